"""What rates of a benchmark say: where a ladder of batch sizes ends, how devices compare, when one of them pays."""

from collections.abc import Callable, Sequence
from typing import Any, Literal, NamedTuple

GRADIENT = "reverse gradient of the mean squared final position in the initial state"
FLAT, STEP = 1.2, 10  # a ladder ends where STEP times the throws give less than FLAT times the rate,
SHORTEST = 1e-3  # s, where a run takes as long: before, it is the launch that is measured,
LONGEST = 2.0  # s, or where a run takes longer
_REASONS = (
    f"sizes end where {STEP} times the throws give less than {FLAT} times the rate (flat), where a run takes over "
    f"{LONGEST:g} s (time), where more would not fit (memory), or at the most that were asked for (most)"
)


class Rung(NamedTuple):
    """A batch size that was run: seconds of one run, bytes that it takes where that is known, how many devices share
    it."""

    throws: int
    seconds: float
    bytes: int | None
    devices: int = 1


def climb(run: Callable[[int], Rung | None], most: int, room: int | None) -> tuple[list[Rung], str]:
    """Run 1, 10, 100, ... throws until the rate is flat, or a run takes too long, or more would not fit.

    **Arguments:** `run(throws)` gives a `Rung`, or `None` where the memory did not suffice; `most` throws, >= 1;
    `room` in bytes, `None` where it is not known.

    Returns the rungs and why there are no more: flat, most, time or memory.
    """
    found: list[Rung] = []
    while True:
        rung = run(STEP ** len(found))
        if rung is None:
            return found, "memory"
        found.append(rung)
        rates = [each.throws / each.seconds for each in found]
        # A batch that is the first to be shared by all devices takes longer to launch.
        alike = len(found) > 1 and rung.seconds >= SHORTEST and rung.devices == found[-2].devices
        if alike and rates[-1] < FLAT * rates[-2]:
            return found, "flat"
        if rung.seconds > LONGEST:
            return found, "time"
        if STEP * rung.throws > most:
            return found, "most"
        if rung.bytes is not None and room is not None and STEP * rung.bytes > room:
            return found, "memory"


class Rate(NamedTuple):
    """One batch size of one scene, on the devices of one kind, in one dtype.

    - `scene`; `device`: kind of platform, such as cpu or gpu; `devices`: how many of them share the batch; `dtype`;
        `job`: value or gradient; `throws`: size of the batch.
    - `trace_seconds`, `lower_seconds`, `compile_seconds`: before the first run, `first_seconds`: of that run.
    - `run_seconds`: of a run after the first, the median of several that take turns with all other rows of the scene;
        `spread`: half of the middle half of these runs, relative to the median.
    - `bounces`: impacts in a run, as `simulate_batch` counts them; `failed`: throws that came neither
        to `t1` nor to rest, those stopped by `max_impacts` included.
    - `program_bytes`: arguments, results and intermediates of the compiled program, all devices together;
        `peak_bytes`: the most that was in use on one of the devices, where no earlier program had needed more. Either
        is `None` where JAX does not say.
    - `stopped`: why there is no larger batch (flat, most, time, memory); empty where there is one.
    """

    scene: str
    device: str
    devices: int
    dtype: str
    job: str
    throws: int
    trace_seconds: float
    lower_seconds: float
    compile_seconds: float
    first_seconds: float
    run_seconds: float
    spread: float
    bounces: int
    failed: int
    program_bytes: int | None
    peak_bytes: int | None
    stopped: str

    @property
    def setup_seconds(self) -> float:
        """Trace, lower and compile: what comes before the first run."""
        return self.trace_seconds + self.lower_seconds + self.compile_seconds

    @property
    def first_answer_seconds(self) -> float:
        """From the call to the first answer."""
        return self.setup_seconds + self.first_seconds

    @property
    def throws_per_second(self) -> float:
        return self.throws / self.run_seconds

    @property
    def bounces_per_second(self) -> float:
        return self.bounces / self.run_seconds


class Pays(NamedTuple):
    """For how many throws an accelerator is faster, its compilation included: `when` is always, never, from (for more
    than `throws`) or up to (for fewer)."""

    when: Literal["always", "never", "from", "up to"]
    throws: float | None = None

    @property
    def words(self) -> str:
        if self.throws is None:
            return f"{self.when} pays"
        return f"pays {self.when} {self.throws:.2g} throws"


def crossover(setup: float, rate: float, setup_there: float, rate_there: float) -> Pays:
    """Where setup + n / rate, in s, is the same here and there.

    **Arguments:** seconds before the first run and throws/s, of the CPU and of the accelerator; rates > 0.

    Returns for which numbers of throws the accelerator takes less time: a `Pays`.
    """
    later, each = setup_there - setup, 1.0 / rate - 1.0 / rate_there  # lost before the first throw, won by each
    if later <= 0.0 and each >= 0.0:
        return Pays("always" if later < 0.0 or each > 0.0 else "never")
    if later >= 0.0 and each <= 0.0:
        return Pays("never")
    return Pays("from" if each > 0.0 else "up to", later / each)


class Best(NamedTuple):
    """The row with the most throws/s of a scene, device, dtype and job; why its ladder ended; for accelerators, how
    many times the rate of the CPU it is, and for how many throws it pays (`None` where no CPU was measured)."""

    row: Rate
    stopped: str
    over_cpu: float | None
    pays: Pays | None


