"""The flat surfaces of a scene on which a ball may stay after its last bounce, and the choice among them."""

from collections.abc import Sequence
from typing import Any

import jax
import jax.core
import jax.numpy as jnp

from .._impact import Contact, along_surface
from .._math import Number, Vector3, components, dot, is_constant, norm, ratio, scale, where_number
from .scene import Scene
from .surface import AbstractSurface, Face


def _can_settle(surface: AbstractSurface) -> bool:
    """Whether a ball may roll or slide on a surface after its last bounce, as far as is known when it is traced."""
    flat = type(surface).face is not AbstractSurface.face
    elastic = is_constant(surface.law.restitution) and surface.law.restitution == 1
    return flat and surface.law.rolls is not None and not elastic


class Floors:
    """The surfaces of `scene` to stay on. Where an index is asked for, that of any other surface, or -1, gives harmless
    numbers."""

    def __init__(self, scene: Scene):
        self.indices = [i for i, surface in enumerate(scene.surfaces) if _can_settle(surface)]
        self._surfaces = [scene.surfaces[i] for i in self.indices]
        self._laws = [surface.law for surface in self._surfaces]
        self._frictions = [law.sliding_friction() for law in self._laws]
        self._ball = scene.ball

    @property
    def have_friction(self) -> bool:
        """Whether a ball may slide against friction, so that its slip is followed."""
        return any(friction is not None for friction in self._frictions)

    @property
    def have_edges(self) -> bool:
        return any(face.half is not None for face in self._faces((0.0, 0.0, 0.0), 0.0))

    def include(self, index: Any) -> Any:
        return jnp.any(jnp.stack([index == i for i in self.indices]))

    def _pick(self, index: Any, options: Sequence[Number]) -> Number:
        """The option of that surface; the last one for every other index."""
        result = options[-1]
        for i, option in zip(self.indices[-2::-1], options[-2::-1], strict=True):
            result = where_number(index == i, option, result)
        return result

    def _faces(self, x: Vector3, time: Any) -> list[Face]:
        faces = [surface.face(x, time) for surface in self._surfaces]
        return [face for face in faces if face is not None]

    def face(self, index: Any, x: Vector3, time: Any) -> tuple[Face, Any]:
        """The face below a ball on the surface of that index, and whether it has edges."""
        faces = self._faces(x, time)

        def vector(options: Sequence[Vector3]) -> Vector3:
            return tuple(self._pick(index, [each[k] for each in options]) for k in range(3))  # pyright: ignore

        half = [(1.0, 1.0) if face.half is None else face.half for face in faces]
        below: Any = self._pick(index, [jnp.where(face.below, 1.0, 0.0) for face in faces])
        face = Face(
            vector([face.normal for face in faces]),
            vector([face.center for face in faces]),
            (vector([face.tangents[0] for face in faces]), vector([face.tangents[1] for face in faces])),
            (self._pick(index, [h[0] for h in half]), self._pick(index, [h[1] for h in half])),
            below > 0.5,
        )
        return face, self._pick(index, [0.0 if each.half is None else 1.0 for each in faces])

    def rolls(self, index: Any) -> Any:
        """Whether a ball rolls on the surface of that index, perhaps after sliding."""
        flags = [(1.0 if law.rolls else 0.0) if f is None else jnp.where(jnp.asarray(f) > 0, 1.0, 0.0)
                 for law, f in zip(self._laws, self._frictions, strict=True)]  # fmt: skip
        return jnp.asarray(self._pick(index, flags)) > 0.5

    def friction(self, index: Any) -> Number:
        """The coefficient on the surface of that index; infinite where a ball never slides or never rolls."""
        return self._pick(index, [jnp.inf if f is None else f for f in self._frictions])

    def holds(self, index: Any) -> Any:
        """Whether a ball rolls on the surface of that index whatever it meets."""
        return self.rolls(index) & ~jnp.isfinite(self.friction(index))

    def law(self, index: Any) -> Contact:
        """What trains need of the surface of that index."""
        reversals: list = [law.reversal() for law in self._laws]
        return Contact(
            self._pick(index, [law.restitution for law in self._laws]),
            self._pick(index, reversals),
            self.friction(index) if self.have_friction else None,
            self.rolls(index),
            self._ball.inertia_ratio,
            self._ball.radius,
        )


def slides_across(scene: Scene) -> bool:
    """Whether a ball is known now, not only when the program runs, to meet a slope that it may slide across."""
    if any(isinstance(leaf, jax.core.Tracer) or jnp.ndim(leaf) > 1 for leaf in jax.tree.leaves(scene)):
        return False
    g = components(scene.gravity)
    above = scale(ratio(-1e6, norm(g)), g)
    for surface in scene.surfaces:
        face = surface.face(above, 0.0) if _can_settle(surface) else None
        if face is not None and surface.law.sliding_friction() is not None:
            steep = norm(along_surface(face.normal, g)) > 1e-6 * norm(g)
            if bool(steep) and bool(dot(face.normal, g) < 0):
                return True
    return False
