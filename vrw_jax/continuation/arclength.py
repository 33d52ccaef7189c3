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
from vrw_jax.numerics import Scalar, StatusCode, batch_sizes, tree_where, value_and_jacobian
from vrw_jax.validation import (
    check_int,
    check_positive,
    raise_for_renamed_arguments,
)

Unknowns = Any
"""A pytree of float arrays with everything that Newton's method corrects."""
SectionVector = Float[Array, " n"]


@raise_for_renamed_arguments(
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
            check = check_int if name in integer_names else check_positive
            object.__setattr__(self, name, check(name, getattr(self, name)))
        if not self.min_ds <= self.initial_ds <= self.max_ds:
            raise ValueError(
                f"the steps are {self.min_ds:g} (smallest), {self.initial_ds:g} (first) and "
                f"{self.max_ds:g} (largest), but they must not fall in this order: "
                "give min_ds <= initial_ds <= max_ds."
            )


class NewtonStep(NamedTuple):
    """Correction and tangent of Newton's method at a trial point (z, p)."""

    correction: Unknowns  # correction of z at fixed p
    tangent: Unknowns  # dz/dp, the tangent of the branch
    jacobian: Float[Array, "n n"]  # Jacobian of the return map with respect to the section state


class AbstractContinuationProblem(eqx.Module):
    """Base class of continuation problems; `args` is a pytree with all other inputs."""

    is_traceable: ClassVar[bool] = True
    """Whether `linearize` can be compiled into a loop. If not, it is called for a batch of
    points from outside of compiled code.
    """

    has_multipliers: ClassVar[bool] = True
    """Whether the Jacobians are those of the equations that are continued."""

    has_kinks: ClassVar[bool] = False
    """Whether a branch may have kinks, at which its tangent jumps."""

    @abc.abstractmethod
    def linearize(self, args: Any, z: Unknowns, p: Scalar) -> NewtonStep:
        """Return correction, tangent and Jacobian; they are not finite if the map is undefined
        at (z, p).
        """

    @abc.abstractmethod
    def section_state(self, z: Unknowns) -> SectionVector:
        """Return the section state, which is a part of z."""

    def interpolate(self, left: Unknowns, right: Unknowns, fraction: Scalar) -> Unknowns:
        """Return the initial guess of Newton's method at a fraction in [0, 1] between two
        points.
        """
        return jax.tree.map(lambda a, b: a + fraction * (b - a), left, right)

    def is_smooth_between(self, left: Unknowns, right: Unknowns) -> Bool[Array, ""]:
        """Return whether two neighboring points show no kink of the branch between them."""
        return jnp.asarray(True)

    def correction_norm(self, z: Unknowns, correction: Unknowns) -> Scalar:
        """Return the norm of a correction, which is compared with the tolerance."""
        return jnp.max(jnp.abs(correction))

    def is_admissible(self, args: Any, z: Unknowns, p: Scalar) -> Bool[Array, ""]:
        """Return whether a converged z satisfies the conditions of its branch."""
        return jnp.all(jnp.isfinite(z))


def make_fixed_point_newton_step(
    return_map: Callable[[Array, Scalar], Array], z: Array, p: Scalar, n_continuous: int
) -> NewtonStep:
    """Return the Newton step of the equation `return_map(z, p)` = z.

    The first `n_continuous` entries of z are continuous. The others are codes, which are copied
    from the image.
    """
    continuous_map = lambda x, p: return_map(jnp.concatenate([x, z[n_continuous:]]), p)
    image_point, jacobians = value_and_jacobian(continuous_map, z[:n_continuous], p)
    jacobian_z, jacobian_p = (jacobian[:n_continuous] for jacobian in jacobians)
    defect = image_point - z
    right_sides = jnp.stack([defect[:n_continuous], jacobian_p], -1)
    solutions = jnp.linalg.solve(jnp.eye(n_continuous, dtype=z.dtype) - jacobian_z, right_sides)
    code_changes = defect[n_continuous:]
    tangent = jnp.concatenate([solutions[:, 1], jnp.zeros_like(code_changes)])
    return NewtonStep(jnp.concatenate([solutions[:, 0], code_changes]), tangent, jacobian_z)


class FixedPointProblem(AbstractContinuationProblem):
    """Continuation problem of fixed points of a map x -> `function(args, x, p)`.

    JAX differentiates the map in forward mode. The map returns NaN if it is not defined.
    """

    function: Callable[[Any, SectionVector, Scalar], SectionVector] = eqx.field(static=True)

    def linearize(self, args: Any, z: Unknowns, p: Scalar) -> NewtonStep:
        return make_fixed_point_newton_step(
            lambda x, p: self.function(args, x, p), z, p, z.shape[0]
        )

    def section_state(self, z: Unknowns) -> SectionVector:
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
    """A point of a branch with the unit tangent of the branch."""

    z: Unknowns
    p: Scalar
    tangent: Unknowns  # derivative of z with respect to arc length; () for stored points
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
    """Plane that selects a point of a branch: the point lies on it. The plane contains a given
    point.
    """

    section_state: SectionVector
    fraction: Scalar
    normal_section: SectionVector
    normal_fraction: Scalar


class CorrectorState(NamedTuple):
    """State of the corrector after one Newton iteration."""

    z: Unknowns
    fraction: Scalar
    correction_norm: Scalar
    tangent: Unknowns  # derivative of z with respect to the parameter as a fraction of its range
    jacobian: Float[Array, "n n"]


def evaluate_newton_step_at_fraction(
    problem: AbstractContinuationProblem, args: Any, bounds: Array, z: Unknowns, fraction: Scalar
) -> NewtonStep:
    """Return the Newton step at a fraction of the parameter's range."""
    return problem.linearize(args, z, bounds[0] + (bounds[1] - bounds[0]) * fraction)


def correct_point(
    problem: AbstractContinuationProblem,
    newton_step: NewtonStep,
    bounds: Array,
    plane: ConstraintPlane,
    z: Unknowns,
    fraction: Scalar,
) -> CorrectorState:
    """Return the state after one Newton iteration on the equations of the branch and of the
    constraint plane.
    """
    parameter_range = bounds[1] - bounds[0]
    tangent = jax.tree.map(
        lambda section_state: parameter_range * section_state, newton_step.tangent
    )
    section_state = problem.section_state(z) + problem.section_state(newton_step.correction)
    plane_residual = plane.normal_section @ (
        section_state - plane.section_state
    ) + plane.normal_fraction * (fraction - plane.fraction)
    d_fraction = -plane_residual / (
        plane.normal_section @ problem.section_state(tangent) + plane.normal_fraction
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


def _fraction_from_parameter(p: Array, bounds: Array) -> Array:
    """Return the parameter as a fraction of its range."""
    return (p - bounds[0]) / (bounds[1] - bounds[0])


def parameter_from_fraction(fraction: Array, bounds: Array) -> Array:
    """Return the parameter at a fraction of its range; it is exact at both ends."""
    p = bounds[0] + (bounds[1] - bounds[0]) * fraction
    return jnp.where(fraction == 1.0, bounds[1], p)


class _TrialPoint(NamedTuple):
    """Predicted point of a branch, with the plane on which Newton's method solves for the point."""

    plane: ConstraintPlane
    z: Unknowns
    fraction: Scalar
    length: Scalar  # predicted arc length from the last point
    is_final: Bool[Array, ""]  # whether the point lies on the end of the range


def _predict_point(
    problem: AbstractContinuationProblem,
    previous_point: ContinuationPoint,
    current_point: ContinuationPoint,
    has_two_points: Bool[Array, ""],
    ds: Scalar,
    bounds: Array,
) -> _TrialPoint:
    """Return the predicted point: one step along the tangent, or the nearer end of the range.

    With `has_two_points`, Newton's method starts on the cubic through the last two points with
    their tangents. The cubic is nearer to the branch by two orders and saves one of three
    iterations.
    """
    fraction = _fraction_from_parameter(current_point.p, bounds)
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
    plane = ConstraintPlane(
        section_state + predicted_length * section_tangent,
        target_fraction,
        jnp.where(is_final, 0.0, section_tangent),
        jnp.where(is_final, 1.0, fraction_rate),
    )
    previous_fraction = _fraction_from_parameter(previous_point.p, bounds)
    displacement = jnp.append(
        section_state - problem.section_state(previous_point.z), fraction - previous_fraction
    )
    has_two_points = has_two_points & problem.is_smooth_between(previous_point.z, current_point.z)
    # After a kink the two points are equal up to round-off.
    has_two_points = has_two_points & (displacement @ displacement > (1e-9 * ds) ** 2)
    chord_length = jnp.where(has_two_points, jnp.sqrt(displacement @ displacement), 1.0)

    def extrapolate(
        previous_value: Array, previous_rate: Array, current_value: Array, current_rate: Array
    ) -> Array:
        mean_rate = (current_value - previous_value) / chord_length
        curvature = (current_rate - mean_rate) / chord_length + (
            predicted_length + chord_length
        ) * (previous_rate + current_rate - 2.0 * mean_rate) / chord_length**2
        return (
            current_value
            + predicted_length * current_rate
            + jnp.where(has_two_points, predicted_length**2 * curvature, 0.0)
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
    return _TrialPoint(plane, z, fraction, predicted_length, is_final)


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
    """Assessment of a trial after one Newton iteration; if no flag is set, the iteration
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
    state: ContinuationState,
    corrector: CorrectorState,
    direction: Scalar,
) -> _TrialAssessment:
    """Return whether a trial is accepted or has failed, and the parameter's rate there."""
    current_point, trial, is_first = state.current_point, state.trial, state.n_points == 0
    distance = jnp.maximum(
        jnp.max(jnp.abs(problem.section_state(corrector.z) - trial.plane.section_state)),
        jnp.abs(corrector.fraction - trial.plane.fraction),
    )
    is_valid = jnp.isfinite(corrector.correction_norm) & (is_first | (distance <= state.ds))
    is_converged = is_valid & (corrector.correction_norm < options.tolerance)
    section_tangent = problem.section_state(corrector.tangent)
    alignment = (
        problem.section_state(current_point.tangent) @ section_tangent + current_point.fraction_rate
    )
    alignment = jnp.where(is_first, direction, alignment)
    tangent_norm = jnp.sqrt(1.0 + section_tangent @ section_tangent)
    turns_little = is_first | (jnp.abs(alignment) >= tangent_norm * jnp.cos(options.max_turn_angle))
    # At a kink a branch turns by more than the limit, however short the step is.
    is_kink = is_converged & ~turns_little & (state.ds < options.kink_step_factor * options.min_ds)
    is_kink = is_kink & problem.has_kinks
    is_accepted = is_converged & (turns_little | is_kink)
    has_failed = ~is_accepted & (
        ~is_valid | is_converged | (state.iteration + 1 >= options.max_newton_iterations)
    )
    return _TrialAssessment(
        is_accepted, has_failed, is_kink, jnp.where(alignment >= 0.0, 1.0, -1.0) / tangent_norm
    )


def _is_suspicious(
    problem: AbstractContinuationProblem,
    options: ArclengthOptions,
    state: ContinuationState,
    assessment: _TrialAssessment,
    new_point: ContinuationPoint,
) -> Bool[Array, ""]:
    """Return whether an accepted trial may lie on another branch, which a shorter step may
    avoid.
    """
    if not problem.has_multipliers:
        return jnp.asarray(False)
    current_point = state.current_point
    turns_back = current_point.fraction_rate * new_point.fraction_rate < 0.0
    is_explained = is_multiplier_change_explained(
        current_point.jacobian, new_point.jacobian, turns_back
    )
    can_be_suspicious = (
        assessment.is_accepted
        & (state.n_points > 0)
        & ~state.suspicion.is_resolved
        & new_point.is_admissible
    )
    return can_be_suspicious & ~is_explained


def _choose_next_ds(
    options: ArclengthOptions, state: ContinuationState, assessment: _TrialAssessment
) -> Scalar:
    """Return the length of the next continuation step.

    The step grows after few Newton iterations, shrinks after many, and is halved after a failure.
    """
    converged_quickly, converged_slowly = state.iteration < 4, state.iteration >= 6
    growth_factor = jnp.where(converged_quickly, 1.4, jnp.where(converged_slowly, 0.6, 1.0))
    longer_ds = jnp.minimum(state.ds * growth_factor, options.max_ds)
    shorter_ds = jnp.where(assessment.has_failed, 0.5 * state.ds, state.ds)
    ds = jnp.where(assessment.is_accepted, longer_ds, shorter_ds)
    return jnp.where(state.n_points == 0, options.initial_ds, ds)


def _is_curve_closed(
    problem: AbstractContinuationProblem,
    start: ContinuationPoint,
    current_point: ContinuationPoint,
    next_point: ContinuationPoint,
    bounds: Array,
) -> Bool[Array, ""]:
    """Return whether the segment from one point to the next contains the branch's start."""
    get_coordinates = lambda point: jnp.append(
        problem.section_state(point.z), _fraction_from_parameter(point.p, bounds)
    )
    chord_vector = get_coordinates(next_point) - get_coordinates(current_point)
    start_offset = get_coordinates(start) - get_coordinates(current_point)
    squared_chord_length = chord_vector @ chord_vector
    fraction = (
        start_offset
        @ chord_vector
        / jnp.where(squared_chord_length > 0.0, squared_chord_length, 1.0)
    )
    deviation = start_offset - fraction * chord_vector
    return (
        (fraction >= 0.0)
        & (fraction <= 1.0)
        & (deviation @ deviation < 0.01 * squared_chord_length)
    )


def _update_status(
    options: ArclengthOptions,
    state: ContinuationState,
    assessment: _TrialAssessment,
    new_point: ContinuationPoint,
    ds: Scalar,
    next_length: Scalar,
    is_closed: Bool[Array, ""],
) -> Int[Array, ""]:
    """Return the status after a trial; `next_length` is the length of the next step."""
    is_accepted, has_failed = assessment.is_accepted, assessment.has_failed
    n_points, status = state.n_points + is_accepted, state.status
    for has_occurred, status_code in (
        (ds < options.min_ds, ContinuationStatus.STEP_SIZE_UNDERFLOW),
        (has_failed & (state.n_points == 0), ContinuationStatus.START_NOT_FOUND),
        (is_accepted & (n_points >= options.max_points), ContinuationStatus.MAX_POINTS_REACHED),
        (
            is_accepted & (state.trial.is_final | (next_length <= 1e-12)),
            ContinuationStatus.RANGE_END_REACHED,
        ),
        (is_accepted & ~new_point.is_admissible, ContinuationStatus.POINT_NOT_ADMISSIBLE),
        (is_accepted & is_closed & (state.n_points > 2), ContinuationStatus.CURVE_CLOSED),
    ):
        status = jnp.where(has_occurred, int(status_code), status)
    return status.astype(jnp.int32)


def _init_branch(
    problem: AbstractContinuationProblem,
    options: ArclengthOptions,
    bounds: Array,
    z: Unknowns,
    p: Scalar,
    direction: Scalar,
) -> ContinuationState:
    """Return the initial state of one branch, whose first trial is the given point."""
    x = problem.section_state(z)
    n_section, dtype = x.shape[0], x.dtype
    zero_length, zero_count, constant_false = (
        jnp.zeros((), dtype),
        jnp.zeros((), jnp.int32),
        jnp.asarray(False),
    )
    zero_tangent, fraction = jax.tree.map(jnp.zeros_like, z), _fraction_from_parameter(p, bounds)
    point = ContinuationPoint(
        z,
        p,
        zero_tangent,
        zero_length + direction,
        jnp.zeros((n_section, n_section), dtype),
        constant_false,
    )
    trial = _TrialPoint(
        ConstraintPlane(x, fraction, jnp.zeros_like(x), zero_length + 1.0),
        z,
        fraction,
        zero_length,
        constant_false,
    )
    running_status = zero_count + int(ContinuationStatus.RUNNING)
    suspicion, first_step = (
        BranchJumpSuspicion(zero_length, constant_false),
        zero_length + options.initial_ds,
    )
    return ContinuationState(
        point,
        point,
        point,
        first_step,
        trial,
        suspicion,
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
    z: Unknowns,
    p: Array,
    bounds: Array,
    directions: Array,
    is_requested: Array,
) -> BranchBatch:
    """Return the initial states of the branches and their empty buffers of points."""
    states = jax.vmap(functools.partial(_init_branch, problem, options, bounds))(z, p, directions)
    status = jnp.where(is_requested, states.status, int(ContinuationStatus.START_NOT_FOUND))
    states = states._replace(status=status.astype(jnp.int32))
    allocate_buffer = lambda x: jnp.zeros((x.shape[0], options.max_points, *x.shape[1:]), x.dtype)
    return states, jax.tree.map(allocate_buffer, states.current_point._replace(tangent=()))


def is_active(branches: BranchBatch) -> Array:
    """Return whether the continuation of each branch still runs."""
    return branches[0].status == int(ContinuationStatus.RUNNING)


def iterate_branches(
    problem: AbstractContinuationProblem,
    options: ArclengthOptions,
    batch_args: Any,
    bounds: Array,
    directions: Array,
    buffer_indices: Array,
    branches: BranchBatch,
    newton_steps: NewtonStep,
) -> BranchBatch:
    """Advance each branch by one linearization of its trial, store accepted points, and return the
    states.

    The points of the branches are stored at the indices `buffer_indices` of the buffers.
    """

    def iterate_branch(
        args: Any, direction: Scalar, state: ContinuationState, newton_step: NewtonStep
    ) -> tuple[ContinuationState, ContinuationPoint, Bool[Array, ""]]:
        trial = state.trial
        corrector = correct_point(
            problem, newton_step, bounds, trial.plane, trial.z, trial.fraction
        )
        assessment = _assess_trial(problem, options, state, corrector, direction)
        p = parameter_from_fraction(
            jnp.where(trial.is_final, trial.plane.fraction, corrector.fraction), bounds
        )
        is_admissible = problem.is_admissible(args, corrector.z, p)
        tangent = jax.tree.map(lambda x: assessment.fraction_rate * x, corrector.tangent)
        new_point = ContinuationPoint(
            corrector.z, p, tangent, assessment.fraction_rate, corrector.jacobian, is_admissible
        )
        is_suspicious = _is_suspicious(problem, options, state, assessment, new_point)
        assessment = assessment._replace(
            is_accepted=assessment.is_accepted & ~is_suspicious,
            has_failed=assessment.has_failed | is_suspicious,
        )
        current_point = tree_where(assessment.is_accepted, new_point, state.current_point)
        first_point = tree_where(
            assessment.is_accepted & (state.n_points == 0), new_point, state.first_point
        )
        # The cubic of the prediction must not cross a kink.
        previous_point = tree_where(assessment.is_kink, new_point, state.current_point)
        previous_point = tree_where(assessment.is_accepted, previous_point, state.previous_point)
        n_points = state.n_points + assessment.is_accepted
        ds = _choose_next_ds(options, state, assessment)
        suspicion = state.suspicion.record_trial(is_suspicious, state.ds)
        suspicion, ds = suspicion.resolve(assessment.is_accepted, ds, options.min_ds)
        next_trial = _predict_point(
            problem, previous_point, current_point, n_points > 1, ds, bounds
        )
        is_finished = assessment.is_accepted | assessment.has_failed
        next_trial = tree_where(
            is_finished, next_trial, trial._replace(z=corrector.z, fraction=corrector.fraction)
        )
        is_closed = _is_curve_closed(problem, first_point, state.current_point, new_point, bounds)
        status = _update_status(
            options, state, assessment, new_point, ds, next_trial.length, is_closed
        )
        iteration = jnp.where(is_finished, 0, state.iteration + 1)
        counters = n_points, status, state.n_linearizations + 1
        next_state = ContinuationState(
            previous_point,
            current_point,
            first_point,
            ds,
            next_trial,
            suspicion,
            iteration,
            *counters,
        )
        return next_state, new_point, assessment.is_accepted

    # Buffers are updated outside of `tree_where`, which would copy them in every iteration.
    state, points = branches
    next_states, new_points, is_accepted = jax.vmap(iterate_branch)(
        batch_args, directions, state, newton_steps
    )
    buffer_index = jnp.where(is_active(branches) & is_accepted, state.n_points, options.max_points)
    write_point = lambda buffer, new_points: buffer.at[buffer_indices, buffer_index].set(
        new_points, mode="drop"
    )
    points = jax.tree.map(write_point, points, new_points._replace(tangent=()))
    return jax.vmap(tree_where)(is_active(branches), next_states, state), points


def to_continuation_result(branches: BranchBatch) -> ContinuationResult:
    """Return the result of a continuation from the states of its branches."""
    states, points = branches
    return ContinuationResult(points, states.n_points, states.status, states.n_linearizations)


@eqx.filter_jit
def continue_from(
    problem: AbstractContinuationProblem,
    options: ArclengthOptions,
    batch_args: Any,
    z: Unknowns,
    p: Float[Array, "*branches"],
    bounds: Float[Array, "2"],
    directions: Float[Array, "*branches"],
    is_requested: Bool[Array, "*branches"] | None = None,
) -> ContinuationResult:
    """Continue branches from the points near (z, p) in the given directions, and return all points.

    The parameter grows if the direction is 1 and shrinks if it is -1. The input is one branch, or
    several with a leading axis, of which only the requested ones run. Each branch ends at the end
    of the range, or with its first point that is not admissible, which is kept. Groups of branches
    run concurrently with one linearization of each per iteration. When a branch ends, the next one
    starts.
    """
    if p.ndim == 0:
        add_axis = lambda tree: jax.tree.map(lambda x: x[None], tree)
        result = continue_from(
            problem, options, add_axis(batch_args), add_axis(z), p[None], bounds, directions[None]
        )
        return jax.tree.map(lambda x: x[0], result)
    is_requested = jnp.ones(p.shape, bool) if is_requested is None else is_requested

    def advance_group(branches: BranchBatch) -> BranchBatch:
        group_indices = jnp.argsort(~is_active(branches), stable=True)[
            : batch_sizes.BRANCH_BATCH_SIZE
        ]
        group_args, group_directions, queue_state = jax.tree.map(
            lambda x: x[group_indices], (batch_args, directions, branches[0])
        )
        has_waiting_branch = jnp.sum(is_active(branches)) > len(group_indices)

        def advance_once(branches: BranchBatch) -> BranchBatch:
            linearize_trial = lambda args, trial: evaluate_newton_step_at_fraction(
                problem, args, bounds, trial.z, trial.fraction
            )
            newton_steps = jax.vmap(linearize_trial)(group_args, branches[0].trial)
            return iterate_branches(
                problem,
                options,
                group_args,
                bounds,
                group_directions,
                group_indices,
                branches,
                newton_steps,
            )

        has_active_branch = lambda branches: jnp.where(
            has_waiting_branch, jnp.all(is_active(branches)), jnp.any(is_active(branches))
        )
        queue_state, points = lax.while_loop(
            has_active_branch, advance_once, (queue_state, branches[1])
        )
        return jax.tree.map(
            lambda x, new_point: x.at[group_indices].set(new_point), branches[0], queue_state
        ), points

    branches = init_branches(problem, options, z, p, bounds, directions, is_requested)
    return to_continuation_result(
        lax.while_loop(lambda branches: jnp.any(is_active(branches)), advance_group, branches)
    )
