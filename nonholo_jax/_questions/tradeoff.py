"""Error against time for every way to run a scene."""

import math
import platform
import sys
import time
from collections.abc import Sequence
from importlib import metadata
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

from .._motion import Integrated, checked
from .._world import BallState, Scene, check_ball_state
from .fifty_digits import bounced, why_not
from .ways import Outcome, Program, Setting, Way, ways

_TIGHT, _RIVALS = 1e-14, 1e-13  # tolerances of the reference, whose steps are no longer than this part of the duration,
_REFERENCE_STEPS = 128  # and of what its gradient is checked against
_LONGEST = f"1/{_REFERENCE_STEPS} of the duration a step"
_MOST_STEPS = 16384
_MOST_STEPS_OF_GRADIENT = 200  # room for steps is written down and read whether it is used or not
_TIGHTEST = {"float64": 1e-13, "float32": 1e-6}
_SAMPLE = 16
_SHORTEST_RUN = 0.02  # s; what takes less is called again


class Row(NamedTuple):
    """One way to run the scene, and what it gave.

    - `method`, `steps` (exact, adaptive or fixed), `dtype`; `what`: value or gradient.
    - `tolerance` (`rtol` and `atol`) of adaptive steps, `step` in s of fixed ones; `n_steps`: median over the throws.
    - `median_error`, `max_error` over all throws, those that failed counting as infinite: of a value in m; of a
        gradient relative to the reference's, in the units of `tradeoff`. `max_error_same`: over the throws that did not
        fail and have as many impacts as the reference; `n_other_itinerary` is the number of the others.
    - `seconds_per_trajectory`: median over the runs, by turns with all other rows, after compilation, of the time of a
        batch divided by its size; `spread`: longest less shortest run, relative to the median.
    - `compile_seconds`: of the program, which serves the whole ladder of tolerances or steps.
    """

    method: str
    steps: str
    dtype: str
    what: str
    tolerance: float | None
    step: float | None
    median_error: float
    max_error: float
    max_error_same: float
    n_other_itinerary: int
    n_steps: int
    seconds_per_trajectory: float
    spread: float
    compile_seconds: float

    @property
    def label(self) -> str:
        """Such as "Tsit5, rtol = atol = 1e-06, float64"."""
        how = f", rtol = atol = {self.tolerance:.0e}" if self.tolerance is not None else ""
        how += f", dt0 = {self.step:.3g} s" if self.step is not None else ""
        return f"{self.method}{how}, {self.dtype}"


