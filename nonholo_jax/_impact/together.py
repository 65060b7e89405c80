"""A ball that touches several surfaces at one instant: which of them take part in the impact, and what it does.

Which. Let v0 be the velocity of the centre that is nearest to v among those that close on nothing touched (Moreau's
projection). The surfaces that it loads take part; and the support of a ball that rolls or slides, if n . v0 = 0 there.

What. In the coordinates y = (v, sqrt(alpha) r omega), in which the metric is the identity, let P_n project on the
normals of the set and P on all that its contact points may not do. If all have one law, y+ = y - (1 + e_n) P_n y -
(1 + e_t) (P - P_n) y, which is (4.2) for e_n = e_t. If not, every normal velocity is reversed by its own e_n, and the
shortest impulse that stops all slips goes to each surface as far as its law goes (`_kicks`). A support is the paper's
A: all of this happens within its kernel, and it takes what it has to, up to its friction. In a groove both sides are
supports.
"""

import functools
import itertools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from .._math import Number, Vector3, components, root
from .projector import matmul


class Touched(NamedTuple):
    """Surfaces side by side, with an axis of K in front, and S supports."""

    normals: Any  # (K, 3)
    takes_part: Any  # whether it is touched, or, for an impact, whether it takes part
    is_support: Any  # (S, K): which of the surfaces each support is, or none
    restitution: Any


def loaded(touched: Touched, velocity: Any) -> tuple[Any, Any]:
    """Which of the surfaces Moreau's projection of a velocity, shape (3,), loads, and that projection. All ways to load
    one to three surfaces are tried: which of them are right depends on no order, and where several are, the load can be
    shared, and all that share it count."""
    normals, present, count = touched.normals, touched.takes_part, touched.normals.shape[0]
    eps = float(jnp.finfo(velocity.dtype).eps)
    ways = [way for size in (1, 2, 3) for way in itertools.combinations(range(count), size)]
    picked = np.array([[i in way for i in range(count)] for way in ways])
    slots = np.array([[[i == j for i in range(count)] for j in (*way, *[count] * (3 - len(way)))] for way in ways])
    closing, speed = -matmul(normals, velocity), jnp.sqrt(jnp.sum(velocity * velocity))

    def one(picked: Any, slots: Any) -> tuple:
        """The loads of one way, the velocity after them, and by which part they are wrong."""
        rows = matmul(slots, normals)  # (3, 3), zeros where fewer are loaded
        fill = jnp.diag(1.0 - jnp.sum(slots, axis=1))
        a, b, c = matmul(rows, rows.T) + fill
        adjugate = jnp.stack([jnp.cross(b, c), jnp.cross(c, a), jnp.cross(a, b)])
        size = matmul(a, adjugate[0])
        possible = (size > 64.0 * eps) & jnp.all(present | ~picked)
        load, after = jnp.zeros(3, velocity.dtype), velocity
        for _ in range(2):  # once more for what rounding has left
            load = load - matmul(matmul(rows, after), adjugate) / jnp.where(possible, size, 1.0)
            after = velocity + matmul(load, rows)
        each, into = matmul(load, slots), jnp.where(present, -matmul(normals, after), 0.0)
        wrong = jnp.max(jnp.maximum(into, -each)) / (speed + jnp.sum(abs(load)) + float(jnp.finfo(speed.dtype).tiny))
        return each, after, jnp.where(possible, wrong, jnp.inf)

    each, after, violation = jax.vmap(one)(picked, slots.astype(velocity.dtype))
    best = jnp.argmin(violation)
    shares = violation <= jnp.maximum(64.0 * eps, violation[best])
    counts = jnp.any(shares[:, None] & (each > 64.0 * eps * speed), axis=0)
    # What closes by rounding alone is loaded by nothing but that; an impact is of it all the same.
    counts = jnp.where(jnp.any(counts), counts, jnp.any(shares[:, None] & (each > 0), axis=0))
    closes = jnp.any(present & (closing > 0))
    return closes & counts, jnp.where(closes, after[best], velocity)


