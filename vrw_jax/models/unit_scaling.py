"""Derivatives that follow from the units of length, time and mass by Euler's theorem.

Gaits do not depend on the units of length, time and mass. Every output of a step or a cycle is
therefore a homogeneous function of the wheel and the start. By Euler's theorem, each unit gives one
column of the Jacobian from the other columns. The Jacobian of a step obtains two columns in this
way. The unit of mass would give a third column, but no mass is always large enough as a divisor:
the column of a light leg would lose its digits. The columns of the Jacobian of a cycle are more
expensive. For a cycle, the direction in which both masses grow also follows from the unit of mass.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array

from vrw_jax.models.batch_step import compute_jacobian_columns
from vrw_jax.numerics import BatchFunction
from vrw_jax.wheel import PARAMETER_DOMAINS, PARAMETER_NAMES, UNIT_POWERS

_SECTION_STATE_UNITS = ("rad", "rad/s", "m/s")
_STEP_INPUT_UNITS = (
    *(domain.unit for domain in PARAMETER_DOMAINS.values()),
    *_SECTION_STATE_UNITS,
    "rad",
)


class UnitScalingPowers(NamedTuple):
    """Powers of one unit in the inputs and outputs of a step."""

    input_powers: tuple[int, ...]  # of parameters, start, and slope of the next line
    output_powers: tuple[int, ...]  # of section state and durations

    def subtract_known_columns(
        self, scaled_output: Array, step_inputs: Sequence[Array], known_columns: Mapping[int, Array]
    ) -> Array:
        """Return `scaled_output` minus each known column times its input and the power of this
        input.

        `scaled_output` is the output times its power. By Euler's theorem, the difference is the sum
        of the same products over the unknown columns.
        """
        for i, known_column in known_columns.items():
            if self.input_powers[i]:
                scaled_output = (
                    scaled_output - (self.input_powers[i] * step_inputs[i]) * known_column
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
"""Unit scaling that gives the Jacobian column of a parameter, by the index of the parameter.
Gravity comes first, because its unit contains a length."""


def complete_jacobian_by_scaling(
    step_inputs: Sequence[Array],
    known_columns: Mapping[int, Array],
    scaled_outputs: Mapping[int, Array],
) -> dict[int, Array]:
    """Return all columns of a Jacobian by the index of their input.

    The columns of `UNIT_SCALING_BY_PARAMETER_INDEX` follow from Euler's theorem.

    - `known_columns`: all other columns, by the index of the input;
    - `scaled_outputs`: outputs times their powers, by the index of the parameter.
    """
    known_columns = dict(known_columns)
    for parameter_index, unit_scaling in UNIT_SCALING_BY_PARAMETER_INDEX.items():
        remaining_sum = unit_scaling.subtract_known_columns(
            scaled_outputs[parameter_index], step_inputs, known_columns
        )
        known_columns[parameter_index] = remaining_sum / (
            unit_scaling.input_powers[parameter_index] * step_inputs[parameter_index]
        )
    return known_columns


def complete_jacobian_columns(
    batch_function: BatchFunction, step_inputs: Sequence[Array], input_indices: Sequence[int]
) -> tuple:
    """Return the Jacobian columns of section state and durations with respect to all inputs.

    `compute_jacobian_columns` gives all columns except two, which follow by scaling.

    - `step_inputs`: parameters, then the start, then on uneven ground the slope of the next line;
    - `input_indices`: indices of all inputs, in the order of the returned columns.
    """
    computed_indices = [
        i for i in range(len(step_inputs)) if i not in UNIT_SCALING_BY_PARAMETER_INDEX
    ]
    computed_columns, step_outputs, other_outputs = compute_jacobian_columns(
        batch_function, step_inputs, computed_indices
    )
    scaled_outputs = {
        i: jnp.asarray(unit_scaling.output_powers, step_outputs.dtype)[:, None] * step_outputs
        for i, unit_scaling in UNIT_SCALING_BY_PARAMETER_INDEX.items()
    }
    columns_by_input = complete_jacobian_by_scaling(
        step_inputs, dict(zip(computed_indices, computed_columns, strict=True)), scaled_outputs
    )
    return jnp.stack([columns_by_input[i] for i in input_indices]), step_outputs, other_outputs
