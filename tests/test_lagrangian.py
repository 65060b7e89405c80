"""Lagrangian systems: each of the registry against its closed form, its barrier, and what is refused."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import named
from systems import all_systems

from nonholo_jax import Integrated, simulate

FINE = Integrated(rtol=1e-11, atol=1e-11)
every_system = pytest.mark.parametrize("case", **named(all_systems))


def start_of(case, dtype=np.float64):
    return jnp.asarray(np.asarray(case.q, dtype)), jnp.asarray(np.asarray(case.v, dtype))


def violation(system, q, v):
    """|A v - b| relative to the terms that it is the sum of."""
    a, b = system.constraint_at(q, jnp.zeros((), q.dtype), v.shape[0])
    return float(jnp.max(jnp.abs(a @ v - b) / (jnp.abs(a) @ jnp.abs(v) + jnp.abs(b) + 1e-300), initial=0.0))


@every_system
def test_free_motion_is_its_closed_form(case):
    system, (q, v) = case.build().without_contacts(), start_of(case)
    trajectory = simulate(system, (q, v), t1=case.t1, motion=FINE)
    got, want = case.observe(*trajectory.final), case.exact(case.t1, np.asarray(q), np.asarray(v))
    np.testing.assert_allclose(got, want, rtol=1e-9, atol=1e-9)
    if case.name != "turntable":  # its table does work
        np.testing.assert_allclose(system.energy(*trajectory.final), system.energy(q, v), rtol=1e-9)
    assert violation(system, *trajectory.final) < 1e-14
