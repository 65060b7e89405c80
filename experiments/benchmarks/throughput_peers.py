"""Section `peers` of bench_throughput.py: seconds per throw at equal error, beside MuJoCo, MJX and Jaxonomy.

A ball drops from about 1 m onto an elastic floor and bounces four times; heights and vertical velocities vary. The
error is the distance from the closed form of the drop at the end, median and maximum over the batch. No rough ball is
thrown, for no peer can express one: spin and tangential velocity are zero, but the library runs its usual `Rough` law
on them. Everything runs on one thread or one JAX device. Seconds and rates are of processor time, all threads together,
for wall time on a shared machine measures the neighbours; compilation is apart, in wall time. A drop is a parabola,
which a Runge-Kutta method follows exactly at any tolerance: `Integrated` and Jaxonomy are left with the error of their
impact times.

MuJoCo has no impacts: a contact is a spring or a damper, and the floor is as stiff as the time step allows. `spring` is
the elastic contact of its documentation (Modeling, Restitution: damping 0) with half a period of exactly two steps, the
stiffest that gives the speed back under its Euler integrator; `RK4` the same with 0.3 radians a step; `damper` turns
the velocity round in one step, as its documentation has it for elastic impacts (Speculative contacts). Its ball is a
free joint with contacts that have no friction. MJX, vmapped, runs the damper. Both are of first order in the step: in
float64, a longer ladder would reach smaller errors, in time that grows as they shrink. Jaxonomy runs its own
BouncingBall, a state of two numbers, vmapped; its ladder is tolerances and how many bisections locate a crossing.

Install the peers with the extra `bench`, without constraints.txt: Jaxonomy asks for a JAX of its own.
"""

import contextlib
import importlib
import time
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from nonholo_jax import Ball, BallState, Exact, Integrated, Plane, Rough, Scene, simulate_batch

GRAVITY, RADIUS, MASS, DURATION = 9.81, 0.025, 0.046, 3.6
ENOUGH, PATIENCE = 0.3, 1.5  # seconds of processor time that all runs of a way should take at least, and at most
TARGETS = (1e-2, 1e-3, 1e-4, 1e-6, 1e-9)  # metres
STEPS = {"spring": (1e-3, 1e-4), "RK4": (1e-3, 1e-4), "damper": (1e-3, 3e-4, 1e-4, 3e-5, 1e-5)}  # MuJoCo, seconds
MJX_STEPS = {np.float64: (1e-3, 3e-4, 1e-4), np.float32: (3e-4,)}  # seconds
TOLERANCES = (1e-3, 1e-9)
EVENTS = ((1e-4, 20), (1e-6, 30), (1e-6, 40))  # Jaxonomy: tolerance, bisections; the last is its default
EVALUATIONS, MJX_THROWS, JAXONOMY_THROWS = 400_000, 64, 4096  # of MuJoCo a run; batches
IMPEDANCE = "0.9999 0.9999 0.001"  # the contact gives nearly all of the acceleration it asks for


class Drops(NamedTuple):
    """The throws of one batch: heights of the centre in m, vertical velocities in m/s, and where they end."""

    height: np.ndarray
    velocity: np.ndarray
    end: np.ndarray


def drops(n: int, dtype: Any = np.float64) -> Drops:
    """The first n throws, rounded to a dtype, with the closed form of their ends in float64."""
    spread = np.random.default_rng(2).uniform(-1.0, 1.0, (n, 2)).astype(dtype)
    height = np.asarray(RADIUS + 1.0 + 0.1 * spread[:, 0], dtype)
    velocity = np.asarray(0.5 * spread[:, 1], dtype)
    h, v = np.asarray(height, np.float64) - RADIUS, np.asarray(velocity, np.float64)
    speed = np.sqrt(v**2 + 2.0 * GRAVITY * h)
    since_first = DURATION - (v + speed) / GRAVITY
    period = 2.0 * speed / GRAVITY
    assert np.all((3.0 * period < since_first) & (since_first < 4.0 * period)), "four bounces each"
    t = since_first - 3.0 * period
    return Drops(height, velocity, RADIUS + t * (speed - 0.5 * GRAVITY * t))


