"""The diagnostics: zero for right motions of every system and law, large for each error that is planted."""

import dataclasses
import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import BALL, all_laws, arrays, lane, named
from systems import ALPHA, J, M, R, all_systems, diagonal, floor_of_normals, knife, thrown_ball, violation

from nonholo_jax import (
    Ball,
    BallState,
    Frictional,
    Integrated,
    LagrangianSystem,
    Plane,
    Rough,
    Scene,
    Smooth,
    collide,
    energy,
    law_residual,
    momentum_about,
    projector,
    simulate,
    slip,
    weak_residual,
)

FINE = Integrated(rtol=1e-11, atol=1e-11)


MU = jnp.asarray(0.8)  # an array, as are the numbers of systems.py: what differs in them only is one program


def moved(name, system):
    """A motion from the start that the registry has for this name, through the barrier of `system`."""
    case = next(case for case in all_systems if case.name == name)
    return simulate(system, (case.q, case.v), t1=case.t1, motion=FINE, max_impacts=3)


@functools.cache
def motion_of(name):
    """A system of the registry and its motion."""
    case = next(case for case in all_systems if case.name == name)
    system = case.build() if name.startswith("rigid_body") else case.build(MU)
    return system, moved(name, system)


@pytest.mark.parametrize("case", **named(all_systems))
def test_right_motions_satisfy_the_weak_form_and_the_law(case):
    system, trajectory = motion_of(case.name)
    assert (int(trajectory.n_impacts) > 0) == (system.n_contacts > 0)
    assert float(weak_residual(system, trajectory)) < 1e-9
    assert float(law_residual(system, trajectory)) < 1e-13
    log = jax.tree.map(np.asarray, trajectory.impacts)
    for i in range(int(trajectory.n_impacts)):
        _check_impact(system, lane(log, i))


@eqx.filter_jit
def at_barrier(system, q, time):
    """B, c, the metric, the projector and the gap."""
    rows, metric, barrier = system.barriers[0].constraint(q), system.metric_at(q), system.barriers[0]
    return rows, barrier.moves(q, time, rows.shape[0]), metric, projector(metric, rows), barrier.gap(q)


def _check_impact(system, log):
    """The law of the paper written out, without the library's own residual."""
    (q, before), (there, after) = log.before, log.after
    rows, c, metric, across, gap = (np.asarray(x) for x in at_barrier(system, q, log.time))
    scale = float(np.max(np.abs(rows) @ np.abs(before)))
    np.testing.assert_allclose(rows @ after - c, -0.8 * (rows @ before - c), atol=1e-14 * scale)
    np.testing.assert_array_equal(there, q)
    # (2.9): the jump of the momentum is orthogonal to ker B.
    free, jump = before - across @ before, metric @ (after - before)
    assert abs(float(jump @ free)) <= 1e-13 * float(np.abs(jump) @ np.abs(before))
    assert abs(float(gap)) < 1e-14
    assert violation(system, q, after) < 1e-14


def test_weak_form_sees_a_wrong_metric():
    system, trajectory = motion_of("thrown_ball")
    wrong = eqx.tree_at(lambda s: s.metric, system, type(system.metric)(diagonal(M, M, M, 1.3 * J, J, J)))
    assert float(weak_residual(wrong, trajectory)) > 1e-3


def test_weak_form_sees_a_wrong_force_and_a_wrong_constraint():
    _, trajectory = motion_of("knife")
    assert float(weak_residual(knife(MU, pull=2.02), trajectory)) > 1e-3
    free = LagrangianSystem(metric=diagonal(1.0, 1.0, 0.3), potential=lambda q: -2.0 * q[0], barriers=knife().barriers)
    assert float(weak_residual(free, trajectory)) > 1e-3


def test_weak_form_sees_a_wrong_sign_of_the_spin():
    trajectory = moved("thrown_ball", thrown_ball(MU, -1.0))
    assert float(weak_residual(thrown_ball(MU), trajectory)) > 1e-3
    assert float(law_residual(thrown_ball(MU), trajectory)) > 1e-3


def test_weak_form_sees_test_functions_outside_of_ker_b():
    _, trajectory = motion_of("thrown_ball")
    assert float(weak_residual(floor_of_normals(MU), trajectory)) > 1e-3


@eqx.filter_jit
def impact_of(system, q, v):
    """R v, for one impact at q."""
    return collide(v, system.metric_at(q), system.barriers[0].constraint(q), system.barriers[0].restitution)


def test_law_sees_what_the_weak_form_cannot():
    """(2.9) only asks that the jump of the momentum vanish on ker B. A wrong mu and specular reflection do so too: the
    first breaks Hypotheses 2 and 3 (energy, involution), the second only the law itself."""
    one = jnp.asarray(1.0)
    right = thrown_ball(one)
    case = next(case for case in all_systems if case.name == "thrown_ball")
    q, v = jnp.asarray(case.q), jnp.asarray(case.v)
    for wrong, keeps in ((thrown_ball(0.5 * one), False), (floor_of_normals(one), True)):
        trajectory = moved("thrown_ball", wrong)
        assert float(weak_residual(right, trajectory)) < 1e-9
        assert float(law_residual(right, trajectory)) > 1e-3
        once = impact_of(wrong, q, v)
        energies = [float(energy(right, (q, x))) for x in (v, once)]
        assert (abs(energies[0] - energies[1]) < 1e-13) == keeps
        assert bool(jnp.allclose(impact_of(wrong, q, once), v, atol=1e-13)) == keeps


