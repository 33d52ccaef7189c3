"""Phases of a batch, and explicit Runge-Kutta steps in them, with an array for each coordinate.

The equations of motion are of second order, q'' = f(q, q'), so a solver step stores only the
accelerations at its stages. The tableau's matrix converts these accelerations to rates, and its
square converts them to positions. The method is the same as for the first-order system, with half
of the stored derivatives. The tableaus are those of diffrax.
"""

import functools
import itertools
import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from vrw_jax.base.elementwise import (
    Vector,
    approximate_power,
    run_if_any_element_active,
    select_trees_by_condition,
)
from vrw_jax.base.options import StepOptions


class ButcherTableau(NamedTuple):
    """Butcher tableau of an explicit Runge-Kutta method with the first-same-as-last property.

    The last stage of a solver step is the first stage of the next.
    """

    convergence_order: int
    stage_nodes: np.ndarray  # Butcher's c: times of the stages, in step lengths
    stage_matrix: np.ndarray  # Butcher's A: from accelerations to rates
    squared_stage_matrix: np.ndarray  # A squared: from accelerations to positions
    rate_error_weights: np.ndarray
    position_error_weights: np.ndarray
    guard_stage_indices: tuple[int, ...]
    """Indices of the stages at which guards are evaluated to find minima inside a solver step.

    The nodes of these stages are separated from each other and from both ends.
    """
    bernstein_matrix: np.ndarray
    """Matrix that maps guard values to the inner Bernstein coefficients of their polynomial.

    The guard values are those at the start, at `guard_stage_indices` and at the end. The polynomial
    through these values does not fall below its smallest coefficient.
    """
    middle_guard_index: int
    """Index of the guard value near the middle of the solver step, used to fit parabolas to guards.

    The guard values are those at the start and at `guard_stage_indices`.
    """
    middle_node: float  # time of this value, in step lengths

    def __eq__(self, other: object) -> bool:
        return self is other  # `load_explicit_tableau` creates each tableau once.

    def __hash__(self) -> int:
        return id(self)


@functools.cache
def load_explicit_tableau(solver_name: str) -> ButcherTableau | None:
    """Return the tableau of diffrax's solver `solver_name`; None if it is not an explicit method.

    The tableau is read from a file in this package, because the import of diffrax takes a fifth of
    the start-up time with cached programs.
    """
    tableaus = json.loads(Path(__file__).with_name("tableaus.json").read_text(encoding="utf-8"))
    if solver_name not in tableaus:
        return None
    tableau_entry = tableaus[solver_name]
    n_stages, has_step_end_stage = len(tableau_entry["b_sol"]), tableau_entry["ssal"]
    n_rows = n_stages + (not has_step_end_stage)
    stage_matrix = np.zeros((n_rows, n_rows))
    for i, matrix_row in enumerate(tableau_entry["a_lower"]):
        stage_matrix[i + 1, : i + 1] = matrix_row
    rate_error_weights = np.zeros(n_rows)
    rate_error_weights[:n_stages] = tableau_entry["b_error"]
    if not has_step_end_stage:
        stage_matrix[n_stages, :n_stages] = tableau_entry["b_sol"]
    stage_nodes = stage_matrix.sum(axis=1)
    # Of several stages at one node, the last stage is the most accurate.
    last_stage_at_node = {
        round(float(stage_node), 3): i
        for i, stage_node in enumerate(stage_nodes)
        if 0.05 < stage_node < 0.95
    }
    nearest_nodes = {
        min((abs(stage_node - guard_node), stage_node) for stage_node in last_stage_at_node)[1]
        for guard_node in GUARD_STAGE_NODES
        if last_stage_at_node
    }
    guard_stage_indices = tuple(last_stage_at_node[node] for node in sorted(nearest_nodes))
    guard_nodes = np.array([0.0, *stage_nodes[list(guard_stage_indices)], 1.0])
    middle_guard_index = min(
        range(1, len(guard_nodes) - 1), key=lambda i: abs(guard_nodes[i] - 0.45), default=0
    )
    polynomial_degree = len(guard_nodes) - 1
    bernstein_basis = [
        math.comb(polynomial_degree, i)
        * guard_nodes**i
        * (1.0 - guard_nodes) ** (polynomial_degree - i)
        for i in range(polynomial_degree + 1)
    ]
    return ButcherTableau(
        convergence_order=tableau_entry["order"],
        stage_nodes=stage_nodes,
        stage_matrix=stage_matrix,
        squared_stage_matrix=_set_roundoff_to_zero(stage_matrix @ stage_matrix),
        rate_error_weights=rate_error_weights,
        position_error_weights=_set_roundoff_to_zero(rate_error_weights @ stage_matrix),
        guard_stage_indices=guard_stage_indices,
        bernstein_matrix=np.linalg.inv(np.stack(bernstein_basis, 1))[1:-1],
        middle_guard_index=middle_guard_index,
        # A step without inner stages has a line instead of a parabola.
        middle_node=float(guard_nodes[middle_guard_index]) or -math.inf,
    )


