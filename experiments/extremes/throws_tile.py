"""Throws of the study throws.py, made by the library and checked by throws_check.py, a tile of them at a time."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from throws_check import BOUNDS, Arc, Ball as Model, Doubt, Moment, Solid, ends_apart, judged

from nonholo_jax import Ball, BallState, Box, Plane, Rough, Scene, simulate, simulate_batch
from nonholo_jax._math.types import NAMES_OF_RESULTS

jax.config.update("jax_enable_x64", True)

IMPACTS = 8  # of a throw, at most
AT_ONCE = 64.0  # roundings of the time
TILE = 256  # throws whose numbers stay in the first caches
DTYPES = ("float32", "float64")
G = 9.81
GRAVITY = (0.0, 0.0, -G)
ENDED, MORE = NAMES_OF_RESULTS.index("reached_t1"), NAMES_OF_RESULTS.index("max_impacts")
VERSION = 1  # of the throws: a folder of another one is not gone on with


class Family(NamedTuple):
    """Throws in one scene of `solids`: a middle and a spread of place, velocity and spin; a normal spread, or an even
    one."""

    solids: dict[str, Solid]
    t1: float
    middle: tuple
    spread: tuple
    normal: bool


def _walls(*half: float) -> dict[str, Solid]:
    """Two walls for every axis, so far from the origin."""
    walls = {}
    for axis, size in enumerate(half):
        for sign in (-1.0, 1.0):
            normal = tuple(-sign * float(k == axis) for k in range(3))
            walls[f"{'xyz'[axis]}{sign:+.0f}"] = Solid(tuple(-size * c for c in normal), normal, None)
    return walls


_TABLE = {
    "floor": Solid((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), None),
    "table": Solid((0.6, 0.0, 0.715), None, (0.6, 0.4, 0.015)),
}
_ZERO = (0.0, 0.0, 0.0)
FAMILIES = {
    "corridor": Family(_walls(0.3), 1.0, (_ZERO,) * 3, ((0.2,) * 3, (6.0, 3.0, 3.0), (90.0,) * 3), False),
    "room": Family(_walls(0.5, 0.4, 0.5), 1.0, (_ZERO,) * 3, ((0.35,) * 3, (5.0,) * 3, (90.0,) * 3), False),
    "table": Family(
        _TABLE,
        1.2,
        ((-0.3, 0.0, 0.9), (2.0, 0.0, -5.0), (0.0, 15.0, 0.0)),
        ((0.04,) * 3, (0.5,) * 3, (30.0,) * 3),
        True,
    ),
}


class Job(NamedTuple):
    """What a chunk is, by its number alone."""

    chunk: int
    family: str
    dtype: str

    @classmethod
    def of(cls, chunk: int) -> "Job":
        round_, which = divmod(chunk, len(FAMILIES))
        return cls(chunk, list(FAMILIES)[which], DTYPES[round_ % 4 == 3])

    def ball(self) -> Model:
        """Restitution, roughness, inertia and radius; a quarter of the chunks are elastic, and a sixth fully rough."""
        rng = np.random.default_rng([VERSION, self.chunk])
        e, e_t = min(rng.uniform(0.6, 1.13), 1.0), min(rng.uniform(-0.4, 1.28), 1.0)
        return Model(*np.asarray([e, e_t, rng.uniform(0.2, 1.0), rng.uniform(0.015, 0.04)], self.dtype))


# One tile of throws


def scene_of(family: Family, ball: Model) -> Scene:
    law = Rough(ball.restitution, ball.tangential)

    def surface(solid: Solid) -> Any:
        if solid.normal is not None:
            return Plane(solid.place, solid.normal, law)
        return Box(center=solid.place, half_size=solid.half, law=law)

    solids = {name: surface(solid) for name, solid in family.solids.items()}
    return Scene(Ball(ball.radius, 0.046, ball.alpha), solids, gravity=GRAVITY)


def drawn(family: Family, key: Any, dtype: Any) -> Moment:
    """Launches of a tile; each vector is an array (3, throws)."""
    if family.normal:
        numbers = jax.random.normal(key, (3, 3, TILE), dtype)
    else:
        numbers = jax.random.uniform(key, (3, 3, TILE), dtype, -1.0, 1.0)
    middle, spread = (jnp.asarray(each, dtype)[..., None] for each in (family.middle, family.spread))
    return Moment(*(middle + spread * numbers))


class Stop(NamedTuple):
    """Where a call of the library has ended."""

    time: Any
    moment: Moment
    n_impacts: Any
    code: Any


def _stop(end: Any) -> Stop:
    moment = Moment(*(x.T for x in (end.final.position, end.final.velocity, end.final.spin)))
    return Stop(end.t1, moment, end.n_impacts, end.result._value)


def _state(moment: Moment) -> BallState:
    return BallState(*(x.T for x in moment))


def stepped(scene: Scene, start: Moment, left: Any, impacts: int) -> Stop:
    """As far as the impact after so many; each throw has a time of its own that is left."""
    options: dict = {"max_impacts": impacts, "log_size": 0, "sum_trains": False, "throw": False}
    return _stop(jax.vmap(lambda state, left: simulate(scene, state, t1=left, **options))(_state(start), left))


class Row(NamedTuple):
    """One arc of every throw of a tile, with what was found of it."""

    live: Any  # whether there was one
    lost: Any  # it ended in a way that it must not
    corner: Any  # the impact before was on several surfaces, or nearly
    open: Any  # rounding decides whether there is one more impact at the end
    arc: Arc
    figures: Any


class Tile(NamedTuple):
    rows: Row  # the first axis is that of the arcs
    whole: Stop
    figures: Any  # the greatest of each throw
    failed: Any


def _double(x: Any) -> Any:
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float64), x)


def tile_of(family: Family, ball: Model, told: Model, key: Any, dtype: Any) -> Tile:
    """The throws of one tile, made and checked; `told` is the ball that the check is told of, the same unless somebody
    wants to see it fail."""
    scene, launch = scene_of(family, ball), drawn(family, key, dtype)
    t1, solids = jnp.full((TILE,), family.t1, dtype), tuple(family.solids.values())
    model, eps = _double(told), float(np.finfo(dtype).eps)

    def arc(carry: tuple, impacts: int) -> tuple[tuple, Row]:
        moment, left, live, doubt = carry
        stop = stepped(scene, moment, jnp.where(live, jnp.maximum(left, 0.0), 0.0), impacts)
        goes_on = stop.code == MORE
        fine = (stop.n_impacts == impacts) & (goes_on | (stop.code == ENDED))
        struck = jnp.full((TILE,), impacts > 0)
        each = Arc(_double(moment), _double(stop.moment), _double(stop.time), struck, goes_on)
        found = judged(solids, model, GRAVITY, each, doubt, eps)
        new, old = (stop.moment, found.doubt), (moment, doubt)
        moment, doubt = jax.tree.map(lambda a, b: jnp.where(live, a, b), new, old)
        # Rounding may put the end of the time before an impact that the last step has come to.
        unmade = (left <= AT_ONCE * eps * family.t1) & (stop.code == ENDED) & (stop.n_impacts < impacts)
        fine, figures = fine | unmade, jnp.where((live & ~unmade)[None], found.figures, 0.0)
        row = Row(live, live & ~fine, live & found.corner, live & found.open, each, figures)
        return (moment, left - stop.time, live & fine & goes_on, doubt), row

    nothing = jnp.zeros((TILE,))
    carry, first = arc((launch, t1, jnp.full((TILE,), True), Doubt(nothing, nothing, nothing)), 0)
    (last, left, goes_on, doubt), rest = lax.scan(lambda carry, _: arc(carry, 1), carry, None, IMPACTS)
    rows = jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), first, rest)
    options: dict = {"max_impacts": IMPACTS, "log_size": 0, "sum_trains": False}
    whole = _stop(simulate_batch(scene, _state(launch), t1=family.t1, **options))
    late = whole.time - jnp.where(goes_on, t1 - left, t1)
    apart = ends_apart(_double(last), _double(whole.moment), _double(late), model, doubt, G, eps)
    same = (whole.n_impacts == rows.live.sum(0, dtype=jnp.int32) - 1) & (goes_on == (whole.code == MORE))
    # Which of two surfaces comes first in a corner is a question of rounding, and with it how many impacts there are.
    apart = jnp.where(rows.corner.any(0) | (rows.open.any(0) & ~same), 0.0, jnp.where(same, apart, jnp.inf))
    figures = jnp.concatenate([rows.figures.max(0), apart[None]])
    named = (whole.code == ENDED) | (whole.code == MORE)
    fine = (figures <= jnp.asarray([*BOUNDS.values()])[:, None]).all(0) & named & ~rows.lost.any(0)
    return Tile(rows, whole, figures, ~fine)
