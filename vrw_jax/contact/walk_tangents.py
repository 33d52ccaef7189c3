"""Walks of a batch with unilateral contact, with tangents along many directions.

Events, contacts and step sizes determine the motion and are computed once. At each stage of a
Runge-Kutta step and at each event, quantities common to all tangents are computed once. Each
tangent then needs only linear operations. The derivatives are those of the discrete flow at the
accepted step sizes, and of the times of its events: see `integrator.tangents`.
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from vrw_jax.contact.batch_integrator import (
    N_ACCUMULATOR_ROWS,
    DynamicsFn,
    IntervalPoint,
    IntervalState,
    LaneStatus,
    complete_solver_step,
    compute_stage_state,
    evaluate_dynamics,
    evaluate_guards_at_point,
    integrator_step,
    iterate_until_stopped,
    motion_from_point,
)
from vrw_jax.contact.contact_modes import ContactMode
from vrw_jax.contact.contact_state import ContactState, ModeDynamics, compute_guard_scales
from vrw_jax.contact.tangent_basis import N_MOVING_LEGS, TangentBasis
from vrw_jax.contact.walk_kernel import (
    STATUS_UNFINISHED,
    BatchWalkResult,
    BatchWalkSettings,
    DifferentiableLaneState,
    LaneState,
)
from vrw_jax.integrator import ButcherTableau, compute_real_stability_limit
from vrw_jax.numerics import StepOptions, run_if_any, select_tree_leaves
from vrw_jax.wheel import compute_wheel_units


class _IntervalTangent(NamedTuple):
    """Tangent of a lane's state during an interval."""

    q: Array
    v: Array
    interval_accumulators: Array | None
    dynamics_rows: Array  # tangents of accelerations and, if requested, accumulator rates
    time: Array  # tangent of the time, s


class _Tangent(NamedTuple):
    """Tangent of the whole state of a lane."""

    interval: _IntervalTangent
    other_tangents: DifferentiableLaneState  # tangents of what is not in the interval

    @classmethod
    def from_lane_tangents(
        cls, lane_tangents: DifferentiableLaneState, dynamics_rows: Array
    ) -> "_Tangent":
        """Return the tangent made of these lane tangents and tangents of dynamics rows."""
        accumulators, interval_accumulators = lane_tangents.accumulators
        other_tangents: Any = lane_tangents._asdict() | {
            "q": None,
            "v": None,
            "accumulators": (accumulators, None),
            "time": None,
        }
        return cls(
            _IntervalTangent(
                lane_tangents.q,
                lane_tangents.v,
                interval_accumulators,
                dynamics_rows,
                lane_tangents.time,
            ),
            DifferentiableLaneState(**other_tangents),
        )

    def to_lane_tangents(self) -> DifferentiableLaneState:
        """Return the tangent of the differentiable lane state."""
        q, v, interval_accumulators, _, time = self.interval
        return self.other_tangents._replace(
            q=q,
            v=v,
            accumulators=(self.other_tangents.accumulators[0], interval_accumulators),
            time=time,
        )


class TangentBatch(NamedTuple):
    """Tangents of each lane: arrays have the tangents on the first axis and lanes on the last."""

    n_tangents: Array  # number of tangents of each lane
    n_column_tangents: Array  # number of leading tangents whose columns may vary
    column_tangents: Array
    tangent_rows: Array  # all numbers of a `_Tangent`, see `_pack_rows`, (tangents, rows, lanes)

    def allocate(self, n_rows: int) -> Array:
        """Return uninitialized rows of all tangents, (tangents, n_rows, lanes)."""
        return lax.empty(
            (len(self.column_tangents), n_rows, *self.n_tangents.shape), self.column_tangents.dtype
        )

    def map_tangents(
        self,
        function: Callable[[Array, Array], Any],
        tangent_rows: Array,
        first_row: Array | int = 0,
    ) -> Array:
        """Return the rows of all tangents, with those from `first_row` on replaced by the
        function's results.

        - `function`: maps the index of a tangent and its rows to the new rows, as a tree.
        """
        should_continue = lambda state: jnp.any(state[0] < self.n_tangents)

        def update_tangent(state: tuple[Array, Array]) -> tuple[Array, Array]:
            k, tangent_rows = state
            new_rows = _pack_rows(function(k, lax.dynamic_index_in_dim(tangent_rows, k, 0, False)))
            # Stacking row by row keeps the rows in registers.
            new_rows = jnp.stack([new_rows[i] for i in range(len(new_rows))])
            start_indices = k, jnp.int32(first_row), jnp.int32(0)
            return k + 1, lax.dynamic_update_slice(tangent_rows, new_rows[None], start_indices)

        return lax.while_loop(
            should_continue, update_tangent, (jnp.zeros((), jnp.int32), tangent_rows)
        )[1]


