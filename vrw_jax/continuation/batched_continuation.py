"""Points of branches on constraint planes, and concurrent branches outside of compiled code.

A map that is machine code for a batch of points is not traced. Its linearizations are called from
outside of compiled code, and `arclength` performs the rest of each iteration.
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
    ProblemUnknowns,
    are_branches_active,
    compute_parameter_from_fraction,
    correct_trial_point,
    evaluate_newton_step_at_fraction,
    init_branches,
    iterate_branches,
    make_continuation_result,
)
from vrw_jax.numerics import select_tree_leaves, select_tree_rows


class PlaneSolveState(NamedTuple):
    """State of Newton's method for a point of a branch on a plane."""

    corrector: CorrectorState
    n_iterations: Int[Array, ""]
    n_converged: Int[Array, ""]


def init_plane_solve_state(
    z: ProblemUnknowns, constraint_plane: ConstraintPlane
) -> PlaneSolveState:
    """Return the initial state of Newton's method on a plane."""
    n_section = constraint_plane.section_state.shape[0]
    zero_tangent, zero_count = jax.tree.map(jnp.zeros_like, z), jnp.zeros((), jnp.int32)
    zero_jacobian = jnp.zeros((n_section, n_section), constraint_plane.section_state.dtype)
    initial_corrector = CorrectorState(
        z,
        constraint_plane.fraction,
        jnp.ones_like(constraint_plane.fraction),
        zero_tangent,
        zero_jacobian,
    )
    return PlaneSolveState(initial_corrector, zero_count, zero_count)


def needs_newton_iteration(options: ArclengthOptions, plane_solve_state: PlaneSolveState) -> Array:
    """Return whether Newton's method needs another iteration."""
    return (
        (plane_solve_state.n_converged < 2)
        & (plane_solve_state.n_iterations < options.max_newton_iterations)
        & jnp.isfinite(plane_solve_state.corrector.correction_norm)
    )


def iterate_plane_solve(
    problem: AbstractContinuationProblem,
    options: ArclengthOptions,
    parameter_bounds: Array,
    constraint_plane: ConstraintPlane,
    plane_solve_state: PlaneSolveState,
    newton_step: NewtonStep,
) -> PlaneSolveState:
    """Return the state of a plane solve after one Newton iteration."""
    corrector_state = plane_solve_state.corrector
    next_corrector = correct_trial_point(
        problem,
        newton_step,
        parameter_bounds,
        constraint_plane,
        corrector_state.z,
        corrector_state.fraction,
    )
    # A trial that is not finite keeps its state, so that no NaN reaches other batch elements.
    is_valid = jnp.isfinite(next_corrector.correction_norm)
    next_corrector = select_tree_leaves(is_valid, next_corrector, corrector_state)._replace(
        correction_norm=next_corrector.correction_norm
    )
    # The last Jacobian is exact if the correction is negligible; then no other iteration follows.
    negligible_correction = options.jacobian_reuse_fraction * options.tolerance
    n_converged_before = jnp.where(next_corrector.correction_norm < negligible_correction, 2, 1)
    n_converged = jnp.where(
        next_corrector.correction_norm < options.tolerance,
        plane_solve_state.n_converged + n_converged_before,
        0,
    )
    return PlaneSolveState(next_corrector, plane_solve_state.n_iterations + 1, n_converged)


def make_plane_solve_point(
    problem: AbstractContinuationProblem,
    args: Any,
    parameter_bounds: Array,
    constraint_plane: ConstraintPlane,
    plane_solve_state: PlaneSolveState,
) -> tuple[ContinuationPoint, Bool[Array, ""]]:
    """Return the point of a plane solve, and whether Newton's method converged.

    The rate of the parameter is that along the plane's normal.
    """
    corrector_state, p = (
        plane_solve_state.corrector,
        compute_parameter_from_fraction(plane_solve_state.corrector.fraction, parameter_bounds),
    )
    is_admissible = problem.is_admissible(args, corrector_state.z, p)
    section_tangent = problem.section_state(corrector_state.tangent)
    normal_alignment = (
        constraint_plane.normal_section @ section_tangent + constraint_plane.normal_fraction
    )
    normal_direction = jnp.where(normal_alignment >= 0.0, 1.0, -1.0)
    fraction_rate = normal_direction / jnp.sqrt(1.0 + section_tangent @ section_tangent)
    point = ContinuationPoint(
        corrector_state.z, p, (), fraction_rate, corrector_state.jacobian, is_admissible
    )
    return point, plane_solve_state.n_converged >= 1


@eqx.filter_jit
def solve_on_plane(
    problem: AbstractContinuationProblem,
    options: ArclengthOptions,
    args: Any,
    z: ProblemUnknowns,
    constraint_plane: ConstraintPlane,
    parameter_bounds: Float[Array, "2"],
) -> tuple[ContinuationPoint, Bool[Array, ""]]:
    """Return the point of the branch on a plane, from z near it, and whether Newton's method
    converged.

    After convergence Newton's method takes one more iteration unless its correction is negligible.
    The Jacobian is then as accurate as the point.
    """

    def iterate_once(plane_solve_state: PlaneSolveState) -> PlaneSolveState:
        newton_step = evaluate_newton_step_at_fraction(
            problem,
            args,
            parameter_bounds,
            plane_solve_state.corrector.z,
            plane_solve_state.corrector.fraction,
        )
        return iterate_plane_solve(
            problem, options, parameter_bounds, constraint_plane, plane_solve_state, newton_step
        )

    needs_more_iterations = functools.partial(needs_newton_iteration, options)
    plane_solve_state = lax.while_loop(
        needs_more_iterations, iterate_once, init_plane_solve_state(z, constraint_plane)
    )
    return make_plane_solve_point(
        problem, args, parameter_bounds, constraint_plane, plane_solve_state
    )


