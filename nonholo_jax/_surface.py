"""Surfaces: where they are, which way they face, and bounds that let a crossing be found without passing it."""

from abc import abstractmethod
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ._law import AbstractContactLaw
from ._polynomial import Interval, Window, evaluate, product, square
from ._rotation import matrix
from ._types import Number, Scalar, Vector, Vector3
from ._vector import (
    add,
    as_number,
    as_vector,
    components,
    cross,
    dot,
    is_constant,
    maximum,
    minimum,
    norm,
    pack,
    plus,
    ratio,
    scale,
    slope,
    subtract,
    times,
    total,
    unit,
    where_number,
)


class AbstractSurface(eqx.Module):
    """A surface that the ball bounces on. Subclasses say, by components and for a point x, the signed `distance`, the
    `direction` from the surface to the point, and a bound of the second derivative of the `level` along a path."""

    law: eqx.AbstractVar[AbstractContactLaw]

    @abstractmethod
    def distance(self, x: Vector3, t: Number) -> Number:
        """Signed distance of a point from the surface in m."""

    @abstractmethod
    def direction(self, x: Vector3, t: Number) -> Vector3:
        """The unit normal, from the surface to the point."""

    @abstractmethod
    def level(self, x: Vector3, t: Number, radius: Number) -> Number:
        """A smooth function of the ball's centre with the zeros of the gap, and unit gradient there."""

    @abstractmethod
    def reach(self, x: Vector3, radius: Number) -> Number | None:
        """The length over which `bend` is tight, or `None` where it is so everywhere."""

    @abstractmethod
    def bend(self, window: Window, t: Number, radius: Number) -> Interval:
        """Bounds of the second derivative of the level along the path in the window."""

    @abstractmethod
    def extent(self) -> Number:
        """The size of the numbers that describe the surface, in m."""

    @abstractmethod
    def is_proper(self, radius: Number) -> list:
        """Conditions on the surface for a ball of that radius, each a pair (bool, sentence)."""

    def is_bounded(self) -> bool:
        """Whether `bend` is a true bound, not an estimate from samples."""
        return getattr(self, "curvature", 0.0) is not None

    def gap(self, x: Vector, t: float | Scalar = 0.0, radius: float | Scalar = 0.0) -> Scalar:
        """Signed distance from the skin of a ball of `radius` (in m) centred at `x` (shape (3,), in m) to the surface,
        negative if it penetrates. With the default radius, the distance of the point `x`."""
        return jnp.asarray(plus(self.distance(components(x), t), times(-1.0, radius)), dtype=x.dtype)

    def normal(self, x: Vector, t: float | Scalar = 0.0) -> Vector:
        """Unit normal from the surface to the point `x`, shape (3,)."""
        return pack(self.direction(components(x), t), x)

    def velocity(self, point: Vector, t: float | Scalar = 0.0) -> Vector:
        """Velocity of the surface at `point`, in m/s, shape (3,): zero for every surface of this version."""
        return jnp.zeros_like(point)


def _finite_and_nonzero(name: str, vector: Any) -> tuple:
    length = norm(components(vector))
    return (length > 0, f"`{name}` must not be the zero vector, but got {vector}")


def _check(surface: AbstractSurface, radius: Number = 0.0) -> None:
    """Raise for what is known now to be wrong; traced values end as `RESULTS.invalid_state`."""
    for holds, sentence in surface.is_proper(radius):
        if isinstance(holds, bool) and not holds:
            raise ValueError(f"Argument {sentence}.")


def _positive(name: str, value: Number) -> tuple:
    return (value > 0, f"`{name}` must be positive, but got {value}; use SI units")


def _perpendicular(axis: Vector3) -> tuple[Vector3, Vector3]:
    """Two unit vectors that complete a unit vector to an orthonormal frame."""
    x, y, z = axis
    if all(is_constant(c) for c in axis):
        helper = min(range(3), key=lambda i: abs(axis[i]))
        first = unit(cross(axis, tuple(1.0 if i == helper else 0.0 for i in range(3))))  # pyright: ignore
    else:  # Duff et al., J. Comput. Graph. Tech. 6(1), 2017: no singular direction
        sign = where_number(z >= 0, 1.0, -1.0)
        a = -1.0 / (sign + z)
        first = (1.0 + sign * x * x * a, sign * x * y * a, -sign * x)
    return first, cross(axis, first)


