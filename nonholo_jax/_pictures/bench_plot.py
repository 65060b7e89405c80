"""The picture of a benchmark: rate against batch size, a panel for each scene, a line for each device, dtype and job.

Nothing here touches `pyplot` or `rcParams`, as in `plot.py`.
"""

from pathlib import Path
from typing import TYPE_CHECKING, Any

from .._questions import Bench, Rate

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
else:  # matplotlib is loaded only when a picture is drawn
    Axes = Figure = Any

_INK, _FAINT = "#222222", "#767676"
# Okabe and Ito's colours, which colour-blind readers can tell apart: the CPU is blue, what else there is warm.
_COLOURS = {"cpu": "#0072B2", "gpu": "#D55E00", "tpu": "#CC79A7"}
_OTHERS = ("#009E73", "#E69F00", "#56B4E9")
_MARKERS = {"value": ("o", "-"), "gradient": ("s", "--")}


def plot_bench(found: Bench, *, path: str | Path | None = None) -> Figure:
    """Draw throws per second against throws in a batch, both logarithmic, with the middle half of the runs as bars.

    **Arguments:** `found` by `bench`; `path` of the PNG, PDF or SVG file to write, if any.

    Returns a `matplotlib.figure.Figure`. Raises `ValueError` where there is nothing to draw, `OSError` where the file
    cannot be written.
    """
    from matplotlib.figure import Figure

    if not found.rows:
        raise ValueError("Argument `found` must have a row, but got none; try other devices or sizes.")
    scenes = list(dict.fromkeys(row.scene for row in found.rows))
    figure = Figure(figsize=(2.9 * len(scenes) + 2.2, 3.7), layout="constrained")
    axes = figure.subplots(1, len(scenes), sharex=True, sharey=True, squeeze=False)[0]
    devices = list(dict.fromkeys(row.device for row in found.rows))
    others = [device for device in devices if device not in _COLOURS]
    colours = _COLOURS | {device: _OTHERS[i % len(_OTHERS)] for i, device in enumerate(others)}
    for ax, scene in zip(axes, scenes, strict=True):
        _panel(ax, [row for row in found.rows if row.scene == scene], colours)
        ax.set_title(scene, fontsize=9, loc="left", color=_INK)
    axes[0].set_ylabel("throws per second", fontsize=9)
    _legend(figure, found, devices, colours)
    figure.suptitle(found.machine, fontsize=7, color=_FAINT, x=0.01, ha="left")
    if path is not None:
        figure.savefig(path, dpi=160)
    return figure


def _panel(ax: Axes, rows: list[Rate], colours: dict[str, str]) -> None:
    for which in dict.fromkeys((row.device, row.dtype, row.job) for row in rows):
        line = [row for row in rows if (row.device, row.dtype, row.job) == which]
        sizes, rates = [row.throws for row in line], [row.throws_per_second for row in line]
        bars = [row.spread * row.throws_per_second for row in line]
        style = _style(*which[1:], colours[which[0]])
        ax.errorbar(sizes, rates, yerr=bars, elinewidth=0.8, capsize=0, zorder=3, **style)
    ax.set(xscale="log", yscale="log")
    low, high = ax.get_ylim()
    ax.set_ylim(low, high * 1.3)
    if len({row.throws for row in rows}) == 1:
        ax.set_xlim(rows[0].throws / 10, rows[0].throws * 10)
    ax.set_xlabel("throws in a batch", fontsize=9)
    ax.tick_params(labelsize=8)
    ax.spines[["top", "right"]].set_visible(False)
    ax.grid(which="major", color="#ececec", lw=0.6, zorder=0)


def _style(dtype: str, job: str, colour: str) -> dict[str, Any]:
    """Round markers and lines for values, squares and dashes for gradients; filled for float64, open for float32."""
    marker, dashes = _MARKERS[job]
    face = colour if dtype == "float64" else "white"
    return {"color": colour, "lw": 1.2, "ls": dashes, "marker": marker, "ms": 4.2, "mew": 1.0, "mfc": face}


def _legend(figure: Figure, found: Bench, devices: list[str], colours: dict[str, str]) -> None:
    from matplotlib.lines import Line2D

    handles, names = [], []
    for device in devices:
        count = max(row.devices for row in found.rows if row.device == device)
        handles.append(Line2D([], [], color=colours[device], lw=3.0))
        names.append(f"{device}, {count} devices" if count > 1 else device)
    styles = dict.fromkeys((row.job, row.dtype) for row in found.rows)
    for job, dtype in sorted(styles, key=lambda style: (style[0] != "value", style[1])):
        handles.append(Line2D([], [], **_style(dtype, job, _INK)))
        names.append(f"{job}, {dtype}")
    figure.legend(handles, names, loc="outside right center", frameon=False, fontsize=8, handlelength=2.6)
