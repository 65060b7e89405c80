"""The first crossing of an arc with the contacts of a system, found without ever passing one.

With m a lower bound of a level's second derivative on a window, the level stays above f + f' s + m s^2 / 2 there, so
that a step to the first zero of that parabola can never pass a crossing. On a plane and a parabolic arc m is exact and
the first step ends at the crossing; elsewhere steps converge to it quadratically. The search is not differentiated: a
Newton correction of its result is, which is the implicit function theorem.
"""

from typing import Any, NamedTuple

import equinox as eqx
import equinox.internal as eqxi
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool

from .._math import (
    Index,
    Number,
    Polynomial,
    Scalar,
    Window,
    derivative,
    dot,
    evaluate,
    frozen,
    norm,
    recentred,
    select,
    shared,
    slope,
    subtract,
    times,
)
from .._world import AbstractSystem, rounding


class Arc(eqx.Module):
    """Smooth motion from `time` on: polynomials of the configuration and of its rate (per second) in local time,
    which runs from 0 to `length` in units of `unit` seconds. It began at the state `start`."""

    time: Scalar
    start: Any
    configuration: tuple[Polynomial, ...]
    rate: tuple[Polynomial, ...]
    length: Number
    unit: Number

    def position(self, s: Number) -> tuple:
        return tuple(evaluate(p, s) for p in self.configuration)

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


class _Step(NamedTuple):
    size: Scalar  # to the first zero of the parabola below the level, or to the end of the window
    hit: Bool[Array, ""]  # the level itself is zero there
    clear: Bool[Array, ""]  # the whole window is free of zeros


class _Here(NamedTuple):
    """The path from local time s on, shared by all contacts."""

    s: Scalar
    coefficients: tuple[Polynomial, ...]  # in powers of time - s: position, tangent, half the second derivative, ...
    size: tuple  # of the numbers that the position is the sum of: what its rounding goes by

    @property
    def position(self) -> tuple:
        return tuple(p[0] for p in self.coefficients)

    @property
    def tangent(self) -> tuple:
        return tuple(p[1] for p in self.coefficients)


def _here(arc: Arc, s: Any) -> _Here:
    coefficients = tuple(recentred(p, s) for p in arc.configuration)
    return _Here(s, coefficients, tuple(evaluate(tuple(abs(c) for c in p), s) for p in arc.configuration))


def _is_exact(system: AbstractSystem, contact: int, path: tuple[Polynomial, ...]) -> bool:
    """Whether the level along the path is a parabola, so that one step ends at its zero."""
    return system.reach(contact, tuple(p[0] for p in path)) is None and all(len(p) <= 3 for p in path)


def _return_to_face(system: AbstractSystem, contact: int, arc: Arc) -> tuple[Scalar, Bool[Array, ""]]:
    """When a parabola that begins on a flat face comes back to it, from the velocity alone, and whether it does. Until
    then it is on the outer side of the face's plane, so that it cannot have met the surface before."""
    q = tuple(p[0] for p in arc.configuration)
    face = system.face(contact, arc.time, q) if all(len(p) <= 3 for p in arc.configuration) else None
    if face is None:
        return jnp.asarray(jnp.inf, dtype=arc.time.dtype), jnp.asarray(False)
    n, place = face.normal, arc.configuration[:3]
    rise = dot(n, tuple(p[1] if len(p) > 1 else 0.0 for p in place))
    pull = -dot(n, tuple(p[2] if len(p) > 2 else 0.0 for p in place))
    falls = jnp.asarray((pull > 0) & (rise > 0) & face.below)
    s = jnp.where(falls, rise / jnp.where(falls, pull, 1.0), jnp.inf)
    if face.half is not None:
        landing = subtract(arc.position(jnp.where(falls, s, 0.0))[:3], face.center)
        for across, half in zip(face.tangents, face.half, strict=True):
            falls = falls & (abs(dot(across, landing)) <= half)
    return s, falls


def _returns(system: AbstractSystem, contact: int, arc: Arc, s: Any) -> Bool[Array, ""]:
    """Whether an arc begins on a plane, or on a flat face to which it comes back at s: then the search has found that
    time from the velocity alone, and the level there, which is nothing but rounding, could only spoil it by rounding
    over the speed."""
    q = frozen(tuple(p[0] for p in arc.configuration))
    touches = abs(frozen(system.level(contact, arc.time, q, arc.start))) <= rounding(system, contact, q)
    if _is_exact(system, contact, arc.configuration):
        return touches
    back, falls = frozen(_return_to_face(system, contact, arc))
    return touches & falls & (abs(s - back) <= 1e-9 * back)


