"""Corrections converge to the fixed point of a map, also next to a jump, and bound their errors."""

from unittest.mock import Mock

import numpy as np
import pytest

import vrw_jax as vrw
from vrw_jax.studies.fidelity import ContactWheelBatch, StepQuantities
from vrw_jax.studies.refinement import JACOBIAN_COST_IN_STEPS, refine_gaits

FIXED_VALUE = 0.3
"""First number of the fixed point; the second number is zero."""
SLOPES = np.array([[0.67, 0.1], [0.0, 0.05]])


def refine_fixed_point(start_offset, tol, add_terms, slopes=SLOPES):
    """Return the refined fixed point of a map of two numbers and a code.

    The map is linear in the offset from the fixed point, up to `add_terms(offset)`, which returns
    the values and the derivatives of additional terms of the first number.
    """

    def take_steps(indices, states):
        offset, end_states = states[:, :2] - [FIXED_VALUE, 0.0], states.copy()
        end_states[:, :2] = offset @ slopes.T + [FIXED_VALUE, 0.0]
        end_states[:, 0] += add_terms(offset)[0]
        quantities = np.zeros((len(states), 7))
        quantities[:, :4], quantities[:, 4] = 1.0, end_states[:, 0]
        outcome = np.full(len(states), int(vrw.Outcome.STEPPED))
        return StepQuantities(end_states, quantities, outcome)

    def linearize_steps(indices, states):
        return_jacobian = np.zeros((len(states), 3, 3))
        return_jacobian[:, :2, :2] = slopes
        return_jacobian[:, 0, 0] += add_terms(states[:, :2] - [FIXED_VALUE, 0.0])[1]
        quantity_jacobian = np.zeros((len(states), 7, 3))
        quantity_jacobian[:, 4] = return_jacobian[:, 0]
        return take_steps(indices, states), return_jacobian, quantity_jacobian

    ground = Mock(
        ContactWheelBatch,
        n_legs=1,
        step_options=vrw.StepOptions(rtol=1e-10, atol=1e-10),
        take_steps=take_steps,
        linearize_steps=linearize_steps,
        make_comparison_batches=list,
        compute_min_contact_duration=lambda indices: np.zeros(len(indices)),
    )
    start = np.append(np.array([FIXED_VALUE, 0.0]) + start_offset, 0.0)[None]
    error_goal = lambda values: np.full_like(values, tol)
    return refine_gaits(
        ground,
        np.arange(1),
        start,
        ("theta_touchdown",),
        error_goal,
        is_every_gait_compared=False,
    )


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_the_error_bound_holds_next_to_a_jump_of_the_map(side):
    add_jump = lambda offset: (0.016 * (side * offset[:, 0] > 5e-6), 0.0)
    gaits = refine_fixed_point(np.array([side * 2e-6, 4e-6]), 1e-2, add_jump)
    assert gaits.is_found[0]
    assert gaits.is_attracting[0]
    assert abs(gaits.values[0, 0] - FIXED_VALUE) <= gaits.error_bounds[0, 0] <= 1e-2


@pytest.mark.parametrize("tol", [1e-2, 1e-4, 1e-6])
def test_one_jacobian_serves_corrections_whose_remaining_error_is_bounded(tol):
    """The quadratic term makes the corrections of one Jacobian contract by a tenth."""
    add_curvature = lambda offset: (offset[:, 0] ** 2, 2.0 * offset[:, 0])
    gaits = refine_fixed_point(np.array([0.02, 0.01]), tol, add_curvature)
    assert gaits.is_found[0]
    assert abs(gaits.values[0, 0] - FIXED_VALUE) <= gaits.error_bounds[0, 0] <= tol
    n_chord_steps = gaits.n_steps[0] - JACOBIAN_COST_IN_STEPS
    assert 0 < n_chord_steps <= 7


def test_a_gait_with_a_multiplier_above_one_does_not_attract():
    slopes = np.array([[1.36, 0.0], [0.0, 0.05]])
    gaits = refine_fixed_point(np.array([1e-3, 0.0]), 1e-6, lambda offset: (0.0, 0.0), slopes)
    assert gaits.is_found[0]
    assert not gaits.is_attracting[0]
