"""How the system moves between contacts. A motion makes arcs; the event loop cuts them at contacts."""

import dataclasses
from abc import abstractmethod
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from .._math import Scalar, times
from .._world import AbstractSystem
from .crossing import Arc


class Piece(NamedTuple):
    """One arc, and what its motion wants to remember of it."""

    arc: Arc
    memory: Any  # of the solver, for the next piece; differentiable
    trial: Any  # what `judge` needs


class AbstractMotion(eqx.Module):
    """Makes the arcs of a system. `safe_steps` is how many steps of the search for a crossing one turn of the loop
    takes; `tile` is how many lanes of a batch share one loop on a CPU."""

    safe_steps: eqx.AbstractVar[int]
    tile: eqx.AbstractVar[int]

    @property
    @abstractmethod
    def is_closed_form(self) -> bool:
        """Whether one piece reaches any time."""

    def in_batch(self, system: AbstractSystem) -> "AbstractMotion":
        """The same motion in the form that is quicker in a batch, however long its program is."""
        del system
        return self

    @abstractmethod
    def check(self, system: AbstractSystem) -> None:
        """Raise `ValueError` if this motion cannot run the system."""

    @abstractmethod
    def max_pieces(self, max_impacts: int) -> int:
        """The largest number of arcs. A motion that would need more ends as `step_limit`."""

    @abstractmethod
    def max_turns(self, max_impacts: int) -> int:
        """The largest number of turns of the loop: never the first bound to be met, unless a search stands still."""

    @abstractmethod
    def begin(self, system: AbstractSystem, time: Scalar, state: Any, t1: Scalar) -> tuple[Any, Any]:
        """The control of the step size, which is not differentiated, and the memory of the solver, which is."""

    @abstractmethod
    def size(self, control: Any, left: Scalar, stays: Any) -> Scalar:
        """The size in seconds of the next arc; `stays` says that the system is in contact all along."""

    def shortened(self, control: Any, size: Scalar) -> Any:
        """The control for a next arc of that size; `None` where all are of one size."""
        del size
        return control

    @abstractmethod
    def piece(
        self, system: AbstractSystem, time: Scalar, state: Any, memory: Any, jumped: Bool[Array, ""], size: Scalar
    ) -> Piece:
        """The arc of that size from a state; `jumped` says that the state has just changed by an impact."""

    @abstractmethod
    def judge(self, control: Any, size: Scalar, trial: Any, stays: Any) -> tuple[Bool[Array, ""], Any]:
        """Whether the arc is accurate enough, and the control for the next one."""


def _either(stays: Any, step: Arc, flight: Arc, like: Any) -> Arc:
    """One of two arcs, as polynomials of one degree."""
    array = lambda x: jnp.asarray(x, like.dtype)  # noqa: E731

    def join(a: tuple, b: tuple) -> tuple:
        b = (*b, *[0.0] * (len(a) - len(b)))
        return tuple(jnp.where(stays, array(x), array(y)) for x, y in zip(a, b, strict=True))

    rows = lambda a, b: tuple(join(x, y) for x, y in zip(a, b, strict=True))  # noqa: E731
    length, unit = (jnp.where(stays, array(a), array(b))
                    for a, b in ((step.length, flight.length), (step.unit, flight.unit)))  # fmt: skip
    return Arc(step.time, step.start, rows(step.configuration, flight.configuration), rows(step.rate, flight.rate),
               length, unit, ~stays, step.derived)  # fmt: skip


def check_counts(**counts: int) -> None:
    """Raise `ValueError` for a count that is no whole number of at least 1."""
    for name, value in counts.items():
        if isinstance(value, bool) or not isinstance(value, int) or value < 1:
            raise ValueError(f"Argument `{name}` must be a whole number of at least 1, but got {value!r}; try 64.")


