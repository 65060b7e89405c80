"""What a room looks like from one direction: its surfaces as lines and polygons in the plane of a picture."""

from functools import singledispatch
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from .._world import AbstractSurface, Box, Cylinder, Hole, Plane, Rectangle, Scene, Sphere

MINUS = "\N{MINUS SIGN}"


def as_numpy(x: Any) -> np.ndarray:
    return np.asarray(x, dtype=float)


class View(NamedTuple):
    """A direction to look along. `toward` points to the viewer, so that positive spin about it is anticlockwise."""

    right: np.ndarray
    up: np.ndarray
    toward: np.ndarray
    depth: float  # of the picture plane, along `toward`
    planar: bool  # the motion stays in the picture plane: surfaces are cut there, else seen in outline

    def flat(self, x: Any) -> np.ndarray:
        return np.stack([as_numpy(x) @ self.right, as_numpy(x) @ self.up], axis=-1)


def _view(right: np.ndarray, up: np.ndarray, position: np.ndarray, tiny: float) -> View:
    toward = np.cross(right, up)
    depths = position @ toward
    return View(right, up, toward, float(np.mean(depths)), bool(np.ptp(depths) <= tiny))


def views(scene: Scene, position: np.ndarray) -> tuple[View, View]:
    """From the side, the largest horizontal extent of the path to the right and gravity down; and from above."""
    gravity = as_numpy(scene.gravity)
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
    if np.ptp(spread @ np.cross(right, up)) > tiny:  # not planar: an axis of the room, so that walls are lines
        axes = [axis for axis in np.eye(3) if abs(axis @ up) < 1e-12]
        wide = 0.7 * max([np.ptp(position @ axis) for axis in axes], default=0.0)
        right = next((axis for axis in axes if np.ptp(position @ axis) >= wide), right)
    right = right * np.sign(right[np.argmax(np.abs(right))]) + 0.0
    right[np.abs(right) < 1e-9] = 0.0
    return _view(right, up, position, tiny), _view(right, np.cross(up, right) + 0.0, position, 0.0)


def axis_name(direction: np.ndarray, plus: str = "") -> str:
    """`x` for the first axis of the room, with a sign if it is a negative one, and a vector for any other direction."""
    for axis, name in zip(np.eye(3), "xyz", strict=True):
        if abs(axis @ direction) > 1 - 1e-12:
            return f"{plus if axis @ direction > 0 else MINUS}{name}"
    return "({})".format(", ".join(f"{c:.2f}" if abs(c) > 1e-9 else "0" for c in direction).replace("-", MINUS))


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
    points = at + np.linspace(-reach, reach, 2001)[:, None] * along
    return Shape(points, np.broadcast_to(inward, points.shape))


def _circle(center: np.ndarray, radius: float, inside: bool, cut: bool = True) -> Shape:
    angle = np.linspace(0, 2 * np.pi, 361)
    out = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    return Shape(center + radius * out, out if inside else None, cut)