def _pack_rows(tree: Any) -> Array:
    """Return all numbers of a tree in one array (rows, lanes)."""
    return jnp.concatenate([x.reshape(-1, x.shape[-1]) for x in jax.tree.leaves(tree)])


def _unpack_rows(rows: Array, template: Any) -> Any:
    """Return rows as a tree of the template's structure: the inverse of `_pack_rows`."""
    leaves, structure = jax.tree.flatten(template)
    arrays, row_offset = [], 0
    for leaf in leaves:
        n_leaf_rows = math.prod(leaf.shape[:-1])
        leaf_rows = rows[..., row_offset : row_offset + n_leaf_rows, :]
        arrays.append(leaf_rows.reshape(*rows.shape[:-2], *leaf.shape))
        row_offset += n_leaf_rows
    return jax.tree.unflatten(structure, arrays)


def _unpack_tangent(tangent_rows: Array, k: Array, template: Any) -> Any:
    """Return tangent k as a tree of the template's structure."""
    return _unpack_rows(lax.dynamic_index_in_dim(tangent_rows, k, 0, False), template)


def walk_with_tangents(
    walk_settings: BatchWalkSettings,
    input_columns: Array,
    x: Array,
    d_columns: Array,
    d_x: Array,
    n_tangents: Array,
) -> tuple[BatchWalkResult, Any]:
    """Return the result of `run_walks`, and the tangents of its floats for each lane.

    Tangents are the first axis of `d_columns`, `d_x` and the returned tangents. Each lane has
    `n_tangents` of them.
    """
    tableau = walk_settings.tableau
    assert tableau is not None  # diffrax differentiates in another way.
    input_columns, x, is_valid = walk_settings.replace_invalid(input_columns, x)
    count_rows = lambda tree: len(_pack_rows(tree))

    def begin_walk(input_columns: Array, x: Array) -> tuple[DifferentiableLaneState, LaneState]:
        lane_state = walk_settings.deactivate_invalid(
            walk_settings.begin_walk(input_columns, x), is_valid
        )
        return lane_state.get_differentiable(), lane_state

    lane_tangents, pushforward, lane_state = jax.linearize(
        begin_walk, input_columns, x, has_aux=True
    )
    dynamics_rows = jnp.zeros(
        (len(lane_tangents.q) + N_ACCUMULATOR_ROWS * walk_settings.is_detailed, *n_tangents.shape),
        x.dtype,
    )
    tangent_template = _Tangent.from_lane_tangents(lane_tangents, dynamics_rows)
    n_column_tangents = jnp.zeros_like(n_tangents)
    for k in range(len(d_columns)):
        n_column_tangents = jnp.where(
            jnp.any(d_columns[k] != 0.0, axis=0), k + 1, n_column_tangents
        )
    tangents = TangentBatch(n_tangents, n_column_tangents, d_columns, d_columns)
    make_start_tangent = lambda k, _: _Tangent.from_lane_tangents(
        pushforward(_unpack_tangent(d_columns, k, input_columns), _unpack_tangent(d_x, k, x)),
        dynamics_rows,
    )
    tangents = tangents._replace(
        tangent_rows=tangents.map_tangents(
            make_start_tangent, tangents.allocate(count_rows(tangent_template))
        )
    )

    def process_and_integrate(
        state: tuple[LaneState, TangentBatch],
    ) -> tuple[LaneState, TangentBatch]:
        lane_state, tangents = state

        def process_events_from(
            input_columns: Array, differentiable: DifferentiableLaneState
        ) -> tuple[DifferentiableLaneState, LaneState]:
            next_state = walk_settings.process_events(
                input_columns, lane_state.replace_differentiable(differentiable)
            )
            return next_state.get_differentiable(), next_state

        _, pushforward, next_state = jax.linearize(
            process_events_from, input_columns, lane_state.get_differentiable(), has_aux=True
        )

        def push_through_event(k: Array, tangent_row: Array) -> _Tangent:
            tangent = _unpack_rows(tangent_row, tangent_template)
            return _Tangent.from_lane_tangents(
                pushforward(
                    _unpack_tangent(d_columns, k, input_columns), tangent.to_lane_tangents()
                ),
                tangent.interval.dynamics_rows,
            )

        tangents = tangents._replace(
            tangent_rows=tangents.map_tangents(push_through_event, tangents.tangent_rows)
        )
        is_unfinished = next_state.outcome == STATUS_UNFINISHED
        dynamics_fn = lambda c: walk_settings.make_dynamics(c, next_state.interval.contact_state)
        integration_arguments = (
            dynamics_fn,
            input_columns,
            next_state.interval,
            tangents,
            tangent_template.interval,
            is_unfinished,
            walk_settings.options,
            tableau,
        )
        interval, tangent_rows = _integrate_with_tangents(*integration_arguments)
        return next_state._replace(interval=interval), tangents._replace(tangent_rows=tangent_rows)

    should_continue = lambda state: jnp.any(state[0].outcome == STATUS_UNFINISHED)
    lane_state, tangents = lax.while_loop(
        should_continue, process_and_integrate, (lane_state, tangents)
    )

    def partition_result(
        differentiable: DifferentiableLaneState, tilt: Array | None
    ) -> tuple[Any, Any]:
        return eqx.partition(
            walk_settings.compute_result(lane_state.replace_differentiable(differentiable), tilt),
            eqx.is_inexact_array,
        )

    float_leaves, pushforward, other_leaves = jax.linearize(
        partition_result,
        lane_state.get_differentiable(),
        walk_settings.tilt(input_columns),
        has_aux=True,
    )
    tilt_tangent = lambda k: walk_settings.tilt(_unpack_tangent(d_columns, k, input_columns))
    push_result_tangent = lambda k, _: pushforward(
        _unpack_tangent(tangents.tangent_rows, k, tangent_template).to_lane_tangents(),
        tilt_tangent(k),
    )
    result_tangents = tangents.map_tangents(
        push_result_tangent, tangents.allocate(count_rows(float_leaves))
    )
    step_result = eqx.combine(float_leaves, other_leaves)
    walk_result = BatchWalkResult(
        step_result, lane_state.outcome, lane_state.n_stepped, lane_state.counters.n_solver_steps
    )
    return walk_result, _unpack_rows(result_tangents, float_leaves)


