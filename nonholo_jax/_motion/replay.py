"""The motion of a system, with derivatives in both modes: find, then replay.

The event loop runs without derivatives. Where they are asked for it runs again, in tiles, and records the path a part
at a time: for every arc, what it began with, its size, and the contact that ended it. Each arc is then repeated with
derivatives on its own, from what it began with: in order for forward mode, from the last to the first in reverse.
"""

import functools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from .._math import (
    ENDS,
    PAUSES,
    Iteration,
    frozen,
    in_a_queue,
    in_tiles,
    quotient,
    shared,
    tangent_of,
    unless_batched,
    where,
    where_needed,
)
from .._world import AbstractSystem
from .crossing import crossing_time
from .hopping import begin_by_hops, finish, hopped, hopper_of
from .loop import (
    Begun,
    Carry,
    Known,
    Log,
    Outcome,
    Row,
    arcs_of,
    as_arrays,
    computed_once,
    empty_path,
    end_of,
    find,
    keep,
    kind_of,
    later,
    outcome_of,
    pack_row,
    start,
    turn,
)
from .motion import AbstractMotion

_ROWS = 32  # arcs of one part of a path
_HOP_TILE = 256
_STRAGGLERS = 64  # lanes that make their turns together


def _arc(system: AbstractSystem, motion: AbstractMotion, t1: Any, known: Known, begun: Begun) -> tuple[Begun, Row]:
    """One arc of a path, differentiable: what the next one begins with, and its row of the log."""
    left, flags = t1 - begun.time + known.ahead, known.flags
    start = system.prepared(begun.time, begun.state)
    size = where(jnp.isinf(known.size), left, known.size)
    piece = motion.piece(system, begun.time, start, begun.memory, flags.jumped, size)
    arc, s = piece.arc, known.s
    if system.n_contacts > 0:
        s = where(known.contact >= 0, crossing_time(s, known.contact, system, arc), s)
    (s,) = shared([where(flags.reached, arc.length, s)])
    elapsed = s * arc.unit
    time, _ = later(begun.time, known.ahead, elapsed)
    time = where(flags.reached, t1, time)
    arrived = as_arrays(system.advanced(time, start, arc.position(s), arc.velocity(s), elapsed), t1.dtype)
    arrived = computed_once(arrived)
    after, until, since = arrived, time, begun.since + elapsed
    if system.n_contacts > 0:
        contact = system.choice(known.contact)
        other, pause = system.after(contact, time, arrived, kind_of(known.kind))
        after = keep(flags.struck, as_arrays(other, t1.dtype), arrived)
        until = where(flags.struck, time + pause, time)
    row = Row(time, until, since, arrived, after)
    return Begun(until, after, piece.memory, where(flags.struck, 0.0, since)), row


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


