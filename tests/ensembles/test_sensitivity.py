"""Propagation, gradients of expected values and Sobol indices, held to closed forms and to large studies."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from nonholo_jax import (
    Ball,
    BallState,
    Correlated,
    FinalPosition,
    Landing,
    LogNormal,
    Measured,
    Normal,
    Plane,
    Returns,
    Rough,
    Sampler,
    Scene,
    TruncatedNormal,
    Uniform,
    Vary,
    expectation,
    monte_carlo,
    propagate,
    sobol_indices,
)

G = 9.81
SCENE = Scene(Ball(0.025, 0.046), {"floor": Plane((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), Rough(0.8))})
THROW = BallState([0.0, 0.0, 1.0], [1.0, 0.0, 0.5], [0.0, 0.0, 0.0])
COVARIANCE = [[0.0004, 0.0002], [0.0002, 0.0009]]
SAMPLER = Sampler(
    THROW, [Vary(["velocity.x", "velocity.z"], Correlated(COVARIANCE)), Vary("position.z", Uniform(0.98, 1.02))]
)


def landing(vx, vz, z):
    return vx * (vz + np.sqrt(vz**2 + 2 * G * (z - 0.025))) / G


def test_propagation_is_the_textbook_s():
    """Jacobian by differences of the closed form, covariance J S J^T, spread of a uniform number included."""
    found = propagate(SCENE, SAMPLER, measures={"landing": Landing("floor")}, t1=1.2)
    center, step = np.array([1.0, 0.5, 1.0]), 1e-6
    slope = [(landing(*(center + step * e)) - landing(*(center - step * e))) / (2 * step) for e in np.eye(3)]
    i = found.names.index("landing.x")
    assert found.itinerary == ("floor",) and found.inputs == (
        "throw.velocity.x",
        "throw.velocity.z",
        "throw.position.z",
    )
    assert np.isclose(found.mean[i], landing(*center), rtol=1e-14)
    assert np.allclose(found.jacobian[i], slope, rtol=1e-8)
    spread = np.zeros((3, 3))
    spread[:2, :2], spread[2, 2] = COVARIANCE, 0.04**2 / 12
    assert np.isclose(found.standard_deviation("landing.x"), np.sqrt(np.array(slope) @ spread @ slope), rtol=1e-8)
    assert np.isclose(found.parts("landing.x")["throw.position.z"], abs(slope[2]) * 0.04 / np.sqrt(12), rtol=1e-8)


def test_a_study_agrees_until_itineraries_change():
    measures = {"landing": Landing("floor"), "near": Returns([0.5, 0.0, 0.2], within=0.1)}
    options = {"measures": measures, "t1": 1.2, "max_impacts": 8}
    linear = propagate(SCENE, SAMPLER, **options)
    assert "near" not in linear.names
    assert linear.against(monte_carlo(SCENE, SAMPLER, n=4000, key=0, **options)) == []
    wall = Scene(
        SCENE.ball,
        dict(zip(SCENE.names, SCENE.surfaces, strict=True))
        | {"wall": Plane((0.58, 0.0, 0.0), (-1.0, 0.0, 0.0), Rough(0.8))},
    )
    sampler = Sampler(THROW, [Vary("velocity.x", Normal(0.1))])
    warned = propagate(wall, sampler, **options).against(monte_carlo(wall, sampler, n=4000, key=0, **options))
    assert warned and any("landing.x: standard deviation" in line and "other ways" in line for line in warned), warned


MOMENTS = {
    "normal": (Normal([0.1, 0.2], mean=[1.0, 2.0]), None),
    "uniform": (Uniform([0.0, 1.0], [0.5, 3.0]), None),
    "lognormal": (LogNormal(0.3), None),
    "truncated": (TruncatedNormal(1.0, [0.0, 0.5], 2.5), None),
    "correlated": (Correlated(COVARIANCE), None),
    "measured": (Measured([[0.0, 1.0], [2.0, 4.0], [3.0, 1.5]]), None),
}


@pytest.mark.parametrize("name", MOMENTS)
def test_moments_are_those_of_the_values(name):
    """Against means over a quasi-random sequence."""
    distribution, _ = MOMENTS[name]
    u = stats.qmc.Sobol(distribution.n_uniform(2), rng=np.random.default_rng(0)).random(2**14)
    center = np.array([1.0, 2.0])
    values = np.asarray(jax.vmap(lambda u: distribution.values(u, jnp.asarray(center)))(jnp.clip(u, 1e-9, 1 - 1e-9)))
    mean, covariance = distribution.moments(center)
    assert np.allclose(values.mean(axis=0), mean, rtol=1e-3, atol=1e-4)
    assert np.allclose(np.cov(values.T), covariance, rtol=5e-3, atol=2e-3 * np.abs(covariance).max())


def test_gradient_of_an_expected_value():
    """Of the mean height, in a restitution and in the spread and the mean of the throws: within its standard errors of
    differences of a large study with the same throws, and of a closed form."""

    def build(theta):
        law = Rough(theta["restitution"])
        scene = Scene(SCENE.ball, {"floor": Plane((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), law)})
        vary = [Vary("velocity.x", Normal(theta["spread"])), Vary("velocity.z", Normal(0.05, mean=theta["mean"]))]
        return scene, Sampler(THROW, vary)

    theta = {"restitution": jnp.asarray(0.8), "spread": jnp.asarray(0.3), "mean": jnp.asarray(0.5)}
    measure = lambda trajectory: trajectory.final.position[2] + trajectory.final.position[0] ** 2  # noqa: E731
    options = {"n": 5000, "key": 1, "t1": 0.8}
    found = expectation(build, theta, measure, **options)
    for name, step in (("restitution", 1e-4), ("spread", 1e-4), ("mean", 1e-4)):
        up, down = ({**theta, name: theta[name] + sign * step} for sign in (1.0, -1.0))
        ends = [expectation(build, each, measure, **options).value for each in (up, down)]
        assert np.isclose(found.gradient[name], (ends[0] - ends[1]) / (2 * step), rtol=1e-5, atol=1e-6), name
        assert 0 < found.gradient_standard_error[name] < 0.1
    assert found.standard_error < 0.02
    # E x^2 with x = vx T on the way to the floor, which no throw reaches by then: its slope is 2 spread T^2.
    square = lambda trajectory: trajectory.final.position[0] ** 2  # noqa: E731
    early = expectation(build, theta, square, n=20_000, key=2, t1=0.3)
    error = early.gradient_standard_error["spread"]
    assert abs(float(early.gradient["spread"]) - 2 * 0.3 * 0.3**2) < 5 * error and error < 2e-3
    # A great number beside x costs its spread no digits: it is spread T.
    far = expectation(build, theta, lambda trajectory: 1e9 + trajectory.final.position[0], n=4000, key=2, t1=0.3)
    assert np.isclose(far.standard_error, 0.3 * 0.3 / np.sqrt(4000), rtol=0.05)


def test_sobol_indices_of_a_sum_of_squares(tmp_path):
    """Position at the end of a flight: x = vx T, y = vy T, z + vz T - g T^2/2; of x + 2 y^2 the parts are known."""
    sampler = lambda sequence: Sampler(THROW, [Vary("velocity", Uniform(-1.0, 1.0))], sequence)  # noqa: E731
    end = lambda trajectory: trajectory.final.position[0] + 2.0 * trajectory.final.position[1] ** 2  # noqa: E731
    options = {"measures": {"end": end, "place": FinalPosition()}, "t1": 0.2, "records": "all"}
    t = 0.2
    a, b = t**2 / 3, 4 * t**4 * (1 / 5 - 1 / 9)
    wanted = np.array([a, b, 0.0]) / (a + b)
    exact = monte_carlo(SCENE, sampler("saltelli"), n=5 * 2048, key=0, out=tmp_path / "s", **options)
    found = sobol_indices(exact, "end")
    assert found.names == ("throw.velocity.x", "throw.velocity.y", "throw.velocity.z")
    assert np.allclose(found.first, wanted, atol=0.02) and np.allclose(found.total, wanted, atol=0.02)
    random = monte_carlo(SCENE, sampler("random"), n=8192, key=0, out=tmp_path / "r", **options)
    given = sobol_indices(random, "end")
    assert np.allclose(given.first, wanted, atol=0.04) and given.total is None
    none = monte_carlo(SCENE, sampler("random"), n=100, key=0, t1=0.2)
    with pytest.raises(ValueError, match="records"):
        sobol_indices(none, "impacts")
