"""A ball that slips against friction in the groove between two surfaces, against Newton's and Euler's equations solved
as one linear system by NumPy, stepped by SciPy, with no code of the library."""

import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from nonholo_jax import (
    KINDS,
    RESULTS,
    Ball,
    BallState,
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
)
from nonholo_jax._impact import groove
from nonholo_jax._impact.rolling import along_surface
from nonholo_jax._math import add, components, norm, ratio, scale

R, G, ALPHA, FULL = 0.1, 9.81, 0.4, 1e-8
RHO, BOWL = 0.4, 0.9  # how far the centre is from the axis of the post, and from the middle of the bowl


def valley(one, two):
    """Two planes that meet along y, at these angles from the upright."""
    n = np.array([np.cos(one), 0.0, np.sin(one)]), np.array([-np.cos(two), 0.0, np.sin(two)])
    return lambda theta: (n, np.zeros((2, 3)), np.inf)


def round_the_post(theta):
    """The normals of bowl and post where the ball is at that angle, how they turn with it, and how far it goes."""
    c, s = np.cos(theta), np.sin(theta)
    low = np.sqrt(BOWL**2 - RHO**2)
    n = np.array([-RHO * c, -RHO * s, low]) / BOWL, np.array([c, s, 0.0])
    return n, np.array([[RHO * s, -RHO * c, 0.0], [-s * BOWL, c * BOWL, 0.0]]) / BOWL, RHO


def cross(k):
    return np.array([[0, -k[2], k[1]], [k[2], 0, -k[0]], [-k[1], k[0], 0]])


