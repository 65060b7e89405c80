"""Exact motion against integrated motion, orders of convergence, and what every motion must keep."""

import dataclasses

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import AIR, GRAVITY, generator, lane, results_of, stacked, states

from nonholo_jax import (
    Air,
    Ball,
    BallState,
    Box,
    Cylinder,
    Exact,
    Frictional,
    Integrated,
    Plane,
    Rough,
    Scene,
    Smooth,
    Sphere,
    simulate,
    simulate_batch,
)
from nonholo_jax._math.types import result_name

EPS = np.finfo(np.float64).eps
R = 0.1
N = 1000
FINE = Integrated(rtol=1e-10, atol=1e-10)
UP = (0.0, 0.0, 1.0)
STILL = (0.0, 0.0, 0.0)


def floor(law=None):
    return Plane(STILL, UP, Rough(0.8) if law is None else law)


def room(law):
    """Six planes round [-1, 1]^3."""
    return {
        f"wall_{axis}_{side}": Plane(side * np.eye(3)[axis], -side * np.eye(3)[axis], law)
        for axis in range(3)
        for side in (-1, 1)
    }


def random_states(rng, n, low, high, speed, spin=20.0):
    return states(rng.uniform(low, high, (n, 3)), rng.normal(0, speed, (n, 3)), rng.normal(0, spin, (n, 3)))


# Random throws, and a time: a handful of impacts in it. Each impact on a curved surface, an edge or a corner multiplies
# differences by about 2 |v| t / r cos(angle), some 10 here, so that rounding of 1e-15 stays below 1e-7 for five or so;
# planes amplify it by their number only. Laws of all kinds take part.
SCENES = {
    "floor": (
        lambda: {"floor": floor(Rough(0.8))},
        lambda rng: random_states(rng, N, (-1, -1, 0.2), (1, 1, 2), 2.0),
        1.5,
    ),
    "room": (
        lambda: room(Rough(0.95, 0.3)),
        lambda rng: random_states(rng, N, -0.85, 0.85, 3.0),
        1.0,
    ),
    "table": (
        lambda: {"floor": floor(), "table": Box((0.0, 0.0, 0.7), (0.6, 0.4, 0.05), Frictional(0.8, 0.2, 0.3))},
        lambda rng: random_states(rng, N, (-1.2, -1, 0.9), (1.2, 1, 1.5), 2.0),
        0.8,
    ),
    "sphere": (
        lambda: {"bowl": Sphere((0.1, 0.0, 0.0), 1.0, Rough(0.9), inside=True)},
        lambda rng: random_states(rng, N, -0.4, 0.4, 2.0),
        0.8,
    ),
    "cylinder": (
        lambda: {"floor": floor(), "post": Cylinder((0.0, 0.0, 0.0), (0.2, 0.1, 1.0), 0.4, Smooth(0.9))},
        lambda rng: aimed_at_the_post(rng),
        0.8,
    ),
}


def aimed_at_the_post(rng):
    angle, away = rng.uniform(0, 2 * np.pi, N), rng.uniform(1.0, 1.5, N)
    position = np.c_[away * np.cos(angle), away * np.sin(angle), rng.uniform(0.3, 1.5, N)]
    target = rng.uniform(-0.5, 0.5, (N, 3)) + [0, 0, 0.7]
    velocity = (target - position) / rng.uniform(0.2, 0.5, (N, 1))
    return states(position, velocity, rng.normal(0, 20, (N, 3)))


