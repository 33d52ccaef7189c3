"""Propagate tangents from the start and the constants of a phase to its end, for a batch.

Each Runge-Kutta step is repeated for the linearized equations, for all requested directions. The
Jacobians at the stages are the same for all directions and are computed once. Each direction then
costs about a hundred products. Step sizes and iterations of the event search are not
differentiated. The derivative is that of the discrete flow with constant step lengths, and of the
time at which the guard becomes zero.

Directions come from `jax.vmap` around a derivative. This module stores the directions on the first
axis of arrays. Loops are therefore traced once and not again for the vmap.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jax.custom_batching import custom_vmap
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir
from jaxtyping import Array, PyTree

from vrw_jax import lanes
from vrw_jax.base.types import Vector
from vrw_jax.flow.tableaus import (
    ButcherTableau,
    EvaluateAcceleration,
    SolverStepFunction,
    StageAccelerations,
    StageState,
    evaluate_stage,
)
from vrw_jax.lanes.code_cache import targets_machine_code


class ImplicitDynamics(NamedTuple):
    """Implicit form of the equations of motion near a state."""

    evaluate_residual: Callable[[StageState], Vector]
    """Function that returns the left minus the right side of the equations of motion."""
    solve_for_accelerations: Callable[[StageState, Vector], Vector]
    """Function that returns accelerations for which the left side equals the second argument."""


class BatchPhase(NamedTuple):
    """Functions that define a phase, elementwise for all batch elements.

    The function `evaluate_acceleration` returns the accelerations at a state. The guards are
    positive inside the phase, and an event occurs when a guard falls through zero. The earliest
    event ends the phase. If two guards are zero at the same time, the first in the list ends the
    phase.
    """

    evaluate_acceleration: EvaluateAcceleration
    evaluate_guards: Callable[[StageState], Array]
    """Function that returns all guards as one array (guards, batch)."""
    evaluate_margins: Callable[[StageState], Vector] = lambda stage_state: ()
    """Function that returns the margins whose minima are computed."""
    margins_include_start: tuple[bool, ...] = ()
    """Whether each margin counts at the phase's start, see `hybrid.GuardsAndMargins`."""
    implicit_dynamics: ImplicitDynamics = None  # type: ignore[assignment]
    """Equations of motion in implicit form. Only derivatives need them."""
    is_compiled_separately: bool = False
    """Whether machine code calls the phase's functions instead of inlining them at each use.

    With calls, the code compiles in half of the time and runs a sixth slower than with inlining.
    """
    state_units: Vector | None = None
    """Units of the coordinates `q` and of their rates `v` for the absolute tolerance.

    The default is SI units.
    """
    take_solver_step: SolverStepFunction | None = None
    """Solver step of the phase; by default, a step of the tableau."""
    take_last_step: Callable[[StageState, Array], list[StageState]] | None = None
    """Function that returns the stages of the same solver step by shorter and slower code, for the
    search for events."""
    has_exact_events: bool = False
    """Whether an event is located to round-off, and not to the tolerances."""
    max_event_correction: Array | None = None
    """Largest last correction of an exact event's time, as a fraction of the solver step.

    The state is extrapolated linearly over the correction, with an error of its square. By default,
    that error is round-off.
    """
    guards_rising_at_start: Array | None = None
    """Whether each guard rises from its round-off at the start of the phase.

    Such a guard has no minimum in the first solver step. If it grows as the cube of the time, the
    errors of inner stages are as large as its values. By default, such guards start at zero.
    """
    guard_scales: Array | None = None
    """Magnitudes of the guards' terms if events are exact, see `hybrid.GuardsAndMargins`."""
    guards_met_at_start: Array | None = None
    """Whether each guard ends the phase at its start; by default, its value and rate decide."""
    evaluate_kinks: Callable[[StageState], Vector] | None = None
    """Function that returns the values of functions at whose zeros the equations have kinks."""
    on_sides: Callable[[Vector], "BatchPhase"] = lambda sides: NotImplemented
    """Function that returns the phase with equations that are smooth, for the signs of the values
    of `evaluate_kinks`. Each kink adds a guard, which triggers where its sign changes.
    """
    sides: Vector = ()
    """Signs for which the equations are smooth; empty without kinks."""
    n_logged_kinks: int = 0
    """Largest number of kinks that the end of the phase lists, see `kinks.KinkLog`."""

    def make_state(self, q: Any, v: Any) -> StageState:
        """Return the state with positions `q`, rates `v` and the accelerations there."""
        return StageState(q, v, self.evaluate_acceleration(q, v))

    def evaluate_with_rates(
        self, evaluate_functions: Callable[[StageState], Any], state: StageState
    ) -> tuple[Any, Any]:
        """Return the values of `evaluate_functions` at a state, and their time derivatives."""
        return jax.jvp(
            lambda q, v: evaluate_functions(self.make_state(q, v)),
            (state.q, state.v),
            (state.v[: len(state.q)], state.acceleration.acceleration[: len(state.v)]),
        )


