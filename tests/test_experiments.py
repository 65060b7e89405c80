"""Small versions of the experiments: every line of their tables passes, and a table with one that does not says so."""

import importlib
import pathlib

import numpy as np
import pytest
import throws
from report import Check, table

SCRIPTS = sorted(path.stem for path in (pathlib.Path(__file__).parents[1] / "experiments").glob("*/[0-9]*.py"))


def script(start):
    return importlib.import_module(next(name for name in SCRIPTS if name.startswith(start)))


def lines_of_the_paper(dtype):
    """All but the motions, which test_diagnostics.py and test_lagrangian.py have."""
    paper = script("01")
    d = paper.draw(50, dtype)
    return [*paper.constraints(d), *paper.algebra(d), *paper.balls(d), *paper.pendulum(d, 6)]


SMALL = {
    "01_float64": lambda: lines_of_the_paper(np.float64),
    "01_float32": lambda: lines_of_the_paper(np.float32),
    "02": lambda: script("02").checks(),
    "03": lambda: script("03").checks(n=20),
    "04": lambda: script("04").checks(t1=1.2, with_errors=False),
    "05": lambda: script("05").checks(bounces=100, fewer=5),
    "06": lambda: script("06").checks(n=5),
    "07": lambda: script("07").checks(script("07").CASES[3:], 10.0 ** np.arange(8, 13)),
    "08": lambda: script("08").checks(("turntable",), steps=2000, step_sizes=0.2 / 2 ** np.arange(4)),
    "09": lambda: script("09").checks((2.5,), (0.6,)),
    "10": lambda: script("10").checks(("wood",)),
    "11": lambda: script("11").checks(t1=0.6, pivots=(20.0,)),
    "12": lambda: script("12").checks(n=3, rounds=2, bound=1e-2),
}


@pytest.mark.parametrize("name", SMALL)
def test_every_line_passes(name):
    rows = SMALL[name]()
    failed = [row for row in rows if not row.passes]
    assert len(rows) >= 3 and not failed, failed


def test_every_numbered_script_is_tested():
    assert {name[:2] for name in SCRIPTS} == {name[:2] for name in SMALL}


@pytest.mark.parametrize("value, above, code", [(1.0, False, 1), (0.1, False, 0), (1.0, True, 0), (np.nan, True, 1),
                                                (np.nan, False, 1)])  # fmt: skip
def test_exit_code_of_a_table(value, above, code, capsys):
    assert table("title", [Check("right", 0.0, 1.0), Check("this", value, 0.5, above)]) == code
    assert ("FAIL" in capsys.readouterr().out) == bool(code)


def test_small_version_of_the_study_of_throws():
    job = throws.Job(0, "corridor", "float64")
    line = throws.done_one(job, 512)
    assert line["failed"] == line["lost"] == 0 and max(line["worst"]) < 8.0
    assert sum(line["results"].values()) == 512 and set(line["results"]) <= {"reached_t1", "max_impacts"}
    assert line["impacts"] > 3 * 512
    for name, value in job.ball()._asdict().items():  # a check that can fail: it is told of another ball
        assert throws.done_one(job, 512, job.ball()._replace(**{name: value * (1.0 + 1e-11)}))["failed"] > 256, name


def test_a_study_of_throws_goes_on_where_it_was_cut(tmp_path):
    lines = throws.Lines(str(tmp_path), 1024)
    lines.add({"chunk": 0, "failed": 0})
    with (tmp_path / "chunks.jsonl").open("a") as file:
        file.write('{"chunk": 1, "fai')
    assert throws.Lines(str(tmp_path), 1024).chunks == lines.chunks
    with pytest.raises(ValueError, match="try another --out"):
        throws.Lines(str(tmp_path), 2048)
