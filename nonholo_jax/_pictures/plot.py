"""Pictures of a throw: the room from the side, the path, the impacts with their spin, and energy and spin in time.

Nothing here touches `pyplot` or `rcParams`: a figure is a plain `matplotlib.figure.Figure`, drawn by Agg when saved.
Lengths on paper are in points (1/72 inch); `Panel.point` is one of them in metres.
"""

from io import BytesIO
from itertools import groupby
from pathlib import Path
from textwrap import fill
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from .._math import NO_IMPACTS, result_name
from .._world import Scene
from .ensemble_plot import plot_ensemble as plot_ensemble
from .fit_plot import plot_fits as plot_fits
from .outline import View, as_numpy, axis_name, half_plane, room, views
from .samples import WORDS, Samples, Strikes, end_of, energies, sample

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
else:  # matplotlib is loaded only when a picture is drawn
    Axes = Figure = Any

_NUMBERED = 9
_FULL_TURN = 300.0  # degrees of arc for the fastest spin drawn
_SMALLEST_BALL = 4.5  # radius in points
_INK, _FAINT, _SOLID = "#222222", "#9a9a9a", "#dcdcd6"
_ENERGIES = {"total": _INK, "translational": "#0072B2", "rotational": "#D55E00", "potential": "#009E73"}
_SPINS = {"x": "#CC79A7", "y": "#7A4FA3", "z": "#B8860B"}


# How it is drawn


class Panel:
    """An axes to scale, with what labels on it must keep away from."""

    def __init__(self, ax: Axes, view: View, low: np.ndarray, high: np.ndarray, scale: float):
        self.ax, self.view, self.low, self.high = ax, view, low, high
        self.point = 1 / (72 * scale)
        self.path = np.zeros((0, 2))  # points that labels avoid most
        self.crowd: list[np.ndarray] = []  # points that labels avoid
        self.boxes: list[tuple] = []  # labels already there
        ax.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")

    def keep_clear(self, points: np.ndarray) -> None:
        """Labels avoid this line."""
        self.crowd.append(_resampled(points, 1.5 * self.point)[0])

    def place(self, label: str, around: np.ndarray, cost: np.ndarray, must: bool = False, **style: Any) -> None:
        """Write a label centred at the cheapest of the points `around`; if none is free, only what `must` be there."""
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.patheffects import withStroke

        text = self.ax.text(0, 0, label, ha="center", va="center", **{"fontsize": 9, "zorder": 9, **style})
        text.set_path_effects([withStroke(linewidth=2.5, foreground="white")])
        figure = self.ax.figure
        extent = text.get_window_extent(FigureCanvasAgg(figure).get_renderer())  # pyright: ignore
        size = np.array([extent.width, extent.height]) * 36 / figure.dpi * self.point  # half of it
        need = size + 1.5 * self.point
        crowd = np.concatenate([np.zeros((0, 2)), *self.crowd])
        apart = need + np.array([5, 2]) * self.point
        best, least = around[0], np.inf
        for at, price in zip(around, cost, strict=True):
            price += 1e4 * bool((at - need < self.low).any() or (at + need > self.high).any())
            price += 1e3 * sum(bool((np.abs(at - c) < apart + s).all()) for c, s in self.boxes)
            if price < least:
                price += 10.0 * np.count_nonzero((np.abs(crowd - at) < need).all(axis=1))
                price += 40.0 * np.count_nonzero((np.abs(self.path - at) < need).all(axis=1))
            if price < least:
                best, least = at, price
        if least > 90 and not must:
            text.remove()
            return
        self.boxes.append((best, size))
        text.set_position(tuple(best))


def _resampled(points: np.ndarray, spacing: float) -> tuple[np.ndarray, np.ndarray]:
    """Points evenly spaced along a line, and the indices (fractional) they come from."""
    lengths = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    ticks = np.arange(0.0, lengths[-1] + 0.5 * spacing, spacing)
    index = np.interp(ticks, lengths, np.arange(len(points)))
    return np.stack([np.interp(ticks, lengths, points[:, i]) for i in range(2)], axis=-1), index


