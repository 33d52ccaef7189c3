"""Continue fixed points in one parameter by pseudo-arclength continuation, also through folds.

An `AbstractContinuationProblem` defines Newton's correction of the unknowns z at a parameter p, and
the derivative dz/dp. Many branches are continued concurrently, and each branch has a buffer of
fixed size for its points. Arc length is measured in the section state and in the parameter as a
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

from vrw_jax.base import batch_sizes
from vrw_jax.base.checks import check_int, check_positive
from vrw_jax.base.elementwise import select_trees_by_condition
from vrw_jax.base.printing import StatusCode
from vrw_jax.base.types import Scalar
from vrw_jax.branches.crossings import BranchJumpSuspicion, is_multiplier_change_explained
from vrw_jax.lanes.autodiff import evaluate_with_jacobian

ProblemUnknowns = Any
"""Tree of float arrays: the unknowns of a continuation problem, which Newton's method corrects."""
SectionStateVector = Float[Array, " n"]


@dataclasses.dataclass(frozen=True)
class ArclengthOptions:
    """Numerical options of a continuation.

    JAX compiles the continuation again whenever an option changes. The length of a continuation
    step is an arc length in the section state and in the parameter as a fraction of its range. For
    `continue_map` the state is in units of its size.

    - `initial_ds`, `max_ds`, `min_ds`: length of the first, the longest and the shortest
      continuation step;
    - `max_points`: largest number of points in each direction;
    - `max_newton_iterations`: largest number of Newton iterations for one point;
    - `tolerance`: largest norm of Newton's last correction;
    - `max_turn_angle`: largest angle between the tangents at neighboring points, rad;
    - `kink_step_factor`: continuation steps shorter than this multiple of `min_ds` may pass a kink
      of the branch at any angle. The value is chosen because three halvings of the step then remain
      for failures of Newton's method between two smooth pieces;
    - `jacobian_reuse_fraction`: if a correction is below this fraction of `tolerance`, the
      iteration ends and the Jacobian at the trial is returned. The value is chosen because that
      Jacobian is then exact.

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
        integer_option_names = ("max_points", "max_newton_iterations")
        for option_name in self.__dataclass_fields__:
            check_option = check_int if option_name in integer_option_names else check_positive
            object.__setattr__(
                self, option_name, check_option(option_name, getattr(self, option_name))
            )
        if not self.min_ds <= self.initial_ds <= self.max_ds:
            raise ValueError(
                f"the steps are {self.min_ds:g} (smallest), {self.initial_ds:g} (first) and "
                f"{self.max_ds:g} (largest), but they must not fall in this order: "
                "give min_ds <= initial_ds <= max_ds."
            )


class NewtonStep(NamedTuple):
    """Newton's correction and the tangent of the branch at a trial point (z, p)."""

    newton_correction: ProblemUnknowns  # of z at fixed p
    branch_tangent: ProblemUnknowns  # derivative dz/dp
    return_map_jacobian: Float[Array, "n n"]  # with respect to the section state


class AbstractSectionStateProblem(eqx.Module):
    """Base class of problems whose unknowns contain a section state.

    The argument `z` contains the unknowns, and `p` contains the varied parameters. The argument
    `args` is a pytree of all other inputs.
    """

    @abc.abstractmethod
    def section_state(self, z: ProblemUnknowns) -> SectionStateVector:
        """Return the section state, which is a part of the unknowns z."""

    def correction_norm(self, z: ProblemUnknowns, correction: ProblemUnknowns) -> Scalar:
        """Return the norm of a Newton correction, which is compared with the tolerance."""
        return jnp.max(jnp.abs(correction))

    def is_admissible(self, args: Any, z: ProblemUnknowns, p: Array) -> Bool[Array, ""]:
        """Return whether the converged unknowns z satisfy the conditions of their branch."""
        return jnp.all(jnp.isfinite(self.section_state(z)))


