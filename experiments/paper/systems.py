"""The registry of Lagrangian systems. A new system gets one builder and one line; every shared test then runs on it.

Balls have a unit quaternion (w, x, y, z) for their orientation and their spin in the fixed frame as velocity.

A builder makes no functions of its own: what it builds twice is then one compiled program, and so is what it builds
with restitutions that are JAX arrays."""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from nonholo_jax import Barrier, LagrangianSystem

M, R, ALPHA, G = 0.7, 0.1, 0.4, 9.81
J = ALPHA * M * R**2
TABLE, PIPE = 3.0, 0.5  # rate of the turntable, radius of the circle of centres in the cylinder


def space_spin(q):
    """Columns: dq/dt for the three components of the spin in the fixed frame, dq/dt = (0, omega) q / 2."""
    w, x, y, z = q
    return 0.5 * jnp.array([[-x, -y, -z], [w, z, -y], [-z, w, x], [y, -x, w]])


def body_spin(q):
    """The same for components in the body, dq/dt = q (0, omega) / 2."""
    w, x, y, z = q
    return 0.5 * jnp.array([[-x, -y, -z], [w, -z, y], [z, w, -x], [-y, x, w]])


@functools.cache
def ball_frame(n):
    """n coordinates whose rates are velocities, then a quaternion and a spin."""

    def frame(q):
        top = jnp.concatenate([jnp.eye(n, dtype=q.dtype), jnp.zeros((n, 3), q.dtype)], axis=1)
        return jnp.concatenate([top, jnp.concatenate([jnp.zeros((4, n), q.dtype), space_spin(q[n:])], axis=1)])

    return frame


@functools.cache
def unit_after(n):
    return lambda q: jnp.concatenate([q[:n], q[n:] / jnp.sqrt(jnp.sum(q[n:] ** 2))])


def _traced(x):
    """A Python number as an array: another value is then no other program."""
    return np.asarray(x, float) if isinstance(x, float | int) else x


class Constant(eqx.Module):
    """The same matrix everywhere."""

    matrix: Any

    def __call__(self, q):
        return jnp.asarray(self.matrix, dtype=q.dtype)


def diagonal(*entries):
    return Constant(np.diag(np.array(entries, float)))


def constant(rows):
    return Constant(np.array(rows, float))


class Level(eqx.Module):
    """The gap sign (q[index] - at)."""

    index: int
    at: Any
    sign: float = 1.0

    def __call__(self, q):
        return self.sign * (q[self.index] - self.at)


class Slope(eqx.Module):
    """The potential pull * q[index]."""

    pull: Any = eqx.field(converter=_traced)
    index: int

    def __call__(self, q):
        return jnp.asarray(self.pull, dtype=q.dtype) * q[self.index]


def rigid_body(inertia=(1.0, 2.0, 3.5)):
    """Free rigid body. q: quaternion; v: spin in the body. No A, no B."""
    return LagrangianSystem(metric=diagonal(*inertia), frame=body_spin, retraction=unit_after(0))


class Turned(eqx.Module):
    """R diag(inertia) R^T at the orientation R."""

    inertia: Any

    def __call__(self, q):
        turn = 4.0 * space_spin(q).T @ body_spin(q)  # its columns are the axes of the body
        return turn @ jnp.diag(jnp.asarray(self.inertia, dtype=q.dtype)) @ turn.T


def rigid_body_in_space(inertia=(1.0, 2.0, 3.5)):
    """The same. q: quaternion; v: spin in the fixed frame, G = R diag(inertia) R^T."""
    return LagrangianSystem(metric=Turned(np.array(inertia)), frame=space_spin, retraction=unit_after(0))


def thrown_ball(restitution: Any = 1.0, sign=1.0):
    """Section 5.2. q: (x, y, z, quaternion); v: (velocity, spin). A = 0; B of Theorem 5.2: the floor z = r holds the
    contact point."""
    rows = [[1.0, 0, 0, 0, -sign * R, 0], [0, 1.0, 0, sign * R, 0, 0], [0, 0, 1.0, 0, 0, 0]]
    floor = Barrier(Level(2, R), constant(rows), restitution, curvature=0.0)
    return LagrangianSystem(
        metric=diagonal(M, M, M, J, J, J), potential=Slope(M * G, 2), barriers=[floor], frame=ball_frame(3),
        retraction=unit_after(3),
    )  # fmt: skip


def floor_of_normals(restitution: Any = 1.0):
    """The thrown ball at a floor that holds only the normal velocity: specular reflection, and as a question put to a
    motion of `thrown_ball`, test functions outside of its ker B."""
    floor = Barrier(Level(2, R), constant([[0, 0, 1.0, 0, 0, 0]]), restitution, curvature=0.0)
    return eqx.tree_at(lambda system: system.barriers, thrown_ball(), (floor,))


