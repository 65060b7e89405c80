"""Impacts on everything that is touched: which surfaces take part, and what they do, against NumPy and the paper."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from nonholo_jax import Ball, Frictional, Rough, Smooth, collide
from nonholo_jax._impact.together import Touched, _pseudo_inverse, loaded, reflected, takes_part

ALPHA, R = 0.4, 0.1
SIZES = [1, 2, 3, 4, 6]
laws_of_one_kind = pytest.mark.parametrize("law", [Rough(0.6), Rough(0.9, 0.2), Smooth(0.7)], ids=repr)


def touched_by(laws, normals, support=None):
    """Surfaces with those laws, all of which take part; `support` is the number of one, or of the two of a groove."""
    supports = support if isinstance(support, tuple) else (support,)
    held = jnp.asarray([[i == each for i in range(len(laws))] for each in supports])
    restitution = jnp.stack([jnp.asarray(law.restitution) for law in laws])
    return Touched(jnp.asarray(normals), jnp.ones(len(laws), bool), held, restitution)


def factors_of(laws):
    def factors(closing, squared):
        return jnp.stack([jnp.asarray(law.slip_factor(ALPHA, closing[i], squared[i])) for i, law in enumerate(laws)])

    return factors


def impact(laws, normals, velocity, spin, support=None, friction=None, grips=1.0, counts=None):
    touched = touched_by(laws, normals, support)
    touched = touched if counts is None else touched._replace(takes_part=jnp.asarray(counts))
    count = len(support) if isinstance(support, tuple) else 1
    friction = None if friction is None else tuple(jnp.broadcast_to(friction, (count,)))
    grips = tuple(jnp.broadcast_to(grips, (count,)))
    after = reflected(R, ALPHA, touched, factors_of(laws), friction, grips, tuple(velocity), tuple(spin))
    return jnp.stack(after[0]), jnp.stack(after[1])


def random_normals(rng, k):
    x = rng.normal(size=(k, 3)) + [0.0, 0.0, 0.7]
    return x / np.linalg.norm(x, axis=1, keepdims=True)


def state_of(rng):
    return jnp.asarray(rng.normal(size=3)), jnp.asarray(rng.normal(size=3) / R)


def rows_of(n, rough):
    """B of one surface on (velocity, spin)."""
    turn = -R * np.cross(np.eye(3), n).T  # -r (omega x n), as a matrix on omega
    return np.hstack([np.eye(3), turn]) if rough else np.hstack([n, np.zeros(3)])[None]


METRIC = np.diag([1.0] * 3 + [ALPHA * R * R] * 3)


def project(rows):
    """The projector of Lemma 1, by NumPy's pseudo-inverse in the coordinates in which the metric is the identity."""
    scale = np.sqrt(np.diag(METRIC))
    w = rows / scale
    return (np.linalg.pinv(w, rcond=1e-10) @ w) * scale / scale[:, None]


def energy(velocity, spin):
    return float(np.sum(np.asarray(velocity) ** 2) + ALPHA * R * R * np.sum(np.asarray(spin) ** 2))