class AbstractContinuationProblem(AbstractSectionStateProblem):
    """Base class of continuation problems, in one continued parameter `p`."""

    is_traceable: ClassVar[bool] = True
    """Whether JAX can trace `linearize`. If False, `linearize` is called outside compiled code, for
    a batch of points.
    """

    has_multipliers: ClassVar[bool] = True
    """Whether the eigenvalues of `NewtonStep.return_map_jacobian` show bifurcations of the branch.
    This requires that the matrix is the Jacobian of the continued equations.
    """

    has_kinks: ClassVar[bool] = False
    """Whether branches may have kinks, at which the tangent jumps."""

    @abc.abstractmethod
    def linearize(self, args: Any, z: ProblemUnknowns, p: Scalar) -> NewtonStep:
        """Return Newton's correction, the tangent and the Jacobian at (z, p).

        The values are not finite if the map is undefined at (z, p).
        """

    def interpolate_unknowns(
        self, left_point: ProblemUnknowns, right_point: ProblemUnknowns, location_fraction: Scalar
    ) -> ProblemUnknowns:
        """Interpolate the unknowns between two points of a branch.

        `location_fraction` is 0 at `left_point` and 1 at `right_point`. The result is the initial
        guess of Newton's method.
        """
        return jax.tree.map(
            lambda left_leaf, right_leaf: left_leaf + location_fraction * (right_leaf - left_leaf),
            left_point,
            right_point,
        )

    def is_smooth_between(
        self, left_point: ProblemUnknowns, right_point: ProblemUnknowns
    ) -> Bool[Array, ""]:
        """Return whether the branch has no detected kink between two neighboring points."""
        return jnp.asarray(True)


def compute_fixed_point_newton_step(
    return_map: Callable[[Array, Scalar], Array], z: Array, p: Scalar, n_continuous: int
) -> NewtonStep:
    """Return Newton's correction and the branch tangent for the equation `return_map(z, p)` = z.

    The first `n_continuous` components of z are continuous. The remaining components are discrete
    codes. The correction of a code is the difference between its image under the map and the code.
    """
    continuous_map = lambda x, p: return_map(jnp.concatenate([x, z[n_continuous:]]), p)
    mapped_point, partial_jacobians = evaluate_with_jacobian(continuous_map, z[:n_continuous], p)
    jacobian_by_z, jacobian_by_p = (
        partial_jacobian[:n_continuous] for partial_jacobian in partial_jacobians
    )
    map_defect = mapped_point - z
    right_hand_sides = jnp.stack([map_defect[:n_continuous], jacobian_by_p], -1)
    correction, tangent = jnp.linalg.solve(
        jnp.eye(n_continuous, dtype=z.dtype) - jacobian_by_z, right_hand_sides
    ).T
    discrete_code_corrections = map_defect[n_continuous:]
    return NewtonStep(
        jnp.concatenate([correction, discrete_code_corrections]),
        jnp.concatenate([tangent, jnp.zeros_like(discrete_code_corrections)]),
        jacobian_by_z,
    )


class FixedPointProblem(AbstractContinuationProblem):
    """Continuation problem for the fixed points of a map x -> `function(args, x, p)`.

    JAX differentiates the map in forward mode. The map returns NaN where it is undefined. The
    unknowns are x in the given units.
    """

    function: Callable[[Any, SectionStateVector, Scalar], SectionStateVector] = eqx.field(
        static=True
    )
    units: Any = 1.0  # one unit for each component of x, or one number

    def linearize(self, args: Any, z: ProblemUnknowns, p: Scalar) -> NewtonStep:
        return compute_fixed_point_newton_step(
            lambda z, p: self.function(args, z * self.units, p) / self.units, z, p, z.shape[0]
        )

    def section_state(self, z: ProblemUnknowns) -> SectionStateVector:
        return z


class ContinuationStatus(StatusCode):
    """Reason for which a continuation ended in one direction."""

    RUNNING = 0, "The continuation was still running."
    RANGE_END_REACHED = 1, "The parameter's range ended."
    POINT_NOT_ADMISSIBLE = 2, "The next points do not satisfy the conditions of the branch."
    STEP_SIZE_UNDERFLOW = 3, "Newton's method found no next point, however short the step."
    MAX_POINTS_REACHED = 4, "The branch has the largest allowed number of points: raise max_points."
    START_NOT_FOUND = 5, "No starting point was found."
    CURVE_CLOSED = 6, "The curve returned to its start."


class ContinuationPoint(NamedTuple):
    """Point of a branch, and the derivatives of the branch with respect to arc length."""

    z: ProblemUnknowns
    p: Scalar
    arclength_tangent: ProblemUnknowns  # dz/ds; () for stored points
    # derivative of the parameter (as a fraction of its range) with respect to arc length
    fraction_rate: Scalar
    return_map_jacobian: Float[Array, "n n"]
    is_admissible: Bool[Array, ""]


