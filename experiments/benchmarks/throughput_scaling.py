"""Section `scaling` of bench_throughput.py: batch, impacts, surfaces, devices; and how long `simulate` compiles."""

import time
from collections.abc import Callable

import equinox as eqx
import jax
import numpy as np
from jax.sharding import Mesh, PartitionSpec
from throughput_shared import BOUNCES, by_turns, hop_limits, room, row, throws

from nonholo_jax import Air, BallState, Integrated, Scene, simulate, simulate_batch

BATCHES = tuple(10**k for k in range(8))
IMPACTS = 1, 10, 100, 1_000, 10_000
# More surfaces are left out: 64 of them compiled in 126 s (one busy core, JAX 0.12), above the 60 s given to a row.
SURFACES = 1, 2, 4, 8, 16, 32
FEW = 4096  # throws, where not they are varied
BUDGET = {"Exact": 2.0, "Integrated": 4.0}  # s, for `simulate` to trace and compile


def scaling(n: int, runs: int) -> list[dict]:
    rows = []
    for size in BATCHES:
        if size <= 10 * n:
            rows += _timed(f"{size} throws", room(), size, BOUNCES if size < 10_000_000 else 8, runs)
    for bounces in IMPACTS:
        rows += _timed(f"{bounces} impacts", room(), FEW, bounces, runs)
    for surfaces in SURFACES:
        rows += _timed(f"{surfaces} surfaces", room(surfaces), FEW, BOUNCES, runs)
    return rows + _devices(n, runs) + _compiling()


def _batch(scene: Scene, bounces: int) -> Callable:
    return lambda states: simulate_batch(scene, states, t1=1e6, max_impacts=bounces, log_size=0)


def _timed(what: str, scene: Scene, n: int, bounces: int, runs: int) -> list[dict]:
    states, own = throws(n, np.float32), _batch(scene, bounces)
    ((compiling, median, spread),) = by_turns({"": lambda: own(states).final}, runs).values()
    impacts = float(own(states).n_impacts.astype(float).sum())  # a throw may end before, in a corner
    new = row("scaling", "float32", what, impacts / median, "bounces/s", compiling, spread / median)
    return [new | (hop_limits(np.float32) if len(scene.surfaces) == 2 else {})]


def _devices(n: int, runs: int) -> list[dict]:
    """The same throws over more and more devices."""
    count, ways = len(jax.devices()), {}
    n, spec = n // count * count, PartitionSpec("lanes")
    states = throws(n, np.float32)
    for k in sorted({2**i for i in range(count.bit_length())} | {count}):
        if k <= count and n % k == 0:
            mesh = Mesh(np.array(jax.devices()[:k]), ("lanes",))
            final = lambda states: _batch(room(), BOUNCES)(states).final  # noqa: E731
            over = jax.jit(jax.shard_map(final, mesh=mesh, in_specs=spec, out_specs=spec, check_vma=False))
            ways[f"{k} of {count} devices"] = lambda over=over: over(states)
    return [
        row("scaling", "float32", way, n * BOUNCES / median, "bounces/s", compiling, spread / median)
        | hop_limits(np.float32)
        for way, (compiling, median, spread) in by_turns(ways, runs).items()
    ]


def _compiling() -> list[dict]:
    """`simulate` of one throw with its log, traced and compiled, against the budget."""
    rows = []
    state = jax.tree.map(lambda x: x[0], throws(1, np.float64))
    for name, (motion, scene) in {"Exact": (None, room()), "Integrated": (Integrated(), room(air=Air()))}.items():

        def run(state: BallState, motion=motion, scene=scene):
            return simulate(scene, state, t1=1.5, motion=motion)

        begin = time.perf_counter()
        eqx.filter_jit(run).lower(state).compile()
        seconds = time.perf_counter() - begin
        new = row("scaling", "float64", f"{name}, simulate", 1.0 / seconds, "compiles/s", seconds, 0.0)
        rows.append(new | {"budget_seconds": BUDGET[name]})
    return rows
