"""Trains: the bounces of a ball on a plane that die out, infinitely many in finite time, in closed form.

With normal n, gravity g = g_t - g_n n, e_n and e_t, let after the first impact w be the normal velocity, u the slip and
m = v_t + alpha r (omega x n), so that v_t = (m + alpha u) / (1 + alpha). Flight number k lasts T_k = T_0 e_n^k,
T_0 = 2 w / g_n. An impact keeps m (the angular momentum about the contact) and turns u into -e_t u; a flight adds
g_t T_k to both. So m grows by g_t t throughout, u_(k+1) = -e_t (u_k + g_t T_k), and the sums of T_k, T_k^2 and u_k T_k
are geometric. None of them has a pole at e_t = -e_n, where the recurrence is resonant, nor at e_n = 0.

Under Coulomb friction an impact that grips does the same, and one that slips takes f (1 + e_n) (1 + 1/alpha) w_k of the
slip, geometric too. Trains of one kind only are summed; where impacts of both kinds follow each other they are bounced.
"""

from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import lax

from .._math import Number, Vector3, add, cross, dot, norm, ratio, scale, shared, subtract, times


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


class Contact(NamedTuple):
    """What the sums need of a law and of the ball."""

    restitution: Number
    reversal: Number
    friction: Number | None  # infinite where the ball never slips; `None` if that is so on all surfaces
    rolls: Any  # False on a smooth surface
    inertia_ratio: Number
    radius: Number


def summed(first: Start, contact: Contact, slips: Any) -> End:
    """After all of the bounces: then the ball rolls, or slides. `slips` says that every impact slips."""
    none = scale(0.0, first.slip)
    return _after(first, contact, slips, 0.0, none)


def bounced(first: Start, contact: Contact, slips: Any, count: Number) -> End:
    """After `count` more bounces."""
    reversal = contact.reversal
    shrunk, turned = contact.restitution**count, _power(-reversal, count)
    first_flight = ratio(times(2.0, first.rise), first.pull)
    gain = times(times(-1.0, reversal), times(first_flight, _sum_of_products(contact.restitution, -reversal, count)))
    slip = add(scale(turned, first.slip), scale(gain, first.along))
    return _after(first, contact, slips, shrunk, slip)


def bounces_within(first: Start, restitution: Number, time: Number) -> Number:
    """How many bounces follow the first impact within `time`, a whole number."""
    left = 1.0 - ratio(time, duration(first, restitution))
    inside = (left > 0) & (restitution > 0)
    count = jnp.log(jnp.where(inside, left, 1.0)) / jnp.log(jnp.where(inside, restitution, 0.5))
    return jnp.where(inside, jnp.floor(count), 0.0)


def slips_throughout(first: Start, contact: Contact, tolerance: float) -> Any:
    """Whether every impact slips, in one direction (but for a change of velocity of `tolerance` in m/s). What friction
    has taken after k bounces, and what is left for it to need, are linear in e_n^k: two ends decide for all k."""
    assert contact.friction is not None
    speed = _speed(first)
    helped = ratio(dot(first.slip, first.along), speed)  # by gravity
    sideways = norm(subtract(first.along, scale(ratio(helped, speed), first.slip)))
    taken, lasts = _taken(first, contact), _lasts(first, contact)
    last = speed + helped * lasts - ratio(taken, 1.0 - contact.restitution)
    flight = ratio(times(2.0, first.rise), first.pull)
    begins = (1.0 + contact.reversal) * (speed + helped * flight) >= taken
    eps = float(jnp.finfo(jnp.result_type(*first.velocity)).eps)
    straight = sideways <= 64.0 * eps * first.pull
    straight = straight | (ratio(sideways * lasts, speed) * ratio(taken, 1.0 - contact.restitution) <= tolerance)
    return (first.rise <= 0) | (straight & (last > 0) & begins & (contact.restitution < 1))