class ContinuationResult(NamedTuple):
    """Points of all branches, in buffers of length `max_points`.

    Only the first `n_points` elements of each buffer are valid.
    """

    points: ContinuationPoint
    n_points: Int[Array, " branches"]
    status: Int[Array, " branches"]  # a ContinuationStatus for each branch
    n_linearizations: Int[Array, " branches"]  # number of calls of `linearize`


class CorrectorPlane(NamedTuple):
    """Plane in which Newton's method solves for a point of a branch, defined by a point and a
    normal.

    The point and the normal each have a part in the section state and a part in the fraction of the
    parameter's range.
    """

    plane_section_state: SectionStateVector
    plane_parameter_fraction: Scalar
    normal_section_part: SectionStateVector
    normal_parameter_part: Scalar


class CorrectorState(NamedTuple):
    """State of the corrector after one Newton iteration."""

    z: ProblemUnknowns
    parameter_fraction: Scalar
    correction_norm: Scalar
    # derivative of z with respect to the fraction of the parameter's range
    fraction_tangent: ProblemUnknowns
    return_map_jacobian: Float[Array, "n n"]


class ContinuationSetup(eqx.Module):
    """Continuation problem with its options and the bounds of the continued parameter.

    Parameter fractions are fractions of the range between the bounds.
    """

    problem: AbstractContinuationProblem
    options: ArclengthOptions = eqx.field(static=True)
    parameter_bounds: Float[Array, "2"]

    @property
    def parameter_range(self) -> Scalar:
        """Return the difference between the bounds."""
        return self.parameter_bounds[1] - self.parameter_bounds[0]

    def compute_parameter_fraction(self, p: Array) -> Array:
        """Return the parameter as a fraction of its range."""
        return (p - self.parameter_bounds[0]) / self.parameter_range

    def compute_parameter(self, parameter_fraction: Array) -> Array:
        """Return the parameter at a fraction of its range.

        Fractions 0 and 1 return the exact bounds.
        """
        p = self.parameter_bounds[0] + self.parameter_range * parameter_fraction
        return jnp.where(parameter_fraction == 1.0, self.parameter_bounds[1], p)

    def linearize_at_fraction(
        self, args: Any, z: ProblemUnknowns, parameter_fraction: Scalar
    ) -> NewtonStep:
        """Return the Newton step at the unknowns z and at a fraction of the parameter's range."""
        p = self.parameter_bounds[0] + self.parameter_range * parameter_fraction
        return self.problem.linearize(args, z, p)


def correct_trial_point(
    setup: ContinuationSetup,
    newton_step: NewtonStep,
    corrector_plane: CorrectorPlane,
    z: ProblemUnknowns,
    parameter_fraction: Scalar,
) -> CorrectorState:
    """Apply one Newton iteration within the corrector plane, and return the new corrector state."""
    section_state_of = setup.problem.section_state
    fraction_tangent = jax.tree.map(
        lambda tangent_leaf: setup.parameter_range * tangent_leaf, newton_step.branch_tangent
    )
    section_state = section_state_of(z) + section_state_of(newton_step.newton_correction)
    plane_residual = corrector_plane.normal_section_part @ (
        section_state - corrector_plane.plane_section_state
    ) + corrector_plane.normal_parameter_part * (
        parameter_fraction - corrector_plane.plane_parameter_fraction
    )
    parameter_fraction_correction = -plane_residual / (
        corrector_plane.normal_section_part @ section_state_of(fraction_tangent)
        + corrector_plane.normal_parameter_part
    )
    dz = jax.tree.map(
        lambda unknown_leaf, tangent_leaf: (
            unknown_leaf + parameter_fraction_correction * tangent_leaf
        ),
        newton_step.newton_correction,
        fraction_tangent,
    )
    correction_norm = jnp.maximum(
        setup.problem.correction_norm(z, dz), jnp.abs(parameter_fraction_correction)
    )
    return CorrectorState(
        jax.tree.map(jnp.add, z, dz),
        parameter_fraction + parameter_fraction_correction,
        correction_norm,
        fraction_tangent,
        newton_step.return_map_jacobian,
    )


class _TrialPoint(NamedTuple):
    """Predicted point of a branch, and the plane in which Newton's method corrects that point."""

    corrector_plane: CorrectorPlane
    z: ProblemUnknowns
    parameter_fraction: Scalar
    predicted_arc_length: Scalar  # from the last point of the branch
    is_range_end: Bool[Array, ""]  # whether the plane is at an end of the parameter's range


