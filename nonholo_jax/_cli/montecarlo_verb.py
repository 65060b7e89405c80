"""`nonholo montecarlo`: its options, what it prints, and how it ends."""

import argparse
import math
import warnings
from pathlib import Path
from typing import Any

from .._ensembles import Ensemble, ImpactCount, Propagation, monte_carlo, named_failures, propagate

_ITINERARIES, _PARTS = 8, 3


def add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("-n", "--throws", type=int, help="how many throws (default: `n` of the file)")
    parser.add_argument("--seed", type=int, help="of the throws (default: `seed` of the file)")
    parser.add_argument("--chunk", type=int, help="throws in memory at once (default: 1024 to 16384)")
    parser.add_argument("--resume", action="store_true", help="go on with the study in the folder")
    parser.add_argument("--seconds", type=float, help="stop after the chunk that is under way then")
    stop = "stop once the standard error of a quantity is as small; may be repeated"
    parser.add_argument("--standard-error", metavar="NAME=VALUE", action="append", default=[], help=stop)
    linear = "compare with first-order propagation of the spread, by one Jacobian, and say where that misleads"
    parser.add_argument("--first-order", action="store_true", help=linear)
    parser.add_argument("--records", metavar="COLUMNS", help="columns to keep of every throw, with commas, or all")
    parser.add_argument("--where", metavar="EVENT", help="keep only throws with this event")
    parser.add_argument("--coordinator", metavar="HOST:PORT", help="of several processes that share a folder")
    parser.add_argument("--processes", type=int, help="how many there are")
    parser.add_argument("--process", type=int, help="which one this is, from 0")


def processes(options: argparse.Namespace) -> tuple[str, int, int] | None:
    """Coordinator, number of processes and which one this is, if there are several. Raises `ValueError` where only some
    of that is given."""
    given = (options.coordinator, options.processes, options.process)
    if all(each is None for each in given):
        return None
    if any(each is None for each in given):
        raise ValueError("Argument `--coordinator` must come with --processes and --process, but not all were given.")
    if not 0 <= options.process < options.processes:
        what = f"must be from 0 to {options.processes - 1}, but got {options.process}"
        raise ValueError(f"Argument `--process` {what}; try 0.")
    return given


def _wanted(pairs: list[str]) -> dict[str, float]:
    found = {}
    for pair in pairs:
        name, _, value = pair.partition("=")
        try:
            found[name] = float(value)
        except ValueError:
            what = f"must be NAME=VALUE, but got {pair!r}"
            raise ValueError(f"Argument `--standard-error` {what}; try hand=0.001.") from None
    return found


def run(file: Any, options: argparse.Namespace, folder: Path, progress: bool) -> Ensemble:
    """The study of a scene file, with what the command line says otherwise."""
    if options.seconds is not None and not 0 < options.seconds < math.inf:
        raise ValueError(f"Argument `--seconds` must be positive and finite, but got {options.seconds}; try 60.")
    arguments = {**file.monte_carlo.arguments, **file.simulate.arguments}
    if options.throws is not None:
        arguments["n"] = options.throws
    if options.seed is not None:
        arguments["key"] = options.seed
    records = options.records
    if records is not None and records != "all":
        records = [name.strip() for name in records.split(",")]
    how = {"chunk": options.chunk, "seconds": options.seconds, "standard_error": _wanted(options.standard_error)}
    kept = {"out": folder, "resume": options.resume, "records": records, "record_where": options.where}
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*throws failed")  # the table says it
        return monte_carlo(file.scene, **arguments, **how, **kept, progress=progress)


def first_order(file: Any) -> Propagation:
    arguments = {**file.monte_carlo.arguments, **file.simulate.arguments}
    sampler, measures = arguments.pop("sampler"), arguments.pop("measures") or {"impacts": ImpactCount()}
    arguments = {name: value for name, value in arguments.items() if name not in ("n", "key")}
    return propagate(file.scene, sampler, measures=measures, **arguments)


