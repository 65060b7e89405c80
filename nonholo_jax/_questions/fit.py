"""Coefficients from measured bounces, by least squares through the simulator."""

import functools
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._math import LEAST_EFFORT, on_cpu
from .._motion import AbstractMotion, checked, flat, simulate
from .._world import BallState, Scene
from .chart import Chart, chart_of, limits_of
from .jacobian import linearized_whole, with_jacobian
from .names import expand, read, write

_ADMISSIBLE = {"restitution": (0.0, 1.0), "tangential": (-1.0, 1.0), "friction": (0.0, math.inf),
               "inertia_ratio": (0.0, math.inf), "radius": (0.0, math.inf), "mass": (0.0, math.inf),
               "drag": (0.0, math.inf), "density": (0.0, math.inf)}  # fmt: skip
_UNDECIDED = 2.0  # a difference of the criterion below which K. Burnham and D. Anderson call models alike
_FEW_THROWS = 256


class Fit(NamedTuple):
    """What `fit` found.

    - `names` of the d free numbers, their `values` (d,), `standard_errors` (d,) and `covariance` (d, d); infinite where
      the data say nothing of a number.
    - `scene`: with the values. `residuals` (n, m): measured less computed, in units of `spread`, NaN if there is none.
    - `spread`: the standard deviation of a measurement: as given, or estimated from the residuals.
    - `n_measured`; `criterion`: Akaike's, corrected for few data (AICc), with all constants of the likelihood; lower is
      better. `is_spread_known`: whether the spread was given.
    """

    names: tuple[str, ...]
    values: np.ndarray
    standard_errors: np.ndarray
    covariance: np.ndarray
    scene: Scene
    residuals: np.ndarray
    spread: float | np.ndarray
    n_measured: int
    criterion: float
    is_spread_known: bool

    def report(self) -> list[str]:
        """A line for every number."""
        rows = zip(self.names, self.values, self.standard_errors, strict=True)
        return [f"{name} = {value:.4g} +- {error:.2g}" for name, value, error in rows]


def fit(
    scene: Scene,
    throws: BallState,
    measured: Any,
    *,
    free: Sequence[str],
    observe: Callable,
    t1: Any,
    t0: Any = 0.0,
    spread: Any = None,
    bounds: Mapping[str, Sequence[float | int]] | None = None,
    n_starts: int = 16,
    key: Any = 0,
    max_impacts: int = 64,
    motion: AbstractMotion | None = None,
    sum_trains: bool = True,
    max_steps: int = 256,
) -> Fit:
    """Find the numbers of a scene with which throws do what was measured, by least squares.

    **Arguments:**

    - `scene`: a `Scene` with a first guess of what is free. `throws`: a `BallState` with a leading axis n.
    - `measured`: shape (n, m), NaN for what was not; `observe`: a function of a `Trajectory` that gives these m numbers
        of one throw.
    - `free`: names such as `"surfaces.floor.law.restitution"` or `"ball.inertia_ratio"`. `bounds`: for a name, the pair
        (lowest, highest); coefficients of a law stay in their admissible range by themselves.
    - `spread`: standard deviation of a measurement, a number or of shape (n, m). `None`: one for all, not known, which
        the residuals then tell.
    - `n_starts`, `key`: how many local searches (Levenberg-Marquardt), one of them from the first guess.
    - `t1`, `t0`, `max_impacts`, `motion`, `sum_trains`: as in `simulate`. `max_steps`: of each search.

    Returns a `Fit`. Standard errors are those of the linear map at the answer. Raises `ValueError` for names that do
    not exist, shapes that do not fit, and fewer measurements than free numbers.

    ```python
    import jax.numpy as jnp
    from nonholo_jax import Ball, BallState, Plane, Rough, Scene, fit
    scene = Scene(Ball(0.033, 0.058), {"floor": Plane((0, 0, 0), (0, 0, 1), Rough(0.7))})
    velocity = jnp.array([[1.0, 0.0, -3.0], [2.0, 0.0, -4.0]])
    throws = BallState(jnp.array([[0.0, 0.0, 0.1]] * 2), velocity, jnp.zeros((2, 3)))
    rise = lambda trajectory: trajectory.impacts.after.velocity[0, 2]
    found = fit(scene, throws, [[2.5], [3.3]], free=["surfaces.floor.law.restitution"], observe=rise, t1=0.1)
    print(found.report())
    ```
    """
    first_throw = jax.tree.map(lambda x: x[0], throws)
    names = expand(scene, first_throw, list(free))
    dtype = throws.position.dtype
    target = np.asarray(measured, dtype=float)
    n = throws.position.shape[0]
    if target.ndim != 2 or target.shape[0] != n:
        raise ValueError(f"Argument `measured` must have shape ({n}, m), a row for each throw, but got {target.shape}.")
    there = np.isfinite(target)
    count = int(there.sum())
    if count <= len(names):
        what = f"must hold more numbers than the {len(names)} that are free, but got {count}"
        raise ValueError(f"Argument `measured` {what}; try freeing fewer.")
    motion, _ = checked(scene, motion, max_impacts, None, slides=sum_trains)
    times = jnp.asarray(t0, dtype=dtype), jnp.asarray(t1, dtype=dtype)
    unit = np.broadcast_to(1.0 if spread is None else np.asarray(spread, dtype=float), target.shape)
    wanted = jnp.asarray(np.where(there, target, 0.0), dtype=dtype)
    weight = jnp.asarray(np.where(there, 1.0 / unit, 0.0), dtype=dtype)
    first = read(scene, first_throw, names)
    chart = chart_of(
        scene, first_throw, names, first, limits_of(scene, first_throw, names, _bounds(names, bounds), dtype)
    )
    problem = _Problem(scene, throws, wanted, weight, chart, motion, times, names, observe, max_impacts, sum_trains)
    shape = jax.eval_shape(problem.computed, first).shape
    if shape != target.shape:
        raise ValueError(f"Argument `observe` must give {target.shape[1]} numbers, as measured, but gives {shape[1]}.")
    noise = jax.random.normal(jax.random.key(key) if isinstance(key, int) else key, (n_starts, len(names)), dtype)
    begin = chart.coordinate(first)
    starts = jnp.where(jnp.arange(n_starts)[:, None] == 0, begin[None], begin[None] + noise)
    search = _program(motion.is_closed_form and on_cpu())
    values, misses, slopes = (np.asarray(x, dtype=float) for x in search(problem, starts, max_steps))
    return _summary(scene, first_throw, names, jnp.asarray(values, dtype=dtype), misses, there, slopes, spread)


