"""A surface given by any gap: what it refuses, and that no crossing of it is passed, whether its curvature is given or
bounded by its own program."""

import warnings

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nonholo_jax import (
    RESULTS,
    Ball,
    BallState,
    Barrier,
    Box,
    Exact,
    Implicit,
    Integrated,
    LagrangianSystem,
    Plane,
    Rough,
    Scene,
    Smooth,
    UnboundedGapWarning,
    simulate,
    simulate_batch,
)


class Hill(eqx.Module):
    height: jax.Array
    speed: float = 0.0

    def __call__(self, x, t):
        rise = self.height * jnp.sin(x[0])
        return x[2] - rise - self.speed * t if self.speed else x[2] - rise


MOVING = {
    "piston": lambda x, t: x[2] - 0.1 - t,
    "shaken": lambda x, t: x[2] - 0.1 * jnp.cos(40.0 * t),
    "from_a_moment_on": lambda x, t: jnp.where(t > 1.0, x[2], x[2] - 0.1),
    "turning": lambda x, t: x @ jnp.stack([jnp.sin(t), 0.0 * t, jnp.cos(t)]),
    "module": Hill(jnp.asarray(0.1), speed=1.0),
    "loop": lambda x, t: jax.lax.fori_loop(0, 3, lambda i, y: y - t, x[2]),
    "compiled": jax.jit(lambda x, t: x[2] - t),
}
STILL = {
    "floor": lambda x, t: x[2],
    "module": Hill(jnp.asarray(0.1)),
    "single": lambda x, t: x[2] - jnp.asarray(0.1, x.dtype),
    "compiled": jax.jit(lambda x, t: x[2]),
    "of_numbers": lambda x, t: np.pi * x[0] + x[2],
}


@pytest.mark.parametrize("name", MOVING)
def test_a_gap_that_depends_on_time_is_refused(name):
    """It was searched as if it stood still, and the ball hit where it had been."""
    with pytest.raises(ValueError, match="must not depend on the time t"):
        Implicit(MOVING[name], Smooth(), curvature=0.2)


@pytest.mark.parametrize("name", STILL)
def test_a_gap_that_does_not_is_taken(name):
    for build in (Implicit, lambda *args: jax.eval_shape(lambda: Implicit(*args))):
        assert build(STILL[name], Smooth()).curvature is None


def test_a_gap_with_traced_numbers_is_taken():
    where = lambda h: Implicit(Hill(h), Smooth(), 0.2).gap(jnp.array([1.0, 0.0, 2.0]))  # noqa: E731
    assert jax.jit(jax.grad(where))(jnp.asarray(0.1)) == pytest.approx(-np.sin(1.0), rel=1e-12)


# No crossing is passed

AT_REST = [0.0, 0.0, 0.0]
UP = (0.0, 0.0, 1.0)


def ridge(x, t):
    """1 cm wide, on a floor 0.1 below the ball's centre."""
    return x[2] - 0.1 - 0.2 * jnp.exp(-0.5 * ((x[0] - 0.5) / 0.005) ** 2)


RADIUS, RIM, TUBE, HEIGHT, AHEAD = 0.1195, 0.2286, 0.0079, 3.048, 4.191


def hoop(x, t):
    return jnp.sqrt((jnp.hypot(x[0] - AHEAD, x[1]) - RIM) ** 2 + (x[2] - HEIGHT) ** 2) - (RADIUS + TUBE)


def alone(gap, law=Smooth(), gravity=(0.0, 0.0, -9.81), **options):  # noqa: B008
    return Scene(Ball(0.1, 1.0), {"wall": Implicit(gap, law, **options)}, gravity=gravity)


def deepest(scene, trajectory, n=801):
    """The least gap on the way."""
    places = trajectory.at(jnp.linspace(0.0, float(trajectory.t1), n)).position
    return float(jnp.min(jax.vmap(scene.surfaces[0].gap)(places)))


