"""What a simulation returns."""

import dataclasses
from collections.abc import Iterable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .._math import KINDS, LEAST_EFFORT, RESULTS, along, frozen, with_options
from .._world import AbstractSystem
from .loop import Outcome, kind_of, unpack_row
from .motion import AbstractMotion
from .replay import run


class ImpactLog(eqx.Module):
    """The impacts in the order in which they happened, and where a ball left an edge. Every field has the leading axis
    log_size (behind the batch axis, if any); rows that are not used hold NaN, and -1 in `surface`.

    - `time` in s, and `duration` in s of the arc before.
    - `until`: the time in s at which `after` holds: that of the impact, or the end of a train.
    - `surface`: index in the order of the scene (of its barriers, for a `LagrangianSystem`).
    - `point` of contact in m, and unit `normal` from the surface to the ball.
    - `before`, `after`: the state on either side of the impact; the positions are equal.
    - `kind`: one of `KINDS`; `support`: index of the surface that the ball stays on afterwards, -1 if it flies;
        `beside`: of a ball in a groove that of the second one, else -1.
    - `grazing`: True where the closing speed is below sqrt(eps) of the speed: the time of such an impact, and its
        derivatives, are those of the branch taken, and ill-conditioned.
    """

    time: Float[Array, "*batch log"]
    until: Float[Array, "*batch log"]
    duration: Float[Array, "*batch log"]
    surface: Int[Array, "*batch log"]
    point: Float[Array, "*batch log d"]
    normal: Float[Array, "*batch log d"]
    before: Any
    after: Any
    kind: KINDS
    support: Int[Array, "*batch log"]
    beside: Int[Array, "*batch log"]
    grazing: Bool[Array, "*batch log"]


class Trajectory(eqx.Module):
    """One motion through its impacts, or a batch of them with a leading axis on every field.

    - `final`: state at `t1`; after the impact if one happens there.
    - `t1`: time reached in s. Earlier than asked for if the motion ended otherwise: see `result`.
    - `impacts`: an `ImpactLog`; `n_rows`, how many rows there were (the log may hold fewer). A train is one.
    - `n_impacts`: rows that count for `max_impacts`: all but hand-overs between flush faces, `n_passed`.
    - `n_arcs`: pieces of smooth motion computed: flights with `Exact`, accepted steps with `Integrated`.
    - `result`: one of `RESULTS`.
    - `is_bounded`: a bool of Python, one for a whole batch: whether every crossing was found with true bounds, so that
        none can have been passed. False if there is a gap that `UnboundedGapWarning` names.
    - `t0`, `initial`, `system`, `motion`: what the motion began with.
    """

    final: Any
    t1: Float[Array, "*batch"]
    impacts: ImpactLog
    n_impacts: Int[Array, "*batch"]
    n_passed: Int[Array, "*batch"]
    n_arcs: Int[Array, "*batch"]
    result: RESULTS
    t0: Float[Array, "*batch"]
    initial: Any
    system: Any  # an AbstractSystem
    motion: Any  # an AbstractMotion
    mapped: tuple[bool, ...] | None = eqx.field(static=True, default=None)
    is_bounded: bool = eqx.field(static=True, default=True)

    @property
    def n_rows(self) -> Any:
        """How many rows a log that is long enough has. Shape as `n_impacts`."""
        return self.n_impacts + self.n_passed

    def at(self, t: Any) -> Any:
        """The state at time `t` in s (scalar or array), exact between impacts: the motion is taken up at the impact
        before `t`, not interpolated. Right-continuous at impacts; NaN outside [t0, t1], and after the last impact
        that was logged if the log is shorter than the motion. Returns a state with the batch axis, if any, and then
        the axes of `t` in front. Differentiable in both modes."""
        long = self.n_impacts.ndim == 0 and not self.motion.is_closed_form
        return (_at_with_least_effort if long else _at_by_default)(self, jnp.asarray(t, dtype=self.t1.dtype))


def _at(trajectory: Trajectory, t: Any) -> Any:
    if trajectory.n_impacts.ndim == 0:
        flat = jax.vmap(lambda each: _at_one(trajectory, each))(t.reshape(-1))
        return jax.tree.map(lambda x: x.reshape(*t.shape, *x.shape[1:]), flat)
    leaves, treedef = jax.tree.flatten((trajectory.system, trajectory.motion))
    mapped = trajectory.mapped or (True,) * len(leaves)
    axes = [0 if each and eqx.is_array(leaf) else None for each, leaf in zip(mapped, leaves, strict=True)]
    system_axes, motion_axes = jax.tree.unflatten(treedef, axes)
    parts = (trajectory.system, trajectory.motion)
    rest = dataclasses.replace(trajectory, system=None, motion=None)

    def one(parts, rest):
        return _at(dataclasses.replace(rest, system=parts[0], motion=parts[1]), t)

    return eqx.filter_vmap(one, in_axes=((system_axes, motion_axes), eqx.if_array(0)))(parts, rest)


_at_by_default = eqx.filter_jit(_at)
_at_with_least_effort = with_options(_at, LEAST_EFFORT)


