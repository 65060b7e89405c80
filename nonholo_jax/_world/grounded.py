"""A scene in which bounces may die out: the ball then rolls on (or, where there is no friction, slides), meets walls,
and leaves faces over their edges. Rolling is a phase of the same motion, on the same loop and in the same log."""

import dataclasses
from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
from jax import lax

from .._impact import rolling, train
from .._math import (
    KINDS,
    RESULTS,
    Choice,
    Hopper,
    Number,
    Vector3,
    add,
    components,
    cross,
    dot,
    minimum,
    norm,
    ratio,
    rolled,
    scale,
    subtract,
    times,
    where,
    where_vector,
)
from .floors import Floors
from .round import round_bend, round_level
from .scene import Flight, Scene
from .stack import Member
from .surface import Face
from .system import AbstractSystem, Meeting, bounces, magnitude, rounding


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


class Travel(NamedTuple):
    """A ball's state inside the engine, with the phase that it is in."""

    flight: Flight
    support: Any  # index of the surface that the ball stays on, -1 in flight; a float, as all of a state is
    below: Ground | None = None  # only while an arc is worked on


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

    @property
    def on(self) -> Any:
        """Whether the ball was on a face before."""
        return self.state.support >= 0


def _if_any(condition: Any, wanted: Callable, plain: Callable) -> Any:
    """`wanted()` if a condition holds in any lane of a batch: otherwise `plain()`, which must be equal then."""
    return lax.cond(eqxi.unvmap_any(condition), wanted, plain)


