"""Minima of margins along a phase, as accurate as the integration.

During the integration, the step that contains the lowest minimum of each margin is stored.
Afterwards, secant steps on the margin's rate locate the minimum, one margin after another.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from vrw_jax.numerics import MINIMUM_LOCATION_TOLERANCE, Scalar, find_cubic_minimum

StateArray = Float[Array, " dim"]
EvaluateMonitored = Callable[[StateArray], Float[Array, " n_watched"]]
"""Function of the state that returns guards and margins."""


class MonitoredFunctions(NamedTuple):
    """Functions that are evaluated along a phase: guards, which end the phase, and margins, whose
    minima are computed.

    - `evaluate_monitored`: function of the state that returns the guards, then the margins;
    - `includes_start`: whether each margin counts at the start of the phase. A margin that is zero
      there by construction does not count, such as the height of a foot that leaves the ground. All
      margins count at interior minima and at the end;
    - `guard_scales`: magnitude of the terms whose difference is the guard. A guard within some
      round-offs of this magnitude counts as zero, because a guard that is negative only for
      microseconds has no better root;
    - `is_zero_at_start`: whether each guard counts as zero at the start in spite of round-off. With
      None, a guard counts as zero if it is exactly zero or within round-off of its scale.
    """

    evaluate_monitored: EvaluateMonitored
    n_guards: int
    includes_start: tuple[bool, ...] = ()
    guard_scales: Array | None = None
    is_zero_at_start: Bool[Array, " n_guards"] | None = None


GUARD_ROUNDOFF_IN_EPS = 32.0
"""Round-off of a guard's value, in units of the round-off of its scale.