class Reference:
    """The motion in a groove. `y` is the angle, the speed along n1 x n2, and the spin."""

    def __init__(self, groove, friction, gravity):
        self.groove, self.friction, self.gravity = groove, friction, gravity

    def frame(self, y):
        n, turns, reach = self.groove(y[0])
        e = np.cross(*n)
        e = e / np.linalg.norm(e)
        rate = 0.0 if np.isinf(reach) else y[1] / reach * np.sign(e @ np.array([-np.sin(y[0]), np.cos(y[0]), 0.0]))
        return n, turns * rate, e, rate

    def slips(self, y):
        n, _, e, _ = self.frame(y)
        return [y[1] * e - R * np.cross(y[2:], k) for k in n]

    def balance(self, y, held):
        """Acceleration, rate of the spin, pushes and friction: Newton, Euler, the two normals, and on each side either
        no slip or Coulomb's law; what is across the groove is shared where both hold."""
        n, turns, e, _ = self.frame(y)
        a, rows, right = np.eye(14), [], []
        acceleration, spins, push, force = a[:3], a[3:6], a[6:8], (a[8:11], a[11:14])
        rows.extend(acceleration - force[0] - force[1] - np.outer(n[0], push[0]) - np.outer(n[1], push[1]))
        right.extend(self.gravity)
        rows.extend(ALPHA * R * spins + cross(n[0]) @ force[0] + cross(n[1]) @ force[1])
        right.extend(np.zeros(3))
        for i, slip in enumerate(self.slips(y)):
            rows.append(n[i] @ acceleration)
            right.append(-y[1] * (e @ turns[i]))
            if held[i]:
                across = np.eye(3) - np.outer(n[i], n[i])
                rows.extend(across @ (acceleration + R * cross(n[i]) @ spins) + np.outer(n[i], n[i]) @ force[i])
                right.extend(across @ (R * np.cross(y[2:], turns[i])))
            else:
                rows.extend(force[i] + self.friction[i] * np.outer(slip / np.linalg.norm(slip), push[i]))
                right.extend(np.zeros(3))
        if all(held):
            rows.append(np.cross(e, n[0]) @ force[0] - np.cross(e, n[1]) @ force[1])
            right.append(0.0)
        found = np.linalg.lstsq(np.array(rows), np.array(right), rcond=None)[0]
        return found[:3], found[3:6], found[6:8], found[8:].reshape(2, 3)

    def rate(self, t, y, held):
        a, spins, *_ = self.balance(y, held)
        *_, e, rate = self.frame(y)
        return [rate, a @ e, *spins]

    def spare(self, y, held):
        """By how much friction could do more on both sides; where both hold, along the groove; and then across it."""
        n, _, e, _ = self.frame(y)
        _, _, push, force = self.balance(y, held)
        used = [abs(f @ e) if all(held) else np.linalg.norm(f) for f in force]
        left = [(mu * p - u) if h else 1.0 for mu, p, u, h in zip(self.friction, push, used, held, strict=True)]
        if not all(held):
            return [*left, 1.0]
        able = [np.sqrt(max((mu * p) ** 2 - u**2, 0)) for mu, p, u in zip(self.friction, push, used, strict=True)]
        return [*left, sum(able) - abs(sum(np.cross(e, k) @ f for k, f in zip(n, force, strict=True)))]

    def let_go(self, y, held, which):
        """A slip begins on one side, along the groove if the other one holds, or, across it, on both."""
        n, _, e, _ = self.frame(y)
        force = self.balance(y, held)[3]
        held = [h and which not in (i, 2) for i, h in enumerate(held)]
        for i in (0, 1):
            if which in (i, 2):
                towards = -np.sign(force[i] @ e) * e if any(held) else -force[i] / np.linalg.norm(force[i])
                axis = n[1 - i] if any(held) else np.cross(n[i], towards)
                moved = -R * np.cross(axis, n[i])
                y[2:] += 3 * FULL * (towards @ moved) / (moved @ moved) * axis
        return held

    def run(self, y, times):
        """Speed and spin at these times, and what happened: the sides whose slip ended, and those that let go."""
        held, t, rows, happened = [np.linalg.norm(u) < 1e-12 for u in self.slips(y)], 0.0, [], []
        for _ in range(20):
            spare = self.spare(y, held)
            if min(spare) < 0:
                happened.append(f"{np.argmin(spare)} lets go")
                held = self.let_go(y, held, int(np.argmin(spare)))
            known = [u / max(np.linalg.norm(u), 1e-300) for u in self.slips(y)]

            def end(t, y, held, known=known):
                slips = [u @ k for u, k in zip(self.slips(y), known, strict=True)]
                return min([1.0, *[size - FULL for size, h in zip(slips, held, strict=True) if not h]])

            events = [end, lambda t, y, held: min(self.spare(y, held))]
            for event in events:
                event.terminal, event.direction = True, -1
            left, args = times[times > t], (tuple(held),)
            run = solve_ivp(self.rate, (t, times[-1]), y, args=args, t_eval=left, events=events, rtol=1e-10,
                            atol=1e-12, method="DOP853")  # fmt: skip
            rows.extend(np.reshape(run.y, (5, -1)).T)
            if run.status != 1:
                break
            which = 0 if len(run.t_events[0]) else 1
            t, y = run.t_events[which][0], run.y_events[which][0]
            if which == 0:
                small = [np.linalg.norm(u) < 2 * FULL for u in self.slips(y)]
                happened.extend(f"{i} grips" for i in (0, 1) if small[i] and not held[i])
                held = [h or s for h, s in zip(held, small, strict=True)]
            else:
                side = int(np.argmin(self.spare(y, held)))
                happened.append(f"{side} lets go")
                held = self.let_go(y, held, side)
        return np.array(rows), happened


CASES = {  # the angles, the coefficients, the tilt, the spin, what happens
    "both slips end": ((0.6, 0.6), (0.2, 0.2), 0.1, (-20.0, 10.0, 3.0), ["1 grips", "0 grips"]),
    "one side is less steep": ((0.5, 1.0), (0.3, 0.15), 0.1, (10.0, -5.0, 8.0), ["0 grips", "1 grips"]),
    "spun fast": ((0.6, 0.9), (0.25, 0.1), 0.0, (-80.0, 2.0, 30.0), ["1 grips", "0 grips"]),
    "too steep": ((0.6, 0.6), (0.1, 0.12), 1.0, (-4.0, 3.0, 1.0), []),
    "one slides for good": ((0.3, 1.2), (0.02, 0.6), 0.6, (5.0, 1.0, -2.0), ["1 grips", "0 grips", "0 lets go"]),
}


