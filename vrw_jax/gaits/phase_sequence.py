"""Describe the phases of the paper's model for the collocation, and the system of a limit cycle.

`make_post_impact_sequence` uses the plane section (theta+, dtheta+) just after an impact that ends
with both feet on the ground. If double support is absent, the rear foot lifts immediately (case B3
of the paper). An impact at which the rear foot leaves the ground (case A3) is not in that plane.
The search therefore does not find such gaits.

`predict_gait` predicts the start of every search by cubic polynomials that were fitted to the gaits
of many wheels. Lengths are in units of L0, times in sqrt(L0 / g), and masses in the total mass. The
surface therefore covers wheels of any size. `experiments/gaits/fit_surface.py` fitted the surface
to gaits that a continuation from the wheel in Table 1 of the paper reaches. The fit uses the mass
ratio and the center of mass of that wheel, and eight legs. For such wheels the prediction is
accurate to about 1 %. For other wheels the parameters are clipped to the range of the fit, and the
prediction is the start of a homotopy.
"""

import functools
import importlib.resources
import itertools
import math
import operator
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from vrw_jax.base.elementwise import Elementwise, LaneArray, Vector, compute_sine_cosine
from vrw_jax.gaits.cycle import CycleOptions
from vrw_jax.gaits.gauss import (
    N_GAUSS_NODES,
    CollocationPhase,
    CollocationSolution,
    PhaseConstants,
    PhaseMesh,
    PhasePoint,
    PhasePoints,
    PhaseSequence,
    estimate_mesh_error,
    reconstruct_gait_step,
    transfer_accelerations,
)
from vrw_jax.gaits.phase_collocation import CycleLinearization, close_cycle, linearize_steps
from vrw_jax.wheel import dynamics, transitions
from vrw_jax.wheel.dynamics import Motion, rotate_to_rear_leg
from vrw_jax.wheel.laws import scale_laws
from vrw_jax.wheel.params import (
    NO_LAWS,
    PARAMETER_NAMES,
    Symbols,
    WheelLaws,
    WheelParams,
    compute_symbols,
    make_wheel_from_parameters,
)
from vrw_jax.wheel.phases import PAPER_PHASES, TRANSITION_ASSUMPTIONS, Assumption, PhaseInstant


def compute_takeoff_acceleration(s: Symbols, sls1_points: PhasePoints) -> Elementwise:
    """Return the acceleration of the rear foot at the start of SLS-I, m/s^2.

    See `dynamics.compute_takeoff_acceleration`.
    """
    return dynamics.compute_takeoff_acceleration(
        s, Motion.from_angle(*sls1_points.phase_start_point.q, *sls1_points.phase_start_point.v)
    )


N_SYMBOL_CONSTANTS = 12
"""Number of those fields of `Symbols` that vary between wheels.

The other fields follow from the number of legs.
"""


N_LAW_SCALES = 3
"""Number of the values after those of the laws: their share, and the units of length and time."""


def count_phase_constants(law_structure: Any) -> int:
    """Return the number of constants on flat ground."""
    if law_structure == NO_LAWS:
        return N_SYMBOL_CONSTANTS
    return N_SYMBOL_CONSTANTS + law_structure.num_leaves + N_LAW_SCALES


def compute_phase_constants(
    n_legs: int, law_structure: Any, *parameters: Elementwise
) -> PhaseConstants:
    """Return the combinations of parameters that occur in the formulas of all phases.

    The arguments are the parameters in the order of `stack_parameters`. In a search, the values of
    `scale_laws` follow those of the laws.
    """
    n_wheel_parameters = len(PARAMETER_NAMES)
    wheel_symbols: tuple[Any, ...] = compute_symbols(n_legs, *parameters[:n_wheel_parameters])
    constants = (*wheel_symbols[:N_SYMBOL_CONSTANTS], *parameters[n_wheel_parameters:])
    n_missing_scales = count_phase_constants(law_structure) - len(constants)
    return constants + (jnp.ones_like(parameters[0]),) * n_missing_scales


