"""Inverse problems: which throw, or which scene, reaches a goal."""

import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from .._math import KINDS, LEAST_EFFORT, RESULTS, along, is_failure, on_cpu, result_name, surfaces_hit
from .._motion import Trajectory, checked, simulate
from .._world import BallState, Scene
from .chart import Chart, chart_of, limits_of
from .goal import AbstractGoal
from .jacobian import linearized_whole
from .names import expand, read, write

_CANDIDATES_PER_START = 64
_FEW_STARTS, _FEW_IMPACTS = 32, 16
_REFUSED = 1e3  # residual, in m, of a motion that fails or leaves the itinerary: worse than any that does not


class Starts(eqx.Module):
    """What each start of the search did; leading axis n_starts. `initial` and `found` hold the free numbers in the
    order of `Design.names`, `miss` is in m, `met` says whether the itinerary was kept, `steps` counts those of the
    solver, `hit` lists surface indices (-1: none)."""

    initial: Float[Array, "n d"]
    found: Float[Array, "n d"]
    miss: Float[Array, " n"]
    met: Bool[Array, " n"]
    steps: Int[Array, " n"]
    hit: Int[Array, "n log"]
    result: RESULTS


class Design(eqx.Module):
    """The answer of `design`.

    - `state`, `scene`: with the free numbers that were found; `names` and `values`: which ones, and what they are.
    - `miss`: norm of the goal's residual, in m; `loss`: half its square.
    - `converged`: the miss is within the tolerance, along the itinerary asked for.
    - `itinerary`: names of the surfaces hit; `trajectory`: the motion, up to the goal.
    - `starts`: what each start did; `evaluations`: how many trajectories were computed (with derivatives or without).
    """

    state: BallState
    scene: Scene
    names: tuple[str, ...] = eqx.field(static=True)
    values: Float[Array, " d"]
    loss: Float[Array, ""]
    miss: Float[Array, ""]
    converged: bool = eqx.field(static=True)
    itinerary: tuple[str, ...] = eqx.field(static=True)
    trajectory: Trajectory
    starts: Starts
    evaluations: int = eqx.field(static=True)
    tolerance: float = eqx.field(static=True)

    def report(self) -> list[str]:
        """One line for each start: where it began, what it found, and why it is no answer if it is none."""
        lines = []
        for i in range(self.starts.miss.shape[0]):
            begun, ended = (self._spelled(xs) for xs in (self.starts.initial[i], self.starts.found[i]))
            lines.append(f"from {begun} to {ended}: {self._verdict(i)}")
        return lines

    def _spelled(self, values: Any) -> str:
        pairs = zip(self.names, values, strict=True)
        return ", ".join(f"{name.removeprefix('throw.')} = {float(x):.6g}" for name, x in pairs)

    def _verdict(self, i: int) -> str:
        each = jax.tree.map(lambda x: x[i], self.starts)
        hit = ", ".join(self.scene.names[int(j)] for j in each.hit if int(j) >= 0) or "nothing"
        if bool(is_failure(each.result)):
            return f"the motion failed ({result_name(each.result)})"
        if not bool(each.met):
            return f"left the itinerary (hit {hit})"
        if float(each.miss) <= self.tolerance:
            return f"reached the goal (miss {float(each.miss):.3g} m)"
        return f"came no closer than {float(each.miss):.3g} m (hit {hit})"