def _predict_trial_point(
    setup: ContinuationSetup,
    previous_point: ContinuationPoint,
    current_point: ContinuationPoint,
    has_previous_point: Bool[Array, ""],
    ds: Scalar,
) -> _TrialPoint:
    """Predict the trial point one continuation step ahead, or at the end of the range if it is
    nearer.

    If `has_previous_point` is true, the prediction is the cubic polynomial through the last two
    points and their tangents. Its error is two orders smaller than the error of a prediction by the
    tangent. This saves one of three Newton iterations.
    """
    problem = setup.problem
    parameter_fraction = setup.compute_parameter_fraction(current_point.p)
    fraction_rate = current_point.fraction_rate
    range_end_fraction = jnp.where(fraction_rate > 0.0, 1.0, 0.0)
    is_parameter_stationary = fraction_rate == 0.0
    arc_length_to_range_end = jnp.where(
        is_parameter_stationary,
        jnp.inf,
        (range_end_fraction - parameter_fraction)
        / jnp.where(is_parameter_stationary, 1.0, fraction_rate),
    )
    is_range_end = arc_length_to_range_end <= ds
    predicted_arc_length = jnp.where(is_range_end, arc_length_to_range_end, ds)
    section_tangent = problem.section_state(current_point.arclength_tangent)
    section_state = problem.section_state(current_point.z)
    target_parameter_fraction = jnp.where(
        is_range_end, range_end_fraction, parameter_fraction + predicted_arc_length * fraction_rate
    )
    corrector_plane = CorrectorPlane(
        section_state + predicted_arc_length * section_tangent,
        target_parameter_fraction,
        jnp.where(is_range_end, 0.0, section_tangent),
        jnp.where(is_range_end, 1.0, fraction_rate),
    )
    previous_parameter_fraction = setup.compute_parameter_fraction(previous_point.p)
    point_displacement = jnp.append(
        section_state - problem.section_state(previous_point.z),
        parameter_fraction - previous_parameter_fraction,
    )
    squared_chord_length = point_displacement @ point_displacement
    # After a kink, the previous and the current point are equal up to round-off.
    has_previous_point = (
        has_previous_point
        & problem.is_smooth_between(previous_point.z, current_point.z)
        & (squared_chord_length > (1e-9 * ds) ** 2)
    )
    chord_length = jnp.where(has_previous_point, jnp.sqrt(squared_chord_length), 1.0)

    def extrapolate_cubic(
        previous_leaf: Array, previous_rate: Array, current_leaf: Array, current_rate: Array
    ) -> Array:
        mean_rate = (current_leaf - previous_leaf) / chord_length
        cubic_coefficient = (current_rate - mean_rate) / chord_length + (
            predicted_arc_length + chord_length
        ) * (previous_rate + current_rate - 2.0 * mean_rate) / chord_length**2
        return (
            current_leaf
            + predicted_arc_length * current_rate
            + jnp.where(has_previous_point, predicted_arc_length**2 * cubic_coefficient, 0.0)
        )

    z, parameter_fraction = jax.tree.map(
        extrapolate_cubic,
        (previous_point.z, previous_parameter_fraction),
        (previous_point.arclength_tangent, previous_point.fraction_rate),
        (current_point.z, parameter_fraction),
        (current_point.arclength_tangent, fraction_rate),
    )
    parameter_fraction = jnp.where(is_range_end, range_end_fraction, parameter_fraction)
    return _TrialPoint(corrector_plane, z, parameter_fraction, predicted_arc_length, is_range_end)


class _TrialVerdict(NamedTuple):
    """Verdict on a trial point after one Newton iteration.

    If the trial is neither accepted nor failed, another Newton iteration follows.
    """

    is_trial_accepted: Bool[Array, ""]
    has_trial_failed: Bool[Array, ""]
    # whether the trial is accepted despite a turn of more than `max_turn_angle`
    is_trial_kink: Bool[Array, ""]
    fraction_rate: Scalar  # derivative of the parameter fraction in the direction of continuation


