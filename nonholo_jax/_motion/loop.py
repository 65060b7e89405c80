"""The event loop. It knows no ball: a system gives it arcs, levels and impacts over a state that is any pytree.

One flat loop: a turn searches one arc for its first crossing and finishes it with an impact, or goes on with the next
arc; lanes of a batch are each in their own bounce. Where the system knows its next impact in closed form it hops.
"""

import functools
from typing import Any, NamedTuple

import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from .._math import KINDS, RESULTS, frozen, if_any, norm, on_cpu, quotient, shared, total, where
from .._world import AbstractSystem, Meeting
from .crossing import crossing_time, search
from .motion import AbstractMotion

_MOST_IMPACTS_AT_ONCE = 128
_FEW_ROWS = 64
_LONG = 8  # steps of the search in one turn, where it is the arc that takes the time


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


class Begun(NamedTuple):
    """The numbers that an arc begins with."""

    time: Any
    state: Any
    memory: Any
    since: Any


class Path(NamedTuple):
    """What derivatives need of every arc."""

    numbers: Any  # size in seconds (infinite for one that reaches as far as t1, whose size has derivatives), where it
    # was cut in local time, by how much rounding had put the time ahead, and what it began with
    labels: Any  # by which contact it was cut, what kind of impact that was, flags, and the number of impacts before


class Flags(NamedTuple):
    """What is known of an arc, as bits of one label."""

    jumped: Any  # it began with an impact
    struck: Any  # it ended with one
    reached: Any  # it ended at t1

    def packed(self) -> Any:
        return functools.reduce(lambda bits, flag: 2 * bits + flag.astype(jnp.int32), self, jnp.asarray(0, jnp.int32))

    @classmethod
    def unpacked(cls, bits: Any) -> "Flags":
        return cls(*[(bits >> k) & 1 == 1 for k in (2, 1, 0)])


class Outcome(NamedTuple):
    """What a run returns."""

    time: Any
    state: Any
    n_impacts: Any
    n_arcs: Any
    result: Any
    log: Log
    n_passed: Any = None


class Carry(NamedTuple):
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
    n_impacts: Any  # and hand-overs: the rows of a log that is long enough
    n_passed: Any  # hand-overs from face to face alone; `None` where there are none
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
    number = jnp.zeros(())
    return columns(values, Row(number, number, number, like, like))


def columns(values: Any, like: Any) -> Any:
    """A pytree from its numbers in the last axis, in the dtypes of `like`; leading axes are kept."""
    leaves, treedef = jax.tree.flatten(like)
    found, start = [], 0
    for leaf in leaves:
        part = values[..., start : start + jnp.size(leaf)]
        found.append(part.reshape(*values.shape[:-1], *jnp.shape(leaf)))
        start += jnp.size(leaf)
    return jax.tree.unflatten(treedef, found)


def as_arrays(state: Any, dtype: Any) -> Any:
    return jax.tree.map(lambda x: jnp.asarray(x, dtype=dtype), state)


def _split(begun: Begun) -> tuple[Any, Any]:
    """The numbers that move, and what does not, as numbers of the labels."""
    moving, rest = eqx.partition(begun, eqx.is_inexact_array)
    return moving, jax.tree.map(lambda x: x.astype(jnp.int32), rest)


def empty_path(begun: Begun, rows: int) -> Path:
    sizes = [sum(leaf.size for leaf in jax.tree.leaves(part)) for part in _split(begun)]
    numbers = jnp.zeros((rows, 3 + sizes[0]), begun.time.dtype)
    return Path(numbers, jnp.full((rows, 4 + sizes[1]), -1, jnp.int32))


def _path_row(contact: Any, kind: Any, flags: Flags, n_impacts: Any, sizes: Any, begun: Begun) -> tuple[Any, Any]:
    moving, rest = (jax.tree.leaves(part) for part in _split(begun))
    numbers = jnp.concatenate([sizes, *[jnp.ravel(x) for x in moving]])
    labels = jnp.stack([contact, kind, flags.packed(), n_impacts])
    return frozen(numbers), jnp.concatenate([labels, *[jnp.ravel(x) for x in rest]])


class Known(NamedTuple):
    """What is known of one arc, or of all arcs of a path with an axis in front."""

    size: Any
    s: Any
    ahead: Any
    contact: Any
    kind: Any
    flags: Flags
    n_impacts: Any
    begun: Begun


