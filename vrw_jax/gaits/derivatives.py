"""Differentiate limit cycles by the implicit function theorem, to any order and in any mode.

First derivatives are the tangents of the linearization at the cycle. Second derivatives are JVPs of
the linearization, of its tangents and of the monodromy matrix. The direction of each JVP is the
derivative of the cycle with respect to one parameter. On a CPU, the first and the second order are
computed by machine code. A lane is the batch element of one wheel.
"""

import functools
import operator
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from vrw_jax.gaits.collocation_search import (
    CycleSearchResult,
    init_search_result,
    run_search_attempts,
    search_all_attempts,
)
from vrw_jax.gaits.phase_collocation import CollocationSolution
from vrw_jax.gaits.phase_sequence import (
    CollocationState,
    CollocationSystem,
    LaneParameters,
    pad_with_zeros,
)
from vrw_jax.lanes.autodiff import (
    ExecutionWrapper,
    apply_jacobian,
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
from vrw_jax.lanes.lane_function import compile_batch_function
from vrw_jax.lanes.settings import call_python, with_default_jax_settings
from vrw_jax.models import unit_scaling as scales
from vrw_jax.wheel.params import (
    NO_LAWS,
    PARAMETER_DOMAINS,
    PARAMETER_NAMES,
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
    n_compiled_orders: int,
    collocation_system: CollocationSystem,
    skips_batches_without_cycles: bool = False,
) -> ExecutionWrapper:
    """Return a function that compiles a batch function for a given order of derivatives.

    Orders below `n_compiled_orders` become machine code. XLA computes higher orders.
    """
    batch_size = collocation_system.cycle_options.batch_size

    def compile_function(
        function_of_element: BatchFunction, derivative_order: int
    ) -> BatchFunction:
        compiled: BatchFunction
        if derivative_order < n_compiled_orders:
            compiled = compile_batch_function(function_of_element, batch_size)
        else:
            compiled = apply_function_in_blocks(function_of_element, batch_size)
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
        make_derivative_compiler(2, collocation_system, skips_batches_without_cycles),
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
            make_derivative_compiler(2, system, skips),
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
