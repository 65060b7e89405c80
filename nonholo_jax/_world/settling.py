"""Where a ball may stay after its last bounce, and what happens when it crosses a contact there or comes to rest."""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
import numpy as np

from .._impact import AbstractContactLaw, Contact, along_surface, rolling, train
from .._math import (
    KINDS,
    RESULTS,
    Choice,
    Number,
    Vector3,
    add,
    components,
    cross,
    dot,
    is_constant,
    minimum,
    norm,
    ratio,
    scale,
    subtract,
    times,
    where,
    where_vector,
)
from .scene import Flight, Scene
from .surface import AbstractSurface, Face
from .system import Meeting, magnitude, rounding
from .touching import Member, Neighbours, Stack, Support, neighbours, numbers_of as _numbers


def _can_settle(surface: AbstractSurface) -> bool:
    """Whether a ball may roll or slide on a surface after its last bounce, as far as is known when it is traced."""
    flat = type(surface).face is not AbstractSurface.face
    elastic = is_constant(surface.law.restitution) and surface.law.restitution == 1
    return flat and surface.law.rolls is not None and not elastic


class Floors:
    """The surfaces of `scene` to stay on. Where a choice is none of them, what it gets are harmless numbers."""

    def __init__(self, scene: Scene):
        kinds = [each.first if isinstance(each, Stack) else each for each in scene.surfaces]
        self.indices = [i for i, surface in enumerate(kinds) if _can_settle(surface)]
        self._ball, floors = scene.ball, [kinds[i] for i in self.indices]
        # Whether a ball may slide against friction, so that its slip is followed.
        self.have_friction = any(surface.law.sliding_friction() is not None for surface in floors)
        self.have_edges = any(surface.has_edges for surface in floors)

    def include(self, contact: Choice) -> Any:
        return contact.among(self.indices)

    def _of(self, contact: Choice, function: Callable[[AbstractSurface], Any]) -> Any:
        return contact.of([function(contact.members[i].surface) for i in self.indices], self.indices)

    def face(self, contact: Choice, x: Vector3, time: Any) -> tuple[Face, Any]:
        """The face below a ball on that surface, and whether it has edges."""
        faces: list[Any] = [contact.members[i].surface.face(x, time) for i in self.indices]
        half = [(1.0, 1.0) if face.half is None else face.half for face in faces]
        vector = lambda options: contact.vector(options, self.indices)  # noqa: E731
        below = contact.of([jnp.asarray(face.below) for face in faces], self.indices)
        tangents = (vector([face.tangents[0] for face in faces]), vector([face.tangents[1] for face in faces]))
        centers, normals = vector([face.center for face in faces]), vector([face.normal for face in faces])
        edged = contact.among([i for i, face in zip(self.indices, faces, strict=True) if face.half is not None])
        return Face(normals, centers, tangents, vector(half), below), edged

    def rolls(self, contact: Choice) -> Any:
        """Whether a ball rolls on that surface, perhaps after sliding."""
        return self._of(contact, lambda surface: _rolls(surface.law))

    def friction(self, contact: Choice) -> Number:
        """The coefficient on that surface; infinite where a ball never slides or never rolls."""
        return self._of(contact, lambda surface: _friction(surface.law))

    def law(self, contact: Choice) -> Contact:
        """What trains need of that surface."""
        return Contact(
            self._of(contact, lambda surface: surface.law.restitution),
            self._of(contact, lambda surface: surface.law.reversal()),
            self.friction(contact) if self.have_friction else None,
            self.rolls(contact),
            self._ball.inertia_ratio,
            self._ball.radius,
        )


def _friction(law: AbstractContactLaw) -> Number:
    friction = law.sliding_friction()
    return jnp.inf if friction is None else friction


def _rolls(law: AbstractContactLaw) -> Any:
    return bool(law.rolls) if law.sliding_friction() is None else _friction(law) > 0


class Freedom(NamedTuple):
    """What a support leaves of a ball's motion: with the acceleration a and the normal n, share (a - held (n . a) n);
    the spin at the velocity v is spin + turning (n x v)."""

    held: Any  # 1 on a face, else 0
    share: Any  # 1 / (1 + alpha) for a ball that rolls, else 1
    spin: Vector3
    turning: Any


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
    flush: Neighbours | None = None  # the faces that are flush with it, if there can be any


class Travel(NamedTuple):
    """A ball's state inside the engine, with the phase that it is in."""

    flight: Flight
    support: Any  # index of the surface that the ball stays on, -1 in flight; a float, as all of a state is
    below: Ground | None = None  # only while an arc is worked on


