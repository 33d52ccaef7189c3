"""One step against a truth of 27 digits, made from two other formulations in another library."""

import numpy as np
import pytest
from support import truth
from support.batched import full_steps, jacobians, lean_steps

import vrw_jax as vrw

STARTS = truth.table("step", "start")


def values(options):
    """States and durations of all cases."""
    return lean_steps(truth.PARAMETERS, STARTS, options)[0]


VALUES = np.concatenate([truth.table("step", "section_state"), truth.table("step", "durations")], 1)
BY_PARAMETER = np.concatenate(
    [
        truth.table("step", "d_section_state_d_params"),
        truth.table("step", "d_durations_d_params"),
    ],
    1,
)
BY_START = np.concatenate(
    [truth.table("step", "d_section_state_d_start"), truth.table("step", "d_durations_d_start")], 1
)


@pytest.mark.parametrize(
    ("options", "claimed"),
    [(vrw.Options(), 1e-9), (vrw.Options.tight(), 1e-12)],
    ids=["default", "tight"],
)
def test_state_and_durations_are_right_to_the_claimed_error(options, claimed):
    found = values(options)
    assert truth.scaled_error(found, VALUES) < claimed


@pytest.mark.parametrize(
    ("options", "claimed"),
    [(vrw.Options(), 1e-9), (vrw.Options.tight(), 1e-12)],
    ids=["default", "tight"],
)
def test_first_derivatives_are_right_to_the_claimed_error(options, claimed):
    by_parameter, by_start = jacobians(truth.PARAMETERS, STARTS, options)
    assert truth.scaled_error(by_parameter, BY_PARAMETER) < claimed
    assert truth.scaled_error(by_start, BY_START) < claimed


def test_derivative_error_is_at_most_ten_times_the_value_error():
    # At tolerances where rounding (1e-13 in derivatives) plays no part.
    for tolerance in (1e-8, 1e-10):
        options = vrw.Options(rtol=tolerance, atol=tolerance)
        of_values = truth.scaled_error(values(options), VALUES)
        by_parameter, by_start = jacobians(truth.PARAMETERS, STARTS, options)
        of_derivatives = max(
            truth.scaled_error(by_parameter, BY_PARAMETER), truth.scaled_error(by_start, BY_START)
        )
        assert of_derivatives < 10.0 * of_values


def test_indicators_impact_and_step_length_are_right():
    found = full_steps(truth.PARAMETERS, STARTS, vrw.Options.tight())
    assert np.all(np.asarray(found.outcome) == vrw.Outcome.STEPPED)
    for quantity, key in [
        (found.post_impact, "post_impact"),
        (found.step_length, "step_length"),
        (found.indicators.lambda_I4, "lambda_impulse_4"),
        (found.indicators.lambda_2, "lambda2_plus"),
        (found.indicators.lambda_4, "lambda4_plus"),
    ]:
        # Algebra, not integration: round-off of forces of some 100 N.
        assert truth.scaled_error(quantity, truth.table("step", key)) < 1e-12, key


@pytest.mark.parametrize("solver", ["Tsit5", "Dopri5", "Kvaerno5"])
def test_any_solver_may_be_named_and_agrees(solver):
    # Kvaerno5's implicit stages stop at their own tolerance: ten times the explicit bound.
    options = vrw.Options(solver=solver, rtol=1e-9, atol=1e-9)
    found = values(options)
    assert truth.scaled_error(found, VALUES) < 1e-7


@pytest.mark.parametrize(
    ("solver", "order"), [pytest.param("Tsit5", 5, marks=pytest.mark.slow), ("Dopri8", 8)]
)
def test_work_falls_with_the_order_of_the_solver(solver, order):
    """Error against number of steps has the solver's order: state, event times and derivatives.

    Adaptive steps at tolerance tol: error ~ tol and steps ~ tol^(-1/order), within the scatter of a
    step-size controller (half an order either way over these three decades).
    """
    tolerances = [1e-6, 1e-7, 1e-8, 1e-9]
    steps, errors, derivative_errors = [], [], []
    for tolerance in tolerances:
        options = vrw.Options(
            solver=solver, rtol=tolerance, atol=tolerance, derivative_tightening=1.0
        )
        found, tried = map(np.asarray, lean_steps(truth.PARAMETERS, STARTS, options))
        steps.append(np.mean(tried))
        errors.append(np.sqrt(np.mean((found - VALUES) ** 2)))
        by_start = np.asarray(jacobians(truth.PARAMETERS, STARTS, options)[1])
        derivative_errors.append(np.sqrt(np.mean((by_start - BY_START) ** 2)))
    slope = lambda error: -np.polyfit(np.log(steps), np.log(error), 1)[0]
    assert slope(errors) > order - 1.0
    assert slope(derivative_errors) > order - 1.5
