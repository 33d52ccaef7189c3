"""Pseudo-arclength continuation of fixed points in one parameter, through folds.

A problem is an `AbstractContinuationProblem`. It defines how Newton's method corrects the unknowns
z at a parameter p, and how z changes with p. Many branches run concurrently, each with buffers of
fixed size for its points. Lengths are measured in the section state and in the parameter as a
fraction of its range.
"""

import abc
import dataclasses
import functools
from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from vrw_jax.continuation.crossings import BranchJumpSuspicion, is_multiplier_change_explained
from vrw_jax.numerics import (
    Scalar,
    StatusCode,
    batch_sizes,
    evaluate_with_jacobian,
    select_tree_leaves,
)
from vrw_jax.validation import (
    check_int,
    check_positive,
    with_renamed_arguments,
)

ProblemUnknowns = Any
"""Tree of float arrays that Newton's method corrects: the unknowns of a continuation problem."""
SectionVector = Float[Array, " n"]


@with_renamed_arguments(
    first_step="initial_ds",
    largest_step="max_ds",
    smallest_step="min_ds",
    iterations="max_newton_iterations",
    turn="max_turn_angle",
)
@dataclasses.dataclass(frozen=True)
class ArclengthOptions:
    """Numerical options of a continuation; each change compiles again.

    - `initial_ds`, `max_ds`, `min_ds`: continuation step along the branch, in the section state and
      in the parameter as a fraction of its range;
    - `max_points`: limit of points in each direction;
    - `max_newton_iterations`: limit of Newton's iterations for one point;
    - `tolerance`: limit of the norm of Newton's last correction;
    - `max_turn_angle`: largest turn of the branch in one continuation step, rad;
    - `kink_step_factor`: steps below this multiple of `min_ds` may pass a kink of the branch, at
      any angle. It is chosen because three halvings then remain for failures of Newton's method
      between two smooth pieces;
    - `jacobian_reuse_fraction`: share of `tolerance` below which a correction converges without
      another iteration. It is chosen because the Jacobian of the trial is then exact.

    Examples:
        >>> vrw.ArclengthOptions(max_ds=0.05).max_points
        400
    """

    initial_ds: float = 0.005
    max_ds: float = 0.02
    min_ds: float = 1e-6
    max_points: int = 400
    max_newton_iterations: int = 10
    tolerance: float = 1e-10
    max_turn_angle: float = 0.2
    kink_step_factor: float = 8.0
    jacobian_reuse_fraction: float = 1e-2

    def __post_init__(self) -> None:
        integer_names = ("max_points", "max_newton_iterations")
        for name in self.__dataclass_fields__:
            check_option = check_int if name in integer_names else check_positive
            object.__setattr__(self, name, check_option(name, getattr(self, name)))
        if not self.min_ds <= self.initial_ds <= self.max_ds:
            raise ValueError(
                f"the steps are {self.min_ds:g} (smallest), {self.initial_ds:g} (first) and "
                f"{self.max_ds:g} (largest), but they must not fall in this order: "
                "give min_ds <= initial_ds <= max_ds."
            )


class NewtonStep(NamedTuple):
    """Correction and tangent of Newton's method at a trial point (z, p)."""

    correction: ProblemUnknowns  # correction of z at fixed p
    tangent: ProblemUnknowns  # dz/dp, the tangent of the branch
    jacobian: Float[Array, "n n"]  # Jacobian of the return map with respect to the section state