def exchange_legs(
    law_structure: Any, phase_constants: PhaseConstants, parity: Any
) -> PhaseConstants:
    """Return the constants of a later step of a wheel whose legs may alternate.

    - `parity`: 1 if the number of steps until then is odd, otherwise 0.
    """
    end = N_SYMBOL_CONSTANTS + law_structure.num_leaves
    laws = jax.tree.unflatten(law_structure, phase_constants[N_SYMBOL_CONSTANTS:end])
    law_values = jax.tree.leaves(laws.exchange_legs(parity))
    return (*phase_constants[:N_SYMBOL_CONSTANTS], *law_values, *phase_constants[end:])


def has_alternating_legs(law_structure: Any) -> bool:
    """Return whether the laws of the legs alternate from step to step."""
    if law_structure == NO_LAWS:
        return False
    return jax.tree.unflatten(law_structure, [0.0] * law_structure.num_leaves).leg_period == 2


def _restore_symbols(n_legs: int, law_structure: Any, phase_constants: PhaseConstants) -> Symbols:
    """Return all symbols of a wheel, computed from the symbols that vary between wheels."""
    laws = WheelLaws()
    if law_structure != NO_LAWS:
        n_constants = count_phase_constants(law_structure)
        law_constants = phase_constants[N_SYMBOL_CONSTANTS:n_constants]
        law_values, scales = law_constants[:-N_LAW_SCALES], law_constants[-N_LAW_SCALES:]
        laws = scale_laws(jax.tree.unflatten(law_structure, law_values), *scales)
    leg_angle = 2.0 * math.pi / n_legs
    symbol_values: tuple[Any, ...] = (
        *phase_constants[:N_SYMBOL_CONSTANTS],
        n_legs,
        math.sin(leg_angle),
        math.cos(leg_angle),
        leg_angle,
        laws.leg,
        laws.hub,
    )
    return Symbols(*symbol_values)


def _make_collocation_phase(
    n_legs: int, stop_at_lift_off: bool, law_structure: Any, phase_index: int
) -> CollocationPhase:
    """Describe the phase with index `phase_index` by functions.

    The functions take the constants that `compute_phase_constants` returns. A further constant may
    follow, the angle by which the next line of the ground is steeper, rad.
    """
    phase_class = PAPER_PHASES[phase_index]
    n_constants = count_phase_constants(law_structure)

    def make_instant(phase_constants: PhaseConstants, phase_point: PhasePoint) -> PhaseInstant:
        tilt = phase_constants[n_constants:]
        wheel_phase = phase_class(
            _restore_symbols(n_legs, law_structure, phase_constants),
            phase_point.held_constants,
            True,
            compute_sine_cosine(*tilt) if tilt else (),
        )
        return PhaseInstant(wheel_phase, wheel_phase.compute_motion(phase_point.q, phase_point.v))

    def evaluate_dynamics_residual(
        phase_constants: PhaseConstants, phase_point: PhasePoint, phase_acceleration: Vector
    ) -> Vector:
        instant = make_instant(phase_constants, phase_point)
        return instant.phase.compute_dynamics_residual(instant.motion, phase_acceleration)

    def evaluate_end_event(phase_constants: PhaseConstants, phase_point: PhasePoint) -> Elementwise:
        instant = make_instant(phase_constants, phase_point)
        return instant.phase.compute_end_guard(instant)

    def evaluate_phase_guards(phase_constants: PhaseConstants, phase_point: PhasePoint) -> Vector:
        instant = make_instant(phase_constants, phase_point)
        guard_values = instant.phase.compute_guards(instant)
        # Every guard keeps its index in ADMISSIBILITY_CHECKS, even if it is not checked.
        return (
            guard_values
            if stop_at_lift_off
            else (*guard_values[:-1], jnp.ones_like(guard_values[-1]))
        )

    def reset_to_next_phase(phase_constants: PhaseConstants, phase_point: PhasePoint) -> PhasePoint:
        instant = make_instant(phase_constants, phase_point)
        return PhasePoint(
            (),
            *PAPER_PHASES[phase_index + 1].select_phase_coordinates(
                phase_point.q[0], instant.phase.reset_motion(instant.motion)
            ),
        )

    def reset_to_section(phase_constants: PhaseConstants, phase_point: PhasePoint) -> PhasePoint:
        (theta, _), (dtheta, dL1) = phase_point.q, phase_point.v
        s = _restore_symbols(n_legs, law_structure, phase_constants)
        if tilt := phase_constants[n_constants:]:
            theta = theta - tilt[0]
        return PhasePoint((), transitions.resolve_two_foot_landing(s, theta, dtheta, dL1), ())

    reset_function = reset_to_section if phase_class is PAPER_PHASES[-1] else reset_to_next_phase
    return CollocationPhase(
        phase_class.phase_name,
        phase_class.n_dof,
        evaluate_dynamics_residual,
        evaluate_end_event,
        reset_function,
        evaluate_phase_guards,
        is_motion_smooth=not phase_class.has_stiff_start,
    )