@pytest.mark.parametrize("motion", [None, Integrated()], ids=["exact", "integrated"])
def test_a_ridge_much_narrower_than_a_step_is_hit(motion):
    """Five samples of the second derivative along the flight passed it."""
    throw = BallState([-1.0, 0.0, 0.2], [10.0, 0.0, 0.0], AT_REST)
    hits = [simulate(alone(ridge, gravity=AT_REST, curvature=curvature), throw, t1=0.3, motion=motion)
            for curvature in (None, 8000.0)]  # fmt: skip
    for hit in hits:
        assert int(hit.n_impacts) == 1 and hit.is_bounded
        assert float(hit.impacts.time[0]) == pytest.approx(0.1494112949887423, rel=1e-12)


THROWS = {
    "first": (None, [4.279463790999344, -0.0017942396184843215, 5.6991887309164095], 3),
    "second": (Integrated(rtol=1e-10, atol=1e-10), [4.410379660099081, -9.649255330349404e-05, 5.6783584264463345], 1),
}


@pytest.mark.parametrize("name", THROWS)
def test_a_rim_is_hit_where_it_is(name):
    """Samples found it 6 cm late, or not at all."""
    motion, velocity, n_hits = THROWS[name]
    others = {
        "board": Box((AHEAD + 0.406, 0, 3.435), (0.025, 0.915, 0.535), Rough(0.7, 0.1)),
        "floor": Plane(AT_REST, UP, Rough(0.8, 0.1)),
    }
    scene = Scene(Ball(RADIUS, 0.624, 2 / 3), {"rim": Implicit(hoop, Rough(0.6, 0.1)), **others})
    throw = BallState([0.0, 0.0, 2.134], velocity, [0.0, -6 * np.pi, 0.0])
    found = simulate(scene, throw, t1=2.2, motion=motion)
    rim = np.asarray(found.impacts.surface) == 0
    gaps = jax.vmap(scene.surfaces[0].gap)(found.impacts.before.position)
    assert rim.sum() == n_hits
    np.testing.assert_allclose(np.asarray(gaps)[rim], 0.0, atol=1e-14)
    assert deepest(scene, found) > -1e-14


def nearest_peg(x, t):
    pegs = jnp.asarray([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]], x.dtype)
    return jnp.min(jnp.linalg.norm(x[None] - pegs, axis=1)) - 0.2


def block(x, t):
    beyond = jnp.abs(x) - 0.3
    return jnp.linalg.norm(jnp.maximum(beyond, 0.0)) + jnp.minimum(jnp.max(beyond), 0.0) - 0.1


def rods(x, t):
    """Along y, every metre."""
    return jnp.hypot(jnp.mod(x[0] + 0.5, 1.0) - 0.5, x[2]) - 0.2


PAST = {  # gap, position, velocity, number of impacts within a second
    "the axis of a hoop": (hoop, [AHEAD - 0.35, -0.35, HEIGHT + 0.5], [1.0, 1.0, 0.0], 0),
    "the axis, in its plane": (hoop, [AHEAD - 0.5, 0.0, HEIGHT + 1.0], [0.7, 0.0, 0.0], 1),
    "the axis, along it": (hoop, [AHEAD, 0.0, HEIGHT + 1.0], AT_REST, 0),
    "the middle of two pegs": (nearest_peg, [-0.5, 0.0, 1.5], [2.0, 0.0, 0.0], 0),
    "the middle, along it": (nearest_peg, [0.5, 0.3, 1.5], AT_REST, 0),
    "the edges of a block": (block, [-1.0, -1.0, 0.5], [2.0, 1.95, 1.0], 1),
    "the kinks inside a block": (block, [-0.1, 0.05, 1.0], [0.1, 0.0, 0.0], 2),
    "jumps of a period": (rods, [-1.0, 0.0, 1.0], [2.3, 0.0, 0.0], 1),
    "jumps that cancel": (
        lambda x, t: x[2] + 5.0 * jnp.sign(x[0]) - 5.0 * jnp.sign(x[0]),
        [-0.5, 0.0, 1.0],
        [2.0, 0.0, 4.0],
        0,
    ),
    "a pole": (lambda x, t: x[2] + 10.0 + 1.0 / x[0] ** 2, [-0.5, 0.0, 1.0], [2.0, 0.0, 0.0], 0),
}