class Exact(AbstractMotion):
    """Closed-form flight in uniform gravity: parabolas, without an integrator and without a tolerance.

    **Arguments:**

    - `contact`: an `Integrated` for a ball that stays on a surface: it then rolls or slides on whatever shape, over
        edges and corners of boxes too. `None` for rolling on flat faces only, which has a closed form.
    - `safe_steps`, `tile`: speed only. How often one turn of the event loop may look ahead for a crossing, and how many
        lanes of a batch share one loop on a CPU.

    Refuses (with `ValueError`) a scene with air, and an `Implicit` surface whose curvature is not given and cannot be
    bounded from its program. Raises `ValueError` for counts below 1.

    ```python
    from nonholo_jax import Exact
    motion = Exact()
    ```
    """

    contact: AbstractMotion | None = None
    safe_steps: int = eqx.field(static=True, default=1)
    tile: int = eqx.field(static=True, default=256)

    def __check_init__(self):
        check_counts(safe_steps=self.safe_steps, tile=self.tile)
        if self.contact is not None and not getattr(self.contact, "steps", False):
            raise ValueError(
                "Argument `contact` must be None or Integrated() with an explicit Runge-Kutta solver, but got "
                f"{self.contact!r}; try Integrated()."
            )

    def shortened(self, control, size):
        return control if self.contact is None else self.contact.shortened(control, size)

    def in_batch(self, system):
        return self if self.contact is None else dataclasses.replace(self, contact=self.contact.in_batch(system))

    @property
    def is_closed_form(self):
        return self.contact is None

    @staticmethod
    def serves(system: AbstractSystem) -> bool:
        """Whether it can move this system."""
        return system.is_uniform() and not system.unbounded(None)

    def check(self, system):
        if not system.is_uniform():
            raise ValueError(
                "Argument `motion` must be Integrated() where the acceleration is not uniform (air, or a system other "
                "than a ball), but got Exact(); try motion=None."
            )
        if not self.serves(system):
            raise ValueError(
                "Argument `motion` must be Integrated() for a surface whose curvature is not bounded, but got "
                "Exact(); try Implicit(gap, law, curvature=...)."
            )

    def max_pieces(self, max_impacts):
        return max_impacts + 1 + (0 if self.contact is None else self.contact.max_pieces(max_impacts))

    def max_turns(self, max_impacts):
        return 256 * (max_impacts + 2) + (0 if self.contact is None else self.contact.max_turns(max_impacts))

    def begin(self, system, time, state, t1):
        return (None, None) if self.contact is None else self.contact.begin(system, time, state, t1)

    def size(self, control, left, stays):
        if self.contact is None:
            return left
        return jnp.where(stays, self.contact.size(control, left, stays), left)

    def piece(self, system, time, state, memory, jumped, size):
        if self.contact is None:
            return self._flight(system, time, state, size)
        stays = system.phase(state) >= 0
        flight = self._flight(system, time, state, size)
        step = self.contact.piece(system, time, state, memory, jumped, size)
        return step._replace(arc=_either(stays, step.arc, flight.arc, size))

    def _flight(self, system: AbstractSystem, time: Scalar, state: Any, size: Scalar) -> Piece:
        q, v = system.evolving(state)
        rates = system.derivative if self.contact is None else system.falling
        dq, a = rates(time, state, q, v)
        configuration = tuple((x, u, times(0.5, w)) for x, u, w in zip(q, v, a, strict=False))
        configuration += tuple((x, u) for x, u in zip(q[len(v) :], dq[len(v) :], strict=True))
        rate = tuple((u, w) for u, w in zip(v, a, strict=True))
        return Piece(Arc(time, state, configuration, rate, size, 1.0), None, None)

    def judge(self, control, size, trial, stays):
        if self.contact is None:
            return jnp.asarray(True), None
        kept, new = self.contact.judge(control, size, trial, stays)
        control = jax.tree.map(lambda a, b: jnp.where(stays, a, b), new, control)
        return kept | ~stays, control
