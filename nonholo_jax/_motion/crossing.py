"""The first crossing of an arc with the contacts of a system, found without ever passing one.

With m a lower bound of a level's second derivative on a window, the level stays above f + f' s + m s^2 / 2 there, so
that a step to the first zero of that parabola can never pass a crossing. On a plane and a parabolic arc m is exact and
the first step ends at the crossing; elsewhere steps converge to it quadratically. The search is not differentiated: a
Newton correction of its result is, which is the implicit function theorem.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool

from .._math import (
    BLIND,
    Index,
    Number,
    Polynomial,
    Scalar,
    Window,
    derivative,
    evaluate,
    frozen,
    if_any,
    norm,
    recentred,
    shared,
    slope,
    times,
    total,
    where,
)
from .._world import AbstractSystem, Member, Return, rounding


class Arc(eqx.Module):
    """Smooth motion from `time` on: polynomials of the configuration and of its rate (per second) in local time,
    which runs from 0 to `length` in units of `unit` seconds. It began at the state `start`."""

    time: Scalar
    start: Any
    configuration: tuple[Polynomial, ...]
    rate: tuple[Polynomial, ...]
    length: Number
    unit: Number
    is_parabola: Any = None  # where only the program that runs knows whether it is one
    derived: tuple[Polynomial, ...] = ()  # what some gaps see beside the configuration

    def position(self, s: Number) -> tuple:
        return tuple(evaluate(p, s) for p in self.configuration)

    def seen(self, s: Number) -> tuple:
        """What gaps see: the configuration, and what is derived."""
        return self.position(s) + tuple(evaluate(p, s) for p in self.derived)

    def tangent(self, s: Number) -> tuple:
        """The derivative of `position`, per unit of local time."""
        return tuple(evaluate(derivative(p), s) for p in self.configuration)

    def velocity(self, s: Number) -> tuple:
        return tuple(evaluate(p, s) for p in self.rate)


class Search(NamedTuple):
    """How far the search has come along an arc."""

    s: Scalar  # local time up to which no contact is crossed
    window: Scalar  # how far ahead the next step looks for its bound
    contact: Index  # the contact that is crossed at s, or -1
    finished: Bool[Array, ""]  # a contact is crossed or the end of the arc is reached
    rests: Bool[Array, ""]  # a bounce there would not rise above rounding
    ends: Bool[Array, ""]  # nor could it be computed: the motion stays in contact


class _Step(NamedTuple):
    size: Scalar  # to the first zero of the parabola below the level, or to the end of the window
    hit: Any  # the level itself is zero there
    clear: Any  # the whole window is free of zeros
    rate: Number  # of the level, where the step begins
    bend: Number
    noise: Number
    exact: Any
    look: Any = None  # how far at least to look ahead next, where the bound may have been too wide to take a step by


class _Here(NamedTuple):
    """The path from local time s on, shared by all contacts."""

    s: Scalar
    coefficients: tuple[Polynomial, ...]  # in powers of time - s: position, tangent, half the second derivative, ...
    size: Number  # of the numbers that the position is the sum of: what its rounding goes by
    speed: Number  # the size of the tangent

    @property
    def position(self) -> tuple:
        return tuple(p[0] for p in self.coefficients)

    @property
    def tangent(self) -> tuple:
        return tuple(p[1] for p in self.coefficients)

    @property
    def half_bends(self) -> tuple:
        return tuple(p[2] if len(p) > 2 else 0.0 for p in self.coefficients)


def _here(path: Sequence[Polynomial], s: Any) -> _Here:
    coefficients = tuple(recentred(p, s) for p in path)
    size = total([evaluate(tuple(abs(c) for c in p), s) for p in path])
    return _Here(s, coefficients, size, norm(tuple(p[1] for p in coefficients)))


def _is_exact(system: AbstractSystem, contact: Any, path: Sequence[Polynomial]) -> bool:
    """Whether the level along the path is a parabola, so that one step ends at its zero."""
    return system.is_parabolic(contact) and all(len(p) <= 3 for p in path)


def _return(system: AbstractSystem, contact: Any, arc: Arc) -> Return | None:
    """When a parabola that begins on a flat face comes back to it."""
    if any(len(p) > 3 for p in arc.configuration) and arc.is_parabola is None:
        return None
    q, v, half_a = (tuple(p[k] if len(p) > k else 0.0 for p in arc.configuration) for k in range(3))
    back = system.returns(contact, arc.time, q, v, half_a, arc.start)
    if back is None or arc.is_parabola is None:
        return back
    return back._replace(comes=back.comes & arc.is_parabola)


def _safe_step(system: AbstractSystem, contact: Any, arc: Arc, here: _Here, window: Any, touching: Any) -> _Step:
    s, coefficients = here.s, here.coefficients
    left = arc.length - s
    value, rate = slope(lambda x: system.level(contact, arc.time, x, arc.start), here.position, here.tangent)
    noise = rounding(system, contact, here.size, s.dtype)
    exact = _is_exact(system, contact, coefficients)
    perhaps = arc.is_parabola if system.is_parabolic(contact) and not exact else None
    # A contact that has just been left has a gap of exactly zero that does not close; rounding may not say otherwise.
    left_behind, opens = (touching == _number(contact)) & (s == 0), False
    may_open = system.n_derived > 0 and isinstance(contact, Member)
    if may_open:
        opens = (touching == _number(contact) + system.n_contacts) & (s == 0)
        left_behind = left_behind | opens
    width: Any = left
    if not exact:  # the reach is a first guess; from then on the window knows better
        reach = system.reach(contact, here.position)
        if reach is not None:
            speed = here.speed + jnp.sqrt(2.0 * norm(here.half_bends) * reach)
            width = where(speed * left > 2.0 * reach, 2.0 * reach / where(speed > 0, speed, 1.0), left)
        width = where(jnp.isinf(window), width, jnp.minimum(left, window))
        # Where it opens from rest, at an edge that is rolled over, only a close look sees that it opens.
        width = where(left_behind & (rate <= 0), max(1e-7, float(jnp.finfo(s.dtype).eps) ** 0.5) * width, width)
    bend = system.bend(contact, arc.time, Window(coefficients, width), arc.start)
    m, most = (jnp.asarray(x, dtype=s.dtype) for x in bend)
    look, least = None, 0.0
    if system.is_wide(contact):
        # Where nothing is known at all, because the path comes too near a point where the gap has no derivative, only
        # a closer look helps; a window that is next to nothing is passed.
        look, least = width / 16.0, float(jnp.finfo(s.dtype).eps) ** 0.75 * arc.length
        m = where((m <= BLIND) & (width <= least), 0.0, m)
    value, rate, m, most, width = shared([value, rate, m, most, width])
    fails: Any = None
    if not isinstance(contact, Member) and contact >= system.n_contacts - system.n_derived:
        # A push may be negative already when an arc begins, and then it need not become less.
        radius: Any = system.reach(contact, here.position)
        fails = (value < -1e-3 * radius) & ~left_behind

    value = where(left_behind, 0.0, jnp.maximum(value, 0.0))
    rate = where(left_behind, jnp.maximum(rate, 0.0), rate)
    zero = _first_zero(value, rate, m)
    if exact:
        return _Step(zero, zero <= left, zero > left, rate, m, noise, True)
    # One Newton step from here leaves an error of bend (value / rate)^2 / 2: where that is rounding, the zero is found.
    closes, comes = rate < 0, value / _nonzero(-rate)
    sharpest = jnp.maximum(jnp.abs(m), jnp.abs(most))
    found = closes & (sharpest * value * value <= noise * rate * rate) & (comes <= width)
    near = (value <= noise) & ((closes & (zero <= width)) | ((rate == 0) & (m < 0)))
    hit = near | found
    if look is not None:  # whether a bounce would rise again is not for a bound to say that is much too wide
        hit = hit & ((rate * rate > -2.0 * m * noise) | (width <= least))
    last = where(closes, jnp.minimum(jnp.minimum(comes, zero), left), 0.0)
    size, clear = where(hit, last, jnp.minimum(zero, width)), zero >= width
    if fails is not None:
        size, hit, clear = where(fails, 0.0, size), hit | fails, clear & ~fails
    back = _return(system, contact, arc)
    if may_open:
        # It moves off with neither velocity nor acceleration: at first no bound sees that it is off.
        bends = 2.0 * norm(here.half_bends)
        soon = jnp.minimum(left, where(bends > 0, here.speed / where(bends > 0, bends, 1.0), left))
        size = where(opens, max(1e-3, float(jnp.finfo(s.dtype).eps) ** 0.25) * soon, size)
        hit, clear = hit & ~jnp.asarray(opens), clear & ~jnp.asarray(opens)
    if perhaps is not None:
        known, flies = _Step(zero, zero <= left, zero > left, rate, m, noise, True), perhaps & ~jnp.asarray(opens)
        size, hit, clear = (where(flies, a, b) for a, b in ((known.size, size), (known.hit, hit), (known.clear, clear)))
        return _Step(size, hit, clear, rate, m, noise, flies, look)
    if back is None:
        return _Step(size, hit, clear, rate, m, noise, False, look)
    falls = back.comes & left_behind & ~jnp.asarray(opens)
    size, hit, clear = where(falls, back.duration, size), where(falls, back.duration <= left, hit), clear & ~falls
    rate, m = where(falls, back.rise, rate), where(falls, times(-2.0, back.pull), m)
    return _Step(size, hit, clear, rate, m, noise, falls)


def _number(contact: Any) -> Any:
    return contact.number if isinstance(contact, Member) else contact


def _nearest(contacts: Any, step: Callable) -> tuple[_Step, Any]:
    """The shortest step towards one contact, or towards one of a stack, and the number of the contact."""
    if not isinstance(contacts, tuple) or isinstance(contacts, Member):
        return step(contacts), np.int32(_number(contacts))
    start, stack = contacts
    as_arrays = lambda each: jax.tree.map(jnp.asarray, each)  # noqa: E731
    steps = stack.each(start, lambda member: as_arrays(step(member)))
    nearest = jnp.argmin(steps.size).astype(jnp.int32)
    return jax.tree.map(lambda x: x[nearest], steps), start + nearest


def _nearest_of(contacts: Sequence, step: Callable, nearest: tuple[_Step, Any]) -> tuple[_Step, Any]:
    """The shortest of the steps towards these contacts and of one that is known."""
    first, contact = nearest
    for each in contacts:
        found, number = _nearest(each, step)
        closer = found.size < first.size  # a tie goes to the first
        contact = where(closer, number, contact)
        first = _Step(*[_either(closer, a, b) for a, b in zip(found, first, strict=True)])
    return first, contact


def _either(condition: Any, a: Any, b: Any) -> Any:
    """`where`; `None` is nothing."""
    if a is None and b is None:
        return None
    return where(condition, 0.0 if a is None else a, 0.0 if b is None else b)


def _first_zero(value: Any, rate: Any, m: Any) -> Any:
    """The first zero of the parabola value + rate s + m s^2 / 2 that is not negative, where it closes."""
    disc = rate * rate - 2.0 * m * value
    edge = jnp.sqrt(jnp.maximum(disc, 0.0))
    falling = where(disc >= 0, 2.0 * value / _nonzero(edge - rate), jnp.inf)
    rising = where(m < 0, (rate + edge) / _nonzero(-m), jnp.inf)
    return where(rate < 0, falling, rising)


def _nonzero(x: Any) -> Any:
    return where(x == 0, float(jnp.finfo(x.dtype).tiny), x)


def search(system: AbstractSystem, arc: Arc, start: Any, window: Any, touching: Index, n_steps: int) -> Search:
    """At most `n_steps` safe steps along an arc, from local time `start` up to which no contact is crossed. `touching`
    is the contact that was left at the beginning of the arc, or -1. The `window` follows the size of the steps, so
    that the bound is tight where they are small: past a near miss it then turns positive at once. Not differentiated.
    """
    arc, system = frozen(arc), frozen(system)

    def step(state: Search) -> Search:
        s, none = state.s, jnp.asarray(-1, dtype=jnp.int32)
        look = (state.window, touching)
        here = _here(arc.configuration, s)
        contacts = system.contacts()
        n = len(contacts) - system.n_derived
        nearest = _Step(jnp.asarray(jnp.inf, s.dtype), False, True, *_NOTHING), none
        nearest = _nearest_of(contacts[:n], lambda each: _safe_step(system, each, arc, here, *look), nearest)
        if system.n_derived > 0:  # a ball that flies has no contact to lose
            typed = lambda x: jnp.asarray(x, s.dtype if jnp.issubdtype(jnp.result_type(x), jnp.inexact) else None)  # noqa: E731

            def more() -> tuple:
                here = _here((*arc.configuration, *arc.derived), s)
                found = _nearest_of(contacts[n:], lambda each: _safe_step(system, each, arc, here, *look), nearest)
                return jax.tree.map(typed, found)

            nearest = if_any(system.phase(arc.start) >= 0, more, lambda: jax.tree.map(typed, nearest))
        first, contact = nearest
        end = s + first.size
        hit = first.hit & (end <= arc.length)
        ahead = where(first.clear, 4.0, 2.0) * jnp.minimum(first.size, arc.length)
        ahead = ahead if first.look is None else jnp.maximum(ahead, first.look)
        rests, ends = _rests(first, hit, here.speed, s.dtype)
        s, finished = jnp.minimum(end, arc.length), hit | (end >= arc.length)
        found = Search(s, ahead, where(hit, contact, none), finished, rests, ends)
        return Search(*[where(state.finished, a, b) for a, b in zip(state, found, strict=True)])

    none, no = jnp.asarray(-1, dtype=jnp.int32), jnp.asarray(False)
    state = Search(start, window, none, start >= arc.length, no, no)
    if n_steps == 1 or system.n_contacts == 0:
        return step(state)
    going = lambda c: (c[0] < n_steps) & eqxi.unvmap_any(~c[1].finished)  # noqa: E731
    return lax.while_loop(going, lambda c: (c[0] + 1, step(c[1])), (jnp.asarray(0), state))[1]


def _rests(first: _Step, hit: Any, speed: Number, dtype: Any) -> tuple[Any, Any]:
    """Whether a bounce at the end of a step would not rise above rounding, and whether it could not even be computed:
    on a plane it is, down to the rounding of the velocity itself."""
    rate = first.rate + first.bend * where(hit, first.size, 0.0)
    rests = jnp.asarray(first.bend < 0) & (rate * rate <= -2.0 * first.bend * first.noise)
    least = 16.0 * float(jnp.finfo(dtype).eps) * speed
    return rests, rests & (jnp.logical_not(first.exact) | (abs(rate) <= least))


_NOTHING = (0.0, 0.0, 0.0, False)  # of a level that is never zero


def _noise(system: AbstractSystem, contact: Any, arc: Arc) -> Number:
    """The part of the speed below which the rate of a level at its zero is rounding. On a plane it is that of the
    velocity; elsewhere the zero itself is known only to the root of rounding where the level hardly changes."""
    eps = float(jnp.finfo(arc.time.dtype).eps)
    if arc.is_parabola is not None and system.is_parabolic(contact):
        return where(arc.is_parabola, 4.0 * eps, eps**0.5)
    return 4.0 * eps if _is_exact(system, contact, arc.configuration) else eps**0.5


@eqx.filter_custom_jvp
def crossing_time(s: Scalar, contact: Index, system: AbstractSystem, arc: Arc) -> Scalar:
    """The local time s at which a contact is crossed, found by `search`, with its derivatives in the arc and the
    system: those of an implicit function. Where the rate of the level is not known (grazing) s has none."""
    del contact, system, arc
    return s


@crossing_time.def_jvp
def _crossing_time_jvp(primals: tuple, tangents: tuple) -> tuple:
    s, index, system, arc = primals
    contact = system.choice(index)

    def level(system: AbstractSystem, arc: Arc, s: Any) -> Any:
        q, contact = arc.seen(s), system.choice(index)  # its surfaces are those of this system
        levels = [system.level(each, arc.time, q, arc.start) for each in contact.members]
        return contact.of([jnp.asarray(level, s.dtype) for level in levels])

    s = crossing_time(*primals)
    _, change = eqx.filter_jvp(lambda system, arc: level(system, arc, s), (system, arc), tangents[2:])
    if change is None:  # a spin alone moves no arc before the first impact
        return s, None
    _, rate = jax.jvp(lambda s: level(system, arc, s), (s,), (jnp.ones_like(s),))
    # An arc that nothing cuts keeps its s: a division by nothing could overflow, and its derivative with it.
    noise = where(index >= 0, contact.of([_noise(system, each, arc) for each in contact.members]), jnp.inf)
    steep = jnp.abs(rate) > noise * frozen(norm(arc.tangent(s)))
    (slope,) = shared([where(steep, rate, 1.0)])
    return s, where(steep, -change / slope, 0.0)
