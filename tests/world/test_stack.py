"""Surfaces in a stack are the same surfaces: a board of many gives the impacts that it gives one by one."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import AIR, lane, result_of, states

from nonholo_jax import (
    Air,
    Ball,
    Box,
    Cylinder,
    Exact,
    Frictional,
    Integrated,
    Plane,
    Rectangle,
    Rough,
    Scene,
    Smooth,
    Sphere,
    simulate,
    simulate_batch,
)
from nonholo_jax._world.surface import AbstractSurface
from nonholo_jax._world.touching import Stack, stacked

BALL = Ball(0.05, 0.7)
UP = (0.0, 0.0, 1.0)
N_ROWS = 6


def ring(n, radius, turn=0.0):
    angles = 2 * np.pi * np.arange(n) / n + turn
    return [(radius * float(np.cos(a)), radius * float(np.sin(a))) for a in angles]


def posts(n, law, radius=0.9, size=0.05):
    return {f"post{i}": Cylinder((x, y, 0.0), UP, size + 0.001 * i, law) for i, (x, y) in enumerate(ring(n, radius))}


def room(n, law, radius=1.6):
    return {f"wall{i}": Plane((x, y, 0.0), (-x, -y, 0.0), law) for i, (x, y) in enumerate(ring(n, radius))}


def globes(n, law):
    return {f"globe{i}": Sphere((x, y, 0.3), 0.1 + 0.001 * i, law) for i, (x, y) in enumerate(ring(n, 0.9))}


def boxes(n, law):
    return {f"box{i}": Box((x, y, 0.3), (0.12, 0.1 + 0.01 * i, 0.2), law) for i, (x, y) in enumerate(ring(n, 0.9))}


def plates(n, law):
    return {
        f"plate{i}": Rectangle((x, y, 0.3), (x, y, 0.0), UP, (0.3, 0.25 + 0.01 * i), law)
        for i, (x, y) in enumerate(ring(n, 0.9))
    }


ROWS = {"posts": (posts, 12), "globes": (globes, 12), "room": (room, 10), "boxes": (boxes, 6), "plates": (plates, 6)}
LAWS = {
    "rough": Rough(0.9),
    "two_coefficients": Rough(0.9, 0.5),
    "smooth": Smooth(0.85),
    "frictional": Frictional(0.8, 0.3, 0.2),
}


def board(row, law, n=None, air=None):
    """A row between two single surfaces, which are met as well."""
    build, most = ROWS[row]
    low, high = Plane((0.0, 0.0, 0.0), UP, law), Sphere((0.0, 0.0, 0.3), 2.2, law, inside=True)
    return Scene(BALL, {"floor": low, **build(n or most, law), "dome": high}, air=air)


def throws(n, seed=0):
    rng = np.random.default_rng(seed)
    angle = rng.uniform(0, 2 * np.pi, n)
    velocity = np.stack([5 * np.cos(angle), 5 * np.sin(angle), rng.uniform(0, 2, n)], axis=1)
    return states(np.tile([0.02, 0.01, 0.3], (n, 1)), velocity, rng.normal(0, 10, (n, 3)))


@pytest.fixture(scope="module", autouse=True)
def _without_the_slow_passes_of_the_compiler():
    jax.config.update("jax_disable_most_optimizations", True)
    yield
    jax.config.update("jax_disable_most_optimizations", False)


@pytest.fixture(autouse=True)
def _planes_are_stacked_too(monkeypatch):
    """From so many on that a room of them is still quick to test."""
    monkeypatch.setattr(Plane, "few", AbstractSurface.few)


@pytest.fixture
def one_by_one(monkeypatch):
    """What a function gives where no surfaces are stacked."""

    def call(function):
        with monkeypatch.context() as patch:
            for surface in (AbstractSurface, Plane):
                patch.setattr(surface, "few", 10**6)
            jax.clear_caches()
            answer = jax.block_until_ready(function())
        jax.clear_caches()
        return answer

    return call


def assert_same(got, wanted, rtol=1e-9):
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=rtol, atol=rtol), got, wanted)


# Each row once, each law, and one row in air. Rows of 6, as the programs of single surfaces grow with their number.
# In the dome a ball could stay, and in the groove between it and a globe: the programs that follow it there take
# several times as long to compile, and one stands for all.
CASES = [
    ("globes", "smooth", None, None),
    ("room", "two_coefficients", None, Exact()),
    ("boxes", "frictional", None, Exact()),
    ("plates", "rough", None, Exact()),
    ("posts", "frictional", Air(**AIR), Integrated(edges=False)),
]
cases = pytest.mark.parametrize("row, law, air, motion", CASES, ids=[f"{c[0]}_{c[1]}" for c in CASES])


def impacts(trajectory):
    """As many rows as there are impacts at most: traced surfaces may be flush and have rows for passing as well."""
    log, rows = trajectory.impacts, (..., slice(N_ROWS))
    return log.time[rows], log.surface[rows], log.normal[..., :N_ROWS, :], trajectory.final, trajectory.n_impacts


@cases
def test_a_batch_on_a_stacked_board_moves_as_on_single_surfaces(row, law, air, motion, one_by_one):
    scene, batch = board(row, LAWS[law], 6, air), throws(32)

    def run():
        return impacts(simulate_batch(scene, batch, t1=0.35, max_impacts=N_ROWS, motion=motion))

    assert any(isinstance(each, Stack) for each in scene.engine(jnp.float64).surfaces)
    got = run()
    in_row = (got[1] > 0) & (got[1] < scene.n_contacts - 1)
    assert len(np.unique(got[1][in_row])) > 2  # several members of the row are hit
    assert_same(got, one_by_one(run))


@pytest.mark.parametrize("row, law", [("posts", "rough"), ("room", "frictional")])
def test_traced_numbers_and_derivatives_are_those_of_the_members_alone_that_are_hit(row, law):
    """Members that are not hit change nothing, so that the few that are may stand for all, one by one."""
    scene = board(row, LAWS[law])
    x, y = ring(ROWS[row][1], 5.0, 0.02)[2]
    state = states([0.02, 0.01, 0.3], [x, y, 1.0], [3.0, -8.0, 5.0])
    options = {"t1": 0.35, "max_impacts": N_ROWS, "motion": Exact(), "throw": False}

    def run(scene):
        def end(scene, state):
            trajectory = simulate(scene, state, **options)
            return jnp.sum(trajectory.final.position), impacts(trajectory)

        traced = jax.tree.map(jnp.asarray, scene)
        return jax.jit(jax.value_and_grad(end, argnums=(0, 1), has_aux=True))(traced, state)

    (_, log), (of_scene, of_state) = run(scene)
    assert_same(log, impacts(simulate(scene, state, **options)))  # of constants
    time, surface, normal, final, n_impacts = log
    struck = sorted(set(np.asarray(surface).tolist()) - {-1})
    assert set(struck) - {0, scene.n_contacts - 1} and len(struck) <= 4
    few = Scene(scene.ball, {scene.names[i]: scene.surfaces[i] for i in struck}, scene.gravity)
    (_, alone), (of_few, of_state_alone) = run(few)
    numbers = np.array([*struck, -1])[np.asarray(alone[1])]
    assert_same((time, surface, normal, final, n_impacts), (alone[0], numbers, *alone[2:]))
    assert_same((of_state, of_scene.ball, of_scene.gravity), (of_state_alone, of_few.ball, of_few.gravity), 1e-8)
    for i, derivative in enumerate(of_scene.surfaces):
        expected = of_few.surfaces[struck.index(i)] if i in struck else jax.tree.map(jnp.zeros_like, derivative)
        assert_same(derivative, expected, 1e-8)


def test_the_log_counts_in_the_order_of_the_scene():
    law = Rough(0.9)
    scene = Scene(BALL, {"floor": Plane((0.0, 0.0, 0.0), UP, law), **posts(12, law), **room(10, law)}, (0.0, 0.0, 0.0))
    kinds = [type(each) for each in scene.engine(jnp.float64).surfaces]
    assert kinds == [Plane, Stack, Stack]
    assert [start for start, _ in scene.engine(jnp.float64).contacts()] == [0, 1, 13]
    # Straight at a post, and between two posts at a wall.
    at = lambda x, y: states([0.0, 0.0, 0.3], [4.0 * x, 4.0 * y, 0.0], [0.0, 0.0, 0.0])  # noqa: E731
    aims = [at(*ring(12, 1.0)[5]), at(*ring(60, 1.0)[18])]
    batch = jax.tree.map(lambda *leaves: jnp.stack(leaves), *aims)
    first = simulate_batch(scene, batch, t1=0.5, max_impacts=1).impacts.surface[:, 0]
    assert [scene.names[i] for i in first] == ["post5", "wall3"]


def test_a_corner_within_a_stack_is_a_corner():
    """Into the edge of two walls of one stack, of which each turns the ball back by its own plane alone."""
    law = Smooth(1.0)
    scene = Scene(BALL, room(12, law), (0.0, 0.0, 0.0))
    few = Scene(BALL, dict(list(room(12, law).items())[:2]), (0.0, 0.0, 0.0))
    x, y = ring(12, 1.0, np.pi / 12)[0]
    start = states([0.0, 0.0, 0.3], [3.0 * x, 3.0 * y, 0.4], [0.0, 0.0, 2.0])
    assert [type(each) for each in scene.engine(jnp.float64).surfaces] == [Stack]
    ends = [simulate(each, start, t1=0.9, max_impacts=4) for each in (scene, few)]
    assert int(ends[0].n_impacts) == 1
    np.testing.assert_allclose(ends[0].final.velocity, [-3.0 * x, -3.0 * y, 0.4], rtol=1e-12, atol=1e-12)
    assert_same(ends[0].final, ends[1].final, 1e-12)


@pytest.mark.parametrize("speed", [0.0, 0.3], ids=["rests", "rolls"])
def test_what_happens_after_bounces_on_a_member_is_what_happens_on_it_alone(speed):
    law = Rough(0.4)
    table = {f"box{i}": Box((2.0 * i, 0.0, 0.0), (0.5, 0.5, 0.1), law) for i in range(6)}
    scenes = Scene(BALL, table), Scene(BALL, {"box3": table["box3"]})
    start = states([6.0, 0.0, 0.3], [speed, 0.0, 0.0], [0.0, 0.0, 0.0])
    ends = [simulate(scene, start, t1=1.2) for scene in scenes]
    assert isinstance(scenes[0].engine(jnp.float64).surfaces[0], Stack)
    assert result_of(ends[0]) == result_of(ends[1])
    assert_same(ends[0].final, ends[1].final, 1e-12)
    n = int(ends[0].n_impacts)
    assert n == int(ends[1].n_impacts)
    supports = [np.asarray(end.impacts.support[:n]) for end in ends]
    np.testing.assert_array_equal(supports[0], np.where(supports[1] == 0, 3, -1))
    assert supports[0][-1] == 3


def test_a_program_does_not_grow_with_a_stack():
    def operations(n):
        scene = Scene(BALL, posts(n, Rough(0.9), radius=3.0))
        program = jax.jit(lambda state: simulate(scene, state, t1=0.35, throw=False).final)
        return program.lower(lane(throws(1), 0)).as_text().count(" = ")

    assert operations(40) <= operations(10) * 1.001


def test_surfaces_of_another_structure_are_no_stack():
    """Nor are few of one, and a stack ends where the row does. An elastic law is structure."""
    one, other = posts(6, Rough(0.9)), posts(6, Rough(1.0))
    surfaces = [*one.values(), *globes(2, Rough(0.9)).values(), *other.values()]
    found = stacked(surfaces, jnp.float64)
    assert [each.count if isinstance(each, Stack) else 1 for each in found] == [6, 1, 1, 6]
    radii, numbers = found[0].each(3, lambda member: (member.surface.radius, member.number))
    np.testing.assert_allclose(radii, [each.radius for each in one.values()], rtol=1e-15)
    np.testing.assert_array_equal(numbers, range(3, 9))
    assert found[0].at(jnp.asarray(4)).radius == one["post4"].radius