def _draw_room(panel: Panel, scene: Scene) -> list[tuple[str, np.ndarray]]:
    """Returns the names of what is seen, each with places where it may be written."""
    from matplotlib.collections import LineCollection
    from matplotlib.colors import to_rgb
    from matplotlib.patches import Polygon

    low, high, point = panel.low, panel.high, panel.point
    middle, reach = (low + high) / 2, 0.75 * float(np.linalg.norm(high - low))
    names = []
    for name, shapes in zip(scene.names, room(scene, panel.view, middle, reach), strict=True):
        spots = []
        for shape in shapes:
            hidden = not (shape.cut or panel.view.planar)  # behind a wall
            edge: dict[str, Any] = {"ec": _INK, "lw": 1.0, "ls": "-" if shape.cut else (0, (4, 3))}
            outline = shape.points if shape.inward is not None else np.vstack([shape.points, shape.points[:1]])
            line, index = _resampled(outline, 5 * point)
            if shape.inward is None:
                face = "none" if not shape.cut else _SOLID if panel.view.planar else (*to_rgb(_SOLID), 0.6)
                panel.ax.add_patch(Polygon(outline, fc=face, zorder=1.6 if hidden else 1, gid="solid", **edge))
                corner = np.clip(outline, low, high)
                spots.append((corner.min(axis=0) + corner.max(axis=0))[None] / 2)
                steps = np.array([(0, -1), (0, 1), (-2, 0), (2, 0)])
            else:
                behind = half_plane(shape, reach)
                above = 0.5 * bool(len(behind))  # straight walls hide what reaches into them
                if above:
                    panel.ax.add_patch(Polygon(behind, fc="white", lw=0, zorder=1.4))
                panel.ax.add_patch(Polygon(outline, closed=False, fill=False, zorder=1.2 + above, gid="wall", **edge))
                steps = shape.inward[np.round(index).astype(int)]
                ends = line + point * (6 * steps - 4.5 * np.gradient(line, axis=0) / (5 * point))
                strokes = LineCollection([*np.stack([line, ends], axis=1)], colors=_FAINT, lw=0.6, zorder=1.1 + above)
                panel.ax.add_collection(strokes)
                panel.crowd.append(line + 4 * point * steps)
                steps = steps[:, None]
            seen = ((line > low) & (line < high)).all(axis=1)
            for gap in (12, 16, 22, 30) if shape.inward is None else (12, 16, 22, 30, -9):
                spots.append((line[:, None] + gap * point * steps)[seen].reshape(-1, 2))
            panel.keep_clear(outline)
        if any(len(each) for each in spots):
            names.append((name, np.concatenate(spots)))
    return names


def _draw_path(panel: Panel, samples: Samples, colour: Any) -> None:
    """Coloured by time, and thinner with time, so that a path that retraces itself is seen twice."""
    from matplotlib.collections import LineCollection

    flat = panel.view.flat(samples.position)
    width = 2.8 - 1.4 * samples.arc / max(samples.arc[-1], 1) if samples.arc[-1] < 12 else np.full(len(flat), 1.2)
    lines = LineCollection([*np.stack([flat[:-1], flat[1:]], axis=1)], zorder=3, capstyle="round", gid="path",
                           colors=colour.to_rgba((samples.time[:-1] + samples.time[1:]) / 2), lw=width[1:])  # fmt: skip
    panel.ax.add_collection(lines)
    panel.path = _resampled(flat, 1.5 * panel.point)[0]


def _ring(angle: np.ndarray) -> np.ndarray:
    return np.stack([np.cos(angle), np.sin(angle)], axis=-1)


def _around(center: np.ndarray, distances: list[float], towards: float) -> tuple[np.ndarray, np.ndarray]:
    """Places for a label, and what each costs: near ones first, and those in the direction `towards`."""
    angle = towards + np.linspace(0, 2 * np.pi, 25)[:-1]
    places = np.concatenate([center + distance * _ring(angle) for distance in distances])
    return places, np.repeat(4.0 * np.arange(len(distances)), 24) + np.tile(1 - np.cos(angle - towards), len(distances))


