"""Search for limit cycles of many wheels by collocation and Newton's method.

A lane is the batch element of one wheel. Arrays of type `LaneArray` have the lanes on the last
axis.

Newton's method on the collocation system also converges to solutions that are not gaits. A cycle is
therefore accepted only if all inequalities that its sequence of phases assumes hold at all nodes.
After each attempt, the wheels without a cycle are gathered for the next attempt.
"""

import functools
import operator
from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import export, lax
from jaxtyping import Array, Bool, Float, Int

from vrw_jax import simd
from vrw_jax.collocation import (
    N_GAUSS_NODES,
    CollocationPhase,
    CollocationSolution,
    CycleLinearization,
    PhaseConstants,
    PhaseMesh,
    PhasePoint,
    PhasePoints,
    PhaseSequence,
    estimate_mesh_error,
    linearize_cycle,
    reconstruct_gait_step,
)
from vrw_jax.cycles.gait_surface import predict_gait
from vrw_jax.cycles.options import CycleOptions
from vrw_jax.cycles.phase_sequence import (
    ADMISSIBILITY_CHECKS,
    compute_phase_constants,
    make_post_impact_sequence,
)
from vrw_jax.numerics import BatchFunction, LaneArray, Vector
from vrw_jax.wheel import WheelParams, make_wheel_from_parameters, stack_parameters

LaneParameters = Float[Array, "n_parameters lanes"]
"""Parameters of each wheel (lane) as floats, in the order of PARAMETER_NAMES."""


@dataclass(frozen=True)
class CycleSearchLimits:
    """Limits in the search for limit cycles that a user cannot set."""

    end_guard_tolerance: float = 1e-6
    """Largest amount by which the guard that ends a phase may be negative at the end of the phase,
    N, m or rad/s.
    """
    max_accepted_mesh_error: float = 1e-5
    """Largest estimated mesh error of an accepted solution.

    The value is chosen because the errors for some hundred random wheels are smaller, most of them
    much smaller.
    """
    n_homotopy_segments: int = 16
    """Number of segments of the last homotopy.

    If no root is found, the gait of the wheel in Table 1 of the paper is continued to the searched
    wheel. The parameters vary on the straight line between the two wheels. If the homotopy ends
    before the searched wheel, its last segment determines the reason.
    """
    max_lanes_without_gathering: int = 16
    """Largest batch size for which the wheels (lanes) that need another attempt are not
    gathered.
    """


CYCLE_SEARCH_LIMITS = CycleSearchLimits()


class CollocationSystem(NamedTuple):
    """Collocation system of a limit cycle: phases, number of gait steps, and meshes."""

    n_legs: int
    period_n: int
    cycle_options: CycleOptions
    stop_at_lift_off: bool = True  # whether the normal force must be positive in an admissible gait
    search_limits: CycleSearchLimits = CYCLE_SEARCH_LIMITS

    @property
    def phase_sequence(self) -> PhaseSequence:
        """Return the phases of one gait step and the functions that describe them."""
        return make_post_impact_sequence(self.n_legs, self.stop_at_lift_off)

    @property
    def phase_meshes(self) -> tuple[PhaseMesh, ...]:
        """Return the meshes of the phases DLS, SLS-I and SLS-II."""
        n_dls_intervals, n_sls1_intervals, n_sls2_intervals = self.cycle_options.mesh_intervals
        return (
            PhaseMesh(n_dls_intervals, 1.0),
            PhaseMesh(n_sls1_intervals, self.cycle_options.mesh_grading),
            PhaseMesh(n_sls2_intervals, 1.0),
        )

    @property
    def phase_constants_function(self) -> Callable:
        """Return the function that maps the parameters to the constants of the
        equations of motion.
        """
        return functools.partial(compute_phase_constants, self.n_legs)

    def linearize_at(
        self,
        parameters: LaneParameters,
        collocation_state: "CollocationState",
        parameter_indices: tuple[int, ...] = (),
    ) -> CycleLinearization:
        """Linearize the collocation equations at a collocation state.

        The result contains tangents with respect to the parameters in `parameter_indices`.
        """
        return linearize_cycle(
            self.phase_sequence,
            self.phase_meshes,
            self.phase_constants_function,
            parameters,
            collocation_state.solution,
            collocation_state.is_phase_active > 0.5,
            parameter_indices,
        )

    def evaluate_phase_points(
        self, parameters: Array, collocation_solution: CollocationSolution
    ) -> tuple[Vector, list[tuple[PhasePoints, ...]]]:
        """Return the section state after the last gait step, and the points of all phases in each
        step.

        The arguments belong to one wheel, or to several wheels on the last axis.
        """
        phase_constants, section_state = (
            self.phase_constants_function(*parameters),
            tuple(collocation_solution.section_state),
        )
        phase_points_of_steps = []
        for step_index in range(self.period_n):
            phase_durations, accelerations_by_phase = jax.tree.map(
                lambda x, step_index=step_index: x[step_index],
                (collocation_solution.durations, collocation_solution.accelerations),
            )
            section_state, phase_points = reconstruct_gait_step(
                self.phase_sequence,
                self.phase_meshes,
                phase_constants,
                section_state,
                phase_durations,
                accelerations_by_phase,
            )
            phase_points_of_steps.append(phase_points)
        return section_state, phase_points_of_steps


