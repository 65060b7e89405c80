"""Section `integrated` of bench_throughput.py: the throws with air of bench_event_loop.py, at equal median error."""

import math
from collections.abc import Callable, Iterable

import diffrax
import numpy as np
from bench_event_loop import BALL, CEILING, LAW, MAX_BOUNCES, SCENE, T1, restarted, throws
from throughput_shared import Program, by_turns, has_c, on_devices, on_one_device, row

from nonholo_jax import Air, BallState, Integrated, simulate_batch

TOLERANCES = 1e-6, 1e-8
RESTARTED = 1024  # throws of the restarted solver: of 256, 1024 and 4096 its quickest batch here


def integrated(n: int, runs: int) -> list[dict]:
    """The library at each tolerance; C and the restarted solver at the loosest of a ladder of tolerances at which their
    median error, of the final position, is no larger than the library's."""
    states = throws(n)
    few = on_one_device(BallState(*(x[:RESTARTED] for x in (states.position, states.velocity, states.spin))))
    truth = _own(Integrated(solver=diffrax.Dopri8(), rtol=1e-12, atol=1e-12), sum_trains=False)(states).final.position
    truth = np.asarray(truth)
    program, rows = Program("runge_kutta.c", np.float64, MAX_BOUNCES) if has_c() else None, []
    for tolerance in TOLERANCES:
        own = _own(Integrated(rtol=tolerance, atol=tolerance))
        flat = _own(Integrated(rtol=tolerance, atol=tolerance), sum_trains=False)
        miss = np.linalg.norm(np.asarray(own(states).final.position) - truth, axis=-1)
        ways: dict[str, Callable] = on_devices(own, states)
        *_, widest = ways
        ways[f"{widest}, no trains"] = lambda flat=flat: flat(states).final
        used, errors = dict.fromkeys(ways, tolerance), dict.fromkeys(ways, float(np.median(miss)))

        def again(tolerance: float) -> tuple[Callable, float]:
            run = restarted(tolerance)
            return lambda: run(few), float(np.median(np.linalg.norm(run(few) - truth[:RESTARTED], axis=-1)))

        bound = float(np.median(miss[:RESTARTED]))
        ways["restarted"], used["restarted"], errors["restarted"] = _loosest(
            again, bound, (tolerance * 0.5**k for k in range(4))
        )
        if program is not None:
            in_c = lambda tolerance: _in_c(program, states, tolerance, truth)  # noqa: E731
            ladder = (tolerance * 10.0 ** (k / 8) for k in range(8, -9, -1))
            ways["C"], used["C"], errors["C"] = _loosest(in_c, errors[widest], ladder)
        rows += _rows(tolerance, ways, used, errors, n, len(few.position), runs)
    return rows


def _own(motion: Integrated, **how) -> Callable:
    return lambda states: simulate_batch(
        SCENE, states, t1=T1, max_impacts=MAX_BOUNCES, log_size=0, motion=motion, **how
    )


def _loosest(at: Callable, bound: float, ladder: Iterable[float]) -> tuple[Callable, float, float]:
    """The first way of a ladder of tolerances whose error is at most `bound`, or the last."""
    found = None
    for tolerance in ladder:
        way, error = at(tolerance)
        found = way, tolerance, error
        if error <= bound:
            break
    assert found is not None
    return found


def _in_c(program: Program, states: BallState, tolerance: float, truth: np.ndarray) -> tuple[Callable, float]:
    """runge_kutta.c, and its median error."""
    air, r = Air(), BALL.radius
    pressure = air.density * 0.5 * math.pi * r**2 / BALL.mass
    tangential = LAW.restitution if LAW.tangential is None else LAW.tangential
    grip = (1.0 + tangential) * BALL.inertia_ratio / (1.0 + BALL.inertia_ratio)
    forces = [9.81, pressure * air.drag, pressure * air.lift * r]
    law = [LAW.restitution, grip, r, grip / (BALL.inertia_ratio * r)]
    way = program.of(states, [r, CEILING - r, *forces, *law, T1, tolerance])
    return way, float(np.median(np.linalg.norm(way()[:3].T - truth, axis=-1)))


def _rows(tolerance: float, ways: dict, used: dict, errors: dict, n: int, few: int, runs: int) -> list[dict]:
    rows = []
    for name, (compiling, median, spread) in by_turns(ways, runs).items():
        count = few if name == "restarted" else n
        each = row("integrated", "float64", name, count / median, "throws/s", compiling, spread / median)
        rows.append(each | {"wanted": tolerance, "tolerance": used[name], "median_error": errors[name]})
    rates = {each["way"]: each["rate"] for each in rows}
    for each in rows:
        each["times_restarted"] = each["rate"] / rates["restarted"]
        if "C" in rates:
            each["of_c"] = each["rate"] / rates["C"]
    return rows