def continue_many_from(
    problem: AbstractContinuationProblem,
    options: ArclengthOptions,
    args_by_branch: Any,
    z: ProblemUnknowns,
    p: Float[Array, " branches"],
    parameter_bounds: Float[Array, "2"],
    direction_signs: Float[Array, " branches"],
    is_branch_requested: Bool[Array, " branches"],
) -> ContinuationResult:
    """Continue branches as `arclength.continue_from` does, outside of compiled code.

    Return all points.
    """
    branch_batch = init_branches(
        problem, options, z, p, parameter_bounds, direction_signs, is_branch_requested
    )
    buffer_indices = jnp.arange(len(p))
    while np.any(is_unfinished := np.asarray(_is_active_jit(branch_batch))):
        trial_point = branch_batch[0].trial
        newton_steps = _linearize_selected(
            problem,
            args_by_branch,
            parameter_bounds,
            trial_point.z,
            trial_point.fraction,
            is_unfinished,
        )
        branch_batch = _iterate_branches_jit(
            problem,
            options,
            args_by_branch,
            parameter_bounds,
            direction_signs,
            buffer_indices,
            branch_batch,
            newton_steps,
        )
    return make_continuation_result(branch_batch)


def _linearize_selected(
    problem: AbstractContinuationProblem,
    args_by_branch: Any,
    parameter_bounds: Array,
    z: ProblemUnknowns,
    fraction: Array,
    is_selected: Any,
) -> NewtonStep:
    """Return the Newton steps of the selected branches, and NaN for the others."""
    lower_bound, upper_bound = np.asarray(parameter_bounds)
    p = lower_bound + (upper_bound - lower_bound) * np.asarray(fraction)
    selected_steps = problem.linearize(
        *jax.device_put(select_tree_rows((args_by_branch, z, p), is_selected))
    )
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
    args_by_branch: Any,
    z: ProblemUnknowns,
    constraint_planes: ConstraintPlane,
    parameter_bounds: Float[Array, "2"],
) -> tuple[ContinuationPoint, Bool[Array, " many"]]:
    """Return many points as `solve_on_plane` does. All arrays have a leading axis."""
    plane_solve_states = _init_plane_solves(z, constraint_planes)
    while np.any(is_unfinished := np.asarray(_needs_iteration_jit(options, plane_solve_states))):
        newton_step = _linearize_selected(
            problem,
            args_by_branch,
            parameter_bounds,
            plane_solve_states.corrector.z,
            plane_solve_states.corrector.fraction,
            is_unfinished,
        )
        plane_solve_states = _iterate_unfinished_plane_solves(
            problem, options, parameter_bounds, constraint_planes, plane_solve_states, newton_step
        )
    return _make_plane_solve_points(
        problem, args_by_branch, parameter_bounds, constraint_planes, plane_solve_states
    )


_is_active_jit: Any = eqx.filter_jit(are_branches_active)
_iterate_branches_jit: Any = eqx.filter_jit(iterate_branches)
_init_plane_solves: Any = eqx.filter_jit(jax.vmap(init_plane_solve_state))
_needs_iteration_jit: Any = eqx.filter_jit(needs_newton_iteration)


@eqx.filter_jit
def _make_plane_solve_points(
    problem: AbstractContinuationProblem,
    args_by_branch: Any,
    parameter_bounds: Array,
    constraint_planes: ConstraintPlane,
    plane_solve_states: PlaneSolveState,
) -> tuple[ContinuationPoint, Bool[Array, " many"]]:
    """Return the points of many plane solves, and whether each solve converged."""
    finish_one = lambda args, constraint_plane, plane_solve_state: make_plane_solve_point(
        problem, args, parameter_bounds, constraint_plane, plane_solve_state
    )
    return jax.vmap(finish_one)(args_by_branch, constraint_planes, plane_solve_states)


@eqx.filter_jit
def _iterate_unfinished_plane_solves(
    problem: AbstractContinuationProblem,
    options: Any,
    parameter_bounds: Array,
    constraint_planes: ConstraintPlane,
    plane_solve_states: PlaneSolveState,
    newton_steps: NewtonStep,
) -> PlaneSolveState:
    """Return the states of many plane solves, after one iteration of each unfinished one."""

    def iterate_one(
        constraint_plane: ConstraintPlane,
        plane_solve_state: PlaneSolveState,
        newton_step: NewtonStep,
    ) -> PlaneSolveState:
        next_state = iterate_plane_solve(
            problem, options, parameter_bounds, constraint_plane, plane_solve_state, newton_step
        )
        return select_tree_leaves(
            needs_newton_iteration(options, plane_solve_state), next_state, plane_solve_state
        )

    return jax.vmap(iterate_one)(constraint_planes, plane_solve_states, newton_steps)
