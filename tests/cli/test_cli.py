"""The command line: every kind of bad input is one clear line and exit code 2, and answers are machine-readable."""

import json
import math
import os
import re
import subprocess
import sys
from pathlib import Path

import jax
import pytest

from nonholo_jax import KINDS, _questions
from nonholo_jax._cli.report import _LABELS
from nonholo_jax.cli import main

BASE = """\
schema = 1
gravity = [0.0, 0.0, -9.81]
[ball]
radius = 0.025
mass = 0.046
inertia_ratio = 0.4
[air]
density = 1.2
[surfaces.floor]
shape = "plane"
point = [0.0, 0.0, 0.0]
normal = [0.0, 0.0, 1.0]
law = { kind = "rough", restitution = 0.9, tangential = 0.5 }
[surfaces.table]
shape = "box"
center = [0.6, 0.0, 0.715]
half_size = [0.6, 0.4, 0.015]
law = { kind = "frictional", restitution = 0.9, tangential = 0.5, friction = 0.6 }
[surfaces.shelf]
shape = "rectangle"
center = [0.0, 0.0, 3.0]
normal = [0.0, 0.0, 1.0]
tangent = [1.0, 0.0, 0.0]
half_size = [0.5, 0.2]
law = { kind = "smooth" }
[surfaces.room]
shape = "sphere"
center = [0.0, 0.0, 0.0]
radius = 9.0
inside = true
law = { kind = "smooth" }
[throw]
position = [-0.3, 0.0, 0.9]
velocity = [2.0, 0.0, -5.0]
spin = [0.0, 0.0, 0.0]
[simulate]
t1 = 2.0
max_impacts = 16
motion = "integrated"
rtol = 1e-8
[design]
free = ["spin.y"]
goal = { kind = "return_to", point = [-0.3, 0.0, 0.9] }
itinerary = ["floor", "table", "floor"]
[design.bounds]
"spin.y" = [-400.0, 400.0]
"""

