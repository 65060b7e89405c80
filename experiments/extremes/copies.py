"""Copies of random scenes that must move alike: in other words, in another frame, in other units, by another call.

    python experiments/extremes/copies.py [--scenes 20000] [--seed 0] [--only NAME ...]

Every scene is thrown twice, in two descriptions, and the first of them twice again, from places that are shifted to
either side by 1e3 roundings (or by 10 tolerances, where something is integrated). Two copies agree if they end by the
same name, with as many impacts (unless a train of bounces may be summed from another bounce on, as by another top or
tolerance), and their places, velocities and spins (times the radius) differ by less than 100 times what such a shift is
and does. A throw whose shifted copy ends by another name or with another number of impacts is ill-conditioned: it is
left out, and counted; so is one that is stopped at `max_impacts`.

What is the same in all: a large table top with two walls, on which half of the balls bounce and half lie from the
beginning, and half of these roll. A fifth of the tables is plastic. For grooves walls may be plastic too, and gravity
is tilted. The exit code is 1 if two copies disagree.
"""

import argparse
import collections
import functools
import pathlib
import sys
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

jax.config.update("jax_enable_x64", True)
from nonholo_jax import (  # noqa: E402
    RESULTS,
    Air,
    Ball,
    BallState,
    Box,
    Exact,
    Frictional,
    Implicit,
    Integrated,
    Plane,
    Rectangle,
    Rough,
    Scene,
    Smooth,
    Sphere,
    simulate,
    simulate_batch,
)

sys.path.append(str(pathlib.Path(__file__).parents[1]))  # for report.py
from report import machine  # noqa: E402

R, MASS, T1, IMPACTS, LANES = 0.05, 0.05, 1.2, 256, 500
HALF, HUGE = 4.0, 1e7  # half the side of the table: no throw comes to its edge; the radius that is nearly a plane
LAWS = {
    "rough": lambda e: Rough(e),
    "two coefficients": lambda e: Rough(e, 0.3),
    "smooth": lambda e: Smooth(e),
    "frictional": lambda e: Frictional(e, 0.1, 0.3),
}
DTYPES = (jnp.float64, jnp.float32)
NAMES = list(RESULTS._name_to_item)
STOPPED = NAMES.index("max_impacts")


class Copy(NamedTuple):
    """One description of a scene and of the call that moves it."""

    top: str = "box"
    is_reversed: bool = False  # the order of the surfaces
    call: str = "vmap"
    motion: str = "closed form"
    frame: str = "turned"
    units: str = "m, s"
    parts: int = 1
    grooves: bool = False  # walls may be plastic, and gravity is tilted

    @property
    def program(self) -> "Copy":
        """The same but for what is only other numbers, or another call, of one program."""
        call = "log" if self.call == "at" else self.call
        return Copy(self.top, self.is_reversed, call, self.motion)


class Family(NamedTuple):
    one: Copy
    other: Copy
    shift: float = 0.0  # in m, if it is more than the roundings
    dtypes: tuple = DTYPES


class End(NamedTuple):
    """How throws ended, in the frame of the table."""

    place: Any
    velocity: Any
    spin: Any  # times the radius
    name: Any  # as index of `NAMES`
    impacts: Any


def _family(one: Copy, shift: float = 0.0, dtypes: tuple = DTYPES, **changes: Any) -> Family:
    return Family(one, one._replace(**changes), shift, dtypes)


