"""A study is what one batch would be: the same throws whatever the chunks, devices and interruptions; moments,
quantiles and itineraries as NumPy has them; chunks wholly there or not at all."""

import dataclasses
import errno
import os
import shutil
import signal
import socket
import subprocess
import sys
import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

import nonholo_jax._ensembles.store as store
from nonholo_jax import (
    Air,
    Ball,
    BallState,
    Box,
    Distance,
    Ensemble,
    FinalPosition,
    ImpactCount,
    Integrated,
    Landing,
    LandingTime,
    Normal,
    Plane,
    Returns,
    Rough,
    Sampler,
    Scene,
    StoreError,
    Uniform,
    Vary,
    monte_carlo,
    simulate,
)
from nonholo_jax._ensembles.measure import struck
from nonholo_jax._ensembles.montecarlo import _spelled
from nonholo_jax.plot import plot_ensemble

G, T1 = 9.81, 1.2
FLOOR = Plane((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), Rough(0.8))
SCENE = Scene(Ball(0.025, 0.046), {"floor": FLOOR, "wall": Plane((1.5, 0.0, 0.0), (-1.0, 0.0, 0.0), Rough(0.8))})
THROW = BallState([0.0, 0.0, 1.0], [1.0, 0.2, 0.0], [0.0, 0.0, 0.0])
SAMPLER = Sampler(
    THROW, [Vary("velocity", Normal([0.5, 0.3, 0.2])), Vary("surfaces.floor.law.restitution", Uniform(0.6, 0.9))]
)
MEASURES = {
    "landing": Landing("floor"),
    "time": LandingTime("floor"),
    "wall": LandingTime("wall"),
    "count": ImpactCount(),
    "near": Returns([1.0, 0.0, 0.3], within=0.2),
}
N = 3000


def study(**options):
    given = {"n": N, "key": 3, "t1": T1, "measures": MEASURES, "max_impacts": 8, "chunk": 1024} | options
    return monte_carlo(SCENE, SAMPLER, **given)


def same(one, other, **tolerance):
    """Two studies: sums equal, or to rounding."""
    for name in one.sums._fields:
        a, b = getattr(one.sums, name), getattr(other.sums, name)
        if name in ("first", "second", "lowest", "highest") and tolerance:
            assert np.allclose(a, b, **tolerance), name
        elif name == "sketches" and tolerance:
            continue
        else:
            assert np.array_equal(a, b) if isinstance(a, np.ndarray) else a == b, name


@pytest.fixture(scope="module")
def kept(tmp_path_factory):
    """A study with all records."""
    folder = tmp_path_factory.mktemp("study") / "kept"
    return study(out=folder, records="all")


def table(found):
    records = found.records().to_table()
    return {name: np.asarray(records[name]) for name in records.column_names}


def test_moments_quantiles_and_extremes_are_those_of_the_records(kept):
    rows = table(kept)
    assert kept.n == N and np.array_equal(rows["throw"], np.arange(N))
    for name in ("landing.x", "time", "wall", "count"):
        there = rows[name][np.isfinite(rows[name])]
        assert kept.present(name) == len(there)
        assert np.isclose(kept.mean(name), there.mean(), rtol=1e-12)
        assert np.isclose(kept.standard_error(name), there.std(ddof=1) / np.sqrt(len(there)), rtol=1e-10)
        (low, at_low), (high, at_high) = kept.extremes(name)
        assert low == there.min() == rows[name][at_low] and high == there.max() == rows[name][at_high]
        counts, edges = kept.histogram(name)
        assert counts.sum() == len(there) and np.array_equal(counts[1:-1], np.histogram(there, edges)[0])
    for name, level in (("landing.x", 0.05), ("time", 0.5), ("landing.y", 0.99)):
        value, error = kept.quantile(name, level)
        # A t-digest of this size is good to 1e-3 in the level.
        assert abs((rows[name] <= value).mean() - level) < 1e-3
        assert 0.2 < error / (np.sqrt(level * (1 - level) / N) / _density(rows[name], value)) < 5.0
    names = [each.name for each in kept.quantities]
    i, j = names.index("landing.x"), names.index("wall")
    both = np.isfinite(rows["wall"])
    assert np.isclose(kept.covariance()[i, j], np.cov(rows["landing.x"][both], rows["wall"][both])[0, 1], rtol=1e-9)
    assert kept.mean("near") == kept.probability("near")[0] == rows["near"].mean()


def _density(values, at):
    return float(stats.gaussian_kde(values)(at)[0])