def arcs_of(path: Path, like: Begun) -> Known:
    """A path, read; `like` has the structure of what its arcs begin with."""
    moving, rest = _split(like)
    moving, rest = columns(path.numbers[:, 3:], moving), columns(path.labels[:, 4:], rest)
    begun = eqx.combine(moving, rest)
    begun = jax.tree.map(lambda x, old: x.astype(old.dtype), begun, like)
    contact, kind, bits, n_impacts = (path.labels[:, k] for k in range(4))
    size, s, ahead = (path.numbers[:, k] for k in range(3))
    return Known(size, s, ahead, contact, kind, Flags.unpacked(bits), n_impacts, begun)


def _empty_log(state: Any, like: Any, rows: int) -> Log:
    width = pack_row(Row(like, like, like, state, state)).size
    return Log(jnp.full((rows, width), jnp.nan, like.dtype), jnp.full((rows, 3), -1, jnp.int32))


def _write(buffer: Any, index: Any, wanted: Any, value: Any) -> Any:
    """The buffer with one more row. In a batch every lane has an index of its own; to write all rows anew, if they are
    few, is then quicker than XLA's scatter on a CPU, from JAX 0.12 on: before, `value` is not computed once for all."""
    rows = buffer.shape[0]
    if rows == 0:
        return buffer
    if rows <= _FEW_ROWS and on_cpu() and jax.__version_info__ >= (0, 12):
        (value,) = shared([value]) if jnp.issubdtype(value.dtype, jnp.inexact) else (value,)
        here = jnp.arange(rows, dtype=jnp.int32) == jnp.where(wanted, index, -1)
        return jnp.where(here[:, None], value[None], buffer)
    return buffer.at[jnp.where(wanted, index, rows)].set(value, mode="drop")


def _written(record: Any, index: Any, wanted: Any, *values: Any) -> Any:
    """A log or a path with one more row."""
    return type(record)(*[_write(buffer, index, wanted, x) for buffer, x in zip(record, values, strict=True)])


def computed_once(state: Any) -> Any:
    leaves, treedef = jax.tree.flatten(state)
    return jax.tree.unflatten(treedef, shared(leaves))


def _shared_flags(flags: tuple) -> list:
    return [flag > 0.5 for flag in shared([flag.astype(float) for flag in flags])]


def keep(condition: Any, new: Any, old: Any) -> Any:
    return jax.tree.map(lambda a, b: where(condition, a, b), new, old)


def start(system, motion, state, t0, t1, log_rows: int, path_rows: int) -> Carry:
    state = as_arrays(state, t0.dtype)
    control, memory = motion.begin(system, t0, state, t1)
    admissible = system.is_admissible(t0, state) & jnp.isfinite(t0) & jnp.isfinite(t1) & (t1 >= t0)
    zero = jnp.asarray(0, dtype=jnp.int32)
    return Carry(
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
        n_passed=zero if system.may_pass else None,
        n_arcs=zero,
        n_turns=zero,
        n_at_once=zero,
        log=_empty_log(state, t0, log_rows),
        path=empty_path(Begun(t0, state, memory, t0), path_rows),
        done=~admissible,
        result=RESULTS.where(admissible, RESULTS.reached_t1, RESULTS.invalid_state),
    )


def _followed(c: Carry, ended: Any, sizes: tuple, contact: Any, kind: Any, flags: Flags) -> Path:
    """The path with one more arc, where there is room for one."""
    if c.path.labels.shape[0] == 0:
        return c.path
    begun = Begun(c.time, c.state, c.memory, c.since)
    row = _path_row(contact, kind, flags, c.n_impacts, jnp.stack(sizes), begun)
    return _written(c.path, quotient(c.n_arcs, c.path.labels.shape[0])[1], ended, *row)


