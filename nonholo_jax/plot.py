"""Pictures of a throw: the room from the side, the path, the impacts with their spin, and energy and spin in time.

Nothing here touches `pyplot` or `rcParams`: a figure is a plain `matplotlib.figure.Figure`, drawn by Agg when saved.
Lengths on paper are in points (1/72 inch); `Panel.point` is one of them in metres.
"""

from functools import singledispatch
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ._scene import Scene
from ._surface import AbstractSurface, Box, Cylinder, Plane, Rectangle, Sphere
from ._types import RESULTS, is_success, result_name


if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
else:  # matplotlib is loaded only when a picture is drawn
    Axes = Figure = Any

_NUMBERED = 9
_FULL_TURN = 300.0  # degrees of arc for the fastest spin drawn
_SMALLEST_BALL = 4.5  # radius in points
_INK, _FAINT, _SOLID = "#222222", "#9a9a9a", "#dcdcd6"
_ENERGIES = {"total": _INK, "translational": "#0072B2", "rotational": "#D55E00", "potential": "#009E73"}
_SPINS = {"x": "#CC79A7", "y": "#7A4FA3", "z": "#B8860B"}


# What happened, in NumPy


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
    position: np.ndarray
    normal: np.ndarray
    spin: np.ndarray  # just after


def _array(x: Any) -> np.ndarray:
    return np.asarray(x, dtype=float)


