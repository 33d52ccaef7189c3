"""Compute walks of a batch with unilateral contact, and their tangents in many directions.

Events, contacts and step sizes are determined by the motion and computed once. At each stage of a
Runge-Kutta step and at each event, the quantities common to all tangents are also computed once.
Each tangent then requires only linear operations. The derivatives are those of the discrete flow
with the accepted step sizes, and of the event times: see `flow.tangents`.
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from vrw_jax.base.elementwise import run_if_any_element_active
from vrw_jax.flow.integrate import compute_phase_end_jvp
from vrw_jax.flow.solver_steps import BatchPhase, ButcherTableau, StageState
from vrw_jax.models.contact_integrator import compute_stage_coordinates, make_contact_phase
from vrw_jax.models.contact_kernel import (
    N_HEIGHT_COLUMNS,
    BatchWalkResult,
    BatchWalkSettings,
    LaneState,
    init_lane_states,
    make_walk_result,
)
from vrw_jax.models.contact_state import ContactModeDynamics, ContactQuantities


class TangentBatch(NamedTuple):
    """Tangents of the input columns of all batch elements, and functions of all tangents.

    The first axis of an array contains tangents, and the last axis the batch. An array of *tangent
    rows* contains the tangents of all floating-point arrays of a `LaneState`.
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


def _unpack_tree_from_rows(tangent_rows: Array, tangent_template: Any) -> Any:
    """Return rows as a tree, which inverts `_pack_tree_into_rows`."""
    leaves, tree_structure = jax.tree.flatten(tangent_template)
    arrays, row_offset = [], 0
    for leaf in leaves:
        n_leaf_rows = math.prod(leaf.shape[:-1])
        leaf_rows = tangent_rows[..., row_offset : row_offset + n_leaf_rows, :]
        arrays.append(leaf_rows.reshape(*tangent_rows.shape[:-2], *leaf.shape))
        row_offset += n_leaf_rows
    return jax.tree.unflatten(tree_structure, arrays)


class IntervalTangents(NamedTuple):
    """Tangents of an interval between two events, with the methods of `flow.PhaseTangents`."""

    make_phase: Callable[[Any, Array], BatchPhase]  # for constants and rows of quantities
    phase_constants: Any  # floating-point arrays of the dynamics
    push_to_constants: Callable[[Array], Any]  # from tangents of columns to those of the constants
    tangents: TangentBatch
    start_tangents: Array  # tangents of coordinates, rates and losses, (tangents, rows, batch)
    held_constants: tuple = ()

    @property
    def zero_constants_tangent(self) -> Any:
        """Return the tangent of constants that do not vary."""
        return jax.tree.map(jnp.zeros_like, self.phase_constants)

    def linearize(
        self, function: Callable[[BatchPhase, StageState], Array], q: Any, v: Any, rows: Array
    ) -> Any:
        """Return the linear map from tangents of (constants, q, v) to those of a function's value.

        - `rows`: rows of `ContactQuantities` at the state, which are not computed again.
        """

        def evaluate(phase_constants: Any, q: Array, v: Array) -> Array:
            phase = self.make_phase(phase_constants, rows)
            return function(phase, phase.make_state(q, v))

        return jax.linearize(evaluate, self.phase_constants, q, v)[1]

    def propagate_to_step_end(
        self,
        tableau: ButcherTableau,
        stage_states: list[StageState],
        start_tangents: Array,
        h: Array,
        is_accepted: Array | bool = True,
    ) -> Array:
        """Return the tangents at the end of a solver step of length `h`, s, if it is accepted."""
        q, v, _ = stage_states[0]
        n, n_rates, tangents = len(q), len(v), self.tangents
        stage_rows = jnp.stack([state.acceleration.acceleration for state in stage_states[:-1]])
        evaluate_rates = lambda _, state: state.acceleration.acceleration[:n_rates]

        def push_stage(loop_state: tuple[Array, Array]) -> tuple[Array, Array]:
            i, rate_tangents = loop_state
            stage = compute_stage_coordinates(tableau, i, q, v, stage_rows, h)
            rows = lax.dynamic_index_in_dim(stage_rows, i, 0, False)
            push = self.linearize(evaluate_rates, *stage, rows)
            # A second linearization removes the terms of inputs, which most tangents keep constant.
            _, push_coordinates = jax.linearize(
                lambda q, v: push(self.zero_constants_tangent, q, v), *stage
            )

            def push_tangent(k: Array, previous_rates: Array) -> Array:
                coordinate_tangents = _propagate_to_stage(
                    tableau,
                    i,
                    lax.dynamic_index_in_dim(start_tangents, k, 0, False),
                    previous_rates.reshape(-1, *v.shape),
                    n,
                    h,
                )
                has_input_tangent = jnp.any(k < tangents.n_column_tangents)
                rate_tangent = run_if_any_element_active(
                    ~has_input_tangent,
                    lambda _: push_coordinates(*coordinate_tangents),
                    jnp.zeros_like(v),
                )
                return run_if_any_element_active(
                    has_input_tangent,
                    lambda _: push(
                        self.push_to_constants(tangents.get_input_tangent(k)), *coordinate_tangents
                    ),
                    rate_tangent,
                )

            return i + 1, tangents.map_tangents_sequentially(
                push_tangent, rate_tangents, i * n_rates
            )

        n_stages = len(stage_states) - 1
        rate_tangents = lax.while_loop(
            lambda loop_state: loop_state[0] < n_stages,
            push_stage,
            (jnp.zeros((), jnp.int32), tangents.allocate_tangent_rows(n_stages * n_rates)),
        )[1]

        def propagate_to_end(k: Array, start_row: Array) -> Array:
            rates = lax.dynamic_index_in_dim(rate_tangents, k, 0, False).reshape(-1, *v.shape)
            end = compute_stage_coordinates(
                tableau, n_stages, start_row[:n], start_row[n:], rates, h
            )
            return jnp.where(is_accepted, jnp.concatenate(end), start_row)

        return tangents.map_tangents_sequentially(propagate_to_end, start_tangents)

    def evaluate_rate_and_tangents(
        self,
        evaluate_function: Callable[[BatchPhase, StageState], Array],
        state: StageState,
        directions: Array,
    ) -> tuple[Array, Array]:
        """Return time derivative and tangents of a number, for tangents of a state."""
        q, v, (_, _, rows) = state
        push = self.linearize(evaluate_function, q, v, rows)
        rate = push(self.zero_constants_tangent, v[: len(q)], rows[: len(v)])

        def push_direction(k: Array, _: Array) -> Array:
            direction = lax.dynamic_index_in_dim(directions, k, 0, False)
            constants_tangent = self.push_to_constants(self.tangents.get_input_tangent(k))
            return push(constants_tangent, direction[: len(q)], direction[len(q) :])

        tangents = self.tangents.map_tangents_sequentially(
            push_direction, self.tangents.allocate_tangent_rows(1)
        )
        return rate, tangents[:, 0]


