"""How fast batches run on every device of this process: time to the first answer, then throws and bounces a second."""

import math
import os
import sys
import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from tqdm import tqdm

from .._impact import Rough
from .._math import WIDEST_VECTORS, is_success, on_cpu
from .._motion import checked, simulate_batch
from .._world import Air, Ball, BallState, Box, Plane, Scene
from .rates import LONGEST, Bench, Rate, Rung, climb
from .tradeoff import machine

SPREAD, SPIN_SPREAD = 0.01, 3.0  # of the velocity, relative to the speed, and of the spin, rad/s: standard deviations
JOBS, DTYPES = ("value", "gradient"), ("float64", "float32")
_KINDS = ("cpu", "gpu", "tpu")
_SHORTEST_RUN = 0.02  # s; what takes less is called again
_FEW_RUNS = 3  # of those that take long
_SHARE = 0.5  # of the free memory


class Case(NamedTuple):
    """A scene to run: `draw(n)` gives a batch of n throws, or with it a scene whose every array has that axis, too."""

    scene: Scene
    draw: Callable[[int], Any]
    drawn: str
    how: dict[str, Any]  # arguments of simulate_batch


def built_in(seed: int = 0) -> dict[str, Case]:
    """Floor and ceiling; Garwin's throw under a table, as in `experiments/scenes/under_the_table.toml`; with air."""
    ball, floor = Ball(radius=0.025, mass=0.046), Plane((0, 0, 0), (0, 0, 1), Rough())
    ceiling = Plane((0, 0, 1), (0, 0, -1), Rough())
    table = Box(center=(0.6, 0, 0.715), half_size=(0.6, 0.4, 0.015), law=Rough())
    inside, hand = ([0.0, 0.0, 0.5], [2.0, 0.0, -5.0]), ([-0.3, 0.0, 0.9], [2.0, 0.0, -5.0])
    found = {}
    for name, surfaces, air, (position, velocity), most in (
        ("floor and ceiling", {"floor": floor, "ceiling": ceiling}, None, inside, 32),
        ("under the table", {"floor": floor, "table": table}, None, hand, 16),
        ("under the table, with air", {"floor": floor, "table": table}, Air(), hand, 16),
    ):
        throw = BallState(position, velocity, [0.0, 0.0, 0.0])
        how = {"t0": 0.0, "t1": 2.0, "max_impacts": most}
        found[name] = case(Scene(ball, surfaces, air=air), throw, how, seed)
    return found


def case(scene: Scene, throw: BallState, how: dict[str, Any], seed: int = 0) -> Case:
    """A scene with throws round one throw."""
    words = f"normal: velocity +- {SPREAD:.0%} of the speed, spin +- {SPIN_SPREAD:g} rad/s, seed {seed}"
    return Case(scene, lambda n: scattered(throw, n, seed), words, how)


def scattered(throw: BallState, n: int, seed: int) -> BallState:
    """n throws round one: throw i depends on the seed and on i alone."""
    noise = np.random.default_rng(seed).standard_normal((n, 6))
    position, velocity, spin = (np.asarray(x, np.float64) for x in (throw.position, throw.velocity, throw.spin))
    speed = float(np.linalg.norm(velocity)) or 1.0
    turned = None if throw.orientation is None else np.tile(np.asarray(throw.orientation, np.float64), (n, 1))
    velocities, spins = velocity + SPREAD * speed * noise[:, :3], spin + SPIN_SPREAD * noise[:, 3:]
    return BallState(np.tile(position, (n, 1)), velocities, spins, orientation=turned)  # pyright: ignore[reportArgumentType]


