"""Parabolas from impact to impact, each with the impact that ends it, in few passes over a batch.

Between planes and the faces of boxes the next impact is the root of a quadratic, at an edge a few steps of Newton's
method away from one: it needs no search. A hop does only what an ordinary bounce needs; where there may be more to do
(a corner of a room, grazing, an edge passed closely or slowly, bounces that die out, a number that is not finite) it
says so, and the event loop goes on from there.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox.internal as eqxi
import jax.numpy as jnp
from jax import lax

from .shared import shared
from .types import Number, Vector3
from .vector import Choice, add, is_constant, plus, scale, times, total, where


class Hop(NamedTuple):
    """A parabola and the impact at its end."""

    duration: Any  # in s; 0 for what cannot hop
    choice: Any  # a float: the plane that was hit, or one of the codes below
    state: Any  # afterwards


# The time is over; cannot hop; and, less the number of the plane, one impact too many, before which it stops.
ENDS, PAUSES, FULL = -1.0, -2.0, -3.0


class Hopper(NamedTuple):
    """How a system hops."""

    first: Callable  # of `touching` (the contact left last), `going`, `full` (there may be no further impact), `left`
    # (how many seconds are left) and a state: a `Hop`, which does nothing where not `going`
    again: Callable | None  # of `touching`, the choice that was made, `left` and a state: duration and state, with
    # derivatives; none where hops are a long program, which pays for itself in batches only


class Wall(NamedTuple):
    """A plane as a hop sees it, with what the ball's centre does towards it."""

    normal: Vector3
    gap: Any
    rate: Any
    pull: Number  # half the acceleration of the gap
    noise: Number  # the rounding of the gap
    origin: Number  # the gap of a ball at the origin, which is a constant where the plane is one

    def time_to(self, left_behind: Any) -> tuple[Any, Any]:
        """When the gap closes: infinite where it does not, negative where rounding could decide; and whether that is
        only a bound from below."""
        gap = where(left_behind, 0.0, jnp.maximum(self.gap, 0.0))
        rate = where(left_behind, jnp.maximum(self.rate, 0.0), self.rate)
        closes = rate < 0
        if is_constant(self.pull) and self.pull == 0:
            return where(closes, gap / where(closes, -rate, 1.0), jnp.inf), False
        square = rate * rate - 4.0 * self.pull * gap
        # Not only a root, but an impact that is well above rounding, so that the ball bounces.
        clear = square > 8.0 * abs(self.pull) * self.noise + 64.0 * float(jnp.finfo(rate.dtype).eps) * rate * rate
        found = where(clear, _closing(gap, rate, self.pull, where(clear, square, 1.0)), -1.0)
        opens = jnp.asarray(self.pull >= 0) & ((square < 0) | ~closes)  # nothing pulls it there
        return where(opens, jnp.inf, found), False

    def is_near(self, h: Any) -> Any:
        """Whether the ball touches it, or nearly, after so long."""
        return self.gap + h * (self.rate + self.pull * h) <= 32.0 * self.noise

    def speed(self, h: Any) -> Any:
        """How fast the gap closes after so long."""
        return -(self.rate + 2.0 * self.pull * h)


