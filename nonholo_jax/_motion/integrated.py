"""Motion by any explicit Diffrax solver, one step an arc, with the solver's own interpolant."""

import dataclasses
import functools
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
import lazy_loader
import numpy as np
from jax import lax

from .._math import Scalar, frozen, if_any, plus, root, shared, times, total
from .crossing import Arc
from .motion import AbstractMotion, Piece, check_counts

if TYPE_CHECKING:
    import diffrax
else:
    diffrax = lazy_loader.load("diffrax")  # a third of the seconds that importing takes, and not needed by parabolas


def rms(tree: Any) -> Any:
    """The root mean square of scalars, without first gathering them into one array."""
    leaves = jax.tree.leaves(tree)
    return root(total([x * x for x in leaves]) / len(leaves))


class _Control(NamedTuple):
    size: Scalar
    controller: Any


class Integrated(AbstractMotion):
    """Motion by an explicit solver of Diffrax, for scenes with air and for systems without closed form.

    **Arguments:**

    - `solver`: an explicit solver of `diffrax` for ordinary differential equations. Explicit Runge-Kutta solvers run
        on their own tableau and interpolant, unrolled over scalars; others through their `init` and `step`.
    - `stepsize_controller`: `None` for `diffrax.PIDController(rtol, atol)`; a `PIDController` of your own; or
        `diffrax.ConstantStepSize()` with `dt0`.
    - `rtol`, `atol`: relative and absolute tolerance of one step.
    - `dt0`: first step in s, or `None` to have it chosen.
    - `max_steps`: bound on the number of accepted steps (arcs, each cut short by an impact included), after which the
        result is `step_limit`.
    - `edges`: whether a ball that stays on a surface also goes on over the edges and corners of boxes and plates, and
        rests or rolls on elastic surfaces and the outside of round ones; this makes a longer program. `None`: where the
        scene has the inside of a sphere or a cylinder, a `Hole` or an `Implicit` that is not elastic.
    - `unroll`: speed only. Whether the stages of a step are written out one after the other, over scalars, which is
        quicker in batches and takes longer to compile; `None` does so in batches of balls.
    - `safe_steps`, `tile`: speed only. How often one turn of the event loop may look ahead for a crossing, and how many
        lanes of a batch share one loop on a CPU.

    Raises `ValueError` for a solver that is not explicit, or a controller of another class.

    ```python
    import diffrax
    from nonholo_jax import Integrated
    motion = Integrated(solver=diffrax.Dopri5(), rtol=1e-6, atol=1e-6)
    ```
    """

    solver: "diffrax.AbstractSolver" = eqx.field(default_factory=lambda: diffrax.Tsit5())
    stepsize_controller: Any = None
    rtol: float = eqx.field(static=True, default=1e-8)
    atol: float = eqx.field(static=True, default=1e-8)
    dt0: Any = None
    max_steps: int = eqx.field(static=True, default=4096)
    safe_steps: int = eqx.field(static=True, default=3)
    tile: int = eqx.field(static=True, default=64)
    unroll: bool | None = eqx.field(static=True, default=None)
    edges: bool | None = eqx.field(static=True, default=None)

    @property
    def is_closed_form(self):
        return False

    def __check_init__(self):
        explicit = isinstance(self.solver, diffrax.AbstractERK) or not isinstance(
            self.solver, diffrax.AbstractImplicitSolver | diffrax.AbstractWrappedSolver | diffrax.AbstractSRK
        )
        if not explicit or self.solver.term_structure is not diffrax.AbstractTerm:
            raise ValueError(
                f"Argument `solver` must be an explicit Diffrax solver of one term, but got {self.solver}; try "
                "diffrax.Tsit5()."
            )
        known = (type(None), diffrax.PIDController, diffrax.ConstantStepSize)
        if not isinstance(self.stepsize_controller, known):
            raise ValueError(
                "Argument `stepsize_controller` must be None, a diffrax.PIDController or diffrax.ConstantStepSize(), "
                f"but got {self.stepsize_controller}; try None with `rtol` and `atol`."
            )
        if self._is_constant and self.dt0 is None:
            raise ValueError("Argument `dt0` must be given with constant steps, but got None; try dt0=1e-3.")
        check_counts(max_steps=self.max_steps, safe_steps=self.safe_steps, tile=self.tile)

    @property
    def _is_constant(self) -> bool:
        if self.stepsize_controller is None:  # a solver without error estimate can only take constant steps
            return not isinstance(self.solver, diffrax.AbstractAdaptiveSolver) or _has_no_estimate(self.solver)
        return isinstance(self.stepsize_controller, diffrax.ConstantStepSize)

    @property
    def _controller(self) -> Any:
        if self.stepsize_controller is None:
            return diffrax.PIDController(rtol=self.rtol, atol=self.atol, norm=rms)
        return self.stepsize_controller

    def in_batch(self, system):
        if self.unroll is not None or system.is_long:
            return self
        return dataclasses.replace(self, unroll=True)

    def check(self, system):
        del system
        if isinstance(self.solver, diffrax.AbstractERK):
            interpolation_weights(self.solver)  # here, since within a transformation it takes many small programs

    def max_pieces(self, max_impacts):
        return self.max_steps

    def max_turns(self, max_impacts):
        # Generous, for `max_steps` counts arcs: rejected steps, and further search along an arc, take turns but no arc.
        return 16 * (self.max_steps + 16)

    def begin(self, system, time, state, t1):
        term, z = _term(system, state), system.evolving(state)
        memory = None
        if not isinstance(self.solver, diffrax.AbstractERK):
            memory = self.solver.init(term, time, t1, _arrays(z, time), None)
        if self._is_constant:
            return _Control(jnp.asarray(self.dt0, dtype=time.dtype), None), memory
        dt0 = None if self.dt0 is None else jnp.asarray(self.dt0, dtype=time.dtype)
        func = lambda terms, t, y, args: terms.vf(t, y, args)  # noqa: E731
        order = self.solver.error_order(term)
        zero = jnp.zeros_like(time)
        controller, init = frozen(self._controller), frozen((_arrays(z, time), t1 - time))
        still = _term(frozen(system), frozen(state))
        size, memo = controller.init(still, zero, init[1], init[0], dt0, None, func, order)
        return _Control(frozen(jnp.asarray(size, dtype=time.dtype)), jax.tree.map(jnp.asarray, memo)), memory

    def shortened(self, control, size):
        return None if self._is_constant else control._replace(size=size)

    @property
    def steps(self) -> bool:
        """Whether it can step through the contacts of an `Exact` motion."""
        return isinstance(self.solver, diffrax.AbstractERK)

    def size(self, control, left, stays):
        return jnp.minimum(control.size, left)

    def piece(self, system, time, state, memory, jumped, size):
        if isinstance(self.solver, diffrax.AbstractERK):
            piece = _runge_kutta_step(self.solver, system, time, state, size, not self.unroll)
            return piece._replace(arc=_with_derived(system, piece.arc))
        z0 = _arrays(system.evolving(state), time)
        z1, error, info, memory, _ = self.solver.step(_term(system, state), time, time + size, z0, None, memory, jumped)
        path = self.solver.interpolation_cls(t0=time, t1=time + size, **info)
        arc = _with_derived(system, _fitted_arc(path, z0, time, state, size))
        return Piece(arc, memory, (z0, z1, error))

    def judge(self, control, size, trial, stays):
        z0, z1, error = frozen(trial)
        if self._is_constant:
            return jnp.asarray(True), control
        zero = jnp.zeros_like(size)
        order = self.solver.error_order(_term(None, None))
        keep, t0, t1, _, memo, _ = frozen(self._controller).adapt_step_size(
            zero, size, z0, z1, None, error, order, control.controller
        )
        # A rejected step shrinks; a step cut short by t1 must not make the next one small, but there is none.
        return keep, _Control(t1 - t0, memo)