@jax.jit
def thrown(angles, friction, gravity, w, times):
    a, b = angles
    one, two = jnp.stack([jnp.cos(a), 0 * a, jnp.sin(a)]), jnp.stack([-jnp.cos(b), 0 * b, jnp.sin(b)])
    planes = {
        "left": Plane((0.0, 0.0, 0.0), one, Frictional(0.3, 0.0, friction[0])),
        "right": Plane((0.0, 0.0, 0.0), two, Frictional(0.3, 0.0, friction[1])),
    }
    x, z = jnp.linalg.solve(jnp.stack([one[::2], two[::2]]), jnp.full(2, R, one.dtype))
    state = BallState(jnp.stack([x, 0 * x, z]), jnp.array([0.0, 0.3, 0.0], one.dtype), w)
    tolerance = 1e-9 if one.dtype == jnp.float64 else 2e-6
    motion = Exact(contact=Integrated(rtol=tolerance, atol=tolerance))
    out = simulate(Scene(Ball(R, 1.0, ALPHA), planes, gravity=gravity), state, t1=times[-1], motion=motion,
                   max_impacts=64, throw=False)  # fmt: skip
    return out.result, out.at(times)


def tilted(angle):
    return np.array([0.0, -G * np.sin(angle), -G * np.cos(angle)])


@functools.cache
def expected(case):
    angles, friction, tilt, w, _ = CASES[case]
    times = np.linspace(0.02, 1.2, 60)
    right = Reference(valley(*angles), friction, tilted(tilt))
    e = right.frame(np.zeros(5))[2]
    return times, e, *right.run(np.array([0.0, 0.3 * e[1], *w]), times)


@pytest.mark.parametrize("dtype", [jnp.float64, jnp.float32], ids=["float64", "float32"])
@pytest.mark.parametrize("case", CASES)
def test_slipping_in_a_groove(case, dtype):
    angles, friction, tilt, w, happens = CASES[case]
    times, e, rows, happened = expected(case)
    assert happened == happens
    result, at = thrown(*[jnp.asarray(x, dtype) for x in (angles, friction, tilted(tilt), w, times)])
    assert result == RESULTS.reached_t1
    close = 2e-6 if dtype == jnp.float64 else 2e-3
    np.testing.assert_allclose(np.asarray(at.velocity) @ e, rows[:, 1], atol=close)
    np.testing.assert_allclose(R * at.spin, R * rows[:, 2:], atol=close)


ROUND = {  # the coefficients of bowl and post, gravity, the speed, the spin or rolling, what happens
    "spun": ((0.3, 0.2), (0.0, 0.0, -G), 0.6, (5.0, 3.0, -20.0), ["0 grips", "1 grips"]),
    "begins to slip": ((0.015, 0.02), (2.0, 0.0, -G), 0.1, None, ["1 lets go"]),
    "slips from the start": ((0.9, 0.01), (1.0, 0.5, -G), 0.3, None, ["1 lets go", "1 grips", "1 lets go"]),
}


@jax.jit
def sent_round(friction, gravity, v, w, times):
    bowl = Sphere((0.0, 0.0, 1.0), BOWL + R, Frictional(0.0, 0.0, friction[0]), inside=True)
    post = Cylinder((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), RHO - R, Frictional(0.0, 0.0, friction[1]))
    z = 1.0 - np.sqrt(BOWL**2 - RHO**2)
    state = BallState(jnp.array([RHO, 0.0, z]), jnp.stack([0 * v, v, 0 * v]), w)
    out = simulate(Scene(Ball(R, 1.0, ALPHA), {"bowl": bowl, "post": post}, gravity=gravity), state, t1=times[-1],
                   motion=Exact(contact=Integrated(rtol=1e-9, atol=1e-9)), max_impacts=64, throw=False)  # fmt: skip
    return out.result, out.impacts.kind, out.at(times)


@pytest.mark.parametrize("case", ROUND)
def test_slipping_round_a_post(case):
    friction, gravity, v, w, happens = ROUND[case]
    right, times = Reference(round_the_post, friction, np.array(gravity)), np.linspace(0.02, 1.0, 50)
    n, _, e, _ = right.frame(np.zeros(5))
    s = v * e[1]
    w = s * (n[0] - n[1]) / (R * np.linalg.norm(np.cross(*n))) if w is None else np.array(w)
    rows, happened = right.run(np.array([0.0, s, *w]), times)
    assert happened == happens
    result, kinds, at = sent_round(*[jnp.asarray(x) for x in (friction, gravity, v, w, times)])
    assert result == RESULTS.reached_t1
    assert bool(jnp.any(kinds == KINDS.slipped)) == (case == "begins to slip")
    np.testing.assert_allclose(jnp.linalg.norm(at.velocity, axis=1), abs(rows[:, 1]), atol=2e-6)
    np.testing.assert_allclose(R * at.spin, R * rows[:, 2:], atol=5e-6)


