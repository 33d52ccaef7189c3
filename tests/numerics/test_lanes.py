"""Batches of any size are run in few shapes; derivatives of lanes take all directions together."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from vrw_jax.numerics import by_directions, in_batches


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


TRACED = []


def product_in_a_loop(x, y):
    """x y^3."""
    TRACED.append(x)
    return lax.fori_loop(0, 3, lambda _, value: value * y, x)


X, Y = jnp.arange(1.0, 4.0), jnp.array([0.5, 2.0, -1.0])
DX = jnp.array([[1.0, 0.0, 2.0], [0.0, 1.0, 1.0]])


def along(dx, dy, x=X):
    return jax.jvp(by_directions(product_in_a_loop), (x, Y), (dx, dy))


def test_directions_of_a_vmap_are_taken_together_and_trace_the_function_twice():
    TRACED.clear()
    value, moved = jax.vmap(along, (0, None), (None, 0))(DX, jnp.ones(3))
    assert len(TRACED) == 2  # its value, and how it moves
    np.testing.assert_allclose(value, X * Y**3, rtol=1e-15)  # a product of four: two roundings
    np.testing.assert_allclose(moved, DX * Y**3 + 3.0 * X * Y**2, rtol=1e-15)


def test_one_direction_needs_no_vmap():
    expected = DX[0] * Y**3 + 6.0 * X * Y**2 * DX[1]
    np.testing.assert_allclose(along(DX[0], 2.0 * DX[1])[1], expected, rtol=1e-15)
    (moved,) = jax.vmap(along)(DX[:1], 2.0 * DX[1:])[1]
    np.testing.assert_allclose(moved, expected, rtol=1e-15)


def test_what_is_mapped_beside_its_directions_is_refused():
    with pytest.raises(NotImplementedError, match="is for its directions"):
        jax.vmap(along)(DX, DX, jnp.stack([X, X]))
