"""Detection of wheels at rest among those whose step has ended without a touchdown.

Round-off decides by which guard the step of such a wheel ends, or whether any guard ends the step.
The outcome therefore depends on the state at the end, and is the same with every engine.
"""

import functools
import operator
from collections.abc import Iterable, Sequence

import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from vrw_jax.numerics import Elementwise
from vrw_jax.wheel.outcomes import Outcome

OUTCOMES_AT_REST = (Outcome.FELL_BACK, Outcome.NO_TOUCHDOWN_IN_TIME, Outcome.SOLVER_FAILED)
"""Outcomes by which the step of a wheel at rest can end."""

MAX_REST_SPEED = 1e-8
"""Largest speed of a wheel at rest, in the wheel's units, chosen because it is a thousand times the
error of a solver step at the default tolerances."""
REST_SPEED_PER_ATOL = 10.0
"""Factor of the absolute tolerance that also bounds the speed of a wheel at rest. The value is
chosen because the errors of solver steps stay below one tolerance."""
MAX_REST_ACCELERATION = 1e-4
"""Largest acceleration of a wheel at rest, in the wheel's units. The value is chosen between two
others. Errors of the accelerations of stiff legs are below 1e-5. Accelerations of wheels that fall
back are near 1."""


def is_still(
    rates: Iterable[Elementwise], rate_units: Iterable[Elementwise], atol: Elementwise
) -> Bool[Array, "..."]:
    """Return whether no coordinate moves, to the accuracy of the solver steps.

    - `rate_units`: unit of each rate for this wheel;
    - `atol`: absolute tolerance in units of the wheel.
    """
    max_speed = jnp.maximum(MAX_REST_SPEED, REST_SPEED_PER_ATOL * atol)
    return _are_within_units(rates, rate_units, max_speed)


def is_at_rest(
    rates: Iterable[Elementwise],
    accelerations: Iterable[Elementwise],
    rate_units: Sequence[Elementwise] | Array,
    time_unit: Elementwise,
    atol: Elementwise,
) -> Bool[Array, "..."]:
    """Return whether the wheel is at rest, from rates and accelerations of its coordinates.

    - `rate_units`, `time_unit`: units of the rates and of time for this wheel;
    - `atol`: absolute tolerance in units of the wheel.
    """
    max_acceleration = MAX_REST_ACCELERATION / time_unit
    return is_still(rates, rate_units, atol) & _are_within_units(
        accelerations, rate_units, max_acceleration
    )


def _are_within_units(
    quantities: Iterable[Elementwise], quantity_units: Iterable[Elementwise], max_value: Elementwise
) -> Bool[Array, "..."]:
    """Return whether every quantity is at most `max_value` times its unit."""
    are_values_bounded = [
        jnp.abs(x) <= max_value * quantity_unit
        for x, quantity_unit in zip(quantities, quantity_units, strict=True)
    ]
    return functools.reduce(operator.and_, are_values_bounded)


def replace_rest_outcome(
    outcome: Int[Array, "..."], is_resting: Bool[Array, "..."]
) -> Int[Array, "..."]:
    """Return the outcomes at the end of a step, with CAME_TO_REST for wheels that are at rest."""
    can_be_rest = functools.reduce(
        operator.or_, [outcome == rest_code for rest_code in OUTCOMES_AT_REST]
    )
    return jnp.where(can_be_rest & is_resting, jnp.int32(Outcome.CAME_TO_REST), outcome)
