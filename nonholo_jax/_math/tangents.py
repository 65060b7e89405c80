"""Derivatives in tiles.

JAX differentiates a batched program by keeping what the derivatives need of all its lanes at once. Here the map from
tangents to tangents is one primitive, which under `vmap` goes through the lanes a tile at a time, and in reverse mode
does the same with its transpose: what a tile needs is computed in the cache, used, and dropped.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
from jax import lax
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

from .tiles import by_tiles


class Iteration(NamedTuple):
    """A program whose derivatives are asked for: some steps on numbers, of which some move with the arguments."""

    begin: (
        Callable  # of the arguments: what stays (a pytree without derivatives) and what moves (floating-point arrays)
    )
    count: Callable  # of what stays, and of the hint: how many steps there are to make, the same for all lanes
    look: Callable  # of the arguments, the number of the step, and what stays: the latter, afterwards, and a path
    follow: Callable  # of the arguments, the number of the step, what `look` returned, and what moves: what stays and
    # what moves, afterwards
    finished: Callable  # of what stays: whether there was no step too few
    of: Callable  # of what moves in the end: what is asked for, linear in it
    most: int  # steps


class _Linear(NamedTuple):
    """A function of residuals and of numbers in which it is linear: what it returns, how it is computed, and a way to
    compute it that can itself be differentiated in both modes."""

    shapes: tuple
    function: Callable
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
    return _Linear(shapes, over(linear.function), over(linear.plain))


_linear.def_impl(_apply)
_linear.def_abstract_eval(
    lambda *_, forward, **__: [jax.core.ShapedArray(x.shape, x.dtype) for x in forward.shapes],
)
ad.primitive_jvps[_linear] = _differentiated
ad.primitive_transposes[_linear] = _transposed
batching.primitive_batchers[_linear] = _batched
mlir.register_lowering(_linear, mlir.lower_fun(_apply, multiple_results=True))


def tangent_of(iteration: Iteration, primals: Any, tangents: Any, hint: Any, like: Any, tile: int) -> Any:
    """The tangent of what is asked for along `tangents`, which have `None` for what stays. `like` is something of
    the same structure and shapes."""
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

    def forward(residuals: Any, numbers: Any) -> list:
        return jax.tree.leaves(_pushed(iteration, *split(residuals), list(numbers)))

    def backward(residuals: Any, numbers: Any) -> list:
        return _pulled(iteration, *split(residuals), jax.tree.unflatten(jax.tree.structure(like), numbers))

    def plain(residuals: Any, moving: Any) -> list:
        hint, arguments, _ = split(residuals)
        return jax.tree.leaves(_all_steps(iteration, hint, arguments, moving))

    def plain_forward(residuals: Any, numbers: Any) -> list:
        at = split(residuals)[2]
        return jax.jvp(lambda *moving: plain(residuals, moving), tuple(at), tuple(numbers))[1]

    def plain_backward(residuals: Any, numbers: Any) -> list:
        at = split(residuals)[2]
        return list(jax.vjp(lambda *moving: plain(residuals, moving), *at)[1](list(numbers)))

    shapes = [tuple(jax.ShapeDtypeStruct(x.shape, x.dtype) for x in xs) for xs in (jax.tree.leaves(like), along)]
    ways = {
        "forward": _Linear(shapes[0], forward, plain_forward),
        "backward": _Linear(shapes[1], backward, plain_backward),
    }
    out = _linear.bind(*arrays, *along, n_residuals=len(arrays), tile=tile, **ways)
    return jax.tree.unflatten(jax.tree.structure(like), out)


def _pushed(iteration: Iteration, hint: Any, arguments: Callable, at: list, numbers: list) -> Any:
    """The tangent of what is asked for."""
    begin = lambda at: iteration.begin(arguments(at))[::-1]  # noqa: E731
    moving, tangent, stays = jax.jvp(begin, (at,), (numbers,), has_aux=True)

    def step(i: Any, carry: tuple) -> tuple:
        stays, moving, tangent = carry
        seen, path = iteration.look(arguments(at), i, stays)
        after = lambda at, moving: iteration.follow(arguments(at), i, seen, path, moving)[::-1]  # noqa: E731
        moving, tangent, stays = jax.jvp(after, (at, moving), (numbers, tangent), has_aux=True)
        return stays, moving, tangent

    stays, moving, tangent = lax.fori_loop(0, iteration.count(stays, hint), step, (stays, moving, tangent))
    return _known(iteration.finished(stays), jax.jvp(iteration.of, (moving,), (tangent,))[1])


def _known(finished: Any, numbers: Any) -> Any:
    """NaN where steps are missing: where rounding has led a chaotic motion to a path that is longer than its hint."""
    return jax.tree.map(lambda x: jnp.where(finished, x, jnp.nan), numbers)


class _Pull(NamedTuple):
    """How far the way back is."""

    part: Any  # the step that comes next, and what it begins with
    stays: Any
    moving: Any
    goal: Any  # the step whose transpose comes next
    kept: Any  # what steps begin with, in slots
    cotangent: Any
    sums: Any
    finished: Any


def _pulled(iteration: Iteration, hint: Any, arguments: Callable, at: list, cotangent: Any) -> list:
    """The cotangent of the arguments that move. What steps begin with is kept in a few slots; from the nearest one the
    others are found again, by the same instructions: a path found by others may differ by rounding in where a step
    ends, and would not fit to the next one."""
    begin = lambda at: iteration.begin(arguments(at))[::-1]  # noqa: E731
    moving, pull, stays = jax.vjp(begin, at, has_aux=True)
    count = iteration.count(stays, hint)
    slots = min(iteration.most, _SLOTS)
    stride = jnp.maximum(-(-count // slots), 1)
    (cotangent,) = jax.vjp(iteration.of, moving)[1](cotangent)
    kept = jax.tree.map(lambda x: jnp.broadcast_to(x, (slots, *jnp.shape(x))), (stays, moving))

    def job(c: _Pull) -> _Pull:
        seen, path = iteration.look(arguments(at), c.part, c.stays)
        after = lambda at, moving: iteration.follow(arguments(at), c.part, seen, path, moving)[::-1]  # noqa: E731

        def back(c: _Pull) -> _Pull:
            _, pull, ended = jax.vjp(after, at, c.moving, has_aux=True)
            more, cotangent = pull(c.cotangent)
            sums = [a + b for a, b in zip(c.sums, more, strict=True)]
            goal = c.goal - 1
            slot = jnp.maximum(goal, 0) // stride
            stays_there, moving_there = jax.tree.map(lambda column: column[slot], c.kept)
            finished = c.finished | ((c.goal == count - 1) & iteration.finished(ended))
            return _Pull(slot * stride, stays_there, moving_there, goal, c.kept, cotangent, sums, finished)

        def on(c: _Pull) -> _Pull:
            moving, stays = after(at, c.moving)
            part = c.part + 1
            slot = jnp.where(part % stride == 0, part // stride, slots)
            kept = jax.tree.map(lambda column, x: column.at[slot].set(x, mode="drop"), c.kept, (stays, moving))
            return c._replace(part=part, stays=stays, moving=moving, kept=kept)

        return back(c) if iteration.most == 1 else lax.cond(c.part == c.goal, back, on, c)

    zero, sums = jnp.zeros_like(count), [jnp.zeros_like(x) for x in at]
    first = _Pull(zero, stays, moving, count - 1, kept, cotangent, sums, iteration.finished(stays))
    last = lax.while_loop(lambda c: c.goal >= 0, job, first)
    return _known(last.finished, [a + b for a, b in zip(last.sums, pull(last.cotangent)[0], strict=True)])


def _all_steps(iteration: Iteration, hint: Any, arguments: Callable, at: Any) -> Any:
    """What moves in the end, in a way that JAX can differentiate as often as one likes."""
    stays, moving = iteration.begin(arguments(at))
    count = iteration.count(stays, hint)

    def step(carry: tuple, i: Any) -> tuple:
        def run(carry: tuple) -> tuple:
            stays, moving = carry
            seen, path = iteration.look(arguments(at), i, stays)
            return iteration.follow(arguments(at), i, seen, path, moving)

        return lax.cond(i < count, run, lambda carry: carry, carry), None

    body = step if iteration.most == 1 else jax.checkpoint(step, prevent_cse=False)
    return iteration.of(lax.scan(body, (stays, moving), jnp.arange(iteration.most, dtype=jnp.int32))[0][1])
