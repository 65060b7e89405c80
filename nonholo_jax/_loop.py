"""The event loop. It knows no ball: a system gives it arcs, levels and impacts over a state that is any pytree.

Two passes (design decision "find, then replay"). `find` runs one flat loop: a turn searches one arc for its first
crossing and finishes it with an impact, or goes on with the next arc; lanes of a batch are each in their own bounce.
Where derivatives are taken, `find` runs without them and records the path (sizes of arcs, contacts), and `replay`
repeats that path with derivatives in a scan that both modes of differentiation can handle.
"""

from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
from jax import lax

from ._hops import ENDS, FULL
from ._crossing import corrected, meeting, newton, search
from ._motion import AbstractMotion
from ._shared import shared
from ._system import AbstractSystem
from ._tiles import in_tiles
from ._types import KINDS, RESULTS
from ._vector import frozen, norm

_CHUNK, _CHUNKS_AT_ONCE = 16, 4
_HOP_TILE = 1024
_MOST_IMPACTS_AT_ONCE = 32


class Row(NamedTuple):
    """One impact, as the log keeps it."""

    time: Any
    until: Any  # when `after` holds: later than `time` if a train is summed
    duration: Any
    before: Any
    after: Any


class Log(NamedTuple):
    """Impacts in the order in which they happen: floats packed into one buffer, one write an impact."""

    values: Any
    labels: Any  # contact, kind, and the phase that follows, or -1


class Path(NamedTuple):
    """What `replay` needs of every arc: its size in seconds (infinite for one that reaches as far as t1, whose size
    has derivatives), where it was cut in local time, by which contact, and what kind of impact that was."""

    sizes: Any
    labels: Any


class Outcome(NamedTuple):
    """What a run returns."""

    time: Any
    state: Any
    n_impacts: Any
    n_arcs: Any
    result: Any
    log: Log


class _Carry(NamedTuple):
    # where the motion is
    time: Any
    state: Any
    memory: Any
    # how the present arc is searched
    s: Any  # local time up to which no contact is crossed
    window: Any  # how far ahead the search looks
    touching: Any  # contact just left, or -1
    jumped: Any  # an impact has happened since the last arc
    control: Any
    # what was done
    since: Any  # seconds since the last impact
    n_impacts: Any
    n_arcs: Any
    n_turns: Any
    n_at_once: Any
    log: Log
    path: Path
    # why it ended
    done: Any
    result: Any


def pack_row(row: Row) -> Any:
    return jnp.concatenate([jnp.ravel(leaf) for leaf in jax.tree.leaves(row)])


def unpack_row(values: Any, like: Any) -> Row:
    """The rows of a log, leading axes kept; `like` is a state of the right structure."""
    leaves, treedef = jax.tree.flatten(Row(jnp.zeros(()), jnp.zeros(()), jnp.zeros(()), like, like))
    rows, start = [], 0
    for leaf in leaves:
        stop = start + jnp.size(leaf)
        part = values[..., start:stop]
        rows.append(part[..., 0] if jnp.ndim(leaf) == 0 else part)
        start = stop
    return jax.tree.unflatten(treedef, rows)


def _arrays(state: Any, dtype: Any) -> Any:
    return jax.tree.map(lambda x: jnp.asarray(x, dtype=dtype), state)


def _empty_log(state: Any, like: Any, rows: int) -> Log:
    width = pack_row(Row(like, like, like, state, state)).size
    return Log(jnp.full((rows, width), jnp.nan, like.dtype), jnp.full((rows, 3), -1, jnp.int32))


def _write(buffer: Any, index: Any, wanted: Any, value: Any) -> Any:
    rows = buffer.shape[0]
    if rows == 0:
        return buffer
    return buffer.at[jnp.where(wanted, index, rows)].set(value, mode="drop")


def _written(record: Any, index: Any, wanted: Any, *values: Any) -> Any:
    """A log or a path with one more row."""
    return type(record)(*[_write(buffer, index, wanted, x) for buffer, x in zip(record, values, strict=True)])


def _shared(state: Any) -> Any:
    leaves, treedef = jax.tree.flatten(state)
    return jax.tree.unflatten(treedef, shared(leaves))


def _shared_flags(flags: tuple) -> list:
    return [flag > 0.5 for flag in shared([flag.astype(float) for flag in flags])]


def _keep(condition: Any, new: Any, old: Any) -> Any:
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), new, old)


