"""Differentiate limit cycles by their parameters and by the ground, to any order and in any mode.

First derivatives are the tangents of the linearization at the cycle. Second derivatives are JVPs of
the linearization, of its tangents and of the monodromy matrix. The direction of each JVP is the
derivative of the cycle with respect to one parameter. On a CPU, the first and the second order are
computed by machine code. A lane is the batch element of one wheel.

The response to uneven ground, straight lines with different slopes, yields the gait sensitivity
norm of Hobbelen and Wisse, "A disturbance rejection measure for limit cycle walkers: the gait
sensitivity norm" (2007). Its sum over all later gait steps has a closed form.
"""

import functools
import operator
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from vrw_jax.base import small_matrices
from vrw_jax.base.elementwise import evaluate_with_jvps
from vrw_jax.base.options import StepOptions
from vrw_jax.gaits.collocation_search import (
    CycleSearchResult,
    init_search_result,
    run_search_attempts,
    search_all_attempts,
)
from vrw_jax.gaits.gauss import CollocationSolution
from vrw_jax.gaits.phase_collocation import linearize_steps
from vrw_jax.gaits.phase_sequence import (
    CollocationState,
    CollocationSystem,
    LaneParameters,
    pad_with_zeros,
)
from vrw_jax.lanes.autodiff import (
    ExecutionWrapper,
    apply_jacobian,
    compute_square_root,
    make_implicit_jacobian,
    make_zero_tangent,
    with_implicit_derivative,
)
from vrw_jax.lanes.batching import (
    BatchFunction,
    apply_function_in_blocks,
    make_zeros_like_output,
    unbatch,
)
from vrw_jax.lanes.environment import call_python, with_default_jax_settings
from vrw_jax.lanes.lane_function import compile_batch_function
from vrw_jax.models import walk_batch as scales
from vrw_jax.wheel.params import (
    NO_LAWS,
    PARAMETER_DOMAINS,
    PARAMETER_NAMES,
    WheelParams,
    compute_symbols,
    compute_wheel_units,
)


def _compute_collocation_tangents(
    collocation_system: CollocationSystem,
    parameters: LaneParameters,
    collocation_state: CollocationState,
) -> CollocationState:
    """Return the derivatives of the collocation state with respect to the parameters.

    The parameters are on a leading axis. The derivatives of the active phases and of the results of
    admissibility checks are zero, and all derivatives are zero for wheels (lanes) without a cycle.
    """
    cycle_linearization = collocation_system.linearize_at(
        parameters,
        collocation_state.solution,
        collocation_state.is_phase_active,
        tuple(range(len(parameters))),
    )
    zero_tangents = jax.tree.map(
        lambda x: jnp.zeros((len(parameters), *x.shape), x.dtype), collocation_state
    )
    state_tangents = zero_tangents._replace(
        solution=cycle_linearization.parameter_tangents,
        gait_step_end_states=cycle_linearization.gait_step_end_tangents,
    )
    return _zero_without_cycle(collocation_state, state_tangents)


def _compute_masked_monodromy(
    collocation_system: CollocationSystem,
    parameters: LaneParameters,
    collocation_state: CollocationState,
) -> Array:
    """Return the monodromy matrix for each wheel (lane), which is zero if the wheel has
    no cycle.
    """
    cycle_linearization = collocation_system.linearize_at(
        parameters, collocation_state.solution, collocation_state.is_phase_active
    )
    return _zero_without_cycle(collocation_state, cycle_linearization.monodromy)


