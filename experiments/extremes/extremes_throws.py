"""Throws with extreme numbers, each a lane of one of three compiled programs, and the cells that judge them."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from extremes_truth import CONVEX, ROUNDINGS, SLAB, box, exact, slab, slopes, sphere, spread, values

from nonholo_jax import Ball, BallState, Box, Plane, Rough, Scene, Sphere, simulate
from nonholo_jax._math.types import NAMES_OF_RESULTS

DTYPES = (np.float32, np.float64)
COLUMNS = tuple(f"{np.dtype(dtype)} {what}" for dtype in DTYPES for what in ("value", "gradient"))
OK = ("reached_t1", "at_rest")


class Cell(NamedTuple):
    """The error that comes nearest to its bound (or breaks it), and the names of results that are not ok."""

    error: float
    bound: float
    names: tuple[str, ...] = ()
    expected: tuple[str, ...] = ()
    open: int = 0  # how many throws there are whose inputs, as they are rounded, do not determine an answer

    @property
    def passes(self) -> bool:
        """A NaN does not, nor a result that nobody expects."""
        return self.error <= self.bound and set(self.names) <= set(self.expected)

    def __str__(self):
        number = "" if self.bound == 0 and self.error == 0 and self.names else f"{self.error:.0e} < {self.bound:.0e}"
        text = " ".join([*([number] if number else []), *self.names, *([f"({self.open} open)"] if self.open else [])])
        return text.replace("e-0", "e-").replace("e+0", "e+") + ("" if self.passes else " FAIL")


def worst(cells: Sequence[Cell]) -> Cell:
    """One cell for several throws."""

    def rank(cell: Cell) -> tuple:
        part = cell.error / cell.bound if cell.bound else 0.0
        return not cell.passes, cell.bound < 1, np.inf if np.isnan(part) else part

    top = max(cells, key=rank)
    names, expected = (
        tuple(sorted({name for cell in cells for name in getattr(cell, of)})) for of in Cell._fields[2:4]
    )
    return Cell(top.error, top.bound, names, expected, sum(bool(cell.bound >= 1) for cell in cells))


# Two families of throws, each one compiled program for all of its extremes


class Throw(NamedTuple):
    row: str
    numbers: dict[str, Any]  # a function is called with eps
    expected: tuple[str, ...] = ()


class Family(NamedTuple):
    inputs: tuple[str, ...]
    base: dict[str, float]
    model: Callable
    run: Callable  # from an array of inputs to the outputs and (result, number of impacts)
    units: Callable  # of the inputs that are zero, and of the outputs
    one_sided: tuple[str, ...] = ()  # derivatives from above where one of these is zero

    def lane(self, throw: Throw, dtype: Any) -> np.ndarray:
        numbers = {**self.base, **throw.numbers}
        eps = float(np.finfo(dtype).eps)
        return np.array([x(eps) if callable(x) else x for x in (numbers[name] for name in self.inputs)], dtype)


def vector(*items: Any) -> Any:
    like = next(x for x in items if isinstance(x, jax.Array))
    return jnp.stack([jnp.asarray(x, like.dtype) for x in items])


def slab_scene(p: Any, law: Rough) -> Scene:
    floor = Plane(vector(0.0, 0.0, p[12]), (0.0, 0.0, 1.0), law)
    ceiling = Plane(vector(0.0, 0.0, p[13]), (0.0, 0.0, -1.0), law)
    ball = Ball(radius=p[7], mass=p[6], inertia_ratio=p[5])
    return Scene(ball, {"floor": floor, "ceiling": ceiling}, gravity=vector(p[10], 0.0, p[11]))


def slab_state(p: Any) -> BallState:
    return BallState(vector(p[0], 0.0, p[1]), vector(p[2], 0.0, p[3]), vector(0.0, p[4], 0.0))


def slab_outputs(state: BallState) -> Any:
    return vector(state.position[0], state.position[2], state.velocity[0], state.velocity[2], state.spin[1])


def run_slab(p: Any, law: Any = None, max_impacts: int = 16, **options: Any) -> tuple:
    scene = slab_scene(p, Rough(p[8], p[9]) if law is None else law)
    end = simulate(scene, slab_state(p), t1=p[14], max_impacts=max_impacts, log_size=0, throw=False, **options)
    return slab_outputs(end.final), (end.result._value, end.n_impacts)  # pyright: ignore[reportAttributeAccessIssue]


def slab_units(p: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    x, _, vx, vz, spin, _, _, r, _, _, gx, gz, floor, ceiling, _ = np.abs(p.astype(float))
    length = abs(float(p[13]) - float(p[12]))
    speed = max(vx, vz, r * spin, (np.hypot(gx, gz) * length) ** 0.5)
    pull = speed**2 / length
    inputs = [length, length, speed, speed, speed / r, 1, 1, r, 1, 1, pull, pull, length, length, 1]
    return np.array(inputs), np.array([length, length, speed, speed, speed / r])


def run_convex(p: Any, surface: Any) -> tuple:
    scene = Scene(Ball(radius=p[10], mass=1.0, inertia_ratio=p[9]), {"it": surface}, gravity=(0.0, 0.0, 0.0))
    end = simulate(scene, BallState(p[:3], p[3:6], p[6:9]), t1=p[16], max_impacts=16, log_size=0, throw=False)
    outputs = jnp.concatenate([end.final.position, end.final.velocity, end.final.spin])
    return outputs, (end.result._value, end.n_impacts)  # pyright: ignore[reportAttributeAccessIssue]


def run_box(p: Any) -> tuple:
    return run_convex(p, Box(center=(0.0, 0.0, 0.0), half_size=p[13:16], law=Rough(p[11], p[12])))


def run_sphere(p: Any) -> tuple:
    return run_convex(p, Sphere(center=(0.0, 0.0, 0.0), radius=p[13], law=Rough(p[11], p[12])))


def convex_units(p: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    q = p.astype(float)
    length, r = np.abs(q[13:16]).max(), q[10]
    speed = max(np.linalg.norm(q[3:6]), np.linalg.norm(q[6:9]) * r)
    inputs = [length] * 3 + [speed] * 3 + [speed / r] * 3 + [1.0, r, 1.0, 1.0] + [length] * 3 + [1.0]
    return np.array(inputs), np.array([length] * 3 + [speed] * 3 + [speed / r] * 3)


SLABS = Family(
    SLAB,
    {
        "x": 0.1, "z": 0.6, "vx": 1.3, "vz": -2.1, "spin": 7.0, "alpha": 0.4, "mass": 0.05, "radius": 0.1, "e": 0.9,
        "e_t": 0.5, "gx": 0.3, "gz": -9.81, "floor": 0.0, "ceiling": 1.2, "t1": 1.0,
    },
    slab, run_slab, slab_units, ("e",),
)  # fmt: skip
_CONVEX = {
    "x": -1.5, "y": 0.1, "z": 0.05, "vx": 1.0, "vy": 0.0, "vz": 0.0, "wx": 0.5, "wy": 3.0, "wz": -2.0, "alpha": 0.4,
    "radius": 0.125, "e": 1.0, "e_t": -1.0, "a": 0.5, "b": 0.5, "c": 0.5, "t1": 2.5,
}  # fmt: skip
BOXES = Family(CONVEX, _CONVEX, box, run_box, convex_units)
SPHERES = Family(CONVEX, _CONVEX, sphere, run_sphere, convex_units)


def slab_throws() -> list[Throw]:
    """Whatever is not named is that of the base throw; lengths, times and speeds grow together where they must."""
    throws = []

    def add(row: str, **numbers: Any) -> None:
        throws.append(Throw(row, numbers))

    for a in (1e-9, 1e-6, 1e-3, 1e3, 1e6, 1e9):
        add("inertia ratio 1e-9 to 1e9", alpha=a)
    for m in (1e-12, 1e-6, 1e6, 1e12):
        add("mass 1e-12 to 1e12 kg", mass=m)
    for r in (1e-12, 1e-6, 1e-3, 1e3, 1e6, 1e12):
        size = max(1.0, r)  # the room grows with the ball, which it has to hold
        add("radius 1e-12 to 1e12 m", radius=r, z=r + 0.6 * size, ceiling=2 * r + 1.2 * size, vx=1.3 * size,
            vz=-2.1 * size, gz=-9.81 * size, spin=7.0 * size / r)  # fmt: skip
        add("all lengths 1e-12 to 1e12 m", radius=0.1 * r, x=0.1 * r, z=0.6 * r, ceiling=1.2 * r, vx=1.3 * r,
            vz=-2.1 * r, gx=0.3 * r, gz=-9.81 * r)  # fmt: skip
    for v in (1e-9, 1e-6, 1e-3, 1e3, 1e6, 1e9):
        fast = {"vx": 1.3 * v, "vz": -2.1 * v, "spin": 7.0 * v, "gx": 0.0}
        add("speed 1e-9 to 1e9 m/s", **fast, t1=min(1.0, 3.0 / v))
        add("the same without gravity", **fast, gz=0.0, t1=1.0 / v)
    for e in (0.0, 1e-9, lambda eps: 1.0 - eps, 1.0):
        add("restitution 0, 1e-9, 1 - eps, 1", e=e)
    for angle in 10.0 ** -np.arange(1, 13):
        add("grazing a plane, 0.1 to 1e-12 rad", vx=1.0, vz=-angle, z=0.1 + 0.5 * angle, gx=0.0, gz=0.0)
    for gx, gz in ((0.0, 0.0), (0.0, 9.81), (9.81, 0.0)):
        add("gravity zero, upward, sideways", gx=gx, gz=gz)
    far = {"x": 1e6 + 0.1, "z": 1e6 + 0.6, "floor": 1e6, "ceiling": 1e6 + 1.2}
    add("scene 1e6 m from the origin", **far)
    add("t1 = 1e6 s, slow flight", vx=1.3e-6, vz=-2.1e-6, spin=7e-6, gx=0.0, gz=0.0, t1=1e6)
    add("t1 = 1e6 s, rolling", e=0.5, gx=0.0, t1=1e6)
    return throws


def convex_throws() -> tuple[list[Throw], list[Throw]]:
    """Against a cube of 1 m and a sphere of 0.5 m radius; e_t = -1 leaves the slip alone, as a smooth wall does."""
    ball, boxes, spheres = 0.125, [], []
    for e_t in (-1.0, 0.5):
        boxes += [
            Throw("head-on at an edge, a corner", {"x": -1.5, "z": 1.5, "vz": -1.0, "e_t": e_t}),
            Throw("head-on at an edge, a corner", {"x": -1.5, "y": 1.5, "z": 1.5, "vy": -1.0, "vz": -1.0, "e_t": e_t}),
            Throw("onto the line between face and edge", {"x": 0.5, "z": 1.5, "vx": 0.0, "vz": -1.0, "e_t": e_t}),
            Throw("onto the point between face and corner",
                  {"x": 0.5, "y": 0.5, "z": 1.5, "vx": 0.0, "vz": -1.0, "e_t": e_t}),
        ]  # fmt: skip
    touch = ball / 3.0**0.5
    boxes += [
        Throw("touching an edge exactly", {"x": 0.575 - 1.6, "z": 0.6 + 1.2, "vx": 0.8, "vz": -0.6}),
        Throw("touching an edge exactly", {"y": 0.5 + 0.075, "z": 0.6}),  # all along the edge
        Throw("touching an edge exactly", {"z": 0.5 + ball}),  # all along the face
        Throw("touching a corner exactly", {"x": 0.5 + touch - 1.0, "y": 0.5 + touch, "z": 0.5 + touch + 1.0,
                                            "vx": 1.0, "vz": -1.0}),
    ]  # fmt: skip
    for angle in 10.0 ** -np.arange(1, 13):
        height = (0.5 + ball) * np.cos(angle)
        spheres.append(Throw("grazing a sphere, 0.1 to 1e-12 rad", {"y": 0.0, "z": height}))
    return boxes, spheres


def with_slopes(run: Callable) -> Callable:
    """The value, both Jacobians and how it ended, of a batch of inputs: one program."""
    values_of = lambda p: run(p)[0]  # noqa: E731
    return jax.jit(jax.vmap(lambda p: (*run(p), jax.jacfwd(values_of)(p), jax.jacrev(values_of)(p))))


def judged(family: Family, throws: Sequence[Throw], dtype: Any, program: Callable) -> list[tuple[str, Cell, Cell]]:
    """A value cell and a gradient cell for each throw."""
    eps = float(np.finfo(dtype).eps)
    lanes = np.stack([family.lane(throw, dtype) for throw in throws])
    found, (codes, _), forward, reverse = jax.tree.map(np.asarray, program(jnp.asarray(lanes)))
    cells = []
    for i, throw in enumerate(throws):
        p, (inputs, outputs) = exact(lanes[i]), family.units(lanes[i])
        units = np.where(lanes[i] == 0, inputs, np.abs(lanes[i].astype(float)))
        ends = [j for j, name in enumerate(family.inputs) if name in family.one_sided and lanes[i][j] == 0]
        value_of = lambda q, f=family: values(f.model, q)  # noqa: E731
        slopes_of = lambda q, f=family, u=units, k=ends: slopes(f.model, q, u, k)  # noqa: E731
        name = NAMES_OF_RESULTS[codes[i]]
        names = () if name in OK else (name,)
        own = ROUNDINGS * eps
        truth = value_of(p)
        allowed = spread(value_of, p, eps, truth) + own * (np.abs(truth) + outputs)
        value = nearest(np.abs(found[i] - truth) / outputs, allowed / outputs)
        truth = slopes_of(p)
        size = np.maximum(np.abs(truth).max(1), outputs)  # of the gradient of each output, as a vector
        allowed = spread(slopes_of, p, eps, truth).max(1) + own * size
        error = np.maximum(*(np.abs(x[i].astype(float) * units - truth).max(1) for x in (forward, reverse)))
        slope = nearest(error / size, allowed / size)
        cells.append((throw.row, *(Cell(*pair, names, throw.expected) for pair in (value, slope))))
    return cells


def nearest(error: np.ndarray, allowed: np.ndarray) -> tuple[float, float]:
    """The error that comes nearest to what is allowed; a NaN before all others."""
    worst_at = np.argmax(np.where(np.isnan(error), np.inf, error / allowed))
    return float(error.flat[worst_at]), float(allowed.flat[worst_at])


def families() -> list[tuple[Family, list[Throw]]]:
    boxes, spheres = convex_throws()
    return [(SLABS, slab_throws()), (BOXES, boxes), (SPHERES, spheres)]
