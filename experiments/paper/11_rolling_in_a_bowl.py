"""A rough ball rolls in a bowl that is no surface of revolution: the ball engine on an `Implicit` surface against the
Lagrangian system of the paper, whose A says that the contact point does not move.

Picture: the way from above with a spin about the normal and without, and how far the two computations are apart."""

import functools
import pathlib
import sys
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from systems import ball_frame, diagonal, unit_after

from nonholo_jax import Ball, BallState, Exact, Implicit, Integrated, LagrangianSystem, Rough, Scene, energy, simulate

sys.path.append(str(pathlib.Path(__file__).parents[1]))  # for report.py
from report import BLUE, FAINT, INK, VERMILION, Check, figure, save, table

NAME = "rolling_in_a_bowl"
R, ALPHA, G = 0.1, 0.4, 9.81
BENDS = (1.0, 2.2)  # of the surface that the centre is on, in 1/m, along x and y
FINE = Integrated(rtol=1e-11, atol=1e-11)


def height(x: Any, y: Any) -> Any:
    """Of the centre; not quite a paraboloid, and not symmetric."""
    return 0.5 * (BENDS[0] * x * x + BENDS[1] * y * y) + 0.15 * x * x * y


def gap(x: Any, t: Any) -> Any:
    return x[2] - height(x[0], x[1])


def normal(x: Any) -> Any:
    slope = jax.grad(lambda x: gap(x, 0.0))(x)
    return slope / jnp.linalg.norm(slope)


@functools.cache  # one scene and one system, so that each is compiled once
def bowl() -> Scene:
    return Scene(Ball(R, 1.0, ALPHA), {"bowl": Implicit(gap, Rough(0.0))}, gravity=(0.0, 0.0, -G))


@functools.cache
def lagrangian() -> LagrangianSystem:
    """q: place of the centre and a quaternion; v: its velocity and the spin. A v = v - r omega x n = 0, three rows."""

    def constraint(q: Any) -> Any:
        a, b, c = normal(q[:3])
        turned = R * jnp.array([[0.0, -c, b], [c, 0.0, -a], [-b, a, 0.0]])  # r n x
        return jnp.concatenate([jnp.eye(3), turned], axis=1)

    inertia = ALPHA * R * R
    return LagrangianSystem(
        metric=diagonal(1.0, 1.0, 1.0, inertia, inertia, inertia),
        potential=lambda q: G * q[2],
        constraint=constraint,
        frame=ball_frame(3),
        retraction=unit_after(3),
    )


def start(pivot: float, x: float = 0.5, y: float = 0.1, vx: float = 0.0, vy: float = 0.4) -> tuple:
    """Position, velocity and spin of a ball that rolls, with a spin about the normal."""
    place = jnp.array([x, y, height(x, y)])
    slope = jax.grad(lambda p: height(p[0], p[1]))(place[:2])
    velocity = jnp.array([vx, vy, vx * slope[0] + vy * slope[1]])
    n = normal(place)
    return place, velocity, jnp.cross(n, velocity) / R + pivot * n


def apart(pivot: float, times: Any) -> tuple[np.ndarray, np.ndarray]:
    """Places by the ball engine at some times, and how far it is from the Lagrangian system, in place, velocity and
    r times spin."""
    place, velocity, spin = start(pivot)
    begin = jnp.concatenate([place, jnp.array([1.0, 0.0, 0.0, 0.0])]), jnp.concatenate([velocity, spin])
    places, far = [], []
    for t in times:
        one = simulate(bowl(), BallState(place, velocity, spin), t1=t, motion=Exact(contact=FINE), max_impacts=4).final
        q, v = simulate(lagrangian(), begin, t1=t, motion=FINE, max_impacts=4).final
        parts = [one.position - q[:3], one.velocity - v[:3], R * (one.spin - v[3:])]
        places.append(np.asarray(one.position))
        far.append(float(jnp.max(jnp.abs(jnp.concatenate(parts)))))
    return np.array(places), np.array(far)


def checks(t1: float = 3.0, pivots: tuple = (0.0, 20.0)) -> list[Check]:
    rows = []
    for pivot in pivots:
        places, far = apart(pivot, np.linspace(0.0, t1, 11)[1:])
        rows.append(
            Check(f"against the Lagrangian system, pivot spin {pivot:g} rad/s", float(far.max()), 1e-9, unit="m, m/s")
        )
        off = np.max(np.abs(places[:, 2] - height(places[:, 0], places[:, 1])))
        rows.append(Check(f"on the surface, pivot spin {pivot:g} rad/s", float(off), 1e-14, unit="m"))
    state = BallState(*start(pivots[-1]))
    end = simulate(bowl(), state, t1=t1, motion=Exact(contact=FINE), max_impacts=4).final
    before = float(energy(bowl(), state))
    rows.append(Check("energy, relative", abs(float(energy(bowl(), end)) - before) / before, 1e-9))
    return rows


def picture() -> None:
    new, (left, right) = figure(7.2, 3.1, 1, 2, width_ratios=[1, 1.15])
    times = np.linspace(0.0, 6.0, 301)[1:]
    grid = np.linspace(-0.65, 0.65, 101)
    left.contour(grid, grid, height(grid[None, :], grid[:, None]), levels=8, colors=FAINT, linewidths=0.7)
    for pivot, colour, label in ((0.0, INK, "without pivot spin"), (20.0, VERMILION, "20 rad/s about the normal")):
        places, far = apart(pivot, times)
        left.plot(places[:, 0], places[:, 1], color=colour, lw=1.1, label=label)
        right.semilogy(times, np.maximum(far, 1e-16), color=colour, lw=1.1, label=label)
    left.set(xlim=(-0.65, 0.65), ylim=(-0.65, 0.65), aspect="equal")
    left.set_xlabel("x of the centre (m)", fontsize=9)
    left.set_ylabel("y of the centre (m)", fontsize=9)
    left.set_title("from above, with lines of equal height", fontsize=9)
    right.axhline(1e-9, color=BLUE, lw=0.8, ls="--")
    right.set_xlabel("time (s)", fontsize=9)
    right.set_ylabel("ball engine less Lagrangian system (m, m/s)", fontsize=9)
    right.legend(fontsize=7.5, frameon=False)
    save(new, NAME)


def main() -> int:
    failed = table("A rough ball rolls in a bowl", checks())
    picture()
    return failed


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    raise SystemExit(main())