def _draw_spin(panel: Panel, center: np.ndarray, radius: float, middle: float, turn: float, style: dict) -> None:
    """An arrow along a circle, `turn` radians long (positive is anticlockwise), about the angle `middle`."""
    from matplotlib.patches import Polygon

    head = np.sign(turn) * min(5.5 * panel.point / radius, 0.8 * abs(turn))
    start, neck, tip = middle - turn / 2, middle + turn / 2 - head, middle + turn / 2
    arc = center + radius * _ring(np.linspace(start, neck + 0.3 * head, 60))
    half = 0.5 * abs(head) * radius
    corners = [(radius + half) * _ring(np.array(neck)), radius * _ring(np.array(tip)),
               (radius - half) * _ring(np.array(neck)), radius * _ring(np.array(neck + 0.3 * head))]  # fmt: skip
    panel.ax.plot(*arc.T, lw=1.3, solid_capstyle="butt", zorder=6, **style)
    panel.ax.add_patch(Polygon(center + np.array(corners), fc=style["color"], lw=0, zorder=6, gid="spin-head"))
    panel.crowd += [arc, center + np.array(corners)]


def _clear_angle(panel: Panel, center: np.ndarray, radius: float, free: float, turn: float) -> float:
    """Where an arc hides least of the path, and is hidden least by it: away from the wall, or to its sides."""
    if turn > 2.2:
        return free
    away = panel.path - center
    near = away[np.abs(np.linalg.norm(away, axis=1) - radius) < 3 * panel.point]
    angle = np.arctan2(near[:, 1], near[:, 0])

    def hidden(middle: float) -> int:
        return int(np.count_nonzero(np.abs((angle - middle + np.pi) % (2 * np.pi) - np.pi) < turn / 2 + 0.1))

    return min((free + np.radians(side) for side in (0, 45, -45, 75, -75)), key=hidden)


def _counted(indices: list[int]) -> str:
    """`1, 3` and `1-9` for the numbers of some impacts."""
    runs: list[list[int]] = []
    for i in indices:
        if not runs or i > runs[-1][-1] + 1:
            runs.append([])
        runs[-1].append(i)
    dash = "\N{EN DASH}"
    return ", ".join(f"{r[0] + 1}{(dash if len(r) > 2 else ', ') + str(r[-1] + 1) if len(r) > 1 else ''}" for r in runs)


def _draw_impacts(panel: Panel, strikes: Strikes, colour: Any, radius: float, fastest: float) -> None:
    """The ball at every impact; number and spin of the first nine. Balls in one place share a label."""
    from matplotlib.patches import Circle

    flat, normal = panel.view.flat(strikes.position), panel.view.flat(strikes.normal)
    places: list[list[int]] = []
    rings: dict[int, int] = {}  # arrows already round a place, by its first impact
    for i, center in enumerate(flat):
        shade = colour.to_rgba(strikes.time[i])
        panel.ax.add_patch(Circle(tuple(center), radius, fc=(*shade[:3], 0.18), ec=shade, lw=1.1, zorder=4, gid="ball"))
        panel.crowd += [center + size * radius * _ring(np.linspace(0, 2 * np.pi, 16)) for size in (0.3, 0.65, 1.0)]
        if i >= _NUMBERED:
            continue
        near = [place for place in places if np.linalg.norm(flat[place[0]] - center) < 0.7 * radius]
        if not near:
            places.append([])
        place = near[0] if near else places[-1]
        place.append(i)
        ring = radius + (3.5 + 5.0 * min(rings.get(place[0], 0), 3)) * panel.point
        turn = np.radians(_FULL_TURN) * (strikes.spin[i] @ panel.view.toward) / fastest
        if abs(turn) * ring > panel.point:
            free = _clear_angle(panel, center, ring, float(np.arctan2(normal[i, 1], normal[i, 0])), abs(turn))
            _draw_spin(panel, center, ring, free, turn, {"color": shade, "gid": f"spin-{i + 1}"})
            rings[place[0]] = rings.get(place[0], 0) + 1
    for place in places:
        ring = radius + (9.0 + 5.0 * min(rings.get(place[0], 0), 4)) * panel.point
        wall = float(np.arctan2(*-normal[place[0], ::-1]))
        around, cost = _around(flat[place[0]], [gap * ring for gap in (1.0, 1.3, 1.7, 2.3)], wall)
        others = np.delete(flat, place, axis=0)[:_NUMBERED]
        nearest = np.linalg.norm(around[:, None] - others, axis=-1).min(axis=1, initial=np.inf)
        cost = cost + 40.0 * (nearest < 1.2 * np.linalg.norm(around - flat[place[0]], axis=-1))  # whose number is it?
        panel.place(_counted(place), around, cost, True, fontweight="bold", gid="number")


