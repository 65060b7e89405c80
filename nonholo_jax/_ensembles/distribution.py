"""Distributions of the numbers of a throw or a scene, each a map from uniform numbers in (0, 1)."""

import csv
from abc import abstractmethod
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import ndtr, ndtri
from jaxtyping import Array, Float


def _row(x: Any) -> Any:
    """An array of one number for each value; Python numbers become float64 or what JAX has for it."""
    return jnp.atleast_1d(jnp.asarray(x, dtype=None if isinstance(x, jax.Array) else float))


def _require(fits: bool, name: str, requirement: str, value: Any, remedy: str) -> None:
    if not fits:
        raise ValueError(f"Argument `{name}` must {requirement}, but got {value}; try {remedy}.")


def _known(x: Any) -> bool:
    return not isinstance(x, jax.core.Tracer)


def _spread(name: str, x: Any) -> Any:
    x = _row(x)
    fits = not _known(x) or bool(jnp.all(jnp.isfinite(x) & (x >= 0)))
    _require(fits, name, "be finite and at least 0", _shown(x), f"{name}=0.1")
    return x


def _finite(name: str, x: Any) -> Any:
    x = _row(x)
    _require(not _known(x) or bool(jnp.all(jnp.isfinite(x))), name, "be finite", _shown(x), f"{name}=0.0")
    return x


def _shown(x: Any) -> str:
    if not _known(x):
        return "a traced array"
    values = np.asarray(x).tolist()
    return str(values[0] if len(values) == 1 else values)


