"""Define continuation problems of gaits, and measure the gaits at points of their branches.

`CollocationProblem` is the fastest problem. It solves the collocation equations of the paper's
sequence of phases, with one linearization per Newton iteration. `ContactGaitProblem` uses batches
of gait steps with unilateral contact. `ReturnMapProblem` applies to every model. It iterates the
gait step of the model and differentiates it in forward mode.
"""

import abc
import zlib
from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool

from vrw_jax.base.options import StepOptions
from vrw_jax.base.types import Scalar
from vrw_jax.branches import arclength
from vrw_jax.branches.arclength import (
    AbstractContinuationProblem,
    ContinuationPoint,
    NewtonStep,
    ProblemUnknowns,
    SectionStateVector,
)
from vrw_jax.branches.branch_points import CONTACT_ORDER_COLUMN
from vrw_jax.gaits.collocation_search import CollocationSystem, compute_correction_norm
from vrw_jax.gaits.force_peaks import compute_force_peaks
from vrw_jax.gaits.phase_collocation import CollocationSolution
from vrw_jax.gaits.return_map_finder import measure_return_map_force_peaks
from vrw_jax.gaits.unilateral_finder import PeriodMap, solve_linear_systems
from vrw_jax.lanes.batching import unbatch
from vrw_jax.lanes.lane_function import compile_batch_function
from vrw_jax.models.interface import AbstractWheel
from vrw_jax.models.measures import MARGIN_MEASURES, MEASURES, STOPPER_MARGIN_MEASURES
from vrw_jax.models.step_results import AbstractStep, AnySectionState
from vrw_jax.wheel.outcomes import Outcome
from vrw_jax.wheel.params import (
    WheelParams,
    stack_parameters,
)

FRICTION_SURPLUS_COLUMN_NAME = "friction_above_slope"
"""Name of the difference between the friction coefficient and the slope's tangent.

The tangent is the smallest friction coefficient for which a gait exists.
"""

MIN_FRICTION_SURPLUS = 1e-9
"""Smallest admissible surplus of friction, as a fraction of the slope's tangent.

The value is chosen to exceed the round-off of friction. If friction equals the tangent, gaits of
every speed repeat.
"""


class BranchWheel(NamedTuple):
    """Wheel whose gaits are continued.

    The continuation problem replaces the continued parameter in `params`.
    """

    params: WheelParams
    # 1 if the phase occurs in the cycle, else 0, shape (n, n_phases); () without collocation
    is_phase_active: Any = ()


class AbstractGaitProblem(AbstractContinuationProblem):
    """Continuation problem of gaits in one parameter of the wheel.

    Event-driven steps of the model measure the gaits.
    """

    model: eqx.AbstractVar[AbstractWheel]
    step_options: eqx.AbstractVar[StepOptions]
    parameter_name: eqx.AbstractVar[str]

    @property
    @abc.abstractmethod
    def n_steps(self) -> int:
        """Return the number of gait steps after which the gaits repeat."""

    def read_gait_state(
        self, wheel: BranchWheel, z: ProblemUnknowns, p: Scalar
    ) -> tuple[AnySectionState, dict[str, Array]]:
        """Return the section state before the first landing, and the continued quantities by name.

        A continued quantity is defined on both sides of a special point. By default, z is the
        section state, and all quantities are measures of the event-driven step.
        """
        return z, {}

    @eqx.filter_jit
    def measure_gaits(self, wheels: BranchWheel, points: ContinuationPoint) -> dict[str, Array]:
        """Return the measures of the gaits at many points by name, computed by
        event-driven steps.
        """

        def measure_point(wheel: BranchWheel, z: Any, p: Array) -> dict[str, Array]:
            section_state, continued_quantities = self.read_gait_state(wheel, z, p)
            model, params = self.model.with_parameter(wheel.params, self.parameter_name, p)
            gait_measures = measure_gait_period(
                model, params, section_state, self.step_options, self.n_steps
            )
            return gait_measures | continued_quantities | {"section_state": section_state}

        return jax.vmap(measure_point)(wheels, points.z, points.p)