class Tradeoff(NamedTuple):
    """What `tradeoff` found.

    - `rows`: one `Row` for each way, rung of its ladder, and value or gradient.
    - `reference`: what the errors are against, and how that was verified. `reference_error`: the largest disagreement
        of the verification, in m, and `gradient_error` that of gradients, without unit (`inf`: nothing verifies it).
        Errors below them say nothing.
    - `n_throws`, `sum_trains` (as in `simulate`), `machine` (device and versions).
    """

    rows: tuple[Row, ...]
    reference: str
    reference_error: float
    gradient_error: float
    n_throws: int
    sum_trains: bool
    machine: str

    def front(self, what: str = "value") -> list[Row]:
        """The rows that no other row beats in both largest error and time, by falling error. Errors below those of the
        reference count as equal."""
        known = self.gradient_error if what == "gradient" else self.reference_error
        error = lambda row: max(row.max_error, known if math.isfinite(known) else 0.0)  # noqa: E731
        finite = [row for row in self.rows if row.what == what and math.isfinite(row.max_error)]
        front: list[Row] = []
        for row in sorted(finite, key=lambda row: (row.seconds_per_trajectory, error(row))):
            if not front or error(row) < error(front[-1]):
                front.append(row)
        return front

    def cheapest(self, error: float, what: str = "value") -> Row | None:
        """The fastest row whose largest error is at most `error`; `None` if there is none."""
        reached = [row for row in self.rows if row.what == what and row.max_error <= error]
        return min(reached, key=lambda row: row.seconds_per_trajectory, default=None)

    def table(self) -> list[str]:
        """What it found, for people: for each way the time with which it gets below an error, and the front."""
        trains = "summed" if self.sum_trains else "none, so that sum_trains=False"
        lines = [f"{self.machine}; {self.n_throws} throws in one batch; trains: {trains}"]
        lines.append(f"errors are of the final position, against {self.reference}")
        for what in dict.fromkeys(row.what for row in self.rows):
            unit = "m" if what == "value" else "relative"
            lines += ["", f"{what}: us a trajectory of the cheapest with a largest error ({unit}) of at most"]
            lines += self._matrix(what)
            lines += ["", f"{what}: the Pareto front", f"  {'largest':>8}  {'median':>8}  {'us':>8}  {'spread':>6}"]
            for row in self.front(what):
                us, spread = 1e6 * row.seconds_per_trajectory, 100 * row.spread
                errors = f"  {row.max_error:8.1e}  {row.median_error:8.1e}"
                lines.append(f"{errors}  {us:8.1f}  {spread:4.0f} %  {row.label}")
            others = [row for row in self.rows if row.what == what and row.n_other_itinerary]
            for row in others:
                rest = f"the others have at most {row.max_error_same:.1e}"
                lines.append(f"  {row.label}: {row.n_other_itinerary} throws failed or have other impacts; {rest}")
        return lines

    def _matrix(self, what: str) -> list[str]:
        marks = [10.0**-k for k in range(2, 14)]
        lines = [f"  {'':25}" + "".join(f"{mark:8.0e}" for mark in marks) + "  compile s"]
        ways: dict[tuple, list[Row]] = {}
        for row in self.rows:
            if row.what == what:
                ways.setdefault((row.method, row.steps if row.steps != "exact" else "", row.dtype), []).append(row)
        for way, rows in ways.items():
            times = [[row.seconds_per_trajectory for row in rows if row.max_error <= mark] for mark in marks]
            cells = "".join(f"{1e6 * min(each):8.1f}" if each else f"{'-':>8}" for each in times)
            lines.append(f"  {way[0]:7}{way[1]:>9}{way[2]:>9}{cells}  {rows[0].compile_seconds:9.1f}")
        return lines

    def report(self) -> dict[str, Any]:
        """All of it in words and numbers that JSON knows; what is infinite is `None`."""
        plain = lambda x: None if isinstance(x, float) and not math.isfinite(x) else x  # noqa: E731
        rows = [{name: plain(x) for name, x in row._asdict().items()} for row in self.rows]
        return {name: plain(x) for name, x in self._asdict().items()} | {"rows": rows}


