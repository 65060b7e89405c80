"""How the system moves between contacts. A motion makes arcs; the event loop cuts them at contacts."""

from abc import abstractmethod
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
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
    takes; `tile` is how many lanes of a batch share one loop on a CPU; `is_closed_form` says that one piece reaches any
    time."""

    safe_steps: eqx.AbstractVar[int]
    tile: eqx.AbstractVar[int]
    is_closed_form: eqx.AbstractClassVar[bool]

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
    def size(self, control: Any, left: Scalar) -> Scalar:
        """The size in seconds of the next arc."""

    @abstractmethod
    def piece(
        self, system: AbstractSystem, time: Scalar, state: Any, memory: Any, jumped: Bool[Array, ""], size: Scalar
    ) -> Piece:
        """The arc of that size from a state; `jumped` says that the state has just changed by an impact."""

    @abstractmethod
    def judge(self, control: Any, size: Scalar, trial: Any) -> tuple[Bool[Array, ""], Any]:
        """Whether the arc is accurate enough, and the control for the next one."""


def check_counts(**counts: int) -> None:
    """Raise `ValueError` for a count that is no whole number of at least 1."""
    for name, value in counts.items():
        if isinstance(value, bool) or not isinstance(value, int) or value < 1:
            raise ValueError(f"Argument `{name}` must be a whole number of at least 1, but got {value!r}; try 64.")


class Exact(AbstractMotion):
    """Closed-form flight in uniform gravity: parabolas, without an integrator and without a tolerance.

    **Arguments:** `safe_steps`, `tile`: speed only. How often one turn of the event loop may look ahead for a crossing,
    and how many lanes of a batch share one loop on a CPU.

    Refuses (with `ValueError`) a scene with air, and an `Implicit` surface whose curvature is not given and cannot be
    bounded from its program. Raises `ValueError` for counts below 1.

    ```python
    from nonholo_jax import Exact
    motion = Exact()
    ```
    """

    safe_steps: int = eqx.field(static=True, default=1)
    tile: int = eqx.field(static=True, default=256)
    is_closed_form: ClassVar[bool] = True

    def __check_init__(self):
        check_counts(safe_steps=self.safe_steps, tile=self.tile)

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
        return max_impacts + 1

    def max_turns(self, max_impacts):
        return 256 * (max_impacts + 2)

    def begin(self, system, time, state, t1):
        return None, None

    def size(self, control, left):
        return left

    def piece(self, system, time, state, memory, jumped, size):
        q, v = system.evolving(state)
        dq, a = system.derivative(time, state, q, v)
        configuration = tuple((x, u, times(0.5, w)) for x, u, w in zip(q, v, a, strict=False))
        configuration += tuple((x, u) for x, u in zip(q[len(v) :], dq[len(v) :], strict=True))
        rate = tuple((u, w) for u, w in zip(v, a, strict=True))
        return Piece(Arc(time, state, configuration, rate, size, 1.0), None, None)

    def judge(self, control, size, trial):
        return jnp.asarray(True), None