def _compute_monodromy_tangents(
    collocation_system: CollocationSystem,
    parameters: LaneParameters,
    solution_and_tangents: tuple[CollocationState, CollocationState],
) -> Array:
    """Return the derivatives of the monodromy matrix with respect to the parameters on the branch.

    The parameters are on a leading axis. The directions are computed one after another, so that the
    compiled program is as short as for one direction. With the paper's force, three of the nine
    derivatives follow from changes of units. A change of the unit of mass scales hub mass and leg
    mass by one factor. Therefore, of the derivatives with respect to the two masses, only the
    derivative in the orthogonal direction is computed.

    - `solution_and_tangents`: the solution z and its derivatives dz/dp with respect to the
      parameters.
    """
    collocation_state, state_tangents = solution_and_tangents
    identity_matrix = jnp.eye(len(parameters), dtype=parameters.dtype)[..., None]
    parameter_tangents = jnp.broadcast_to(identity_matrix, (len(parameters), *parameters.shape))

    def compute_monodromy_jvps(directions: Any) -> tuple[Array, Array]:
        return lax.map(
            lambda tangents: jax.jvp(
                functools.partial(_compute_masked_monodromy, collocation_system),
                (parameters, collocation_state),
                tangents,
            ),
            directions,
        )

    if collocation_system.law_structure != NO_LAWS:
        # The numbers of a law may have any units, so that units determine nothing.
        return compute_monodromy_jvps((parameter_tangents, state_tangents))[1]
    hub_mass_index = PARAMETER_NAMES.index("hub_mass")
    leg_mass_index = PARAMETER_NAMES.index("leg_mass")
    total_mass = parameters[hub_mass_index] + parameters[leg_mass_index]
    hub_mass_share = parameters[hub_mass_index] / total_mass
    leg_mass_share = parameters[leg_mass_index] / total_mass
    unscaled_parameter_indices = [
        i
        for i in range(len(parameters))
        if i not in (hub_mass_index, leg_mass_index, *scales.UNIT_SCALING_BY_PARAMETER_INDEX)
    ]

    def select_directions(x: Array) -> Array:
        """Return the tangents in the computed directions. The last one is that of the masses."""
        mass_tangent = hub_mass_share * x[leg_mass_index] - leg_mass_share * x[hub_mass_index]
        return jnp.stack([*(x[i] for i in unscaled_parameter_indices), mass_tangent])

    monodromy_matrices, monodromy_tangents = compute_monodromy_jvps(
        jax.tree.map(select_directions, (parameter_tangents, state_tangents))
    )
    tangent_by_parameter = dict(
        zip(unscaled_parameter_indices, monodromy_tangents[:-1], strict=True)
    )
    mass_scale_tangent = (
        scales.MASS_UNIT_SCALING.subtract_known_jacobian_columns(
            jnp.zeros_like(monodromy_tangents[0]), tuple(parameters), tangent_by_parameter
        )
        / total_mass
    )
    squared_direction_norm = hub_mass_share * hub_mass_share + leg_mass_share * leg_mass_share
    tangent_by_parameter[hub_mass_index] = (
        hub_mass_share * mass_scale_tangent - leg_mass_share * monodromy_tangents[-1]
    ) / squared_direction_norm
    tangent_by_parameter[leg_mass_index] = (
        leg_mass_share * mass_scale_tangent + hub_mass_share * monodromy_tangents[-1]
    ) / squared_direction_norm
    time_scale_tangent = (
        jnp.asarray([[0, 1], [-1, 0]])[..., None] * monodromy_matrices[0]
    )  # derivative with respect to the logarithm of the time unit
    time_scale_tangents = {
        i: time_scale_tangent
        if unit_scale is scales.TIME_UNIT_SCALING
        else jnp.zeros_like(time_scale_tangent)
        for i, unit_scale in scales.UNIT_SCALING_BY_PARAMETER_INDEX.items()
    }
    tangent_by_parameter = scales.complete_jacobian_by_scaling(
        tuple(parameters), tangent_by_parameter, time_scale_tangents
    )
    return jnp.stack([tangent_by_parameter[i] for i in range(len(parameters))])


def _zero_without_cycle(collocation_state: CollocationState, tree_over_lanes: Any) -> Any:
    return jax.tree.map(
        lambda x: jnp.where(collocation_state.has_cycle > 0.5, x, 0.0), tree_over_lanes
    )


def make_derivative_compiler(
    collocation_system: CollocationSystem,
    skips_batches_without_cycles: bool = False,
) -> ExecutionWrapper:
    """Return a function that compiles a batch function for a given order of derivatives.

    Orders below 2 become machine code. XLA computes higher orders.
    """
    batch_size = collocation_system.cycle_options.batch_size

    def compile_function(
        function_of_element: BatchFunction, derivative_order: int
    ) -> BatchFunction:
        compile_batch: Any = (
            compile_batch_function if derivative_order < 2 else apply_function_in_blocks
        )
        compiled: BatchFunction = compile_batch(function_of_element, batch_size)
        return skip_without_cycles(compiled) if skips_batches_without_cycles else compiled

    return compile_function