ADMISSIBILITY_CHECKS: tuple[Assumption, ...] = (
    *(
        assumption
        for phase_class in PAPER_PHASES
        for assumption in (
            Assumption(f"{phase_class.phase_title} has no duration", "the duration", "T", "s"),
            *phase_class.list_assumptions(),
        )
    ),
    *TRANSITION_ASSUMPTIONS,
    Assumption("the mesh is too coarse", "the mesh", "", ""),
)
"""Assumptions about a gait, in the order in which they are checked.

The first checks concern the duration and the guards of each phase. Checks of the transitions
between phases and of the mesh follow.
"""


@functools.cache
def make_post_impact_sequence(
    n_legs: int, stop_at_lift_off: bool = True, law_structure: Any = NO_LAWS
) -> PhaseSequence:
    """Build the sequence DLS, SLS-I and SLS-II on the plane section (theta+, dtheta+) after the
    impact.
    """
    collocation_phases = tuple(
        _make_collocation_phase(n_legs, stop_at_lift_off, law_structure, phase_index)
        for phase_index in range(len(PAPER_PHASES))
    )

    def make_start_point(phase_constants: PhaseConstants, section_state: Vector) -> PhasePoint:
        s = _restore_symbols(n_legs, law_structure, phase_constants)
        sine, cosine = compute_sine_cosine(section_state[0])
        foot_distance = s.L0 * s.sin_alpha / rotate_to_rear_leg(s, sine, cosine).cos
        return PhasePoint((foot_distance,), section_state[:1], section_state[1:])

    def evaluate_transition_margins(
        phase_constants: PhaseConstants,
        phase_points: tuple[PhasePoints, ...],
        is_phase_active: Array,
    ) -> Vector:
        dls_points, sls1_points, sls2_points = phase_points
        lift_off_guard = collocation_phases[0].end_event_function(
            phase_constants, dls_points.phase_start_point
        )
        (theta, _), (dtheta, dL1) = sls2_points.phase_end_point.q, sls2_points.phase_end_point.v
        landing_result = transitions.resolve_landing(
            _restore_symbols(n_legs, law_structure, phase_constants), theta, dtheta, dL1
        )
        return (
            jnp.where(is_phase_active[0], lift_off_guard, -lift_off_guard),
            landing_result.rear_impulse.normal,
            sls1_points.phase_end_point.v[2],
        )

    return PhaseSequence(
        2,
        make_start_point,
        collocation_phases,
        evaluate_transition_margins,
        functools.partial(exchange_legs, law_structure)
        if has_alternating_legs(law_structure)
        else None,
    )