class CollocationProblem(AbstractGaitProblem):
    """Continuation problem of limit cycles by collocation. The unknowns z are a
    `CollocationSolution`.

    If an indicator changes its sign, the solution still exists, but the event-driven step does not
    confirm it as a gait.

    - `additional_quantity_function`: function of the wheel's symbols, the phase points of the first
      gait step and z, or None;
    - `measures_force_peaks`: whether the points also have the measures of the gait's force.
    """

    model: AbstractWheel
    step_options: StepOptions
    collocation_system: CollocationSystem = eqx.field(static=True)
    parameter_name: str = eqx.field(static=True)
    additional_quantity_function: Callable | None = eqx.field(static=True)
    measures_force_peaks: bool = eqx.field(static=True, default=False)

    @property
    def n_steps(self) -> int:
        return self.collocation_system.period_n

    def _stack_parameters_at(self, wheel: BranchWheel, p: Scalar) -> Array:
        """Return the wheel's parameters as a vector, in which the continued parameter
        has the value p.
        """
        return stack_parameters(self.model.with_parameter(wheel.params, self.parameter_name, p)[1])

    def linearize(self, wheel: BranchWheel, z: ProblemUnknowns, p: Scalar) -> NewtonStep:
        linearize_trial = make_trial_linearizer(
            self.collocation_system, (self.model.parameter_names.index(self.parameter_name),)
        )
        newton_correction, parameter_tangents, monodromy_matrix, *_ = linearize_trial(
            self._stack_parameters_at(wheel, p), wheel.is_phase_active, z
        )
        return NewtonStep(
            newton_correction, jax.tree.map(lambda x: x[0], parameter_tangents), monodromy_matrix
        )

    def section_state(self, z: ProblemUnknowns) -> SectionStateVector:
        return z.section_state

    def correction_norm(self, z: ProblemUnknowns, newton_correction: ProblemUnknowns) -> Scalar:
        return unbatch(compute_correction_norm)(z, newton_correction)

    def is_admissible(self, wheel: BranchWheel, z: ProblemUnknowns, p: Scalar) -> Bool[Array, ""]:
        """Return whether all durations are positive.

        The event-driven step checks all other conditions.
        """
        return jnp.all((z.durations > 0.0) | (wheel.is_phase_active < 0.5))

    def read_gait_state(
        self, wheel: BranchWheel, z: ProblemUnknowns, p: Scalar
    ) -> tuple[AnySectionState, dict[str, Array]]:
        """Return the section state before the first landing, and the continued quantities by name.

        The continued quantities are the shortest duration of each phase over the gait steps, s, and
        `takeoff_acceleration`, m/s^2. The latter is the lowest acceleration of the rear foot at
        take-off over the gait steps.
        """
        collocation_system = self.collocation_system
        parameters = self._stack_parameters_at(wheel, p)
        wheel_symbols = collocation_system.make_wheel(parameters).symbols()
        phase_points_by_step = collocation_system.evaluate_phase_points(parameters, z)
        last_end_point, min_durations = (
            phase_points_by_step[-1][-1].phase_end_point,
            jnp.min(z.durations, 0),
        )
        continued_quantities = {
            "duration_dls": jnp.where(wheel.is_phase_active[0, 0] > 0.5, min_durations[0], jnp.nan),
            "duration_sls1": min_durations[1],
            "duration_sls2": min_durations[2],
            "takeoff_acceleration": collocation_system.measure_takeoff_acceleration(parameters, z),
            "mesh_error": collocation_system.estimate_mesh_error(z),
        }
        if self.additional_quantity_function is not None:
            continued_quantities |= self.additional_quantity_function(
                wheel_symbols, phase_points_by_step[0], z
            )
        if self.measures_force_peaks:
            continued_quantities |= compute_force_peaks(collocation_system, parameters, z)
        return jnp.stack([last_end_point.q[0], *last_end_point.v]), continued_quantities


GaitQuantityFunction = Callable[[CollocationSystem, Array, Array, CollocationSolution], Array]
"""Function that computes quantities of collocated gaits, with the batch elements on the last axis.

Its arguments are the collocation system, the parameters, `is_phase_active` and the solution.
"""


