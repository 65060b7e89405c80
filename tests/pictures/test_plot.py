"""Pictures: what is drawn is what happened."""

import subprocess
import sys

import numpy as np
import pytest

from nonholo_jax import (
    Air,
    Ball,
    BallState,
    Box,
    Cylinder,
    Hole,
    Implicit,
    Integrated,
    Plane,
    Rectangle,
    Rough,
    Scene,
    Smooth,
    Sphere,
    simulate,
)
from nonholo_jax._pictures.outline import View, axis_name, shapes
from nonholo_jax.plot import plot_trajectory

GRIP = Rough(0.85, 0.4)
FLOOR = Plane((0, 0, 0), (0, 0, 1), GRIP)


def _table():
    law = Rough()
    surfaces = {"floor": Plane((0, 0, 0), (0, 0, 1), law), "table": Box((0.6, 0, 0.715), (0.6, 0.4, 0.015), law)}
    throw = BallState([-0.3, 0.0, 0.9], [2.0, 0.0, -5.0], [0.0, 15.384615384615385, 0.0])
    return Scene(Ball(0.025, 0.046), surfaces), throw, {"t1": 0.6, "max_impacts": 16}


def _solid():
    surfaces = {
        "floor": FLOOR,
        "globe": Sphere((1.2, 0, 0.2), 0.35, GRIP),
        "step": Box((2.2, 0, 0.2), (0.3, 1, 0.2), GRIP),
    }
    return Scene(Ball(0.06, 0.2), surfaces), BallState([-0.5, 0, 1.4], [1.9, 0, 0.5], [0, 0, 0]), {"t1": 1.4}


def _spatial():
    surfaces = {
        "floor": FLOOR,
        "wall": Plane((0, 1, 0), (0, -1, 0), GRIP),
        "post": Cylinder((3, 0.6, 0), (0, 0, 1), 0.1, GRIP),
    }
    return Scene(Ball(0.05, 0.1), surfaces), BallState([0, -0.8, 1.2], [2.0, 2.5, 0.0], [10, 20, 30]), {"t1": 1.2}


def _corridor():
    walls = {"left": Plane((0, 0, 0), (1, 0, 0), Rough()), "right": Plane((1, 0, 0), (-1, 0, 0), Rough())}
    scene = Scene(Ball(0.05, 0.1), walls, gravity=(0, 0, 0))
    return scene, BallState([0.5, 0, 0], [2.0, 0, 0.8], [0, 12, 0]), {"t1": 4.0, "max_impacts": 16}


def _air():
    scene = Scene(Ball(0.025, 0.046), {"floor": FLOOR}, air=Air())
    return scene, BallState([0, 0, 1], [1, 0, 0], [0, 40, 0]), {"t1": 0.6, "motion": Integrated()}


def _sideways():
    surfaces = {
        "floor": Plane((0, 0, 0), (1, 0, 0), GRIP),
        "shelf": Rectangle((0.5, 1.2, 0), (1, 0.3, 0), (0, 1, 0), (0.3, 0.3), GRIP),
    }
    return (
        Scene(Ball(0.05, 0.1), surfaces, gravity=(-9.81, 0, 0)),
        BallState([1, 0, 0], [0, 1, 0], [0, 0, 3]),
        {"t1": 1.2},
    )


def _bowl():
    scene = Scene(Ball(0.05, 0.1), {"bowl": Sphere((0, 0, 1), 1.0, Smooth(0.95), inside=True)})
    return scene, BallState([0.5, 0, 1.2], [0, 0, 0], [0, 0, 0]), {"t1": 1.0}


def _free():
    return Scene(Ball(0.05, 0.1), {"floor": FLOOR}), BallState([0, 0, 2], [1, 0, 1], [0, 0, 0]), {"t1": 0.5}


def _upright():
    return Scene(Ball(0.05, 0.1), {"floor": FLOOR}), BallState([0, 0, 1], [0, 0, 0], [0, 0, 5]), {"t1": 0.7}


