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

from ._crossing import corrected, meeting, newton, search
from ._motion import AbstractMotion
from ._shared import shared
from ._system import AbstractSystem
from ._tiles import in_tiles
from ._types import KINDS, RESULTS
from ._vector import frozen, norm

_CHUNK = 16
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
    ahead: Any  # by how much rounding has put `time` ahead of the motion
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
        ahead=jnp.zeros_like(t0),
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
    left = t1 - c.time + c.ahead
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
        s, resting, ends = jnp.where(crossed, newton(arc, s, met.value, met.rate, met.noise), s), met.rests, met.ends
        (s,) = shared([s])
    elapsed = s * arc.unit
    reached = through & last
    time, ahead = _later(c.time, c.ahead, elapsed)
    time = jnp.where(reached, t1, time)
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
    path = _written(c.path, c.n_arcs, ended & ~c.done, sizes, jnp.stack([found.contact, labels[1]]))

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
        ahead=jnp.where(ended, ahead, c.ahead),
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


def _later(time: Any, ahead: Any, elapsed: Any) -> tuple[Any, Any]:
    """The time after so many seconds, and by how much rounding has put that ahead: Kahan's sum. Bounces of one height
    would otherwise all round it the same way, in float32 at 1e6 s by hundredths of a second each."""
    step = elapsed - ahead
    later = time + step
    return later, frozen((later - time) - step)


def _code(kind: Any) -> Any:
    return jnp.asarray(kind._value, dtype=jnp.int32)


def kind_of(code: Any) -> KINDS:
    """The kind of that code."""
    return eqx.tree_at(lambda kind: kind._value, KINDS.bounce, code)


def _tiny(arc: Any, s: Any) -> Any:
    """A length below which two impacts count as one instant."""
    eps = float(jnp.finfo(s.dtype).eps)
    return 64.0 * eps * frozen(norm(arc.position(s)))


def find(system, motion, state, t0, t1, *, max_impacts: int, log_rows: int, path_rows: int, kind: Any = "lax"):
    """Run the loop; returns the outcome and the path. `kind` chooses how the loop itself may be differentiated."""
    carry = _start(system, motion, state, t0, t1, log_rows, path_rows)
    turn = lambda c: _turn(c, system, motion, t1, max_impacts)  # noqa: E731
    going = lambda c: eqxi.unvmap_any(~c.done)  # noqa: E731
    if kind == "lax":
        end = lax.while_loop(going, turn, carry)
    else:
        end = eqxi.while_loop(going, turn, carry, kind=kind, max_steps=motion.max_turns(max_impacts))
    return Outcome(end.time, end.state, end.n_impacts, end.n_arcs, end.result, end.log), end.path


def replay(system, motion, state, t0, t1, path: Path, known: Outcome) -> Outcome:
    """Repeat a path with derivatives. What was found (contacts, counts, the result) is taken from `known`."""
    moves = known.n_arcs > 0  # a lane that cannot start computes harmless numbers, and gives back what was found
    harmless = lambda x: jnp.where(moves, x, jnp.ones_like(x)) if eqx.is_inexact_array(x) else x  # noqa: E731
    system, state = jax.tree.map(harmless, (system, _arrays(state, t0.dtype)))  # NaN times zero is NaN in derivatives
    t0, t1 = (jnp.where(moves, t, 0.0) for t in (t0, t1))
    _, memory = motion.begin(system, t0, state, t1)
    log_rows = known.log.labels.shape[0]
    reached = known.result == RESULTS.reached_t1

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
        moved, later = _later(time, ahead, elapsed)
        moved = jnp.where(last, t1, moved)
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
            jnp.where(used, later, ahead),
            _keep(used, after, state),
            _keep(used, piece.memory, memory),
            jnp.where(used, struck, jumped),
            jnp.where(struck, 0.0, since + elapsed),
            n_impacts + struck.astype(jnp.int32),
        )
        return carry, (row, jnp.where(struck, n_impacts, log_rows))

    def chunk(carry, steps):
        def run(carry):
            inner, buffer = carry
            inner, (rows, where) = lax.scan(jax.checkpoint(one, prevent_cse=False), inner, steps)
            return inner, buffer.at[where].set(rows, mode="drop") if log_rows else buffer

        needed = eqxi.unvmap_any(steps[0][0] < known.n_arcs)
        return lax.cond(needed, run, lambda carry: carry, carry), None

    values = jnp.where(jnp.isnan(known.log.values), known.log.values, 0.0)  # rows that are not used stay NaN
    rows = path.labels.shape[0]
    size = min(_CHUNK, rows)
    padding = -rows % size
    steps = (
        jnp.arange(rows + padding, dtype=jnp.int32),
        jnp.pad(path.sizes, ((0, padding), (0, 0))),
        jnp.pad(path.labels, ((0, padding), (0, 0))),
    )
    steps = jax.tree.map(lambda x: x.reshape(-1, size, *x.shape[1:]), steps)
    steps = (steps[0], *[(pair[..., 0], pair[..., 1]) for pair in steps[1:]])
    zero = jnp.asarray(0, dtype=jnp.int32)
    first = (t0, jnp.zeros_like(t0), state, memory, jnp.asarray(True), jnp.zeros_like(t0), zero)
    ((time, _, state, *_), values), _ = lax.scan(chunk, (first, values), steps)
    time, state = _keep(moves, (time, state), (known.time, known.state))
    return known._replace(time=time, state=state, log=Log(values, known.log.labels))


def _find(system, motion, state, t0, t1, **options):
    """`find`, not differentiated, and in tiles where it is batched."""
    return in_tiles(lambda *primals: find(*primals, **options), motion.tile)(*frozen((system, motion, state, t0, t1)))


@eqx.filter_custom_jvp
def _find_or_replay(system, motion, state, t0, t1, *, max_impacts: int, log_rows: int):
    outcome, _ = _find(system, motion, state, t0, t1, max_impacts=max_impacts, log_rows=log_rows, path_rows=0)
    return outcome


@_find_or_replay.def_jvp
def _find_or_replay_jvp(primals, tangents, *, max_impacts: int, log_rows: int):
    _, motion, *_ = primals
    path_rows = motion.max_pieces(max_impacts)
    outcome, path = _find(*primals, max_impacts=max_impacts, log_rows=log_rows, path_rows=path_rows)
    repeat = lambda system, motion, state, t0, t1: replay(system, motion, state, t0, t1, path, outcome)  # noqa: E731
    return eqx.filter_jvp(repeat, primals, tangents)


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
        return find(system, motion, state, t0, t1, path_rows=0, **options)[0]
    if isinstance(adjoint, diffrax.RecursiveCheckpointAdjoint):
        return find(system, motion, state, t0, t1, path_rows=0, kind="checkpointed", **options)[0]
    raise ValueError(
        "Argument `adjoint` must be None, diffrax.ForwardMode() or diffrax.RecursiveCheckpointAdjoint(), but got "
        f"{adjoint}; try None, which serves both modes."
    )
