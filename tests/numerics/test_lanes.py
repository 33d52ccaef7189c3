"""Batches of any size are run in few shapes."""

import jax.numpy as jnp
import numpy as np
import pytest

from vrw_jax.numerics import in_batches


@pytest.mark.parametrize(("n", "widths"), [(1, [1]), (3, [4]), (4, [4]), (9, [4, 4, 1])])
def test_batches_are_filled_up_to_few_sizes_and_cut_back(n, widths):
    seen = []

    def doubled(x, tree):
        seen.append(len(x))
        return {"sum": x + tree["y"]}

    x = jnp.arange(float(n))
    told = in_batches(doubled, (1, 4), x, {"y": np.arange(float(n))})
    np.testing.assert_array_equal(told["sum"], 2.0 * np.arange(n))
    assert seen == widths
