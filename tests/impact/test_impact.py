"""Lemma 1, Theorems 4.1, 5.1, 5.2 and section 6, at ordinary and at extreme masses, inertias and radii.

Errors are measured in the metric: y = L^T v, G = L L^T, so that |y| is the kinetic-energy norm of v.
"""

import inspect
import re

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
from jax.test_util import check_grads

from nonholo_jax import collide, projector

BATCH = 32
SHAPES = [(1, 1), (6, 3), (5, 5), (4, 7)]  # (n, k)
RATIOS = [1e-12, 1.0, 1e12]
# J/m and r: the inertia ratio J/(m r^2) runs from 1e-24 to 1e24.
BALLS = [(0.4, 1.0), (1e-12, 1.0), (1e12, 1.0), (1.0, 1e-6), (1.0, 1e6), (1e-12, 1e6), (1e12, 1e-6)]
dtypes = pytest.mark.parametrize("dtype", [np.float32, np.float64])
shapes = pytest.mark.parametrize("n, k", SHAPES)
ratios = pytest.mark.parametrize("ratio", RATIOS)
balls = pytest.mark.parametrize("inertia, radius", BALLS)

project_one = jax.jit(projector)
project_batch = jax.jit(jax.vmap(projector))
collide_batch = jax.jit(jax.vmap(collide))  # None has no axes
collide_many = jax.jit(jax.vmap(collide, (0, None, None, None)))


def ulps(error, dtype):
    """The largest entry of `error`, in units of the dtype's eps; NaN counts as infinite."""
    return np.nan_to_num(np.max(np.abs(error), initial=0), nan=np.inf) / np.finfo(dtype).eps


class Systems:
    """A batch of random metrics G = (S K)(S K)^T, S of the given ratio, with B and v to match."""

    def __init__(self, n, k, ratio, dtype, seed=0):
        rng = np.random.default_rng(seed)
        scale = np.where(np.arange(n) % 2 == 1, np.sqrt(ratio), 1.0) * rng.uniform(0.5, 2, (BATCH, n))
        corr = np.eye(n) + 0.3 * np.tril(rng.uniform(-1, 1, (BATCH, n, n)), -1)
        factor = scale[:, :, None] * corr
        rows = rng.standard_normal((BATCH, k, n))
        self.dtype = dtype
        self.metric = jnp.asarray(factor @ factor.mT, dtype)
        # Rows of balanced whitened size, in units that differ by up to 1e6 from row to row.
        units = 10.0 ** rng.uniform(-3, 3, (BATCH, k, 1))
        self.constraint = jnp.asarray(units * rows * scale[:, None, :], dtype)
        self.velocity = jnp.asarray(rng.standard_normal((BATCH, n)) / scale, dtype)
        self.restitution = jnp.asarray(rng.uniform(0, 1, BATCH), dtype)
        # What follows belongs to the rounded G and B, whose digits the tests compare.
        metric = np.asarray(self.metric, np.float64)
        diagonal = np.sqrt(np.diagonal(metric, axis1=1, axis2=2))
        self._scale = diagonal
        self._corr = np.linalg.cholesky(metric / diagonal[:, :, None] / diagonal[:, None, :])

    def white(self, v):
        """L^T v"""
        return (self._corr.mT @ (self._scale * np.asarray(v, np.float64))[..., None])[..., 0]

    def white_operator(self, p):
        """L^T P L^-T"""
        p = self._scale[:, :, None] * np.asarray(p, np.float64) / self._scale[:, None, :]
        return np.linalg.solve(self._corr, (self._corr.mT @ p).mT).mT

    def white_rows(self, b):
        """B L^-T, and its rows' lengths"""
        w = np.linalg.solve(self._corr, (np.asarray(b, np.float64) / self._scale[:, None, :]).mT).mT
        return w, np.linalg.norm(w, axis=-1, keepdims=True)

    def project(self):
        return project_batch(self.metric, self.constraint)

    def collide(self, velocity, restitution, offset=None):
        restitution = jnp.broadcast_to(jnp.asarray(restitution, self.dtype), (BATCH,))
        return collide_batch(velocity, self.metric, self.constraint, restitution, offset)