MakeBatchPhase = Callable[[Any, Vector], BatchPhase]
"""Function that returns the `BatchPhase` for two kinds of constants.

The first argument is a tree of arrays with few tangent directions. The second argument contains the
held constants. These are arrays that are constant during the phase and have arbitrary tangents,
such as the state at its start.
"""


def apply_batched_jvp_rule(
    evaluate_jvp_rule: Callable[[Any, Any], tuple[Any, Any]], primals: Any, tangents: Any
) -> tuple[Any, Any]:
    """Return the values and tangents of a JVP rule that computes all directions of a vmap together.

    - `evaluate_jvp_rule`: function of primals and tangents that returns the values and their
      tangents. The first axis of its tangents contains the directions. The length of this axis is 1
      if all directions have the same tangents;
    - `primals`, `tangents`: arguments of the JVP rule, without an axis of directions.
    """
    leaves, tree_structure = jax.tree.flatten((primals, tangents))
    n_primal_leaves = len(jax.tree.leaves(primals))
    n_directions = len(_count_vmapped_directions(tangents))
    if n_directions == 0:
        function_values, output_tangents = evaluate_jvp_rule(
            primals, jax.tree.map(lambda x: x[None], tangents)
        )
        return function_values, jax.tree.map(lambda x: x[0], output_tangents)
    output_structure: Any = None

    def evaluate_batched_jvp_rule(leaves: Any, axes: Any) -> tuple[list, list]:
        nonlocal output_structure
        if any(leaf_axis is not None for leaf_axis in axes[:n_primal_leaves]):
            raise NotImplementedError(
                "jax.vmap around a derivative of lanes maps its directions only: put batches of "
                "values on the lanes' axis, the last one."
            )
        leaves_and_axes = zip(leaves[n_primal_leaves:], axes[n_primal_leaves:], strict=True)
        direction_leaves = [
            x[None] if leaf_axis is None else jnp.moveaxis(x, leaf_axis, 0)
            for x, leaf_axis in leaves_and_axes
        ]
        function_values, output_tangents = evaluate_jvp_rule(
            *jax.tree.unflatten(tree_structure, [*leaves[:n_primal_leaves], *direction_leaves])
        )
        output_tangents = jax.tree.map(
            lambda x: jnp.broadcast_to(x, (n_directions, *x.shape[1:])), output_tangents
        )
        flat_results, output_structure = jax.tree.flatten((function_values, output_tangents))
        n_function_values = len(jax.tree.leaves(function_values))
        return flat_results, [None] * n_function_values + [0] * (
            len(flat_results) - n_function_values
        )

    flat_results = _HOIST_OUT_OF_VMAP_PRIMITIVE.bind(
        *leaves, map_over_axes=evaluate_batched_jvp_rule
    )
    return jax.tree.unflatten(output_structure, flat_results)


@custom_vmap
def _count_vmapped_directions(_: Any) -> Array:
    """Return zeros whose length is the number of directions in an enclosing `jax.vmap`.

    Without such a vmap, the array is empty.
    """
    return jnp.zeros(0)


@_count_vmapped_directions.def_vmap
@lanes.with_default_jax_settings
def _count_vmapped_directions_rule(n_directions: int, _: list, _tangent: Any) -> tuple[Array, bool]:
    return jnp.zeros(n_directions), False


_HOIST_OUT_OF_VMAP_PRIMITIVE = Primitive("beyond")
_HOIST_OUT_OF_VMAP_PRIMITIVE.multiple_results = True
batching.primitive_batchers[_HOIST_OUT_OF_VMAP_PRIMITIVE] = lambda values, axes, map_over_axes: (
    map_over_axes(values, axes)
)
"""Primitive whose function is traced outside of the enclosing `jax.vmap`, which would trace its
loops again.
"""