ALL = {f.__name__[1:]: f for f in (_table, _solid, _spatial, _corridor, _air, _sideways, _bowl, _free, _upright)}
_known: dict = {}


def _drawn(name, **options):
    """Simulated once, and drawn once where no option asks for another picture."""
    if name not in _known:
        scene, throw, how = ALL[name]()
        trajectory = simulate(scene, throw, **how)
        _known[name] = scene, trajectory, plot_trajectory(scene, trajectory, hand=throw.position)
    scene, trajectory, figure = _known[name]
    return scene, trajectory, plot_trajectory(scene, trajectory, **options) if options else figure


def _side(figure):
    return figure.axes[0]


@pytest.mark.parametrize("name", ALL)
def test_a_picture_is_written_and_shows_every_impact(name, tmp_path):
    from PIL import Image

    path = tmp_path / "trajectory.png"
    scene, trajectory, figure = _drawn(name, path=path)  # warnings are errors
    assert 10_000 < path.stat().st_size < 200_000
    with Image.open(path) as picture:
        assert np.allclose(picture.info["dpi"], 150, atol=0.1) and picture.format == "PNG"
    panels = [ax for ax in figure.axes if ax.get_aspect() == 1.0]
    assert len(panels) == (2 if name == "spatial" else 1)
    n = int(trajectory.n_impacts)
    for panel in panels:
        balls = [patch for patch in panel.patches if patch.get_gid() == "ball"]
        assert len(balls) == n
        assert all(ball.get_radius() >= float(scene.ball.radius) for ball in balls)
    numbers = ", ".join(text.get_text() for text in _side(figure).texts if text.get_gid() == "number")
    assert sorted(int(i) for i in numbers.split(", ") if i) == list(range(1, min(n, 9) + 1))


@pytest.mark.parametrize("name", ALL)
def test_labels_keep_clear_of_the_path_and_of_each_other(name):
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    _, trajectory, figure = _drawn(name)
    renderer = FigureCanvasAgg(figure).get_renderer()
    ax = _side(figure)
    boxes = [text.get_window_extent(renderer) for text in ax.texts]
    segments = ax.findobj(lambda artist: artist.get_gid() == "path")[0].get_segments()
    path = ax.transData.transform(np.concatenate([np.linspace(a, b, 20) for a, b in segments]))
    for i, box in enumerate(boxes):
        assert box.count_contains(path) == 0, ax.texts[i].get_text()
        assert not any(box.overlaps(other) for other in boxes[:i])
        assert ax.bbox.containsx(box.x0) and ax.bbox.containsx(box.x1) and ax.bbox.containsy(box.y0)


@pytest.mark.parametrize("name", ["table", "corridor", "sideways", "spatial"])
def test_spin_arrows_turn_with_the_ball(name):
    """A point of the skin, rotated by Rodrigues' formula and projected, moves the way the arrow points."""
    scene, trajectory, figure = _drawn(name)
    ax, axes = _side(figure), {"x (m)": 0, "y (m)": 1, "z (m)": 2}
    right = axes[(ax.get_xlabel() or "x (m)")]
    up = axes[ax.get_ylabel()]
    seen = 0
    for i in range(min(int(trajectory.n_impacts), 9)):
        spin = np.asarray(trajectory.impacts.after.spin[i])
        lines = [line for line in ax.lines if line.get_gid() == f"spin-{i + 1}"]
        for line in lines:
            center = np.asarray(trajectory.impacts.after.position[i])[[right, up]]
            arms = np.stack(line.get_data(), axis=1) - center
            drawn = np.unwrap(np.arctan2(arms[:, 1], arms[:, 0]))
            angle = 1e-4
            axis = spin / np.linalg.norm(spin)
            cross = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
            rotation = np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
            skin = np.eye(3)[right]
            moved = rotation @ skin
            assert np.sign(drawn[-1] - drawn[0]) == np.sign(moved[up])
            seen += 1
    assert seen >= 2