@dtypes
@shapes
@ratios
def test_idempotent_and_orthogonal(n, k, ratio, dtype):
    # P P = P; G P symmetric; B P = B; rank P = rank B.
    s = Systems(n, k, ratio, dtype)
    p = s.white_operator(s.project())
    assert ulps(p @ p - p, dtype) < 40
    assert ulps(p - p.mT, dtype) < 40
    w, length = s.white_rows(s.constraint)
    assert ulps((w @ p - w) / length, dtype) < 60
    assert ulps(np.trace(p, axis1=1, axis2=2) - min(n, k), dtype) < 60


@dtypes
@ratios
def test_kernel_of_a_larger_constraint_is_kept(ratio, dtype):
    # (3.2): ker B inside ker A, that is A = gamma B, gives A P = A.
    s = Systems(6, 3, ratio, dtype)
    w, length = s.white_rows(s.constraint)
    gamma = np.random.default_rng(1).standard_normal((BATCH, 2, 3))
    a = gamma @ (w / length)
    assert ulps(a @ s.white_operator(s.project()) - a, dtype) < 100


@dtypes
@shapes
@ratios
def test_involution_and_isometry(n, k, ratio, dtype):
    # Theorem 4.1: R^2 = I and |R v| = |v|.
    s = Systems(n, k, ratio, dtype)
    after = s.collide(s.velocity, 1.0)
    norm = np.linalg.norm(s.white(s.velocity), axis=-1)
    assert ulps(np.linalg.norm(s.white(after), axis=-1) / norm - 1, dtype) < 40
    again = s.collide(after, 1.0)
    assert ulps(s.white(again - s.velocity) / norm[:, None], dtype) < 80


@dtypes
@shapes
@ratios
def test_restitution(n, k, ratio, dtype):
    # (6.1): B v+ = -mu B v-; the part in ker B is kept; the energy lost is (1 - mu^2) |P v-|^2 / 2.
    s = Systems(n, k, ratio, dtype)
    mu = np.asarray(s.restitution, np.float64)[:, None]
    before, after = s.white(s.velocity), s.white(s.collide(s.velocity, s.restitution))
    norm = np.linalg.norm(before, axis=-1, keepdims=True)
    w, length = s.white_rows(s.constraint)
    assert ulps(np.einsum("bkn,bn->bk", w / length, after + mu * before) / norm, dtype) < 60
    p = np.linalg.pinv(w / length) @ (w / length)
    normal = np.einsum("bij,bj->bi", p, before)
    loss = (1 - mu**2) * np.sum(normal**2, axis=-1, keepdims=True)
    energy = np.sum(after**2, axis=-1, keepdims=True)
    condition = np.linalg.cond(w / length).max()
    assert ulps((norm**2 - loss - energy) / norm**2, dtype) < 60 * condition
    assert np.all(energy <= norm**2 * (1 + 40 * np.finfo(dtype).eps))


@dtypes
@pytest.mark.parametrize("duplicate", [False, True])
def test_offset_is_a_moving_frame(duplicate, dtype):
    # With c = B w the wall moves with w: v+ - w is the impact of v - w on the wall at rest.
    s = Systems(5, 3, 1e12, dtype)
    if duplicate:
        s.constraint = jnp.concatenate([s.constraint, s.constraint], axis=1)
    wall = jnp.flip(s.velocity, axis=0)
    offset = jnp.einsum("bkn,bn->bk", s.constraint, wall, precision="highest")
    moving = s.white(s.collide(s.velocity, s.restitution, offset) - wall)
    resting = s.white(s.collide(s.velocity - wall, s.restitution))
    condition = np.linalg.cond(s.white_rows(s.constraint[:, :3])[0] / s.white_rows(s.constraint[:, :3])[1])
    size = np.linalg.norm(s.white(s.velocity), axis=-1) + np.linalg.norm(s.white(wall), axis=-1)
    assert ulps((moving - resting) / (condition * size)[:, None], dtype) < 40


