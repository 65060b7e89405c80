"""Arithmetic on triples of scalars that drops what is known to be zero or one when the program is traced."""

import functools
import math
import operator
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from .types import Number, Numbers, Vector3


def is_constant(x: Any) -> bool:
    """True for a Python number, which is a constant of the compiled program."""
    return isinstance(x, float | int)


def as_number(x: Any) -> Any:
    """A Python float for Python and NumPy numbers; JAX arrays stay as they are (integers become floating)."""
    if isinstance(x, jax.Array):
        return x if jnp.issubdtype(x.dtype, jnp.floating) else x.astype(float)
    if isinstance(x, float | int | np.ndarray | np.generic) and not isinstance(x, bool):
        return float(x)
    if isinstance(x, str | bool | list | tuple):
        raise ValueError(f"A number must be a float or a scalar JAX array, but got {x!r}; try 1.0.")
    return x  # a placeholder of a pytree transformation


def as_vector(x: Any, n: int = 3) -> Any:
    """A tuple of n floats for Python and NumPy vectors; a JAX array with last axis n stays as it is."""
    wrong = f"A vector must have {n} components here, but got {x!r}; try {(0.0,) * (n - 1) + (1.0,)}."
    if isinstance(x, jax.Array):
        if x.ndim == 0 or x.shape[-1] != n:
            raise ValueError(wrong)
        return x if jnp.issubdtype(x.dtype, jnp.floating) else x.astype(float)
    if isinstance(x, list | tuple | np.ndarray):
        if len(x) != n:
            raise ValueError(wrong)
        return tuple(as_number(item) for item in x)
    if isinstance(x, float | int | str):
        raise ValueError(wrong)
    return x


def as_pair(x: Any) -> Any:
    """`as_vector` of two components."""
    return as_vector(x, 2)


def as_quaternion(x: Any) -> Any:
    """`as_vector` of four components."""
    return as_vector(x, 4)


def components(x: Any) -> tuple:
    """The scalars of a vector that `as_vector` stored."""
    return x if isinstance(x, tuple) else tuple(x[..., i] for i in range(x.shape[-1]))


def pack(x: Sequence, like: Any) -> Float[Array, " n"]:
    """One array of the dtype of `like` from scalars."""
    return jnp.stack([jnp.asarray(item, dtype=like.dtype) for item in x], axis=-1)


def times(a: Numbers, b: Numbers) -> Numbers:
    for x, y in ((a, b), (b, a)):
        if is_constant(x):
            if x == 0:
                return 0.0
            if x == 1:
                return y
            if x == -1:
                return -y
    return a * b


def plus(a: Numbers, b: Numbers) -> Numbers:
    if is_constant(a) and a == 0:
        return b
    if is_constant(b) and b == 0:
        return a
    return a + b


def total(terms: Sequence[Numbers]) -> Numbers:
    result: Numbers = 0.0
    for term in terms:
        result = plus(result, term)
    return result


def add(a: Sequence, b: Sequence) -> Any:
    return tuple(plus(x, y) for x, y in zip(a, b, strict=True))


def subtract(a: Sequence, b: Sequence) -> Any:
    return tuple(plus(x, times(-1.0, y)) for x, y in zip(a, b, strict=True))


def scale(factor: Number, a: Sequence) -> Any:
    return tuple(times(factor, x) for x in a)


def dot(a: Sequence, b: Sequence) -> Number:
    return total([times(x, y) for x, y in zip(a, b, strict=True)])


def cross(a: Vector3, b: Vector3) -> Vector3:
    return (
        plus(times(a[1], b[2]), times(-1.0, times(a[2], b[1]))),
        plus(times(a[2], b[0]), times(-1.0, times(a[0], b[2]))),
        plus(times(a[0], b[1]), times(-1.0, times(a[1], b[0]))),
    )


def where(condition: Any, a: Any, b: Any) -> Any:
    """`jnp.where` of numbers in as few operations as it takes: none where the condition or the answer is known."""
    if isinstance(condition, bool | np.bool_):
        return a if condition else b
    if a is b or (is_constant(a) and is_constant(b) and a == b):
        return a
    if is_constant(a) and is_constant(b):
        return jnp.where(condition, a, b)
    arrays = [x for x in (a, b) if not is_constant(x)]
    dtype, shape = jnp.result_type(*arrays), jnp.shape(condition)
    if any(jnp.shape(x) != shape or x.dtype != dtype or getattr(x, "weak_type", False) for x in arrays):
        return jnp.where(condition, a, b)
    a, b = (np.full(shape, x, dtype)[()] if is_constant(x) else x for x in (a, b))
    return lax.select(condition, a, b)


