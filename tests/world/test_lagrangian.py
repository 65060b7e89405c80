"""Lagrangian systems: each of the registry against its closed form, its barrier, and what is refused."""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import lane, named, result_of, results_of
from systems import (
    MEETING,
    G,
    J,
    M,
    R,
    all_systems,
    rolling_ball,
    thrown_ball,
    turntable,
    two_balls,
    violation,
)

from nonholo_jax import (
    Ball,
    BallState,
    Barrier,
    Integrated,
    LagrangianSystem,
    Plane,
    Rough,
    Scene,
    projector,
    simulate,
    simulate_batch,
)

FINE = Integrated(rtol=1e-11, atol=1e-11)
ROUGH = Integrated(diffrax.Heun(), diffrax.ConstantStepSize(), dt0=0.1, max_steps=64)  # where accuracy is not asked for
every_system = pytest.mark.parametrize("case", **named(all_systems))


def start_of(case, dtype=np.float64):
    return jnp.asarray(np.asarray(case.q, dtype)), jnp.asarray(np.asarray(case.v, dtype))


@every_system
def test_free_motion_is_its_closed_form(case):
    system, (q, v) = case.build().without_contacts(), start_of(case)
    trajectory = simulate(system, (q, v), t1=case.t1, motion=FINE)
    seen = jax.jit(lambda q, v: (case.observe(q, v), system.energy(q, v)))
    (got, energy), (_, initial) = seen(*trajectory.final), seen(q, v)
    np.testing.assert_allclose(got, case.exact(case.t1, np.asarray(q), np.asarray(v)), rtol=1e-9, atol=1e-9)
    if case.name != "turntable":  # its table does work
        np.testing.assert_allclose(energy, initial, rtol=1e-9)
    assert violation(system, *trajectory.final) < 1e-14


def test_thrown_ball_is_the_ball_engine():
    position, turn, velocity, spin = [0, 0, 0.6], [0.5, 0.5, -0.5, 0.5], [1.0, -0.5, 0.3], [3.0, 12.0, -5.0]
    scene = Scene(Ball(R, M), {"floor": Plane((0, 0, 0), (0, 0, 1), Rough(0.9))}, (0.0, 0.0, -G))
    want = simulate(scene, BallState(position, velocity, spin, turn), t1=2.0)
    got = simulate(thrown_ball(jnp.asarray(0.9)), (position + turn, velocity + spin), t1=2.0, motion=FINE)
    assert int(got.n_impacts) == int(want.n_impacts) >= 3
    n = int(got.n_impacts)
    np.testing.assert_allclose(got.impacts.time[:n], want.impacts.time[:n], rtol=1e-12)
    np.testing.assert_allclose(got.impacts.after[1][:n, 3:], want.impacts.after.spin[:n], atol=1e-9)
    np.testing.assert_allclose(got.final[0], jnp.append(want.final.position, want.final.orientation), atol=1e-9)
    np.testing.assert_allclose(got.final[1], jnp.append(want.final.velocity, want.final.spin), atol=1e-9)


def test_rolling_ball_meets_the_wall_by_theorem_5_1():
    v1, v2, w3 = -1.5, 0.7, 9.0
    trajectory = simulate(rolling_ball(), ([1.0, 0, 1, 0, 0, 0], [v1, v2, -v2 / R, v1 / R, w3]), t1=1.5, motion=FINE)
    inner = J + R**2 * M / 2
    want_v2 = R**2 * M / (2 * inner) * v2 + R * J / inner * w3
    want_w3 = (J + R**2 * M) / (R * inner) * v2 - R**2 * M / (2 * inner) * w3
    np.testing.assert_allclose(trajectory.final[1], [-v1, want_v2, -want_v2 / R, -v1 / R, want_w3], rtol=1e-13)


def test_nonholonomic_pendulum_comes_back():
    """Section 5.2.1: v and spin are reversed at every bounce, and the ball flies along one parabola for ever."""
    v, u = 0.4, 1.1
    state = ([0.0, 0.0, R, 1, 0, 0, 0], [v, 0.0, u, 0.0, -R * M * v / J, 0.0])
    trajectory = simulate(thrown_ball(jnp.asarray(1.0)), state, t1=2 * u / G * 20.5, motion=FINE)
    assert int(trajectory.n_impacts) == 20
    first, last = lane(trajectory.impacts.before, 0), lane(trajectory.impacts.before, 18)
    np.testing.assert_allclose(trajectory.impacts.after[1][:20], -trajectory.impacts.before[1][:20], atol=1e-11)
    np.testing.assert_allclose(first[0][:3], last[0][:3], atol=1e-11)
    np.testing.assert_allclose(first[1], last[1], atol=1e-11)


