"""Minima of margins during a phase, as accurate as the integration.

During the integration, the solver step that contains the lowest minimum of each margin is stored.
Afterwards, a secant iteration for the root of the margin's time derivative locates each minimum.
The margins are refined one after another.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from vrw_jax.base.elementwise import select_trees_by_condition
from vrw_jax.base.types import Scalar
from vrw_jax.flow.minima import find_cubic_minimum, refine_minimum_location

StateArray = Float[Array, " dim"]
EvaluateGuardsAndMargins = Callable[[StateArray], Float[Array, " n_guards_and_margins"]]
"""Function that returns the values of all guards, followed by all margins, at a state."""


class GuardsAndMargins(NamedTuple):
    """Guards and margins that the integration evaluates during a phase.

    A guard ends the phase when it falls to zero. The integration computes the minimum of each
    margin over the phase.

    - `evaluate_guards_and_margins`: function that returns the guards, followed by the margins, at a
      state;
    - `n_guards`: number of guards;
    - `includes_phase_start`: whether the minimum of each margin includes its value at the start of
      the phase. The value is False for a margin that is zero there by construction, such as the
      height of a foot that leaves the ground. Interior minima and the value at the end are always
      included;
    - `guard_scales`: magnitude of the terms whose difference is the guard. A guard within some
      round-offs of this magnitude is treated as zero, because a guard that is negative only for
      microseconds has no better root;
    - `is_zero_at_start`: whether each guard is treated as zero at the start in spite of round-off.
      If the field is None, a guard is treated as zero if its value is 0 or within round-off of its
      scale.
    """

    evaluate_guards_and_margins: EvaluateGuardsAndMargins
    n_guards: int
    includes_phase_start: tuple[bool, ...] = ()
    guard_scales: Array | None = None
    is_zero_at_start: Bool[Array, " n_guards"] | None = None


GUARD_ROUNDOFF_IN_EPS = 32.0
"""Largest round-off error of a guard, in units of the machine epsilon times the guard's scale.

