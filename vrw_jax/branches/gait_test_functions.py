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

from vrw_jax.branches.continuation import (
    DOUBLE_SUPPORT_INDICATOR_NAMES,
    SECOND_PEAK_RATE_NAME,
    GaitContinuation,
)
from vrw_jax.branches.continuation_problems import (
    BranchWheel,
    CollocationProblem,
    make_trial_linearizer,
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
    compute_force_peaks,
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
    make_wheel_from_parameters,
    stack_parameters,
    transitions,
)

LINEAR_MARGIN_SUBSTITUTES: Mapping[str, str] = GaitContinuation.linear_margin_substitutes
"""Names of margins that vanish as a cube, each with the quantity that vanishes linearly at the same
point."""

DISCONTINUOUS_QUANTITIES = (*DOUBLE_SUPPORT_INDICATOR_NAMES, "duration_sls1", "duration_sls2")
"""Quantities at whose zeros the step is discontinuous, so that measures of the step are not
defined."""

DLS_VANISHING_NAME = "duration_dls"
"""Name of the special point at which the duration of double support is zero. At this point the rear
foot's force is zero and falls. At the zero of `lambda_4_plus` the force is zero and rises, and the
step jumps."""

INITIAL_FORCE_FALL_NAME = "fall of the rear foot's force at first"
"""Name of a rate in N/s that is positive on the curve of `DLS_VANISHING_NAME`. The curve ends at
the zero of the rate."""

MEAN_FORCE_FALL_NAME = "its mean fall in double support"
"""Name of a rate in N/s that is zero on the curve of `lambda_4_plus`. On the curve of
`DLS_VANISHING_NAME`, which otherwise satisfies the same equations, the rate is not zero."""

CONTINUED_QUANTITIES = (
    *DISCONTINUOUS_QUANTITIES,
    *LINEAR_MARGIN_SUBSTITUTES.values(),
    INITIAL_FORCE_FALL_NAME,
    MEAN_FORCE_FALL_NAME,
)
"""Quantities of the collocated gait itself, which are also defined beyond the special point."""


FORCE_QUANTITY_NAMES = (SECOND_PEAK_RATE_NAME,)
"""Quantities of the force in a gait, whose extrema are located on its collocation."""


@dataclass(frozen=True)
class TestFunctionOptions:
    """Options of the test functions of gaits.

    - `n_codim2_iterations`: number of Newton iterations for a point of codimension two;
    - `max_duration_roundoff`: round-off of a duration that is zero along a whole curve, s;
    - `relative_difference_step`: finite difference of section state and relative parameters, for
      derivatives of the quantities of a step.
    """

    n_codim2_iterations: int = 8
    max_duration_roundoff: float = 1e-9
    relative_difference_step: float = 1e-6


def select_test_quantity(name: str, has_double_support: bool) -> str:
    """Return the name of the quantity whose zero is the special point.

    The name depends on whether the gait has double support.
    """
    if name == "lambda_4_plus" and has_double_support:
        return MEAN_FORCE_FALL_NAME
    return (
        "lambda_4_plus" if name == DLS_VANISHING_NAME else LINEAR_MARGIN_SUBSTITUTES.get(name, name)
    )


def find_test_quantity_group(name: str, n_legs: int) -> tuple[str, ...]:
    """Return the names of the quantities that are evaluated together with that of a special
    point.
    """
    leg_suffixes = [f"[{leg}]" for leg in range(3, n_legs + 1)]
    step_quantities = [
        name + leg
        for name, margin_name in MARGIN_MEASURES.items()
        for leg in (leg_suffixes if margin_name.leg_dimension else [""])
    ]
    quantity_groups = (
        BIFURCATION_NAMES,
        CONTINUED_QUANTITIES,
        FORCE_QUANTITY_NAMES,
        tuple(name for name in step_quantities if name not in CONTINUED_QUANTITIES),
    )
    return next(
        quantity_group
        for quantity_group in quantity_groups
        if select_test_quantity(name, True) in quantity_group
    )