def test_weak_form_needs_the_whole_log():
    system, trajectory = motion_of("thrown_ball")
    short = dataclasses.replace(trajectory, impacts=jax.tree.map(lambda x: x[:1], trajectory.impacts))
    with pytest.raises(ValueError, match="log_size=None"):
        weak_residual(system, short)


FLOOR = {"point": np.zeros(3), "normal": np.array([0.2, -0.1, 1.0])}
THROW = BallState(np.array([0.0, 0.0, 0.8]), np.array([0.7, 0.4, -1.0]), np.array([20.0, -9.0, 5.0]))


def scene_with(law):
    roof = Plane((0, 0, 2), (0, 0, -1), Rough(0.3, 0.1))
    return Scene(Ball(**BALL), {"floor": Plane(**FLOOR, law=law), "roof": roof})


@pytest.mark.parametrize("case", **named(all_laws))
def test_law_of_the_ball(case):
    scene = scene_with(case.build(**arrays(case.numbers)))
    trajectory = simulate(scene, THROW, t1=0.9, max_impacts=3)
    assert int(trajectory.n_impacts) >= 1
    assert float(law_residual(scene, trajectory)) < 1e-13
    one = jnp.asarray(1.0)
    for other in (Rough(one * 0.7), Smooth(one * 0.7), Frictional(one * 0.8, one * 0.2, one * 0.1)):
        assert float(law_residual(scene_with(other), trajectory)) > 1e-3


def test_energy_of_a_ball_is_that_of_its_lagrangian_system():
    scene = Scene(Ball(R, M, ALPHA), {}, (0.0, 0.0, -9.81))
    q, v = jnp.asarray([0.3, 0.1, 0.6, 1.0, 0, 0, 0]), jnp.asarray([1.0, -0.5, 0.3, 3.0, 12.0, -5.0])
    want = 0.5 * M * 1.34 + 0.5 * J * 178.0 + M * 9.81 * 0.6
    np.testing.assert_allclose(energy(scene, BallState(q[:3], v[:3], v[3:])), want, rtol=1e-14)
    np.testing.assert_allclose(energy(thrown_ball(), (q, v)), want, rtol=1e-14)
    many = BallState(jnp.stack([q[:3]] * 2), jnp.stack([v[:3]] * 2), jnp.stack([v[3:]] * 2))
    np.testing.assert_allclose(energy(scene, many), [want, want], rtol=1e-14)
    np.testing.assert_allclose(energy(thrown_ball(), (jnp.stack([q] * 2), jnp.stack([v] * 2))), want, rtol=1e-14)


def test_impacts_keep_energy_and_the_momentum_about_the_contact():
    scene = scene_with(Rough())
    log = lane(simulate(scene, THROW, t1=0.9, max_impacts=3).impacts, 0)
    np.testing.assert_allclose(energy(scene, log.before), energy(scene, log.after), rtol=1e-13)
    momenta = [momentum_about(log.point, scene, state) for state in (log.before, log.after)]
    np.testing.assert_allclose(*momenta, rtol=1e-12)
    slips = [slip(scene, state, "floor") for state in (log.before, log.after)]
    np.testing.assert_allclose(slips[0], -slips[1], rtol=1e-12)
    assert abs(float(slips[0] @ log.normal)) < 1e-13 < float(jnp.linalg.norm(slips[0]))


def test_slip_is_zero_in_rolling():
    scene = scene_with(Rough())
    n = jnp.asarray(FLOOR["normal"] / np.linalg.norm(FLOOR["normal"]))
    spin = jnp.asarray([1.0, 2.0, 3.0])
    rolls = BallState(0.1 * n, 0.1 * jnp.cross(spin, n), spin)
    np.testing.assert_allclose(slip(scene, rolls, "floor"), 0.0, atol=1e-16)
    with pytest.raises(ValueError, match="one of floor, roof"):
        slip(scene, rolls, "wall")


def test_refused():
    scene = scene_with(Rough())
    one = simulate(scene, THROW, t1=0.1, max_impacts=3)
    batch = jax.tree.map(lambda x: x[None] if eqx.is_array(x) else x, one)
    with pytest.raises(ValueError, match="a Scene or a LagrangianSystem, but got str"):
        energy("scene", THROW)
    with pytest.raises(ValueError, match="one motion, but got a batch"):
        law_residual(scene, batch)
    with pytest.raises(ValueError, match="must be a LagrangianSystem"):
        weak_residual(thrown_ball(), one)
    assert float(law_residual(scene, one)) == 0.0
