"""What is below a ball that stays on a surface, which way it is driven there, and what resists it."""

from collections.abc import Iterable
from typing import Any, NamedTuple

import jax.numpy as jnp

from .._impact import groove, rolling
from .._math import (
    Choice,
    Number,
    Vector3,
    add,
    components,
    cross,
    dot,
    minimum,
    norm,
    plus,
    ratio,
    root,
    scale,
    subtract,
    where,
    where_vector,
)
from .._world import Face, Flight, Neighbours, Scene, along, neighbours, numbers_of
from .floors import Floors

_UP = (0.0, 0.0, 1.0)


class Freedom(NamedTuple):
    """What a support leaves of a ball's motion: with the acceleration a and the normal n, share (a - held (n . a) n);
    the spin at the velocity v is spin + turning (n x v)."""

    held: Any  # 1 on a face, else 0
    share: Any  # 1 / (1 + alpha) for a ball that rolls, else 1
    spin: Vector3
    turning: Any


class Brake(NamedTuple):
    """What resists a ball that rolls."""

    coefficient: Number  # zero of one that slips
    heading: Vector3  # in which it rolls, or begins to; zero where resistance holds it
    straight: Any  # whether it keeps that direction until it stops
    holds: Any  # whether resistance holds it


class Slides(NamedTuple):
    """How a ball in a groove slips on its two sides."""

    grips: tuple[Any, Any]  # whether it does not
    headings: tuple[Vector3, Vector3]  # in which direction it does, against friction; or zero
    straight: tuple[Any, Any]  # whether it keeps that direction until its slip ends
    lasts: Any  # for how long both slip on, about, where their directions change; else infinite
    limits: tuple[Number, Number]  # the coefficients of friction


class Ground(NamedTuple):
    """What a ball that stays on a face has below it."""

    face: Face
    edged: Any  # whether it is on a face with edges
    rolls: Any  # whether it is on a face on which it rolls, perhaps after sliding
    friction: Number | None  # of that face; infinite where it never slides or never rolls
    free: Freedom
    slip: Vector3  # zero of a ball that rolls, and where there is no friction to slide against
    heading: Vector3  # the direction in which it slides against friction, or zero
    straight: Any  # whether it keeps that direction until its slip ends
    lasts: Any  # for how long it slips on, about, where its direction changes; else infinite
    flush: Neighbours | None = None  # the faces that are flush with it, if there can be any
    pivot: Number = 0.0  # the spin about the normal of a ball that rolls on a curved surface
    seams: tuple = ()  # for each pair of seams whether the ball is beyond it, and what `Floors.seam` says
    brake: Brake | None = None  # `None` where nothing resists rolling
    slides: Slides | None = None  # only where there are grooves with friction
    spinning: tuple | None = None  # the coefficient of what resists spinning about the normal, and against which sign


class Travel(NamedTuple):
    """A ball's state inside the engine, with the phase that it is in."""

    flight: Flight
    support: Any  # index of the surface that the ball stays on, -1 in flight; a float, as all of a state is
    below: Ground | None = None  # only while an arc is worked on


_SIDES = 4096  # more surfaces than there may be in a scene with grooves


def phase_of(state: Travel) -> Any:
    return jnp.asarray(state.support).astype(jnp.int32)


def second_of(state: Travel) -> Any:
    """The other surface of a ball in a groove, else -1: kept in the fractional part of `support`."""
    support = jnp.asarray(state.support)
    return jnp.round((support - jnp.trunc(support)) * _SIDES).astype(jnp.int32) - 1


def support_of(first: Any, second: Any, dtype: Any) -> Any:
    """What `Travel.support` is for these two."""
    return jnp.asarray(first).astype(dtype) + (jnp.asarray(second) + 1).astype(dtype) / _SIDES


def code_of(first: Any, second: Any) -> Any:
    """One whole number for both, as the log keeps it."""
    return first + _SIDES * (second + 1)


