"""What the event loop asks of a mechanical system."""

from abc import abstractmethod
from collections.abc import Sequence
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool

from .._math import KINDS, RESULTS, Choice, Hopper, Index, Interval, Number, Scalar, Window, plus, times, total
from .surface import Return


class Meeting(NamedTuple):
    """What happens when a contact is crossed."""

    kind: KINDS
    fault: RESULTS  # `reached_t1` if the motion can go on, or why not
    after: Any  # the state afterwards
    pause: Scalar | float  # how many seconds have passed by then
    is_at_rest: Any  # nothing moves any more


class AbstractSystem(eqx.Module):
    """A system that moves smoothly between contacts. Its state is any pytree; what evolves of it, and what its gaps
    see, are tuples of scalars. A contact is crossed where its `level` goes from positive to negative: a smooth
    function with the zeros of the gap, and its derivative there, that is cheaper to bound than the gap itself."""

    n_contacts: eqx.AbstractVar[int]  # a contact is its number, or a `Member`
    is_long: eqx.AbstractClassVar[bool]  # `derivative` is a long program: a loop should hold it only once

    may_stay: ClassVar[bool] = False  # whether it may go on in contact: then its phase decides how it moves
    may_pass: ClassVar[bool] = False  # whether it may be handed over from one contact to another, without an impact

    n_derived: ClassVar[int] = 0  # how many numbers gaps see beside those that evolve: see `derived`
    degree_of_derived: ClassVar[int] = 4  # of the polynomials that they are along an arc

    def falling(self, time: Scalar, state: Any, q: tuple, v: tuple) -> tuple[tuple, tuple]:
        """`derivative` where nothing is touched."""
        return self.derivative(time, state, q, v)

    def derived(self, time: Scalar, state: Any, q: tuple, v: tuple) -> tuple[Number, ...]:
        """Smooth functions of the motion whose zeros are contacts: what a gap sees of them along an arc is a polynomial
        through samples. For motions that step."""
        del time, state, q, v
        return ()

    def longest(self, state: Any) -> Scalar | None:
        """How many seconds a step from this prepared state may have at most; `None` where any may do."""
        del state

    def is_coarse(self, arc: Any) -> Any:
        """Whether a step along a surface may have passed a part of it unseen; `None` where that cannot be."""
        del arc

    def code(self, state: Any) -> Index:
        """`phase`, with all that the log has to know of it."""
        return self.phase(state)

    def supports(self, code: Any) -> tuple[Any, Any]:
        """The surfaces that a code stands for: the one that the system stays on; the second one of a groove, or -1."""
        return code, jnp.full_like(code, -1)

    def code_of(self, support: Any, beside: Any) -> Any:
        """The code of two surfaces: the inverse of `supports`."""
        del beside
        return support

    def left_by(self, contact: Choice) -> Any:
        """What the search is told beside the number of the contact that is left: `n_contacts` if the state moves off it
        with neither velocity nor acceleration, as where its push ends, else 0."""
        del contact
        return 0

    def most_rows(self, max_impacts: int) -> int:
        """How many rows a log may need for so many impacts."""
        return 2 * max_impacts + 8 if self.may_pass else max_impacts

    def engine(self, dtype: Any) -> "AbstractSystem":
        """The same system as the event loop sees it, where all numbers have that dtype."""
        del dtype
        return self

    def contacts(self) -> list:
        """All contacts; those of one class may stand together, as a pair of their first number and a `Stack`."""
        return list(range(self.n_contacts))

    def choice(self, index: Any) -> Choice:
        """The contact of a traced number, with all contacts as `members`."""
        return Choice(index, self.n_contacts, members=range(self.n_contacts))

    @abstractmethod
    def evolving(self, state: Any) -> tuple[tuple[Number, ...], tuple[Number, ...]]:
        """The configuration that gaps see, and its velocity: two tuples of scalars."""

    @abstractmethod
    def prepared(self, time: Scalar, state: Any) -> Any:
        """The state at which an arc begins, with what is worth computing only once for all of the arc."""

    @abstractmethod
    def derivative(self, time: Scalar, state: Any, q: tuple, v: tuple) -> tuple[tuple[Number, ...], tuple[Number, ...]]:
        """The rates of q and of v on the arc that begins at `state`."""

    def rate_of(self, time: Scalar, state: Any) -> tuple[Number, ...]:
        """The rate of q in a state."""
        return self.derivative(time, state, *self.evolving(state))[0]

    @abstractmethod
    def is_uniform(self) -> bool:
        """Whether on every arc v is the rate of as many q and has a constant rate itself, and other q have a constant
        rate: arcs are then parabolas."""

    @abstractmethod
    def advanced(self, time: Scalar, state: Any, q: tuple, v: tuple, duration: Number) -> Any:
        """The state at `time`, after smooth motion from `state` to (q, v) during `duration` seconds."""

    @abstractmethod
    def bounced(self, contact: Choice, time: Scalar, state: Any) -> Any:
        """The state after an impact on that contact, if nothing but a bounce follows."""

    @abstractmethod
    def meets(self, contact: Choice, time: Scalar, state: Any, left: Scalar, rests: Any, ends: Any) -> Meeting:
        """What happens when a contact is crossed in `state`, `left` seconds before the end. `rests` says that a bounce
        would not rise above rounding, `ends` that it could not even be computed."""

    @abstractmethod
    def after(self, contact: Choice, time: Scalar, state: Any, kind: KINDS) -> tuple[Any, Scalar | float]:
        """The state after a contact is crossed, and how many seconds have passed by then, if it is known what kind of
        impact it is: the same as in `meets`, for derivatives."""

    @abstractmethod
    def during(self, contact: Choice, time: Scalar, state: Any, elapsed: Scalar) -> Any:
        """The state `elapsed` seconds after a contact was crossed in `state`, within the time that `impact` takes."""

    @abstractmethod
    def named(self, contact: Choice, state: Any) -> Index:
        """The contact that the log names, and that is touched afterwards: that itself, but for the edges of a face."""

    @abstractmethod
    def phase(self, state: Any) -> Index:
        """Which motion a state is in: -1 if free, else the index of the contact that it stays on."""

    @abstractmethod
    def level(self, contact: Any, time: Scalar, q: tuple, state: Any) -> Number:
        """Positive apart, zero at contact, negative beyond; there its derivative is that of the gap in metres. `state`
        is the one at which the arc began."""

    @abstractmethod
    def is_parabolic(self, contact: Any) -> bool:
        """Whether the level along every parabola is one itself: `bend` is then exact over the whole arc."""

    @abstractmethod
    def returns(self, contact: Any, time: Scalar, q: tuple, v: tuple, half_a: tuple, state: Any) -> Return | None:
        """When a parabola that begins at `state` on a flat face of a surface comes back to it, if low bounces on it are
        to be exact, else `None`."""

    @abstractmethod
    def reach(self, contact: Any, q: tuple) -> Number | None:
        """A length over which `bend` is worth asking for; `None` if there is no such length."""

    @abstractmethod
    def bend(self, contact: Any, time: Scalar, window: Window, state: Any) -> Interval:
        """Bounds of the second derivative of the level along the window."""

    def is_wide(self, contact: Any) -> bool:
        """Whether `bend` may be too wide to take a step by, or even `BLIND`: a closer look is then worth it."""
        del contact
        return False

    @abstractmethod
    def unbounded(self, state: Any) -> list[str]:
        """The contacts, by names for the user, whose `bend` is no true bound but an estimate from samples, for motions
        from a user's state or a batch of them (`None`: from any)."""

    @abstractmethod
    def extent(self, contact: Any) -> Number:
        """The size of the numbers that the level is computed from, in metres: it sets the rounding error."""

    @abstractmethod
    def is_admissible(self, time: Scalar, state: Any) -> Bool[Array, ""]:
        """Whether the motion can start there."""

    @abstractmethod
    def received(self, state: Any, batch: bool, t0: Any) -> Any:
        """A user's state (or a batch of them) at t0 as arrays. Raises `ValueError` for what cannot be right."""

    @abstractmethod
    def unpacked(self, state: Any, phase: Index | None = None) -> Any:
        """The engine's form of a user's state, in the free phase or a given one: a pytree of scalars of one dtype."""

    @abstractmethod
    def packed(self, state: Any) -> Any:
        """The user's form of an engine's state."""

    @abstractmethod
    def contact_frame(self, contact: Choice, time: Scalar, state: Any) -> tuple[Array, Array]:
        """The point of contact and the gradient of the gap there."""

    @abstractmethod
    def hopper(self, state: Any) -> Hopper | None:
        """Where the next impact is known in closed form, until something unusual happens: how to make one arc and the
        impact that ends it. Elsewhere `None`."""

    @abstractmethod
    def without_contacts(self) -> "AbstractSystem":
        """The same system with nothing to hit."""


def bounces(ends: Any, after: Any) -> Meeting:
    """What an impact leads to where nothing but a bounce can follow."""
    kind = KINDS.where(ends, KINDS.unused, KINDS.bounce)
    fault = RESULTS.where(ends, RESULTS.sustained_contact, RESULTS.reached_t1)
    return Meeting(kind, fault, after, 0.0, False)


def magnitude(q: Sequence[Number]) -> Number:
    """The size of the numbers of a configuration, as their rounding goes by it."""
    return total([abs(c) for c in q])


def rounding(system: AbstractSystem, contact: Any, size: Number, dtype: Any) -> Number:
    """The rounding error of a level in m: a few eps of the numbers that it is computed from."""
    return times(8.0 * float(jnp.finfo(dtype).eps), plus(size, system.extent(contact)))