class AbstractDistribution(eqx.Module):
    """How some numbers vary. `values(u, center)` maps `n_uniform(n)` independent uniform numbers in (0, 1) to `n`
    values; `center` holds the numbers of the scene or throw themselves, about which a distribution may vary.

    The map is differentiable in the distribution's own numbers, so that the gradient of an expected value can be taken
    with the uniform numbers held fixed (reparametrisation)."""

    @abstractmethod
    def n_uniform(self, n: int) -> int:
        """How many uniform numbers `n` values take."""

    @abstractmethod
    def values(self, u: Float[Array, " k"], center: Float[Array, " n"]) -> Float[Array, " n"]:
        """The values of one throw."""

    @abstractmethod
    def moments(self, center: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Mean, shape (n,), and covariance, shape (n, n)."""

    def check(self, n: int) -> None:
        """Raises `ValueError` where it does not fit `n` numbers."""


def _fits(n: int, **rows: Any) -> None:
    for name, row in rows.items():
        if row is not None and row.shape[0] not in (1, n):
            raise ValueError(
                f"Argument `{name}` must have 1 or {n} components, one for each name, but got {row.shape[0]}; try one."
            )


def _center(given: Any, center: Any) -> Any:
    return center if given is None else given.astype(center.dtype)


def _mean(given: Any, center: np.ndarray) -> np.ndarray:
    return center if given is None else np.broadcast_to(np.asarray(given), center.shape)


def _moments(mean: np.ndarray, variance: Any) -> tuple[np.ndarray, np.ndarray]:
    """Of independent numbers."""
    return mean, np.diag(np.broadcast_to(variance, mean.shape))


class Normal(AbstractDistribution):
    """Normal with `std` about `mean`; `None` for the value that the scene or the throw has. Each of one component, or
    one for each name; independent of each other. Raises `ValueError` for a spread below 0.

    ```python
    from nonholo_jax import Normal
    Normal(std=0.05)                                         # m/s, for names=["velocity"]
    ```
    """

    std: Float[Array, " n"]
    mean: Float[Array, " n"] | None = None

    def __init__(self, std: Any, mean: Any = None):
        self.std = _spread("std", std)
        self.mean = None if mean is None else _finite("mean", mean)

    def n_uniform(self, n):
        return n

    def values(self, u, center):
        return _center(self.mean, center) + self.std.astype(u.dtype) * ndtri(u)

    def moments(self, center):
        return _moments(_mean(self.mean, center), np.asarray(self.std) ** 2)

    def check(self, n):
        _fits(n, std=self.std, mean=self.mean)


class Uniform(AbstractDistribution):
    """Uniform between `low` and `high`. Raises `ValueError` unless low <= high.

    ```python
    from nonholo_jax import Uniform
    Uniform(0.7, 0.9)                                        # for names=["surfaces.floor.law.restitution"]
    ```
    """

    low: Float[Array, " n"]
    high: Float[Array, " n"]

    def __init__(self, low: Any, high: Any):
        self.low, self.high = _finite("low", low), _finite("high", high)
        if _known(self.low) and _known(self.high):
            _require(bool(jnp.all(self.low <= self.high)), "low", "be at most `high`", f"{low} and {high}", "low=0.0")

    def n_uniform(self, n):
        return n

    def values(self, u, center):
        low, high = self.low.astype(u.dtype), self.high.astype(u.dtype)
        return low + (high - low) * u

    def moments(self, center):
        low, high = np.asarray(self.low), np.asarray(self.high)
        return _moments(np.broadcast_to(0.5 * (low + high), center.shape), (high - low) ** 2 / 12.0)

    def check(self, n):
        _fits(n, low=self.low, high=self.high)


class LogNormal(AbstractDistribution):
    """The logarithm is normal with standard deviation `sigma` about that of `median`; `None` for the value that the
    scene or the throw has. Raises `ValueError` for a spread below 0 or a median that is not positive.

    ```python
    from nonholo_jax import LogNormal
    LogNormal(sigma=0.02)                                    # 2 percent, for names=["ball.radius"]
    ```
    """

    sigma: Float[Array, " n"]
    median: Float[Array, " n"] | None = None

    def __init__(self, sigma: Any, median: Any = None):
        self.sigma = _spread("sigma", sigma)
        self.median = None if median is None else _finite("median", median)
        if self.median is not None and _known(self.median):
            _require(bool(jnp.all(self.median > 0)), "median", "be positive", median, "median=1.0")

    def n_uniform(self, n):
        return n

    def values(self, u, center):
        return _center(self.median, center) * jnp.exp(self.sigma.astype(u.dtype) * ndtri(u))

    def moments(self, center):
        median, square = _mean(self.median, center), np.asarray(self.sigma) ** 2
        mean = median * np.exp(0.5 * square)
        return _moments(mean, mean**2 * np.expm1(square))

    def check(self, n):
        _fits(n, sigma=self.sigma, median=self.median)


class TruncatedNormal(AbstractDistribution):
    """Normal with `std` about `mean`, given that it is between `low` and `high`; `mean` `None` for the value that the
    scene or the throw has. Raises `ValueError` for a spread that is not positive and unless low < high.

    ```python
    from nonholo_jax import TruncatedNormal
    TruncatedNormal(std=0.1, low=0.0, high=1.0)              # for a restitution
    ```
    """

    std: Float[Array, " n"]
    low: Float[Array, " n"]
    high: Float[Array, " n"]
    mean: Float[Array, " n"] | None = None

    def __init__(self, std: Any, low: Any, high: Any, mean: Any = None):
        self.std, self.low, self.high = _spread("std", std), _row(low), _row(high)
        self.mean = None if mean is None else _finite("mean", mean)
        if _known(self.std):
            _require(bool(jnp.all(self.std > 0)), "std", "be positive", _shown(self.std), "std=0.1")
        if _known(self.low) and _known(self.high):
            _require(bool(jnp.all(self.low < self.high)), "low", "be below `high`", f"{low} and {high}", "low=0.0")

    def n_uniform(self, n):
        return n

    def values(self, u, center):
        mean, std = _center(self.mean, center), self.std.astype(u.dtype)
        low, high = ((x.astype(u.dtype) - mean) / std for x in (self.low, self.high))
        # In the tail that is nearer to 0, where probabilities keep their digits.
        flip = low + high > 0
        a, b = jnp.where(flip, -high, low), jnp.where(flip, -low, high)
        part = jnp.where(flip, 1.0 - u, u)
        z = ndtri(ndtr(a) + part * (ndtr(b) - ndtr(a)))
        return jnp.clip(mean + std * jnp.where(flip, -z, z), self.low.astype(u.dtype), self.high.astype(u.dtype))

    def moments(self, center):
        from scipy.stats import truncnorm

        mean, std = _mean(self.mean, center), np.asarray(self.std)
        ends = [(np.asarray(x) - mean) / std for x in (self.low, self.high)]
        first, second = truncnorm.stats(*ends, loc=mean, scale=std, moments="mv")
        return _moments(np.asarray(first), np.asarray(second))

    def check(self, n):
        _fits(n, std=self.std, low=self.low, high=self.high, mean=self.mean)


class Correlated(AbstractDistribution):
    """Normal with a `covariance` between the names, shape (n, n), about `mean`; `None` for the values that the scene or
    the throw has. Raises `ValueError` for a matrix that is not square, symmetric and positive semidefinite.

    ```python
    from nonholo_jax import Correlated
    Correlated([[0.04, -0.01], [-0.01, 0.02]])               # (m/s)^2, for names=["velocity.x", "velocity.z"]
    ```
    """

    root: Float[Array, "n n"]
    mean: Float[Array, " n"] | None = None

    def __init__(self, covariance: Any, mean: Any = None):
        example = "[[0.04, 0.0], [0.0, 0.02]]"
        lengths = [len(row) if hasattr(row, "__len__") else 0 for row in covariance]
        square = len(lengths) > 0 and all(length == len(lengths) for length in lengths)
        _require(square, "covariance", "be a square matrix", f"rows of lengths {lengths}", example)
        matrix = np.asarray(covariance, dtype=float)
        _require(bool(np.isfinite(matrix).all()), "covariance", "be finite", matrix.tolist(), example)
        size = float(np.abs(matrix).max(initial=0.0))
        even = np.allclose(matrix, matrix.T, rtol=0, atol=1e-12 * size)
        _require(even, "covariance", "be symmetric", matrix.tolist(), example)
        spread, axes = np.linalg.eigh(0.5 * (matrix + matrix.T))
        lowest = float(spread.min(initial=0.0))
        fits = lowest >= -1e-12 * size
        what = f"{matrix.tolist()} with the eigenvalue {lowest:.3g}"
        _require(fits, "covariance", "be positive semidefinite", what, example)
        self.root = jnp.asarray(axes * np.sqrt(np.maximum(spread, 0.0)))
        self.mean = None if mean is None else _finite("mean", mean)

    def n_uniform(self, n):
        return n

    def values(self, u, center):
        # A sum of products, not a matrix product: its order must not depend on how many throws there are.
        z, root = ndtri(u), self.root.astype(u.dtype)
        turned = sum(root[:, i] * z[i] for i in range(root.shape[1]))
        return _center(self.mean, center) + turned

    def moments(self, center):
        root = np.asarray(self.root)
        return _mean(self.mean, center), root @ root.T

    def check(self, n):
        if self.root.shape[0] != n:
            raise ValueError(f"Argument `covariance` must have {n} rows, one for each name, but got {len(self.root)}.")
        _fits(n, mean=self.mean)


class Measured(AbstractDistribution):
    """A row of a table of measured throws, each as likely as the other: `rows` of shape (m, n), a column for each name.
    Raises `ValueError` for a table without rows or with a value that is not finite. `Measured.read` reads a file.

    ```python
    from nonholo_jax import Measured
    Measured([[2.0, -5.1], [1.9, -4.8], [2.2, -5.3]])        # for names=["velocity.x", "velocity.z"]
    ```
    """

    rows: Float[Array, "m n"]

    def __init__(self, rows: Any):
        table = np.asarray(rows, dtype=float)
        _require(table.ndim == 2 and len(table) > 0, "rows", "be a table", f"shape {table.shape}", "[[2.0, -5.1]]")
        _require(bool(np.isfinite(table).all()), "rows", "be finite", "NaN or infinity", "leaving such rows out")
        self.rows = jnp.asarray(table)

    @staticmethod
    def read(path: str | Path, columns: Sequence[str]) -> "Measured":
        """The named columns of a CSV file with a header, or of a Parquet file. Raises `ValueError` that names file,
        line and remedy for what cannot be read."""
        path = Path(path)
        return Measured(_parquet(path, columns) if path.suffix == ".parquet" else _csv(path, columns))

    def n_uniform(self, n):
        return 1

    def values(self, u, center):
        last = self.rows.shape[0] - 1
        index = jnp.minimum((u[0] * self.rows.shape[0]).astype(jnp.int32), last)
        return self.rows.astype(u.dtype)[index]

    def moments(self, center):
        rows = np.asarray(self.rows)
        return rows.mean(axis=0), np.atleast_2d(np.cov(rows.T, ddof=0))

    def check(self, n):
        if self.rows.shape[1] != n:
            raise ValueError(f"Argument `rows` must have {n} columns, one for each name, but got {self.rows.shape[1]}.")


def _columns(path: Path, known: Sequence[str], columns: Sequence[str]) -> list[int]:
    for name in columns:
        if name not in known:
            what = f"{path}: column {name!r} must be one of {', '.join(map(repr, known))}, but it is not there"
            raise ValueError(f"{what}; correct `columns` or the header")
    return [list(known).index(name) for name in columns]


def _csv(path: Path, columns: Sequence[str]) -> list[list[float]]:
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            lines = list(csv.reader(file))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        reason = getattr(error, "strerror", None) or error
        raise ValueError(f"{path}: the table must be a readable CSV file, but got {reason}; check the path") from None
    if not lines:
        raise ValueError(f"{path}: the table must have a header, but the file is empty; name the columns in line 1")
    wanted = _columns(path, [name.strip() for name in lines[0]], columns)
    rows = []
    for number, line in enumerate(lines[1:], 2):
        if not line:
            continue
        try:
            rows.append([float(line[i]) for i in wanted])
        except (ValueError, IndexError):
            what = f"{path}: line {number} must hold a number in {', '.join(columns)}, but got {','.join(line)!r}"
            raise ValueError(f"{what}; correct the line or leave it out") from None
        if not np.isfinite(rows[-1]).all():
            raise ValueError(f"{path}: line {number} must be finite, but got {','.join(line)!r}; leave the line out")
    if not rows:
        raise ValueError(f"{path}: the table must have a row below its header, but has none; add one")
    return rows


def _parquet(path: Path, columns: Sequence[str]) -> np.ndarray:
    import pyarrow as pa
    from pyarrow import parquet

    try:
        names = parquet.read_schema(path).names
        _columns(path, names, columns)
        table = parquet.read_table(path, columns=list(columns))
        return np.stack([table[name].to_numpy().astype(float) for name in columns], axis=-1)
    except (OSError, pa.ArrowException) as error:
        raise ValueError(
            f"{path}: the table must be a readable Parquet file, but got {error}; check the path"
        ) from None
