"""The picture of a Monte Carlo study: where balls land, how a quantity is distributed, which ways they take, and how
the estimate converges.

Nothing here touches `pyplot` or `rcParams`, as in `plot.py`.
"""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from .._ensembles import Ensemble
from .outline import View, room

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
else:  # matplotlib is loaded only when a picture is drawn
    Axes = Figure = Any

_INK, _FAINT, _BAR, _BAND = "#222222", "#9a9a9a", "#0072B2", "#bcd7ea"
_ITINERARIES = 8
_WIDE = 5.8  # inches, of a plan
_NEAR = 8.0  # times the size of a cloud of places: what of the room is drawn with it
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
    plans = [(k, *_extent(found, k)) for k, plane in enumerate(found.sums.planes) if plane.sum()]
    panels = []
    spread = quantity if quantity in numbers else next(iter(_spread(found, numbers)), None)
    if spread is not None:
        panels.append(lambda ax: _distribution(ax, found, spread))
    if found.sums.itineraries:
        panels.append(lambda ax: _itineraries(ax, found))
    estimated = quantity or next(iter([*events, *numbers]), None)
    if estimated is not None:
        panels.append(lambda ax: _convergence(ax, found, estimated))
    deep = [_WIDE * min(max((high - low)[1] / (high - low)[0], 0.15), 0.6) + 0.8 for _, low, high in plans]
    deep += [2.8] * -(-len(panels) // 2)
    figure = Figure(figsize=(7.6, sum(deep, 0.3)), layout="constrained")
    grid = figure.add_gridspec(max(len(deep), 1), 2, height_ratios=deep or None)
    for row, (k, low, high) in enumerate(plans):
        _places(figure.add_subplot(grid[row, :]), found, k, low, high)
    for i, draw in enumerate(panels):
        last = i == len(panels) - 1 and i % 2 == 0  # alone in its row
        row = len(plans) + i // 2
        draw(figure.add_subplot(grid[row, :] if last else grid[row, i % 2]))
    for ax in figure.axes:
        ax.tick_params(labelsize=8, length=3, width=0.7)
        ax.spines[:].set(linewidth=0.7)
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


def _extent(found: Ensemble, k: int) -> tuple[np.ndarray, np.ndarray]:
    """Of a plan: the places, and what of the room has an end and is near."""
    i, j = found.frame.pairs[k]
    x, y, counts = found.frame.edges[i], found.frame.edges[j], found.sums.planes[k]
    used = [np.flatnonzero(counts.sum(axis=axis)) for axis in (1, 0)]
    first = np.array([x[used[0][0]], y[used[1][0]]])
    last = np.array([x[used[0][-1] + 1], y[used[1][-1] + 1]])
    wide, low, high = float(max(last - first)), first, last
    for points in _outlines(found, (first + last) / 2, (1.0 + _NEAR) * wide):
        below, above = points.min(axis=0), points.max(axis=0)
        if max(*(above - first), *(last - below)) <= _NEAR * wide:
            low, high = np.minimum(low, below), np.maximum(high, above)
    rim = 0.05 * max(high - low)
    return low - rim, high + rim


def _outlines(found: Ensemble, center: np.ndarray, reach: float) -> list[np.ndarray]:
    """Of the bodies of the room that have an end, from above; a study that was opened from its folder has no room."""
    if found.scene is None:
        return []
    shapes = [shape for part in room(found.scene, _ABOVE, center, reach) for shape in part]
    return [np.asarray(shape.points) for shape in shapes if shape.inward is None]


def _places(ax: Axes, found: Ensemble, k: int, low: np.ndarray, high: np.ndarray) -> None:
    from matplotlib.colors import LogNorm
    from matplotlib.patches import Polygon

    i, j = found.frame.pairs[k]
    x, y, counts = found.frame.edges[i], found.frame.edges[j], found.sums.planes[k]
    name = found.quantities[i].name.rsplit(".", 1)[0]
    shown = np.ma.masked_equal(counts.T, 0)
    mesh = ax.pcolormesh(x, y, shown, norm=LogNorm(1, max(counts.max(), 2)), cmap="viridis", rasterized=True)
    if found.scene is not None:
        parts = room(found.scene, _ABOVE, (low + high) / 2, float(np.linalg.norm(high - low)))
        for body, part in zip(found.scene.names, parts, strict=True):
            for shape in part:
                closed, points = shape.inward is None, np.asarray(shape.points)
                ax.add_patch(Polygon(points, closed=closed, fill=False, ec=_INK, lw=0.9, ls=(0, (4, 2))))
                if closed:
                    corner = (points[:, 0].min(), points[:, 1].max())
                    where = {"textcoords": "offset points", "va": "top", "fontsize": 7, "clip_on": True}
                    ax.annotate(body, corner, (3, -3), **where)
    ax.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
    bar = ax.figure.colorbar(mesh, cax=ax.inset_axes((1.02, 0.0, 0.02, 1.0)))
    bar.set_label("throws in a cell", fontsize=8)
    bar.ax.tick_params(labelsize=7)
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
    for y, share in zip(place, shares, strict=True):
        ax.annotate(f"{share:.2%}", (share, y), (4, 0), textcoords="offset points", va="center", fontsize=7)
    ax.set_xlim(0.0, 1.3 * max(shares))
    ax.set_xticks([tick for tick in ax.get_xticks() if 0.0 <= tick <= min(1.0, 1.3 * max(shares))])
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
