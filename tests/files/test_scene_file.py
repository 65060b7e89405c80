"""Scene files: what is written is read back, bit for bit, for every shape, law, goal and motion."""

from pathlib import Path

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import pytest

from nonholo_jax import (
    Air,
    Ball,
    BallState,
    Box,
    Cylinder,
    Exact,
    Frictional,
    HitTarget,
    Hole,
    Implicit,
    Integrated,
    Land,
    Plane,
    Rectangle,
    ReturnTo,
    Rough,
    Scene,
    Smooth,
    Sphere,
    simulate,
)
from nonholo_jax.scene_file import DesignTask, SceneError, SceneFile, SimulateTask, load_scene, save_scene

LAWS = {
    "the paper's law": Rough(0.7),
    "two coefficients": Rough(0.9, 0.5),
    "smooth": Smooth(0.8),
    "frictional": Frictional(0.75, 0.1, 0.6),
}
SURFACES = {
    "plane": Plane((0.1, 0.2, 0.3), (0.0, 1.0, 3.0), Rough()),
    "rectangle": Rectangle((0.0, 0.0, 1.0), (0.0, 0.0, 2.0), (1.0, 1.0, 0.0), (0.5, 0.2), Rough()),
    "box": Box((0.6, 0.0, 0.715), (0.6, 0.4, 0.015), Rough()),
    "turned box": Box((0.6, 0.0, 0.715), (0.6, 0.4, 0.015), Rough(), rotation=(0.9, 0.1, 0.0, 0.2)),
    "sphere": Sphere((0.0, 0.0, 1.0), 1.0, Rough()),
    "sphere from inside": Sphere((5.0, 5.0, 5.0), 3.0, Rough(), inside=True),
    "cylinder": Cylinder((1.0, 0.0, 0.0), (0.0, 1.0, 1.0), 0.1, Rough()),
    "hole": Hole((1.0, 0.0, 0.0), (0.0, 1.0, 3.0), 0.1, Rough()),
    "cylinder from inside": Cylinder((5.0, 5.0, 0.0), (0.0, 0.0, 1.0), 3.0, Rough(), inside=True),
}
GOALS = {
    "return_to": ReturnTo([0.1, 0.2, 0.3]),
    "hit_target": HitTarget([0.1, 0.2, 0.3]),
    "land": Land([0.1, 0.2, 0.3]),
    "land on": Land([0.1, 0.2, 0.3], surface="wall"),
}
MOTIONS = {
    "chosen": None,
    "exact": Exact(),
    "integrated": Integrated(),
    "integrated otherwise": Integrated(solver=diffrax.Dopri5(), rtol=1e-6, atol=1e-9, dt0=1e-3, max_steps=99),
}
THROW = BallState([5.0, 5.0, 4.1], [0.1, -2.0, 1e-30], [3.0, 1 / 3, -4e20])


def _scene(surface=SURFACES["plane"], air=None):
    return Scene(Ball(0.025, 0.046, 2 / 3), {"wall": surface}, (0.1, 0.2, -9.81), air)


def _read_back(file, folder):
    save_scene(file, folder / "scene.toml")
    return load_scene(folder / "scene.toml")


def _assert_equal(a, b):
    assert jax.tree.structure(a) == jax.tree.structure(b)
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        assert x == y if isinstance(x, str) else jnp.array_equal(x, y)


@pytest.mark.parametrize("name", SURFACES)
def test_surface_is_read_back(name, tmp_path):
    file = SceneFile(_scene(SURFACES[name]), THROW)
    _assert_equal(_read_back(file, tmp_path), file)


@pytest.mark.parametrize("name", LAWS)
def test_law_is_read_back(name, tmp_path):
    file = SceneFile(_scene(eqx.tree_at(lambda s: s.law, SURFACES["plane"], LAWS[name])), THROW)
    _assert_equal(_read_back(file, tmp_path), file)


