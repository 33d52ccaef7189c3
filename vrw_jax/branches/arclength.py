"""Continue branches by pseudo-arclength continuation, through folds and past kinks.

An `AbstractContinuationProblem` defines Newton's correction of the unknowns z at a parameter p, and
the derivative dz/dp, for a batch of points. Each branch is a generator, which yields the points at
which it needs them. `run_together` computes the requested points of all branches in one batch. Arc
length is measured in the section state and in the parameter as a fraction of its range.
"""

import abc
import dataclasses
import functools
from collections.abc import Callable, Generator, Mapping, Sequence
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from vrw_jax.base.checks import check_int, check_positive
from vrw_jax.base.progress import report_progress
from vrw_jax.base.results import Outcome, StatusCode
from vrw_jax.branches.branch import BIFURCATIONS, TestFunction, is_multiplier_change_explained
from vrw_jax.gaits.finder import STATE_AGREEMENT_TOLERANCE
from vrw_jax.lanes.autodiff import evaluate_with_jacobian
from vrw_jax.lanes.batching import map_in_numpy_batches, select_tree_rows

LOCATION_BATCH_SIZES = (1, 8)
"""Numbers of special points that one call locates. Only one size is compiled if compilation is
expensive.
"""

Unknowns = Float[np.ndarray, " unknowns"]

QuantitiesByName = dict[str, np.ndarray]
"""Arrays of quantities with one element per point, by the name of the quantity."""


@dataclasses.dataclass(frozen=True)
class ArclengthOptions:
    """Numerical options of a continuation.

    The length of a continuation step is an arc length in the section state and in the parameter as
    a fraction of its range. For `continue_map` the state is in units of its size.

    - `initial_ds`, `max_ds`, `min_ds`: length of the first, the longest and the shortest
      continuation step;
    - `max_points`: largest number of points in each direction;
    - `max_newton_iterations`: largest number of Newton iterations for one point;
    - `tolerance`: largest norm of Newton's last correction;
    - `max_turn_angle`: largest angle between the tangents at neighboring points, rad;
    - `kink_step_factor`: continuation steps shorter than this multiple of `min_ds` may pass a kink
      of the branch at any angle, or a fold at a bound of the parameter. The value is chosen because
      three halvings of the step then remain for failures of Newton's method between two smooth
      pieces;
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
    """Newton's correction and the tangent of the branch at trial points, or at one trial point."""

    newton_correction: Float[Array | np.ndarray, "*points unknowns"]  # of z at fixed p
    branch_tangent: Float[Array | np.ndarray, "*points unknowns"]  # derivative dz/dp
    return_map_jacobian: Float[Array | np.ndarray, "*points n n"]  # by the section state


