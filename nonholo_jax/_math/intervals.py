"""Intervals: sums and products of them, and the values of elementary functions over them.

An endpoint may be infinite: nothing is known on that side then. Rounding is up to the caller (see `widened`).
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jax.scipy.special import erf, erfc

from .polynomial import Interval

_ROUNDINGS = 16.0  # by how many eps of the larger end an interval is widened


class Values(NamedTuple):
    """A function over an interval: its values, its slopes and its second derivatives."""

    value: Interval
    slope: Interval
    bend: Interval


def everything(like: Any) -> Interval:
    return Interval(jnp.full_like(like, -jnp.inf), jnp.full_like(like, jnp.inf))


def point(x: Any) -> Interval:
    return Interval(x, x)


def hull(a: Interval, b: Interval) -> Interval:
    return Interval(jnp.minimum(a.low, b.low), jnp.maximum(a.high, b.high))


def meet(a: Interval, b: Interval) -> Interval:
    return Interval(jnp.maximum(a.low, b.low), jnp.minimum(a.high, b.high))


def plus_each(*terms: Interval) -> Interval:
    low, high = terms[0]
    for term in terms[1:]:
        low, high = low + term.low, high + term.high
    return Interval(low, high)


def negative(a: Interval) -> Interval:
    return Interval(-a.high, -a.low)


def greatest(a: Interval) -> Any:
    """The greatest size of a number of the interval."""
    return jnp.maximum(jnp.abs(a.low), jnp.abs(a.high))


def widened(a: Interval) -> Interval:
    """The interval with what rounding may have cut off."""
    margin = _ROUNDINGS * float(jnp.finfo(jnp.result_type(a.low)).eps) * greatest(a)
    margin = jnp.where(jnp.isfinite(margin), margin, 0.0)
    return Interval(a.low - margin, a.high + margin)


def chosen(condition: Any, a: Interval, b: Interval) -> Interval:
    return Interval(jnp.where(condition, a.low, b.low), jnp.where(condition, a.high, b.high))


def by_sign(known: float | None, c: Any, a: Interval) -> Interval:
    """c a, for a number c whose sign may be known when the program is traced."""
    low, high = _product(c, a.low), _product(c, a.high)
    if known is None:
        return Interval(jnp.minimum(low, high), jnp.maximum(low, high))
    return Interval(low, high) if known >= 0 else Interval(high, low)


def _product(a: Any, b: Any) -> Any:
    """a b, where nothing times infinity is nothing: an end of an interval is never reached there."""
    return jnp.where((a == 0) | (b == 0), 0.0, a * b)


def product_of(a: Interval, b: Interval) -> Interval:
    corners = [_product(x, y) for x in a for y in b]
    low = jnp.minimum(jnp.minimum(corners[0], corners[1]), jnp.minimum(corners[2], corners[3]))
    high = jnp.maximum(jnp.maximum(corners[0], corners[1]), jnp.maximum(corners[2], corners[3]))
    return Interval(low, high)


def weighed(weight: Interval, a: Interval) -> Interval:
    """The product with an interval that holds no negative number, as that of a square."""
    low = jnp.minimum(_product(weight.low, a.low), _product(weight.high, a.low))
    high = jnp.maximum(_product(weight.low, a.high), _product(weight.high, a.high))
    return Interval(low, high)


def reciprocal(a: Interval) -> Interval:
    across = (a.low < 0) & (a.high > 0)
    low = jnp.where(across | (a.high == 0), -jnp.inf, 1.0 / a.high)
    high = jnp.where(across | (a.low == 0), jnp.inf, 1.0 / a.low)
    return Interval(low, high)


def whole_power(a: Interval, n: int) -> Interval:
    """a^n for a whole number n."""
    if n < 0:
        return reciprocal(whole_power(a, -n))
    if n == 0:
        return point(jnp.ones_like(a.low))
    low, high = (lax.integer_pow(x, n) for x in a)
    if n % 2:
        return Interval(low, high)
    least = jnp.where((a.low <= 0) & (a.high >= 0), 0.0, jnp.minimum(low, high))
    return Interval(least, jnp.maximum(low, high))


def real_power(a: Interval, p: Any) -> Interval:
    """a^p for a number p; unknown where a may be negative."""
    ends = [jnp.power(jnp.maximum(x, 0.0), p) for x in a]
    inside = Interval(jnp.minimum(*ends), jnp.maximum(*ends))
    return chosen(a.low < 0, everything(a.low), inside)


# Elementary functions


def _rising(function: Callable, a: Interval) -> Interval:
    return Interval(function(a.low), function(a.high))


def _times(c: Any, a: Interval) -> Interval:
    return by_sign(c, c, a)


def _above(a: Interval, least: float) -> Interval:
    """The part of the interval where a function is defined; a NaN elsewhere would be no bound."""
    return Interval(jnp.maximum(a.low, least), jnp.maximum(a.high, least))


def whole_power_of(a: Interval, n: int) -> Values:
    slope, bend = (whole_power(a, max(n - k, 0) if n >= 0 else n - k) for k in (1, 2))
    if n < 0:  # at the pole it jumps from one end to the other
        pole = (a.low <= 0) & (a.high >= 0)
        slope, bend = (chosen(pole, everything(a.low), x) for x in (slope, bend))
    return Values(whole_power(a, n), _times(float(n), slope), _times(float(n * (n - 1)), bend))


def real_power_of(a: Interval, p: Any) -> Values:
    slope, bend = by_sign(None, p, real_power(a, p - 1)), by_sign(None, p * (p - 1), real_power(a, p - 2))
    return Values(real_power(a, p), slope, bend)


def _exp(a: Interval) -> Values:
    e = _rising(jnp.exp, a)
    return Values(e, e, e)


def _exp2(a: Interval) -> Values:
    e, c = _rising(jnp.exp2, a), math.log(2.0)
    return Values(e, _times(c, e), _times(c * c, e))


def _expm1(a: Interval) -> Values:
    e = _rising(jnp.exp, a)
    return Values(_rising(jnp.expm1, a), e, e)


def _log(a: Interval) -> Values:
    a = _above(a, 0.0)
    r = reciprocal(a)
    return Values(_rising(jnp.log, a), r, negative(whole_power(r, 2)))


def _log2(a: Interval) -> Values:
    return Values(*[_times(1.0 / math.log(2.0), part) for part in _log(a)])


def _log1p(a: Interval) -> Values:
    a = _above(a, -1.0)
    r = reciprocal(Interval(1.0 + a.low, 1.0 + a.high))
    return Values(_rising(jnp.log1p, a), r, negative(whole_power(r, 2)))


def _sqrt(a: Interval) -> Values:
    a = _above(a, 0.0)
    root = _rising(jnp.sqrt, a)
    r = reciprocal(root)
    return Values(root, _times(0.5, r), _times(-0.25, whole_power(r, 3)))


def _rsqrt(a: Interval) -> Values:
    r = reciprocal(_rising(jnp.sqrt, _above(a, 0.0)))
    return Values(r, _times(-0.5, whole_power(r, 3)), _times(0.75, whole_power(r, 5)))


def _cbrt(a: Interval) -> Values:
    root = _rising(jnp.cbrt, a)
    r = reciprocal(root)
    return Values(root, _times(1.0 / 3.0, whole_power(r, 2)), _times(-2.0 / 9.0, whole_power(r, 5)))


def sine_of(a: Interval, start: Any, sine: Any, cosine: Any) -> Values:
    """The sine, from what it and the cosine are at one number of the interval: two evaluations instead of six."""
    off = Interval(a.low - start, a.high - start)
    sines, cosines = _wave(sine, cosine, off), _wave(cosine, -sine, off)
    return Values(sines, cosines, negative(sines))


def _wave(value: Any, slope: Any, off: Interval) -> Interval:
    """Values of a sine or cosine, which has that value and slope somewhere, so far off: Taylor's formula."""
    square, farthest = whole_power(off, 2), greatest(off)
    rest = farthest * farthest * farthest / 6.0
    first, second = by_sign(None, slope, off), by_sign(None, -0.5 * value, square)
    low = value + first.low + second.low - rest
    high = value + first.high + second.high + rest
    near = farthest < 4.0  # NaN and infinity are not
    return Interval(jnp.where(near, jnp.maximum(low, -1.0), -1.0), jnp.where(near, jnp.minimum(high, 1.0), 1.0))


