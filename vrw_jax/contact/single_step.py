"""Steps of one wheel with unilateral contact, by machine code or by diffrax in JAX programs.

`build_contact_step_function` returns a function of one wheel that `jax.vmap` maps onto lanes. For
derivatives, each tangent has one lane beside the lane of the motion. For samples of a step, a JAX
program advances from event to event and records the start of each interval. Then every interval
is integrated again, sample by sample.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from vrw_jax.contact.batch_integrator import (
    IntervalPoint,
    attempt_solver_step,
    init_interval,
    motion_from_point,
)
from vrw_jax.contact.contact_modes import ContactMode
from vrw_jax.contact.contact_state import (
    Accumulators,
    ContactState,
    ModeDynamics,
    pack_state,
    unpack_state,
)
from vrw_jax.contact.diffrax_interval import sample_by_diffrax
from vrw_jax.contact.mechanics import WheelMotion, find_slots
from vrw_jax.contact.walk_kernel import (
    STATUS_UNFINISHED,
    BatchWalkResult,
    BatchWalkSettings,
    StepSummary,
    init_lane_states,
    make_result_template,
    process_and_integrate,
    run_walks,
)
from vrw_jax.contact.walk_tangents import walk_with_tangents
from vrw_jax.integrator import ButcherTableau, load_explicit_tableau, sample_at_equal_times
from vrw_jax.models import split_jacobian_by_leaf
from vrw_jax.numerics import ForwardFunction, StepOptions, make_opaque_condition, unbatch
from vrw_jax.runtime import compile_cached_lane_function
from vrw_jax.wheel import stack_parameters


class ContactStepConfig(NamedTuple):
    """Static configuration of a step, and the functions of its array leaves."""

    argument_structure: Any  # tree structure of (wheel, params, x, options)
    is_detailed: bool
    uses_diffrax: bool = False  # whether diffrax replaces the batch kernel
    engine_name: str = "lanes"  # name of the engine in the results

    def tighten_tolerances(self, leaves: tuple[Array, ...]) -> tuple[Array, ...]:
        """Return the leaves with the tolerances of derivatives."""
        *settings, options = jax.tree.unflatten(self.argument_structure, leaves)
        return tuple(jax.tree.leaves((*settings, options.with_derivative_tolerances())))

    def compile_function(
        self, function: Callable, make_template: Callable, key: tuple[Any, ...]
    ) -> Callable:
        """Return a function over lanes as a function of one wheel."""
        if self.uses_diffrax:
            return _add_lane_axis(function)
        return unbatch(compile_cached_lane_function(function, make_template, key))

    def unpack_leaves(self, leaves: tuple[Array, ...]) -> tuple[Array, Array, Any]:
        """Return the lanes' input columns and section states, and (wheel, params, options)."""
        wheel, params, x, options = jax.tree.unflatten(self.argument_structure, leaves)
        uneven_columns = () if wheel.uneven is None else wheel.uneven
        restitution = () if wheel.restitution is None else (wheel.restitution.astype(x.dtype),)
        input_columns = jnp.stack(
            [*stack_parameters(params), wheel.friction, *uneven_columns, *restitution]
        )
        return input_columns, x, (wheel, params, options)

    def make_walk_settings(self, step_settings: Any) -> BatchWalkSettings:
        """Return the settings of a batch of walks of one step each."""
        wheel, params, options = step_settings
        tableau = None if self.uses_diffrax else load_explicit_tableau(options.solver)
        assert self.uses_diffrax or tableau is not None  # The caller has checked the solver.
        contact_rules = (
            wheel.max_events,
            wheel.has_one_sided_stoppers,
            wheel.uses_paper_rule,
            self.is_detailed,
        )
        has_columns = wheel.uneven is not None, wheel.restitution is not None
        return BatchWalkSettings(
            params.n_legs, 1, *contact_rules, options, tableau, *has_columns, self.engine_name
        )

    def make_template(self, *leaves: Array) -> tuple:
        """Return zero arrays in the structure and shapes of `compute_outputs` for one wheel."""
        params = self.unpack_leaves(leaves)[2][1]
        return _partition_result(
            make_result_template(params.n_legs, leaves[0].dtype, self.is_detailed)
        )

    def compute_outputs(self, *leaves: Array) -> tuple:
        """Return the results of a step over lanes, split into floats and other arrays.

        The leaves have the lanes on their last axis.
        """
        input_columns, x, step_settings = self.unpack_leaves(leaves)
        return _partition_result(
            run_walks(self.make_walk_settings(step_settings), input_columns, x)
        )

    def compute_tangents(self, leaves: tuple[Array, ...], tangents: tuple[Array, ...]) -> tuple:
        """Return the tangents of the result's floats, the floats, and the other arrays.

        Each lane has one tangent of its leaves.
        """
        input_columns, x, step_settings = self.unpack_leaves(leaves)
        d_columns, d_x = (tangent_rows[None] for tangent_rows in self.unpack_leaves(tangents)[:2])
        n_tangents = jnp.ones_like(input_columns[0], jnp.int32)
        walk_result, result_tangents = walk_with_tangents(
            self.make_walk_settings(step_settings), input_columns, x, d_columns, d_x, n_tangents
        )
        result_tangents = jax.tree.map(lambda leaf: leaf[0], result_tangents)
        return _partition_result(walk_result._replace(step_result=result_tangents))[
            0
        ], *_partition_result(walk_result)


