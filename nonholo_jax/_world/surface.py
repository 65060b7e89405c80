"""Surfaces: where they are, which way they face, and bounds that let a crossing be found without passing it."""

from abc import abstractmethod
from collections.abc import Sequence
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp

from .._impact import AbstractContactLaw
from .._math import (
    Interval,
    Number,
    Scalar,
    Vector,
    Vector3,
    Window,
    as_number,
    as_vector,
    bend_of,
    components,
    dot,
    gradient_of,
    is_bounded,
    is_constant,
    norm,
    pack,
    plus,
    reach_of,
    times,
    unit,
    value_of,
)


class Face(NamedTuple):
    """A flat piece of a surface, on which a ball can roll."""

    normal: Vector3
    center: Vector3
    tangents: tuple[Vector3, Vector3]
    half: tuple[Number, Number] | None  # half sizes along the tangents; `None` for a face without edges
    below: Any  # whether the ball's centre is over it, not over an edge


class Along(NamedTuple):
    """The flat face of a surface that faces most like a direction, as a ball at one place sees it."""

    normal: Vector3
    height: Number  # of the ball's centre above its plane
    holds: Any  # whether the ball is above it, or comes above it at once
    ahead: Number  # how fast the ball comes towards its middle, -inf of a face without edges


class Return(NamedTuple):
    """A parabola that begins on a flat face and comes back to it. Until then it is on the outer side of the face's
    plane, so that it cannot meet the surface before."""

    duration: Number
    comes: Any  # whether it comes back, to the same face
    rise: Number  # its speed away from the face
    pull: Number  # half its acceleration towards the face


class AbstractSurface(eqx.Module):
    """A surface that the ball bounces on. Subclasses say, by components and for a point x, the signed `distance`, the
    `direction` from the surface to the point, and a bound of the second derivative of the `level` along a path."""

    law: eqx.AbstractVar[AbstractContactLaw]
    has_edges: ClassVar[bool] = False  # whether its flat faces, if there are any, end somewhere
    is_parabolic: ClassVar[bool] = False  # whether the level along every parabola is one itself
    few: ClassVar[int] = 4  # up to how many in a row a program holds one by one

    def __check_init__(self):
        if not isinstance(self.law, AbstractContactLaw):
            raise ValueError(f"Argument `law` must be a contact law, but got {self.law!r}; try Rough(restitution=0.9).")

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

    def face(self, x: Vector3, t: Number) -> Face | None:
        """The flat piece that a ball at `x` would roll on; `None` for a surface that has none."""
        del x, t
        return None

    def returns(self, x: Vector3, v: Vector3, half_a: Vector3, t: Number) -> Return | None:
        """When a parabola that begins on a flat face comes back to it, from the velocity v and half the acceleration
        alone; `None` for a surface on which the level itself says so."""
        del x, v, half_a, t
        return None

    def clearance(self, x: Vector3, t: Number, radius: Number) -> Number:
        """How far at least the centre of a ball at `x` can go in any direction before it touches, in m."""
        return plus(self.distance(x, t), times(-1.0, radius))

    def along(self, n: Vector3, x: Vector3, v: Vector3, slack: Number) -> Along | None:
        """The face that faces most like n, for a ball at x with the velocity v, where places are known to `slack`;
        `None` for a surface without faces."""
        del n, x, v, slack
        return None

    def rim(self, n: Vector3) -> tuple[Vector3, Sequence[tuple[Vector3, Number]]] | None:
        """The middle of the face that faces most like n, and both pairs of its edges: across, and half the distance.
        `None` for a face without edges."""
        del n
        return None

    def engine(self) -> "AbstractSurface":
        """The same surface as the event loop sees it, with what is worth computing only once."""
        return self

    def seams(self) -> Sequence[tuple[Sequence[Vector3], Vector3, Number]]:
        """Where the curvature of the surface jumps: on pairs of planes (one axis across them, a point in the middle
        between the two, and half the distance) and on cylinders (two axes, a point on that of the cylinder, radius)."""
        return ()

    def direction_within(self, x: Vector3, t: Number, beyond: Sequence[Any]) -> Vector3:
        """The unit normal of the part of the surface that is, or is not, beyond each of the `seams`, also where the
        point is not on that part any more."""
        del beyond
        return self.direction(x, t)

    def directions(self) -> Sequence[Vector3]:
        """Directions along which this surface may be apart from others, with the normals of its faces among them."""
        return ()

    def most(self, n: Vector3) -> Number | None:
        """The most of n . x over all that is on or behind the surface, in m; `None` where it is infinite or unknown."""
        del n
        return None

    def is_bounded(self) -> bool:
        """Whether `bend` is a true bound, not an estimate from samples."""
        return getattr(self, "curvature", 0.0) is not None

    def is_wide(self) -> bool:
        """Whether `bend` may be too wide to take a step by, or even `BLIND`."""
        return False

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


def nonzero(name: str, vector: Any) -> tuple:
    length = norm(components(vector))
    return (length > 0, f"`{name}` must not be the zero vector, but got {vector}")


def check(surface: AbstractSurface, radius: Number = 0.0) -> None:
    """Raise for what is known now to be wrong; traced values end as `RESULTS.invalid_state`."""
    for holds, sentence in surface.is_proper(radius):
        if isinstance(holds, bool) and not holds:
            raise ValueError(f"Argument {sentence}.")