def _start(system, motion, state, t0, t1, log_rows: int, path_rows: int) -> _Carry:
    state = _arrays(state, t0.dtype)
    control, memory = motion.begin(system, t0, state, t1)
    admissible = system.is_admissible(t0, state) & jnp.isfinite(t0) & jnp.isfinite(t1) & (t1 >= t0)
    zero = jnp.asarray(0, dtype=jnp.int32)
    return _Carry(
        time=t0,
        state=state,
        memory=memory,
        s=jnp.zeros_like(t0),
        window=jnp.full_like(t0, jnp.inf),
        touching=zero - 1,
        jumped=jnp.asarray(True),
        control=control,
        since=jnp.zeros_like(t0),
        n_impacts=zero,
        n_arcs=zero,
        n_turns=zero,
        n_at_once=zero,
        log=_empty_log(state, t0, log_rows),
        path=Path(jnp.zeros((path_rows, 2), t0.dtype), jnp.full((path_rows, 2), -1, jnp.int32)),
        done=~admissible,
        result=RESULTS.where(admissible, RESULTS.reached_t1, RESULTS.invalid_state),
    )


def _turn(c: _Carry, system: AbstractSystem, motion: AbstractMotion, t1: Any, max_impacts: int) -> _Carry:
    """One turn: search one arc a little further; where that ends it, finish it."""
    left = t1 - c.time
    size = jnp.where(c.done, 1.0, motion.size(c.control, left))  # finished lanes compute harmless numbers
    last = size >= left
    length = jnp.where(last, left, frozen(size))
    begun = system.prepared(c.time, c.state)
    piece = motion.piece(system, c.time, begun, c.memory, c.jumped, length)
    arc = piece.arc
    kept, control = motion.judge(c.control, size, piece.trial)
    found = search(system, arc, c.s, c.window, c.touching, motion.safe_steps)
    kept, finished = _shared_flags((kept, found.finished))
    ended = kept & finished
    crossed = ended & (found.contact >= 0)
    through = ended & ~crossed
    s, resting, ends = jnp.where(through, arc.length, found.s), jnp.asarray(False), jnp.asarray(False)
    if system.n_contacts > 0:
        met = meeting(system, arc, found.s, found.contact)
        s, resting, ends = jnp.where(crossed, newton(arc, s, met.value, met.rate), s), met.rests, met.ends
        (s,) = shared([s])
    elapsed = s * arc.unit
    reached = through & last
    time = jnp.where(reached, t1, c.time + elapsed)
    arrived = _arrays(system.advanced(time, begun, arc.position(s), arc.velocity(s), elapsed), t1.dtype)
    arrived = _shared(arrived)

    since = c.since + elapsed
    at_once = since * norm(frozen(arc.tangent(s))) <= _tiny(arc, s) * arc.unit
    same = found.contact == c.touching  # bounces on one surface die out, they are no corner
    n_at_once = jnp.where(at_once & (c.n_impacts > 0) & ~same, c.n_at_once + 1, 0)
    full = c.n_impacts >= max_impacts
    stuck = n_at_once > _MOST_IMPACTS_AT_ONCE
    kind, fault, after, pause, name = KINDS.unused, RESULTS.reached_t1, arrived, 0.0, found.contact
    if system.n_contacts > 0:
        name = system.named(found.contact, arrived)
        bounced = system.bounced(found.contact, time, arrived)
        kind, fault = system.follows(found.contact, time, arrived, bounced, t1 - time, resting, ends)
        after, pause = system.impact(found.contact, time, arrived, bounced, kind)
        after = _arrays(after, t1.dtype)
    failed = fault != RESULTS.reached_t1
    stopped = crossed & (failed | full | stuck)
    stopped, crossed = _shared_flags((stopped, crossed))
    struck = crossed & ~stopped
    until = time + pause
    settled = struck & system.is_at_rest(found.contact, time, arrived, after)
    row, labels = Row(time, until, since, arrived, after), jnp.stack([name, _code(kind), system.phase(after)])
    log = _written(c.log, c.n_impacts, struck & ~c.done, pack_row(row), labels)
    sizes = frozen(jnp.stack([jnp.where(last, jnp.inf, length), s]))
    place = c.n_arcs % max(c.path.labels.shape[0], 1)
    path = _written(c.path, place, ended & ~c.done, sizes, jnp.stack([found.contact, labels[1]]))

    result = RESULTS.where(crossed & full, RESULTS.max_impacts, c.result)
    result = RESULTS.where(crossed & stuck, RESULTS.corner, result)
    result = RESULTS.where(crossed & failed, fault, result)
    result = RESULTS.where(settled, RESULTS.at_rest, result)
    broken = ended & ~jnp.isfinite(time + sum(arrived_leaf.sum() for arrived_leaf in jax.tree.leaves(arrived)))
    (broken,) = _shared_flags((broken,))
    result = RESULTS.where(broken, RESULTS.invalid_state, result)
    n_arcs = c.n_arcs + ended.astype(jnp.int32)
    exhausted = (c.n_turns + 1 >= motion.max_turns(max_impacts)) | (n_arcs >= motion.max_pieces(max_impacts))
    exhausted = exhausted & ~(reached | stopped | settled | broken)
    result = RESULTS.where(exhausted, RESULTS.step_limit, result)
    new = c._replace(
        time=jnp.where(struck, until, jnp.where(ended, time, c.time)),
        state=_keep(ended, _keep(struck, after, arrived), c.state),
        memory=_keep(ended, piece.memory, c.memory),
        s=jnp.where(kept & ~ended, frozen(found.s), 0.0),
        window=jnp.where(kept & ~ended, frozen(found.window), jnp.inf),
        touching=jnp.where(struck, name, jnp.where(through, -1, c.touching)),
        jumped=jnp.where(ended, struck, c.jumped),
        control=_keep(ended | ~kept, control, c.control),
        since=jnp.where(struck, 0.0, jnp.where(ended, since, c.since)),
        n_impacts=c.n_impacts + struck.astype(jnp.int32),
        n_arcs=n_arcs,
        n_turns=c.n_turns + 1,
        n_at_once=jnp.where(struck, n_at_once, c.n_at_once),
        done=reached | stopped | settled | exhausted | broken,
        result=result,
    )
    old = c._replace(log=log, path=path)
    return _keep_small(c.done, old, new._replace(log=log, path=path))