ROLLING = [[1.0, 0, 0, -R, 0], [0, 1.0, R, 0, 0]]
MEETING = [[1.0, 0, 0, 0, 0], [0, 1.0, 0, 0, -R], [0, 0, 0, 1.0, 0], [0, 1.0, R, 0, 0]]


def rolling_ball(restitution: Any = 1.0):
    """Section 5.1. q: (x, y, quaternion); v: (v1, v2, spin). A and B of the paper: rolling on the floor, and no
    velocity at the floor nor at the wall x = r."""
    wall = Barrier(Level(0, R), constant(MEETING), restitution, curvature=0.0)
    return LagrangianSystem(
        metric=diagonal(M, M, J, J, J), constraint=constant(ROLLING), barriers=[wall], frame=ball_frame(2),
        retraction=unit_after(2),
    )  # fmt: skip


def _table(q, t):
    return TABLE * jnp.stack([-q[1], q[0]])


def _table_and_wall(q, t):
    return jnp.append(_table(q, t), 0.0)


def turntable(restitution: Any = 1.0):
    """A ball rolls on a table that turns at the rate TABLE. q, v, A as `rolling_ball`, A v = b the velocity of the
    table; B of a smooth wall x = 0.4: the rows of A, and the normal velocity; c = (b, 0)."""
    wall = Barrier(
        Level(0, 0.4, -1.0), constant([*ROLLING, [1.0, 0, 0, 0, 0]]), restitution, offset=_table_and_wall, curvature=0.0
    )
    return LagrangianSystem(
        metric=diagonal(M, M, J, J, J), constraint=constant(ROLLING), offset=_table, barriers=[wall],
        frame=ball_frame(2), retraction=unit_after(2),
    )  # fmt: skip


def _in_pipe(q):
    return jnp.array([[PIPE, 0, 0, 0, R], [0, 1.0, R * jnp.sin(q[0]), -R * jnp.cos(q[0]), 0]])


def _below_pipe(q):
    return jnp.concatenate([_in_pipe(q), jnp.array([[0, 1.0, 0, 0, 0]], dtype=q.dtype)])


def cylinder(restitution: Any = 1.0):
    """A ball rolls inside a vertical cylinder. q: (phi, z, quaternion), of the centre on a circle of radius PIPE; v:
    (dphi/dt, dz/dt, spin). A: no velocity at the wall; B of a smooth floor z = -1: the rows of A, and dz/dt."""
    floor = Barrier(Level(1, -1.0), _below_pipe, restitution, curvature=0.0)
    return LagrangianSystem(
        metric=diagonal(M * PIPE**2, M, J, J, J), potential=Slope(M * G, 1), constraint=_in_pipe, barriers=[floor],
        frame=ball_frame(2), retraction=unit_after(2),
    )  # fmt: skip


def _blade(q):
    return jnp.array([[-jnp.sin(q[2]), jnp.cos(q[2]), 0]])


def _blade_at_wall(q):
    return jnp.concatenate([_blade(q), jnp.array([[1.0, 0, 0]], dtype=q.dtype)])


class Sleigh(eqx.Module):
    """The Lagrangian of a sleigh whose centre of mass is `ahead` of its blade."""

    mass: Any
    inertia: Any
    ahead: Any

    def __call__(self, q, v):
        centre = v[:2] + self.ahead * v[2] * jnp.stack([-jnp.sin(q[2]), jnp.cos(q[2])])
        return 0.5 * self.mass * jnp.sum(centre**2) + 0.5 * self.inertia * v[2] ** 2


def sleigh(restitution: Any = 1.0, mass=1.3, inertia=0.4, ahead=0.3):
    """Chaplygin's. q: (x, y, heading) of the blade, its rates as v; the centre of mass is `ahead` of the blade. A: no
    velocity across the blade; B of the wall x = 0.1: that, and dx/dt of the blade's point."""
    wall = Barrier(Level(0, 0.1, -1.0), _blade_at_wall, restitution, curvature=0.0)
    return LagrangianSystem(Sleigh(mass, inertia, ahead), constraint=_blade, barriers=[wall])


def knife(restitution: Any = 1.0, pull=2.0):
    """A knife edge on an incline. q: (x, y, heading), x down the slope, its rates as v. A: no velocity across the
    blade; B of the wall x = 0.1: that, and dx/dt."""
    wall = Barrier(Level(0, 0.1, -1.0), _blade_at_wall, restitution, curvature=0.0)
    return LagrangianSystem(
        metric=diagonal(1.0, 1.0, 0.3), potential=Slope(-pull, 0), constraint=_blade, barriers=[wall],
    )  # fmt: skip


def _rolls(q):
    return jnp.array([[1.0, 0, -R * jnp.cos(q[3]), 0], [0, 1.0, -R * jnp.sin(q[3]), 0]])