def _safe_step(system: AbstractSystem, contact: int, arc: Arc, here: _Here, window: Any, touching: Any) -> _Step:
    s, coefficients, size = here
    left = arc.length - s
    value, rate = slope(lambda x: system.level(contact, arc.time, x, arc.start), here.position, here.tangent)
    tolerance = rounding(system, contact, size)
    reach = system.reach(contact, here.position)
    exact = _is_exact(system, contact, coefficients)
    width = left
    if reach is not None:
        bends = [times(2.0, p[2]) if len(p) > 2 else 0.0 for p in coefficients]
        speed = norm(here.tangent) + jnp.sqrt(norm(bends) * reach)
        width = jnp.where(speed * left > 2.0 * reach, 2.0 * reach / jnp.where(speed > 0, speed, 1.0), left)
    if not exact:  # the reach is a first guess; from then on the window knows better
        width = jnp.where(jnp.isinf(window), width, jnp.minimum(left, window))
    # A contact that has just been left has a gap of exactly zero that does not close; rounding may not say otherwise.
    left_behind = touching & (s == 0)
    if not exact:  # where it opens from rest, at an edge that is rolled over, only a close look sees that it opens
        width = jnp.where(left_behind & (rate <= 0), 1e-7 * width, width)
    bend = system.bend(contact, arc.time, Window(coefficients, width), arc.start)
    m, most = (jnp.asarray(x, dtype=arc.time.dtype) for x in bend)
    value, rate, m, most, width = shared([value, rate, m, most, width])

    value = jnp.where(left_behind, 0.0, jnp.maximum(value, 0.0))
    rate = jnp.where(left_behind, jnp.maximum(rate, 0.0), rate)
    disc = rate * rate - 2.0 * m * value
    edge = jnp.sqrt(jnp.maximum(disc, 0.0))
    falling = jnp.where(disc >= 0, 2.0 * value / _nonzero(edge - rate), jnp.inf)
    rising = jnp.where(m < 0, (rate + edge) / _nonzero(-m), jnp.inf)
    zero = jnp.where(rate < 0, falling, rising)
    if exact:
        return _Step(zero, zero <= left, zero > left)
    # One Newton step from here leaves an error of bend (value / rate)^2 / 2: where that is rounding, the zero is found.
    sharpest = jnp.maximum(jnp.abs(m), jnp.abs(most))
    found = (rate < 0) & (sharpest * value * value <= tolerance * rate * rate) & (value <= -rate * width)
    near = (value <= tolerance) & (((rate < 0) & (zero <= width)) | ((rate == 0) & (m < 0)))
    last = jnp.where(rate < 0, jnp.minimum(jnp.minimum(value / _nonzero(-rate), zero), left), 0.0)
    hit = near | found
    size = jnp.where(hit, last, jnp.minimum(zero, width))
    back, falls = _return_to_face(system, contact, arc)
    falls = falls & left_behind
    return _Step(jnp.where(falls, back, size), jnp.where(falls, back <= left, hit), (zero >= width) & ~falls)


def _nonzero(x: Any) -> Any:
    return jnp.where(x == 0, jnp.asarray(jnp.finfo(x.dtype).tiny, dtype=x.dtype), x)


def search(system: AbstractSystem, arc: Arc, start: Any, window: Any, touching: Index, n_steps: int) -> Search:
    """At most `n_steps` safe steps along an arc, from local time `start` up to which no contact is crossed. `touching`
    is the contact that was left at the beginning of the arc, or -1. The `window` follows the size of the steps, so
    that the bound is tight where they are small: past a near miss it then turns positive at once. Not differentiated.
    """
    arc, system = frozen(arc), frozen(system)
    none = jnp.asarray(-1, dtype=jnp.int32)

    def step(state: Search) -> Search:
        size, contact = jnp.asarray(jnp.inf, dtype=state.s.dtype), none
        hit, clear = jnp.asarray(False), jnp.asarray(True)
        here = _here(arc, state.s)
        for i in range(system.n_contacts):
            each = _safe_step(system, i, arc, here, state.window, touching == i)
            closer = each.size < size  # a tie goes to the first
            size = jnp.where(closer, each.size, size)
            contact = jnp.where(closer, i, contact).astype(jnp.int32)
            hit = jnp.where(closer, each.hit, hit)
            clear = jnp.where(closer, each.clear, clear)
        hit = hit & (state.s + size <= arc.length)
        s = jnp.minimum(state.s + size, arc.length)
        ahead = jnp.where(clear, 4.0, 2.0) * jnp.minimum(size, arc.length)
        found = Search(s, ahead, jnp.where(hit, contact, none), hit | (state.s + size >= arc.length))
        return Search(*[jnp.where(state.finished, a, b) for a, b in zip(state, found, strict=True)])

    state = Search(start, window, none, start >= arc.length)
    if n_steps == 1 or system.n_contacts == 0:
        return step(state)
    going = lambda c: (c[0] < n_steps) & eqxi.unvmap_any(~c[1].finished)  # noqa: E731
    return lax.while_loop(going, lambda c: (c[0] + 1, step(c[1])), (jnp.asarray(0), state))[1]


