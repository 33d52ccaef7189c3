"""Derivatives that follow from the units of length, time and mass by Euler's theorem.

The choice of these units does not affect a gait. So every output of a step or a cycle is a
homogeneous function of the parameters and the start. By Euler's theorem, each unit determines one
column of the Jacobian from the other columns. Two columns of the Jacobian of a step are computed in
this way. The unit of mass would determine a third column, but no mass is always large enough to
divide by: the column for the mass of a light leg would lose its digits. The columns of the Jacobian
of a cycle are more expensive. For a cycle, the unit of mass also determines the derivative in the
direction in which both masses grow.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array

from vrw_jax.lanes.autodiff import compute_jacobian_columns
from vrw_jax.lanes.batching import BatchFunction
from vrw_jax.wheel.params import PARAMETER_DOMAINS, PARAMETER_NAMES, UNIT_POWERS

_SECTION_STATE_UNITS = ("rad", "rad/s", "m/s")
_STEP_INPUT_UNITS = (
    *(parameter_domain.unit for parameter_domain in PARAMETER_DOMAINS.values()),
    *_SECTION_STATE_UNITS,
    "rad",
)


class UnitScalingPowers(NamedTuple):
    """Exponents of one unit in the units of the inputs and outputs of a step."""

    step_input_powers: tuple[int, ...]  # exponents for parameters, start, slope of the next line
    step_output_powers: tuple[int, ...]  # exponents for section state and durations

    def subtract_known_jacobian_columns(
        self,
        scaled_output: Array,
        step_inputs: Sequence[Array],
        known_jacobian_columns: Mapping[int, Array],
    ) -> Array:
        """Subtract the contribution of each known Jacobian column from the sum in Euler's theorem.

        `scaled_output` is an output times the exponent of the unit in that output. The contribution
        of a column is the column times its input and the exponent of the unit in that input. By
        Euler's theorem, the result is the sum of the contributions of the unknown columns.
        """
        for i, known_jacobian_column in known_jacobian_columns.items():
            if self.step_input_powers[i]:
                scaled_output = (
                    scaled_output
                    - (self.step_input_powers[i] * step_inputs[i]) * known_jacobian_column
                )
        return scaled_output


LENGTH_UNIT_SCALING, TIME_UNIT_SCALING, MASS_UNIT_SCALING = (
    UnitScalingPowers(
        *(
            tuple(UNIT_POWERS[unit_name][unit_index] for unit_name in unit_names)
            for unit_names in (_STEP_INPUT_UNITS, (*_SECTION_STATE_UNITS, "s", "s", "s"))
        )
    )
    for unit_index in range(3)
)
UNIT_SCALING_BY_PARAMETER_INDEX = {
    PARAMETER_NAMES.index("gravity"): TIME_UNIT_SCALING,
    PARAMETER_NAMES.index("locked_length"): LENGTH_UNIT_SCALING,
}
"""Unit scaling that determines the Jacobian column of a parameter, by the index of the parameter.
Gravity comes first, because its unit contains a length.
"""


def complete_jacobian_by_scaling(
    step_inputs: Sequence[Array],
    known_jacobian_columns: Mapping[int, Array],
    scaled_outputs: Mapping[int, Array],
) -> dict[int, Array]:
    """Return all columns of a Jacobian, by the index of the input.

    Euler's theorem determines the columns of `UNIT_SCALING_BY_PARAMETER_INDEX`.

    - `known_jacobian_columns`: all other columns, by the index of the input;
    - `scaled_outputs`: outputs times the exponents of a unit, by the index of the parameter whose
      column the unit determines.
    """
    known_jacobian_columns = dict(known_jacobian_columns)
    for parameter_index, unit_scaling in UNIT_SCALING_BY_PARAMETER_INDEX.items():
        unknown_column_product = unit_scaling.subtract_known_jacobian_columns(
            scaled_outputs[parameter_index], step_inputs, known_jacobian_columns
        )
        known_jacobian_columns[parameter_index] = unknown_column_product / (
            unit_scaling.step_input_powers[parameter_index] * step_inputs[parameter_index]
        )
    return known_jacobian_columns


def complete_jacobian_columns(
    batch_function: BatchFunction, step_inputs: Sequence[Array], input_indices: Sequence[int]
) -> tuple:
    """Compute the Jacobian of section state and durations with respect to all inputs of a step.

    The results are those of `compute_jacobian_columns`. Two columns are computed from all other
    columns by unit scaling.

    - `batch_function`: function that computes the step for a batch;
    - `step_inputs`: parameters, then the start, then on uneven ground the slope of the next line of
      the ground;
    - `input_indices`: indices of all inputs, in the order of the returned columns.
    """
    computed_indices = [
        i for i in range(len(step_inputs)) if i not in UNIT_SCALING_BY_PARAMETER_INDEX
    ]
    computed_jacobian_columns, step_outputs, nonfloat_outputs = compute_jacobian_columns(
        batch_function, step_inputs, computed_indices
    )
    scaled_outputs = {
        i: jnp.asarray(unit_scaling.step_output_powers, step_outputs.dtype)[:, None] * step_outputs
        for i, unit_scaling in UNIT_SCALING_BY_PARAMETER_INDEX.items()
    }
    jacobian_columns_by_input = complete_jacobian_by_scaling(
        step_inputs,
        dict(zip(computed_indices, computed_jacobian_columns, strict=True)),
        scaled_outputs,
    )
    return (
        jnp.stack([jacobian_columns_by_input[i] for i in input_indices]),
        step_outputs,
        nonfloat_outputs,
    )
