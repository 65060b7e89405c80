"""The fields of a scene file, and one sentence for every way in which a file can be wrong."""

import difflib
import math
from typing import Annotated, Any, Literal

from pydantic import Field, ValidationError, model_validator

from .montecarlo_schema import MEASURES, VARY, MonteCarloTable
from .schema_types import (
    SCHEMA as SCHEMA,
    Bounds,
    Direction,
    Finite,
    Lengths3,
    Name,
    NotNegative,
    Positive,
    Quaternion,
    Restitution,
    SceneError as SceneError,
    Table,
    Tangential,
    Vector2,
    Vector3,
    fault,
)


class BallTable(Table):
    radius: Positive
    mass: Positive
    inertia_ratio: Positive = 0.4


class AirTable(Table):
    density: NotNegative = 1.204
    drag: NotNegative = 0.47
    lift: Finite = 1.0
    wind: Vector3 = [0.0, 0.0, 0.0]


class RoughTable(Table):
    kind: Literal["rough"]
    restitution: Restitution = 1.0
    tangential: Tangential | None = None
    rolling: NotNegative = 0.0
    spinning: NotNegative = 0.0


class SmoothTable(Table):
    kind: Literal["smooth"]
    restitution: Restitution = 1.0


class FrictionalTable(Table):
    kind: Literal["frictional"]
    restitution: Restitution
    tangential: Tangential
    friction: NotNegative
    rolling: NotNegative = 0.0
    spinning: NotNegative = 0.0


LawTable = Annotated[RoughTable | SmoothTable | FrictionalTable, Field(discriminator="kind")]


class PlaneTable(Table):
    shape: Literal["plane"]
    point: Vector3
    normal: Direction
    law: LawTable


class RectangleTable(Table):
    shape: Literal["rectangle"]
    center: Vector3
    normal: Direction
    tangent: Direction
    half_size: Vector2
    law: LawTable

    @model_validator(mode="after")
    def _spans_a_plane(self):
        (a, b, c), (x, y, z) = self.normal, self.tangent
        lengths = math.hypot(a, b, c) * math.hypot(x, y, z)
        if math.hypot(b * z - c * y, c * x - a * z, a * y - b * x) <= 1e-12 * lengths:
            raise fault("must not be along `normal`", "choose the direction of the first side", "tangent")
        return self


class BoxTable(Table):
    shape: Literal["box"]
    center: Vector3
    half_size: Lengths3
    law: LawTable
    rotation: Quaternion | None = None


class SphereTable(Table):
    shape: Literal["sphere"]
    center: Vector3
    radius: Positive
    law: LawTable
    inside: bool = False


class CylinderTable(Table):
    shape: Literal["cylinder"]
    point: Vector3
    axis: Direction
    radius: Positive
    law: LawTable
    inside: bool = False


class HoleTable(Table):
    shape: Literal["hole"]
    center: Vector3
    normal: Direction
    radius: Positive
    law: LawTable


SurfaceTable = Annotated[
    PlaneTable | RectangleTable | BoxTable | SphereTable | CylinderTable | HoleTable, Field(discriminator="shape")
]


class ThrowTable(Table):
    position: Vector3
    velocity: Vector3
    spin: Vector3
    orientation: Quaternion | None = None


class SimulateTable(Table):
    t1: Finite
    t0: Finite = 0.0
    max_impacts: Annotated[int, Field(ge=0, le=1_000_000)] = 64
    sum_trains: bool = True
    motion: Literal["exact", "integrated"] | None = None
    contact: bool = False
    solver: str | None = None
    rtol: Positive | None = None
    atol: Positive | None = None
    dt0: Positive | None = None
    max_steps: Annotated[int, Field(ge=1, le=10_000_000)] | None = None

    @model_validator(mode="after")
    def _fits_together(self):
        if not self.t1 > self.t0:
            raise fault(f"must be later than t0 = {self.t0}", "it is the time in s at which the simulation ends", "t1")
        for name in ("solver", "rtol", "atol", "dt0", "max_steps"):
            if getattr(self, name) is not None and self.motion != "integrated":
                raise fault('must come with motion = "integrated"', "add that line or remove this one", name)
        return self


class ReturnToTable(Table):
    kind: Literal["return_to"]
    point: Vector3


class HitTargetTable(Table):
    kind: Literal["hit_target"]
    point: Vector3