def test_two_balls_keep_momentum_angular_momentum_and_energy():
    case = next(case for case in all_systems if case.name == "two_balls")
    one, heavier = jnp.asarray(1.0), jnp.asarray(2.5)
    system = two_balls(one, heavier)

    def momenta(q, v):
        momentum = M * (v[:3] + 2.5 * v[6:9])
        turning = M * (jnp.cross(q[:3], v[:3]) + 2.5 * jnp.cross(q[7:10], v[6:9])) + J * (v[3:6] + 2.5 * v[9:12])
        return jnp.append(jnp.append(momentum, turning), system.energy(q, v))

    trajectory = simulate(system, (case.q, case.v), t1=1.0, motion=FINE)
    assert int(trajectory.n_impacts) == 1
    momenta = jax.jit(momenta)
    np.testing.assert_allclose(momenta(*trajectory.final), momenta(*start_of(case)), rtol=1e-12, atol=1e-13)
    turn = [1.0, 0, 0, 0]
    head_on = ([0.0, 0, 0, *turn, 1.0, 0, 0, *turn], [0.9, 0, 0, 0, 0, 0, -0.2, 0, 0, 0, 0, 0])
    after = simulate(two_balls(one, one), head_on, t1=1.0, motion=FINE).final[1]
    np.testing.assert_allclose(after, np.roll(head_on[1], 6), atol=1e-14)  # they exchange velocities


class Wall(eqx.Module):
    """The gap of the half plane normal . q > 0, and as `constraint`, no velocity across it."""

    normal: jax.Array
    as_rows: bool = False

    def __call__(self, q):
        return self.normal[None] if self.as_rows else self.normal @ q


def flat(q):
    return jnp.eye(2)


def corner(left, right):
    """A point in the plane between two walls that meet at the origin."""
    walls = []
    for normal, mu in (((1.0, 0.0), left), ((1.0, 1.0), right)):
        gap, rows = (Wall(jnp.asarray(normal), as_rows) for as_rows in (False, True))
        walls.append(Barrier(gap, rows, jnp.asarray(mu), curvature=0.0))
    return LagrangianSystem(metric=flat, barriers=walls)


@pytest.mark.parametrize("right, want", [(1.0, (1.0, 0.25)), (0.5, None)])
def test_corner_is_resolved(right, want):
    trajectory = simulate(corner(1.0, right), ([1.0, 0.25], [-1.0, -0.25]), t1=1.5, motion=FINE)
    log = trajectory.impacts
    np.testing.assert_allclose(log.time[: int(trajectory.n_impacts)], 1.0, rtol=1e-14)
    q, v = trajectory.final
    assert float(q[0]) > 0 and float(q[0] + q[1]) > 0
    if want is not None:  # both at once, by the stacked B, which reverses everything
        assert int(trajectory.n_impacts) == 1
        np.testing.assert_allclose(v, want, atol=1e-15)


@pytest.mark.parametrize("name", ["cylinder", "knife"])
def test_gradients_through_impacts(name):
    """Both modes agree with central differences, in the state and in the restitution."""
    case = next(case for case in all_systems if case.name == name)
    q, v = start_of(case)
    weights = jnp.cos(jnp.arange(q.size + v.size, dtype=q.dtype))

    def end(x):
        system = case.build(0.9 + x)
        moved = system.admissible(q + x * weights[: q.size], v + x)
        state = (q + x * weights[: q.size], moved)
        trajectory = simulate(system, state, t1=case.t1, motion=Integrated(rtol=1e-12, atol=1e-12), throw=False)
        return jnp.sum(weights * jnp.append(*trajectory.final)), trajectory.n_impacts

    h = 1e-5
    (_, n), reverse = jax.jit(jax.value_and_grad(end, has_aux=True))(jnp.zeros(()))
    sides = jnp.asarray([h, -h, 0.0])
    values, slopes, _ = jax.jit(jax.vmap(lambda x: jax.jvp(end, (x,), (jnp.ones(()),), has_aux=True)))(sides)
    assert int(n) >= 2
    forward, central = slopes[2], (values[0] - values[1]) / (2 * h)
    np.testing.assert_allclose(forward, reverse, rtol=1e-9)
    np.testing.assert_allclose(forward, central, rtol=1e-6)


class Pull(eqx.Module):
    strength: jax.Array

    def __call__(self, q):
        return -self.strength * q[0]