def _hop_again(begun: Begun, choices: Any, hop: Callable, t1: Any) -> Begun:
    """The hops of a path."""

    def one(carry, choice):
        time, ahead, state, before = carry
        choice = choice.astype(t1.dtype)
        duration, state = hop(before, choice, t1 - time + ahead, state)
        time, ahead = later(time, ahead, duration)
        return (where(choice == ENDS, t1, time), ahead, state, choice), None

    def some(carry, choices):
        return lax.scan(jax.checkpoint(one, prevent_cse=False), carry, choices)[0]

    def some_if_any(carry, choices):
        return lax.cond(eqxi.unvmap_any(choices[0] != int(PAUSES)), some, lambda carry, _: carry, carry, choices), None

    chunks = -(-choices.size // _ROWS)
    size = -(-choices.size // chunks)
    choices = jnp.pad(choices, (0, size * chunks - choices.size), constant_values=int(PAUSES)).reshape(chunks, size)
    begin = (begun.time, jnp.zeros_like(begun.time), as_arrays(begun.state, t1.dtype), jnp.full_like(t1, -1.0))
    if chunks == 1:
        time, _, state, _ = some(begin, choices[0])
    else:
        (time, _, state, _), _ = lax.scan(jax.checkpoint(some_if_any, prevent_cse=False), begin, choices)
    return begun._replace(time=time, state=state)


def _iteration(max_impacts: int, log_rows: int, pieces: int, values: Any, in_batch: bool) -> Iteration:
    """The motion with derivatives: a part of the path is found without them, and its arcs are repeated with them."""
    of_motion = lambda system, motion: motion.in_batch(system) if in_batch else motion  # noqa: E731
    most = -(-pieces // _ROWS)
    rows = -(-pieces // most)

    def harmless(arguments: Any, moves: Any) -> Any:
        """A lane that cannot start computes harmless numbers: NaN times zero is NaN in derivatives."""
        system, motion, state, t0, t1 = arguments
        tame = lambda x: where(moves, x, jnp.ones_like(x)) if eqx.is_inexact_array(x) else x  # noqa: E731
        system, state = jax.tree.map(tame, (system, as_arrays(state, t0.dtype)))
        return system, motion, state, *(where(moves, t, 0.0) for t in (t0, t1))

    def begin(arguments: Any) -> tuple:
        still = frozen(arguments)
        found = start(still[0], still[1], still[2], still[3], still[4], 0, 0)
        moves = ~found.done
        system, motion, state, t0, t1 = harmless(arguments, moves)
        again = Begun(t0, state, motion.begin(system, t0, state, t1)[1], jnp.zeros_like(t0))
        hopper = hopper_of(system, motion, state, max_impacts)
        if log_rows == 0 and hopper is not None and hopper.again is not None:
            found, path = frozen(hopped(found, still[0], still[4], max_impacts, max_impacts + 1))
            again = _hop_again(again, path, hopper.again, t1)
        done, found = found.n_arcs, found._replace(n_arcs=jnp.zeros_like(found.n_arcs))
        return (moves, done, found), eqx.filter(again, eqx.is_inexact_array)

    def parts(stays: Any, n_arcs: Any) -> Any:
        _, done, found = stays
        # Rounding may find another arc or two than were found without derivatives.
        left = jnp.where(found.done, 0, jnp.maximum(n_arcs - done, 0) + 2)
        return jnp.minimum(quotient(eqxi.unvmap_max(left) + (rows - 1), rows)[0], most)

    def look(arguments: Any, i: Any, stays: Any) -> tuple:
        moves, done, found = stays
        still, way, _, _, end = frozen(arguments)
        way = of_motion(still, way)
        begun = Begun(found.time, found.state, found.memory, found.since)
        path = found._replace(path=empty_path(begun, rows))
        search = frozen(_resumed(still, way, end, path, rows * (i + 1), max_impacts))
        count, arcs = search.n_arcs - found.n_arcs, arcs_of(search.path, begun)
        return (moves, done, search._replace(path=found.path)), count, arcs

    def step(arguments: Any, row: Known, moving: Any) -> tuple:
        system, motion, _, _, t1 = arguments
        begun = eqx.combine(moving, eqx.filter(row.begun, eqx.is_inexact_array, inverse=True))
        after, logged = _arc(system, of_motion(system, motion), t1, row, begun)
        record = pack_row(logged) if log_rows else jnp.zeros(values.shape[1:], values.dtype)
        return eqx.filter(after, eqx.is_inexact_array), record

    return Iteration(
        begin=begin,
        parts=parts,
        look=look,
        harmless=lambda arguments, stays: harmless(arguments, stays[0]),
        starts=lambda row: eqx.filter(row.begun, eqx.is_inexact_array),
        step=step,
        place=lambda row: where(row.flags.struck, row.n_impacts, np.int32(log_rows)),
        table=np.zeros(values.shape, values.dtype),
        finished=lambda stays: stays[2].done,
        of=lambda moving, table: (moving.time, moving.state, table),
        most=most,
    )


def _find(system, motion, state, t0, t1, **options):
    """`find`, not differentiated, and in tiles where it is batched."""
    primals = frozen((system, motion, state, t0, t1))
    hopper = hopper_of(system, motion, state, options["max_impacts"])
    if options["log_rows"] == 0 and hopper is not None:
        return _find_by_hops(*primals, alone="lax" if hopper.again is None else "hop", **options)

    if system.is_long:  # a turn costs much more than to take a lane out of a tile and another one in
        ends = _in_a_queue(motion.tile, **options)(*primals)
        return outcome_of(ends)

    def many(system, motion, *rest):
        return find(system, motion.in_batch(system), *rest, **options)

    return in_tiles(many, motion.tile, alone=lambda *primals: find(*primals, **options))(*primals)


def _in_a_queue(tile: int, *, max_impacts: int, log_rows: int) -> Callable:
    """`end_of`, where a batch is a queue."""

    def begin(system, motion, state, t0, t1):
        return start(system, motion.in_batch(system), state, t0, t1, log_rows, 0)

    def advance(c, system, motion, state, t0, t1):
        del state, t0
        return turn(c, system, motion.in_batch(system), t1, max_impacts)

    alone = functools.partial(end_of, max_impacts=max_impacts, log_rows=log_rows)
    return in_a_queue(begin, advance, lambda c: c.done, tile, alone)


def _find_by_hops(system, motion, state, t0, t1, *, alone: str, max_impacts: int, log_rows: int):
    """The same: first all lanes by hops, then those that have not come to an end. Hops are so quick that reading and
    writing counts: what passes into a tile and out of it is the user's form of a state, few arrays instead of many."""

    def written(system, outcome):
        return outcome._replace(state=(system.packed(outcome.state), system.phase(outcome.state)))

    def read(system, outcome):
        return outcome._replace(state=system.unpacked(*outcome.state))

    def first(system, motion, user, phase, t0, t1):
        state = system.unpacked(user, phase)
        outcome, paused = begin_by_hops(system, motion, state, t0, t1, max_impacts=max_impacts)
        return written(system, outcome), paused

    def rest(outcome, paused, system, motion, t1):
        return written(system, finish(read(system, outcome), paused, system, motion, t1, max_impacts=max_impacts))

    def both(system, motion, user, phase, t0, t1):
        outcome, paused = in_tiles(first, _HOP_TILE)(system, motion, user, phase, t0, t1)
        return where_needed(rest, _STRAGGLERS)(paused.unfinished, outcome, (paused, system, motion, t1))

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
    still = frozen(out)
    like = (still.time, still.state, still.log.values)
    pieces = primals[1].max_pieces(primals[0].most_rows(max_impacts))
    alone, many = (_iteration(max_impacts, log_rows, pieces, still.log.values, each) for each in (False, True))
    time, state, values = tangent_of(alone, many, primals, tangents, still.n_arcs, like, primals[1].tile)
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
    kind = _loop_kind(adjoint)
    if kind is None:
        return _find_or_replay(system, motion, state, t0, t1, **options)
    return find(system, motion, state, t0, t1, kind=kind, **options)


def _loop_kind(adjoint: Any) -> str | None:
    """How the loop itself is differentiated, as `find` has it, for an `adjoint` or for such a kind."""
    if adjoint is None or adjoint in ("lax", "checkpointed"):
        return adjoint
    import diffrax

    if isinstance(adjoint, diffrax.ForwardMode):
        return "lax"
    if isinstance(adjoint, diffrax.RecursiveCheckpointAdjoint):
        return "checkpointed"
    raise ValueError(
        "Argument `adjoint` must be None, diffrax.ForwardMode() or diffrax.RecursiveCheckpointAdjoint(), but got "
        f"{adjoint}; try None, which serves both modes."
    )
