"""How a motion ended, and what a row of a log is."""

import jax
import jax.numpy as jnp
import pytest

from nonholo_jax import KINDS, RESULTS


@pytest.mark.parametrize("item", [KINDS.unused, RESULTS.reached_t1], ids=["kinds", "results"])
def test_a_batch_prints_also_if_it_is_empty(item):
    """As the kinds of an empty log are, so that a trajectory with `log_size=0` prints."""
    sentence = repr(item).split("<")[1][:-1]
    of_shape = lambda *shape: jax.tree.map(lambda x: jnp.zeros(shape, x.dtype), item)  # noqa: E731
    assert repr(of_shape(2)).count(sentence) == 2
    assert repr(of_shape(3, 0)).endswith("<[]>")
    printed = []
    jax.jit(lambda x: printed.append(repr(x)))(of_shape(2))
    assert printed[0].endswith("<traced>")