@pytest.mark.parametrize("name", SCENES)
def test_exact_agrees_with_integrated(name, getkey):
    """Same itinerary, no impact missed or doubled, and the same states wherever no impact is grazing."""
    surfaces, sampler, t1 = SCENES[name]
    throw = sampler(generator(getkey()))
    scene = Scene(Ball(R, 0.7), surfaces(), GRAVITY)
    exact, integrated = (
        simulate_batch(scene, throw, t1=t1, max_impacts=24, sum_trains=False, motion=motion)
        for motion in (Exact(), FINE)
    )
    fine = np.array(results_of(exact)) == "reached_t1"
    assert fine.sum() > 0.99 * N  # a ball that is thrown so slowly that its bounces end is left to other tests
    assert np.array_equal(results_of(exact), results_of(integrated))
    log = exact.impacts
    speed = np.linalg.norm(log.before.velocity, axis=-1)
    closing = np.abs(np.sum(np.asarray(log.normal) * np.asarray(log.before.velocity), axis=-1))
    grazing = np.any(np.where(np.asarray(log.surface) >= 0, closing < 1e-3 * speed, False), axis=1)
    used = fine & ~grazing
    assert used.sum() > 0.9 * N
    assert np.array_equal(exact.n_impacts[used], integrated.n_impacts[used])
    assert np.array_equal(log.surface[used], integrated.impacts.surface[used])
    assert np.asarray(exact.n_impacts).max() >= 3 and np.asarray(exact.n_impacts).mean() > 1
    np.testing.assert_allclose(log.time[used], integrated.impacts.time[used], rtol=0, atol=1e-7)
    scale = np.array([1.0] * 6 + [1 / R] * 3)  # r omega is a velocity
    difference = np.abs(np.asarray(stacked(exact.final)) - np.asarray(stacked(integrated.final))) / scale
    assert difference[used].max() < 1e-7
    check_log(scene, exact, fine)


def check_log(scene, trajectory, lanes):
    """At every impact the gap is zero and closes; after it, it opens; and nowhere between is the ball inside."""
    log = lane(trajectory.impacts, lanes)
    surface = np.asarray(log.surface)
    used = surface >= 0
    inward = np.sum(np.asarray(log.normal) * np.asarray(log.before.velocity), axis=-1)
    outward = np.sum(np.asarray(log.normal) * np.asarray(log.after.velocity), axis=-1)
    assert np.all(inward[used] < 0) and np.all(outward[used] >= 0)
    assert np.all(np.diff(np.asarray(log.time), axis=1)[used[:, 1:]] >= 0)
    times = np.linspace(0.0, 1.0, 64) * float(trajectory.t1[np.flatnonzero(lanes)[0]])
    places = np.asarray(trajectory.at(times).position)[lanes]
    for each in scene.surfaces:
        gaps = jax.vmap(lambda x, s=each: s.gap(x, 0.0, R))(jnp.asarray(places.reshape(-1, 3)))
        assert np.min(gaps) > -1e-12


def air_scenes():
    return {
        "room": (room(Rough(0.9, 0.4)), lambda rng: random_states(rng, 200, -0.8, 0.8, 4.0, 40.0)),
        "table": (
            {"floor": floor(), "table": Box((0.0, 0.0, 0.7), (0.6, 0.4, 0.05), Rough(0.8))},
            lambda rng: random_states(rng, 200, (-1.2, -1, 0.9), (1.2, 1, 1.5), 3.0, 40.0),
        ),
    }


LIGHT = 0.02  # kg: a ball of 0.1 m radius that air slows within a second


@pytest.mark.parametrize("name", ["room", "table"])
def test_errors_fall_with_the_tolerance(name, getkey):
    surfaces, sampler = air_scenes()[name]
    scene = Scene(Ball(R, LIGHT), surfaces, GRAVITY, Air(**AIR))
    throw = sampler(generator(getkey()))

    @jax.jit
    def run(tolerance):
        motion = Integrated(stepsize_controller=diffrax.PIDController(tolerance, tolerance), max_steps=2048)
        end = simulate_batch(scene, throw, t1=1.0, max_impacts=16, sum_trains=False, motion=motion)
        return end.final.position, end.impacts.surface, end.result, end.n_impacts

    names = lambda result: np.array([result_name(lane(result, i)) for i in range(len(throw.position))])  # noqa: E731
    best, itinerary, result, counts = run(1e-13)
    fine = names(result) == "reached_t1"
    assert fine.sum() > 190 and np.asarray(counts).mean() > 0.8
    errors = []
    for tolerance in (1e-6, 1e-8, 1e-10):
        position, surface, *_ = run(tolerance)
        same = np.all(np.asarray(surface) == np.asarray(itinerary), axis=1)
        assert np.all(same[fine])
        errors.append(np.median(np.abs(np.asarray(position - best)).max(axis=1)[fine]))
    assert errors[0] < 1e-4 and errors[1] < errors[0] / 10 and errors[2] < errors[1] / 10 and errors[2] < 1e-8