_PLANE, _BOX, _TWO = Copy("plane"), Copy(), Copy("two")
_IN_AIR, _GROOVE = Copy(motion="air"), Copy(motion="followed", grooves=True)
FAMILIES = {
    "plane as box": _family(_PLANE, top="box"),
    "plane as rectangle": _family(_PLANE, top="rectangle"),
    "plane as Implicit": _family(_PLANE, top="implicit", motion="followed"),
    "plane as huge sphere": _family(_PLANE, 1e-6, DTYPES[:1], top="sphere", motion="followed"),
    "box let into a floor": _family(_PLANE, top="inlay"),
    "cut in two": _family(_BOX, top="two"),
    "cut in three": _family(_BOX, top="three"),
    "another order": _family(_BOX, is_reversed=True),
    "turned back": _family(_BOX, frame="straight"),
    "mirrored": _family(_BOX, frame="mirrored"),
    "in cm and 0.1 s": _family(_BOX, units="cm, 0.1 s"),
    "with a log": _family(_BOX, call="log"),
    "at(t)": _family(_BOX, call="at"),
    "one by one": _family(_BOX, call="single"),
    "simulate_batch": _family(_BOX, call="batch"),
    "in two parts": _family(_BOX, parts=2),
    "cut in two, in two parts": _family(_TWO, parts=2),
    "contacts integrated": _family(_BOX, motion="followed"),
    "air: plane as box": _family(_PLANE._replace(motion="air"), top="box"),
    "air: cut in two": _family(_IN_AIR, top="two"),
    "air: another order": _family(_IN_AIR, is_reversed=True),
    "air: turned back": _family(_IN_AIR, frame="straight"),
    "air: mirrored": _family(_IN_AIR, frame="mirrored"),
    "air: in cm and 0.1 s": _family(_IN_AIR, units="cm, 0.1 s"),
    "air: with a log": _family(_IN_AIR, call="log"),
    "air: at(t)": _family(_IN_AIR, call="at"),
    "air: one by one": _family(_IN_AIR, call="single"),
    "air: in two parts": _family(_IN_AIR, parts=2),
    "groove: another order": _family(_GROOVE, is_reversed=True),
    "groove: turned back": _family(_GROOVE, frame="straight"),
    "groove: mirrored": _family(_GROOVE, frame="mirrored"),
    "groove: in cm and 0.1 s": _family(_GROOVE, units="cm, 0.1 s"),
    "groove: at(t)": _family(_GROOVE, call="at"),
    "groove: in two parts": _family(_GROOVE, parts=2),
}


def tolerance(motion: str, dtype: Any) -> float:
    """Of one step; a motion in closed form has none."""
    fine = {"closed form": 0.0, "followed": 1e-9, "air": 1e-10}[motion]
    return fine if dtype == jnp.float64 else 1e3 * fine


def motion_of(name: str, dtype: Any) -> Any:
    if name == "closed form":
        return Exact()
    integrated = Integrated(rtol=tolerance(name, dtype), atol=tolerance(name, dtype))
    return integrated if name == "air" else Exact(contact=integrated)


class _Over(eqx.Module):
    """How far a ball is above a plane."""

    point: Any
    normal: Any
    radius: Any

    def __call__(self, x: Any, t: Any) -> Any:
        del t
        return jnp.sum((x - self.point) * self.normal) - self.radius


def _pieces(kind: str, cut: Any) -> list[tuple[Any, Any]]:
    """Where the boxes that make a top begin and end along its first axis."""
    edges = {"two": (-HALF, cut, HALF), "three": (-HALF, cut, cut + 0.3, HALF)}.get(kind, (-HALF, HALF))
    return list(zip(edges, edges[1:], strict=False))


def top(kind: str, law: Any, numbers: dict) -> dict:
    """A table top at the height 0 of the frame."""
    place, axes, unit, cut = (numbers[name] for name in ("place", "axes", "length", "cut"))

    def at(*x: Any) -> Any:
        return place + unit * jnp.stack([jnp.asarray(c, axes.dtype) for c in x]) @ axes

    def box(begin: Any, end: Any, depth: float = 1.0) -> Box:
        half = (unit * 0.5 * (end - begin), unit * HALF, unit * 0.5 * depth)
        return Box(at(0.5 * (begin + end), 0.0, -0.5 * depth), half, law, rotation=numbers["turn"])

    origin, normal = at(0.0, 0.0, 0.0), axes[2]
    if kind == "plane":
        return {"top": Plane(origin, normal, law)}
    if kind == "rectangle":
        return {"top": Rectangle(origin, normal, axes[0], (unit * HALF, unit * HALF), law)}
    if kind == "implicit":
        return {"top": Implicit(_Over(origin, normal, unit * R), law)}
    if kind == "sphere":
        return {"top": Sphere(center=at(0.0, 0.0, -HUGE), radius=unit * HUGE, law=law)}
    if kind == "inlay":
        return {"top": Plane(origin, normal, law), "inlay": box(cut - 0.25, cut + 0.25, 0.2)}
    return {f"piece {i}": box(*ends) for i, ends in enumerate(_pieces(kind, cut))}


