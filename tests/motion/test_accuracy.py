"""`accuracy=`: the error asked for is reached, and what cannot be reached is refused."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nonholo_jax import Air, Ball, BallState, Exact, Integrated, Plane, Rough, Scene, simulate, simulate_batch
from nonholo_jax._motion.accuracy import motion_for

FLOOR = {"floor": Plane((0, 0, 0), (0, 0, 1), Rough(0.9, 0.5))}
BALL = Ball(radius=0.025, mass=0.046)
AIR, VACUUM = Scene(BALL, FLOOR, air=Air()), Scene(BALL, FLOOR)
THROW = BallState([0.0, 0.0, 1.0], [2.0, 1.0, -1.0], [0.0, 50.0, 0.0])
ONE = BallState([[0.0, 0.0, 1.0]], [[2.0, 1.0, -1.0]], [[0.0, 50.0, 0.0]])
OPTIONS = {"t1": 1.0, "log_size": 0, "sum_trains": False}


def picked(accuracy, t1=1.0, scene=AIR, state=THROW, closed_form=False):
    return motion_for(scene, accuracy, state, 0.0, t1, closed_form=closed_form)


@pytest.fixture(scope="module")
def throws():
    keys = jax.random.split(jax.random.key(0), 3)
    position = jnp.array([[0.0, 0.0, 0.7]]) + jax.random.uniform(keys[0], (16, 3), minval=-0.3, maxval=0.3)
    velocity = jax.random.uniform(keys[1], (16, 3), minval=-5.0, maxval=5.0)
    return BallState(position, velocity, 50.0 * jax.random.normal(keys[2], (16, 3)))


@pytest.fixture(scope="module")
def truth(throws):
    motion = Integrated(solver=diffrax.Dopri5(), rtol=1e-13, atol=1e-13)
    return simulate_batch(AIR, throws, motion=motion, **OPTIONS).final.position


@pytest.mark.parametrize("accuracy, solver", [(1e-4, diffrax.Tsit5), (1e-9, diffrax.Dopri8)])
def test_reaches_the_error_that_is_asked_for(throws, truth, accuracy, solver):
    end = simulate_batch(AIR, throws, accuracy=accuracy, **OPTIONS)
    assert isinstance(end.motion.solver, solver)
    error = np.linalg.norm(end.final.position - truth, axis=1)
    assert error.max() <= accuracy
    assert error.max() >= 1e-5 * accuracy  # it does not do what nobody asked for


def test_exact_where_the_scene_allows_it():
    assert isinstance(picked(1e-6, closed_form=True), Exact)
    assert isinstance(simulate_batch(VACUUM, ONE, accuracy=1e-6, **OPTIONS).motion, Exact)


def test_tolerances_fall_with_the_error_and_with_the_duration():
    tolerance = lambda *args: float(picked(*args).stepsize_controller.atol)  # noqa: E731
    ladder = [tolerance(10.0**-k) for k in range(2, 12)]
    assert ladder == sorted(ladder, reverse=True) and ladder[-1] > 0
    assert tolerance(1e-6, 4.0) < tolerance(1e-6, 2.0) < tolerance(1e-6, 1.0) == tolerance(1e-6, 0.5)


def test_the_tolerance_follows_a_traced_duration():
    traced = jax.jit(lambda t1: picked(1e-6, t1).stepsize_controller.atol)(jnp.asarray(3.0))
    assert traced == pytest.approx(float(picked(1e-6, 3.0).stepsize_controller.atol), rel=1e-12)
    shape = jax.eval_shape(lambda state: simulate(AIR, state, accuracy=1e-6, **OPTIONS).final.position, THROW)
    assert shape.shape == (3,)


def test_float32_keeps_its_dtype():
    single = jax.tree.map(lambda x: x.astype(jnp.float32), THROW)
    assert picked(1e-3, state=single).stepsize_controller.atol.dtype == jnp.float32


SINGLE = jax.tree.map(lambda x: x.astype(jnp.float32), THROW)
REFUSED = {
    "with a motion": ({"accuracy": 1e-6, "motion": Exact()}, THROW, "without `motion`"),
    "zero": ({"accuracy": 0.0}, THROW, "positive number.*got 0.0"),
    "negative": ({"accuracy": -1e-6}, THROW, "positive number.*got -1e-06"),
    "not finite": ({"accuracy": float("nan")}, THROW, "positive number.*got nan"),
    "beyond float32": ({"accuracy": 1e-6}, SINGLE, "float32.*got 1e-06; try states in float64"),
    "beyond float64": ({"accuracy": 1e-15}, THROW, "float64.*got 1e-15; try accuracy="),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_cannot_be_is_refused_in_one_line(name):
    how, state, words = REFUSED[name]
    with pytest.raises(ValueError, match=f"^Argument `accuracy` must .*{words}") as caught:
        simulate(AIR, state, **how, **OPTIONS)
    assert "\n" not in str(caught.value) and "; try " in str(caught.value)
