"""After the last bounce: trains against sums of single bounces, rolling against its closed forms, walls and edges."""

import dataclasses
import pathlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import result_of, results_of, stacked

from nonholo_jax import (
    KINDS,
    Air,
    Ball,
    BallState,
    Box,
    Exact,
    Integrated,
    Plane,
    Rectangle,
    Rough,
    Scene,
    Smooth,
    Sphere,
    collide,
    energy,
    simulate,
    simulate_batch,
)
from nonholo_jax._math.types import kind_name
from nonholo_jax.scene_file import load_scene

R, MASS, ALPHA, G = 0.1, 0.7, 0.4, 9.81
UP, STILL = (0.0, 0.0, 1.0), (0.0, 0.0, 0.0)
TILTED = (0.2, -0.1, 1.0)
BALL = Ball(R, MASS, ALPHA)
THROW = BallState([0.1, -0.2, 1.0], [1.0, 0.4, -0.5], [3.0, -4.0, 5.0])
LAWS = {
    "common": Rough(0.7),
    "separate": Rough(0.6, tangential=0.3),
    "negative": Rough(0.8, tangential=-0.5),
    "resonant": Rough(0.5, tangential=-0.5),
    "near_resonant": Rough(0.5, tangential=-0.5 + 1e-7),
    "no_reversal": Rough(0.7, tangential=0.0),
    "smooth": Smooth(0.7),
}
motions = pytest.mark.parametrize("motion", [Exact(), Integrated(rtol=1e-11, atol=1e-11)], ids=["exact", "integrated"])


def plane_scene(law, normal=UP, **options):
    return Scene(BALL, {"plane": Plane(STILL, normal, law)}, **options)


def kinds(trajectory):
    return [kind_name(trajectory.impacts.kind, i) for i in range(int(trajectory.n_impacts))]


def row(tree, i):
    return jax.tree.map(lambda x: x[i], tree)


def contact_velocity(state, normal):
    return state.velocity - R * jnp.cross(state.spin, jnp.asarray(normal) / np.linalg.norm(normal))


def bounced_by_hand(law, normal, state, count):
    """The state after `count` more bounces, and the time: flight by flight, impacts by the projector of Lemma 1."""
    n = np.asarray(normal) / np.linalg.norm(normal)
    metric = jnp.diag(jnp.asarray([1.0] * 3 + [ALPHA * R * R] * 3))
    turn = -R * np.cross(np.eye(3), n).T  # omega -> the velocity of the contact point that it gives
    across = np.eye(3) - np.outer(n, n)
    tangential = jnp.asarray(np.hstack([across, turn]))
    along = jnp.asarray(np.concatenate([n, np.zeros(3)])[None])
    e_n, e_t = law.restitution, law.reversal()
    gravity, time = np.array([0.0, 0.0, -G]), 0.0
    x, v = np.asarray(state.position), np.concatenate([state.velocity, state.spin])
    hit = jax.jit(lambda v: collide(collide(v, metric, along, e_n), metric, tangential, e_t))
    for _ in range(count):
        flight = -2.0 * (v[:3] @ n) / (gravity @ n)
        x, time = x + v[:3] * flight + 0.5 * gravity * flight**2, time + flight
        x = x - ((x @ n) - R) * n
        v[:3] += gravity * flight
        v = np.array(hit(jnp.asarray(v)))
    return x, v, time


# Trains


def summed_and_single(law):
    """One batch of all coefficients and slopes of a class of laws: trains summed, every bounce computed, and the states
    of both at some times within the train."""
    cases = [(each, normal) for each in LAWS.values() if type(each) is law for normal in (UP, TILTED)]

    @jax.jit
    @jax.vmap
    def run(e_n, e_t, normal):
        scene = plane_scene(Rough(e_n, tangential=e_t) if law is Rough else Smooth(e_n), normal)
        summed = simulate(scene, THROW, t1=4.0, max_impacts=2)
        single = simulate(scene, THROW, t1=4.0, sum_trains=False, max_impacts=200)
        begin, end = summed.impacts.time[0], summed.impacts.until[0]
        times = begin + (end - begin) * jnp.linspace(0.0, 0.999, 57)
        within = [stacked(each.at(times)) for each in (summed, single)]
        strip = lambda each: dataclasses.replace(each, system=None, motion=None)  # noqa: E731
        return strip(summed), strip(single), within

    columns = zip(*[(each.restitution, each.reversal(), normal) for each, normal in cases], strict=True)
    return cases, *run(*[jnp.asarray(column) for column in columns])