@pytest.mark.parametrize("dtype, tolerance", [(np.float32, 3e-5), (np.float64, 1e-9)])
def test_batches_of_states_and_of_systems(dtype, tolerance):
    blade = lambda q: jnp.array([[-jnp.sin(q[2]), jnp.cos(q[2]), 0.0]])  # noqa: E731
    pulls = jnp.asarray(np.array([0.5, 2.0], dtype))
    system = LagrangianSystem(metric=lambda q: jnp.eye(3), potential=Pull(pulls), constraint=blade)
    states = jnp.zeros((2, 3), dtype), jnp.asarray(np.array([[0, 0, 1.2], [0, 0, 1.2]], dtype))
    motion = Integrated(rtol=1e-5 if dtype == np.float32 else 1e-11, atol=1e-6 if dtype == np.float32 else 1e-11)
    batch = simulate_batch(system, states, t1=1.0, scene_axes=0, motion=motion, throw=True)
    assert batch.final[0].dtype == dtype
    for i, pull in enumerate(pulls):
        want = all_systems[7].exact(1.0, np.zeros(3), np.array([0, 0, 1.2])) * [pull / 2, pull / 2, 1]
        np.testing.assert_allclose(batch.final[0][i], want, rtol=tolerance, atol=tolerance)
    ends = jax.vmap(lambda v: simulate(lane(system, 1), (states[0][0], v), t1=1.0, motion=motion).final[0])(states[1])
    np.testing.assert_allclose(ends[1], batch.final[0][1], rtol=tolerance)


@pytest.mark.parametrize("solver", [diffrax.Dopri8(), diffrax.Heun()])
def test_other_solvers(solver):
    case = next(case for case in all_systems if case.name == "knife")
    fine = Integrated(solver, rtol=1e-8, atol=1e-8)
    coarse = Integrated(solver, stepsize_controller=diffrax.ConstantStepSize(), dt0=1e-3)
    motion, tolerance = (fine, 1e-7) if isinstance(solver, diffrax.Dopri8) else (coarse, 1e-5)
    q, v = start_of(case)
    final = simulate(case.build().without_contacts(), (q, v), t1=3.0, motion=motion).final
    np.testing.assert_allclose(case.observe(*final), case.exact(3.0, q, v), atol=tolerance)


# What is refused


def plane_system(**changes):
    """Two coordinates; any argument can be spoilt."""
    parts = {"metric": lambda q: jnp.eye(2), "constraint": lambda q: jnp.array([[0.0, 1.0]])}
    return LagrangianSystem(**{**parts, **changes})


def _wall(rows, offset=None):
    return [Barrier(lambda q: 1.0 - q[0], lambda q: jnp.array(rows), offset=offset)]


AT_REST = ([0.0, 0.0], [0.0, 0.0])
REFUSED = {
    "both": (lambda: plane_system(lagrangian=lambda q, v: v @ v), AT_REST, "`lagrangian` alone or `metric`"),
    "neither": (lambda: LagrangianSystem(), AT_REST, "none of them"),
    "no function": (lambda: LagrangianSystem(metric=1.0), AT_REST, "`metric` must be a function"),
    "offset alone": (lambda: plane_system(constraint=None, offset=lambda q, t: q), AT_REST, "with `constraint`"),
    "no barrier": (lambda: plane_system(barriers=[1.0]), AT_REST, "must hold Barriers"),
    "restitution": (lambda: Barrier(lambda q: q[0], lambda q: q[None], 1.5), AT_REST, r"`restitution` must lie in \[0"),
    "curvature": (lambda: Barrier(lambda q: q[0], lambda q: q[None], curvature=-1.0), AT_REST, "`curvature`"),
    "no pair": (plane_system, [1.0], r"must be a pair \(q, v\)"),
    "batch": (plane_system, (jnp.zeros((2, 2)), jnp.zeros((2, 2))), "try simulate_batch"),
    "lengths": (plane_system, ([0.0, 0.0], [0.0]), "where there is no `frame`"),
    "columns": (lambda: plane_system(constraint=lambda q: jnp.ones((1, 3))), AT_REST, r"`constraint` .*\(any, 2\)"),
    "metric shape": (lambda: plane_system(metric=lambda q: jnp.eye(3)), AT_REST, r"`metric` must return the shape"),
    "offset shape": (lambda: plane_system(offset=lambda q, t: q), AT_REST, r"`offset` must return the shape \(1"),
    "barrier columns": (
        lambda: plane_system(barriers=_wall([[1.0]])), AT_REST, r"`barriers\[0\].constraint` must return",
    ),
    "velocity": (plane_system, ([0.0, 0.0], [1.0, 0.25]), r"\|A v - b\| = 0.25; try system.admissible"),
    "not finite": (plane_system, ([0.0, jnp.nan], [1.0, 0.0]), "finite"),
    "metric": (lambda: plane_system(metric=lambda q: jnp.diag(jnp.array([1.0, -1.0]))), AT_REST, "positive definite"),
    "semidefinite": (lambda: plane_system(metric=lambda q: jnp.ones((2, 2))), AT_REST, "positive definite"),
    "asymmetric": (lambda: plane_system(metric=lambda q: jnp.array([[1.0, 0.5], [0, 1.0]])), AT_REST, "symmetric"),
    "frame rank": (lambda: plane_system(frame=lambda q: jnp.ones((2, 2))), AT_REST, "independent columns"),
    "frame not closed": (
        lambda: LagrangianSystem(
            metric=lambda q: jnp.eye(2), frame=lambda q: jnp.array([[jnp.cos(q[2]), 0], [jnp.sin(q[2]), 0], [0, 1.0]])
        ),
        ([0.0, 0.0, 0.0], [0.0, 0.0]), "whole tangent space",
    ),
    "behind": (lambda: plane_system(barriers=_wall([[1.0, 0], [0, 1.0]])), ([1.5, 0.0], [0.0, 0.0]), "a gap of -0.5"),
    "kernel": (lambda: plane_system(barriers=_wall([[1.0, 0]])), AT_REST, r"`barriers\[0\].constraint` .*ker B inside"),
    "two frames": (
        lambda: plane_system(barriers=_wall([[1.0, 0], [0, 1.0]]), offset=lambda q, t: jnp.ones(1)),
        ([0.0, 0.0], [0.0, 1.0]), r"`barriers\[0\].offset` .* two moving frames",
    ),
}  # fmt: skip


