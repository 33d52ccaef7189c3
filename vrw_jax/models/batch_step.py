"""Batches of steps computed with the paper's model, as values and as derivatives.

The same source is compiled to machine code and runs on GPUs. The phases are those of the diffrax
engine. Each array holds one quantity for all wheels. `build_step_function` returns a function for
one wheel. Under `jax.vmap`, this function runs once for the whole batch.
"""

import dataclasses
import functools
import math
import operator
from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool

from vrw_jax import lanes
from vrw_jax.base.options import StepOptions
from vrw_jax.base.trigonometry import compute_sine_cosine
from vrw_jax.base.types import Vector
from vrw_jax.flow.integrate import integrate_batch_phase, sample_batch_phase
from vrw_jax.flow.tableaus import (
    ButcherTableau,
    StageAccelerations,
    StageState,
    load_explicit_tableau,
)
from vrw_jax.flow.tangents import BatchPhase, ImplicitDynamics, with_batched_jvp
from vrw_jax.lanes.autodiff import ForwardFunction
from vrw_jax.lanes.batching import BatchFunction, unbatch
from vrw_jax.lanes.lane_function import compile_batch_function
from vrw_jax.models.phase_sequence import (
    PhaseResult,
    PhaseRunner,
    PhaseSequenceResult,
    finish_gait_step,
    make_advance_result,
    make_step_result,
    make_trajectory,
    run_step_phases,
)
from vrw_jax.models.step_results import AdvanceResult, Trajectory
from vrw_jax.wheel import transitions
from vrw_jax.wheel.geometry import Motion
from vrw_jax.wheel.params import PARAMETER_NAMES, WheelParams, compute_wheel_units
from vrw_jax.wheel.phases import AbstractPhase, PhaseInstant


class _NextPhaseInputs(NamedTuple):
    """Data that the integration of a phase passes to the integration of the next phase."""

    next_solver_dt: Array  # step size that the controller proposes next, s
    has_phase_occurred: Bool[Array, " lanes"]  # whether the phase took place
    is_unfinished: Bool[Array, " lanes"]


def make_batch_phase(
    phase: AbstractPhase, records_margins: bool, is_compiled_separately: bool = False
) -> BatchPhase:
    """Return the functions that the batched integrator needs to integrate a phase.

    - `records_margins`: whether the integrator also evaluates margins;
    - `is_compiled_separately`: whether machine code calls the phase's functions instead of inlining
      them.
    """

    def evaluate_acceleration(q: Vector, v: Vector) -> StageAccelerations:
        sin_theta, cos_theta = compute_sine_cosine(q[0])
        return StageAccelerations(
            sin_theta,
            cos_theta,
            phase.solve_acceleration(phase.complete_wheel_motion(sin_theta, cos_theta, q, v))[
                : phase.n_dof
            ],
        )

    def complete_motion_at_stage(stage_state: StageState) -> Motion:
        return phase.complete_wheel_motion(
            stage_state.acceleration.sin, stage_state.acceleration.cos, stage_state.q, stage_state.v
        )

    def make_phase_instant(stage_state: StageState) -> PhaseInstant:
        return PhaseInstant(
            phase, complete_motion_at_stage(stage_state), stage_state.acceleration.acceleration
        )

    implicit_dynamics = ImplicitDynamics(
        lambda stage: phase.compute_dynamics_residual(
            complete_motion_at_stage(stage), stage.acceleration.acceleration
        ),
        lambda stage, right_hand_side: phase.solve_dynamics(
            complete_motion_at_stage(stage), right_hand_side
        ),
    )
    return BatchPhase(
        evaluate_acceleration,
        lambda stage: phase.compute_guards(make_phase_instant(stage)),
        lambda stage: phase.compute_margins(make_phase_instant(stage)),
        phase.are_margins_counted_at_start if records_margins else (),
        implicit_dynamics,
        is_compiled_separately,
        phase.coordinate_units,
    )


