"""Distributions are their quantile functions: held to SciPy's, and differentiable in their own numbers."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from nonholo_jax import Correlated, LogNormal, Measured, Normal, TruncatedNormal, Uniform
from nonholo_jax._ensembles.sampler import sobol, uniforms

U = np.array([1e-12, 1e-6, 0.01, 0.3, 0.5, 0.7, 0.99, 1.0 - 1e-6, 1.0 - 1e-12])
CENTER = 2.0
CASES = {
    "normal": (lambda: Normal(0.3), stats.norm(CENTER, 0.3)),
    "normal, mean": (lambda: Normal(0.3, mean=-1.0), stats.norm(-1.0, 0.3)),
    "uniform": (lambda: Uniform(0.5, 0.75), stats.uniform(0.5, 0.25)),
    "lognormal": (lambda: LogNormal(0.1), stats.lognorm(0.1, scale=CENTER)),
    "truncated": (lambda: TruncatedNormal(0.5, 1.5, 2.2), stats.truncnorm(-1.0, 0.4, CENTER, 0.5)),
    "upper tail": (lambda: TruncatedNormal(0.1, 2.5, 3.0), stats.truncnorm(5.0, 10.0, CENTER, 0.1)),
    "lower tail": (lambda: TruncatedNormal(0.1, 1.0, 1.5), stats.truncnorm(-10.0, -5.0, CENTER, 0.1)),
}


@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_values_are_quantiles(name, dtype):
    make, law = CASES[name]
    eps = float(np.finfo(dtype).eps)
    u = U[(eps < U) & (1.0 - eps > U)].astype(dtype)
    values = jax.vmap(lambda u: make().values(u[None], jnp.full((1,), CENTER, dtype)))(jnp.asarray(u))[:, 0]
    assert values.dtype == dtype
    assert np.allclose(values, law.ppf(u.astype(float)), rtol=200 * eps)


@pytest.mark.parametrize("name", CASES)
def test_slopes_in_their_numbers(name):
    """With the uniform numbers held fixed, both modes equal central differences."""
    distribution = CASES[name][0]()
    leaves, tree = jax.tree.flatten(distribution)
    u, center = jnp.asarray([0.23]), jnp.full((1,), CENTER)

    def value(numbers):
        return jax.tree.unflatten(tree, [x[None] for x in numbers]).values(u, center)[0]

    numbers = jnp.stack([leaf[0] for leaf in leaves])
    step = 1e-6
    slopes = [
        (value(numbers.at[i].add(step)) - value(numbers.at[i].add(-step))) / (2 * step) for i in range(len(leaves))
    ]
    for mode in (jax.jacfwd, jax.jacrev):
        assert np.allclose(mode(value)(numbers), np.asarray(slopes), rtol=1e-6, atol=1e-8)


def test_covariance_is_kept(getkey):
    covariance = np.array([[0.04, -0.018, 0.0], [-0.018, 0.09, 0.01], [0.0, 0.01, 0.02]])
    distribution = Correlated(covariance)
    root = np.asarray(distribution.root)
    assert np.allclose(root @ root.T, covariance, atol=1e-16)
    u = jax.random.uniform(getkey(), (20_000, 3), minval=1e-9)
    values = np.asarray(jax.vmap(lambda u: distribution.values(u, jnp.array([1.0, 2.0, 3.0])))(u))
    error = np.sqrt(2.0 / len(u)) * 0.09
    assert np.allclose(np.cov(values.T), covariance, atol=5 * error)
    assert np.allclose(values.mean(axis=0), [1.0, 2.0, 3.0], atol=5 * 0.3 / np.sqrt(len(u)))


def test_a_degenerate_covariance_stays_on_its_line():
    distribution = Correlated([[1.0, 2.0], [2.0, 4.0]])
    values = distribution.values(jnp.array([0.2, 0.9]), jnp.zeros(2))
    assert np.isclose(values[1], 2.0 * values[0], atol=1e-7)


def test_measured_rows_come_whole_and_evenly():
    rows = np.arange(12.0).reshape(4, 3)
    drawn = np.stack(
        [Measured(rows).values(jnp.asarray([u]), jnp.zeros(3)) for u in (0.01, 0.26, 0.51, 0.76, 0.9999999)]
    )
    assert np.array_equal(drawn, rows[[0, 1, 2, 3, 3]])


WRONG = {
    "spread below 0": (lambda: Normal(-0.1), "at least 0"),
    "spread not finite": (lambda: LogNormal(np.inf), "finite"),
    "median": (lambda: LogNormal(0.1, median=0.0), "positive"),
    "order": (lambda: Uniform(1.0, 0.0), "at most `high`"),
    "no room": (lambda: TruncatedNormal(0.1, 1.0, 1.0), "below `high`"),
    "not square": (lambda: Correlated([[1.0, 0.0]]), "square"),
    "not symmetric": (lambda: Correlated([[1.0, 0.5], [0.0, 1.0]]), "symmetric"),
    "not semidefinite": (lambda: Correlated([[1.0, 2.0], [2.0, 1.0]]), "eigenvalue -1"),
    "no rows": (lambda: Measured(np.zeros((0, 2))), "table"),
}


@pytest.mark.parametrize("name", WRONG)
def test_what_cannot_be_is_refused(name):
    make, words = WRONG[name]
    with pytest.raises(ValueError, match=words) as error:
        make()
    assert "but got" in str(error.value) and "try" in str(error.value)


def test_tables_are_read_and_faults_have_their_line(tmp_path):
    import pyarrow as pa
    from pyarrow import parquet

    path = tmp_path / "throws.csv"
    path.write_text("vx,vy,vz\n1.0,2.0,3.0\n\n4.0,5.0,6.0\n")
    assert np.array_equal(Measured.read(path, ["vz", "vx"]).rows, [[3.0, 1.0], [6.0, 4.0]])
    parquet.write_table(pa.table({"a": [1.0, 2.0], "b": [3.0, 4.0]}), tmp_path / "throws.parquet")
    assert np.array_equal(Measured.read(tmp_path / "throws.parquet", ["b"]).rows, [[3.0], [4.0]])
    for text, words in (("vx\n1.0\nfast\n", "line 3"), ("vx\n1.0\nnan\n", "line 3"), ("vy\n1.0\n", "'vx'"),
                        ("", "empty"), ("vx\n", "row")):  # fmt: skip
        path.write_text(text)
        with pytest.raises(ValueError, match=words):
            Measured.read(path, ["vx"])
    with pytest.raises(ValueError, match="No such file"):
        Measured.read(tmp_path / "none.csv", ["vx"])


def test_uniform_numbers_depend_on_key_and_index_alone(getkey):
    key = getkey()
    at = lambda high, low: uniforms(key, (jnp.uint32(high), jnp.uint32(low)), (3,), jnp.float64)  # noqa: E731
    many = jax.vmap(lambda low: uniforms(key, (jnp.uint32(0), low), (3,), jnp.float64))(jnp.arange(5, dtype=jnp.uint32))
    assert np.array_equal(many[3], at(0, 3))
    assert not np.array_equal(at(0, 3), at(1, 3))


def test_sobol_numbers_do_not_know_of_chunks():
    whole = sobol([1, 2], 4, 0, 100, np.float64)
    assert np.array_equal(whole[37:61], sobol([1, 2], 4, 37, 24, np.float64))
    assert abs(sobol([1, 2], 4, 0, 4096, np.float64).mean() - 0.5) < 1e-4
