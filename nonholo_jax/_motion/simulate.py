"""The two functions that run a simulation: check, choose the motion, run, package."""

import dataclasses
import warnings
from typing import Any

import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
import numpy as np

from .._math import (
    LEAST_EFFORT,
    NAMES_OF_RESULTS,
    NO_FAILURES,
    WIDEST_VECTORS,
    as_number,
    as_pair,
    as_quaternion,
    as_vector,
    by_tiles,
    free_devices,
    is_failure,
    over_devices,
    result_message,
    result_name,
    with_options,
)
from .._staying import Grounded, grounded, slides_across, stays_curved
from .._world import AbstractSystem, Scene
from .accuracy import motion_for
from .integrated import Integrated
from .motion import AbstractMotion, Exact
from .replay import run
from .trajectory import Trajectory, packaged

_LINE = 16  # tiles that are one queue, where each lane writes a log
_FEW_IMPACTS = 64  # are over before XLA has made a program quick: it saves 1 us an impact, and takes 0.4 s
_NDIM = {as_number: 0, as_vector: 1, as_pair: 1, as_quaternion: 1}


class SimulationError(RuntimeError):
    """A motion could not be computed; the message is that of its result."""


class UnboundedGapWarning(UserWarning):
    """A gap has a second derivative that is not bounded along a path, only sampled: a bump may be passed."""


def simulate(
    scene: AbstractSystem,
    state: Any,
    *,
    t1: Any,
    t0: Any = 0.0,
    max_impacts: int = 64,
    log_size: int | None = None,
    motion: AbstractMotion | None = None,
    accuracy: float | None = None,
    sum_trains: bool = True,
    adjoint: Any = None,
    throw: bool = True,
) -> Trajectory:
    """Move a state from `t0` to `t1` through its impacts.

    **Arguments:**

    - `scene`: a `Scene`.
    - `state`: a `BallState` with fields of shape (3,). The dtype of the whole computation follows its position.
    - `t1`, `t0`: times in s, t1 >= t0. Traced, so that a new value is no recompilation.
    - `max_impacts`: >= 0. A motion that arrives at one impact more stops there, before it, with
        `RESULTS.max_impacts`.
    - `log_size`: rows of the log; `None` for `max_impacts` and, where faces may be flush, as many hand-overs from one
        to the other; 0 for none.
    - `motion`: `Exact()` or `Integrated(...)`; `None` picks `Exact()` where the scene allows it, else `Integrated()`:
        with air, a gap whose curvature is neither given nor bounded by its program, or friction on a slope, across
        which a ball slides along a curve. In a scene with the inside of a sphere or a cylinder, a `Hole`, or an
        `Implicit`, it picks `Exact(contact=Integrated())`; so it does, in a second program, where a ball that is not
        traced stays on something in a way that `Exact()` does not follow.
    - `accuracy`: instead of `motion`, the error of the final position, in m, that is wanted: a Python number > 0. Picks
        `Exact()` where the scene allows it, else solver and tolerances that 99 of 100 throws of
        `experiments/benchmarks/bench_accuracy.py` reach it with; an expectation, no bound. Grazing throws may miss it.
    - `sum_trains`: bounces on a plane that die out before anything else can happen are summed in closed form, as one
        row of the log, and the ball goes on rolling (on a `Smooth` surface sliding, on a `Frictional` one sliding until
        it rolls). False gives every bounce, and ends as `RESULTS.sustained_contact` where they have died out.
    - `adjoint`: how derivatives are taken. `None` finds the path without derivatives and repeats it with them, in
        both modes. `diffrax.ForwardMode()` differentiates the loop itself, forward only, first derivatives only.
        `diffrax.RecursiveCheckpointAdjoint()` likewise, reverse only.
    - `throw`: raise failures. Inside `vmap` they are always returned, lane by lane, in `Trajectory.result`.

    Returns a `Trajectory`. Differentiable, in both modes and to second order, in the state, the times and every number
    of the scene that is a JAX array. Raises `ValueError` for arguments that cannot be right, and `SimulationError`
    where the motion failed (`RESULTS` says how it can). Warns with `UnboundedGapWarning` of a gap that is only sampled.

    ```python
    from nonholo_jax import Ball, BallState, Plane, Rough, Scene, simulate
    scene = Scene(Ball(0.025, 0.046), {"floor": Plane((0, 0, 0), (0, 0, 1), Rough())})
    trajectory = simulate(scene, BallState([0, 0, 1], [1, 0, 0], [0, 0, 0]), t1=1.0)
    trajectory.final.position, trajectory.n_impacts
    ```
    """
    _check_scene(scene, tuple(_axes(scene, None)))
    wanted, chosen = None if accuracy is None else (accuracy, state, t0, t1), motion is None and accuracy is None
    motion, log_rows = checked(scene, motion, max_impacts, log_size, slides=sum_trains, wanted=wanted)
    system = _continued(scene, motion, sum_trains)
    log_rows = system.most_rows(log_rows) if log_size is None else log_rows
    state = scene.received(state, batch=False, t0=t0)
    dtype = jax.tree.leaves(state)[0].dtype
    t0, t1 = (_array(t, dtype) for t in (t0, t1))
    _check_times(t0, t1)
    is_long = isinstance(system, Grounded) and system.curved  # a program that takes much longer to make than to run
    move = _run_few if is_long or (motion.is_closed_form and max_impacts <= _FEW_IMPACTS) else _run
    trajectory = move(system, motion, state, t0, t1, max_impacts, log_rows, adjoint)
    if chosen and sum_trains and _is_unfollowed(trajectory, motion):
        motion = Exact(contact=Integrated()) if motion.is_closed_form else dataclasses.replace(motion, edges=True)
        options = {"max_impacts": max_impacts, "log_size": log_size, "adjoint": adjoint, "throw": throw}
        return simulate(scene, state, t1=t1, t0=t0, motion=motion, **options)
    trajectory = _told(trajectory, scene.unbounded(state))
    return _raised(trajectory) if throw else trajectory