class Meeting(NamedTuple):
    """What the level of one contact does at one local time, where it is crossed."""

    value: Scalar
    rate: Scalar
    noise: Any  # rates below this one, as a part of the speed, are not known
    rests: Bool[Array, ""]  # a bounce would not rise above rounding
    ends: Bool[Array, ""]  # nor could it be computed: the motion stays in contact


def _noise(system: AbstractSystem, contact: int, arc: Arc) -> float:
    """The part of the speed below which the rate of a level at its zero is rounding. On a plane it is that of the
    velocity; elsewhere the zero itself is known only to the root of rounding where the level hardly changes."""
    eps = float(jnp.finfo(arc.time.dtype).eps)
    return 4.0 * eps if _is_exact(system, contact, arc.configuration) else eps**0.5


def meeting(system: AbstractSystem, arc: Arc, s: Scalar, contact: Index) -> Meeting:
    here = _here(arc, s)
    columns = []
    for i in range(system.n_contacts):
        value, rate = slope(lambda x, i=i: system.level(i, arc.time, x, arc.start), here.position, here.tangent)
        bend = system.bend(i, arc.time, Window(here.coefficients, 0.0), arc.start)
        flat = 1.0 if _is_exact(system, i, here.coefficients) else 0.0
        returns = jnp.where(_returns(system, i, arc, s), 1.0, 0.0)
        columns.append((value, rate, bend.low, rounding(system, i, here.size), flat, returns))
    value, rate, bend, tolerance, flat, returns = [select(contact, column) for column in zip(*columns, strict=True)]
    value, rate, bend, tolerance = shared([value, rate, bend, tolerance])
    rests = (bend < 0) & (rate * rate <= -2.0 * bend * tolerance)
    # On a plane a bounce of any height is computed, down to the rounding of the velocity itself.
    least = 16.0 * float(jnp.finfo(s.dtype).eps) * norm(here.tangent)
    value = jnp.where(returns > 0.5, value - frozen(value), value)  # zero, with the derivative that it has
    exact = jnp.asarray(flat > 0.5) | (returns > 0.5)
    noise = select(contact, [_noise(system, i, arc) for i in range(system.n_contacts)])
    return Meeting(value, rate, noise, rests, rests & (~exact | (jnp.abs(rate) <= least)))  # pyright: ignore


def newton(arc: Arc, s: Scalar, value: Number, rate: Number, noise: Number) -> Scalar:
    """One Newton step for the zero of a level. Where its rate is not known (grazing) `s` is kept."""
    steep = jnp.abs(rate) > noise * frozen(norm(arc.tangent(s)))
    s = s - jnp.where(steep, value / jnp.where(steep, rate, 1.0), 0.0)
    return s - frozen(jnp.minimum(s, 0.0))  # not before the arc begins, with the derivative it has


def corrected(system: AbstractSystem, arc: Arc, s: Scalar, contact: Index) -> Scalar:
    """The local time of a crossing found near `s`, differentiable in the arc and the system: two Newton steps, so
    that second derivatives are right too."""
    known = s = frozen(s)
    returns = select(contact, [jnp.where(_returns(system, i, arc, s), 1.0, 0.0) for i in range(system.n_contacts)])
    noise = select(contact, [_noise(system, i, arc) for i in range(system.n_contacts)])
    # An arc that nothing cuts keeps its s: a Newton step to nowhere could overflow, and its derivative with it.
    noise = jnp.where(contact >= 0, noise, jnp.inf)
    for _ in range(2):
        q, tangent = arc.position(s), arc.tangent(s)
        pairs = [
            slope(lambda x, i=i: system.level(i, arc.time, x, arc.start), q, tangent) for i in range(system.n_contacts)
        ]
        (s,) = shared([newton(arc, s, *(select(contact, column) for column in zip(*pairs, strict=True)), noise)])
    return jnp.where(returns > 0.5, known + (s - frozen(s)), s)  # pyright: ignore[reportOperatorIssue]
