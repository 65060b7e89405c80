"""The metric-orthogonal projector of Lemma 1 and the collision laws (4.2) and (6.1), in any dimension.

Everything is done in whitened coordinates y = L^T v, where G = L L^T. There the metric is the identity, and
the projector is V V^T, the columns of V an orthonormal basis of the rows of W = B L^-T. No inverse is formed.
"""

import jax
import jax.lax as lax
import jax.numpy as jnp
import jax.scipy as jsp
from jax.typing import ArrayLike
from jaxtyping import Array, Float


def matmul(a: Array, b: Array) -> Array:
    # Accelerators multiply float32 matrices in lower precision unless told otherwise.
    return jnp.matmul(a, b, precision=lax.Precision.HIGHEST)


def divisor(x: Array) -> Array:
    """A divisor: zeros become ones."""
    return jnp.where(x == 0, jnp.ones_like(x), x)


def _tolerance(x: Array) -> float:
    """What counts as zero, relative to what it was computed from."""
    return 10 * max(x.shape) * float(jnp.finfo(x.dtype).eps)


@jax.custom_jvp
def pseudo_inverse(w: Float[Array, "k n"]) -> tuple[Float[Array, "n k"], Float[Array, "n n"]]:
    """The pseudo-inverse of `w` and the orthogonal projector onto the span of its rows."""
    u, s, vt = jnp.linalg.svd(w, full_matrices=False)
    cutoff = _tolerance(w) * jnp.max(s, initial=0)
    drop = s <= cutoff  # False for NaN, which must come out again
    vt = jnp.where(drop[:, None], jnp.zeros_like(vt), vt)
    s = jnp.where(drop, jnp.ones_like(s), s)
    return matmul(vt.T / s[None, :], u.T), matmul(vt.T, vt)


@pseudo_inverse.defjvp
def _pseudo_inverse_jvp(primals, tangents):
    # The derivative of the SVD divides by differences of singular values; the ball's own B has equal ones.
    # That of Golub and Pereyra (1973) has no such divisor and holds wherever the rank does not change.
    (w,), (dw,) = primals, tangents
    w_plus, pi = pseudo_inverse(w)
    turn = matmul(dw.T - matmul(pi, dw.T), w_plus.T)  # (I - Pi) dW^T (W^+)^T
    left = dw.T - matmul(matmul(dw.T, w), w_plus)  # dW^T (I - W W^+), zero if W has full row rank
    dw_plus = matmul(turn, w_plus) + matmul(w_plus, matmul(w_plus.T, left)) - matmul(matmul(w_plus, dw), w_plus)
    return (w_plus, pi), (dw_plus, turn + turn.T)


def _reduce(b: Array) -> tuple[Array, Array]:
    """(R, R b) with R invertible: Gaussian elimination, complete pivoting; what cancels to rounding is zero.

    Rows may differ only in components of little inertia. There lie the digits that an SVD of `b` would lose.
    """
    k, n = b.shape
    combination, size, free = jnp.eye(k, dtype=b.dtype), jnp.abs(b), jnp.ones(k, bool)
    for _ in range(min(k - 1, n)):
        i, j = jnp.unravel_index(jnp.argmax(jnp.where(free[:, None], jnp.abs(b), 0)), b.shape)
        free = free.at[i].set(False)
        factor = jnp.where(free, b[:, j] / divisor(b[i, j]), 0)[:, None]
        size = size + jnp.abs(factor) * size[i][None, :]
        b = b - factor * b[i][None, :]
        b = jnp.where(jnp.abs(b) <= _tolerance(b) * size, jnp.zeros_like(b), b)
        combination = combination - factor * combination[i][None, :]
    return combination, b


def _unit_rows(w: Array) -> tuple[Array, Array]:
    """The rows of `w` at unit length, zero rows as they are, and the factors, shape (k, 1)."""
    w_fixed = lax.stop_gradient(w)
    largest = divisor(jnp.max(jnp.abs(w_fixed), axis=1, initial=0))[:, None]  # its squares may overflow
    norm = divisor(jnp.sqrt(jnp.sum((w_fixed / largest) ** 2, axis=1)))[:, None]
    return w / largest / norm, 1 / largest / norm