def _is_unfollowed(trajectory: Trajectory, motion: AbstractMotion) -> bool:
    """Whether a motion that is known, not traced, ended because the ball stays on something in a way that takes an
    integrator."""
    code = trajectory.result._value  # pyright: ignore[reportAttributeAccessIssue]
    if isinstance(code, jax.core.Tracer) or not isinstance(trajectory.system, Scene | Grounded):
        return False
    plain = isinstance(motion, Exact) and motion.contact is None
    plain = plain or (isinstance(motion, Integrated) and motion.edges is None)
    return plain and NAMES_OF_RESULTS[int(code)] in ("sustained_contact", "pivoting")


def simulate_batch(
    scene: AbstractSystem,
    states: Any,
    *,
    t1: Any,
    t0: Any = 0.0,
    scene_axes: Any = None,
    max_impacts: int = 64,
    log_size: int | None = None,
    motion: AbstractMotion | None = None,
    accuracy: float | None = None,
    sum_trains: bool = True,
    adjoint: Any = None,
    throw: bool = False,
) -> Trajectory:
    """`simulate` for many states at once, and if wanted for many scenes.

    **Arguments:** as `simulate`, but every field of `states` has a leading axis N, and

    - `scene_axes`: as `in_axes` of `vmap`, for scene parameters that are sampled: `None` for one scene for all; 0 if
        every JAX array of the scene has a leading axis N; or a pytree of these in the shape of the scene.
    - `log_size`: the log of a large batch is most of its memory and time; 0 if only the final states are wanted.
    - `throw`: False by default: one failed lane must not lose a batch. Each lane has its own `Trajectory.result`.

    Returns a `Trajectory` with a leading axis N. The batch is spread over all devices of the process, unless this is
    called within a transformation or somebody has put an argument on a device.

    ```python
    import jax, jax.numpy as jnp
    from nonholo_jax import Ball, BallState, Plane, Rough, Scene, simulate_batch
    scene = Scene(Ball(0.025, 0.046), {"floor": Plane((0, 0, 0), (0, 0, 1), Rough())})
    spin = jax.random.normal(jax.random.key(0), (1000, 3))
    throws = BallState(jnp.ones((1000, 3)), jnp.zeros((1000, 3)), spin)
    simulate_batch(scene, throws, t1=1.0).final.position.mean(axis=0)
    ```
    """
    axes = tuple(_axes(scene, scene_axes))
    _check_scene(scene, axes)
    one_scene = all(axis is None for axis in axes)
    wanted, slides = None if accuracy is None else (accuracy, states, t0, t1), sum_trains and one_scene
    first = scene if one_scene else _first(scene, axes)
    motion, log_rows = checked(first, motion, max_impacts, log_size, slides=slides, wanted=wanted)
    system = _continued(scene, motion, sum_trains)
    log_rows = system.most_rows(log_rows) if log_size is None else log_rows
    states = scene.received(states, batch=True, t0=t0)
    dtype = jax.tree.leaves(states)[0].dtype
    t0, t1 = (_array(t, dtype) for t in (t0, t1))
    _check_times(t0, t1)
    devices = free_devices((system, motion, states, t0, t1))
    trajectory = _run_batch(system, motion, states, t0, t1, axes, max_impacts, log_rows, adjoint, devices)
    trajectory = _told(trajectory, first.unbounded(states))
    return _raised(trajectory) if throw else trajectory


