"""Compute walks of a batch with unilateral contact, and their tangents in many directions.

Events, contacts and step sizes are determined by the motion and computed once. At each stage of a
Runge-Kutta step and at each event, the quantities common to all tangents are also computed once.
Each tangent then requires only linear operations. The derivatives are those of the discrete flow
with the accepted step sizes, and of the event times: see `integrator.tangents`.
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from vrw_jax.base.elementwise import run_if_any_element_active, select_trees_by_condition
from vrw_jax.flow.event_location import compute_event_time_tangent
from vrw_jax.flow.tableaus import ButcherTableau, compute_real_stability_limit
from vrw_jax.models.contact_integrator import (
    N_ACCUMULATOR_ROWS,
    ContactIntervalState,
    DynamicsFn,
    LaneStatus,
    advance_running_lanes,
    complete_solver_step,
    compute_stage_state,
    evaluate_dynamics,
    evaluate_guards_of_coordinates,
    iterate_until_stopped,
    unpack_motion,
)
from vrw_jax.models.contact_kernel import (
    N_HEIGHT_COLUMNS,
    STATUS_UNFINISHED,
    BatchWalkResult,
    BatchWalkSettings,
    DifferentiableLaneState,
    LaneState,
    init_lane_states,
)
from vrw_jax.models.contact_state import compute_guard_scales
from vrw_jax.wheel.laws import compute_damping_coefficient
from vrw_jax.wheel.outcomes import ContactMode
from vrw_jax.wheel.params import compute_wheel_units


class _IntervalTangent(NamedTuple):
    """Tangent of the state of each batch element during an interval.

    After the first field, the fields are the first fields of `DifferentiableLaneState`.
    """

    dynamics_rows: Array  # tangents of accelerations and, if requested, accumulator rates
    q: Array
    v: Array
    interval_accumulators: Array | None
    time_since_event: Array  # tangent of the time, s


class TangentBatch(NamedTuple):
    """Tangents of the input columns of all batch elements, and functions of all tangents.

    The first axis of an array contains tangents, and the last axis the batch. Arrays of *tangent
    rows* contain the tangents of the dynamics rows and of the `DifferentiableLaneState`.
    """

    n_tangents: Array  # number of tangents of each batch element
    n_column_tangents: Array  # number of leading tangents whose columns may vary
    column_tangents: Array  # tangents of the input columns

    def get_input_tangent(self, k: Array) -> Array:
        """Return the tangent of the input columns with index `k`."""
        return lax.dynamic_index_in_dim(self.column_tangents, k, 0, keepdims=False)

    def allocate_tangent_rows(self, n_rows: int) -> Array:
        """Return an uninitialized array for all tangents, (tangents, n_rows, batch)."""
        return lax.empty(
            (len(self.column_tangents), n_rows, *self.n_tangents.shape), self.column_tangents.dtype
        )

    def map_tangents_sequentially(
        self,
        compute_new_rows: Callable[[Array, Array], Any],
        tangent_rows: Array,
        first_replaced_row: Array | int = 0,
    ) -> Array:
        """Return the tangents after a function has been applied to each, (tangents, rows, batch).

        The results of the function replace the rows from `first_replaced_row` onward.

        - `compute_new_rows`: function that takes the index and the rows of a tangent, and returns a
          tree of new rows.
        """
        should_continue = lambda state: jnp.any(state[0] < self.n_tangents)

        def update_tangent_rows(state: tuple[Array, Array]) -> tuple[Array, Array]:
            k, tangent_rows = state
            new_rows = _pack_tree_into_rows(
                compute_new_rows(k, lax.dynamic_index_in_dim(tangent_rows, k, 0, False))
            )
            # Stacking row by row keeps the rows in registers.
            new_rows = jnp.stack([new_rows[i] for i in range(len(new_rows))])
            start_indices = k, jnp.int32(first_replaced_row), jnp.int32(0)
            return k + 1, lax.dynamic_update_slice(tangent_rows, new_rows[None], start_indices)

        return lax.while_loop(
            should_continue, update_tangent_rows, (jnp.zeros((), jnp.int32), tangent_rows)
        )[1]


def _pack_tree_into_rows(array_tree: Any) -> Array:
    """Return all arrays of a tree, concatenated to one array (rows, batch)."""
    return jnp.concatenate(
        [leaf.reshape(-1, leaf.shape[-1]) for leaf in jax.tree.leaves(array_tree)]
    )


def _unpack_tree_from_rows(tangent_rows: Array, tangent_template: Any, first_row: int = 0) -> Any:
    """Return the rows from `first_row` onward as a tree with the structure of `tangent_template`.

    The function is the inverse of `_pack_tree_into_rows`.
    """
    leaves, tree_structure = jax.tree.flatten(tangent_template)
    arrays, row_offset = [], first_row
    for leaf in leaves:
        n_leaf_rows = math.prod(leaf.shape[:-1])
        leaf_rows = tangent_rows[..., row_offset : row_offset + n_leaf_rows, :]
        arrays.append(leaf_rows.reshape(*tangent_rows.shape[:-2], *leaf.shape))
        row_offset += n_leaf_rows
    return jax.tree.unflatten(tree_structure, arrays)


def _unpack_tangent(
    tangent_rows: Array, k: Array, tangent_template: Any, first_row: int = 0
) -> Any:
    """Return the tangent with index `k` as a tree with the structure of `tangent_template`."""
    return _unpack_tree_from_rows(
        lax.dynamic_index_in_dim(tangent_rows, k, 0, False), tangent_template, first_row
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
    count_rows = lambda array_tree: len(_pack_tree_into_rows(array_tree))

    def begin_walk(
        input_columns: Array, section_state: Array
    ) -> tuple[DifferentiableLaneState, tuple[Array, LaneState]]:
        input_columns, lane_state = init_lane_states(walk_settings, input_columns, section_state)
        return lane_state.get_differentiable_state(), (input_columns, lane_state)

    tangent_template, pushforward, (input_columns, lane_state) = jax.linearize(
        begin_walk, input_columns, section_state, has_aux=True
    )
    n_dynamics_rows = len(tangent_template.q) + N_ACCUMULATOR_ROWS * walk_settings.is_detailed
    zero_dynamics_rows = jnp.zeros((n_dynamics_rows, *n_tangents.shape), section_state.dtype)
    interval_template = _IntervalTangent(zero_dynamics_rows, *tangent_template[:4])
    n_column_tangents = jnp.zeros_like(n_tangents)
    for k in range(len(input_column_tangents)):
        n_column_tangents = jnp.where(
            jnp.any(input_column_tangents[k] != 0.0, axis=0), k + 1, n_column_tangents
        )
    tangents = TangentBatch(n_tangents, n_column_tangents, input_column_tangents)
    push_start_tangent = lambda k, _: (
        zero_dynamics_rows,
        pushforward(
            tangents.get_input_tangent(k),
            lax.dynamic_index_in_dim(section_state_tangents, k, 0, keepdims=False),
        ),
    )
    n_rows = n_dynamics_rows + count_rows(tangent_template)
    tangent_rows = tangents.map_tangents_sequentially(
        push_start_tangent, tangents.allocate_tangent_rows(n_rows)
    )

    def process_and_integrate(state: tuple[LaneState, Array]) -> tuple[LaneState, Array]:
        lane_state, tangent_rows = state

        def process_events_from(
            input_columns: Array, differentiable: DifferentiableLaneState
        ) -> tuple[DifferentiableLaneState, LaneState]:
            next_state = walk_settings.process_events(
                input_columns, lane_state.replace_differentiable_state(differentiable)
            )
            return next_state.get_differentiable_state(), next_state

        _, pushforward, next_state = jax.linearize(
            process_events_from, input_columns, lane_state.get_differentiable_state(), has_aux=True
        )

        push_event_tangent = lambda k, tangent_row: pushforward(
            tangents.get_input_tangent(k),
            _unpack_tree_from_rows(tangent_row, tangent_template, n_dynamics_rows),
        )
        tangent_rows = tangents.map_tangents_sequentially(
            push_event_tangent, tangent_rows, n_dynamics_rows
        )
        interval_state, tangent_rows = _integrate_with_tangents(
            walk_settings, input_columns, next_state, tangents, tangent_rows, interval_template
        )
        return next_state._replace(contact_interval_state=interval_state), tangent_rows

    should_continue = lambda state: jnp.any(state[0].walk_outcome == STATUS_UNFINISHED)
    lane_state, tangent_rows = lax.while_loop(
        should_continue, process_and_integrate, (lane_state, tangent_rows)
    )

    def partition_step_result(
        differentiable: DifferentiableLaneState, input_columns: Array
    ) -> tuple[Any, Any]:
        return eqx.partition(
            walk_settings.compute_step_result(
                lane_state.replace_differentiable_state(differentiable), input_columns
            ),
            eqx.is_inexact_array,
        )

    float_leaves, pushforward, nonfloat_leaves = jax.linearize(
        partition_step_result,
        lane_state.get_differentiable_state(),
        input_columns,
        has_aux=True,
    )
    push_result_tangent = lambda k, _: pushforward(
        _unpack_tangent(tangent_rows, k, tangent_template, n_dynamics_rows),
        tangents.get_input_tangent(k),
    )
    result_tangents = tangents.map_tangents_sequentially(
        push_result_tangent, tangents.allocate_tangent_rows(count_rows(float_leaves))
    )
    walk_result = BatchWalkResult(
        eqx.combine(float_leaves, nonfloat_leaves),
        lane_state.walk_outcome,
        lane_state.n_stepped,
        lane_state.step_counters.n_solver_steps,
    )
    return walk_result, _unpack_tree_from_rows(result_tangents, float_leaves)


def _integrate_with_tangents(
    walk_settings: BatchWalkSettings,
    input_columns: Array,
    lane_state: LaneState,
    tangents: TangentBatch,
    start_tangent_rows: Array,
    tangent_template: _IntervalTangent,
) -> tuple[ContactIntervalState, Array]:
    """Return the result of `integrate_contact_interval`, and the tangents of its end state.

    The tangents have the shape (tangents, rows, batch).
    """
    initial_state, tableau = lane_state.contact_interval_state, walk_settings.tableau
    assert tableau is not None  # diffrax differentiates in another way.
    make_contact_dynamics = lambda columns: walk_settings.make_lane_contact_dynamics(
        columns, initial_state.contact_state
    )
    contact_mode_dynamics = make_contact_dynamics(input_columns)
    guard_scales = compute_guard_scales(contact_mode_dynamics)
    last_stage = len(tableau.stage_nodes) - 1
    options = compute_wheel_units(contact_mode_dynamics.s).scale_times_to_seconds(
        walk_settings.step_options
    )
    # The damper stops a leg swinging in the air within a time of order m / c. The tangents of such
    # a leg must not grow, but step-size control is based on the motion alone, in which the leg may
    # be nearly at rest.
    stability_safety_factor = 0.85
    has_swing_leg = jnp.any(
        ~initial_state.contact_state.is_leg_locked
        & (initial_state.contact_state.contact_modes == ContactMode.OFF),
        axis=0,
    )
    stable_step_factor = stability_safety_factor * compute_real_stability_limit(tableau)
    s = contact_mode_dynamics.s
    limit_step_size = lambda damping: jnp.where(
        has_swing_leg, stable_step_factor * s.m / damping, jnp.inf
    )
    stable_step_size = limit_step_size(s.c)

    def try_solver_step(
        state: tuple[ContactIntervalState, Array],
    ) -> tuple[ContactIntervalState, Array]:
        contact_interval_state, tangent_rows = state
        max_step_size = stable_step_size
        if s.leg_force is not None:
            motion = unpack_motion(contact_interval_state.contact_interval_point)
            damping = jnp.max(compute_damping_coefficient(s, motion.L, motion.dL), axis=0)
            max_step_size = limit_step_size(jnp.maximum(damping, 0.0))
        h = jnp.where(
            contact_interval_state.event_bracket.is_event_search_active,
            contact_interval_state.h,
            jnp.minimum(contact_interval_state.h, max_step_size),
        )
        contact_interval_state = contact_interval_state._replace(h=h)
        stage_rows, stage_row_tangents = _evaluate_solver_stages(
            make_contact_dynamics,
            input_columns,
            contact_interval_state,
            tangents,
            tangent_rows,
            tangent_template,
            tableau,
        )
        attempted_step = complete_solver_step(
            contact_mode_dynamics, tableau, options, contact_interval_state, stage_rows
        )
        next_interval = advance_running_lanes(
            contact_interval_state, attempted_step, guard_scales, tableau, options
        )
        is_state_updated = next_interval.time_since_event != contact_interval_state.time_since_event
        n = len(contact_interval_state.contact_interval_point.q)

        def propagate_to_end(k: Array, tangent_row: Array) -> _IntervalTangent:
            start_tangent = _unpack_tree_from_rows(tangent_row, tangent_template)
            stage_tangents = lax.dynamic_index_in_dim(stage_row_tangents, k, 0, False).reshape(
                -1, *tangent_template.dynamics_rows.shape
            )
            q, v = compute_stage_state(
                tableau,
                last_stage,
                start_tangent.q,
                start_tangent.v,
                stage_tangents[:, :n],
                contact_interval_state.h,
            )
            interval_accumulators = start_tangent.interval_accumulators
            if interval_accumulators is not None:
                weights = tableau.stage_matrix[last_stage]
                interval_accumulators = interval_accumulators + contact_interval_state.h * sum(
                    weights[j] * stage_tangents[j, n:] for j in range(last_stage)
                )
            end_tangent = _IntervalTangent(
                stage_tangents[last_stage],
                q,
                v,
                interval_accumulators,
                start_tangent.time_since_event,
            )
            return select_trees_by_condition(
                is_state_updated,
                end_tangent,
                start_tangent._replace(dynamics_rows=stage_tangents[0]),
            )

        return next_interval, tangents.map_tangents_sequentially(propagate_to_end, tangent_rows)

    is_running = lambda state: state[0].lane_status == LaneStatus.RUNNING
    contact_interval_state, tangent_rows = iterate_until_stopped(
        is_running,
        lane_state.walk_outcome == STATUS_UNFINISHED,
        try_solver_step,
        (initial_state, start_tangent_rows),
    )
    return contact_interval_state, tangents.map_tangents_sequentially(
        _make_event_shift(
            make_contact_dynamics,
            input_columns,
            initial_state,
            contact_interval_state,
            tangents,
            tangent_template,
        ),
        tangent_rows,
    )


def _evaluate_solver_stages(
    make_contact_dynamics: DynamicsFn,
    input_columns: Array,
    contact_interval_state: ContactIntervalState,
    tangents: TangentBatch,
    tangent_rows: Array,
    tangent_template: _IntervalTangent,
    tableau: ButcherTableau,
) -> tuple[Array, Array]:
    """Return the dynamics rows at all stages of a solver step, and the tangents of these rows.

    The dynamics rows are accelerations, contact quantities and, if requested, accumulator rates.
    The tangents are computed one after another.
    """
    contact_interval_point = contact_interval_state.contact_interval_point
    h = contact_interval_state.h
    n_dynamics_rows, last_stage = len(tangent_template.dynamics_rows), len(tableau.stage_nodes) - 1
    is_at_interval_start = (contact_interval_state.lane_status == LaneStatus.RUNNING) & (
        contact_interval_state.time_since_event == 0.0
    )

    def evaluate_stage_with_tangents(
        state: tuple[Array, Array, Array],
    ) -> tuple[Array, Array, Array]:
        i, stage_rows, stage_row_tangents = state

        stage_coordinates = compute_stage_state(
            tableau, i, contact_interval_point.q, contact_interval_point.v, stage_rows, h
        )

        def evaluate_dynamics_rows(input_columns: Array, q: Array, v: Array) -> tuple[Array, Array]:
            rows = evaluate_dynamics(make_contact_dynamics(input_columns), q, v)
            n_accumulator_rows = n_dynamics_rows - len(q)
            differentiated_rows = rows[: len(q)], rows[len(rows) - n_accumulator_rows :]
            return jnp.concatenate(differentiated_rows), rows

        _, pushforward, stage_row = jax.linearize(
            evaluate_dynamics_rows, input_columns, *stage_coordinates, has_aux=True
        )
        # A second linearization removes the terms of the inputs, which most tangents keep constant.
        zero_input_tangent = jnp.zeros_like(input_columns)
        _, push_coordinates = jax.linearize(
            lambda q, v: pushforward(zero_input_tangent, q, v), *stage_coordinates
        )

        def propagate_tangent(k: Array, previous_stage_rows: Array) -> Array:
            tangent = _unpack_tangent(tangent_rows, k, tangent_template)
            previous_rows = previous_stage_rows.reshape(-1, *tangent_template.dynamics_rows.shape)
            coordinate_tangents = _propagate_stage_coordinates(
                tableau, i, tangent, previous_rows, h
            )
            input_tangent = tangents.get_input_tangent(k)
            has_input_tangent = jnp.any(k < tangents.n_column_tangents)
            row_tangent = run_if_any_element_active(
                ~has_input_tangent,
                lambda _: push_coordinates(*coordinate_tangents),
                tangent.dynamics_rows,
            )
            row_tangent = run_if_any_element_active(
                has_input_tangent,
                lambda _: pushforward(input_tangent, *coordinate_tangents),
                row_tangent,
            )
            return jnp.where(
                (i > 0) | is_at_interval_start, row_tangent, previous_stage_rows[:n_dynamics_rows]
            )

        stage_row = jnp.where(i > 0, stage_row, contact_interval_point.dynamics_rows)
        stage_rows = lax.dynamic_update_index_in_dim(stage_rows, stage_row, i, 0)
        return (
            i + 1,
            stage_rows,
            tangents.map_tangents_sequentially(
                propagate_tangent, stage_row_tangents, i * n_dynamics_rows
            ),
        )

    later_stage_rows = jnp.zeros((last_stage, *contact_interval_point.dynamics_rows.shape), h.dtype)
    stage_rows = jnp.concatenate([contact_interval_point.dynamics_rows[None], later_stage_rows])
    stage_row_tangents = tangents.map_tangents_sequentially(
        lambda k, _: _unpack_tangent(tangent_rows, k, tangent_template).dynamics_rows,
        tangents.allocate_tangent_rows((last_stage + 1) * n_dynamics_rows),
    )
    # The first stage is the last stage of the previous step, except after an event.
    first_stage = jnp.where(jnp.any(is_at_interval_start), 0, 1).astype(jnp.int32)
    should_continue = lambda state: state[0] <= last_stage
    return lax.while_loop(
        should_continue, evaluate_stage_with_tangents, (first_stage, stage_rows, stage_row_tangents)
    )[1:]


def _propagate_stage_coordinates(
    tableau: ButcherTableau,
    i: Array,
    tangent: _IntervalTangent,
    stage_row_tangents: Array,
    h: Array,
) -> tuple[Array, Array]:
    """Return the tangents of `compute_stage_state`, from the tangents at the earlier stages."""
    flat_matrices = [
        jnp.asarray(stage_matrix.ravel())
        for stage_matrix in (tableau.stage_matrix, tableau.squared_stage_matrix)
    ]
    n_stages, stage_node = len(tableau.stage_matrix[0]), jnp.asarray(tableau.stage_nodes)[i]

    def add_stage_increment(state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        j, rate_increment, coordinate_increment = state
        a, b = (
            lax.dynamic_index_in_dim(flat_matrix, i * n_stages + j, 0, False)
            for flat_matrix in flat_matrices
        )
        row_tangent = lax.dynamic_index_in_dim(stage_row_tangents, j, 0, False)[: len(tangent.q)]
        return j + 1, rate_increment + a * row_tangent, coordinate_increment + b * row_tangent

    q, v = tangent.q, tangent.v
    initial_state = jnp.zeros((), jnp.int32), jnp.zeros_like(q), jnp.zeros_like(q)
    _, rate_increment, coordinate_increment = lax.while_loop(
        lambda state: state[0] < i, add_stage_increment, initial_state
    )
    return q + h * (stage_node * v + h * coordinate_increment), v + h * rate_increment


def _make_event_shift(
    make_contact_dynamics: DynamicsFn,
    input_columns: Array,
    initial_state: ContactIntervalState,
    contact_interval_state: ContactIntervalState,
    tangents: TangentBatch,
    tangent_template: _IntervalTangent,
) -> Callable[[Array, Array], _IntervalTangent]:
    """Return a function that adds the effect of the event time's tangent to a state's tangent.

    The time of a force extremum is constant for tangents, because the force is stationary there.
    """
    end_q, end_v, end_rows = contact_interval_state.contact_interval_point
    end_accelerations = end_rows[: len(end_q)]

    def compute_guards(input_columns: Array, q: Array, v: Array) -> Array:
        contact_mode_dynamics = make_contact_dynamics(input_columns)
        contact_state = contact_mode_dynamics.contact_state._replace(force_rate_signs=None)
        contact_mode_dynamics = contact_mode_dynamics._replace(contact_state=contact_state)
        return evaluate_guards_of_coordinates(contact_mode_dynamics, q, v)

    _, guard_pushforward = jax.linearize(compute_guards, input_columns, end_q, end_v)
    guard_rates = guard_pushforward(jnp.zeros_like(input_columns), end_v, end_accelerations)
    has_reached_event = (initial_state.lane_status == LaneStatus.RUNNING) & (
        contact_interval_state.lane_status == LaneStatus.EVENT
    )

    def shift_tangent_to_event(k: Array, tangent_row: Array) -> _IntervalTangent:
        tangent = _unpack_tree_from_rows(tangent_row, tangent_template)
        time_tangent = compute_event_time_tangent(
            has_reached_event,
            contact_interval_state.triggered_guard_index,
            guard_rates,
            guard_pushforward(tangents.get_input_tangent(k), tangent.q, tangent.v),
        )
        interval_accumulators = tangent.interval_accumulators
        if interval_accumulators is not None:
            interval_accumulators = (
                interval_accumulators + time_tangent * end_rows[-N_ACCUMULATOR_ROWS:]
            )
        return tangent._replace(
            q=tangent.q + time_tangent * end_v,
            v=tangent.v + time_tangent * end_accelerations,
            interval_accumulators=interval_accumulators,
            time_since_event=time_tangent,
        )

    return shift_tangent_to_event
