"""Derivatives in tiles are derivatives: of a row of steps that is short enough to write down, they are those that JAX
finds of the same row written plainly, for any number of steps, of lanes, of tiles, in both modes and twice."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nonholo_jax._math.tangents import Iteration, tangent_of

MOST = 20
PARTS = {1: 20, 5: 4, 20: 1}  # how many parts, of how many steps


def begin(arguments):
    x, shared, count = arguments
    return {"odd": jnp.asarray(False), "x": x + shared}, {"x": x + shared, "sum": jnp.zeros_like(x)}


def step(arguments, row, moving):
    """The path, sin(i), is known; so is x at the beginning, but not its derivative."""
    x, shared, _ = arguments
    i, path = row["i"], row["path"]
    old = moving["x"]
    new = shared * jnp.sin(old) + i.astype(x.dtype) * x
    moved = {"x": new, "sum": moving["sum"] + new * old + path * x}
    return moved, jnp.stack([new * shared, old])


def look(size):
    def look(arguments, k, stays):
        """`size` steps from k * size on, as far as there are so many."""
        x, shared, count = jax.lax.stop_gradient(arguments)
        i = size * jnp.asarray(k, dtype=jnp.int32) + jnp.arange(size, dtype=jnp.int32)
        rows, now, total = [], *stays["moving"]
        for each in range(size):
            path = jnp.sin(i[each].astype(x.dtype))
            rows.append({"i": i[each], "path": path, "x": now, "sum": total})
            new, _ = step((x, shared, count), rows[-1], {"x": now, "sum": total})
            going = i[each] < count
            now, total = jnp.where(going, new["x"], now), jnp.where(going, new["sum"], total)
        rows = jax.tree.map(lambda *columns: jnp.stack(columns), *rows)
        return {**stays, "moving": (now, total), "done": count <= i[-1] + 1}, jnp.clip(count - i[0], 0, size), rows

    return look


def asked(moving, table):
    return moving["x"], 2.0 * moving["sum"], jnp.sum(table[:, 0] + 3.0 * table[:, 1])


def plainly(x, shared, count):
    _, moving = begin((x, shared, count))
    table = jnp.zeros((MOST, 2))
    for i in range(MOST):
        row = {"i": jnp.asarray(i, dtype=jnp.int32), "path": jnp.sin(jnp.asarray(i, dtype=x.dtype))}
        new, record = step((x, shared, count), row, moving)
        moving = jax.tree.map(lambda a, b, i=i: jnp.where(i < count, a, b), new, moving)
        table = table.at[jnp.where(i < count, i, MOST)].set(record, mode="drop")
    return asked(moving, table)


def iteration(steps, parts, finishes=True, missing=0):
    """All lanes look through the same number of parts, some of them idle; the hint may be some parts short."""
    size = PARTS[parts]

    def starts(arguments):
        stays, moving = begin(arguments)
        stays["done"] = arguments[2] <= 0
        return {**stays, "moving": jax.lax.stop_gradient((moving["x"], moving["sum"]))}, moving

    return Iteration(
        begin=starts,
        parts=lambda _, hint: max(-(-steps // size) - missing, min(steps, 1)) + 0 * hint,
        look=look(size),
        harmless=lambda arguments, _: arguments,
        starts=lambda row: {"x": row["x"], "sum": row["sum"]},
        step=step,
        place=lambda row: row["i"],
        table=np.zeros((MOST, 2)),
        finished=lambda stays: stays["done"] & finishes,
        of=asked,
        most=parts,
    )


def tiled(steps, tile, finishes=True, parts=5, missing=0):
    @jax.custom_jvp
    def run(x, shared, count):
        return plainly(x, shared, count)

    @run.defjvp
    def rule(primals, tangents):
        like = run(*primals)
        along = (*tangents[:2], None)
        hint = jnp.asarray(0, dtype=jnp.int32)
        way = iteration(steps, parts, finishes, missing)
        return like, tangent_of(way, way, primals, along, hint, like, tile)

    return run


def numbers(n):
    count = jnp.arange(n, dtype=jnp.int32)
    return jnp.linspace(0.2, 1.4, n), jnp.asarray(0.7), count


def over_lanes(run, steps):
    """A scalar of all lanes, whose parameter is shared."""

    def loss(x, shared, count):
        a, b, c = jax.vmap(run, in_axes=(0, None, 0))(x, shared, jnp.minimum(count, steps))
        return jnp.sum(a * b) + jnp.sum(a) + jnp.sum(b * c)

    return loss


@pytest.mark.parametrize("steps", [0, 1, 8, 9, 17, 20])
@pytest.mark.parametrize("tile, parts", [(1, 5), (4, 1), (4, 5), (64, 20)])
def test_both_modes_are_those_of_the_plain_program(steps, tile, parts):
    given = numbers(7)
    truth = jax.grad(over_lanes(plainly, steps), argnums=(0, 1))(*given)
    own = over_lanes(tiled(steps, tile, parts=parts), steps)
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


@pytest.mark.parametrize("missing", [1, 3, 20])
@pytest.mark.parametrize("steps, parts", [(9, 5), (20, 5), (20, 20)])
def test_a_path_that_is_longer_than_its_hint_is_followed_to_its_end(steps, parts, missing):
    given = (*numbers(7)[:2], jnp.asarray([0, 20, 3, 1, 9, 20, 5], dtype=jnp.int32))
    truth = jax.grad(over_lanes(plainly, steps), argnums=(0, 1))(*given)
    own = over_lanes(tiled(steps, 4, parts=parts, missing=missing), steps)
    for way in (jax.grad, jax.jacfwd, jax.jacrev):
        for one, true in zip(jax.jit(way(own, argnums=(0, 1)))(*given), truth, strict=True):
            np.testing.assert_allclose(one, true, rtol=1e-12)


def test_a_path_that_does_not_end_has_no_silent_derivative():
    given = numbers(3)
    run = over_lanes(tiled(2, 4, finishes=False), 2)
    assert np.all(np.isnan(jax.grad(run)(*given)))
    assert np.all(np.isnan(jax.jacfwd(run)(*given)))