def _first(scene: AbstractSystem, axes: tuple) -> AbstractSystem:
    """The first of many scenes, whose gaps are then functions of one point."""
    if not isinstance(scene, AbstractSystem) or not any(scene.is_wide(i) for i in range(scene.n_contacts)):
        return scene
    leaves, treedef = jax.tree.flatten(scene)
    return jax.tree.unflatten(treedef, [leaf if axis is None else jax.lax.index_in_dim(leaf, 0, axis, keepdims=False)
                                        for leaf, axis in zip(leaves, axes, strict=True)])  # fmt: skip


def _told(trajectory: Trajectory, unbounded: list[str]) -> Trajectory:
    """Say, now and in what is returned, which gaps were searched by samples."""
    if not unbounded:
        return trajectory
    warnings.warn(
        f"The gap of {' and '.join(unbounded)} has a second derivative that cannot be bounded from its program, only "
        "sampled, so that a bump narrower than a step may be passed; try a bound of its norm, curvature=...",
        UnboundedGapWarning,
        stacklevel=3,
    )
    return dataclasses.replace(trajectory, is_bounded=False)


def _continued(scene: AbstractSystem, motion: AbstractMotion, sum_trains: bool) -> AbstractSystem:
    """The system with the motion after the last bounce, where there may be one."""
    if not (sum_trains and isinstance(scene, Scene)):
        return scene
    steps = getattr(motion, "contact", None) or motion
    curved = isinstance(steps, Integrated) and (steps is not motion or stays_curved(scene, steps.edges))
    return grounded(scene, float(getattr(steps, "atol", 0.0)), motion.is_closed_form, curved)


def _check_scene(scene: Any, axes: tuple) -> None:
    """Every number of a scene is one number, and every vector one vector, but for the axis that is mapped."""
    leaves = jax.tree_util.tree_flatten_with_path(scene)[0]
    for (path, leaf), axis in zip(leaves, axes, strict=True):
        wanted = _ndim(scene, path)
        if not eqx.is_array(leaf) or wanted is None:
            continue
        if leaf.ndim - (axis is not None) != wanted:
            what = jax.tree_util.keystr(path, simple=True, separator=".")
            raise ValueError(
                f"Argument `scene` must hold one value per motion in `{what}`, but got an array of shape {leaf.shape}; "
                "try simulate_batch(..., scene_axes=0), or vmap, for many scenes."
            )


