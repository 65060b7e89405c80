"""A function of a few numbers that is linearized as a whole: with its Jacobian, in one forward pass."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp


def with_jacobian(function: Callable, u: Any) -> tuple[Any, Any, Any]:
    """Value of shape (m,), Jacobian of shape (m, d) and what comes beside them, of a function that returns a value and
    something beside it."""
    push = lambda e: jax.jvp(function, (u,), (e,), has_aux=True)  # noqa: E731
    if u.size == 1:  # without an axis of directions, which would take Python a while to add
        value, column, aside = push(jnp.ones_like(u))
        return value, column[:, None], aside
    return jax.vmap(push, out_axes=(None, 1, None))(jnp.eye(u.size, dtype=u.dtype))


@eqx.filter_custom_jvp
def linearized_whole(u: Any, *, function: Callable) -> tuple[Any, Any]:
    """`function(u)`, a pytree that is called. A solver that linearizes this compiles one program, instead of a value,
    its linearization and what reverse mode would want to keep."""
    return function(u)


@linearized_whole.def_jvp
def _linearized_whole_jvp(primals, tangents, *, function: Callable):
    (u,), (du,) = primals, tangents
    value, columns, aside = with_jacobian(function, u)
    return (value, aside), (columns @ du, jax.tree.map(lambda _: None, aside))
