"""Rates: where a ladder ends, how devices compare, what is counted. Nothing here asserts a time."""

import json
import math
import os
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nonholo_jax import RESULTS, Ball, BallState, Bench, Plane, Rate, Rough, Scene, bench, simulate_batch
from nonholo_jax._questions.bench import SPIN_SPREAD, SPREAD, Program, built_in, case, scattered
from nonholo_jax._questions.rates import Pays, Rung, climb, crossover, summary
from nonholo_jax.scene_file import load_scene

SCENE = Scene(Ball(0.025, 0.046), {"floor": Plane((0, 0, 0), (0, 0, 1), Rough())})
THROW = BallState([0.0, 0.0, 1.0], [1.0, 0.0, -2.0], [0.0, 5.0, 0.0])
HOW = {"t0": 0.0, "t1": 1.5, "max_impacts": 8}


def ladder(launch, each, most=10**9, room=None, bytes_each=None):
    """A device that takes `launch` + n `each` seconds for n throws."""
    asked = []

    def run(throws):
        asked.append(throws)
        return Rung(throws, launch + each * throws, None if bytes_each is None else bytes_each * throws)

    found, why = climb(run, most, room)
    assert [rung.throws for rung in found] == asked == [10**k for k in range(len(asked))]
    return len(asked), why


def test_sizes_end_where_the_rate_is_flat():
    # 1e5 and 1e6 throws take 2 ms and 11 ms: 1.8 times the rate; 1e7 take 101 ms: 1.09 times
    assert ladder(1e-3, 1e-8) == (8, "flat")
    assert ladder(1.5, 1e-8) == (9, "time")  # 1e8 throws take 2.5 s, and the rate still rises
    assert ladder(0.0, 1.0) == (2, "flat")


def test_a_rate_is_not_called_flat_while_the_launch_is_measured():
    assert ladder(0.0, 1e-9, most=10**5) == (6, "most")


def test_a_rate_is_not_called_flat_where_more_devices_begin_to_share_the_batch():
    slower = lambda n: Rung(n, 0.01 if n == 1 else 0.2, None, 1 if n == 1 else 2)  # noqa: E731
    assert len(climb(slower, 10**4, None)[0]) == 5


@pytest.mark.parametrize("most, sizes", [(1, 1), (9, 1), (10, 2), (99, 2), (100, 3)])
def test_sizes_end_at_the_most_that_were_asked_for(most, sizes):
    assert ladder(1.0, 0.0, most=most) == (sizes, "most")


def test_sizes_end_where_more_would_not_fit():
    assert ladder(1.0, 0.0, room=10_000, bytes_each=50) == (3, "memory")  # 5,000 bytes fit, 50,000 do not
    assert climb(lambda n: Rung(n, 1.0, None) if n < 100 else None, 10**6, None)[1] == "memory"


def test_from_where_an_accelerator_pays():
    assert crossover(2.0, 10.0, 12.0, 1000.0).when == "from"
    n = crossover(2.0, 10.0, 12.0, 1000.0).throws
    assert 2.0 + n / 10.0 == pytest.approx(12.0 + n / 1000.0)  # both take as long
    assert crossover(2.0, 10.0, 12.0, 5.0) == crossover(2.0, 10.0, 2.0, 10.0) == Pays("never")
    assert crossover(2.0, 10.0, 1.0, 10.0) == crossover(2.0, 10.0, 2.0, 11.0) == Pays("always")
    assert crossover(2.0, 10.0, 3.0, 10.0) == crossover(2.0, 10.0, 2.0, 9.0) == Pays("never")
    n = crossover(12.0, 1000.0, 2.0, 10.0)
    assert n.when == "up to" and 12.0 + n.throws / 1000.0 == pytest.approx(2.0 + n.throws / 10.0)
    assert "from 1e+02 throws" in crossover(2.0, 10.0, 12.0, 1e9).words and Pays("never").words == "never pays"


def row(device, throws, seconds, compiling=3.0, job="value", stopped=""):
    times = (0.5, 0.25, compiling, 2.0, seconds)
    return Rate("floor", device, 1, "float64", job, throws, *times, 0.1, 4 * throws, 0, 100 * throws, None, stopped)


ROWS = (row("cpu", 1, 0.01), row("cpu", 10, 0.02), row("cpu", 100, 0.25, stopped="flat"),
        row("gpu", 1, 0.02, 30.0), row("gpu", 10, 0.02, 31.0), row("gpu", 100, 0.02, 32.0, stopped="most"),
        row("gpu", 1, 0.02, 30.0, "gradient", stopped="most"))  # fmt: skip
ABOUT = {"floor": {"t0": 0.0, "t1": 1.0, "max_impacts": 8, "motion": "Exact", "throws": "normal"}}