class Plane(AbstractSurface):
    """A half-space: the ball stays on the side of the normal.

    **Arguments:** `point` on the plane in m, shape (3,); `normal`, shape (3,), any length but zero, towards the ball;
    `law` of contact. Raises `ValueError` for a zero normal.

    ```python
    from nonholo_jax import Plane, Rough
    floor = Plane(point=(0.0, 0.0, 0.0), normal=(0.0, 0.0, 1.0), law=Rough())
    ```
    """

    point: Any = eqx.field(converter=as_vector)
    facing: Any = eqx.field(converter=as_vector)
    law: AbstractContactLaw

    def __init__(self, point: Any, normal: Any, law: AbstractContactLaw):
        self.point, self.facing, self.law = as_vector(point), as_vector(normal), law
        _check(self)

    def distance(self, x, t):
        n = self.direction(x, t)
        # Two dot products, not dot(n, x - point): a floor at height 0 then costs nothing.
        return plus(dot(n, x), times(-1.0, dot(n, components(self.point))))

    def direction(self, x, t):
        return unit(components(self.facing))

    def level(self, x, t, radius):
        return plus(self.distance(x, t), times(-1.0, radius))

    def reach(self, x, radius):
        return None

    def bend(self, window, t, radius):
        return window.along(unit(components(self.facing)), (0.0, 0.0, 0.0)).bend

    def extent(self):
        return norm(components(self.point))

    def is_proper(self, radius):
        return [_finite_and_nonzero("normal", self.facing)]


def _excess(y: Vector3, half: Vector3) -> Vector3:
    """How far a point in the box's own frame is beyond each pair of faces."""
    return tuple(maximum(plus(abs(c), times(-1.0, h)), 0.0) for c, h in zip(y, half, strict=True))  # pyright: ignore


def _box_distance(y: Vector3, half: Vector3) -> Number:
    inside = [plus(abs(c), times(-1.0, h)) for c, h in zip(y, half, strict=True)]
    deepest = maximum(maximum(inside[0], inside[1]), inside[2])
    return plus(norm(_excess(y, half)), minimum(deepest, 0.0))


def _box_level(y: Vector3, half: Vector3, radius: Number) -> Number:
    """(D - r^2) / 2r with D the squared distance, a sum of three clipped squares: no list of faces, edges, corners."""
    beyond = _excess(y, half)
    return ratio(plus(dot(beyond, beyond), times(-1.0, times(radius, radius))), times(2.0, radius))


def _box_bend(window: Window, axes: tuple, center: Vector3, half: Vector3, radius: Number) -> Interval:
    """The sum of the clipped squares' second derivatives, each v^2 + e a where e > 0 and 0 elsewhere, over r."""
    lows, highs = [], []
    for axis, h in zip(axes, half, strict=True):
        value, rate, bend = window.along(axis, center)
        farthest = maximum(plus(maximum(value.high, times(-1.0, value.low)), times(-1.0, h)), 0.0)
        # The excess e grows with the coordinate on the right of the box and against it on the left.
        right, left = value.low > 0, value.high < 0
        either = maximum(abs(bend.low), abs(bend.high))
        away = where_number(right, bend.high, where_number(left, times(-1.0, bend.low), either))
        back = where_number(right, times(-1.0, bend.low), where_number(left, bend.high, either))
        squares = square(rate)
        lows.append(minimum(plus(squares.low, times(-1.0, times(farthest, maximum(back, 0.0)))), 0.0))
        highs.append(where_number(farthest > 0, plus(squares.high, times(farthest, maximum(away, 0.0))), 0.0))
    return Interval(ratio(total(lows), radius), ratio(total(highs), radius))


def _box_direction(y: Vector3, half: Vector3, axes: tuple) -> Vector3:
    beyond = [times(e, where_number(c < 0, -1.0, 1.0)) for c, e in zip(y, _excess(y, half), strict=True)]
    n = unit(beyond)
    return add(add(scale(n[0], axes[0]), scale(n[1], axes[1])), scale(n[2], axes[2]))


def _in_frame(x: Vector3, center: Vector3, axes: tuple) -> Vector3:
    d = subtract(x, center)
    return tuple(dot(axis, d) for axis in axes)  # pyright: ignore


