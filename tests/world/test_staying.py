"""A ball that stays on a surface of any shape: against closed forms, SciPy on equations written anew here, and itself
turned, moved by other motions, in other dtypes, in batches; and every way in which staying ends."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import result_of, results_of, turned_axes
from scipy.integrate import solve_ivp

from nonholo_jax import (
    RESULTS,
    Air,
    Ball,
    BallState,
    Box,
    Cylinder,
    Exact,
    Frictional,
    Implicit,
    Integrated,
    Plane,
    Rectangle,
    Rough,
    Scene,
    SimulationError,
    Smooth,
    Sphere,
    energy,
    simulate,
    simulate_batch,
)
from nonholo_jax._math.types import kind_name

R, G, ALPHA = 0.1, 9.81, 0.4
BALL = Ball(R, 1.0, ALPHA)
STEPS = Integrated(rtol=1e-10, atol=1e-10, edges=True)
FLIES = Exact(contact=Integrated(rtol=1e-10, atol=1e-10))
motions = pytest.mark.parametrize("motion", [STEPS, FLIES], ids=["integrated", "exact"])
BOWL_LAWS = {"rough": Rough(0.0), "smooth": Smooth(0.0), "frictional": Frictional(0.0, 0.0, 0.15)}


def kinds(trajectory):
    return [kind_name(trajectory.impacts.kind, i) for i in range(int(trajectory.n_rows))]


def run(surfaces, state, t1, motion=FLIES, ball=BALL, **options):
    scene = Scene(ball, surfaces, options.pop("gravity", (0.0, 0.0, -G)), options.pop("air", None))
    return simulate(scene, state, t1=t1, motion=motion, throw=False, **options)


def as_numpy(state):
    return [np.asarray(x, float) for x in (state.position, state.velocity, state.spin)]


# Independent motion: the equations of a ball with its contact force, in the fixed frame, with six numbers more than it
# needs; `normal(x)` and its derivative along v by differences.


def independent(law, normal, start, t1, gravity=(0.0, 0.0, -G), friction=None):
    """Position, velocity and spin at t1 of a ball that stays on a surface: rolling, or slipping against friction, or
    without any; by SciPy."""

    def push(x, v):
        h = 1e-5
        turn = (normal(x + h * v) - normal(x - h * v)) / (2 * h)
        return -turn @ v - normal(x) @ np.array(gravity), turn

    def rate(t, y):
        x, v, w = y[:3], y[3:6], y[6:]
        n, g = normal(x), np.array(gravity)
        pressed, turn = push(x, v)
        force = np.zeros(3)  # along the surface
        if law == "rough":  # what keeps v = r w x n
            slides = g + pressed * n - R * np.cross(w, turn)  # of which (1 + 1 / alpha) times the force takes the rest
            force = -(slides - (slides @ n) * n) / (1.0 + 1.0 / ALPHA)
        elif law == "frictional":
            slip = v - R * np.cross(w, n)
            slip = slip - (slip @ n) * n
            force = -friction * pressed * slip / np.linalg.norm(slip)
        return np.concatenate([v, g + pressed * n + force, np.cross(force, n) / (ALPHA * R)])

    end = solve_ivp(rate, (0.0, t1), np.concatenate(start), rtol=1e-11, atol=1e-12, method="DOP853").y[:, -1]
    return end[:3], end[3:6], end[6:]


def in_bowl(x):
    d = np.array([0.0, 0.0, 1.0]) - x
    return d / np.linalg.norm(d)


def bowl_start(slip=0.0):
    """On the wall of a bowl of radius 1 around (0, 0, 1), with a spin about the normal too."""
    angle = 0.8
    n = np.array([-np.sin(angle), 0.0, np.cos(angle)])
    x, v = (
        np.array([0.0, 0.0, 1.0]) - 0.9 * n,
        np.array([0.0, 0.7, 0.0]) + 0.3 * np.array([np.cos(angle), 0.0, np.sin(angle)]),
    )
    return x, v, np.cross(n, v - slip * np.array([0.0, 1.0, 0.0])) / R + 5.0 * n


@pytest.mark.parametrize("law", BOWL_LAWS, ids=BOWL_LAWS)
def test_in_a_bowl_by_scipy(law):
    slip = 1.5 if law == "frictional" else 0.0
    start = bowl_start(slip)
    t1 = 0.15 if law == "frictional" else 1.3  # before its slip has died out
    out = run({"bowl": Sphere((0, 0, 1), 1.0, BOWL_LAWS[law], inside=True)}, BallState(*start), t1)
    assert result_of(out) == "reached_t1" and kinds(out) == ["train"]
    for got, wanted in zip(as_numpy(out.final), independent(law, in_bowl, start, t1, friction=0.15), strict=True):
        np.testing.assert_allclose(got, wanted, rtol=1e-6, atol=1e-7)
    if law != "frictional":
        scene = out.system.scene
        assert abs(float(energy(scene, out.final)) - float(energy(scene, BallState(*start)))) < 1e-8
    np.testing.assert_allclose(np.linalg.norm(as_numpy(out.final)[0] - [0, 0, 1]), 0.9, rtol=1e-15)


@motions
def test_inside_a_vertical_cylinder_it_goes_up_and_down(motion):
    """In closed form (Routh, 1905): the angle runs evenly, and the height swings with sqrt(alpha / (1 + alpha)) of
    its rate."""
    rho, turning, z_rate, pivot = 0.9, 4.0, 0.3, 2.0
    n = np.array([-1.0, 0.0, 0.0])
    v = np.array([0.0, rho * turning, z_rate])
    state = BallState([rho, 0.0, 0.0], v, np.cross(n, v) / R + pivot * n)
    pipe = Cylinder((0, 0, 0), (0, 0, 1), 1.0, Rough(0.0), inside=True)
    out = run({"pipe": pipe}, state, 2.0, motion)
    rate = turning * np.sqrt(ALPHA / (1 + ALPHA))
    middle = (ALPHA * turning * R * pivot - G) / (ALPHA * turning**2)
    t = np.array([0.5, 1.1, 2.0])
    z = middle - middle * np.cos(rate * t) + z_rate / rate * np.sin(rate * t)
    wanted = np.stack([rho * np.cos(turning * t), rho * np.sin(turning * t), z], axis=-1)
    np.testing.assert_allclose(out.at(jnp.asarray(t)).position, wanted, atol=2e-8)


# How staying ends


@motions
@pytest.mark.parametrize("law", [Rough(0.0), Smooth(0.0)], ids=["rough", "smooth"])
def test_it_leaves_the_crest_of_a_hill(motion, law):
    """Where the push ends: cos = 10/17 for a ball that rolls from rest, 2/3 for one that slides."""
    v, reach = 0.05, 1.1
    state = BallState([0.0, 0.0, R], [v, 0.0, 0.0], [0.0, v / R, 0.0])
    out = run({"hill": Sphere((0, 0, -1), 1.0, law)}, state, 3.0, motion)
    assert kinds(out) == ["train", "left"] and result_of(out) == "reached_t1"
    share = 1.4 if isinstance(law, Rough) else 1.0
    cosine = (2 * G * reach / share + v * v) / (G * reach * (1 + 2 / share))
    assert abs(float(out.impacts.before.position[1, 2]) + 1 - reach * cosine) < 1e-6
    assert int(out.impacts.support[1]) == -1 and float(out.final.position[2]) < -4


@pytest.mark.parametrize("turn", [None, (0.9, 0.3, -0.2, 0.25)], ids=["level", "turned"])
@motions
def test_it_tips_over_an_edge_that_it_is_too_slow_to_fly_off(motion, turn):
    """`pivoting` is a motion: about the edge until the push ends, as over a sphere of the radius of the ball."""
    axes = np.eye(3) if turn is None else turned_axes(jnp.asarray(turn))
    v = 0.3
    table = {"table": Box((0.0, 0.0, 0.0), (1.0, 1.0, 1.0), Rough(0.0), rotation=turn)}
    parts = [jnp.asarray(x, float) @ axes for x in ([0.9, 0.1, 1 + R], [v, 0.0, 0.0], [0.0, v / R, 0.0])]
    scene_gravity = jnp.asarray([0.0, 0.0, -G]) @ axes
    out = run(table, BallState(*parts), 1.0, motion, gravity=scene_gravity)
    assert kinds(out) == ["train", "passed", "left"] and int(out.n_impacts) == 2 and int(out.n_passed) == 1
    height = float((jnp.asarray(axes) @ out.impacts.before.position[2])[2]) - 1.0
    assert abs(height - (2 * G * R / 1.4 + v * v) / (G * (1 + 2 / 1.4))) < 1e-6
    spin = jnp.asarray(axes) @ out.final.spin
    np.testing.assert_allclose(spin[jnp.asarray([0, 2])], 0.0, atol=1e-9)


@motions
def test_over_a_gap_it_turns_about_one_edge_and_meets_the_other(motion):
    """What the impact takes, in closed form: about the second edge the angular momentum stays (e_n = 0, no slip)."""
    law, width, v = Rough(0.0), 0.02, 0.8
    table = {"a": Box((0, 0, -1), (1, 1, 1), law), "b": Box((2.0 + width, 0, -1), (1, 1, 1), law)}
    state = BallState([0.5, 0.0, R], [v, 0.0, 0.0], [0.0, v / R, 0.0])
    out = run(table, state, 2.0, motion)
    assert result_of(out) == "reached_t1"
    drop = R - np.sqrt(R**2 - width**2 / 4)
    fast = np.sqrt(v**2 + 2 * G * drop / 1.4)
    # The contact jumps from one edge to the other, by the angle 2 asin(w / 2r) between the two normals.
    turned = 2 * np.arcsin(width / (2 * R))
    slow = fast * (np.cos(turned) + ALPHA) / (1 + ALPHA)
    wanted = np.sqrt(slow**2 - 2 * G * drop / 1.4)
    np.testing.assert_allclose(out.final.velocity, [wanted, 0.0, 0.0], atol=1e-6)
    # To the rounding of the tops of the boxes, each the sum of -1 and 1.
    np.testing.assert_allclose(out.final.position[2], R, atol=np.finfo(float).eps)


def test_air_lifts_a_rolling_ball():
    """It takes off where the lift is its weight: k v (W - v) = m g, with k = density pi r^2 lift / 2."""
    ball, wind = Ball(0.02, 0.0027, 2 / 3), 20.0
    floor = {"floor": Plane((0, 0, 0), (0, 0, 1), Rough(0.0))}
    state = BallState([0, 0, 0.02], [0.1, 0, 0], [0, 5.0, 0])
    out = run(floor, state, 0.2, Integrated(rtol=1e-9, atol=1e-9), ball, air=Air(wind=(wind, 0.0, 0.0)))
    k = 1.204 * np.pi * 0.02**2 / 2
    takes_off = wind / 2 - np.sqrt(wind**2 / 4 - 0.0027 * G / k)
    row = kinds(out).index("left")
    assert abs(float(out.impacts.before.velocity[row, 0]) - takes_off) < 1e-6
    # In a weaker wind it never does.
    out = run(floor, state, 2.0, Integrated(rtol=1e-9, atol=1e-9), ball, air=Air(wind=(8.0, 0.0, 0.0)))
    assert "left" not in kinds(out) and float(out.final.position[2]) == 0.02


def test_friction_that_cannot_hold_it_lets_it_slip():
    """On a hill of friction f a ball that rolls from rest begins to slip where g sin k = f N, k = alpha / (1 + alpha):
    with N = g cos - v^2 / R and v^2 = 2 g R (1 - cos) / (1 + alpha)."""
    friction, v, reach = 0.2, 1e-3, 1.1
    state = BallState([0.0, 0.0, R], [v, 0.0, 0.0], [0.0, v / R, 0.0])
    out = run({"hill": Sphere((0, 0, -1), 1.0, Frictional(0.0, 0.0, friction))}, state, 5.0)
    assert "slipped" in kinds(out) and kinds(out).index("slipped") < kinds(out).index("left")
    row = kinds(out).index("slipped")
    cosine = (float(out.impacts.before.position[row, 2]) + 1) / reach
    k, fast = ALPHA / (1 + ALPHA), v**2 / (G * reach) + 2 * (1 - cosine) / (1 + ALPHA)
    assert abs(np.sqrt(1 - cosine**2) * k - friction * (cosine - fast)) < 1e-5


# Grooves


ROUGH, SMOOTH, FRICTION = Rough(0.3), Smooth(0.3), Frictional(0.3, 0.0, 0.9)
SIDES = {
    "both rough": (ROUGH, ROUGH),
    "both smooth": (SMOOTH, SMOOTH),
    "one rough": (ROUGH, SMOOTH),
    "friction": (FRICTION, FRICTION),
}


def valley(laws, opening=0.6, tilt=0.1):
    """Two planes that meet along y, each `opening` from the upright, under a gravity that is tilted along them."""
    n = np.array([np.cos(opening), 0.0, np.sin(opening)])
    planes = {"left": Plane((0, 0, 0), n, laws[0]), "right": Plane((0, 0, 0), n * [-1, 1, 1], laws[1])}
    return planes, R / np.sin(opening), (0.0, -G * np.sin(tilt), -G * np.cos(tilt))


@motions
@pytest.mark.parametrize("laws", SIDES.values(), ids=SIDES)
def test_along_a_groove(laws, motion):
    """In closed form: gripped at both sides it is as heavy as 1 + alpha |Omega|^2 r^2 says, with v = Omega x r n."""
    opening, tilt = 0.6, 0.1
    planes, height, gravity = valley(laws, opening, tilt)
    out = run(planes, BallState([0, 0, height + 0.01], [0, 0.3, 0], [-3.0, 0, 0]), 1.5, motion, gravity=gravity,
              max_impacts=300)  # fmt: skip
    assert result_of(out) == "reached_t1" and "groove" in kinds(out)
    # With friction it may come in with a little slip, which soon ends.
    assert kinds(out)[-1] in (("groove", "gripped") if laws[0] is FRICTION else ("groove",))
    row = int(out.n_rows) - 1
    assert {int(out.impacts.support[row]), int(out.impacts.beside[row])} == {0, 1}
    grips = [not isinstance(law, Smooth) for law in laws]
    # The two contacts lie r sin(opening) below the centre: about that line a ball turns that grips at both.
    share = {0: 1.0, 1: 1.0 + ALPHA, 2: 1.0 + ALPHA / np.sin(opening) ** 2}[sum(grips)]
    start = float(out.impacts.until[row])
    x, v = (np.asarray(part[row]) for part in (out.impacts.after.position, out.impacts.after.velocity))
    dt, a = 1.5 - start, -G * np.sin(tilt) / share
    np.testing.assert_allclose(out.final.position, [0.0, x[1] + v[1] * dt + 0.5 * a * dt**2, height], atol=1e-7)
    np.testing.assert_allclose(out.final.velocity, [0.0, v[1] + a * dt, 0.0], atol=1e-7)
    middle = out.at(jnp.asarray(start + 0.5 * dt))
    np.testing.assert_allclose(middle.velocity[1], v[1] + 0.5 * a * dt, atol=1e-7)


@motions
def test_round_a_post_in_a_bowl(motion):
    """Smooth: a circle with one push from the bowl and one from the post, at an even speed; energy and height stay."""
    bowl = Sphere((0, 0, 1), 1.0, Smooth(0.0), inside=True)
    post = Cylinder((0, 0, 0), (0, 0, 1), 0.3, Smooth(0.0))
    rho = 0.4
    z, v = 1.0 - np.sqrt(0.9**2 - rho**2), 0.5
    out = run({"bowl": bowl, "post": post}, BallState([rho, 0, z], [0, v, 0], [0, 0, 0]), 2.0, motion, max_impacts=300)
    assert result_of(out) == "reached_t1" and "groove" in kinds(out)
    turned = 2.0 * v / rho
    np.testing.assert_allclose(out.final.position, [rho * np.cos(turned), rho * np.sin(turned), z], atol=1e-6)
    # Faster than v^2 = g rho tan(slope) the bowl carries it away from the post.
    fast = 1.2 * np.sqrt(G * rho * rho / np.sqrt(0.81 - rho**2))
    out = run(
        {"bowl": bowl, "post": post}, BallState([rho, 0, z], [0, fast, 0], [0, 0, 0]), 1.0, motion, max_impacts=300
    )
    assert "groove" not in kinds(out) and result_of(out) == "reached_t1"


def test_in_a_corner_it_comes_to_rest():
    """Against a wall across the groove, which holds it there."""
    planes, height, gravity = valley(SIDES["both rough"])
    planes["end"] = Plane((0, -1.0, 0), (0, 1, 0), Rough(0.3))
    out = run(planes, BallState([0, 0, height + 0.01], [0, 0.0, 0], [0, 0, 0]), 20.0, gravity=gravity, max_impacts=500)
    assert result_of(out) == "at_rest"
    np.testing.assert_allclose(out.final.position, [0.0, -1.0 + R, height], atol=1e-7)


# Elastic surfaces, resistance


@motions
def test_rest_is_rest_on_an_elastic_floor(motion):
    floor = {"floor": Plane((0, 0, 0), (0, 0, 1), Rough())}
    out = run(floor, BallState([0, 0, R], [0, 0, 0], [0, 0, 0]), 1.0, motion)
    assert result_of(out) == "at_rest" and float(out.final.position[2]) == R
    out = run(floor, BallState([0, 0, R], [1.0, 0, 0], [0, 10.0, 0]), 1.0, motion)
    np.testing.assert_allclose(out.final.position, [1.0, 0.0, R], rtol=1e-12)


@pytest.mark.parametrize("motion", [None, STEPS, FLIES], ids=["chosen", "integrated", "exact"])
@pytest.mark.parametrize("kind", ["rough", "frictional"])
def test_a_putt_stops(motion, kind):
    """A Stimpmeter putt: 1.83 m/s and c = 0.056 make 3.05 m. The spin about the normal is gone before."""
    losses = {"rolling": 0.056, "spinning": 0.02}
    law = Rough(0.5, **losses) if kind == "rough" else Frictional(0.5, 0.2, 0.4, **losses)
    ball, v = Ball(0.0213, 0.0459), 1.83
    state = BallState([0, 0, 0.0213], [v, 0, 0], [0, v / 0.0213, 30.0])
    out = run({"green": Plane((0, 0, 0), (0, 0, 1), law)}, state, 8.0, motion, ball)
    assert result_of(out) == "at_rest" and kinds(out)[-1] == "stopped"
    np.testing.assert_allclose(out.t1, v / (0.056 * G), rtol=1e-9)
    np.testing.assert_allclose(out.final.position, [v**2 / (2 * 0.056 * G), 0.0, 0.0213], atol=1e-9)
    assert np.all(np.asarray(out.final.velocity) == 0) and np.all(np.abs(np.asarray(out.final.spin)) < 1e-12)
    early = out.at(jnp.asarray(0.5))
    np.testing.assert_allclose(early.spin[2], 30.0 - 0.5 * 0.02 * G / (0.4 * 0.0213), rtol=1e-9)
    np.testing.assert_allclose(early.velocity[0], v - 0.5 * 0.056 * G, rtol=1e-9)


@pytest.mark.parametrize("motion", [None, FLIES], ids=["chosen", "exact"])
def test_a_putt_across_a_slope(motion):
    """By SciPy in the plane of the slope; it comes to rest where resistance holds it."""
    angle, c, r = np.arctan(0.03), 0.056, 0.0213
    n, down = np.array([np.sin(angle), 0, np.cos(angle)]), np.array([np.cos(angle), 0, -np.sin(angle)])
    across = np.array([0.0, 1.0, 0.0])
    green = {"green": Plane((0, 0, 0), n, Rough(0.5, rolling=c))}
    out = run(green, BallState(r * n, across, np.cross(n, across) / r), 8.0, motion, Ball(r, 0.0459))

    def rate(t, y):
        return [*y[2:], *(np.array([G * np.sin(angle) / 1.4, 0]) - c * G * np.cos(angle) * y[2:] / np.hypot(*y[2:]))]

    def slow(t, y):
        return np.hypot(*y[2:]) - 1e-9

    slow.terminal = True
    end = solve_ivp(rate, (0, 8), [0, 0, 0, 1.0], rtol=1e-11, atol=1e-13, events=slow)
    x, y = end.y[:2, -1]
    assert result_of(out) == "at_rest"
    np.testing.assert_allclose(out.final.position, r * n + x * down + y * across, atol=1e-6)


# The same scene, said otherwise


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("law", ["rough", "smooth"])
def test_a_bowl_turned_implicit_batched_jitted(law, dtype):
    """One state in four scenes that are one, in a batch and alone, in both dtypes."""
    x, v, w = (np.asarray(part) for part in bowl_start())
    law, axes = BOWL_LAWS[law], np.asarray(turned_axes(jnp.asarray((0.9, 0.3, -0.2, 0.25))))
    center = np.array([0.0, 0.0, 1.0])

    def gap(x, t):
        away = x - jnp.asarray(center, x.dtype)
        return 0.9 - jnp.sqrt(jnp.sum(away * away))

    tolerance = 2e-3 if dtype == np.float32 else 1e-7
    motion = Exact(Integrated(rtol=1e-5, atol=1e-5)) if dtype == np.float32 else FLIES
    plain = Scene(BALL, {"bowl": Sphere(center, 1.0, law, inside=True)})
    turned = Scene(BALL, {"bowl": Sphere(center @ axes, 1.0, law, inside=True)}, gravity=np.array([0, 0, -G]) @ axes)
    said = Scene(BALL, {"bowl": Implicit(gap, law, curvature=3.0)})
    state = lambda *parts: BallState(*[jnp.asarray(part, dtype) for part in parts])  # noqa: E731
    ends = []
    for scene, start, back in ((plain, (x, v, w), np.eye(3)), (turned, (x @ axes, v @ axes, w @ axes), axes),
                               (said, (x, v, w), np.eye(3))):  # fmt: skip
        out = simulate(scene, state(*start), t1=1.0, motion=motion, throw=False)
        assert result_of(out) == "reached_t1" and out.final.position.dtype == dtype
        ends.append(np.concatenate([part @ back.T for part in as_numpy(out.final)[:2]]))
    batch = jax.tree.map(lambda a: jnp.stack([a, a]), state(x, v, w))
    many = simulate_batch(plain, batch, t1=1.0, motion=motion)
    ends.append(np.concatenate([np.asarray(part[1], float) for part in (many.final.position, many.final.velocity)]))
    for other in ends[1:]:
        np.testing.assert_allclose(other, ends[0], atol=tolerance)


def test_at_is_simulate_until_then():
    table = {
        "table": Box((0, 0, -1), (1, 1, 1), Rough(0.0)),
        "bowl": Sphere((1.5, 0, 0.0), 2.0, Rough(0.3), inside=True),
    }
    state = BallState([0.9, 0.0, R], [0.3, 0.1, 0.0], [-1.0, 3.0, 1.0])
    whole = run(table, state, 2.0)
    assert {"passed", "left", "bounce"} <= set(kinds(whole)) and result_of(whole) == "reached_t1"
    for t in (0.2, 0.5, 0.6, 1.0, 2.0):
        part = run(table, state, t)
        for a, b in zip(as_numpy(whole.at(jnp.asarray(t))), as_numpy(part.final), strict=True):
            np.testing.assert_allclose(a, b, atol=1e-6)


@functools.cache
def moved(kind):
    """The end of a motion as a function of three numbers: the speed, a size of the scene, a coefficient."""

    def end(numbers):
        speed, size, c = numbers
        if kind == "bowl":
            scene = Scene(BALL, {"bowl": Sphere((0.0, 0.0, 1.0), size, Rough(0.0, rolling=c), inside=True)})
            n = jnp.asarray(bowl_start()[0]) - jnp.asarray([0.0, 0.0, 1.0])
            x = jnp.asarray([0.0, 0.0, 1.0]) + n / 0.9 * (size - R)
            v, w = (jnp.asarray(part) * speed for part in bowl_start()[1:])
            state = BallState(x, v, w)
        elif kind == "crest":
            scene = Scene(BALL, {"hill": Sphere((0.0, 0.0, -size), size, Frictional(0.0, 0.0, 5.0 * c))})
            state = BallState(jnp.asarray([0.0, 0.0, R]), speed * jnp.asarray([0.3, 0.1, 0.0]),
                              speed / R * jnp.asarray([-0.1, 0.3, 0.0]))  # fmt: skip
        else:
            scene = Scene(BALL, {"table": Box((0.0, 0.0, -1.0), (size, 1.0, 1.0), Rough(c))})
            state = BallState(jnp.asarray([0.9, 0.0, R]), speed * jnp.asarray([0.3, 0.05, 0.0]),
                              speed / R * jnp.asarray([-0.05, 0.3, 0.2]))  # fmt: skip
        out = simulate(scene, state, t1=1.5 if kind == "crest" else 0.9, motion=FLIES, throw=False, log_size=0)
        return jnp.concatenate([out.final.position, out.final.velocity, R * out.final.spin])

    return jax.jit(end), jax.jit(jax.jacrev(end)), jax.jit(jax.jacfwd(end))


@pytest.mark.parametrize("kind", ["bowl", "crest", "edge"])
def test_derivatives_in_both_modes_against_differences(kind):
    end, reverse, forward = moved(kind)
    at, h = jnp.asarray([1.0, 1.0, 0.05]), 1e-4
    differences = np.stack([(end(at + h * e) - end(at - h * e)) / (2 * h) for e in np.eye(3)], axis=-1)
    got = np.asarray(reverse(at))
    np.testing.assert_allclose(got, forward(at), rtol=1e-6, atol=1e-7)
    np.testing.assert_allclose(got, differences, rtol=2e-4, atol=2e-4)
    assert np.max(np.abs(got[:, 0])) > 0.1 and np.max(np.abs(got[:, 1])) > 0.01


def slip_on_a_crest(friction, later):
    """When a ball that rolls over a ball of radius 1 begins to slip, and its slip some time later, by SciPy: all along
    one great circle, with the angle and the speeds of the centre and of the rim."""
    rho, push = 1.0 + R, lambda y: G * np.cos(y[0]) - y[1] ** 2 / (1.0 + R)
    options = {"rtol": 1e-13, "atol": 1e-15, "method": "DOP853"}
    spare = lambda t, y: friction * push(y) * (1 + 1 / ALPHA) - G * np.sin(y[0])  # noqa: E731
    spare.terminal = True
    rolls = lambda t, y: [y[1] / rho, G * np.sin(y[0]) / (1 + ALPHA)]  # noqa: E731
    found = solve_ivp(rolls, (0.0, 2.0), [0.0, np.hypot(0.3, 0.1)], events=spare, **options)
    begins, (angle, speed) = found.t_events[0][0], found.y_events[0][0]
    slips = lambda t, y: [y[1] / rho, G * np.sin(y[0]) - friction * push(y), friction * push(y) / ALPHA]  # noqa: E731
    _, centre, rim = solve_ivp(slips, (0.0, later), [angle, speed, speed], **options).y[:, -1]
    return begins, centre - rim


def test_a_slip_that_begins_on_a_crest_goes_along_as_the_normal_turns():
    """Whichever way rounding puts the moment at which it begins."""
    frictions = 0.25 + 5e-4 * np.arange(-6, 7)
    wanted = np.array([slip_on_a_crest(f, 0.1) for f in frictions])

    def end(friction, t1):
        scene = Scene(BALL, {"hill": Sphere((0.0, 0.0, -1.0), 1.0, Frictional(0.0, 0.0, friction))})
        state = BallState(*[jnp.asarray(x) for x in ([0.0, 0.0, R], [0.3, 0.1, 0.0], [-0.1 / R, 0.3 / R, 0.0])])
        out = simulate(scene, state, t1=t1, motion=FLIES, throw=False, log_size=4)
        return out.impacts.time[1], jnp.linalg.norm(out.final.velocity) - R * jnp.linalg.norm(out.final.spin)

    begins, slips = jax.jit(jax.vmap(end))(jnp.asarray(frictions), jnp.asarray(wanted[:, 0] + 0.1))
    np.testing.assert_allclose(begins, wanted[:, 0], atol=1e-9)
    np.testing.assert_allclose(slips, wanted[:, 1], rtol=5e-8)


def test_it_tips_over_the_edge_of_a_thin_plate_as_over_that_of_a_box():
    state = BallState([0.95, 0.0, R], [0.05, 0.02, 0.0], [-0.02 / R, 0.05 / R, 0.3])
    plate = Rectangle((0, 0, 0), (0, 0, 1), (1, 0, 0), (1.0, 1.0), Rough(0.0))
    ends = [run({"top": top}, state, 1.8) for top in (plate, Box((0, 0, -0.5), (1, 1, 0.5), Rough(0.0)))]
    assert [kinds(out) for out in ends] == [["train", "passed", "left"]] * 2
    for a, b in zip(*[as_numpy(out.final) for out in ends], strict=True):
        np.testing.assert_allclose(a, b, atol=1e-7)


def test_refusals_name_the_remedy():
    table = {"table": Box((0, 0, -1), (1, 1, 1), Rough(0.5))}
    state = BallState([0.9, 0.0, R], [0.3, 0.0, 0.0], [0.0, 3.0, 0.0])
    out = run(table, state, 1.0, Exact())
    assert result_of(out) == "pivoting"
    with pytest.raises(SimulationError, match="contact=Integrated"):
        simulate(Scene(BALL, table), state, t1=1.0, motion=Exact())
    # Where no motion is asked for, and nothing is traced, it is found by a second try.
    again, asked = run(table, state, 1.0, None), run(table, state, 1.0, Exact(contact=Integrated()))
    np.testing.assert_array_equal(again.final.position, asked.final.position)
    traced = jax.jit(lambda state: run(table, state, 1.0, None).result)(state)
    assert traced == RESULTS.pivoting
    with pytest.raises(ValueError, match="`contact` must be None or Integrated"):
        Exact(contact=Exact())
    with pytest.raises(ValueError, match="`rolling` must not be negative"):
        Rough(0.5, rolling=-0.1)


def test_batches_of_any_end():
    """Lanes that fly, roll, tip over and rest beside each other, each with a result."""
    table = {
        "table": Box((0, 0, -1), (1, 1, 1), Rough(0.3, rolling=0.01)),
        "bowl": Sphere((0, 0, 0), 6.0, Rough(0.3), inside=True),
    }
    x = jnp.asarray([0.0, 0.9, 0.5, 2.0])
    v = jnp.asarray([0.0, 0.3, 2.0, 0.0])
    zero = jnp.zeros_like(x)
    states = BallState(
        jnp.stack([x, zero, zero + R], 1), jnp.stack([v, zero, zero], 1), jnp.stack([zero, v / R, zero], 1)
    )
    out = simulate_batch(Scene(BALL, table), states, t1=3.0, motion=Exact(Integrated()), max_impacts=100)
    assert results_of(out) == ["at_rest", "reached_t1", "reached_t1", "reached_t1"]
    assert np.all(np.linalg.norm(np.asarray(out.final.position), axis=1) <= 5.9 + 1e-9)
