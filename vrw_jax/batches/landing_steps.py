"""Steps of the paper's wheel from just after one landing to just after the next.

Both landings leave both feet on the ground, so that the state has two numbers. The ground of a step
consists of two lines.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from vrw_jax import simd
from vrw_jax.batches.programs import run_compiled
from vrw_jax.integrator import load_explicit_tableau
from vrw_jax.models import (
    N_STEP_INPUTS,
    ViscoelasticWheel,
    compute_jacobian_columns,
    take_step_after_landing,
)
from vrw_jax.numerics import StepOptions
from vrw_jax.wheel import PARAMETER_NAMES, wheel_from_parameters

LANDING_STEP_INPUTS = (*PARAMETER_NAMES, "theta", "dtheta", "next_slope")
"""Inputs of a step with respect to which derivatives are available."""


class LandingSteps(NamedTuple):
    """Results of a batch of steps, with lanes on the last axis.

    If a step failed, its values are zero, except `event_order_margin`.
    """

    state: np.ndarray
    """(theta+, dtheta+) just after the next landing with both feet held, in the frame of the next
    line, (2, lanes), rad, rad/s."""
    rear_impulse: np.ndarray
    """Normal impulse of the rear foot in that landing, N s. If the impulse is negative, the landing
    releases the foot, and `state` is not the motion of the wheel."""
    event_order_margin: np.ndarray
    """Margin of the order of events, m^2/s; NaN if SLS-I was not reached.

    The margin is positive if Leg 2 meets its stopper before the next foot lands, and negative if
    that foot lands first. The margin and its first derivatives are continuous where both happen at
    once."""
    outcome: np.ndarray  # an Outcome
    durations: np.ndarray  # of DLS, SLS-I, SLS-II, (3, lanes), s
    jacobian: np.ndarray | None
    """Jacobian of (theta+, dtheta+, rear_impulse, event_order_margin) by the requested inputs,
    shape (inputs, 4, lanes); None if no derivatives were requested."""


def step_batch_after_landing(
    parameter_rows: np.ndarray,
    states: np.ndarray,
    next_slopes: np.ndarray,
    *,
    n_legs: int = 8,
    model: ViscoelasticWheel | None = None,
    options: StepOptions | None = None,
    derivatives: Sequence[str] = (),
) -> LandingSteps:
    """Return one step of every lane from landing to landing on uneven ground.

    Args:
        parameter_rows: parameters in the order of PARAMETER_NAMES, (9, lanes); the slope is that of
            the line under both feet.
        states: (theta+, dtheta+) just after a landing with both feet held, in the frame of that
            line, (2, lanes), rad, rad/s.
        next_slopes: slopes of the lines on which the steps end, (lanes,), rad.
        n_legs: number of legs of all wheels.
        model: model whose `stop_at_lift_off` applies.
        options: numerical choices.
        derivatives: names in `LANDING_STEP_INPUTS`.

    Raises:
        ValueError: the solver is not explicit.
    """
    model, options = model or ViscoelasticWheel(), options or StepOptions()
    tableau = load_explicit_tableau(options.solver)
    if tableau is None:
        raise ValueError(
            f"solver is {options.solver}, but lanes need an explicit one: take Dopri8."
        )
    option_leaves, options_structure = jax.tree.flatten(options)
    lane_independent = [np.asarray(leaf, parameter_rows.dtype) for leaf in option_leaves]
    n_parameters, stop_at_lift_off = len(PARAMETER_NAMES), model.stop_at_lift_off
    input_indices = tuple(LANDING_STEP_INPUTS.index(name) for name in derivatives)

    def step_lanes_after_landing(
        lane_independent: Any, lane_inputs: Any, straggler_count: Array | None = None
    ) -> tuple:
        current_options = jax.tree.unflatten(options_structure, lane_independent)
        if input_indices:
            current_options = current_options.with_derivative_tolerances()

        def landing_outputs(*lane_inputs: Array) -> tuple:
            params = wheel_from_parameters(lane_inputs[:n_parameters], n_legs, lane_inputs[-1])
            post_landing_state = lane_inputs[n_parameters:-1]
            landing_step = take_step_after_landing(
                params,
                post_landing_state,
                current_options,
                tableau,
                stop_at_lift_off,
                straggler_count,
            )
            diagnostics = (
                landing_step.is_unfinished,
                landing_step.outcome,
                jnp.stack(landing_step.durations),
            )
            return landing_step.landing_quantities, diagnostics

        if not input_indices:
            landing_quantities, diagnostics = landing_outputs(*lane_inputs)
            return (*diagnostics, landing_quantities)
        jacobian_columns, landing_quantities, diagnostics = compute_jacobian_columns(
            landing_outputs, lane_inputs, input_indices
        )
        return (*diagnostics, landing_quantities, jacobian_columns)

    cache_key = ("step after landing", n_legs, stop_at_lift_off, options_structure, input_indices)
    register_limits = simd.RegisterLimits(N_STEP_INPUTS) if input_indices else simd.DEFAULT_LIMITS
    lane_arrays = [*parameter_rows, *states, next_slopes]
    results = run_compiled(
        step_lanes_after_landing, lane_independent, lane_arrays, cache_key, register_limits
    )
    _, outcome, durations, landing_quantities, *jacobian_columns = results
    return LandingSteps(
        state=landing_quantities[:2],
        rear_impulse=landing_quantities[2],
        event_order_margin=np.where(durations[1] > 0.0, landing_quantities[3], np.nan),
        outcome=outcome,
        durations=durations,
        jacobian=jacobian_columns[0] if jacobian_columns else None,
    )
