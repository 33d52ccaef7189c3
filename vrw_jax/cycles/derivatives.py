"""Derivatives of limit cycles by the implicit function theorem, to any order and in any mode.

First derivatives are the tangents of the linearized pass at the cycle. Second derivatives are
derivatives of that pass, of its tangents and of the monodromy matrix. They are taken along the
tangents of the cycle, one parameter after another. Both are machine code on a CPU.
"""

import functools
import operator
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from vrw_jax import simd
from vrw_jax.collocation import CollocationSolution
from vrw_jax.cycles.collocation_search import (
    CollocationState,
    CollocationSystem,
    Parameters,
    SearchResult,
    register_export_names,
    search_in_stages,
    search_lanes,
    state_tangents,
)
from vrw_jax.models import unit_scaling as scales
from vrw_jax.numerics import (
    BatchFunction,
    ExecutionWrapper,
    apply_jacobian,
    implicit_jacobian,
    make_blockwise,
    unbatch,
    with_implicit_derivative,
    zero_tangent,
)
from vrw_jax.runtime import cached_lane_function, cached_trace, with_default_settings
from vrw_jax.wheel import PARAMETER_DOMAINS, PARAMETER_NAMES, compute_symbols, compute_wheel_units


def _collocation_tangents(
    system: CollocationSystem, parameters: Parameters, collocation_state: CollocationState
) -> CollocationState:
    """Return the derivatives of the state with respect to the parameters, on a leading axis, for
    each lane.

    They are zero if no cycle was found.
    """
    linearized_pass = system.linearize_at(
        parameters, collocation_state, tuple(range(parameters.shape[0]))
    )
    return _mask_not_found(collocation_state, state_tangents(linearized_pass, collocation_state))


def _masked_monodromy(
    system: CollocationSystem, parameters: Parameters, collocation_state: CollocationState
) -> Array:
    return _mask_not_found(
        collocation_state, system.linearize_at(parameters, collocation_state).monodromy
    )


def _monodromy_tangents(
    system: CollocationSystem,
    parameters: Parameters,
    solution_and_tangents: tuple[CollocationState, CollocationState],
) -> Array:
    """Return the derivatives of the monodromy matrix along the branch, on a leading axis over
    parameters.

    `solution_and_tangents` are z and dz/dp. The directions are computed one after another, so that
    the compiled code is as short as for one. Three of the nine derivatives follow from a change of
    units. For the unit of mass, the direction increases both masses by the same factor; it leaves
    the forces of the ground and of the legs unchanged.
    """
    collocation_state, tangents = solution_and_tangents
    hub_index, leg_index = (PARAMETER_NAMES.index(name) for name in ("hub_mass", "leg_mass"))
    total_mass = parameters[hub_index] + parameters[leg_index]
    hub_share, leg_share = parameters[hub_index] / total_mass, parameters[leg_index] / total_mass
    other_indices = [
        i
        for i in range(len(parameters))
        if i not in (hub_index, leg_index, *scales.SCALING_BY_PARAMETER)
    ]
    ones, zeros = jnp.ones_like(total_mass), jnp.zeros_like(total_mass)
    first_indices = jnp.asarray([*other_indices, leg_index])
    second_indices = jnp.asarray([*other_indices, hub_index])
    weights = (
        jnp.stack([ones] * len(other_indices) + [hub_share]),
        jnp.stack([zeros] * len(other_indices) + [-leg_share]),
    )
    identity = jnp.eye(len(parameters), dtype=parameters.dtype)[..., None]
    parameter_tangents = jnp.broadcast_to(identity, (len(parameters), *parameters.shape))

    def monodromy_tangent(direction: tuple) -> tuple[Array, Array]:
        first_index, second_index, first_weight, second_weight = direction
        select_entry = lambda x, first_index: lax.dynamic_index_in_dim(
            x, first_index, keepdims=False
        )
        direction = jax.tree.map(
            lambda x: (
                first_weight * select_entry(x, first_index)
                + second_weight * select_entry(x, second_index)
            ),
            (parameter_tangents, tangents),
        )
        return jax.jvp(
            functools.partial(_masked_monodromy, system), (parameters, collocation_state), direction
        )

    matrices, monodromy_tangents = lax.map(
        monodromy_tangent, (first_indices, second_indices, *weights)
    )
    tangent_by_parameter = dict(zip(other_indices, monodromy_tangents[:-1], strict=True))
    mass_scale_tangent = (
        scales.MASS_SCALING.subtract_columns(
            jnp.zeros_like(monodromy_tangents[0]), tuple(parameters), tangent_by_parameter
        )
        / total_mass
    )
    squared_direction_norm = hub_share * hub_share + leg_share * leg_share
    tangent_by_parameter[hub_index] = (
        hub_share * mass_scale_tangent - leg_share * monodromy_tangents[-1]
    ) / squared_direction_norm
    tangent_by_parameter[leg_index] = (
        leg_share * mass_scale_tangent + hub_share * monodromy_tangents[-1]
    ) / squared_direction_norm
    time_scale_tangent = (
        jnp.asarray([[0, 1], [-1, 0]])[..., None] * matrices[0]
    )  # tangent of the monodromy over (angle, rate)
    time_scale_tangents = {
        i: time_scale_tangent
        if unit_scale is scales.TIME_SCALING
        else jnp.zeros_like(time_scale_tangent)
        for i, unit_scale in scales.SCALING_BY_PARAMETER.items()
    }
    tangent_by_parameter = scales.complete_by_scaling(
        tuple(parameters), tangent_by_parameter, time_scale_tangents
    )
    return jnp.stack([tangent_by_parameter[i] for i in range(len(parameters))])