def tradeoff(
    scene: Scene,
    states: BallState,
    *,
    t1: Any,
    t0: Any = 0.0,
    max_impacts: int = 64,
    sum_trains: bool | None = None,
    solvers: Sequence[Any] | None = None,
    tolerances: Sequence[float] | None = None,
    steps: Sequence[int] = (16, 32, 64, 128, 256, 512),
    dtypes: Sequence[str] = ("float64", "float32"),
    gradients: bool = True,
    runs: int = 7,
    progress: bool = False,
) -> Tradeoff:
    """Measure error against time for every way to run a batch of throws: on this machine, after compilation.

    **Arguments:**

    - `scene`, `t1`, `t0`, `max_impacts`: as in `simulate`; `states`: as in `simulate_batch`, fields of shape (N, 3) in
        float64.
    - `sum_trains`: as in `simulate`; `None` leaves trains out where no throw of the batch has one, as it is faster.
    - `solvers`: explicit solvers of `diffrax`, each run with adaptive and with fixed steps (default: Tsit5, Dopri5,
        Dopri8 and Heun). `Exact` is run where the scene allows it.
    - `tolerances`: > 0, of adaptive steps (default: 1e-3 to 1e-13 by powers of ten; in float32 those above 1e-7).
        `steps`: fixed steps are t1 - t0 divided by these numbers, each >= 1.
    - `dtypes`: of `"float64"` and `"float32"`. float32 starts from the rounded throws, which is part of its errors.
    - `gradients`: measure reverse gradients, too: of one combination of the final coordinates, with respect to the nine
        numbers of each throw, where velocities count times t1 - t0 and spins times that and the radius.
    - `runs`: >= 1, how often each row is timed. `progress`: show a bar on standard error.

    Returns a `Tradeoff`. Errors are of the final position, against `Exact` in float64, checked with fifty digits where
    the scene has planes only and mpmath is there; else against `Dopri8` at a tolerance of 1e-14, checked against
    another solver. Raises `ValueError` for arguments that cannot be right, and where JAX computes in float32 only.

    ```python
    import jax, jax.numpy as jnp
    from nonholo_jax import Ball, BallState, Plane, Rough, Scene, tradeoff
    jax.config.update("jax_enable_x64", True)
    scene = Scene(Ball(0.025, 0.046), {"floor": Plane((0, 0, 0), (0, 0, 1), Rough())})
    throws = BallState(jnp.ones((4, 3)), jnp.zeros((4, 3)), jnp.arange(12.0).reshape(4, 3))
    found = tradeoff(scene, throws, t1=1.0, solvers=[], dtypes=["float64"], gradients=False)
    found.cheapest(1e-9).label                               # 'Exact, float64'
    ```
    """
    import diffrax

    if solvers is None:
        solvers = (diffrax.Tsit5(), diffrax.Dopri5(), diffrax.Dopri8(), diffrax.Heun())
    _check(scene, states, t0, t1, solvers, tolerances, steps, dtypes, runs)
    motion, _ = checked(scene, None, max_impacts, None, slides=sum_trains is not False)
    study = _Study(Setting(scene, states, t0, t1, max_impacts, sum_trains is True), motion.is_closed_form, progress)
    words, apart = study.find_reference(sum_trains is None)
    also, slopes_apart = "", math.inf
    for way in ways(motion.is_closed_form, solvers, dtypes):
        study.measure(way, _rungs(way, tolerances, [study.setting.duration / n for n in steps]))
    if gradients:
        also, slopes_apart = study.measure_gradients()
    rows, n = study.timed(runs), states.position.shape[0]
    return Tradeoff(rows, words + also, apart, slopes_apart, n, study.setting.sum_trains, machine(jax.devices()[:1]))


class _Job(NamedTuple):
    """One rung of a ladder, run once."""

    way: Way
    rung: float | None
    what: str
    outcome: Outcome


