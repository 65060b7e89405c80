"""What is measured of a trajectory in a Monte Carlo study. Any function of a `Trajectory` may be; these are ready."""

import functools
from abc import abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .._math import KINDS, NO_IMPACTS, along, frozen, is_failure, root, shared
from .._motion import ImpactLog, Trajectory, flat
from .._questions import as_point

_SAMPLES = 17  # of an arc, of which the nearest begins Newton's method
_NEWTON_STEPS = 3


class AbstractMeasure(eqx.Module):
    """A function of one `Trajectory` that returns a number, a vector of shape (3,), or True or False (an event, whose
    mean is its probability). NaN where there is nothing to measure. `unit` is that of the numbers."""

    unit: eqx.AbstractClassVar[str]

    @abstractmethod
    def __call__(self, trajectory: Trajectory) -> Any:
        """The measured value."""


class Quantity(NamedTuple):
    """A number that was measured; an `event` is true or false, and its mean a probability."""

    name: str
    unit: str
    event: bool


def quantities_of(measures: Mapping[str, Any], shapes: Sequence[Any]) -> tuple[list[Quantity], tuple]:
    """The numbers that measures of such shapes give, and pairs of them that are places seen from above."""
    found: list[Quantity] = []
    pairs = []
    for (name, measure), shape in zip(measures.items(), shapes, strict=True):
        unit, event = getattr(measure, "unit", ""), shape.dtype == bool
        if len(shape.shape) > 1:
            raise ValueError(f"Measure {name!r} must give a number or a vector, but gives shape {shape.shape}.")
        if shape.shape == ():
            found.append(Quantity(name, unit, event))
            continue
        if shape.shape == (3,) and unit == "m":
            pairs.append((len(found), len(found) + 1))
        letters = ("x", "y", "z") if shape.shape[0] == 3 else tuple(map(str, range(shape.shape[0])))
        found += [Quantity(f"{name}.{letter}", unit, event) for letter in letters]
    return found, tuple(pairs)


def measured(measures: Iterable[Any], trajectory: Trajectory) -> Float[Array, " q"]:
    """All that is measured of one trajectory. NaN where that failed: its `final` is where it stopped, not its end."""
    return jnp.where(is_failure(trajectory.result), jnp.nan, flat(measures, trajectory))


def struck(log: ImpactLog) -> Any:
    """The rows of a log that are impacts: not where a ball left an edge or ceased to slip, nor unused ones."""
    others = [log.kind == getattr(KINDS, name) for name in NO_IMPACTS]
    return (log.surface >= 0) & ~functools.reduce(jnp.logical_or, others)


def _row(trajectory: Trajectory, surface: str | None, count: int) -> tuple[Any, Any]:
    """The row of the log with that impact on that surface, and whether there is one."""
    log = trajectory.impacts
    names = trajectory.system.names
    if surface is not None and surface not in names:
        raise ValueError(f"Argument `surface` must be one of {', '.join(names)}, but got {surface!r}.")
    wanted = struck(log) if surface is None else struck(log) & (log.surface == names.index(surface))
    there = wanted & (jnp.cumsum(wanted, dtype=jnp.int32) == count)
    return jnp.argmax(there), jnp.any(there)


class Landing(AbstractMeasure):
    """Contact point, in m, of the impact number `count` on the surface of that name (on any if `None`); shape (3,).

    ```python
    from nonholo_jax import Landing
    Landing("floor")                                         # where the ball first comes to the floor
    ```
    """

    unit: ClassVar[str] = "m"
    surface: str | None = eqx.field(static=True, default=None)
    count: int = eqx.field(static=True, default=1)

    def __call__(self, trajectory) -> Float[Array, "3"]:
        row, there = _row(trajectory, self.surface, self.count)
        return jnp.where(there, trajectory.impacts.point[row], jnp.nan)