@pytest.mark.parametrize("dtype", [jnp.float64, jnp.float32])
@pytest.mark.parametrize("name", PAST)
def test_the_search_goes_on_past_points_without_a_derivative(name, dtype):
    gap, position, velocity, n_impacts = PAST[name]
    scene, throw = alone(gap, Rough(0.8, 0.1)), [jnp.asarray(x, dtype) for x in (position, velocity, AT_REST)]
    assert Exact.serves(scene)
    found = simulate(scene, BallState(*throw), t1=1.0)
    assert int(found.n_impacts) == n_impacts
    assert found.is_bounded and deepest(scene, found) > -32.0 * float(jnp.finfo(dtype).eps)


def sampled_throws(n):
    rng = np.random.default_rng(5)
    place = rng.uniform([-2.0, -2.0, 0.8], [2.0, 2.0, 2.0], (n, 3))
    return BallState(*[jnp.asarray(x) for x in (place, 2.0 * rng.standard_normal((n, 3)), np.zeros((n, 3)))])


def test_bounds_of_the_program_and_of_the_curvature_find_the_same():
    throws = sampled_throws(200)
    hills = lambda x, t: x[2] - 0.1 - 0.1 * jnp.sin(2.0 * x[0]) * jnp.cos(3.0 * x[1])  # noqa: E731
    own, given = (simulate_batch(alone(hills, Rough(0.7, 0.2), curvature=c), throws, t1=1.0, max_impacts=8)
                  for c in (None, 1.5))  # fmt: skip
    np.testing.assert_array_equal(own.n_impacts, given.n_impacts)
    assert int(jnp.sum(own.n_impacts)) > 100
    np.testing.assert_allclose(own.impacts.time, given.impacts.time, rtol=1e-9)


class Tilted(eqx.Module):
    point: jax.Array
    normal: jax.Array

    def __call__(self, x, t):
        return jnp.sum((x - self.point) * self.normal)


