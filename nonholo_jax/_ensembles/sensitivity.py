"""What the spread of a study comes from: first-order propagation, gradients of expected values, Sobol indices."""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.flatten_util
import jax.numpy as jnp
import numpy as np

from .._math import (
    LEAST_EFFORT,
    NAMES_OF_RESULTS,
    NO_FAILURES,
    WIDEST_VECTORS,
    by_tiles,
    surfaces_hit,
    with_options,
)
from .._motion import AbstractMotion, checked, flat, simulate
from .._world import Scene
from .ensemble import Ensemble, warn_of_failures
from .measure import measured, quantities_of
from .sampler import Sampler, halves, uniforms

_CHUNK = 4096


class Propagation(NamedTuple):
    """What a linear map of the inputs makes of their spread.

    - `names` of the q outputs, `inputs` of the d numbers that vary; `itinerary` of the central throw.
    - `mean` (q,): of the central throw. `jacobian` (q, d). `covariance` (q, q).
    - `input_covariance` (d, d).
    """

    names: tuple[str, ...]
    inputs: tuple[str, ...]
    itinerary: tuple[str, ...]
    mean: np.ndarray
    jacobian: np.ndarray
    covariance: np.ndarray
    input_covariance: np.ndarray

    def standard_deviation(self, name: str) -> float:
        i = self.names.index(name)
        return float(np.sqrt(self.covariance[i, i]))

    def parts(self, name: str) -> dict[str, float]:
        """The standard deviation that each input alone would give an output."""
        i, spread = self.names.index(name), np.sqrt(np.diag(self.input_covariance))
        return {each: float(abs(self.jacobian[i, k]) * spread[k]) for k, each in enumerate(self.inputs)}

    def against(self, found: Ensemble, tolerance: float = 0.1) -> list[str]:
        """A warning, one line, for every output whose mean or standard deviation in a study is not the linear one, to
        `tolerance` standard deviations and three standard errors; empty where they agree."""
        length = max((len(each.what) for each in found.itineraries), default=0)
        same = sum(each.count for each in found.itineraries if each.what == self.itinerary[:length])
        way = " ".join(self.itinerary) or "no impact"
        n = found.n - sum(each.count for each in found.failures)
        others = f"{1.0 - same / n:.2%} of the throws take other ways than the central one ({way})"
        curved = f"all take the way of the central one ({way}), but the map from inputs to this is curved"
        reason = curved if same == n else others
        lines, rounding = [], 1e-9 * float(np.abs(self.mean).max(initial=0.0))
        for i, name in enumerate(self.names):
            mean, error, spread = found.mean(name), found.standard_error(name), found.standard_deviation(name)
            room, linear = tolerance * spread + 3.0 * error + rounding, self.standard_deviation(name)
            if not abs(mean - self.mean[i]) <= room:
                lines.append(f"{name}: mean {mean:.6g}, but {self.mean[i]:.6g} of the central throw; {reason}")
            if not abs(spread - linear) <= room:
                lines.append(f"{name}: standard deviation {spread:.4g}, but {linear:.4g} to first order; {reason}")
        return lines


def propagate(
    scene: Scene,
    sampler: Sampler,
    *,
    measures: Mapping[str, Callable],
    t1: Any,
    t0: Any = 0.0,
    max_impacts: int = 64,
    itinerary_length: int = 8,
    motion: AbstractMotion | None = None,
    sum_trains: bool = True,
) -> Propagation:
    """First-order propagation of the inputs' covariance, by one Jacobian at their mean.

    **Arguments:** as `monte_carlo`. Events, which have no derivative, are left out.

    Returns a `Propagation`, whose `against(found)` says where a study disagrees. It does where the map is curved over
    the spread of the inputs, and where some throws take another itinerary, of which a derivative knows nothing. Raises
    `ValueError` as `monte_carlo` does, and `SimulationError` where the central throw fails.

    ```python
    from nonholo_jax import Ball, BallState, Landing, Normal, Plane, Rough, Sampler, Scene, Vary, propagate
    scene = Scene(Ball(0.025, 0.046), {"floor": Plane((0, 0, 0), (0, 0, 1), Rough())})
    throw = BallState([0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0])
    sampler = Sampler(throw, [Vary("velocity", Normal(std=0.05))])
    found = propagate(scene, sampler, measures={"landing": Landing("floor")}, t1=1.0)
    print(found.standard_deviation("landing.x"), found.parts("landing.x"))
    ```
    """
    inputs = sampler.names(scene)
    motion, rows = checked(scene, motion, max_impacts, min(itinerary_length, max_impacts), sum_trains)
    options = {"t0": t0, "t1": t1, "max_impacts": max_impacts, "log_size": rows, "motion": motion}
    center, spread = sampler.moments(scene)
    values = jnp.asarray(center, dtype=sampler.throw.position.dtype)

    def run(values: Any, throw: bool = False) -> Any:
        return simulate(*sampler.applied(scene, values), sum_trains=sum_trains, throw=throw, **options)

    trajectory = run(values, throw=True)
    shapes = jax.eval_shape(lambda: [jnp.asarray(measure(trajectory)) for measure in measures.values()])
    smooth = {name: m for (name, m), shape in zip(measures.items(), shapes, strict=True) if shape.dtype != bool}
    quantities, _ = quantities_of(smooth, [shape for shape in shapes if shape.dtype != bool])
    mean = np.asarray(flat(smooth.values(), trajectory), dtype=float)
    slopes = with_options(jax.jacrev(lambda v: flat(smooth.values(), run(v))), LEAST_EFFORT)
    jacobian = np.asarray(slopes(values), dtype=float)
    names = tuple(each.name for each in quantities)
    way = surfaces_hit(scene.names, jax.tree.map(np.asarray, trajectory.impacts))
    return Propagation(names, inputs, tuple(way), mean, jacobian, jacobian @ spread @ jacobian.T, spread)