def _keep_small(condition: Any, a: _Carry, b: _Carry) -> _Carry:
    """`_keep` for all but the buffers, which would be copied whole at every turn."""
    fields = {name: _keep(condition, getattr(a, name), getattr(b, name))
              for name in _Carry._fields if name not in ("log", "path")}  # fmt: skip
    return _Carry(log=a.log, path=a.path, **fields)


def _code(kind: Any) -> Any:
    return jnp.asarray(kind._value, dtype=jnp.int32)


def kind_of(code: Any) -> KINDS:
    """The kind of that code."""
    return eqx.tree_at(lambda kind: kind._value, KINDS.bounce, code)


def _tiny(arc: Any, s: Any) -> Any:
    """A length below which two impacts count as one instant."""
    eps = float(jnp.finfo(s.dtype).eps)
    return 64.0 * eps * frozen(norm(arc.position(s)))


class _Hopping(NamedTuple):
    """A carry without what only a search needs."""

    time: Any
    state: Any
    mark: Any  # the contact just left, or -1; once it has stopped, when and why, as `_stopped` has it
    turn: Any


def _stopped(turn: Any, touching: Any, why: Any, bits: int) -> Any:
    """A mark below -1 from the number of impacts, the contact last touched and the reason, 0 to 2."""
    return ~((((turn << bits) | (touching + 1)) << 2 | why) + 1)


def _unmarked(mark: Any, bits: int) -> tuple:
    known = ~mark - 1
    return known >> (bits + 2), ((known >> 2) & ((1 << bits) - 1)) - 1, known & 3


def _hopped(carry: _Carry, system: AbstractSystem, t1: Any, max_impacts: int) -> _Carry:
    """The motion as far as it is a row of ordinary impacts, known in closed form. All lanes that hop are at the same
    impact, so that the number of turns counts their impacts."""

    bits = system.n_contacts.bit_length()

    def turn(c: _Hopping) -> _Hopping:
        going = c.mark >= -1
        hop = system.hop(c.mark, going, c.turn >= max_impacts, t1 - c.time, c.state)
        why = jnp.where(hop.choice == ENDS, 0, jnp.where(hop.choice == FULL, 1, 2))
        stop = _stopped(c.turn, jnp.maximum(c.mark, -1), why, bits)
        mark = jnp.where(hop.choice >= 0, hop.choice.astype(jnp.int32), jnp.where(going, stop, c.mark))
        return _Hopping(c.time + hop.duration, hop.state, mark, c.turn + 1)

    zero = jnp.asarray(0, dtype=jnp.int32)
    none = _stopped(zero, -1, 2, bits)
    start = _Hopping(carry.time, carry.state, jnp.where(carry.done, none, carry.touching), zero)
    end = lax.while_loop(lambda c: eqxi.unvmap_any(c.mark >= -1), turn, start)
    n_impacts, touching, why = _unmarked(end.mark, bits)
    reached, full = (why == 0) & ~carry.done, (why == 1) & ~carry.done
    return carry._replace(
        time=jnp.where(reached, t1, end.time),
        state=end.state,
        touching=touching,
        jumped=carry.jumped | (n_impacts > 0),
        n_impacts=n_impacts,
        n_arcs=n_impacts + (reached | full).astype(jnp.int32),
        done=carry.done | reached | full,
        result=RESULTS.where(full, RESULTS.max_impacts, carry.result),
    )


