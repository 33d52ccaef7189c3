"""Walks of a batch with unilateral contact, with tangents along many directions.

Everything that determines the motion (events, contacts, step sizes) is computed once. At each stage
of a Runge-Kutta step and at each event, quantities that all tangents share are computed once. Each
tangent then needs only linear operations. The derivatives are those of the discrete flow at the
accepted step sizes, and of the times of its events: see `numerics.tangents`.
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
    evaluate_dynamics,
    finish_attempt,
    guards_at_point,
    integrator_step,
    motion_from_point,
    run_until_done,
    stage_state,
)
from vrw_jax.contact.contact_modes import ContactMode
from vrw_jax.contact.contact_state import ContactState, ModeDynamics, guard_scales
from vrw_jax.contact.tangent_basis import N_MOVING_LEGS, TangentBasis
from vrw_jax.contact.walk_kernel import (
    STATUS_UNFINISHED,
    BatchWalk,
    BatchWalkResult,
    LaneState,
    LaneTangents,
)
from vrw_jax.integrator import ButcherTableau, real_stability_limit
from vrw_jax.numerics import StepOptions, run_if_any, tree_where
from vrw_jax.wheel import compute_own_units


class _IntervalTangent(NamedTuple):
    """Tangent of a lane's state during an interval."""

    q: Array
    v: Array
    accumulated: Array | None
    dynamics_rows: Array  # of accelerations and, if requested, accumulators
    time: Array  # tangent of the time, s


class _Tangent(NamedTuple):
    """Tangent of all of a lane's state."""

    interval: _IntervalTangent
    others: LaneTangents  # those not in the interval

    @classmethod
    def from_lane_tangents(cls, lane_tangents: LaneTangents, dynamics_rows: Array) -> "_Tangent":
        """Return the tangent of these lane tangents and dynamics rows."""
        accumulators, accumulated = lane_tangents.accumulated
        others: Any = lane_tangents._asdict() | {
            "q": None,
            "v": None,
            "accumulated": (accumulators, None),
            "time": None,
        }
        return cls(
            _IntervalTangent(
                lane_tangents.q, lane_tangents.v, accumulated, dynamics_rows, lane_tangents.time
            ),
            LaneTangents(**others),
        )

    def lane_tangents(self) -> LaneTangents:
        """Return the lane tangents."""
        q, v, accumulated, _, time = self.interval
        return self.others._replace(
            q=q, v=v, accumulated=(self.others.accumulated[0], accumulated), time=time
        )


class TangentBatch(NamedTuple):
    """Tangents of each lane: arrays have them on the first axis, lanes on the last."""

    n_tangents: Array  # number of tangents of a lane
    n_column_tangents: Array  # number of leading ones that may have column parts
    columns: Array
    rows: Array  # all numbers of a `_Tangent` in one array, for few loops and short compilation

    def allocate(self, size: int) -> Array:
        """Return uninitialized rows of each tangent, to be written."""
        return lax.empty((len(self.columns), size, *self.n_tangents.shape), self.columns.dtype)

    def map_tangents(
        self, function: Callable[[Array, Array], Any], rows: Array, first_row: Array | int = 0
    ) -> Array:
        """Return the rows of each tangent, overwritten from row `first_row` on by `function(k,
        rows)`.
        """
        should_continue = lambda state: jnp.any(state[0] < self.n_tangents)

        def update_one(state: tuple[Array, Array]) -> tuple[Array, Array]:
            k, rows = state
            new_rows = _pack_rows(function(k, lax.dynamic_index_in_dim(rows, k, 0, False)))
            # Stacking row by row keeps the rows in registers.
            new_rows = jnp.stack([new_rows[i] for i in range(len(new_rows))])
            position = k, jnp.int32(first_row), jnp.int32(0)
            return k + 1, lax.dynamic_update_slice(rows, new_rows[None], position)

        return lax.while_loop(should_continue, update_one, (jnp.zeros((), jnp.int32), rows))[1]


def _pack_rows(tree: Any) -> Array:
    """Return all numbers of a tree in one array of rows."""
    return jnp.concatenate([x.reshape(-1, x.shape[-1]) for x in jax.tree.leaves(tree)])