def _draw_start(panel: Panel, samples: Samples, colour: Any, radius: float, marks: dict, named: bool) -> None:
    """The ball as it is thrown, its velocity, and points marked by name; with labels where `named`."""
    from matplotlib.patches import Circle, FancyArrowPatch
    from matplotlib.patheffects import Normal, withStroke

    point = panel.point
    center, velocity = panel.view.flat(samples.position[0]), panel.view.flat(samples.velocity[0])
    shade = colour.to_rgba(samples.time[0])
    panel.ax.add_patch(Circle(tuple(center), radius, fc="white", ec=shade, lw=1.1, zorder=4, gid="start"))
    panel.crowd += [center + size * radius * _ring(np.linspace(0, 2 * np.pi, 16)) for size in (0.5, 1.0)]
    speed, tip = float(np.linalg.norm(velocity)), center
    if speed > 1e-9:
        tip = center + velocity / speed * (radius + 26 * point)
        arrow = FancyArrowPatch(tuple(center), tuple(tip), arrowstyle="-|>", mutation_scale=11, color=_INK, lw=1.3,
                                shrinkA=0, shrinkB=0, zorder=7, gid="velocity")  # fmt: skip
        arrow.set_path_effects([withStroke(linewidth=2.4, foreground="white"), Normal()])
        panel.ax.add_patch(arrow)
        panel.keep_clear(np.stack([center, tip]))
    for name, place in marks.items():
        at = panel.view.flat(place)
        panel.ax.plot(*at, "*", ms=10, mfc="#E69F00", mec=_INK, mew=0.7, zorder=8, gid=name)
        panel.crowd.append(at + 5 * point * _ring(np.linspace(0, 2 * np.pi, 8)))
        if named:
            around, cost = _around(at, [radius + gap * point for gap in (9, 13, 18, 26, 36)], np.pi)
            panel.place(name, around, cost, fontsize=9, gid=f"{name}-label")
    if speed > 1e-9 and named:
        full = float(np.linalg.norm(samples.velocity[0]))
        around, cost = _around(tip, [gap * point for gap in (16, 22, 30, 40)], np.arctan2(*velocity[::-1]))
        panel.place(f"{full:.3g} m/s", around, cost, fontsize=8, gid="speed")


