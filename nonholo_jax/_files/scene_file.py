"""Scene files: a ball, surfaces, a throw and what to do with it, as one TOML file."""

import json
import math
import tomllib
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from .._impact import Frictional, Rough, Smooth
from .._motion import AbstractMotion, Exact, Integrated
from .._questions import HitTarget, Land, ReturnTo, expand
from .._world import Air, Ball, BallState, Box, Cylinder, Hole, Plane, Rectangle, Scene, Sphere
from .montecarlo_file import MonteCarloTask as MonteCarloTask, table_of, task_of
from .scene_schema import (
    GOALS,
    LAWS,
    SCHEMA,
    SURFACES,
    Document,
    SceneError as SceneError,
    dotted,
    nearest,
    parse,
    shown,
)


class SimulateTask(NamedTuple):
    """The `[simulate]` table: `simulate(file.scene, file.throw, **file.simulate.arguments)`."""

    t1: float
    t0: float = 0.0
    max_impacts: int = 64
    motion: AbstractMotion | None = None
    sum_trains: bool = True

    @property
    def arguments(self) -> dict[str, Any]:
        return self._asdict()


class DesignTask(NamedTuple):
    """The `[design]` table; `[simulate]` says how the motion is computed:
    `design(file.scene, file.throw, **file.design.arguments, **file.simulate.arguments)`."""

    free: tuple[str, ...]
    goal: Any
    itinerary: tuple[str, ...] | None = None
    bounds: dict[str, tuple[float, float]] | None = None
    n_starts: int = 16
    seed: int = 0

    @property
    def arguments(self) -> dict[str, Any]:
        fields = self._asdict()
        return fields | {"key": jax.random.key(fields.pop("seed"))}


class SceneFile(NamedTuple):
    """What a scene file holds. `simulate`, `design` and `monte_carlo` are `None` where the file has no such table."""

    scene: Scene
    throw: BallState
    simulate: SimulateTask | None = None
    design: DesignTask | None = None
    monte_carlo: MonteCarloTask | None = None


_SHAPE_CLASSES = {"plane": Plane, "rectangle": Rectangle, "box": Box, "sphere": Sphere, "cylinder": Cylinder,
                  "hole": Hole}  # fmt: skip
_LAW_CLASSES = {"rough": Rough, "smooth": Smooth, "frictional": Frictional}
_GOAL_CLASSES = {"return_to": ReturnTo, "hit_target": HitTarget, "land": Land}


def load_scene(path: str | Path) -> SceneFile:
    """Read and check a scene file.

    **Arguments:** `path` of a TOML file with `schema = 1`; the fields are those of the classes of the same name, in SI
    units. `Implicit` surfaces are functions and cannot be in a file.

    Returns a `SceneFile`. Raises `SceneError` (a `ValueError`) with one line that names file, field, value and remedy:
    for a file that cannot be read, a field that is unknown, missing, of the wrong type or out of range, a ball that
    starts inside a surface, and names in `[design]` that do not exist.

    ```python
    from pathlib import Path
    from nonholo_jax import simulate
    from nonholo_jax.scene_file import load_scene
    scene_path = Path("experiments/scenes/under_the_table.toml")
    if scene_path.exists():
        file = load_scene(scene_path)
        simulate(file.scene, file.throw, **file.simulate.arguments)
    ```
    """
    try:
        return _built(parse(_read(Path(path))), Path(path).parent)
    except SceneError as error:
        raise SceneError(_one_line(f"{path}: {error}")) from None


def save_scene(file: SceneFile, path: str | Path) -> None:
    """Write a scene file that `load_scene` reads back to the same numbers.

    **Arguments:** `file`, a `SceneFile`; `path` of the file to write, replaced if it exists.

    Raises `SceneError` where the scene cannot be in a file: `Implicit` surfaces, goals that are functions, values that
    `load_scene` would refuse; nothing is then written. Raises `OSError` where the file cannot be written.

    ```python
    import tempfile
    from nonholo_jax import Ball, BallState, Scene
    from nonholo_jax.scene_file import SceneFile, save_scene
    file = SceneFile(Scene(Ball(0.025, 0.046), {}), BallState([0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]))
    save_scene(file, f"{tempfile.mkdtemp()}/free_flight.toml")
    ```
    """
    try:
        document = parse(_tables(file))
        _built(document, Path(path).parent)
    except SceneError as error:
        raise SceneError(_one_line(f"{path}: {error}")) from None
    lines = _emitted(document.model_dump(by_alias=True, exclude_none=True, exclude_unset=True), ())
    Path(path).write_text("\n".join(lines) + "\n", encoding="utf-8")