def _perpendicular(axis: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Two unit vectors that complete one to an orthonormal frame."""
    first = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    first = first / np.linalg.norm(first)
    return first, np.cross(axis, first)


@singledispatch
def shapes(surface: AbstractSurface, view: View, middle: np.ndarray, reach: float, radius: float) -> list[Shape]:
    """Any surface: where the ball's centre touches it in the picture plane, moved by a radius against the normal."""
    from contourpy import contour_generator

    ticks = np.linspace(-reach, reach, 241)
    h, v = np.meshgrid(middle[0] + ticks, middle[1] + ticks)
    lift = lambda h, v: h[..., None] * view.right + v[..., None] * view.up + view.depth * view.toward  # noqa: E731
    every = lambda f, x: as_numpy(jax.jit(jax.vmap(f))(jnp.asarray(x.reshape(-1, 3), dtype=float)))  # noqa: E731
    gaps = every(lambda x: surface.gap(x, 0.0, radius), lift(h, v)).reshape(h.shape)
    found = []
    for line in contour_generator(h, v, gaps).lines(0.0):
        points = np.asarray(line)
        normal = view.flat(every(lambda x: surface.normal(x, 0.0), lift(points[:, 0], points[:, 1])))
        inward = -normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
        found.append(Shape(points - radius * normal, inward))
    return found


@shapes.register
def _(surface: Plane, view: View, middle: np.ndarray, reach: float, radius: float) -> list[Shape]:
    n, p = as_numpy(surface.facing), as_numpy(surface.point)
    n = n / np.linalg.norm(n)
    across = view.flat(n)
    steep = float(np.linalg.norm(across))
    if steep < (1e-6 if view.planar else 0.5):  # parallel to the picture, or too oblique to be a line in it
        return []
    offset = (n @ p - view.depth * (n @ view.toward)) / steep
    across = across / steep
    return [_line(offset * across, np.array([-across[1], across[0]]), -across, middle, reach)]


@shapes.register(Box)
@shapes.register(Rectangle)
def _(surface: Any, view: View, middle: np.ndarray, reach: float, radius: float) -> list[Shape]:
    center, half, axes = (as_numpy(part) for part in surface._frame())
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


@shapes.register
def _(surface: Sphere, view: View, middle: np.ndarray, reach: float, radius: float) -> list[Shape]:
    center, size = as_numpy(surface.center), float(surface.radius)
    away = float(center @ view.toward) - view.depth
    cut = not view.planar or abs(away) < size
    section = (size**2 - away**2) ** 0.5 if view.planar and cut else size
    return [_circle(view.flat(center), section, surface.inside, cut)]


@shapes.register
def _(surface: Cylinder, view: View, middle: np.ndarray, reach: float, radius: float) -> list[Shape]:
    point, axis, size = as_numpy(surface.point), as_numpy(surface.axis), float(surface.radius)
    axis = axis / np.linalg.norm(axis)
    facing = axis @ view.toward
    if abs(facing) > (1e-6 if view.planar else 0.99):  # an ellipse: slide the circle along the axis into the plane
        first, second = _perpendicular(axis)
        angle = np.linspace(0, 2 * np.pi, 361)[:, None]
        out = np.cos(angle) * first + np.sin(angle) * second
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


@shapes.register
def _(surface: Hole, view: View, middle: np.ndarray, reach: float, radius: float) -> list[Shape]:
    center, n, size = as_numpy(surface.center), as_numpy(surface.facing), float(surface.radius)
    n = n / np.linalg.norm(n)
    at, up, away = view.flat(center), view.flat(n), float(center @ view.toward) - view.depth
    if view.planar and abs(np.linalg.norm(up) - 1) > 1e-9:  # a section that is no right angle
        return shapes.dispatch(AbstractSurface)(surface, view, middle, reach, radius)
    if view.planar and abs(away) < size:
        return _section_of_hole(at, up, (size**2 - away**2) ** 0.5, middle, reach)
    found = shapes(Plane(surface.center, surface.facing, surface.law), view, middle, reach, radius)
    if view.planar:
        return found
    if abs(n @ view.toward) > 0.1:  # the rim is seen
        first, second = _perpendicular(n)
        angle = np.linspace(0, 2 * np.pi, 361)[:, None]
        out = view.flat(np.cos(angle) * first + np.sin(angle) * second)
        found.append(Shape(at + size * out, out / np.linalg.norm(out, axis=1, keepdims=True)))
    else:  # what is below the ground is hidden
        across, deep = np.array([-up[1], up[0]]), (reach + abs(up @ (middle - at))) * up
        found.append(Shape(np.array([at - size * across, at - size * across - deep, at + size * across - deep,
                                     at + size * across]), cut=False))  # fmt: skip
    return found


def _section_of_hole(at: np.ndarray, up: np.ndarray, half: float, middle: np.ndarray, reach: float) -> list[Shape]:
    """The ground to the left and to the right of a hole, and the wall below it."""
    found, across = [], np.array([-up[1], up[0]])
    far, deep = (reach + abs(axis @ (middle - at)) for axis in (across, up))
    ticks = np.linspace(0, 1, 1001)[:, None]
    for out in (-across, across):
        ground, wall = at + (half + far * ticks[::-1]) * out, at + half * out - deep * ticks * up
        inward = np.concatenate([np.broadcast_to(-up, ground.shape), np.broadcast_to(out, wall.shape)])
        found.append(Shape(np.concatenate([ground, wall]), inward))
    return found


def half_plane(shape: Shape, reach: float) -> np.ndarray:
    """The corners of the solid behind a straight wall; empty for any other shape."""
    if shape.inward is None or np.ptp(shape.inward, axis=0).max() > 0:
        return np.zeros((0, 2))
    ends = shape.points[[0, -1]]
    return np.vstack([ends, ends[::-1] + 2 * reach * shape.inward[:1]])


def room(scene: Scene, view: View, middle: np.ndarray, reach: float) -> list[list[Shape]]:
    """The shapes of every surface within `reach` of `middle`. Straight walls end where they meet, as a room does."""
    found = [shapes(surface, view, middle, reach, float(scene.ball.radius)) for surface in scene.surfaces]
    straight = [shape for each in found for shape in each if len(half_plane(shape, reach))]
    walls = [(shape.points[0], shape.inward[0]) for shape in straight if shape.inward is not None]

    def visible(shape: Shape) -> Shape:
        if shape.inward is None or not len(half_plane(shape, reach)):
            return shape
        free = [(shape.points - at) @ into < 1e-9 * reach for at, into in walls]
        keep = np.all(free, axis=0)
        return shape._replace(points=shape.points[keep], inward=shape.inward[keep])

    return [[shape for shape in map(visible, each) if len(shape.points) > 1] for each in found]
