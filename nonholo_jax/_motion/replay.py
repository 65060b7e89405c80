"""The motion of a system, with derivatives in both modes: find, then replay.

The event loop runs without derivatives. Where they are asked for it runs again, in tiles, and records the path (sizes
of arcs, contacts), a part at a time, and each part is repeated with derivatives in a scan that both modes can handle.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
from jax import lax

from .._math import (
    RESULTS,
    Choice,
    Iteration,
    frozen,
    in_tiles,
    shared,
    tangent_of,
    unless_batched,
    where,
    where_needed,
)
from .._world import ENDS, PAUSES, AbstractSystem
from .crossing import corrected
from .loop import (
    Carry,
    Log,
    Outcome,
    Path,
    Row,
    as_arrays,
    begin_by_hops,
    computed_once,
    find,
    finish,
    hopped,
    hopper_of,
    keep,
    kind_of,
    later,
    pack_row,
    start,
    turn,
)
from .motion import AbstractMotion

_CHUNK, _ROWS = 4, 32  # arcs: of which none is repeated where all lanes have ended; of one part of a path
_HOP_TILE = 512
_STRAGGLERS = 64  # lanes that make their turns together


class _Replay(NamedTuple):
    """A motion that is repeated with derivatives."""

    time: Any
    ahead: Any
    state: Any
    memory: Any
    jumped: Any
    since: Any
    n_impacts: Any
    values: Any  # of the log


def _repeat(r: _Replay, steps: tuple, system, motion, t1: Any, known: Carry) -> _Replay:
    """The arcs of one part of a path, which the search `known` has come to the end of."""
    log_rows = r.values.shape[0]
    reached = known.done & (known.result == RESULTS.reached_t1)

    def one(carry, step):
        time, ahead, state, memory, jumped, since, n_impacts = carry
        index, (size, s), (contact, code) = step
        used = index < known.n_arcs
        last = reached & (index == known.n_arcs - 1)
        left = t1 - time + ahead
        whole = jnp.where(used, jnp.where(jnp.isinf(size), left, size), 0.0)
        begun = system.prepared(time, state)
        piece = motion.piece(system, time, begun, memory, jumped, whole)
        arc = piece.arc
        crossed = used & (contact >= 0)
        choice = Choice(contact, system.n_contacts)
        if system.n_contacts > 0:
            (s,) = shared([where(crossed, corrected(system, arc, s, choice), s)])
        s = jnp.where(last, arc.length, s)
        s = jnp.where(used, s, 0.0)
        elapsed = s * arc.unit
        moved, next_ahead = later(time, ahead, elapsed)
        moved = jnp.where(last, t1, moved)
        arrived = as_arrays(system.advanced(moved, begun, arc.position(s), arc.velocity(s), elapsed), t1.dtype)
        arrived = computed_once(arrived)
        struck = crossed & (n_impacts < known.n_impacts)
        after, until = arrived, moved
        if system.n_contacts > 0:
            other, pause = system.after(choice, moved, arrived, kind_of(code))
            after = keep(struck, as_arrays(other, t1.dtype), arrived)
            until = jnp.where(struck, moved + pause, moved)
        row = pack_row(Row(moved, until, since + elapsed, arrived, after)) if log_rows else jnp.zeros((0,), t1.dtype)
        carry = (
            jnp.where(used, until, time),
            jnp.where(used, next_ahead, ahead),
            keep(used, after, state),
            keep(used, piece.memory, memory),
            jnp.where(used, struck, jumped),
            jnp.where(struck, 0.0, since + elapsed),
            n_impacts + struck.astype(jnp.int32),
        )
        return carry, (row, jnp.where(struck, n_impacts, log_rows))

    def chunk(r, steps):
        def run(r):
            inner, (rows, where) = lax.scan(jax.checkpoint(one, prevent_cse=False), tuple(r[:-1]), steps)
            values = r.values.at[where].set(rows, mode="drop") if log_rows else r.values
            return r._replace(values=values, **dict(zip(_Replay._fields, inner, strict=False)))

        return lax.cond(eqxi.unvmap_any(steps[0][0] < known.n_arcs), run, lambda r: r, r), None

    return lax.scan(chunk, r, steps)[0]


def _resumed(system, motion, t1, carry: Carry, stop: Any, max_impacts: int) -> Carry:
    """The loop, as far as every lane has ended or gone through `stop` arcs."""

    def one(state):
        c, ended = state
        paused = c.n_arcs >= stop
        c = turn(c._replace(done=ended | paused), system, motion, t1, max_impacts)
        return c, ended | (c.done & ~paused)

    going = lambda state: eqxi.unvmap_any(~state[1] & (state[0].n_arcs < stop))  # noqa: E731
    carry, ended = lax.while_loop(going, one, (carry, carry.done))
    return carry._replace(done=ended)


def _hop_again(r: _Replay, choices: Any, hop: Callable, t1: Any) -> _Replay:
    """The hops of a path."""

    def one(carry, choice):
        time, ahead, state, before = carry
        choice = choice.astype(t1.dtype)
        duration, state = hop(before, choice, t1 - time + ahead, state)
        time, ahead = later(time, ahead, duration)
        return (jnp.where(choice == ENDS, t1, time), ahead, state, choice), None

    def some(carry, choices):
        return lax.scan(jax.checkpoint(one, prevent_cse=False), carry, choices)[0]

    def some_if_any(carry, choices):
        return lax.cond(eqxi.unvmap_any(choices[0] != int(PAUSES)), some, lambda carry, _: carry, carry, choices), None

    chunks = -(-choices.size // _ROWS)
    size = -(-choices.size // chunks)
    choices = jnp.pad(choices, (0, size * chunks - choices.size), constant_values=int(PAUSES)).reshape(chunks, size)
    begin = (r.time, r.ahead, as_arrays(r.state, t1.dtype), jnp.full_like(t1, -1.0))
    if chunks == 1:
        time, ahead, state, _ = some(begin, choices[0])
    else:
        (time, ahead, state, _), _ = lax.scan(jax.checkpoint(some_if_any, prevent_cse=False), begin, choices)
    return r._replace(time=time, ahead=ahead, state=state)


def _iteration(max_impacts: int, log_rows: int, motion: AbstractMotion) -> Iteration:
    """The motion with derivatives: by turns a part of the path is found without them and repeated with them. Between
    the steps there is what was found, and what was repeated."""
    rows = min(_ROWS, _CHUNK * -(-motion.max_pieces(max_impacts) // _CHUNK))
    most = -(-motion.max_pieces(max_impacts) // rows)

    def harmless(arguments: Any, moves: Any) -> Any:
        """A lane that cannot start computes harmless numbers: NaN times zero is NaN in derivatives."""
        system, motion, state, t0, t1 = arguments
        tame = lambda x: jnp.where(moves, x, jnp.ones_like(x)) if eqx.is_inexact_array(x) else x  # noqa: E731
        system, state = jax.tree.map(tame, (system, as_arrays(state, t0.dtype)))
        return system, motion, state, *(jnp.where(moves, t, 0.0) for t in (t0, t1))

    def begin(arguments: Any) -> tuple:
        still = frozen(arguments)
        found = start(still[0], still[1], still[2], still[3], still[4], log_rows, 0)
        moves = ~found.done
        system, motion, state, t0, t1 = harmless(arguments, moves)
        values = jnp.where(jnp.isnan(found.log.values), 0.0, found.log.values)
        nothing, zero = jnp.zeros_like(t0), jnp.asarray(0, dtype=jnp.int32)
        _, memory = motion.begin(system, t0, state, t1)
        again = _Replay(t0, nothing, state, memory, jnp.asarray(True), nothing, zero, values)
        hopper = hopper_of(system, motion, state, max_impacts)
        if log_rows == 0 and hopper is not None and hopper.again is not None:
            found, path = frozen(hopped(found, still[0], still[4], max_impacts, max_impacts + 1))
            again = _hop_again(again, path, hopper.again, t1)._replace(n_impacts=found.n_impacts)
        done, found = found.n_arcs, found._replace(n_arcs=jnp.zeros_like(found.n_arcs))
        moving, rest = eqx.partition(again, eqx.is_inexact_array)
        return (moves, done, found, rest), moving

    def count(stays: Any, n_arcs: Any) -> Any:
        _, done, found, _ = stays
        # Rounding may find another arc or two than were found without derivatives.
        left = jnp.where(found.done, 0, jnp.maximum(n_arcs - done, 0) + 2)
        return jnp.minimum(-(-eqxi.unvmap_max(left) // rows), most)

    def look(arguments: Any, i: Any, stays: Any) -> tuple:
        moves, done, found, rest = stays
        still, way, _, _, end = frozen(arguments)
        empty = Path(jnp.zeros((rows, 2), end.dtype), jnp.full((rows, 2), -1, jnp.int32))
        search = frozen(_resumed(still, way, end, found._replace(path=empty), rows * (i + 1), max_impacts))
        return (moves, done, search._replace(path=found.path), rest), search.path

    def follow(arguments: Any, i: Any, stays: Any, path: Any, moving: Any) -> tuple:
        moves, done, search, rest = stays
        system, motion, _, _, t1 = harmless(arguments, moves)
        index = rows * i + jnp.arange(rows, dtype=jnp.int32)
        steps = jax.tree.map(lambda x: x.reshape(-1, _CHUNK, *x.shape[1:]), (index, *path))
        steps = (steps[0], *[(pair[..., 0], pair[..., 1]) for pair in steps[1:]])
        again = _repeat(eqx.combine(moving, rest), steps, system, motion, t1, search)
        moving, rest = eqx.partition(again, eqx.is_inexact_array)
        return (moves, done, search, rest), moving

    asked = lambda moving: (moving.time, moving.state, moving.values)  # noqa: E731
    return Iteration(begin, count, look, follow, lambda stays: stays[2].done, asked, most)


def _find(system, motion, state, t0, t1, **options):
    """`find`, not differentiated, and in tiles where it is batched."""
    primals = frozen((system, motion, state, t0, t1))
    hopper = hopper_of(system, motion, state, options["max_impacts"])
    if options["log_rows"] == 0 and hopper is not None:
        return _find_by_hops(*primals, alone="lax" if hopper.again is None else "hop", **options)
    return in_tiles(lambda *primals: find(*primals, **options), motion.tile)(*primals)


def _find_by_hops(system, motion, state, t0, t1, *, alone: str, max_impacts: int, log_rows: int):
    """The same: first all lanes by hops, then those that have not come to an end. Hops are so quick that reading and
    writing counts: what passes into a tile and out of it is the user's form of a state, few arrays instead of many."""

    def written(system, outcome):
        return outcome._replace(state=(system.packed(outcome.state), system.phase(outcome.state)))

    def read(system, outcome):
        return outcome._replace(state=system.unpacked(*outcome.state))

    def first(system, motion, user, phase, t0, t1):
        state = system.unpacked(user, phase)
        outcome, begun = begin_by_hops(system, motion, state, t0, t1, max_impacts=max_impacts)
        return written(system, outcome), begun

    def rest(outcome, begun, system, motion, t1):
        return written(system, finish(read(system, outcome), begun, system, motion, t1, max_impacts=max_impacts))

    def both(system, motion, user, phase, t0, t1):
        outcome, begun = in_tiles(first, _HOP_TILE)(system, motion, user, phase, t0, t1)
        return where_needed(rest, _STRAGGLERS)(begun.unfinished, outcome, (begun, system, motion, t1))

    def by_turns(system, motion, user, phase, t0, t1):
        options = {"max_impacts": max_impacts, "log_rows": log_rows}
        return written(system, find(system, motion, system.unpacked(user, phase), t0, t1, **options))

    given = (system, motion, system.packed(as_arrays(state, t0.dtype)), system.phase(state), t0, t1)
    return read(system, unless_batched(both if alone == "hop" else by_turns, both)(*given))