@pytest.fixture(scope="module", params=[Rough, Smooth], ids=["rough", "smooth"])
def trains(request):
    return summed_and_single(request.param)


def test_train_is_the_sum_of_its_bounces(trains):
    """Times, place, velocity and spin at the end against 200 bounces by hand, and against every bounce computed."""
    cases, summed, single, _ = trains
    assert results_of(summed) == ["reached_t1"] * len(cases)
    for i, (law, normal) in enumerate(cases):
        assert kinds(row(summed, i)) == ["train"]
        log = row(row(summed.impacts, i), 0)
        x, v, lasts = bounced_by_hand(law, normal, row(row(single.impacts.after, i), 0), 200)
        np.testing.assert_allclose(float(log.until), float(log.time) + lasts, rtol=1e-12)
        np.testing.assert_allclose(log.after.position, x, rtol=1e-12, atol=1e-13)
        after = np.concatenate([log.after.velocity, log.after.spin])
        np.testing.assert_allclose(after, v, rtol=1e-12, atol=1e-12)
        # 200 of them, or fewer where the normal velocity has sunk to the rounding of the others.
        np.testing.assert_allclose(float(log.until), float(single.t1[i]), rtol=1e-12)
        np.testing.assert_allclose(log.after.position, single.final.position[i], rtol=1e-12, atol=1e-12)


def test_states_within_a_train_are_those_of_its_bounces(trains):
    _, _, _, (a, b) = trains
    # A time of a bounce is known to rounding only, and the velocity jumps there.
    np.testing.assert_allclose(a, b, rtol=0, atol=1e-10)


def test_published_end_of_a_train():
    """Drop from 1 m, g = 9.8, e = 0.5: t = 3 sqrt(2 / 9.8), exact (SciML's documentation reaches it to 8e-13)."""
    scene = Scene(BALL, {"floor": Plane(STILL, UP, Rough(0.5))}, gravity=(0.0, 0.0, -9.8))
    trajectory = simulate(scene, BallState([0.0, 0.0, 1.0 + R], STILL, STILL), t1=2.0)
    assert result_of(trajectory) == "at_rest" and kinds(trajectory) == ["train"]
    assert abs(float(trajectory.t1) - 3.0 * np.sqrt(2.0 / 9.8)) <= 4 * np.finfo(float).eps


def test_plastic_impact_is_the_limit_of_trains():
    end = lambda e, normal: stacked(simulate(plane_scene(Rough(e), normal), THROW, t1=2.0).final)  # noqa: E731
    both = jax.jit(lambda e, normal: jax.jvp(lambda e: end(e, normal), (e,), (jnp.ones_like(e),)))
    for normal in (jnp.asarray(UP), jnp.asarray(TILTED)):
        plastic, nearly = both(jnp.asarray(0.0), normal), both(jnp.asarray(1e-9), normal)
        np.testing.assert_allclose(plastic[0], nearly[0], rtol=0, atol=1e-7)
        np.testing.assert_allclose(plastic[1], nearly[1], rtol=0, atol=1e-6)


def test_bounces_on_where_another_surface_is_near():
    """Beside a wall that could be reached the ball bounces honestly until it cannot; the sum changes nothing."""
    law = Rough(0.7)
    near = Scene(BALL, {"floor": Plane(STILL, UP, law), "wall": Plane((3.0, 0.0, 0.0), (-1.0, 0.0, 0.0), law)})
    far = Scene(BALL, {"floor": Plane(STILL, UP, law)})
    t1 = 3.0
    a, b = (simulate(scene, THROW, t1=t1) for scene in (near, far))
    assert kinds(b) == ["train"] and kinds(a).count("bounce") >= 2 and kinds(a)[-1] == "train"
    assert (np.asarray(a.impacts.surface[: int(a.n_impacts)]) == 0).all()
    np.testing.assert_allclose(stacked(a.final), stacked(b.final), rtol=0, atol=1e-12)


