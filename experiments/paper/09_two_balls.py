"""Two rough balls collide: B is the relative velocity of the points that touch. Momentum, angular momentum and energy;
equal balls head-on without spin exchange their velocities.

Picture: the paths of the two and of their centre of mass, and what passes from one to the other."""

import pathlib
import sys

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from systems import J, M, R, two_balls

from nonholo_jax import Integrated, LagrangianSystem, Trajectory, simulate

sys.path.append(str(pathlib.Path(__file__).parents[1]))  # for report.py
from report import BLUE, FAINT, INK, VERMILION, Check, figure, residuals, save, table

NAME = "two_balls"
FINE = Integrated(rtol=1e-11, atol=1e-11)
TURN = [1.0, 0.0, 0.0, 0.0]
ROUGH = ([0.0, 0.0, 0.0, *TURN, 1.0, 0.08, 0.0, *TURN],
         [1.0, 0.2, 0.0, 0.0, 0.0, 12.0, -0.6, 0.1, 0.0, 0.0, 0.0, -7.0])  # fmt: skip
HEAD_ON = ([0.0, 0.0, 0.0, *TURN, 1.0, 0.0, 0.0, *TURN], [0.9, 0, 0, 0, 0, 0, -0.2, 0, 0, 0, 0, 0])
OUT_OF_PLANE = ([0.0, 0.0, 0.0, *TURN, 1.0, 0.05, 0.03, *TURN],
                [1.0, 0.2, 0.0, 3.0, -5.0, 2.0, -0.6, 0.1, 0.05, 1.0, 4.0, -7.0])  # fmt: skip


def collide_them(system: LagrangianSystem, start: tuple) -> Trajectory:
    return simulate(system, start, t1=1.2, motion=FINE, max_impacts=2)


@eqx.filter_jit
def energy(system: LagrangianSystem, q, v):
    return system.energy(q, v)


def momenta(state: tuple, other: float) -> tuple[np.ndarray, np.ndarray]:
    """Momentum, and angular momentum about the origin, the second ball `other` times as heavy."""
    q, v = (np.asarray(x) for x in state)
    momentum = M * (v[:3] + other * v[6:9])
    turning = M * (np.cross(q[:3], v[:3]) + other * np.cross(q[7:10], v[6:9])) + J * (v[3:6] + other * v[9:12])
    return momentum, turning


def relative(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.max(np.abs(a - b)) / np.max(np.abs(b)))


def checks(ratios=(1.0, 2.5, 100.0), restitutions=(1.0, 0.6)) -> list[Check]:
    rows = []
    start, head_on = (tuple(jnp.asarray(x, dtype=float) for x in state) for state in (OUT_OF_PLANE, HEAD_ON))
    for other in ratios:
        for mu in restitutions:
            system = two_balls(jnp.asarray(mu), other)  # an array: one program for all restitutions
            trajectory = collide_them(system, start)
            final, n = trajectory.final, trajectory.n_impacts
            pairs = zip(momenta(final, other), momenta(OUT_OF_PLANE, other), strict=True)
            changes = [relative(a, b) for a, b in pairs]
            gain = float(energy(system, *final) / energy(system, *start)) - 1
            name = f"masses 1 : {other:g}, mu = {mu:g}"
            rows += [
                Check(f"{name}: impacts", int(n), 0, above=True),
                Check(f"{name}: momentum", changes[0], 1e-12),
                Check(f"{name}: angular momentum", changes[1], 1e-12),
            ]
            if mu == 1:
                rows.append(Check(f"{name}: energy, change", abs(gain), 1e-12))
            else:
                rows.append(Check(f"{name}: energy, gain", gain, -1e-3))
    system = two_balls(jnp.asarray(restitutions[-1]), ratios[-1])
    rows += [row._replace(what=f"{name}: {row.what}") for row in residuals(system, collide_them(system, start))]
    after = np.asarray(collide_them(two_balls(jnp.asarray(1.0)), head_on).final[1])
    return [*rows, Check("equal, head-on, no spin: exchange", relative(after, np.roll(HEAD_ON[1], 6)), 1e-13)]


def picture() -> None:
    system = two_balls()
    trajectory = collide_them(system, ROUGH)
    hit = float(trajectory.impacts.time[0])
    times = np.sort([*np.linspace(0.0, 1.2, 121), hit - 1e-9])
    q, v = (np.asarray(x) for x in trajectory.at(times))
    new, (left, right) = figure(7.2, 2.7, 1, 2, width_ratios=[1.5, 1])
    circle = np.linspace(0, 2 * np.pi, 80)
    for k, colour in ((0, BLUE), (7, VERMILION)):
        left.plot(q[:, k], q[:, k + 1], color=colour, lw=1.4)
        for t, style in ((0.0, ":"), (hit, "-"), (1.2, "--")):
            x = np.asarray(trajectory.at(t)[0])[k : k + 2]
            left.plot(x[0] + R * np.cos(circle), x[1] + R * np.sin(circle), color=colour, lw=0.9, ls=style)
    middle = 0.5 * (q[:, :2] + q[:, 7:9])
    left.plot(middle[:, 0], middle[:, 1], color=FAINT, lw=1.0, ls="-.", label="centre of mass")
    left.plot([], [], color=INK, ls=":", lw=0.9, label="t = 0")
    left.plot([], [], color=INK, ls="-", lw=0.9, label="impact")
    left.plot([], [], color=INK, ls="--", lw=0.9, label="t = 1.2 s")
    left.set(aspect="equal")
    left.set_xlabel("x (m)", fontsize=9)
    left.set_ylabel("y (m)", fontsize=9)
    left.legend(fontsize=7.5, frameon=False, ncols=4, loc="lower left", bbox_to_anchor=(-0.1, 1.0), columnspacing=1.0)
    shares = {
        "total": (np.asarray(jax.vmap(system.energy)(jnp.asarray(q), jnp.asarray(v))), INK),
        "first ball": (0.5 * M * np.sum(v[:, :3] ** 2, 1) + 0.5 * J * np.sum(v[:, 3:6] ** 2, 1), BLUE),
        "second ball": (0.5 * M * np.sum(v[:, 6:9] ** 2, 1) + 0.5 * J * np.sum(v[:, 9:] ** 2, 1), VERMILION),
        "rotation of both": (0.5 * J * (np.sum(v[:, 3:6] ** 2, 1) + np.sum(v[:, 9:] ** 2, 1)), FAINT),
    }  # fmt: skip
    for name, (energy, colour) in shares.items():
        right.plot(times, energy, color=colour, lw=1.4, label=name, ls="--" if colour == FAINT else "-")
    right.set(ylim=(0, 1.35 * shares["total"][0].max()))
    right.set_xlabel("time (s)", fontsize=9)
    right.set_ylabel("kinetic energy (J)", fontsize=9)
    right.legend(fontsize=7.5, frameon=False, ncols=2)
    save(new, NAME)


def main() -> int:
    failed = table("Two rough balls", checks())
    picture()
    return failed


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    raise SystemExit(main())
