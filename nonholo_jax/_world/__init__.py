"""What moves and what it meets: balls, surfaces, air, scenes, Lagrangian systems, as the event loop asks for them."""

from .air import Air as Air
from .ball import Ball as Ball, BallState as BallState, check_ball_state as check_ball_state
from .box import Box as Box, Rectangle as Rectangle
from .grounded import grounded as grounded
from .lagrangian import Barrier as Barrier, LagrangianSystem as LagrangianSystem, as_arrays as as_arrays
from .round import Cylinder as Cylinder, Sphere as Sphere
from .scene import Scene as Scene
from .settling import slides_across as slides_across
from .surface import AbstractSurface as AbstractSurface, Implicit as Implicit, Plane as Plane, Return as Return
from .system import AbstractSystem as AbstractSystem, Meeting as Meeting, magnitude as magnitude, rounding as rounding
from .touching import Member as Member, Stack as Stack