def _add_lane_axis(function: Callable) -> Callable:
    """Return a function over lanes as a function of arrays without the axis of lanes."""

    def evaluate_one_lane(*arrays: Any) -> Any:
        outputs = function(*jax.tree.map(lambda x: jnp.asarray(x)[..., None], arrays))
        return jax.tree.map(lambda x: x[..., 0], outputs)

    return evaluate_one_lane


def _partition_result(walk_result: BatchWalkResult) -> tuple[Any, Any]:
    """Return the results of a step, split into floats and other arrays.

    A detailed walk gives all results of the step. Any other walk gives section state, durations,
    outcome and number of solver steps.
    """
    step_result = walk_result.step_result
    if isinstance(step_result, StepSummary):
        step_result = (
            step_result.section_state,
            step_result.durations,
            walk_result.outcome,
            walk_result.n_solver_steps,
        )
    return eqx.partition(step_result, eqx.is_inexact_array)


def build_contact_step_function(config: ContactStepConfig) -> ForwardFunction:
    """Return a function from the leaves of (wheel, params, x, options) to the results of a step.

    The results are split into floats and other arrays. The function is a forward rule from which
    all AD modes are built.
    """
    cache_key = "step with unilateral contact", str(config.argument_structure), config.is_detailed
    return config.compile_function(config.compute_outputs, config.make_template, cache_key)


def build_contact_step_jacobian(
    config: ContactStepConfig, input_indices: tuple[int, ...]
) -> ForwardFunction:
    """Return a function that computes the Jacobian of the step of `build_contact_step_function`.

    The function returns (Jacobian with respect to the leaves at `input_indices`, float results) and
    the other results.
    """

    def make_template(leaves: tuple[Array, ...], _tangents: tuple[Array, ...]) -> tuple:
        float_outputs, other_outputs = config.make_template(*leaves)
        return float_outputs, float_outputs, other_outputs

    structure_name = str(config.argument_structure)
    cache_key = "step with unilateral contact along directions", structure_name, config.is_detailed
    compute_tangents = unbatch(
        compile_cached_lane_function(config.compute_tangents, make_template, cache_key)
    )

    def evaluate_jacobian(*leaves: Array) -> tuple:
        leaves = config.tighten_tolerances(leaves)
        unit_tangents = np.eye(sum(np.size(leaves[i]) for i in input_indices))
        tangents, leaf_offset = [jnp.zeros_like(leaf) for leaf in leaves], 0
        for i in input_indices:
            leaf_tangents = unit_tangents[
                :, leaf_offset : (leaf_offset := leaf_offset + np.size(leaves[i]))
            ]
            tangents[i] = jnp.asarray(
                leaf_tangents.reshape(-1, *jnp.shape(leaves[i])), leaves[i].dtype
            )
        batch_axes = tuple(0 if i in input_indices else None for i in range(len(leaves)))
        jacobian_columns, float_outputs, other_outputs = jax.vmap(
            compute_tangents, (None, batch_axes)
        )(leaves, tuple(tangents))
        float_outputs, other_outputs = jax.tree.map(lambda x: x[0], (float_outputs, other_outputs))
        return (
            split_jacobian_by_leaf(jacobian_columns, leaves, input_indices),
            float_outputs,
        ), other_outputs

    return evaluate_jacobian


