"""Batch Monte Carlo: throws drawn, run and measured chunk by chunk, in memory that does not grow with their number."""

import time
import types
from collections.abc import Callable, Mapping, Sequence
from importlib import metadata
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

from .._math import NAMES_OF_RESULTS, WIDEST_VECTORS, by_tiles, over_devices, with_options
from .._motion import AbstractMotion, checked, simulate
from .._world import BallState, Scene
from .ensemble import Ensemble, warn_of_failures
from .measure import AbstractMeasure, ImpactCount, measured, quantities_of, struck
from .sampler import SOBOL_MOST, Sampler, halves, uniforms
from .statistics import Frame, Sums, Totals, frame_of, means, sums_of
from .store import Store

_PILOT = 1024  # throws that choose the edges of histograms
_CHUNKS, _CHUNK = 32, (1024, 16_384)  # at least so many, of sizes between
_POLL = 0.2  # s
_STATE = tuple(f"throw.{name}.{c}" for name in ("position", "velocity", "spin") for c in "xyz")


class _Plan(NamedTuple):
    """What the compiled program of a chunk needs to know; static."""

    sampler: Any  # a function of a key, or None
    measures: tuple
    max_impacts: int
    log_rows: int
    sum_trains: bool
    devices: int


class _Found(NamedTuple):
    """What a chunk gives, an entry for each throw."""

    inputs: Any
    values: Any
    hits: Any
    results: Any


