"""Integrate one phase from its start to its earliest event, for one element.

A stepper of `solver_steps` takes one solver step at a time. The state at an event therefore has the
accuracy of the integrator and not of an interpolant. An accepted solver step that brackets an event
is repeated. Newton's method corrects the length of the repeated step until the step ends at the
event. Derivatives of the event's state and time follow from the implicit function theorem, so they
are accurate to the order of the solver.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from enum import IntEnum
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from vrw_jax.base.elementwise import make_opaque_loop_condition, select_trees_by_condition
from vrw_jax.base.options import StepOptions
from vrw_jax.base.types import Scalar
from vrw_jax.flow.diffrax_minima import (
    GuardsAndMargins,
    InteriorMarginMinima,
    MarginMinimumRefinement,
    SolverStepEnd,
    StateArray,
    advance_margin_minimum_refinement,
    find_guards_met_at_start,
    interpolate_by_cubics,
    is_guard_at_roundoff,
    make_empty_interior_margin_minima,
    select_entry_by_mask,
    select_flag,
    update_interior_margin_minima,
)
from vrw_jax.flow.minima import evaluate_cubic, find_cubic_minimum
from vrw_jax.flow.solver_steps import AbstractStepper, VectorField, make_stepper


class PhaseEnd(NamedTuple):
    """State at the end of a phase, duration, triggered guard, failure flags and margin minima."""

    state: StateArray
    duration: Scalar  # duration of the phase, s
    end_guard_index: Int[Array, ""]  # index of the guard that ended the phase; -1 if none did
    is_timed_out: Bool[Array, ""]
    has_integration_failed: Bool[Array, ""]
    solver_steps: Int[Array, ""]  # number of tried solver steps, accepted or not
    margin_minima: Float[Array, " n_margins"]  # minima of the margins, empty if there are none


class StepPurpose(IntEnum):
    """Purpose of the next solver step."""

    INTEGRATION = 0
    EVENT_SEARCH = 1  # The step locates a bracketed event.
    REFINEMENT = 2  # The step refines the minimum of a margin.
    DONE = 3  # No further step is taken.


EVENT_TIME_ACCURACY = 1e-8
"""Largest correction of the event's time by a Newton iteration that ends the search.

The correction is relative to the time since the phase began. The value is chosen because the state
is extrapolated linearly over the correction, with an error of its square, which is round-off.
"""
STALLED_CORRECTION_RATIO = 0.9
"""Ratio of successive corrections of the event's time above which a correction is round-off.

