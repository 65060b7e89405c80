"""The command line: `nonholo VERB SCENE.toml`. Only this file and `cache.py` touch JAX's configuration."""

import argparse
import contextlib
import gc
import importlib
import json
import math
import os
import sys
import threading
import time
from collections.abc import Iterator
from importlib import metadata
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

from .cache import programs_kept
from .clock import BEGAN, CPU_BEFORE
from .report import finite, motion_of, state_of, table_of, unit_of

DONE, BAD_INPUT, FAILED = 0, 2, 3
_IN_BOTH = (
    "tradeoff",
    "bench",
)  # verbs that compute in float64 and in float32, and write their rows beside the picture


_TABLES = (("simulate", "t1 = 2.0"), ("design", 'free = ["spin.y"] and a goal'),
           ("monte_carlo", "n = 100_000 and [[monte_carlo.vary]]"))  # fmt: skip


class _BadInput(Exception):
    """Something that the user can put right; the message is one line."""


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        raise _BadInput(f"{message}; see nonholo --help")


class _Answer(NamedTuple):
    """What a verb found: for machines, for people, and for the picture."""

    report: dict[str, Any]
    text: list[str]
    trajectory: Any
    drawing: dict[str, Any]
    failure: str | None


def main(argv: list[str] | None = None) -> int:
    """Run the command line.

    **Arguments:** `argv`, the words behind `nonholo`; `None` for those of the process.

    Returns the exit code: 0 done, 2 bad input (one line on standard error), 3 the computation failed.

    ```python
    from nonholo_jax.cli import main
    main(["simulate", "no_such_file.toml"])
    ```
    """
    try:
        options = _parser().parse_args(argv)
        if argv is None:
            _choose_for_xla(options.verb)
            # Tracing makes many objects that stay: to look for garbage among them again and again takes a tenth of it.
            gc.set_threshold(100_000, 50, 50)
        return _run(options, from_start=argv is None)
    except _BadInput as error:
        print(f"nonholo: {' '.join(str(error).split())}", file=sys.stderr)
        return BAD_INPUT
    except BrokenPipeError:  # the reader of a pipe has gone; nothing may be written any more, not even at exit
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return DONE
    except SystemExit as end:  # --help
        return int(end.code or DONE)


def _parser() -> argparse.ArgumentParser:
    what = (
        "Rough balls that fly and bounce: simulate a throw, design one, draw many, or measure errors, times and rates."
    )
    codes = "Exit code: 0 done, 2 bad input, 3 the computation failed."
    from . import bench_verb, montecarlo_verb

    parser = _Parser("nonholo", description=what, epilog=codes, allow_abbrev=False)
    parser.add_argument("--version", action="version", version=f"nonholo_jax {metadata.version('nonholo_jax')}")
    verbs = parser.add_subparsers(dest="verb", metavar="VERB", required=True)
    for verb, purpose in (
        ("simulate", "simulate the throw of a scene file"),
        ("design", "find the throw that reaches the goal of a scene file"),
        ("tradeoff", "measure error against time for every way to run a scene file"),
        ("montecarlo", "draw many throws of a scene file and say what they do"),
        ("bench", "measure throws and bounces a second on every device, of a scene file or of three scenes"),
    ):
        each = verbs.add_parser(verb, help=purpose, description=purpose.capitalize() + ".", allow_abbrev=False)
        count: dict[str, Any] = {"nargs": "?"} if verb == "bench" else {}
        each.add_argument(
            "scene", metavar="SCENE.toml", help="scene file; see experiments/scenes for examples", **count
        )
        each.add_argument("--json", action="store_true", help="print one JSON object, and nothing else")
        each.add_argument("--out", metavar="DIR", help="folder for what is written (default: nonholo-out/SCENE)")
        each.add_argument("--no-plot", action="store_true", help="draw no picture")
        each.add_argument("--no-cache", action="store_true", help="keep no compiled programs on disk, and use none")
        if verb not in _IN_BOTH:
            each.add_argument("--float32", action="store_true", help="compute in float32 instead of float64")
        else:
            each.set_defaults(float32=False)
        if verb in ("montecarlo", "bench"):
            (montecarlo_verb if verb == "montecarlo" else bench_verb).add_options(each)
        if verb != "tradeoff":
            continue
        each.add_argument("-n", "--throws", type=int, default=256, help="size of the batch (default: %(default)s)")
        spread = "throws differ by this part of the speed, and of the radius in position (default: %(default)s)"
        each.add_argument("--spread", type=float, default=0.01, help=spread)
        each.add_argument("--seed", type=int, default=0, help="of the throws (default: %(default)s)")
        each.add_argument("--error", type=float, default=1e-6, help="wanted error in m (default: %(default)s)")
    return parser


