"""A ball that touches two surfaces at once and goes along the groove between them: one degree of freedom.

With the normals n1 and n2, c = |n1 x n2| and e = (n1 x n2) / c, the velocity is w e. A ball that slips at neither
contact has v = r omega x n1 = r omega x n2, so that omega = w (n1 - n2) / (r c). One that slips at the first alone,
where nothing holds it, has omega = w (n2 x e) / r + pivot n2; one that slips at both keeps its spin. Kane's equations,
with G = diag(1, alpha r^2) and the rates of these directions, give dw/dt and dpivot/dt. The torque gives the forces
along the surfaces, but for the share of those across the groove, of which each contact takes the same; the rest of the
acceleration gives the two pushes.
"""

from typing import Any, NamedTuple

import jax

from .._math import Number, Vector3, add, cross, dot, norm, ratio, scale, subtract, where_vector


class Sides(NamedTuple):
    """What is on the two sides of a groove."""

    normals: tuple[Vector3, Vector3]
    turns: tuple[Vector3, Vector3]  # how fast the normals turn as the ball goes along
    grips: tuple[Any, Any]  # whether the ball cannot slip there


class Way(NamedTuple):
    """How a ball may go along a groove."""

    along: Vector3
    turning: Vector3  # spin per speed
    free: Vector3  # about which it may spin as well, or zero


class Course(NamedTuple):
    """How it goes."""

    acceleration: Vector3
    pivots: Number  # the rate of the spin about the free axis
    pushes: tuple[Number, Number]  # per mass
    forces: tuple[Vector3, Vector3]  # along the surfaces, per mass


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


def course(
    radius: Number, inertia_ratio: Number, sides: Sides, velocity: Vector3, pivot: Number, pull: Vector3
) -> Course:
    """The motion under a `pull`, gravity and air per mass."""
    j, (one, two) = inertia_ratio * radius * radius, sides.normals
    path, rates = jax.jvp(lambda *normals: way(radius, sides, normals), sides.normals, sides.turns)
    speed = dot(path.along, velocity)
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
    return Course(acceleration, pivots, pushes, forces)


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
