"""Coulomb friction after the last bounce: the ball slides until it rolls."""

import dataclasses

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import result_of, results_of, stacked

from nonholo_jax import (
    Air,
    Ball,
    BallState,
    Box,
    Exact,
    Frictional,
    Integrated,
    Plane,
    Rough,
    Scene,
    Smooth,
    energy,
    simulate,
    simulate_batch,
    slip,
)
from nonholo_jax._math.types import kind_name
from nonholo_jax._staying.floors import _asked_once

R, MASS, ALPHA, G = 0.1, 0.7, 0.4, 9.81
BALL = Ball(R, MASS, ALPHA)
UP, SLOPE = (0.0, 0.0, 1.0), (0.2, 0.0, 1.0)
TAN = 0.2  # of the slope
TIGHT = Integrated(rtol=1e-11, atol=1e-11)
motions = pytest.mark.parametrize("motion", [Exact(), TIGHT], ids=["exact", "integrated"])


def plane_scene(law, normal=UP):
    return Scene(BALL, {"plane": Plane((0.0, 0.0, 0.0), normal, law)})


def throw(velocity, spin):
    return BallState([0.0, 0.0, 0.3], velocity, spin)


def kinds(trajectory, lane=None):
    kind, count = trajectory.impacts.kind, trajectory.n_impacts
    if lane is not None:
        kind, count = jax.tree.map(lambda x: x[lane], (kind, count))
    return [kind_name(kind, i) for i in range(int(count))]


def lane_of(tree, i):
    return jax.tree.map(lambda x: x[i], tree)


def slip_of(state, normal):
    n = np.asarray(normal) / np.linalg.norm(normal)
    contact = np.asarray(state.velocity) - R * np.cross(np.asarray(state.spin), n)
    return contact - np.outer(contact @ n, n).reshape(contact.shape)


# e_n, e_t, f, normal, velocity, spin: straight along the slope, where there is one
STRAIGHT = {
    "slips_on": (0.7, 0.2, 0.05, UP, (4.0, 1.0, -0.5), (3.0, -4.0, 5.0)),
    "slips_with_backspin": (0.5, 0.4, 0.1, UP, (2.0, 0.0, 0.0), (0.0, -60.0, 0.0)),
    "slips_then_grips": (0.7, 0.2, 0.2, UP, (4.0, 1.0, -0.5), (3.0, -4.0, 5.0)),
    "grips": (0.6, -0.3, 0.5, UP, (0.5, 0.4, -0.5), (0.0, 0.0, 5.0)),
    "keeps_its_slip": (0.7, -1.0, 0.5, UP, (1.0, 0.4, -0.5), (0.0, 0.0, 5.0)),
    "plastic": (0.0, 0.3, 0.1, UP, (4.0, 1.0, -0.5), (3.0, -4.0, 5.0)),
    "no_friction": (0.6, 0.3, 0.0, SLOPE, (1.0, 2.0, -0.5), (3.0, -4.0, 5.0)),
    "downhill": (0.7, 0.2, 0.05, SLOPE, (4.0, 0.0, -0.5), (0.0, -4.0, 0.0)),
    "uphill_and_back": (0.5, 0.2, 0.03, SLOPE, (-4.0, 0.0, -0.5), (0.0, -4.0, 0.0)),
    "uphill_then_rolls": (0.3, 0.2, 0.06, SLOPE, (-4.0, 0.0, -0.5), (0.0, -4.0, 0.0)),
}