def _draw_times(energy: Axes, spin: Axes, scene: Scene, samples: Samples, strikes: Strikes, second: float) -> None:
    """Energy and spin against time; `second` is its length in points."""
    for name, values in energies(scene, samples).items():
        if name == "potential" and not values.any():
            continue
        wide = 1.8 if name == "total" else 1.2
        energy.plot(samples.time, values, color=_ENERGIES[name], lw=wide, label=name, gid=f"energy-{name}")
    scale = np.abs(samples.spin).max()
    spin.axhline(0, color=_FAINT, lw=0.5, zorder=0)
    for i, name in enumerate("xyz"):
        if np.abs(samples.spin[:, i]).max() > 1e-9 * scale:
            spin.plot(samples.time, samples.spin[:, i], color=_SPINS[name], lw=1.3, gid=f"spin-{name}",
                      label=rf"$\omega_{name}$")  # fmt: skip
    if scale == 0:
        spin.plot(samples.time[[0, -1]], [0, 0], color=_INK, lw=1.3, label="no spin")
        spin.set_ylim(-1, 1)
    energy.set_ylabel("energy (J)", fontsize=9)
    spin.set_ylabel("spin (rad/s)", fontsize=9)
    spin.set_xlabel("time (s)", fontsize=9)
    energy.tick_params(labelbottom=False)
    written = -np.inf
    for ax in (energy, spin):
        for time in strikes.time:
            ax.axvline(time, color=_FAINT, lw=0.5 if len(strikes.time) <= 30 else 0.2, zorder=0, gid="impact-time")
        ax.set_xlim(samples.time[0], max(samples.time[-1], samples.time[0] + 1e-9))
        ax.margins(y=0.08)
        ax.spines[["top", "right"]].set_visible(False)
        ax.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncol=4, fontsize=8, frameon=False,
                  borderaxespad=1.1 if ax is energy else 0.1, handlelength=1.3, columnspacing=1.2)  # fmt: skip
    for i, time in enumerate(strikes.time[:_NUMBERED]):
        if (time - written) * second > 9:
            energy.text(time, 1.01, str(i + 1), transform=energy.get_xaxis_transform(), ha="center", va="bottom",
                        fontsize=7, fontweight="bold", gid="impact-number")  # fmt: skip
            written = time


# The page


class Page(NamedTuple):
    """Where everything is, in inches: (left, bottom, width, height)."""

    size: tuple[float, float]
    scale: float  # inches per metre
    side: tuple
    above: tuple | None
    bar: tuple
    energy: tuple
    spin: tuple


def _page(width: float, height: float, depth: float | None) -> Page:
    """Panels below a wide room, and beside a tall one. `depth` is that of the plan view, if there is one."""
    left, bottom, gap, least = 0.72, 0.85, 0.5, 0.7
    plan = depth or 0.0
    between = gap * (depth is not None)
    if height + plan < 0.7 * width:
        w, base = 6.2, bottom + 3.65
        scale = w / width
        heights = [max(height * scale, 1.3), max(plan * scale, least) * (depth is not None)]
        energy, spin = (left, bottom + 1.5, w, 1.35), (left, bottom, w, 1.1)
        full = left + w + 0.95
    else:
        scale = min((4.5 - between) / (height + plan), 5.2 / width)
        heights = [height * scale, max(plan * scale, least) * (depth is not None)]
        w, base = max(width * scale, 2.4), bottom
        x, tall = left + w + 1.6, (sum(heights) + between - 0.42) / 2
        energy, spin = (x, bottom + tall + 0.42, 3.2, tall), (x, bottom, 3.2, tall)
        full = x + 3.2 + 0.2
    above = None if depth is None else (left, base, w, heights[1])
    foot = base + heights[1] + between
    bar = (left + w + 0.12, foot, 0.13, heights[0])
    return Page((full, foot + heights[0] + 0.72), scale, (left, foot, w, heights[0]), above, bar, energy, spin)


def _bounds(view: View, position: np.ndarray, radius: float) -> tuple[np.ndarray, np.ndarray]:
    flat = view.flat(position)
    low, high = flat.min(axis=0), flat.max(axis=0)
    rim = 1.5 * radius + (0.11 if view.planar else 0.15) * float(np.max(high - low))
    return low - rim, high + rim


def _widened(scene: Scene, view: View, low: np.ndarray, high: np.ndarray, strikes: Strikes) -> tuple:
    """A view that shows more of the bodies that are hit, by up to half of its size, where they are no endless walls."""
    size = float(np.max(high - low))
    more = [low, high]
    for i, shapes in enumerate(room(scene, view, (low + high) / 2, 2 * size)):
        for points in [s.points for s in shapes if i in strikes.surface and s.inward is None and s.cut]:
            if np.ptp(points, axis=0).max() < 2 * size:
                more += [points.min(axis=0) - 0.06 * size, points.max(axis=0) + 0.06 * size]
    return np.maximum(np.min(more, axis=0), low - 0.5 * size), np.minimum(np.max(more, axis=0), high + 0.5 * size)


