"""What the extremes are held to: small models of their own in fifty digits, which share no code with the library.

Each model takes the inputs of one throw as they were rounded to float32 or float64 and gives its outputs. The answer of
a computation that is as good as its inputs lies among the answers of inputs that differ from these by some roundings:
that spread, `bound`, is all that an error is allowed. It knows by itself that a grazing throw loses half its digits.
"""

import itertools
from collections.abc import Callable, Sequence
from typing import Any

import mpmath
import numpy as np
from mpmath import mp, mpf

mp.dps = 50
ROUNDINGS = 16  # relative roundings of each input that an answer may be off by
_STEP = mpf(10) ** -18  # of differences: errors of 1e-36
_NEVER = mpf(10) ** 60
_TINY = mpf(10) ** -45
_WAYS = 12


def exact(p: Any) -> list:
    """The very numbers of an array of floats."""
    return [mpf(float(x)) for x in p]


def values(model: Callable, p: Sequence) -> np.ndarray:
    return np.array([float(x) for x in model(p)])


def slopes(model: Callable, p: Sequence, units: Any, one_sided: Sequence[int] = ()) -> np.ndarray:
    """The derivatives of all outputs by all inputs, (outputs, inputs), each per `units` of its input. By an input at
    the end of its range (`one_sided`) they are those from above."""
    columns = []
    for j, unit in enumerate(exact(units)):
        at = lambda k, j=j, unit=unit: model([x + k * _STEP * unit * (i == j) for i, x in enumerate(p)])  # noqa: E731
        if j in one_sided:
            column = [(4 * b - 3 * a - c) / 2 for a, b, c in zip(at(0), at(1), at(2), strict=True)]
        else:
            column = [(b - a) / 2 for a, b in zip(at(-1), at(1), strict=True)]
        columns.append([float(c / _STEP) for c in column])
    return np.array(columns).T


def spread(function: Callable, p: Sequence, eps: float, known: np.ndarray, roundings: float = ROUNDINGS) -> np.ndarray:
    """Twice how far the answers of `function` are from the known one among inputs within that many roundings."""
    rng, far = np.random.default_rng(0), np.zeros_like(known)
    for _ in range(_WAYS):
        signs = rng.choice([-1.0, 1.0], len(p))
        moved = [x * (1 + roundings * mpf(eps) * s) for x, s in zip(p, signs, strict=True)]
        far = np.maximum(far, np.nan_to_num(np.abs(function(moved) - known), nan=np.inf))
    return 2.0 * far


# A rough ball between two level planes, moving in a vertical plane

SLAB = ("x", "z", "vx", "vz", "spin", "alpha", "mass", "radius", "e", "e_t", "gx", "gz", "floor", "ceiling", "t1")


def _first(gap: Any, rate: Any, bend: Any) -> Any:
    """The first time at which a gap that is not negative closes: gap + rate t + bend t^2 / 2."""
    if gap <= 0:  # touched: apart at once, or not at all
        if rate < 0:
            return mpf(0)
        return -2 * rate / bend if bend < 0 else _NEVER
    disc = rate * rate - 2 * bend * gap
    if disc < 0:
        return _NEVER
    edge = mpmath.sqrt(disc)
    if rate < 0:
        return 2 * gap / (edge - rate)
    return (rate + edge) / -bend if bend < 0 else _NEVER


def slab(p: Sequence) -> list:
    """x, z, their velocities and the spin at t1."""
    x, z, vx, vz, w, alpha, _, r, e, e_t, gx, gz, floor, ceiling, left = p
    touching, share = 0, (1 + e_t) * alpha / (1 + alpha)
    if ceiling - floor <= 2 * r:  # no room for the ball, among inputs that are hardly known
        return [mpf("nan")] * 5
    while True:
        gaps = [(z - floor - r) * (touching != 1), (ceiling - r - z) * (touching != -1)]
        # The side that has just been hit is left at once, or never: a throw that starts beyond rounding is put on it.
        times = [_first(gaps[0], vz, gz), _first(gaps[1], -vz, -gz)]
        side = 1 if times[0] <= times[1] else -1
        t = min(times)
        if touching == side and t < _TINY * (1 + left) and gz * side < 0:  # died out: it rolls
            vx = (vx + alpha * r * side * w) / (1 + alpha)
            a = gx / (1 + alpha)
            return [x + vx * left + a * left**2 / 2, z, vx + a * left, mpf(0), side * (vx + a * left) / r]
        t_now = min(t, left)
        x, z = x + vx * t_now + gx * t_now**2 / 2, z + vz * t_now + gz * t_now**2 / 2
        vx, vz, left = vx + gx * t_now, vz + gz * t_now, left - t_now
        if t >= left + t_now:
            return [x, z, vx, vz, w]
        slip = vx - r * side * w
        vx, w, vz = vx - share * slip, w + side * share * slip / (alpha * r), -e * vz
        z = floor + r if side == 1 else ceiling - r
        touching = side