# name: what is replaced, by what, and words that the line must hold: field, value, remedy
MALFORMED = {
    "unknown top field": ("gravity =", "gravitty =", "`gravitty`", "-9.81", "did you mean 'gravity'"),
    "unknown top table": ("[air]", "[airr]", "`airr`", "a table", "did you mean 'air'"),
    "unknown ball field": ("radius = 0.025", "radus = 0.025", "`ball.radus`", "0.025", "did you mean 'radius'"),
    "unknown surface field": ('"plane"', '"plane"\nnormall = 1', "`surfaces.floor.normall`", "1", "'normal'"),
    "field of another shape": ("center = [0.6", "point = [0.6", "`surfaces.table.point`", "0.715",
        "center, half_size"),
    "unknown law field": ("friction = 0.6", "frction = 0.6", "`surfaces.table.law.frction`", "0.6", "'friction'"),
    "unknown goal field": ("[-0.3, 0.0, 0.9] }", "[0, 0, 1], x = 1 }", "`design.goal.x`", "1", "remove it"),
    "unknown simulate field": ("t1 = 2.0", "t1 = 2.0\nt_1 = 3.0", "`simulate.t_1`", "3.0", "did you mean 't1'"),
    "unknown shape": ('"box"', '"bocks"', "`surfaces.table.shape`", "'bocks'", "'box'"),
    "implicit shape": ('"box"', '"implicit"', "`surfaces.table.shape`", "'implicit'", "nonholo_jax.Implicit"),
    "unknown law": ('"rough"', '"ruff"', "`surfaces.floor.law.kind`", "'ruff'", "choose one of these"),
    "unknown goal": ('"return_to"', '"return"', "`design.goal.kind`", "'return'", "'return_to'"),
    "unknown motion": ('"integrated"', '"euler"', "`simulate.motion`", "'euler'", 'motion = "integrated"'),
    "unknown solver": ("rtol = 1e-8", 'solver = "Tsit6"', "`simulate.solver`", "'Tsit6'", "'Tsit5'"),
    "implicit solver": ("rtol = 1e-8", 'solver = "Kvaerno5"', "`simulate.solver`", "'Kvaerno5'", "try 'Tsit5'"),
    "fixed-step solver": ("rtol = 1e-8", 'solver = "Euler"', "`simulate.dt0`", "'Euler', but got nothing",
        "add dt0 ="),
    "exact with air": ('motion = "integrated"\nrtol = 1e-8', 'motion = "exact"', "`simulate.motion`", "'exact'",
        "remove the line"),
    "tolerance without motion": ('motion = "integrated"', "", "`simulate.rtol`", "1e-08", "add that line"),
    "missing mass": ("mass = 0.046", "", "`ball.mass`", "nothing", "add mass = 0.046 (kg)"),
    "missing ball": ("[ball]\nradius = 0.025\nmass = 0.046\ninertia_ratio = 0.4", "", "`ball`", "nothing",
        "[ball]"),
    "missing law": ('law = { kind = "smooth" }\n[throw]', "[throw]", "`surfaces.room.law`", "nothing", "add law ="),
    "missing shape": ('shape = "plane"', "", "`surfaces.floor.shape`", "nothing", "'plane'"),
    "missing kind": ('kind = "rough", ', "", "`surfaces.floor.law.kind`", "nothing", "'rough'"),
    "missing friction": (", friction = 0.6", "", "`surfaces.table.law.friction`", "nothing", "friction = 0.6"),
    "missing t1": ("t1 = 2.0", "", "`simulate.t1`", "nothing", "t1 = 2.0 (seconds)"),
    "missing free": ('free = ["spin.y"]', "", "`design.free`", "nothing", 'free = ["spin.y"]'),
    "schema missing": ("schema = 1", "", "`schema`", "nothing", "schema = 1"),
    "schema too new": ("schema = 1", "schema = 2", "`schema`", "2", "update the package"),
    "schema as text": ("schema = 1", 'schema = "1"', "`schema`", "'1'", "write schema = 1"),
    "text for number": ("mass = 0.046", 'mass = "46 g"', "`ball.mass`", "'46 g'", "mass = 0.046 (kg)"),
    "bool for number": ("mass = 0.046", "mass = true", "`ball.mass`", "true", "mass = 0.046 (kg)"),
    "date for number": ("mass = 0.046", "mass = 2024-01-01", "`ball.mass`", "2024-01-01", "mass = 0.046 (kg)"),
    "huge whole number": ("mass = 0.046", f"mass = 1{400 * '0'}", "`ball.mass`", "1000", "mass = 0.046 (kg)"),
    "float for count": ("max_impacts = 16", "max_impacts = 1.5", "`simulate.max_impacts`", "1.5",
        "max_impacts = 16"),
    "endless count": ("max_impacts = 16", "max_impacts = 10000000000", "`simulate.max_impacts`", "10000000000",
        "at most"),
    "number for vector": ("spin = [0.0, 0.0, 0.0]", "spin = 3.0", "`throw.spin`", "3.0", "(rad/s)"),
    "vector of two": ("velocity = [2.0, 0.0, -5.0]", "velocity = [2.0, -5.0]", "`throw.velocity`", "[2.0, -5.0]",
        "m/s"),
    "vector of four": ("gravity = [0.0, ", "gravity = [0.0, 0.0, ", "`gravity`", "-9.81]", "must have 3 entries"),
    "text in vector": ("position = [-0.3", 'position = ["a"', "`throw.position.x`", "'a'", "position ="),
    "table for text": ('free = ["spin.y"]', 'free = "spin.y"', "`design.free`", "'spin.y'", 'free = ["spin.y"]'),
    "number for surface": ("[surfaces.floor]", "[surfaces]\nwall = 3\n[surfaces.floor]", "`surfaces.wall`", "3",
        "[surfaces.floor] with shape"),
    "zero mass": ("mass = 0.046", "mass = 0.0", "`ball.mass`", "0.0", "greater than 0"),
    "negative radius": ("radius = 0.025", "radius = -0.025", "`ball.radius`", "-0.025", "radius = 0.025 (metres)"),
    "zero alpha": ("inertia_ratio = 0.4", "inertia_ratio = 0", "`ball.inertia_ratio`", "0", "a solid sphere"),
    "negative sphere": ("radius = 9.0", "radius = -9.0", "`surfaces.room.radius`", "-9.0", "greater than 0"),
    "room smaller than ball": ("radius = 9.0", "radius = 0.01", "`surfaces.room.radius`", "0.01", "enlarge"),
    "flat box": ("0.4, 0.015]", "0.4, 0.0]", "`surfaces.table.half_size[2]`", "0.0", "greater than 0"),
    "restitution above 1": ("restitution = 0.9, tangential = 0.5 }", "restitution = 1.1 }",
        "`surfaces.floor.law.restitution`", "1.1", "at most 1"),
    "restitution below 0": ("restitution = 0.9, tangential = 0.5 }", "restitution = -0.1 }",
        "`surfaces.floor.law.restitution`", "-0.1", "at least 0"),
    "tangential beyond 1": ("tangential = 0.5 }", "tangential = -1.5 }", "`surfaces.floor.law.tangential`", "-1.5",
        "-1"),
    "negative friction": ("friction = 0.6", "friction = -0.6", "`surfaces.table.law.friction`", "-0.6",
        "at least 0"),
    "negative density": ("density = 1.2", "density = -1.2", "`air.density`", "-1.2", "kg/m^3"),
    "zero normal": ("normal = [0.0, 0.0, 1.0]\nlaw", "normal = [0.0, 0, 0]\nlaw", "`surfaces.floor.normal`",
        "[0.0, 0, 0]", "any length but zero"),
    "tangent along normal": ("tangent = [1.0, 0.0, 0.0]", "tangent = [0.0, 0.0, 2.0]", "`surfaces.shelf.tangent`",
        "2.0", "first side"),
    "zero orientation": ("[simulate]", "orientation = [0.0, 0.0, 0.0, 0.0]\n[simulate]", "`throw.orientation`",
        "0.0", "any length but zero"),
    "NaN": ("velocity = [2.0, ", "velocity = [nan, ", "`throw.velocity.x`", "nan", "finite"),
    "infinity": ("gravity = [0.0, 0.0, -9.81]", "gravity = [0.0, 0.0, -inf]", "`gravity.z`", "-inf", "m/s^2"),
    "NaN bound": ("[-400.0, 400.0]", "[nan, 400.0]", "`design.bounds.'spin.y'`", "nan", "low < high"),
    "ball inside floor": ("position = [-0.3, 0.0, 0.9]", "position = [-0.3, 0.0, 0.02]", "`throw.position`",
        "0.02]", "'floor', but got [-0.3, 0.0, 0.02], which is 0.005 m inside (radius included); move it out"),
    "ball inside table": ("position = [-0.3, 0.0, 0.9]", "position = [0.5, 0.0, 0.71]", "`throw.position`", "0.71]",
        "'table'"),
    "ball outside room": ("position = [-0.3, 0.0, 0.9]", "position = [-20.0, 0.0, 0.9]", "`throw.position`",
        "-20.0", "'room'"),
    "free that is none": ('free = ["spin.y"]', 'free = ["spinn.y"]', "`design.free`", "'spinn.y'", "throw.spin.y"),
    "free twice": ('free = ["spin.y"]', 'free = ["spin", "spin.y"]', "`design.free`", "'spin.y'", "once"),
    "nothing free": ('free = ["spin.y"]', "free = []", "`design.free`", "[]", "at least one name"),
    "itinerary of no surface": ('"floor", "table"', '"floor", "tabel"', "`design.itinerary[1]`", "'tabel'",
        "'table'"),
    "goal on no surface": ('kind = "return_to"', 'kind = "land", surface = "roof"', "`design.goal.surface`",
        "'roof'", "floor, table, shelf, room"),
    "bounds inverted": ("[-400.0, 400.0]", "[400.0, -400.0]", "`design.bounds.'spin.y'`", "[400.0, -400.0]",
        "exchange"),
    "bounds of what is not free": ('"spin.y" = [', '"spin.x" = [', "`design.bounds.'spin.x'`", "'spin.x'",
        "`design.free`"),
    "bounds of nothing": ('"spin.y" = [', '"spam" = [', "`design.bounds`", "'spam'", "try"),
    "no starts": ("[design]", "[design]\nn_starts = 0", "`design.n_starts`", "0", "n_starts = 16"),
    "empty surface name": ("[surfaces.floor]", '[surfaces.""]', "`surfaces`", "''", "rename"),
    "dot in surface name": ("[surfaces.floor]", '[surfaces."a.b"]', "`surfaces`", "'a.b'", "rename"),
    "end before start": ("t1 = 2.0", "t1 = 2.0\nt0 = 3.0", "`simulate.t1`", "2.0", "later than t0 = 3.0"),
    "not TOML": ("mass = 0.046", "mass := 0.046", "TOML", "line 5", "correct it there"),
    "field twice": ("mass = 0.046", "mass = 0.046\nmass = 0.05", "TOML", "line 6", "correct it there"),
}  # fmt: skip


