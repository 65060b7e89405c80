"""A surface given by any gap: what it refuses."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nonholo_jax import Implicit, Smooth


class Hill(eqx.Module):
    height: jax.Array
    speed: float = 0.0

    def __call__(self, x, t):
        rise = self.height * jnp.sin(x[0])
        return x[2] - rise - self.speed * t if self.speed else x[2] - rise


MOVING = {
    "piston": lambda x, t: x[2] - 0.1 - t,
    "shaken": lambda x, t: x[2] - 0.1 * jnp.cos(40.0 * t),
    "from_a_moment_on": lambda x, t: jnp.where(t > 1.0, x[2], x[2] - 0.1),
    "turning": lambda x, t: x @ jnp.stack([jnp.sin(t), 0.0 * t, jnp.cos(t)]),
    "module": Hill(jnp.asarray(0.1), speed=1.0),
    "loop": lambda x, t: jax.lax.fori_loop(0, 3, lambda i, y: y - t, x[2]),
    "compiled": jax.jit(lambda x, t: x[2] - t),
}
STILL = {
    "floor": lambda x, t: x[2],
    "module": Hill(jnp.asarray(0.1)),
    "single": lambda x, t: x[2] - jnp.asarray(0.1, x.dtype),
    "compiled": jax.jit(lambda x, t: x[2]),
    "of_numbers": lambda x, t: np.pi * x[0] + x[2],
}


@pytest.mark.parametrize("name", MOVING)
def test_a_gap_that_depends_on_time_is_refused(name):
    """It was searched as if it stood still, and the ball hit where it had been."""
    with pytest.raises(ValueError, match="must not depend on the time t"):
        Implicit(MOVING[name], Smooth(), curvature=0.2)


@pytest.mark.parametrize("name", STILL)
def test_a_gap_that_does_not_is_taken(name):
    for build in (Implicit, lambda *args: jax.eval_shape(lambda: Implicit(*args))):
        assert build(STILL[name], Smooth()).curvature is None


def test_a_gap_with_traced_numbers_is_taken():
    where = lambda h: Implicit(Hill(h), Smooth(), 0.2).gap(jnp.array([1.0, 0.0, 2.0]))  # noqa: E731
    assert jax.jit(jax.grad(where))(jnp.asarray(0.1)) == pytest.approx(-np.sin(1.0), rel=1e-12)