def of_code(code: Any) -> tuple[Any, Any]:
    is_known = code >= 0
    return jnp.where(is_known, code % _SIDES, code), jnp.where(is_known, code // _SIDES - 1, -1)


class Forced(NamedTuple):
    """What drives a ball that stays on a surface: accelerations."""

    normal: Vector3
    turn: Vector3  # how fast the normal turns
    push: Number  # what the surface must take away along the normal: negative where it pushes
    along: Vector3  # of gravity and air, along the surface
    twist: Vector3  # `rolling.twist`, of a ball that rolls


def arrays(numbers: Iterable, time: Any) -> Any:
    """The numbers as arrays of the dtype of the time."""
    return tuple(jnp.asarray(c, time.dtype) for c in numbers)


class Footing:
    """What a ball has below it that stays on a surface of a scene. `tolerance` and `parabolic` are those of `Grounded`;
    `joins` says that faces may be flush, or that a surface has parts that bend differently."""

    def __init__(self, scene: Scene, tolerance: float, parabolic: bool, floors: Floors, joins: bool):
        self.scene, self.tolerance, self.parabolic = scene, tolerance, parabolic
        self.floors, self.joins = floors, joins

    @property
    def curved(self) -> bool:
        return self.floors.curved

    @property
    def n_edges(self) -> int:
        """How many contacts, behind the surfaces, are pairs of edges of the face below, or of seams of the surface."""
        return self.floors.n_seams + 2 * self.floors.have_edges

    @property
    def end_of_slip(self) -> int:
        """The contact at which a slip has died out."""
        return self.scene.n_contacts + self.n_edges

    @property
    def end_of_roll(self) -> int:
        """The contact at which resistance has stopped a ball that rolled."""
        return self.end_of_slip + self.floors.have_friction

    @property
    def end_of_spin(self) -> int:
        """The contact at which spinning about the normal has died out, where that is followed step by step."""
        return self.end_of_roll + self.floors.resist[0]

    @property
    def end_of_hold(self) -> int:
        """The contact at which the surface would have to pull the ball, or to grip it more than friction can."""
        return self.end_of_spin + (self.floors.resist[1] and self.curved)

    @property
    def follows_hold(self) -> bool:
        """Whether what holds a ball on a surface may end while nothing else happens."""
        return self.curved or (self.scene.air is not None and bool(self.floors.indices))

    @property
    def have_grooves(self) -> bool:
        """Whether a ball may be followed along a groove between two surfaces."""
        return self.curved and self.scene.n_contacts > 1

    @property
    def end_of_slips(self) -> int:
        """The first of the contacts at which the slips on both sides of a groove have died out."""
        return self.end_of_hold + self.n_holds

    @property
    def n_derived(self) -> int:
        """How many numbers that follow from the motion are followed like a part of it."""
        return self.n_holds + 2 * (self.have_grooves and self.floors.have_friction)

    @property
    def n_holds(self) -> int:
        """How many pushes are followed."""
        return self.follows_hold + self.have_grooves

    def sides(self, time: Any, state: Travel, x: Vector3, v: Vector3, second: Any = None) -> groove.Sides:
        """What is on both sides of the ball in a groove; harmless numbers for one that is in none."""
        second = second_of(state) if second is None else second
        inside, choices = second >= 0, [self.scene.choice(i) for i in (phase_of(state), second)]
        normals, turns = [], []
        for choice, plain in zip(choices, ((0.0, 0.0, 1.0), (1.0, 0.0, 0.0)), strict=True):
            n, turn = self.floors.turning(choice, x, v, time)
            normals.append(tuple(jnp.asarray(c, time.dtype) for c in where_vector(inside, n, plain)))
            turns.append(where_vector(inside, turn, tuple(0.0 * c for c in normals[-1])))
        grips = [self.floors.rolls(choice) for choice in choices]
        return groove.Sides(tuple(normals), tuple(turns), tuple(jnp.asarray(g) for g in grips))  # pyright: ignore

    def limits(self, state: Travel) -> tuple[Number, Number]:
        """The coefficients of friction on both sides of a groove: infinite where a ball cannot slip, zero where nothing
        holds it."""
        one, two = (self.limit(self.scene.choice(i)) for i in (phase_of(state), second_of(state)))
        return one, two

    def limit(self, side: Choice) -> Number:
        """The coefficient of friction on one side."""
        return where(self.floors.rolls(side), self.floors.friction(side), 0.0)

    def ground(self, time: Any, state: Travel) -> Ground:
        flight, floors, on = state.flight, self.floors, state.support >= 0
        support = self.scene.choice(phase_of(state))
        face, edged = floors.face(support, flight.position, time)
        if self.curved:  # in flight there may be no normal
            face = face._replace(normal=where_vector(on, face.normal, _UP))
        edged, rolls, ball, n = on & edged, on & floors.rolls(support), self.scene.ball, face.normal
        share = where(rolls, ratio(1.0, 1.0 + ball.inertia_ratio), 1.0)
        pivot = where_vector(rolls, scale(dot(n, flight.spin), n), flight.spin)
        free = Freedom(where(on, 1.0, 0.0), share, pivot, where(rolls, ratio(1.0, ball.radius), 0.0))
        flush = self._flush(time, state, n) if self.joins else None
        more = self._curved_ground(time, state, support, n, on, rolls) if self.curved else {}
        if not (floors.have_friction or any(floors.resist)):
            return Ground(face, edged, rolls, None, free, rolling.NONE, rolling.NONE, True, jnp.inf, flush, **more)
        a = self.pull(time, flight)
        along, alpha, twist, turn = rolling.along_surface(n, a), ball.inertia_ratio, rolling.NONE, rolling.NONE
        if self.curved:
            turn = where_vector(on, floors.turning(support, flight.position, flight.velocity, time)[1], rolling.NONE)
            twist = rolling.twist(ball.radius, more["pivot"], n, turn)
            a = add(a, scale(dot(turn, flight.velocity), n))
            if floors.resist[1]:
                more["spinning"] = self._spinning(support, flight, n, turn, -dot(a, n), rolls)
        elif floors.resist[1]:
            more["spinning"] = where(rolls, floors.resistance(support, 1), 0.0), jnp.sign(dot(n, flight.spin))
        push, brake, slowed = -dot(a, n), None, rolling.NONE
        if floors.resist[0]:
            brake, slowed = self._brake(support, flight, n, push, add(along, scale(alpha, twist)), rolls, turn)
        if not floors.have_friction:
            none = rolling.NONE
            return Ground(face, edged, rolls, None, free, none, none, True, jnp.inf, flush, brake=brake, **more)
        friction = floors.friction(support)
        slides = rolls & jnp.isfinite(friction)
        if self.have_grooves:
            slides = slides & (second_of(state) < 0)
        slip = rolling.own_slip(ball.radius, n, flight.velocity, flight.spin)
        slip = where_vector(slides, slip, rolling.NONE)
        if self.have_grooves:
            more["slides"] = self._slides(time, state)
        drive = subtract(along, twist)
        if brake is not None:
            drive = add(drive, scale(where(dot(slip, slip) > 0, 0.0, 1.0 + 1.0 / alpha), slowed))
        most = where(slides, friction, 0.0) * push * (1.0 + 1.0 / alpha)
        heading = where_vector(slides, rolling.heading(slip, drive, most), rolling.NONE)
        straight: Any = True
        if not self.parabolic:
            change = self._change(flight, turn, friction * (1.0 + 1.0 / alpha))
            straight = rolling.ends_soon(heading, slip, drive, most, self.tolerance, change, self._balance(most))
        lasts = where(straight, jnp.inf, rolling.lasts(heading, slip, drive, most))
        if brake is not None:
            slides = dot(heading, heading) > 0
            brake = brake._replace(coefficient=where(slides, 0.0, brake.coefficient), holds=brake.holds & ~slides,
                                   heading=where_vector(slides, rolling.NONE, brake.heading))  # fmt: skip
        if self.follows_hold and not self.parabolic:
            begins = (dot(heading, heading) > 0) & (dot(slip, slip) == 0)
            slip = where_vector(begins, scale(self.first_slip(flight), heading), slip)
        if self.have_grooves:  # there it is the spin that is followed
            slip = where_vector(second_of(state) >= 0, scale(ball.radius, flight.spin), slip)
        if self.have_grooves:
            lasts = minimum(lasts, more["slides"].lasts)
        return Ground(face, edged, rolls, friction, free, slip, heading, straight, lasts, flush, brake=brake, **more)

    def first_slip(self, flight: Flight) -> Number:
        """The slip with which one begins: so large that it does not end at once where friction hardly fails to hold it,
        as far as that is known to rounding and to the tolerance of a step."""
        eps, radius = self._eps(flight), self.scene.ball.radius
        size = norm(flight.velocity) + radius * norm(flight.spin) + root(radius * norm(components(self.scene.gravity)))
        return 4.0 * self.tolerance * (1.0 + size) + max(eps**0.75, 1024.0 * eps) * size

    def _balance(self, most: Number) -> Number:
        """By how much friction may seem to exceed what drives a ball whose slip has just begun: the moment at which
        that begins is known to the tolerance of a step."""
        return 1e3 * self.tolerance * most if self.follows_hold else 0.0

    def last_slip(self, flight: Flight, slip: Vector3, straight: Any = False) -> Number:
        """The slip at which one that was `slip` at the beginning of an arc counts as over: not so small that a step
        may end there unseen and the next arc take it for rounding. One that goes straight to its end is not missed."""
        eps, size = self._eps(flight), norm(flight.velocity) + self.scene.ball.radius * norm(flight.spin)
        least = where(straight, 0.0, self.tolerance * (1.0 + size)) + 256.0 * eps * size
        speed = norm(slip)
        return where(speed > least, least, 0.5 * speed)

    @staticmethod
    def _eps(flight: Flight) -> float:
        return float(jnp.finfo(jnp.result_type(*flight.position)).eps)

    def _slides(self, time: Any, state: Travel) -> Slides:
        flight, radius, limits = state.flight, self.scene.ball.radius, self.limits(state)
        sides = self.sides(time, state, flight.position, flight.velocity)
        slips = groove.slips(radius, sides, flight.velocity, flight.spin)
        grips, headings, straight, lasts = [], [], [], jnp.inf
        for slip, limit in zip(slips, limits, strict=True):
            speed, firm = norm(slip), jnp.isinf(jnp.asarray(limit))
            slides = (speed > 0) & ~firm & (limit > 0) & (second_of(state) >= 0)
            grips.append(firm | ((speed == 0) & (limit > 0)))
            headings.append(where_vector(slides, scale(ratio(1.0, speed), slip), rolling.NONE))
        sides = sides._replace(grips=(grips[0], grips[1]))
        goes = self.course(
            time, flight, sides, flight.velocity, flight.spin, groove.Rub(limits, (headings[0], headings[1]))
        )
        rates = groove.slip_rates(radius, sides, flight.spin, goes)
        for slip, known, rate in zip(slips, headings, rates, strict=True):
            decay, speed = -dot(known, rate), norm(slip)
            aside = norm(add(rate, scale(decay, known)))
            most = 100.0 * self.tolerance
            straight.append((speed <= most) & (decay > 0) & (aside * speed <= most * decay))
            turns = (speed > 0) & (decay > 0) & ~straight[-1]
            lasts = minimum(lasts, where(turns, ratio(speed, decay), jnp.inf))
        return Slides((grips[0], grips[1]), (headings[0], headings[1]), (straight[0], straight[1]), lasts, limits)

    def course(
        self, time: Any, flight: Flight, sides: groove.Sides, v: Vector3, spin: Vector3, rub: groove.Rub | None
    ) -> groove.Course:
        """How a ball in a groove goes on under gravity and air."""
        ball = self.scene.ball
        pull = arrays(self.scene.derivative(time, flight._replace(spin=spin), flight.position, v)[1], time)
        v, spin = arrays(v, time), arrays(spin, time)
        return groove.course(ball.radius, ball.inertia_ratio, sides, v, spin, pull, rub)

    def _brake(
        self, support: Choice, flight: Flight, n: Vector3, push: Number, along: Vector3, rolls: Any, turn: Vector3
    ) -> tuple[Brake, Vector3]:
        """What resists a ball that rolls, `along` being what drives it; and by how much that slows it."""
        share, velocity = ratio(1.0, 1.0 + self.scene.ball.inertia_ratio), rolling.along_surface(n, flight.velocity)
        coefficient = where(rolls, self.floors.resistance(support, 0), 0.0)
        most = coefficient * push
        heading, driven = rolling.heading(velocity, scale(share, along), most), scale(share, along)
        stands = (dot(heading, heading) == 0) & rolls & (coefficient > 0)
        heading = where_vector(coefficient > 0, heading, rolling.NONE)
        straight: Any = True
        if not self.parabolic:
            change = self._change(flight, turn, coefficient)
            straight = rolling.ends_soon(heading, velocity, driven, most, self.tolerance, change)
        return Brake(coefficient, heading, straight, stands), where_vector(stands, driven, scale(most, heading))

    def _change(self, flight: Flight, turn: Vector3, friction: Number) -> Number:
        """The part of the forces on a ball on a surface that may change in a second: `turn` is the rate of the normal,
        `friction` what acts against the ball for a push of 1."""
        speed = norm(flight.velocity)
        change = 0.0
        if self.curved:
            turning = self.scene.ball.radius * norm(flight.spin) + speed * (1.0 + 2.0 * friction)
            change = ratio(norm(turn), speed) * turning
        if self.scene.air is not None:
            drag = norm(subtract(self.pull(0.0, flight), components(self.scene.gravity)))
            change = change + ratio(2.0 * drag, speed)
        return change

    def _spinning(
        self, support: Choice, flight: Flight, n: Vector3, turn: Vector3, push: Number, rolls: Any
    ) -> tuple[Number, Number]:
        """What resists spinning about the normal, and the sign that it acts against, zero where it holds."""
        coefficient, pivot = where(rolls, self.floors.resistance(support, 1), 0.0), dot(n, flight.spin)
        eps = float(jnp.finfo(jnp.result_type(*flight.spin)).eps)
        pivot = where(abs(pivot) > 8.0 * eps * norm(flight.spin), pivot, 0.0)
        driven, most = dot(flight.spin, turn), rolling.spin_loss(self.scene.ball, coefficient, push)
        begins = where(abs(driven) > most, jnp.sign(driven), 0.0)
        return coefficient, where(pivot != 0, jnp.sign(pivot), begins)

    def _curved_ground(
        self, time: Any, state: Travel, support: Choice, n: Vector3, on: Any, rolls: Any
    ) -> dict[str, Any]:
        flight = state.flight
        pivot = where(rolls, dot(n, flight.spin), 0.0)
        if self.have_grooves:
            sides = self.sides(time, state, flight.position, flight.velocity)
            free = groove.way(self.scene.ball.radius, sides).free
            pivot = where(second_of(state) >= 0, dot(free, flight.spin), pivot)
        seams = []
        for k in range(self.floors.n_seams):
            axes, middle, half, present = self.floors.seam(support, k)
            beyond = norm(along(subtract(flight.position, middle), axes)) > half
            seams.append((beyond, axes, middle, half, on & present))
        return {"pivot": pivot, "seams": tuple(seams)}

    def placed(self, time: Any, support: Any, flight: Flight) -> Flight:
        """The ball exactly on the curved surface that it stays on, going along it."""
        return self._into_groove(time, support, self._onto_surface(time, support, flight))

    def _into_groove(self, time: Any, support: Any, flight: Flight) -> Flight:
        """The ball exactly on both surfaces of the groove that it is in, going along it."""
        if not self.have_grooves:
            return flight
        state = Travel(flight, support)
        inside, x, v = second_of(state) >= 0, flight.position, flight.velocity
        sides = self.sides(time, state, x, v)
        one, two = sides.normals
        depths = [where(inside, self.floors.depth(self.scene.choice(i), x, n, time), 0.0)
                  for i, n in zip((phase_of(state), second_of(state)), sides.normals, strict=True)]  # fmt: skip
        meets = dot(one, two)
        determinant = 1.0 - meets * meets
        a, b = (ratio(depths[i] - meets * depths[1 - i], determinant) for i in (0, 1))
        x = where_vector(inside, subtract(x, add(scale(a, one), scale(b, two))), x)
        along = groove.way(self.scene.ball.radius, sides).along
        return flight._replace(position=x, velocity=where_vector(inside, scale(dot(along, v), along), v))

    def _onto_surface(self, time: Any, support: Any, flight: Flight) -> Flight:
        floor, x = self.scene.choice(jnp.asarray(support).astype(jnp.int32)), flight.position
        face, _ = self.floors.face(floor, x, time)
        n, depth = face.normal, self.floors.depth(floor, x, face.normal, time)
        x = subtract(x, scale(depth, n))
        velocity = rolling.along_surface(n, flight.velocity)
        on = support >= 0
        return flight._replace(
            position=where_vector(on, x, flight.position), velocity=where_vector(on, velocity, flight.velocity)
        )

    def pull(self, time: Any, flight: Flight, floor: Choice | None = None) -> Vector3:
        """Gravity, and what air gives now; with a `floor`, and what its curvature takes to follow it."""
        _, a = self.scene.derivative(time, flight, flight.position, flight.velocity)
        if floor is None or not self.curved:
            return a
        n, _ = self.floors.turning(floor, flight.position, flight.velocity, time)
        along = rolling.along_surface(n, flight.velocity)
        _, turn = self.floors.turning(floor, flight.position, along, time)
        return add(a, scale(dot(turn, along), n))

    def _flush(self, time: Any, state: Travel, n: Vector3) -> Neighbours:
        """The faces that are flush with the one that the ball is on, that itself left out."""
        found = neighbours(self.scene, time, n, self.scene.ball.radius, state.flight)
        other = (numbers_of(self.scene) != phase_of(state)) & (state.support >= 0)
        return found._replace(flush=found.flush & other)

    def inner(self, q: tuple) -> tuple[tuple, Number]:
        """Of a configuration the slip, or nothing where it is not followed, and the spin about the normal."""
        slip = q[3:6] if self.floors.have_friction else ()
        return slip, q[3 + len(slip)] if self.curved else 0.0

    def forced(self, time: Any, state: Travel, below: Ground, q: tuple, v: tuple) -> Forced:
        flight, free, (slip, pivot) = state.flight, below.free, self.inner(q)
        n, x, turn = below.face.normal, q[:3], rolling.NONE
        still = free.spin
        if self.curved:
            on, floor = phase_of(state) >= 0, self.scene.choice(phase_of(state))
            n, turn = self.floors.turning(floor, x, v, time, [seam[0] for seam in below.seams])
            n, turn = where_vector(on, n, _UP), where_vector(on, turn, rolling.NONE)
            still = where_vector(below.rolls, scale(pivot, n), free.spin)
        if self.scene.air is not None:  # a ball that rolls turns as it goes
            turning = subtract(v, slip) if slip else v
            flight = flight._replace(spin=add(still, scale(free.turning, cross(n, turning))))
        _, a = self.scene.derivative(time, flight, x, v)
        into = dot(n, a)
        along = subtract(a, scale(free.held * into, n))
        if not self.curved:
            return Forced(n, turn, into, along, rolling.NONE)
        twist = rolling.twist(self.scene.ball.radius, pivot, n, turn)
        return Forced(n, turn, plus(into, dot(turn, v)), along, where_vector(below.rolls, twist, rolling.NONE))

    def braked(self, below: Ground, forced: Forced, v: tuple) -> Vector3:
        """By how much resistance slows a ball that rolls."""
        brake = below.brake
        assert brake is not None
        share, heading = ratio(1.0, 1.0 + self.scene.ball.inertia_ratio), brake.heading
        if not self.parabolic:
            kept = rolling.carried(forced.normal, heading) if self.curved else heading
            heading = where_vector(brake.straight, kept, rolling.later_heading(v, heading))
        most = brake.coefficient * -forced.push
        against = scale(most, heading)
        driven = scale(share, add(forced.along, scale(self.scene.ball.inertia_ratio, forced.twist)))
        if not self.parabolic:
            ends = add(driven, scale(rolling.decay(heading, driven, most), heading))
            against = where_vector(brake.straight & (dot(heading, heading) > 0), ends, against)
        return where_vector(brake.holds, driven, against)

    def slip_rate(self, below: Ground, slip: Vector3, along: Vector3, forced: Forced) -> Vector3:
        """The rate of the slip, zero for a ball that does not slide against friction; `along` drives it."""
        slides, heading = dot(below.heading, below.heading) > 0, below.heading
        assert below.friction is not None
        most = where(slides, below.friction, 0.0) * -forced.push
        most = most * (1.0 + 1.0 / self.scene.ball.inertia_ratio)
        kept = rolling.carried(forced.normal, heading) if self.curved else heading
        rate = scale(dot(along, kept) - most, kept)
        if not self.parabolic:
            towards = rolling.later_heading(slip, heading)
            if self.follows_hold:
                # A slip that has just begun follows what drives it, faster than an explicit solver can.
                begins = (dot(along, heading) > most - self._balance(most)) & (norm(slip) <= self.tolerance**0.5)
                towards = where_vector(begins, scale(ratio(1.0, norm(along)), along), towards)
            turning = subtract(along, scale(most, towards))
            rate = where_vector(below.straight, scale(-rolling.decay(kept, along, most), kept), turning)
        return where_vector(slides, rate, rolling.NONE)