def _refusal(capsys, arguments):
    """The one line of a refusal."""
    code = main(arguments)
    out, err = capsys.readouterr()
    assert code == 2
    assert out == ""
    assert err.startswith("nonholo: ") and err.endswith("\n")
    assert err.count("\n") == 1
    assert "Traceback" not in err
    return err


@pytest.mark.parametrize("name", MALFORMED)
def test_malformed_scene_file_is_one_clear_line(name, tmp_path, capsys):
    old, new, *words = MALFORMED[name]
    assert old in BASE
    scene = tmp_path / "scene.toml"
    scene.write_text(BASE.replace(old, new, 1))
    line = _refusal(capsys, ["design", str(scene), "--no-plot"])
    assert str(scene) in line
    for word in words:
        assert word in line


def test_the_scene_that_the_table_spoils_is_itself_accepted(tmp_path):
    from nonholo_jax.scene_file import load_scene

    scene = tmp_path / "scene.toml"
    scene.write_text(BASE)
    assert load_scene(scene).scene.names == ("floor", "table", "shelf", "room")


COMMANDS = {
    "no verb": ([], "VERB"),
    "unknown verb": (["simulat", "SCENE"], "'simulat'"),
    "no scene": (["simulate"], "SCENE.toml"),
    "unknown option": (["simulate", "SCENE", "--jsn"], "--jsn"),
    "abbreviated option": (["simulate", "SCENE", "--js"], "--js"),
    "option without value": (["simulate", "SCENE", "--out"], "--out"),
    "two scenes": (["simulate", "SCENE", "another.toml"], "another.toml"),
    "no such file": (["simulate", "FOLDER/none.toml"], "none.toml"),
    "folder for file": (["simulate", "FOLDER"], "a directory"),
    "file below a file": (["simulate", "SCENE/none.toml"], "Not a directory"),
    "out is a file": (["simulate", "SCENE", "--out", "SCENE"], "File exists"),
    "out below a file": (["simulate", "SCENE", "--out", "SCENE/out"], "Not a directory"),
    "out with a null byte": (["simulate", "SCENE", "--out", "a\0b"], "--out"),
    "scene with a null byte": (["simulate", "a\0b"], "null"),
    "name on two lines": (["simulate", "no\nfile.toml"], "no\\nfile.toml"),
}


