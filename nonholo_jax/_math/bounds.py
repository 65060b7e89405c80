"""True bounds of what a function does along a path, from its own program: an interpreter of jaxprs over courses.

The function is traced once; then every operation of it is applied to what its operands do along the window. What does
not depend on the path stays the number that it is, traced or not. An operation that is not known here, of a number
that depends on the path, makes the function `Unbounded`.
"""

import functools
import math
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
import numpy as np

from .courses import (
    Course,
    Truth,
    angle,
    constant,
    cosine,
    either,
    inverse,
    larger,
    largest,
    length,
    moved,
    multiplied,
    of_function,
    opposite,
    rooted,
    scaled,
    shifted,
    sine,
    size,
    smaller,
    soft_larger,
    squared,
    stepped,
    summed,
    to_real_power,
    to_whole_power,
)
from .intervals import SMOOTH
from .polynomial import Interval, Window
from .vector import frozen, is_constant

_MOST_ENTRIES = 1 << 14  # of a product of matrices, written out
_MOST_FACTORS = 16  # of a product of numbers


class Unbounded(Exception):
    """A function does something with the path whose bounds are not known."""


def course_of(function: Callable, window: Window) -> Course:
    """What a scalar function of the configuration, shape (n,), does along the path in the window. Raises `Unbounded`
    where its program holds an operation that is not known here."""
    start = [p[0] for p in window.coefficients]
    dtype = jnp.result_type(*[x for x in (*start, window.width) if not is_constant(x)] or [float])
    stack = lambda xs: jnp.stack([jnp.asarray(x, dtype=dtype) for x in xs])  # noqa: E731
    tracks = [window.track(p) for p in window.coefficients]
    value, rate, bend = (Interval(stack([part.low for part in each]), stack([part.high for part in each]))
                         for each in zip(*tracks, strict=True))  # fmt: skip
    pace = stack([p[1] if len(p) > 1 else 0.0 for p in window.coefficients])
    path = Course(value, rate, bend, stack(start), pace)
    closed = jax.make_jaxpr(function)(jax.ShapeDtypeStruct(path.start.shape, dtype))
    width = jnp.maximum(jnp.asarray(window.width, dtype), float(jnp.finfo(dtype).tiny))  # no infinity times nothing
    (found,) = _run(width, closed.jaxpr, frozen(closed.consts), [path])
    found = found if isinstance(found, Course) else constant(jnp.asarray(found, dtype))
    return found._replace(squares=None)


def is_boundable(function: Callable, n: int) -> bool:
    """Whether `course_of` knows all operations of a function of n coordinates. Says nothing of one that fails: whoever
    calls it will hear."""

    def course(x: Any) -> Any:
        cast = lambda y: y.astype(x.dtype) if eqx.is_inexact_array(y) else y  # noqa: E731
        return course_of(jax.tree.map(cast, function), Window(((x, x, x),) * n, x)).start

    for dtype in (jnp.result_type(float), jnp.float32):  # it may hold numbers of one of these
        try:
            jax.eval_shape(course, jax.ShapeDtypeStruct((), dtype))
        except Unbounded:
            return False
        except Exception:
            continue
        return True
    return False


# The interpreter


def _run(width: Any, jaxpr: Any, constants: Any, operands: Any) -> list:
    known: dict = {}
    names = getattr(jaxpr, "all_invars", None) or [*jaxpr.constvars, *jaxpr.invars]
    known.update(zip(names, [*constants, *operands], strict=True))

    def read(atom: Any) -> Any:
        return np.asarray(atom.val, atom.aval.dtype) if hasattr(atom, "val") else known[atom]

    for eqn in jaxpr.eqns:
        found = _applied(width, eqn, [read(atom) for atom in eqn.invars])
        known.update(zip(eqn.outvars, found, strict=True))
    return [read(atom) for atom in jaxpr.outvars]


