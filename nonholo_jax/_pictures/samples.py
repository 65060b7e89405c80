"""A motion as a picture needs it: in NumPy, densely in time, with both sides of every impact."""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from .._math import kind_name, result_name
from .._world import Scene
from .outline import as_numpy

# What a picture's title says of a row of the log, where that is not an ordinary impact.
WORDS = {"left": "off {}", "train": "{} (dying out)", "gripped": "{} (gripped)", "passed": "on to {}",
         "slipped": "{} (slips)", "stopped": "{} (stops)", "groove": "{} (groove)"}  # fmt: skip


class Samples(NamedTuple):
    """The motion sampled arc by arc; both sides of every impact are in it, so that kinks and jumps are sharp."""

    time: np.ndarray
    position: np.ndarray
    velocity: np.ndarray
    spin: np.ndarray
    arc: np.ndarray  # which arc a sample belongs to


class Strikes(NamedTuple):
    """The impacts that the picture shows."""

    time: np.ndarray
    surface: np.ndarray
    kind: list[str]
    position: np.ndarray
    normal: np.ndarray
    spin: np.ndarray  # just after


def end_of(trajectory: Any, until: float | None) -> float:
    """Where the picture ends: at `until`, and no later than the trajectory can tell its state."""
    if trajectory.t1.ndim:
        raise ValueError(
            f"Argument `trajectory` must be one motion, but got a batch of shape {trajectory.t1.shape}; try simulate() "
            "on the state of one lane."
        )
    rows, ends = trajectory.impacts.time.shape[0], [float(trajectory.t1)]
    if until is not None:
        ends.append(max(float(until), float(trajectory.t0)))
    if int(trajectory.n_rows) > rows:
        ends.append(float(trajectory.impacts.time[-1]) if rows else float(trajectory.t0))
    return min(ends)


def sample(trajectory: Any, end: float) -> tuple[Samples, Strikes]:
    log = trajectory.impacts
    shown = (np.asarray(log.surface) >= 0) & (as_numpy(log.time) <= end)
    times, untils = as_numpy(log.time)[shown], np.minimum(as_numpy(log.until)[shown], end)
    trains = untils > times  # arcs of their own, between those before and after
    begins = np.array([float(trajectory.t0), *untils, *times[trains]])
    ends = np.array([*times, end, *untils[trains]])
    order = np.argsort(begins, kind="stable")
    per_arc = int(np.clip(2400 // len(begins), 24, 100))
    inner = np.linspace(begins, ends, per_arc)[1:-1].T
    asked = np.concatenate([[end], times[trains], inner.ravel()])
    padded = np.full(-(-asked.size // 512) * 512, end)  # few sizes, few compilations
    padded[: asked.size] = asked
    state = trajectory.at(jnp.asarray(padded, dtype=trajectory.t1.dtype))
    columns = []
    for name in ("position", "velocity", "spin"):
        every = (trajectory.initial, log.before, log.after, state)
        first, before, after, values = (as_numpy(getattr(each, name)) for each in every)
        last = 1 + np.count_nonzero(trains)
        opens = np.vstack([first, after[shown], values[1:last]])
        closes = np.vstack([before[shown], values[:1], after[shown][trains]])
        middle = values[last : asked.size].reshape(len(begins), per_arc - 2, 3)
        columns.append(np.concatenate([opens[:, None], middle, closes[:, None]], axis=1)[order].reshape(-1, 3))
    clock = np.concatenate([begins[:, None], inner, ends[:, None]], axis=1)[order].ravel()
    position, velocity, spin = columns
    samples = Samples(clock, position, velocity, spin, np.repeat(np.arange(len(begins)), per_arc))
    good = np.all([np.isfinite(column).all(axis=1) for column in columns], axis=0)
    if not good.any():
        raise ValueError(
            "Argument `trajectory` must have a finite state to draw, but it ended as "
            f"{result_name(trajectory.result)}; try simulate() with throw=True, which says why."
        )
    rows = (as_numpy(x)[shown] for x in (log.before.position, log.normal, log.after.spin))
    kinds = [kind_name(log.kind, int(i)) for i in np.flatnonzero(shown)]
    return Samples(*(column[good] for column in samples)), Strikes(times, np.asarray(log.surface)[shown], kinds, *rows)


def energies(scene: Scene, samples: Samples) -> dict[str, np.ndarray]:
    """In J; the potential energy is zero at the origin of the room."""
    mass, inertia, gravity = (as_numpy(x) for x in (scene.ball.mass, scene.ball.inertia, scene.gravity))
    parts = {
        "translational": 0.5 * mass * np.sum(samples.velocity**2, axis=1),
        "rotational": 0.5 * inertia * np.sum(samples.spin**2, axis=1),
        "potential": -mass * samples.position @ gravity,
    }
    return {"total": sum(parts.values()), **parts}  # pyright: ignore[reportReturnType]