def _run(options: argparse.Namespace, from_start: bool) -> int:
    began = time.perf_counter()
    with _precision(options.float32), contextlib.ExitStack() as stack:
        from .._files import load_scene

        whole = CPU_BEFORE + time.perf_counter() - BEGAN
        importing = whole if from_start else time.perf_counter() - began
        try:
            if options.verb == "montecarlo":
                _join(options)
            file = None if options.scene is None else load_scene(options.scene)
        except ValueError as error:
            raise _BadInput(str(error)) from None
        for table, example in _TABLES:
            wanted = file is not None and table in ("simulate", options.verb.replace("monte", "monte_"))
            if wanted and getattr(file, table) is None:
                what = f"`{table}` must be given for nonholo {options.verb}, but got nothing"
                raise _BadInput(f"{options.scene}: {what}; add [{table}] with {example}")
        writes = options.verb in (*_IN_BOTH, "montecarlo") or not options.no_plot
        folder = options.folder = _writable(options) if writes else None
        # Not where times of compilation are measured, nor by processes that would write side by side.
        alone = options.verb not in _IN_BOTH and getattr(options, "coordinator", None) is None
        stack.enter_context(programs_kept(alone and not options.no_cache))
        if folder is not None and not options.no_plot:  # what draws comes while XLA compiles
            threading.Thread(target=importlib.import_module, args=("matplotlib.figure",), daemon=True).start()
        clock = _CompileClock()
        if sys.stderr.isatty():
            print(f"nonholo: compiling the {options.verb}; this takes most of the time", file=sys.stderr, flush=True)
        try:
            answer = _VERBS[options.verb](file, options)
        except ValueError as error:  # arguments that only the computation itself can judge
            if not (str(error).startswith("Argument ") or type(error).__name__ == "StoreError"):
                raise  # a fault of ours
            raise _BadInput(f"{options.scene or options.verb}: {error}") from None
        except KeyboardInterrupt:
            if options.verb != "montecarlo":
                raise
            print(f"nonholo: interrupted; whole chunks are kept in {folder}: go on with --resume", file=sys.stderr)
            return FAILED
        seconds = {"import": importing, **clock.split()}
        picture = None
        if folder is not None and not options.no_plot:
            began = time.perf_counter()
            picture = _draw(options.verb, None if file is None else file.scene, answer, folder)
            seconds["plot"] = time.perf_counter() - began
        if folder is not None and options.verb in _IN_BOTH:
            _written(finite(answer.report), folder / f"{options.verb}.json")
        _show(options, answer, seconds, picture)
    if answer.failure is not None:
        print(f"nonholo: {options.scene}: {' '.join(answer.failure.split())}", file=sys.stderr)
        return FAILED
    return DONE


def _join(options: argparse.Namespace) -> None:
    """Become one of several processes, if asked to; one that dies may come back while the others wait."""
    import jax

    from .montecarlo_verb import processes

    given = processes(options)
    if given is not None:
        jax.config.update("jax_enable_recoverability", True)
        jax.distributed.initialize(*given)


