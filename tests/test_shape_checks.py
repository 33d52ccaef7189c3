"""Tests check the types and shapes of a function's first call, once in every test."""

import jax.numpy as jnp
import pytest
from jaxtyping import TypeCheckError
from support import shape_checks

from vrw_jax.continuation import floquet_multipliers

SQUARE = 2.0 * jnp.eye(3)
NOT_SQUARE = jnp.ones((3, 2))


@pytest.mark.parametrize("turn", ["first", "second"])
def test_a_wrong_shape_is_refused_in_every_test(turn):
    """Each parameter is a test of its own, and its first call is checked again."""
    with pytest.raises(TypeCheckError, match="floquet_multipliers"):
        floquet_multipliers(NOT_SQUARE)


def test_a_valid_call_does_not_end_the_checks_of_the_next_test():
    """A fresh start within the test stands for the next test."""
    floquet_multipliers(SQUARE)
    shape_checks.start_test()
    with pytest.raises(TypeCheckError, match="floquet_multipliers"):
        floquet_multipliers(NOT_SQUARE)
