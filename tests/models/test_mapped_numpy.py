"""A function inside `jax.jit` may map NumPy arrays by `jax.vmap`, as outside of `jit`.

JAX rejects a mapped NumPy array as argument of a function with a derivative rule inside `jit`.
"""

import jax
import numpy as np
import pytest

import vrw_jax as vrw

DAMPING = np.array([150.0, 200.0])
START = np.asarray(vrw.paper_start())


def measure_step(damping):
    return vrw.step(vrw.WheelParams(damping=damping), START).dls_fraction


def map_section(damping):
    return vrw.return_map(vrw.WheelParams(damping=damping), START)[1]


def measure_gait(damping):
    return vrw.limit_cycle(vrw.WheelParams(damping=damping)).dls_fraction


def measure_contact_step(damping):
    model = vrw.UnilateralWheel(friction=0.8)
    return vrw.step(vrw.WheelParams(damping=damping), START, model=model).step_length


@pytest.mark.parametrize(
    "measure",
    [measure_step, map_section, measure_gait, measure_contact_step],
    ids=lambda f: f.__name__,
)
def test_a_numpy_array_is_mapped_inside_jit(measure):
    """The reference is the same call outside of `jit`."""
    expected = jax.vmap(measure)(DAMPING)
    # Round-off of XLA's code inside and outside of a larger program differs in the last digits.
    found = jax.jit(lambda factor: jax.vmap(measure)(DAMPING) * factor)(1.0)
    np.testing.assert_allclose(found, expected, rtol=1e-12)