def advance_gait_step(
    params: WheelParams,
    x: Vector,
    options: StepOptions,
    tableau: ButcherTableau,
    stop_at_lift_off: bool,
    straggler_count: Array | None = None,
) -> tuple[AdvanceResult, Array]:
    """Compute one walking step per batch element, without indicators, margins and energies.

    Return the results, and flags of the elements that were stopped as stragglers. No result of
    these elements is valid.

    - `x`: section state of each batch element just before touchdown;
    - `tableau`: Butcher tableau of the explicit solver;
    - `stop_at_lift_off`: see `ViscoelasticWheel`;
    - `straggler_count`: largest number of batch elements that may remain unfinished, see
      `integrate_batch_phase`.
    """
    phase_sequence = run_batch_phases(
        params,
        x,
        options,
        tableau,
        stop_at_lift_off,
        records_margins=False,
        straggler_count=straggler_count,
    )
    is_phase_unfinished = [
        phase_end.next_phase_inputs.is_unfinished for phase_end in phase_sequence.phase_end_results
    ]
    return make_advance_result(phase_sequence, "lanes"), functools.reduce(
        operator.or_, is_phase_unfinished
    )


def run_batch_phases(
    params: WheelParams,
    x: Vector,
    options: StepOptions,
    tableau: ButcherTableau,
    stop_at_lift_off: bool,
    records_margins: bool,
    straggler_count: Array | None = None,
    is_compiled_separately: bool = False,
) -> PhaseSequenceResult:
    """Integrate all phases of one walking step per batch element and return their starts and ends.

    - `tableau`: Butcher tableau of the explicit solver;
    - `stop_at_lift_off`: see `ViscoelasticWheel`;
    - `records_margins`: whether the minima of the margins are computed;
    - `straggler_count`: largest number of batch elements that may remain unfinished, see
      `integrate_batch_phase`;
    - `is_compiled_separately`: see `BatchPhase`.
    """
    phase_runner = _make_phase_runner(
        options, tableau, records_margins, straggler_count, is_compiled_separately
    )
    landing_function = with_batched_jvp(transitions.resolve_landing)
    return run_step_phases(phase_runner, params, x, options, stop_at_lift_off, landing_function)


# Upper bound on the first solver step in SLS-I, as a fraction of the step size that the controller
# proposes at the end of DLS. At lift-off the rear foot loses its force. This excites the fast mode
# of the airborne leg, which decays within 0.05 s. A first solver step above this bound and the next
# would be rejected and repeated.
MAX_FIRST_STEP_RATIO = 0.3
# Upper bound on that step as a multiple of (m/c) rtol^(1/p), where p is the order of the solver.
# The value is chosen because the step-size controller settles at 7.2 to 9.5. This holds for solvers
# of orders 5 to 8 and tolerances of 1e-4 to 1e-10.
MAX_FIRST_STEP_IN_TRANSIENT_TIMES = 7.0