def _frame(figure: Figure, page: Page, place: tuple, low: np.ndarray, high: np.ndarray, view: View) -> Panel:
    """An axes to scale round the middle of what is to be seen."""
    middle, half = (low + high) / 2, np.array(place[2:]) / page.scale / 2
    panel = Panel(_axes(figure, page, place), view, middle - half, middle + half, page.scale)
    panel.ax.set_ylabel(f"{axis_name(view.up)} (m)", fontsize=9)
    return panel


def _axes(figure: Figure, page: Page, place: tuple, **options: Any) -> Axes:
    (w, h), (x, y, dx, dy) = page.size, place
    ax = figure.add_axes((x / w, y / h, dx / w, dy / h), **options)
    ax.tick_params(labelsize=8, length=3, width=0.7)
    ax.spines[:].set(linewidth=0.7)
    return ax


def _caption(scene: Scene, view: View, strikes: Strikes, enlarged: float, fastest: float) -> str:
    along = axis_name(-view.toward, "+")
    words = [f"Section in the plane of motion, seen along {along}."]
    if not view.planar:
        words = [f"Side view along {along}, and view from above; surfaces in outline."]
    if enlarged > 1:
        words.append(f"Ball drawn {enlarged:.3g} times its size.")
    if len(strikes.time):
        some = f" (first {_NUMBERED})" if len(strikes.time) > _NUMBERED else ""
        if fastest > 1e-9:
            words.append(
                f"Arc arrows: spin just after the impact{some}, {_FULL_TURN:.0f}\N{DEGREE SIGN} = {fastest:.3g} rad/s."
            )
    if not as_numpy(scene.gravity).any():
        words.append("No gravity.")
    return " ".join(words)


def _title(scene: Scene, trajectory: Any, strikes: Strikes, end: float, title: str | None) -> str:
    if title is None:
        names = [WORDS.get(k, "{}").format(scene.names[i]) for i, k in zip(strikes.surface, strikes.kind, strict=True)]
        groups = [(name, len(list(same))) for name, same in groupby(names)]
        words = [f"{name} \N{MULTIPLICATION SIGN}{n}" if n > 1 else name for name, n in groups]
        shown = ", ".join(words[:5]) + (", \N{HORIZONTAL ELLIPSIS}" if len(words) > 5 else "")
        n = len(names) - sum(strikes.kind.count(kind) for kind in NO_IMPACTS)
        title = f"{n} impact{'s' * (n != 1)}{': ' * bool(names)}{shown}"
    if end >= float(trajectory.t1) and result_name(trajectory.result) != "reached_t1":
        title += f" \N{EN DASH} ended at {end:.4g} s: {result_name(trajectory.result)}"
    return title


def _draw_texts(figure: Figure, page: Page, title: str, caption: str) -> None:
    left, (wide, tall) = page.side[0], page.size
    room = 72 * (wide - left - 0.2)
    figure.suptitle(fill(title, int(room / 6.2)), x=left / wide, y=1 - 0.15 / tall, ha="left", va="top", fontsize=11)
    figure.text(left / wide, 0.1 / tall, fill(caption, int(room / 4.4)), fontsize=8, color="#555555", gid="caption")


