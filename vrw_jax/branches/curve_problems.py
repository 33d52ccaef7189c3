"""Continue curves of special points in two parameters, as branches of an extended system.

The extended system has the second parameter as an additional unknown, and a test function of the
special point as an additional equation. One call of machine code computes Newton's correction, the
tangents, the quantities of a collocated gait and their derivatives. Event-driven steps compute the
margins that the collocation does not determine.
"""

import abc
import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from vrw_jax.base.results import Outcome
from vrw_jax.branches.arclength import (
    AbstractContinuationProblem,
    ContinuationPoint,
    NewtonStep,
    QuantitiesByName,
)
from vrw_jax.branches.branch import BIFURCATIONS, FOLD, TestFunction, evaluate_bifurcations
from vrw_jax.branches.continuation_problems import (
    DOUBLE_SUPPORT_INDICATOR_NAMES,
    LINEAR_MARGIN_SUBSTITUTES,
    SECOND_PEAK_RATE_NAME,
    BranchWheel,
)
from vrw_jax.gaits.gauss import CollocationSolution
from vrw_jax.gaits.phase_sequence import CollocationSystem, compute_takeoff_acceleration
from vrw_jax.models.measures import MARGIN_MEASURES
from vrw_jax.wheel import transitions
from vrw_jax.wheel.params import Symbols
from vrw_jax.wheel.phases import PhaseInstant, make_paper_phases


class TwoParameterStep(NamedTuple):
    """Newton steps at trial points in two parameters, and the test function there."""

    newton_correction: np.ndarray  # of z at fixed parameters, (points, unknowns)
    tangents: np.ndarray  # derivatives of z by both parameters, (points, 2, unknowns)
    return_map_jacobian: np.ndarray
    test_value: np.ndarray  # at the corrected z, (points,)
    test_gradient: np.ndarray  # total derivatives by both parameters, (points, 2)


# Finite difference of the section state and of the relative parameters, for derivatives of
# quantities that an event-driven step determines.
RELATIVE_DIFFERENCE_STEP = 1e-6


MIN_GRADIENT_RATIO = 1e-9
"""Smallest ratio of the derivatives of a test function by the second and by the first parameter.
The value is chosen because the round-off of finite differences is smaller.
"""