class CollocationState(NamedTuple):
    """Solution of the collocation system, its active phases, and the result of its admissibility
    checks.

    All fields are floats with the wheels (lanes) on the last axis.
    """

    solution: CollocationSolution
    is_phase_active: LaneArray  # (n, n_phases, lanes): 1 if the phase occurs, else 0
    # (lanes,): 1 for a limit cycle, 0 for a replacement of a missing cycle
    has_cycle: LaneArray
    # (lanes,): 1 + index in ADMISSIBILITY_CHECKS of the check that a root fails;
    # plus HOMOTOPY_FAILURE_OFFSET for a root of a wheel on the homotopy; a HomotopyFailure; else 0
    failed_check: LaneArray
    gait_step_end_states: (
        LaneArray  # (n, 4, lanes): theta, L1 and their rates at the end of each step
    )


class CycleSearchResult(NamedTuple):
    """Result of a search for limit cycles, with the wheels (lanes) on the last axis."""

    collocation_state: CollocationState
    monodromy_matrix: LaneArray  # (row, column, lanes)
    correction_norm: LaneArray  # norm of Newton's last correction
    n_newton_iterations: Int[Array, " lanes"]  # number of linearizations of the system


# Traces on disk contain these named tuples.
for namedtuple_class in (CollocationSolution, CollocationState, CycleSearchResult):
    export.register_namedtuple_serialization(
        namedtuple_class, serialized_name=f"vrw_jax.{namedtuple_class.__name__}"
    )


def predict_start_from_gait_surface(
    collocation_system: CollocationSystem, parameters: LaneParameters, has_dls: Array
) -> CollocationState:
    """Return the gait that the stored gait surface predicts, as a start of the search.

    Without DLS, the duration of SLS-I includes that of DLS.
    """
    predicted_solution = predict_gait(
        make_wheel_from_parameters(parameters, collocation_system.n_legs),
        collocation_system.phase_meshes,
    )
    dls_duration, sls1_duration, sls2_duration = predicted_solution.durations[0]
    phase_durations = jnp.stack(
        [
            jnp.where(has_dls, dls_duration, 0.0),
            jnp.where(has_dls, sls1_duration, dls_duration + sls1_duration),
            sls2_duration,
        ]
    )
    start_state = make_start_state(
        collocation_system, predicted_solution.section_state, phase_durations, has_dls
    )
    accelerations_by_phase = tuple(
        jnp.broadcast_to(
            jnp.where(has_dls, predicted_accelerations, 0.0), acceleration_template.shape
        )
        for predicted_accelerations, acceleration_template in zip(
            predicted_solution.accelerations, start_state.solution.accelerations, strict=True
        )
    )
    return start_state._replace(
        solution=start_state.solution._replace(accelerations=accelerations_by_phase)
    )


def make_start_state(
    collocation_system: CollocationSystem,
    section_state: Array,
    phase_durations: Array,
    has_dls: Array,
) -> CollocationState:
    """Build a start of the search in which all accelerations are zero.

    The section state and the phase durations are the same in all gait steps. `has_dls` determines
    whether double support is an active phase.
    """
    period_n, n_phases = collocation_system.period_n, len(collocation_system.phase_sequence.phases)
    n_lanes = section_state.shape[-1]
    zero_accelerations = tuple(
        jnp.zeros(
            (
                period_n,
                phase_mesh.n_intervals,
                N_GAUSS_NODES,
                collocation_phase.n_coordinates,
                n_lanes,
            ),
            section_state.dtype,
        )
        for collocation_phase, phase_mesh in zip(
            collocation_system.phase_sequence.phases, collocation_system.phase_meshes, strict=True
        )
    )
    is_dls_active = jnp.where(has_dls, 1.0, 0.0).astype(section_state.dtype)
    is_sls_active = jnp.ones((period_n, n_phases - 1, n_lanes), section_state.dtype)
    is_phase_active = jnp.concatenate(
        [jnp.broadcast_to(is_dls_active, (period_n, 1, n_lanes)), is_sls_active], 1
    )
    phase_durations = jnp.broadcast_to(phase_durations, (period_n, n_phases, n_lanes))
    collocation_solution = CollocationSolution(section_state, phase_durations, zero_accelerations)
    return CollocationState(
        collocation_solution, is_phase_active, *init_search_flags(collocation_system, section_state)
    )


