"""Test functions of collocated gaits over two parameters, whose zeros are special points.

Trial solution, tangents, quantities and their derivatives are computed by one call of machine code.
Margins that need an event-driven step are computed by steps.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from vrw_jax.branches.continuation import INDICATOR_NAMES, GaitContinuation
from vrw_jax.branches.continuation_problems import (
    BranchWheel,
    CollocationProblem,
    linearize_with_quantities,
    measure_gait,
)
from vrw_jax.collocation import CollocationSolution, PhasePoints
from vrw_jax.continuation import (
    BIFURCATION_NAMES,
    AbstractTestFunction,
    SectionVector,
    TestFunctionNewtonStep,
    offset_bifurcation_margins,
)
from vrw_jax.cycles import (
    CollocationState,
    CollocationSystem,
    compute_correction_norm,
    compute_takeoff_acceleration,
    init_search_flags,
)
from vrw_jax.measures import MARGIN_MEASURES
from vrw_jax.models import ViscoelasticWheel
from vrw_jax.numerics import Scalar, StepOptions, unbatch
from vrw_jax.wheel import (
    PARAMETER_NAMES,
    PhaseInstant,
    Symbols,
    make_phases,
    stack_parameters,
    transitions,
    wheel_from_parameters,
)

LINEAR_SUBSTITUTES: Mapping[str, str] = GaitContinuation.linear_substitutes
"""Names of margins that vanish as a cube, with the quantity that vanishes linearly at the same
point.
"""

DISCONTINUOUS_QUANTITIES = (*INDICATOR_NAMES, "duration_sls1", "duration_sls2")
"""Quantities at whose zeros the step is discontinuous, so that its measures are not defined."""

DLS_VANISHES = "duration_dls"
"""Name of the special point at which the duration of double support is zero. There the rear
foot's force is zero and falls. At the zero of `lambda_4_plus` the force is zero and rises, and the
step jumps.
"""

FORCE_FALL_NAME = "fall of the rear foot's force at first"
"""Name of a rate in N/s that is positive on the curve of `DLS_VANISHES`; the curve ends at the
rate's zero.
"""

MEAN_FORCE_FALL_NAME = "its mean fall in double support"
"""Name of a rate in N/s that is zero on the curve of `lambda_4_plus`. On the curve of
`DLS_VANISHES`, which otherwise satisfies the same equations, it is not zero.
"""

CONTINUED_QUANTITIES = (
    *DISCONTINUOUS_QUANTITIES,
    *LINEAR_SUBSTITUTES.values(),
    FORCE_FALL_NAME,
    MEAN_FORCE_FALL_NAME,
)
"""Quantities of the collocated gait itself, which are also defined beyond the special point."""


@dataclass(frozen=True)
class TestFunctionOptions:
    """Options of the test functions of gaits.

    - `n_codim2_iterations`: number of Newton iterations for a point of codimension two;
    - `duration_roundoff`: round-off of a duration that is zero along a whole curve, s;
    - `relative_difference`: finite difference of section state and relative parameters, for
      derivatives of the quantities of a step.
    """

    n_codim2_iterations: int = 8
    duration_roundoff: float = 1e-9
    relative_difference: float = 1e-6


def select_test_quantity(name: str, has_double_support: bool) -> str:
    """Return the name of the quantity whose zero is the special point, for gaits with or without
    double support.
    """
    if name == "lambda_4_plus" and has_double_support:
        return MEAN_FORCE_FALL_NAME
    return "lambda_4_plus" if name == DLS_VANISHES else LINEAR_SUBSTITUTES.get(name, name)


def find_quantity_group(name: str, n_legs: int) -> tuple[str, ...]:
    """Return the names of the quantities that are evaluated together with that of a special
    point.
    """
    leg_suffixes = [f"[{leg}]" for leg in range(3, n_legs + 1)]
    step_quantities = [
        name + leg
        for name, margin_name in MARGIN_MEASURES.items()
        for leg in (leg_suffixes if margin_name.dimension else [""])
    ]
    quantity_groups = (
        BIFURCATION_NAMES,
        CONTINUED_QUANTITIES,
        tuple(name for name in step_quantities if name not in CONTINUED_QUANTITIES),
    )
    return next(
        quantity_group
        for quantity_group in quantity_groups
        if select_test_quantity(name, True) in quantity_group
    )


class TestFunctionArgs(NamedTuple):
    """Wheel on a curve of special points, and the index of the quantity that vanishes there."""

    gait: BranchWheel
    quantity_index: Array


class GaitTestFunction(AbstractTestFunction):
    """One of `quantities` of collocated gaits as a test function over two parameters."""

    system: CollocationSystem = eqx.field(static=True)
    parameter_names: tuple[str, str] = eqx.field(static=True)
    quantities: tuple[str, ...] = eqx.field(static=True)  # names of the quantities of one group
    model: ViscoelasticWheel
    step_options: StepOptions
    options: TestFunctionOptions = eqx.field(static=True, default=TestFunctionOptions())

    def linearize(
        self, wheel: TestFunctionArgs, z: CollocationSolution, p: Array
    ) -> TestFunctionNewtonStep:
        gait = wheel.gait
        parameter_indices = tuple(PARAMETER_NAMES.index(name) for name in self.parameter_names)
        linearize = linearize_with_quantities(
            self.system, parameter_indices, QUANTITY_FUNCTIONS.get(self.quantities)
        )
        arguments = stack_parameters(self.with_parameters(gait, p).params), gait.phase_active, z
        correction, tangents, monodromy, *quantity_data = linearize(*arguments)
        first_tangent, second_tangent = (
            jax.tree.map(lambda x, i=i: x[i], tangents) for i in range(2)
        )
        if quantity_data:
            value, parameter_gradient = quantity_data
            if self.quantities == BIFURCATION_NAMES:
                apply_margin_jacobian = lambda d: jax.jvp(
                    offset_bifurcation_margins, (value,), (d,)
                )
                value, parameter_gradient = jax.vmap(apply_margin_jacobian, out_axes=(None, 0))(
                    parameter_gradient
                )
            value, parameter_gradient = value + parameter_gradient[0], parameter_gradient[1:]
        else:
            value, parameter_gradient = self._differentiate_steps(
                gait, z, p, correction, (first_tangent, second_tangent)
            )
        return TestFunctionNewtonStep(
            correction,
            (first_tangent, second_tangent),
            monodromy,
            value[wheel.quantity_index],
            parameter_gradient[:, wheel.quantity_index],
        )

    def _differentiate_steps(
        self,
        gait: BranchWheel,
        z: CollocationSolution,
        p: Array,
        correction: CollocationSolution,
        tangents: tuple,
    ) -> tuple[Array, Array]:
        """Return the step's quantities of the corrected gait, and their derivatives with respect to
        both parameters.

        Newton's method needs the derivatives to a few digits. Finite differences of steps cost less
        than derivatives of the step, and use the same machine code. Near a fold the tangents grow
        without bound and become parallel, and so do the corrections. The differences are therefore
        taken along an orthonormal basis, from the point of the tangents' plane that is nearest to
        the trial.
        """
        scaled_tangents = jnp.stack(
            [
                p[parameter_index] * self.section_state(tangent)
                for parameter_index, tangent in enumerate(tangents)
            ]
        )
        basis, triangular_factor = jnp.linalg.qr(
            jnp.concatenate([scaled_tangents, jnp.eye(2, dtype=p.dtype)], 1).T
        )
        basis_coefficients = p[:, None] * jnp.linalg.inv(triangular_factor)
        correction_coordinates = basis[:-2].T @ self.section_state(correction)

        def measure_at_offset(offset: Array) -> Array:
            parameter_change = basis_coefficients @ (offset - correction_coordinates)
            displace_entry = lambda x, correction_entry, first_tangent, second_tangent: (
                x
                + correction_entry
                + parameter_change[0] * first_tangent
                + parameter_change[1] * second_tangent
            )
            return self.measure_step(
                gait, jax.tree.map(displace_entry, z, correction, *tangents), p + parameter_change
            )

        difference = self.options.relative_difference
        quantities_at_offsets = jax.vmap(measure_at_offset)(difference * jnp.eye(3, 2, -1, p.dtype))
        quantity_gradients = (quantities_at_offsets[1:] - quantities_at_offsets[0]) / difference
        parameter_gradient = triangular_factor.T @ quantity_gradients / p[:, None]
        return quantities_at_offsets[
            0
        ] + correction_coordinates @ quantity_gradients, parameter_gradient

    def with_parameters(self, gait: BranchWheel, p: Array) -> BranchWheel:
        """Return the wheel with both parameters at p."""
        params = gait.params
        for name, value in zip(self.parameter_names, p, strict=True):
            params = self.model.with_parameter(params, name, value)[1]
        return gait._replace(params=params)

    @property
    def gait_problem(self) -> CollocationProblem:
        """Return the continuation problem of the gaits along the first parameter alone."""
        return CollocationProblem(
            system=self.system,
            parameter_name=self.parameter_names[0],
            additional_quantities=_compute_continued_quantities,
        )

    def measure_step(self, gait: BranchWheel, z: CollocationSolution, p: Array) -> Array:
        """Return the quantities of an event-driven step from the gait, in the order of
        `quantities`.
        """
        params = self.with_parameters(gait, p).params
        section_state = self.gait_problem.read_state(gait._replace(params=params), z, p[0])[0]
        measures = measure_gait(self.model, params, section_state, self.step_options, 1)
        measures_and_legs = [
            (measures[name.partition("[")[0]], name.partition("[")[2]) for name in self.quantities
        ]
        return jnp.stack(
            [measure[int(leg[:-1]) - 3] if leg else measure for measure, leg in measures_and_legs]
        )

    def section_state(self, z: CollocationSolution) -> SectionVector:
        return z.section_state

    def correction_norm(self, z: CollocationSolution, correction: CollocationSolution) -> Scalar:
        return unbatch(compute_correction_norm)(z, correction)

    def is_admissible(self, wheel: TestFunctionArgs, z: CollocationSolution, p: Array) -> Array:
        is_nonnegative = z.durations > -self.options.duration_roundoff
        return jnp.all(is_nonnegative | (wheel.gait.phase_active < 0.5))


@eqx.filter_jit
def locate_jump_onset(
    test_function: GaitTestFunction, gait: BranchWheel, z: CollocationSolution, p: Array
) -> tuple[Array, Array]:
    """Return the parameters at which `DLS_VANISHES` meets `lambda_4_plus`, and their last relative
    change.

    The search starts from a gait and parameters near that point. The equations of both curves are
    singular if double support has zero duration. The equations of the same gait without double
    support are regular, and the rear foot's force and its rate are both zero there.
    """
    gait = gait._replace(phase_active=gait.phase_active.at[0, 0].set(0.0))
    z = z._replace(durations=z.durations.at[0, 0].set(0.0))
    quantity_indices = [
        jnp.asarray(CONTINUED_QUANTITIES.index(name)) for name in ("lambda_4_plus", FORCE_FALL_NAME)
    ]

    def take_newton_step(solution_and_parameters: tuple, _: None) -> tuple[tuple, Array]:
        z, p = solution_and_parameters
        force, force_fall = (
            test_function.linearize(TestFunctionArgs(gait, index), z, p)
            for index in quantity_indices
        )
        gradients = jnp.stack([force.parameter_gradient, force_fall.parameter_gradient])
        parameter_change = -jnp.linalg.solve(gradients, jnp.stack([force.value, force_fall.value]))
        displace_entry = lambda x, correction_entry, first_tangent, second_tangent: (
            x
            + correction_entry
            + parameter_change[0] * first_tangent
            + parameter_change[1] * second_tangent
        )
        return (
            jax.tree.map(displace_entry, z, force.correction, *force.tangents),
            p + parameter_change,
        ), parameter_change / p

    (_, p), relative_changes = lax.scan(
        take_newton_step, (z, p), None, length=test_function.options.n_codim2_iterations
    )
    return p, jnp.max(jnp.abs(relative_changes[-1]))


def _continued_quantities(
    system: CollocationSystem, parameters: Array, phase_active: Array, z: CollocationSolution
) -> Array:
    """Return the `CONTINUED_QUANTITIES` of a collocated gait, in their order."""
    s = wheel_from_parameters(parameters, system.n_legs).symbols()
    (phase_points,) = system.evaluate_phase_points(parameters, z)[1]
    return jnp.stack(list(_compute_continued_quantities(s, phase_points, z).values()))


def _compute_continued_quantities(
    s: Symbols, phase_points: Any, z: CollocationSolution
) -> dict[str, Array]:
    """Return the `CONTINUED_QUANTITIES` of a step by name, from the points of its phases."""
    dls, sls1, sls2 = phase_points
    landing = transitions.land(s, sls2.end.q[0], *sls2.end.v)
    fore_force, rear_force = transitions.landing_forces(s, landing)
    dls_duration, *other_durations = z.durations[0]
    forces = landing.rear_impulse.normal, fore_force.normal, rear_force.normal
    values = (
        *forces,
        *other_durations,
        compute_takeoff_acceleration(s, sls1),
        *_force_decrease_rates(s, dls, dls_duration),
    )
    return dict(zip(CONTINUED_QUANTITIES, values, strict=True))


def _force_decrease_rates(s: Symbols, dls: PhasePoints, dls_duration: Array) -> tuple[Array, Array]:
    """Return the initial and the mean rate at which the rear foot's force decreases in DLS, N/s."""
    phase = make_phases(s, dls.start.held_constants[0], stop_at_lift_off=False)[0]

    def make_instant(theta: Array, dtheta: Array) -> PhaseInstant:
        return PhaseInstant(phase, phase.motion_at((theta,), (dtheta,)), None)

    rear_force = lambda *at: phase.end_guard(make_instant(*at))
    start_state, end_state = (*dls.start.q, *dls.start.v), (*dls.end.q, *dls.end.v)
    rates = start_state[1], make_instant(*start_state).acceleration.ddtheta
    first_force, force_rate = jax.jvp(rear_force, start_state, rates)
    mean_decrease_rate = (first_force - rear_force(*end_state)) / jnp.where(
        dls_duration == 0.0, 1.0, dls_duration
    )
    return -force_rate, mean_decrease_rate


def _trial_monodromy(
    system: CollocationSystem, parameters: Array, phase_active: Array, z: CollocationSolution
) -> Array:
    """Return the monodromy matrix of a trial solution."""
    collocation_state = CollocationState(
        z, phase_active, *init_search_flags(system, z.section_state)
    )
    return system.linearize_at(parameters, collocation_state).monodromy


QUANTITY_FUNCTIONS = {
    CONTINUED_QUANTITIES: _continued_quantities,
    BIFURCATION_NAMES: _trial_monodromy,
}
"""Functions that compute the quantities of a test function without an event-driven step, by
group.
"""
