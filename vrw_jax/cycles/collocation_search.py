"""Search for limit cycles of many wheels at once: starts, Newton's method, admissibility checks,
retries.

Newton's method on the collocation system also converges to solutions that are no gaits. A cycle
therefore counts as found only if every sign that its sequence of phases assumes holds at all nodes.
Wheels without a cycle after an attempt are gathered for the next attempt.
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
    reconstruct_step,
)
from vrw_jax.cycles.gait_surface import predict_gait
from vrw_jax.cycles.options import CycleOptions
from vrw_jax.cycles.phase_sequence import (
    ADMISSIBILITY_CHECKS,
    compute_constants,
    held_landing_sequence,
)
from vrw_jax.numerics import BatchFunction, LaneArray, Vector
from vrw_jax.wheel import WheelParams, stack_parameters, wheel_from_parameters

Parameters = Float[Array, "n_parameters lanes"]
"""Float parameters of each lane, in the order of PARAMETER_NAMES."""


@dataclass(frozen=True)
class SearchLimits:
    """Limits of the search that users do not set."""

    guard_tolerance: float = 1e-6
    """Largest depth below zero of a guard at the end of the phase that it ends, N, m or rad/s."""
    max_mesh_error: float = 1e-5
    """Estimate of the mesh error above which a solution does not count as found.

    It is chosen because the errors of some hundred random wheels are below it, most of them by far.
    """
    n_homotopy_segments: int = 16
    """Number of segments of the last homotopy.

    If no root is found, the gait of Table 1 is continued from wheel to wheel on the line to this
    wheel. The homotopy arrives, or the segment in which it ends gives the reason.
    """
    max_ungathered_lanes: int = 16
    """Largest number of lanes that are searched without gathering those that need another
    attempt.
    """


SEARCH_LIMITS = SearchLimits()


class CollocationSystem(NamedTuple):
    """Problem of a search: the phases, the number of steps and the meshes."""

    n_legs: int
    period_n: int
    options: CycleOptions
    stop_at_lift_off: bool = True  # whether the ground must push in an admissible gait
    search_limits: SearchLimits = SEARCH_LIMITS

    @property
    def sequence(self) -> PhaseSequence:
        """Return the phases of one gait step as data for the collocation."""
        return held_landing_sequence(self.n_legs, self.stop_at_lift_off)

    @property
    def meshes(self) -> tuple[PhaseMesh, ...]:
        """Return the mesh of each phase: DLS, SLS-I, SLS-II."""
        dls, sls1, sls2 = self.options.mesh_intervals
        return PhaseMesh(dls, 1.0), PhaseMesh(sls1, self.options.mesh_grading), PhaseMesh(sls2, 1.0)

    @property
    def compute_constants(self) -> Callable:
        """Return the function that computes the constants of the equations from the parameters."""
        return functools.partial(compute_constants, self.n_legs)

    def linearize_at(
        self,
        parameters: Parameters,
        state: "CollocationState",
        tangent_indices: tuple[int, ...] = (),
    ) -> CycleLinearization:
        """Return the linearization at a state, with tangents with respect to the parameters of
        `tangent_indices`.
        """
        return linearize_cycle(
            self.sequence,
            self.meshes,
            self.compute_constants,
            parameters,
            state.solution,
            state.phase_active > 0.5,
            tangent_indices,
        )

    def evaluate_phase_points(
        self, parameters: Array, solution: CollocationSolution
    ) -> tuple[Vector, list[tuple[PhasePoints, ...]]]:
        """Return the section state after the last step, and the points of all phases of each step.

        The arguments are those of one wheel, or those of lanes.
        """
        constants, section = self.compute_constants(*parameters), tuple(solution.section_state)
        phase_points_of_steps = []
        for step_index in range(self.period_n):
            durations, accelerations = jax.tree.map(
                lambda x, step_index=step_index: x[step_index],
                (solution.durations, solution.accelerations),
            )
            section, phase_points = reconstruct_step(
                self.sequence, self.meshes, constants, section, durations, accelerations
            )
            phase_points_of_steps.append(phase_points)
        return section, phase_points_of_steps


class CollocationState(NamedTuple):
    """Solution of the collocation system with the data that select it: floats only, lanes last."""

    solution: CollocationSolution
    phase_active: LaneArray  # (n, n_phases, lanes): 1 if the phase takes place, else 0
    # (lanes,): 1 for a limit cycle; 0 if there is none and other numbers replace the solution
    found: LaneArray
    failed_check: (
        LaneArray  # (lanes,): 1 + index in ADMISSIBILITY_CHECKS of the check that a root fails;
    )
    # plus HOMOTOPY_OFFSET for a root of a wheel on the homotopy; a NewtonFailure; else 0
    ends: LaneArray  # (n, 4, lanes): theta, L1 and their rates at the end of each step


class SearchResult(NamedTuple):
    """Result of a search, lanes last."""

    state: CollocationState
    monodromy: LaneArray  # (row, column, lanes)
    residual: LaneArray  # norm of the last correction of Newton's method
    n_newton_iterations: Int[Array, " lanes"]  # number of linearized passes


@functools.cache
def register_export_names() -> None:
    """Register the names of these types for exported traces on disk, once in a process."""
    for state_class in (CollocationSolution, CollocationState, SearchResult):
        export.register_namedtuple_serialization(
            state_class, serialized_name=f"vrw_jax.{state_class.__name__}"
        )


def surface_start(
    system: CollocationSystem, parameters: Parameters, has_dls: Array
) -> CollocationState:
    """Return the gait that the stored surface predicts as a start; without DLS its duration is
    added to SLS-I.
    """
    predicted_solution = predict_gait(
        wheel_from_parameters(parameters, system.n_legs), system.meshes
    )
    dls_duration, sls1_duration, sls2_duration = predicted_solution.durations[0]
    durations = jnp.stack(
        [
            jnp.where(has_dls, dls_duration, 0.0),
            jnp.where(has_dls, sls1_duration, dls_duration + sls1_duration),
            sls2_duration,
        ]
    )
    start = make_start(system, predicted_solution.section_state, durations, has_dls)
    accelerations = tuple(
        jnp.broadcast_to(jnp.where(has_dls, acceleration, 0.0), template.shape)
        for acceleration, template in zip(
            predicted_solution.accelerations, start.solution.accelerations, strict=True
        )
    )
    return start._replace(solution=start.solution._replace(accelerations=accelerations))


def make_start(
    system: CollocationSystem, section: Array, durations: Array, has_dls: Array
) -> CollocationState:
    """Return a start with zero accelerations whose steps all have this section state and these
    durations.
    """
    period_n, n_phases = system.period_n, len(system.sequence.phases)
    n_lanes = section.shape[-1]
    accelerations = tuple(
        jnp.zeros(
            (period_n, mesh.n_intervals, N_GAUSS_NODES, phase.n_coordinates, n_lanes), section.dtype
        )
        for phase, mesh in zip(system.sequence.phases, system.meshes, strict=True)
    )
    first_phase = jnp.where(has_dls, 1.0, 0.0).astype(section.dtype)
    other_phases = jnp.ones((period_n, n_phases - 1, n_lanes), section.dtype)
    phase_active = jnp.concatenate(
        [jnp.broadcast_to(first_phase, (period_n, 1, n_lanes)), other_phases], 1
    )
    durations = jnp.broadcast_to(durations, (period_n, n_phases, n_lanes))
    solution = CollocationSolution(section, durations, accelerations)
    return CollocationState(solution, phase_active, *init_search_flags(system, section))


def init_search_flags(system: CollocationSystem, section: Array) -> tuple[Array, Array, Array]:
    """Return initial values of the fields `found`, `failed_check` and `ends` of a start."""
    lane_shape, n_ends = section.shape[1:], 2 * system.sequence.phases[-1].n_coordinates
    zeros = lambda *shape: jnp.zeros((*shape, *lane_shape), section.dtype)
    return zeros(), zeros(), zeros(system.period_n, n_ends)


def reduce_all_but_lanes(combine: Callable[[Array, Array], Array], x: Array) -> LaneArray:
    """Return `x` reduced by `combine` over all axes but that of the lanes.

    The reduction goes by halves, because XLA's reduction runs along the wrong axis.
    """
    if simd.targets_machine_code():
        reduction = jnp.max if combine is jnp.maximum else jnp.min
        return reduction(x, axis=tuple(range(x.ndim - 1)))
    flattened = x.reshape(-1, x.shape[-1])
    while flattened.shape[0] > 1:
        half_length = flattened.shape[0] // 2
        remainder = flattened[2 * half_length :]
        flattened = jnp.concatenate(
            [combine(flattened[:half_length], flattened[half_length : 2 * half_length]), remainder]
        )
    return flattened[0]


def collocation_correction_norm(
    solution: CollocationSolution, correction: CollocationSolution
) -> LaneArray:
    """Return the largest entry of a correction, with accelerations weighted by their effect on
    positions.
    """
    max_over_entries = functools.partial(reduce_all_but_lanes, jnp.maximum)
    correction_norm = jnp.maximum(
        max_over_entries(jnp.abs(correction.section_state)),
        max_over_entries(jnp.abs(correction.durations)),
    )
    for phase_index, acceleration_change in enumerate(correction.accelerations):
        duration = max_over_entries(jnp.abs(solution.durations[:, phase_index]))
        correction_norm = jnp.maximum(
            correction_norm, max_over_entries(jnp.abs(acceleration_change)) * duration**2
        )
    return correction_norm


def _step_fraction(solution: CollocationSolution, correction: CollocationSolution) -> LaneArray:
    """Return the largest fraction of a correction, at most 1, that changes section and durations
    within limits.
    """
    step_time = jnp.sum(solution.durations, 1, keepdims=True)
    change_limits = jnp.concatenate(
        [
            0.15 * jnp.abs(solution.section_state) + 0.05,
            (0.25 * jnp.abs(solution.durations) + 0.02 * jnp.abs(step_time)).reshape(
                -1, solution.section_state.shape[-1]
            ),
        ]
    )
    changes = jnp.concatenate(
        [
            correction.section_state,
            correction.durations.reshape(-1, solution.section_state.shape[-1]),
        ]
    )
    smallest_float = jnp.finfo(changes.dtype).tiny
    step_fraction = reduce_all_but_lanes(
        jnp.minimum, change_limits / jnp.maximum(jnp.abs(changes), smallest_float)
    )
    return jnp.minimum(1.0, step_fraction)


def state_tangents(
    linearized_pass: CycleLinearization, state: CollocationState
) -> CollocationState:
    """Return the tangents of a state from a linearized pass; the data that select a solution
    have zero tangents.
    """
    zero_tangents = lambda x: jnp.zeros(
        (linearized_pass.step_end_tangents.shape[0], *x.shape), x.dtype
    )
    d_found, d_failed_check = zero_tangents(state.found), zero_tangents(state.failed_check)
    return CollocationState(
        linearized_pass.tangents,
        zero_tangents(state.phase_active),
        d_found,
        d_failed_check,
        linearized_pass.step_end_tangents,
    )


class _NewtonState(NamedTuple):
    """State of the loop of Newton's method, for all lanes."""

    iteration: Int[Array, ""]
    state: CollocationState
    monodromy: LaneArray
    residual: LaneArray
    converged: Bool[Array, " lanes"]
    is_running: Bool[Array, " lanes"]
    n_newton_iterations: Int[Array, " lanes"]


