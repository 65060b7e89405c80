"""The one registry of laws, surfaces and motions. A new class gets one line here; every shared test then runs on it."""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from nonholo_jax import (
    AbstractContactLaw,
    Air,
    Ball,
    BallState,
    Box,
    Cylinder,
    Exact,
    Frictional,
    Hole,
    Implicit,
    Integrated,
    Plane,
    Rectangle,
    Rough,
    Scene,
    Smooth,
    Sphere,
)
from nonholo_jax._math import Choice
from nonholo_jax._math.types import result_name

# With the effort that XLA takes by default, which conftest.py turns down: for bounds that are near to rounding.
full_jit = functools.partial(jax.jit, compiler_options={"xla_backend_optimization_level": 3})

GRAVITY = np.array([0.0, 0.0, -9.81])
BALL = {"radius": 0.1, "mass": 0.7, "inertia_ratio": 0.4}
AIR = {"density": 1.2, "drag": 0.5, "lift": 0.9, "wind": np.array([0.4, -0.3, 0.2])}


# Laws


class LawCase(NamedTuple):
    name: str
    build: Callable[..., AbstractContactLaw]
    numbers: dict[str, float]  # keyword arguments of `build`; any of them may be a JAX scalar


all_laws = (
    LawCase("rough", Rough, {"restitution": 0.8}),
    LawCase("rough_two_coefficients", Rough, {"restitution": 0.9, "tangential": 0.5}),
    LawCase("smooth", Smooth, {"restitution": 0.85}),
    LawCase("frictional_gripping", Frictional, {"restitution": 0.8, "tangential": 0.3, "friction": 50.0}),
    LawCase("frictional_sliding", Frictional, {"restitution": 0.8, "tangential": 0.3, "friction": 0.002}),
)


class AnyLaw(AbstractContactLaw):
    """The law of a traced index, so that one compiled program serves all laws, lane by lane."""

    index: jax.Array
    laws: tuple[AbstractContactLaw, ...]

    @property
    def restitution(self):  # pyright: ignore[reportIncompatibleVariableOverride]
        return Choice(self.index, len(self.laws)).of([jnp.asarray(law.restitution) for law in self.laws])

    def slip_factor(self, inertia_ratio, closing_speed, slip_squared):
        sizes = (inertia_ratio, closing_speed, slip_squared)
        return Choice(self.index, len(self.laws)).of([jnp.asarray(law.slip_factor(*sizes)) for law in self.laws])

    def admissible(self):
        return [check for law in self.laws for check in law.admissible()]


# Surfaces. A throw starts at one of `starts` and would be at one of `targets`, which lie beyond the surface, after its
# time of flight: it must hit on the way, by continuity.


class SurfaceCase(NamedTuple):
    name: str
    build: Callable[..., Any]  # build(law=..., **numbers)
    numbers: dict[str, Any]  # any of them may be a JAX array
    starts: Callable[[np.random.Generator, int], np.ndarray]
    targets: Callable[[np.random.Generator, int], np.ndarray]


class Hills(eqx.Module):
    """A floor of hills. The eigenvalues of its second derivative are amplitude * sin(x +- y)."""

    amplitude: Any
    height: Any

    def __call__(self, x, t):
        return x[2] - self.height - self.amplitude * jnp.sin(x[0]) * jnp.cos(x[1])


def _hills(law, amplitude, height):
    return Implicit(Hills(jnp.asarray(amplitude), jnp.asarray(height)), law, curvature=0.3)


def _in_box(low, high):
    return lambda rng, n: rng.uniform(low, high, (n, 3))


def _directions(rng, n, dimension=3):
    x = rng.standard_normal((n, dimension))
    return x / np.linalg.norm(x, axis=1, keepdims=True)


def _shell(center, low, high):
    return lambda rng, n: np.asarray(center) + _directions(rng, n) * rng.uniform(low, high, (n, 1))


def _in_frame(center, half, axes, middle=(0.0, 0.0, 0.0)):
    return lambda rng, n: np.asarray(center) + (rng.uniform(-1, 1, (n, 3)) * half + middle) @ np.asarray(axes)


def _ring(center, axes, distance, height):
    """Points at such a distance from the last of the axes, and at such a height along it."""

    def points(rng, n):
        across = _directions(rng, n, 2) * rng.uniform(*distance, (n, 1))
        return np.asarray(center) + np.hstack([across, rng.uniform(*height, (n, 1))]) @ np.asarray(axes)

    return points