REAR_FORCE_CHECK_CODES = tuple(
    check_code
    for check_code, assumption in enumerate(ADMISSIBILITY_CHECKS, 1)
    if assumption.symbol.startswith("λ4")
)
EARLY_TOUCHDOWN_CHECK_CODE = 10
"""Values of `CollocationState.failed_check` that `CollocationSystem.is_beyond_border` reads."""

LaneParameters = Float[Array, "n_parameters lanes"]
"""Parameters of each wheel (lane) as floats, in the order of `stack_parameters`."""


def pad_with_zeros(array: Array, shape: tuple[int, ...]) -> Array:
    """Return an array of a larger shape, with zeros after the entries of each axis."""
    widths = [(0, m - n, 0) for m, n in zip(shape, array.shape, strict=True)]
    return lax.pad(array, jnp.zeros((), array.dtype), widths)


class CollocationSystem(NamedTuple):
    """Collocation system of a limit cycle: phases, number of gait steps, and meshes.

    Inside `jit`, where the mesh that a gait needs is unknown, each wheel may have one of two
    meshes. Arrays then have the size of the fine mesh. A solution on the mesh of `coarse_options`
    fills the first mesh intervals, and the others contain zeros.
    """

    n_legs: int
    period_n: int
    cycle_options: CycleOptions
    stop_at_lift_off: bool = True  # whether the normal force must be positive in an admissible gait
    law_structure: Any = NO_LAWS
    coarse_options: CycleOptions | None = None

    @property
    def coarse_system(self) -> "CollocationSystem":
        """Return the system on the coarse mesh, or this system if it has one mesh."""
        return self._replace(
            cycle_options=self.coarse_options or self.cycle_options, coarse_options=None
        )

    def select_coarse_state(self, state: "CollocationState") -> "CollocationState":
        """Return the state on the coarse mesh, of use for the wheels whose gaits are there."""
        accelerations = tuple(
            x[:, : mesh.n_intervals]
            for x, mesh in zip(
                state.solution.accelerations, self.coarse_system.phase_meshes, strict=True
            )
        )
        return state._replace(solution=state.solution._replace(accelerations=accelerations))

    def is_on_coarse_mesh(self, state: "CollocationState") -> Any:
        """Return for each wheel whether its solution is on the coarse mesh."""
        if self.coarse_options is None:
            return jnp.asarray(False)
        return jnp.all(state.solution.accelerations[1][:, -1] == 0.0, (0, 1, 2))

    def on_each_mesh(self, make_function: Callable) -> Callable:
        """Return `make_function(system)`, a function of parameters and a state of one wheel.

        With two meshes the result is that on the mesh of the wheel, padded with zeros to the size
        of the fine mesh.
        """
        if self.coarse_options is None:
            return make_function(self)
        fine_system = self._replace(coarse_options=None)
        on_coarse, on_fine = make_function(self.coarse_system), make_function(fine_system)

        def evaluate(parameters: Array, state: CollocationState, *arguments: Any) -> Any:
            is_coarse = self.is_on_coarse_mesh(state)
            mask = lambda state, flag: state._replace(
                has_cycle=jnp.where(flag, state.has_cycle, 0.0)
            )
            coarse_state = mask(self.select_coarse_state(state), is_coarse)
            coarse = on_coarse(parameters, coarse_state, *arguments)
            fine = on_fine(parameters, mask(state, ~is_coarse), *arguments)
            return jax.tree.map(
                lambda x, y: jnp.where(is_coarse, pad_with_zeros(x, y.shape), y), coarse, fine
            )

        return evaluate

    @property
    def phase_sequence(self) -> PhaseSequence:
        """Return the phases of one gait step and the functions that describe them."""
        return make_post_impact_sequence(self.n_legs, self.stop_at_lift_off, self.law_structure)

    @property
    def phase_meshes(self) -> tuple[PhaseMesh, ...]:
        """Return the meshes of the phases DLS, SLS-I and SLS-II."""
        n_dls_intervals, n_sls1_intervals, n_sls2_intervals = self.cycle_options.mesh_intervals
        return (
            PhaseMesh(n_dls_intervals, 1.0),
            PhaseMesh(n_sls1_intervals, self.cycle_options.mesh_grading),
            PhaseMesh(n_sls2_intervals, 1.0),
        )

    @property
    def phase_constants_function(self) -> Callable:
        """Return the function that maps the parameters to the constants of the
        equations of motion.
        """
        return functools.partial(compute_phase_constants, self.n_legs, self.law_structure)

    def complete_parameters(self, parameters: Array, *scales: Array) -> Array:
        """Return the parameters with the values that `scale_laws` takes after those of laws.

        The scales are those of the units of length and time, by default 1.
        """
        if self.law_structure == NO_LAWS:
            return parameters
        share = jnp.ones_like(parameters[0])
        return jnp.stack([*parameters, share, *(scales or (share, share))])

    def make_wheel(self, parameters: Array, step_index: Array | int = 0) -> WheelParams:
        """Return the wheel in a gait step, with the parameters on the first axis, in SI units."""
        params = make_wheel_from_parameters(
            parameters, self.n_legs, law_structure=self.law_structure
        )
        if params.laws is None:
            return params
        return params.attach_laws(params.laws.exchange_legs(step_index % 2))

    def is_beyond_border(self, failed_check: Any, has_dls: Any) -> Any:
        """Return for each wheel whether its root shows that it is just beyond the border of its
        gaits.

        The force on the rear foot then has the wrong sign, or the next foot meets the ground too
        early after double support. Neither a homotopy nor walks lead to a gait of such a wheel:
        none of 1,900 such wheels with 8 legs had one. With 6 or 16 legs, 9 of 600 had one, so
        that the result is false for all wheels with another number of legs than 8. It is false
        with a user's law of the legs too, for which no such numbers are known.

        - `failed_check`: `CollocationState.failed_check` of the root;
        - `has_dls`: whether the root has double support.
        """
        is_paper_wheel = self.n_legs == WheelParams().n_legs and self.law_structure == NO_LAWS
        return is_paper_wheel & (
            (failed_check == REAR_FORCE_CHECK_CODES[0])
            | (failed_check == REAR_FORCE_CHECK_CODES[1])
            | ((failed_check == EARLY_TOUCHDOWN_CHECK_CODE) & has_dls)
        )

    def linearize_at(
        self,
        parameters: LaneParameters,
        collocation_solution: CollocationSolution,
        is_phase_active: LaneArray,
        parameter_indices: tuple[int, ...] = (),
    ) -> CycleLinearization:
        """Linearize the collocation equations at a collocation solution.

        The result contains tangents with respect to the parameters in `parameter_indices`.
        """
        return close_cycle(
            parameters,
            collocation_solution.section_state,
            *linearize_steps(
                self, parameters, collocation_solution, is_phase_active, parameter_indices
            ),
        )

    def evaluate_phase_points(
        self, parameters: Array, collocation_solution: CollocationSolution
    ) -> list[tuple[PhasePoints, ...]]:
        """Return the points of all phases in each gait step.

        The arguments belong to one wheel, or to several wheels on the last axis.
        """
        phase_constants = self.phase_constants_function(*parameters)
        section_state = tuple(collocation_solution.section_state)
        phase_points_of_steps = []
        for step_index in range(self.period_n):
            section_state, phase_points = reconstruct_gait_step(
                self,
                self.phase_sequence.select_constants(phase_constants, (step_index % 2,)),
                section_state,
                collocation_solution.durations[step_index],
                tuple(x[step_index] for x in collocation_solution.accelerations),
            )
            phase_points_of_steps.append(phase_points)
        return phase_points_of_steps

    @functools.partial(jax.jit, static_argnums=0)
    def estimate_mesh_error(self, collocation_solution: CollocationSolution) -> Array:
        """Return the estimated mesh error of a solution for one wheel."""
        solution_with_lane = jax.tree.map(lambda x: x[..., None], collocation_solution)
        return estimate_mesh_error(self, solution_with_lane)[0]

    @functools.partial(jax.jit, static_argnums=0)
    def trace_checks(
        self, parameters: Array, collocation_solution: CollocationSolution, is_phase_active: Array
    ) -> list[Array]:
        """Return the quantity of each of the ADMISSIBILITY_CHECKS except that of the mesh, for the
        first gait step of one wheel.

        A guard has one value at the start of its phase, at each node and at the end.
        """
        phase_constants = self.phase_constants_function(*parameters)
        phase_points = self.evaluate_phase_points(parameters, collocation_solution)[0]
        quantities = []
        for phase, points, duration in zip(
            self.phase_sequence.phases, phase_points, collocation_solution.durations[0], strict=True
        ):
            guards_by_instant = zip(
                *(
                    phase.guards_function(phase_constants, point)
                    for point in (
                        points.phase_start_point, points.node_points, points.phase_end_point
                    )
                ),
                strict=True,
            )  # fmt: skip
            quantities += [duration, *(jnp.hstack(guards) for guards in guards_by_instant)]
        return quantities + list(
            self.phase_sequence.margins_function(
                phase_constants, phase_points, is_phase_active[0] > 0.5
            )
        )

    @functools.partial(jax.jit, static_argnums=0)
    def measure_takeoff_acceleration(
        self, parameters: Array, collocation_solution: CollocationSolution
    ) -> Array:
        """Return the lowest acceleration of the rear foot at take-off over the gait steps of one
        wheel, m/s^2.
        """
        points_by_step = self.evaluate_phase_points(parameters, collocation_solution)
        return jnp.min(
            jnp.stack(
                [
                    compute_takeoff_acceleration(self.make_wheel(parameters, k).symbols(), points)
                    for k, (_, points, _) in enumerate(points_by_step)
                ]
            )
        )