def make_trial_linearizer(
    collocation_system: CollocationSystem,
    parameter_indices: tuple[int, ...],
    gait_quantity_function: GaitQuantityFunction | None = None,
) -> Any:
    """Return a function that linearizes the collocation equations of one wheel at a trial solution.

    The arguments of the function are (parameters, is_phase_active, solution), and `jax.vmap` can
    map it over wheels. It returns Newton's correction, the tangents with respect to the selected
    parameters and the monodromy matrix. If `gait_quantity_function` is not None, it also returns
    the computed quantities and their JVPs. The directions of the JVPs are the correction and each
    tangent.
    """

    def linearize_trial(parameters: Array, is_phase_active: Array, z: CollocationSolution) -> tuple:
        cycle_linearization = collocation_system.linearize_at(
            parameters, z, is_phase_active, parameter_indices
        )
        newton_results = (
            cycle_linearization.newton_correction,
            cycle_linearization.parameter_tangents,
            cycle_linearization.monodromy,
        )
        if gait_quantity_function is None:
            return newton_results
        # The parameters do not change in the direction of the correction.
        parameter_tangents = np.zeros((1 + len(parameter_indices), len(parameters), 1))
        parameter_tangents[range(1, len(parameter_tangents)), parameter_indices] = 1.0
        tangent_directions = (
            jnp.broadcast_to(
                parameter_tangents.astype(parameters.dtype),
                (len(parameter_tangents), *parameters.shape),
            ),
            jax.tree.map(
                lambda correction, tangents: jnp.concatenate([correction[None], tangents]),
                *newton_results[:2],
            ),
        )
        evaluate_quantities = lambda parameters, z: gait_quantity_function(
            collocation_system, parameters, is_phase_active, z
        )
        compute_quantity_tangent = lambda tangent_direction: jax.jvp(
            evaluate_quantities, (parameters, z), tangent_direction
        )[1]
        return (
            *newton_results,
            evaluate_quantities(parameters, z),
            lax.map(compute_quantity_tangent, tangent_directions),
        )

    return unbatch(
        compile_batch_function(linearize_trial, collocation_system.cycle_options.batch_size)
    )


class AbstractReturnMapProblem(AbstractGaitProblem):
    """Continuation problem of fixed points of the return map over `period_n` gait steps.

    The unknowns z are the section state. Its last components are discrete codes (see
    `AbstractWheel.count_continuous_section_entries`), which are copied from the image under the
    return map in every Newton iteration. Newton's method converges only if state and image have
    equal codes.
    """

    model: AbstractWheel
    step_options: StepOptions
    parameter_name: str = eqx.field(static=True)
    period_n: int = eqx.field(static=True)
    n_coordinates: int = eqx.field(static=True)

    @property
    def n_steps(self) -> int:
        return self.period_n

    def section_state(self, z: ProblemUnknowns) -> SectionStateVector:
        return z[: self.n_coordinates]

    def interpolate_unknowns(
        self, left_point: ProblemUnknowns, right_point: ProblemUnknowns, location_fraction: Scalar
    ) -> ProblemUnknowns:
        """Interpolate the first components of two section states.

        The discrete codes are those of the nearer section state.
        """
        nearer_point = jnp.where(location_fraction < 0.5, left_point, right_point)
        interpolated_point = left_point + location_fraction * (right_point - left_point)
        return jnp.concatenate(
            [interpolated_point[: self.n_coordinates], nearer_point[self.n_coordinates :]]
        )

    def is_smooth_between(
        self, left_point: ProblemUnknowns, right_point: ProblemUnknowns
    ) -> Bool[Array, ""]:
        """Return whether two neighboring points have equal discrete codes in their
        section states.
        """
        return jnp.all(left_point[self.n_coordinates :] == right_point[self.n_coordinates :])


class ReturnMapProblem(AbstractReturnMapProblem):
    """Continuation problem of the gaits of a model whose gait steps JAX can differentiate."""

    def linearize(self, wheel: BranchWheel, z: ProblemUnknowns, p: Scalar) -> NewtonStep:
        def return_map(z: Array, p: Scalar) -> Array:
            model, params = self.model.with_parameter(wheel.params, self.parameter_name, p)
            for _ in range(self.period_n):
                advance_result = model.advance(params, z, self.step_options)
                z = jnp.where(
                    advance_result.outcome == Outcome.STEPPED, advance_result.section_state, jnp.nan
                )
            return z

        return arclength.compute_fixed_point_newton_step(return_map, z, p, self.n_coordinates)


