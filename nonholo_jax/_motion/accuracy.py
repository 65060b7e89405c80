"""The cheapest motion that is expected to reach an error.

The numbers are fitted to the throws of `experiments/benchmarks/bench_accuracy.py`: 1,000 in each of five scenes with
air, a few metres wide and 0.7 to 4 s long. There the error at the end that 99 of 100 throws stay below is at most
`_GROWTH` max(1, T)^3 times the absolute tolerance of one step for Tsit5, with T the duration in seconds. With Dopri8,
whose interpolant has a lower order than its steps, it is moreover at most `_BETWEEN` max(1, T)^3 times the power 3/4 of
that tolerance.
"""

from typing import Any

import jax
import jax.core
import jax.numpy as jnp
import numpy as np

from .._world import Scene
from .integrated import Integrated, rms
from .motion import AbstractMotion, Exact

_GROWTH = 20.0
_BETWEEN = 0.25
_TIGHT = 3e-8  # m; below it Dopri8 is cheaper than Tsit5
_ROUNDINGS = {"float32": 50.0, "float64": 500.0}  # what remains, in eps of the length of the way


def motion_for(scene: Any, accuracy: float, state: Any, t0: Any, t1: Any, closed_form: bool) -> AbstractMotion:
    """The motion that `simulate(..., accuracy=)` picks. Tolerances are traced: they follow the duration without a new
    program."""
    if isinstance(accuracy, bool) or not isinstance(accuracy, float | int) or not 0 < accuracy < float("inf"):
        raise ValueError(
            f"Argument `accuracy` must be a positive number of Python, in m, but got {accuracy!r}; try 1e-6."
        )
    if not isinstance(scene, Scene):
        raise ValueError(
            f"Argument `accuracy` must come with a Scene, but got {type(scene).__name__}; try "
            "motion=Integrated(rtol=..., atol=...)."
        )
    dtype = jnp.dtype(getattr(getattr(state, "position", None), "dtype", jnp.result_type(float)))
    _refuse_beyond(scene, accuracy, state, t0, t1, dtype)
    if closed_form:
        return Exact()
    duration = jnp.asarray(t1, dtype) - jnp.asarray(t0, dtype)
    growth = jnp.maximum(duration, 1.0) ** 3
    tolerance = accuracy / (_GROWTH * growth)
    tight = accuracy < _TIGHT
    if tight:
        tolerance = jnp.minimum(tolerance, (accuracy / (_BETWEEN * growth)) ** (4.0 / 3.0))
    # No relative part: the error is asked for in metres, however fast the ball is. Below rounding no step is accepted.
    tolerance = jnp.maximum(tolerance, 2.0 * float(jnp.finfo(dtype).eps))
    import diffrax

    control = diffrax.PIDController(rtol=0.0, atol=tolerance, norm=rms)
    solver = diffrax.Dopri8() if tight else diffrax.Tsit5()
    return Integrated(solver=solver, stepsize_controller=control, atol=accuracy / _GROWTH)


def _refuse_beyond(scene: Scene, accuracy: float, state: Any, t0: Any, t1: Any, dtype: Any) -> None:
    """Raise `ValueError` for what rounding makes impossible over the way that a throw may go, where that is known."""
    known = (state.position, state.velocity, scene.gravity, t0, t1) if hasattr(state, "velocity") else ()
    if not known or any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(known)):
        return
    position, speed, fall = (np.linalg.norm(np.asarray(x, float), axis=-1).max() for x in known[:3])
    duration = float(t1) - float(t0)
    way = float(position + speed * duration + 0.5 * fall * duration**2)
    least = _ROUNDINGS[dtype.name] * float(jnp.finfo(dtype).eps) * way
    if accuracy < least:
        remedy = "states in float64" if dtype == jnp.float32 else f"accuracy={2 * least:.0e}"
        raise ValueError(
            f"Argument `accuracy` must be at least {least:.1e} m here, as rounding in {dtype.name} over a way of "
            f"{way:.3g} m leaves no less, but got {accuracy}; try {remedy}."
        )