def _around_axis(point, axis, low, high):
    """Points at a distance between `low` and `high` from a line, near `point`."""
    e = np.asarray(axis) / np.linalg.norm(axis)
    first = np.cross(e, [1.0, 0.0, 0.0])
    first = first / np.linalg.norm(first)
    frame = np.stack([first, np.cross(e, first)])

    def points(rng, n):
        across = _directions(rng, n, 2) * rng.uniform(low, high, (n, 1))
        return np.asarray(point) + across @ frame + rng.uniform(-0.5, 0.5, (n, 1)) * e

    return points


def frame_of(normal, tangent):
    """The axes of a rectangle: tangent made orthogonal to the normal, its partner, and the normal."""
    n = np.asarray(normal, float) / np.linalg.norm(normal)
    t = np.asarray(tangent, float) - n * (n @ np.asarray(tangent, float))
    t = t / np.linalg.norm(t)
    return np.stack([t, np.cross(n, t), n])


def axes_of(quaternion):
    """The rows are the axes of a frame turned by the quaternion (w, x, y, z)."""
    w, *v = np.asarray(quaternion, float) / np.linalg.norm(quaternion)
    return np.stack([e + 2 * w * np.cross(v, e) + 2 * np.cross(v, np.cross(v, e)) for e in np.eye(3)])


_PLATE = {
    "center": np.array([0.1, 0.0, 0.2]),
    "normal": np.array([0.1, 0.2, 1.0]),
    "tangent": np.array([1.0, 0.1, 0.0]),
}
_BOX = {"center": np.array([0.1, -0.1, 0.2]), "half_size": np.array([0.4, 0.3, 0.15])}
_TURN = np.array([0.9, 0.1, 0.3, -0.2])
_GLOBE = {"center": np.array([0.1, 0.2, -0.1]), "radius": 0.5}
_BOWL = {"center": np.array([0.1, 0.2, -0.1]), "radius": 1.0}
_POST = {"point": np.array([0.1, 0.2, 0.0]), "axis": np.array([0.2, 1.0, 0.3]), "radius": 0.4}
_PIPE = {"point": np.array([0.1, 0.2, 0.0]), "axis": np.array([0.2, 1.0, -0.3]), "radius": 0.9}
_PIT = {"center": np.array([0.1, 0.2, -0.1]), "normal": np.array([0.1, -0.2, 1.0]), "radius": 0.4}
_PIT_AXES = frame_of(_PIT["normal"], (1.0, 0.0, 0.0))

all_surfaces = (
    SurfaceCase(
        "plane", Plane, {"point": np.zeros(3), "normal": np.array([0.0, 0.0, 1.0])},
        _in_box((-1, -1, 0.5), (1, 1, 1.5)), _in_box((-1, -1, -0.5), (1, 1, -0.2)),
    ),
    SurfaceCase(
        "tilted_plane", Plane, {"point": np.array([0.1, -0.2, 0.3]), "normal": np.array([0.3, -0.2, 1.0])},
        _in_box((-1, -1, 1.5), (1, 1, 2.0)), _in_box((-1, -1, -1.0), (1, 1, -0.6)),
    ),
    SurfaceCase(
        "rectangle", Rectangle, {**_PLATE, "half_size": np.array([0.6, 0.4])},
        _shell(_PLATE["center"], 1.2, 1.6),
        _in_frame(_PLATE["center"], (0.6, 0.4, 0.0), frame_of(_PLATE["normal"], _PLATE["tangent"])),
    ),
    SurfaceCase(
        "box", Box, _BOX, _shell(_BOX["center"], 1.2, 1.6), _in_frame(_BOX["center"], _BOX["half_size"], np.eye(3)),
    ),
    SurfaceCase(
        "rotated_box", Box, {**_BOX, "rotation": _TURN},
        _shell(_BOX["center"], 1.2, 1.6), _in_frame(_BOX["center"], _BOX["half_size"], axes_of(_TURN)),
    ),
    SurfaceCase(
        "sphere_outside", Sphere, _GLOBE, _shell(_GLOBE["center"], 1.0, 1.5), _shell(_GLOBE["center"], 0.0, 0.4),
    ),
    SurfaceCase(
        "sphere_inside", lambda **numbers: Sphere(**numbers, inside=True), _BOWL,
        _shell(_BOWL["center"], 0.0, 0.6), _shell(_BOWL["center"], 1.3, 1.6),
    ),
    SurfaceCase(
        "cylinder_outside", Cylinder, _POST,
        _around_axis(_POST["point"], _POST["axis"], 0.8, 1.2), _around_axis(_POST["point"], _POST["axis"], 0.0, 0.3),
    ),
    SurfaceCase(
        "cylinder_inside", lambda **numbers: Cylinder(**numbers, inside=True), _PIPE,
        _around_axis(_PIPE["point"], _PIPE["axis"], 0.0, 0.5), _around_axis(_PIPE["point"], _PIPE["axis"], 1.2, 1.5),
    ),
    SurfaceCase(
        "hole", Hole, _PIT, _in_frame(_PIT["center"], (0.6, 0.6, 0.2), _PIT_AXES, (0.0, 0.0, 0.6)),
        _ring(_PIT["center"], _PIT_AXES, (0.45, 1.0), (-0.5, -0.2)),
    ),
    SurfaceCase(
        "implicit", _hills, {"amplitude": 0.2, "height": 0.1},
        _in_box((-1, -1, 0.6), (1, 1, 1.5)), _in_box((-1, -1, -0.6), (1, 1, -0.3)),
    ),
)  # fmt: skip


