"""The ways in which a scene can be run, each as one compiled program for its whole ladder of tolerances or steps."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from .._math import WIDEST_VECTORS, is_success, on_cpu
from .._motion import AbstractMotion, Exact, Integrated, rms, simulate_batch
from .._world import BallState

# The gradient is that of one number, a combination of the coordinates in which none has a special place.
_WEIGHTS = (0.6, 0.3, 0.74)


class Way(NamedTuple):
    """A solver with adaptive or fixed steps, or `Exact`, in one dtype."""

    solver: Any  # None for Exact
    steps: str  # "exact", "adaptive" or "fixed"
    dtype: str

    @property
    def method(self) -> str:
        return "Exact" if self.solver is None else type(self.solver).__name__

    @property
    def name(self) -> tuple[str, str, str]:
        return self.method, self.steps, self.dtype

    def motion(self, rung: Any, longest: Any, max_steps: int) -> AbstractMotion:
        """The motion with a tolerance or a step in s that may be traced, so that one program serves them all."""
        if self.steps == "exact":
            return Exact()
        import diffrax

        if self.steps == "fixed":
            control = diffrax.ConstantStepSize()
            return Integrated(self.solver, stepsize_controller=control, dt0=rung, max_steps=max_steps)
        control = diffrax.PIDController(rtol=rung, atol=rung, dtmax=longest, norm=rms)
        return Integrated(self.solver, stepsize_controller=control, max_steps=max_steps)


class Setting(NamedTuple):
    """What is run."""

    scene: Any
    states: BallState
    t0: Any
    t1: Any
    max_impacts: int
    sum_trains: bool

    @property
    def duration(self) -> float:
        return float(self.t1) - float(self.t0)

    def states_in(self, dtype: str) -> BallState:
        return jax.tree.map(lambda x: x.astype(dtype), self.states)


class Outcome(NamedTuple):
    """Of a batch: final positions (N, 3), or gradients (N, 9) in scaled units; and how each throw went."""

    values: np.ndarray
    n_impacts: np.ndarray
    n_arcs: np.ndarray
    arrived: np.ndarray


def value_of(setting: Setting, way: Way, max_steps: int) -> Callable:
    """The final positions, and how each throw went, as a function of states, rung and longest step."""

    def run(states, rung, longest):
        end = simulate_batch(
            setting.scene, states, t0=setting.t0, t1=setting.t1, max_impacts=setting.max_impacts, log_size=0,
            motion=way.motion(rung, longest, max_steps), sum_trains=setting.sum_trains,
        )  # fmt: skip
        return end.final.position, end.n_impacts, end.n_arcs, is_success(end.result)

    return run


def gradient_of(setting: Setting, way: Way, max_steps: int) -> Callable:
    """The reverse gradient of one combination of the final coordinates with respect to each throw, and how it went."""
    value = value_of(setting, way, max_steps)

    def run(states, rung, longest):
        def combined(states):
            position, *rest = value(states, rung, longest)
            return jnp.sum(position @ jnp.asarray(_WEIGHTS, position.dtype)), rest

        slope, rest = jax.grad(combined, has_aux=True)(states)
        return jnp.concatenate([slope.position, slope.velocity, slope.spin], axis=-1), *rest

    return run


def scales_of(setting: Setting) -> np.ndarray:
    """What makes the nine derivatives numbers without unit: velocities count times the duration, spins as the speed of
    the ball's skin."""
    return np.repeat([1.0, setting.duration, setting.duration * float(setting.scene.ball.radius)], 3)


class Program:
    """One compiled program: `call(rung)` runs it."""

    def __init__(self, setting: Setting, way: Way, what: str, longest: float, max_steps: int):
        make = {"value": value_of, "gradient": gradient_of}[what]
        self.way, self.what, self.longest = way, what, longest
        self.states = setting.states_in(way.dtype)
        self.scales = None if what == "value" else scales_of(setting)
        program = jax.jit(make(setting, way, max_steps), **(WIDEST_VECTORS if on_cpu() else {}))
        self.compiled = program.lower(*self._arguments(1.0, longest)).compile()

    def _arguments(self, rung: float | None, longest: float | None) -> tuple:
        number = lambda x: jnp.asarray(1.0 if x is None else x, dtype=self.way.dtype)  # noqa: E731
        return self.states, number(rung), number(self.longest if longest is None else longest)

    def call(self, rung: float | None, longest: float | None = None) -> Any:
        return jax.block_until_ready(self.compiled(*self._arguments(rung, longest)))

    def outcome(self, rung: float | None, longest: float | None = None) -> Outcome:
        values, *rest = (np.asarray(x) for x in self.call(rung, longest))
        values = values.astype(np.float64)
        return Outcome(values if self.scales is None else values / self.scales, *rest)


def ways(exact: bool, solvers: Sequence[Any], dtypes: Sequence[str]) -> list[Way]:
    """All ways, those of float64 first."""
    found = []
    for dtype in dtypes:
        found += [Way(None, "exact", dtype)] if exact else []
        found += [Way(solver, steps, dtype) for solver in solvers for steps in ("adaptive", "fixed")]
    return found
