"""Questions asked of a motion: energy, momentum and slip, the law at each impact, and the paper's own definition."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._impact import matmul, projector, whiten
from .._math import KINDS, RESULTS, Choice
from .._motion import Trajectory, run
from .._world import BallState, LagrangianSystem, Scene, as_arrays


def _refuse_system(system: Any) -> None:
    if not isinstance(system, Scene | LagrangianSystem):
        raise ValueError(
            f"Argument `system` must be a Scene or a LagrangianSystem, but got {type(system).__name__}; try the one "
            "that made the motion."
        )


def _refuse_batch(trajectory: Trajectory) -> None:
    if trajectory.n_impacts.ndim != 0:
        raise ValueError(
            f"Argument `trajectory` must be one motion, but got a batch of shape {trajectory.n_impacts.shape}; try "
            "jax.tree.map(lambda x: x[i], trajectory), or simulate() for one state."
        )


def _array(x: Any, like: Array) -> Array:
    return jnp.stack([jnp.asarray(c, dtype=like.dtype) for c in x]) if isinstance(x, tuple) else x.astype(like.dtype)


def energy(system: Any, state: Any) -> Float[Array, "*batch"]:
    """Kinetic and potential energy, in J.

    **Arguments:**

    - `system`: a `Scene`, where it is m |v|^2 / 2 + J |spin|^2 / 2 - m gravity . position; or a `LagrangianSystem`,
        where it is p . v - L.
    - `state`: a `BallState`, or a pair (q, v). Leading axes of its fields, if any, are those of the answer.

    Raises `ValueError` for other systems. Source: the paper, Hypothesis 2: elastic impacts conserve it.

    ```python
    from nonholo_jax import Ball, BallState, Scene, energy
    energy(Scene(Ball(0.025, 0.046), {}), BallState([0, 0, 1], [2, 0, 0], [0, 10, 0]))
    ```
    """
    _refuse_system(system)
    if isinstance(system, Scene):
        ball, g = system.ball, _array(system.gravity, state.position)
        fall = jnp.sum(state.position * jnp.broadcast_to(g, state.position.shape), axis=-1)
        kinetic = 0.5 * ball.mass * jnp.sum(state.velocity**2, axis=-1)
        return kinetic + 0.5 * ball.inertia * jnp.sum(state.spin**2, axis=-1) - ball.mass * fall
    q, v = as_arrays(*state)
    function = system.energy
    for _ in range(q.ndim - 1):
        function = jax.vmap(function)
    return function(q, v)


def _contact_velocity(scene: Scene, state: BallState, n: Array, moving: Array) -> tuple[Array, Array]:
    """The normal and the tangential velocity of the contact point relative to the surface."""
    u = state.velocity - scene.ball.radius * jnp.cross(state.spin, n) - moving
    closing = matmul(u, n)
    return closing, u - closing * n


def slip(scene: Scene, state: BallState, surface: str) -> Float[Array, "3"]:
    """The tangential velocity of the ball's point nearest to a surface, relative to it, in m/s, shape (3,).

    **Arguments:** `scene`; one `state`, fields of shape (3,); the name of the `surface`. Zero for a ball that rolls.
    Raises `ValueError` for a name that the scene does not have. Source: the paper, (1.1).

    ```python
    from nonholo_jax import Ball, BallState, Plane, Rough, Scene, slip
    scene = Scene(Ball(0.1, 1.0), {"floor": Plane((0, 0, 0), (0, 0, 1), Rough())})
    slip(scene, BallState([0, 0, 0.1], [1, 0, 0], [0, 10, 0]), "floor")  # it rolls: zero
    ```
    """
    each, x = scene.surface(surface), state.position
    n = each.normal(x)
    return _contact_velocity(scene, state, n, each.velocity(x - scene.ball.radius * n))[1]


def momentum_about(point: Any, scene: Scene, state: BallState) -> Float[Array, "*batch 3"]:
    """The angular momentum of the ball about a fixed point, m (x - point) x v + J spin, in kg m^2/s, shape (3,).

    **Arguments:** `point` in m, shape (3,); `scene`; `state`, whose leading axes, if any, are those of the answer. An
    impact conserves it about the point of contact. Source: the paper, section 5.2, after Theorem 5.2.

    ```python
    from nonholo_jax import Ball, BallState, Scene, momentum_about
    momentum_about((0, 0, 0), Scene(Ball(0.1, 1.0), {}), BallState([0, 0, 1], [1, 0, 0], [0, 0, 0]))
    ```
    """
    x, ball = state.position, scene.ball
    point = jnp.broadcast_to(jnp.asarray(point, dtype=x.dtype), x.shape)
    return ball.mass * jnp.cross(x - point, state.velocity) + ball.inertia * state.spin


# The law


def _ball_row(scene: Scene, contact: Array, time: Array, n: Array, before: Any, after: Any) -> tuple[Array, Array]:
    ball = scene.ball
    x = before.position - ball.radius * n
    moving = jnp.stack([surface.velocity(x, time) for surface in scene.surfaces])[contact]
    closing, slipping = _contact_velocity(scene, before, n, moving)
    e_n = Choice(contact, len(scene.surfaces)).of(
        [jnp.asarray(surface.law.restitution, time.dtype) for surface in scene.surfaces]
    )
    sizes = (ball.inertia_ratio, jnp.abs(closing), jnp.sum(slipping**2))
    s = Choice(contact, len(scene.surfaces)).of(
        [jnp.asarray(each.law.slip_factor(*sizes), time.dtype) for each in scene.surfaces]
    )
    closing_after, slipping_after = _contact_velocity(scene, after, n, moving)
    # An impulse changes the velocity of the contact point by 1 + 1/alpha times what it changes that of the centre.
    miss = (closing_after + e_n * closing) * n + slipping_after - (1 - s * (1 + 1 / ball.inertia_ratio)) * slipping
    return jnp.sqrt(jnp.sum(miss**2)), jnp.sqrt(closing**2 + jnp.sum(slipping**2))


def _row(system: LagrangianSystem, index: int, time: Array, before: Any, after: Any) -> tuple[Array, Array]:
    barrier, (q, v) = system.barriers[index], before
    rows = barrier.constraint(q)
    _, _, _, scaling = whiten(system.metric_at(q), rows, thorough=False)  # so that the rows have one unit
    c = barrier.moves(q, time, rows.shape[0])
    old, new = (matmul(scaling, matmul(rows, x) - c) for x in (v, after[1]))
    return jnp.sqrt(jnp.sum((new + barrier.restitution * old) ** 2)), jnp.sqrt(jnp.sum(old**2))


def law_residual(system: Any, trajectory: Trajectory) -> Float[Array, ""]:
    """By how much the impacts of a motion miss the law: the largest |B v+ - c + mu (B v- - c)| / |B v- - c|.

    **Arguments:**

    - `system`: the law that is asked about. Of a `Scene`, the velocities of the contact point, normal and tangential,
        are compared with the law of the surface; of a `LagrangianSystem`, B v in units that make its rows comparable.
    - `trajectory`: one motion. Its log is read, rows of the kind `bounce`.

    Returns a number, of the size of rounding for a motion of that system; 0 without impacts. Raises `ValueError` for a
    batch. Source: the paper, (4.2) and (6.1); with `weak_residual`, which cannot see mu, it fixes v+.

    ```python
    from nonholo_jax import Ball, BallState, Plane, Rough, Scene, law_residual, simulate
    scene = Scene(Ball(0.025, 0.046), {"floor": Plane((0, 0, 0), (0, 0, 1), Rough(0.8))})
    law_residual(scene, simulate(scene, BallState([0, 0, 1], [1, 0, 0], [0, 0, 9]), t1=1.0))
    ```
    """
    _refuse_system(system)
    _refuse_batch(trajectory)
    if system.n_contacts == 0 or trajectory.impacts.time.shape[0] == 0:
        return jnp.zeros((), trajectory.t1.dtype)
    return _law_residual(system, trajectory.impacts)


@eqx.filter_jit
def _law_residual(system: Any, log: Any) -> Array:
    def one(contact, time, normal, before, after):
        if isinstance(system, Scene):
            return _ball_row(system, contact, time, normal, before, after)
        pairs = [_row(system, i, time, before, after) for i in range(system.n_contacts)]
        miss, size = zip(*pairs, strict=True)
        return jnp.stack(miss)[contact], jnp.stack(size)[contact]

    miss, size = jax.vmap(one)(log.surface, log.time, log.normal, log.before, log.after)
    counts = (log.surface >= 0) & (log.kind == KINDS.bounce) & (size > 0)
    return jnp.max(jnp.where(counts, miss / jnp.where(size > 0, size, 1.0), 0.0))


# The paper's definition

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(12)


def weak_residual(
    system: Any, trajectory: Trajectory, *, n_functions: int = 8, key: Any = None, panels: int = 8
) -> Float[Array, ""]:
    """By how much a motion misses the paper's definition of a weak solution, Definition 1.

    The integral (2.4), in the velocities of the system that of (F^T dL/dq + Q) . eta + p . (d eta/dt + F^+ K eta), is
    computed along the motion for random smooth eta with eta in ker A, eta in ker B at each impact, and eta = 0 at both
    ends: for a right motion it is zero. It does not see the restitution, since (2.9) only asks that the jump of the
    momentum vanish on ker B: see `law_residual` for that.

    **Arguments:**

    - `system`: a `LagrangianSystem`, whose Lagrangian, constraints and barriers are asked about.
    - `trajectory`: one motion, of this system or of another with the same coordinates, with all its impacts logged.
    - `n_functions`: how many eta; `key`: of `jax.random`, by default `jax.random.key(0)`.
    - `panels`: intervals of an arc, each integrated by Gauss's rule with 12 points.

    Returns the largest |integral| divided by the integral of the absolute values of its terms: a number from 0 to 1,
    limited by the accuracy of the motion. Raises `ValueError` for a Scene, a batch, or a log that is too short.
    Source: the paper, (2.4), (2.5), (2.9).

    ```python
    import jax.numpy as jnp
    from nonholo_jax import Barrier, Integrated, LagrangianSystem, simulate, weak_residual
    wall = Barrier(lambda q: q[0] + 0.3 * q[1], lambda q: jnp.array([[1.0, 0.3]]), curvature=0.0)
    system = LagrangianSystem(metric=lambda q: jnp.eye(2), barriers=[wall])
    motion = Integrated(rtol=1e-6, atol=1e-6)
    weak_residual(system, simulate(system, ([1.0, 0.0], [-2.0, 1.0]), t1=1.0, motion=motion))
    ```
    """
    if not isinstance(system, LagrangianSystem) or not isinstance(trajectory.system, LagrangianSystem):
        raise ValueError("Arguments must be a LagrangianSystem and a motion of one, but got others; try building one.")
    _refuse_batch(trajectory)
    n_impacts, log = int(trajectory.n_impacts), trajectory.impacts
    if n_impacts > log.time.shape[0]:
        raise ValueError(
            f"Argument `trajectory` must have all {n_impacts} impacts in its log, but got {log.time.shape[0]} rows; "
            "try log_size=None."
        )
    q, v = trajectory.initial
    keys = jax.random.split(jax.random.key(0) if key is None else key, 2 * n_impacts + 2)
    noise = lambda k, *shape: jax.random.normal(keys[k], (*shape, n_functions, v.shape[0]), v.dtype)  # noqa: E731
    begin, start, pulse = trajectory.t0, (q, v), jnp.zeros_like(noise(0))
    answers = []
    for k in range(n_impacts + 1):
        last = k == n_impacts
        end = trajectory.t1 if last else log.time[k]
        if end > begin:
            to = jnp.zeros_like(pulse)
            if not last and log.time[k] < trajectory.t1:
                to = _pulse(system, end, log.before[0][k], log.surface[k], noise(2 * k))
            own = noise(2 * k + 1, 3)
            answers.append(_arc_integrals(system, trajectory.system, trajectory.motion, begin, end, start, pulse, to,
                                          own, panels))  # fmt: skip
            pulse = to
        if not last:
            begin, start = log.until[k], (log.after[0][k], log.after[1][k])
    integrals, sizes = (sum(each) for each in zip(*answers, strict=True))
    return jnp.max(jnp.abs(integrals) / sizes)


@eqx.filter_jit
def _pulse(system: LagrangianSystem, t: Array, q: Array, contact: Array, noise: Array) -> Array:
    """Random velocities of about the same energy in the ker B of every barrier that is touched, shape of the noise."""
    metric = system.metric_at(q)
    blocks = []
    for i, barrier in enumerate(system.barriers):
        blocks.append(jnp.where((contact == i) | system.touches(i, q), barrier.constraint(q), 0.0))
    e = noise / jnp.sqrt(jnp.diagonal(metric))[None, :]
    return e - matmul(e, projector(metric, jnp.concatenate(blocks)).T)


@eqx.filter_jit
def _arc_integrals(
    system: LagrangianSystem, moving: Any, motion: Any, begin: Array, end: Array, start: Any, pulse: Array, to: Array,
    noise: Array, panels: int,
) -> tuple[Array, Array]:  # fmt: skip
    """The integral over one arc for every test function, and that of the absolute values of its terms."""
    free, dtype = moving.without_contacts(), begin.dtype
    local = (np.arange(panels)[:, None] + 0.5 * (1 + _NODES)[None, :]).reshape(-1) / panels
    weights = jnp.asarray(np.tile(0.5 * _WEIGHTS / panels, panels), dtype) * (end - begin)
    times = begin + jnp.asarray(local, dtype) * (end - begin)

    def onward(carry, t):
        outcome = run(free, motion, carry[1], carry[0], t, max_impacts=0, log_rows=0)
        arrived = outcome.result == RESULTS.reached_t1  # else NaN, which shows in the answer
        state = jax.tree.map(lambda x: jnp.where(arrived, x, jnp.nan), outcome.state)
        return (t, state), free.packed(state)

    _, (q, v) = jax.lax.scan(onward, (begin, free.unpacked(start)), times)
    noise = noise / jnp.sqrt(jnp.diagonal(system.metric_at(start[0])))[None, None, :]
    shape = lambda t: (t - begin) / (end - begin)  # noqa: E731

    def eta(q, t):
        s = shape(t)
        wave = noise[0] + jnp.cos(3.0 * s) * noise[1] + jnp.sin(4.0 * s) * noise[2]
        y = (1 - s) * pulse + s * to + s * (1 - s) * wave
        a, _ = system.constraint_at(q, t, y.shape[-1])
        return y if a.shape[0] == 0 else y - matmul(y, projector(system.metric_at(q), a).T)

    def terms(t, q, v):
        w = system.rate(q, v)
        p = jax.grad(system._lagrangian, 1)(q, v)
        slope, turning = system.bending(q, v, w, p)
        if system.forces is not None:
            slope = slope + system.forces(q, v, t)
        value, change = jax.jvp(eta, (q, t), (w, jnp.ones_like(t)))
        return jnp.stack([matmul(value, slope), matmul(value, turning), matmul(change, p)])

    each = jax.vmap(terms)(times, q, v)
    sums = [jnp.sum(weights[:, None] * x, axis=0) for x in (jnp.sum(each, axis=1), jnp.sum(jnp.abs(each), axis=1))]
    return sums[0], sums[1]