@pytest.fixture(scope="module")
def straight():
    """All cases by one program: trains summed and then on to t1, and every bounce computed."""

    @jax.jit  # which shows where two copies of one number, rounded in two ways, would lead into two branches
    @jax.vmap
    def run(e_n, e_t, f, normal, velocity, spin):
        scene, state = plane_scene(Frictional(e_n, e_t, f), normal), throw(velocity, spin)
        summed = simulate(scene, state, t1=4.0, max_impacts=16, motion=Exact())
        single = simulate(scene, state, t1=4.0, sum_trains=False, max_impacts=250, motion=Exact())
        times = jnp.linspace(0.0, 4.0, 81)
        strip = lambda each: dataclasses.replace(each, system=None, motion=None)  # noqa: E731
        return (
            strip(summed),
            strip(single),
            summed.at(times),
            stacked(single.at(times)),
            energy(scene, summed.at(times)),
        )

    columns = [jnp.asarray(column) for column in zip(*STRAIGHT.values(), strict=True)]
    return run(*columns)


def test_train_is_the_sum_of_its_bounces(straight):
    """Time, place, velocity and spin at the end, and the states within, against every bounce computed."""
    summed, single, within, each, _ = straight
    for i, name in enumerate(STRAIGHT):
        row = kinds(summed, i).index("train")
        log = lane_of(lane_of(summed.impacts, i), row)
        np.testing.assert_allclose(float(log.until), float(single.t1[i]), rtol=1e-12, err_msg=name)
        end, ends = stacked(log.after), stacked(lane_of(single.final, i))
        np.testing.assert_allclose(end, ends, rtol=0, atol=1e-11, err_msg=name)
        before = np.linspace(0.0, 4.0, 81) < float(log.until)
        np.testing.assert_allclose(
            stacked(lane_of(within, i))[before], each[i][before], rtol=0, atol=1e-10, err_msg=name
        )


def test_slides_until_it_rolls(straight):
    """Textbook: the slip decays at f g (1 + 1/alpha), less what gravity adds, the centre at f g; and then it rolls."""
    summed, *_ = straight
    assert results_of(summed) == ["reached_t1"] * len(STRAIGHT)
    assert kinds(summed, list(STRAIGHT).index("slips_then_grips"))[-1] == "train"
    for i, (name, (_, _, f, normal, *_)) in enumerate(STRAIGHT.items()):
        logged, n = kinds(summed, i), np.asarray(normal) / np.linalg.norm(normal)
        if name in ("keeps_its_slip", "no_friction", "grips", "slips_then_grips"):
            assert "gripped" not in logged
            continue
        begin = lane_of(lane_of(summed.impacts, i), logged.index("train"))
        u = slip_of(begin.after, normal)
        size, pull, g = np.linalg.norm(u), G * n[2], np.array([0.0, 0.0, -G]) + G * n[2] * n
        decay = f * pull * (1.0 + 1.0 / ALPHA) - g @ u / size
        if decay < 0:  # downhill, and too steep to stop
            assert logged[-1] == "train" and name == "downhill"
            continue
        end = lane_of(lane_of(summed.impacts, i), logged.index("gripped"))
        t = size / decay
        np.testing.assert_allclose(float(end.time - begin.until), t, rtol=1e-12)
        v = begin.after.velocity + (g - f * pull * u / size) * t
        np.testing.assert_allclose(end.after.velocity, v, rtol=0, atol=1e-12)
        np.testing.assert_allclose(slip_of(end.after, normal), 0.0, atol=1e-14)
        rolls = f >= TAN * ALPHA / (1.0 + ALPHA) if normal == SLOPE else True
        share = 1.0 / (1.0 + ALPHA) if rolls else 1.0
        left = float(summed.t1[i] - end.time)
        a = share * g - (0.0 if rolls else f * pull * np.array([g[0], 0.0, g[2]]) / np.linalg.norm(g))
        final = lane_of(summed.final, i)
        np.testing.assert_allclose(final.velocity, end.after.velocity + a * left, rtol=0, atol=1e-11)
        assert (np.linalg.norm(slip_of(final, normal)) < 1e-12) == rolls, name