GUARD_STAGE_NODES = (0.15, 0.47, 0.92)
"""Nodes, as fractions of the solver step, near which guards are evaluated inside the step.

The values are chosen nearer to the ends than equally spaced nodes. A minimum just after the start
or before the end is the hardest to detect.
"""


def _compute_bernstein_coefficients(
    tableau: ButcherTableau, guard_values: list[Array]
) -> list[Array]:
    """Return the Bernstein coefficients, except the last, of the polynomials through guard values.

    If all coefficients are positive, so is the polynomial.
    """
    return [
        guard_values[0],
        *(_sum_weighted_terms(matrix_row, guard_values) for matrix_row in tableau.bernstein_matrix),
    ]


def find_earliest_guard_minimum_fraction(
    tableau: ButcherTableau, guard_values: list[Array], is_counted: Array | bool = True
) -> Array:
    """Return the location of the earliest minimum at which some guard may be negative.

    The location is a fraction of the solver step, or 1 if no guard has such a minimum.
    `guard_values` are the guards at the start, at the stages `guard_stage_indices`, and at the end,
    each (guards, batch). `is_counted` marks the guards that may have a minimum. The computation is
    skipped if no batch element may have one.
    """
    lowest_coefficients = functools.reduce(
        jnp.minimum, _compute_bernstein_coefficients(tableau, guard_values)
    )
    may_cross_inside = jnp.any(
        is_counted & (lowest_coefficients <= 0.0) & (guard_values[-1] > 0.0), axis=0
    )

    def find_first_minimum(_: Array) -> Array:
        # A guard may have a minimum at the node of its lowest coefficient if it rises somewhere.
        min_bernstein_coefficient, *inner_bernstein_coefficients = _compute_bernstein_coefficients(
            tableau, guard_values
        )
        minimum_fraction = jnp.zeros_like(min_bernstein_coefficient)
        for i, inner_bernstein_coefficient in enumerate(inner_bernstein_coefficients):
            minimum_fraction = jnp.where(
                inner_bernstein_coefficient < min_bernstein_coefficient,
                (i + 1) / len(guard_values[1:]),
                minimum_fraction,
            )
            min_bernstein_coefficient = jnp.minimum(
                inner_bernstein_coefficient, min_bernstein_coefficient
            )
        has_guard_risen = jnp.zeros(minimum_fraction.shape, bool)
        for preceding_guard_value, following_guard_value in (
            *zip(inner_bernstein_coefficients[-1:], guard_values[-1:], strict=False),
            *itertools.pairwise(guard_values),
        ):
            has_guard_risen = has_guard_risen | (preceding_guard_value < following_guard_value)
        has_guard_minimum = (
            (min_bernstein_coefficient <= 0.0)
            & (minimum_fraction > 0.0)
            & has_guard_risen
            & (guard_values[-1] > 0.0)
        )
        return jnp.min(jnp.where(is_counted & has_guard_minimum, minimum_fraction, 1.0), axis=0)

    whole_step_fraction = jnp.ones_like(guard_values[0][0])
    return run_if_any_element_active(
        jnp.any(may_cross_inside), find_first_minimum, whole_step_fraction
    )


