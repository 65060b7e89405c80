"""Boxes and rectangles: a ball that touches one has its centre on a box with rounded edges and corners."""

from abc import abstractmethod
from collections.abc import Callable, Sequence
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .._impact import AbstractContactLaw
from .._math import (
    Interval,
    Number,
    Vector3,
    Window,
    add,
    as_pair,
    as_quaternion,
    as_vector,
    beyond,
    components,
    cross,
    dot,
    is_constant,
    matrix,
    maximum,
    minimum,
    norm,
    plus,
    ratio,
    scale,
    square,
    subtract,
    times,
    total,
    unit,
    where,
)
from .surface import AbstractSurface, Along, Face, Return, check, nonzero, positive


def _excess(y: Vector3, half: Vector3) -> Vector3:
    """How far a point in the box's own frame is beyond each pair of faces."""
    return tuple(beyond(abs(c), h) for c, h in zip(y, half, strict=True))  # pyright: ignore


def _box_distance(y: Vector3, half: Vector3) -> Number:
    inside = [plus(abs(c), times(-1.0, h)) for c, h in zip(y, half, strict=True)]
    deepest = maximum(maximum(inside[0], inside[1]), inside[2])
    return plus(norm(_excess(y, half)), minimum(deepest, 0.0))


def _box_level(y: Vector3, half: Vector3, radius: Number) -> Number:
    """(D - r^2) / 2r with D the squared distance, a sum of three clipped squares: no list of faces, edges, corners."""
    excess = _excess(y, half)
    return ratio(plus(dot(excess, excess), times(-1.0, times(radius, radius))), times(2.0, radius))


def _box_bend(window: Window, axes: tuple, center: Vector3, half: Vector3, radius: Number) -> Interval:
    """The sum of the clipped squares' second derivatives, each v^2 + e a where e > 0 and 0 elsewhere, over r."""
    lows, highs = [], []
    dtype = jnp.result_type(*[c for p in window.coefficients for c in p if not is_constant(c)] or [float])
    eps = 32.0 * float(jnp.finfo(dtype).eps)
    for axis, h in zip(axes, half, strict=True):
        value, rate, bend = window.along(axis, center)
        farthest = maximum(plus(maximum(value.high, times(-1.0, value.low)), times(-1.0, h)), 0.0)
        # The excess e grows with the coordinate on the right of the box and against it on the left.
        right, left = value.low > 0, value.high < 0
        either = maximum(abs(bend.low), abs(bend.high))
        away = where(right, bend.high, where(left, times(-1.0, bend.low), either))
        back = where(right, times(-1.0, bend.low), where(left, bend.high, either))
        squares = square(rate)
        bend_low = plus(squares.low, times(-1.0, times(farthest, maximum(back, 0.0))))
        # Beyond the edge all along, to rounding: a ball that rolls off must not seem to fall back.
        nearest, slack = maximum(value.low, times(-1.0, value.high)), times(eps, plus(h, abs(dot(axis, center))))
        lows.append(where(plus(nearest, slack) >= h, bend_low, minimum(bend_low, 0.0)))
        highs.append(where(farthest > 0, plus(squares.high, times(farthest, maximum(away, 0.0))), 0.0))
    return Interval(ratio(total(lows), radius), ratio(total(highs), radius))


def _box_direction(y: Vector3, half: Vector3, axes: tuple, excess: Vector3 | None = None) -> Vector3:
    excess = _excess(y, half) if excess is None else excess
    n = unit([where(c < 0, times(-1.0, e), e) for c, e in zip(y, excess, strict=True)])
    return add(add(scale(n[0], axes[0]), scale(n[1], axes[1])), scale(n[2], axes[2]))


def along(x: Vector3, axes: Sequence) -> Any:
    """The components of a vector along some axes."""
    return tuple(dot(axis, x) for axis in axes)  # pyright: ignore


def _in_frame(x: Vector3, center: Vector3, axes: tuple) -> Vector3:
    return along(subtract(x, center), axes)


def _rotation_axes(rotation: Any) -> tuple:
    """The box's own axes in the world frame; exact constants where there is no rotation."""
    if rotation is None:
        return ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    if isinstance(rotation, tuple) and len(rotation) == 3:  # known already
        return rotation
    if isinstance(rotation, tuple) and all(is_constant(c) for c in rotation):
        with jax.ensure_compile_time_eval():
            turn = np.asarray(matrix(rotation), dtype=float)
        return tuple(tuple(float(c) for c in column) for column in turn.T)
    turn = matrix(jnp.stack([jnp.asarray(c) for c in rotation]) if isinstance(rotation, tuple) else rotation)
    return tuple(tuple(turn[i, j] for i in range(3)) for j in range(3))