def _at_one(trajectory: Trajectory, t: Any) -> Any:
    """The state at one time of one motion."""
    system, log = trajectory.system.engine(t.dtype), trajectory.impacts
    rows = log.time.shape[0]
    end = trajectory.t1
    start, begin, phase = trajectory.initial, trajectory.t0, jnp.asarray(-1, dtype=jnp.int32)
    if rows > 0:
        n = jnp.minimum(trajectory.n_rows, rows)
        past = jnp.sum((log.until <= t) & (jnp.arange(rows, dtype=n.dtype) < n), dtype=n.dtype)
        row = jnp.maximum(past - 1, 0)
        start = jax.tree.map(lambda a, b: jnp.where(past > 0, a[row], b), log.after, start)
        begin = jnp.where(past > 0, log.until[row], begin)
        phase = jnp.where(past > 0, system.code_of(log.support[row], log.beside[row]), phase)
        end = jnp.where(trajectory.n_rows > rows, log.until[rows - 1], end)
    else:
        end = jnp.where(trajectory.n_rows > 0, trajectory.t0, end)
    inside = (t >= trajectory.t0) & (t <= end)
    free = system.without_contacts()
    until = jnp.where(inside, t, begin)
    state, motion = free.unpacked(start, phase), trajectory.motion
    state = free.prepared(begin, state) if motion.is_closed_form else state
    if motion.is_closed_form:
        piece = motion.piece(free, begin, state, None, jnp.asarray(True), until - begin)
        arc, s = piece.arc, piece.arc.length
        end_state = free.advanced(until, state, arc.position(s), arc.velocity(s), s * arc.unit)
        end_state = jax.tree.map(lambda x: jnp.asarray(x, dtype=t.dtype), end_state)
    else:
        end_state = run(free, motion, state, begin, until, max_impacts=0, log_rows=0).state
    if rows > 0:
        summed, inner = _in_train(trajectory, past, n, t)
        end_state = jax.tree.map(lambda a, b: jnp.where(summed, a, b), inner, end_state)
    return jax.tree.map(lambda x: jnp.where(inside, x, jnp.nan), system.packed(end_state))


def _in_train(trajectory: Trajectory, past: Any, n: Any, t: Any) -> tuple[Any, Any]:
    """Whether the time falls into the train that follows `past` rows of the log, and the state if it does."""
    system, log = trajectory.system.engine(t.dtype), trajectory.impacts
    row = jnp.minimum(past, log.time.shape[0] - 1)
    time = log.time[row]
    summed = (past < n) & (time <= t) & (t < log.until[row])
    before = jax.tree.map(lambda a, b: jnp.where(summed, a[row], b), log.before, trajectory.initial)
    elapsed = jnp.where(summed, t - time, 0.0)
    contact = system.choice(jnp.maximum(log.surface[row], 0))
    state = system.during(contact, time, system.unpacked(before), elapsed)
    return summed, jax.tree.map(lambda x: jnp.asarray(x, dtype=t.dtype), state)


def packaged(system: AbstractSystem, motion: AbstractMotion, state: Any, t0: Any, outcome: Outcome) -> Trajectory:
    """The user's form of an outcome."""
    log, n_rows = _log(system, t0, outcome), outcome.n_impacts
    n_passed = jnp.zeros_like(n_rows) if outcome.n_passed is None else outcome.n_passed
    return Trajectory(
        final=system.packed(outcome.state),
        t1=outcome.time,
        impacts=log,
        n_impacts=n_rows if outcome.n_passed is None else n_rows - n_passed,
        n_passed=n_passed,
        n_arcs=outcome.n_arcs,
        result=outcome.result,
        t0=t0,
        initial=state,
        system=system,
        motion=motion,
    )


def _log(system: AbstractSystem, t0: Any, outcome: Outcome) -> ImpactLog:
    values = outcome.log.values
    contact, code, phase = (outcome.log.labels[:, i] for i in range(3))
    support, beside = system.supports(phase)
    row, used = unpack_row(values, outcome.state), contact >= 0
    safe = jax.tree.map(jnp.nan_to_num, frozen(outcome.state))  # harmless numbers for the rows that are not used
    before = jax.tree.map(lambda a, b: jnp.where(along(used, a), a, b), row.before, safe)

    def frames(contact: Any, time: Any, before: Any) -> tuple:
        if system.n_contacts == 0:
            nowhere = jnp.full((contact.shape[0], len(system.evolving(outcome.state)[0])), jnp.nan, t0.dtype)
            return nowhere, nowhere, jnp.zeros(contact.shape, bool)
        frame = lambda i, *rest: system.contact_frame(system.choice(i), *rest)  # noqa: E731
        point, normal = jax.vmap(frame)(contact, time, before)
        point, normal = (jnp.where(used[:, None], x, jnp.nan) for x in (point, normal))
        rate = frozen(jax.vmap(lambda time, state: _joined(system.rate_of(time, state), time))(time, before))
        rate = rate[:, : normal.shape[1]]  # of what the normal is of: a state may evolve more than the gaps see
        closing, speed = jnp.abs(jnp.sum(normal * rate, axis=-1)), jnp.sqrt(jnp.sum(rate**2, axis=-1))
        return point, normal, used & (closing <= float(jnp.finfo(t0.dtype).eps) ** 0.5 * speed)

    if values.shape[0] > 0:
        point, normal, grazing = frames(contact, row.time, before)
    else:  # nothing to compute, only shapes to know
        shapes = jax.eval_shape(frames, contact, row.time, before)
        point, normal, grazing = (jnp.zeros(x.shape, x.dtype) for x in shapes)
    packed_before, packed_after = jax.vmap(system.packed)(row.before), jax.vmap(system.packed)(row.after)
    return ImpactLog(
        row.time, row.until, row.duration, contact, point, normal, packed_before, packed_after,
        kind_of(jnp.maximum(code, 0)), support, beside, grazing,
    )  # fmt: skip


def _joined(numbers: Any, like: Any) -> Any:
    return jnp.stack([jnp.asarray(x, dtype=like.dtype) for x in numbers])


def flat(measures: Iterable[Any], trajectory: Trajectory) -> Float[Array, " q"]:
    """All that is measured of one trajectory."""
    dtype = trajectory.t1.dtype
    parts = [jnp.ravel(jnp.asarray(measure(trajectory)).astype(dtype)) for measure in measures]
    return jnp.concatenate(parts) if parts else jnp.zeros((0,), dtype)
