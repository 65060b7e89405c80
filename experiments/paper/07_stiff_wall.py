"""Reflection as the limit of a stiff wall. The impact (4.2) is replaced by a compliant layer: during contact

    s' = B v,    G v' = (Lagrange-d'Alembert) - k B^T (B G^-1 B^T)^-1 s,    s = 0 at the first touch,

until the gap is zero again. Where B is constant and nothing else acts, B v swings as cos(sqrt(k) t) and is reversed
after pi / sqrt(k), for every k. What else happens during the contact spoils that:

- smooth flat floor, gravity: nothing does; the energy alone makes it exact at every k;
- rough flat floor, gravity: the contact gets longer by O(1/k), a phase error of O(1/sqrt(k)) at the end of a swing: the
  velocity tends to that of (4.2) at the rate 1/k;
- round smooth wall, sleigh at a wall (whose A holds all the time): B turns while it lasts: 1/sqrt(k).

Picture: the error against the stiffness, and the contact of the rough ball at three of them."""

import pathlib
import sys
from typing import Any, NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import optimistix
from systems import M, R, diagonal, floor_of_normals, sleigh, thrown_ball

from nonholo_jax import Barrier, LagrangianSystem, collide

sys.path.append(str(pathlib.Path(__file__).parents[1]))  # for report.py
from report import BLUE, GREEN, INK, ORANGE, VERMILION, Check, figure, save, table

NAME = "stiff_wall"
NOISE = 1e-9  # of the end of the contact, as it is found
STIFFNESS = 10.0 ** np.arange(4, 13)  # s^-2


class Case(NamedTuple):
    name: str
    system: LagrangianSystem
    q: Any  # at the first touch
    v: Any
    rate: float | None  # the error is as k to the power of -rate; None: it is zero


def bowl() -> LagrangianSystem:
    """A point that slides in a bowl |q| < 1, pulled down: one smooth round wall, B = gradient of the gap."""
    gap = lambda q: 0.5 * (1.0 - jnp.sum(q**2))  # noqa: E731
    wall = Barrier(gap, lambda q: -q[None, :])
    return LagrangianSystem(metric=diagonal(M, M), potential=lambda q: 9.81 * M * q[1], barriers=[wall])


TURN = [1.0, 0.0, 0.0, 0.0]
THROW = ([0.0, 0.0, R, *TURN], [1.0, -0.5, -2.0, 3.0, 12.0, -5.0])
CASES = (
    Case("holonomic: smooth floor", floor_of_normals(), *THROW, None),
    Case("holonomic: round smooth wall", bowl(), [0.6, -0.8], [1.0, -0.7], 0.5),
    Case("nonholonomic: rough floor", thrown_ball(), *THROW, 1.0),
    Case("nonholonomic: sleigh at a wall", sleigh(), [0.1, 0.0, 0.5], [1.5 * np.cos(0.5), 1.5 * np.sin(0.5), 0.9], 0.5),
)


def layer(system: LagrangianSystem):
    """The vector field in the time tau = sqrt(k) t, of (q, v, sigma = sqrt(k) s); its argument is 1 / sqrt(k), so
    that (4.2) is the limit at 0."""
    free, barrier = system.without_contacts(), system.barriers[0]

    def field(tau, y, eps):
        q, v, sigma = y
        rate, a = free.acceleration(eps * tau, q, v)
        b, metric = barrier.constraint(q), system.metric_at(q)
        lift = jnp.linalg.solve(metric, b.T)
        return eps * rate, eps * a - lift @ jnp.linalg.solve(b @ lift, sigma), b @ v

    return diffrax.ODETerm(field)


def contact(case: Case, eps, tolerance: float = 1e-12, times: Any = None):
    """(q, v) at the end of the contact, and how long it was in units of pi sqrt(1 / k); or, at the given times, v."""
    q, v = jnp.asarray(case.q), jnp.asarray(case.v)
    barrier, term = case.system.barriers[0], layer(case.system)
    y = (q, v, jnp.zeros(barrier.constraint(q).shape[0]))
    options: dict = {"stepsize_controller": diffrax.PIDController(rtol=tolerance, atol=tolerance), "args": eps}
    solve = lambda y, a, b, **how: diffrax.diffeqsolve(  # noqa: E731
        term, diffrax.Dopri8(), a, b, 0.01, y, **options, **how)  # fmt: skip
    if times is not None:
        found = solve(y, 0.0, times[-1], saveat=diffrax.SaveAt(ts=times)).ys
        assert found is not None
        return found[1]
    # Half way first: at the touch itself the gap is zero too.
    ys = solve(y, 0.0, 0.5 * jnp.pi).ys
    y = jax.tree.map(lambda x: x[-1], ys)
    event = diffrax.Event(
        lambda t, y, args, **_: barrier.gap(y[0]) / eps, optimistix.Newton(1e-10, 1e-10), direction=True
    )
    end = solve(y, 0.5 * jnp.pi, 2.0 * jnp.pi, event=event)
    assert end.ys is not None and end.ts is not None
    q, v, _ = (x[-1] for x in end.ys)
    return q, v, end.ts[-1] / jnp.pi