@pytest.mark.parametrize("build, state, words", REFUSED.values(), ids=REFUSED.keys())
def test_refused(build, state, words):
    with pytest.raises(ValueError, match=words):
        simulate(build(), state, t1=1.0)


def test_rough_wall_on_a_turntable_is_refused_by_name():
    table = turntable()
    rough = Barrier(lambda q: 0.4 - q[0], lambda q: jnp.array(MEETING))
    system = eqx.tree_at(lambda system: system.barriers, table, (rough,))
    case = next(case for case in all_systems if case.name == "turntable")
    with pytest.raises(ValueError, match="two moving frames at once"):
        simulate(system, (case.q, case.v), t1=1.0)


def test_traced_values_end_by_name():
    system = plane_system(barriers=_wall([[1.0, 0], [0, 1.0]]))
    run = jax.jit(lambda v: simulate(system, (jnp.zeros(2), v), t1=1.0, motion=ROUGH, throw=False))
    assert result_of(run(jnp.array([0.5, 0.0]))) == "reached_t1"
    assert result_of(run(jnp.array([0.5, 0.1]))) == "invalid_state"
    batch = simulate_batch(system, (jnp.zeros((2, 2)), jnp.array([[0.5, 0.0], [0.5, 0.1]])), t1=1.0, motion=ROUGH)
    assert results_of(batch) == ["reached_t1", "invalid_state"]


def test_barrier_that_does_not_stop_the_motion_is_named():
    """B v = 0 stops the motion along the wall, not towards it."""
    system = LagrangianSystem(metric=lambda q: jnp.eye(2), barriers=_wall([[0.0, 1.0]]))
    assert (
        result_of(simulate(system, ([0.0, 0.0], [2.0, 0.0]), t1=1.0, motion=ROUGH, throw=False)) == "barrier_conflict"
    )


def test_admissible_is_the_nearest_velocity():
    case = next(case for case in all_systems if case.name == "turntable")
    system, (q, v) = turntable(), start_of(case)
    admissible = jax.jit(lambda q, v: system.admissible(q, v))
    got = admissible(q, v + 1.0)
    assert violation(system, q, got) < 1e-15
    np.testing.assert_allclose(admissible(q, v), v, atol=1e-14)
    along = jax.jit(
        lambda q, x: x @ system.metric_at(q) @ (jnp.eye(5) - projector(system.metric_at(q), system.constraint(q)))
    )
    np.testing.assert_allclose(along(q, got - v - 1.0), np.zeros(5), atol=1e-13)


def test_constraint_holds_over_many_steps():
    """The drift does not grow with the number of steps."""
    case = next(case for case in all_systems if case.name == "disk")
    coarse = Integrated(stepsize_controller=diffrax.ConstantStepSize(), dt0=5e-3, max_steps=100_000)
    system = case.build().without_contacts()
    trajectory = simulate(system, start_of(case), t1=100.0, motion=coarse)
    assert int(trajectory.n_arcs) >= 20_000 and violation(system, *trajectory.final) < 1e-14
