"""What the event loop asks of a mechanical system."""

from abc import abstractmethod
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool

from ._polynomial import Interval, Window
from ._types import Index, Number, Scalar
from ._vector import is_constant, plus, times, total


class AbstractSystem(eqx.Module):
    """A system that moves smoothly between contacts. Its state is any pytree; what evolves of it, and what its gaps
    see, are tuples of scalars. A contact is crossed where its `level` goes from positive to negative: a smooth
    function with the zeros of the gap, and its derivative there, that is cheaper to bound than the gap itself."""

    n_contacts: eqx.AbstractVar[int]

    @abstractmethod
    def evolving(self, state: Any) -> tuple[tuple[Number, ...], tuple[Number, ...]]:
        """The configuration that gaps see, and its rate: two tuples of n scalars."""

    @abstractmethod
    def uniform_acceleration(self) -> tuple[Number, ...] | None:
        """The acceleration of the configuration where it is constant, else `None`: the arcs are then not parabolas."""

    @abstractmethod
    def acceleration(self, time: Scalar, state: Any, q: tuple, v: tuple) -> tuple[Number, ...]:
        """The acceleration of the configuration."""

    @abstractmethod
    def advanced(self, state: Any, q: tuple, v: tuple, duration: Number) -> Any:
        """The state after smooth motion to (q, v) during `duration` seconds."""

    @abstractmethod
    def impact(self, contact: Index, time: Scalar, state: Any) -> Any:
        """The state after an impact on the contact of that index."""

    @abstractmethod
    def level(self, contact: int, time: Scalar, q: tuple) -> Number:
        """Positive apart, zero at contact, negative beyond; there its derivative is that of the gap in metres."""

    @abstractmethod
    def reach(self, contact: int, q: tuple) -> Number | None:
        """A length over which `bend` is worth asking for; `None` if it is as good over the whole arc."""

    @abstractmethod
    def bend(self, contact: int, time: Scalar, window: Window) -> Interval:
        """Bounds of the second derivative of the level along the window."""

    @abstractmethod
    def is_bounded(self, contact: int) -> bool:
        """Whether `bend` is a true bound, not an estimate from samples."""

    @abstractmethod
    def extent(self, contact: int) -> Number:
        """The size of the numbers that the level is computed from, in metres: it sets the rounding error."""

    @abstractmethod
    def is_admissible(self, time: Scalar, state: Any) -> Bool[Array, ""]:
        """Whether the motion can start there."""

    @abstractmethod
    def unpacked(self, state: Any) -> Any:
        """The engine's form of a user's state: a pytree of scalars, all of one dtype."""

    @abstractmethod
    def packed(self, state: Any) -> Any:
        """The user's form of an engine's state."""

    @abstractmethod
    def contact_frame(self, contact: Index, time: Scalar, state: Any) -> tuple[Array, Array]:
        """The point of contact and the unit normal there."""

    @abstractmethod
    def without_contacts(self) -> "AbstractSystem":
        """The same system with nothing to hit."""


def rounding(system: AbstractSystem, contact: int, q: Sequence[Number]) -> Number:
    """The rounding error of a level in m: a few eps of the numbers that it is computed from."""
    dtype = jnp.result_type(*[c for c in q if not is_constant(c)])
    return times(8.0 * float(jnp.finfo(dtype).eps), plus(total([abs(c) for c in q]), system.extent(contact)))