@pytest.mark.parametrize("name", GOALS)
def test_goal_is_read_back(name, tmp_path):
    simulation = SimulateTask(2.0, 0.5, 7)
    task = DesignTask(("spin.y", "ball.radius"), GOALS[name], ("wall", "wall"), {"spin.y": (-1.0, float("inf"))}, 3, 4)
    file = SceneFile(_scene(), THROW, simulation, task)
    back = _read_back(file, tmp_path)
    _assert_equal(back, file)
    assert type(back.design.goal) is type(GOALS[name])
    assert back.design.free == task.free and back.design.itinerary == task.itinerary


@pytest.mark.parametrize("name", MOTIONS)
def test_motion_is_read_back(name, tmp_path):
    file = SceneFile(_scene(), THROW, SimulateTask(2.0, motion=MOTIONS[name]))
    back = _read_back(file, tmp_path).simulate
    assert back == file.simulate


def test_air_and_orientation_are_read_back(tmp_path):
    throw = BallState(THROW.position, THROW.velocity, THROW.spin, [0.5, -0.5, 0.5, 0.5])
    file = SceneFile(_scene(air=Air(1.3, 0.4, 0.9, (1.0, 2.0, 3.0))), throw)
    _assert_equal(_read_back(file, tmp_path), file)


def test_traced_numbers_of_a_scene_are_written_as_they_are(tmp_path):
    scene = eqx.tree_at(lambda s: s.ball.radius, _scene(), jnp.asarray(0.1, dtype=jnp.float32))
    assert _read_back(SceneFile(scene, THROW), tmp_path).scene.ball.radius == 0.1


def test_orientation_of_any_length_is_made_a_unit_quaternion(tmp_path):
    throw = eqx.tree_at(lambda s: s.orientation, THROW, jnp.asarray([0.0, 3.0, 0.0, 4.0]), is_leaf=lambda x: x is None)
    back = _read_back(SceneFile(_scene(), throw), tmp_path)
    assert back.throw.orientation.tolist() == [0.0, 0.6, 0.0, 0.8]


SHORT = """\
schema = 1
ball = { radius = 1, mass = 2 }
air = {}
surfaces.roof = { shape = "plane", point = [0, 0, 9], normal = [0, 0, -1], law.kind = "rough" }
throw = { position = [0, 0, 0], velocity = [0, 0, 0], spin = [0, 0, 0] }
simulate.t1 = 1
design = { free = ["spin"], goal = { kind = "land", point = [0, 0, 0] } }
"""


def test_fields_that_are_left_out_have_the_defaults_of_the_classes(tmp_path):
    path = tmp_path / "scene.toml"
    path.write_text(SHORT)
    file = load_scene(path)
    _assert_equal(file.scene, Scene(Ball(1, 2), {"roof": Plane((0, 0, 9), (0, 0, -1), Rough())}, air=Air()))
    assert file.simulate == SimulateTask(1.0)
    _assert_equal(file.design, DesignTask(("spin",), Land([0.0, 0.0, 0.0])))


def test_a_file_runs(tmp_path):
    file = _read_back(SceneFile(_scene(), THROW, SimulateTask(0.01, max_impacts=1)), tmp_path)
    assert simulate(file.scene, file.throw, **file.simulate.arguments).t1 == 0.01


def test_design_arguments_are_those_of_the_function():
    arguments = DesignTask(("spin",), GOALS["land"], seed=3).arguments
    assert set(arguments) == {"free", "goal", "itinerary", "bounds", "n_starts", "key"}
    assert jnp.array_equal(jax.random.key_data(arguments["key"]), jax.random.key_data(jax.random.key(3)))


def test_surface_names_keep_their_order_and_may_be_of_any_letters(tmp_path):
    names = ("zuunmod", "a-b_1", "дэлгүүр")
    scene = Scene(Ball(0.025, 0.046), {name: SURFACES["plane"] for name in names})
    assert _read_back(SceneFile(scene, THROW), tmp_path).scene.names == names


