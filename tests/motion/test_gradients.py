"""Derivatives of a motion through its impacts, in both modes, of every law, surface and motion of the registry.

With constant steps the derivative of `Integrated` is that of the discrete map, whatever the order of the solver, so
that a solver of two stages, quick to compile, stands for all. Adaptive Tsit5 is tested on one surface.
"""

import functools

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import (
    AIR,
    BALL,
    GRAVITY,
    AnyLaw,
    all_laws,
    all_motions,
    all_surfaces,
    arrays,
    generator,
    lane,
    scene_of,
    stacked,
    states,
    throws,
)
from jax.flatten_util import ravel_pytree

from nonholo_jax import (
    Air,
    Ball,
    BallState,
    Exact,
    Integrated,
    Plane,
    Rough,
    Scene,
    collide,
    simulate,
)

T1, MAX_IMPACTS, PER_LAW = 0.35, 4, 3
PLANE = all_surfaces[0]


def all_numbers(case, state, dtype=np.float64):
    """Every number that a motion depends on."""
    return {
        "state": {"position": state.position, "velocity": state.velocity, "spin": state.spin},
        "ball": arrays(BALL, dtype),
        "laws": {law.name: arrays(law.numbers, dtype) for law in all_laws},
        "surface": arrays(case.numbers, dtype),
        "gravity": jnp.asarray(GRAVITY, dtype),
        "air": arrays(AIR, dtype),
        "t1": jnp.asarray(T1, dtype),
    }


def move(case, motion, numbers, law, adjoint=None, with_air=False):
    scene = scene_of(
        case, law, ball=numbers["ball"], numbers=numbers["surface"], gravity=numbers["gravity"],
        air=numbers["air"] if with_air else None,
    )  # fmt: skip
    options = {"max_impacts": MAX_IMPACTS, "motion": motion, "adjoint": adjoint, "throw": False}
    return simulate(scene, BallState(**numbers["state"]), t1=numbers["t1"], sum_trains=False, **options)


def outputs(trajectory):
    """Final state, and time and place of the first impact."""
    log = trajectory.impacts
    return jnp.concatenate([stacked(trajectory.final), log.time[:1], log.point[0]])


def one_motion(case, motion, adjoint=None):
    """(numbers flattened, index of the law) -> outputs, and how to unflatten. The same function for surfaces that
    differ in their numbers only."""
    alike = [each.build is case.build and each.numbers.keys() == case.numbers.keys() for each in all_surfaces]
    return _one_motion(alike.index(True), motion, adjoint)


@functools.cache
def _one_motion(number, motion, adjoint):
    case = all_surfaces[number]
    air = not isinstance(motion, Exact)
    example = all_numbers(case, lane(throws(case, jax.random.key(0), 1), 0))
    unravel = ravel_pytree(example)[1]

    def trajectory(flat, index):
        numbers = unravel(flat)
        law = AnyLaw(index, tuple(law.build(**numbers["laws"][law.name]) for law in all_laws))
        return move(case, motion, numbers, law, adjoint, with_air=air)

    return trajectory, unravel


def batch_of(case, key, dtype=np.float64):
    """Flattened numbers for a few throws at every law, and the indices of the laws."""
    n = PER_LAW * len(all_laws)
    throw = throws(case, key, n, flight=(0.15, 0.25), dtype=dtype)
    flat = jnp.stack([ravel_pytree(all_numbers(case, lane(throw, i), dtype))[0] for i in range(n)])
    return flat, jnp.repeat(jnp.arange(len(all_laws), dtype=jnp.int32), PER_LAW)


def both_modes(function, flat, index):
    """Jacobians (lanes, outputs, numbers) in forward and reverse mode, and number, first state and first time of the
    impacts."""
    forward, reverse, trajectory = _both_modes(function)(flat, index)
    return np.asarray(forward), np.asarray(reverse), trajectory


@functools.cache
def _both_modes(function):
    """One program, that finds the path once."""

    @jax.jit
    @jax.vmap
    def run(x, i):
        def value(x):
            trajectory = function(x, i)
            log = trajectory.impacts
            return outputs(trajectory), (trajectory.n_impacts, stacked(lane(log.before, 0)), log.time[0])

        along = lambda tangent: jax.jvp(lambda x: value(x)[0], (x,), (tangent,))[1]  # noqa: E731
        out, pullback, trajectory = jax.vjp(value, x, has_aux=True)
        forward = jax.vmap(along, out_axes=-1)(jnp.eye(x.size))
        return forward, jax.vmap(lambda cotangent: pullback(cotangent)[0])(jnp.eye(out.size)), trajectory

    return run