@pytest.mark.parametrize("slips", [(False, False), (True, False), (True, True)])
def test_derivatives_of_the_course_in_a_groove(slips):
    """In both modes, of all numbers, against differences: held on both sides, on one, on none."""
    w = jnp.array([3.0, -2.0, 4.0])

    def grip(angles, friction, gravity, turn, speed, spin):
        a, b = angles
        normals = ((jnp.cos(a), 0.1 * jnp.sin(a), jnp.sin(a)), (-jnp.cos(b), 0.2 * jnp.sin(a), jnp.sin(b)))
        one, two = (scale(ratio(1.0, norm(n)), n) for n in normals)
        turns = tuple(along_surface(n, components(each)) for n, each in zip((one, two), turn, strict=True))
        sides = groove.Sides((one, two), turns, (jnp.asarray(True), jnp.asarray(True)))
        path = groove.way(R, sides)
        velocity = scale(speed, path.along)
        held = groove.spin_of(path, speed, 0.0, path.along, True)
        first = add(held, scale(spin[0], two) if slips[0] else (0.0, 0.0, 0.0))  # the other side does not feel it
        spin = add(first, components(spin) if all(slips) else (0.0, 0.0, 0.0))
        change = groove.Change((False, False), 1e-9, 1e-8)
        return groove.gripped(R, ALPHA, sides, velocity, spin, components(gravity), (friction[0], friction[1]), change)

    def goes(*numbers):
        found = grip(*numbers)
        course = found.course
        return jax.tree.map(jnp.asarray, (course.acceleration, scale(R, course.spins), course.pushes, found.speed))

    at = [jnp.asarray(x, float) for x in ((0.6, 0.8), (0.4, 0.5), (0.0, -1.0, -G), np.eye(2, 3), 0.7, w)]
    assert [bool(held) for held in grip(*at).sides.grips] == [not slides for slides in slips]
    check_grads(jax.jit(goes), at, 1, atol=1e-5, rtol=1e-5)


@jax.jit
@functools.partial(jax.vmap, in_axes=(0, 0, None))
def rolled_to_a_wall(points, normals, gravity):
    """Along the groove of two of three planes, to the third."""
    planes = {f"{i}": Plane(points[i], normals[i], Rough(0.6, 0.3)) for i in range(3)}
    state = BallState(jnp.array([0.5, R, R]), jnp.array([1.0, 0.0, 0.0]), jnp.array([0.0, 1.0, -1.0]) / R)
    return simulate(Scene(Ball(R, 1.0, ALPHA), planes, gravity=gravity), state, t1=1.2,
                    motion=Exact(contact=Integrated(rtol=1e-9, atol=1e-9)), throw=False)  # fmt: skip


def test_a_wall_across_a_groove_turns_a_ball_back():
    """Whichever side the ball is said to lie on: both hold it, so that it rolls back along the groove."""
    orders = np.array(list(itertools.permutations(range(3))))
    points, normals = np.array([(0, 0, 0), (0, 0, 0), (1.0, 0, 0)]), np.array([(0, 0, 1.0), (0, 1.0, 0), (-1.0, 0, 0)])
    out = rolled_to_a_wall(jnp.asarray(points[orders]), jnp.asarray(normals[orders]), jnp.array([1.0, -5.0, -5.0]))
    assert np.all(np.asarray(out.result._value) == RESULTS.reached_t1._value)
    a, way = 1.0 / (1.0 + 2.0 * ALPHA), 0.5 - R
    speed = np.sqrt(1.0 + 2.0 * a * way)
    left = 1.2 - (speed - 1.0) / a
    x, v = 1.0 - R - 0.6 * speed * left + 0.5 * a * left**2, -0.6 * speed + a * left
    np.testing.assert_allclose(out.final.position, np.tile([x, R, R], (6, 1)), atol=1e-8)
    np.testing.assert_allclose(out.final.velocity, np.tile([v, 0, 0], (6, 1)), atol=1e-8)
    np.testing.assert_allclose(R * out.final.spin, np.tile([0, v, -v], (6, 1)), atol=1e-8)