def init_search_flags(
    collocation_system: CollocationSystem, section_state: Array
) -> tuple[Array, Array, Array]:
    """Return `has_cycle`, `failed_check` and `gait_step_end_states` before the search, which are
    zeros.
    """
    lane_shape, n_step_end_components = (
        section_state.shape[1:],
        2 * collocation_system.phase_sequence.phases[-1].n_coordinates,
    )
    make_zeros = lambda *array_shape: jnp.zeros((*array_shape, *lane_shape), section_state.dtype)
    return (
        make_zeros(),
        make_zeros(),
        make_zeros(collocation_system.period_n, n_step_end_components),
    )


def reduce_over_non_lane_axes(
    combine_two_arrays: Callable[[Array, Array], Array], lane_values: Array
) -> LaneArray:
    """Reduce `lane_values` by `combine_two_arrays` over all axes except the last axis.

    The halves of the array are combined repeatedly, because XLA's own reduction runs along the
    wrong axis.
    """
    if simd.targets_machine_code():
        machine_reduction = jnp.max if combine_two_arrays is jnp.maximum else jnp.min
        return machine_reduction(lane_values, axis=tuple(range(lane_values.ndim - 1)))
    rows_over_lanes = lane_values.reshape(-1, lane_values.shape[-1])
    while rows_over_lanes.shape[0] > 1:
        half_row_count = rows_over_lanes.shape[0] // 2
        unpaired_lane_row = rows_over_lanes[2 * half_row_count :]
        rows_over_lanes = jnp.concatenate(
            [
                combine_two_arrays(
                    rows_over_lanes[:half_row_count],
                    rows_over_lanes[half_row_count : 2 * half_row_count],
                ),
                unpaired_lane_row,
            ]
        )
    return rows_over_lanes[0]


def compute_correction_norm(
    collocation_solution: CollocationSolution, newton_correction: CollocationSolution
) -> LaneArray:
    """Return the norm of a Newton correction: its largest absolute component, shape (lanes,).

    The correction of each acceleration is multiplied by the square of the phase's duration, as in
    its effect on positions.
    """
    max_by_lane = functools.partial(reduce_over_non_lane_axes, jnp.maximum)
    correction_norm = jnp.maximum(
        max_by_lane(jnp.abs(newton_correction.section_state)),
        max_by_lane(jnp.abs(newton_correction.durations)),
    )
    for phase_index, acceleration_change in enumerate(newton_correction.accelerations):
        phase_duration = max_by_lane(jnp.abs(collocation_solution.durations[:, phase_index]))
        correction_norm = jnp.maximum(
            correction_norm, max_by_lane(jnp.abs(acceleration_change)) * phase_duration**2
        )
    return correction_norm


def _compute_correction_fraction(
    collocation_solution: CollocationSolution, newton_correction: CollocationSolution
) -> LaneArray:
    """Return the largest admissible fraction of a Newton correction, at most 1.

    With this fraction, the changes of the section state and of the durations are within their
    limits.
    """
    gait_step_duration = jnp.sum(collocation_solution.durations, 1, keepdims=True)
    max_unknown_changes = jnp.concatenate(
        [
            0.15 * jnp.abs(collocation_solution.section_state) + 0.05,
            (
                0.25 * jnp.abs(collocation_solution.durations) + 0.02 * jnp.abs(gait_step_duration)
            ).reshape(-1, collocation_solution.section_state.shape[-1]),
        ]
    )
    proposed_unknown_changes = jnp.concatenate(
        [
            newton_correction.section_state,
            newton_correction.durations.reshape(-1, collocation_solution.section_state.shape[-1]),
        ]
    )
    smallest_float = jnp.finfo(proposed_unknown_changes.dtype).tiny
    correction_fraction = reduce_over_non_lane_axes(
        jnp.minimum,
        max_unknown_changes / jnp.maximum(jnp.abs(proposed_unknown_changes), smallest_float),
    )
    return jnp.minimum(1.0, correction_fraction)


def compute_state_tangents(
    cycle_linearization: CycleLinearization, collocation_state: CollocationState
) -> CollocationState:
    """Return the tangents of a collocation state, computed from the linearization at that state.

    The tangents of the active phases and of the results of admissibility checks are zero.
    """
    make_zero_tangents = lambda x: jnp.zeros(
        (cycle_linearization.gait_step_end_tangents.shape[0], *x.shape), x.dtype
    )
    has_cycle_tangents, failed_check_tangents = (
        make_zero_tangents(collocation_state.has_cycle),
        make_zero_tangents(collocation_state.failed_check),
    )
    return CollocationState(
        cycle_linearization.parameter_tangents,
        make_zero_tangents(collocation_state.is_phase_active),
        has_cycle_tangents,
        failed_check_tangents,
        cycle_linearization.gait_step_end_tangents,
    )


