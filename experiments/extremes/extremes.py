"""The simulator at the extremes: what it answers where numbers are very large, very small, equal, or no numbers.

Each cell of the table is an error and the bound that it must keep, or the name of a result. Errors are against models
of their own in fifty digits (`extremes_truth.py`) that begin with the same rounded inputs. Lengths are in units of the
scene, velocities in units of the fastest one, spins times the radius; derivatives are by the logarithm of each input
(x df/dx), in the same units, forward and reverse mode both. The bound of a cell is what `ROUNDINGS` (16) roundings of
each input do to the truth, and as many roundings of the answer: an answer may not be worse than its inputs are.

    python experiments/extremes/extremes.py [--throws 100000] [--json FILE]

prints the table and the random study (`random_scenes.py`); exit code 1 if a cell breaks its bound, holds a NaN under a
result that is none, tunnels, or does not end.
"""

import argparse
import json
import pathlib
import sys
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

import jax
import numpy as np
from extremes_long import ROWS
from extremes_throws import COLUMNS, DTYPES, families, judged, with_slopes, worst
from random_scenes import GAIN, NAMED, OK, TEMPLATES, Found, Template, study

sys.path.append(str(pathlib.Path(__file__).parents[1]))  # for report.py
from report import machine


def collected(cells: Sequence[tuple], dtype: type, table: dict) -> None:
    """Add the rows of one precision to the table."""
    for row in dict.fromkeys(cell[0] for cell in cells):
        for k, what in ((1, "value"), (2, "gradient")):
            several = [cell[k] for cell in cells if cell[0] == row and cell[k] is not None]
            if several:
                table.setdefault(row, {})[f"{np.dtype(dtype)} {what}"] = worst(several)


def printed(table: dict) -> None:
    width = max(len(row) for row in table)
    print(f"{'':{width}}  " + "".join(f"{column:29}" for column in COLUMNS).rstrip())
    for row, cells in table.items():
        print(f"{row:{width}}  " + "".join(f"{str(cells.get(column, '')):29}" for column in COLUMNS).rstrip())


def printed_study(found: dict[str, Found]) -> None:
    print(f"\n{'random scenes':32} {'throws':>7} {'impacts':>8} {'tunnelled':>9} {'depth':>6} {'energy':>6}  results")
    for name, part in found.items():
        counts = ", ".join(f"{count} {result}" for result, count in part.results.most_common())
        sizes = f"{part.throws:7} {part.impacts:8} {part.tunnelled:9} {part.penetration:6.2f} {part.gained:6.1f}"
        print(f"{name:32} {sizes}  {counts}" + ("" if passes(part) else " FAIL"))
    print("depth: in units of what is allowed, 16 eps of the coordinates; energy: gained, in roundings of it")


def passes(part: Found) -> bool:
    return part.tunnelled == part.unannounced == 0 and part.gained <= GAIN and set(part.results) <= {*OK, *NAMED}


def shares(throws: int) -> list[tuple[Template, type, int]]:
    """Nine tenths of the throws in float64, spread over the templates, the rest in float32, on one of them."""
    single = throws // 10
    each = -(-(throws - single) // len(TEMPLATES))
    return [(TEMPLATES[0], np.float32, single), *[(template, np.float64, each) for template in TEMPLATES]]


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description="The simulator at the extremes.")
    parser.add_argument("--throws", type=int, default=100_000, help="of the random study")
    parser.add_argument("--json", type=pathlib.Path, metavar="FILE")
    options = parser.parse_args(argv)
    begun = time.monotonic()
    table: dict = {}
    with ThreadPoolExecutor(2) as pool:  # one compiles while the other computes
        studies = {
            f"{template.name}, {np.dtype(dtype)}": pool.submit(study, template, throws, dtype)
            for template, dtype, throws in shares(options.throws)
        }
        cells = [
            (dtype, pool.submit(lambda f=family, t=throws, d=dtype: judged(f, t, d, with_slopes(f.run))))
            for family, throws in families()
            for dtype in DTYPES
        ]
        cells += [(dtype, pool.submit(rows, dtype)) for rows in ROWS for dtype in DTYPES]
        for dtype, task in cells:
            collected(task.result(), dtype, table)
        found = {name: task.result() for name, task in studies.items()}
    print(machine())
    printed(table)
    printed_study(found)
    failed = sum(not cell.passes for row in table.values() for cell in row.values())
    failed += sum(not passes(part) for part in found.values())
    total = sum(part.throws for part in found.values())
    print(f"{len(table)} extremes, {total} random throws, {failed} FAIL; {time.monotonic() - begun:.0f} s")
    if options.json:
        rows = {row: {column: cell._asdict() for column, cell in cells.items()} for row, cells in table.items()}
        answer = {"machine": machine(), "extremes": rows, "study": {k: v._asdict() for k, v in found.items()}}
        options.json.write_text(json.dumps(answer, indent=1))
    return int(failed > 0)


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    sys.exit(main())