# Order of convergence, with constant steps that an impact restarts. The ball is light and spins fast, so that its path
# is a spiral: where the force hardly changes, methods of order 5 look better than they are at steps that are usable.

SOLVERS = {
    "euler": (diffrax.Euler(), 1),  # through `init` and `step`; the rest through their tableau
    "heun": (diffrax.Heun(), 2),
    "midpoint": (diffrax.Midpoint(), 2),
    "ralston": (diffrax.Ralston(), 2),
    "bosh3": (diffrax.Bosh3(), 3),
    "tsit5": (diffrax.Tsit5(), 5),
    "dopri5": (diffrax.Dopri5(), 5),
}


def air_bounce(solver, h):
    scene = Scene(Ball(R, LIGHT), {"floor": floor(Rough(0.8))}, GRAVITY, Air(**AIR))
    motion = Integrated(solver=solver, stepsize_controller=diffrax.ConstantStepSize(), dt0=h, max_steps=2048)
    throw = BallState([0, 0, 0.6], [6.0, 1.0, -3.0], [5.0, 150.0, -100.0])
    return simulate(scene, throw, t1=0.5, max_impacts=1, sum_trains=False, motion=motion, throw=False)


@pytest.fixture(scope="module")
def reference():
    end = air_bounce(diffrax.Dopri8(), 0.5 / 1500)
    assert int(end.n_impacts) == 1 and result_name(end.result) == "reached_t1"
    return np.asarray(stacked(end.final))


@pytest.mark.parametrize("name", SOLVERS)
def test_order_of_convergence_through_an_impact(name, reference):
    """The impact cuts a step where the solver's interpolant crosses the floor. Interpolants are one order below their
    method (Tsit5: 4), but each impact uses one once only, so that its local error is of the method's global order:
    nothing is lost."""
    solver, order = SOLVERS[name]
    counts = np.array([64, 90, 128, 181, 256]) * (2 if order == 1 else 1)
    # The place of the impact in its step is a periodic function of 1/h: the mean of several h smooths it out.
    sizes = 0.5 / (counts[:, None] * np.linspace(1, 1.06, 9))
    ends = jax.jit(jax.vmap(jax.vmap(lambda h: stacked(air_bounce(solver, h).final))))(jnp.asarray(sizes))
    errors = np.mean(np.log(np.abs(np.asarray(ends) - reference)[..., :6].max(axis=-1)), axis=1)
    slope = np.polyfit(np.mean(np.log(sizes), axis=1), errors, 1)[0]
    assert abs(slope - order) < 0.2, (slope, np.exp(errors))


@pytest.mark.parametrize("name", ["heun", "midpoint", "ralston"])
def test_large_steps_of_second_order_are_exact_on_parabolas(name, getkey):
    """Their end points are, and so must be the paths between: an impact cuts a step anywhere, and the next begins
    with the velocity that the path has there."""
    scene = Scene(Ball(R, 0.7), room(Rough(0.95, 0.3)), GRAVITY)
    throw = random_states(generator(getkey()), 64, -0.85, 0.85, 3.0)
    constant = diffrax.ConstantStepSize()
    motion = Integrated(SOLVERS[name][0], stepsize_controller=constant, dt0=0.27, max_steps=64)
    options = {"t1": 1.0, "max_impacts": 24, "sum_trains": False}
    found, exact = (simulate_batch(scene, throw, **options, motion=each) for each in (motion, Exact()))
    counts = np.asarray(exact.n_impacts)
    assert np.array_equal(found.n_impacts, counts) and counts.mean() > 3
    assert np.array_equal(found.impacts.surface, exact.impacts.surface)
    np.testing.assert_allclose(found.impacts.time, exact.impacts.time, rtol=0, atol=1e-12)
    scale = np.array([1.0] * 6 + [1 / R] * 3)  # r omega is a velocity
    difference = np.abs(np.asarray(stacked(found.final)) - np.asarray(stacked(exact.final))) / scale
    assert difference.max() < 1e-12


