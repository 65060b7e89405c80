"""Spheres and cylinders, from outside and from inside."""

import functools
from abc import abstractmethod
from typing import Any

import equinox as eqx

from .._impact import AbstractContactLaw
from .._math import (
    Interval,
    Number,
    Vector3,
    Window,
    add,
    as_number,
    as_vector,
    components,
    cross,
    dot,
    is_constant,
    norm,
    plus,
    product,
    ratio,
    scale,
    square,
    subtract,
    times,
    total,
    unit,
    where,
)
from .surface import AbstractSurface, check, nonzero, positive


def perpendicular(axis: Vector3) -> tuple[Vector3, Vector3]:
    """Two unit vectors that complete a unit vector to an orthonormal frame."""
    x, y, z = axis
    if all(is_constant(c) for c in axis):
        helper = min(range(3), key=lambda i: abs(axis[i]))
        first = unit(cross(axis, tuple(1.0 if i == helper else 0.0 for i in range(3))))  # pyright: ignore
    else:  # Duff et al., J. Comput. Graph. Tech. 6(1), 2017: no singular direction
        sign = where(z >= 0, 1.0, -1.0)
        a = -1.0 / (sign + z)
        first = (1.0 + sign * x * x * a, sign * x * y * a, -sign * x)
    return first, cross(axis, first)


def round_level(y: tuple, reach: Number, inside: bool) -> Number:
    """(|y|^2 - rho^2) / 2 rho, or its opposite inside: the second derivative is exact and cheap to bound."""
    outside = ratio(plus(dot(y, y), times(-1.0, times(reach, reach))), times(2.0, reach))
    return times(-1.0, outside) if inside else outside


def round_bend(window: Window, axes: tuple, origin: Vector3, reach: Number, inside: bool) -> Interval:
    tracks = [window.along(axis, origin) for axis in axes]
    terms = [*[square(track.rate) for track in tracks], *[product(track.value, track.bend) for track in tracks]]
    low, high = (ratio(total([getattr(term, end) for term in terms]), reach) for end in ("low", "high"))
    return Interval(times(-1.0, high), times(-1.0, low)) if inside else Interval(low, high)


_AXES = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


def _lies_across(n: Vector3, axes: tuple) -> bool:
    """Whether a direction is known to have no part along the axis of a cylinder."""
    square = total([times(dot(n, axis), dot(n, axis)) for axis in axes])
    return is_constant(square) and bool(abs(square - dot(n, n)) <= 1e-15)


class _AbstractRound(AbstractSurface):
    """What a sphere and a cylinder share: a distance from a middle, across two or three axes."""

    radius: eqx.AbstractVar[Number]
    inside: eqx.AbstractVar[bool]

    @abstractmethod
    def _frame(self) -> tuple[Vector3, tuple]:
        """A point in the middle, and the axes across which the surface is round."""

    @property
    def _sign(self) -> float:
        return -1.0 if self.inside else 1.0

    def _reach(self, radius):
        return plus(self.radius, times(self._sign, radius))

    def _across(self, x):
        middle, axes = self._frame()
        d = subtract(x, middle)
        return tuple(dot(axis, d) for axis in axes)

    def distance(self, x, t):
        return times(self._sign, plus(norm(self._across(x)), times(-1.0, self.radius)))

    def direction(self, x, t):
        n = scale(self._sign, unit(self._across(x)))
        _, axes = self._frame()
        return functools.reduce(add, [scale(c, axis) for c, axis in zip(n, axes, strict=True)])

    def level(self, x, t, radius):
        return round_level(self._across(x), self._reach(radius), self.inside)

    def reach(self, x, radius):
        return self._reach(radius) if self.inside else norm(self._across(x))

    def bend(self, window, t, radius):
        middle, axes = self._frame()
        return round_bend(window, axes, middle, self._reach(radius), self.inside)

    def most(self, n):
        middle, axes = self._frame()
        if self.inside or not is_constant(norm(n)) or not _lies_across(n, axes):
            return None
        return plus(dot(n, middle), times(norm(n), self.radius))

    def extent(self):
        return plus(norm(self._frame()[0]), self.radius)


class Sphere(_AbstractRound):
    """A fixed sphere; the ball is outside it, or inside where `inside` is True.

    **Arguments:** `center` in m, shape (3,); `radius` > 0 in m (larger than the ball's where `inside`); `law` of
    contact; `inside`, a Python bool. Raises `ValueError` for a radius that is not positive.

    ```python
    from nonholo_jax import Smooth, Sphere
    bowl = Sphere(center=(0.0, 0.0, 1.0), radius=1.0, law=Smooth(), inside=True)
    ```
    """

    center: Any = eqx.field(converter=as_vector)
    radius: Number = eqx.field(converter=as_number)
    law: AbstractContactLaw
    inside: bool = eqx.field(static=True, default=False)

    def __check_init__(self):
        check(self)

    def _frame(self):
        return components(self.center), _AXES

    def is_proper(self, radius):
        return [positive("radius", self.radius), _fits(self.radius, radius, self.inside)]


def _fits(radius: Number, ball: Number, inside: bool) -> tuple:
    sentence = f"`radius` must be larger than the ball's inside a surface, but got {radius} and {ball}"
    return (radius > ball, sentence) if inside else (True, sentence)


class Cylinder(_AbstractRound):
    """An endless circular cylinder; the ball is outside it, or inside where `inside` is True.

    **Arguments:** `point` on the axis in m, shape (3,); `axis`, shape (3,), any length but zero; `radius` > 0 in m
    (larger than the ball's where `inside`); `law` of contact; `inside`, a Python bool. Raises `ValueError` for a zero
    axis or a radius that is not positive.

    ```python
    from nonholo_jax import Cylinder, Rough
    post = Cylinder(point=(1.0, 0.0, 0.0), axis=(0.0, 0.0, 1.0), radius=0.1, law=Rough())
    ```
    """

    point: Any = eqx.field(converter=as_vector)
    axis: Any = eqx.field(converter=as_vector)
    radius: Number = eqx.field(converter=as_number)
    law: AbstractContactLaw
    inside: bool = eqx.field(static=True, default=False)

    def __check_init__(self):
        check(self)

    def _frame(self):
        return components(self.point), perpendicular(unit(components(self.axis)))

    def is_proper(self, radius):
        return [
            nonzero("axis", self.axis),
            positive("radius", self.radius),
            _fits(self.radius, radius, self.inside),
        ]
