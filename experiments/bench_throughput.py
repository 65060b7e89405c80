"""How many bounces a second, beside C programs; gradients beside values; scaling.

Sections: `limit`, floor and ceiling, elastic, 64 impacts of each throw, beside bounces.c, on one device and on all;
`table`, throws under a table, a Box, beside table.c; `integrated`, throws with air, beside `diffrax.diffeqsolve`
restarted at every bounce and runge_kutta.c, at equal median error; `gradient`, a scalar of the end against that and its
gradient in nine inputs, 16 impacts; `scaling`, with batch size, impacts and surfaces, with compilation time beside it.
The C programs are compiled here (-O3, OpenMP, state in registers). All ways of a section run by turns, medians after
compilation, each way as often in a turn as takes 50 ms.

    python experiments/bench_throughput.py [--sections limit,table] [--throws 1048576] [--runs 5] [--json FILE]
"""

import argparse
import json
import os
import pathlib
from collections.abc import Callable
from typing import NamedTuple

import jax
from report import machine
from throughput_bounces import limit, table
from throughput_gradient import gradient
from throughput_integrated import integrated
from throughput_scaling import scaling


class Section(NamedTuple):
    run: Callable[[int, int], list[dict]]  # of a number of throws and of runs
    part: int = 1  # of --throws, that it is run with


SECTIONS = {
    "limit": Section(limit),
    "table": Section(table, 16),
    "integrated": Section(integrated, 64),
    "gradient": Section(gradient, 64),
    "scaling": Section(scaling),
}


def printed(rows: list[dict]) -> None:
    for r in rows:
        extra = f"  {r['of_c']:.3f} of C" if "of_c" in r else ""
        extra += f"  {r['times_value']:.1f} x value" if "times_value" in r else ""
        extra += f"  {r['times_restarted']:.1f} x restarted" if "times_restarted" in r else ""
        if "median_error" in r:
            extra += f"  median error {r['median_error']:.1e} m, tolerance {r['tolerance']:.1e}"
        head = f"{r['section']:>10}  {r['dtype']:>8}  {r['way']:>24}"
        timing = f"+- {r['spread']:4.0%}  compile {r['compile_seconds']:5.1f} s"
        print(f"{head}  {r['rate']:9.3g} {r['unit']:11}  {timing}{extra}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("--sections", default=",".join(SECTIONS))
    parser.add_argument("--throws", type=int, default=1 << 20)
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--json")
    options = parser.parse_args()
    unknown = set(options.sections.split(",")) - set(SECTIONS)
    if unknown:
        parser.error(f"--sections must be of {', '.join(SECTIONS)}, but got {', '.join(sorted(unknown))}")
    load = f"load average {os.getloadavg()[0]:.1f}"
    print(f"{machine()}, {len(jax.devices())} devices, {options.throws} throws, {load}")
    rows = []
    for name in options.sections.split(","):
        section = SECTIONS[name]
        new = section.run(max(options.throws // section.part, 1), options.runs)
        printed(new)
        rows += new
    if options.json:
        pathlib.Path(options.json).write_text(json.dumps({"machine": machine(), "rows": rows}, indent=1))


if __name__ == "__main__":
    main()
