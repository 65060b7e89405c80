"""Where two surfaces meet: joints of flush faces, ramps, kerbs, corners and edges, against the same face in one piece,
closed forms, and each other. Every fault that was found has a test by its name; beside it stands its whole kind."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import result_of, results_of, turned_axes

from nonholo_jax import (
    Air,
    Ball,
    BallState,
    Box,
    Exact,
    Frictional,
    Integrated,
    Plane,
    Rectangle,
    Rough,
    Scene,
    Smooth,
    simulate,
    simulate_batch,
)
from nonholo_jax._math.types import kind_name

R = 0.1
BALL = Ball(R, 1.0)
LAWS = {"rough": Rough(0.5), "smooth": Smooth(0.6), "frictional": Frictional(0.5, 0.1, 0.4)}
laws = pytest.mark.parametrize("law", LAWS.values(), ids=LAWS.keys())


def kinds(trajectory):
    return [kind_name(trajectory.impacts.kind, i) for i in range(int(trajectory.n_rows))]


def pieces(law, cut, turn=None, place=(0.0, 0.0, 0.0)):
    """A table top of 4 m by 2 m at the height 0, in as many pieces as `cut` says, turned as a whole."""
    rotation = (1.0, 0.0, 0.0, 0.0) if turn is None else turn
    axes = np.eye(3) if turn is None else turned_axes(jnp.asarray(turn))
    at = lambda x: jnp.asarray(place, axes.dtype) + jnp.asarray(x, axes.dtype) @ axes  # noqa: E731
    ends = np.linspace(-1.0, 3.0, cut + 1)
    middle, half = 0.5 * (ends[1:] + ends[:-1]), 0.5 * np.diff(ends)
    return {
        f"piece_{i}": Box(at([m, 0.0, -0.5]), (h, 1.0, 0.5), law, rotation=rotation)
        for i, (m, h) in enumerate(zip(middle, half, strict=True))
    }


def rolling(speed, axes=None, place=(0.0, 0.0, 0.0), x=0.0, dtype=float, slip=0.0):
    axes = np.eye(3) if axes is None else axes
    array = lambda *numbers: jnp.stack([jnp.asarray(c, axes.dtype) for c in numbers])  # noqa: E731
    v, spin = array(speed, 0.1 * speed, 0.0), array(-0.1 * speed, speed - slip, 0.3) / R
    parts = (jnp.asarray(place, axes.dtype) + array(x, 0.0, R) @ axes, v @ axes, spin @ axes)
    return BallState(*(part.astype(dtype) for part in parts))


@laws
def test_rolling_over_a_joint(law):
    """e01: nothing happens, whatever the law, the number of the pieces and their order; the log says where."""
    whole = simulate(Scene(BALL, pieces(law, 1)), rolling(1.0, slip=0.5), t1=2.0)
    for cut, orders in ((2, (1,)), (3, (1, -1))):
        for order in orders:
            scene = Scene(BALL, dict(list(pieces(law, cut).items())[::order]))
            t = simulate(scene, rolling(1.0, slip=0.5), t1=2.0)
            for name in ("position", "velocity", "spin"):
                got, want = getattr(t.final, name), getattr(whole.final, name)
                np.testing.assert_allclose(got, want, rtol=0, atol=1e-13 if name != "spin" else 1e-12)
            assert result_of(t) == "reached_t1" and int(t.n_impacts) == int(whole.n_impacts)
            assert (
                kinds(t).count("passed") == int(t.n_passed) == (1 if cut == 2 else 2)
                or float(t.final.position[0]) < 1.7
            )
            rows = [i for i, kind in enumerate(kinds(t)) if kind == "passed"]
            joints = np.linspace(-1.0, 3.0, cut + 1)[1:-1]
            hit = [x for x in joints if 0.0 < x < float(t.final.position[0])]
            np.testing.assert_allclose([float(t.impacts.before.position[i, 0]) for i in rows], hit, atol=1e-12)
            times = np.linspace(0.0, 2.0, 23)
            np.testing.assert_allclose(t.at(times).position, whole.at(times).position, rtol=0, atol=1e-12)


def test_hand_overs_are_no_impacts():
    """They count neither for `max_impacts` nor in the itinerary, and need no room of their own."""
    tiles = {f"t{i}": Rectangle((0.25 * i, 0.0, 0.0), (0, 0, 1), (1, 0, 0), (0.125, 1.0), Rough(0.5)) for i in range(9)}
    t = simulate(Scene(BALL, tiles), rolling(1.0), t1=1.9, max_impacts=2)
    assert result_of(t) == "reached_t1" and int(t.n_impacts) == 1 and int(t.n_passed) == 8
    np.testing.assert_allclose(t.final.position, [1.9, 0.19, R], atol=1e-13)
    shorter = simulate(Scene(BALL, tiles), rolling(1.0), t1=1.9, max_impacts=2, log_size=0)
    np.testing.assert_allclose(shorter.final.position, t.final.position, atol=1e-14)


def test_a_box_let_into_a_floor():
    """e01: the ball rolls on, by the law of the face that it comes onto and then by that of the floor again."""
    floor = Plane((0, 0, 0), (0, 0, 1), Rough(0.5))
    for law, ends in ((Rough(0.3), 4.0), (Smooth(0.5), 4.0), (Frictional(0.5, 0.0, 0.2), 4.0)):
        inlay = Box((2.0, 0.0, -0.05), (1.0, 1.0, 0.05), law)
        for surfaces in ({"floor": floor, "inlay": inlay}, {"inlay": inlay, "floor": floor}):
            t = simulate(Scene(BALL, surfaces), rolling(2.0), t1=2.0)
            np.testing.assert_allclose(t.final.position, [ends, 0.4, R], atol=1e-12)
            passed = [i for i, kind in enumerate(kinds(t)) if kind == "passed"]
            np.testing.assert_allclose(t.impacts.before.position[jnp.asarray(passed), 0], [1.0, 3.0], atol=1e-12)
            names = [list(surfaces)[int(t.impacts.support[i])] for i in passed]
            assert names == ["inlay", "floor"]


def test_the_law_changes_at_a_joint():
    """A sliding ball comes from ice onto cloth: it keeps its spin on the ice, slows down at f g on the cloth, and rolls
    after that. By hand."""
    ice = Box((0.0, 0.0, -0.5), (1.0, 1.0, 0.5), Smooth(0.5))
    cloth = Box((6.0, 0.0, -0.5), (5.0, 1.0, 0.5), Frictional(0.5, 0.0, 0.2))
    state = BallState([0.0, 0.0, R], [2.0, 0.0, 0.0], [0.0, 0.0, 0.0])
    t = simulate(Scene(BALL, {"ice": ice, "cloth": cloth}), state, t1=1.0)
    slows, g = 0.2 * 9.81, 9.81
    grips = 2.0 / (0.2 * g * (1 + 1 / 0.4))  # the slip of 2 m/s dies out at f g (1 + 1/alpha)
    assert float(t.at(0.49).spin[1]) == 0.0
    rest = 0.5 - grips
    x = 1.0 + 2.0 * grips - 0.5 * slows * grips**2 + (2.0 - slows * grips) * rest
    np.testing.assert_allclose(t.final.position[0], x, atol=1e-12)
    np.testing.assert_allclose(t.final.velocity[0], 2.0 - slows * grips, atol=1e-12)
    assert [kind for kind in kinds(t) if kind in ("passed", "gripped")] == ["passed", "gripped"]


@functools.cache
def turned_motions(law_name, cut, with_air, dtype):
    """The final states of balls that roll over pieces turned in every direction, without gravity turning with them."""
    law = LAWS[law_name]
    air = Air(lift=0.1) if with_air else None

    def one(turn, place, speed):
        axes = turned_axes(turn)
        gravity = jnp.asarray([0.0, 0.0, -9.81], dtype) @ axes
        surfaces = pieces(law, cut, turn, place)
        scene = Scene(BALL, surfaces, gravity=gravity, air=air)
        state = rolling(speed, axes, place, dtype=dtype)
        motion = Integrated(rtol=1e-11, atol=1e-11) if with_air else None
        t = simulate(scene, state, t1=jnp.asarray(1.6, dtype), motion=motion, throw=False)
        back = lambda x: axes @ x  # noqa: E731
        return back(t.final.position - place), back(t.final.velocity), t.result._value, t.n_impacts

    rng = np.random.default_rng(3)
    turns = rng.normal(size=(40, 4))
    turns = turns / np.linalg.norm(turns, axis=1, keepdims=True)
    places = rng.uniform(-2, 2, (40, 3))
    arrays = (jnp.asarray(x, dtype) for x in (turns, places, rng.uniform(0.8, 1.6, 40)))
    return [np.asarray(x, float) for x in jax.jit(jax.vmap(one))(*arrays)]


@pytest.mark.parametrize(
    "law_name, with_air", [("rough", False), ("smooth", False), ("frictional", False), ("rough", True)]
)
def test_turned_copies_of_a_joint(law_name, with_air):
    """rolling_on_tilted_box, and its joints: pieces of a table turned in space carry the ball as one does."""
    for dtype, bound in ((jnp.float64, 1e-9), (jnp.float32, 2e-3)):
        if with_air and dtype == jnp.float32:
            continue
        one, two = (turned_motions(law_name, cut, with_air, dtype) for cut in (1, 2))
        assert np.all(one[2] == 0) and np.all(two[2] == 0)
        np.testing.assert_allclose(two[0], one[0], rtol=0, atol=bound)
        np.testing.assert_allclose(two[1], one[1], rtol=0, atol=bound)
        assert np.max(abs(one[0][:, 2] - R)) < (1e-12 if dtype == jnp.float64 else 1e-5)


@laws
def test_a_slow_ball_stays_on_its_support_when_it_comes_to_a_wall(law):
    """It was lifted off, where rounding of gravity had given it a velocity across that was no rounding of its own."""

    @jax.jit
    @jax.vmap
    def run(turn, place):
        axes = turned_axes(turn)
        wall = Plane(place + 0.14 * axes[0], -axes[0], law)
        scene = Scene(BALL, pieces(law, 1, turn, place) | {"wall": wall}, gravity=jnp.asarray([0.0, 0.0, -9.81]) @ axes)
        state = rolling(0.02, axes, place, dtype=jnp.float64)
        t = simulate(scene, state, t1=6.0, motion=Exact(), throw=False, log_size=0)
        return axes @ (t.final.position - place), axes @ t.final.velocity

    rng = np.random.default_rng(5)
    turns = rng.normal(size=(100, 4))
    places, velocities = run(turns / np.linalg.norm(turns, axis=1, keepdims=True), rng.uniform(-2, 2, (100, 3)))
    np.testing.assert_allclose(velocities[:, 0], velocities[0, 0], rtol=1e-9)
    np.testing.assert_allclose(places[:, 2], R, rtol=0, atol=1e-9)
    assert np.all(np.asarray(velocities[:, 0]) < 0)


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
@laws
def test_landing_beside_a_joint(law, dtype):
    """e02: it bounces as on one face, however near the joint is."""
    h, v = 0.3, 3.0
    fall = np.sqrt(2 * h / 9.81)
    scales = np.concatenate([10.0 ** -np.arange(1, 17), [0.0]])
    off = np.concatenate([scales, -scales, np.linspace(-0.004, 0.004, 201)])
    place = np.c_[off - v * fall, 0.1 + 0 * off, 0 * off + R + h]
    throws = BallState(
        *(jnp.asarray(x, dtype) for x in (place, np.tile([v, 0.2, 0.0], (off.size, 1)), 0 * place + [0.0, 5.0, 1.0]))
    )
    options = {"t1": jnp.asarray(1.5 * fall, dtype), "max_impacts": 8, "log_size": 0}
    halves = simulate_batch(Scene(BALL, pieces(law, 2)), throws, **options)
    whole = simulate_batch(Scene(BALL, pieces(law, 1)), throws, **options)
    bound = 1e-12 if dtype == jnp.float64 else 2e-4
    assert set(results_of(halves)) == {"reached_t1"}
    np.testing.assert_allclose(halves.final.velocity, whole.final.velocity, rtol=0, atol=bound)
    np.testing.assert_allclose(R * halves.final.spin, R * whole.final.spin, rtol=0, atol=bound)


@pytest.mark.parametrize("law", [LAWS["rough"], LAWS["frictional"]], ids=["rough", "frictional"])
def test_bounces_that_die_out_over_a_joint(law):
    """e02: the last of them hits the edge of the piece that is left; the other piece holds the ball, to rounding."""
    off, place = np.linspace(-4e-4, 4e-4, 200), np.array([0.0, 0.0, R + 0.02])
    state = lambda x: BallState(*(jnp.asarray(c, jnp.float32) for c in (x, [0.4, 0.1, 0.0], [0.0, 1.0, 0.3])))  # noqa: E731
    options = {"t1": jnp.float32(1.0), "max_impacts": 64, "motion": Exact()}
    whole = simulate(Scene(BALL, pieces(law, 1)), state(place), log_size=8, **options)
    end = float(whole.at(whole.impacts.until[whole.n_rows - 1]).position[0])  # where they have died out

    places = place + np.c_[1.0 - end + off, 0.0 * off, 0.0 * off]  # the joint is at x = 1
    state = jax.vmap(state)(jnp.asarray(places))
    halves = simulate_batch(Scene(BALL, pieces(law, 2)), state, log_size=0, **options)
    assert set(results_of(halves)) == {"reached_t1"}
    gone = halves.final.position - state.position
    np.testing.assert_allclose(gone, np.tile(np.asarray(whole.final.position) - place, (200, 1)), rtol=0, atol=2e-6)
    np.testing.assert_allclose(halves.final.velocity, np.tile(whole.final.velocity, (200, 1)), rtol=0, atol=2e-6)
    np.testing.assert_allclose(halves.final.spin, np.tile(whole.final.spin, (200, 1)), rtol=0, atol=2e-5)


@laws
@pytest.mark.parametrize("plastic", [False, True])
def test_down_a_ramp_onto_the_floor(law, plastic):
    """e03: the floor alone; the ramp would have to pull. (v cos, 0, e v sin), by each law's own slip."""
    angle = np.deg2rad(10.0)
    n, down = np.array([np.sin(angle), 0, np.cos(angle)]), np.array([np.cos(angle), 0, -np.sin(angle)])
    import equinox as eqx

    law = eqx.tree_at(lambda each: each.restitution, law, 0.0) if plastic else law
    planes = {"ramp": Plane((0, 0, 0), tuple(n), law), "floor": Plane((0, 0, 0), (0, 0, 1), law)}
    for surfaces in (planes, dict(list(planes.items())[::-1])):
        t = simulate(Scene(BALL, surfaces), BallState(R * n - down, [0.0] * 3, [0.0] * 3), t1=2.0, max_impacts=200)
        hit = [i for i in range(int(t.n_rows)) if list(surfaces)[int(t.impacts.surface[i])] == "floor"][0]
        before, after = (jax.tree.map(lambda x, hit=hit: x[hit], s) for s in (t.impacts.before, t.impacts.after))
        slip = before.velocity - R * jnp.cross(before.spin, jnp.asarray([0.0, 0.0, 1.0]))
        slip = slip.at[2].set(0.0)
        speed = float(jnp.sqrt(slip @ slip))
        s = law.slip_factor(0.4, abs(float(before.velocity[2])), speed**2)
        vertical = -law.restitution * float(before.velocity[2])
        want = np.asarray(before.velocity) - s * np.asarray(slip)
        # A plastic impact is a train of one: from then on it rolls, or slides.
        if plastic and law.rolls and law.sliding_friction() is None:
            assert float(t.final.velocity[2]) == 0.0 and float(t.final.velocity[0]) > 1.0
        else:
            np.testing.assert_allclose(after.velocity, [want[0], 0.0, vertical], atol=1e-12)
        assert float(t.final.position[0]) > 1.0 and abs(float(t.final.position[2]) - R) < 1e-9