class IntervalLog(NamedTuple):
    """Start state and duration of each interval of a step, between two events."""

    state: Array  # start of each interval, see `contact_state.PackedState`, (intervals, dim)
    contact: Array  # contact mode of every foot, (intervals, legs)
    locked: Array
    duration: Array  # s


class SampledIntervals(NamedTuple):
    """Intervals of a step, each sampled at equal times with both ends."""

    log: IntervalLog
    summary: StepSummary
    outcome: Array
    state: Array  # `contact_state.PackedState`, (intervals, samples, dim)
    tangential: Array  # force on every foot, N, (intervals, samples, legs)
    normal: Array


def sample_interval(
    dynamics: ModeDynamics,
    motion: WheelMotion,
    initial_accumulators: Array,
    duration: Array,
    n_samples: int,
    options: StepOptions,
    tableau: ButcherTableau,
) -> Array:
    """Return samples of one interval at equal times, both ends included, with axes (sample, row,
    lanes).

    The rows are coordinates, rates, accumulators that start at `initial_accumulators`, and normal
    and tangential forces of the slots.

    - `duration`: length of the interval, s.
    """
    initial_interval = init_interval(dynamics, motion, options.dt0)

    def take_sample_step(
        sample_state: tuple[IntervalPoint, Array], step_size: Array
    ) -> tuple[tuple[IntervalPoint, Array], Array]:
        start_point, accumulators = sample_state
        attempt = attempt_solver_step(
            dynamics, tableau, options, initial_interval._replace(point=start_point, h=step_size)
        )
        assert attempt.accumulator_increments is not None
        return (
            attempt.end_point,
            accumulators + attempt.accumulator_increments,
        ), attempt.squared_error

    def pack_sample(sample_state: tuple[IntervalPoint, Array]) -> Array:
        (q, v, dynamics_rows), accumulators = sample_state
        return jnp.concatenate([q, v, accumulators, dynamics_rows[len(q) : len(q) + 4]])

    return sample_at_equal_times(
        take_sample_step,
        pack_sample,
        (initial_interval.point, initial_accumulators),
        tableau,
        duration,
        n_samples,
        options,
    )