def _rotation_axes(rotation: Any) -> tuple:
    """The box's own axes in the world frame; exact constants where there is no rotation."""
    if rotation is None:
        return ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    if isinstance(rotation, tuple) and all(is_constant(c) for c in rotation):
        with jax.ensure_compile_time_eval():
            turn = np.asarray(matrix(rotation), dtype=float)
        return tuple(tuple(float(c) for c in column) for column in turn.T)
    turn = matrix(jnp.stack([jnp.asarray(c) for c in rotation]) if isinstance(rotation, tuple) else rotation)
    return tuple(tuple(turn[i, j] for i in range(3)) for j in range(3))


class Box(AbstractSurface):
    """A solid box with faces, edges and corners: a table top, a step, a brick.

    **Arguments:** `center` in m, shape (3,); `half_size` in m, shape (3,), positive; `law` of contact; `rotation`, a
    quaternion (w, x, y, z) from the box's own axes to the world, or `None` for a box along the axes. Raises
    `ValueError` for half sizes that are not positive.

    ```python
    from nonholo_jax import Box, Rough
    table = Box(center=(0.6, 0.0, 0.715), half_size=(0.6, 0.4, 0.015), law=Rough())
    ```
    """

    center: Any = eqx.field(converter=as_vector)
    half_size: Any = eqx.field(converter=as_vector)
    law: AbstractContactLaw
    rotation: Any = eqx.field(converter=as_vector, default=None)

    def __check_init__(self):
        _check(self)

    def _frame(self):
        return components(self.center), components(self.half_size), _rotation_axes(self.rotation)

    def distance(self, x, t):
        center, half, axes = self._frame()
        return _box_distance(_in_frame(x, center, axes), half)

    def direction(self, x, t):
        center, half, axes = self._frame()
        return _box_direction(_in_frame(x, center, axes), half, axes)

    def level(self, x, t, radius):
        center, half, axes = self._frame()
        return _box_level(_in_frame(x, center, axes), half, radius)

    def reach(self, x, radius):
        center, half, axes = self._frame()
        return maximum(norm(_excess(_in_frame(x, center, axes), half)), radius)

    def bend(self, window, t, radius):
        center, half, axes = self._frame()
        return _box_bend(window, axes, center, half, radius)

    def extent(self):
        return plus(norm(components(self.center)), norm(components(self.half_size)))

    def is_proper(self, radius):
        return [_positive("half_size", h) for h in components(self.half_size)]


class Rectangle(AbstractSurface):
    """A thin plate with edges; the ball bounces on both of its sides.

    **Arguments:** `center` in m, shape (3,); `normal`, shape (3,); `tangent`, shape (3,), the direction of the first
    side (its part along the normal is removed); `half_size` of the two sides in m, shape (2,), positive; `law` of
    contact. Raises `ValueError` for a zero normal, a tangent along the normal, or half sizes that are not positive.

    ```python
    from nonholo_jax import Rectangle, Rough
    shelf = Rectangle((0.0, 0.0, 1.0), (0.0, 0.0, 1.0), (1.0, 0.0, 0.0), (0.5, 0.2), Rough())
    ```
    """

    center: Any = eqx.field(converter=as_vector)
    facing: Any = eqx.field(converter=as_vector)
    tangent: Any = eqx.field(converter=as_vector)
    half_size: Any = eqx.field(converter=as_vector)
    law: AbstractContactLaw

    def __init__(self, center: Any, normal: Any, tangent: Any, half_size: Any, law: AbstractContactLaw):
        self.center, self.facing, self.tangent = as_vector(center), as_vector(normal), as_vector(tangent)
        self.half_size, self.law = as_vector(half_size), law
        _check(self)

    def _frame(self):
        n = unit(components(self.facing))
        raw = components(self.tangent)
        tangent = unit(subtract(raw, scale(dot(raw, n), n)))
        half = components(self.half_size)
        return components(self.center), (half[0], half[1], 0.0), (tangent, cross(n, tangent), n)

    def distance(self, x, t):
        center, half, axes = self._frame()
        return norm(_excess(_in_frame(x, center, axes), half))

    def direction(self, x, t):
        center, half, axes = self._frame()
        return _box_direction(_in_frame(x, center, axes), half, axes)

    def level(self, x, t, radius):
        center, half, axes = self._frame()
        return _box_level(_in_frame(x, center, axes), half, radius)

    def reach(self, x, radius):
        center, half, axes = self._frame()
        return maximum(norm(_excess(_in_frame(x, center, axes), half)), radius)

    def bend(self, window, t, radius):
        center, half, axes = self._frame()
        return _box_bend(window, axes, center, half, radius)

    def extent(self):
        return plus(norm(components(self.center)), norm(components(self.half_size)))

    def is_proper(self, radius):
        n, raw = components(self.facing), components(self.tangent)
        sideways = norm(cross(n, raw)) > 0
        sentence = f"`tangent` must not be along `normal`, but got {self.tangent} and {self.facing}"
        return [
            _finite_and_nonzero("normal", self.facing),
            (sideways, sentence),
            *[_positive("half_size", h) for h in components(self.half_size)],
        ]