class AbstractContinuationProblem(abc.ABC):
    """Base class of continuation problems, in one continued parameter `p`.

    The unknowns `z` of a point begin with its section state, of which arc lengths are measured. The
    argument `args` is a tree of all other inputs, such as the wheel. A problem also defines the
    quantities of its points and their test functions.
    """

    test_functions: ClassVar[Mapping[str, TestFunction]] = BIFURCATIONS
    """Test functions by name; the name of one of a leg has the number of the leg in brackets."""

    linear_margin_substitutes: ClassVar[Mapping[str, str]] = {}
    """Names of margins whose roots are ill-conditioned. Each margin is mapped to the name of a
    quantity that vanishes linearly at the same point.
    """

    location_unit: ClassVar[float | None] = None
    """Unit of the parameter in which special points are located, or None for its range."""

    @property
    def section_units(self) -> Any:
        """Return the units of the components of the section state among the unknowns."""
        return 1.0

    has_multipliers: ClassVar[bool] = True
    """Whether the eigenvalues of `NewtonStep.return_map_jacobian` show bifurcations of the branch.
    This requires that the matrix is the Jacobian of the continued equations.
    """

    has_kinks: ClassVar[bool] = False
    """Whether branches may have kinks, at which the tangent jumps."""

    may_start_singular: ClassVar[bool] = False
    """Whether a branch starts next to a given start at which the equations are singular."""

    may_start_vertical: ClassVar[bool] = False
    """Whether a branch may start where only its first unknown varies, and not the parameter."""

    @abc.abstractmethod
    def linearize(
        self, args: Any, z: Float[np.ndarray, "points unknowns"], p: Float[np.ndarray, " points"]
    ) -> NewtonStep:
        """Return Newton's correction, the tangent and the Jacobian at many points (z, p).

        The values are not finite if the map is undefined at (z, p).
        """

    def section_state(self, z: np.ndarray) -> np.ndarray:
        """Return the section state, with which the unknowns of a point begin."""
        return z

    def correction_norm(self, z: Unknowns, correction: Unknowns) -> float:
        """Return the norm of a Newton correction, which is compared with the tolerance."""
        return np.max(np.abs(correction))

    def is_admissible(self, args: Any, z: Unknowns, p: float) -> bool:
        """Return whether the converged unknowns z satisfy the conditions of their branch."""
        return bool(np.isfinite(self.section_state(z)).all())

    def displace(self, args: Any, z: Unknowns, p: float, section_state: np.ndarray) -> Unknowns:
        """Return initial guesses of the unknowns near z for another section state."""
        return np.append(section_state, z[len(section_state) :])

    def interpolate(self, left: np.ndarray, right: np.ndarray, fraction: np.ndarray) -> np.ndarray:
        """Return initial guesses between points of a branch, each at a fraction of the way."""
        return left + fraction[:, None] * (right - left)

    def is_smooth_between(self, left: Unknowns, right: Unknowns) -> bool:
        """Return whether the branch has no detected kink between two neighboring points."""
        return True

    def measure(self, args: Any, points: "ContinuationPoint") -> QuantitiesByName:
        """Return quantities at many points by name, except those computed from the Jacobian."""
        return {}

    def make_point_reader(self, args: Any, point: "ContinuationPoint") -> Callable | None:
        """Return a function that finds the gait at a point, or None if no gait can be found."""
        return None

    def describe_parameter(self, name: str) -> dict[str, str]:
        """Return the attributes of the continued parameter in the dataset of a branch."""
        return {"units": "1"}

    def are_points_admissible(self, quantities: QuantitiesByName) -> np.ndarray:
        """Return whether each point is admissible, computed from the quantities at the points.

        A gait is admissible if its event-driven step returns to its section state. A fixed point of
        another map has no such step, and every finite fixed point is admissible.
        """
        if "outcome" not in quantities:
            return np.asarray(True)
        return (quantities["outcome"] == Outcome.STEPPED) & (
            quantities.get("closure", 0.0) <= STATE_AGREEMENT_TOLERANCE
        )

    def mask_undefined_quantities(
        self, quantities: QuantitiesByName, owners: np.ndarray
    ) -> QuantitiesByName:
        """Replace each quantity that is undefined for the wheel of a point by NaN."""
        return quantities

    def describe_branch_end(self, end_name: str, parameter_value: float) -> str:
        """Return a sentence that describes the end of a branch."""
        return f"{end_name.replace('_', ' ')} at {parameter_value:.9g} ends it."

    def explain_stalled_end(self, quantities: QuantitiesByName) -> str:
        """Return a sentence on why Newton's method finds nothing beyond a point, or "".

        - `quantities`: quantities of this point, with an axis of length 1.
        """
        return ""


class ContinuationStatus(StatusCode):
    """Reason for which a continuation ended in one direction."""

    RUNNING = 0, "The continuation was still running."
    RANGE_END_REACHED = 1, "The parameter's range ended."
    POINT_NOT_ADMISSIBLE = 2, "The next points do not satisfy the conditions of the branch."
    STEP_SIZE_UNDERFLOW = 3, "Newton's method found no next point, however short the step."
    MAX_POINTS_REACHED = 4, "The branch is at its limit: raise max_points of ArclengthOptions."
    START_NOT_FOUND = 5, "No starting point was found."
    CURVE_CLOSED = 6, "The curve returned to its start."
    BRANCH_SWITCHED = 7, "It begins on another branch."


