"""Section `scaling` of bench_throughput.py."""

import numpy as np
from throughput_shared import BOUNCES, by_turns, room, row, throws

from nonholo_jax import Scene, simulate_batch


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
