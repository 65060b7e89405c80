"""A scene in which bounces may die out: the ball then rolls on (or, where there is no friction, slides), meets walls,
and leaves faces over their edges. Rolling is a phase of the same motion, on the same loop and in the same log."""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
from jax import lax

from .._impact import rolling, train
from .._math import (
    KINDS,
    Hopper,
    Number,
    Vector3,
    add,
    cross,
    dot,
    maximum,
    minimum,
    rolled,
    scale,
    subtract,
    times,
    where,
    where_vector,
)
from .round import round_bend, round_level
from .scene import Scene
from .settling import Floors, Ground, Settling, Travel, phase_of
from .system import AbstractSystem, Meeting, bounces
from .touching import Member, may_be_flush


def _if_any(condition: Any, wanted: Callable, plain: Callable) -> Any:
    """`wanted()` if a condition holds in any lane of a batch: otherwise `plain()`, which must be equal then."""
    return lax.cond(eqxi.unvmap_any(condition), wanted, plain)


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
    may_pass: bool = eqx.field(static=True)  # pyright: ignore[reportIncompatibleVariableOverride]
    is_long: ClassVar[bool] = False
    may_stay: ClassVar[bool] = True

    def __init__(
        self,
        scene: Scene,
        tolerance: float = 0.0,
        parabolic: bool = False,
        hits: bool = True,
        may_pass: bool | None = None,
    ):
        self.scene, self.tolerance, self.parabolic, self.hits = scene, tolerance, parabolic, hits
        self.may_pass = may_be_flush(scene.surfaces, scene.ball.radius) if may_pass is None else may_pass

    @property
    def names(self) -> tuple[str, ...]:
        return self.scene.names

    @property
    def _settling(self) -> Settling:
        return Settling(self.scene, self.tolerance, self.parabolic, Floors(self.scene), self.may_pass)

    @property
    def _floors(self) -> Floors:
        return Floors(self.scene)

    @property
    def _n_surfaces(self) -> int:
        return self.scene.n_contacts

    @property
    def _end_of_slip(self) -> int:
        return self._settling.end_of_slip

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
        return state._replace(below=self._settling.ground(time, state))

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

    def rate_of(self, time, state):
        return state.flight.velocity

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
        return phase_of(state)

    def named(self, contact, state):
        return where(contact.index >= self._n_surfaces, self.phase(state), contact.index)

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
            on = phase_of(state) == contact.number
            away = self.scene.level(contact, time, x, state.flight)
            if self.may_pass:
                found = self._flush(contact, time, state)
                entry = [round_level((dot(axis, subtract(x, middle)),), half, False)
                         for axis, middle, half in found.rim]  # fmt: skip
                away = where(found.flush, functools.reduce(maximum, entry or [1.0]), away)
                on = on | found.inside
            return where(on, 1.0, away)
        if contact == self._end_of_slip:
            heading = self._below(time, state).heading
            return where(dot(heading, heading) > 0, dot(heading, q[3:]), 1.0)
        across, middle, half, present = self._exit(contact, state, time)
        y = dot(across, subtract(x, middle))
        return where(present, round_level((y,), half, True), 1.0)

    def _flush(self, contact: Member, time: Any, state: Travel) -> "_Entry":
        """How a ball on a support sees a face that is flush with it: it comes onto it over its edges."""
        below = self._below(time, state)
        assert below.flush is not None
        flush, rim = below.flush.flush[contact.number], contact.surface.rim(below.face.normal)
        inside = flush & (below.flush.holds[contact.number] | (rim is None))
        return _Entry(flush, inside, [] if rim is None else [(axis, rim[0], half) for axis, half in rim[1]])

    def is_parabolic(self, contact):
        return self.scene.is_parabolic(contact) if isinstance(contact, Member) else contact == self._end_of_slip

    def returns(self, contact, time, q, v, half_a, state):
        if not isinstance(contact, Member):
            return None
        back = self.scene.returns(contact, time, q[:3], v[:3], half_a[:3], state.flight)
        # A ball that rolls neither leaves its support nor comes back to it, whatever rounding says.
        return None if back is None else back._replace(comes=back.comes & (phase_of(state) != contact.number))

    def reach(self, contact, q):
        return self.scene.reach(contact, q[:3]) if isinstance(contact, Member) else self.scene.ball.radius

    def bend(self, contact, time, window, state):
        place = window._replace(coefficients=window.coefficients[:3])
        if isinstance(contact, Member):
            bend, skip = self.scene.bend(contact, time, place, state.flight), phase_of(state) == contact.number
            if self.may_pass:
                found = self._flush(contact, time, state)
                bends = [round_bend(place, (axis,), middle, half, False) for axis, middle, half in found.rim]
                low, high = ([getattr(each, end) for each in bends] or [0.0] for end in ("low", "high"))
                rim = type(bend)(functools.reduce(minimum, low), functools.reduce(maximum, high))
                bend = type(bend)(*[where(found.flush, a, b) for a, b in zip(rim, bend, strict=True)])
                skip = skip | found.inside
        elif contact == self._end_of_slip:
            heading = self._below(time, state).heading
            bend = window._replace(coefficients=window.coefficients[3:]).along(heading, rolling.NONE).bend
            skip = dot(heading, heading) == 0
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
        n, struck, stays = self.scene.struck(contact, time, state.flight, settling.support(state))
        pull = settling.pull(time, struck)
        rise, into, e_n = dot(n, struck.velocity), times(-1.0, dot(n, pull)), self.scene.restitution(contact)
        # Not later than `train.duration`, or nearly.
        soon = rests | (times(2.0, rise) <= 1.001 * left * times(into, 1.0 - e_n))
        soon = settling.floors.include(contact) & (into > 0) & soon

        def plain() -> Meeting:
            return _as_arrays(bounces(ends, Travel(struck, -1.0)), time)

        def unusual() -> Meeting:
            touch = settling.touch(contact, time, state, n, struck, pull, stays)
            return _as_arrays(settling.meets(touch, left, rests, ends), time)

        return _if_any((state.support >= 0) | soon, unusual, plain)

    def after(self, contact, time, state, kind):
        settling = self._settling
        n, struck, stays = self.scene.struck(contact, time, state.flight, settling.support(state))

        def unusual() -> tuple:
            touch = settling.touch(contact, time, state, n, struck, settling.pull(time, struck), stays)
            return _as_arrays(settling.settled(touch, kind, train.summed(*settling.train_of(touch, kind)))[:2], time)

        plain = lambda: _as_arrays((Travel(struck, -1.0), 0.0), time)  # noqa: E731
        return _if_any((state.support >= 0) | (kind != KINDS.bounce), unusual, plain)

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