# What every motion keeps


def elastic_scenes():
    laws = (Rough(), Smooth(), Rough(1.0, -1.0))
    return {
        "room": (room(laws[0]), lambda rng: random_states(rng, 64, -0.85, 0.85, 3.0), 1.0),
        "sphere": (
            {"bowl": Sphere(STILL, 1.0, laws[0], inside=True)},
            lambda rng: random_states(rng, 64, -0.4, 0.4, 2.0),
            0.7,
        ),
        "table": (
            {"floor": floor(laws[0]), "table": Box((0, 0, 0.7), (0.6, 0.4, 0.05), laws[1])},
            lambda rng: random_states(rng, 64, (-1.2, -1, 0.9), (1.2, 1, 1.5), 2.0),
            1.2,
        ),
    }


@pytest.mark.parametrize("name", ["room", "sphere", "table"])
def test_elastic_motion_is_reversible_and_keeps_its_energy(name, getkey):
    """Run, flip velocity and spin, run back: the start, flipped (Theorem 4.1 is an involution)."""
    surfaces, sampler, t1 = elastic_scenes()[name]
    mass, alpha = 0.7, 0.4
    scene = Scene(Ball(R, mass, alpha), surfaces, GRAVITY)
    throw = sampler(generator(getkey()))
    there = simulate_batch(scene, throw, t1=t1, max_impacts=32)
    end = there.final
    back = simulate_batch(scene, BallState(end.position, -end.velocity, -end.spin), t1=t1, max_impacts=32)
    assert set(results_of(there)) == {"reached_t1"} and np.asarray(there.n_impacts).mean() > 1
    assert np.array_equal(there.n_impacts, back.n_impacts)
    position, flipped = np.asarray(back.final.position), np.asarray(back.final.velocity)
    # Rounding grows through the impacts on curves and edges, there and back; planes do not amplify it.
    tolerance = 1e-12 if name == "room" else 1e-8
    np.testing.assert_allclose(position, throw.position, rtol=0, atol=tolerance)
    np.testing.assert_allclose(flipped, -throw.velocity, rtol=0, atol=10 * tolerance)
    np.testing.assert_allclose(R * back.final.spin, -R * throw.spin, rtol=0, atol=10 * tolerance)

    def energy(state):
        v, w = np.asarray(state.velocity), np.asarray(state.spin)
        height = np.asarray(state.position)[..., 2]
        return mass * (np.sum(v * v, -1) + alpha * R**2 * np.sum(w * w, -1)) / 2 + mass * 9.81 * height

    start = energy(throw)
    scale = np.abs(start) + mass * 9.81
    assert np.max(np.abs(energy(end) - start) / scale) < 64 * EPS * 32
    log = np.asarray(there.impacts.surface) >= 0
    change = np.abs(energy(there.impacts.after) - energy(there.impacts.before)) / scale[:, None]
    assert np.max(change[log]) < 64 * EPS


@pytest.mark.parametrize("motion", [Exact(), FINE], ids=["exact", "integrated"])
def test_planar_motion_stays_planar(motion, getkey):
    """To the last bit: y, v_y, omega_x and omega_z stay zero among surfaces that are symmetric about y = 0."""
    rng = generator(getkey())
    scene = Scene(
        Ball(R, 0.7),
        {
            "floor": floor(Rough(0.9, 0.3)),
            "table": Box((0.3, 0.0, 0.7), (0.5, 0.4, 0.05), Rough()),
            "ball": Sphere((-1.0, 0.0, 0.5), 0.3, Frictional(0.9, 0.5, 0.1)),
            "slope": Plane((2.0, 0.0, 0.0), (-1.0, 0.0, 0.3), Smooth(0.9)),
        },
        GRAVITY,
        None if isinstance(motion, Exact) else Air(wind=(1.0, 0.0, 0.0)),
    )
    n = 64
    zero = np.zeros(n)
    position = np.c_[rng.uniform(-1.5, 1.2, n), zero, rng.uniform(1.0, 1.5, n)]
    velocity = np.c_[rng.normal(0, 2, n), zero, rng.normal(0, 2, n)]
    spin = np.c_[zero, rng.normal(0, 30, n), zero]
    end = simulate_batch(
        scene, states(position, velocity, spin), t1=1.0, max_impacts=32, sum_trains=False, motion=motion
    )
    assert np.asarray(end.n_impacts).mean() > 1
    off_plane = [end.final.position[:, 1], end.final.velocity[:, 1], end.final.spin[:, 0], end.final.spin[:, 2]]
    assert all(np.all(np.asarray(x) == 0.0) for x in off_plane)


