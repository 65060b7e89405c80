"""A hundred million throws through the quick path of batches, each checked as it runs.

    python experiments/extremes/throws.py [--throws 1e8] [--out FOLDER] [--chunk N] [--json FILE]
    python experiments/extremes/throws.py --replay CHUNK LANE [--chunk N]

A throw is made as a whole, `simulate_batch(..., log_size=0)`, and once more impact by impact, each time from the state
in which the ball meets a surface (throws_tile.py). throws_check.py, which shares no code with the library, asks of
every arc and impact: is the flight a parabola, is the impact the law's, is energy kept, or lost as it should be, is the
angular momentum about the contact kept, is the ball outside everything at eight times of every arc, does it touch where
it bounces; and whether the whole throw ends where its steps do. Figures are in roundings. Every chunk of throws has a
restitution, roughness, inertia and radius of its own; three of four are in float32, one is in float64.

With --out, every chunk that is done is a line of FOLDER/chunks.jsonl; the same command goes on from there.
"""

import argparse
import functools
import json
import os
import pathlib
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.sharding import Mesh, PartitionSpec
from throws_check import BOUNDS, Ball
from throws_tile import FAMILIES, IMPACTS, TILE, VERSION, Family, Job, tile_of

from nonholo_jax._math.types import NAMES_OF_RESULTS

sys.path.append(str(pathlib.Path(__file__).parents[1]))  # for report.py
from report import machine

SHOWN = 8  # failures that are named
AHEAD = 2  # chunks that are begun, so that no device waits


# Chunks


def _in_parts(family: Family, dtype: Any, ball: Ball, told: Ball, key: Any, tiles: Any) -> dict:
    """What there is to say of some tiles, one after the other."""

    def one(number: Any) -> dict:
        tile = tile_of(family, ball, told, jax.random.fold_in(key, number), dtype)
        codes = jnp.arange(len(NAMES_OF_RESULTS), dtype=jnp.int32)[:, None] == tile.whole.code[None]
        return {
            "impacts": tile.whole.n_impacts.sum(),
            "corners": tile.rows.corner.sum(),
            "lost": tile.rows.lost.any(0).sum(),
            "worst": tile.figures.max(1),
            "results": codes.sum(1),
            "failed": tile.failed,
        }

    found = lax.map(one, tiles)
    summed = {name: found[name].sum(0)[None] for name in ("impacts", "corners", "lost", "results")}
    return {**summed, "worst": found["worst"].max(0)[None], "failed": found["failed"]}


@functools.cache
def program(family: str, dtype: str) -> Callable:
    """A chunk over all devices, compiled once for each size: of the arguments of `tile_of`, and the numbers of the
    tiles."""
    devices = np.array(jax.local_devices())
    parts = functools.partial(_in_parts, FAMILIES[family], np.dtype(dtype))
    specs = {
        "in_specs": (*[PartitionSpec()] * 3, PartitionSpec("tiles")),
        "out_specs": PartitionSpec("tiles"),
    }
    whole = jax.shard_map(parts, mesh=Mesh(devices, ("tiles",)), **specs, check_vma=False)
    return jax.jit(whole, compiler_options={"xla_cpu_prefer_vector_width": 512})


def arguments(job: Job) -> tuple[Ball, Ball, Any]:
    return job.ball(), job.ball(), jax.random.fold_in(jax.random.key(VERSION), job.chunk)