def skip_without_cycles(function: BatchFunction) -> BatchFunction:
    """Return a function whose results are zero for a batch that contains no cycle."""

    def evaluate(parameters: Array, trees: Any) -> Any:
        state = trees
        while not isinstance(state, CollocationState):  # Derivatives follow the state.
            state = state[0]
        return lax.cond(
            jnp.any(state.has_cycle > 0.5),
            function,
            lambda *arguments: make_zeros_like_output(function, *arguments),
            parameters,
            trees,
        )

    return evaluate


def make_tangent_function(
    collocation_system: CollocationSystem, skips_batches_without_cycles: bool = False
) -> Callable:
    """Return a differentiable function that computes `_compute_collocation_tangents`
    for one wheel.
    """
    if collocation_system.coarse_options is not None:
        return collocation_system.on_each_mesh(
            functools.partial(make_tangent_function, skips_batches_without_cycles=True)
        )
    compute_tangents = with_implicit_derivative(
        functools.partial(_compute_collocation_tangents, collocation_system),
        lambda *primal_arrays: compute_tangents(*primal_arrays),
        make_derivative_compiler(collocation_system, skips_batches_without_cycles),
    )
    return compute_tangents


def _search_in_scaled_units(
    collocation_system: CollocationSystem,
    run_attempts: BatchFunction,
    starts_only_from_guess: bool,
    parameters: LaneParameters,
    *si_guess: CollocationState,
) -> CycleSearchResult:
    """Run `search_all_attempts` in units of the wheel, and return the result in SI units.

    The units of the wheel are those of length and time. The section state is (theta, dtheta) after
    a landing. The state at the end of each gait step is (theta, L1) and their rates. Mass is not
    converted, because no unknown contains mass.
    """
    wheel_units = compute_wheel_units(
        compute_symbols(collocation_system.n_legs, *parameters[: len(PARAMETER_NAMES)])
    )._replace(mass_unit=1.0)
    time_unit = wheel_units.time_unit
    angle_unit = jnp.ones_like(time_unit)
    position_units = jnp.stack([angle_unit, wheel_units.length_unit, wheel_units.length_unit])
    section_units = jnp.stack([angle_unit, 1.0 / time_unit])
    acceleration_units = tuple(
        position_units[: phase.n_coordinates] / (time_unit * time_unit)
        for phase in collocation_system.phase_sequence.phases
    )
    no_unit: Any = 1.0
    state_units = CollocationState(
        solution=CollocationSolution(section_units, time_unit, acceleration_units),
        is_phase_active=no_unit,
        has_cycle=no_unit,
        failed_check=no_unit,
        gait_step_end_states=jnp.concatenate([position_units[:2], position_units[:2] / time_unit]),
    )
    scaled_search_guess = jax.tree.map(operator.truediv, si_guess, (state_units,) * len(si_guess))
    scaled_values = [
        parameter_value / wheel_units.compute_unit_in_si(parameter_domain.unit)
        for parameter_value, parameter_domain in zip(
            parameters, PARAMETER_DOMAINS.values(), strict=False
        )
    ]
    # A law is evaluated in SI units.
    scaled_parameters = collocation_system.complete_parameters(
        jnp.stack([*scaled_values, *parameters[len(PARAMETER_NAMES) :]]),
        wheel_units.length_unit,
        time_unit,
    )
    search_result = search_all_attempts(
        collocation_system,
        run_attempts,
        starts_only_from_guess,
        scaled_parameters,
        *scaled_search_guess,
    )
    monodromy_matrix = section_units[:, None] * search_result.monodromy_matrix / section_units
    return search_result._replace(
        collocation_state=jax.tree.map(operator.mul, search_result.collocation_state, state_units),
        monodromy_matrix=monodromy_matrix,
    )


SearchMissingCycles = Callable[..., CycleSearchResult]
"""Function of a collocation system, parameters, a search result and optionally a guess, as NumPy
arrays, which returns the result with further cycles.
"""