class LandTable(Table):
    kind: Literal["land"]
    point: Vector3
    surface: str | None = None


GoalTable = Annotated[ReturnToTable | HitTargetTable | LandTable, Field(discriminator="kind")]


class DesignTable(Table):
    free: Annotated[list[str], Field(min_length=1)]
    goal: GoalTable
    itinerary: Annotated[list[str], Field(min_length=1)] | None = None
    bounds: dict[str, Bounds] = {}
    n_starts: Annotated[int, Field(ge=1, le=100_000)] = 16
    seed: Annotated[int, Field(ge=0, le=2**32 - 1)] = 0


class Document(Table):
    """A whole scene file."""

    schema_: int = Field(alias="schema")
    gravity: Vector3 = [0.0, 0.0, -9.81]
    ball: BallTable
    air: AirTable | None = None
    surfaces: dict[Name, SurfaceTable] = {}
    throw: ThrowTable
    simulate: SimulateTable | None = None
    design: DesignTable | None = None
    monte_carlo: MonteCarloTable | None = None


SURFACES = {"plane": PlaneTable, "rectangle": RectangleTable, "box": BoxTable, "sphere": SphereTable,
            "cylinder": CylinderTable, "hole": HoleTable}  # fmt: skip
LAWS = {"rough": RoughTable, "smooth": SmoothTable, "frictional": FrictionalTable}
GOALS = {"return_to": ReturnToTable, "hit_target": HitTargetTable, "land": LandTable}
_TABLES = {"ball": BallTable, "air": AirTable, "throw": ThrowTable, "simulate": SimulateTable, "design": DesignTable,
           "monte_carlo": MonteCarloTable, **SURFACES, **LAWS, **GOALS, **VARY, **MEASURES}  # fmt: skip

_EXAMPLES = {
    "radius": "radius = 0.025 (metres)",
    "mass": "mass = 0.046 (kg)",
    "inertia_ratio": "inertia_ratio = 0.4 (a solid sphere; 2/3 is a thin shell)",
    "restitution": "restitution = 0.9 (1 conserves energy, 0 is plastic)",
    "tangential": "tangential = 0.5 (1 reverses the slip, -1 keeps it)",
    "friction": "friction = 0.6 (0 is a smooth wall)",
    "rolling": "rolling = 0.056 (0 rolls on for ever)",
    "spinning": "spinning = 0.02 (0 spins on for ever)",
    "density": "density = 1.204 (kg/m^3)",
    "drag": "drag = 0.47 (a smooth sphere)",
    "lift": "lift = 1.0",
    "law": 'law = { kind = "rough", restitution = 0.9 }',
    "kind": 'kind = "rough" in a law or kind = "return_to" in a goal',
    "shape": 'shape = "plane"',
    "inside": "inside = true",
    "half_size": "half_size = [0.6, 0.4, 0.015] (half the lengths of the sides in metres; a rectangle has two)",
    "normal": "normal = [0.0, 0.0, 1.0] (towards the ball)",
    "tangent": "tangent = [1.0, 0.0, 0.0]",
    "axis": "axis = [0.0, 0.0, 1.0]",
    "rotation": "rotation = [1.0, 0.0, 0.0, 0.0] (a quaternion w, x, y, z)",
    "orientation": "orientation = [1.0, 0.0, 0.0, 0.0] (a quaternion w, x, y, z)",
    "velocity": "velocity = [2.0, 0.0, -5.0] (m/s)",
    "spin": "spin = [0.0, 0.0, 0.0] (rad/s)",
    "gravity": "gravity = [0.0, 0.0, -9.81] (m/s^2)",
    "wind": "wind = [0.0, 0.0, 0.0] (m/s)",
    "t0": "t0 = 0.0 (seconds)",
    "t1": "t1 = 2.0 (seconds)",
    "max_impacts": "max_impacts = 16",
    "sum_trains": "sum_trains = true (false gives every bounce)",
    "motion": 'motion = "integrated"',
    "contact": "contact = true (a ball that stays on a surface is followed over curves, edges and corners)",
    "solver": 'solver = "Tsit5"',
    "rtol": "rtol = 1e-8",
    "atol": "atol = 1e-8",
    "dt0": "dt0 = 1e-3 (seconds)",
    "max_steps": "max_steps = 4096",
    "free": 'free = ["spin.y"]',
    "goal": 'goal = { kind = "return_to", point = [0.0, 0.0, 1.0] }',
    "itinerary": 'itinerary = ["floor"] (names of surfaces)',
    "bounds": '"spin.y" = [-400.0, 400.0] below [design.bounds]',
    "n_starts": "n_starts = 16",
    "seed": "seed = 0",
    "ball": "[ball] with radius and mass",
    "throw": "[throw] with position, velocity and spin",
    "surfaces": "[surfaces.floor] with shape and law",
    "air": "[air] with density and drag",
    "simulate": "[simulate] with t1 = 2.0",
    "design": "[design] with free and goal",
    "schema": f"schema = {SCHEMA}",
    "monte_carlo": "[monte_carlo] with n = 100_000, and [[monte_carlo.vary]]",
    "n": "n = 100_000",
    "vary": '[[monte_carlo.vary]] with names = ["velocity"], kind = "normal" and std = 0.05',
    "measure": '[[monte_carlo.measure]] with name = "landing", kind = "landing" and surface = "floor"',
    "names": 'names = ["velocity"]',
    "name": 'name = "landing"',
    "std": "std = 0.05",
    "sigma": "sigma = 0.02",
    "low": "low = 0.7",
    "high": "high = 0.9",
    "covariance": "covariance = [[0.04, -0.01], [-0.01, 0.02]]",
    "file": 'file = "throws.csv"',
    "columns": 'columns = ["vx", "vz"]',
    "within": "within = 0.1 (metres)",
    "after": "after = 1",
    "count": "count = 1",
    "surface": 'surface = "floor"',
    "sequence": 'sequence = "sobol"',
}