def test_scene_of_dying_bounces():
    """The scene file, on a box: the train's end equals the sum of its bounces, and energy never increases."""
    file = load_scene(pathlib.Path(__file__).parents[2] / "experiments" / "scenes" / "dying_bounces.toml")
    assert file.simulate is not None
    options = file.simulate.arguments
    trajectory = simulate(file.scene, file.throw, **options)
    assert result_of(trajectory) == "reached_t1" and {"train", "rolling", "left"} <= set(kinds(trajectory))
    options |= {"sum_trains": False, "max_impacts": 200, "throw": False}
    each = simulate(file.scene, file.throw, **options)
    first = kinds(trajectory).index("train")
    np.testing.assert_allclose(float(trajectory.impacts.until[first]), float(each.t1), rtol=1e-12)
    end = row(trajectory.impacts.after, first)
    np.testing.assert_allclose(end.position, each.final.position, rtol=1e-12, atol=1e-13)
    states = trajectory.at(jnp.linspace(0.0, trajectory.t1, 2001))
    values = energy(file.scene, states)
    assert float(jnp.max(jnp.diff(values))) <= 1e-14 * float(values[0])


# Rolling


@motions
@pytest.mark.parametrize("law", [Rough(0.5), Smooth(0.5)], ids=["rough", "smooth"])
def test_rolling_down_a_slope(law, motion):
    """Acceleration g sin(theta) / (1 + alpha) along the slope (textbook), g sin(theta) where it slides."""
    trajectory = simulate(plane_scene(law, TILTED), THROW, t1=3.0, motion=motion)
    start, begin = row(trajectory.impacts.after, 0), trajectory.impacts.until[0]
    n = jnp.asarray(TILTED) / np.linalg.norm(TILTED)
    g = jnp.array([0.0, 0.0, -G])
    a = (g - (g @ n) * n) / (1.0 + ALPHA * law.rolls)
    t = trajectory.t1 - begin
    np.testing.assert_allclose(trajectory.final.velocity, start.velocity + a * t, rtol=0, atol=1e-12)
    place = start.position + start.velocity * t + 0.5 * a * t * t
    np.testing.assert_allclose(trajectory.final.position, place, rtol=0, atol=1e-11)
    slip = contact_velocity(trajectory.final, TILTED)
    if law.rolls:
        np.testing.assert_allclose(slip, 0.0, atol=1e-12)
    else:
        np.testing.assert_array_equal(trajectory.final.spin, THROW.spin)
    assert trajectory.final.spin @ n == pytest.approx(float(THROW.spin @ n), abs=1e-12)


def rolling(velocity, pivot=0.0, height=0.0, **fields):
    """A state that rolls on a level floor."""
    vx, vy = velocity
    return BallState([0.0, 0.0, height + R], [vx, vy, 0.0], [-vy / R, vx / R, pivot], **fields)


@motions
def test_rolling_ball_meets_a_wall(motion):
    """Theorem 5.1 and section 6: (v1, v2, omega3) from A and B of the paper, by the projector."""

    @jax.jit
    def run(mu):
        floor, wall = Plane(STILL, UP, Rough(0.5)), Plane((-1.0, 0.0, 0.0), (1.0, 0.0, 0.0), Rough(mu))
        state = rolling((-2.0, 0.7), pivot=4.0)
        return simulate(Scene(BALL, {"floor": floor, "wall": wall}), state, t1=1.0, motion=motion)

    b = jnp.array([[1.0, 0, 0, 0, 0], [0, 1.0, 0, 0, -R], [0, 0, 0, 1.0, 0], [0, 1.0, R, 0, 0]])
    metric = MASS * jnp.diag(jnp.array([1.0, 1.0, *[ALPHA * R * R] * 3]))
    for mu in (0.0, 0.5, 0.8, 1.0):
        trajectory = run(mu)
        assert kinds(trajectory) == ["train", "rolling"]
        before, after = row(trajectory.impacts.before, 1), row(trajectory.impacts.after, 1)
        want = collide(jnp.concatenate([before.velocity[:2], before.spin]), metric, b, mu)
        np.testing.assert_allclose(jnp.concatenate([after.velocity[:2], after.spin]), want, rtol=0, atol=1e-12)
        assert float(after.velocity[2]) == 0.0 and int(trajectory.impacts.support[1]) == 0


