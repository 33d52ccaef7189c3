"""Walks of batches with unilateral contact, and steps with their Jacobians, by machine code."""

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from vrw_jax.base import batch_sizes
from vrw_jax.base.options import StepOptions
from vrw_jax.flow.solver_steps import load_explicit_tableau
from vrw_jax.lanes.lane_function import CompiledBatchFunction, compile_batch_function
from vrw_jax.models.contact_impacts import project_motion
from vrw_jax.models.contact_kernel import BatchWalkSettings, run_walks
from vrw_jax.models.contact_mechanics import pack_motion
from vrw_jax.models.contact_record import UnilateralStep
from vrw_jax.models.contact_section import (
    LOCKED_CODE_OFFSET,
    compute_section_units,
    embed_section_state,
    unpack_section_state,
)
from vrw_jax.models.contact_tangents import walk_with_tangents
from vrw_jax.models.unilateral_wheel import UnilateralWheel
from vrw_jax.models.walk_batch import (
    StepBatchResult,
    StepInput,
    WalkBatch,
    make_step_input,
)
from vrw_jax.wheel.outcomes import ContactMode
from vrw_jax.wheel.params import (
    FRICTION_NAME,
    PARAMETER_NAMES,
    Symbols,
    compute_symbols,
    compute_wheel_units_of_rows,
)


def step_batch_with_contact(
    model: Any,
    inputs: list[StepInput],
    next_line: list[StepInput],
    section_states: np.ndarray,
    n_steps: int,
    options: StepOptions,
    requested_engine: str,
    n_legs: int,
    derivative_names: Sequence[str],
) -> StepBatchResult:
    """Return the result of `step_batch` for a model with unilateral contact.

    Without derivatives on flat ground, one call of the kernel computes all gait steps. On uneven
    ground, further inputs are the friction of the feet that landed earlier, and the increase of the
    slope to the next line of the ground, rad, or two rises (see `models.select_stance_line`), m.

    - `next_line`: slope of the next line, or two rises; empty if all lines have one slope.
    """
    if requested_engine not in ("auto", "lanes") or load_explicit_tableau(options.solver) is None:
        raise ValueError(
            f"engine is {requested_engine!r} and solver {options.solver}, but batches with contact "
            "need 'lanes' and an explicit Runge-Kutta solver: map vrw.walk over the wheels."
        )
    if np.ndim(model.restitution):
        raise ValueError(
            f"restitution has shape {np.shape(model.restitution)}, but a batch needs one number "
            "for all elements: call vrw.step_batch for each restitution."
        )
    first_values = np.stack([x.select_values(0) for x in inputs])
    section_states = embed_section_states(first_values, section_states, n_legs)
    friction = np.asarray(model.friction, section_states.dtype)
    is_ground_uneven = bool(next_line) or friction.ndim == 2
    if not (derivative_names or is_ground_uneven or model.leg_period > 1):
        x, durations, outcome, n_stepped, solver_steps, _ = map(
            np.asarray, walk_batch(first_values, section_states, n_steps, model, options, n_legs)
        )
        solver_index = np.zeros_like(n_stepped)
        return StepBatchResult(
            x, durations, outcome, n_stepped, solver_steps, solver_index, "lanes", (options.solver,)
        )
    if is_ground_uneven:
        slope = inputs[PARAMETER_NAMES.index("slope")]
        if len(next_line) == 1:
            next_slope = next_line[0]
            tilt = next_slope._replace(
                values=next_slope.values - slope.values,
                list_terms=lambda k: [(k, -1.0), *next_slope.list_terms(k)],
            )
            next_line = [tilt]
        inputs = [
            *inputs,
            make_step_input(FRICTION_NAME, friction, n_steps, len(section_states), -1),
            *(next_line or [StepInput("", np.zeros_like(slope.values))]),
        ]
    batch = WalkBatch(section_states.T.copy(), inputs, derivative_names)
    input_indices = list(batch.input_indices)

    def step_lanes(_: Any, inputs: np.ndarray, x: np.ndarray, k: int) -> tuple[np.ndarray, ...]:
        if not derivative_names:
            x, durations, outcome, _, solver_steps, _ = walk_batch(
                inputs, x.T, 1, model, options, n_legs
            )
            outputs: tuple[Any, ...] = x, durations, outcome, solver_steps
        else:
            step, jacobian = step_batch_with_jacobian(
                inputs, x.T, model, options, n_legs, input_indices
            )
            columns = np.concatenate([jacobian.section_state, jacobian.durations], 1)
            outputs = step.section_state, step.durations, step.outcome, step.solver_steps
            outputs += (columns[:, :, input_indices],)
        return tuple(np.asarray(x).T for x in outputs)

    batch.take_steps(n_steps, step_lanes, model)
    return batch.make_batch_result("lanes", (options.solver,))


