"""Minima of margins, and extrema and integrals of quantities, during a phase of a batch.

They are as accurate as the integration. During the integration, the solver step that contains the
lowest minimum of each margin is stored. Afterwards, a secant iteration for the root of the margin's
time derivative locates each minimum, one margin after another.

Other quantities are taken over the smooth parts between kinks. Each part is sampled at the nodes of
Lobatto's rule in several intervals. In an interval, a quantity is the polynomial through its values
and rates at the five nodes, and its integral is that of Lobatto's rule. Both are more accurate than
the motion.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from vrw_jax.base.elementwise import (
    Vector,
    select_entry_by_mask,
    select_trees_by_condition,
)
from vrw_jax.base.options import StepOptions
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


N_INTERVALS = 8
"""Number of intervals in each part. The value is chosen because a relative error of the force is
then below 1e-9.
"""
INTERVAL_GRADING = 4.0
"""Ratio of the last interval's length to the first. The value is chosen because fast modes of light
legs decay after the start of a part.
"""
NODES = np.array([-1.0, -np.sqrt(3.0 / 7.0), 0.0, np.sqrt(3.0 / 7.0), 1.0])
"""Nodes of Lobatto's rule in an interval from -1 to 1."""
NODE_WEIGHTS = np.array([9.0, 49.0, 64.0, 49.0, 9.0]) / 180.0
"""Weights of the nodes in the mean over an interval."""
_BOUNDARIES = np.expm1(np.linspace(0.0, np.log(INTERVAL_GRADING), N_INTERVALS + 1)) / (
    INTERVAL_GRADING - 1.0
)
_INTERVAL_FRACTIONS = np.diff(_BOUNDARIES)
NODE_FRACTIONS = np.append(
    (_BOUNDARIES[:-1, None] + _INTERVAL_FRACTIONS[:, None] * (NODES[:-1] + 1.0) / 2.0).ravel(), 1.0
)
"""Time of each node as a fraction of the duration of a part. Neighboring intervals share a node."""
_NODE_INDICES = (len(NODES) - 1) * np.arange(N_INTERVALS)[:, None] + np.arange(len(NODES))
_POWERS = np.arange(2 * len(NODES))
N_BRACKETS = 8
"""Number of brackets in an interval, each of which may contain one inflection and two extrema."""
_BRACKET_ENDS = np.linspace(-1.0, 1.0, N_BRACKETS + 1)
N_BISECTIONS = 12
"""Number of bisections of a bracket. The value is chosen because Newton's method then converges."""
N_NEWTON_STEPS = 3
"""Number of Newton's steps after them. The value is chosen because they reach round-off."""


def _evaluate_powers(location: Any, order: int = 0) -> Any:
    """Return the derivatives of all powers of a location, on the last axis."""
    factors = np.prod([_POWERS - i for i in range(order)], axis=0) * np.ones(len(_POWERS))
    return factors * location[..., None] ** np.maximum(_POWERS - order, 0)


_COEFFICIENTS_FROM_NODES = np.linalg.inv(
    np.concatenate([_evaluate_powers(NODES), _evaluate_powers(NODES, 1)])
)


class SmoothParts(NamedTuple):
    """Parts of a phase between its kinks. Their first axis contains the parts, in order of time."""

    n_kinks: Array  # number of kinks, which may exceed the number of listed parts
    sides: Array  # sides of the kinks in each part
    durations: Array  # s, zero for absent parts
    states: Array  # coordinates and rates at the `NODE_FRACTIONS` of each part

    @property
    def is_complete(self) -> Array:
        return self.n_kinks < len(self.durations)


class PartExtrema(NamedTuple):
    """Extrema of a quantity in the parts of a phase, in order of time; most flags are false."""

    times: Array  # since the start of the phase, s
    values: Array
    is_maximum: Array
    is_minimum: Array


