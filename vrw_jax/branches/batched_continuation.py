"""Solve for points of branches on planes, and continue branches outside compiled code.

JAX cannot trace a map that is machine code for a batch of points. The linearizations of such a map
are called outside compiled code. The functions of `arclength` perform the rest of each iteration.
"""

import functools
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from vrw_jax.base.elementwise import select_trees_by_condition
from vrw_jax.base.progress import report_progress
from vrw_jax.branches.arclength import (
    AbstractContinuationProblem,
    ArclengthOptions,
    ContinuationPoint,
    ContinuationResult,
    ContinuationSetup,
    CorrectorPlane,
    CorrectorState,
    NewtonStep,
    ProblemUnknowns,
    are_branches_active,
    correct_trial_point,
    init_branches,
    iterate_branches,
    make_continuation_result,
)
from vrw_jax.lanes.batching import select_tree_rows


class PlaneNewtonState(NamedTuple):
    """State of Newton's method for the point at which a branch crosses a plane."""

    corrector_state: CorrectorState
    n_iterations: Int[Array, ""]
    n_converged_iterations: Int[Array, ""]


def init_plane_newton(z: ProblemUnknowns, corrector_plane: CorrectorPlane) -> PlaneNewtonState:
    """Return the initial state of Newton's method in a plane, with the initial guess z."""
    n_section_coordinates = corrector_plane.plane_section_state.shape[0]
    initial_tangent, initial_count = jax.tree.map(jnp.zeros_like, z), jnp.zeros((), jnp.int32)
    initial_jacobian = jnp.zeros(
        (n_section_coordinates, n_section_coordinates), corrector_plane.plane_section_state.dtype
    )
    initial_corrector_state = CorrectorState(
        z,
        corrector_plane.plane_parameter_fraction,
        jnp.ones_like(corrector_plane.plane_parameter_fraction),
        initial_tangent,
        initial_jacobian,
    )
    return PlaneNewtonState(initial_corrector_state, initial_count, initial_count)


def needs_newton_iteration(
    options: ArclengthOptions, plane_newton_state: PlaneNewtonState
) -> Array:
    """Return whether Newton's method in a plane needs another iteration."""
    return (
        (plane_newton_state.n_converged_iterations < 2)
        & (plane_newton_state.n_iterations < options.max_newton_iterations)
        & jnp.isfinite(plane_newton_state.corrector_state.correction_norm)
    )


def iterate_plane_newton(
    setup: ContinuationSetup,
    corrector_plane: CorrectorPlane,
    plane_newton_state: PlaneNewtonState,
    newton_step: NewtonStep,
) -> PlaneNewtonState:
    """Apply one Newton iteration in a plane, and return the new state of Newton's method.

    The state is unchanged if Newton's method needs no other iteration.
    """
    corrector_state = plane_newton_state.corrector_state
    next_corrector_state = correct_trial_point(
        setup,
        newton_step,
        corrector_plane,
        corrector_state.z,
        corrector_state.parameter_fraction,
    )
    # A trial that is not finite leaves the state unchanged. NaN reaches no other batch element.
    is_correction_valid = jnp.isfinite(next_corrector_state.correction_norm)
    next_corrector_state = select_trees_by_condition(
        is_correction_valid, next_corrector_state, corrector_state
    )._replace(correction_norm=next_corrector_state.correction_norm)
    # If the correction is negligible, the last Jacobian is exact and no other iteration follows.
    options = setup.options
    negligible_correction_norm = options.jacobian_reuse_fraction * options.tolerance
    n_added_converged_iterations = jnp.where(
        next_corrector_state.correction_norm < negligible_correction_norm, 2, 1
    )
    n_converged_iterations = jnp.where(
        next_corrector_state.correction_norm < options.tolerance,
        plane_newton_state.n_converged_iterations + n_added_converged_iterations,
        0,
    )
    return select_trees_by_condition(
        needs_newton_iteration(options, plane_newton_state),
        PlaneNewtonState(
            next_corrector_state, plane_newton_state.n_iterations + 1, n_converged_iterations
        ),
        plane_newton_state,
    )


def make_plane_newton_point(
    setup: ContinuationSetup,
    args: Any,
    corrector_plane: CorrectorPlane,
    plane_newton_state: PlaneNewtonState,
) -> tuple[ContinuationPoint, Bool[Array, ""]]:
    """Return the point at which the branch crosses a plane, and whether Newton's method converged.

    The sign of the point's `fraction_rate` follows the direction of the plane's normal.
    """
    corrector_state = plane_newton_state.corrector_state
    p = setup.compute_parameter(corrector_state.parameter_fraction)
    is_admissible = setup.problem.is_admissible(args, corrector_state.z, p)
    section_tangent = setup.problem.section_state(corrector_state.fraction_tangent)
    normal_alignment = (
        corrector_plane.normal_section_part @ section_tangent
        + corrector_plane.normal_parameter_part
    )
    normal_direction = jnp.where(normal_alignment >= 0.0, 1.0, -1.0)
    fraction_rate = normal_direction / jnp.sqrt(1.0 + section_tangent @ section_tangent)
    continuation_point = ContinuationPoint(
        corrector_state.z, p, (), fraction_rate, corrector_state.return_map_jacobian, is_admissible
    )
    return continuation_point, plane_newton_state.n_converged_iterations >= 1


