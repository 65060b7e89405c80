"""Where a ball may stay after its last bounce, and what happens when it crosses a contact there or comes to rest."""

import functools
import operator
from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np

from .._impact import rolling, train
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
    maximum,
    minimum,
    norm,
    ratio,
    scale,
    subtract,
    times,
    where,
    where_vector,
)
from .._world import (
    Flight,
    Meeting,
    Member,
    Neighbours,
    Support,
    along,
    magnitude,
    neighbours,
    numbers_of,
    rounding,
)
from .grooved import Grooved, Touch
from .ground import Travel, phase_of, second_of, support_of


def _foremost(found: Neighbours, which: Any) -> Any:
    """The index of the surface among those that lies most ahead."""
    least = float(jnp.finfo(found.ahead.dtype).min)
    return jnp.argmax(jnp.where(which, jnp.maximum(found.ahead, least), -jnp.inf)).astype(jnp.int32)


class Settling(Grooved):
    """What a ball does that comes to a surface to stay on, or meets something there."""

    def _onto(self, index: Any, found: Neighbours, time: Any) -> Any:
        """The surface onto which a ball passes that comes to the contact of that index, an edge of its support or a
        flush face; or -1."""
        is_met = found.flush & (numbers_of(self.scene) == index)
        reached = found.flush & found.holds | is_met
        best = _foremost(found, reached)
        over = (index >= self.scene.n_contacts) & (index < self.end_of_slip)
        return where((over | jnp.any(is_met)) & jnp.any(reached), best, np.int32(-1))

    def _held_by(self, contact: Choice, time: Any, struck: Flight) -> tuple[Any, Any]:
        """The index of what holds a ball after an impact with that contact: the surface that it hits; or a flush one,
        where the face that it hits ends beside it. That is then below the ball, to rounding."""
        face, _ = self.floors.face(contact, struck.position, time)
        found = neighbours(self.scene, time, face.normal, self.scene.ball.radius, struck)
        holds = found.flush & found.holds
        is_held = self.floors.include(contact) & ~face.below & jnp.any(holds)
        return where(is_held, _foremost(found, holds), contact.index), is_held

    def supports(self, state: Travel) -> tuple[Support, ...]:
        """What the ball stays on, for an impact on something else."""
        floors, found = self.floors, []
        for which in (phase_of, second_of)[: 1 + self.have_grooves]:
            index = which(state)
            floor = self.scene.choice(index)
            rolls = floors.rolls(floor)
            found.append(Support(index, floors.friction(floor) if floors.have_friction else None, rolls))
        return tuple(found)

    def _kept(self, contact: Choice, time: Any, state: Travel, stays: tuple[Any, ...]) -> tuple[Travel, Any]:
        """The state with the supports that a ball is on after an impact, and whether there are any."""
        any_, is_exit = functools.reduce(operator.or_, stays), contact.index >= self.scene.n_contacts
        if self.have_grooves:
            first, second = where(stays[0], phase_of(state), second_of(state)), where(stays[0], second_of(state), -1)
            kept = support_of(first, where(stays[1], second, -1), time.dtype)
            state = state._replace(support=where(any_ & ~is_exit & (second_of(state) >= 0), kept, state.support))
        return state, (state.support >= 0) & (any_ | is_exit)

    def touch(
        self,
        contact: Choice,
        time: Any,
        state: Travel,
        n: Vector3,
        struck: Flight,
        pull: Vector3,
        stays: tuple[Any, ...],
    ) -> Touch:
        """`stays` says on which of its supports a ball still is after an impact."""
        floors, onto, held_by, is_held = self.floors, None, contact.index, False
        state, on = self._kept(contact, time, state, stays)
        if self.joins:  # on a face that is flush with its support it is no less on that
            face, _ = floors.face(self.scene.choice(phase_of(state)), state.flight.position, time)
            onto = self._onto(contact.index, self._flush(time, state, face.normal), time)
            on = on | (onto >= 0)
            if not self.curved:
                held_by, is_held = self._held_by(contact, time, struck)
        floor, turn = self.scene.choice(where(on, phase_of(state), held_by)), None
        is_seam = self._is_seam(contact)
        if self.curved:
            x = where_vector(is_seam, self._beyond(time, state.flight), state.flight.position)
            state, struck = state._replace(flight=state.flight._replace(position=x)), struck._replace(position=x)
            pull = self.pull(time, struck, floor)
        face, edged = floors.face(floor, state.flight.position, time)
        if is_held is not False:
            face = face._replace(below=face.below | (is_held & ~on))
        first = train.start(struck.velocity, struck.spin, face.normal, pull, self.scene.ball.radius)
        if self.curved:
            _, turn = floors.turning(floor, struck.position, first.velocity, time)
            if onto is not None:
                onto = where(is_seam & (onto < 0) & (first.pull > 0), phase_of(state), onto)
        law = floors.law(floor)
        slips, grips = self._regime(first, law)
        entry = self.enter(contact, time, state, on, self.pull) if self.have_grooves else None
        return Touch(
            contact, time, state, n, struck, pull, floor, face, edged, first, law, slips, grips, on, onto, entry, turn
        )

    def struck(self, contact: Choice, time: Any, state: Travel) -> tuple[Vector3, Flight, tuple[Any, ...]]:
        """`Scene.struck`; without an impact at a contact that is no surface."""
        n, struck, stays = self.scene.struck(contact, time, state.flight, self.supports(state))
        if self.follows_hold:
            is_exit, free = contact.index >= self.scene.n_contacts, state.flight
            velocity, spin = (where_vector(is_exit, a, b)
                              for a, b in ((free.velocity, struck.velocity), (free.spin, struck.spin)))  # fmt: skip
            struck = struck._replace(velocity=velocity, spin=spin)
        return n, struck, stays

    def _is_seam(self, contact: Choice) -> Any:
        return (contact.index >= self.scene.n_contacts) & (contact.index < self.end_of_slip)

    def _beyond(self, time: Any, flight: Flight) -> Vector3:
        """A place so little further along that the difference is rounding, but surely beyond a seam that is reached."""
        eps, speed = float(jnp.finfo(time.dtype).eps), norm(flight.velocity)
        size = magnitude(flight.position) + self.scene.ball.radius
        return add(flight.position, scale(ratio(128.0 * eps * size, speed), flight.velocity))

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
        for k in range(self.floors.n_seams):
            axes, middle, half, present = self.floors.seam(touch.floor, k)
            margin = abs(norm(along(subtract(x, middle), axes)) - half)
            room = minimum(room, where(present, margin, jnp.inf))

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
        if touch.turn is not None:  # a train is summed on the plane that touches the surface
            speed = norm(struck.velocity)
            least = maximum(self.tolerance, 64.0 * float(jnp.finfo(touch.time.dtype).eps) * speed)
            calm = calm & (norm(touch.turn) * lasts_known * speed <= least)
        if struck.orientation is not None:  # infinitely many rotations have no sum
            calm = False
        return lasts, clear, calm & (touch.slips | touch.grips)

    def train_of(self, touch: Touch, kind: KINDS) -> tuple:
        """What a train is summed from, in an impact of a known kind: one that lies down does not bounce."""
        first = touch.first
        return first._replace(rise=where(kind == KINDS.train, first.rise, 0.0)), touch.law, touch.slips

    def meets(self, touch: Touch, left: Any, rests: Any, ends: Any) -> Meeting:
        contact, on, first, law = touch.contact, touch.on, touch.first, touch.law
        is_exit = contact.index >= self.scene.n_contacts
        grips = (contact.index == self.end_of_slip) & self.floors.have_friction
        lifts: Any = False
        if self.follows_hold:
            lifts = (contact.index >= self.end_of_hold) & (contact.index < self.end_of_slips)
            grips = grips | (contact.index >= self.end_of_slips)
        lands = touch.floor if self.joins else contact
        is_floor = self.floors.include(lands) & touch.face.below & (first.pull > 0)
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
        stops: Any = False
        if any(self.floors.resist):
            stops = (contact.index >= self.end_of_roll) & (contact.index < self.end_of_hold)
            over = KINDS.where(stops, KINDS.stopped, over)
        if self.follows_hold and self.floors.have_friction:
            begins = jnp.asarray(lifts) & self._begins_to_slip(touch)
            begins = begins & (second_of(touch.state) < 0) if self.have_grooves else begins
            over = KINDS.where(begins, KINDS.slipped, over)
        kind = KINDS.where(on, KINDS.where(is_exit, over, KINDS.rolling), bounce_or_end)
        enters, bounces_off, cornered = False, False, False
        if self.have_grooves:
            enters, bounces_off, slips_there, cornered = self.in_groove(touch, rests)
            kind = KINDS.where(slips_there, KINDS.slipped, kind)
            kind = KINDS.where(enters | cornered, KINDS.groove, kind)
        passes = touch.onto >= 0 if self.joins else False
        kind = KINDS.where(passes, KINDS.passed, kind) if self.joins else kind

        end = train.summed(*self.train_of(touch, kind))
        after, pause, wedged, is_at_rest = self.settled(touch, kind, end)
        stuck = ~is_exit & where(on, rests & ~wedged, ends & ~is_floor)
        stuck = stuck & ~passes if self.joins else stuck
        if self.have_grooves:
            stuck, is_at_rest = stuck & ~enters & ~bounces_off & ~cornered, is_at_rest | cornered
        fault = RESULTS.where(stuck, RESULTS.sustained_contact, RESULTS.reached_t1)
        fault = RESULTS.where(~on & endless, RESULTS.no_limit, fault)
        goes = is_exit & ~grips & ~jnp.asarray(lifts) & ~jnp.asarray(stops)
        tips = False if self.curved else on & goes & self._tips(touch)
        fault = RESULTS.where(tips & ~passes if self.joins else tips, RESULTS.pivoting, fault)
        if (self.floors.have_friction or self.floors.resist[0]) and self.parabolic:
            below, pull = self.ground(touch.time, after), self.pull(touch.time, after.flight)
            along = rolling.along_surface(below.face.normal, pull)
            straight = rolling.is_straight(below.heading, along, norm(pull))
            if below.brake is not None:
                straight = straight & rolling.is_straight(below.brake.heading, along, norm(pull))
            bends = (after.support >= 0) & ~straight
            fault = RESULTS.where(bends, RESULTS.curved_slide, fault)
        return Meeting(kind, fault, after, pause, is_at_rest)

    def _stopped(self, touch: Touch) -> tuple[Vector3, Vector3]:
        """Velocity and spin of a ball whose rolling, or spinning about the normal, has died out."""
        flight, n, index = touch.state.flight, touch.face.normal, touch.contact.index
        velocity, spin = flight.velocity, flight.spin
        if self.floors.resist[0]:
            # One that goes aside has only turned by a right angle.
            small = self.parabolic or norm(velocity) <= 100.0 * self.tolerance
            stops = (index == self.end_of_roll) & small
            velocity = where_vector(stops, rolling.NONE, velocity)
            spin = where_vector(stops, scale(dot(n, spin), n), spin)
        if self.end_of_hold > self.end_of_spin:
            without = subtract(spin, scale(dot(n, spin), n))
            spin = where_vector(index == self.end_of_spin, without, spin)
        return velocity, spin

    def _begins_to_slip(self, touch: Touch) -> Any:
        """Whether the surface still pushes a ball that it cannot make roll any more."""
        flight, eps = touch.state.flight, float(jnp.finfo(touch.time.dtype).eps)
        size = norm(touch.pull) + norm(self.pull(touch.time, flight))
        slip = rolling.own_slip(self.scene.ball.radius, touch.face.normal, flight.velocity, flight.spin)
        limited = touch.law.rolls & jnp.isfinite(jnp.inf if touch.law.friction is None else touch.law.friction)
        return limited & (norm(slip) == 0) & (touch.first.pull > eps**0.5 * size)

    def _slipping(self, touch: Touch) -> tuple[Vector3, Vector3]:
        """Velocity and spin of a ball that begins to slip: a little, so that rounding does not hide the direction."""
        flight, ball, n = touch.state.flight, self.scene.ball, touch.face.normal
        drive = rolling.along_surface(n, touch.pull)
        if touch.turn is not None:
            drive = subtract(drive, rolling.twist(ball.radius, dot(n, flight.spin), n, touch.turn))
        slip = scale(ratio(self.first_slip(flight), norm(drive)), drive)
        return flight.velocity, rolling.rolling_spin(ball.radius, n, subtract(flight.velocity, slip), flight.spin)

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
            if self.follows_hold:
                slips = kind == KINDS.slipped
                kept = [where_vector(slips, a, b) for a, b in zip(self._slipping(touch), kept, strict=True)]
                stays = stays | (on & slips)
        if any(self.floors.resist):
            stops = kind == KINDS.stopped
            kept = [where_vector(stops, a, b) for a, b in zip(self._stopped(touch), kept, strict=True)]
            stays = stays | (on & stops)
        held, pull = self._held(touch)
        wedged = self._is_wedged(touch, held, pull)
        if self.have_grooves:
            wedged = wedged & (second_of(touch.state) < 0)
        kept = [where_vector(wedged, rolling.NONE, x) for x in kept]

        velocity = where_vector(left, flight.velocity, where_vector(stays, kept[0], struck.velocity))
        spin = where_vector(left, flight.spin, where_vector(stays, kept[1], struck.spin))
        after = flight._replace(
            position=where_vector(settles, add(flight.position, end.shift), flight.position),
            velocity=where_vector(settles, end.velocity, velocity),
            spin=where_vector(settles & touch.law.rolls, end.spin, spin),
        )
        surface, support = (touch.floor if self.joins else touch.contact).index, touch.state.support
        surface = surface.astype(touch.time.dtype)
        if self.have_grooves:
            enters, support, after = self.beside(touch, kind, after)
            stays = stays | enters
        support = where(settles, surface, where(stays, support, -1.0))
        if self.joins:
            passed, onto = kind == KINDS.passed, touch.onto
            within = (onto == phase_of(touch.state)) & self.have_grooves  # a groove goes on over a seam
            support = where(passed, where(within, touch.state.support, onto.astype(support.dtype)), support)
            after = self._passed(passed, onto, touch, after)
        if self.curved:
            after = self.placed(touch.time, support, after)
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
        g = components(self.scene.gravity)
        along, least = rolling.along_surface(touch.face.normal, g), 64.0 * eps * norm(g)
        if self.floors.resist[0]:
            share = 1.0 + self.scene.ball.inertia_ratio
            holds = share * self.floors.resistance(touch.floor, 0) * -dot(touch.face.normal, g)
            least = maximum(least, where(touch.law.rolls, holds, 0.0))
        is_level = (norm(along) <= least) & (self.scene.air is None)
        before = size(touch.state.flight)
        if self.floors.resist[0]:  # what is left of a stop that is found by steps is small already
            before = maximum(before, jnp.sqrt(self.scene.ball.radius * norm(g)))
        return (size(after) <= 64.0 * eps * before) & (is_level | held)

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
        flies = state._replace(support=-1.0)
        touch = self.touch(contact, time, flies, n, struck, self.pull(time, struck), (False, False))
        first, law = touch.first, touch.law
        last = train.bounced(first, law, touch.slips, train.bounces_within(first, law.restitution, elapsed))
        velocity = add(last.velocity, scale(last.rise, first.normal))
        since = jnp.maximum(elapsed - last.time, 0.0)
        fall = add(scale(since, velocity), scale(0.5 * since * since, touch.pull))
        position = add(add(struck.position, last.shift), fall)
        spin = where_vector(law.rolls, last.spin, struck.spin)
        velocity = add(velocity, scale(since, touch.pull))
        return Travel(struck._replace(position=position, velocity=velocity, spin=spin), -1.0)
