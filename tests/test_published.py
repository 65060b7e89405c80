"""Published and exactly derivable values. The source of each is in the docstring of its test."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import full_jit, lane, stacked, states

from nonholo_jax import (
    Ball,
    BallState,
    Box,
    Cylinder,
    Exact,
    Implicit,
    Integrated,
    Plane,
    Rough,
    Scene,
    Smooth,
    simulate,
    simulate_batch,
)

EPS = np.finfo(np.float64).eps
R, MASS, ALPHA = 0.025, 0.046, 0.4
UP, DOWN = (0.0, 0.0, 1.0), (0.0, 0.0, -1.0)
STILL = (0.0, 0.0, 0.0)
motions = pytest.mark.parametrize("motion", [Exact(), Integrated(rtol=1e-10, atol=1e-10)], ids=["exact", "integrated"])


def floor(law=None, height=0.0):
    return Plane((0.0, 0.0, height), UP, Rough() if law is None else law)


def ceiling(height, law=None):
    return Plane((0.0, 0.0, height), DOWN, Rough() if law is None else law)


def pairs(trajectory, radius=R):
    """(v_x, r omega_y) before the first impact and after each."""
    log, n = trajectory.impacts, int(trajectory.n_impacts)
    rows = [(log.before, 0), *[(log.after, i) for i in range(n)]]
    return np.array([(state.velocity[i, 0], radius * state.spin[i, 1]) for state, i in rows])


# Rough ball


def test_garwin_floor_underside_floor():
    """Garwin, Am. J. Phys. 37, 88 (1969): (1, 0), (3/7, 10/7), (-31/49, -60/49), (-333/343, -130/343)."""
    scene = Scene(Ball(R, MASS), {"floor": floor(), "underside": ceiling(0.7)})
    throw = BallState([0.0, 0.0, 0.3], [1.0, 0.0, -6.0], [0.0, 0.0, 0.0])
    trajectory = simulate(scene, throw, t1=0.33)
    assert np.asarray(trajectory.impacts.surface[:4]).tolist() == [0, 1, 0, -1]
    expected = [(1, 0), (3 / 7, 10 / 7), (-31 / 49, -60 / 49), (-333 / 343, -130 / 343)]
    np.testing.assert_allclose(pairs(trajectory), expected, rtol=0, atol=8 * EPS)


def test_garwin_two_bounces_restore_velocity_and_spin(getkey):
    """Garwin 1969: (v_x, omega) is restored exactly by two elastic bounces on one floor."""
    scene = Scene(Ball(R, MASS), {"floor": floor()})
    velocity, spin = jax.random.normal(getkey(), (64, 3)), 100 * jax.random.normal(getkey(), (64, 3))
    throw = states(jnp.full((64, 3), 0.5), velocity, spin)
    log = simulate_batch(scene, throw, t1=10.0, max_impacts=2).impacts
    sideways = log.after.velocity[:, 1, :2] - velocity[:, :2]
    turning = log.after.spin[:, 1] - spin
    assert np.abs(sideways).max() < 32 * EPS * max(np.abs(velocity).max(), R * np.abs(spin).max())
    assert np.abs(turning).max() < 32 * EPS * max(np.abs(velocity).max() / R, np.abs(spin).max()) / ALPHA


def test_pendulum_of_the_paper():
    """Paper, 5.2.1: v = (-v, 0, -u), omega = (0, m r v / J, 0) are reversed at the floor; the ball flies the same
    parabola back, for ever."""
    ball, v, u = Ball(R, MASS), 1.3, 2.1
    spin = R * MASS * v / ball.inertia
    throw = BallState([0.2, 0.1, R], [-v, 0.0, -u], [0.0, spin, 0.0])
    n = 128
    log = simulate(Scene(ball, {"floor": floor()}), throw, t1=1e3, max_impacts=n).impacts
    signs = np.where(np.arange(n) % 2 == 0, 1.0, -1.0)[:, None]
    np.testing.assert_allclose(log.after.velocity[:, :2], signs * [[v, 0.0]], rtol=0, atol=n * 4 * EPS)
    np.testing.assert_allclose(log.after.velocity[:, 2], u, rtol=n * 4 * EPS)
    np.testing.assert_allclose(log.after.spin, -signs * [[0.0, spin, 0.0]], rtol=0, atol=n * 4 * EPS * spin)
    places = [[0.2, 0.1], [0.2 + 2 * u / 9.81 * v, 0.1]]  # there and back
    expected = np.array([places[i % 2] for i in range(n)])
    np.testing.assert_allclose(log.before.position[:, :2], expected, rtol=0, atol=n * n * 4 * EPS)


@motions
def test_throw_that_retraces_itself_off_an_underside(motion, getkey):
    """Derived: r omega_y / v_x = 5/26 at the hand, alpha = 2/5, elastic, whatever the heights."""
    n = 32
    x, z = jax.random.uniform(getkey(), (2, n))
    speed = 1.0 + jax.random.uniform(getkey(), (n,))
    hand = jnp.stack([x, x, 0.2 + 0.5 * z], axis=1)
    velocity = jnp.stack([speed, 0 * speed, -7 - speed], axis=1)
    spin = jnp.stack([0 * speed, 5 / 26 * speed / R, 0 * speed], axis=1)
    heights = 0.8 + jax.random.uniform(getkey(), (n,))

    def go(state, height):
        scene = Scene(Ball(R, MASS), {"floor": floor(), "underside": ceiling(height)})
        first = simulate(scene, state, t1=2.0, max_impacts=2, motion=motion)
        there = simulate(scene, state, t1=2 * first.impacts.time[1], max_impacts=8, motion=motion)
        return first.impacts.surface, there

    surface, there = full_jit(jax.vmap(go))(states(hand, velocity, spin), heights)
    assert np.array_equal(surface, np.tile([0, 1], (n, 1)))
    assert np.array_equal(there.n_impacts, np.full(n, 3))
    np.testing.assert_allclose(there.final.position, hand, rtol=0, atol=1e-12)
    np.testing.assert_allclose(there.final.velocity, -velocity, rtol=0, atol=1e-11)
    np.testing.assert_allclose(there.final.spin, -spin, rtol=0, atol=1e-11 / R)


def test_garwins_throw_under_the_table():
    """Derived, and the answer of the main job: spin.y = (5/26) 2.0 / 0.025 brings the ball back to the hand."""
    table = Box((0.6, 0.0, 0.715), (0.6, 0.4, 0.015), Rough())
    scene = Scene(Ball(R, MASS), {"floor": floor(), "table": table})
    throw = BallState([-0.3, 0.0, 0.9], [2.0, 0.0, -5.0], [0.0, 5 / 26 * 2.0 / R, 0.0])
    there = simulate(scene, throw, t1=2.0, max_impacts=16)
    assert np.asarray(there.impacts.surface[:3]).tolist() == [0, 1, 0]
    back = there.at(2 * there.impacts.time[1])
    np.testing.assert_allclose(back.position, throw.position, rtol=0, atol=1e-13)
    np.testing.assert_allclose(back.velocity, -throw.velocity, rtol=0, atol=1e-12)


def disc_between_walls(alpha, omega=3.0, v=0.7, across=1.9):
    """Spin about z, between the walls x = 0 and x = 1, without gravity: a thousand impacts."""
    walls = {"left": Plane(STILL, (1.0, 0.0, 0.0), Rough()), "right": Plane((1.0, 0.0, 0.0), (-1.0, 0.0, 0.0), Rough())}
    scene = Scene(Ball(0.1, 1.0, jnp.asarray(alpha)), walls, gravity=STILL)
    throw = BallState([0.1, 0.0, 0.0], [-across, v, 0.0], [0.0, 0.0, omega])
    return simulate(scene, throw, t1=1e6, max_impacts=1000).impacts


@pytest.mark.parametrize("alpha", [0.1, 0.4, 0.5, 2 / 3])
def test_disc_between_walls_is_bounded_and_turns(alpha):
    """Broomhead and Gutkin 1993; Cox and Feres 2017: the (sqrt(alpha) r omega, v) plane turns by 2 beta per pair of
    bounces, cos beta = (1 - alpha) / (1 + alpha)."""
    n = 1000
    log = disc_between_walls(alpha)
    plane = np.sqrt(alpha) * 0.1 * np.asarray(log.after.spin[:, 2]) + 1j * np.asarray(log.after.velocity[:, 1])
    beta = np.arccos((1 - alpha) / (1 + alpha))
    turn = plane[2:] / plane[:-2]
    assert np.abs(np.abs(np.angle(turn)) - 2 * beta).max() < 64 * EPS
    assert np.abs(np.abs(plane) / np.abs(plane[0]) - 1).max() < n * 4 * EPS
    # y advances by v T between bounces; each of the two interleaved geometric sums is at most |plane| / sin(beta).
    time = 0.8 / 1.9
    reach = np.ptp(np.asarray(log.before.position[:, 1]))
    assert reach < 2 * 2 * np.abs(plane[0]) * time / np.sin(beta)


@pytest.mark.parametrize("k, n", [(1, 3), (1, 4), (2, 5), (3, 7)])
def test_disc_between_walls_closes(k, n):
    """Ahmed, Cox, Wang, Chaos 32, 023102 (2022): alpha = tan^2(pi k / 2n) closes every orbit after 2n bounces."""
    log = disc_between_walls(np.tan(np.pi * k / (2 * n)) ** 2)
    after = np.asarray(stacked(log.after))[: 2 * n + 1]
    np.testing.assert_allclose(after[2 * n], after[0], rtol=0, atol=400 * EPS)
    assert np.abs(after[2:-1:2] - after[0]).max(axis=1).min() > 1e-2  # and not before


# Cross, Am. J. Phys. 70, 482 (2002): surface, angle in (deg, from the surface), v in, v out (m/s), angle out, spin out
# (rad/s), e_y. Tennis ball, R = 0.033 m, spin before 0, as transcribed.
CROSS = [
    ("wood", 20, 3.72, 3.09, 19.2, 34.9, 0.80),
    ("wood", 45, 3.80, 2.53, 50.4, 58.2, 0.73),
    ("emery", 20, 3.53, 2.24, 27.2, 78.5, 0.84),
    ("emery", 45, 3.70, 2.66, 51.3, 49.9, 0.79),
    ("rebound_ace", 20, 3.35, 2.13, 23.4, 76.7, 0.74),
    ("rebound_ace", 45, 3.60, 2.66, 49.3, 50.6, 0.79),
]


@pytest.mark.parametrize("row", CROSS, ids=[f"{row[0]}_{row[1]}" for row in CROSS])
def test_cross_tennis_ball(row):
    """The law has two coefficients. Taken from the two measured velocities they give e_y to its printed digits, and
    the spin, which nothing was fitted to, to 15 %: angular momentum about the contact is conserved, alpha = 0.55."""
    _, angle, v_in, v_out, angle_out, spin_out, e_y = row
    alpha, radius = 0.55, 0.033
    into = v_in * np.array([np.cos(np.radians(angle)), 0.0, -np.sin(np.radians(angle))])
    out = v_out * np.array([np.cos(np.radians(angle_out)), 0.0, np.sin(np.radians(angle_out))])
    e_n = -out[2] / into[2]
    assert abs(e_n - e_y) < 0.01
    e_t = (1 - out[0] / into[0]) * (1 + alpha) / alpha - 1
    assert -1 < e_t < 0.2  # rough surfaces stop the slip, and hardly reverse it
    scene = Scene(Ball(radius, 0.057, alpha), {"court": floor(Rough(jnp.asarray(e_n), jnp.asarray(e_t)))}, STILL)
    after = lane(simulate(scene, BallState([0, 0, radius], into, STILL), t1=0.1, max_impacts=1).impacts.after, 0)
    np.testing.assert_allclose(after.velocity, out, rtol=0, atol=32 * EPS)
    assert abs(after.spin[1] / spin_out - 1) < 0.15


# Event times and gradients


@motions
def test_first_impact_of_a_drop(motion):
    """Siconos, BouncingBallED reference file: height 1, g 9.81, e 0.9."""
    scene = Scene(Ball(R, MASS), {"floor": floor(Smooth(0.9))})
    log = simulate(scene, BallState([0, 0, 1 + R], STILL, STILL), t1=0.5, max_impacts=1, motion=motion).impacts
    assert abs(log.time[0] - 0.4515236409857) < 1e-13
    assert abs(log.after.velocity[0, 2] - 3.986502226263) < 1e-12


@motions
@pytest.mark.parametrize("mode", [jax.jacfwd, jax.jacrev])
def test_derivative_of_the_first_impact_time(motion, mode):
    """Diffrax, test_event.py: g 8, from rest at x0 = 1, 3, 10: d t / d x0 = 0.25, 0.144338, 0.0790569."""
    scene = Scene(Ball(R, MASS), {"floor": floor()}, gravity=(0.0, 0.0, -8.0))

    def time(height):
        throw = BallState(jnp.stack([0 * height, 0 * height, height + R]), jnp.zeros(3), jnp.zeros(3))
        return simulate(scene, throw, t1=2.0, max_impacts=4, motion=motion, throw=False).impacts.time[0]

    heights = jnp.array([1.0, 3.0, 10.0])
    slopes = jax.jit(jax.vmap(mode(time)))(heights)
    np.testing.assert_allclose(slopes, [0.25, 0.144338, 0.0790569], rtol=5e-6)
    np.testing.assert_allclose(slopes, 1 / np.sqrt(2 * 8.0 * np.asarray(heights)), rtol=1e-12)


@motions
@pytest.mark.parametrize("mode", [jax.jacfwd, jax.jacrev])
def test_final_height_after_a_bounce(motion, mode):
    """Zhong, Han, Brikis 2022, task 1: without a time-of-impact term a simulator gives +1."""
    scene = Scene(Ball(0.1, 1.0), {"floor": floor(Smooth())}, gravity=STILL)

    def height(y, v):
        throw = BallState(
            jnp.stack([jnp.asarray(-1.0), 0 * y, y]), jnp.stack([jnp.asarray(2.0), 0 * y, v]), jnp.zeros(3)
        )
        return simulate(scene, throw, t1=1.0, max_impacts=2, motion=motion, throw=False).final.position[2]

    twice = lambda y, v: (height(y, v),) * 2  # noqa: E731
    slopes, end = full_jit(mode(twice, argnums=(0, 1), has_aux=True))(jnp.asarray(1.0), jnp.asarray(-2.0))
    assert abs(end - 1.2) < 16 * EPS
    np.testing.assert_allclose(slopes, (-1.0, -1.0), rtol=0, atol=64 * EPS)


@jax.jit
@jax.jacrev
def planar_jacobian(y, mu):
    """The derivative of (x, z, v_x, v_z, omega) after 0.4 s above a rough floor."""
    zero = jnp.zeros_like(y[0])
    state = BallState(*[jnp.stack(part) for part in ((y[0], zero, y[1]), (y[2], zero, y[3]), (zero, y[4], zero))])
    end = simulate(Scene(Ball(R, MASS), {"floor": floor(Rough(mu))}), state, t1=0.4, max_impacts=2, throw=False).final
    return jnp.stack([end.position[0], end.position[2], end.velocity[0], end.velocity[2], end.spin[1]])


@pytest.mark.parametrize("mu", [0.3, 0.9, 1.0])
def test_saltation_matrix_of_a_planar_rough_bounce(mu):
    """Kong et al. 2023: D_x R + (f+ - D_x R f-) D_x g / (D_x g f-), here for (x, z, v_x, v_z, omega). Its determinant
    is -mu^3 (derived), and free flight keeps volumes."""
    g, t1 = 9.81, 0.4
    throw = np.array([0.0, 0.7, 1.3, -2.0, 12.0])
    flight = lambda t: np.eye(5) + t * (np.eye(5, k=2) * [[1], [1], [0], [0], [0]])  # noqa: E731
    fall = np.sqrt(throw[3] ** 2 + 2 * g * (throw[1] - R))
    before = (fall + throw[3]) / g
    k = ALPHA / (1 + ALPHA)
    s = (1 + mu) * k
    reset = np.diag([1.0, 1.0, 1 - s, -mu, 1 - s / ALPHA])
    reset[2, 4], reset[4, 2] = s * R, s / (ALPHA * R)
    v_minus = throw[2:] + before * np.array([0, -g, 0])
    v_plus = (reset[2:, 2:]) @ v_minus
    f_minus, f_plus = np.array([*v_minus[:2], 0, -g, 0]), np.array([*v_plus[:2], 0, -g, 0])
    d_gap = np.array([0.0, 1.0, 0.0, 0.0, 0.0])
    saltation = reset + np.outer(f_plus - reset @ f_minus, d_gap) / (d_gap @ f_minus)

    jacobian = np.asarray(planar_jacobian(jnp.asarray(throw), jnp.asarray(mu)))
    expected = flight(t1 - before) @ saltation @ flight(before)
    np.testing.assert_allclose(jacobian, expected, rtol=0, atol=64 * EPS * np.abs(expected).max())
    assert abs(np.linalg.det(jacobian) + mu**3) < 1e-12


# Billiards without spin. Started with uniform positions and directions the flow is stationary, so that the expected
# number of collisions in any time T is exactly T * perimeter / (pi * area).


def mean_time_between_collisions(scene, positions, directions, t1):
    """Estimate and standard error. The error of a ratio of means, by the delta method."""
    zero = np.zeros(len(positions))
    throw = states(np.c_[positions, zero], np.c_[directions, zero], np.zeros((len(zero), 3)))
    end = simulate_batch(scene, throw, t1=t1, max_impacts=512, log_size=0, throw=True)
    assert set(np.asarray(end.t1)) == {t1}
    counts = np.asarray(end.n_impacts, float)
    speed = np.linalg.norm(end.final.velocity, axis=1)
    assert np.abs(speed - 1).max() < 512 * 4 * EPS and np.array_equal(end.final.spin, throw.spin)
    return t1 / counts.mean(), t1 / counts.mean() ** 2 * counts.std() / np.sqrt(len(counts))


def directions_of(rng, n):
    angle = rng.uniform(0, 2 * np.pi, n)
    return np.c_[np.cos(angle), np.sin(angle)]


def test_mean_time_in_a_square_with_a_disc():
    """DynamicalBilliards.jl tests: pi (1 - pi R^2) / (4 + 2 pi R), unit square, disc of radius R, unit speed."""
    n, radius, r = 2000, 0.3, 0.05  # the ball's centre is the particle: walls move out, the disc shrinks
    walls = {
        f"wall_{axis}_{side}": Plane(side * (0.5 + r) * np.eye(3)[axis], -side * np.eye(3)[axis], Smooth())
        for axis in (0, 1)
        for side in (-1, 1)
    }
    disc = Cylinder(STILL, (0.0, 0.0, 1.0), radius - r, Smooth())
    rng = np.random.default_rng(1)
    positions = rng.uniform(-0.5, 0.5, (4 * n, 2))
    positions = positions[np.linalg.norm(positions, axis=1) > radius][:n]
    scene = Scene(Ball(r, 1.0), {**walls, "disc": disc}, gravity=STILL)
    mean, error = mean_time_between_collisions(scene, positions, directions_of(rng, n), 30.0)
    expected = np.pi * (1 - np.pi * radius**2) / (4 + 2 * np.pi * radius)
    assert error < 5e-3 * expected
    assert abs(mean - expected) < 4 * error


def test_mean_time_in_a_stadium():
    """DynamicalBilliards.jl tests: pi (w l + pi w^2 / 4) / (2 l + pi w), length l, width w, unit speed."""
    n, length, width = 1000, 1.0, 0.8

    def gap(x, t):
        """(rho^2 - d^2) / 2 rho with d the distance from the middle segment: second derivatives of at most 1 / rho."""
        beyond = jnp.maximum(jnp.abs(x[0]) - length / 2, 0.0)
        return width / 4 - (beyond**2 + x[1] ** 2) / width

    rng = np.random.default_rng(2)
    positions = rng.uniform(-1, 1, (8 * n, 2)) * [(length + width) / 2, width / 2]
    beyond = np.maximum(np.abs(positions[:, 0]) - length / 2, 0)
    positions = positions[beyond**2 + positions[:, 1] ** 2 < (width / 2) ** 2][:n]
    scene = Scene(Ball(0.01, 1.0), {"stadium": Implicit(gap, Smooth(), curvature=2 / width)}, gravity=STILL)
    mean, error = mean_time_between_collisions(scene, positions, directions_of(rng, n), 30.0)
    expected = np.pi * (width * length + np.pi * width**2 / 4) / (2 * length + np.pi * width)
    assert error < 5e-3 * expected
    assert abs(mean - expected) < 4 * error
