"""What each ingredient of a scene costs, and that what is absent costs nothing.

The base is a rough elastic ball on a floor, 1.5 s, without a log; every other line adds one thing. For each: how many
operations the compiled program has, compilation time, and time per throw, as a ratio to the base, by turns. Beside them
a minimal function of JAX, written by hand for that one scene, for the same bounces.

    python experiments/benchmarks/bench_scene_cost.py [--throws 65536] [--runs 7] [--json FILE]
"""

import argparse
import json
import pathlib
import re
import sys
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from throughput_shared import by_turns

from nonholo_jax import (
    Air,
    Ball,
    BallState,
    Box,
    Frictional,
    Integrated,
    Plane,
    Rough,
    Scene,
    simulate_batch,
)

sys.path.append(str(pathlib.Path(__file__).parents[1]))  # for report.py
from report import machine

jax.config.update("jax_enable_x64", True)

BALL, T1, G = Ball(radius=0.025, mass=0.046), 1.5, 9.81
UP = (0.0, 0.0, 1.0)
# Which file of the library stands for an ingredient: its code must not be in the program of a scene without it.
CODE = {
    "integrator": "_motion/integrated.py",
    "quaternion": "_math/rotation.py",
    "table": "_world/box.py",
    "air": "_world/air.py",
}


def throws(n: int, orientation: bool = False) -> BallState:
    rng = np.random.default_rng(0)
    position = rng.uniform(-0.3, 0.3, (n, 3)) + [0.0, 0.0, 0.4]
    parts = position, rng.uniform(-1.0, 1.0, (n, 3)), 50.0 * rng.standard_normal((n, 3))
    turned = jnp.tile(jnp.array([[1.0, 0.0, 0.0, 0.0]]), (n, 1)) if orientation else None
    position, velocity, spin = (jnp.asarray(part) for part in parts)
    return BallState(position, velocity, spin, turned)


def scene(n_walls: int = 0, law: Any = None, table: bool = False, **options) -> Scene:
    """A floor; walls far around, which no throw reaches; a table beside."""
    law = Rough() if law is None else law
    surfaces: dict[str, Any] = {"floor": Plane((0.0, 0.0, 0.0), UP, law)}
    for i in range(n_walls):
        angle = 2.0 * np.pi * i / n_walls
        out = (float(np.cos(angle)), float(np.sin(angle)), 0.0)
        surfaces[f"wall{i}"] = Plane(tuple(20.0 * c for c in out), tuple(-c for c in out), law)
    if table:
        surfaces["table"] = Box(center=(5.0, 0.0, 0.7), half_size=(0.6, 0.4, 0.015), law=law)
    return Scene(BALL, surfaces, **options)


def minimal(states: BallState) -> BallState:
    """The base, by hand: no other surface, law, result, log, corner, rounding, rest, or check of anything."""

    def turn(c):
        (x, y, z), (u, v, w), (a, b, s), left, n = c
        fall = z - BALL.radius
        h = (w + jnp.sqrt(jnp.maximum(w * w + 2.0 * G * fall, 0.0))) / G
        hits = h < left
        h = jnp.minimum(h, left)
        x, y, z, w = x + u * h, y + v * h, z + h * (w - 0.5 * G * h), w - G * h
        k = 2.0 * BALL.inertia_ratio / (1.0 + BALL.inertia_ratio)
        twist = k / (BALL.inertia_ratio * BALL.radius)
        slip_x, slip_y = u - BALL.radius * b, v + BALL.radius * a
        u, v = jnp.where(hits, u - k * slip_x, u), jnp.where(hits, v - k * slip_y, v)
        a, b = jnp.where(hits, a - twist * slip_y, a), jnp.where(hits, b + twist * slip_x, b)
        return (x, y, z), (u, v, jnp.where(hits, -w, w)), (a, b, s), left - h, n + hits

    def tile(columns):
        begin = (columns[:3], columns[3:6], columns[6:], jnp.full_like(columns[0], T1), jnp.zeros_like(columns[0], int))
        return lax.while_loop(lambda c: jnp.any(c[3] > 0), turn, begin)

    parts = (states.position, states.velocity, states.spin)
    columns = tuple(part[:, i].reshape(-1, 1024) for part in parts for i in range(3))
    *found, _, _ = lax.map(tile, columns)
    return BallState(*(jnp.stack([c.reshape(-1) for c in part], axis=-1) for part in found))