def test_a_positive_spin_about_y_turns_x_down():
    _, trajectory, figure = _drawn("table")
    assert float(trajectory.impacts.after.spin[0, 1]) > 100  # clockwise with x to the right and z up
    (line,) = [line for line in _side(figure).lines if line.get_gid() == "spin-1"]
    x, z = line.get_data()
    around = np.unwrap(np.arctan2(z - float(trajectory.impacts.after.position[0, 2]), x - x.mean()))
    assert around[-1] < around[0]


def test_length_of_spin_arrows_is_proportional_to_the_spin():
    _, trajectory, figure = _drawn("corridor")
    spins, turns = [], []
    for i in range(9):
        spin = float(trajectory.impacts.after.spin[i, 1])
        lines = [line for line in _side(figure).lines if line.get_gid() == f"spin-{i + 1}"]
        heads = [patch for patch in _side(figure).patches if patch.get_gid() == "spin-head"]
        if abs(spin) < 5:
            continue
        center = np.asarray(trajectory.impacts.after.position[i])[[0, 2]]
        arms = np.stack(lines[0].get_data(), axis=1) - center
        radius = np.linalg.norm(arms[0])
        tips = [head.get_xy()[1] - center for head in heads]
        end = min(
            (tip for tip in tips), key=lambda tip: abs(np.linalg.norm(tip) - radius) + np.linalg.norm(tip - arms[-1])
        )
        angle = np.unwrap(np.arctan2(*np.vstack([arms, end]).T[::-1]))
        spins.append(spin)
        turns.append(angle[-1] - angle[0])
    assert len(spins) > 5
    assert np.allclose(np.array(turns) / np.array(spins), turns[0] / spins[0], rtol=1e-6)


@pytest.mark.parametrize("name", ALL)
def test_energy_and_spin_are_those_of_the_motion(name):
    scene, trajectory, figure = _drawn(name)
    ball, gravity = scene.ball, np.asarray(scene.gravity)
    (line,) = [line for line in figure.findobj(lambda a: a.get_gid() == "energy-total")]
    times, total = line.get_data()
    between = ~np.isin(times, np.asarray(trajectory.impacts.time)) & (times <= float(trajectory.t1))
    state = trajectory.at(times[between])
    v, w, x = (np.asarray(a) for a in (state.velocity, state.spin, state.position))
    inertia = ball.inertia_ratio * ball.mass * ball.radius**2
    expected = 0.5 * ball.mass * (v * v).sum(1) + 0.5 * inertia * (w * w).sum(1) - ball.mass * x @ gravity
    np.testing.assert_allclose(total[between], expected, rtol=1e-9, atol=1e-12)
    for i, axis in enumerate("xyz"):
        lines = figure.findobj(lambda a, axis=axis: a.get_gid() == f"spin-{axis}")
        assert bool(lines) == bool(np.abs(w[:, i]).max() > 1e-9 * max(np.abs(w).max(), 1e-9))
        if lines:
            np.testing.assert_allclose(lines[0].get_ydata()[between], w[:, i], atol=1e-9)


def test_total_energy_jumps_exactly_at_lossy_impacts():
    _, trajectory, figure = _drawn("solid")
    (line,) = figure.findobj(lambda a: a.get_gid() == "energy-total")
    times, total = line.get_data()
    drops = np.flatnonzero(np.diff(total) < -1e-6)
    np.testing.assert_array_equal(times[drops], times[drops + 1])
    np.testing.assert_array_equal(times[drops], np.asarray(trajectory.impacts.time)[: int(trajectory.n_impacts)])


def test_the_path_has_a_sharp_kink_at_every_impact():
    _, trajectory, figure = _drawn("table")
    (path,) = _side(figure).findobj(lambda a: a.get_gid() == "path")
    points = np.concatenate(path.get_segments())
    for i in range(int(trajectory.n_impacts)):
        center = np.asarray(trajectory.impacts.after.position[i])[[0, 2]]
        assert np.linalg.norm(points - center, axis=1).min() < 1e-12


