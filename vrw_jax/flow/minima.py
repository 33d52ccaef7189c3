"""Minima of margins during a phase of a batch, as accurate as the integration.

During the integration, the solver step that contains the lowest minimum of each margin is stored.
Afterwards, a secant iteration for the root of the margin's time derivative locates each minimum,
one margin after another.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from vrw_jax.base.elementwise import select_entry_by_mask, select_trees_by_condition
from vrw_jax.base.options import StepOptions
from vrw_jax.base.types import Vector
from vrw_jax.flow.solver_steps import BatchPhase, ButcherTableau, SolverStepFunction, StageState

MINIMUM_LOCATION_TOLERANCE = 1e-6
"""Accuracy of the location of a minimum, as a fraction of the solver step. The value is chosen
because the error of the minimum is proportional to the square of the error of its location.
"""
EnterSides = Callable[[Vector], tuple[BatchPhase, SolverStepFunction, Any]]
"""Function that returns the phase on the given sides of its kinks, its solver, and its tangents."""


@jax.jit  # The function is traced once for all margins.
def _find_cubic_minimum(
    cubic_value_at_0: Array, cubic_rate_at_0: Array, cubic_value_at_1: Array, cubic_rate_at_1: Array
) -> tuple[Array, Array]:
    """Return the location and the value of the interior minimum of the cubic Hermite interpolant.

    The location is between 0 and 1. If there is no interior minimum, the value is the
    lower of the values at the two ends. Rates are multiplied by the length of the solver step.
    """
    quadratic_coefficient = 3.0 * (
        2.0 * cubic_value_at_0 + cubic_rate_at_0 - 2.0 * cubic_value_at_1 + cubic_rate_at_1
    )
    linear_coefficient = 2.0 * (
        -3.0 * cubic_value_at_0 - 2.0 * cubic_rate_at_0 + 3.0 * cubic_value_at_1 - cubic_rate_at_1
    )
    discriminant = (
        linear_coefficient * linear_coefficient - 4.0 * quadratic_coefficient * cubic_rate_at_0
    )
    sqrt_discriminant = jnp.sqrt(jnp.where(discriminant > 0.0, discriminant, 1.0))
    # The minimum is the root with positive curvature, computed without cancellation.
    location_denominator = jnp.where(
        linear_coefficient >= 0.0,
        -(linear_coefficient + sqrt_discriminant),
        2.0 * quadratic_coefficient,
    )
    location_numerator = jnp.where(
        linear_coefficient >= 0.0, 2.0 * cubic_rate_at_0, sqrt_discriminant - linear_coefficient
    )
    nonzero_denominator = jnp.where(location_denominator == 0.0, 1.0, location_denominator)
    x = jnp.where(location_denominator == 0.0, -1.0, location_numerator / nonzero_denominator)
    has_interior_minimum = (discriminant > 0.0) & (x > 0.0) & (x < 1.0)
    x = jnp.where(has_interior_minimum, x, 0.5)
    value = (
        (1 + 2 * x) * (1 - x) ** 2 * cubic_value_at_0
        + x * (1 - x) ** 2 * cubic_rate_at_0
        + x * x * (3 - 2 * x) * cubic_value_at_1
        + x * x * (x - 1) * cubic_rate_at_1
    )
    end_value = jnp.minimum(cubic_value_at_0, cubic_value_at_1)
    return x, jnp.where(has_interior_minimum, value, end_value)


class MarginMinimaState(NamedTuple):
    """Margins at the present state, and the lowest minimum of each margin so far."""

    margin_values: Array  # margins at the present state, (margins, batch)
    margin_rates: Array
    lowest_margin_values: (
        Array  # lowest interior minimum, (margins, batch); infinity if there is none
    )
    step_start_q: Vector  # positions at the start of that step, each (margins, batch)
    step_start_v: Vector
    step_length: Array  # length of that step, (margins, batch), s
    time_to_minimum: Array  # time from the step's start to the minimum, s
    step_start_margin_rates: Array  # rates of the margins at the step's start
    # tangents of that start, (margins, directions, components, batch)
    step_start_tangents: Array | None = None
    step_start_sides: Vector = ()  # `BatchPhase.sides` in that step, each (margins, batch)


def init_margin_minima_state(
    phase: BatchPhase, start_state: StageState, phase_tangents: Any
) -> MarginMinimaState:
    """Return the state of the search for minima before the first solver step.

    A margin that is zero at the start of the phase by construction cannot fall there. Its negative
    time derivative at the start is round-off and is replaced by zero.
    """
    margin_values, margin_rates = _evaluate_margins_with_rates(phase, start_state)
    includes_phase_start = _spread_over_batch(phase.margins_include_start, margin_values)
    zero_margins = jnp.zeros_like(margin_values)
    make_zeros = lambda coordinates: tuple(
        jnp.zeros((len(margin_values), *x.shape), x.dtype) for x in coordinates
    )
    margin_rates = jnp.where(includes_phase_start, margin_rates, jnp.maximum(margin_rates, 0.0))
    zero_tangents = (
        None
        if phase_tangents is None
        else jnp.stack([jnp.zeros_like(phase_tangents.start_tangents)] * len(margin_values))
    )
    return MarginMinimaState(
        margin_values,
        margin_rates,
        zero_margins + jnp.inf,
        make_zeros(start_state.q),
        make_zeros(start_state.v),
        zero_margins,
        zero_margins,
        zero_margins,
        zero_tangents,
        make_zeros(phase.sides),
    )


def update_margin_minima_state(
    phase: BatchPhase,
    margin_minima_state: MarginMinimaState,
    step_start: StageState,
    step_end: StageState,
    step_length: Array,
    is_accepted: Array,
    step_start_tangents: Array | None,
) -> MarginMinimaState:
    """Return the lowest interior minima after one more solver step.

    - `is_accepted`: whether each batch element accepts the step;
    - `step_start_tangents`: tangents of the step's start.
    """
    margin_values, margin_rates = _evaluate_margins_with_rates(phase, step_end)
    margin_minimum_location, margin_minimum = _find_cubic_minimum(
        margin_minima_state.margin_values,
        margin_minima_state.margin_rates * step_length,
        margin_values,
        margin_rates * step_length,
    )
    has_interior_minimum = (margin_minima_state.margin_rates < 0.0) & (margin_rates >= 0.0)
    is_minimum_lower = (
        is_accepted
        & has_interior_minimum
        & (margin_minimum < margin_minima_state.lowest_margin_values)
    )

    minimum_of_step = margin_minima_state._replace(
        lowest_margin_values=margin_minimum,
        step_start_q=step_start.q,
        step_start_v=step_start.v,
        step_length=step_length,
        time_to_minimum=margin_minimum_location * step_length,
        step_start_margin_rates=margin_minima_state.margin_rates,
        step_start_tangents=step_start_tangents,
        step_start_sides=phase.sides,
    )
    margin_values, margin_rates = select_trees_by_condition(
        is_accepted,
        (margin_values, margin_rates),
        (margin_minima_state.margin_values, margin_minima_state.margin_rates),
    )
    lowest_minimum = _replace_if_lower(is_minimum_lower, margin_minima_state, minimum_of_step)
    return lowest_minimum._replace(margin_values=margin_values, margin_rates=margin_rates)


def _replace_if_lower(
    is_minimum_lower: Array, old_state: MarginMinimaState, new_state: MarginMinimaState
) -> MarginMinimaState:
    def replace_if_lower(old_value: Array, new_value: Array) -> Array:
        n_margins, *batch_shape = is_minimum_lower.shape
        n_inner_axes = old_value.ndim - is_minimum_lower.ndim
        is_lower = is_minimum_lower.reshape(n_margins, *(1,) * n_inner_axes, *batch_shape)
        return jnp.where(is_lower, new_value, old_value)

    return jax.tree.map(replace_if_lower, old_state, new_state)


def pass_kink_of_margins(
    phase: BatchPhase,
    next_phase: BatchPhase,
    margin_minima_state: MarginMinimaState,
    kink_state: StageState,
    is_at_kink: Array,
    kink_tangents: Array | None,
) -> MarginMinimaState:
    """Return the lowest minima after a kink, where a margin may have a minimum or may jump.

    - `phase`, `next_phase`: the phase before and after the kink;
    - `kink_state`, `kink_tangents`: state at the kink in `next_phase`, and its tangents.
    """
    old_values = margin_minima_state.margin_values
    values, rates = _evaluate_margins_with_rates(next_phase, kink_state)
    lower_values = jnp.minimum(old_values, values)
    zero_length = jnp.zeros(is_at_kink.shape, values.dtype)
    minimum_at_kink = margin_minima_state._replace(
        lowest_margin_values=lower_values,
        step_start_q=kink_state.q,
        step_start_v=kink_state.v,
        step_length=zero_length,
        time_to_minimum=zero_length,
        step_start_margin_rates=rates,
        step_start_tangents=kink_tangents,
        step_start_sides=tuple(
            jnp.where(values < old_values, *x)
            for x in zip(next_phase.sides, phase.sides, strict=True)
        ),
    )
    is_lower = is_at_kink & (lower_values < margin_minima_state.lowest_margin_values)
    lowest_minimum = _replace_if_lower(is_lower, margin_minima_state, minimum_at_kink)
    return lowest_minimum._replace(
        margin_values=jnp.where(is_at_kink, values, old_values),
        margin_rates=jnp.where(is_at_kink, rates, margin_minima_state.margin_rates),
    )


def _evaluate_margins_with_rates(phase: BatchPhase, state: StageState) -> tuple[Array, Array]:
    margins_and_rates = phase.evaluate_with_rates(phase.evaluate_margins, state)
    return lax.stop_gradient((jnp.stack(margins_and_rates[0]), jnp.stack(margins_and_rates[1])))


class MarginMinimaResult(NamedTuple):
    """Minima of margins over a phase; each field has the shape (margins, batch)."""

    phase_margin_minima: Array  # minima over the phase, ends included
    interior_margin_minima: Array  # interior minima; infinity if a margin has none
    step_length_to_minimum: (
        Array  # length of the step from the stored start to the interior minimum, s
    )


class _MarginMinimumSearch(NamedTuple):
    """State of the secant iteration for the minimum of one margin in each batch element."""

    step_length: Array  # length of the next solver step, s
    best_step_length: Array  # length of the step that ended with the smallest rate, s
    best_margin_rate: Array
    margin_value: Array
    is_minimum_unresolved: Array
    n_iterations: Array


def refine_margin_minima(
    phase: BatchPhase,
    solver_step_function: SolverStepFunction,
    margin_minima_state: MarginMinimaState,
    start_margin_values: Array,
    options: StepOptions,
    min_iterations: int = 1,
    enter_sides: EnterSides | None = None,
) -> MarginMinimaResult:
    """Return the minima of the margins over the phase, refined by a secant iteration.

    `start_margin_values` are the margins at the start of the phase, (margins, batch). Each
    iteration takes a solver step from the start of the solver step that contains the minimum. At
    most `max_margin_search_iterations` iterations are made per margin, and at least
    `min_iterations`. Each iteration adds correct digits to the derivatives of the minimum's time.

    - `enter_sides`: function for phases with kinks.
    """

    phase_and_solver = phase, solver_step_function

    def refine_minimum(_: None, margin_scan_inputs: tuple) -> tuple[None, tuple[Array, Array]]:
        margin_index, margin_minimum_state = margin_scan_inputs
        phase, solver_step_function = phase_and_solver
        if enter_sides is not None:
            phase, solver_step_function, _ = enter_sides(margin_minimum_state.step_start_sides)
        return None, _refine_one_margin_minimum(
            phase,
            solver_step_function,
            margin_index,
            margin_minimum_state,
            options.max_margin_search_iterations,
            min_iterations,
        )

    includes_phase_start = _spread_over_batch(phase.margins_include_start, start_margin_values)
    end_margin_minima = jnp.minimum(
        jnp.where(includes_phase_start, start_margin_values, jnp.inf),
        margin_minima_state.margin_values,
    )
    margin_indices = jnp.arange(len(start_margin_values), dtype=jnp.int32)
    interior_margin_minima, step_length_to_minimum = lax.scan(
        refine_minimum,
        None,
        (margin_indices, margin_minima_state._replace(step_start_tangents=None)),
    )[1]
    return MarginMinimaResult(
        jnp.minimum(interior_margin_minima, end_margin_minima),
        interior_margin_minima,
        step_length_to_minimum,
    )


def _refine_one_margin_minimum(
    phase: BatchPhase,
    solver_step_function: SolverStepFunction,
    margin_index: Array,
    margin_minimum_state: MarginMinimaState,
    max_iterations: Any,
    min_iterations: int,
) -> tuple[Array, Array]:
    """Return the minimum of one margin, and the length of the solver step that ends there, s."""
    minimum_step_start_state = phase.make_state(
        margin_minimum_state.step_start_q, margin_minimum_state.step_start_v
    )

    evaluate_selected_margin = lambda state: (
        select_entry_by_mask(margin_index, jnp.stack(phase.evaluate_margins(state))),
    )

    def improve_margin_minimum_search(
        margin_minimum_search: _MarginMinimumSearch,
    ) -> _MarginMinimumSearch:
        step_length = margin_minimum_search.step_length
        n_iterations = margin_minimum_search.n_iterations
        step_end = solver_step_function(minimum_step_start_state, step_length)[0][-1]
        (margin_value,), (margin_rate,) = phase.evaluate_with_rates(
            evaluate_selected_margin, step_end
        )
        # A secant step for the root of the margin's rate, whose slope has no derivative.
        length_value, rate_value = lax.stop_gradient((step_length, margin_rate))
        best = margin_minimum_search.best_step_length, margin_minimum_search.best_margin_rate
        length_change = length_value - best[0]
        rate_slope = (rate_value - best[1]) / jnp.where(length_change == 0.0, 1.0, length_change)
        is_secant_usable = (length_change != 0.0) & (rate_slope > 0.0)
        length_correction = jnp.where(
            is_secant_usable, -margin_rate / jnp.where(is_secant_usable, rate_slope, 1.0), 0.0
        )
        max_step_length = margin_minimum_state.step_length
        next_step_length = jnp.clip(step_length + length_correction, 0.0, max_step_length)
        has_converged = (
            jnp.abs(next_step_length - step_length) <= MINIMUM_LOCATION_TOLERANCE * max_step_length
        )
        best_step_length, best_margin_rate = select_trees_by_condition(
            jnp.abs(rate_value) < jnp.abs(best[1]), (length_value, rate_value), best
        )
        return select_trees_by_condition(
            margin_minimum_search.is_minimum_unresolved,
            _MarginMinimumSearch(
                next_step_length,
                best_step_length,
                best_margin_rate,
                margin_value,
                margin_minimum_search.is_minimum_unresolved
                & (~has_converged | (n_iterations + 1 < min_iterations)),
                n_iterations,
            ),
            margin_minimum_search,
        )._replace(n_iterations=n_iterations + 1)

    zero_step_length = jnp.zeros_like(margin_minimum_state.step_length)
    margin_minimum_search = _MarginMinimumSearch(
        margin_minimum_state.time_to_minimum,
        zero_step_length,
        margin_minimum_state.step_start_margin_rates,
        zero_step_length + jnp.inf,
        jnp.isfinite(margin_minimum_state.lowest_margin_values),
        jnp.zeros((), jnp.int32),
    )
    needs_iteration = lambda margin_minimum_search: (
        jnp.any(margin_minimum_search.is_minimum_unresolved)
        & (margin_minimum_search.n_iterations < max_iterations)
    )
    final_search = lax.while_loop(
        needs_iteration, improve_margin_minimum_search, margin_minimum_search
    )
    return final_search.margin_value, final_search.step_length


def _spread_over_batch(flags_of_margins: Any, margins: Array) -> Array:
    """Return one flag for each margin in a shape that broadcasts with (margins, batch)."""
    return jnp.asarray(flags_of_margins).reshape(-1, *(1,) * (margins.ndim - 1))


def compute_margin_minima_jvp(
    solver_step_function: SolverStepFunction,
    tableau: ButcherTableau,
    phase_tangents: Any,
    margin_minima_state: MarginMinimaState,
    margin_minima_result: MarginMinimaResult,
    start_state: StageState,
    end_state: StageState,
    end_tangents: Array,
    enter_sides: EnterSides | None = None,
) -> Array:
    """Return the tangents of the minima of the margins, shape (directions, margins, batch).

    The tangents are those of the margins at fixed times, because the shift of a minimum in time has
    no first-order effect. `start_state` and `end_state` are the states at the start and at the end
    of the phase, and `end_tangents` are the tangents of the end state.
    """
    phase = phase_tangents.make_phase(
        phase_tangents.equation_constants, phase_tangents.held_constants
    )
    phase_and_solver = phase, solver_step_function, phase_tangents
    evaluate_margins = lambda phase, state: jnp.stack(phase.evaluate_margins(state))
    compute_margin_tangents = functools.partial(phase_tangents.evaluate_tangents, evaluate_margins)

    def compute_margin_tangent(_: None, margin_scan_inputs: tuple) -> tuple[None, Array]:
        margin_index, margin_minimum_state, step_length = margin_scan_inputs
        phase, solver_step_function, step_tangents = phase_and_solver
        if enter_sides is not None:
            phase, solver_step_function, step_tangents = enter_sides(
                margin_minimum_state.step_start_sides
            )
        minimum_step_start_state = phase.make_state(
            margin_minimum_state.step_start_q, margin_minimum_state.step_start_v
        )
        stage_states = solver_step_function(minimum_step_start_state, step_length)[0]
        state_tangents = step_tangents.propagate_to_step_end(
            tableau, stage_states, margin_minimum_state.step_start_tangents, step_length
        )
        margin_tangents = step_tangents.evaluate_tangents(
            evaluate_margins, stage_states[-1], state_tangents
        )
        return None, select_entry_by_mask(margin_index, margin_tangents, 1)

    margin_indices = jnp.arange(len(margin_minima_result.phase_margin_minima), dtype=jnp.int32)
    interior_minima_tangents = jnp.moveaxis(
        lax.scan(
            compute_margin_tangent,
            None,
            (margin_indices, margin_minima_state, margin_minima_result.step_length_to_minimum),
        )[1],
        0,
        1,
    )
    end_margin_minima_tangents = jnp.where(
        margin_minima_state.margin_values <= margin_minima_result.phase_margin_minima,
        compute_margin_tangents(end_state, end_tangents),
        compute_margin_tangents(start_state, phase_tangents.start_tangents),
    )
    return jnp.where(
        margin_minima_result.interior_margin_minima <= margin_minima_result.phase_margin_minima,
        interior_minima_tangents,
        end_margin_minima_tangents,
    )