def takes_part(touched: Touched, velocity: Any) -> tuple[Any, Any]:
    """Which of the touched surfaces take part in an impact, and which of the supports do, shape (S,)."""
    counts, nearest = loaded(touched, velocity)
    if not len(touched.is_support):
        return counts, jnp.zeros((0,), bool)
    eps = float(jnp.finfo(velocity.dtype).eps)
    size = jnp.sqrt(jnp.sum(velocity * velocity))
    stays = touched.is_support & (abs(matmul(touched.normals, nearest)) <= 64.0 * eps * size)[None]
    return counts | jnp.any(stays, axis=0), jnp.any(stays, axis=1)


def across_supports(touched: Touched) -> Any:
    """The normals of the supports, shape (S, 3), zero where there is none."""
    return jnp.sum(jnp.where(touched.is_support[:, :, None], touched.normals[None], 0.0), axis=1)


def without(rows: Any, x: Any) -> Any:
    """What is left of x beside the rows, which are of unit length or zero."""
    if not len(rows):
        return x
    return x - matmul(matmul(x, rows.T if rows.shape[0] == 1 else _pseudo_inverse(rows)), rows)


def reflected(
    radius: Number,
    inertia_ratio: Number,
    touched: Touched,
    slip_factors: Callable,
    friction: tuple[Number, ...] | None,
    grips: tuple[Any, ...],
    velocity: Vector3,
    spin: Vector3,
    levels: tuple[float, ...] | None = None,
) -> tuple[Vector3, Vector3]:
    """Velocity and spin after an impact on all surfaces that take part.

    **Arguments:** `slip_factors(closing, slip_squared)` gives the factors s of all laws, as a single impact has them;
    `friction` is that of each support, or `None` where `grips` says all: it holds the ball (1) or is smooth (0);
    `levels` are the factors of all laws in units of what stops a slip, from the largest to the smallest and without
    zero, if they are known and at least a hundredth apart.
    """
    y, stretch = _whitened(radius, inertia_ratio, velocity, spin)
    share = jnp.asarray(inertia_ratio / (1.0 + inertia_ratio), y.dtype)
    set_ = _Set(*_rows(touched.normals, stretch[3]), touched, slip_factors, share, levels)
    holds = _row(grips, y.dtype)
    if friction is None:
        after = _within(set_, y, holds, False)[0]
    else:
        limits = _row(friction, y.dtype)
        ends = jnp.where(jnp.isinf(limits)[None], holds[None], jnp.arange(2.0, dtype=y.dtype)[:, None])
        (free, gripping), (lighter, heavier), (_, needed) = jax.vmap(lambda grip: _within(set_, y, grip, True))(ends)
        parts = [_held(*each) for each in zip(limits, lighter, heavier, needed * root(share), strict=True)]
        after = free + functools.reduce(jnp.minimum, parts) * (gripping - free)
    after = after / stretch
    return components(after[:3]), components(after[3:] / radius)  # pyright: ignore[reportReturnType]


def _row(numbers: tuple, dtype: Any) -> Any:
    array = [jnp.asarray(each).astype(dtype)[None] for each in numbers]
    return jnp.concatenate(array) if array else jnp.zeros((0,), dtype)


def _held(friction: Any, lighter: Any, heavier: Any, needed: Any) -> Any:
    """How far friction goes towards holding a ball on a support: its pressure there goes from `lighter`, without
    friction, to `heavier`, where it is enough for what is `needed`. All the way where friction is infinite; not at all
    where it is not enough and the ball would be pulled in, which is no pressure."""
    coefficient, lighter = jnp.where(jnp.isinf(friction), 0.0, friction), jnp.maximum(lighter, 0.0)
    slips = needed > coefficient * heavier
    rest = needed - coefficient * (heavier - lighter)
    part = jnp.where(slips, coefficient * lighter / jnp.where(slips, rest, 1.0), 1.0)
    return jnp.where(jnp.isinf(friction), 1.0, part)


class _Set(NamedTuple):
    normals: Any  # (K, 6)
    tangents: Any  # (K, 2, 6), of unit length
    touched: Touched
    slip_factors: Callable
    share: Any
    levels: tuple | None


def _whitened(radius: Number, inertia_ratio: Number, velocity: Vector3, spin: Vector3) -> tuple[Any, Any]:
    v = jnp.stack([jnp.asarray(x) for x in velocity])
    turn = radius * jnp.stack([jnp.asarray(w, dtype=v.dtype) for w in spin])
    weight = root(jnp.asarray(inertia_ratio, dtype=v.dtype))
    stretch = jnp.concatenate([jnp.ones(3, v.dtype), jnp.full(3, 1.0, v.dtype) * weight])
    return stretch * jnp.concatenate([v, turn]), stretch


