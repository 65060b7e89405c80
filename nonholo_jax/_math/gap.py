"""A gap that is any smooth function of the configuration, and bounds of its second derivative along a path."""

import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp

from .bounds import Unbounded, course_of, is_boundable
from .courses import Course
from .polynomial import Interval, Window, evaluate
from .types import Number
from .vector import components, is_constant, maximum, minimum, norm, plus, ratio, slope, times, where

_SAMPLES = (0.0, 0.25, 0.5, 0.75, 1.0)
BLIND = -1e30  # a lower bound of the second derivative where there is none
_FAR = 1e12  # no window is longer


def value_of(gap: Callable, x: Sequence[Number]) -> Any:
    """The gap at a point given by its scalars."""
    dtype = jnp.result_type(*[c for c in x if not is_constant(c)] or [float])
    return gap(jnp.stack([jnp.asarray(c, dtype=dtype) for c in x]))


def gradient_of(gap: Callable, x: Sequence[Number]) -> tuple:
    """The gradient of the gap at a point given by its scalars."""
    return components(jax.grad(gap)(jnp.stack([jnp.asarray(c) for c in x])))


def reach_of(curvature: Number | None) -> Number | None:
    """A length over which a gap with that bound of its second derivative bends by one; `None` if that is unknown: one
    look at the whole path then often says that it is free, and if not, how far to look."""
    return None if curvature is None else ratio(1.0, curvature, otherwise=_FAR)


def is_bounded(gap: Callable, curvature: Number | None, n: int) -> bool:
    """Whether `bend_of` gives true bounds of a gap of n coordinates."""
    if curvature is not None:
        return True
    leaves, structure = jax.tree.flatten(gap)
    kinds = tuple(
        jax.ShapeDtypeStruct(leaf.shape, leaf.dtype) if isinstance(leaf, jax.Array) else leaf for leaf in leaves
    )
    try:
        return _is_boundable(structure, kinds, n)
    except TypeError:  # something in the gap has no hash
        return is_boundable(gap, n)


@functools.lru_cache(maxsize=64)
def _is_boundable(structure: Any, kinds: tuple, n: int) -> bool:
    """The answer goes by the program alone, not by the numbers in it; whoever runs a scene asks often."""
    leaves = [jnp.zeros(x.shape, x.dtype) if isinstance(x, jax.ShapeDtypeStruct) else x for x in kinds]
    return is_boundable(jax.tree.unflatten(structure, leaves), n)


def bend_of(gap: Callable, curvature: Number | None, window: Window) -> Interval:
    """Bounds of the second derivative of the gap along the path in the window: true ones if `curvature` bounds the
    norm of the gap's second derivative, or its program can be bounded, and estimates from samples otherwise."""
    if curvature is None:
        try:
            return _safe(course_of(gap, window), window)
        except Unbounded:
            return _sampled(gap, window)
    start = tuple(p[0] for p in window.coefficients)
    along = window.along(gradient_of(gap, start), start).bend
    if is_constant(curvature) and curvature == 0:
        return along
    tracks = [window.track(p) for p in window.coefficients]
    fastest = norm([maximum(abs(track.rate.low), abs(track.rate.high)) for track in tracks])
    hardest = norm([maximum(abs(track.bend.low), abs(track.bend.high)) for track in tracks])
    # v . H v, and what the gradient can turn by within the window, times the acceleration.
    margin = plus(times(curvature, fastest * fastest), times(times(curvature, times(fastest, window.width)), hardest))
    return Interval(along.low - margin, along.high + margin)


def _safe(course: Course, window: Window) -> Interval:
    """Bounds of the second derivative, the lower one raised to where the values and rates alone say as much: the
    parabola with it has its first zero no later than the gap, which is all that a search asks of it. Without any bound
    the lower one is `BLIND`."""
    tiny = float(jnp.finfo(course.start.dtype).tiny) ** 0.5
    width, steepest = jnp.asarray(window.width, course.start.dtype), jnp.minimum(course.rate.low, 0.0)
    start = jnp.maximum(course.start, 0.0)
    reached = where(steepest < 0, start / where(steepest < 0, -steepest, 1.0), jnp.inf)
    free = (course.value.low > 0) | (reached >= width)
    zero = jnp.maximum(where(free, 1.001 * width, reached), tiny)
    ahead = start + course.pace * zero  # of where that rate alone would bring it; less only by rounding
    first = -2.0 * where(free, ahead, jnp.maximum(ahead, 0.0)) / (zero * zero)
    # At a gap of zero, unless it moves off, nothing but its own bend says whether it closes.
    known = (free & (course.pace != 0)) | (start > 0)
    low = jnp.maximum(course.bend.low, where(jnp.isnan(first) | ~known, -jnp.inf, first))
    most = jnp.maximum(jnp.abs(course.bend.low), jnp.abs(course.bend.high))
    return Interval(jnp.clip(low, BLIND, -BLIND), jnp.minimum(most, -BLIND))


def _sampled(gap: Callable, window: Window) -> Interval:
    """Five samples, with their spread as margin."""
    along = lambda s: value_of(gap, tuple(evaluate(p, s) for p in window.coefficients))  # noqa: E731
    rate = lambda s: slope(lambda z: along(z[0]), (s,), (1.0,))[1]  # noqa: E731
    like = jnp.asarray(window.width)
    samples = [slope(lambda z: rate(z[0]), (c * like,), (1.0,))[1] for c in _SAMPLES]
    low, high = samples[0], samples[0]
    for sample in samples[1:]:
        low, high = minimum(low, sample), maximum(high, sample)
    return Interval(low - (high - low), high + (high - low))
