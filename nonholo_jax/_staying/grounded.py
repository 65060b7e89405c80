"""A scene in which bounces may die out: the ball then rolls on (or, where there is no friction, slides), meets walls,
and leaves faces over their edges. Rolling is a phase of the same motion, on the same loop and in the same log."""

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .._impact import rolling, train
from .._math import (
    KINDS,
    Hopper,
    Interval,
    Number,
    Vector3,
    add,
    cross,
    dot,
    frozen,
    if_any,
    maximum,
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
from .._world import AbstractSystem, Meeting, Member, Scene, along, bounces, round_bend, round_level
from .floors import Floors, is_coarse, may_pass, may_settle
from .ground import Ground, Travel, code_of, of_code, phase_of, second_of, support_of
from .settling import Settling


class _Entry(NamedTuple):
    flush: Any
    inside: Any  # the ball is above the face, or it has no edges
    rim: Sequence  # its edges: across, middle, half size


class Grounded(AbstractSystem):
    """A scene with the motion after the last bounce. `tolerance` is the velocity in m/s that what has no sum may change
    during a train that is summed; `parabolic` says that arcs must be parabolas. Where a surface has a coefficient of
    friction, the slip is part of the configuration, and its end is a contact."""

    scene: Scene
    tolerance: float = eqx.field(static=True)
    parabolic: bool = eqx.field(static=True)
    hits: bool = eqx.field(static=True)
    curved: bool = eqx.field(static=True)
    may_pass: bool = eqx.field(static=True)  # pyright: ignore[reportIncompatibleVariableOverride]
    may_stay: ClassVar[bool] = True

    def __init__(
        self,
        scene: Scene,
        tolerance: float = 0.0,
        parabolic: bool = False,
        hits: bool = True,
        may_pass: bool = False,
        curved: bool = False,
    ):
        self.scene, self.tolerance, self.parabolic, self.hits = scene, tolerance, parabolic, hits
        self.curved, self.may_pass = curved, may_pass

    @property
    def is_long(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.curved

    @property
    def names(self) -> tuple[str, ...]:
        return self.scene.names

    @property
    def _settling(self) -> Settling:
        return Settling(self.scene, self.tolerance, self.parabolic, self._floors, self.may_pass)

    @property
    def _floors(self) -> Floors:
        return Floors(self.scene, self.curved)

    _n_surfaces = property(lambda self: self.scene.n_contacts)
    _end_of_slip = property(lambda self: self._settling.end_of_slip)

    @property
    def n_contacts(self) -> int:  # pyright: ignore[reportIncompatibleVariableOverride]
        settling = self._settling
        return (settling.end_of_hold + settling.n_derived) if self.hits else 0

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
        slip = (rolling.NONE if state.below is None else state.below.slip) if self._floors.have_friction else ()
        pivot = (0.0 if state.below is None else state.below.pivot,) if self.curved else ()
        speed: tuple = ()
        if self._floors.resist[0]:  # of a ball that rolls against resistance
            known = None if state.below is None else state.below.brake
            speed = (0.0 if known is None else dot(known.heading, velocity),)
        return (*position, *slip, *pivot, *speed), velocity

    def is_uniform(self):
        return self.scene.is_uniform()

    def prepared(self, time, state):
        return state._replace(below=self._settling.ground(time, state))

    def derivative(self, time, state, q, v):
        below, settling = self._below(time, state), self._settling
        slip, _ = settling.inner(q)
        free, alpha = below.free, self.scene.ball.inertia_ratio
        forced = settling.forced(time, state, below, q, v)
        n, rate = forced.normal, forced.along
        if self.curved:
            rate = subtract(rate, forced.twist)
        changes = settling.slip_rate(below, slip, rate, forced) if slip else ()
        if self.curved:
            rate = add(rate, scale(1.0 + alpha, forced.twist))
        if slip:
            # Friction leaves v + alpha r (omega x n) alone, so that (1 + alpha) v - alpha u changes by gravity only.
            with_slip = scale(free.share, add(rate, scale(alpha, changes)))
            rate = where_vector(below.rolls, with_slip, scale(free.share, rate))
        else:
            rate = scale(free.share, rate)
        slows: tuple = ()
        if below.brake is not None:
            rate = where_vector(below.brake.holds, rolling.NONE, subtract(rate, settling.braked(below, forced, v)))
            slows = (dot(below.brake.heading, rate),)
        if not self.curved:
            return (*v, *changes, *slows), rate
        rate = subtract(rate, scale(dot(forced.turn, v), n))
        changes = subtract(changes, scale(dot(forced.turn, slip), n)) if slip else ()
        spun = dot(scale(free.turning, cross(n, subtract(v, slip) if slip else v)), forced.turn)
        if below.spinning is not None:
            coefficient, sign = below.spinning
            lost = rolling.spin_loss(self.scene.ball, coefficient, -forced.push)
            spun = where((sign == 0) & (coefficient > 0), 0.0, spun - sign * lost)
        if settling.have_grooves:
            inside, (faster, pivots, spins) = second_of(state) >= 0, settling.rates_in_groove(time, state, below, q, v)
            rate, spun = where_vector(inside, faster, rate), where(inside, pivots, spun)
            if slip:
                changes = where_vector(inside, scale(self.scene.ball.radius, spins), changes)
            slows = tuple(where(inside, 0.0, each) for each in slows)
        return (*v, *changes, spun, *slows), rate

    def longest(self, state):
        """Where a slip turns, half of the time that it lasts: then the direction in which it ends is not smooth."""
        if self.parabolic or not self._floors.have_friction:
            return None
        return frozen(0.5 * self._below(0.0, state).lasts)

    def falling(self, time, state, q, v):
        return (*v, *(0.0 for _ in q[3:])), self.scene.derivative(time, state.flight, q[:3], v)[1]

    @property
    def n_derived(self) -> int:
        return self._settling.n_derived if self.hits else 0

    @property
    def degree_of_derived(self) -> int:
        return 7 if self.curved else 4

    def derived(self, time, state, q, v):
        """By how much the surface below pushes, or, where a ball rolls that may slip, by how much friction could do
        more: in metres, and 1 where there is nothing to hold."""
        below, settling = self._below(time, state), self._settling
        slip, _ = settling.inner(q)
        forced = settling.forced(time, state, below, q, v)
        radius, on = self.scene.ball.radius, phase_of(state) >= 0
        size = frozen(norm(forced.along) + abs(forced.push))
        hold = ratio(times(-radius, forced.push), size)
        if slip:
            assert below.friction is not None
            limited = below.rolls & jnp.isfinite(below.friction) & (dot(below.heading, below.heading) == 0)
            most = where(limited, below.friction, 0.0) * -forced.push * (1.0 + 1.0 / self.scene.ball.inertia_ratio)
            drive = subtract(forced.along, forced.twist)
            if below.brake is not None:
                drive = add(drive, scale(1.0 + 1.0 / self.scene.ball.inertia_ratio, settling.braked(below, forced, v)))
            spare = ratio(radius * (most * abs(most) - dot(drive, drive)), frozen(most * most + dot(drive, drive)))
            hold = where(limited, spare, hold)
        if not settling.have_grooves:
            return (where(on, hold, 1.0),)
        inside, (first, *others) = second_of(state) >= 0, settling.ends_in_groove(time, state, below, q, v)
        return where(on, where(inside, first, hold), 1.0), *[where(inside, x, 1.0) for x in others]

    def is_coarse(self, arc):
        return is_coarse(self.scene, arc, functools.partial(self._is_on, arc.start)) if self.curved else None

    def rate_of(self, time, state):
        return state.flight.velocity

    def advanced(self, time, state, q, v, duration):
        flight = self.scene.advanced(time, state.flight, q[:3], v, duration)
        below, settling = self._below(time, state), self._settling
        slip, pivot = settling.inner(q)
        n, free, orientation, still = below.face.normal, below.free, flight.orientation, below.free.spin
        if self.curved:
            flight = self._settling.placed(time, state.support, flight)
            face, _ = self._floors.face(self.scene.choice(phase_of(state)), flight.position, time)
            n, v = where_vector(state.support >= 0, face.normal, below.face.normal), flight.velocity
            still = where_vector(below.rolls, scale(pivot, n), free.spin)
            slip = rolling.along_surface(n, slip) if slip else slip
            if settling.have_grooves:
                inside = second_of(state) >= 0
                in_groove = settling.spin_there(time, state, below, flight, q)
        elif below.spinning is not None:
            still = self._spun_down(time, state, below, duration)
        spin = add(still, scale(free.turning, cross(n, subtract(v, slip) if slip else v)))
        spin = where_vector(inside, in_groove, spin) if settling.have_grooves else spin
        if orientation is not None:
            turning = subtract(state.flight.velocity, below.slip)
            before = add(free.spin, scale(free.turning, cross(below.face.normal, turning)))
            before = where_vector(inside, state.flight.spin, before) if settling.have_grooves else before
            turned = rolled(state.flight.orientation, before, spin, duration, orientation.dtype)
            orientation = jnp.where(below.rolls, turned, orientation)
        return Travel(flight._replace(spin=spin, orientation=orientation), state.support)

    def _spun_down(self, time: Any, state: Travel, below: Ground, duration: Any) -> Vector3:
        """The spin about the normal after so many seconds on a flat surface."""
        assert below.spinning is not None
        coefficient, sign = below.spinning
        n, pivot = below.face.normal, dot(below.face.normal, below.free.spin)
        lost = rolling.spin_loss(self.scene.ball, coefficient, -dot(n, self._settling.pull(time, state.flight)))
        left = sign * maximum(abs(pivot) - lost * duration, 0.0)
        return where_vector(below.rolls, scale(left, n), below.free.spin)

    # Contacts

    def _is_on(self, state: Travel, number: Any) -> Any:
        """Whether the ball stays on that surface."""
        on = phase_of(state) == number
        return on | (second_of(state) == number) if self._settling.have_grooves else on

    def phase(self, state):
        return phase_of(state)

    def named(self, contact, state):
        name = where(contact.index >= self._n_surfaces, self.phase(state), contact.index)
        if not self._settling.have_grooves:
            return name
        settling = self._settling
        beside = (contact.index == settling.end_of_hold + 1) | (contact.index == settling.end_of_slips + 1)
        return where(beside, second_of(state), name)

    def code(self, state):
        if not self._settling.have_grooves:
            return phase_of(state)
        return where(state.support >= 0, code_of(phase_of(state), second_of(state)), np.int32(-1))

    def supports(self, code):
        return of_code(code) if self._settling.have_grooves else super().supports(code)

    def code_of(self, support, beside):
        return code_of(support, beside) if self._settling.have_grooves else support

    def left_by(self, contact):
        if not self._settling.follows_hold:
            return 0
        settling, index = self._settling, contact.index
        holds = (index >= settling.end_of_hold) & (index < settling.end_of_slips)
        return where(holds, np.int32(self.n_contacts), np.int32(0))

    def _below(self, time: Any, state: Travel) -> Ground:
        return self._settling.ground(time, state) if state.below is None else state.below

    def _exit(self, contact: int, state: Travel, time: Any) -> tuple[Vector3, Vector3, Number, Any]:
        """Along one pair of edges: across, middle, half size, and whether there are such edges."""
        below = self._below(time, state)
        assert below.face.half is not None
        k = contact - self._n_surfaces  # of the two
        return below.face.tangents[k], below.face.center, below.face.half[k], below.edged

    def level(self, contact, time, q, state):
        x = q[:3]
        if isinstance(contact, Member):
            on = self._is_on(state, contact.number)
            away = self.scene.level(contact, time, x, state.flight)
            if self.may_pass:
                found = self._flush(contact, time, state)
                entry = [round_level((dot(axis, subtract(x, middle)),), half, False)
                         for axis, middle, half in found.rim]  # fmt: skip
                away = where(found.flush, functools.reduce(maximum, entry or [1.0]), away)
                on = on | found.inside
            return where(on, 1.0, away)
        if contact == self._end_of_slip and self._floors.have_friction:
            below = self._below(time, state)
            heading, slip = below.heading, dot(below.heading, q[3:6])
            slip = slip if self.parabolic else slip - self._settling.last_slip(state.flight, below.slip, below.straight)
            return where(dot(heading, heading) > 0, slip, 1.0)
        settling = self._settling
        if contact >= settling.end_of_hold:
            return q[contact - settling.end_of_hold - settling.n_derived]
        if contact >= settling.end_of_roll:
            sign, k = self._dying(contact, time, state)
            unit = 1.0 if contact == settling.end_of_roll else self.scene.ball.radius
            return where(sign != 0, sign * q[k] * unit, 1.0)
        if self.curved:
            beyond, axes, middle, half, present = self._below(time, state).seams[contact - self._n_surfaces]
            away = round_level(along(subtract(x, middle), axes), half, False)
            return where(present, where(beyond, away, times(-1.0, away)), 1.0)
        across, middle, half, present = self._exit(contact, state, time)
        y = dot(across, subtract(x, middle))
        return where(present, round_level((y,), half, True), 1.0)

    def _dying(self, contact: int, time: Any, state: Travel) -> tuple[Any, int]:
        """Of rolling, or of spinning about the normal, that resistance stops: its sign, zero where there is none, and
        which number of the configuration it is."""
        below, settling = self._below(time, state), self._settling
        first = 3 + 3 * settling.floors.have_friction
        if contact == settling.end_of_roll and below.brake is not None:
            heading = below.brake.heading
            return where(dot(heading, heading) > 0, 1.0, 0.0), first + self.curved
        assert below.spinning is not None
        coefficient, sign = below.spinning
        return where(coefficient > 0, sign, 0.0), first

    def _flush(self, contact: Member, time: Any, state: Travel) -> "_Entry":
        """How a ball on a support sees a face that is flush with it: it comes onto it over its edges."""
        below = self._below(time, state)
        assert below.flush is not None
        flush, rim = below.flush.flush[contact.number], contact.surface.rim(below.face.normal)
        inside = flush & (below.flush.holds[contact.number] | (rim is None))
        return _Entry(flush, inside, [] if rim is None else [(axis, rim[0], half) for axis, half in rim[1]])

    def is_parabolic(self, contact):
        return self.scene.is_parabolic(contact) if isinstance(contact, Member) else contact >= self._end_of_slip

    def returns(self, contact, time, q, v, half_a, state):
        if not isinstance(contact, Member):
            return None
        back = self.scene.returns(contact, time, q[:3], v[:3], half_a[:3], state.flight)
        # A ball that rolls neither leaves its support nor comes back to it, whatever rounding says.
        return None if back is None else back._replace(comes=back.comes & ~self._is_on(state, contact.number))

    def reach(self, contact, q):
        return self.scene.reach(contact, q[:3]) if isinstance(contact, Member) else self.scene.ball.radius

    def bend(self, contact, time, window, state):
        place = window._replace(coefficients=window.coefficients[:3])
        if isinstance(contact, Member):
            bend, skip = self.scene.bend(contact, time, place, state.flight), self._is_on(state, contact.number)
            if self.may_pass:
                found = self._flush(contact, time, state)
                bends = [round_bend(place, (axis,), middle, half, False) for axis, middle, half in found.rim]
                low, high = ([getattr(each, end) for each in bends] or [0.0] for end in ("low", "high"))
                rim = type(bend)(functools.reduce(minimum, low), functools.reduce(maximum, high))
                bend = type(bend)(*[where(found.flush, a, b) for a, b in zip(rim, bend, strict=True)])
                skip = skip | found.inside
        elif contact == self._end_of_slip and self._floors.have_friction:
            heading = self._below(time, state).heading
            bend = window._replace(coefficients=window.coefficients[3:6]).along(heading, rolling.NONE).bend
            skip = dot(heading, heading) == 0
        elif contact >= self._settling.end_of_hold:
            k = contact - self._settling.end_of_hold - self._settling.n_derived
            bend, skip = window.track(window.coefficients[k]).bend, phase_of(state) < 0
        elif contact >= self._settling.end_of_roll:
            sign, k = self._dying(contact, time, state)
            unit = 1.0 if contact == self._settling.end_of_roll else self.scene.ball.radius
            low, high = scale(unit, window.track(window.coefficients[k]).bend)
            bend, skip = Interval(where(sign < 0, -high, low), where(sign < 0, -low, high)), sign == 0
        elif self.curved:
            beyond, axes, middle, half, present = self._below(time, state).seams[contact - self._n_surfaces]
            low, high = round_bend(place, tuple(axes), middle, half, False)
            away = (times(-1.0, high), times(-1.0, low))
            bend, skip = Interval(*[where(beyond, a, b) for a, b in zip((low, high), away, strict=True)]), ~present
        else:
            across, middle, half, present = self._exit(contact, state, time)
            bend, skip = round_bend(place, (across,), middle, half, True), ~present
        low, high = (where(skip, 0.0, x) for x in bend)
        return type(bend)(low, high)

    def is_wide(self, contact):
        return isinstance(contact, Member) and self.scene.is_wide(contact)

    def unbounded(self, state):
        return self.scene.unbounded(state)

    def extent(self, contact):
        return self.scene.extent(contact) if isinstance(contact, Member) else self.scene.ball.radius

    # What happens there

    def bounced(self, contact, time, state):
        return Travel(self.scene.bounced(contact, time, state.flight), state.support)

    def meets(self, contact, time, state, left, rests, ends):
        settling = self._settling
        n, struck, stays = settling.struck(contact, time, state)
        pull = settling.pull(time, struck, contact)
        rise, into, e_n = dot(n, struck.velocity), times(-1.0, dot(n, pull)), self.scene.restitution(contact)
        # Not later than `train.duration`, or nearly.
        soon = rests | (times(2.0, rise) <= 1.001 * left * times(into, 1.0 - e_n))
        soon = settling.floors.include(contact) & (into > 0) & soon

        def plain() -> Meeting:
            return _as_arrays(bounces(ends, Travel(struck, -1.0)), time)

        def unusual() -> Meeting:
            touch = settling.touch(contact, time, state, n, struck, pull, stays)
            return _as_arrays(settling.meets(touch, left, rests, ends), time)

        return if_any((state.support >= 0) | soon, unusual, plain)

    def after(self, contact, time, state, kind):
        settling = self._settling
        n, struck, stays = settling.struck(contact, time, state)

        def unusual() -> tuple:
            touch = settling.touch(contact, time, state, n, struck, settling.pull(time, struck), stays)
            return _as_arrays(settling.settled(touch, kind, train.summed(*settling.train_of(touch, kind)))[:2], time)

        plain = lambda: _as_arrays((Travel(struck, -1.0), 0.0), time)  # noqa: E731
        return if_any((state.support >= 0) | (kind != KINDS.bounce), unusual, plain)

    def during(self, contact, time, state, elapsed):
        return self._settling.during(contact, time, state, elapsed)

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
        if phase is not None and self._settling.have_grooves:
            first, second = of_code(jnp.asarray(phase))
            support = support_of(first, second, dtype)
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


def grounded(scene: Scene, tolerance: float, parabolic: bool, curved: bool = False) -> Scene | Grounded:
    """A scene with the motion after the last bounce, if there can be a last one."""
    if not may_settle(scene, curved):
        return scene
    return Grounded(scene, tolerance, parabolic, may_pass=may_pass(scene, curved), curved=curved)
