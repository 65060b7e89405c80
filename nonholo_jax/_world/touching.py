"""Surfaces side by side: many of one class as one, what a ball touches of them at one instant, what an impact on all of
it does, and what is flush."""

import itertools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .._impact import Rough, Smooth, Touched, across_supports, reflected, takes_part, without
from .._math import Number, Vector3, dot, frozen, is_constant, plus, scale, subtract, times
from .surface import AbstractSurface
from .system import magnitude, rounding

_TOUCHING = 16.0  # by how many roundings of it a gap may differ from zero
_MOST = 8  # surfaces of those touched that are looked at, if a scene has more
_FEW = 16  # surfaces of which all pairs are looked at before there is a program
_AXES = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


class Member(NamedTuple):
    """A surface of a scene, and its number there, which may be traced."""

    number: Any
    surface: AbstractSurface


class Stack(eqx.Module):
    """Surfaces that follow each other in a scene and differ in nothing but numbers. A number that is one constant of
    all of them stays that; the others have an axis in front."""

    surface: AbstractSurface
    count: int = eqx.field(static=True)

    def at(self, index: Any) -> AbstractSurface:
        """The surface of a traced index, counted from 0; the nearest one for an index that there is none of."""
        index = jnp.clip(index, 0, self.count - 1)
        return jax.tree.map(lambda x: x if is_constant(x) else x[index], self.surface)

    @property
    def first(self) -> AbstractSurface:
        """One of them, for what they have in common."""
        return jax.tree.map(lambda x: x if is_constant(x) else x[0], self.surface)

    def each(self, start: int, function: Callable[[Member], Any]) -> Any:
        """A function of every surface, with an axis in front; the first of them is number `start`."""
        arrays, constants = eqx.partition(self.surface, eqx.is_array)
        numbers = start + np.arange(self.count, dtype=np.int32)
        return jax.vmap(lambda x, i: function(Member(i, eqx.combine(x, constants))))(arrays, numbers)


def stacked(surfaces: Sequence[AbstractSurface], dtype: Any) -> tuple:
    """The surfaces in their order, long rows of one class as `Stack`s."""
    found: list = []
    for _, row in itertools.groupby(surfaces, _structure):
        each = list(row)
        found += each if len(each) <= each[0].few else [Stack(_joined(each, dtype), len(each))]
    return tuple(found)


def _structure(surface: AbstractSurface) -> tuple:
    """What surfaces of one stack have in common. An elastic law is structure: it spares the end of bounces."""
    restitution = surface.law.restitution
    shapes = tuple(() if is_constant(leaf) else jnp.shape(leaf) for leaf in jax.tree.leaves(surface))
    return jax.tree.structure(surface), shapes, is_constant(restitution) and restitution == 1


def _joined(surfaces: Sequence[AbstractSurface], dtype: Any) -> AbstractSurface:
    def join(*leaves: Any) -> Any:
        if not all(is_constant(leaf) for leaf in leaves):
            return jnp.stack([jnp.asarray(leaf, dtype) for leaf in leaves])
        same = all(leaf == leaves[0] for leaf in leaves)
        return leaves[0] if same else jnp.asarray(np.array(leaves), dtype)

    return jax.tree.map(join, *surfaces)


def may_touch_two(surfaces: Sequence[AbstractSurface | Stack], radius: Number) -> bool:
    """Whether a ball may touch two of the surfaces at one instant, as far as is known when it is traced."""
    if any(isinstance(each, Stack) for each in surfaces) or len(surfaces) > _FEW:
        return True
    return any(not are_apart(a, b, radius) for a, b in itertools.combinations(surfaces, 2))  # pyright: ignore


def are_apart(a: AbstractSurface, b: AbstractSurface, radius: Number) -> bool:
    """Whether two surfaces are known to lie on two sides of a slab that is thicker than the ball."""
    if not (is_constant(radius) and _is_known(a, b)):
        return False
    for n in (*a.directions(), *b.directions(), *_AXES):
        for one, other in ((a, b), (b, a)):
            ends = one.most(n), other.most(scale(-1.0, n))
            if all(is_constant(end) for end in ends) and -(ends[0] + ends[1]) > 2.0 * radius:  # pyright: ignore
                return True
    return False


def may_be_flush(surfaces: Sequence[AbstractSurface], radius: Any) -> bool:
    """Whether two surfaces may have faces in one plane, as far as is known when it is traced."""
    flat = [each for each in surfaces if type(each).along is not AbstractSurface.along]
    if not is_constant(radius):  # perhaps one for each of many scenes
        return len(flat) > 1
    return any(_share_a_plane(a, b) and not are_apart(a, b, radius) for a, b in itertools.combinations(flat, 2))


def _share_a_plane(a: AbstractSurface, b: AbstractSurface) -> bool:
    if not _is_known(a, b):
        return True
    for n, m in itertools.product(a.directions(), b.directions()):
        turned = max(abs(x) for x in subtract(n, m))
        apart, size = plus(a.most(n), times(-1.0, b.most(m))), plus(a.extent(), b.extent())  # pyright: ignore
        if turned < 1e-3 and abs(apart) <= 1e-3 * size:
            return True
    return False


