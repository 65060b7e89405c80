"""A batch that runs in tiles is the batch that runs at once, whatever its size, and lane by lane the single motion."""

import dataclasses
import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import all_surfaces, scene_of, stacked, throws

from nonholo_jax import Exact, Rough, simulate, simulate_batch
from nonholo_jax._math import tiles
from nonholo_jax._math.tiles import in_a_queue, in_tiles

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


@pytest.mark.parametrize("n", [1, 4, 5, 37, 700])
def test_a_queue_of_any_length(n, monkeypatch):
    """Lanes that take from no turn to fifty, in tiles of four: each as it goes alone, in its place, also where the line
    is cut into several, within another batch, and with an argument that all lanes share."""
    monkeypatch.setattr(tiles, "_LONGEST_LINE", 16)

    def begin(count, x, rate):
        return {"left": count, "x": x * jnp.ones_like(rate), "turns": jnp.zeros((2,), jnp.int32)}

    def advance(c, _, __, rate):
        going = c["left"] > 0
        new = {"left": c["left"] - 1, "x": c["x"] * rate + 1.0, "turns": c["turns"] + 1}
        return jax.tree.map(lambda a, b: jnp.where(going, a, b), new, c)

    finished = lambda c: c["left"] <= 0  # noqa: E731

    def alone(*args):
        return jax.lax.while_loop(lambda c: ~finished(c), lambda c: advance(c, *args), begin(*args))

    rng = np.random.default_rng(n)
    counts = rng.integers(0, 8, n) + 40 * (rng.uniform(size=n) < 0.1)
    args = jnp.asarray(counts), jnp.asarray(rng.normal(size=n)), jnp.asarray(0.9)
    queue = in_a_queue(begin, advance, finished, 4, alone)
    wanted = jax.vmap(alone, (0, 0, None))(*args)
    found = jax.jit(jax.vmap(queue, (0, 0, None)))(*args)
    assert np.array_equal(found["turns"], np.stack([counts, counts], axis=1))
    for one, other in zip(jax.tree.leaves(found), jax.tree.leaves(wanted), strict=True):
        assert np.array_equal(one, other)
    rates = jnp.asarray([0.9, 1.1])
    nested = jax.vmap(jax.vmap(queue, (0, 0, None)), (None, None, 0))(*args[:2], rates)
    assert np.array_equal(nested["x"][0], wanted["x"])
    single = queue(args[0][0], args[1][0], args[2])
    assert np.array_equal(single["x"], wanted["x"][0])


def test_nobody_in_a_queue_waits_for_a_slow_lane():
    """One lane in sixteen takes a hundred turns, the others take one: 1,840 in all, where tiles of sixteen, each with a
    slow one, would take 25,600. Lanes count what they are taken along for, finished or not."""
    counts = jnp.where(jnp.arange(256) % 16 == 0, 100, 1)

    def begin(count):
        return {"left": count, "turns": 0 * count}

    def advance(c, count):
        del count
        return {"left": c["left"] - 1, "turns": c["turns"] + 1}

    queue = in_a_queue(begin, advance, lambda c: c["left"] <= 0, 16, begin)
    turns = np.asarray(jax.vmap(queue)(counts)["turns"])
    assert np.all(turns >= np.asarray(counts)) and turns.sum() < 6000


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


def test_a_log_in_tiles(getkey):
    """The log of a batch is put together tile by tile: the same rows, derivatives in both modes."""
    scene, states = scene_of(PLANE, Rough(0.8, tangential=0.4)), throws(PLANE, getkey(), 11)

    def run(motion):
        def total(shift):
            moved = dataclasses.replace(states, velocity=states.velocity + shift)
            batch = simulate_batch(scene, moved, t1=1.0, max_impacts=4, motion=motion)
            return jnp.nansum(batch.impacts.point * batch.impacts.after.velocity), batch

        shift = jnp.zeros((11, 3))
        slope, batch = jax.jit(jax.grad(total, has_aux=True))(shift)
        along = jax.jit(lambda x, d: jax.jvp(lambda x: total(x)[0], (x,), (d,))[1])(shift, jnp.cos(slope))
        return slope, along, batch.impacts, batch.final

    tiles, whole = run(Exact(tile=4)), run(Exact(tile=1000))
    assert bool(jnp.any(tiles[2].surface >= 0)) and bool(jnp.any(tiles[2].surface < 0))
    assert np.allclose(tiles[1], np.sum(tiles[0] * np.cos(tiles[0])), rtol=1e-10)
    for one, other in zip(jax.tree.leaves(tiles), jax.tree.leaves(whole), strict=True):
        assert np.allclose(one, other, rtol=0, atol=1e-10, equal_nan=True)


DEVICES = """
import jax, jax.numpy as jnp, numpy as np
jax.config.update("jax_enable_x64", True)
from nonholo_jax import Ball, BallState, Plane, Rough, Scene, simulate_batch
n = 5
restitution = jnp.linspace(0.5, 1.0, n)
scene = Scene(Ball(0.1, 1.0), {"floor": Plane((0, 0, 0), (0, 0, 1), Rough(restitution))})
spin = jnp.arange(3.0 * n).reshape(n, 3)
states = BallState(jnp.ones((n, 3)), jnp.ones((n, 3)), spin)
options = {"t1": jnp.asarray(1.0), "scene_axes": 0, "max_impacts": 3}
spread = simulate_batch(scene, states, **options)
first = jax.devices()[0]
alone = simulate_batch(scene, jax.device_put(states, first), **options)
inside = jax.jit(lambda states: simulate_batch(scene, states, **options))(states)
counts = [len(each.final.position.sharding.device_set) for each in (spread, alone, inside)]
assert counts[1:] == [1, 1], counts
for other in (alone, inside):
    for a, b in zip(jax.tree.leaves(spread), jax.tree.leaves(other), strict=True):
        np.testing.assert_allclose(np.asarray(a), np.asarray(b), rtol=1e-13, atol=1e-15)
print("shared by", counts[0], jax.device_count())
"""


def test_devices_share_a_batch():
    """Over two devices of a process of its own, an odd number of lanes; but not where a device was chosen, nor within a
    transformation. The answer is the same."""
    flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count=2"
    environment = {**os.environ, "XLA_FLAGS": flags}
    done = subprocess.run([sys.executable, "-c", DEVICES], capture_output=True, text=True, env=environment, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == ["shared", "by", "2", "2"]


def test_a_batch_on_a_cpu_is_cut_into_tiles_where_an_accelerator_is_there_too(monkeypatch):
    loops = lambda: str(jax.make_jaxpr(in_tiles_of_two())(jnp.ones(8))).count("scan[")  # noqa: E731
    in_tiles_of_two = lambda: jax.vmap(in_tiles(lambda x: 2.0 * x, 2))  # noqa: E731
    assert loops() == 1
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert loops() == 0
    with jax.default_device(jax.devices("cpu")[0]):
        assert loops() == 1
