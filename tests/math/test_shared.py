"""`shared` is the identity in every derivative, and in the program of a CPU what XLA does not copy: a barrier, or,
before JAX 0.12, a division."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nonholo_jax._math.shared import shared

dtypes = pytest.mark.parametrize("dtype", [np.float32, np.float64])


def one(x):
    (x,) = shared([x])
    return x


def numbers(dtype):
    info = np.finfo(dtype)
    ends = [0.0, -0.0, 1.0, -1 / 3, np.inf, -np.inf, np.nan, info.max, -info.max, info.tiny, info.eps, np.pi]
    return jnp.asarray(np.asarray(ends, dtype))


def same(found, expected):
    """To the last bit, the sign of zero included."""
    assert found.dtype == expected.dtype and found.shape == expected.shape
    np.testing.assert_array_equal(np.asarray(found), np.asarray(expected))
    signs = [np.where(np.isnan(x), False, np.signbit(x)) for x in (found, expected)]
    np.testing.assert_array_equal(*signs)


@dtypes
@pytest.mark.parametrize("wrap", [lambda f: f, jax.jit], ids=["eager", "jit"])
def test_identity_in_value_and_derivatives(wrap, dtype):
    x = numbers(dtype)
    same(wrap(one)(x), x)
    same(wrap(jax.vmap(one))(x), x)
    same(wrap(jax.vmap(one, in_axes=1))(jnp.stack([x, -x])), jnp.stack([x, -x], axis=1))
    # Infinite and NaN as place and as direction: each is handed through by itself.
    for place, direction in ((x, x), (jnp.ones_like(x), x), (x, jnp.ones_like(x))):
        value, tangent = wrap(lambda p, d: jax.jvp(one, (p,), (d,)))(place, direction)
        same(value, place)
        same(tangent, direction)
        same(wrap(lambda p, d: jax.vjp(one, p)[1](d)[0])(place, direction), direction)
    same(wrap(jax.vmap(jax.grad(one)))(x), jnp.ones_like(x))


@dtypes
@pytest.mark.parametrize("outer", [jax.jacfwd, jax.jacrev])
@pytest.mark.parametrize("inner", [jax.jacfwd, jax.jacrev])
def test_second_derivatives(inner, outer, dtype):
    x = jnp.asarray([0.3, -1.7, 2.9], dtype)

    def value(x, passed):
        a, b, c = passed([x[0], x[1] * x[0], jnp.sin(x[2])])
        (end,) = passed([a * b * c + c**3])
        return end

    first, second = (jax.jit(outer(inner(lambda x, p=passed: value(x, p))))(x) for passed in (shared, tuple))
    assert first.dtype == dtype
    np.testing.assert_allclose(first, second, rtol=0, atol=32 * np.finfo(dtype).eps)
    linear = jax.jit(outer(inner(one)))(x[0])
    same(linear, jnp.zeros_like(linear))


def test_constants_stay_constants():
    values = shared([1.5, 2, jnp.ones(())])
    assert values[:2] == (1.5, 2) and all(isinstance(value, float | int) for value in values[:2])


PROGRAMS = {  # and how many numbers each shares
    "value": (one, 1),
    "tangent": (lambda x: jax.jvp(one, (x,), (2 * x,)), 2),
    "transposed": (lambda x: jax.vjp(one, x)[1](2 * x), 1),
    "tangent_of_transposed": (lambda x: jax.jvp(lambda y: jax.vjp(one, y)[1](y * y)[0], (x,), (x,)), 2),
    "batch": (lambda x: jax.vmap(one)(jnp.stack([x, x])), 1),
}


@pytest.mark.parametrize("name", PROGRAMS)
def test_programs_of_a_cpu_have_it_and_others_do_not(name):
    program, count = PROGRAMS[name]
    traced = jax.jit(program).trace(jnp.ones(()))
    text = {p: traced.lower(lowering_platforms=(p,)).as_text() for p in ("cpu", "cuda")}
    operation = "stablehlo.optimization_barrier" if jax.__version_info__ >= (0, 12) else "stablehlo.divide"
    assert text["cpu"].count(operation) == count
    assert operation not in text["cuda"]
    if jax.default_backend() == "cpu" and "divide" in operation:  # nor does the compiler see through the divisor
        assert " divide(" in traced.lower().compile().as_text()
