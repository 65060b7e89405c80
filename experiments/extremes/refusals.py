"""How many throws in random scenes end before their time, and by which name: with contacts followed by
`Exact(contact=Integrated())`, and, for comparison, with `Exact()` alone.

    python experiments/extremes/refusals.py [--throws 100000] [--plain] [--json FILE]

Every number of the scenes is drawn anew for each throw, as in `random_scenes.py`. A throw counts as refused if its
result is neither a success nor `max_impacts` (bounces that go on, most of them of restitution near 1). At its end no
ball may be inside anything, by distances in NumPy, nor may the energy have grown. Exit code 1 where one breaks that.
"""

import argparse
import json
import pathlib
import sys
import time
from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from random_scenes import BUILD, NAMES_OF_RESULTS, Template, admissible, gaps

from nonholo_jax import Ball, BallState, Exact, Frictional, Integrated, Rough, Scene, simulate

sys.path.append(str(pathlib.Path(__file__).parents[1]))  # for report.py
from report import machine

DONE = ("reached_t1", "at_rest", "max_impacts")
T1, IMPACTS, TOLERANCE = 2.0, 256, 1e-6
DEEPEST, MOST_GAINED = 1e-6, 1e-4


def _losing(u: Any) -> Any:
    """One coefficient, and no elastic walls: bounces die out."""
    return Rough(0.9 * u[0])


def _rubbing(u: Any) -> Any:
    """The same with friction, from none to more than any that is known."""
    return Frictional(0.9 * u[0], 0.5 * u[1], u[2])


SHAPES = {
    "bowl with a post": ("bowl", "post"),
    "pipe with a box": ("pipe", "box"),
    "floor with wall and box": ("plane", "plane", "box"),
    "Galton board": ("plane", "post", "post", "post", "post"),
}
FAMILIES = tuple(
    Template(f"{name}, {kind}", shapes, law)
    for name, shapes in SHAPES.items()
    for kind, law in (("rough", _losing), ("friction", _rubbing))
)


class Found(NamedTuple):
    throws: int
    results: Counter
    depth: float  # the deepest that a ball was inside something at its end, in m
    gained: float  # the most energy gained, per mass, relative to what there was
    wrong: tuple[int, ...]  # throws that are none of these, by their number

    @property
    def refused(self) -> int:
        return sum(count for name, count in self.results.items() if name not in DONE)


def program(template: Template, motion: Any) -> Callable:
    def one(d):
        laws = [template.law(u) for u in d["laws"]]
        surfaces = {f"{k}": BUILD[kind](d["surfaces"][k], laws[k]) for k, kind in enumerate(template.surfaces)}
        scene = Scene(Ball(d["radius"], 1.0, d["alpha"]), surfaces, gravity=d["gravity"])
        state = BallState(d["position"], d["velocity"], d["spin"])
        end = simulate(scene, state, t1=T1, max_impacts=IMPACTS, log_size=0, motion=motion, throw=False)
        return end.result._value, end.final.position, end.final.velocity, end.final.spin  # pyright: ignore

    return jax.jit(jax.vmap(one))


def tame(template: Template, rng: np.random.Generator, n: int) -> dict[str, np.ndarray]:
    """Balls of ordinary sizes and speeds under a gravity that points down, so that most of them come to stay."""
    d = admissible(template, rng, n, float)
    d["velocity"] *= np.minimum(1.0, 3.0 / np.linalg.norm(d["velocity"], axis=1, keepdims=True))
    d["alpha"] = rng.uniform(0.2, 1.0, n)
    d["gravity"] = np.array([0.0, 0.0, -9.81]) + 0.5 * rng.standard_normal((n, 3))
    return d


def study(template: Template, throws: int, motion: Any, batch: int = 1024, seed: int = 0) -> Found:
    rng, run = np.random.default_rng([seed, FAMILIES.index(template)]), program(template, motion)
    results, depth, gained, wrong = Counter(), 0.0, -np.inf, []
    for k in range(-(-throws // batch)):
        d = tame(template, rng, batch)
        codes, x, v, w = (np.asarray(part) for part in run(jax.tree.map(jnp.asarray, d)))
        results.update(NAMES_OF_RESULTS[code] for code in codes)
        inside = -gaps(template, d, x[:, None]).reshape(batch, -1).min(axis=1)
        depth = max(depth, float(inside.max()))

        def energy(x, v, w, d=d):
            turning = d["alpha"] * d["radius"] ** 2 * np.sum(w**2, axis=1)
            return 0.5 * (np.sum(v**2, axis=1) + turning) - np.sum(x * d["gravity"], axis=1)

        before, after = energy(d["position"], d["velocity"], d["spin"]), energy(x, v, w)
        more = (after - before) / (1.0 + abs(before))
        gained = max(gained, float(np.max(more)))
        wrong += [int(k * batch + i) for i in np.nonzero(~((inside <= DEEPEST) & (more <= MOST_GAINED)))[0]]
    return Found(batch * -(-throws // batch), results, depth, gained, tuple(wrong))


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=str(__doc__).split("\n\n")[0])
    parser.add_argument("--throws", type=int, default=100_000, help="in each family")
    parser.add_argument("--plain", action="store_true", help="with Exact() alone")
    parser.add_argument("--only", default="", help="families with this in their name")
    parser.add_argument("--json", type=pathlib.Path, metavar="FILE")
    options = parser.parse_args(argv)
    jax.config.update("jax_enable_x64", True)
    motion = Exact() if options.plain else Exact(contact=Integrated(rtol=TOLERANCE, atol=TOLERANCE))
    print(f"{machine()}\n{'':33} {'throws':>7} {'refused':>8} {'depth':>8} {'energy':>8}  results")
    rows, fine = {}, True
    for template in FAMILIES:
        if options.only not in template.name:
            continue
        begun = time.monotonic()
        found = study(template, options.throws, motion)
        counts = ", ".join(f"{count} {name}" for name, count in found.results.most_common())
        fine &= not found.wrong
        sizes = f"{found.throws:7} {found.refused / found.throws:8.5f} {found.depth:8.1e} {found.gained:8.1e}"
        verdict = f" FAIL: {', '.join(map(str, found.wrong[:8]))}" if found.wrong else ""
        print(f"{template.name:33} {sizes}  {counts}{verdict}  ({time.monotonic() - begun:.0f} s)", flush=True)
        rows[template.name] = found._asdict()
    if options.json:
        options.json.write_text(json.dumps({"machine": machine(), "families": rows}, indent=1))
    return 0 if fine else 1


if __name__ == "__main__":
    sys.exit(main())