def done_one(job: Job, size: int, told: Ball | None = None) -> dict:
    """The line of one chunk."""
    ball, same, key = arguments(job)
    tiles = np.arange(size // TILE)
    found = jax.tree.map(np.asarray, program(job.family, job.dtype)(ball, told or same, key, tiles))
    results = found["results"].sum(0)
    return {
        "chunk": job.chunk,
        "family": job.family,
        "dtype": job.dtype,
        "throws": size,
        **{name: int(found[name].sum()) for name in ("impacts", "corners", "lost")},
        "results": {name: int(n) for name, n in zip(NAMES_OF_RESULTS, results, strict=True) if n},
        "worst": [float(x) for x in found["worst"].max(0)],
        "failed": int(found["failed"].sum()),
        "lanes": np.flatnonzero(found["failed"])[:SHOWN].tolist(),
    }


# A folder to go on from


class Lines:
    """The chunks that are done, kept in a folder where there is one. A line that a kill has cut short is dropped."""

    def __init__(self, folder: str | None, size: int):
        options = {"version": VERSION, "chunk": size, "impacts": IMPACTS, "tile": TILE, "bounds": [*BOUNDS.values()]}
        self.path = None if folder is None else pathlib.Path(folder) / "chunks.jsonl"
        self.chunks: dict[int, dict] = {}
        if self.path is None:
            return
        self.path.parent.mkdir(parents=True, exist_ok=True)
        whole = self._read() if self.path.exists() else []
        if whole and whole[0] != options:
            raise ValueError(f"Folder {folder} holds a study with {whole[0]}, not {options}; try another --out.")
        self.chunks = {line["chunk"]: line for line in whole[1:]}
        fresh = self.path.with_suffix(".new")
        fresh.write_text("".join(json.dumps(line) + "\n" for line in [options, *self.chunks.values()]))
        fresh.replace(self.path)

    def _read(self) -> list[dict]:
        assert self.path is not None
        whole = self.path.read_text().split("\n")[:-1]  # what follows the last end of a line is not one
        return [json.loads(line) for line in whole]

    def add(self, line: dict) -> None:
        self.chunks[line["chunk"]] = line
        if self.path is not None:
            with self.path.open("a") as file:
                file.write(json.dumps(line) + "\n")


def computed(jobs: list[Job], size: int) -> Iterator[dict]:
    """The lines of the chunks, in order. One is always waiting, so that no device is idle while a line is written."""
    with ThreadPoolExecutor(AHEAD) as pool:
        waiting: list = []
        try:
            for job in jobs:
                waiting.append(pool.submit(done_one, job, size))
                if len(waiting) == AHEAD:
                    yield waiting.pop(0).result()
            while waiting:
                yield waiting.pop(0).result()
        finally:
            for each in waiting:
                each.cancel()


# What is printed


def summary(lines: list[dict]) -> dict:
    """All chunks together, and the worst of each kind of throw."""
    total: dict = {
        name: sum(line[name] for line in lines) for name in ("throws", "impacts", "corners", "lost", "failed")
    }
    total["results"] = dict(sum((Counter(line["results"]) for line in lines), Counter()))
    worst: dict = {}
    for line in lines:
        at = worst.setdefault(f"{line['family']}, {line['dtype']}", {"throws": 0, "worst": [0.0] * len(BOUNDS)})
        at["throws"] += line["throws"]
        at["worst"] = np.maximum(at["worst"], line["worst"]).tolist()
    failures = [(line["chunk"], lane) for line in lines for lane in line["lanes"]][:SHOWN]
    return {**total, "kinds": dict(sorted(worst.items())), "failures": failures}


def printed(found: dict, seconds: float, new: int, cpu: float) -> None:
    kinds = found["kinds"]
    print(f"\n{'worst, in roundings':34}  bound  " + "  ".join(f"{name:>17}" for name in kinds))
    for i, (name, bound) in enumerate(BOUNDS.items()):
        print(f"{name:34}  {bound:5.0f}  " + "  ".join(f"{kind['worst'][i]:17.2f}" for kind in kinds.values()))
    print(f"{'throws':34}         " + "  ".join(f"{kind['throws']:17}" for kind in kinds.values()))
    results = ", ".join(f"{n} {name}" for name, n in sorted(found["results"].items(), key=lambda pair: -pair[1]))
    print(f"{found['throws']} throws, {found['impacts']} impacts, {found['corners']} of them on several surfaces")
    print(f"results: {results}; {found['lost']} lost on the way")
    for chunk, lane in found["failures"]:
        print(f"FAIL chunk {chunk}, lane {lane}: try --replay {chunk} {lane}")
    pace = f"{new} of them now, in {seconds:.0f} s ({cpu:.0f} s of processor time), {new / seconds:.3g} throws/s"
    print(f"{found['failed']} FAIL; {pace}; load average {os.getloadavg()[0]:.1f}")


def replay(job: Job, lane: int) -> int:
    """The log of one throw, and what was found of it."""
    number, at = divmod(lane, TILE)
    ball, told, key = arguments(job)
    one = functools.partial(tile_of, FAMILIES[job.family], dtype=np.dtype(job.dtype))
    tile = jax.tree.map(lambda x: np.asarray(x)[..., at], jax.jit(one)(ball, told, jax.random.fold_in(key, number)))
    print(f"{job}, lane {lane}\n{ball}")
    for k in range(int(tile.rows.live.sum())):
        row = jax.tree.map(lambda x, k=k: x[k], tile.rows)
        for name, moment in (("from", row.arc.begin), ("to", row.arc.end)):
            print(f"{name:>5}  " + "  ".join(f"{part} {x.tolist()}" for part, x in moment._asdict().items()))
        print(f"       seconds {row.arc.seconds:.17g}, strikes {row.arc.strikes}, corner {row.corner}, lost {row.lost}")
        print("       " + "  ".join(f"{x:.3g} {name}" for name, x in zip(BOUNDS, row.figures, strict=False)))
    whole = tile.whole
    print(f"whole  {NAMES_OF_RESULTS[int(whole.code)]}, {whole.n_impacts} impacts, {whole.time:.17g} s, ", end="")
    print(", ".join(f"{part} {x.tolist()}" for part, x in whole.moment._asdict().items()))
    print(f"       {tile.figures[-1]:.3g} {list(BOUNDS)[-1]}\n{'FAIL' if tile.failed else 'pass'}")
    return int(tile.failed)


def study(throws: int, size: int, lines: Lines) -> tuple[dict, float, int]:
    """All of it; and for how many seconds it has now worked on how many throws."""
    wanted = range(-(-throws // size))
    jobs = [Job.of(chunk) for chunk in wanted if chunk not in lines.chunks]
    begun = said = time.perf_counter()
    for line in computed(jobs, size):
        lines.add(line)
        if time.perf_counter() > said + 20.0:
            said = time.perf_counter()
            failed = sum(each["failed"] for each in lines.chunks.values())
            print(f"{said - begun:6.0f} s  {len(lines.chunks) * size:.3g} throws  {failed} FAIL", flush=True)
    found = summary([lines.chunks[chunk] for chunk in wanted])
    return found, time.perf_counter() - begun, len(jobs) * size


def use_every_core() -> None:
    """Make every core a device of its own; XLA reads this once, when JAX first computes."""
    flag = "--xla_force_host_platform_device_count"
    if flag not in os.environ.get("XLA_FLAGS", ""):
        os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {flag}={os.cpu_count()}"


def main() -> int:
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("--throws", type=float, default=1e8)
    parser.add_argument("--chunk", type=int, default=1 << 18, help="throws that share the numbers of the scene")
    parser.add_argument("--out", metavar="FOLDER")
    parser.add_argument("--json", metavar="FILE")
    parser.add_argument("--replay", type=int, nargs=2, metavar=("CHUNK", "LANE"))
    options = parser.parse_args()
    use_every_core()
    unit = TILE * len(jax.devices())
    if options.chunk < unit or options.chunk % unit:
        parser.error(f"--chunk must be a multiple of {unit}, but got {options.chunk}; try {1 << 18}")
    if options.replay:
        return replay(Job.of(options.replay[0]), options.replay[1])
    print(f"{machine()}, {len(jax.devices())} devices, load average {os.getloadavg()[0]:.1f}", flush=True)
    try:
        lines = Lines(options.out, options.chunk)
    except ValueError as error:
        parser.error(str(error))
    found, seconds, new = study(int(options.throws), options.chunk, lines)
    printed(found, seconds, new, time.process_time())
    if options.json:
        found = {"machine": machine(), "seconds": seconds, "new": new, "bounds": BOUNDS, **found}
        pathlib.Path(options.json).write_text(json.dumps(found, indent=1))
    return int(found["failed"] > 0)


if __name__ == "__main__":
    sys.exit(main())
