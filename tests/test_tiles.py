"""A batch that runs in tiles is the batch that runs at once, whatever its size, and lane by lane the single motion."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import all_surfaces, scene_of, stacked, throws

from nonholo_jax import Exact, Rough, simulate, simulate_batch
from nonholo_jax._tiles import in_tiles

PLANE = all_surfaces[0]


@pytest.mark.parametrize("n", [1, 4, 7, 8, 13])
def test_any_size_and_any_axes(n):
    """Mapped and unmapped arguments, integers and floats, whole tiles and a rest."""

    def function(x, k, shift):
        return x.sum() + shift, k + 1

    x, k = jnp.arange(3.0 * n).reshape(n, 3), jnp.arange(n)
    total, count = jax.vmap(in_tiles(function, 4), in_axes=(0, 0, None))(x, k, jnp.asarray(0.5))
    assert np.array_equal(total, np.asarray(x).sum(axis=1) + 0.5)
    assert np.array_equal(count, np.arange(n) + 1)
    nested = jax.vmap(jax.vmap(in_tiles(function, 4), (0, None, None)), (None, 0, None))(x, k, jnp.asarray(0.5))
    assert nested[0].shape == (n, n) and np.array_equal(nested[0], np.tile(np.asarray(total), (n, 1)))


def test_a_tile_is_as_large_as_asked():
    """What runs at once is seen in the program: the largest array of its inner loop."""
    program = jax.make_jaxpr(jax.vmap(in_tiles(jnp.sin, 4)))(jnp.zeros(10))
    assert "f64[4]" in str(program) and "f64[3,4]" in str(program)


def test_tiles_do_not_change_a_motion(getkey):
    """To rounding: the values, the log and the derivatives of a batch over several tiles."""
    scene = scene_of(PLANE, Rough(0.8, tangential=0.4))
    state = throws(PLANE, getkey(), 21)

    def run(motion):
        def value(state):
            trajectory = simulate(scene, state, t1=1.0, max_impacts=8, motion=motion, throw=False)
            return stacked(trajectory.final), trajectory.impacts.time

        return jax.jit(jax.vmap(value))(state), jax.jit(jax.vmap(jax.jacrev(lambda s: value(s)[0])))(state)

    for one, other in zip(jax.tree.leaves(run(Exact(tile=8))), jax.tree.leaves(run(Exact(tile=1000))), strict=True):
        assert np.allclose(one, other, rtol=0, atol=1e-11, equal_nan=True)


def test_scene_parameters_in_tiles(getkey):
    state = throws(PLANE, getkey(), 11)
    restitution = jnp.linspace(0.0, 1.0, 11)
    scene = scene_of(PLANE, Rough(restitution))
    batch = simulate_batch(scene, state, t1=0.5, max_impacts=4, scene_axes=0, motion=Exact(tile=4), log_size=0)

    def one(restitution, state):
        return simulate(scene_of(PLANE, Rough(restitution)), state, t1=0.5, max_impacts=4, throw=False)

    single = jax.vmap(one)(restitution, state)
    assert np.allclose(stacked(batch.final), stacked(single.final), rtol=0, atol=1e-14)