def _write(figure: Figure, path: str | Path) -> None:
    """A PNG; one that would be larger than 200 kB gets by with 256 colours, which takes a third."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from PIL import Image

    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    picture, page = Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3]), BytesIO()
    options: dict[str, Any] = {"format": "PNG", "optimize": True, "dpi": (figure.dpi, figure.dpi)}
    picture.save(page, **options)
    if page.tell() > 195_000:
        page = BytesIO()
        picture.quantize(256, method=Image.Quantize.MEDIANCUT, kmeans=2, dither=Image.Dither.NONE).save(page, **options)
    Path(path).write_bytes(page.getvalue())


def plot_trajectory(
    scene: Scene,
    trajectory: Any,
    *,
    hand: Any = None,
    target: Any = None,
    title: str | None = None,
    path: str | Path | None = None,
    until: float | None = None,
) -> Figure:
    """Draw one motion: the room from the side, the path coloured by time, the ball at every impact, energy and spin.

    **Arguments:**

    - `scene`: a `Scene`, and `trajectory`: what `simulate` made of it, with a log.
    - `hand`, `target`: points to mark, in m, shape (3,); `None` for no mark.
    - `title`: `None` for the itinerary. How the motion ended is added unless it did all that was asked of it.
    - `path`: where to write a PNG of 150 dots per inch; `None` to write nothing.
    - `until`: the picture ends at this time in s, or where the motion or its log ends if that is earlier.

    Returns a `matplotlib.figure.Figure` that belongs to nobody: `pyplot` is not used and no setting is changed. The
    picture looks along the horizontal direction in which the path is narrowest, with gravity down; a motion that is
    not planar is also seen from above. Raises `ValueError` for a batch, and for a motion without any finite state.

    ```python
    from nonholo_jax import Ball, BallState, Plane, Rough, Scene, simulate
    from nonholo_jax.plot import plot_trajectory
    scene = Scene(Ball(0.025, 0.046), {"floor": Plane((0, 0, 0), (0, 0, 1), Rough(0.8))})
    trajectory = simulate(scene, BallState([0, 0, 1], [1, 0, 0], [0, 30, 0]), t1=1.0)
    figure = plot_trajectory(scene, trajectory, hand=(0, 0, 1))
    ```
    """
    from matplotlib import colormaps
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import ListedColormap, Normalize
    from matplotlib.figure import Figure

    end = end_of(trajectory, until)
    samples, strikes = sample(trajectory, end)
    view, above = views(scene, samples.position)
    radius = float(scene.ball.radius)
    marks = {name: as_numpy(at) for name, at in (("hand", hand), ("target", target)) if at is not None}
    marked = np.vstack([samples.position, *marks.values()])
    low, high = _widened(scene, view, *_bounds(view, marked, radius), strikes)
    back, front = _bounds(above, marked, radius)
    back[0], front[0] = low[0], high[0]
    size, depth = high - low, None if view.planar else float(front[1] - back[1])
    page = _page(float(size[0]), float(size[1]), depth)
    figure = Figure(figsize=page.size, dpi=150, facecolor="white")
    shades = ListedColormap(colormaps["viridis"](np.linspace(0, 0.93, 256)))
    colour = ScalarMappable(Normalize(samples.time[0], max(end, samples.time[0] + 1e-9)), shades)
    panels = [_frame(figure, page, page.side, low, high, view)]
    if page.above is not None:
        panels.append(_frame(figure, page, page.above, back, front, above))
    panels[-1].ax.set_xlabel(f"{axis_name(view.right)} (m)", fontsize=9)
    drawn = max(radius, _SMALLEST_BALL * panels[0].point)
    axes = np.stack([panel.view.toward for panel in panels], axis=-1)
    fastest = float(np.abs(strikes.spin[:_NUMBERED] @ axes).max(initial=0.0))
    for panel in panels:
        names = _draw_room(panel, scene)
        _draw_path(panel, samples, colour)
        _draw_impacts(panel, strikes, colour, drawn, max(fastest, 1e-9))
        _draw_start(panel, samples, colour, drawn, marks, panel is panels[0])
        for name, places in names:
            panel.place(name, places, 0.1 * np.arange(len(places)), fontstyle="italic", color=_INK, gid="surface")
    energy = _axes(figure, page, page.energy)
    spin = _axes(figure, page, page.spin, sharex=energy)
    _draw_times(energy, spin, scene, samples, strikes, 72 * page.energy[2] / max(end - samples.time[0], 1e-9))
    bar = figure.colorbar(colour, cax=_axes(figure, page, page.bar))
    bar.set_label("time (s)", fontsize=9)
    bar.outline.set_linewidth(0.7)  # pyright: ignore
    caption = _caption(scene, view, strikes, drawn / radius, fastest)
    _draw_texts(figure, page, _title(scene, trajectory, strikes, end, title), caption)
    if path is not None:
        _write(figure, path)
    return figure
