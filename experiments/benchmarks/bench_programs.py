"""How large the compiled programs are, and how long a first answer takes: budgets, and what is measured against them.

    python experiments/benchmarks/bench_programs.py [--json FILE] [--only WORD]

Sizes are lines of StableHLO with an operation, constants included, calls expanded at every call site, without host
callbacks. Times are those of a fresh process for each row, whose imports are not counted, with JAX's cache on disk off;
a second call is the median of 50. The exit code is 1 if a size is above its budget. Times are printed beside theirs,
and do not count: they depend on the machine, and on what else it does.
"""

import argparse
import json
import os
import pathlib
import re
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from typing import Any, NamedTuple

ROOT = pathlib.Path(__file__).parents[2]
if str(ROOT / "experiments") not in sys.path:
    sys.path.append(str(ROOT / "experiments"))

OPTIONS: dict[str, Any] = {"t1": 2.0, "max_impacts": 16, "throw": False}
LANES = 1024


class Row(NamedTuple):
    """What is measured, and its budget: what it has to be at least, and what it should be."""

    name: str
    unit: str
    least: float
    goal: float


ROWS = [
    Row("batch, floor + table: lines", "lines", 4500, 2000),
    Row("its reverse gradient: lines", "lines", 16_000, 6000),
    Row("with air, gradient: lines", "lines", 26_000, 10_000),
    Row("first simulate", "s", 1.5, 0.7),
    Row("first simulate, with air", "s", 4.0, 1.5),
    Row("first grad", "s", 7.0, 2.0),
    Row("first grad, with air", "s", 15.0, 4.0),
    Row("28 pegs, batch of 2000, first call", "s", 8.0, 3.0),
    Row("programs compiled by one simulate", "programs", 2, 1),
    Row("programs compiled by one simulate, with air", "programs", 2, 1),
    Row("second simulate", "ms", 2.0, 0.3),
    Row("second grad", "ms", 8.0, 1.0),
    Row("nonholo design under_the_table", "s", 7.0, 4.0),
]


def lines_of(text: str) -> int:
    """Operations of a StableHLO module, with every function counted as often as it is called."""
    own: dict[str, int] = {}
    calls: dict[str, list[str]] = {}
    name = ""
    for line in text.splitlines():
        if header := re.search(r"func\.func (?:public |private )?@([\w.\-]+)", line):
            name = header[1]
            own[name], calls[name] = 0, []
        elif called := re.search(r"call @([\w.\-]+)", line):
            calls[name].append(called[1])
        elif " = " in line and name:
            own[name] += 1
    total: dict[str, int] = {}

    def count(function: str) -> int:
        if function not in total:
            total[function] = own[function] + sum(count(each) for each in calls[function])
        return total[function]

    return count("main")


# What runs in a fresh process: each returns one number for its row, and prints nothing.


def _scene(air: bool = False) -> Any:
    from nonholo_jax import Air, Ball, Box, Plane, Rough, Scene

    law = Rough(0.9)
    table = Box(center=(0.6, 0.0, 0.715), half_size=(0.6, 0.4, 0.015), law=law)
    surfaces = {"floor": Plane((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), law), "table": table}
    return Scene(Ball(0.025, 0.046), surfaces, air=Air() if air else None)


def _pegs() -> tuple:
    """A board of 28 pegs above a floor, and 2,000 balls let go in a row above it."""
    import numpy as np

    from nonholo_jax import Ball, BallState, Cylinder, Plane, Rough, Scene

    law = Rough(0.6)
    surfaces: dict[str, Any] = {"floor": Plane((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), law)}
    for i in range(4):
        for j in range(7):
            place = ((j - 3 + 0.5 * (i % 2)) * 0.1, 0.0, 0.3 + 0.1 * i)
            surfaces[f"peg_{i}_{j}"] = Cylinder(point=place, axis=(0.0, 1.0, 0.0), radius=0.01, law=law)
    x = np.linspace(-0.1, 0.1, 2000)
    position = np.stack([x, 0.0 * x, 0.0 * x + 0.9], axis=1)
    return Scene(Ball(0.008, 0.005), surfaces), BallState(position, 0.0 * position, 0.0 * position)


def _throw() -> Any:
    from nonholo_jax import BallState

    return BallState([-0.3, 0.0, 0.9], [2.0, 0.0, -5.0], [0.0, 15.0, 0.0])


def _batch() -> Any:
    import jax
    import jax.numpy as jnp

    return jax.tree.map(lambda x: jnp.broadcast_to(x, (LANES, *x.shape)), _throw())


def _end(scene: Any) -> Callable:
    from nonholo_jax import simulate

    return lambda state: simulate(scene, state, **OPTIONS).final.position.sum()