def bench(
    scene: Scene | None = None,
    throw: BallState | None = None,
    *,
    t1: Any = None,
    t0: Any = 0.0,
    max_impacts: int = 64,
    motion: Any = None,
    sum_trains: bool = True,
    draw: Callable[[int], Any] | None = None,
    name: str = "scene",
    devices: Sequence[str] | None = None,
    dtypes: Sequence[str] | None = None,
    jobs: Sequence[str] = JOBS,
    most: int = 10**7,
    runs: int = 7,
    seed: int = 0,
    progress: bool = False,
) -> Bench:
    """Measure how long batches of throws take on every device of this process, compilation apart.

    **Arguments:**

    - `scene`, `t1`, `t0`, `max_impacts`, `motion`, `sum_trains`: as in `simulate`; without a scene three that come with
        the package: floor and ceiling, under a table, under a table with air, 2 s each. `name`: what to call it.
    - `throw`: fields of shape (3,). The throws of a batch are normal round it: velocities with 1 percent of the speed
        as standard deviation, spins with 3 rad/s.
    - `draw`: instead of `throw`, a function: `draw(n)` gives a `BallState` with fields of shape (n, 3), or a pair of a
        scene, every array of which has a leading axis n, and that.
    - `devices`: kinds of platform, such as `["cpu", "gpu"]`; `None` for all that JAX has. The devices of a kind share a
        batch, as in `simulate_batch`: for every core of a CPU to be one, set
        `XLA_FLAGS=--xla_force_host_platform_device_count=...` before Python starts, as the command line does.
    - `dtypes`: of `"float64"` and `"float32"`; `None` for both where JAX computes in float64, else for float32.
    - `jobs`: of `"value"` and `"gradient"`, the reverse gradient of the mean squared final position, m^2, in the
        initial state.
    - `most`: throws in a batch, >= 1. Sizes are 1, 10, 100, ... until ten times the throws give less than 1.2 times
        the rate, a run takes longer than 2 s, or ten times the throws would not fit half of the free memory.
    - `runs`: >= 1, how often each row is timed, by turns. `seed` of the throws. `progress`: show a bar.

    Returns a `Bench`. Raises `ValueError` for arguments that cannot be right and devices that are not there. Each batch
    size is a program of its own: compiling them takes most of the time, ten minutes for the scenes of the package.

    ```python
    from nonholo_jax import Ball, BallState, Plane, Rough, Scene, bench
    scene = Scene(Ball(0.025, 0.046), {"floor": Plane((0, 0, 0), (0, 0, 1), Rough())})
    throw = BallState([0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0])
    found = bench(scene, throw, t1=1.0, devices=["cpu"], dtypes=["float32"], jobs=["value"], most=1)
    print(found.rows[0].bounces_per_second, found.rows[0].compile_seconds)
    ```
    """
    wanted = _checked_dtypes(dtypes)
    _check(jobs, most, runs, seed)
    there = _there(devices)
    how = {"t1": t1, "t0": t0, "max_impacts": max_impacts, "motion": motion, "sum_trains": sum_trains}
    cases = _cases(name, scene, throw, draw, how, seed)
    scenes = {each: _about(one) for each, one in cases.items()}
    study = _Study(there, wanted, tuple(jobs), most, runs, progress)
    rows = tuple(row for each, one in cases.items() for row in study.rows(each, one))
    used = [device for kind in there.values() for device in kind]
    return Bench(rows, scenes, machine(used), bool(jax.config.jax_compilation_cache_dir))  # pyright: ignore[reportAttributeAccessIssue]


