"""The motion of a system, with derivatives in both modes: find, then replay.

Without derivatives the event loop runs as it is. With them it runs without them and records the path (sizes of arcs,
contacts), a part at a time, and each part is repeated with derivatives in a scan that both modes can handle.
"""

from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
from jax import lax

from ._crossing import corrected
from ._loop import (
    Carry,
    Log,
    Outcome,
    Path,
    Row,
    as_arrays,
    can_hop,
    computed_once,
    find,
    keep,
    kind_of,
    later,
    pack_row,
    start,
    turn,
)
from ._motion import AbstractMotion
from ._shared import shared
from ._system import AbstractSystem
from ._tiles import in_tiles
from ._types import RESULTS
from ._vector import frozen

_CHUNK, _CHUNKS_AT_ONCE = 16, 4
_HOP_TILE = 1024


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
        if system.n_contacts > 0:
            (s,) = shared([jnp.where(crossed, corrected(system, arc, s, contact), s)])
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
            bounced = system.bounced(contact, moved, arrived)
            other, pause = system.impact(contact, moved, arrived, bounced, kind_of(code))
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


def replay(system, motion, state, t0, t1, *, max_impacts: int, log_rows: int) -> Outcome:
    """The motion with derivatives. By turns a part of the path is found without them and repeated with them, so that
    only one part at a time is in memory."""
    still, now = frozen((system, motion)), frozen((state, t0, t1))
    chunks = -(-motion.max_pieces(max_impacts) // _CHUNK)
    size = -(-motion.max_pieces(max_impacts) // chunks)  # equal chunks, none of which is mostly padding
    per_part = min(chunks, _CHUNKS_AT_ONCE)
    rows = size * per_part
    begin = start(still[0], still[1], now[0], now[1], now[2], log_rows, rows)
    moves = ~begin.done  # a lane that cannot start computes harmless numbers, and gives back what was found
    harmless = lambda x: jnp.where(moves, x, jnp.ones_like(x)) if eqx.is_inexact_array(x) else x  # noqa: E731
    system, state = jax.tree.map(harmless, (system, as_arrays(state, t0.dtype)))  # NaN times zero is NaN in derivatives
    t0, t1 = (jnp.where(moves, t, 0.0) for t in (t0, t1))
    _, memory = motion.begin(system, t0, state, t1)
    end = frozen(t1)
    values = jnp.where(jnp.isnan(begin.log.values), 0.0, begin.log.values)

    def part(both, first):
        def run(both):
            search, r = both
            empty = Path(jnp.zeros_like(search.path.sizes), jnp.full_like(search.path.labels, -1))
            resume = lambda system, motion, t1, c, stop: _resumed(system, motion, t1, c, stop, max_impacts)  # noqa: E731
            search = in_tiles(resume, motion.tile)(*still, end, search._replace(path=empty), first + rows)
            search = frozen(search)
            index = first + jnp.arange(rows, dtype=jnp.int32)
            steps = jax.tree.map(lambda x: x.reshape(per_part, size, *x.shape[1:]), (index, *search.path))
            steps = (steps[0], *[(pair[..., 0], pair[..., 1]) for pair in steps[1:]])
            return search, _repeat(r, steps, system, motion, t1, search)

        return lax.cond(eqxi.unvmap_any(~both[0].done), run, lambda both: both, both), None

    zero = jnp.asarray(0, dtype=jnp.int32)
    nothing = jnp.zeros_like(t0)
    r = _Replay(t0, nothing, state, memory, jnp.asarray(True), nothing, zero, values)
    firsts = rows * jnp.arange(-(-chunks // per_part), dtype=jnp.int32)
    body = part if firsts.size == 1 else jax.checkpoint(part, prevent_cse=False)
    (search, r), _ = lax.scan(body, (begin, r), firsts)
    time, state = keep(moves, (r.time, r.state), (search.time, search.state))
    log = Log(jnp.where(jnp.isnan(search.log.values), search.log.values, r.values), search.log.labels)
    return Outcome(time, state, search.n_impacts, search.n_arcs, search.result, log)


def _find(system, motion, state, t0, t1, **options):
    """`find`, not differentiated, and in tiles where it is batched."""
    primals = frozen((system, motion, state, t0, t1))
    if options["log_rows"] == 0 and can_hop(system, motion, state, options["max_impacts"]):
        return _find_by_hops(*primals, **options)
    return in_tiles(lambda *primals: find(*primals, **options), motion.tile)(*primals)


def _find_by_hops(system, motion, state, t0, t1, **options):
    """The same. Hops are so quick that reading and writing counts: what passes into a tile and out of it is the user's
    form of a state, few arrays instead of many."""

    def part(system, motion, user, phase, t0, t1):
        outcome = find(system, motion, system.unpacked(user, phase), t0, t1, kind="hop", **options)
        return outcome._replace(state=(system.packed(outcome.state), system.phase(outcome.state)))

    given = (system, motion, system.packed(as_arrays(state, t0.dtype)), system.phase(state), t0, t1)
    outcome = in_tiles(part, _HOP_TILE)(*given)
    return outcome._replace(state=system.unpacked(*outcome.state))


@eqx.filter_custom_jvp
def _find_or_replay(system, motion, state, t0, t1, *, max_impacts: int, log_rows: int):
    return _find(system, motion, state, t0, t1, max_impacts=max_impacts, log_rows=log_rows)


@_find_or_replay.def_jvp
def _find_or_replay_jvp(primals, tangents, *, max_impacts: int, log_rows: int):
    options = {"max_impacts": max_impacts, "log_rows": log_rows}
    return eqx.filter_jvp(lambda *primals: replay(*primals, **options), primals, tangents)


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
        return find(system, motion, state, t0, t1, **options)
    if isinstance(adjoint, diffrax.RecursiveCheckpointAdjoint):
        return find(system, motion, state, t0, t1, kind="checkpointed", **options)
    raise ValueError(
        "Argument `adjoint` must be None, diffrax.ForwardMode() or diffrax.RecursiveCheckpointAdjoint(), but got "
        f"{adjoint}; try None, which serves both modes."
    )