The value is chosen because a guard is a sum of several terms, each with its own round-off.
"""


def is_guard_at_roundoff(
    guards_and_margins: GuardsAndMargins,
    is_guard_crossing: Bool[Array, " n_guards"],
    guard_values: Float[Array, " n_guards"],
) -> tuple[Bool[Array, ""], Int[Array, ""]]:
    """Return whether the lowest crossing guard is zero within round-off, and its index.

    Guards are compared after division by their scales.
    """
    guard_scales = guards_and_margins.guard_scales
    scaled_guard_values = guard_values if guard_scales is None else guard_values / guard_scales
    scaled_guard_values = jnp.where(is_guard_crossing, scaled_guard_values, jnp.inf)
    is_guard_near_zero = (
        jnp.abs(jnp.min(scaled_guard_values))
        <= GUARD_ROUNDOFF_IN_EPS * jnp.finfo(scaled_guard_values.dtype).eps
    )
    return (
        is_guard_near_zero & (guard_scales is not None),
        jnp.argmin(scaled_guard_values).astype(jnp.int32),
    )


def find_guards_met_at_start(
    guards_and_margins: GuardsAndMargins,
    guard_values: Float[Array, " n_guards"],
    guard_rates: Float[Array, " n_guards"],
) -> tuple[Bool[Array, " n_guards"], Bool[Array, " n_guards"]]:
    """Return whether each guard ends the phase at the start, and whether it falls there.

    A guard ends the phase at the start if it is negative, or if it is zero and its time derivative
    is not positive. The second flag is True if such a guard is zero with a negative time
    derivative. Only then does the event time depend on the start state. `guard_rates` are the time
    derivatives of the guards.
    """
    is_guard_zero = guard_values == 0.0
    is_guard_met = (guard_values < 0.0) | (is_guard_zero & (guard_rates <= 0.0))
    if guards_and_margins.guard_scales is not None:
        guard_roundoff = GUARD_ROUNDOFF_IN_EPS * jnp.finfo(guard_values.dtype).eps
        is_guard_zero = guard_values >= -guard_roundoff * guards_and_margins.guard_scales
    if guards_and_margins.is_zero_at_start is not None:
        is_guard_zero = guards_and_margins.is_zero_at_start
        is_guard_met = jnp.where(is_guard_zero, guard_rates <= 0.0, is_guard_met)
    return is_guard_met, is_guard_met & is_guard_zero & (guard_rates < 0.0)


class SolverStepEnd(NamedTuple):
    """State, guards and margins at the end of the last accepted solver step."""

    end_time: Scalar
    state: StateArray
    state_rate: StateArray
    solver_state: Any
    guard_and_margin_values: Float[Array, " n_guards_and_margins"]
    guard_and_margin_rates: Float[Array, " n_guards_and_margins"]


def interpolate_by_cubics(
    step_start: SolverStepEnd, step_end: SolverStepEnd, step_length: Scalar
) -> tuple[Array, Array, Array, Array]:
    """Return the cubics through all guards and margins at both ends of a solver step.

    The result contains the four arguments of `evaluate_cubic`, without derivatives.
    """
    return lax.stop_gradient(
        (
            step_start.guard_and_margin_values,
            step_start.guard_and_margin_rates * step_length,
            step_end.guard_and_margin_values,
            step_end.guard_and_margin_rates * step_length,
        )
    )


class InteriorMarginMinima(NamedTuple):
    """Lowest interior minimum of each margin so far, and the solver step that contains it."""

    interior_minimum_values: Float[Array, " n"]  # infinite if a margin has no interior minimum
    step_start_state: Float[Array, "n dim"]
    step_length: Float[Array, " n"]  # length of the solver step, s
    time_to_minimum: Float[Array, " n"]  # time from the start of the solver step, s
    step_start_margin_rates: Float[Array, " n"]


class MarginMinimumRefinement(NamedTuple):
    """State of the secant iterations that refine the minima of the margins after the integration.

    The iterations find the time at which the time derivative of one margin is zero. They treat one
    margin after another.
    """

    margin_index: Int[Array, ""]
    n_iterations: Int[Array, ""]
    best_step_length: Scalar  # time from the step's start at which the rate was smallest, s
    best_margin_rate: Scalar
    # refined minima; before the refinement, the margins at the phase's start
    lowest_margin_values: Float[Array, " n"]


def make_empty_interior_margin_minima(
    guards_and_margins: GuardsAndMargins, start_state: StateArray
) -> InteriorMarginMinima:
    """Return an `InteriorMarginMinima` in which no margin has a minimum yet."""
    n_margins = len(guards_and_margins.includes_phase_start)
    zero_margins = jnp.zeros((n_margins,), start_state.dtype)
    return InteriorMarginMinima(
        zero_margins + jnp.inf,
        jnp.broadcast_to(start_state, (n_margins, len(start_state))),
        zero_margins,
        zero_margins,
        zero_margins,
    )


def update_interior_margin_minima(
    guards_and_margins: GuardsAndMargins,
    interior_margin_minima: InteriorMarginMinima,
    step_start: SolverStepEnd,
    step_end: SolverStepEnd,
    step_length: Scalar,
    is_step_in_phase: Bool[Array, ""],
) -> InteriorMarginMinima:
    """Return the lowest interior minima after one more solver step from `step_start` to `step_end`.

    - `step_length`: duration of the solver step, s;
    - `is_step_in_phase`: whether the step is part of the phase. If False, nothing changes.

    A margin has a minimum inside the step if its time derivative changes from negative to positive.
    A margin that is zero at the start of the phase by construction cannot fall there. Its negative
    time derivative at the start is round-off and is replaced by zero.
    """
    if not guards_and_margins.includes_phase_start:
        return interior_margin_minima
    start_margin_rates, end_margin_rates, step_length = lax.stop_gradient(
        (
            step_start.guard_and_margin_rates[guards_and_margins.n_guards :],
            step_end.guard_and_margin_rates[guards_and_margins.n_guards :],
            step_length,
        )
    )
    is_zero_at_phase_start = (step_start.end_time == 0.0) & ~jnp.asarray(
        guards_and_margins.includes_phase_start
    )
    start_margin_rates = jnp.where(
        is_zero_at_phase_start, jnp.maximum(start_margin_rates, 0.0), start_margin_rates
    )
    start_margin_values, _, end_margin_values, end_margin_changes = (
        x[guards_and_margins.n_guards :]
        for x in interpolate_by_cubics(step_start, step_end, step_length)
    )
    minimum_fractions, cubic_minimum_values = find_cubic_minimum(
        start_margin_values, start_margin_rates * step_length, end_margin_values, end_margin_changes
    )
    is_minimum_lower = (
        is_step_in_phase
        & (start_margin_rates < 0.0)
        & (end_margin_rates >= 0.0)
        & (cubic_minimum_values < interior_margin_minima.interior_minimum_values)
    )
    minima_in_step = InteriorMarginMinima(
        cubic_minimum_values,
        step_start.state,
        step_length,
        minimum_fractions * step_length,
        start_margin_rates,
    )
    return jax.tree.map(
        lambda new, previous: jnp.where(
            is_minimum_lower.reshape(-1, *(1,) * (previous.ndim - 1)), new, previous
        ),
        minima_in_step,
        interior_margin_minima,
    )


def select_entry_by_mask(entry_index: Int[Array, ""], stacked_entries: Array) -> Array:
    """Return the entry of `stacked_entries` at `entry_index` on the first axis, using a masked sum.

    In a batch, the masked sum is cheaper than a gather.
    """
    is_selected = jnp.arange(stacked_entries.shape[0]) == entry_index
    return jnp.sum(
        jnp.where(
            is_selected.reshape(-1, *(1,) * (stacked_entries.ndim - 1)), stacked_entries, 0.0
        ),
        axis=0,
    )


def select_flag(index: Int[Array, ""], flags: Bool[Array, " n"]) -> Bool[Array, ""]:
    return jnp.any(flags & (jnp.arange(len(flags)) == index))


def advance_margin_minimum_refinement(
    margin_minimum_refinement: MarginMinimumRefinement,
    guards_and_margins: GuardsAndMargins,
    interior_margin_minima: InteriorMarginMinima,
    tried_step_end: SolverStepEnd,
    step_length: Scalar,
    is_refining: Bool[Array, ""],
    is_phase_end: Bool[Array, ""],
    max_iterations: int,
    min_iterations: int = 3,
) -> tuple[MarginMinimumRefinement, Bool[Array, ""], Scalar]:
    """Return the next refinement state, whether another solver step is needed, and its length, s.

    After the integration, a secant iteration finds the time at which the time derivative of each
    margin is zero. Each iteration takes a solver step of `step_length` from the start of the solver
    step that contains the minimum.

    - `tried_step_end`: end of the last solver step;
    - `is_refining`: whether `tried_step_end` was such an iteration;
    - `is_phase_end`: whether the integration has ended, so that the first margin is refined next;
    - `max_iterations`, `min_iterations`: largest and smallest number of iterations per margin. The
      smallest number is required because each iteration makes the derivatives of the minimum's time
      accurate to more digits.
    """
    margin_values = tried_step_end.guard_and_margin_values[guards_and_margins.n_guards :]
    margin_rates = tried_step_end.guard_and_margin_rates[guards_and_margins.n_guards :]
    margin_index, n_iterations, best_step_length, best_margin_rate, lowest_margin_values = (
        margin_minimum_refinement
    )
    n_iterations = n_iterations + is_refining
    margin_value, margin_rate, minimum_step_length = (
        select_entry_by_mask(margin_index, x)
        for x in (margin_values, margin_rates, interior_margin_minima.step_length)
    )
    proposed_step_length, best_step_length, best_margin_rate, has_secant_converged = (
        refine_minimum_location(
            step_length,
            margin_rate,
            lax.stop_gradient(minimum_step_length),
            best_step_length,
            best_margin_rate,
        )
    )
    is_margin_refined = is_refining & (
        (n_iterations == max_iterations) | (has_secant_converged & (n_iterations >= min_iterations))
    )
    margin_indices = jnp.arange(margin_values.shape[0])
    lowest_margin_values = jnp.where(
        is_margin_refined & (margin_indices == margin_index),
        jnp.minimum(margin_value, lowest_margin_values),
        lowest_margin_values,
    )
    needs_margin_refinement = jnp.isfinite(interior_margin_minima.interior_minimum_values) & (
        is_phase_end | (margin_indices > margin_index)
    )
    is_next_margin_selected = is_phase_end | is_margin_refined
    margin_index = jnp.where(
        is_next_margin_selected, jnp.argmax(needs_margin_refinement).astype(jnp.int32), margin_index
    )
    time_to_minimum, step_start_margin_rate = lax.stop_gradient(
        (
            select_entry_by_mask(margin_index, interior_margin_minima.time_to_minimum),
            select_entry_by_mask(margin_index, interior_margin_minima.step_start_margin_rates),
        )
    )
    n_iterations, best_step_length, best_margin_rate = select_trees_by_condition(
        is_next_margin_selected,
        (0, 0.0, step_start_margin_rate),
        (n_iterations, best_step_length, best_margin_rate),
    )
    return (
        MarginMinimumRefinement(
            margin_index,
            n_iterations,
            best_step_length,
            best_margin_rate,
            lowest_margin_values,
        ),
        jnp.where(is_next_margin_selected, jnp.any(needs_margin_refinement), is_refining),
        jnp.where(is_next_margin_selected, time_to_minimum, proposed_step_length),
    )