class AbstractContinuationProblem(eqx.Module):
    """Base class of continuation problems.

    The argument `args` of the methods is a tree with all inputs except z and p.
    """

    is_traceable: ClassVar[bool] = True
    """Whether `linearize` can be compiled into a loop. If not, `linearize` is called for a batch of
    points from outside of compiled code."""

    has_multipliers: ClassVar[bool] = True
    """Whether the Jacobians are those of the equations that are continued."""

    has_kinks: ClassVar[bool] = False
    """Whether a branch may have kinks, at which its tangent jumps."""

    @abc.abstractmethod
    def linearize(self, args: Any, z: ProblemUnknowns, p: Scalar) -> NewtonStep:
        """Return correction, tangent and Jacobian at (z, p); they are not finite if the map is
        undefined.
        """

    @abc.abstractmethod
    def section_state(self, z: ProblemUnknowns) -> SectionVector:
        """Return the section state, which is a part of z."""

    def interpolate(
        self, left: ProblemUnknowns, right: ProblemUnknowns, fraction: Scalar
    ) -> ProblemUnknowns:
        """Return the initial guess of Newton's method at a fraction in [0, 1] between two
        points.
        """
        return jax.tree.map(lambda a, b: a + fraction * (b - a), left, right)

    def is_smooth_between(self, left: ProblemUnknowns, right: ProblemUnknowns) -> Bool[Array, ""]:
        """Return whether no kink of the branch shows between two neighboring points."""
        return jnp.asarray(True)

    def correction_norm(self, z: ProblemUnknowns, correction: ProblemUnknowns) -> Scalar:
        """Return the norm of a correction, which is compared with the tolerance."""
        return jnp.max(jnp.abs(correction))

    def is_admissible(self, args: Any, z: ProblemUnknowns, p: Scalar) -> Bool[Array, ""]:
        """Return whether a converged z satisfies the conditions of its branch."""
        return jnp.all(jnp.isfinite(z))


def make_fixed_point_newton_step(
    return_map: Callable[[Array, Scalar], Array], z: Array, p: Scalar, n_continuous: int
) -> NewtonStep:
    """Return the Newton step of the equation `return_map(z, p)` = z.

    The first `n_continuous` components of z are continuous. The others are codes, which are copied
    from the image.
    """
    continuous_map = lambda x, p: return_map(jnp.concatenate([x, z[n_continuous:]]), p)
    image_point, jacobians = evaluate_with_jacobian(continuous_map, z[:n_continuous], p)
    jacobian_z, jacobian_p = (jacobian[:n_continuous] for jacobian in jacobians)
    map_defect = image_point - z
    right_sides = jnp.stack([map_defect[:n_continuous], jacobian_p], -1)
    solutions = jnp.linalg.solve(jnp.eye(n_continuous, dtype=z.dtype) - jacobian_z, right_sides)
    code_changes = map_defect[n_continuous:]
    tangent = jnp.concatenate([solutions[:, 1], jnp.zeros_like(code_changes)])
    return NewtonStep(jnp.concatenate([solutions[:, 0], code_changes]), tangent, jacobian_z)


class FixedPointProblem(AbstractContinuationProblem):
    """Continuation problem of fixed points of a map x -> `function(args, x, p)`.

    JAX differentiates the map in forward mode. The map returns NaN if it is not defined.
    """

    function: Callable[[Any, SectionVector, Scalar], SectionVector] = eqx.field(static=True)

    def linearize(self, args: Any, z: ProblemUnknowns, p: Scalar) -> NewtonStep:
        return make_fixed_point_newton_step(
            lambda x, p: self.function(args, x, p), z, p, z.shape[0]
        )

    def section_state(self, z: ProblemUnknowns) -> SectionVector:
        return z


class ContinuationStatus(StatusCode):
    """Reason why the continuation of a branch ended in one direction."""

    RUNNING = 0, "The continuation was still running."
    RANGE_END_REACHED = 1, "The parameter's range ended."
    POINT_NOT_ADMISSIBLE = 2, "The next points do not satisfy the conditions of the branch."
    STEP_SIZE_UNDERFLOW = 3, "Newton's method found no next point, however short the step."
    MAX_POINTS_REACHED = 4, "The branch has the largest allowed number of points: raise max_points."
    START_NOT_FOUND = 5, "No starting point was found."
    CURVE_CLOSED = 6, "The curve returned to its start."


class ContinuationPoint(NamedTuple):
    """Point of a branch with the unit tangent of the branch."""

    z: ProblemUnknowns
    p: Scalar
    tangent: ProblemUnknowns  # derivative of z with respect to arc length; () for stored points
    # derivative of the parameter, as a fraction of its range, with respect to arc length
    fraction_rate: Scalar
    jacobian: Float[Array, "n n"]
    is_admissible: Bool[Array, ""]


