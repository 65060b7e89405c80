"""What must be so of a ball in flight and at an impact, written from the formulas; it shares no code with the library.

Vectors are arrays whose first axis is x, y, z; energy, momentum and impulse are per unit of mass. Figures are computed
in float64, in roundings: eps of the dtype of the throw, times the sum of the lengths or speeds that take part.
"""

import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp

TIMES = 8  # of every arc, both ends among them
SEVERAL = 1024.0  # roundings of the second smallest gap, up to which an impact counts as one on several surfaces
NEVER = 1e30  # the doubt after an impact on several surfaces
# What is looked at, and how many roundings it may be off.
BOUNDS = {
    "flight: place off the parabola": 64.0,
    "flight: energy": 64.0,
    "flight: gap below zero": 64.0,
    "impact: velocity, spin off the law": 64.0,
    "impact: energy off the law": 64.0,
    "impact: energy gained": 64.0,
    "impact: momentum about contact": 64.0,
    "impact: gap where it happens": 64.0,
    "end: whole throw off its steps": 64.0,
}


class Solid(NamedTuple):
    """A half-space, with a point and a normal, or a box along the axes, with a centre and half sizes."""

    place: tuple
    normal: tuple | None
    half: tuple | None


class Ball(NamedTuple):
    """Coefficients of normal and of tangential restitution, J/(m r^2), and radius."""

    restitution: Any
    tangential: Any
    alpha: Any
    radius: Any


class Moment(NamedTuple):
    place: Any
    velocity: Any
    spin: Any


class Arc(NamedTuple):
    """A flight from one moment to another, seconds later; `struck`: at the first moment it meets a surface, and the
    flight begins with an impact; `strikes`: at the second one it meets another."""

    begin: Moment
    end: Moment
    seconds: Any
    struck: Any
    strikes: Any


class Doubt(NamedTuple):
    """How far two computations of one throw may be apart, by first order, in roundings: in m at one time, in m/s, and
    in s where it meets a surface."""

    place: Any
    velocity: Any
    late: Any


class Found(NamedTuple):
    figures: Any  # in the order of BOUNDS, without the last
    corner: Any
    open: Any  # rounding decides whether there is one more impact at the end
    doubt: Doubt


