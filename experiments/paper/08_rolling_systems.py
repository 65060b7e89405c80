"""Chaplygin's sleigh, the vertical rolling disk, the knife edge, a ball on a turntable and a ball in a vertical
cylinder: free against their closed forms, against a wall (systems.py says which B), the constraint over 1e5 steps, and
the energy at several step sizes.

Picture: each path, free and against its wall, and the error of the energy against the step."""

import argparse
import pathlib
import sys

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from systems import SystemCase, all_systems

from nonholo_jax import Integrated, LagrangianSystem, simulate

sys.path.append(str(pathlib.Path(__file__).parents[1]))  # for report.py
from report import BLUE, FAINT, GREEN, INK, ORANGE, PURPLE, VERMILION, Check, figure, residuals, save, table

NAME = "rolling_systems"
NAMES = ("sleigh", "disk", "knife", "turntable", "cylinder")
FINE = Integrated(rtol=1e-11, atol=1e-11)
STEPS = 0.2 / 2 ** np.arange(6)  # s


def case_of(name: str) -> SystemCase:
    return next(case for case in all_systems if case.name == name)


def start_of(case: SystemCase) -> tuple:
    return jnp.asarray(case.q), jnp.asarray(case.v)


def in_constant_steps(h, max_steps: int = 4096) -> Integrated:
    return Integrated(stepsize_controller=diffrax.ConstantStepSize(), dt0=h, max_steps=max_steps)


@eqx.filter_jit
def onward(system: LagrangianSystem, state: tuple, t0, t1, h, max_steps: int) -> tuple:
    """The state at t1."""
    return simulate(system, state, t0=t0, t1=t1, motion=in_constant_steps(h, max_steps), max_impacts=0).final


@eqx.filter_jit
def violation(system: LagrangianSystem, t, q, v):
    """|A v - b| relative to the terms that it is the sum of."""
    a, b = system.constraint_at(q, t, v.shape[0])
    return jnp.max(jnp.abs(a @ v - b)) / jnp.max(jnp.abs(a) @ jnp.abs(v))


def largest_violation(case: SystemCase, steps: int, h: float = 2e-3, stops: int = 20) -> float:
    """Over so many steps of size h; looked at `stops` times."""
    system = case.build().without_contacts()
    span = h * steps / stops
    state, t, size, seen = start_of(case), jnp.zeros(()), jnp.asarray(h), []
    for _ in range(stops):
        state, t = onward(system, state, t, t + span, size, max(steps, 4096)), t + span
        seen.append(float(violation(system, t, *state)))
    return max(seen)


def conserved(case: SystemCase, system: LagrangianSystem, state: tuple):
    """The energy; on the turntable, which does work, the speed of the centre."""
    if case.name == "turntable":
        return jnp.sqrt(jnp.sum(state[1][:2] ** 2))
    return system.energy(*state)


def energy_errors(case: SystemCase, steps=STEPS, max_steps: int = 4096) -> np.ndarray:
    """Relative, at t = 3.2 s, for each step size: constant steps of Tsit5, whose order is 5."""
    system, start = case.build().without_contacts(), start_of(case)
    begin, end = jnp.zeros(()), jnp.asarray(3.2)
    size = eqx.filter_jit(lambda state: conserved(case, system, state))
    zero = float(size(start))
    ends = np.array([size(onward(system, start, begin, end, jnp.asarray(h), max_steps)) for h in steps])
    return np.abs(ends / zero - 1 if zero else ends)


def order(errors: np.ndarray, steps=STEPS) -> float:
    """The slope of the error over the step, where it is above rounding; NaN if it never is."""
    clear = errors > 1e-12
    if clear.sum() < 3:
        return float("nan")
    return float(np.polyfit(np.log(steps[clear]), np.log(errors[clear]), 1)[0])


