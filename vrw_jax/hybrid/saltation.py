"""Determinant of the flow's Jacobian through modes and events.

It follows from Liouville's formula and from saltation matrices.
"""

from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
from jax import lax
from jax.typing import ArrayLike
from jaxtyping import Array

from vrw_jax.hybrid.phase_integration import sample_phase
from vrw_jax.hybrid.program_cache import call_compiled
from vrw_jax.hybrid.simulation import Guard, HybridSolution, Mode, normalize_modes
from vrw_jax.numerics import Scalar, StepOptions, forbid_reverse_mode
from vrw_jax.validation import check_reals


def flow_jacobian_determinant(
    modes: Sequence[Mode] | Mode,
    start: ArrayLike | Sequence,
    solution: HybridSolution,
    options: StepOptions | None = None,
) -> Scalar:
    """Return the determinant of the final state's Jacobian with respect to `start`, after the last
    event.

    It is the exponential of the field's divergence integrated along each mode (Liouville), times
    the determinant of each event's saltation matrix (R. I. Leine and H. Nijmeijer, Dynamics and
    Bifurcations of Non-Smooth Mechanical Systems, 2004, section 7). For an orbit that is periodic
    after these events, it is the product of all multipliers, including the 1 along the orbit. A
    return map's Jacobian loses the digits of that product if a guard is grazed, because its entries
    grow as one over the guard's rate.

    The result is NaN if the solver steps are exhausted. Transforms of JAX apply, except reverse
    mode.
    """
    options = StepOptions() if options is None else options
    modes, start = normalize_modes(modes), check_reals("start", start)
    determinant = call_compiled(_multiply_event_determinants, modes, start, solution, options)
    return forbid_reverse_mode("flow_jacobian_determinant", determinant)


def _multiply_event_determinants(
    modes: tuple[Mode, ...], start: Array, solution: HybridSolution, options: StepOptions
) -> Scalar:
    event_determinant_functions = [
        _make_event_determinant_function(mode, guard, options)
        for mode in modes
        for guard in mode.guards
    ]
    first_guards = jnp.cumsum(jnp.asarray([0, *(len(mode.guards) for mode in modes)]))[:-1]
    phase_starts = jnp.concatenate([start[None], solution.states_after[:-1]])
    durations = jnp.diff(solution.times, prepend=0.0)
    next_modes = jnp.append(solution.modes[1:], solution.mode)
    event_indices = jnp.arange(len(solution.times))
    next_modes = jnp.where(event_indices == solution.n_events - 1, solution.mode, next_modes)
    vector_fields = [mode.field for mode in modes]

    def multiply_event(determinant: Array, event_data: tuple) -> tuple[Array, None]:
        (
            event_index,
            start_state,
            state_before,
            state_after,
            mode_duration,
            factor_index,
            next_mode,
        ) = event_data
        next_flow = lax.switch(next_mode, vector_fields, state_after)
        event_determinant = lax.switch(
            factor_index,
            event_determinant_functions,
            start_state,
            state_before,
            next_flow,
            mode_duration,
        )
        return determinant * jnp.where(
            event_index < solution.n_events, event_determinant, 1.0
        ), None

    event_data_by_event = (
        event_indices, phase_starts, solution.states_before, solution.states_after, durations,
        first_guards[solution.modes] + solution.guards,
        next_modes,
    )  # fmt: skip
    return lax.scan(multiply_event, jnp.ones((), start.dtype), event_data_by_event)[0]


def _make_event_determinant_function(mode: Mode, guard: Guard, options: StepOptions) -> Callable:
    """Return the function that computes the determinant's factor of one mode and of the guard that
    ends it.
    """

    def flow_with_divergence(z: Array) -> Array:
        y = z[:-2]
        divergence = jnp.trace(jax.jacfwd(mode.field)(y))
        return jnp.concatenate([mode.field(y), jnp.stack([divergence, jnp.ones_like(divergence)])])

    def evaluate_factor(
        start: Array, state_before: Array, next_flow: Array, duration: Array
    ) -> Array:
        end_state = sample_phase(
            flow_with_divergence, jnp.append(start, jnp.zeros(2)), duration, 2, options
        )[-1]
        # Otherwise the solver steps were exhausted.
        is_end_reached = jnp.abs(end_state[-1] - duration) <= 1e-9 * duration
        reset_jacobian = jax.jacfwd(guard.reset)(state_before)
        guard_gradient = jax.jacfwd(guard.value)(state_before)
        flow_before = mode.field(state_before)
        saltation_matrix = reset_jacobian + jnp.outer(
            next_flow - reset_jacobian @ flow_before, guard_gradient
        ) / (guard_gradient @ flow_before)
        return jnp.where(
            is_end_reached, jnp.exp(end_state[-2]) * jnp.linalg.det(saltation_matrix), jnp.nan
        )

    return evaluate_factor
