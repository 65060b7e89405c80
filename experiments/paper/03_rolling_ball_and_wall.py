"""A ball that rolls on a rough floor meets a rough wall: Theorem 5.1, from A and B of the paper and by the ball engine.

Picture: seen from above, the pivot spin omega_3 that the ball comes with decides where it goes."""

import pathlib
import sys
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from systems import ALPHA, J, M, R, rolling_ball

from nonholo_jax import Ball, BallState, Integrated, Plane, Rough, Scene, simulate, simulate_batch

sys.path.append(str(pathlib.Path(__file__).parents[1]))  # for report.py
from report import BLUE, FAINT, GREEN, INK, ORANGE, PURPLE, VERMILION, Check, figure, residuals, save, table

NAME = "rolling_ball_and_wall"
V1, V2, START = -1.5, 0.7, 1.0


def theorem_5_1(v1: Any, v2: Any, w3: Any) -> tuple:
    """As it is printed: (v1+, v2+, omega_3+)."""
    whole, half = J + R**2 * M, J + R**2 * M / 2
    return (
        -v1,
        R**2 * M / (2 * half) * v2 + R * J / half * w3,
        whole / (R * half) * v2 - R**2 * M / (2 * half) * w3,
    )


def room(mu: Any = 1.0) -> Scene:
    """The floor does not bounce, so that a ball that touches it rolls at once."""
    floor, wall = Plane((0, 0, 0), (0, 0, 1), Rough(0.0)), Plane((0, 0, 0), (1, 0, 0), Rough(mu))
    return Scene(Ball(R, M, ALPHA), {"floor": floor, "wall": wall})


def rolling(v1: Any, v2: Any, w3: Any) -> BallState:
    """(5.1), a distance START from the wall; for numbers or arrays of them."""
    v1, v2, w3 = jnp.broadcast_arrays(*(jnp.asarray(x, dtype=float) for x in (v1, v2, w3)))
    zero = jnp.zeros_like(v1)
    position = jnp.stack([zero + START, zero, zero + R], -1)
    return BallState(position, jnp.stack([v1, v2, zero], -1), jnp.stack([-v2 / R, v1 / R, w3], -1))


def observed(state: BallState) -> np.ndarray:
    return np.stack([state.velocity[..., 0], state.velocity[..., 1], state.spin[..., 2]])


def checks(n: int = 1000) -> list[Check]:
    rng = np.random.default_rng(0)
    v1, v2, w3 = -rng.uniform(0.5, 3.0, n), rng.normal(size=n), 10 * rng.normal(size=n)
    size = np.abs(v1) + np.abs(v2) + R * np.abs(w3)
    units = np.array([1.0, 1.0, R])[:, None]
    worst = lambda got, want: float(np.max(np.abs(units * (got - np.stack(want))) / size))  # noqa: E731
    # The restitution is an array: one program for all of them.
    batch = lambda mu, state, t1: simulate_batch(room(jnp.asarray(mu)), state, t1=t1, log_size=0, throw=True).final  # noqa: E731
    ends = batch(1.0, rolling(v1, v2, w3), 4.0)
    level = np.max(np.abs(ends.position[:, 2] - R)) / R
    rows = [
        Check(f"ball engine: Theorem 5.1, {n} balls, relative", worst(observed(ends), theorem_5_1(v1, v2, w3)), 1e-14),
        Check("ball engine: it still rolls on the floor, height", float(level), 1e-14),
    ]
    mu = 0.6  # section 6: of the change 2 P v only (1 + mu) P v happens
    share = lambda before, after: 0.5 * (1 - mu) * before + 0.5 * (1 + mu) * after  # noqa: E731
    lossy = [share(before, after) for before, after in zip((v1, v2, w3), theorem_5_1(v1, v2, w3), strict=True)]
    ends = batch(mu, rolling(v1, v2, w3), 4.0)
    rows.append(Check(f"ball engine: section 6 with mu = {mu}, relative", worst(observed(ends), lossy), 1e-14))
    system = rolling_ball()
    start = ([START, 0.0, 1.0, 0.0, 0.0, 0.0], [V1, V2, -V2 / R, V1 / R, 9.0])
    trajectory = simulate(system, start, t1=1.5, motion=Integrated(rtol=1e-11, atol=1e-11), max_impacts=2)
    q, v = trajectory.final
    one = jax.tree.map(lambda x: x[0], batch(1.0, rolling(V1 + 0 * v1, V2, 9.0), 1.5))
    want = np.array(theorem_5_1(V1, V2, 9.0))
    miss = np.abs(units[:, 0] * (np.asarray(v)[jnp.array([0, 1, 4])] - want)).max() / abs(V1)
    apart = max(float(jnp.max(jnp.abs(x - y))) for x, y in (
        (q[:2], one.position[:2]), (v[:2], one.velocity[:2]), (R * v[2:], R * one.spin)))  # fmt: skip
    return [
        *rows,
        Check("A and B of section 5.1: Theorem 5.1, relative", float(miss), 1e-13),
        Check("A and B against the ball engine at t = 1.5 s", apart, 1e-9, unit="m, m/s"),
        *residuals(system, trajectory),
    ]


