"""Minima of margins along a phase, at the integrator's accuracy.

During the integration, the step that holds the lowest minimum of each margin is stored. After it,
secant steps on the margin's rate locate the minimum, one margin after the other.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from vrw_jax.numerics import MINIMUM_LOCATION_TOLERANCE, Scalar, find_cubic_minimum

StateVector = Float[Array, " dim"]
MonitorFn = Callable[[StateVector], Float[Array, " n_watched"]]
"""Guards and margins as functions of the state."""


class MonitoredFunctions(NamedTuple):
    """Functions monitored along a phase: guards that end it, then margins whose minimum is
    searched.

    - `values`: returns the guards, then the margins;
    - `includes_start`: whether each margin counts at the start of the phase. A margin that is zero
      there by construction does not count, like the height of a foot that leaves the ground. All
      margins count at interior minima and at the end;
    - `guard_scales`: magnitude of the terms whose difference a guard is. A guard within some
      round-offs of it counts as zero, because in a dip of microseconds no time brings it closer;
    - `is_zero_at_start`: guards that count as zero at the start in spite of round-off. None: those
      that are exactly zero, or within round-off of their scales.
    """

    values: MonitorFn
    n_guards: int
    includes_start: tuple[bool, ...] = ()
    guard_scales: Array | None = None
    is_zero_at_start: Bool[Array, " n_guards"] | None = None


GUARD_ROUNDOFF_EPS = 32.0
"""Round-off of a guard's value, in units of round-off of its scale.

It is chosen because a guard is a sum of several terms, each with its own round-off.
"""


def is_at_roundoff(
    monitored_functions: MonitoredFunctions,
    is_crossing: Bool[Array, " n_guards"],
    guards: Float[Array, " n_guards"],
) -> tuple[Bool[Array, ""], Int[Array, ""]]:
    """Return whether the lowest crossing guard is only round-off, and the index of that guard."""
    scales = (
        jnp.ones_like(guards)
        if monitored_functions.guard_scales is None
        else monitored_functions.guard_scales
    )
    lowest = jnp.where(is_crossing, guards / scales, jnp.inf)
    is_near_zero = jnp.abs(jnp.min(lowest)) <= GUARD_ROUNDOFF_EPS * jnp.finfo(lowest.dtype).eps
    has_scales = monitored_functions.guard_scales is not None
    return is_near_zero & has_scales, jnp.argmin(lowest).astype(jnp.int32)


def guards_met_at_start(
    monitored_functions: MonitoredFunctions,
    guards: Float[Array, " n_guards"],
    rates: Float[Array, " n_guards"],
) -> tuple[Bool[Array, " n_guards"], Bool[Array, " n_guards"]]:
    """Return which guards end the phase at its start, and which of them fall through zero there.

    The others are below zero or at rest on it: their event time does not follow from the start.
    """
    is_met = (guards < 0.0) | ((guards == 0.0) & (rates <= 0.0))
    is_zero = guards == 0.0
    if monitored_functions.guard_scales is not None:
        roundoff = GUARD_ROUNDOFF_EPS * jnp.finfo(guards.dtype).eps
        is_zero = is_zero | (guards >= -roundoff * monitored_functions.guard_scales)
    if monitored_functions.is_zero_at_start is not None:
        is_zero = monitored_functions.is_zero_at_start
        is_met = jnp.where(is_zero, rates <= 0.0, is_met)
    return is_met, is_met & is_zero & (rates < 0.0)


class AcceptedPhaseStep(NamedTuple):
    """The end of the last accepted step, which a rejected step does not change."""

    time: Scalar
    state: StateVector
    solver_state: Any
    values: Float[Array, " n_watched"]
    rates: Float[Array, " n_watched"]


class InteriorMinimum(NamedTuple):
    """Lowest interior minimum so far of each margin, and the step that holds it."""

    value: Float[Array, " n"]
    start_state: Float[Array, "n dim"]
    step_length: Float[Array, " n"]  # of the step from its start, s
    minimum_offset: Float[Array, " n"]  # of the minimum from the step's start, s
    start_rate: Float[Array, " n"]

    @property
    def is_found(self) -> Bool[Array, " n"]:
        """Whether each margin has an interior minimum."""
        return jnp.isfinite(self.value)


class MinimumRefinement(NamedTuple):
    """State of the secant steps on a margin's rate after the integration, one margin at a time."""

    monitor: Int[Array, ""]
    n_iterations: Int[Array, ""]
    best_length: Scalar  # time with the smallest rate so far, from the step's start, s
    best_rate: Scalar
    lowest_values: Float[Array, " n"]  # refined minima, and the values at the phase's start


