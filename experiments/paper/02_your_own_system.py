"""A nonholonomic system of your own, in under 25 lines: a cart with two wheels on a ramp, which runs into a wall.

q = (x, y, heading, left wheel, right wheel); (x, y) is the middle of the axle and x goes down the ramp. The wheels
neither slip nor skid; the centre of mass is ahead of the axle, on a castor that is free to swivel."""

import pathlib
import sys

import jax
import jax.numpy as jnp

from nonholo_jax import Barrier, Integrated, LagrangianSystem, energy, law_residual, simulate, weak_residual

sys.path.append(str(pathlib.Path(__file__).parents[1]))  # for report.py
from report import Check, table


def cart(restitution, wheel=0.05, half_axle=0.15, centre=0.08, nose=0.2):
    """At the wall x = 1 the nose of the cart has no velocity into the wall, and may slide along it."""

    def lagrangian(q, v):
        c, s = jnp.cos(q[2]), jnp.sin(q[2])
        velocity = v[:2] + centre * v[2] * jnp.stack([-s, c])
        kinetic = 1.5 * jnp.sum(velocity**2) + 0.02 * v[2] ** 2 + 3e-4 * jnp.sum(v[3:] ** 2)
        return kinetic + 3.0 * 0.8 * (q[0] + centre * c)  # m = 3 kg; g sin(slope) = 0.8 m/s^2

    def wheels(q):
        c, s = jnp.cos(q[2]), jnp.sin(q[2])
        return jnp.array([[-s, c, 0, 0, 0], [c, s, -half_axle, -wheel, 0], [c, s, half_axle, 0, -wheel]])

    def wheels_and_nose(q):
        return jnp.concatenate([wheels(q), jnp.array([[1.0, 0, -nose * jnp.sin(q[2]), 0, 0]])])

    wall = Barrier(lambda q: 1.0 - q[0] - nose * jnp.cos(q[2]), wheels_and_nose, restitution, curvature=nose)
    return LagrangianSystem(lagrangian, constraint=wheels, barriers=[wall])


MOTION = Integrated(rtol=1e-11, atol=1e-11)


@jax.jit
def roll(heading):
    """The motion from rest at x = 0."""
    zero = jnp.zeros_like(heading)
    q = jnp.stack([zero, zero, heading, zero, zero])
    return simulate(cart(0.8), (q, jnp.zeros_like(q)), t1=6.0, motion=MOTION, max_impacts=8)


def checks() -> list[Check]:
    heading, h = jnp.asarray(0.3), 1e-5
    system, trajectory = cart(0.8), roll(heading)
    log, n = trajectory.impacts, int(trajectory.n_impacts)
    q, v = trajectory.final
    slope = jax.grad(lambda heading: roll(heading).final[0][1])(heading)
    central = (roll(heading + h).final[0][1] - roll(heading - h).final[0][1]) / (2 * h)
    before, after = (jax.vmap(system.energy)(*state) for state in (log.before, log.after))
    arcs = jnp.append(before[:n], energy(system, (q, v))) - jnp.append(system.energy(*trajectory.initial), after[:n])
    print(f"{n} impacts at t = {log.time[:n]} s; energy {before[:n]} J before, {after[:n]} J after")
    print(f"y(6 s) = {float(q[1]):.6f} m, d y(6 s) / d heading = {float(slope):.6f} m/rad, through {n} impacts\n")
    slip = jnp.max(jnp.abs(system.constraint(q) @ v)) / jnp.max(jnp.abs(v))
    return [
        Check("energy between impacts, change", float(jnp.max(jnp.abs(arcs))), 1e-9, unit="J"),
        Check("energy at impacts, largest change", float(jnp.max(after[:n] - before[:n])), 0.0, unit="J"),
        Check("weak_residual: the paper's (2.4)", float(weak_residual(system, trajectory)), 1e-9),
        Check("law_residual: the paper's (6.1)", float(law_residual(system, trajectory)), 1e-12),
        Check("|A v| / |v| at the end", float(slip), 1e-14),
        Check("gradient against central differences, relative", float(jnp.abs(slope / central - 1)), 1e-6),
    ]


def main() -> int:
    return table("A cart on a ramp runs into a wall", checks())


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    raise SystemExit(main())