def summary(rows: Sequence[Rate]) -> list[Best]:
    """The best of each ladder, in the order of the rows. On both sides of a comparison count the rate of the best batch
    size, and what its program takes before the first run."""
    ladders: dict[tuple, list[Rate]] = {}
    for row in rows:
        ladders.setdefault((row.scene, row.dtype, row.job, row.device), []).append(row)
    best = {key: max(ladder, key=lambda row: row.throws_per_second) for key, ladder in ladders.items()}
    found = []
    for key, row in best.items():
        cpu, over, pays = best.get((*key[:3], "cpu")), None, None
        if cpu is not None and row.device != "cpu":
            over = row.throws_per_second / cpu.throws_per_second
            pays = crossover(cpu.setup_seconds, cpu.throws_per_second, row.setup_seconds, row.throws_per_second)
        stopped = next((each.stopped for each in ladders[key] if each.stopped), "")
        found.append(Best(row, stopped, over, pays))
    return found


class Bench(NamedTuple):
    """What `bench` found.

    - `rows`: a `Rate` for each scene, device, dtype, job and batch size.
    - `scenes`: by name, what was run: `t0`, `t1` in s, `max_impacts`, `motion`, `throws` (how they were drawn).
    - `machine`: devices and versions. `cached`: whether JAX may have read programs from its cache on disk, which makes
        `compile_seconds` too short.
    """

    rows: tuple[Rate, ...]
    scenes: dict[str, dict[str, Any]]
    machine: str
    cached: bool

    def summary(self) -> list[Best]:
        """The best of each ladder, against the CPU."""
        return summary(self.rows)

    def table(self) -> list[str]:
        """For people."""
        lines = [self.machine, f"gradient: {GRADIENT}", _REASONS]
        if self.cached:
            lines.append("JAX's cache on disk is on: compile times may be those of reading from it")
        for scene, how in self.scenes.items():
            about = f"t = {how['t0']:g} to {how['t1']:g} s, at most {how['max_impacts']} impacts, {how['motion']}"
            lines += ["", f"{scene}: {about}", f"  {how['throws']}", *_HEAD]
            lines += [_line(row) for row in self.rows if row.scene == scene]
            lines += [
                "",
                "  the best size of each",
                f"  {'device':8} {'dtype':8} {'job':8} {'throws/s':>9} {'at':>9}  ended",
            ]
            lines += [_sentence(best) for best in self.summary() if best.row.scene == scene]
        return lines

    def report(self) -> dict[str, Any]:
        """All of it in words and numbers that JSON knows; what is not known is `None`."""
        also = ("setup_seconds", "first_answer_seconds", "throws_per_second", "bounces_per_second")
        rows = [row._asdict() | {name: getattr(row, name) for name in also} for row in self.rows]
        best = []
        for row, stopped, over, pays in self.summary():
            which = {name: getattr(row, name) for name in ("scene", "device", "devices", "dtype", "job", "throws")}
            rate = {"throws_per_second": row.throws_per_second, "setup_seconds": row.setup_seconds}
            against = {"over_cpu": over, "pays": None if pays is None else pays._asdict()}
            best.append({**which, **rate, "stopped": stopped, **against})
        about = {"machine": self.machine, "cached": self.cached, "gradient": GRADIENT, "scenes": self.scenes}
        return {**about, "rows": rows, "best": best}


_HEAD = (
    f"  {'':8} {'':8} {'':8} {'':>9} {'':>9} {'':>9} {'':>5}  {'s to the first answer':^39}  {'MB':>9} {'MB':>9}",
    f"  {'device':8} {'dtype':8} {'job':8} {'throws':>9} {'throws/s':>9} {'bounces/s':>9} {'+- %':>5}"
    f"  {'trace':>6} {'lower':>6} {'compile':>7} {'run':>8} {'all':>8}  {'program':>9} {'peak':>9}",
)


def _device(row: Rate) -> str:
    return f"{row.device} x{row.devices}" if row.devices > 1 else row.device


def _line(row: Rate) -> str:
    memory = [f"{each / 1e6:9.3g}" if each is not None else f"{'-':>9}" for each in (row.program_bytes, row.peak_bytes)]
    words = (
        f"  {_device(row):8} {row.dtype:8} {row.job:8} {row.throws:9d} {row.throws_per_second:9.3g} "
        f"{row.bounces_per_second:9.3g} {100 * row.spread:5.1f}  {row.trace_seconds:6.2f} {row.lower_seconds:6.2f} "
        f"{row.compile_seconds:7.2f} {row.first_seconds:8.2g} {row.first_answer_seconds:8.2f}  {' '.join(memory)}"
    )
    return words + (f"  {row.failed} throws failed" if row.failed else "")


def _sentence(best: Best) -> str:
    row = best.row
    which = f"{_device(row):8} {row.dtype:8} {row.job:8}"
    words = f"  {which} {row.throws_per_second:9.3g} {row.throws:9d}  {best.stopped}"
    if best.over_cpu is None or best.pays is None:
        return words
    return f"{words}; {best.over_cpu:.3g} times the cpu's rate, {best.pays.words}"