class _Problem(eqx.Module):
    """What is computed for some values of the free numbers, and how far that is from what was measured."""

    scene: Scene
    throws: BallState
    wanted: Array
    weight: Array
    chart: Chart
    motion: AbstractMotion
    times: tuple[Array, Array]
    names: tuple[str, ...] = eqx.field(static=True)
    observe: Callable = eqx.field(static=True)
    max_impacts: int = eqx.field(static=True)
    sum_trains: bool = eqx.field(static=True)

    def computed(self, values: Any) -> Any:
        options = {"max_impacts": self.max_impacts, "motion": self.motion, "sum_trains": self.sum_trains}
        # Of few throws the loop itself is differentiated: one program. The other way goes through many in tiles.
        options["adjoint"] = "lax" if len(self.wanted) <= _FEW_THROWS else None

        def one(throw: BallState) -> Any:
            room, state = write(self.scene, throw, self.names, values)
            return flat(
                [self.observe], simulate(room, state, t0=self.times[0], t1=self.times[1], throw=False, **options)
            )

        return jax.vmap(one)(self.throws)

    def misses(self, values: Any) -> Any:
        return jnp.where(self.weight > 0, (self.wanted - self.computed(values)) * self.weight, 0.0)


def _search(problem: _Problem, starts: Any, max_steps: int) -> tuple[Any, Any, Any]:
    """The best values, what they miss, and the slopes of that."""
    import optimistix as optx

    solver = optx.LevenbergMarquardt(rtol=1e-10, atol=1e-10)
    residual = functools.partial(linearized_whole, function=eqx.Partial(_missed, problem))
    options = {"max_steps": max_steps, "throw": False, "has_aux": True}

    def descended(u: Any) -> tuple[Any, Any]:
        solution = optx.least_squares(lambda u, _: residual(u), solver, u, **options)
        return solution.value, solution.aux

    ends, costs = jax.vmap(descended)(starts)
    values = problem.chart.value(ends[jnp.argmin(costs)])
    misses, slopes, _ = with_jacobian(lambda values: (jnp.ravel(problem.misses(values)), None), values)
    return values, misses.reshape(problem.wanted.shape), slopes