def test_angular_momentum_about_the_contact_and_energy(straight):
    """Friction at the contact point leaves v + alpha r (omega x n) alone, and never adds energy."""
    summed, _, states, _, energies = straight
    for i, (name, (*_, normal, _, _)) in enumerate(STRAIGHT.items()):
        n = np.asarray(normal) / np.linalg.norm(normal)
        state = lane_of(states, i)
        moment = np.asarray(state.velocity) + ALPHA * R * np.cross(np.asarray(state.spin), n)
        along = moment - np.outer(moment @ n, n)
        g = np.array([0.0, 0.0, -G]) + G * n[2] * n
        np.testing.assert_allclose(along, along[0] + np.linspace(0, 4, 81)[:, None] * g, atol=1e-10, err_msg=name)
        assert np.diff(energies[i]).max() <= 1e-13 * float(energies[i, 0]), name
    del summed


@pytest.fixture(scope="module")
def across():
    """Across a slope, by the solver: friction that holds a rolling ball, and friction that does not."""

    @jax.jit
    @jax.vmap
    def run(friction, spin):
        scene = plane_scene(Frictional(0.0, 0.2, friction), SLOPE)
        trajectory = simulate(scene, throw((0.5, 1.5, -0.5), spin), t1=3.0, max_impacts=8, motion=TIGHT)
        start, end = trajectory.impacts.until[0], trajectory.impacts.time[1]
        end = jnp.where(trajectory.n_impacts > 1, end, 3.0)
        times = start + (end - start) * jnp.linspace(0.0, 0.9, 41)  # at the very end the angle is 0 to rounding
        return dataclasses.replace(trajectory, system=None, motion=None), times, trajectory.at(times)

    cases = [(0.08, (0.0, 9.0, 0.0)), (0.3, (-30.0, 0.0, 4.0)), (0.03, (-30.0, 0.0, 4.0))]
    return cases, *run(*[jnp.asarray(column) for column in zip(*cases, strict=True)])


def test_slides_across_a_slope(across):
    """Closed forms in the angle phi between slip and gravity along the slope, h = |g_t|: u sin(phi) / tan(phi/2)^(F/h)
    is constant, and u (F + h cos(phi)) falls by F^2 - h^2 a second, so that it tells when the ball rolls."""
    cases, trajectory, times, states = across
    n = np.asarray(SLOPE) / np.linalg.norm(SLOPE)
    g = np.array([0.0, 0.0, -G]) + G * n[2] * n
    h = np.linalg.norm(g)
    for i, (f, _) in enumerate(cases):
        most = f * G * n[2] * (1.0 + 1.0 / ALPHA)
        u = slip_of(lane_of(states, i), SLOPE)
        size, cosine = np.linalg.norm(u, axis=1), u @ g / h / np.linalg.norm(u, axis=1)
        clock = size * (most + h * cosine)
        falls = clock[0] - (most**2 - h**2) * np.asarray(times[i] - times[i, 0])
        np.testing.assert_allclose(clock, falls, rtol=1e-8, atol=1e-8)
        sine = np.sqrt(1.0 - cosine**2)
        constant = size * sine * ((1.0 + cosine) / sine) ** (most / h)
        np.testing.assert_allclose(constant, constant[0], rtol=1e-6)
        if most > h:
            assert kinds(trajectory, i) == ["train", "gripped"]
            rolls = float(times[i, 0]) + clock[0] / (most**2 - h**2)
            np.testing.assert_allclose(float(trajectory.impacts.time[i, 1]), rolls, rtol=1e-8)
        else:
            assert kinds(trajectory, i) == ["train"]
    assert results_of(trajectory) == ["reached_t1"] * len(cases)