It is chosen because a guard is a sum of several terms, each with its own round-off.
"""


def is_guard_at_roundoff(
    monitored_functions: MonitoredFunctions,
    is_crossing: Bool[Array, " n_guards"],
    guard_values: Float[Array, " n_guards"],
) -> tuple[Bool[Array, ""], Int[Array, ""]]:
    """Return whether the lowest of the crossing guards is zero up to round-off, and its index."""
    guard_scales = (
        jnp.ones_like(guard_values)
        if monitored_functions.guard_scales is None
        else monitored_functions.guard_scales
    )
    scaled_guards = jnp.where(is_crossing, guard_values / guard_scales, jnp.inf)
    is_guard_near_zero = (
        jnp.abs(jnp.min(scaled_guards))
        <= GUARD_ROUNDOFF_IN_EPS * jnp.finfo(scaled_guards.dtype).eps
    )
    has_guard_scales = monitored_functions.guard_scales is not None
    return is_guard_near_zero & has_guard_scales, jnp.argmin(scaled_guards).astype(jnp.int32)


def find_guards_met_at_start(
    monitored_functions: MonitoredFunctions,
    guard_values: Float[Array, " n_guards"],
    guard_rates: Float[Array, " n_guards"],
) -> tuple[Bool[Array, " n_guards"], Bool[Array, " n_guards"]]:
    """Return whether each guard ends the phase at its start, and whether it falls through zero
    there.

    A guard that ends the phase without falling through zero is below zero, or stays at zero. Its
    event time does not depend on the start state. `guard_rates` are the time derivatives of the
    guards.
    """
    ends_phase = (guard_values < 0.0) | ((guard_values == 0.0) & (guard_rates <= 0.0))
    is_guard_zero = guard_values == 0.0
    if monitored_functions.guard_scales is not None:
        guard_roundoff = GUARD_ROUNDOFF_IN_EPS * jnp.finfo(guard_values.dtype).eps
        is_guard_zero = is_guard_zero | (
            guard_values >= -guard_roundoff * monitored_functions.guard_scales
        )
    if monitored_functions.is_zero_at_start is not None:
        is_guard_zero = monitored_functions.is_zero_at_start
        ends_phase = jnp.where(is_guard_zero, guard_rates <= 0.0, ends_phase)
    return ends_phase, ends_phase & is_guard_zero & (guard_rates < 0.0)


class AcceptedPhaseStep(NamedTuple):
    """End of the last accepted solver step of a phase, with the monitored functions there."""

    end_time: Scalar
    state: StateArray
    solver_state: Any
    monitored_values: Float[Array, " n_watched"]
    monitored_rates: Float[Array, " n_watched"]


class InteriorMinimum(NamedTuple):
    """Lowest interior minimum of each margin so far, and the solver step that contains it."""

    minimum_values: Float[Array, " n"]
    start_state: Float[Array, "n dim"]
    step_length: Float[Array, " n"]  # length of the step from its start, s
    time_to_minimum: Float[Array, " n"]  # time from the step's start to the minimum, s
    start_margin_rates: Float[Array, " n"]

    @property
    def has_minimum(self) -> Bool[Array, " n"]:
        """Return whether each margin has an interior minimum, (margins,)."""
        return jnp.isfinite(self.minimum_values)


class MinimumRefinement(NamedTuple):
    """State of the secant iterations that refine the minima after the integration.

    Each iteration is on the rate of one margin, and the margins follow one another.
    """

    margin_index: Int[Array, ""]
    n_iterations: Int[Array, ""]
    best_step_length: Scalar  # time from the step's start with the smallest rate so far, s
    best_margin_rate: Scalar
    # refined minima, and before them the values at the phase's start
    lowest_margin_values: Float[Array, " n"]


def make_empty_interior_minimum(
    monitored_functions: MonitoredFunctions, start: StateArray
) -> InteriorMinimum:
    """Return the interior minima before the first solver step: no margin has a minimum."""
    n_margins = len(monitored_functions.includes_start)
    zero_margins = jnp.zeros((n_margins,), start.dtype)
    return InteriorMinimum(
        zero_margins + jnp.inf,
        jnp.tile(start, (n_margins, 1)),
        zero_margins,
        zero_margins,
        zero_margins,
    )


def update_interior_minimum(
    monitored_functions: MonitoredFunctions,
    interior_minimum: InteriorMinimum,
    step_start: AcceptedPhaseStep,
    step_end: AcceptedPhaseStep,
    length: Scalar,
    is_step_counted: Bool[Array, ""],
) -> InteriorMinimum:
    """Return the interior minima, updated with the minima inside one solver step.

    A margin has a minimum inside the step if its rate changes from negative to positive. The rate
    of a margin that is zero at the start of the phase by construction is also zero there, so that a
    negative rate is round-off and counts as zero.
    """
    if not monitored_functions.includes_start:
        return interior_minimum
    start_margins, start_rates, end_margins, end_rates = (
        lax.stop_gradient(v)[monitored_functions.n_guards :]
        for v in (
            step_start.monitored_values,
            step_start.monitored_rates,
            step_end.monitored_values,
            step_end.monitored_rates,
        )
    )
    is_zero_at_phase_start = (step_start.end_time == 0.0) & ~jnp.asarray(
        monitored_functions.includes_start
    )
    start_rates = jnp.where(is_zero_at_phase_start, jnp.maximum(start_rates, 0.0), start_rates)
    length = lax.stop_gradient(length)
    minimum_fraction, minimum_margins = find_cubic_minimum(
        start_margins, start_rates * length, end_margins, end_rates * length
    )
    minimum_margins = jnp.where(
        jnp.isfinite(minimum_margins), minimum_margins, jnp.minimum(start_margins, end_margins)
    )
    is_minimum_lower = (
        is_step_counted
        & (start_rates < 0.0)
        & (end_rates >= 0.0)
        & (minimum_margins < interior_minimum.minimum_values)
    )
    return InteriorMinimum(
        jnp.where(is_minimum_lower, minimum_margins, interior_minimum.minimum_values),
        jnp.where(is_minimum_lower[:, None], step_start.state, interior_minimum.start_state),
        jnp.where(is_minimum_lower, length, interior_minimum.step_length),
        jnp.where(is_minimum_lower, minimum_fraction * length, interior_minimum.time_to_minimum),
        jnp.where(is_minimum_lower, start_rates, interior_minimum.start_margin_rates),
    )


def select_entry_by_mask(entry_index: Int[Array, ""], stacked_entries: Array) -> Array:
    """Return the entry at an index of the first axis, computed as a masked sum.

    In a batch, the masked sum is cheaper than a gather.
    """
    is_selected = jnp.arange(stacked_entries.shape[0]) == entry_index
    return jnp.sum(
        jnp.where(
            is_selected.reshape(-1, *(1,) * (stacked_entries.ndim - 1)), stacked_entries, 0.0
        ),
        axis=0,
    )


def advance_minimum_refinement(
    minimum_refinement: MinimumRefinement,
    monitored_functions: MonitoredFunctions,
    interior_minimum: InteriorMinimum,
    tried_step: AcceptedPhaseStep,
    length: Scalar,
    is_refining: Bool[Array, ""],
    begins_refinement: Bool[Array, ""],
    is_phase_end: Bool[Array, ""],
    max_iterations: int,
    min_tries: int = 3,
) -> tuple[MinimumRefinement, Bool[Array, ""], Scalar]:
    """Return the next state of the refinement, whether another step is needed, and its length, s.

    After the integration, secant steps on its rate locate the minimum of each margin. Each secant
    step is a solver step of `length` from the start of the step that contains the minimum. The flag
    `is_refining` is True if `tried_step` was such a step. At least `min_tries` and at most
    `max_iterations` steps are taken. A least number is required because each step makes the
    derivatives of the location accurate to more digits.
    """
    margin_values = tried_step.monitored_values[monitored_functions.n_guards :]
    margin_rates = tried_step.monitored_rates[monitored_functions.n_guards :]
    margin_index = minimum_refinement.margin_index
    n_iterations = minimum_refinement.n_iterations + is_refining
    margin_value, margin_rate, step_length = (
        select_entry_by_mask(margin_index, x)
        for x in (margin_values, margin_rates, interior_minimum.step_length)
    )
    margin_rate_value, step_length_value = lax.stop_gradient((margin_rate, length))
    length_change = step_length_value - minimum_refinement.best_step_length
    margin_rate_slope = (margin_rate_value - minimum_refinement.best_margin_rate) / jnp.where(
        length_change == 0.0, 1.0, length_change
    )
    is_secant_usable = (length_change != 0.0) & (margin_rate_slope > 0.0)
    proposed_step_length = length - jnp.where(
        is_secant_usable, margin_rate / jnp.where(is_secant_usable, margin_rate_slope, 1.0), 0.0
    )
    proposed_step_length = jnp.clip(proposed_step_length, 0.0, lax.stop_gradient(step_length))
    has_secant_converged = (
        jnp.abs(proposed_step_length - length) <= MINIMUM_LOCATION_TOLERANCE * step_length
    )
    is_margin_done = is_refining & (
        (n_iterations == max_iterations) | (has_secant_converged & (n_iterations >= min_tries))
    )
    has_smaller_margin_rate = jnp.abs(margin_rate_value) < jnp.abs(
        minimum_refinement.best_margin_rate
    )

    margin_indices = jnp.arange(margin_values.shape[0])
    lowest_margin_values = jnp.where(
        is_margin_done & (margin_indices == margin_index),
        jnp.minimum(margin_value, minimum_refinement.lowest_margin_values),
        minimum_refinement.lowest_margin_values,
    )
    start_margin_values = jnp.where(
        jnp.asarray(monitored_functions.includes_start), margin_values, jnp.inf
    )
    needs_refinement = interior_minimum.has_minimum & (
        is_phase_end | (margin_indices > margin_index)
    )
    begins_next_margin = is_phase_end | is_margin_done
    margin_index = jnp.where(
        begins_next_margin, jnp.argmax(needs_refinement).astype(jnp.int32), margin_index
    )
    minimum_offset, start_rate = lax.stop_gradient(
        (
            select_entry_by_mask(margin_index, interior_minimum.time_to_minimum),
            select_entry_by_mask(margin_index, interior_minimum.start_margin_rates),
        )
    )
    next_refinement = MinimumRefinement(
        margin_index=margin_index,
        n_iterations=jnp.where(begins_next_margin, 0, n_iterations),
        best_step_length=jnp.where(
            begins_next_margin,
            0.0,
            jnp.where(
                has_smaller_margin_rate, step_length_value, minimum_refinement.best_step_length
            ),
        ),
        best_margin_rate=jnp.where(
            begins_next_margin,
            start_rate,
            jnp.where(
                has_smaller_margin_rate, margin_rate_value, minimum_refinement.best_margin_rate
            ),
        ),
        lowest_margin_values=jnp.where(
            begins_refinement, start_margin_values, lowest_margin_values
        ),
    )
    return (
        next_refinement,
        jnp.where(begins_next_margin, jnp.any(needs_refinement), is_refining),
        jnp.where(begins_next_margin, minimum_offset, proposed_step_length),
    )
