"""Numbers that are computed once.

XLA's fusion on the CPU copies whatever is cheap into all of its consumers, and these into theirs, so that a chain of
stages is computed anew for every output, and compiled anew. It never copies a division. `lax.optimization_barrier` is
gone before fusion begins, and a division written in JAX turns into a multiplication in derivatives, where its divisor
has fewer axes. Hence a primitive of its own, the identity, that becomes a division only when the program is lowered.
"""

from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

from ._vector import is_constant


def _divided(x: Any) -> Any:
    """x, divided by a one that XLA cannot see through."""
    one, two = jnp.ones_like(x), jnp.full_like(x, 2)
    return x / jnp.where(x == x, one, two)


_shared = Primitive("shared")
_shared.def_impl(lambda x: x)
_shared.def_abstract_eval(lambda x: x)
ad.deflinear2(_shared, lambda cotangent, _: [_shared.bind(cotangent)])
batching.defvectorized(_shared)
mlir.register_lowering(_shared, mlir.lower_fun(lambda x: x, multiple_results=False))
mlir.register_lowering(_shared, mlir.lower_fun(_divided, multiple_results=False), platform="cpu")


def shared(values: Sequence[Any]) -> tuple:
    """The same floating-point numbers, computed once in the compiled program, and their derivatives likewise."""
    return tuple(value if is_constant(value) else _shared.bind(jnp.asarray(value)) for value in values)
