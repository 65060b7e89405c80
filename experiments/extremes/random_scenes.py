"""Random throws in random scenes. Whether a ball has gone through something is asked of the log, by distances that are
written here in NumPy and share no code with the library, at many times of every arc."""

import functools
from collections import Counter
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from nonholo_jax import (
    Ball,
    BallState,
    Box,
    Cylinder,
    Exact,
    Frictional,
    Plane,
    Rectangle,
    Rough,
    Scene,
    Smooth,
    Sphere,
    simulate,
)
from nonholo_jax._math.types import NAMES_OF_RESULTS

ROWS = 24  # impacts of a throw at most, all of them in its log
OPTIONS: dict = {}  # of the compiler
GAIN = 32.0  # roundings of the energy that an arc or an impact may add
SAMPLES = 17  # times of every arc
OK = ("reached_t1", "at_rest")
# Results that a throw may have: it was stopped, or physics ends there. None of them is a hang or a broken number.
NAMED = ("max_impacts", "sustained_contact", "pivoting", "curved_slide", "no_limit", "corner")


class Template(NamedTuple):
    """Scenes of one program: kinds of surfaces and laws are fixed, every number is drawn anew for each throw."""

    name: str
    surfaces: tuple[str, ...]
    law: Callable  # of three random numbers in [0, 1]


def _rough(u: Any) -> Any:
    return Rough(jnp.where(u[0] < 0.1, 1.0, u[0]), 2.0 * u[1] - 1.0)


def _one_mu(u: Any) -> Any:
    return Rough(u[0])


def _smooth(u: Any) -> Any:
    return Smooth(u[0])


def _frictional(u: Any) -> Any:
    return Frictional(u[0], 2.0 * u[1] - 1.0, 2.0 * u[2] ** 3)


TEMPLATES = (
    Template("floor, wall and box", ("plane", "plane", "box"), _rough),
    Template("floor, plate and ball", ("plane", "rectangle", "sphere"), _frictional),
    Template("bowl with a post", ("bowl", "post"), _one_mu),
    Template("pipe with a box", ("pipe", "box"), _smooth),
)
_WIDTH = 13  # numbers of each surface: place 3, direction 3, second direction 3, sizes 3, one more
_N_LAW = 3


def drawn(template: Template, rng: np.random.Generator, n: int) -> dict[str, np.ndarray]:
    """Numbers of n throws: (n, surfaces, 13) and (n, surfaces, 3) of the laws, and those of the ball and its flight."""
    shape = (n, len(template.surfaces))
    unit = lambda x: x / np.linalg.norm(x, axis=-1, keepdims=True)  # noqa: E731
    numbers = np.zeros((*shape, _WIDTH))
    numbers[..., 0:3] = rng.uniform(-1.0, 1.0, (*shape, 3))
    numbers[..., 3:6] = unit(rng.standard_normal((*shape, 3)))
    numbers[..., 6:9] = unit(rng.standard_normal((*shape, 3)))
    numbers[..., 9:12] = 10.0 ** rng.uniform(-1.7, -0.2, (*shape, 3))
    numbers[..., 12] = rng.standard_normal(shape)
    axes = np.eye(3)
    for k, kind in enumerate(template.surfaces):
        if kind == "plane":  # a floor, and walls that lean
            up = [axes[2], axes[0], -axes[0], -axes[1]][k % 4]
            numbers[:, k, 3:6] = unit(up + 0.2 * rng.standard_normal((n, 3)) * (rng.random((n, 1)) < 0.7))
            numbers[:, k, 0:3] = -1.2 * up
        if kind in ("bowl", "pipe"):
            numbers[:, k, 0:3] *= 0.1
            numbers[:, k, 9] = rng.uniform(1.0, 2.0, n)
    gravity = rng.standard_normal((n, 3)) * 3.0 + np.where(rng.random((n, 1)) < 0.6, [[0.0, 0.0, -9.81]], 0.0)
    gravity *= rng.random((n, 1)) > 0.15
    return {
        "surfaces": numbers,
        "laws": rng.random((*shape, _N_LAW)),
        "radius": 10.0 ** rng.uniform(-3.0, -0.8, n),
        "alpha": 10.0 ** rng.uniform(-1.5, 1.0, n),
        "gravity": gravity,
        "position": rng.uniform(-1.0, 1.0, (n, 3)),
        "velocity": rng.standard_normal((n, 3)) * 10.0 ** rng.uniform(-2.0, 1.3, (n, 1)),
        "spin": rng.standard_normal((n, 3)) * 10.0 ** rng.uniform(-1.0, 2.0, (n, 1)),
    }


# Distances of the centre from the surfaces, in NumPy. x has shape (n, times, 3), p (n, 13).


def _across(x: np.ndarray, p: np.ndarray) -> np.ndarray:
    """The part of x - place that is across the direction."""
    d, e = x - p[:, None, 0:3], p[:, None, 3:6]
    return d - np.sum(d * e, axis=-1, keepdims=True) * e