def ways(n: int) -> dict[str, tuple[Callable, BallState]]:
    def by(room: Scene, log: int = 0, motion: Any = None) -> Callable:
        options = {"t1": T1, "log_size": log, "motion": motion, "max_impacts": 16}
        return lambda states: simulate_batch(room, states, **options)

    def end(room: Scene) -> Callable:
        run = by(room)
        total = lambda states: run(states).final.position.sum()  # noqa: E731
        return lambda states: jax.value_and_grad(total)(states)

    plain, oriented = throws(n), throws(n, orientation=True)
    final = lambda run: lambda states: run(states).final  # noqa: E731
    air = Air()
    return {
        "by hand": (minimal, plain),
        "floor": (final(by(scene())), plain),
        "+ restitution 0.8, bounces that die out": (final(by(scene(law=Rough(0.8)))), plain),
        "+ friction": (final(by(scene(law=Frictional(1.0, 0.5, 0.3)))), plain),
        "+ 1 wall": (final(by(scene(1))), plain),
        "+ 3 walls": (final(by(scene(3))), plain),
        "+ 7 walls": (final(by(scene(7))), plain),
        "+ a table (Box)": (final(by(scene(table=True))), plain),
        "+ orientation": (final(by(scene())), oriented),
        "+ log of 16 rows": (by(scene(), 16), plain),
        "+ air (Integrated, 1e-8)": (final(by(scene(air=air))), plain),
        "+ Integrated without air": (final(by(scene(), motion=Integrated())), plain),
        "+ gradient in 9 numbers": (end(scene()), plain),
    }


def operations(text: str) -> int:
    return len(re.findall(r"^\s+(?:ROOT )?%?[\w.-]+ = ", text, re.M)) - len(
        re.findall(r" (?:parameter|constant)\(", text)
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("--throws", type=int, default=1 << 16)
    parser.add_argument("--runs", type=int, default=7)
    parser.add_argument("--json")
    options = parser.parse_args()
    if options.throws < 1024 or options.throws % 1024:
        parser.error(f"--throws must be a multiple of 1024, but got {options.throws}")
    print(f"{machine()}, {options.throws} throws, float64")
    programs, runs, rows = {}, {}, []
    every = ways(options.throws)
    for name, (way, states) in every.items():
        programs[name] = jax.jit(way)
        runs[name] = lambda name=name, states=states: programs[name](states)
    timed = by_turns(runs, options.runs)
    exact = {name: np.asarray(jax.tree.leaves(programs[name](throws(1024)))[0]) for name in ("by hand", "floor")}
    print(f"by hand and floor agree to {np.abs(exact['by hand'] - exact['floor']).max():.1e} m")
    base = timed["floor"][1]
    for name, (_, states) in every.items():
        text = programs[name].lower(states).compile().as_text() or ""
        compiling, median, spread = timed[name]
        inside = [what for what, file in CODE.items() if file in text]
        values = {"operations": operations(text), "seconds": median / options.throws, "contains": inside}
        rows.append({"what": name, **values, "ratio": median / base, "spread": spread / median, "compile": compiling})
        size = f"{values['operations']:6} operations  compile {compiling:5.1f} s  {1e9 * values['seconds']:8.0f} ns"
        print(f"{name:>40}  {size}  +- {spread / median:4.0%}  {median / base:7.2f} x floor  {', '.join(inside)}")
    if options.json:
        pathlib.Path(options.json).write_text(json.dumps({"machine": machine(), "rows": rows}, indent=1))


if __name__ == "__main__":
    main()