def test_ramp_by_hand():
    angle = np.deg2rad(10.0)
    n, down = np.array([np.sin(angle), 0, np.cos(angle)]), np.array([np.cos(angle), 0, -np.sin(angle)])
    scene = Scene(
        BALL, {"ramp": Plane((0, 0, 0), tuple(n), Smooth(0.5)), "floor": Plane((0, 0, 0), (0, 0, 1), Smooth(0.5))}
    )
    t = simulate(scene, BallState(R * n - down, [0.0] * 3, [0.0] * 3), t1=2.0, max_impacts=200)
    # The centre's way on the ramp ends where both are touched, R tan(angle / 2) before the foot.
    v = np.sqrt(2 * 9.81 * np.sin(angle) * (1.0 - R * np.tan(angle / 2)))
    np.testing.assert_allclose(
        t.impacts.after.velocity[1], [v * np.cos(angle), 0.0, 0.5 * v * np.sin(angle)], atol=1e-12
    )


@pytest.mark.parametrize("kerb", [0.02, 0.06, 0.12])
def test_against_a_kerb(kerb):
    """A kerb lower than the centre lets the floor go, a higher one does not: then both are hit."""
    for law in (Smooth(0.5), Rough(0.5)):
        scene = Scene(
            BALL, {"floor": Plane((0, 0, 0), (0, 0, 1), law), "kerb": Box((2.0, 0.0, kerb - 1.0), (1.0, 1.0, 1.0), law)}
        )
        t = simulate(scene, rolling(2.0, slip=0.0), t1=0.6, max_impacts=200)
        n, v = np.asarray(t.impacts.normal[1]), np.asarray(t.impacts.before.velocity[1])
        after = np.asarray(t.impacts.after.velocity[1])
        np.testing.assert_allclose(n, [-np.sqrt(1 - (1 - min(kerb / R, 1)) ** 2), 0.0, 1 - min(kerb / R, 1)], atol=1e-9)
        np.testing.assert_allclose(n @ after, -0.5 * (n @ v), atol=1e-12)
        assert (after[2] > 0.01) == (kerb < R)


