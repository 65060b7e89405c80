"""Flights and bounces of a ball between planes with fifty digits, to judge what the rest of the package computes.

Nothing here is shared with the impacts of the package: an impact is an impulse at the contact point, whose normal part
follows from Newton's restitution and whose tangential part from the compliance 1/m + r^2/J of the contact point. The
roots are those of the quadratic equation.
"""

import importlib.util
from typing import Any

import numpy as np

from .._impact import Frictional, Rough, Smooth
from .._world import Plane, Scene

_DIGITS = 50


def why_not(scene: Any) -> str | None:
    """Why a scene cannot be computed here; `None` if it can."""
    if importlib.util.find_spec("mpmath") is None:
        return "mpmath is not installed"
    if not isinstance(scene, Scene) or scene.air is not None:
        return "only flights along parabolas are"
    laws = (Rough, Smooth, Frictional)
    if not all(type(surface) is Plane and type(surface.law) in laws for surface in scene.surfaces):
        return "only bounces on planes are"
    return None


def bounced(scene: Scene, throw: Any, t0: float, t1: float, most: int) -> tuple[np.ndarray, int] | None:
    """Where a ball is after its bounces, rounded to float64, and how many they were.

    **Arguments:** `throw` is one `BallState`; `most` is the largest number of impacts. Returns `None` where there would
    be more (a train among them), or where two planes are hit at once.
    """
    import mpmath

    with mpmath.workdps(_DIGITS):
        return _bounced(mpmath, scene, throw, t0, t1, most)


def _bounced(mp: Any, scene: Scene, throw: Any, t0: float, t1: float, most: int) -> tuple[np.ndarray, int] | None:
    number = lambda x: mp.mpf(float(x))  # noqa: E731
    vector = lambda xs: mp.matrix([number(x) for x in np.asarray(xs)])  # noqa: E731
    dot = lambda a, b: (a.T * b)[0]  # noqa: E731
    x, v, w = (vector(part) for part in (throw.position, throw.velocity, throw.spin))
    g, radius = vector(scene.gravity), number(scene.ball.radius)
    planes = []
    for plane in scene.surfaces:
        facing = vector(plane.facing)  # pyright: ignore[reportAttributeAccessIssue]
        planes.append((facing / mp.sqrt(dot(facing, facing)), vector(plane.point), plane.law))  # pyright: ignore
    left, touching, count = number(t1) - number(t0), -1, 0
    while True:
        roots = []
        for i, (n, point, _) in enumerate(planes):
            gap = mp.mpf(0) if i == touching else dot(n, x - point) - radius
            s = _first_root(mp, dot(n, g) / 2, dot(n, v), gap)
            if s is not None and s <= left:
                roots.append((s, i))
        if not roots:
            x = x + left * v + left * left / 2 * g
            return np.array([float(c) for c in x]), count
        roots.sort()
        if count == most or (len(roots) > 1 and roots[1][0] == roots[0][0]):
            return None
        s, touching = roots[0]
        x, v, left, count = x + s * v + s * s / 2 * g, v + s * g, left - s, count + 1
        n, _, law = planes[touching]
        v, w = _struck(mp, scene.ball, law, n, v, w)


def _first_root(mp: Any, a: Any, b: Any, c: Any) -> Any:
    """The first s >= 0 at which a s^2 + b s + c falls through zero. A gap of zero, just left, is no root again."""
    if c <= 0 and b < 0:
        return mp.mpf(0)
    below = b * b - 4 * a * c
    if a == 0:
        return -c / b if b < 0 else None
    if below < 0:
        return None
    for s in sorted([(-b - mp.sqrt(below)) / (2 * a), (-b + mp.sqrt(below)) / (2 * a)]):
        if s > 0 and 2 * a * s + b < 0:
            return s
    return None


def _struck(mp: Any, ball: Any, law: Any, n: Any, v: Any, w: Any) -> tuple[Any, Any]:
    """Velocity and spin after the impulse p at the contact point, r_c = -r n from the centre."""
    number = lambda value: mp.mpf(float(value))  # noqa: E731
    cross = lambda a, b: mp.matrix(  # noqa: E731
        [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
    )
    mass, radius = number(ball.mass), number(ball.radius)
    inertia = number(ball.inertia_ratio) * mass * radius**2
    arm = -radius * n
    point = v + cross(w, arm)
    closing = (n.T * point)[0]
    slip = point - closing * n
    along = -(1 + number(law.restitution)) * mass * closing
    across = mp.matrix([0, 0, 0])
    if not isinstance(law, Smooth):
        reversed_share = law.restitution if law.tangential is None else law.tangential
        across = -(1 + number(reversed_share)) / (1 / mass + radius**2 / inertia) * slip
    if isinstance(law, Frictional):
        needed = mp.norm(across)
        if needed > number(law.friction) * along:
            across = across * (number(law.friction) * along / needed)
    p = along * n + across
    return v + p / mass, w + cross(arm, p) / inertia