class ContinuationResult(NamedTuple):
    """Points of branches in buffers of `max_points`, of which the first `n_points` are set."""

    points: ContinuationPoint
    n_points: Int[Array, " branches"]
    status: Int[Array, " branches"]  # a ContinuationStatus for each branch
    n_linearizations: Int[Array, " branches"]  # number of calls of `linearize`


class ConstraintPlane(NamedTuple):
    """Plane that contains a given point and selects a point of a branch."""

    section_state: SectionVector
    fraction: Scalar
    normal_section: SectionVector
    normal_fraction: Scalar


class CorrectorState(NamedTuple):
    """State of the corrector after one Newton iteration."""

    z: ProblemUnknowns
    fraction: Scalar
    correction_norm: Scalar
    # derivative of z with respect to the parameter as a fraction of its range
    tangent: ProblemUnknowns
    jacobian: Float[Array, "n n"]


def evaluate_newton_step_at_fraction(
    problem: AbstractContinuationProblem,
    args: Any,
    parameter_bounds: Array,
    z: ProblemUnknowns,
    fraction: Scalar,
) -> NewtonStep:
    """Return the Newton step at a fraction of the parameter's range."""
    return problem.linearize(
        args, z, parameter_bounds[0] + (parameter_bounds[1] - parameter_bounds[0]) * fraction
    )


def correct_trial_point(
    problem: AbstractContinuationProblem,
    newton_step: NewtonStep,
    parameter_bounds: Array,
    constraint_plane: ConstraintPlane,
    z: ProblemUnknowns,
    fraction: Scalar,
) -> CorrectorState:
    """Return the state after one Newton iteration.

    The equations are those of the branch and of the constraint plane.
    """
    parameter_range = parameter_bounds[1] - parameter_bounds[0]
    tangent = jax.tree.map(
        lambda section_state: parameter_range * section_state, newton_step.tangent
    )
    section_state = problem.section_state(z) + problem.section_state(newton_step.correction)
    plane_residual = constraint_plane.normal_section @ (
        section_state - constraint_plane.section_state
    ) + constraint_plane.normal_fraction * (fraction - constraint_plane.fraction)
    d_fraction = -plane_residual / (
        constraint_plane.normal_section @ problem.section_state(tangent)
        + constraint_plane.normal_fraction
    )
    dz = jax.tree.map(lambda a, b: a + d_fraction * b, newton_step.correction, tangent)
    correction_norm = jnp.maximum(problem.correction_norm(z, dz), jnp.abs(d_fraction))
    return CorrectorState(
        jax.tree.map(jnp.add, z, dz),
        fraction + d_fraction,
        correction_norm,
        tangent,
        newton_step.jacobian,
    )


def _compute_parameter_fraction(p: Array, parameter_bounds: Array) -> Array:
    """Return the parameter as a fraction of its range."""
    return (p - parameter_bounds[0]) / (parameter_bounds[1] - parameter_bounds[0])


def compute_parameter_from_fraction(fraction: Array, parameter_bounds: Array) -> Array:
    """Return the parameter at a fraction of its range, exact at both ends of the range."""
    p = parameter_bounds[0] + (parameter_bounds[1] - parameter_bounds[0]) * fraction
    return jnp.where(fraction == 1.0, parameter_bounds[1], p)


class _TrialPoint(NamedTuple):
    """Predicted point of a branch, with the plane on which Newton's method solves for the point."""

    plane: ConstraintPlane
    z: ProblemUnknowns
    fraction: Scalar
    length: Scalar  # predicted arc length from the last point
    is_final: Bool[Array, ""]  # whether the point lies on the end of the range


