"""The plan of the house: a room imports only from rooms above it, a file only from files above it, and none grows too
long."""

import ast
import pathlib
import subprocess
import sys

import pytest

import nonholo_jax

PACKAGE = pathlib.Path(nonholo_jax.__file__).parent
# From the ground up, and so in each room.
ROOMS = {
    "_math": [
        "types",
        "vector",
        "shared",
        "hops",
        "polynomial",
        "intervals",
        "courses",
        "bounds",
        "gap",
        "rotation",
        "tiles",
        "tangents",
    ],
    "_impact": ["projector", "law", "together", "train", "rolling", "groove"],
    "_world": [
        "ball",
        "surface",
        "box",
        "round",
        "hole",
        "air",
        "system",
        "touching",
        "checks",
        "scene",
        "lagrangian",
    ],
    "_staying": ["floors", "ground", "grooved", "settling", "grounded"],
    "_motion": ["crossing", "motion", "integrated", "loop", "hopping", "replay", "accuracy", "trajectory", "simulate"],
    "_questions": [
        "diagnostics",
        "names",
        "goal",
        "chart",
        "jacobian",
        "design",
        "fit",
        "fifty_digits",
        "ways",
        "tradeoff",
        "rates",
        "bench",
    ],
    "_ensembles": [
        "distribution",
        "sampler",
        "measure",
        "statistics",
        "store",
        "ensemble",
        "montecarlo",
        "sensitivity",
    ],
    "_files": ["schema_types", "montecarlo_schema", "scene_schema", "montecarlo_file", "scene_file", "traced"],
    "_pictures": ["bench_plot", "outline", "samples", "ensemble_plot", "fit_plot", "plot", "tradeoff_plot"],
    "_cli": ["clock", "cache", "report", "bench_verb", "montecarlo_verb", "main"],
}
DOORS = ["plot", "scene_file", "cli"]  # public modules, which hand on what rooms hold; so does the package itself
FILES = sorted(PACKAGE.rglob("*.py"))
NAMES = {file: ".".join(file.relative_to(PACKAGE).with_suffix("").parts) for file in FILES}
files = pytest.mark.parametrize("file", FILES, ids=list(NAMES.values()))


def parsed(file):
    return ast.parse(file.read_text())


def imports_of(file):
    """(room, file) of all that a file imports from the package, anywhere in it; where it imports from a room as a
    whole, the file is `None`."""
    here = ("nonholo_jax", *file.relative_to(PACKAGE).parts[:-1])
    found = set()
    for node in ast.walk(parsed(file)):
        if isinstance(node, ast.ImportFrom):
            start = here[: len(here) - node.level + 1] if node.level else ()
            module = (*start, *(node.module.split(".") if node.module else ()))
            wholes = [(*module, alias.name) for alias in node.names]
        elif isinstance(node, ast.Import):
            wholes = [tuple(alias.name.split(".")) for alias in node.names]
        else:
            continue
        for package, *path in wholes:
            if package != "nonholo_jax":
                continue
            assert path, f"{NAMES[file]} imports the package as a whole"
            inside = len(path) > 1 and path[1] in ROOMS.get(path[0], ())
            found.add((path[0], path[1] if inside else None))
    return found


def test_every_file_has_its_place():
    rooms = {f"{room}.{name}" for room, names in ROOMS.items() for name in [*names, "__init__"]}
    assert set(NAMES.values()) == rooms | {"__init__", *DOORS}


def test_no_room_is_too_full():
    assert max(map(len, ROOMS.values())) <= 12


@files
def test_imports_only_from_above(file):
    room, _, name = NAMES[file].rpartition(".")
    if not room:
        below = {f"{one}.{two}" for one, two in imports_of(file) if one not in ROOMS}
        assert not below or name == "__init__", f"{file.name} imports from {sorted(below)}"
        return
    rooms, order = list(ROOMS), ROOMS[room]
    above = order if name == "__init__" else order[: order.index(name)]
    for one, two in imports_of(file):
        fine = two in above if one == room else one in rooms[: rooms.index(room)]
        assert fine, f"{NAMES[file]} imports from below: {one}.{two}"


@pytest.mark.parametrize("name", ["__init__", *DOORS])
def test_doors_only_hand_on(name):
    """The package's own door may hand on rooms when they are asked for, too."""
    document, *rest = parsed(PACKAGE / f"{name}.py").body
    assert isinstance(document, ast.Expr)
    defined = {getattr(node, "name", ast.unparse(node).split(" ")[0])
               for node in rest if not isinstance(node, ast.Import | ast.ImportFrom | ast.If)}  # fmt: skip
    assert defined <= ({"_WHEN_ASKED", "__getattr__", "__dir__", "__all__"} if name == "__init__" else set())


def test_what_is_handed_on_when_asked_for_is_what_type_checkers_see():
    block = next(node for node in parsed(PACKAGE / "__init__.py").body if isinstance(node, ast.If))
    imports = [node for node in block.body if isinstance(node, ast.ImportFrom)]
    seen = {node.module: sorted(alias.name for alias in node.names) for node in imports}
    assert seen == {room: sorted(names) for room, names in nonholo_jax._WHEN_ASKED.items()}


def test_a_plain_simulation_needs_no_question_and_no_ensemble():
    code = """
import sys
from nonholo_jax import Ball, BallState, Plane, Rough, Scene, simulate
scene = Scene(Ball(0.025, 0.046), {"floor": Plane((0, 0, 0), (0, 0, 1), Rough())})
simulate(scene, BallState([0, 0, 1], [1, 0, 0], [0, 0, 0]), t1=0.1)
heavy = "matplotlib pydantic zarr pyarrow SALib xarray pandas scipy.optimize optax tqdm".split()
rooms = [f"nonholo_jax.{room}" for room in ("_questions", "_ensembles", "_files", "_pictures")]
print([name for name in (*heavy, *rooms) if name in sys.modules])
"""
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert found.stdout.strip() == "[]", found.stdout


@files
def test_no_file_and_no_function_is_too_long(file):
    assert len(file.read_text().splitlines()) <= 500
    for node in ast.walk(parsed(file)):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            assert node.end_lineno - node.lineno < 80, f"{file.name}: {node.name}"


@files
def test_configuration_is_left_to_the_command_line(file):
    if NAMES[file] in ("_cli.main", "_cli.cache"):
        return
    updates = [
        node
        for node in ast.walk(parsed(file))
        if isinstance(node, ast.Call)
        and isinstance(node.func, ast.Attribute)
        and node.func.attr == "update"
        and ast.unparse(node.func.value) in ("jax.config", "config")
    ]
    assert not updates


def test_everything_public_is_documented():
    for name in dir(nonholo_jax):
        thing = getattr(nonholo_jax, name)
        if not name.startswith("_") and getattr(thing, "__module__", "").startswith("nonholo_jax"):
            assert thing.__doc__, name
