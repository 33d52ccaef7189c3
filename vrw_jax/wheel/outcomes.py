"""Contact modes of a foot, and wheels that come to rest.

For a wheel at rest, round-off decides which guard ends the step, or whether any guard does. The
outcome therefore depends only on the state at the end of the step. It is the same with every
engine.
"""

import functools
import operator
from collections.abc import Iterable, Sequence
from enum import IntEnum

import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from vrw_jax.base.outcomes import Outcome
from vrw_jax.base.types import Elementwise

POSSIBLE_OUTCOMES_AT_REST = (Outcome.FELL_BACK, Outcome.NO_TOUCHDOWN_IN_TIME, Outcome.SOLVER_FAILED)
"""Outcomes with which a step can end before the wheel is recognized to be at rest."""

MAX_REST_SPEED = 1e-8
"""Largest speed of a wheel at rest, in the wheel's own units. The value is chosen because it is a
thousand times the error of a solver step at the default tolerances.
"""
REST_SPEED_PER_ATOL = 10.0
"""Upper bound on the speed of a wheel at rest, divided by the absolute tolerance. The larger of
this bound and `MAX_REST_SPEED` is used. The value is chosen because the errors of solver steps stay
below one tolerance.
"""
MAX_REST_ACCELERATION = 1e-4
"""Largest acceleration of a wheel at rest, in the wheel's own units. The value is chosen because it
lies between two scales: errors of the accelerations of stiff legs are below 1e-5, and accelerations
of wheels that fall back are near 1.
"""


def are_rates_negligible(
    coordinate_rates: Iterable[Elementwise], rate_units: Iterable[Elementwise], atol: Elementwise
) -> Bool[Array, "..."]:
    """Return whether all rates are 0 within the accuracy of the solver steps.

    - `rate_units`: the wheel's own unit of each rate;
    - `atol`: absolute tolerance in the wheel's own units.
    """
    max_speed = jnp.maximum(MAX_REST_SPEED, REST_SPEED_PER_ATOL * atol)
    return _are_quantities_small(coordinate_rates, rate_units, max_speed)


def are_coordinates_at_rest(
    coordinate_rates: Iterable[Elementwise],
    coordinate_accelerations: Iterable[Elementwise],
    rate_units: Sequence[Elementwise] | Array,
    time_unit: Elementwise,
    atol: Elementwise,
) -> Bool[Array, "..."]:
    """Return whether rates and accelerations of all coordinates are negligible.

    - `rate_units`, `time_unit`: the wheel's own units of the rates and of time;
    - `atol`: absolute tolerance in the wheel's own units.
    """
    return are_rates_negligible(coordinate_rates, rate_units, atol) & _are_quantities_small(
        coordinate_accelerations, rate_units, MAX_REST_ACCELERATION / time_unit
    )


def _are_quantities_small(
    quantities: Iterable[Elementwise],
    quantity_units: Iterable[Elementwise],
    max_value_in_units: Elementwise,
) -> Bool[Array, "..."]:
    is_quantity_small = [
        jnp.abs(x) <= max_value_in_units * quantity_unit
        for x, quantity_unit in zip(quantities, quantity_units, strict=True)
    ]
    return functools.reduce(operator.and_, is_quantity_small)


def replace_rest_outcome(
    step_outcome: Int[Array, "..."], is_at_rest: Bool[Array, "..."]
) -> Int[Array, "..."]:
    """Return the outcomes of steps. The outcome is CAME_TO_REST if the wheel is at rest at the
    end.
    """
    has_rest_outcome = functools.reduce(
        operator.or_,
        [step_outcome == possible_outcome for possible_outcome in POSSIBLE_OUTCOMES_AT_REST],
    )
    return jnp.where(has_rest_outcome & is_at_rest, jnp.int32(Outcome.CAME_TO_REST), step_outcome)


class ContactMode(IntEnum):
    """Contact mode of a foot. Section states and trajectories contain these integers."""

    OFF = 0  # in the air
    STICK = 1  # at rest on the ground
    SLIP_DOWN = 2  # sliding downhill
    SLIP_UP = 3  # sliding uphill