@pytest.mark.parametrize("lean", [-0.4, 0.4], ids=["over the ball", "away from it"])
def test_any_wall_by_the_stacked_projector(lean):
    """A wall that leans, met while rolling on a slope: both contacts' rows in one B, which is rank-deficient; or, if it
    leans away, so that the slope would have to pull, its own alone."""
    n1, n2 = (np.asarray(n) / np.linalg.norm(n) for n in (TILTED, (-1.0, 0.3, lean)))
    scene = Scene(
        BALL, {"slope": Plane(STILL, TILTED, Rough(0.5)), "wall": Plane((0.5, 0.0, 0.0), tuple(n2), Rough(0.6))}
    )
    v = np.cross([0.1, 2.0, 0.3], n1) + 1.0 * np.cross(np.cross(n1, [1.0, 0.0, 0.0]), n1)
    spin = np.cross(n1, v) / R + 3.0 * n1
    trajectory = simulate(scene, BallState(R * n1, v, spin), t1=0.4)
    stays = n1 @ n2 <= 0
    assert stays == (lean < 0) and kinds(trajectory)[:2] == ["train", "rolling" if stays else "bounce"]
    rows = [np.hstack([np.eye(3), -R * np.cross(np.eye(3), n).T]) for n in ((n1, n2) if stays else (n2,))]
    metric = jnp.diag(jnp.asarray([1.0] * 3 + [ALPHA * R * R] * 3))
    before, after = (
        jnp.concatenate([s.velocity[1], s.spin[1]]) for s in (trajectory.impacts.before, trajectory.impacts.after)
    )
    want = collide(before, metric, jnp.asarray(np.vstack(rows)), 0.6)
    np.testing.assert_allclose(after, want, rtol=0, atol=1e-12)


def test_separate_coefficients_at_a_wall():
    """The support is the paper's A: roughness does not lift the ball off it. Within its kernel the wall's normal and
    its slip are one direction where the ball comes straight, and e_n decides."""
    floor = Plane(STILL, UP, Rough(0.5))
    wall = Plane((-1.0, 0.0, 0.0), (1.0, 0.0, 0.0), Rough(0.8, tangential=0.2))
    trajectory = simulate(Scene(BALL, {"floor": floor, "wall": wall}), rolling((-2.0, 0.0)), t1=0.6)
    assert kinds(trajectory)[:2] == ["train", "rolling"] and int(trajectory.impacts.support[1]) == 0
    np.testing.assert_allclose(trajectory.impacts.after.velocity[1], [1.6, 0.0, 0.0], atol=1e-13)
    np.testing.assert_allclose(trajectory.impacts.after.spin[1], [0.0, 1.6 / R, 0.0], atol=1e-12)


@pytest.mark.parametrize("law", [Rough(0.5), Smooth(0.5)], ids=["rolls", "slides"])
def test_smooth_wall_turns_the_ball_round(law):
    scene = Scene(BALL, {"floor": Plane(STILL, UP, law), "wall": Plane((-1.0, 0.0, 0.0), (1.0, 0.0, 0.0), Smooth(0.9))})
    trajectory = simulate(scene, rolling((-2.0, 0.5), pivot=3.0), t1=0.8)
    assert kinds(trajectory) == ["train", "rolling"]
    np.testing.assert_allclose(trajectory.final.velocity, [1.8, 0.5, 0.0], atol=1e-12)
    np.testing.assert_allclose(trajectory.final.spin[2], 3.0, atol=1e-12)
    spin_y = 1.8 / R if law.rolls else -2.0 / R
    np.testing.assert_allclose(trajectory.final.spin[1], spin_y, atol=1e-12)


def tables():
    law = Rough(0.5)
    half = (0.5, 0.4, 0.05)
    return {
        "box": Box((0.0, 0.0, 1.0), half, law),
        "rotated": Box((0.0, 0.0, 1.0), half, law, rotation=(np.cos(0.15), 0.0, 0.0, np.sin(0.15))),
        "plate": Rectangle((0.0, 0.0, 1.05), UP, (1.0, 0.0, 0.0), half[:2], law),
    }


EDGES = {name: (table, Exact()) for name, table in tables().items()} | {
    "integrated": (tables()["rotated"], Integrated(rtol=1e-11, atol=1e-11))
}


