"""Random scenes and extreme throws, in a small version of experiments/extremes, and what that study has found."""

import extremes_long
import extremes_throws
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import random_scenes
from hypothesis import given, settings, strategies
from random_scenes import NAMED, OK, TEMPLATES, admissible, judged

LANES = 64  # of one example: all of them share one program
random_scenes.OPTIONS = {"xla_backend_optimization_level": 0}  # run a few times only
seeds = given(seed=strategies.integers(0, 2**32 - 1))
few = settings(max_examples=12, deadline=None, derandomize=True, database=None)


def drawn(seed, template=TEMPLATES[0]):
    return admissible(template, np.random.default_rng(seed), LANES, np.float64)


@few
@seeds
def test_random_scenes(seed):
    """Nothing is passed or entered, every throw ends with a result, none of these hides a NaN, no energy appears."""
    found = judged(TEMPLATES[0], drawn(seed), np.float64)
    assert found.tunnelled == 0 and found.unannounced == 0
    assert set(found.results) <= {*OK, *NAMED} and sum(found.results.values()) == LANES
    assert found.gained <= random_scenes.GAIN


@few
@seeds
def test_a_lane_without_numbers_leaves_the_others_alone(seed):
    """Whatever number is a NaN or an infinity, its lane is refused by name, and the others answer to the last bit."""
    numbers = drawn(seed)
    rng = np.random.default_rng(seed)
    spoilt = {name: values.copy() for name, values in numbers.items()}
    name, lane = rng.choice(sorted(numbers)), int(rng.integers(LANES))
    flat = spoilt[name].reshape(LANES, -1)
    column = {"surfaces": 0, "laws": 1}.get(name, int(rng.integers(flat.shape[1])))  # not all are used by every kind
    flat[lane, column] = rng.choice([np.nan, np.inf, -np.inf])
    run = lambda d: jax.tree.map(np.asarray, random_scenes.program(TEMPLATES[0])(jax.tree.map(jnp.asarray, d)))  # noqa: E731
    plain, mixed = run(numbers), run(spoilt)
    assert random_scenes.NAMES_OF_RESULTS[mixed[0][lane]] == "invalid_state"
    for a, b in zip(jax.tree.leaves(plain), jax.tree.leaves(mixed), strict=True):
        np.testing.assert_array_equal(np.delete(a, lane, axis=0), np.delete(b, lane, axis=0))


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_small_version_of_the_table(dtype):
    """A few rows, the derivatives too."""
    wanted = ("inertia", "grazing a plane", "restitution", "scene 1e6 m")
    throws = [throw for throw in extremes_throws.slab_throws() if throw.row.startswith(wanted)][::2]
    program = extremes_throws.with_slopes(extremes_throws.SLABS.run)
    cells = extremes_throws.judged(extremes_throws.SLABS, throws, dtype, program)
    failed = [cell for cell in cells if not (cell[1].passes and cell[2].passes)]
    assert len(cells) >= 12 and not failed, failed


def test_derivatives_beside_a_lane_without_numbers():
    """Derivatives by a number that all lanes share were NaN where the scene of one of them held a NaN, although that
    lane had no part in the result."""
    for row, value, slope in extremes_long.with_bad_lanes(np.float64):
        assert value.passes and slope.passes, (row, value, slope)


def test_last_bounces_beside_a_wall_do_not_go_through_it():
    """Bounces below rounding were taken for a train whatever was beside them: in a groove of two planes the way of the
    ball during such a train took it into the other one, in float32 by many times the rounding of its place."""
    draw = admissible(TEMPLATES[0], np.random.default_rng([0, 0]), 2048, np.float32)
    grooves = {name: values[[160, 558, 1284, 2023]] for name, values in draw.items()}
    assert judged(TEMPLATES[0], grooves, np.float32).tunnelled == 0
