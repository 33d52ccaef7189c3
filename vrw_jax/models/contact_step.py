"""Compute steps of one wheel with unilateral contact, by machine code or by diffrax.

`jax.vmap` maps the compiled functions of one wheel to batch elements. For derivatives, each tangent
has its own batch element in addition to that of the motion. To sample a step, a JAX program
advances from event to event and records the start of each interval. Every interval is then
integrated again, from sample to sample.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jax.flatten_util import ravel_pytree
from jaxtyping import Array

from vrw_jax import lanes
from vrw_jax.base.elementwise import make_opaque_loop_condition
from vrw_jax.base.options import StepOptions
from vrw_jax.flow.phase_integration import sample_phase
from vrw_jax.flow.solver_steps import (
    ButcherTableau,
    StageState,
    divide_equally,
    load_explicit_tableau,
    sample_between_intervals,
)
from vrw_jax.models.contact_integrator import make_contact_phase
from vrw_jax.models.contact_kernel import (
    BatchWalkResult,
    BatchWalkSettings,
    advance_to_events,
    init_lane_states,
    run_walks,
)
from vrw_jax.models.contact_mechanics import (
    find_contact_slots,
    pack_motion,
    unpack_motion,
)
from vrw_jax.models.contact_record import GaitStepSummary
from vrw_jax.models.contact_state import (
    N_LOSSES,
    ContactModeDynamics,
    ContactQuantities,
    ContactState,
    EnergyLossAccumulators,
    compute_contact_quantities,
    compute_packed_units,
    evaluate_vector_field,
    pack_state,
    unpack_state,
)
from vrw_jax.models.contact_tangents import walk_with_tangents
from vrw_jax.wheel.outcomes import ContactMode
from vrw_jax.wheel.params import WheelParams, compute_wheel_units, stack_parameters


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
    tableau = None if uses_diffrax else load_explicit_tableau(options.solver)
    assert uses_diffrax or tableau is not None  # The caller has checked the solver.
    walk_settings = BatchWalkSettings(
        params.n_legs,
        1,
        wheel.max_events,
        wheel.has_one_sided_stoppers,
        wheel.uses_paper_rule,
        is_detailed,
        options,
        tableau,
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


class ContactIntervalLog(NamedTuple):
    """Start and duration of each interval of a step; an interval is between two events."""

    q: Array  # coordinates at the start of each interval, (intervals, 3 + n)
    v: Array  # rates and losses in the step so far, (intervals, 3 + n + N_LOSSES)
    contact_state: ContactState
    durations: Array  # s


def sample_contact_interval(
    contact_mode_dynamics: ContactModeDynamics,
    q: Array,
    v: Array,
    duration: Array,
    n_samples: int,
    options: StepOptions,
    tableau: ButcherTableau,
) -> Array:
    """Return samples of one interval at equally spaced times, (samples, entries, batch).

    The first and the last sample are at the ends of the interval. The entries are coordinates,
    rates, losses, normal forces and tangential forces in the contact slots.

    - `q`, `v`: coordinates, and rates followed by losses at the start;
    - `duration`: length of the interval, s.
    """
    phase = make_contact_phase(contact_mode_dynamics, tableau, options)
    take_solver_step: Any = phase.take_solver_step

    def take_sample_step(state: StageState, h: Array) -> tuple[StageState, Array]:
        stage_states, squared_error = take_solver_step(state, h)
        return stage_states[-1], squared_error

    def pack_sample(state: StageState) -> Array:
        contact_quantities = ContactQuantities.unpack_rows(
            contact_mode_dynamics, state.acceleration.acceleration
        )
        slot_forces = contact_quantities.normal_forces, contact_quantities.tangential_forces
        return jnp.concatenate([state.q, state.v, *slot_forces])

    return sample_between_intervals(
        take_sample_step,
        pack_sample,
        phase.make_state(q, v),
        tableau,
        divide_equally(duration, n_samples),
        options,
    )


def sample_by_diffrax(
    contact_mode_dynamics: ContactModeDynamics,
    q: Array,
    v: Array,
    duration: Array,
    n_samples: int,
    options: StepOptions,
) -> Array:
    """Return the samples of `sample_contact_interval` for a single wheel, (samples, entries)."""
    losses = EnergyLossAccumulators(jnp.zeros_like(duration), *v[len(q) :])

    def pack_sample(packed_state: Array) -> Array:
        motion, (_, *losses) = unpack_state(packed_state)
        contact_quantities = compute_contact_quantities(contact_mode_dynamics, motion)
        slot_forces = contact_quantities.normal_forces, contact_quantities.tangential_forces
        return jnp.concatenate([*pack_motion(motion), jnp.stack(losses), *slot_forces])

    packed_states = sample_phase(
        functools.partial(evaluate_vector_field, contact_mode_dynamics),
        pack_state(unpack_motion(q, v), losses),
        duration,
        n_samples,
        compute_wheel_units(contact_mode_dynamics.s).scale_times_to_seconds(options),
        compute_packed_units(contact_mode_dynamics.s),
    )
    return jax.vmap(pack_sample)(packed_states)


@functools.cache
def build_contact_step_sampler(uses_diffrax: bool, n_samples: int) -> Callable[..., tuple]:
    """Return a function that samples a step from (wheel, params, x, options).

    The function returns (log, summary and outcome of the step, states, tangential forces, normal
    forces). The states are packed, (intervals, samples, entries), and the forces on all feet are in
    N, (intervals, samples, legs). The samples are at equally spaced times from the start to the end
    of each interval. The function has no derivatives.
    """

    prepare = functools.partial(prepare_walk, True, "lanes", False, uses_diffrax)

    def prepare_resolved(arguments: tuple) -> tuple:
        walk_settings, input_columns, x = prepare(*arguments)
        return walk_settings, walk_settings.resolve_heights(input_columns, x), x

    init_lane_state = lambda *arguments: init_lane_states(*prepare_resolved(arguments))[1]

    def advance_to_event(arguments: tuple, lane_state: Any) -> tuple[Any, ContactIntervalLog]:
        walk_settings, input_columns, x = prepare_resolved(arguments)
        start, lane_state = advance_to_events(
            walk_settings, walk_settings.replace_invalid_lanes(input_columns, x)[0], lane_state
        )
        n = len(start.q)
        return lane_state, ContactIntervalLog(
            start.q,
            jnp.concatenate([start.v[:n], start.step_record.losses]),
            start.contact_state,
            lane_state.interval_duration,
        )

    def sample_logged_interval(arguments: tuple, interval_log: ContactIntervalLog) -> Array:
        walk_settings, input_columns, x = prepare_resolved(arguments)
        q, v, contact_state, durations = interval_log
        dynamics = walk_settings.make_lane_contact_dynamics(
            walk_settings.replace_invalid_lanes(input_columns, x)[0], contact_state
        )
        arguments = dynamics, q, v, durations, n_samples, walk_settings.step_options
        if walk_settings.tableau is None:
            return sample_by_diffrax(*arguments)
        return sample_contact_interval(*arguments, walk_settings.tableau)

    def sample_whole_step(*arguments: Any) -> tuple:
        walk_settings, input_columns, _ = prepare_resolved(arguments)
        max_events = walk_settings.max_events
        initial_state = begin_compiled_walk(*arguments)
        log_template = jax.eval_shape(advance_compiled_walk, arguments, initial_state)[1]
        allocate_log_array = lambda leaf: jnp.zeros((max_events, *leaf.shape), leaf.dtype)

        def record_interval_end(loop_state: tuple) -> tuple:
            previous_state, contact_interval_log = loop_state
            lane_state, interval_entry = advance_compiled_walk(arguments, previous_state)
            entry_index = previous_state.step_record.events
            entry_index = jnp.where(
                lane_state.step_record.events > entry_index, entry_index, max_events
            )
            write_log_entry = lambda log_leaf, entry_leaf: log_leaf.at[entry_index].set(
                entry_leaf, mode="drop"
            )
            return lane_state, jax.tree.map(write_log_entry, contact_interval_log, interval_entry)

        should_continue = lambda state: make_opaque_loop_condition(
            state[0].is_unfinished, state[0].step_record.events
        )
        lane_state, contact_interval_log = lax.while_loop(
            should_continue,
            record_interval_end,
            (initial_state, jax.tree.map(allocate_log_array, log_template)),
        )
        step_summary = walk_settings.summarize_step(lane_state, input_columns)
        map_intervals = lax.map if uses_diffrax else lambda f, log: jax.vmap(f)(log)
        sample_rows = map_intervals(
            functools.partial(sample_compiled_intervals, arguments), contact_interval_log
        )
        interval_samples = _unpack_sample_rows(
            walk_settings.n_legs, contact_interval_log, sample_rows
        )
        return contact_interval_log, step_summary, lane_state.walk_outcome, *interval_samples

    compile_lanes = call_with_one_lane if uses_diffrax else lanes.jit_batch
    begin_compiled_walk = compile_lanes(init_lane_state)
    advance_compiled_walk = compile_lanes(advance_to_event)
    sample_compiled_intervals = (
        sample_logged_interval if uses_diffrax else lanes.jit_batch(sample_logged_interval)
    )
    return jax.jit(sample_whole_step)


def _unpack_sample_rows(
    n_legs: int, contact_interval_log: ContactIntervalLog, sample_rows: Array
) -> tuple[Array, Array, Array]:
    """Return packed states, tangential forces (N) and normal forces (N) of all legs, from samples.

    The axes are (intervals, samples, entries). `sample_rows` contains results of
    `sample_contact_interval`.
    """
    n, n_samples = 3 + n_legs, sample_rows.shape[1]
    q, v, losses, normal_forces, tangential_forces = jnp.split(
        jnp.moveaxis(sample_rows, -1, 0), (n, 2 * n, 2 * n + N_LOSSES, 2 * n + N_LOSSES + 2)
    )
    time_since_event = jnp.linspace(0.0, 1.0, n_samples) * contact_interval_log.durations[:, None]
    packed_states = pack_state(
        unpack_motion(q, v), EnergyLossAccumulators(time_since_event, *losses)
    )
    contact_modes = contact_interval_log.contact_state.contact_modes.T[..., None]
    scatter_to_legs = find_contact_slots(contact_modes != ContactMode.OFF).scatter_to_legs
    legs_first = packed_states, scatter_to_legs(tangential_forces), scatter_to_legs(normal_forces)
    return tuple(jnp.moveaxis(x, 0, -1) for x in legs_first)  # type: ignore[return-value]