def _missed(problem: _Problem, u: Any) -> tuple[Any, Any]:
    """The misses, and the cost, which is infinite where it is no number."""
    misses = jnp.ravel(problem.misses(problem.chart.value(u)))
    cost = jax.lax.stop_gradient(jnp.sum(misses**2))
    return misses, jnp.where(jnp.isfinite(cost), cost, jnp.inf)


@functools.cache
def _program(quickly: bool) -> Callable:
    """`_search`, compiled; on a CPU without pains where throws are parabolas."""
    return eqx.filter_jit(_search, **(LEAST_EFFORT if quickly else {}))


def _bounds(names: tuple[str, ...], given: Mapping | None) -> dict[str, Any]:
    own = {name: _ADMISSIBLE[name.rsplit(".", 1)[1]] for name in names if name.rsplit(".", 1)[1] in _ADMISSIBLE}
    return {**own, **(given or {})}


def _summary(scene, throw, names, values, misses, there, slopes, spread) -> Fit:
    count, d = int(there.sum()), len(names)
    square = float((misses**2)[there].sum())
    if spread is None:
        scale = math.sqrt(square / (count - d))
        parameters = d + 1  # the spread is one more
        criterion = count * (math.log(2.0 * math.pi * max(square, 1e-300) / count) + 1.0)
    else:
        sizes = np.broadcast_to(np.asarray(spread, dtype=float), there.shape)[there]
        scale, parameters = 1.0, d
        criterion = square + float(np.log(2.0 * math.pi * sizes**2).sum())
    free = count - parameters - 1
    criterion += 2.0 * parameters + (2.0 * parameters * (parameters + 1) / free if free > 0 else math.inf)
    kept, lengths = slopes[there.ravel()], np.linalg.norm(slopes[there.ravel()], axis=0)
    known = lengths > 1e-10 * max(float(lengths.max(initial=0.0)), 1e-300)
    covariance = np.full((d, d), np.inf)
    inverse = np.linalg.pinv(kept[:, known].T @ kept[:, known], rcond=1e-12)
    covariance[np.ix_(known, known)] = scale**2 * inverse
    return Fit(
        names=names,
        values=np.asarray(values, dtype=float),
        standard_errors=np.sqrt(np.diag(covariance)),
        covariance=covariance,
        scene=write(scene, throw, names, values)[0],
        residuals=np.where(there, misses / (scale or 1.0), np.nan),
        spread=scale if spread is None else np.asarray(spread, dtype=float),
        n_measured=count,
        criterion=criterion,
        is_spread_known=spread is not None,
    )


class Preference(NamedTuple):
    """Which of several fits of the same data is to be preferred: `verdict` is a name or `"undecided"`. `differences`:
    of the criterion from the best, `weights`: Akaike's, the probability of each if one of them is right."""

    verdict: str
    differences: dict[str, float]
    weights: dict[str, float]


def compare(fits: Mapping[str, Fit]) -> Preference:
    """Compare models by Akaike's criterion, corrected for few data (AICc; K. Burnham and D. Anderson, 2002).

    **Arguments:** `fits` of the same data, by name; at least two.

    Returns a `Preference`: the model of the lowest criterion, or `"undecided"` where another comes within 2. Raises
    `ValueError` for fewer than two fits, or of different data, or where the spread was given to some only.

    ```python
    from nonholo_jax import compare, fit
    # compare({"rough": fit(...), "frictional": fit(...)}).verdict
    ```
    """
    if len(fits) < 2:
        raise ValueError(f"Argument `fits` must hold at least two, but got {len(fits)}; try another law.")
    if len({each.n_measured for each in fits.values()}) > 1:
        raise ValueError("Argument `fits` must be of the same data, but they differ in how much was measured.")
    known = [name for name, each in fits.items() if each.is_spread_known]
    if known and len(known) < len(fits):
        other = next(name for name in fits if name not in known)
        what = f"must all have a given `spread` or none, but {known[0]!r} was given one and {other!r} estimated it"
        raise ValueError(f"Argument `fits` {what}; try fit(..., spread=...) for each.")
    best = min(each.criterion for each in fits.values())
    apart = {name: each.criterion - best if each.criterion < math.inf else math.inf for name, each in fits.items()}
    parts = {name: math.exp(-0.5 * x) for name, x in apart.items()}
    whole = sum(parts.values())
    near = [name for name, x in apart.items() if x < _UNDECIDED]
    verdict = near[0] if len(near) == 1 else "undecided"
    return Preference(verdict, apart, {name: x / whole for name, x in parts.items()})
