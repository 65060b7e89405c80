import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nonholo_jax._math import root


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
@pytest.mark.parametrize("x", [0.0, -1.0])
def test_root_and_its_derivatives_are_zero_where_there_is_none(x, dtype):
    first = jax.grad(root)
    assert float(root(jnp.asarray(x, dtype))) == 0.0
    for derivative in (first, jax.grad(first), jax.grad(jax.grad(first)), jax.jacfwd(jax.jacfwd(first))):
        np.testing.assert_array_equal(np.asarray(derivative(jnp.asarray(x, dtype))), 0.0)