@pytest.mark.parametrize("name", COMMANDS)
def test_malformed_command_line_is_one_clear_line(name, tmp_path, capsys):
    arguments, word = COMMANDS[name]
    scene = tmp_path / "scene.toml"
    scene.write_text(BASE)
    places = [each.replace("SCENE", str(scene)).replace("FOLDER", str(tmp_path)) for each in arguments]
    line = _refusal(capsys, places)
    assert word in line
    assert ";" in line  # what is wrong; what to do


def test_text_that_is_not_utf8_is_named_by_line(tmp_path, capsys):
    scene = tmp_path / "scene.toml"
    scene.write_bytes(BASE.encode().replace(b"[air]", b"# \xff\n[air]"))
    line = _refusal(capsys, ["simulate", str(scene)])
    assert "UTF-8" in line and "0xff in line 7" in line


@pytest.mark.parametrize("table", ["simulate", "design"])
def test_a_verb_without_its_table_says_which(table, tmp_path, capsys):
    start = BASE.index(f"[{table}]")
    stop = BASE.index("[design]") if table == "simulate" else len(BASE)
    scene = tmp_path / "scene.toml"
    scene.write_text(BASE[:start] + BASE[stop:])
    line = _refusal(capsys, ["design", str(scene), "--no-plot"])
    assert f"`{table}`" in line and f"add [{table}]" in line


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() == 0, reason="root may write anywhere")
def test_folder_that_cannot_be_written_is_refused(tmp_path, capsys):
    (tmp_path / "closed").mkdir(mode=0o500)
    scene = tmp_path / "scene.toml"
    scene.write_text(BASE)
    line = _refusal(capsys, ["simulate", str(scene), "--out", str(tmp_path / "closed")])
    assert "Permission denied" in line


BOUNCE = """\
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
[design]
free = ["spin.y"]
goal = { kind = "return_to", point = [0.0, 0.0, 1.0] }
itinerary = ["floor"]
n_starts = 2
"""
FALL = (math.sqrt(2.0**2 + 2 * 9.81 * 0.975) - 2.0) / 9.81