def test_a_wall_lets_go_at_once_where_nothing_presses_the_ball_to_it_any_more():
    """It is pushed to the wall by friction alone, against gravity. As soon as it rolls, it leaves, also where the push
    of the wall is negative then without becoming less."""
    size, n, t1 = 0.05, 16, 0.5

    @jax.jit
    @jax.vmap
    def run(pull, speed):
        surfaces = {
            "floor": Plane((0, 0, 0), (0, 0, 1), Frictional(0.3, 0.1, 0.3)),
            "wall": Plane((0.8, 0, 0), (-1, 0, 0), Frictional(0.0, 0.1, 0.3)),
        }
        zero = jnp.zeros_like(pull)
        velocity, spin = jnp.stack([0.33 + zero, speed, zero]), jnp.stack([-speed, 0.33 + zero, zero]) / size
        state = BallState(jnp.stack([0.7 + zero, zero, size + zero]), velocity, spin)
        scene = Scene(Ball(size, 0.05), surfaces, gravity=jnp.stack([pull, -0.6 + zero, -G + zero]))
        motion = Exact(contact=Integrated(rtol=1e-9, atol=1e-9))
        return simulate(scene, state, t1=jnp.asarray(t1), motion=motion, throw=False, log_size=8)

    rng = np.random.default_rng(2)
    pulls, speeds = rng.uniform(-0.5, -0.05, n), rng.uniform(-1.5, -0.5, n)
    out = run(pulls, speeds)
    assert np.all(np.asarray(out.result._value) == RESULTS.reached_t1._value)
    rows = np.asarray(out.impacts.kind._value)
    last = np.asarray(out.n_impacts) - 1
    lanes = np.arange(n)
    assert np.all(rows[lanes, last] == KINDS.left._value) and np.all(rows[lanes, last - 1] == KINDS.gripped._value)
    times = np.asarray(out.impacts.time)
    np.testing.assert_allclose(times[lanes, last], times[lanes, last - 1], atol=1e-9)
    left, rolls = t1 - times[lanes, last], pulls / 1.4
    np.testing.assert_allclose(out.final.velocity[:, 0], rolls * left, atol=1e-8)
    np.testing.assert_allclose(out.final.position[:, 0], 0.75 + 0.5 * rolls * left**2, atol=1e-8)


@pytest.mark.parametrize("floor, order", [(Smooth(0.0), (1, 2, 0)), (Rough(0.0), (2, 0, 1))], ids=["smooth", "rough"])
def test_in_a_corner_a_ball_keeps_the_spin_that_nothing_takes(floor, order):
    """Between smooth walls: on a smooth floor all of it, on a rough one what is about the normal. Also turned."""
    turn = Rotation.from_rotvec([0.4, -0.3, 0.8]).as_matrix()
    points, normals = np.diag([0.4, 0.3, 0.0]), np.array([(-1.0, 0, 0), (0, -1.0, 0), (0, 0, 1.0)])

    @jax.jit
    @jax.vmap
    def run(turn, pull):
        laws = [Smooth(0.0), Smooth(0.0), floor]
        surfaces = {str(i): Plane(points[i] @ turn.T, normals[i] @ turn.T, laws[i]) for i in order}
        state = BallState(*(jnp.asarray(x) @ turn.T for x in ([0.0, 0.0, R], [0.6, 0.4, 0.0], [2.0, 3.0, 5.0])))
        scene = Scene(Ball(R, 0.05), surfaces, gravity=pull @ turn.T)
        motion = Exact(contact=Integrated(rtol=1e-9, atol=1e-9))
        return simulate(scene, state, t1=3.0, motion=motion, throw=False, log_size=0)

    turns, pulls = np.stack([np.eye(3), turn, turn]), np.array([[1.0, 1.5, -G], [1.0, 1.5, -G], [2.0, 0.5, -G]])
    out = run(turns, pulls)
    assert np.all(np.asarray(out.result._value) == RESULTS.at_rest._value)
    inward = lambda x: np.einsum("ni,nij->nj", np.asarray(x), turns)  # noqa: E731
    np.testing.assert_allclose(inward(out.final.position), np.tile([0.4 - R, 0.3 - R, R], (3, 1)), atol=1e-8)
    np.testing.assert_allclose(out.final.velocity, 0.0, atol=1e-12)
    kept = [2.0, 3.0, 5.0] if isinstance(floor, Smooth) else [0.0, 0.0, 5.0]
    np.testing.assert_allclose(inward(out.final.spin), np.tile(kept, (3, 1)), atol=1e-8)
