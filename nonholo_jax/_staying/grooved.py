"""A ball in the groove between two surfaces: how it goes, what ends there, and how it comes in and out."""

from typing import Any, NamedTuple

import jax.numpy as jnp

from .._impact import groove, rolling, train
from .._math import (
    KINDS,
    Choice,
    Number,
    Vector3,
    add,
    cross,
    dot,
    frozen,
    if_any,
    minimum,
    norm,
    ratio,
    scale,
    subtract,
    total,
    where,
    where_vector,
)
from .._world import Face, Flight
from .ground import Footing, Ground, Travel, arrays, phase_of, second_of, support_of


class Entry(NamedTuple):
    """How a ball goes on along the groove of its support and what it meets, or of the two surfaces that it is on."""

    joined: Travel
    sides: groove.Sides
    held: tuple[Any, Any]  # on which sides the ball did not slip before
    path: groove.Way
    course: groove.Course
    speed: Number
    spin: Vector3


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
    entry: Entry | None = None  # where there are grooves
    turn: Vector3 | None = None  # how fast the normal of a curved surface turns as the ball goes along


def _is_carried(columns: list[Vector3], into: Vector3) -> Any:
    """Whether pushes that are not negative, times these columns, sum to a vector."""
    one, two, three = columns
    volume = dot(cross(one, two), three)
    parts = [ratio(dot(cross(a, b), c), volume)
             for a, b, c in ((into, two, three), (one, into, three), (one, two, into))]  # fmt: skip
    eps = float(jnp.finfo(jnp.result_type(volume)).eps)
    return (parts[0] >= 0) & (parts[1] >= 0) & (parts[2] >= 0) & (abs(volume) > eps**0.5)