class ContinuationState(NamedTuple):
    """State of the continuation of one branch in one direction."""

    previous_point: ContinuationPoint
    current_point: ContinuationPoint
    first_point: ContinuationPoint  # meaningless until a point is accepted
    ds: Scalar
    trial_point: _TrialPoint
    jump_suspicion: BranchJumpSuspicion
    n_newton_iterations: Int[Array, ""]
    n_points: Int[Array, ""]
    status_code: Int[Array, ""]
    n_linearizations: Int[Array, ""]

    @classmethod
    def from_start(
        cls,
        setup: ContinuationSetup,
        z: ProblemUnknowns,
        p: Scalar,
        direction_sign: Scalar,
    ) -> "ContinuationState":
        """Return the initial state of one branch, whose first trial point is (z, p)."""
        section_state = setup.problem.section_state(z)
        n_section_coordinates, float_dtype = section_state.shape[0], section_state.dtype
        initial_arc_length, initial_count = jnp.zeros((), float_dtype), jnp.zeros((), jnp.int32)
        initial_flag = jnp.asarray(False)
        parameter_fraction = setup.compute_parameter_fraction(p)
        initial_point = ContinuationPoint(
            z,
            p,
            jax.tree.map(jnp.zeros_like, z),
            initial_arc_length + direction_sign,
            jnp.zeros((n_section_coordinates, n_section_coordinates), float_dtype),
            initial_flag,
        )
        corrector_plane = CorrectorPlane(
            section_state,
            parameter_fraction,
            jnp.zeros_like(section_state),
            initial_arc_length + 1.0,
        )
        return cls(
            initial_point,
            initial_point,
            initial_point,
            initial_arc_length + setup.options.initial_ds,
            _TrialPoint(corrector_plane, z, parameter_fraction, initial_arc_length, initial_flag),
            BranchJumpSuspicion(initial_arc_length, initial_flag),
            initial_count,
            initial_count,
            initial_count + int(ContinuationStatus.RUNNING),
            initial_count,
        )

    def assess_trial(
        self,
        setup: ContinuationSetup,
        corrector_state: CorrectorState,
        direction_sign: Scalar,
    ) -> _TrialVerdict:
        """Assess a trial point after one Newton iteration, and return the verdict."""
        problem, options = setup.problem, setup.options
        current_point, trial_point = self.current_point, self.trial_point
        is_first_point = self.n_points == 0
        trial_distance = jnp.maximum(
            jnp.max(
                jnp.abs(
                    problem.section_state(corrector_state.z)
                    - trial_point.corrector_plane.plane_section_state
                )
            ),
            jnp.abs(
                corrector_state.parameter_fraction
                - trial_point.corrector_plane.plane_parameter_fraction
            ),
        )
        is_trial_valid = jnp.isfinite(corrector_state.correction_norm) & (
            is_first_point | (trial_distance <= self.ds)
        )
        has_trial_converged = is_trial_valid & (corrector_state.correction_norm < options.tolerance)
        section_tangent = problem.section_state(corrector_state.fraction_tangent)
        tangent_alignment = (
            problem.section_state(current_point.arclength_tangent) @ section_tangent
            + current_point.fraction_rate
        )
        tangent_alignment = jnp.where(is_first_point, direction_sign, tangent_alignment)
        tangent_norm = jnp.sqrt(1.0 + section_tangent @ section_tangent)
        is_turn_small = is_first_point | (
            jnp.abs(tangent_alignment) >= tangent_norm * jnp.cos(options.max_turn_angle)
        )
        # At a kink a branch turns by more than the limit, even if the continuation step is short.
        is_trial_kink = (
            has_trial_converged
            & ~is_turn_small
            & (self.ds < options.kink_step_factor * options.min_ds)
            & problem.has_kinks
        )
        is_trial_accepted = has_trial_converged & (is_turn_small | is_trial_kink)
        has_trial_failed = ~is_trial_accepted & (
            ~is_trial_valid
            | has_trial_converged
            | (self.n_newton_iterations + 1 >= options.max_newton_iterations)
        )
        return _TrialVerdict(
            is_trial_accepted,
            has_trial_failed,
            is_trial_kink,
            jnp.where(tangent_alignment >= 0.0, 1.0, -1.0) / tangent_norm,
        )

    def is_jump_suspicious(
        self,
        problem: AbstractContinuationProblem,
        trial_verdict: _TrialVerdict,
        new_point: ContinuationPoint,
    ) -> Bool[Array, ""]:
        """Return whether an accepted trial may lie on another branch.

        A shorter continuation step may then avoid the jump.
        """
        if not problem.has_multipliers:
            return jnp.asarray(False)
        current_point = self.current_point
        has_parameter_turned_back = current_point.fraction_rate * new_point.fraction_rate < 0.0
        is_multiplier_change_explained_by_bifurcations = is_multiplier_change_explained(
            current_point.return_map_jacobian,
            new_point.return_map_jacobian,
            has_parameter_turned_back,
        )
        can_trial_be_suspicious = (
            trial_verdict.is_trial_accepted
            & (self.n_points > 0)
            & ~self.jump_suspicion.accepts_any_multipliers
            & new_point.is_admissible
        )
        return can_trial_be_suspicious & ~is_multiplier_change_explained_by_bifurcations

    def choose_next_ds(self, options: ArclengthOptions, trial_verdict: _TrialVerdict) -> Scalar:
        """Return the length of the next continuation step.

        The continuation step is lengthened after few Newton iterations, shortened after many, and
        halved after a failure.
        """
        ds_growth_factor = jnp.where(
            self.n_newton_iterations < 4, 1.4, jnp.where(self.n_newton_iterations >= 6, 0.6, 1.0)
        )
        longer_ds = jnp.minimum(self.ds * ds_growth_factor, options.max_ds)
        shorter_ds = jnp.where(trial_verdict.has_trial_failed, 0.5 * self.ds, self.ds)
        chosen_ds = jnp.where(trial_verdict.is_trial_accepted, longer_ds, shorter_ds)
        return jnp.where(self.n_points == 0, options.initial_ds, chosen_ds)

    def is_curve_closed(
        self, setup: ContinuationSetup, next_point: ContinuationPoint
    ) -> Bool[Array, ""]:
        """Return whether the start of the branch lies on the segment up to the next point."""
        start, current, next_coordinates = (
            jnp.append(
                setup.problem.section_state(point.z), setup.compute_parameter_fraction(point.p)
            )
            for point in (self.first_point, self.current_point, next_point)
        )
        chord_vector, offset_to_start = next_coordinates - current, start - current
        squared_chord_length = chord_vector @ chord_vector
        chord_fraction = (
            offset_to_start
            @ chord_vector
            / jnp.where(squared_chord_length > 0.0, squared_chord_length, 1.0)
        )
        offset_from_chord = offset_to_start - chord_fraction * chord_vector
        return (
            (chord_fraction >= 0.0)
            & (chord_fraction <= 1.0)
            & (offset_from_chord @ offset_from_chord < 0.01 * squared_chord_length)
        )

    def compute_next_status_code(
        self,
        setup: ContinuationSetup,
        trial_verdict: _TrialVerdict,
        new_point: ContinuationPoint,
        ds: Scalar,
        next_arc_length: Scalar,
    ) -> Int[Array, ""]:
        """Return the `ContinuationStatus` of a branch after a trial.

        `ds` is the proposed length of the next continuation step. `next_arc_length` is its
        predicted arc length, which is shorter at the end of the range.
        """
        options, (is_trial_accepted, has_trial_failed, *_) = setup.options, trial_verdict
        n_points, branch_status_code = self.n_points + is_trial_accepted, self.status_code
        for has_branch_ended, status_code in (
            (ds < options.min_ds, ContinuationStatus.STEP_SIZE_UNDERFLOW),
            (has_trial_failed & (self.n_points == 0), ContinuationStatus.START_NOT_FOUND),
            (
                is_trial_accepted & (n_points >= options.max_points),
                ContinuationStatus.MAX_POINTS_REACHED,
            ),
            (
                is_trial_accepted & (self.trial_point.is_range_end | (next_arc_length <= 1e-12)),
                ContinuationStatus.RANGE_END_REACHED,
            ),
            (is_trial_accepted & ~new_point.is_admissible, ContinuationStatus.POINT_NOT_ADMISSIBLE),
            (
                is_trial_accepted & (self.n_points > 2) & self.is_curve_closed(setup, new_point),
                ContinuationStatus.CURVE_CLOSED,
            ),
        ):
            branch_status_code = jnp.where(has_branch_ended, int(status_code), branch_status_code)
        return branch_status_code.astype(jnp.int32)