def where_vector(condition: Any, a: Sequence, b: Sequence) -> Any:
    """`where`, component by component."""
    return tuple(where(condition, x, y) for x, y in zip(a, b, strict=True))


def minimum(a: Number, b: Number) -> Number:
    return min(a, b) if is_constant(a) and is_constant(b) else jnp.minimum(a, b)


def maximum(a: Number, b: Number) -> Number:
    return max(a, b) if is_constant(a) and is_constant(b) else jnp.maximum(a, b)


def root(x: Number) -> Number:
    """Square root, zero for x <= 0, with a zero (not infinite) derivative there."""
    if is_constant(x):
        return math.sqrt(max(x, 0.0))
    positive = x > 0
    # The double where: the inner one keeps 1/(2 sqrt(0)) = inf out of the derivative, where inf * 0 would be NaN. What
    # it puts in is small: a compiler may compute x twice, rounded in two ways, so that it is zero once and once above.
    # But not so small that third derivatives are infinite.
    small = math.sqrt(jnp.finfo(jnp.result_type(x)).tiny)
    return where(positive, jnp.sqrt(where(positive, x, small)), 0.0)


def ratio(a: Number, b: Number, otherwise: Number = 0.0) -> Number:
    """a / b, and `otherwise` where b is zero, with finite derivatives everywhere."""
    if is_constant(b):
        return times(a, 1.0 / b) if b != 0 else otherwise
    if is_constant(a) and a == 0 and is_constant(otherwise) and otherwise == 0:
        return 0.0
    usable = b != 0
    return where(usable, a / where(usable, b, 1.0), otherwise)


def norm(a: Sequence) -> Number:
    return root(dot(a, a))


def unit(a: Sequence) -> Any:
    """The direction of a vector; exact for the axes."""
    length = norm(a)
    if is_constant(length):
        return tuple(a) if length == 1 else tuple(ratio(x, length) for x in a)
    length = where(length != 0, length, 1.0)
    return tuple(0.0 if is_constant(x) and x == 0 else x / length for x in a)


def beyond(x: Number, bound: Number) -> Number:
    """By how much x exceeds a bound, or zero."""
    excess = plus(x, times(-1.0, bound))
    return max(excess, 0.0) if is_constant(excess) else where(excess <= 0, 0.0, excess)


class Choice:
    """One of several things by a traced index, whose comparisons are made once, however much is chosen by them. With
    `sizes`, a thing stands for so many values of the index; `members` are the things themselves, if they are known."""

    def __init__(self, index: Any, count: int, sizes: Sequence[int] = (), members: Sequence = ()):
        self.index, self.members = index, members
        self._flags, start = [], 0
        for size in sizes or (1,) * count:
            self._flags.append(index == start if size == 1 else (index >= start) & (index < start + size))
            start += size

    def extend(self, start: int, members: Sequence) -> None:
        """More things, each for one value of the index, from `start` on."""
        self._flags += [self.index == start + i for i in range(len(members))]
        self.members = [*self.members, *members]

    def is_(self, i: int) -> Any:
        """Whether it is number i."""
        return self._flags[i]

    def among(self, numbers: Sequence[int]) -> Any:
        """Whether it is one of these."""
        return functools.reduce(operator.or_, [self._flags[i] for i in numbers], False)

    def of(self, options: Sequence, numbers: Sequence[int] | None = None) -> Any:
        """The option of that number, and the last one for any number that has none; `numbers` are those of the options
        if they are not counted from 0. Folded where all options are the same constant."""
        known = list(zip(range(len(options)) if numbers is None else numbers, options, strict=True))
        result = known[-1][1]
        for i, option in known[-2::-1]:
            result = where(self._flags[i], option, result)
        return result

    def vector(self, options: Sequence[Sequence], numbers: Sequence[int] | None = None) -> Any:
        """`of`, component by component."""
        return tuple(self.of(column, numbers) for column in zip(*options, strict=True))


def slope(function: Callable, at: Sequence, along: Sequence) -> tuple[Number, Number]:
    """A scalar function of a point and its derivative along a direction."""
    dtype = jnp.result_type(*[x for x in (*at, *along) if not is_constant(x)] or [float])
    lift = lambda xs: tuple(jnp.asarray(x, dtype=dtype) for x in xs)  # noqa: E731
    value, derivative = jax.jvp(lambda *x: jnp.asarray(function(x), dtype=dtype), lift(at), lift(along))
    return value, derivative


def frozen(tree: Any) -> Any:
    """The same values without derivatives; constants stay constants."""
    return jax.tree.map(lambda x: jax.lax.stop_gradient(x) if isinstance(x, jax.Array) else x, tree)
