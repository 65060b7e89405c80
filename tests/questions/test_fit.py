"""Fits find what made the data, say how well they know it, and do not decide what the data leave open."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import norm

from nonholo_jax import Ball, BallState, Frictional, Plane, Rough, Scene, compare, fit, simulate_batch

RADIUS = 0.033
LAW = "surfaces.ground.law."
ANGLES = np.radians([20.0, 35.0, 45.0, 60.0])
THROWS = BallState(
    jnp.tile(jnp.array([[0.0, 0.0, RADIUS]]), (4, 1)),
    jnp.asarray(4.0 * np.stack([np.cos(ANGLES), 0 * ANGLES, -np.sin(ANGLES)], axis=-1)),
    jnp.zeros((4, 3)),
)


def after(trajectory):
    log = trajectory.impacts.after
    return jnp.stack([log.velocity[0, 0], log.velocity[0, 2], RADIUS * log.spin[0, 1]])


def room(law):
    return Scene(Ball(RADIUS, 0.057, 0.55), {"ground": Plane((0, 0, 0), (0, 0, 1), law)})


def measured(law):
    """What the law makes of the throws."""
    log = simulate_batch(room(law), THROWS, t1=1e-3, max_impacts=1).impacts.after
    velocity, spin = np.asarray(log.velocity[:, 0]), np.asarray(log.spin[:, 0])
    return np.stack([velocity[:, 0], velocity[:, 2], RADIUS * spin[:, 1]], axis=-1)


def run(law, data, free, **options):
    given = {"observe": after, "t1": 1e-3, "max_impacts": 1, "n_starts": 4} | options
    return fit(room(law), THROWS, data, free=[LAW + name for name in free], **given)


def test_what_made_the_data_is_found():
    found = run(
        Frictional(0.9, 0.0, 0.5), measured(Frictional(0.76, 0.11, 0.28)), ("restitution", "tangential", "friction")
    )
    assert np.allclose(found.values, [0.76, 0.11, 0.28], atol=1e-7)
    assert np.abs(found.residuals * found.spread).max() < 1e-7
    assert found.scene.surfaces[0].law.restitution == found.values[0] and found.n_measured == 12


def test_standard_errors_are_the_spread_of_repeated_fits():
    """Of estimates from forty noisy repetitions; the noise itself is estimated as well."""
    law, noise, rng = Rough(0.76, tangential=0.11), 0.05, np.random.default_rng(0)
    exact = measured(law)
    guess, two = Rough(0.7, tangential=0.2), ("restitution", "tangential")
    found = [run(guess, exact + noise * rng.standard_normal(exact.shape), two) for _ in range(40)]
    values = np.stack([each.values for each in found])
    errors = np.sqrt(np.mean([each.standard_errors**2 for each in found], axis=0))
    assert np.allclose(values.mean(axis=0), [0.76, 0.11], atol=4 * errors.max() / np.sqrt(40))
    assert np.allclose(values.std(axis=0, ddof=1), errors, rtol=0.45)
    assert np.isclose(np.sqrt(np.mean([each.spread**2 for each in found])), noise, rtol=0.15)
    known = run(Rough(0.7, tangential=0.2), exact, ("restitution", "tangential"), spread=noise)
    assert np.allclose(known.standard_errors, errors, rtol=0.1)


def test_the_criterion_is_that_of_the_normal_distribution():
    """AICc by SciPy's density, constants included: a given spread that is wrong loses against the right one, and fits
    of which only some were given a spread have no common measure."""
    data = measured(Rough(0.76)) + 0.05 * np.random.default_rng(2).standard_normal((4, 3))
    fits = {str(size): run(Rough(0.7), data, ["restitution"], spread=size) for size in (0.05, 0.5, 0.005)}
    fits["each"] = run(Rough(0.7), data, ["restitution"], spread=np.full((4, 3), 0.05))
    estimated = run(Rough(0.7), data, ["restitution"])
    for each, d in [*((each, 1) for each in fits.values()), (estimated, 2)]:
        misses = each.residuals * each.spread
        size = each.spread if d == 1 else np.sqrt(np.mean(misses**2))
        likelihood = norm.logpdf(misses, scale=size).sum()
        assert each.criterion == pytest.approx(2 * d - 2 * likelihood + 2 * d * (d + 1) / (12 - d - 1), rel=1e-12)
    apart = compare(fits).differences
    assert abs(apart["0.05"]) < 1e-9 and abs(apart["each"]) < 1e-9 and min(apart["0.5"], apart["0.005"]) > 10
    for mixed in ({"known": fits["0.05"], "not": estimated}, {"not": estimated, "known": fits["each"]}):
        with pytest.raises(ValueError, match="'known' was given one and 'not' estimated it"):
            compare(mixed)


def test_laws_are_preferred_only_where_the_data_tell():
    """Where all throws grip, friction does not show: its error is infinite, and the simpler law is as good."""
    rng = np.random.default_rng(1)
    two = ("restitution", "tangential")
    slips = measured(Frictional(0.76, 0.1, 0.2)) + 0.02 * rng.standard_normal((4, 3))
    fits = {
        "rough": run(Rough(0.7, tangential=0.2), slips, two),
        "frictional": run(Frictional(0.7, 0.1, 0.4), slips, ("restitution", "friction")),
    }
    assert compare(fits).verdict == "frictional" and compare(fits).weights["frictional"] > 0.99
    grips = measured(Rough(0.76, tangential=0.1)) + 0.02 * rng.standard_normal((4, 3))
    rough, strong = (
        run(Rough(0.7, tangential=0.2), grips, two),
        run(Frictional(0.7, 0.2, 2.0), grips, (*two, "friction")),
    )
    assert np.isinf(strong.standard_errors[2]) and np.allclose(strong.values[:2], rough.values, atol=1e-5)
    same = compare({"one": rough, "other": rough})
    assert same.verdict == "undecided" and same.weights == {"one": 0.5, "other": 0.5}


def test_missing_measurements_do_not_count():
    data = measured(Rough(0.76, tangential=0.11))
    data[1:, 2] = np.nan
    found = run(Rough(0.7, tangential=0.2), data, ("restitution", "tangential"))
    assert found.n_measured == 9 and np.isnan(found.residuals[1, 2])
    assert np.allclose(found.values, [0.76, 0.11], atol=1e-7)


def test_what_cannot_be_is_refused():
    data = measured(Rough(0.76))
    for change, words in (
        ({"free": [LAW + "restitutio"]}, "restitution"),
        ({"measured": data[:2]}, "row for each throw"),
        ({"measured": data[:, :2]}, "`observe`"),
        ({"measured": np.full((4, 3), np.nan)}, "freeing fewer"),
    ):
        given = {"measured": data, "free": [LAW + "restitution"], "observe": after, "t1": 1e-3} | change
        with pytest.raises(ValueError, match=words):
            fit(room(Rough(0.7)), THROWS, **given)
    with pytest.raises(ValueError, match="two"):
        compare({})
