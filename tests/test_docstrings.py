"""The examples of the documentation run."""

import inspect
import pathlib
import re
import textwrap

import jax
import pytest

import nonholo_jax

README = pathlib.Path(__file__).parents[1] / "README.md"
BLOCK = re.compile(r"^([ \t]*)```python\n(.*?)^\1```", re.MULTILINE | re.DOTALL)


def blocks_of(text):
    return [textwrap.dedent(match[1]) for match in BLOCK.findall(inspect.cleandoc(text or ""))]


def examples():
    """(name, code) of every block in the docstrings of public names and their public methods, and in the README."""
    found = []
    for name in dir(nonholo_jax):
        thing = getattr(nonholo_jax, name)
        if name.startswith("_") or inspect.ismodule(thing):
            continue
        things = [(name, thing)]
        if inspect.isclass(thing):
            things += [(f"{name}.{method}", f) for method, f in vars(thing).items() if method[0] != "_" and callable(f)]
        found += [(each, code) for each, owner in things for code in blocks_of(owner.__doc__)]
    if README.exists():
        found += [(f"README_{i}", code) for i, code in enumerate(blocks_of(README.read_text()))]
    return found


EXAMPLES = examples()


def test_there_are_examples():
    assert {"simulate", "Scene", "Ball", "projector"} <= {name for name, _ in EXAMPLES}


@pytest.mark.parametrize("code", [code for _, code in EXAMPLES], ids=[name for name, _ in EXAMPLES])
def test_example_runs(code, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with jax.numpy_rank_promotion("allow"), jax.numpy_dtype_promotion("standard"):
        exec(compile(code, "example", "exec"), {"__name__": "example"})