def empty_minimum(monitored_functions: MonitoredFunctions, start: StateVector) -> InteriorMinimum:
    """Return the state without interior minima."""
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
    """Return the minima, with the step in which a margin turns from falling to rising if it is the
    lowest.

    A margin that is zero at the phase's start by construction is at rest there: a negative rate is
    round-off and counts as zero.
    """
    if not monitored_functions.includes_start:
        return minimum
    v0, r0, v1, r1 = (
        lax.stop_gradient(v)[monitored_functions.n_guards :]
        for v in (step_start.values, step_start.rates, step_end.values, step_end.rates)
    )
    is_at_rest = (step_start.time == 0.0) & ~jnp.asarray(monitored_functions.includes_start)
    r0 = jnp.where(is_at_rest, jnp.maximum(r0, 0.0), r0)
    length = lax.stop_gradient(length)
    x, value = find_cubic_minimum(v0, r0 * length, v1, r1 * length)
    value = jnp.where(jnp.isfinite(value), value, jnp.minimum(v0, v1))
    is_lower = is_counted & (r0 < 0.0) & (r1 >= 0.0) & (value < minimum.value)
    return InteriorMinimum(
        jnp.where(is_lower, value, minimum.value),
        jnp.where(is_lower[:, None], step_start.state, minimum.start_state),
        jnp.where(is_lower, length, minimum.step_length),
        jnp.where(is_lower, x * length, minimum.minimum_offset),
        jnp.where(is_lower, r0, minimum.start_rate),
    )


def select_row(index: Int[Array, ""], rows: Array) -> Array:
    """Return the row with this index; a gather would cost more in a batch."""
    is_selected = jnp.arange(rows.shape[0]) == index
    return jnp.sum(jnp.where(is_selected.reshape(-1, *(1,) * (rows.ndim - 1)), rows, 0.0), axis=0)


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
    """Return the next state of the refinement, whether another step is needed, and its length.

    After the integration, secant steps on the rate locate each margin's minimum at the integrator's
    accuracy, in at most `max_iterations` steps. Each is a solver step of `length` from the start of
    the step that holds the minimum. `is_refining`: whether `step` was such a step. `min_tries`:
    least number of them, chosen because each makes the location's derivatives accurate to more
    digits.
    """
    values = step.values[monitored_functions.n_guards :]
    rates = step.rates[monitored_functions.n_guards :]
    monitor, n_iterations = refinement.monitor, refinement.n_iterations + is_refining
    value, rate, step_length = (
        select_row(monitor, x) for x in (values, rates, minimum.step_length)
    )
    constant_rate, constant_length = lax.stop_gradient((rate, length))
    length_change = constant_length - refinement.best_length
    rate_derivative = (constant_rate - refinement.best_rate) / jnp.where(
        length_change == 0.0, 1.0, length_change
    )
    is_usable = (length_change != 0.0) & (rate_derivative > 0.0)
    secant = length - jnp.where(is_usable, rate / jnp.where(is_usable, rate_derivative, 1.0), 0.0)
    secant = jnp.clip(secant, 0.0, lax.stop_gradient(step_length))
    has_converged = jnp.abs(secant - length) <= MINIMUM_LOCATION_TOLERANCE * step_length
    is_done = is_refining & (
        (n_iterations == max_iterations) | (has_converged & (n_iterations >= min_tries))
    )
    is_better = jnp.abs(constant_rate) < jnp.abs(refinement.best_rate)

    monitors = jnp.arange(values.shape[0])
    lowest = jnp.where(
        is_done & (monitors == monitor),
        jnp.minimum(value, refinement.lowest_values),
        refinement.lowest_values,
    )
    start_values = jnp.where(jnp.asarray(monitored_functions.includes_start), values, jnp.inf)
    is_remaining = minimum.is_found & (is_phase_end | (monitors > monitor))
    takes_next = is_phase_end | is_done
    monitor = jnp.where(takes_next, jnp.argmax(is_remaining).astype(jnp.int32), monitor)
    offset, start_rate = lax.stop_gradient(
        (select_row(monitor, minimum.minimum_offset), select_row(monitor, minimum.start_rate))
    )
    next_refinement = MinimumRefinement(
        monitor=monitor,
        n_iterations=jnp.where(takes_next, 0, n_iterations),
        best_length=jnp.where(
            takes_next, 0.0, jnp.where(is_better, constant_length, refinement.best_length)
        ),
        best_rate=jnp.where(
            takes_next, start_rate, jnp.where(is_better, constant_rate, refinement.best_rate)
        ),
        lowest_values=jnp.where(is_starting, start_values, lowest),
    )
    return (
        next_refinement,
        jnp.where(takes_next, jnp.any(is_remaining), is_refining),
        jnp.where(takes_next, offset, secant),
    )