def test_itineraries_and_results_are_those_of_the_records(kept):
    rows = table(kept)
    kinds, counts = np.unique(rows["itinerary"].astype(str), return_counts=True)
    assert {" ".join(each.what): each.count for each in kept.itineraries} == dict(
        zip(kinds, counts.tolist(), strict=True)
    )
    assert [each.count for each in kept.itineraries] == sorted(counts.tolist(), reverse=True)
    assert {each.what: each.count for each in kept.results} == {"reached_t1": N}


def test_a_throw_is_what_simulate_makes_of_its_inputs(kept):
    rows = table(kept)
    for i in (0, 1023, 1024, 2999):
        values = jnp.asarray([rows[name][i] for name in SAMPLER.names(SCENE)])
        scene, state = SAMPLER.applied(SCENE, values)
        trajectory = simulate(scene, state, t1=T1, max_impacts=8)
        assert np.isclose(trajectory.impacts.time[0], rows["time"][i], rtol=1e-13)
        assert int(trajectory.n_impacts) == rows["count"][i]


def test_the_mean_is_the_textbook_s(kept):
    """The time to the floor depends on the vertical velocity alone; E y = E(vy) E(T), for the two are independent."""
    h, m, s = 1.0 - 0.025, 0.0, 0.2
    u = (np.arange(20_000) + 0.5) / 20_000
    vz = stats.norm(m, s).ppf(u)
    fall = (vz + np.sqrt(vz**2 + 2 * G * h)) / G
    time, error = kept.mean("time"), kept.standard_error("time")
    assert abs(time - fall.mean()) < 5 * error
    assert abs(kept.standard_deviation("time") - fall.std()) < 5 * error
    far, error = kept.mean("landing.y"), kept.standard_error("landing.y")
    assert abs(far - 0.2 * fall.mean()) < 5 * error


def test_chunks_do_not_matter(kept):
    same(kept, study(chunk=1000), rtol=1e-10, atol=1e-9)
    same(kept, study(chunk=1 << 16), rtol=1e-10, atol=1e-9)


def test_samples_are_the_same_to_the_last_bit(kept, tmp_path):
    rows, others = table(kept), table(study(chunk=777, out=tmp_path / "other", records="all"))
    for name in SAMPLER.names(SCENE):
        assert np.array_equal(rows[name], others[name])


def test_sobol_throws_do_not_know_of_chunks_and_converge(kept):
    quiet = Sampler(THROW, SAMPLER.vary, "sobol")
    options = {"n": 2048, "key": 0, "t1": T1, "measures": MEASURES, "max_impacts": 8}
    one, other = (monte_carlo(SCENE, quiet, chunk=c, **options) for c in (500, 2048))
    same(one, other, rtol=1e-10, atol=1e-9)
    assert abs(one.mean("landing.y") - kept.mean("landing.y")) < 5 * kept.standard_error("landing.y")


def test_functions_of_a_key(getkey):
    """A sampler, and a measure, of one's own; a scene per throw."""

    def draw(key):
        a, b = jax.random.split(key)
        wall = Plane((1.0 + jax.random.uniform(a), 0.0, 0.0), (-1.0, 0.0, 0.0), Rough(0.8))
        room = Scene(SCENE.ball, {"floor": FLOOR, "wall": wall})
        return room, dataclasses.replace(THROW, velocity=THROW.velocity + 0.1 * jax.random.normal(b, (3,)))

    options = {"n": 300, "key": getkey(), "t1": T1, "measures": {"speed": lambda t: jnp.linalg.norm(t.final.velocity)}}
    one, other = (monte_carlo(SCENE, draw, chunk=c, **options) for c in (128, 300))
    same(one, other, rtol=1e-10, atol=1e-9)
    assert one.present("speed") == 300 and one.itineraries[0].count > 100


def test_without_itineraries_nothing_is_logged():
    found = study(itinerary_length=0, measures={"end": FinalPosition()})
    logged = study(measures={"end": FinalPosition()})
    assert found.itineraries[0].what == ()
    assert np.isclose(found.mean("end.x"), logged.mean("end.x"), rtol=1e-12)


# Distances