def differences(function, flat, index, step):
    """Central differences of fourth order, (lanes, outputs, numbers), and for each lane and number whether all points
    of them are made of the same number of impacts and steps: the discrete map jumps where a step more is taken."""
    steps = step * np.maximum(np.abs(np.asarray(flat)), 0.1)  # (lanes, numbers)
    slopes, same = _around(function)(flat, jnp.asarray(steps), index)
    assert np.mean(same) > 0.9
    return np.asarray(slopes), np.asarray(same)


@functools.cache
def _around(function):
    @jax.jit
    @jax.vmap
    def around(x, h, i):
        shifts = jnp.asarray(np.array([-2, -1, 1, 2])[:, None, None] * np.eye(x.size))

        def one(d):
            trajectory = function(x + d * h, i)
            return outputs(trajectory), jnp.stack([trajectory.n_impacts, trajectory.n_arcs])

        end, counts = jax.vmap(jax.vmap(one))(shifts)
        slopes = jnp.einsum("s,spo->op", jnp.array([1, -8, 8, -1]) / 12, end) / h[None]
        return slopes, jnp.all(counts == counts[:1], axis=(0, 2))

    return around


def check_differences(jacobian, differences, tolerance):
    slopes, same = differences
    assert relative(jacobian, np.where(same[:, None, :], slopes, jacobian)) < tolerance


def saltation(scene, before, t, t1):
    """flight(t1 - t) S flight(t) of a motion with one impact at t from the state `before`, with (Kong et al. 2023)
    S = D_x R + (f+ - D_x R f-) D_x g / (D_x g f-), the impact R from the general projector of Lemma 1."""
    surface, ball, law = scene.surfaces[0], scene.ball, scene.surfaces[0].law
    g = jnp.asarray(scene.gravity)
    metric = jnp.diag(jnp.stack([ball.mass] * 3 + [ball.inertia] * 3))

    def reset(y):
        n = surface.normal(y[:3], 0.0)
        turn = jnp.array([[0, -n[2], n[1]], [n[2], 0, -n[0]], [-n[1], n[0], 0]])  # n x
        contact = jnp.concatenate([jnp.eye(3), ball.radius * turn], axis=1)  # v - r omega x n
        tangent = (jnp.eye(3) - jnp.outer(n, n)) @ contact
        normal = jnp.concatenate([n, jnp.zeros(3)])[None]
        closing, slip = jnp.abs(n @ y[3:6]), tangent @ y[3:]
        grip = ball.inertia_ratio / (1 + ball.inertia_ratio)
        e_t = law.slip_factor(ball.inertia_ratio, closing, slip @ slip) / grip - 1
        v = collide(y[3:], metric, normal, law.restitution)
        return jnp.concatenate([y[:3], collide(v, metric, tangent, e_t)])

    field = lambda y: jnp.concatenate([y[3:6], g, jnp.zeros(3)])  # noqa: E731
    d_reset = jax.jacfwd(reset)(before)
    f_minus, f_plus = field(before), field(reset(before))
    d_gap = jnp.concatenate([surface.normal(before[:3], 0.0), jnp.zeros(6)])
    jump = d_reset + jnp.outer(f_plus - d_reset @ f_minus, d_gap) / (d_gap @ f_minus)
    flight = lambda t: jnp.eye(9) + t * jnp.eye(9, k=3) * jnp.repeat(jnp.array([1.0, 0, 0]), 3)[:, None]  # noqa: E731
    return flight(t1 - t) @ jump @ flight(t)


def relative(a, b):
    """The largest difference, each row (one output) in units of its largest entry."""
    size = np.maximum(np.max(np.abs(b), axis=-1, keepdims=True), 1e-3)
    return np.max(np.nan_to_num(np.abs(a - b) / size, nan=np.inf))


# The other surfaces are these turned about, thin, or from the other side: along an exact path each is differentiated.
ALONG_STEPS = ("plane", "box", "sphere_outside", "cylinder_inside", "implicit")
CASES = [pytest.param(case, motion, id=f"{case.name}-{motion}") for motion in ("exact", "heun") for case in all_surfaces
         if motion == "exact" or case.name in ALONG_STEPS]  # fmt: skip