class Block(NamedTuple):
    """A box as a hop sees it: what the ball's centre does in the box's own frame. A ball that touches it has its
    centre on a box with rounded edges, inside a greater one with sharp edges."""

    place: Vector3
    rate: Vector3
    pull: Vector3  # half the acceleration
    half: Vector3
    radius: Number
    noise: Number  # the rounding of a gap

    def level(self, h: Any) -> tuple[Any, Any, Any]:
        """(D - r^2) / 2r with D the squared distance, after so long; its rate; and the square of the part of the
        velocity that it depends on."""
        value, slope, square = times(-0.5, self.radius), 0.0, 0.0
        for y, w, a, half in zip(*self[:4], strict=True):
            at = y + h * (w + a * h)
            beyond, speed = jnp.maximum(abs(at) - half, 0.0), w + 2.0 * a * h
            value = value + beyond * beyond / (2.0 * self.radius)
            slope = slope + beyond * where(at < 0, -speed, speed) / self.radius
            square = square + where(beyond > 0, speed * speed, 0.0)
        return value, slope, square

    def time_to(self, left_behind: Any) -> tuple[Any, Any]:
        """When the ball comes to it: infinite where it does not, negative where there is more to find out; and whether
        that is only a bound from below. It enters the greater box first; where it does so over a face, it is there."""
        enters = self._enters(left_behind)
        comes = jnp.isfinite(enters)
        (h,) = shared([where(comes, enters, 0.0)])
        first, on_face = h, self.level(h)[0] <= self.noise
        h, fits = self._to_edge(h, comes & ~on_face)
        _, slope, square = self.level(h)
        eps = float(jnp.finfo(h.dtype).eps)
        clear = slope * slope > 16.0 * self.pulled() * self.noise + 64.0 * eps * square
        inside = functools.reduce(
            jnp.logical_and,
            [abs(y) < half + self.radius - 64.0 * self.noise for y, half in zip(self.place, self.half, strict=True)],
        )
        _, leaving, square = self.level(jnp.zeros_like(enters))
        # At an edge, so near to the plane of a face that rounding decides on which side, it may be inside.
        near = functools.reduce(
            jnp.logical_and,
            [abs(y) < half + self.radius + 64.0 * self.noise for y, half in zip(self.place, self.half, strict=True)],
        )
        over = self._over()
        starts = ~inside & ~(near & ~((over[0] & over[1]) | (over[1] & over[2]) | (over[2] & over[0])))
        starts = starts | (left_behind & (leaving > 0) & self.is_convex(square))
        hits = fits & (slope < 0) & clear
        return where(starts, where(comes, where(hits, h, first), jnp.inf), -1.0), comes & ~hits

    def _to_edge(self, begun: Any, needed: Any) -> tuple[Any, Any]:
        """From the greater box to the rounded one, by Newton's method from one side, for the level is convex where the
        ball is fast enough; and whether that is so and it got there."""

        def step(_: Any, h: Any) -> Any:
            value, slope, _ = self.level(h)
            far = needed & (value > 0.125 * self.noise) & (slope < 0)
            return h + where(far, value / where(slope < 0, -slope, 1.0), 0.0)

        # Which lanes are still far is not asked after every step: that would be more passes over the batch than steps.
        steps = jnp.where(eqxi.unvmap_any(needed), _NEWTON_STEPS[begun.dtype.itemsize], 0)
        h = lax.fori_loop(0, steps, step, begun)
        square, (value, _, square_there) = self.level(begun)[2], self.level(h)
        return h, ~needed | ((abs(value) <= self.noise) & self.is_convex(jnp.minimum(square, square_there)))

    def pulled(self) -> Any:
        """A bound of half the acceleration."""
        return total([abs(a) for a in self.pull])

    def is_convex(self, square: Any) -> Any:
        """Whether the level is convex with room to spare, where the ball is so fast near an edge."""
        return square > _CONVEX * self.pulled() * self.radius

    def _over(self) -> list:
        """Along each axis, whether the centre is between the faces across it."""
        return [abs(y) <= half for y, half in zip(self.place, self.half, strict=True)]

    def _enters(self, left_behind: Any) -> Any:
        """When the centre comes into the greater box."""
        first, over = jnp.inf, self._over()
        for k, (y, w, a, half) in enumerate(zip(*self[:4], strict=True)):
            wide = plus(half, self.radius)
            if is_constant(a) and a == 0:  # it comes from the side that it moves away from
                ways = [(where(w > 0, -y, y) - wide, -abs(w), 0.0)]
            else:
                ways = [(y - wide, w, a), (-y - wide, -w, times(-1.0, a))]
            for gap, rate, pull in ways:
                touches = (abs(gap) <= 64.0 * self.noise) & over[k - 1] & over[k - 2]
                rate = where(left_behind & touches, jnp.maximum(rate, 0.0), rate)
                h = _falls(where(touches, 0.0, gap), rate, pull)
                (h,) = shared([h])
                at = where(jnp.isfinite(h), h, 0.0)
                for j in (k - 1, k - 2):
                    other = abs(self.place[j] + at * (self.rate[j] + self.pull[j] * at))
                    h = where(other <= plus(self.half[j], self.radius), h, jnp.inf)
                first = jnp.minimum(first, h)
        return first

    def is_near(self, h: Any) -> Any:
        """Whether the ball touches it, or nearly, after so long."""
        return self.level(h)[0] <= 32.0 * self.noise

    def speed(self, h: Any) -> Any:
        """How fast the gap closes after so long."""
        return -self.level(h)[1]


_NEWTON_STEPS = {4: 4, 8: 6}  # by the bytes of a number: what takes more is left to the event loop
_CONVEX = 32.0  # v^2 over r g / 2 of a ball near an edge, from which on the level is convex with room to spare


