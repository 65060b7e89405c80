"""Polynomial paths and rigorous bounds of their derivatives over a window, from Bernstein coefficients."""

import math
from collections.abc import Sequence
from typing import NamedTuple

from .types import Number
from .vector import is_constant, maximum, minimum, plus, times, total

Polynomial = tuple[Number, ...]  # coefficients, constant term first


class Interval(NamedTuple):
    """All numbers from `low` to `high`. The two are one object where the interval is known to be a point."""

    low: Number
    high: Number

    @property
    def is_point(self) -> bool:
        return self.low is self.high


def evaluate(p: Polynomial, s: Number) -> Number:
    """Horner's rule."""
    result = p[-1]
    for coefficient in reversed(p[:-1]):
        result = plus(coefficient, times(result, s))
    return result


def derivative(p: Polynomial) -> Polynomial:
    return tuple(times(float(j), p[j]) for j in range(1, len(p))) or (0.0,)


def recentred(p: Polynomial, s: Number) -> Polynomial:
    """The coefficients in powers of (time - s), by repeated Horner steps."""
    q = list(p)
    for i in range(len(q) - 1):
        for j in range(len(q) - 2, i - 1, -1):
            q[j] = plus(q[j], times(q[j + 1], s))
    return tuple(q)


def bounds(p: Polynomial, width: Number) -> Interval:
    """An interval that holds all values on [0, width]: the hull of the Bernstein coefficients."""
    degree = len(p) - 1
    if degree == 0 or (is_constant(width) and width == 0):
        return Interval(p[0], p[0])
    scaled, power = [p[0]], width
    for coefficient in p[1:]:
        scaled.append(times(coefficient, power))
        power = times(power, width)
    low = high = p[0]
    for i in range(1, degree + 1):
        weights = [math.comb(i, j) / math.comb(degree, j) for j in range(i + 1)]
        control = total([times(weight, term) for weight, term in zip(weights, scaled, strict=False)])
        low, high = minimum(low, control), maximum(high, control)
    return Interval(low, high)


def product(a: Interval, b: Interval) -> Interval:
    if a.is_point and b.is_point:
        value = times(a.low, b.low)
        return Interval(value, value)
    corners = [times(x, y) for x in a for y in b]
    low = minimum(minimum(corners[0], corners[1]), minimum(corners[2], corners[3]))
    high = maximum(maximum(corners[0], corners[1]), maximum(corners[2], corners[3]))
    return Interval(low, high)


def square(a: Interval) -> Interval:
    """The squares of an interval: unlike `product(a, a)` it knows that both factors are one number."""
    if a.is_point:
        value = times(a.low, a.low)
        return Interval(value, value)
    low, high = times(a.low, a.low), times(a.high, a.high)
    nearest = maximum(maximum(a.low, times(-1.0, a.high)), 0.0)
    return Interval(times(nearest, nearest), maximum(low, high))


class Track(NamedTuple):
    """Bounds of one coordinate over a window: its values, its rate and its second derivative."""

    value: Interval
    rate: Interval
    bend: Interval


class Window(NamedTuple):
    """A piece of a path: polynomials per configuration coordinate in local time, valid on [0, width]."""

    coefficients: tuple[Polynomial, ...]
    width: Number

    def track(self, p: Polynomial) -> Track:
        """Bernstein bounds of the second derivative, and from them, by the mean value theorem, of the rest."""
        rate = derivative(p)
        bend = bounds(derivative(rate), self.width)
        rates = self.spread(rate[0], bend)
        return Track(self.spread(p[0], rates), rates, bend)

    def spread(self, start: Number, slope: Interval) -> Interval:
        """Values over the window of what begins at `start` and changes at a rate in `slope`."""
        if is_constant(self.width) and self.width == 0:
            return Interval(start, start)
        if slope.is_point:
            end = plus(start, times(slope.low, self.width))
            return Interval(minimum(start, end), maximum(start, end))
        low, high = (plus(start, times(extreme(rate, 0.0), self.width))
                     for extreme, rate in ((minimum, slope.low), (maximum, slope.high)))  # fmt: skip
        return Interval(low, high)

    def along(self, direction: Sequence[Number], origin: Sequence[Number]) -> Track:
        """Bounds of the coordinate direction . (x - origin). Projecting before bounding keeps them tight."""
        columns = zip(*self.coefficients, strict=True)
        p = [total([times(d, c) for d, c in zip(direction, column, strict=True)]) for column in columns]
        p[0] = total([times(d, plus(c[0], times(-1.0, o)))
                      for d, c, o in zip(direction, self.coefficients, origin, strict=True)])  # fmt: skip
        return self.track(tuple(p))