def walls(law: Any, numbers: dict) -> dict:
    """Two walls that make a square corner."""
    place, axes, unit = (numbers[name] for name in ("place", "axes", "length"))
    x, y = (place + unit * jnp.asarray(point, axes.dtype) @ axes for point in ((0.8, 0.0, 0.0), (0.0, 0.6, 0.0)))
    return {"x": Plane(x, -axes[0], law), "y": Plane(y, -axes[1], law)}


def described(copy: Copy, law: Callable, numbers: dict) -> Scene:
    """A table with two walls on it."""
    surfaces = top(copy.top, law(numbers["restitution"]), numbers) | walls(law(numbers["of walls"]), numbers)
    if copy.is_reversed:
        surfaces = dict(list(surfaces.items())[::-1])
    air = Air(1.2 / numbers["length"] ** 3) if copy.motion == "air" else None
    return Scene(Ball(numbers["length"] * R, MASS), surfaces, gravity=numbers["gravity"], air=air)


@functools.cache
def program(copy: Copy, law_name: str) -> Callable:
    """Moves a batch of numbers and states from 0 to `t1`: state, time reached, name and number of impacts there, and
    of a log the state at `t`. Compiled with the least effort, for it takes longer to make than to run."""
    law = LAWS[law_name]

    def options(state: BallState) -> dict[str, Any]:
        motion, rows = motion_of(copy.motion, state.position.dtype), 96 if copy.call == "log" else 0
        return {"max_impacts": IMPACTS, "log_size": rows, "motion": motion, "throw": False}

    def one(numbers: dict, state: BallState, t1: Any, t: Any) -> tuple:
        found = simulate(described(copy, law, numbers), state, t1=t1, **options(state))
        at = found.at(t) if copy.call == "log" else None
        return found.final, found.t1, found.result._value, found.n_impacts, at

    def batch(numbers: dict, states: BallState, t1: Any, t: Any) -> tuple:
        del t
        scenes = eqx.filter_vmap(lambda each: described(copy, law, each))(numbers)
        found = simulate_batch(scenes, states, t1=t1[0], scene_axes=0, **options(states))
        return found.final, found.t1, found.result._value, found.n_impacts, None

    ways = {"batch": batch, "single": lambda *each: jax.lax.map(lambda x: one(*x), each)}
    return jax.jit(ways.get(copy.call, jax.vmap(one)), compiler_options={"xla_backend_optimization_level": 0})


@functools.cache
def drawn(seed: int, n: int) -> dict:
    """Throws at the table: some roll from the beginning, some slide, most bounce."""
    rng = np.random.default_rng(seed)
    turn = rng.normal(size=(n, 4))
    turn = turn / np.linalg.norm(turn, axis=1, keepdims=True)
    v = rng.uniform(-1.5, 1.5, (n, 3))
    x = np.c_[rng.uniform(-0.5, 0.5, (n, 2)), R + rng.uniform(0.0, 0.3, n)]
    spin = rng.normal(size=(n, 3)) * 20.0
    low, rolls = rng.random(n) < 0.5, rng.random(n) < 0.5
    x[low, 2], v[low, 2] = R, 0.0
    rolls = low & rolls
    spin[rolls, 0], spin[rolls, 1] = -v[rolls, 1] / R, v[rolls, 0] / R
    numbers = {"turn": turn, "place": rng.uniform(-1, 1, (n, 3)), "x": x, "v": v, "spin": spin, "low": low}
    numbers["cut"] = rng.uniform(-0.6, 0.6, n)
    numbers["restitution"] = np.where(rng.random(n) < 0.2, 0.0, rng.uniform(0.3, 0.9, n))
    numbers["plastic walls"] = rng.random(n) < 0.4
    numbers["tilt"] = np.c_[rng.uniform(-1.0, 3.0, (n, 2)), np.zeros(n)]
    return numbers


def axes_of(turn: np.ndarray) -> np.ndarray:
    """The rows are the axes of frames turned by unit quaternions."""
    w, v = turn[:, :1], turn[:, 1:]
    once = [np.cross(v, e) for e in np.eye(3)]
    return np.stack([e + 2 * w * c + 2 * np.cross(v, c) for e, c in zip(np.eye(3), once, strict=True)], axis=1)


