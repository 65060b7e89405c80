"""What a throw is designed for."""

from abc import abstractmethod
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from .._math import Scalar, frozen
from .._motion import Trajectory

_ON_ONE_ARC = 33
_ON_ALL_ARCS = 257
_ROUNDS = 3
_NEWTON_STEPS = 4


def as_point(x: Any) -> Any:
    point = jnp.asarray(x, dtype=None if isinstance(x, jax.Array) else float)
    if point.shape != (3,):
        raise ValueError(f"Argument `point` must have shape (3,), but got {point.shape}; try [0.0, 0.0, 1.0].")
    return point


class AbstractGoal(eqx.Module):
    """A differentiable residual of a trajectory, zero where the goal is reached.

    A goal of passing through a point sets `passes_after`, the number of impacts that must come first where there is no
    itinerary. A search may then treat the time of passing as one more free number, which saves it the search for the
    closest approach at every step."""

    passes_after: eqx.AbstractClassVar[int | None]

    @abstractmethod
    def residual(self, trajectory: Trajectory, n_required: int | None) -> tuple[Float[Array, " n"], Scalar]:
        """The residual, and the time at which the goal is closest. `n_required` is the length of the itinerary (the
        trajectory then stops before the impact after it), or `None` without one."""


class ReturnTo(AbstractGoal):
    """The ball's centre comes back to `point` (in m, shape (3,)) on the arc after the itinerary's last impact, or,
    without an itinerary, on any arc after the first impact. The residual is the vector of closest approach. Raises
    `ValueError` for another shape.

    ```python
    from nonholo_jax import ReturnTo
    goal = ReturnTo([-0.3, 0.0, 0.9])
    ```
    """

    passes_after: ClassVar[int | None] = 1
    point: Float[Array, "3"] = eqx.field(converter=as_point)

    def residual(self, trajectory, n_required):
        return _closest_approach(trajectory, self.point, 1 if n_required is None else n_required, n_required is None)


class HitTarget(AbstractGoal):
    """The ball's centre passes through `point` (in m, shape (3,)) on the arc after the itinerary's last impact, or,
    without an itinerary, on any arc, the first included. Raises `ValueError` for another shape.

    ```python
    from nonholo_jax import HitTarget
    goal = HitTarget([1.2, 0.0, 0.4])
    ```
    """

    passes_after: ClassVar[int | None] = 0
    point: Float[Array, "3"] = eqx.field(converter=as_point)

    def residual(self, trajectory, n_required):
        return _closest_approach(trajectory, self.point, n_required or 0, n_required is None)


class Land(AbstractGoal):
    """The contact point of an impact is at `point` (in m, shape (3,)): of the itinerary's last impact, or, without an
    itinerary, of the first impact on the surface named `surface` (on any surface if `None`). Raises `ValueError` for
    another shape, and when it is asked about a scene without that surface.

    ```python
    from nonholo_jax import Land
    goal = Land([0.5, 0.1, 0.0], surface="floor")
    ```
    """

    passes_after: ClassVar[int | None] = None
    point: Float[Array, "3"] = eqx.field(converter=as_point)
    surface: str | None = eqx.field(static=True, default=None)

    def residual(self, trajectory, n_required):
        log = trajectory.impacts
        names = trajectory.system.names  # pyright: ignore[reportAttributeAccessIssue]
        if self.surface is not None and self.surface not in names:
            raise ValueError(f"Argument `surface` must be one of {', '.join(names)}, but got {self.surface!r}.")
        wanted = log.surface >= 0
        if n_required is None and self.surface is not None:
            wanted = log.surface == names.index(self.surface)
        row = jnp.argmax(wanted) if n_required is None else jnp.asarray(n_required - 1)
        happened = wanted[row]
        return jnp.where(happened, log.point[row] - self.point.astype(log.point.dtype), jnp.nan), log.time[row]


