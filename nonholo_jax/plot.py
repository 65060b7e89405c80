"""Pictures of throws, of studies and of fits."""

from ._pictures import plot_ensemble as plot_ensemble, plot_fits as plot_fits, plot_trajectory as plot_trajectory