class Expectation(NamedTuple):
    """An expected value, its gradient, in the form of the parameters, and the standard errors of both."""

    value: float
    standard_error: float
    gradient: Any
    gradient_standard_error: Any


def expectation(
    build: Callable[[Any], tuple[Scene, Sampler]],
    parameters: Any,
    measure: Callable,
    *,
    n: int,
    key: Any,
    t1: Any,
    t0: Any = 0.0,
    max_impacts: int = 64,
    itinerary_length: int = 8,
    motion: AbstractMotion | None = None,
    sum_trains: bool = True,
) -> Expectation:
    """The expected value of a number that is measured, and its gradient, by reparametrisation: the uniform numbers
    behind every throw are held fixed, and each throw is differentiated.

    **Arguments:**

    - `build`: a function of `parameters`, any pytree of JAX arrays, that returns a `Scene` and a `Sampler`.
    - `measure`: as in `monte_carlo`, of one number that is no event. Throws in which it is not there are left out, and
        so are those that failed, which a `UserWarning` counts.
    - the rest as in `monte_carlo`.

    Returns an `Expectation`. Where a small change of the parameters changes which throws take which itinerary, and the
    value jumps from one itinerary to the other, the gradient lacks the part that these throws contribute: it is then
    biased, however small its standard error. Raises `ValueError` as `monte_carlo` does.

    ```python
    import jax.numpy as jnp
    from nonholo_jax import Ball, BallState, Normal, Plane, Rough, Sampler, Scene, Vary, expectation
    def build(restitution):
        scene = Scene(Ball(0.025, 0.046), {"floor": Plane((0, 0, 0), (0, 0, 1), Rough(restitution))})
        throw = BallState([0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0])
        return scene, Sampler(throw, [Vary("velocity", Normal(std=0.05))])
    height = lambda trajectory: trajectory.final.position[2]
    expectation(build, jnp.asarray(0.8), height, n=1000, key=0, t1=0.8)
    ```
    """
    if isinstance(n, bool) or not isinstance(n, int) or n < 2:
        raise ValueError(f"Argument `n` must be a whole number of at least 2, but got {n!r}; try 1000.")
    key = jax.random.key(key) if isinstance(key, int) else key
    parameters = jax.tree.map(jnp.asarray, parameters)
    scene, sampler = build(parameters)
    sampler.names(scene)
    motion, rows = checked(scene, motion, max_impacts, min(itinerary_length, max_impacts), sum_trains)
    options = {"max_impacts": max_impacts, "log_size": rows, "motion": motion, "sum_trains": sum_trains}
    count, first, second, shift, results = 0, 0.0, 0.0, None, np.zeros(len(NAMES_OF_RESULTS), int)
    for start in range(0, n, _CHUNK):
        index = np.minimum(np.arange(start, start + _CHUNK, dtype=np.int64), n - 1)
        found = _slopes(build, measure, parameters, key, t0, t1, options, halves(index))
        rows = np.asarray(found, dtype=float)[: min(_CHUNK, n - start)]
        results += np.bincount(rows[:, 0].astype(int), minlength=len(NAMES_OF_RESULTS))
        values = rows[np.isfinite(rows[:, 1]), 1:]
        shift = values[0] if shift is None and len(values) else shift  # sums of squares keep their digits
        moved = values if shift is None else values - shift
        count, first, second = count + len(values), first + moved.sum(axis=0), second + (moved**2).sum(axis=0)
    results[NO_FAILURES] = 0
    warn_of_failures({NAMES_OF_RESULTS[code]: int(results[code]) for code in np.flatnonzero(results)}, n)
    with np.errstate(all="ignore"):
        mean = np.asarray(first / np.float64(count))
        error = np.sqrt(np.maximum(second / np.float64(count) - mean**2, 0.0) / np.float64(count - 1))
        mean = mean if shift is None else shift + mean
    flat_parameters, unravel = jax.flatten_util.ravel_pytree(parameters)
    gradient, spread = (unravel(jnp.asarray(x[1:], dtype=flat_parameters.dtype)) for x in (mean, error))
    return Expectation(float(mean[0]), float(error[0]), gradient, spread)


