"""Numbers of a scene that may change without a new program."""

from typing import Any

import jax
import jax.numpy as jnp

from .._world import Scene

_ALONG_AXES = ("gravity", "facing", "axis", "tangent", "rotation")
_STRUCTURE = {
    **dict.fromkeys((*_ALONG_AXES, "restitution", "tangential"), (-1.0, 0.0, 1.0)),
    **dict.fromkeys(("friction", "rolling", "spinning", "density", "drag", "lift", "wind"), (0.0,)),
}


def traced(scene: Scene, dtype: Any = None) -> Scene:
    """A scene whose numbers are JAX arrays, so that other numbers need no other program.

    **Arguments:** `scene`, with numbers of Python; `dtype` of the arrays (default: JAX's default for floats).

    Returns the same scene. What changes the model stays a number of Python, and with it a constant of the program:
    restitution and tangential that are exactly -1, 0 or 1; components of gravity, normals, axes, tangents and rotations
    that are; friction, resistance, density, drag, lift and components of the wind that are exactly 0. All else becomes
    a scalar, of vectors component by component, which is the smaller program.

    ```python
    from nonholo_jax import Ball, BallState, Plane, Rough, Scene, simulate
    from nonholo_jax.scene_file import traced
    room = lambda e: traced(Scene(Ball(0.025, 0.046), {"floor": Plane((0, 0, 0), (0, 0, 1), Rough(e))}))
    throw = BallState([0, 0, 1], [1, 0, 0], [0, 0, 0])
    [simulate(room(e), throw, t1=0.8).n_impacts for e in (0.7, 0.8)]  # one program
    ```
    """
    dtype = jnp.result_type(float) if dtype is None else dtype

    def one(path: tuple, x: Any) -> Any:
        if not isinstance(x, float):
            return x
        names = [key.name for key in path if isinstance(key, jax.tree_util.GetAttrKey)]
        return x if x in _STRUCTURE.get(names[-1], ()) else jnp.asarray(x, dtype)

    return jax.tree_util.tree_map_with_path(one, scene)  # which asks no constructor to judge the numbers once more