def _predict_point(
    problem: AbstractContinuationProblem,
    previous_point: ContinuationPoint,
    current_point: ContinuationPoint,
    has_two_points: Bool[Array, ""],
    ds: Scalar,
    parameter_bounds: Array,
) -> _TrialPoint:
    """Return the predicted point: one continuation step along the tangent, or the nearer end of the
    range.

    With `has_two_points`, Newton's method starts on the cubic through the last two points with
    their tangents. The cubic is nearer to the branch than the tangent by two orders, and saves one
    of three iterations.
    """
    fraction = _compute_parameter_fraction(current_point.p, parameter_bounds)
    fraction_rate = current_point.fraction_rate
    range_end = jnp.where(fraction_rate > 0.0, 1.0, 0.0)
    is_stationary = fraction_rate == 0.0
    bound_distance = jnp.where(
        is_stationary,
        jnp.inf,
        (range_end - fraction) / jnp.where(is_stationary, 1.0, fraction_rate),
    )
    is_final = bound_distance <= ds
    predicted_length = jnp.where(is_final, bound_distance, ds)
    section_tangent = problem.section_state(current_point.tangent)
    section_state = problem.section_state(current_point.z)
    target_fraction = jnp.where(is_final, range_end, fraction + predicted_length * fraction_rate)
    constraint_plane = ConstraintPlane(
        section_state + predicted_length * section_tangent,
        target_fraction,
        jnp.where(is_final, 0.0, section_tangent),
        jnp.where(is_final, 1.0, fraction_rate),
    )
    previous_fraction = _compute_parameter_fraction(previous_point.p, parameter_bounds)
    point_displacement = jnp.append(
        section_state - problem.section_state(previous_point.z), fraction - previous_fraction
    )
    has_two_points = has_two_points & problem.is_smooth_between(previous_point.z, current_point.z)
    # After a kink the two points are equal up to round-off.
    has_two_points = has_two_points & (point_displacement @ point_displacement > (1e-9 * ds) ** 2)
    chord_length = jnp.where(has_two_points, jnp.sqrt(point_displacement @ point_displacement), 1.0)

    def extrapolate(
        previous_value: Array, previous_rate: Array, current_value: Array, current_rate: Array
    ) -> Array:
        mean_rate = (current_value - previous_value) / chord_length
        cubic_coefficient = (current_rate - mean_rate) / chord_length + (
            predicted_length + chord_length
        ) * (previous_rate + current_rate - 2.0 * mean_rate) / chord_length**2
        return (
            current_value
            + predicted_length * current_rate
            + jnp.where(has_two_points, predicted_length**2 * cubic_coefficient, 0.0)
        )

    z = jax.tree.map(
        extrapolate,
        previous_point.z,
        previous_point.tangent,
        current_point.z,
        current_point.tangent,
    )
    fraction = jnp.where(
        is_final,
        range_end,
        extrapolate(previous_fraction, previous_point.fraction_rate, fraction, fraction_rate),
    )
    return _TrialPoint(constraint_plane, z, fraction, predicted_length, is_final)


class ContinuationState(NamedTuple):
    """State of the continuation of one branch."""

    previous_point: ContinuationPoint
    current_point: ContinuationPoint
    first_point: ContinuationPoint  # first point of the branch, if it exists
    ds: Scalar
    trial: _TrialPoint
    suspicion: BranchJumpSuspicion
    iteration: Int[Array, ""]
    n_points: Int[Array, ""]
    status: Int[Array, ""]
    n_linearizations: Int[Array, ""]


class _TrialAssessment(NamedTuple):
    """Assessment of a trial after one Newton iteration. If no flag is set, the iteration
    continues.
    """

    is_accepted: Bool[Array, ""]
    has_failed: Bool[Array, ""]
    # the trial is accepted, although the branch turns by more than `max_turn_angle`
    is_kink: Bool[Array, ""]
    fraction_rate: Scalar  # rate of the parameter in the direction of continuation


