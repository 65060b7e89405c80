"""Pictures of throws, studies, fits, trade-offs and rates; matplotlib is loaded only when one is drawn."""

from .bench_plot import plot_bench as plot_bench
from .ensemble_plot import plot_ensemble as plot_ensemble
from .fit_plot import plot_fits as plot_fits
from .plot import plot_trajectory as plot_trajectory
from .tradeoff_plot import plot_tradeoff as plot_tradeoff