class _NewtonState(NamedTuple):
    """Loop state of Newton's method for all wheels (lanes)."""

    iteration_index: Int[Array, ""]
    collocation_state: CollocationState
    monodromy_matrix: LaneArray
    correction_norm: LaneArray
    has_lane_converged: Bool[Array, " lanes"]
    is_lane_running: Bool[Array, " lanes"]
    n_newton_iterations: Int[Array, " lanes"]


def run_newton_iterations(
    collocation_system: CollocationSystem,
    parameters: LaneParameters,
    start_state: CollocationState,
    initial_parameters: LaneParameters,
    homotopy_steps: Array,
    max_iterations: Array | int,
    is_lane_requested: Bool[Array, " lanes"],
) -> CycleSearchResult:
    """Run Newton's method with limited corrections on the requested wheels (lanes).

    During the first `homotopy_steps` iterations the parameters change from `initial_parameters` to
    their final values. The iteration of a wheel ends when it converges, or when round-off prevents
    its corrections from decreasing. The result for a wheel therefore does not depend on other
    wheels.
    """
    cycle_options = collocation_system.cycle_options
    machine_epsilon = float(jnp.finfo(parameters.dtype).eps)
    tight_newton_tolerance, loose_newton_tolerance = (
        max(cycle_options.tolerance, 1e3 * machine_epsilon),
        CycleOptions.tolerance,
    )

    def run_newton_iteration(newton_state: _NewtonState) -> _NewtonState:
        homotopy_fraction = jnp.minimum(
            1.0, (newton_state.iteration_index + 1) / jnp.maximum(homotopy_steps, 1)
        ).astype(parameters.dtype)
        is_at_target = homotopy_fraction >= 1.0
        current_parameters = jnp.where(
            is_at_target,
            parameters,
            initial_parameters + homotopy_fraction * (parameters - initial_parameters),
        )
        collocation_solution = newton_state.collocation_state.solution
        cycle_linearization = collocation_system.linearize_at(
            current_parameters, newton_state.collocation_state
        )
        newton_correction = cycle_linearization.newton_correction
        correction_norm = compute_correction_norm(collocation_solution, newton_correction)
        is_correction_finite = jnp.isfinite(correction_norm)
        correction_fraction = _compute_correction_fraction(collocation_solution, newton_correction)
        is_lane_moving = newton_state.is_lane_running & is_correction_finite
        update_moving_lanes = lambda new_value, old_value: jnp.where(
            is_lane_moving, new_value, old_value
        )

        def apply_correction(unknowns: Array, newton_correction_values: Array) -> Array:
            return jnp.where(
                is_lane_moving,
                unknowns
                + correction_fraction * jnp.where(is_lane_moving, newton_correction_values, 0.0),
                unknowns,
            )

        newton_tolerance = (
            jnp.where(
                2.0 * correction_norm > newton_state.correction_norm,
                loose_newton_tolerance,
                tight_newton_tolerance,
            )
            if tight_newton_tolerance < loose_newton_tolerance
            else tight_newton_tolerance
        )
        has_lane_converged = is_lane_moving & is_at_target & (correction_norm < newton_tolerance)
        collocation_state = newton_state.collocation_state._replace(
            solution=jax.tree.map(apply_correction, collocation_solution, newton_correction),
            gait_step_end_states=update_moving_lanes(
                cycle_linearization.gait_step_end_states,
                newton_state.collocation_state.gait_step_end_states,
            ),
        )
        return _NewtonState(
            iteration_index=newton_state.iteration_index + 1,
            collocation_state=collocation_state,
            monodromy_matrix=update_moving_lanes(
                cycle_linearization.monodromy, newton_state.monodromy_matrix
            ),
            correction_norm=update_moving_lanes(correction_norm, newton_state.correction_norm),
            has_lane_converged=newton_state.has_lane_converged | has_lane_converged,
            is_lane_running=is_lane_moving & ~has_lane_converged,
            n_newton_iterations=newton_state.n_newton_iterations + newton_state.is_lane_running,
        )

    has_running_lanes = lambda newton_state: (
        jnp.any(newton_state.is_lane_running)
        & (newton_state.iteration_index < max_iterations + homotopy_steps)
    )
    section_size, float_dtype, n_lanes = (
        collocation_system.phase_sequence.section_size,
        start_state.has_cycle.dtype,
        is_lane_requested.shape[-1],
    )
    first_newton_state = _NewtonState(
        iteration_index=jnp.zeros((), jnp.int32),
        collocation_state=start_state,
        monodromy_matrix=jnp.zeros((section_size, section_size, n_lanes), float_dtype),
        correction_norm=jnp.ones((n_lanes,), float_dtype),
        has_lane_converged=jnp.zeros((n_lanes,), bool),
        is_lane_running=is_lane_requested,
        n_newton_iterations=jnp.zeros((n_lanes,), jnp.int32),
    )
    last_newton_state = lax.while_loop(has_running_lanes, run_newton_iteration, first_newton_state)
    failed_check = find_first_failed_check(
        collocation_system, parameters, last_newton_state.collocation_state
    )
    has_cycle = (last_newton_state.has_lane_converged & (failed_check == 0.0)).astype(
        parameters.dtype
    )
    failed_check = jnp.where(last_newton_state.has_lane_converged, failed_check, 0.0)
    collocation_state = last_newton_state.collocation_state._replace(
        has_cycle=has_cycle, failed_check=failed_check
    )
    return CycleSearchResult(
        collocation_state,
        last_newton_state.monodromy_matrix,
        last_newton_state.correction_norm,
        last_newton_state.n_newton_iterations,
    )


