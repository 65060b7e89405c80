"""How a world moves in time: arcs, first crossings, the event loop, its replay for derivatives, and `simulate`."""

from .integrated import Integrated as Integrated, rms as rms
from .motion import AbstractMotion as AbstractMotion, Exact as Exact
from .replay import run as run
from .simulate import (
    SimulationError as SimulationError,
    UnboundedGapWarning as UnboundedGapWarning,
    checked as checked,
    simulate as simulate,
    simulate_batch as simulate_batch,
)
from .trajectory import ImpactLog as ImpactLog, Trajectory as Trajectory, flat as flat
