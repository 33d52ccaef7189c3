"""A force peak that appears or disappears at an event is a special point of branches."""

import dataclasses

import numpy as np
import pytest
from numpy.polynomial import Chebyshev
from reference_code import complementarity, five_coordinates
from reference_code.contact_force_extrema import make_start
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

import vrw_jax as vrw

TWO_PEAKS = vrw.parameter_sets["two_peaks"].params
FIRST_INTERVAL_SECONDS = 4e-3
"""Duration after the landing in which the second formulation has no event, s."""


def compute_initial_rate(friction, gait):
    """Return the rate of the fore foot's force just after the landing, N/s.

    The rate is the derivative of a polynomial through forces of the second formulation.
    """
    model = vrw.UnilateralWheel(friction=friction)
    state = vrw.limit_cycle(TWO_PEAKS, model=model, guess=gait.section_state).section_state
    wheel = complementarity.ComplementarityWheel(friction, c=100.0, k=2500.0, Ls=1.0, slope=0.075)
    landed, _ = complementarity._process_event(wheel, make_start(np.asarray(state)), 0, None)
    solve = lambda y: complementarity._solve_contact_forces(
        wheel, y[:11], y[11:], landed.mode, landed.is_locked
    )
    motion = solve_ivp(
        lambda _, y: np.r_[y[11:], solve(y)[0]], (0.0, FIRST_INTERVAL_SECONDS),
        np.r_[landed.q, landed.v], method="DOP853", rtol=1e-13, atol=1e-13, dense_output=True,
    ).sol  # fmt: skip
    force = np.vectorize(lambda t: solve(motion(t))[1][0, 1])
    return Chebyshev.interpolate(force, 12, [0.0, FIRST_INTERVAL_SECONDS]).deriv()(0.0)


@pytest.mark.slow  # a branch with unilateral contact compiles for more than a minute
def test_a_branch_locates_the_peak_that_appears_at_a_landing():
    """The initial rate of the force changes its sign there, while the force stays smooth."""
    model = vrw.UnilateralWheel(friction=0.86)
    gait = vrw.limit_cycle(TWO_PEAKS, model=model)
    branch = vrw.continue_branch(
        TWO_PEAKS, "friction", (0.85, 0.87), cycle=gait, model=model, force_peaks=True
    )
    (point,) = branch.special_points
    assert (point.kind, point.ends_branch) == ("number_of_force_peaks_changes", False)
    counts = branch.dataset.n_force_peaks.values
    np.testing.assert_array_equal(counts, np.where(branch.values < point.value, 3.0, 2.0))
    bracket = point.value - 1e-3, point.value + 1e-3
    expected = brentq(compute_initial_rate, *bracket, (gait,), xtol=1e-11)
    assert abs(point.value / expected - 1.0) < 1e-9


STIFF = vrw.WheelParams(stiffness=4250.0, damping=130.0, natural_length=1.0, slope=0.109)
"""A wheel whose second peak is just before the next touchdown."""
FINE = vrw.CycleOptions(mesh_intervals=(40, 32, 16), tolerance=1e-12)


def compute_final_rate(slope, gait):
    """Return the rate of the fore foot's force just before the touchdown, N/s, by the reference."""
    params = dataclasses.replace(STIFF, slope=np.asarray(slope))
    fields = [field for field in dataclasses.fields(params) if field.init]
    numbers = {field.name: float(getattr(params, field.name)) for field in fields}
    state = vrw.limit_cycle(params, guess=gait, options=FINE).section_state
    phase = five_coordinates.step(numbers | {"n_legs": 8}, np.asarray(state))["phases"][-1]
    wheel = five_coordinates.Wheel(numbers | {"n_legs": 8})
    force = np.vectorize(lambda t: wheel.acceleration(*phase.sample(float(t)), phase.name)[1][1])
    return Chebyshev.interpolate(force, 80, [0.0, phase.duration]).deriv()(phase.duration)


@pytest.mark.slow  # a branch with peaks compiles for more than a minute
def test_a_branch_locates_the_second_peak_that_a_touchdown_removes():
    gait = vrw.limit_cycle(STIFF, options=FINE)
    branch = vrw.continue_branch(
        STIFF, "slope", (0.107, 0.111), cycle=gait, cycle_options=FINE, force_peaks=True
    )
    (point,) = branch.special_points
    assert point.kind == "number_of_force_peaks_changes"
    counts = branch.dataset.n_force_peaks.values
    np.testing.assert_array_equal(counts, np.where(branch.values < point.value, 2.0, 1.0))
    assert np.min(branch.dataset.force_trough_depth.values[counts == 2.0]) > 10.0
    bracket = point.value - 1e-4, point.value + 1e-4
    expected = brentq(compute_final_rate, *bracket, (gait,), xtol=1e-12)
    assert abs(point.value / expected - 1.0) < 1e-9