@pytest.mark.parametrize("motion", [Exact(), FINE], ids=["exact", "integrated"])
def test_at_is_the_motion(motion, getkey):
    """at(t) is what a second simulation to t ends with; right-continuous at impacts; NaN outside [t0, t1]."""
    rng, t0, t1 = generator(getkey()), 0.25, 1.25
    scene = Scene(Ball(R, 0.7), room(Rough(0.9)), GRAVITY, None if isinstance(motion, Exact) else Air())
    throw = random_states(rng, 8, -0.85, 0.85, 3.0)
    whole = simulate_batch(scene, throw, t0=t0, t1=t1, max_impacts=16, sum_trains=False, motion=motion)
    times = np.linspace(t0, t1, 11)
    found = stacked(whole.at(times))
    assert found.shape == (8, 11, 9)
    tolerance = 1e-11 if isinstance(motion, Exact) else 1e-6  # air: the steps are others, to the tolerance
    to = jax.jit(
        lambda t: stacked(
            simulate_batch(scene, throw, t0=t0, t1=t, max_impacts=16, sum_trains=False, motion=motion).final
        )
    )
    for i, t in enumerate(times):
        np.testing.assert_allclose(found[:, i], to(jnp.asarray(t)), rtol=0, atol=tolerance * 10)
    np.testing.assert_allclose(found[:, 0], stacked(throw), rtol=0, atol=0)
    outside = stacked(whole.at(jnp.array([t0 - 1e-9, t1 + 1e-9])))
    assert np.all(np.isnan(outside))
    for i in range(2):
        one = lane_of(whole, i)
        n = int(one.n_impacts)
        assert n > 1
        right = stacked(one.at(one.impacts.time[:n]))
        np.testing.assert_array_equal(right, stacked(one.impacts.after)[:n])
        left = stacked(one.at(one.impacts.time[:n] - 1e-9))
        np.testing.assert_allclose(left, stacked(one.impacts.before)[:n], rtol=0, atol=1e-6)


def lane_of(trajectory, i):
    """One lane as a trajectory of its own: the scene has no leading axis."""
    rest = dataclasses.replace(trajectory, system=None, motion=None)
    return dataclasses.replace(lane(rest, i), system=trajectory.system, motion=trajectory.motion)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_orientation_turns_with_the_spin(dtype, getkey):
    """dq/dt = (0, omega) q / 2: a turn about a fixed axis between impacts; unit length always; None stays None."""
    scene = Scene(Ball(R, 0.7), {"floor": floor()}, GRAVITY)
    q = jnp.asarray([1.0, 0.0, 0.0, 0.0], dtype)
    base = [jnp.asarray(x, dtype) for x in ([0, 0, 2.0], [0, 0, 0.0], [0.0, 0.0, 3.0])]
    end = simulate(scene, BallState(*base, q), t1=0.5).final
    angle = 1.5
    expected = np.array([np.cos(angle / 2), 0, 0, np.sin(angle / 2)])
    assert end.orientation.dtype == dtype
    np.testing.assert_allclose(end.orientation, expected, rtol=0, atol=8 * np.finfo(dtype).eps)
    tumbling = simulate(scene, BallState(base[0], base[1] + 1, base[2] + 5, q), t1=2.0).final
    assert abs(float(jnp.linalg.norm(tumbling.orientation)) - 1) < 32 * np.finfo(dtype).eps
    assert simulate(scene, BallState(*base), t1=0.5).final.orientation is None
