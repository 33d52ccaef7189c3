"""Minima of margins along a phase, as accurate as the integration.

During the integration, the step that contains the lowest minimum of each margin is stored.
Afterwards, secant steps on the margin's rate locate the minimum, one margin after the other.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from vrw_jax.numerics import MINIMUM_LOCATION_TOLERANCE, Scalar, find_cubic_minimum

StateVector = Float[Array, " dim"]
MonitorFn = Callable[[StateVector], Float[Array, " n_watched"]]
"""Guards and margins as a function of the state."""


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

    evaluate: MonitorFn
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
    guards: Float[Array, " n_guards"],
) -> tuple[Bool[Array, ""], Int[Array, ""]]:
    """Return whether the lowest crossing guard is zero up to round-off, and the index of that
    guard.
    """
    guard_scales = (
        jnp.ones_like(guards)
        if monitored_functions.guard_scales is None
        else monitored_functions.guard_scales
    )
    scaled_guards = jnp.where(is_crossing, guards / guard_scales, jnp.inf)
    is_near_zero = (
        jnp.abs(jnp.min(scaled_guards))
        <= GUARD_ROUNDOFF_IN_EPS * jnp.finfo(scaled_guards.dtype).eps
    )
    has_scales = monitored_functions.guard_scales is not None
    return is_near_zero & has_scales, jnp.argmin(scaled_guards).astype(jnp.int32)


def find_guards_met_at_start(
    monitored_functions: MonitoredFunctions,
    guards: Float[Array, " n_guards"],
    rates: Float[Array, " n_guards"],
) -> tuple[Bool[Array, " n_guards"], Bool[Array, " n_guards"]]:
    """Return which guards end the phase at its start, and which of them fall through zero there.

    The other guards that end it are below zero, or at rest on it, so their event time does not
    follow from the start. `rates` are the guards' time derivatives.
    """
    ends_phase = (guards < 0.0) | ((guards == 0.0) & (rates <= 0.0))
    is_zero = guards == 0.0
    if monitored_functions.guard_scales is not None:
        roundoff = GUARD_ROUNDOFF_IN_EPS * jnp.finfo(guards.dtype).eps
        is_zero = is_zero | (guards >= -roundoff * monitored_functions.guard_scales)
    if monitored_functions.is_zero_at_start is not None:
        is_zero = monitored_functions.is_zero_at_start
        ends_phase = jnp.where(is_zero, rates <= 0.0, ends_phase)
    return ends_phase, ends_phase & is_zero & (rates < 0.0)


class AcceptedPhaseStep(NamedTuple):
    """The end of the last accepted step; a rejected step does not change it."""

    time: Scalar
    state: StateVector
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
        """Whether each margin has an interior minimum."""
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


def empty_minimum(monitored_functions: MonitoredFunctions, start: StateVector) -> InteriorMinimum:
    """Return the state of the search that has found no interior minimum, before the first step."""
    n = len(monitored_functions.includes_start)
    zeros = jnp.zeros((n,), start.dtype)
    return InteriorMinimum(zeros + jnp.inf, jnp.tile(start, (n, 1)), zeros, zeros, zeros)


def update_minimum(
    monitored_functions: MonitoredFunctions,
    minimum: InteriorMinimum,
    step_start: AcceptedPhaseStep,
    step_end: AcceptedPhaseStep,
    length: Scalar,
    is_counted: Bool[Array, ""],
) -> InteriorMinimum:
    """Return the minima, updated with a step in which a margin's rate changes from negative to
    positive.

    A margin that is zero at the phase's start by construction is at rest there, so a negative rate
    is round-off and counts as zero.
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
    location, value = find_cubic_minimum(v0, r0 * length, v1, r1 * length)
    value = jnp.where(jnp.isfinite(value), value, jnp.minimum(v0, v1))
    is_lower = is_counted & (r0 < 0.0) & (r1 >= 0.0) & (value < minimum.value)
    return InteriorMinimum(
        jnp.where(is_lower, value, minimum.value),
        jnp.where(is_lower[:, None], step_start.state, minimum.start_state),
        jnp.where(is_lower, length, minimum.step_length),
        jnp.where(is_lower, location * length, minimum.minimum_offset),
        jnp.where(is_lower, r0, minimum.start_rate),
    )


