"""A gap that is any smooth function of the configuration, and bounds of its second derivative along a path."""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp

from .polynomial import Interval, Window, evaluate
from .types import Number
from .vector import components, is_constant, maximum, minimum, norm, plus, ratio, slope, times

_SAMPLES = (0.0, 0.25, 0.5, 0.75, 1.0)
_FAR = 1e12  # no window is longer


def value_of(gap: Callable, x: Sequence[Number]) -> Any:
    """The gap at a point given by its scalars."""
    dtype = jnp.result_type(*[c for c in x if not is_constant(c)] or [float])
    return gap(jnp.stack([jnp.asarray(c, dtype=dtype) for c in x]))


def gradient_of(gap: Callable, x: Sequence[Number]) -> tuple:
    """The gradient of the gap at a point given by its scalars."""
    return components(jax.grad(gap)(jnp.stack([jnp.asarray(c) for c in x])))


def reach_of(curvature: Number | None) -> Number:
    """A length over which a gap with that bound of its second derivative (`None` if unknown) bends by one."""
    return _FAR if curvature is None else ratio(1.0, curvature, otherwise=_FAR)


def bend_of(gap: Callable, curvature: Number | None, window: Window) -> Interval:
    """Bounds of the second derivative of the gap along the path in the window: true ones if `curvature` bounds the
    norm of the gap's second derivative, and estimates from samples without it."""
    if curvature is None:
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
