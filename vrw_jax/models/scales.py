"""What units tell of a step's derivatives: in others of length and time it is the same step.

So every number that a step tells is a homogeneous function of the wheel and the start, and by
Euler's theorem two columns of its Jacobian follow from the other ten. The unit of mass would give a
third, but no mass is always large enough to divide by: a light leg's column would lose its digits.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array

from vrw_jax.models.lane_step import DIRECTIONS, along_units
from vrw_jax.numerics import LaneFunction
from vrw_jax.wheel import DOMAINS, PARAMETER_NAMES


class Scale(NamedTuple):
    """A unit: its power in each number of (parameters, start) and of (section state, durations)."""

    last: int  # place of the parameter whose column it tells
    given: tuple[int, ...]
    told: tuple[int, ...]


_POWERS = {
    "kg": (0, 0), "m": (1, 0), "N/m": (0, -2), "N s/m": (0, -1), "rad": (0, 0), "m/s^2": (1, -2),
    "rad/s": (0, -1), "m/s": (1, -1), "s": (0, 1),
}  # fmt: skip
"""Of length and time, in units of the wheel's numbers and the step's."""
_STATE = ("rad", "rad/s", "m/s")


def _scale(last: str, unit: int) -> Scale:
    given = (*(domain.unit for domain in DOMAINS.values()), *_STATE)
    powers = [tuple(_POWERS[x][unit] for x in units) for units in (given, (*_STATE, "s", "s", "s"))]
    return Scale(PARAMETER_NAMES.index(last), *powers)


SCALES = _scale("gravity", 1), _scale("locked_length", 0)
"""In this order: gravity has a length in it."""


def along_all(function: LaneFunction, lanes: Sequence[Array], moved: Sequence[int]) -> tuple:
    """`along_units` of a step's section state and durations by all numbers that it moves with.

    `lanes`: parameters, then the start; `moved`: all of them, in the order of the columns told.
    """
    own = [i for i in range(DIRECTIONS) if i not in {scale.last for scale in SCALES}]
    columns, told, others = along_units(function, lanes, own)
    by = dict(zip(own, columns, strict=True))
    for scale in SCALES:
        left = jnp.asarray(scale.told, told.dtype)[:, None] * told
        for i, power in enumerate(scale.given):
            if power and i != scale.last:
                left = left - (power * lanes[i]) * by[i]
        by[scale.last] = left / (scale.given[scale.last] * lanes[scale.last])
    return jnp.stack([by[i] for i in moved]), told, others