def find_hidden_event_fraction(
    tableau: ButcherTableau, values: list[Array], others: list[Array]
) -> Array:
    """Return where guards with `armed` may be negative within a solver step that does not show it.

    Such a guard is the maximum of its value and minus `armed`. It may be negative for a short time,
    which neither its sign at the end of the step nor a polynomial through it shows, because it has
    a kink. The result is the earliest zero or minimum of `values`, one of the two functions, while
    `others` may be negative, as a fraction of the step, or 1 if there is none. A zero is exact in
    the limit of short steps. The times of both, (guards, batch), are those of
    `find_earliest_guard_minimum_fraction`.
    """
    coefficients = [*_compute_bernstein_coefficients(tableau, others), others[-1]]
    may_be_negative = functools.reduce(jnp.minimum, coefficients) < 0.0
    changes_sign = may_be_negative & (functools.reduce(jnp.maximum, coefficients) >= 0.0)
    fraction = jnp.ones_like(values[0])
    nodes = [0.0, *map(float, tableau.stage_nodes[list(tableau.guard_stage_indices)]), 1.0]
    for (left_node, left), (right_node, right) in itertools.pairwise(
        zip(nodes, values, strict=True)
    ):
        is_bracket = changes_sign & (left > 0.0) & (right <= 0.0)
        share = left / jnp.where(is_bracket, left - right, 1.0)
        zero = left_node + (right_node - left_node) * share
        fraction = jnp.where(is_bracket, jnp.minimum(fraction, zero), fraction)
    overshoot = CROSSING_OVERSHOOT * jnp.maximum(fraction, CROSSING_OVERSHOOT)
    minimum_fraction = find_earliest_guard_minimum_fraction(tableau, values, may_be_negative)
    return jnp.minimum(jnp.min(fraction + overshoot, axis=0), minimum_fraction)


CROSSING_OVERSHOOT = 1e-6
"""Share of a solver step by which it ends beyond the estimated zero of a guard.

The value is chosen because the guard is then negative beyond round-off. An event within this share
before its guard is disarmed may be missed.
"""


# Factor by which the estimated step length for the tolerance is multiplied. This value and the two
# following ones are chosen because they are usual for explicit methods (Hairer, Norsett and Wanner,
# Solving Ordinary Differential Equations I, Section II.4).
STEP_LENGTH_SAFETY_FACTOR = 0.9
# Smallest ratio of successive step lengths.
MIN_STEP_LENGTH_RATIO = 0.2
# Largest ratio of successive step lengths; after a rejected step the ratio is at most 1.
MAX_STEP_LENGTH_RATIO = 5.0


def compute_step_size_factor(
    tableau: ButcherTableau,
    mean_squared_error: Array,
    float_dtype: Any,
) -> Array:
    """Return the ratio of the next step length to the present one, as `float_dtype`.

    `mean_squared_error` is the mean square of the solver step's error divided by the tolerance.
    """
    error_power = approximate_power(
        jnp.clip(mean_squared_error, 1e-20, 1e20), -0.5 / tableau.convergence_order
    ).astype(float_dtype)
    return jnp.clip(
        STEP_LENGTH_SAFETY_FACTOR * error_power,
        MIN_STEP_LENGTH_RATIO,
        jnp.where(mean_squared_error <= 1.0, MAX_STEP_LENGTH_RATIO, 1.0),
    )


def _set_roundoff_to_zero(x: np.ndarray) -> np.ndarray:
    """Return the array with zeros in place of entries that are within round-off of zero."""
    return np.where(np.abs(x) < 1e-14 * np.max(np.abs(x)), 0.0, x)


class StageAccelerations(NamedTuple):
    """Accelerations at one state, and sine and cosine of the wheel's angle theta.

    For a state without positions, `acceleration` is its time derivative, and the others are empty.
    """

    sin: Any  # sine of theta
    cos: Any
    acceleration: Any  # accelerations, those of the phase's coordinates first