def _assess_trial(
    problem: AbstractContinuationProblem,
    options: ArclengthOptions,
    continuation_state: ContinuationState,
    corrector_state: CorrectorState,
    direction_sign: Scalar,
) -> _TrialAssessment:
    """Return whether a trial is accepted or has failed, and the rate of the parameter at the
    trial.
    """
    current_point, trial_point, is_first_point = (
        continuation_state.current_point,
        continuation_state.trial,
        continuation_state.n_points == 0,
    )
    trial_distance = jnp.maximum(
        jnp.max(
            jnp.abs(problem.section_state(corrector_state.z) - trial_point.plane.section_state)
        ),
        jnp.abs(corrector_state.fraction - trial_point.plane.fraction),
    )
    is_valid = jnp.isfinite(corrector_state.correction_norm) & (
        is_first_point | (trial_distance <= continuation_state.ds)
    )
    is_converged = is_valid & (corrector_state.correction_norm < options.tolerance)
    section_tangent = problem.section_state(corrector_state.tangent)
    tangent_alignment = (
        problem.section_state(current_point.tangent) @ section_tangent + current_point.fraction_rate
    )
    tangent_alignment = jnp.where(is_first_point, direction_sign, tangent_alignment)
    tangent_norm = jnp.sqrt(1.0 + section_tangent @ section_tangent)
    is_turn_small = is_first_point | (
        jnp.abs(tangent_alignment) >= tangent_norm * jnp.cos(options.max_turn_angle)
    )
    # At a kink a branch turns by more than the limit, however short the step is.
    is_kink = (
        is_converged
        & ~is_turn_small
        & (continuation_state.ds < options.kink_step_factor * options.min_ds)
    )
    is_kink = is_kink & problem.has_kinks
    is_accepted = is_converged & (is_turn_small | is_kink)
    has_failed = ~is_accepted & (
        ~is_valid
        | is_converged
        | (continuation_state.iteration + 1 >= options.max_newton_iterations)
    )
    return _TrialAssessment(
        is_accepted,
        has_failed,
        is_kink,
        jnp.where(tangent_alignment >= 0.0, 1.0, -1.0) / tangent_norm,
    )


def _is_jump_suspicious(
    problem: AbstractContinuationProblem,
    options: ArclengthOptions,
    continuation_state: ContinuationState,
    trial_assessment: _TrialAssessment,
    new_point: ContinuationPoint,
) -> Bool[Array, ""]:
    """Return whether an accepted trial may lie on another branch, which a shorter step may
    avoid.
    """
    if not problem.has_multipliers:
        return jnp.asarray(False)
    current_point = continuation_state.current_point
    has_turned_back = current_point.fraction_rate * new_point.fraction_rate < 0.0
    is_multiplier_change_explained_by_bifurcations = is_multiplier_change_explained(
        current_point.jacobian, new_point.jacobian, has_turned_back
    )
    can_be_suspicious = (
        trial_assessment.is_accepted
        & (continuation_state.n_points > 0)
        & ~continuation_state.suspicion.is_resolved
        & new_point.is_admissible
    )
    return can_be_suspicious & ~is_multiplier_change_explained_by_bifurcations


def _choose_next_step_length(
    options: ArclengthOptions,
    continuation_state: ContinuationState,
    trial_assessment: _TrialAssessment,
) -> Scalar:
    """Return the length of the next continuation step.

    The step grows after few Newton iterations, shrinks after many, and is halved after a failure.
    """
    has_converged_quickly, has_converged_slowly = (
        continuation_state.iteration < 4,
        continuation_state.iteration >= 6,
    )
    growth_factor = jnp.where(has_converged_quickly, 1.4, jnp.where(has_converged_slowly, 0.6, 1.0))
    longer_ds = jnp.minimum(continuation_state.ds * growth_factor, options.max_ds)
    shorter_ds = jnp.where(
        trial_assessment.has_failed, 0.5 * continuation_state.ds, continuation_state.ds
    )
    ds = jnp.where(trial_assessment.is_accepted, longer_ds, shorter_ds)
    return jnp.where(continuation_state.n_points == 0, options.initial_ds, ds)


def _is_curve_closed(
    problem: AbstractContinuationProblem,
    start_point: ContinuationPoint,
    current_point: ContinuationPoint,
    next_point: ContinuationPoint,
    parameter_bounds: Array,
) -> Bool[Array, ""]:
    """Return whether the segment from one point to the next contains the branch's start."""
    stack_coordinates = lambda point: jnp.append(
        problem.section_state(point.z), _compute_parameter_fraction(point.p, parameter_bounds)
    )
    chord_vector = stack_coordinates(next_point) - stack_coordinates(current_point)
    start_offset = stack_coordinates(start_point) - stack_coordinates(current_point)
    squared_chord_length = chord_vector @ chord_vector
    chord_fraction = (
        start_offset
        @ chord_vector
        / jnp.where(squared_chord_length > 0.0, squared_chord_length, 1.0)
    )
    start_distance = start_offset - chord_fraction * chord_vector
    return (
        (chord_fraction >= 0.0)
        & (chord_fraction <= 1.0)
        & (start_distance @ start_distance < 0.01 * squared_chord_length)
    )


