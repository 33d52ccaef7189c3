"""Derivatives that follow from the units of length, time and mass by Euler's theorem.

In other units of length, time and mass every gait is the same. So every output of a step or a cycle
is a homogeneous function of the wheel and the start. By Euler's theorem, each unit gives one column
of the derivatives from the other columns. The Jacobian of a step obtains two columns in this way. A
third column would follow from the unit of mass. No mass is always large enough to divide by, and
the column of a light leg would lose its digits. The Jacobian of a cycle has more expensive columns.
There, the direction in which both masses grow also follows from the unit of mass.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array

from vrw_jax.models.batch_step import compute_jacobian_columns
from vrw_jax.numerics import BatchFunction
from vrw_jax.wheel import PARAMETER_DOMAINS, PARAMETER_NAMES, UNIT_POWERS

_STATE_UNITS = ("rad", "rad/s", "m/s")
_INPUT_UNITS = (*(domain.unit for domain in PARAMETER_DOMAINS.values()), *_STATE_UNITS, "rad")


class UnitScaling(NamedTuple):
    """Powers of one unit in the inputs and outputs of a step."""

    input_powers: tuple[int, ...]  # of parameters, start, and slope of the next line
    output_powers: tuple[int, ...]  # of section state and durations

    def subtract_columns(
        self, remainder: Array, inputs: Sequence[Array], known_columns: Mapping[int, Array]
    ) -> Array:
        """Return `remainder` minus each known column times its input and the power of this input.

        The argument is the output times its power. By Euler's theorem, the result is the sum of the
        same products over the unknown columns.
        """
        for i, column in known_columns.items():
            if self.input_powers[i]:
                remainder = remainder - (self.input_powers[i] * inputs[i]) * column
        return remainder


def _make_unit_scaling(unit_index: int) -> UnitScaling:
    """Return the powers of one unit: 0 is length, 1 is time, 2 is mass."""
    powers = (
        tuple(UNIT_POWERS[unit_name][unit_index] for unit_name in units)
        for units in (_INPUT_UNITS, (*_STATE_UNITS, "s", "s", "s"))
    )
    return UnitScaling(*powers)


LENGTH_SCALING, TIME_SCALING, MASS_SCALING = (_make_unit_scaling(unit) for unit in range(3))
SCALING_BY_PARAMETER = {
    PARAMETER_NAMES.index("gravity"): TIME_SCALING,
    PARAMETER_NAMES.index("locked_length"): LENGTH_SCALING,
}
"""Unit scaling that gives the Jacobian column of a parameter, by the parameter's index. Gravity
comes first, because its unit contains a length."""


def complete_by_scaling(
    inputs: Sequence[Array], known_columns: Mapping[int, Array], scaled_outputs: Mapping[int, Array]
) -> dict[int, Array]:
    """Return all columns of a Jacobian, with those of `SCALING_BY_PARAMETER` from Euler's theorem.

    - `known_columns`: all other columns, by the index of the input;
    - `scaled_outputs`: outputs times their powers, by the index of the parameter.
    """
    known_columns = dict(known_columns)
    for parameter_index, scaling in SCALING_BY_PARAMETER.items():
        remainder = scaling.subtract_columns(scaled_outputs[parameter_index], inputs, known_columns)
        known_columns[parameter_index] = remainder / (
            scaling.input_powers[parameter_index] * inputs[parameter_index]
        )
    return known_columns


def complete_jacobian_columns(
    batch_function: BatchFunction, inputs: Sequence[Array], input_indices: Sequence[int]
) -> tuple:
    """Return `compute_jacobian_columns` of section state and durations with respect to all inputs.

    Two columns follow from the others by scaling.

    - `inputs`: parameters, then the start, then on uneven ground the slope of the next line;
    - `input_indices`: indices of all inputs, in the order of the returned columns.
    """
    computed_indices = [i for i in range(len(inputs)) if i not in SCALING_BY_PARAMETER]
    computed_columns, outputs, other_outputs = compute_jacobian_columns(
        batch_function, inputs, computed_indices
    )
    scaled_outputs = {
        i: jnp.asarray(scaling.output_powers, outputs.dtype)[:, None] * outputs
        for i, scaling in SCALING_BY_PARAMETER.items()
    }
    columns_by_input = complete_by_scaling(
        inputs, dict(zip(computed_indices, computed_columns, strict=True)), scaled_outputs
    )
    return jnp.stack([columns_by_input[i] for i in input_indices]), outputs, other_outputs