def walk_batch(
    input_columns: np.ndarray,
    section_states: np.ndarray,
    n_steps: int,
    model: UnilateralWheel,
    options: StepOptions,
    n_legs: int,
) -> tuple[np.ndarray, ...]:
    """Return the results of walks of `n_steps` steps for a batch of wheels with `n_legs` legs.

    The result is (section states, durations in the last step, s, outcomes, numbers of completed
    walking steps, numbers of solver steps, lengths of the last step, m). The first axis of each
    array contains the wheels.

    - `input_columns`: parameters of wheels and laws, and friction, shape (inputs, wheels). On
      uneven ground, the walk has one step, and more columns follow: see `N_HEIGHT_COLUMNS`;
    - `section_states`: full section states, shape (wheels, 4 + 3 n).
    """
    (section_state, durations, step_length), *outcome_and_counts = _run_walk(
        model, options, n_legs, n_steps, input_columns, section_states.T
    )
    return section_state, durations, *outcome_and_counts, step_length


def step_batch_with_jacobian(
    input_columns: np.ndarray,
    section_states: np.ndarray,
    model: UnilateralWheel,
    options: StepOptions,
    n_legs: int,
    input_indices: Sequence[int] | None = None,
) -> tuple[UnilateralStep, UnilateralStep]:
    """Return the results of one walking step for a batch of wheels, and their Jacobian.

    The arguments are those of `walk_batch`. The first axis of each array contains the wheels. The
    last axis of the Jacobian contains the input columns, followed by the entries of the section
    state.

    Derivatives are zero with respect to inputs outside `input_indices` and with respect to inputs
    that cannot vary. These are contact codes, and lengths of legs on their stoppers or with loaded
    feet. Tangents are computed only for independent rates (see `_IndependentStartRates`).
    """
    contact_codes = np.round(section_states[:, 4 + 2 * n_legs :]).astype(int)
    step_inputs = np.concatenate([input_columns.T, section_states], 1)
    is_tangent_needed = np.ones(step_inputs.shape, bool)
    is_off_stopper = contact_codes < LOCKED_CODE_OFFSET
    is_entry_variable = [
        is_off_stopper & ((contact_codes & (LOCKED_CODE_OFFSET - 1)) == ContactMode.OFF),
        is_off_stopper,
        np.zeros(contact_codes.shape, bool),
    ]
    is_tangent_needed[:, len(input_columns) + 4 :] = np.concatenate(is_entry_variable, 1)
    if input_indices is not None:
        is_tangent_needed &= np.isin(np.arange(step_inputs.shape[1]), input_indices)
    rate_indices = len(input_columns) + np.array([1, 2, 3, *range(4 + n_legs, 4 + 2 * n_legs)])
    section_units = compute_section_units(
        compute_wheel_units_of_rows(input_columns.T, n_legs), n_legs
    )
    rate_units = np.stack(section_units, -1)[:, rate_indices - len(input_columns)]
    projected_units = rate_units[:, [1, 2, 0, *range(3, 3 + n_legs)]]  # as in `pack_motion`
    rate_projection = _project_start_rates(input_columns, section_states, n_legs) * (
        rate_units[:, None] / projected_units[:, :, None]
    )
    independent_rates = _IndependentStartRates.from_rate_projection(
        rate_projection, is_tangent_needed[:, rate_indices], rate_units
    )
    is_tangent_needed[:, rate_indices] = independent_rates.is_independent
    wheel_index, input_index = np.nonzero(is_tangent_needed)
    lane_index, tangent_index_in_wheel, lane_wheels = _pack_tangents(is_tangent_needed.sum(1))
    tangent_input_indices = np.full((MAX_TANGENTS_PER_LANE, len(lane_wheels)), -1.0)
    tangent_input_indices[tangent_index_in_wheel, lane_index] = input_index
    walk_result, tangents = _run_walk(
        model,
        options.with_derivative_tolerances(),
        n_legs,
        1,
        input_columns[:, lane_wheels],
        section_states[lane_wheels].T,
        tangent_input_indices,
    )
    first_lane_of_wheel = np.searchsorted(lane_wheels, np.arange(len(section_states)))

    def gather_tangents(leaf: np.ndarray) -> np.ndarray:
        jacobian_rows = np.zeros((*step_inputs.shape, *leaf.shape[2:]), leaf.dtype)
        jacobian_rows[wheel_index, input_index] = leaf[lane_index, tangent_index_in_wheel]
        jacobian_rows[:, rate_indices] = independent_rates.expand_tangents_to_all_rates(
            jacobian_rows[:, rate_indices]
        )
        return np.moveaxis(jacobian_rows, 1, -1)

    return jax.tree.map(
        lambda leaf: leaf[first_lane_of_wheel], walk_result.step_result
    ), jax.tree.map(gather_tangents, tangents)


