"""What is lowered for another platform than this one: nothing in it calls the host, or asks for what only a CPU has."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import AIR, states

from nonholo_jax import Air, Ball, Box, Exact, Integrated, Plane, Rough, Scene, simulate, simulate_batch

LAW = Rough(0.9)
SURFACES = {
    "floor": Plane((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), LAW),
    "box": Box((0.3, 0.0, 0.2), (0.1, 0.1, 0.1), LAW),
}
SCENES = {air is not None: Scene(Ball(0.1, 0.7), SURFACES, air=air) for air in (None, Air(**AIR))}
# More lanes than there are in a tile of either motion.
N = max(Exact().tile, Integrated().tile) + 1
# By which JAX writes `lax.empty`: GPUs and TPUs know it.
EVERYWHERE = {"AllocateBuffer"}

dtypes = pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64], ids=["float32", "float64"])
scenes = pytest.mark.parametrize("in_air", [False, True], ids=["exact", "integrated"])


def throws(dtype, *axes):
    parts = [0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 3.0, 0.0]
    return states(*[np.broadcast_to(x, (*axes, 3)) for x in parts], dtype)


def alone(scene, state):
    return simulate(scene, state, t1=0.5, max_impacts=8, throw=False)


def batch(scene, states):
    return simulate_batch(scene, states, t1=0.5, max_impacts=8, throw=False)


def value(run, scene):
    def call(state):
        trajectory = run(scene, state)
        return trajectory.final, trajectory.t1, trajectory.impacts.time, trajectory.result._value

    return jax.jit(call)


def gradient(run, scene):
    return jax.jit(jax.grad(lambda state: jnp.sum(run(scene, state).final.position)))


def module(program, arguments, platform):
    """The text of an exported program."""
    return jax.export.export(program, platforms=[platform])(arguments).mlir_module()


def custom_calls(text):
    return set(re.findall(r"custom_call @([\w.]+)", text)) | set(re.findall(r'call_target_name = "([^"]+)"', text))


def assert_needs_no_cpu(program, arguments):
    texts = [module(program, arguments, platform) for platform in ("cuda", "tpu")]
    for text in texts:
        assert custom_calls(text) <= EVERYWHERE
        assert "callback" not in text
        # Sharing is for the CPU's compiler: elsewhere it would only forbid fusion.
        assert "optimization_barrier" not in text
    assert texts[0].count("\n") == texts[1].count("\n")


@scenes
@dtypes
@pytest.mark.parametrize("run", [alone, batch])
def test_a_motion_for_another_platform_needs_no_host_and_no_cpu(run, dtype, in_air):
    arguments, program = throws(dtype, *([N] if run is batch else [])), value(run, SCENES[in_air])
    assert_needs_no_cpu(program, arguments)
    text = module(program, arguments, "cpu")
    assert not custom_calls(text) and "callback" not in text
    assert ("optimization_barrier" in text) == (jax.__version_info__ >= (0, 12))


@scenes
@dtypes
def test_a_gradient_for_another_platform_needs_no_host_and_no_cpu(dtype, in_air):
    assert_needs_no_cpu(gradient(alone, SCENES[in_air]), throws(dtype))


@scenes
def test_a_batch_of_gradients_for_another_platform_needs_no_host_and_no_cpu(in_air):
    """In one dtype: lowering is what costs, and in what it lowers to a batch of float64 differs in nothing else."""
    assert_needs_no_cpu(gradient(batch, SCENES[in_air]), throws(jnp.float32, N))


def test_what_raises_calls_the_host():
    raises = jax.jit(lambda state: simulate(SCENES[False], state, t1=0.5, max_impacts=8).final)
    assert any("callback" in name for name in custom_calls(raises.lower(throws(jnp.float32)).as_text()))