def _make_phase_runner(
    options: StepOptions,
    tableau: ButcherTableau,
    records_margins: bool,
    straggler_count: Array | None,
    is_compiled_separately: bool,
) -> PhaseRunner:
    """Return a function that integrates one phase to its end, for all batch elements.

    The arguments are those of `run_batch_phases`.
    """

    def run_phase(
        phase: AbstractPhase,
        q: Vector,
        v: Vector,
        is_active_lane: Array,
        previous_phase_end: PhaseResult | None,
    ) -> PhaseResult:
        scaled_options = compute_wheel_units(phase.s).scale_times_to_seconds(options)
        dt0 = scaled_options.dt0 + jnp.zeros_like(q[0])
        if previous_phase_end is not None:
            next_phase_inputs = previous_phase_end.next_phase_inputs
            dt0 = next_phase_inputs.next_solver_dt
            if phase.has_stiff_start:
                tolerance_root = jnp.exp(
                    jnp.log(options.rtol.astype(jnp.float32)) / tableau.convergence_order
                ).astype(dt0.dtype)
                max_transient_dt = (
                    MAX_FIRST_STEP_IN_TRANSIENT_TIMES * tolerance_root * phase.s.m / phase.s.c
                )
                stiff_dt0 = jnp.minimum(MAX_FIRST_STEP_RATIO * dt0, max_transient_dt)
                dt0 = jnp.where(next_phase_inputs.has_phase_occurred, stiff_dt0, dt0)
        float_leaves, nonarray_leaves = eqx.partition((phase.s, phase.ground_ahead), eqx.is_array)

        def make_phase(float_leaves: Any, phase_constants: Vector) -> BatchPhase:
            s, ground_ahead = eqx.combine(float_leaves, nonarray_leaves)
            phase_with_traced_inputs = dataclasses.replace(
                phase, s=s, phase_constants=phase_constants, ground_ahead=ground_ahead
            )
            return make_batch_phase(
                phase_with_traced_inputs, records_margins, is_compiled_separately
            )

        phase_end = integrate_batch_phase(
            make_phase,
            float_leaves,
            phase.phase_constants,
            tableau,
            q,
            v,
            is_active_lane,
            dt0,
            scaled_options,
            straggler_count,
        )
        return PhaseResult(
            *phase_end.state[:2],
            duration=phase_end.duration,
            end_guard_index=phase_end.end_guard_index,
            is_timed_out=phase_end.is_timed_out,
            n_solver_steps=phase_end.n_tried_steps,
            margin_minima=phase_end.margin_minima,
            next_phase_inputs=_NextPhaseInputs(
                phase_end.next_solver_dt, is_active_lane, phase_end.is_unfinished
            ),
        )

    return run_phase


def can_use_batch_kernel(options: StepOptions) -> bool:
    """Return whether the batch kernel can compute the step.

    The kernel requires machine code and an explicit solver. Raise a `ValueError` if the options
    require the batch kernel and it is not available.
    """
    is_solver_explicit = load_explicit_tableau(options.solver) is not None
    if options.engine == "lanes" and not (is_solver_explicit and lanes.is_machine_code_available()):
        raise ValueError(
            "engine is 'lanes', which needs a CPU, llvmlite and an explicit solver, but the solver "
            f"is {options.solver} on a {jax.default_backend()}: take engine='diffrax'."
        )
    return is_solver_explicit and lanes.is_machine_code_available() and options.engine != "diffrax"


def run_lane_phases(
    argument_structure: Any,
    stop_at_lift_off: bool,
    records_margins: bool,
    argument_leaves: Sequence[Array],
) -> tuple[PhaseSequenceResult, ButcherTableau, StepOptions]:
    """Integrate the phases of one walking step for each batch element.

    The leaves are those of (params, x, options), with the batch on their last axis. Return the
    starts and ends of all phases, the Butcher tableau and the solver options.
    """
    params, x, options = jax.tree.unflatten(argument_structure, argument_leaves)
    tableau = load_explicit_tableau(options.solver)
    assert tableau is not None  # `can_use_batch_kernel` has checked the solver.
    phase_sequence = run_batch_phases(
        params,
        tuple(x),
        options,
        tableau,
        stop_at_lift_off,
        records_margins,
        is_compiled_separately=True,
    )
    return phase_sequence, tableau, options


def make_step_outputs_function(
    argument_structure: Any, stop_at_lift_off: bool, friction: float | None
) -> BatchFunction:
    """Return a function that computes the results of a batch of walking steps from the leaves of
    (params, x, options).

    The results are split into float arrays and other arrays.

    - `friction`: friction coefficient of the margins; None for the minimal results.
    """

    def compute_step_outputs(*argument_leaves: Array) -> tuple:
        phase_sequence, *_ = run_lane_phases(
            argument_structure, stop_at_lift_off, friction is not None, argument_leaves
        )
        if friction is None:
            return eqx.partition(make_advance_result(phase_sequence, "lanes"), eqx.is_inexact_array)
        phase_end_results = tuple(
            phase_end._replace(next_phase_inputs=None)
            for phase_end in phase_sequence.phase_end_results
        )
        float_phase_sequence = phase_sequence._replace(
            phases=(), phase_start_states=(), phase_end_results=phase_end_results
        )  # only floats
        step_result = with_batched_jvp(
            lambda phase_sequence: make_step_result(phase_sequence, friction, "lanes")
        )(float_phase_sequence)
        return eqx.partition(step_result, eqx.is_inexact_array)

    return compute_step_outputs


