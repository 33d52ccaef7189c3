"""Corrections converge to the fixed point of a map, also next to a jump."""

from unittest.mock import Mock

import numpy as np
import pytest

import vrw_jax as vrw
from vrw_jax.tolerance.contact_steps import GroundBatch, StepQuantities
from vrw_jax.tolerance.refinement import BroydenIteration, refine

POINT, JUMP = 0.3, 0.016
SLOPES = np.array([[0.67, 0.1], [0.0, 0.05]])


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_the_error_bound_holds_if_differences_span_a_jump(side):
    """A map of two numbers and a code, whose point is known: 5e-6 beside it the first one jumps,
    and makes 1,600 of its slope. By that hardly anything is left to correct of it, and corrections
    come down as the second one does."""

    def step(indices, x):
        off = x[:, :2] - [POINT, 0.0]
        y = x.copy()
        y[:, :2] = off @ SLOPES.T + [POINT, 0.0]
        y[:, 0] += JUMP * (side * off[:, 0] > 5e-6)
        result = np.column_stack([*np.ones((4, len(x))), y[:, 0], *np.zeros((2, len(x)))])
        return StepQuantities(y, result, np.full(len(x), int(vrw.Outcome.STEPPED)))

    ground = Mock(
        GroundBatch,
        n_legs=1,
        options=vrw.StepOptions(rtol=1e-10, atol=1e-10),
        take_steps=step,
        complete_states=lambda x: x,
        find_free_coordinates=lambda x: np.ones((len(x), 2), bool),
        min_resolved_contact_duration=lambda indices: np.zeros(len(indices)),
    )
    begin = np.array([[POINT + side * 2e-6, 4e-6, 0.0]])
    chord = BroydenIteration.from_states(ground, np.arange(1), begin, None)
    solution = refine(chord, ("theta_touchdown",), lambda values: np.full_like(values, 1e-2), 1)
    assert solution.is_done[0]
    error = solution.remaining_error[0, 0] + solution.numerical_error[0, 0]
    assert abs(solution.values[0, 0] - POINT) <= error <= 1e-2
    assert chord.is_attracting()[0]  # as slopes of 0.67 and 0.05 do