def _tan(a: Interval) -> Values:
    whole = jnp.floor(a.low / math.pi + 0.5) == jnp.floor(a.high / math.pi + 0.5)
    tangent = chosen(whole & jnp.isfinite(a.low), _rising(jnp.tan, a), everything(a.low))
    square = whole_power(tangent, 2)
    slope = Interval(jnp.where(jnp.isfinite(tangent.low), 1.0 + square.low, -jnp.inf), 1.0 + square.high)
    return Values(tangent, slope, _times(2.0, product_of(slope, tangent)))


def _tanh(a: Interval) -> Values:
    tangent = _rising(jnp.tanh, a)
    square = whole_power(tangent, 2)
    slope = Interval(1.0 - square.high, 1.0 - square.low)
    return Values(tangent, slope, _times(-2.0, weighed(slope, tangent)))


def _logistic(a: Interval) -> Values:
    s, mirrored = _rising(jax.nn.sigmoid, a), _rising(jax.nn.sigmoid, negative(a))
    ends = s.low * mirrored.high, s.high * mirrored.low
    most = jnp.where((a.low <= 0) & (a.high >= 0), 0.25, jnp.maximum(*ends))
    slope = Interval(jnp.minimum(*ends), most)
    lean = Interval(mirrored.low - s.high, mirrored.high - s.low)
    return Values(s, slope, weighed(slope, lean))


