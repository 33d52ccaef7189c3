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
    """Functions monitored along a phase: guards that end the phase, then margins whose minimum is
    computed.

    - `evaluate`: function of the state that returns the guards, then the margins;
    - `includes_start`: whether each margin counts at the start of the phase. A margin that is zero
      there by construction does not count, such as the height of a foot that leaves the ground. All
      margins count at interior minima and at the end;
    - `guard_scales`: magnitude of the terms whose difference a guard is. A guard within some
      round-offs of this magnitude counts as zero, because a guard that is negative only for
      microseconds has no better root;
    - `is_zero_at_start`: guards that count as zero at the start in spite of round-off. If it is
      None, those guards count as zero that are exactly zero, or within round-off of their scales.
    """

    evaluate: EvaluateMonitored
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
    """Return whether the lowest crossing guard is zero up to round-off, and the index of that
    guard.
    """
    guard_scales = (
        jnp.ones_like(guard_values)
        if monitored_functions.guard_scales is None
        else monitored_functions.guard_scales
    )
    scaled_guards = jnp.where(is_crossing, guard_values / guard_scales, jnp.inf)
    is_near_zero = (
        jnp.abs(jnp.min(scaled_guards))
        <= GUARD_ROUNDOFF_IN_EPS * jnp.finfo(scaled_guards.dtype).eps
    )
    has_scales = monitored_functions.guard_scales is not None
    return is_near_zero & has_scales, jnp.argmin(scaled_guards).astype(jnp.int32)


