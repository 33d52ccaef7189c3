"""The wheel at which a second force peak appears is a special point of branches and curves."""

import dataclasses

import numpy as np
import pytest
from numpy.polynomial import Chebyshev
from reference_code import five_coordinates
from scipy.optimize import brentq

import vrw_jax as vrw

SOFT = vrw.WheelParams(stiffness=900.0, damping=100.0, natural_length=1.0, slope=0.075)
"""A wheel with two peaks; with softer legs it has one."""
NAME = "second_peak_rate"
FINE = vrw.CycleOptions(mesh_intervals=(40, 32, 16), tolerance=1e-12)


@pytest.fixture(scope="module")
def gait():
    return vrw.limit_cycle(SOFT, options=FINE)


def reference_rate(stiffness, gait, damping=100.0):
    """The largest maximum of the fore foot's force rate in SLS-I and SLS-II, N/s, by the reference.

    The gait is a fixed point of the reference's own step.
    """
    params = dataclasses.replace(SOFT, stiffness=np.asarray(stiffness), damping=np.asarray(damping))
    numbers = {f.name: getattr(params, f.name) for f in dataclasses.fields(params) if f.init}
    numbers = {name: float(value) for name, value in numbers.items()} | {"n_legs": 8}
    x = np.asarray(vrw.limit_cycle(params, guess=gait, options=FINE).section_state)
    step = five_coordinates.step(numbers, x)
    assert np.max(np.abs(step["section_state"] - x)) < 1e-9
    wheel, rates = five_coordinates.Wheel(numbers), []
    for phase in step["phases"][1:]:
        force = np.vectorize(
            lambda t, phase=phase: wheel.acceleration(*phase.sample(float(t)), phase.name)[1][1]
        )
        rate = Chebyshev.interpolate(force, 80, [0.0, phase.duration]).deriv()
        times = rate.deriv().roots()
        times = times[np.abs(times.imag) < 1e-9].real
        times = times[(times > 0.0) & (times < phase.duration)]
        rates += rate(times[rate.deriv(2)(times) < 0.0]).tolist()
    return max(rates)


@pytest.mark.slow  # a branch with peaks compiles for more than a minute
def test_a_branch_locates_where_the_second_peak_disappears(gait):
    branch = vrw.continue_branch(
        SOFT, "stiffness", (840.0, 910.0), cycle=gait, cycle_options=FINE, force_peaks=True
    )
    (point,) = (point for point in branch.special_points if "peak" in point.name)
    assert (point.name, point.ends_branch) == (NAME, False)
    expected = brentq(reference_rate, point.value - 0.5, point.value + 0.5, (gait,), xtol=1e-10)
    assert abs(point.value / expected - 1.0) < 1e-9
    counts = branch.dataset.n_force_peaks.values
    np.testing.assert_array_equal(counts, np.where(branch.values > point.value, 2.0, 1.0))


@pytest.mark.slow  # a branch and a curve compile for minutes
def test_the_curve_of_the_second_peak_is_that_of_the_reference(gait):
    """Compared with bisection along the stiffness, at both ends and in the middle of the curve."""
    bounds = {"stiffness": (840.0, 910.0), "damping": (85.0, 115.0)}
    curve = vrw.continue_special_point(NAME, ("stiffness", "damping"), gait, bounds=bounds)
    values = np.asarray(curve.values)
    assert np.ptp(values[:, 1]) > 5.0
    for stiffness, damping in values[[0, len(values) // 2, -1]]:
        bracket = stiffness - 0.5, stiffness + 0.5
        expected = brentq(reference_rate, *bracket, (gait, damping), xtol=1e-10)
        assert abs(stiffness / expected - 1.0) < 1e-9


@pytest.mark.slow  # branches on two meshes compile for more than a minute
def test_a_branch_refines_the_mesh_on_which_its_first_gait_does_not_repeat():
    branch = vrw.continue_branch(SOFT, "stiffness", (895.0, 905.0))
    assert branch.outcome == vrw.Outcome.STEPPED
    assert np.ptp(branch.values) == 10.0
    assert np.max(branch.dataset.closure) < 1e-7


def test_a_model_without_collocation_raises_one_sentence():
    with pytest.raises(ValueError, match="has no measures of the force"):
        vrw.continue_branch(SOFT, "slope", (0.07, 0.1), model=vrw.RigidWheel(), force_peaks=True)