def test_hand_and_target_are_marked_where_they_are():
    scene, trajectory, _ = _drawn("table")
    figure = plot_trajectory(scene, trajectory, hand=(-0.3, 0.0, 0.9), target=(0.4, 0.0, 0.5))
    stars = {line.get_gid(): line.get_xydata()[0] for line in _side(figure).lines if line.get_marker() == "*"}
    assert set(stars) == {"hand", "target"} and np.allclose(stars["target"] - stars["hand"], [0.7, -0.4])
    assert {"hand", "target"} <= {text.get_text() for text in _side(figure).texts}


def test_until_ends_the_picture():
    _, trajectory, figure = _drawn("table", until=0.3)
    (line,) = figure.findobj(lambda a: a.get_gid() == "energy-total")
    assert line.get_xdata()[-1] == pytest.approx(0.3)
    assert len([patch for patch in _side(figure).patches if patch.get_gid() == "ball"]) == 2


def test_a_motion_that_ended_early_says_so():
    scene = Scene(Ball(0.05, 0.1), {"floor": Plane((0, 0, 0), (0, 0, 1), Rough(0.5))})
    for name, speed, sum_trains in (("at_rest", 0, True), ("sustained_contact", 1, False)):
        options = {"sum_trains": sum_trains, "max_impacts": 200, "throw": False}
        trajectory = simulate(scene, BallState([0, 0, 1], [speed, 0, 0], [0, 0, 0]), t1=5.0, **options)
        assert name in plot_trajectory(scene, trajectory).get_suptitle()
        assert name not in plot_trajectory(scene, trajectory, until=0.5).get_suptitle()
    _, _, figure = _drawn("table", title="Under the table")
    assert figure.get_suptitle() == "Under the table"


def test_a_hundred_impacts(tmp_path):
    walls = {"floor": Plane((0, 0, 0), (0, 0, 1), Rough()), "west": Plane((0, 0, 0), (1, 0, 0), Rough()),
             "east": Plane((2, 0, 0), (-1, 0, 0), Rough())}  # fmt: skip
    scene = Scene(Ball(0.025, 0.046), walls)
    trajectory = simulate(scene, BallState([0.5, 0, 0.4], [1.1, 0, 0], [0, 12, 0]), t1=100.0, max_impacts=100)
    figure = plot_trajectory(scene, trajectory, path=tmp_path / "many.png")
    assert (tmp_path / "many.png").stat().st_size < 200_000
    assert len([patch for patch in _side(figure).patches if patch.get_gid() == "ball"]) == 100
    assert "max_impacts" in figure.get_suptitle()
    numbers = ", ".join(text.get_text() for text in _side(figure).texts if text.get_gid() == "number")
    assert {int(i) for i in numbers.replace("\N{EN DASH}", ", ").split(", ")} <= set(range(1, 10))


def test_a_ball_too_small_to_see_is_enlarged_and_the_caption_says_so():
    scene = Scene(Ball(0.001, 0.001), {"floor": FLOOR})
    trajectory = simulate(scene, BallState([0, 0, 1], [1, 0, 0], [0, 0, 0]), t1=0.6)
    figure = plot_trajectory(scene, trajectory)
    (ball,) = [patch for patch in _side(figure).patches if patch.get_gid() == "ball"]
    caption = figure.findobj(lambda a: a.get_gid() == "caption")[0].get_text().replace("\n", " ")
    assert f"Ball drawn {ball.get_radius() / 0.001:.3g} times its size" in caption
    _, _, figure = _drawn("table")
    assert "times its size" not in figure.findobj(lambda a: a.get_gid() == "caption")[0].get_text()