def test_slides_across_a_slope_that_it_could_hardly_roll_on():
    """F = 1.01 h: the direction settles a hundred times as fast as the slip dies out, and the end is still found."""
    n = np.asarray(SLOPE) / np.linalg.norm(SLOPE)
    h, most = TAN * G * n[2], 1.01 * TAN * G * n[2]
    scene = plane_scene(Frictional(0.0, 0.2, 1.01 * TAN * ALPHA / (1.0 + ALPHA)), SLOPE)
    state = BallState([0.0, 0.0, R / n[2] + 1e-3], [0.0, 0.1, -0.1], [0.0, 0.0, 0.0])
    trajectory = simulate(scene, state, t1=6.0)
    assert kinds(trajectory) == ["train", "gripped"] and int(trajectory.n_arcs) < 150
    start = slip_of(lane_of(trajectory.impacts.after, 0), SLOPE)
    clock = np.linalg.norm(start) * most + start @ (np.array([0.0, 0.0, -G]) + G * n[2] * n)
    lasts = float(trajectory.impacts.time[1] - trajectory.impacts.until[0])
    np.testing.assert_allclose(lasts, clock / (most**2 - h**2), rtol=1e-5)


def test_motion_that_a_slope_needs():
    """A known slope is integrated by default; asked for parabolas, the motion ends with a name before it slides."""
    state = throw((0.5, 1.5, -0.5), (-30.0, 0.0, 4.0))
    slope, level = (plane_scene(Frictional(0.5, 0.2, 0.1), normal) for normal in (SLOPE, UP))
    assert isinstance(simulate(slope, state, t1=0.1).motion, Integrated)
    assert isinstance(simulate(level, state, t1=0.1).motion, Exact)
    trajectory = simulate(slope, state, t1=3.0, motion=Exact(), throw=False)
    assert result_of(trajectory) == "curved_slide"


def test_between_rough_and_smooth(straight):
    """Much friction is the rough law; none, or e_t = -1, the smooth one."""
    summed, *_ = straight

    def final(name, law):
        _, _, _, normal, velocity, spin = STRAIGHT[name]
        return simulate(plane_scene(law, normal), throw(velocity, spin), t1=4.0, motion=Exact()).final

    for name, law in (("grips", Rough(0.6, -0.3)), ("keeps_its_slip", Smooth(0.7)), ("no_friction", Smooth(0.6))):
        mine = lane_of(summed.final, list(STRAIGHT).index(name))
        np.testing.assert_allclose(stacked(mine), stacked(final(name, law)), rtol=0, atol=1e-11, err_msg=name)


def test_impacts_of_both_kinds_are_bounced():
    """|e_t| > e_n: impacts that slip and impacts that grip follow each other to the end, which is rolling."""
    scene, state = plane_scene(Frictional(0.4, 0.8, 0.1)), throw((1.0, 0.0, -0.5), (0.0, 0.0, 0.0))
    trajectory = simulate(scene, state, t1=2.0, max_impacts=100)
    logged = kinds(trajectory)
    assert "train" not in logged and logged.count("bounce") > 20 and logged[-1] in ("rolling", "gripped")
    np.testing.assert_allclose(slip(scene, trajectory.final, "plane"), 0.0, atol=1e-12)
    np.testing.assert_allclose(trajectory.final.velocity, [1.0 / (1.0 + ALPHA), 0.0, 0.0], atol=1e-12)


@motions
def test_smooth_wall_makes_a_rolling_ball_slide(motion):
    """The wall turns the velocity round, not the spin: the ball slips at 2 v, then rolls on more slowly."""
    table = Box((0.0, 0.0, -0.1), (1.0, 1.0, 0.1), Frictional(0.0, 0.0, 0.5))
    wall = Plane((0.8, 0.0, 0.0), (-1.0, 0.0, 0.0), Smooth(1.0))
    scene = Scene(BALL, {"table": table, "wall": wall})
    speed = 3.0
    state = BallState([0.0, 0.1, R], [speed, 0.0, -1.0], [0.0, speed / R, 3.0])
    trajectory = simulate(scene, state, t1=3.0, motion=motion)
    assert kinds(trajectory) == ["train", "rolling", "gripped", "left"], kinds(trajectory)
    log = trajectory.impacts
    np.testing.assert_allclose(log.after.velocity[1], [-speed, 0.0, 0.0], atol=1e-9)
    np.testing.assert_allclose(log.after.spin[1], [0.0, speed / R, 3.0], atol=1e-9)
    slid = float(log.time[2] - log.time[1])
    np.testing.assert_allclose(slid, 2.0 * speed / (0.5 * G * (1.0 + 1.0 / ALPHA)), rtol=1e-8)
    rolls = -speed * (1.0 - ALPHA) / (1.0 + ALPHA)  # the angular momentum about the contact stays
    np.testing.assert_allclose(log.after.velocity[2], [rolls, 0.0, 0.0], atol=1e-8)


