"""What a Monte Carlo study costs beside the batches that it is made of: sampling, measures, sums, files.

For scenes with a [monte_carlo] table: throws a second of `simulate_batch` alone on throws drawn before, with the same
log, what varies of the scene mapped, in batches of the size of a chunk; of `monte_carlo` without and with a folder; by
turns, on one device and, in a process of its own, on as many as there are cores.

    python experiments/benchmarks/bench_montecarlo.py [--throws 262144] [--runs 3] [--devices N]
"""

import argparse
import os
import pathlib
import subprocess
import sys
import tempfile

EXPERIMENTS = pathlib.Path(__file__).parents[1]
SCENES = ("superball_under_table", "table_tennis_serve")
CHUNK = 16_384


def measure(n: int, runs: int) -> None:
    import equinox as eqx
    import jax
    from throughput_shared import by_turns

    from nonholo_jax import monte_carlo, simulate_batch
    from nonholo_jax._ensembles.sampler import halves, uniforms
    from nonholo_jax.scene_file import load_scene

    for name in SCENES:
        file = load_scene(EXPERIMENTS / "scenes" / f"{name}.toml")
        assert file.monte_carlo is not None and file.simulate is not None
        sampler, how = file.monte_carlo.sampler, file.simulate.arguments
        arguments = {**file.monte_carlo.arguments, **how, "n": n, "chunk": CHUNK}

        @eqx.filter_jit
        def drawn(index, sampler=sampler, file=file):
            def one(lane):
                u = uniforms(jax.random.key(0), lane, (sampler.n_uniform(file.scene),), sampler.throw.position.dtype)
                return sampler.applied(file.scene, sampler.values(file.scene, u))

            return jax.vmap(one)(index)

        import numpy as np

        scenes, states = drawn(halves(np.arange(CHUNK)))
        axes = jax.tree.map(lambda x: 0 if eqx.is_array(x) and _varies(np.asarray(x)) else None, scenes)
        scenes = jax.tree.map(lambda x, axis: x[0] if eqx.is_array(x) and axis is None else x, scenes, axes)
        rows = arguments["itinerary_length"]

        def batches(scenes=scenes, states=states, axes=axes, rows=rows, how=how):
            options = {**how, "log_size": rows, "scene_axes": axes}
            return [simulate_batch(scenes, states, **options).final.position for _ in range(-(-n // CHUNK))]

        def study(arguments=arguments, file=file, **more):
            return monte_carlo(file.scene, **arguments, **more).sums.throws

        def kept(study=study):
            with tempfile.TemporaryDirectory() as folder:
                return study(out=folder)

        ways = {"simulate_batch": batches, "monte_carlo": study, "monte_carlo, kept in a folder": kept}
        timed = by_turns(ways, runs)
        base = timed["simulate_batch"][1] / (-(-n // CHUNK) * CHUNK)
        for way, (compiling, median, spread) in timed.items():
            count = -(-n // CHUNK) * CHUNK if way == "simulate_batch" else n
            each = median / count
            head = f"{name:22} {len(jax.devices())} devices  {way:30} {1 / each:9.3g} throws/s"
            times = f"+- {spread / median:4.0%}  compile {compiling:5.1f} s"
            print(f"{head}  {times}  {base / each:.2f} of simulate_batch", flush=True)


def _varies(x) -> bool:
    return bool((x != x[:1]).any())


def main() -> None:
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("--throws", type=int, default=262_144)
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--devices", type=int)
    options = parser.parse_args()
    if options.devices is not None:
        measure(options.throws, options.runs)
        return
    sys.path.append(str(EXPERIMENTS))  # for report.py
    from report import machine

    print(f"{machine()}, {options.throws} throws, chunks of {CHUNK}", flush=True)
    for devices in sorted({1, os.cpu_count() or 1}):
        flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count={devices}"
        command = [sys.executable, __file__, "--devices", str(devices)]
        command += ["--throws", str(options.throws), "--runs", str(options.runs)]
        subprocess.run(command, env={**os.environ, "XLA_FLAGS": flags}, check=True)


if __name__ == "__main__":
    main()
