"""Inelastic impacts, section 6: the same throw with mu from 0 (plastic) to 1 (energy conserved), by the formulas of the
paper, by B, and by the ball engine, one batch over scenes.

Picture: the paths, and what each component of the velocity does."""

import pathlib
import sys
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from systems import ALPHA, G, J, M, R, thrown_ball

from nonholo_jax import Ball, BallState, Integrated, Plane, Rough, Scene, collide, projector, simulate, simulate_batch

sys.path.append(str(pathlib.Path(__file__).parents[1]))  # for report.py
from report import BLUE, FAINT, GREEN, INK, ORANGE, PURPLE, VERMILION, Check, figure, residuals, save, table

NAME = "inelastic"
VELOCITY, SPIN = np.array([1.0, -0.5, -2.0]), np.array([3.0, -20.0, 5.0])
METRIC = np.diag([M, M, M, J, J, J])
COLOURS = (VERMILION, ORANGE, GREEN, PURPLE, BLUE)


def section_6(mu: Any) -> np.ndarray:
    """As it is printed: (v+, omega+)."""
    (v1, v2, v3), (w1, w2, w3), whole = VELOCITY, SPIN, J + M * R**2
    return np.stack([
        (M * R**2 - mu * J) / whole * v1 + J * R * (1 + mu) / whole * w2,
        (M * R**2 - mu * J) / whole * v2 - J * R * (1 + mu) / whole * w1,
        -mu * v3,
        -R * M * (1 + mu) / whole * v2 + (J - mu * M * R**2) / whole * w1,
        R * M * (1 + mu) / whole * v1 + (J - mu * M * R**2) / whole * w2,
        w3 + 0 * mu,
    ], axis=-1)  # fmt: skip


def scene(mu: Any) -> Scene:
    return Scene(Ball(R, M, ALPHA), {"floor": Plane((0, 0, 0), (0, 0, 1), Rough(mu))}, (0.0, 0.0, -G))


def throw(n: int) -> BallState:
    """n times the same: it touches the floor and approaches."""
    same = lambda x: jnp.broadcast_to(jnp.asarray(x), (n, 3))  # noqa: E731
    return BallState(same(np.array([0.0, 0.0, R])), same(VELOCITY), same(SPIN))


def size(v: np.ndarray) -> np.ndarray:
    """sqrt(2 T)"""
    return np.sqrt(np.einsum("...i,ij,...j->...", v, METRIC, v))


def checks(n: int = 101) -> list[Check]:
    mu, before = np.linspace(0.0, 1.0, n), np.concatenate([VELOCITY, SPIN])
    rows = np.asarray(thrown_ball().barriers[0].constraint(jnp.zeros(7)))
    want = section_6(mu)
    hit = lambda mu: collide(jnp.asarray(before), jnp.asarray(METRIC), jnp.asarray(rows), mu)  # noqa: E731
    by_b = jax.jit(jax.vmap(hit))(mu)
    log = simulate_batch(
        jax.vmap(scene)(jnp.asarray(mu)), throw(n), t1=1.0, scene_axes=0, max_impacts=1, sum_trains=False
    ).impacts
    engine = np.concatenate([log.after.velocity[:, 0], log.after.spin[:, 0]], axis=-1)
    across = np.asarray(jax.jit(projector)(jnp.asarray(METRIC), jnp.asarray(rows))) @ before
    lost = 0.5 * (size(before) ** 2 - size(engine) ** 2)
    theory = 0.5 * (1 - mu**2) * size(across) ** 2  # from (6.1): only v_perp shrinks
    momentum = lambda v: R * M * np.stack([-v[..., 1], v[..., 0]], -1) + J * v[..., 3:5]  # noqa: E731
    about_c = np.max(np.abs(momentum(engine) - momentum(before))) / np.max(np.abs(momentum(before)))
    relative = lambda x: float(np.max(size(np.asarray(x) - want)) / size(before))  # noqa: E731
    bounces = simulate(thrown_ball(0.5), ([0, 0, R + 0.3, 1, 0, 0, 0], [*VELOCITY, *SPIN]), t1=0.5, max_impacts=2,
                       motion=Integrated(rtol=1e-11, atol=1e-11))  # fmt: skip
    return [
        Check(f"formulas of section 6 against B, {n} values of mu", relative(by_b), 1e-14),
        Check("formulas of section 6 against the ball engine", relative(engine), 1e-14),
        Check("mu = 1: energy is conserved", float(abs(lost[-1]) / size(before) ** 2), 1e-14),
        Check("energy lost is (1 - mu^2) T(v_perp), relative", float(np.max(np.abs(lost - theory)) / theory[0]), 1e-13),
        Check("mu = 0: the contact point is at rest, |B v+|", float(np.max(np.abs(rows @ engine[0]))), 1e-14),
        Check("(4.1): momentum about C, for every mu", float(about_c), 1e-13),
        *[row._replace(what=f"mu = 0.5: {row.what}") for row in residuals(thrown_ball(0.5), bounces)],
    ]


def picture() -> None:
    new, (left, right) = figure(7.2, 3.1, 1, 2, width_ratios=[1.25, 1])
    times = jnp.linspace(0.0, 0.9, 400)
    for mu, colour in zip((0.0, 0.25, 0.5, 0.75, 1.0), COLOURS, strict=True):
        start = BallState([-0.5, 0.25, R + 0.3], VELOCITY, [3.0, 10.0, 5.0])
        path = np.asarray(simulate(scene(mu), start, t1=0.9, max_impacts=64).at(times).position)
        left.plot(path[:, 0], path[:, 2], color=colour, lw=1.3, label=rf"$\mu$ = {mu:g}")
    left.axhspan(-0.03, 0.0, color=FAINT, alpha=0.4, lw=0)
    left.axhline(R, color=FAINT, lw=0.8, ls=":")
    left.set_xlabel("x of the centre (m)", fontsize=9)
    left.set_ylabel("z of the centre (m)", fontsize=9)
    left.legend(fontsize=8, frameon=False, loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=5, columnspacing=1.0)
    mu = np.linspace(0.0, 1.0, 11)
    log = simulate_batch(
        jax.vmap(scene)(jnp.asarray(mu)), throw(11), t1=1.0, scene_axes=0, max_impacts=1, sum_trains=False
    ).impacts
    want, v, w = section_6(mu), log.after.velocity[:, 0], R * log.after.spin[:, 0]
    for line, dots, colour, label in (
        (want[:, 0], v[:, 0], BLUE, "$v_1^+$"), (want[:, 2], v[:, 2], INK, "$v_3^+$"),
        (R * want[:, 4], w[:, 1], VERMILION, r"$r\,\omega_2^+$"),
    ):  # fmt: skip
        right.plot(mu, line, color=colour, lw=1.2, label=label)
        right.plot(mu, dots, "o", color=colour, ms=3.5, mfc="white")
    right.set_xlabel(r"restitution $\mu$", fontsize=9)
    right.set_ylabel("after the impact (m/s)", fontsize=9)
    right.legend(fontsize=8, frameon=False, title="lines: section 6; dots: ball engine", title_fontsize=7)
    save(new, NAME)


def main() -> int:
    failed = table("Inelastic impacts, mu from 0 to 1", checks())
    picture()
    return failed


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    raise SystemExit(main())