@eqx.filter_custom_jvp
def _find_or_replay(system, motion, state, t0, t1, *, max_impacts: int, log_rows: int):
    return _find(system, motion, state, t0, t1, max_impacts=max_impacts, log_rows=log_rows)


@_find_or_replay.def_jvp
def _find_or_replay_jvp(primals, tangents, *, max_impacts: int, log_rows: int):
    out = _find_or_replay(*primals, max_impacts=max_impacts, log_rows=log_rows)
    iteration, still = _iteration(max_impacts, log_rows, primals[1]), frozen(out)
    like = (still.time, still.state, still.log.values)
    time, state, values = tangent_of(iteration, primals, tangents, still.n_arcs, like, primals[1].tile)
    values = jnp.where(jnp.isnan(still.log.values), 0.0, values)
    nothing = jax.tree.map(lambda _: None, out)
    return out, nothing._replace(time=time, state=state, log=Log(values, None))


def run(
    system: AbstractSystem,
    motion: AbstractMotion,
    state: Any,
    t0: Any,
    t1: Any,
    *,
    max_impacts: int,
    log_rows: int,
    adjoint: Any = None,
) -> Outcome:
    """Move a system from t0 to t1 through its impacts, differentiably; see `simulate`."""
    options: dict[str, Any] = {"max_impacts": max_impacts, "log_rows": log_rows}
    if adjoint is None:
        return _find_or_replay(system, motion, state, t0, t1, **options)
    if isinstance(adjoint, diffrax.ForwardMode):
        return find(system, motion, state, t0, t1, kind="lax", **options)
    if isinstance(adjoint, diffrax.RecursiveCheckpointAdjoint):
        return find(system, motion, state, t0, t1, kind="checkpointed", **options)
    raise ValueError(
        "Argument `adjoint` must be None, diffrax.ForwardMode() or diffrax.RecursiveCheckpointAdjoint(), but got "
        f"{adjoint}; try None, which serves both modes."
    )