class CollocationState(NamedTuple):
    """Solution of the collocation system, its active phases, and the result of its admissibility
    checks.

    All fields are floats with the wheels (lanes) on the last axis.
    """

    solution: CollocationSolution
    is_phase_active: LaneArray  # (n, n_phases, lanes): 1 if the phase occurs, else 0
    # (lanes,): 1 for a limit cycle, 0 for a replacement of a missing cycle
    has_cycle: LaneArray
    # (lanes,): 1 + index in ADMISSIBILITY_CHECKS of the check that a root fails;
    # plus HOMOTOPY_FAILURE_CODE_OFFSET for a root of a wheel on the homotopy; a HomotopyFailure;
    # else 0
    failed_check: LaneArray
    # (n, 4, lanes): theta, L1 and their rates at the end of each step
    gait_step_end_states: LaneArray

    @classmethod
    def make_start(
        cls, collocation_solution: CollocationSolution, is_phase_active: LaneArray
    ) -> "CollocationState":
        """Return a start of the search, with zeros in the fields that the search computes."""
        zeros_of_lanes = jnp.zeros_like(collocation_solution.section_state[0])
        durations = collocation_solution.durations
        zero_end_states = jnp.zeros((len(durations), 4, *durations.shape[2:]), durations.dtype)
        return cls(
            collocation_solution, is_phase_active, zeros_of_lanes, zeros_of_lanes, zero_end_states
        )