def _compute_guard_minima(
    collocation_phase: CollocationPhase, phase_constants: PhaseConstants, phase_points: PhasePoints
) -> Vector:
    """Return the minimum of each guard over the start and the nodes of a phase.

    The minima are computed by a loop over the nodes.
    """

    def update_minimum(
        guard_minima: Vector, node_state: tuple[Array, Array]
    ) -> tuple[Vector, None]:
        q, v = node_state
        node_guards = collocation_phase.guards_function(
            phase_constants, PhasePoint(phase_points.node_points.held_constants, tuple(q), tuple(v))
        )
        return tuple(map(jnp.minimum, guard_minima, node_guards)), None

    start_guards = collocation_phase.guards_function(
        phase_constants, phase_points.phase_start_point
    )
    node_states = jnp.stack(phase_points.node_points.q, 1), jnp.stack(phase_points.node_points.v, 1)
    return lax.scan(update_minimum, start_guards, node_states)[0]


def find_first_failed_check(
    collocation_system: CollocationSystem,
    parameters: LaneParameters,
    collocation_state: CollocationState,
) -> LaneArray:
    """Return the number of the first failed admissibility check for each wheel, or 0 if no check
    fails.

    The number is 1 + the index of the check in ADMISSIBILITY_CHECKS. Durations, guards at all nodes
    and margins at the transitions must be positive.
    """
    phase_sequence = collocation_system.phase_sequence
    phase_constants = collocation_system.phase_constants_function(*parameters)
    collocation_solution = collocation_state.solution

    def check_step_admissibility(loop_carry: tuple, step_inputs: tuple) -> tuple:
        section_state, failed_check = loop_carry
        phase_durations, accelerations_by_phase, is_phase_active = step_inputs
        is_phase_active = is_phase_active > 0.5
        next_section_state, phase_points = reconstruct_gait_step(
            phase_sequence,
            collocation_system.phase_meshes,
            phase_constants,
            tuple(section_state),
            phase_durations,
            accelerations_by_phase,
        )
        is_check_satisfied: list[Array] = []
        for phase_index, (collocation_phase, points_of_phase) in enumerate(
            zip(phase_sequence.phases, phase_points, strict=True)
        ):
            is_check_satisfied.append(
                ~is_phase_active[phase_index] | (phase_durations[phase_index] > 0.0)
            )
            guards_at_phase_end = collocation_phase.guards_function(
                phase_constants, points_of_phase.phase_end_point
            )
            for guard_minimum, end_guard_value in zip(
                _compute_guard_minima(collocation_phase, phase_constants, points_of_phase),
                guards_at_phase_end,
                strict=True,
            ):
                is_check_satisfied.append(
                    ~is_phase_active[phase_index]
                    | (
                        (guard_minimum > 0.0)
                        & (end_guard_value > -collocation_system.search_limits.end_guard_tolerance)
                    )
                )
        is_check_satisfied += [
            admissibility_margin > 0.0
            for admissibility_margin in phase_sequence.margins_function(
                phase_constants, phase_points, is_phase_active
            )
        ]
        for check_index, has_check_passed in enumerate(is_check_satisfied):
            failed_check = jnp.where(
                (failed_check == 0.0) & ~has_check_passed, 1.0 + check_index, failed_check
            )
        return (jnp.stack(next_section_state), failed_check), None

    step_inputs = (
        collocation_solution.durations,
        collocation_solution.accelerations,
        collocation_state.is_phase_active,
    )
    loop_carry = (
        collocation_solution.section_state,
        jnp.zeros(parameters.shape[-1:], parameters.dtype),
    )
    (_, failed_check), _ = lax.scan(check_step_admissibility, loop_carry, step_inputs)
    is_mesh_fine_enough = (
        estimate_mesh_error(phase_sequence, collocation_system.phase_meshes, collocation_solution)
        < collocation_system.search_limits.max_accepted_mesh_error
    )
    return jnp.where(
        (failed_check == 0.0) & ~is_mesh_fine_enough, float(FAILED_MESH_CHECK_CODE), failed_check
    )


