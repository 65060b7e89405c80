"""Batches in tiles. On a CPU a program over thousands of lanes writes every intermediate to memory and reads it back;
over a few lanes it stays in the first cache, and each tile ends with its own slowest lane. And over devices, each of
which takes its share of the lanes and waits for no other."""

import functools
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

# Options for `jit` on a CPU. XLA takes no pains over a program that will not run for long, and uses the widest vectors
# that the processor has, not half of them. An inner `jit` may have none.
LEAST_EFFORT: Any = {"compiler_options": {"xla_backend_optimization_level": 0}}
_LONGEST_LINE = 64  # tiles
WIDEST_VECTORS: Any = {"compiler_options": {"xla_cpu_prefer_vector_width": 512}}


def on_cpu() -> bool:
    """Whether what is traced now is for a CPU: JAX's default backend, unless `jax.default_device` says otherwise."""
    chosen = jax.config.jax_default_device  # pyright: ignore[reportAttributeAccessIssue]
    return (getattr(chosen, "platform", chosen) or jax.default_backend()) == "cpu"


def is_traced(arguments: Any) -> bool:
    """Whether what is called now is within a transformation."""
    leaves = [jax.device_put(np.zeros(())), *jax.tree.leaves(arguments)]
    return any(isinstance(leaf, jax.core.Tracer) for leaf in leaves)


def with_options(function: Callable, options: dict) -> Callable:
    """`eqx.filter_jit`, with options on a CPU where they may be given."""
    plain, best = eqx.filter_jit(function), eqx.filter_jit(function, **options)

    @functools.wraps(function)
    def call(*args):
        return (best if on_cpu() and not is_traced(args) else plain)(*args)

    return call


def in_tiles(function: Callable, size: int, alone: Callable | None = None) -> Callable:
    """The same function of pytrees, which under `vmap` on a CPU runs `size` lanes at a time; `alone` is another way to
    compute it for one lane. Not differentiable in reverse mode."""
    return _in_a_batch(lambda whole, lanes, n: by_tiles(whole(function), lanes, n, size), alone or function)


def in_a_queue(begin: Callable, advance: Callable, finished: Callable, size: int, alone: Callable) -> Callable:
    """A function of pytrees, `advance(c, *args)` from `c = begin(*args)` on until `finished(c)`. Under `vmap` on a CPU
    it runs `size` lanes at a time, and where an eighth of them has finished, the next in line take their place: none
    waits for a slow one. `alone` computes it for one lane. Not differentiable in reverse mode."""

    def run_all(whole: Callable, lanes: Any, n: int) -> Any:
        first, turn = whole(begin), whole(advance)
        if n <= size or not on_cpu():
            return lax.while_loop(lambda c: ~jnp.all(finished(c)), lambda c: turn(lanes, c), first(lanes))
        queue = lambda lanes: _queued(first, turn, finished, lanes, size)  # noqa: E731
        return by_tiles(queue, lanes, n, _LONGEST_LINE * size)  # a line is kept in memory as a whole

    return _in_a_batch(run_all, alone)


def unless_batched(alone: Callable, function: Callable) -> Callable:
    """`alone` for one lane, and under `vmap` another way to compute the same. Not differentiable in reverse mode."""
    return _in_a_batch(lambda whole, lanes, n: whole(function)(lanes), alone)


def _in_a_batch(run_all: Callable, alone: Callable) -> Callable:
    """`alone`, but `run_all(whole, lanes, n)` where it is batched; `whole(f)` is f for many: a function of `lanes` and
    of what f takes before its arguments."""

    def call(*args):
        arrays, constants = eqx.partition(args, eqx.is_array)

        @custom_vmap
        def run(arrays):
            return alone(*eqx.combine(arrays, constants))

        @run.def_vmap
        def over_lanes(axis_size, in_batched, arrays):
            (batched,) = in_batched
            lanes, rest = eqx.partition(arrays, batched)

            def whole(function):
                return jax.vmap(lambda lanes, *more: function(*more, *eqx.combine(lanes, rest, constants)))

            out = run_all(whole, lanes, axis_size)
            return out, jax.tree.map(lambda _: True, out)

        return run(arrays)

    return call


