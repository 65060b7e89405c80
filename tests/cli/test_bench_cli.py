"""`nonholo bench`: one answer, one clear line for what is wrong, with a scene file and without."""

import json
from pathlib import Path

import jax
import numpy as np
import pytest

from nonholo_jax import _questions, simulate_batch
from nonholo_jax._cli.bench_verb import draws
from nonholo_jax._questions.bench import scattered
from nonholo_jax.cli import main
from nonholo_jax.scene_file import load_scene

SCENE = """\
schema = 1
[ball]
radius = 0.025
mass = 0.046
[surfaces.floor]
shape = "plane"
point = [0.0, 0.0, 0.0]
normal = [0.0, 0.0, 1.0]
law = { kind = "rough" }
[throw]
position = [0.0, 0.0, 1.0]
velocity = [1.0, 0.0, -2.0]
spin = [0.0, 0.0, 0.0]
[simulate]
t1 = 0.8
max_impacts = 4
"""
VARY = """\
[monte_carlo]
[[monte_carlo.vary]]
names = ["velocity"]
kind = "normal"
std = 0.1
"""
FLOOR = '[[monte_carlo.vary]]\nnames = ["surfaces.floor.law.restitution"]\nkind = "uniform"\nlow = 0.8\nhigh = 0.9\n'
SMALL = ["--most", "1", "--dtypes", "float32", "--jobs", "value", "--devices", "cpu"]


def written(tmp_path, text):
    path = tmp_path / "bounce.toml"
    path.write_text(text)
    return path


def test_bench_prints_one_json_object_and_writes_table_and_picture(tmp_path, capsys):
    scene = written(tmp_path, SCENE)
    assert main(["bench", str(scene), "--json", "--out", str(tmp_path), *SMALL]) == 0
    out, err = capsys.readouterr()
    assert err == "" and out.count("\n") == 1
    answer = json.loads(out, parse_constant=lambda token: pytest.fail(f"{token} is no JSON"))
    assert answer["verb"] == "bench" and list(answer["scenes"]) == ["bounce"]
    (row,) = answer["rows"]
    assert (row["device"], row["dtype"], row["job"], row["throws"]) == ("cpu", "float32", "value", 1)
    file = load_scene(scene)
    states = jax.tree.map(lambda x: x.astype(np.float32), scattered(file.throw, 1, 0))
    assert row["bounces"] == int(simulate_batch(file.scene, states, **file.simulate.arguments).n_impacts.sum()) == 1
    assert json.loads((tmp_path / "bench.json").read_text())["rows"] == answer["rows"]
    assert answer["picture"] == str(tmp_path / "bench.png")
    assert (tmp_path / "bench.png").read_bytes().startswith(b"\x89PNG")


def test_without_a_scene_there_are_three(tmp_path, capsys, monkeypatch):
    from nonholo_jax._questions.bench import built_in

    monkeypatch.chdir(tmp_path)
    scenes = {name: {"t0": 0.0, "t1": 2.0, "max_impacts": 8, "motion": "Exact", "throws": ""} for name in built_in()}
    times = (0.5, 0.2, 3.0, 0.1, 0.1)
    rows = tuple(
        _questions.Rate(name, "cpu", 1, "float64", "value", 10**k, *times, 0.1, 4, 0, None, None, "flat" if k else "")
        for name in scenes for k in (0, 1)
    )  # fmt: skip
    asked = {}
    made = lambda **how: asked.update(how) or _questions.Bench(rows, scenes, "one machine", False)  # noqa: E731
    monkeypatch.setattr(_questions, "bench", made)
    assert main(["bench", "--most", "1e3", "--devices", "cpu,gpu"]) == 0
    out = capsys.readouterr().out
    assert asked["most"] == 1000 and asked["devices"] == ["cpu", "gpu"] and "jobs" not in asked
    assert all(name in out for name in ("floor and ceiling", "under the table: ", "under the table, with air"))
    folder = Path("nonholo-out") / "bench"
    assert {path.name for path in folder.iterdir()} == {"bench.png", "bench.json"} and str(folder) in out


@pytest.mark.parametrize("also, own", [("", False), (FLOOR, True)])
def test_throws_are_those_of_the_monte_carlo_table(tmp_path, also, own):
    file = load_scene(written(tmp_path, SCENE + VARY + also))
    many, few = draws(file, 1)(2000), draws(file, 1)(3)
    for one, other in zip(jax.tree.leaves(many), jax.tree.leaves(few), strict=True):
        assert (one[:3] == other[:3]).all() if np.ndim(one) else one == other
    throws = many[1] if own else many
    assert np.std(throws.velocity, axis=0) == pytest.approx(np.full(3, 0.1), rel=0.1)
    assert (throws.spin == 0.0).all() and throws.position.shape == (2000, 3)
    if own:
        restitution = many[0].surfaces[0].law.restitution
        assert restitution.shape == (2000,) and 0.8 <= restitution.min() < restitution.max() <= 0.9


BAD = [("--most", "0"), ("--most", "many"), ("--most", "1.5"), ("--most", "inf"), ("--seed", "-1"),
       ("--devices", "abacus"), ("--devices", "cpu,cpu"), ("--devices", ""), ("--dtypes", "float16"),
       ("--jobs", "hessian")]  # fmt: skip


@pytest.mark.parametrize("option, value", BAD)
@pytest.mark.parametrize("with_scene", [True, False])
def test_bad_options_are_one_line(tmp_path, capsys, option, value, with_scene):
    scene = [str(written(tmp_path, SCENE))] if with_scene else []
    assert main(["bench", *scene, "--out", str(tmp_path), option, value]) == 2
    out, err = capsys.readouterr()
    assert out == "" and err.count("\n") == 1 and err.startswith("nonholo: ") and "Traceback" not in err
    assert option.removeprefix("--") in err and ";" in err and "None" not in err
    assert value.split(",")[0] in err


def test_a_scene_without_simulate_says_so(tmp_path, capsys):
    scene = written(tmp_path, SCENE[: SCENE.index("[simulate]")])
    assert main(["bench", str(scene), "--out", str(tmp_path)]) == 2
    assert "add [simulate]" in capsys.readouterr().err
