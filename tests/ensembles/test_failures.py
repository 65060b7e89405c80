"""A throw that failed stays where it stopped, or does not move at all: it is in no number but the count of failures."""

import jax.numpy as jnp
import numpy as np
import pytest

from nonholo_jax import (
    Ball,
    BallState,
    FinalPosition,
    ImpactCount,
    Landing,
    Normal,
    Plane,
    Rough,
    Sampler,
    Scene,
    SimulationError,
    Uniform,
    Vary,
    expectation,
    monte_carlo,
    propagate,
)

R, G, T1, N = 0.025, 9.81, 0.8, 2000
FALL = np.sqrt(2 * (1 - R) / G)
OVER = "of 2000 throws failed"


def scene(e):
    return Scene(Ball(R, 0.046), {"floor": Plane((0, 0, 0), (0, 0, 1), Rough(e))})


def sampler(dtype=np.float64, low=0.9, high=1.05):
    """A third of the restitutions, those above 1, are not admissible."""
    vectors = ([0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0])
    throw = BallState(*(jnp.asarray(x, dtype) for x in vectors))
    return Sampler(throw, [Vary("surfaces.floor.law.restitution", Uniform(low, high))])


def height(e):
    """Where a ball is at T1 that fell at rest and bounced once with restitution e."""
    return R + e * G * FALL * (T1 - FALL) - 0.5 * G * (T1 - FALL) ** 2


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    measures = {"end": FinalPosition(), "high": lambda t: t.final.position[2] > height(0.95), "n": ImpactCount()}
    kept = {"out": tmp_path_factory.mktemp("study") / "kept", "records": "all"}
    with pytest.warns(UserWarning, match=OVER):
        return monte_carlo(scene(0.95), sampler(), n=N, key=0, t1=T1, measures=measures, chunk=512, **kept)


def test_means_are_those_of_the_others(study):
    """Of e uniform from 0.9 to 1, in closed form, which the standard error then covers."""
    (failed,) = study.failures
    assert failed.what == "invalid_state" and abs(failed.probability - 1 / 3) < 4 * failed.standard_error
    assert study.present("end.z") == study.present("high") == study.present("n") == N - failed.count
    assert abs(study.mean("end.z") - height(0.95)) < 4 * study.standard_error("end.z")
    spread = G * FALL * (T1 - FALL) * 0.1 / np.sqrt(12)
    assert abs(study.standard_deviation("end.z") / spread - 1) < 0.05
    assert abs(study.quantile("end.z", 0.5)[0] - height(0.95)) < 4 * study.quantile("end.z", 0.5)[1]
    assert study.extremes("end.z")[1][0] < height(1.0) < 1.0  # the failed ones would be at 1 m
    assert study.mean("n") == 1.0
    p, error = study.probability("high")
    assert abs(p - 0.5) < 4 * error


def test_itineraries_and_records_leave_them_out(study):
    (way,) = study.itineraries
    assert way.what == ("floor",) and way.count == N - study.failures[0].count and way.probability == 1.0
    table = study.records(["surfaces.floor.law.restitution", "end.z", "high", "result"]).to_pydict()
    for e, z, high, result in zip(*table.values(), strict=True):
        failed = e > 1
        assert failed == (result == "invalid_state") == np.isnan(z) == (high is None)
        assert failed or z == pytest.approx(height(e), abs=1e-12)


def test_single_precision():
    with pytest.warns(UserWarning, match=OVER):
        found = monte_carlo(scene(0.95), sampler(np.float32), n=N, key=1, t1=T1, measures={"end": FinalPosition()})
    assert abs(found.mean("end.z") - height(0.95)) < 4 * found.standard_error("end.z")


def test_expected_values_and_their_slopes():
    """The restitution is shifted by the parameter: d height / d e is the same for every throw that counts."""
    throws = Sampler(sampler().throw, [Vary("surfaces.floor.law.restitution", Normal(std=0.05))])
    build = lambda e: (scene(e), throws)  # noqa: E731
    with pytest.warns(UserWarning, match=OVER):
        found = expectation(build, jnp.asarray(0.98), lambda t: t.final.position[2], n=N, key=0, t1=T1)
    assert float(found.gradient) == pytest.approx(G * FALL * (T1 - FALL), rel=1e-9)
    assert found.value < height(1.0)


def test_a_central_throw_that_fails_is_refused():
    """There is nothing to propagate from."""
    measures = {"landing": Landing("floor"), "end": FinalPosition()}
    with pytest.raises(SimulationError, match="invalid_state"):
        propagate(scene(0.95), sampler(low=1.0, high=1.2), measures=measures, t1=T1)