@dataclass(frozen=True, eq=False, kw_only=True)
class AbstractCurveProblem(AbstractContinuationProblem):
    """Continuation problem for the curve on which a test function of two parameters is zero.

    The curve is continued in the first parameter, and turns back like a branch at a fold. The
    unknowns begin with the second parameter as a fraction of its range, and then those of the fixed
    point. The curve ends when this fraction leaves [0, 1].

    - `first_range`: range of the first parameter, in which it is measured, or None for its value.
    """

    second_bounds: tuple[float, float]
    first_range: float | None = None

    has_multipliers: ClassVar[bool] = False
    may_start_vertical: ClassVar[bool] = True

    @abc.abstractmethod
    def linearize_in_two_parameters(
        self, args: Any, z: np.ndarray, p: np.ndarray
    ) -> TwoParameterStep:
        """Return the Newton steps at fixed points z and parameters p, shape (points, 2)."""

    def compute_second_parameter(self, y: np.ndarray) -> np.ndarray:
        """Return the second parameter at points of the curve."""
        lower_bound, upper_bound = self.second_bounds
        return lower_bound + (upper_bound - lower_bound) * y[..., 0]

    def linearize(self, args: Any, y: np.ndarray, p: np.ndarray) -> NewtonStep:
        step = self.linearize_in_two_parameters(
            args, y[:, 1:], np.stack([p, self.compute_second_parameter(y)], 1)
        )
        parameter_range = self.second_bounds[1] - self.second_bounds[0]
        # Where the curve is parallel to the second parameter, its tangent would be infinite, and
        # round-off would turn the curve.
        by_fraction = parameter_range * step.test_gradient[:, 1:]
        unit = np.abs(p[:, None]) if self.first_range is None else self.first_range
        least = MIN_GRADIENT_RATIO * unit * step.test_gradient[:, :1]
        by_fraction = np.where(np.abs(by_fraction) < np.abs(least), least, by_fraction)
        changes = (
            (-step.test_value[:, None] / by_fraction, step.newton_correction),
            (-step.test_gradient[:, :1] / by_fraction, step.tangents[:, 0]),
        )
        correction, tangent = (
            np.concatenate([fraction, z + parameter_range * fraction * step.tangents[:, 1]], 1)
            for fraction, z in changes
        )
        # The fraction adds a multiplier of zero, which has no effect.
        jacobian = np.pad(step.return_map_jacobian, ((0, 0), (0, 1), (0, 1)))
        return NewtonStep(correction, tangent, jacobian)

    def select_section_state(self, z: np.ndarray) -> np.ndarray:
        """Return the section state of gaits, with which their unknowns z begin."""
        return z

    def measure_quantities(self, args: Any, z: np.ndarray, p: np.ndarray) -> np.ndarray:
        """Return the quantities of gaits that `differentiate_quantities` differentiates.

        - `z`, `p`: unknowns of the gaits, and both parameters, shape (points, 2).
        """
        raise NotImplementedError

    def differentiate_quantities(
        self,
        args: Any,
        z: np.ndarray,
        p: np.ndarray,
        correction: np.ndarray,
        tangents: np.ndarray,
        parameter_units: np.ndarray,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return quantities at corrected gaits z, and their derivatives by both parameters.

        Newton's method requires only a few digits of the derivatives. Finite differences of gait
        steps are cheaper than automatic derivatives, and use the same machine code. Near a fold the
        tangents and the correction grow without bound and become parallel. The differences are
        therefore taken in the directions of an orthonormal basis of the tangents' plane. They start
        from the point of that plane that is nearest to the trial.

        - `parameter_units`: sizes of the parameters at each point, in which steps are measured.
        """
        section_state, n = self.select_section_state, len(p)
        units = parameter_units[:, :, None]
        scaled_tangents = np.concatenate(
            [units * section_state(tangents), np.broadcast_to(np.eye(2), (n, 2, 2))], 2
        )
        basis, factor = np.linalg.qr(np.swapaxes(scaled_tangents, 1, 2))
        coefficients = units * np.linalg.inv(factor)
        start = np.einsum("nki,nk->ni", basis[:, :-2], section_state(correction))
        offsets = RELATIVE_DIFFERENCE_STEP * np.eye(3, 2, -1)
        changes = np.einsum("nij,nkj->nki", coefficients, offsets - start[:, None])
        trials = z[:, None] + changes @ tangents
        repeated = jax.tree.map(lambda x: np.repeat(x, 3, 0), args)
        quantities = self.measure_quantities(
            repeated, trials.reshape(3 * n, -1), (p[:, None] + changes).reshape(3 * n, 2)
        ).reshape(n, 3, -1)
        rates = (quantities[:, 1:] - quantities[:, :1]) / RELATIVE_DIFFERENCE_STEP
        gradient = np.swapaxes(factor, 1, 2) @ rates / units
        return quantities[:, 0] + np.einsum("ni,niq->nq", start, rates), gradient

    def is_admissible(self, args: Any, y: np.ndarray, p: float) -> bool:
        return super().is_admissible(args, y, p) and bool(0.0 <= y[0] <= 1.0)


RANGE_EDGE = "edge of the box"
"""Name of the distance of the second parameter from its nearer bound, as a fraction of its range.
"""

FOLD_MARGIN_OFFSET = 1e-6
"""Value that the margin to the fold has on the curve by which the fold is represented.

The value is above zero, because the equations are singular at the fold. It is small, because the
error of the parameters is the square of the value.
"""

COMPLEX_STEP = 1e-30
"""Imaginary step of derivatives of polynomials, which have no round-off of differences."""


def stack_bifurcation_margins(jacobians: np.ndarray) -> np.ndarray:
    """Return the test functions of the bifurcations on the last axis, with that of the fold reduced
    by `FOLD_MARGIN_OFFSET`.
    """
    margins = evaluate_bifurcations(jacobians)
    return np.stack([*(margins | {FOLD: margins[FOLD] - FOLD_MARGIN_OFFSET}).values()], -1)


DISCONTINUOUS_QUANTITIES = (*DOUBLE_SUPPORT_INDICATOR_NAMES, "duration_sls1", "duration_sls2")
"""Names of the quantities that make the gait step discontinuous if they vanish. The measures of the
step are then undefined.
"""

DLS_VANISHING_NAME = "duration_dls"
"""Name of the special point at which the duration of double support vanishes.

At that point the rear foot's force is zero and decreases. Where `lambda_4_plus` vanishes, the force
is zero and increases, and the gait jumps.
"""

INITIAL_FORCE_FALL_NAME = "fall of the rear foot's force at first"
"""Name of the rate at which the rear foot's force first decreases, N/s.

The rate is positive on the curve of `DLS_VANISHING_NAME`. The curve ends where the rate is zero.
"""

MEAN_FORCE_FALL_NAME = "its mean fall in double support"
"""Name of the mean rate at which the rear foot's force decreases in double support, N/s.

The rate is zero on the curve of `lambda_4_plus`. It is not zero on the curve of
`DLS_VANISHING_NAME`, which otherwise satisfies the same equations.
"""

CONTINUED_QUANTITIES = (
    *DISCONTINUOUS_QUANTITIES,
    *LINEAR_MARGIN_SUBSTITUTES.values(),
    INITIAL_FORCE_FALL_NAME,
    MEAN_FORCE_FALL_NAME,
)
"""Names of quantities of the collocated gait that are defined on both sides of a special point."""


FORCE_QUANTITY_NAMES = (SECOND_PEAK_RATE_NAME,)
"""Names of quantities of the gait's force, whose extrema are located on its collocation."""


def select_test_quantity(special_point_name: str, has_double_support: bool) -> str:
    """Return the name of the quantity that vanishes at the named special point.

    The quantity depends on whether the gait has double support.
    """
    if special_point_name == "lambda_4_plus" and has_double_support:
        return MEAN_FORCE_FALL_NAME
    substitutes = {**LINEAR_MARGIN_SUBSTITUTES, DLS_VANISHING_NAME: "lambda_4_plus"}
    return substitutes.get(special_point_name, special_point_name)


def find_test_quantity_group(quantity_name: str, n_legs: int) -> tuple[str, ...]:
    """Return the names of all quantities that are evaluated together with `quantity_name`."""
    suffixes = [f"[{leg}]" for leg in range(3, n_legs + 1)]
    step_quantity_names = tuple(
        name + suffix
        for name, margin in MARGIN_MEASURES.items()
        for suffix in (suffixes if margin.leg_dimension else [""])
        if name not in CONTINUED_QUANTITIES
    )
    groups = tuple(BIFURCATIONS), CONTINUED_QUANTITIES, FORCE_QUANTITY_NAMES, step_quantity_names
    name = select_test_quantity(quantity_name, True)
    return next(group for group in groups if name in group)


class CurveWheel(NamedTuple):
    """Wheels on curves of special points, and the index of the quantity that vanishes on each."""

    branch_wheel: BranchWheel
    quantity_index: np.ndarray


@dataclass(frozen=True, eq=False, kw_only=True)
class GaitCurveProblem(AbstractCurveProblem):
    """Problem of the curves of special points of gaits.

    - `gaits`: problem of the gaits in both parameters;
    - `quantity_names`: names of the quantities in one group, which are evaluated together;
    - `special_point_names`: name of the special point on each curve.
    """

    gaits: Any
    quantity_names: tuple[str, ...]
    special_point_names: tuple[str, ...]

    @property
    def test_functions(self) -> Mapping[str, TestFunction]:  # type: ignore[override]
        return {**self.gaits.test_functions, RANGE_EDGE: TestFunction("lost", ends_branch=True)}

    def describe_branch_end(self, end_name: str, parameter_value: float) -> str:
        if end_name == RANGE_EDGE:
            return "The second parameter's range ended."
        return super().describe_branch_end(end_name, parameter_value)

    @property
    def location_unit(self) -> float | None:  # type: ignore[override]
        return self.gaits.location_unit

    def linearize_in_two_parameters(
        self, wheels: CurveWheel, z: np.ndarray, p: np.ndarray
    ) -> TwoParameterStep:
        (correction, tangents, jacobian), quantities = self.gaits.linearize_with_quantities(
            wheels.branch_wheel, z, p, QUANTITY_FUNCTION_BY_GROUP.get(self.quantity_names)
        )
        if quantities:
            values, rates = quantities  # The first rate is along the correction.
            if self.quantity_names == tuple(BIFURCATIONS):
                trials = values[:, None] + 1j * COMPLEX_STEP * rates
                rates = stack_bifurcation_margins(trials).imag / COMPLEX_STEP
                values = stack_bifurcation_margins(values)
            values, gradient = values + rates[:, 0], rates[:, 1:]
        else:
            units, second_range = p, self.second_bounds[1] - self.second_bounds[0]
            if self.first_range is not None:
                units = np.broadcast_to([self.first_range, second_range], p.shape)
            values, gradient = self.differentiate_quantities(
                wheels.branch_wheel, z + correction, p, correction, tangents, units
            )
        rows, index = np.arange(len(z)), wheels.quantity_index
        return TwoParameterStep(
            correction, tangents, jacobian, values[rows, index], gradient[rows, :, index]
        )

    def select_section_state(self, z: np.ndarray) -> np.ndarray:
        return self.gaits.section_state(z)

    def measure_quantities(self, wheels: BranchWheel, z: np.ndarray, p: np.ndarray) -> np.ndarray:
        """Return the quantities of gaits that the equations of the gaits do not contain.

        They are the bifurcations of a return map, the measures of the gait's force, or those of an
        event-driven step that starts from the gait. The last axis has the order of
        `quantity_names`.
        """
        gaits = self.gaits
        if self.quantity_names == tuple(BIFURCATIONS):
            return stack_bifurcation_margins(gaits.linearize(wheels, z, p).return_map_jacobian)
        if self.quantity_names == FORCE_QUANTITY_NAMES:
            gaits = dataclasses.replace(gaits, measures_force_peaks=True)
            measures = gaits.read_gaits(wheels, gaits.replace_parameters(wheels, p), z)[1]
        else:
            measures = gaits.measure(wheels, ContinuationPoint(z, p, z, p, z, p))
        return np.stack([measures[name] for name in self.quantity_names], -1)

    def measure(self, wheels: CurveWheel, points: ContinuationPoint) -> QuantitiesByName:
        """Return the quantities of the gaits, the second parameter, and its distance from its
        range's edge as a fraction of the range.
        """
        fraction, z = points.z[:, 0], points.z[:, 1:]
        p = np.stack([points.p, self.compute_second_parameter(points.z)], 1)
        quantities = self.gaits.measure(wheels.branch_wheel, points._replace(z=z, p=p))
        return quantities | {"second": p[:, 1], RANGE_EDGE: np.minimum(fraction, 1.0 - fraction)}

    def mask_undefined_quantities(
        self, quantities: QuantitiesByName, owners: np.ndarray
    ) -> QuantitiesByName:
        """Replace the quantity that is zero on the whole curve by NaN."""
        (name,) = self.special_point_names
        return quantities | {name: np.full(len(owners), np.nan)}

    def are_points_admissible(self, quantities: QuantitiesByName) -> np.ndarray:
        are_positive = [
            ~(values <= 0.0)
            for name, values in quantities.items()
            if (test := self.test_functions.get(name)) and test.ends_branch
        ]
        return np.all(are_positive, axis=0) & super().are_points_admissible(quantities)

    def make_point_reader(self, wheel: CurveWheel, point: ContinuationPoint) -> Callable:
        return lambda: point

    def section_state(self, y: np.ndarray) -> np.ndarray:
        return np.concatenate([y[..., :1], self.gaits.section_state(y[..., 1:])], -1)

    def correction_norm(self, y: np.ndarray, correction: np.ndarray) -> float:
        return max(abs(correction[0]), self.gaits.correction_norm(y[1:], correction[1:]))


# Largest round-off of a duration that is zero on a whole curve, s.
MAX_DURATION_ROUNDOFF_S = 1e-9


class CollocationCurveProblem(GaitCurveProblem):
    """Problem of the curves of special points of gaits that collocation finds."""

    linear_margin_substitutes: ClassVar[Mapping[str, str]] = LINEAR_MARGIN_SUBSTITUTES

    @property
    def test_functions(self) -> Mapping[str, TestFunction]:  # type: ignore[override]
        # The force begins to rise at the end of the curve.
        force_fall = TestFunction("lost", ends_branch=True)
        return {**super().test_functions, INITIAL_FORCE_FALL_NAME: force_fall}

    def measure(self, wheels: CurveWheel, points: ContinuationPoint) -> QuantitiesByName:
        quantities = super().measure(wheels, points)
        # Without double support, the rear foot's force must not be positive.
        rear_force_sign = np.where(wheels.branch_wheel.is_phase_active[:, 0, 0] > 0.5, 1.0, -1.0)
        return quantities | {"lambda_4_plus": rear_force_sign * quantities["lambda_4_plus"]}

    def mask_undefined_quantities(
        self, quantities: QuantitiesByName, owners: np.ndarray
    ) -> QuantitiesByName:
        """Replace each quantity that is zero or undefined on the whole curve by NaN."""
        special_point_names = np.array(self.special_point_names)[owners]
        is_dls_vanishing = special_point_names == DLS_VANISHING_NAME
        is_step_discontinuous = is_dls_vanishing | np.isin(
            special_point_names, DISCONTINUOUS_QUANTITIES
        )

        def is_undefined(name: str) -> np.ndarray:
            if name == INITIAL_FORCE_FALL_NAME:
                return ~is_dls_vanishing
            substituted = [x for x, y in LINEAR_MARGIN_SUBSTITUTES.items() if y == name]
            is_zero_on_curve = np.isin(special_point_names, [name, *substituted])
            if name == "lambda_4_plus":
                return is_zero_on_curve | is_dls_vanishing
            if name.partition("[")[0] in MARGIN_MEASURES and name not in CONTINUED_QUANTITIES:
                return is_zero_on_curve | is_step_discontinuous
            return is_zero_on_curve

        # A transposed array has its points on the last axis.
        masked = {
            name: np.where(is_undefined(name), np.nan, x.T).T for name, x in quantities.items()
        }
        return masked | {
            "outcome": np.where(is_step_discontinuous, Outcome.STEPPED, quantities["outcome"]),
            "closure": np.where(is_step_discontinuous, 0.0, quantities["closure"]),
        }

    def is_admissible(self, wheel: CurveWheel, y: np.ndarray, p: float) -> bool:
        durations = self.gaits.unpack(y[1:]).durations
        is_inactive = wheel.branch_wheel.is_phase_active < 0.5
        return super().is_admissible(wheel, y, p) and bool(
            np.all((durations > -MAX_DURATION_ROUNDOFF_S) | is_inactive)
        )


# Number of Newton iterations for a point of codimension two.
N_CODIM2_ITERATIONS = 8


def locate_jump_onset(
    problem: CollocationCurveProblem, wheels: BranchWheel, z: np.ndarray, p: np.ndarray
) -> tuple[np.ndarray, float]:
    """Locate the two parameters at which `DLS_VANISHING_NAME` meets `lambda_4_plus`.

    Return the parameters and their last relative change. The search starts from a nearby gait and
    its parameters. If the duration of double support is zero, the equations of both curves are
    singular. The search therefore uses the equations for the gait without double support, which are
    regular. The rear foot's force and its rate must be zero.
    """
    # One row for each of the two equations.
    solution = problem.gaits.unpack(np.repeat(z[None], 2, 0))
    solution.durations[:, 0, 0] = 0.0
    z = problem.gaits.pack(solution)
    values, is_phase_active = (np.repeat(np.asarray(x)[None], 2, 0) for x in wheels)
    is_phase_active[:, 0, 0] = 0.0
    names = ("lambda_4_plus", INITIAL_FORCE_FALL_NAME)
    curve_wheels = CurveWheel(
        BranchWheel(values, is_phase_active),
        np.array([CONTINUED_QUANTITIES.index(name) for name in names]),
    )
    relative_change = np.inf
    for _ in range(N_CODIM2_ITERATIONS):
        step = problem.linearize_in_two_parameters(curve_wheels, z, np.repeat(p[None], 2, 0))
        change = -np.linalg.solve(step.test_gradient, step.test_value)
        relative_change = float(np.max(np.abs(change / p)))
        z = z + step.newton_correction + np.einsum("i,niu->nu", change, step.tangents)
        p = p + change
    return p, relative_change


def _stack_continued_quantities(
    system: CollocationSystem, parameters: Array, _: Array, z: CollocationSolution
) -> Array:
    wheel_symbols = system.make_wheel(parameters).symbols()
    (phase_points,) = system.evaluate_phase_points(parameters, z)
    return jnp.stack([*compute_continued_quantities(wheel_symbols, phase_points, z).values()])


def compute_continued_quantities(
    wheel_symbols: Symbols, phase_points: Any, z: CollocationSolution
) -> dict[str, Array]:
    """Return the `CONTINUED_QUANTITIES` of a gait step by name, computed from the points of its
    phases.
    """
    s, ((start, _, end), sls1_points, (_, _, sls2_end)) = wheel_symbols, phase_points
    landing = transitions.resolve_landing(s, sls2_end.q[0], *sls2_end.v)
    fore_force, rear_force = transitions.compute_landing_forces(s, landing)
    dls_duration, *single_support_durations = z.durations[0]
    dls, *_ = make_paper_phases(s, start.held_constants[0], stop_at_lift_off=False)
    make_instant = lambda theta, dtheta: PhaseInstant(dls, dls.compute_motion((theta,), (dtheta,)))
    compute_rear_force = lambda *state: dls.compute_end_guard(make_instant(*state))
    start_state = *start.q, *start.v
    rates = start_state[1], make_instant(*start_state).acceleration.ddtheta
    first_force, force_rate = jax.jvp(compute_rear_force, start_state, rates)
    force_fall = first_force - compute_rear_force(*end.q, *end.v)
    quantities = (
        landing.rear_impulse.normal,
        fore_force.normal,
        rear_force.normal,
        *single_support_durations,
        compute_takeoff_acceleration(s, sls1_points),
        -force_rate,
        force_fall / jnp.where(dls_duration == 0.0, 1.0, dls_duration),
    )
    return dict(zip(CONTINUED_QUANTITIES, quantities, strict=True))


QUANTITY_FUNCTION_BY_GROUP = {
    CONTINUED_QUANTITIES: _stack_continued_quantities,
    tuple(BIFURCATIONS): lambda system, parameters, is_phase_active, z: (
        system.linearize_at(parameters, z, is_phase_active).monodromy
    ),
}
"""Function that computes a group of quantities without an event-driven step, by the names in the
group.
"""