def monte_carlo(
    scene: Scene,
    sampler: Sampler | Callable,
    *,
    n: int,
    key: Any,
    t1: Any,
    t0: Any = 0.0,
    measures: Mapping[str, AbstractMeasure | Callable] | None = None,
    max_impacts: int = 64,
    itinerary_length: int = 8,
    motion: AbstractMotion | None = None,
    accuracy: float | None = None,
    sum_trains: bool = True,
    chunk: int | None = None,
    seconds: float | None = None,
    standard_error: Mapping[str, float] | None = None,
    out: str | Path | None = None,
    resume: bool = False,
    records: str | Sequence[str] | None = None,
    record_where: str | None = None,
    progress: bool = False,
) -> Ensemble:
    """Draw throws, run them and measure them, chunk by chunk.

    **Arguments:**

    - `scene`: a `Scene`. `sampler`: a `Sampler`, or a function of a JAX key that returns a `BallState`, or a pair of a
        `Scene` and a `BallState`. Throw number i depends on `key` and i alone, whatever the size of the chunks and the
        number of devices or processes.
    - `n`: how many throws, >= 1; `key`: a JAX key, or a whole number.
    - `measures`: by name, `Landing`, `Returns`, ... or any function of a `Trajectory`; see `AbstractMeasure`.
        Itineraries and results are always counted. Default: the number of impacts. Throws that failed are left out of
        every number; a `UserWarning` counts them, and `Ensemble.failures` names them.
    - `itinerary_length`: how many impacts of an itinerary count, and how many rows of the log a measure sees.
    - `t1`, `t0`, `max_impacts`, `motion`, `accuracy`, `sum_trains`: as in `simulate`.
    - `chunk`: throws that are in memory at once (default: between 1,024 and 16,384, so that there are some 32 chunks).
    - `seconds`, `standard_error` (by name of a quantity, the one that is wanted): stop earlier, after a whole chunk.
    - `out`: folder that keeps every chunk as soon as it is done; `resume=True` goes on where a run of the same study
        stopped, to the identical result. Several processes (`jax.distributed`) share the chunks of one folder.
    - `records`: names of columns to keep for every throw (inputs, quantities, `"itinerary"`, `"result"`), or `"all"`;
        `record_where`: an event, so that only its throws are kept. Both need `out`.
    - `progress`: a bar on standard error.

    Returns an `Ensemble`. Raises `ValueError` for arguments that cannot be right, `StoreError` (a `ValueError`) for a
    folder that holds something else, is damaged, or is full; what is whole is kept.

    ```python
    from nonholo_jax import Ball, BallState, Landing, Normal, Plane, Rough, Sampler, Scene, Vary, monte_carlo
    scene = Scene(Ball(0.025, 0.046), {"floor": Plane((0, 0, 0), (0, 0, 1), Rough())})
    throw = BallState([0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0])
    sampler = Sampler(throw, [Vary("velocity", Normal(std=0.05))])
    found = monte_carlo(scene, sampler, n=2000, key=0, t1=1.0, measures={"landing": Landing("floor")})
    print(found.mean("landing.x"), found.standard_error("landing.x"), found.itineraries[0])
    ```
    """
    _check_counts(n=n, itinerary_length=itinerary_length, chunk=1 if chunk is None else chunk)
    chunk = min(max(-(-n // (_CHUNKS * _CHUNK[0])) * _CHUNK[0], _CHUNK[0]), _CHUNK[1]) if chunk is None else chunk
    key = jax.random.key(key) if isinstance(key, int) else key
    if accuracy is not None and not isinstance(sampler, Sampler):
        what = f"must come with a Sampler, whose throw it is for, but got {type(sampler).__name__}"
        raise ValueError(f"Argument `accuracy` {what}; try motion=Integrated(rtol=1e-8).")
    wanted = None if accuracy is None else (accuracy, sampler.throw, t0, t1)
    motion, log_rows = checked(scene, motion, max_impacts, min(itinerary_length, max_impacts), sum_trains, wanted)
    measures = {"impacts": ImpactCount()} if measures is None else dict(measures)
    study = _Study(scene, sampler, key, t0, t1, motion, measures, (max_impacts, log_rows, sum_trains), n, chunk)
    study.check_names(standard_error, records, record_where)
    run = study.description(records, record_where)
    store = None if out is None else Store(out, run)
    found = _Runner(study, store, seconds, standard_error, records, record_where, progress).run(resume)
    warn_of_failures({each.what: each.count for each in found.failures}, found.n)
    return found


def _check_counts(**counts: Any) -> None:
    for name, value in counts.items():
        least = 0 if name == "itinerary_length" else 1
        if isinstance(value, bool) or not isinstance(value, int) or value < least:
            raise ValueError(
                f"Argument `{name}` must be a whole number of at least {least}, but got {value!r}; try 1000."
            )


class _Study:
    """What is drawn, run and measured."""

    def __init__(self, scene, sampler, key, t0, t1, motion, measures, how, n, chunk):
        if not (isinstance(sampler, Sampler) or callable(sampler)):
            what = f"must be a Sampler or a function of a key, but got {type(sampler).__name__}"
            raise ValueError(f"Argument `sampler` {what}; try Sampler(throw, [Vary('velocity', Normal(0.1))]).")
        self.scene, self.sampler, self.key, self.motion, self.measures = scene, sampler, key, motion, measures
        self.n, self.chunk = n, chunk
        self.is_table = isinstance(sampler, Sampler)
        self.inputs = sampler.names(scene) if self.is_table else _STATE
        state = sampler.throw if isinstance(sampler, Sampler) else _state_of(jax.eval_shape(lambda k: sampler(k), key))
        self.dtype = state.position.dtype
        self.t0, self.t1 = (jnp.asarray(t, dtype=self.dtype) for t in (t0, t1))
        if not bool(self.t1 >= self.t0):
            raise ValueError(
                f"Argument `t1` must be finite and at least `t0`, but got t1={t1} and t0={t0}; try t1=1.0."
            )
        if self.is_table and sampler.sequence != "random" and n > SOBOL_MOST:
            what = f"must be at most {SOBOL_MOST} with a Sobol sequence, but got {n}"
            raise ValueError(f"Argument `n` {what}; try sequence='random'.")
        self.devices = len(jax.local_devices())
        function = None if self.is_table else sampler
        self.plan = _Plan(function, tuple(measures.values()), how[0], how[1], how[2], self.devices)
        self.quantities, self.pairs = quantities_of(measures, jax.eval_shape(lambda: self._measured_once()))

    def _measured_once(self) -> list:
        u = jnp.full(self.sampler.n_uniform(self.scene), 0.5, self.dtype) if self.is_table else None
        _, scene, state = _drawn(self.scene, self.sampler, self.key, u)
        options = {"max_impacts": self.plan.max_impacts, "log_size": self.plan.log_rows, "motion": self.motion}
        trajectory = simulate(scene, state, t0=float(self.t0), t1=float(self.t1), throw=False, **options)
        return [jnp.asarray(measure(trajectory)) for measure in self.measures.values()]

    def check_names(self, standard_error: Any, records: Any, where: Any) -> None:
        names = [each.name for each in self.quantities]
        events = [each.name for each in self.quantities if each.event]
        columns = [*self.inputs, *names, "itinerary", "result"]
        listed = [] if records is None or records == "all" else [records] if isinstance(records, str) else list(records)
        for what, given, known in (
            ("standard_error", list(standard_error or ()), names),
            ("records", listed, columns),
            ("record_where", [] if where is None else [where], events),
        ):
            for name in given:
                if name not in known:
                    there = ", ".join(known) or "no event"
                    raise ValueError(f"Argument `{what}` must name one of {there}, but got {name!r}.")
        for name, value in (standard_error or {}).items():
            if not (isinstance(value, float | int) and value > 0):
                raise ValueError(
                    f"Argument `standard_error` must be positive for {name!r}, but got {value!r}; try 1e-3."
                )

    def description(self, records: Any, where: str | None) -> dict[str, Any]:
        """What determines the numbers, for the folder."""
        versions = {name: metadata.version(name) for name in ("nonholo_jax", "jax", "diffrax", "numpy")}
        return {
            "n": self.n,
            "chunk": self.chunk,
            "key": [str(jax.random.key_impl(self.key)), np.asarray(jax.random.key_data(self.key)).tolist()],
            "scene": _spelled(self.scene),
            "sampler": _spelled(self.sampler),
            "motion": _spelled(self.motion),
            "measures": {name: _spelled(measure) for name, measure in self.measures.items()},
            "t0": float(self.t0),
            "t1": float(self.t1),
            "dtype": str(self.dtype),
            "how": list(self.plan[2:5]),
            "inputs": list(self.inputs),
            "sequence": self.sampler.sequence if self.is_table else "random",
            "sources": list(self.sampler.sources(self.scene)) if self.is_table else [],
            "surfaces": list(self.scene.names),
            "quantities": [list(each) for each in self.quantities],
            "failures": "left out",
            "records": None if records is None else "all" if records == "all" else _as_list(records),
            "record_where": where,
            "versions": versions,
        }

    def found(self, start: int, count: int) -> _Found:
        """Throws `start` to `start + count`, computed by the same program as any other chunk."""
        tile = self.motion.tile * self.devices
        padded = -(-max(self.chunk, count) // tile) * tile
        index = start + np.minimum(np.arange(padded, dtype=np.int64), count - 1)
        if self.is_table and self.sampler.sequence != "random":
            seed = np.asarray(jax.random.key_data(self.key)).ravel().tolist()
            u = self.sampler.chosen(self.scene, seed, start, count)
            lanes: Any = np.concatenate([u, np.repeat(u[-1:], padded - count, axis=0)])
        else:
            lanes = halves(index)
        table = self.sampler if self.is_table else None
        out = _run_chunk(self.plan, self.scene, table, self.key, self.motion, self.t0, self.t1, lanes)
        return jax.tree.map(lambda x: x[:count], out)


def _as_list(names: str | Sequence[str]) -> list[str]:
    return [names] if isinstance(names, str) else list(names)


def _state_of(drawn: Any) -> BallState:
    return drawn if isinstance(drawn, BallState) else drawn[1]


def _spelled(thing: Any) -> str:
    """A pytree with its numbers, or a function with its code, as text that stays the same from run to run."""
    if isinstance(thing, eqx.Module):
        leaves, treedef = jax.tree.flatten(thing)
        numbers = [np.asarray(leaf).tolist() if eqx.is_array(leaf) else repr(leaf) for leaf in leaves]
        return f"{type(thing).__name__} {eqx.tree_pformat(thing, short_arrays=True)} {numbers} {_static(treedef)}"
    code = getattr(thing, "__code__", None)
    name = f"{getattr(thing, '__module__', '')}.{getattr(thing, '__qualname__', type(thing).__name__)}"
    if code is None:
        return f"{name} {_static(repr(thing))}"
    cells = [_spelled(cell.cell_contents) for cell in thing.__closure__ or ()]
    return f"{name} {_code(code)} {cells}"


def _code(code: types.CodeType) -> str:
    constants = [_code(x) if isinstance(x, types.CodeType) else repr(x) for x in code.co_consts]
    return f"{code.co_code.hex()} {code.co_names} {constants}"


def _static(treedef: Any) -> str:
    text = str(treedef)
    return text if " at 0x" not in text else ""  # addresses differ from run to run


def _drawn(scene: Scene, sampler: Any, key: Any, u: Any) -> tuple[Any, Scene, BallState]:
    """The numbers that vary, and scene and throw with them."""
    if u is not None:
        values = sampler.values(scene, u)
        return values, *sampler.applied(scene, values)
    drawn = sampler(key)
    state = _state_of(drawn)
    own = scene if isinstance(drawn, BallState) else drawn[0]
    return jnp.concatenate([state.position, state.velocity, state.spin]), own, state


def _chunk_of(plan: _Plan, scene, sampler, key, motion, t0, t1, lanes) -> _Found:
    options = {"max_impacts": plan.max_impacts, "log_size": plan.log_rows, "sum_trains": plan.sum_trains}

    def one(rest, lane):
        scene, sampler, key, motion, t0, t1 = rest
        if plan.sampler is not None:
            own = jax.random.fold_in(jax.random.fold_in(key, lane[0]), lane[1])
            inputs, room, state = _drawn(scene, plan.sampler, own, None)
        else:
            u = lane
            if isinstance(lane, tuple):
                u = uniforms(key, lane, (sampler.n_uniform(scene),), sampler.throw.position.dtype)
            inputs, room, state = _drawn(scene, sampler, key, u)
        trajectory = simulate(room, state, t0=t0, t1=t1, motion=motion, throw=False, **options)
        values = measured(plan.measures, trajectory)
        code = jnp.asarray(trajectory.result._value, dtype=jnp.int32)
        log = trajectory.impacts
        hits = jnp.where(struck(log), log.surface, -1).astype(jnp.int16)
        return _Found(inputs, values, hits, code)

    arrays, constants = eqx.partition((scene, sampler, key, motion, t0, t1), eqx.is_array)

    def batch(lanes, arrays):
        whole = lambda lanes: jax.vmap(lambda lane: one(eqx.combine(arrays, constants), lane))(lanes)  # noqa: E731
        count = jax.tree.leaves(lanes)[0].shape[0]
        return by_tiles(whole, lanes, count, motion.tile) if plan.log_rows else whole(lanes)

    return over_devices(batch, lanes, arrays, plan.devices)


_run_chunk = with_options(_chunk_of, WIDEST_VECTORS)


class _Runner:
    """The loop over chunks."""

    def __init__(self, study: _Study, store, seconds, standard_error, records, where, progress: bool):
        self.study, self.store, self.seconds, self.wanted = study, store, seconds, dict(standard_error or {})
        self.records, self.where, self.progress = records, where, progress
        if records is not None and store is None:
            raise ValueError("Argument `records` must come with `out`, the folder to write them to; try out='study'.")
        if where is not None and records is None:
            raise ValueError("Argument `record_where` must come with `records`; try records='all'.")
        if store is None and jax.process_count() > 1:
            raise ValueError("Argument `out` must be given where several processes share a study; try out='study'.")
        self.n_chunks = -(-study.n // study.chunk)
        self.began = time.monotonic()
        self.reached = 0  # chunks that are in the totals, which take them in their order
        self.held: Sums | None = None
        self.ahead: dict[int, _Found] = {}  # chunks that were computed for the frame

    def run(self, resume: bool) -> Ensemble:
        if self.store is not None:
            self.store.begin(resume or jax.process_count() > 1)
        self.frame = self._frame()
        self.totals = Totals(self.frame)
        with self._bar() as bar:
            self._advance(bar)
            own = iter(k for k in range(self.n_chunks) if k % jax.process_count() == jax.process_index())
            todo = (k for k in own if not self._has(k))
            k = next(todo, None)
            found = None if k is None or self._is_over() else self._launch(k)
            while found is not None and k is not None:
                following = next(todo, None)
                ahead = None if following is None else self._launch(following)  # while this one is summed
                self._reduce(k, found)
                self._advance(bar)
                k, found = following, None if self._is_over() else ahead
            while self.reached < self.n_chunks and not self._is_over() and jax.process_count() > 1:
                time.sleep(_POLL)  # for the chunks of others
                self._advance(bar)
        about = {**self.study.description(self.records, self.where), "throws": self.totals.throws}
        folder = None if self.store is None else self.store.folder
        parts = (self.frame, self.totals.sums(), about, self.totals.history, folder)
        ensemble = Ensemble(self.study.scene, tuple(self.study.quantities), *parts)
        if folder is not None and jax.process_index() == 0:
            ensemble.save(folder)
        return ensemble

    def _frame(self) -> Frame:
        """From the first throws, whatever the chunks."""
        found = None if self.store is None else self.store.load_frame()
        if found is not None:
            return found
        count = min(_PILOT, self.study.n)
        self.ahead = {k: self._launch(k) for k in range(-(-count // self.study.chunk))}
        values = np.concatenate([np.asarray(part.values, dtype=float) for part in self.ahead.values()])[:count]
        frame = frame_of(values, self.study.pairs, tuple(each.event for each in self.study.quantities))
        if self.store is not None:
            self.store.save_frame(frame)
        return frame

    def _has(self, k: int) -> bool:
        return self.store is not None and self.store.has(k)

    def _launch(self, k: int) -> _Found:
        """Begin to compute a chunk; JAX returns before it is done."""
        if k in self.ahead:
            return self.ahead.pop(k)
        start = k * self.study.chunk
        return self.study.found(start, min(self.study.chunk, self.study.n - start))

    def _reduce(self, k: int, found: _Found) -> None:
        inputs, values, hits, results = (np.asarray(x) for x in found)
        start = k * self.study.chunk
        sums = sums_of(self.frame, values.astype(float), hits, results, start)
        if self.store is not None:
            self.store.save(k, sums, self._table(start, inputs, values, hits, results))
        self.held = sums if k == self.reached else None

    def _table(self, start: int, inputs, values, hits, results) -> Any:
        """The records that are kept of a chunk."""
        if self.records is None:
            return None
        import pyarrow as pa

        names = [each.name for each in self.study.quantities]
        keep = slice(None) if self.where is None else values[:, names.index(self.where)] == 1
        columns: dict[str, Any] = {"throw": np.arange(start, start + len(values), dtype=np.int64)[keep]}
        columns |= {name: inputs[keep, i] for i, name in enumerate(self.study.inputs)}
        for i, each in enumerate(self.study.quantities):
            column = values[keep, i]
            columns[each.name] = pa.array(column == 1, mask=np.isnan(column)) if each.event else column
        surfaces = np.array([*self.study.scene.names, ""], dtype=object)
        columns["itinerary"] = [" ".join(surfaces[row[row >= 0]]) for row in hits[keep]]
        columns["result"] = np.array(NAMES_OF_RESULTS, dtype=object)[results[keep]]
        wanted = None if self.records == "all" else {"throw", *_as_list(self.records)}
        return pa.table({name: column for name, column in columns.items() if wanted is None or name in wanted})

    def _advance(self, bar: Any) -> None:
        """Take up the chunks that are there, in their order."""
        while self.reached < self.n_chunks and not self._is_enough():
            part = self.held
            if part is None:
                if not self._has(self.reached):
                    return
                assert self.store is not None
                part = self.store.load(self.reached)
            self.held = None
            self.totals.add(part)
            self.reached += 1
            bar.update(part.throws)
            if self.study.quantities:
                mean, error, _ = means(self.frame, self.totals.moments())
                bar.set_postfix_str(f"{self.study.quantities[0].name} {mean[0]:.6g} +- {error[0]:.1g}")

    def _is_enough(self) -> bool:
        """Whether the standard errors that are wanted are reached."""
        if not self.wanted or self.reached == 0:
            return False
        _, error, _ = means(self.frame, self.totals.moments())
        names = [each.name for each in self.study.quantities]
        return all(error[names.index(name)] <= value for name, value in self.wanted.items())

    def _is_over(self) -> bool:
        late = self.seconds is not None and self.reached > 0 and time.monotonic() - self.began >= self.seconds
        return late or self._is_enough()

    def _bar(self) -> Any:
        return tqdm(total=self.study.n, unit=" throws", disable=not self.progress, smoothing=0.1)