# Reading


def _one_line(text: str) -> str:
    return "".join(c if c.isprintable() else repr(c)[1:-1] for c in text)


def _read(path: Path) -> dict[str, Any]:
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        raise SceneError("the file must exist, but got no such file; check the path") from None
    except IsADirectoryError:
        raise SceneError("the path must be a file, but got a directory; name the .toml file in it") from None
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise SceneError(f"the file must be readable, but got {reason}; check path and permissions") from None
    try:
        return tomllib.loads(data.decode("utf-8"))
    except UnicodeDecodeError as error:
        line = data[: error.start].count(b"\n") + 1
        what = f"the file must be UTF-8 text, but got byte 0x{data[error.start]:02x} in line {line}"
        raise SceneError(f"{what}; save it as UTF-8") from None
    except ValueError as error:
        raise SceneError(f"the file must be TOML, but got: {error}; correct it there") from None
    except RecursionError:
        raise SceneError("the file must be TOML, but got brackets nested too deeply; flatten them") from None


def _built(document: Document, folder: Path) -> SceneFile:
    ball = Ball(**dict(document.ball))
    surfaces = {name: _object(table, _SHAPE_CLASSES) for name, table in document.surfaces.items()}
    for name, surface in surfaces.items():
        _check_fits(name, surface, ball.radius)
    air = None if document.air is None else Air(**dict(document.air))
    scene = Scene(ball, surfaces, document.gravity, air)
    _check_outside(scene, document.throw.position)
    throw = _throw(document)
    simulate = _simulate(document, scene)
    monte_carlo = None if document.monte_carlo is None else task_of(document.monte_carlo, scene, throw, folder)
    return SceneFile(scene, throw, simulate, _design(document, scene, throw), monte_carlo)


def _check_fits(name: str, surface: Any, radius: Any) -> None:
    """A ball must fit into what is hollow."""
    is_hole = isinstance(surface, Hole)
    if (is_hole or getattr(surface, "inside", False)) and not surface.radius > radius:
        where, remedy = (" in a hole", "") if is_hole else (" where inside = true", " or set inside = false")
        raise SceneError(
            f"`surfaces.{name}.radius` must be larger than the ball's radius {radius}{where}, "
            f"but got {surface.radius}; enlarge it{remedy}"
        )


def _object(table: Any, classes: dict[str, Any]) -> Any:
    """The surface, law or goal of a table: the fields carry the names of the constructor's arguments."""
    fields = dict(table)
    tag = fields.pop("shape" if "shape" in fields else "kind")
    if "law" in fields:
        fields["law"] = _object(fields["law"], _LAW_CLASSES)
    return classes[tag](**fields)


def _throw(document: Document) -> BallState:
    fields = dict(document.throw)
    quaternion = fields["orientation"]
    if quaternion is not None:
        length = math.hypot(*quaternion)
        if abs(length - 1.0) > 4e-16:  # what is already of length 1 keeps its last bits
            fields["orientation"] = [c / length for c in quaternion]
    dtype = jnp.result_type(float)
    for name, vector in fields.items():
        if vector is not None and max(map(abs, vector)) > float(jnp.finfo(dtype).max):
            what = f"`throw.{name}` must be within the range of {dtype.name}, but got {shown(vector)}"
            raise SceneError(f"{what}; use float64 or smaller numbers")
    return BallState(**fields)


def _check_outside(scene: Scene, position: list[float]) -> None:
    """On Python floats throughout, so that the answer does not depend on JAX's precision."""
    x, y, z = position
    for name, surface in zip(scene.names, scene.surfaces, strict=True):
        gap = float(surface.distance((x, y, z), 0.0)) - scene.ball.radius
        size = math.hypot(*position) + float(surface.extent()) + scene.ball.radius
        eps = float(jnp.finfo(jnp.result_type(float)).eps)  # a throw is stored in this precision
        if gap < -64.0 * eps * size:
            raise SceneError(
                f"`throw.position` must leave the ball outside of surface {name!r}, but got {shown(position)}, which "
                f"is {-gap:.6g} m inside (radius included); move it out by at least that much"
            )


