"""The picture of fits: what each model leaves of the measurements.

Nothing here touches `pyplot` or `rcParams`, as in `plot.py`.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from .._questions import Fit

if TYPE_CHECKING:
    from matplotlib.figure import Figure
else:  # matplotlib is loaded only when a picture is drawn
    Figure = Any

_COLOURS = ("#0072B2", "#56B4E9", "#D55E00", "#E69F00", "#009E73", "#CC79A7")
_MARKS = ("o", "s", "^", "D", "v", "P")


def plot_fits(
    fits: Mapping[str, Mapping[str, Fit]],
    *,
    rows: Sequence[str] | None = None,
    unit: str = "",
    path: str | Path | None = None,
) -> Figure:
    """Draw residuals, measured less computed, in the units of the measurements: a panel for each set of data.

    **Arguments:** `fits`: by data, by model; `rows`: a label for each measured number of a set, in order (throw by
    throw); `unit` of them; `path` of the PNG, PDF or SVG file to write, if any.

    Returns a `matplotlib.figure.Figure`. Raises `OSError` where the file cannot be written.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(2.5 * len(fits) + 1.6, 3.2), layout="constrained")
    axes = figure.subplots(1, len(fits), sharey=True, sharex=True, squeeze=False)[0]
    for ax, (data, found) in zip(axes, fits.items(), strict=True):
        ax.axvline(0.0, color="#9a9a9a", lw=0.8)
        for k, (name, each) in enumerate(found.items()):
            misses = (each.residuals * each.spread).ravel()
            place = np.arange(misses.size) + 0.16 * (k - 0.5 * (len(found) - 1))
            style: dict[str, Any] = {"color": _COLOURS[k % len(_COLOURS)], "marker": _MARKS[k % len(_MARKS)]}
            ax.plot(misses, place, ls="", ms=4.5, label=name, **style)
            ax.hlines(place, 0.0, misses, color=style["color"], lw=0.8)
        ax.set_title(data, fontsize=9, loc="left")
        ax.set_xlabel("measured less computed" + f" ({unit})" * bool(unit), fontsize=8)
        ax.tick_params(labelsize=8, length=3, width=0.7)
        ax.spines[:].set(linewidth=0.7)
    count = next(iter(next(iter(fits.values())).values())).residuals.size
    axes[0].set_yticks(np.arange(count), list(rows) if rows is not None else [str(i) for i in range(count)])
    axes[0].set_ylim(count - 0.5, -0.5)
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside right center", fontsize=8, frameon=False)
    if path is not None:
        figure.savefig(path, dpi=160)
    return figure