def _closing(gap: Any, rate: Any, pull: Number, square: Any) -> Any:
    """The root of gap + rate t + pull t^2 from above to below, of which `square` is the discriminant."""
    closes, edge = rate < 0, jnp.sqrt(square)
    return where(closes, 2.0 * gap, rate + edge) / where(closes, edge - rate, _positive(-2.0 * pull))


def _falls(gap: Any, rate: Any, pull: Number) -> Any:
    """When gap + rate t + pull t^2 goes from above to below, if it is not yet to be below for good."""
    if is_constant(pull) and pull == 0:
        return where((rate < 0) & (gap >= 0), gap / where(rate < 0, -rate, 1.0), jnp.inf)
    square = rate * rate - 4.0 * pull * gap
    falls = (square > 0) & where(gap >= 0, (rate < 0) | jnp.asarray(pull < 0), (rate > 0) & jnp.asarray(pull < 0))
    return where(falls, _closing(gap, rate, pull, where(falls, square, 1.0)), jnp.inf)


def _positive(x: Number) -> Number:
    return x if is_constant(x) and x > 0 else where(jnp.asarray(x > 0), x, 1.0)


def _are_apart(a: Any, b: Any) -> bool:
    """Whether two planes are known to face each other at a distance, so that no ball touches both."""
    if not (isinstance(a, Wall) and isinstance(b, Wall)):
        return False
    if not all(is_constant(c) for c in (*a.normal, *b.normal, a.origin, b.origin)):
        return False
    faces = all(x == -y for x, y in zip(a.normal, b.normal, strict=True))
    return faces and bool(a.origin + b.origin > 1e-3 * (abs(a.origin) + abs(b.origin)))


def hop(
    walls: Sequence[Wall | Block],
    gravity: Vector3,
    kicked: Callable,
    dies_out: Callable,
    touching: Any,
    going: Any,
    full: Any,
    left: Any,
    state: Any,
) -> Hop:
    """One hop of a ball.

    **Arguments:** `kicked(choice, position, velocity, spin)`: the velocities after an impact;
    `dies_out(i, wall, speed, left)`: whether bounces may die out after an impact of that normal speed; the rest as in
    `Hopper`.
    """
    found, bounds = zip(*[wall.time_to(touching == i) for i, wall in enumerate(walls)], strict=True)
    steps = shared(found)
    h, which = steps[0], jnp.zeros_like(left)
    for i, step in enumerate(steps[1:], 1):
        which = where(step < h, float(i), which)
        h = jnp.minimum(h, step)
    hits, hops = h <= left, jnp.isfinite(left) & (h >= 0)
    for i, wall in enumerate(walls):
        there = (which == i) & hits
        unusual = bounds[i] | dies_out(i, wall, wall.speed(h), left - h)
        for other in walls:
            if other is not wall and not _are_apart(wall, other):
                unusual = unusual | other.is_near(h)
        hops = hops if unusual is False else hops & ~(there & unusual)
    choice = where(hops, where(hits, where(full, FULL - which, which), ENDS), PAUSES)
    duration = where(going & hops, jnp.minimum(h, left), 0.0)
    choice = where(going, choice, PAUSES)
    duration, choice = shared([duration, choice])
    return Hop(duration, choice, _moved(duration, choice, gravity, kicked, state))


def hop_again(walls: Sequence[Wall], gravity: Vector3, kicked: Callable, touching: Any, choice: Any, left: Any, state):
    """Duration and end of a hop between planes that `hop` has found, with derivatives; only one plane is asked for."""
    which, hits = where(choice > FULL, choice, FULL - choice), (choice >= 0) | (choice <= FULL)
    gap, rate, pull = Choice(which, len(walls)).vector([(w.gap, w.rate, w.pull) for w in walls])
    gap = where(touching == which, 0.0, gap)
    if is_constant(pull) and pull == 0:
        h = gap / where(hits, -rate, 1.0)
    else:
        h = _closing(gap, rate, pull, where(hits, rate * rate - 4.0 * pull * gap, 1.0))
    (duration,) = shared([where(hits, h, where(choice == ENDS, left, 0.0))])
    return duration, _moved(duration, choice, gravity, kicked, state)


def _moved(duration: Any, choice: Any, gravity: Vector3, kicked: Callable, state: Any) -> Any:
    struck = choice >= 0
    x, v, spin = state
    position = add(x, scale(duration, add(v, scale(times(0.5, duration), gravity))))
    velocity = add(v, scale(duration, gravity))
    after, turned = kicked(choice, position, velocity, spin)
    keep = lambda new, old: tuple(b if a is b else where(struck, a, b) for a, b in zip(new, old, strict=True))  # noqa: E731
    return position, keep(after, velocity), keep(turned, spin)