def design(
    scene: Scene,
    state: BallState,
    *,
    free: Sequence[str],
    goal: AbstractGoal | Callable[[Trajectory], Any],
    itinerary: Sequence[str] | None = None,
    bounds: Mapping[str, Sequence[float | int]] | None = None,
    n_starts: int = 16,
    key: Any = None,
    t1: Any,
    t0: Any = 0.0,
    max_impacts: int = 64,
    motion: Any = None,
    sum_trains: bool | None = None,
    solver: Any = None,
    tolerance: float | None = None,
    max_steps: int = 64,
) -> Design:
    """Find the free numbers with which a throw reaches a goal, by gradient through its impacts, from many starts.

    **Arguments:**

    - `scene`, `state`: what is not free, and a first guess of what is.
    - `free`: names such as `"spin.y"`, `"velocity"`, `"surfaces.table.law.restitution"`, `"ball.radius"`.
    - `goal`: `ReturnTo`, `HitTarget`, `Land`, or any differentiable function of a `Trajectory` that returns an array
        which is zero where the goal is reached.
    - `itinerary`: names of the surfaces that must be hit first, in order. A motion that hits others is refused.
    - `bounds`: for a name, the pair (lowest, highest); infinite ones are allowed.
    - `n_starts`: how many local searches; they begin at the best of 64 times as many random candidates, and at
        `state` itself. `key`: of the random candidates (default: `jax.random.key(0)`).
    - `t1`, `t0`, `max_impacts`, `motion`, `sum_trains` (default: only without an itinerary): as in `simulate`.
    - `solver`: an `optimistix` least-squares solver (default: Levenberg-Marquardt) or minimiser, or an `optax`
        optimiser. `max_steps`: of each local search.
    - `tolerance`: on the miss; by default 1e-6 m in float64, 1e-3 m in float32.

    Returns a `Design`: of the answers found the one nearest to the first guess, or, if there is none, the closest
    miss, with `converged=False` and the report of every start. Raises `ValueError` for names that do not exist.

    ```python
    from nonholo_jax import Ball, BallState, Plane, ReturnTo, Rough, Scene, design
    scene = Scene(Ball(0.025, 0.046), {"floor": Plane((0, 0, 0), (0, 0, 1), Rough())})
    throw = BallState([0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0])
    answer = design(scene, throw, free=["spin.y"], goal=ReturnTo([0.0, 0.0, 1.0]), itinerary=["floor"], t1=2.0)
    answer.values                                            # r m v / J, section 5.2.1 of the paper
    ```
    """
    names = _checked_names(scene, state, free, itinerary, goal, n_starts)
    dtype = state.position.dtype
    tolerance = (1e-6 if dtype == jnp.float64 else 1e-3) if tolerance is None else tolerance
    sum_trains = itinerary is None if sum_trains is None else sum_trains
    motion, _ = checked(scene, motion, max_impacts, None, slides=sum_trains)
    timed = isinstance(goal, AbstractGoal) and goal.passes_after is not None and not motion.is_closed_form
    how = (max_impacts, motion, sum_trains, timed)
    t0, t1 = (jnp.asarray(np.asarray(t, dtype)) for t in (t0, t1))
    problem = _Problem(scene, state, goal, t0, t1, names, _wanted(scene, itinerary), *how)
    first = read(scene, state, names)
    chart = chart_of(scene, state, names, first, limits_of(scene, state, names, bounds or {}, dtype))
    key = jax.random.key(0) if key is None else key
    starts, times = _searched(problem, chart, first, n_starts, key, _least_squares_solver(solver), max_steps)
    best = _best(starts, chart, first, tolerance)
    values = jnp.asarray(starts.found[best])
    scene, state = write(scene, state, names, values)
    trajectory = _up_to_goal(problem, values, times[best])
    return Design(
        state=state,
        scene=scene,
        names=names,
        values=values,
        loss=jnp.asarray(0.5 * starts.miss[best] ** 2),
        miss=jnp.asarray(starts.miss[best]),
        converged=bool(starts.met[best] & (starts.miss[best] <= tolerance)),
        itinerary=surfaces_hit(scene.names, trajectory.impacts),
        trajectory=trajectory,
        starts=jax.tree.map(jnp.asarray, starts),
        evaluations=n_starts * _CANDIDATES_PER_START + int(np.sum(starts.steps)),
        tolerance=float(tolerance),
    )


def _up_to_goal(problem: "_Problem", values: Any, time: Any) -> Trajectory:
    """The picture and the report end at the goal: where that is an impact, with it. To run again to its time would not
    do: steps that another end cuts are other steps, and may end before the impact."""
    t1 = np.asarray(problem.t1)
    until = lambda end: problem.trajectory(values, jnp.asarray(end, t1.dtype), adjoint=None)  # noqa: E731
    if not (isinstance(problem.goal, AbstractGoal) and np.isfinite(time)):
        return until(t1)
    if problem.goal.passes_after is not None:
        return until(time)
    trajectory = until(t1)
    times = np.asarray(trajectory.impacts.time)
    apart = np.where(np.isfinite(times), abs(times - time), np.inf)
    near = float(np.finfo(t1.dtype).eps) ** 0.5 * (abs(t1) + abs(np.asarray(problem.t0)))
    return _up_to_row(trajectory, int(apart.argmin())) if apart.min(initial=np.inf) <= near else until(time)


