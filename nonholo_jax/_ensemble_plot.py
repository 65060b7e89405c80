"""The picture of a Monte Carlo study: where balls land, how a quantity is distributed, which ways they take, and how
the estimate converges.

Nothing here touches `pyplot` or `rcParams`, as in `plot.py`.
"""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ._ensemble import Ensemble
from ._outline import View, room

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
else:  # matplotlib is loaded only when a picture is drawn
    Axes = Figure = Any

_INK, _FAINT, _BAR, _BAND = "#222222", "#9a9a9a", "#0072B2", "#bcd7ea"
_ITINERARIES = 8
_ABOVE = View(np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0]), 0.0, False)


def plot_ensemble(found: Ensemble, *, quantity: str | None = None, path: str | Path | None = None) -> Figure:
    """Draw a study: places that were measured, seen from above with the room; the distribution of a quantity;
    frequencies of itineraries with their standard errors; and the estimate after so many throws with its 95 % band.

    **Arguments:** `found` by `monte_carlo`; `quantity`, by name, for the distribution and the estimate (default: the
    first number, and the first event if there is one); `path` of the PNG, PDF or SVG file to write, if any.

    Returns a `matplotlib.figure.Figure`. Raises `ValueError` for a quantity that was not measured, `OSError` where the
    file cannot be written.
    """
    from matplotlib.figure import Figure

    names = [each.name for each in found.quantities]
    if quantity is not None and quantity not in names:
        raise ValueError(f"Argument `quantity` must be one of {', '.join(names)}, but got {quantity!r}.")
    numbers = [each.name for each in found.quantities if not each.event]
    events = [each.name for each in found.quantities if each.event]
    panels = []
    if found.frame.pairs and found.sums.planes[0].sum():
        panels.append(lambda ax: _places(ax, found))
    spread = quantity if quantity in numbers else next(iter(_spread(found, numbers)), None)
    if spread is not None:
        panels.append(lambda ax: _distribution(ax, found, spread))
    if found.sums.itineraries:
        panels.append(lambda ax: _itineraries(ax, found))
    estimated = quantity or next(iter([*events, *numbers]), None)
    if estimated is not None:
        panels.append(lambda ax: _convergence(ax, found, estimated))
    rows = -(-len(panels) // 2)
    figure = Figure(figsize=(7.6, 3.1 * max(rows, 1) + 0.3), layout="constrained")
    axes = figure.subplots(max(rows, 1), 2, squeeze=False).ravel()
    for ax, draw in zip(axes, panels, strict=False):
        draw(ax)
        ax.tick_params(labelsize=8, length=3, width=0.7)
        ax.spines[:].set(linewidth=0.7)
    for ax in axes[len(panels) :]:
        ax.remove()
    figure.suptitle(f"{found.n:,} throws", fontsize=10, x=0.02, ha="left")
    if path is not None:
        figure.savefig(path, dpi=160)
    return figure


def _spread(found: Ensemble, numbers: list[str]) -> list[str]:
    """Quantities that are no places first: those are drawn already."""
    placed = {found.quantities[i].name.rsplit(".", 1)[0] for pair in found.frame.pairs for i in pair}
    there = [name for name in numbers if found.present(name)]
    return sorted(there, key=lambda name: name.rsplit(".", 1)[0] in placed)


def _label(found: Ensemble, name: str) -> str:
    unit = next(each.unit for each in found.quantities if each.name == name)
    return f"{name} ({unit})" if unit else name


def _places(ax: Axes, found: Ensemble) -> None:
    from matplotlib.colors import LogNorm
    from matplotlib.patches import Polygon

    i, j = found.frame.pairs[0]
    x, y, counts = found.frame.edges[i], found.frame.edges[j], found.sums.planes[0]
    name = found.quantities[i].name.rsplit(".", 1)[0]
    shown = np.ma.masked_equal(counts.T, 0)
    mesh = ax.pcolormesh(x, y, shown, norm=LogNorm(1, max(counts.max(), 2)), cmap="viridis", rasterized=True)
    bar = ax.figure.colorbar(mesh, ax=ax, shrink=0.85, pad=0.02)
    bar.set_label("throws in a cell", fontsize=8)
    bar.ax.tick_params(labelsize=7)
    used = [np.flatnonzero(counts.sum(axis=k)) for k in (1, 0)]
    low = np.array([x[used[0][0]], y[used[1][0]]])
    high = np.array([x[used[0][-1] + 1], y[used[1][-1] + 1]])
    rim = 0.1 * max(high - low)
    low, high = low - rim, high + rim
    if found.scene is not None:
        reach = float(np.linalg.norm(high - low))
        for shapes in room(found.scene, _ABOVE, (low + high) / 2, reach):
            for shape in shapes:
                closed = shape.inward is None
                ax.add_patch(Polygon(shape.points, closed=closed, fill=False, ec=_INK, lw=0.9, ls=(0, (4, 2))))
    ax.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
    ax.set_title(f"{name}, from above", fontsize=9, loc="left")
    ax.set_xlabel("x (m)", fontsize=8)
    ax.set_ylabel("y (m)", fontsize=8)


def _distribution(ax: Axes, found: Ensemble, name: str) -> None:
    counts, edges = found.histogram(name)
    inside, present = counts[1:-1], max(found.present(name), 1)
    ax.stairs(inside / (present * np.diff(edges)), edges, fill=True, color=_BAND, ec=_BAR, lw=0.8)
    used = np.flatnonzero(inside)
    if len(used):
        ax.set_xlim(float(edges[used[0]]), float(edges[used[-1] + 1]))
    outside = int(counts[0] + counts[-1])
    middle = found.quantile(name, 0.5)[0]
    ax.axvline(middle, color=_INK, lw=0.9)
    for level in (0.05, 0.95):
        ax.axvline(found.quantile(name, level)[0], color=_INK, lw=0.7, ls=(0, (3, 3)))
    note = "" if present == found.n else f"; absent in {found.n - present}"
    note += f"; {outside} outside" if outside else ""
    ax.set_title(f"{name}: median and 90 % of {'those there' if present < found.n else 'all'}", fontsize=9, loc="left")
    ax.set_xlabel(f"{_label(found, name)}{note}", fontsize=8)
    ax.set_ylabel("density", fontsize=8)
    ax.set_ylim(bottom=0)


def _itineraries(ax: Axes, found: Ensemble) -> None:
    rows = found.itineraries
    shown, rest = rows[:_ITINERARIES], rows[_ITINERARIES:]
    labels = [_short(each.what) for each in shown]
    shares, errors = [each.probability for each in shown], [each.standard_error for each in shown]
    if rest:
        labels.append(f"{len(rest)} others")
        share = sum(each.count for each in rest) / found.n
        shares.append(share)
        errors.append(float(np.sqrt(share * (1.0 - share) / found.n)))
    place = np.arange(len(labels))
    ax.barh(place, shares, xerr=errors, color=_BAND, ec=_BAR, lw=0.8, error_kw={"lw": 0.9, "ecolor": _INK})
    ax.set_yticks(place, labels, fontsize=7)
    ax.set_ylim(max(len(labels), 4) - 0.4, -0.6)
    ax.set_title("itineraries", fontsize=9, loc="left")
    ax.set_xlabel("part of the throws", fontsize=8)


def _short(itinerary: tuple[str, ...]) -> str:
    if not itinerary:
        return "no impact"
    text = " ".join(itinerary)
    return text if len(text) <= 34 else text[:31] + "..."


def _convergence(ax: Axes, found: Ensemble, name: str) -> None:
    i = [each.name for each in found.quantities].index(name)
    n = np.array([each.throws for each in found.history], dtype=float)
    mean = np.array([each.mean[i] for each in found.history])
    error = np.array([each.standard_error[i] for each in found.history])
    ax.fill_between(n, mean - 1.96 * error, mean + 1.96 * error, color=_BAND, lw=0)
    ax.plot(n, mean, color=_BAR, lw=1.2, marker="." if len(n) < 12 else None)
    ax.axhline(mean[-1], color=_FAINT, lw=0.7, ls=(0, (3, 3)))
    if n[-1] > 10 * n[0]:
        ax.set_xscale("log")
    what = "probability" if found.quantities[i].event else "mean"
    ax.set_title(f"{what} of {name}, with its 95 % band", fontsize=9, loc="left")
    ax.set_xlabel("throws", fontsize=8)
    ax.set_ylabel(_label(found, name), fontsize=8)
