"""One grammar names a number anywhere: `throw.spin.y`, `surfaces.floor.law.restitution`, `ball.radius`, `gravity.z`."""

import difflib
from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._math import is_constant
from .._world import BallState, Scene


class _Place(NamedTuple):
    """Where a number lives: attributes and indices from (scene, state) on, and the component of a vector, if any."""

    steps: tuple
    component: int | None


_STATE = ("position", "velocity", "spin", "orientation")
_SPOKEN = {"facing": "normal", "function": None}  # fields whose public name differs, or that hold no number


def _is_number(x: Any) -> bool:
    return is_constant(x) or (eqx.is_inexact_array(x) and x.ndim == 0)


def _is_vector(x: Any) -> bool:
    if isinstance(x, tuple):
        return all(_is_number(c) for c in x)
    return eqx.is_inexact_array(x) and x.ndim == 1


def _fields(prefix: str, owner: Any, steps: tuple) -> dict[str, _Place]:
    """The numbers that an object holds, by name."""
    places: dict[str, _Place] = {}
    for field in getattr(owner, "__dataclass_fields__", {}):
        name, value = _SPOKEN.get(field, field), getattr(owner, field)
        if name is None or isinstance(value, bool):
            continue
        here = (*steps, field)
        if _is_number(value):
            places[f"{prefix}.{name}"] = _Place(here, None)
        elif _is_vector(value):
            letters = "wxyz" if len(value) == 4 else "xyz"
            places |= {f"{prefix}.{name}.{letters[i]}": _Place(here, i) for i in range(len(value))}
        elif isinstance(value, eqx.Module):
            places |= _fields(f"{prefix}.{name}", value, here)
    return places


def places(scene: Scene, state: BallState) -> dict[str, _Place]:
    """Every number of a scene and a throw, by its full name."""
    found: dict[str, _Place] = {}
    for name in _STATE:
        value = getattr(state, name)
        if value is not None:
            letters = "wxyz" if name == "orientation" else "xyz"
            found |= {f"throw.{name}.{c}": _Place((1, name), i) for i, c in enumerate(letters)}
    found |= _fields("ball", scene.ball, (0, "ball"))
    found |= {f"gravity.{c}": _Place((0, "gravity"), i) for i, c in enumerate("xyz")}
    if scene.air is not None:
        found |= _fields("air", scene.air, (0, "air"))
    for i, (name, surface) in enumerate(zip(scene.names, scene.surfaces, strict=True)):
        found |= _fields(f"surfaces.{name}", surface, (0, "surfaces", i))
    return found


def expand(scene: Scene, state: BallState, names: Sequence[str]) -> tuple[str, ...]:
    """Full names of single numbers, in the order given: `spin` gives `throw.spin.x`, `throw.spin.y`, `throw.spin.z`.
    Raises `ValueError`, with the nearest known name, for a name that is not there or is named twice."""
    known = places(scene, state)
    found: list[str] = []
    for name in names:
        full = f"throw.{name}" if name.split(".")[0] in _STATE else name
        hits = [each for each in known if each == full or each.startswith(full + ".")]
        vectors = {each.rsplit(".", 1)[0] for each in known if each.rsplit(".", 1)[1] in tuple("wxyz")}
        if full not in known and full not in vectors:
            near = difflib.get_close_matches(full, [*known, *sorted(vectors)], n=1, cutoff=0.5)
            hint = f"did you mean {near[0]!r}?" if near else "try 'spin.y', 'velocity' or 'ball.radius'."
            raise ValueError(f"Name {name!r} is no number of this scene; {hint}")
        for hit in hits:
            if hit in found:
                raise ValueError(f"Name {hit!r} is given twice, by {name!r} too; try naming it once.")
            found.append(hit)
    return tuple(found)


def _follow(pair: Any, steps: tuple) -> Any:
    for step in steps:
        pair = pair[step] if isinstance(step, int) else getattr(pair, step)
    return pair


def read(scene: Scene, state: BallState, names: Sequence[str]) -> Float[Array, " n"]:
    """The numbers of those full names, in the dtype of the state."""
    known = places(scene, state)
    values, dtype = [], state.position.dtype
    for name in names:
        steps, component = known[name]
        value = _follow((scene, state), steps)
        value = np.asarray(value) if _is_known(value) and eqx.is_array(value) else value
        values.append(value if component is None else value[component])
    if all(map(_is_known, values)):
        return jnp.asarray(np.asarray(values, dtype))
    return jnp.stack([jnp.asarray(value, dtype=dtype) for value in values])


def _is_known(x: Any) -> bool:
    """True where NumPy can do what JAX would compile a program for."""
    return not isinstance(x, jax.core.Tracer)


def _replaced(vector: Any, component: int, new: Any) -> Any:
    if not (_is_known(vector) and _is_known(new)):
        return vector.at[component].set(new.astype(vector.dtype))
    changed = np.array(vector)
    changed[component] = new
    return jnp.asarray(changed)


def write(scene: Scene, state: BallState, names: Sequence[str], values: Any) -> tuple[Scene, BallState]:
    """The scene and the state with those numbers replaced; they may be traced."""
    known = places(scene, state)
    pair = (scene, state)
    for i, name in enumerate(names):
        steps, component = known[name]
        new = values[i]
        if component is not None:
            old = _follow(pair, steps)
            if isinstance(old, jax.Array):
                new = _replaced(old, component, new)
            else:
                new = tuple(new if j == component else part for j, part in enumerate(old))
        pair = eqx.tree_at(lambda x, steps=steps: _follow(x, steps), pair, new)
    return pair