def whiten(metric: Array, constraint: Array, thorough: bool = True) -> tuple[Array, Array, Array, Array]:
    """(scale, factor, w, rows): G = L L^T, L = diag(scale) factor; w = rows B L^-T has unit rows. What is not
    `thorough` is cheaper, and loses digits where rows differ only in components of little inertia."""
    # Nothing that is computed depends on `scale` or on `rows`, so neither needs a derivative.
    scale = lax.stop_gradient(jnp.sqrt(jnp.diagonal(metric)))
    factor = jnp.linalg.cholesky(metric / scale[:, None] / scale[None, :])
    w, first = _unit_rows(constraint / scale[None, :])
    rows = jnp.eye(w.shape[0], dtype=w.dtype)
    if thorough:
        rows, reduced = _reduce(lax.stop_gradient(w))
        w = reduced + matmul(rows, w - lax.stop_gradient(w))  # the value of `reduced`, the derivative of rows w
    w, last = _unit_rows(jsp.linalg.solve_triangular(factor, w.T, lower=True).T)
    return scale, factor, w, last * rows * first.T


def _check(metric: Array, constraint: Array) -> None:
    if metric.ndim != 2 or metric.shape[0] != metric.shape[1]:
        raise ValueError(
            "Argument `metric` must be a square matrix of shape (n, n), but got shape "
            f"{metric.shape}; try `jax.vmap` for a batch and `jnp.diag` for a diagonal metric."
        )
    if constraint.ndim != 2 or constraint.shape[1] != metric.shape[0]:
        raise ValueError(
            f"Argument `constraint` must have shape (k, {metric.shape[0]}) to match `metric`, but got shape "
            f"{constraint.shape}; try `constraint[None, :]` for one row and `jax.vmap` for a batch."
        )


def projector(metric: Float[Array, "n n"], constraint: Float[Array, "k n"]) -> Float[Array, "n n"]:
    """The projector onto the complement of ker B that is orthogonal in the metric G.

    P = G^-1 B^T (B G^-1 B^T)^+ B, so that P P = P, G P is symmetric, B P = B and P v = 0 for v in ker B.

    **Arguments:**

    - `metric`: G, shape (n, n), symmetric positive definite, of any scaling: masses in kg next to moments of
        inertia in kg m^2. The result is NaN where it is not positive definite.
    - `constraint`: B, shape (k, n), of any rank and any units per row; zero and dependent rows are allowed.

    **Returns:**

    P, shape (n, n); its entry (i, j) has the unit of velocity i over velocity j. Derivatives of any order and
    both modes are right for changes that keep the rank of B.

    **Raises:**

    `ValueError` if the shapes do not match.

    **Source:** Treschev and Zubelevich, Lemma 1, (3.1); the derivative, Golub and Pereyra (1973).

    !!! example

        ```python
        import jax.numpy as jnp
        from nonholo_jax import projector

        G = jnp.diag(jnp.array([2.0, 2.0, 0.8]))  # a disc: v_x, v_y, spin
        B = jnp.array([[1.0, 0.0, -1.0], [0.0, 1.0, 0.0]])  # it neither slips nor lifts
        P = projector(G, B)
        assert jnp.allclose(P @ P, P, atol=1e-6)
        ```
    """
    _check(metric, constraint)
    scale, factor, w, _ = whiten(metric, constraint)
    _, pi = pseudo_inverse(w)
    p = jsp.linalg.solve_triangular(factor, matmul(pi, factor.T), trans="T", lower=True)
    return p / scale[:, None] * scale[None, :]


