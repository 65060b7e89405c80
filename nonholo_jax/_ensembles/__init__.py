"""What is asked of many throws: distributions, samplers, measures, statistics, studies that are kept, sensitivities."""

from .distribution import (
    AbstractDistribution as AbstractDistribution,
    Correlated as Correlated,
    LogNormal as LogNormal,
    Measured as Measured,
    Normal as Normal,
    TruncatedNormal as TruncatedNormal,
    Uniform as Uniform,
)
from .ensemble import Ensemble as Ensemble, named_failures as named_failures
from .measure import (
    AbstractMeasure as AbstractMeasure,
    Distance as Distance,
    FinalPosition as FinalPosition,
    ImpactCount as ImpactCount,
    Landing as Landing,
    LandingTime as LandingTime,
    Returns as Returns,
)
from .montecarlo import monte_carlo as monte_carlo
from .sampler import Sampler as Sampler, Vary as Vary
from .sensitivity import (
    Expectation as Expectation,
    Indices as Indices,
    Propagation as Propagation,
    expectation as expectation,
    propagate as propagate,
    sobol_indices as sobol_indices,
)
from .store import StoreError as StoreError
