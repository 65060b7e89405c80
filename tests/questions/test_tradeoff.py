"""Error against time: the errors are right, the front is a front, and the reference does not rest on itself."""

import json
import math

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nonholo_jax import Air, Ball, BallState, Frictional, Plane, Rough, Scene, Smooth, simulate_batch, tradeoff
from nonholo_jax._questions.fifty_digits import bounced, why_not

BALL = Ball(radius=0.025, mass=0.046)
FLOOR = Plane((0, 0, 0), (0, 0, 1), Rough(0.9, 0.5))
CEILING = Plane((0, 0, 1), (0, 0.1, -2), Frictional(0.8, 0.3, 0.2))
WALL = Plane((1, 0, 0), (-1, 0, 0), Smooth(0.7))
SURFACES = {"floor": FLOOR, "ceiling": CEILING, "wall": WALL}


def throws(n, seed=0):
    keys = jax.random.split(jax.random.key(seed), 3)
    position = jnp.array([[0.0, 0.0, 0.5]]) + jax.random.uniform(keys[0], (n, 3), minval=-0.2, maxval=0.2)
    velocity = jax.random.uniform(keys[1], (n, 3), minval=-4.0, maxval=4.0)
    return BallState(position, velocity, 50.0 * jax.random.normal(keys[2], (n, 3)))


OPTIONS = {"solvers": [diffrax.Tsit5()], "dtypes": ["float64"], "tolerances": (1e-4, 1e-6, 1e-8, 1e-10), "runs": 2}


@pytest.fixture(scope="module")
def with_air():
    scene = Scene(BALL, {"floor": FLOOR}, air=Air())
    values = tradeoff(scene, throws(8), t1=0.8, steps=(4, 8, 16), gradients=False, **OPTIONS)
    # The programs of gradients through impacts take a minute to compile; test_gradients.py holds those to the truth.
    in_flight = tradeoff(Scene(BALL, {}, air=Air()), throws(8), t1=0.8, steps=(), **OPTIONS)
    slopes = tuple(row for row in in_flight.rows if row.what == "gradient")
    return values._replace(rows=values.rows + slopes, gradient_error=in_flight.gradient_error)


@pytest.fixture(scope="module")
def without_air():
    return tradeoff(Scene(BALL, SURFACES), throws(32), t1=1.0, solvers=[], runs=2, gradients=False)


def ladder(found, steps, what):
    return [row for row in found.rows if (row.steps, row.what) == (steps, what)]


@pytest.mark.parametrize("what", ["value", "gradient"])
def test_errors_fall_with_the_tolerance(with_air, what):
    errors = [row.max_error for row in ladder(with_air, "adaptive", what)]
    assert len(errors) == 4 and errors == sorted(errors, reverse=True)
    assert errors[0] > 1e-6 and errors[-1] < 1e-8


def test_errors_fall_with_the_step_at_the_order_of_the_solver(with_air):
    rows = ladder(with_air, "fixed", "value")
    slope = np.polyfit(np.log([row.step for row in rows]), np.log([row.median_error for row in rows]), 1)[0]
    assert 4.5 < slope < 6.5


def test_every_row_says_what_it_is(with_air):
    for row in with_air.rows:
        assert row.median_error <= row.max_error and row.max_error_same <= row.max_error
        assert (row.tolerance is None) == (row.steps == "fixed") and (row.step is None) == (row.steps == "adaptive")
        assert row.n_other_itinerary == 0 and row.seconds_per_trajectory > 0 and row.spread >= 0
        assert row.method in row.label and row.dtype in row.label
    assert "Dopri8" in with_air.reference and "Tsit5" in with_air.reference and with_air.reference_error < 1e-11
    assert with_air.gradient_error < 1e-9 and not with_air.sum_trains


@pytest.mark.parametrize("what", ["value", "gradient"])
def test_the_front_is_a_front(with_air, what):
    front, rows = with_air.front(what), [row for row in with_air.rows if row.what == what]
    assert front
    for row, after in zip(front, front[1:], strict=False):
        assert after.max_error < row.max_error and after.seconds_per_trajectory >= row.seconds_per_trajectory
    for row in rows:
        assert any(
            each.max_error <= max(row.max_error, with_air.reference_error, with_air.gradient_error)
            and each.seconds_per_trajectory <= row.seconds_per_trajectory
            for each in front
        )


