"""A scene: one ball, named surfaces, gravity and perhaps air."""

import functools
import itertools
from collections.abc import Callable, Mapping
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
from jax import lax

from .._math import (
    Block,
    Choice,
    Hopper,
    Number,
    Vector3,
    Wall,
    Window,
    add,
    as_vector,
    components,
    cross,
    dot,
    hop,
    hop_again,
    is_constant,
    plus,
    ratio,
    scale,
    shared,
    subtract,
    times,
    turned,
    where,
)
from .air import Air
from .ball import Ball, BallState, check_ball_state
from .box import AbstractBlock, along
from .surface import AbstractSurface, Plane
from .system import AbstractSystem, bounces, magnitude, rounding
from .touching import Member, Stack, Support, after_all, may_touch_two, stacked, touches_two


class Flight(NamedTuple):
    """A ball's state inside the engine: one scalar per component."""

    position: Vector3
    velocity: Vector3
    spin: Vector3
    orientation: Any


class Scene(AbstractSystem):
    """A ball and what it can hit.

    **Arguments:**

    - `ball`: a `Ball`.
    - `surfaces`: a mapping from names to surfaces, in the order that `ImpactLog.surface` counts. May be empty.
    - `gravity`: acceleration in m/s^2, shape (3,).
    - `air`: an `Air`, or `None` for flight along parabolas.

    Every number may be a JAX array: it is then traced, and can be differentiated and mapped over. Numbers of Python
    become constants of the compiled program. Raises `ValueError` where a number that is known is not admissible.

    ```python
    from nonholo_jax import Ball, Plane, Rough, Scene
    floor = Plane((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), Rough(restitution=0.9))
    scene = Scene(Ball(radius=0.025, mass=0.046), {"floor": floor})
    ```
    """

    ball: Ball
    surfaces: tuple[AbstractSurface, ...]
    gravity: Any = eqx.field(converter=as_vector)
    air: Air | None
    names: tuple[str, ...] = eqx.field(static=True)
    is_long: ClassVar[bool] = False

    def __init__(
        self,
        ball: Ball,
        surfaces: Mapping[str, AbstractSurface],
        gravity: Any = (0.0, 0.0, -9.81),
        air: Air | None = None,
    ):
        if not isinstance(ball, Ball):
            raise ValueError(f"Argument `ball` must be a Ball, but got {ball!r}; try Ball(radius=0.025, mass=0.046).")
        if not isinstance(surfaces, Mapping) or not all(isinstance(s, AbstractSurface) for s in surfaces.values()):
            raise ValueError(
                f"Argument `surfaces` must map names to surfaces, but got {surfaces!r}; try {{'floor': Plane(...)}}."
            )
        self.ball = ball
        self.surfaces = tuple(surfaces.values())
        self.names = tuple(surfaces)
        self.gravity = as_vector(gravity)
        self.air = air
        for name, surface in surfaces.items():
            for holds, sentence in surface.is_proper(ball.radius):
                if isinstance(holds, bool) and not holds:
                    raise ValueError(f"Surface `{name}`: argument {sentence}.")

    def surface(self, name: str) -> AbstractSurface:
        """The surface of that name; raises `ValueError` with the known names if there is none."""
        if name not in self.names:
            raise ValueError(f"Argument `name` must be one of {', '.join(self.names)}, but got {name!r}.")
        return self.surfaces[self.names.index(name)]

    @property
    def n_contacts(self) -> int:  # pyright: ignore[reportIncompatibleVariableOverride]
        return len(self.names)

    def evolving(self, state: Flight) -> tuple:
        return state.position, state.velocity

    def is_uniform(self):
        return self.air is None

    def prepared(self, time, state):
        return state

    def derivative(self, time, state, q, v):
        g = components(self.gravity)
        return v, g if self.air is None else add(g, self.air.acceleration(self.ball, v, state.spin))

    def rate_of(self, time, state):
        return state.velocity

    def advanced(self, time, state, q, v, duration):
        orientation = state.orientation
        if orientation is not None:  # the spin is constant in flight, so that the rotation is exact
            angle = jnp.stack([jnp.asarray(w * duration, dtype=orientation.dtype) for w in state.spin])
            orientation = turned(orientation, angle)
        return Flight(q, v, state.spin, orientation)

    def meets(self, contact, time, state, left, rests, ends):
        return bounces(ends, self.bounced(contact, time, state))

    def after(self, contact, time, state, kind):
        return self.bounced(contact, time, state), 0.0

    def during(self, contact, time, state, elapsed):
        return state

    def named(self, contact, state):
        return contact.index

    def phase(self, state):
        return jnp.asarray(-1, dtype=jnp.int32)

    def bounced(self, contact, time, state):
        return self.struck(contact, time, state)[1]

    def engine(self, dtype):
        surfaces = [each.engine() for each in self.surfaces]
        return eqx.tree_at(lambda scene: scene.surfaces, self, stacked(surfaces, dtype))

    def contacts(self):
        starts = itertools.accumulate(self._sizes, initial=0)
        return [(i, each) if isinstance(each, Stack) else Member(i, each) for i, each in zip(starts, self.surfaces)]  # noqa: B905

    @property
    def _sizes(self) -> tuple[int, ...]:
        return tuple(each.count if isinstance(each, Stack) else 1 for each in self.surfaces)

    def choice(self, index):
        members = [each if isinstance(each, Member) else Member(index, each[1].at(index - each[0]))
                   for each in self.contacts()]  # fmt: skip
        return Choice(index, len(members), self._sizes, members)

    def chosen(self, contact: Choice) -> list[AbstractSurface]:
        """Of every class, the surface that may be the one."""
        return [each.surface for each in contact.members if isinstance(each, Member)]

    def normal(self, contact: Choice, time: Any, x: Vector3) -> Vector3:
        return contact.vector([surface.direction(x, time) for surface in self.chosen(contact)])

    def restitution(self, contact: Choice) -> Number:
        return contact.of([surface.law.restitution for surface in self.chosen(contact)])

    def struck(self, contact: Choice, time: Any, state: Flight, supports: tuple[Support, ...] = ()) -> tuple:
        """The normal of a contact, the state after an impact there, and on which of its supports a ball still is then:
        by Theorem 5.2, for any normal and any law; where it touches several surfaces, on all of them."""
        normals = [surface.direction(state.position, time) for surface in self.chosen(contact)]
        n = shared(contact.vector(normals))
        as_arrays = lambda tree: jax.tree.map(lambda x: jnp.asarray(x, dtype=time.dtype), tree)  # noqa: E731
        single = self._after(contact, n, state.velocity, state.spin)
        if not may_touch_two(self.surfaces, self.ball.radius):
            return n, state._replace(velocity=single[0], spin=single[1]), (False,) * len(supports)
        several, no = touches_two(self, time, state.position), jnp.asarray(False)

        def on_all(_: Any) -> tuple:
            unusual, after, stays = after_all(self, time, contact.index, state, supports)
            return unusual, as_arrays(after), tuple(stays)

        unusual, after, stays = lax.cond(
            eqxi.unvmap_any(several), on_all, lambda each: (no, each, (no,) * len(supports)), as_arrays(single)
        )
        velocity, spin = jax.tree.map(lambda a, b: where(several & unusual, a, b), after, as_arrays(single))
        return n, state._replace(velocity=velocity, spin=spin), tuple(several & each for each in stays)

    def _after(self, contact: Choice, n: Vector3, velocity: Vector3, spin: Vector3, shared: Callable = shared) -> Any:
        """Velocity and spin after an impact on one surface, with the normal there."""
        ball = self.ball
        e_n, closing = self.restitution(contact), dot(n, velocity)
        slip = subtract(subtract(velocity, scale(ball.radius, cross(spin, n))), scale(closing, n))
        closing, *slip = shared([closing, *slip])
        sizes = (ball.inertia_ratio, abs(closing), dot(slip, slip))
        s = contact.of([surface.law.slip_factor(*sizes) for surface in self.chosen(contact)])
        s, rebound = shared([s, times(plus(1.0, e_n), closing)])
        kick = add(scale(rebound, n), scale(s, slip))
        twist = times(s, ratio(1.0, times(ball.inertia_ratio, ball.radius)))
        return subtract(velocity, kick), add(spin, scale(twist, cross(n, tuple(slip))))

    def hopper(self, state):
        if len(self.surfaces) == 0 or self.air is not None or state.orientation is not None:
            return None
        if all(type(each) is Plane for each in self.surfaces):
            return Hopper(self.hop, self.hop_again)
        known = all(isinstance(each, (Plane, AbstractBlock)) for each in self.surfaces)
        return Hopper(self.hop, None) if known else None

    def hop(self, touching, going, full, left, state, dies_out=lambda *_: False):
        """A parabola and the impact that ends it; `dies_out(i, wall, speed, left)` says whether bounces may end after
        an impact."""
        walls, g, kicked = self._hopping(left, state)
        parts = (state.position, state.velocity, state.spin)
        done = hop(walls, g, kicked, dies_out, touching, going, full, left, parts)
        position, velocity, spin = done.state
        return done._replace(state=Flight(position, velocity, spin, None))

    def hop_again(self, touching, choice, left, state):
        """The same with derivatives, after the choice has been made."""
        walls, g, kicked = self._hopping(left, state)
        parts = (state.position, state.velocity, state.spin)
        duration, (position, velocity, spin) = hop_again(walls, g, kicked, touching, choice, left, parts)
        return duration, Flight(position, velocity, spin, None)

    def _hopping(self, left, state):
        """Planes, gravity and impacts, as hops see them."""
        g, x = components(self.gravity), state.position
        walls, origin, zero = [], (0.0, 0.0, 0.0), jnp.zeros_like(left)
        half_g, v = scale(0.5, g), state.velocity
        for i, surface in enumerate(self.surfaces):
            noise = rounding(self, i, magnitude(x), left.dtype)
            if isinstance(surface, AbstractBlock):
                place, axes, half = surface.in_frame(x)
                walls.append(Block(place, along(v, axes), along(half_g, axes), half, self.ball.radius, noise))
            else:
                n = surface.direction(x, 0.0)
                gap, there = (self.level(i, zero, place, state) for place in (x, origin))
                walls.append(Wall(n, gap, dot(n, v), dot(n, half_g), noise, there))

        def kicked(choice, position, velocity, spin):
            choice = self.choice(choice)
            n = self.normal(choice, 0.0, position)
            # Only the slip is shared: each number more is one more pass over the batch.
            return self._after(choice, n, velocity, spin, lambda x: (x[0], *shared(x[1:])) if len(x) > 2 else x)

        return walls, g, kicked

    def _surface(self, contact: Any) -> AbstractSurface:
        return contact.surface if isinstance(contact, Member) else self.surfaces[contact]

    def level(self, contact, time, q, state):
        return self._surface(contact).level(q, time, self.ball.radius)

    def is_parabolic(self, contact):
        return self._surface(contact).is_parabolic

    def returns(self, contact, time, q, v, half_a, state):
        surface = self._surface(contact)
        elastic = is_constant(surface.law.restitution) and surface.law.restitution == 1  # such bounces stay high
        return None if elastic else surface.returns(q, v, half_a, time)

    def reach(self, contact, q):
        return self._surface(contact).reach(q, self.ball.radius)

    def bend(self, contact, time, window: Window, state):
        return self._surface(contact).bend(window, time, self.ball.radius)

    def is_wide(self, contact):
        return self._surface(contact).is_wide()

    def unbounded(self, state):
        return [f"surface `{name}`" for name, surface in zip(self.names, self.surfaces) if not surface.is_bounded()]  # noqa: B905

    def extent(self, contact):
        return plus(self._surface(contact).extent(), self.ball.radius)

    def is_admissible(self, time, state):
        leaves = [leaf for leaf in jax.tree.leaves((self, state)) if not is_constant(leaf)]
        holds: list = [jnp.all(jnp.isfinite(leaf)) for leaf in leaves]
        holds += [value > 0 for value in (self.ball.radius, self.ball.mass, self.ball.inertia_ratio)]
        size = magnitude(state.position)

        def fits(member: Member) -> Any:
            surface = member.surface
            checks = [check for check, _ in (*surface.is_proper(self.ball.radius), *surface.law.admissible())]
            depth = self.level(member, time, state.position, state) + 16.0 * rounding(self, member, size, time.dtype)
            return functools.reduce(jnp.logical_and, [x for x in checks if x is not True], depth >= 0)

        for each in self.contacts():
            holds.append(fits(each) if isinstance(each, Member) else jnp.all(each[1].each(each[0], fits)))
        return functools.reduce(jnp.logical_and, [x for x in holds if x is not True], jnp.asarray(True))

    def received(self, state, batch, t0):
        check_ball_state(state, batch)
        return state

    def unpacked(self, state: BallState, phase=None) -> Flight:
        dtype = state.position.dtype
        parts = [components(x.astype(dtype)) for x in (state.position, state.velocity, state.spin)]
        orientation = state.orientation
        if orientation is not None:
            orientation = orientation.astype(dtype) / jnp.linalg.norm(orientation.astype(dtype))
        return Flight(*parts, orientation)  # pyright: ignore

    def packed(self, state: Flight) -> BallState:
        parts = [jnp.stack(x, axis=-1) for x in (state.position, state.velocity, state.spin)]
        return BallState(parts[0], parts[1], parts[2], state.orientation)

    def contact_frame(self, contact, time, state: Flight):
        n = self.normal(contact, time, state.position)
        n = tuple(jnp.asarray(c, dtype=time.dtype) for c in n)
        point = subtract(state.position, scale(self.ball.radius, n))
        return jnp.stack(point), jnp.stack(n)

    def without_contacts(self) -> "Scene":
        return Scene(self.ball, {}, self.gravity, self.air)
