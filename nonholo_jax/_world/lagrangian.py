"""Any Lagrangian system with nonholonomic constraints, in any velocities, that meets barriers."""

from collections.abc import Callable, Sequence
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.scipy as jsp
import numpy as np
from jaxtyping import Array, Float

from .._impact import accelerate, collide, matmul, settle
from .._math import (
    RESULTS,
    Number,
    as_number,
    bend_of,
    components,
    frozen,
    gradient_of,
    is_bounded,
    is_constant,
    reach_of,
    value_of,
)
from .checks import conditions, fit, refuse, refuse_shapes
from .system import AbstractSystem, bounces


class Given(eqx.Module):
    """A function of the user's. Its numbers follow the dtype of the state, and its values are cast to it."""

    function: Any

    def __init__(self, function: Callable):
        # A plain function is no pytree of arrays; `Partial` makes it one without leaves.
        self.function = function if isinstance(function, eqx.Module) else jax.tree_util.Partial(function)

    def __call__(self, q: Array, *args: Array) -> Any:
        return jnp.asarray(self.function(q, *args), dtype=q.dtype)


def _given(name: str, function: Any) -> Any:
    if function is None:
        return None
    if not callable(function):
        raise ValueError(f"Argument `{name}` must be a function, but got {function!r}; try `lambda q: ...`.")
    return Given(function)


class Barrier(eqx.Module):
    """A wall in the space of configurations, with the constraint that holds on it.

    **Arguments:**

    - `gap`: `gap(q)`, a smooth scalar, positive apart, zero at contact; its gradient must not vanish there.
    - `constraint`: `constraint(q) -> B`, shape (k, n), acting on v: ker B is the distribution of the wall. It must lie
        inside the wall (B stops the motion towards it) and inside that of the system, ker A.
    - `restitution`: mu in [0, 1]: 0 is plastic, 1 conserves the energy.
    - `offset`: `offset(q, t) -> c`, shape (k,), for a wall that moves along itself: B v = c. `None` is zero.
    - `curvature`: a bound of the norm of the second derivative of the gap, with which no crossing is ever passed.
        `None` takes bounds from the program of the gap, as for `Implicit`, and samples where that cannot be done.

    Raises `ValueError` for a restitution out of range and a negative curvature. Source: the paper, sections 2 and 6.

    ```python
    import jax.numpy as jnp
    from nonholo_jax import Barrier
    wall = Barrier(gap=lambda q: q[0] - 0.1, constraint=lambda q: jnp.array([[1.0, 0.0]]), curvature=0.0)
    ```
    """

    gap: Any
    constraint: Any
    restitution: Number
    offset: Any
    curvature: Number | None

    def __init__(self, gap: Any, constraint: Any, restitution: Any = 1.0, offset: Any = None, curvature: Any = None):
        self.gap, self.constraint, self.offset = (
            _given("gap", gap), _given("constraint", constraint), _given("offset", offset)
        )  # fmt: skip
        self.restitution, self.curvature = as_number(restitution), as_number(curvature)
        if is_constant(self.restitution) and not 0 <= self.restitution <= 1:
            raise ValueError(
                f"Argument `restitution` must lie in [0, 1], but got {restitution}; 1 conserves energy, 0 is plastic."
            )
        if is_constant(self.curvature) and not self.curvature >= 0:  # pyright: ignore
            raise ValueError(f"Argument `curvature` must not be negative, but got {curvature}; try None.")

    def moves(self, q: Array, t: Array, k: int) -> Array:
        """c, shape (k,)."""
        return jnp.zeros(k, q.dtype) if self.offset is None else self.offset(q, t)