def _closest_approach(trajectory: Trajectory, point: Any, first: int, everywhere: bool) -> tuple[Any, Any]:
    """The vector from `point` to the nearest point of the path after impact number `first`, and its time. A sample
    near it is found without derivatives; from there the path is a parabola (to rounding, if not exactly), on which
    Newton's method finds the closest approach, and its last step carries the derivatives."""
    point = point.astype(trajectory.t1.dtype)
    log = trajectory.impacts
    begin = trajectory.t0 if first == 0 else log.time[first - 1]
    phase, system = None, trajectory.system
    if trajectory.motion.is_closed_form and not everywhere and not system.may_stay:
        state = trajectory.initial if first == 0 else jax.tree.map(lambda x: x[first - 1], log.after)
        t, low, high = begin, jnp.zeros_like(begin), frozen(trajectory.t1 - begin)
    else:
        low, high, t = _bracket(frozen(trajectory), point, frozen(begin), everywhere)
        state, low, high = trajectory.at(t), low - t, high - t
        phase = _phase_at(trajectory, t) if system.may_stay else None
    inner = system.prepared(t, system.unpacked(state, phase))
    _, pull = system.derivative(t, inner, *system.evolving(inner))
    offset, velocity = state.position - point, state.velocity
    bend = jnp.stack([jnp.asarray(a, dtype=t.dtype) for a in pull])
    s = low + (high - low) * _samples(_ON_ONE_ARC, t.dtype)[:, None]
    away = jnp.sum(frozen(offset[None] + velocity[None] * s + 0.5 * bend[None] * s * s) ** 2, axis=-1)
    nearest = jnp.argmin(jnp.where(jnp.isnan(away), jnp.inf, away))
    s = s[nearest, 0]
    for _ in range(_NEWTON_STEPS):
        s = frozen(jnp.clip(s - _newton(offset, velocity, bend, s), low, high))
    inside = (s > low) & (s < high)
    s = jnp.where(inside, s - _newton(offset, velocity, bend, s), s)
    enough = trajectory.n_impacts >= first
    return jnp.where(enough, offset + velocity * s + 0.5 * bend * s * s, jnp.nan), frozen(t + s)


def _phase_at(trajectory: Trajectory, t: Any) -> Any:
    """Which surface the ball is on at a time, or -1."""
    log = trajectory.impacts
    if log.time.shape[0] == 0:
        return None
    past = jnp.sum((log.surface >= 0) & (log.until <= t), dtype=jnp.int32)
    return jnp.where(past > 0, log.support[jnp.maximum(past - 1, 0)], np.int32(-1))


def _samples(n: int, dtype: Any) -> Any:
    return jnp.linspace(0.0, 1.0, n, dtype=dtype)


def _bracket(still: Trajectory, point: Any, start: Any, everywhere: bool) -> tuple[Any, Any, Any]:
    """Times before and after the closest approach, and between them, by sampling ever finer."""
    start = jnp.where(jnp.isfinite(start), start, still.t0)
    samples = _samples(_ON_ALL_ARCS if everywhere else _ON_ONE_ARC, start.dtype)
    last = samples.size - 1

    def refined(_, bracket):
        low, high, _ = bracket
        times = low + (high - low) * samples
        away = jnp.sum((still.at(times).position - point[None]) ** 2, axis=-1)
        nearest = jnp.argmin(jnp.where(jnp.isnan(away), jnp.inf, away))
        return times[jnp.maximum(nearest - 1, 0)], times[jnp.minimum(nearest + 1, last)], times[nearest]

    return lax.fori_loop(0, _ROUNDS, refined, (start, still.t1, start))


def _newton(offset: Any, velocity: Any, bend: Any, s: Any) -> Any:
    """Newton's step for the zero of d/ds |offset + velocity s + bend s^2 / 2|^2 / 2."""
    x, v = offset + velocity * s + 0.5 * bend * s * s, velocity + bend * s
    speed = jnp.sum(v * v)
    curvature = speed + jnp.sum(x * bend)
    # Where the distance is not convex, the step of Gauss and Newton still goes downhill.
    curvature = jnp.where(curvature > 0, curvature, speed)
    usable = curvature > 0
    return jnp.where(usable, jnp.sum(x * v) / jnp.where(usable, curvature, 1.0), 0.0)