@pytest.mark.parametrize("case, motion", CASES)
def test_modes_agree_with_differences_and_saltation(case, motion, getkey):
    function, unravel = one_motion(case, all_motions[motion])
    flat, index = batch_of(case, getkey())
    forward, reverse, trajectory = both_modes(function, flat, index)
    assert np.all(np.isfinite(forward))
    assert relative(forward, reverse) < 1e-10
    check_differences(forward, differences(function, flat, index, 1e-4), 1e-7)
    # Every number of the laws counts in some lane, and so do the others, but for the mass and the air in vacuum.
    matters = unravel(jnp.asarray(np.abs(forward).max(axis=(0, 1))))
    unused = {"exact": {"mass", *AIR}, "heun": set()}[motion]
    for group in ("ball", "surface", "air"):
        assert all(np.any(x > 0) for name, x in matters[group].items() if name not in unused)
    idle = {(law, name) for law, group in matters["laws"].items() for name, x in group.items() if x == 0}
    # Only the coefficient of the branch that Coulomb's limit did not take.
    assert idle == {("frictional_gripping", "friction"), ("frictional_sliding", "tangential")}
    if motion == "exact":
        check_saltation(case, unravel, flat, index, trajectory, forward)


def check_saltation(case, unravel, flat, index, trajectory, jacobian):
    n_impacts, before, time = trajectory

    @jax.jit
    @jax.vmap
    def expected(x, i, before, time):
        numbers = unravel(x)
        law = AnyLaw(i, tuple(law.build(**numbers["laws"][law.name]) for law in all_laws))
        scene = scene_of(case, law, ball=numbers["ball"], numbers=numbers["surface"], gravity=numbers["gravity"])
        return saltation(scene, before, time, numbers["t1"])

    matrices = expected(flat, index, before, time)
    once = np.asarray(n_impacts) == 1
    assert once.sum() >= len(all_laws)  # the formula here is for one impact
    assert once.all() or case.name in ("rectangle", "sphere_inside", "cylinder_inside", "hole")
    places = unravel(jnp.arange(flat.shape[1], dtype=float))["state"]
    columns = np.concatenate([np.asarray(places[name], int) for name in ("position", "velocity", "spin")])
    assert relative(jacobian[once][:, :9][:, :, columns], np.asarray(matrices)[once]) < 1e-10


def test_adaptive_steps_agree_with_differences(getkey):
    """The derivative is that of the path taken: step sizes count as given, which is right to the tolerance."""
    case = next(case for case in all_surfaces if case.name == "sphere_inside")
    function, _ = one_motion(case, all_motions["tsit5"])
    flat, index = batch_of(case, getkey())
    value = lambda x, i: outputs(function(x, i))  # noqa: E731
    forward = np.asarray(jax.jit(jax.vmap(jax.jacfwd(value)))(flat, index))
    check_differences(forward, differences(function, flat, index, 1e-3), 1e-6)


def test_impact_in_a_last_step_that_t1_cuts():
    """The size of that step depends on t1, and after another impact on everything: it may not count as given. Air
    makes it matter: the path within a step does not depend on the step's size on a parabola, nor does Heun's at all."""
    numbers = all_numbers(PLANE, states([0.0, 0.0, 0.6], [2.0, 1.0, -1.2], [30.0, -40.0, 50.0]))
    numbers["ball"]["mass"] = jnp.asarray(0.1)
    flat, unravel = ravel_pytree(numbers)
    # t1 = 0.35 cuts the first step of 1 s, where the ball hits at about 0.2 s, and the second of 0.18 s.
    sizes = jnp.asarray([1.0, 0.18])

    def function(x, size):
        constant = diffrax.ConstantStepSize()
        motion = Integrated(diffrax.Midpoint(), stepsize_controller=constant, dt0=size, max_steps=8)
        return move(PLANE, motion, unravel(x), Rough(0.9), with_air=True)

    flat = jnp.stack([flat, flat])
    forward, reverse, (n_impacts, _, time) = both_modes(function, flat, sizes)
    assert np.all(np.asarray(n_impacts) >= 1) and np.all((np.asarray(time) > 0.18) & (np.asarray(time) < 0.3))
    assert relative(forward, reverse) < 1e-12
    check_differences(forward, differences(function, flat, sizes, 1e-4), 1e-9)
    at_t1 = int(unravel(jnp.arange(flat.shape[1], dtype=float))["t1"])
    assert np.all(np.abs(forward[:, 9, at_t1]) > 1e-3)  # even the time of the impact depends on t1, by such a step