def run_newton(
    system: CollocationSystem,
    parameters: Parameters,
    start: CollocationState,
    initial_parameters: Parameters,
    homotopy_steps: Array,
    max_iterations: Array | int,
    is_pending: Bool[Array, " lanes"],
) -> SearchResult:
    """Run Newton's method with limited steps on the lanes of `is_pending`, and return the result.

    During the first `homotopy_steps` iterations the parameters move from `initial_parameters` to
    their final values. A lane stops when it converges, or when round-off keeps its corrections from
    decreasing. Its result therefore does not depend on other lanes.
    """
    options = system.options
    machine_epsilon = float(jnp.finfo(parameters.dtype).eps)
    tight_tolerance, loose_tolerance = (
        max(options.tolerance, 1e3 * machine_epsilon),
        CycleOptions.tolerance,
    )

    def newton_iteration(newton_state: _NewtonState) -> _NewtonState:
        homotopy_fraction = jnp.minimum(
            1.0, (newton_state.iteration + 1) / jnp.maximum(homotopy_steps, 1)
        ).astype(parameters.dtype)
        is_at_target = homotopy_fraction >= 1.0
        current_parameters = jnp.where(
            is_at_target,
            parameters,
            initial_parameters + homotopy_fraction * (parameters - initial_parameters),
        )
        solution = newton_state.state.solution
        linearized_pass = system.linearize_at(current_parameters, newton_state.state)
        correction = linearized_pass.correction
        correction_norm = collocation_correction_norm(solution, correction)
        is_finite = jnp.isfinite(correction_norm)
        step_fraction = _step_fraction(solution, correction)
        is_moving = newton_state.is_running & is_finite
        replace_if_moving = lambda new_value, old_value: jnp.where(is_moving, new_value, old_value)

        def apply_correction(x: Array, change: Array) -> Array:
            return jnp.where(is_moving, x + step_fraction * jnp.where(is_moving, change, 0.0), x)

        tolerance = (
            jnp.where(
                2.0 * correction_norm > newton_state.residual, loose_tolerance, tight_tolerance
            )
            if tight_tolerance < loose_tolerance
            else tight_tolerance
        )
        is_converged = is_moving & is_at_target & (correction_norm < tolerance)
        state = newton_state.state._replace(
            solution=jax.tree.map(apply_correction, solution, correction),
            ends=replace_if_moving(linearized_pass.step_ends, newton_state.state.ends),
        )
        return _NewtonState(
            iteration=newton_state.iteration + 1,
            state=state,
            monodromy=replace_if_moving(linearized_pass.monodromy, newton_state.monodromy),
            residual=replace_if_moving(correction_norm, newton_state.residual),
            converged=newton_state.converged | is_converged,
            is_running=is_moving & ~is_converged,
            n_newton_iterations=newton_state.n_newton_iterations + newton_state.is_running,
        )

    is_active = lambda newton_state: (
        jnp.any(newton_state.is_running)
        & (newton_state.iteration < max_iterations + homotopy_steps)
    )
    section_size, dtype, n_lanes = (
        system.sequence.section_size,
        start.found.dtype,
        is_pending.shape[-1],
    )
    first_state = _NewtonState(
        iteration=jnp.zeros((), jnp.int32),
        state=start,
        monodromy=jnp.zeros((section_size, section_size, n_lanes), dtype),
        residual=jnp.ones((n_lanes,), dtype),
        converged=jnp.zeros((n_lanes,), bool),
        is_running=is_pending,
        n_newton_iterations=jnp.zeros((n_lanes,), jnp.int32),
    )
    last_state = lax.while_loop(is_active, newton_iteration, first_state)
    failed_check = first_failed_check(system, parameters, last_state.state)
    is_found = (last_state.converged & (failed_check == 0.0)).astype(parameters.dtype)
    failed_check = jnp.where(last_state.converged, failed_check, 0.0)
    state = last_state.state._replace(found=is_found, failed_check=failed_check)
    return SearchResult(
        state, last_state.monodromy, last_state.residual, last_state.n_newton_iterations
    )


