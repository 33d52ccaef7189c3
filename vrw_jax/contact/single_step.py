"""One wheel with unilateral contact, by the machine code of the batch kernel within JAX programs.

`build_contact_step_function` returns a function of one wheel that `jax.vmap` maps onto lanes. For
derivatives, each tangent is a lane of its own beside the wheel's motion. For samples of a step, a
JAX program advances from event to event and records the start of each interval. Then every interval
becomes a lane that is integrated again, sample by sample.
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
    attempt_step,
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
from vrw_jax.contact.mechanics import WheelMotion, find_slots
from vrw_jax.contact.walk_kernel import (
    STATUS_UNFINISHED,
    BatchWalk,
    BatchWalkResult,
    StepSummary,
    advance_round,
    init_lanes,
    make_result_template,
    run_walks,
)
from vrw_jax.contact.walk_tangents import walk_with_tangents
from vrw_jax.integrator import ButcherTableau, load_explicit_tableau, sample_at_equal_times
from vrw_jax.models import split_jacobian
from vrw_jax.numerics import ForwardFunction, StepOptions, unbatch
from vrw_jax.runtime import cached_lane_function
from vrw_jax.wheel import stack_parameters


class ContactStepConfig(NamedTuple):
    """Static configuration of a step."""

    structure: Any  # of (wheel, params, x, options), whose leaves are the arrays
    is_detailed: bool

    def unpack(self, leaves: tuple[Array, ...]) -> tuple[Array, Array, Any]:
        """Return columns and section states of lanes, and the other settings."""
        wheel, params, x, options = jax.tree.unflatten(self.structure, leaves)
        more = () if wheel.uneven is None else wheel.uneven
        columns = jnp.stack([*stack_parameters(params), wheel.friction, *more])
        return columns, x, (wheel, params, options)

    def make_walk(self, settings: Any) -> BatchWalk:
        """Return the batch settings of a walk of one step."""
        wheel, params, options = settings
        tableau = load_explicit_tableau(options.solver)
        assert tableau is not None  # checked by the caller
        rules = (
            wheel.max_events,
            wheel.has_one_sided_stoppers,
            wheel.uses_paper_rule,
            self.is_detailed,
        )
        return BatchWalk(params.n_legs, 1, *rules, options, tableau, wheel.uneven is not None)

    def make_template(self, *leaves: Array) -> tuple:
        """Return arrays in the structure of `compute_outputs`."""
        params = self.unpack(leaves)[2][1]
        return _partition_result(
            make_result_template(params.n_legs, leaves[0].dtype, self.is_detailed)
        )

    def compute_outputs(self, *leaves: Array) -> tuple:
        """Return the result over lanes, which the leaves have on their last axis."""
        columns, x, settings = self.unpack(leaves)
        return _partition_result(run_walks(self.make_walk(settings), columns, x))

    def compute_tangents(self, leaves: tuple[Array, ...], tangents: tuple[Array, ...]) -> tuple:
        """Return the tangents of the result's floats for one tangent of each lane, the floats, and
        the rest.
        """
        columns, x, settings = self.unpack(leaves)
        d_columns, d_x = (rows[None] for rows in self.unpack(tangents)[:2])
        n_tangents = jnp.ones_like(columns[0], jnp.int32)
        walk, result_tangents = walk_with_tangents(
            self.make_walk(settings), columns, x, d_columns, d_x, n_tangents
        )
        result_tangents = jax.tree.map(lambda leaf: leaf[0], result_tangents)
        return _partition_result(walk._replace(step_result=result_tangents))[0], *_partition_result(
            walk
        )


def _partition_result(walk: BatchWalkResult) -> tuple[Any, Any]:
    """Return floats and other parts of a step: of the full result, or of the four minimal ones."""
    step = walk.step_result
    if isinstance(step, StepSummary):
        step = step.section_state, step.durations, walk.outcome, walk.n_solver_steps
    return eqx.partition(step, eqx.is_inexact_array)


def build_contact_step_function(structure: Any, is_detailed: bool) -> ForwardFunction:
    """Return the step over the leaves of (wheel, params, x, options), as a forward rule for any AD
    mode.
    """
    config = ContactStepConfig(structure, is_detailed)
    cache_key = "step on real ground", str(structure), is_detailed
    return unbatch(cached_lane_function(config.compute_outputs, config.make_template, cache_key))


def build_contact_step_jacobian(
    structure: Any, is_detailed: bool, input_indices: tuple[int, ...]
) -> ForwardFunction:
    """Return the Jacobian of `build_contact_step_function`.

    It gives (Jacobian with respect to the leaves at `input_indices`, floats) and the other outputs.
    """
    config = ContactStepConfig(structure, is_detailed)

    def make_template(leaves: tuple[Array, ...], _tangents: tuple[Array, ...]) -> tuple:
        value, aux = config.make_template(*leaves)
        return value, value, aux

    cache_key = "step on real ground along directions", str(structure), is_detailed
    compute_tangents = unbatch(
        cached_lane_function(config.compute_tangents, make_template, cache_key)
    )

    def evaluate_jacobian(*leaves: Array) -> tuple:
        *settings, options = jax.tree.unflatten(structure, leaves)
        leaves = tuple(jax.tree.leaves((*settings, options.with_derivative_tolerances())))
        units = np.eye(sum(np.size(leaves[i]) for i in input_indices))
        tangents, offset = [jnp.zeros_like(leaf) for leaf in leaves], 0
        for i in input_indices:
            rows = units[:, offset : (offset := offset + np.size(leaves[i]))]
            tangents[i] = jnp.asarray(rows.reshape(-1, *jnp.shape(leaves[i])), leaves[i].dtype)
        axes = tuple(0 if i in input_indices else None for i in range(len(leaves)))
        columns, value, aux = jax.vmap(compute_tangents, (None, axes))(leaves, tuple(tangents))
        value, aux = jax.tree.map(lambda x: x[0], (value, aux))
        return (split_jacobian(columns, leaves, input_indices), value), aux

    return evaluate_jacobian


class IntervalLog(NamedTuple):
    """Start and duration of each interval of a step between two events."""

    state: Array  # (intervals, dim), see `contact_state.PackedState`
    contact: Array  # (intervals, legs)
    locked: Array
    duration: Array  # s


class SampledIntervals(NamedTuple):
    """Intervals at equal times, both ends included."""

    log: IntervalLog
    ends: StepSummary
    outcome: Array
    state: Array  # (intervals, samples, dim)
    tangential: Array  # on every foot, N, (intervals, samples, legs)
    normal: Array


def sample_interval(
    dynamics: ModeDynamics,
    motion: WheelMotion,
    accumulated: Array,
    duration: Array,
    n_samples: int,
    options: StepOptions,
    tableau: ButcherTableau,
) -> Array:
    """Return one interval at equal times, ends included, with axes (sample, ., lanes).

    The rows are coordinates, rates, accumulators starting at `accumulated`, and normal and
    tangential forces of the slots.
    """
    initial = init_interval(dynamics, motion, options.dt0)

    def take_sample_step(
        sample: tuple[IntervalPoint, Array], length: Array
    ) -> tuple[tuple[IntervalPoint, Array], Array]:
        point, accumulated = sample
        attempt = attempt_step(dynamics, tableau, options, initial._replace(point=point, h=length))
        assert attempt.accumulated is not None
        return (attempt.end, accumulated + attempt.accumulated), attempt.squared_error

    def rows(sample: tuple[IntervalPoint, Array]) -> Array:
        (q, v, dynamics_rows), accumulated = sample
        return jnp.concatenate([q, v, accumulated, dynamics_rows[len(q) : len(q) + 4]])

    return sample_at_equal_times(
        take_sample_step, rows, (initial.point, accumulated), tableau, duration, n_samples, options
    )


@functools.cache
def build_contact_step_sampler(structure: Any, n_samples: int) -> Callable[..., SampledIntervals]:
    """Return the sampled motion of a step over the leaves of (wheel, params, x, options).

    It has no derivatives.
    """
    config = ContactStepConfig(structure, True)
    cache_key = str(structure)

    def begin_lane(*leaves: Array) -> Any:
        columns, x, settings = config.unpack(leaves)
        return init_lanes(config.make_walk(settings), columns, x)[1]

    def advance_to_event(leaves: tuple[Array, ...], lane: Any) -> tuple[Any, IntervalLog]:
        columns, x, settings = config.unpack(leaves)
        walk = config.make_walk(settings)
        processed, lane = advance_round(
            walk, walk.replace_invalid(columns, x)[0], lane, waits_for_events=True
        )
        assert processed.accumulators is not None
        (point, contact_state), zero = (
            (processed.interval.point, processed.interval.contact_state),
            jnp.zeros_like(lane.interval.time),
        )
        state = pack_state(motion_from_point(point), Accumulators(zero, *processed.accumulators))
        return lane, IntervalLog(
            state, contact_state.contact, contact_state.locked, lane.interval.time
        )

    def sample_intervals(leaves: tuple[Array, ...], log: IntervalLog) -> Array:
        columns, x, settings = config.unpack(leaves)
        walk, no_legs = config.make_walk(settings), log.locked & False
        contact_state = ContactState(log.contact, log.locked, no_legs, no_legs, no_legs)
        motion, accumulators = unpack_state(log.state)
        dynamics = walk.make_dynamics(walk.replace_invalid(columns, x)[0], contact_state)
        arguments = jnp.stack(accumulators[1:]), log.duration, n_samples, walk.options, walk.tableau
        return sample_interval(dynamics, motion, *arguments)

    def run(*leaves: Array) -> SampledIntervals:
        wheel, params, *_ = jax.tree.unflatten(structure, leaves)
        initial = begin_compiled(*leaves)
        log_template = jax.eval_shape(advance_compiled, leaves, initial)[1]
        allocate = lambda leaf: jnp.zeros((wheel.max_events, *leaf.shape), leaf.dtype)

        def record_interval_end(state: tuple) -> tuple:
            previous, log = state
            lane, row = advance_compiled(leaves, previous)
            index = previous.counters.n_events
            index = jnp.where(lane.counters.n_events > index, index, wheel.max_events)
            write_row = lambda old, new: old.at[index].set(new, mode="drop")
            return lane, jax.tree.map(write_row, log, row)

        should_continue = lambda state: state[0].outcome == STATUS_UNFINISHED
        lane, log = lax.while_loop(
            should_continue, record_interval_end, (initial, jax.tree.map(allocate, log_template))
        )
        final_state = motion_from_point(lane.interval.point), lane.interval.contact_state
        columns, _, others = config.unpack(leaves)
        walk = config.make_walk(others)
        summary = walk.summarize(final_state, lane.counters, lane.outcome, walk.tilt(columns))
        rows = jax.vmap(lambda log: sample_compiled(leaves, log))(log)
        return SampledIntervals(
            log, summary, lane.outcome, *_unpack_samples(params.n_legs, log, rows)
        )

    begin_compiled = unbatch(
        cached_lane_function(begin_lane, begin_lane, ("start on real ground", cache_key))
    )
    make_template = lambda leaves, lane: (lane, IntervalLog(*(lane.interval.time,) * 4))
    advance_compiled = unbatch(
        cached_lane_function(advance_to_event, make_template, ("to the next event", cache_key))
    )
    sample_compiled = unbatch(
        cached_lane_function(
            sample_intervals,
            lambda leaves, log: log.duration,
            ("samples on real ground", cache_key, n_samples),
        )
    )
    return jax.jit(run)


def _unpack_samples(n: int, log: IntervalLog, rows: Array) -> tuple[Array, Array, Array]:
    """Return rows of `sample_interval` as packed states, and tangential and normal forces of all
    legs.
    """
    n_samples, size = rows.shape[1], 3 + n
    clock = jnp.linspace(0.0, 1.0, n_samples) * log.duration[:, None]
    q, v, accumulators, forces = jnp.split(rows, (size, 2 * size, 2 * size + 3), -1)
    state = [q[..., :3], v[..., :3], q[..., 3:], v[..., 3:], clock[..., None], accumulators]
    slots = jax.vmap(lambda contact: find_slots(contact != ContactMode.OFF))(log.contact)
    scatter_to_legs = jax.vmap(jax.vmap(lambda slots, pair: slots.scatter(pair), (None, 0)))
    normal, tangential = (scatter_to_legs(slots, forces[..., i : i + 2]) for i in (0, 2))
    return jnp.concatenate(state, -1), tangential, normal
