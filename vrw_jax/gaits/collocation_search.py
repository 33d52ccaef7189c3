"""Search for limit cycles of many wheels by collocation and Newton's method.

A lane is the batch element of one wheel. Arrays of type `LaneArray` have the lanes on the last
axis.

Newton's method on the collocation system also converges to solutions that are not gaits. A cycle is
therefore accepted only if all inequalities that its sequence of phases assumes hold at all nodes.
After each attempt, the wheels without a cycle are gathered for the next attempt.
"""

from enum import IntEnum
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import export, lax
from jaxtyping import Array, Bool, Int

from vrw_jax.base.elementwise import LaneArray, Vector, select_trees_by_condition
from vrw_jax.gaits.cycle import CycleOptions
from vrw_jax.gaits.gauss import (
    N_GAUSS_NODES,
    CollocationPhase,
    CollocationSolution,
    PhaseConstants,
    PhasePoint,
    PhasePoints,
    estimate_mesh_error,
    reconstruct_gait_step,
)
from vrw_jax.gaits.phase_sequence import (
    ADMISSIBILITY_CHECKS,
    N_LAW_SCALES,
    CollocationState,
    CollocationSystem,
    LaneParameters,
    predict_gait,
)
from vrw_jax.lanes.batching import BatchFunction
from vrw_jax.wheel.params import (
    NO_LAWS,
    PARAMETER_NAMES,
    WheelParams,
    make_wheel_from_parameters,
    stack_parameters,
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
        make_wheel_from_parameters(parameters[: len(PARAMETER_NAMES)], collocation_system.n_legs),
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
    is_sls_active = jnp.ones_like(dls_duration)
    is_phase_active = jnp.stack([jnp.where(has_dls, is_sls_active, 0.0)] + [is_sls_active] * 2)
    accelerations = tuple(jnp.where(has_dls, x[0], 0.0) for x in predicted_solution.accelerations)
    # All gait steps have the same start.
    phase_durations, accelerations, is_phase_active = jax.tree.map(
        lambda x: jnp.broadcast_to(x, (collocation_system.period_n, *x.shape)),
        (phase_durations, accelerations, is_phase_active),
    )
    return CollocationState.make_start(
        CollocationSolution(predicted_solution.section_state, phase_durations, accelerations),
        is_phase_active,
    )


def compute_correction_norm(
    collocation_solution: CollocationSolution, newton_correction: CollocationSolution
) -> LaneArray:
    """Return the norm of a Newton correction: its largest absolute component, shape (lanes,).

    The correction of each acceleration is multiplied by the square of the phase's duration, as in
    its effect on positions.
    """
    compute_size = lambda x: jnp.max(jnp.abs(x), axis=tuple(range(x.ndim - 1)))
    correction_norm = jnp.maximum(
        compute_size(newton_correction.section_state), compute_size(newton_correction.durations)
    )
    for phase_index, acceleration_change in enumerate(newton_correction.accelerations):
        phase_duration = compute_size(collocation_solution.durations[:, phase_index])
        correction_norm = jnp.maximum(
            correction_norm, compute_size(acceleration_change) * phase_duration**2
        )
    return correction_norm


def _compute_correction_fraction(
    collocation_solution: CollocationSolution, newton_correction: CollocationSolution
) -> LaneArray:
    """Return the largest admissible fraction of a Newton correction, at most 1.

    With this fraction, the changes of the section state and of the durations are within their
    limits.
    """
    durations = collocation_solution.durations
    gait_step_duration = jnp.sum(durations, 1, keepdims=True)

    def compute_least_ratio(max_changes: Array, changes: Array) -> LaneArray:
        ratios = max_changes / jnp.maximum(jnp.abs(changes), jnp.finfo(changes.dtype).tiny)
        return jnp.min(ratios, axis=tuple(range(ratios.ndim - 1)))

    section_ratio = compute_least_ratio(
        0.15 * jnp.abs(collocation_solution.section_state) + 0.05, newton_correction.section_state
    )
    duration_ratio = compute_least_ratio(
        0.25 * jnp.abs(durations) + 0.02 * jnp.abs(gait_step_duration), newton_correction.durations
    )
    return jnp.minimum(1.0, jnp.minimum(section_ratio, duration_ratio))


class _NewtonState(NamedTuple):
    """Loop state of Newton's method for all wheels (lanes)."""

    iteration_index: Int[Array, ""]
    search_result: CycleSearchResult
    has_lane_converged: Bool[Array, " lanes"]
    is_lane_running: Bool[Array, " lanes"]


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
    machine_epsilon = float(jnp.finfo(parameters.dtype).eps)
    tight_newton_tolerance = max(collocation_system.cycle_options.tolerance, 1e3 * machine_epsilon)
    loose_newton_tolerance = max(CycleOptions.tolerance, tight_newton_tolerance)

    def run_newton_iteration(newton_state: _NewtonState) -> _NewtonState:
        iteration_index, search_result, has_lane_converged, is_lane_running = newton_state
        homotopy_fraction = jnp.minimum(
            1.0, (iteration_index + 1) / jnp.maximum(homotopy_steps, 1)
        ).astype(parameters.dtype)
        is_at_target = homotopy_fraction >= 1.0
        current_parameters = jnp.where(
            is_at_target,
            parameters,
            initial_parameters + homotopy_fraction * (parameters - initial_parameters),
        )
        collocation_state = search_result.collocation_state
        solution = collocation_state.solution
        linearization = collocation_system.linearize_at(
            current_parameters, solution, collocation_state.is_phase_active
        )
        correction = linearization.newton_correction
        correction_norm = compute_correction_norm(solution, correction)
        fraction = _compute_correction_fraction(solution, correction)
        is_lane_moving = is_lane_running & jnp.isfinite(correction_norm)
        newton_tolerance = jnp.where(
            2.0 * correction_norm > search_result.correction_norm,
            loose_newton_tolerance,
            tight_newton_tolerance,
        )
        has_converged_now = is_lane_moving & is_at_target & (correction_norm < newton_tolerance)
        corrected_result = search_result._replace(
            collocation_state=collocation_state._replace(
                solution=jax.tree.map(lambda x, dx: x + fraction * dx, solution, correction),
                gait_step_end_states=linearization.gait_step_end_states,
            ),
            monodromy_matrix=linearization.monodromy,
            correction_norm=correction_norm,
        )
        search_result = select_trees_by_condition(is_lane_moving, corrected_result, search_result)
        return _NewtonState(
            iteration_index + 1,
            search_result._replace(
                n_newton_iterations=search_result.n_newton_iterations + is_lane_running
            ),
            has_lane_converged | has_converged_now,
            is_lane_moving & ~has_converged_now,
        )

    has_running_lanes = lambda newton_state: (
        jnp.any(newton_state.is_lane_running)
        & (newton_state.iteration_index < max_iterations + homotopy_steps)
    )
    first_search_result = init_search_result(collocation_system, parameters)
    _, search_result, has_lane_converged, _ = lax.while_loop(
        has_running_lanes,
        run_newton_iteration,
        _NewtonState(
            jnp.zeros((), jnp.int32),
            first_search_result._replace(collocation_state=start_state),
            jnp.zeros_like(is_lane_requested),
            is_lane_requested,
        ),
    )
    collocation_state = search_result.collocation_state
    failed_check = find_first_failed_check(collocation_system, parameters, collocation_state)
    return search_result._replace(
        collocation_state=collocation_state._replace(
            has_cycle=(has_lane_converged & (failed_check == 0.0)).astype(parameters.dtype),
            failed_check=jnp.where(has_lane_converged, failed_check, 0.0),
        )
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


# Largest amount by which the guard that ends a phase may be negative at the end of the phase, N, m
# or rad/s.
END_GUARD_TOLERANCE = 1e-6
# Largest estimated mesh error of an accepted solution. The value is chosen because the errors for
# some hundred random wheels are smaller, most of them much smaller.
MAX_ACCEPTED_MESH_ERROR = 1e-5


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
    first_phase_constants = collocation_system.phase_constants_function(*parameters)
    collocation_solution = collocation_state.solution

    def check_step_admissibility(loop_carry: tuple, step_inputs: tuple) -> tuple:
        section_state, failed_check = loop_carry
        phase_durations, accelerations_by_phase, is_phase_active, *parity = step_inputs
        phase_constants = phase_sequence.select_constants(first_phase_constants, parity)
        is_phase_active = is_phase_active > 0.5
        next_section_state, phase_points = reconstruct_gait_step(
            collocation_system,
            phase_constants,
            tuple(section_state),
            phase_durations,
            accelerations_by_phase,
        )
        is_check_satisfied = []
        for phase, points_of_phase, is_active, duration in zip(
            phase_sequence.phases, phase_points, is_phase_active, phase_durations, strict=True
        ):
            end_guards = phase.guards_function(phase_constants, points_of_phase.phase_end_point)
            guard_minima = _compute_guard_minima(phase, phase_constants, points_of_phase)
            is_phase_valid = [
                duration > 0.0,
                *(
                    (guard_minimum > 0.0) & (end_guard > -END_GUARD_TOLERANCE)
                    for guard_minimum, end_guard in zip(guard_minima, end_guards, strict=True)
                ),
            ]
            is_check_satisfied += [~is_active | is_valid for is_valid in is_phase_valid]
        transition_margins = phase_sequence.margins_function(
            phase_constants, phase_points, is_phase_active
        )
        is_check_satisfied += [margin > 0.0 for margin in transition_margins]
        for check_index, has_check_passed in enumerate(is_check_satisfied):
            failed_check = jnp.where(
                (failed_check == 0.0) & ~has_check_passed, 1.0 + check_index, failed_check
            )
        return (jnp.stack(next_section_state), failed_check), None

    step_inputs = (
        collocation_solution.durations,
        collocation_solution.accelerations,
        collocation_state.is_phase_active,
        *phase_sequence.list_parities(collocation_system.period_n, parameters.dtype),
    )
    loop_carry = (
        collocation_solution.section_state,
        jnp.zeros(parameters.shape[-1:], parameters.dtype),
    )
    (_, failed_check), _ = lax.scan(check_step_admissibility, loop_carry, step_inputs)
    is_mesh_fine_enough = (
        estimate_mesh_error(collocation_system, collocation_solution) < MAX_ACCEPTED_MESH_ERROR
    )
    return jnp.where(
        (failed_check == 0.0) & ~is_mesh_fine_enough, float(FAILED_MESH_CHECK_CODE), failed_check
    )


class SearchAttempt(NamedTuple):
    """Description of one attempt of the search, or an array of these values for all attempts."""

    max_newton_iterations: Any
    starts_from_guess: Any = False  # else from the gait that the stored surface predicts
    continues_last_attempt: Any = False  # else the attempt has its own start
    has_dls: Any = True
    homotopy_steps: Any = 0  # number of iterations from the wheel in Table 1 to the searched wheel
    # number of the segment of the last homotopy, or 0 for an attempt on the searched wheel
    homotopy_segment: Any = 0
    is_second_try: Any = False  # on the same segment


# Number of segments of the last homotopy. If no root is found, the gait of the wheel in Table 1 of
# the paper is continued to the searched wheel. The parameters vary on the straight line between the
# two wheels. If the homotopy ends before the searched wheel, its last segment determines the
# reason.
N_HOMOTOPY_SEGMENTS = 16


def list_search_attempts(cycle_options: CycleOptions) -> list[SearchAttempt]:
    """Return the attempts of the search in the order in which they run.

    The first two attempts start from the guess, if there is one. The next two start from the gait
    that the stored surface predicts. The first and the third attempt have few Newton iterations, so
    that wheels that need more iterations are gathered in separate blocks. The next attempt searches
    for a cycle without double support. A homotopy from the wheel in Table 1 of the paper follows,
    and a longer search without double support, which fast gaits need. Each segment of the last
    homotopy has two attempts: from the gait of the previous wheel, and without double support.
    """
    first_iterations = cycle_options.first_newton_iterations
    max_iterations = cycle_options.max_newton_iterations
    search_attempts = [
        SearchAttempt(first_iterations, starts_from_guess=True),
        SearchAttempt(max_iterations, continues_last_attempt=True),
        SearchAttempt(first_iterations),
        SearchAttempt(max_iterations, continues_last_attempt=True),
        SearchAttempt(max_iterations, has_dls=False),
        SearchAttempt(max_iterations, homotopy_steps=cycle_options.homotopy_steps),
        SearchAttempt(3 * max_iterations, has_dls=False),
    ]
    for segment in range(1, 1 + N_HOMOTOPY_SEGMENTS):
        search_attempts += [
            SearchAttempt(
                max_iterations, continues_last_attempt=segment > 1, homotopy_segment=segment
            ),
            SearchAttempt(
                max_iterations, has_dls=False, homotopy_segment=segment, is_second_try=True
            ),
        ]
    return search_attempts


def _make_homotopy_start(
    collocation_system: CollocationSystem, parameters: LaneParameters
) -> LaneParameters:
    """Return the parameters of the wheel in Table 1, at which homotopies begin.

    Its legs have the paper's force, so the share of a law is zero.
    """
    n, table_1_wheel = len(PARAMETER_NAMES), WheelParams(n_legs=collocation_system.n_legs)
    values = stack_parameters(table_1_wheel).astype(parameters.dtype)[:, None]
    values = jnp.broadcast_to(values, (n, *parameters.shape[1:]))
    if collocation_system.law_structure == NO_LAWS:
        return values
    end = len(parameters) - N_LAW_SCALES
    share = jnp.zeros_like(parameters[:1])
    return jnp.concatenate([values, parameters[n:end], share, parameters[end + 1 :]])


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
    search_attempt = jax.tree.map(
        lambda *values: jnp.asarray(values, jnp.int32)[attempt_index],
        *list_search_attempts(collocation_system.cycle_options),
    )
    is_on_segment = search_attempt.homotopy_segment > 0
    is_before_target = is_on_segment & (search_attempt.homotopy_segment < N_HOMOTOPY_SEGMENTS)
    is_second_try = search_attempt.is_second_try == 1
    table_1_parameters = _make_homotopy_start(collocation_system, parameters)
    fraction = search_attempt.homotopy_segment.astype(parameters.dtype) / N_HOMOTOPY_SEGMENTS
    target_parameters = jnp.where(
        is_before_target,
        table_1_parameters + fraction * (parameters - table_1_parameters),
        parameters,
    )
    last_state = search_result.collocation_state
    start_state = predict_start_from_gait_surface(
        collocation_system,
        jnp.where(search_attempt.homotopy_steps > 0, table_1_parameters, target_parameters),
        search_attempt.has_dls == 1,
    )
    start_state = select_trees_by_condition(
        search_attempt.continues_last_attempt == 1, last_state, start_state
    )
    if search_guess is not None:
        start_state = select_trees_by_condition(
            search_attempt.starts_from_guess == 1, search_guess, start_state
        )
    last_check = jnp.where(is_second_try, float(HomotopyFailure.FIRST_TRY_FAILED), 0.0)
    is_lane_pending = _can_attempt_change_result(
        collocation_system, attempt_index, search_result
    ) & (~is_on_segment | (last_state.failed_check == last_check))
    attempt_result = run_newton_iterations(
        collocation_system,
        target_parameters,
        start_state,
        table_1_parameters,
        search_attempt.homotopy_steps,
        search_attempt.max_newton_iterations,
        is_lane_pending,
    )
    # The result for a wheel on the homotopy may decide the search for the wheel at its end.
    has_cycle = attempt_result.collocation_state.has_cycle
    failed_check = attempt_result.collocation_state.failed_check
    failure, last_failure = HomotopyFailure.FIRST_TRY_FAILED, HomotopyFailure.BOTH_TRIES_FAILED
    homotopy_check = jnp.where(
        failed_check > 0.0,
        failed_check + jnp.where(is_before_target, HOMOTOPY_FAILURE_CODE_OFFSET, 0.0),
        jnp.where(is_second_try, float(last_failure), float(failure)),
    )
    is_mesh_coarse = failed_check == FAILED_MESH_CHECK_CODE
    is_segment_solved = (has_cycle > 0.5) | (is_before_target & is_mesh_coarse)
    homotopy_check = jnp.where(is_segment_solved, 0.0, homotopy_check)
    # The long search without double support may end far from gaits, which is no reason.
    failed_check = jnp.where(
        (attempt_index == N_DIRECT_ATTEMPTS - 1) & ~is_mesh_coarse, 0.0, failed_check
    )
    attempt_result = attempt_result._replace(
        collocation_state=attempt_result.collocation_state._replace(
            has_cycle=jnp.where(is_before_target, 0.0, has_cycle),
            failed_check=jnp.where(is_on_segment, homotopy_check, failed_check),
        )
    )
    # The first inadmissible root is kept, unless a later one fails only the mesh check. That one is
    # the start of a search on a finer mesh.
    attempt_state = attempt_result.collocation_state
    is_attempt_kept = is_lane_pending & (
        (last_state.failed_check <= 0.0)
        | (attempt_state.has_cycle > 0.5)
        | (attempt_state.failed_check == FAILED_MESH_CHECK_CODE)
    )
    merged_result = select_trees_by_condition(is_attempt_kept, attempt_result, search_result)
    return merged_result._replace(
        n_newton_iterations=search_result.n_newton_iterations + attempt_result.n_newton_iterations
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
            _can_attempt_change_result(collocation_system, attempt_index, search_result)
        )

    def run_next_attempt(
        loop_carry: tuple[Array, CycleSearchResult],
    ) -> tuple[Array, CycleSearchResult]:
        attempt_index, search_result = loop_carry
        return attempt_index + 1, _run_search_attempt(
            collocation_system, attempt_index, parameters, search_result, search_guess
        )

    return lax.while_loop(has_next_attempt, run_next_attempt, (attempt_index, search_result))[1]


# Number of attempts that start from the guess. They are the first ones.
N_GUESS_ATTEMPTS = 2
# Largest batch size for which the wheels (lanes) that need another attempt are not gathered.
MAX_LANES_WITHOUT_GATHERING = 16


def search_all_attempts(
    collocation_system: CollocationSystem,
    run_attempts: BatchFunction,
    starts_only_from_guess: bool,
    parameters: LaneParameters,
    *search_guess: CollocationState,
) -> CycleSearchResult:
    """Run all attempts, and return the search result for each wheel (lane).

    Blocks of wheels are searched together, and a block takes as long as its slowest wheel. The
    wheels without a cycle are therefore gathered before each stage.

    - `run_attempts`: batched form of `run_search_attempts`;
    - `starts_only_from_guess`: whether only the attempts from the guess are run;
    - `search_guess`: optionally, a guess.
    """
    n_lanes = parameters.shape[-1]
    first_attempt_index = jnp.asarray(0 if search_guess else N_GUESS_ATTEMPTS, jnp.int32)
    # For several gait steps, the homotopy would continue a gait of one step, which decides nothing,
    # unless the legs alternate.
    has_alternating_legs = collocation_system.phase_sequence.constants_of_step is not None
    n_attempts = (
        len(list_search_attempts(collocation_system.cycle_options))
        if collocation_system.period_n == 1 or has_alternating_legs
        else N_DIRECT_ATTEMPTS
    )
    if starts_only_from_guess:
        n_attempts = N_GUESS_ATTEMPTS
    search_result = init_search_result(collocation_system, parameters)
    if n_lanes <= MAX_LANES_WITHOUT_GATHERING:
        return run_attempts(
            parameters,
            search_result,
            first_attempt_index,
            jnp.asarray(n_attempts, jnp.int32),
            *search_guess,
        )

    def has_next_attempt_stage(loop_carry: tuple) -> Array:
        attempt_index, _, search_result, *_ = loop_carry
        return (attempt_index < n_attempts) & jnp.any(
            _can_attempt_change_result(collocation_system, attempt_index, search_result)
        )

    def run_attempt_stage(loop_carry: tuple) -> tuple:
        attempt_index, lane_indices, *lane_arrays = loop_carry
        lane_order_pending_first = jnp.argsort(
            ~_can_attempt_change_result(collocation_system, attempt_index, lane_arrays[0]),
            stable=True,
        )
        lane_indices, search_result, parameters, *search_guess = jax.tree.map(
            lambda x: x[..., lane_order_pending_first], (lane_indices, *lane_arrays)
        )
        end_attempt_index = jnp.where(
            attempt_index < N_DIRECT_ATTEMPTS, attempt_index + 1, n_attempts
        )
        search_result = run_attempts(
            parameters, search_result, attempt_index, end_attempt_index, *search_guess
        )
        return end_attempt_index, lane_indices, search_result, parameters, *search_guess

    lane_indices = jnp.arange(n_lanes)
    initial_carry: tuple = first_attempt_index, lane_indices, search_result, parameters
    _, lane_indices, gathered_search_result, *_ = lax.while_loop(
        has_next_attempt_stage, run_attempt_stage, (*initial_carry, *search_guess)
    )
    original_lane_order = jnp.argsort(lane_indices)
    return jax.tree.map(lambda x: x[..., original_lane_order], gathered_search_result)


def _can_attempt_change_result(
    collocation_system: CollocationSystem,
    attempt_index: Int[Array, ""],
    search_result: CycleSearchResult,
) -> Bool[Array, " lanes"]:
    failed_check = search_result.collocation_state.failed_check
    has_dls = search_result.collocation_state.is_phase_active[0, 0] > 0.5
    is_lane_decided = (failed_check > 0.0) | (failed_check == HomotopyFailure.BOTH_TRIES_FAILED)
    return (search_result.collocation_state.has_cycle < 0.5) & jnp.where(
        attempt_index < N_DIRECT_ATTEMPTS,
        ~collocation_system.is_beyond_border(failed_check, has_dls)
        | (attempt_index < N_ATTEMPTS_BEYOND_BORDER),
        ~is_lane_decided,
    )


def init_search_result(
    collocation_system: CollocationSystem, parameters: LaneParameters
) -> CycleSearchResult:
    """Return the search result of each wheel (lane) before the first attempt."""
    phase_sequence, period_n = collocation_system.phase_sequence, collocation_system.period_n
    section_size = phase_sequence.section_size
    make_zeros = lambda *shape: jnp.zeros((*shape, parameters.shape[-1]), parameters.dtype)
    # A trace of `predict_start_from_gait_surface` would add 30 ms to the first call.
    start_solution = CollocationSolution(
        section_state=make_zeros(section_size),
        durations=make_zeros(period_n, len(phase_sequence.phases)),
        accelerations=tuple(
            make_zeros(period_n, phase_mesh.n_intervals, N_GAUSS_NODES, phase.n_coordinates)
            for phase_mesh, phase in zip(
                collocation_system.phase_meshes, phase_sequence.phases, strict=True
            )
        ),
    )
    return CycleSearchResult(
        collocation_state=CollocationState.make_start(start_solution, start_solution.durations),
        monodromy_matrix=make_zeros(section_size, section_size),
        correction_norm=make_zeros() + jnp.inf,
        n_newton_iterations=make_zeros().astype(jnp.int32),
    )


FAILED_MESH_CHECK_CODE = len(ADMISSIBILITY_CHECKS)
"""Value of `CollocationState.failed_check` for a root whose mesh is too coarse."""

HOMOTOPY_FAILURE_CODE_OFFSET = float(len(ADMISSIBILITY_CHECKS))
"""Offset of `CollocationState.failed_check` if the check fails for an intermediate wheel of the
homotopy.
"""


class HomotopyFailure(IntEnum):
    """Values of `CollocationState.failed_check` if Newton's method fails in the homotopy.

    The homotopy starts at the wheel in Table 1 of the paper.
    """

    FIRST_TRY_FAILED = -1
    BOTH_TRIES_FAILED = -2


N_DIRECT_ATTEMPTS = sum(
    search_attempt.homotopy_segment == 0 for search_attempt in list_search_attempts(CycleOptions())
)
"""Number of attempts before those of the last homotopy."""

N_ATTEMPTS_BEYOND_BORDER = N_DIRECT_ATTEMPTS - 2
"""Number of attempts for a wheel that is beyond the border of its gaits."""
