"""How long a command takes, start to end, picture included: without kept programs, with them, for other numbers.

    python experiments/benchmarks/bench_command_line.py

Runs `nonholo design` of the throw under a table and `nonholo simulate` of a serve, each once a row, with a cache of
their own that begins empty. Other numbers are another spin, velocity, table height, restitution and t1. Of the throw
under the table restitution is 0.9 in the second row and 0.95 in the fourth, since 1 is structure.
"""

import os
import pathlib
import subprocess
import sys
import tempfile
import time

ROOT = pathlib.Path(__file__).parents[2]
sys.path.append(str(ROOT / "experiments"))
from report import machine  # noqa: E402

START = "import sys; from nonholo_jax.cli import main; sys.exit(main())"
COMMANDS = {"design": "under_the_table", "simulate": "table_tennis_serve"}
OTHER = {
    "under_the_table": {
        "restitution = 0.9 ": "restitution = 0.95 ",
        "0.715]": "0.72]",
        "t1 = 2.0": "t1 = 1.9",
        "velocity = [2.0": "velocity = [2.1",
        "spin = [0.0, 0.0": "spin = [0.0, 1.0",
    },
    "table_tennis_serve": {
        "restitution = 0.876": "restitution = 0.88",
        "[0.0, 0.0, 0.745]": "[0.0, 0.0, 0.75]",
        "t1 = 1.0": "t1 = 0.9",
        "velocity = [6.3": "velocity = [6.4",
        "spin = [0.0, 80.0": "spin = [0.0, 85.0",
    },
}


def other_numbers(text: str, name: str) -> str:
    for old, new in OTHER[name].items():
        assert old in text, old
        text = text.replace(old, new)
    return text


def seconds(verb: str, scene: pathlib.Path, folder: str, *more: str, cache: str = "off") -> float:
    environment = {**os.environ, "NONHOLO_CACHE": cache}
    command = [sys.executable, "-c", START, verb, str(scene), "--out", folder, *more]
    begun = time.perf_counter()
    done = subprocess.run(command, capture_output=True, text=True, env=environment, cwd=ROOT)
    assert done.returncode in (0, 3), done.stderr
    return time.perf_counter() - begun


def main() -> int:
    print(machine())
    print(f"{'':36s}{'no cache':>10s}{'first':>10s}{'second':>10s}{'other numbers':>15s}")
    for verb, name in COMMANDS.items():
        with tempfile.TemporaryDirectory() as folder:
            text = (ROOT / f"experiments/scenes/{name}.toml").read_text()
            if name == "under_the_table":
                text = text.replace("restitution = 1.0", "restitution = 0.9")
            scene, cache = pathlib.Path(folder) / f"{name}.toml", str(pathlib.Path(folder) / "cache")
            scene.write_text(text)
            row = [seconds(verb, scene, folder)]
            row += [seconds(verb, scene, folder, cache=cache) for _ in range(2)]
            scene.write_text(other_numbers(text, name))
            row.append(seconds(verb, scene, folder, cache=cache))
        print(f"{f'{verb} {name}':36s}{row[0]:10.1f}{row[1]:10.1f}{row[2]:10.1f}{row[3]:15.1f} s", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