def _has_no_estimate(solver: Any) -> bool:
    return isinstance(solver, diffrax.AbstractERK) and not np.any(getattr(solver.tableau, "b_error", 1.0))


def _arrays(z: Any, like: Any) -> Any:
    return jax.tree.map(lambda x: jnp.asarray(x, dtype=like.dtype), z)


def _term(system: Any, state: Any) -> "diffrax.ODETerm":
    def field(t, z, args):
        q, v = z
        return _arrays(system.derivative(t, state, q, v), t)

    return diffrax.ODETerm(field)


def _combination(weights: Any, terms: Sequence) -> Any:
    return total([times(float(w), term) for w, term in zip(weights, terms, strict=False)])


def _unrolled_stages(tableau: Any, system: Any, time: Any, state: Any, h: Any) -> tuple[list, list]:
    """The stages of an explicit Runge-Kutta method over scalars: h times the derivative of (q, v), flat; the part of q
    itself."""
    q, v = system.evolving(state)
    n = len(q)
    stages, rates = [], []
    for i in range(tableau.num_stages):
        row = tableau.a_lower[i - 1] if i > 0 else ()
        z = [plus(x, _combination(row, [k[j] for k in stages])) for j, x in enumerate((*q, *v))]
        c = 0.0 if i == 0 else float(tableau.c[i - 1])
        dq, dv = system.derivative(time + c * h, state, tuple(z[:n]), tuple(z[n:]))
        stages.append(shared([h * x for x in (*dq, *dv)]))
        rates.append(dq)
    return stages, rates


