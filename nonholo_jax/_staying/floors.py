"""The surfaces of a scene that a ball may stay on."""

import functools
import operator
import weakref
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
import numpy as np

from .._impact import AbstractContactLaw, Contact, along_surface, rolling
from .._math import Choice, Number, Vector3, Window, components, dot, frozen, is_constant, norm, ratio, scale, slope
from .._world import AbstractSurface, Face, Implicit, Member, Scene, Stack, may_be_flush


def _asked_once(question: Callable) -> Callable:
    """A question about a scene, and other arguments that can be hashed, whose answer is kept as long as the scene is: a
    call of a compiled program would else spend longer on such questions than the program runs."""
    answers: dict[tuple, tuple[weakref.ref, Any]] = {}

    @functools.wraps(question)
    def answer(scene: Any, *rest: Any) -> Any:
        key = (id(scene), *rest)
        known = answers.get(key)
        if known is not None and known[0]() is scene:
            return known[1]
        found = question(scene, *rest)
        if not any(isinstance(leaf, np.ndarray) for leaf in jax.tree.leaves(scene)):  # their numbers may change
            answers[key] = (weakref.ref(scene, lambda _: answers.pop(key, None)), found)
        return found

    return answer


def can_settle(surface: AbstractSurface, curved: bool = False) -> bool:
    """Whether a ball may roll or slide on a surface after its last bounce, as far as is known when it is traced; if
    not `curved`, on a flat one only."""
    if curved:
        return surface.law.rolls is not None
    flat = type(surface).face is not AbstractSurface.face
    return flat and surface.law.rolls is not None and not is_elastic(surface)


def is_elastic(surface: AbstractSurface) -> bool:
    """Whether bounces on a surface are known never to die out."""
    return is_constant(surface.law.restitution) and bool(surface.law.restitution == 1)


def is_coarse(scene: Any, arc: Any, is_on: Callable[[Any], Any]) -> Any:
    """Whether a step along a surface is so long that, by the bounds of how its level bends, a dent or a ridge of a
    thousandth of the radius may lie between the places where the step has looked; `None` where all of them are known by
    a few numbers."""
    path, most = frozen(tuple(arc.configuration[:3])), 1e-3 * scene.ball.radius

    def strays(each: Member) -> Any:
        low, high = each.surface.bend(Window(path, arc.length), arc.time, scene.ball.radius)
        aside = jnp.maximum(abs(low), abs(high)) * arc.length * arc.length / 8.0
        return jnp.where(is_on(each.number), aside > most, False)

    found = []
    for each in scene.contacts():
        kind = each.surface if isinstance(each, Member) else each[1].first
        if isinstance(kind, Implicit) and kind.is_bounded():
            found.append(strays(each) if isinstance(each, Member) else jnp.any(each[1].each(each[0], strays)))
    return functools.reduce(operator.or_, found) if found else None