BranchBatch = tuple[ContinuationState, ContinuationPoint]
"""States of the concurrent branches, and the buffers that store the points of the branches."""


def init_branches(
    setup: ContinuationSetup,
    z: ProblemUnknowns,
    p: Array,
    direction_signs: Array,
    is_branch_requested: Array,
) -> BranchBatch:
    """Return the initial states of all branches, and empty buffers for their points.

    A branch starts only if its element of `is_branch_requested` is true.
    """
    continuation_states = jax.vmap(functools.partial(ContinuationState.from_start, setup))(
        z, p, direction_signs
    )
    initial_status = jnp.where(
        is_branch_requested,
        continuation_states.status_code,
        int(ContinuationStatus.START_NOT_FOUND),
    )
    continuation_states = continuation_states._replace(status_code=initial_status.astype(jnp.int32))
    allocate_buffer = lambda x: jnp.zeros(
        (x.shape[0], setup.options.max_points, *x.shape[1:]), x.dtype
    )
    return continuation_states, jax.tree.map(
        allocate_buffer, continuation_states.current_point._replace(arclength_tangent=())
    )


def are_branches_active(branch_batch: BranchBatch) -> Array:
    """Return whether the continuation of each branch is still running."""
    return branch_batch[0].status_code == int(ContinuationStatus.RUNNING)


