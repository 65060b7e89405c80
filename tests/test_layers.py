"""The plan of the house: each file imports only from files above it, and none grows too long."""

import ast
import pathlib

import pytest

import nonholo_jax

PACKAGE = pathlib.Path(nonholo_jax.__file__).parent
# From the ground up. `_motion*` and the faces may be several files.
ORDER = [
    "_clock",
    "_types",
    "_vector",
    "_shared",
    "_polynomial",
    "_rotation",
    "_hops",
    "_tiles",
    "_tangents",
    # ground: the mathematics of impact
    "_impact",
    "_law",
    "_gap",
    "_system",
    "_checks",
    "_lagrangian",
    # world
    "_ball",
    "_surface",
    "_box",
    "_round",
    "_air",
    "_corner",
    "_scene",
    "_train",
    "_rolling",
    "_floors",
    "_grounded",
    # motion
    "_crossing",
    "_motion",
    "_motion_integrated",
    "_loop",
    "_replay",
    "_accuracy",
    "_trajectory",
    "_simulate",
    # questions asked of motion
    "_diagnostics",
    "_names",
    "_goal",
    "_chart",
    "_design",
    "_fifty_digits",
    "_ways",
    "_tradeoff",
    "_distribution",
    "_sampler",
    "_measure",
    "_fit",
    "_statistics",
    "_store",
    "_ensemble",
    "_montecarlo",
    "_sensitivity",
    # face
    "_schema_types",
    "_montecarlo_schema",
    "_scene_schema",
    "_montecarlo_file",
    "scene_file",
    "_outline",
    "_samples",
    "_ensemble_plot",
    "_fit_plot",
    "plot",
    "_tradeoff_plot",
    "_montecarlo_verb",
    "_report",
    "cli",
]
FILES = sorted(PACKAGE.rglob("*.py"))
files = pytest.mark.parametrize("file", FILES, ids=[file.stem for file in FILES])


def parsed(file):
    return ast.parse(file.read_text())


def imports_of(tree):
    """The names of the package's own modules that a file imports, anywhere in it."""
    names = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom):
            module = (node.module or "").removeprefix("nonholo_jax").removeprefix(".")
            own = node.level > 0 or (node.module or "").split(".")[0] == "nonholo_jax"
            if own:
                names |= {module.split(".")[0]} if module else {alias.name for alias in node.names}
        elif isinstance(node, ast.Import):
            whole = [alias.name.split(".") for alias in node.names]
            names |= {parts[1] for parts in whole if parts[0] == "nonholo_jax" and len(parts) > 1}
    return names


@files
def test_imports_only_from_above(file):
    if file.stem in ("__init__", "__main__"):
        return
    assert file.stem in ORDER, f"{file.name} has no place in the order of this test"
    above = ORDER[: ORDER.index(file.stem)]
    below = {name for name in imports_of(parsed(file)) if name in ORDER and name not in above}
    assert not below, f"{file.name} imports from below: {sorted(below)}"


@files
def test_no_file_and_no_function_is_too_long(file):
    assert len(file.read_text().splitlines()) <= 500
    for node in ast.walk(parsed(file)):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            assert node.end_lineno - node.lineno < 80, f"{file.name}: {node.name}"


@files
def test_configuration_is_left_to_the_command_line(file):
    if file.stem == "cli":
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
    for name, thing in vars(nonholo_jax).items():
        if not name.startswith("_") and getattr(thing, "__module__", "").startswith("nonholo_jax"):
            assert thing.__doc__, name