def _stages_in_turn(tableau: Any, system: Any, time: Any, state: Any, h: Any) -> tuple[list, list]:
    """The same by a loop, which holds the system's derivative once, and over two arrays, q and v: where the derivative
    is a long program, it compiles several times as fast."""
    (q, v), count = (_joined(x, time) for x in system.evolving(state)), tableau.num_stages
    weights, nodes = np.zeros((count, count)), np.zeros(count)
    for i in range(1, count):
        weights[i, :i], nodes[i] = tableau.a_lower[i - 1], tableau.c[i - 1]

    def stage(slopes, each):
        index, row, c = each
        z = [x + h * _product(row, slope) for x, slope in zip((q, v), slopes, strict=True)]
        rates = system.derivative(time + c * h, state, *(tuple(x) for x in z))
        new = zip(slopes, rates, strict=True)
        return tuple(lax.dynamic_update_index_in_dim(x, _joined(rate, time), index, 0) for x, rate in new), None

    plan = (jnp.arange(count), jnp.asarray(weights, dtype=time.dtype), jnp.asarray(nodes, dtype=time.dtype))
    start = tuple(jnp.zeros((count, x.size), time.dtype) for x in (q, v))
    (rates, others), _ = jax.lax.scan(stage, start, plan)
    return [(h * rates[i], h * others[i]) for i in range(count)], [(rates[i],) for i in range(count)]


def _product(a: Any, b: Any) -> Any:
    """Of matrices, without loss of accuracy on any device."""
    return jnp.matmul(a, b, precision=lax.Precision.HIGHEST)


def _joined(x: Any, like: Any) -> Any:
    return jnp.stack([jnp.asarray(c, dtype=like.dtype) for c in x])


def _runge_kutta_step(solver: Any, system: Any, time: Any, state: Any, h: Any, is_compact: bool) -> Piece:
    """One step of an explicit Runge-Kutta method and its interpolant."""
    tableau, (q, v) = solver.tableau, system.evolving(state)
    make, split = _unrolled_stages, tuple
    if is_compact:  # the same arithmetic on two arrays instead of many scalars
        make, split = _stages_in_turn, lambda blocks: tuple(c for block in blocks for c in block)
        q, v = (_joined(q, time),), (_joined(v, time),)
    n, z0 = len(q), (*q, *v)
    stages, rates = make(tableau, system, time, state, h)
    columns = [[k[j] for k in stages] for j in range(len(z0))]
    steps = shared([_combination(tableau.b_sol, column) for column in columns])
    z1 = tuple(plus(x, step) for x, step in zip(z0, steps, strict=True))
    error = tuple(_combination(tableau.b_error, column) for column in columns)
    weights = interpolation_weights(solver)
    if len(weights) == 2 and not tableau.fsal:
        means = [_combination(tableau.b_sol, column) for column in zip(*rates, strict=True)]
        ends, _ = system.derivative(time + h, state, split(z1[:n]), split(z1[n:]))
        ends = (_joined(ends, time),) if is_compact else ends
        path = tuple(_cubic(*each, h) for each in zip(q, rates[0], ends, means, strict=True))
        rate = tuple(_quadratic(*each) for each in zip(v, stages[0][n:], z1[n:], strict=True))
    else:
        polynomials = []
        for x, step, column in zip(z0, steps, columns, strict=True):
            inner = shared([_combination(row, column) for row in weights])
            # The last coefficient makes the polynomial end where the step ends, to rounding.
            polynomials.append((x, *inner, plus(step, times(-1.0, total(inner)))))
        path, rate = tuple(polynomials[:n]), tuple(polynomials[n:])
    if is_compact:
        path, rate = (tuple(zip(*part[0], strict=True)) for part in (path, rate))
    return Piece(Arc(time, state, path, rate, jnp.ones_like(h), h), None, (split(z0), split(z1), split(error)))


def _cubic(q0: Any, rate0: Any, rate1: Any, mean: Any, h: Any) -> tuple:
    """The path with these rates at its ends and `mean` between them. Diffrax's own cubic takes the last stage for the
    slope at the end, which it is not where the first stage is not the last of the step before: a ball would leave the
    floor with another velocity than it has there."""
    second = plus(times(3.0, mean), times(-1.0, plus(times(2.0, rate0), rate1)))
    third = plus(plus(rate0, rate1), times(-2.0, mean))
    second, third = shared([second, third])
    return q0, times(h, rate0), times(h, second), times(h, third)


def _quadratic(v0: Any, step: Any, v1: Any) -> tuple:
    """What begins at v0 with the slope `step` and ends at v1."""
    return v0, step, plus(v1, times(-1.0, plus(v0, step)))