def _plates(x: np.ndarray, p: np.ndarray) -> np.ndarray:
    n = p[:, 3:6]
    first = p[:, 6:9] - np.sum(p[:, 6:9] * n, axis=1, keepdims=True) * n
    first = first / np.linalg.norm(first, axis=1, keepdims=True)
    d = x - p[:, None, 0:3]
    beyond = [
        np.maximum(np.abs(np.einsum("ntk,nk->nt", d, axis)) - half, 0.0)
        for axis, half in ((first, p[:, 9:10]), (np.cross(n, first), p[:, 10:11]), (n, 0.0))
    ]
    return np.sqrt(sum(b**2 for b in beyond))


def _boxes(x: np.ndarray, p: np.ndarray) -> np.ndarray:
    q = np.concatenate([p[:, 12:13], p[:, 3:6]], axis=1)
    q = q / np.linalg.norm(q, axis=1, keepdims=True)
    d = x - p[:, None, 0:3]
    v, w = -q[:, None, 1:], q[:, None, :1]  # the inverse rotation
    y = d + 2.0 * w * np.cross(v, d) + 2.0 * np.cross(v, np.cross(v, d))
    beyond = np.abs(y) - p[:, None, 9:12]
    return np.linalg.norm(np.maximum(beyond, 0.0), axis=-1) + np.minimum(beyond.max(axis=-1), 0.0)


DISTANCES: dict[str, Callable] = {
    "plane": lambda x, p: np.einsum("ntk,nk->nt", x - p[:, None, 0:3], p[:, 3:6]),
    "rectangle": _plates,
    "box": _boxes,
    "sphere": lambda x, p: np.linalg.norm(x - p[:, None, 0:3], axis=-1) - p[:, 9:10],
    "bowl": lambda x, p: p[:, 9:10] - np.linalg.norm(x - p[:, None, 0:3], axis=-1),
    "post": lambda x, p: np.linalg.norm(_across(x, p), axis=-1) - p[:, 9:10],
    "pipe": lambda x, p: p[:, 9:10] - np.linalg.norm(_across(x, p), axis=-1),
}
BUILD: dict[str, Callable] = {
    "plane": lambda p, law: Plane(p[0:3], p[3:6], law),
    "rectangle": lambda p, law: Rectangle(p[0:3], p[3:6], p[6:9], p[9:11], law),
    "box": lambda p, law: Box(center=p[0:3], half_size=p[9:12], law=law, rotation=jnp.concatenate([p[12:13], p[3:6]])),
    "sphere": lambda p, law: Sphere(center=p[0:3], radius=p[9], law=law),
    "bowl": lambda p, law: Sphere(center=p[0:3], radius=p[9], law=law, inside=True),
    "post": lambda p, law: Cylinder(point=p[0:3], axis=p[3:6], radius=p[9], law=law),
    "pipe": lambda p, law: Cylinder(point=p[0:3], axis=p[3:6], radius=p[9], law=law, inside=True),
}


def gaps(template: Template, d: dict[str, np.ndarray], x: np.ndarray) -> np.ndarray:
    """The smallest gap to any surface at places (n, times, 3)."""
    each = [DISTANCES[kind](x, d["surfaces"][:, k]) for k, kind in enumerate(template.surfaces)]
    return np.min(each, axis=0) - d["radius"][:, None]


def admissible(template: Template, rng: np.random.Generator, n: int, dtype: Any) -> dict[str, np.ndarray]:
    """n throws that begin apart from everything, rounded to the dtype."""
    parts: list = []
    while sum(len(part["radius"]) for part in parts) < n:
        d = {k: v.astype(dtype).astype(float) for k, v in drawn(template, rng, 2 * n).items()}
        fine = gaps(template, d, d["position"][:, None])[:, 0] > 1e-3
        for k, kind in enumerate(template.surfaces):
            if kind in ("bowl", "pipe"):
                fine &= d["surfaces"][:, k, 9] > 1.05 * d["radius"]
        parts.append({k: v[fine] for k, v in d.items()})
    return {k: np.concatenate([part[k] for part in parts])[:n] for k in parts[0]}


@functools.cache
def program(template: Template) -> Callable:
    """The scene of one draw, thrown; jit compiles it once for each dtype and size of batch."""

    def one(d):
        laws = [template.law(u) for u in d["laws"]]
        surfaces = {f"{k}": BUILD[kind](d["surfaces"][k], laws[k]) for k, kind in enumerate(template.surfaces)}
        scene = Scene(Ball(d["radius"], 1.0, d["alpha"]), surfaces, gravity=d["gravity"])
        state = BallState(d["position"], d["velocity"], d["spin"])
        end = simulate(scene, state, t1=2.0, max_impacts=ROWS, motion=Exact(), throw=False)
        log = end.impacts
        moving = [(s.position, s.velocity, s.spin) for s in (log.before, log.after, end.final)]
        return end.result._value, end.n_rows, end.t1, log.time, log.until, *moving  # pyright: ignore

    return jax.jit(jax.vmap(one), compiler_options=OPTIONS)


