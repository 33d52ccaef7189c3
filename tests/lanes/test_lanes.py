"""Batches of any size run in few shapes; derivatives of lanes use all directions together."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from vrw_jax.lanes import map_in_batches
from vrw_jax.lanes.autodiff import with_batched_jvp


@pytest.mark.parametrize(("n", "widths"), [(1, [1]), (3, [4]), (4, [4]), (9, [4, 4, 1])])
def test_batches_are_padded_to_few_sizes_and_cropped(n, widths):
    observed_rows = []

    def doubled(x, tree):
        observed_rows.append(len(x))
        return {"sum": x + tree["y"]}

    x = jnp.arange(float(n))
    result = map_in_batches(doubled, (1, 4), x, {"y": np.arange(float(n))})
    np.testing.assert_array_equal(result["sum"], 2.0 * np.arange(n))
    assert observed_rows == widths


TRACED_CALLS = []


def product_in_a_loop(x, y):
    """Return x y^3."""
    TRACED_CALLS.append(x)
    return lax.fori_loop(0, 3, lambda _, value: value * y, x)


X, Y = jnp.arange(1.0, 4.0), jnp.array([0.5, 2.0, -1.0])
DX = jnp.array([[1.0, 0.0, 2.0], [0.0, 1.0, 1.0]])


def compute_jvp(dx, dy, x=X):
    return jax.jvp(with_batched_jvp(product_in_a_loop), (x, Y), (dx, dy))


def test_tangents_of_a_vmap_are_batched_and_trace_the_function_twice():
    TRACED_CALLS.clear()
    value, shifted = jax.vmap(compute_jvp, (0, None), (None, 0))(DX, jnp.ones(3))
    assert len(TRACED_CALLS) == 2  # its value, and how it moves
    np.testing.assert_allclose(value, X * Y**3, rtol=1e-15)  # a product of four: two roundings
    np.testing.assert_allclose(shifted, DX * Y**3 + 3.0 * X * Y**2, rtol=1e-15)


def test_a_single_tangent_needs_no_vmap():
    expected = DX[0] * Y**3 + 6.0 * X * Y**2 * DX[1]
    np.testing.assert_allclose(compute_jvp(DX[0], 2.0 * DX[1])[1], expected, rtol=1e-15)
    (shifted,) = jax.vmap(compute_jvp)(DX[:1], 2.0 * DX[1:])[1]
    np.testing.assert_allclose(shifted, expected, rtol=1e-15)


def test_mapped_primals_with_batched_tangents_are_refused():
    with pytest.raises(NotImplementedError, match="maps its directions only"):
        jax.vmap(compute_jvp)(DX, DX, jnp.stack([X, X]))