def _has_attempt_name(attempt_index: Array, *attempt_names: str) -> Array:
    """Return whether the attempt at `attempt_index` in the order of attempts has one of the given
    names.
    """
    return functools.reduce(
        operator.or_,
        [attempt_index == SEARCH_ATTEMPTS.index(attempt_name) for attempt_name in attempt_names],
    )


def _run_search_attempt(
    collocation_system: CollocationSystem,
    attempt_index: Array,
    parameters: LaneParameters,
    search_result: CycleSearchResult,
    search_guess: CollocationState | None,
) -> CycleSearchResult:
    """Run one attempt on the wheels (lanes) without a cycle, and return the merged search result.

    - `attempt_index`: index of the attempt in the order of attempts;
    - `search_guess`: guess of the user, or None.
    """
    cycle_options, n_homotopy_segments = (
        collocation_system.cycle_options,
        collocation_system.search_limits.n_homotopy_segments,
    )
    table_1_values = stack_parameters(WheelParams(n_legs=collocation_system.n_legs)).astype(
        parameters.dtype
    )
    max_iterations_by_name = dict.fromkeys(SEARCH_ATTEMPTS, cycle_options.max_newton_iterations) | {
        "guess": cycle_options.first_newton_iterations,
        "surface": cycle_options.first_newton_iterations,
    }
    max_iterations_by_attempt = [
        max_iterations_by_name[attempt_name] for attempt_name in SEARCH_ATTEMPTS
    ] + [cycle_options.max_newton_iterations] * (2 * n_homotopy_segments)
    homotopy_segment_by_attempt = [0] * len(SEARCH_ATTEMPTS) + [
        1 + homotopy_try_index // 2 for homotopy_try_index in range(2 * n_homotopy_segments)
    ]
    select_by_attempt = lambda table_by_attempt: jnp.asarray(table_by_attempt, jnp.int32)[
        attempt_index
    ]
    table_1_parameters = jnp.broadcast_to(table_1_values[:, None], parameters.shape)
    # Each segment has two tries: from the previous wheel's gait, and without double support.
    homotopy_segment_number = select_by_attempt(homotopy_segment_by_attempt)
    is_second_homotopy_try_by_attempt = [0] * len(SEARCH_ATTEMPTS) + [0, 1] * n_homotopy_segments
    is_second_homotopy_try = select_by_attempt(is_second_homotopy_try_by_attempt) == 1
    is_homotopy_segment_attempt = homotopy_segment_number > 0
    is_last_homotopy_segment = ~is_homotopy_segment_attempt | (
        homotopy_segment_number == n_homotopy_segments
    )
    homotopy_fraction = homotopy_segment_number.astype(parameters.dtype) / n_homotopy_segments
    target_parameters = jnp.where(
        is_last_homotopy_segment,
        parameters,
        table_1_parameters + homotopy_fraction * (parameters - table_1_parameters),
    )
    is_homotopy_attempt = _has_attempt_name(attempt_index, "homotopy")
    start_parameters = jnp.where(is_homotopy_attempt, table_1_parameters, target_parameters)
    has_dls = jnp.broadcast_to(
        ~_has_attempt_name(attempt_index, "without DLS") & ~is_second_homotopy_try,
        parameters.shape[-1:],
    )
    homotopy_steps = jnp.where(is_homotopy_attempt, cycle_options.homotopy_steps, 0)
    start_state = predict_start_from_gait_surface(collocation_system, start_parameters, has_dls)
    continues_previous_segment = _has_attempt_name(attempt_index, "guess, on", "surface, on") | (
        (homotopy_segment_number > 1) & ~is_second_homotopy_try
    )
    start_state = jax.tree.map(
        lambda surface_value, previous_value: jnp.where(
            continues_previous_segment, previous_value, surface_value
        ),
        start_state,
        search_result.collocation_state,
    )
    if search_guess is not None:
        is_guess_attempt = _has_attempt_name(attempt_index, "guess")
        start_state = jax.tree.map(
            lambda surface_value, guess_value: jnp.where(
                is_guess_attempt, guess_value, surface_value
            ),
            start_state,
            search_guess,
        )
    is_lane_pending = search_result.collocation_state.has_cycle < 0.5
    is_lane_pending &= ~is_homotopy_segment_attempt | (
        search_result.collocation_state.failed_check
        == jnp.where(is_second_homotopy_try, float(HomotopyFailure.FIRST_TRY_FAILED), 0.0)
    )
    attempt_result = run_newton_iterations(
        collocation_system,
        target_parameters,
        start_state,
        table_1_parameters,
        homotopy_steps,
        select_by_attempt(max_iterations_by_attempt),
        is_lane_pending,
    )
    if collocation_system.period_n == 1:
        # The result for a wheel on the homotopy may decide the search for the wheel at its end.
        collocation_state = attempt_result.collocation_state
        failure_code = jnp.where(
            is_second_homotopy_try,
            float(HomotopyFailure.BOTH_TRIES_FAILED),
            float(HomotopyFailure.FIRST_TRY_FAILED),
        )
        has_cycle, failed_check = collocation_state.has_cycle, collocation_state.failed_check
        continues_homotopy = ~is_last_homotopy_segment & (
            (has_cycle > 0.5) | (failed_check == FAILED_MESH_CHECK_CODE)
        )
        final_failed_check = jnp.where(
            is_last_homotopy_segment, failed_check, failed_check + HOMOTOPY_FAILURE_OFFSET
        )
        failed_check_code = jnp.where(
            (has_cycle > 0.5) | (failed_check > 0.0), final_failed_check, failure_code
        )
        failed_check_code = jnp.where(continues_homotopy, 0.0, failed_check_code)
        homotopy_state = collocation_state._replace(
            has_cycle=jnp.where(is_last_homotopy_segment, has_cycle, 0.0),
            failed_check=failed_check_code,
        )
        collocation_state = jax.tree.map(
            lambda new_value, old_value: jnp.where(
                is_homotopy_segment_attempt, new_value, old_value
            ),
            homotopy_state,
            attempt_result.collocation_state,
        )
        attempt_result = attempt_result._replace(collocation_state=collocation_state)
    merged_search_result = jax.tree.map(
        lambda new_value, old_value: jnp.where(is_lane_pending, new_value, old_value),
        attempt_result,
        search_result,
    )
    # The first inadmissible root is reported, unless a later one fails only the mesh check.
    failed_check_before, failed_check_after = (
        search_result.collocation_state.failed_check,
        merged_search_result.collocation_state.failed_check,
    )
    failed_check = jnp.where(
        (failed_check_before <= 0.0) | (failed_check_after == FAILED_MESH_CHECK_CODE),
        failed_check_after,
        failed_check_before,
    )
    failed_check = jnp.where(
        merged_search_result.collocation_state.has_cycle > 0.5, 0.0, failed_check
    )
    collocation_state = merged_search_result.collocation_state._replace(failed_check=failed_check)
    return merged_search_result._replace(
        collocation_state=collocation_state,
        n_newton_iterations=search_result.n_newton_iterations + attempt_result.n_newton_iterations,
    )