@pytest.mark.parametrize("k", SIZES)
def test_pseudo_inverse(k):
    rng = np.random.default_rng(k)
    rows = rng.normal(size=(k, 6))
    rows[k // 2] = rows[0]
    np.testing.assert_allclose(_pseudo_inverse(jnp.asarray(rows)), np.linalg.pinv(rows), atol=1e-13)
    check_grads(lambda factor: _pseudo_inverse(factor * jnp.asarray(rows)), (1.3,), 2, atol=1e-6, rtol=1e-6)


def nearest_that_leaves(normals, v):
    """The nearest velocity that closes on nothing, by Dykstra's alternating projections."""
    x, rests = np.array(v, float), np.zeros((len(normals), 3))
    for _ in range(20_000):
        for i, n in enumerate(normals):
            y = x + rests[i]
            x = y - min(n @ y, 0.0) * n
            rests[i] = y - x
    return x


@pytest.mark.parametrize("k", SIZES)
def test_projection_of_moreau(k):
    rng = np.random.default_rng(10 + k)
    find = jax.jit(loaded)
    for _ in range(20):
        normals, v = random_normals(rng, k), rng.normal(size=3)
        counts, nearest = find(touched_by([Smooth()] * k, normals), jnp.asarray(v))
        assert np.min(normals @ np.asarray(nearest)) > -1e-12
        # The conditions of Kuhn and Tucker, which only the nearest one fulfils.
        impulse, part = np.asarray(nearest) - v, np.asarray(counts)
        assert np.all(abs(normals[part] @ np.asarray(nearest)) < 1e-13)
        if part.any():
            load = np.linalg.lstsq(normals[part].T, impulse, rcond=None)[0]
            np.testing.assert_allclose(normals[part].T @ load, impulse, atol=1e-13)
            assert part.sum() > 3 or np.all(load > 0)
        else:
            assert np.all(impulse == 0)
    np.testing.assert_allclose(nearest, nearest_that_leaves(normals, v), atol=1e-6)


def test_all_share_a_load_that_can_be_shared():
    c = np.sqrt(0.5)
    pit = [(c, 0, c), (-c, 0, c), (0, c, c), (0, -c, c)]
    for v in ([0.0, 0.0, -1.0], [0.1, 0.05, -1.0]):
        counts, nearest = loaded(touched_by([Smooth()] * 4, pit), jnp.asarray(v))
        assert np.all(counts) and np.max(abs(np.asarray(nearest))) < 1e-15
    counts, _ = loaded(touched_by([Smooth()] * 4, pit), jnp.asarray([0.0, -1.0, 0.0]))
    assert list(np.asarray(counts)) == [False, False, True, False]


def test_which_surfaces_hold_a_rolling_ball():
    """A ramp, a kerb and a wall that leans away let go; a square wall and a nose above the centre do not."""
    floor, v = (0.0, 0.0, 1.0), jnp.asarray([1.0, 0.0, 0.0])
    for angle, both in ((0.3, False), (0.0, True), (-0.3, True)):
        wall = (-np.cos(angle), 0.0, np.sin(angle))
        parts, stays = takes_part(touched_by([Rough()] * 2, [floor, wall], support=0), v)
        assert list(np.asarray(parts)) == [both, True] and list(np.asarray(stays)) == [both]
    # Down a ramp onto the floor: the floor alone.
    ramp = (np.sin(0.2), 0.0, np.cos(0.2))
    parts, stays = takes_part(
        touched_by([Rough()] * 2, [ramp, floor], support=0), jnp.asarray([np.cos(0.2), 0.0, -np.sin(0.2)])
    )
    assert list(np.asarray(parts)) == [False, True] and list(np.asarray(stays)) == [False]


@laws_of_one_kind
@pytest.mark.parametrize("k", SIZES)
def test_one_law(law, k):
    """v - (1 + e_n) P_n v - (1 + e_t) (P - P_n) v; with one coefficient it is (4.2)."""
    rng = np.random.default_rng(k)
    for _ in range(3):
        normals, (v, spin) = random_normals(rng, k), state_of(rng)
        z = np.concatenate([v, spin])
        p_n = project(np.vstack([rows_of(n, False) for n in normals]))
        rows = np.vstack([rows_of(n, bool(law.rolls)) for n in normals])
        e_n, e_t = law.restitution, law.reversal()
        want = z - (1 + e_n) * p_n @ z - (1 + e_t) * (project(rows) - p_n) @ z
        got = np.concatenate(impact([law] * k, normals, v, spin))
        np.testing.assert_allclose(got, want, rtol=0, atol=1e-11 * np.max(abs(z)))
        if e_n == e_t:
            paper = collide(jnp.asarray(z), jnp.asarray(METRIC), jnp.asarray(rows), e_n)
            np.testing.assert_allclose(got, paper, rtol=0, atol=1e-11 * np.max(abs(z)))


MIXED = (Rough(0.9, 0.3), Frictional(0.5, 0.0, 0.3), Smooth(0.8), Frictional(0.7, 0.4, 2.0), Rough(0.6))


@functools.cache
def mixed_impacts():
    """Impacts on up to four surfaces of different laws, with or without a support, for a batch of throws."""
    several = [MIXED[:2], MIXED[1:4], MIXED[2:] + MIXED[:1]]
    return [(laws, support) for laws in several for support in (None, 0)]


def mixed(laws, support):
    friction = None if support is None else laws[support].sliding_friction()
    friction = jnp.asarray(jnp.inf if friction is None else friction)
    grips = 0.0 if support is None else float(bool(laws[support].rolls))

    def run(normals, v, spin):
        touched = touched_by(laws, normals, support)
        parts, _ = takes_part(touched, v)
        return *impact(laws, normals, v, spin, support, friction, grips, parts), parts

    return jax.jit(jax.vmap(run))


def throws_at(rng, k, support, count=40):
    """Normals and states; with a support, of a ball that rolls on it against the others."""
    normals = np.stack([random_normals(rng, k) for _ in range(count)])
    v, spin = rng.normal(size=(count, 3)), rng.normal(size=(count, 3)) / R
    if support is not None:
        n = normals[:, support]
        v = v - np.sum(v * n, axis=1, keepdims=True) * n
        spin = np.cross(n, v) / R + np.sum(spin * n, axis=1, keepdims=True) * n
    return normals, v, spin


def test_different_laws_keep_what_they_have_to():
    """Energy never grows; a kept support neither pulls the ball in nor lets it go; normal velocities reverse; and the
    order of the surfaces does not matter."""
    rng = np.random.default_rng(5)
    for laws, support in mixed_impacts():
        k = len(laws)
        normals, v, spin = throws_at(rng, k, support)
        after, turned, parts = (np.asarray(x) for x in mixed(laws, support)(*map(jnp.asarray, (normals, v, spin))))
        before_energy = np.sum(v**2, axis=1) + ALPHA * R * R * np.sum(spin**2, axis=1)
        after_energy = np.sum(after**2, axis=1) + ALPHA * R * R * np.sum(turned**2, axis=1)
        assert np.all(after_energy <= before_energy * (1 + 1e-12))
        for i in range(len(v)):
            rates = normals[i] @ np.stack([v[i], after[i]], axis=1)
            if support is not None and parts[i, support]:
                assert abs(rates[support, 1]) < 1e-12
            few = np.flatnonzero(parts[i])
            if len(few) == 1:  # one surface reverses by its own coefficient
                np.testing.assert_allclose(rates[few, 1], -laws[few[0]].restitution * rates[few, 0], atol=1e-12)
        order = [*range(1, k), 0]
        moved = None if support is None else order.index(support)
        again = mixed(tuple(laws[i] for i in order), moved)(*map(jnp.asarray, (normals[:, order], v, spin)))
        np.testing.assert_allclose(again[0], after, atol=1e-11)
        np.testing.assert_allclose(again[1], turned, atol=1e-11 / R)
        assert np.array_equal(again[2], parts[:, order])


def test_turned_copies_agree():
    rng = np.random.default_rng(6)
    turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    turn = turn * np.linalg.det(turn)
    for laws, support in mixed_impacts()[1::2]:
        normals, v, spin = throws_at(rng, len(laws), support)
        run = mixed(laws, support)
        after, turned, _ = run(*map(jnp.asarray, (normals, v, spin)))
        copy = run(*map(jnp.asarray, (normals @ turn.T, v @ turn.T, spin @ turn.T)))
        np.testing.assert_allclose(copy[0], np.asarray(after) @ turn.T, atol=1e-11)
        np.testing.assert_allclose(copy[1], np.asarray(turned) @ turn.T, atol=1e-10)


def test_a_row_that_is_nearly_zero_is_not_a_direction_of_its_own():
    """A ball that rolls straight to a wall keeps of two slips there one. However the wall's two tangents are turned
    about its normal, also so that one of them has nearly nothing of that slip, the ball stays on its support."""
    law, v, spin = Rough(0.6, 0.3), jnp.asarray([1.2, -1.0, 0.0]), jnp.asarray([10.0, 12.0, -2.6])
    run = jax.jit(lambda normals, v, spin: impact([law, law], normals, v, spin, support=0))
    expected = run(jnp.asarray([(0.0, 0.0, 1.0), (-1.0, 0.0, 0.0)]), v, spin)
    assert float(expected[0][2]) == 0.0
    for angle in np.concatenate([10.0 ** -np.arange(1.0, 17.0), np.linspace(0.1, 1.5, 8)]):
        c, s = np.cos(angle), np.sin(angle)
        turn = np.array([(1.0, 0.0, 0.0), (0.0, c, -s), (0.0, s, c)])
        normals = np.array([(0.0, 0.0, 1.0), (-1.0, 0.0, 0.0)]) @ turn.T
        after = run(jnp.asarray(normals), turn @ v, turn @ spin)
        assert abs(after[0] @ normals[0]) < 1e-13
        few = 1e-14 / max(angle, 1e-13)  # a tangent that is turned away from the slip says little of its direction
        np.testing.assert_allclose(turn.T @ after[0], expected[0], rtol=0, atol=max(1e-13, few))
        np.testing.assert_allclose(turn.T @ after[1], expected[1], rtol=0, atol=max(1e-13, few) / R)


def test_laws_go_over_into_each_other():
    """No friction is a smooth surface, much of it a rough one, whatever the others are, and e_t = -1 keeps the slip."""
    rng = np.random.default_rng(7)
    normals = random_normals(rng, 3)
    v, spin = -jnp.asarray(normals.sum(axis=0)), state_of(rng)[1]
    assert np.all(loaded(touched_by(MIXED[:3], normals), v)[0])
    for other in MIXED:
        of = lambda law, other=other: np.concatenate(impact([other, law, other], normals, v, spin))  # noqa: E731
        smooth = of(Smooth(0.8))
        for same in (Frictional(0.8, 0.3, 0.0), Rough(0.8, -1.0), Frictional(0.8, -1.0, 0.5)):
            np.testing.assert_allclose(of(same), smooth, rtol=0, atol=1e-11)
        for small in (1e-6, 1e-9):
            np.testing.assert_allclose(of(Frictional(0.8, 0.3, small)), smooth, rtol=0, atol=1e3 * small)
            np.testing.assert_allclose(of(Rough(0.8, -1.0 + small)), smooth, rtol=0, atol=1e3 * small)
        np.testing.assert_allclose(of(Frictional(0.8, 0.3, 1e9)), of(Rough(0.8, 0.3)), rtol=0, atol=1e-11)


def test_levels_that_are_known_are_those_that_are_found():
    """The shorter program for laws without friction whose numbers are constants."""
    rng = np.random.default_rng(9)
    laws = [Rough(0.6), Rough(0.9, 0.2), Smooth(0.7), Rough(0.5, 0.2)]
    touched, (v, spin) = touched_by(laws, random_normals(rng, 4)), state_of(rng)
    options = (R, ALPHA, touched, factors_of(laws), None, (0.0,), tuple(v), tuple(spin))
    known = reflected(*options, levels=(1.6, 1.2))
    np.testing.assert_allclose(np.concatenate(known), np.concatenate(reflected(*options)), rtol=0, atol=1e-12)


def test_dropped_into_a_valley_it_comes_straight_back():
    c = np.sqrt(0.5)
    for law in (Rough(0.5), Rough(0.5, -0.3), Rough(0.5, 0.9), Smooth(0.5), Frictional(0.5, 0.2, 0.4)):
        after, turned = impact([law, law], [(c, 0, c), (-c, 0, c)], jnp.asarray([0.0, 0.0, -2.0]), jnp.zeros(3))
        np.testing.assert_allclose(after, [0.0, 0.0, 1.0], atol=1e-14)
        np.testing.assert_allclose(turned, 0.0, atol=1e-12)


@pytest.mark.parametrize("friction", [0.05, 0.3, jnp.inf])
def test_a_cushion_presses_the_ball_on_the_table(friction):
    """By hand: the nose gives J (-cos b, 0, -sin b), the table J sin b upwards and at most f J sin b along it."""
    b = 0.4
    nose = (-np.cos(b), 0.0, -np.sin(b))
    laws = [Frictional(0.5, 0.0, 1.0), Smooth(0.9)]
    v, spin = jnp.asarray([1.0, 0.0, 0.0]), jnp.asarray([0.0, 1.0 / R, 0.0])
    after, turned = impact(laws, [(0.0, 0.0, 1.0), nose], v, spin, 0, jnp.asarray(friction))
    np.testing.assert_allclose(after, [-0.9, 0.0, 0.0], atol=1e-13)  # n . v+ = -e n . v
    # x: -J cos b + F = -1.9; F turns the ball: alpha r d(omega) = -F, |F| <= f J sin b, and no more than rolling needs.
    if np.isinf(friction):
        assert float(turned[1]) == pytest.approx(-0.9 / R)
    else:
        change = ALPHA * R * (float(turned[1]) - 1.0 / R)
        push = (1.9 - change) / np.cos(b)
        assert change == pytest.approx(-friction * push * np.sin(b))
    assert float(turned[1]) * R >= -0.9 - 1e-12


def test_no_friction_where_the_ball_is_lifted():
    """A ball that rolls and spins meets a rough post that lifts it off its support, which holds it all the same, but
    gives no friction against that. In one of 100,352 random motions in a bowl with a post it gave fifty times what
    rolling needs, the other way, and the energy jumped from -12 to 101 J/kg."""
    rng, n, laws = np.random.default_rng(3), 4000, [Frictional(0.2, 0.1, 0.9), Frictional(0.2, 0.1, 0.8)]

    @jax.jit
    @jax.vmap
    def run(normals, v, spin, friction):
        parts, _ = takes_part(touched_by(laws, normals, 0), v)
        return impact(laws, normals, v, spin, 0, friction, counts=parts)

    normals, v, spin = throws_at(rng, 2, 0, n)
    spin = spin + rng.normal(size=(n, 1)) * 20.0 / R * normals[:, 0]
    after, turned = (np.asarray(x) for x in run(*map(jnp.asarray, (normals, v, spin, rng.uniform(0.0, 1.0, n)))))
    size = lambda v, spin: np.sum(v**2, axis=1) + ALPHA * R * R * np.sum(spin**2, axis=1)  # noqa: E731
    assert np.all(size(after, turned) <= size(v, spin) * (1 + 1e-12))


def in_groove(rng, count=20):
    """Normals of two sides and of what a ball meets there that rolls along, held or not by the second side."""
    for i in range(count):
        one, two, third = random_normals(rng, 3)
        along = np.cross(one, two)
        third = third - max(third @ along + 0.1, 0.0) * along / (along @ along)
        third = third / np.linalg.norm(third)
        v, c = along / np.linalg.norm(along), np.linalg.norm(along)
        spin = (one - two) / (R * c) if i % 2 else np.cross(one, v) / R + 3.0 * one
        yield np.stack([one, two, third]), v, spin, (1.0, float(i % 2))


def test_in_a_groove_both_sides_are_supports():
    """The paper's law within the kernel of what both sides hold, in whatever order the two are named."""
    rng, run = np.random.default_rng(20), jax.jit(impact, static_argnums=(0, 4))
    for normals, v, spin, grips in in_groove(rng):
        z, laws = np.concatenate([v, spin]), (Rough(0.6),) * 3
        held = np.vstack([rows_of(n, bool(grip)) for n, grip in zip(normals[:2], grips, strict=True)])
        np.testing.assert_allclose(held @ z, 0.0, atol=1e-12)
        free = np.eye(6) - project(held)
        want = z - 1.6 * project(rows_of(normals[2], True) @ free) @ z
        got = np.concatenate(run(laws, normals, jnp.asarray(v), jnp.asarray(spin), (0, 1), None, jnp.asarray(grips)))
        np.testing.assert_allclose(got, want, rtol=0, atol=1e-11 * np.max(abs(z)))
        again = run(laws, normals[[1, 0, 2]], jnp.asarray(v), jnp.asarray(spin), (0, 1), None, jnp.asarray(grips[::-1]))
        np.testing.assert_allclose(np.concatenate(again), got, rtol=0, atol=1e-11 * np.max(abs(z)))


def test_which_sides_of_a_groove_hold_a_ball():
    """Both beside a wall across; one where what it meets pushes it off the other; none under a slope."""
    sides, v = [(0.0, 0.0, 1.0), (0.0, 1.0, 0.0)], jnp.asarray([1.0, 0.0, 0.0])
    c = np.sqrt(0.5)
    for third, expected in (((-1, 0, 0), [True, True]), ((-c, 0, -c), [True, True]), ((-c, c, 0), [True, False]),
                            ((-c, 0, c), [False, True]), ((-0.6, 0.64, 0.48), [False, False])):  # fmt: skip
        parts, stays = takes_part(touched_by([Rough()] * 3, [*sides, third], (0, 1)), v)
        assert list(np.asarray(stays)) == expected and list(np.asarray(parts)) == [*expected, True]


@pytest.mark.parametrize("friction", [0.0, 0.1, 0.3, jnp.inf])
def test_a_nose_presses_the_ball_into_a_groove(friction):
    """By hand: the nose gives J (-cos b, -sin b c, -sin b c) with c^2 = 1/2, each side J sin b c against it and at most
    f J sin b c along the groove, of which rolling needs the same on both."""
    b, c = 0.7, np.sqrt(0.5)
    normals = [(0.0, 0.0, 1.0), (0.0, 1.0, 0.0), (-np.cos(b), -c * np.sin(b), -c * np.sin(b))]
    laws = [Frictional(0.5, 0.0, 1.0)] * 2 + [Smooth(0.9)]
    v, spin = jnp.asarray([1.0, 0.0, 0.0]), jnp.asarray([0.0, 1.0, -1.0]) / R
    after, turned = (np.asarray(x) for x in impact(laws, normals, v, spin, (0, 1), friction))
    np.testing.assert_allclose(after, [-0.9, 0.0, 0.0], atol=1e-13)  # n . v+ = -e n . v
    np.testing.assert_allclose(turned[[0, 1]], [0.0, -turned[2]], atol=1e-11)
    # x: -J cos b + 2 F = -1.9; F turns the ball: alpha r d(omega) = -F on each side.
    force = -ALPHA * R * (turned[1] - 1.0 / R)
    push = (1.9 + 2.0 * force) / np.cos(b) * c * np.sin(b)
    limit = friction * push if friction < 1.0 else np.inf
    assert force == pytest.approx(min(ALPHA * 1.9, limit), abs=1e-12)


def test_derivatives():
    """Of everything that is a number, in both modes, against differences."""
    rng = np.random.default_rng(8)
    normals, v, spin = throws_at(rng, 3, 0)

    def run(v, spin, e, f, tilt):
        laws = [Frictional(0.5, 0.1, f), Rough(e, 0.4), Frictional(0.6, 0.2, 2.0 * f)]
        n = jnp.asarray(normals[0]) + 0.1 * tilt
        n = n / jnp.sqrt(jnp.sum(n * n, axis=1, keepdims=True))
        restitution = jnp.stack([jnp.asarray(0.5), e, jnp.asarray(0.6)])
        touched = Touched(n, jnp.ones(3, bool), jnp.asarray([[True, False, False]]), restitution)
        after = reflected(R, ALPHA, touched, factors_of(laws), (f,), (1.0,), tuple(v), tuple(spin))
        return jnp.concatenate([jnp.stack(after[0]), R * jnp.stack(after[1])])

    at = (jnp.asarray(v[0]), jnp.asarray(spin[0]), jnp.asarray(0.8), jnp.asarray(0.2), jnp.zeros((3, 3)))
    check_grads(jax.jit(run), at, 1, atol=1e-5, rtol=1e-5)
    assert Ball(R, 1.0).inertia_ratio == ALPHA
