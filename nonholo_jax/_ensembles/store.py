"""A folder that holds a Monte Carlo study: what it is, and its chunks, each wholly there or not at all."""

import contextlib
import hashlib
import io
import json
import os
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from .statistics import Frame, Sums

_FORMAT = 1
_ARRAYS = (
    "present",
    "first",
    "second",
    "histogram",
    "planes",
    "lowest",
    "highest",
    "lowest_at",
    "highest_at",
    "results",
)


class StoreError(ValueError):
    """A folder cannot be used for a study, or not any more; the message is one line that says what to do."""


def fingerprint(run: dict[str, Any]) -> str:
    """Of what determines the numbers of a study."""
    text = json.dumps({name: value for name, value in run.items() if name != "versions"}, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()


class Store:
    """The folder of one study."""

    def __init__(self, folder: str | Path, run: dict[str, Any]):
        self.folder, self.run, self.mark = Path(folder), run, fingerprint(run)

    @property
    def chunks(self) -> Path:
        return self.folder / "chunks"

    @property
    def records(self) -> Path:
        return self.folder / "records"

    def begin(self, resume: bool) -> None:
        """Make the folder, or take up what is there. Raises `StoreError` for a folder that holds something else."""
        described = self.folder / "run.json"
        with room(self.folder):
            if self.folder.exists() and not self.folder.is_dir():
                raise StoreError(f"{self.folder}: must be a folder, but is a file; choose another")
            if described.exists():
                self._check(described, resume)
            elif self.chunks.exists():
                raise StoreError(f"{described}: must be there beside chunks/, but is missing; choose another folder")
            self.chunks.mkdir(parents=True, exist_ok=True)
            if self.run["records"] is not None:
                self.records.mkdir(exist_ok=True)
            if not described.exists():
                _write(described, (json.dumps({"format": _FORMAT, **self.run}, indent=1) + "\n").encode())

    def _check(self, described: Path, resume: bool) -> None:
        there = read_run(self.folder)
        if fingerprint(there) != self.mark:
            differ = sorted(k for k in {*there, *self.run} - {"versions"} if there.get(k) != self.run.get(k))
            what = f"{self.folder}: must be empty or hold this study, but holds another, which differs in"
            raise StoreError(f"{what} {', '.join(differ)}; choose another folder, or the same arguments")
        if not resume:
            what = f"{self.folder}: must be empty, but holds this study already"
            raise StoreError(f"{what}; resume it (resume=True, --resume), or choose another folder")

    def has(self, k: int) -> bool:
        return self._path(k).exists()

    def _path(self, k: int) -> Path:
        return self.chunks / f"{k:08d}.npz"

    def save(self, k: int, sums: Sums, table: Any) -> None:
        """One chunk. Its records come first: it counts once its sums are there."""
        with room(self.folder):
            if table is not None:
                from pyarrow import parquet

                buffer = io.BytesIO()
                parquet.write_table(table, buffer)
                _write(self.records / f"{k:08d}.parquet", buffer.getvalue())
            buffer = io.BytesIO()
            arrays: dict[str, Any] = {name: getattr(sums, name) for name in _ARRAYS}
            small = {"mark": self.mark, "throws": sums.throws, "itineraries": list(sums.itineraries.items())}
            arrays["small"] = np.frombuffer(json.dumps(small).encode(), np.uint8)
            arrays |= {f"sketch{i}": np.frombuffer(data, np.uint8) for i, data in enumerate(sums.sketches)}
            np.savez(buffer, **arrays)
            _write(self._path(k), buffer.getvalue())

    def load(self, k: int) -> Sums:
        path = self._path(k)
        try:
            with np.load(io.BytesIO(path.read_bytes())) as file:
                arrays = {name: file[name] for name in file.files}
            small = json.loads(arrays["small"].tobytes())
            sketches = tuple(arrays[f"sketch{i}"].tobytes() for i in range(len(arrays["lowest"])))
            found = {name: arrays[name] for name in _ARRAYS}
        except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
            raise StoreError(f"{path}: must be a whole chunk, but is damaged ({error}); remove it and resume") from None
        if small["mark"] != self.mark:
            raise StoreError(f"{path}: must belong to this study, but is of another; remove it and resume")
        itineraries = {tuple(kind): count for kind, count in small["itineraries"]}
        return Sums(throws=small["throws"], itineraries=itineraries, sketches=sketches, **found)

    def save_frame(self, frame: Frame) -> None:
        buffer = io.BytesIO()
        pairs = np.array(frame.pairs, dtype=np.int64).reshape(-1, 2)
        np.savez(buffer, shift=frame.shift, edges=frame.edges, pairs=pairs, events=np.array(frame.events, dtype=bool))
        with room(self.folder):
            _write(self.folder / "frame.npz", buffer.getvalue())

    def load_frame(self) -> Frame | None:
        path = self.folder / "frame.npz"
        if not path.exists():
            return None
        try:
            with np.load(io.BytesIO(path.read_bytes())) as file:
                pairs = tuple((int(i), int(j)) for i, j in file["pairs"])
                return Frame(file["shift"], file["edges"], pairs, tuple(bool(x) for x in file["events"]))
        except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
            raise StoreError(f"{path}: must be whole, but is damaged ({error}); remove it and resume") from None


def read_run(folder: str | Path) -> dict[str, Any]:
    """What the study in a folder is. Raises `StoreError` where there is none."""
    path = Path(folder) / "run.json"
    try:
        run = json.loads(path.read_text(encoding="utf-8"))
        version = run.pop("format")
    except FileNotFoundError:
        raise StoreError(f"{folder}: must hold a study, but has no run.json; check the folder") from None
    except (OSError, ValueError, KeyError, AttributeError) as error:
        raise StoreError(
            f"{path}: must describe a study, but is damaged ({error}); start anew in another folder"
        ) from None
    if version != _FORMAT:
        raise StoreError(f"{path}: must have format {_FORMAT}, but has {version}; update the package")
    return run


def _write(path: Path, data: bytes) -> None:
    """The whole file or none of it, whatever happens."""
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        with part.open("wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        part.replace(path)
    except BaseException:
        with contextlib.suppress(OSError):
            part.unlink(missing_ok=True)
        raise
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)


@contextlib.contextmanager
def room(folder: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        reason = error.strerror or error
        what = f"{folder}: must be a folder with room, but got {reason}"
        raise StoreError(f"{what}; what is whole is kept: make room and resume") from None