@functools.lru_cache(maxsize=32)
def _weights(interpolation: Any, b_sol: tuple, dtype: Any) -> np.ndarray:
    """`interpolation_weights` of an interpolation class and the weights of the solution."""
    n = len(b_sol)
    nodes = [0.5 - 0.5 * np.cos(np.pi * (np.arange(degree) + 1) / degree) for degree in range(1, _HIGHEST + 1)]
    points = [*nodes, np.linspace(0.0, 1.0, 23)]  # 0 is known: the path starts there

    def evaluate(times: Any) -> Any:  # one program for all
        ends = {"t0": jnp.zeros((), dtype), "t1": jnp.ones((), dtype), "y0": jnp.zeros(n, dtype)}
        path = interpolation(**ends, y1=jnp.asarray(b_sol, dtype), k=jnp.eye(n, dtype=dtype))
        return jax.vmap(path.evaluate)(times)

    times = np.concatenate(points).astype(dtype)
    found = jax.jit(evaluate)(times)
    if isinstance(found, jax.core.Tracer):
        with jax.ensure_compile_time_eval():  # within somebody's transformation; then in many small programs
            found = evaluate(times)
    *samples, values = np.split(np.asarray(found, dtype=float), np.cumsum([len(x) for x in points])[:-1])
    eps = float(jnp.finfo(dtype).eps)
    for degree, (at, sample) in enumerate(zip(nodes, samples, strict=True), 1):
        powers = np.arange(1, degree + 1)
        fit = np.linalg.solve(at[:, None] ** powers, sample)
        if np.max(np.abs(points[-1][:, None] ** powers @ fit - values)) < 1e4 * eps * max(1.0, np.max(np.abs(fit))):
            fit[np.abs(fit) < 1e2 * eps] = 0.0
            return fit[:-1]
    return np.zeros(0)


_HIGHEST = 9  # degree of an interpolant


def interpolation_weights(solver: Any) -> np.ndarray:
    """The solver's interpolant as powers of theta in [0, 1]: row j - 1 holds the weights of theta^j on the stages, for
    j from 1 to degree - 1; what theta^degree gets follows from the end of the step. Constants, found at trace time by
    evaluating Diffrax's own interpolation class on unit stages and fitting the lowest degree that reproduces it."""
    b_sol = tuple(float(weight) for weight in solver.tableau.b_sol)
    weights = _weights(solver.interpolation_cls, b_sol, jnp.result_type(float))
    if weights.ndim == 1:
        raise ValueError(
            f"Argument `solver` must have a polynomial interpolant, but got {solver}; try diffrax.Tsit5()."
        )
    return weights


def _with_derived(system: Any, arc: Arc) -> Arc:
    """An arc with polynomials of what gaps see beside the configuration."""
    if system.n_derived == 0:
        return arc
    degree = system.degree_of_derived
    nodes = 0.5 - 0.5 * np.cos(np.pi * np.arange(degree + 1) / degree)
    inverse = np.zeros((degree + 1, degree + 1))
    inverse[0, 0], inverse[1:, 1:] = 1.0, np.linalg.inv(nodes[1:, None] ** np.arange(1, degree + 1))
    inverse[1:, 0] = -np.sum(inverse[1:, 1:], axis=1)

    def sample(s: Any) -> tuple:
        found = system.derived(arc.time + s * arc.unit, arc.start, arc.position(s), arc.velocity(s))
        return tuple(jnp.asarray(x, s.dtype) for x in found)

    at = jnp.asarray(nodes, arc.length.dtype)  # pyright: ignore
    weights = jnp.asarray(inverse, arc.length.dtype)  # pyright: ignore
    fit = lambda: tuple(_product(weights, x) for x in jax.vmap(sample)(at))  # noqa: E731
    one = lambda: (jnp.zeros_like(at).at[0].set(1.0),) * system.n_derived  # noqa: E731
    fitted = if_any(system.phase(arc.start) >= 0, fit, one)
    return dataclasses.replace(arc, derived=tuple(tuple(x[i] for i in range(degree + 1)) for x in fitted))


def _fitted_arc(path: Any, z0: Any, time: Any, state: Any, h: Any) -> Arc:
    """An arc through samples of any interpolation class: linear for solvers that interpolate so, else quintic."""
    degree = 1 if isinstance(path, diffrax.LocalLinearInterpolation) else 5
    nodes = 0.5 - 0.5 * np.cos(np.pi * (np.arange(degree) + 1) / degree)
    inverse = np.linalg.inv(nodes[:, None] ** np.arange(1, degree + 1))
    samples = [path.evaluate(time + float(s) * h) for s in nodes]

    def fit(start, *values):
        rises = [value - start for value in values]
        return (start, *[_combination(row, rises) for row in inverse])

    q, v = jax.tree.map(fit, z0, *samples)
    return Arc(time, state, q, v, jnp.ones_like(h), h)
