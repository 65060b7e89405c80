"""Sections `limit` and `table` of bench_throughput.py: parabolas from impact to impact, beside C programs."""

from typing import Any

import jax.numpy as jnp
import numpy as np
from throughput_shared import (
    BALL,
    BOUNCES,
    DTYPES,
    HEIGHT,
    Program,
    distance,
    has_c,
    on_devices,
    room,
    throws,
    timed_rows,
)

from nonholo_jax import BallState, Box, Plane, Rough, Scene, simulate_batch

TOP = Box(center=(0.6, 0.0, 0.715), half_size=(0.6, 0.4, 0.015), law=Rough())
TABLE = Scene(BALL, {"floor": Plane((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), Rough()), "table": TOP})


def limit(n: int, runs: int) -> list[dict]:
    rows = []
    for name, dtype in DTYPES.items():
        states, scene = throws(n, dtype), room()
        own = lambda states, scene=scene: simulate_batch(scene, states, t1=1e3, max_impacts=BOUNCES, log_size=0)  # noqa: E731
        ways = on_devices(own, states)
        if has_c():
            ways["C"] = Program("bounces.c", dtype, BOUNCES).of(states, [HEIGHT, BALL.radius, 9.81, BALL.inertia_ratio])
            error = np.median(distance(ways["C"](), own(states).final))
            print(f"{name}: median difference after {BOUNCES} bounces, C and this library: {error:.1e} m")
        rows += timed_rows("limit", name, ways, n * BOUNCES, "bounces/s", runs)
    return rows


def table(n: int, runs: int) -> list[dict]:
    """Throws of 1 s at the floor under a table, with spread enough that some hit its edges and corners."""
    rows = []
    for name, dtype in DTYPES.items():
        states = _under_the_table(n, dtype)
        own = lambda states: simulate_batch(TABLE, states, t1=1.0, max_impacts=16, log_size=0)  # noqa: E731
        end = own(states)
        impacts = np.asarray(end.n_impacts)
        ways = on_devices(own, states)
        if has_c():
            numbers = [BALL.radius, 9.81, BALL.inertia_ratio, *TOP.center, *TOP.half_size, 1.0]
            ways["C"] = Program("table.c", dtype, 16).of(states, numbers)
            columns = ways["C"]()
            error, alike = np.median(distance(columns, end.final)), np.mean(columns[9] == impacts)
            print(f"{name}: median difference of the final position, C and this library: {error:.1e} m; ", end="")
            print(f"{alike:.3%} of the throws have the same number of impacts")
        rows += timed_rows("table", name, ways, float(impacts.sum()), "bounces/s", runs)
    return rows


def _under_the_table(n: int, dtype: Any) -> BallState:
    rng = np.random.default_rng(1)
    parts = ([-0.3, 0.0, 0.9], [2.0, 0.0, -5.0], [0.0, 15.0, 0.0])
    spread = (0.05, 0.3, 10.0)
    noisy = [np.asarray(m) + s * rng.standard_normal((n, 3)) for m, s in zip(parts, spread, strict=True)]
    return BallState(*(jnp.asarray(x.astype(dtype)) for x in noisy))