@pytest.mark.parametrize("table, motion", EDGES.values(), ids=EDGES)
def test_ball_flies_off_an_edge(table, motion):
    scene = Scene(BALL, {"floor": Plane(STILL, UP, Rough(0.0)), "table": table})
    state = rolling((1.6, 0.3), height=1.05)
    trajectory = simulate(scene, state, t1=1.0, motion=motion)
    assert kinds(trajectory) == ["train", "left", "train"]
    edge = row(trajectory.impacts.after, 1)
    assert abs(float(table.gap(edge.position, radius=R))) < 1e-9
    np.testing.assert_allclose(edge.velocity, state.velocity, atol=1e-9)
    floor = float(trajectory.impacts.time[2] - trajectory.impacts.time[1])
    assert floor == pytest.approx(np.sqrt(2 * 1.05 / G), rel=1e-9)
    if not isinstance(table, Box) or table.rotation is None:
        assert float(edge.position[0]) == pytest.approx(0.5, abs=1e-9)


@pytest.mark.parametrize("wall", [Rough(0.5), Smooth(0.3), Rough(0.0)], ids=["rough", "smooth", "plastic"])
def test_rolls_down_to_a_wall_and_comes_to_rest(wall):
    """Ever lower rebounds from the wall, whose times are a geometric series; along the groove it would roll on."""
    slope = {"floor": Plane(STILL, (0.2, 0.0, 1.0), Rough(0.5)), "wall": Plane((2.0, 0.0, 0.0), (-1.0, 0.0, 0.0), wall)}
    state = BallState([0.0, 0.0, 0.3], STILL, STILL)
    trajectory = simulate(Scene(BALL, slope), state, t1=9.0)
    assert result_of(trajectory) == "at_rest"
    first, mu = kinds(trajectory).index("rolling"), wall.restitution
    speed, pull = np.linalg.norm(trajectory.impacts.before.velocity[first]), G * 0.2 / np.sqrt(1.04) / (1.0 + ALPHA)
    rests = float(trajectory.impacts.time[first]) + 2.0 * mu * speed / (pull * (1.0 - mu))
    np.testing.assert_allclose(float(trajectory.t1), rests, rtol=0, atol=1e-6)
    np.testing.assert_allclose(stacked(trajectory.final)[3:], 0.0, atol=1e-12)
    moving = dataclasses.replace(state, velocity=jnp.asarray([0.0, 0.3, 0.0]))
    stays = simulate(Scene(BALL, slope), moving, t1=9.0, motion=Exact(), throw=False)
    assert result_of(stays) == "sustained_contact"


def test_slow_ball_tips_by_name():
    """v^2 < g r at the edge: it would pivot."""
    scene, options = Scene(BALL, {"table": tables()["box"]}), {"t1": 2.0, "motion": Exact(), "throw": False}
    limit = np.sqrt(G * R)
    ends = [simulate(scene, rolling((f * limit, 0.0), height=1.05), **options) for f in (0.99, 1.01)]
    assert [result_of(end) for end in ends] == ["pivoting", "reached_t1"]


def test_resting_in_a_bowl_is_followed_where_a_motion_is_chosen_and_named_where_it_is_not():
    law, below = Rough(0.5), (0.0, 0.0, -1.0)
    bowl = Scene(BALL, {"bowl": Sphere((0.0, 0.0, 1.0), 1.0, law, inside=True), "floor": Plane(below, UP, law)})
    for motion, result in ((None, "at_rest"), (Exact(), "sustained_contact")):
        end = simulate(
            bowl, BallState([0.0, 0.0, 0.9], STILL, STILL), t1=9.0, motion=motion, throw=False, max_impacts=200
        )
        assert result_of(end) == result


# All of it together


def course(e, tilt=0.0, radius=R, g=G, **options):
    """A table with a wall at one end, above a floor with a fence. Its numbers are arrays, for one program."""
    law, tilt = Rough(jnp.asarray(e)), jnp.asarray(tilt)
    return Scene(
        Ball(radius, MASS, ALPHA),
        {
            "floor": Plane(STILL, UP, law),
            "table": Box((0.0, 0.0, 0.5), (1.5, 0.8, 0.05), law),
            "wall": Plane((1.5, 0.0, 0.0), (-1.0, tilt, 0.0), law),
            "fence": Plane((-3.0, 0.0, 0.0), (1.0, 0.0, 0.0), law),
        },
        gravity=jnp.stack([jnp.zeros_like(g), jnp.zeros_like(g), -g]) if isinstance(g, jax.Array) else (0.0, 0.0, -g),
        **options,
    )