def solve_on_plane(
    setup: ContinuationSetup, args: Any, z: ProblemUnknowns, corrector_plane: CorrectorPlane
) -> tuple[ContinuationPoint, Bool[Array, ""]]:
    """Solve for the point at which a branch crosses a plane.

    Return the point, and whether Newton's method converged. The initial guess is z. After
    convergence another iteration follows, unless the last correction is negligible. The Jacobian is
    therefore as accurate as the point.
    """

    def iterate_plane_newton_once(plane_newton_state: PlaneNewtonState) -> PlaneNewtonState:
        corrector_state = plane_newton_state.corrector_state
        newton_step = setup.linearize_at_fraction(
            args, corrector_state.z, corrector_state.parameter_fraction
        )
        return iterate_plane_newton(setup, corrector_plane, plane_newton_state, newton_step)

    plane_newton_state = lax.while_loop(
        functools.partial(needs_newton_iteration, setup.options),
        iterate_plane_newton_once,
        init_plane_newton(z, corrector_plane),
    )
    return make_plane_newton_point(setup, args, corrector_plane, plane_newton_state)


def continue_branches_uncompiled(
    problem: AbstractContinuationProblem,
    options: ArclengthOptions,
    args_by_branch: Any,
    z: ProblemUnknowns,
    p: Float[Array, " branches"],
    parameter_bounds: Float[Array, "2"],
    direction_signs: Float[Array, " branches"],
    is_branch_requested: Bool[Array, " branches"],
) -> ContinuationResult:
    """Continue many branches outside compiled code, and return all points.

    The arguments and the result are those of `arclength.continue_from`.
    """
    setup = ContinuationSetup(problem, options, parameter_bounds)
    branch_batch = init_branches(setup, z, p, direction_signs, is_branch_requested)
    branch_buffer_indices = jnp.arange(len(p))
    n_iterations = 0
    while np.any(is_branch_unfinished := np.asarray(_are_branches_active_jit(branch_batch))):
        n_iterations += 1
        report_progress(f"{n_iterations:,} Newton iterations along {len(p)} curves")
        newton_steps = _linearize_selected_branches(
            setup, args_by_branch, branch_batch[0].trial_point, is_branch_unfinished
        )
        branch_batch = _iterate_branches_jit(
            setup,
            args_by_branch,
            direction_signs,
            branch_buffer_indices,
            branch_batch,
            newton_steps,
        )
    return make_continuation_result(branch_batch)


def _linearize_selected_branches(
    setup: ContinuationSetup, args_by_branch: Any, trial_points: Any, is_branch_selected: np.ndarray
) -> NewtonStep:
    """Return the Newton steps for the selected branches. All other branches receive NaN.

    `trial_points` contains the trial unknowns z and the trial parameter fractions of all branches.
    """
    lower_bound, upper_bound = np.asarray(setup.parameter_bounds)
    p = lower_bound + (upper_bound - lower_bound) * np.asarray(trial_points.parameter_fraction)
    selected_newton_steps = setup.problem.linearize(
        *jax.device_put(select_tree_rows((args_by_branch, trial_points.z, p), is_branch_selected))
    )

    def insert_rows(selected_leaf: Any) -> np.ndarray:
        leaf_of_all_branches = np.full((len(p), *selected_leaf.shape[1:]), np.nan)
        leaf_of_all_branches[is_branch_selected] = selected_leaf
        return leaf_of_all_branches

    return jax.device_put(jax.tree.map(insert_rows, selected_newton_steps))


def solve_on_planes(
    setup: ContinuationSetup,
    args_by_branch: Any,
    z: ProblemUnknowns,
    corrector_planes: CorrectorPlane,
) -> tuple[ContinuationPoint, Bool[Array, " many"]]:
    """Solve for the points at which many branches cross planes.

    Return the points, and whether Newton's method converged for each branch. Every array has a
    leading axis over the branches; see `solve_on_plane`.
    """
    if setup.problem.is_traceable:
        return _solve_on_planes_jit(setup, args_by_branch, z, corrector_planes)
    states = _init_plane_newton_jit(z, corrector_planes)
    while np.any(
        is_solve_unfinished := np.asarray(_needs_newton_iteration_jit(setup.options, states))
    ):
        newton_steps = _linearize_selected_branches(
            setup, args_by_branch, states.corrector_state, is_solve_unfinished
        )
        states = _iterate_plane_newton_jit(setup, corrector_planes, states, newton_steps)
    return _make_plane_newton_points_jit(setup, args_by_branch, corrector_planes, states)


_solve_on_planes_jit: Any = eqx.filter_jit(eqx.filter_vmap(solve_on_plane, in_axes=(None, 0, 0, 0)))
_are_branches_active_jit: Any = eqx.filter_jit(are_branches_active)
_iterate_branches_jit: Any = eqx.filter_jit(iterate_branches)
_init_plane_newton_jit: Any = eqx.filter_jit(jax.vmap(init_plane_newton))
_needs_newton_iteration_jit: Any = eqx.filter_jit(needs_newton_iteration)
_iterate_plane_newton_jit: Any = eqx.filter_jit(
    eqx.filter_vmap(iterate_plane_newton, in_axes=(None, 0, 0, 0))
)
_make_plane_newton_points_jit: Any = eqx.filter_jit(
    eqx.filter_vmap(make_plane_newton_point, in_axes=(None, 0, 0, 0))
)
