"""What a Monte Carlo study found."""

import dataclasses
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from .._math import NAMES_OF_RESULTS, NO_FAILURES
from .._world import Scene
from .measure import Quantity
from .statistics import N_BINS, Estimate, Frame, Sums, means, probability, quantiles

LEVELS = (0.001, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 0.75, 0.9, 0.95, 0.975, 0.99, 0.999)


class Frequency(NamedTuple):
    """How often something happened: out of all throws, with its standard error."""

    what: Any
    count: int
    probability: float
    standard_error: float


def named_failures(counts: Mapping[str, int], n: int) -> str:
    """One line on the failures among `n` throws, by name of `RESULTS`, or nothing."""
    if not counts:
        return ""
    each = ", ".join(f"{name} {count}" for name, count in counts.items())
    return f"{sum(counts.values())} of {n} throws failed ({each}) and are left out of every number"


def warn_of_failures(counts: Mapping[str, int], n: int) -> None:
    line = named_failures(counts, n)
    if line:
        warnings.warn(f"{line}; try narrower distributions, or see RESULTS for what each name means.", stacklevel=3)


@dataclasses.dataclass(frozen=True)
class Ensemble:
    """Means, covariances, quantiles, histograms, itineraries and results of a batch of throws. Values that were not
    there (NaN), and all values of throws that failed, are left out of every number and counted by `present`; all errors
    are standard errors.

    - `history`: an `Estimate` after so many throws, at most 256 of them.
    - `n`: throws that were run. `quantities`: what was measured. `about`: what determines the numbers.
    - `folder`: where chunks and records are, if they were kept.
    """

    scene: Scene | None
    quantities: tuple[Quantity, ...]
    frame: Frame
    sums: Sums
    about: dict[str, Any]
    history: Sequence[Estimate] = ()
    folder: Path | None = None

    @property
    def n(self) -> int:
        return self.sums.throws

    def _index(self, name: str) -> int:
        names = [each.name for each in self.quantities]
        if name not in names:
            raise ValueError(f"Argument `name` must be one of {', '.join(names)}, but got {name!r}.")
        return names.index(name)

    def mean(self, name: str) -> float:
        """Mean of a quantity over the throws in which it is present; the probability of an event."""
        i = self._index(name)
        return self.probability(name)[0] if self.quantities[i].event else float(means(self.frame, self.sums)[0][i])

    def standard_error(self, name: str) -> float:
        """Of the mean. Of an event that never or always happened, by the rule of succession."""
        i = self._index(name)
        if self.quantities[i].event:
            return self.probability(name)[1]
        return float(means(self.frame, self.sums)[1][i])

    def probability(self, name: str) -> tuple[float, float]:
        """Of an event, and its standard error."""
        i = self._index(name)
        if not self.quantities[i].event:
            raise ValueError(f"Argument `name` must name an event, but got {name!r}; try mean({name!r}).")
        present = int(self.sums.present[i, i])
        return probability(round(float(self.sums.first[i, i] + self.frame.shift[i] * present)), present)

    def standard_deviation(self, name: str) -> float:
        i = self._index(name)
        return float(np.sqrt(self.covariance()[i, i]))

    def covariance(self) -> np.ndarray:
        """Between the quantities, in their order, over the throws in which both are present; shape (q, q)."""
        return means(self.frame, self.sums)[2]

    def present(self, name: str) -> int:
        """In how many throws there was such a value."""
        i = self._index(name)
        return int(self.sums.present[i, i])

    def quantile(self, name: str, level: float) -> tuple[float, float]:
        """Quantile of that level in (0, 1), by a t-digest, and its standard error."""
        if not 0 < level < 1:
            raise ValueError(f"Argument `level` must be between 0 and 1, but got {level}; try 0.5.")
        value, error = quantiles(self.sums, [level])
        i = self._index(name)
        return float(value[i, 0]), float(error[i, 0])

    def extremes(self, name: str) -> tuple[tuple[float, int], tuple[float, int]]:
        """Lowest and highest value, each with the number of its throw."""
        i, s = self._index(name), self.sums
        return (float(s.lowest[i]), int(s.lowest_at[i])), (float(s.highest[i]), int(s.highest_at[i]))

    def histogram(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        """Counts, shape (bins + 2,), the first and last of which are below and above, and edges, shape (bins + 1,)."""
        i = self._index(name)
        return self.sums.histogram[i], self.frame.edges[i]

    @property
    def itineraries(self) -> list[Frequency]:
        """The sequences of surfaces hit, names in a tuple, the most frequent first; out of the throws that did not
        fail."""
        surfaces, n = self.about["surfaces"], self.n - sum(each.count for each in self.failures)
        rows = []
        for kind, count in self.sums.itineraries.items():
            rows.append(Frequency(tuple(surfaces[i] for i in kind), count, *probability(count, n)))
        return rows

    @property
    def results(self) -> list[Frequency]:
        """How the motions ended, by name of `RESULTS`."""
        pairs = zip(NAMES_OF_RESULTS, self.sums.results, strict=True)
        return [Frequency(name, int(count), *probability(int(count), self.n)) for name, count in pairs if count]

    @property
    def failures(self) -> list[Frequency]:
        """Those of the results that are failures: their throws are in no number but these."""
        fine = [NAMES_OF_RESULTS[code] for code in NO_FAILURES]
        return [each for each in self.results if each.what not in fine]

    def to_xarray(self) -> Any:
        """An `xarray.Dataset` with the dimensions quantity, level, bin, edge, itinerary and result."""
        import xarray as xr

        mean, error, covariance = means(self.frame, self.sums)
        level, level_error = quantiles(self.sums, LEVELS)
        names = [each.name for each in self.quantities]
        itineraries, q = self.itineraries, ("quantity",)
        data = {
            "mean": (q, mean),
            "standard_error": (q, error),
            "covariance": (("quantity", "other_quantity"), covariance),
            "present": (q, np.diag(self.sums.present).copy()),
            "lowest": (q, self.sums.lowest),
            "highest": (q, self.sums.highest),
            "lowest_throw": (q, self.sums.lowest_at),
            "highest_throw": (q, self.sums.highest_at),
            "quantile": (("quantity", "level"), level),
            "quantile_standard_error": (("quantity", "level"), level_error),
            "histogram": (("quantity", "bin"), self.sums.histogram),
            "edges": (("quantity", "edge"), self.frame.edges),
            "itinerary_count": (("itinerary",), np.array([each.count for each in itineraries], dtype=np.int64)),
            "result_count": (("result",), self.sums.results),
        }
        coordinates = {
            "quantity": names,
            "other_quantity": names,
            "unit": (q, [each.unit for each in self.quantities]),
            "event": (q, [each.event for each in self.quantities]),
            "level": list(LEVELS),
            "bin": np.arange(N_BINS + 2),
            "itinerary": [" ".join(each.what) or "no impact" for each in itineraries],
            "result": list(NAMES_OF_RESULTS),
        }
        attributes = {name: _attribute(value) for name, value in self.about.items()}
        return xr.Dataset(data, coordinates, attributes | {"throws": self.n})

    def save(self, folder: str | Path) -> None:
        """Write `summary.zarr`, which xarray opens, and `itineraries.parquet`."""
        import pyarrow as pa
        from pyarrow import parquet

        from .store import room

        folder = Path(folder)
        rows = self.itineraries
        table = pa.table({
            "itinerary": [" ".join(each.what) for each in rows],
            "count": [each.count for each in rows],
            "probability": [each.probability for each in rows],
            "standard_error": [each.standard_error for each in rows],
        })  # fmt: skip
        with room(folder):
            folder.mkdir(parents=True, exist_ok=True)
            self.to_xarray().to_zarr(folder / "summary.zarr", mode="w", zarr_format=2, consolidated=True)
            parquet.write_table(table, folder / "itineraries.parquet")

    @staticmethod
    def open(folder: str | Path) -> "Ensemble":
        """The study in a folder, whole or not: its chunks are read one by one. Raises `StoreError` where there is none,
        or where it is damaged."""
        from .statistics import Totals
        from .store import Store, StoreError, read_run

        run = read_run(folder)
        store = Store(folder, run)
        frame = store.load_frame()
        if frame is None or not store.has(0):
            raise StoreError(f"{folder}: must hold a chunk, but has none yet; run the study")
        totals, k = Totals(frame), 0
        while store.has(k):
            totals.add(store.load(k))
            k += 1
        quantities = tuple(Quantity(*each) for each in run["quantities"])
        return Ensemble(None, quantities, frame, totals.sums(), run, totals.history, Path(folder))

    def records(self, columns: Sequence[str] | None = None) -> Any:
        """The throws that were kept, read when they are asked for: a `pyarrow.dataset.Dataset`, or with `columns` a
        `pyarrow.Table` of these. Raises `ValueError` where none were kept."""
        from pyarrow import dataset

        if self.folder is None or self.about["records"] is None:
            raise ValueError("There are no records of this study; try monte_carlo(..., out='study', records='all').")
        found = dataset.dataset(self.folder / "records", format="parquet")
        return found if columns is None else found.to_table(columns=list(columns))


def _attribute(value: Any) -> Any:
    import json

    return value if isinstance(value, str | int | float) else json.dumps(value)