def parse(document: dict[str, Any]) -> Document:
    """The checked form of a scene file's tables. Raises `SceneError` for the most telling fault."""
    version = document.get("schema")
    if "schema" not in document:
        raise SceneError(f"`schema` must be given, but got nothing; add the line schema = {SCHEMA} at the top")
    if isinstance(version, bool) or not isinstance(version, int) or version < 1:
        raise SceneError(f"`schema` must be {SCHEMA}, but got {shown(version)}; write schema = {SCHEMA}")
    if version > SCHEMA:
        remedy = f"the file is newer than this nonholo_jax: update the package, or write schema = {SCHEMA}"
        raise SceneError(f"`schema` must be at most {SCHEMA}, but got {version}; {remedy}")
    try:
        return Document.model_validate(document)
    except ValidationError as error:
        faults = error.errors(include_url=False)
        # A misspelt name also leaves a field missing; the misspelling says more.
        telling = min(faults, key=lambda fault: fault["type"] != "extra_forbidden")
        sentence = _sentence(telling, document)
    raise SceneError(sentence)


def shown(value: Any) -> str:
    """A value as it might stand in a scene file, cut to a readable length."""
    if isinstance(value, bool):
        text = str(value).lower()
    elif isinstance(value, dict):
        text = "a table"
    elif isinstance(value, int | float | str | list):
        text = repr(value)
    else:
        text = str(value)
    return text if len(text) <= 60 else text[:57] + "..."


def nearest(name: str, known: Any, otherwise: str = "choose one of these") -> str:
    """A remedy for a name that is not known."""
    close = difflib.get_close_matches(name, list(known), n=1, cutoff=0.5)
    return f"did you mean {close[0]!r}?" if close else otherwise


_LISTS = (
    "free",
    "itinerary",
    "half_size",
    "vary",
    "measure",
    "names",
    "columns",
    "covariance",
    "std",
    "mean",
    "low",
    "high",
)


def dotted(path: tuple) -> str:
    """A path in a document as one name; components of vectors are called by their letters."""
    text = ""
    for i, part in enumerate(path):
        if isinstance(part, int):
            before = path[i - 1]
            letters = "wxyz" if before in ("orientation", "rotation") else "xyz"
            named = before not in _LISTS and "bounds" not in path and part < len(letters)
            text += f".{letters[part]}" if named else f"[{part}]"
        else:
            plain = bool(part) and all(c.isalnum() or c in "_-" for c in part)
            text += ("." if text else "") + (part if plain else repr(part))
    return text


def _in_list(path: tuple) -> bool:
    return len(path) == 3 and path[0] == "monte_carlo" and path[1] in ("vary", "measure")