def build_step_function(
    argument_structure: Any, stop_at_lift_off: bool, friction: float | None
) -> ForwardFunction:
    """Return a function that computes the results of a walking step from the leaves of (params, x,
    options).

    The results are split into float arrays and other arrays. The function serves as a forward-mode
    rule, from which all AD modes are derived.
    """
    return unbatch(
        compile_batch_function(
            make_step_outputs_function(argument_structure, stop_at_lift_off, friction)
        )
    )


def build_step_finisher(
    argument_structure: Any, stop_at_lift_off: bool, phase_index: int
) -> BatchFunction:
    """Return a function that computes the results of `finish_gait_step` from a list of leaves.

    The leaves are those of (params, distance, state, options), whose pytree structure is
    `argument_structure`. The results are split into float arrays and other arrays.
    """

    def compute_finish_outputs(*argument_leaves: Array) -> tuple:
        params, foot_distance, phase_state, options = jax.tree.unflatten(
            argument_structure, argument_leaves
        )
        tableau = load_explicit_tableau(options.solver)
        assert tableau is not None  # checked by `can_use_batch_kernel`
        remaining_step_result = finish_gait_step(
            _make_phase_runner(options, tableau, False, None, is_compiled_separately=True),
            params,
            phase_index,
            foot_distance,
            tuple(phase_state),
            options,
            stop_at_lift_off,
            "lanes",
        )
        return eqx.partition(remaining_step_result, eqx.is_inexact_array)

    return unbatch(compile_batch_function(compute_finish_outputs))


def build_step_sampler(
    argument_structure: Any, stop_at_lift_off: bool, n_samples: int
) -> BatchFunction:
    """Return a function that samples a walking step at `n_samples` equidistant times of each phase.

    The arguments of the function are the leaves of (params, x, options).
    """

    def sample_lane_steps(*argument_leaves: Array) -> Trajectory:
        phase_sequence, tableau, options = run_lane_phases(
            argument_structure, stop_at_lift_off, False, argument_leaves
        )
        phase_samples = [
            sample_batch_phase(
                make_batch_phase(phase, False),
                tableau,
                *phase_start,
                phase_end.duration,
                n_samples,
                compute_wheel_units(phase.s).scale_times_to_seconds(options),
            )
            for phase, phase_start, phase_end in zip(
                phase_sequence.phases,
                phase_sequence.phase_start_states,
                phase_sequence.phase_end_results,
                strict=True,
            )
        ]
        return make_trajectory(phase_sequence, phase_samples)

    return unbatch(compile_batch_function(sample_lane_steps))


def build_step_jacobian(
    argument_structure: Any,
    stop_at_lift_off: bool,
    friction: float | None,
    input_indices: tuple[int, ...],
) -> ForwardFunction:
    """Return a function that computes a walking step and the Jacobian of its results.

    The walking step is that of `build_step_function`. The returned function gives the Jacobian of
    the float results, the float results, and all other results. The Jacobian is with respect to the
    leaves at `input_indices`.
    """
    compute_step_outputs = make_step_outputs_function(
        argument_structure, stop_at_lift_off, friction
    )
    compute_lane_jacobian = lambda *leaves: compute_jacobian_columns(
        compute_step_outputs, leaves, input_indices
    )

    def evaluate_step_jacobian(*argument_leaves: Array) -> tuple:
        params, x, options = jax.tree.unflatten(argument_structure, argument_leaves)
        n_jacobian_columns = sum(math.prod(jnp.shape(argument_leaves[i])) for i in input_indices)
        compute_columns = unbatch(
            compile_batch_function(
                compute_lane_jacobian,
                register_limits=lanes.RegisterLimits(
                    N_STEP_INPUTS + (n_jacobian_columns > N_STEP_INPUTS)
                ),
            )
        )
        jacobian_columns, float_outputs, nonfloat_outputs = compute_columns(
            *jax.tree.leaves((params, x, options.with_derivative_tolerances()))
        )
        return (
            split_jacobian_by_leaf(jacobian_columns, argument_leaves, input_indices),
            float_outputs,
        ), nonfloat_outputs

    return evaluate_step_jacobian


