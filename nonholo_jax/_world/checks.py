"""What a Lagrangian system asks of a state, of its functions and of its barriers, and the words for it."""

from typing import Any

import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
from jaxtyping import Array, Bool

from .._impact import divisor, matmul, pseudo_inverse, whiten
from .._math import components
from .system import magnitude, rounding


def refuse_shapes(system: Any, q: Array, v: Array) -> None:
    """Raise `ValueError` where a function of the system does not give what (q, v) of one motion needs."""
    for name, x in (("q", q), ("v", v)):
        if x.ndim != 1:
            raise ValueError(
                f"Argument `{name}` must have shape (n,) for one motion, but got {x.shape}; try simulate_batch()."
            )
    n, t = v.shape[0], jnp.zeros((), q.dtype)
    if system.frame is None and q.shape != v.shape:
        raise ValueError(
            f"Argument `v` must have shape {q.shape} as q where there is no `frame`, but got {v.shape}; try frame=..."
        )
    _refuse_shape("frame", system.frame, (q,), (q.shape[0], n))
    _refuse_shape("lagrangian", system.lagrangian, (q, v), ())
    _refuse_shape("metric", system.metric, (q,), (n, n))
    _refuse_shape("potential", system.potential, (q,), ())
    _refuse_shape("forces", system.forces, (q, v, t), (n,))
    _refuse_shape("retraction", system.retraction, (q,), q.shape)
    m = _refuse_shape("constraint", system.constraint, (q,), (None, n))
    _refuse_shape("offset", system.offset, (q, t), m[:1])
    for i, barrier in enumerate(system.barriers):
        _refuse_shape(f"barriers[{i}].gap", barrier.gap, (q,), ())
        k = _refuse_shape(f"barriers[{i}].constraint", barrier.constraint, (q,), (None, n))
        _refuse_shape(f"barriers[{i}].offset", barrier.offset, (q, t), k[:1])


def _refuse_shape(name: str, function: Any, args: tuple, wanted: tuple) -> tuple:
    if function is None:
        return (0,)
    shape = jax.eval_shape(function, *args).shape
    if len(shape) != len(wanted) or any(want not in (None, got) for got, want in zip(shape, wanted, strict=True)):
        rows = ", ".join("any" if want is None else str(want) for want in wanted)
        raise ValueError(
            f"Argument `{name}` must return the shape ({rows}) at q of shape {args[0].shape}, but got {shape}; try "
            "one row for each equation and one column for each velocity."
        )
    return shape


def _frame_conditions(system: Any, q: Array) -> dict:
    """Full rank, and (I - F F^+) [F_j, F_i] = 0: brackets of the columns of F stay in their span."""
    eps = float(jnp.finfo(q.dtype).eps)
    f, df = system.frame(q), jax.jacfwd(system.frame)(q)
    lengths = divisor(jnp.sqrt(jnp.sum(f**2, axis=0)))
    basis, triangle = jnp.linalg.qr(f / lengths[None, :])
    least = jnp.min(jnp.abs(jnp.diagonal(triangle)))
    along = jnp.einsum("kil,lj->kij", df, f, precision=jax.lax.Precision.HIGHEST)
    bracket = (along - along.swapaxes(1, 2)).reshape(q.shape[0], -1)
    outside = jnp.max(jnp.abs(bracket - matmul(basis, matmul(basis.T, bracket))), initial=0.0)
    return {
        "frame": (least > 100.0 * eps * q.shape[0], least),
        "closed": (outside <= eps**0.5 * jnp.max(jnp.abs(along), initial=0.0), outside),
    }


def fit(system: Any, index: int, t: Array, q: Array, n: int) -> dict:
    """How well barrier and system go together at q: whether ker B is inside ker A, whether B v = c and A v = b agree,
    and whether B stops the motion towards the barrier. Sizes are relative, in the metric."""
    barrier, metric = system.barriers[index], system.metric_at(q)
    eps = float(jnp.finfo(q.dtype).eps)
    rows = barrier.constraint(q)
    _, _, w, scaling = whiten(metric, rows, thorough=False)
    w_plus, pi = pseudo_inverse(w)
    c = matmul(scaling, barrier.moves(q, t, rows.shape[0]))
    drift = matmul(w_plus, c)  # the least velocity with B v = c
    a, b = system.constraint_at(q, t, n)
    gradient = jax.grad(barrier.gap)(q)
    gradient = gradient if system.frame is None else matmul(gradient, system.frame(q))
    _, _, others, scaling = whiten(metric, jnp.concatenate([a, gradient[None, :]]), thorough=False)
    outside, b = others - matmul(others, pi), matmul(scaling, jnp.append(b, 0.0))[:-1]
    inside, past = _largest(outside[:-1]), _largest(outside[-1])
    disagreement = jnp.maximum(_largest(matmul(w, drift) - c), _largest(matmul(others[:-1], drift) - b))
    size = _largest(c) + _largest(b) + jnp.sqrt(jnp.sum(drift**2))
    return {
        "inside": (inside <= eps**0.5, inside),
        "agreed": (disagreement <= eps**0.5 * size, disagreement),
        "stopped": (past <= eps**0.5, past),
    }


def _largest(x: Array) -> Array:
    return jnp.max(jnp.abs(x), initial=0.0)


