"""Branches of gaits along parameters of a law of the legs that a user gives."""

import numpy as np
import pytest
from support.leg_laws import QuadraticDamper, make_progressive_leg, make_wheel

import vrw_jax as vrw

PARAMS = vrw.WheelParams(damping=150.0)


@pytest.fixture(scope="module")
def branch():
    model = make_wheel(QuadraticDamper())
    return vrw.continue_branch(PARAMS, "leg.c2", (0.0, 100.0), model=model)


def test_a_branch_along_a_parameter_of_the_law_ends_at_the_papers_gait(branch):
    values, periods = branch.values, branch.dataset.period.values
    assert values.min() == 0.0
    paper_period = float(vrw.limit_cycle(PARAMS).period)
    assert abs(periods[np.argmin(values)] - paper_period) < 1e-10
    assert branch.dataset["leg.c2"].attrs["units"] == "N s^2/m^2"
    assert "N s^2/m^2" in str(branch)


def test_points_of_the_branch_are_gaits_of_their_laws(branch):
    index = len(branch.values) // 2
    cycle = vrw.limit_cycle(PARAMS, model=make_wheel(QuadraticDamper(branch.values[index])))
    point = branch.dataset.isel(point=index)
    assert abs(cycle.period - float(point.period)) < 1e-10
    np.testing.assert_allclose(cycle.section_state, point.section_state, atol=1e-9)


@pytest.mark.slow
def test_a_border_along_a_parameter_of_the_wheel_has_a_gait_of_the_law():
    model = make_wheel(make_progressive_leg(1000.0, 300.0))
    branch = vrw.continue_branch(
        vrw.WheelParams(damping=120.0), "damping", (100.0, 180.0), model=model
    )
    (border,) = (x for x in branch.special_points if x.name == "lambda_4_plus")
    assert abs(float(border.cycle.indicators.lambda_4)) < 1e-6
    np.testing.assert_array_equal(border.cycle.parameters[9:], [0.0, 1000.0, 300.0])
