"""Section `gradient` of bench_throughput.py."""

import jax
import numpy as np
from throughput_shared import by_turns, room, row, throws

from nonholo_jax import Air, Integrated, simulate


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
