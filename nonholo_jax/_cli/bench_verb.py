"""`nonholo bench`: its options, and what is measured."""

import argparse
import math
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:  # the other verbs need nothing of this
    from .._questions import Bench
else:
    Bench = Any


def whole(text: str) -> int:
    """A whole number, which may be written as 1e6."""
    number = float(text)
    if not math.isfinite(number) or number != int(number):
        raise ValueError(text)
    return int(number)


def add_options(parser: argparse.ArgumentParser) -> None:
    kinds = "kinds of platform, with commas, such as cpu,gpu (default: all that JAX has)"
    parser.add_argument("--devices", metavar="KINDS", help=kinds)
    parser.add_argument("--dtypes", metavar="DTYPES", help="of float64,float32 (default: both)")
    parser.add_argument("--jobs", metavar="JOBS", help="of value,gradient (default: both)")
    parser.add_argument("--most", metavar="N", type=whole, default=10**7, help="throws in a batch (default: 1e7)")
    parser.add_argument("--seed", type=int, default=0, help="of the throws (default: %(default)s)")


def run(file: Any | None, options: argparse.Namespace, progress: bool) -> Bench:
    """The benchmark of a scene file, or of the scenes that come with the package."""
    from .._questions import bench

    listed = {name: getattr(options, name) for name in ("devices", "dtypes", "jobs")}
    wanted = {name: [x.strip() for x in text.split(",")] for name, text in listed.items() if text is not None}
    how: dict[str, Any] = {**wanted, "most": options.most, "seed": options.seed, "progress": progress}
    if file is None:
        return bench(**how)
    drawn = {"throw": file.throw} if file.monte_carlo is None else {"draw": draws(file, options.seed)}
    found = bench(file.scene, **drawn, **file.simulate.arguments, name=options.stem, **how)
    if "draw" in drawn:
        found.scenes[options.stem]["throws"] = f"drawn from [monte_carlo] of the file, seed {options.seed}"
    return found


def draws(file: Any, seed: int) -> Any:
    """A function that draws n throws, and scenes if these vary, from the `[monte_carlo]` table of a scene file. Throw i
    depends on the seed and on i alone."""
    import equinox as eqx
    import jax.numpy as jnp
    import numpy as np

    sampler, scene = file.monte_carlo.sampler, file.scene

    def draw(n: int) -> Any:
        count, dtype = sampler.n_uniform(scene), np.dtype(sampler.throw.position.dtype)
        if sampler.sequence == "random":
            tiny = float(np.finfo(dtype).eps)
            u = np.clip(np.random.default_rng(seed).random((n, count)), tiny, 1.0 - tiny).astype(dtype)
        else:
            u = sampler.chosen(scene, seed, 0, n)
        one = lambda u: sampler.applied(scene, sampler.values(scene, u))  # noqa: E731
        scenes, throws = eqx.filter_vmap(one, out_axes=eqx.if_array(0))(jnp.asarray(u))
        own = any(not name.startswith("throw.") for name in sampler.names(scene))
        return (scenes, throws) if own else throws

    return draw