The value is chosen because Newton's method halves the corrections, or reduces them to two thirds at
a triple root. Round-off does neither.
"""


class _EventSearch(NamedTuple):
    """State of the Newton iteration that locates the earliest event inside a solver step."""

    is_guard_crossing: Bool[Array, " n_guards"]
    lower_step_length_bound: (
        Scalar  # bracket of the event's time, s from the start of the solver step
    )
    upper_step_length_bound: Scalar
    time_tolerance: Scalar  # tolerance of the event's time, s
    n_iterations: Int[Array, ""]
    is_located: Bool[Array, ""]
    last_event_time_correction: Scalar  # last correction of the event's time, s

    def propose_event_time(
        self, guard_values: Array, guard_rates: Array, step_length: Scalar
    ) -> tuple[Scalar, Array, _EventSearch]:
        """Return the earliest event time that Newton's method proposes for the crossing guards.

        The result is (time from the start of the solver step, s, index of the proposing guard,
        search with the remaining bracket).

        A proposal outside the bracket is replaced by the bracket's midpoint. The proposal has
        derivatives, see `_attach_event_derivatives`.
        """
        is_guard_falling = self.is_guard_crossing & (guard_rates < 0.0)
        time_to_zero = -guard_values / jnp.where(is_guard_falling, guard_rates, -1.0)
        # A guard that rises below zero has crossed at an unknown earlier time.
        missed_event_time = jnp.where(
            self.is_guard_crossing & (guard_values < 0.0), -jnp.inf, jnp.inf
        )
        proposed_step_lengths = jnp.where(
            is_guard_falling, step_length + time_to_zero, missed_event_time
        )
        # If no crossing guard falls here, the lowest of the crossing guards is taken.
        lowest_guard_index = jnp.argmin(jnp.where(self.is_guard_crossing, guard_values, jnp.inf))
        proposing_guard_index = jnp.where(
            jnp.any(proposed_step_lengths < jnp.inf),
            jnp.argmin(proposed_step_lengths),
            lowest_guard_index,
        ).astype(jnp.int32)
        # At the start of a step, a crossing guard may be zero and rise.
        is_guard_rising = (guard_values == 0.0) & (guard_rates > 0.0)
        is_step_before_event = jnp.all(
            jnp.where(self.is_guard_crossing, (guard_values > 0.0) | is_guard_rising, True)
        )
        lower_step_length_bound = jnp.where(
            is_step_before_event, lax.stop_gradient(step_length), self.lower_step_length_bound
        )
        upper_step_length_bound = jnp.where(
            is_step_before_event, self.upper_step_length_bound, lax.stop_gradient(step_length)
        )
        is_proposal_finite = jnp.isfinite(jnp.min(proposed_step_lengths))
        finite_proposed_step_length = select_entry_by_mask(
            proposing_guard_index,
            jnp.where(jnp.isfinite(proposed_step_lengths), proposed_step_lengths, 0.0),
        )
        # A proposal within round-off of a collapsed bracket counts as inside.
        is_proposal_in_bracket = (
            is_proposal_finite
            & (finite_proposed_step_length >= lower_step_length_bound - self.time_tolerance)
            & (finite_proposed_step_length <= upper_step_length_bound + self.time_tolerance)
        )
        # If round-off moves Newton's proposal out of the bracket, its derivative is still valid.
        bisected_step_length = 0.5 * (lower_step_length_bound + upper_step_length_bound) + (
            finite_proposed_step_length - lax.stop_gradient(finite_proposed_step_length)
        )
        next_step_length = jnp.where(
            is_proposal_in_bracket, finite_proposed_step_length, bisected_step_length
        )
        remaining_search = self._replace(
            lower_step_length_bound=lower_step_length_bound,
            upper_step_length_bound=upper_step_length_bound,
        )
        return next_step_length, proposing_guard_index, remaining_search


class _PhaseState(NamedTuple):
    """State of the loop that integrates a phase."""

    step_purpose: Int[Array, ""]  # a StepPurpose
    last_accepted_step_end: SolverStepEnd
    last_step_start: SolverStepEnd  # end of the solver step before the last accepted one
    next_step_length: Scalar  # length of the next solver step, s
    controller_state: Any
    event_search: _EventSearch
    interior_margin_minima: InteriorMarginMinima
    margin_minimum_refinement: MarginMinimumRefinement
    triggered_guard_index: Int[Array, ""]
    is_timed_out: Bool[Array, ""]
    has_integration_failed: Bool[Array, ""]
    n_tried_steps: Int[Array, ""]


def integrate_phase(
    vector_field: VectorField,
    guards_and_margins: GuardsAndMargins,
    start_state: StateArray,
    is_active: Bool[Array, ""],
    options: StepOptions,
) -> PhaseEnd:
    """Return the end of the phase that begins at `start_state`, where a guard first falls to zero.

    A guard that is negative at the start, or zero and not rising, ends the phase immediately with
    duration 0. A guard that is zero and rising does not end the phase. If a guard falls through
    zero at the start, the event time has a derivative. This derivative is minus the guard's
    derivative with respect to the start, divided by the guard's time derivative.

    The integration also detects a guard that is negative only inside a solver step. If the cubic
    through the guard's values and time derivatives may be negative, the solver step is repeated up
    to the minimum of the cubic. If two guards are zero at the same time, the first in the list ends
    the phase. If `is_active` is False, nothing is integrated. Errors are those of the solver for
    the tolerances of `options`.
    """
    phase_context = _PhaseContext(make_stepper(vector_field, options), guards_and_margins, options)
    phase_state = lax.while_loop(
        lambda phase_state: make_opaque_loop_condition(
            phase_state.step_purpose != StepPurpose.DONE, phase_state.n_tried_steps
        ),
        functools.partial(_advance_phase_state, phase_context),
        _init_phase_state(phase_context, start_state, is_active),
    )
    end_time, end_state = _attach_event_derivatives(phase_context, phase_state)
    margin_minima = jnp.minimum(
        phase_state.margin_minimum_refinement.lowest_margin_values,
        phase_state.last_accepted_step_end.guard_and_margin_values[guards_and_margins.n_guards :],
    )
    return PhaseEnd(
        state=end_state,
        duration=end_time,
        end_guard_index=phase_state.triggered_guard_index,
        is_timed_out=phase_state.is_timed_out,
        has_integration_failed=phase_state.has_integration_failed,
        solver_steps=phase_state.n_tried_steps,
        margin_minima=margin_minima,
    )


def _attach_event_derivatives(
    phase_context: _PhaseContext, phase_state: _PhaseState
) -> tuple[Scalar, StateArray]:
    """Return time and state at the end of a phase, with derivatives that the event's time affects.

    The derivatives of Newton's iteration, which located the event, are right to third order only.
    Time and state of the event also solve two equations: the guard is zero, and the last solver
    step reaches the state. All derivatives follow from them by the implicit function theorem.
    """
    solver_stepper, guards_and_margins, _ = phase_context
    step_start, step_end = phase_state.last_step_start, phase_state.last_accepted_step_end
    guard_index = phase_state.triggered_guard_index
    was_located = (guard_index >= 0) & phase_state.event_search.is_located

    def evaluate_event_equations(event: tuple[Scalar, StateArray]) -> tuple[Scalar, StateArray]:
        end_time, state = event
        guard_value = select_entry_by_mask(
            guard_index, guards_and_margins.evaluate_guards_and_margins(state)
        )
        reached_state, *_ = solver_stepper.step(
            step_start.state, step_start.solver_state, end_time - step_start.end_time
        )
        return (
            jnp.where(was_located, guard_value, step_end.end_time - end_time),
            state - jnp.where(was_located, reached_state, step_end.state),
        )

    def solve_tangent_equations(linear_function: Callable, values: tuple) -> tuple:
        guard_value, state_change = values
        field = -linear_function((jnp.ones_like(guard_value), jnp.zeros_like(state_change)))[1]
        guard_change = linear_function((jnp.zeros_like(guard_value), state_change))[0]
        guard_rate = linear_function((jnp.ones_like(guard_value), field))[0]
        is_guard_falling = guard_rate < 0.0
        time_change = jnp.where(
            is_guard_falling,
            (guard_value - guard_change) / jnp.where(is_guard_falling, guard_rate, -1.0),
            0.0,
        )
        return time_change, state_change + field * time_change

    return lax.custom_root(
        evaluate_event_equations,
        (step_end.end_time, step_end.state),
        lambda _, located_event: located_event,
        solve_tangent_equations,
    )


class _PhaseContext(NamedTuple):
    """Arguments of the integration loop that do not change during a phase."""

    solver_stepper: AbstractStepper
    guards_and_margins: GuardsAndMargins
    step_options: StepOptions


def _init_phase_state(
    phase_context: _PhaseContext, start_state: StateArray, is_active: Bool[Array, ""]
) -> _PhaseState:
    """Return the state of the integration loop before the first solver step.

    All arrays that the loop batches or differentiates are batched or differentiated from the start.
    Otherwise JAX would trace the loop again for each array that becomes batched or differentiated.
    """
    stepper, guards_and_margins, options = phase_context
    n_guards = guards_and_margins.n_guards
    no_time = 0.0 * start_state[0]
    rate, memory, control_state = stepper.start(start_state, options)
    values, rates = jax.jvp(guards_and_margins.evaluate_guards_and_margins, (start_state,), (rate,))
    is_guard_met, is_guard_falling = find_guards_met_at_start(
        guards_and_margins, values[:n_guards], rates[:n_guards]
    )
    first_met_guard = jnp.argmax(is_guard_met).astype(jnp.int32)
    # An event at time zero is searched for like any other, because its time depends on the start.
    is_event_searched = is_active & select_flag(first_met_guard, is_guard_falling)
    has_event = is_active & jnp.any(is_guard_met) & ~is_event_searched
    float_zero, count = lax.stop_gradient(no_time), jnp.where(is_active, 0, 0).astype(jnp.int32)
    start = SolverStepEnd(no_time, start_state, rate, memory, values, rates)
    purpose = jnp.where(is_event_searched, StepPurpose.EVENT_SEARCH, StepPurpose.INTEGRATION)
    includes_start = jnp.asarray(guards_and_margins.includes_phase_start, bool)
    return _PhaseState(
        step_purpose=jnp.where(is_active & ~has_event, purpose, StepPurpose.DONE).astype(jnp.int32),
        last_accepted_step_end=start,
        last_step_start=start,
        next_step_length=no_time
        + jnp.where(is_event_searched, 0.0, jnp.minimum(options.dt0, options.max_phase_time)),
        controller_state=jax.tree.map(lambda x: x + float_zero, control_state),
        event_search=_EventSearch(
            is_guard_crossing=is_event_searched & (jnp.arange(n_guards) == first_met_guard),
            lower_step_length_bound=float_zero,
            upper_step_length_bound=float_zero,
            time_tolerance=float_zero,
            n_iterations=count,
            is_located=is_active & False,
            last_event_time_correction=float_zero + jnp.inf,
        ),
        interior_margin_minima=make_empty_interior_margin_minima(guards_and_margins, start_state),
        margin_minimum_refinement=MarginMinimumRefinement(
            count,
            count,
            float_zero,
            float_zero,
            jnp.where(includes_start, values[n_guards:], jnp.inf),
        ),
        triggered_guard_index=jnp.where(has_event, first_met_guard, -1) + count,
        is_timed_out=is_active & False,
        has_integration_failed=is_active & False,
        n_tried_steps=count,
    )


def _advance_phase_state(phase_context: _PhaseContext, phase_state: _PhaseState) -> _PhaseState:
    """Return the loop state after one solver step.

    The searches for the event and for minima of margins are updated.
    """
    _, guards_and_margins, options = phase_context
    previous_step_end = phase_state.last_accepted_step_end
    step_length = phase_state.next_step_length
    is_searching_event = phase_state.step_purpose == StepPurpose.EVENT_SEARCH
    tried_step_end, error_estimate = _try_solver_step(phase_context, phase_state)
    step_assessment = _assess_solver_step(
        phase_context, phase_state, tried_step_end, error_estimate
    )
    event_search, event_guard_index, event_step_length = _improve_event_search(
        phase_context, phase_state, tried_step_end, step_assessment
    )
    is_at_event = event_search.is_located
    # At the event, the state is extrapolated over the last correction of the event's time.
    correction = jnp.where(is_at_event, event_step_length - step_length, 0.0)
    tried_step_end = tried_step_end._replace(
        end_time=jnp.where(
            is_at_event, previous_step_end.end_time + event_step_length, tried_step_end.end_time
        ),
        state=tried_step_end.state + correction * tried_step_end.state_rate,
    )
    end_time, is_accepted = tried_step_end.end_time, step_assessment.is_accepted
    is_timed_out = is_accepted & (end_time >= options.max_phase_time)
    is_timed_out = is_timed_out | (is_at_event & (end_time > options.max_phase_time))
    is_step_too_short = step_assessment.is_step_too_short | (
        is_searching_event
        & ~is_at_event
        & (event_search.n_iterations >= options.max_event_iterations)
    )
    is_phase_end = is_at_event | is_timed_out | is_step_too_short
    step_purpose = jnp.where(
        step_assessment.has_guard_crossed, StepPurpose.EVENT_SEARCH, phase_state.step_purpose
    )
    step_purpose = jnp.where(is_phase_end, StepPurpose.DONE, step_purpose).astype(jnp.int32)
    following_step_length = jnp.where(
        is_searching_event,
        event_step_length,
        lax.stop_gradient(step_assessment.following_step_length),
    )
    is_step_taken = is_accepted | is_at_event
    interior_margin_minima = update_interior_margin_minima(
        guards_and_margins,
        phase_state.interior_margin_minima,
        previous_step_end,
        tried_step_end,
        step_length,
        is_step_taken,
    )
    margin_minimum_refinement = phase_state.margin_minimum_refinement
    if guards_and_margins.includes_phase_start:
        was_refining_minimum = phase_state.step_purpose == StepPurpose.REFINEMENT
        margin_minimum_refinement, is_refining, step_length_to_minimum = (
            advance_margin_minimum_refinement(
                margin_minimum_refinement,
                guards_and_margins,
                interior_margin_minima,
                tried_step_end,
                step_length,
                was_refining_minimum,
                is_phase_end,
                options.max_margin_search_iterations,
            )
        )
        step_purpose = jnp.where(was_refining_minimum, StepPurpose.DONE, step_purpose)
        step_purpose = jnp.where(is_refining, StepPurpose.REFINEMENT, step_purpose)
        following_step_length = jnp.where(
            is_refining, step_length_to_minimum, following_step_length
        )
    return _PhaseState(
        step_purpose=step_purpose.astype(jnp.int32),
        last_accepted_step_end=select_trees_by_condition(
            is_step_taken, tried_step_end, previous_step_end
        ),
        last_step_start=select_trees_by_condition(
            is_step_taken, previous_step_end, phase_state.last_step_start
        ),
        next_step_length=following_step_length,
        controller_state=step_assessment.controller_state,
        event_search=event_search,
        interior_margin_minima=interior_margin_minima,
        margin_minimum_refinement=margin_minimum_refinement,
        triggered_guard_index=jnp.where(
            is_at_event & ~is_timed_out, event_guard_index, phase_state.triggered_guard_index
        ),
        is_timed_out=is_timed_out | phase_state.is_timed_out,
        has_integration_failed=is_step_too_short | phase_state.has_integration_failed,
        n_tried_steps=step_assessment.n_tried_steps,
    )


def _improve_event_search(
    phase_context: _PhaseContext,
    phase_state: _PhaseState,
    tried_step_end: SolverStepEnd,
    step_assessment: _StepAssessment,
) -> tuple[_EventSearch, Array, Scalar]:
    """Return the search for the event after one solver step, the event's guard, and its next time.

    The time is that since the start of the solver step, s. A solver step ends the search if it
    changes the event's time by little compared with the step. For an event much earlier than the
    step's end, the change is also compared with the time since the phase began. The second
    comparison is skipped if the change is only the guard's round-off.
    """
    guards_and_margins = phase_context.guards_and_margins
    n_guards, step_length = guards_and_margins.n_guards, phase_state.next_step_length
    is_searching = phase_state.step_purpose == StepPurpose.EVENT_SEARCH
    guard_values = tried_step_end.guard_and_margin_values[:n_guards]
    event_step_length, guard_index, search = phase_state.event_search.propose_event_time(
        guard_values, tried_step_end.guard_and_margin_rates[:n_guards], step_length
    )
    proposed, tried, start_time = lax.stop_gradient(
        (event_step_length, step_length, phase_state.last_accepted_step_end.end_time)
    )
    correction = jnp.abs(proposed - tried)
    is_correction_small = correction <= EVENT_TIME_ACCURACY * (start_time + proposed)
    is_stalled = correction >= STALLED_CORRECTION_RATIO * search.last_event_time_correction
    is_confirmed = (correction <= search.time_tolerance) & (is_correction_small | is_stalled)
    is_guard_at_zero, lowest_guard_index = is_guard_at_roundoff(
        guards_and_margins, search.is_guard_crossing, guard_values
    )
    is_started = step_assessment.has_guard_crossed
    search = _EventSearch(
        is_guard_crossing=jnp.where(
            is_started, step_assessment.is_guard_crossing, search.is_guard_crossing
        ),
        lower_step_length_bound=jnp.where(is_started, 0.0, search.lower_step_length_bound),
        upper_step_length_bound=jnp.where(is_started, tried, search.upper_step_length_bound),
        time_tolerance=jnp.where(is_started, step_assessment.time_tolerance, search.time_tolerance),
        n_iterations=search.n_iterations + is_searching,
        is_located=is_searching & (is_confirmed | is_guard_at_zero),
        last_event_time_correction=jnp.where(is_started, jnp.inf, correction),
    )
    return search, jnp.where(is_guard_at_zero, lowest_guard_index, guard_index), event_step_length


def _try_solver_step(
    phase_context: _PhaseContext, phase_state: _PhaseState
) -> tuple[SolverStepEnd, Array]:
    """Return the end of one tried solver step with guards and margins, and the error estimate.

    All purposes of a solver step share this call of the solver and of the monitored functions, so
    this code is compiled once.
    """
    solver_stepper, guards_and_margins, options = phase_context
    start_state = (
        phase_state.last_accepted_step_end.state,
        phase_state.last_accepted_step_end.solver_state,
    )
    if guards_and_margins.includes_phase_start:
        state_before_minimum = select_entry_by_mask(
            phase_state.margin_minimum_refinement.margin_index,
            phase_state.interior_margin_minima.step_start_state,
        )
        starts_at_minimum_step = (
            state_before_minimum,
            solver_stepper.start(state_before_minimum, options)[1],
        )
        start_state = select_trees_by_condition(
            phase_state.step_purpose == StepPurpose.REFINEMENT, starts_at_minimum_step, start_state
        )
    end_state, end_rate, error_estimate, solver_state = solver_stepper.step(
        *start_state, phase_state.next_step_length
    )
    guard_and_margin_values, guard_and_margin_rates = jax.jvp(
        guards_and_margins.evaluate_guards_and_margins,
        (end_state,),
        (end_rate,),
    )
    error_estimate = jnp.where(
        jnp.all(jnp.isfinite(guard_and_margin_values)), error_estimate, jnp.inf
    )
    phase_time_limit = lax.stop_gradient(options.max_phase_time)
    start_time = phase_state.last_accepted_step_end.end_time
    is_integrating = phase_state.step_purpose == StepPurpose.INTEGRATION
    is_last_step = is_integrating & (phase_state.next_step_length >= phase_time_limit - start_time)
    end_time = jnp.where(is_last_step, phase_time_limit, start_time + phase_state.next_step_length)
    return SolverStepEnd(
        end_time, end_state, end_rate, solver_state, guard_and_margin_values, guard_and_margin_rates
    ), error_estimate


class _StepAssessment(NamedTuple):
    """Acceptance of a tried solver step, crossing guards, and length of the next step."""

    is_accepted: Bool[Array, ""]
    has_guard_crossed: Bool[Array, ""]  # whether the step brackets an event
    is_guard_crossing: Bool[Array, " n_guards"]  # guards that are not positive at the step's end
    is_step_too_short: Bool[Array, ""]
    following_step_length: Scalar  # length of the next step, s
    time_tolerance: Scalar  # tolerance of the event's time, s
    controller_state: Any
    n_tried_steps: Int[Array, ""]


def _assess_solver_step(
    phase_context: _PhaseContext,
    phase_state: _PhaseState,
    tried_step_end: SolverStepEnd,
    error_estimate: Array,
) -> _StepAssessment:
    """Return whether a solver step is accepted, which guards cross zero, and the next length.

    A guard may cross zero at the end of the solver step or inside it.
    """
    solver_stepper, guards_and_margins, options = phase_context
    n_guards = guards_and_margins.n_guards
    previous_step_end = phase_state.last_accepted_step_end
    step_length = phase_state.next_step_length
    is_integrating = phase_state.step_purpose == StepPurpose.INTEGRATION
    is_within_tolerance, next_step_length, controller_state = solver_stepper.control(
        (previous_step_end.state, tried_step_end.state),
        error_estimate,
        step_length,
        phase_state.controller_state,
    )
    is_within_tolerance = is_within_tolerance & is_integrating
    is_guard_crossing = tried_step_end.guard_and_margin_values[:n_guards] <= 0.0
    guard_cubics = tuple(
        x[:n_guards] for x in interpolate_by_cubics(previous_step_end, tried_step_end, step_length)
    )
    step_length_to_minimum = step_length * _find_earliest_dip(
        guard_cubics, is_guard_crossing, lax.stop_gradient(step_length), previous_step_end.end_time
    )
    must_shorten_step = is_within_tolerance & (step_length_to_minimum < step_length)
    has_guard_crossed = is_within_tolerance & jnp.any(is_guard_crossing) & ~must_shorten_step
    n_tried_steps = phase_state.n_tried_steps + (phase_state.step_purpose != StepPurpose.REFINEMENT)
    has_step_failed = (n_tried_steps >= options.max_solver_steps) | (
        previous_step_end.end_time + next_step_length == previous_step_end.end_time
    )
    following_step_length = jnp.where(must_shorten_step, step_length_to_minimum, next_step_length)
    is_accepted = is_within_tolerance & ~has_guard_crossed & ~must_shorten_step
    end_time = jnp.where(is_accepted, tried_step_end.end_time, previous_step_end.end_time)
    # The last step ends at the time limit.
    remaining_phase_time = lax.stop_gradient(options.max_phase_time - end_time)
    following_step_length = jnp.minimum(following_step_length, remaining_phase_time)
    event_step_length_guess = lax.stop_gradient(step_length) * lax.cond(
        has_guard_crossed,
        _guess_event_fraction,
        lambda *_: jnp.ones_like(step_length),
        guard_cubics,
        is_guard_crossing,
    )
    time_resolution = 1e3 * jnp.finfo(step_length.dtype).eps * tried_step_end.end_time
    return _StepAssessment(
        is_accepted=is_accepted,
        has_guard_crossed=has_guard_crossed,
        is_guard_crossing=is_guard_crossing,
        is_step_too_short=is_integrating & ~has_guard_crossed & has_step_failed,
        following_step_length=jnp.where(
            has_guard_crossed, event_step_length_guess, following_step_length
        ),
        time_tolerance=lax.stop_gradient(jnp.maximum(options.rtol * step_length, time_resolution)),
        controller_state=select_trees_by_condition(
            is_integrating & ~must_shorten_step, controller_state, phase_state.controller_state
        ),
        n_tried_steps=n_tried_steps,
    )


def _find_earliest_dip(
    guard_cubics: tuple[Array, ...],
    is_guard_crossing: Array,
    step_length: Scalar,
    start_time: Scalar,
) -> Scalar:
    """Return where the first guard may be negative inside a solver step; 1 if none may be.

    The location is a fraction of the solver step, at most nine tenths. It is the minimum of the
    guard's cubic, whose coefficients are those of `interpolate_by_cubics`. In the solver step, the
    cubic is nowhere below the smallest of its Bernstein coefficients, so a guard with positive
    coefficients stays positive. For any other guard, the caller repeats the solver step up to the
    location. In shorter steps, the coefficients are closer to the guard. The caller stops when the
    coefficients are positive or the guard is negative at the end of a step.
    """
    start_values, start_rates, end_values, end_rates = guard_cubics
    lowest_coefficient = jnp.minimum(start_values + start_rates / 3.0, end_values - end_rates / 3.0)
    may_dip = (lowest_coefficient <= 0.0) & (end_rates >= 0.0) & ~is_guard_crossing

    def find_minima(guard_cubics: tuple[Array, ...], may_dip: Array) -> Scalar:
        fractions = jnp.clip(find_cubic_minimum(*guard_cubics)[0], 0.1, 0.9)
        does_time_advance = start_time + fractions * step_length > start_time
        return jnp.min(jnp.where(may_dip & does_time_advance, fractions, 1.0))

    no_dip = lambda *_: jnp.ones_like(step_length)
    return lax.cond(jnp.any(may_dip), find_minima, no_dip, guard_cubics, may_dip)


def _guess_event_fraction(guard_cubics: tuple[Array, ...], is_guard_crossing: Array) -> Scalar:
    """Return the earliest root of a crossing guard's cubic, as a fraction of the solver step.

    The secant method, followed by Newton's method, locates the root of each cubic.
    """
    start_values, start_rates, end_values, end_rates = guard_cubics
    guard_decrease = jnp.where(
        is_guard_crossing & (start_values > end_values),
        start_values - end_values,
        1.0,
    )
    fraction_to_zero = jnp.where(
        is_guard_crossing, jnp.clip(start_values / guard_decrease, 0.0, 1.0), 1.0
    )
    # A guard that rises from zero, or from round-off above it, has its other zero where the cubic
    # divided by x vanishes.
    linear_coefficient = 3.0 * end_values - 2.0 * start_rates - end_rates
    quadratic_coefficient = start_rates - 2.0 * end_values + end_rates
    parabola_root_denominator = (
        jnp.sqrt(
            jnp.maximum(
                linear_coefficient * linear_coefficient - 4.0 * start_rates * quadratic_coefficient,
                0.0,
            )
        )
        - linear_coefficient
    )
    nonzero_parabola_root = jnp.clip(
        2.0
        * start_rates
        / jnp.where(parabola_root_denominator > 0.0, parabola_root_denominator, 1.0),
        0.0,
        1.0,
    )
    cubic_rate_function = lambda fraction_to_zero: (
        6.0 * fraction_to_zero * (fraction_to_zero - 1.0) * (start_values - end_values)
        + (1.0 - fraction_to_zero) * (1.0 - 3.0 * fraction_to_zero) * start_rates
        + fraction_to_zero * (3.0 * fraction_to_zero - 2.0) * end_rates
    )
    does_guard_rise_from_zero = (
        is_guard_crossing
        & (start_rates > 0.0)
        & ((start_values == 0.0) | (cubic_rate_function(fraction_to_zero) >= 0.0))
    )
    fraction_to_zero = jnp.where(does_guard_rise_from_zero, nonzero_parabola_root, fraction_to_zero)
    for _ in range(3):
        is_guard_falling = (cubic_rate_value := cubic_rate_function(fraction_to_zero)) < 0.0
        fraction_change = evaluate_cubic(fraction_to_zero, *guard_cubics) / jnp.where(
            is_guard_falling, cubic_rate_value, 1.0
        )
        fraction_to_zero = jnp.where(
            is_guard_crossing & is_guard_falling,
            jnp.clip(fraction_to_zero - fraction_change, 0.0, 1.0),
            fraction_to_zero,
        )
    return jnp.min(jnp.where(is_guard_crossing, fraction_to_zero, 1.0))


def sample_phase(
    vector_field: VectorField,
    start_state: StateArray,
    duration: Scalar,
    n_samples: int,
    options: StepOptions,
) -> Float[Array, "n_samples dim"]:
    """Return the states at `n_samples` equally spaced times of a phase, as accurate as the solver.

    The first sample is `start_state` and the last is the state after `duration`, s. Each interval
    between two samples is integrated with adaptive solver steps. The last of these solver steps
    ends exactly at the time of the sample.
    """
    solver_stepper = make_stepper(vector_field, options)
    sample_interval = duration / (n_samples - 1)

    def take_adaptive_step(loop_carry: tuple) -> tuple:
        time, state, solver_state, step_length, controller_state, n_tried_steps = loop_carry
        step_length = jnp.minimum(step_length, sample_interval - time)
        end_state, _, error_estimate, end_solver_state = solver_stepper.step(
            state, solver_state, step_length
        )
        is_within_tolerance, next_step_length, controller_state = solver_stepper.control(
            (state, end_state), error_estimate, step_length, controller_state
        )
        is_last_step = is_within_tolerance & (step_length >= sample_interval - time)
        time = jnp.where(
            is_last_step, sample_interval, jnp.where(is_within_tolerance, time + step_length, time)
        )
        state, solver_state = select_trees_by_condition(
            is_within_tolerance, (end_state, end_solver_state), (state, solver_state)
        )
        return time, state, solver_state, next_step_length, controller_state, n_tried_steps + 1

    needs_step = lambda c: (c[0] < sample_interval) & (c[-1] < options.max_solver_steps)

    def integrate_to_next_sample(state: StateArray, _sample: None) -> tuple[StateArray, StateArray]:
        initial_count = jnp.zeros((), jnp.int32)
        _, solver_state, controller_state = solver_stepper.start(state, options)
        zero_duration = jnp.zeros_like(sample_interval)
        loop_carry = (
            zero_duration,
            state,
            solver_state,
            zero_duration + options.dt0,
            controller_state,
            initial_count,
        )
        next_state = lax.while_loop(needs_step, take_adaptive_step, loop_carry)[1]
        return next_state, next_state

    _, states = lax.scan(integrate_to_next_sample, start_state, None, length=n_samples - 1)
    return jnp.concatenate([start_state[None], states])