class TestFunctionWheel(NamedTuple):
    """Wheel on a curve of special points, and the index of the quantity that vanishes on it."""

    branch_wheel: BranchWheel
    quantity_index: Array


class GaitTestFunction(AbstractTestFunction):
    """Test function over two parameters: one of several quantities of collocated gaits."""

    system: CollocationSystem = eqx.field(static=True)
    parameter_names: tuple[str, str] = eqx.field(static=True)
    quantity_names: tuple[str, ...] = eqx.field(static=True)  # names of the quantities of one group
    model: ViscoelasticWheel
    step_options: StepOptions
    test_function_options: TestFunctionOptions = eqx.field(
        static=True, default=TestFunctionOptions()
    )

    def linearize(
        self, wheel: TestFunctionWheel, z: CollocationSolution, p: Array
    ) -> TestFunctionNewtonStep:
        branch_wheel = wheel.branch_wheel
        parameter_indices = tuple(PARAMETER_NAMES.index(name) for name in self.parameter_names)
        linearize_trial = make_trial_linearizer(
            self.system, parameter_indices, QUANTITY_FUNCTION_BY_GROUP.get(self.quantity_names)
        )
        trial_arguments = (
            stack_parameters(self.with_parameters(branch_wheel, p).params),
            branch_wheel.is_phase_active,
            z,
        )
        correction, tangents, monodromy, *quantity_data = linearize_trial(*trial_arguments)
        first_tangent, second_tangent = (
            jax.tree.map(lambda x, i=i: x[i], tangents) for i in range(2)
        )
        if quantity_data:
            quantity_values, parameter_gradients = quantity_data
            if self.quantity_names == BIFURCATION_NAMES:
                apply_margin_jacobian = lambda quantity_tangent: jax.jvp(
                    offset_bifurcation_margins, (quantity_values,), (quantity_tangent,)
                )
                quantity_values, parameter_gradients = jax.vmap(
                    apply_margin_jacobian, out_axes=(None, 0)
                )(parameter_gradients)
            quantity_values, parameter_gradients = (
                quantity_values + parameter_gradients[0],
                parameter_gradients[1:],
            )
        else:
            quantity_values, parameter_gradients = self._differentiate_steps(
                branch_wheel, z, p, correction, (first_tangent, second_tangent)
            )
        return TestFunctionNewtonStep(
            correction,
            (first_tangent, second_tangent),
            monodromy,
            quantity_values[wheel.quantity_index],
            parameter_gradients[:, wheel.quantity_index],
        )

    def _differentiate_steps(
        self,
        branch_wheel: BranchWheel,
        z: CollocationSolution,
        p: Array,
        correction: CollocationSolution,
        tangents: tuple,
    ) -> tuple[Array, Array]:
        """Return the step's quantities of the corrected gait, and their derivatives by both
        parameters.

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
        orthonormal_basis, triangular_factor = jnp.linalg.qr(
            jnp.concatenate([scaled_tangents, jnp.eye(2, dtype=p.dtype)], 1).T
        )
        basis_coefficients = p[:, None] * jnp.linalg.inv(triangular_factor)
        correction_coordinates = orthonormal_basis[:-2].T @ self.section_state(correction)

        def measure_at_offset(basis_offset: Array) -> Array:
            parameter_change = basis_coefficients @ (basis_offset - correction_coordinates)
            displace_leaf = lambda x, correction_leaf, first_tangent, second_tangent: (
                x
                + correction_leaf
                + parameter_change[0] * first_tangent
                + parameter_change[1] * second_tangent
            )
            return self.measure_step(
                branch_wheel,
                jax.tree.map(displace_leaf, z, correction, *tangents),
                p + parameter_change,
            )

        difference_step = self.test_function_options.relative_difference_step
        quantities_at_offsets = jax.vmap(measure_at_offset)(
            difference_step * jnp.eye(3, 2, -1, p.dtype)
        )
        quantity_gradients = (
            quantities_at_offsets[1:] - quantities_at_offsets[0]
        ) / difference_step
        parameter_gradient = triangular_factor.T @ quantity_gradients / p[:, None]
        return quantities_at_offsets[
            0
        ] + correction_coordinates @ quantity_gradients, parameter_gradient

    def with_parameters(self, branch_wheel: BranchWheel, p: Array) -> BranchWheel:
        """Return the wheel with both parameters at p."""
        params = branch_wheel.params
        for name, parameter_value in zip(self.parameter_names, p, strict=True):
            params = self.model.with_parameter(params, name, parameter_value)[1]
        return branch_wheel._replace(params=params)

    @property
    def gait_problem(self) -> CollocationProblem:
        """Return the continuation problem of the gaits along the first parameter alone."""
        return CollocationProblem(
            system=self.system,
            parameter_name=self.parameter_names[0],
            compute_additional_quantities=_compute_continued_quantities,
        )

    def measure_step(self, branch_wheel: BranchWheel, z: CollocationSolution, p: Array) -> Array:
        """Return the quantities of the gait's force or of an event-driven step from the gait, in
        the order of `quantity_names`.
        """
        params = self.with_parameters(branch_wheel, p).params
        if self.quantity_names == FORCE_QUANTITY_NAMES:
            force_peaks = compute_force_peaks(self.system, stack_parameters(params), z)
            return jnp.stack([force_peaks[name] for name in FORCE_QUANTITY_NAMES])
        section_state = self.gait_problem.read_gait_state(
            branch_wheel._replace(params=params), z, p[0]
        )[0]
        gait_measures = measure_gait(self.model, params, section_state, self.step_options, 1)
        measures_and_legs = [
            (gait_measures[name.partition("[")[0]], name.partition("[")[2])
            for name in self.quantity_names
        ]
        return jnp.stack(
            [
                measure_value[int(leg_suffix[:-1]) - 3] if leg_suffix else measure_value
                for measure_value, leg_suffix in measures_and_legs
            ]
        )

    def section_state(self, z: CollocationSolution) -> SectionVector:
        return z.section_state

    def correction_norm(self, z: CollocationSolution, correction: CollocationSolution) -> Scalar:
        return unbatch(compute_correction_norm)(z, correction)

    def is_admissible(self, wheel: TestFunctionWheel, z: CollocationSolution, p: Array) -> Array:
        is_nonnegative = z.durations > -self.test_function_options.max_duration_roundoff
        return jnp.all(is_nonnegative | (wheel.branch_wheel.is_phase_active < 0.5))


@eqx.filter_jit
def locate_jump_onset(
    test_function: GaitTestFunction, branch_wheel: BranchWheel, z: CollocationSolution, p: Array
) -> tuple[Array, Array]:
    """Return the parameters at which `DLS_VANISHING_NAME` meets `lambda_4_plus`.

    The second result is the last relative change of the parameters. The search starts from a gait
    and parameters near that point. The equations of both curves are singular if double support has
    zero duration. The equations of the same gait without double support are regular, and the rear
    foot's force and its rate are both zero.
    """
    branch_wheel = branch_wheel._replace(
        is_phase_active=branch_wheel.is_phase_active.at[0, 0].set(0.0)
    )
    z = z._replace(durations=z.durations.at[0, 0].set(0.0))
    quantity_indices = [
        jnp.asarray(CONTINUED_QUANTITIES.index(name))
        for name in ("lambda_4_plus", INITIAL_FORCE_FALL_NAME)
    ]

    def take_newton_step(solution_and_parameters: tuple, _: None) -> tuple[tuple, Array]:
        z, p = solution_and_parameters
        force_step, force_fall_step = (
            test_function.linearize(TestFunctionWheel(branch_wheel, quantity_index), z, p)
            for quantity_index in quantity_indices
        )
        quantity_gradients = jnp.stack(
            [force_step.parameter_gradient, force_fall_step.parameter_gradient]
        )
        parameter_change = -jnp.linalg.solve(
            quantity_gradients, jnp.stack([force_step.value, force_fall_step.value])
        )
        displace_leaf = lambda x, correction_leaf, first_tangent, second_tangent: (
            x
            + correction_leaf
            + parameter_change[0] * first_tangent
            + parameter_change[1] * second_tangent
        )
        return (
            jax.tree.map(displace_leaf, z, force_step.correction, *force_step.tangents),
            p + parameter_change,
        ), parameter_change / p

    (_, p), relative_changes = lax.scan(
        take_newton_step,
        (z, p),
        None,
        length=test_function.test_function_options.n_codim2_iterations,
    )
    return p, jnp.max(jnp.abs(relative_changes[-1]))


def _stack_continued_quantities(
    system: CollocationSystem, parameters: Array, is_phase_active: Array, z: CollocationSolution
) -> Array:
    """Return the `CONTINUED_QUANTITIES` of a collocated gait, in their order."""
    wheel_symbols = make_wheel_from_parameters(parameters, system.n_legs).symbols()
    (phase_points,) = system.evaluate_phase_points(parameters, z)[1]
    return jnp.stack(list(_compute_continued_quantities(wheel_symbols, phase_points, z).values()))


def _compute_continued_quantities(
    wheel_symbols: Symbols, phase_points: Any, z: CollocationSolution
) -> dict[str, Array]:
    """Return the `CONTINUED_QUANTITIES` of a step by name, from the points of its phases."""
    dls, sls1, sls2 = phase_points
    landing = transitions.resolve_landing(wheel_symbols, sls2.end.q[0], *sls2.end.v)
    fore_force, rear_force = transitions.compute_landing_forces(wheel_symbols, landing)
    dls_duration, *other_durations = z.durations[0]
    landing_forces = landing.rear_impulse.normal, fore_force.normal, rear_force.normal
    quantity_values = (
        *landing_forces,
        *other_durations,
        compute_takeoff_acceleration(wheel_symbols, sls1),
        *_compute_force_decrease_rates(wheel_symbols, dls, dls_duration),
    )
    return dict(zip(CONTINUED_QUANTITIES, quantity_values, strict=True))


def _compute_force_decrease_rates(
    s: Symbols, dls: PhasePoints, dls_duration: Array
) -> tuple[Array, Array]:
    """Return the initial and the mean rate at which the rear foot's force decreases in DLS, N/s."""
    dls_phase = make_phases(s, dls.start.held_constants[0], stop_at_lift_off=False)[0]

    def make_instant(theta: Array, dtheta: Array) -> PhaseInstant:
        return PhaseInstant(dls_phase, dls_phase.compute_motion((theta,), (dtheta,)), None)

    compute_rear_force = lambda *state: dls_phase.compute_end_guard(make_instant(*state))
    start_state, end_state = (*dls.start.q, *dls.start.v), (*dls.end.q, *dls.end.v)
    state_rates = start_state[1], make_instant(*start_state).acceleration.ddtheta
    first_force, force_rate = jax.jvp(compute_rear_force, start_state, state_rates)
    mean_decrease_rate = (first_force - compute_rear_force(*end_state)) / jnp.where(
        dls_duration == 0.0, 1.0, dls_duration
    )
    return -force_rate, mean_decrease_rate


def _compute_trial_monodromy(
    system: CollocationSystem, parameters: Array, is_phase_active: Array, z: CollocationSolution
) -> Array:
    """Return the monodromy matrix of a trial solution."""
    collocation_state = CollocationState(
        z, is_phase_active, *init_search_flags(system, z.section_state)
    )
    return system.linearize_at(parameters, collocation_state).monodromy


QUANTITY_FUNCTION_BY_GROUP = {
    CONTINUED_QUANTITIES: _stack_continued_quantities,
    BIFURCATION_NAMES: _compute_trial_monodromy,
}
"""Function that computes the quantities of a test function without an event-driven step, by the
group of quantities."""