def iterate_branches(
    setup: ContinuationSetup,
    args_by_branch: Any,
    direction_signs: Array,
    branch_buffer_indices: Array,
    branch_batch: BranchBatch,
    newton_steps: NewtonStep,
) -> BranchBatch:
    """Apply one Newton iteration to the trial of each branch, and store the accepted points.

    Accepted points of branch i are stored in the buffer with index `branch_buffer_indices[i]`.
    """
    problem, options = setup.problem, setup.options

    def iterate_branch(
        args: Any,
        direction_sign: Scalar,
        continuation_state: ContinuationState,
        newton_step: NewtonStep,
    ) -> tuple[ContinuationState, ContinuationPoint, Bool[Array, ""]]:
        trial_point = continuation_state.trial_point
        corrector_state = correct_trial_point(
            setup,
            newton_step,
            trial_point.corrector_plane,
            trial_point.z,
            trial_point.parameter_fraction,
        )
        trial_verdict = continuation_state.assess_trial(setup, corrector_state, direction_sign)
        accepted_parameter = setup.compute_parameter(
            jnp.where(
                trial_point.is_range_end,
                trial_point.corrector_plane.plane_parameter_fraction,
                corrector_state.parameter_fraction,
            )
        )
        is_admissible = problem.is_admissible(args, corrector_state.z, accepted_parameter)
        arclength_tangent = jax.tree.map(
            lambda x: trial_verdict.fraction_rate * x, corrector_state.fraction_tangent
        )
        new_point = ContinuationPoint(
            corrector_state.z,
            accepted_parameter,
            arclength_tangent,
            trial_verdict.fraction_rate,
            corrector_state.return_map_jacobian,
            is_admissible,
        )
        is_trial_suspicious = continuation_state.is_jump_suspicious(
            problem, trial_verdict, new_point
        )
        is_trial_accepted = trial_verdict.is_trial_accepted & ~is_trial_suspicious
        has_trial_failed = trial_verdict.has_trial_failed | is_trial_suspicious
        trial_verdict = trial_verdict._replace(
            is_trial_accepted=is_trial_accepted, has_trial_failed=has_trial_failed
        )
        current_point = select_trees_by_condition(
            is_trial_accepted, new_point, continuation_state.current_point
        )
        first_point = select_trees_by_condition(
            is_trial_accepted & (continuation_state.n_points == 0),
            new_point,
            continuation_state.first_point,
        )
        # The cubic prediction must not cross a kink.
        previous_point = select_trees_by_condition(
            trial_verdict.is_trial_kink, new_point, continuation_state.current_point
        )
        previous_point = select_trees_by_condition(
            is_trial_accepted, previous_point, continuation_state.previous_point
        )
        n_points = continuation_state.n_points + is_trial_accepted
        jump_suspicion, ds = continuation_state.jump_suspicion.update_after_trial(
            is_trial_suspicious,
            is_trial_accepted,
            continuation_state.ds,
            continuation_state.choose_next_ds(options, trial_verdict),
            options.min_ds,
        )
        next_trial_point = _predict_trial_point(
            setup, previous_point, current_point, n_points > 1, ds
        )
        is_trial_finished = is_trial_accepted | has_trial_failed
        next_trial_point = select_trees_by_condition(
            is_trial_finished,
            next_trial_point,
            trial_point._replace(
                z=corrector_state.z, parameter_fraction=corrector_state.parameter_fraction
            ),
        )
        next_status = continuation_state.compute_next_status_code(
            setup, trial_verdict, new_point, ds, next_trial_point.predicted_arc_length
        )
        next_n_newton_iterations = jnp.where(
            is_trial_finished, 0, continuation_state.n_newton_iterations + 1
        )
        next_continuation_state = ContinuationState(
            previous_point,
            current_point,
            first_point,
            ds,
            next_trial_point,
            jump_suspicion,
            next_n_newton_iterations,
            n_points,
            next_status,
            continuation_state.n_linearizations + 1,
        )
        return next_continuation_state, new_point, is_trial_accepted

    # Buffers are updated outside `select_trees_by_condition`, which would copy them in every
    # iteration.
    continuation_state, point_buffers = branch_batch
    next_continuation_states, new_points, is_trial_accepted = jax.vmap(iterate_branch)(
        args_by_branch, direction_signs, continuation_state, newton_steps
    )
    point_index_in_buffer = jnp.where(
        are_branches_active(branch_batch) & is_trial_accepted,
        continuation_state.n_points,
        options.max_points,
    )
    write_point = lambda point_buffer, new_points: point_buffer.at[
        branch_buffer_indices, point_index_in_buffer
    ].set(new_points, mode="drop")
    point_buffers = jax.tree.map(
        write_point, point_buffers, new_points._replace(arclength_tangent=())
    )
    return jax.vmap(select_trees_by_condition)(
        are_branches_active(branch_batch), next_continuation_states, continuation_state
    ), point_buffers