# Motions

all_motions = {
    "exact": Exact(),
    "tsit5": Integrated(rtol=1e-10, atol=1e-10),
    "heun": Integrated(solver=diffrax.Heun(), stepsize_controller=diffrax.ConstantStepSize(), dt0=0.021, max_steps=64),
}


def named(cases):
    """The arguments of `pytest.mark.parametrize` for cases that have names."""
    return {"argvalues": cases, "ids": [case.name for case in cases]}


# States


def generator(key) -> np.random.Generator:
    return np.random.default_rng(np.asarray(jax.random.key_data(key)))


def states(position, velocity, spin, dtype=np.float64) -> BallState:
    return BallState(*[jnp.asarray(np.asarray(x, dtype)) for x in (position, velocity, spin)])


def throws(case: SurfaceCase, key, n: int, *, gravity=GRAVITY, flight=(0.25, 0.4), dtype=np.float64) -> BallState:
    """`n` states that hit the surface before they have flown for `flight[1]` seconds, with spins of a few turns per
    second. The gap is positive at the start for a ball of radius 0.1."""
    rng = generator(key)
    start, target = case.starts(rng, n), case.targets(rng, n)
    time = rng.uniform(*flight, (n, 1))
    velocity = (target - start) / time - 0.5 * np.asarray(gravity) * time
    return states(start, velocity, rng.normal(0.0, 10.0, (n, 3)), dtype)


def lane(tree, i):
    """One lane of a batch."""
    return jax.tree.map(lambda x: x[i] if eqx.is_array(x) else x, tree)


def arrays(numbers: dict, dtype=np.float64) -> dict:
    return {name: jnp.asarray(np.asarray(value, dtype)) for name, value in numbers.items()}


def scene_of(case: SurfaceCase, law, *, ball=None, numbers=None, gravity=GRAVITY, air=None) -> Scene:
    """A scene with one surface, `it`. Numbers default to the constants of this file."""
    surface = case.build(law=law, **(case.numbers if numbers is None else numbers))
    return Scene(
        Ball(**(BALL if ball is None else ball)), {"it": surface}, gravity, None if air is None else Air(**air)
    )


def stacked(state: BallState):
    """Position, velocity and spin in one array (..., 9)."""
    return jnp.concatenate([state.position, state.velocity, state.spin], axis=-1)


def result_of(trajectory) -> str:
    """The name of the result of one trajectory."""
    return result_name(trajectory.result)


def results_of(trajectory) -> list[str]:
    """The names of the results of a batch."""
    return [result_name(lane(trajectory.result, i)) for i in range(len(trajectory.t1))]


def turned_axes(quaternion):
    """`axes_of`, for JAX arrays."""
    w, v = quaternion[0], quaternion[1:]
    size = jnp.sqrt(jnp.sum(quaternion * quaternion))
    w, v = w / size, v / size
    rows = [e + 2 * w * jnp.cross(v, e) + 2 * jnp.cross(v, jnp.cross(v, e)) for e in jnp.eye(3, dtype=v.dtype)]
    return jnp.stack(rows)
