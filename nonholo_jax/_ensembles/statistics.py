"""Sums over throws that add up chunk by chunk as if everything were done at once. NumPy, float64."""

from typing import Any, NamedTuple

import numpy as np

from .._math import NAMES_OF_RESULTS, NO_FAILURES

N_BINS = 64
_SKETCH = 1000  # centroids of a t-digest: the level of a quantile is then good to 1e-3 (test_montecarlo.py)


class Frame(NamedTuple):
    """What sums refer to, found from the first throws: `shift` and `edges` of every quantity."""

    shift: np.ndarray  # (q,), near the mean, so that sums of squares keep their digits
    edges: np.ndarray  # (q, N_BINS + 1), of histograms
    pairs: tuple[tuple[int, int], ...]  # quantities of which there is a histogram in two dimensions
    events: tuple[bool, ...]  # quantities that are true or false: they have no quantiles


class Estimate(NamedTuple):
    """Means of the quantities after so many throws, and their standard errors."""

    throws: int
    mean: np.ndarray
    standard_error: np.ndarray


class Sums(NamedTuple):
    """What is kept of some throws. Values that are not finite count as absent."""

    throws: int
    present: np.ndarray  # (q, q): throws in which both quantities are present
    first: np.ndarray  # (q, q): sum of the first quantity less its shift, where the second is present
    second: np.ndarray  # (q, q): sum of the products
    histogram: np.ndarray  # (q, N_BINS + 2): below, the bins, above
    planes: np.ndarray  # (pairs, N_BINS, N_BINS)
    lowest: np.ndarray  # (q,)
    highest: np.ndarray  # (q,)
    lowest_at: np.ndarray  # (q,): number of the throw
    highest_at: np.ndarray  # (q,)
    results: np.ndarray  # (r,)
    itineraries: dict[tuple[int, ...], int]
    sketches: tuple[bytes, ...]  # (q)


def frame_of(values: np.ndarray, pairs: tuple, events: tuple) -> Frame:
    """The frame for values like these, shape (n, q)."""
    edges, shift = [], []
    for column in values.T:
        some = column[np.isfinite(column)]
        if some.size == 0:
            some = np.zeros(1)
        low, high = float(some.min()), float(some.max())
        wide = 0.25 * (high - low) or 0.5 * max(abs(high), 1.0) * 1e-6
        shift.append(float(some.mean()))
        edges.append(np.linspace(low - wide, high + wide, N_BINS + 1))
    return Frame(np.array(shift), np.array(edges).reshape(-1, N_BINS + 1), pairs, events)


def sums_of(frame: Frame, values: np.ndarray, hits: np.ndarray, results: np.ndarray, start: int) -> Sums:
    """Of throws `start` and following: `values` (n, q), `hits` (n, rows) indices or -1, `results` (n,) codes. What a
    throw hit before it failed is no itinerary."""
    n, q = values.shape
    there = np.isfinite(values)
    mask, moved = there.astype(float), np.where(there, values - frame.shift, 0.0)
    lowest, highest = np.where(there, values, np.inf), np.where(there, values, -np.inf)
    at = [lowest.argmin(axis=0), highest.argmax(axis=0)] if n else [np.zeros(q, int)] * 2
    return Sums(
        n,
        (mask.T @ mask).round().astype(np.int64),
        moved.T @ mask,
        moved.T @ moved,
        np.stack([_histogram(values[:, i], frame.edges[i]) for i in range(q)]) if q else np.zeros((0, N_BINS + 2), int),
        np.stack([_plane(values, frame, pair) for pair in frame.pairs]) if frame.pairs else _no_planes(),
        lowest.min(axis=0, initial=np.inf),
        highest.max(axis=0, initial=-np.inf),
        start + at[0],
        start + at[1],
        np.bincount(results, minlength=len(NAMES_OF_RESULTS)).astype(np.int64),
        _counted(hits[np.isin(results, NO_FAILURES)]),
        tuple(_sketch(values[there[:, i] & (not frame.events[i]), i]) for i in range(q)),
    )


def _no_planes() -> np.ndarray:
    return np.zeros((0, N_BINS, N_BINS), np.int64)


