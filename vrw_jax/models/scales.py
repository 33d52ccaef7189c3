"""Derivatives that follow from the units of length, time and mass by Euler's theorem.

In other units of length, time and mass every gait is the same. So every output of a step or a cycle
is a homogeneous function of the wheel and the start. By Euler's theorem, each unit gives one column
of the derivatives from the other columns. The Jacobian of a step obtains two columns in this way. A
third would follow from the unit of mass. No mass is always large enough to divide by, and the
column of a light leg would lose its digits. For the Jacobian of a cycle, whose columns cost more,
the direction in which both masses grow is given as well.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array

from vrw_jax.models.lane_step import DIRECTIONS, along_units
from vrw_jax.numerics import LaneFunction
from vrw_jax.wheel import DOMAINS, PARAMETER_NAMES

_POWERS = {
    "kg": (0, 0, 1), "m": (1, 0, 0), "N/m": (0, -2, 1), "N s/m": (0, -1, 1), "rad": (0, 0, 0),
    "m/s^2": (1, -2, 0), "rad/s": (0, -1, 0), "m/s": (1, -1, 0), "s": (0, 1, 0),
}  # fmt: skip
"""Powers of length, time and mass in the units of the wheel's parameters and of a step's
outputs."""
_STATE = ("rad", "rad/s", "m/s")
_GIVEN = (*(domain.unit for domain in DOMAINS.values()), *_STATE)


class Scale(NamedTuple):
    """Powers of one unit in each input (parameters, start) and output (section state,
    durations).
    """

    given: tuple[int, ...]
    told: tuple[int, ...]

    def left(self, told: Array, numbers: Sequence[Array], by: Mapping[int, Array]) -> Array:
        """Return `remainder` minus the given columns, each times its input and that input's power.

        The argument is the output times its power. By Euler's theorem, the result is the sum of the
        same products over the columns that are not given.
        """
        for i, column in by.items():
            if self.given[i]:
                told = told - (self.given[i] * numbers[i]) * column
        return told


def _scale(unit: int) -> Scale:
    """Return the powers of one unit: 0 is length, 1 is time, 2 is mass."""
    powers = (
        tuple(_POWERS[x][unit] for x in units) for units in (_GIVEN, (*_STATE, "s", "s", "s"))
    )
    return Scale(*powers)


LENGTH, TIME, MASS = (_scale(unit) for unit in range(3))
SCALES = {PARAMETER_NAMES.index("gravity"): TIME, PARAMETER_NAMES.index("locked_length"): LENGTH}
"""Scaling that gives the column of a parameter, by the parameter's index. Gravity comes first,
because its unit contains a length."""


def with_scales(
    numbers: Sequence[Array], by: Mapping[int, Array], told: Mapping[int, Array]
) -> dict[int, Array]:
    """Return all columns; those of `SCALING_BY_PARAMETER` follow from the outputs times their
    powers.
    """
    by = dict(by)
    for last, scale in SCALES.items():
        left = scale.left(told[last], numbers, by)
        by[last] = left / (scale.given[last] * numbers[last])
    return by


def along_all(function: LaneFunction, lanes: Sequence[Array], moved: Sequence[int]) -> tuple:
    """Return `jacobian_columns` of a step's section state and durations for all inputs.

    - `inputs`: parameters, then the start;
    - `input_indices`: all of them, in the order of the returned columns.
    """
    own = [i for i in range(DIRECTIONS) if i not in SCALES]
    columns, told, others = along_units(function, lanes, own)
    powers = {i: jnp.asarray(s.told, told.dtype)[:, None] * told for i, s in SCALES.items()}
    by = with_scales(lanes, dict(zip(own, columns, strict=True)), powers)
    return jnp.stack([by[i] for i in moved]), told, others