@pytest.mark.parametrize("air", [None, Air()], ids=["vacuum", "air"])
def test_distance_is_that_of_the_path(air):
    table_top = Box(center=(0.6, 0.0, 0.715), half_size=(0.6, 0.4, 0.015), law=Rough())
    room = Scene(Ball(0.025, 0.046), {"floor": FLOOR, "table": table_top}, air=air)
    state = BallState([-0.3, 0.0, 0.9], [2.0, 0.1, -5.0], [0.0, 15.0, 0.0])
    motion = None if air is None else Integrated(rtol=1e-10, atol=1e-10)
    trajectory = simulate(room, state, t1=1.0, max_impacts=12, motion=motion)
    times = jnp.sort(jnp.concatenate([jnp.linspace(0.0, 1.0, 20_001), trajectory.impacts.time[: trajectory.n_impacts]]))
    path = np.asarray(trajectory.at(times).position)
    for point, after in (((-0.3, 0.0, 0.9), 1), ((0.1, 0.1, 0.3), 0), ((0.4, 0.0, 0.2), 2), ((2.0, 0.0, 0.0), 3)):
        away = np.linalg.norm(path - np.asarray(point), axis=-1)
        begun = 0.0 if after == 0 else float(trajectory.impacts.time[after - 1])
        wanted = float(away[np.asarray(times) >= begun].min())
        found = float(Distance(point, after)(trajectory))
        assert abs(found - wanted) < (1e-6 if air is None else 5e-5), (point, found, wanted)
    assert np.isnan(Distance((0.0, 0.0, 0.0), 13)(trajectory))


def test_an_edge_that_is_left_is_no_landing():
    """A ball that rolls off a table comes to the table once, by a train, and then to the floor."""
    table_top = Box(center=(0.0, 0.0, 0.485), half_size=(0.5, 0.5, 0.015), law=Rough(0.5))
    room = Scene(Ball(0.025, 0.046), {"floor": FLOOR, "table": table_top})
    trajectory = simulate(room, BallState([0.0, 0.0, 0.6], [1.2, 0.0, 0.0], [0.0, 0.0, 0.0]), t1=1.5)
    rows = [int(i) for i in trajectory.impacts.surface if i >= 0]
    assert rows.count(1) == int(struck(trajectory.impacts).sum()) - rows.count(0) + 1  # one row is that of the edge
    assert int(struck(trajectory.impacts).sum()) < len(rows)
    last = int(jnp.sum(struck(trajectory.impacts) & (trajectory.impacts.surface == 1)))
    assert np.isfinite(LandingTime("table", last)(trajectory)) and np.isnan(LandingTime("table", last + 1)(trajectory))


# Folders


def test_a_study_opens_from_its_folder(kept):
    import xarray as xr

    opened = Ensemble.open(kept.folder)
    same(kept, opened)
    data = xr.open_zarr(kept.folder / "summary.zarr")
    assert float(data["mean"].sel(quantity="time")) == kept.mean("time")
    assert data.attrs["throws"] == N and "surfaces" in data.attrs
    assert not list(kept.folder.rglob("*.part"))