def report_of_first_order(linear: Propagation, found: Ensemble) -> dict[str, Any]:
    """For machines: of every quantity its value for the central throw, its spread, and the spread by each input."""
    quantities = {}
    for name, mean in zip(linear.names, linear.mean, strict=True):
        spread = {"standard_deviation": linear.standard_deviation(name), "parts": linear.parts(name)}
        quantities[name] = {"mean": float(mean), **spread}
    return {"itinerary": list(linear.itinerary), "quantities": quantities, "warnings": linear.against(found)}


def table_of_first_order(linear: Propagation, found: Ensemble) -> list[str]:
    """For people."""
    width = max(len("to first order"), *(len(name) for name in linear.names))
    lines = ["", f"  {'to first order':{width}}  {'mean':>12}  {'std. dev.':>10}  most of it by"]
    rounding = 1e-12 * float(abs(linear.mean).max(initial=0.0))
    for name, mean in zip(linear.names, linear.mean, strict=True):
        parts = sorted(linear.parts(name).items(), key=lambda item: -item[1])[:_PARTS]
        most = ", ".join(f"{each.removeprefix('throw.')} {size:.2g}" for each, size in parts if size > rounding)
        lines.append(f"  {name:{width}}  {mean:12.6g}  {linear.standard_deviation(name):10.3g}  {most}".rstrip())
    notes = linear.against(found)
    return lines + ["", *(f"  warning: {line}" for line in notes)] if notes else lines


def report(found: Ensemble) -> dict[str, Any]:
    """For machines."""
    quantities = {}
    for each in found.quantities:
        name = each.name
        entry: dict[str, Any] = {"unit": each.unit, "present": found.present(name), "mean": found.mean(name)}
        entry["standard_error"] = found.standard_error(name)
        if each.event:
            entry = {"probability": entry.pop("mean"), **entry}
        else:
            (low, low_at), (high, high_at) = found.extremes(name)
            entry["standard_deviation"] = found.standard_deviation(name)
            entry["quantiles"] = {str(p): found.quantile(name, p)[0] for p in (0.05, 0.25, 0.5, 0.75, 0.95)}
            entry["lowest"], entry["highest"] = [low, low_at], [high, high_at]
        quantities[name] = entry
    return {
        "throws": found.n,
        "quantities": quantities,
        "itineraries": [[list(each.what), *each[1:]] for each in found.itineraries[:100]],
        "results": {each.what: each.count for each in found.results},
        "failures": {each.what: each.count for each in found.failures},
        "folder": None if found.folder is None else str(found.folder),
    }


def table(found: Ensemble) -> list[str]:
    """For people."""
    width = max([len("quantity"), *(len(each.name) for each in found.quantities)])
    columns = ("std. error", "std. dev.", "5 %", "median", "95 %")
    head = f"  {'quantity':{width}}  {'mean':>12}" + "".join(f"  {name:>10}" for name in columns)
    lines = [f"{found.n} throws", "", f"{head}  unit"]
    for each in found.quantities:
        mean, error = found.mean(each.name), found.standard_error(each.name)
        line = f"  {each.name:{width}}  {mean:12.6g}  {error:10.2g}"
        if each.event:
            lines.append(f"{line}  probability")
            continue
        levels = "".join(f"  {found.quantile(each.name, p)[0]:10.4g}" for p in (0.05, 0.5, 0.95))
        part = found.present(each.name) / found.n
        there = "" if part == 1 else f", present in {part:.2%}"
        lines.append(f"{line}  {found.standard_deviation(each.name):10.3g}{levels}  {each.unit}{there}".rstrip())
    rows = found.itineraries
    if rows:
        lines += ["", "  itineraries"]
        lines += [f"  {each.probability:9.3%} +- {each.standard_error:.3%}  {' '.join(each.what) or 'no impact'}"
                  for each in rows[:_ITINERARIES]]  # fmt: skip
        rest = sum(each.count for each in rows[_ITINERARIES:])
        if rest:
            part = rest / sum(each.count for each in rows)
            lines.append(f"  {part:9.3%}            {len(rows) - _ITINERARIES} others")
    results = ", ".join(f"{each.what} {each.count}" for each in found.results)
    lines += ["", f"  results: {results}"]
    failures = named_failures({each.what: each.count for each in found.failures}, found.n)
    lines += [f"  warning: {failures}"] if failures else []
    if found.folder is not None:
        lines.append(f"  study: {found.folder}")
    return lines