START = BallState([-0.5, 0.0, 0.9], [2.4, 0.1, 0.0], [1.0, -2.0, 3.0])


@pytest.mark.parametrize("air", [None, Air(drag=0.4, lift=0.5)], ids=["vacuum", "air"])
def test_energy_never_increases_and_nothing_is_passed(air):
    scene = course(0.6, 0.05, air=air)
    trajectory = simulate(scene, START, t1=6.0 if air is None else 3.0)
    seen = kinds(trajectory)
    assert {"bounce", "train", "rolling"} <= set(seen), seen
    states = trajectory.at(jnp.linspace(0.0, trajectory.t1, 3001))
    values = energy(scene, states)
    assert float(jnp.max(jnp.diff(values))) <= 1e-9 * float(values[0])
    gaps = [jax.vmap(lambda x, s=surface: s.gap(x, radius=R))(states.position) for surface in scene.surfaces]
    assert float(jnp.min(jnp.stack(gaps))) > -1e-9


def test_motions_agree_after_the_last_bounce():
    """Exact and Integrated log the same, and `at` continues from any row."""
    other = Integrated(rtol=1e-11, atol=1e-11)
    a, b = (simulate(course(0.6, 0.05), START, t1=6.0, motion=motion) for motion in (None, other))
    assert kinds(a) == kinds(b)
    np.testing.assert_allclose(stacked(a.final), stacked(b.final), rtol=0, atol=1e-8)
    times = jnp.linspace(0.0, 6.0, 23)
    np.testing.assert_allclose(stacked(a.at(times))[:, :3], stacked(b.at(times))[:, :3], rtol=0, atol=1e-8)


def test_single_precision_and_batches(getkey):
    spread = 0.05 * jax.random.normal(getkey(), (32, 3))
    throws = BallState(*[x[None] + k * spread for x, k in zip(jax.tree.leaves(START), (0.0, 1.0, 1.0), strict=True)])
    wide = simulate_batch(course(0.6), throws, t1=2.0)
    one = simulate(course(0.6), row(throws, 3), t1=2.0)
    np.testing.assert_allclose(stacked(row(wide.final, 3)), stacked(one.final), rtol=0, atol=1e-11)
    narrow = jax.tree.map(lambda x: x.astype(jnp.float32), throws)
    single = simulate_batch(course(0.6), narrow, t1=2.0)
    assert single.final.position.dtype == jnp.float32
    same = (single.impacts.kind == wide.impacts.kind).all(axis=1)
    assert int(same.sum()) > 20
    np.testing.assert_allclose(single.final.position[same], wide.final.position[same], rtol=0, atol=2e-3)


PARAMETERS = jnp.array([0.6, 0.05, R, G, 2.4, 0.1, 1.0, -2.0, 3.0])


def after_all(p, t1):
    """The final state, and when every event was over."""
    e, tilt, radius, g, vx, vy, *spin = p
    state = BallState(START.position, jnp.stack([vx, vy, 0.0 * vx]), jnp.stack(spin))
    trajectory = simulate(course(e, tilt, radius, g), state, t1=t1, max_impacts=16, throw=False)
    until = jnp.where(trajectory.impacts.surface >= 0, trajectory.impacts.until, 0.0)
    return jnp.concatenate([stacked(trajectory.final), until])