def solve_cycle_with_derivatives(
    collocation_system: CollocationSystem,
    parameters: Array,
    search_guess: CollocationState | None,
    starts_only_from_guess: bool = False,
    search_missing_cycles: SearchMissingCycles | None = None,
) -> tuple[CollocationState, tuple]:
    """Return the collocation state for the cycle of one wheel, and diagnostics of the search.

    The state is differentiable with respect to the parameters. The guess has no derivatives.

    - `search_missing_cycles`: Python function that searches again for cycles that were not found.
    """
    searched_system = collocation_system.coarse_system
    batched_search = compile_batch_function(
        functools.partial(run_search_attempts, searched_system),
        searched_system.cycle_options.batch_size,
    )

    def search_lanes(parameters: LaneParameters, *guess: CollocationState) -> CycleSearchResult:
        search_result = _search_in_scaled_units(
            searched_system, batched_search, starts_only_from_guess, parameters, *guess
        )
        if collocation_system.coarse_options is not None:
            zeros = init_search_result(collocation_system, parameters)
            search_result = jax.tree.map(
                lambda x, y: pad_with_zeros(x, y.shape), search_result, zeros
            )
        if search_missing_cycles is None:
            return search_result
        return lax.cond(
            jnp.all(search_result.collocation_state.has_cycle > 0.5),
            lambda: search_result,
            lambda: call_python(
                functools.partial(search_missing_cycles, collocation_system),
                jax.tree.map(jax.typeof, search_result),
                parameters,
                search_result,
                *guess,
            ),
        )

    search_one_wheel = unbatch(search_lanes)
    compute_tangents = make_tangent_function(collocation_system)

    @jax.custom_jvp
    def solve_with_jvp_rule(
        parameters: Array, *search_guess: CollocationState
    ) -> tuple[CollocationState, tuple]:
        collocation_state, *search_diagnostics = search_one_wheel(parameters, *search_guess)
        return collocation_state, tuple(search_diagnostics)

    @solve_with_jvp_rule.defjvp
    @with_default_jax_settings
    def jvp_rule(primals: tuple, tangents: tuple) -> tuple:
        collocation_state, search_diagnostics = solve_with_jvp_rule(*primals)
        state_tangent = apply_jacobian(compute_tangents(primals[0], collocation_state), tangents[0])
        return (collocation_state, search_diagnostics), (
            state_tangent,
            make_zero_tangent(search_diagnostics),
        )

    return solve_with_jvp_rule(parameters, *(() if search_guess is None else (search_guess,)))


def attach_monodromy_derivatives(
    collocation_system: CollocationSystem,
    monodromy_value: Array,
    parameters: Array,
    collocation_state: CollocationState,
) -> Array:
    """Return `monodromy_value` with the derivatives of the monodromy matrix on the
    branch of cycles.
    """
    skips = collocation_system.coarse_options is not None

    def make_monodromy_jacobian(system: CollocationSystem) -> Callable:
        return make_implicit_jacobian(
            functools.partial(_compute_masked_monodromy, system),
            make_tangent_function(system, skips),
            make_derivative_compiler(system, skips),
            make_jacobian=functools.partial(_compute_monodromy_tangents, system),
        )

    return attach_derivatives(
        collocation_system.on_each_mesh(make_monodromy_jacobian),
        monodromy_value,
        parameters,
        collocation_state,
    )


def attach_derivatives(
    compute_parameter_jacobian: Callable, value: Any, parameters: Array, gait: Any
) -> Any:
    """Return `value` with the derivatives that a function of the parameters and a gait returns."""

    @jax.custom_jvp
    def attach_with_jvp_rule(value: Any, parameters: Array, gait: Any) -> Any:
        return value

    @attach_with_jvp_rule.defjvp
    @with_default_jax_settings
    def jvp_rule(primals: tuple, tangents: tuple) -> tuple:
        return attach_with_jvp_rule(*primals), apply_jacobian(
            compute_parameter_jacobian(*primals[1:]), tangents[1]
        )

    return attach_with_jvp_rule(value, parameters, gait)


N_DOUBLINGS = 45
"""Number of doublings of the steps whose effects are summed. The value is chosen because the sum is
then complete, unless the modulus of a multiplier differs from 1 by little more than round-off.
"""


