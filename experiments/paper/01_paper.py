"""Every theorem and every numbered formula of the paper, checked at random masses, radii, inertias, velocities and mu.

Errors are relative to the size of what is compared (of velocities: in the kinetic-energy norm), in units of the
machine's eps; the formulas as the paper prints them are evaluated in a longer format (float32: in float64; float64: in
NumPy's longdouble). Once in float64, once in float32. Exit code 1 if a line fails."""

import argparse
import pathlib
import sys
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import systems

from nonholo_jax import (
    Ball,
    BallState,
    Integrated,
    Plane,
    Rough,
    Scene,
    collide,
    momentum_about,
    projector,
    simulate,
    simulate_batch,
    slip,
    weak_residual,
)

sys.path.append(str(pathlib.Path(__file__).parents[1]))  # for report.py
from report import Check, table


class Draw(NamedTuple):
    """Random numbers, already rounded to the format that is tested, in the longer one."""

    m: np.ndarray
    r: np.ndarray
    j: np.ndarray
    v: np.ndarray  # of the centre, shape (n, 3)
    w: np.ndarray  # spin
    mu: np.ndarray
    dtype: type

    @property
    def eps(self) -> float:
        return float(np.finfo(self.dtype).eps)


def draw(n: int, dtype: type, seed: int = 0) -> Draw:
    """m from 0.1 to 10, r from 0.03 to 3, J/(m r^2) from 0.05 to 5, log-uniform; mu uniform in [0, 1]."""
    rng = np.random.default_rng(seed)
    longer = np.float64 if dtype == np.float32 else np.longdouble
    short = lambda x: np.asarray(x, dtype).astype(longer)  # noqa: E731
    spread = lambda low, high: low * (high / low) ** rng.random(n)  # noqa: E731
    m, r = spread(0.1, 10.0), spread(0.03, 3.0)
    j, v = spread(0.05, 5.0) * m * r**2, rng.normal(size=(n, 3))
    w = rng.normal(size=(n, 3)) / r[:, None]
    return Draw(short(m), short(r), short(j), short(v), short(w), short(rng.random(n)), dtype)


def device(d: Draw, *arrays: np.ndarray) -> list:
    return [jnp.asarray(np.asarray(x, d.dtype)) for x in arrays]