def _map_directions(
    evaluate_for_direction: Callable[[Any], Any], directions: Any, is_unrolled: bool = False
) -> Any:
    """Return the results of a function for all directions.

    They are computed in a loop, which makes the values for one direction fit into registers. With
    `is_unrolled` there is no loop, so that the compiler removes entries that are known to be zero.
    """
    varying_tangents, shared_tangents = eqx.partition(directions, lambda x: len(x) > 1)
    shared_tangents = jax.tree.map(lambda x: x[0], shared_tangents)
    evaluate_varying = lambda tangents: evaluate_for_direction(
        eqx.combine(tangents, shared_tangents)
    )
    if not jax.tree.leaves(varying_tangents):
        return jax.tree.map(lambda x: x[None], evaluate_varying(varying_tangents))
    if is_unrolled:
        return jax.vmap(evaluate_varying)(varying_tangents)
    return lax.map(evaluate_varying, varying_tangents)


def stack_directions(directions: Vector) -> Array:
    """Return the tangents of several quantities as one array (directions, quantities, batch)."""
    return jnp.stack(jnp.broadcast_arrays(*directions), 1)


@functools.partial(jax.jit, static_argnums=0)
def _compute_stage_jacobians(
    make_phase: MakeBatchPhase,
    phase_constants: Any,
    phase_constants_directions: Any,
    held_constants: Vector,
    stage_states: list[StageState],
) -> tuple[Array, Array]:
    """Return derivatives of the accelerations at all stages of a solver step except the last.

    The first array contains the Jacobians with respect to positions, rates and held constants,
    shape (stages, coordinates, components, batch). The second array contains the tangents due to
    the constants of the phase, shape (stages, directions, coordinates, batch).
    """

    def linearize_stage(packed_state: Array) -> tuple[Array, Array]:
        # inverse of `_pack_stage_state`
        n = (len(packed_state) - 2) // 3
        state_components = tuple(packed_state)
        sin, cos, *accelerations = state_components[2 * n :]
        stage_state = StageState(
            state_components[:n],
            state_components[n : 2 * n],
            StageAccelerations(sin, cos, tuple(accelerations)),
        )
        implicit_dynamics = make_phase(phase_constants, held_constants).implicit_dynamics
        implicit_dynamics = ImplicitDynamics(*[jax.jit(f) for f in implicit_dynamics])
        evaluate_residual = lambda *constants: make_phase(
            *constants
        ).implicit_dynamics.evaluate_residual(stage_state)
        compute_acceleration_derivative = lambda *tangent: _solve_acceleration(
            implicit_dynamics, stage_state, jax.jvp(evaluate_residual, *tangent)[1]
        )
        zero_phase_constants, zero_held_constants, zero_accelerations = jax.tree.map(
            jnp.zeros_like, (phase_constants, held_constants, tuple(accelerations))
        )
        jacobian_columns = []
        for unit_vector in _make_unit_vectors((*stage_state.q, *stage_state.v)):
            theta_tangent = unit_vector[0]
            state_tangent = StageState(
                unit_vector[:n],
                unit_vector[n:],
                StageAccelerations(cos * theta_tangent, -sin * theta_tangent, zero_accelerations),
            )
            _, residual_tangent = jax.jvp(
                implicit_dynamics.evaluate_residual, (stage_state,), (state_tangent,)
            )
            jacobian_columns.append(
                _solve_acceleration(implicit_dynamics, stage_state, residual_tangent)
            )
        jacobian_columns += [
            compute_acceleration_derivative(
                (phase_constants, held_constants), (zero_phase_constants, unit_vector)
            )
            for unit_vector in _make_unit_vectors(held_constants)
        ]
        differentiate_by_phase_constants = lambda phase_constants_direction: (
            compute_acceleration_derivative(
                (phase_constants, held_constants), (phase_constants_direction, zero_held_constants)
            )
        )
        return jnp.stack(jacobian_columns, 1), _map_directions(
            differentiate_by_phase_constants, phase_constants_directions, is_unrolled=True
        )

    return lax.map(
        linearize_stage, jnp.stack([_pack_stage_state(state) for state in stage_states[:-1]])
    )


def _pack_stage_state(state: StageState) -> Array:
    """Return positions, rates, sine and cosine of theta, and accelerations as one array.

    The array has the shape (components, batch).
    """
    sin, cos, acceleration = state.acceleration
    return jnp.stack([*state.q, *state.v, sin, cos, *acceleration[: len(state.q)]])


