"""From the `[monte_carlo]` table of a scene file to a sampler and measures."""

from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from .._ensembles import (
    Correlated,
    Distance,
    FinalPosition,
    ImpactCount,
    Landing,
    LandingTime,
    LogNormal,
    Measured,
    Normal,
    Returns,
    Sampler,
    TruncatedNormal,
    Uniform,
    Vary,
)
from .._questions import expand
from .._world import BallState, Scene
from .montecarlo_schema import MonteCarloTable
from .schema_types import SceneError

_DISTRIBUTIONS = {"normal": Normal, "uniform": Uniform, "lognormal": LogNormal, "truncated_normal": TruncatedNormal,
                  "correlated": Correlated}  # fmt: skip
_MEASURES = {"landing": Landing, "landing_time": LandingTime, "impact_count": ImpactCount,
             "final_position": FinalPosition, "distance": Distance, "returns": Returns}  # fmt: skip


class MonteCarloTask(NamedTuple):
    """The `[monte_carlo]` table, and as `table` what the file says; `[simulate]` says how the motion is computed:
    `monte_carlo(file.scene, **file.monte_carlo.arguments, **file.simulate.arguments)`."""

    sampler: Sampler
    measures: dict[str, Any] | None = None
    n: int = 100_000
    seed: int = 0
    itinerary_length: int = 8
    table: dict[str, Any] | None = None

    @property
    def arguments(self) -> dict[str, Any]:
        fields = self._asdict()
        del fields["table"]
        return fields | {"key": jax.random.key(fields.pop("seed"))}


def task_of(table: MonteCarloTable, scene: Scene, throw: BallState, folder: Path) -> MonteCarloTask:
    """Raises `SceneError` for names, columns and files that do not exist, and numbers that do not fit together."""
    vary = []
    for i, each in enumerate(table.vary):
        field = f"monte_carlo.vary[{i}]"
        try:
            names = expand(scene, throw, each.names)
            distribution = _distribution(each, folder)
            distribution.check(len(names))
        except ValueError as error:
            raise SceneError(f"`{field}`: {error}") from None
        vary.append(Vary(each.names, distribution))
    sampler = Sampler(throw, vary, table.sequence)
    try:
        sampler.names(scene)
    except ValueError as error:
        raise SceneError(f"`monte_carlo.vary`: {error}") from None
    measures = {}
    for i, each in enumerate(table.measure):
        fields = dict(each)
        kind, name = fields.pop("kind"), fields.pop("name")
        surface = fields.get("surface")
        if surface is not None and surface not in scene.names:
            what = f"must be one of {', '.join(scene.names) or 'no surface'}, but got {surface!r}"
            raise SceneError(f"`monte_carlo.measure[{i}].surface` {what}; name a surface of the scene")
        measures[name] = _MEASURES[kind](**fields)
    kept = table.model_dump(exclude_none=True, exclude_unset=True)
    return MonteCarloTask(sampler, measures or None, table.n, table.seed, table.itinerary_length, kept)


def _distribution(table: Any, folder: Path) -> Any:
    fields = dict(table)
    kind = fields.pop("kind")
    del fields["names"]
    if kind == "measured":
        return Measured.read(folder / fields["file"], fields["columns"])
    return _DISTRIBUTIONS[kind](**{name: _array(value) for name, value in fields.items() if value is not None})


def _array(value: Any) -> Any:
    return value if isinstance(value[0], list) else np.asarray(value, dtype=float)


def table_of(task: MonteCarloTask) -> dict[str, Any]:
    """For a file. Raises `SceneError` for a task that was not read from one."""
    if task.table is None:
        raise SceneError("`monte_carlo` must come from a scene file, but was made in Python; keep it in Python")
    return dict(task.table) | {"n": task.n, "seed": task.seed}
