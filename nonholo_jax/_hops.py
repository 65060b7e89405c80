"""Parabolas from plane to plane, each with the impact that ends it, in few passes over a batch.

Between planes the next impact is the root of a quadratic, and needs no search. A hop does only what an ordinary bounce
needs; where there may be more to do (a corner, grazing, bounces that die out, a number that is not finite) it says so,
and the event loop goes on from there.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp

from ._shared import shared
from ._types import Number, Vector3
from ._vector import add, is_constant, scale, select, times


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
    again: Callable  # of `touching`, the choice that was made, `left` and a state: duration and state, with derivatives


class Wall(NamedTuple):
    """A plane as a hop sees it, with what the ball's centre does towards it."""

    normal: Vector3
    gap: Any
    rate: Any
    pull: Number  # half the acceleration of the gap
    noise: Number  # the rounding of the gap
    origin: Number  # the gap of a ball at the origin, which is a constant where the plane is one


def _times_to(wall: Wall, left_behind: Any) -> Any:
    """When the gap closes: infinite where it does not, negative where rounding could decide."""
    gap = jnp.where(left_behind, 0.0, jnp.maximum(wall.gap, 0.0))
    rate = jnp.where(left_behind, jnp.maximum(wall.rate, 0.0), wall.rate)
    closes = rate < 0
    if is_constant(wall.pull) and wall.pull == 0:
        return jnp.where(closes, gap / jnp.where(closes, -rate, 1.0), jnp.inf)
    square = rate * rate - 4.0 * wall.pull * gap
    # Not only a root, but an impact that is well above rounding, so that the ball bounces.
    clear = square > 8.0 * abs(wall.pull) * wall.noise + 64.0 * float(jnp.finfo(rate.dtype).eps) * rate * rate
    found = jnp.where(clear, _closing(gap, rate, wall.pull, jnp.where(clear, square, 1.0)), -1.0)
    opens = jnp.asarray(wall.pull >= 0) & ((square < 0) | ~closes)  # nothing pulls it there
    return jnp.where(opens, jnp.inf, found)


def _closing(gap: Any, rate: Any, pull: Number, square: Any) -> Any:
    """The root of gap + rate t + pull t^2 from above to below, of which `square` is the discriminant."""
    closes, edge = rate < 0, jnp.sqrt(square)
    return jnp.where(closes, 2.0 * gap, rate + edge) / jnp.where(closes, edge - rate, _positive(-2.0 * pull))


def _positive(x: Number) -> Number:
    return x if is_constant(x) and x > 0 else jnp.where(jnp.asarray(x > 0), x, 1.0)


def _are_apart(a: Wall, b: Wall) -> bool:
    """Whether two planes are known to face each other at a distance, so that no ball touches both."""
    if not all(is_constant(c) for c in (*a.normal, *b.normal, a.origin, b.origin)):
        return False
    faces = all(x == -y for x, y in zip(a.normal, b.normal, strict=True))
    return faces and bool(a.origin + b.origin > 1e-3 * (abs(a.origin) + abs(b.origin)))


def hop(
    walls: Sequence[Wall],
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

    **Arguments:** `kicked(choice, velocity, spin)`: the velocities after an impact; `dies_out(i, wall, speed, left)`:
    whether bounces may die out after an impact of that normal speed; the rest as in `Hopper`.
    """
    steps = shared([_times_to(wall, touching == i) for i, wall in enumerate(walls)])
    h, which = steps[0], jnp.zeros_like(left)
    for i, step in enumerate(steps[1:], 1):
        which = jnp.where(step < h, float(i), which)
        h = jnp.minimum(h, step)
    hits, hops = h <= left, jnp.isfinite(left) & (h >= 0)
    for i, wall in enumerate(walls):
        there = (which == i) & hits
        unusual = dies_out(i, wall, -(wall.rate + 2.0 * wall.pull * h), left - h)
        for other in walls:
            if other is not wall and not _are_apart(wall, other):
                unusual = unusual | (other.gap + h * (other.rate + other.pull * h) <= 32.0 * other.noise)
        hops = hops if unusual is False else hops & ~(there & unusual)
    choice = jnp.where(hops, jnp.where(hits, jnp.where(full, FULL - which, which), ENDS), PAUSES)
    duration = jnp.where(going & hops, jnp.minimum(h, left), 0.0)
    choice = jnp.where(going, choice, PAUSES)
    duration, choice = shared([duration, choice])
    return Hop(duration, choice, _moved(duration, choice, gravity, kicked, state))


def hop_again(walls: Sequence[Wall], gravity: Vector3, kicked: Callable, touching: Any, choice: Any, left: Any, state):
    """Duration and end of a hop that `hop` has found, with derivatives; only one plane is asked for."""
    which, hits = jnp.where(choice > FULL, choice, FULL - choice), (choice >= 0) | (choice <= FULL)
    gap, rate, pull = (select(which, column) for column in zip(*[(w.gap, w.rate, w.pull) for w in walls], strict=True))
    gap = jnp.where(touching == which, 0.0, gap)
    if is_constant(pull) and pull == 0:
        h = gap / jnp.where(hits, -rate, 1.0)
    else:
        h = _closing(gap, rate, pull, jnp.where(hits, rate * rate - 4.0 * pull * gap, 1.0))
    (duration,) = shared([jnp.where(hits, h, jnp.where(choice == ENDS, left, 0.0))])
    return duration, _moved(duration, choice, gravity, kicked, state)


def _moved(duration: Any, choice: Any, gravity: Vector3, kicked: Callable, state: Any) -> Any:
    struck = choice >= 0
    x, v, spin = state
    position = add(x, scale(duration, add(v, scale(times(0.5, duration), gravity))))
    velocity = add(v, scale(duration, gravity))
    after, turned = kicked(choice, velocity, spin)
    keep = lambda new, old: tuple(b if a is b else jnp.where(struck, a, b) for a, b in zip(new, old, strict=True))  # noqa: E731
    return position, keep(after, velocity), keep(turned, spin)