def _choose_for_xla(verb: str) -> None:
    """Make every core a device of its own for a batch that spreads over devices. And ask JAX 0.10 for XLA's older code
    generator on the CPU: compilation takes three quarters of the time, and one motion runs as fast. Other versions may
    not know that flag, and XLA stops at a flag that it does not know. What is chosen already stays."""
    flags = {"--xla_cpu_use_fusion_emitters=": "false"} if metadata.version("jaxlib").startswith("0.10.") else {}
    if verb in ("montecarlo", "bench"):
        own = getattr(os, "sched_getaffinity", None)  # the cores that this process may use, where the system says so
        flags["--xla_force_host_platform_device_count="] = str(len(own(0)) if own else os.cpu_count() or 1)
    chosen = os.environ.get("XLA_FLAGS", "")
    more = [flag + value for flag, value in flags.items() if flag not in chosen]
    if more:
        os.environ["XLA_FLAGS"] = " ".join([chosen, *more]).strip()


@contextlib.contextmanager
def _precision(single: bool) -> Iterator[None]:
    """Compute in float64 or float32, and leave JAX as it was."""
    import jax

    before = jax.config.jax_enable_x64  # pyright: ignore[reportAttributeAccessIssue]
    jax.config.update("jax_enable_x64", not single)
    try:
        yield
    finally:
        jax.config.update("jax_enable_x64", before)


class _CompileClock:
    """Splits the wall time since it was made into compilation and the rest. JAX reports every trace, lowering and
    compilation when it ends; they nest, so that what counts is the union of their intervals."""

    _listening: "list[_CompileClock]" = []

    def __init__(self):
        import jax.monitoring

        self.intervals: list[tuple[float, float]] = []
        if not _CompileClock._listening:  # JAX has no public way to stop listening in every version: register once
            jax.monitoring.register_event_duration_secs_listener(_CompileClock._heard)
        _CompileClock._listening[:] = [self]
        self.began = time.perf_counter()

    @staticmethod
    def _heard(event: str, duration_secs: float, **details: Any) -> None:
        if event.startswith("/jax/core/compile/"):
            now = time.perf_counter()
            _CompileClock._listening[-1].intervals.append((now - duration_secs, now))

    def split(self) -> dict[str, float]:
        total = time.perf_counter() - self.began
        compiling, end = 0.0, self.began
        for low, high in sorted(self.intervals):
            compiling += max(high - max(low, end), 0.0)
            end = max(end, high)
        return {"compile": compiling, "run": total - compiling}


def _writable(options: argparse.Namespace) -> Path:
    """The folder of what is written, made if need be."""
    own = Path("nonholo-out") / Path(options.scene or "").stem
    own = own / options.verb if options.verb in ("montecarlo", "bench") else own
    folder = own if options.out is None else Path(options.out)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if not os.access(folder, os.W_OK):
            raise PermissionError(13, "Permission denied")
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise _BadInput(
            f"argument --out must be a folder that can be written, but got {str(folder)!r} ({reason}); choose "
            "another, or --no-plot"
        ) from None
    return folder


def _draw(verb: str, scene: Any, answer: _Answer, folder: Path) -> str | None:
    """Write the picture; `None` where there is nothing to draw, which the answer then says."""
    from .._pictures import plot_bench, plot_ensemble, plot_tradeoff, plot_trajectory

    draw = {"tradeoff": plot_tradeoff, "montecarlo": plot_ensemble, "bench": plot_bench}.get(verb)
    path = folder / ("trajectory.png" if draw is None else f"{verb}.png")
    try:
        if draw is not None:
            draw(**answer.drawing, path=path)
        else:
            plot_trajectory(scene, answer.trajectory, path=path, **answer.drawing)
    except ValueError as error:
        answer.text.append(f"  no picture: {error}")
        return None
    except OSError as error:
        raise _no_room(path, error) from None
    return str(path)


