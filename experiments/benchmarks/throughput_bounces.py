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
    hop_limits,
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
        new = timed_rows("limit", name, ways, n * BOUNCES, "bounces/s", runs)
        rows += [each | hop_limits(dtype) for each in new]
    return rows


def table(n: int, runs: int) -> list[dict]:
    """Throws of 1 s at the floor under a table, with spread enough that some hit its edges and corners."""
    rows = []
    for name, dtype in DTYPES.items():
        states = _under_the_table(n, dtype)
        own = lambda states: simulate_batch(TABLE, states, t1=1.0, max_impacts=16, log_size=0)  # noqa: E731
        impacts = float(own(states).n_impacts.sum())
        ways = on_devices(own, states)
        if has_c():
            numbers = [BALL.radius, 9.81, BALL.inertia_ratio, *TOP.center, *TOP.half_size, 1.0]
            program = Program("table.c", dtype, 16)
            ways["C"] = program.of(states, numbers)
            for which, others in {"these throws": states, "throws at its edges": _at_the_edges(n, dtype)}.items():
                columns, end = program.of(others, numbers)(), own(others)
                error, alike = np.median(distance(columns, end.final)), np.mean(columns[9] == end.n_impacts)
                print(f"{name}, {which}: C and this library end {error:.1e} m apart (median); ", end="")
                print(f"{alike:.3%} have the same number of impacts")
        rows += timed_rows("table", name, ways, impacts, "bounces/s", runs)
    return rows


def _under_the_table(n: int, dtype: Any) -> BallState:
    rng = np.random.default_rng(1)
    parts = ([-0.3, 0.0, 0.9], [2.0, 0.0, -5.0], [0.0, 15.0, 0.0])
    spread = (0.05, 0.3, 10.0)
    noisy = [np.asarray(m) + s * rng.standard_normal((n, 3)) for m, s in zip(parts, spread, strict=True)]
    return BallState(*(jnp.asarray(x.astype(dtype)) for x in noisy))


def _at_the_edges(n: int, dtype: Any) -> BallState:
    """Throws from all around at points near the edges and corners of the table: for the check alone."""
    rng = np.random.default_rng(2)
    center, half = (np.array([float(c) for c in x]) for x in (TOP.center, TOP.half_size))
    along = np.arange(3) == rng.integers(0, 4, (n, 1))  # of the edge; none for a corner
    target = center + half * np.where(along, rng.uniform(-1.0, 1.0, (n, 3)), rng.choice([-1.0, 1.0], (n, 3)))
    start = target + 0.3 * rng.standard_normal((n, 3))
    start[:, 2] = np.maximum(start[:, 2], 2.0 * BALL.radius)
    inside = (np.abs(start - center) < half + 2.0 * BALL.radius).all(axis=1)
    start[inside, 2] = center[2] + 0.5
    time = rng.uniform(0.1, 0.5, (n, 1))
    velocity = (target + 0.01 * rng.standard_normal((n, 3)) - start) / time + [0.0, 0.0, 0.5 * 9.81] * time
    spin = 50.0 * rng.standard_normal((n, 3))
    return BallState(*(jnp.asarray(x.astype(dtype)) for x in (start, velocity, spin)))