GAIT_SURFACE_MESHES = (PhaseMesh(2, 1.0), PhaseMesh(4, 2.0), PhaseMesh(1, 1.0))
"""Meshes for the predicted accelerations in DLS, SLS-I and SLS-II."""
GAIT_SURFACE_DEGREE = 3
"""Degree of the polynomials whose coefficients are stored."""


@functools.cache
def load_gait_surface() -> dict[str, np.ndarray]:
    """Load the gait surface from the file `surface.npz` in this package.

    The arrays are the center, half range and limits of each coordinate, and the coefficients of
    the polynomials of the centered coordinates, of shape (monomials, unknowns).
    """
    surface_file = importlib.resources.files(__package__) / "surface.npz"
    with surface_file.open("rb") as surface_stream, np.load(surface_stream) as stored_arrays:
        return dict(stored_arrays)


def compute_time_unit(params: WheelParams) -> Elementwise:
    """Return the unit of time for a wheel, sqrt(L0 / g), s."""
    return jnp.sqrt(params.locked_length / params.gravity)


def compute_surface_coordinates(params: WheelParams) -> tuple[Elementwise, ...]:
    """Return the four dimensionless coordinates of a wheel on the gait surface.

    They are the square root of the damping, the stiffness, the natural length and the slope.
    """
    total_mass = params.hub_mass + params.n_legs * params.leg_mass
    return (
        jnp.sqrt(params.damping * compute_time_unit(params) / total_mass),
        params.stiffness * params.locked_length / (total_mass * params.gravity),
        params.natural_length / params.locked_length,
        params.slope,
    )