def _no_room(path: Path, error: OSError) -> _BadInput:
    what = f"argument --out must be a folder with room for {str(path)!r}, but got {error.strerror or error}"
    return _BadInput(f"{what}; choose another, or --no-plot")


def _written(report: dict[str, Any], path: Path) -> None:
    try:
        path.write_text(json.dumps(report, allow_nan=False, indent=1) + "\n")
    except OSError as error:
        raise _no_room(path, error) from None


# The verbs


def _simulate(file: Any, options: argparse.Namespace) -> _Answer:
    import jax

    from .._files import traced
    from .._math import is_failure, result_message, result_name
    from .._motion import simulate

    trajectory = simulate(traced(file.scene), file.throw, **file.simulate.arguments, throw=False)
    jax.block_until_ready(trajectory.t1)
    result = result_name(trajectory.result)
    report = {"throw": state_of(file.throw), "result": result, **motion_of(file.scene, trajectory)}
    text = [f"{result}: {result_message(trajectory.result)}", "", *table_of(report)]
    failure = f"{result}: {result_message(trajectory.result)}" if bool(is_failure(trajectory.result)) else None
    return _Answer(report, text, trajectory, {}, failure)


def _design(file: Any, options: argparse.Namespace) -> _Answer:
    import jax

    from .._files import traced
    from .._math import result_name
    from .._questions import ReturnTo, design

    how = file.simulate.arguments
    if how["sum_trains"]:  # where an itinerary counts single bounces, `design` leaves trains out, which compiles faster
        del how["sum_trains"]
    answer = design(traced(file.scene), file.throw, **file.design.arguments, **how)
    jax.block_until_ready(answer.miss)
    values = [float(x) for x in answer.values]
    reached = int((answer.starts.met & (answer.starts.miss <= answer.tolerance)).sum())
    starts = answer.report()
    report = {
        "throw": state_of(answer.state),
        "found": dict(zip(answer.names, values, strict=True)),
        "miss": float(answer.miss),
        "loss": float(answer.loss),
        "converged": answer.converged,
        "evaluations": answer.evaluations,
        "starts": {"count": len(starts), "reached": reached, "report": starts},
        "result": result_name(answer.trajectory.result),
        **motion_of(answer.scene, answer.trajectory),
    }
    head = "found" if answer.converged else "not found; the closest miss is"
    text = [f"{head}, by {len(starts)} starts and {answer.evaluations} trajectories:", ""]
    width = max(len(name.removeprefix("throw.")) for name in answer.names)
    text += [f"  {name.removeprefix('throw.'):<{width}} = {x!r} {unit_of(name)}".rstrip()
             for name, x in report["found"].items()]  # fmt: skip
    text += [f"  miss {answer.miss:.3g} m, {reached} of {len(starts)} starts reached the goal", "", *table_of(report)]
    failure = None
    if not answer.converged:
        text += ["", "what each start did:", *(f"  {line}" for line in starts)]
        asked = " after " + ", ".join(file.design.itinerary) if file.design.itinerary else ""
        best = f"the best of {len(starts)} starts missed by {answer.miss:.3g} m"
        if not math.isfinite(answer.miss):
            best = f"none of {len(starts)} starts hit these surfaces in this order"
        remedy = "widen `design.bounds`, free more, raise `n_starts`, or change the itinerary"
        failure = f"no throw within `bounds` reached the goal{asked}: {best}; {remedy}"
    goal = file.design.goal
    drawing = {"hand" if isinstance(goal, ReturnTo) else "target": goal.point}
    return _Answer(report, text, answer.trajectory, drawing, failure)