def _bin(column: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """0 below, N_BINS + 1 above; equally wide bins, the last with its upper end."""
    place = (column - edges[0]) * (N_BINS / (edges[-1] - edges[0]))
    inner = np.where(column == edges[-1], N_BINS, np.floor(np.clip(place, -1.0, N_BINS)) + 1)
    return inner.astype(np.int64)


def _histogram(column: np.ndarray, edges: np.ndarray) -> np.ndarray:
    return np.bincount(_bin(column[np.isfinite(column)], edges), minlength=N_BINS + 2).astype(np.int64)


def _plane(values: np.ndarray, frame: Frame, pair: tuple[int, int]) -> np.ndarray:
    x, y = (values[:, i] for i in pair)
    there = np.isfinite(x) & np.isfinite(y)
    i, j = (_bin(column[there], frame.edges[k]) - 1 for column, k in ((x, pair[0]), (y, pair[1])))
    inside = (i >= 0) & (i < N_BINS) & (j >= 0) & (j < N_BINS)
    flat = np.bincount(i[inside] * N_BINS + j[inside], minlength=N_BINS * N_BINS)
    return flat.reshape(N_BINS, N_BINS).astype(np.int64)


def _counted(hits: np.ndarray) -> dict[tuple[int, ...], int]:
    if len(hits) == 0:
        return {}
    rows = hits.shape[1]
    base = int(hits.max(initial=-1)) + 2
    if base**rows >= 2**62:  # too many for one number each
        kinds, counts = np.unique(hits, axis=0, return_counts=True)
    else:
        code = (hits.astype(np.int64) + 1) @ (base ** np.arange(rows, dtype=np.int64))
        codes, counts = np.unique(code, return_counts=True)
        kinds = (codes[:, None] // base ** np.arange(rows, dtype=np.int64)) % base - 1
    return {tuple(int(i) for i in kind if i >= 0): int(c) for kind, c in zip(kinds, counts, strict=True)}


def _sketch(values: np.ndarray) -> bytes:
    from fastdigest import TDigest

    column: Any = np.ascontiguousarray(values, dtype=float)
    return TDigest.from_values(column, max_centroids=_SKETCH).to_bytes()


_HISTORY = 256
_ADDED = ("throws", "present", "first", "second", "histogram", "planes", "results")


class Totals:
    """The sums of consecutive chunks, added in their order, in memory that does not grow with their number."""

    def __init__(self, frame: Frame):
        self.frame, self.fields, self.throws = frame, None, 0
        self.itineraries: dict[tuple[int, ...], int] = {}
        self.sketches: list = []
        self.history: list[Estimate] = []  # thinned out as it grows
        self.every = self.parts = 1

    def add(self, part: Sums) -> None:
        from fastdigest import TDigest

        self.throws += part.throws
        for kind, count in part.itineraries.items():
            self.itineraries[kind] = self.itineraries.get(kind, 0) + count
        if self.fields is None:
            self.fields = part._asdict()
            self.sketches = [TDigest(max_centroids=_SKETCH) for _ in part.sketches]
        else:
            fields = self.fields
            for name in _ADDED:
                fields[name] = fields[name] + getattr(part, name)
            for better, name in (
                (part.lowest < fields["lowest"], "lowest"),
                (part.highest > fields["highest"], "highest"),
            ):
                for each in (name, f"{name}_at"):
                    fields[each] = np.where(better, getattr(part, each), fields[each])
        for sketch, more in zip(self.sketches, part.sketches, strict=True):
            sketch.merge_inplace(TDigest.from_bytes(more))
        if self.parts % self.every == 0:
            self.history.append(Estimate(self.throws, *means(self.frame, self.moments())[:2]))
        self.parts += 1
        if len(self.history) > _HISTORY:
            del self.history[::2]
            self.every *= 2

    def moments(self) -> Sums:
        """What means and errors need, without the rest being brought up to date."""
        assert self.fields is not None
        return Sums(**self.fields)

    def sums(self) -> Sums:
        order = sorted(self.itineraries.items(), key=lambda item: (-item[1], item[0]))
        sketches = tuple(sketch.to_bytes() for sketch in self.sketches)
        return self.moments()._replace(itineraries=dict(order), sketches=sketches)


def means(frame: Frame, sums: Sums) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mean of every quantity where it is present, its standard error, and the covariance matrix; NaN where there are
    too few throws."""
    with np.errstate(all="ignore"):
        count = sums.present.astype(float)
        first = sums.first / count
        mean = frame.shift + np.diag(first)
        covariance = (sums.second / count - first * first.T) * count / (count - 1.0)
        covariance[count < 2] = np.nan
        error = np.sqrt(np.maximum(np.diag(covariance), 0.0) / np.diag(count))
        error[np.isnan(np.diag(covariance))] = np.nan
    return mean, error, covariance


def quantiles(sums: Sums, levels: Any) -> tuple[np.ndarray, np.ndarray]:
    """Quantiles of every quantity, shape (q, levels), and their standard errors: half the distance between those one
    standard error of the level to either side."""
    from fastdigest import TDigest

    found = np.full((2, len(sums.sketches), len(levels)), np.nan)
    for i, data in enumerate(sums.sketches):
        sketch = TDigest.from_bytes(data)
        n = sums.present[i, i]
        if n == 0 or sketch.is_empty():
            continue
        for j, p in enumerate(levels):
            step = np.sqrt(p * (1.0 - p) / n)
            low, high = (sketch.quantile(float(np.clip(p + sign * step, 0.0, 1.0))) for sign in (-1.0, 1.0))
            found[:, i, j] = sketch.quantile(float(p)), 0.5 * (high - low)
    return found[0], found[1]


def probability(count: int, n: int) -> tuple[float, float]:
    """A frequency and its standard error; where all or none count, by the rule of succession, so that it is not 0."""
    if n == 0:
        return float("nan"), float("nan")
    p = count / n
    q = p if 0 < count < n else (count + 1.0) / (n + 2.0)
    return p, float(np.sqrt(q * (1.0 - q) / n))