class ContinuationPoint(NamedTuple):
    """Point of a branch with its derivatives by arc length, or many points on a leading axis."""

    z: np.ndarray
    p: Any
    arclength_tangent: np.ndarray  # dz/ds
    fraction_rate: Any  # derivative of the parameter, as a fraction of its range, by arc length
    return_map_jacobian: np.ndarray
    is_admissible: Any

    def reverse(self) -> "ContinuationPoint":
        """Return the point with the rates in the opposite direction."""
        return self._replace(
            arclength_tangent=-self.arclength_tangent, fraction_rate=-self.fraction_rate
        )


POINT_BATCH_SIZES = (LOCATION_BATCH_SIZES[-1],)
"""Number of points that one call of an XLA program computes, one size so that it compiles once."""


@eqx.filter_jit
def _linearize_map(
    function: Callable, units: tuple[float, ...], args: Any, z: Array, p: Array
) -> NewtonStep:
    """Return the Newton steps of fixed points of a map at many points, see `MapProblem`."""
    n_continuous = len(units)
    scale = jnp.asarray([*units, *[1.0] * (z.shape[1] - n_continuous)])

    def linearize(args: Any, z: Array, p: Array) -> NewtonStep:
        codes = z[n_continuous:]
        evaluate = lambda x, p: function(args, jnp.concatenate([x, codes]) * scale, p) / scale
        image, jacobians = evaluate_with_jacobian(evaluate, z[:n_continuous], p)
        by_z, by_p = (jacobian[:n_continuous] for jacobian in jacobians)
        defect = image - z
        right_sides = jnp.column_stack([defect[:n_continuous], by_p])
        solutions = jnp.linalg.solve(jnp.eye(n_continuous) - by_z, right_sides).T
        tangents = jnp.pad(solutions[1:], ((0, 0), (0, len(codes))))
        return NewtonStep(
            jnp.concatenate([solutions[0], defect[n_continuous:]]),
            tangents if p.ndim else tangents[0],
            by_z,
        )

    return jax.vmap(linearize)(args, z, p)


@dataclasses.dataclass(frozen=True, eq=False)
class AbstractStateProblem(AbstractContinuationProblem):
    """Base class of problems whose unknowns are section states in units, fixed points of a map.

    Components without a unit are discrete codes, which Newton's method copies from the image under
    the map. It converges only if state and image have equal codes.
    """

    units: tuple[float, ...]

    @property
    def section_units(self) -> np.ndarray:
        return np.array(self.units)

    @property
    @abc.abstractmethod
    def function(self) -> Callable[[Any, Array, Array], Array]:
        """Return the map x -> `function(args, x, p)`, which is NaN where it is undefined.

        If p is a vector, there is a tangent for each entry.
        """

    def linearize(self, args: Any, z: np.ndarray, p: np.ndarray) -> NewtonStep:
        linearize = functools.partial(_linearize_map, self.function, self.units)
        return map_in_numpy_batches(linearize, POINT_BATCH_SIZES, args, z, p)

    def section_state(self, z: np.ndarray) -> np.ndarray:
        return z[..., : len(self.units)]

    def interpolate(self, left: np.ndarray, right: np.ndarray, fraction: np.ndarray) -> np.ndarray:
        """Interpolate the coordinates; the discrete codes are those of the nearer state."""
        nearer = np.where(fraction[:, None] < 0.5, left, right)
        between, n = super().interpolate(left, right, fraction), len(self.units)
        return np.concatenate([between[:, :n], nearer[:, n:]], 1)

    def is_smooth_between(self, left: np.ndarray, right: np.ndarray) -> bool:
        return bool(np.all(left[len(self.units) :] == right[len(self.units) :]))


