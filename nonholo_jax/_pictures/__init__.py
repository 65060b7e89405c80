"""Pictures of throws, studies, fits and trade-offs; matplotlib is loaded only when one is drawn."""

from .ensemble_plot import plot_ensemble as plot_ensemble
from .fit_plot import plot_fits as plot_fits
from .plot import plot_trajectory as plot_trajectory
from .tradeoff_plot import plot_tradeoff as plot_tradeoff