class AbstractBlock(AbstractSurface):
    """What a solid box and a thin plate share: half sizes along axes of their own."""

    center: eqx.AbstractVar[Any]
    half_size: eqx.AbstractVar[Any]
    has_edges: ClassVar[bool] = True
    faces: eqx.AbstractClassVar[tuple[int, ...]]  # the axes across which there are faces

    @abstractmethod
    def _frame(self) -> tuple[Any, Any, tuple]:
        """The centre, three half sizes, and the axes in the world frame."""

    def in_frame(self, x: Vector3) -> tuple[Vector3, tuple, Vector3]:
        """A point in the block's own frame, the axes of that in the world, and the half sizes."""
        center, half, axes = self._frame()
        return _in_frame(x, center, axes), axes, half

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

    def along(self, n, x, v, slack):
        center, half, axes = self._frame()
        y, w, d = _in_frame(x, center, axes), along(v, axes), along(n, axes)
        like = [abs(d[i]) if i in self.faces else -1.0 for i in range(3)]
        pick = _largest(like)
        backwards = pick(d) < 0
        normal = tuple(
            where(backwards, times(-1.0, c), c) for c in (pick(column) for column in zip(*axes, strict=True))
        )
        height = plus(where(backwards, times(-1.0, pick(y)), pick(y)), times(-1.0, pick(half)))
        inside = [(abs(c) < h - slack) | ((abs(c) <= h + slack) & (where(c < 0, times(-1.0, u), u) <= 0))
                  for c, u, h in zip(y, w, half, strict=True)]  # fmt: skip
        holds = pick([inside[i - 2] & inside[i - 1] for i in range(3)])
        return Along(normal, height, holds, dot(v, subtract(center, x)))  # pyright: ignore

    def rim(self, n):
        center, half, axes = self._frame()
        d = along(n, axes)
        pick = _largest([abs(d[i]) if i in self.faces else -1.0 for i in range(3)])
        others = [[*things[i:], *things[:i]] for things in (axes, half) for i in (1, 2)]
        sides = [(tuple(pick(column) for column in zip(*others[i], strict=True)), pick(others[i + 2])) for i in (0, 1)]
        return center, sides

    def direction_within(self, x, t, beyond):
        center, half, axes = self._frame()
        y, flags = _in_frame(x, center, axes), iter(beyond)
        within = [is_constant(h) and h == 0 for h in half]  # no seam there
        excess = tuple(abs(c) if none else where(next(flags), plus(abs(c), times(-1.0, h)), 0.0)
                       for c, h, none in zip(y, half, within, strict=True))  # fmt: skip
        return _box_direction(y, half, axes, excess)  # pyright: ignore

    def seams(self):
        center, half, axes = self._frame()
        thick = [not (is_constant(h) and h == 0) for h in half]
        return [((axis,), center, h) for axis, h, there in zip(axes, half, thick, strict=True) if there]

    def directions(self):
        axes = self._frame()[2]
        return (*axes, *[scale(-1.0, axis) for axis in axes])

    def most(self, n):
        center, half, axes = self._frame()
        return plus(dot(n, center), total([times(h, abs(dot(n, axis))) for h, axis in zip(half, axes, strict=True)]))

    def extent(self):
        return plus(norm(components(self.center)), norm(components(self.half_size)))

    def returns(self, x, v, half_a, t):
        y, axes, half = self.in_frame(x)
        w, b = along(v, axes), along(half_a, axes)
        pick = _farthest(y, half, self.faces)
        backwards = pick(y) < 0
        rise, pull = (where(backwards, times(-1.0, c), c) for c in (pick(w), times(-1.0, pick(b))))
        # Not of a ball that has just rolled over an edge, whose place is known to rounding only.
        eps = float(jnp.finfo(jnp.result_type(*[c for c in y if not is_constant(c)])).eps)
        inner: Any = tuple(plus(h, times(-64.0 * eps, plus(h, self.extent()))) for h in half)
        comes = (pull > 0) & (rise > 0) & _is_over(y, inner, pick)
        duration = where(comes, rise / where(comes, pull, 1.0), 0.0)
        landing = tuple(plus(c, times(duration, plus(u, times(duration, d)))) for c, u, d in zip(y, w, b, strict=True))
        return Return(duration, comes & _is_over(landing, half, pick), rise, pull)  # pyright: ignore