def _applied(width: Any, eqn: Any, operands: list) -> list:
    """The results of one operation."""
    name = eqn.primitive.name
    if not any(_moves(x) for x in operands):
        found = _bind(eqn, *operands)
    elif name in _CALLS:
        found = _called(width, eqn, operands)
    elif any(isinstance(x, Truth) for x in operands) and name in _ON_TRUTHS | _STRUCTURAL:
        found = _on_truths(eqn, operands)
    elif name in _STRUCTURAL:
        found = _rearranged(eqn, operands)
    elif name in _RULES:
        found = _RULES[name](width, eqn, *operands)
    else:
        raise Unbounded(name)
    found = found if isinstance(found, list | tuple) and not _moves(found) else [found]
    return [_in_shape(x, atom.aval.shape) for x, atom in zip(found, eqn.outvars, strict=True)]


def _moves(x: Any) -> bool:
    return isinstance(x, Course | Truth)


def _bind(eqn: Any, *operands: Any) -> Any:
    found = eqn.primitive.get_bind_params(eqn.params)
    functions, params = found if isinstance(found, tuple) else ((), found)
    return eqn.primitive.bind(*functions, *operands, **params)


def _in_shape(x: Any, shape: tuple) -> Any:
    """Numbers combine with arrays of any shape."""
    if not isinstance(x, Course):
        return x
    return jax.tree.map(lambda part: part if part.shape == shape else jnp.broadcast_to(part, shape), x)


def _as_course(x: Any) -> Course:
    if isinstance(x, Truth):
        raise Unbounded("a condition as a number")
    return x if isinstance(x, Course) else constant(jnp.asarray(x))


# Programs within the program


def _inner(eqn: Any) -> Any:
    return next(eqn.params[key] for key in ("jaxpr", "call_jaxpr", "fun_jaxpr") if key in eqn.params)


def _called(width: Any, eqn: Any, operands: list) -> Any:
    special = _SPECIAL.get(eqn.params.get("name"))
    if special is not None:
        function, rule = special
        if len(operands) == 2 and _is_call_of(function, eqn):
            return [rule(width, *[_as_course(x) for x in operands])]
    inner = _inner(eqn)
    return _run(width, getattr(inner, "jaxpr", inner), frozen(list(getattr(inner, "consts", ()))), operands)


def _is_call_of(function: Callable, eqn: Any) -> bool:
    """Whether it is this very function, not another one of its name."""
    avals = [jax.ShapeDtypeStruct(a.aval.shape, a.aval.dtype, weak_type=a.aval.weak_type) for a in eqn.invars]
    own = jax.make_jaxpr(function)(*avals).eqns
    return len(own) == 1 and own[0].primitive is eqn.primitive and str(_inner(own[0])) == str(_inner(eqn))


_CALLS = {"jit", "pjit", "closed_call", "core_call", "remat", "checkpoint", "remat2", "custom_jvp_call",
          "custom_vjp_call", "custom_vjp_call_jaxpr"}  # fmt: skip
_SPECIAL = {"hypot": (jnp.hypot, length), "logaddexp": (jnp.logaddexp, soft_larger)}

# What moves numbers about, and sums them: the same for values, rates and second derivatives

_STRUCTURAL = {"reshape", "squeeze", "expand_dims", "broadcast_in_dim", "transpose", "slice", "rev", "copy", "copy_p",
               "concatenate", "stack", "unstack", "tile", "split", "pad", "gather", "dynamic_slice",
               "dynamic_update_slice", "scatter", "scatter-add", "cumsum", "stop_gradient",
               "optimization_barrier", "shared"}  # fmt: skip