@pytest.mark.parametrize("error", [1e-3, 1e-6, 1e-9])
def test_the_cheapest_reaches_the_error_and_lies_on_the_front(with_air, error):
    cheapest = with_air.cheapest(error)
    assert cheapest.max_error <= error and cheapest in with_air.front()
    assert with_air.cheapest(0.0) is None or with_air.cheapest(0.0).max_error == 0.0


def test_the_report_survives_json(with_air):
    report = with_air.report()
    assert json.loads(json.dumps(report, allow_nan=False)) == json.loads(json.dumps(report))
    back = json.loads(json.dumps(report))
    assert [row["max_error"] for row in back["rows"]] == [row.max_error for row in with_air.rows]
    assert report["n_throws"] == 8 and "JAX" in report["machine"]
    failed = with_air._replace(rows=(with_air.rows[0]._replace(max_error=math.inf),))
    assert failed.report()["rows"][0]["max_error"] is None and failed.front() == [] and failed.cheapest(1.0) is None


def test_exact_is_held_to_fifty_digits(without_air):
    assert "mpmath at 50 digits" in without_air.reference and "16 throws" in without_air.reference
    assert without_air.reference_error < 1e-12
    double, single = without_air.rows
    assert (double.dtype, single.dtype) == ("float64", "float32") and double.max_error == 0.0
    assert 1e-8 < single.median_error < 1e-3


def test_fifty_digits_bounce_as_exact_does():
    scene, states = Scene(BALL, SURFACES), throws(32)
    end = simulate_batch(scene, states, t1=1.0, log_size=0, sum_trains=False)
    counts = []
    for i in range(16):
        position, count = bounced(scene, jax.tree.map(lambda x, i=i: x[i], states), 0.0, 1.0, 64)
        counts.append(count)
        assert count == end.n_impacts[i]
        assert np.linalg.norm(position - end.final.position[i]) < 1e-12
    assert max(counts) >= 3 and bounced(scene, jax.tree.map(lambda x: x[0], states), 0.0, 5.0, 1) is None


def test_fifty_digits_know_what_they_cannot_do():
    assert why_not(Scene(BALL, SURFACES)) is None
    assert "parabolas" in why_not(Scene(BALL, SURFACES, air=Air()))


def test_bounces_that_die_out_are_summed_where_there_are_some():
    scene = Scene(BALL, {"floor": Plane((0, 0, 0), (0, 0, 1), Rough(0.3))})
    found = tradeoff(scene, throws(4), t1=2.0, solvers=[], dtypes=["float64"], gradients=False, runs=1, max_impacts=16)
    assert found.sum_trains and found.rows[0].n_other_itinerary == 0
    assert "the sample has trains" in found.reference and found.reference_error < 1e-6


WRONG = {
    "states": {"states": BallState(jnp.ones((4, 3), jnp.float32), jnp.ones((4, 3)), jnp.ones((4, 3)))},
    "state.position": {"states": BallState(jnp.ones(3), jnp.ones(3), jnp.ones(3))},
    "t1": {"t1": 0.0},
    "solver": {"solvers": [diffrax.Kvaerno5()]},
    "solvers": {"solvers": [diffrax.Tsit5(), diffrax.Tsit5()]},
    "dtypes": {"dtypes": ["float16"]},
    "tolerances": {"tolerances": [0.0]},
    "steps": {"steps": [-1]},
    "runs": {"runs": 0},
}


@pytest.mark.parametrize("name", WRONG)
def test_bad_arguments_are_named_in_one_line(name):
    arguments = {"scene": Scene(BALL, SURFACES), "states": throws(4), "t1": 1.0} | WRONG[name]
    with pytest.raises(ValueError, match=f"^Argument `{name}` must .*, but got .*; try ") as caught:
        tradeoff(arguments.pop("scene"), arguments.pop("states"), **arguments)
    assert "\n" not in str(caught.value)