class LandingTime(AbstractMeasure):
    """Time, in s, of the impact number `count` on the surface of that name (on any if `None`).

    ```python
    from nonholo_jax import LandingTime
    LandingTime("table")
    ```
    """

    unit: ClassVar[str] = "s"
    surface: str | None = eqx.field(static=True, default=None)
    count: int = eqx.field(static=True, default=1)

    def __call__(self, trajectory) -> Float[Array, ""]:
        row, there = _row(trajectory, self.surface, self.count)
        return jnp.where(there, trajectory.impacts.time[row], jnp.nan)


class ImpactCount(AbstractMeasure):
    """How many impacts there were; a train is one.

    ```python
    from nonholo_jax import ImpactCount
    ImpactCount()
    ```
    """

    unit: ClassVar[str] = ""

    def __call__(self, trajectory) -> Float[Array, ""]:
        return trajectory.n_impacts.astype(trajectory.t1.dtype)


class FinalPosition(AbstractMeasure):
    """Position, in m, at the end; shape (3,).

    ```python
    from nonholo_jax import FinalPosition
    FinalPosition()
    ```
    """

    unit: ClassVar[str] = "m"

    def __call__(self, trajectory) -> Float[Array, "3"]:
        return trajectory.final.position


class Distance(AbstractMeasure):
    """How near, in m, the ball's centre comes to `point` (in m, shape (3,)) after impact number `after` (0: from the
    beginning on). Exact for parabolas; with air on the polynomial of degree five that has the position, velocity and
    acceleration of both ends of an arc. NaN where there are fewer impacts. Bounces of a train are passed over, and so
    is what follows the last impact that the log has room for.

    ```python
    from nonholo_jax import Distance
    Distance([-0.3, 0.0, 0.9])
    ```
    """

    unit: ClassVar[str] = "m"
    point: Float[Array, "3"] = eqx.field(converter=as_point)
    after: int = eqx.field(static=True, default=1)

    def __call__(self, trajectory) -> Float[Array, ""]:
        return _nearest(trajectory, self.point, self.after)


class Returns(AbstractMeasure):
    """Whether the ball's centre comes within `within` m of `point` (in m, shape (3,)) after impact number `after`: see
    `Distance`. Raises `ValueError` unless `within` is positive.

    ```python
    from nonholo_jax import Returns
    Returns([-0.3, 0.0, 0.9], within=0.1)                    # back to the hand
    ```
    """

    unit: ClassVar[str] = ""
    point: Float[Array, "3"] = eqx.field(converter=as_point)
    within: float = eqx.field(static=True)
    after: int = eqx.field(static=True, default=1)

    def __check_init__(self):
        if not self.within > 0:
            raise ValueError(f"Argument `within` must be positive, but got {self.within}; try within=0.1 (metres).")

    def __call__(self, trajectory) -> Bool[Array, ""]:
        return _nearest(trajectory, self.point, self.after) <= self.within


def _nearest(trajectory: Trajectory, point: Any, after: int) -> Any:
    """The smallest distance to a point on the arcs that begin with impact number `after`."""
    log, dtype = trajectory.impacts, trajectory.t1.dtype
    rows = log.time.shape[0]
    if after > rows:
        return jnp.asarray(jnp.nan, dtype)
    first, last = (jax.tree.map(lambda x: x[None], state) for state in (trajectory.initial, trajectory.final))
    join = lambda *xs: jnp.concatenate([jnp.asarray(x) for x in xs])[after:]  # noqa: E731
    begins, phases = join(trajectory.t0[None], log.until), join(-jnp.ones(1, jnp.int32), log.support)
    starts = jax.tree.map(join, first, log.after)
    arc = after + jnp.arange(rows + 1 - after, dtype=jnp.int32)
    is_last = arc == trajectory.n_rows
    ends = jnp.where(is_last, trajectory.t1, join(log.time, trajectory.t1[None]))
    arrivals = jax.tree.map(lambda x, y: jnp.where(along(is_last, y), y, join(x, y)), log.before, last)
    there = is_last | ((arc < trajectory.n_rows) & (arc < rows))
    tame = lambda x, y: jnp.where(along(there, x), x, y)  # noqa: E731
    starts, arrivals = (jax.tree.map(tame, x, first) for x in (starts, arrivals))
    begins, ends = jnp.where(there, begins, 0.0), jnp.where(there, ends, 0.0)
    of_arc = lambda *arc: _coefficients(trajectory.system, point.astype(dtype), *arc)  # noqa: E731
    away = _nearest_of(jax.vmap(of_arc)(begins, ends, starts, arrivals, jnp.where(there, phases, -1)))
    found = jnp.min(jnp.where(there, away, jnp.inf))
    return jnp.where(jnp.isfinite(found), found, jnp.nan)