@pytest.mark.parametrize("speed", [0.0, 1.0])
def test_a_ball_that_begins_at_a_gap_of_zero_but_for_rounding_does_not_fall_through(speed):
    """It fell through where the gap was not positive: a value of zero said that the gap could not close."""
    rng = np.random.default_rng(0)
    points, normals, v = rng.standard_normal((3, 100, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    v = speed * (v - np.sum(v * normals, axis=1, keepdims=True) * normals)

    @jax.jit
    @jax.vmap
    def run(point, normal, v):
        scene = Scene(Ball(0.05, 1.0), {"it": Implicit(Tilted(point, normal), Rough(0.5))}, gravity=-9.81 * normal)
        end = simulate(scene, BallState(point, v, jnp.zeros(3)), t1=0.1, motion=Exact(), throw=False)
        return Tilted(point, normal)(end.final.position, 0.0), end.result == RESULTS.sustained_contact

    gaps, stay = run(*map(jnp.asarray, (points, normals, v)))
    assert bool(jnp.all(stay))
    np.testing.assert_allclose(gaps, 0.0, atol=1e-14)


@pytest.mark.parametrize("transform", [jax.grad, jax.jacfwd])
def test_a_gap_that_is_differentiated_may_be_bounded_by_its_program(transform):
    throw = BallState([0.0, 0.0, 1.0], [1.0, 0.2, 0.0], AT_REST)

    def landing(height, curvature):
        return simulate(alone(Hill(height), Rough(0.7), curvature=curvature), throw, t1=0.8).final.position[2]

    own, given = (transform(lambda h, c=c: landing(h, c))(jnp.asarray(0.2)) for c in (None, 0.2))
    assert abs(float(own)) > 0.1
    np.testing.assert_allclose(own, given, rtol=1e-9)


def test_many_scenes_are_each_bounded_by_the_program():
    heights, throws = jnp.array([0.1, 0.2, 0.3]), sampled_throws(3)
    scenes = alone(Hill(heights), Rough(0.7))
    axes = jax.tree.map(lambda _: 0, scenes)
    many = simulate_batch(scenes, throws, t1=1.0, scene_axes=axes)
    assert many.is_bounded and isinstance(many.motion, Exact)
    for i, height in enumerate(heights):
        one = simulate(alone(Hill(height), Rough(0.7)), jax.tree.map(lambda x, i=i: x[i], throws), t1=1.0)
        np.testing.assert_allclose(many.final.position[i], one.final.position, rtol=1e-9)


@pytest.mark.parametrize("adjoint", [diffrax.ForwardMode(), diffrax.RecursiveCheckpointAdjoint()])
def test_the_loop_itself_may_be_differentiated(adjoint):
    transform = jax.jacfwd if isinstance(adjoint, diffrax.ForwardMode) else jax.grad
    throw = BallState([0.0, 0.0, 1.0], [1.0, 0.2, 0.0], AT_REST)

    wanted = jax.grad(lambda h: simulate(alone(Hill(h), Rough(0.7)), throw, t1=0.8).final.position[2])(jnp.asarray(0.2))
    module = lambda h: simulate(alone(Hill(h), Rough(0.7)), throw, t1=0.8, adjoint=adjoint).final.position[2]  # noqa: E731
    np.testing.assert_allclose(transform(module)(jnp.asarray(0.2)), wanted, rtol=1e-9)


@pytest.mark.parametrize("n", [2, 4])
def test_a_barrier_in_any_dimension_is_bounded_by_its_program(n):
    """A ridge across the way of a point."""
    axis = jnp.eye(n)
    gap = lambda q: q[1] - 0.2 * jnp.exp(-0.5 * ((q[0] - 0.5) / 0.005) ** 2)  # noqa: E731
    rows = lambda q: jax.grad(gap)(q)[None]  # noqa: E731
    times = []
    for curvature in (None, 8000.0):
        system = LagrangianSystem(metric=lambda q: jnp.eye(n), barriers=[Barrier(gap, rows, curvature=curvature)])
        found = simulate(system, (0.1 * axis[1] - axis[0], 10.0 * axis[0]), t1=0.16, max_impacts=4, throw=False)
        assert found.is_bounded and int(found.n_impacts) >= 1
        times.append(float(found.impacts.time[0]))
    assert times[0] == pytest.approx(times[1], rel=1e-9)


# Where there are no bounds


def table(x, t):
    return x[2] - 0.1 - jnp.interp(x[0], jnp.arange(-2.0, 3.0), jnp.asarray([0.0, 0.1, 0.0, 0.1, 0.0]))


FALL = BallState([0.2, 0.0, 1.0], [0.3, 0.0, 0.0], AT_REST)


def test_a_gap_that_is_only_sampled_is_named_in_a_warning_and_in_the_answer():
    scene = alone(table, Rough(0.8))
    many = jax.tree.map(lambda x: jnp.stack([x, x]), FALL)
    for run, throw in ((simulate, FALL), (simulate_batch, many)):
        with pytest.warns(UnboundedGapWarning, match=r"surface `wall` .* curvature=") as caught:
            found = run(scene, throw, t1=0.6)
        assert len(caught) == 1
        assert found.is_bounded is False and isinstance(found.motion, Integrated)
        assert np.all(np.asarray(found.n_impacts) == 1)
    barrier = Barrier(lambda q: jnp.sort(q)[0], lambda q: jnp.eye(2))
    with pytest.warns(UnboundedGapWarning, match="barrier 0"):
        simulate(LagrangianSystem(metric=lambda q: jnp.eye(2), barriers=[barrier]), ([1.0, 1.0], [0.1, 0.1]), t1=0.1)


def test_no_warning_where_the_curvature_is_given_or_the_program_runs_again():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert simulate(alone(table, curvature=0.0), FALL, t1=0.3).is_bounded
    final = jax.jit(lambda throw: simulate(alone(table), throw, t1=0.3).final.position)
    with pytest.warns(UnboundedGapWarning):
        final(FALL)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        final(FALL)


def test_exact_refuses_a_gap_that_is_only_sampled():
    with pytest.raises(ValueError, match=r"curvature=\.\.\."):
        simulate(alone(table), FALL, t1=0.3, motion=Exact())


# Lying on it, and a curvature that jumps

SIZE = 0.02135


def step_down(x, t):
    """A floor that ends at x = 0, for the centre of a ball: a plane, then a quarter of a cylinder round the edge."""
    return jnp.sqrt(jnp.maximum(x[0], 0.0) ** 2 + x[2] ** 2) - SIZE


def test_a_ball_that_lies_on_it_does_not_fall_through():
    """With a gap and a rate of exactly zero the bound of its second derivative was raised to zero."""
    floor = Implicit(lambda x, t: x[2] - SIZE, Rough(0.5))
    rolls = BallState([0.0, 0.0, SIZE], [0.3, 0.0, 0.0], [0.0, 0.3 / SIZE, 0.0])
    out = simulate(Scene(Ball(SIZE, 0.0459), {"floor": floor}), rolls, t1=0.4)
    np.testing.assert_allclose(out.final.position, (0.12, 0.0, SIZE), rtol=0, atol=1e-14)


@pytest.mark.parametrize("speed", [0.6, 1.0, 3.0])
def test_a_ball_flies_off_where_the_curvature_jumps(speed):
    """It is too fast for the edge, which begins all at once. Every step ended before that, until there were no more."""
    scene = Scene(Ball(SIZE, 0.0459), {"step": Implicit(step_down, Rough(0.0))})
    rolls = BallState([-0.2, 0.0, SIZE], [speed, 0.0, 0.0], [0.0, speed / SIZE, 0.0])
    out, late = simulate(scene, rolls, t1=0.2 / speed + 0.05), 0.05
    np.testing.assert_allclose(out.final.position, (speed * late, 0.0, SIZE - 4.905 * late**2), rtol=0, atol=1e-12)


def dent_times(x, v, depth, width, end, alpha=0.4):
    """How long a ball rolls from x to `end` through a dent at 0: by the energy that it keeps."""
    s = np.linspace(x, end, 400_001)
    z = -depth * np.exp(-((s / width) ** 2))
    speed = np.sqrt(v * v - 2.0 * 9.81 * z / (1.0 + alpha))
    ways = np.sqrt(1.0 + (2.0 * s / width**2 * z) ** 2) / speed
    return np.sum(0.5 * (ways[1:] + ways[:-1]) * np.diff(s))


@pytest.mark.parametrize("depth", [0.004, -0.002])
def test_no_dent_is_passed_between_two_steps(depth):
    """On a level floor steps become as long as the way; however far before the dent the ball begins."""
    width, v = 0.03, 0.5

    @jax.jit
    @jax.vmap
    def roll(x, t1):
        floor = Implicit(lambda x, t: x[2] - 0.05 + depth * jnp.exp(-((x[0] / width) ** 2)), Rough(0.0))
        state = BallState(
            jnp.stack([x, 0 * x, 0.05 + 0 * x]), jnp.array([v, 0.0, 0.0]), jnp.array([0.0, v / 0.05, 0.0])
        )
        motion = Exact(contact=Integrated(rtol=1e-9, atol=1e-9))
        out = simulate(
            Scene(Ball(0.05, 1.0), {"floor": floor}), state, t1=t1, motion=motion, max_impacts=4, throw=False
        )
        return out.result, out.final

    starts = -np.array([0.2, 0.31, 0.47, 0.6, 0.83, 1.3])
    times = np.array([dent_times(x, v, depth, width, 0.3) for x in starts])
    result, final = roll(jnp.asarray(starts), jnp.asarray(times))
    assert np.all(np.asarray(result._value) == RESULTS.reached_t1._value)
    np.testing.assert_allclose(final.position[:, 0], 0.3, atol=1e-7)
    np.testing.assert_allclose(final.velocity[:, 0], v, atol=1e-7)