class Program:
    """One compiled program on the devices of one kind, with its batch on them, and how long it took to get there."""

    def __init__(self, case: Case, devices: Sequence[Any], dtype: str, job: str, throws: int):
        lanes, alike, constants = _batch(case, dtype, throws)
        axes = 0 if alike is None else None
        self.throws, self.devices = throws, list(devices) if throws >= len(devices) else list(devices[:1])

        def run(lanes, alike):
            states, mapped = lanes
            scene = eqx.combine(mapped if alike is None else alike, constants)
            end = simulate_batch(scene, states, scene_axes=axes, log_size=0, throw=False, **case.how)
            return end.final, (end.n_impacts, ~is_success(end.result))

        def slope(lanes, alike):
            def squared(states):
                final, counts = run((states, lanes[1]), alike)
                return jnp.sum(final.position**2) / throws, counts

            return jax.grad(squared, has_aux=True)(lanes[0])

        with jax.default_device(self.devices[0]):
            function, self.arguments = _spread({"value": run, "gradient": slope}[job], lanes, alike, self.devices)
            jax.block_until_ready(self.arguments)
            compiled = jax.jit(function, **(WIDEST_VECTORS if on_cpu() else {}))
            traced, self.trace_seconds = _timed(lambda: compiled.trace(*self.arguments))
            lowered, self.lower_seconds = _timed(traced.lower)
            self.compiled, self.compile_seconds = _timed(lowered.compile)
        before = _peak(self.devices)
        (_, (n_impacts, failed)), self.first_seconds = _timed(self.call)
        peak = _peak(self.devices)
        self.peak_bytes = peak if peak is not None and (before is None or peak > before) else None
        self.bounces = int(np.asarray(n_impacts)[:throws].sum(dtype=np.int64))
        self.failed = int(np.asarray(failed)[:throws].sum())
        self.program_bytes = _program_bytes(self.compiled, len(self.devices))

    def call(self) -> Any:
        return jax.block_until_ready(self.compiled(*self.arguments))

    def seconds(self, last: float) -> float:
        """Of a run: the mean of as many as fill `_SHORTEST_RUN` where one takes `last`."""
        count = max(1, min(math.ceil(_SHORTEST_RUN / max(last, 1e-9)), 1000))
        return _timed(lambda: [self.call() for _ in range(count)])[1] / count

    def roughly(self) -> float:
        """Of a run, well enough to see whether a ladder goes on: the shortest, which others disturb least."""
        if self.first_seconds > LONGEST:
            return self.first_seconds
        last = _timed(self.call)[1]
        return min(self.seconds(last) for _ in range(_FEW_RUNS))


class _Ladder(NamedTuple):
    """The programs of one device, dtype and job by size, what a run of each took, and why there are no more."""

    device: str
    dtype: str
    job: str
    programs: list[Program]
    rungs: list[Rung]
    stopped: str


class _Study:
    """What is measured of each scene."""

    def __init__(self, devices: dict[str, list], dtypes: tuple, jobs: tuple, most: int, runs: int, progress: bool):
        self.devices, self.dtypes, self.jobs, self.most, self.runs = devices, dtypes, jobs, most, runs
        self.bar = tqdm(disable=not progress, bar_format="nonholo: {desc} ({elapsed})", leave=False, file=sys.stderr)

    def rows(self, name: str, case: Case) -> list[Rate]:
        ladders = [
            self.ladder(name, case, kind, dtype, job)
            for dtype in self.dtypes for job in self.jobs for kind in self.devices
        ]  # fmt: skip
        pairs = [pair for ladder in ladders for pair in zip(ladder.programs, ladder.rungs, strict=True)]
        seconds: list[list[float]] = [[] for _ in pairs]
        for turn in range(self.runs):  # by turns, so that a busy machine slows them all
            self.bar.set_description_str(f"{name}: timing, round {turn + 1} of {self.runs}")
            for (program, rung), taken in zip(pairs, seconds, strict=True):
                if rung.seconds <= LONGEST or turn < _FEW_RUNS:
                    taken.append(program.seconds(rung.seconds))
        self.bar.clear()
        each = iter(seconds)
        return [row for ladder in ladders for row in _rows(name, ladder, [next(each) for _ in ladder.programs])]

    def ladder(self, name: str, case: Case, kind: str, dtype: str, job: str) -> _Ladder:
        programs: list[Program] = []

        def run(throws: int) -> Rung | None:
            self.bar.set_description_str(f"{name}: {kind}, {dtype}, {job}, {throws} throws")
            try:
                program = Program(case, self.devices[kind], dtype, job, throws)
                rung = Rung(throws, program.roughly(), program.program_bytes, len(program.devices))
            except jax.errors.JaxRuntimeError as error:
                if "RESOURCE_EXHAUSTED" not in str(error) or not programs:
                    raise
                return None
            programs.append(program)
            return rung

        rungs, stopped = climb(run, self.most, _room(self.devices[kind]))
        return _Ladder(kind, dtype, job, programs, rungs, stopped)