def make_continuation_result(branch_batch: BranchBatch) -> ContinuationResult:
    """Return the points of all branches, the number of points per branch, and the statuses."""
    continuation_states, point_buffers = branch_batch
    return ContinuationResult(
        point_buffers,
        continuation_states.n_points,
        continuation_states.status_code,
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
    """Continue branches from the points near (z, p), and return all points.

    The sign 1 in `direction_signs` increases the parameter, and the sign -1 decreases it. The input
    is one branch, or several branches on a leading axis. Only the branches selected by
    `is_branch_requested` are continued; the default selects all.

    A branch ends at the end of the parameter's range, or at its first point that is not admissible.
    That point is included. A group of branches runs concurrently, with one linearization per branch
    and iteration. When a branch of the group ends, the next branch starts.
    """
    if p.ndim == 0:
        add_branch_axis = lambda tree_of_one_branch: jax.tree.map(
            lambda x: x[None], tree_of_one_branch
        )
        batched_continuation_result = continue_from(
            problem,
            options,
            add_branch_axis(args_by_branch),
            add_branch_axis(z),
            p[None],
            parameter_bounds,
            direction_signs[None],
        )
        return jax.tree.map(lambda x: x[0], batched_continuation_result)
    if is_branch_requested is None:
        is_branch_requested = jnp.ones(p.shape, bool)
    setup = ContinuationSetup(problem, options, parameter_bounds)

    def advance_concurrent_branches(branch_batch: BranchBatch) -> BranchBatch:
        concurrent_branch_indices = jnp.argsort(~are_branches_active(branch_batch), stable=True)[
            : batch_sizes.BRANCH_BATCH_SIZE
        ]
        concurrent_branch_args, concurrent_directions, concurrent_branch_states = jax.tree.map(
            lambda x: x[concurrent_branch_indices],
            (args_by_branch, direction_signs, branch_batch[0]),
        )
        is_any_branch_waiting = jnp.sum(are_branches_active(branch_batch)) > len(
            concurrent_branch_indices
        )

        def advance_group_once(branch_batch: BranchBatch) -> BranchBatch:
            linearize_trial = lambda args, trial_point: setup.linearize_at_fraction(
                args, trial_point.z, trial_point.parameter_fraction
            )
            newton_steps = jax.vmap(linearize_trial)(
                concurrent_branch_args, branch_batch[0].trial_point
            )
            return iterate_branches(
                setup,
                concurrent_branch_args,
                concurrent_directions,
                concurrent_branch_indices,
                branch_batch,
                newton_steps,
            )

        has_active_branch = lambda branch_batch: jnp.where(
            is_any_branch_waiting,
            jnp.all(are_branches_active(branch_batch)),
            jnp.any(are_branches_active(branch_batch)),
        )
        concurrent_branch_states, point_buffers = lax.while_loop(
            has_active_branch, advance_group_once, (concurrent_branch_states, branch_batch[1])
        )
        return jax.tree.map(
            lambda x, new_point: x.at[concurrent_branch_indices].set(new_point),
            branch_batch[0],
            concurrent_branch_states,
        ), point_buffers

    branch_batch = init_branches(setup, z, p, direction_signs, is_branch_requested)
    return make_continuation_result(
        lax.while_loop(
            lambda branch_batch: jnp.any(are_branches_active(branch_batch)),
            advance_concurrent_branches,
            branch_batch,
        )
    )