def _options(path: tuple) -> dict[str, Any]:
    """What the tag at the end of a path may be."""
    if path[-1] == "shape":
        return SURFACES
    if _in_list(path[:-1]):
        return VARY if path[1] == "vary" else MEASURES
    return LAWS if path[-2] == "law" else GOALS


def _untagged(location: tuple) -> tuple:
    """Pydantic's path without the tags that it inserts for the members of a union."""
    path: list = []
    skip = False
    for i, part in enumerate(location):
        if not skip:
            path.append(part)
        before = tuple(path)
        is_union = before[-1] in ("law", "goal") or (len(before) == 2 and before[0] == "surfaces") or _in_list(before)
        skip = is_union and not skip and i + 1 < len(location) and location[i + 1] in _TABLES
    return tuple(path)


def _example(path: tuple) -> str:
    """How the field that holds this value might read."""
    names = [part for part in path if isinstance(part, str)]
    if "bounds" in names:
        return _EXAMPLES["bounds"]
    name = "surfaces" if names[0] == "surfaces" and len(names) == 2 else names[-1]
    return _EXAMPLES.get(name, f"{name} = [0.0, 0.0, 0.0] (metres)")


def _sentence(fault: Any, document: dict[str, Any]) -> str:
    kind, context, value = fault["type"], fault.get("ctx", {}), fault["input"]
    path = _untagged(fault["loc"])
    if kind == "extra_forbidden":
        return _unknown_field(fault["loc"], path, value)
    if kind == "missing":
        return f"`{dotted(path)}` must be given, but got nothing; add {_example(path)}"
    if kind == "union_tag_not_found":
        path = (*path, context["discriminator"].strip("'"))
        options = _options(path)
        return f"`{dotted(path)}` must be given, but got nothing; add {path[-1]} = one of {_listed(options)}"
    if kind == "union_tag_invalid":
        return _unknown_tag((*path, context["discriminator"].strip("'")), context["tag"])
    if path[-1] == "[key]":
        remedy = "rename it with letters, digits, _ and -"
        return f"`{dotted(path[:-2])}` must have names without dots or spaces, but got {value!r}; {remedy}"
    if kind == "fault":
        if context["field"]:
            path = (*path, context["field"])
            value = value.get(context["field"]) if isinstance(value, dict) else value
        return f"`{dotted(path)}` {context['requirement']}, but got {shown(value)}; {context['remedy']}"
    requirement = _REQUIREMENTS.get(kind, "must be admissible")
    requirement = requirement.format(**{key: _plain(entry) for key, entry in context.items()})
    if path[-1] in ("free", "itinerary"):
        requirement = requirement.replace("1 entries", "at least one name")
    return f"`{dotted(path)}` {requirement}, but got {shown(value)}; for example {_example(path)}"


_REQUIREMENTS = {
    "float_type": "must be a number",
    "int_type": "must be a whole number",
    "int_from_float": "must be a whole number",
    "string_type": "must be text in quotes",
    "bool_type": "must be true or false",
    "list_type": "must be a list",
    "dict_type": "must be a table",
    "model_type": "must be a table",
    "model_attributes_type": "must be a table",
    "finite_number": "must be finite",
    "greater_than": "must be greater than {gt}",
    "greater_than_equal": "must be at least {ge}",
    "less_than_equal": "must be at most {le}",
    "too_short": "must have {min_length} entries",
    "too_long": "must have {max_length} entries",
    "literal_error": "must be {expected}",
}


def _plain(entry: Any) -> Any:
    return f"{entry:g}" if isinstance(entry, float) else entry


def _listed(options: Any) -> str:
    return ", ".join(repr(option) for option in options)


def _unknown_field(location: tuple, path: tuple, value: Any) -> str:
    table = _TABLES[location[-2]] if len(location) > 1 else Document
    known = [field.alias or name for name, field in table.model_fields.items()]
    name = str(path[-1])
    where = f"`{dotted(path)}` is an unknown field and must be one of {', '.join(known)}"
    return f"{where}, but got {dotted((name,))} = {shown(value)}; {nearest(name, known, 'remove it')}"


def _unknown_tag(path: tuple, tag: Any) -> str:
    options = _options(path)
    remedy = nearest(str(tag), options)
    if path[-1] == "shape" and str(tag).lower() == "implicit":
        remedy = "an implicit surface is a function: build it in Python with nonholo_jax.Implicit"
    return f"`{dotted(path)}` must be one of {_listed(options)}, but got {shown(tag)}; {remedy}"