def _rearranged(eqn: Any, operands: list) -> Any:
    if any(isinstance(x, Truth) for x in operands):
        raise Unbounded(eqn.primitive.name)
    numbers = [not _moves(x) and jnp.issubdtype(jnp.result_type(x), jnp.inexact) for x in operands]
    courses = [_as_course(x) if number else x for x, number in zip(operands, numbers, strict=True)]

    def part(of: Callable) -> Any:
        found = _bind(eqn, *[of(x) if isinstance(x, Course) else x for x in courses])
        return list(found) if eqn.primitive.multiple_results else [found]

    value, rate, bend = ([part(lambda x, k=k, j=j: x[k][j]) for j in (0, 1)] for k in (0, 1, 2))
    start, pace = part(lambda x: x.start), part(lambda x: x.pace)
    squares: list = [None] * len(start)
    if not any(numbers) and all(x.squares is not None for x in courses if isinstance(x, Course)):
        squares = list(zip(*[part(lambda x, j=j: x.squares[j]) for j in (0, 1)], strict=True))
    pair = lambda ends, i: Interval(ends[0][i], ends[1][i])  # noqa: E731
    return [Course(pair(value, i), pair(rate, i), pair(bend, i), start[i], pace[i], squares[i])
            for i in range(len(start))]  # fmt: skip


_ON_TRUTHS = {"and", "or", "not", "convert_element_type", "eq", "ne", "xor"}


def _on_truths(eqn: Any, operands: list) -> Any:
    """Operations of conditions: those that a condition can only make true by being true, `not`, and comparisons."""
    if any(isinstance(x, Course) for x in operands):
        raise Unbounded(eqn.primitive.name)
    always, ever, start = (_bind(eqn, *[x[k] if isinstance(x, Truth) else x for x in operands]) for k in range(3))
    if eqn.primitive.name == "not":
        return Truth(ever, always, start)
    if eqn.primitive.name == "convert_element_type":
        return _converted(eqn, Truth(always, ever, start))
    if eqn.primitive.name in ("eq", "ne", "xor"):
        known = functools.reduce(jnp.logical_and, [x.always == x.ever for x in operands if isinstance(x, Truth)])
        return Truth(known & start, ~known | start, start)
    if any(x.dtype != bool for x in (always, ever)):
        raise Unbounded(eqn.primitive.name)
    return Truth(always, ever, start)


def _converted(eqn: Any, x: Truth) -> Any:
    if not jnp.issubdtype(eqn.outvars[0].aval.dtype, jnp.inexact):
        raise Unbounded("a condition as a whole number")
    one = jnp.asarray(1.0, eqn.outvars[0].aval.dtype)
    same = Truth(*[part.astype(bool) for part in x])
    return either(same, constant(jnp.broadcast_to(one, x.start.shape)), constant(jnp.zeros_like(x.start)))


# Rules, operation by operation


def _sign_of(c: Any) -> float | None:
    """The sign of a constant, if it is known now and the same everywhere."""
    if isinstance(c, jax.core.Tracer):
        return None
    if isinstance(c, jax.Array) and not c.is_fully_addressable:  # on other machines
        return None
    c = np.asarray(c)
    return 1.0 if (c >= 0).all() else -1.0 if (c <= 0).all() else None


def _add(width: Any, eqn: Any, a: Any, b: Any) -> Course:
    if isinstance(a, Course) and isinstance(b, Course):
        return moved(width, a, b)
    return shifted(a, b) if isinstance(a, Course) else shifted(b, a)


def _sub(width: Any, eqn: Any, a: Any, b: Any) -> Course:
    return _add(width, eqn, a, opposite(b) if isinstance(b, Course) else -b)


def _mul(width: Any, eqn: Any, a: Any, b: Any) -> Course:
    if a is b:
        return squared(width, a)
    if isinstance(a, Course) and isinstance(b, Course):
        return multiplied(width, a, b)
    course, c = (a, b) if isinstance(a, Course) else (b, a)
    return scaled(_sign_of(c), c, course)


def _div(width: Any, eqn: Any, a: Any, b: Any) -> Course:
    return _mul(width, eqn, a, inverse(width, b) if isinstance(b, Course) else 1.0 / b)


def _pow(width: Any, eqn: Any, a: Any, b: Any) -> Course:
    if not isinstance(b, Course):
        if _sign_of(b) is not None and np.ndim(b) == 0 and float(b).is_integer() and abs(float(b)) < 64:
            n = int(b)
            return to_whole_power(width, a, n, lambda x: jax.lax.integer_pow(x, n))
        return to_real_power(width, a, b, lambda x: jnp.power(x, b))
    logarithm = _smooth("log", width, a, jnp.log) if isinstance(a, Course) else jnp.log(a)
    exponent = _mul(width, eqn, b, logarithm)
    return _smooth("exp", width, exponent, jnp.exp)


