"""Rough rigid balls, and other nonholonomic systems, through their collisions: batched, compiled, differentiable."""

from . import _clock as _clock
from ._air import Air as Air
from ._ball import Ball as Ball, BallState as BallState
from ._box import Box as Box, Rectangle as Rectangle
from ._design import Design as Design, design as design
from ._diagnostics import (
    energy as energy,
    law_residual as law_residual,
    momentum_about as momentum_about,
    slip as slip,
    weak_residual as weak_residual,
)
from ._distribution import (
    AbstractDistribution as AbstractDistribution,
    Correlated as Correlated,
    LogNormal as LogNormal,
    Measured as Measured,
    Normal as Normal,
    TruncatedNormal as TruncatedNormal,
    Uniform as Uniform,
)
from ._ensemble import Ensemble as Ensemble
from ._fit import Fit as Fit, Preference as Preference, compare as compare, fit as fit
from ._goal import AbstractGoal as AbstractGoal, HitTarget as HitTarget, Land as Land, ReturnTo as ReturnTo
from ._impact import collide as collide, projector as projector
from ._lagrangian import Barrier as Barrier, LagrangianSystem as LagrangianSystem
from ._law import AbstractContactLaw as AbstractContactLaw, Frictional as Frictional, Rough as Rough, Smooth as Smooth
from ._measure import (
    AbstractMeasure as AbstractMeasure,
    Distance as Distance,
    FinalPosition as FinalPosition,
    ImpactCount as ImpactCount,
    Landing as Landing,
    LandingTime as LandingTime,
    Returns as Returns,
)
from ._montecarlo import monte_carlo as monte_carlo
from ._motion import AbstractMotion as AbstractMotion, Exact as Exact
from ._motion_integrated import Integrated as Integrated
from ._round import Cylinder as Cylinder, Sphere as Sphere
from ._sampler import Sampler as Sampler, Vary as Vary
from ._scene import Scene as Scene
from ._sensitivity import (
    Expectation as Expectation,
    Indices as Indices,
    Propagation as Propagation,
    expectation as expectation,
    propagate as propagate,
    sobol_indices as sobol_indices,
)
from ._simulate import SimulationError as SimulationError, simulate as simulate, simulate_batch as simulate_batch
from ._store import StoreError as StoreError
from ._surface import (
    AbstractSurface as AbstractSurface,
    Implicit as Implicit,
    Plane as Plane,
)
from ._tradeoff import Row as Row, Tradeoff as Tradeoff, tradeoff as tradeoff
from ._trajectory import ImpactLog as ImpactLog, Trajectory as Trajectory
from ._types import KINDS as KINDS, RESULTS as RESULTS
