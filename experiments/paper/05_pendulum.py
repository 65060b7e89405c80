"""The nonholonomic pendulum, section 5.2.1: thrown with spin = r m v / J, a rough elastic ball flies along one
parabola, there and back, for ever.

Picture: the parabola with what reverses at its ends, and how far from the first two places the ball still bounces."""

import pathlib
import sys

import jax
import jax.numpy as jnp
import numpy as np
from systems import ALPHA, G, J, M, R, thrown_ball

from nonholo_jax import Ball, BallState, Integrated, Plane, Rough, Scene, Trajectory, energy, simulate

sys.path.append(str(pathlib.Path(__file__).parents[1]))  # for report.py
from report import BLUE, FAINT, INK, VERMILION, Check, figure, residuals, save, table

NAME = "pendulum"
V, U = 0.4, 1.1  # m/s along and up
SPIN = R * M * V / J
PERIOD = 4 * U / G  # there and back
SCENE = Scene(Ball(R, M, ALPHA), {"floor": Plane((0, 0, 0), (0, 0, 1), Rough())}, (0.0, 0.0, -G))


def by_the_ball_engine(bounces: int) -> Trajectory:
    """It starts on the floor, leaving it."""
    start = BallState([0.0, 0.0, R], [V, 0.0, U], [0.0, -SPIN, 0.0])
    return simulate(SCENE, start, t1=PERIOD / 2 * (bounces + 0.5), max_impacts=bounces + 1)


def by_the_lagrangian(bounces: int, max_impacts: int) -> Trajectory:
    start = ([0.0, 0.0, R, 1.0, 0.0, 0.0, 0.0], [V, 0.0, U, 0.0, -SPIN, 0.0])
    motion = Integrated(rtol=1e-12, atol=1e-12, max_steps=40_000)
    return simulate(thrown_ball(), start, t1=PERIOD / 2 * (bounces + 0.5), motion=motion, max_impacts=max_impacts)


def strayed(trajectory: Trajectory) -> np.ndarray:
    """At each bounce, how far place, velocity and surface velocity before it are from what 5.2.1 says, relative to the
    parabola's length and to the speed."""
    log = trajectory.impacts
    if isinstance(log.before, BallState):
        parts = (log.before.position, log.before.velocity, R * log.before.spin)
    else:
        q, v = log.before
        parts = (q[:, :3], v[:, :3], R * v[:, 3:])
    n = int(trajectory.n_impacts)
    x, v, w = (np.asarray(part)[:n] for part in parts)
    turn = (-1.0) ** np.arange(n)[:, None]  # the first bounce is at the far end
    length = 2 * U * V / G
    places = 0.5 * (1 + turn) * np.array([length, 0, 0]) + np.array([0, 0, R])
    velocities = np.concatenate([turn * V, 0 * turn, 0 * turn - U], axis=1)
    spins = turn * np.array([0, -R * SPIN, 0])
    errors = [(x - places) / length, (v - velocities) / U, (w - spins) / U]
    return np.max(np.abs(np.concatenate(errors, axis=1)), axis=1)


def checks(bounces: int = 1000, fewer: int = 100) -> list[Check]:
    """The engine through `bounces`, the LagrangianSystem through `fewer`."""
    many, few = by_the_ball_engine(bounces), by_the_lagrangian(fewer, fewer + 1)
    n, log = int(many.n_impacts), many.impacts
    both = [np.concatenate([s.velocity, R * s.spin], axis=1)[:n] for s in (log.before, log.after)]
    times = np.abs(np.asarray(log.time)[:n] - PERIOD / 2 * np.arange(1, n + 1)) / PERIOD
    e = [float(energy(SCENE, state)) for state in (many.initial, many.final)]
    return [
        Check("ball engine: bounces missing", bounces - n, 0),
        Check("ball engine: v+ = -v-, omega+ = -omega-", float(np.max(np.abs(both[0] + both[1]))) / U, 1e-12),
        Check(f"ball engine: strayed in {n} bounces", float(np.max(strayed(many))), 1e-9),
        Check("ball engine: times of the bounces, in periods", float(np.max(times)), 1e-9),
        Check("ball engine: energy", abs(e[1] / e[0] - 1), 1e-12),
        Check(f"LagrangianSystem: strayed in {int(few.n_impacts)} bounces", float(np.max(strayed(few))), 1e-9),
        Check("LagrangianSystem: bounces missing", fewer - int(few.n_impacts), 0),
        *residuals(thrown_ball(), by_the_lagrangian(3, fewer + 1)),
    ]


def picture(bounces: int = 1000, fewer: int = 100) -> None:
    many, few = by_the_ball_engine(bounces), by_the_lagrangian(fewer, fewer + 1)
    new, (left, right) = figure(7.2, 3.0, 1, 2, width_ratios=[1, 1.1])
    path = np.asarray(many.at(jnp.linspace(0.0, PERIOD / 2, 60)).position)
    last = np.asarray(many.at(jnp.linspace(PERIOD / 2 * (bounces - 1), PERIOD / 2 * bounces, 12)).position)
    left.axhspan(-0.02, 0.0, color=FAINT, alpha=0.4, lw=0)
    left.plot(path[:, 0], path[:, 2], color=BLUE, lw=1.5, label="first flight")
    left.plot(last[:, 0], last[:, 2], "o", color=VERMILION, ms=4, mfc="white", label=f"flight {bounces}")
    circle = np.linspace(0, 2 * np.pi, 80)
    for x in (path[0, 0], path[-1, 0]):
        left.plot(x + R * np.cos(circle), R + R * np.sin(circle), color=FAINT, lw=0.8)
    left.set(aspect="equal", ylim=(-0.02, 0.28))
    left.set_xlabel("x of the centre (m)", fontsize=9)
    left.set_ylabel("z of the centre (m)", fontsize=9)
    left.legend(fontsize=8, frameon=False, loc="upper center", ncols=2)
    for trajectory, colour, label in ((many, BLUE, "ball engine"), (few, INK, "Lagrangian system, 1e-12")):
        error = np.maximum(strayed(trajectory), 1e-17)
        right.loglog(np.arange(1, error.size + 1), error, color=colour, lw=1.2, label=label)
    right.axhline(1e-9, color=VERMILION, lw=1.0, ls="--", label="bound")
    right.set_ylim(1e-17, 1e-8)
    right.set_xlabel("bounce", fontsize=9)
    right.set_ylabel("strayed (relative)", fontsize=9)
    right.legend(fontsize=8, frameon=False, loc="upper left", bbox_to_anchor=(0.0, 0.9))
    save(new, NAME)


def main() -> int:
    failed = table("The nonholonomic pendulum", checks())
    picture()
    return failed


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    raise SystemExit(main())
