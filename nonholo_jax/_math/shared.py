"""Numbers that are computed once, or not at all.

XLA's fusion on the CPU copies whatever is cheap into all of its consumers, and these into theirs, so that a chain of
stages is computed anew for every output, and compiled anew. From JAX 0.12 on, `lax.optimization_barrier` prevents
that; before, it is gone when fusion begins, but a division is never copied. A division written in JAX turns into a
multiplication in derivatives, where its divisor has fewer axes. Hence a primitive of its own, the identity, that
becomes a barrier or a division only when the program is lowered.
"""

from collections.abc import Callable, Sequence
from typing import Any

import equinox.internal as eqxi
import jax
import jax.numpy as jnp
from jax import lax
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

from .vector import is_constant


def _opaque(x: Any) -> Any:
    """x, behind a barrier, or divided by a one that XLA cannot see through."""
    if jax.__version_info__ >= (0, 12):
        return lax.optimization_barrier(x)
    one, two = jnp.ones_like(x), jnp.full_like(x, 2)
    return x / jnp.where(x == x, one, two)


_shared = Primitive("shared")
_shared.def_impl(lambda x: x)
_shared.def_abstract_eval(lambda x: x)
ad.deflinear2(_shared, lambda cotangent, _: [_shared.bind(cotangent)])
batching.defvectorized(_shared)
mlir.register_lowering(_shared, mlir.lower_fun(lambda x: x, multiple_results=False))
mlir.register_lowering(_shared, mlir.lower_fun(_opaque, multiple_results=False), platform="cpu")


def shared(values: Sequence[Any]) -> tuple:
    """The same floating-point numbers, computed once in the compiled program, and their derivatives likewise."""
    return tuple(value if is_constant(value) else _shared.bind(jnp.asarray(value)) for value in values)


def if_any(condition: Any, wanted: Callable, plain: Callable) -> Any:
    """`wanted()` if a condition holds in any lane of a batch: otherwise `plain()`, which must be equal then."""
    return lax.cond(eqxi.unvmap_any(condition), wanted, plain)
