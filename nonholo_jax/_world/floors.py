"""The flat surfaces of a scene on which a ball may stay after its last bounce, and the choice among them."""

from collections.abc import Callable
from typing import Any

import jax
import jax.core
import jax.numpy as jnp

from .._impact import AbstractContactLaw, Contact, along_surface
from .._math import Choice, Number, Vector3, components, dot, is_constant, norm, ratio, scale
from .scene import Scene
from .stack import Stack
from .surface import AbstractSurface, Face


def _can_settle(surface: AbstractSurface) -> bool:
    """Whether a ball may roll or slide on a surface after its last bounce, as far as is known when it is traced."""
    flat = type(surface).face is not AbstractSurface.face
    elastic = is_constant(surface.law.restitution) and surface.law.restitution == 1
    return flat and surface.law.rolls is not None and not elastic


class Floors:
    """The surfaces of `scene` to stay on. Where a choice is none of them, what it gets are harmless numbers."""

    def __init__(self, scene: Scene):
        kinds = [each.surface if isinstance(each, Stack) else each for each in scene.surfaces]
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

    def holds(self, contact: Choice) -> Any:
        """Whether a ball rolls on that surface whatever it meets."""
        return self._of(contact, lambda surface: _rolls(surface.law) & (_friction(surface.law) == jnp.inf))

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


def slides_across(scene: Scene) -> bool:
    """Whether a ball is known now, not only when the program runs, to meet a slope that it may slide across."""
    if any(isinstance(leaf, jax.core.Tracer) or jnp.ndim(leaf) > 1 for leaf in jax.tree.leaves(scene)):
        return False
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