class SlopeResponse(NamedTuple):
    """Derivatives of a gait step with respect to its start state and the slopes of the ground.

    A gait step depends on two successive lines of the ground. Let x[k] be the start state of step
    k, y[k] its measures, and e[k] the deviation of the slope of line k. Then x[k+1] = A x[k] + B1
    e[k] + B0 e[k+1] and y[k] = C x[k] + D1 e[k] + D0 e[k+1].
    """

    A: Float[Array, "n n"]
    B1: Float[Array, " n"]
    B0: Float[Array, " n"]
    C: Float[Array, "n_measures n"]
    D1: Float[Array, " n_measures"]
    D0: Float[Array, " n_measures"]

    @classmethod
    def from_jacobian(cls, step_jacobian: Array, n_state_entries: int) -> "SlopeResponse":
        """Build the response from the Jacobian of (end state, measures).

        The Jacobian is with respect to (start state, slope, next slope). A state has
        `n_state_entries` entries.
        """
        end_state_rows, measure_rows = (
            step_jacobian[:n_state_entries],
            step_jacobian[n_state_entries:],
        )
        return cls(
            end_state_rows[:, :n_state_entries],
            end_state_rows[:, n_state_entries],
            end_state_rows[:, n_state_entries + 1],
            measure_rows[:, :n_state_entries],
            measure_rows[:, n_state_entries],
            measure_rows[:, n_state_entries + 1],
        )

    def select_measures(self, measure_indices: Sequence[int]) -> "SlopeResponse":
        """Return the response of the measures with the indices `measure_indices`."""
        measure_index_array = jnp.asarray(measure_indices)
        return self._replace(
            C=self.C[measure_index_array],
            D1=self.D1[measure_index_array],
            D0=self.D0[measure_index_array],
        )


class SensitivityNormParts(NamedTuple):
    """Gait sensitivity norm of each measure and its three parts, in the measure's unit per rad.

    The squares of the parts sum to the square of the norm. Each part is a response to the deviation
    of the slope of one line of the ground. The first two parts have a sign. They belong to the gait
    step that ends on that line and to the step that begins on it. The third part belongs to all
    later steps.
    """

    sensitivity_norms: Float[Array, " n_measures"]
    ending_step_response: Float[Array, " n_measures"]
    beginning_step_response: Float[Array, " n_measures"]
    later_steps_response: Float[Array, " n_measures"]


def compute_sensitivity_norms(slope_response: SlopeResponse) -> SensitivityNormParts:
    """Return the ratio of each measure's standard deviation to that of independent slopes.

    The responses to the deviation of one line are D0, then C B0 + D1, then C A^j b. Here b = A B0 +
    B1 and j = 0, 1, .... The squares of C A^j b sum to C P C^T. The matrix P solves the discrete
    Lyapunov equation `P = A P A^T + b b^T`. The norm is infinite if the gait is not stable.
    """
    A, B1, B0, C, D1, D0 = slope_response
    is_gait_stable = small_matrices.compute_spectral_radius(lax.stop_gradient(A)) < 1.0
    A = jnp.where(is_gait_stable, A, 0.0)
    b = A @ B0 + B1

    def double(_: Any, state: tuple[Array, Array]) -> tuple[Array, Array]:
        """Return A^2m and the sum of A^j b b^T A^Tj below j = 2m, from those of m."""
        power, covariance = state
        return power @ power, covariance + power @ covariance @ power.T

    _, P = lax.fori_loop(0, N_DOUBLINGS, double, (A, jnp.outer(b, b)))
    later_steps_squared = jnp.einsum("mi,ij,mj->m", C, P, C)
    beginning_step_response = C @ B0 + D1
    sensitivity_norm = compute_square_root(D0**2 + beginning_step_response**2 + later_steps_squared)
    infinite_if_unstable = lambda unbounded_sensitivity: jnp.where(
        is_gait_stable, unbounded_sensitivity, jnp.inf
    )
    return SensitivityNormParts(
        infinite_if_unstable(sensitivity_norm),
        D0,
        beginning_step_response,
        infinite_if_unstable(compute_square_root(later_steps_squared)),
    )