class Grounded(AbstractSystem):
    """A scene with the motion after the last bounce. `tolerance` is the velocity in m/s that what has no sum may change
    during a train that is summed; `parabolic` says that arcs must be parabolas. Where a surface has a coefficient of
    friction, the slip is part of the configuration, and its end is a contact."""

    scene: Scene
    tolerance: float = eqx.field(static=True)
    parabolic: bool = eqx.field(static=True)
    hits: bool = eqx.field(static=True)
    is_long: ClassVar[bool] = False

    def __init__(self, scene: Scene, tolerance: float = 0.0, parabolic: bool = False, hits: bool = True):
        self.scene, self.tolerance, self.parabolic, self.hits = scene, tolerance, parabolic, hits

    @property
    def names(self) -> tuple[str, ...]:
        return self.scene.names

    @property
    def _floors(self) -> Floors:
        return Floors(self.scene)

    @property
    def _n_surfaces(self) -> int:
        return self.scene.n_contacts

    @property
    def _end_of_slip(self) -> int:
        """The contact at which a slip has died out, behind the surfaces and, where some of them have faces with edges,
        the two pairs of edges of the face below."""
        return self._n_surfaces + 2 * self._floors.have_edges

    @property
    def n_contacts(self) -> int:  # pyright: ignore[reportIncompatibleVariableOverride]
        return (self._end_of_slip + self._floors.have_friction) if self.hits else 0

    def engine(self, dtype):
        return dataclasses.replace(self, scene=self.scene.engine(dtype))

    def _others(self) -> list[int]:
        """The contacts behind the surfaces."""
        return list(range(self._n_surfaces, self.n_contacts))

    def contacts(self):
        return [*(self.scene.contacts() if self.hits else []), *self._others()]

    def choice(self, index):
        surfaces = self.scene.choice(index)
        surfaces.extend(self._n_surfaces, self._others())
        return surfaces

    # Smooth motion

    def evolving(self, state: Travel):
        position, velocity = self.scene.evolving(state.flight)
        if not self._floors.have_friction:
            return position, velocity
        return (*position, *(rolling.NONE if state.below is None else state.below.slip)), velocity

    def is_uniform(self):
        return self.scene.is_uniform()

    def prepared(self, time, state):
        return state._replace(below=self._ground(time, state))

    def _ground(self, time: Any, state: Travel) -> Ground:
        flight, floors, on = state.flight, self._floors, state.support >= 0
        support = self.scene.choice(self.phase(state))
        face, edged = floors.face(support, flight.position, time)
        edged, rolls, ball, n = on & edged, on & floors.rolls(support), self.scene.ball, face.normal
        share = where(rolls, ratio(1.0, 1.0 + ball.inertia_ratio), 1.0)
        pivot = where_vector(rolls, scale(dot(n, flight.spin), n), flight.spin)
        free = Freedom(where(on, 1.0, 0.0), share, pivot, where(rolls, ratio(1.0, ball.radius), 0.0))
        if not floors.have_friction:
            return Ground(face, edged, rolls, None, free, rolling.NONE, rolling.NONE, True)
        friction = floors.friction(support)
        slides = rolls & jnp.isfinite(friction)
        slip = rolling.own_slip(ball.radius, n, flight.velocity, flight.spin)
        slip = where_vector(slides, slip, rolling.NONE)
        a = self._pull(time, flight)
        most = where(slides, friction, 0.0) * -dot(a, n) * (1.0 + 1.0 / ball.inertia_ratio)
        along = rolling.along_surface(n, a)
        heading = where_vector(slides, rolling.heading(slip, along, most), rolling.NONE)
        straight = self.parabolic or rolling.stays_straight(heading, slip, along, most, self.tolerance)
        return Ground(face, edged, rolls, friction, free, slip, heading, straight)

    def derivative(self, time, state, q, v):
        flight, below = state.flight, self._below(time, state)
        n, free, (q, slip) = below.face.normal, below.free, (q[:3], q[3:])
        if self.scene.air is not None:  # a ball that rolls turns as it goes
            turning = subtract(v, slip) if slip else v
            flight = flight._replace(spin=add(free.spin, scale(free.turning, cross(n, turning))))
        _, a = self.scene.derivative(time, flight, q, v)
        push = dot(n, a)
        rate = subtract(a, scale(free.held * push, n))
        if not slip:
            return v, scale(free.share, rate)
        changes = self._slip_rate(below, slip, rate, push)
        # Friction leaves v + alpha r (omega x n) alone, so that (1 + alpha) v - alpha u changes by gravity only.
        with_slip = scale(free.share, add(rate, scale(self.scene.ball.inertia_ratio, changes)))
        return (*v, *changes), where_vector(below.rolls, with_slip, scale(free.share, rate))

    def _slip_rate(self, below: Ground, slip: Vector3, along: Vector3, push: Number) -> Vector3:
        """The rate of the slip, zero for a ball that does not slide against friction."""
        slides, heading = dot(below.heading, below.heading) > 0, below.heading
        assert below.friction is not None
        most = where(slides, below.friction, 0.0) * -push
        most = most * (1.0 + 1.0 / self.scene.ball.inertia_ratio)
        rate = scale(dot(along, heading) - most, heading)
        if not self.parabolic:
            turning = subtract(along, scale(most, rolling.later_heading(slip, heading)))
            rate = where_vector(below.straight, rate, turning)
        return where_vector(slides, rate, rolling.NONE)

    def advanced(self, time, state, q, v, duration):
        flight = self.scene.advanced(time, state.flight, q[:3], v, duration)
        below = self._below(time, state)
        n, free, orientation = below.face.normal, below.free, flight.orientation
        spin = add(free.spin, scale(free.turning, cross(n, subtract(v, q[3:]) if q[3:] else v)))
        if orientation is not None:
            turning = subtract(state.flight.velocity, below.slip)
            before = add(free.spin, scale(free.turning, cross(n, turning)))
            turned = rolled(state.flight.orientation, before, spin, duration, orientation.dtype)
            orientation = jnp.where(below.rolls, turned, orientation)
        return Travel(flight._replace(spin=spin, orientation=orientation), state.support)

    # Contacts

    def phase(self, state):
        return jnp.asarray(state.support).astype(jnp.int32)

    def named(self, contact, state):
        return where(contact.index >= self._n_surfaces, self.phase(state), contact.index)

    def _below(self, time: Any, state: Travel) -> Ground:
        return self._ground(time, state) if state.below is None else state.below

    def _exit(self, contact: int, state: Travel, time: Any) -> tuple[Vector3, Vector3, Number, Any]:
        """Along one pair of edges: across, middle, half size, and whether there are such edges."""
        below = self._below(time, state)
        assert below.face.half is not None
        k = contact - self._n_surfaces  # of the two
        return below.face.tangents[k], below.face.center, below.face.half[k], below.edged

    def level(self, contact, time, q, state):
        x = q[:3]
        if isinstance(contact, Member):
            on = state.support == contact.number
            return where(on, 1.0, self.scene.level(contact, time, x, state.flight))
        if contact == self._end_of_slip:
            heading = self._below(time, state).heading
            return where(dot(heading, heading) > 0, dot(heading, q[3:]), 1.0)
        across, middle, half, present = self._exit(contact, state, time)
        y = dot(across, subtract(x, middle))
        return where(present, round_level((y,), half, True), 1.0)

    def is_parabolic(self, contact):
        return self.scene.is_parabolic(contact) if isinstance(contact, Member) else contact == self._end_of_slip

    def returns(self, contact, time, q, v, half_a):
        if not isinstance(contact, Member):
            return None
        return self.scene.returns(contact, time, q[:3], v[:3], half_a[:3])

    def reach(self, contact, q):
        return self.scene.reach(contact, q[:3]) if isinstance(contact, Member) else self.scene.ball.radius

    def bend(self, contact, time, window, state):
        place = window._replace(coefficients=window.coefficients[:3])
        if isinstance(contact, Member):
            bend, skip = self.scene.bend(contact, time, place, state.flight), state.support == contact.number
        elif contact == self._end_of_slip:
            heading = self._below(time, state).heading
            bend = window._replace(coefficients=window.coefficients[3:]).along(heading, rolling.NONE).bend
            skip = dot(heading, heading) == 0
        else:
            across, middle, half, present = self._exit(contact, state, time)
            bend, skip = round_bend(place, (across,), middle, half, True), ~present
        low, high = (where(skip, 0.0, x) for x in bend)
        return type(bend)(low, high)

    def is_bounded(self, contact):
        return contact >= self._n_surfaces or self.scene.is_bounded(contact)

    def extent(self, contact):
        return self.scene.extent(contact) if isinstance(contact, Member) else self.scene.ball.radius

    # What happens there

    def _pull(self, time: Any, flight: Flight) -> Vector3:
        """Gravity, and what air gives now."""
        _, a = self.scene.derivative(time, flight, flight.position, flight.velocity)
        return a

    def _touch(self, contact: Choice, time: Any, state: Travel, n: Vector3, struck: Flight, pull: Vector3) -> Touch:
        floors = self._floors
        floor = self.scene.choice(where(state.support >= 0, self.phase(state), contact.index))
        face, edged = floors.face(floor, state.flight.position, time)
        first = train.start(struck.velocity, struck.spin, face.normal, pull, self.scene.ball.radius)
        law = floors.law(floor)
        slips, grips = self._regime(first, law)
        return Touch(contact, time, state, n, struck, pull, floor, face, edged, first, law, slips, grips)

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
        if self._floors.have_edges:
            assert face.half is not None
            for across, half in zip(face.tangents, face.half, strict=True):
                margin = half - abs(dot(across, subtract(x, face.center)))
                room = minimum(room, where(touch.edged, margin, jnp.inf))

        def clear(other: Member) -> Number:
            return where(touch.floor.index == other.number, jnp.inf, other.surface.clearance(x, touch.time, radius))

        for each in self.scene.contacts():
            room = minimum(room, clear(each) if isinstance(each, Member) else jnp.min(each[1].each(each[0], clear)))
        return room

    def _sums(self, touch: Touch, end: train.End) -> tuple[Any, Any, Any]:
        """How long the train lasts, whether it is clear of other surfaces and of edges until it ends, and whether it
        has a sum: air changes nothing, and all impacts are of one kind."""
        first, struck = touch.first, touch.struck
        lasts = train.duration(first, touch.law.restitution)
        lasts_known = where(jnp.isfinite(lasts), lasts, 0.0)
        height = ratio(first.rise * first.rise, 2.0 * first.pull)
        clear = train.span(first, lasts_known) + height < self._room(touch)
        calm: Any = True
        if self.scene.air is not None:  # its force now is part of the sum; what matters is how that changes
            later = self._pull(touch.time, struck._replace(velocity=end.velocity, spin=end.spin))
            calm = norm(subtract(touch.pull, later)) * lasts_known <= self.tolerance
        if struck.orientation is not None:  # infinitely many rotations have no sum
            calm = False
        return lasts, clear, calm & (touch.slips | touch.grips)

    def _stays(self, touch: Touch) -> Any:
        """Whether a ball on its support stays on it when it hits a surface: Theorem 5.1 needs one common mu there, and
        a smooth wall turns the ball round."""
        rolls, stays = touch.on & self._floors.holds(touch.floor), []
        for surface in self.scene.chosen(touch.contact):
            law = surface.law
            common = bool(law.rolls) and law.sliding_friction() is None and law.reversal() == law.restitution
            stays.append(rolls & common if law.rolls else law.rolls is False)
        return touch.contact.of(stays)

    def bounced(self, contact, time, state):
        return Travel(self.scene.bounced(contact, time, state.flight), state.support)

    def meets(self, contact, time, state, left, rests, ends):
        n, struck = self.scene.struck(contact, time, state.flight)
        pull = self._pull(time, struck)
        rise, into, e_n = dot(n, struck.velocity), times(-1.0, dot(n, pull)), self.scene.restitution(contact)
        # Not later than `train.duration`, or nearly.
        soon = rests | (times(2.0, rise) <= 1.001 * left * times(into, 1.0 - e_n))
        soon = self._floors.include(contact) & (into > 0) & soon

        def plain() -> Meeting:
            return _as_arrays(bounces(ends, Travel(struck, -1.0)), time)

        def settling() -> Meeting:
            touch = self._touch(contact, time, state, n, struck, pull)
            return _as_arrays(self._settling(touch, left, rests, ends), time)

        return _if_any((state.support >= 0) | soon, settling, plain)

    def after(self, contact, time, state, kind):
        n, struck = self.scene.struck(contact, time, state.flight)

        def settled() -> tuple:
            touch = self._touch(contact, time, state, n, struck, self._pull(time, struck))
            return _as_arrays(self._settled(touch, kind, train.summed(*self._train_of(touch, kind)))[:2], time)

        plain = lambda: _as_arrays((Travel(struck, -1.0), 0.0), time)  # noqa: E731
        return _if_any((state.support >= 0) | (kind != KINDS.bounce), settled, plain)

    def _train_of(self, touch: Touch, kind: KINDS) -> tuple:
        """What a train is summed from, in an impact of a known kind: one that lies down does not bounce."""
        first = touch.first
        return first._replace(rise=where(kind == KINDS.train, first.rise, 0.0)), touch.law, touch.slips

    def _settling(self, touch: Touch, left: Any, rests: Any, ends: Any) -> Meeting:
        contact, on, first, law = touch.contact, touch.on, touch.first, touch.law
        is_exit, grips = contact.index >= self._n_surfaces, contact.index == self._end_of_slip
        is_floor = self._floors.include(contact) & touch.face.below & (first.pull > 0)
        lasts, clear, sums = self._sums(touch, train.summed(first, law, touch.slips))
        capped = law.rolls & jnp.isfinite(jnp.inf if law.friction is None else law.friction)
        small = rests & ~capped  # whatever it is, it is taken for a train
        dies_out = is_floor & (lasts <= left) & (small | (clear & sums))
        moves = dot(first.slip, first.slip) + dot(first.along, first.along) > 0
        endless = dies_out & law.rolls & ~capped & (abs(law.reversal) == 1) & (law.restitution < 1) & moves
        lies = is_floor & where(capped, ends, rests)

        # Beside a wall a ball lies down where it is: what it goes during its last bounces could take it through.
        bounce_or_end = KINDS.where(dies_out & clear, KINDS.train, KINDS.where(lies, KINDS.rolling, KINDS.bounce))
        wall = KINDS.where(self._stays(touch), KINDS.rolling, KINDS.bounce)
        over = KINDS.where(grips, KINDS.gripped, KINDS.left)
        kind = KINDS.where(on, KINDS.where(is_exit, over, wall), bounce_or_end)

        end = train.summed(*self._train_of(touch, kind))
        after, pause, wedged, is_at_rest = self._settled(touch, kind, end)
        stuck = ~is_exit & where(on, rests & ~wedged, ends & ~is_floor)
        fault = RESULTS.where(stuck, RESULTS.sustained_contact, RESULTS.reached_t1)
        fault = RESULTS.where(~on & endless, RESULTS.no_limit, fault)
        fault = RESULTS.where(on & is_exit & ~grips & self._tips(touch), RESULTS.pivoting, fault)
        if self._floors.have_friction and self.parabolic:
            below, pull = self._ground(touch.time, after), self._pull(touch.time, after.flight)
            straight = rolling.is_straight(below.heading, rolling.along_surface(below.face.normal, pull), norm(pull))
            bends = (after.support >= 0) & ~straight
            fault = RESULTS.where(bends, RESULTS.curved_slide, fault)
        return Meeting(kind, fault, after, pause, is_at_rest)

    def _tips(self, touch: Touch) -> Any:
        """Whether a ball that comes to an edge is too slow to fly off: v^2 < g_n r, v across the edge."""
        second = touch.contact.index > self._n_surfaces
        across = where_vector(second, touch.face.tangents[1], touch.face.tangents[0])
        speed = dot(across, touch.state.flight.velocity)
        pull = times(-1.0, dot(touch.face.normal, components(self.scene.gravity)))
        return speed * speed < pull * self.scene.ball.radius * (1.0 + 1e-5)

    def _settled(self, touch: Touch, kind: KINDS, end: train.End) -> tuple[Travel, Any, Any, Any]:
        """The state after an impact of that kind, how many seconds have passed, whether all that is left of the motion
        is impacts in a groove, and whether nothing moves any more."""
        flight, on, struck, n = touch.state.flight, touch.on, touch.struck, touch.face.normal
        is_train, rolls, left, grips = (
            kind == each for each in (KINDS.train, KINDS.rolling, KINDS.left, KINDS.gripped)
        )
        settles, stays = ~on & (is_train | rolls), on & (rolls | grips)
        kept = self._against(touch)
        if self._floors.have_friction:
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
        at_rest = (settles | stays) & self._is_still(touch, after, held)
        return Travel(after, support), where(settles, end.time, 0.0), wedged, at_rest

    def _is_still(self, touch: Touch, after: Flight, held: Any) -> Any:
        """Whether nothing moves any more, nor will."""
        eps = float(jnp.finfo(touch.time.dtype).eps)
        size: Callable = lambda flight: norm(flight.velocity) + self.scene.ball.radius * norm(flight.spin)  # noqa: E731
        along = rolling.along_surface(touch.face.normal, components(self.scene.gravity))
        is_level = (norm(along) <= 64.0 * eps * norm(components(self.scene.gravity))) & (self.scene.air is None)
        return (size(after) <= 64.0 * eps * size(touch.state.flight)) & (is_level | held)

    def _against(self, touch: Touch) -> tuple[Vector3, Vector3]:
        """Velocity and spin of a ball that stays on its support when it hits another surface; where there is friction
        it may slip afterwards."""
        ball, flight, n, wall = self.scene.ball, touch.state.flight, touch.face.normal, touch.normal
        mu = self.scene.restitution(touch.contact)
        velocity, spin = rolling.against_rough(
            ball.radius, ball.inertia_ratio, n, wall, mu, flight.velocity, flight.spin
        )
        laws = [surface.law for surface in self.scene.chosen(touch.contact)]
        if all(law.rolls is not False for law in laws):
            return velocity, spin
        smooth = touch.contact.of([law.rolls is False for law in laws])
        turned = rolling.against_smooth(n, wall, mu, flight.velocity)
        firm = touch.on & self._floors.holds(touch.floor)
        carried = where_vector(firm, rolling.rolling_spin(ball.radius, n, turned, flight.spin), flight.spin)
        return where_vector(smooth, turned, velocity), where_vector(smooth, carried, spin)

    def _held(self, touch: Touch) -> tuple[Any, Number]:
        """Whether gravity holds a ball on its support against another surface, into that surface and not along the
        groove between the two; and the acceleration with which it does so."""
        g, groove = components(self.scene.gravity), cross(touch.face.normal, touch.normal)
        pull = times(-1.0, dot(touch.normal, rolling.along_surface(touch.face.normal, g)))
        eps = float(jnp.finfo(touch.time.dtype).eps)
        held = (pull > 0) & (abs(dot(g, groove)) <= 64.0 * eps * norm(g)) & (self.scene.air is None)
        return held & touch.on & (touch.contact.index < self._n_surfaces), pull

    def _is_wedged(self, touch: Touch, held: Any, pull: Number) -> Any:
        """Whether all that is left of the motion of a ball in a groove is impacts on a surface beside its support, from
        which it moves off by less than rounding."""
        flight = touch.state.flight
        closing, size = dot(touch.normal, flight.velocity), magnitude(flight.position)
        surfaces = [each for each in touch.contact.members if isinstance(each, Member)]
        noises = [rounding(self, each, size, touch.time.dtype) for each in surfaces]
        creeps = norm(flight.velocity) + self.scene.ball.radius * norm(flight.spin) <= 64.0 * abs(closing)
        small = closing * closing <= 4.0 * pull * touch.contact.of(noises)
        return held & self._stays(touch) & creeps & small

    def during(self, contact, time, state, elapsed):
        """The state so long after the first impact of a train."""
        n, struck = self.scene.struck(contact, time, state.flight)
        touch = self._touch(contact, time, state._replace(support=-1.0), n, struck, self._pull(time, struck))
        first, law = touch.first, touch.law
        last = train.bounced(first, law, touch.slips, train.bounces_within(first, law.restitution, elapsed))
        velocity = add(last.velocity, scale(last.rise, first.normal))
        since = jnp.maximum(elapsed - last.time, 0.0)
        fall = add(scale(since, velocity), scale(0.5 * since * since, touch.pull))
        position = add(add(struck.position, last.shift), fall)
        spin = where_vector(law.rolls, last.spin, struck.spin)
        velocity = add(velocity, scale(since, touch.pull))
        return Travel(struck._replace(position=position, velocity=velocity, spin=spin), -1.0)

    # Where nothing settles

    def hopper(self, state):
        hopper = self.scene.hopper(state.flight)
        return None if hopper is None or hopper.again is None else Hopper(self._hop, self._hop_again)

    def _hop_again(self, touching, choice, left, state):
        duration, flight = self.scene.hop_again(touching, choice, left, state.flight)
        return duration, Travel(flight, state.support)

    def _hop(self, touching, going, full, left, state):
        def dies_out(i, wall, speed, left):
            """`train.duration` is at most `left`, or nearly, without its divisions."""
            if i not in self._floors.indices:
                return False
            e, pull = self.scene.surfaces[i].law.restitution, times(-2.0, wall.pull)
            return jnp.asarray(pull > 0) & (times(2.0 * e, speed) <= 1.001 * left * times(pull, 1.0 - e))

        done = self.scene.hop(touching, going, full, left, state.flight, dies_out)
        return done._replace(state=Travel(done.state, state.support))

    # Users' states

    def is_admissible(self, time, state):
        return self.scene.is_admissible(time, state.flight)

    def received(self, state, batch, t0):
        return self.scene.received(state, batch, t0)

    def unpacked(self, state, phase=None):
        flight = self.scene.unpacked(state)
        dtype = state.position.dtype
        support = jnp.asarray(-1.0, dtype=dtype) if phase is None else jnp.asarray(phase).astype(dtype)
        return Travel(flight, support)

    def packed(self, state):
        return self.scene.packed(state.flight)

    def contact_frame(self, contact, time, state):
        return self.scene.contact_frame(contact, time, state.flight)

    def without_contacts(self):
        return dataclasses.replace(self, hits=False)


def _as_arrays(tree: Any, time: Any) -> Any:
    """Numbers as arrays of the dtype of the time; codes and flags as arrays."""
    number = lambda x: x if eqx.is_array(x) and not jnp.issubdtype(x.dtype, jnp.inexact) else x.astype(time.dtype)  # noqa: E731
    return jax.tree.map(lambda x: jnp.asarray(x) if isinstance(x, bool) else number(jnp.asarray(x)), tree)


def grounded(scene: Scene, tolerance: float, parabolic: bool) -> Scene | Grounded:
    """A scene with the motion after the last bounce, if there can be a last one."""
    return Grounded(scene, tolerance, parabolic) if Floors(scene).indices else scene