def _mask_not_found(collocation_state: CollocationState, tree: Any) -> Any:
    """Return the tree with zeros in the lanes without a cycle."""
    return jax.tree.map(lambda x: jnp.where(collocation_state.found > 0.5, x, 0.0), tree)


def compile_batched(
    function: BatchFunction, make_output_template: Callable, cache_key: tuple, batch_size: int
) -> BatchFunction:
    """Return a batched function compiled in its fastest form: machine code on a CPU, else XLA in
    blocks.
    """
    if simd.is_available():
        return cached_lane_function(function, make_output_template, cache_key)
    register_export_names()
    return cached_trace(make_blockwise(function, batch_size), cache_key)


def _make_compiler(
    name: str, make_templates: tuple[Callable, ...], system: CollocationSystem
) -> ExecutionWrapper:
    """Return a function that compiles a batch function, given the order of the derivative it
    computes.

    Orders with an output template use `compile_batched`, higher orders XLA.
    """
    batch_size = system.options.batch_size

    def compile_function(function: BatchFunction, order: int) -> BatchFunction:
        if order < len(make_templates):
            return compile_batched(
                function, make_templates[order], (name, order, system), batch_size
            )
        return make_blockwise(function, batch_size)

    return compile_function


def _make_tangent_function(system: CollocationSystem) -> Callable:
    """Return `_collocation_tangents` of one wheel as a differentiable function."""
    make_templates = (
        (lambda parameters, collocation_state: collocation_state),
        (lambda parameters, solution_and_tangents: solution_and_tangents[0]),
    )
    compile_function = _make_compiler("columns", make_templates, system)
    tangents = with_implicit_derivative(
        functools.partial(_collocation_tangents, system),
        lambda *at: tangents(*at),
        compile_function,
    )
    return tangents