def _slopes_of(
    build: Callable, measure: Callable, parameters: Any, key: Any, t0: Any, t1: Any, options: dict, lanes: Any
):
    """Of each of some throws the code of its result, the value and its slopes."""

    def one(lane: Any) -> Any:
        def value(parameters: Any) -> Any:
            scene, sampler = build(parameters)
            u = uniforms(key, lane, (sampler.n_uniform(scene),), sampler.throw.position.dtype)
            room, state = sampler.applied(scene, sampler.values(scene, u))
            trajectory = simulate(room, state, t0=t0, t1=t1, throw=False, **options)
            return measured([measure], trajectory)[0], jnp.asarray(trajectory.result._value, trajectory.t1.dtype)

        (number, result), slopes = jax.value_and_grad(value, has_aux=True)(parameters)
        slopes = jax.flatten_util.ravel_pytree(slopes)[0].astype(number.dtype)
        return jnp.concatenate([jnp.stack([result, number]), slopes])

    return by_tiles(jax.vmap(one), lanes, lanes[0].shape[0], options["motion"].tile)


_slopes = with_options(_slopes_of, WIDEST_VECTORS)


class Indices(NamedTuple):
    """Sobol indices of an output by what moves it: the part of its variance that each number alone gives (`first`), and
    that it has a share in (`total`; `None` unless the design was Saltelli's), with 95 % confidence intervals."""

    names: tuple[str, ...]
    first: np.ndarray
    first_confidence: np.ndarray
    total: np.ndarray | None = None
    total_confidence: np.ndarray | None = None


def sobol_indices(found: Ensemble, quantity: str, seed: int = 0) -> Indices:
    """Sobol indices from the records of a study, by SALib: by its RBD-FAST method (S. Tarantola and others, 2006) for
    any throws, first order only; by Saltelli's estimators (A. Saltelli and others, 2010), total indices included, where
    the sampler's sequence was `"saltelli"`.

    **Arguments:** `found` with `records="all"`; `quantity`, a name; `seed` of the intervals' bootstrap. Throws in which
    it is not there are left out by RBD-FAST, and refused by the other.

    Returns `Indices`. Raises `ValueError` without such records. The names are inputs; of correlated ones and of tables,
    the independent numbers behind them (`velocity.x+velocity.z#0`).

    ```python
    import tempfile
    from nonholo_jax import (
        Ball, BallState, FinalPosition, Normal, Plane, Rough, Sampler, Scene, Vary, monte_carlo, sobol_indices
    )
    scene = Scene(Ball(0.025, 0.046), {"floor": Plane((0, 0, 0), (0, 0, 1), Rough())})
    throw = BallState([0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0])
    sampler = Sampler(throw, [Vary("velocity", Normal(std=0.05))], "saltelli")
    options = {"measures": {"end": FinalPosition()}, "records": "all", "out": tempfile.mkdtemp()}
    found = monte_carlo(scene, sampler, n=5 * 64, key=0, t1=1.0, **options)
    sobol_indices(found, "end.x")
    ```
    """
    about = found.about
    if found.folder is None or about["records"] != "all" or not about["sources"]:
        raise ValueError("Argument `found` must have records of all throws of a Sampler; try records='all'.")
    found.mean(quantity)
    table = found.records().to_table().sort_by("throw")
    y = np.asarray(table[quantity], dtype=float)
    names = tuple(about["sources"])
    problem = {"num_vars": len(names), "names": list(names), "bounds": [[0.0, 1.0]] * len(names)}
    if about["sequence"] == "saltelli":
        from SALib.analyze import sobol

        y = y[: len(y) // (len(names) + 2) * (len(names) + 2)]
        if not np.isfinite(y).all() or len(y) == 0:
            raise ValueError(f"Argument `quantity` must be there in every throw, but {quantity!r} is not; try another.")
        si = sobol.analyze(problem, y, calc_second_order=False, seed=seed)
        return Indices(names, si["S1"], si["S1_conf"], si["ST"], si["ST_conf"])
    from SALib.analyze import rbd_fast

    if tuple(about["inputs"]) != names:
        what = "must have inputs that are independent"
        raise ValueError(f"Argument `found` {what}, but some are correlated or of a table; try sequence='saltelli'.")
    x = np.stack([np.asarray(table[name], dtype=float) for name in names], axis=-1)
    there = np.isfinite(y)
    si = rbd_fast.analyze(problem, x[there], y[there], seed=seed)
    return Indices(names, np.asarray(si["S1"]), np.asarray(si["S1_conf"]))