@eqx.filter_jit
def compute_step_slope_response(
    model: Any,
    params: WheelParams,
    section_state: Array,
    measure_names: Sequence[str],
    options: StepOptions,
) -> SlopeResponse:
    """Return the slope response of an event-driven step that starts at the section state of a gait.

    The discrete codes in the section state do not vary.
    """
    n_state_entries = model.count_continuous_section_entries(params)
    section_state_codes = section_state[n_state_entries:]

    def evaluate_step(step_start_and_slopes: Array) -> Array:
        stepwise_ground: Any = model.split_ground_by_step(
            eqx.tree_at(lambda p: p.slope, params, step_start_and_slopes[n_state_entries:]), 1
        )
        step_model, step_params = model.with_step_ground(
            params, tuple(ground_quantity_by_step[0] for ground_quantity_by_step in stepwise_ground)
        )
        gait_step = step_model.take_step(
            step_params,
            jnp.concatenate([step_start_and_slopes[:n_state_entries], section_state_codes]),
            options,
        )
        step_measures = gait_step.measures()
        measure_values = [jnp.ravel(step_measures[measure_name]) for measure_name in measure_names]
        return jnp.concatenate([gait_step.section_state[:n_state_entries], *measure_values])

    step_start_and_slopes = jnp.concatenate(
        [section_state[:n_state_entries], jnp.stack([params.slope, params.slope])]
    )
    return SlopeResponse.from_jacobian(
        jax.jacfwd(evaluate_step)(step_start_and_slopes), n_state_entries
    )


COLLOCATION_RESPONSE_MEASURES = (
    "dls_fraction",
    "period",
    "speed",
    "step_length",
    "duration_dls",
    "duration_sls1",
    "duration_sls2",
)
"""Names of the measures of a gait step that follow from its durations and its first landing."""


@functools.cache
def make_slope_response_function(collocation_system: CollocationSystem) -> Callable:
    """Return the slope response of a gait step of the paper's model, computed from its collocation.

    The result is a function of the parameters and the collocation state of a gait. The measures are
    `COLLOCATION_RESPONSE_MEASURES`. The state is (theta+, dtheta+) just after a landing, in the
    frame of the line of the ground under both feet. The response is differentiable on the branch of
    gaits, in every mode and to any order.
    """
    compute_jacobian = with_implicit_derivative(
        functools.partial(_compute_step_jacobian, collocation_system),
        make_tangent_function(collocation_system),
        make_derivative_compiler(collocation_system),
    )
    n_state_entries = collocation_system.phase_sequence.section_size
    return jax.jit(
        lambda parameters, collocation_state: SlopeResponse.from_jacobian(
            compute_jacobian(parameters, lax.stop_gradient(collocation_state)), n_state_entries
        )
    )


def _compute_step_jacobian(
    collocation_system: CollocationSystem,
    parameters: LaneParameters,
    collocation_state: CollocationState,
) -> Array:
    """Return the Jacobian of (end state, measures) with respect to (start state, slope, next
    slope), for each wheel on the last axis.
    """
    solution, sequence = collocation_state.solution, collocation_system.phase_sequence
    # The last constant of a phase is the angle by which the next line is steeper.
    parameters = jnp.concatenate(
        [collocation_system.complete_parameters(parameters), jnp.zeros_like(parameters[:1])]
    )
    (_, end_tangents), (_, _, duration_tangents, _) = linearize_steps(
        collocation_system,
        parameters,
        solution,
        collocation_state.is_phase_active,
        (PARAMETER_NAMES.index("slope"), len(parameters) - 1),
    )
    phase_constants = collocation_system.phase_constants_function(*parameters)

    def measure(section_state: Array, durations: Array) -> Array:
        start = sequence.step_start_map(phase_constants, tuple(section_state))
        period, (step_length,) = jnp.sum(durations, 0), start.held_constants
        fraction, speed = durations[0] / period, step_length / period
        return jnp.stack([fraction, period, speed, step_length, *durations])

    n_directions, n_coordinates, _ = end_tangents.shape
    start_tangents = jnp.eye(n_directions, n_coordinates, -1, parameters.dtype)[..., None]
    _, measure_tangents = evaluate_with_jvps(
        measure,
        (solution.section_state, solution.durations[0]),
        (jnp.broadcast_to(start_tangents, end_tangents.shape), duration_tangents[0]),
    )
    tangents = jnp.concatenate([end_tangents, measure_tangents], 1)[1:]
    by_slope, by_tilt = tangents[-2:]
    return jnp.stack([*tangents[:-2], by_slope - by_tilt, by_tilt], 1)
