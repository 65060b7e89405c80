"""What an impact does to velocities: the projector, contact laws, corners, trains of bounces, rolling and sliding."""

from . import groove as groove, rolling as rolling, train as train
from .law import AbstractContactLaw as AbstractContactLaw, Frictional as Frictional, Rough as Rough, Smooth as Smooth
from .projector import (
    accelerate as accelerate,
    collide as collide,
    divisor as divisor,
    matmul as matmul,
    projector as projector,
    pseudo_inverse as pseudo_inverse,
    settle as settle,
    whiten as whiten,
)
from .rolling import along_surface as along_surface
from .together import (
    Touched as Touched,
    across_supports as across_supports,
    reflected as reflected,
    takes_part as takes_part,
    without as without,
)
from .train import Contact as Contact