def _round_level(y: tuple, reach: Number, inside: bool) -> Number:
    """(|y|^2 - rho^2) / 2 rho, or its opposite inside: the second derivative is exact and cheap to bound."""
    outside = ratio(plus(dot(y, y), times(-1.0, times(reach, reach))), times(2.0, reach))
    return times(-1.0, outside) if inside else outside


def _round_bend(window: Window, axes: tuple, origin: Vector3, reach: Number, inside: bool) -> Interval:
    tracks = [window.along(axis, origin) for axis in axes]
    terms = [*[square(track.rate) for track in tracks], *[product(track.value, track.bend) for track in tracks]]
    low, high = (ratio(total([getattr(term, end) for term in terms]), reach) for end in ("low", "high"))
    return Interval(times(-1.0, high), times(-1.0, low)) if inside else Interval(low, high)


_AXES = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


class Sphere(AbstractSurface):
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
        _check(self)

    def _reach(self, radius):
        return plus(self.radius, times(-1.0 if self.inside else 1.0, radius))

    def distance(self, x, t):
        outward = plus(norm(subtract(x, components(self.center))), times(-1.0, self.radius))
        return times(-1.0 if self.inside else 1.0, outward)

    def direction(self, x, t):
        return scale(-1.0 if self.inside else 1.0, unit(subtract(x, components(self.center))))

    def level(self, x, t, radius):
        return _round_level(subtract(x, components(self.center)), self._reach(radius), self.inside)

    def reach(self, x, radius):
        return self._reach(radius) if self.inside else norm(subtract(x, components(self.center)))

    def bend(self, window, t, radius):
        return _round_bend(window, _AXES, components(self.center), self._reach(radius), self.inside)

    def extent(self):
        return plus(norm(components(self.center)), self.radius)

    def is_proper(self, radius):
        return [_positive("radius", self.radius), _fits(self.radius, radius, self.inside)]


def _fits(radius: Number, ball: Number, inside: bool) -> tuple:
    sentence = f"`radius` must be larger than the ball's inside a surface, but got {radius} and {ball}"
    return (radius > ball, sentence) if inside else (True, sentence)


class Cylinder(AbstractSurface):
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
        _check(self)

    def _reach(self, radius):
        return plus(self.radius, times(-1.0 if self.inside else 1.0, radius))

    def _across(self, x):
        axes = _perpendicular(unit(components(self.axis)))
        d = subtract(x, components(self.point))
        return axes, tuple(dot(axis, d) for axis in axes)

    def distance(self, x, t):
        _, y = self._across(x)
        return times(-1.0 if self.inside else 1.0, plus(norm(y), times(-1.0, self.radius)))

    def direction(self, x, t):
        axes, y = self._across(x)
        n = scale(-1.0 if self.inside else 1.0, unit(y))
        return add(scale(n[0], axes[0]), scale(n[1], axes[1]))

    def level(self, x, t, radius):
        return _round_level(self._across(x)[1], self._reach(radius), self.inside)

    def reach(self, x, radius):
        return self._reach(radius) if self.inside else norm(self._across(x)[1])

    def bend(self, window, t, radius):
        axes = _perpendicular(unit(components(self.axis)))
        return _round_bend(window, axes, components(self.point), self._reach(radius), self.inside)

    def extent(self):
        return plus(norm(components(self.point)), self.radius)

    def is_proper(self, radius):
        return [
            _finite_and_nonzero("axis", self.axis),
            _positive("radius", self.radius),
            _fits(self.radius, radius, self.inside),
        ]