@dtypes
@ratios
def test_dependent_rows_change_nothing(ratio, dtype):
    s = Systems(6, 3, ratio, dtype)
    p = s.white_operator(s.project())
    b = s.constraint
    for extra in (1e-9 * b, 1e9 * b, jnp.zeros_like(b), b[:, :1] + 0.5 * b[:, 1:2]):
        s.constraint = jnp.concatenate([b, extra], axis=1)
        condition = np.linalg.cond(s.white_rows(b)[0] / s.white_rows(b)[1])[:, None, None]
        assert ulps((s.white_operator(s.project()) - p) / condition, dtype) < 40


# The ball: v = (v_1, v_2, v_3, omega_1, omega_2, omega_3).


def ball_metric(mass, inertia):
    return jnp.diag(jnp.stack([mass] * 3 + [inertia] * 3))


def contact_rows(radius, normal):
    """v_S + omega x SC with SC = -r n, equation (1.1); shape (3, 6)."""
    x, y, z = normal
    zero = jnp.zeros_like(x)
    cross = jnp.stack([zero, -z, y, z, zero, -x, -y, x, zero]).reshape(3, 3)  # cross @ w = n x w
    return jnp.concatenate([jnp.eye(3, dtype=x.dtype), radius * cross], axis=1)


class BallCase:
    """Section 5.2: one ball and many velocities of comparable energy in every component."""

    def __init__(self, inertia, radius, dtype, mass=0.7):
        self.dtype = dtype
        self.m, self.r, self.J = (jnp.asarray(x, dtype) for x in (mass, radius, inertia * mass))
        self.metric = ball_metric(self.m, self.J)
        self.up = jnp.asarray([0.0, 0.0, 1.0], dtype)
        self.constraint = contact_rows(self.r, self.up)
        self.root = np.sqrt(np.diagonal(np.asarray(self.metric, np.float64)))
        v = np.random.default_rng(2).standard_normal((BATCH, 6)) / self.root
        self.v = jnp.asarray(v, dtype)
        # The same numbers, rounded once, in extended precision for the paper's formulas.
        self.exact = [np.longdouble(x) for x in (self.m, self.r, self.J)]

    def collide(self, restitution=1.0):
        return collide_many(self.v, self.metric, self.constraint, jnp.asarray(restitution, self.dtype))

    def ulps(self, got, want):
        norm = np.linalg.norm(self.root * np.asarray(self.v, np.float64), axis=-1, keepdims=True)
        return ulps(self.root * (np.asarray(got, np.longdouble) - want) / norm, self.dtype)


@dtypes
@balls
def test_theorem_5_2(inertia, radius, dtype):
    case = BallCase(inertia, radius, dtype)
    m, r, J = case.exact
    Jp = J + r**2 * m
    v1, v2, v3, w1, w2, w3 = np.asarray(case.v, np.longdouble).T
    want = [
        (m * r**2 - J) / Jp * v1 + 2 * J * r / Jp * w2,
        (m * r**2 - J) / Jp * v2 - 2 * J * r / Jp * w1,
        -v3,
        -2 * r * m / Jp * v2 + (J - m * r**2) / Jp * w1,
        2 * r * m / Jp * v1 + (J - m * r**2) / Jp * w2,
        w3,
    ]
    assert case.ulps(case.collide(), np.stack(want, -1)) < 10


@dtypes
@balls
@pytest.mark.parametrize("mu", [0.0, 0.3, 0.9])
def test_section_6(inertia, radius, mu, dtype):
    case = BallCase(inertia, radius, dtype)
    m, r, J = case.exact
    e = np.longdouble(dtype(mu))
    Jp = J + r**2 * m
    v1, v2, v3, w1, w2, w3 = np.asarray(case.v, np.longdouble).T
    want = [
        (m * r**2 - e * J) / Jp * v1 + J * r * (1 + e) / Jp * w2,
        (m * r**2 - e * J) / Jp * v2 - J * r * (1 + e) / Jp * w1,
        -e * v3,
        -r * m * (1 + e) / Jp * v2 + (J - e * m * r**2) / Jp * w1,
        r * m * (1 + e) / Jp * v1 + (J - e * m * r**2) / Jp * w2,
        w3,
    ]
    assert case.ulps(case.collide(mu), np.stack(want, -1)) < 10


