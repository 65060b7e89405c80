"""Parabolas from impact to impact, in closed form; where there is more to do the event loop goes on."""

from typing import Any, NamedTuple

import equinox.internal as eqxi
import jax.numpy as jnp
from jax import lax

from .._math import ENDS, FULL, PAUSES, RESULTS, Hopper, where
from .._world import AbstractSystem
from .loop import Carry, Outcome, allowed, later, outcome_of, start, turn
from .motion import AbstractMotion


class _Hopping(NamedTuple):
    """A carry without what only a search needs."""

    time: Any
    ahead: Any
    state: Any
    mark: Any  # the contact just left, or -1; once it has stopped, when and why, as `_stopped` has it
    turn: Any
    path: Any  # the choices so far, or none


def _stopped(turn: Any, touching: Any, why: Any, bits: int) -> Any:
    """A mark below -1 from the number of impacts, the contact last touched and the reason, 0 to 2."""
    return ~((((turn << bits) | (touching + 1)) << 2 | why) + 1)


def _unmarked(mark: Any, bits: int) -> tuple:
    known = ~mark - 1
    return known >> (bits + 2), ((known >> 2) & ((1 << bits) - 1)) - 1, known & 3


def hopped(carry: Carry, system: AbstractSystem, t1: Any, max_impacts: int, rows: int = 0) -> tuple[Carry, Any]:
    """The motion as far as it is a row of ordinary impacts, known in closed form, and the choices of the hops, in so
    many rows."""
    end = _hops(carry, system, t1, max_impacts, rows)
    return _landed(carry, end, system, t1), end.path


def _hops(carry: Carry, system: AbstractSystem, t1: Any, max_impacts: int, rows: int = 0) -> _Hopping:
    """All lanes that hop are at the same impact, so that the number of turns counts their impacts."""
    bits, hopper = system.n_contacts.bit_length(), system.hopper(carry.state)
    assert hopper is not None

    def hop(c: _Hopping) -> _Hopping:
        going, full = c.mark >= -1, c.turn >= allowed(carry, max_impacts) - carry.n_impacts
        done = hopper.first(c.mark, going, full, t1 - c.time + c.ahead, c.state)
        why = where(done.choice == ENDS, 0, where(done.choice <= FULL, 1, 2))
        stop = _stopped(c.turn, jnp.maximum(c.mark, -1), why, bits)
        mark = where(done.choice >= 0, done.choice.astype(jnp.int32), where(going, stop, c.mark))
        time, ahead = later(c.time, c.ahead, done.duration)
        path = c.path.at[c.turn].set(done.choice.astype(c.path.dtype)) if rows else c.path
        return _Hopping(time, ahead, done.state, mark, c.turn + 1, path)

    zero = jnp.asarray(0, dtype=jnp.int32)
    mark = where(_can_start(carry, system), carry.touching, _stopped(zero, -1, 2, bits))
    path = jnp.full((rows,), int(PAUSES), jnp.int16)
    begin = _Hopping(carry.time, carry.ahead, carry.state, mark, zero, path)
    return lax.while_loop(lambda c: eqxi.unvmap_any(c.mark >= -1), hop, begin)


def _can_start(carry: Carry, system: AbstractSystem) -> Any:
    return ~carry.done & (carry.s == 0) & (system.phase(carry.state) < 0)


def _landed(carry: Carry, end: _Hopping, system: AbstractSystem, t1: Any) -> Carry:
    """The carry after hops."""
    free = _can_start(carry, system)
    n_impacts, touching, why = _unmarked(end.mark, system.n_contacts.bit_length())
    reached, full, moved = free & (why == 0), free & (why == 1), n_impacts > 0
    return carry._replace(
        time=where(reached, t1, end.time),
        ahead=end.ahead,
        state=end.state,
        window=where(moved, jnp.inf, carry.window),
        touching=where(free, touching, carry.touching),
        jumped=carry.jumped | moved,
        since=where(moved, 0.0, carry.since),
        n_impacts=carry.n_impacts + n_impacts,
        n_arcs=carry.n_arcs + n_impacts + (reached | full).astype(jnp.int32),
        n_at_once=where(moved, 0, carry.n_at_once),
        done=carry.done | reached | full,
        result=RESULTS.where(full, RESULTS.max_impacts, carry.result),
    )


def hopper_of(system: AbstractSystem, motion: AbstractMotion, state: Any, max_impacts: int) -> Hopper | None:
    """How the system hops, if it does."""
    few = (max_impacts + 2) << (system.n_contacts.bit_length() + 2) < 2**31
    return system.hopper(state) if motion.is_closed_form and few else None


def _turned(c: Carry, system, motion, t1, max_impacts: int) -> Carry:
    return hopped(turn(c, system, motion, t1, max_impacts), system, t1, max_impacts)[0]


class Paused(NamedTuple):
    """How far hops have come, beside the outcome."""

    unfinished: Any
    ahead: Any
    mark: Any


def begin_by_hops(system, motion, state, t0, t1, *, max_impacts: int) -> tuple[Outcome, Paused]:
    """`find`, as far as it goes by hops. Neither this nor the rest is for derivatives."""
    carry = start(system, motion, state, t0, t1, 0, 0)
    end = _hops(carry, system, t1, max_impacts)
    c = _landed(carry, end, system, t1)
    return outcome_of(c), Paused(~c.done, end.ahead, end.mark)


def finish(outcome: Outcome, paused: Paused, system, motion, t1, *, max_impacts: int) -> Outcome:
    """The rest, by turns, and, where hops are a short program, by both. The carry, which is long, is made again."""
    hopper = system.hopper(outcome.state)
    next_of = _turned if hopper is not None and hopper.again is not None else turn
    carry = start(system, motion, outcome.state, outcome.time, t1, 0, 0)
    nothing = jnp.zeros((0,), jnp.int16)
    end = _Hopping(outcome.time, paused.ahead, outcome.state, paused.mark, outcome.n_impacts, nothing)
    going = lambda c: eqxi.unvmap_any(~c.done)  # noqa: E731
    next_turn = lambda c: next_of(c, system, motion, t1, max_impacts)  # noqa: E731
    return outcome_of(lax.while_loop(going, next_turn, _landed(carry, end, system, t1)))
