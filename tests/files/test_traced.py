"""Numbers of a scene file that may change without a new program, and those that are structure."""

from pathlib import Path

import jax
import jax.monitoring
import jax.numpy as jnp
import numpy as np
import pytest

from nonholo_jax import (
    Air,
    Ball,
    BallState,
    Box,
    Cylinder,
    Exact,
    Frictional,
    Integrated,
    Plane,
    Rough,
    Scene,
    Smooth,
    Sphere,
    simulate,
)
from nonholo_jax._motion.simulate import checked
from nonholo_jax.scene_file import load_scene, traced

SCENES = sorted((Path(__file__).parents[2] / "experiments" / "scenes").glob("*.toml"))
COMPILED: list[str] = []


@pytest.fixture(scope="module", autouse=True)
def _listening():
    """From now on: JAX has no public way to stop one listener, and the command line has one of its own."""

    def heard(event, seconds, **details):
        if event == "/jax/core/compile/backend_compile_duration":
            COMPILED.append(event)

    jax.monitoring.register_event_duration_secs_listener(heard)


def room(restitution=0.9, height=0.715, floor=0.8, radius=0.025, wind=0.0):
    surfaces = {
        "floor": Plane((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), Rough(floor, tangential=0.5)),
        "table": Box((0.6, 0.0, height), (0.6, 0.4, 0.015), Rough(restitution)),
    }
    air = None if wind == 0.0 else Air(wind=(wind, 0.0, 0.0))
    return Scene(Ball(radius, 0.046), surfaces, air=air)


def moved(scene, spin=15.0, t1=0.4):
    throw = BallState([-0.3, 0.0, 0.9], [2.0, 0.0, -5.0], [0.0, spin, 0.0])
    return simulate(scene, throw, t1=t1, max_impacts=8)


def test_other_numbers_need_no_other_program():
    moved(traced(room()))
    COMPILED.clear()
    one = moved(traced(room(0.8, 0.7, 0.75, 0.026)), spin=12.0, t1=0.45)
    assert not COMPILED
    other = moved(room(0.8, 0.7, 0.75, 0.026), spin=12.0, t1=0.45)
    assert COMPILED  # the listener listens
    assert int(one.n_impacts) == int(other.n_impacts) >= 2
    for a, b in zip(jax.tree.leaves(one.final), jax.tree.leaves(other.final), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-12)
    rows = 8  # traced surfaces may be flush, so that their log has rows for what the ball passes
    np.testing.assert_allclose(one.impacts.time[:rows], other.impacts.time[:rows], rtol=1e-12)
    assert np.all(np.isnan(one.impacts.time[rows:]))


def test_what_changes_the_model_stays_a_constant():
    surfaces = {
        "floor": Plane((0.0, 0.0, 0.0), (0.0, 0.6, 0.8), Rough(1.0, tangential=-1.0)),
        "ice": Sphere((0.0, 0.0, -5.0), 1.0, Smooth(0.0)),
        "wall": Cylinder((9.0, 0.0, 0.0), (0.0, 0.0, 1.0), 1.0, Frictional(0.5, 0.25, 0.0)),
        "box": Box((5.0, 0.0, 0.0), (1.0, 1.0, 1.0), Rough(), rotation=(0.8, 0.0, 0.6, 0.0)),
    }
    scene = traced(Scene(Ball(1.0, 1.0, 1.0), surfaces, (0.0, 0.0, -9.81), Air(drag=0.0, wind=(1.0, 0.0, 0.0))))
    floor, ice, wall, box = scene.surfaces
    assert (floor.law.restitution, floor.law.tangential) == (1.0, -1.0)
    assert (ice.law.restitution, wall.law.friction) == (0.0, 0.0)
    assert isinstance(wall.law.restitution, jax.Array) and isinstance(wall.law.tangential, jax.Array)

    def kept(vector):
        return [x if isinstance(x, float) else None for x in vector]

    assert kept(floor.facing) == [0.0, None, None] and kept(floor.point) == kept(ice.center) == [None] * 3
    assert kept(scene.gravity) == [0.0, 0.0, None] and kept(wall.axis) == [0.0, 0.0, 1.0]
    assert kept(box.rotation) == [None, 0.0, None, 0.0] and kept(box.half_size) == [None] * 3
    assert scene.air.drag == 0.0 and kept(scene.air.wind) == [None, 0.0, 0.0]
    ball = (scene.ball.radius, scene.ball.mass, scene.ball.inertia_ratio)  # 1 is no structure here
    assert all(isinstance(x, jax.Array) for x in (*ball, scene.air.density, wall.radius, ice.radius))


def test_an_elastic_floor_stays_elastic():
    """It bounces for ever and is never rolled on; nor does a program hold the end of bounces that cannot end."""

    def room(e):
        return Scene(Ball(0.025, 0.046), {"floor": Plane((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), Smooth(e))})

    def lines(scene):
        program = jax.jit(lambda x: simulate(scene, x, t1=3.0, throw=False).final).lower(drop)
        return program.as_text().count("\n")

    drop = BallState([0.0, 0.0, 0.1], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0])
    assert lines(traced(room(1.0))) < 0.7 * lines(traced(room(0.9)))
    bounced, exact = (simulate(scene, drop, t1=3.0) for scene in (traced(room(1.0)), room(1.0)))
    assert int(bounced.n_impacts) == int(exact.n_impacts) > 10
    np.testing.assert_allclose(bounced.final.position, exact.final.position, rtol=1e-12)


@pytest.mark.parametrize("path", SCENES, ids=[path.stem for path in SCENES])
def test_a_scene_file_picks_the_same_motion(path):
    file = load_scene(path)
    known, _ = checked(file.scene, None, 8, None, slides=True)
    COMPILED.clear()
    assert type(checked(traced(file.scene), None, 8, None, slides=True)[0]) is type(known)
    assert not COMPILED


def test_a_slope_of_traced_numbers_is_still_seen():
    slope = Plane((0.0, 0.0, 0.0), (0.0, 0.6, 0.8), Frictional(0.5, 0.2, 0.3))
    scene = Scene(Ball(0.025, 0.046), {"slope": slope})
    assert type(checked(traced(scene), None, 8, None, slides=True)[0]) is Integrated
    flat = Scene(Ball(0.025, 0.046), {"flat": Plane((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), Frictional(0.5, 0.2, 0.3))})
    assert type(checked(traced(flat), None, 8, None, slides=True)[0]) is Exact


def test_in_single_precision():
    scene = traced(room(), jnp.float32)
    assert {x.dtype for x in jax.tree.leaves(scene) if isinstance(x, jax.Array)} == {np.dtype(np.float32)}
    throw = jax.tree.map(lambda x: x.astype(jnp.float32), BallState([-0.3, 0, 0.9], [2, 0, -5], [0, 15, 0]))
    np.testing.assert_allclose(
        simulate(scene, throw, t1=0.4).final.position, simulate(room(), throw, t1=0.4).final.position, rtol=1e-4
    )