def turn(
    c: Carry, system: AbstractSystem, motion: AbstractMotion, t1: Any, max_impacts: int, differentiable: bool = False
) -> Carry:
    """One turn: search one arc a little further; where that ends it, finish it. `differentiable` turns have derivatives
    of their own."""
    active, left, stays = ~c.done, t1 - c.time + c.ahead, system.phase(c.state) >= 0
    ready = system.prepared(c.time, c.state)
    size = where(active, _size(system, motion, c.control, ready, left, stays), 1.0)  # else harmless numbers
    last = size >= left
    length = where(last, left, frozen(size))
    piece = motion.piece(system, c.time, ready, c.memory, c.jumped, length)
    arc = piece.arc
    kept, control = motion.judge(c.control, size, piece.trial, stays)
    found = search(system, arc, c.s, c.window, c.touching, max(motion.safe_steps, _LONG * system.is_long))
    kept, control = _ending_there(system, motion, arc, found, kept, stays, control)
    kept, finished = _shared_flags((kept, found.finished))
    ended = active & kept & finished
    crossed, contact = ended & (found.contact >= 0), system.choice(found.contact)
    through = ended & ~crossed
    s = where(through, arc.length, found.s)
    if differentiable and system.n_contacts > 0:
        s = where(crossed, crossing_time(s, found.contact, system, arc), s)
    (s,) = shared([s])
    elapsed, reached = s * arc.unit, through & last
    time, ahead = later(c.time, c.ahead, elapsed)
    time = where(reached, t1, time)
    arrived = system.advanced(time, ready, arc.position(s), arc.velocity(s), elapsed)
    arrived = computed_once(as_arrays(arrived, t1.dtype))

    since = c.since + elapsed
    n_at_once = _at_once(c, arc, s, since, found.contact)
    full, stuck = c.n_impacts >= allowed(c, max_impacts), n_at_once > _MOST_IMPACTS_AT_ONCE
    met, name, left_by = Meeting(KINDS.unused, RESULTS.reached_t1, arrived, 0.0, False), found.contact, 0
    if system.n_contacts > 0:
        name, left_by = system.named(contact, arrived), system.left_by(contact)
        met = system.meets(contact, time, arrived, t1 - time, found.rests, found.ends)
    after, n_passed = as_arrays(met.after, t1.dtype), c.n_passed
    if n_passed is not None:  # a hand-over is no impact, and is named by what the ball comes onto
        passed = met.kind == KINDS.passed
        full, stuck, name = full & ~passed, stuck & ~passed, where(passed, system.phase(after), name)
        n_passed = n_passed + (crossed & passed).astype(jnp.int32)
    failed = met.fault != RESULTS.reached_t1
    stopped, crossed = _shared_flags((crossed & (failed | full | stuck), crossed))
    struck = crossed & ~stopped
    until, settled = time + met.pause, struck & met.is_at_rest
    row, kind = Row(time, until, since, arrived, after), jnp.asarray(met.kind._value, dtype=jnp.int32)
    log = _written(c.log, c.n_impacts, struck, pack_row(row), jnp.stack([name, kind, system.code(after)]))
    sizes = where(last, jnp.inf, length), s, c.ahead
    path = _followed(c, ended, sizes, found.contact, kind, Flags(c.jumped, struck, reached))

    finite = jnp.isfinite(total([time, *jax.tree.leaves(jax.tree.map(jnp.sum, arrived))]))
    (broken,) = _shared_flags((ended & ~finite,))
    n_arcs, most = c.n_arcs + ended.astype(jnp.int32), system.most_rows(max_impacts)
    exhausted = (c.n_turns + 1 >= motion.max_turns(most)) | (n_arcs >= motion.max_pieces(most))
    exhausted = active & exhausted & ~(reached | stopped | settled | broken)
    faults = [(full, RESULTS.max_impacts), (stuck, RESULTS.corner), (failed, met.fault)]
    ends = [(settled, RESULTS.at_rest), (broken, RESULTS.invalid_state), (exhausted, RESULTS.step_limit)]
    code = _why(c, [*[(crossed & holds, why) for holds, why in faults], *ends])
    goes_on = active & kept & ~ended
    return c._replace(
        time=where(struck, until, where(ended, time, c.time)),
        ahead=where(ended, ahead, c.ahead),
        state=keep(struck, after, keep(ended, arrived, c.state)),
        memory=keep(ended, piece.memory, c.memory),
        s=where(goes_on, frozen(found.s), 0.0),
        window=where(goes_on, frozen(found.window), jnp.inf),
        touching=where(struck, name + left_by, where(through, np.int32(-1), c.touching)),
        jumped=where(ended, struck, c.jumped),
        control=keep(active & (ended | ~kept), control, c.control),
        since=where(struck, 0.0, where(ended, since, c.since)),
        n_impacts=c.n_impacts + struck.astype(jnp.int32),
        n_passed=n_passed,
        n_arcs=n_arcs,
        n_turns=c.n_turns + active.astype(jnp.int32),
        n_at_once=where(struck, n_at_once, c.n_at_once),
        done=c.done | reached | stopped | settled | exhausted | broken,
        result=_result_of(code),
        log=log,
        path=path,
    )


def _size(system: AbstractSystem, motion: AbstractMotion, control: Any, ready: Any, left: Any, stays: Any) -> Any:
    """The size in seconds of the next arc: constant steps stay so."""
    size, most = motion.size(control, left, stays), system.longest(ready)
    return size if most is None or motion.shortened(control, most) is None else jnp.minimum(size, most)


def _ending_there(
    system: AbstractSystem, motion: AbstractMotion, arc: Any, found: Any, kept: Any, stays: Any, control: Any
) -> tuple[Any, Any]:
    """What ends a contact is found on an interpolant, which is best at both ends of a step: where it is further from
    them, the step is not kept, and the next one ends just behind it. Not below rounding: where the curvature of a
    surface jumps, so does what holds the ball there, and every step would end before the jump. A step that is too long
    to see the surface (`_looking_often`) is not kept either."""
    if system.n_derived == 0:
        return kept, control
    look = lambda: _not_too_early(system, motion, arc, found, kept, stays, control)  # noqa: E731
    return if_any(stays, look, lambda: (kept, control))


