"""Batches in tiles. On a CPU a program over thousands of lanes writes every intermediate to memory and reads it back;
over a few lanes it stays in the first cache, and each tile ends with its own slowest lane."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jax.custom_batching import custom_vmap


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
            if axis_size <= size or jax.default_backend() != "cpu":
                out = whole(lanes)
            else:
                out = _in_turn(whole, lanes, axis_size, size)
            return out, jax.tree.map(lambda _: True, out)

        return run(arrays)

    return call


def _in_turn(whole: Callable, lanes: Any, n: int, size: int) -> Any:
    """`whole` on tiles of `size` lanes, one after the other; the last tile is filled up with the last lane."""
    padding = -n % size
    tiles = jax.tree.map(
        lambda x: jnp.pad(x, ((0, padding), *[(0, 0)] * (x.ndim - 1)), mode="edge").reshape(-1, size, *x.shape[1:]),
        lanes,
    )
    out = lax.map(whole, tiles)
    return jax.tree.map(lambda x: x.reshape(x.shape[0] * size, *x.shape[2:])[:n], out)