_SAMPLES = (0.0, 0.25, 0.5, 0.75, 1.0)


class Implicit(AbstractSurface):
    """Any surface, given as the zeros of a smooth function of the ball's centre.

    **Arguments:**

    - `function`: `gap(x, t)` of the ball's centre x (shape (3,), in m) at time t, in m: positive apart, zero at
        contact; it need not be a distance, but its gradient must not vanish at contact. It must not depend on t in
        this version. It may be an `equinox.Module` whose fields are traced.
    - `law` of contact.
    - `curvature`: a bound in 1/m of the norm of the second derivative of the function. With it no crossing is ever
        passed. Without it `Exact` refuses the surface; `Integrated` then bounds the second derivative along each step
        from five samples with their spread as margin, which can pass a bump much narrower than a step.

    ```python
    import jax.numpy as jnp
    from nonholo_jax import Implicit, Rough
    hills = Implicit(lambda x, t: x[2] - 0.1 * jnp.sin(x[0]) - 0.05, Rough(), curvature=0.1)
    ```
    """

    function: Any
    law: AbstractContactLaw
    curvature: Number | None = eqx.field(converter=as_number, default=None)

    def __init__(self, gap: Any, law: AbstractContactLaw, curvature: Any = None):
        # A plain function is no pytree of arrays; `Partial` makes it one without leaves.
        self.function = gap if isinstance(gap, eqx.Module) else jax.tree_util.Partial(gap)
        self.law = law
        self.curvature = as_number(curvature)
        _check(self)

    def _value(self, x, t):
        dtype = jnp.result_type(*[c for c in x if not is_constant(c)] or [float])
        return self.function(jnp.stack([jnp.asarray(c, dtype=dtype) for c in x]), t)

    def _gradient(self, x, t):
        point = jnp.stack([jnp.asarray(c) for c in x])
        return components(jax.grad(lambda p: self.function(p, t))(point))

    def distance(self, x, t):
        return self._value(x, t)

    def gap(self, x: Vector, t: float | Scalar = 0.0, radius: float | Scalar = 0.0) -> Scalar:
        """The given function at the ball's centre `x`; the radius is already in it."""
        return self.function(x, t)

    def direction(self, x, t):
        return unit(self._gradient(x, t))

    def level(self, x, t, radius):
        return self._value(x, t)

    def reach(self, x, radius):
        return None if self.curvature is None else ratio(1.0, self.curvature, otherwise=1e12)

    def bend(self, window, t, radius):
        if self.curvature is None:
            return self._sampled_bend(window, t)
        start = tuple(p[0] for p in window.coefficients)
        tracks = [window.track(p) for p in window.coefficients]
        fastest = norm([maximum(abs(track.rate.low), abs(track.rate.high)) for track in tracks])
        hardest = norm([maximum(abs(track.bend.low), abs(track.bend.high)) for track in tracks])
        along = [
            product(Interval(g, g), track.bend) for g, track in zip(self._gradient(start, t), tracks, strict=True)
        ]
        # v . H v, and what the gradient can turn by within the window, times the acceleration.
        turned = times(times(self.curvature, times(fastest, window.width)), hardest)
        margin = plus(times(self.curvature, fastest * fastest), turned)
        return Interval(total([x.low for x in along]) - margin, total([x.high for x in along]) + margin)

    def _sampled_bend(self, window, t):
        def along(s):
            return self._value(tuple(evaluate(p, s) for p in window.coefficients), t)

        rate = lambda s: slope(lambda z: along(z[0]), (s,), (1.0,))[1]  # noqa: E731
        like = jnp.asarray(window.width)
        samples = [slope(lambda z: rate(z[0]), (c * like,), (1.0,))[1] for c in _SAMPLES]
        low, high = samples[0], samples[0]
        for sample in samples[1:]:
            low, high = minimum(low, sample), maximum(high, sample)
        return Interval(low - (high - low), high + (high - low))

    def extent(self):
        return 0.0

    def is_proper(self, radius):
        if self.curvature is None:
            return []
        return [(self.curvature >= 0, f"`curvature` must not be negative, but got {self.curvature}")]