def run_search_attempts(
    collocation_system: CollocationSystem,
    parameters: LaneParameters,
    search_result: CycleSearchResult,
    attempt_index: Int[Array, ""],
    end_attempt_index: Int[Array, ""],
    search_guess: CollocationState | None = None,
) -> CycleSearchResult:
    """Run the search attempts with indices from `attempt_index` to `end_attempt_index` - 1.

    Return the search result. An attempt changes only wheels (lanes) without a cycle. The parameters
    must be in their domains.
    """

    def has_next_attempt(loop_carry: tuple[Array, CycleSearchResult]) -> Array:
        attempt_index, search_result = loop_carry
        return (attempt_index < end_attempt_index) & jnp.any(
            _can_attempt_change_result(attempt_index, search_result)
        )

    def run_next_attempt(
        loop_carry: tuple[Array, CycleSearchResult],
    ) -> tuple[Array, CycleSearchResult]:
        attempt_index, search_result = loop_carry
        return attempt_index + 1, _run_search_attempt(
            collocation_system, attempt_index, parameters, search_result, search_guess
        )

    return lax.while_loop(has_next_attempt, run_next_attempt, (attempt_index, search_result))[1]


def search_all_attempts(
    collocation_system: CollocationSystem, run_attempts: BatchFunction, *parameters_and_guess: Any
) -> CycleSearchResult:
    """Run all attempts, and return the search result for each wheel (lane).

    Blocks of wheels are searched together, and a block takes as long as its slowest wheel. The
    wheels without a cycle are therefore gathered before each stage.

    - `run_attempts`: batched form of `run_search_attempts`;
    - `parameters_and_guess`: the parameters and, optionally, a guess.
    """
    parameters, n_lanes = parameters_and_guess[0], parameters_and_guess[0].shape[-1]
    # For several gait steps, the homotopy would continue a gait of one step, which decides nothing.
    n_attempts = len(SEARCH_ATTEMPTS) + 2 * collocation_system.search_limits.n_homotopy_segments * (
        collocation_system.period_n == 1
    )
    first_attempt_index = jnp.asarray(
        SEARCH_ATTEMPTS.index("surface" if len(parameters_and_guess) == 1 else "guess"), jnp.int32
    )
    search_result = init_search_result(collocation_system, parameters)
    if n_lanes <= collocation_system.search_limits.max_lanes_without_gathering:
        return run_attempts(
            parameters,
            search_result,
            first_attempt_index,
            jnp.asarray(n_attempts, jnp.int32),
            *parameters_and_guess[1:],
        )

    def has_next_attempt_stage(loop_carry: tuple) -> Array:
        attempt_index, _, search_result, _ = loop_carry
        return (attempt_index < n_attempts) & jnp.any(
            _can_attempt_change_result(attempt_index, search_result)
        )

    def run_attempt_stage(loop_carry: tuple) -> tuple:
        attempt_index, lane_indices, *lane_arrays = loop_carry
        lane_order_pending_first = jnp.argsort(
            ~_can_attempt_change_result(attempt_index, lane_arrays[0]), stable=True
        )
        lane_indices, search_result, parameters_and_guess = jax.tree.map(
            lambda x: x[..., lane_order_pending_first], (lane_indices, *lane_arrays)
        )
        end_attempt_index = jnp.where(
            attempt_index < len(SEARCH_ATTEMPTS), attempt_index + 1, n_attempts
        )
        return (
            end_attempt_index,
            lane_indices,
            run_attempts(
                parameters_and_guess[0],
                search_result,
                attempt_index,
                end_attempt_index,
                *parameters_and_guess[1:],
            ),
            parameters_and_guess,
        )

    initial_carry = first_attempt_index, jnp.arange(n_lanes), search_result, parameters_and_guess
    _, lane_indices, gathered_search_result, _ = lax.while_loop(
        has_next_attempt_stage, run_attempt_stage, initial_carry
    )
    original_lane_order = jnp.argsort(lane_indices)
    return jax.tree.map(lambda x: x[..., original_lane_order], gathered_search_result)