def _polynomial(width: Any, eqn: Any, x: Any, *coefficients: Any) -> Course:
    """Horner's rule; the constant comes first."""
    found = coefficients[-1]
    for c in reversed(coefficients[:-1]):
        product = _mul(width, eqn, found, x) if _moves(found) or _moves(x) else found * x
        found = _add(width, eqn, product, c) if _moves(product) or _moves(c) else product + c
    return found


def _prod(width: Any, eqn: Any, a: Course) -> Course:
    for axis in sorted(eqn.params["axes"], reverse=True):
        if a.start.shape[axis] > _MOST_FACTORS:
            raise Unbounded("reduce_prod")
        factors = [jax.tree.map(lambda x, i=i, axis=axis: jnp.take(x, i, axis), a) for i in range(a.start.shape[axis])]
        a = functools.reduce(functools.partial(multiplied, width), factors)
    return a


def _smooth(name: str, width: Any, a: Course, function: Callable) -> Course:
    build = rooted if name == "sqrt" else of_function
    return build(width, SMOOTH[name](a.value), a, function)


def _of_smooth(name: str) -> Callable:
    return lambda width, eqn, a: _smooth(name, width, a, functools.partial(_bind, eqn))


def _max(width: Any, eqn: Any, a: Any, b: Any) -> Course:
    found = larger(width, *_alike(a, b))
    course, c = (a, b) if isinstance(a, Course) else (b, a)
    # The root of the larger of a sum of squares and a constant is the larger of two roots.
    return found if isinstance(c, Course) else found._replace(squares=course.squares)


def _min(width: Any, eqn: Any, a: Any, b: Any) -> Course:
    return smaller(width, *_alike(a, b))


def _alike(*operands: Any) -> list[Course]:
    courses = [_as_course(x) for x in operands]
    shape = jnp.broadcast_shapes(*[x.start.shape for x in courses])
    return [_in_shape(x, shape) for x in courses]


def _clamp(width: Any, eqn: Any, low: Any, x: Any, high: Any) -> Course:
    return _min(width, eqn, _max(width, eqn, x, low), high)


def _extreme(width: Any, eqn: Any, a: Course, sign: int) -> Course:
    axes = eqn.params["axes"]
    return largest(width, a, axes) if sign > 0 else opposite(largest(width, opposite(a), axes))


def _select(width: Any, eqn: Any, which: Any, *cases: Any) -> Course:
    if isinstance(which, Course):
        raise Unbounded("select_n")
    courses = [x._replace(squares=None) for x in _alike(*cases)]
    if isinstance(which, Truth):
        return either(which, courses[1], courses[0])
    return jax.tree.map(lambda *xs: jax.lax.select_n(which, *xs), *courses)


def _less(width: Any, eqn: Any, a: Any, b: Any) -> Truth:
    """The comparisons: of a < b, a <= b, a > b, a >= b, a == b and a != b."""
    name = eqn.primitive.name
    (x, y), same = _alike(a, b), a is b
    (low, high), (least, most) = x.value, y.value
    start = _bind(eqn, x.start, y.start)
    if name in ("eq", "ne"):
        always, ever = (low == most) & (high == least), (low <= most) & (high >= least)
        always = always | same
        return Truth(always, ever, start) if name == "eq" else Truth(~ever, ~always, start)
    compare = {"lt": jnp.less, "le": jnp.less_equal, "gt": jnp.greater, "ge": jnp.greater_equal}[name]
    ends = (compare(high, least), compare(low, most)) if name in ("lt", "le") else (
        compare(low, most), compare(high, least))  # fmt: skip
    return Truth(*ends, start)


def _finite(width: Any, eqn: Any, a: Course) -> Truth:
    yes = jnp.ones(a.start.shape, bool)
    return Truth(yes, yes, yes)