def _integrate_with_tangents(
    dynamics_fn: DynamicsFn,
    input_columns: Array,
    initial_state: IntervalState,
    tangents: TangentBatch,
    tangent_template: _IntervalTangent,
    has_unfinished_walk: Array,
    options: StepOptions,
    tableau: ButcherTableau,
) -> tuple[IntervalState, Array]:
    """Return the result of `integrate_interval`, and the tangent rows at the event."""
    dynamics = dynamics_fn(input_columns)
    guard_scales, last_stage = compute_guard_scales(dynamics), len(tableau.nodes) - 1
    options = compute_wheel_units(dynamics.s).scale_times_to_seconds(options)
    has_later_moving_legs = _has_later_moving_legs(
        tangents, tangent_template, initial_state.contact_state
    )
    max_stable_h = _max_stable_step(dynamics, tableau)

    def try_step(state: tuple[IntervalState, Array]) -> tuple[IntervalState, Array]:
        interval, tangent_rows = state
        h = jnp.where(
            interval.event_bracket.is_active, interval.h, jnp.minimum(interval.h, max_stable_h)
        )
        interval = interval._replace(h=h)
        stage_rows, stage_row_tangents = _evaluate_stages(
            dynamics_fn,
            input_columns,
            interval,
            tangents._replace(tangent_rows=tangent_rows),
            tangent_template,
            tableau,
            has_later_moving_legs,
        )
        attempt = complete_solver_step(dynamics, tableau, options, interval, stage_rows)
        next_interval = integrator_step(interval, attempt, guard_scales, tableau, options)
        is_state_updated, n = next_interval.time != interval.time, len(interval.point.q)

        def propagate_to_end(k: Array, tangent_row: Array) -> _IntervalTangent:
            start_tangent = _unpack_rows(tangent_row, tangent_template)
            stage_tangents = lax.dynamic_index_in_dim(stage_row_tangents, k, 0, False).reshape(
                -1, *tangent_template.dynamics_rows.shape
            )
            combine_stages = lambda leg_slice: compute_stage_state(
                tableau,
                last_stage,
                start_tangent.q[leg_slice],
                start_tangent.v[leg_slice],
                stage_tangents[:, :n][:, leg_slice],
                interval.h,
            )
            first_coordinates = slice(0, 3 + N_MOVING_LEGS)
            other_coordinates = slice(3 + N_MOVING_LEGS, None)
            unchanged_coordinates = (
                start_tangent.q[other_coordinates],
                start_tangent.v[other_coordinates],
            )
            end_coordinates = zip(
                combine_stages(first_coordinates),
                run_if_any(
                    has_later_moving_legs,
                    lambda _: combine_stages(other_coordinates),
                    unchanged_coordinates,
                ),
                strict=True,
            )
            q, v = map(jnp.concatenate, end_coordinates)
            interval_accumulators = start_tangent.interval_accumulators
            if interval_accumulators is not None:
                weights = tableau.matrix[last_stage]
                interval_accumulators = interval_accumulators + interval.h * sum(
                    weights[j] * stage_tangents[j, n:] for j in range(last_stage)
                )
            end_tangent = _IntervalTangent(
                q, v, interval_accumulators, stage_tangents[last_stage], start_tangent.time
            )
            return select_tree_leaves(
                is_state_updated,
                end_tangent,
                start_tangent._replace(dynamics_rows=stage_tangents[0]),
            )

        return next_interval, tangents.map_tangents(propagate_to_end, tangent_rows)

    is_running = lambda state: state[0].status == LaneStatus.RUNNING
    interval, tangent_rows = iterate_until_stopped(
        is_running, has_unfinished_walk, try_step, (initial_state, tangents.tangent_rows)
    )
    return interval, tangents.map_tangents(
        _shift_to_event(
            dynamics_fn, input_columns, initial_state, interval, tangents, tangent_template
        ),
        tangent_rows,
    )