def _ndim(owner: Any, path: tuple) -> int | None:
    """How many axes a leaf has by the converter of its field: 0 for a number or one component of a vector, 1 for a
    vector, `None` where no converter says (arrays of one's own surfaces, laws and gaps may have any shape)."""
    wanted = None
    for key in path:
        if isinstance(key, jax.tree_util.GetAttrKey):  # of a module; of a NamedTuple, too, which has no converters
            field = getattr(type(owner), "__dataclass_fields__", {}).get(key.name)
            wanted = None if field is None else _NDIM.get(field.metadata.get("converter"))
            owner = getattr(owner, key.name, None)
        elif isinstance(key, jax.tree_util.SequenceKey):
            wanted = None if wanted is None else wanted - 1
            owner = owner[key.idx]
        elif isinstance(key, jax.tree_util.DictKey):
            wanted, owner = None, owner[key.key]
        else:  # a container of somebody's own
            return None
    return wanted


def _moved(scene, motion, state, t0, t1, max_impacts: int, log_rows: int, adjoint) -> Trajectory:
    scene = _cast(scene, t1.dtype)
    options = {"max_impacts": max_impacts, "log_rows": log_rows, "adjoint": adjoint}
    engine = scene.engine(t1.dtype)
    outcome = run(engine, motion, engine.unpacked(state), t0, t1, **options)
    return dataclasses.replace(packaged(engine, motion, state, t0, outcome), system=scene)


_run = eqx.filter_jit(_moved)
_run_few = with_options(_moved, LEAST_EFFORT)


def _moved_batch(scene, motion, states, t0, t1, axes: tuple, max_impacts: int, log_rows: int, adjoint, devices: int):
    scene = _cast(scene, t1.dtype)
    leaves, treedef = jax.tree.flatten(scene)
    options = {"max_impacts": max_impacts, "log_rows": log_rows, "adjoint": adjoint}
    moved = [leaf if axis is None else jnp.moveaxis(leaf, axis, 0) for leaf, axis in zip(leaves, axes, strict=True)]
    arrays, constants = eqx.partition(([moved[i] for i, axis in enumerate(axes) if axis is None], motion), eqx.is_array)

    def batch(lanes, rest):
        states, mapped = lanes
        (alike, motion), t0, t1 = eqx.combine(rest[0], constants), rest[1], rest[2]

        def one(state, mapped):
            own, common = iter(mapped), iter(alike)
            each = [next(common) if axis is None else next(own) for axis in axes]
            system = jax.tree.unflatten(treedef, each).engine(t1.dtype)
            outcome = run(system, motion, system.unpacked(state), t0, t1, **options)
            whole = packaged(system, motion, state, t0, outcome)
            return dataclasses.replace(whole, system=None, motion=None, initial=None)

        whole = lambda lanes: jax.vmap(one)(*lanes)  # noqa: E731
        if log_rows == 0:
            return whole(lanes)
        size = motion.tile * (_LINE if scene.is_long else 1)
        return by_tiles(whole, lanes, len(jax.tree.leaves(states)[0]), size)

    mapped = [leaf for leaf, axis in zip(moved, axes, strict=True) if axis is not None]
    whole = over_devices(batch, (states, mapped), (arrays, t0, t1), devices)
    flags = tuple(axis is not None for axis in axes) + (False,) * len(jax.tree.leaves(motion))
    given = {"system": jax.tree.unflatten(treedef, moved), "motion": motion, "initial": states}  # and not copied
    return dataclasses.replace(whole, **given, mapped=flags)


_run_batch = with_options(_moved_batch, WIDEST_VECTORS)


def _cast(scene: Any, dtype: Any) -> Any:
    """The scene in the dtype of the state. Python numbers follow it by themselves."""
    return jax.tree.map(lambda x: x.astype(dtype) if eqx.is_inexact_array(x) else x, scene)


def _axes(scene: Any, scene_axes: Any) -> list:
    """The mapped axis of every leaf of the scene, or None."""
    spread: list = []
    is_none = lambda x: x is None  # noqa: E731
    if is_none(scene_axes) or isinstance(scene_axes, int):
        spread = [scene_axes] * len(jax.tree.leaves(scene))
    else:
        jax.tree.map(
            lambda axis, part: spread.extend([axis] * len(jax.tree.leaves(part))), scene_axes, scene, is_leaf=is_none
        )
    leaves = jax.tree.leaves(scene)
    return [axis if eqx.is_array(leaf) else None for axis, leaf in zip(spread, leaves, strict=True)]