def _coefficients(system: Any, point: Any, begin: Any, end: Any, start: Any, arrival: Any, phase: Any) -> list:
    """Of the polynomials of degree five, one for each component, that take an arc, as seen from a point, to [0, 1]."""
    free, h = system.without_contacts(), end - begin

    def pull(time: Any, state: Any) -> Any:
        inner = free.unpacked(state, phase)
        _, rate = free.derivative(time, inner, *free.evolving(inner))
        return [jnp.asarray(x, dtype=h.dtype) for x in rate[:3]]

    found = []
    for i, (a, b) in enumerate(zip(pull(begin, start), pull(end, arrival), strict=True)):
        x, v, a = start.position[i] - point[i], h * start.velocity[i], h * h * a
        far = arrival.position[i] - point[i] - (x + v + 0.5 * a)
        fast, strong = h * arrival.velocity[i] - (v + a), h * h * b - a
        found.append((x, v, 0.5 * a, 10.0 * far - 4.0 * fast + 0.5 * strong, -15.0 * far + 7.0 * fast - strong,
                      6.0 * far - 3.0 * fast + 0.5 * strong))  # fmt: skip
    return found


def _nearest_of(parts: Any) -> Any:
    """The smallest length of a vector whose three components are polynomials of degree five on [0, 1], for many. One
    number after the other, each an array over the arcs: a compiler makes one loop of that."""
    numbers = shared([number for part in parts for number in part])
    parts = [numbers[k : k + 6] for k in range(0, len(numbers), 6)]
    still = frozen(parts)
    s, square = jnp.zeros_like(still[0][0]), sum(part[0] ** 2 for part in still)
    for k in range(1, _SAMPLES):
        here = k / (_SAMPLES - 1)
        new = sum(_at(part, here) ** 2 for part in still)
        s, square = jnp.where(new < square, here, s), jnp.minimum(new, square)
    (s,) = shared([s])
    low, high = jnp.maximum(s - 1.0 / (_SAMPLES - 1), 0.0), jnp.minimum(s + 1.0 / (_SAMPLES - 1), 1.0)
    for _ in range(_NEWTON_STEPS):
        places, speeds, pulls = (jnp.stack(each) for each in zip(*[_expanded(part, s) for part in still], strict=True))
        speed = jnp.sum(speeds * speeds, axis=0)
        curvature = speed + jnp.sum(places * pulls, axis=0)
        curvature = jnp.where(curvature > 0, curvature, speed)
        step = jnp.sum(places * speeds, axis=0) / jnp.where(curvature > 0, curvature, 1.0)
        (s,) = shared([jnp.clip(s - step, low, high)])
    # At the closest point the distance does not depend on s to first order.
    square = sum(_at(part, s) ** 2 for part in parts)
    return jax.vmap(root)(square)


def _at(part: tuple, s: Any) -> Any:
    """A polynomial, by Horner's rule."""
    value = part[5]
    for k in (4, 3, 2, 1, 0):
        value = part[k] + s * value
    return value


def _expanded(part: tuple, s: Any) -> tuple[Any, Any, Any]:
    """A polynomial and its first two derivatives."""
    x, v, a = part[5], jnp.zeros_like(part[5]), jnp.zeros_like(part[5])
    for k in (4, 3, 2, 1, 0):
        x, v, a = part[k] + s * x, x + s * v, v + s * a
    return x, v, 2.0 * a