@pytest.mark.parametrize(
    "cloth, rail", [(Rough(0.85), Rough(0.85)), (Frictional(0.5, 0.0, 0.2), Frictional(0.85, 0.0, 0.2))]
)
def test_rolling_into_a_square_corner(cloth, rail):
    """e06: symmetric, whatever the order; with (4.2) stacked over floor and both walls v+ = -0.85 v."""
    r, v = 0.028575, np.sqrt(2.0)
    planes = {
        "cloth": Plane((0, 0, 0), (0, 0, 1), cloth),
        "x": Plane((4.5, 0, 0), (-1, 0, 0), rail),
        "y": Plane((0, 4.5, 0), (0, -1, 0), rail),
    }
    for order in (("cloth", "x", "y"), ("y", "cloth", "x")):
        scene = Scene(Ball(r, 0.17), {name: planes[name] for name in order})
        t = simulate(scene, BallState([1, 1, r], [v, v, 0], [-v / r, v / r, 0]), t1=3.0)
        np.testing.assert_allclose(t.final.position[0], t.final.position[1], atol=1e-12)
        np.testing.assert_allclose(t.final.velocity[0], t.final.velocity[1], atol=1e-13)
        hit = kinds(t).index("rolling") if "train" not in kinds(t) else kinds(t).index("rolling", 1)
        np.testing.assert_allclose(
            t.impacts.after.velocity[hit], -0.85 * np.asarray(t.impacts.before.velocity[hit]), atol=1e-12
        )