def dot(a: Any, b: Any) -> Any:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def cross(a: Any, b: Any) -> Any:
    return jnp.stack([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


def size(a: Any) -> Any:
    return jnp.sqrt(dot(a, a))


def gap_and_normal(solid: Solid, x: Any, radius: Any) -> tuple[Any, Any]:
    """Of a ball at x: how far its skin is away, and the direction from the surface to it."""
    away = jnp.stack([x[k] - solid.place[k] for k in range(3)])
    if solid.normal is not None:
        normal = jnp.stack([jnp.full_like(x[0], c) for c in solid.normal])
        return sum(c * away[k] for k, c in enumerate(solid.normal) if c != 0) - radius, normal
    assert solid.half is not None
    beyond = jnp.stack([away[k] - jnp.clip(away[k], -solid.half[k], solid.half[k]) for k in range(3)])
    distance = size(beyond)
    return distance - radius, beyond / jnp.where(distance > 0, distance, 1.0)[None]


def nearest(solids: Sequence[Solid], x: Any, radius: Any) -> tuple[Any, Any, Any]:
    """The smallest gap, its normal, and the second smallest gap."""
    gap, normal = gap_and_normal(solids[0], x, radius)
    second = jnp.full_like(gap, jnp.inf)
    for solid in solids[1:]:
        other, direction = gap_and_normal(solid, x, radius)
        closer = other < gap
        second = jnp.where(closer, gap, jnp.minimum(second, other))
        gap, normal = jnp.where(closer, other, gap), jnp.where(closer[None], direction, normal)
    return gap, normal, second


def struck(ball: Ball, n: Any, before: Moment) -> tuple[Moment, Any, Any]:
    """After an impact on a rough surface with the normal n: the contact point's velocity u is reversed, its normal part
    by e_n and the rest by e_t, by an impulse J at the contact, which feels the ball's mass along n and
    alpha / (1 + alpha) of it across. And what the slip and the normal velocity were."""
    arm = -ball.radius * n  # from the centre to the contact
    u = before.velocity + cross(before.spin, arm)
    closing = dot(u, n)
    slip = u - closing[None] * n
    impulse = -(1.0 + ball.restitution) * closing[None] * n
    impulse -= (1.0 + ball.tangential) * ball.alpha / (1.0 + ball.alpha) * slip
    turned = cross(arm, impulse) / (ball.alpha * ball.radius**2)
    return Moment(before.place, before.velocity + impulse, before.spin + turned), closing, slip


def kinetic(ball: Ball, v: Any, w: Any) -> Any:
    return 0.5 * dot(v, v) + 0.5 * ball.alpha * ball.radius**2 * dot(w, w)


class Sizes(NamedTuple):
    """What one rounding is a part of: lengths, speeds and squares of speeds."""

    place: Any
    speed: Any
    square: Any


def sizes_of(arc: Arc, left_with: Any, closing: Any, round_: Any, pull: Any, radius: Any) -> Sizes:
    """A rounding of the place makes an impact late, by more the slower it comes; with that, and round an edge with the
    normal, the velocity and the way from there on change."""
    begin, end, t = arc.begin, arc.end, arc.seconds
    speed = size(begin.velocity) + size(left_with) + t * pull + radius * (size(begin.spin) + size(end.spin))
    length = size(begin.place) + size(end.place) + 1.0 + t * speed
    late = jnp.where(arc.struck, length / jnp.abs(closing), 0.0)
    turned = jnp.where(round_, (length + late * speed) / radius, 0.0)
    speeds = speed * (1.0 + turned) + late * pull
    places = length + late * size(left_with - begin.velocity)
    return Sizes(places, speeds, speeds * speed + places * pull)


def judged(solids: Sequence[Solid], ball: Ball, gravity: tuple, arc: Arc, doubt: Doubt, eps: float) -> Found:
    """All figures of one arc and of the impact that it begins with."""
    begin, end, t = arc.begin, arc.end, arc.seconds
    g = jnp.stack([jnp.full_like(t, c) for c in gravity])
    left_with = end.velocity - t[None] * g  # the flight, followed back from its end; its spin is that at the end
    _, n, second = nearest(solids, begin.place, ball.radius)
    after, closing, slip = struck(ball, n, begin)
    round_ = arc.struck & (jnp.max(jnp.abs(n), axis=0) < 1.0)  # at an edge
    sizes = sizes_of(arc, left_with, closing, round_, size(g), ball.radius)
    corner = arc.struck & (second <= SEVERAL * eps * sizes.place)
    touching, facing, _ = nearest(solids, end.place, ball.radius)
    figures = [
        *flown(solids, ball.radius, g, arc, left_with, sizes),
        *bounced(ball, n, arc, Moment(begin.place, left_with, end.spin), (after, closing, slip), corner, sizes),
        jnp.where(arc.strikes, jnp.abs(touching), 0.0) / sizes.place,
    ]
    figures = jnp.maximum(jnp.stack(figures), 0.0) / eps
    next_doubt = grown(doubt, arc, left_with, (round_, ball.radius), dot(end.velocity, facing), size(g))
    next_doubt = Doubt(*(jnp.where(corner, NEVER, x) for x in next_doubt))
    allowed = BOUNDS["end: whole throw off its steps"] * eps
    just = (arc.struck & (t <= allowed * doubt.late)) | (jnp.abs(touching) <= allowed * next_doubt.place)
    return Found(figures, corner, ~arc.strikes & just, next_doubt)


def flown(solids: Sequence[Solid], radius: Any, g: Any, arc: Arc, left_with: Any, sizes: Sizes) -> list:
    """Of the flight: how far it ends from the parabola, energy gained or lost, how deep it goes into something."""
    begin, end, t = arc.begin, arc.end, arc.seconds
    off = size(end.place - begin.place - 0.5 * t[None] * (left_with + end.velocity))
    drift = 0.5 * dot(end.velocity, end.velocity) - 0.5 * dot(left_with, left_with) - dot(g, end.place - begin.place)
    s = jnp.linspace(0.0, 1.0, TIMES)[:, None] * t[None]
    way = begin.place[:, None] + s[None] * left_with[:, None] + (0.5 * s**2)[None] * g[:, None]
    gaps = functools.reduce(jnp.minimum, [gap_and_normal(solid, way, radius)[0] for solid in solids])
    return [off / sizes.place, jnp.abs(drift) / sizes.square, -jnp.min(gaps, axis=0) / sizes.place]


def bounced(ball: Ball, n: Any, arc: Arc, found: Moment, by_law: tuple, corner: Any, sizes: Sizes) -> list:
    """Of the impact, or of the launch: how far the velocity is from what it should be, the energy from what is lost,
    what is gained, and what the angular momentum about the contact has changed by. Of an impact on several surfaces,
    only whether energy is gained."""
    (after, closing, slip), begin, alpha, r = by_law, arc.begin, ball.alpha, ball.radius
    single = arc.struck & ~corner
    velocity, spin = (jnp.where(single[None], a, b) for a, b in zip(after[1:], begin[1:], strict=True))
    wrong = jnp.maximum(size(found.velocity - velocity), r * size(found.spin - spin))
    change = kinetic(ball, found.velocity, found.spin) - kinetic(ball, begin.velocity, begin.spin)
    lost = 0.5 * (1.0 - ball.restitution**2) * closing**2
    lost += 0.5 * (1.0 - ball.tangential**2) * alpha / (1.0 + alpha) * dot(slip, slip)
    momentum = r * cross(n, found.velocity - begin.velocity) + alpha * r**2 * (found.spin - begin.spin)
    return [
        jnp.where(corner, 0.0, wrong) / sizes.speed,
        jnp.where(single, jnp.abs(change + lost), 0.0) / sizes.square,
        jnp.where(arc.struck, change, 0.0) / sizes.square,
        jnp.where(single, size(momentum), 0.0) / (r * sizes.speed),
    ]


def grown(doubt: Doubt, arc: Arc, left_with: Any, edge: tuple, closing: Any, pull: Any) -> Doubt:
    """The doubt after one more arc, as `sizes_of` explains it."""
    round_, radius = edge
    sizes = sizes_of(arc, left_with, jnp.inf, round_, pull, radius)
    late, speed = jnp.where(arc.struck, doubt.late, 0.0), sizes.speed
    turned = jnp.where(round_, 4.0 * speed / radius * (doubt.place + late * speed), 0.0)
    velocity = doubt.velocity + 4.0 * late * pull + turned + speed
    place = doubt.place + late * size(left_with - arc.begin.velocity) + arc.seconds * velocity + sizes.place
    return Doubt(place, velocity, jnp.where(arc.strikes, place / jnp.abs(closing), 0.0) + arc.seconds)


def ends_apart(a: Moment, b: Moment, late: Any, ball: Ball, doubt: Doubt, pull: float, eps: float) -> Any:
    """How far apart two ends of one throw are, the second late by some seconds, in units of the doubt."""
    speed = size(a.velocity) + size(b.velocity)
    place = size(a.place - b.place) / (doubt.place + doubt.late * speed)
    velocity = jnp.maximum(size(a.velocity - b.velocity), ball.radius * size(a.spin - b.spin))
    velocity = velocity / (doubt.velocity + doubt.late * pull)
    time = jnp.where(doubt.late > 0, jnp.abs(late) / doubt.late, 0.0)
    return jnp.maximum(jnp.maximum(place, velocity), time) / eps