def phase_of(state: Travel) -> Any:
    return jnp.asarray(state.support).astype(jnp.int32)


class Touch(NamedTuple):
    """A ball that crosses a contact, and what is below it: the face that it is on, or else that of the surface that it
    hits."""

    contact: Choice
    time: Any
    state: Travel
    normal: Vector3  # of what is hit
    struck: Flight  # the ball after an ordinary impact
    pull: Vector3  # gravity, and what air gives then
    floor: Choice
    face: Face
    edged: Any
    first: train.Start  # of the train that begins
    law: train.Contact
    slips: Any  # whether all impacts of the train slip
    grips: Any  # whether all of them grip
    on: Any  # whether the ball was on a face before, and is not thrown off it
    onto: Any  # the surface onto which it passes, or -1; `None` where no faces are flush


class Settling(NamedTuple):
    """What a ball does that stays on a face of a scene. `tolerance` and `parabolic` are those of `Grounded`."""

    scene: Scene
    tolerance: float
    parabolic: bool
    floors: Floors
    joins: bool  # whether faces may be flush

    @property
    def end_of_slip(self) -> int:
        """The contact at which a slip has died out, behind the surfaces and, where some of them have faces with edges,
        the two pairs of edges of the face below."""
        return self.scene.n_contacts + 2 * self.floors.have_edges

    def ground(self, time: Any, state: Travel) -> Ground:
        flight, floors, on = state.flight, self.floors, state.support >= 0
        support = self.scene.choice(phase_of(state))
        face, edged = floors.face(support, flight.position, time)
        edged, rolls, ball, n = on & edged, on & floors.rolls(support), self.scene.ball, face.normal
        share = where(rolls, ratio(1.0, 1.0 + ball.inertia_ratio), 1.0)
        pivot = where_vector(rolls, scale(dot(n, flight.spin), n), flight.spin)
        free = Freedom(where(on, 1.0, 0.0), share, pivot, where(rolls, ratio(1.0, ball.radius), 0.0))
        flush = self._flush(time, state, n) if self.joins else None
        if not floors.have_friction:
            return Ground(face, edged, rolls, None, free, rolling.NONE, rolling.NONE, True, flush)
        friction = floors.friction(support)
        slides = rolls & jnp.isfinite(friction)
        slip = rolling.own_slip(ball.radius, n, flight.velocity, flight.spin)
        slip = where_vector(slides, slip, rolling.NONE)
        a = self.pull(time, flight)
        most = where(slides, friction, 0.0) * -dot(a, n) * (1.0 + 1.0 / ball.inertia_ratio)
        along = rolling.along_surface(n, a)
        heading = where_vector(slides, rolling.heading(slip, along, most), rolling.NONE)
        straight = self.parabolic or rolling.stays_straight(heading, slip, along, most, self.tolerance)
        return Ground(face, edged, rolls, friction, free, slip, heading, straight, flush)

    def _flush(self, time: Any, state: Travel, n: Vector3) -> Neighbours:
        """The faces that are flush with the one that the ball is on, that itself left out."""
        found = neighbours(self.scene, time, n, self.scene.ball.radius, state.flight)
        other = (_numbers(self.scene) != phase_of(state)) & (state.support >= 0)
        return found._replace(flush=found.flush & other)

    def _onto(self, index: Any, found: Neighbours, time: Any) -> Any:
        """The surface onto which a ball passes that comes to the contact of that index, an edge of its support or a
        flush face; or -1."""
        is_met = found.flush & (_numbers(self.scene) == index)
        reached, least = found.flush & found.holds | is_met, float(jnp.finfo(time.dtype).min)
        best = jnp.argmax(jnp.where(reached, jnp.maximum(found.ahead, least), -jnp.inf)).astype(jnp.int32)
        over = (index >= self.scene.n_contacts) & (index != self.end_of_slip)
        return where((over | jnp.any(is_met)) & jnp.any(reached), best, np.int32(-1))

    def pull(self, time: Any, flight: Flight) -> Vector3:
        """Gravity, and what air gives now."""
        _, a = self.scene.derivative(time, flight, flight.position, flight.velocity)
        return a

    def support(self, state: Travel) -> Support:
        """What the ball stays on, for an impact on something else."""
        floors, index = self.floors, phase_of(state)
        floor = self.scene.choice(index)
        return Support(index, floors.friction(floor) if floors.have_friction else None, floors.rolls(floor))

    def touch(
        self, contact: Choice, time: Any, state: Travel, n: Vector3, struck: Flight, pull: Vector3, stays: Any
    ) -> Touch:
        """`stays` says whether a ball that was on a face before an impact is there afterwards."""
        floors, on = self.floors, (state.support >= 0) & (stays | (contact.index >= self.scene.n_contacts))
        onto = None
        if self.joins:  # on a face that is flush with its support it is no less on that
            face, _ = floors.face(self.scene.choice(phase_of(state)), state.flight.position, time)
            onto = self._onto(contact.index, self._flush(time, state, face.normal), time)
            on = on | (onto >= 0)
        floor = self.scene.choice(where(on, phase_of(state), contact.index))
        face, edged = floors.face(floor, state.flight.position, time)
        first = train.start(struck.velocity, struck.spin, face.normal, pull, self.scene.ball.radius)
        law = floors.law(floor)
        slips, grips = self._regime(first, law)
        return Touch(contact, time, state, n, struck, pull, floor, face, edged, first, law, slips, grips, on, onto)

    def _regime(self, first: train.Start, law: train.Contact) -> tuple[Any, Any]:
        """Whether all impacts of a train slip, and whether all of them grip."""
        if law.friction is None:
            return False, True
        limited = law.rolls & jnp.isfinite(law.friction)
        tolerance = jnp.inf if self.parabolic else self.tolerance  # a path that bends has a name of its own
        slips = limited & train.slips_throughout(first, law, tolerance)
        return slips, ~limited | (train.grips_throughout(first, law) & ~slips)

    def _room(self, touch: Touch) -> Number:
        """How far the centre can go from a place on a surface without meeting another, or the face's edge."""
        radius, x, face = self.scene.ball.radius, touch.struck.position, touch.face
        room: Number = jnp.inf
        if self.floors.have_edges:
            assert face.half is not None
            for across, half in zip(face.tangents, face.half, strict=True):
                margin = half - abs(dot(across, subtract(x, face.center)))
                room = minimum(room, where(touch.edged, margin, jnp.inf))

        flush = None
        if self.joins:
            flush = neighbours(self.scene, touch.time, face.normal, radius, touch.struck).flush

        def clear(other: Member) -> Number:
            own: Any = touch.floor.index == other.number
            own = own if flush is None else own | flush[other.number]
            return where(own, jnp.inf, other.surface.clearance(x, touch.time, radius))

        for each in self.scene.contacts():
            room = minimum(room, clear(each) if isinstance(each, Member) else jnp.min(each[1].each(each[0], clear)))
        return room

    def _sums(self, touch: Touch) -> tuple[Any, Any, Any]:
        """How long the train lasts, whether it is clear of other surfaces and of edges until it ends, and whether it
        has a sum: air changes nothing, and all impacts are of one kind."""
        first, struck = touch.first, touch.struck
        lasts = train.duration(first, touch.law.restitution)
        lasts_known = where(jnp.isfinite(lasts), lasts, 0.0)
        height = ratio(first.rise * first.rise, 2.0 * first.pull)
        clear = train.span(first, lasts_known) + height < self._room(touch)
        calm: Any = True
        if self.scene.air is not None:  # its force now is part of the sum; what matters is how that changes
            end = train.summed(first, touch.law, touch.slips)
            later = self.pull(touch.time, struck._replace(velocity=end.velocity, spin=end.spin))
            calm = norm(subtract(touch.pull, later)) * lasts_known <= self.tolerance
        if struck.orientation is not None:  # infinitely many rotations have no sum
            calm = False
        return lasts, clear, calm & (touch.slips | touch.grips)

    def train_of(self, touch: Touch, kind: KINDS) -> tuple:
        """What a train is summed from, in an impact of a known kind: one that lies down does not bounce."""
        first = touch.first
        return first._replace(rise=where(kind == KINDS.train, first.rise, 0.0)), touch.law, touch.slips

    def meets(self, touch: Touch, left: Any, rests: Any, ends: Any) -> Meeting:
        contact, on, first, law = touch.contact, touch.on, touch.first, touch.law
        is_exit, grips = contact.index >= self.scene.n_contacts, contact.index == self.end_of_slip
        is_floor = self.floors.include(contact) & touch.face.below & (first.pull > 0)
        lasts, clear, sums = self._sums(touch)
        capped = law.rolls & jnp.isfinite(jnp.inf if law.friction is None else law.friction)
        small = rests & ~capped  # whatever it is, it is taken for a train
        dies_out = is_floor & (lasts <= left) & (small | (clear & sums))
        moves = dot(first.slip, first.slip) + dot(first.along, first.along) > 0
        endless = dies_out & law.rolls & ~capped & (abs(law.reversal) == 1) & (law.restitution < 1) & moves
        lies = is_floor & where(capped, ends, rests)

        # Beside a wall a ball lies down where it is: what it goes during its last bounces could take it through.
        bounce_or_end = KINDS.where(dies_out & clear, KINDS.train, KINDS.where(lies, KINDS.rolling, KINDS.bounce))
        over = KINDS.where(grips, KINDS.gripped, KINDS.left)
        kind = KINDS.where(on, KINDS.where(is_exit, over, KINDS.rolling), bounce_or_end)
        passes = touch.onto >= 0 if self.joins else False
        kind = KINDS.where(passes, KINDS.passed, kind) if self.joins else kind

        end = train.summed(*self.train_of(touch, kind))
        after, pause, wedged, is_at_rest = self.settled(touch, kind, end)
        stuck = ~is_exit & where(on, rests & ~wedged, ends & ~is_floor)
        stuck = stuck & ~passes if self.joins else stuck
        fault = RESULTS.where(stuck, RESULTS.sustained_contact, RESULTS.reached_t1)
        fault = RESULTS.where(~on & endless, RESULTS.no_limit, fault)
        tips = on & is_exit & ~grips & self._tips(touch)
        fault = RESULTS.where(tips & ~passes if self.joins else tips, RESULTS.pivoting, fault)
        if self.floors.have_friction and self.parabolic:
            below, pull = self.ground(touch.time, after), self.pull(touch.time, after.flight)
            straight = rolling.is_straight(below.heading, rolling.along_surface(below.face.normal, pull), norm(pull))
            bends = (after.support >= 0) & ~straight
            fault = RESULTS.where(bends, RESULTS.curved_slide, fault)
        return Meeting(kind, fault, after, pause, is_at_rest)

    def _tips(self, touch: Touch) -> Any:
        """Whether a ball that comes to an edge is too slow to fly off: v^2 < g_n r, v across the edge."""
        second = touch.contact.index > self.scene.n_contacts
        across = where_vector(second, touch.face.tangents[1], touch.face.tangents[0])
        speed = dot(across, touch.state.flight.velocity)
        pull = times(-1.0, dot(touch.face.normal, components(self.scene.gravity)))
        return speed * speed < pull * self.scene.ball.radius * (1.0 + 1e-5)

    def settled(self, touch: Touch, kind: KINDS, end: train.End) -> tuple[Travel, Any, Any, Any]:
        """The state after an impact of that kind, how many seconds have passed, whether all that is left of the motion
        is impacts in a groove, and whether nothing moves any more."""
        flight, on, struck, n = touch.state.flight, touch.on, touch.struck, touch.face.normal
        is_train, rolls, left, grips = (
            kind == each for each in (KINDS.train, KINDS.rolling, KINDS.left, KINDS.gripped)
        )
        settles, stays = ~on & (is_train | rolls), on & (rolls | grips)
        kept = struck.velocity, struck.spin
        if self.floors.have_friction:
            ball = self.scene.ball
            velocity, spin = rolling.gripped(ball.radius, ball.inertia_ratio, n, flight.velocity, flight.spin)
            kept = where_vector(grips, velocity, kept[0]), where_vector(grips, spin, kept[1])
        held, pull = self._held(touch)
        wedged = self._is_wedged(touch, held, pull)
        kept = [where_vector(wedged, rolling.NONE, x) for x in kept]

        velocity = where_vector(left, flight.velocity, where_vector(stays, kept[0], struck.velocity))
        spin = where_vector(left, flight.spin, where_vector(stays, kept[1], struck.spin))
        after = flight._replace(
            position=where_vector(settles, add(flight.position, end.shift), flight.position),
            velocity=where_vector(settles, end.velocity, velocity),
            spin=where_vector(settles & touch.law.rolls, end.spin, spin),
        )
        surface = touch.contact.index.astype(jnp.asarray(touch.state.support).dtype)
        support = where(settles, surface, where(stays, touch.state.support, -1.0))
        if self.joins:
            passed, onto = kind == KINDS.passed, touch.onto
            support = where(passed, onto.astype(support.dtype), support)
            after = self._passed(passed, onto, touch, after)
        at_rest = (settles | stays) & self._is_still(touch, after, held)
        return Travel(after, support), where(settles, end.time, 0.0), wedged, at_rest

    def _passed(self, passed: Any, onto: Any, touch: Touch, after: Flight) -> Flight:
        """The state of a ball that has passed onto a flush face: as it was, but where it cannot slip it rolls."""
        flight, ball, floor = touch.state.flight, self.scene.ball, self.scene.choice(onto)
        state = flight.velocity, flight.spin
        rolling_ = rolling.gripped(ball.radius, ball.inertia_ratio, touch.face.normal, *state)
        firm = self.floors.rolls(floor) & ~jnp.isfinite(self.floors.friction(floor))
        kept = [where_vector(passed, where_vector(firm, a, b), c)
                for a, b, c in zip(rolling_, state, (after.velocity, after.spin), strict=True)]  # fmt: skip
        return after._replace(position=where_vector(passed, flight.position, after.position), velocity=kept[0],
                              spin=kept[1])  # fmt: skip

    def _is_still(self, touch: Touch, after: Flight, held: Any) -> Any:
        """Whether nothing moves any more, nor will."""
        eps = float(jnp.finfo(touch.time.dtype).eps)
        size: Callable = lambda flight: norm(flight.velocity) + self.scene.ball.radius * norm(flight.spin)  # noqa: E731
        along = rolling.along_surface(touch.face.normal, components(self.scene.gravity))
        is_level = (norm(along) <= 64.0 * eps * norm(components(self.scene.gravity))) & (self.scene.air is None)
        return (size(after) <= 64.0 * eps * size(touch.state.flight)) & (is_level | held)

    def _held(self, touch: Touch) -> tuple[Any, Number]:
        """Whether gravity holds a ball on its support against another surface, into that surface and not along the
        groove between the two; and the acceleration with which it does so."""
        g, groove = components(self.scene.gravity), cross(touch.face.normal, touch.normal)
        pull = times(-1.0, dot(touch.normal, rolling.along_surface(touch.face.normal, g)))
        eps = float(jnp.finfo(touch.time.dtype).eps)
        held = (pull > 0) & (abs(dot(g, groove)) <= 64.0 * eps * norm(g)) & (self.scene.air is None)
        return held & touch.on & (touch.contact.index < self.scene.n_contacts), pull

    def _is_wedged(self, touch: Touch, held: Any, pull: Number) -> Any:
        """Whether all that is left of the motion of a ball in a groove is impacts on a surface beside its support, from
        which it moves off by less than rounding."""
        flight = touch.state.flight
        closing, size = dot(touch.normal, flight.velocity), magnitude(flight.position)
        surfaces = [each for each in touch.contact.members if isinstance(each, Member)]
        noises = [rounding(self.scene, each, size, touch.time.dtype) for each in surfaces]
        creeps = norm(flight.velocity) + self.scene.ball.radius * norm(flight.spin) <= 64.0 * abs(closing)
        small = closing * closing <= 4.0 * pull * touch.contact.of(noises)
        return held & creeps & small

    def during(self, contact: Choice, time: Any, state: Travel, elapsed: Any) -> Travel:
        """The state so long after the first impact of a train."""
        n, struck, _ = self.scene.struck(contact, time, state.flight)
        touch = self.touch(contact, time, state._replace(support=-1.0), n, struck, self.pull(time, struck), False)
        first, law = touch.first, touch.law
        last = train.bounced(first, law, touch.slips, train.bounces_within(first, law.restitution, elapsed))
        velocity = add(last.velocity, scale(last.rise, first.normal))
        since = jnp.maximum(elapsed - last.time, 0.0)
        fall = add(scale(since, velocity), scale(0.5 * since * since, touch.pull))
        position = add(add(struck.position, last.shift), fall)
        spin = where_vector(law.rolls, last.spin, struck.spin)
        velocity = add(velocity, scale(since, touch.pull))
        return Travel(struck._replace(position=position, velocity=velocity, spin=spin), -1.0)


def slides_across(scene: Scene) -> bool:
    """Whether a ball is known now, not only when the program runs, to meet a slope that it may slide across."""
    if any(isinstance(leaf, jax.core.Tracer) or np.ndim(leaf) > 1 for leaf in jax.tree.leaves(scene)):
        return False
    # As numbers of Python, on which every operation of JAX would be a program of its own to compile.
    known = functools.partial(jax.tree.map, lambda x: float(x) if eqx.is_inexact_array(x) and x.ndim == 0 else x)
    if all(known(surface.law).sliding_friction() is None for surface in scene.surfaces):
        return False
    scene = known(scene)
    with jax.ensure_compile_time_eval():  # known numbers, also within a transformation
        return _meets_slope(scene)


def _meets_slope(scene: Scene) -> bool:
    g = components(scene.gravity)
    above = scale(ratio(-1e6, norm(g)), g)
    for surface in scene.surfaces:
        face = surface.face(above, 0.0) if _can_settle(surface) else None
        if face is not None and surface.law.sliding_friction() is not None:
            steep = norm(along_surface(face.normal, g)) > 1e-6 * norm(g)
            if bool(steep) and bool(dot(face.normal, g) < 0):
                return True
    return False