def size(air: bool, gradient: bool) -> dict:
    import jax

    from nonholo_jax import simulate_batch

    scene = _scene(air)
    end: Any = lambda states: simulate_batch(scene, states, log_size=0, **OPTIONS).final.position.sum()  # noqa: E731
    states = _batch()
    times = [time.perf_counter()]
    traced = jax.jit(jax.grad(end) if gradient else end).trace(states)
    times.append(time.perf_counter())
    lowered = traced.lower()
    times.append(time.perf_counter())
    value = lines_of(lowered.as_text())
    begun = time.perf_counter()
    lowered.compile()
    parts = [b - a for a, b in zip(times, times[1:], strict=False)]
    return {"value": value, "trace": parts[0], "lower": parts[1], "compile": time.perf_counter() - begun}


def first(air: bool, gradient: bool) -> dict:
    import jax

    scene, state, end = _scene(air), _throw(), None
    end = _end(scene)
    begun = time.perf_counter()
    jax.block_until_ready(jax.grad(end)(state) if gradient else end(state))
    return {"value": time.perf_counter() - begun}


def pegs() -> dict:
    import jax

    from nonholo_jax import simulate_batch

    scene, states = _pegs()
    begun = time.perf_counter()
    jax.block_until_ready(simulate_batch(scene, states, t1=2.0, max_impacts=64, log_size=0).final.position)
    return {"value": time.perf_counter() - begun}


def programs(air: bool) -> dict:
    """How many programs XLA compiles for one `simulate` with a log, once the state is an array."""
    import jax

    from nonholo_jax import simulate

    scene, state = _scene(air), _throw()
    count = [0]

    def heard(event: str, *_: Any, **__: Any) -> None:
        count[0] += event == "/jax/core/compile/backend_compile_duration"

    jax.monitoring.register_event_duration_secs_listener(heard)
    simulate(scene, state, **OPTIONS)
    return {"value": count[0]}


def second(gradient: bool) -> dict:
    import jax

    from nonholo_jax import simulate

    scene, state = _scene(), _throw()
    end = jax.grad(_end(scene)) if gradient else lambda state: simulate(scene, state, **OPTIONS).final.position
    jax.block_until_ready(end(state))
    times = []
    for _ in range(50):
        begun = time.perf_counter()
        jax.block_until_ready(end(state))
        times.append(1e3 * (time.perf_counter() - begun))
    return {"value": statistics.median(times)}


def design() -> dict:
    with tempfile.TemporaryDirectory() as folder:
        start = "import sys; from nonholo_jax.cli import main; sys.exit(main())"
        command = [sys.executable, "-c", start, "design"]
        command += [str(ROOT / "experiments/scenes/under_the_table.toml"), "--out", folder, "--json"]
        environment = {**os.environ, "NONHOLO_CACHE": "off"}
        begun = time.perf_counter()
        subprocess.run(command, check=True, capture_output=True, env=environment)
        return {"value": time.perf_counter() - begun}


JOBS: list[Callable[[], dict]] = [
    lambda: size(False, False),
    lambda: size(False, True),
    lambda: size(True, True),
    lambda: first(False, False),
    lambda: first(True, False),
    lambda: first(False, True),
    lambda: first(True, True),
    pegs,
    lambda: programs(False),
    lambda: programs(True),
    lambda: second(False),
    lambda: second(True),
    design,
]


def measured(index: int) -> dict:
    """One row, in a process of its own."""
    environment = {**os.environ, "JAX_ENABLE_COMPILATION_CACHE": "false", "JAX_ENABLE_X64": "true"}
    command = [sys.executable, __file__, "--row", str(index)]
    done = subprocess.run(command, check=True, capture_output=True, text=True, env=environment, cwd=ROOT)
    return json.loads(done.stdout.splitlines()[-1])


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=pathlib.Path, help="write the rows there, too")
    parser.add_argument("--only", default="", help="only rows whose name holds this")
    parser.add_argument("--row", type=int, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.row is not None:
        print(json.dumps(JOBS[given.row]()))
        return 0
    from report import machine

    print(machine())
    print(f"{'':46s}{'measured':>10s}{'at least':>10s}{'goal':>8s}")
    rows, failed = [], False
    for index, row in enumerate(ROWS):
        if given.only not in row.name:
            continue
        found = measured(index)
        value = found["value"]
        missed = value > row.least
        failed |= missed and row.unit in ("lines", "programs")
        note = "" if value > row.goal else "  goal"
        note = "  MISSED" if missed else note
        parts = "".join(f"  {name} {found[name]:.1f} s" for name in ("trace", "lower", "compile") if name in found)
        print(f"{row.name:46s}{value:10.5g}{row.least:10g}{row.goal:8g} {row.unit}{note}{parts}", flush=True)
        rows.append({**row._asdict(), **found})
    if given.json is not None:
        given.json.write_text(json.dumps({"machine": machine(), "rows": rows}, indent=1))
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