def _min_guards(phase: CollocationPhase, constants: PhaseConstants, points: PhasePoints) -> Vector:
    """Return each guard's minimum over the start and the nodes of a phase, computed in one loop."""

    def update_minimum(minima: Vector, node_state: tuple[Array, Array]) -> tuple[Vector, None]:
        q, v = node_state
        guards = phase.guards(
            constants, PhasePoint(points.nodes.held_constants, tuple(q), tuple(v))
        )
        return tuple(map(jnp.minimum, minima, guards)), None

    start_guards = phase.guards(constants, points.start)
    nodes = jnp.stack(points.nodes.q, 1), jnp.stack(points.nodes.v, 1)
    return lax.scan(update_minimum, start_guards, nodes)[0]


def first_failed_check(
    system: CollocationSystem, parameters: Parameters, state: CollocationState
) -> LaneArray:
    """Return 1 + the index in ADMISSIBILITY_CHECKS of the first failed check, or 0 if all hold, for
    each lane.

    Durations, guards at all nodes and the quantities checked at transitions must be positive.
    """
    sequence = system.sequence
    constants = system.compute_constants(*parameters)
    solution = state.solution

    def check_step(carry: tuple, inputs: tuple) -> tuple:
        section, failed_check = carry
        durations, accelerations, phase_active = inputs
        phase_active = phase_active > 0.5
        next_section, phase_points = reconstruct_step(
            sequence, system.meshes, constants, tuple(section), durations, accelerations
        )
        conditions: list[Array] = []
        for phase_index, (phase, points) in enumerate(
            zip(sequence.phases, phase_points, strict=True)
        ):
            conditions.append(~phase_active[phase_index] | (durations[phase_index] > 0.0))
            end_guards = phase.guards(constants, points.end)
            for minimum, end_guard in zip(
                _min_guards(phase, constants, points), end_guards, strict=True
            ):
                conditions.append(
                    ~phase_active[phase_index]
                    | ((minimum > 0.0) & (end_guard > -system.search_limits.guard_tolerance))
                )
        conditions += [
            value > 0.0
            for value in sequence.admissibility_margins(constants, phase_points, phase_active)
        ]
        for check_index, is_satisfied in enumerate(conditions):
            failed_check = jnp.where(
                (failed_check == 0.0) & ~is_satisfied, 1.0 + check_index, failed_check
            )
        return (jnp.stack(next_section), failed_check), None

    inputs = (solution.durations, solution.accelerations, state.phase_active)
    carry = (solution.section_state, jnp.zeros(parameters.shape[-1:], parameters.dtype))
    (_, failed_check), _ = lax.scan(check_step, carry, inputs)
    is_resolved = (
        estimate_mesh_error(sequence, system.meshes, solution) < system.search_limits.max_mesh_error
    )
    return jnp.where((failed_check == 0.0) & ~is_resolved, float(MESH_CHECK_CODE), failed_check)