def picture() -> None:
    new, (left, right) = figure(7.2, 3.1, 1, 2, width_ratios=[1, 1.15])
    times = jnp.linspace(0.0, 1.35, 200)
    for spin, colour in zip((-30.0, -15.0, 0.0, 15.0, 30.0), (VERMILION, ORANGE, INK, GREEN, BLUE), strict=True):
        path = np.asarray(simulate(room(), rolling(V1, V2, spin), t1=1.4).at(times).position)
        out = path[np.argmin(path[:, 0]) :]
        left.plot(out[:, 0], out[:, 1], color=colour, lw=1.4)
        label = f"{spin:+.0f}".replace("-", "\N{MINUS SIGN}").replace("+0", "0")
        left.annotate(label, path[-1, :2], xytext=(4, 0), textcoords="offset points", color=colour, fontsize=8,
                      va="center")  # fmt: skip
    left.annotate(
        "", (0.11, V2 * (START - R) / -V1), (1.0, 0.0), arrowprops={"arrowstyle": "-|>", "color": PURPLE, "lw": 1.8}
    )
    left.axvspan(-0.12, 0.0, color=FAINT, alpha=0.4, lw=0)
    left.axvline(R, color=FAINT, lw=0.8, ls=":")
    left.text(-0.06, 1.2, "wall", rotation=90, ha="center", va="center", fontsize=8)
    left.text(1.02, 0.0, "in", fontsize=8, color=PURPLE, va="center")
    left.set(xlim=(-0.12, 1.25), aspect="equal")
    left.set_xlabel("x of the centre (m)", fontsize=9)
    left.set_ylabel("y of the centre (m)", fontsize=9)
    left.set_title(r"from above; $\omega_3^-$ in rad/s", fontsize=9)
    spins = np.linspace(-40.0, 40.0, 17)
    ends = simulate_batch(room(), rolling(V1, V2, spins), t1=1.2, log_size=0, throw=True).final
    fine = np.linspace(-40.0, 40.0, 3)
    _, v2, w3 = theorem_5_1(V1 + 0 * fine, V2, fine)
    right.plot(fine, v2, color=BLUE, lw=1.2, label=r"$v_2^+$, Theorem 5.1")
    right.plot(fine, R * w3, color=VERMILION, lw=1.2, label=r"$r\,\omega_3^+$, Theorem 5.1")
    right.plot(spins, ends.velocity[:, 1], "o", color=BLUE, ms=3.5, mfc="white", label="ball engine")
    right.plot(spins, R * ends.spin[:, 2], "o", color=VERMILION, ms=3.5, mfc="white")
    right.axhline(V2, color=PURPLE, lw=0.8, ls="--", label=r"$v_2^-$")
    right.set_xlabel(r"pivot spin before the wall $\omega_3^-$ (rad/s)", fontsize=9)
    right.set_ylabel("after the wall (m/s)", fontsize=9)
    right.legend(fontsize=7.5, frameon=False)
    save(new, NAME)


def main() -> int:
    failed = table("A rolling ball meets a wall", checks())
    picture()
    return failed


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    raise SystemExit(main())
