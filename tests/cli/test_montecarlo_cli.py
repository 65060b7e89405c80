"""`nonholo montecarlo`: one answer, one clear line for what is wrong, and nothing lost."""

import errno
import json
import math
import os
import re

import pytest

from nonholo_jax import Ensemble, monte_carlo
from nonholo_jax.cli import main
from nonholo_jax.scene_file import load_scene, save_scene

SCENE = """schema = 1
[ball]
radius = 0.025
mass = 0.046
[surfaces.floor]
shape = "plane"
point = [0.0, 0.0, 0.0]
normal = [0.0, 0.0, 1.0]
law = { kind = "rough", restitution = 0.8 }
[throw]
position = [0.0, 0.0, 1.0]
velocity = [1.0, 0.0, 0.0]
spin = [0.0, 0.0, 0.0]
[simulate]
t1 = 1.0
max_impacts = 8
[monte_carlo]
n = 600
seed = 1
[[monte_carlo.vary]]
names = ["velocity"]
kind = "normal"
std = [0.1, 0.1, 0.2]
[[monte_carlo.vary]]
names = ["velocity_of_nothing"]
kind = "normal"
std = 1.0
[[monte_carlo.measure]]
name = "landing"
kind = "landing"
surface = "floor"
[[monte_carlo.measure]]
name = "near"
kind = "returns"
point = [1.0, 0.0, 0.3]
within = 0.2
"""
SECOND = '[[monte_carlo.vary]]\nnames = ["velocity_of_nothing"]\nkind = "normal"\nstd = 1.0\n'
GOOD = SCENE.replace(SECOND, "")
CORRELATED = 'names = ["velocity.x", "velocity.z"]\nkind = "correlated"\n'
TABLE = 'names = ["velocity.z"]\nkind = "measured"\n'
VELOCITY = 'names = ["velocity"]\nkind = "normal"\nstd = [0.1, 0.1, 0.2]'


def written(tmp_path, text):
    path = tmp_path / "scene.toml"
    path.write_text(text)
    return str(path)


@pytest.fixture
def scene(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "throws.csv").write_text("vx,vz\n1.0,0.0\n1.1,fast\n")
    return written(tmp_path, GOOD)


def test_one_json_object_store_and_picture(scene, tmp_path, capsys):
    assert main(["montecarlo", scene, "--json", "--chunk", "200", "--out", "study"]) == 0
    out, error = capsys.readouterr()
    answer = json.loads(out)
    assert error == "" and out.count("\n") == 1
    assert answer["verb"] == "montecarlo" and answer["throws"] == 600
    near = answer["quantities"]["near"]
    assert near["present"] == 600 and 0 < near["probability"] < 1 and near["standard_error"] > 0
    assert (tmp_path / "study" / "montecarlo.png").stat().st_size > 10_000
    file = load_scene(scene)
    direct = monte_carlo(file.scene, **file.monte_carlo.arguments, **file.simulate.arguments)
    assert direct.mean("near") == near["probability"]
    assert main(["montecarlo", scene, "--chunk", "200", "--out", "study", "--resume", "--no-plot"]) == 0
    text, error = capsys.readouterr()
    assert error == "" and "600 throws" in text and "near" in text and "itineraries" in text


def test_throws_that_failed_are_counted_and_named(tmp_path, monkeypatch, capsys):
    """A restitution of 0.8 with a spread of 0.2 is above 1 in one throw of six."""
    monkeypatch.chdir(tmp_path)
    text = GOOD.replace('names = ["velocity"]', 'names = ["surfaces.floor.law.restitution"]')
    path = written(tmp_path, text.replace("std = [0.1, 0.1, 0.2]", "std = 0.2"))
    assert main(["montecarlo", path, "--json", "--out", "one"]) == 0
    out, error = capsys.readouterr()
    answer = json.loads(out)
    failed = answer["failures"]["invalid_state"]
    assert error == "" and 50 < failed < 150 and answer["quantities"]["landing.x"]["present"] == 600 - failed
    assert main(["montecarlo", path, "--out", "two", "--no-plot"]) == 0
    out, error = capsys.readouterr()
    assert error == "" and f"warning: {failed} of 600 throws failed (invalid_state {failed})" in out


def test_first_order_stands_beside_the_answer(scene, capsys):
    """A drop bounces back: its landing is linear in the horizontal velocity, and the spread of that is 0.1 m/s."""
    command = ["montecarlo", scene, "--first-order", "--chunk", "200", "--no-plot"]
    assert main([*command, "--out", "one", "--json"]) == 0
    linear = json.loads(capsys.readouterr().out)["first_order"]
    fall = math.sqrt(2.0 * 0.975 / 9.81)
    found = linear["quantities"]["landing.y"]
    assert math.isclose(found["parts"]["throw.velocity.y"], 0.1 * fall, rel_tol=1e-6) and found["mean"] == 0.0
    assert linear["itinerary"] == ["floor"] and "near" not in linear["quantities"]
    assert main([*command, "--out", "two", "-n", "4000"]) == 0
    text = capsys.readouterr().out
    assert "to first order" in text and "velocity.y" in text and "warning: " not in text


def test_a_file_is_read_back(scene, tmp_path):
    file = load_scene(scene)
    save_scene(file, tmp_path / "copy.toml")
    copy = load_scene(tmp_path / "copy.toml")
    assert copy.monte_carlo.arguments.keys() == file.monte_carlo.arguments.keys()
    assert copy.monte_carlo.table == file.monte_carlo.table and copy.monte_carlo.sampler == file.monte_carlo.sampler


