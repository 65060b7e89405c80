"""A ball that touches two surfaces at once and goes along the groove between them.

With the normals n1 and n2, c = |n1 x n2| and e = (n1 x n2) / c, the velocity is w e. A ball that slips at neither
contact has v = r omega x n1 = r omega x n2, so that omega = w (n1 - n2) / (r c). One that slips at the second alone has
omega = w (n1 x e) / r + pivot n1; its slip there is along e. One that slips at both has any spin.

Without friction against a slip, Kane's equations, with G = diag(1, alpha r^2) and the rates of these directions, give
dw/dt and dpivot/dt. The torque gives the forces along the surfaces, but for the share of those across the groove, of
which each contact takes the same; the rest of the acceleration gives the two pushes. With friction, the forces along
the surfaces are linear in the two pushes, for which the two normals give two equations.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from .._math import (
    Number,
    Vector3,
    add,
    cross,
    dot,
    frozen,
    minimum,
    norm,
    ratio,
    root,
    scale,
    subtract,
    where,
    where_vector,
)
from .rolling import NONE, along_surface, own_slip


class Sides(NamedTuple):
    """What is on the two sides of a groove."""

    normals: tuple[Vector3, Vector3]
    turns: tuple[Vector3, Vector3]  # how fast the normals turn as the ball goes along
    grips: tuple[Any, Any]  # whether the ball does not slip there


class Way(NamedTuple):
    """How a ball may go along a groove."""

    along: Vector3
    turning: Vector3  # spin per speed
    free: Vector3  # about which it may spin as well, or zero


class Course(NamedTuple):
    """How it goes."""

    acceleration: Vector3
    spins: Vector3  # the rate of the spin
    pivots: Number  # the rate of the spin about the free axis
    pushes: tuple[Number, Number]  # per mass
    forces: tuple[Vector3, Vector3]  # along the surfaces, per mass


class Rub(NamedTuple):
    """What friction there is on the two sides."""

    limits: tuple[Number, Number]  # its coefficients: infinite where a ball cannot slip, zero where nothing holds it
    headings: tuple[Vector3, Vector3]  # the directions in which the ball slips, zero where it does not


def way(radius: Number, sides: Sides, normals: tuple[Vector3, Vector3] | None = None) -> Way:
    one, two = sides.normals if normals is None else normals
    first, second = sides.grips
    across = cross(one, two)
    size = norm(across)
    along = scale(ratio(1.0, size), across)
    both = scale(ratio(1.0, radius * size), subtract(one, two))
    only = where_vector(
        first, scale(ratio(1.0, radius), cross(one, along)), scale(ratio(1.0, radius), cross(two, along))
    )
    nothing = scale(0.0, along)
    turning = where_vector(first & second, both, where_vector(first | second, only, nothing))
    free = where_vector(first & second, nothing, where_vector(first, one, where_vector(second, two, nothing)))
    return Way(along, turning, free)


def entered(
    radius: Number, inertia_ratio: Number, path: Way, velocity: Vector3, spin: Vector3
) -> tuple[Number, Number]:
    """Speed along the groove and spin about the free axis of what comes into it: what its constraints take is lost."""
    j = inertia_ratio * radius * radius
    mass = 1.0 + j * dot(path.turning, path.turning)
    return ratio(dot(path.along, velocity) + j * dot(path.turning, spin), mass), dot(path.free, spin)


def spin_of(path: Way, speed: Number, pivot: Number, kept: Vector3, grips: Any) -> Vector3:
    """The spin at that speed; `kept` is the one of a ball that slips at both contacts."""
    return where_vector(grips, add(scale(speed, path.turning), scale(pivot, path.free)), kept)


def slips(radius: Number, sides: Sides, velocity: Vector3, spin: Vector3) -> tuple[Vector3, Vector3]:
    """The slip on both sides."""
    one, two = (own_slip(radius, n, velocity, spin) for n in sides.normals)
    return one, two


def course(
    radius: Number,
    inertia_ratio: Number,
    sides: Sides,
    velocity: Vector3,
    spin: Vector3,
    pull: Vector3,
    rub: Rub | None = None,
) -> Course:
    """The motion under a `pull`, gravity and air per mass."""
    path, rates = jax.jvp(lambda *normals: way(radius, sides, normals), sides.normals, sides.turns)
    held = _held(radius, inertia_ratio, sides, path, rates, velocity, spin, pull)
    if rub is None:
        return held
    acceleration, spins, pushes, forces = _rubbed(radius, inertia_ratio, sides, velocity, spin, pull, rub)
    pivots = dot(path.free, spins) + dot(rates.free, spin)
    loose = Course(acceleration, spins, pivots, pushes, forces)
    both = sides.grips[0] & sides.grips[1]
    return jax.tree.map(lambda a, b: jnp.where(both, a, b), held, loose)


def _held(
    radius: Number,
    inertia_ratio: Number,
    sides: Sides,
    path: Way,
    rates: Way,
    velocity: Vector3,
    spin: Vector3,
    pull: Vector3,
) -> Course:
    """`course` without friction against a slip."""
    j, (one, two) = inertia_ratio * radius * radius, sides.normals
    speed, pivot = dot(path.along, velocity), dot(path.free, spin)
    mass = 1.0 + j * dot(path.turning, path.turning)
    drags = speed * dot(path.turning, rates.turning) + pivot * dot(path.turning, rates.free)
    faster = ratio(dot(path.along, pull) - j * drags, mass)
    acceleration = add(scale(faster, path.along), scale(speed, rates.along))
    pivots = -speed * dot(path.free, rates.turning)
    spun = add(scale(faster, path.turning), scale(speed, rates.turning))
    spun = add(spun, add(scale(pivots, path.free), scale(pivot, rates.free)))
    torque = scale(-inertia_ratio * radius, spun)  # n1 x F1 + n2 x F2
    forces = _forces(sides, path.along, torque)
    rest = subtract(subtract(acceleration, pull), add(*forces))
    meets, a, b = dot(one, two), dot(rest, one), dot(rest, two)
    determinant = 1.0 - meets * meets
    pushes = ratio(a - meets * b, determinant), ratio(b - meets * a, determinant)
    return Course(acceleration, spun, pivots, pushes, forces)


def _forces(sides: Sides, along: Vector3, torque: Vector3) -> tuple[Vector3, Vector3]:
    (one, two), (first, second) = sides.normals, sides.grips
    size = norm(cross(one, two))
    twisting = dot(torque, along)
    across = subtract(torque, scale(twisting, along))
    both = [
        add(scale(ratio(sign * dot(across, other), size), along), scale(0.5 * twisting, cross(along, n)))
        for n, other, sign in ((one, two, -1.0), (two, one, 1.0))
    ]
    alone = [cross(torque, n) for n in (one, two)]
    nothing = scale(0.0, along)
    grips = first & second
    return (where_vector(grips, both[0], where_vector(first, alone[0], nothing)),
            where_vector(grips, both[1], where_vector(second, alone[1], nothing)))  # fmt: skip


def _rubbed(
    radius: Number,
    inertia_ratio: Number,
    sides: Sides,
    velocity: Vector3,
    spin: Vector3,
    pull: Vector3,
    rub: Rub,
) -> tuple[Vector3, Vector3, tuple[Number, Number], tuple[Vector3, Vector3]]:
    """Acceleration, rate of the spin, pushes and forces of a ball that slips on one side at least.

    The force F_i is f_i + N_i own_i + N_j other_i: -N_i mu_i u_i/|u_i| where the ball slips, and where not, what keeps
    the slip zero: (1 + 1/alpha) F_i = r omega x dn_i/dt - g - N_j n_j - F_j - (n_j x F_j) x n_i / alpha, along
    the surface."""
    normals, grips, share = sides.normals, sides.grips, ratio(inertia_ratio, 1.0 + inertia_ratio)
    drags = [
        scale(where(g, 0.0, limit), heading) for g, limit, heading in zip(grips, rub.limits, rub.headings, strict=True)
    ]
    fixed, own, other = [], [], []
    for i, n in enumerate(normals):
        m, drag = normals[1 - i], drags[1 - i]
        turned = subtract(scale(radius, cross(spin, sides.turns[i])), pull)
        fixed.append(where_vector(grips[i], scale(share, along_surface(n, turned)), NONE))
        back = scale(ratio(1.0, inertia_ratio), cross(cross(m, drag), n))
        leans = subtract(back, along_surface(n, subtract(m, drag)))
        other.append(where_vector(grips[i], scale(share, leans), NONE))
        own.append(scale(-1.0, drags[i]))
    rows = []
    for i, n in enumerate(normals):
        k = 1 - i
        wanted = -dot(velocity, sides.turns[i]) - dot(n, pull) - dot(n, fixed[k])
        rows.append((1.0 + dot(n, other[k]), dot(n, normals[k]) + dot(n, own[k]), wanted))
    (a, b, p), (d, c, q) = rows
    determinant = a * d - b * c
    pushes = ratio(p * d - b * q, determinant), ratio(a * q - c * p, determinant)
    forces = [add(fixed[i], add(scale(pushes[i], own[i]), scale(pushes[1 - i], other[i]))) for i in (0, 1)]
    acceleration = add(pull, add(*forces))
    acceleration = add(acceleration, add(scale(pushes[0], normals[0]), scale(pushes[1], normals[1])))
    torque = add(cross(normals[0], forces[0]), cross(normals[1], forces[1]))
    spins = scale(ratio(-1.0, inertia_ratio * radius), torque)
    return acceleration, spins, pushes, (forces[0], forces[1])


def slip_rates(radius: Number, sides: Sides, spin: Vector3, goes: Course) -> tuple[Vector3, Vector3]:
    """How the slips on both sides change."""
    rates = []
    for n, turn in zip(sides.normals, sides.turns, strict=True):
        turned = add(cross(goes.spins, n), cross(spin, turn))
        rates.append(along_surface(n, subtract(goes.acceleration, scale(radius, turned))))
    return rates[0], rates[1]


class _Load(NamedTuple):
    """What friction does on the two sides, and could do: forces per mass."""

    most: tuple[Number, Number]
    along: tuple[Number, Number]
    across: tuple[Number, Number]  # where both sides hold, as each can
    room: tuple[Number, Number]  # of squares: what it could do across besides what it does along
    turns: Number  # where both sides hold, by which share the force across could grow, below zero if it is too large
    directions: tuple[Vector3, Vector3, Vector3]  # along; across, on both sides


def _load(sides: Sides, goes: Course, limits: tuple[Number, Number]) -> _Load:
    """What is across the groove may be shared in any way by two sides that hold: they do if some way serves."""
    e = cross(*sides.normals)
    e = scale(ratio(1.0, norm(e)), e)
    one, two = (cross(e, n) for n in sides.normals)
    most = [where(jnp.isfinite(limit), limit, 0.0) * push for limit, push in zip(limits, goes.pushes, strict=True)]
    along = [dot(e, force) for force in goes.forces]
    across = [dot(one, goes.forces[0]), dot(two, goes.forces[1])]
    room = [m * abs(m) - f * f for m, f in zip(most, along, strict=True)]
    firm = [jnp.isinf(jnp.asarray(limit)) for limit in limits]
    able = [root(jnp.maximum(a, 0.0)) for a in room]
    total, whole, both = across[0] + across[1], able[0] + able[1], sides.grips[0] & sides.grips[1]
    shares = []
    for i in (0, 1):
        share = where(whole > 0, ratio(able[i], whole), 0.5)
        share = where(firm[1 - i], 0.0, where(firm[i], 1.0, share))
        shares.append(where(both, share * total, across[i]))
    grows = where(firm[0] | firm[1], 1.0, 1.0 - ratio(total * total, whole * whole, jnp.inf))
    return _Load((most[0], most[1]), (along[0], along[1]), (shares[0], shares[1]), (room[0], room[1]),
                 grows, (e, one, two))  # fmt: skip


def spare(sides: Sides, goes: Course, limits: tuple[Number, Number]) -> tuple[Number, Number]:
    """By how much friction could do more than it does on both sides where it holds, of what it can: in squares."""
    load = _load(sides, goes, limits)
    one, two = (ratio(room - f * f, frozen(most * most + along * along + f * f), 1.0) for room, f, most, along
                in zip(load.room, load.across, load.most, load.along, strict=True))  # fmt: skip
    return one, two


def _released(
    sides: Sides, goes: Course, limits: tuple[Number, Number], ends: tuple[Any, Any]
) -> tuple[tuple[Any, Any], tuple[Vector3, Vector3]]:
    """On which sides the ball is held, where those let go on which friction cannot hold it, or is known to end; and the
    directions in which it begins to slip there."""
    load, (first, second) = _load(sides, goes, limits), sides.grips
    limited = [g & jnp.isfinite(limit) for g, limit in zip(sides.grips, limits, strict=True)]
    over = [c & ((room < f * f) | end)
            for c, room, f, end in zip(limited, load.room, load.across, ends, strict=True)]  # fmt: skip
    lengthwise = [ratio(room, most * most, 1.0) for room, most in zip(load.room, load.most, strict=True)]
    turns = limited[0] & limited[1] & (over[0] | over[1]) & (load.turns < minimum(*lengthwise))
    lets = [c | turns for c in over]
    alone = first & second & ~(lets[0] & lets[1])  # then the slip is along the groove
    headings = []
    for f, side, aside in zip(load.along, load.across, load.directions[1:], strict=True):
        force = add(scale(f, load.directions[0]), scale(where(alone, 0.0, side), aside))
        headings.append(scale(ratio(-1.0, norm(force)), force))
    return (first & ~lets[0], second & ~lets[1]), (headings[0], headings[1])


class Grip(NamedTuple):
    """How a ball goes on that comes into a groove, or whose slip there begins or ends."""

    sides: Sides  # with the turns of its speed, and `grips` where it does not slip
    speed: Number
    spin: Vector3
    course: Course


class Change(NamedTuple):
    """What happens to a ball in a groove: whether what holds it ends, on both sides, and the largest slip in m/s that
    friction may stop."""

    ends: tuple[Any, Any]
    least: Number
    begins: Number  # the slip with which one begins


def gripped(
    radius: Number,
    inertia_ratio: Number,
    sides: Sides,
    velocity: Vector3,
    spin: Vector3,
    pull: Vector3,
    limits: tuple[Number, Number],
    change: Change,
) -> Grip:
    """Of the sides on which the slip is small, those hold on which friction can; on the others a slip begins. `turns`
    of `sides` are those of a ball of speed 1, `grips` says whether a side may hold at all."""
    known = slips(radius, sides, velocity, spin)
    firm = [jnp.isinf(jnp.asarray(limit)) for limit in limits]
    small = [norm(u) <= change.least for u in known]
    may = tuple(jnp.asarray(g & (s | f)) for g, s, f in zip(sides.grips, small, firm, strict=True))
    zero = jnp.zeros_like(jnp.asarray(velocity[0]))
    array = lambda tree: jax.tree.map(lambda x: x + zero, tree)  # noqa: E731
    known = [where_vector(s, NONE, scale(ratio(1.0, norm(u)), u)) for s, u in zip(small, known, strict=True)]

    def turn(k: Any, carry: tuple) -> tuple:
        grips, headings, *_ = carry
        path = way(radius, sides._replace(grips=grips))
        speed, pivot = entered(radius, inertia_ratio, path, velocity, spin)
        turns = (scale(speed, sides.turns[0]), scale(speed, sides.turns[1]))
        held, now = Sides(sides.normals, turns, grips), spin_of(path, speed, pivot, spin, grips[0] | grips[1])
        goes = course(radius, inertia_ratio, held, scale(speed, path.along), now, pull, Rub(limits, headings))
        ends = tuple((k == 0) & end for end in change.ends)
        after, begun = _released(held, goes, limits, ends)  # pyright: ignore[reportArgumentType]
        begun = tuple(where_vector(a & ~b, new, old)
                      for a, b, new, old in zip(grips, after, begun, headings, strict=True))  # fmt: skip
        last = k == 2  # what is found then is what the course was found with
        after = tuple(jnp.where(last, a, b) for a, b in zip(grips, after, strict=True))
        begun = jax.tree.map(lambda a, b: jnp.where(last, a, b), headings, begun)
        return after, begun, speed, now, goes

    empty = Course(array(NONE), array(NONE), zero, (zero, zero), (array(NONE), array(NONE)))
    start = (may, tuple(array(known)), zero, array(NONE), empty)
    grips, headings, speed, spin, goes = lax.fori_loop(0, 3, turn, start)
    for i, (n, u) in enumerate(zip(sides.normals, headings, strict=True)):
        axis = where_vector(grips[1 - i], sides.normals[1 - i], cross(n, u))
        slip = scale(-radius, cross(axis, n))  # of a unit of spin about that axis
        begins = small[i] & may[i] & ~grips[i]
        spin = add(spin, scale(where(begins, ratio(change.begins, dot(slip, u)), 0.0), axis))
    held = Sides(sides.normals, (scale(speed, sides.turns[0]), scale(speed, sides.turns[1])), grips)
    path = way(radius, held)
    return Grip(held, speed, spin_of(path, speed, dot(path.free, spin), spin, grips[0] | grips[1]), goes)
