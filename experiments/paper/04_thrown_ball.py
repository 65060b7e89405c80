"""A rough ball thrown to the floor as a LagrangianSystem with a quaternion frame, against the ball engine; and what the
weak form and the law see of planted errors.

Picture: both paths, and how far apart they are."""

import pathlib
import sys

import equinox as eqx
import jax
import numpy as np
from systems import ALPHA, G, J, M, R, diagonal, floor_of_normals, thrown_ball

from nonholo_jax import (
    Ball,
    BallState,
    Integrated,
    LagrangianSystem,
    Plane,
    Rough,
    Scene,
    Trajectory,
    law_residual,
    simulate,
    weak_residual,
)

sys.path.append(str(pathlib.Path(__file__).parents[1]))  # for report.py
from report import BLUE, FAINT, INK, VERMILION, Check, figure, residuals, save, table

NAME = "thrown_ball"
MU = 0.9
POSITION, TURN, VELOCITY, SPIN = [0.0, 0.0, 0.6], [0.5, 0.5, -0.5, 0.5], [1.0, -0.5, 0.3], [3.0, 12.0, -5.0]
FINE = Integrated(rtol=1e-11, atol=1e-11)


def by_the_ball_engine(t1: float) -> Trajectory:
    scene = Scene(Ball(R, M, ALPHA), {"floor": Plane((0, 0, 0), (0, 0, 1), Rough(MU))}, (0.0, 0.0, -G))
    return simulate(scene, BallState(POSITION, VELOCITY, SPIN, TURN), t1=t1, max_impacts=8)


def by_the_lagrangian(t1: float, system: LagrangianSystem, max_impacts: int = 8) -> Trajectory:
    start = (POSITION + TURN, VELOCITY + SPIN)
    return simulate(system, start, t1=t1, motion=FINE, max_impacts=max_impacts)


def apart(one: BallState, other: tuple) -> np.ndarray:
    """The largest difference in position, orientation, velocity or surface velocity; leading axes stay."""
    (q, v), parts = other, []
    for a, b in ((one.position, q[..., :3]), (one.orientation, q[..., 3:]), (one.velocity, v[..., :3]),
                 (R * one.spin, R * v[..., 3:])):  # fmt: skip
        parts.append(np.max(np.abs(np.asarray(a) - np.asarray(b)), axis=-1))
    return np.max(np.stack(parts), axis=0)


def planted(trajectory: Trajectory, t1: float) -> list[Check]:
    """Each error in the question must show in the residual that is meant to see it; a wrong mu, and specular
    reflection, satisfy (2.4) too, and show in the law."""
    right = thrown_ball(MU)
    heavy = diagonal(M, M, M, 1.3 * J, J, J)
    metric = eqx.tree_at(lambda system: system.metric, right, type(right.metric)(heavy))
    specular = by_the_lagrangian(t1, floor_of_normals(MU), 3)
    weaker = by_the_lagrangian(t1, thrown_ball(0.6 * MU), 3)
    seen = lambda system, motion: float(weak_residual(system, motion))  # noqa: E731
    return [
        Check("planted, wrong inertia: weak_residual", seen(metric, trajectory), 1e-3, above=True),
        Check("planted, wrong sign of the spin: weak_residual", seen(thrown_ball(MU, -1.0), trajectory), 1e-3, True),
        Check("planted, psi not in ker B: weak_residual", seen(floor_of_normals(MU), trajectory), 1e-3, True),
        Check("specular reflection: weak_residual cannot see it", seen(right, specular), 1e-9),
        Check("specular reflection: law_residual", float(law_residual(right, specular)), 1e-3, above=True),
        Check("wrong mu: weak_residual cannot see it", seen(right, weaker), 1e-9),
        Check("wrong mu: law_residual", float(law_residual(right, weaker)), 1e-3, above=True),
    ]


def checks(t1: float = 2.6, with_errors: bool = True) -> list[Check]:
    want, got = by_the_ball_engine(t1), by_the_lagrangian(t1, thrown_ball(MU))
    n = int(want.n_impacts)
    each = [jax.tree.map(lambda x: x[:n], log.after) for log in (want.impacts, got.impacts)]
    times = np.abs(want.impacts.time - got.impacts.time)[:n]
    rows = [
        Check("number of bounces, difference", abs(n - int(got.n_impacts)), 0),
        Check(f"times of {n} bounces", float(np.max(times)), 1e-9, unit="s"),
        Check("states after each bounce", float(np.max(apart(*each))), 1e-9, unit="m, m/s"),
        Check(f"state at t = {t1} s", float(apart(want.final, got.final)), 1e-9, unit="m, m/s"),
        *residuals(thrown_ball(MU), got),
    ]
    if not with_errors:
        return rows
    short = by_the_lagrangian(1.2, thrown_ball(MU), 3)
    return rows + planted(short, 1.2)


def picture(t1: float = 2.6) -> None:
    one, other = by_the_ball_engine(t1), by_the_lagrangian(t1, thrown_ball(MU))
    times = np.linspace(0.0, t1, 400)
    exact, q = one.at(times), other.at(times)
    new, (top, below) = figure(6.0, 4.2, 2, 1, height_ratios=[1.4, 1])
    top.axhspan(-0.06, 0.0, color=FAINT, alpha=0.4, lw=0)
    top.axhline(R, color=FAINT, lw=0.8, ls=":")
    top.plot(exact.position[:, 0], exact.position[:, 2], color=BLUE, lw=1.4, label="ball engine, closed form")
    top.plot(q[0][::8, 0], q[0][::8, 2], "o", ms=3.5, mfc="white", color=VERMILION,
             label="Lagrangian system, Tsit5 at 1e-11")  # fmt: skip
    top.set_ylim(-0.06, 0.78)
    top.set_xlabel("x of the centre (m)", fontsize=9)
    top.set_ylabel("z of the centre (m)", fontsize=9)
    top.legend(fontsize=8, frameon=False, ncols=2, loc="upper right")
    gap = np.maximum(apart(exact, q), 1e-17)
    below.semilogy(times, gap, color=INK, lw=1.2)
    for k, t in enumerate(np.asarray(one.impacts.time)[: int(one.n_impacts)]):
        below.axvline(t, color=FAINT, lw=0.8, ls=":", label=None if k else "bounces")
    below.axhline(1e-9, color=VERMILION, lw=1.0, ls="--", label="bound")
    below.set_ylim(1e-17, 1e-8)
    below.set_xlabel("time (s)", fontsize=9)
    below.set_ylabel("difference (m, m/s, 1)", fontsize=9)
    below.legend(fontsize=8, frameon=False, ncols=2, loc="lower right")
    save(new, NAME)


def main() -> int:
    failed = table("A thrown ball, twice", checks())
    picture()
    return failed


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    raise SystemExit(main())
