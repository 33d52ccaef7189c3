"""Minima of margins along a phase, for a batch, as accurate as the integration.

The method is that of `hybrid/minima` for one wheel. During the integration, the step that contains
the lowest minimum of each margin is stored. Afterwards, secant steps on the margin's rate locate
the minimum, one margin after the other.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from vrw_jax.integrator.tableaus import AccelerationFn, ButcherTableau, StageState, StepFn
from vrw_jax.integrator.tangents import PhaseTangents
from vrw_jax.numerics import (
    MINIMUM_LOCATION_TOLERANCE,
    StepOptions,
    Vector,
    find_cubic_minimum,
    tree_where,
)


class MarginFunctions(NamedTuple):
    """Margins whose minima are computed, as a function of the state."""

    evaluate_margins: Callable[[StageState], Vector]
    # whether the margin at the phase's start counts, see `hybrid.MonitoredFunctions`
    includes_start: tuple[bool, ...]


class MinimaState(NamedTuple):
    """Margins at the present state, and the step that contains the lowest minimum of each so
    far.
    """

    values: Array  # margins at the present state, (margins, batch)
    rates: Array
    lowest_values: Array  # lowest interior minimum, (margins, batch); infinity if there is none
    start_q: Array  # positions at the start of that step, (margins, coordinates, batch)
    start_v: Array
    step_length: Array  # length of that step, (margins, batch), s
    minimum_offset: Array  # time from the step's start to the minimum, s
    start_rates: Array  # rates of the margins at the step's start
    # tangents of that start, (margins, directions, components, batch)
    start_tangents: Array | None = None


def evaluate_with_rates(
    function: Callable[[StageState], Vector], evaluate: AccelerationFn, state: StageState
) -> tuple[Vector, Vector]:
    """Return the values of `function` at a state, and their time derivatives along the motion."""
    n = len(state.q)

    def evaluate_along_motion(q: Vector, v: Vector) -> Vector:
        return function(StageState(q, v, evaluate(q, v)))

    return jax.jvp(
        evaluate_along_motion, (state.q, state.v), (state.v, state.acceleration.acceleration[:n])
    )


def init_minima(
    margins: MarginFunctions,
    evaluate: AccelerationFn,
    state: StageState,
    phase_tangents: PhaseTangents | None,
) -> MinimaState:
    """Return the state of the search for minima before the first step.

    A margin that is zero at the start by construction has no negative rate there except round-off,
    so a negative rate counts as zero.
    """
    values, rates = map(jnp.stack, evaluate_with_rates(margins.evaluate_margins, evaluate, state))
    includes_start = jnp.asarray(margins.includes_start)[:, None]
    infinite_minima = jnp.zeros_like(values)
    zero_starts = jnp.zeros((len(values), len(state.q), values.shape[-1]), values.dtype)
    rates = jnp.where(includes_start, rates, jnp.maximum(rates, 0.0))
    zero_tangents = (
        None
        if phase_tangents is None
        else jnp.stack([jnp.zeros_like(phase_tangents.start_tangents)] * len(values))
    )
    return MinimaState(
        values,
        rates,
        infinite_minima + jnp.inf,
        zero_starts,
        zero_starts,
        infinite_minima,
        infinite_minima,
        infinite_minima,
        zero_tangents,
    )


class AcceptedStep(NamedTuple):
    """A solver step, and which batch elements accepted it."""

    start: StageState
    end: StageState
    length: Array
    is_accepted: Array
    start_tangents: Array | None  # tangents of the step's start


def update_minima(
    margins: MarginFunctions,
    evaluate: AccelerationFn,
    minima: MinimaState,
    accepted_step: AcceptedStep,
) -> MinimaState:
    """Return the minima, updated with those inside an accepted step."""
    start, end, length, is_accepted, _ = accepted_step
    values, rates = map(jnp.stack, evaluate_with_rates(margins.evaluate_margins, evaluate, end))
    location, value = find_cubic_minimum(
        minima.values, minima.rates * length, values, rates * length
    )
    value = jnp.where(jnp.isfinite(value), value, jnp.minimum(minima.values, values))
    has_minimum = (minima.rates < 0.0) & (rates >= 0.0)
    is_lower = is_accepted & has_minimum & (value < minima.lowest_values)
    replace_if_lower = lambda new_value, old_value: jnp.where(is_lower, new_value, old_value)
    replace_start_if_lower = lambda new_value, old_value: jnp.where(
        is_lower[:, None], jnp.stack(new_value), old_value
    )
    start_tangents = minima.start_tangents
    if start_tangents is not None and accepted_step.start_tangents is not None:
        start_tangents = jnp.where(
            is_lower[:, None, None], accepted_step.start_tangents[None], start_tangents
        )
    return MinimaState(
        values=jnp.where(is_accepted, values, minima.values),
        rates=jnp.where(is_accepted, rates, minima.rates),
        lowest_values=replace_if_lower(value, minima.lowest_values),
        start_q=replace_start_if_lower(start.q, minima.start_q),
        start_v=replace_start_if_lower(start.v, minima.start_v),
        step_length=replace_if_lower(length, minima.step_length),
        minimum_offset=replace_if_lower(location * length, minima.minimum_offset),
        start_rates=replace_if_lower(minima.rates, minima.start_rates),
        start_tangents=start_tangents,
    )


class MinimaResult(NamedTuple):
    """Minima of margins over a phase, each an array (margins, batch)."""

    phase_minima: Array  # minima over the phase, ends included
    interior_minima: Array  # interior minima; infinity if there is none
    length_to_minimum: Array  # length of the step from the stored start to the interior minimum, s


class _MinimumSearch(NamedTuple):
    """State of the secant iteration for the minimum of one margin, for each batch element."""

    length: Array  # length of the next try, s
    best_length: Array  # length with the smallest rate so far, s
    best_rate: Array
    value: Array
    is_unresolved: Array
    n_iterations: Array


def refine_minima(
    margins: MarginFunctions,
    step_function: StepFn,
    evaluate: AccelerationFn,
    minima: MinimaState,
    start_values: Array,
    options: StepOptions,
) -> MinimaResult:
    """Return the minima of the margins over the phase; `start_values` are the margins at its start.

    Each minimum takes at most `max_margin_search_iterations` secant steps. All of them begin at the
    start of the step that contains the minimum.
    """

    def refine_margin(_: None, inputs: tuple) -> tuple[None, tuple[Array, Array]]:
        index, margin_state = inputs
        q, v = tuple(margin_state.start_q), tuple(margin_state.start_v)
        start = StageState(q, v, evaluate(q, v))

        def selected_margin(state: StageState) -> Array:
            is_selected = jnp.arange(len(margins.includes_start)) == index
            return jnp.sum(
                jnp.where(is_selected[:, None], jnp.stack(margins.evaluate_margins(state)), 0.0), 0
            )

        def improve(search: _MinimumSearch) -> _MinimumSearch:
            end = step_function(start, search.length).end
            (value,), (rate,) = evaluate_with_rates(
                lambda state: (selected_margin(state),), evaluate, end
            )
            length_change = search.length - search.best_length
            rate_derivative = (rate - search.best_rate) / jnp.where(
                length_change == 0.0, 1.0, length_change
            )
            is_usable = (length_change != 0.0) & (rate_derivative > 0.0)
            change = jnp.where(is_usable, -rate / jnp.where(is_usable, rate_derivative, 1.0), 0.0)
            length = jnp.clip(search.length + change, 0.0, margin_state.step_length)
            has_converged = (
                jnp.abs(length - search.length)
                <= MINIMUM_LOCATION_TOLERANCE * margin_state.step_length
            )
            is_better = jnp.abs(rate) < jnp.abs(search.best_rate)
            improved_search = _MinimumSearch(
                length=length,
                best_length=jnp.where(is_better, search.length, search.best_length),
                best_rate=jnp.where(is_better, rate, search.best_rate),
                value=value,
                is_unresolved=search.is_unresolved & ~has_converged,
                n_iterations=search.n_iterations,
            )
            return tree_where(search.is_unresolved, improved_search, search)._replace(
                n_iterations=search.n_iterations + 1
            )

        has_minimum = jnp.isfinite(margin_state.lowest_values)
        zero_length = jnp.zeros_like(margin_state.step_length)
        n_iterations = jnp.zeros((), jnp.int32)
        search = _MinimumSearch(
            margin_state.minimum_offset,
            zero_length,
            margin_state.start_rates,
            zero_length + jnp.inf,
            has_minimum,
            n_iterations,
        )
        needs_iteration = lambda search: (
            jnp.any(search.is_unresolved)
            & (search.n_iterations < options.max_margin_search_iterations)
        )
        final_search = lax.while_loop(needs_iteration, improve, search)
        return None, (final_search.value, final_search.length)

    includes_start = np.asarray(margins.includes_start)[:, None]
    end_minima = jnp.minimum(jnp.where(includes_start, start_values, jnp.inf), minima.values)
    margin_indices = jnp.arange(len(includes_start), dtype=jnp.int32)
    interior_minima, length = lax.scan(
        refine_margin, None, (margin_indices, minima._replace(start_tangents=None))
    )[1]
    return MinimaResult(jnp.minimum(interior_minima, end_minima), interior_minima, length)


def minima_jvp(
    make_margins: Callable[..., tuple[MarginFunctions, AccelerationFn]],
    step_function: StepFn,
    tableau: ButcherTableau,
    phase_tangents: PhaseTangents,
    minima: MinimaState,
    result: MinimaResult,
    phase_ends: tuple[StageState, StageState],
    end_tangents: Array,
) -> Array:
    """Return the tangents of the minima, an array (directions, margins, batch).

    They are tangents of the margins at fixed times of the minima, because the shift of a minimum
    has no first-order effect. `phase_ends` are the start and the end of the phase, and
    `end_tangents` the tangents of the end state.
    """
    margins, evaluate = make_margins(phase_tangents.constants, phase_tangents.held_constants)

    def evaluate_margins(constants: Any, held_constants: Vector, q: Vector, v: Vector) -> Array:
        margin_functions, acceleration_of = make_margins(constants, held_constants)
        return jnp.stack(margin_functions.evaluate_margins(StageState(q, v, acceleration_of(q, v))))

    tangents_of_margins = functools.partial(phase_tangents.evaluate_tangents, evaluate_margins)

    def tangent_of_margin(_: None, inputs: tuple) -> tuple[None, Array]:
        index, margin_state, length = inputs
        q, v = tuple(margin_state.start_q), tuple(margin_state.start_v)
        start = StageState(q, v, evaluate(q, v))
        rk_step = step_function(start, length)
        tangents = phase_tangents.propagate(
            tableau, rk_step.stage_states, margin_state.start_tangents, length
        )
        is_selected = jnp.arange(len(margins.includes_start)) == index
        return None, jnp.sum(
            jnp.where(is_selected[:, None], tangents_of_margins(rk_step.end, tangents), 0.0), 1
        )

    margin_indices = jnp.arange(len(result.phase_minima), dtype=jnp.int32)
    interior_tangents = jnp.moveaxis(
        lax.scan(tangent_of_margin, None, (margin_indices, minima, result.length_to_minimum))[1],
        0,
        1,
    )
    start_tangents = tangents_of_margins(phase_ends[0], phase_tangents.start_tangents)
    end_margin_tangents = tangents_of_margins(phase_ends[1], end_tangents)
    end_minima_tangents = jnp.where(
        minima.values <= result.phase_minima, end_margin_tangents, start_tangents
    )
    return jnp.where(
        result.interior_minima <= result.phase_minima, interior_tangents, end_minima_tangents
    )