class _Study:
    """The programs compiled so far, the reference, and what has been run."""

    def __init__(self, setting: Setting, exact: bool, progress: bool):
        import diffrax

        self.setting, self.exact = setting, exact
        self.programs: dict[tuple, tuple[Program, float]] = {}
        self.jobs: list[_Job] = []
        self.references: dict[str, Outcome] = {}
        self.best = Way(None, "exact", "float64") if exact else Way(diffrax.Dopri8(), "adaptive", "float64")
        self.rival = Way(diffrax.Tsit5(), "adaptive", "float64")
        self.bar = tqdm(disable=not progress, bar_format="nonholo: {desc} ({elapsed})", leave=False, file=sys.stderr)

    def program(self, way: Way, what: str = "value", max_steps: int = _MOST_STEPS) -> Program:
        key = (*way.name, what)
        if key not in self.programs:
            self.bar.set_description_str(f"compiling {' '.join(key)}")
            begin = time.perf_counter()
            made = Program(self.setting, way, what, self.setting.duration, max_steps)
            self.programs[key] = made, time.perf_counter() - begin
        return self.programs[key][0]

    def tightest(
        self, way: Way, what: str = "value", max_steps: int = _MOST_STEPS, tolerance: float = _TIGHT
    ) -> Outcome:
        return self.program(way, what, max_steps).outcome(tolerance, self.setting.duration / _REFERENCE_STEPS)

    def find_reference(self, may_sum_trains: bool) -> tuple[str, float]:
        """What errors are against, and by how much that disagrees with another way to compute it."""
        known = self.tightest(self.best)
        if may_sum_trains and not known.arrived.all():
            self.setting = self.setting._replace(sum_trains=True)
            self.programs.clear()
            known = self.tightest(self.best)
        self.references["value"] = known
        if not known.arrived.any():
            raise ValueError("Argument `states` must have throws that reach `t1`, but got none; try simulate() on one.")
        name = "Exact in float64" if self.exact else f"Dopri8 in float64 at {_TIGHT:.0e}, at most {_LONGEST}"
        obstacle = why_not(self.setting.scene) if self.exact else None
        if self.exact and obstacle is None:
            checked_throws, apart = _against_fifty_digits(self.setting, known)
            if checked_throws:
                return f"{name}; mpmath at 50 digits agrees to {apart:.1e} m on {checked_throws} throws", apart
            obstacle = "the sample has trains"
        reason = f" (not checked at 50 digits: {obstacle})" if obstacle else ""
        other = self.tightest(self.rival)
        same = _same(known, other)
        apart = _largest(_distance(other.values, known.values)[same])
        missing = f"; {(~same).sum()} throws have other impacts" if not same.all() else ""
        return f"{name}{reason}; Tsit5 at {_TIGHT:.0e} agrees to {apart:.1e} m{missing}", apart

    def measure(self, way: Way, rungs: Sequence[float | None]) -> None:
        self.jobs += [_Job(way, rung, "value", self.program(way).outcome(rung)) for rung in rungs]

    def measure_gradients(self) -> tuple[str, float]:
        """The same for gradients, but for rungs of too many steps. Each program takes half a minute to compile, with
        trains a whole one: fixed steps only in float64, and only without trains."""
        values = [
            job for job in self.jobs
            if job.outcome.n_arcs.max() <= _MOST_STEPS_OF_GRADIENT and job.outcome.arrived.any()
            and (job.way.steps != "fixed" or (job.way.dtype == "float64" and not self.setting.sum_trains))
        ]  # fmt: skip
        most = {self.best.name: int(self.references["value"].n_arcs.max())}
        for job in values:
            most[job.way.name] = max(most.get(job.way.name, 0), int(job.outcome.n_arcs.max()))
        has_rival = self.rival.name in most
        if has_rival:
            steps = self.tightest(self.rival, tolerance=_RIVALS).n_arcs.max()
            most[self.rival.name] = max(most[self.rival.name], int(steps))
        room = lambda way: 16 * (most[way.name] // 16 + 2)  # noqa: E731
        known = self.references["gradient"] = self.tightest(self.best, "gradient", room(self.best))
        for job in values:
            outcome = self.program(job.way, "gradient", room(job.way)).outcome(job.rung)
            self.jobs.append(_Job(job.way, job.rung, "gradient", outcome))
        if not has_rival:
            return "; gradients not checked against another solver", math.inf
        other = self.tightest(self.rival, "gradient", tolerance=_RIVALS)
        same = _same(known, other)
        apart = _largest((_distance(other.values, known.values) / _length(known.values))[same])
        return f"; its gradients and those of Tsit5 at {_RIVALS:.0e} agree to {apart:.1e}", apart

    def timed(self, runs: int) -> tuple[Row, ...]:
        """Every row, timed by turns with all others, so that a busy machine slows them all."""
        seconds: list[list[float]] = [[] for _ in self.jobs]
        for turn in range(runs):
            self.bar.set_description_str(f"timing, round {turn + 1} of {runs}")
            for job, taken in zip(self.jobs, seconds, strict=True):
                program, _ = self.programs[*job.way.name, job.what]
                calls, begin, now = 0, time.perf_counter(), 0.0
                while now < _SHORTEST_RUN:
                    program.call(job.rung)
                    calls, now = calls + 1, time.perf_counter() - begin
                taken.append(now / calls)
        self.bar.close()
        return tuple(self._row(job, taken) for job, taken in zip(self.jobs, seconds, strict=True))

    def _row(self, job: _Job, taken: list[float]) -> Row:
        known, way = self.references[job.what], job.way
        error = _distance(job.outcome.values, known.values)
        error = error if job.what == "value" else error / _length(known.values)
        error = np.where(job.outcome.arrived & np.isfinite(error), error, np.inf)
        same = _same(job.outcome, known)
        typical = float(np.median(taken))
        return Row(
            *way.name,
            job.what,
            job.rung if way.steps == "adaptive" else None,
            job.rung if way.steps == "fixed" else None,
            float(np.median(error)),
            float(np.max(error)),
            _largest(error[same]),
            int((~same).sum()),
            int(np.median(job.outcome.n_arcs)),
            typical / len(error),
            (max(taken) - min(taken)) / typical,
            self.programs[*way.name, job.what][1],
        )


def _distance(a: np.ndarray, b: np.ndarray) -> Any:
    with np.errstate(invalid="ignore"):
        return _length(a - b)


def _length(a: np.ndarray) -> Any:
    return np.linalg.norm(a, axis=-1)


def _largest(errors: np.ndarray) -> float:
    return float(np.max(errors, initial=0.0)) if errors.size else math.inf


def _same(a: Outcome, b: Outcome) -> np.ndarray:
    """The throws that both computed, with as many impacts."""
    return a.arrived & b.arrived & (a.n_impacts == b.n_impacts)


def _rungs(way: Way, tolerances: Sequence[float] | None, steps: Sequence[float]) -> list:
    if way.steps == "exact":
        return [None]
    if way.steps == "fixed":
        return list(steps)
    low = _TIGHTEST[way.dtype]
    if way.method == "Heun":  # of order 2: it takes 1e4 steps where the others take 20
        low = max(low, 1e-7)
    wanted = 10.0 ** -np.arange(3, 14) if tolerances is None else tolerances
    return [float(x) for x in wanted if x >= 0.99 * low]


def _against_fifty_digits(setting: Setting, known: Outcome) -> tuple[int, float]:
    """How many throws were computed with fifty digits, and the largest distance of the reference from them."""
    apart, times = [], (float(setting.t0), float(setting.t1))
    for i in np.flatnonzero(known.arrived)[:_SAMPLE]:
        throw = jax.tree.map(lambda x, i=i: x[i], setting.states)
        true = bounced(setting.scene, throw, *times, setting.max_impacts)
        if true is not None and true[1] == known.n_impacts[i]:
            apart.append(float(_length(true[0] - known.values[i])))
    return len(apart), max(apart, default=math.inf)


def machine(devices: Sequence[Any]) -> str:
    """Kinds of devices, with their numbers where there are several, processor and versions: what times depend on."""
    kinds = [device.device_kind for device in devices]
    names = [f"{kinds.count(kind)} x {kind}" if kinds.count(kind) > 1 else kind for kind in dict.fromkeys(kinds)]
    versions = f"Python {platform.python_version()}, JAX {jax.__version__}, Diffrax {metadata.version('diffrax')}"
    return f"{', '.join(names)}, {platform.machine()}, {versions}"


def _check(scene, states, t0, t1, solvers, tolerances, steps, dtypes, runs) -> None:
    if not isinstance(scene, Scene):
        raise ValueError(f"Argument `scene` must be a Scene, but got {type(scene).__name__}; try Scene(ball, ...).")
    check_ball_state(states, True)
    if jnp.zeros(()).dtype != jnp.float64 or states.position.dtype != jnp.float64:
        raise ValueError(
            f"Argument `states` must be in float64, in which the reference is computed, but got "
            f"{states.position.dtype}; try jax.config.update('jax_enable_x64', True) before making them."
        )
    if not float(t1) > float(t0):
        raise ValueError(f"Argument `t1` must be later than `t0`, but got t1={t1} and t0={t0}; try t1=1.0.")
    names = [type(solver).__name__ for solver in solvers]
    for solver in solvers:
        Integrated(solver, dt0=1.0)  # refuses what is not explicit
        if names.count(type(solver).__name__) > 1:
            raise ValueError(f"Argument `solvers` must not repeat a class, but got {names}; try one of each.")
    known = ("float64", "float32")
    if not dtypes or any(dtype not in known for dtype in dtypes) or len(set(dtypes)) < len(dtypes):
        raise ValueError(f"Argument `dtypes` must be some of {known}, but got {dtypes!r}; try ['float64'].")
    for name, values in (("tolerances", tolerances or ()), ("steps", steps)):
        if not all(value > 0 and math.isfinite(value) for value in values):
            raise ValueError(f"Argument `{name}` must hold positive numbers, but got {values}; try leaving it out.")
    if isinstance(runs, bool) or not isinstance(runs, int) or runs < 1:
        raise ValueError(f"Argument `runs` must be a whole number of at least 1, but got {runs!r}; try 7.")