def test_the_summary_is_made_of_the_best_of_each_ladder():
    cpu, gpu, gradient = summary(ROWS)
    assert (cpu.row, gpu.row) == (ROWS[1], ROWS[5]) and (cpu.stopped, gpu.stopped) == ("flat", "most")
    assert cpu.over_cpu is None and cpu.pays is None
    assert gpu.over_cpu == pytest.approx(5000.0 / 500.0)
    # 3.75 + n / 500 = 32.75 + n / 5000
    assert gpu.pays.when == "from" and gpu.pays.throws == pytest.approx(29.0 / (1 / 500 - 1 / 5000))
    assert gradient.over_cpu is None and gradient.pays is None  # no CPU to compare with


def test_rates_and_times_to_the_first_answer():
    assert ROWS[2].throws_per_second == 400.0 and ROWS[2].bounces_per_second == 1600.0
    assert ROWS[2].setup_seconds == 3.75 and ROWS[2].first_answer_seconds == 5.75


def test_the_report_survives_json_and_the_table_says_all_of_it():
    found = Bench(ROWS, ABOUT, "one machine", True)
    report = json.loads(json.dumps(found.report(), allow_nan=False))
    assert set(report) == {"machine", "cached", "gradient", "scenes", "rows", "best"}
    assert [each["throws"] for each in report["rows"]] == [each.throws for each in ROWS]
    assert report["rows"][2]["throws_per_second"] == 400.0 and report["rows"][0]["peak_bytes"] is None
    assert report["best"][1]["over_cpu"] == 10.0 and report["best"][1]["pays"]["when"] == "from"
    assert report["best"][0]["pays"] is None and "squared final position" in report["gradient"]
    text = "\n".join(found.table())
    for words in ("one machine", "cache on disk", "10 times the cpu's rate", "pays from 1.6e+04 throws", "flat"):
        assert words in text
    assert sum(line.split()[:1] in (["cpu"], ["gpu"]) for line in text.splitlines()) == len(ROWS) + 3


def test_throws_scatter_round_the_throw_and_do_not_depend_on_their_number():
    many, few = scattered(THROW, 4000, 3), scattered(THROW, 10, 3)
    assert (many.position == THROW.position[None]).all()
    for one, other in zip(jax.tree.leaves(many), jax.tree.leaves(few), strict=True):
        assert (one[:10] == other).all()
    speed = math.sqrt(5.0)
    assert np.std(many.velocity, axis=0) == pytest.approx(np.full(3, SPREAD * speed), rel=0.05)
    assert np.std(many.spin, axis=0) == pytest.approx(np.full(3, SPIN_SPREAD), rel=0.05)
    assert np.mean(many.spin, axis=0) == pytest.approx(np.asarray(THROW.spin), abs=0.2)
    assert (scattered(THROW, 10, 4).spin != few.spin).all()
    turned = BallState(THROW.position, THROW.velocity, THROW.spin, [1.0, 0.0, 0.0, 0.0])
    assert scattered(turned, 10, 0).orientation.shape == (10, 4)


def test_the_scene_under_the_table_is_that_of_its_file():
    file = load_scene(Path(__file__).parents[2] / "experiments" / "scenes" / "under_the_table.toml")
    one = built_in()["under the table"]
    assert jax.tree.leaves(one.scene) == jax.tree.leaves(file.scene)
    assert one.how["t1"] == file.simulate.t1 and one.how["max_impacts"] == file.simulate.max_impacts
    middle = np.mean(one.draw(10_000).velocity, axis=0)
    assert middle == pytest.approx(np.asarray(file.throw.velocity), abs=0.01)
    assert built_in()["under the table, with air"].scene.air is not None


@pytest.fixture(scope="module")
def found():
    return bench(
        SCENE, THROW, **HOW, name="floor", devices=["cpu"], dtypes=["float32"], jobs=["value"], most=10, runs=2
    )


def test_the_bounces_counted_are_those_of_simulate_batch(found):
    assert [(each.throws, each.device, each.dtype, each.job) for each in found.rows] == [
        (1, "cpu", "float32", "value"), (10, "cpu", "float32", "value"),
    ]  # fmt: skip
    for each in found.rows:
        states = jax.tree.map(lambda x: x.astype(jnp.float32), scattered(THROW, each.throws, 0))
        end = simulate_batch(SCENE, states, **HOW, log_size=0)
        assert each.bounces == int(end.n_impacts.sum()) >= each.throws
        assert each.failed == 0 and (end.result == RESULTS.reached_t1).all()