def _make_unit_vectors(template_state: Vector) -> list[Vector]:
    n = len(template_state)
    return [
        tuple(jnp.full_like(template_state[j], float(i == j)) for j in range(n)) for i in range(n)
    ]


def _solve_acceleration(
    implicit_dynamics: ImplicitDynamics, state: StageState, residual_tangent: Vector
) -> Array:
    """Return the tangent of the accelerations that cancels a tangent of the residual.

    The result follows from the implicit function theorem.
    """
    return -jnp.stack(implicit_dynamics.solve_for_accelerations(state, residual_tangent))


@functools.partial(jax.jit, static_argnums=0)  # The function is traced once for all its calls.
def _propagate_tangents(
    tableau: ButcherTableau,
    state_jacobians: Array,
    phase_constants_tangents: Array,
    start_tangents: Array,
    h: Array,
) -> Array:
    """Return the tangents at the end of a solver step, given the tangents at its start.

    The tangents are those of positions, rates and held constants. `h` is the length of the step, s.
    """
    n = state_jacobians.shape[1]

    def propagate_tangent_direction(tangent_direction: tuple[Array, Array]) -> Array:
        phase_constants_tangent, start_tangent = tangent_direction
        start_position_tangents = tuple(start_tangent[:n])
        start_rate_tangents = tuple(start_tangent[n : 2 * n])
        held_constants_tangents = tuple(start_tangent[2 * n :])
        stage_tangents: list[Vector] = []
        q, v = start_position_tangents, start_rate_tangents
        for i in range(len(tableau.stage_nodes) - 1):
            state_tangents = (*q, *v, *held_constants_tangents)
            acceleration_tangents = [
                functools.reduce(
                    lax.add,
                    map(lax.mul, state_jacobians[i, coordinate_index], state_tangents),
                    phase_constants_tangent[i, coordinate_index],
                )
                for coordinate_index in range(n)
            ]
            stage_tangents.append(tuple(acceleration_tangents))
            q, v = evaluate_stage(
                tableau, i + 1, start_position_tangents, start_rate_tangents, stage_tangents, h
            )
        return jnp.stack([*q, *v, *held_constants_tangents])

    return _map_directions(
        propagate_tangent_direction,
        (jnp.moveaxis(phase_constants_tangents, 1, 0), start_tangents),
    )


def compute_each_jvp(function: Callable[..., Any], primals: tuple, directions: tuple) -> Any:
    """Return the tangents of a function's result for all directions, computed with `jax.jvp`.

    The program is as short as for one direction.
    """
    return _map_directions(lambda direction: jax.jvp(function, primals, direction)[1], directions)