def _simulate(document: Document, scene: Scene) -> SimulateTask | None:
    table = document.simulate
    if table is None:
        return None
    motion = Exact() if table.motion == "exact" else None
    if table.contact:
        motion = Exact(contact=Integrated()) if scene.air is None else Integrated(edges=True)
    if table.motion == "exact" and scene.air is not None:
        what = "`simulate.motion` must be 'integrated' where the scene has air, but got 'exact'"
        raise SceneError(f"{what}; change or remove the line")
    if table.motion == "integrated":
        named = {name: getattr(table, name) for name in ("rtol", "atol", "dt0", "max_steps")}
        options = {name: value for name, value in named.items() if value is not None}
        options |= {"edges": True} if table.contact else {}
        if table.solver is not None:
            options["solver"] = _solver(table.solver)
        try:
            motion = Integrated(**options)
        except ValueError:  # the one thing left that can be wrong
            what = f"`simulate.dt0` must be given for the constant steps of {table.solver!r}, but got nothing"
            raise SceneError(f"{what}; add dt0 = 1e-3 (seconds)") from None
    return SimulateTask(table.t1, table.t0, table.max_impacts, motion, table.sum_trains)


def _solver(name: str) -> Any:
    import diffrax

    known = {}
    for key, value in vars(diffrax).items():
        is_solver = isinstance(value, type) and issubclass(value, diffrax.AbstractSolver)
        if is_solver and not key.startswith("Abstract"):
            known[key] = value
    explicit = "an explicit solver of diffrax"
    if name not in known:
        raise SceneError(f"`simulate.solver` must be {explicit}, but got {name!r}; {nearest(name, known)}")
    try:
        solver = known[name]()
        Integrated(solver=solver, dt0=1.0)
    except (TypeError, ValueError):
        raise SceneError(f"`simulate.solver` must be {explicit}, but got {name!r}; try 'Tsit5'") from None
    return solver


def _design(document: Document, scene: Scene, throw: BallState) -> DesignTask | None:
    table = document.design
    if table is None:
        return None
    free = _expanded(scene, throw, table.free, "design.free")
    for name in table.bounds:
        extra = set(_expanded(scene, throw, [name], "design.bounds")) - set(free)
        if extra:
            field, known = dotted(("design", "bounds", name)), ", ".join(table.free)
            raise SceneError(
                f"`{field}` must be of a free component, but got {name!r} where free = {known}; add it to `design.free`"
            )
    for i, name in enumerate(table.itinerary or ()):
        _check_surface(scene, name, f"design.itinerary[{i}]")
    if getattr(table.goal, "surface", None) is not None:
        _check_surface(scene, table.goal.surface, "design.goal.surface")  # pyright: ignore
    bounds = {name: (low, high) for name, (low, high) in table.bounds.items()}
    itinerary = None if table.itinerary is None else tuple(table.itinerary)
    goal = _object(table.goal, _GOAL_CLASSES)
    return DesignTask(tuple(table.free), goal, itinerary, bounds or None, table.n_starts, table.seed)


def _expanded(scene: Scene, throw: BallState, names: list[str], field: str) -> tuple[str, ...]:
    try:
        return expand(scene, throw, tuple(names))
    except ValueError as error:
        raise SceneError(f"`{field}`: {error}") from None


def _check_surface(scene: Scene, name: str, field: str) -> None:
    if name not in scene.names:
        known = ", ".join(scene.names) or "no surface"
        raise SceneError(f"`{field}` must be one of {known}, but got {name!r}; {nearest(name, scene.names)}")


# Writing


def _plain(value: Any) -> Any:
    """Numbers and lists of Python from fields of a scene."""
    if isinstance(value, bool | str | int):
        return value
    if isinstance(value, tuple | list):
        return [_plain(entry) for entry in value]
    array = np.asarray(value)
    # Through text: 0.1 in float32 is written as 0.1, the shortest number that reads back to it.
    return float(str(array[()])) if array.ndim == 0 else [_plain(entry) for entry in array]