class ContactGaitProblem(AbstractReturnMapProblem):
    """Continuation problem of gaits with unilateral contact, solved by batches of gait steps."""

    n_legs: int = eqx.field(static=True)
    measures_force_peaks: bool = eqx.field(static=True, default=False)

    is_traceable: ClassVar[bool] = False
    has_kinks: ClassVar[bool] = True

    def stack_parameter_values(self, wheels: BranchWheel, p: Array) -> Array:
        """Return the parameter values of many wheels, in which the continued parameter has the
        value p.
        """

        def select_values(wheel: BranchWheel, p: Array) -> Array:
            model, params = self.model.with_parameter(wheel.params, self.parameter_name, p)
            return model.collect_parameter_values(params)

        return jax.vmap(select_values)(wheels, p)

    def _make_period_map(self, wheels: BranchWheel, p: Array) -> PeriodMap:
        """Return the map that advances the section states of many wheels by one period."""
        parameter_values = np.asarray(self.stack_parameter_values(wheels, p))
        return PeriodMap(self.model, self.n_legs, self.period_n, parameter_values)

    def linearize(self, wheel: BranchWheel, z: ProblemUnknowns, p: Array) -> NewtonStep:
        """Return the Newton steps of many wheels at their trial points."""
        section_states, n_coordinates = np.asarray(z), self.n_coordinates
        is_continued_parameter = np.asarray(self.model.parameter_names) == self.parameter_name
        period_evaluation = self._make_period_map(wheel, p).evaluate_period(
            self.step_options, section_states, is_continued_parameter
        )
        nan_if_incomplete = np.where(period_evaluation.is_period_complete, 0.0, np.nan)[:, None]
        period_defects = period_evaluation.end_states - section_states + nan_if_incomplete
        return_map_jacobian = period_evaluation.return_map_jacobian[
            :, :n_coordinates, :n_coordinates
        ]
        parameter_jacobian = period_evaluation.parameter_jacobian[
            :, :n_coordinates, is_continued_parameter
        ]
        right_hand_sides = np.concatenate(
            [period_defects[:, :n_coordinates, None], parameter_jacobian], -1
        )
        linear_system_solutions = solve_linear_systems(
            np.eye(n_coordinates) - return_map_jacobian, right_hand_sides
        )
        contact_code_changes = period_defects[:, n_coordinates:]
        newton_corrections = np.concatenate(
            [linear_system_solutions[..., 0], contact_code_changes], 1
        )
        parameter_tangents = np.concatenate(
            [linear_system_solutions[..., 1], 0.0 * contact_code_changes], 1
        )
        return NewtonStep(newton_corrections, parameter_tangents, jnp.asarray(return_map_jacobian))

    def measure_gaits(self, wheels: BranchWheel, points: ContinuationPoint) -> dict[str, Array]:
        period_evaluation = self._make_period_map(wheels, points.p).evaluate_period(
            self.step_options, np.asarray(points.z), False, False
        )
        section_states = jnp.asarray(points.z)
        additional_quantities = {
            "section_state": section_states,
            CONTACT_ORDER_COLUMN: compute_contact_order_numbers(
                period_evaluation.gait_steps_of_period, self.n_legs
            ),
            FRICTION_SURPLUS_COLUMN_NAME: np.asarray(
                jax.vmap(self._compute_friction_surplus)(wheels, points.p)
            ),
        }
        if self.measures_force_peaks:
            additional_quantities |= self._measure_force_peaks(
                wheels,
                points.p,
                section_states,
                jnp.asarray(period_evaluation.gait_steps_of_period.section_state),
            )
        return (
            _combine_period_measures(period_evaluation.gait_steps_of_period, points.z)
            | additional_quantities
        )

    @eqx.filter_jit
    def _measure_force_peaks(
        self, wheels: BranchWheel, p: Array, section_states: Array, step_ends: Array
    ) -> dict[str, Array]:
        """Return the `measures.FORCE_PEAK_MEASURES` of many gaits by name.

        The first axis of all arguments is that of the gaits.
        """

        def measure_gait_force(
            wheel: BranchWheel, p: Array, section_state: Array, step_ends: Array
        ) -> dict[str, Array]:
            model, params = self.model.with_parameter(wheel.params, self.parameter_name, p)
            return measure_return_map_force_peaks(
                model, params, section_state, step_ends, self.step_options
            )

        return jax.vmap(measure_gait_force)(wheels, p, section_states, step_ends)

    def _compute_friction_surplus(self, wheel: BranchWheel, p: Array) -> Array:
        """Return the friction coefficient minus the slope's tangent.

        Over a period, the ground's tangential impulse balances the impulse of the weight parallel
        to the slope. The tangential impulse is at most the friction coefficient times the normal
        impulse. Therefore no gait repeats without a surplus.
        """
        model: Any
        model, params = self.model.with_parameter(wheel.params, self.parameter_name, p)
        return model.friction - jnp.tan(params.slope) * (1.0 + MIN_FRICTION_SURPLUS)

    def is_admissible(self, wheel: BranchWheel, z: ProblemUnknowns, p: Scalar) -> Bool[Array, ""]:
        """Return whether friction can balance the component of the weight parallel to the slope."""
        return jnp.all(jnp.isfinite(z)) & (self._compute_friction_surplus(wheel, p) > 0.0)