@functools.cache
def build_contact_step_sampler(
    config: ContactStepConfig, n_samples: int
) -> Callable[..., SampledIntervals]:
    """Return a function from the leaves of (wheel, params, x, options) to the sampled motion of a
    step.

    The function has no derivatives.
    """
    argument_structure, cache_key = config.argument_structure, str(config.argument_structure)

    def begin_lane(*leaves: Array) -> Any:
        input_columns, x, step_settings = config.unpack_leaves(leaves)
        return init_lane_states(config.make_walk_settings(step_settings), input_columns, x)[1]

    def advance_to_event(leaves: tuple[Array, ...], lane_state: Any) -> tuple[Any, IntervalLog]:
        input_columns, x, step_settings = config.unpack_leaves(leaves)
        walk_settings = config.make_walk_settings(step_settings)
        state_after_event, lane_state = process_and_integrate(
            walk_settings,
            walk_settings.replace_invalid(input_columns, x)[0],
            lane_state,
            waits_for_events=True,
        )
        assert state_after_event.step_accumulators is not None
        (point, contact_state), zero_time = (
            (state_after_event.interval.point, state_after_event.interval.contact_state),
            jnp.zeros_like(lane_state.interval.time),
        )
        state = pack_state(
            motion_from_point(point), Accumulators(zero_time, *state_after_event.step_accumulators)
        )
        return lane_state, IntervalLog(
            state, contact_state.contact_modes, contact_state.locked, lane_state.interval.time
        )

    def make_logged_dynamics(
        leaves: tuple[Array, ...], log: IntervalLog
    ) -> tuple[BatchWalkSettings, ModeDynamics]:
        input_columns, x, step_settings = config.unpack_leaves(leaves)
        walk_settings, no_leg_flags = config.make_walk_settings(step_settings), log.locked & False
        contact_state = ContactState(
            log.contact, log.locked, no_leg_flags, no_leg_flags, no_leg_flags
        )
        return walk_settings, walk_settings.make_dynamics(
            walk_settings.replace_invalid(input_columns, x)[0], contact_state
        )

    def sample_with_diffrax(leaves: tuple[Array, ...], log: IntervalLog) -> tuple:
        walk_settings, dynamics = make_logged_dynamics(leaves, log)
        return sample_by_diffrax(
            dynamics, log.state, log.duration, n_samples, walk_settings.options
        )

    def sample_intervals(leaves: tuple[Array, ...], log: IntervalLog) -> Array:
        walk_settings, dynamics = make_logged_dynamics(leaves, log)
        motion, accumulators = unpack_state(log.state)
        assert walk_settings.tableau is not None
        sampling_arguments = (
            jnp.stack(accumulators[1:]),
            log.duration,
            n_samples,
            walk_settings.options,
            walk_settings.tableau,
        )
        return sample_interval(dynamics, motion, *sampling_arguments)

    def sample_whole_step(*leaves: Array) -> SampledIntervals:
        wheel, params, *_ = jax.tree.unflatten(argument_structure, leaves)
        initial_state = compiled_start(*leaves)
        log_template = jax.eval_shape(compiled_advance, leaves, initial_state)[1]
        allocate = lambda leaf: jnp.zeros((wheel.max_events, *leaf.shape), leaf.dtype)

        def record_interval_end(state: tuple) -> tuple:
            previous_state, interval_log = state
            lane_state, interval_entry = compiled_advance(leaves, previous_state)
            entry_index = previous_state.counters.n_events
            entry_index = jnp.where(
                lane_state.counters.n_events > entry_index, entry_index, wheel.max_events
            )
            write_entry = lambda log_leaf, entry_leaf: log_leaf.at[entry_index].set(
                entry_leaf, mode="drop"
            )
            return lane_state, jax.tree.map(write_entry, interval_log, interval_entry)

        should_continue = lambda state: make_opaque_condition(
            state[0].outcome == STATUS_UNFINISHED, state[0].counters.n_events
        )
        lane_state, interval_log = lax.while_loop(
            should_continue,
            record_interval_end,
            (initial_state, jax.tree.map(allocate, log_template)),
        )
        final_state = (
            motion_from_point(lane_state.interval.point),
            lane_state.interval.contact_state,
        )
        input_columns, _, step_settings = config.unpack_leaves(leaves)
        walk_settings = config.make_walk_settings(step_settings)
        summary = walk_settings.summarize_step(
            final_state, lane_state.counters, lane_state.outcome, walk_settings.tilt(input_columns)
        )
        if config.uses_diffrax:
            samples = lax.map(lambda log: sample_with_diffrax(leaves, log), interval_log)
        else:
            sample_rows = jax.vmap(lambda log: compiled_sampling(leaves, log))(interval_log)
            samples = _unpack_sample_rows(params.n_legs, interval_log, sample_rows)
        return SampledIntervals(interval_log, summary, lane_state.outcome, *samples)

    compiled_start = config.compile_function(
        begin_lane, begin_lane, ("start with unilateral contact", cache_key)
    )
    make_template = lambda leaves, lane: (lane, IntervalLog(*(lane.interval.time,) * 4))
    compiled_advance = config.compile_function(
        advance_to_event, make_template, ("to the next event", cache_key)
    )
    compiled_sampling = unbatch(
        compile_cached_lane_function(
            sample_intervals,
            lambda leaves, log: log.duration,
            ("samples with unilateral contact", cache_key, n_samples),
        )
    )
    return jax.jit(sample_whole_step)


def _unpack_sample_rows(n: int, log: IntervalLog, sample_rows: Array) -> tuple[Array, Array, Array]:
    """Return the rows of `sample_interval` as packed states, and tangential and normal forces of
    all legs.

    The axes are (intervals, samples, entries), with forces in N.
    """
    n_samples, n_coordinates = sample_rows.shape[1], 3 + n
    time_since_event = jnp.linspace(0.0, 1.0, n_samples) * log.duration[:, None]
    q, v, accumulators, forces = jnp.split(
        sample_rows, (n_coordinates, 2 * n_coordinates, 2 * n_coordinates + 3), -1
    )
    state_parts = [
        q[..., :3],
        v[..., :3],
        q[..., 3:],
        v[..., 3:],
        time_since_event[..., None],
        accumulators,
    ]
    contact_slots = jax.vmap(lambda contact: find_slots(contact != ContactMode.OFF))(log.contact)
    scatter_to_legs = jax.vmap(
        jax.vmap(lambda contact_slots, slot_pair: contact_slots.scatter(slot_pair), (None, 0))
    )
    normal, tangential = (scatter_to_legs(contact_slots, forces[..., i : i + 2]) for i in (0, 2))
    return jnp.concatenate(state_parts, -1), tangential, normal
