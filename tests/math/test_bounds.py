"""Bounds of functions along paths, from their own programs: that they hold, that they are sharp, and when there are
none."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nonholo_jax._math import Window, bend_of, evaluate
from nonholo_jax._math.bounds import Unbounded, course_of, is_boundable
from nonholo_jax._motion.crossing import _first_zero

MATRIX = np.random.default_rng(0).normal(size=(6, 3))
PLACES = np.array([[0.3, 0.1, 0.0], [-1.0, 0.4, 0.2], [0.5, -0.8, 0.9], [0.0, 1.5, -0.3]])


def like(x, c):
    return jnp.asarray(c, x.dtype)


def torus(x):
    """Not by `hypot`: with the least effort of XLA and JAX 0.10 a compiled program has wrong derivatives of that."""
    return jnp.sqrt((jnp.linalg.norm(x[:2] - like(x, [1.0, 0.0])) - 0.3) ** 2 + (x[2] - 0.5) ** 2) - 0.1


def _polynomial(c, x):
    """Before JAX 0.12 `polyval` is a loop."""
    return jnp.polyval(c, x) if jax.__version_info__ >= (0, 12) else ((c[0] * x + c[1]) * x + c[2]) * x + c[3]


def network(x):
    w = like(x, MATRIX)
    return jnp.sum(jnp.tanh(w @ jax.nn.sigmoid(w[:3] @ x)))


SMOOTH = {
    "linear": lambda x: x[2] - 0.3 * x[0] + 1.0,
    "ridge": lambda x: x[2] - 0.2 * jnp.exp(-0.5 * ((x[0] - 0.5) / 0.05) ** 2),
    "waves": lambda x: x[2] - 0.1 * jnp.sin(3.0 * x[0]) * jnp.cos(2.0 * x[1]),
    "terrain": lambda x: x[2] - 0.1 * jnp.sum(jnp.sin(like(x, MATRIX) @ x + 1.0)),
    "ratio": lambda x: x[0] / (1.0 + x[1] ** 2) + x[2] ** 3 / (2.0 + jnp.sin(x[0])),
    "quadratic_form": lambda x: x @ like(x, MATRIX[:3]) @ x,
    "network": network,
    "soft_minimum": lambda x: jnp.logaddexp(-x[0], -2.0 * x[1]) + jax.nn.softplus(3.0 * x[2]),
    "powers": lambda x: (x[0] ** 2 + 0.1) ** 1.5 + 2.0 ** x[1] + (x[2] ** 2 + 0.5) ** x[0] + x[1] ** -2.0 / 1e3,
    "roots": lambda x: jnp.cbrt(x[0] + 20.0) + jax.lax.rsqrt(x[1] ** 2 + 0.3) + jnp.log1p(x[2] ** 2),
    "angles": lambda x: jnp.arctan(x[0]) + jnp.arcsin(jnp.tanh(0.3 * x[1])) + jnp.arccos(jnp.tanh(0.3 * x[2])),
    "hyperbolic": lambda x: jnp.cosh(x[0]) * jnp.arcsinh(x[1]) + jnp.sinh(0.5 * x[2]) + jnp.expm1(0.5 * x[0]),
    "error_function": lambda x: jax.scipy.special.erf(x[0]) - jax.scipy.special.erfc(x[1]) + jnp.exp2(0.5 * x[2]),
    "polynomial": lambda x: _polynomial(like(x, [1.0, -2.0, 0.5, 3.0]), x[0]) + jnp.prod(x),
    "moved_about": lambda x: (
        jnp.sum(jnp.roll(jnp.stack([x, 2.0 * x]), 1, axis=1)[:, :2] ** 2) + x[jnp.array([2, 0])][0]
    ),
    "set": lambda x: jnp.sum(x.at[0].set(2.0).at[1].add(1.0) ** 3),
    "cross": lambda x: jnp.cross(x, like(x, MATRIX[0])) @ jnp.cross(like(x, MATRIX[1]), x),
    "rewritten": jax.checkpoint(jax.jit(lambda x: jax.nn.silu(x[0]) * jnp.log2(3.0 + x[1] ** 2))),
}
# Somewhere they have a kink, a jump, a pole, or no derivative.
ROUGH = {
    "torus": torus,
    "norm": lambda x: jnp.linalg.norm(x - 0.5) - 0.3,
    "nearest": lambda x: jnp.min(jax.vmap(lambda c: jnp.linalg.norm(x - c))(like(x, PLACES))) - 0.2,
    "box": lambda x: jnp.linalg.norm(jnp.maximum(jnp.abs(x) - 0.3, 0.0)) + jnp.minimum(jnp.max(jnp.abs(x) - 0.3), 0.0),
    "clipped": lambda x: x[2] - jnp.clip(x[0], -0.3, 0.4) ** 2,
    "periodic": lambda x: jnp.sqrt((jnp.mod(x[0] + 0.5, 1.0) - 0.5) ** 2 + x[2] ** 2) - 0.2,
    "either": lambda x: jnp.where((x[0] > 0) & (x[1] < 0.3), x[1] ** 2, x[2]) + (x[1] > 0.7).astype(x.dtype) * x[0],
    "pole": lambda x: x[2] - 1.0 / x[0] + jnp.tan(x[1]),
    "angle": lambda x: jnp.arctan2(x[1], x[0]) * x[2],
    "log": lambda x: jnp.log(x[0]) + jnp.abs(x[1]) ** 2.5,
    "stairs": lambda x: jnp.floor(2.0 * x[0]) * x[1] + jnp.sign(x[2]) * x[0],
    "log_of_sum": lambda x: jax.nn.logsumexp(-5.0 * x) / 5.0,
}
dtypes = pytest.mark.parametrize("dtype", [jnp.float64, jnp.float32])


def windows(n, dtype, degree=3):
    rng = np.random.default_rng(3)
    paths, widths = rng.normal(size=(n, 3, degree + 1)), 10.0 ** rng.uniform(-4, 0.3, n)
    return jnp.asarray(paths, dtype), jnp.asarray(widths, dtype)


def window(path, width):
    return Window(tuple(tuple(p) for p in path), width)


def course(function):
    return lambda path, width: course_of(function, window(path, width))


def samples(function, n=65):
    """Value, rate and second derivative along the window."""

    def one(path, width):
        along = lambda s: function(jnp.stack([evaluate(tuple(p), s) for p in path]))  # noqa: E731
        rate = jax.grad(along)
        s = jnp.linspace(0.0, 1.0, n, dtype=width.dtype) * width
        return tuple(jax.vmap(f)(s) for f in (along, rate, jax.grad(rate)))

    return one


@dtypes
@pytest.mark.parametrize("name", [*SMOOTH, *ROUGH])
def test_bounds_hold_all_along_the_window(name, dtype):
    function = {**SMOOTH, **ROUGH}[name]
    paths, widths = windows(400, dtype)
    both = lambda path, width: (course(function)(path, width), samples(function)(path, width))  # noqa: E731
    found, seen = jax.jit(jax.vmap(both))(paths, widths)
    slack = 1e4 * float(jnp.finfo(dtype).eps)  # of derivatives that JAX computes with rounding
    for bound, values in zip(found[:3], seen, strict=True):
        low, high, values = (np.asarray(x, np.float64) for x in (*bound, values))
        assert not np.isnan(low).any() and not np.isnan(high).any()
        known = np.isfinite(values) & np.isfinite(seen[0])  # not at a pole, not where there is no logarithm
        margin = slack * (1.0 + np.where(known, np.abs(values), 0.0).max(axis=1))
        assert (np.where(known, values, np.inf).min(axis=1) >= low - margin).all()
        assert (np.where(known, values, -np.inf).max(axis=1) <= high + margin).all()


@pytest.mark.parametrize("name", SMOOTH)
def test_bounds_close_in_linearly_on_the_second_derivative(name):
    """In a window of width h they are apart by O(h), as the second derivative itself is."""
    widths = 2.0 ** -np.arange(6.0, 14.0)
    both = jax.vmap(jax.vmap(course(SMOOTH[name]), (None, 0)), (0, None))
    bend = jax.jit(both)(windows(8, jnp.float64)[0], jnp.asarray(widths)).bend
    slopes = np.polyfit(np.log(widths), np.log(np.asarray(bend.high - bend.low)).T, 1)[0]
    assert np.median(slopes) == pytest.approx(1.0, abs=0.2)


@dtypes
@pytest.mark.parametrize("name", ["ridge", "waves", "torus", "box", "nearest", "pole"])
def test_a_step_by_the_bounds_never_passes_a_zero(name, dtype):
    """The parabola with them has its first zero no later than the function; also where it begins on one, whatever
    rounding makes of that."""
    paths, widths = windows(400, dtype)
    rises = np.random.default_rng(4).choice([0.0, 0.0, 1e-3, 0.1, 1.0], 400)

    def one(path, width, rise):
        function = {**SMOOTH, **ROUGH}[name]
        start = function(path[:, 0])
        gap = lambda x: function(x) - start + rise  # noqa: E731
        value, rate, _ = samples(gap)(path, width)
        return value, rate, bend_of(gap, None, window(path, width))

    value, rate, bend = jax.jit(jax.vmap(one))(paths, widths, jnp.asarray(rises, dtype))
    off = 4.0 * float(jnp.finfo(dtype).eps)  # the search and the bounds may round the value in two ways
    first = np.asarray(_first_zero(jnp.maximum(value[:, 0], 0.0) + off, rate[:, 0], bend.low))
    noise = 64.0 * float(jnp.finfo(dtype).eps) * (1.0 + np.abs(np.asarray(value)).max(axis=1))
    negative = np.asarray(value) < -noise[:, None]
    crossed = negative.any(axis=1) & np.isfinite(np.asarray(value)).all(axis=1)
    when = np.asarray(widths) * negative.argmax(axis=1) / (value.shape[1] - 1)
    assert crossed.sum() > 50
    assert (first[crossed] <= when[crossed]).all()


def test_alone_compiled_and_in_a_batch_bounds_agree():
    paths, widths = windows(3, jnp.float64)
    many = jax.vmap(course(torus))(paths, widths)
    for i, (path, width) in enumerate(zip(paths, widths, strict=True)):
        for one in (course(torus)(path, width), jax.jit(course(torus))(path, width)):
            for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(many), strict=True):
                np.testing.assert_allclose(a, b[i], rtol=1e-9)


class Hill(eqx.Module):
    height: jax.Array

    def __call__(self, x):
        return x[2] - self.height * jnp.sin(x[0])


def test_numbers_of_the_function_may_be_traced():
    path, width = (x[0] for x in windows(1, jnp.float64))

    def bend(height):
        inside = jax.lax.while_loop(
            lambda c: c[0] < 1, lambda c: (c[0] + 1, course(Hill(height))(path, width).bend.low), (0, 0.0 * height)
        )[1]
        return inside, course(lambda x: x[2] - height * jnp.sin(x[0]))(path, width).bend.low

    wanted = course(lambda x: x[2] - 0.3 * jnp.sin(x[0]))(path, width).bend.low
    heights = jnp.array([0.3, 0.3])
    for found in (*jax.jit(bend)(heights[0]), *jax.vmap(bend)(heights)):
        np.testing.assert_allclose(found, wanted, rtol=1e-12)
    np.testing.assert_array_equal(jax.jacfwd(lambda h: bend(h)[1])(heights[0]), 0.0)  # a bound is not differentiated


def test_any_operation_of_numbers_that_do_not_move_is_known():
    gap = lambda x: x[2] - jnp.sort(like(x, MATRIX[0]))[1] * x[0] ** 2  # noqa: E731
    assert is_boundable(gap, 3)
    assert is_boundable(lambda x: 1.0, 3)


UNKNOWN = {
    "sort": lambda x: jnp.sort(x)[0],
    "table": lambda x: jnp.interp(x[0], jnp.arange(4.0), jnp.arange(4.0) ** 2),
    "loop": lambda x: jax.lax.while_loop(lambda y: y < 0, lambda y: y + x[0] ** 2, x[2]),
    "large": lambda x: jnp.sum((jnp.ones((200, 200)) @ (jnp.ones((200, 3)) @ x)) ** 2),
}


@pytest.mark.parametrize("name", UNKNOWN)
def test_what_is_not_known_has_no_bounds(name):
    assert not is_boundable(UNKNOWN[name], 3)
    with pytest.raises(Unbounded):
        course(UNKNOWN[name])(*(x[0] for x in windows(1, jnp.float64)))


@pytest.mark.parametrize("n", [1, 2, 7])
def test_any_number_of_coordinates(n):
    assert is_boundable(lambda q: jnp.sum(jnp.cos(q) ** 2) - 0.1, n)


def test_a_kink_is_bounded_on_the_side_to_which_it_does_not_bend():
    path = jnp.array([[-0.5, 1.0, -0.2], [0.3, 0.0, 0.0], [0.0, 0.0, 0.0]])  # x[0] passes 0
    width = jnp.asarray(1.0)
    up, down = (course(lambda x, s=s: s * jnp.abs(x[0]))(path, width).bend for s in (1.0, -1.0))
    assert -0.5 < up.low < -0.3 and up.high == np.inf
    assert 0.3 < down.high < 0.5 and down.low == -np.inf


def test_a_length_has_bounds_even_where_it_is_zero():
    """|p|' is at most |p'| in size, and |p|'' at least -|p''|."""
    path = jnp.array([[-0.5, 1.0, 0.1], [-1.0, 2.0, 0.2], [0.0, 0.0, 0.0]])
    for length in (jnp.linalg.norm, lambda x: jnp.hypot(x[0], x[1]), lambda x: jnp.sqrt(x @ x)):
        found = course(length)(path, jnp.asarray(1.0))
        assert abs(found.rate.low) < 1.3 * np.sqrt(5.0) and abs(found.rate.high) < 1.3 * np.sqrt(5.0)
        assert -0.5 < found.bend.low < 0.0 and found.bend.high == np.inf


def test_a_function_is_known_by_what_it_does_not_by_its_name():
    @jax.jit
    def hypot(a, b):
        return a * b

    path, width = (x[0] for x in windows(1, jnp.float64))
    named = course(lambda x: hypot(x[0], x[1]))(path, width)
    plain = course(lambda x: x[0] * x[1])(path, width)
    np.testing.assert_allclose(named.bend, plain.bend, rtol=1e-12)