def interrupted(monkeypatch, after, error):
    """Fail in the midst of writing chunk number `after`."""
    write, count = store._write, iter(range(1000))

    def failing(path, data):
        if path.suffix == ".npz" and path.parent.name == "chunks" and next(count) == after:
            path.with_name(f".{path.name}.0.part").write_bytes(data[: len(data) // 2])
            raise error
        write(path, data)

    monkeypatch.setattr(store, "_write", failing)


def test_a_picture_has_a_plan_of_every_place_with_the_room(kept):
    """Two places, and a table that is drawn whole; every throw is in some cell of its plan."""
    scene = Scene(SCENE.ball, {"floor": FLOOR, "table": Box((0.9, 0.0, 0.3), (0.4, 0.3, 0.02), Rough(0.8))})
    measures = {"first": Landing(), "end": FinalPosition(), "time": LandingTime("floor")}
    found = monte_carlo(scene, Sampler(THROW, [Vary("velocity", Normal(0.1))]), n=500, key=0, t1=1.0, measures=measures)
    plans = {ax.get_title(loc="left"): ax for ax in plot_ensemble(found).axes}
    for name in ("first", "end"):
        ax = plans[f"{name}, from above"]
        (mesh,) = ax.collections
        assert mesh.get_array().sum() == found.present(f"{name}.x")
        (low, high), (left, right) = ax.get_xlim(), ax.get_ylim()
        assert low < 0.5 and high > 1.3 and left < -0.3 and right > 0.3
        assert "table" in [text.get_text() for text in ax.texts]
    assert {"itineraries", "mean of first.x, with its 95 % band"} <= set(plans)
    opened = plot_ensemble(Ensemble.open(kept.folder), quantity="near")
    titles = [ax.get_title(loc="left") for ax in opened.axes]
    assert "landing, from above" in titles and "probability of near, with its 95 % band" in titles
    with pytest.raises(ValueError, match="far"):
        plot_ensemble(found, quantity="far")


@pytest.mark.parametrize("error", [KeyboardInterrupt(), OSError(errno.ENOSPC, "No space left on device")], ids=str)
def test_an_interrupted_study_resumes_to_the_same_bits(kept, tmp_path, monkeypatch, error):
    folder = tmp_path / "study"
    with monkeypatch.context() as patch:
        interrupted(patch, 1, error)
        with pytest.raises(KeyboardInterrupt if isinstance(error, KeyboardInterrupt) else StoreError, match="room|^$"):
            study(out=folder, records="all")
    assert [path.name for path in sorted((folder / "chunks").glob("*.npz"))] == ["00000000.npz"]
    with pytest.raises(StoreError, match="resume"):
        study(out=folder, records="all")
    resumed = study(out=folder, records="all", resume=True)
    same(kept, resumed)
    for name in ("chunks", "records"):
        for path in (kept.folder / name).iterdir():
            assert path.read_bytes() == (folder / name / path.name).read_bytes()


def test_a_folder_of_something_else_is_refused(kept, tmp_path):
    folder = tmp_path / "study"
    shutil.copytree(kept.folder, folder)
    with pytest.raises(StoreError, match="another, which differs in key"):
        study(out=folder, records="all", key=4, resume=True)
    (folder / "run.json").unlink()
    with pytest.raises(StoreError, match="missing"):
        study(out=folder, records="all", resume=True)
    with pytest.raises(StoreError, match="must be a folder"):
        (tmp_path / "file").write_text("")
        study(out=tmp_path / "file")
    with pytest.raises(StoreError, match="has no run.json"):
        Ensemble.open(tmp_path)


def test_what_determines_a_study_is_told_apart():
    """Functions by their code, the constants in it and what it closes over; the same again from run to run."""
    times = lambda x: lambda trajectory: x * trajectory.t1  # noqa: E731
    twice, thrice = (lambda trajectory: 2.0 * trajectory.t1), (lambda trajectory: 3.0 * trajectory.t1)
    assert _spelled(twice) != _spelled(thrice)
    assert _spelled(times(2.0)) == _spelled(times(2.0)) != _spelled(times(3.0))
    assert _spelled(Landing("floor")) == _spelled(Landing("floor")) != _spelled(Landing("wall"))
    assert _spelled(SAMPLER) != _spelled(Sampler(THROW, [Vary("velocity", Normal(0.1))]))


@pytest.mark.parametrize("part", ["chunks/00000001.npz", "frame.npz", "run.json"])
def test_damage_is_found(kept, tmp_path, part):
    folder = tmp_path / "study"
    shutil.copytree(kept.folder, folder)
    data = bytearray((folder / part).read_bytes())
    middle = len(data) // 2
    data[middle : middle + 20] = bytes(255 - x for x in data[middle : middle + 20])
    (folder / part).write_bytes(data)
    with pytest.raises(StoreError, match=part.split("/")[-1]):
        study(out=folder, records="all", resume=True)


def test_studies_stop_when_they_are_good_enough():
    enough = study(standard_error={"landing.x": 0.006}, chunk=256)
    assert enough.n < N and enough.standard_error("landing.x") <= 0.006
    less = study(n=enough.n - 256, chunk=256)
    assert less.standard_error("landing.x") > 0.006
    assert study(seconds=1e-9, chunk=256).n == 256


def test_only_some_throws_are_kept(tmp_path):
    found = study(out=tmp_path / "study", records=["landing.x", "itinerary"], record_where="near")
    rows = found.records().to_table()
    assert rows.column_names == ["throw", "landing.x", "itinerary"]
    assert len(rows) == round(found.mean("near") * N)


WRONG = {
    "n": (lambda: study(n=0), "`n`"),
    "chunk": (lambda: study(chunk=0), "`chunk`"),
    "name": (lambda: monte_carlo(SCENE, Sampler(THROW, [Vary("spim", Normal(1.0))]), n=1, key=0, t1=1.0), "spin"),
    "twice": (lambda: Sampler(THROW, [Vary("spin", Normal(1.0)), Vary("spin.x", Normal(1.0))]).names(SCENE), "twice"),
    "components": (lambda: Sampler(THROW, [Vary("spin.x", Normal([1.0, 2.0]))]).names(SCENE), "components"),
    "column": (lambda: study(out="unused", records=["landing.w"]), "landing.w"),
    "event": (lambda: study(out="unused", records="all", record_where="time"), "near"),
    "quantity": (lambda: study(standard_error={"x": 1.0}), "`standard_error`"),
    "records": (lambda: study(records="all"), "`out`"),
    "surface": (lambda: study(measures={"there": Landing("roof")}), "roof"),
    "within": (lambda: Returns([0.0, 0.0, 0.0], within=0.0), "positive"),
    "accuracy": (lambda: monte_carlo(SCENE, lambda key: THROW, n=1, key=0, t1=1.0, accuracy=1e-6), "`accuracy`"),
    "times": (lambda: study(t1=-1.0), "`t1`"),
    "nothing varies": (lambda: Sampler(THROW, []), "at least one"),
}


@pytest.mark.parametrize("name", WRONG)
def test_what_cannot_be_is_refused(name):
    make, words = WRONG[name]
    with pytest.raises(ValueError, match=words):
        make()


# Other processes

SCRIPT = """
import sys, jax
jax.config.update("jax_enable_x64", True)
sys.path.insert(0, {here!r})
coordinator = sys.argv[2:]
if coordinator:
    jax.config.update("jax_enable_recoverability", True)
    jax.distributed.initialize(coordinator[0], 2, int(coordinator[1]))
import test_montecarlo as t
found = t.study(out=sys.argv[1], records="all", resume=True, chunk=256)
print("done", found.n, len(jax.local_devices()))
if coordinator:
    sys.stdin.read()  # the others cannot come back when the process that brings them together has left
"""


def run(folder, *more, devices=1, wait=True, effort=0):
    here = os.path.dirname(__file__)
    flags = f"--xla_force_host_platform_device_count={devices} --xla_backend_optimization_level={effort}"
    flags = f"{os.environ.get('XLA_FLAGS', '')} {flags}"
    environment = {**os.environ, "XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu"}
    command = [sys.executable, "-c", SCRIPT.format(here=here), str(folder), *map(str, more)]
    pipes = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.PIPE)
    process = subprocess.Popen(command, env=environment, text=True, **pipes)
    if not wait:
        return process
    out, error = process.communicate()
    assert process.returncode == 0, error
    return out


def alike(folder, other):
    for name in ("chunks", "records"):
        for path in (folder / name).iterdir():
            assert path.read_bytes() == (other / name / path.name).read_bytes(), path.name


def test_a_killed_study_resumes_to_the_same_bits(tmp_path):
    """SIGKILL at several moments, then once more undisturbed: chunk by chunk what an undisturbed study writes."""
    folder, whole = tmp_path / "killed", tmp_path / "whole"
    assert "done 3000 1" in run(whole)
    for wanted in (1, 4):
        process = run(folder, wait=False)
        while process.poll() is None and len(list((folder / "chunks").glob("*.npz"))) < wanted:
            time.sleep(0.001)
        process.send_signal(signal.SIGKILL)
        process.communicate()
    run(folder)
    alike(whole, folder)
    same(Ensemble.open(whole), Ensemble.open(folder))


def test_one_of_two_processes_dies_and_comes_back(tmp_path):
    """They share the chunks of a folder; the one that is left waits for the other."""
    with socket.socket() as free:
        free.bind(("localhost", 0))
        coordinator = f"localhost:{free.getsockname()[1]}"
    folder, whole = tmp_path / "shared", tmp_path / "whole"
    first, second = (run(folder, coordinator, i, wait=False) for i in (0, 1))
    while second.poll() is None and first.poll() is None and not list((folder / "chunks").glob("*.npz")):
        time.sleep(0.001)
    second.send_signal(signal.SIGKILL)
    second.communicate()
    second = run(folder, coordinator, 1, wait=False)
    for process in (second, first):
        out, error = process.communicate(timeout=300)
        assert process.returncode == 0 and "done 3000 1" in out, error
    run(whole)
    alike(whole, folder)
    same(Ensemble.open(whole), Ensemble.open(folder))


def test_two_devices_draw_the_same_throws(tmp_path):
    """Compiled as by default: with less effort, JAX 0.10 rounds otherwise for two devices."""
    one, two = tmp_path / "one", tmp_path / "two"
    assert "done 3000 1" in run(one, effort=3) and "done 3000 2" in run(two, devices=2, effort=3)
    one, two = Ensemble.open(one), Ensemble.open(two)
    same(one, two, rtol=1e-10, atol=1e-9)
    rows, others = table(one), table(two)
    for name in SAMPLER.names(SCENE):
        assert np.array_equal(rows[name], others[name])
