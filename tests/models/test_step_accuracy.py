"""One step agrees with a reference of 27 digits, from two formulations in another library."""

import numpy as np
import pytest
from support import reference_values
from support.batched import compute_full_steps, compute_jacobians, compute_states_and_work
from support.slow_variants import mark_slow

import vrw_jax as vrw

STARTS = reference_values.stack_quantity("step", "start")


def compute_reference_steps(options):
    """Return states and durations of all cases."""
    return compute_states_and_work(reference_values.REFERENCE_PARAMETERS, STARTS, options)[0]


VALUES = np.concatenate(
    [
        reference_values.stack_quantity("step", "section_state"),
        reference_values.stack_quantity("step", "durations"),
    ],
    1,
)
BY_PARAMETER = np.concatenate(
    [
        reference_values.stack_quantity("step", "d_section_state_d_params"),
        reference_values.stack_quantity("step", "d_durations_d_params"),
    ],
    1,
)
BY_START = np.concatenate(
    [
        reference_values.stack_quantity("step", "d_section_state_d_start"),
        reference_values.stack_quantity("step", "d_durations_d_start"),
    ],
    1,
)


@pytest.mark.parametrize(
    ("options", "claimed"),
    [(vrw.StepOptions(), 1e-9), (vrw.StepOptions.tight(), 1e-12)],
    ids=["default", "tight"],
)
def test_state_and_durations_are_accurate_to_the_claimed_error(options, claimed):
    solution = compute_reference_steps(options)
    assert reference_values.compute_scaled_error(solution, VALUES) < claimed


@pytest.mark.parametrize(
    ("options", "claimed"),
    [(vrw.StepOptions(), 1e-9), (vrw.StepOptions.tight(), 1e-12)],
    ids=["default", "tight"],
)
def test_first_derivatives_are_accurate_to_the_claimed_error(options, claimed):
    by_parameter, by_start = compute_jacobians(
        reference_values.REFERENCE_PARAMETERS, STARTS, options
    )
    assert reference_values.compute_scaled_error(by_parameter, BY_PARAMETER) < claimed
    assert reference_values.compute_scaled_error(by_start, BY_START) < claimed


def test_derivative_error_is_at_most_ten_times_the_value_error():
    # At tolerances where rounding (1e-13 in derivatives) plays no part.
    for tolerance in (1e-8, 1e-10):
        options = vrw.StepOptions(rtol=tolerance, atol=tolerance)
        of_values = reference_values.compute_scaled_error(compute_reference_steps(options), VALUES)
        by_parameter, by_start = compute_jacobians(
            reference_values.REFERENCE_PARAMETERS, STARTS, options
        )
        of_derivatives = max(
            reference_values.compute_scaled_error(by_parameter, BY_PARAMETER),
            reference_values.compute_scaled_error(by_start, BY_START),
        )
        assert of_derivatives < 10.0 * of_values


@pytest.mark.parametrize("by_lanes", [*mark_slow(False), True], ids=["wheel", "lanes"])
def test_indicators_impact_and_step_length_are_accurate(by_lanes):
    solution = compute_full_steps(
        reference_values.REFERENCE_PARAMETERS,
        STARTS,
        vrw.StepOptions.tight(),
        uses_lane_engine=by_lanes,
    )
    assert np.all(np.asarray(solution.outcome) == vrw.Outcome.STEPPED)
    for quantity, key in [
        (solution.post_impact, "post_impact"),
        (solution.step_length, "step_length"),
        (solution.indicators.lambda_I4, "lambda_impulse_4"),
        (solution.indicators.lambda_2, "lambda2_plus"),
        (solution.indicators.lambda_4, "lambda4_plus"),
    ]:
        # Algebra, not integration: round-off of forces of some 100 N.
        assert (
            reference_values.compute_scaled_error(
                quantity, reference_values.stack_quantity("step", key)
            )
            < 1e-12
        ), key


@pytest.mark.parametrize("solver", ["Tsit5", *mark_slow("Dopri5", "Kvaerno5")])
def test_all_solvers_agree(solver):
    # Kvaerno5's implicit stages stop at their own tolerance: ten times the explicit bound.
    options = vrw.StepOptions(solver=solver, rtol=1e-9, atol=1e-9)
    solution = compute_reference_steps(options)
    assert reference_values.compute_scaled_error(solution, VALUES) < 1e-7


@pytest.mark.parametrize(("solver", "order"), mark_slow(("Tsit5", 5), ("Dopri8", 8)))
def test_work_falls_with_the_order_of_the_solver(solver, order):
    """Error against number of steps has the solver's order: state, event times and derivatives.

    Adaptive steps at tolerance tol: error ~ tol and steps ~ tol^(-1/order), within the scatter of a
    step-size controller (half an order either way over these three decades).
    """
    tolerances = [1e-6, 1e-7, 1e-8, 1e-9]
    steps, errors, derivative_errors = [], [], []
    for tolerance in tolerances:
        options = vrw.StepOptions(
            solver=solver, rtol=tolerance, atol=tolerance, derivative_tightening=1.0
        )
        solution, tried = map(
            np.asarray,
            compute_states_and_work(reference_values.REFERENCE_PARAMETERS, STARTS, options),
        )
        steps.append(np.mean(tried))
        errors.append(np.sqrt(np.mean((solution - VALUES) ** 2)))
        by_start = np.asarray(
            compute_jacobians(reference_values.REFERENCE_PARAMETERS, STARTS, options)[1]
        )
        derivative_errors.append(np.sqrt(np.mean((by_start - BY_START) ** 2)))
    slope = lambda error: -np.polyfit(np.log(steps), np.log(error), 1)[0]
    assert slope(errors) > order - 1.0
    assert slope(derivative_errors) > order - 1.5