class Way(NamedTuple):
    """A way to run a batch: `run` returns the positions at the end, heights alone or x, y, z."""

    name: str
    dtype: str
    batch: Drops
    run: Callable[[], Any]
    compiling: float | None = None  # seconds, if not to be had from the first run


def measured(way: Way, runs: int) -> dict:
    """A row of the table."""
    times, compiling, position = [], way.compiling, None
    if compiling is None:
        begin = time.perf_counter()
        jax.block_until_ready(way.run())
        compiling = time.perf_counter() - begin
    while not times or (sum(times) + times[-1] < PATIENCE and (len(times) < runs or sum(times) < ENOUGH)):
        begin = time.process_time()
        position = jax.block_until_ready(way.run())
        times.append(time.process_time() - begin)
    low, median, high = (float(x) for x in np.quantile(times, [0.25, 0.5, 0.75]))
    compiling = max(compiling - median, 0.0) if way.compiling is None else compiling
    n, off = len(way.batch.end), np.asarray(position, np.float64)
    off = np.abs(off - way.batch.end) if off.ndim == 1 else np.linalg.norm(off - _on_axis(way.batch.end), axis=1)
    row = {"section": "peers", "dtype": way.dtype, "way": way.name, "rate": n / median, "unit": "throws/s"}
    row |= {"compile_seconds": compiling, "spread": (high - low) / 2 / median, "throws": n, "seconds": median / n}
    return row | {"error": float(np.median(off)), "error_max": float(off.max())}


def _on_axis(heights: np.ndarray) -> np.ndarray:
    return np.stack([np.zeros_like(heights), np.zeros_like(heights), heights], axis=1)


def library(n: int) -> Iterator[Way]:
    """This library: `Exact` in both precisions, and `Integrated` at some tolerances."""
    scene = Scene(Ball(radius=RADIUS, mass=MASS), {"floor": Plane((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), Rough())})
    motions: list[tuple[str, Any, Any]] = [("Exact", np.float64, Exact()), ("Exact", np.float32, Exact())]
    motions += [(f"Integrated {tol:.0e}", np.float64, Integrated(rtol=tol, atol=tol)) for tol in TOLERANCES]
    for name, dtype, motion in motions:
        batch = drops(n, dtype)
        zero = jnp.zeros((n, 3), dtype)
        parts = zero.at[:, 2].set(batch.height), zero.at[:, 2].set(batch.velocity), zero
        states = jax.device_put(BallState(*parts), jax.devices()[0])

        def run(states=states, motion=motion):
            return simulate_batch(scene, states, t1=DURATION, motion=motion, max_impacts=16, log_size=0).final.position

        yield Way(name, np.dtype(dtype).name, batch, run)


def _model(mujoco: Any, step: float, contact: str, integrator: str) -> Any:
    """A ball that is free, and a floor, as MuJoCo has them."""
    solref = " ".join(f"{x:.17g}" for x in _solref(step, contact))
    geom = f'condim="1" solref="{solref}" solimp="{IMPEDANCE}"'
    return mujoco.MjModel.from_xml_string(
        f"""<mujoco>
        <option timestep="{step}" integrator="{integrator}" gravity="0 0 {-GRAVITY}"/>
        <worldbody>
            <geom type="plane" size="5 5 0.1" {geom}/>
            <body><freejoint/><geom type="sphere" size="{RADIUS}" mass="{MASS}" {geom}/></body>
        </worldbody></mujoco>"""
    )


def _solref(step: float, contact: str) -> tuple[float, float]:
    """Minus the stiffness (1/s^2) and minus the damping (1/s) of an elastic contact, per mass."""
    return {"spring": (-2.0 / step**2, 0.0), "RK4": (-((0.3 / step) ** 2), 0.0), "damper": (0.0, -2.0 / step)}[contact]