def test_ball_may_touch_a_surface_to_rounding(tmp_path):
    floor = {"wall": Plane((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), Rough())}
    for depth, is_refused in ((0.0, False), (1e-16, False), (1e-12, True)):
        throw = BallState([0.0, 0.0, 0.025 - depth], [0.0, 0.0, -1.0], [0.0, 0.0, 0.0])
        file = SceneFile(Scene(Ball(0.025, 0.046), floor), throw)
        if is_refused:
            with pytest.raises(SceneError, match="`throw.position` must leave the ball outside of surface 'wall'"):
                _read_back(file, tmp_path)
        else:
            _read_back(file, tmp_path)


CONTROLLED = Integrated(stepsize_controller=diffrax.PIDController(1e-3, 1e-3))
FALLING = BallState([0.0, float("nan"), 0.0], THROW.velocity, THROW.spin)
REFUSED = {
    "implicit surface": (
        SceneFile(_scene(Implicit(lambda x, t: x[2], Rough())), THROW),
        "`surfaces.wall` .* but got Implicit",
    ),
    "goal that is a function": (
        SceneFile(_scene(), THROW, SimulateTask(1.0), DesignTask(("spin",), lambda trajectory: trajectory.t1)),
        "`design.goal` .* but got function",
    ),
    "step size controller": (
        SceneFile(_scene(), THROW, SimulateTask(1.0, motion=CONTROLLED)),
        "`simulate.motion` .* without a controller",
    ),
    "NaN": (SceneFile(_scene(), FALLING), "`throw.position.y` .* nan"),
    "batch of throws": (SceneFile(_scene(), jax.tree.map(lambda x: jnp.ones((2, 3)), THROW)), "`throw.position.x`"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_cannot_be_in_a_file_is_refused_and_nothing_is_written(name, tmp_path):
    file, message = REFUSED[name]
    with pytest.raises(SceneError, match=message) as caught:
        save_scene(file, tmp_path / "scene.toml")
    assert "\n" not in str(caught.value)
    assert not list(tmp_path.iterdir())


SCENES = sorted((Path(__file__).parents[2] / "experiments" / "scenes").glob("*.toml"))


@pytest.mark.parametrize("path", SCENES, ids=lambda path: path.stem)
def test_scenes_of_the_repository_load_and_are_read_back(path, tmp_path):
    file = load_scene(path)
    _assert_equal(_read_back(file, tmp_path), file)


def test_garwins_throw_is_that_of_the_design_document():
    file = load_scene(Path(__file__).parents[2] / "experiments" / "scenes" / "under_the_table.toml")
    assert file.scene.names == ("floor", "table")
    assert file.throw.velocity.tolist() == [2.0, 0.0, -5.0]
    assert file.simulate == SimulateTask(2.0, 0.0, 16)
    assert file.design.free == ("spin.y",) and file.design.itinerary == ("floor", "table", "floor")
    assert file.design.bounds == {"spin.y": (-400.0, 400.0)}


@pytest.mark.parametrize("shape, words", [("hole", "in a hole"), ("cylinder", "where inside = true")])
def test_a_ball_must_fit_into_what_is_hollow(shape, words, tmp_path):
    place = "center = [0, 0, 0], normal = [0, 0, 1]" if shape == "hole" else "point = [0, 0, 0], axis = [0, 0, 1]"
    inside = "" if shape == "hole" else ", inside = true"
    roof = next(line for line in SHORT.splitlines() if line.startswith("surfaces"))
    path = tmp_path / "scene.toml"
    wall = f'surfaces.wall = {{ shape = "{shape}", {place}, radius = 0.9{inside}, law.kind = "rough" }}'
    path.write_text(SHORT.replace(roof, wall))
    with pytest.raises(SceneError, match=f"`surfaces.wall.radius` must be larger than .* 1.0 {words}, but got 0.9"):
        load_scene(path)