def _not_too_early(
    system: AbstractSystem, motion: AbstractMotion, arc: Any, found: Any, kept: Any, stays: Any, control: Any
) -> tuple[Any, Any]:
    kept, control = _looking_often(system, motion, arc, kept, stays, control)
    shortened = motion.shortened(control, (1.0 + 1e-5) * frozen(found.s * arc.unit))
    if shortened is None:
        return kept, control
    inside = (found.s > 1e-3 * arc.length) & (found.s < 0.99 * arc.length)
    path = norm(frozen(arc.tangent(found.s))) * arc.length
    inside = inside & (path > _tiny(arc, found.s))
    early = stays & kept & found.finished & (found.contact >= 0) & inside
    return kept & ~early, keep(early, shortened, control)


def _looking_often(
    system: AbstractSystem, motion: AbstractMotion, arc: Any, kept: Any, stays: Any, control: Any
) -> tuple[Any, Any]:
    """A step along a surface is not kept where it may have passed a dent unseen, but for what is below rounding."""
    coarse = system.is_coarse(arc)
    shortened = motion.shortened(control, 0.5 * frozen(arc.length * arc.unit))
    if coarse is None or shortened is None:
        return kept, control
    path = norm(frozen(arc.tangent(0.0 * arc.length))[:3]) * arc.length
    coarse = stays & kept & coarse & (path > _tiny(arc, arc.length))
    return kept & ~coarse, keep(coarse, shortened, control)


def allowed(c: Carry, max_impacts: int) -> Any:
    """How many rows there may be: hand-overs are no impacts."""
    return max_impacts if c.n_passed is None else max_impacts + c.n_passed


def later(time: Any, ahead: Any, elapsed: Any) -> tuple[Any, Any]:
    """The time after so many seconds, and by how much rounding has put that ahead: Kahan's sum. Bounces of one height
    would otherwise all round it the same way, in float32 at 1e6 s by hundredths of a second each."""
    step = elapsed - ahead
    total = time + step
    return total, frozen((total - time) - step)


def _at_once(c: Carry, arc: Any, s: Any, since: Any, contact: Any) -> Any:
    """How many impacts have followed each other at one instant. Bounces on one surface die out, they are no corner."""
    at_once = since * norm(frozen(arc.tangent(s))) <= _tiny(arc, s) * arc.unit
    return where(at_once & (c.n_impacts > 0) & (contact != c.touching), c.n_at_once + 1, 0)


def _why(c: Carry, cases: list) -> Any:
    """The code of how a motion ended, by the last case that holds."""
    return functools.reduce(lambda code, case: where(case[0], case[1]._value, code), cases, c.result._value)


def _result_of(code: Any) -> RESULTS:
    return eqx.tree_at(lambda result: result._value, RESULTS.reached_t1, code)


def kind_of(code: Any) -> KINDS:
    """The kind of that code."""
    return eqx.tree_at(lambda kind: kind._value, KINDS.bounce, code)


def _tiny(arc: Any, s: Any) -> Any:
    """A length below which two impacts count as one instant."""
    eps = float(jnp.finfo(s.dtype).eps)
    return 64.0 * eps * frozen(norm(arc.position(s)))


def find(system, motion, state, t0, t1, *, max_impacts: int, log_rows: int, kind: Any = None) -> Outcome:
    """Run the loop. `kind` says how the loop itself may be differentiated: `None` not at all, "lax" forward,
    "checkpointed" in reverse."""
    return outcome_of(end_of(system, motion, state, t0, t1, max_impacts=max_impacts, log_rows=log_rows, kind=kind))


def end_of(system, motion, state, t0, t1, *, max_impacts: int, log_rows: int, kind: Any = None) -> Carry:
    """Where the loop ends."""
    carry = start(system, motion, state, t0, t1, log_rows, 0)
    next_turn = lambda c: turn(c, system, motion, t1, max_impacts, kind is not None)  # noqa: E731
    going = lambda c: eqxi.unvmap_any(~c.done)  # noqa: E731
    if kind in (None, "lax"):
        return lax.while_loop(going, next_turn, carry)
    most = motion.max_turns(system.most_rows(max_impacts))
    return eqxi.while_loop(going, next_turn, carry, kind=kind, max_steps=most)


def outcome_of(c: Carry) -> Outcome:
    return Outcome(c.time, c.state, c.n_impacts, c.n_arcs, c.result, c.log, c.n_passed)