def _unpack_rows(rows: Array, template: Any) -> Any:
    """Return the rows as a tree of the template's structure: the inverse of `_pack_rows`."""
    leaves, structure = jax.tree.flatten(template)
    arrays, offset = [], 0
    for leaf in leaves:
        size = math.prod(leaf.shape[:-1])
        leaf_rows = rows[..., offset : offset + size, :]
        arrays.append(leaf_rows.reshape(*rows.shape[:-2], *leaf.shape))
        offset += size
    return jax.tree.unflatten(structure, arrays)


def _unpack_at(rows: Array, k: Array, template: Any) -> Any:
    """Return tangent k as a tree of the template's structure."""
    return _unpack_rows(lax.dynamic_index_in_dim(rows, k, 0, False), template)


def walk_with_tangents(
    walk: BatchWalk, columns: Array, x: Array, d_columns: Array, d_x: Array, n_tangents: Array
) -> tuple[BatchWalkResult, Any]:
    """Return the result of `run_walks`, and the tangents of its floats for each lane.

    Tangents are the first axis of `d_columns`, `d_x` and the returned tangents; a lane has
    `n_tangents` of them.
    """
    columns, x, is_valid = walk.replace_invalid(columns, x)
    n_rows = lambda tree: len(_pack_rows(tree))

    def begin_walk(columns: Array, x: Array) -> tuple[LaneTangents, LaneState]:
        lane = walk.deactivate(walk.begin_walk(columns, x), is_valid)
        return lane.get_tangents(), lane

    lane_tangents, push, lane = jax.linearize(begin_walk, columns, x, has_aux=True)
    dynamics_rows = jnp.zeros(
        (len(lane_tangents.q) + N_ACCUMULATOR_ROWS * walk.is_detailed, *n_tangents.shape), x.dtype
    )
    template = _Tangent.from_lane_tangents(lane_tangents, dynamics_rows)
    n_column_tangents = jnp.zeros_like(n_tangents)
    for k in range(len(d_columns)):
        n_column_tangents = jnp.where(
            jnp.any(d_columns[k] != 0.0, axis=0), k + 1, n_column_tangents
        )
    tangents = TangentBatch(n_tangents, n_column_tangents, d_columns, d_columns)
    start_tangent = lambda k, _: _Tangent.from_lane_tangents(
        push(_unpack_at(d_columns, k, columns), _unpack_at(d_x, k, x)), dynamics_rows
    )
    tangents = tangents._replace(
        rows=tangents.map_tangents(start_tangent, tangents.allocate(n_rows(template)))
    )

    def advance_round(state: tuple[LaneState, TangentBatch]) -> tuple[LaneState, TangentBatch]:
        lane, tangents = state

        def past_events(
            columns: Array, lane_tangents: LaneTangents
        ) -> tuple[LaneTangents, LaneState]:
            next_lane = walk.process_events(columns, lane.replace_tangents(lane_tangents))
            return next_lane.get_tangents(), next_lane

        _, push, next_lane = jax.linearize(past_events, columns, lane.get_tangents(), has_aux=True)

        def pass_event(k: Array, row: Array) -> _Tangent:
            tangent = _unpack_rows(row, template)
            return _Tangent.from_lane_tangents(
                push(_unpack_at(d_columns, k, columns), tangent.lane_tangents()),
                tangent.interval.dynamics_rows,
            )

        tangents = tangents._replace(rows=tangents.map_tangents(pass_event, tangents.rows))
        is_unfinished = next_lane.outcome == STATUS_UNFINISHED
        dynamics_at = lambda c: walk.make_dynamics(c, next_lane.interval.contact_state)
        arguments = (
            dynamics_at,
            columns,
            next_lane.interval,
            tangents,
            template.interval,
            is_unfinished,
            walk.options,
            walk.tableau,
        )
        interval, rows = _integrate_with_tangents(*arguments)
        return next_lane._replace(interval=interval), tangents._replace(rows=rows)

    should_continue = lambda state: jnp.any(state[0].outcome == STATUS_UNFINISHED)
    lane, tangents = lax.while_loop(should_continue, advance_round, (lane, tangents))

    def partition_result(lane_tangents: LaneTangents, tilt: Array | None) -> tuple[Any, Any]:
        return eqx.partition(
            walk.compute_result(lane.replace_tangents(lane_tangents), tilt), eqx.is_inexact_array
        )

    floats, push, others = jax.linearize(
        partition_result, lane.get_tangents(), walk.tilt(columns), has_aux=True
    )
    tilt_at = lambda k: walk.tilt(_unpack_at(d_columns, k, columns))
    push_tangent = lambda k, _: push(
        _unpack_at(tangents.rows, k, template).lane_tangents(), tilt_at(k)
    )
    result_tangents = tangents.map_tangents(push_tangent, tangents.allocate(n_rows(floats)))
    step_result = eqx.combine(floats, others)
    walk_result = BatchWalkResult(
        step_result, lane.outcome, lane.n_stepped, lane.counters.n_solver_steps
    )
    return walk_result, _unpack_rows(result_tangents, floats)


