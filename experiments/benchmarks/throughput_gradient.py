"""Section `gradient` of bench_throughput.py: time and memory of values and their gradients."""

import time
from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from throughput_shared import by_turns, room, row, throws

from nonholo_jax import Air, Integrated, Scene, simulate

MOTIONS = {"Exact": (None, room()), "Integrated": (Integrated(rtol=1e-6, atol=1e-6), room(air=Air()))}
# Room for so many impacts, in the rows of memory: those are compiled only. Integrated counts steps: 16 is as 64.
IMPACTS = {"Exact": (16, 64, 256, 1024), "Integrated": (64,)}
MEMORY_THROWS = 256


def gradient(n: int, runs: int) -> list[dict]:
    """Value, and value with the gradient in the nine numbers of a throw, of a scalar after 16 impacts."""
    rows = []
    for motion_name, (motion, scene) in MOTIONS.items():
        states, end = throws(n, np.float64), _end(scene, motion, 16)
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
    return rows + _memory(min(n, MEMORY_THROWS))


def _end(scene: Scene, motion: Any, impacts: int) -> Callable:
    def end(state):
        options = {"t1": 3.0, "max_impacts": impacts, "log_size": 0, "throw": False, "motion": motion}
        return simulate(scene, state, **options).final.position.sum()

    return end


def _memory(n: int) -> list[dict]:
    """What the compiled programs allocate beside their arguments and results. On a CPU the search for a path is in
    tiles of lanes, whose memory serves one after the other: a larger batch takes less of it for each throw. The replay
    of a gradient is not."""
    rows, states = [], throws(n, np.float64)
    for name, (motion, scene) in MOTIONS.items():
        for impacts in IMPACTS[name]:
            end = _end(scene, motion, impacts)
            used = {}
            for way, function in {"value": end, "reverse": jax.value_and_grad(end)}.items():
                begin = time.perf_counter()
                compiled = jax.jit(jax.vmap(function)).lower(states).compile()
                seconds = time.perf_counter() - begin
                analysis = compiled.memory_analysis()
                used[way] = float("nan") if analysis is None else analysis.temp_size_in_bytes / n
                what = f"{name}, {way}, room for {impacts}"
                each = row("gradient", "float64", what, used[way], "bytes/throw", seconds, 0.0)
                rows.append(each | {"times_value": used[way] / used["value"]})
    return rows