@functools.cache
def compute_real_stability_limit(tableau: ButcherTableau) -> float:
    """Return the largest z with |R(-z)| <= 1, where R is the stability function of the method.

    For a motion that decays as exp(-r t), the longest stable solver step is z / r.
    """
    z = np.linspace(0.01, 20.0, 2000)
    stage_vector = np.ones(len(tableau.stage_nodes))
    stability_polynomial = 1.0
    # R is the polynomial 1 - z w (1 - z A + ...).
    for matrix_power in range(1, len(stage_vector) + 1):
        stability_polynomial = stability_polynomial + (-z) ** matrix_power * (
            tableau.stage_matrix[-1] @ stage_vector
        )
        stage_vector = tableau.stage_matrix @ stage_vector
    return float(z[np.argmax(np.abs(stability_polynomial) > 1.0 + 1e-12)])


class StageState(NamedTuple):
    """Positions, rates and accelerations at one stage.

    Each is a tuple of arrays (batch,), or one array (coordinates, batch).
    """

    q: Any
    v: Any
    acceleration: StageAccelerations


EvaluateAcceleration = Callable[[Any, Any], StageAccelerations]
SolverStepFunction = Callable[[StageState, Array], tuple[list[StageState], Array]]
"""Function of a state and a step length that returns all stages of a solver step, and its error.

The first stage is the start of the step, and the last stage is its end. The error is the mean
square of the error divided by the tolerance, and infinite if the end is not finite.
"""


def take_rk_step(
    tableau: ButcherTableau,
    evaluate_acceleration: EvaluateAcceleration,
    start_state: StageState,
    h: Array,
) -> list[StageState]:
    """Return the states at all stages of one Runge-Kutta step of length `h`, s.

    The first state is the start of the step, and the last state is its end.
    """
    n = len(start_state.v)
    stage_states, stage_accelerations = [start_state], [start_state.acceleration.acceleration[:n]]
    for i in range(1, len(tableau.stage_nodes)):
        q, v = evaluate_stage(tableau, i, start_state.q, start_state.v, stage_accelerations, h)
        stage_acceleration = evaluate_acceleration(q, v)
        stage_states.append(StageState(q, v, stage_acceleration))
        stage_accelerations.append(stage_acceleration.acceleration[:n])
    return stage_states


def estimate_step_error(
    tableau: ButcherTableau, stage_states: list[StageState], h: Array
) -> list[Array]:
    """Return the errors of the positions and then of the rates after a step of length `h`, s."""
    accelerations_by_coordinate = [
        [stage_state.acceleration.acceleration[i] for stage_state in stage_states]
        for i in range(len(stage_states[0].v))
    ]
    position_errors = [
        h * h * _sum_weighted_terms(tableau.position_error_weights, accelerations)
        for accelerations in accelerations_by_coordinate[: len(stage_states[0].q)]
    ]
    rate_errors = [
        h * _sum_weighted_terms(tableau.rate_error_weights, accelerations)
        for accelerations in accelerations_by_coordinate
    ]
    return position_errors + rate_errors


@functools.partial(jax.jit, static_argnums=(0, 1))  # The function is traced once for all steps.
def evaluate_stage(
    tableau: ButcherTableau,
    stage_index: int,
    start_positions: Vector,
    start_rates: Vector,
    stage_accelerations: list[Vector],
    h: Array,
) -> tuple[Vector, Vector]:
    """Return positions and rates at one stage from accelerations at the earlier stages.

    `h` is the length of the solver step, s.
    """
    stage_positions, stage_rates = [], []
    has_positions = len(start_positions) > 0
    for coordinate in range(len(start_rates)):
        coordinate_accelerations = [
            stage_acceleration[coordinate] for stage_acceleration in stage_accelerations
        ]
        if has_positions:
            twice_integrated_acceleration = _sum_weighted_terms(
                tableau.squared_stage_matrix[stage_index], coordinate_accelerations
            )
            displacement_per_time = (
                float(tableau.stage_nodes[stage_index]) * start_rates[coordinate]
            )
            if twice_integrated_acceleration is not None:
                displacement_per_time = displacement_per_time + h * twice_integrated_acceleration
            stage_positions.append(start_positions[coordinate] + h * displacement_per_time)
        integrated_acceleration = _sum_weighted_terms(
            tableau.stage_matrix[stage_index], coordinate_accelerations, is_sorted=not has_positions
        )
        stage_rates.append(start_rates[coordinate] + h * integrated_acceleration)
    return tuple(stage_positions), tuple(stage_rates)