def select_entry(index: Int[Array, ""], entries: Array) -> Array:
    """Return the entry at an index of the first axis, by a masked sum, which is cheaper than a
    gather in a batch.
    """
    is_selected = jnp.arange(entries.shape[0]) == index
    return jnp.sum(
        jnp.where(is_selected.reshape(-1, *(1,) * (entries.ndim - 1)), entries, 0.0), axis=0
    )


def refine_minimum(
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
    """Return the next state of the refinement, whether another step is needed, and the length of
    that step, s.

    After the integration, secant steps on the rate locate each margin's minimum, in at most
    `max_iterations` steps. Each is a solver step of `length` from the start of the step that
    contains the minimum. The flag `is_refining` is True if `step` was such a step. At least
    `min_tries` of them are taken, chosen because each makes the location's derivatives accurate to
    more digits.
    """
    values = step.values[monitored_functions.n_guards :]
    rates = step.rates[monitored_functions.n_guards :]
    margin_index, n_iterations = refinement.margin_index, refinement.n_iterations + is_refining
    value, rate, step_length = (
        select_entry(margin_index, x) for x in (values, rates, minimum.step_length)
    )
    constant_rate, constant_length = lax.stop_gradient((rate, length))
    length_change = constant_length - refinement.best_length
    rate_derivative = (constant_rate - refinement.best_rate) / jnp.where(
        length_change == 0.0, 1.0, length_change
    )
    is_usable = (length_change != 0.0) & (rate_derivative > 0.0)
    proposed_length = length - jnp.where(
        is_usable, rate / jnp.where(is_usable, rate_derivative, 1.0), 0.0
    )
    proposed_length = jnp.clip(proposed_length, 0.0, lax.stop_gradient(step_length))
    has_converged = jnp.abs(proposed_length - length) <= MINIMUM_LOCATION_TOLERANCE * step_length
    is_done = is_refining & (
        (n_iterations == max_iterations) | (has_converged & (n_iterations >= min_tries))
    )
    is_better = jnp.abs(constant_rate) < jnp.abs(refinement.best_rate)

    margin_indices = jnp.arange(values.shape[0])
    lowest_values = jnp.where(
        is_done & (margin_indices == margin_index),
        jnp.minimum(value, refinement.lowest_values),
        refinement.lowest_values,
    )
    start_values = jnp.where(jnp.asarray(monitored_functions.includes_start), values, jnp.inf)
    needs_refinement = minimum.is_found & (is_phase_end | (margin_indices > margin_index))
    begins_next_margin = is_phase_end | is_done
    margin_index = jnp.where(
        begins_next_margin, jnp.argmax(needs_refinement).astype(jnp.int32), margin_index
    )
    minimum_offset, start_rate = lax.stop_gradient(
        (
            select_entry(margin_index, minimum.minimum_offset),
            select_entry(margin_index, minimum.start_rate),
        )
    )
    next_refinement = MinimumRefinement(
        margin_index=margin_index,
        n_iterations=jnp.where(begins_next_margin, 0, n_iterations),
        best_length=jnp.where(
            begins_next_margin, 0.0, jnp.where(is_better, constant_length, refinement.best_length)
        ),
        best_rate=jnp.where(
            begins_next_margin,
            start_rate,
            jnp.where(is_better, constant_rate, refinement.best_rate),
        ),
        lowest_values=jnp.where(is_starting, start_values, lowest_values),
    )
    return (
        next_refinement,
        jnp.where(begins_next_margin, jnp.any(needs_refinement), is_refining),
        jnp.where(begins_next_margin, minimum_offset, proposed_length),
    )
