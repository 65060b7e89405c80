"""Many surfaces of one class as one, so that a program does not grow with their number."""

from collections.abc import Callable, Sequence
from itertools import groupby
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .._math import is_constant
from .surface import AbstractSurface


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
    for _, row in groupby(surfaces, _structure):
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