@pytest.mark.parametrize("last", [True, False])
def test_a_corner_among_many_surfaces(last):
    """More surfaces than are looked at: what is not touched changes nothing, wherever it stands in the scene."""
    law = Frictional(0.7, 0.2, 0.3)
    corner = {"floor": Plane((0, 0, 0), (0, 0, 1), law), "x": Plane((1, 0, 0), (-1, 0, 0), law)}
    others = {f"far_{i}": Box((-5.0 - i, 0, 0), (0.3, 0.3, 0.3), law) for i in range(9)}
    state = BallState([1 - R - 0.3, 0.0, R + 0.3], [1.0, 0.2, -1.0], [3.0, 20.0, 1.0])
    few = simulate(Scene(BALL, corner, gravity=(0, 0, 0)), state, t1=0.5)
    surfaces = {**others, **corner} if last else {**corner, **others}
    many = simulate(Scene(BALL, surfaces, gravity=(0, 0, 0)), state, t1=0.5)
    assert int(few.n_impacts) == int(many.n_impacts) == 1
    np.testing.assert_allclose(many.final.velocity, few.final.velocity, atol=1e-13)
    np.testing.assert_allclose(many.final.spin, few.final.spin, atol=1e-12)


@pytest.mark.parametrize("place", ["nose", "wall"])
def test_the_same_cushion_by_four_laws(place):
    """s10b: no friction is smooth, and so is e_t = -1."""
    r = 0.02625
    table = Plane((0, 0, 0), (0, 0, 1), Frictional(0.5, 0.0, 0.212))
    finals = []
    for law in (Smooth(0.98), Frictional(0.98, 0.0, 0.0), Frictional(0.98, 0.0, 1e-12), Rough(0.98, -1.0)):
        cushion = (
            Box((0.6, 0, 1.4 * r + 0.05), (0.1, 1.0, 0.05), law)
            if place == "nose"
            else Plane((0.5, 0, 0), (-1, 0, 0), law)
        )
        state = BallState([0.3, 0, r], [1.0, 0, 0], [0, 1.0 / r, 0])
        t = simulate(Scene(Ball(r, 0.1406), {"table": table, "cushion": cushion}), state, t1=1.2)
        hit = int(np.argmax(np.asarray(t.impacts.surface) == 1))
        np.testing.assert_allclose(t.impacts.after.velocity[hit], [-0.98, 0.0, 0.0], atol=1e-12)
        finals.append(np.concatenate([t.final.velocity, r * t.final.spin]))
    np.testing.assert_allclose(finals, [finals[0]] * 4, atol=1e-11)
    rolls = lambda spin: (0.98 - 0.4 * spin) / 1.4  # once it rolls, by the angular momentum about the contact  # noqa: E731
    pressed = 1.0
    if place == "nose":  # J = 1.98 / (cos b - f sin b), f J sin b of which slows the topspin down
        b = np.arcsin(0.4)
        pressed = 1.0 - 0.212 * np.sin(b) * 1.98 / (np.cos(b) - 0.212 * np.sin(b)) / 0.4
    np.testing.assert_allclose(finals[0][0], -rolls(pressed), atol=1e-9)