class LagrangianSystem(AbstractSystem):
    """A mechanical system given by its Lagrangian, with constraints linear in the velocities, and barriers.

    Motion is that of Lagrange and d'Alembert; at a barrier v+ = v - (1 + mu) G^-1 B^T (B G^-1 B^T)^+ (B v - c), and
    barriers of equal restitution that are hit at one instant (to rounding of 1 + |q|) act as one, with their rows of B
    stacked. All derivatives are taken by JAX from what is given here.

    **Arguments:** functions of the configuration q, shape (n_q,), and the velocity v, shape (n,). They may be
    `equinox.Module`s, whose arrays are then traced and differentiated.

    - `lagrangian`: `lagrangian(q, v)`, quadratic in v; or instead of it
    - `metric`: `metric(q) -> G`, shape (n, n), with `potential(q)`, zero if `None`.
    - `constraint`: `constraint(q) -> A`, shape (m, n), and `offset(q, t) -> b`, shape (m,): A v = b, b zero if `None`.
    - `barriers`: `Barrier`s, in the order that `ImpactLog.surface` counts.
    - `frame`: `frame(q) -> F`, shape (n_q, n), with dq/dt = F v, for velocities that are not the rates of coordinates.
        It must span the whole tangent space of the configurations: constraints enter through A only.
    - `forces`: `forces(q, v, t)`, shape (n,), that have no potential; their power is forces . v.
    - `retraction`: `retraction(q)`, which puts q back on its manifold after a step: a quaternion at unit length.

    Functions are told apart by identity: a system built again from new lambdas is compiled again.

    Give the pair (q, v) to `simulate`, which gives pairs back. Raises `ValueError` for a Lagrangian and a metric, or
    neither; and `simulate` does, for shapes that do not fit, a velocity with A v != b (see `admissible`), a metric that
    is not positive definite, a frame that is not one, and a barrier whose ker B is not inside ker A. Where values are
    traced, such motions end as `RESULTS.invalid_state`. Source: the paper, sections 2, 4 and 6.

    ```python
    import jax.numpy as jnp
    from nonholo_jax import LagrangianSystem, simulate
    knife = LagrangianSystem(  # (x, y, heading) on an incline: no velocity across the blade
        metric=lambda q: jnp.diag(jnp.array([1.0, 1.0, 0.1])),
        potential=lambda q: -2.0 * q[0],
        constraint=lambda q: jnp.array([[jnp.sin(q[2]), -jnp.cos(q[2]), 0.0]]),
    )
    q, v = simulate(knife, ([0.0, 0.0, 0.0], [0.0, 0.0, 1.0]), t1=1.0).final
    ```
    """

    lagrangian: Any
    metric: Any
    potential: Any
    constraint: Any
    offset: Any
    barriers: tuple[Barrier, ...]
    frame: Any
    forces: Any
    retraction: Any
    is_long: ClassVar[bool] = True

    def __init__(
        self,
        lagrangian: Any = None,
        *,
        metric: Any = None,
        potential: Any = None,
        constraint: Any = None,
        offset: Any = None,
        barriers: Any = (),
        frame: Any = None,
        forces: Any = None,
        retraction: Any = None,
    ):
        if (lagrangian is None) == (metric is None) or (metric is None and potential is not None):
            got = [name for name, x in (("lagrangian", lagrangian), ("metric", metric), ("potential", potential)) if x]
            raise ValueError(
                "Arguments must be `lagrangian` alone or `metric` with `potential`, but got "
                f"{', '.join(f'`{name}`' for name in got) or 'none of them'}; try one or the other."
            )
        if offset is not None and constraint is None:
            raise ValueError("Argument `offset` must come with `constraint`, but got it alone; try constraint=...")
        if not all(isinstance(barrier, Barrier) for barrier in barriers):
            raise ValueError(f"Argument `barriers` must hold Barriers, but got {barriers!r}; try [Barrier(gap, B)].")
        self.lagrangian, self.metric = _given("lagrangian", lagrangian), _given("metric", metric)
        self.potential = _given("potential", potential)
        self.constraint, self.offset = _given("constraint", constraint), _given("offset", offset)
        self.frame, self.forces = _given("frame", frame), _given("forces", forces)
        self.retraction = _given("retraction", retraction)
        self.barriers = tuple(barriers)

    # Mechanics

    def _lagrangian(self, q: Array, v: Array) -> Array:
        if self.lagrangian is not None:
            return self.lagrangian(q, v)
        kinetic = 0.5 * matmul(v, matmul(self.metric(q), v))
        return kinetic if self.potential is None else kinetic - self.potential(q)

    def _momentum(self, q: Array, v: Array) -> Array:
        return jax.grad(self._lagrangian, 1)(q, v) if self.metric is None else matmul(self.metric(q), v)

    def metric_at(self, q: Array) -> Float[Array, "n n"]:
        """G at the configuration q, shape (n, n)."""
        if self.metric is not None:
            return self.metric(q)
        still = jnp.zeros(jax.eval_shape(self.frame, q).shape[1] if self.frame is not None else q.shape[0], q.dtype)
        return jax.jacfwd(self._momentum, 1)(q, still)

    def constraint_at(self, q: Array, t: Array, n: int) -> tuple[Array, Array]:
        """A, shape (m, n), and b, shape (m,)."""
        a = jnp.zeros((0, n), q.dtype) if self.constraint is None else self.constraint(q)
        return a, jnp.zeros(a.shape[0], q.dtype) if self.offset is None else self.offset(q, t)

    def rate(self, q: Array, v: Array) -> Array:
        """dq/dt, shape (n_q,)."""
        return v if self.frame is None else matmul(self.frame(q), v)

    def energy(self, q: Any, v: Any) -> Float[Array, ""]:
        """p . v - L, in J if everything is in SI units, of q, shape (n_q,), and v, shape (n,)."""
        q, v = as_arrays(q, v)
        return matmul(self._momentum(q, v), v) - self._lagrangian(q, v)

    def admissible(self, q: Any, v: Any, t: Any = 0.0) -> Float[Array, " n"]:
        """The velocity with A v = b that is nearest to v in the metric; shapes (n_q,) and (n,)."""
        q, v = as_arrays(q, v)
        return self._projected(q, v, jnp.asarray(t, dtype=q.dtype))

    def _projected(self, q: Array, v: Array, t: Array) -> Array:
        a, b = self.constraint_at(q, t, v.shape[0])
        return v if a.shape[0] == 0 else settle(v, self.metric_at(q), a, b)

    def bending(self, q: Array, v: Array, w: Array, p: Array) -> tuple[Array, Array]:
        """(F^T dL/dq, (F^+ K)^T p): what of dp/dt is not a force. K has the columns [w, F_i]."""
        slope = jax.grad(self._lagrangian, 0)(q, v)
        if self.frame is None:
            return slope, jnp.zeros_like(v)
        f, df = jax.jvp(self.frame, (q,), (w,))
        basis, triangle = jnp.linalg.qr(f)
        y = matmul(basis, jsp.linalg.solve_triangular(triangle, p, trans="T"))  # (F^+)^T p
        turning = jax.grad(lambda x: matmul(y, matmul(self.frame(x), v)))(q)
        return matmul(f.T, slope), matmul(df.T, y) - matmul(f.T, turning)

    def acceleration(self, t: Array, q: Array, v: Array) -> tuple[Array, Array]:
        """(dq/dt, dv/dt), with G dv/dt = F^T dL/dq + (F^+ K)^T p + Q + A^T lambda - (dp/dq) w and
        A dv/dt = db/dt - (dA/dt) v."""
        w = self.rate(q, v)
        p, change = jax.jvp(lambda x: self._momentum(x, v), (q,), (w,))
        slope, turning = self.bending(q, v, w, p)
        force = slope + turning - change
        if self.forces is not None:
            force = force + self.forces(q, v, t)

        def excess(q, t):
            a, b = self.constraint_at(q, t, v.shape[0])
            return b - matmul(a, v), a

        _, rate, a = jax.jvp(excess, (q, t), (w, jnp.ones_like(t)), has_aux=True)
        return w, accelerate(self.metric_at(q), a, force, rate)

    def touches(self, index: int, q: Array) -> Array:
        """Whether a barrier is in contact at q to rounding. What q was computed from may be larger than q itself, which
        vanishes at a corner in the origin: coordinates are taken to be of the order of one."""
        tolerance = 128.0 * float(jnp.finfo(q.dtype).eps) * (1.0 + jnp.sum(jnp.abs(q)))
        return jnp.abs(self.barriers[index].gap(q)) <= tolerance

    # What the event loop asks for

    @property
    def n_contacts(self) -> int:  # pyright: ignore[reportIncompatibleVariableOverride]
        return len(self.barriers)

    def evolving(self, state):
        return components(state[0]), components(state[1])

    def derivative(self, time, state, q, v):
        rates = self.acceleration(time, *_stacked(q, v, time))
        return components(rates[0]), components(rates[1])

    def is_uniform(self):
        return False

    def advanced(self, time, state, q, v, duration):
        q, v = _stacked(q, v, time)
        q = q if self.retraction is None else self.retraction(q)
        return q, self._projected(q, v, time)

    def meets(self, contact, time, state, left, rests, ends):
        q, v = state
        fits = [fit(self, i, time, q, v.shape[0]) for i in range(self.n_contacts)]
        fitting = contact.of([jnp.all(jnp.stack([holds for holds, _ in each.values()])) for each in fits])
        met = bounces(ends, self.bounced(contact, time, state))
        return met._replace(fault=RESULTS.where(fitting, met.fault, RESULTS.barrier_conflict))

    def after(self, contact, time, state, kind):
        return self.bounced(contact, time, state), 0.0

    def bounced(self, contact, time, state):
        """(6.1), with the rows of every barrier of the same restitution that is hit at this instant."""
        q, v = state
        restitution = contact.of([jnp.asarray(barrier.restitution, q.dtype) for barrier in self.barriers])
        w = frozen(self.rate(q, v))
        blocks, offsets = [], []
        for i, barrier in enumerate(self.barriers):
            rows = barrier.constraint(q)
            offset = barrier.moves(q, time, rows.shape[0])
            if self.n_contacts > 1:
                closing = matmul(jax.grad(barrier.gap)(q), w) < 0
                hit = contact.is_(i) | (self.touches(i, q) & closing & (barrier.restitution == restitution))
                rows, offset = jnp.where(hit, rows, 0.0), jnp.where(hit, offset, 0.0)
            blocks.append(rows)
            offsets.append(offset)
        b, c = jnp.concatenate(blocks), jnp.concatenate(offsets)
        return q, collide(v, self.metric_at(q), b, restitution, c)

    def during(self, contact, time, state, elapsed):
        return state

    def named(self, contact, state):
        return contact.index

    def prepared(self, time, state):
        return state

    def phase(self, state):
        return jnp.asarray(-1, dtype=jnp.int32)

    def level(self, contact, time, q, state):
        return value_of(self.barriers[contact].gap, q)

    def is_parabolic(self, contact):
        return False

    def returns(self, contact, time, q, v, half_a, state):
        return None

    def reach(self, contact, q):
        return reach_of(self.barriers[contact].curvature)

    def bend(self, contact, time, window, state):
        return bend_of(self.barriers[contact].gap, self.barriers[contact].curvature, window)

    def is_wide(self, contact):
        return self.barriers[contact].curvature is None

    def unbounded(self, state):
        n = state[0].shape[-1]
        return [f"barrier {i}" for i, each in enumerate(self.barriers) if not is_bounded(each.gap, each.curvature, n)]

    def extent(self, contact):
        return 0.0

    def is_admissible(self, time, state):
        q, v = state
        return jnp.all(jnp.stack([holds for holds, _ in conditions(self, time, q, v).values()]))

    def received(self, state, batch, t0):
        if not isinstance(state, tuple | list) or len(state) != 2:
            raise ValueError(f"Argument `state` must be a pair (q, v), but got {state!r}; try (q, v).")
        q, v = as_arrays(*state)
        if not batch:  # what is wrong in one lane must not lose a batch
            refuse_shapes(self, q, v)
            refuse(self, t0, q, v)
        elif q.ndim != 2 or v.ndim != 2 or q.shape[0] != v.shape[0]:
            raise ValueError(
                f"Argument `states` must have shapes (N, n_q) and (N, n), but got {q.shape} and {v.shape}; try "
                "simulate() for one state."
            )
        return q, v

    def unpacked(self, state, phase=None):
        q, v = state
        refuse_shapes(self, q, v)
        return q if self.retraction is None else self.retraction(q), v

    def packed(self, state):
        return tuple(state)

    def contact_frame(self, contact, time, state):
        gradients = jnp.stack([jnp.stack(gradient_of(each.gap, components(state[0]))) for each in self.barriers])
        return state[0], gradients[contact.index]

    def hopper(self, state):
        return None

    def without_contacts(self) -> "LagrangianSystem":
        return eqx.tree_at(lambda system: system.barriers, self, ())


def _stacked(q: Sequence[Number], v: Sequence[Number], like: Array) -> tuple[Array, Array]:
    return tuple(jnp.stack([jnp.asarray(c, dtype=like.dtype) for c in x]) for x in (q, v))  # pyright: ignore


def as_arrays(q: Any, v: Any) -> tuple[Array, Array]:
    """q and v as floating arrays of one dtype, that of q."""
    q, v = (x if isinstance(x, jax.Array | np.ndarray) else jnp.asarray(x, dtype=float) for x in (q, v))
    q = jnp.asarray(q) if jnp.issubdtype(q.dtype, jnp.floating) else jnp.asarray(q, dtype=float)
    return q, jnp.asarray(v, dtype=q.dtype)