def of(name: str, steps: int, step_sizes=STEPS) -> list[Check]:
    case = case_of(name)
    free, (q, v) = case.build().without_contacts(), start_of(case)
    end = simulate(free, (q, v), t1=case.t1, motion=FINE).final
    want = case.exact(case.t1, np.asarray(q), np.asarray(v))
    rows = [Check(f"{name}: free, closed form at {case.t1} s", float(np.max(np.abs(case.observe(*end) - want))), 1e-9)]
    system = case.build(0.8)
    trajectory = simulate(system, (q, v), t1=case.t1, motion=FINE, max_impacts=3)
    n = int(trajectory.n_impacts)
    rows.append(Check(f"{name}: impacts on its wall", n, 0, above=True))
    rows += [check._replace(what=f"{name}: {check.what}") for check in residuals(system, trajectory)]
    kept = float(violation(system, trajectory.t1, *trajectory.final))
    rows.append(Check(f"{name}: |A v - b| after {n} impacts", kept, 1e-10))
    rows.append(Check(f"{name}: |A v - b| over {steps:.0e} steps", largest_violation(case, steps), 1e-10))
    errors = energy_errors(case, step_sizes, max(steps, 4096))
    what = "speed of the centre" if name == "turntable" else "energy"
    slope = order(errors, step_sizes)
    if np.isnan(slope):
        rows.append(Check(f"{name}: {what} at every step size", float(errors.max()), 1e-12))
    else:
        rows.append(Check(f"{name}: {what}, order in the step", slope, 4.8, above=True))
        rows.append(Check(f"{name}: {what} at h = {step_sizes[-1]:g} s", float(errors[-1]), 1e-8))
    return rows


def checks(names=NAMES, steps: int = 100_000, step_sizes=STEPS) -> list[Check]:
    return [row for name in names for row in of(name, steps, step_sizes)]


TITLES = {
    "sleigh": "Chaplygin's sleigh", "disk": "vertical disk", "knife": "knife edge on an incline",
    "turntable": "ball on a turntable", "cylinder": "ball in a vertical cylinder",
}  # fmt: skip
WALLS = {"sleigh": ("v", 0.1), "disk": ("v", 0.3), "knife": ("v", 0.1), "turntable": ("v", 0.4), "cylinder": ("h", -1)}


def draw_paths(ax, name: str) -> None:
    case = case_of(name)
    times = jnp.linspace(0.0, case.t1, 300)
    for system, colour, label in ((case.build().without_contacts(), FAINT, "free"), (case.build(0.8), BLUE, "wall")):
        trajectory = simulate(system, start_of(case), t1=case.t1, motion=FINE, max_impacts=3)
        stop = times[times <= trajectory.t1]
        path = np.asarray(trajectory.at(stop)[0])
        ax.plot(path[:, 0], path[:, 1], color=colour, lw=1.4, ls="-" if label == "wall" else "--", label=label)
        if label == "wall":
            n = int(trajectory.n_impacts)
            hits = np.asarray(trajectory.impacts.before[0])[:n]
            ax.plot(hits[:, 0], hits[:, 1], "o", color=VERMILION, ms=3.5)
    kind, place = WALLS[name]
    (ax.axvline if kind == "v" else ax.axhline)(place, color=INK, lw=1.2)
    ax.plot(*case.q[:2], "s", color=INK, ms=3)
    ax.set_title(TITLES[name], fontsize=9)
    ax.set_xlabel("angle (rad)" if name == "cylinder" else "x (m)", fontsize=8)
    ax.set_ylabel("z (m)" if name == "cylinder" else "y (m)", fontsize=8)


def picture() -> None:
    new, axes = figure(8.0, 4.8, 2, 3)
    for ax, name in zip(axes.flat, NAMES, strict=False):
        draw_paths(ax, name)
    axes[0, 0].legend(fontsize=8, frameon=False)
    last = axes[1, 2]
    for name, colour in zip(NAMES, (BLUE, PURPLE, VERMILION, ORANGE, GREEN), strict=True):
        errors = np.maximum(energy_errors(case_of(name)), 1e-17)
        last.loglog(STEPS, errors, "o-", ms=3, lw=1.0, color=colour, label=name)
    last.loglog(STEPS[:4], 1e-2 * STEPS[:4] ** 5, color=INK, lw=0.8, ls=":", label="order 5")
    last.set_xlabel("step (s)", fontsize=8)
    last.set_ylabel("relative error of the energy\n(turntable: of the speed)", fontsize=8)
    last.legend(fontsize=6.5, frameon=False)
    save(new, NAME)


def main() -> int:
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("--steps", type=int, default=100_000)
    failed = table("Rolling systems", checks(steps=parser.parse_args().steps))
    picture()
    return failed


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    raise SystemExit(main())
