"""Rotations, by jaxlie. Its code relies on implicit promotion, which is allowed here and nowhere else."""

from typing import Any

import jax
import jax.numpy as jnp
import jaxlie
from jax import lax
from jaxtyping import Array, Float

from .types import Quaternion, Vector

_PARTS = 64


def turned(orientation: Quaternion, angle: Vector) -> Quaternion:
    """The orientation after a rotation by the vector `angle` (rad, fixed frame): dq/dt = (0, omega) q / 2."""
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        q = (jaxlie.SO3.exp(angle) @ jaxlie.SO3(orientation)).wxyz
    return q.astype(orientation.dtype)


def rolled(orientation: Any, spin0: Any, spin1: Any, duration: Any, dtype: Any) -> Any:
    """The orientation after `duration` with a spin that changes linearly: exact where its direction stays, else to
    fourth order in the parts of the time (Magnus)."""
    start, end = (jnp.stack([jnp.asarray(x, dtype=dtype) for x in spin]) for spin in (spin0, spin1))
    step = jnp.asarray(duration, dtype=dtype) / _PARTS
    turning = (end - start) / _PARTS
    twist = step * step / 12.0 * jnp.cross(start, turning)  # of the first part; the others have the same

    def part(q, k):
        middle = start + (k + 0.5) * turning
        return turned(q, step * middle - twist), None

    return lax.scan(part, orientation, jnp.arange(_PARTS, dtype=dtype))[0]


def matrix(wxyz: Any) -> Float[Array, "3 3"]:
    """The rotation matrix of a quaternion of any length but zero."""
    wxyz = jnp.asarray(wxyz)
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        return jaxlie.SO3(wxyz / jnp.linalg.norm(wxyz)).as_matrix().astype(wxyz.dtype)