@dtypes
@balls
def test_momentum_about_contact_is_conserved(inertia, radius, dtype):
    # m CS x v + J omega, CS = (0, 0, r), for every mu; relative to what |v| allows.
    case = BallCase(inertia, radius, dtype)
    m, r, J = (float(x) for x in case.exact)

    def momentum(v):
        v = np.asarray(v, np.float64)
        return m * np.cross([0, 0, r], v[:, :3]) + J * v[:, 3:]

    norm = np.linalg.norm(case.root * np.asarray(case.v, np.float64), axis=-1, keepdims=True)
    for mu in (0.0, 0.5, 1.0):
        change = momentum(case.collide(mu)) - momentum(case.v)
        assert ulps(change / (norm * np.hypot(r * np.sqrt(m), np.sqrt(J))), dtype) < 10


@dtypes
@balls
def test_projector_of_the_ball_to_the_last_digits(inertia, radius, dtype):
    # (3.1) in 60 digits, which no cancellation reaches.
    case = BallCase(inertia, radius, dtype)
    p = np.asarray(project_one(case.metric, case.constraint), np.float64)
    with mpmath.workdps(60):
        g = mpmath.matrix(np.asarray(case.metric, np.float64).tolist())
        b = mpmath.matrix(np.asarray(case.constraint, np.float64).tolist())
        gbt = g**-1 * b.T
        exact = np.array((gbt * (b * gbt) ** -1 * b).tolist(), dtype=np.float64)
    assert ulps(case.root[:, None] * (p - exact) / case.root[None, :], dtype) < 8
    p = case.root[:, None] * p / case.root[None, :]
    assert ulps(p @ p - p, dtype) < 8


@dtypes
def test_pendulum_5_2_1(dtype):
    m, r, J, v, u, g = 0.3, 0.05, 4e-4, 1.3, 2.1, 9.81
    case = BallCase(J / m, r, dtype, mass=m)
    before = jnp.asarray([-v, 0, -u, 0, r * m * v / J, 0], dtype)
    tol = 10 * np.finfo(dtype).eps * np.asarray([v, v, v, r * m * v / J] * 2)[[0, 1, 2, 3, 3, 3]]
    first = collide(before, case.metric, case.constraint)
    assert np.all(np.abs(first + before) < tol)  # v_S+ = -v_S-, omega+ = -omega-
    # Along the parabola the vertical velocity changes sign; the second impact is the first one reversed.
    landing = first.at[2].set(-first[2])
    second = collide(landing, case.metric, case.constraint)
    assert np.all(np.abs(second - before.at[2].set(u)) < 2 * tol)
    # Both flights last 2 u / g: the ball is back at its first contact point.
    displacement = (first[:2] + second[:2]) * (2 * u / g)
    assert np.all(np.abs(displacement) < 2 * tol[:2])


