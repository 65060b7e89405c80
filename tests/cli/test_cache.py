"""The command line keeps its programs on disk, says so in one line where it cannot, and never fails for it."""

import json
import os
import shutil

import jax
import jax.monitoring
import pytest

from nonholo_jax._cli import cache as module
from nonholo_jax._cli.cache import folder_of_programs, programs_kept
from nonholo_jax.cli import main

SCENE = """\
schema = 1
[ball]
radius = 0.025
mass = 0.046
[surfaces.floor]
shape = "plane"
point = [0.0, 0.0, 0.0]
normal = [0.0, 0.0, 1.0]
law = { kind = "rough", restitution = 1.0, tangential = 0.5 }
[throw]
position = [0.0, 0.0, 0.9]
velocity = [2.0, 0.0, -5.0]
spin = [0.0, 3.0, 0.0]
[simulate]
t1 = 0.5
max_impacts = 4
"""
HITS: list[str] = []


@pytest.fixture(scope="module", autouse=True)
def _listening():
    """From now on: JAX has no public way to stop one listener, and the command line has one of its own."""
    jax.monitoring.register_event_listener(lambda event, **_: HITS.append(event) if "cache_hits" in event else None)


@pytest.fixture
def cache(tmp_path, monkeypatch):
    """The folder named for programs; not yet made."""
    monkeypatch.setenv("NONHOLO_CACHE", str(tmp_path / "programs"))
    monkeypatch.setattr(module, "_LEAST_SECONDS", 0.0)  # so that what is kept does not depend on the machine
    return tmp_path / "programs"


@pytest.fixture
def simulated(tmp_path, capsys):
    def simulated(*more, text=SCENE):
        """Run as in a new process; the answer, standard error, and how many programs came from disk."""
        jax.clear_caches()
        HITS.clear()
        path = tmp_path / "scene.toml"
        path.write_text(text)
        code = main(["simulate", str(path), "--json", "--no-plot", *more])
        printed = capsys.readouterr()
        assert code == 0
        return json.loads(printed.out), printed.err, len(HITS)

    return simulated


def entries(folder):
    return sorted(folder.glob("*/*-cache"))


def test_a_second_run_and_one_with_other_numbers_compile_nothing_anew(cache, simulated):
    settings = {name: value for name, value in jax.config.values.items() if "cache" in name}
    first, errors, hits = simulated()
    assert (errors, hits) == ("", 0)
    kept = len(entries(cache))
    assert kept >= 1
    again, errors, hits = simulated()
    assert (errors, hits) == ("", kept) and again["final"] == first["final"]
    changed = SCENE
    for old, new in (("0.5 }", "0.25 }"), ("0.9]", "0.8]"), ("3.0, 0.0]", "9.0, 1.0]"), ("t1 = 0.5", "t1 = 0.6")):
        assert old in changed
        changed = changed.replace(old, new)
    other, errors, hits = simulated(text=changed)
    assert (errors, hits) == ("", kept) and other["final"] != first["final"] and len(entries(cache)) == kept
    assert settings == {name: value for name, value in jax.config.values.items() if "cache" in name}


def test_it_can_be_turned_off(cache, simulated, monkeypatch):
    simulated("--no-cache")
    assert not cache.exists()
    monkeypatch.setenv("NONHOLO_CACHE", "off")
    assert folder_of_programs() is None
    simulated()
    assert not cache.exists()


def test_a_broken_entry_costs_one_line_and_is_thrown_away(cache, simulated):
    first, _, _ = simulated()
    for entry in entries(cache):
        whole = entry.read_bytes()
        entry.write_bytes(whole[: len(whole) // 2])
    again, errors, hits = simulated()
    assert hits == 0 and again["final"] == first["final"]
    assert errors.count("\n") == 1 and "not kept in" in errors and "--no-cache" in errors
    assert not entries(cache)
    simulated()
    assert entries(cache) and simulated()[1:] == ("", len(entries(cache)))


def test_a_folder_that_cannot_be_used_costs_one_line(cache, simulated):
    cache.write_text("a file")
    _, errors, hits = simulated()
    assert hits == 0 and errors.count("\n") == 1 and str(cache) in errors
    assert cache.read_text() == "a file"


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() == 0, reason="the superuser may write anywhere")
def test_a_folder_that_cannot_be_written_costs_one_line(cache, simulated):
    cache.mkdir()
    cache.chmod(0o500)
    assert simulated()[1].count("\n") == 1


def test_a_folder_that_goes_away_meanwhile_costs_no_answer(cache, simulated):
    with programs_kept(True):
        jax.jit(lambda x: x + 1)(1.0)
        shutil.rmtree(cache)
        assert simulated()[0]["result"] == "reached_t1"


def test_the_cache_of_jax_itself_is_left_alone(cache, simulated, tmp_path):
    from jax.experimental.compilation_cache import compilation_cache

    before = jax.config.jax_compilation_cache_dir
    try:
        jax.config.update("jax_compilation_cache_dir", str(tmp_path / "own"))
        simulated()
        assert jax.config.jax_compilation_cache_dir == str(tmp_path / "own") and not cache.exists()
    finally:
        jax.config.update("jax_compilation_cache_dir", before)
        compilation_cache.reset_cache()


def test_programs_lie_by_default_in_the_cache_of_the_user(monkeypatch):
    import platformdirs

    monkeypatch.delenv("NONHOLO_CACHE")
    folder = folder_of_programs()
    assert str(folder.parent) == platformdirs.user_cache_dir("nonholo_jax", appauthor=False)
    assert folder.name.startswith(f"jax-{jax.__version__}-")