class Grooved(Footing):
    """What a ball does in a groove."""

    def along_groove(
        self, time: Any, state: Travel, below: Ground, q: tuple, v: tuple
    ) -> tuple[groove.Sides, Vector3, groove.Course]:
        """How a ball goes along a groove: its sides, its spin, and what changes them."""
        x: Any = q[:3]
        sides, spin = self.spin_in_groove(time, state, below, x, v, q)  # pyright: ignore[reportArgumentType]
        rub = None
        if below.slides is not None:
            slips = groove.slips(self.scene.ball.radius, sides, v, spin)  # pyright: ignore[reportArgumentType]
            rub = groove.Rub(below.slides.limits, self._headings(below, slips, sides))
        return sides, spin, self.course(time, state.flight._replace(position=x), sides, v, spin, rub)  # pyright: ignore

    def spin_in_groove(
        self, time: Any, state: Travel, below: Ground, x: Vector3, v: Vector3, q: tuple
    ) -> tuple[groove.Sides, Vector3]:
        """The sides of the groove that the ball has come along to the place `x`, and its spin there."""
        radius, kept, (_, pivot) = self.scene.ball.radius, state.flight.spin, self.inner(q)
        sides = self.sides(time, state, x, v)
        if below.slides is not None:
            sides, kept = sides._replace(grips=below.slides.grips), scale(ratio(1.0, radius), q[3:6])
        path = groove.way(radius, sides)
        if below.slides is not None:
            pivot = dot(path.free, kept)
        return sides, groove.spin_of(path, dot(path.along, v), pivot, kept, sides.grips[0] | sides.grips[1])

    def spin_there(self, time: Any, state: Travel, below: Ground, flight: Flight, q: tuple) -> Vector3:
        """The spin of a ball that has come along a groove; zero where none is in one."""
        there = lambda: self.spin_in_groove(time, state, below, flight.position, flight.velocity, q)[1]  # noqa: E731
        return if_any(second_of(state) >= 0, lambda: arrays(there(), time), lambda: arrays(rolling.NONE, time))

    def rates_in_groove(
        self, time: Any, state: Travel, below: Ground, q: tuple, v: Vector3
    ) -> tuple[Vector3, Number, Vector3]:
        """The rates of velocity, of the spin about the free axis, and of all of the spin in a groove, or zero."""

        def rates() -> tuple:
            _, _, course = self.along_groove(time, state, below, q, v)
            return arrays((*course.acceleration, course.pivots, *course.spins), time)

        found = if_any(second_of(state) >= 0, rates, lambda: arrays((0.0,) * 7, time))
        return found[:3], found[3], found[4:]

    @staticmethod
    def _headings(below: Ground, slips: tuple, sides: groove.Sides) -> tuple[Vector3, Vector3]:
        """The directions of the slips on both sides, some time after the arc began."""
        assert below.slides is not None
        found = []
        both = zip(slips, below.slides.headings, below.slides.straight, sides.normals, strict=True)
        for slip, known, straight, normal in both:
            slides = dot(known, known) > 0
            later = where_vector(straight, rolling.carried(normal, known), rolling.later_heading(slip, known))
            found.append(where_vector(slides, later, rolling.NONE))
        return found[0], found[1]

    def ends_in_groove(self, time: Any, state: Travel, below: Ground, q: tuple, v: Vector3) -> tuple:
        """`derived` on both sides of a groove: what holds the ball there, and, where friction may stop them, its
        slips; 1 where there is none."""

        def ends() -> tuple:
            return arrays(self._ends(state, below, *self.along_groove(time, state, below, q, v), v), time)

        return if_any(second_of(state) >= 0, ends, lambda: arrays((1.0,) * self.n_derived, time))

    def _ends(
        self, state: Travel, below: Ground, sides: groove.Sides, spin: Vector3, course: groove.Course, v: Vector3
    ) -> list[Number]:
        size, radius = frozen(total([abs(push) for push in course.pushes])), self.scene.ball.radius
        holds = [ratio(radius * push, size) for push in course.pushes]
        if below.slides is None:
            return holds
        spare = groove.spare(sides, course, below.slides.limits)
        flight, ends = state.flight, []
        before = groove.slips(radius, sides, flight.velocity, flight.spin)
        slips = [subtract(v, scale(radius, cross(spin, n))) for n in sides.normals]
        for i, limit in enumerate(below.slides.limits):
            limited = jnp.isfinite(limit) & (limit > 0) & sides.grips[i]
            holds[i] = where(limited, radius * spare[i], holds[i])
            known = below.slides.headings[i]
            least = self.last_slip(flight, before[i])
            ends.append(where(dot(known, known) > 0, dot(known, slips[i]) - least, 1.0))
        return [*holds, *ends]

    def enter(self, contact: Any, time: Any, state: Travel, on: Any, pull_at: Any) -> Entry:
        """How a ball goes on that meets a surface with that contact, or where what holds it in a groove ends."""
        flight, ball, index = state.flight, self.scene.ball, contact.index
        alone, is_met = second_of(state) < 0, index < self.scene.n_contacts
        beside = where(alone & is_met, index, second_of(state))
        joined = state._replace(support=support_of(phase_of(state), beside, time.dtype))
        sides = self.sides(time, joined, flight.position, flight.velocity)
        path = groove.way(ball.radius, sides)
        one, two = groove.slips(ball.radius, sides, arrays(flight.velocity, time), arrays(flight.spin, time))
        held = norm(one) == 0, norm(two) == 0
        if self.floors.have_friction:
            unit = self.sides(time, joined, flight.position, path.along)
            ahead = scale(dot(path.along, flight.velocity), path.along)
            pull = arrays(pull_at(time, flight._replace(velocity=ahead)), time)
            ends = tuple((index == self.end_of_hold + i) & ~alone & on for i in (0, 1))
            eps = float(jnp.finfo(time.dtype).eps)
            least = 100.0 * self.tolerance + 256.0 * eps * (norm(flight.velocity) + ball.radius * norm(flight.spin))
            change = groove.Change(ends, least, self.first_slip(flight))  # pyright: ignore[reportArgumentType]
            grip = groove.gripped(ball.radius, ball.inertia_ratio, unit, arrays(flight.velocity, time),
                                  arrays(flight.spin, time), pull, self.limits(joined), change)  # fmt: skip
            return Entry(joined, sides, held, path, grip.course, grip.speed, grip.spin)
        speed, pivot = groove.entered(ball.radius, ball.inertia_ratio, path, flight.velocity, flight.spin)
        along = scale(speed, path.along)
        sides = self.sides(time, joined, flight.position, along)
        spin = groove.spin_of(path, speed, pivot, flight.spin, sides.grips[0] | sides.grips[1])
        pull = arrays(pull_at(time, flight._replace(velocity=along, spin=spin)), time)
        course = groove.course(ball.radius, ball.inertia_ratio, sides, along, spin, pull)
        return Entry(joined, sides, held, path, course, speed, spin)

    def in_groove(self, touch: Touch, rests: Any) -> tuple[Any, Any, Any, Any]:
        """Whether a ball on one surface goes on along the groove that another one makes with it; whether it could, but
        for a push that is nearly zero there, so that it bounces off; whether one in a groove begins to slip there; and
        whether a third surface holds it in a corner."""
        state, index, on, entry = touch.state, touch.contact.index, touch.on, touch.entry
        assert entry is not None
        eps = float(jnp.finfo(touch.time.dtype).eps)
        alone, is_met, course = second_of(state) < 0, index < self.scene.n_contacts, entry.course
        size = norm(touch.pull) + norm(course.acceleration)
        push = minimum(*course.pushes)
        pressed, hardly = push > eps * size, (push <= eps * size) & (push > -0.01 * size)
        fits = (state.support >= 0) & is_met & alone & rests & self.floors.include(touch.contact)
        follows = fits & self._rolls_freely(entry.joined)
        over = (index >= self.end_of_hold) & (index < self.end_of_slips) & ~alone & on
        first = index == self.end_of_hold
        own = where(first, course.pushes[0], course.pushes[1])
        limits = self.limits(state)
        limit = where(first, limits[0], limits[1])
        limited = jnp.isfinite(limit) & (limit > 0) & where(first, *entry.held)
        slips = over & limited & (own > eps * size)
        cornered = on & is_met & ~alone & rests & self._in_corner(touch, entry)
        return follows & pressed, follows & hardly, slips, cornered

    def _in_corner(self, touch: Touch, entry: Entry) -> Any:
        """Whether what is met holds a ball that is in a groove at rest: also now, if friction acts against its spin."""
        into, normals = scale(-1.0, self.pull(touch.time, touch.state.flight)), self._three_normals(touch, entry)
        held = _is_carried(normals, into)
        if self.floors.have_friction:
            limits, columns = (*self.limits(entry.joined), self.limit(touch.contact)), []
            for n, limit in zip(normals, limits, strict=True):
                slip = rolling.own_slip(self.scene.ball.radius, n, rolling.NONE, touch.struck.spin)
                drag = scale(ratio(where(jnp.isfinite(limit), limit, 0.0), norm(slip)), slip)
                columns.append(subtract(n, drag))
            held = held & _is_carried(columns, into)
        if touch.struck.orientation is not None:
            held = held & (norm(self._kept_spin(touch, entry)) == 0)
        return held & (self.scene.air is None)

    def _three_normals(self, touch: Touch, entry: Entry) -> list[Vector3]:
        return [*entry.sides.normals, arrays(touch.normal, touch.time)]

    def _kept_spin(self, touch: Touch, entry: Entry) -> Vector3:
        """The spin of a ball in a corner: friction takes at once all that it acts against, however long that takes."""
        spin, normals = touch.struck.spin, self._three_normals(touch, entry)
        if self.floors.resist[1]:
            beside = (phase_of(touch.state), second_of(touch.state))
            three = [*(self.scene.choice(index) for index in beside), touch.contact]
            takes = total([self.floors.resistance(each, 1) for each in three]) > 0
            spin = where_vector(takes, rolling.NONE, spin)
        grips = [*entry.sides.grips, self.floors.rolls(touch.contact)]
        axis = rolling.NONE
        for n, grip in zip(normals, grips, strict=True):
            axis = add(axis, where_vector(grip, n, rolling.NONE))
        count = total([where(grip, 1.0, 0.0) for grip in grips])
        return where_vector(count == 0, spin, where_vector(count == 1, scale(dot(axis, spin), axis), rolling.NONE))

    def _rolls_freely(self, joined: Travel) -> Any:
        """Whether nothing resists rolling on a side of a groove, which is not followed."""
        if not self.floors.resist[0]:
            return True
        one, two = (self.floors.resistance(self.scene.choice(i), 0) > 0 for i in (phase_of(joined), second_of(joined)))
        return jnp.logical_not(one | two)

    def beside(self, touch: Touch, kind: KINDS, after: Flight) -> tuple[Any, Any, Flight]:
        """Whether a ball stays that comes into a groove, or out of one onto one of its sides, or whose slip changes
        there; its support; its state."""
        state, index, dtype, entry = touch.state, touch.contact.index, touch.time.dtype, touch.entry
        assert entry is not None
        first, second = phase_of(state), second_of(state)
        enters, left = kind == KINDS.groove, (kind == KINDS.left) & (second >= 0) & (index >= self.end_of_hold)
        changes = ((kind == KINDS.gripped) | (kind == KINDS.slipped)) & (second >= 0)
        rests = enters & (second >= 0)  # in a corner
        along = where_vector(rests, rolling.NONE, scale(entry.speed, entry.path.along))
        after = after._replace(
            velocity=where_vector(enters | changes, along, after.velocity),
            spin=where_vector(
                enters | changes, where_vector(rests, self._kept_spin(touch, entry), entry.spin), after.spin
            ),
        )
        alone = where(index == self.end_of_hold, second, first).astype(dtype)
        return enters | left | changes, where(enters, entry.joined.support, where(left, alone, state.support)), after