def _sample(trajectory: Any, end: float) -> tuple[Samples, Strikes]:
    log, start = trajectory.impacts, float(trajectory.t0)
    shown = (np.asarray(log.surface) >= 0) & (_array(log.time) <= end)
    times = _array(log.time)[shown]
    bounds = np.array([start, *times, end])
    per_arc = int(np.clip(1200 // (len(times) + 1), 8, 240))
    inner = np.linspace(bounds[:-1], bounds[1:], per_arc)[1:-1].T
    asked = np.concatenate([[start, end], inner.ravel()])
    padded = np.full(-(-asked.size // 512) * 512, start)  # few sizes, few compilations
    padded[: asked.size] = asked
    state = trajectory.at(jnp.asarray(padded, dtype=trajectory.t1.dtype))
    columns = []
    for name in ("position", "velocity", "spin"):
        values, before, after = (_array(getattr(s, name)) for s in (state, log.before, log.after))
        before, after = before[shown], after[shown]
        first = before[:1] if len(times) and times[0] == start else values[:1]
        opens, closes = np.concatenate([first, after]), np.concatenate([before, values[1:2]])
        middle = values[2 : asked.size].reshape(len(bounds) - 1, per_arc - 2, 3)
        columns.append(np.concatenate([opens[:, None], middle, closes[:, None]], axis=1).reshape(-1, 3))
    clock = np.concatenate([bounds[:-1, None], inner, bounds[1:, None]], axis=1).ravel()
    samples = Samples(clock, *columns, np.repeat(np.arange(len(bounds) - 1), per_arc))
    good = np.isfinite(samples.position).all(axis=1)
    samples = Samples(*(column[good] for column in samples))
    after, normal = log.after, _array(log.normal)[shown]
    strikes = Strikes(times, np.asarray(log.surface)[shown], _array(after.position)[shown], normal,
                      _array(after.spin)[shown])  # fmt: skip
    return samples, strikes


def _energies(scene: Scene, samples: Samples) -> dict[str, np.ndarray]:
    """In J; the potential energy is zero at the origin of the room."""
    mass, inertia, gravity = (_array(x) for x in (scene.ball.mass, scene.ball.inertia, scene.gravity))
    parts = {
        "translational": 0.5 * mass * np.sum(samples.velocity**2, axis=1),
        "rotational": 0.5 * inertia * np.sum(samples.spin**2, axis=1),
        "potential": -mass * samples.position @ gravity,
    }
    return {"total": sum(parts.values()), **parts}  # pyright: ignore[reportReturnType]


# How it is looked at


class View(NamedTuple):
    """A direction to look along. `toward` points to the viewer, so that positive spin about it is anticlockwise."""

    right: np.ndarray
    up: np.ndarray
    toward: np.ndarray
    depth: float  # of the picture plane, along `toward`
    planar: bool  # the motion stays in the picture plane: surfaces are cut there, else seen in outline

    def flat(self, x: Any) -> np.ndarray:
        return np.stack([_array(x) @ self.right, _array(x) @ self.up], axis=-1)


def _view(right: np.ndarray, up: np.ndarray, position: np.ndarray, tiny: float) -> View:
    toward = np.cross(right, up)
    depths = position @ toward
    return View(right, up, toward, float(np.mean(depths)), bool(np.ptp(depths) <= tiny))


def _views(scene: Scene, position: np.ndarray) -> tuple[View, View]:
    """From the side, the largest horizontal extent of the path to the right and gravity down; and from above."""
    gravity = _array(scene.gravity)
    strength = np.linalg.norm(gravity)
    up = -gravity / strength if strength > 0 else np.array([0.0, 0.0, 1.0])
    up = up + 0.0  # no negative zeros in labels
    level = np.eye(3) - np.outer(up, up)
    spread = (position - position.mean(axis=0)) @ level
    tiny = 1e-3 * (np.ptp(position, axis=0).max() + float(scene.ball.radius))
    sizes, directions = np.linalg.eigh(spread.T @ spread)
    right = directions[:, -1]
    if np.sqrt(sizes[-1] / len(position)) < tiny:  # straight up and down
        right = level[np.argmax(np.diag(level))]
    right = right / np.linalg.norm(right)
    right = right * np.sign(right[np.argmax(np.abs(right))]) + 0.0
    for axis in np.eye(3):  # an axis of the room if it is nearly one, unless the motion is planar across it
        aligned = axis @ up == 0 and axis @ right > np.cos(np.radians(20))
        if aligned and (np.ptp(spread @ np.cross(axis, up)) <= tiny or np.ptp(spread @ np.cross(right, up)) > tiny):
            right = axis
    return _view(right, up, position, tiny), _view(right, np.cross(up, right) + 0.0, position, 0.0)


def _axis_name(direction: np.ndarray) -> str:
    for axis, name in zip(np.eye(3), "xyz", strict=True):
        if abs(axis @ direction) > 1 - 1e-12:
            return f"{name} (m)" if axis @ direction > 0 else f"\N{MINUS SIGN}{name} (m)"
    return "along ({}) (m)".format(", ".join(f"{c:.2f}" for c in direction).replace("-", "\N{MINUS SIGN}"))


# What a surface looks like


class Shape(NamedTuple):
    """A line in the picture plane with the solid on one side (`inward`, unit vectors), or a filled polygon."""

    points: np.ndarray
    inward: np.ndarray | None = None
    cut: bool = True  # False: not in the picture plane, seen in front of it or behind


def _hull(points: np.ndarray) -> np.ndarray:
    """Convex hull by Andrew's monotone chain."""
    ordered = sorted({(round(float(x), 12), round(float(y), 12)) for x, y in points})
    hull: list = []
    for sweep in (ordered, ordered[::-1]):
        chain: list = []
        for p in sweep:
            while len(chain) > 1 and np.linalg.det([np.subtract(chain[-1], chain[-2]), np.subtract(p, chain[-2])]) <= 0:
                chain.pop()
            chain.append(p)
        hull += chain[:-1]
    return np.array(hull or ordered)


def _line(at: np.ndarray, along: np.ndarray, inward: np.ndarray, middle: np.ndarray, reach: float) -> Shape:
    at = at + along * (along @ (middle - at))
    points = at + np.linspace(-reach, reach, 201)[:, None] * along
    return Shape(points, np.broadcast_to(inward, points.shape))


def _circle(center: np.ndarray, radius: float, inside: bool, cut: bool = True) -> Shape:
    angle = np.linspace(0, 2 * np.pi, 361)
    out = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    return Shape(center + radius * out, out if inside else None, cut)


@singledispatch
def _shapes(surface: AbstractSurface, view: View, middle: np.ndarray, reach: float, radius: float) -> list[Shape]:
    """Any surface: where the ball's centre touches it in the picture plane, moved by a radius against the normal."""
    from contourpy import contour_generator

    ticks = np.linspace(-reach, reach, 241)
    h, v = np.meshgrid(middle[0] + ticks, middle[1] + ticks)
    lift = lambda h, v: h[..., None] * view.right + v[..., None] * view.up + view.depth * view.toward  # noqa: E731
    every = lambda f, x: _array(jax.jit(jax.vmap(f))(jnp.asarray(x.reshape(-1, 3), dtype=float)))  # noqa: E731
    gaps = every(lambda x: surface.gap(x, 0.0, radius), lift(h, v)).reshape(h.shape)
    shapes = []
    for line in contour_generator(h, v, gaps).lines(0.0):
        points = np.asarray(line)
        normal = view.flat(every(lambda x: surface.normal(x, 0.0), lift(points[:, 0], points[:, 1])))
        inward = -normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
        shapes.append(Shape(points - radius * normal, inward))
    return shapes


@_shapes.register
def _(surface: Plane, view: View, middle: np.ndarray, reach: float, radius: float) -> list[Shape]:
    n, p = _array(surface.facing), _array(surface.point)
    n = n / np.linalg.norm(n)
    across = view.flat(n)
    steep = float(np.linalg.norm(across))
    if steep < (1e-6 if view.planar else 0.5):  # parallel to the picture, or too oblique to be a line in it
        return []
    offset = (n @ p - view.depth * (n @ view.toward)) / steep
    across = across / steep
    return [_line(offset * across, np.array([-across[1], across[0]]), -across, middle, reach)]


@_shapes.register(Box)
@_shapes.register(Rectangle)
def _(surface: Any, view: View, middle: np.ndarray, reach: float, radius: float) -> list[Shape]:
    center, half, axes = (_array(part) for part in surface._frame())
    signs = np.array(np.meshgrid(*[[-1, 1]] * 3)).reshape(3, -1).T
    corners = center + (signs * half) @ axes
    if not view.planar:
        return [Shape(_hull(view.flat(corners)))]
    height = corners @ view.toward - view.depth
    cuts = []
    for i, j in np.argwhere(np.abs(signs[:, None] - signs).sum(axis=-1) == 2):
        if height[i] <= 0 < height[j]:
            cuts.append(corners[i] + (corners[j] - corners[i]) * height[i] / (height[i] - height[j]))
    return [Shape(_hull(view.flat(np.array(cuts)))) if cuts else Shape(_hull(view.flat(corners)), cut=False)]


@_shapes.register
def _(surface: Sphere, view: View, middle: np.ndarray, reach: float, radius: float) -> list[Shape]:
    center, size = _array(surface.center), float(surface.radius)
    away = center @ view.toward - view.depth
    cut = not view.planar or abs(away) < size
    section = np.sqrt(size**2 - away**2) if view.planar and cut else size
    return [_circle(view.flat(center), section, surface.inside, cut)]


@_shapes.register
def _(surface: Cylinder, view: View, middle: np.ndarray, reach: float, radius: float) -> list[Shape]:
    point, axis, size = _array(surface.point), _array(surface.axis), float(surface.radius)
    axis = axis / np.linalg.norm(axis)
    facing = axis @ view.toward
    if abs(facing) > (1e-6 if view.planar else 0.99):  # an ellipse: slide the circle along the axis into the plane
        first = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
        first = first / np.linalg.norm(first)
        angle = np.linspace(0, 2 * np.pi, 361)[:, None]
        out = np.cos(angle) * first + np.sin(angle) * np.cross(axis, first)
        rim = point + size * out
        rim = rim - ((rim @ view.toward - view.depth) / facing)[:, None] * axis
        outward = view.flat(out) / np.linalg.norm(view.flat(out), axis=1, keepdims=True)
        return [Shape(view.flat(rim), outward if surface.inside else None)]
    along = view.flat(axis) / np.linalg.norm(view.flat(axis))
    across = np.array([-along[1], along[0]])
    away = (point @ view.toward - view.depth) * float(view.planar)
    section = np.sqrt(max(size**2 - away**2, 0.0))
    sides = [_line(view.flat(point) + s * section * across, along, s * across, middle, reach) for s in (-1.0, 1.0)]
    if section == 0 or surface.inside:
        return sides if section > 0 else []
    return [Shape(np.concatenate([sides[0].points, sides[1].points[::-1]]))]