def evaluate_monomials(centered_surface_coordinates: tuple[Elementwise, ...]) -> list[Elementwise]:
    """Return all monomials of the coordinates up to the degree of the surface.

    The constant monomial is the first.
    """
    constant_monomial = jnp.ones_like(centered_surface_coordinates[0])
    return [
        functools.reduce(operator.mul, monomial_factors, constant_monomial)
        for monomial_degree in range(GAIT_SURFACE_DEGREE + 1)
        for monomial_factors in itertools.combinations_with_replacement(
            centered_surface_coordinates, monomial_degree
        )
    ]


def predict_gait(params: WheelParams, phase_meshes: tuple[PhaseMesh, ...]) -> CollocationSolution:
    """Predict the section state, the durations and the accelerations for the gait of each wheel.

    The accelerations belong to the nodes of `phase_meshes`. The wheels are on the last axis.
    """
    gait_surface = load_gait_surface()
    # Python floats do not change the dtype of the parameters.
    coordinate_ranges = (
        gait_surface[name].tolist() for name in ("centre", "spread", "lower", "upper")
    )
    centered_surface_coordinates = tuple(
        (jnp.clip(surface_coordinate, lower_bound, upper_bound) - coordinate_center) / half_range
        for surface_coordinate, coordinate_center, half_range, lower_bound, upper_bound in zip(
            compute_surface_coordinates(params), *coordinate_ranges, strict=True
        )
    )
    monomials = jnp.stack(evaluate_monomials(centered_surface_coordinates))
    predicted_surface_values = jnp.tensordot(
        jnp.asarray(gait_surface["coefficients"].T, monomials.dtype), monomials, 1
    )
    time_unit = compute_time_unit(params)
    section_state = jnp.stack(
        [predicted_surface_values[0], predicted_surface_values[1] / time_unit]
    )
    phase_durations = predicted_surface_values[None, 2:5] * time_unit
    # The coordinates are (theta, L1, L2).
    coordinate_units = jnp.stack(
        [jnp.ones_like(time_unit), params.locked_length, params.locked_length]
    )
    acceleration_units = coordinate_units / time_unit**2
    accelerations_by_phase = []
    first_value_index = 5
    for phase_class, surface_mesh, phase_mesh in zip(
        PAPER_PHASES, GAIT_SURFACE_MESHES, phase_meshes, strict=True
    ):
        n_coordinates = phase_class.n_dof
        n_values = surface_mesh.n_intervals * N_GAUSS_NODES * n_coordinates
        surface_accelerations = predicted_surface_values[
            first_value_index : first_value_index + n_values
        ].reshape(surface_mesh.n_intervals, N_GAUSS_NODES, n_coordinates, *monomials.shape[1:])
        first_value_index += n_values
        phase_accelerations = transfer_accelerations(
            surface_mesh, phase_mesh, surface_accelerations
        )
        accelerations_by_phase.append(
            (phase_accelerations * acceleration_units[:n_coordinates])[None]
        )
    return CollocationSolution(section_state, phase_durations, tuple(accelerations_by_phase))
