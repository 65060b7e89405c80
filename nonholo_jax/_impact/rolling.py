"""A ball on a flat surface: it rolls, or slides against Coulomb friction f until it rolls, and meets other surfaces.

With the slip u = v_t - r omega x n, gravity g_t along the surface and g_n into it, friction accelerates the centre by
-f g_n u/|u| and leaves v_t + alpha r (omega x n), the angular momentum about the contact, alone. So
du/dt = g_t - F u/|u| with F = f g_n (1 + 1/alpha): on a level plane the slip decays along itself, at F, and the centre
slows down by f g_n. A ball without slip rolls where |g_t| <= F, that is f >= tan(theta) alpha / (1 + alpha); on a
steeper slope it begins to slide downhill.
"""

from typing import Any

import jax.numpy as jnp

from .._math import Number, Vector3, add, cross, dot, norm, plus, ratio, scale, subtract, where

NONE: Vector3 = (0.0, 0.0, 0.0)


def along_surface(normal: Vector3, a: Vector3) -> Vector3:
    """The part of a vector along a surface."""
    return subtract(a, scale(dot(a, normal), normal))


def rolling_spin(radius: Number, normal: Vector3, turning: Vector3, spin: Vector3) -> Vector3:
    """The spin of a ball that rolls at the velocity `turning` (less its slip, if it slips): (1.1) solved for the part
    along the surface. The part about the normal stays."""
    return add(scale(ratio(1.0, radius), cross(normal, turning)), scale(dot(normal, spin), normal))


def own_slip(radius: Number, normal: Vector3, velocity: Vector3, spin: Vector3) -> Vector3:
    """The velocity of the contact point along the surface; exactly zero where that is its rounding error."""
    tangential = along_surface(normal, velocity)
    slip = subtract(tangential, scale(radius, cross(spin, normal)))
    eps = float(jnp.finfo(jnp.result_type(*velocity)).eps)
    slips = norm(slip) > 64.0 * eps * (norm(tangential) + radius * norm(spin))
    return tuple(where(slips, u, 0.0) for u in slip)  # pyright: ignore


def heading(slip: Vector3, along: Vector3, most: Number) -> Vector3:
    """The direction against which friction acts: that of the slip, or, where gravity overcomes the friction of a ball
    that does not slip yet, of gravity. Zero for a ball that rolls. `most` is F."""
    slips = norm(slip) > 0
    slides = slips | (norm(along) > most)
    towards = tuple(jnp.where(slips, u, g) for u, g in zip(slip, along, strict=True))
    size = norm(towards)
    return tuple(jnp.where(slides, ratio(x, size), 0.0) for x in towards)  # pyright: ignore


def twist(radius: Number, pivot: Number, normal: Vector3, turn: Vector3) -> Vector3:
    """r (omega . n) n x dn/dt: how a spin about the normal drives the contact point of a ball aside whose normal turns.
    With it, on any surface, the slip changes by du/dt = g_t - twist - F u/|u|, and a ball that rolls has
    (1 + alpha) dv_t/dt = g_t + alpha twist, with d(omega . n)/dt = omega . dn/dt."""
    return scale(radius * pivot, cross(normal, turn))


def spin_loss(ball: Any, coefficient: Number, push: Number) -> Number:
    """What spinning friction takes of the spin about the normal in a second, for a push per mass."""
    return ratio(coefficient * push, ball.inertia_ratio * ball.radius)


def later_heading(slip: Vector3, known: Vector3) -> Vector3:
    """The direction of a slip within an arc that began with a `known` one. Beyond the end of the slip, which the arc
    will be cut at, the slip is mirrored there: a straight slide stays smooth, so that a solver may step over its end,
    and one that turns does not, so that it may not."""
    ahead = dot(known, slip)
    mirrored = add(slip, scale(jnp.where(ahead < 0, -2.0, 0.0) * ahead, known))
    size = norm(mirrored)
    return tuple(jnp.where(size > 0, ratio(u, size), k) for u, k in zip(mirrored, known, strict=True))  # pyright: ignore


def carried(normal: Vector3, known: Vector3) -> Vector3:
    """A direction along a surface that is kept, where the normal has become this one; zero if it was zero."""
    here = along_surface(normal, known)
    size = norm(here)
    return tuple(jnp.where(size > 0, ratio(u, size), 0.0) for u in here)  # pyright: ignore


def is_straight(known: Vector3, along: Vector3, pull: Number) -> Any:
    """Whether gravity along the surface leaves the direction of the slip as it is."""
    eps = float(jnp.finfo(jnp.result_type(*known)).eps)
    return (dot(known, known) == 0) | (_sideways(known, along) <= 64.0 * eps * abs(pull))


def decay(known: Vector3, along: Vector3, most: Number) -> Number:
    """The rate at which a slip of the direction `known` dies out, on average until its end, while g_t and F are
    constant. F|u| + g_t . u then changes at the rate g_t^2 - F^2, however the slip turns, so that it lasts
    (F|u| + g_t . u) / (F^2 - g_t^2)."""
    return ratio(most * most - dot(along, along), plus(most, dot(known, along)))


def lasts(known: Vector3, slip: Vector3, along: Vector3, most: Number) -> Number:
    """How long a slip lasts at that rate; infinite where there is none, or friction does not end it."""
    speed = norm(slip)
    ends = (speed > 0) & (most > norm(along))
    return where(ends, ratio(speed, decay(known, along, most), otherwise=jnp.inf), jnp.inf)


def ends_soon(
    known: Vector3,
    slip: Vector3,
    along: Vector3,
    most: Number,
    tolerance: float,
    change: Number = 0.0,
    least: Number = 0.0,
) -> Any:
    """Whether a slip is so near its end that it may go straight there, at the rate `decay`: friction and gravity change
    the velocity until then as they do along the true path, which a straight one misses by no more than `tolerance` (m).
    `change` is the part of both that may change in a second: that must be less than 10 `tolerance` (m/s). The direction
    of a slip settles at the rate |g_t| / |u|, which is faster than any explicit solver can follow: where friction
    hardly exceeds gravity, it would not come to the end without this. A slip that decays at the rate `least` or less
    may as well be one that has just begun."""
    speed, drive, left = norm(slip), norm(along), lasts(known, slip, along, most)
    aside = ratio(speed * _sideways(known, along), drive)
    left = where(jnp.isfinite(left), left, 0.0)
    near = (aside * left <= tolerance) & (left * left * change * (most + drive) <= 10.0 * tolerance)
    return (speed > least * left) & (most > drive) & near


def _sideways(known: Vector3, along: Vector3) -> Number:
    return norm(subtract(along, scale(dot(known, along), known)))


def gripped(
    radius: Number, inertia_ratio: Number, normal: Vector3, velocity: Vector3, spin: Vector3
) -> tuple[Vector3, Vector3]:
    """Velocity and spin of a ball whose slip has died out. What is left of it, rounding or the tolerance of a step, is
    stopped, and the angular momentum about the contact stays."""
    share = ratio(inertia_ratio, plus(1.0, inertia_ratio))
    velocity = subtract(velocity, scale(share, own_slip(radius, normal, velocity, spin)))
    return velocity, rolling_spin(radius, normal, velocity, spin)
