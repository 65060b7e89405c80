"""The extremes that are no single throw: a million bounces, motions run back, and lanes that hold no numbers."""

from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from extremes_throws import OK, SLABS, Cell, Throw, nearest, run_slab, slab_outputs, slab_scene, slab_state, with_slopes
from extremes_truth import exact, slab_long, slopes, spread, values

from nonholo_jax import BallState, Rough, simulate
from nonholo_jax._math.types import NAMES_OF_RESULTS

MILLION = 1_000_000
_PER_IMPACT = 2.0  # roundings; they may all have one sign, as the law is the same number at every impact
ELASTIC = Rough()  # a constant of the program: the ball bounces for ever
Cells = list[tuple]

# Bounces under gravity, one in about a second, and between two walls, one in about a microsecond. The narrow walls hold
# a ball of 0.1 m, and one as small as their distance.
_FLOOR = {"z": 0.3, "vz": 4.5, "gx": 0.0, "ceiling": 10.0}
_NARROW = {"z": 0.1 + 3e-7, "vz": -1.0, "gx": 0.0, "gz": 0.0, "ceiling": 0.2 + 1e-6, "t1": 1.0}
_SMALL = {**_NARROW, "radius": 1e-6, "z": 1.3e-6, "ceiling": 3e-6, "x": 1e-6, "spin": 1e6}
LONG = (
    Throw("1e6 bounces in 1e6 s", {**_FLOOR, "t1": 1e6}),
    Throw("1e6 bounces, walls 1e-6 m apart", _NARROW),
    Throw("the same, ball of 1e-6 m", _SMALL),
)


def _of_long(p: Any) -> tuple:
    return run_slab(p, ELASTIC, 2 * MILLION)


def _along(p: Any, direction: Any) -> Any:
    """The derivative along one direction, by differentiating the loop itself: forward mode needs no record of it."""
    value = lambda p: run_slab(p, ELASTIC, 2 * MILLION, adjoint=diffrax.ForwardMode())[0]  # noqa: E731
    return jax.jvp(value, (p,), (direction * p,))[1]


def million(dtype: Any) -> Cells:
    """After a million impacts: where it is and how that depends on a change of all inputs together, against powers of
    one linear map; what has become of the energy and the angular momentum."""
    eps = float(np.finfo(dtype).eps)
    lanes = np.stack([SLABS.lane(throw, dtype) for throw in LONG])
    signs = np.random.default_rng(1).choice([-1.0, 1.0], lanes.shape[1]).astype(dtype)
    found, (codes, counts) = jax.tree.map(np.asarray, jax.jit(jax.vmap(_of_long))(jnp.asarray(lanes)))
    slope = np.asarray(jax.jit(jax.vmap(_along, in_axes=(0, None)))(jnp.asarray(lanes), jnp.asarray(signs)))
    cells = []
    for i, throw in enumerate(LONG):
        p, (_, outputs), name = exact(lanes[i]), SLABS.units(lanes[i]), NAMES_OF_RESULTS[codes[i]]
        names = () if name in OK else (name,)
        # Every impact may round the slip by as much: a constant of the law does so in the same way each time.
        each = _PER_IMPACT * eps * int(counts[i])
        value_of = lambda q: values(slab_long, q)  # noqa: E731

        def slope_of(q, p=p):
            model = lambda t: slab_long([x + t[0] * float(s) * y for x, s, y in zip(q, signs, p, strict=True)])  # noqa: E731
            return slopes(model, [0 * q[0]], [1.0])[:, 0]

        truth, rate = value_of(p), slope_of(p)
        outputs = np.maximum(outputs, np.abs(truth))  # it goes a million metres
        allowed = spread(value_of, p, eps, truth) / outputs + each
        cells.append((throw.row, Cell(*nearest(np.abs(found[i] - truth) / outputs, allowed), names),
                      _slope_cell(slope[i], rate, spread(slope_of, p, eps, rate), outputs, each, names)))  # fmt: skip
        cells += _kept(throw.row, lanes[i].astype(float), found[i].astype(float), each, names)
    return cells


def _slope_cell(found: Any, truth: Any, far: Any, outputs: Any, each: float, names: tuple) -> Cell:
    size = np.maximum(np.abs(truth), outputs)
    return Cell(*nearest(np.abs(found.astype(float) - truth) / size, far / size + each), names)


def _kept(row: str, p: np.ndarray, end: np.ndarray, each: float, names: tuple) -> Cells:
    """Energy, and on one floor the angular momentum about the contact, which no impact changes."""
    alpha, r, gz = p[5], p[7], p[11]
    start = p[:5]

    def energy(y):
        return 0.5 * (y[2] ** 2 + y[3] ** 2 + alpha * (r * y[4]) ** 2) - gz * y[1]

    momentum = lambda y: y[2] + alpha * r * y[4]  # noqa: E731
    rows = [(f"{row}: energy", Cell(abs(energy(end) / energy(start) - 1.0), each, names), None)]
    if gz != 0:
        drift = abs(momentum(end) / momentum(start) - 1.0)
        rows.append((f"{row}: angular momentum", Cell(drift, each, names), None))
    return rows