def _search_in_scaled_units(
    system: CollocationSystem,
    search: BatchFunction,
    parameters: Parameters,
    *guess: CollocationState,
) -> SearchResult:
    """Return the result of `search_in_stages` in SI, searched in the wheel's own units of length
    and time.

    The section is (theta, dtheta) after a landing; the step ends are (theta, L1) and their rates.
    Mass is not converted, because no unknown contains it.
    """
    units = compute_wheel_units(compute_symbols(system.n_legs, *parameters))._replace(mass=1.0)
    angle_unit, time_unit = jnp.ones_like(units.time), units.time
    position_units = jnp.stack([angle_unit, units.length, units.length])
    section_units = jnp.stack([angle_unit, 1.0 / time_unit])
    end_units = jnp.concatenate([position_units[:2], position_units[:2] / time_unit])

    def convert_units(
        state: CollocationState, apply_unit: Callable[[Array, Array], Array]
    ) -> CollocationState:
        """Return the state with each number converted by `apply_unit(number, unit)`."""
        solution = state.solution
        accelerations = tuple(
            apply_unit(x, position_units[: x.shape[-2]] / (time_unit * time_unit))
            for x in solution.accelerations
        )
        solution = CollocationSolution(
            apply_unit(solution.section_state, section_units),
            apply_unit(solution.durations, time_unit),
            accelerations,
        )
        return state._replace(solution=solution, ends=apply_unit(state.ends, end_units))

    scaled_guess = tuple(convert_units(state, operator.truediv) for state in guess)
    parameter_units = [
        units.si_value(parameter_domain.unit) for parameter_domain in PARAMETER_DOMAINS.values()
    ]
    scaled_parameters = [x / unit for x, unit in zip(parameters, parameter_units, strict=True)]
    result = search_in_stages(system, search, jnp.stack(scaled_parameters), *scaled_guess)
    monodromy = section_units[:, None] * result.monodromy / section_units
    return result._replace(state=convert_units(result.state, operator.mul), monodromy=monodromy)


def solve_cycle_with_derivatives(
    system: CollocationSystem, parameters: Array, guess: CollocationState | None
) -> tuple[CollocationState, tuple]:
    """Return the cycle of one wheel, differentiable in its parameters, and the diagnostics of the
    search.

    The guess has no derivative.
    """
    search_problem = functools.partial(search_lanes, system)
    make_template = lambda parameters, start, *_: start
    batched_search = compile_batched(
        search_problem, make_template, ("search", system), system.options.batch_size
    )
    search_single_wheel = unbatch(
        functools.partial(_search_in_scaled_units, system, batched_search)
    )
    tangents_of = _make_tangent_function(system)

    @jax.custom_jvp
    def solve_with_rule(
        parameters: Array, *guess: CollocationState
    ) -> tuple[CollocationState, tuple]:
        collocation_state, *diagnostics = search_single_wheel(parameters, *guess)
        return collocation_state, tuple(diagnostics)

    @solve_with_rule.defjvp
    @with_default_settings
    def jvp_rule(primals: tuple, tangents: tuple) -> tuple:
        collocation_state, diagnostics = solve_with_rule(*primals)
        tangent = apply_jacobian(tangents_of(primals[0], collocation_state), tangents[0])
        return (collocation_state, diagnostics), (tangent, zero_tangent(diagnostics))

    return solve_with_rule(parameters, *(() if guess is None else (guess,)))


def attach_monodromy(
    system: CollocationSystem,
    monodromy_value: Array,
    parameters: Array,
    collocation_state: CollocationState,
) -> Array:
    """Return `monodromy_value` with the derivatives of the monodromy matrix along the branch."""
    make_template = lambda parameters, solution_and_tangents: parameters
    compile_function = _make_compiler("monodromy", (make_template, make_template), system)
    monodromy_of = functools.partial(_masked_monodromy, system)
    tangents_of_monodromy = functools.partial(_monodromy_tangents, system)
    jacobian_of = implicit_jacobian(
        monodromy_of,
        _make_tangent_function(system),
        compile_function,
        make_jacobian=tangents_of_monodromy,
    )

    @jax.custom_jvp
    def attach_with_rule(
        monodromy_value: Array, parameters: Array, collocation_state: CollocationState
    ) -> Array:
        return monodromy_value

    @attach_with_rule.defjvp
    @with_default_settings
    def jvp_rule(primals: tuple, tangents: tuple) -> tuple:
        return attach_with_rule(*primals), apply_jacobian(jacobian_of(*primals[1:]), tangents[1])

    return attach_with_rule(monodromy_value, parameters, collocation_state)
