"""Coordinates for a search: without bounds, and all of order one."""

from collections.abc import Mapping, Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .names import expand


class Chart(eqx.Module):
    """Free numbers from coordinates without bounds, all of order one (the transformations of MINUIT)."""

    centre: Array
    scale: Array
    low: Array
    high: Array

    def value(self, u: Any) -> Any:
        below, above = jnp.isfinite(self.low), jnp.isfinite(self.high)
        low, high = jnp.where(below, self.low, 0.0), jnp.where(above, self.high, 0.0)
        rise = self.scale * (jnp.sqrt(u * u + 1.0) - 1.0)
        one_sided = jnp.where(below, low + rise, high - rise)
        two_sided = low + 0.5 * (high - low) * (1.0 + jnp.sin(u))
        return jnp.where(below & above, two_sided, jnp.where(below | above, one_sided, self.centre + self.scale * u))

    def coordinate(self, x: Any) -> Any:
        below, above = jnp.isfinite(self.low), jnp.isfinite(self.high)
        low, high = jnp.where(below, self.low, 0.0), jnp.where(above, self.high, 1.0)
        rise = jnp.maximum(jnp.where(below, x - low, high - x), 0.0) / self.scale + 1.0
        one_sided = jnp.sqrt(rise * rise - 1.0)
        width = jnp.where(high > low, high - low, 1.0)
        two_sided = jnp.arcsin(jnp.clip(2.0 * (x - low) / width - 1.0, -0.999999, 0.999999))
        return jnp.where(below & above, two_sided, jnp.where(below | above, one_sided, (x - self.centre) / self.scale))


def limits_of(scene, state, names, bounds: Mapping[str, Sequence[float | int]], dtype) -> tuple[Array, Array]:
    low, high = np.full((2, len(names)), ((-np.inf,), (np.inf,)))
    for name, pair in bounds.items():
        for full in expand(scene, state, [name]):
            if full not in names:
                raise ValueError(
                    f"Argument `bounds` must name free numbers, but got {name!r}; try adding it to `free`."
                )
            if len(pair) != 2 or not pair[0] < pair[1]:
                raise ValueError(
                    f"Argument `bounds[{name!r}]` must be (lowest, highest), but got {pair}; try exchanging."
                )
            low[names.index(full)], high[names.index(full)] = pair
    return jnp.asarray(low.astype(dtype)), jnp.asarray(high.astype(dtype))


def chart_of(scene, state, names, first: Any, limits: tuple) -> Chart:
    """Coordinates in which one is a natural step: a rolling spin for spins, the speed for velocities."""
    speed = float(np.linalg.norm(np.asarray(state.velocity))) or 1.0
    natural = {"throw.velocity": speed, "throw.spin": speed / float(scene.ball.radius), "throw.position": 1.0}
    sizes = [
        natural.get(name.rsplit(".", 1)[0], abs(float(x)) or 1.0)
        for name, x in zip(names, np.asarray(first), strict=True)
    ]
    low, high = limits
    return Chart(first, jnp.asarray(np.asarray(sizes, first.dtype)), low, high)