def with_batched_jvp(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return `function` with a JVP rule that computes the tangents of all directions together.

    The rule differentiates with respect to all floating-point arrays among the arguments.
    """

    def call_with_batched_jvp(*arguments: Any) -> Any:
        float_arguments, nonfloat_arguments = eqx.partition(arguments, eqx.is_inexact_array)
        evaluate_with_float_arguments = lambda *float_arguments: function(
            *eqx.combine(float_arguments, nonfloat_arguments)
        )
        evaluate_float_results = lambda *float_arguments: eqx.filter(
            evaluate_with_float_arguments(*float_arguments), eqx.is_inexact_array
        )
        differentiable_function = jax.custom_jvp(evaluate_with_float_arguments)

        @differentiable_function.defjvp
        @lanes.with_default_jax_settings
        def evaluate_float_jvp(primals: tuple, tangent: tuple) -> tuple:
            evaluate_with_tangents = lambda primals, directions: (
                evaluate_with_float_arguments(*primals),
                compute_each_jvp(evaluate_float_results, primals, directions),
            )
            function_outputs, float_tangents = apply_batched_jvp_rule(
                evaluate_with_tangents, primals, tangent
            )
            return function_outputs, eqx.combine(
                float_tangents, lanes.make_zero_tangent(function_outputs)
            )

        return differentiable_function(*float_arguments)

    return call_with_batched_jvp


class PhaseTangents(NamedTuple):
    """Tangents of the start state, of the constants and of the held constants of a phase."""

    make_phase: MakeBatchPhase
    phase_constants: Any
    held_constants: Vector
    phase_constants_tangents: Any  # tree of the constants, directions first
    # tangents of positions, rates, held constants, (directions, components, batch)
    start_tangents: Array

    def on_sides(self, sides: Vector) -> "PhaseTangents":
        """Return the tangents in a phase with smooth equations, see `BatchPhase.on_sides`."""
        return self._replace(
            make_phase=lambda *constants: self.make_phase(*constants).on_sides(sides)
        )

    def propagate_to_step_end(
        self,
        tableau: ButcherTableau,
        stage_states: list[StageState],
        start_tangents: Array,
        h: Array,
        is_accepted: Array | bool = True,
    ) -> Array:
        """Return the tangents at the end of a solver step, given the tangents at its start.

        `h` is the length of the step, s. Elements that do not accept the step keep their tangents.
        """
        stage_jacobians = _compute_stage_jacobians(
            self.make_phase,
            self.phase_constants,
            self.phase_constants_tangents,
            self.held_constants,
            stage_states,
        )
        end_tangents = _propagate_tangents(tableau, *stage_jacobians, start_tangents, h)
        return (
            end_tangents
            if is_accepted is True
            else jnp.where(is_accepted, end_tangents, start_tangents)
        )

    def evaluate_rate_and_tangents(
        self,
        evaluate_function: Callable[[BatchPhase, StageState], Array],
        state: StageState,
        directions: Array,
    ) -> tuple[Array, Array]:
        """Return the time derivative of a function, and the result of `evaluate_tangents`."""
        phase = self.make_phase(self.phase_constants, self.held_constants)
        _, (rate,) = phase.evaluate_with_rates(
            lambda state: (evaluate_function(phase, state),), state
        )
        return rate, self.evaluate_tangents(evaluate_function, state, directions)

    def evaluate_tangents(
        self,
        evaluate_function: Callable[[BatchPhase, StageState], Any],
        state: StageState,
        directions: Array,
    ) -> Any:
        """Return the tangents of a function of phase and state, for tangents of a state.

        The first axis of the result contains the directions.
        """

        def evaluate_for_constants(
            phase_constants: Any, held_constants: Vector, q: Vector, v: Vector
        ) -> Any:
            phase = self.make_phase(phase_constants, held_constants)
            return evaluate_function(phase, phase.make_state(q, v))

        n, direction_components = len(state.q), tuple(jnp.moveaxis(directions, 1, 0))
        return compute_each_jvp(
            evaluate_for_constants,
            (self.phase_constants, self.held_constants, state.q, state.v),
            (
                self.phase_constants_tangents,
                direction_components[2 * n :],
                direction_components[:n],
                direction_components[n : 2 * n],
            ),
        )


_FORWARD_ONLY_PRIMITIVE = Primitive("forward_only")
"""Identity operation whose transpose raises an error."""


def _raise_reverse_mode_error(_cotangent: Any, _value: Any, *, function_name: str) -> None:
    """Raise a ValueError that explains why reverse mode is not available."""
    raise ValueError(
        f"hybrid.{function_name} has no derivative in reverse mode, since the number of its solver "
        "steps is not known beforehand: use forward mode, jax.jacfwd or jax.jvp, instead of "
        "jax.grad, jax.jacrev or jax.vjp."
    )


_FORWARD_ONLY_PRIMITIVE.def_impl(lambda x, *, function_name: x)
_FORWARD_ONLY_PRIMITIVE.def_abstract_eval(lambda x, *, function_name: x)
ad.deflinear2(_FORWARD_ONLY_PRIMITIVE, _raise_reverse_mode_error)
batching.defvectorized(_FORWARD_ONLY_PRIMITIVE)
mlir.register_lowering(_FORWARD_ONLY_PRIMITIVE, lambda _context, x, *, function_name: [x])


def forbid_reverse_mode(function_name: str, function_result: PyTree) -> PyTree:
    """Return `function_result` unchanged, marked so that reverse-mode differentiation raises an
    error.

    `function_name` is the function in `flow` that computed the result. Inside `lanes.jit` there is
    no mark, because reverse mode transposes the derivatives that machine code computes.
    """
    if targets_machine_code():
        return function_result

    def mark_leaf_as_forward_only(leaf: Any) -> Any:
        if isinstance(leaf, jax.core.Tracer) and eqx.is_inexact_array(leaf):
            return _FORWARD_ONLY_PRIMITIVE.bind(leaf, function_name=function_name)
        return leaf

    return jax.tree.map(mark_leaf_as_forward_only, function_result)
