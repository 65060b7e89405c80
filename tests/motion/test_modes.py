"""The missing axis of the registry: however a motion is asked for, plainly or within transformations of JAX, it is the
same motion, with the same derivative, on every shape and under every law.

Compiling is what costs. Every shape is compiled under one structure of law in turn: plainly, batched, and in one
program with the scene traced that is `jit`, `grad`, and `jit` of `grad` at once. Under all others what may differ is
what Python does while it traces, for which nothing need be compiled."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import all_laws, all_surfaces, lane, named, scene_of, throws

from nonholo_jax import Ball, BallState, Box, Frictional, Rectangle, Scene, simulate

OPTIONS = {"t1": 0.5, "max_impacts": 8, "log_size": 0}
LAWS = {law.name: law for law in all_laws}
# Of the structures of laws, that in which a shape is compiled: friction is what only faces know how to handle.
IN_TURN = ("frictional_sliding", "rough", "smooth", "rough_two_coefficients")
COMPILED = {
    shape.name: LAWS["frictional_sliding" if shape.name in ("box", "rectangle") else IN_TURN[i % len(IN_TURN)]]
    for i, shape in enumerate(all_surfaces)
}
WEIGHTS = np.array([1.0, -2.0, 0.5])
# The others are these turned about, thin, or from the other side: the same code.
DIFFERENTIATED = ("plane", "box", "sphere_outside", "cylinder_inside", "implicit")
# One law of each structure; the gripping law of friction differs from the sliding one in a number.
STRUCTURES = [law for law in all_laws if law.name != "frictional_gripping"]
shapes = pytest.mark.parametrize("shape", **named(all_surfaces))
laws = pytest.mark.parametrize("law", **named(STRUCTURES))


@pytest.fixture(scope="module", autouse=True)
def _without_the_slow_passes_of_the_compiler():
    jax.config.update("jax_disable_most_optimizations", True)
    yield
    jax.config.update("jax_disable_most_optimizations", False)


def final(scene, state):
    return simulate(scene, state, **OPTIONS).final.position


def size(scene, state):
    """A number with a derivative in all that a motion begins with."""
    return jnp.dot(final(scene, state), WEIGHTS)


def flat(tree):
    return np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(tree)])


def assert_close(got, wanted, tolerance):
    got, wanted = flat(got), flat(wanted)
    assert np.linalg.norm(got - wanted) <= tolerance * np.linalg.norm(wanted)


@shapes
def test_every_mode_computes_the_same_motion(shape, getkey):
    law = COMPILED[shape.name]
    scene, batch = scene_of(shape, law.build(**law.numbers)), throws(shape, getkey(), 2)
    state, traced = lane(batch, 0), jax.tree.map(jnp.asarray, scene)

    plain = final(scene, state)
    assert_close(jax.vmap(lambda state: final(scene, state))(batch)[0], plain, 1e-11)
    if shape.name not in DIFFERENTIATED:
        assert_close(jax.jit(final)(traced, state), plain, 1e-12)
        return
    value, (of_scene, of_state) = jax.jit(jax.value_and_grad(size, argnums=(0, 1)))(traced, state)
    assert_close(value, jnp.dot(plain, WEIGHTS), 1e-12)
    assert np.linalg.norm(flat(of_scene)) > 0.01  # it was struck
    assert_close(jax.grad(lambda state: size(scene, state))(state), of_state, 1e-12)


@shapes
@laws
def test_every_law_can_be_traced_on_every_shape(shape, law, getkey):
    state = lane(throws(shape, getkey(), 1), 0)
    scene = scene_of(shape, law.build(**law.numbers))
    assert jax.eval_shape(lambda state: final(scene, state), state).shape == (3,)


@pytest.mark.parametrize("shape", ["box", "rectangle"])
def test_friction_on_a_flat_face_within_jit(shape):
    """A condition on known numbers was once computed by JAX, which made it unknown within `jit`."""
    law = Frictional(0.93, 0.0, 0.25)
    table = {
        "box": Box((0.0, 0.0, 0.745), (1.37, 0.7625, 0.015), law),
        "rectangle": Rectangle((0.0, 0.0, 0.76), (0.0, 0.0, 1.0), (1.0, 0.0, 0.0), (1.37, 0.7625), law),
    }[shape]
    scene = Scene(Ball(0.02, 0.0027, 2 / 3), {"table": table})
    start, still = jnp.array([0.0, 0.0, 1.0]), jnp.zeros(3)

    @jax.jit
    def height(velocity):
        return simulate(scene, BallState(start, velocity, still), t1=0.3).final.position[2]

    assert height(jnp.array([1.0, 0.0, -2.0])) == pytest.approx(1.126840778, abs=1e-9)