def _propagate_to_stage(
    tableau: ButcherTableau, i: Array, start_tangent: Array, rate_tangents: Array, n: int, h: Array
) -> tuple[Array, Array]:
    """Return the tangents of `compute_stage_coordinates`, from the tangents at the earlier stages.

    - `start_tangent`: tangent of `n` coordinates, and of the rates.
    """
    flat_matrices = [
        jnp.asarray(stage_matrix.ravel())
        for stage_matrix in (tableau.stage_matrix, tableau.squared_stage_matrix)
    ]
    n_stages, stage_node = len(tableau.stage_matrix[0]), jnp.asarray(tableau.stage_nodes)[i]

    def add_stage(state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        j, rate_increment, coordinate_increment = state
        a, b = (
            lax.dynamic_index_in_dim(flat_matrix, i * n_stages + j, 0, False)
            for flat_matrix in flat_matrices
        )
        rates = lax.dynamic_index_in_dim(rate_tangents, j, 0, False)[:n]
        return j + 1, rate_increment + a * rates, coordinate_increment + b * rates

    q, v, losses = start_tangent[:n], start_tangent[n : 2 * n], start_tangent[2 * n :]
    initial_state = jnp.zeros((), jnp.int32), jnp.zeros_like(q), jnp.zeros_like(q)
    _, rate_increment, coordinate_increment = lax.while_loop(
        lambda state: state[0] < i, add_stage, initial_state
    )
    stage_q = q + h * (stage_node * v + h * coordinate_increment)
    # The losses do not affect the motion.
    return stage_q, jnp.concatenate([v + h * rate_increment, losses])


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
            tangents.get_input_tangent(k), _unpack_tree_from_rows(tangent_row, template)
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
        _unpack_tree_from_rows(lax.dynamic_index_in_dim(tangent_rows, k, 0, False), template),
        tangents.get_input_tangent(k),
    )
    result_tangents = tangents.map_tangents_sequentially(
        push_result_tangent, tangents.allocate_tangent_rows(count_rows(float_results))
    )
    walk_result = make_walk_result(eqx.combine(float_results, other_results), lane_state)
    return walk_result, _unpack_tree_from_rows(result_tangents, float_results)


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
