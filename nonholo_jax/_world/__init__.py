"""What moves and what it meets: balls, surfaces, air, scenes, Lagrangian systems, as the event loop asks for them."""

from .air import Air as Air
from .ball import Ball as Ball, BallState as BallState, check_ball_state as check_ball_state
from .box import Box as Box, Rectangle as Rectangle, along as along
from .hole import Hole as Hole
from .lagrangian import Barrier as Barrier, LagrangianSystem as LagrangianSystem, as_arrays as as_arrays
from .round import (
    Cylinder as Cylinder,
    Sphere as Sphere,
    round_bend as round_bend,
    round_level as round_level,
)
from .scene import Flight as Flight, Scene as Scene
from .surface import (
    AbstractSurface as AbstractSurface,
    Face as Face,
    Implicit as Implicit,
    Plane as Plane,
    Return as Return,
)
from .system import (
    AbstractSystem as AbstractSystem,
    Meeting as Meeting,
    bounces as bounces,
    magnitude as magnitude,
    rounding as rounding,
)
from .touching import (
    Member as Member,
    Neighbours as Neighbours,
    Stack as Stack,
    Support as Support,
    may_be_flush as may_be_flush,
    neighbours as neighbours,
    numbers_of as numbers_of,
)