def test_each_law_alone_agrees_with_the_choice_of_laws(getkey):
    """One program per law, with what it knows at trace time, against the program that chooses lane by lane."""
    function, unravel = one_motion(PLANE, Exact())
    flat, index = batch_of(PLANE, getkey())
    flat, index = flat[::PER_LAW], index[::PER_LAW]

    @jax.jit
    def alone(flat):
        def value(x, law):
            numbers = unravel(x)
            return outputs(move(PLANE, Exact(), numbers, law.build(**numbers["laws"][law.name])))

        return jnp.stack([jax.jacrev(value)(x, law) for x, law in zip(flat, all_laws, strict=True)])

    chosen = jax.jit(jax.vmap(jax.jacrev(lambda x, i: outputs(function(x, i)))))(flat, index)
    assert relative(np.asarray(alone(flat)), np.asarray(chosen)) < 1e-12


# Other adjoints


@pytest.mark.parametrize("motion", ["exact", "heun"])
def test_adjoints_agree(motion, getkey):
    case = next(case for case in all_surfaces if case.name == "sphere_inside")
    flat, index = batch_of(case, getkey())
    found = []
    for adjoint, mode in [
        (None, jax.jacrev),
        (diffrax.ForwardMode(), jax.jacfwd),
        (diffrax.RecursiveCheckpointAdjoint(), jax.jacrev),
    ]:
        function, _ = one_motion(case, all_motions[motion], adjoint)
        jacobian = jax.jit(jax.vmap(mode(lambda x, i, f=function: outputs(f(x, i))[:9])))
        found.append(np.asarray(jacobian(flat, index)))
    assert relative(found[1], found[0]) < 1e-9
    assert relative(found[2], found[0]) < 1e-9


def test_a_spin_alone_moves_no_arc_before_the_first_impact():
    """The derivative of the loop itself: the first arc has none then, and its end none either."""
    scene = Scene(Ball(0.025, 0.046), {"floor": Plane((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), Rough(0.8))})

    def place(spin, adjoint):
        state = BallState(jnp.array([0.0, 0.0, 0.5]), jnp.array([1.0, 0.0, 0.0]), spin)
        return simulate(scene, state, t1=0.9, max_impacts=4, sum_trains=False, adjoint=adjoint).final.position

    spin = jnp.array([0.0, 7.0, 1.0])
    loop = jax.jit(jax.jacfwd(lambda spin: place(spin, diffrax.ForwardMode())))(spin)
    arcs = jax.jit(jax.jacfwd(lambda spin: place(spin, None)))(spin)
    assert np.abs(arcs).max() > 1e-3
    assert np.abs(loop - arcs).max() < 1e-14


# Second derivatives


@pytest.mark.parametrize("name", ["plane", "sphere_inside", "box"])
def test_second_derivatives(name, getkey):
    """jax.hessian of a component of the final position, against differences of its gradient."""
    case = next(case for case in all_surfaces if case.name == name)
    scene = scene_of(case, Rough(0.8))
    throw = throws(case, getkey(), 4, flight=(0.15, 0.25))
    weights = jnp.array([0.3, -0.5, 0.8])

    def height(velocity, position, spin):
        return (
            weights
            @ simulate(
                scene, BallState(position, velocity, spin), t1=T1, max_impacts=4, sum_trains=False, throw=False
            ).final.position
        )

    rest = (throw.position, throw.spin)
    hessian = np.asarray(jax.jit(jax.vmap(jax.hessian(height)))(throw.velocity, *rest))
    gradient = jax.jit(jax.vmap(jax.grad(height)))
    h = 1e-5
    columns = [(gradient(throw.velocity + h * e, *rest) - gradient(throw.velocity - h * e, *rest)) / (2 * h)
               for e in jnp.eye(3)[:, None]]  # fmt: skip
    expected = np.stack([np.asarray(column) for column in columns], axis=-1)
    assert np.abs(hessian).max() > 1e-3
    assert np.abs(hessian - expected).max() < 1e-6 * max(1.0, np.abs(expected).max())
    assert np.abs(hessian - hessian.mT).max() < 1e-9 * np.abs(hessian).max()


