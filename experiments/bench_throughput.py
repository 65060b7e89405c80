"""How many bounces a second, beside a C program; gradients beside values; scaling.

Sections: `limit`, floor and ceiling, elastic, 64 impacts of each throw, beside bounces.c (compiled here, -O3, OpenMP,
state in registers), on one device and on all; `table`, throws under a table, a Box; `gradient`, a scalar of the end
against that and its gradient in nine inputs, 16 impacts; `scaling`, with batch size, impacts and surfaces, with
compilation time beside it. All ways of a section run by turns, medians after compilation.

    python experiments/bench_throughput.py [--sections limit,table] [--throws 1048576] [--runs 5] [--json FILE]
"""

import argparse
import ctypes
import json
import os
import pathlib
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable
from typing import Any

# Every core is a device of its own; XLA reads this once, before JAX starts.
if "xla_force_host_platform_device_count" not in os.environ.get("XLA_FLAGS", ""):
    flag = f"--xla_force_host_platform_device_count={os.cpu_count()}"
    os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {flag}"

import jax
import jax.numpy as jnp
import numpy as np
from report import machine

from nonholo_jax import Air, Ball, BallState, Box, Integrated, Plane, Rough, Scene, simulate, simulate_batch

jax.config.update("jax_enable_x64", True)

HERE = pathlib.Path(__file__).parent
HEIGHT, BOUNCES = 1.0, 64
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


def on_one_device(states: BallState) -> BallState:
    return jax.device_put(states, jax.devices()[0])


class Limit:
    """bounces.c, compiled for this machine."""

    def __init__(self, dtype: Any):
        self.real = ctypes.c_float if dtype == np.float32 else ctypes.c_double
        self.folder = tempfile.TemporaryDirectory()
        library = pathlib.Path(self.folder.name) / "bounces.so"
        options = ["-O3", "-march=native", "-fopenmp", "-fno-math-errno", "-fno-trapping-math", "-shared", "-fPIC"]
        name = "float" if dtype == np.float32 else "double"
        command = ["cc", *options, f"-DREAL={name}", str(HERE / "bounces.c"), "-o", str(library), "-lm"]
        subprocess.run(command, check=True)
        self.run = ctypes.CDLL(str(library)).run

    def prepared(self, states: BallState) -> tuple[np.ndarray, np.ndarray]:
        columns = np.concatenate([np.asarray(x).T for x in (states.position, states.velocity, states.spin)])
        n, size = columns.shape[1], columns.itemsize
        assert n * size % 64 == 0, "the C program takes whole vectors: try a power of two"
        raw = np.zeros(10 * n * size + 64, np.uint8)
        start = -raw.ctypes.data % 64
        data = raw[start : start + 10 * n * size].view(columns.dtype).reshape(10, n)
        data[:9] = columns
        return columns, data

    def __call__(self, columns: np.ndarray, data: np.ndarray) -> np.ndarray:
        numbers = [self.real(float(x)) for x in (HEIGHT, BALL.radius, 9.81, BALL.inertia_ratio)]
        n = ctypes.c_long(data.shape[1])
        self.run(ctypes.c_void_p(data.ctypes.data), ctypes.c_void_p(data[9].ctypes.data), n, BOUNCES, *numbers)
        return data


def by_turns(ways: dict[str, Callable[[], Any]], runs: int) -> dict[str, tuple[float, float, float]]:
    """Seconds of the first call less one run, the median run, and half the spread of the middle half."""
    first = {}
    for name, way in ways.items():
        begin = time.perf_counter()
        jax.block_until_ready(way())
        first[name] = time.perf_counter() - begin
    times: dict[str, list] = {name: [] for name in ways}
    for _ in range(runs):
        for name, way in ways.items():
            begin = time.perf_counter()
            jax.block_until_ready(way())
            times[name].append(time.perf_counter() - begin)
    middle = {name: np.quantile(t, [0.25, 0.5, 0.75]) for name, t in times.items()}
    return {
        name: (max(first[name] - m, 0.0), float(m), float(high - low) / 2) for name, (low, m, high) in middle.items()
    }


def limit(n: int, runs: int) -> list[dict]:
    rows = []
    for name, dtype in DTYPES.items():
        states, scene = throws(n, dtype), room()
        own = lambda states, scene=scene: simulate_batch(scene, states, t1=1e3, max_impacts=BOUNCES, log_size=0)  # noqa: E731
        single = on_one_device(states)
        ways: dict[str, Callable] = {"one device": lambda own=own, states=single: own(states).final}
        if len(jax.devices()) > 1:
            ways[f"{len(jax.devices())} devices"] = lambda own=own, states=states: own(states).final
        if shutil.which("cc") and jax.default_backend() == "cpu":
            program = Limit(dtype)
            columns, data = program.prepared(states)
            ways["C"] = lambda program=program, columns=columns, data=data: program(columns, data)
            data[:9] = columns
            program(columns, data)
            error = float(np.median(np.abs(data[0] - np.asarray(own(states).final.position)[:, 0])))
            print(f"{name}: median difference of x after {BOUNCES} bounces, C and this library: {error:.1e} m")
        for way, (compiling, median, spread) in by_turns(ways, runs).items():
            rows.append(row("limit", name, way, n * BOUNCES / median, "bounces/s", compiling, spread / median))
        rates = {r["way"]: r["rate"] for r in rows if r["dtype"] == name}
        for each in (r for r in rows if r["dtype"] == name and "C" in rates):
            each["of_c"] = each["rate"] / rates["C"]
    return rows