@pytest.mark.parametrize("kind, dtype", [("box", "float64"), ("rectangle", "float64"), ("box", "float32")])
def test_rolling_off_a_tilted_edge(kind, dtype):
    """rolling_off_tilted_edge: it leaves once, and falls freely from there, by the closed form."""
    r, reach, speed, t1, g = 0.05, 0.4, 1.0, 0.6, 9.81

    def end(angle, yaw):
        c, s, cy, sy = jnp.cos(angle), jnp.sin(angle), jnp.cos(yaw), jnp.sin(yaw)
        turn = lambda v: jnp.stack([cy * v[0] - sy * v[1], sy * v[0] + cy * v[1], v[2]])  # noqa: E731
        n, down = turn(jnp.stack([s, 0 * s, c])), turn(jnp.stack([c, 0 * s, -s]))
        a, b, u, w = jnp.cos(angle / 2), jnp.sin(angle / 2), jnp.cos(yaw / 2), jnp.sin(yaw / 2)
        box = Box(-0.1 * n, (reach, reach, 0.1), Rough(0.5), rotation=jnp.stack([u * a, -w * b, u * b, w * a]))
        it = box if kind == "box" else Rectangle(0.0 * n, n, down, (reach, reach), Rough(0.5))
        state = BallState(r * n, speed * down, jnp.cross(n, speed * down) / r)
        t = simulate(Scene(Ball(r, 1.0), {"slope": it}), state, t1=t1, throw=False)
        return t.final.position, t.n_impacts, t.result._value, n, down

    rng = np.random.default_rng(0)
    angles, yaws = rng.uniform(0.0, 0.5, 400), rng.uniform(-3.0, 3.0, 400)
    x, impacts, result, n, down = map(np.asarray, jax.jit(jax.vmap(end))(angles.astype(dtype), yaws.astype(dtype)))
    pull = g * np.sin(angles) / 1.4
    at_edge = (-speed + np.sqrt(speed**2 + 2 * pull * reach)) / pull
    fast, fly = speed + pull * at_edge, t1 - at_edge
    right = r * n + (reach + fast * fly)[:, None] * down + np.array([0, 0, -0.5 * g]) * fly[:, None] ** 2
    assert np.all(result == 0) and np.max(impacts) <= 2
    np.testing.assert_allclose(x, right, rtol=0, atol=1e-9 if dtype == "float64" else 2e-5)