MAX_TANGENTS_PER_LANE = 16
"""Largest number of tangents in one batch element of the kernel.

Further tangents of the same wheel are computed in additional batch elements.
"""


def _pack_tangents(n_tangents_by_wheel: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the batch element of each tangent, its position there, and the elements' wheels.

    The tangents are ordered by wheel.
    """
    n_lanes_by_wheel = np.maximum(-(-n_tangents_by_wheel // MAX_TANGENTS_PER_LANE), 1)
    first_lane_of_wheel = np.cumsum(n_lanes_by_wheel) - n_lanes_by_wheel
    tangent_index_in_wheel = np.concatenate(
        [np.arange(n_tangents) for n_tangents in n_tangents_by_wheel]
    )
    lane_index = (
        np.repeat(first_lane_of_wheel, n_tangents_by_wheel)
        + tangent_index_in_wheel // MAX_TANGENTS_PER_LANE
    )
    return (
        lane_index,
        tangent_index_in_wheel % MAX_TANGENTS_PER_LANE,
        np.repeat(np.arange(len(n_tangents_by_wheel)), n_lanes_by_wheel),
    )


RATE_RANK_TOLERANCE = 1e-10
"""Largest remainder of a dependent rate, as a fraction of the largest remainder of all rates.

The value is chosen because an independent rate has a remainder of order one, like the projection.
"""


class _IndependentStartRates(NamedTuple):
    """Independent rates in section states, and weights that express all rates in terms of them.

    A loaded foot constrains the wheel. A resting foot leaves two of the four rates of hub and leg
    independent.
    """

    independent_rate_indices: np.ndarray  # index of each independent rate, (wheels, independent)
    is_independent: np.ndarray  # whether each rate is an independent rate, (wheels, rates)
    # weights of the independent rates in all rates, (wheels, independent, rates)
    combination_weights: np.ndarray

    @classmethod
    def from_rate_projection(
        cls, rate_projection: np.ndarray, is_requested: np.ndarray, rate_units: np.ndarray
    ) -> "_IndependentStartRates":
        """Return the independent rates for the projection of all rates at the start of a step.

        The axes of `rate_projection` are (wheels, projected rates, rates). Among the rates for
        which `is_requested` is True, the one with the largest remainder is selected repeatedly.
        The remainder is the part of a projection that is orthogonal to the selected ones. The
        projection is dimensionless, and the weights are those of rates in SI units. `rate_units`
        contains the unit of each rate, (wheels, rates).
        """
        requested_projection = np.nan_to_num(rate_projection) * is_requested[:, None]
        projection_remainder = requested_projection
        n_wheels, n_projected_rates, _ = rate_projection.shape
        n_selected = int(is_requested.sum(1).max(initial=0))
        rate_indices = np.zeros((n_wheels, n_selected), int)
        is_rate_used = np.zeros((n_wheels, n_selected), bool)
        is_independent = np.zeros(is_requested.shape, bool)
        directions = np.zeros((n_wheels, n_selected, n_projected_rates))
        smallest_norm = RATE_RANK_TOLERANCE * np.linalg.norm(requested_projection, axis=1).max(-1)
        for i in range(n_selected):
            remainder_norms = np.linalg.norm(projection_remainder, axis=1)
            rate_indices[:, i] = remainder_norms.argmax(-1)
            is_rate_used[:, i] = remainder_norms.max(-1) > smallest_norm
            is_independent[np.arange(n_wheels), rate_indices[:, i]] |= is_rate_used[:, i]
            selected_remainder = np.take_along_axis(
                projection_remainder, rate_indices[:, i, None, None], 2
            )[:, :, 0]
            selected_norm = np.where(is_rate_used[:, i], remainder_norms.max(-1), np.inf)
            directions[:, i] = selected_remainder / selected_norm[:, None]
            direction = directions[:, i, :, None]
            projection_remainder = projection_remainder - direction * np.sum(
                direction * projection_remainder, 1, keepdims=True
            )
        components = directions @ requested_projection
        # Each direction is the remainder of one rate, so the matrix is triangular.
        triangular_matrix = np.triu(np.take_along_axis(components, rate_indices[:, None], 2))
        triangular_matrix += np.eye(n_selected) * ~is_rate_used[:, None]
        weights = np.linalg.solve(triangular_matrix, components)
        independent_rate_units = np.take_along_axis(rate_units, rate_indices, 1)
        weights = weights * independent_rate_units[:, :, None] / rate_units[:, None]
        return cls(rate_indices, is_independent, weights)

    def expand_tangents_to_all_rates(self, tangents: np.ndarray) -> np.ndarray:
        """Return the tangents with respect to all rates, (wheels, rates, ...).

        `tangents` contains the tangents with respect to the independent rates.
        """
        return np.einsum(
            "wir,wi...->wr...",
            self.combination_weights,
            tangents[np.arange(len(tangents))[:, None], self.independent_rate_indices],
        )


def _project_start_rates(
    input_columns: np.ndarray, section_states: np.ndarray, n_legs: int
) -> np.ndarray:
    """Return the matrix that projects the rates of a section state onto the contact constraints.

    The result has the shape (wheels, projected rates, rates).
    """

    repeated_states = np.repeat(section_states, 3 + n_legs, 0)
    start_rates_by_unit = np.tile(np.eye(3 + n_legs), (len(section_states), 1))
    repeated_states[:, 1:4] = start_rates_by_unit[:, :3]
    repeated_states[:, 4 + n_legs : 4 + 2 * n_legs] = start_rates_by_unit[:, 3:]
    repeated_columns = np.repeat(input_columns[: len(PARAMETER_NAMES)], 3 + n_legs, 1)
    compiled_function = _compile_section_function(_compute_projected_rates, n_legs)
    rates = compiled_function.run(repeated_columns, repeated_states.T)
    rates = rates.T.reshape(len(section_states), 3 + n_legs, 3 + n_legs)
    return np.swapaxes(rates, 1, 2)


def _compute_projected_rates(s: Symbols, section_state: Array) -> Array:
    motion, contact_state = unpack_section_state(s, section_state)
    return pack_motion(project_motion(s, motion, *contact_state[:2]))[1]


@functools.cache
def _compile_section_function(
    section_function: Callable[[Symbols, Array], Array], n_legs: int
) -> CompiledBatchFunction:
    """Return a compiled function of parameters and section states, from one of wheel symbols.

    The arrays have the batch on their last axis. One program is compiled for any number of wheels.
    """
    evaluate_lanes = lambda parameters, section_states: section_function(
        compute_symbols(n_legs, *parameters), section_states
    )
    return compile_batch_function(evaluate_lanes, batch_sizes.CONTACT_XLA_BATCH_SIZE)


def _make_static_walk_settings(
    model: UnilateralWheel, options: StepOptions, n_legs: int, has_tangents: bool, n_columns: int
) -> BatchWalkSettings:
    """Return the walk settings without traced options and number of steps, as a hashable key.

    If tangents are requested, the step is detailed.
    """
    return BatchWalkSettings(
        n_legs,
        0,
        model.max_events,
        model.has_one_sided_stoppers,
        model.uses_paper_rule,
        has_tangents,
        eqx.filter(options, eqx.is_array, inverse=True),
        None,
        n_columns - len(model.parameter_names),
        model.restitution is not None,
        law_structure=jax.tree.structure(model.laws),
    )


def _run_walk(
    model: UnilateralWheel,
    options: StepOptions,
    n_legs: int,
    n_steps: int,
    input_columns: np.ndarray,
    section_states: np.ndarray,
    *tangent_input_indices: np.ndarray,
) -> Any:
    """Return the results of all walks, with the batch elements on the first axis.

    In the input arrays, the batch elements are on the last axis.
    """
    settings = _make_static_walk_settings(
        model, options, n_legs, bool(tangent_input_indices), len(input_columns)
    )
    dtype = input_columns.dtype
    # Neighboring lanes run as long as the slowest of them. Lanes are sorted by damping, because
    # high damping limits the step size by stability.
    lane_order = np.argsort(-input_columns[PARAMETER_NAMES.index("damping")], kind="stable")
    if model.restitution is not None:
        restitution_row = np.full_like(input_columns[:1], np.asarray(model.restitution))
        input_columns = np.concatenate([input_columns, restitution_row])
    traced_options = jax.tree.map(lambda x: np.asarray(x, dtype), eqx.filter(options, eqx.is_array))
    input_arrays = input_columns, section_states, *tangent_input_indices
    walk_results = _compile_walks(settings).run(
        np.int32(n_steps), traced_options, *(x[:, lane_order] for x in input_arrays)
    )
    inverse_lane_order = np.argsort(lane_order, kind="stable")
    restore_order = lambda x: np.moveaxis(x, -1, 0)[inverse_lane_order]
    return jax.tree.map(restore_order, walk_results)


def embed_section_states(
    input_columns: np.ndarray, section_states: np.ndarray, n_legs: int
) -> np.ndarray:
    """Return full section states, (wheels, 4 + 3 n), for section states with three entries.

    Full section states are returned unchanged.
    """
    if section_states.shape[1] != 3:
        return section_states
    compiled_function = _compile_section_function(embed_section_state, n_legs)
    return compiled_function.run(input_columns[: len(PARAMETER_NAMES)], section_states.T).T


@functools.cache
def _compile_walks(static_walk_settings: BatchWalkSettings) -> CompiledBatchFunction:
    run_lane_walks = functools.partial(_run_lane_walks, static_walk_settings)
    return compile_batch_function(run_lane_walks, batch_sizes.CONTACT_XLA_BATCH_SIZE)


def _run_lane_walks(
    static_walk_settings: BatchWalkSettings,
    n_steps: Array,
    traced_options: StepOptions,
    input_columns: Array,
    section_state: Array,
    tangent_input_indices: Array | None = None,
) -> Any:
    """Return the results of walks, with the batch on the last axis, and their tangents if
    requested.

    - `n_steps`, `traced_options`: number of steps and options, the same for the batch;
    - `tangent_input_indices`: index of the input of each tangent, or -1.
    """
    options = eqx.combine(traced_options, static_walk_settings.step_options)
    tableau = load_explicit_tableau(options.solver)
    assert tableau is not None  # The caller has checked the solver.
    walk_settings = static_walk_settings._replace(
        n_steps=n_steps, step_options=options, tableau=tableau
    )
    if tangent_input_indices is None:
        return run_walks(walk_settings, input_columns, section_state)
    # Batches have no tangent of restitution, which is the last column.
    n_columns = len(input_columns) - static_walk_settings.has_restitution
    input_index = np.arange(n_columns + len(section_state), dtype=np.int32)
    if static_walk_settings.has_restitution:
        input_index = np.insert(input_index, n_columns, -2)
    unit_tangents = lax.optimization_barrier(
        (tangent_input_indices[:, None] == input_index[:, None]).astype(section_state.dtype)
    )
    return walk_with_tangents(
        walk_settings,
        input_columns,
        section_state,
        unit_tangents[:, : len(input_columns)],
        unit_tangents[:, len(input_columns) :],
        jnp.sum(tangent_input_indices >= 0, axis=0, dtype=jnp.int32),
    )
