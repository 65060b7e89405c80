"""Trains: the bounces of a ball on a plane that die out, infinitely many in finite time, in closed form.

With normal n, gravity g = g_t - g_n n, e_n and e_t, let after the first impact w be the normal velocity, u the slip and
m = v_t + alpha r (omega x n), so that v_t = (m + alpha u) / (1 + alpha). Flight number k lasts T_k = T_0 e_n^k,
T_0 = 2 w / g_n. An impact keeps m (the angular momentum about the contact) and turns u into -e_t u; a flight adds
g_t T_k to both. So m grows by g_t t throughout, u_(k+1) = -e_t (u_k + g_t T_k), and the sums of T_k, T_k^2 and u_k T_k
are geometric. None of them has a pole at e_t = -e_n, where the recurrence is resonant, nor at e_n = 0.
"""

from typing import Any, NamedTuple

import jax.numpy as jnp

from ._types import Number, Vector3
from ._vector import add, cross, dot, ratio, scale, subtract, times


class Start(NamedTuple):
    """A ball just after the first impact of a train, as the sums see it."""

    normal: Vector3
    rise: Number  # normal velocity, >= 0
    velocity: Vector3  # of the centre, along the surface
    slip: Vector3
    pivot: Number  # spin about the normal
    pull: Number  # gravity towards the surface, > 0 where there is a train
    along: Vector3  # gravity along the surface


class End(NamedTuple):
    """After some of the bounces, or all of them."""

    time: Number  # since the first impact
    shift: Vector3  # of the centre, along the surface
    rise: Number
    velocity: Vector3
    spin: Vector3


def start(velocity: Vector3, spin: Vector3, normal: Vector3, gravity: Vector3, radius: Number) -> Start:
    rise, pull = dot(normal, velocity), times(-1.0, dot(normal, gravity))
    tangential = subtract(velocity, scale(rise, normal))
    slip = subtract(tangential, scale(radius, cross(spin, normal)))
    return Start(normal, rise, tangential, slip, dot(normal, spin), pull, add(gravity, scale(pull, normal)))


def duration(first: Start, restitution: Number) -> Number:
    """How long all the bounces last, in s; infinite where they do not end."""
    return ratio(times(2.0, first.rise), times(first.pull, 1.0 - restitution), otherwise=jnp.inf)


def span(first: Start, time: Number) -> Number:
    """A bound of the way of the centre along the surface within `time`: no impact makes the slip larger."""
    slip, speed, pull = (jnp.sqrt(jnp.maximum(dot(x, x), 0.0)) for x in (first.slip, first.velocity, first.along))
    return time * (speed + 2.0 * slip + 2.0 * pull * time)


def summed(
    first: Start, restitution: Number, reversal: Number, inertia_ratio: Number, radius: Number, rolls: Any
) -> End:
    """After all of the bounces. Then the ball rolls, or, on a smooth surface, slides."""
    none = scale(0.0, first.slip)
    return _after(first, restitution, reversal, inertia_ratio, radius, rolls, 0.0, none)


def bounced(
    first: Start,
    restitution: Number,
    reversal: Number,
    inertia_ratio: Number,
    radius: Number,
    rolls: Any,
    count: Number,
) -> End:
    """After `count` more bounces."""
    shrunk, turned = restitution**count, _power(-reversal, count)
    first_flight = ratio(times(2.0, first.rise), first.pull)
    gain = times(times(-1.0, reversal), times(first_flight, _sum_of_products(restitution, -reversal, count)))
    slip = add(scale(turned, first.slip), scale(gain, first.along))
    return _after(first, restitution, reversal, inertia_ratio, radius, rolls, shrunk, slip)


def bounces_within(first: Start, restitution: Number, time: Number) -> Number:
    """How many bounces follow the first impact within `time`, a whole number."""
    left = 1.0 - ratio(time, duration(first, restitution))
    inside = (left > 0) & (restitution > 0)
    count = jnp.log(jnp.where(inside, left, 1.0)) / jnp.log(jnp.where(inside, restitution, 0.5))
    return jnp.where(inside, jnp.floor(count), 0.0)


def _after(first, restitution, reversal, inertia_ratio, radius, rolls, shrunk, slip) -> End:
    """`shrunk` is e_n^k and `slip` the slip after k bounces."""
    flight = ratio(times(2.0, first.rise), first.pull)
    time = ratio(times(flight, 1.0 - shrunk), 1.0 - restitution)
    squares = ratio(1.0 - shrunk * shrunk, 1.0 - restitution * restitution)  # of the durations, in units of T_0^2
    product = reversal * restitution
    # From the recurrence: sum_(j<k) e_n^j u_j.
    weighted = subtract(first.slip, scale(shrunk, slip))
    weighted = subtract(weighted, scale(product * flight * squares, first.along))
    weighted = scale(ratio(1.0, 1.0 + product), weighted)
    slipped = add(scale(flight, weighted), scale(0.5 * flight * flight * squares, first.along))
    moment = add(scale(1.0 + inertia_ratio, first.velocity), scale(-inertia_ratio, first.slip))
    shift = add(scale(time, moment), scale(0.5 * time * time, first.along))
    shift = scale(1.0 / (1.0 + inertia_ratio), add(shift, scale(inertia_ratio, slipped)))
    velocity = add(add(moment, scale(time, first.along)), scale(inertia_ratio, slip))
    velocity = scale(1.0 / (1.0 + inertia_ratio), velocity)
    # On a smooth surface the slip is what it is, and the centre moves as if there were no surface.
    free = add(scale(time, first.velocity), scale(0.5 * time * time, first.along))
    shift = tuple(jnp.where(rolls, a, b) for a, b in zip(shift, free, strict=True))
    sliding = add(first.velocity, scale(time, first.along))
    velocity = tuple(jnp.where(rolls, a, b) for a, b in zip(velocity, sliding, strict=True))
    before = subtract(first.velocity, first.slip)
    turning: Any = tuple(jnp.where(rolls, a, b) for a, b in zip(subtract(velocity, slip), before, strict=True))
    spin = add(scale(1.0 / radius, cross(first.normal, turning)), scale(first.pivot, first.normal))
    return End(time, shift, times(first.rise, shrunk), velocity, spin)  # pyright: ignore


def _power(base: Number, count: Number) -> Number:
    """base^count for a whole count and a base of either sign, with finite derivatives at base 0."""
    size = abs(base)
    known = size > 0
    value = jnp.where(known, jnp.where(known, size, 1.0) ** count, jnp.where(count == 0, 1.0, 0.0))
    return jnp.where((base < 0) & (count % 2 == 1), -value, value)


def _sum_of_products(a: Number, b: Number, count: Number) -> Number:
    """sum_(j<count) a^j b^(count-1-j), for a >= 0, also where a and b are close."""
    apart = abs(a - b) > 1e-3 * (abs(a) + abs(b))
    direct = ratio(_power(a, count) - _power(b, count), jnp.where(apart, a - b, 1.0))
    same = jnp.where(apart | (a <= 0) | (b <= 0), 0.0, 1.0)
    x = jnp.log(jnp.where(same > 0, a, 1.0)) - jnp.log(jnp.where(same > 0, b, 1.0))
    nearly = jnp.where(x == 0, count, jnp.expm1(count * x) / jnp.expm1(jnp.where(x == 0, 1.0, x)))
    return jnp.where(apart, direct, _power(b, count - 1.0) * nearly)