def test_derivatives_over_a_joint():
    """Of the whole way over joints, into the square corner and down the ramp, against differences."""
    tiles = pieces(Frictional(0.5, 0.1, 0.4), 3)
    wall = Plane((2.6, 0.0, 0.0), (-1.0, 0.2, 0.0), Rough(0.8, 0.3))
    scene = Scene(BALL, {**tiles, "wall": wall})

    def end(x):
        state = BallState(jnp.stack([x[0], 0.0 * x[0], R + 0.0 * x[0]]), x[1:4] * jnp.asarray([1.0, 1.0, 0.0]), x[4:])
        return simulate(scene, state, t1=1.4, motion=Exact()).final.position

    x = jnp.asarray([0.1, 2.0, 0.3, 0.0, 0.0, 5.0, 0.0])
    forward = jax.jit(jax.jacfwd(end))(x)
    reverse = jax.jit(jax.jacrev(end))(x)
    run, h = jax.jit(end), 1e-6
    columns = [0, 1, 5]
    differences = np.stack([(run(x.at[i].add(h)) - run(x.at[i].add(-h))) / (2 * h) for i in columns], axis=1)
    np.testing.assert_allclose(forward[:, jnp.asarray(columns)], differences, rtol=1e-6, atol=1e-7)
    np.testing.assert_allclose(reverse, forward, rtol=1e-9, atol=1e-10)