@dtypes
@pytest.mark.parametrize("inertia, radius", BALLS)
def test_theorem_5_1(inertia, radius, dtype):
    # The rolling ball meets the wall; the paper's own A and B in v = (v_1, v_2, omega_1, omega_2, omega_3).
    m, r, J = (dtype(x) for x in (0.7, radius, inertia * 0.7))
    rng = np.random.default_rng(3)
    metric = jnp.diag(jnp.asarray([m, m, J, J, J]))
    a = jnp.asarray([[1, 0, 0, -r, 0], [0, 1, r, 0, 0]], dtype)
    b = jnp.asarray([[1, 0, 0, 0, 0], [0, 1, 0, 0, -r], [0, 0, 0, 1, 0], [0, 1, r, 0, 0]], dtype)
    root = np.sqrt(np.asarray([m, m, J, J, J], np.float64))
    w1, w2, w3 = rng.standard_normal((3, BATCH)) / np.maximum(root[2], np.float64(r) * root[0])
    w3 = w3 * np.maximum(1, np.float64(r) * root[0] / root[2])
    v = np.stack([w2 * r, -w1 * r, w1, w2, w3], -1)  # (5.1)
    got = np.asarray(collide_many(jnp.asarray(v, dtype), metric, b, 1.0), np.longdouble)
    m, r, J = (np.longdouble(x) for x in (m, r, J))
    Jp, Jt = J + r**2 * m, J + r**2 * m / 2
    v1, v2, _, _, w3 = np.asarray(jnp.asarray(v, dtype), np.longdouble).T
    v1, v2, w3 = (
        -v1,
        r**2 * m / (2 * Jt) * v2 + r * J / Jt * w3,
        Jp / (r * Jt) * v2 - r**2 * m / (2 * Jt) * w3,
    )
    want = np.stack([v1, v2, -v2 / r, v1 / r, w3], -1)
    norm = np.linalg.norm(root * v, axis=-1, keepdims=True)
    assert ulps(root * (got - want) / norm, dtype) < 20
    p = np.asarray(project_one(metric, b), np.float64)
    white_a = np.asarray(a, np.float64) / root
    white_p = root[:, None] * p / root[None, :]
    length = np.linalg.norm(white_a, axis=1, keepdims=True)
    assert ulps((white_a @ white_p - white_a) / length, dtype) < 20


def corner(m, r, J, turn):
    """Floor and wall at once, both turned by the rotation `turn`: six rows of rank five.

    At extreme inertia ratios the rows are nearly all translation or nearly all rotation, equal to rounding
    except for the rest, on which the impact depends.
    """
    rows = [contact_rows(r, n) for n in (turn[:, 2], turn[:, 0])]
    return ball_metric(m, J), jnp.concatenate(rows)


@dtypes
@balls
def test_corner_of_rank_five(inertia, radius, dtype):
    m, r, J = (jnp.asarray(x, dtype) for x in (0.7, radius, inertia * 0.7))
    for seed in range(8):
        turn = np.linalg.qr(np.random.default_rng(seed).standard_normal((3, 3)))[0]
        turn = turn * np.linalg.det(turn)
        metric, b = corner(m, r, J, jnp.asarray(turn, dtype))
        # Both contacts at rest: the ball turns about the line through them.
        turn = np.asarray(jnp.asarray(turn, dtype), np.float64)
        axis, lever = turn[:, 0] - turn[:, 2], -np.float64(r) * turn[:, 2]
        root = np.sqrt(np.diagonal(np.asarray(metric, np.float64)))
        kernel = root * np.concatenate([-np.cross(axis, lever), axis])
        want = np.eye(6) - np.outer(kernel, kernel) / (kernel @ kernel)
        p = root[:, None] * np.asarray(project_one(metric, b), np.float64) / root[None, :]
        assert ulps(p - want, dtype) < 40
        assert ulps(p @ p - p, dtype) < 20


# Derivatives.


def of_ball(m, r, J, v, mu):
    # The three singular values of the whitened B are equal.
    up = jnp.asarray([0.0, 0.0, 1.0], v.dtype)
    return collide(v, ball_metric(m, J), contact_rows(r, up), mu)


def of_corner(m, r, J, v, mu):
    metric, b = corner(m, r, J, jnp.eye(3, dtype=v.dtype))
    return collide(v, metric, b, mu, _dot(b, v[::-1])), projector(metric, b)


def of_duplicate_rows(m, r, J, v, mu):
    corr = jnp.eye(6, dtype=v.dtype) + 0.1 * jnp.outer(v, v)
    b = contact_rows(r, v[3:] / m)
    b = jnp.concatenate([b, J * b, jnp.zeros_like(b)])
    return collide(v, corr, b, mu), projector(corr, b)


def of_everything(m, r, J, v, mu):
    factor = jnp.diag(jnp.stack([m, r, J])) + 0.3 * jnp.outer(v[:3], v[3:])
    metric, b = factor @ factor.T + jnp.eye(3, dtype=v.dtype), jnp.stack([v[:3], v[3:]])
    return collide(v[1:4], metric, b, mu, v[:2]), projector(metric, b)