def find_extrema(values: Array, rates: Array, durations: Array) -> PartExtrema:
    """Return the smooth extrema of a quantity, with its values and rates at the nodes of parts.

    Their values have exact first derivatives, because the quantity is stationary there.
    """
    lengths = durations[:, None] * _INTERVAL_FRACTIONS.astype(values.dtype)
    slopes = rates[:, _NODE_INDICES] * (0.5 * lengths[..., None])
    samples = jnp.concatenate([values[:, _NODE_INDICES], slopes], -1)
    coefficients = samples @ _COEFFICIENTS_FROM_NODES.T.astype(values.dtype)
    fixed = lax.stop_gradient(coefficients)
    evaluate = lambda location, order: jnp.sum(
        fixed[..., None, :] * _evaluate_powers(location, order), -1
    )

    def find_roots(order: int, start: Array, end: Array, is_positive: Array) -> Array:
        """Return a root of a derivative in each bracket, or any location if there is none.

        - `is_positive`: whether the derivative is positive at the start of the bracket.
        """

        def halve(_: Any, bracket: tuple[Array, Array]) -> tuple[Array, Array]:
            middle = 0.5 * (bracket[0] + bracket[1])
            is_later = (evaluate(middle, order) > 0.0) == is_positive
            return jnp.where(is_later, middle, bracket[0]), jnp.where(is_later, bracket[1], middle)

        def correct(_: Any, location: Array) -> Array:
            rate = evaluate(location, order + 1)
            change = evaluate(location, order) / jnp.where(rate == 0.0, 1.0, rate)
            return jnp.clip(location - change, start, end)

        low, high = lax.fori_loop(0, N_BISECTIONS, halve, (start, end))
        return lax.fori_loop(0, N_NEWTON_STEPS, correct, 0.5 * (low + high))

    shape = (*fixed.shape[:-1], N_BRACKETS)
    start, end = (
        jnp.broadcast_to(x.astype(values.dtype), shape)
        for x in (_BRACKET_ENDS[:-1], _BRACKET_ENDS[1:])
    )
    # Two extrema in one bracket are separated by an inflection.
    inflections = find_roots(2, start, end, evaluate(start, 2) > 0.0)
    interleave = lambda *x: jnp.stack(x, -1).reshape(*shape[:-1], -1)
    start, end = interleave(start, inflections), interleave(inflections, end)
    # Neighboring intervals have the same slope at their common node.
    end_slopes = lax.stop_gradient(jnp.concatenate([slopes[..., :1], slopes[..., -1:]], -1))
    inner_slopes = evaluate(start[..., 1:], 1)
    all_slopes = jnp.concatenate([end_slopes[..., :1], inner_slopes, end_slopes[..., 1:]], -1)
    is_rising = all_slopes > 0.0
    locations = find_roots(1, start, end, is_rising[..., :-1])
    extremum_values = jnp.sum(coefficients[..., None, :] * _evaluate_powers(locations), -1)
    starts = (jnp.cumsum(durations) - durations)[:, None] + durations[:, None] * _BOUNDARIES[:-1]
    times = starts[..., None] + 0.5 * (locations + 1.0) * lengths[..., None]
    has_occurred = (durations > 0.0)[:, None, None]
    is_maximum = has_occurred & is_rising[..., :-1] & ~is_rising[..., 1:]
    is_minimum = has_occurred & ~is_rising[..., :-1] & is_rising[..., 1:]
    return PartExtrema(*map(jnp.ravel, (times, extremum_values, is_maximum, is_minimum)))


def mask_ends(values: Array, durations: Array) -> Array:
    """Return the values at both ends of each part, and -inf for absent parts."""
    return jnp.ravel(jnp.where((durations > 0.0)[:, None], values[:, np.array([0, -1])], -jnp.inf))


def mask_incomplete(value: Array, parts_by_phase: Sequence[SmoothParts]) -> Array:
    """Return a value, or NaN if a phase has more kinks than parts are listed."""
    is_complete = functools.reduce(jnp.logical_and, [x.is_complete for x in parts_by_phase])
    return jnp.where(is_complete, value, jnp.nan)


