"""What the sections of bench_throughput.py share: the ball, throws, C programs, timing by turns, rows of the table."""

import ctypes
import math
import os
import pathlib
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable, Sequence
from typing import Any

# Every core is a device of its own; XLA reads this once, when JAX first computes.
if "xla_force_host_platform_device_count" not in os.environ.get("XLA_FLAGS", ""):
    flag = f"--xla_force_host_platform_device_count={os.cpu_count()}"
    os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {flag}"

import jax
import jax.numpy as jnp
import numpy as np

from nonholo_jax import Ball, BallState, Plane, Rough, Scene

jax.config.update("jax_enable_x64", True)

HERE = pathlib.Path(__file__).parent
HEIGHT, BOUNCES = 1.0, 64
# Of one turn of the loop of bounces.c: 14 for the two times of arrival, 7 for the flight, 12 for the impact; a root and
# a division (two of each) count as one, and comparisons, choices and changes of sign as none.
FLOPS = 33
SHORTEST = 0.05  # s of one measurement
BALL = Ball(radius=0.025, mass=0.046)
DTYPES = {"float32": np.float32, "float64": np.float64}


def room(n_surfaces: int = 2, **options) -> Scene:
    """A floor and a ceiling, and walls around that make a prism."""
    planes = {
        "floor": Plane((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), Rough()),
        "ceiling": Plane((0.0, 0.0, HEIGHT), (0.0, 0.0, -1.0), Rough()),
    }
    for i, angle in enumerate(np.linspace(0.0, 2.0 * np.pi, n_surfaces - 1)[: n_surfaces - 2]):
        out = (float(np.cos(angle)), float(np.sin(angle)), 0.0)
        planes[f"wall{i}"] = Plane(tuple(2.0 * c for c in out), tuple(-c for c in out), Rough())
    return Scene(BALL, dict(list(planes.items())[:n_surfaces]), **options)


def throws(n: int, dtype: Any) -> BallState:
    rng = np.random.default_rng(0)
    position = rng.uniform(-0.3, 0.3, (n, 3)) + [0.0, 0.0, 0.5]
    parts = position, rng.uniform(-6.0, 6.0, (n, 3)), 50.0 * rng.standard_normal((n, 3))
    return BallState(*(jnp.asarray(part.astype(dtype)) for part in parts))


def hop_limits(dtype: Any) -> dict:
    """What one bounce between floor and ceiling takes: FLOPS; and nine numbers read and written, for a program that
    keeps nothing between bounces (bounces.c does so once for all of them)."""
    return {"flops_each": FLOPS, "bytes_each": 18 * np.dtype(dtype).itemsize}


def on_one_device(states: BallState) -> BallState:
    return jax.device_put(states, jax.devices()[0])


def on_devices(own: Callable[[BallState], Any], states: BallState) -> dict[str, Callable[[], Any]]:
    """The final state on one device, and on all where there are several."""
    single = on_one_device(states)
    ways: dict[str, Callable] = {"one device": lambda: own(single).final}
    if len(jax.devices()) > 1:
        ways[f"{len(jax.devices())} devices"] = lambda: own(states).final
    return ways


def has_c() -> bool:
    """Whether a C program runs on what JAX runs on."""
    return shutil.which("cc") is not None and jax.default_backend() == "cpu"


class Program:
    """`run` of a C program beside this file, compiled for this machine: see lanes.h."""

    def __init__(self, source: str, dtype: Any, limit: int):
        self.dtype, self.limit = np.dtype(dtype), limit
        self.folder = tempfile.TemporaryDirectory()
        library = pathlib.Path(self.folder.name) / "program.so"
        options = ["-O3", "-march=native", "-fopenmp", "-fno-math-errno", "-fno-trapping-math", "-shared", "-fPIC"]
        name = "float" if self.dtype == np.float32 else "double"
        command = ["cc", *options, f"-DREAL={name}", str(HERE / source), "-o", str(library), "-lm"]
        subprocess.run(command, check=True)
        self.run = ctypes.CDLL(str(library)).run

    def _columns(self, rows: int, n: int) -> np.ndarray:
        size = self.dtype.itemsize
        if n * size % 64:
            raise ValueError(f"Argument `--throws` must be such that C has whole vectors, but got {n}; try 1048576.")
        raw = np.zeros(rows * n * size + 64, np.uint8)
        start = -raw.ctypes.data % 64
        return raw[start : start + rows * n * size].view(self.dtype).reshape(rows, n)

    def of(self, states: BallState, numbers: Sequence[Any]) -> Callable[[], np.ndarray]:
        """A function without arguments that runs these throws and gives ten columns, the same array every time."""
        before = self._columns(9, states.position.shape[0])
        before[:] = np.concatenate([np.asarray(x).T for x in (states.position, states.velocity, states.spin)])
        after, values = self._columns(10, before.shape[1]), np.array([float(x) for x in numbers], self.dtype)

        def way() -> np.ndarray:
            pointers = [ctypes.c_void_p(x.ctypes.data) for x in (before, after)]
            self.run(*pointers, ctypes.c_long(before.shape[1]), ctypes.c_void_p(values.ctypes.data), self.limit)
            return after

        return way


def distance(columns: np.ndarray, final: BallState) -> np.ndarray:
    """Between the final positions of a C program and of the library."""
    return np.linalg.norm(columns[:3].T - np.asarray(final.position), axis=-1)


def by_turns(ways: dict[str, Callable[[], Any]], runs: int) -> dict[str, tuple[float, float, float]]:
    """Seconds of the first call less one run, the median run, and half the spread of the middle half."""
    first = {name: _seconds(way, 1) for name, way in ways.items()}
    # A short run may fit between two interruptions by others, where a long one does not: so none is short.
    times_each = {name: max(1, min(math.ceil(SHORTEST / _seconds(way, 1)), 1000)) for name, way in ways.items()}
    times: dict[str, list] = {name: [] for name in ways}
    for _ in range(runs):
        for name, way in ways.items():
            times[name].append(_seconds(way, times_each[name]))
    middle = {name: np.quantile(t, [0.25, 0.5, 0.75]) for name, t in times.items()}
    return {
        name: (max(first[name] - m, 0.0), float(m), float(high - low) / 2) for name, (low, m, high) in middle.items()
    }


def _seconds(way: Callable[[], Any], count: int) -> float:
    """Of one run, out of so many."""
    begin = time.perf_counter()
    for _ in range(count):
        jax.block_until_ready(way())
    return (time.perf_counter() - begin) / count


def row(section: str, dtype: str, way: str, rate: float, unit: str, compiling: float, spread: float) -> dict:
    values = {"rate": rate, "unit": unit, "compile_seconds": compiling, "spread": spread}
    return {"section": section, "dtype": dtype, "way": way, **values}


def timed_rows(section: str, dtype: str, ways: dict[str, Callable], count: float, unit: str, runs: int) -> list[dict]:
    """A row for every way, of `count` done a run; with the share of C's rate where one is called C."""
    rows = [
        row(section, dtype, way, count / median, unit, compiling, spread / median)
        for way, (compiling, median, spread) in by_turns(ways, runs).items()
    ]
    rates = {each["way"]: each["rate"] for each in rows}
    return [each | {"of_c": each["rate"] / rates["C"]} for each in rows] if "C" in rates else rows