class Floors:
    """The surfaces of `scene` to stay on: if `curved`, of any shape, each seen as the plane that touches it below the
    ball. Where a choice is none of them, what it gets are harmless numbers."""

    def __init__(self, scene: Any, curved: bool = False):
        kinds = [each.first if isinstance(each, Stack) else each for each in scene.surfaces]
        self.curved = curved
        self.indices = [i for i, surface in enumerate(kinds) if can_settle(surface, curved)]
        self._ball, floors = scene.ball, [kinds[i] for i in self.indices]
        # Whether a ball may slide against friction, so that its slip is followed.
        self.have_friction = any(surface.law.sliding_friction() is not None for surface in floors)
        self.have_edges = not curved and any(surface.has_edges for surface in floors)
        resistance = [surface.law.resistance() for surface in floors]
        # Whether anything resists rolling, and spinning about the normal, on any of them.
        self.resist = tuple(
            any(not (is_constant(c) and c == 0) for c in each) for each in zip(*resistance, strict=True)
        )
        self.resist = self.resist or (False, False)
        self.n_seams = max([len(surface.seams()) for surface in floors], default=0) if curved else 0

    def include(self, contact: Choice) -> Any:
        return contact.among(self.indices)

    def _of(self, contact: Choice, function: Callable[[AbstractSurface], Any]) -> Any:
        return contact.of([function(contact.members[i].surface) for i in self.indices], self.indices)

    def face(self, contact: Choice, x: Vector3, time: Any) -> tuple[Face, Any]:
        """The face below a ball on that surface, and whether it has edges."""
        if self.curved:
            n = self._vector(contact, lambda surface: surface.direction(x, time))
            still = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
            return Face(n, x, still, None, True), False
        faces: list[Any] = [contact.members[i].surface.face(x, time) for i in self.indices]
        half = [(1.0, 1.0) if face.half is None else face.half for face in faces]
        vector = lambda options: contact.vector(options, self.indices)  # noqa: E731
        below = contact.of([jnp.asarray(face.below) for face in faces], self.indices)
        tangents = (vector([face.tangents[0] for face in faces]), vector([face.tangents[1] for face in faces]))
        centers, normals = vector([face.center for face in faces]), vector([face.normal for face in faces])
        edged = contact.among([i for i, face in zip(self.indices, faces, strict=True) if face.half is not None])
        return Face(normals, centers, tangents, vector(half), below), edged

    def _vector(self, contact: Choice, function: Callable[[AbstractSurface], Any]) -> Vector3:
        return contact.vector([function(contact.members[i].surface) for i in self.indices], self.indices)

    def turning(
        self, contact: Choice, x: Vector3, v: Vector3, time: Any, beyond: Sequence | None = None
    ) -> tuple[Vector3, Vector3]:
        """The normal below a ball on that surface, and how fast it turns as the ball goes along; if it is known which
        seams it is `beyond`, of that part of the surface."""

        def normal(*x: Any) -> tuple:
            def direction(surface: AbstractSurface) -> Any:
                if beyond is None:
                    return surface.direction(x, time)  # pyright: ignore
                return surface.direction_within(x, time, beyond[: len(surface.seams())])  # pyright: ignore

            n = self._vector(contact, direction)
            return tuple(jnp.asarray(c, time.dtype) for c in n)

        arrays = [tuple(jnp.asarray(c, time.dtype) for c in each) for each in (x, v)]
        return jax.jvp(normal, *arrays)  # pyright: ignore

    def depth(self, contact: Choice, x: Vector3, n: Vector3, time: Any) -> Number:
        """How far a ball is off that surface, to first order, along the normal there."""

        def level(x: Any) -> Any:
            return self._of(contact, lambda surface: surface.level(x, time, self._ball.radius))

        value, rate = slope(level, x, n)
        return ratio(value, rate)

    def seam(self, contact: Choice, k: int) -> tuple[Sequence[Vector3], Vector3, Number, Any]:
        """Seam number k, across which that surface bends otherwise: the axes across it, its middle, the distance from
        there, and whether there is such a seam."""
        found = [(i, contact.members[i].surface.seams()) for i in self.indices]
        rows = [(i, seams[k]) for i, seams in found if len(seams) > k]
        numbers, most = [i for i, _ in rows], max(len(row[0]) for _, row in rows)
        each = [(*row[0], *[rolling.NONE] * (most - len(row[0]))) for _, row in rows]
        axes = [contact.vector(column, numbers) for column in zip(*each, strict=True)]
        middle = contact.vector([row[1] for _, row in rows], numbers)
        return axes, middle, contact.of([row[2] for _, row in rows], numbers), contact.among(numbers)

    def rolls(self, contact: Choice) -> Any:
        """Whether a ball rolls on that surface, perhaps after sliding."""
        return self._of(contact, lambda surface: _rolls(surface.law))

    def friction(self, contact: Choice) -> Number:
        """The coefficient on that surface; infinite where a ball never slides or never rolls."""
        return self._of(contact, lambda surface: _friction(surface.law))

    def resistance(self, contact: Choice, which: int) -> Number:
        """The coefficient of rolling resistance on that surface (0), or of spinning friction (1)."""
        return self._of(contact, lambda surface: surface.law.resistance()[which])

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


@_asked_once
def may_settle(scene: Scene, curved: bool) -> bool:
    """Whether there is a surface that a ball may stay on."""
    return bool(Floors(scene, curved).indices)


@_asked_once
def may_pass(scene: Scene, curved: bool) -> bool:
    """Whether a ball may come from one face, or part of a surface, onto another without an impact."""
    return (curved and Floors(scene, curved).n_seams > 0) or may_be_flush(scene.surfaces, scene.ball.radius)


@_asked_once
def stays_curved(scene: Scene, edges: bool | None) -> bool:
    """Whether a ball is to be followed where it stays on a surface that is not flat; `edges` is that of `Integrated`.
    From the outside of spheres and cylinders it soon rolls off, so that only those that hold it count here."""
    if edges is not None:
        return edges
    if scene.air is not None and Floors(scene).resist[1]:
        return True
    hollow = [each for each in scene.surfaces if type(each).face is AbstractSurface.face and getattr(each, "inside", 1)]
    return any(can_settle(each, curved=True) and not is_elastic(each) for each in hollow)


@_asked_once
def slides_across(scene: Scene) -> bool:
    """Whether a ball is known now, not only when the program runs, to meet a slope that it may slide across."""
    if any(isinstance(leaf, jax.core.Tracer) or np.ndim(leaf) > 1 for leaf in jax.tree.leaves(scene)):
        return False
    # As numbers of Python, on which every operation of JAX would be a program of its own to compile.
    known = functools.partial(jax.tree.map, lambda x: float(x) if eqx.is_inexact_array(x) and x.ndim == 0 else x)
    if not any(_may_bend(known(surface.law)) for surface in scene.surfaces):
        return False
    scene = known(scene)
    with jax.ensure_compile_time_eval():  # known numbers, also within a transformation
        return _meets_slope(scene)


def _may_bend(law: AbstractContactLaw) -> bool:
    """Whether a ball on a slope is slowed against its direction, so that its path there is no parabola."""
    return law.sliding_friction() is not None or bool(law.resistance()[0] != 0)


def _meets_slope(scene: Scene) -> bool:
    g = components(scene.gravity)
    above = scale(ratio(-1e6, norm(g)), g)
    for surface in scene.surfaces:
        face = surface.face(above, 0.0) if can_settle(surface) else None
        if face is not None and _may_bend(surface.law):
            steep = norm(along_surface(face.normal, g)) > 1e-6 * norm(g)
            if bool(steep) and bool(dot(face.normal, g) < 0):
                return True
    return False