def _rolls_at_wall(q):
    return jnp.concatenate([_rolls(q), jnp.array([[1.0, 0, 0, 0]], dtype=q.dtype)])


def disk(restitution: Any = 1.0):
    """A vertical disk rolls. q: (x, y, roll, heading), its rates as v. A: no velocity at the floor; B of the wall
    x = 0.3 for its centre: that, and dx/dt."""
    wall = Barrier(Level(0, 0.3, -1.0), _rolls_at_wall, restitution, curvature=0.0)
    return LagrangianSystem(metric=diagonal(M, M, 0.5 * M * R**2, 0.3 * M * R**2), constraint=_rolls, barriers=[wall])


def _touching(q):
    n = (q[7:10] - q[:3]) / jnp.sqrt(jnp.sum((q[7:10] - q[:3]) ** 2))
    x, y, z = n
    eye = jnp.eye(3, dtype=q.dtype)
    turn = R * jnp.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])  # r n x w = -r w x n
    return jnp.concatenate([-eye, turn, eye, turn], axis=1)


def _frame_of_two(q):
    one, two = ball_frame(3)(q[:7]), ball_frame(3)(q[7:])
    zero = jnp.zeros((7, 6), q.dtype)
    return jnp.block([[one, zero], [zero, two]])


def _unit_two(q):
    return jnp.concatenate([unit_after(3)(q[:7]), unit_after(3)(q[7:])])


class Between(eqx.Module):
    """The gap between two balls: the distance of their centres less that at which they touch."""

    at: Any

    def __call__(self, q):
        return jnp.sqrt(jnp.sum((q[7:10] - q[:3]) ** 2)) - self.at


class MassOfTwo(eqx.Module):
    """The metric of two balls, the second `other` times as heavy."""

    other: Any = eqx.field(converter=_traced)

    def __call__(self, q):
        one = jnp.array((M, M, M, J, J, J), dtype=q.dtype)
        return jnp.diag(jnp.concatenate([one, jnp.asarray(self.other, dtype=q.dtype) * one]))


def two_balls(restitution: Any = 1.0, other: Any = 1.0):
    """Two rough balls in space, the second `other` times as heavy. q: (x1, quaternion 1, x2, quaternion 2); v: (v1,
    spin 1, v2, spin 2). A = 0; B: the relative velocity of the touching points, v2 - v1 - r (w1 + w2) x n."""
    touch = Barrier(Between(2 * R), _touching, restitution)
    return LagrangianSystem(metric=MassOfTwo(other), barriers=[touch], frame=_frame_of_two, retraction=_unit_two)


# Closed forms: what is observed of (q, v), and what it should be at time t.


def _euler(t, spin, inertia=(1.0, 2.0, 3.5)):
    """Euler's equations by another integrator, in the body."""
    from scipy.integrate import solve_ivp

    i = np.asarray(inertia)
    field = lambda t, w: np.cross(i * w, w) / i  # noqa: E731
    return solve_ivp(field, (0.0, t), spin, method="DOP853", rtol=1e-13, atol=1e-13).y[:, -1]


def _turned(angle, vector):
    c, s = np.cos(angle), np.sin(angle)
    return np.array([c * vector[0] - s * vector[1], s * vector[0] + c * vector[1]])


def _turntable(t, q, v):
    """The velocity of the centre turns at the rate k = alpha/(1 + alpha) TABLE."""
    k = ALPHA / (1 + ALPHA) * TABLE
    centre = q[:2] + np.array([-v[1], v[0]]) / k
    return np.concatenate([centre + _turned(k * t, q[:2] - centre), _turned(k * t, v[:2])])


def _cylinder(t, q, v):
    """phi turns evenly; z swings at the rate sqrt(alpha/(1 + alpha)) dphi/dt."""
    rate, radial = v[0], v[2] * np.cos(q[0]) + v[3] * np.sin(q[0])
    swing = np.sqrt(ALPHA / (1 + ALPHA)) * rate
    middle = q[1] - G / (ALPHA * rate**2) - R * radial / rate
    z = middle + (q[1] - middle) * np.cos(swing * t) + v[1] / swing * np.sin(swing * t)
    return np.array([q[0] + rate * t, z])


def _sleigh(t, q, v, mass=1.3, inertia=0.4, ahead=0.3):
    """From u = 0: u = U tanh(k t), spin = W / cosh(k t), with m U^2 = (I + m a^2) W^2 and k = m a U / (I + m a^2)."""
    whole = inertia + mass * ahead**2
    fastest = np.sqrt(whole / mass) * v[2]
    k = mass * ahead * fastest / whole
    return np.array([fastest * np.tanh(k * t), v[2] / np.cosh(k * t)])