def _up_to_row(trajectory: Trajectory, row: int) -> Trajectory:
    """The motion up to a row of its log, and with it."""
    log = trajectory.impacts
    keep = np.arange(len(log.time)) <= row

    def cut(x: Any, unused: Any) -> Any:
        x = np.asarray(x)
        return jax.device_put(np.where(along(keep, x), x, np.asarray(unused, x.dtype)))

    kept = jax.tree.map(lambda x: cut(x, np.nan if jnp.issubdtype(x.dtype, np.floating) else 0), log)
    kept = dataclasses.replace(kept, surface=cut(log.surface, -1), support=cut(log.support, -1))
    final, t1 = jax.tree.map(lambda x: jax.device_put(np.asarray(x)[row]), (log.after, log.until))
    passed = np.sum(np.asarray(kept.kind == KINDS.passed)[: row + 1])
    counts = {"n_impacts": row + 1 - passed, "n_passed": passed}
    counts = {name: jax.device_put(np.asarray(count, log.surface.dtype)) for name, count in counts.items()}
    parts = {"final": final, "t1": t1, "impacts": kept, **counts}
    return dataclasses.replace(trajectory, result=RESULTS.reached_t1, **parts)


class _Problem(eqx.Module):
    """Everything but the free numbers."""

    scene: Scene
    state: BallState
    goal: Any
    t0: Array
    t1: Array
    names: tuple[str, ...] = eqx.field(static=True)
    wanted: tuple[int, ...] | None = eqx.field(static=True)
    max_impacts: int = eqx.field(static=True)
    motion: Any
    sum_trains: bool = eqx.field(static=True)
    timed: bool = eqx.field(static=True)  # the time of passing through the goal is one more coordinate, the last

    def trajectory(self, values: Any, t1: Any = None, adjoint: Any = "lax") -> Trajectory:
        """The motion. In a search the loop itself is differentiated, forward: value and Jacobian are one program then,
        and not two, one after the other."""
        scene, state = write(self.scene, self.state, self.names, values)
        most = self.max_impacts if self.wanted is None else len(self.wanted)
        t1 = self.t1 if t1 is None else t1
        options = {"max_impacts": most, "motion": self.motion, "sum_trains": self.sum_trains, "throw": False}
        return simulate(scene, state, t1=t1, t0=self.t0, adjoint=adjoint, **options)

    def residual(self, values: Any) -> tuple[Any, tuple]:
        """The goal's residual, refused where the motion is none that was asked for; and what happened."""
        trajectory = self.trajectory(values)
        if isinstance(self.goal, AbstractGoal):
            required = None if self.wanted is None else len(self.wanted)
            residual, time = self.goal.residual(trajectory, required)
        else:
            residual, time = jnp.ravel(self.goal(trajectory)), trajectory.t1
        return self._judged(residual, self.met(trajectory), trajectory, time)

    def _judged(self, residual: Any, met: Any, trajectory: Trajectory, time: Any) -> tuple[Any, tuple]:
        met = met & jnp.all(jnp.isfinite(residual))
        ok = met & (trajectory.result != RESULTS.invalid_state)
        miss = jnp.sqrt(jnp.sum(jnp.where(ok, jax.lax.stop_gradient(residual), 0.0) ** 2))
        aside = (jnp.where(ok, miss, jnp.inf), met, trajectory.impacts.surface, trajectory.result, time)
        return jnp.where(ok, residual, _REFUSED), aside

    def passing(self, values: Any, time: Any) -> tuple[Any, tuple]:
        """`residual` for a goal of passing through a point, at a time that is given."""
        trajectory = self.trajectory(values, time)
        residual = trajectory.final.position - self.goal.point.astype(time.dtype)
        met = self.met(trajectory) & (trajectory.result == RESULTS.reached_t1)
        if self.wanted is None:
            met = met & (trajectory.n_impacts >= self.goal.passes_after)
        return self._judged(residual, met, trajectory, time)

    def at(self, u: Any, chart: Chart) -> tuple[Any, tuple]:
        """The residual at a point of the chart. The solver works in JAX's default precision, the motion in its own."""
        wide, u = u.dtype, u.astype(self.t1.dtype)
        if self.timed:
            time = self.t0 + 0.5 * (self.t1 - self.t0) * (1.0 + jnp.sin(u[-1]))
            residual, aside = self.passing(chart.value(u[:-1]), time)
        else:
            residual, aside = self.residual(chart.value(u))
        return residual.astype(wide), aside

    def with_time(self, u: Any, time: Any) -> Any:
        """The inverse of what `at` does to the last coordinate, appended to the others."""
        if not self.timed:
            return u
        part = 2.0 * (jnp.where(jnp.isfinite(time), time, self.t1) - self.t0) / (self.t1 - self.t0) - 1.0
        return jnp.concatenate([u, jnp.arcsin(jnp.clip(part, -0.999999, 0.999999))[None]])

    def met(self, trajectory: Trajectory) -> Any:
        if self.wanted is None:
            return trajectory.n_impacts >= 0
        return jnp.all(trajectory.impacts.surface == jnp.asarray(self.wanted, dtype=jnp.int32))