class Found(NamedTuple):
    """What one batch shows; penetration in units of its own tolerance, tunnelled if beyond."""

    throws: int
    impacts: int
    results: Counter
    penetration: float
    tunnelled: int
    unannounced: int  # NaN or infinity under a result that is ok
    gained: float  # energy, in units of its own rounding


def judged(template: Template, d: dict[str, np.ndarray], dtype: Any) -> Found:
    n, eps = len(d["radius"]), float(np.finfo(dtype).eps)
    out = program(template)({k: jnp.asarray(v.astype(dtype)) for k, v in d.items()})
    cast = lambda x: np.asarray(x, dtype=float if jnp.issubdtype(x.dtype, jnp.floating) else None)  # noqa: E731
    codes, counts, t1, time, until, before, after, final = jax.tree.map(cast, out)
    start = (d["position"], d["velocity"], d["spin"])
    rows = time.shape[1]  # as many as impacts and faces passed at most
    used = np.arange(rows)[None] < counts[:, None]
    # Arcs from each `after` to the next `before`, the last one to the final state; unused ones stand still there.
    begin = [np.concatenate([s[:, None], np.where(used[..., None], a, f[:, None])], axis=1)
             for s, a, f in zip(start, after, final, strict=True)]  # fmt: skip
    end = [np.concatenate([np.where(used[..., None], b, f[:, None]), f[:, None]], axis=1)
           for b, f in zip(before, final, strict=True)]  # fmt: skip
    ends = np.concatenate([np.where(used, time, t1[:, None]), t1[:, None]], axis=1)
    begins = np.concatenate([np.zeros((n, 1)), np.where(used, until, t1[:, None])], axis=1)
    named = np.array([NAMES_OF_RESULTS[c] for c in codes])
    fine = np.isin(named, OK)
    finite = np.all([np.isfinite(x).all(axis=-1) for x in final], axis=0) & np.isfinite(t1)
    x = sampled(begin, end, ends - begins)
    gap = gaps(template, d, x.reshape(n, -1, 3)).reshape(n, rows + 1, SAMPLES)
    # Places are known to roundings of the coordinates that they are computed from, and of the way there.
    reach = np.abs(x).max(axis=(1, 2, 3)) + 4.0
    depth = np.max(-gap, axis=(1, 2)) / (16.0 * eps * reach)
    depth = np.where(np.isnan(depth), 0.0, depth)
    g = d["gravity"]
    kinetic = lambda v, w: 0.5 * np.sum(v**2, -1) + 0.5 * (d["alpha"] * d["radius"] ** 2)[:, None] * np.sum(w**2, -1)  # noqa: E731
    energy = lambda s: kinetic(s[1], s[2]) - np.einsum("ntk,nk->nt", s[0], g)  # noqa: E731
    first, last = energy(begin), energy(end)
    height = np.linalg.norm(g, axis=-1, keepdims=True) * reach[:, None]
    scale = np.max(np.abs(first) + kinetic(begin[1], begin[2]) + height, axis=1) * eps
    gains = np.maximum(np.max(np.diff(first, axis=1), axis=1), np.max(np.abs(last - first), axis=1)) / scale
    return Found(
        n, int(counts.sum()), Counter(named.tolist()), float(depth.max()), int((depth > 1.0).sum()),
        int((fine & ~finite).sum()), float(np.nanmax(gains)),
    )  # fmt: skip


def sampled(begin: list, end: list, lasts: np.ndarray) -> np.ndarray:
    """Places at SAMPLES times of every arc, (n, arcs, times, 3): the cubic through both ends with their velocities,
    which is the parabola where the acceleration is constant, in flight, rolling and sliding."""
    s = np.linspace(0.0, 1.0, SAMPLES)[:, None]
    a, b = begin[0][:, :, None], end[0][:, :, None]
    u, v = (each[1][:, :, None] * lasts[:, :, None, None] for each in (begin, end))
    return (1 + 2 * s) * (1 - s) ** 2 * a + s * (1 - s) ** 2 * u + s**2 * (3 - 2 * s) * b + s**2 * (s - 1) * v


def study(template: Template, throws: int, dtype: Any, seed: int = 0, batch: int = 2048) -> Found:
    rng = np.random.default_rng([seed, TEMPLATES.index(template)])
    parts = [judged(template, admissible(template, rng, batch, dtype), dtype) for _ in range(-(-throws // batch))]
    return Found(
        sum(p.throws for p in parts), sum(p.impacts for p in parts), sum((p.results for p in parts), Counter()),
        max(p.penetration for p in parts), sum(p.tunnelled for p in parts), sum(p.unannounced for p in parts),
        max(p.gained for p in parts),
    )  # fmt: skip