def _dot(a, b):
    return jnp.matmul(a, b, precision="highest")


jacobian_of_ball = jax.jit(jax.jacrev(of_ball, argnums=(0, 1, 2, 3, 4)))


def arguments(dtype):
    v = jnp.asarray([0.3, -1.2, -2.0, 0.7, 0.4, -0.9], dtype)
    return (*(jnp.asarray(x, dtype) for x in (0.7, 0.8, 0.5)), v, jnp.asarray(0.6, dtype))


functions = pytest.mark.parametrize("f", [of_ball, of_corner, of_duplicate_rows, of_everything])


@functions
def test_derivatives_against_differences(f):
    # Forward against central differences, reverse against forward, and the same of the first derivatives.
    check_grads(jax.jit(f), arguments(np.float64), order=2, modes=("fwd", "rev"), atol=1e-6, rtol=1e-6, eps=1e-5)


@functions
def test_forward_and_reverse_agree_in_both_dtypes(f):
    double = jax.jit(jax.jacfwd(f, argnums=(0, 1, 2, 3, 4)))(*arguments(np.float64))
    size = max(float(jnp.max(jnp.abs(x))) for x in jax.tree.leaves(double))
    for dtype in (np.float32, np.float64):
        for jacobian in (jax.jacfwd, jax.jacrev):
            got = jax.jit(jacobian(f, argnums=(0, 1, 2, 3, 4)))(*arguments(dtype))
            error = jax.tree.map(lambda a, b: np.asarray(a, np.float64) - np.asarray(b), got, double)
            assert all(x.dtype == dtype for x in jax.tree.leaves(got))
            assert max(ulps(x / size, dtype) for x in jax.tree.leaves(error)) < 60


@dtypes
@balls
def test_gradients_at_extremes_are_finite(inertia, radius, dtype):
    case = BallCase(inertia, radius, dtype)
    args = (case.m, case.r, case.J, case.v[0], jnp.asarray(0.5, dtype))
    leaves = jax.tree.leaves(jacobian_of_ball(*args))
    assert all(bool(jnp.all(jnp.isfinite(x))) for x in leaves)


# Arguments.


@dtypes
def test_not_a_metric_gives_nan(dtype):
    eye, row = jnp.eye(2, dtype=dtype), jnp.ones((1, 2), dtype)
    for metric, b in ((-eye, row), (eye * jnp.nan, row), (eye, row * jnp.nan)):
        assert np.all(np.isnan(collide(jnp.ones(2, dtype), metric, b)))


@dtypes
def test_no_rows_and_zero_rows(dtype):
    eye, v = jnp.eye(3, dtype=dtype), jnp.arange(3, dtype=dtype)
    for k in (0, 4):
        b = jnp.zeros((k, 3), dtype)
        assert np.all(projector(eye, b) == 0)
        assert np.all(collide(v, eye, b, offset=jnp.zeros(k, dtype)) == v)


@pytest.mark.parametrize(
    "name, shapes",
    [
        ("metric", ((3,), (3, 4), (2, 3))),
        ("constraint", ((3,), (3, 3), (3,))),
        ("constraint", ((3,), (3, 3), (2, 4))),
        ("velocity", ((2,), (3, 3), (2, 3))),
        ("offset", ((3,), (3, 3), (2, 3))),
    ],
)
def test_wrong_shapes(name, shapes):
    unchecked = inspect.unwrap(collide)  # without the tests' own type checks, as users have it
    with pytest.raises(ValueError, match=rf"^Argument `{name}` must .*, but got .*; try "):
        unchecked(*(jnp.ones(shape) for shape in shapes), 1.0, jnp.ones(5))


@pytest.mark.parametrize("function", [projector, collide])
def test_docstring_example(function):
    (example,) = re.findall(r"```python\n(.*?)```", inspect.getdoc(function), re.DOTALL)
    exec(inspect.cleandoc(example), {})