def _rows(scene: str, ladder: _Ladder, seconds: list[list[float]]) -> list[Rate]:
    found = []
    for program, taken in zip(ladder.programs, seconds, strict=True):
        low, middle, high = (float(x) for x in np.quantile(taken, [0.25, 0.5, 0.75]))
        which = (scene, ladder.device, len(program.devices), ladder.dtype, ladder.job, program.throws)
        before = (program.trace_seconds, program.lower_seconds, program.compile_seconds, program.first_seconds)
        counts = (program.bounces, program.failed, program.program_bytes, program.peak_bytes)
        stopped = ladder.stopped if program is ladder.programs[-1] else ""
        found.append(Rate(*which, *before, middle, (high - low) / 2 / middle, *counts, stopped))
    return found


def _batch(case: Case, dtype: str, throws: int) -> tuple[Any, Any, Any]:
    """What each throw has (its state, and the arrays of its own scene, if any), the arrays that all share (`None` where
    scenes are own), and the rest of the scene; in NumPy, so that no device keeps more than its program takes."""
    drawn = case.draw(throws)
    scene, states = (case.scene, drawn) if isinstance(drawn, BallState) else drawn
    arrays, constants = eqx.partition(scene, eqx.is_array)
    lanes, alike = ((states, None), arrays) if isinstance(drawn, BallState) else ((states, arrays), None)
    cast = lambda x: np.asarray(x).astype(dtype) if eqx.is_inexact_array(x) else np.asarray(x)  # noqa: E731
    return jax.tree.map(cast, lanes), jax.tree.map(cast, alike), constants


def _spread(function: Callable, lanes: Any, alike: Any, devices: list) -> tuple[Callable, tuple]:
    """The function on those devices, each of which takes its share of the lanes and waits for no other; and its
    arguments there, the last lane repeated so that all shares are equal."""
    if len(devices) == 1:
        return function, jax.device_put((lanes, alike), devices[0])
    mesh = Mesh(np.array(devices), ("lanes",))
    each, all_of_it = PartitionSpec("lanes"), PartitionSpec()
    padding = -jax.tree.leaves(lanes)[0].shape[0] % len(devices)
    fill = lambda x: np.pad(np.asarray(x), ((0, padding), *[(0, 0)] * (x.ndim - 1)), mode="edge")  # noqa: E731
    lanes = jax.device_put(jax.tree.map(fill, lanes), NamedSharding(mesh, each))
    alike = jax.device_put(alike, NamedSharding(mesh, all_of_it))
    options = {"in_specs": (each, all_of_it), "out_specs": each, "check_vma": False}
    return jax.shard_map(function, mesh=mesh, **options), (lanes, alike)


def _timed(function: Callable[[], Any]) -> tuple[Any, float]:
    begin = time.perf_counter()
    found = function()
    return found, time.perf_counter() - begin


def _peak(devices: list) -> int | None:
    """The most bytes that were ever in use on one of the devices, where they say."""
    stats = [device.memory_stats() or {} for device in devices]
    return max((each["peak_bytes_in_use"] for each in stats if "peak_bytes_in_use" in each), default=None)


def _program_bytes(compiled: Any, n_devices: int) -> int | None:
    """Arguments, results and intermediates, where the backend says."""
    try:
        parts = compiled.memory_analysis()
        each = parts.argument_size_in_bytes + parts.output_size_in_bytes + parts.temp_size_in_bytes
        return n_devices * int(each - parts.alias_size_in_bytes)
    except (AttributeError, NotImplementedError, jax.errors.JaxRuntimeError):
        return None


