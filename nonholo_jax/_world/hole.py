"""A plane with a round hole in it: a ball that touches one has its centre on a plane, on a quarter of a torus round the
rim, or on a cylinder inside."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp

from .._impact import AbstractContactLaw
from .._math import (
    Interval,
    Number,
    Track,
    Vector3,
    Window,
    add,
    as_number,
    as_vector,
    beyond,
    components,
    dot,
    is_constant,
    maximum,
    minimum,
    norm,
    plus,
    product,
    ratio,
    root,
    scale,
    square,
    subtract,
    times,
    total,
    unit,
    where,
)
from .round import perpendicular
from .surface import AbstractSurface, check, nonzero, positive

_DEEP = 16.0  # hole radii


def _minus(x: Interval) -> Interval:
    return Interval(times(-1.0, x.high), times(-1.0, x.low))


def _blunt(y: tuple, least: Number) -> Number:
    """The size of y, without its point at y = 0: where it is smaller than `least`, a parabola that is never smaller."""
    size = norm(y)
    if is_constant(least) and least <= 0:
        return size
    blunt = ratio(plus(dot(y, y), times(least, least)), times(2.0, least))
    return where(size < least, blunt, size)


def _blunt_track(window: Window, axes: tuple, origin: Vector3, least: Number) -> Track:
    """Bounds of `_blunt` along a path, exact where the window is short.

    With R the larger of the size and `least`, its second derivative is (|y'|^2 + y . y'' - R'^2) / R, without R'^2
    where y is smaller than `least`; and |y'|^2 is at least R'^2.
    """
    tracks = [window.along(axis, origin) for axis in axes]
    ends = lambda parts: (total([part.low for part in parts]), total([part.high for part in parts]))  # noqa: E731
    (_, speed), (pull, push) = ends([square(t.rate) for t in tracks]), ends([product(t.value, t.bend) for t in tracks])
    near, far = (root(x) for x in ends([square(t.value) for t in tracks]))
    smallest, speed_end = maximum(near, least), root(speed)
    start = tuple(p[0] for p in window.coefficients)
    pace = tuple(p[1] if len(p) > 1 else 0.0 for p in window.coefficients)
    y, w = (tuple(dot(axis, x) for axis in axes) for x in (subtract(start, origin), pace))
    value, rate = _blunt(y, least), ratio(dot(y, w), maximum(norm(y), least))

    def within(bend: Interval) -> tuple[Interval, Interval]:
        rates = window.spread(rate, bend)
        rates = Interval(maximum(rates.low, times(-1.0, speed_end)), minimum(rates.high, speed_end))
        values = window.spread(value, rates)
        return rates, Interval(maximum(values.low, near), minimum(values.high, maximum(far, least)))

    low = ratio(minimum(pull, 0.0), smallest)
    high = ratio(maximum(plus(speed, push), 0.0), smallest)
    rates, _ = within(Interval(low, high))
    at_full_size = near >= least
    slower = where(at_full_size, square(rates).low, 0.0)
    high = ratio(maximum(plus(plus(speed, push), times(-1.0, slower)), 0.0), smallest)
    rates, values = within(Interval(low, high))
    return Track(values, rates, Interval(low, high))


def _half_square_bend(track: Track, slack: Number) -> Interval:
    """Bounds of the second derivative of max(x, 0)^2 / 2: that is x'^2 + x x'' where x > 0, and 0 elsewhere. Down to
    -`slack`, which is rounding, x counts as positive: a ball that rolls off must not seem to fall back."""
    value, rate, bend = track
    farthest, squares = maximum(value.high, 0.0), square(rate)
    low = plus(squares.low, times(farthest, minimum(bend.low, 0.0)))
    high = where(farthest > 0, plus(squares.high, times(farthest, maximum(bend.high, 0.0))), 0.0)
    return Interval(where(plus(value.low, slack) >= 0, low, minimum(low, 0.0)), high)


class Hole(AbstractSurface):
    """A half-space with a round hole in it, straight down and without a bottom.

    **Arguments:** `center` of the hole in the plane in m, shape (3,); `normal` of the plane, shape (3,), any length but
    zero, towards the ball; `radius` > 0 of the hole in m, larger than the ball's; `law` of contact, on the plane, the
    sharp rim and the wall. Raises `ValueError` for a zero normal or a radius that is not positive. A bottom is another
    surface below, such as a `Plane`. There is one hole in a plane.

    ```python
    from nonholo_jax import Hole, Rough
    green = Hole(center=(0.0, 0.0, 0.0), normal=(0.0, 0.0, 1.0), radius=0.054, law=Rough(0.4))
    ```
    """

    center: Any = eqx.field(converter=as_vector)
    facing: Any = eqx.field(converter=as_vector)
    radius: Number = eqx.field(converter=as_number)
    law: AbstractContactLaw

    def __init__(self, center: Any, normal: Any, radius: Any, law: AbstractContactLaw):
        self.center, self.facing = as_vector(center), as_vector(normal)
        self.radius, self.law = as_number(radius), law
        check(self)

    def _frame(self) -> tuple[Vector3, Vector3, tuple]:
        """The middle of the hole, the normal, and two axes across it."""
        n = unit(components(self.facing))
        return components(self.center), n, perpendicular(n)

    def _place(self, x: Vector3) -> tuple[tuple, Number]:
        """A point across the axis of the hole, and its height above the plane."""
        center, n, axes = self._frame()
        d = subtract(x, center)
        # Not dot(n, x - center): a plane at height 0 then costs nothing.
        return tuple(dot(axis, d) for axis in axes), plus(dot(n, x), times(-1.0, dot(n, center)))

    def _excess(self, y: tuple, height: Number) -> tuple[Number, Number]:
        """How far a point is inside the hole's edge, and above the plane; negative on the other side."""
        return plus(self.radius, times(-1.0, norm(y))), height

    def distance(self, x, t):
        inwards, height = self._excess(*self._place(x))
        outside = norm((beyond(inwards, 0.0), beyond(height, 0.0)))
        return plus(outside, minimum(maximum(inwards, height), 0.0))

    def direction(self, x, t):
        y, height = self._place(x)
        return self._normal(y, *[beyond(e, 0.0) for e in self._excess(y, height)])

    def _normal(self, y: tuple, inwards: Number, height: Number) -> Vector3:
        _, n, axes = self._frame()
        out = unit(y)
        n_across, n_up = unit((times(-1.0, inwards), height))
        return add(
            add(scale(times(n_across, out[0]), axes[0]), scale(times(n_across, out[1]), axes[1])), scale(n_up, n)
        )

    def level(self, x, t, radius):
        y, height = self._place(x)
        inwards = plus(self.radius, times(-1.0, _blunt(y, self._spare(radius))))
        excess = (beyond(inwards, 0.0), beyond(height, 0.0))
        return ratio(plus(dot(excess, excess), times(-1.0, times(radius, radius))), times(2.0, radius))

    def _spare(self, radius: Number) -> Number:
        """How far the centre of a ball in the hole can go from the axis."""
        return plus(self.radius, times(-1.0, radius))

    def reach(self, x, radius):
        inwards, height = self._excess(*self._place(x))
        return maximum(norm((beyond(inwards, 0.0), beyond(height, 0.0))), radius)

    def bend(self, window, t, radius):
        center, n, axes = self._frame()
        away = _blunt_track(window, axes, center, self._spare(radius))
        inwards = Interval(*[plus(self.radius, x) for x in _minus(away.value)])
        dtype = jnp.result_type(*[c for p in window.coefficients for c in p if not is_constant(c)] or [float])
        slack = times(32.0 * float(jnp.finfo(dtype).eps), self.extent())
        parts = [_half_square_bend(Track(inwards, _minus(away.rate), _minus(away.bend)), slack),
                 _half_square_bend(window.along(n, center), slack)]  # fmt: skip
        return Interval(*[ratio(total(ends), radius) for ends in zip(*parts, strict=True)])

    def seams(self):
        # From the plane to the rim, and from the rim to the wall, which comes to a second end that does not matter.
        center, n, axes = self._frame()
        deep = times(_DEEP, self.radius)
        return [(axes, center, self.radius), ((n,), subtract(center, scale(deep, n)), deep)]

    def direction_within(self, x, t, beyond):
        outside, above = beyond
        y, height = self._place(x)
        above = outside | (above & (height > times(-_DEEP, self.radius)))
        inwards = where(outside, 0.0, plus(self.radius, times(-1.0, norm(y))))
        return self._normal(y, inwards, where(above, height, 0.0))

    def directions(self):
        return (unit(components(self.facing)),)

    def most(self, n):
        facing = unit(components(self.facing))
        known = all(is_constant(c) for c in (*n, *facing))
        return dot(n, components(self.center)) if known and tuple(n) == tuple(facing) else None

    def extent(self):
        return plus(norm(components(self.center)), self.radius)

    def is_proper(self, radius):
        sentence = f"`radius` must be larger than the ball's, but got {self.radius} and {radius}"
        return [
            nonzero("normal", self.facing),
            positive("radius", self.radius),
            (self.radius > radius, sentence),
        ]