def integrate_over_parts(values: Array, durations: Array) -> Array:
    """Return the integral of a quantity over all parts, with its values at their nodes."""
    weights = _INTERVAL_FRACTIONS[:, None] * NODE_WEIGHTS
    return jnp.sum(durations[:, None, None] * weights * values[:, _NODE_INDICES])


class StepForceExtrema(NamedTuple):
    """Extrema of a force in one gait step, in chronological order."""

    times: Any  # s
    forces: Any  # N
    is_peak: Any
    is_trough: Any
    rate_times: Any  # of extrema of the rate, s
    rates: Any  # N/s
    is_rate_maximum: Any
    other_forces: Any  # at the ends of phases, or at all samples, N


def summarize_forces(xp: Any, fore: StepForceExtrema, total: StepForceExtrema) -> dict[str, Any]:
    """Return the measures of a step from extrema of the force on the fore foot and of their sum.

    - `xp`: `jax.numpy`, or `numpy` for numbers of extrema that differ from step to step.
    """
    fore_peaks, total_peaks = (_summarize_force(extrema, xp) for extrema in (fore, total))
    names = {"n_force_peaks": "n_total_force_peaks", "peak_force": "peak_total_force"}
    names["smooth_peak_force"] = "smooth_peak_total_force"
    return fore_peaks | {names[name]: total_peaks[name] for name in names}


def _summarize_force(extrema: StepForceExtrema, xp: Any) -> dict[str, Any]:
    """Return the measures of the fore foot in `measures.FORCE_PEAK_MEASURES`, by name."""
    find_largest = lambda values: xp.max(values, initial=-xp.inf)
    peak_forces = xp.where(extrema.is_peak, extrema.forces, -xp.inf)
    lower_neighbor_peak = xp.minimum(
        _find_highest_before(peak_forces, xp), _find_highest_before(peak_forces, xp, True)
    )
    is_trough = extrema.is_trough & xp.isfinite(lower_neighbor_peak)
    trough_depths = xp.where(
        is_trough, xp.where(is_trough, lower_neighbor_peak, 0.0) - extrema.forces, 0.0
    )
    first_peak_time = xp.min(xp.where(extrema.is_peak, extrema.times, xp.inf), initial=xp.inf)
    is_later_rate_maximum = extrema.is_rate_maximum & (extrema.rate_times > first_peak_time)
    largest_rate = find_largest(xp.where(is_later_rate_maximum, extrema.rates, -xp.inf))
    candidate_forces = xp.append(peak_forces, extrema.other_forces)
    return {
        "n_force_peaks": xp.sum(extrema.is_peak),
        # The maximum of tied forces has one-sided derivatives. Selection returns one of them.
        "peak_force": candidate_forces[xp.argmax(candidate_forces)],
        "smooth_peak_force": xp.where(xp.any(extrema.is_peak), find_largest(peak_forces), xp.nan),
        "force_trough_depth": xp.max(trough_depths, initial=0.0),
        "second_peak_rate": xp.where(xp.any(is_later_rate_maximum), largest_rate, xp.nan),
    }


def _find_highest_before(forces: Any, xp: Any, is_reversed: bool = False) -> Any:
    """Return the largest force before each one, or after it, and -inf if there is none.

    JAX computes it in a loop, because comparisons of all pairs would double the compiled code.
    """
    if xp is np:
        order = slice(None, None, -1 if is_reversed else 1)
        return np.maximum.accumulate(np.append(-np.inf, forces[order])[:-1])[order]
    start = jnp.asarray(-jnp.inf, forces.dtype)
    keep_highest = lambda highest, force: (jnp.maximum(highest, force), highest)
    return lax.scan(keep_highest, start, forces, reverse=is_reversed)[1]