def _update_continuation_status(
    options: ArclengthOptions,
    continuation_state: ContinuationState,
    trial_assessment: _TrialAssessment,
    new_point: ContinuationPoint,
    ds: Scalar,
    next_length: Scalar,
    is_closed: Bool[Array, ""],
) -> Int[Array, ""]:
    """Return the status of a branch after a trial.

    `next_length` is the length of the next step.
    """
    is_accepted, has_failed = trial_assessment.is_accepted, trial_assessment.has_failed
    n_points, status_by_reason = (
        continuation_state.n_points + is_accepted,
        continuation_state.status,
    )
    for has_reason_occurred, status_code in (
        (ds < options.min_ds, ContinuationStatus.STEP_SIZE_UNDERFLOW),
        (has_failed & (continuation_state.n_points == 0), ContinuationStatus.START_NOT_FOUND),
        (is_accepted & (n_points >= options.max_points), ContinuationStatus.MAX_POINTS_REACHED),
        (
            is_accepted & (continuation_state.trial.is_final | (next_length <= 1e-12)),
            ContinuationStatus.RANGE_END_REACHED,
        ),
        (is_accepted & ~new_point.is_admissible, ContinuationStatus.POINT_NOT_ADMISSIBLE),
        (
            is_accepted & is_closed & (continuation_state.n_points > 2),
            ContinuationStatus.CURVE_CLOSED,
        ),
    ):
        status_by_reason = jnp.where(has_reason_occurred, int(status_code), status_by_reason)
    return status_by_reason.astype(jnp.int32)


def _init_continuation_state(
    problem: AbstractContinuationProblem,
    options: ArclengthOptions,
    parameter_bounds: Array,
    z: ProblemUnknowns,
    p: Scalar,
    direction_sign: Scalar,
) -> ContinuationState:
    """Return the initial state of one branch, whose first trial is the given point."""
    x = problem.section_state(z)
    n_section, float_dtype = x.shape[0], x.dtype
    zero_length, zero_count, false_flag = (
        jnp.zeros((), float_dtype),
        jnp.zeros((), jnp.int32),
        jnp.asarray(False),
    )
    zero_tangent, fraction = (
        jax.tree.map(jnp.zeros_like, z),
        _compute_parameter_fraction(p, parameter_bounds),
    )
    point = ContinuationPoint(
        z,
        p,
        zero_tangent,
        zero_length + direction_sign,
        jnp.zeros((n_section, n_section), float_dtype),
        false_flag,
    )
    trial_point = _TrialPoint(
        ConstraintPlane(x, fraction, jnp.zeros_like(x), zero_length + 1.0),
        z,
        fraction,
        zero_length,
        false_flag,
    )
    running_status = zero_count + int(ContinuationStatus.RUNNING)
    jump_suspicion, first_step = (
        BranchJumpSuspicion(zero_length, false_flag),
        zero_length + options.initial_ds,
    )
    return ContinuationState(
        point,
        point,
        point,
        first_step,
        trial_point,
        jump_suspicion,
        zero_count,
        zero_count,
        running_status,
        zero_count,
    )


BranchBatch = tuple[ContinuationState, ContinuationPoint]
"""States of concurrent branches, and the buffers of their points."""


def init_branches(
    problem: AbstractContinuationProblem,
    options: ArclengthOptions,
    z: ProblemUnknowns,
    p: Array,
    parameter_bounds: Array,
    direction_signs: Array,
    is_branch_requested: Array,
) -> BranchBatch:
    """Return the initial states of the branches and their empty buffers of points."""
    continuation_states = jax.vmap(
        functools.partial(_init_continuation_state, problem, options, parameter_bounds)
    )(z, p, direction_signs)
    initial_status = jnp.where(
        is_branch_requested, continuation_states.status, int(ContinuationStatus.START_NOT_FOUND)
    )
    continuation_states = continuation_states._replace(status=initial_status.astype(jnp.int32))
    allocate_buffer = lambda x: jnp.zeros((x.shape[0], options.max_points, *x.shape[1:]), x.dtype)
    return continuation_states, jax.tree.map(
        allocate_buffer, continuation_states.current_point._replace(tangent=())
    )