def find_guards_met_at_start(
    monitored_functions: MonitoredFunctions,
    guard_values: Float[Array, " n_guards"],
    guard_rates: Float[Array, " n_guards"],
) -> tuple[Bool[Array, " n_guards"], Bool[Array, " n_guards"]]:
    """Return which guards end the phase at its start, and which guards fall through zero at the
    start.

    The other guards that end the phase are below zero, or at rest on zero. Their event time does
    not follow from the start. `guard_rates` are the guards' time derivatives.
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
    """End of the last accepted step of a phase. A rejected step does not change it."""

    time: Scalar
    state: StateArray
    solver_state: Any
    values: Float[Array, " n_watched"]
    rates: Float[Array, " n_watched"]


class InteriorMinimum(NamedTuple):
    """Lowest interior minimum of each margin so far, and the step that contains it."""

    value: Float[Array, " n"]
    start_state: Float[Array, "n dim"]
    step_length: Float[Array, " n"]  # length of the step from its start, s
    minimum_offset: Float[Array, " n"]  # time from the step's start to the minimum, s
    start_rate: Float[Array, " n"]

    @property
    def is_found(self) -> Bool[Array, " n"]:
        """Return whether each margin has an interior minimum."""
        return jnp.isfinite(self.value)


class MinimumRefinement(NamedTuple):
    """State of the secant iteration on a margin's rate, which follows the integration, one
    margin at a time.
    """

    margin_index: Int[Array, ""]
    n_iterations: Int[Array, ""]
    best_length: Scalar  # time from the step's start with the smallest rate so far, s
    best_rate: Scalar
    # refined minima, and before them the values at the phase's start
    lowest_values: Float[Array, " n"]


def make_empty_minimum(
    monitored_functions: MonitoredFunctions, start: StateArray
) -> InteriorMinimum:
    """Return the state of the search before the first step, without an interior minimum."""
    n = len(monitored_functions.includes_start)
    zeros = jnp.zeros((n,), start.dtype)
    return InteriorMinimum(zeros + jnp.inf, jnp.tile(start, (n, 1)), zeros, zeros, zeros)


def update_interior_minimum(
    monitored_functions: MonitoredFunctions,
    minimum: InteriorMinimum,
    step_start: AcceptedPhaseStep,
    step_end: AcceptedPhaseStep,
    length: Scalar,
    is_step_counted: Bool[Array, ""],
) -> InteriorMinimum:
    """Return the minima, updated with a step in which a margin's rate changes from negative to
    positive.

    A margin that is zero at the phase's start by construction is at rest at the start. A negative
    rate is then round-off and counts as zero.
    """
    if not monitored_functions.includes_start:
        return minimum
    v0, r0, v1, r1 = (
        lax.stop_gradient(v)[monitored_functions.n_guards :]
        for v in (step_start.values, step_start.rates, step_end.values, step_end.rates)
    )
    starts_at_zero = (step_start.time == 0.0) & ~jnp.asarray(monitored_functions.includes_start)
    r0 = jnp.where(starts_at_zero, jnp.maximum(r0, 0.0), r0)
    length = lax.stop_gradient(length)
    minimum_location, minimum_value = find_cubic_minimum(v0, r0 * length, v1, r1 * length)
    minimum_value = jnp.where(jnp.isfinite(minimum_value), minimum_value, jnp.minimum(v0, v1))
    is_minimum_lower = is_step_counted & (r0 < 0.0) & (r1 >= 0.0) & (minimum_value < minimum.value)
    return InteriorMinimum(
        jnp.where(is_minimum_lower, minimum_value, minimum.value),
        jnp.where(is_minimum_lower[:, None], step_start.state, minimum.start_state),
        jnp.where(is_minimum_lower, length, minimum.step_length),
        jnp.where(is_minimum_lower, minimum_location * length, minimum.minimum_offset),
        jnp.where(is_minimum_lower, r0, minimum.start_rate),
    )


def select_by_mask(entry_index: Int[Array, ""], stacked_entries: Array) -> Array:
    """Return the element at an index of the first axis, by a masked sum.

    In a batch, the sum is cheaper than a gather.
    """
    is_selected = jnp.arange(stacked_entries.shape[0]) == entry_index
    return jnp.sum(
        jnp.where(
            is_selected.reshape(-1, *(1,) * (stacked_entries.ndim - 1)), stacked_entries, 0.0
        ),
        axis=0,
    )


def advance_minimum_refinement(
    refinement: MinimumRefinement,
    monitored_functions: MonitoredFunctions,
    minimum: InteriorMinimum,
    step: AcceptedPhaseStep,
    length: Scalar,
    is_refining: Bool[Array, ""],
    is_starting: Bool[Array, ""],
    is_phase_end: Bool[Array, ""],
    max_iterations: int,
    min_tries: int = 3,
) -> tuple[MinimumRefinement, Bool[Array, ""], Scalar]:
    """Return the next state of the refinement, whether another step is needed, and its length, s.

    After the integration, secant steps on the rate locate each margin's minimum, in at most
    `max_iterations` steps. Each is a solver step of `length` from the start of the step that
    contains the minimum. The flag `is_refining` is True if `step` was such a step. At least
    `min_tries` steps are taken. The value is chosen because each step makes the location's
    derivatives accurate to more digits.
    """
    margin_values = step.values[monitored_functions.n_guards :]
    margin_rates = step.rates[monitored_functions.n_guards :]
    margin_index, n_iterations = refinement.margin_index, refinement.n_iterations + is_refining
    margin_value, margin_rate, step_length = (
        select_by_mask(margin_index, x) for x in (margin_values, margin_rates, minimum.step_length)
    )
    constant_rate, constant_length = lax.stop_gradient((margin_rate, length))
    length_change = constant_length - refinement.best_length
    rate_derivative = (constant_rate - refinement.best_rate) / jnp.where(
        length_change == 0.0, 1.0, length_change
    )
    is_secant_usable = (length_change != 0.0) & (rate_derivative > 0.0)
    proposed_length = length - jnp.where(
        is_secant_usable, margin_rate / jnp.where(is_secant_usable, rate_derivative, 1.0), 0.0
    )
    proposed_length = jnp.clip(proposed_length, 0.0, lax.stop_gradient(step_length))
    has_converged = jnp.abs(proposed_length - length) <= MINIMUM_LOCATION_TOLERANCE * step_length
    is_margin_done = is_refining & (
        (n_iterations == max_iterations) | (has_converged & (n_iterations >= min_tries))
    )
    has_smaller_rate = jnp.abs(constant_rate) < jnp.abs(refinement.best_rate)

    margin_indices = jnp.arange(margin_values.shape[0])
    lowest_values = jnp.where(
        is_margin_done & (margin_indices == margin_index),
        jnp.minimum(margin_value, refinement.lowest_values),
        refinement.lowest_values,
    )
    start_values = jnp.where(
        jnp.asarray(monitored_functions.includes_start), margin_values, jnp.inf
    )
    needs_refinement = minimum.is_found & (is_phase_end | (margin_indices > margin_index))
    begins_next_margin = is_phase_end | is_margin_done
    margin_index = jnp.where(
        begins_next_margin, jnp.argmax(needs_refinement).astype(jnp.int32), margin_index
    )
    minimum_offset, start_rate = lax.stop_gradient(
        (
            select_by_mask(margin_index, minimum.minimum_offset),
            select_by_mask(margin_index, minimum.start_rate),
        )
    )
    next_refinement = MinimumRefinement(
        margin_index=margin_index,
        n_iterations=jnp.where(begins_next_margin, 0, n_iterations),
        best_length=jnp.where(
            begins_next_margin,
            0.0,
            jnp.where(has_smaller_rate, constant_length, refinement.best_length),
        ),
        best_rate=jnp.where(
            begins_next_margin,
            start_rate,
            jnp.where(has_smaller_rate, constant_rate, refinement.best_rate),
        ),
        lowest_values=jnp.where(is_starting, start_values, lowest_values),
    )
    return (
        next_refinement,
        jnp.where(begins_next_margin, jnp.any(needs_refinement), is_refining),
        jnp.where(begins_next_margin, minimum_offset, proposed_length),
    )