def _steps(width: Any, eqn: Any, a: Course) -> Course:
    return stepped(a, functools.partial(_bind, eqn))


def _rem(width: Any, eqn: Any, a: Any, b: Any) -> Course:
    if isinstance(b, Course):
        raise Unbounded("rem")
    turns = stepped(scaled(_sign_of(b), 1.0 / b, a), jnp.trunc)
    return moved(width, a, opposite(scaled(_sign_of(b), b, turns)))


def _convert(width: Any, eqn: Any, a: Course) -> Course:
    if not jnp.issubdtype(eqn.params["new_dtype"], jnp.inexact):
        raise Unbounded("a whole number from the path")
    return jax.tree.map(lambda x: x.astype(eqn.params["new_dtype"]), a)


def _dot(width: Any, eqn: Any, a: Any, b: Any) -> Course:
    """A product of matrices, written out as products of numbers and their sum. Axes: those of the batch, the free ones
    of a, the free ones of b, and those that are summed."""
    (left, right), (left_batch, right_batch) = eqn.params["dimension_numbers"]
    shapes = [atom.aval.shape for atom in eqn.invars]
    free = [[i for i in range(len(shape)) if i not in (*used, *batch)]
            for shape, used, batch in zip(shapes, (left, right), (left_batch, right_batch), strict=True)]  # fmt: skip
    n, m, k = len(left_batch), len(free[0]), len(free[1])
    sizes = [[shapes[0][i] for i in (*left_batch, *free[0])], [shapes[1][i] for i in free[1]]]
    whole = (*sizes[0], *sizes[1], *[shapes[0][i] for i in left])
    if math.prod(whole) > _MOST_ENTRIES:
        raise Unbounded("dot_general")

    def spread(x: Any, order: tuple, new: range) -> Any:
        wide = lambda y: jnp.broadcast_to(jnp.expand_dims(jnp.transpose(y, order), tuple(new)), whole)  # noqa: E731
        return jax.tree.map(wide, x) if isinstance(x, Course) else wide(jnp.asarray(x))

    c = spread(a, (*left_batch, *free[0], *left), range(n + m, n + m + k))
    d = spread(b, (*right_batch, *free[1], *right), range(n, n + m))
    product = squared(width, c) if a is b and m + k == 0 and tuple(left) == tuple(right) else _mul(width, eqn, c, d)
    axes = tuple(range(n + m + k, len(whole)))
    return summed(width, jax.tree.map(lambda x: jnp.sum(x, axes), product))


_RULES: dict[str, Callable] = {
    "add": _add,
    "add_any": _add,
    "sub": _sub,
    "mul": _mul,
    "div": _div,
    "neg": lambda width, eqn, a: opposite(a),
    "square": lambda width, eqn, a: squared(width, a),
    "integer_pow": lambda width, eqn, a: to_whole_power(width, a, eqn.params["y"], functools.partial(_bind, eqn)),
    "pow": _pow,
    "polynomial": _polynomial,
    "one_minus_square": lambda width, eqn, a: shifted(opposite(squared(width, a)), jnp.ones_like(a.start)),
    "reduce_prod": _prod,
    "sin": lambda width, eqn, a: sine(width, a),
    "cos": lambda width, eqn, a: cosine(width, a),
    "atan2": lambda width, eqn, a, b: angle(width, *_alike(a, b)),
    "abs": lambda width, eqn, a: size(width, a),
    "max": _max,
    "min": _min,
    "clamp": _clamp,
    "reduce_max": functools.partial(_extreme, sign=1),
    "reduce_min": functools.partial(_extreme, sign=-1),
    "select_n": _select,
    "is_finite": _finite,
    "rem": _rem,
    "convert_element_type": _convert,
    "dot_general": _dot,
    "reduce_sum": lambda width, eqn, a: summed(width, _rearranged(eqn, [a])[0]),
    **{name: _of_smooth(name) for name in SMOOTH},
    **{name: _less for name in ("lt", "le", "gt", "ge", "eq", "ne")},
    **{name: _steps for name in ("floor", "ceil", "round", "sign")},
}
