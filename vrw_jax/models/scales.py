"""What units tell of derivatives: in others of length, time and mass every gait is the same.

So every number that a step or a cycle tells is a homogeneous function of the wheel and the start,
and by Euler's theorem a column of its derivatives for each unit follows from the others. That of a
step's Jacobian has two such columns: a third would be a mass's, but none is always large enough to
divide by, and a light leg's column would lose its digits. Of a cycle's, which are dearer, the
direction in which both masses grow is told.
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
"""Of length, time and mass, in units of the wheel's numbers and the step's."""
_STATE = ("rad", "rad/s", "m/s")
_GIVEN = (*(domain.unit for domain in DOMAINS.values()), *_STATE)


class Scale(NamedTuple):
    """A unit: its power in each number of (parameters, start) and of (section state, durations)."""

    given: tuple[int, ...]
    told: tuple[int, ...]

    def left(self, told: Array, numbers: Sequence[Array], by: Mapping[int, Array]) -> Array:
        """What Euler's theorem leaves of `told`, each times its power, to columns not in `by`."""
        for i, column in by.items():
            if self.given[i]:
                told = told - (self.given[i] * numbers[i]) * column
        return told


def _scale(unit: int) -> Scale:
    powers = (
        tuple(_POWERS[x][unit] for x in units) for units in (_GIVEN, (*_STATE, "s", "s", "s"))
    )
    return Scale(*powers)


LENGTH, TIME, MASS = (_scale(unit) for unit in range(3))
SCALES = {PARAMETER_NAMES.index("gravity"): TIME, PARAMETER_NAMES.index("locked_length"): LENGTH}
"""By the place of the parameter whose column each tells, gravity first: it has a length in it."""


def with_scales(
    numbers: Sequence[Array], by: Mapping[int, Array], told: Mapping[int, Array]
) -> dict[int, Array]:
    """All columns, of which those of SCALES follow from `told`, each number times its power."""
    by = dict(by)
    for last, scale in SCALES.items():
        left = scale.left(told[last], numbers, by)
        by[last] = left / (scale.given[last] * numbers[last])
    return by


def along_all(function: LaneFunction, lanes: Sequence[Array], moved: Sequence[int]) -> tuple:
    """`along_units` of a step's section state and durations by all numbers that it moves with.

    `lanes`: parameters, then the start; `moved`: all of them, in the order of the columns told.
    """
    own = [i for i in range(DIRECTIONS) if i not in SCALES]
    columns, told, others = along_units(function, lanes, own)
    powers = {i: jnp.asarray(s.told, told.dtype)[:, None] * told for i, s in SCALES.items()}
    by = with_scales(lanes, dict(zip(own, columns, strict=True)), powers)
    return jnp.stack([by[i] for i in moved]), told, others