MALFORMED = {
    "unknown name": (SCENE, "vary[1]"),
    "name twice": (SCENE.replace("velocity_of_nothing", "velocity.x"), "twice"),
    "n = 0": (GOOD.replace("n = 600", "n = 0"), "monte_carlo.n"),
    "negative spread": (GOOD.replace("std = [0.1, 0.1, 0.2]", "std = [0.1, -0.1, 0.2]"), "std[1]"),
    "spreads": (GOOD.replace("std = [0.1, 0.1, 0.2]", "std = [0.1, 0.2]"), "components"),
    "missing": (GOOD.replace("std = [0.1, 0.1, 0.2]\n", ""), "std"),
    "misspelt": (GOOD.replace("std =", "sdt ="), "did you mean 'std'"),
    "unknown kind": (GOOD.replace('"normal"', '"gaussian"'), "'gaussian'"),
    "unknown measure": (GOOD.replace('"returns"', '"return"'), "did you mean 'returns'"),
    "unknown surface": (GOOD.replace('surface = "floor"', 'surface = "roof"'), "'roof'"),
    "within": (GOOD.replace("within = 0.2", "within = 0.0"), "within"),
    "same name": (GOOD.replace('name = "near"', 'name = "landing"'), "differ"),
    "nothing varies": (GOOD.replace(f"[[monte_carlo.vary]]\n{VELOCITY}\n", ""), "monte_carlo.vary"),
    "covariance": (GOOD.replace(VELOCITY, CORRELATED + "covariance = [[1.0, 2.0], [2.0, 1.0]]"), "semidefinite"),
    "ragged": (GOOD.replace(VELOCITY, CORRELATED + "covariance = [[1.0], [2.0, 1.0]]"), "covariance"),
    "column": (GOOD.replace(VELOCITY, TABLE + 'file = "throws.csv"\ncolumns = ["vy"]'), "'vy'"),
    "csv row": (GOOD.replace(VELOCITY, TABLE + 'file = "throws.csv"\ncolumns = ["vz"]'), "line 3"),
    "no csv": (GOOD.replace(VELOCITY, TABLE + 'file = "none.csv"\ncolumns = ["vz"]'), "none.csv"),
}


def refused(capsys, *words):
    code = main(list(words))
    out, error = capsys.readouterr()
    assert code in (2, 3) and out == "" and error.count("\n") == 1, (code, out, error)
    assert "Traceback" not in error
    return code, error


@pytest.mark.parametrize("name", MALFORMED)
def test_malformed_tables_are_one_clear_line(name, scene, tmp_path, capsys):
    text, words = MALFORMED[name]
    assert text != GOOD
    code, error = refused(capsys, "montecarlo", written(tmp_path, text))
    assert code == 2 and words in error and "scene.toml" in error, error


COMMANDS = {
    "n": (["-n", "0"], "`n`"),
    "chunk": (["--chunk", "-1"], "`chunk`"),
    "seconds": (["--seconds", "0"], "--seconds"),
    "error": (["--standard-error", "near"], "NAME=VALUE"),
    "quantity": (["--standard-error", "far=0.1"], "'far'"),
    "records": (["--records", "landing.w"], "landing.w"),
    "where": (["--records", "all", "--where", "landing.x"], "near"),
    "process": (["--process", "0"], "--coordinator"),
}


@pytest.mark.parametrize("name", COMMANDS)
def test_malformed_command_lines_are_one_clear_line(name, scene, capsys):
    options, words = COMMANDS[name]
    code, error = refused(capsys, "montecarlo", scene, *options)
    assert code == 2 and words in error, error


def test_folders_of_others_damage_and_full_disks(scene, tmp_path, capsys, monkeypatch):
    command = ["montecarlo", scene, "--chunk", "200", "--out", "study", "--no-plot"]
    sync, count = os.fsync, iter(range(1000))

    def full(descriptor):
        if next(count) == 6:  # two for the study itself and its frame, with their folders; then chunk 0; then here
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        sync(descriptor)

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", full)
        _, error = refused(capsys, *command)
        assert "No space left" in error and "resume" in error
    assert len(list((tmp_path / "study" / "chunks").glob("*.npz"))) == 1
    _, error = refused(capsys, *command)
    assert "resume" in error
    _, error = refused(capsys, *command, "--resume", "--seed", "2")
    assert "another" in error and "key" in error
    assert main([*command, "--resume"]) == 0
    whole = capsys.readouterr().out
    path = tmp_path / "study" / "chunks" / "00000001.npz"
    path.write_bytes(path.read_bytes()[:500])
    _, error = refused(capsys, *command, "--resume")
    assert "00000001.npz" in error and "damaged" in error
    path.unlink()
    assert main([*command, "--resume"]) == 0
    seconds = re.compile(r"seconds: .*")
    assert seconds.sub("", capsys.readouterr().out) == seconds.sub("", whole)
    assert Ensemble.open(tmp_path / "study").n == 600


def test_an_interrupt_ends_with_what_was_done(scene, capsys, monkeypatch):
    import nonholo_jax._ensembles.montecarlo as engine

    reduce, count = engine._Runner._reduce, iter(range(10))

    def interrupted(self, k, found):
        if next(count) == 1:
            raise KeyboardInterrupt
        reduce(self, k, found)

    with monkeypatch.context() as patch:
        patch.setattr(engine._Runner, "_reduce", interrupted)
        code, error = refused(capsys, "montecarlo", scene, "--chunk", "200", "--out", "study")
    assert code == 3 and "--resume" in error
    assert Ensemble.open("study").n == 200