def solve(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """a^-1 b for positive definite a, by elimination: NumPy has no longdouble solver."""
    x = np.concatenate([a, b], axis=-1)
    n = a.shape[-1]
    for i in range(n):
        x[..., i, :] /= x[..., i, i, None]
        for k in range(n):
            if k != i:
                x[..., k, :] -= x[..., k, i, None] * x[..., i, :]
    return x[..., n:]


def product(a: np.ndarray, x: np.ndarray) -> np.ndarray:
    return np.einsum("...ij,...j->...i", a, x)


def formula_3_1(g: np.ndarray, b: np.ndarray) -> np.ndarray:
    """P = G^-1 B^T (B G^-1 B^T)^-1 B, as it is printed."""
    bt = np.swapaxes(b, -1, -2)
    return solve(g, bt) @ solve(b @ solve(g, bt), b)


def worst(error: np.ndarray, size: np.ndarray, d: Draw) -> float:
    """The largest relative error, in eps."""
    return float(np.max(np.abs(error) / np.abs(size)) / d.eps)


def norm(g: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Of velocities, from the kinetic energy: sqrt(2 T)."""
    return np.sqrt(np.einsum("...i,...ij,...j->...", v, g, v))


def miss(g: np.ndarray, got, want: np.ndarray, before: np.ndarray, d: Draw) -> float:
    return worst(norm(g, np.asarray(got, want.dtype) - want), norm(g, before), d)


def stack(rows: list, like: np.ndarray) -> np.ndarray:
    """A batch of matrices from rows of numbers and arrays."""
    return np.stack([np.stack([np.broadcast_to(x, like.shape) for x in row], -1) for row in rows], -2).astype(
        like.dtype
    )


def diagonal(*entries: np.ndarray) -> np.ndarray:
    return np.stack(entries, -1)[..., None] * np.eye(len(entries), dtype=entries[0].dtype)


def rolling_rows(r: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A and B of section 5.1; velocities (v1, v2, w1, w2, w3)."""
    a = stack([[1, 0, 0, -r, 0], [0, 1, r, 0, 0]], r)
    return a, stack([[1, 0, 0, 0, 0], [0, 1, 0, 0, -r], [0, 0, 0, 1, 0], [0, 1, r, 0, 0]], r)


def floor_rows(r: np.ndarray) -> np.ndarray:
    """B of section 5.2; velocities (v1, v2, v3, w1, w2, w3)."""
    return stack([[1, 0, 0, 0, -r, 0], [0, 1, 0, r, 0, 0], [0, 0, 1, 0, 0, 0]], r)


def rolls(d: Draw, v1: np.ndarray, v2: np.ndarray, w3: np.ndarray) -> np.ndarray:
    """The velocity of a ball that rolls on the floor: (5.1)."""
    return np.stack([v1, v2, -v2 / d.r, v1 / d.r, w3], -1)


impacts = jax.jit(jax.vmap(collide))
projectors = jax.jit(jax.vmap(projector))
slips_at_floor = jax.jit(jax.vmap(lambda scene, state: slip(scene, state, "floor")))
momenta_about = jax.jit(jax.vmap(momentum_about))


def constraints(d: Draw) -> list[Check]:
    """(1.1) and (1.2): the velocity of the touching points, by the cross product; (5.1)."""
    a, b = rolling_rows(d.r)
    v = np.concatenate([d.v[:, :2], d.w], -1)
    level = d.v * np.array([1, 1, 0])  # the centre stays at the height r
    at = lambda arm: level + np.cross(d.w, d.r[:, None] * np.array(arm))  # noqa: E731
    floor, wall = at([0, 0, -1]), at([-1, 0, 0])
    size = np.linalg.norm(level, axis=-1) + d.r * np.linalg.norm(d.w, axis=-1)
    position, velocity, spin = device(d, d.r[:, None] * np.array([0, 0, 1]), level, d.w)
    states = BallState(position, velocity, spin)
    scenes = ball_scenes(*device(d, d.m, d.r, d.j, d.mu))
    slips = np.asarray(slips_at_floor(scenes, states), d.r.dtype)
    both = np.stack([wall[:, 0], wall[:, 1], wall[:, 2] / d.r, floor[:, 1]], -1)
    own = np.array(rolls(d, d.v[:, 0], d.v[:, 1], d.w[:, 2]))
    own = np.asarray(own, d.dtype).astype(own.dtype)
    of_wall = np.max(np.abs(product(b, v) - both) * np.stack([1 + 0 * d.r, 1 + 0 * d.r, d.r, 1 + 0 * d.r], -1), -1)
    return [
        Check("(1.1)  v_C = v_S + [w, SC]: rows of A, slip()", worst(np.max(np.abs(slips - floor), -1), size, d), 8),
        Check("(1.1)  A v is the velocity of C", worst(np.max(np.abs(product(a, v) - floor[:, :2]), -1), size, d), 8),
        Check("(1.2)  B v is the velocity of G, and of C", worst(of_wall, size, d), 8),
        Check("(5.1)  v1 = w2 r, v2 = -w1 r solve A v = 0", worst(np.max(np.abs(product(a, own)), -1), size, d), 8),
    ]


def random_system(d: Draw, n: int = 6, k: int = 3) -> tuple[np.ndarray, ...]:
    """G positive definite, B = [I C] with the kernel (-C z, z), A = gamma B, a velocity v, and u in ker B."""
    rng = np.random.default_rng(1)
    count, longer = d.m.shape[0], d.m.dtype
    short = lambda *shape: rng.normal(size=(count, *shape)).astype(d.dtype).astype(longer)  # noqa: E731
    root = short(n, n)
    g = (root @ np.swapaxes(root, -1, -2) + np.eye(n)).astype(d.dtype).astype(longer)
    g = (0.5 * (g + np.swapaxes(g, -1, -2))).astype(d.dtype).astype(longer)
    c, z = short(k, n - k), short(n - k)
    b = np.concatenate([np.broadcast_to(np.eye(k, dtype=longer), (count, k, k)), c], -1)
    return g, b, short(2, k) @ b, short(n), np.concatenate([-product(c, z), z], -1)


def algebra(d: Draw) -> list[Check]:
    """Lemma 1, (2.9) and (4.1), the three hypotheses and Theorem 4.1, for random G and B of rank 3 in 6 dimensions."""
    g, b, a, v, u = random_system(d)
    p = np.asarray(projectors(*device(d, g, b)), g.dtype)
    exact = formula_3_1(g, b)
    after = np.asarray(impacts(*device(d, v, g, b)), g.dtype)
    again = np.asarray(impacts(*device(d, after, g, b)), g.dtype)
    other = np.asarray(d.v[:, :1] * v + d.v[:, 1:2] * u, d.dtype)
    linear = d.v[:, :1] * after + d.v[:, 1:2] * np.asarray(impacts(*device(d, u, g, b)))
    size, sizes = norm(g, v), np.linalg.norm(exact, axis=(-2, -1))
    matrix = lambda x: np.linalg.norm(np.asarray(x, float), axis=(-2, -1))  # noqa: E731
    jump = np.einsum("...i,...ij,...j->...", u, g, after - v)
    energy = norm(g, after) ** 2 - size**2
    across, along = product(exact, v), v - product(exact, v)
    split = lambda x: np.asarray(x, g.dtype)  # noqa: E731
    plastic = split(impacts(*device(d, v, g, b, d.mu)))
    return [
        Check("(3.1)  P = G^-1 B^T (B G^-1 B^T)^-1 B", worst(matrix(p - exact), sizes, d), 100),
        Check("Lemma 1  P P = P", worst(matrix(p @ p - p), sizes**2, d), 100),
        Check("Lemma 1  ker P = ker B", worst(norm(g, product(p, u)), matrix(exact) * norm(g, u), d), 100),
        Check("Lemma 1  W is orthogonal to ker B: G P = (G P)^T",
              worst(matrix(g @ p - np.swapaxes(g @ p, -1, -2)), matrix(g) * sizes, d), 100),
        Check("(3.2)  A P = A where ker B is in ker A", worst(matrix(a @ p - a), matrix(a) * sizes, d), 100),
        Check("(2.9), (4.1)  T(v+ - v-, u) = 0 for u in ker B", worst(jump, norm(g, u) * size, d), 100),
        Check("Hypothesis 1  v+ is linear in v-", miss(g, impacts(*device(d, other, g, b)), linear, other, d), 100),
        Check("Hypothesis 2  T is conserved", worst(energy, size**2, d), 100),
        Check("Hypothesis 3  R R = I", miss(g, again, v, v, d), 100),
        Check("(2.6)  v- in ker B is not changed", miss(g, impacts(*device(d, u, g, b)), u, u, d), 100),
        Check("(4.2)  Theorem 4.1: v+ = (I - 2 P) v-", miss(g, after, v - 2 * across, v, d), 100),
        Check("(4.3)  Q = -1: P v+ = -P v-", miss(g, product(exact, after), -across, v, d), 100),
        Check("(4.3)  what is parallel to ker B is kept", miss(g, after - product(exact, after), along, v, d), 100),
        Check("(6.1)  v+ = -mu v_perp + v_par", miss(g, plastic, along - d.mu[:, None] * across, v, d), 100),
    ]  # fmt: skip


def theorem_5_1(d: Draw) -> np.ndarray:
    """v+ as it is printed."""
    m, r, j, (v1, v2), w3 = d.m, d.r, d.j, d.v[:, :2].T, d.w[:, 2]
    jp, jt = j + r**2 * m, j + r**2 * m / 2
    after = (r**2 * m / (2 * jt) * v2 + r * j / jt * w3, jp / (r * jt) * v2 - r**2 * m / (2 * jt) * w3)
    return rolls(d, -v1, *after)


def section_6(d: Draw, mu: np.ndarray) -> np.ndarray:
    """The formulas of section 6 as they are printed; with mu = 1 they are Theorem 5.2."""
    m, r, j, (v1, v2, v3), (w1, w2, w3) = d.m, d.r, d.j, d.v.T, d.w.T
    jp = j + m * r**2
    return np.stack([
        (m * r**2 - mu * j) / jp * v1 + j * r * (1 + mu) / jp * w2,
        (m * r**2 - mu * j) / jp * v2 - j * r * (1 + mu) / jp * w1,
        -mu * v3,
        -r * m * (1 + mu) / jp * v2 + (j - mu * m * r**2) / jp * w1,
        r * m * (1 + mu) / jp * v1 + (j - mu * m * r**2) / jp * w2,
        w3,
    ], -1)  # fmt: skip


def theorem_5_2(d: Draw) -> np.ndarray:
    """v+ as it is printed."""
    m, r, j, (v1, v2, v3), (w1, w2, w3) = d.m, d.r, d.j, d.v.T, d.w.T
    jp = j + m * r**2
    return np.stack([
        (m * r**2 - j) / jp * v1 + 2 * j * r / jp * w2, (m * r**2 - j) / jp * v2 - 2 * j * r / jp * w1, -v3,
        -2 * r * m / jp * v2 + (j - m * r**2) / jp * w1, 2 * r * m / jp * v1 + (j - m * r**2) / jp * w2, w3,
    ], -1)  # fmt: skip


def ball_scene(m, r, j, mu) -> Scene:
    ball = Ball(r, m, j / (m * r**2))
    return Scene(ball, {"floor": Plane((0, 0, 0), (0, 0, 1), Rough(mu))}, gravity=(0.0, 0.0, 0.0))


ball_scenes = jax.jit(jax.vmap(ball_scene))


def by_the_ball_engine(d: Draw, mu: np.ndarray):
    """One impact of every ball, by `simulate_batch` over scenes and states: they start in touch, and approach."""
    scenes = ball_scenes(*device(d, d.m, d.r, d.j, mu))
    v = np.concatenate([d.v[:, :2], -np.abs(d.v[:, 2:])], -1)
    states = BallState(*device(d, d.r[:, None] * np.array([0, 0, 1]), v, d.w))
    log = simulate_batch(scenes, states, t1=1.0, scene_axes=0, max_impacts=1).impacts
    before, after = (jax.tree.map(lambda x: x[:, 0], state) for state in (log.before, log.after))
    return scenes, log.point[:, 0], before, after, d._replace(v=v)


def balls(d: Draw) -> list[Check]:
    """Theorems 5.1 and 5.2, the momentum about C, and the formulas of section 6, by B and by the ball engine."""
    a, b = rolling_rows(d.r)
    g = diagonal(d.m, d.m, d.j, d.j, d.j)
    v = np.asarray(rolls(d, d.v[:, 0], d.v[:, 1], d.w[:, 2]), d.dtype)
    rolled = np.asarray(impacts(*device(d, v, g, b)), g.dtype)
    at_floor, gg = floor_rows(d.r), diagonal(d.m, d.m, d.m, d.j, d.j, d.j)
    vv = np.concatenate([d.v, d.w], -1)
    elastic = impacts(*device(d, vv, gg, at_floor))
    lossy = impacts(*device(d, vv, gg, at_floor, d.mu))
    _, _, _, after, falling = by_the_ball_engine(d, d.mu)
    lost = np.concatenate([after.velocity, after.spin], -1)
    scenes, point, before, after, falling = by_the_ball_engine(d, np.ones_like(d.mu))
    kept = np.concatenate([after.velocity, after.spin], -1)
    momenta = [momenta_about(point, scenes, state) for state in (before, after)]
    size = d.r * d.m * np.linalg.norm(d.v, axis=-1) + d.j * np.linalg.norm(d.w, axis=-1)
    turned = np.linalg.norm(np.asarray(momenta[1] - momenta[0], size.dtype), axis=-1)
    drift = np.max(np.abs(product(a, rolled)), -1)
    speed = np.linalg.norm(d.v, axis=-1) + d.r * np.linalg.norm(d.w, axis=-1)
    return [
        Check("Theorem 5.1  by A and B of section 5.1", miss(g, rolled, theorem_5_1(d), v, d), 100),
        Check("Theorem 5.1  the ball still rolls: A v+ = 0", worst(drift, speed, d), 100),
        Check("Theorem 5.2  by B of section 5.2", miss(gg, elastic, theorem_5_2(d), vv, d), 100),
        Check("Theorem 5.2  by simulate(Scene)", miss(gg, kept, theorem_5_2(falling), vv, d), 100),
        Check("after Theorem 5.2  momentum about C is conserved", worst(turned, size, d), 100),
        Check("section 6  formulas with mu, by B", miss(gg, lossy, section_6(d, d.mu), vv, d), 100),
        Check("section 6  formulas with mu, by simulate(Scene)", miss(gg, lost, section_6(falling, d.mu), vv, d), 100),
    ]


def pendulum(d: Draw, bounces: int = 50) -> list[Check]:
    """5.2.1: v- = (-v, 0, -u), w = r m v / J. At every bounce both are reversed, and every second one is where the
    first was."""
    v, u = np.abs(d.v[:, 0]) + 0.1, np.abs(d.v[:, 2]) + 1.0
    m, r, j = d.m, d.r, d.j
    zero = 0 * v
    x, vel = np.stack([zero, zero, r], -1), np.stack([-v, zero, -u], -1)
    states = BallState(*device(d, x, vel, np.stack([zero, r * m * v / j, zero], -1)))
    one = jax.jit(jax.vmap(lambda m, r, j, state, t1: simulate(
        Scene(Ball(r, m, j / (m * r**2)), {"floor": Plane((0, 0, 0), (0, 0, 1), Rough())}), state, t1=t1,
        max_impacts=bounces, throw=False).impacts))  # fmt: skip
    log = one(*device(d, m, r, j), states, *device(d, 2 * u / 9.81 * (bounces + 0.5)))
    both = lambda state: np.concatenate([state.velocity, r[:, None, None] * np.asarray(state.spin)], -1)  # noqa: E731
    before, after = both(log.before), both(log.after)
    speed = np.max(np.abs(before[:, 0]), -1)
    home = np.max(np.abs(log.point[:, ::2] - log.point[:, :1]), (1, 2))
    return [
        Check("5.2.1  v+ = -v-, w+ = -w-", worst(np.max(np.abs(before + after), (1, 2)), speed, d), 100),
        Check(f"5.2.1  {bounces} bounces at two places", worst(home, 2 * u * v / 9.81, d), 50 * bounces),
    ]


def motions(d: Draw) -> list[Check]:
    """(2.3) and the weak form (2.4) to (2.9) over a motion through three impacts, that of a knife edge on an incline
    which meets a wall; the equation (2.2) between impacts."""
    fine = d.dtype == np.float64
    tolerance, limit = (1e-11, 1e-9) if fine else (1e-6, 1e-4)
    case = next(case for case in systems.all_systems if case.name == "knife")
    system = case.build(0.8)
    q, v = (jnp.asarray(np.asarray(x, d.dtype)) for x in (case.q, case.v))
    motion = Integrated(rtol=tolerance, atol=tolerance)
    trajectory = simulate(system, (q, v), t1=case.t1, motion=motion, max_impacts=3)
    final = [np.asarray(x, float) for x in trajectory.final]
    blade = np.array([-np.sin(final[0][2]), np.cos(final[0][2]), 0.0])
    drift = np.array([blade @ final[1] / (np.abs(blade) @ np.abs(final[1]))])
    # Of B only the row that is also A's: psi may then move the blade into the wall.
    wall = eqx.tree_at(lambda wall: wall.constraint, system.barriers[0], system.constraint)
    loose = eqx.tree_at(lambda system: system.barriers, system, (wall,))
    right, planted = (float(weak_residual(each, trajectory)) / d.eps for each in (system, loose))
    return [
        Check("(2.2)  Lagrange-d'Alembert between impacts, Chaplygin's sleigh", equation_2_2(d), 100),
        Check("(2.3)  x' in ker A after three impacts, knife edge", worst(drift, np.ones(1), d), 16),
        Check("(2.4)  the weak form, (2.7) to (2.9): knife edge, three impacts", right, limit / d.eps),
        Check("(2.5)  with psi outside of ker B it does not hold", planted, 1e-3 / d.eps, above=True),
    ]


def equation_2_2(d: Draw) -> float:
    """(d/dt dL/dv - dL/dx) psi for psi in ker A, at random states of the sleigh, with its acceleration; relative."""
    system = systems.sleigh().without_contacts()
    lagrangian = system.lagrangian

    def one(heading, speed, turn):
        q = jnp.stack([0 * heading, 0 * heading, heading])
        ahead = jnp.stack([jnp.cos(heading), jnp.sin(heading), 0 * heading])
        v = speed * ahead + turn * jnp.eye(3, dtype=q.dtype)[2]
        w, rate = system.acceleration(jnp.zeros_like(heading), q, v)
        _, force = jax.jvp(jax.grad(lagrangian, 1), (q, v), (w, rate))
        left = force - jax.grad(lagrangian, 0)(q, v)
        return jnp.stack([left @ ahead, left[2]]), jnp.sqrt(jnp.sum(force**2)) + jnp.sum(v**2)

    left, size = jax.jit(jax.vmap(one))(*device(d, *d.v.T))
    return worst(np.max(np.abs(left), -1), np.asarray(size), d)


def misprints(d: Draw) -> None:
    """errata.md: the two matrices P that the paper prints are not those of (3.1)."""
    a = formula_3_1(diagonal(d.m, d.m, d.j, d.j, d.j), rolling_rows(d.r)[1])
    b = formula_3_1(diagonal(d.m, d.m, d.m, d.j, d.j, d.j), floor_rows(d.r))
    jt, jp = d.j + d.r**2 * d.m / 2, d.j + d.r**2 * d.m
    print("Misprints of the paper, no failures: (3.1) gives P_11 = P_44 = 1 in 5.1, where 1/(2 J~) is printed "
          f"(here {float(a[0, 0, 0]):.3g}, {float(a[0, 3, 3]):.3g}; {float(1 / (2 * jt[0])):.3g}),\n"
          f"and P_33 = 1 in 5.2, where 1/J' is printed (here {float(b[0, 2, 2]):.3g}; {float(1 / jp[0]):.3g}). "
          "The theorems themselves are right.")  # fmt: skip


def checks(n: int = 2000, dtype: type = np.float64, bounces: int = 50) -> list[Check]:
    d = draw(n, dtype)
    few = Draw._make([*(x[:200] for x in d[:-1]), d.dtype])
    return [*constraints(d), *algebra(d), *balls(d), *pendulum(few, bounces), *motions(d)]


def main() -> int:
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("--samples", type=int, default=2000)
    options = parser.parse_args()
    failed = 0
    for dtype in (np.float64, np.float32):
        title = f"{dtype.__name__}, {options.samples} samples, errors and bounds in eps = {np.finfo(dtype).eps:.3g}"
        failed |= table(title, checks(options.samples, dtype))
    misprints(draw(1, np.float64))
    return failed


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    raise SystemExit(main())