def test_gradients_through_a_slide():
    """Forward, reverse and fourth-order differences through train, slide, grip and rolling."""

    def end(p):
        scene = Scene(
            Ball(p[6], MASS, p[7]),
            {"plane": Plane((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), Frictional(p[8], p[9], p[10]))},
            gravity=(0.0, 0.0, -p[11]),
        )
        state = BallState(
            jnp.concatenate([p[:2], jnp.asarray([0.3])]), p[jnp.asarray([2, 3, 4])], jnp.stack([p[5], p[5], p[5]])
        )
        trajectory = simulate(scene, state, t1=3.0, max_impacts=8, motion=Exact())
        return jnp.concatenate([stacked(trajectory.final), trajectory.impacts.time[:2]])

    p = jnp.asarray([0.1, -0.2, 4.0, 1.0, -0.5, 3.0, R, ALPHA, 0.6, 0.3, 0.08, G])
    forward, reverse = jax.jit(lambda p: (jax.jacfwd(end)(p), jax.jacrev(end)(p)))(p)
    value = jax.jit(jax.vmap(end))
    h = 1e-3
    steps = h * jnp.eye(p.size)
    a, b = (value(jnp.concatenate([p[None] + k * steps, p[None] - k * steps])) for k in (1.0, 2.0))
    a, b = ((x[: p.size] - x[p.size :]).T for x in (a, b))
    np.testing.assert_allclose(forward, reverse, rtol=1e-10, atol=1e-10)
    np.testing.assert_allclose(forward, (8.0 * a - b) / (12.0 * h), rtol=1e-6, atol=1e-6)
    assert np.abs(forward[0, 10]) > 1e-3


def test_gradients_with_air():
    """The same by a solver, on a table with a wall: bounces, train, slide, wall, slide back to it, rolling along it."""
    steps = {"solver": diffrax.Heun(), "stepsize_controller": diffrax.ConstantStepSize(), "dt0": 0.02}
    motion = Integrated(**steps, atol=1e-13)  # the sum of a train may neglect only what differences do not see

    def end(p, t1):
        e, f, vx, vy, turn, drag = p
        surfaces = {
            "table": Box((1.0, 0.0, -0.1), (2.0, 2.0, 0.1), Frictional(e, 0.1 * e, f)),
            "wall": Plane((2.2, 0.0, 0.0), (-1.0, 0.0, 0.0), Smooth(e)),
        }
        state = throw(jnp.stack([vx, vy, 0.0 * vx]), jnp.stack([0.0 * vx, turn, 0.0 * vx]))
        scene = Scene(BALL, surfaces, air=Air(drag=drag, lift=0.3))
        trajectory = simulate(scene, state, t1=t1, motion=motion, max_impacts=20, throw=False)
        return jnp.concatenate([stacked(trajectory.final), trajectory.n_impacts[None].astype(p.dtype)])

    p, h = jnp.asarray([0.3, 0.2, 3.5, 0.3, -20.0, 0.3]), 2e-5
    modes = [jax.jit(mode(end)) for mode in (jax.jacfwd, jax.jacrev)]
    value = jax.jit(jax.vmap(end, in_axes=(0, None)))
    points = jnp.stack([p + k * h * step for k in (1, -1, 2, -2) for step in jnp.eye(p.size)])
    for t1, least in ((0.6, 11), (1.1, 12), (2.0, 13)):
        forward, reverse = (mode(p, t1) for mode in modes)
        near, back, far, farther = value(points, t1).reshape(4, p.size, -1)
        assert near[:, -1].min() == farther[:, -1].max() >= least
        difference = ((8.0 * (near - back) - (far - farther)) / (12.0 * h)).T
        scale = 1.0 + jnp.abs(forward)
        np.testing.assert_allclose(reverse / scale, forward / scale, rtol=0, atol=1e-10)
        np.testing.assert_allclose(forward / scale, difference / scale, rtol=0, atol=1e-6)


