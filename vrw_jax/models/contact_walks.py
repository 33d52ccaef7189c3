"""Walks of one wheel and of batches with unilateral contact, and their tangents.

`jax.vmap` maps the compiled functions of one wheel to batch elements. For derivatives, each tangent
then has its own batch element in addition to that of the motion. In contrast,
`step_batch_with_jacobian` computes many tangents of each element.

Events, contacts and step sizes are determined by the motion and computed once. The derivatives are
those of the discrete flow with the accepted step sizes, and of the event times: see
`flow.tangents`.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.flatten_util import ravel_pytree
from jaxtyping import Array

from vrw_jax import lanes
from vrw_jax.base.options import StepOptions
from vrw_jax.flow.integrate import compute_phase_end_jvp
from vrw_jax.flow.solver_steps import BatchPhase
from vrw_jax.lanes.lane_function import CompiledBatchFunction, compile_batch_function
from vrw_jax.models.contact_impacts import project_motion
from vrw_jax.models.contact_integrator import (
    IntervalTangents,
    TangentBatch,
    make_contact_phase,
    pack_tree_into_rows,
    unpack_tree_from_rows,
)
from vrw_jax.models.contact_kernel import (
    N_HEIGHT_COLUMNS,
    BatchWalkResult,
    BatchWalkSettings,
    LaneState,
    init_lane_states,
    make_walk_result,
    run_walks,
)
from vrw_jax.models.contact_mechanics import pack_motion
from vrw_jax.models.contact_record import (
    LOCKED_CODE_OFFSET,
    GaitStepSummary,
    UnilateralStep,
    compute_section_units,
    embed_section_state,
    unpack_section_state,
)
from vrw_jax.models.contact_state import ContactModeDynamics, ContactQuantities
from vrw_jax.models.viscoelastic import load_batch_tableau
from vrw_jax.wheel.params import (
    PARAMETER_NAMES,
    Symbols,
    WheelParams,
    compute_symbols,
    compute_wheel_units_of_rows,
    stack_parameters,
)
from vrw_jax.wheel.transitions import ContactMode

CONTACT_XLA_BATCH_SIZE = 2048
"""Number of steps with unilateral contact that one XLA call computes, on devices without machine
code.
"""


def walk_batch(
    input_columns: np.ndarray,
    section_states: np.ndarray,
    n_steps: int,
    model: Any,
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
    model: Any,
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
    return compile_batch_function(evaluate_lanes, CONTACT_XLA_BATCH_SIZE)


def _make_static_walk_settings(
    model: Any, options: StepOptions, n_legs: int, has_tangents: bool, n_columns: int
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
    model: Any,
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
    return compile_batch_function(run_lane_walks, CONTACT_XLA_BATCH_SIZE)


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
    walk_settings = static_walk_settings._replace(
        n_steps=n_steps, step_options=options, tableau=load_batch_tableau(options)
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


def walk_with_tangents(
    walk_settings: BatchWalkSettings,
    input_columns: Array,
    section_state: Array,
    input_column_tangents: Array,
    section_state_tangents: Array,
    n_tangents: Array,
) -> tuple[BatchWalkResult, Any]:
    """Return the result of `run_walks`, and the tangents of its floating-point arrays.

    - `n_tangents`: number of tangents of each batch element;
    - `input_column_tangents`, `section_state_tangents`: tangents of the inputs. The first axis
      contains the tangents, of which the first `n_tangents` are used.

    The first axis of the resulting tangents also contains the tangents.
    """
    input_columns, push_to_columns = jax.linearize(
        walk_settings.resolve_heights, input_columns, section_state
    )
    if walk_settings.n_ground_columns == N_HEIGHT_COLUMNS:
        input_column_tangents = jnp.stack(
            list(map(push_to_columns, input_column_tangents, section_state_tangents))
        )
    count_rows = lambda array_tree: len(pack_tree_into_rows(array_tree))
    split_floats = lambda tree: eqx.partition(tree, eqx.is_inexact_array)
    split_state = lambda lane_state: split_floats(lane_state._replace(progress=None))

    def begin_walk(input_columns: Array, section_state: Array) -> tuple[LaneState, tuple]:
        input_columns, lane_state = init_lane_states(walk_settings, input_columns, section_state)
        return eqx.filter(lane_state, eqx.is_inexact_array), (input_columns, lane_state)

    template, pushforward, (input_columns, lane_state) = jax.linearize(
        begin_walk, input_columns, section_state, has_aux=True
    )
    n_column_tangents = jnp.zeros_like(n_tangents)
    for k in range(len(input_column_tangents)):
        n_column_tangents = jnp.where(
            jnp.any(input_column_tangents[k] != 0.0, axis=0), k + 1, n_column_tangents
        )
    tangents = TangentBatch(n_tangents, n_column_tangents, input_column_tangents)
    push_start_tangent = lambda k, _: pushforward(
        tangents.get_input_tangent(k),
        lax.dynamic_index_in_dim(section_state_tangents, k, 0, keepdims=False),
    )
    progress = walk_settings.begin_progress(input_columns, lane_state)
    lane_state = lane_state._replace(progress=progress)
    tangent_rows = tangents.map_tangents_sequentially(
        push_start_tangent, tangents.allocate_tangent_rows(count_rows(template))
    )

    def advance(state: tuple[LaneState, Array]) -> tuple[LaneState, Array]:
        lane_state, tangent_rows = state
        floats, others = split_state(lane_state)
        others = others._replace(progress=lane_state.progress)

        def process_events(input_columns: Array, floats: LaneState) -> tuple[LaneState, LaneState]:
            next_state = walk_settings.process_events(input_columns, eqx.combine(floats, others))
            return split_state(next_state)[0], next_state

        _, pushforward, next_state = jax.linearize(
            process_events, input_columns, floats, has_aux=True
        )
        push_event_tangent = lambda k, tangent_row: pushforward(
            tangents.get_input_tangent(k), unpack_tree_from_rows(tangent_row, template)
        )
        tangent_rows = tangents.map_tangents_sequentially(push_event_tangent, tangent_rows)
        return _integrate_with_tangents(
            walk_settings, input_columns, next_state, tangents, tangent_rows
        )

    lane_state, tangent_rows = lax.while_loop(
        lambda state: jnp.any(state[0].is_unfinished), advance, (lane_state, tangent_rows)
    )
    floats, others = split_state(lane_state)
    compute_result = lambda floats, input_columns: split_floats(
        walk_settings.compute_step_result(eqx.combine(floats, others), input_columns)
    )
    float_results, pushforward, other_results = jax.linearize(
        compute_result, floats, input_columns, has_aux=True
    )
    push_result_tangent = lambda k, _: pushforward(
        unpack_tree_from_rows(lax.dynamic_index_in_dim(tangent_rows, k, 0, False), template),
        tangents.get_input_tangent(k),
    )
    result_tangents = tangents.map_tangents_sequentially(
        push_result_tangent, tangents.allocate_tangent_rows(count_rows(float_results))
    )
    walk_result = make_walk_result(eqx.combine(float_results, other_results), lane_state)
    return walk_result, unpack_tree_from_rows(result_tangents, float_results)


def _integrate_with_tangents(
    walk_settings: BatchWalkSettings,
    input_columns: Array,
    lane_state: LaneState,
    tangents: TangentBatch,
    tangent_rows: Array,
) -> tuple[LaneState, Array]:
    """Return the state of all batch elements at their next events, and its tangents."""
    tableau = walk_settings.tableau
    assert tableau is not None  # diffrax differentiates in another way.

    # The time of a force extremum is constant for derivatives.
    contact_state = lane_state.contact_state._replace(force_rate_signs=None)
    constants, push_to_constants, others = jax.linearize(
        lambda columns: eqx.partition(
            walk_settings.make_lane_contact_dynamics(columns, contact_state), eqx.is_inexact_array
        ),
        input_columns,
        has_aux=True,
    )

    def make_phase(constants: Any, rows: Array) -> BatchPhase:
        dynamics: ContactModeDynamics = eqx.combine(constants, others)
        quantities = ContactQuantities.unpack_rows(dynamics, rows)
        dynamics = dynamics._replace(known_solution=quantities.force_solution)
        return make_contact_phase(
            dynamics, tableau, walk_settings.step_options, is_differentiated=True
        )

    n_rows = len(lane_state.q) + len(lane_state.v)
    phase_tangents = IntervalTangents(
        make_phase, constants, push_to_constants, tangents, tangent_rows[:, :n_rows]
    )
    lane_state, phase_end, search_end = walk_settings.integrate(
        input_columns, lane_state, phase_tangents
    )
    assert search_end is not None
    motion_tangents, time_tangents, _ = compute_phase_end_jvp(
        tableau, phase_tangents, phase_end, search_end
    )
    integrator_state = search_end.integrator_state
    end_tangents = jnp.concatenate([motion_tangents, time_tangents[:, None]], 1)

    def select_end_tangent(k: Array, _: Array) -> Array:
        select_tangent = lambda x: lax.dynamic_index_in_dim(x, k, 0, False)
        start_tangent = select_tangent(integrator_state.state_tangents)
        return jnp.where(
            integrator_state.has_guard_crossed,
            select_tangent(end_tangents),
            jnp.concatenate([start_tangent, jnp.zeros_like(start_tangent[:1])]),
        )

    return lane_state, tangents.map_tangents_sequentially(select_end_tangent, tangent_rows)


def prepare_walk(
    is_detailed: bool,
    engine: str,
    measures_force_peaks: bool,
    uses_diffrax: bool,
    wheel: Any,
    params: WheelParams,
    x: Array,
    options: StepOptions,
) -> tuple[BatchWalkSettings, Array, Array]:
    """Return the settings of walks of one step, and input columns and section states.

    - `engine`: name of the engine in the results;
    - `uses_diffrax`: whether diffrax replaces the batch kernel.
    """
    uneven_ground_columns = jax.tree.leaves(wheel.uneven)
    restitution = () if wheel.restitution is None else (wheel.restitution.astype(x.dtype),)
    input_columns = jnp.stack(
        [*stack_parameters(params), wheel.friction, *uneven_ground_columns, *restitution]
    )
    walk_settings = BatchWalkSettings(
        params.n_legs,
        1,
        wheel.max_events,
        wheel.has_one_sided_stoppers,
        wheel.uses_paper_rule,
        is_detailed,
        options,
        None if uses_diffrax else load_batch_tableau(options),
        len(uneven_ground_columns),
        wheel.restitution is not None,
        engine,
        measures_force_peaks,
        jax.tree.structure(params.laws),
    )
    return walk_settings, input_columns, x


WalkPreparation = Callable[..., tuple[BatchWalkSettings, Array, Array]]
"""`prepare_walk` as a function of (wheel, params, x, options)."""


def take_contact_steps(prepare: WalkPreparation, *arguments: Any) -> Any:
    """Return the results of one step of all batch elements, which are on the last axis.

    If details are requested, the results are those in `UnilateralStep`. Otherwise they are section
    state, durations, outcome and number of solver steps.
    """
    return _select_step_results(run_walks(*prepare(*arguments)))


def _select_step_results(walk_result: BatchWalkResult) -> Any:
    step_result = walk_result.step_result
    if not isinstance(step_result, GaitStepSummary):
        return step_result
    return (
        step_result.section_state,
        step_result.durations,
        walk_result.outcome,
        walk_result.n_solver_steps,
    )


def call_with_one_lane(function: Callable) -> Callable:
    """Return a function of one wheel from a function of a batch, without machine code."""

    def call_function(*arguments: Any) -> Any:
        lane_outputs = function(*jax.tree.map(lambda x: jnp.asarray(x)[..., None], arguments))
        return jax.tree.map(lambda x: x[..., 0], lane_outputs)

    return call_function


def make_column_function(
    prepare: WalkPreparation, structure: Any, argnums: tuple[int, ...]
) -> Callable:
    """Return a function of the leaves of (wheel, params, x, options) for Jacobian columns.

    Its results are those of `lanes.compute_jacobian_columns`, with the tolerances for derivatives.
    Each column is the tangent of a batch element of its own.
    """
    divide_results = lambda walk_result: eqx.partition(
        _select_step_results(walk_result), eqx.is_inexact_array
    )

    def compute_walk_tangents(leaves: tuple[Array, ...], tangents: tuple[Array, ...]) -> tuple:
        walk_settings, input_columns, x = prepare(*jax.tree.unflatten(structure, leaves))
        _, input_column_tangents, section_state_tangents = prepare(
            *jax.tree.unflatten(structure, tangents)
        )
        walk_result, result_tangents = walk_with_tangents(
            walk_settings,
            input_columns,
            x,
            input_column_tangents[None],
            section_state_tangents[None],
            n_tangents=jnp.ones_like(input_columns[0], jnp.int32),
        )
        result_tangents = jax.tree.map(lambda leaf: leaf[0], result_tangents)
        float_tangents, _ = divide_results(walk_result._replace(step_result=result_tangents))
        return float_tangents, *divide_results(walk_result)

    compute_compiled_tangents = lanes.jit_batch(compute_walk_tangents)

    def compute_columns(*leaves: Array) -> tuple:
        *settings, options = jax.tree.unflatten(structure, leaves)
        leaves = tuple(jax.tree.leaves((*settings, options.with_derivative_tolerances())))
        selected_entries, unravel = ravel_pytree([leaves[i] for i in argnums])
        unit_vectors = jnp.eye(selected_entries.size, dtype=selected_entries.dtype)
        tangents = [jnp.zeros_like(leaf) for leaf in leaves]
        for i, leaf_tangents in zip(argnums, jax.vmap(unravel)(unit_vectors), strict=True):
            tangents[i] = leaf_tangents
        batch_axes = tuple(0 if i in argnums else None for i in range(len(leaves)))
        columns, *results = jax.vmap(compute_compiled_tangents, (None, batch_axes))(
            leaves, tuple(tangents)
        )
        return columns, *jax.tree.map(lambda x: x[0], results)

    return compute_columns
