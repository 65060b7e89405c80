"""One flat event loop against restarting a solver at every bounce.

"flat" is this library for bounces alone (`sum_trains=False`), as the restarted solver does them, "untiled" the same
with all lanes in one loop instead of tiles of a few, and "trains" this library as it is by default: ready for bounces
that die out, which these throws have no time for.

A ball with drag and Magnus force between a floor and a ceiling, many different throws, 1.5 s, about 4 bounces each,
float64. All ways use Tsit5 with the same tolerances; errors of the final position are against a run at 1e-12. The
times are medians of interleaved runs after compilation, so that a busy machine slows both.

    python experiments/benchmarks/bench_event_loop.py [--throws 4096] [--runs 5] [--json FILE]
"""

import argparse
import json
import platform
import time

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx

from nonholo_jax import Air, Ball, BallState, Integrated, Plane, Rough, Scene, simulate

jax.config.update("jax_enable_x64", True)

T1, CEILING, MAX_BOUNCES = 1.5, 1.0, 16
BALL = Ball(radius=0.025, mass=0.046)
LAW = Rough(restitution=0.9, tangential=0.5)
SCENE = Scene(
    BALL,
    {
        "floor": Plane((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), LAW),
        "ceiling": Plane((0.0, 0.0, CEILING), (0.0, 0.0, -1.0), LAW),
    },
    air=Air(),
)


def throws(n: int) -> BallState:
    keys = jax.random.split(jax.random.key(0), 3)
    position = jnp.array([0.0, 0.0, 0.5]) + jax.random.uniform(keys[0], (n, 3), minval=-0.3, maxval=0.3)
    velocity = jax.random.uniform(keys[1], (n, 3), minval=-6.0, maxval=6.0)
    return BallState(position, velocity, 50.0 * jax.random.normal(keys[2], (n, 3)))


def restarted(tolerance: float):
    """vmap of a scan over bounces, each a `diffeqsolve` that ends at an event."""

    def field(t, y, spin):
        v = y[3:]
        _, a = SCENE.derivative(t, SCENE.unpacked(BallState(y[:3], v, spin)), tuple(y[:3]), tuple(v))
        return jnp.concatenate([v, jnp.stack([jnp.asarray(c, dtype=y.dtype) for c in a])])

    floor = lambda t, y, args, **_: y[2] - BALL.radius  # noqa: E731
    ceiling = lambda t, y, args, **_: CEILING - BALL.radius - y[2]  # noqa: E731
    finder = optx.Newton(1e-2 * tolerance, 1e-2 * tolerance)
    event = diffrax.Event([floor, ceiling], finder, direction=[False, False])

    def bounce(carry, _):
        t, y, spin = carry
        solution = diffrax.diffeqsolve(
            diffrax.ODETerm(field),
            diffrax.Tsit5(),
            t,
            T1,
            None,
            y,
            spin,
            saveat=diffrax.SaveAt(t1=True),
            stepsize_controller=diffrax.PIDController(rtol=tolerance, atol=tolerance),
            event=event,
            throw=False,
        )
        assert solution.ts is not None and solution.ys is not None
        end, y = solution.ts[0], solution.ys[0]
        state = SCENE.unpacked(BallState(y[:3], y[3:], spin))
        hit = jnp.where(y[2] < 0.5 * CEILING, 0, 1)
        after = SCENE.packed(SCENE.bounced(SCENE.choice(hit), end, state))
        going = end < T1
        velocity = jnp.where(going, after.velocity, y[3:])
        spin = jnp.where(going, after.spin, spin)
        return (end, jnp.concatenate([y[:3], velocity]), spin), None

    def run(state):
        y0 = jnp.concatenate([state.position, state.velocity])
        first = (jnp.asarray(0.0), y0, state.spin)
        (_, y, _), _ = jax.lax.scan(bounce, first, None, length=MAX_BOUNCES)
        return y[:3]

    return jax.jit(jax.vmap(run))


def flat(tolerance: float, sum_trains: bool = False, **how):
    """This library."""
    motion = Integrated(rtol=tolerance, atol=tolerance, **how)

    def run(state):
        options = {"max_impacts": MAX_BOUNCES, "log_size": 0, "throw": False, "sum_trains": sum_trains}
        return simulate(SCENE, state, t1=T1, motion=motion, **options).final.position

    return jax.jit(jax.vmap(run))


def seconds(function, states) -> float:
    begin = time.perf_counter()
    jax.block_until_ready(function(states))
    return time.perf_counter() - begin


def compiled(function, states) -> tuple[float, np.ndarray]:
    begin = time.perf_counter()
    result = np.asarray(jax.block_until_ready(function(states)))
    return time.perf_counter() - begin, result


def main() -> None:
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("--throws", type=int, default=4096)
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--json")
    options = parser.parse_args()
    states = throws(options.throws)
    reference = np.asarray(flat(1e-12)(states))
    machine = f"{jax.devices()[0].device_kind}, {platform.machine()}, Python {platform.python_version()}"
    print(f"{machine}, JAX {jax.__version__}, Diffrax {diffrax.__version__}, {options.throws} throws, float64")
    print(
        f"{'tolerance':>9}  {'way':>9}  {'throws/s':>9}  {'median error m':>14}  {'99 % m':>8}  {'compile s':>9}  ratio"
    )
    rows = []
    for tolerance in (1e-6, 1e-8, 1e-10):
        ways = {
            "restarted": restarted(tolerance),
            "flat": flat(tolerance),
            "untiled": flat(tolerance, tile=options.throws),
            "trains": flat(tolerance, sum_trains=True),
        }
        first = {name: compiled(way, states) for name, way in ways.items()}
        runs = {name: [] for name in ways}
        for _ in range(options.runs):
            for name, way in ways.items():
                runs[name].append(seconds(way, states))
        medians = {name: float(np.median(times)) for name, times in runs.items()}
        for name in ways:
            error = np.linalg.norm(first[name][1] - reference, axis=-1)
            row = {
                "tolerance": tolerance,
                "way": name,
                "throws_per_second": options.throws / medians[name],
                "median_error": float(np.median(error)),
                "error_99": float(np.quantile(error, 0.99)),
                "compile_seconds": first[name][0] - medians[name],
                "ratio": medians["restarted"] / medians[name],
            }
            rows.append(row)
            print(
                f"{tolerance:9.0e}  {name:>9}  {row['throws_per_second']:9.3g}  {row['median_error']:14.2g}  "
                f"{row['error_99']:8.1g}  {row['compile_seconds']:9.1f}  {row['ratio']:.1f}"
            )
    if options.json:
        with open(options.json, "w") as file:
            json.dump({"machine": machine, "jax": jax.__version__, "rows": rows}, file, indent=1)


if __name__ == "__main__":
    main()