def _room(devices: list) -> int | None:
    """Bytes that a program may take on these devices together, where that is known."""
    stats = [device.memory_stats() or {} for device in devices]
    if all("bytes_limit" in each for each in stats):
        return int(_SHARE * sum(each["bytes_limit"] - each.get("bytes_in_use", 0) for each in stats))
    if devices[0].platform != "cpu":
        return None
    try:
        return int(_SHARE * os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
    except (AttributeError, ValueError, OSError):
        return None


def _about(case: Case) -> dict[str, Any]:
    """What was run, in words and numbers that JSON knows."""
    how = case.how
    motion, _ = checked(case.scene, how.get("motion"), how["max_impacts"], 0, slides=how.get("sum_trains", True))
    times = {"t0": float(how["t0"]), "t1": float(how["t1"])}
    return {**times, "max_impacts": how["max_impacts"], "motion": type(motion).__name__, "throws": case.drawn}


def _there(wanted: Sequence[str] | None) -> dict[str, list]:
    """The devices of this process by kind of platform."""
    found: dict[str, list] = {}
    for kind in filter(None, dict.fromkeys([*_KINDS, jax.default_backend(), *(wanted or ())])):
        try:
            devices = jax.local_devices(backend=kind)
        except RuntimeError:
            continue
        if devices not in found.values() or kind in (wanted or ()):
            found[kind] = devices
    if wanted is None:
        return found
    for kind in wanted:
        if kind not in found or list(wanted).count(kind) > 1:
            raise ValueError(
                f"Argument `devices` must be some of {', '.join(found)}, which JAX has here, but got "
                f"{kind!r}{' twice' if kind in found else ''}; try leaving it out."
            )
    if not wanted:
        raise ValueError(f"Argument `devices` must be some of {', '.join(found)}, but got none; try leaving it out.")
    return {kind: found[kind] for kind in wanted}


def _cases(name: str, scene: Any, throw: Any, draw: Any, how: dict[str, Any], seed: int) -> dict[str, Case]:
    """What is to run, by name."""
    if scene is not None:
        _check_scene(scene, throw, draw, how["t0"], how["t1"])
        return {name: case(scene, throw, how, seed) if draw is None else Case(scene, draw, "as `draw` draws them", how)}
    for what, value in {"throw": throw, "draw": draw, "t1": how["t1"], "motion": how["motion"]}.items():
        if value is not None:
            problem = f"must come with `scene`, but got {type(value).__name__} without one"
            raise ValueError(f"Argument `{what}` {problem}; try bench(scene, throw, t1=1.0).")
    return built_in(seed)


def _checked_dtypes(dtypes: Sequence[str] | None) -> tuple[str, ...]:
    double = jnp.zeros(()).dtype == jnp.float64
    if dtypes is None:
        return DTYPES if double else ("float32",)
    _check_words("dtypes", dtypes, DTYPES)
    if "float64" in dtypes and not double:
        raise ValueError(
            "Argument `dtypes` must be ('float32',) where JAX computes in float32 only, but got "
            f"{dtypes!r}; try jax.config.update('jax_enable_x64', True) first."
        )
    return tuple(dtypes)


def _check_words(name: str, values: Sequence[str], known: tuple[str, ...]) -> None:
    if not values or any(value not in known for value in values) or len(set(values)) < len(values):
        raise ValueError(f"Argument `{name}` must be some of {known}, but got {values!r}; try {known[:1]}.")


def _check(jobs: Sequence[str], most: Any, runs: Any, seed: Any) -> None:
    _check_words("jobs", jobs, JOBS)
    for name, value, least in (("most", most, 1), ("runs", runs, 1), ("seed", seed, 0)):
        if isinstance(value, bool) or not isinstance(value, int) or value < least:
            what = f"must be a whole number of at least {least}, but got {value!r}"
            raise ValueError(f"Argument `{name}` {what}; try leaving it out.")


def _check_scene(scene: Any, throw: Any, draw: Any, t0: Any, t1: Any) -> None:
    if not isinstance(scene, Scene):
        raise ValueError(f"Argument `scene` must be a Scene, but got {type(scene).__name__}; try Scene(ball, ...).")
    if (throw is None) == (draw is None):
        what = "must be given, or `draw`, but got " + ("neither" if throw is None else "both")
        raise ValueError(f"Argument `throw` {what}; try BallState(position, velocity, spin).")
    if throw is not None and not (isinstance(throw, BallState) and np.shape(throw.position) == (3,)):
        what = f"must be a BallState of one ball, with fields of shape (3,), but got {throw!r}"
        raise ValueError(f"Argument `throw` {what}; try BallState(position, velocity, spin).")
    if t1 is None or not float(t1) > float(t0):
        raise ValueError(f"Argument `t1` must be later than `t0`, but got t1={t1} and t0={t0}; try t1=1.0.")