def test_a_row_has_all_its_parts(found):
    for each in found.rows:
        times = each[6:11]
        assert min(times) > 0.0 and all(math.isfinite(x) for x in times) and each.spread >= 0.0
        assert each.program_bytes is None or each.program_bytes > 36 * each.throws  # nine numbers each go in
    first, last = (each.stopped for each in found.rows)
    assert first == "" and last in ("most", "flat")  # a busy machine may find the rate flat
    assert found.scenes["floor"] == {**HOW, "motion": "Exact", "throws": found.scenes["floor"]["throws"]}
    assert "seed 0" in found.scenes["floor"]["throws"] and "JAX" in found.machine


def test_throws_that_do_not_come_to_the_end_are_counted():
    program = Program(case(SCENE, THROW, HOW | {"max_impacts": 1}), jax.devices(), "float64", "value", 3)
    assert program.failed == 3 and program.bounces == 3


def test_the_gradient_is_that_of_the_mean_squared_final_position():
    fall = {"t0": 0.0, "t1": 0.25, "max_impacts": 1}  # it does not arrive: x = x0 + t v + t^2 g / 2
    one = case(Scene(Ball(0.025, 0.046), {}), THROW, fall)
    program = Program(one, jax.devices(), "float64", "gradient", 4)
    slope, _ = program.call()
    states, t = one.draw(4), 0.25
    end = states.position + t * states.velocity + 0.5 * t**2 * jnp.array([[0.0, 0.0, -9.81]])
    assert np.asarray(slope.position) == pytest.approx(np.asarray(2 * end / 4), rel=1e-12)
    assert np.asarray(slope.velocity) == pytest.approx(np.asarray(2 * t * end / 4), rel=1e-12)
    assert (slope.spin == 0.0).all()


SHARED = """
import jax, numpy as np
jax.config.update("jax_enable_x64", True)
from nonholo_jax import Ball, BallState, Plane, Rough, Scene
from nonholo_jax._questions.bench import Program, case
scene = Scene(Ball(0.025, 0.046), {"floor": Plane((0, 0, 0), (0, 0, 1), Rough())})
throw = BallState([0.0, 0.0, 1.0], [1.0, 0.0, -2.0], [0.0, 5.0, 0.0])
one = case(scene, throw, {"t0": 0.0, "t1": 1.5, "max_impacts": 8})
for job in ("value", "gradient"):
    alone, shared = (Program(one, jax.devices()[:k], "float64", job, 5) for k in (1, 2))
    assert (len(alone.devices), len(shared.devices)) == (1, 2) and alone.bounces == shared.bounces > 5
    for x, y in zip(jax.tree.leaves(alone.call()), jax.tree.leaves(shared.call()), strict=True):
        assert len(y.sharding.device_set) == 2 and np.allclose(x, y[:5], rtol=1e-12, atol=1e-12)
print("alike")
"""


def test_devices_that_share_a_batch_compute_what_one_does():
    flags = f"--xla_force_host_platform_device_count=2 {os.environ.get('XLA_FLAGS', '')}"
    environment = os.environ | {"XLA_FLAGS": flags, "PYTHONPATH": str(Path(__file__).parents[2])}
    done = subprocess.run([sys.executable, "-c", SHARED], env=environment, capture_output=True, text=True)
    assert done.stdout == "alike\n", done.stderr


def test_scenes_may_differ_from_throw_to_throw():
    def draw(n):
        restitution = jnp.linspace(0.5, 1.0, n)
        floor = Plane((0, 0, 0), (0, 0, 1), Rough(restitution))
        return Scene(Ball(0.025, 0.046), {"floor": floor}), scattered(THROW, n, 0)

    found = bench(SCENE, draw=draw, **HOW, devices=["cpu"], dtypes=["float64"], jobs=["value"], most=1, runs=1)
    scene, states = draw(1)
    assert found.rows[0].bounces == int(simulate_batch(scene, states, scene_axes=0, **HOW).n_impacts.sum())


WRONG = {
    "devices": {"devices": ["abacus"]},
    "dtypes": {"dtypes": ["float16"]},
    "jobs": {"jobs": []},
    "most": {"most": 0},
    "runs": {"runs": 0},
    "seed": {"seed": -1},
    "t1": {"t1": 0.0},
    "throw": {"throw": None},
}


@pytest.mark.parametrize("name", WRONG)
def test_bad_arguments_are_named_in_one_line(name):
    given = {"scene": SCENE, "throw": THROW, "t1": 1.0} | WRONG[name]
    with pytest.raises(ValueError, match=f"^Argument `{name}` must .*, but got .*; try ") as caught:
        bench(given.pop("scene"), given.pop("throw"), **given)
    assert "\n" not in str(caught.value)


def test_what_belongs_to_a_scene_does_not_come_without_one():
    with pytest.raises(ValueError, match=r"^Argument `t1` must come with `scene`, but got float"):
        bench(t1=1.0)