def collide(
    velocity: Float[Array, " n"],
    metric: Float[Array, "n n"],
    constraint: Float[Array, "k n"],
    restitution: ArrayLike = 1.0,
    offset: Float[Array, " k"] | None = None,
) -> Float[Array, " n"]:
    """The velocity after an impact: its part orthogonal to ker B is reversed and multiplied by mu.

    v+ = v - (1 + mu) G^-1 B^T (B G^-1 B^T)^+ (B v - c), so that B v+ - c = -mu (B v - c), and with mu = 1 and
    c = 0 the kinetic energy v^T G v / 2 is conserved and a second impact undoes the first.

    **Arguments:**

    - `velocity`: v, shape (n,), in the units that go with `metric`.
    - `metric`: G, shape (n, n), symmetric positive definite; the result is NaN where it is not.
    - `constraint`: B, shape (k, n), of any rank; ker B is the distribution of the wall.
    - `restitution`: mu, a number in [0, 1]: 0 is plastic, 1 conserves the energy.
    - `offset`: c, shape (k,), the unit of B v: a moving wall asks for B v = c. It must be in the range of B.
        `None` is zero.

    **Returns:**

    v+, shape (n,). Derivatives are right for changes that keep the rank of B.

    **Raises:**

    `ValueError` if the shapes do not match.

    **Source:** Treschev and Zubelevich, Theorem 4.1, (4.2), and section 6, (6.1).

    !!! example

        ```python
        import jax.numpy as jnp
        from nonholo_jax import collide

        G = jnp.diag(jnp.array([2.0, 2.0, 0.8]))  # a disc: v_x, v_y, spin
        B = jnp.array([[1.0, 0.0, -1.0], [0.0, 1.0, 0.0]])  # rough floor: no velocity at the contact
        v = collide(jnp.array([1.0, -3.0, 0.0]), G, B)
        assert jnp.allclose(v, jnp.array([3 / 7, 3.0, 10 / 7]))
        ```
    """
    _check(metric, constraint)
    if velocity.shape != metric.shape[:1]:
        raise ValueError(
            f"Argument `velocity` must have shape {metric.shape[:1]} to match `metric`, but got shape "
            f"{velocity.shape}; try `jax.vmap` for a batch."
        )
    if offset is not None and offset.shape != constraint.shape[:1]:
        raise ValueError(
            f"Argument `offset` must have shape {constraint.shape[:1]} to match `constraint`, but got shape "
            f"{offset.shape}; try one number for each row."
        )
    scale, factor, w, rows = whiten(metric, constraint)
    w_plus, pi = pseudo_inverse(w)
    y = matmul(pi, matmul(factor.T, scale * velocity))
    if offset is not None:
        y = y - matmul(w_plus, matmul(rows, offset))
    change = jsp.linalg.solve_triangular(factor, y, trans="T", lower=True) / scale
    return velocity - (1 + jnp.asarray(restitution, velocity.dtype)) * change


def accelerate(metric: Array, constraint: Array, force: Array, rate: Array) -> Array:
    """The a with A a = rate and G a = force + A^T lambda for some lambda: Lagrange-d'Alembert's equations, solved in
    whitened coordinates by projection. A, shape (m, n), may have any rank; `rate` must be in its range."""
    if constraint.shape[0] == 0:
        scale = lax.stop_gradient(jnp.sqrt(jnp.diagonal(metric)))
        factor = jnp.linalg.cholesky(metric / scale[:, None] / scale[None, :])
        return jsp.linalg.cho_solve((factor, True), force / scale) / scale
    scale, factor, w, rows = whiten(metric, constraint, thorough=False)
    w_plus, pi = pseudo_inverse(w)
    y = jsp.linalg.solve_triangular(factor, force / scale, lower=True)
    y = y - matmul(pi, y) + matmul(w_plus, matmul(rows, rate))
    return jsp.linalg.solve_triangular(factor, y, trans="T", lower=True) / scale


def settle(velocity: Array, metric: Array, constraint: Array, offset: Array) -> Array:
    """The velocity with A v = b nearest to one that nearly is so: only the excess is projected, so that what is right
    stays as it is."""
    scale, factor, w, rows = whiten(metric, constraint, thorough=False)
    y = matmul(pseudo_inverse(w)[0], matmul(rows, matmul(constraint, velocity) - offset))
    return velocity - jsp.linalg.solve_triangular(factor, y, trans="T", lower=True) / scale