def are_branches_active(branch_batch: BranchBatch) -> Array:
    """Return whether the continuation of each branch still runs."""
    return branch_batch[0].status == int(ContinuationStatus.RUNNING)


def iterate_branches(
    problem: AbstractContinuationProblem,
    options: ArclengthOptions,
    args_by_branch: Any,
    parameter_bounds: Array,
    direction_signs: Array,
    buffer_indices: Array,
    branch_batch: BranchBatch,
    newton_steps: NewtonStep,
) -> BranchBatch:
    """Linearize the trial of each branch once, store accepted points, and return the states.

    The points of the branches are stored at the indices `buffer_indices` of the buffers.
    """

    def iterate_branch(
        args: Any,
        direction_sign: Scalar,
        continuation_state: ContinuationState,
        newton_step: NewtonStep,
    ) -> tuple[ContinuationState, ContinuationPoint, Bool[Array, ""]]:
        trial_point = continuation_state.trial
        corrector_state = correct_trial_point(
            problem,
            newton_step,
            parameter_bounds,
            trial_point.plane,
            trial_point.z,
            trial_point.fraction,
        )
        trial_assessment = _assess_trial(
            problem, options, continuation_state, corrector_state, direction_sign
        )
        p = compute_parameter_from_fraction(
            jnp.where(trial_point.is_final, trial_point.plane.fraction, corrector_state.fraction),
            parameter_bounds,
        )
        is_admissible = problem.is_admissible(args, corrector_state.z, p)
        tangent = jax.tree.map(
            lambda x: trial_assessment.fraction_rate * x, corrector_state.tangent
        )
        new_point = ContinuationPoint(
            corrector_state.z,
            p,
            tangent,
            trial_assessment.fraction_rate,
            corrector_state.jacobian,
            is_admissible,
        )
        is_suspicious = _is_jump_suspicious(
            problem, options, continuation_state, trial_assessment, new_point
        )
        trial_assessment = trial_assessment._replace(
            is_accepted=trial_assessment.is_accepted & ~is_suspicious,
            has_failed=trial_assessment.has_failed | is_suspicious,
        )
        current_point = select_tree_leaves(
            trial_assessment.is_accepted, new_point, continuation_state.current_point
        )
        first_point = select_tree_leaves(
            trial_assessment.is_accepted & (continuation_state.n_points == 0),
            new_point,
            continuation_state.first_point,
        )
        # The cubic of the prediction must not cross a kink.
        previous_point = select_tree_leaves(
            trial_assessment.is_kink, new_point, continuation_state.current_point
        )
        previous_point = select_tree_leaves(
            trial_assessment.is_accepted, previous_point, continuation_state.previous_point
        )
        n_points = continuation_state.n_points + trial_assessment.is_accepted
        ds = _choose_next_step_length(options, continuation_state, trial_assessment)
        jump_suspicion = continuation_state.suspicion.record_trial(
            is_suspicious, continuation_state.ds
        )
        jump_suspicion, ds = jump_suspicion.resolve(
            trial_assessment.is_accepted, ds, options.min_ds
        )
        next_trial_point = _predict_point(
            problem, previous_point, current_point, n_points > 1, ds, parameter_bounds
        )
        is_finished = trial_assessment.is_accepted | trial_assessment.has_failed
        next_trial_point = select_tree_leaves(
            is_finished,
            next_trial_point,
            trial_point._replace(z=corrector_state.z, fraction=corrector_state.fraction),
        )
        is_closed = _is_curve_closed(
            problem, first_point, continuation_state.current_point, new_point, parameter_bounds
        )
        status = _update_continuation_status(
            options,
            continuation_state,
            trial_assessment,
            new_point,
            ds,
            next_trial_point.length,
            is_closed,
        )
        iteration = jnp.where(is_finished, 0, continuation_state.iteration + 1)
        next_counters = n_points, status, continuation_state.n_linearizations + 1
        next_state = ContinuationState(
            previous_point,
            current_point,
            first_point,
            ds,
            next_trial_point,
            jump_suspicion,
            iteration,
            *next_counters,
        )
        return next_state, new_point, trial_assessment.is_accepted

    # Buffers are updated outside of `select_tree_leaves`, which would copy them in every iteration.
    continuation_state, branch_points = branch_batch
    next_states, new_points, is_accepted = jax.vmap(iterate_branch)(
        args_by_branch, direction_signs, continuation_state, newton_steps
    )
    buffer_index = jnp.where(
        are_branches_active(branch_batch) & is_accepted,
        continuation_state.n_points,
        options.max_points,
    )
    write_point = lambda buffer, new_points: buffer.at[buffer_indices, buffer_index].set(
        new_points, mode="drop"
    )
    branch_points = jax.tree.map(write_point, branch_points, new_points._replace(tangent=()))
    return jax.vmap(select_tree_leaves)(
        are_branches_active(branch_batch), next_states, continuation_state
    ), branch_points