def _integrate_with_tangents(
    dynamics_at: DynamicsFn,
    columns: Array,
    initial: IntervalState,
    tangents: TangentBatch,
    template: _IntervalTangent,
    is_walking: Array,
    options: StepOptions,
    tableau: ButcherTableau,
) -> tuple[IntervalState, Array]:
    """Return the result of `integrate_interval`, with the tangents propagated to the event."""
    dynamics = dynamics_at(columns)
    scales, last_stage = guard_scales(dynamics), len(tableau.nodes) - 1
    options = compute_own_units(dynamics.s).scale_times(options)
    has_more_moving = _has_more_moving(tangents, template, initial.contact_state)
    max_h = _max_stable_step(dynamics, tableau)

    def try_step(state: tuple[IntervalState, Array]) -> tuple[IntervalState, Array]:
        interval, rows = state
        h = jnp.where(interval.search.is_active, interval.h, jnp.minimum(interval.h, max_h))
        interval = interval._replace(h=h)
        stage_rows, row_tangents = _evaluate_stages(
            dynamics_at,
            columns,
            interval,
            tangents._replace(rows=rows),
            template,
            tableau,
            has_more_moving,
        )
        attempt = finish_attempt(dynamics, tableau, options, interval, stage_rows)
        next_interval = integrator_step(interval, attempt, scales, tableau, options)
        is_taken, n = next_interval.time != interval.time, len(interval.point.q)

        def end_tangent(k: Array, row: Array) -> _IntervalTangent:
            point = _unpack_rows(row, template)
            stage_tangents = lax.dynamic_index_in_dim(row_tangents, k, 0, False).reshape(
                -1, *template.dynamics_rows.shape
            )
            stage_of = lambda leg_slice: stage_state(
                tableau,
                last_stage,
                point.q[leg_slice],
                point.v[leg_slice],
                stage_tangents[:, :n][:, leg_slice],
                interval.h,
            )
            first_coordinates = slice(0, 3 + N_MOVING_LEGS)
            other_coordinates = slice(3 + N_MOVING_LEGS, None)
            unchanged = point.q[other_coordinates], point.v[other_coordinates]
            ends = zip(
                stage_of(first_coordinates),
                run_if_any(has_more_moving, lambda _: stage_of(other_coordinates), unchanged),
                strict=True,
            )
            q, v = map(jnp.concatenate, ends)
            accumulated = point.accumulated
            if accumulated is not None:
                weights = tableau.matrix[last_stage]
                accumulated = accumulated + interval.h * sum(
                    weights[j] * stage_tangents[j, n:] for j in range(last_stage)
                )
            end_point = _IntervalTangent(q, v, accumulated, stage_tangents[last_stage], point.time)
            return tree_where(is_taken, end_point, point._replace(dynamics_rows=stage_tangents[0]))

        return next_interval, tangents.map_tangents(end_tangent, rows)

    is_running = lambda state: state[0].status == LaneStatus.RUNNING
    interval, rows = run_until_done(is_running, is_walking, try_step, (initial, tangents.rows))
    return interval, tangents.map_tangents(
        _shift_to_event(dynamics_at, columns, initial, interval, tangents, template), rows
    )


