"""The flat surfaces of a scene on which a ball may stay after its last bounce, and the choice among them."""

from typing import Any

import jax
import jax.core
import jax.numpy as jnp

from .._impact import Contact, along_surface
from .._math import Choice, Number, Vector3, components, dot, is_constant, norm, ratio, scale
from .scene import Scene
from .surface import AbstractSurface, Face


def _can_settle(surface: AbstractSurface) -> bool:
    """Whether a ball may roll or slide on a surface after its last bounce, as far as is known when it is traced."""
    flat = type(surface).face is not AbstractSurface.face
    elastic = is_constant(surface.law.restitution) and surface.law.restitution == 1
    return flat and surface.law.rolls is not None and not elastic


class Floors:
    """The surfaces of `scene` to stay on. Where a choice is none of them, what it gets are harmless numbers."""

    def __init__(self, scene: Scene):
        self.indices = [i for i, surface in enumerate(scene.surfaces) if _can_settle(surface)]
        self._surfaces = [scene.surfaces[i] for i in self.indices]
        self._laws = [surface.law for surface in self._surfaces]
        self._frictions = [law.sliding_friction() for law in self._laws]
        self._ball = scene.ball
        # Whether a ball may slide against friction, so that its slip is followed.
        self.have_friction = any(friction is not None for friction in self._frictions)
        self.have_edges = any(surface.has_edges for surface in self._surfaces)

    def include(self, contact: Choice) -> Any:
        return contact.among(self.indices)

    def face(self, contact: Choice, x: Vector3, time: Any) -> tuple[Face, Any]:
        """The face below a ball on that surface, and whether it has edges."""
        faces: list[Any] = [surface.face(x, time) for surface in self._surfaces]
        half = [(1.0, 1.0) if face.half is None else face.half for face in faces]
        vector = lambda options: contact.vector(options, self.indices)  # noqa: E731
        below = contact.of([jnp.asarray(face.below) for face in faces], self.indices)
        tangents = (vector([face.tangents[0] for face in faces]), vector([face.tangents[1] for face in faces]))
        centers, normals = vector([face.center for face in faces]), vector([face.normal for face in faces])
        edged = contact.among([i for i, face in zip(self.indices, faces, strict=True) if face.half is not None])
        return Face(normals, centers, tangents, vector(half), below), edged

    def rolls(self, contact: Choice) -> Any:
        """Whether a ball rolls on that surface, perhaps after sliding."""
        flags: list[Any] = [bool(law.rolls) if f is None else f > 0
                 for law, f in zip(self._laws, self._frictions, strict=True)]  # fmt: skip
        return contact.of(flags, self.indices)

    def friction(self, contact: Choice) -> Number:
        """The coefficient on that surface; infinite where a ball never slides or never rolls."""
        return contact.of([jnp.inf if f is None else f for f in self._frictions], self.indices)

    def holds(self, contact: Choice) -> Any:
        """Whether a ball rolls on that surface whatever it meets."""
        return contact.of([bool(law.rolls) and f is None or (f == jnp.inf)
                           for law, f in zip(self._laws, self._frictions, strict=True)], self.indices)  # fmt: skip

    def law(self, contact: Choice) -> Contact:
        """What trains need of that surface."""
        reversals: list = [law.reversal() for law in self._laws]
        return Contact(
            contact.of([law.restitution for law in self._laws], self.indices),
            contact.of(reversals, self.indices),
            self.friction(contact) if self.have_friction else None,
            self.rolls(contact),
            self._ball.inertia_ratio,
            self._ball.radius,
        )


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