def make_continuation_result(branch_batch: BranchBatch) -> ContinuationResult:
    """Return the result of a continuation from the states of its branches."""
    continuation_states, branch_points = branch_batch
    return ContinuationResult(
        branch_points,
        continuation_states.n_points,
        continuation_states.status,
        continuation_states.n_linearizations,
    )


@eqx.filter_jit
def continue_from(
    problem: AbstractContinuationProblem,
    options: ArclengthOptions,
    args_by_branch: Any,
    z: ProblemUnknowns,
    p: Float[Array, "*branches"],
    parameter_bounds: Float[Array, "2"],
    direction_signs: Float[Array, "*branches"],
    is_branch_requested: Bool[Array, "*branches"] | None = None,
) -> ContinuationResult:
    """Continue branches from the points near (z, p) in the given directions, and return all points.

    The parameter grows if the direction is 1 and shrinks if it is -1. The input is one branch, or
    several with a leading axis, of which only the requested ones run. Each branch ends at the end
    of the range, or with its first point that is not admissible, which is kept. Groups of branches
    run concurrently with one linearization of each branch per iteration. When a branch ends, the
    next branch starts.
    """
    if p.ndim == 0:
        add_axis = lambda tree: jax.tree.map(lambda x: x[None], tree)
        result = continue_from(
            problem,
            options,
            add_axis(args_by_branch),
            add_axis(z),
            p[None],
            parameter_bounds,
            direction_signs[None],
        )
        return jax.tree.map(lambda x: x[0], result)
    is_branch_requested = (
        jnp.ones(p.shape, bool) if is_branch_requested is None else is_branch_requested
    )

    def advance_group(branch_batch: BranchBatch) -> BranchBatch:
        group_indices = jnp.argsort(~are_branches_active(branch_batch), stable=True)[
            : batch_sizes.BRANCH_BATCH_SIZE
        ]
        group_args, group_directions, branch_queue_state = jax.tree.map(
            lambda x: x[group_indices], (args_by_branch, direction_signs, branch_batch[0])
        )
        has_waiting_branch = jnp.sum(are_branches_active(branch_batch)) > len(group_indices)

        def advance_once(branch_batch: BranchBatch) -> BranchBatch:
            linearize_trial = lambda args, trial_point: evaluate_newton_step_at_fraction(
                problem, args, parameter_bounds, trial_point.z, trial_point.fraction
            )
            newton_steps = jax.vmap(linearize_trial)(group_args, branch_batch[0].trial)
            return iterate_branches(
                problem,
                options,
                group_args,
                parameter_bounds,
                group_directions,
                group_indices,
                branch_batch,
                newton_steps,
            )

        has_active_branch = lambda branch_batch: jnp.where(
            has_waiting_branch,
            jnp.all(are_branches_active(branch_batch)),
            jnp.any(are_branches_active(branch_batch)),
        )
        branch_queue_state, branch_points = lax.while_loop(
            has_active_branch, advance_once, (branch_queue_state, branch_batch[1])
        )
        return jax.tree.map(
            lambda x, new_point: x.at[group_indices].set(new_point),
            branch_batch[0],
            branch_queue_state,
        ), branch_points

    branch_batch = init_branches(
        problem, options, z, p, parameter_bounds, direction_signs, is_branch_requested
    )
    return make_continuation_result(
        lax.while_loop(
            lambda branch_batch: jnp.any(are_branches_active(branch_batch)),
            advance_group,
            branch_batch,
        )
    )