@dataclasses.dataclass(frozen=True, eq=False)
class MapProblem(AbstractStateProblem):
    """Continuation problem for the fixed points of any map, which JAX differentiates."""

    iterated_map: Callable[[Any, Array, Array], Array]
    period_n: int = 1  # number of iterates

    may_start_singular: ClassVar[bool] = True

    @property
    def function(self) -> Callable[[Any, Array, Array], Array]:
        if self.period_n == 1:
            return self.iterated_map
        return jax.tree_util.Partial(_iterate_map, self.iterated_map, self.period_n)

    def measure(self, args: Any, points: ContinuationPoint) -> QuantitiesByName:
        return {"x": self.section_units * points.z}

    def label(self, quantities: QuantitiesByName) -> tuple[dict, dict]:
        return {"x": (("point", "component"), quantities["x"])}, {}


def _iterate_map(function: Callable, n: int, args: Any, x: Array, p: Array) -> Array:
    for _ in range(n):
        x = function(args, x, p)
    return x


class Track(NamedTuple):
    """Points of a branch in one direction, and why the continuation ended."""

    points: list[ContinuationPoint]
    status: ContinuationStatus


class Correction(NamedTuple):
    """Result of Newton's method on a plane across a branch."""

    z: Unknowns
    fraction: float  # of the parameter's range
    fraction_tangent: Unknowns  # derivative of z by that fraction
    return_map_jacobian: np.ndarray
    has_converged: bool
    n_iterations: int


MAX_RANGE_EXCESS = 1e-12
"""Largest round-off of the parameter beyond its bounds, as a fraction of its range."""

SUSPICIOUS_STEP_TOLERANCE = 1e-10
"""Tolerance of the points up to a suspicious one. The value is chosen because Newton's method may
turn onto a crossing branch at a distance of some thousand tolerances, and can't meet a smaller
tolerance there.
"""

Plane = tuple[np.ndarray, np.ndarray]
"""Plane across a branch: one of its points and its normal, in the coordinates of arc length."""
PointRequests = Generator[tuple[Unknowns, float], NewtonStep, Any]
"""Generator that yields (z, p) and receives the `NewtonStep` there."""


def run_together(
    problem: AbstractContinuationProblem,
    args: Any,
    owners: Sequence[int] | np.ndarray,
    tasks: Sequence[PointRequests],
) -> list[Any]:
    """Return the results of generators, whose requests are linearized in common batches.

    - `owners`: for each task, the index of its inputs on the leading axis of `args`.
    """
    results: list[Any] = [None] * len(tasks)
    requests: dict[int, tuple[Unknowns, float]] = {}

    def advance(index: int, newton_step: NewtonStep | None) -> None:
        try:
            requests[index] = tasks[index].send(newton_step)  # type: ignore[arg-type]
        except StopIteration as stop:
            results[index] = stop.value
            requests.pop(index, None)

    with np.errstate(all="ignore"):  # A trial that is not finite fails alone.
        for index in range(len(tasks)):
            advance(index, None)
        n_iterations = 0
        while requests:
            n_iterations += 1
            report_progress(f"{n_iterations:,} Newton iterations along {len(tasks)} curves")
            indices = list(requests)
            z, p = (np.stack(values) for values in zip(*requests.values(), strict=True))
            newton_steps = jax.tree.map(
                np.asarray,
                problem.linearize(select_tree_rows(args, np.asarray(owners)[indices]), z, p),
            )
            for row, index in enumerate(indices):
                advance(index, NewtonStep(*(values[row] for values in newton_steps)))
    return results


