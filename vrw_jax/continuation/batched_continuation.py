"""Points of branches on constraint planes, and concurrent branches outside of compiled code.

If a map is machine code for a batch of points, it is not traced. Linearizations are then called
from outside of compiled code, and `arclength` performs the rest of each iteration.
"""

import functools
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from vrw_jax.continuation.arclength import (
    AbstractContinuationProblem,
    ArclengthOptions,
    ConstraintPlane,
    ContinuationPoint,
    ContinuationResult,
    CorrectorState,
    NewtonStep,
    Unknowns,
    correct_point,
    evaluate_newton_step_at_fraction,
    init_branches,
    is_active,
    iterate_branches,
    parameter_from_fraction,
    to_continuation_result,
)
from vrw_jax.numerics import take_rows, tree_where


class PlaneSolveState(NamedTuple):
    """State of Newton's method for a point on a plane."""

    corrector: CorrectorState
    n_iterations: Int[Array, ""]
    n_converged: Int[Array, ""]


def init_plane_solve(z: Unknowns, plane: ConstraintPlane) -> PlaneSolveState:
    """Return the initial state of Newton's method on a plane."""
    n_section = plane.section_state.shape[0]
    zero_tangent, zero_count = jax.tree.map(jnp.zeros_like, z), jnp.zeros((), jnp.int32)
    zero_jacobian = jnp.zeros((n_section, n_section), plane.section_state.dtype)
    initial_corrector = CorrectorState(
        z, plane.fraction, jnp.ones_like(plane.fraction), zero_tangent, zero_jacobian
    )
    return PlaneSolveState(initial_corrector, zero_count, zero_count)


def needs_iteration(options: ArclengthOptions, state: PlaneSolveState) -> Array:
    """Return whether Newton's method needs another iteration."""
    return (
        (state.n_converged < 2)
        & (state.n_iterations < options.max_newton_iterations)
        & jnp.isfinite(state.corrector.correction_norm)
    )


def iterate_plane_solve(
    problem: AbstractContinuationProblem,
    options: ArclengthOptions,
    bounds: Array,
    plane: ConstraintPlane,
    state: PlaneSolveState,
    newton_step: NewtonStep,
) -> PlaneSolveState:
    """Return the state after one Newton iteration."""
    corrector = state.corrector
    next_corrector = correct_point(
        problem, newton_step, bounds, plane, corrector.z, corrector.fraction
    )
    # A trial that is not finite keeps its state, so that no NaN reaches other batch elements.
    is_valid = jnp.isfinite(next_corrector.correction_norm)
    next_corrector = tree_where(is_valid, next_corrector, corrector)._replace(
        correction_norm=next_corrector.correction_norm
    )
    # The last Jacobian is exact if the correction is negligible; then no other iteration follows.
    negligible_correction = options.jacobian_reuse_fraction * options.tolerance
    n_converged_before = jnp.where(next_corrector.correction_norm < negligible_correction, 2, 1)
    n_converged = jnp.where(
        next_corrector.correction_norm < options.tolerance,
        state.n_converged + n_converged_before,
        0,
    )
    return PlaneSolveState(next_corrector, state.n_iterations + 1, n_converged)


def finish_plane_solve(
    problem: AbstractContinuationProblem,
    args: Any,
    bounds: Array,
    plane: ConstraintPlane,
    state: PlaneSolveState,
) -> tuple[ContinuationPoint, Bool[Array, ""]]:
    """Return the point and whether it converged; the parameter's rate is that along the plane's
    normal.
    """
    corrector, p = state.corrector, parameter_from_fraction(state.corrector.fraction, bounds)
    is_admissible = problem.is_admissible(args, corrector.z, p)
    section_tangent = problem.section_state(corrector.tangent)
    alignment = plane.normal_section @ section_tangent + plane.normal_fraction
    direction = jnp.where(alignment >= 0.0, 1.0, -1.0)
    fraction_rate = direction / jnp.sqrt(1.0 + section_tangent @ section_tangent)
    point = ContinuationPoint(corrector.z, p, (), fraction_rate, corrector.jacobian, is_admissible)
    return point, state.n_converged >= 1


@eqx.filter_jit
def solve_on_plane(
    problem: AbstractContinuationProblem,
    options: ArclengthOptions,
    args: Any,
    z: Unknowns,
    plane: ConstraintPlane,
    bounds: Float[Array, "2"],
) -> tuple[ContinuationPoint, Bool[Array, ""]]:
    """Return the point of the branch on a plane, from z near it, and whether Newton's method
    converged.

    After convergence Newton's method takes one more iteration unless its correction is negligible.
    The Jacobian is then as accurate as the point.
    """

    def iterate_once(state: PlaneSolveState) -> PlaneSolveState:
        newton_step = evaluate_newton_step_at_fraction(
            problem, args, bounds, state.corrector.z, state.corrector.fraction
        )
        return iterate_plane_solve(problem, options, bounds, plane, state, newton_step)

    needs_more_iterations = functools.partial(needs_iteration, options)
    state = lax.while_loop(needs_more_iterations, iterate_once, init_plane_solve(z, plane))
    return finish_plane_solve(problem, args, bounds, plane, state)