def _json(capsys, arguments, code=0):
    assert main(arguments) == code
    out, err = capsys.readouterr()
    assert out.count("\n") == 1
    return json.loads(out, parse_constant=lambda token: pytest.fail(f"{token} is no JSON")), err


def _vectors(state):
    assert set(state) == {"position", "velocity", "spin"}
    return all(len(vector) == 3 and all(type(x) is float for x in vector) for vector in state.values())


def test_simulate_prints_one_json_object(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("bounce.toml").write_text(BOUNCE)
    answer, err = _json(capsys, ["simulate", "bounce.toml", "--json", "--no-plot"])
    assert err == ""
    assert answer["verb"] == "simulate"
    assert answer["result"] == "reached_t1"
    assert answer["itinerary"] == ["floor"]
    assert _vectors(answer["throw"]) and _vectors(answer["final"])
    (impact,) = answer["impacts"]
    assert impact["surface"] == "floor"
    assert impact["time"] == pytest.approx(FALL, rel=1e-14)
    assert _vectors(impact["before"]) and _vectors(impact["after"])
    assert impact["after"]["velocity"][0] == pytest.approx(3 / 7, rel=1e-14)  # (1 - alpha) / (1 + alpha), Theorem 5.2
    assert answer["energy"]["final"] == pytest.approx(answer["energy"]["initial"], rel=1e-14)
    assert answer["seconds"]["compile"] > 0 and answer["seconds"]["run"] > 0 and answer["seconds"]["import"] >= 0
    assert not Path("nonholo-out").exists()


def test_float32_is_a_choice_that_does_not_outlast_the_command(tmp_path, capsys):
    scene = tmp_path / "bounce.toml"
    scene.write_text(BOUNCE)
    answer, _ = _json(capsys, ["simulate", str(scene), "--json", "--no-plot", "--float32"])
    assert answer["dtype"] == "float32"
    error = abs(answer["impacts"][0]["time"] - FALL)
    assert 1e-12 < error < 1e-6
    assert jax.config.read("jax_enable_x64")


def test_a_throw_beyond_float32_is_refused_there(tmp_path, capsys):
    scene = tmp_path / "bounce.toml"
    scene.write_text(BOUNCE.replace("spin = [0.0,", "spin = [1e300,"))
    line = _refusal(capsys, ["simulate", str(scene), "--float32", "--no-plot"])
    assert "`throw.spin`" in line and "1e+300" in line and "float64" in line


def test_simulation_that_fails_is_exit_code_3_and_still_json(tmp_path, capsys):
    scene = tmp_path / "scene.toml"
    lying = BOUNCE.replace("position = [0.0, 0.0, 1.0]", "position = [0.0, 0.0, 0.025]")
    lying = lying.replace("velocity = [1.0, 0.0, -2.0]", "velocity = [0.0, 0.0, 0.0]")
    scene.write_text(lying.replace("[simulate]", '[simulate]\nmotion = "exact"'))
    answer, err = _json(capsys, ["simulate", str(scene), "--json", "--no-plot"], code=3)
    assert answer["result"] == "sustained_contact"
    assert err.count("\n") == 1
    assert "sustained_contact: " in err and "contact = true" in err


def test_design_prints_one_json_object(tmp_path, capsys):
    scene = tmp_path / "bounce.toml"
    scene.write_text(BOUNCE)
    answer, err = _json(capsys, ["design", str(scene), "--json", "--no-plot"])
    assert err == ""
    assert answer["verb"] == "design" and answer["converged"] is True
    assert answer["found"]["throw.spin.y"] == pytest.approx(-1 / (0.4 * 0.025), rel=1e-6)  # section 5.2.1, v = -1
    assert answer["throw"]["spin"][1] == answer["found"]["throw.spin.y"]
    assert answer["miss"] < 1e-6 and answer["loss"] == pytest.approx(0.5 * answer["miss"] ** 2, abs=1e-300)
    assert answer["itinerary"] == ["floor"] and len(answer["impacts"]) == 1
    assert answer["starts"]["count"] == 2 and answer["evaluations"] > 2


def test_design_without_an_answer_is_exit_code_3_with_an_honest_report(tmp_path, capsys):
    scene = tmp_path / "bounce.toml"
    scene.write_text(BOUNCE.replace("point = [0.0, 0.0, 1.0] }", "point = [0.0, 0.0, 5.0] }"))
    assert main(["design", str(scene), "--no-plot"]) == 3
    out, err = capsys.readouterr()
    assert "not found" in out and out.count("came no closer than") == 2
    assert err.count("\n") == 1 and "missed by" in err and "widen" in err


@pytest.fixture
def small_tradeoff(monkeypatch):
    """Only what compiles in seconds; test_tradeoff.py has the rest."""
    whole = _questions.tradeoff
    less = {"solvers": [], "dtypes": ["float64"], "gradients": False, "runs": 1}
    monkeypatch.setattr(_questions, "tradeoff", lambda *args, **how: whole(*args, **how | less))


def test_tradeoff_prints_one_json_object_and_writes_table_and_picture(tmp_path, capsys, small_tradeoff):
    scene = tmp_path / "bounce.toml"
    scene.write_text(BOUNCE)
    answer, err = _json(capsys, ["tradeoff", str(scene), "--json", "--out", str(tmp_path), "-n", "4"])
    assert err == "" and answer["verb"] == "tradeoff" and answer["cheapest"] == "Exact, float64"
    (row,) = answer["rows"]
    assert row["method"] == "Exact" and row["max_error"] == 0.0 and "mpmath" in answer["reference"]
    assert answer["batch"] == {"throws": 4, "spread": 0.01, "seed": 0} and answer["n_throws"] == 4
    assert json.loads((tmp_path / "tradeoff.json").read_text())["rows"] == answer["rows"]
    assert (tmp_path / "tradeoff.png").read_bytes().startswith(b"\x89PNG")
    assert answer["picture"] == str(tmp_path / "tradeoff.png")


def test_tradeoff_names_the_cheapest(tmp_path, capsys, small_tradeoff):
    scene = tmp_path / "bounce.toml"
    scene.write_text(BOUNCE)
    assert main(["tradeoff", str(scene), "--no-plot", "--out", str(tmp_path), "-n", "4", "--error", "1e-9"]) == 0
    out = capsys.readouterr().out
    assert "cheapest for 1e-09 m: Exact, float64" in out and "Pareto front" in out and "mpmath at 50 digits" in out
    assert not (tmp_path / "tradeoff.png").exists() and (tmp_path / "tradeoff.json").exists()


@pytest.mark.parametrize("option, value", [("-n", "0"), ("--error", "0"), ("--error", "nan"), ("--spread", "-1"),
                                           ("--seed", "-1"), ("-n", "many")])  # fmt: skip
def test_bad_options_of_tradeoff_are_one_line(tmp_path, capsys, option, value):
    scene = tmp_path / "bounce.toml"
    scene.write_text(BOUNCE)
    line = _refusal(capsys, ["tradeoff", str(scene), "--out", str(tmp_path), option, value])
    assert option in line and value in line


def test_version(capsys):
    assert main(["--version"]) == 0
    assert re.fullmatch(r"nonholo_jax \d+\.\d+\.\d+\n", capsys.readouterr().out)


def test_help_is_exit_code_0(capsys):
    assert main(["--help"]) == 0
    assert "simulate" in capsys.readouterr().out


def test_a_process_of_its_own_draws_and_leaves_standard_output_to_the_answer(tmp_path):
    (tmp_path / "bounce.toml").write_text(BOUNCE)
    command = [sys.executable, "-c", "import sys; from nonholo_jax.cli import main; sys.exit(main())"]
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).parents[2])}

    def run(*arguments):
        return subprocess.run([*command, *arguments], cwd=tmp_path, env=environment, capture_output=True, text=True)

    done = run("simulate", "bounce.toml", "--json")
    assert done.returncode == 0, done.stderr
    answer = json.loads(done.stdout)
    assert 0.1 < answer["seconds"]["import"] < 60
    assert answer["picture"] == str(Path("nonholo-out") / "bounce" / "trajectory.png")
    assert (tmp_path / answer["picture"]).read_bytes().startswith(b"\x89PNG")
    refused = run("simulate", "none.toml")
    assert (refused.returncode, refused.stdout) == (2, "")
    assert refused.stderr == "nonholo: none.toml: the file must exist, but got no such file; check the path\n"


def test_every_kind_of_row_has_a_label():
    assert set(_LABELS) == set(KINDS._name_to_item) - {"unused"}