def table(n: int, runs: int) -> list[dict]:
    rows = []
    top = Box(center=(0.6, 0.0, 0.715), half_size=(0.6, 0.4, 0.015), law=Rough())
    scene = Scene(BALL, {"floor": Plane((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), Rough()), "table": top})
    rng = np.random.default_rng(1)
    for name, dtype in DTYPES.items():
        parts = ([-0.3, 0.0, 0.9], [2.0, 0.0, -5.0], [0.0, 15.0, 0.0])
        spread = (0.05, 0.3, 10.0)
        noisy = [np.asarray(m) + s * rng.standard_normal((n, 3)) for m, s in zip(parts, spread, strict=True)]
        states = BallState(*(jnp.asarray(x.astype(dtype)) for x in noisy))
        own = lambda states: simulate_batch(scene, states, t1=1.0, max_impacts=16, log_size=0)  # noqa: E731
        count = float(own(states).n_impacts.sum())
        single = on_one_device(states)
        ways = {"one device": lambda own=own, states=single: own(states).final}
        if len(jax.devices()) > 1:
            ways[f"{len(jax.devices())} devices"] = lambda own=own, states=states: own(states).final
        for way, (compiling, median, spread_) in by_turns(ways, runs).items():
            rows.append(row("table", name, way, count / median, "bounces/s", compiling, spread_ / median))
    return rows


def gradient(n: int, runs: int) -> list[dict]:
    """Value, and value with the gradient in the nine numbers of a throw, of a scalar after 16 impacts."""
    rows = []
    motions = {"Exact": (None, room()), "Integrated": (Integrated(rtol=1e-6, atol=1e-6), room(air=Air()))}
    for motion_name, (motion, scene) in motions.items():
        states = throws(n, np.float64)

        def end(state, scene=scene, motion=motion):
            options = {"t1": 3.0, "max_impacts": 16, "log_size": 0, "throw": False, "motion": motion}
            return simulate(scene, state, **options).final.position.sum()

        value = jax.jit(jax.vmap(end))
        reverse = jax.jit(jax.vmap(jax.value_and_grad(end)))
        forward = jax.jit(jax.vmap(lambda state, end=end: (end(state), jax.jacfwd(end)(state))))
        ways = {name: (lambda way=way, states=states: way(states))
                for name, way in {"value": value, "reverse": reverse, "forward": forward}.items()}  # fmt: skip
        timed = by_turns(ways, runs)
        for way, (compiling, median, spread) in timed.items():
            ratio = {"times_value": median / timed["value"][1]}
            name = f"{motion_name}, {way}"
            rows.append(row("gradient", "float64", name, n / median, "throws/s", compiling, spread / median) | ratio)
    return rows


def scaling(n: int, runs: int) -> list[dict]:
    rows = []

    def add(what: str, scene: Scene, n: int, bounces: int) -> None:
        states = throws(n, np.float32)
        run = lambda: simulate_batch(scene, states, t1=1e6, max_impacts=bounces, log_size=0).final  # noqa: E731
        ((compiling, median, spread),) = by_turns({"": run}, runs).values()
        rows.append(row("scaling", "float32", what, n * bounces / median, "bounces/s", compiling, spread / median))

    for size in (1, 100, 10_000, 1_000_000, 10_000_000):
        if size <= 10 * n:
            add(f"{size} throws", room(), size, BOUNCES if size < 10_000_000 else 8)
    for bounces in (1, 10, 100, 1_000, 10_000):
        add(f"{bounces} impacts", room(), 4096, bounces)
    for surfaces in (1, 2, 4, 8, 16):
        add(f"{surfaces} surfaces", room(surfaces), 4096, BOUNCES)
    return rows


def row(section: str, dtype: str, way: str, rate: float, unit: str, compiling: float, spread: float) -> dict:
    values = {"rate": rate, "unit": unit, "compile_seconds": compiling, "spread": spread}
    return {"section": section, "dtype": dtype, "way": way, **values}


def printed(rows: list[dict]) -> None:
    for r in rows:
        extra = f"  {r['of_c']:.2f} of C" if "of_c" in r else ""
        extra += f"  {r['times_value']:.1f} x value" if "times_value" in r else ""
        head = f"{r['section']:>9}  {r['dtype']:>8}  {r['way']:>20}"
        timing = f"+- {r['spread']:4.0%}  compile {r['compile_seconds']:5.1f} s"
        print(f"{head}  {r['rate']:9.3g} {r['unit']:9}  {timing}{extra}")


SECTIONS = {"limit": limit, "table": table, "gradient": gradient, "scaling": scaling}


def main() -> None:
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("--sections", default=",".join(SECTIONS))
    parser.add_argument("--throws", type=int, default=1 << 20)
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--json")
    options = parser.parse_args()
    unknown = set(options.sections.split(",")) - set(SECTIONS)
    if unknown:
        parser.error(f"--sections must be of {', '.join(SECTIONS)}, but got {', '.join(sorted(unknown))}")
    print(f"{machine()}, {len(jax.devices())} devices, {options.throws} throws")
    sizes = {
        "limit": options.throws,
        "table": options.throws // 16,
        "gradient": options.throws // 64,
        "scaling": options.throws,
    }
    rows = []
    for name in options.sections.split(","):
        new = SECTIONS[name](sizes[name], options.runs)
        printed(new)
        rows += new
    if options.json:
        pathlib.Path(options.json).write_text(json.dumps({"machine": machine(), "rows": rows}, indent=1))


if __name__ == "__main__":
    main()
