"""Words shared by every file: array shapes and the ways in which a motion can end."""

from typing import Any, TypeAlias

import equinox.internal as eqxi
import jax.core
import numpy as np
from jaxtyping import Array, Float, Int

Scalar: TypeAlias = Float[Array, ""]
Vector: TypeAlias = Float[Array, "3"]
Quaternion: TypeAlias = Float[Array, "4"]
Number: TypeAlias = float | Scalar
Numbers: TypeAlias = float | Float[Array, "..."]  # one number, or an array of them that is computed with as one
Vector3: TypeAlias = tuple[Number, Number, Number]
"""Inside the engine a vector is three scalars: under `vmap` each is one contiguous array, and a component that is a
Python number is a constant of the program."""
Index: TypeAlias = Int[Array, ""]


class _Names(type(eqxi.Enumeration)):
    """Equinox cannot print a batch of no items, as the kinds of an empty log are."""

    def __getitem__(cls, item):
        value = getattr(item, "_value", 0)
        return "[]" if not isinstance(value, jax.core.Tracer) and np.size(value) == 0 else super().__getitem__(item)


class RESULTS(eqxi.Enumeration, metaclass=_Names):  # pyright: ignore[reportGeneralTypeIssues]
    """How a motion ended. The first two are successes, the third is a stop, the others are failures."""

    reached_t1 = "The motion reached `t1`."
    at_rest = "The ball came to rest before `t1`."
    max_impacts = (
        "The motion was stopped on its way to one impact more than `max_impacts`. Try increasing `max_impacts`, or "
        "read `Trajectory.t1` for the time reached."
    )
    step_limit = (
        "The step limit was reached before `t1`. Try increasing `max_steps` of the motion, or loosening `rtol` and "
        "`atol`."
    )
    invalid_state = (
        "The initial state or the scene is not admissible: a value is NaN or infinite, a mass, radius, inertia or size "
        "is not positive, a coefficient of restitution or friction is out of its range, a direction has no length, or "
        "the ball starts inside a surface. Try checking these, and moving the ball out by at least its radius."
    )
    no_limit = (
        "The bounces accumulate without a limit, because the tangential restitution is 1 in size and the normal one "
        "below 1. Try `tangential` between -1 and 1."
    )
    corner = (
        "Impacts at a corner did not resolve at one instant. Try moving the throw slightly off the corner, or round "
        "the corner off."
    )
    pivoting = (
        "The ball came to the edge of a face too slowly to fly off (v^2 < g r across the edge): it tips over the edge, "
        "which this motion does not follow. Try `motion=Exact(contact=Integrated())` (in air `Integrated(edges=True)`; "
        "in a scene file `contact = true`)."
    )
    sustained_contact = (
        "The ball stays in contact with a surface (it rests, rolls, or its bounces have died out below rounding) in a "
        "way that this motion does not follow. Try `motion=Exact(contact=Integrated())` (in air "
        "`Integrated(edges=True)`; in a scene file `contact = true`), or `throw=False` and `Trajectory.t1` for how far "
        "it came."
    )
    curved_slide = (
        "The ball slides across a slope, against friction: its slip turns, so that its path is no parabola. Try "
        "`motion=Integrated()`."
    )
    barrier_conflict = (
        "At an impact the barrier and the system ask for velocities that contradict each other, or the barrier does "
        "not stop the motion towards it. Try a `constraint` of the Barrier that holds the rows of the system's and "
        "of the gap's gradient, with the `offset` that goes with them."
    )


NO_IMPACTS = ("left", "gripped", "slipped", "stopped", "passed")
NAMES_OF_RESULTS = tuple(RESULTS._name_to_item)


NO_FAILURES = [NAMES_OF_RESULTS.index(name) for name in ("reached_t1", "at_rest", "max_impacts")]  # their codes


def is_success(result: RESULTS):
    """True where the motion did all that was asked of it. Shape as `result`."""
    return (result == RESULTS.reached_t1) | (result == RESULTS.at_rest)


def is_failure(result: RESULTS):
    """True where the motion could not be computed, so that `throw=True` raises. Shape as `result`."""
    return ~is_success(result) & (result != RESULTS.max_impacts)


def result_name(result: RESULTS) -> str:
    """The name of one concrete result, such as `"reached_t1"`."""
    return NAMES_OF_RESULTS[int(result._value)]  # pyright: ignore[reportAttributeAccessIssue]


def surfaces_hit(names: tuple[str, ...], log: Any) -> tuple[str, ...]:
    """The names of the surfaces of one concrete log, in the order in which they were hit."""
    rows = [(int(surface), kind_name(log.kind, i)) for i, surface in enumerate(log.surface) if surface >= 0]
    return tuple(names[surface] for surface, kind in rows if kind not in NO_IMPACTS)


def kind_name(kind: "KINDS", row: int) -> str:
    """The name of one row of concrete kinds, such as `"bounce"`."""
    return tuple(KINDS._name_to_item)[int(kind._value[row])]  # pyright: ignore[reportAttributeAccessIssue]


def result_message(result: RESULTS) -> str:
    """The sentence that says what one concrete result means and what to try."""
    return RESULTS._index_to_message[int(result._value)]  # pyright: ignore[reportAttributeAccessIssue]


class KINDS(eqxi.Enumeration, metaclass=_Names):  # pyright: ignore[reportGeneralTypeIssues]
    """What one row of an `ImpactLog` stands for."""

    unused = "No impact in this row."
    bounce = "One impact."
    train = "Infinitely many impacts that end in finite time; then the ball stays on the surface. One, if plastic."
    rolling = "An impact after which the ball goes on along the surface that it was on, or comes to lie on one."
    left = "The ball leaves a surface, over its edge or where that would have to pull it, without an impact."
    gripped = (
        "The slip of a ball that slid has died out, without an impact: from here it rolls, or, where it is too steep "
        "for that, slides downhill."
    )
    passed = (
        "The ball goes on from one face to another one that is flush with it, or to a part of its surface that bends "
        "otherwise, without an impact."
    )
    stopped = "Rolling resistance, or spinning friction, has stopped what it acts against, without an impact."
    groove = (
        "The last of the bounces on a second surface: the ball goes on along the groove between two, or rests there."
    )
    slipped = "A ball that rolled begins to slip, as friction cannot hold it any more, without an impact."