def test_single_precision():
    cast = lambda x: jnp.asarray(x, dtype=jnp.float32)  # noqa: E731
    e_n, e_t, f, normal, velocity, spin = STRAIGHT["uphill_then_rolls"]
    state = BallState(cast([0.0, 0.0, 0.3]), cast(velocity), cast(spin))
    scene = plane_scene(Frictional(e_n, e_t, f), normal)
    a = simulate(scene, state, t1=4.0, motion=Exact())
    b = simulate(scene, throw(velocity, spin), t1=4.0, motion=Exact())
    assert a.final.position.dtype == jnp.float32 and kinds(a) == kinds(b)
    np.testing.assert_allclose(stacked(a.final), stacked(b.final), rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@motions
def test_times_between_of_a_batch_that_slides_and_rolls(motion, dtype):
    """From the last row of the log on a ball rolls at constant velocity. Computed twice with other roundings, the slip
    of a rolling ball was 0 once and 1e-17 once, and a fifth of the lanes went on sliding."""
    n, rng, eps = 100, np.random.default_rng(0), float(np.finfo(dtype).eps)
    scene = plane_scene(Frictional(0.0, 0.0, 0.7))
    velocity = np.concatenate([rng.standard_normal((n, 2)), np.full((n, 1), -0.1)], axis=1)
    parts = ([[0.0, 0.0, R]] * n, velocity, 20.0 * rng.standard_normal((n, 3)))
    throws = BallState(*(jnp.asarray(np.asarray(x), dtype) for x in parts))
    if motion is TIGHT and dtype == np.float32:
        motion = Integrated(rtol=1e-5, atol=1e-6)
    batch = simulate_batch(scene, throws, t1=2.0, motion=motion, max_impacts=8)
    ts = jnp.linspace(0.0, 2.0, 21, dtype=dtype)
    log, lane, row = batch.impacts, np.arange(n), np.asarray(batch.n_impacts) - 1
    place, speed, until = (np.asarray(x, float)[lane, row] for x in (log.after.position, log.after.velocity, log.until))
    later = np.asarray(ts, float)[None] >= until[:, None]
    assert later.any(axis=1).all() and set(results_of(batch)) == {"reached_t1"}
    right = place[:, None] + speed[:, None] * (np.asarray(ts, float)[None, :, None] - until[:, None, None])
    error = np.abs(np.asarray(batch.at(ts).position) - right).max(axis=-1)
    assert np.where(later, error, 0.0).max() < 64 * eps * np.abs(right).max()


def test_what_is_known_of_a_scene_is_asked_once_for_each():
    """As long as it is there, and where none of its numbers may change."""
    asked = []

    @_asked_once
    def question(scene, detail):
        asked.append(detail)
        return float(scene.surfaces[0].law.restitution), detail

    def scene(restitution, point=(0.0, 0.0, 0.0)):
        return Scene(Ball(0.1, 1.0), {"floor": Plane(point, (0, 0, 1), Rough(restitution))})

    for e in (0.25, 0.5, 0.75):  # each may lie where the one before has lain
        one = scene(e)
        for detail in (True, False, True):
            assert question(one, detail) == (e, detail)
    assert asked == 3 * [True, False]
    changed = eqx.tree_at(lambda each: each.surfaces[0].law.restitution, one, np.array(0.3))
    for e in (0.3, 0.4):
        changed.surfaces[0].law.restitution[...] = e
        assert question(changed, True) == (e, True)
