"""Rotations, by jaxlie. Its code relies on implicit promotion, which is allowed here and nowhere else."""

from typing import Any

import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Float

from ._types import Quaternion, Vector


def turned(orientation: Quaternion, angle: Vector) -> Quaternion:
    """The orientation after a rotation by the vector `angle` (rad, fixed frame): dq/dt = (0, omega) q / 2."""
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        q = (jaxlie.SO3.exp(angle) @ jaxlie.SO3(orientation)).wxyz
    return q.astype(orientation.dtype)


def matrix(wxyz: Any) -> Float[Array, "3 3"]:
    """The rotation matrix of a quaternion of any length but zero."""
    wxyz = jnp.asarray(wxyz)
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        return jaxlie.SO3(wxyz / jnp.linalg.norm(wxyz)).as_matrix().astype(wxyz.dtype)
