"""What throws and scenes are drawn from. Throw i depends on the key and on i alone."""

import warnings
from collections.abc import Sequence
from typing import Any, Literal, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._questions import expand, read, write
from .._world import BallState, Scene
from .distribution import AbstractDistribution, Correlated

Sequences = Literal["random", "sobol", "saltelli"]
SOBOL_MOST = 2**30  # points of a sequence


class Vary(eqx.Module):
    """Numbers that vary together: names such as `"throw.spin.y"`, `"velocity"` (three numbers) or
    `"surfaces.floor.law.restitution"`, and their distribution.

    ```python
    from nonholo_jax import Normal, Vary
    Vary(["velocity"], Normal(std=0.05))
    ```
    """

    names: tuple[str, ...] = eqx.field(static=True)
    distribution: AbstractDistribution

    def __init__(self, names: Sequence[str] | str, distribution: AbstractDistribution):
        self.names = (names,) if isinstance(names, str) else tuple(names)
        self.distribution = distribution
        if not isinstance(distribution, AbstractDistribution):
            raise ValueError(
                f"Argument `distribution` must be a distribution, but got {distribution!r}; try Normal(0.1)."
            )


class Sampler(eqx.Module):
    """A throw, and what of it and of its scene varies.

    **Arguments:**

    - `throw`: what does not vary, and the centre of what does.
    - `vary`: a sequence of `Vary`. Different ones are independent of each other.
    - `sequence`: `"random"`, or `"sobol"` for a scrambled Sobol sequence (`scipy.stats.qmc`), whose means converge
        faster where few numbers vary. Its throws are not independent: standard errors are then those that as many
        random throws would have. `"saltelli"` is the design that `sobol_indices` takes for its total indices.

    `monte_carlo` raises `ValueError` for names that the scene does not have or that come twice, and for distributions
    that do not fit their names.

    ```python
    from nonholo_jax import BallState, Normal, Sampler, Uniform, Vary
    throw = BallState([0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0])
    vary = [Vary("velocity", Normal(std=0.05)), Vary("surfaces.floor.law.restitution", Uniform(0.8, 0.9))]
    Sampler(throw, vary)
    ```
    """

    throw: BallState
    vary: tuple[Vary, ...]
    sequence: Sequences = eqx.field(static=True)

    def __init__(self, throw: BallState, vary: Sequence[Vary], sequence: Sequences = "random"):
        self.throw, self.vary, self.sequence = throw, tuple(vary), sequence
        if sequence not in get_args(Sequences):
            known = ", ".join(map(repr, get_args(Sequences)))
            raise ValueError(f"Argument `sequence` must be one of {known}, but got {sequence!r}; try 'random'.")
        if not self.vary:
            raise ValueError(
                "Argument `vary` must hold at least one Vary, but got none; try Vary('spin', Normal(1.0))."
            )

    def names(self, scene: Scene) -> tuple[str, ...]:
        """Full names of the single numbers that vary, in the order of `values`."""
        names = expand(scene, self.throw, [name for each in self.vary for name in each.names])
        for each, group in self._groups(scene):
            try:
                each.distribution.check(len(group))
            except ValueError as error:
                raise ValueError(f"{', '.join(each.names)}: {error}") from None
        return names

    def _groups(self, scene: Scene) -> list[tuple[Vary, tuple[str, ...]]]:
        return [(each, expand(scene, self.throw, each.names)) for each in self.vary]

    def n_uniform(self, scene: Scene) -> int:
        """How many uniform numbers a throw takes."""
        return sum(each.distribution.n_uniform(len(group)) for each, group in self._groups(scene))

    def values(self, scene: Scene, u: Float[Array, " k"]) -> Float[Array, " d"]:
        """The numbers that vary, from uniform ones."""
        found, begin = [], 0
        for each, group in self._groups(scene):
            end = begin + each.distribution.n_uniform(len(group))
            new = each.distribution.values(u[begin:end], read(scene, self.throw, group))
            found.append(jnp.broadcast_to(new, (len(group),)))
            begin = end
        return jnp.concatenate(found)

    def moments(self, scene: Scene) -> tuple[np.ndarray, np.ndarray]:
        """Mean, shape (d,), and covariance, shape (d, d), of the numbers that vary."""
        names, found = self.names(scene), []
        for each, group in self._groups(scene):
            found.append(each.distribution.moments(np.asarray(read(scene, self.throw, group), dtype=float)))
        covariance, begin = np.zeros((len(names), len(names))), 0
        for _, part in found:
            end = begin + len(part)
            covariance[begin:end, begin:end] = part
            begin = end
        return np.concatenate([mean for mean, _ in found]), covariance

    def sources(self, scene: Scene) -> tuple[str, ...]:
        """A name for each of the uniform numbers: what it moves."""
        names: list[str] = []
        for each, group in self._groups(scene):
            count = each.distribution.n_uniform(len(group))
            whole = "+".join(each.names)
            own = isinstance(each.distribution, Correlated) or count != len(group)
            names += [f"{whole}#{k}" if count > 1 else whole for k in range(count)] if own else group
        return tuple(names)

    def chosen(self, scene: Scene, seed: Any, start: int, count: int) -> np.ndarray:
        """The uniform numbers of throws `start` to `start + count` of a sequence that is not random."""
        d, dtype = self.n_uniform(scene), self.throw.position.dtype
        if self.sequence == "sobol":
            return sobol(seed, d, start, count, dtype)
        # Saltelli's design: a row A, the same with one number after the other from B, and B.
        first, last = start // (d + 2), (start + count - 1) // (d + 2)
        rows = sobol(seed, 2 * d, first, last - first + 1, dtype)
        index = np.arange(start, start + count)
        row, place = rows[index // (d + 2) - first], (index % (d + 2))[:, None]
        from_b = (place == np.arange(1, d + 1)) | (place == d + 1)
        return np.where(from_b, row[:, d:], row[:, :d])

    def applied(self, scene: Scene, values: Float[Array, " d"]) -> tuple[Scene, BallState]:
        """Scene and throw with those numbers."""
        return write(scene, self.throw, self.names(scene), values)


def uniforms(key: Any, index: Any, shape: tuple, dtype: Any) -> Array:
    """Numbers in (0, 1), ends excluded, that depend on the key and the pair of halves of a 64-bit index alone."""
    high, low = index
    u = jax.random.uniform(jax.random.fold_in(jax.random.fold_in(key, high), low), shape, dtype)
    eps = float(jnp.finfo(dtype).eps)
    return jnp.clip(u, 0.25 * eps, 1.0 - 0.5 * eps)


def halves(index: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """64-bit indices as two of 32 bits, which do not need JAX's x64 mode."""
    return (index >> 32).astype(np.uint32), (index & 0xFFFFFFFF).astype(np.uint32)


def sobol(seed: Any, dimension: int, start: int, count: int, dtype: Any) -> np.ndarray:
    """Rows `start` to `start + count` of a scrambled Sobol sequence, in (0, 1)."""
    from scipy.stats import qmc

    bits = SOBOL_MOST.bit_length() - 1  # of each number; SciPy cannot go forward in sequences of more than 32
    engine = qmc.Sobol(dimension, scramble=True, bits=bits, rng=np.random.default_rng(seed))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the balance of a power of two is kept by the whole, not by its chunks
        if start:
            engine.fast_forward(start)
        u = engine.random(count)
    eps = float(np.finfo(dtype).eps)
    u = u + 0.5 ** (bits + 1)  # the middle of a cell
    return np.clip(u.astype(dtype), 0.25 * eps, 1.0 - 0.5 * eps)
