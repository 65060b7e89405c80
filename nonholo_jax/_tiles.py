"""Batches in tiles. On a CPU a program over thousands of lanes writes every intermediate to memory and reads it back;
over a few lanes it stays in the first cache, and each tile ends with its own slowest lane. And over devices, each of
which takes its share of the lanes and waits for no other."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.custom_batching import custom_vmap
from jax.sharding import Mesh, PartitionSpec


def in_tiles(function: Callable, size: int) -> Callable:
    """The same function of pytrees, which under `vmap` on a CPU runs `size` lanes at a time. Not differentiable in
    reverse mode."""

    def call(*args):
        arrays, constants = eqx.partition(args, eqx.is_array)

        @custom_vmap
        def run(arrays):
            return function(*eqx.combine(arrays, constants))

        @run.def_vmap
        def over_lanes(axis_size, in_batched, arrays):
            (batched,) = in_batched
            lanes, rest = eqx.partition(arrays, batched)
            whole = jax.vmap(lambda lanes: function(*eqx.combine(lanes, rest, constants)))
            out = by_tiles(whole, lanes, axis_size, size)
            return out, jax.tree.map(lambda _: True, out)

        return run(arrays)

    return call


def by_tiles(whole: Callable, lanes: Any, n: int, size: int) -> Any:
    """`whole` on `n` lanes; on a CPU on tiles of `size` lanes, one after the other, the last filled up with the last
    lane."""
    if n <= size or jax.default_backend() != "cpu":
        return whole(lanes)
    n_tiles, padding = -(-n // size), -n % size
    tiles = jax.tree.map(
        lambda x: _filled(x, padding).reshape(n_tiles, size, *x.shape[1:]),
        lanes,
    )
    out = lax.map(whole, tiles)
    return jax.tree.map(lambda x: x.reshape(x.shape[0] * size, *x.shape[2:])[:n], out)


def _filled(x: Any, padding: int) -> Any:
    """With the last lane so many times more."""
    return jnp.pad(x, ((0, padding), *[(0, 0)] * (x.ndim - 1)), mode="edge")


def free_devices(args: Any) -> int:
    """Over how many devices of this process arguments may be spread: over one within a transformation, or where
    somebody has put an argument on a device of their choice."""
    leaves = [leaf for leaf in jax.tree.leaves(args) if isinstance(leaf, jax.Array)]
    if any(isinstance(leaf, jax.core.Tracer) for leaf in leaves):
        return 1
    if any(leaf.committed and len(leaf.sharding.device_set) == 1 for leaf in leaves):
        return 1
    return len(jax.local_devices())


def over_devices(function: Callable, lanes: Any, rest: Any, count: int) -> Any:
    """`function(lanes, rest)` with the first axis of `lanes` cut into as many equal parts as devices; the last part is
    filled up with the last lane."""
    n = jax.tree.leaves(lanes)[0].shape[0]
    if count == 1 or n < count:
        return function(lanes, rest)
    mesh, spec = Mesh(np.array(jax.local_devices()[:count]), ("lanes",)), PartitionSpec("lanes")
    padding = -n % count
    lanes = jax.tree.map(lambda x: _filled(x, padding), lanes)
    options = {"in_specs": (spec, PartitionSpec()), "out_specs": spec, "check_vma": False}
    out = jax.shard_map(function, mesh=mesh, **options)(lanes, rest)
    return jax.tree.map(lambda x: x[:n], out) if padding else out