def _can_hop(system: AbstractSystem, motion: AbstractMotion, state: Any, max_impacts: int) -> bool:
    few = (max_impacts + 2) << (system.n_contacts.bit_length() + 2) < 2**31
    return motion.is_closed_form and few and system.can_hop(state)


def find(system, motion, state, t0, t1, *, max_impacts: int, log_rows: int, kind: Any = "lax") -> Outcome:
    """Run the loop. `kind` chooses how the loop itself may be differentiated."""
    carry = _start(system, motion, state, t0, t1, log_rows, 0)
    turn = lambda c: _turn(c, system, motion, t1, max_impacts)  # noqa: E731
    going = lambda c: eqxi.unvmap_any(~c.done)  # noqa: E731
    if kind == "hop":
        carry = _hopped(carry, system, t1, max_impacts)
        rest = in_tiles(lambda system, motion, t1, carry: lax.while_loop(going, lambda c: _turn(c, system, motion, t1, max_impacts), carry), motion.tile)
        end = lax.cond(eqxi.unvmap_any(~carry.done), lambda c: rest(system, motion, t1, c), lambda c: c, carry)
    elif kind == "lax":
        end = lax.while_loop(going, turn, carry)
    else:
        end = eqxi.while_loop(going, turn, carry, kind=kind, max_steps=motion.max_turns(max_impacts))
    return Outcome(end.time, end.state, end.n_impacts, end.n_arcs, end.result, end.log)


class _Replay(NamedTuple):
    """A motion that is repeated with derivatives."""

    time: Any
    state: Any
    memory: Any
    jumped: Any
    since: Any
    n_impacts: Any
    values: Any  # of the log


def _repeat(r: _Replay, steps: tuple, system, motion, t1: Any, known: _Carry) -> _Replay:
    """The arcs of one part of a path, which the search `known` has come to the end of."""
    log_rows = r.values.shape[0]
    reached = known.done & (known.result == RESULTS.reached_t1)

    def one(carry, step):
        time, state, memory, jumped, since, n_impacts = carry
        index, (size, s), (contact, code) = step
        used = index < known.n_arcs
        last = reached & (index == known.n_arcs - 1)
        left = t1 - time
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
        moved = jnp.where(last, t1, time + elapsed)
        arrived = _arrays(system.advanced(moved, begun, arc.position(s), arc.velocity(s), elapsed), t1.dtype)
        arrived = _shared(arrived)
        struck = crossed & (n_impacts < known.n_impacts)
        after, until = arrived, moved
        if system.n_contacts > 0:
            bounced = system.bounced(contact, moved, arrived)
            other, pause = system.impact(contact, moved, arrived, bounced, kind_of(code))
            after = _keep(struck, _arrays(other, t1.dtype), arrived)
            until = jnp.where(struck, moved + pause, moved)
        row = pack_row(Row(moved, until, since + elapsed, arrived, after)) if log_rows else jnp.zeros((0,), t1.dtype)
        carry = (
            jnp.where(used, until, time),
            _keep(used, after, state),
            _keep(used, piece.memory, memory),
            jnp.where(used, struck, jumped),
            jnp.where(struck, 0.0, since + elapsed),
            n_impacts + struck.astype(jnp.int32),
        )
        return carry, (row, jnp.where(struck, n_impacts, log_rows))

    def chunk(r, steps):
        def run(r):
            inner, (rows, where) = lax.scan(jax.checkpoint(one, prevent_cse=False), tuple(r[:-1]), steps)
            return _Replay(*inner, r.values.at[where].set(rows, mode="drop") if log_rows else r.values)

        return lax.cond(eqxi.unvmap_any(steps[0][0] < known.n_arcs), run, lambda r: r, r), None

    return lax.scan(chunk, r, steps)[0]


