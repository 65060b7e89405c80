"""What a number does along a window: enclosures of its values, its rate and its second derivative, and their sums,
products, powers and functions.

Each enclosure is met with the one that follows from its value at the start and the enclosure of the next derivative
(mean value theorem), so that it shrinks with the window and does not grow with the length of the formula. Where a
number has a kink its second derivative is a bound of what it is beside the kink on the side to which it bends there,
and infinite on the other: the rate jumps.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from .intervals import (
    SMOOTH,
    Values,
    by_sign,
    chosen,
    everything,
    greatest,
    hull,
    meet,
    negative,
    plus_each,
    point,
    product_of,
    real_power_of,
    sine_of,
    softplus_of,
    weighed,
    whole_power,
    whole_power_of,
    widened,
)
from .polynomial import Interval
from .shared import shared


class Course(NamedTuple):
    """One number, or an array of them, over a window of local time."""

    value: Interval
    rate: Interval
    bend: Interval
    start: Any  # the value and the rate where the window begins
    pace: Any
    squares: tuple | None = None  # if it is a sum of squares: bounds of the sums of the squared rates and second
    # derivatives of what is squared; its root is then as steep as these say, and no steeper, where it is zero


class Truth(NamedTuple):
    """A condition over a window: whether it always holds, whether it ever does, and whether at the start."""

    always: Any
    ever: Any
    start: Any


def constant(x: Any) -> Course:
    still = point(jnp.zeros_like(x))
    return Course(point(x), still, still, x, still.low)


def enclosed(
    width: Any, value: Interval, rate: Interval, bend: Interval, start: Any, pace: Any, squares: tuple | None = None
) -> Course:
    """A course from enclosures that may be wider than they need to be."""
    value, rate, bend = _known(value), _known(rate), _known(bend)
    pace = jnp.clip(jnp.where(jnp.isnan(pace), 0.0, pace), rate.low, rate.high)
    rate = widened(meet(rate, _spread(pace, bend, width)))
    value = widened(meet(value, _spread(start, rate, width)))
    if start.size == 1:  # each is used many times over; arrays rather pass through once
        parts = shared([*value, *rate, *bend, start, pace])
        value, rate, bend = (Interval(*parts[k : k + 2]) for k in (0, 2, 4))
        start, pace = parts[6:]
    return Course(value, rate, bend, start, pace, squares)


def _known(a: Interval) -> Interval:
    return Interval(jnp.where(jnp.isnan(a.low), -jnp.inf, a.low), jnp.where(jnp.isnan(a.high), jnp.inf, a.high))


def _spread(start: Any, change: Interval, width: Any) -> Interval:
    return _known(Interval(start + jnp.minimum(change.low, 0.0) * width, start + jnp.maximum(change.high, 0.0) * width))


def moved(width: Any, a: Course, b: Course) -> Course:
    """a + b."""
    squares = None
    if a.squares is not None and b.squares is not None:
        squares = (a.squares[0] + b.squares[0], a.squares[1] + b.squares[1])
    value, rate, bend = (plus_each(x, y) for x, y in zip(a[:3], b[:3], strict=True))
    return enclosed(width, value, rate, bend, a.start + b.start, a.pace + b.pace, squares)


def summed(width: Any, a: Course) -> Course:
    """A sum, from the sums of all parts."""
    return enclosed(width, a.value, a.rate, a.bend, a.start, a.pace, a.squares)


def shifted(a: Course, c: Any) -> Course:
    """a + c for a constant: the root of a sum of squares and a number that is not negative is a distance, too."""
    squares = a.squares
    if squares is not None:
        squares = tuple(jnp.where(c >= 0, x, jnp.inf) for x in squares)
    value = widened(Interval(a.value.low + c, a.value.high + c))
    return a._replace(value=value, start=a.start + c, squares=squares)


def opposite(a: Course) -> Course:
    return Course(negative(a.value), negative(a.rate), negative(a.bend), -a.start, -a.pace)


def scaled(known: float | None, c: Any, a: Course) -> Course:
    """c a for a constant, whose sign may be known."""
    squares = a.squares
    if squares is not None:
        squares = tuple(jnp.where(c >= 0, c * x, jnp.inf) for x in squares)
    value, rate, bend = (by_sign(known, c, x) for x in a[:3])
    return Course(value, rate, bend, c * a.start, c * a.pace, squares)


def multiplied(width: Any, a: Course, b: Course) -> Course:
    rates = product_of(a.rate, b.rate)
    bend = plus_each(product_of(a.bend, b.value), rates, rates, product_of(a.value, b.bend))
    rate = plus_each(product_of(a.rate, b.value), product_of(a.value, b.rate))
    value = product_of(a.value, b.value)
    return enclosed(width, value, rate, bend, a.start * b.start, a.pace * b.start + a.start * b.pace)


def of_function(width: Any, values: Values, a: Course, function: Callable) -> Course:
    """A function of a, from what it does over the values of a."""
    return _composed(width, values, a, *jax.jvp(function, (a.start,), (a.pace,)))


def _composed(width: Any, values: Values, a: Course, start: Any, pace: Any) -> Course:
    rate = product_of(values.slope, a.rate)
    bend = plus_each(weighed(whole_power(a.rate, 2), values.bend), product_of(values.slope, a.bend))
    return enclosed(width, values.value, rate, bend, start, pace)


def squared(width: Any, a: Course) -> Course:
    found = of_function(width, whole_power_of(a.value, 2), a, jnp.square)
    return found._replace(squares=(greatest(a.rate) ** 2, greatest(a.bend) ** 2))


def rooted(width: Any, values: Values, a: Course, function: Callable) -> Course:
    """The square root. That of a sum of squares is a length: it changes no faster than the vector does, and its second
    derivative is not below minus the size of that of the vector (by Cauchy and Schwarz), even where it is zero."""
    root = of_function(width, values, a, function)
    if a.squares is None:
        return root
    fastest, hardest = (jnp.sqrt(x) for x in a.squares)
    rate = meet(root.rate, widened(Interval(-fastest, fastest)))
    bend = root.bend._replace(low=jnp.maximum(root.bend.low, -hardest))
    return enclosed(width, root.value, rate, bend, root.start, root.pace)


def sine(width: Any, a: Course) -> Course:
    value, slope = shared([jnp.sin(a.start), jnp.cos(a.start)])
    return _composed(width, sine_of(a.value, a.start, value, slope), a, value, slope * a.pace)


def cosine(width: Any, a: Course) -> Course:
    return sine(width, shifted(a, math.pi / 2.0))


def to_whole_power(width: Any, a: Course, n: int, function: Callable) -> Course:
    return squared(width, a) if n == 2 else of_function(width, whole_power_of(a.value, n), a, function)


def to_real_power(width: Any, a: Course, p: Any, function: Callable) -> Course:
    return of_function(width, real_power_of(a.value, p), a, function)


def inverse(width: Any, a: Course) -> Course:
    return to_whole_power(width, a, -1, lambda x: 1.0 / x)


def largest(width: Any, a: Course, axes: Sequence[int]) -> Course:
    """The largest of the numbers along some axes: a kink, convex, where another one takes over."""
    axes = tuple(axes)
    value = Interval(jnp.max(a.value.low, axes), jnp.max(a.value.high, axes))
    contends = a.value.high >= jnp.expand_dims(value.low, axes)
    least = lambda x: jnp.min(jnp.where(contends, x, jnp.inf), axes)  # noqa: E731
    most = lambda x: jnp.max(jnp.where(contends, x, -jnp.inf), axes)  # noqa: E731
    rate = Interval(least(a.rate.low), most(a.rate.high))
    alone = jnp.sum(contends, axes) <= 1
    bend = Interval(least(a.bend.low), jnp.where(alone, most(a.bend.high), jnp.inf))
    start, pace = jax.jvp(lambda x: jnp.max(x, axes), (a.start,), (a.pace,))
    return enclosed(width, value, rate, bend, start, pace)


def larger(width: Any, a: Course, b: Course) -> Course:
    return largest(width, jax.tree.map(lambda x, y: jnp.stack([x, y]), a._replace(squares=None),
                                       b._replace(squares=None)), (0,))  # fmt: skip


def smaller(width: Any, a: Course, b: Course) -> Course:
    return opposite(larger(width, opposite(a), opposite(b)))


def size(width: Any, a: Course) -> Course:
    return larger(width, a, opposite(a))


def stepped(a: Course, function: Callable) -> Course:
    """A function that is constant between its jumps, and not falling."""
    value = Interval(function(a.value.low), function(a.value.high))
    unknown, still = everything(a.start), point(jnp.zeros_like(a.start))
    rest = chosen(value.low == value.high, still, unknown)
    return Course(value, rest, rest, function(a.start), still.low)


def either(truth: Truth, a: Course, b: Course) -> Course:
    """a where the condition holds, else b. Where it may change nothing is known but the values."""
    unknown = everything(a.start)

    def part(x: Interval, y: Interval, open_: Interval) -> Interval:
        return chosen(truth.always, x, chosen(truth.ever, open_, y))

    value = part(a.value, b.value, hull(a.value, b.value))
    rate, bend = (part(x, y, unknown) for x, y in zip(a[1:3], b[1:3], strict=True))
    start, pace = (jnp.where(truth.start, x, y) for x, y in zip(a[3:5], b[3:5], strict=True))
    return Course(value, rate, bend, start, pace)


def angle(width: Any, y: Course, x: Course) -> Course:
    """The angle of (x, y), unknown where the box of both holds the origin or the cut along the negative x."""
    radius2 = moved(width, squared(width, x), squared(width, y))
    over = inverse(width, radius2)
    turn = plus_each(product_of(x.value, y.rate), negative(product_of(y.value, x.rate)))
    drift = plus_each(product_of(x.value, y.bend), negative(product_of(y.value, x.bend)))
    rate = product_of(turn, over.value)
    bend = plus_each(product_of(drift, over.value), product_of(turn, over.rate))
    corners = [jnp.arctan2(b, a) for a in x.value for b in y.value]
    low = jnp.minimum(jnp.minimum(corners[0], corners[1]), jnp.minimum(corners[2], corners[3]))
    high = jnp.maximum(jnp.maximum(corners[0], corners[1]), jnp.maximum(corners[2], corners[3]))
    cut = (x.value.low <= 0) & (y.value.low <= 0) & (y.value.high >= 0)
    around = Interval(jnp.full_like(low, -jnp.pi), jnp.full_like(low, jnp.pi))
    value, unknown = chosen(cut, around, Interval(low, high)), everything(low)
    start, pace = jax.jvp(jnp.arctan2, (y.start, x.start), (y.pace, x.pace))
    return enclosed(width, value, chosen(cut, unknown, rate), chosen(cut, unknown, bend), start, pace)


def soft_larger(width: Any, a: Course, b: Course) -> Course:
    """log(exp(a) + exp(b))."""
    ahead = moved(width, b, opposite(a))
    return moved(width, a, of_function(width, softplus_of(ahead.value), ahead, jax.nn.softplus))


def length(width: Any, *sides: Course) -> Course:
    """The root of the sum of squares."""
    total = squared(width, sides[0])
    for side in sides[1:]:
        total = moved(width, total, squared(width, side))
    return rooted(width, SMOOTH["sqrt"](total.value), total, jnp.sqrt)