def _sum_weighted_terms(
    term_weights: np.ndarray, terms_to_sum: list[Array], is_sorted: bool = False
) -> Any:
    """Return the sum of `term_weights` times `terms_to_sum`, or None if all weights are zero.

    Half of the operations in a solver step are such sums. The sum uses functions of `lax`, because
    they are traced in a third of the time of Python's operators. With `is_sorted`, small weights
    come first, so that the weights of Dopri8 add up to 1 without round-off.
    """
    weights_and_terms = [(w, x) for w, x in zip(term_weights, terms_to_sum, strict=False) if w]
    if is_sorted:
        weights_and_terms.sort(key=lambda weight_and_term: abs(weight_and_term[0]))
    weighted_terms = [lax.mul(x.dtype.type(w), x) for w, x in weights_and_terms]
    return functools.reduce(lax.add, weighted_terms) if weighted_terms else None


class ImplicitDynamics(NamedTuple):
    """Implicit form of the equations of motion near a state."""

    evaluate_residual: Callable[[StageState], Vector]
    """Function that returns the left minus the right side of the equations of motion."""
    solve_for_accelerations: Callable[[StageState, Vector], Vector]
    """Function that returns accelerations for which the left side equals the second argument."""


class BatchPhase(NamedTuple):
    """Functions that define a phase, elementwise for all batch elements.

    The function `evaluate_acceleration` returns the accelerations at a state. The guards are
    positive inside the phase, and an event occurs when a guard falls through zero. The earliest
    event ends the phase. If two guards are zero at the same time, the first in the list ends the
    phase.
    """

    evaluate_acceleration: EvaluateAcceleration
    evaluate_guards: Callable[[StageState], Array]
    """Function that returns all guards as one array (guards, batch)."""
    evaluate_margins: Callable[[StageState], Vector] = lambda stage_state: ()
    """Function that returns the margins whose minima are computed."""
    margins_include_start: tuple[bool, ...] = ()
    """Whether each margin counts at the phase's start, see `phase_integration.GuardsAndMargins`."""
    implicit_dynamics: ImplicitDynamics = None  # type: ignore[assignment]
    """Equations of motion in implicit form. Only derivatives need them."""
    is_compiled_separately: bool = False
    """Whether machine code calls the phase's functions instead of inlining them at each use.

    With calls, the code compiles in half of the time and runs a sixth slower than with inlining.
    """
    state_units: Vector | None = None
    """Units of the coordinates `q` and of their rates `v` for the absolute tolerance.

    The default is SI units.
    """
    take_solver_step: SolverStepFunction | None = None
    """Solver step of the phase; by default, a step of the tableau."""
    take_last_step: Callable[[StageState, Array], list[StageState]] | None = None
    """Function that returns the stages of the same solver step, for the search for events. Its code
    may be shorter and slower, and it has no error that depends on tangents."""
    has_exact_events: bool = False
    """Whether an event is located to round-off, and not to the tolerances."""
    max_event_correction: Array | None = None
    """Largest last correction of an exact event's time, as a fraction of the solver step.

    The state is extrapolated linearly over the correction, with an error of its square. By default,
    that error is round-off.
    """
    guards_rising_at_start: Array | None = None
    """Whether each guard rises from its round-off at the start of the phase.

    Such a guard has no minimum in the first solver step. If it grows as the cube of the time, the
    errors of inner stages are as large as its values. By default, such guards start at zero.
    """
    guard_scales: Array | None = None
    """Magnitudes of the guards' terms if events are exact, see `phase_integration`."""
    evaluate_armed_guards: Callable[[StageState], tuple[Array, Array]] | None = None
    """Function for guards with `armed`, the maximum of two functions: value and minus `armed`.

    It returns these functions of all guards, and for each of them the other one.
    """
    guards_met_at_start: Array | None = None
    """Whether each guard ends the phase at its start; by default, its value and rate decide."""
    evaluate_kinks: Callable[[StageState], Vector] | None = None
    """Function that returns the values of functions at whose zeros the equations have kinks."""
    on_sides: Callable[[Vector], "BatchPhase"] = lambda sides: NotImplemented
    """Function that returns the phase with equations that are smooth, for the signs of the values
    of `evaluate_kinks`. Each kink adds a guard, which triggers where its sign changes.
    """
    sides: Vector = ()
    """Signs for which the equations are smooth; empty without kinks."""
    n_logged_kinks: int = 0
    """Largest number of kinks that the end of the phase lists, see `tangents.KinkLog`."""

    def make_state(self, q: Any, v: Any) -> StageState:
        """Return the state with positions `q`, rates `v` and the accelerations there."""
        return StageState(q, v, self.evaluate_acceleration(q, v))

    def wrap_functions(self, wrap: Callable) -> "BatchPhase":
        """Return the phase in which `wrap` has been applied to each function."""
        return self._replace(
            evaluate_acceleration=wrap(self.evaluate_acceleration),
            evaluate_guards=wrap(self.evaluate_guards),
            evaluate_margins=wrap(self.evaluate_margins),
            on_sides=lambda sides: self.on_sides(sides).wrap_functions(wrap),
        )

    def evaluate_with_rates(
        self, evaluate_functions: Callable[[StageState], Any], state: StageState
    ) -> tuple[Any, Any]:
        """Return the values of `evaluate_functions` at a state, and their time derivatives."""
        return jax.jvp(
            lambda q, v: evaluate_functions(self.make_state(q, v)),
            (state.q, state.v),
            (state.v[: len(state.q)], state.acceleration.acceleration[: len(state.v)]),
        )