def numbers_of(copy: Copy, throws: dict) -> dict:
    """The numbers of the scenes."""
    n, straight = len(throws["cut"]), copy.frame == "straight"
    turn = np.tile([1.0, 0.0, 0.0, 0.0], (n, 1)) if straight else throws["turn"]
    axes, hand = axes_of(turn), -1.0 if copy.frame == "mirrored" else 1.0
    axes[:, 0] *= hand
    length, second = {"m, s": (1.0, 1.0), "cm, 0.1 s": (100.0, 10.0)}[copy.units]
    down = [0.0, 0.0, -9.81] + throws["tilt"] * copy.grooves
    numbers = {name: throws[name] for name in ("cut", "restitution")}
    numbers |= {"turn": turn, "axes": axes, "place": length * throws["place"] * (not straight)}
    numbers |= {"hand": np.full(n, hand), "length": np.full(n, length), "second": np.full(n, second)}
    numbers["gravity"] = length / second**2 * _into(axes, down)
    numbers["of walls"] = np.where(throws["plastic walls"] & copy.grooves, 0.0, 0.6)
    return numbers


def _into(axes: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Vectors in the frame of the table as vectors in space."""
    return np.einsum("ni,nij->nj", x, axes)


def states_of(numbers: dict, throws: dict, shift: float, dtype: Any) -> BallState:
    """The states that throws begin with. What lies on the table is lifted, by roundings alone, not pushed into it."""
    axes, unit, second, hand = (numbers[name] for name in ("axes", "length", "second", "hand"))
    lifted = np.where(throws["low"], min(abs(shift), 1e3 * float(jnp.finfo(dtype).eps)), shift)
    x = throws["x"] + np.c_[np.full((len(unit), 2), shift), lifted]
    position = numbers["place"] + unit[:, None] * _into(axes, x)
    velocity = (unit / second)[:, None] * _into(axes, throws["v"])
    spin = (hand / second)[:, None] * _into(axes, throws["spin"])  # the mirror image of a spin turns the other way
    return BallState(*(jnp.asarray(each, dtype) for each in (position, velocity, spin)))


def seen(numbers: dict, state: BallState, name: Any, impacts: Any) -> End:
    """An end in the frame of the table, in m and s."""
    unit, second, hand = (numbers[name][:, None] for name in ("length", "second", "hand"))
    place, velocity, spin = (np.asarray(x, float) for x in (state.position, state.velocity, state.spin))
    inward = lambda x: np.einsum("nj,nij->ni", x, numbers["axes"])  # noqa: E731
    place, velocity = inward(place - numbers["place"]) / unit, inward(velocity) * second / unit
    return End(place, velocity, inward(spin) * hand * second * R, np.asarray(name), np.asarray(impacts))


def moved(copy: Copy, law: str, numbers: dict, state: BallState) -> tuple:
    """State, name and number of impacts at T1."""
    run, t1 = program(copy.program, law), T1 * numbers["second"]
    if copy.call == "at":
        final, reached, name, impacts, at = run(numbers, state, 1.4 * t1, t1)
        is_there = reached >= t1
        final = jax.tree.map(lambda a, b: jnp.where(is_there[:, None], a, b), at, final)
        return final, jnp.where(is_there, 0, name), impacts
    if copy.parts == 1:
        final, _, name, impacts, _ = run(numbers, state, t1, t1)
        return final, name, impacts
    state, _, first, impacts, _ = run(numbers, state, 0.37 * t1, 0.37 * t1)
    final, _, name, others, _ = run(numbers, state, t1 - 0.37 * t1, t1)
    return final, jnp.where(first > 1, first, name), impacts + others


@functools.cache
def ends(copy: Copy, law: str, dtype: Any, n: int, seed: int, shift: float) -> End:
    """How all throws end, in batches of one size, so that one program does."""
    throws, found = drawn(seed, n), []
    numbers = numbers_of(copy, throws)
    for begin in range(0, n, LANES):
        lanes = np.minimum(np.arange(begin, begin + LANES), n - 1)
        rounded = {name: jnp.asarray(value[lanes], dtype) for name, value in numbers.items()}
        exact = {name: np.asarray(value, float) for name, value in rounded.items()}
        state = states_of(exact, {name: value[lanes] for name, value in throws.items()}, shift, dtype)
        found.append(seen(exact, *moved(copy, law, rounded, state)))
    return jax.tree.map(lambda *parts: np.concatenate(parts)[:n], *found)


def apart(a: End, b: End) -> np.ndarray:
    """How far two ends are from one another in place, velocity and spin. What is no number is infinitely far."""
    with np.errstate(invalid="ignore"):
        differences = [np.max(abs(x - y), axis=1) for x, y in zip(a[:3], b[:3], strict=True)]
    return np.nan_to_num(np.max(differences, axis=0), nan=np.inf)


class Found(NamedTuple):
    wrong: np.ndarray  # whether two copies disagree, throw by throw
    left_out: np.ndarray
    worst: float  # the largest difference of two copies that agree, in bounds
    names: collections.Counter  # of the ends before the time


def compared(family: Family, law: str, dtype: Any, n: int, seed: int) -> Found:
    tolerances = [tolerance(copy.motion, dtype) for copy in (family.one, family.other)]
    shift = max(1e3 * float(jnp.finfo(dtype).eps), 10.0 * max(tolerances), family.shift)
    first, second = (ends(copy, law, dtype, n, seed, 0.0) for copy in (family.one, family.other))
    left_out, by = (first.name == STOPPED) | (second.name == STOPPED), np.full(n, shift)
    uncounted = drawn(seed, n)["low"]  # with how many impacts these begin, rounding decides
    for sign in (1.0, -1.0):
        shifted = ends(family.one, law, dtype, n, seed, sign * shift)
        left_out |= (shifted.name != first.name) | ((shifted.impacts != first.impacts) & ~uncounted)
        by = np.maximum(by, apart(first, shifted))
    in_bounds = apart(first, second) / (100.0 * by)
    alike = (first.name == second.name) & (in_bounds <= 1.0)
    summed_alike = max(tolerances) == 0.0 and family.other.top == family.one.top
    if summed_alike and family.other.call != "at" and family.other.parts == 1:
        alike &= (first.impacts == second.impacts) | uncounted
    wrong = ~alike & ~left_out
    names = collections.Counter(NAMES[code] for code in first.name[~left_out] if code > 1)
    return Found(wrong, left_out, float(np.max(in_bounds[alike & ~left_out], initial=0.0)), names)


def study(name: str, scenes: int, seed: int, laws: list, dtypes: list) -> int:
    """Print how many copies of one family agree; return how many do not."""
    begun, share = time.perf_counter(), -(-scenes // (len(dtypes) * len(laws)))
    founds = {}
    for dtype in dtypes:
        for law in laws:
            found = founds[dtype, law] = compared(FAMILIES[name], law, dtype, share, seed + list(LAWS).index(law))
            if np.any(found.wrong):
                at = ", ".join(str(i) for i in np.flatnonzero(found.wrong)[:8])
                print(f"    {np.sum(found.wrong)} disagree: {law}, {jnp.dtype(dtype).name}, throws {at}", flush=True)
    wrong, left_out = (sum(int(np.sum(getattr(f, which))) for f in founds.values()) for which in ("wrong", "left_out"))
    of = share * len(founds) - left_out
    worst = " and ".join(f"{max(founds[dtype, law].worst for law in laws):.0e}" for dtype in dtypes)
    names = sum((f.names for f in founds.values()), collections.Counter())
    early = ", ".join(f"{count} {each}" for each, count in names.most_common()) or "none"
    print(f"{name:24} {of - wrong:6} of {of:6} agree  {left_out:5} left out  worst {worst}  early: {early}  "
          f"({time.perf_counter() - begun:.0f} s)", flush=True)  # fmt: skip
    return wrong


def main() -> int:
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("--scenes", type=int, default=20_000, help="in each family")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", nargs="*", default=[""], help="families whose names begin with one of these")
    parser.add_argument("--law", choices=list(LAWS), help="one alone")
    parser.add_argument("--dtype", choices=[jnp.dtype(each).name for each in DTYPES], help="one alone")
    arguments = parser.parse_args()
    print(machine())
    laws = [law for law in LAWS if arguments.law in (None, law)]
    wrong = 0
    for name, family in FAMILIES.items():
        dtypes = [each for each in family.dtypes if arguments.dtype in (None, jnp.dtype(each).name)]
        if name.startswith(tuple(arguments.only)) and dtypes:
            wrong += study(name, arguments.scenes, arguments.seed, laws, dtypes)
    print("worst: the largest difference of copies that agree, in bounds, float64 and float32")
    return int(wrong > 0)


if __name__ == "__main__":
    sys.exit(main())