def grips_throughout(first: Start, contact: Contact) -> Any:
    """Whether friction stops the slip at every impact. The slip there over the closing speed, s, goes over into
    -rho s + gained with rho = e_t / e_n, so that it stays on a segment: from s_0 to s_1, or, for rho < 0, to its limit.
    """
    rho = ratio(contact.reversal, contact.restitution)
    gained = scale(ratio(2.0, first.pull), first.along)
    start = add(scale(ratio(1.0, first.rise), first.slip), gained)
    other = tuple(jnp.where(rho < 0, ratio(g, 1.0 + rho, jnp.where(g == 0, 0.0, jnp.inf)), g - rho * s)
                  for g, s in zip(gained, start, strict=True))  # fmt: skip
    most = jnp.maximum(norm(start), norm(other))
    enough = (1.0 + contact.reversal) * most * first.rise <= _taken(first, contact)
    return (first.rise > 0) & (abs(rho) <= 1) & enough


def _speed(first: Start) -> Number:
    """The size of the slip; exactly zero where that is its rounding error, which a compiler may compute twice, as two
    numbers, so that a direction would be one divided by the other."""
    eps = float(jnp.finfo(jnp.result_type(*first.velocity)).eps)
    size, of = shared([norm(first.slip), norm(first.velocity) + norm(subtract(first.velocity, first.slip))])
    return jnp.where(size > 64.0 * eps * of, size, 0.0)


def _taken(first: Start, contact: Contact) -> Number:
    """What an impact at the velocity `rise` takes of the slip where friction is overcome."""
    friction = 0.0 if contact.friction is None else jnp.where(jnp.isinf(contact.friction), 0.0, contact.friction)
    return friction * (1.0 + contact.restitution) * (1.0 + 1.0 / contact.inertia_ratio) * first.rise


def _lasts(first: Start, contact: Contact) -> Number:
    """`duration`, but a harmless number where the bounces do not end."""
    return ratio(times(2.0, first.rise), times(first.pull, 1.0 - contact.restitution))


def _after(first: Start, contact: Contact, slips: Any, shrunk: Number, slip: Vector3) -> End:
    """`shrunk` is e_n^k, and `slip` the slip after k bounces that all grip."""
    restitution, reversal, _, rolls, inertia_ratio, radius = contact
    flight = ratio(times(2.0, first.rise), first.pull)
    time = ratio(times(flight, 1.0 - shrunk), 1.0 - restitution)
    squares = ratio(1.0 - shrunk * shrunk, 1.0 - restitution * restitution)  # of the durations, in units of T_0^2
    product = reversal * restitution
    # From the recurrence: sum_(j<k) e_n^j u_j.
    weighted = subtract(first.slip, scale(shrunk, slip))
    weighted = subtract(weighted, scale(product * flight * squares, first.along))
    weighted = scale(ratio(1.0, 1.0 + product), weighted)
    if contact.friction is not None:  # slipping, u_k = u_0 + change (1 - e_n^k)
        loss = _taken(first, contact) * ratio(1.0, 1.0 - restitution)
        change = scale(_lasts(first, contact), first.along)
        change = subtract(change, scale(ratio(loss, _speed(first)), first.slip))
        sums = ratio(1.0 - shrunk, 1.0 - restitution)
        slipping = add(scale(sums, first.slip), scale(sums - squares, change))
        weighted = tuple(jnp.where(slips, a, b) for a, b in zip(slipping, weighted, strict=True))
        slipping = add(first.slip, scale(1.0 - shrunk, change))
        slip = tuple(jnp.where(slips, a, b) for a, b in zip(slipping, slip, strict=True))  # pyright: ignore
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
    is_odd = lax.rem(abs(count), jnp.full_like(count, 2.0)) == 1
    return jnp.where((base < 0) & is_odd, -value, value)


def _sum_of_products(a: Number, b: Number, count: Number) -> Number:
    """sum_(j<count) a^j b^(count-1-j), for a >= 0, also where a and b are close."""
    apart = abs(a - b) > 1e-3 * (abs(a) + abs(b))
    direct = ratio(_power(a, count) - _power(b, count), jnp.where(apart, a - b, 1.0))
    same = jnp.where(apart | (a <= 0) | (b <= 0), 0.0, 1.0)
    x = jnp.log(jnp.where(same > 0, a, 1.0)) - jnp.log(jnp.where(same > 0, b, 1.0))
    nearly = jnp.where(x == 0, count, jnp.expm1(count * x) / jnp.expm1(jnp.where(x == 0, 1.0, x)))
    return jnp.where(apart, direct, _power(b, count - 1.0) * nearly)
