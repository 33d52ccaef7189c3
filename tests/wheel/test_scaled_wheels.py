"""A scaled wheel has the same gait in other units of mass, length and time."""

import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vrw_jax as vrw
from vrw_jax.wheel import PARAMETER_NAMES, compute_wheel_units_of_rows

MASS, LENGTH, TIME = 0.01, 0.2, 0.5
FACTORS = {"mass": MASS, "length": LENGTH, "time": TIME}
REFERENCE_TOLERANCE = 1e-8
"""Allowed relative difference, chosen because the mesh error of both gaits is below 1e-9."""


@pytest.fixture(scope="module")
def cycles():
    params = vrw.WheelParams(damping=150.0)
    return vrw.limit_cycle(params), vrw.limit_cycle(params.scaled(**FACTORS))


@pytest.mark.parametrize(
    ("name", "factor"),
    [
        ("period", TIME),
        ("speed", LENGTH / TIME),
        ("dls_fraction", 1.0),
        ("spectral_radius", 1.0),
    ],
)
def test_a_measure_of_the_scaled_gait_follows_from_its_unit(cycles, name, factor):
    expected = factor * float(getattr(cycles[0], name))
    assert float(getattr(cycles[1], name)) == pytest.approx(expected, rel=REFERENCE_TOLERANCE)


def test_scaling_back_returns_the_wheel():
    params = vrw.WheelParams(slope=0.28, n_legs=9)
    inverse = {name: 1.0 / factor for name, factor in FACTORS.items()}
    result = params.scaled(**FACTORS).scaled(**inverse).scaled(mass=1)
    for value, expected in zip(jax.tree.leaves(result), jax.tree.leaves(params), strict=True):
        np.testing.assert_allclose(value, expected, rtol=1e-15)
    assert result.n_legs == 9


def test_a_scaled_wheel_keeps_gravity_if_time_grows_by_the_root_of_length():
    small = vrw.WheelParams().scaled(length=0.2, time=0.2**0.5)
    assert float(small.gravity) == pytest.approx(9.81, rel=1e-15)
    assert float(small.stiffness) == pytest.approx(500.0 / 0.2, rel=1e-15)
    assert float(small.damping) == pytest.approx(200.0 / 0.2**0.5, rel=1e-15)


def test_the_factors_can_be_traced_and_batched():
    gravity = lambda time: vrw.WheelParams().scaled(time=time).gravity
    assert float(jax.grad(gravity)(1.0)) == pytest.approx(-2.0 * 9.81)
    assert vrw.WheelParams().scaled(time=np.array([1.0, 2.0])).gravity.shape == (2,)


@pytest.mark.parametrize("time", [np.array([1, 2]), jnp.array([1, 2])])
def test_factors_may_be_arrays_of_integers(time):
    np.testing.assert_array_equal(vrw.WheelParams().scaled(time=time).gravity, [9.81, 9.81 / 4.0])


@pytest.mark.parametrize("value", [0.0, -1.0, float("nan"), np.array([1.0, -2.0])])
def test_a_factor_that_is_not_positive_is_refused(value):
    with pytest.raises(ValueError, match=r"length is .* but a factor of scale is positive"):
        vrw.WheelParams().scaled(length=value)


def test_the_units_of_a_wheel_on_a_huge_slope_are_computed_without_a_warning():
    row = np.array([getattr(vrw.WheelParams(), name) for name in PARAMETER_NAMES])
    row[PARAMETER_NAMES.index("slope")] = 1e300
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        units = compute_wheel_units_of_rows(row[None], 8)
    np.testing.assert_allclose(np.ravel(units), 1.0, rtol=1e-12)