def _resumed(system, motion, t1, carry: _Carry, stop: Any, max_impacts: int) -> _Carry:
    """The loop, as far as every lane has ended or gone through `stop` arcs."""

    def turn(state):
        c, ended = state
        paused = c.n_arcs >= stop
        c = _turn(c._replace(done=ended | paused), system, motion, t1, max_impacts)
        return c, ended | (c.done & ~paused)

    going = lambda state: eqxi.unvmap_any(~state[1] & (state[0].n_arcs < stop))  # noqa: E731
    carry, ended = lax.while_loop(going, turn, (carry, carry.done))
    return carry._replace(done=ended)


def replay(system, motion, state, t0, t1, *, max_impacts: int, log_rows: int) -> Outcome:
    """The motion with derivatives. By turns a part of the path is found without them and repeated with them, so that
    only one part at a time is in memory."""
    still = frozen((system, motion))
    chunks = -(-motion.max_pieces(max_impacts) // _CHUNK)
    size = -(-motion.max_pieces(max_impacts) // chunks)  # equal chunks, none of which is mostly padding
    per_part = min(chunks, _CHUNKS_AT_ONCE)
    rows = size * per_part
    begin = _start(*still, *frozen((state, t0, t1)), log_rows, rows)
    moves = ~begin.done  # a lane that cannot start computes harmless numbers, and gives back what was found
    state = jax.tree.map(lambda x: jnp.where(moves, x, 1.0), _arrays(state, t0.dtype))
    t0, t1 = (jnp.where(moves, t, 0.0) for t in (t0, t1))
    _, memory = motion.begin(system, t0, state, t1)
    end = frozen(t1)
    values = jnp.where(jnp.isnan(begin.log.values), 0.0, begin.log.values)

    def part(both, first):
        def run(both):
            search, r = both
            empty = jax.tree.map(jnp.zeros_like, search.path.sizes), jnp.full_like(search.path.labels, -1)
            resume = lambda system, motion, t1, c, stop: _resumed(system, motion, t1, c, stop, max_impacts)  # noqa: E731
            search = in_tiles(resume, motion.tile)(*still, end, search._replace(path=Path(*empty)), first + rows)
            search = frozen(search)
            index = first + jnp.arange(rows, dtype=jnp.int32)
            steps = jax.tree.map(lambda x: x.reshape(per_part, size, *x.shape[1:]), (index, *search.path))
            steps = (steps[0], *[(pair[..., 0], pair[..., 1]) for pair in steps[1:]])
            return search, _repeat(r, steps, system, motion, t1, search)

        return lax.cond(eqxi.unvmap_any(~both[0].done), run, lambda both: both, both), None

    zero = jnp.asarray(0, dtype=jnp.int32)
    r = _Replay(t0, state, memory, jnp.asarray(True), jnp.zeros_like(t0), zero, values)
    firsts = rows * jnp.arange(-(-chunks // per_part), dtype=jnp.int32)
    body = part if firsts.size == 1 else jax.checkpoint(part, prevent_cse=False)
    (search, r), _ = lax.scan(body, (begin, r), firsts)
    time, state = _keep(moves, (r.time, r.state), (search.time, search.state))
    log = Log(jnp.where(jnp.isnan(search.log.values), search.log.values, r.values), search.log.labels)
    return Outcome(time, state, search.n_impacts, search.n_arcs, search.result, log)


def _find(system, motion, state, t0, t1, **options):
    """`find`, not differentiated, and in tiles where it is batched."""
    primals = frozen((system, motion, state, t0, t1))
    if options["log_rows"] == 0 and _can_hop(system, motion, state, options["max_impacts"]):
        return _find_by_hops(*primals, **options)
    return in_tiles(lambda *primals: find(*primals, **options), motion.tile)(*primals)


def _find_by_hops(system, motion, state, t0, t1, **options):
    """The same. Hops are so quick that reading and writing counts: what passes into a tile and out of it is the user's
    form of a state, few arrays instead of many."""

    def part(system, motion, user, phase, t0, t1):
        outcome = find(system, motion, system.unpacked(user, phase), t0, t1, kind="hop", **options)
        return outcome._replace(state=(system.packed(outcome.state), system.phase(outcome.state)))

    given = (system, motion, system.packed(_arrays(state, t0.dtype)), system.phase(state), t0, t1)
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
        return find(system, motion, state, t0, t1, **options)[0]
    if isinstance(adjoint, diffrax.RecursiveCheckpointAdjoint):
        return find(system, motion, state, t0, t1, kind="checkpointed", **options)[0]
    raise ValueError(
        "Argument `adjoint` must be None, diffrax.ForwardMode() or diffrax.RecursiveCheckpointAdjoint(), but got "
        f"{adjoint}; try None, which serves both modes."
    )
