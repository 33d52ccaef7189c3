"""Inputs of a step: section states and the slopes of uneven ground, with the checks of both.

Uneven ground consists of straight lines between the footholds.
"""

import functools
import operator
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from vrw_jax.base.types import Elementwise
from vrw_jax.wheel.params import MAX_SI_VALUE, PARAMETER_DOMAINS, WheelParams

SectionState = Float[Array, "3"]
"""State (theta-, dtheta-, dL1-) just before touchdown, in rad, rad/s and m/s. The leg labels are
those of the step that ends. The touchdown condition determines the length of Leg 1. Leg 2 is on its
stopper.
"""
AnySectionState = Float[Array, "section ..."]
"""Section state of any model: a `SectionState` or a longer vector. A batch has its elements on the
last axis.
"""
PAPER_START_STATE = (0.1, 1.6, -0.1)
"""Start near the gait of Table 1 of the paper, inside the gait's basin of attraction: rad, rad/s,
m/s.
"""


SectionStateEntries = Float[Array, "section ..."] | tuple[Array, ...]
"""Section state as one array, or as separate entries. Each entry may be an array with one value per
batch element.
"""


def is_valid_start_state(params: WheelParams, x: SectionStateEntries) -> Array:
    """Return whether the parameters and the start state are valid.

    They are valid if all values are finite and within their domains, and if the wheel rolls
    forward. NaN gives False.
    """
    wheel_angle, angular_rate = x[0], x[1]
    is_angle_in_range = (jnp.abs(wheel_angle) < 0.5 * jnp.pi) & (
        jnp.abs(wheel_angle - params.leg_angle) < 0.5 * jnp.pi
    )
    # In single precision the bound would overflow, with a warning.
    max_entry = min(MAX_SI_VALUE, float(jnp.finfo(jnp.result_type(angular_rate)).max))
    are_entries_bounded = functools.reduce(
        operator.and_, [jnp.abs(state_entry) < max_entry for state_entry in x]
    )
    return params.is_in_domain() & are_entries_bounded & is_angle_in_range & (angular_rate > 0.0)


def replace_invalid_inputs(
    is_valid_start: Array,
    params: WheelParams,
    x: SectionStateEntries,
    fallback_state: Any,
) -> tuple[WheelParams, Any]:
    """Return the parameters and the start state, with invalid inputs replaced.

    The wheel of Table 1 of the paper and `fallback_state` replace them. The replacement prevents
    NaN in the step and its derivatives.
    """
    return jax.tree.map(
        lambda given_value, valid_input_value: jnp.where(
            is_valid_start, given_value, jnp.asarray(valid_input_value, given_value.dtype)
        ),
        (params, x),
        (type(params)(n_legs=params.n_legs), fallback_state),
    )


def complete_ground_line_slopes(slope: Array, n_steps: int) -> Array:
    """Return the slopes of the n + 1 lines of the ground under a walk of n steps, rad.

    If `slope` has n entries, the last slope is repeated.
    """
    require_stepwise_shape("slope", slope, n_steps)
    return slope if len(slope) > n_steps else jnp.append(slope, slope[-1:])


def require_stepwise_shape(quantity_name: str, stepwise_values: Array, n_steps: int) -> None:
    """Raise a `ValueError` unless an array has n or n + 1 entries for n steps."""
    if jnp.shape(stepwise_values) not in ((n_steps,), (n_steps + 1,)):
        n_steps_text = "a step" if n_steps == 1 else f"a walk of {n_steps} steps"
        raise ValueError(
            f"{quantity_name} has shape {jnp.shape(stepwise_values)}, but {n_steps_text} of one "
            "wheel "
            f"takes one number, or an array of {n_steps} or {n_steps + 1} over its steps: map "
            "over batches of wheels with jax.vmap."
        )


def separate_next_slope(params: WheelParams) -> tuple[WheelParams, Elementwise | None]:
    """Return the wheel on the line of the ground under both feet, and the slope of the next line.

    The slope is in rad. The line joins the footholds of the two feet in double support. On uneven
    ground, `params.slope` has both slopes on a leading axis that no other parameter has. On flat
    ground, `params.slope` has no such axis and the second result is None.
    """
    if jnp.ndim(params.slope) == jnp.ndim(params.damping):
        return params, None
    slope, next_slope = params.slope[0], params.slope[1]
    return eqx.tree_at(lambda wheel: wheel.slope, params, slope), next_slope


def is_slope_in_domain(slope: Elementwise) -> Array:
    """Return whether a slope (rad) lies in the allowed domain. NaN gives False."""
    return jnp.asarray(PARAMETER_DOMAINS["slope"].contains_parameter_value(slope))


def select_stance_line_and_tilt(
    params: WheelParams, x: SectionStateEntries
) -> tuple[WheelParams, Array, Elementwise | None]:
    """Return the wheel on the present line of the ground, the validity of the step, and the tilt.

    The present line is the one under both feet in double support. A step may start only if
    parameters, start and slopes are valid. The tilt is the angle by which the next line is steeper
    than the present line, rad. On flat ground the tilt is None.
    """
    params, next_slope = separate_next_slope(params)
    is_valid_step = is_valid_start_state(params, x)
    if next_slope is None:
        return params, is_valid_step, None
    is_valid_step = is_valid_step & is_slope_in_domain(next_slope)
    return params, is_valid_step, jnp.where(is_valid_step, next_slope - params.slope, 0.0)