def _evaluate_stages(
    dynamics_fn: DynamicsFn,
    input_columns: Array,
    interval: IntervalState,
    tangents: TangentBatch,
    tangent_template: _IntervalTangent,
    tableau: ButcherTableau,
    has_later_moving_legs: Array,
) -> tuple[Array, Array]:
    """Return the dynamics rows at the stages of a step, and the tangents of these rows.

    The tangents are computed one after another.
    """
    point, h = interval.point, interval.h
    n_dynamics_rows, last_stage = len(tangent_template.dynamics_rows), len(tableau.nodes) - 1
    is_at_interval_start = (interval.status == LaneStatus.RUNNING) & (interval.time == 0.0)

    def evaluate_stage_with_tangents(
        state: tuple[Array, Array, Array],
    ) -> tuple[Array, Array, Array]:
        i, stage_rows, stage_row_tangents = state

        stage_coordinates = compute_stage_state(tableau, i, point.q, point.v, stage_rows, h)
        dynamics = dynamics_fn(input_columns)
        tangent_basis = TangentBasis.from_motion(
            dynamics,
            motion_from_point(IntervalPoint(*stage_coordinates, stage_coordinates[0])),
            has_later_moving_legs,
        )
        zero_response = tangent_basis.make_zero_response()
        compute_column_response = lambda k, _: tangent_basis.compute_column_response(
            dynamics_fn, input_columns, _unpack_tangent(tangents.column_tangents, k, input_columns)
        )
        column_responses = tangents._replace(n_tangents=tangents.n_column_tangents).map_tangents(
            compute_column_response, tangents.allocate(len(_pack_rows(zero_response)))
        )

        def propagate_tangent(k: Array, known_rows: Array) -> Array:
            tangent = _unpack_tangent(tangents.tangent_rows, k, tangent_template)
            previous_rows = known_rows.reshape(-1, *tangent_template.dynamics_rows.shape)
            coordinate_tangent_fn = lambda leg_slice: _propagate_stage_coordinates(
                tableau, i, tangent, previous_rows, h, leg_slice
            )
            column_response = run_if_any(
                jnp.any(k < tangents.n_column_tangents),
                lambda _: _unpack_tangent(column_responses, k, zero_response),
                zero_response,
            )
            row_tangent = tangent_basis.propagate_tangent(
                coordinate_tangent_fn, column_response, has_later_moving_legs
            )
            return jnp.where(
                (i > 0) | is_at_interval_start, row_tangent, known_rows[:n_dynamics_rows]
            )

        stage_row = jnp.where(
            i > 0, evaluate_dynamics(dynamics, *stage_coordinates), point.dynamics_rows
        )
        stage_rows = lax.dynamic_update_index_in_dim(stage_rows, stage_row, i, 0)
        return (
            i + 1,
            stage_rows,
            tangents.map_tangents(propagate_tangent, stage_row_tangents, i * n_dynamics_rows),
        )

    later_stage_rows = jnp.zeros((last_stage, *point.dynamics_rows.shape), h.dtype)
    stage_rows = jnp.concatenate([point.dynamics_rows[None], later_stage_rows])
    stage_row_tangents = tangents.map_tangents(
        lambda k, _: _unpack_tangent(tangents.tangent_rows, k, tangent_template).dynamics_rows,
        tangents.allocate((last_stage + 1) * n_dynamics_rows),
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
    known_row_tangents: Array,
    h: Array,
    leg_slice: slice,
) -> tuple[Array, Array]:
    """Return the tangent of `compute_stage_state` for some coordinates, from the earlier stages."""
    flat_matrices = [
        jnp.asarray(np.reshape(x, -1)) for x in (tableau.matrix, tableau.matrix_squared)
    ]
    n_stages, node = len(tableau.matrix[0]), jnp.asarray(tableau.nodes)[i]

    def add_stage(state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        j, rate_increment, coordinate_increment = state
        a, b = (
            lax.dynamic_index_in_dim(flat_matrix, i * n_stages + j, 0, False)
            for flat_matrix in flat_matrices
        )
        row_tangent = lax.dynamic_index_in_dim(known_row_tangents, j, 0, False)[: len(tangent.q)][
            leg_slice
        ]
        return j + 1, rate_increment + a * row_tangent, coordinate_increment + b * row_tangent

    q, v = tangent.q[leg_slice], tangent.v[leg_slice]
    initial_state = jnp.zeros((), jnp.int32), jnp.zeros_like(q), jnp.zeros_like(q)
    _, rate_increment, coordinate_increment = lax.while_loop(
        lambda state: state[0] < i, add_stage, initial_state
    )
    return q + h * (node * v + h * coordinate_increment), v + h * rate_increment


def _max_stable_step(
    dynamics: ModeDynamics, tableau: ButcherTableau, safety_factor: float = 0.85
) -> Array:
    """Return the step size above which tangents of a swinging leg grow, times a safety factor, s.

    The damper of such a leg stops the leg within m / c. Step-size control is based on the motion
    alone, in which the leg may be almost at rest.
    """
    has_swing_leg = jnp.any(
        ~dynamics.contact_state.locked & (dynamics.contact_state.contact_modes == ContactMode.OFF),
        axis=0,
    )
    step_factor = safety_factor * compute_real_stability_limit(tableau)
    return jnp.where(has_swing_leg, step_factor * dynamics.s.m / dynamics.s.c, jnp.inf)


def _has_later_moving_legs(
    tangents: TangentBatch, tangent_template: _IntervalTangent, contact_state: ContactState
) -> Array:
    """Return whether any leg after the first ones moves, in any lane and along any tangent."""

    def check_tangent(state: tuple[Array, Array]) -> tuple[Array, Array]:
        k, has_moving_leg = state
        tangent = _unpack_tangent(tangents.tangent_rows, k, tangent_template)
        length_tangents = jnp.concatenate(
            [tangent.q[3 + N_MOVING_LEGS :], tangent.v[3 + N_MOVING_LEGS :]]
        )
        return k + 1, has_moving_leg | jnp.any(length_tangents != 0.0, axis=0)

    initial_state = jnp.zeros((), jnp.int32), jnp.any(~contact_state.locked[N_MOVING_LEGS:], axis=0)
    should_continue = lambda state: jnp.any(state[0] < tangents.n_tangents)
    return jnp.any(lax.while_loop(should_continue, check_tangent, initial_state)[1])


def _shift_to_event(
    dynamics_fn: DynamicsFn,
    input_columns: Array,
    initial_state: IntervalState,
    interval: IntervalState,
    tangents: TangentBatch,
    tangent_template: _IntervalTangent,
) -> Callable[[Array, Array], _IntervalTangent]:
    """Return a function that shifts tangents by the tangent of the event time."""
    point, n = interval.point, len(interval.point.q)

    def compute_guards(input_columns: Array, q: Array, v: Array) -> Array:
        dynamics = dynamics_fn(input_columns)
        return evaluate_guards_at_point(
            dynamics, IntervalPoint(q, v, evaluate_dynamics(dynamics, q, v))
        )

    _, guard_pushforward = jax.linearize(compute_guards, input_columns, point.q, point.v)
    guard_rates = guard_pushforward(jnp.zeros_like(input_columns), point.v, point.dynamics_rows[:n])
    has_reached_event = (initial_state.status == LaneStatus.RUNNING) & (
        interval.status == LaneStatus.EVENT
    )

    def shift_tangent(k: Array, tangent_row: Array) -> _IntervalTangent:
        tangent, time_tangent = (
            _unpack_rows(tangent_row, tangent_template),
            jnp.zeros_like(interval.time),
        )
        guard_tangents = guard_pushforward(
            _unpack_tangent(tangents.column_tangents, k, input_columns), tangent.q, tangent.v
        )
        for guard_index in range(len(guard_tangents)):
            is_at_guard = (
                has_reached_event
                & (interval.triggered_guard == guard_index)
                & (guard_rates[guard_index] < 0.0)
            )
            time_tangent = jnp.where(
                is_at_guard,
                -guard_tangents[guard_index]
                / jnp.where(is_at_guard, guard_rates[guard_index], -1.0),
                time_tangent,
            )
        interval_accumulators = tangent.interval_accumulators
        if interval_accumulators is not None:
            interval_accumulators = (
                interval_accumulators + time_tangent * point.dynamics_rows[-N_ACCUMULATOR_ROWS:]
            )
        return _IntervalTangent(
            q=tangent.q + time_tangent * point.v,
            v=tangent.v + time_tangent * point.dynamics_rows[:n],
            interval_accumulators=interval_accumulators,
            dynamics_rows=tangent.dynamics_rows,
            time=time_tangent,
        )

    return shift_tangent