# Reversal

REVERSED = tuple(
    Throw(f"run back after {n} bounces", {**numbers, "t1": (n + 0.4) * period})
    for n in (10, 100, 1000)
    for numbers, period in ((_FLOOR, 1.036), ({**_FLOOR, "vz": -2.1, "gz": 0.0, "ceiling": 1.2}, 1.0 / 2.1))
)  # fmt: skip


def there_and_back(p: Any) -> tuple:
    """Run, turn the velocities round, run as long again, turn them round again."""
    scene, options = slab_scene(p, ELASTIC), {"t1": p[14], "max_impacts": 1100, "log_size": 0, "throw": False}
    turned = lambda s: BallState(s.position, -s.velocity, -s.spin)  # noqa: E731
    there = simulate(scene, slab_state(p), **options)
    back = simulate(scene, turned(there.final), **options)
    code = jnp.maximum(there.result._value, back.result._value)  # pyright: ignore
    return slab_outputs(turned(back.final)), (code, there.n_impacts)


def reversal(dtype: Any) -> Cells:
    """The throw comes back to where it began, whatever the inputs: the derivatives by the state are one, all others
    zero. An error on the way there or back grows at most as the way itself makes small changes grow."""
    eps = float(np.finfo(dtype).eps)
    lanes = np.stack([SLABS.lane(throw, dtype) for throw in REVERSED])
    found, (codes, counts), *jacobians = jax.tree.map(np.asarray, with_slopes(there_and_back)(jnp.asarray(lanes)))
    cells = []
    for i, throw in enumerate(REVERSED):
        (inputs, outputs), name = SLABS.units(lanes[i]), NAMES_OF_RESULTS[codes[i]]
        names = () if name in OK else (name,)
        units = np.where(lanes[i] == 0, inputs, np.abs(lanes[i].astype(float)))
        whole = np.where((lanes[i] == 0) & (np.array(SLABS.inputs) == "gz"), 0.0, units)  # the model has gravity or not
        growth = np.abs(slopes(slab_long, exact(lanes[i]), whole) / outputs[:, None]).max()
        once = _PER_IMPACT * eps * (1 + int(counts[i])) * max(1.0, growth)
        truth = np.eye(5, 15) * units
        error = max(np.abs((each[i] * units - truth) / outputs[:, None]).max() for each in jacobians)
        value = (np.abs(found[i] - lanes[i][:5].astype(float)) / outputs).max()
        cells.append((throw.row, Cell(float(value), once, names), Cell(float(error), once * max(1.0, growth), names)))
    return cells


# Lanes that hold no numbers


def with_bad_lanes(dtype: Any) -> Cells:
    """Good throws among such as hold a NaN or an infinity in one of their inputs: the good ones must answer what they
    answer among themselves, to the last bit, and a number that all lanes share must have a derivative that the bad
    ones leave alone."""
    good = np.stack([SLABS.lane(Throw("", {"vx": 1.0 + 0.1 * i}), dtype) for i in range(30)])
    lanes, bad = np.tile(good, (2, 1)), np.arange(60) >= 30
    for k in range(30):
        lanes[30 + k, k // 2] = np.nan if k % 2 else np.inf * (-1) ** (k // 2)
    order = np.random.default_rng(0).permutation(60)
    lanes, bad = lanes[order], bad[order]
    clean = np.where(bad[:, None], good[0], lanes)

    @jax.jit
    def total(factor, lanes):
        """A loss of all lanes that ended well, of a factor that all of them share."""
        found, (codes, _) = jax.vmap(lambda p: run_slab(p + (factor - 1.0) * good[0]))(lanes)
        fine = (codes == NAMES_OF_RESULTS.index("reached_t1"))[:, None]
        return jnp.sum(jnp.where(fine & ~jnp.asarray(bad)[:, None], found, 0.0)), (found, codes)

    one = jnp.ones((), dtype)
    slope = jax.jit(jax.grad(total, has_aux=True))
    (mixed, (found, codes)), (pure, (expected, _)) = (slope(one, jnp.asarray(each)) for each in (lanes, clean))
    names = tuple(sorted({NAMES_OF_RESULTS[code] for code in np.asarray(codes)[bad]} - set(OK)))
    quiet = sum(NAMES_OF_RESULTS[code] in OK for code in np.asarray(codes)[bad])  # bad lanes that say nothing
    moved = np.abs(np.asarray(found) - np.asarray(expected))[~bad].max() + quiet
    along = abs(float(mixed - pure) / float(pure))
    row = "NaN or inf in half of the lanes"
    expected = ("invalid_state",)
    eps = float(np.finfo(dtype).eps)
    return [(row, Cell(float(moved), 0.0, names, expected), Cell(along, 64 * eps, names, expected))]


ROWS = (million, reversal, with_bad_lanes)