def _is_known(*surfaces: AbstractSurface) -> bool:
    """Whether places and sizes are numbers of Python."""
    shapes = [value for each in surfaces for name, value in vars(each).items() if name != "law"]
    return all(is_constant(leaf) for leaf in jax.tree.leaves(shapes))


class Support(NamedTuple):
    """A surface that a ball stays on: in a groove one of two."""

    index: Any  # -1 if there is none
    friction: Number | None  # infinite where the ball never slides or never rolls; `None` if that is so on all surfaces
    rolls: Any


class _Here(NamedTuple):
    """A surface as a ball at one place sees it."""

    normal: Any
    gap: Any  # to first order
    noise: Any  # of the gap
    is_edge: Any  # the nearest part of it is an edge or a corner
    ahead: Any  # how much it lies ahead of the ball: of two flush faces, the ball moves onto the one that does more


def _every(scene: Any, function: Callable[[Member], Any]) -> Any:
    """A function of every surface, with an axis in front."""
    row = lambda x: jnp.asarray(x)[None]  # noqa: E731
    parts = [jax.tree.map(row, function(each)) if isinstance(each, Member) else each[1].each(each[0], function)
             for each in scene.contacts()]  # fmt: skip
    return jax.tree.map(lambda *each: jnp.concatenate(each), *parts)


def touches(scene: Any, member: Member, time: Any, position: Vector3) -> Any:
    """Whether a ball touches a surface, to rounding."""
    noise = rounding(scene, member, magnitude(position), time.dtype)
    return abs(scene.level(member, time, position, None)) <= _TOUCHING * noise


def touches_two(scene: Any, time: Any, position: Vector3) -> Any:
    """Whether a ball touches more than one surface."""
    return jnp.sum(_every(scene, lambda each: touches(scene, each, time, position)), dtype=jnp.int32) > 1


class Neighbours(NamedTuple):
    """What is flush with a face, for every surface, with an axis in front."""

    flush: Any  # whether it has a face in the same plane
    holds: Any  # whether the ball is above that face, or comes above it at once
    ahead: Any  # of several, the ball moves onto the one that is most of this


def neighbours(scene: Any, time: Any, normal: Vector3, height: Any, state: Any) -> Neighbours:
    """The faces in one plane with that of a `normal`, above which a ball is at a `height`."""
    x, radius = state.position, scene.ball.radius

    def of(each: Member) -> Neighbours:
        noise = rounding(scene, each, magnitude(x), time.dtype)
        face = each.surface.along(normal, x, state.velocity, _TOUCHING * noise)
        if face is None:
            return Neighbours(jnp.asarray(False), jnp.asarray(False), jnp.asarray(-jnp.inf, time.dtype))
        turned = jnp.max(jnp.stack([jnp.asarray(abs(c), time.dtype) for c in subtract(face.normal, normal)]))
        flush = (turned <= 2.0 * noise / radius) & (abs(face.height - height) <= _TOUCHING * noise)
        return Neighbours(flush, jnp.asarray(face.holds), jnp.asarray(face.ahead, time.dtype))

    return frozen(_every(scene, of))


def after_all(scene: Any, time: Any, struck: Any, state: Any, supports: tuple[Support, ...]) -> tuple:
    """An impact on everything that is touched, of a ball that hits the surface number `struck`: whether it is more than
    an ordinary impact on that; velocity and spin afterwards; and on which supports the ball still is then."""
    nearby = _nearby(scene, time, struck, state, supports)
    touched, pick = nearby
    v = jnp.stack([jnp.asarray(c, time.dtype) for c in state.velocity])
    # A ball on its support moves along it. What gravity has added to that by rounding may be more than that of v.
    parts, stays = takes_part(frozen(touched), frozen(without(across_supports(touched), v)))
    only = jnp.any(parts & (pick(numbers_of(scene)) == struck)) & (jnp.sum(parts, dtype=jnp.int32) == 1)
    touched = touched._replace(takes_part=parts)

    def factors(closing: Any, squared: Any) -> Any:
        sizes = [_spread(x, pick, scene.n_contacts) for x in (closing, squared)]
        alpha = scene.ball.inertia_ratio

        def factor(each: Member) -> Any:
            here = [x[each.number] for x in sizes]
            return jnp.asarray(each.surface.law.slip_factor(alpha, *here), time.dtype)

        return pick(_every(scene, factor))

    friction = tuple(each.friction for each in supports if each.friction is not None) or None
    sizes, rolls = (scene.ball.radius, scene.ball.inertia_ratio), tuple(each.rolls for each in supports)
    after = reflected(*sizes, touched, factors, friction, rolls, state.velocity, state.spin, _levels(scene))
    return ~only | jnp.any(stays), after, stays


def numbers_of(scene: Any) -> Any:
    """The number of every surface."""
    return jnp.arange(scene.n_contacts, dtype=jnp.int32)


