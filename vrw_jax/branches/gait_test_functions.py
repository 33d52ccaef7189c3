"""Define test functions of collocated gaits in two parameters, whose roots are special points.

One call of machine code computes Newton's correction, the tangents, the quantities and the
derivatives of the quantities. Event-driven steps compute the margins that the collocation does not
determine.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from vrw_jax.base.options import StepOptions
from vrw_jax.base.types import Scalar
from vrw_jax.branches.arclength import SectionStateVector
from vrw_jax.branches.branch_points import SECOND_PEAK_RATE_NAME
from vrw_jax.branches.continuation import DOUBLE_SUPPORT_INDICATOR_NAMES, GaitContinuation
from vrw_jax.branches.continuation_problems import (
    BranchWheel,
    CollocationProblem,
    make_trial_linearizer,
    measure_gait_period,
)
from vrw_jax.branches.sign_changes import BIFURCATION_NAMES
from vrw_jax.branches.test_functions import (
    AbstractTestFunction,
    TestFunctionNewtonStep,
    compute_offset_bifurcation_margins,
)
from vrw_jax.gaits.collocation_search import CollocationSystem, compute_correction_norm
from vrw_jax.gaits.force_peaks import compute_force_peaks
from vrw_jax.gaits.margin_defaults import compute_takeoff_acceleration
from vrw_jax.gaits.phase_collocation import CollocationSolution
from vrw_jax.lanes.batching import unbatch
from vrw_jax.models.measures import MARGIN_MEASURES
from vrw_jax.models.viscoelastic import ViscoelasticWheel
from vrw_jax.wheel import transitions
from vrw_jax.wheel.params import (
    Symbols,
    stack_parameters,
)
from vrw_jax.wheel.phases import PhaseInstant, make_paper_phases

LINEAR_MARGIN_SUBSTITUTES: Mapping[str, str] = GaitContinuation.linear_margin_substitutes
"""Names of margins that vanish as a cube. Each margin is mapped to a quantity that vanishes
linearly at the same point.
"""

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
    return (
        "lambda_4_plus"
        if special_point_name == DLS_VANISHING_NAME
        else LINEAR_MARGIN_SUBSTITUTES.get(special_point_name, special_point_name)
    )


def find_test_quantity_group(quantity_name: str, n_legs: int) -> tuple[str, ...]:
    """Return the names of all quantities that are evaluated together with `quantity_name`."""
    leg_suffixes = [f"[{leg_number}]" for leg_number in range(3, n_legs + 1)]
    step_quantity_names = tuple(
        margin_name + leg_suffix
        for margin_name, margin_measure in MARGIN_MEASURES.items()
        for leg_suffix in (leg_suffixes if margin_measure.leg_dimension else [""])
        if margin_name not in CONTINUED_QUANTITIES
    )
    quantity_groups = (
        BIFURCATION_NAMES,
        CONTINUED_QUANTITIES,
        FORCE_QUANTITY_NAMES,
        step_quantity_names,
    )
    return next(
        quantity_group
        for quantity_group in quantity_groups
        if select_test_quantity(quantity_name, True) in quantity_group
    )


class TestFunctionWheel(NamedTuple):
    """Wheel on a curve of special points, and the index of the quantity that vanishes
    on the curve.
    """

    branch_wheel: BranchWheel
    quantity_index: Array


# Largest round-off of a duration that is zero on a whole curve, s.
MAX_DURATION_ROUNDOFF_S = 1e-9
# Finite difference of the section state and of the relative parameters, for derivatives of
# quantities that an event-driven step determines.
RELATIVE_DIFFERENCE_STEP = 1e-6


class GaitTestFunction(AbstractTestFunction):
    """Test function in two parameters, whose roots are special points of gaits found by
    collocation.

    Its value is one of the quantities in `quantity_names`, which are evaluated together.
    """

    collocation_system: CollocationSystem = eqx.field(static=True)
    parameter_names: tuple[str, str] = eqx.field(static=True)
    quantity_names: tuple[str, ...] = eqx.field(static=True)  # names of the quantities in one group
    model: ViscoelasticWheel
    step_options: StepOptions

    def linearize(
        self, wheel: TestFunctionWheel, z: CollocationSolution, p: Array
    ) -> TestFunctionNewtonStep:
        branch_wheel = wheel.branch_wheel
        parameter_indices = tuple(
            self.model.parameter_names.index(parameter_name)
            for parameter_name in self.parameter_names
        )
        linearize_trial = make_trial_linearizer(
            self.collocation_system,
            parameter_indices,
            QUANTITY_FUNCTION_BY_GROUP.get(self.quantity_names),
        )
        newton_correction, parameter_tangents, monodromy_matrix, *quantities_and_gradients = (
            linearize_trial(
                stack_parameters(self.with_parameters(branch_wheel, p).params),
                branch_wheel.is_phase_active,
                z,
            )
        )
        if quantities_and_gradients:
            quantity_values, parameter_gradients = quantities_and_gradients
            if self.quantity_names == BIFURCATION_NAMES:
                apply_margin_jacobian = lambda quantity_tangent: jax.jvp(
                    compute_offset_bifurcation_margins, (quantity_values,), (quantity_tangent,)
                )
                quantity_values, parameter_gradients = jax.vmap(
                    apply_margin_jacobian, out_axes=(None, 0)
                )(parameter_gradients)
            quantity_values, parameter_gradients = (
                quantity_values + parameter_gradients[0],
                parameter_gradients[1:],
            )
        else:
            quantity_values, parameter_gradients = self._differentiate_step_quantities(
                branch_wheel, z, p, newton_correction, parameter_tangents
            )
        return TestFunctionNewtonStep(
            newton_correction,
            parameter_tangents,
            monodromy_matrix,
            quantity_values[wheel.quantity_index],
            parameter_gradients[:, wheel.quantity_index],
        )

    def _differentiate_step_quantities(
        self,
        branch_wheel: BranchWheel,
        z: CollocationSolution,
        p: Array,
        newton_correction: CollocationSolution,
        parameter_tangents: CollocationSolution,
    ) -> tuple[Array, Array]:
        """Return the step's quantities at the corrected gait, and their derivatives.

        The derivatives are with respect to the two parameters. Newton's method requires only a few
        digits of the derivatives. Finite differences of gait steps are cheaper than automatic
        derivatives, and use the same machine code. Near a fold the tangents and the correction grow
        without bound and become parallel. The differences are therefore taken in the directions of
        an orthonormal basis of the tangents' plane. They start from the point of that plane that is
        nearest to the trial.
        """
        tangents_times_parameters = p[:, None] * self.section_state(parameter_tangents)
        orthonormal_tangent_basis, triangular_factor = jnp.linalg.qr(
            jnp.concatenate([tangents_times_parameters, jnp.eye(2, dtype=p.dtype)], 1).T
        )
        basis_coefficients = p[:, None] * jnp.linalg.inv(triangular_factor)
        correction_coordinates = orthonormal_tangent_basis[:-2].T @ self.section_state(
            newton_correction
        )

        def measure_gait_at_offset(basis_offset: Array) -> Array:
            parameter_change = basis_coefficients @ (basis_offset - correction_coordinates)
            displaced_solution = displace_solution(
                z, newton_correction, parameter_tangents, parameter_change
            )
            return self.measure_step_quantities(
                branch_wheel, displaced_solution, p + parameter_change
            )

        quantities_at_offsets = jax.vmap(measure_gait_at_offset)(
            RELATIVE_DIFFERENCE_STEP * jnp.eye(3, 2, -1, p.dtype)
        )
        quantity_gradients = (
            quantities_at_offsets[1:] - quantities_at_offsets[0]
        ) / RELATIVE_DIFFERENCE_STEP
        parameter_gradient = triangular_factor.T @ quantity_gradients / p[:, None]
        return quantities_at_offsets[
            0
        ] + correction_coordinates @ quantity_gradients, parameter_gradient

    def with_parameters(self, branch_wheel: BranchWheel, p: Array) -> BranchWheel:
        """Return the wheel with the two parameters replaced by the components of p."""
        params = branch_wheel.params
        for parameter_name, parameter_value in zip(self.parameter_names, p, strict=True):
            _, params = self.model.with_parameter(params, parameter_name, parameter_value)
        return branch_wheel._replace(params=params)

    @property
    def gait_problem(self) -> CollocationProblem:
        """Return the problem that continues the gaits in the first parameter."""
        return CollocationProblem(
            model=self.model,
            step_options=self.step_options,
            collocation_system=self.collocation_system,
            parameter_name=self.parameter_names[0],
            additional_quantity_function=_compute_continued_quantities,
        )

    def measure_step_quantities(
        self, branch_wheel: BranchWheel, z: CollocationSolution, p: Array
    ) -> Array:
        """Return the quantities of the gait that the collocation equations do not contain.

        They are either those of the gait's force, or those of an event-driven step that starts from
        the gait. Their order is that of `quantity_names`.
        """
        params = self.with_parameters(branch_wheel, p).params
        if self.quantity_names == FORCE_QUANTITY_NAMES:
            force_peaks = compute_force_peaks(self.collocation_system, stack_parameters(params), z)
            return jnp.stack([force_peaks[quantity_name] for quantity_name in FORCE_QUANTITY_NAMES])
        section_state = self.gait_problem.read_gait_state(
            branch_wheel._replace(params=params), z, p[0]
        )[0]
        gait_measures = measure_gait_period(self.model, params, section_state, self.step_options, 1)
        measures_and_legs = [
            (gait_measures[quantity_name.partition("[")[0]], quantity_name.partition("[")[2])
            for quantity_name in self.quantity_names
        ]
        return jnp.stack(
            [
                measure_value[int(leg_suffix[:-1]) - 3] if leg_suffix else measure_value
                for measure_value, leg_suffix in measures_and_legs
            ]
        )

    def section_state(self, z: CollocationSolution) -> SectionStateVector:
        return z.section_state

    def correction_norm(
        self, z: CollocationSolution, newton_correction: CollocationSolution
    ) -> Scalar:
        return unbatch(compute_correction_norm)(z, newton_correction)

    def is_admissible(self, wheel: TestFunctionWheel, z: CollocationSolution, p: Array) -> Array:
        are_durations_nonnegative = z.durations > -MAX_DURATION_ROUNDOFF_S
        return jnp.all(are_durations_nonnegative | (wheel.branch_wheel.is_phase_active < 0.5))


def displace_solution(
    z: CollocationSolution,
    newton_correction: CollocationSolution,
    parameter_tangents: CollocationSolution,
    parameter_change: Array,
) -> CollocationSolution:
    """Return a corrected solution, displaced along its tangents by a change of two parameters."""
    return jax.tree.map(
        lambda x, correction, tangents: (
            x + correction + parameter_change[0] * tangents[0] + parameter_change[1] * tangents[1]
        ),
        z,
        newton_correction,
        parameter_tangents,
    )


# Number of Newton iterations for a point of codimension two.
N_CODIM2_ITERATIONS = 8


@eqx.filter_jit
def locate_jump_onset(
    test_function: GaitTestFunction, branch_wheel: BranchWheel, z: CollocationSolution, p: Array
) -> tuple[Array, Array]:
    """Locate the two parameters at which `DLS_VANISHING_NAME` meets `lambda_4_plus`.

    Return the parameters and their last relative change. The search starts from a nearby gait and
    its parameters. If the duration of double support is zero, the equations of both curves are
    singular. The search therefore uses the equations for the gait without double support, which are
    regular. The rear foot's force and its rate must be zero.
    """
    branch_wheel = branch_wheel._replace(
        is_phase_active=branch_wheel.is_phase_active.at[0, 0].set(0.0)
    )
    z = z._replace(durations=z.durations.at[0, 0].set(0.0))
    quantity_indices = [
        jnp.asarray(CONTINUED_QUANTITIES.index(quantity_name))
        for quantity_name in ("lambda_4_plus", INITIAL_FORCE_FALL_NAME)
    ]

    def take_newton_step(solution_and_parameters: tuple, _: None) -> tuple[tuple, Array]:
        z, p = solution_and_parameters
        newton_steps = [
            test_function.linearize(TestFunctionWheel(branch_wheel, quantity_index), z, p)
            for quantity_index in quantity_indices
        ]
        parameter_change = -jnp.linalg.solve(
            jnp.stack([newton_step.parameter_gradient for newton_step in newton_steps]),
            jnp.stack([newton_step.test_function_value for newton_step in newton_steps]),
        )
        z = displace_solution(
            z,
            newton_steps[0].newton_correction,
            newton_steps[0].parameter_tangents,
            parameter_change,
        )
        return (z, p + parameter_change), parameter_change / p

    (_, p), relative_parameter_changes = lax.scan(
        take_newton_step,
        (z, p),
        None,
        length=N_CODIM2_ITERATIONS,
    )
    return p, jnp.max(jnp.abs(relative_parameter_changes[-1]))


def _stack_continued_quantities(
    collocation_system: CollocationSystem,
    parameters: Array,
    is_phase_active: Array,
    z: CollocationSolution,
) -> Array:
    """Return the values of `CONTINUED_QUANTITIES` for a collocated gait, in their order."""
    wheel_symbols = collocation_system.make_wheel(parameters).symbols()
    (phase_points,) = collocation_system.evaluate_phase_points(parameters, z)
    return jnp.stack(list(_compute_continued_quantities(wheel_symbols, phase_points, z).values()))


def _compute_continued_quantities(
    wheel_symbols: Symbols, phase_points: Any, z: CollocationSolution
) -> dict[str, Array]:
    """Return the `CONTINUED_QUANTITIES` of a gait step by name, computed from the points of its
    phases.
    """
    (dls_start, _, dls_end), sls1_phase_points, (_, _, sls2_end) = phase_points
    landing_result = transitions.resolve_landing(wheel_symbols, sls2_end.q[0], *sls2_end.v)
    fore_force, rear_force = transitions.compute_landing_forces(wheel_symbols, landing_result)
    takeoff_acceleration = compute_takeoff_acceleration(wheel_symbols, sls1_phase_points)
    dls_duration, *single_support_durations = z.durations[0]
    dls_phase, *_ = make_paper_phases(
        wheel_symbols, dls_start.held_constants[0], stop_at_lift_off=False
    )

    def make_dls_instant(theta: Array, dtheta: Array) -> PhaseInstant:
        return PhaseInstant(dls_phase, dls_phase.compute_motion((theta,), (dtheta,)))

    compute_rear_force = lambda *dls_state: dls_phase.compute_end_guard(
        make_dls_instant(*dls_state)
    )
    start_state = *dls_start.q, *dls_start.v
    dls_state_rates = start_state[1], make_dls_instant(*start_state).acceleration.ddtheta
    initial_rear_force, rear_force_rate = jax.jvp(compute_rear_force, start_state, dls_state_rates)
    mean_decrease_rate = (
        initial_rear_force - compute_rear_force(*dls_end.q, *dls_end.v)
    ) / jnp.where(dls_duration == 0.0, 1.0, dls_duration)
    quantity_values = (
        landing_result.rear_impulse.normal,
        fore_force.normal,
        rear_force.normal,
        *single_support_durations,
        takeoff_acceleration,
        -rear_force_rate,
        mean_decrease_rate,
    )
    return dict(zip(CONTINUED_QUANTITIES, quantity_values, strict=True))


QUANTITY_FUNCTION_BY_GROUP = {
    CONTINUED_QUANTITIES: _stack_continued_quantities,
    BIFURCATION_NAMES: lambda collocation_system, parameters, is_phase_active, z: (
        collocation_system.linearize_at(parameters, z, is_phase_active).monodromy
    ),
}
"""Function that computes a group of quantities without an event-driven step, by the names in the
group.
"""