def checked(
    scene: Any, motion: Any, max_impacts: int, log_size: int | None, slides: bool, wanted: tuple | None = None
) -> tuple[AbstractMotion, int]:
    if not isinstance(scene, AbstractSystem):
        raise ValueError(
            f"Argument `scene` must be a Scene, but got {type(scene).__name__}; try Scene(ball, surfaces)."
        )
    for name, value in (("max_impacts", max_impacts), ("log_size", 0 if log_size is None else log_size)):
        if isinstance(value, bool) or not isinstance(value, int) or value < 0:
            raise ValueError(f"Argument `{name}` must be a whole number of at least 0, but got {value!r}; try 64.")
    if wanted is not None and motion is not None:
        raise ValueError(f"Argument `accuracy` must come without `motion`, but got {motion!r}; try motion=None.")
    chosen = motion is None
    if chosen:
        closed = Exact.serves(scene) and not (slides and isinstance(scene, Scene) and slides_across(scene))
        stays = slides and isinstance(scene, Scene) and stays_curved(scene, None)
        motion = Exact(contact=Integrated() if stays else None) if closed else Integrated()
        motion = motion if wanted is None else motion_for(scene, *wanted, closed_form=closed)
    if not isinstance(motion, AbstractMotion):
        raise ValueError(f"Argument `motion` must be None, Exact() or Integrated(), but got {motion!r}; try None.")
    if not (chosen and motion.is_closed_form):  # which serves, as was asked above
        motion.check(scene)
    return motion, max_impacts if log_size is None else log_size


def _array(time: Any, dtype: Any) -> Any:
    """An array for a number; for one of Python or NumPy without a program of its own."""
    if isinstance(time, float | int | np.generic | np.ndarray):
        return jax.device_put(np.asarray(time, dtype))
    return jnp.asarray(time, dtype=dtype)


def _check_times(t0: Any, t1: Any) -> None:
    if t0.ndim or t1.ndim:
        raise ValueError(
            f"Arguments `t0` and `t1` must be scalars, but got shapes {t0.shape} and {t1.shape}; try vmap for several."
        )
    # By NumPy: within a transformation JAX would trace the comparison of two known numbers.
    if not any(isinstance(t, jax.core.Tracer) for t in (t0, t1)) and not np.asarray(t1) >= np.asarray(t0):
        raise ValueError(f"Argument `t1` must be finite and at least `t0`, but got t1={t1} and t0={t0}; try t1=1.0.")


def _raised(trajectory: Trajectory) -> Trajectory:
    """Raise for failures: now where the result is known, else when the compiled program runs."""
    code = trajectory.result._value  # pyright: ignore[reportAttributeAccessIssue]
    if type(code).__name__ == "BatchTracer":  # JAX has no public name for it; inside vmap nothing is raised
        return trajectory
    if isinstance(code, jax.core.Tracer):
        failed = is_failure(trajectory.result)
        # On every array of the answer: what is not used is compiled away, and its error with it.
        answer, rest = eqx.partition((trajectory.final, trajectory.t1, trajectory.impacts), eqx.is_array)
        final, t1, impacts = eqx.combine(trajectory.result.error_if(answer, failed), rest)
        return dataclasses.replace(trajectory, final=final, t1=t1, impacts=impacts)
    failed = ~np.isin(np.asarray(code), NO_FAILURES)  # without a program of its own
    if failed.ndim == 0 and bool(failed):
        result = trajectory.result
        when = "" if isinstance(trajectory.t1, jax.core.Tracer) else f" (t = {float(trajectory.t1):g} s)"
        raise SimulationError(f"{result_name(result)}: {result_message(result)}{when}")
    if failed.ndim and bool(failed.any()):
        first = int(np.argmax(failed))
        result = jax.tree.map(lambda x: x[first], trajectory.result)
        raise SimulationError(
            f"{int(failed.sum())} of {failed.size} lanes failed, the first of them lane {first} with "
            f"{result_name(result)}: {result_message(result)} Try throw=False, which returns every lane."
        )
    return trajectory
