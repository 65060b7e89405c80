"""How many bounces a second, beside C programs; gradients beside values; scaling.

Sections: `limit`, floor and ceiling, elastic, 64 impacts of each throw, beside bounces.c, on one device and on all;
`table`, throws under a table, a Box, beside table.c; `integrated`, throws with air, beside `diffrax.diffeqsolve`
restarted at every bounce and runge_kutta.c, at equal median error; `gradient`, a scalar of the end against that and its
gradient in nine inputs, 16 impacts; `scaling`, with batch size, impacts and surfaces, with compilation time beside it;
`peers`, a drop with four elastic bounces beside MuJoCo, MJX and Jaxonomy, where installed, at equal error.
The C programs are compiled here (-O3, OpenMP, state in registers). All ways of a section run by turns, medians after
compilation, each way as often in a turn as takes 50 ms.

On an accelerator the C programs are left out. With what the device can do at most, operations a second (of float32 and,
if given, of float64) and bytes a second of its memory, rows that bounce between floor and ceiling say what part of it
they reach, at the operations of bounces.c and one passage of the state through memory for every bounce.

    python experiments/benchmarks/bench_throughput.py [--sections limit,table] [--throws 1048576] [--runs 5]
        [--json FILE] [--peak-flops FLOAT32 [FLOAT64]] [--peak-bytes BYTES]
"""

import argparse
import json
import os
import pathlib
import sys
from collections.abc import Callable
from typing import NamedTuple

import jax
from throughput_bounces import limit, table
from throughput_gradient import gradient
from throughput_integrated import integrated
from throughput_peers import peers
from throughput_scaling import scaling

sys.path.append(str(pathlib.Path(__file__).parents[1]))  # for report.py
from report import machine


class Section(NamedTuple):
    run: Callable[[int, int], list[dict]]  # of a number of throws and of runs
    part: int = 1  # of --throws, that it is run with


SECTIONS = {
    "limit": Section(limit),
    "table": Section(table),
    "integrated": Section(integrated, 64),
    "gradient": Section(gradient, 64),
    "scaling": Section(scaling),
    "peers": Section(peers, 16),
}


def with_limits(rows: list[dict], flops: list[float], bandwidth: float | None) -> list[dict]:
    """The rows, with the part of the device's limits that they reach."""
    peak = dict(zip(("float32", "float64"), flops, strict=False))
    for r in rows:
        if "flops_each" in r and r["dtype"] in peak:
            r["of_flops"] = r["rate"] * r["flops_each"] / peak[r["dtype"]]
        if "bytes_each" in r and bandwidth:
            r["of_bytes"] = r["rate"] * r["bytes_each"] / bandwidth
    return rows


def printed(rows: list[dict]) -> None:
    for r in rows:
        extra = f"  {r['of_c']:.3f} of C" if "of_c" in r else ""
        extra += f"  {r['times_value']:.1f} x value" if "times_value" in r else ""
        extra += f"  {r['times_restarted']:.1f} x restarted" if "times_restarted" in r else ""
        if "median_error" in r:
            extra += f"  median error {r['median_error']:.1e} m, tolerance {r['tolerance']:.1e}"
        extra += f"  error {r['error']:.1e}, at most {r['error_max']:.1e} m, of {r['throws']}" if "error" in r else ""
        extra += "".join(f"  {r[key]:.3g} x {key[6:]}" for key in ("times_exact", "times_integrated") if key in r)
        extra += f"  {r['of_flops']:.2%} of peak flops" if "of_flops" in r else ""
        extra += f"  {r['of_bytes']:.2%} of peak bytes" if "of_bytes" in r else ""
        extra += f"  budget {r['budget_seconds']:.0f} s" if "budget_seconds" in r else ""
        head = f"{r['section']:>10}  {r['dtype']:>8}  {r['way']:>28}"
        timing = f"+- {r['spread']:4.0%}  compile {r['compile_seconds']:5.1f} s"
        print(f"{head}  {r['rate']:9.3g} {r['unit']:11}  {timing}{extra}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("--sections", default=",".join(SECTIONS))
    parser.add_argument("--throws", type=int, default=1 << 20)
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--json")
    parser.add_argument("--peak-flops", type=float, nargs="+", default=[], help="of all devices, float32 then float64")
    parser.add_argument("--peak-bytes", type=float, help="a second, of all devices")
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
        printed(with_limits(new, options.peak_flops, options.peak_bytes))
        rows += new
    if options.json:
        pathlib.Path(options.json).write_text(json.dumps({"machine": machine(), "rows": rows}, indent=1))


if __name__ == "__main__":
    main()