def compute_contact_order_numbers(gait_steps_of_period: Any, n_legs: int) -> np.ndarray:
    """Return a number for each period that identifies its order of contacts, shape (periods,).

    The number is a checksum of the contact modes that occur, the event counts and the final contact
    modes.
    """
    has_contact_mode_occurred = np.asarray(gait_steps_of_period.mode_durations) > 0.0
    contact_codes = np.asarray(gait_steps_of_period.section_state)[..., -n_legs:]
    event_and_impact_counts = np.stack(
        [np.asarray(gait_steps_of_period.events), np.asarray(gait_steps_of_period.impacts)], -1
    )
    integer_arrays_by_period = [
        x.reshape(len(x), -1).astype(np.int64)
        for x in (has_contact_mode_occurred, contact_codes, event_and_impact_counts)
    ]
    contact_order_numbers = [
        zlib.crc32(integers_of_period.tobytes())
        for integers_of_period in np.concatenate(integer_arrays_by_period, 1)
    ]
    return np.array(contact_order_numbers, float)


@jax.jit
@jax.vmap
def _combine_period_measures(
    step_results: AbstractStep, section_states: AnySectionState
) -> dict[str, Array]:
    """Combine the measures of the gait steps in each period to measures of the period.

    `section_states` contains the first section state of each period.
    """
    return combine_step_measures(
        step_results.section_state[-1],
        jax.vmap(lambda step_result: step_result.measures())(step_results),
        section_states,
    )


def measure_gait_period(
    model: AbstractWheel,
    params: WheelParams,
    section_state: AnySectionState,
    step_options: StepOptions,
    period_n: int,
) -> dict[str, Array]:
    """Return all measures of one period of a gait, which starts at `section_state`.

    Indicators and margins are minima over the gait steps, required friction coefficients are
    maxima, and durations and energies are sums. The section state is that of the last step, and the
    post-impact state is that of the first step. `outcome` is the first failure of a step, if any.
    `closure` is the largest change of the section state over the period.
    """

    def measure_next_step(
        section_state: AnySectionState, _: None
    ) -> tuple[AnySectionState, dict[str, Array]]:
        step_result = model.take_step(params, section_state, step_options)
        return step_result.section_state, step_result.measures()

    end_state, step_measures = lax.scan(measure_next_step, section_state, None, length=period_n)
    return combine_step_measures(end_state, step_measures, section_state)


def combine_step_measures(
    end_state: AnySectionState, step_measures: dict[str, Array], section_state: AnySectionState
) -> dict[str, Array]:
    """Return the result of `measure_gait_period`, computed from the measures of each step and
    the end state.
    """
    period_measures = {}
    for measure_name, values_by_step in step_measures.items():
        if measure_name in MARGIN_MEASURES | STOPPER_MARGIN_MEASURES or measure_name.startswith(
            "lambda_"
        ):
            period_measures[measure_name] = jnp.min(values_by_step, 0)
        elif measure_name.endswith("_touchdown"):
            period_measures[measure_name] = values_by_step[-1]
        elif measure_name.endswith("_post_impact"):
            period_measures[measure_name] = values_by_step[0]
        elif measure_name == "outcome":
            period_measures[measure_name] = values_by_step[
                jnp.argmax(values_by_step != Outcome.STEPPED)
            ]
        elif MEASURES[measure_name].is_averaged_over_steps:
            period_measures[measure_name] = jnp.mean(values_by_step, 0)
        elif MEASURES[measure_name].is_largest_over_steps:
            period_measures[measure_name] = jnp.max(values_by_step, 0)
        else:
            period_measures[measure_name] = jnp.sum(values_by_step, 0)
    positive_period = jnp.where(period_measures["period"] > 0.0, period_measures["period"], 1.0)
    period_measures["dls_fraction"] = period_measures["duration_dls"] / positive_period
    period_measures["speed"] = period_measures["step_length"] / positive_period
    return period_measures | {"closure": jnp.max(jnp.abs(end_state - section_state))}
