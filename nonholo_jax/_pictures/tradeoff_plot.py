"""The picture of a trade-off: time against error, one curve for each way to run the scene, and the front through them.

Nothing here touches `pyplot` or `rcParams`, as in `plot.py`.
"""

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .._questions import Row, Tradeoff

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
else:  # matplotlib is loaded only when a picture is drawn
    Axes = Figure = Any

_INK, _FAINT, _FRONT = "#222222", "#9a9a9a", "#d9d9d0"
# Okabe and Ito's colours, which colour-blind readers can tell apart.
_COLOURS = ("#0072B2", "#009E73", "#D55E00", "#E69F00", "#CC79A7", "#56B4E9")
_AXES = {
    "value": ("final position", "largest error of the final position, m"),
    "gradient": ("its gradient", "largest relative error of the gradient"),
}


def plot_tradeoff(found: Tradeoff, *, path: str | Path | None = None) -> Figure:
    """Draw time per trajectory against largest error, both logarithmic: a panel for values, one for gradients.

    **Arguments:** `found` by `tradeoff`; `path` of the PNG, PDF or SVG file to write, if any.

    Returns a `matplotlib.figure.Figure`. Raises `ValueError` where no row has an error to draw, `OSError` where the
    file cannot be written.
    """
    from matplotlib.figure import Figure

    shown = [what for what in _AXES if any(_drawn(found, what))]
    if not shown:
        raise ValueError("Argument `found` must have a row with a finite error, but got none; try other throws.")
    figure = Figure(figsize=(3.6 * len(shown) + 1.9, 3.9), layout="constrained")
    axes = figure.subplots(1, len(shown), sharey=True, squeeze=False)[0]
    methods = list(dict.fromkeys(row.method for row in found.rows))
    inexact = [method for method in methods if method != "Exact"]
    colours = {method: _COLOURS[i % len(_COLOURS)] for i, method in enumerate(inexact)} | {"Exact": _INK}
    for ax, what in zip(axes, shown, strict=True):
        _panel(ax, found, what, colours)
    axes[0].set_ylabel("time per trajectory, µs", fontsize=9)
    _legend(figure, {method: colours[method] for method in methods}, found)
    title = f"{found.n_throws} throws in one batch; {found.machine}"
    figure.suptitle(title, fontsize=7, color=_FAINT, x=0.01, ha="left")
    if path is not None:
        figure.savefig(path, dpi=160)
    return figure


def _drawn(found: Tradeoff, what: str) -> list[Row]:
    """Rows with an error that a logarithmic axis has; those at the floor of the reference are drawn there."""
    return [row for row in found.rows if row.what == what and math.isfinite(row.max_error)]


def _floor(found: Tradeoff, what: str) -> float:
    """Below it errors say nothing: the disagreement of the reference with another way to compute it."""
    apart = found.gradient_error if what == "gradient" else found.reference_error
    return max(apart, 1e-16) if math.isfinite(apart) else 1e-16


def _to_floor(curve: list[Row], floor: float) -> list[Row]:
    """A curve up to its cheapest row at the floor: what is dearer, there, shows nothing."""
    at_floor = [row for row in curve if row.max_error <= floor]
    cheapest = min(at_floor, key=lambda row: row.seconds_per_trajectory, default=None)
    return [row for row in curve if row not in at_floor or row is cheapest]


def _panel(ax: Axes, found: Tradeoff, what: str, colours: dict[str, str]) -> None:
    floor = _floor(found, what)
    at = lambda rows: ([max(r.max_error, floor) for r in rows], [1e6 * r.seconds_per_trajectory for r in rows])  # noqa: E731
    rows = _drawn(found, what)
    ax.plot(*at(found.front(what)), color=_FRONT, lw=7, solid_capstyle="round", solid_joinstyle="round", zorder=1)
    for way in dict.fromkeys((row.method, row.steps, row.dtype) for row in rows):
        method, steps, dtype = way
        curve = _to_floor([row for row in rows if (row.method, row.steps, row.dtype) == way], floor)
        style = _style(steps, dtype, colours[method])
        ax.plot(*at(curve), zorder=3 if dtype == "float64" else 2.5, **style)
    ax.set(xscale="log", yscale="log")
    ax.invert_xaxis()
    low, high = ax.get_xlim()[1], ax.get_xlim()[0]
    if low < 10 * floor:
        low = min(low, floor / 30)
        ax.axvspan(floor, low, color="#f3f3ef", lw=0, zorder=0)
        where = {"transform": ax.get_xaxis_transform(), "rotation": 90, "ha": "center", "va": "top", "color": _FAINT}
        ax.text(math.sqrt(floor * low), 0.98, "reference not known better", fontsize=6, **where)
    ax.set_xlim(high, low)
    name, label = _AXES[what]
    ax.set_title(name, fontsize=9, loc="left", color=_INK)
    ax.set_xlabel(label, fontsize=9)
    ax.tick_params(labelsize=8)
    ax.spines[["top", "right"]].set_visible(False)
    ax.grid(which="major", color="#ececec", lw=0.6, zorder=0)


def _style(steps: str, dtype: str, colour: str) -> dict[str, Any]:
    """Filled markers for float64, open ones for float32; dashes and squares for fixed steps, a star for `Exact`."""
    marker, size = {"adaptive": ("o", 3.6), "fixed": ("s", 3.4), "exact": ("*", 9.0)}[steps]
    single = dtype == "float32"
    return {
        "color": colour,
        "lw": 0.8 if single else 1.2,
        "ls": "--" if steps == "fixed" else "-",
        "marker": marker,
        "ms": size,
        "mew": 0.9,
        "mfc": "white" if single else colour,
    }


def _legend(figure: Figure, colours: dict[str, str], found: Tradeoff) -> None:
    from matplotlib.lines import Line2D

    handles, names = [], []
    for method, colour in colours.items():
        marker: dict[str, Any] = {"marker": "*", "ms": 9, "lw": 0} if method == "Exact" else {"lw": 2.0}
        handles.append(Line2D([], [], color=colour, **marker))
        names.append(method)
    styles = {(row.steps, row.dtype) for row in found.rows}
    for steps, words in (("adaptive", "adaptive steps"), ("fixed", "fixed steps")):
        for dtype in ("float64", "float32"):
            if (steps, dtype) in styles:
                handles.append(Line2D([], [], **_style(steps, dtype, _INK)))
                names.append(f"{words}, {dtype}")
    handles.append(Line2D([], [], color=_FRONT, lw=7, solid_capstyle="round"))
    names.append("Pareto front")
    figure.legend(handles, names, loc="outside right center", frameon=False, fontsize=8, handlelength=2.2)
