"""Rough rigid balls, and other nonholonomic systems, through their collisions: batched, compiled, differentiable."""

import importlib as _importlib
from typing import TYPE_CHECKING as _TYPE_CHECKING, Any as _Any

from . import _cli as _cli
from ._impact import (
    AbstractContactLaw as AbstractContactLaw,
    Frictional as Frictional,
    Rough as Rough,
    Smooth as Smooth,
    collide as collide,
    projector as projector,
)
from ._math import KINDS as KINDS, RESULTS as RESULTS
from ._motion import (
    AbstractMotion as AbstractMotion,
    Exact as Exact,
    ImpactLog as ImpactLog,
    Integrated as Integrated,
    SimulationError as SimulationError,
    Trajectory as Trajectory,
    UnboundedGapWarning as UnboundedGapWarning,
    simulate as simulate,
    simulate_batch as simulate_batch,
)
from ._world import (
    AbstractSurface as AbstractSurface,
    Air as Air,
    Ball as Ball,
    BallState as BallState,
    Barrier as Barrier,
    Box as Box,
    Cylinder as Cylinder,
    Hole as Hole,
    Implicit as Implicit,
    LagrangianSystem as LagrangianSystem,
    Plane as Plane,
    Rectangle as Rectangle,
    Scene as Scene,
    Sphere as Sphere,
)

if _TYPE_CHECKING:
    from ._ensembles import (
        AbstractDistribution as AbstractDistribution,
        AbstractMeasure as AbstractMeasure,
        Correlated as Correlated,
        Distance as Distance,
        Ensemble as Ensemble,
        Expectation as Expectation,
        FinalPosition as FinalPosition,
        ImpactCount as ImpactCount,
        Indices as Indices,
        Landing as Landing,
        LandingTime as LandingTime,
        LogNormal as LogNormal,
        Measured as Measured,
        Normal as Normal,
        Propagation as Propagation,
        Returns as Returns,
        Sampler as Sampler,
        StoreError as StoreError,
        TruncatedNormal as TruncatedNormal,
        Uniform as Uniform,
        Vary as Vary,
        expectation as expectation,
        monte_carlo as monte_carlo,
        propagate as propagate,
        sobol_indices as sobol_indices,
    )
    from ._questions import (
        AbstractGoal as AbstractGoal,
        Bench as Bench,
        Design as Design,
        Fit as Fit,
        HitTarget as HitTarget,
        Land as Land,
        Preference as Preference,
        Rate as Rate,
        ReturnTo as ReturnTo,
        Row as Row,
        Tradeoff as Tradeoff,
        bench as bench,
        compare as compare,
        design as design,
        energy as energy,
        fit as fit,
        law_residual as law_residual,
        momentum_about as momentum_about,
        slip as slip,
        tradeoff as tradeoff,
        weak_residual as weak_residual,
    )

# These rooms come when one of their names is asked for: a plain `simulate` needs neither, nor what they import.
_WHEN_ASKED = {
    "_questions": [
        "AbstractGoal",
        "Bench",
        "Design",
        "Fit",
        "HitTarget",
        "Land",
        "Preference",
        "Rate",
        "ReturnTo",
        "Row",
        "Tradeoff",
        "bench",
        "compare",
        "design",
        "energy",
        "fit",
        "law_residual",
        "momentum_about",
        "slip",
        "tradeoff",
        "weak_residual",
    ],
    "_ensembles": [
        "AbstractDistribution",
        "AbstractMeasure",
        "Correlated",
        "Distance",
        "Ensemble",
        "Expectation",
        "FinalPosition",
        "ImpactCount",
        "Indices",
        "Landing",
        "LandingTime",
        "LogNormal",
        "Measured",
        "Normal",
        "Propagation",
        "Returns",
        "Sampler",
        "StoreError",
        "TruncatedNormal",
        "Uniform",
        "Vary",
        "expectation",
        "monte_carlo",
        "propagate",
        "sobol_indices",
    ],
}


def __getattr__(name: str) -> _Any:
    if name == "__version__":
        return _importlib.import_module("importlib.metadata").version(__name__)
    for room, names in _WHEN_ASKED.items():
        if name in names:
            globals()[name] = getattr(_importlib.import_module(f".{room}", __name__), name)
            return globals()[name]
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


__all__ = sorted({*[name for name in globals() if name[0] != "_"], *sum(_WHEN_ASKED.values(), [])})  # pyright: ignore[reportUnsupportedDunderAll]


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
