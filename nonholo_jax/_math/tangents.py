"""Derivatives in tiles.

JAX differentiates a batched program by keeping what the derivatives need of all its lanes at once. Here the map from
tangents to tangents is one primitive, which under `vmap` goes through the lanes a tile at a time, and in reverse mode
does the same with its transpose: what a tile needs is computed in the cache, used, and dropped.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

from .tiles import by_tiles, quotient


class Iteration(NamedTuple):
    """A program whose derivatives are asked for: steps on numbers, of which some move with the arguments. The steps
    come in parts. A part is first looked through without derivatives; each of its steps is then known by a row."""

    begin: (
        Callable  # of the arguments: what stays (a pytree without derivatives) and what moves (floating-point arrays)
    )
    parts: Callable  # of what stays, and of the hint: how many parts there are, as it seems, the same for all lanes
    look: Callable  # of the arguments, the number of the part, and what stays: the latter, afterwards; how many steps
    # the part has; and their rows, a pytree of arrays with an axis in front
    harmless: Callable  # of the arguments, and of what stays: arguments with which idle steps are numbers, too
    starts: Callable  # of a row: what moves, where the step begins
    step: Callable  # of the arguments, a row, and what moves: the latter, afterwards, and a record
    place: Callable  # of a row: where its record stands in the table, which has room for no other place
    table: np.ndarray  # of zeros, for the records
    finished: Callable  # of what stays: whether there was no step too few
    of: Callable  # of what moves in the end, and of the table: what is asked for, linear in both
    most: int  # parts


class _Linear(NamedTuple):
    """A function of residuals and of numbers in which it is linear: what it returns, how it is computed, and a way to
    compute it that can itself be differentiated in both modes."""

    shapes: tuple
    function: Callable
    many: Callable  # the same, in the form that is quicker in a batch
    plain: Callable


_SLOTS = 8

_linear = Primitive("linear_in_tiles")
_linear.multiple_results = True


def _apply(*args: Any, n_residuals: int, forward: _Linear, backward: _Linear, tile: int) -> list:
    del backward, tile
    return list(forward.function(args[:n_residuals], args[n_residuals:]))


def _plainly(*args: Any, n_residuals: int, forward: _Linear, backward: _Linear, tile: int) -> list:
    del backward, tile
    return list(forward.plain(args[:n_residuals], args[n_residuals:]))


def _transposed(cotangents, *args, n_residuals: int, forward: _Linear, backward: _Linear, tile: int) -> list:
    known = [ad.instantiate_zeros(cotangent) for cotangent in cotangents]
    options: dict = {"n_residuals": n_residuals, "forward": backward, "backward": forward, "tile": tile}
    return [None] * n_residuals + _linear.bind(*args[:n_residuals], *known, **options)


def _differentiated(primals, tangents, **params) -> tuple:
    """Where only the linear numbers move it is the map itself; elsewhere these are second derivatives."""
    out = _linear.bind(*primals, **params)
    n = params["n_residuals"]
    moving = [ad.instantiate_zeros(tangent) for tangent in tangents]
    if all(type(tangent) is ad.Zero for tangent in tangents[:n]):
        return out, _linear.bind(*primals[:n], *moving[n:], **params)
    return out, jax.jvp(functools.partial(_plainly, **params), tuple(primals), tuple(moving))[1]


def _batched(args, dims, *, n_residuals: int, forward: _Linear, backward: _Linear, tile: int) -> tuple:
    size = next(x.shape[d] for x, d in zip(args, dims, strict=True) if d is not None)
    front = [x if d is None else jnp.moveaxis(x, d, 0) for x, d in zip(args, dims, strict=True)]
    mapped = tuple(d is not None for d in dims)
    for i in range(n_residuals, len(front)):  # so that the transpose is linear in as many numbers
        front[i] = front[i] if mapped[i] else jnp.broadcast_to(front[i], (size, *front[i].shape))
    many = (_over_lanes(each, mapped[:n_residuals], size, tile) for each in (forward, backward))
    out = _linear.bind(*front, n_residuals=n_residuals, forward=next(many), backward=next(many), tile=tile)
    return out, [0] * len(out)


def _over_lanes(linear: _Linear, mapped: tuple, size: int, tile: int) -> _Linear:
    def over(one_lane: Callable) -> Callable:
        def function(residuals: Any, numbers: Any) -> list:
            same = [None if moves else x for moves, x in zip(mapped, residuals, strict=True)]

            def one(lane: tuple) -> list:
                own = iter(lane[0])
                return one_lane([next(own) if moves else x for moves, x in zip(mapped, same, strict=True)], lane[1])

            lanes = [x for moves, x in zip(mapped, residuals, strict=True) if moves], list(numbers)
            return by_tiles(jax.vmap(one), lanes, size, tile)

        return function

    shapes = tuple(jax.ShapeDtypeStruct((size, *x.shape), x.dtype) for x in linear.shapes)
    # Lanes that differ in nothing but what they are linear in are directions of one motion.
    return _Linear(shapes, over(linear.many if any(mapped) else linear.function), over(linear.many), over(linear.plain))


_linear.def_impl(_apply)
_linear.def_abstract_eval(
    lambda *_, forward, **__: [jax.core.ShapedArray(x.shape, x.dtype) for x in forward.shapes],
)
ad.primitive_jvps[_linear] = _differentiated
ad.primitive_transposes[_linear] = _transposed
batching.primitive_batchers[_linear] = _batched
mlir.register_lowering(_linear, mlir.lower_fun(_apply, multiple_results=True))


def tangent_of(
    iteration: Iteration, many: Iteration, primals: Any, tangents: Any, hint: Any, like: Any, tile: int
) -> Any:
    """The tangent of what is asked for along `tangents`, which have `None` for what stays. `like` is something of
    the same structure and shapes; `many` is the same program in the form that is quicker in a batch."""
    directions, structure = jax.tree.flatten(tangents, is_leaf=lambda x: x is None)
    slots = structure.flatten_up_to(primals)
    places = [i for i, x in enumerate(slots) if eqx.is_array(x)]
    moves = [directions[i] is not None for i in places]
    arrays, along = [hint, *[slots[i] for i in places]], [x for x in directions if x is not None]

    def split(residuals: Any) -> tuple[Any, Callable, list]:
        """The hint, the arguments as a function of those that move, and these."""

        def arguments(moving: Any) -> Any:
            new = iter(moving)
            filled = [next(new) if m else x for m, x in zip(moves, residuals[1:], strict=True)]
            leaves = dict(zip(places, filled, strict=True))
            return jax.tree.unflatten(structure, [leaves.get(i, x) for i, x in enumerate(slots)])

        return residuals[0], arguments, [x for m, x in zip(moves, residuals[1:], strict=True) if m]

    def forward(iteration: Iteration, residuals: Any, numbers: Any) -> list:
        return jax.tree.leaves(_pushed(iteration, *split(residuals)[1:], list(numbers)))

    def backward(iteration: Iteration, residuals: Any, numbers: Any) -> list:
        return _pulled(iteration, *split(residuals), jax.tree.unflatten(jax.tree.structure(like), numbers))

    def plain(residuals: Any, moving: Any) -> list:
        return jax.tree.leaves(_all_steps(iteration, split(residuals)[1], moving))

    def plain_forward(residuals: Any, numbers: Any) -> list:
        at = split(residuals)[2]
        return jax.jvp(lambda *moving: plain(residuals, moving), tuple(at), tuple(numbers))[1]

    def plain_backward(residuals: Any, numbers: Any) -> list:
        at = split(residuals)[2]
        return list(jax.vjp(lambda *moving: plain(residuals, moving), *at)[1](list(numbers)))

    shapes = [tuple(jax.ShapeDtypeStruct(x.shape, x.dtype) for x in xs) for xs in (jax.tree.leaves(like), along)]
    of = functools.partial
    ways = {
        "forward": _Linear(shapes[0], of(forward, iteration), of(forward, many), plain_forward),
        "backward": _Linear(shapes[1], of(backward, iteration), of(backward, many), plain_backward),
    }
    out = _linear.bind(*arrays, *along, n_residuals=len(arrays), tile=tile, **ways)
    return jax.tree.unflatten(jax.tree.structure(like), out)


def _pushed(iteration: Iteration, arguments: Callable, at: list, numbers: list) -> Any:
    """The tangent of what is asked for."""
    begin = lambda at: iteration.begin(arguments(at))[::-1]  # noqa: E731
    moving, tangent, stays = jax.jvp(begin, (at,), (numbers,), has_aux=True)

    def part(state: tuple) -> tuple:
        i, (stays, tangent, table) = state
        stays, count, rows = iteration.look(arguments(at), i, stays)

        def one(j: Any, carry: tuple) -> tuple:
            tangent, table = carry
            row = _row(rows, j)
            after = lambda at, moving: iteration.step(arguments(at), row, moving)  # noqa: E731
            new, record = jax.jvp(after, (at, iteration.starts(row)), (numbers, tangent))[1]
            used = j < count
            return _kept(used, new, tangent), _entered(table, iteration.place(row), used, record)

        return i + 1, (stays, *lax.fori_loop(0, eqxi.unvmap_max(count), one, (tangent, table)))

    first = (jnp.asarray(0), (stays, tangent, jnp.asarray(iteration.table)))
    goes_on = lambda state: (state[0] < iteration.most) & _goes_on(iteration, state[1][0])  # noqa: E731
    _, (stays, tangent, table) = part(first) if iteration.most == 1 else lax.while_loop(goes_on, part, first)
    asked = jax.jvp(iteration.of, (moving, jnp.asarray(iteration.table)), (tangent, table))[1]
    return _known(iteration.finished(stays), asked)


def _goes_on(iteration: Iteration, stays: Any) -> Any:
    """Whether a lane needs more parts. A hint only guesses at how many there are: the steps of a solver at the limit of
    its stability depend on rounding, and another program rounds otherwise."""
    return eqxi.unvmap_any(~iteration.finished(stays))


def _row(rows: Any, j: Any) -> Any:
    return jax.tree.map(lambda x: lax.dynamic_index_in_dim(x, j, keepdims=False, allow_negative_indices=False), rows)


def _kept(used: Any, new: Any, old: Any) -> Any:
    return jax.tree.map(lambda a, b: jnp.where(used, a, b), new, old)


def _entered(table: Any, place: Any, used: Any, record: Any) -> Any:
    """The table with a record more."""
    return table.at[jnp.where(used, place, table.shape[0])].set(record, mode="drop") if table.size else table


def _record(table: Any, place: Any) -> Any:
    """The record at a place, zeros for a place that there is none of."""
    zeros = jnp.zeros(table.shape[1:], table.dtype)
    return table.at[place].get(mode="fill", fill_value=0.0) if table.size else zeros


def _known(finished: Any, numbers: Any) -> Any:
    """NaN where steps are missing, which none should be."""
    return jax.tree.map(lambda x: jnp.where(finished, x, jnp.nan), numbers)


class _Pull(NamedTuple):
    """How far the way back is."""

    part: Any  # which is looked through next, and what it begins with
    stays: Any
    goal: Any  # the part whose transpose comes next
    last: Any  # the part that seems to be the last one, and with which the way back begins
    kept: Any  # what parts begin with, in slots
    cotangent: Any
    sums: Any
    finished: Any


def _pulled(iteration: Iteration, hint: Any, arguments: Callable, at: list, cotangent: Any) -> list:
    """The cotangent of the arguments that move. What parts begin with is kept in a few slots; from the nearest one the
    others are found again, by the same instructions: a path found by others may differ by rounding in where a step
    ends, and would not fit to the next one."""
    begin = lambda at: iteration.begin(arguments(at))[::-1]  # noqa: E731
    moving, pull, stays = jax.vjp(begin, at, has_aux=True)
    cotangent, cotangents = jax.vjp(iteration.of, moving, jnp.asarray(iteration.table))[1](cotangent)
    parts, sums = iteration.parts(stays, hint), [jnp.zeros_like(x) for x in at]
    slots = min(iteration.most, _SLOTS)
    stride = jnp.maximum(quotient(parts + (slots - 1), slots)[0], 1)
    kept = jax.tree.map(lambda x: jnp.broadcast_to(x, (slots, *jnp.shape(x))), stays)

    def job(c: _Pull) -> _Pull:
        stays, count, rows = iteration.look(arguments(at), c.part, c.stays)
        # Where steps are missing after the last part, there is another one behind it.
        behind = (c.part == c.last) & (c.goal == c.last) & (c.part + 1 < iteration.most) & _goes_on(iteration, stays)
        here = (c.part == c.goal) & ~behind
        steps = jnp.where(here, eqxi.unvmap_max(count), 0)

        def one(k: Any, carry: tuple) -> tuple:
            cotangent, sums = carry
            j = steps - 1 - k
            row, used = _row(rows, j), j < count
            after = lambda at, moving: iteration.step(arguments(at), row, moving)  # noqa: E731
            known = _record(cotangents, iteration.place(row))
            more, new = jax.vjp(after, at, iteration.starts(row))[1]((cotangent, known))
            # Not only added: the row of a step that there is none of may have derivatives that are no numbers.
            return _kept(used, new, cotangent), _kept(used, jax.tree.map(jnp.add, sums, more), sums)

        cotangent, sums = lax.fori_loop(0, steps, one, (c.cotangent, c.sums))
        if iteration.most == 1:
            return c._replace(stays=stays, cotangent=cotangent, sums=sums, goal=c.goal - 1)
        on, goal = c.part + 1, jnp.where(here, c.goal - 1, jnp.where(behind, c.goal + 1, c.goal))
        slot, beside = quotient(on, stride)
        slot = jnp.where(here | (beside != 0), slots, slot)
        kept = jax.tree.map(lambda column, x: column.at[slot].set(x, mode="drop"), c.kept, stays)
        nearest = jnp.minimum(quotient(jnp.maximum(goal, 0), stride)[0], slots - 1)
        finished = c.finished | (here & (c.goal == c.last) & iteration.finished(stays))
        stays = _kept(here, _row(kept, nearest), stays)
        return _Pull(
            jnp.where(here, nearest * stride, on),
            stays,
            goal,
            jnp.maximum(c.last, goal),
            kept,
            cotangent,
            sums,
            finished,
        )

    zero = jnp.zeros_like(parts)
    first = _Pull(zero, stays, parts - 1, parts - 1, kept, cotangent, sums, iteration.finished(stays))
    if iteration.most == 1:
        last = lax.cond(parts > 0, job, lambda c: c, first._replace(goal=zero))
        last = last._replace(finished=iteration.finished(last.stays))
    else:
        last = lax.while_loop(lambda c: c.goal >= 0, job, first)
    return _known(last.finished, jax.tree.map(jnp.add, last.sums, pull(last.cotangent)[0]))


def _all_steps(iteration: Iteration, arguments: Callable, at: Any) -> Any:
    """What moves in the end, in a way that JAX can differentiate as often as one likes."""
    stays, moving = iteration.begin(arguments(at))

    def part(carry: tuple, i: Any) -> tuple:
        def run(carry: tuple) -> tuple:
            stays, *rest = carry
            stays, count, rows = iteration.look(arguments(at), i, stays)
            tame = iteration.harmless(arguments(at), stays)

            def one(carry: tuple, each: tuple) -> tuple:
                j, row = each

                def make(carry: tuple) -> tuple:
                    moving, table = carry
                    new, record = iteration.step(tame, row, moving)
                    return _kept(j < count, new, moving), _entered(table, iteration.place(row), j < count, record)

                return lax.cond(eqxi.unvmap_any(j < count), make, lambda carry: carry, carry), None

            index = jnp.arange(jax.tree.leaves(rows)[0].shape[0], dtype=jnp.int32)
            return stays, *lax.scan(jax.checkpoint(one, prevent_cse=False), tuple(rest), (index, rows))[0]

        return lax.cond(_goes_on(iteration, carry[0]), run, lambda carry: carry, carry), None

    first = (stays, moving, jnp.asarray(iteration.table))
    body = part if iteration.most == 1 else jax.checkpoint(part, prevent_cse=False)
    _, moving, table = lax.scan(body, first, jnp.arange(iteration.most, dtype=jnp.int32))[0]
    return iteration.of(moving, table)