def test_gradients_through_train_rolling_wall_and_edge():
    """Both modes, and central differences of fourth order: while it rolls, after the wall, and after the edge."""
    value = jax.jit(jax.vmap(after_all, in_axes=(0, None)))
    modes = [jax.jit(mode(after_all)) for mode in (jax.jacfwd, jax.jacrev)]
    h = 2e-5
    points = [PARAMETERS + k * h * step for k in (1, -1, 2, -2) for step in jnp.eye(PARAMETERS.size)]
    for t1 in (1.05, 3.0, 4.6):
        forward, reverse = (mode(PARAMETERS, t1) for mode in modes)
        assert bool(jnp.isfinite(forward).all() & jnp.isfinite(reverse).all())
        scale = 1.0 + jnp.abs(forward)
        np.testing.assert_allclose(reverse / scale, forward / scale, rtol=0, atol=1e-10)
        near, back, far, farther = value(jnp.stack(points), t1).reshape(4, PARAMETERS.size, -1)
        difference = ((8.0 * (near - back) - (far - farther)) / (12.0 * h)).T
        np.testing.assert_allclose(forward / scale, difference / scale, rtol=0, atol=1e-6)


def test_no_rolling_where_no_bounce_can_die_out():
    """Elastic scenes pay nothing: their program has no other phase."""
    elastic = simulate(plane_scene(Rough()), THROW, t1=0.1)
    assert type(elastic.system) is Scene
    assert bool((elastic.impacts.kind == KINDS.unused)[1:].all())


# Corners


@pytest.mark.parametrize("wall", [Rough, Smooth], ids=["rough", "smooth"])
def test_floor_and_wall_hit_at_one_instant(wall):
    """One impact by the stacked projector, whose rows are dependent; elastic, it conserves energy and undoes itself."""

    def corner(mu):
        floor, side = Plane(STILL, UP, Rough(mu)), Plane(STILL, (1.0, 0.0, 0.0), wall(mu))
        return Scene(BALL, {"floor": floor, "wall": side}, gravity=STILL)

    state = BallState([0.6, 0.0, 0.6], [-1.0, 0.3, -1.0], [1.0, 2.0, 3.0])
    run = jax.jit(lambda mu: simulate(corner(mu), state, t1=0.9, sum_trains=False))
    metric = jnp.diag(jnp.asarray([1.0] * 3 + [ALPHA * R * R] * 3))
    blocks = []
    for n, law in ((UP, Rough), ((1.0, 0.0, 0.0), wall)):
        full = np.hstack([np.eye(3), -R * np.cross(np.eye(3), n).T])
        blocks.append(full if law is Rough else np.concatenate([n, np.zeros(3)])[None])
    before = jnp.concatenate([state.velocity, state.spin])
    for mu in (1.0, 0.6, 0.1):
        trajectory = run(mu)
        assert int(trajectory.n_impacts) == 1
        after = jnp.concatenate([trajectory.impacts.after.velocity[0], trajectory.impacts.after.spin[0]])
        want = collide(before, metric, jnp.asarray(np.vstack(blocks)), mu)
        np.testing.assert_allclose(after, want, rtol=0, atol=1e-13)
    end = lambda v: simulate(corner(1.0), BallState(state.position, v, state.spin), t1=0.9, throw=False)  # noqa: E731
    slow = jax.jit(jax.jacrev(lambda v: end(v).final.velocity))
    assert bool(jnp.isfinite(slow(state.velocity)).all())


def test_nearly_at_one_instant_resolves_in_order():
    """However close two impacts are, each ends as one named motion; with two coefficients they follow one another."""
    floor = Plane(STILL, UP, Rough(jnp.asarray(0.8)))
    side = Plane(STILL, (1.0, 0.0, 0.0), Rough(jnp.asarray(0.9)))
    offsets = jnp.concatenate([jnp.array([0.0]), 10.0 ** jnp.arange(-16.0, -1.0)])
    position = jnp.array([[0.6, 0.0, 0.6]]) + offsets[:, None] * jnp.array([[1.0, 0.0, 0.0]])
    states = BallState(position, jnp.tile(jnp.array([-1.0, 0.3, -1.0]), (16, 1)), jnp.ones((16, 3)))
    for law in (floor.law, side.law):
        scene = Scene(BALL, {"floor": floor, "wall": Plane(STILL, (1.0, 0.0, 0.0), law)}, gravity=STILL)
        batch = simulate_batch(scene, states, t1=0.9, sum_trains=False)
        assert results_of(batch) == ["reached_t1"] * 16
        assert (np.asarray(batch.n_impacts) <= 4).all() and (np.asarray(batch.n_impacts) >= 1).all()
        assert (np.asarray(batch.final.position[:, ::2]) >= R - 1e-12).all()
