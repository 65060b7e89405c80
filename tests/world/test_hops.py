"""Hops, from plane to plane in closed form, are the event loop: the same impacts, to rounding, and the same results;
and where there is more to do than an ordinary bounce they leave it to the loop."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nonholo_jax import (
    RESULTS,
    Ball,
    BallState,
    Box,
    Exact,
    Frictional,
    Plane,
    Rectangle,
    Rough,
    Scene,
    Smooth,
    simulate,
    simulate_batch,
)
from nonholo_jax._motion.hopping import _stopped, _unmarked, hopped
from nonholo_jax._motion.loop import start

BALL = Ball(0.1, 0.5)
SLOPE = (0.6, 0.0, 0.8)
WALLS = {
    "floor": ((0.0, 0.0, 0.0), (0.0, 0.0, 1.0)),
    "ceiling": ((0.0, 0.0, 2.0), (0.0, 0.0, -1.0)),
    "left": ((-1.0, 0.0, 0.0), (1.0, 0.0, 0.0)),
    "right": ((1.0, 0.0, 0.0), (-1.0, 0.0, 0.0)),
    "slope": ((-1.2, 0.0, 0.0), SLOPE),
}
LAWS = {
    "elastic": Rough(1.0),
    "paper": Rough(0.8),
    "rough": Rough(0.9, 0.4),
    "smooth": Smooth(0.7),
    "frictional": Frictional(0.85, 0.2, 0.3),
}


def throws(key, n, dtype):
    keys = jax.random.split(key, 3)
    position = jnp.array([[0.0, 0.0, 1.2]]) + jax.random.uniform(keys[0], (n, 3), minval=-0.6, maxval=0.6)
    parts = position, 4.0 * jax.random.normal(keys[1], (n, 3)), 20.0 * jax.random.normal(keys[2], (n, 3))
    return BallState(*(x.astype(dtype) for x in parts))


def scene(law, names=tuple(WALLS), traced=False, gravity=(0.0, 0.0, -9.81)):
    number = (lambda x: jnp.asarray(x, dtype=float)) if traced else (lambda x: x)
    planes = {name: Plane(number(WALLS[name][0]), number(WALLS[name][1]), LAWS[law]) for name in names}
    return Scene(BALL, planes, number(gravity))


def both(room, states, **options):
    """By hops, which keep no log, and by the loop alone, which does."""
    hops = simulate_batch(room, states, log_size=0, **options)
    return hops, simulate_batch(room, states, **options)


def agree(hops, loop, tolerance, share=1.0):
    """But for lanes that rounding has sent another way: at most a `share` less than all of them."""
    same = np.asarray((hops.n_impacts == loop.n_impacts) & (hops.result == loop.result))
    assert same.mean() >= share, same.mean()
    for a, b in zip(jax.tree.leaves((hops.final, hops.t1)), jax.tree.leaves((loop.final, loop.t1)), strict=True):
        error = np.abs(np.asarray(a - b)).reshape(len(same), -1).max(axis=1) / (1.0 + np.nanmax(np.abs(np.asarray(b))))
        assert np.isnan(a).sum() == np.isnan(b).sum()
        assert np.nanquantile(error[same], 1.0 if share == 1.0 else 0.98) < tolerance


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("sum_trains", [True, False])
def test_a_room(getkey, law, sum_trains):
    """Five planes, with corners, ramps and dying bounces, each law; 12 impacts do not amplify rounding by 1e6."""
    states = throws(getkey(), 300, float)
    agree(*both(scene(law), states, t1=2.0, max_impacts=12, sum_trains=sum_trains), 1e-9, share=0.99)


@pytest.mark.parametrize("gravity", [(0.0, 0.0, 0.0), (0.0, 0.0, 9.81), (3.0, 0.0, -9.0)])
def test_traced_numbers_and_any_gravity(getkey, gravity):
    states = throws(getkey(), 300, float)
    room = scene("rough", traced=True, gravity=gravity)
    agree(*both(room, states, t1=1.0, max_impacts=12), 1e-9, share=0.99)


def test_single_precision(getkey):
    states = throws(getkey(), 300, np.float32)
    hops, loop = both(scene("elastic", ("floor", "ceiling")), states, t1=2.0, max_impacts=12)
    assert hops.final.position.dtype == np.float32
    agree(hops, loop, 1e-3, share=0.99)


BLOCKS = {
    "table": lambda number, law: {"table": Box(number((0.6, 0.0, 0.8)), number((0.6, 0.4, 0.05)), law)},
    "turned": lambda number, law: {"brick": Box((0.0, 0.0, 1.0), (0.3, 0.5, 0.2), law, (0.9, 0.2, -0.3, 0.1))},
    "shelf": lambda number, law: {
        "shelf": Rectangle((0.0, 0.0, 0.9), (0.1, 0.0, 1.0), (1.0, 0.0, 0.0), (0.5, 0.3), law)
    },
    "two": lambda number, law: {
        "step": Box((1.2, 0.0, 0.2), (0.5, 2.0, 0.2), law),
        "brick": Box((0.0, 0.0, 1.0), (0.3, 0.3, 0.3), law),
    },
}


def throws_at(key, n, block, dtype=float):
    """At points near faces, edges and corners of a block, from all around it."""
    rng = np.random.default_rng(np.asarray(jax.random.key_data(key)))
    place, axes, half = (np.asarray(x) for x in block.in_frame((0.0, 0.0, 0.0)))
    center, within = -axes.T @ place, rng.uniform(-1.0, 1.0, (n, 3))
    ends = np.sign(within) * (1.0 + rng.uniform(-0.1, 0.3, (n, 3)))
    target = center + (np.where(rng.uniform(size=(n, 3)) < 0.5, ends, within) * half) @ axes
    away = rng.standard_normal((n, 3))
    away = away / np.linalg.norm(away, axis=1, keepdims=True)
    start = center + away * (1.1 * np.linalg.norm(half) + 3.0 * BALL.radius)
    start[:, 2] = np.maximum(start[:, 2], 2.0 * BALL.radius)
    velocity = (target - start) / 0.3 + [0.0, 0.0, 0.5 * 9.81 * 0.3]
    return BallState(*(jnp.asarray(x.astype(dtype)) for x in (start, velocity, 20.0 * rng.standard_normal((n, 3)))))


def slow_at(key, n, block):
    """From close to its edges and corners, slowly."""
    rng = np.random.default_rng(np.asarray(jax.random.key_data(key)))
    place, axes, half = (np.asarray(x) for x in block.in_frame((0.0, 0.0, 0.0)))
    corner = np.where(rng.uniform(size=(n, 3)) < 0.7, rng.choice([-1.0, 1.0], (n, 3)), rng.uniform(-1.0, 1.0, (n, 3)))
    away = np.where(np.abs(corner) == 1.0, np.sign(corner) * rng.uniform(0.2, 1.0, (n, 3)), 0.0)
    away = away / np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-3)
    start = -axes.T @ place + (corner * half + 1.02 * BALL.radius * away) @ axes
    velocity = 0.3 * rng.standard_normal((n, 3))
    keep = (np.linalg.norm(away, axis=1) > 0.5) & (start[:, 2] > 1.01 * BALL.radius)
    return BallState(*(jnp.asarray(x[keep]) for x in (start, velocity, rng.standard_normal((n, 3)))))


def block_scene(blocks, law="elastic", traced=False, gravity=(0.0, 0.0, -9.81)):
    number = (lambda x: jnp.asarray(x, dtype=float)) if traced else (lambda x: x)
    floor = Plane((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), LAWS[law])
    return Scene(BALL, {"floor": floor, **BLOCKS[blocks](number, LAWS[law])}, number(gravity))


@pytest.mark.parametrize("blocks", BLOCKS)
def test_blocks(getkey, blocks):
    """Faces, edges and corners, near misses and what is between them, as often as not met by the search."""
    room = block_scene(blocks)
    states = jax.tree.map(
        lambda *x: jnp.concatenate(x), *[throws_at(getkey(), 400, block) for block in room.surfaces[1:]]
    )
    hops, loop = both(room, states, t1=1.0, max_impacts=10)
    assert (np.asarray(loop.impacts.surface) > 0).any(axis=1).mean() > 0.3
    agree(hops, loop, 1e-9, share=0.99)


@pytest.mark.parametrize("gravity", [(0.0, 0.0, -9.81), (0.0, 0.0, 0.0), (4.0, 0.0, 3.0)])
def test_slow_balls_near_edges(getkey, gravity):
    """Where a ball may fall back onto an edge that it has just passed."""
    room = block_scene("table", gravity=gravity)
    states = slow_at(getkey(), 600, room.surfaces[1])
    hops, loop = both(room, states, t1=0.5, max_impacts=6)
    assert (np.asarray(loop.impacts.surface) == 1).any(axis=1).mean() > 0.1
    agree(hops, loop, 1e-9, share=0.99)


@pytest.mark.parametrize("gravity", [(0.0, 0.0, 0.0), (2.0, -3.0, 5.0)])
def test_blocks_of_traced_numbers_in_any_gravity(getkey, gravity):
    room = block_scene("table", traced=True, gravity=gravity)
    states = throws_at(getkey(), 300, room.surfaces[1])
    agree(*both(room, states, t1=1.0, max_impacts=10), 1e-9, share=0.99)


def test_blocks_in_single_precision(getkey):
    room = block_scene("table")
    states = throws_at(getkey(), 300, room.surfaces[1], np.float32)
    hops, loop = both(room, states, t1=0.5, max_impacts=10)
    assert hops.final.position.dtype == np.float32
    agree(hops, loop, 1e-3, share=0.97)


def test_most_throws_under_a_table_need_no_search(getkey):
    """Else the quick way would be right and of no use."""
    room = block_scene("table")
    noise = np.asarray(jax.random.normal(getkey(), (3, 200, 3)))
    parts = np.asarray([-0.4, 0.0, 0.9]), np.asarray([2.0, 0.0, -5.0]), np.asarray([0.0, 15.0, 0.0])
    spread = (0.05, 0.3, 10.0)
    states = BallState(*(jnp.asarray(x + s * z) for x, s, z in zip(parts, spread, noise, strict=True)))

    def hops(state):
        t0, t1 = jnp.asarray(0.0), jnp.asarray(1.0)
        return hopped(start(room, Exact(), room.unpacked(state), t0, t1, 0, 0), room, t1, 16)[0].done

    assert jax.jit(jax.vmap(hops))(states).mean() > 0.8


def test_it_stops_before_an_impact_too_many(getkey):
    """In the place, and at the time, of the impact that it may not have."""
    states = throws(getkey(), 300, float)
    hops, loop = both(scene("elastic", ("floor", "ceiling")), states, t1=50.0, max_impacts=6)
    assert (hops.result == RESULTS.max_impacts).all() and (hops.n_impacts == 6).all()
    agree(hops, loop, 1e-11)


def test_what_is_unusual_is_left_to_the_loop():
    """A corner hit at once, a ball that lies, a plastic impact, a start in contact, a start within a wall, NaN, and a
    throw that only touches the ceiling: the results of the loop, not only their numbers."""
    room = scene("paper", ("floor", "ceiling", "left", "right"))
    touch = 2.0 * 9.81 * (1.9 - 0.5)
    position = [[0.0, 0, 1.0], [0.0, 0, 0.1], [0, 0, 0.1], [0.9, 0, 1.0], [0, 0, 0.05], [np.nan, 0, 1], [0, 0, 0.5]]
    velocity = [[9.81, 0, -9.0], [1.0, 0, 0], [0, 0, -1.0], [1.0, 0, 0], [0, 0, 0], [0, 0, 0], [0, 0, touch**0.5]]
    states = BallState(jnp.asarray(position), jnp.asarray(velocity), jnp.ones((7, 3)))
    hops, loop = both(room, states, t1=3.0, max_impacts=40)
    agree(hops, loop, 1e-9)
    assert (hops.result == RESULTS.invalid_state).tolist() == [False] * 4 + [True, True, False]


def test_a_corner_is_one_impact():
    """Thrown into the edge of two walls: one impact with both (4.2), not one after the other."""
    room = scene("elastic", ("floor", "left", "right"), gravity=(0.0, 0.0, 0.0))
    state = BallState([0.0, 0.0, 1.0], [0.9, 0.0, -0.9], [0.0, 3.0, 0.0])
    hops, loop = simulate(room, state, t1=1.5, log_size=0), simulate(room, state, t1=1.5)
    assert loop.impacts.surface[0] >= 0
    np.testing.assert_allclose(hops.final.position, loop.final.position, atol=1e-12)
    np.testing.assert_allclose(hops.final.spin, loop.final.spin, atol=1e-12)


def test_a_lane_does_not_see_the_others(getkey):
    """A lane that is not finite, or that goes on for longer, changes nothing in the lanes beside it."""
    room = scene("rough", ("floor", "ceiling"))
    states = throws(getkey(), 8, float)
    alone = simulate_batch(room, states, t1=1.0, log_size=0)
    worse = BallState(states.position.at[3].set(jnp.nan), states.velocity.at[5].mul(30.0), states.spin)
    beside = simulate_batch(room, worse, t1=1.0, log_size=0)
    rest = np.asarray([0, 1, 2, 4, 6, 7])
    assert (beside.result == RESULTS.invalid_state).tolist() == [lane == 3 for lane in range(8)]
    for a, b in zip(jax.tree.leaves(alone.final), jax.tree.leaves(beside.final), strict=True):
        np.testing.assert_array_equal(a[rest], b[rest])


def rounding_below_the_edge(dtype):
    """Throws that touch an edge, or nearly, so close to the plane of a face that rounding decides on which side."""
    gaps = [0.0, 1e-6, 1e-5, 3e-5] if dtype == jnp.float32 else [0.0, 1e-14, 1e-13]
    a, radius = (0.07 if dtype == jnp.float32 else 1e-6), 0.025
    x = np.array([[-0.5 - (radius + gap) * np.cos(a), 0.0, -0.5 - (radius + gap) * np.sin(a)] for gap in gaps])
    return BallState(*(jnp.asarray(part, dtype) for part in (x, x * 0.0 + [0.0, 0.0, 3.5], x * 0.0)))


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64], ids=["float32", "float64"])
def test_an_edge_beside_the_plane_of_a_face(dtype):
    """The ball flies into the edge; it was taken for one that the face next to the edge has behind it."""
    room = Scene(Ball(0.025, 0.046), {"box": Box(center=(0, 0, 0), half_size=(0.5, 0.5, 0.5), law=Rough())})
    states = rounding_below_the_edge(dtype)
    quick, slow = (simulate_batch(room, states, t1=0.1, log_size=size) for size in (0, 4))
    np.testing.assert_array_equal(quick.n_impacts, slow.n_impacts)
    if dtype == jnp.float32:
        assert np.all(np.asarray(quick.n_impacts) == 1)
    np.testing.assert_allclose(quick.final.velocity, slow.final.velocity, rtol=1e-3 if dtype == jnp.float32 else 1e-6)


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64], ids=["float32", "float64"])
def test_from_an_edge_onto_the_face(dtype):
    """A ball bounces on an edge, a hair below the top, and lands on the top, not as deep as it began."""
    radius, drops, t = 0.02, np.array([1.5e-4, 1e-5, 3e-13]), 0.3
    room = Scene(Ball(radius, 0.046), {"box": Box((0.6, 0.0, 0.715), (0.6, 0.4, 0.015), Rough())})
    x = -np.sqrt(2 * radius * drops - drops**2) - t
    position = np.stack([x, 0 * x, 0.75 - drops + 2.0 * t - 0.5 * 9.81 * t * t], axis=1)
    velocity = 0 * position + [1.0, 0.0, -2.0 + 9.81 * t]
    states = BallState(*(jnp.asarray(part, dtype) for part in (position, velocity, 0 * position)))
    end = simulate_batch(room, states, t1=2.0, max_impacts=1, log_size=0).final  # at the second impact
    np.testing.assert_allclose(end.position[:, 2], 0.75, atol=4 * float(jnp.finfo(dtype).eps))


def test_marks_can_be_read_back():
    for mark in [(0, -1, 2), (0, 4, 1), (77, 2, 0), (10**6, 6, 2)]:
        turn, touching, why = (jnp.asarray(x) for x in mark)
        stopped = _stopped(turn, touching, why, 3)
        assert stopped < -1 and tuple(int(x) for x in _unmarked(stopped, 3)) == mark


def test_the_program_has_no_search():
    """Where the scene is planes and no log is kept, there are two loops more, which hop: before the search, and within
    it, for what it was needed for."""
    room = scene("elastic", ("floor",))
    state = BallState([0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0])
    run = lambda size: str(jax.make_jaxpr(lambda s: simulate(room, s, t1=1.0, log_size=size, throw=False))(state))  # noqa: E731
    assert run(0).count("while[") == 2 + run(4).count("while[")
    assert Exact().is_closed_form
