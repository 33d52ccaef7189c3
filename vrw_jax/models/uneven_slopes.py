"""Slopes of uneven ground: straight lines that join the footholds."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array

from vrw_jax.models.section_states import StateValues, is_valid_start
from vrw_jax.numerics import Elementwise
from vrw_jax.wheel import PARAMETER_DOMAINS, WheelParams


def complete_slopes(slope: Array, n_steps: int) -> Array:
    """Return the slopes of the n + 1 lines of n steps, rad; the last of n given slopes is used
    twice.
    """
    check_step_values("slope", slope, n_steps)
    return slope if len(slope) > n_steps else jnp.append(slope, slope[-1:])


def check_step_values(name: str, values: Array, n_steps: int) -> None:
    """Raise a ValueError for an array with neither one value per step nor one more."""
    if jnp.shape(values) not in ((n_steps,), (n_steps + 1,)):
        steps = "a step" if n_steps == 1 else f"a walk of {n_steps} steps"
        raise ValueError(
            f"{name} has shape {jnp.shape(values)}, but {steps} of one wheel takes one number, or "
            f"an array of {n_steps} or {n_steps + 1} over its steps: map over batches of wheels "
            "with jax.vmap."
        )


def split_slopes(params: WheelParams) -> tuple[WheelParams, Elementwise | None]:
    """Return the wheel on the line under both feet in double support, and the slope of the next
    line, rad.

    On uneven ground `params.slope` has both of them on a leading axis that no other parameter has;
    on flat ground it has none, and the second result is None.
    """
    if jnp.ndim(params.slope) == jnp.ndim(params.damping):
        return params, None
    slope, ahead = params.slope[0], params.slope[1]
    return eqx.tree_at(lambda wheel: wheel.slope, params, slope), ahead


def is_valid_slope(slope: Elementwise) -> Array:
    """Return whether a slope lies in its domain; False for NaN."""
    return jnp.asarray(PARAMETER_DOMAINS["slope"].contains(slope))


def select_line(
    params: WheelParams, x: StateValues
) -> tuple[WheelParams, Array, Elementwise | None]:
    """Return the wheel on the line under both feet, whether a step may begin, and the angle by
    which the next line is steeper, rad; None on flat ground.
    """
    params, ahead = split_slopes(params)
    good = is_valid_start(params, x)
    if ahead is None:
        return params, good, None
    good = good & is_valid_slope(ahead)
    return params, good, jnp.where(good, ahead - params.slope, 0.0)