def _knife(t, q, v, pull=2.0):
    """A cycloid."""
    w = v[2]
    down, across = np.sin(w * t) ** 2 / (2 * w**2), (t - np.sin(2 * w * t) / (2 * w)) / (2 * w)
    return np.array([pull * down, pull * across, w * t])


def _disk(t, q, v):
    """A circle of radius R w_roll / w_heading."""
    radius, heading = R * v[2] / v[3], q[3] + v[3] * t
    return np.array(
        [q[0] + radius * (np.sin(heading) - np.sin(q[3])), q[1] - radius * (np.cos(heading) - np.cos(q[3]))]
    )


def _along(q, v):
    return jnp.stack([v[0] * jnp.cos(q[2]) + v[1] * jnp.sin(q[2]), v[2]])


@eqx.filter_jit
def _constraint(system, q, n):
    return system.constraint_at(q, jnp.zeros((), q.dtype), n)


def violation(system, q, v):
    """|A v - b| relative to the velocities."""
    v = np.asarray(v)
    a, b = (np.asarray(x) for x in _constraint(system, q, v.shape[0]))
    return float(np.max(np.abs(a @ v - b), initial=0.0) / (np.max(np.abs(a) @ np.abs(v), initial=0.0) + 1e-300))


class SystemCase(NamedTuple):
    name: str
    build: Callable[..., LagrangianSystem]  # build(restitution), or build() where there is no barrier
    q: Any  # the start
    v: Any
    t1: float  # by then the barrier, if any, is hit
    observe: Callable  # observe(q, v), to be compared with
    exact: Callable  # exact(t, q0, v0), without barriers


_TURN = [0.5, 0.5, -0.5, 0.5]
_fly = lambda t, q, v: np.array([q[0] + v[0] * t, q[1] + v[1] * t, q[2] + v[2] * t - G / 2 * t**2])  # noqa: E731
_pair = lambda t, q, v: np.concatenate([q[:3] + t * v[:3], q[7:10] + t * v[6:9]])  # noqa: E731

all_systems = (
    SystemCase("rigid_body", rigid_body, _TURN, [0.3, 2.0, 0.4], 3.0, lambda q, v: v, lambda t, q, v: _euler(t, v)),
    SystemCase(
        "rigid_body_in_space", rigid_body_in_space, [1.0, 0.0, 0.0, 0.0], [0.3, 2.0, 0.4], 3.0,
        lambda q, v: 4.0 * body_spin(q).T @ space_spin(q) @ v, lambda t, q, v: _euler(t, v),
    ),
    SystemCase(
        "thrown_ball", thrown_ball, [0.0, 0.0, 0.6, *_TURN], [1.0, -0.5, 0.3, 3.0, 12.0, -5.0], 2.0,
        lambda q, v: q[:3], _fly,
    ),
    SystemCase(
        "rolling_ball", rolling_ball, [1.0, 0.0, *_TURN], [-1.5, 0.7, -7.0, -15.0, 9.0], 1.5,
        lambda q, v: jnp.append(q[:2], v), lambda t, q, v: np.append(q[:2] + t * v[:2], v),
    ),
    SystemCase(
        "turntable", turntable, [0.2, -0.1, *_TURN], [0.5, 0.3, (TABLE * 0.2 - 0.3) / R, (0.5 - TABLE * 0.1) / R, 2.0],
        2.0, lambda q, v: jnp.append(q[:2], v[:2]), _turntable,
    ),
    SystemCase(
        "cylinder", cylinder, [0.3, 0.0, *_TURN],
        [6.0, 0.4, 4.0 * np.cos(0.3) - 4.0 * np.sin(0.3), 4.0 * np.sin(0.3) + 4.0 * np.cos(0.3), -6.0 * PIPE / R],
        2.0, lambda q, v: q[:2], _cylinder,
    ),
    SystemCase("sleigh", sleigh, [0.0, 0.0, 0.0], [0.0, 0.0, 1.5], 4.0, _along, _sleigh),
    SystemCase("knife", knife, [0.0, 0.0, 0.0], [0.0, 0.0, 1.2], 3.0, lambda q, v: q, _knife),
    SystemCase(
        "disk", disk, [0.0, 0.0, 0.0, 0.4], [R * 8.0 * np.cos(0.4), R * 8.0 * np.sin(0.4), 8.0, 0.9], 2.5,
        lambda q, v: q[:2], _disk,
    ),
    SystemCase(
        "two_balls", two_balls, [0.0, 0.0, 0.0, *_TURN, 1.0, 0.05, 0.03, *_TURN],
        [1.0, 0.2, 0.0, 3.0, -5.0, 2.0, -0.6, 0.1, 0.05, 1.0, 4.0, -7.0], 1.0,
        lambda q, v: jnp.concatenate([q[:3], q[7:10]]), _pair,
    ),
)  # fmt: skip