def _checked_names(scene, state, free, itinerary, goal, n_starts: int) -> tuple[str, ...]:
    for name, value in (("free", free), ("itinerary", itinerary)):
        if isinstance(value, str):
            raise ValueError(f"Argument `{name}` must be a list of names, but got {value!r}; try [{value!r}].")
    if not callable(goal) and not isinstance(goal, AbstractGoal):
        raise ValueError(
            f"Argument `goal` must be a goal or a function of a trajectory, but got {goal!r}; try ReturnTo."
        )
    if isinstance(n_starts, bool) or not isinstance(n_starts, int) or n_starts < 1:
        raise ValueError(f"Argument `n_starts` must be a whole number of at least 1, but got {n_starts!r}; try 16.")
    if itinerary is not None and len(itinerary) == 0:
        raise ValueError("Argument `itinerary` must name at least one surface, but got none; try None.")
    names = expand(scene, state, free)
    if not names:
        raise ValueError("Argument `free` must name at least one number, but got none; try ['spin.y'].")
    return names


def _wanted(scene: Scene, itinerary: Sequence[str] | None) -> tuple[int, ...] | None:
    if itinerary is None:
        return None
    for name in itinerary:
        scene.surface(name)
    return tuple(scene.names.index(name) for name in itinerary)


def _least_squares_solver(solver: Any) -> Any:
    import optimistix as optx

    if solver is None:
        return optx.LevenbergMarquardt(rtol=1e-12, atol=1e-12)
    import optax

    if isinstance(solver, optax.GradientTransformation):
        return optx.OptaxMinimiser(solver, rtol=1e-10, atol=1e-12)
    if not isinstance(solver, optx.AbstractLeastSquaresSolver | optx.AbstractMinimiser):
        raise ValueError(
            f"Argument `solver` must be an optimistix or optax solver, but got {solver!r}; try "
            "optimistix.LevenbergMarquardt(rtol=1e-12, atol=1e-12)."
        )
    return solver


def _each(function: Callable, lanes: Any, in_a_row: bool) -> Any:
    """The function of lanes, one after the other or all at once: a few parabolas take less time than Python takes to
    give each operation an axis more."""
    return jax.lax.map(function, lanes) if in_a_row else jax.vmap(function)(lanes)


def _starts(problem: _Problem, chart: Chart, first: Any, n_starts: int, key: Any, in_a_row: bool) -> Any:
    """The first guess and the best of many random candidates, in coordinates."""
    shape = (n_starts * _CANDIDATES_PER_START - 1, first.size)
    bounded = jnp.isfinite(chart.low) & jnp.isfinite(chart.high)
    spread, flat = jax.random.split(key)
    normal = jax.random.normal(spread, shape, first.dtype)
    uniform = jax.random.uniform(flat, shape, first.dtype, minval=-1.0, maxval=1.0)
    u = jnp.concatenate([chart.coordinate(first)[None], jnp.where(bounded[None], jnp.arcsin(uniform), normal)])
    miss, _, _, _, time = _each(lambda each: problem.residual(chart.value(each))[1], u, in_a_row)
    order = jnp.argsort(miss.at[0].set(-1.0))[:n_starts]  # the first guess always takes part
    return jax.vmap(problem.with_time)(u[order], time[order]).astype(jnp.result_type(float))


