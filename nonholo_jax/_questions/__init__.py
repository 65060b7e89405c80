"""What is asked of one motion: diagnostics, goals, design, fits to measurements, error against time, rates."""

from .bench import Case as Case, bench as bench
from .design import Design as Design, design as design
from .diagnostics import (
    energy as energy,
    law_residual as law_residual,
    momentum_about as momentum_about,
    slip as slip,
    weak_residual as weak_residual,
)
from .fit import Fit as Fit, Preference as Preference, compare as compare, fit as fit
from .goal import (
    AbstractGoal as AbstractGoal,
    HitTarget as HitTarget,
    Land as Land,
    ReturnTo as ReturnTo,
    as_point as as_point,
)
from .names import expand as expand, read as read, write as write
from .rates import Bench as Bench, Rate as Rate
from .tradeoff import Row as Row, Tradeoff as Tradeoff, tradeoff as tradeoff
