"""Inputs of a step: section states and uneven ground, with the checks of both."""

import functools
import operator
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from vrw_jax.base.types import Elementwise
from vrw_jax.wheel.ground import GroundAhead, compute_foot_distance, compute_line_slope
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


def compute_rises(heights: Array, n_steps: int) -> Array:
    """Return the height of each of the n + 1 footholds of a walk minus that of the foothold before.

    If `heights` has n + 1 entries, the foothold before the walk lies on the mean line.
    """
    if jnp.shape(heights) not in ((n_steps + 1,), (n_steps + 2,)):
        raise ValueError(
            f"heights has shape {jnp.shape(heights)}, but a walk of {n_steps} steps of one wheel "
            f"takes {n_steps + 1} heights of footholds, or {n_steps + 2} with the foothold before "
            "the walk: map over batches of wheels with jax.vmap."
        )
    return jnp.diff(heights, prepend=0.0)[-(n_steps + 1) :]


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


def is_slope_in_domain(slope: Elementwise) -> Array:
    """Return whether a slope (rad) lies in the allowed domain. NaN gives False."""
    return jnp.asarray(PARAMETER_DOMAINS["slope"].contains_parameter_value(slope))


def select_stance_line(
    params: WheelParams, x: SectionStateEntries
) -> tuple[WheelParams, Array, GroundAhead | None]:
    """Return the wheel on the line under both feet, the validity of the step, and the ground ahead.

    A step may start only if parameters, start and ground are valid. On flat ground, the slope has
    as many axes as the other parameters, and the ground ahead is None. On uneven ground, the slope
    has a leading axis: the slopes of this line and of the next one, or the mean slope and two
    rises. These are the heights of the foothold on which the step begins, and of the next one, each
    minus the height of the foothold before.
    """
    if jnp.ndim(params.slope) == jnp.ndim(params.damping):
        return params, is_valid_start_state(params, x), None
    first_slope, *other_values = params.slope
    replace_slope = lambda slope: eqx.tree_at(lambda wheel: wheel.slope, params, slope)
    if len(other_values) == 1:
        params, next_slope = replace_slope(first_slope), other_values[0]
        is_valid_step = is_valid_start_state(params, x) & is_slope_in_domain(next_slope)
        tilt = jnp.where(is_valid_step, next_slope - params.slope, 0.0)
        return params, is_valid_step, GroundAhead(tilt)
    rise, next_rise = other_values
    theta = jnp.where(jnp.abs(x[0]) < 0.5 * jnp.pi, x[0], 0.0)
    foot_distance = compute_foot_distance(replace_slope(first_slope).symbols(), theta)
    params = replace_slope(find_stance_slope(first_slope, rise, foot_distance))
    is_valid_step = is_valid_start_state(params, x) & (jnp.abs(next_rise) < MAX_SI_VALUE)
    mask_invalid = lambda value: jnp.where(is_valid_step, value, 0.0)
    ground_ahead = GroundAhead(mask_invalid(first_slope - params.slope), mask_invalid(next_rise))
    return params, is_valid_step, ground_ahead


def find_stance_slope(
    mean_slope: Elementwise, rise: Elementwise, foot_distance: Elementwise
) -> Elementwise:
    """Return the slope of the line under both feet, rad, or an invalid slope if the rise exceeds
    the distance of the feet.
    """
    is_rise_possible = jnp.abs(rise) < foot_distance
    possible_rise = jnp.where(is_rise_possible, rise, 0.0)
    slope = compute_line_slope(mean_slope, possible_rise, foot_distance)
    return jnp.where(is_rise_possible, slope, IMPOSSIBLE_SLOPE)


IMPOSSIBLE_SLOPE = jnp.pi
"""Slope outside the domain of slopes, so that a step on it is BAD_INPUT, rad."""