MakeBatchPhase = Callable[[Any, Vector], BatchPhase]
"""Function that returns the `BatchPhase` for two kinds of constants.

The first argument is a tree of arrays with few tangent directions. The second argument contains the
held constants. These are arrays that are constant during the phase and have arbitrary tangents,
such as the state at its start.
"""


def make_solver_step_function(
    phase: BatchPhase, tableau: ButcherTableau, options: StepOptions
) -> SolverStepFunction:
    """Return a function of state and length that takes one solver step in the phase.

    The function is traced once for all its calls.
    """

    def take_step(state: StageState, h: Array) -> tuple[list[StageState], Array]:
        stage_states = take_rk_step(tableau, phase.evaluate_acceleration, state, h)
        return stage_states, _compute_mean_squared_error(
            tableau, stage_states, h, options, phase.state_units
        )

    return jax.jit(phase.take_solver_step or take_step)


def _compute_mean_squared_error(
    tableau: ButcherTableau,
    stage_states: list[StageState],
    step_length: Array,
    options: StepOptions,
    state_units: Vector | None,
) -> Array:
    """Return the mean square of the error of a solver step, divided by the tolerance.

    The result is infinite for a solver step whose end is not finite. The mean is computed in
    float32, because an error estimate needs no higher precision.

    - `state_units`: units of the coordinates and rates for the absolute tolerance; None for SI
      units.
    """
    start_state, end_state = stage_states[0], stage_states[-1]
    start_state_components = (*start_state.q, *start_state.v)
    convert_to_float32 = lambda x: x.astype(jnp.float32)
    sum_of_squares: Any = 0.0
    component_units: Any = (
        (1.0,) * len(start_state_components) if state_units is None else state_units
    )
    for component_error, start_component, end_component, component_unit in zip(
        estimate_step_error(tableau, stage_states, step_length),
        start_state_components,
        (*end_state.q, *end_state.v),
        component_units,
        strict=True,
    ):
        error_tolerance = options.atol * component_unit + options.rtol * jnp.maximum(
            jnp.abs(start_component), jnp.abs(end_component)
        )
        relative_error = convert_to_float32(component_error) / convert_to_float32(error_tolerance)
        sum_of_squares = sum_of_squares + relative_error * relative_error
    return jnp.where(
        jnp.isfinite(sum_of_squares), sum_of_squares / len(start_state_components), jnp.inf
    )


