"""Derivatives in tiles are derivatives: of a row of steps that is short enough to write down, they are those that JAX
finds of the same row written plainly, for any number of steps, of lanes, of tiles, in both modes and twice."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nonholo_jax._math.tangents import Iteration, tangent_of

MOST = 20


def begin(arguments):
    x, shared, _ = arguments
    return {"odd": jnp.asarray(False)}, {"x": x + shared, "sum": jnp.zeros_like(x)}


def step(arguments, i, stays, moving):
    x, shared, count = arguments
    old = moving["x"]
    new = shared * jnp.sin(old) + jnp.asarray(i).astype(x.dtype) * x
    going = i < count
    moved = {"x": jnp.where(going, new, old), "sum": moving["sum"] + jnp.where(going, new * old, 0.0)}
    return {"odd": stays["odd"] ^ going}, moved


def look(arguments, i, stays):
    return stays, jnp.sin(jnp.asarray(i).astype(float))


def follow(arguments, i, stays, path, moving):
    x, shared, count = arguments
    stays, moved = step(arguments, i, stays, moving)
    return stays, {"x": moved["x"], "sum": moved["sum"] + jnp.where(i < count, path * x, 0.0)}


def asked(moving):
    return moving["x"], 2.0 * moving["sum"]


def plainly(x, shared, count):
    stays, moving = begin((x, shared, count))
    for i in range(MOST):
        stays, path = look((x, shared, count), i, stays)
        stays, moving = follow((x, shared, count), i, stays, path, moving)
    return asked(moving)


def iteration(steps, finished=True):
    """All lanes make the same number of steps, some of them idle."""
    return Iteration(
        begin, lambda _, hint: steps + 0 * hint, look, follow, lambda _: jnp.asarray(finished), asked, MOST
    )


def tiled(steps, tile, finished=True):
    @jax.custom_jvp
    def run(x, shared, count):
        return plainly(x, shared, count)

    @run.defjvp
    def rule(primals, tangents):
        like = run(*primals)
        along = (*tangents[:2], None)
        hint = jnp.asarray(0, dtype=jnp.int32)
        return like, tangent_of(iteration(steps, finished), primals, along, hint, like, tile)

    return run


def numbers(n):
    count = jnp.arange(n, dtype=jnp.int32)
    return jnp.linspace(0.2, 1.4, n), jnp.asarray(0.7), count


def over_lanes(run, steps):
    """A scalar of all lanes, whose parameter is shared."""

    def loss(x, shared, count):
        a, b = jax.vmap(run, in_axes=(0, None, 0))(x, shared, jnp.minimum(count, steps))
        return jnp.sum(a * b) + jnp.sum(a)

    return loss


@pytest.mark.parametrize("steps", [0, 1, 8, 9, 17, 20])
@pytest.mark.parametrize("tile", [1, 4, 64])
def test_both_modes_are_those_of_the_plain_program(steps, tile):
    given = numbers(7)
    truth = jax.grad(over_lanes(plainly, steps), argnums=(0, 1))(*given)
    own = over_lanes(tiled(steps, tile), steps)
    reverse = jax.jit(jax.grad(own, argnums=(0, 1)))(*given)
    forward = jax.jit(jax.jacfwd(own, argnums=(0, 1)))(*given)
    for one, other, true in zip(reverse, forward, truth, strict=True):
        np.testing.assert_allclose(one, true, rtol=1e-12)
        np.testing.assert_allclose(other, true, rtol=1e-12)


@pytest.mark.parametrize("again", [jax.jacfwd, jax.jacrev])
@pytest.mark.parametrize("first", [jax.grad, jax.jacfwd])
def test_second_derivatives_in_every_order_of_modes(again, first):
    given, steps = numbers(5), 11
    second = lambda run: again(first(over_lanes(run, steps)))(*given)  # noqa: E731
    np.testing.assert_allclose(jax.jit(lambda: second(tiled(steps, 2)))(), second(plainly), rtol=1e-11, atol=1e-12)


def test_lanes_within_and_around_the_derivative():
    """vmap of grad, and grad of vmap, and Jacobians, whose directions are lanes of their own."""
    x, shared, count = numbers(6)
    run, steps = tiled(6, 4), 6
    each = jax.jit(jax.vmap(jax.jacrev(lambda x, c: run(x, shared, c)), in_axes=(0, 0)))(x, count)
    both = jax.jit(jax.vmap(jax.jacfwd(lambda x, c: run(x, shared, c)), in_axes=(0, 0)))(x, count)
    true = jax.vmap(jax.jacrev(lambda x, c: plainly(x, shared, c)), in_axes=(0, 0))(x, jnp.minimum(count, steps))
    for one, other, exact in zip(each, both, true, strict=True):
        np.testing.assert_allclose(one, exact, rtol=1e-12)
        np.testing.assert_allclose(other, exact, rtol=1e-12)


def test_a_path_that_is_longer_than_its_hint_has_no_silent_derivative():
    given = numbers(3)
    run = over_lanes(tiled(2, 4, finished=False), 2)
    assert np.all(np.isnan(jax.grad(run)(*given)))
    assert np.all(np.isnan(jax.jacfwd(run)(*given)))
