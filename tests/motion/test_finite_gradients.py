"""Derivatives are finite in every lane, however the motion ends, and whatever was computed and not chosen."""

import functools

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import AIR, GRAVITY, all_motions, all_surfaces, scene_of, stacked, states
from jax.flatten_util import ravel_pytree

from nonholo_jax import (
    Air,
    Ball,
    BallState,
    Box,
    Frictional,
    Integrated,
    Plane,
    Rough,
    Scene,
    Smooth,
    Sphere,
    simulate,
)

PLANE = all_surfaces[0]


def awkward_lanes(dtype):
    """Lanes that end in every way: what it is, position, velocity, spin."""
    r = 0.1
    rows = {
        "bounces": ([0, 0, 1.0], [0.5, 0, -1], [1, 2, 3]),
        "finished_at_once_touching_and_leaving": ([0, 0, r], [0, 0, 3], [0, 0, 0]),
        "touching_and_approaching": ([0, 0, r], [1, 0, -3], [0, 0, 0]),
        "at_rest_on_the_floor": ([0, 0, r], [0, 0, 0], [0, 0, 0]),
        "slides_on_the_floor": ([0, 0, r], [1, 0, 0], [0, 0, 0]),
        "drops_without_slip_or_spin": ([0.5, 0.5, 0.5], [0, 0, 0], [0, 0, 0]),
        "misses_everything": ([0, 0, 3.0], [0, 0, 9], [0, 0, 0]),
        "grazes_the_sphere": ([1.0, 0, 3.0], [0, 0, 0], [0, 0, 0]),
        "drops_on_the_top_of_the_sphere": ([2.0, 0, 1.7], [0, 0, 0], [0, 0, 0]),
        "drops_on_an_edge_of_the_box": ([-1.5, 0, 1.2], [0, 0, 0], [0, 0, 0]),
        "drops_on_a_corner_of_the_box": ([-1.5, -0.5, 1.2], [0, 0, 0], [0, 0, 0]),
        "floor_and_box_together": ([-1.4, 0, r], [-1, 0, -1], [0, 0, 0]),
        "bounces_without_end": ([0.5, 0.5, r + 1e-9], [0, 0, 0], [0, 0, 0]),
        "starts_inside_the_sphere": ([2.0, 0, 1.0], [0, 0, 0], [0, 0, 0]),
        "starts_at_the_centre_of_the_box": ([-2.0, 0, 0.5], [0, 0, 0], [0, 0, 0]),
    }
    return list(rows), states(*zip(*rows.values(), strict=True), dtype)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("motion", ["exact", "heun"])
def test_no_nan_in_any_lane(motion, dtype):
    names, throw = awkward_lanes(dtype)
    cast = lambda x: jnp.asarray(x, dtype)  # noqa: E731
    numbers = {"radius": cast(0.1), "e": cast(0.7), "t": cast(0.2), "f": cast(0.3), "size": cast([0.5, 0.5, 0.5])}

    def end(numbers, state):
        surfaces = {
            "floor": Plane(cast([0, 0, 0]), (0, 0, 1), Frictional(numbers["e"], numbers["t"], numbers["f"])),
            "ball": Sphere(cast([2.0, 0, 0.8]), cast(0.9), Rough(numbers["e"])),
            "box": Box(cast([-2.0, 0, 0.5]), numbers["size"], Smooth(numbers["e"])),
        }
        air = None if motion == "exact" else AIR
        scene = scene_of_surfaces(numbers["radius"], surfaces, air)
        trajectory = simulate(
            scene, state, t1=0.6, max_impacts=6, sum_trains=False, motion=all_motions[motion], throw=False
        )
        log = trajectory.impacts
        time = jnp.where(log.surface >= 0, log.time, 0.0).sum()
        return stacked(trajectory.final), time, trajectory.t1

    @jax.jit
    @functools.partial(jax.vmap, in_axes=(None, 0))
    def run(numbers, state):
        flat, unravel = ravel_pytree((numbers, state))
        value = lambda x: ravel_pytree(end(*unravel(x)))[0]  # noqa: E731
        out, pullback = jax.vjp(value, flat)
        forward = jax.vmap(lambda tangent: jax.jvp(value, (flat,), (tangent,))[1])(jnp.eye(flat.size, dtype=dtype))
        return out, forward, jax.vmap(pullback)(jnp.eye(out.size, dtype=dtype))

    for what, found in zip(("value", "forward", "reverse"), run(numbers, throw), strict=True):
        for i, name in enumerate(names):
            assert all(np.all(np.isfinite(leaf[i])) for leaf in jax.tree.leaves(found)), (name, what)


def scene_of_surfaces(radius, surfaces, air):
    scene = scene_of(PLANE, Rough(), air=air)
    return Scene(Ball(radius, 0.7), surfaces, GRAVITY, scene.air)


def test_an_arc_that_nothing_cuts_has_finite_derivatives():
    """In float32 a Newton step towards a table that this flight does not meet overflowed in its seventh power, and what
    was not even chosen made the reverse derivative NaN."""
    table = Box((0.6, 0.0, 0.715), (0.6, 0.4, 0.015), Rough(0.9, 0.5))
    scene = Scene(Ball(0.025, 0.046), {"table": table}, air=Air(lift=1.0))
    numbers = (
        [-0.99037641, 0.00655911, 0.025],
        [-1.1950164, 0.01207377, 4.2920685],
        [-0.65627468, -38.619197, 0.61274576],
    )
    state = BallState(*(jnp.asarray(x, jnp.float32) for x in numbers))
    steps = diffrax.ConstantStepSize()
    motion = Integrated(solver=diffrax.Dopri8(), stepsize_controller=steps, dt0=2 / 128, max_steps=16)

    def end(state):
        options = {"t1": jnp.float32(0.07809377), "motion": motion, "log_size": 0, "sum_trains": False}
        return simulate(scene, state, **options).final.position.sum()

    slopes = jax.jit(jax.grad(end))(state)
    np.testing.assert_allclose(slopes.position, 1.0, rtol=1e-6)  # nothing but a flight
    assert np.isfinite(ravel_pytree(slopes)[0]).all()