def _rows(normals: Any, weight: Any) -> tuple[Any, Any]:
    """The normal velocity and two components of the slip of every surface, as unit rows on y."""
    x, y, z = (normals[:, i] for i in range(3))
    sign = jnp.where(z >= 0, 1.0, -1.0)
    a = -1.0 / (sign + z)  # two tangents without a singular direction: Duff et al., J. Comput. Graph. Tech. 6(1), 2017
    first = jnp.stack([1.0 + sign * x * x * a, sign * x * y * a, -sign * x], axis=-1)
    second = jnp.cross(normals, first)
    tangents = jnp.stack([first, second], axis=1)
    turned = -jnp.stack([second, -first], axis=1) / weight
    rows = jnp.concatenate([tangents, turned], axis=-1) / root(1.0 + 1.0 / (weight * weight))
    return jnp.concatenate([normals, jnp.zeros_like(normals)], axis=-1), rows


def _within(set_: _Set, y: Any, grip: Any, measures: bool) -> tuple[Any, Any, Any]:
    """The impact of a ball that may not slip on a support (`grip`, shape (S,), is 1) or without friction there (0): y
    afterwards; and, if that is measured, the impulse that presses the ball on each support, and the one that keeps it
    from slipping there, in units of y."""
    touched, others = set_.touched, _others(set_.touched)[:, None]
    held = _held_rows(set_, grip)
    begin = held.free(y)

    normal = held.free(jnp.where(others, set_.normals, 0.0))
    inverse = _pseudo_inverse(normal)
    closing = matmul(normal, begin)
    push = matmul(inverse, (1.0 + touched.restitution) * closing)
    scale = _at_most_elastic(begin, push)
    load = -scale * matmul(inverse.T, push)

    rows = held.free(jnp.where(others[:, :, None], set_.tangents, 0.0).reshape(-1, 6))
    rows = (rows - matmul(matmul(rows, inverse), normal)).reshape(-1, 2, 6)
    kick = _kicks(set_, rows, load, begin)
    drag = jnp.sum(rows * kick[:, :, None], axis=(0, 1))
    after = begin - scale * push
    slower = _at_most_elastic(after, drag)
    after = after - slower * drag
    if not measures:
        return after, None, None
    # What others do that the supports have to withstand.
    own = set_.tangents * (slower * kick)[:, :, None]
    given = jnp.sum(jnp.where(others, -load[:, None] * set_.normals, 0.0), axis=0) + jnp.sum(own, axis=(0, 1))
    presses, keeps = held.impulses(given + after - without(held.rows[: len(grip)], y))
    return after, presses, root(_above_rounding(jnp.sum(keeps.reshape(-1, 2) ** 2, axis=1), y))


class _Rows(NamedTuple):
    """What supports do not let a ball do: S normals, and 2 S rows of the slips with what of them is along the normals.
    All are of unit length, smaller or zero."""

    rows: Any  # (3 S, 6): the normals, and what of the slips is beside them
    inverse: Any  # the pseudo-inverse: with it two sides share equally what is across their groove
    along: Any  # (2 S, 6), of the slips

    def free(self, x: Any) -> Any:
        return x - matmul(matmul(x, self.inverse), self.rows) if len(self.rows) else x

    def impulses(self, x: Any) -> tuple[Any, Any]:
        """What they take of x: across each support, and along it."""
        count = len(self.rows) // 3
        keeps = matmul(x, self.inverse[:, count:])
        return matmul(x - matmul(keeps, self.along), self.inverse[:, :count]), keeps


def _held_rows(set_: _Set, grip: Any) -> _Rows:
    held = set_.touched.takes_part[None] & set_.touched.is_support  # (S, K)
    normals = jnp.sum(jnp.where(held[:, :, None], set_.normals[None], 0.0), axis=1)
    tangents = jnp.sum(jnp.where(held[:, :, None, None], set_.tangents[None], 0.0), axis=1)
    along = (grip[:, None, None] * tangents).reshape(-1, set_.normals.shape[1])
    if len(held) < 2:
        rows = jnp.concatenate([normals, along])
        return _Rows(rows, rows.T, along)
    across = _pseudo_inverse(normals)
    beside = along - matmul(matmul(along, across), normals)
    inverse = jnp.concatenate([across, _pseudo_inverse(beside)], axis=1)
    return _Rows(jnp.concatenate([normals, beside]), inverse, along)


