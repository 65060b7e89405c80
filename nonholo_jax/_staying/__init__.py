"""A ball that stays on a surface: what it is on, how it goes along it, and how that begins and ends."""

from .floors import slides_across as slides_across, stays_curved as stays_curved
from .grounded import Grounded as Grounded, grounded as grounded