def _can_attempt_change_result(
    attempt_index: Int[Array, ""], search_result: CycleSearchResult
) -> Bool[Array, " lanes"]:
    """Return for each wheel (lane) whether an attempt can still change its search result."""
    is_lane_decided = (search_result.collocation_state.failed_check > 0.0) | (
        search_result.collocation_state.failed_check == HomotopyFailure.BOTH_TRIES_FAILED
    )
    return (search_result.collocation_state.has_cycle < 0.5) & (
        (attempt_index < len(SEARCH_ATTEMPTS)) | ~is_lane_decided
    )


def init_search_result(
    collocation_system: CollocationSystem, parameters: LaneParameters
) -> CycleSearchResult:
    """Return the search result of each wheel (lane) before the first attempt."""
    section_size, n_phases = (
        collocation_system.phase_sequence.section_size,
        len(collocation_system.phase_sequence.phases),
    )
    make_zeros = lambda *array_shape: jnp.zeros(
        (*array_shape, parameters.shape[-1]), parameters.dtype
    )
    return CycleSearchResult(
        make_start_state(
            collocation_system, make_zeros(section_size), make_zeros(n_phases), make_zeros() > 0.0
        ),
        make_zeros(section_size, section_size),
        make_zeros() + jnp.inf,
        make_zeros().astype(jnp.int32),
    )


FAILED_MESH_CHECK_CODE = len(ADMISSIBILITY_CHECKS)
"""Value of `CollocationState.failed_check` for a root whose mesh is too coarse."""

HOMOTOPY_FAILURE_OFFSET = float(len(ADMISSIBILITY_CHECKS))
"""Offset of `CollocationState.failed_check` if the check fails for an intermediate wheel of the
homotopy.
"""


class HomotopyFailure(IntEnum):
    """Values of `CollocationState.failed_check` if Newton's method fails in the homotopy.

    The homotopy starts at the wheel in Table 1 of the paper.
    """

    FIRST_TRY_FAILED = -1
    BOTH_TRIES_FAILED = -2


SEARCH_ATTEMPTS = ("guess", "guess, on", "surface", "surface, on", "homotopy", "without DLS")
"""Names of the attempts in the order in which they run.

The first two attempts start from the guess, if there is one. The next two start from the gait that
the stored surface predicts. A homotopy from the wheel in Table 1 of the paper follows. The last
attempt searches for a cycle without double support. The attempts "guess" and "surface" have few
Newton iterations, so that wheels that need more iterations are gathered in separate blocks.
"""