def _evaluate_stages(
    dynamics_at: DynamicsFn,
    columns: Array,
    interval: IntervalState,
    tangents: TangentBatch,
    template: _IntervalTangent,
    tableau: ButcherTableau,
    has_more_moving: Array,
) -> tuple[Array, Array]:
    """Return the dynamics rows at the stages of a step, and the tangents of these rows.

    The tangents are processed one after another.
    """
    point, h = interval.point, interval.h
    size, last_stage = len(template.dynamics_rows), len(tableau.nodes) - 1
    is_fresh = (interval.status == LaneStatus.RUNNING) & (interval.time == 0.0)

    def evaluate_stage(state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        i, stage_rows, row_tangents = state

        stage_coordinates = stage_state(tableau, i, point.q, point.v, stage_rows, h)
        dynamics = dynamics_at(columns)
        basis = TangentBasis.from_motion(
            dynamics,
            motion_from_point(IntervalPoint(*stage_coordinates, stage_coordinates[0])),
            has_more_moving,
        )
        zero_response = basis.make_zero()
        respond = lambda k, _: basis.respond_to_columns(
            dynamics_at, columns, _unpack_at(tangents.columns, k, columns)
        )
        column_responses = tangents._replace(n_tangents=tangents.n_column_tangents).map_tangents(
            respond, tangents.allocate(len(_pack_rows(zero_response)))
        )

        def propagate_one(k: Array, known_rows: Array) -> Array:
            tangent = _unpack_at(tangents.rows, k, template)
            previous_rows = known_rows.reshape(-1, *template.dynamics_rows.shape)
            coordinates = lambda leg_slice: _stage_tangent(
                tableau, i, tangent, previous_rows, h, leg_slice
            )
            column_response = run_if_any(
                jnp.any(k < tangents.n_column_tangents),
                lambda _: _unpack_at(column_responses, k, zero_response),
                zero_response,
            )
            new_row = basis.propagate_tangent(coordinates, column_response, has_more_moving)
            return jnp.where((i > 0) | is_fresh, new_row, known_rows[:size])

        row = jnp.where(i > 0, evaluate_dynamics(dynamics, *stage_coordinates), point.dynamics_rows)
        stage_rows = lax.dynamic_update_index_in_dim(stage_rows, row, i, 0)
        return i + 1, stage_rows, tangents.map_tangents(propagate_one, row_tangents, i * size)

    other_rows = jnp.zeros((last_stage, *point.dynamics_rows.shape), h.dtype)
    stage_rows = jnp.concatenate([point.dynamics_rows[None], other_rows])
    row_tangents = tangents.map_tangents(
        lambda k, _: _unpack_at(tangents.rows, k, template).dynamics_rows,
        tangents.allocate((last_stage + 1) * size),
    )
    # The first stage is the last one of the previous step, except after an event.
    first_stage = jnp.where(jnp.any(is_fresh), 0, 1).astype(jnp.int32)
    should_continue = lambda state: state[0] <= last_stage
    return lax.while_loop(should_continue, evaluate_stage, (first_stage, stage_rows, row_tangents))[
        1:
    ]


def _stage_tangent(
    tableau: ButcherTableau,
    i: Array,
    tangent: _IntervalTangent,
    known_rows: Array,
    h: Array,
    leg_slice: slice,
) -> tuple[Array, Array]:
    """Return the tangent of `stage_state` for some coordinates, from the earlier stages."""
    rows = [jnp.asarray(np.reshape(x, -1)) for x in (tableau.matrix, tableau.matrix_squared)]
    width, node = len(tableau.matrix[0]), jnp.asarray(tableau.nodes)[i]

    def add_stage(state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        j, first_sum, second_sum = state
        a, b = (lax.dynamic_index_in_dim(weights, i * width + j, 0, False) for weights in rows)
        row = lax.dynamic_index_in_dim(known_rows, j, 0, False)[: len(tangent.q)][leg_slice]
        return j + 1, first_sum + a * row, second_sum + b * row

    q, v = tangent.q[leg_slice], tangent.v[leg_slice]
    initial = jnp.zeros((), jnp.int32), jnp.zeros_like(q), jnp.zeros_like(q)
    _, first_sum, second_sum = lax.while_loop(lambda state: state[0] < i, add_stage, initial)
    return q + h * (node * v + h * second_sum), v + h * first_sum


def _max_stable_step(
    dynamics: ModeDynamics, tableau: ButcherTableau, safety_factor: float = 0.85
) -> Array:
    """Return the step size above which tangents of a swinging leg grow, times a safety factor.

    The damper of such a leg stops it within m / c. Step-size control is based on the motion alone,
    in which such a leg may be almost at rest.
    """
    has_swing_leg = jnp.any(
        ~dynamics.contact_state.locked & (dynamics.contact_state.contact == ContactMode.OFF), axis=0
    )
    step_factor = safety_factor * real_stability_limit(tableau)
    return jnp.where(has_swing_leg, step_factor * dynamics.s.m / dynamics.s.c, jnp.inf)


def _has_more_moving(
    tangents: TangentBatch, template: _IntervalTangent, contact_state: ContactState
) -> Array:
    """Return whether any leg after the first ones moves, in any lane and along any tangent."""

    def check_one(state: tuple[Array, Array]) -> tuple[Array, Array]:
        k, has_moving = state
        tangent = _unpack_at(tangents.rows, k, template)
        lengths = jnp.concatenate([tangent.q[3 + N_MOVING_LEGS :], tangent.v[3 + N_MOVING_LEGS :]])
        return k + 1, has_moving | jnp.any(lengths != 0.0, axis=0)

    initial = jnp.zeros((), jnp.int32), jnp.any(~contact_state.locked[N_MOVING_LEGS:], axis=0)
    should_continue = lambda state: jnp.any(state[0] < tangents.n_tangents)
    return jnp.any(lax.while_loop(should_continue, check_one, initial)[1])


def _shift_to_event(
    dynamics_at: DynamicsFn,
    columns: Array,
    initial: IntervalState,
    interval: IntervalState,
    tangents: TangentBatch,
    template: _IntervalTangent,
) -> Callable[[Array, Array], _IntervalTangent]:
    """Return the function that shifts tangents by the tangent of the event time."""
    point, n = interval.point, len(interval.point.q)

    def compute_guards(columns: Array, q: Array, v: Array) -> Array:
        dynamics = dynamics_at(columns)
        return guards_at_point(dynamics, IntervalPoint(q, v, evaluate_dynamics(dynamics, q, v)))

    _, push_guards = jax.linearize(compute_guards, columns, point.q, point.v)
    rates = push_guards(jnp.zeros_like(columns), point.v, point.dynamics_rows[:n])
    has_arrived = (initial.status == LaneStatus.RUNNING) & (interval.status == LaneStatus.EVENT)

    def shift_tangent(k: Array, row: Array) -> _IntervalTangent:
        tangent, time_tangent = _unpack_rows(row, template), jnp.zeros_like(interval.time)
        guard_tangents = push_guards(_unpack_at(tangents.columns, k, columns), tangent.q, tangent.v)
        for index in range(len(guard_tangents)):
            is_at_guard = has_arrived & (interval.guard == index) & (rates[index] < 0.0)
            time_tangent = jnp.where(
                is_at_guard,
                -guard_tangents[index] / jnp.where(is_at_guard, rates[index], -1.0),
                time_tangent,
            )
        accumulated = tangent.accumulated
        if accumulated is not None:
            accumulated = accumulated + time_tangent * point.dynamics_rows[-N_ACCUMULATOR_ROWS:]
        return _IntervalTangent(
            q=tangent.q + time_tangent * point.v,
            v=tangent.v + time_tangent * point.dynamics_rows[:n],
            accumulated=accumulated,
            dynamics_rows=tangent.dynamics_rows,
            time=time_tangent,
        )

    return shift_tangent