def sample_batch_phase(
    phase: BatchPhase,
    tableau: ButcherTableau,
    q: Vector,
    v: Vector,
    interval_lengths: Array,
    options: StepOptions,
) -> Array:
    """Return positions and rates at the start of a phase and after each interval of time.

    The result has the shape (samples, 2 coordinates, batch), with the positions before the rates.

    - `interval_lengths`: see `sample_between_intervals`.
    """

    take_solver_step = make_solver_step_function(phase, tableau, options)

    def solver_step_function(state: StageState, step_length: Array) -> tuple[StageState, Array]:
        stage_states, mean_squared_error = take_solver_step(state, step_length)
        return stage_states[-1], mean_squared_error

    pack_sample = lambda phase_state: jnp.stack([*phase_state.q, *phase_state.v])
    return sample_between_intervals(
        solver_step_function,
        pack_sample,
        phase.make_state(q, v),
        tableau,
        interval_lengths,
        options,
    )


def divide_equally(duration: Array, n_samples: int) -> Array:
    """Return the lengths of the intervals between `n_samples` equally spaced times, s."""
    return jnp.broadcast_to(duration / (n_samples - 1), (n_samples - 1, *duration.shape))


def sample_between_intervals(
    solver_step_function: Callable[[Any, Array], tuple[Any, Array]],
    pack_sample: Callable[[Any], Array],
    start_state: Any,
    tableau: ButcherTableau,
    interval_lengths: Array,
    options: StepOptions,
) -> Array:
    """Return samples at the start of a motion and after each interval of time.

    - `solver_step_function`: function of state and step length, s, that returns the state at the
      end of a solver step and the squared ratio of its error to the tolerance;
    - `pack_sample`: function that returns the sample for a state. The first axis of the result
      contains the samples;
    - `interval_lengths`: lengths of the intervals between samples, on the first axis, s.
    """
    initial_count = jnp.zeros((), jnp.int32)

    def take_solver_step_to_sample(loop_carry: tuple) -> tuple:
        sample_state, previous_h, remaining_time_to_sample, n_tried_steps = loop_carry
        h = previous_h
        sampled_step_length = jnp.where(h < remaining_time_to_sample, h, remaining_time_to_sample)
        step_end, mean_squared_error = solver_step_function(sample_state, sampled_step_length)
        step_length_factor = compute_step_size_factor(
            tableau, mean_squared_error, sampled_step_length.dtype
        )
        is_within_tolerance = mean_squared_error <= 1.0
        # A step that was shortened to end at a sample does not reduce the next step's length.
        h = jnp.where(
            is_within_tolerance & (sampled_step_length < h),
            jnp.maximum(h, sampled_step_length * step_length_factor),
            sampled_step_length * step_length_factor,
        )
        is_running = remaining_time_to_sample > 0.0
        return (
            select_trees_by_condition(is_running & is_within_tolerance, step_end, sample_state),
            lax.stop_gradient(jnp.where(is_running, h, previous_h)),
            jnp.where(
                is_running & is_within_tolerance,
                jnp.where(
                    sampled_step_length == remaining_time_to_sample,
                    0.0,
                    remaining_time_to_sample - sampled_step_length,
                ),
                remaining_time_to_sample,
            ),
            n_tried_steps + 1,
        )

    def integrate_to_next_sample(loop_carry: tuple, length: Array) -> tuple[tuple, Array]:
        needs_step = lambda loop_carry: (
            jnp.any(loop_carry[2] > 0.0) & (loop_carry[3] < options.max_solver_steps)
        )
        initial_loop_carry = (*loop_carry, length, initial_count)
        sample_state, h, _, _ = lax.while_loop(
            needs_step, take_solver_step_to_sample, initial_loop_carry
        )
        return (sample_state, h), pack_sample(sample_state)

    initial_loop_carry = start_state, options.dt0 + jnp.zeros_like(interval_lengths[0])
    samples_after_start = lax.scan(integrate_to_next_sample, initial_loop_carry, interval_lengths)[
        1
    ]
    return jnp.concatenate([pack_sample(start_state)[None], samples_after_start])
