"""Is a Monte Carlo study the same however often it dies, and wherever it runs? Of the superball under the table.

`kills`: `nonholo montecarlo` killed by SIGKILL at random moments and resumed each time; every file of its folder is
compared, byte for byte, with that of an undisturbed run. `places`: the same throws on 1, 2 and 4 devices, by 1 and 2
processes, in chunks of 1,000 and of 65,536, compared throw by throw with the first of these.

    python experiments/studies/montecarlo_anywhere.py [--sections kills,places] [--throws N] [--kills 10] [--seed 0]
"""

import argparse
import itertools
import os
import pathlib
import signal
import socket
import subprocess
import sys
import tempfile
import time

import numpy as np

from nonholo_jax import Ensemble

sys.path.append(str(pathlib.Path(__file__).parents[1]))  # for report.py
from report import Check, table

SCENE = pathlib.Path(__file__).parents[1] / "scenes" / "superball_under_table.toml"
QUANTITIES = ("distance", "second_landing.x", "second_landing.y")
THROWS = {"kills": 1_000_000, "places": 131_072}
CHUNK_OF_KILLS = 4096
DEVICES, PROCESSES, CHUNKS = (1, 2, 4), (1, 2), (1000, 65_536)


def start(folder: pathlib.Path, n: int, chunk: int, *more: str, devices: int | None = None) -> subprocess.Popen:
    """The command; on as many devices as cores, unless told otherwise."""
    environment = dict(os.environ)
    if devices is not None:
        flag = f"--xla_force_host_platform_device_count={devices}"
        environment["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {flag}"
    program = "import sys; from nonholo_jax.cli import main; sys.exit(main())"
    command = [sys.executable, "-c", program, "montecarlo", str(SCENE), "-n", str(n), "--chunk", str(chunk)]
    command += ["--records", "all", "--out", str(folder), "--no-plot", "--json", *more]
    return subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def finished(process: subprocess.Popen) -> None:
    _, error = process.communicate()
    if process.returncode:
        raise RuntimeError(f"nonholo montecarlo ended with {process.returncode}: {error}")


def chunks_in(folder: pathlib.Path) -> int:
    return len(list((folder / "chunks").glob("*.npz")))


def files_in(folder: pathlib.Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def kills(room: pathlib.Path, n: int, count: int, seed: int) -> list[Check]:
    """Every fifth time before the first chunk of a process, otherwise while it writes one after the other."""
    whole, folder, began = room / "whole", room / "killed", time.monotonic()
    process = start(whole, n, CHUNK_OF_KILLS)
    while process.poll() is None and not chunks_in(whole):
        time.sleep(0.01)
    first = time.monotonic() - began
    finished(process)
    work = time.monotonic() - began - first
    rng, done = np.random.default_rng(seed), 0
    for i in range(count):
        there = chunks_in(folder)
        process = start(folder, n, CHUNK_OF_KILLS, "--resume")
        early = i % 5 == 0
        while not early and process.poll() is None and chunks_in(folder) == there:
            time.sleep(0.001)
        try:
            process.wait(rng.uniform(0.0, first if early else work / 8.0))
        except subprocess.TimeoutExpired:
            process.send_signal(signal.SIGKILL)
            done += 1
        process.communicate()
        print(f"  {done} times killed: {chunks_in(folder)} of {chunks_in(whole)} chunks are there", flush=True)
    finished(start(folder, n, CHUNK_OF_KILLS, "--resume"))
    expected, found = files_in(whole), files_in(folder)
    left = [name for name in found if name not in expected]
    differ = [name for name, data in expected.items() if found.get(name) != data]
    print(f"  {len(expected)} files of {sum(map(len, expected.values())) / 1e6:.1f} MB; left over {left[:3]}")
    return [
        Check(f"{n} throws, SIGKILL: how often", done, count - 0.5, above=True),
        Check("files that differ from the undisturbed run's", len(differ), 0, unit=", ".join(differ[:3])),
        Check("files left over", len(left), 0, unit=", ".join(left[:3])),
    ]


def study(folder: pathlib.Path, n: int, devices: int, processes: int, chunk: int) -> Ensemble:
    if processes == 1:
        finished(start(folder, n, chunk, devices=devices))
        return Ensemble.open(folder)
    with socket.socket() as free:
        free.bind(("localhost", 0))
        coordinator = f"localhost:{free.getsockname()[1]}"
    shared = ("--coordinator", coordinator, "--processes", str(processes), "--process")
    running = [start(folder, n, chunk, *shared, str(k), devices=devices) for k in range(processes)]
    for process in running:
        finished(process)
    return Ensemble.open(folder)


def places(room: pathlib.Path, n: int) -> list[Check]:
    rows: list[Check] = []
    base, expected = None, {}
    for devices, processes, chunk in itertools.product(DEVICES, PROCESSES, CHUNKS):
        name = f"{devices} devices, {processes} processes, chunks of {chunk}"
        began = time.monotonic()
        found = study(room / f"{devices}_{processes}_{chunk}", n, devices, processes, chunk)
        read = found.records().to_table().sort_by("throw")
        columns = {column: read[column].to_numpy() for column in read.column_names}
        print(f"  {name}: {time.monotonic() - began:.0f} s", flush=True)
        if base is None:
            base, expected = found, columns
            continue
        inputs = [np.array_equal(columns[x], expected[x]) for x in ("throw", *found.about["inputs"])]
        same = [np.array_equal(columns[x], expected[x]) for x in ("itinerary", "result", "hand")]
        apart = [np.nanmax(np.abs(columns[x] - expected[x])) for x in QUANTITIES]
        means = [abs(found.mean(x) / base.mean(x) - 1.0) for x in ("hand", *QUANTITIES[:2])]
        errors = [abs(found.standard_error(x) / base.standard_error(x) - 1.0) for x in ("hand", *QUANTITIES)]
        rows += [
            Check(f"{name}: columns of inputs that differ in a bit", inputs.count(False), 0),
            Check("    columns of itineraries, results, events that differ", same.count(False), 0),
            Check("    greatest difference of a measured number", float(np.max(apart)), 1e-8, unit="m"),
            Check("    greatest relative difference of a mean", float(np.max(means)), 1e-10),
            Check("    greatest relative difference of a standard error", float(np.max(errors)), 1e-8),
        ]
    return rows


def main() -> int:
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("--sections", default="kills,places")
    parser.add_argument("--throws", type=int)
    parser.add_argument("--kills", type=int, default=10)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    code = 0
    for section in options.sections.split(","):
        n = options.throws or THROWS[section]
        print(section, flush=True)
        with tempfile.TemporaryDirectory() as folder:
            room = pathlib.Path(folder)
            rows = kills(room, n, options.kills, options.seed) if section == "kills" else places(room, n)
        code |= table(f"A study of {n} throws", rows)
    return code


if __name__ == "__main__":
    sys.exit(main())
