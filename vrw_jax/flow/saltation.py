"""Determinant of the flow's Jacobian over a sequence of modes and events.

The computation uses Liouville's formula and saltation matrices.
"""

import functools
from collections.abc import Sequence

import jax
import jax.numpy as jnp
from jax import lax
from jax.typing import ArrayLike
from jaxtyping import Array

from vrw_jax.base.checks import check_reals
from vrw_jax.base.forward_only import forbid_reverse_mode
from vrw_jax.base.options import StepOptions
from vrw_jax.base.types import Scalar
from vrw_jax.flow.hybrid_simulation import Guard, HybridSolution, Mode, convert_modes_to_tuple
from vrw_jax.flow.phase_integration import sample_phase
from vrw_jax.lanes.saved_traces import call_compiled_program


def flow_jacobian_determinant(
    modes: Sequence[Mode] | Mode,
    start: ArrayLike | Sequence,
    solution: HybridSolution,
    options: StepOptions | None = None,
) -> Scalar:
    """Return the determinant of the flow's Jacobian from `start` to the last event.

    The Jacobian is that of the state after the event's reset with respect to `start`.

    Each mode contributes the exponential of the time integral of its field's divergence
    (Liouville). Each event contributes the determinant of its saltation matrix (R. I. Leine and H.
    Nijmeijer, Dynamics and Bifurcations of Non-Smooth Mechanical Systems, 2004, section 7). For an
    orbit that is periodic after these events, the result is the product of all multipliers. This
    product includes the multiplier 1 in the direction of the flow.

    The Jacobian of a return map does not yield this product accurately if a guard is grazed. The
    entries of the Jacobian then grow in inverse proportion to the guard's time derivative.

    The result is NaN if the number of solver steps reaches its limit. All transforms of JAX except
    reverse mode are supported.

    Args:
        modes: modes of the system, as in `simulate_hybrid`.
        start: state at which `solution` begins, shape (dim,).
        solution: result of `simulate_hybrid`.
        options: options of the integration.
    """
    options = StepOptions() if options is None else options
    modes, start = convert_modes_to_tuple(modes), check_reals("start", start)
    flow_determinant = call_compiled_program(
        _multiply_event_determinants, modes, start, solution, options
    )
    return forbid_reverse_mode("flow_jacobian_determinant", flow_determinant)


def _multiply_event_determinants(
    modes: tuple[Mode, ...], start: Array, solution: HybridSolution, options: StepOptions
) -> Scalar:
    event_determinant_functions = [
        functools.partial(_compute_event_determinant, mode, guard, options)
        for mode in modes
        for guard in mode.guards
    ]
    first_guard_index_by_mode = jnp.cumsum(jnp.asarray([0, *(len(mode.guards) for mode in modes)]))[
        :-1
    ]
    phase_start_states, durations = solution.find_phases(start)
    next_modes = jnp.append(solution.modes[1:], solution.mode)
    event_indices = jnp.arange(len(solution.times))
    next_modes = jnp.where(event_indices == solution.n_events - 1, solution.mode, next_modes)
    vector_fields = [mode.field for mode in modes]

    def compute_event_determinant(event_inputs: tuple) -> Array:
        (
            event_determinant_index,
            next_mode,
            start_state,
            state_before_event,
            state_after_event,
            mode_duration,
        ) = event_inputs
        return lax.switch(
            event_determinant_index,
            event_determinant_functions,
            start_state,
            state_before_event,
            lax.switch(next_mode, vector_fields, state_after_event),
            mode_duration,
        )

    event_inputs_by_event = (
        first_guard_index_by_mode[solution.modes] + solution.guards,
        next_modes,
        phase_start_states, solution.states_before, solution.states_after, durations,
    )  # fmt: skip
    event_determinants = lax.map(compute_event_determinant, event_inputs_by_event)
    return jnp.prod(jnp.where(event_indices < solution.n_events, event_determinants, 1.0))


def _compute_event_determinant(
    mode: Mode,
    guard: Guard,
    options: StepOptions,
    start: Array,
    state_before_event: Array,
    field_after_event: Array,
    mode_duration: Array,
) -> Array:
    """Return one factor of the determinant.

    The factor is that of one phase in `mode` and of the event of `guard` that ends the phase.
    """

    def evaluate_flow_and_divergence(augmented_state: Array) -> Array:
        state = augmented_state[:-2]
        divergence = jnp.trace(jax.jacfwd(mode.field)(state))
        return jnp.concatenate(
            [mode.field(state), jnp.stack([divergence, jnp.ones_like(divergence)])]
        )

    end_state = sample_phase(
        evaluate_flow_and_divergence, jnp.append(start, jnp.zeros(2)), mode_duration, 2, options
    )[-1]
    # Otherwise the solver steps were exhausted.
    has_reached_end = jnp.abs(end_state[-1] - mode_duration) <= 1e-9 * mode_duration
    reset_jacobian = jax.jacfwd(guard.reset)(state_before_event)
    guard_gradient = jax.jacfwd(guard.value)(state_before_event)
    field_before_event = mode.field(state_before_event)
    saltation_matrix = reset_jacobian + jnp.outer(
        field_after_event - reset_jacobian @ field_before_event, guard_gradient
    ) / (guard_gradient @ field_before_event)
    return jnp.where(
        has_reached_end, jnp.exp(end_state[-2]) * jnp.linalg.det(saltation_matrix), jnp.nan
    )