def mujoco_c(n: int) -> Iterator[Way]:
    """MuJoCo's own stepping, many steps a call; fewer throws where steps are many."""
    mujoco = _installed("mujoco", "MuJoCo")
    if mujoco is None:
        return
    for contact, steps in STEPS.items():
        for step in steps:
            model = _model(mujoco, step, contact, "RK4" if contact == "RK4" else "Euler")
            data, count = mujoco.MjData(model), round(DURATION / step)
            evaluations = count * (4 if contact == "RK4" else 1)
            batch = drops(int(np.clip(EVALUATIONS // evaluations, 4, n)))

            def run(model=model, data=data, count=count, batch=batch):
                ends = np.empty((len(batch.end), 3))
                for i, (height, velocity) in enumerate(zip(batch.height, batch.velocity, strict=True)):
                    mujoco.mj_resetData(model, data)
                    data.qpos[:3] = 0.0, 0.0, height
                    data.qvel[2] = velocity
                    mujoco.mj_step(model, data, count)
                    ends[i] = data.qpos[:3]
                return ends

            yield Way(f"MuJoCo {contact} {step:.0e}", "float64", batch, run, 0.0)


def mjx(n: int) -> Iterator[Way]:
    """MJX, vmapped and jitted; one program for all steps of a precision."""
    mujoco, jax_mujoco = _installed("mujoco", None), _installed("mujoco.mjx", "MJX")
    if mujoco is None or jax_mujoco is None:
        return
    n = min(n, MJX_THROWS)
    for dtype, steps in MJX_STEPS.items():
        precision = contextlib.nullcontext() if dtype == np.float64 else jax.enable_x64(False)
        with precision:
            compiled, seconds = _mjx_compiled(mujoco, jax_mujoco, n)
        for step in steps:
            batch, count = drops(n, dtype), np.int32(round(DURATION / step))
            numbers = dtype(step), np.asarray(_solref(step, "damper"), dtype), count
            inputs = jax.device_put((*numbers, batch.height, batch.velocity), jax.devices()[0])

            def run(compiled=compiled, inputs=inputs):
                return compiled(*inputs)

            yield Way(f"MJX damper {step:.0e}", np.dtype(dtype).name, batch, run, seconds)
            seconds = 0.0


def _mjx_compiled(mujoco: Any, jax_mujoco: Any, n: int) -> tuple[Any, float]:
    """The ends of n throws as a compiled function of the step, the contact, the number of steps, and the throws."""
    model = _model(mujoco, 1e-3, "damper", "Euler")
    model.opt.iterations, model.opt.ls_iterations = 1, 4  # one contact: the answer is the same as with more
    on_device = jax_mujoco.put_model(model)
    at_rest = jax_mujoco.make_data(model)

    def one(step, solref, count, height, velocity):
        solrefs = jnp.broadcast_to(solref, on_device.geom_solref.shape)
        changed = on_device.tree_replace({"opt.timestep": step, "geom_solref": solrefs})
        state = at_rest.replace(qpos=at_rest.qpos.at[2].set(height), qvel=at_rest.qvel.at[2].set(velocity))
        return jax.lax.fori_loop(0, count, lambda _, state: jax_mujoco.step(changed, state), state).qpos[:3]

    dtype = on_device.opt.timestep.dtype
    number, throws = jax.ShapeDtypeStruct((), dtype), jax.ShapeDtypeStruct((n,), dtype)
    shapes = number, jax.ShapeDtypeStruct((2,), dtype), jax.ShapeDtypeStruct((), np.int32), throws, throws
    begin = time.perf_counter()
    compiled = jax.jit(jax.vmap(one, in_axes=(None, None, None, 0, 0))).lower(*shapes).compile()
    return compiled, time.perf_counter() - begin


def jaxonomy(n: int) -> Iterator[Way]:
    """Jaxonomy's BouncingBall, restarted at every zero crossing by its simulator, vmapped and jitted."""
    package, models = _installed("jaxonomy.simulation", "Jaxonomy"), _installed("jaxonomy.models", None)
    if package is None or models is None:
        return
    batch = drops(min(n, JAXONOMY_THROWS))
    states = jax.device_put(jnp.stack([batch.height, batch.velocity], axis=1), jax.devices()[0])
    for tolerance, bisections in EVENTS:
        ball = models.BouncingBall(g=GRAVITY, e=1.0, b=0.0, h0=RADIUS)
        accuracy = {"rtol": tolerance, "atol": 1e-2 * tolerance, "zc_bisection_loop_count": bisections}
        options = package.SimulatorOptions(math_backend="jax", max_major_steps=100, **accuracy)
        simulator, context = package.Simulator(ball, options=options), ball.create_context()

        def end(state, simulator=simulator, context=context):
            return simulator.advance_to(DURATION, context.with_continuous_state(state)).context.continuous_state[0]

        begin = time.perf_counter()
        compiled = jax.jit(jax.vmap(end)).lower(states).compile()
        seconds = time.perf_counter() - begin
        name = f"Jaxonomy {tolerance:.0e}, {bisections}"
        yield Way(name, "float64", batch, lambda compiled=compiled: compiled(states), seconds)


def _installed(module: str, name: str | None) -> Any:
    """The module, or None and, given a name, a line that says so."""
    try:
        return importlib.import_module(module)
    except ImportError as error:
        if name:
            print(f"{name} is skipped ({error}); to install it: pip install -e '.[bench]'")
        return None


def compared(rows: list[dict], own: list[dict]) -> None:
    """Add to a peer's rows how many times as long a throw takes as in the library, at errors no larger."""
    for r in rows:
        for motion in ("Exact", "Integrated"):
            reach = [o["seconds"] for o in own if o["way"].startswith(motion) and _as_good(o, r)]
            if reach:
                r[f"times_{motion.lower()}"] = r["seconds"] / min(reach)


def _as_good(one: dict, other: dict) -> bool:
    return one["error"] <= other["error"] and one["error_max"] <= other["error_max"]


def summary(name: str, rows: list[dict]) -> None:
    """Print the cheapest way of a peer to reach each error, and the best that it reached where one was not reached."""
    smallest: dict[str, float] = {}  # error that each of these ways is the cheapest to reach
    for target in TARGETS:
        reached = [r for r in rows if r["error"] <= target]
        if reached:
            smallest[_told(min(reached, key=lambda r: r["seconds"]))] = target
    for told, target in smallest.items():
        print(f"{name}: {target:.0e} m reached by {told}")
    best = min(rows, key=lambda r: r["error"])
    if best["error"] > TARGETS[-1]:
        missed = max(target for target in TARGETS if target < best["error"])
        print(f"{name}: {missed:.0e} m not reached on this ladder, the best is {_told(best)}")


def _told(r: dict) -> str:
    ratios = [f"{r[key]:.3g} times {motion}" for motion, key in
              (("Exact", "times_exact"), ("Integrated", "times_integrated")) if key in r]  # fmt: skip
    told = " and ".join(ratios) or "which the library does not reach"
    return f"{r['way']} ({r['dtype']}): {r['error']:.1e} m in {r['seconds']:.2e} s, {told}"


def peers(n: int, runs: int) -> list[dict]:
    """Rows of all ways; `error` and `error_max` in m, `seconds` per throw, `throws` the size of the batch."""
    if jax.default_backend() != "cpu":
        print(
            "peers is skipped: it measures processor time, and this JAX runs on an accelerator; try JAX_PLATFORMS=cpu"
        )
        return []
    own = [measured(way, runs) for way in library(n)]
    rows = list(own)
    for name, ways in {"MuJoCo": mujoco_c, "MJX": mjx, "Jaxonomy": jaxonomy}.items():
        new = [measured(way, runs) for way in ways(n)]
        if new:
            compared(new, own)
            summary(name, new)
        rows += new
    return rows