def errors(case: Case, stiffness: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """|v - v+| / |v-| in the metric, v+ from (4.2) at the touch; and the durations."""
    q, v = jnp.asarray(case.q), jnp.asarray(case.v)
    metric = case.system.metric_at(q)
    want = collide(v, metric, case.system.barriers[0].constraint(q))
    size = lambda v: jnp.sqrt(jnp.einsum("...i,ij,...j->...", v, metric, v))  # noqa: E731
    _, got, lasted = jax.jit(jax.vmap(lambda eps: contact(case, eps)))(jnp.asarray(stiffness**-0.5))
    return np.asarray(size(got - want[None]) / size(v)), np.asarray(lasted)


def checks(cases=CASES, stiffness: np.ndarray = STIFFNESS) -> list[Check]:
    rows = []
    for case in cases:
        miss, lasted = errors(case, stiffness)
        rows.append(Check(f"{case.name}: contact / (pi / sqrt(k)) - 1", abs(float(lasted[-1]) - 1), 1e-5))
        if case.rate is None:
            rows.append(Check(f"{case.name}: largest error", float(miss.max()), NOISE))
            continue
        clear = miss > 10 * NOISE
        rate = -float(np.polyfit(np.log(stiffness[clear]), np.log(miss[clear]), 1)[0])
        rows += [
            Check(f"{case.name}: smallest error", float(miss.min()), 1e-4),
            Check(f"{case.name}: rate {rate:.3f}, off {case.rate:g} by", abs(rate - case.rate), 0.02),
        ]
    return rows


def picture() -> None:
    new, (left, right) = figure(7.2, 3.5, 1, 2)
    for case, colour, mark in zip(CASES, (ORANGE, GREEN, BLUE, VERMILION), "os^D", strict=True):
        left.loglog(STIFFNESS, errors(case, STIFFNESS)[0], mark + "-", ms=3.5, lw=1.0, color=colour, label=case.name)
    left.loglog(STIFFNESS, 30 * STIFFNESS**-0.5, color=INK, lw=0.8, ls=":", label=r"$k^{-1/2}$")
    left.loglog(STIFFNESS[:5], 30 / STIFFNESS[:5], color=INK, lw=0.8, ls="--", label=r"$k^{-1}$")
    left.set_xlabel(r"stiffness $k$ (s$^{-2}$)", fontsize=9)
    left.set_ylabel(r"$|v - v^+| \,/\, |v^-|$", fontsize=9)
    new.legend(handles=left.get_lines(), fontsize=7, frameon=False, loc="outside upper left", ncols=3)
    rough, times = CASES[2], jnp.linspace(0.0, np.pi, 100)
    for k, style in ((1e2, ":"), (1e3, "--"), (1e6, "-")):
        v = np.asarray(contact(rough, k**-0.5, times=times))
        for i, colour, scale in ((0, BLUE, 1.0), (2, INK, 1.0), (4, VERMILION, R)):
            right.plot(times / np.pi, scale * v[:, i], color=colour, lw=1.2, ls=style)
        right.plot([], [], color=INK, ls=style, lw=1.2, label=f"$k = 10^{{{np.log10(k):.0f}}}$ s$^{{-2}}$")
    barrier, q = rough.system.barriers[0], jnp.asarray(rough.q)
    want = np.asarray(collide(jnp.asarray(rough.v), rough.system.metric_at(q), barrier.constraint(q)))
    for i, colour, scale, label in ((0, BLUE, 1.0, "$v_1$"), (2, INK, 1.0, "$v_3$"), (4, VERMILION, R, r"$r\omega_2$")):
        right.plot(1.0, scale * want[i], "o", color=colour, ms=5, mfc="white", clip_on=False)
        right.annotate(label, (1.0, scale * want[i]), xytext=(7, 0), textcoords="offset points", color=colour,
                       fontsize=9, va="center", annotation_clip=False)  # fmt: skip
    right.plot([], [], "o", color=INK, ms=5, mfc="white", label="(4.2)")
    right.set_xlim(0, 1)
    right.set_xlabel(r"time in the contact, $t\sqrt{k}/\pi$", fontsize=9)
    right.set_ylabel("velocity (m/s)", fontsize=9)
    right.legend(fontsize=7, frameon=False)
    save(new, NAME)


def main() -> int:
    failed = table("Reflection as the limit of a stiff wall", checks())
    picture()
    return failed


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    raise SystemExit(main())