# One motion, and motions together


@pytest.mark.parametrize("motion", ["exact", "heun"])
def test_single_precision_gradients(motion, getkey):
    """float32 derivatives are float32, and those of float64 to its precision."""
    motion = all_motions[motion]
    throw = throws(PLANE, getkey(), 8, flight=(0.15, 0.25))

    def jacobian(dtype):
        def value(x):
            numbers = all_numbers(PLANE, BallState(x[:3], x[3:6], x[6:]), dtype)
            return stacked(move(PLANE, motion, numbers, Rough(jnp.asarray(0.8, dtype))).final)

        return jax.jit(jax.vmap(jax.jacrev(value)))(stacked(throw).astype(dtype))

    single, double = jacobian(np.float32), jacobian(np.float64)
    assert single.dtype == np.float32 and double.dtype == np.float64
    assert relative(np.asarray(single, float), np.asarray(double)) < 1e3 * np.finfo(np.float32).eps


def test_motion_may_be_chosen_by_default():
    """Air needs an integrator; without it the closed form is as good and cheaper."""
    state = lane(throws(PLANE, jax.random.key(0), 1), 0)
    assert isinstance(simulate(scene_of(PLANE, Rough()), state, t1=0.1).motion, Exact)
    assert isinstance(simulate(scene_of(PLANE, Rough(), air=AIR), state, t1=0.1).motion, Integrated)


@pytest.mark.parametrize("adjoint", [diffrax.ForwardMode(), diffrax.RecursiveCheckpointAdjoint()])
def test_derivatives_of_the_loop_itself_through_bounces_on_one_plane(adjoint):
    """The search finds the return to a plane from the velocity alone, with a level of zero there: derivatives of the
    loop took that for a constant, and were wrong from the second bounce on."""
    scene = Scene(Ball(0.1, 1.0), {"floor": Plane((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), Rough())})

    def height(speed, adjoint=adjoint):
        throw = BallState(jnp.stack([0 * speed, 0 * speed, 0.3 + 0 * speed]), jnp.stack([0 * speed, 0 * speed, speed]),
                          jnp.zeros(3))  # fmt: skip
        return simulate(scene, throw, t1=3.3, max_impacts=8, log_size=0, adjoint=adjoint, throw=False).final.position[2]

    mode = jax.jacfwd if isinstance(adjoint, diffrax.ForwardMode) else jax.jacrev
    speed, step = jnp.asarray(2.0), 1e-6
    expected = (height(speed + step, None) - height(speed - step, None)) / (2 * step)
    np.testing.assert_allclose(mode(height)(speed), expected, rtol=1e-6)


def test_lanes_that_wait_for_others_keep_their_steps(getkey):
    """A reverse gradient looks through the path in parts, and a lane that has come to the end of a part waits for the
    others. It has the same derivatives as alone."""
    surface = Plane((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), Rough(0.8, 0.3))
    scene = Scene(Ball(**BALL), {"floor": surface}, air=Air(**AIR))
    rng, n = generator(getkey()), 4
    position = rng.normal(0.0, 1.0, (n, 3)) * [1.0, 1.0, 0.0] + np.linspace([0.0, 0.0, 0.3], [0.0, 0.0, 2.0], n)
    throw = states(position, rng.normal(0.0, 2.0, (n, 3)), rng.normal(0.0, 10.0, (n, 3)))
    motion = Integrated(rtol=1e-11, atol=1e-11)
    run = lambda state: simulate(scene, state, t1=2.0, motion=motion, log_size=0, throw=False)  # noqa: E731
    gradient = jax.jit(jax.grad(lambda state: run(state).final.position.sum()))
    arcs = np.asarray(jax.jit(jax.vmap(run))(throw).n_arcs)
    assert arcs.min() > 32 and len(set(arcs)) > 1  # more than one part, and not the same for all
    together = jax.jit(jax.vmap(gradient))(throw)
    for i in range(n):
        alone = gradient(lane(throw, i))
        np.testing.assert_allclose(stacked(lane(together, i)), stacked(alone), rtol=1e-9, atol=1e-10)
