"""A ball that rolls over the floor climbs a kerb of height h if it is fast enough. At the impact, which neither bounces
nor slips, the angular momentum about the edge stays: v+ = v (1 - h / ((1 + alpha) r)). Then it turns about the edge,
and comes over if (1 + alpha) v+^2 / 2 > g h. So it does on kerbs up to h = r (1 + alpha) / (3 + alpha); from a higher
one a ball that is fast enough flies off the edge first.

Picture: the slowest speed that climbs, by bisection, against that formula; and how the speed changes on the way."""

import pathlib
import sys
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from nonholo_jax import Ball, BallState, Box, Exact, Integrated, Plane, Rough, Scene, simulate, simulate_batch

sys.path.append(str(pathlib.Path(__file__).parents[1]))  # for report.py
from report import BLUE, FAINT, GREEN, INK, VERMILION, Check, figure, save, table

NAME = "over_a_kerb"
R, G, START = 0.1, 9.81, 0.2
MOTION = Exact(contact=Integrated(rtol=1e-10, atol=1e-10))


def slowest(h: Any, alpha: Any) -> Any:
    """The speed above which a ball climbs."""
    return np.sqrt(2.0 * G * h / (1.0 + alpha)) / (1.0 - h / ((1.0 + alpha) * R))


def street(h: Any, alpha: Any = 0.4) -> Scene:
    law = Rough(0.0)
    floor = Plane((0, 0, 0), (0, 0, 1), law)
    kerb = Box(center=jnp.stack([1.0 + 0 * h, 0 * h, h - 1.0]), half_size=(1.0, 1.0, 1.0), law=law)
    return Scene(Ball(R, 1.0, alpha), {"floor": floor, "kerb": kerb})


def rolling(v: Any) -> BallState:
    zero = jnp.zeros_like(v)
    return BallState(
        jnp.stack([zero - START, zero, zero + R], -1),
        jnp.stack([v, zero, zero], -1),
        jnp.stack([zero, v / R, zero], -1),
    )


def found(heights: np.ndarray, alphas: np.ndarray, rounds: int = 16, first: float = 0.02) -> np.ndarray:
    """The same by bisection, for all kerbs at once, from speeds that are off by `first` on both sides."""
    h, alpha = jnp.asarray(heights), jnp.asarray(alphas)
    scenes = jax.vmap(street)(h, alpha)
    low, high = ((1.0 + sign * first) * jnp.asarray(slowest(heights, alphas)) for sign in (-1.0, 1.0))
    for _ in range(rounds):
        middle = 0.5 * (low + high)
        ends = simulate_batch(scenes, rolling(middle), t1=6.0, scene_axes=0, log_size=0, motion=MOTION, throw=True)
        climbs = ends.final.velocity[:, 0] > 0
        low, high = jnp.where(climbs, low, middle), jnp.where(climbs, middle, high)
    return np.asarray(0.5 * (low + high))


def checks(n: int = 12, rounds: int = 16, bound: float = 1e-5) -> list[Check]:
    heights, alphas = np.linspace(0.05, 0.38, n) * R, np.resize([0.4, 2 / 3, 0.5], n)
    speeds = slowest(heights, alphas)
    off = float(np.max(np.abs(found(heights, alphas, rounds) / speeds - 1.0)))
    rows = [Check(f"slowest speed that climbs, {n} kerbs, relative", off, bound)]
    h, v = 0.3 * R, 1.05 * slowest(0.3 * R, 0.4)
    out = simulate(street(jnp.asarray(h)), rolling(jnp.asarray(v)), t1=0.9, motion=MOTION)
    after = float(jnp.linalg.norm(out.impacts.after.velocity[1]))
    rows.append(Check("speed after the impact, relative", abs(after / (v * (1 - h / (1.4 * R))) - 1), 1e-12))
    over = np.sqrt((v * (1 - h / (1.4 * R))) ** 2 - 2 * G * h / 1.4)
    rows.append(Check("speed on the kerb, relative", abs(float(out.final.velocity[0]) / over - 1.0), 1e-6))
    return rows


def picture() -> None:
    new, (left, right) = figure(7.2, 3.1, 1, 2, width_ratios=[1, 1.15])
    fine = np.linspace(0.0, 0.41, 200)
    for alpha, colour, label in ((0.4, BLUE, "solid ball"), (2 / 3, VERMILION, "thin shell")):
        heights = np.linspace(0.05, 0.38, 7) * R
        left.plot(fine, slowest(fine * R, alpha), color=colour, lw=1.2, label=label)
        left.plot(heights / R, found(heights, np.full(7, alpha), 12), "o", color=colour, ms=3.5, mfc="white")
    left.set_xlabel("height of the kerb / radius", fontsize=9)
    left.set_ylabel("slowest speed that climbs (m/s)", fontsize=9)
    left.legend(fontsize=7.5, frameon=False)
    h = 0.35 * R
    for factor, colour in ((0.95, INK), (1.02, GREEN), (1.2, VERMILION)):
        state = rolling(jnp.asarray(factor * slowest(h, 0.4)))
        ends = [simulate(street(jnp.asarray(h)), state, t1=t, motion=MOTION).final for t in np.linspace(0.0, 0.8, 161)]
        path = np.array([(end.position[0], end.velocity[0]) for end in ends])
        right.plot(path[:, 0], path[:, 1], color=colour, lw=1.2, label=f"{factor:g} of the slowest that climbs")
    right.axvline(-np.sqrt(R**2 - (R - h) ** 2), color=FAINT, lw=0.8, ls=":")
    right.axvspan(0.0, 0.3, color=FAINT, alpha=0.3, lw=0)
    right.text(0.15, 0.03, "on the kerb", fontsize=8, ha="center")
    right.axhline(0.0, color=FAINT, lw=0.8)
    right.set(xlim=(-0.25, 0.3))
    right.set_xlabel("x of the centre (m)", fontsize=9)
    right.set_ylabel("speed along x (m/s)", fontsize=9)
    right.legend(fontsize=7.5, frameon=False, loc="upper right")
    save(new, NAME)


def main() -> int:
    failed = table("A ball climbs a kerb", checks())
    picture()
    return failed


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    raise SystemExit(main())
