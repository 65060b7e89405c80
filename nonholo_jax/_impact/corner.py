"""A ball that hits several surfaces at one instant: their constraints in one B, which may be rank-deficient (4.2)."""

from typing import Any

import jax.numpy as jnp
from jax import lax

from .._math import Number, Vector3, components, is_constant, root
from .law import AbstractContactLaw
from .projector import matmul


def is_one_mu(law: AbstractContactLaw) -> bool:
    """Whether a law is the paper's: one mu multiplies all that the wall constrains."""
    e_n, e_t = law.restitution, law.reversal()
    same = e_t is e_n or (is_constant(e_n) and is_constant(e_t) and bool(e_n == e_t))
    rough = law.rolls is True and law.sliding_friction() is None
    return law.rolls is False or (rough and same)


def rows_of(law: AbstractContactLaw, normal: Vector3, hit: Any, dtype: Any) -> Any:
    """B on (velocity, radius times spin), which is what the contact point must not do: move, or move inwards. Zeros for
    a surface that is not hit."""
    n = jnp.stack([jnp.asarray(c, dtype=dtype) for c in normal])
    if law.rolls:
        turn = jnp.cross(n[None], jnp.eye(3, dtype=n.dtype)).T  # v - r omega x n = v + n x (r omega)
        rows = jnp.concatenate([jnp.eye(3, dtype=n.dtype), turn], axis=1)
    else:
        rows = jnp.concatenate([n, jnp.zeros_like(n)])[None]
    return jnp.where(hit, rows, jnp.zeros_like(rows))


def collide_with_all(
    radius: Number,
    inertia_ratio: Number,
    rows: Any,
    restitution: Number,
    velocity: Vector3,
    spin: Vector3,
) -> tuple[Vector3, Vector3]:
    """Velocity and spin after an impact on all surfaces whose `rows` are stacked, shape (k, 6), by their projector."""
    like = jnp.stack([jnp.asarray(x) for x in velocity])
    weight = jnp.asarray(inertia_ratio, dtype=like.dtype) ** 0.5
    stretch = jnp.concatenate([jnp.ones(3, like.dtype), jnp.full(3, weight)])  # the metric becomes the identity
    turn = radius * jnp.stack([jnp.asarray(w, dtype=like.dtype) for w in spin])
    y = stretch * jnp.concatenate([like, turn])
    basis = _orthonormal(rows / stretch[None])
    after = (y - (1.0 + restitution) * matmul(matmul(basis, y), basis)) / stretch
    return components(after[:3]), components(after[3:] / radius)  # pyright: ignore[reportReturnType]


def _orthonormal(rows: Any) -> Any:
    """An orthonormal basis of the span of rows in six dimensions, filled up with zeros, by Gram and Schmidt, twice. The
    same projector as by `projector`, for few rows of one scale: a tenth of its program."""
    tolerance = 1e3 * float(jnp.finfo(rows.dtype).eps)

    def one(carry, row):
        basis, count = carry
        size = root(matmul(row, row))
        row = row / jnp.where(size > 0, size, 1.0)
        rest = row - matmul(matmul(basis, row), basis)
        rest = rest - matmul(matmul(basis, rest), basis)
        left = root(matmul(rest, rest))
        new = jnp.asarray(left > tolerance)
        rest = jnp.where(new, rest / jnp.where(new, left, 1.0), 0.0)
        return (basis.at[count].add(rest, mode="drop"), count + new.astype(jnp.int32)), None

    start = (jnp.zeros((6, 6), rows.dtype), jnp.asarray(0, dtype=jnp.int32))
    return lax.scan(one, start, rows)[0][0]