def _at(problem: _Problem, chart: Chart, u: Any) -> tuple[Any, tuple]:
    return problem.at(u, chart)


def _descend(problem: _Problem, chart: Chart, initial: Any, solver: Any, max_steps: int, in_a_row: bool) -> tuple:
    """Local searches from each start."""
    import optimistix as optx

    residual = functools.partial(linearized_whole, function=eqx.Partial(_at, problem, chart))

    def loss(u):
        value, aside = residual(u)
        return 0.5 * jnp.sum(value**2), aside

    def one(u):
        options = {"max_steps": max_steps, "throw": False, "has_aux": True}
        if isinstance(solver, optx.AbstractLeastSquaresSolver):
            solution = optx.least_squares(lambda u, _: residual(u), solver, u, **options)
        else:
            solution = optx.minimise(lambda u, _: loss(u), solver, u, **options)
        d = len(problem.names)
        values = [chart.value(each[:d].astype(problem.t1.dtype)) for each in (u, solution.value)]
        return *values, solution.aux, solution.stats["num_steps"]

    return _each(one, initial, in_a_row)


@functools.cache
def _programs(cpu: bool, closed_form: bool) -> tuple[Callable, Callable]:
    """`_starts` and `_descend`, compiled. On a CPU XLA takes no pains over what runs for a few milliseconds."""
    quickly = LEAST_EFFORT if cpu else {}
    return eqx.filter_jit(_starts, **(quickly if closed_form else {})), eqx.filter_jit(_descend, **quickly)


def _searched(problem: _Problem, chart: Chart, first: Any, n_starts: int, key: Any, solver: Any, max_steps: int):
    """What each start found, and the time at which its goal is reached. XLA compiles one program while Python traces
    the next; what is compiled here, or was before, is not compiled again when it is called."""
    closed_form = problem.motion.is_closed_form
    rank, descend = _programs(on_cpu(), closed_form)
    few = n_starts <= _FEW_STARTS and problem.wanted is not None and len(problem.wanted) <= _FEW_IMPACTS
    in_a_row = closed_form and on_cpu() and few
    asked, how = (problem, chart, first, n_starts, key, in_a_row), (solver, max_steps, in_a_row)
    with ThreadPoolExecutor(1) as beside:
        jobs = [beside.submit(rank.lower(*asked).compile)]
        like = jnp.asarray(np.zeros((n_starts, first.size + problem.timed), jnp.result_type(float)))
        jobs.append(beside.submit(descend.lower(problem, chart, like, *how).compile))
        problem.trajectory(first, adjoint=None)  # the program of the answer
        for job in jobs:
            job.result()
    begun, found, (miss, met, hit, result, times), steps = _arrays(descend(problem, chart, rank(*asked), *how))
    return Starts(begun, found, miss, met, steps, hit, result), times


def _arrays(tree: Any) -> Any:
    """Arrays of NumPy: outside a compiled function every operation of JAX is a program of its own to compile."""
    return jax.tree.map(np.asarray, tree)


def _best(starts: Starts, chart: Chart, first: Any, tolerance: float) -> int:
    """Of the starts that reached the goal the one nearest to the first guess; else the closest miss. In NumPy, since
    every operation of JAX outside a compiled function is a program of its own to compile."""
    miss, found = np.asarray(starts.miss), np.asarray(starts.found)
    reached = np.asarray(starts.met) & (miss <= tolerance)
    distance = np.sum(((found - np.asarray(first)) / np.asarray(chart.scale)) ** 2, axis=-1)
    if not np.any(reached):
        return int(np.argmin(miss))
    # Several starts end at one answer up to rounding: take the most exact of those.
    nearest = np.min(np.where(reached, distance, np.inf))
    same = reached & (distance <= nearest * (1.0 + 1e-6) + 1e-12)
    return int(np.argmin(np.where(same, miss, np.inf)))