def where_needed(function: Callable, size: int) -> Callable:
    """`call(needed, otherwise, args)`: `function(otherwise, *args)` where needed, else `otherwise`. Under `vmap` on a
    CPU the lanes that need it are gathered, `size` at a time, so that few of them cost little. Not differentiable in
    reverse mode."""

    def call(needed: Any, otherwise: Any, args: tuple) -> Any:
        arrays, constants = eqx.partition(args, eqx.is_array)

        @custom_vmap
        def run(needed, otherwise, arrays):
            return lax.cond(needed, lambda x: function(x, *eqx.combine(arrays, constants)), lambda x: x, otherwise)

        @run.def_vmap
        def over_lanes(n, in_batched, needed, otherwise, arrays):
            every = lambda x, batched: x if batched else jnp.broadcast_to(x, (n, *jnp.shape(x)))  # noqa: E731
            needed, otherwise = jax.tree.map(every, (needed, otherwise), tuple(in_batched[:2]))
            lanes, rest = eqx.partition(arrays, in_batched[2])
            whole = jax.vmap(lambda otherwise, lanes: function(otherwise, *eqx.combine(lanes, rest, constants)))
            if n <= size or not on_cpu():
                out = jax.tree.map(lambda a, b: jnp.where(along(needed, a), a, b), whole(otherwise, lanes), otherwise)
            else:
                out = _gathered(whole, needed, otherwise, lanes, n, size)
            return out, jax.tree.map(lambda _: True, out)

        return run(needed, otherwise, arrays)

    return call


def along(flags: Any, x: Any) -> Any:
    """Flags of lanes or of rows, in the shape that goes with an array which has those axes in front."""
    return flags.reshape(flags.shape + (1,) * (x.ndim - flags.ndim))


def quotient(n: Any, size: Any) -> tuple[Any, Any]:
    """Quotient and remainder of integers of which neither is negative, so that no sign has to be looked at."""
    size = jnp.asarray(size, n.dtype)
    return lax.div(n, size), lax.rem(n, size)


def _gathered(whole: Callable, needed: Any, otherwise: Any, lanes: Any, n: int, size: int) -> Any:
    """Those of the lanes that need it, `size` at a time; a gap in the last group is filled with some lane."""
    some = lambda: jnp.cumsum(needed, dtype=jnp.int32)  # noqa: E731
    count = lax.cond(jnp.any(needed), some, lambda: jnp.zeros(n, jnp.int32))

    def group(k: Any, out: Any) -> Any:
        index = jnp.searchsorted(count, k * size + 1 + jnp.arange(size, dtype=jnp.int32))
        found = whole(*jax.tree.map(lambda x: x.at[index].get(mode="clip"), (out, lanes)))
        return jax.tree.map(lambda x, new: x.at[index].set(new, mode="drop"), out, found)

    return lax.fori_loop(0, quotient(count[-1] + (size - 1), size)[0], group, otherwise)


def _queued(first: Callable, turn: Callable, finished: Callable, lanes: Any, size: int) -> Any:
    """All lanes, a tile of `size` at a time, in which those that have finished are replaced."""
    n, few = jax.tree.leaves(lanes)[0].shape[0], max(size // 8, 1)
    of = lambda tree, index: jax.tree.map(lambda x: x.at[index].get(mode="clip"), tree)  # noqa: E731

    def refilled(state: tuple) -> tuple:
        line, index, following = state
        own, c = of(lanes, index), of(line, index)
        busy = lambda c: ~jnp.all(finished(c)) & ((following >= np.int32(n)) | (jnp.sum(finished(c)) < few))  # noqa: E731
        c = lax.while_loop(busy, lambda c: turn(own, c), c)
        line = jax.tree.map(lambda x, new: x.at[index].set(new, unique_indices=True), line, c)
        free = finished(c)
        new = following - 1 + jnp.cumsum(free, dtype=jnp.int32)
        fresh = free & (new < np.int32(n))
        return line, jnp.where(fresh, new, index), following + jnp.sum(fresh, dtype=jnp.int32)

    def going(state: tuple) -> Any:
        line, index, following = state
        return (following < np.int32(n)) | ~jnp.all(of(finished(line), index))

    line = by_tiles(first, lanes, n, size)
    start = line, jnp.arange(size, dtype=jnp.int32), jnp.asarray(size, jnp.int32)
    return lax.while_loop(going, refilled, start)[0]


def by_tiles(whole: Callable, lanes: Any, n: int, size: int) -> Any:
    """`whole` on `n` lanes; on a CPU on tiles of at most `size` lanes, one after the other, all of one size, in eights,
    the last filled up with the last lane."""
    if n <= size or not on_cpu():
        return whole(lanes)
    n_tiles = -(-n // size)
    size = min(size, -(-n // (8 * n_tiles)) * 8)
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