def split_jacobian_by_leaf(
    jacobian_columns: Any, argument_leaves: Sequence[Array], input_indices: Sequence[int]
) -> tuple:
    """Split a Jacobian into one tree per selected leaf.

    - `jacobian_columns`: Jacobian, whose leading axis runs over all entries of the selected leaves;
    - `input_indices`: indices of the selected leaves in `argument_leaves`.
    """
    jacobian_by_leaf, first_column = [], 0
    for i in input_indices:
        leaf_shape = jnp.shape(argument_leaves[i])
        end_column = first_column + math.prod(leaf_shape)
        columns_of_leaf = slice(first_column, end_column)
        select_leaf_columns = lambda x, columns=columns_of_leaf, leaf_shape=leaf_shape: (
            jnp.moveaxis(x[columns], 0, -1).reshape(*x.shape[1:], *leaf_shape)
        )
        jacobian_by_leaf.append(jax.tree.map(select_leaf_columns, jacobian_columns))
        first_column = end_column
    return tuple(jacobian_by_leaf)


N_STEP_INPUTS = len(PARAMETER_NAMES) + 3
"""Number of inputs of a step on flat ground: the parameters and the section state.

Uneven ground adds the slope of the next line of the ground. Machine code keeps one number per
derivative in registers.
"""


def compute_jacobian_columns(
    batch_function: BatchFunction, argument_leaves: Sequence[Array], input_indices: Sequence[int]
) -> tuple:
    """Return the Jacobian columns, the float results and all other results of a batched function.

    The columns are derivatives with respect to the leaves at `input_indices`. The leading axis of
    the columns runs over the entries of the leaves. `batch_function` returns float arrays with the
    batch on the last axis, and auxiliary results.
    """

    def evaluate_at_selected_leaves(*selected_leaf_values: Array) -> tuple:
        all_leaves = list(argument_leaves)
        for i, selected_leaf_value in zip(input_indices, selected_leaf_values, strict=True):
            all_leaves[i] = selected_leaf_value
        return batch_function(*all_leaves)

    selected_leaves = [argument_leaves[i] for i in input_indices]
    n_entries_by_leaf = [math.prod(leaf.shape[:-1]) for leaf in selected_leaves]
    n_vectors = sum(n_entries_by_leaf)
    # Each entry of a unit vector is a separate constant 0 or 1, so that machine code omits products
    # with 0.
    unit_vectors, unit_tangents = iter(np.eye(n_vectors)), []
    for leaf, n_entries in zip(selected_leaves, n_entries_by_leaf, strict=True):
        lane_tangents = [
            jnp.broadcast_to(
                jnp.asarray(next(unit_vectors), leaf.dtype)[:, None], (n_vectors, leaf.shape[-1])
            )
            for _ in range(n_entries)
        ]
        unit_tangents.append(lane_tangents[0] if leaf.ndim == 1 else jnp.stack(lane_tangents, 1))
    directional_derivative_function = lambda tangents: jax.jvp(
        evaluate_at_selected_leaves, selected_leaves, tangents, has_aux=True
    )
    float_outputs, jacobian_columns, nonfloat_outputs = jax.vmap(
        directional_derivative_function, out_axes=(None, 0, None)
    )(unit_tangents)
    return jacobian_columns, float_outputs, nonfloat_outputs
