"""A ball that rolls on curved surfaces and along a groove, against the Lagrangian system of the paper, whose A says
that no contact point moves. As the ball's inertia is the same about all axes, its spin needs no coordinates but its
integrals."""

import functools

import jax.numpy as jnp
import numpy as np
import pytest

from nonholo_jax import (
    Ball,
    BallState,
    Cylinder,
    Exact,
    Integrated,
    LagrangianSystem,
    Plane,
    Rough,
    Scene,
    Sphere,
    simulate,
)

R, ALPHA, PULL = 0.1, 0.4, (0.7, -0.4, -9.81)
RHO, BOWL = 0.4, 0.9
TILT = np.array([np.cos(0.3), 0.0, np.sin(0.3)])  # the axis of the cylinder


def from_the_middle(x):
    n = -x / jnp.linalg.norm(x)
    return [n]


def from_the_axis(x):
    across = x - jnp.sum(x * TILT.astype(x.dtype)) * TILT.astype(x.dtype)
    return [-across / jnp.linalg.norm(across)]


def between_planes(x):
    return [jnp.array([np.cos(0.6), 0.0, np.sin(0.6)], x.dtype), jnp.array([-np.cos(0.9), 0.0, np.sin(0.9)], x.dtype)]


def round_a_post(x):
    across = x * jnp.array([1.0, 1.0, 0.0], x.dtype)
    return [*from_the_middle(x), across / jnp.linalg.norm(across)]


ROUGH = Rough(0.0)
LEFT, RIGHT = between_planes(np.zeros(3))
BOTH = {"a": Plane((0, 0, 0), LEFT, ROUGH), "b": Plane((0, 0, 0), RIGHT, ROUGH)}
BOWL_WITH_POST = {
    "bowl": Sphere((0, 0, 0), BOWL + R, ROUGH, inside=True),
    "post": Cylinder((0, 0, 0), (0, 0, 1), RHO - R, ROUGH),
}
WAYS = {  # the surfaces, the normals, the place and the velocity of the ball, its spin about what is left free
    "in a sphere": ({"bowl": Sphere((0, 0, 0), BOWL + R, ROUGH, inside=True)}, from_the_middle, (0.36, 0.0), 8.0),
    "in a cylinder": ({"pipe": Cylinder((0, 0, 0), TILT, 1.0, ROUGH, inside=True)}, from_the_axis, (0.2, 0.1), 8.0),
    "along a groove": (BOTH, between_planes, None, 0.0),
    "round a post": (BOWL_WITH_POST, round_a_post, None, 0.0),
}


def place_of(name):
    if name == "along a groove":
        one, two = (np.asarray(n)[::2] for n in between_planes(np.zeros(3)))
        x, z = np.linalg.solve(np.stack([one, two]), [R, R])
        return np.array([x, 0.0, z])
    if name == "round a post":
        return np.array([RHO, 0.0, -np.sqrt(BOWL**2 - RHO**2)])
    if name == "in a sphere":
        return np.array([0.3, 0.2, -np.sqrt(BOWL**2 - 0.13)])
    side = np.array([0.0, 1.0, 0.0])
    down = np.cross(TILT, side)
    down = -down * np.sign(down[2])
    return 0.9 * (np.cos(0.4) * down + np.sin(0.4) * side)


def lagrangian(normals):
    inertia = ALPHA * R * R

    def constraint(q):
        n = normals(q[:3])
        zero = jnp.zeros(3, q.dtype)
        if len(n) == 1:  # v - r omega x n = 0
            a, b, c = n[0]
            turned = R * jnp.array([[0.0, -c, b], [c, 0.0, -a], [-b, a, 0.0]], q.dtype)
            return jnp.concatenate([jnp.eye(3, dtype=q.dtype), turned], axis=1)
        e = jnp.cross(*n)
        rows = [jnp.concatenate([k, zero]) for k in n]
        rows += [jnp.concatenate([e, -R * jnp.cross(k, e)]) for k in n]  # e . (v - r omega x n)
        return jnp.stack([*rows, jnp.concatenate([zero, e])])

    return LagrangianSystem(
        metric=lambda q: jnp.diag(jnp.array([1.0] * 3 + [inertia] * 3, q.dtype)),
        potential=lambda q: -jnp.sum(jnp.array(PULL, q.dtype) * q[:3]),
        constraint=constraint,
    )


@functools.cache
def moved(name, dtype):
    """Place, velocity and r times spin, by the ball and by the Lagrangian system."""
    surfaces, normals, along, pivot = WAYS[name]
    x = place_of(name)
    n = [np.asarray(k, float) for k in normals(jnp.asarray(x))]
    if along is None:
        e = np.cross(*n)
        c = np.linalg.norm(e)
        v, spin = 0.3 * e / c, 0.3 * (n[0] - n[1]) / (R * c)
    else:
        v = np.cross(n[0], [along[0], along[1], 0.5])
        spin = np.cross(n[0], v) / R + pivot * n[0]
    tolerance = 1e-10 if dtype == jnp.float64 else 1e-6
    steps = Integrated(rtol=tolerance, atol=tolerance)
    x, v, spin = (jnp.asarray(part, dtype) for part in (x, v, spin))
    scene = Scene(Ball(R, 1.0, ALPHA), surfaces, gravity=PULL)
    ball = simulate(scene, BallState(x, v, spin), t1=0.8, motion=Exact(contact=steps), max_impacts=8).final
    begin = jnp.concatenate([x, jnp.zeros(3, dtype)]), jnp.concatenate([v, spin])
    q, w = simulate(lagrangian(normals), begin, t1=0.8, motion=steps, max_impacts=4).final
    one = np.concatenate([ball.position, ball.velocity, R * ball.spin])
    return one, np.concatenate([q[:3], w[:3], R * w[3:]])


@pytest.mark.parametrize("dtype", [jnp.float64, jnp.float32], ids=["float64", "float32"])
@pytest.mark.parametrize("name", WAYS)
def test_rolls_as_the_lagrangian_system(name, dtype):
    ball, system = moved(name, dtype)
    np.testing.assert_allclose(ball, system, atol=3e-8 if dtype == jnp.float64 else 2e-4)
    assert np.max(np.abs(ball[3:6])) > 0.1