def _others(touched: Touched) -> Any:
    """The surfaces that take part and are no supports."""
    return touched.takes_part & ~jnp.any(touched.is_support, axis=0)


def _kicks(set_: _Set, rows: Any, load: Any, y: Any) -> Any:
    """What every surface takes of the slip, shape (K, 2). Where all laws have one factor w, it is w times the shortest
    impulse that stops all of the slip. Where not, as far as to the least w all take part in that, from there to the
    next one those that reach so far, and so on: continuous in all numbers, and a smooth surface, w = 0, is not there.
    """
    closing = jnp.maximum(load, 0.0) / (1.0 + set_.touched.restitution)

    def factors(stops: Any) -> Any:
        squared = _above_rounding(jnp.sum(stops * stops, axis=1), y) / set_.share
        return set_.slip_factors(closing, squared) / set_.share

    own = factors(matmul(rows, y))
    own = jnp.where(_others(set_.touched), own, 0.0)
    if set_.levels is None:
        order = jnp.argsort(-lax.stop_gradient(own))
        levels, places = own[order], np.arange(own.size)[:, None]
        ranks = jnp.argmax(order[None] == places, axis=1)  # so many are abler
        able = (ranks[None] <= places) & (own > 0)[None]
    else:
        levels = jnp.asarray(set_.levels, own.dtype)
        able = own[None] > (1.0 - 1e-3) * levels[:, None]

    def shared_by(able: Any) -> Any:
        part = jnp.where(able[:, None, None], rows, 0.0).reshape(-1, y.size)
        return matmul(_pseudo_inverse(part).T, y).reshape(-1, 2)

    steps = levels - jnp.concatenate([levels[1:], jnp.zeros_like(levels[:1])])
    kicks = jnp.sum(steps[:, None, None] * jax.vmap(shared_by)(able), axis=0)
    gripping = factors(jnp.zeros_like(kicks))[:, None]
    grips = gripping > 0
    stops = kicks / jnp.where(grips, gripping, 1.0)
    return jnp.where(grips, factors(stops)[:, None] * stops, 0.0)


def _above_rounding(squares: Any, y: Any) -> Any:
    """Squares of velocities that are parts of y, zero where they are rounding."""
    eps = float(jnp.finfo(y.dtype).eps)
    return jnp.where(squares > eps * eps * matmul(y, y), squares, 0.0)


def _at_most_elastic(y: Any, change: Any) -> Any:
    """The part of a change, at most 1, by which y may be lessened without growing in size."""
    most, size = 2.0 * matmul(y, change), _above_rounding(matmul(change, change), y)
    eps = float(jnp.finfo(y.dtype).eps)
    grows = (most < size * (1.0 - 256.0 * eps)) & (size > 0)  # a change that is rounding is not judged
    return jnp.where(grows, jnp.maximum(most, 0.0) / jnp.where(grows, size, 1.0), 1.0)


def _pseudo_inverse(rows: Any) -> Any:
    """The pseudo-inverse, shape (n, k), of few rows of one scale, shape (k, n), row by row (Greville 1960). A small row
    is known in its direction to few digits: what of a larger one is beside it may be rounding, times `known`."""
    tolerance = 1e3 * float(jnp.finfo(rows.dtype).eps)

    def one(inverse: Any, each: tuple) -> tuple:
        here, row = each
        known = matmul(row, inverse)
        rest = row - matmul(known, rows)
        rest = rest - matmul(matmul(rest, inverse), rows)
        size = matmul(rest, rest)
        is_new = size > tolerance * tolerance * (1.0 + matmul(known, known))
        new = rest / jnp.where(is_new, size, 1.0)
        old = matmul(inverse, known) / (1.0 + matmul(known, known))
        column = jnp.where(is_new, new, old)
        return inverse - column[:, None] * known[None] + column[:, None] * here[None], None

    begin = jnp.zeros(rows.shape[::-1], rows.dtype)
    return lax.scan(one, begin, (np.eye(rows.shape[0], dtype=rows.dtype), rows))[0]