def _table(value: Any, classes: dict[str, Any], tables: dict[str, Any], tag: str, field: str) -> dict[str, Any]:
    """The table of a surface, law or goal; the inverse of `_object`."""
    kind = next((name for name, each in classes.items() if type(value) is each), None)
    if kind is None:
        known = ", ".join(each.__name__ for each in classes.values())
        raise SceneError(
            f"`{field}` must be one of {known} in a scene file, but got {type(value).__name__}; keep it in Python"
        )
    table: dict[str, Any] = {tag: kind}
    for name in tables[kind].model_fields:
        entry = getattr(value, "facing" if name == "normal" else name, None)
        if name == "law":
            table[name] = _table(entry, _LAW_CLASSES, LAWS, "kind", f"{field}.law")
        elif name != tag and entry is not None:
            table[name] = _plain(entry)
    return table


def _given(value: Any, names: tuple[str, ...]) -> dict[str, Any]:
    fields = {name: getattr(value, name) for name in names}
    return {name: _plain(entry) for name, entry in fields.items() if entry is not None}


def _tables(file: SceneFile) -> dict[str, Any]:
    scene = file.scene
    tables: dict[str, Any] = {"schema": SCHEMA, "gravity": _plain(scene.gravity)}
    tables["ball"] = _given(scene.ball, ("radius", "mass", "inertia_ratio"))
    if scene.air is not None:
        tables["air"] = _given(scene.air, ("density", "drag", "lift", "wind"))
    tables["surfaces"] = {
        name: _table(surface, _SHAPE_CLASSES, SURFACES, "shape", f"surfaces.{name}")
        for name, surface in zip(scene.names, scene.surfaces, strict=True)
    }
    tables["throw"] = _given(file.throw, ("position", "velocity", "spin", "orientation"))
    if file.simulate is not None:
        tables["simulate"] = _given(file.simulate, ("t0", "t1", "max_impacts", "sum_trains")) | _motion_fields(
            file.simulate.motion
        )
    if file.design is not None:
        task = file.design
        tables["design"] = _given(task, ("free", "itinerary", "n_starts", "seed"))
        tables["design"]["goal"] = _table(task.goal, _GOAL_CLASSES, GOALS, "kind", "design.goal")
        if task.bounds:
            tables["design"]["bounds"] = {name: _plain(pair) for name, pair in task.bounds.items()}
    if file.monte_carlo is not None:
        tables["monte_carlo"] = table_of(file.monte_carlo)
    return tables


def _motion_fields(motion: Any) -> dict[str, Any]:
    if motion is None:
        return {}
    if type(motion) is Exact and motion.contact in (None, Integrated()):
        return {"motion": "exact"} | ({} if motion.contact is None else {"contact": True})
    if type(motion) is Integrated and motion.stepsize_controller is None and motion.edges is not False:
        solver = {"motion": "integrated", "solver": type(motion.solver).__name__}
        solver |= {"contact": True} if motion.edges else {}
        return solver | _given(motion, ("rtol", "atol", "dt0", "max_steps"))
    raise SceneError(
        f"`simulate.motion` must be Exact(), Exact(contact=Integrated()) or Integrated() without a controller in a "
        f"scene file, but got {motion!r}; set rtol and atol instead"
    )


def _literal(value: Any) -> str:
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{key} = {_literal(entry)}" for key, entry in value.items()) + " }"
    if isinstance(value, list):
        return "[" + ", ".join(_literal(entry) for entry in value) + "]"
    if isinstance(value, bool):
        return str(value).lower()
    return json.dumps(value, ensure_ascii=False) if isinstance(value, str) else repr(value)


def _key(name: str) -> str:
    is_bare = name.isascii() and all(c.isalnum() or c in "_-" for c in name)
    return name if is_bare else json.dumps(name, ensure_ascii=False)


def _emitted(table: dict[str, Any], path: tuple[str, ...]) -> list[str]:
    """TOML lines of a table: its own values first, then its subtables; a table with a `kind` stands in one line."""
    inner = {name: value for name, value in table.items() if isinstance(value, dict) and "kind" not in value}
    rows = {
        name: value for name, value in table.items() if isinstance(value, list) and value and isinstance(value[0], dict)
    }
    lines = [f"{_key(name)} = {_literal(value)}" for name, value in table.items() if name not in {**inner, **rows}]
    if path and (lines or not inner):
        lines.insert(0, f"\n[{'.'.join(_key(part) for part in path)}]")
    for name, value in inner.items():
        lines += _emitted(value, (*path, name))
    for name, value in rows.items():
        for row in value:
            lines.append(f"\n[[{'.'.join(_key(part) for part in (*path, name))}]]")
            lines += [f"{_key(field)} = {_literal(entry)}" for field, entry in row.items()]
    return lines