def conditions(system: Any, t: Array, q: Array, v: Array) -> dict[Any, tuple[Bool[Array, ""], Array]]:
    """What must hold where a motion starts, each with a number that says by how much it does or does not."""
    eps, n = float(jnp.finfo(q.dtype).eps), v.shape[0]
    numbers = [jnp.all(jnp.isfinite(jnp.asarray(leaf))) for leaf in jax.tree.leaves((system, t, q, v))]
    found: dict[Any, Any] = {"finite": (jnp.all(jnp.stack(numbers)), t)}
    metric = system.metric_at(q)
    scale = divisor(jnp.sqrt(jnp.abs(jnp.diagonal(metric))))
    scaled = metric / scale[:, None] / scale[None, :]
    lopsided, pivot = _largest(scaled - scaled.T), jnp.min(jnp.diagonal(jnp.linalg.cholesky(scaled))) ** 2
    found["symmetric"] = (lopsided <= 100.0 * eps, lopsided)
    found["positive"] = (pivot > 10.0 * n * eps, pivot)  # False for NaN, which is what Cholesky gives otherwise
    if system.frame is not None:
        found |= _frame_conditions(system, q)
    for i, barrier in enumerate(system.barriers):
        gap = barrier.gap(q)
        found[("apart", i)] = (gap >= -16.0 * rounding(system, i, magnitude(components(q)), q.dtype), gap)
        e, curvature = barrier.restitution, barrier.curvature
        found[("restitution", i)] = (jnp.asarray((e >= 0) & (e <= 1)), jnp.asarray(e, q.dtype))
        if curvature is not None:
            found[("curvature", i)] = (jnp.asarray(curvature >= 0), jnp.asarray(curvature, q.dtype))
        fits = fit(system, i, t, q, n)
        found |= {(name, i): fits[name] for name in ("inside", "agreed")}
    a, b = system.constraint_at(q, t, n)
    excess = matmul(a, v) - b
    _, _, _, scaling = whiten(metric, a, thorough=False)
    size = jnp.sqrt(jnp.maximum(matmul(v, matmul(metric, v)), 0.0)) + _largest(matmul(scaling, b))
    found["velocity"] = (_largest(matmul(scaling, excess)) <= 1e3 * eps * size, _largest(excess))
    return found


SENTENCES = {
    "finite": "Arguments `scene` and `state` must hold finite numbers, but got NaN or infinity at t = {size:g}; try "
    "printing them.",
    "symmetric": "Argument `metric` must be symmetric, but got a relative asymmetry of {size:.3g} at the initial q; "
    "try 0.5 * (G + G.T).",
    "positive": "Argument `metric` must be positive definite, but got a smallest scaled pivot of {size:.3g} at the "
    "initial q; try other coordinates, or a mass for every velocity.",
    "frame": "Argument `frame` must have independent columns, but got a smallest pivot of {size:.3g} at the initial q; "
    "try one column for each velocity.",
    "closed": "Argument `frame` must span the whole tangent space, so that brackets of its columns stay in their span, "
    "but got {size:.3g} outside of it; try a frame for all velocities, with the constraint in `constraint`.",
    "apart": "Argument `state` must start on the positive side of barriers[{i}], but got a gap of {size:.6g}; try "
    "another q.",
    "restitution": "Argument `barriers[{i}].restitution` must lie in [0, 1], but got {size:g}; 1 conserves energy.",
    "curvature": "Argument `barriers[{i}].curvature` must not be negative, but got {size:g}; try None.",
    "inside": "Argument `barriers[{i}].constraint` must hold the constraint of the system (ker B inside ker A; [B; A] "
    "has the rank of B), but got {size:.3g} of it outside at the initial q; try stacking the rows of A onto B.",
    "agreed": "Argument `barriers[{i}].offset` must agree with `offset` of the system, but got B v = c and A v = b "
    "that contradict each other by {size:.3g} at the initial q: a wall and a floor that hold one point in two "
    "moving frames at once; try a smooth wall (the rows of A and of the gap's gradient), or another offset.",
    "velocity": "Argument `state` must have a velocity with A v = b, but got |A v - b| = {size:.3g}; try "
    "system.admissible(q, v).",
}


@eqx.filter_jit
def _jitted_conditions(system: Any, t: Array, q: Array, v: Array) -> dict:
    # Keys of a dict that JAX rebuilds must be of one kind.
    return {str(key): value for key, value in conditions(system, t, q, v).items()}


def refuse(system: Any, t: Any, q: Array, v: Array) -> None:
    """Raise `ValueError` for what must hold and does not, where it is known now."""
    t = jnp.asarray(t, dtype=q.dtype)
    if any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves((system, t, q, v))):
        return
    system = jax.tree.map(lambda x: x.astype(q.dtype) if eqx.is_inexact_array(x) else x, system)
    found = _jitted_conditions(system, t, q, v)
    names: list[Any] = [name for name in SENTENCES if name in found]
    for i in range(system.n_contacts):
        names += [(name, i) for name in SENTENCES if str((name, i)) in found]
    order = [name for name in SENTENCES]
    for key in sorted(names, key=lambda key: order.index(key if isinstance(key, str) else key[0])):
        holds, size = found[str(key)]
        if not bool(holds):
            kind, i = (key, 0) if isinstance(key, str) else key
            raise ValueError(SENTENCES[kind].format(size=float(size), i=i))