def _farthest(y: Vector3, half: Vector3, choices: Sequence[int]) -> Callable[[Sequence], Any]:
    """Picks from three things that of the axis along which a point is farthest beyond a box, among `choices`."""
    if len(choices) == 1:
        return lambda options: options[choices[0]]
    return _largest(_excess(y, half))


def _largest(sizes: Sequence) -> Callable[[Sequence], Any]:
    """Picks from three things that of the largest of three numbers."""
    first = (sizes[0] >= sizes[1]) & (sizes[0] >= sizes[2])
    second = sizes[1] >= sizes[2]
    return lambda options: where(first, options[0], where(second, options[1], options[2]))


def _face(x: Vector3, center: Vector3, half: Vector3, axes: tuple, choices: Sequence[int]) -> Face:
    """The face that a point is farthest beyond, of those across the axes `choices`."""
    y = _in_frame(x, center, axes)
    pick = _farthest(y, half, choices)
    pick_vector = lambda vectors: tuple(pick(column) for column in zip(*vectors, strict=True))  # noqa: E731
    turned = [[*things[i:], *things[:i]] for things in (axes, half) for i in (1, 2)]  # the next axis, and the one after
    backwards = pick(y) < 0
    normal = tuple(where(backwards, times(-1.0, c), c) for c in pick_vector(axes))
    tangents, sizes = (pick_vector(turned[0]), pick_vector(turned[1])), (pick(turned[2]), pick(turned[3]))
    return Face(normal, center, tangents, sizes, _is_over(y, half, pick))  # pyright: ignore


def _is_over(y: Vector3, half: Vector3, pick: Callable) -> Any:
    """Whether a point is over the face across the axis that `pick` picks."""
    within = [abs(c) <= h for c, h in zip(y, half, strict=True)]
    others = [within[i - 2] & within[i - 1] for i in range(3)]
    return pick(others)


class Box(AbstractBlock):
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
    rotation: Any = eqx.field(converter=as_quaternion, default=None)
    faces: ClassVar[tuple[int, ...]] = (0, 1, 2)

    def __check_init__(self):
        check(self)

    def _frame(self):
        return components(self.center), components(self.half_size), _rotation_axes(self.rotation)

    def distance(self, x, t):
        center, half, axes = self._frame()
        return _box_distance(_in_frame(x, center, axes), half)

    def face(self, x, t):
        center, half, axes = self._frame()
        return _face(x, center, half, axes, self.faces)

    def engine(self):
        axes = _rotation_axes(self.rotation)
        return eqx.tree_at(lambda box: box.rotation, self, axes, is_leaf=lambda x: x is None)

    def is_proper(self, radius):
        return [positive("half_size", h) for h in components(self.half_size)]


class Rectangle(AbstractBlock):
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
    half_size: Any = eqx.field(converter=as_pair)
    law: AbstractContactLaw
    faces: ClassVar[tuple[int, ...]] = (2,)

    def __init__(self, center: Any, normal: Any, tangent: Any, half_size: Any, law: AbstractContactLaw):
        self.center, self.facing, self.tangent = as_vector(center), as_vector(normal), as_vector(tangent)
        self.half_size, self.law = as_pair(half_size), law
        check(self)

    def _frame(self):
        n = unit(components(self.facing))
        raw = components(self.tangent)
        tangent = unit(subtract(raw, scale(dot(raw, n), n)))
        half = components(self.half_size)
        return components(self.center), (half[0], half[1], 0.0), (tangent, cross(n, tangent), n)

    def distance(self, x, t):
        center, half, axes = self._frame()
        return norm(_excess(_in_frame(x, center, axes), half))

    def face(self, x, t):
        center, half, axes = self._frame()
        return _face(x, center, half, axes, self.faces)

    def is_proper(self, radius):
        n, raw = components(self.facing), components(self.tangent)
        sideways = norm(cross(n, raw)) > 0
        sentence = f"`tangent` must not be along `normal`, but got {self.tangent} and {self.facing}"
        return [
            nonzero("normal", self.facing),
            (sideways, sentence),
            *[positive("half_size", h) for h in components(self.half_size)],
        ]