def test_a_short_log_ends_the_picture_and_a_batch_is_refused():
    scene, throw, how = _table()
    trajectory = simulate(scene, throw, **how, log_size=1)
    figure = plot_trajectory(scene, trajectory)
    assert len([patch for patch in _side(figure).patches if patch.get_gid() == "ball"]) == 1
    import jax

    batch = jax.tree.map(lambda x: x[None] if hasattr(x, "shape") else x, trajectory)
    with pytest.raises(ValueError, match="must be one motion"):
        plot_trajectory(scene, batch)


def test_outlines_lie_where_the_gap_vanishes():
    """Every surface's outline in the plane of motion, drawn by its own rule, against its distance."""
    import jax.numpy as jnp

    x, z = np.array([1.0, 0, 0]), np.array([0, 0, 1.0])
    view = View(x, z, np.cross(x, z), 0.0, True)
    wave = Implicit(lambda p, t: p[2] - 0.1 * jnp.sin(3 * p[0]) - 0.05, GRIP, curvature=0.9)
    cases = [
        Plane((0.1, 0.2, 0.3), (0.4, 0.1, 1.0), GRIP),
        Box((0, 0.1, 0), (0.5, 0.4, 0.3), GRIP, rotation=(0.9, 0.1, 0.3, 0.2)),
        Rectangle((0, 0, 0), (0.2, 0.3, 1), (1, 0, 0), (0.5, 0.4), GRIP),
        Sphere((0.1, 0.2, 0.1), 0.6, GRIP, inside=True),
        Cylinder((0.1, 0.2, 0), (0.2, 1, 0.3), 0.3, GRIP),
        Cylinder((0.1, 0.2, 0), (1, 0, 0.3), 0.3, GRIP, inside=True),
        Hole((0.1, 0.2, 0), (0.2, 0, 1), 0.5, GRIP),
        Hole((0.1, 0.7, 0), (0.2, 0, 1), 0.5, GRIP),
        wave,
    ]
    for surface in cases:
        found = shapes(surface, view, np.zeros(2), 1.5, 0.05)
        assert found
        for shape in found:
            room = shape.points[:, :1] * x + shape.points[:, 1:] * z
            if isinstance(surface, Implicit):  # its gap is that of the centre, a radius away along the normal
                room = room - 0.05 * shape.inward @ np.stack([x, z])
            gaps = [float(surface.gap(jnp.asarray(p))) for p in room[:: max(len(room) // 12, 1)]]
            np.testing.assert_allclose(gaps, 0, atol=1e-4 if surface is wave else 1e-9)
            if shape.inward is not None:
                beyond = room[0] + 0.01 * shape.inward[0] @ np.stack([x, z])
                assert float(surface.gap(jnp.asarray(beyond))) < 0


def test_axes_are_named_after_the_room():
    assert axis_name(np.array([0, 0, 1.0])) == "z"
    assert axis_name(np.array([-1.0, 0, 0])) == "\N{MINUS SIGN}x"
    assert axis_name(np.array([0.6, -0.8, 0])) == "(0.60, \N{MINUS SIGN}0.80, 0)"


def test_no_global_state_is_touched(tmp_path):
    """In a fresh process, where `pyplot` cannot be imported at all."""
    code = f"""
import sys
sys.modules["matplotlib.pyplot"] = None
from nonholo_jax import Ball, BallState, Plane, Rough, Scene, simulate
import nonholo_jax.plot
assert "matplotlib" not in sys.modules, "matplotlib is loaded only when a picture is drawn"
import matplotlib
settings = lambda: {{key: matplotlib.rcParams[key] for key in matplotlib.rcParams if key != "backend"}}
before = settings()
scene = Scene(Ball(0.05, 0.1), {{"floor": Plane((0, 0, 0), (0, 0, 1), Rough(0.8))}})
trajectory = simulate(scene, BallState([0, 0, 0.2], [1, 0, 0], [0, 5, 0]), t1=0.4)
nonholo_jax.plot.plot_trajectory(scene, trajectory, path={str(tmp_path / "p.png")!r})
assert settings() == before
"""
    done = subprocess.run([sys.executable, "-W", "error", "-c", code], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