def _is_attempt_named(attempt_index: Array, *names: str) -> Array:
    """Return whether the attempt of this index has one of these names."""
    return functools.reduce(
        operator.or_, [attempt_index == SEARCH_ATTEMPTS.index(name) for name in names]
    )


def _run_attempt(
    system: CollocationSystem,
    attempt_index: Array,
    parameters: Parameters,
    result: SearchResult,
    guess: CollocationState | None,
) -> SearchResult:
    """Run one attempt on the lanes that are without a cycle, and return the merged result."""
    options, n_segments = system.options, system.search_limits.n_homotopy_segments
    table_1 = stack_parameters(WheelParams(n_legs=system.n_legs)).astype(parameters.dtype)
    max_iterations = dict.fromkeys(SEARCH_ATTEMPTS, options.max_newton_iterations) | {
        "guess": options.first_newton_iterations, "surface": options.first_newton_iterations
    }  # fmt: skip
    iteration_limits = [max_iterations[name] for name in SEARCH_ATTEMPTS] + [
        options.max_newton_iterations
    ] * (2 * n_segments)
    segment_indices = [0] * len(SEARCH_ATTEMPTS) + [1 + i // 2 for i in range(2 * n_segments)]
    select_for_attempt = lambda table: jnp.asarray(table, jnp.int32)[attempt_index]
    table_1_parameters = jnp.broadcast_to(table_1[:, None], parameters.shape)
    # Each segment is tried twice: from the previous wheel, then without double support.
    segment = select_for_attempt(segment_indices)
    is_second_try_by_attempt = [0] * len(SEARCH_ATTEMPTS) + [0, 1] * n_segments
    is_second_try = select_for_attempt(is_second_try_by_attempt) == 1
    is_segment = segment > 0
    is_last_segment = ~is_segment | (segment == n_segments)
    homotopy_fraction = segment.astype(parameters.dtype) / n_segments
    target_parameters = jnp.where(
        is_last_segment,
        parameters,
        table_1_parameters + homotopy_fraction * (parameters - table_1_parameters),
    )
    is_homotopy = _is_attempt_named(attempt_index, "homotopy")
    start_parameters = jnp.where(is_homotopy, table_1_parameters, target_parameters)
    has_dls = jnp.broadcast_to(
        ~_is_attempt_named(attempt_index, "without DLS") & ~is_second_try, parameters.shape[-1:]
    )
    homotopy_steps = jnp.where(is_homotopy, options.homotopy_steps, 0)
    start = surface_start(system, start_parameters, has_dls)
    continues_previous = _is_attempt_named(attempt_index, "guess, on", "surface, on") | (
        (segment > 1) & ~is_second_try
    )
    start = jax.tree.map(lambda s, n: jnp.where(continues_previous, n, s), start, result.state)
    if guess is not None:
        is_guess = _is_attempt_named(attempt_index, "guess")
        start = jax.tree.map(lambda s, g: jnp.where(is_guess, g, s), start, guess)
    is_pending = result.state.found < 0.5
    is_pending &= ~is_segment | (
        result.state.failed_check == jnp.where(is_second_try, float(NewtonFailure.FIRST_TRY), 0.0)
    )
    attempt_result = run_newton(
        system,
        target_parameters,
        start,
        table_1_parameters,
        homotopy_steps,
        select_for_attempt(iteration_limits),
        is_pending,
    )
    if system.period_n == 1:
        homotopy_state = _homotopy_outcome(
            attempt_result.state,
            is_last_segment,
            jnp.where(
                is_second_try, float(NewtonFailure.BOTH_TRIES), float(NewtonFailure.FIRST_TRY)
            ),
        )
        state = jax.tree.map(
            lambda a, b: jnp.where(is_segment, a, b), homotopy_state, attempt_result.state
        )
        attempt_result = attempt_result._replace(state=state)
    merged_result = jax.tree.map(lambda a, b: jnp.where(is_pending, a, b), attempt_result, result)
    # The first inadmissible root is reported, unless a later one fails only the mesh check.
    failed_before, failed_after = result.state.failed_check, merged_result.state.failed_check
    failed_check = jnp.where(
        (failed_before <= 0.0) | (failed_after == MESH_CHECK_CODE), failed_after, failed_before
    )
    failed_check = jnp.where(merged_result.state.found > 0.5, 0.0, failed_check)
    state = merged_result.state._replace(failed_check=failed_check)
    return merged_result._replace(
        state=state,
        n_newton_iterations=result.n_newton_iterations + attempt_result.n_newton_iterations,
    )


def _homotopy_outcome(
    state: CollocationState, is_last_segment: Array, failure_code: Array
) -> CollocationState:
    """Return what the result for a wheel on the homotopy implies for the wheel at its end.

    If it implies nothing, the check code is `failure_code`.
    """
    is_found, failed_check = state.found, state.failed_check
    continues_homotopy = ~is_last_segment & ((is_found > 0.5) | (failed_check == MESH_CHECK_CODE))
    final_code = jnp.where(is_last_segment, failed_check, failed_check + HOMOTOPY_OFFSET)
    check_code = jnp.where((is_found > 0.5) | (failed_check > 0.0), final_code, failure_code)
    check_code = jnp.where(continues_homotopy, 0.0, check_code)
    return state._replace(found=jnp.where(is_last_segment, is_found, 0.0), failed_check=check_code)


def search_lanes(
    system: CollocationSystem,
    parameters: Parameters,
    result: SearchResult,
    attempt_index: Int[Array, ""],
    end_index: Int[Array, ""],
    guess: CollocationState | None = None,
) -> SearchResult:
    """Run the attempts from `attempt_index` to before `end_index` on the lanes without a cycle;
    return the result.

    The parameters must be in their domains.
    """

    def has_next_attempt(carry: tuple[Array, SearchResult]) -> Array:
        attempt_index, result = carry
        return (attempt_index < end_index) & jnp.any(_needs_attempt(attempt_index, result))

    def run_next_attempt(carry: tuple[Array, SearchResult]) -> tuple[Array, SearchResult]:
        attempt_index, result = carry
        return attempt_index + 1, _run_attempt(system, attempt_index, parameters, result, guess)

    return lax.while_loop(has_next_attempt, run_next_attempt, (attempt_index, result))[1]


def search_in_stages(
    system: CollocationSystem, search: BatchFunction, *arguments: Any
) -> SearchResult:
    """Return the search result of each lane after all attempts; `arguments` are parameters and, if
    given, a guess.

    Blocks of lanes are searched together, and a block takes as long as its slowest lane. The lanes
    that are still without a cycle are therefore gathered before each stage.
    """
    parameters, n_lanes = arguments[0], arguments[0].shape[-1]
    # With several steps, a repeated gait of one step would be continued, which decides nothing.
    n_attempts = len(SEARCH_ATTEMPTS) + 2 * system.search_limits.n_homotopy_segments * (
        system.period_n == 1
    )
    first_attempt = jnp.asarray(
        SEARCH_ATTEMPTS.index("surface" if len(arguments) == 1 else "guess"), jnp.int32
    )
    result = init_search_result(system, parameters)
    if n_lanes <= system.search_limits.max_ungathered_lanes:
        return search(
            parameters, result, first_attempt, jnp.asarray(n_attempts, jnp.int32), *arguments[1:]
        )

    def has_next_stage(carry: tuple) -> Array:
        attempt_index, _, result, _ = carry
        return (attempt_index < n_attempts) & jnp.any(_needs_attempt(attempt_index, result))

    def run_stage(carry: tuple) -> tuple:
        attempt_index, lane_indices, *lane_arrays = carry
        pending_first_order = jnp.argsort(
            ~_needs_attempt(attempt_index, lane_arrays[0]), stable=True
        )
        lane_indices, result, arguments = jax.tree.map(
            lambda x: x[..., pending_first_order], (lane_indices, *lane_arrays)
        )
        end_index = jnp.where(attempt_index < len(SEARCH_ATTEMPTS), attempt_index + 1, n_attempts)
        return (
            end_index,
            lane_indices,
            search(arguments[0], result, attempt_index, end_index, *arguments[1:]),
            arguments,
        )

    start_carry = first_attempt, jnp.arange(n_lanes), result, arguments
    _, lane_indices, result_gathered, _ = lax.while_loop(has_next_stage, run_stage, start_carry)
    inverse_order = jnp.argsort(lane_indices)
    return jax.tree.map(lambda x: x[..., inverse_order], result_gathered)


def _needs_attempt(attempt_index: Int[Array, ""], result: SearchResult) -> Bool[Array, " lanes"]:
    """Return whether this attempt can still change the result of a lane."""
    is_decided = (result.state.failed_check > 0.0) | (
        result.state.failed_check == NewtonFailure.BOTH_TRIES
    )
    return (result.state.found < 0.5) & ((attempt_index < len(SEARCH_ATTEMPTS)) | ~is_decided)


def init_search_result(system: CollocationSystem, parameters: Parameters) -> SearchResult:
    """Return the search result before the first attempt."""
    section_size, n_phases = system.sequence.section_size, len(system.sequence.phases)
    zeros = lambda *shape: jnp.zeros((*shape, parameters.shape[-1]), parameters.dtype)
    return SearchResult(
        make_start(system, zeros(section_size), zeros(n_phases), zeros() > 0.0),
        zeros(section_size, section_size),
        zeros() + jnp.inf,
        zeros().astype(jnp.int32),
    )


MESH_CHECK_CODE = len(ADMISSIBILITY_CHECKS)
"""Value of `CollocationState.failed_check` for a root that the mesh does not resolve."""

HOMOTOPY_OFFSET = float(len(ADMISSIBILITY_CHECKS))
"""Offset in `CollocationState.failed_check` of a check that a wheel on the homotopy fails."""


class NewtonFailure(IntEnum):
    """Values of `CollocationState.failed_check` for a homotopy on which Newton's method fails."""

    FIRST_TRY = -1
    BOTH_TRIES = -2


SEARCH_ATTEMPTS = ("guess", "guess, on", "surface", "surface, on", "homotopy", "without DLS")
"""Names of the attempts in their order. They start from the guess, if any, and from the gait
that the stored surface predicts. A homotopy from Table 1 follows, then a cycle without double
support. The first two begin with a few iterations, so that a batch can gather the lanes that need
more in separate blocks.
"""