def positive(name: str, value: Number) -> tuple:
    return (value > 0, f"`{name}` must be positive, but got {value}; use SI units")


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
    is_parabolic: ClassVar[bool] = True
    few: ClassVar[int] = 32  # between planes a batch hops, which pays for a longer program

    def __init__(self, point: Any, normal: Any, law: AbstractContactLaw):
        self.point, self.facing, self.law = as_vector(point), as_vector(normal), law
        check(self)

    def distance(self, x, t):
        n = self.direction(x, t)
        # Two dot products, not dot(n, x - point): a floor at height 0 then costs nothing.
        return plus(dot(n, x), times(-1.0, dot(n, components(self.point))))

    def direction(self, x, t):
        return unit(components(self.facing))

    def face(self, x, t):
        still = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
        return Face(self.direction(x, t), components(self.point), still, None, True)

    def level(self, x, t, radius):
        return plus(self.distance(x, t), times(-1.0, radius))

    def reach(self, x, radius):
        return None

    def bend(self, window, t, radius):
        return window.along(unit(components(self.facing)), (0.0, 0.0, 0.0)).bend

    def along(self, n, x, v, slack):
        return Along(self.direction(x, 0.0), self.distance(x, 0.0), True, -jnp.inf)

    def directions(self):
        return (unit(components(self.facing)),)

    def most(self, n):
        facing = unit(components(self.facing))
        known = all(is_constant(c) for c in (*n, *facing))
        return dot(n, components(self.point)) if known and tuple(n) == tuple(facing) else None

    def extent(self):
        return norm(components(self.point))

    def is_proper(self, radius):
        return [nonzero("normal", self.facing)]


def _depends_on_time(gap: Any) -> bool:
    """Whether a gap at two times is two gaps to JAX. Says nothing of a gap that fails: whoever calls it will hear."""
    x, t = (jax.ShapeDtypeStruct(shape, jnp.result_type(float)) for shape in ((3,), (2,)))
    try:
        jax.eval_shape(jax.vmap(gap, in_axes=(None, 0)), x, t)
    except Exception:
        return False
    try:
        jax.eval_shape(jax.vmap(gap, in_axes=(None, 0), out_axes=None), x, t)
    except ValueError:
        return True
    return False


def _at_start(gap: Any, x: Any) -> Any:
    return gap(x, 0.0)


class Implicit(AbstractSurface):
    """Any surface, given as the zeros of a smooth function of the ball's centre.

    **Arguments:**

    - `function`: `gap(x, t)` of the ball's centre x (shape (3,), in m) at time t, in m: positive apart, zero at
        contact; it need not be a distance, but its gradient must not vanish at contact. It may be an
        `equinox.Module` whose fields are traced. Raises `ValueError` if it depends on t: surfaces do not move yet.
    - `law` of contact.
    - `curvature`: a bound in 1/m of the norm of the second derivative of the function; no crossing is then passed.
        Nor without it, if the function is made of arithmetic, powers, norms, sums, products of matrices, elementary
        functions, minima and maxima: bounds then come from its own program, and are often tighter. (Points near which
        even its rate is not bounded, such as jumps and poles, are passed in windows of eps^(3/4) of the arc.) Other
        functions (with loops, sorting, or tables looked up at x) are sampled five times a step, which can pass a bump
        narrower than that: `UnboundedGapWarning` says so, `Trajectory.is_bounded` too, and `Exact` refuses them.

    ```python
    import jax.numpy as jnp
    from nonholo_jax import Implicit, Rough
    hills = Implicit(lambda x, t: x[2] - 0.1 * jnp.sin(x[0]) - 0.05, Rough())
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
        if _depends_on_time(gap):
            what = "must not depend on the time t, but does: surfaces do not move yet"
            raise ValueError(f"Argument `gap` {what}; try a scene for each of its positions.")
        check(self)

    def distance(self, x, t):
        return value_of(lambda p: self.function(p, t), x)

    def gap(self, x: Vector, t: float | Scalar = 0.0, radius: float | Scalar = 0.0) -> Scalar:
        """The given function at the ball's centre `x`; the radius is already in it."""
        return self.function(x, t)

    def direction(self, x, t):
        return unit(gradient_of(lambda p: self.function(p, t), x))

    def returns(self, x: Vector3, v: Vector3, half_a: Vector3, t: Number) -> Return | None:
        """When a parabola that begins on a flat face comes back to it, from the velocity v and half the acceleration
        alone; `None` for a surface on which the level itself says so."""
        del x, v, half_a, t
        return None

    def clearance(self, x, t, radius):
        return 0.0  # a gap with any slope tells no distance

    def level(self, x, t, radius):
        return value_of(lambda p: self.function(p, t), x)

    def reach(self, x, radius):
        return reach_of(self.curvature)

    def bend(self, window, t, radius):
        return bend_of(lambda p: self.function(p, t), self.curvature, window)

    def is_bounded(self):
        gap = jax.tree_util.Partial(_at_start, self.function)
        return is_bounded(gap, self.curvature, 3)

    def is_wide(self):
        return self.curvature is None

    def extent(self):
        return 0.0

    def is_proper(self, radius):
        if self.curvature is None:
            return []
        return [(self.curvature >= 0, f"`curvature` must not be negative, but got {self.curvature}")]