def continue_many_from(
    problem: AbstractContinuationProblem,
    options: ArclengthOptions,
    batch_args: Any,
    z: Unknowns,
    p: Float[Array, " branches"],
    bounds: Float[Array, "2"],
    directions: Float[Array, " branches"],
    is_requested: Bool[Array, " branches"],
) -> ContinuationResult:
    """Continue branches as `arclength.continue_from` does, outside of compiled code, and return
    all points.
    """
    branches = init_branches(problem, options, z, p, bounds, directions, is_requested)
    buffer_indices = jnp.arange(len(p))
    while np.any(is_unfinished := np.asarray(_is_active_jit(branches))):
        trial = branches[0].trial
        newton_steps = _linearize_selected(
            problem, batch_args, bounds, trial.z, trial.fraction, is_unfinished
        )
        branches = _iterate_branches_jit(
            problem, options, batch_args, bounds, directions, buffer_indices, branches, newton_steps
        )
    return to_continuation_result(branches)


def _linearize_selected(
    problem: AbstractContinuationProblem,
    batch_args: Any,
    bounds: Array,
    z: Unknowns,
    fraction: Array,
    is_selected: Any,
) -> NewtonStep:
    """Return the Newton steps of the selected branches, and NaN for the others."""
    lower_bound, upper_bound = np.asarray(bounds)
    p = lower_bound + (upper_bound - lower_bound) * np.asarray(fraction)
    selected_steps = problem.linearize(*jax.device_put(take_rows((batch_args, z, p), is_selected)))
    fill_with_nan = lambda selected_values: np.full(
        (len(is_selected), *selected_values.shape[1:]), np.nan
    )
    all_steps = jax.tree.map(fill_with_nan, selected_steps)
    for all_values, selected_values in zip(
        jax.tree.leaves(all_steps), jax.tree.leaves(selected_steps), strict=True
    ):
        all_values[is_selected] = selected_values
    return jax.device_put(all_steps)


def solve_many_on_planes(
    problem: AbstractContinuationProblem,
    options: ArclengthOptions,
    batch_args: Any,
    z: Unknowns,
    planes: ConstraintPlane,
    bounds: Float[Array, "2"],
) -> tuple[ContinuationPoint, Bool[Array, " many"]]:
    """Return many points as `solve_on_plane` does; all arrays have a leading axis."""
    state = _init_plane_solves(z, planes)
    while np.any(is_unfinished := np.asarray(_needs_iteration_jit(options, state))):
        newton_step = _linearize_selected(
            problem, batch_args, bounds, state.corrector.z, state.corrector.fraction, is_unfinished
        )
        state = _iterate_plane_solves(problem, options, bounds, planes, state, newton_step)
    return _finish_plane_solves(problem, batch_args, bounds, planes, state)


_is_active_jit: Any = eqx.filter_jit(is_active)
_iterate_branches_jit: Any = eqx.filter_jit(iterate_branches)
_init_plane_solves: Any = eqx.filter_jit(jax.vmap(init_plane_solve))
_needs_iteration_jit: Any = eqx.filter_jit(needs_iteration)


@eqx.filter_jit
def _finish_plane_solves(
    problem: AbstractContinuationProblem,
    batch_args: Any,
    bounds: Array,
    planes: ConstraintPlane,
    states: PlaneSolveState,
) -> tuple[ContinuationPoint, Bool[Array, " many"]]:
    """Return the points of many solves, and whether each converged."""
    finish_one = lambda args, plane, state: finish_plane_solve(problem, args, bounds, plane, state)
    return jax.vmap(finish_one)(batch_args, planes, states)


@eqx.filter_jit
def _iterate_plane_solves(
    problem: AbstractContinuationProblem,
    options: Any,
    bounds: Array,
    planes: ConstraintPlane,
    states: PlaneSolveState,
    newton_steps: NewtonStep,
) -> PlaneSolveState:
    """Return the states of many solves after one iteration of those that need it."""

    def iterate_one(
        plane: ConstraintPlane, state: PlaneSolveState, newton_step: NewtonStep
    ) -> PlaneSolveState:
        next_state = iterate_plane_solve(problem, options, bounds, plane, state, newton_step)
        return tree_where(needs_iteration(options, state), next_state, state)

    return jax.vmap(iterate_one)(planes, states, newton_steps)