@dataclasses.dataclass(frozen=True)
class ArclengthDriver:
    """Driver of the continuation of one problem, within the bounds of its parameter."""

    problem: AbstractContinuationProblem
    options: ArclengthOptions
    parameter_bounds: np.ndarray

    @property
    def parameter_range(self) -> float:
        """Return the difference between the bounds."""
        return self.parameter_bounds[1] - self.parameter_bounds[0]

    def with_tolerance(self, tolerance: float) -> Any:
        """Return the driver with another tolerance."""
        options = dataclasses.replace(self.options, tolerance=tolerance)
        return dataclasses.replace(self, options=options)

    def compute_fraction(self, p: Any) -> Any:
        """Return the parameter as a fraction of its range."""
        return (p - self.parameter_bounds[0]) / self.parameter_range

    def compute_parameter(self, fraction: float) -> float:
        """Return the parameter at a fraction of its range; 0 and 1 return the exact bounds."""
        lower_bound, upper_bound = self.parameter_bounds
        return float(
            upper_bound if fraction == 1.0 else lower_bound + self.parameter_range * fraction
        )

    def coordinates(self, z: Unknowns, fraction: Any) -> np.ndarray:
        """Return the coordinates in which arc length is measured."""
        return np.append(self.problem.section_state(z), fraction)

    def correct(
        self,
        z: Unknowns,
        fraction: float,
        plane: Plane,
        max_distance: float = np.inf,
        n_converged_iterations: int = 1,
    ) -> PointRequests:
        """Find the point at which a branch crosses a plane, by Newton's method from (z, fraction).

        Two converged iterations return a Jacobian as accurate as the point. A negligible correction
        counts as all of them. The search fails farther than `max_distance` from the plane's point.
        """
        (plane_point, normal), n_converged, n_iterations = plane, 0, 0
        fraction_tangent, jacobian = np.zeros_like(z), np.zeros(0)
        while n_iterations < self.options.max_newton_iterations:
            n_iterations += 1
            newton_step = yield z, self.compute_parameter(fraction)
            jacobian = np.asarray(newton_step.return_map_jacobian)
            fraction_tangent = self.parameter_range * np.asarray(newton_step.branch_tangent)
            distance = normal @ (
                self.coordinates(z + newton_step.newton_correction, fraction) - plane_point
            )
            fraction_change = -distance / (normal @ self.coordinates(fraction_tangent, 1.0))
            dz = newton_step.newton_correction + fraction_change * fraction_tangent
            correction_norm = max(self.problem.correction_norm(z, dz), abs(fraction_change))
            if not np.isfinite(correction_norm):
                n_converged = 0
                break
            z, fraction = z + dz, fraction + fraction_change
            if np.max(np.abs(self.coordinates(z, fraction) - plane_point)) > max_distance:
                n_converged = 0
                break
            is_negligible = (
                correction_norm < self.options.jacobian_reuse_fraction * self.options.tolerance
            )
            n_converged += n_converged_iterations if is_negligible else 1
            if correction_norm >= self.options.tolerance:
                n_converged = 0
            if n_converged >= n_converged_iterations:
                break
        return Correction(z, fraction, fraction_tangent, jacobian, n_converged > 0, n_iterations)

    def solve_on_plane(
        self, args: Any, z: Unknowns, fraction: float, plane: Plane
    ) -> Generator[tuple, NewtonStep, tuple[ContinuationPoint, bool]]:
        """Return the point at which a branch crosses a plane, and whether it was found.

        The rates of the point follow the direction of the plane's normal.
        """
        correction = yield from self.correct(z, fraction, plane, n_converged_iterations=2)
        point = self.make_point(args, correction, plane[1])
        return point, correction.has_converged

    def make_point(
        self, args: Any, correction: Correction, direction: np.ndarray, fraction: Any = None
    ) -> ContinuationPoint:
        """Return a corrected point with its rates in the direction of a vector."""
        tangent = self.coordinates(correction.fraction_tangent, 1.0)
        fraction_rate = np.copysign(1.0, direction @ tangent) / np.linalg.norm(tangent)
        p = self.compute_parameter(correction.fraction if fraction is None else fraction)
        return ContinuationPoint(
            correction.z,
            p,
            fraction_rate * correction.fraction_tangent,
            fraction_rate,
            correction.return_map_jacobian,
            self.problem.is_admissible(args, correction.z, p),
        )

    def predict(
        self,
        previous: ContinuationPoint,
        current: ContinuationPoint,
        ds: float,
        takes_other_plane: bool = False,
    ) -> tuple[Unknowns, float, Plane, float, bool]:
        """Predict the point one continuation step ahead, or at a nearer end of the range.

        Return its unknowns and fraction, the plane on which they are corrected, the predicted arc
        length to the end of the range, and whether the plane is that end. The plane is normal to
        the branch if the end is farther than `ds`; `takes_other_plane` selects the opposite plane.
        The prediction is the cubic polynomial through the last two points and their tangents, whose
        error is two orders smaller than that of the tangent. This saves one of three Newton
        iterations.
        """
        fraction, fraction_rate = self.compute_fraction(current.p), current.fraction_rate
        range_end = 1.0 if fraction_rate > 0.0 else 0.0
        length_to_end = (range_end - fraction) / fraction_rate if fraction_rate else np.inf
        is_range_end = bool(length_to_end <= ds) != takes_other_plane
        length = length_to_end if is_range_end else ds
        state, rate = (
            np.append(current.z, fraction),
            np.append(current.arclength_tangent, fraction_rate),
        )
        tangent = self.coordinates(current.arclength_tangent, fraction_rate)
        target = self.coordinates(current.z, fraction) + length * tangent
        previous_state = np.append(previous.z, self.compute_fraction(previous.p))
        chord_length = np.linalg.norm(
            self.coordinates(current.z, fraction) - self.coordinates(previous.z, previous_state[-1])
        )
        prediction = state + length * rate
        # Beyond a kink, and at the start, there is no previous point.
        if chord_length > 1e-9 * ds and self.problem.is_smooth_between(previous.z, current.z):
            previous_rate = np.append(previous.arclength_tangent, previous.fraction_rate)
            mean_rate = (state - previous_state) / chord_length
            prediction += length**2 * (
                (rate - mean_rate) / chord_length
                + (length + chord_length)
                * (previous_rate + rate - 2.0 * mean_rate)
                / chord_length**2
            )
        if is_range_end:
            prediction[-1] = target[-1] = range_end
            tangent = self.coordinates(0.0 * current.z, 1.0)
        return prediction[:-1], prediction[-1], (target, tangent), length_to_end, is_range_end

    def is_closed_by(self, points: list[ContinuationPoint]) -> bool:
        """Return whether the start of a branch lies on the segment up to its last point."""
        start, current, following = (
            self.coordinates(points[i].z, self.compute_fraction(points[i].p)) for i in (0, -2, -1)
        )
        chord, offset = following - current, start - current
        position = offset @ chord / max(chord @ chord, np.finfo(float).tiny)
        offset = offset - position * chord
        return bool(0.0 <= position <= 1.0 and offset @ offset < 0.01 * (chord @ chord))

    def find_end_status(
        self, points: list[ContinuationPoint], is_at_end: bool
    ) -> ContinuationStatus | None:
        """Return why a branch ends at its last point, or None if it continues."""
        has_ended = {
            ContinuationStatus.CURVE_CLOSED: len(points) > 3 and self.is_closed_by(points),
            ContinuationStatus.POINT_NOT_ADMISSIBLE: not points[-1].is_admissible,
            ContinuationStatus.RANGE_END_REACHED: is_at_end,
            ContinuationStatus.MAX_POINTS_REACHED: len(points) >= self.options.max_points,
        }
        return next(filter(has_ended.get, has_ended), None)

    def trace(self, args: Any, z: Unknowns, p: float, direction_sign: float) -> PointRequests:
        """Continue a branch from the point near (z, p), and return its `Track`.

        The sign 1 increases the parameter at first. A branch ends at the end of the parameter's
        range, or at its first point that is not admissible. That point is included. A closed branch
        ends with its start. A step is lengthened after few Newton iterations, shortened after many,
        and halved after a failure.
        """
        options, fraction = self.options, self.compute_fraction(p)
        along_parameter = self.coordinates(0.0 * z, 1.0)
        correction = yield from self.correct(
            z, fraction, (self.coordinates(z, fraction), along_parameter)
        )
        if self.problem.may_start_vertical and not correction.has_converged:
            start_plane = self.coordinates(z, fraction), np.eye(len(along_parameter))[0]
            correction = yield from self.correct(z, fraction, start_plane, options.initial_ds)
            fraction = correction.fraction
        if not correction.has_converged:
            return Track([], ContinuationStatus.START_NOT_FOUND)
        points = [self.make_point(args, correction, direction_sign * along_parameter, fraction)]
        previous, ds, is_range_end, takes_other_plane = points[0], options.initial_ds, False, False
        # A suspicious step may have reached another branch; shorter steps then avoid the jump. If
        # they stall within its length, as at a crossing, its point is accepted.
        suspicious_step, length_to_suspicious, is_point_new = None, 0.0, True
        crossing_driver = self.with_tolerance(SUSPICIOUS_STEP_TOLERANCE)
        while True:
            trial_z, trial_fraction, plane, length_to_end, is_next_range_end = self.predict(
                previous, points[-1], ds, takes_other_plane
            )
            is_at_end = is_range_end or bool(length_to_end <= MAX_RANGE_EXCESS)
            if is_point_new and (status := self.find_end_status(points, is_at_end)) is not None:
                if status == ContinuationStatus.CURVE_CLOSED:
                    points[-1] = points[0]
                return Track(points, status)
            if ds < options.min_ds:
                if suspicious_step is None:
                    return Track(points, ContinuationStatus.STEP_SIZE_UNDERFLOW)
                previous, ds, is_range_end = suspicious_step
                points.append(previous)
                suspicious_step, takes_other_plane, is_point_new = None, False, True
                continue
            is_range_end = is_next_range_end
            driver = self if suspicious_step is None else crossing_driver
            correction = yield from driver.correct(trial_z, trial_fraction, plane, ds)
            current = points[-1]
            tangent = self.coordinates(current.arclength_tangent, current.fraction_rate)
            new_tangent = self.coordinates(correction.fraction_tangent, 1.0)
            min_projection = np.cos(options.max_turn_angle) * np.linalg.norm(new_tangent)
            is_kink = abs(tangent @ new_tangent) < min_projection
            is_within = abs(correction.fraction - 0.5) <= 0.5 + MAX_RANGE_EXCESS
            is_short = ds < options.kink_step_factor * options.min_ds
            # A branch that turns back at the end of the range only touches the plane there. A step
            # that ends before that plane by its tangent may pass it, because the branch curves.
            takes_other_plane = not takes_other_plane and (
                is_short and not correction.has_converged
                if is_range_end
                else correction.has_converged and not is_within and length_to_end <= 2.0 * ds
            )
            is_point_new = (correction.has_converged and is_within) and (
                not is_kink or (self.problem.has_kinks and is_short)
            )
            is_suspicious = False
            if is_point_new:
                point = self.make_point(
                    args, correction, tangent, trial_fraction if is_range_end else None
                )
                is_suspicious = bool(
                    self.problem.has_multipliers
                    and point.is_admissible
                    and not is_multiplier_change_explained(
                        current.return_map_jacobian,
                        point.return_map_jacobian,
                        bool(current.fraction_rate * point.fraction_rate < 0.0),
                    )
                )
            is_point_new &= not is_suspicious
            if is_suspicious and suspicious_step is None:
                suspicious_step, length_to_suspicious = (point, ds, is_range_end), ds
            if is_point_new:
                length_to_suspicious -= ds
                if length_to_suspicious <= 0.0:
                    suspicious_step = None
                # The cubic prediction must not cross a kink.
                previous, takes_other_plane = point if is_kink else current, False
                points.append(point)
                growth = 1.4 if correction.n_iterations < 5 else 1.0
                growth = 0.6 if correction.n_iterations > 6 else growth
                ds = min(ds * growth, options.max_ds)
            elif not takes_other_plane:
                ds *= 0.5