def softplus_of(a: Interval) -> Values:
    """log(1 + exp(a))."""
    s = _logistic(a)
    return Values(_rising(jax.nn.softplus, a), s.value, s.slope)


def _erf(a: Interval) -> Values:
    square = whole_power(a, 2)
    bell = Interval(jnp.exp(-square.high), jnp.exp(-square.low))
    slope = _times(2.0 / math.sqrt(math.pi), bell)
    return Values(_rising(erf, a), slope, _times(-2.0, weighed(slope, a)))


def _erfc(a: Interval) -> Values:
    value, slope, bend = _erf(a)
    return Values(Interval(erfc(a.high), erfc(a.low)), negative(slope), negative(bend))


def _atan(a: Interval) -> Values:
    square = whole_power(a, 2)
    slope = reciprocal(Interval(1.0 + square.low, 1.0 + square.high))
    return Values(_rising(jnp.arctan, a), slope, _times(-2.0, weighed(whole_power(slope, 2), a)))


def _asin(a: Interval) -> Values:
    a = Interval(jnp.clip(a.low, -1.0, 1.0), jnp.clip(a.high, -1.0, 1.0))
    square = whole_power(a, 2)
    slope = reciprocal(_rising(jnp.sqrt, Interval(1.0 - square.high, 1.0 - square.low)))
    return Values(_rising(jnp.arcsin, a), slope, weighed(whole_power(slope, 3), a))


def _acos(a: Interval) -> Values:
    value, slope, bend = _asin(a)
    return Values(Interval(jnp.pi / 2 - value.high, jnp.pi / 2 - value.low), negative(slope), negative(bend))


def _sinh(a: Interval) -> Values:
    sine, cosine = _rising(jnp.sinh, a), _cosh_over(a)
    return Values(sine, cosine, sine)


def _cosh(a: Interval) -> Values:
    sine, cosine = _rising(jnp.sinh, a), _cosh_over(a)
    return Values(cosine, sine, cosine)


def _cosh_over(a: Interval) -> Interval:
    ends = [jnp.cosh(x) for x in a]
    least = jnp.where((a.low <= 0) & (a.high >= 0), 1.0, jnp.minimum(*ends))
    return Interval(least, jnp.maximum(*ends))


def _asinh(a: Interval) -> Values:
    square = whole_power(a, 2)
    slope = reciprocal(_rising(jnp.sqrt, Interval(1.0 + square.low, 1.0 + square.high)))
    return Values(_rising(jnp.arcsinh, a), slope, negative(weighed(whole_power(slope, 3), a)))


SMOOTH: dict[str, Callable[[Interval], Values]] = {
    "exp": _exp, "exp2": _exp2, "expm1": _expm1, "log": _log, "log2": _log2, "log1p": _log1p, "sqrt": _sqrt,
    "rsqrt": _rsqrt, "cbrt": _cbrt, "tan": _tan, "tanh": _tanh, "logistic": _logistic, "erf": _erf, "erfc": _erfc,
    "atan": _atan, "asin": _asin, "acos": _acos, "sinh": _sinh, "cosh": _cosh, "asinh": _asinh,
}  # fmt: skip
"""Elementary functions by the names of JAX's primitives."""
