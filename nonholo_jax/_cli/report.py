"""What the command line says of a motion: for machines, and as a table for people."""

import math
from typing import Any

import jax
import numpy as np

from .._math import kind_name, surfaces_hit

_UNITS = {"position": "m", "velocity": "m/s", "spin": "rad/s", "gravity": "m/s^2", "point": "m", "center": "m",
          "radius": "m", "half_size": "m", "mass": "kg", "wind": "m/s", "density": "kg/m^3"}  # fmt: skip
_LABELS = {
    "bounce": "{}",
    "train": "{}, dies out",
    "rolling": "{}, rolling",
    "left": "off {}",
    "gripped": "{}, slips no more",
    "slipped": "{}, slips",
    "stopped": "{}, stops",
    "groove": "{}, in a groove",
    "passed": "on to {}",
}


def state_of(state: Any) -> dict[str, list[float]]:
    names = ("position", "velocity", "spin", "orientation")
    fields = {name: getattr(state, name) for name in names}
    return {name: [float(x) for x in value] for name, value in fields.items() if value is not None}


def _energy(scene: Any, state: dict[str, list[float]]) -> float:
    """Kinetic and potential energy in J, of a state as it is reported."""
    ball, v, w = scene.ball, state["velocity"], state["spin"]
    mass, radius, inertia_ratio = (float(x) for x in (ball.mass, ball.radius, ball.inertia_ratio))
    kinetic = 0.5 * mass * (math.fsum(x * x for x in v) + inertia_ratio * radius**2 * math.fsum(x * x for x in w))
    return kinetic - mass * math.fsum(float(g) * x for g, x in zip(scene.gravity, state["position"], strict=True))


def motion_of(scene: Any, trajectory: Any) -> dict[str, Any]:
    """The part of a report that every verb has."""
    log = jax.tree.map(np.asarray, trajectory.impacts)
    impacts = []
    for i in range(min(int(trajectory.n_rows), len(log.time))):
        before, after = (jax.tree.map(lambda x, i=i: x[i], each) for each in (log.before, log.after))
        impacts.append(
            {
                "time": float(log.time[i]),
                "surface": scene.names[int(log.surface[i])],
                "kind": kind_name(log.kind, i),
                "until": float(log.until[i]),
                "support": scene.names[int(log.support[i])] if log.support[i] >= 0 else None,
                "point": [float(x) for x in log.point[i]],
                "normal": [float(x) for x in log.normal[i]],
                "before": state_of(before),
                "after": state_of(after),
            }
        )
    final, initial = state_of(trajectory.final), state_of(trajectory.initial)
    return {
        "itinerary": list(surfaces_hit(scene.names, log)),
        "impacts": impacts,
        "final": final,
        "time": float(trajectory.t1),
        "energy": {"initial": _energy(scene, initial), "final": _energy(scene, final)},
    }


def unit_of(name: str) -> str:
    """The SI unit of a number by its name in the grammar of scene files."""
    parts = [part for part in name.split(".") if part not in ("w", "x", "y", "z")]
    return _UNITS.get(parts[-1], "")


def _triple(vector: list[float]) -> str:
    return " ".join(f"{0.0 if abs(x) < 5e-5 else x:9.4f}" for x in vector)


def table_of(report: dict[str, Any]) -> list[str]:
    """The throw, every impact and the end, one aligned line each."""
    impacts = report["impacts"]
    labels = [_LABELS[impact["kind"]].format(impact["surface"]) for impact in impacts]
    width = max([len("surface"), *map(len, labels)])
    lines = [
        f"  {'time':>8}  {'':{width}}  {'position':^29}  {'velocity after':^29}  {'spin after':^29}",
        f"  {'s':>8}  {'surface':{width}}  {'m':^29}  {'m/s':^29}  {'rad/s':^29}",
    ]
    rows = [(None, "(throw)", report["throw"])]
    rows += [(impact["until"], label, impact["after"]) for impact, label in zip(impacts, labels, strict=True)]
    rows.append((report["time"], "(end)", report["final"]))
    for moment, label, state in rows:
        clock = "" if moment is None else f"{moment:.5f}"
        vectors = "  ".join(_triple(state[name]) for name in ("position", "velocity", "spin"))
        lines.append(f"  {clock:>8}  {label:{width}}  {vectors}")
    energy = report["energy"]
    lines += ["", f"  itinerary: {', '.join(report['itinerary']) or 'no impact'}"]
    return [*lines, f"  energy: {energy['initial']:.6g} J at the throw, {energy['final']:.6g} J at the end"]


def finite(value: Any) -> Any:
    """The same tree with null for what JSON has no word for."""
    if isinstance(value, dict):
        return {key: finite(entry) for key, entry in value.items()}
    if isinstance(value, list):
        return [finite(entry) for entry in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
