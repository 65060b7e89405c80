"""A scene in which bounces may die out: the ball then rolls on (or, where there is no friction, slides), meets walls,
and leaves faces over their edges. Rolling is a phase of the same motion, on the same loop and in the same log."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.core
import jax.numpy as jnp
from jax import lax

from .._impact import rolling, train
from .._math import (
    KINDS,
    RESULTS,
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
    select,
    select_vector,
    subtract,
    times,
    where_number,
)
from .floors import Floors
from .hops import Hopper
from .round import round_bend, round_level
from .scene import Flight, Scene
from .surface import Face
from .system import AbstractSystem, bounces, rounding


class Ground(NamedTuple):
    """What a ball on a face has below it."""

    face: Face
    edged: Any  # whether the face has edges
    slip: Vector3  # zero of a ball that rolls, and where there is no friction to slide against
    heading: Vector3  # the direction in which it slides against friction, or zero
    straight: Any  # whether it keeps that direction until its slip ends


class Travel(NamedTuple):
    """A ball's state inside the engine, with the phase that it is in."""

    flight: Flight
    support: Any  # index of the surface that the ball stays on, -1 in flight; a float, as all of a state is
    below: Ground | None = None  # only while an arc is worked on


def _where(condition: Any, a: Sequence[Number], b: Sequence[Number]) -> Any:
    return tuple(where_number(condition, x, y) for x, y in zip(a, b, strict=True))


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
    def _end_of_slip(self) -> int:
        """The contact at which a slip has died out, behind the surfaces and, where some of them have faces with edges,
        the two pairs of edges of the face below."""
        return len(self.scene.surfaces) + 2 * self._floors.have_edges

    @property
    def n_contacts(self) -> int:  # pyright: ignore[reportIncompatibleVariableOverride]
        return (self._end_of_slip + self._floors.have_friction) if self.hits else 0

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
        flight = state.flight
        face, edged = self._floors.face(state.support, flight.position, time)
        if not self._floors.have_friction:
            return Ground(face, edged, rolling.NONE, rolling.NONE, True)
        ball, n, friction = self.scene.ball, face.normal, self._floors.friction(state.support)
        slides = (state.support >= 0) & self._floors.rolls(state.support) & jnp.isfinite(friction)
        slip = _where(slides, rolling.own_slip(ball.radius, n, flight.velocity, flight.spin), rolling.NONE)
        a = self._pull(time, flight)
        most = jnp.where(slides, friction, 0.0) * -dot(a, n) * (1.0 + 1.0 / ball.inertia_ratio)
        along = rolling.along_surface(n, a)
        heading = _where(slides, rolling.heading(slip, along, most), rolling.NONE)
        straight = self.parabolic or rolling.stays_straight(heading, slip, along, most, self.tolerance)
        return Ground(face, edged, slip, heading, straight)

    def derivative(self, time, state, q, v):
        flight, on = state.flight, state.support >= 0
        below, ball = self._below(time, state), self.scene.ball
        n, rolls = below.face.normal, on & self._floors.rolls(state.support)
        q, slip = q[:3], q[3:]
        if self.scene.air is not None:
            turning = subtract(v, slip) if slip else v
            spin = rolling.rolling_spin(ball.radius, n, turning, flight.spin)
            flight = flight._replace(spin=_where(rolls, spin, flight.spin))
        _, a = self.scene.derivative(time, flight, q, v)
        along, alpha = rolling.along_surface(n, a), ball.inertia_ratio
        changes = self._slip_rate(state, below, slip, along, dot(a, n)) if slip else ()
        # Friction leaves v + alpha r (omega x n) alone, so that (1 + alpha) v - alpha u changes by gravity only.
        rolling_rate = add(along, scale(alpha, changes)) if slip else along
        rate = _where(rolls, scale(1.0 / (1.0 + alpha), rolling_rate), along)
        return (*v, *changes), _where(on, rate, a)

    def _slip_rate(self, state: Travel, below: Ground, slip: Vector3, along: Vector3, push: Number) -> Vector3:
        """The rate of the slip, zero for a ball that does not slide against friction."""
        slides, heading = dot(below.heading, below.heading) > 0, below.heading
        most = jnp.where(slides, self._floors.friction(state.support), 0.0) * -push
        most = most * (1.0 + 1.0 / self.scene.ball.inertia_ratio)
        rate = scale(dot(along, heading) - most, heading)
        if not self.parabolic:
            turning = subtract(along, scale(most, rolling.later_heading(slip, heading)))
            rate = _where(below.straight, rate, turning)
        return _where(slides, rate, rolling.NONE)

    def advanced(self, time, state, q, v, duration):
        rolls = (state.support >= 0) & self._floors.rolls(state.support)
        flight = self.scene.advanced(time, state.flight, q[:3], v, duration)
        below, ball = self._below(time, state), self.scene.ball
        slips = (below.slip, q[3:] if self._floors.have_friction else rolling.NONE)
        before, after = (rolling.rolling_spin(ball.radius, below.face.normal, subtract(u, slip), flight.spin)
                         for u, slip in zip((state.flight.velocity, v), slips, strict=True))  # fmt: skip
        orientation = flight.orientation
        if orientation is not None:
            orientation = jnp.where(
                rolls, rolled(state.flight.orientation, before, after, duration, orientation.dtype), orientation
            )
        spin = _where(rolls, after, flight.spin)
        return Travel(flight._replace(spin=spin, orientation=orientation), state.support)

    # Contacts

    def phase(self, state):
        return jnp.asarray(state.support).astype(jnp.int32)

    def named(self, contact, state):
        return jnp.where(contact >= len(self.scene.surfaces), self.phase(state), contact)

    def _below(self, time: Any, state: Travel) -> Ground:
        return self._ground(time, state) if state.below is None else state.below

    def _exit(self, contact: int, state: Travel, time: Any) -> tuple[Vector3, Vector3, Number, Any]:
        """Along one pair of edges: across, middle, half size, and whether there are such edges."""
        face, edged, *_ = self._below(time, state)
        assert face.half is not None
        k = contact - len(self.scene.surfaces)
        return face.tangents[k], face.center, face.half[k], (state.support >= 0) & (edged > 0)

    def level(self, contact, time, q, state):
        x = q[:3]
        if contact < len(self.scene.surfaces):
            return jnp.where(state.support == contact, 1.0, self.scene.level(contact, time, x, state.flight))
        if contact == self._end_of_slip:
            heading = self._below(time, state).heading
            return jnp.where(dot(heading, heading) > 0, dot(heading, q[3:]), 1.0)
        across, middle, half, present = self._exit(contact, state, time)
        y = dot(across, subtract(x, middle))
        return jnp.where(present, round_level((y,), half, True), 1.0)

    def face(self, contact, time, q):
        return self.scene.face(contact, time, q[:3]) if contact < len(self.scene.surfaces) else None

    def reach(self, contact, q):
        if contact == self._end_of_slip:
            return None
        return self.scene.reach(contact, q[:3]) if contact < len(self.scene.surfaces) else self.scene.ball.radius

    def bend(self, contact, time, window, state):
        place = window._replace(coefficients=window.coefficients[:3])
        if contact < len(self.scene.surfaces):
            bend, skip = self.scene.bend(contact, time, place, state.flight), state.support == contact
        elif contact == self._end_of_slip:
            heading = self._below(time, state).heading
            bend = window._replace(coefficients=window.coefficients[3:]).along(heading, rolling.NONE).bend
            skip = dot(heading, heading) == 0
        else:
            across, middle, half, present = self._exit(contact, state, time)
            bend, skip = round_bend(place, (across,), middle, half, True), ~present
        low, high = (jnp.where(skip, 0.0, x) for x in bend)
        return type(bend)(low, high)

    def is_bounded(self, contact):
        return contact >= len(self.scene.surfaces) or self.scene.is_bounded(contact)

    def extent(self, contact):
        return self.scene.extent(contact) if contact < len(self.scene.surfaces) else self.scene.ball.radius

    # What happens there

    def _floor(self, contact: Any, time: Any, state: Travel) -> tuple[Face, Any]:
        """The face that the ball is on, or else that of the surface that it hits; and whether it has edges."""
        return self._floors.face(jnp.where(state.support >= 0, self.phase(state), contact), state.flight.position, time)

    def _start(self, time: Any, struck: Flight, face: Face) -> train.Start:
        """What a train begins with, after the first impact."""
        return train.start(struck.velocity, struck.spin, face.normal, self._pull(time, struck), self.scene.ball.radius)

    def _pull(self, time: Any, flight: Flight) -> Vector3:
        """Gravity, and what air gives now."""
        _, a = self.scene.derivative(time, flight, flight.position, flight.velocity)
        return a

    def _regime(self, contact: Any, first: train.Start) -> tuple[Any, Any]:
        """Whether all impacts of a train slip, and whether all of them grip."""
        law = self._floors.law(contact)
        if law.friction is None:
            return jnp.asarray(False), jnp.asarray(True)
        limited = law.rolls & jnp.isfinite(law.friction)
        tolerance = jnp.inf if self.parabolic else self.tolerance  # a path that bends has a name of its own
        slips = limited & train.slips_throughout(first, law, tolerance)
        return slips, ~limited | (train.grips_throughout(first, law) & ~slips)

    def _summed(self, contact: Any, first: train.Start) -> train.End:
        slips, _ = self._regime(contact, first)
        return train.summed(first, self._floors.law(contact), slips)

    def _room(self, contact: Any, x: Vector3, time: Any, face: Face, edged: Any) -> Number:
        """How far the centre can go from a place on a surface without meeting another, or the face's edge."""
        radius = self.scene.ball.radius
        assert face.half is not None
        room: Number = jnp.inf
        for across, half in zip(face.tangents, face.half, strict=True):
            margin = half - abs(dot(across, subtract(x, face.center)))
            room = minimum(room, jnp.where(edged > 0, margin, jnp.inf))
        for i, surface in enumerate(self.scene.surfaces):
            room = minimum(room, jnp.where(contact == i, jnp.inf, surface.clearance(x, time, radius)))
        return room

    def _sums(self, contact: Any, time: Any, struck: Flight, first: train.Start, floor: tuple) -> tuple[Any, Any, Any]:
        """How long the train lasts, whether it is clear of other surfaces and of edges until it ends, and whether it
        has a sum: air changes nothing, and all impacts are of one kind."""
        lasts = train.duration(first, self._floors.law(contact).restitution)
        lasts_known = jnp.where(jnp.isfinite(lasts), lasts, 0.0)
        height = ratio(first.rise * first.rise, 2.0 * first.pull)
        clear = train.span(first, lasts_known) + height < self._room(contact, struck.position, time, *floor)
        calm = jnp.asarray(True)
        if self.scene.air is not None:  # its force now is part of the sum; what matters is how that changes
            end = self._summed(contact, first)
            later = self._pull(time, struck._replace(velocity=end.velocity, spin=end.spin))
            calm = norm(subtract(self._pull(time, struck), later)) * lasts_known <= self.tolerance
        if struck.orientation is not None:  # infinitely many rotations have no sum
            calm = jnp.asarray(False)
        slips, grips = self._regime(contact, first)
        return lasts, clear, calm & (slips | grips)

    def _stays(self, contact: Any, support: Any) -> Any:
        """Whether a ball on `support` stays on it when it hits a surface: Theorem 5.1 needs one common mu there, and a
        smooth wall turns the ball round."""
        rolls = self._floors.holds(support)
        stays = []
        for surface in self.scene.surfaces:
            law = surface.law
            common = law.rolls and law.sliding_friction() is None and law.reversal() == law.restitution
            stays.append(jnp.where(rolls & jnp.asarray(common), 1.0, 0.0) if law.rolls else float(law.rolls is False))
        return jnp.asarray(select(contact, stays)) > 0.5

    def bounced(self, contact, time, state):
        return Travel(self.scene.bounced(contact, time, state.flight), state.support)

    def follows(self, contact, time, state, bounced, left, rests, ends):
        face, _ = self._floor(contact, time, state)
        first = self._start(time, bounced.flight, face)
        is_floor = self._floors.include(contact) & face.below & (first.pull > 0)
        soon = is_floor & ((train.duration(first, self._floors.law(contact).restitution) <= left) | rests)
        arguments = (contact, time, state, bounced, left, rests, ends)
        return _if_any((state.support >= 0) | soon, lambda: self._settling(*arguments), lambda: bounces(ends))

    def _settling(self, contact, time, state, bounced, left, rests, ends):
        on, struck = state.support >= 0, bounced.flight
        is_exit, grips = contact >= len(self.scene.surfaces), jnp.asarray(contact == self._end_of_slip)
        floor = self._floor(contact, time, state)
        first, law = self._start(time, struck, floor[0]), self._floors.law(contact)
        is_floor = self._floors.include(contact) & floor[0].below & (first.pull > 0)
        lasts, clear, sums = self._sums(contact, time, struck, first, floor)
        capped = law.rolls & jnp.isfinite(jnp.inf if law.friction is None else law.friction)
        small = rests & ~capped  # whatever it is, it is taken for a train
        dies_out = is_floor & (lasts <= left) & (small | (clear & sums))
        moves = dot(first.slip, first.slip) + dot(first.along, first.along) > 0
        endless = dies_out & law.rolls & ~capped & (abs(law.reversal) == 1) & (law.restitution < 1) & moves
        lies = is_floor & jnp.where(capped, ends, rests)

        # Beside a wall a ball lies down where it is: what it goes during its last bounces could take it through.
        bounce_or_end = KINDS.where(dies_out & clear, KINDS.train, KINDS.where(lies, KINDS.rolling, KINDS.bounce))
        wall = KINDS.where(self._stays(contact, state.support), KINDS.rolling, KINDS.bounce)
        over = KINDS.where(grips, KINDS.gripped, KINDS.left)
        kind = KINDS.where(on, KINDS.where(is_exit, over, wall), bounce_or_end)

        stuck = ~is_exit & jnp.where(on, rests & ~self._is_wedged(contact, time, state), ends & ~is_floor)
        fault = RESULTS.where(stuck, RESULTS.sustained_contact, RESULTS.reached_t1)
        fault = RESULTS.where(~on & endless, RESULTS.no_limit, fault)
        fault = RESULTS.where(on & is_exit & ~grips & self._tips(contact, state, floor[0]), RESULTS.pivoting, fault)
        if self._floors.have_friction and self.parabolic:
            after, _ = self.impact(contact, time, state, bounced, kind)
            below, pull = self._ground(time, after), self._pull(time, after.flight)
            straight = rolling.is_straight(below.heading, rolling.along_surface(below.face.normal, pull), norm(pull))
            bends = (after.support >= 0) & ~straight
            fault = RESULTS.where(bends, RESULTS.curved_slide, fault)
        return kind, fault

    def _tips(self, contact: Any, state: Travel, face: Face) -> Any:
        """Whether a ball that comes to an edge is too slow to fly off: v^2 < g_n r, v across the edge."""
        second = contact > len(self.scene.surfaces)
        across = _where(second, face.tangents[1], face.tangents[0])
        speed = dot(across, state.flight.velocity)
        pull = times(-1.0, dot(face.normal, components(self.scene.gravity)))
        return speed * speed < pull * self.scene.ball.radius * (1.0 + 1e-5)

    def impact(self, contact, time, state, bounced, kind):
        as_arrays = lambda tree: jax.tree.map(lambda x: jnp.asarray(x, dtype=time.dtype), tree)  # noqa: E731
        return _if_any(
            (state.support >= 0) | (kind != KINDS.bounce),
            lambda: as_arrays(self._settled(contact, time, state, bounced, kind)),
            lambda: as_arrays((Travel(bounced.flight, -1.0), 0.0)),
        )

    def _settled(self, contact, time, state, bounced, kind):
        flight, on, struck = state.flight, state.support >= 0, bounced.flight
        face, _ = self._floor(contact, time, state)
        first = self._start(time, struck, face)
        is_train, rolls, left, grips = (kind == k for k in (KINDS.train, KINDS.rolling, KINDS.left, KINDS.gripped))
        settles, stays = ~on & (is_train | rolls), on & (rolls | grips)
        first = first._replace(rise=jnp.where(is_train, first.rise, 0.0))
        end = self._summed(contact, first)
        kept = self._against(contact, time, flight, state.support, face.normal)
        if self._floors.have_friction:
            ball = self.scene.ball
            velocity, spin = rolling.gripped(ball.radius, ball.inertia_ratio, face.normal, flight.velocity, flight.spin)
            kept = kept._replace(velocity=_where(grips, velocity, kept.velocity), spin=_where(grips, spin, kept.spin))

        wedged = self._is_wedged(contact, time, state)
        kept = kept._replace(velocity=_where(wedged, rolling.NONE, kept.velocity),
                             spin=_where(wedged, rolling.NONE, kept.spin))  # fmt: skip

        velocity = _where(left, flight.velocity, _where(stays, kept.velocity, struck.velocity))
        spin = _where(left, flight.spin, _where(stays, kept.spin, struck.spin))
        after = flight._replace(
            position=_where(settles, add(flight.position, end.shift), flight.position),
            velocity=_where(settles, end.velocity, velocity),
            spin=_where(settles & self._floors.rolls(contact), end.spin, spin),
        )
        surface = jnp.asarray(contact).astype(jnp.asarray(state.support).dtype)
        support = jnp.where(settles, surface, jnp.where(stays, state.support, -1.0))
        return Travel(after, support), jnp.where(settles, end.time, 0.0)

    def _against(self, contact: Any, time: Any, flight: Flight, support: Any, n: Vector3) -> Flight:
        """A ball that stays on its support hits another surface; where there is friction it may slip afterwards."""
        ball, surfaces, velocity, spin = self.scene.ball, self.scene.surfaces, flight.velocity, flight.spin
        wall = self._normal(contact, time, flight.position)
        mu = select(contact, [surface.law.restitution for surface in surfaces])
        smooth = jnp.asarray(select(contact, [float(surface.law.rolls is False) for surface in surfaces])) > 0.5
        turned = rolling.against_smooth(n, wall, mu, velocity)
        firm = self._floors.holds(support)
        carried = _where(firm, rolling.rolling_spin(ball.radius, n, turned, spin), spin)
        velocity, spin = rolling.against_rough(ball.radius, ball.inertia_ratio, n, wall, mu, velocity, spin)
        return flight._replace(velocity=_where(smooth, turned, velocity), spin=_where(smooth, carried, spin))

    def _normal(self, contact: Any, time: Any, x: Vector3) -> Vector3:
        """The normal at a place of the surface of that index."""
        return select_vector(contact, [surface.direction(x, time) for surface in self.scene.surfaces])

    def _held(self, contact: Any, time: Any, state: Travel) -> tuple[Number, Any]:
        """The acceleration with which gravity holds a ball on its support against another surface, and whether it does
        so: into that surface, and not along the groove between the two."""
        x, surfaces = state.flight.position, self.scene.surfaces
        face, _ = self._floors.face(state.support, x, time)
        wall = self._normal(contact, time, x)
        g, groove = components(self.scene.gravity), cross(face.normal, wall)
        pull = times(-1.0, dot(wall, rolling.along_surface(face.normal, g)))
        eps = float(jnp.finfo(jnp.result_type(*x)).eps)
        held = (pull > 0) & (abs(dot(g, groove)) <= 64.0 * eps * norm(g)) & (self.scene.air is None)
        return pull, held & (state.support >= 0) & (contact < len(surfaces))

    def _is_wedged(self, contact: Any, time: Any, state: Travel) -> Any:
        """Whether all that is left of the motion of a ball in a groove is impacts on a surface beside its support, from
        which it moves off by less than rounding."""
        flight, surfaces = state.flight, self.scene.surfaces
        pull, held = self._held(contact, time, state)
        closing = dot(self._normal(contact, time, flight.position), flight.velocity)
        tolerance = select(contact, [rounding(self, i, flight.position) for i in range(len(surfaces))])
        creeps = norm(flight.velocity) + self.scene.ball.radius * norm(flight.spin) <= 64.0 * abs(closing)
        return held & self._stays(contact, state.support) & creeps & (closing * closing <= 4.0 * pull * tolerance)

    def during(self, contact, time, state, elapsed):
        """The state so long after the first impact of a train."""
        face, _ = self._floors.face(contact, state.flight.position, time)
        struck = self.scene.bounced(contact, time, state.flight)
        first = self._start(time, struck, face)
        law, (slips, _) = self._floors.law(contact), self._regime(contact, first)
        last = train.bounced(first, law, slips, train.bounces_within(first, law.restitution, elapsed))
        velocity = add(last.velocity, scale(last.rise, first.normal))
        since = jnp.maximum(elapsed - last.time, 0.0)
        gravity = self._pull(time, struck)
        fall = add(scale(since, velocity), scale(0.5 * since * since, gravity))
        position = add(add(struck.position, last.shift), fall)
        spin = _where(law.rolls, last.spin, struck.spin)
        flight = struck._replace(position=position, velocity=add(velocity, scale(since, gravity)), spin=spin)
        return Travel(flight, -1.0)

    def is_at_rest(self, contact, time, before, after):
        eps = float(jnp.finfo(after.flight.position[0].dtype).eps)
        size: Callable = lambda flight: norm(flight.velocity) + self.scene.ball.radius * norm(flight.spin)  # noqa: E731
        face, _ = self._floor(contact, time, before)
        g = components(self.scene.gravity)
        is_level = (norm(rolling.along_surface(face.normal, g)) <= 64.0 * eps * norm(g)) & (self.scene.air is None)
        still = size(after.flight) <= 64.0 * eps * size(before.flight)
        return (after.support >= 0) & still & (is_level | self._held(contact, time, before)[1])

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


def grounded(scene: Scene, tolerance: float, parabolic: bool) -> Scene | Grounded:
    """A scene with the motion after the last bounce, if there can be a last one."""
    return Grounded(scene, tolerance, parabolic) if Floors(scene).indices else scene