def _tradeoff(file: Any, options: argparse.Namespace) -> _Answer:
    from .._questions import tradeoff

    for name, value, fits in (
        ("-n/--throws", options.throws, options.throws >= 1),
        ("--spread", options.spread, 0 <= options.spread < math.inf),
        ("--seed", options.seed, 0 <= options.seed < 2**32),
        ("--error", options.error, 0 < options.error < math.inf),
    ):
        if not fits:
            raise _BadInput(f"argument {name} must be positive and finite, but got {value}; leave it out")
    how = file.simulate.arguments
    times = {name: how[name] for name in ("t0", "t1", "max_impacts") if name in how}
    trains = None if how.get("sum_trains", True) else False
    states = _scattered(file, options.throws, options.spread, options.seed)
    found = tradeoff(file.scene, states, **times, sum_trains=trains, progress=sys.stderr.isatty())
    wanted = f"{options.error:g} m"
    best = found.cheapest(options.error)
    report = {
        "throw": state_of(file.throw),
        "batch": {"throws": options.throws, "spread": options.spread, "seed": options.seed},
        **found.report(),
        "error": options.error,
        "cheapest": None if best is None else best.label,
    }
    text, failure = found.table(), None
    if best is None:
        closest = min(found.rows, key=lambda row: row.max_error if row.what == "value" else math.inf)
        failure = (
            f"no way reached {wanted}: the closest is {closest.label} with {closest.max_error:.1e} m; raise --error"
        )
    else:
        us = 1e6 * best.seconds_per_trajectory
        text += ["", f"cheapest for {wanted}: {best.label}: {us:.1f} us, largest error {best.max_error:.1e} m"]
    return _Answer(report, text, None, {"found": found}, failure)


def _montecarlo(file: Any, options: argparse.Namespace) -> _Answer:
    from .montecarlo_verb import first_order, report, report_of_first_order, run, table, table_of_first_order

    found = run(file, options, options.folder, progress=sys.stderr.isatty())
    whole, text = {"throw": state_of(file.throw), **report(found)}, table(found)
    if options.first_order:
        linear = first_order(file)
        whole["first_order"] = report_of_first_order(linear, found)
        text += table_of_first_order(linear, found)
    return _Answer(whole, text, None, {"found": found}, None)


def _bench(file: Any, options: argparse.Namespace) -> _Answer:
    from .bench_verb import run

    options.stem = None if options.scene is None else Path(options.scene).stem
    found = run(file, options, progress=sys.stderr.isatty())
    throw = {} if file is None else {"throw": state_of(file.throw)}
    return _Answer({**throw, **found.report()}, found.table(), None, {"found": found}, None)


def _scattered(file: Any, n: int, spread: float, seed: int) -> Any:
    """The throw of the file, n times, each a little different."""
    import jax
    import jax.numpy as jnp

    from .._world import BallState

    throw, radius = file.throw, file.scene.ball.radius
    speed = math.sqrt(math.fsum(float(x) ** 2 for x in throw.velocity)) or 1.0
    sizes = (radius, speed, speed / radius)
    keys = jax.random.split(jax.random.key(seed), 3)
    fields = [
        x[None] + spread * size * jax.random.normal(key, (n, 3), x.dtype)
        for x, size, key in zip((throw.position, throw.velocity, throw.spin), sizes, keys, strict=True)
    ]
    turned = None if throw.orientation is None else jnp.broadcast_to(throw.orientation, (n, 4))
    return BallState(*fields, orientation=turned)


_VERBS = {"simulate": _simulate, "design": _design, "tradeoff": _tradeoff, "montecarlo": _montecarlo, "bench": _bench}


# Printing


def _show(options: argparse.Namespace, answer: _Answer, seconds: dict[str, float], picture: str | None) -> None:
    if options.json:
        head = {"verb": options.verb, "scene": options.scene, "dtype": "float32" if options.float32 else "float64"}
        whole = head | answer.report | {"seconds": seconds, "picture": picture}
        print(json.dumps(finite(whole), allow_nan=False), flush=True)
        return
    print(f"{options.scene or options.verb}: " + "\n".join(answer.text))
    if picture is not None:
        print(f"  picture: {picture}")
    print("  seconds: " + ", ".join(f"{name} {value:.2f}" for name, value in seconds.items()), flush=True)
