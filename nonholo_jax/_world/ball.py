"""The ball and its state."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._math import Number, as_number, is_constant


class Ball(eqx.Module):
    """A ball whose centre of mass is its centre and whose inertia is the same about every axis through it.

    **Arguments:**

    - `radius`: r > 0 in m.
    - `mass`: m > 0 in kg.
    - `inertia_ratio`: alpha = J / (m r^2) > 0: 2/5 solid sphere (default), 2/3 thin shell, 1/2 a disc that moves in
        its plane.

    Raises `ValueError` for values that are not positive and finite. Source: the paper, section 5.

    ```python
    from nonholo_jax import Ball
    superball = Ball(radius=0.025, mass=0.046)
    superball.inertia                                # J in kg m^2
    ```
    """

    radius: Number = eqx.field(converter=as_number)
    mass: Number = eqx.field(converter=as_number)
    inertia_ratio: Number = eqx.field(converter=as_number, default=0.4)

    def __check_init__(self):
        for name in ("radius", "mass", "inertia_ratio"):
            value = getattr(self, name)
            if is_constant(value) and not 0 < value < float("inf"):
                raise ValueError(f"Argument `{name}` must be positive and finite, but got {value}; use SI units.")

    @property
    def inertia(self) -> Number:
        """J = alpha m r^2 in kg m^2."""
        return self.inertia_ratio * self.mass * self.radius**2


def _as_array(x: Any) -> Any:
    """A floating JAX array from lists, NumPy and JAX arrays; NumPy float32 keeps its dtype."""
    if isinstance(x, jax.Array | np.ndarray):
        return jnp.asarray(x) if jnp.issubdtype(x.dtype, jnp.floating) else jnp.asarray(x, dtype=float)
    if isinstance(x, list | tuple):
        if any(isinstance(item, jax.Array) for item in x):
            dtype = jnp.result_type(*x)
            return jnp.stack([jnp.asarray(item, dtype=dtype) for item in x])
        return jnp.asarray(x, dtype=float)
    return x


class BallState(eqx.Module):
    """Where the ball is and how it moves. A batch has one leading axis on every field.

    **Arguments:**

    - `position`: of the centre, in m, shape (3,).
    - `velocity`: of the centre, in m/s, shape (3,).
    - `spin`: angular velocity in the fixed frame, in rad/s, shape (3,).
    - `orientation`: unit quaternion (w, x, y, z), body to world, shape (4,); `None` if it is of no interest, and then
        it is not computed.

    The dtype of the whole simulation follows `position`.

    ```python
    from nonholo_jax import BallState
    throw = BallState([-0.3, 0.0, 0.9], [2.0, 0.0, -5.0], [0.0, 15.0, 0.0])
    ```
    """

    position: Float[Array, "*batch 3"] = eqx.field(converter=_as_array)
    velocity: Float[Array, "*batch 3"] = eqx.field(converter=_as_array)
    spin: Float[Array, "*batch 3"] = eqx.field(converter=_as_array)
    orientation: Float[Array, "*batch 4"] | None = eqx.field(converter=_as_array, default=None)


def check_ball_state(state: Any, batch: bool) -> None:
    """Raise `ValueError` for shapes that are not those of one state, or of one batch of states."""
    if not isinstance(state, BallState):
        raise ValueError(f"Argument `state` must be a BallState, but got {type(state).__name__}; try BallState(...).")
    names = [("position", 3), ("velocity", 3), ("spin", 3), ("orientation", 4)]
    sizes = set()
    for name, n in names:
        x = getattr(state, name, None)
        if x is None:
            continue
        want = f"(N, {n})" if batch else f"({n},)"
        if x.ndim != (2 if batch else 1) or x.shape[-1] != n:
            other = "simulate() for one state" if batch else "simulate_batch() or vmap for a batch"
            raise ValueError(f"Argument `state.{name}` must have shape {want}, but got {x.shape}; try {other}.")
        sizes.add(x.shape[0] if batch else 1)
    if len(sizes) > 1:
        raise ValueError(
            f"Argument `states` must have one batch size, but got {sorted(sizes)}; try jnp.broadcast_to on the shorter."
        )