def _levels(scene: Any) -> tuple[float, ...] | None:
    """By how much the laws of a scene multiply what stops a slip, from the largest to the smallest and without zero, if
    that is known when it is traced."""
    laws = [each.first.law if isinstance(each, Stack) else each.law for each in scene.surfaces]
    reversals = [law.reversal() for law in laws]
    known = all(type(law) in (Rough, Smooth) and is_constant(e) for law, e in zip(laws, reversals, strict=True))
    if not known:
        return None
    found = sorted({1.0 + float(e) for e in reversals if e > -1}, reverse=True)  # pyright: ignore
    apart = all(b < 0.99 * a for a, b in itertools.pairwise(found))
    return tuple(found) if apart and found else None


def _spread(x: Any, pick: Callable, count: int) -> Any:
    """What belongs to the surfaces that were picked, for all surfaces."""
    return jnp.zeros((count,), x.dtype).at[pick(jnp.arange(count, dtype=jnp.int32))].set(x)


def _nearby(scene: Any, time: Any, struck: Any, state: Any, supports: tuple[Support, ...]) -> tuple[Touched, Callable]:
    """The surfaces that are touched, without those that say nothing of their own; and what picks from a value for every
    surface those that are looked at."""
    x, count = state.position, scene.n_contacts
    here = _every(scene, lambda each: _seen(scene, each, time, state))
    numbers = numbers_of(scene)
    is_support = jnp.zeros((0, count), bool)
    if supports:
        is_support = jnp.stack([numbers == each.index for each in supports])
    held = jnp.any(is_support, axis=0)
    touched = (abs(here.gap) <= _TOUCHING * here.noise) | (numbers == struck) | held
    pick: Callable = lambda values: values  # noqa: E731
    if count > _MOST:
        # The one that is hit and the support before the others.
        wanted = touched.astype(jnp.int32) + ((numbers == struck) | held).astype(jnp.int32)
        _, few = jax.lax.top_k(frozen(wanted), _MOST)
        pick = lambda values: values[few]  # noqa: E731
        touched, held, here = pick(touched), pick(held), jax.tree.map(pick, here)
        is_support = jax.vmap(pick)(is_support)
    spare = frozen(_are_spare(scene, time, x, here, touched, held, pick))
    law = lambda each: jnp.asarray(each.surface.law.restitution, time.dtype)  # noqa: E731
    restitution = pick(_every(scene, law))
    return Touched(here.normal, touched & ~spare, is_support, restitution), pick


def _seen(scene: Any, each: Member, time: Any, state: Any) -> _Here:
    surface, x = each.surface, state.position
    as_array = lambda value: jnp.asarray(value, time.dtype)  # noqa: E731
    is_edge, ahead, face = jnp.asarray(False), as_array(-jnp.inf), surface.face(x, time)
    if surface.has_edges and face is not None:
        is_edge = ~jnp.asarray(face.below)
        ahead = as_array(dot(state.velocity, subtract(face.center, x)))
    normal = jnp.stack([as_array(c) for c in surface.direction(x, time)])
    gap = as_array(scene.level(each, time, x, state))
    noise = as_array(rounding(scene, each, magnitude(x), time.dtype))
    return _Here(normal, gap, noise, is_edge, ahead)


def _are_spare(scene: Any, time: Any, x: Any, here: _Here, touched: Any, held: Any, pick: Callable) -> Any:
    """Which of the touched surfaces say nothing that another one does not: edges that lie on another surface, as two
    flush faces have them where they meet, and faces with one normal."""
    radius = scene.ball.radius
    place = jnp.stack([jnp.asarray(c, time.dtype) for c in x])
    points = place[None] - (radius + here.gap)[:, None] * here.normal
    far = lambda each: jax.vmap(lambda p: jnp.asarray(each.surface.distance(tuple(p), time), time.dtype))(points)  # noqa: E731
    lies_on = pick(abs(_every(scene, far))) <= 2.0 * here.noise[:, None]  # of the point of the second on the first
    apart = jnp.max(abs(here.normal[:, None] - here.normal[None]), axis=-1)
    alike = apart <= 2.0 * here.noise[:, None] / radius
    alike = alike & ~here.is_edge[:, None] & ~here.is_edge[None]
    covers = touched[:, None] & touched[None] & ~jnp.eye(touched.size, dtype=bool)
    covers = covers & ((lies_on & here.is_edge[None]) | alike)
    # Of two that cover each other one stays, the same one in whatever order they come.
    order = jnp.arange(touched.size, dtype=jnp.int32)
    keys = (held.astype(jnp.int32), 1 - here.is_edge.astype(jnp.int32), here.ahead, -here.gap, -order)
    better, equal = jnp.zeros_like(covers), jnp.ones_like(covers)
    for key in keys:
        better = better | (equal & (key[:, None] > key[None]))
        equal = equal & (key[:, None] == key[None])
    return jnp.any(covers & (better | ~covers.T), axis=0)
