"""A plane with a hole in it: distance, bounds, the same surface as an `Implicit`, and putts that drop or do not."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nonholo_jax import (
    RESULTS,
    Ball,
    BallState,
    Exact,
    Hole,
    Implicit,
    Integrated,
    Plane,
    Rough,
    Scene,
    energy,
    simulate,
    simulate_batch,
)
from nonholo_jax._math import Window

R, SIZE, MASS, G = 0.054, 0.02135, 0.0459, 9.81  # of a golf hole and a golf ball
CENTER, NORMAL, WIDE = np.array([0.1, 0.2, -0.1]), np.array([0.1, -0.2, 1.0]), 0.4
TILTED = Hole(CENTER, NORMAL, WIDE, Rough(0.9))


def golf(law, **others):
    return Scene(Ball(SIZE, MASS), {"green": Hole((0, 0, 0), (0, 0, 1), R, law), **others})


def putt(speed, aside=0.0, start=-0.2):
    """A ball that rolls along x."""
    like = lambda *x: jnp.stack([jnp.asarray(c, float) for c in x])  # noqa: E731
    return BallState(like(start, aside, SIZE), like(speed, 0, 0), like(0, speed / SIZE, 0))


def test_the_distance_is_that_of_the_nearest_point():
    """Against points on the plane and on the wall, a fine mesh of them."""
    n = NORMAL / np.linalg.norm(NORMAL)
    first = np.cross(n, [0.0, 1.0, 0.0])
    first /= np.linalg.norm(first)
    frame, angle = np.stack([first, np.cross(n, first), n]), np.linspace(0, 2 * np.pi, 721)
    plane = [[(a * np.cos(t), a * np.sin(t), 0.0) for t in angle] for a in np.linspace(WIDE, 2.0, 201)]
    wall = [[(WIDE * np.cos(t), WIDE * np.sin(t), -z) for t in angle] for z in np.linspace(0.0, 1.0, 201)]
    mesh = np.array([*plane, *wall]).reshape(-1, 3)
    rng, found = np.random.default_rng(0), []
    for x in rng.uniform((-0.8, -0.8, -0.5), (0.8, 0.8, 0.6), (60, 3)):
        away = np.linalg.norm(mesh - x, axis=1).min()
        is_solid = np.hypot(x[0], x[1]) > WIDE and x[2] < 0
        found.append((float(TILTED.gap(jnp.asarray(CENTER + x @ frame))), -away if is_solid else away))
    gaps, wanted = np.array(found).T
    assert (wanted < 0).sum() > 5
    np.testing.assert_allclose(gaps, wanted, rtol=0, atol=6e-3)  # of the mesh
    assert np.all(np.abs(wanted) >= np.abs(gaps) - 1e-12)


def test_bounds_of_the_bend_hold_and_are_tight_in_short_windows():
    radius, rng, n = 0.1, np.random.default_rng(1), 4000

    def bounds(path, width):
        return jnp.stack([jnp.asarray(x) for x in TILTED.bend(Window(tuple(map(tuple, path)), width), 0.0, radius)])

    def second(path, s):
        place = lambda s: tuple(sum(c[k] * s**k for k in range(4)) for c in path)  # noqa: E731
        return jax.grad(jax.grad(lambda s: TILTED.level(place(s), 0.0, radius)))(s)

    both = jax.jit(jax.vmap(lambda path, width, s: (bounds(path, width), jax.vmap(lambda s: second(path, s))(s))))
    path = rng.normal(size=(n, 3, 4)) * np.array([0.5, 1.0, 1.0, 0.5])
    path[:, :, 0] += np.array([0.1, 0.2, 0.1])
    for longest in (1.0, 0.1, 1e-3, 1e-6):
        width = longest * rng.uniform(0.01, 1.0, n)
        times = width[:, None] * np.concatenate([[0.0, 1.0], rng.random(20)])
        (low, high), bends = (np.asarray(x) for x in ((lambda b, d: (b.T, d))(*both(path, width, times))))
        slack = 1e-9 * (1.0 + np.abs(bends).max(axis=1))
        assert np.all(bends.min(axis=1) >= low - slack) and np.all(bends.max(axis=1) <= high + slack)
    assert np.median(bends.min(axis=1) - low) < 1e-4  # of the lower one, which steps go by


@functools.partial(jax.jit, static_argnames="which")
def _thrown(throw, which):
    scene = golf(Rough(0.7, 0.3))
    if which == "implicit":

        def gap(x, t):
            inside = jnp.maximum(R - jnp.sqrt(x[0] ** 2 + x[1] ** 2), 0.0)
            return jnp.sqrt(inside**2 + jnp.maximum(x[2], 0.0) ** 2) - SIZE

        scene = Scene(scene.ball, {"green": Implicit(gap, Rough(0.7, 0.3))})
    return simulate_batch(scene, throw, t1=0.6, max_impacts=4, sum_trains=False)


def test_throws_at_it_are_those_at_the_same_surface_as_an_implicit():
    rng, n = np.random.default_rng(2), 64
    start = rng.uniform((-0.1, -0.1, 0.1), (0.1, 0.1, 0.3), (n, 3))
    target, time = rng.uniform((-0.06, -0.06, 0.0), (0.06, 0.06, 0.0), (n, 3)), rng.uniform(0.1, 0.25, (n, 1))
    velocity = (target - start) / time + np.array([0.0, 0.0, 0.5 * G]) * time
    throw = BallState(*[jnp.asarray(x) for x in (start, velocity, rng.normal(0, 30, (n, 3)))])
    one, two = (_thrown(throw, which) for which in ("hole", "implicit"))
    count = np.asarray(one.n_impacts)
    assert np.array_equal(count, two.n_impacts) and count.max() == 4
    hit = count > 0
    one, two = ([np.asarray(x)[hit, 0] for x in (each.impacts.time, each.impacts.after.velocity, each.impacts.normal)]
                for each in (one, two))  # fmt: skip
    up = one[2][:, 2]
    assert [int(np.sum(x)) > 2 for x in (up < 1e-9, (up > 1e-9) & (up < 1 - 1e-9), up > 1 - 1e-9)] == [True] * 3
    np.testing.assert_allclose(one[0], two[0], rtol=0, atol=1e-10)
    np.testing.assert_allclose(one[1], two[1], rtol=0, atol=1e-8)


def escapes(speed, alpha=0.4):
    """Whether a putt over the middle gets over the far rim, on a green without restitution.

    The ball flies off where the hole begins, since v^2 > g r. At the far rim it keeps what it has of its angular
    momentum about the point that it touches. Then it flies again, if v^2 > g r cos, or it goes round that point, and
    gets over it if (1 + alpha) v^2 / 2 > g (r - z).
    """
    x, z, vx, vz, turn = -2 * R, SIZE, speed, 0.0, speed  # the place seen from the far rim; turn is r times the spin
    for _ in range(20):
        ticks = np.linspace(0.0, -x / vx, 200_001)[1:]
        ahead = x + vx * ticks, z + vz * ticks - G * ticks**2 / 2
        meets = np.hypot(ahead[0], np.maximum(ahead[1], 0.0)) < SIZE * (1 - 1e-12)
        i = np.argmax(meets)
        if not meets[i] or ahead[1][i] <= 0:  # it comes over the green, or to the wall
            return not meets[i]
        (x, z), vz = (float(c[i]) for c in ahead), vz - G * ticks[i]
        x, z = x * SIZE / np.hypot(x, z), z * SIZE / np.hypot(x, z)
        along = ((vx * z - vz * x) / SIZE + alpha * turn) / (1 + alpha)
        if along <= 0 or along**2 <= G * z:
            return along > 0 and (1 + alpha) * along**2 / 2 > G * (SIZE - z)
        vx, vz, turn = along * z / SIZE, -along * x / SIZE, along
    raise AssertionError(speed)


def capture_speed():
    """The fastest putt over the middle that drops."""
    low, high = 1.4, 1.8
    while high - low > 1e-6:
        middle = (low + high) / 2
        low, high = (low, middle) if escapes(middle) else (middle, high)
    return low


@functools.cache
def _run(t1=0.6):
    return jax.jit(lambda throw: simulate(golf(Rough(0.0)), throw, t1=t1, throw=False))


def test_a_putt_over_the_middle_drops_below_the_capture_speed():
    """Holmes (Am. J. Phys. 59, 129, 1991) finds 1.63 m/s for this hole and this ball."""
    fastest = capture_speed()
    assert 1.55 < fastest < 1.7
    for factor, drops in ((1 - 1e-3, True), (1 + 1e-3, False)):
        out = _run()(putt(factor * fastest))
        assert out.result == RESULTS.reached_t1
        assert bool(out.final.position[2] < 0) == drops


@pytest.mark.parametrize("speed", [0.6, 1.2, 2.0])
def test_a_fast_putt_leaves_the_green_where_the_hole_begins(speed):
    """It flies along a parabola from there: v^2 > g r."""
    out, late = _run()(putt(speed)), 0.3 * R / speed
    there = out.at((0.2 - R) / speed + late)
    np.testing.assert_allclose(there.position, (-R + speed * late, 0, SIZE - G * late**2 / 2), rtol=0, atol=1e-12)


def test_a_slow_putt_rolls_over_the_rim_until_it_has_to_be_pulled():
    """(1 + alpha) v^2 / 2 + g z is conserved, and the push ends where v^2 = g r cos: with no friction lost, at
    cos = (2 + (1 + alpha) v0^2 / (g r)) / (3 + alpha), which is 10/17 from rest."""
    for v in (0.1, 0.3, 0.44):
        out = _run(2.2)(putt(v, start=-0.06))
        before = out.impacts.before.position[2]  # after it has passed onto the rim
        cos = (2 + 1.4 * v**2 / (G * SIZE)) / 3.4
        assert float(before[2]) == pytest.approx(SIZE * cos, abs=1e-7 * SIZE)
        assert float(before[0]) == pytest.approx(-R + SIZE * np.sqrt(1 - cos**2), abs=1e-7)


def test_finer_steps_agree_round_the_rim():
    """The putt of experiments/scenes/golf_putt.toml, which lips out."""
    scene = golf(Rough(0.4, 0.0, rolling=0.056))
    ends = [simulate(scene, putt(0.784, 0.044, -0.25), t1=0.6, motion=Exact(contact=Integrated(rtol=tol, atol=tol)))
            for tol in (1e-8, 1e-12)]  # fmt: skip
    assert float(ends[1].final.velocity[1]) < -0.3
    for a, b in zip(jax.tree.leaves(ends[0].final), jax.tree.leaves(ends[1].final), strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-6 * max(1.0, float(jnp.abs(b).max())))


def test_derivatives_know_where_the_hole_begins():
    """A putt that starts further on flies off earlier."""
    slope = jax.jit(jax.jacfwd(lambda x: simulate(golf(Rough(0.0)), putt(1.0, start=x), t1=0.2).final.position))(-0.2)
    np.testing.assert_allclose(slope, (1.0, 0.0, -G * R), rtol=0, atol=1e-9)


@pytest.mark.parametrize("aside", [0.0, 0.02, 0.035, 0.045, 0.05])
def test_energy_never_grows(aside):
    scene = _cup()
    for speed in (0.5, 1.1, 1.7):
        out = _with_cup(putt(speed, aside))
        # In a groove with rolling resistance, which a ball finds at the bottom of the cup, it is not followed.
        assert out.result in (RESULTS.reached_t1, RESULTS.at_rest, RESULTS.sustained_contact)
        time = jnp.linspace(0.0, float(out.t1), 101)
        found = jax.vmap(lambda state: energy(scene, state))(jax.vmap(out.at)(time))
        assert np.all(np.diff(np.asarray(found)) <= 1e-9 * float(found[0]))


@functools.cache
def _cup():
    return golf(Rough(0.4, 0.0, rolling=0.056), cup=Plane((0, 0, -0.1), (0, 0, 1), Rough(0.2, 0.0, rolling=0.1)))


@jax.jit
def _with_cup(throw):
    return simulate(_cup(), throw, t1=1.0, max_impacts=200, motion=Exact(contact=Integrated()), throw=False)


@pytest.mark.parametrize("numbers, words", [
    ({"radius": -0.1}, "`radius` must be positive"), ({"normal": (0, 0, 0)}, "`normal` must not be the zero vector"),
])  # fmt: skip
def test_what_is_refused(numbers, words):
    with pytest.raises(ValueError, match=words):
        Hole(**({"center": (0, 0, 0), "normal": (0, 0, 1), "radius": 0.1, "law": Rough()} | numbers))


def test_a_ball_must_fit_into_the_hole():
    with pytest.raises(ValueError, match="Surface `green`: argument `radius` must be larger than the ball's"):
        Scene(Ball(0.06, 1.0), {"green": Hole((0, 0, 0), (0, 0, 1), 0.054, Rough())})