def slab_long(p: Sequence) -> list:
    """The same after very many elastic impacts (e = e_t = 1, no force along the planes): what lies between two impacts
    on the floor is one linear map of (x, vx, r spin), and its powers need no loop over them."""
    x, z, vx, vz, w, alpha, _, r, _, _, _, gz, floor, ceiling, t1 = p
    first = _first(z - floor - r, vz, gz)
    if gz < 0 and vz * vz < -2 * gz * (ceiling - r - z):
        period, walls = 2 * (vz + gz * first) / gz, 1
    else:
        period, walls = 2 * (ceiling - floor - 2 * r) / abs(vz), 2
    assert gz == 0 or walls == 1
    k = 2 / (1 + alpha)

    def impact(side):  # slip u = vx - side r w
        return mpmath.matrix([[1, 0, 0], [0, 1 - k * alpha, k * alpha * side], [0, k * side, 1 - k]])

    def flight(t):
        return mpmath.matrix([[1, t, 0], [0, 1, 0], [0, 0, 1]])

    whole = flight(period) if walls == 1 else flight(period / 2) * impact(-1) * flight(period / 2)
    count = int(mpmath.floor((t1 - first) / period))
    state = (whole * impact(1)) ** count * flight(first) * mpmath.matrix([x, vx, r * w])
    left, rise = t1 - first - count * period, -(vz + gz * first)
    return slab([state[0], floor + r, state[1], -rise, state[2] / r, *p[5:8], mpf(1), mpf(1), *p[10:14], left])


# A rough ball that flies straight and hits a box or a sphere, once: both are convex

CONVEX = ("x", "y", "z", "vx", "vy", "vz", "wx", "wy", "wz", "alpha", "radius", "e", "e_t", "a", "b", "c", "t1")


def _dot(a: Sequence, b: Sequence) -> Any:
    return sum((x * y for x, y in zip(a, b, strict=True)), mpf(0))


def _cross(a: Sequence, b: Sequence) -> list:
    return [a[i - 2] * b[i - 1] - a[i - 1] * b[i - 2] for i in range(3)]


def _entry(y: Sequence, v: Sequence, reach: Any) -> Any:
    """When a point that moves straight comes as near to zero as `reach`, or never."""
    a, b, c = _dot(v, v), _dot(y, v), _dot(y, y) - reach * reach
    disc = b * b - a * c
    return c / (mpmath.sqrt(disc) - b) if disc >= 0 and b < 0 else _NEVER


def _meets_box(x: Sequence, v: Sequence, half: Sequence, r: Any) -> tuple:
    """The first time at which the centre is at a distance r from the box, and the normal: on one of 6 faces, 12 edges
    and 8 corners, each a sum of squares over the axes along which the centre is beyond the box."""
    found, normal = _NEVER, [mpf(0)] * 3
    for signs in itertools.product((-1, 0, 1), repeat=3):
        axes = [i for i in range(3) if signs[i]]
        if not axes:
            continue
        beyond = [signs[i] * x[i] - half[i] for i in axes]
        t = _entry(beyond, [signs[i] * v[i] for i in axes], r)
        if not 0 <= t < found:
            continue
        at = [a + t * b for a, b in zip(x, v, strict=True)]
        if all(s * y >= h if s else abs(y) <= h for s, y, h in zip(signs, at, half, strict=True)):
            found, normal = t, [s * (s * y - h) / r if s else mpf(0) for s, y, h in zip(signs, at, half, strict=True)]
    return found, normal


def _meets_sphere(x: Sequence, v: Sequence, half: Sequence, r: Any) -> tuple:
    t = _entry(x, v, half[0] + r)
    return t, [(a + t * b) / (half[0] + r) for a, b in zip(x, v, strict=True)]


def convex(p: Sequence, meets: Callable) -> list:
    """Position, velocity and spin at t1."""
    x, v, w, (alpha, r, e, e_t), half, t1 = p[:3], p[3:6], p[6:9], p[9:13], p[13:16], p[16]
    t, n = meets(x, v, half, r)
    if t > t1:
        return [a + t1 * b for a, b in zip(x, v, strict=True)] + [*v, *w]
    x = [a + t * b for a, b in zip(x, v, strict=True)]
    closing, turn = _dot(n, v), _cross(w, n)
    slip = [b - closing * c - r * d for b, c, d in zip(v, n, turn, strict=True)]
    share = (1 + e_t) * alpha / (1 + alpha)
    kick = _cross(n, slip)
    v = [b - (1 + e) * closing * c - share * d for b, c, d in zip(v, n, slip, strict=True)]
    w = [b + share / (alpha * r) * c for b, c in zip(w, kick, strict=True)]
    return [a + (t1 - t) * b for a, b in zip(x, v, strict=True)] + [*v, *w]


def box(p: Sequence) -> list:
    return convex(p, _meets_box)


def sphere(p: Sequence) -> list:
    return convex(p, _meets_sphere)
