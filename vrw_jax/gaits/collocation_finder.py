"""Find gaits of the paper's model by collocation, and check each gait by one event-driven step."""

import dataclasses
import functools
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from vrw_jax.base.checks import has_traced_leaf
from vrw_jax.base.options import StepOptions
from vrw_jax.gaits.collocation_search import predict_start_from_gait_surface
from vrw_jax.gaits.cycle import CYCLE_MEASURE_FUNCTIONS, AbstractCycle
from vrw_jax.gaits.derivatives import (
    COLLOCATION_RESPONSE_MEASURES,
    SearchMissingCycles,
    SlopeResponse,
    attach_derivatives,
)
from vrw_jax.gaits.finder import (
    AbstractGaitFinder,
    Gait,
    GaitBranchPoint,
    ParameterValues,
    move_derivative_axis_first,
)
from vrw_jax.gaits.limit_cycle_result import (
    LimitCycle,
    guess_cycle_from_walk,
    land_foot,
    sample_walk_in_time,
    solve_limit_cycle,
)
from vrw_jax.gaits.options import CycleOptions
from vrw_jax.gaits.phase_sequence import CollocationState, CollocationSystem
from vrw_jax.gaits.return_map_finder import (
    ReturnMapCycle,
    ReturnMapFinder,
)
from vrw_jax.lanes.autodiff import evaluate_with_jacobian
from vrw_jax.lanes.settings import with_default_jax_settings
from vrw_jax.models.measures import (
    DIFFERENTIABLE_STEP_NAMES,
    FORCE_PEAK_MEASURES,
    GAIT_SENSITIVITY_MEASURES,
    MARGIN_MEASURES,
    MEASURES,
)
from vrw_jax.models.step_results import AbstractStep, SectionState, StepResult
from vrw_jax.models.stepping import convert_step_arguments, start_walk_toward_gait
from vrw_jax.models.viscoelastic import ViscoelasticWheel
from vrw_jax.wheel.params import WheelParams

SECOND_MESH_INTERVALS = (64, 24, 24)
"""Mesh intervals in DLS, SLS-I and SLS-II of the fine mesh inside `jit`.

The value is chosen because all 144 gaits of 400 random wheels are then found that `limit_cycles`
finds (damping 20 to 400 N s/m, stiffness 300 to 3000 N/m, slope 0.05 to 0.35 rad). With 24 instead
of 64 intervals one gait is missed, whose double support lasts 19 s.
"""


class CollocationFinder(AbstractGaitFinder):
    """Finder of limit cycles of the paper's model, which requires no start near the gait.

    `period_n` applies only to `find_cycle`.
    """

    model: ViscoelasticWheel
    n_legs: int = eqx.field(static=True)
    step_options: StepOptions
    cycle_options: CycleOptions = eqx.field(static=True)
    period_n: int = eqx.field(static=True)
    coarse_options: CycleOptions | None = eqx.field(static=True, default=None)

    options_type: ClassVar[type] = CycleOptions
    cycle_measures: ClassVar[tuple[str, ...]] = tuple(CYCLE_MEASURE_FUNCTIONS)
    readable_measures: ClassVar[tuple[str, ...]] = tuple(
        dict.fromkeys((*cycle_measures, *DIFFERENTIABLE_STEP_NAMES, *MARGIN_MEASURES))
    )
    differentiable_measures: ClassVar[tuple[str, ...]] = tuple(
        measure_name
        for measure_name in readable_measures
        if not MEASURES[measure_name].leg_dimension
    )
    supports_cold_start: ClassVar[bool] = True
    has_own_measures: ClassVar[bool] = True
    default_measures: ClassVar[tuple[str, ...]] = tuple(
        measure_name
        for measure_name in cycle_measures
        if measure_name not in ("spectral_margin", *GAIT_SENSITIVITY_MEASURES, *FORCE_PEAK_MEASURES)
    )

    @property
    def search_options(self) -> CycleOptions:
        return self.cycle_options

    @property
    def collocation_system(self) -> CollocationSystem:
        """Return the collocation system that the search solves."""
        return CollocationSystem(
            self.n_legs,
            self.period_n,
            self.cycle_options,
            self.model.stop_at_lift_off,
            jax.tree.structure(self.model.own_parameters),
            self.coarse_options,
        )

    def with_second_mesh(self) -> "CollocationFinder":
        """Return a finder for `jit`, which uses a fine mesh where its own mesh is too coarse."""
        fine_intervals: Any = tuple(
            map(max, self.cycle_options.mesh_intervals, SECOND_MESH_INTERVALS)
        )
        return dataclasses.replace(
            self,
            cycle_options=dataclasses.replace(self.cycle_options, mesh_intervals=fine_intervals),
            coarse_options=self.cycle_options,
        )

    def with_finer_mesh(self, n_doublings: int) -> "CollocationFinder":
        """Return a finder whose numbers of mesh intervals are doubled `n_doublings` times."""
        options = self.cycle_options
        for _ in range(n_doublings):
            options = options.refine_mesh()
        return dataclasses.replace(self, cycle_options=options)

    @classmethod
    def read_measure(cls, measure_name: str, cycle: AbstractCycle, step: AbstractStep) -> Array:
        """Return the measure of a gait with the given name.

        At a scuffing take-off the clearance in SLS-I jumps, and the clearance in SLS-II is returned
        instead. Callers must therefore also check `takeoff_acceleration`.
        """
        measure_value = super().read_measure(measure_name, cycle, step)
        if measure_name == "clearance_sls1":
            is_takeoff_scuffing = cycle.measure("takeoff_acceleration") < 0.0
            return jnp.where(is_takeoff_scuffing, step.measures()["clearance_sls2"], measure_value)
        return measure_value

    def find_cycle(
        self,
        params: WheelParams,
        cycle_guess: Any = None,
        starts_only_from_guess: bool = False,
        search_missing_cycles: SearchMissingCycles | None = None,
    ) -> LimitCycle:
        params = self.model.attach_laws(params)
        system = self.collocation_system
        if isinstance(cycle_guess, LimitCycle) and cycle_guess.system == system:
            cycle_guess = system.select_coarse_state(cycle_guess.collocation_state)
        elif isinstance(cycle_guess, LimitCycle) and cycle_guess.system == system.coarse_system:
            cycle_guess = cycle_guess.collocation_state
        elif cycle_guess is not None and not isinstance(cycle_guess, CollocationState):
            section_state = getattr(cycle_guess, "section_state", cycle_guess)
            params, section_state, _, _ = convert_step_arguments(params, section_state, None, None)
            cycle_guess = self.guess_cycle_from_state(*lax.stop_gradient((params, section_state)))
        return dataclasses.replace(
            solve_limit_cycle(
                params,
                system,
                cycle_guess,
                starts_only_from_guess,
                search_missing_cycles,
            ),
            model=self.model.with_laws(params.laws),
        )

    def find_cycles(
        self, params: WheelParams, cycle_guess: Any = None, **search_options: Any
    ) -> Any:
        find_cycle: Any = functools.partial(self.find_cycle, **search_options)
        return jax.vmap(find_cycle)(params, cycle_guess)

    def guess_cycle_from_state(
        self, params: WheelParams, section_state: SectionState
    ) -> CollocationState:
        """Compute a guess of the cycle from a walk of `period_n` gait steps that starts at
        `section_state`.
        """
        params = self.model.attach_laws(params)
        walk_samples = sample_walk_in_time(self.model, params, section_state, self.period_n)
        return guess_cycle_from_walk(self.collocation_system.coarse_system, params, walk_samples)

    @eqx.filter_jit
    def shift_first_step(
        self, first_step_index: int, params: WheelParams, collocation_state: CollocationState
    ) -> CollocationState:
        """Return the same cycle, starting with its gait step at the index `first_step_index`."""
        previous_end_state = collocation_state.gait_step_end_states[first_step_index - 1]
        section_state = land_foot(params.symbols(), previous_end_state[jnp.array([0, 2, 3])])
        shifted_state = jax.tree.map(
            lambda x: jnp.roll(x, -first_step_index, 0) if x.ndim else x, collocation_state
        )
        return shifted_state._replace(
            solution=shifted_state.solution._replace(section_state=section_state)
        )

    @eqx.filter_jit
    def make_initial_guess(self, parameter_values: ParameterValues) -> CollocationState:
        predicted_search_start = predict_start_from_gait_surface(
            self.collocation_system, parameter_values[:, None], jnp.ones((1,), bool)
        )
        return jax.tree.map(lambda x: x[..., 0], predicted_search_start)

    def find_gait(self, parameter_values: ParameterValues, cycle_guess: CollocationState) -> Gait:
        cycle, cycle_derivatives = compute_cycle_and_derivatives(
            self.collocation_system, parameter_values, cycle_guess
        )
        step, step_derivatives = compute_step_and_derivatives(
            self.collocation_system,
            self.model,
            parameter_values,
            cycle.section_state,
            cycle_derivatives.section_state,
            self.step_options,
        )
        stack_coordinates = lambda cycle: jnp.concatenate(
            [
                cycle.section_state,
                cycle.durations.reshape(*cycle.section_state.shape[:-1], -1),
            ],
            -1,
        )
        branch_point = GaitBranchPoint(
            stack_coordinates(cycle),
            stack_coordinates(cycle_derivatives),
            cycle.collocation_state.is_phase_active,
            cycle.monodromy_value,
        )
        return Gait(cycle, step, cycle_derivatives, step_derivatives, branch_point)

    def refine_cycle_guess(
        self, parameter_values: ParameterValues, cycle_guess: Any
    ) -> CollocationState:
        cycle: Any = self.find_cycle_from_values(parameter_values, cycle_guess)
        return cycle.collocation_state

    def compute_slope_response(
        self, params: WheelParams, cycle: Any, measure_names: Sequence[str]
    ) -> SlopeResponse:
        """Return the linear response of the gait step and of its measures to the slopes of the
        ground.

        Uneven ground consists of lines with different slopes, and one gait step depends on two
        successive lines. The response is computed from the collocation if it determines the
        measures. Otherwise it is computed from the event-driven step.
        """
        if not set(measure_names) <= set(COLLOCATION_RESPONSE_MEASURES):
            return super().compute_slope_response(params, cycle, measure_names)
        return cycle.slope_response.select_measures(
            [COLLOCATION_RESPONSE_MEASURES.index(measure_name) for measure_name in measure_names]
        )

    def precompile_programs(self, params: WheelParams) -> None:
        parameter_values = self.model.collect_parameter_values(params)
        section_state = jnp.asarray(
            self.model.compute_default_start(params), parameter_values.dtype
        )
        with ThreadPoolExecutor(2) as compile_pool:
            cycle_program_future = compile_pool.submit(
                with_default_jax_settings(compute_cycle_and_derivatives),
                self.collocation_system,
                parameter_values,
                self.make_initial_guess(parameter_values),
            )
            step_program_future = compile_pool.submit(
                with_default_jax_settings(self.take_gait_step), params, section_state
            )
            cycle_program_future.result(), step_program_future.result()

    def take_gait_step(self, params: WheelParams, section_state: Array) -> StepResult:
        parameter_values = self.model.collect_parameter_values(params)
        # The program with derivatives is the one that exists.
        step, _ = compute_step_and_derivatives(
            self.collocation_system,
            self.model,
            parameter_values,
            section_state,
            jnp.zeros((len(parameter_values), len(section_state)), section_state.dtype),
            self.step_options,
        )
        return step


class KinkedGaitFinder(ReturnMapFinder):
    """Finder of gaits whose legs have a force with kinks.

    A mesh that does not adapt to the kinks is less accurate than event-driven steps. Collocation
    therefore only finds the start of Newton's method on the return map.
    """

    has_own_measures: ClassVar[bool] = True
    cycle_measures: ClassVar[tuple[str, ...]] = (
        *ReturnMapFinder.cycle_measures,
        *FORCE_PEAK_MEASURES,
    )
    readable_measures: ClassVar[tuple[str, ...]] = tuple(
        measure_name
        for measure_name in CollocationFinder.readable_measures
        if measure_name in ReturnMapFinder.readable_measures
        or measure_name in MARGIN_MEASURES
        or measure_name in FORCE_PEAK_MEASURES
    )
    differentiable_measures: ClassVar[tuple[str, ...]] = tuple(
        measure_name
        for measure_name in readable_measures
        if measure_name in CollocationFinder.differentiable_measures
        # Derivatives of multipliers are second derivatives of a step.
        and measure_name not in ("spectral_radius", "spectral_margin", "stability_margin")
    )
    default_measures: ClassVar[tuple[str, ...]] = tuple(
        measure_name
        for measure_name in differentiable_measures
        if measure_name in CollocationFinder.default_measures
    )
    cycle_options: CycleOptions = eqx.field(static=True, default_factory=CycleOptions)
    # Derivatives of the Jacobian would need second derivatives, which compile slowly.
    differentiates_jacobian: ClassVar[bool] = False

    def find_cycle(self, params: WheelParams, cycle_guess: Any = None) -> ReturnMapCycle:
        if cycle_guess is None:
            cycle_guess = self._find_start(lax.stop_gradient(params))
        return super().find_cycle(params, cycle_guess)

    def _find_start(self, params: WheelParams) -> Array:
        """Return the section state of a gait on a mesh, or of a walk if there is none."""
        fields = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        cycle = CollocationFinder(**fields).find_cycle(params)
        if not has_traced_leaf(cycle.found) and bool(cycle.found):
            return cycle.section_state
        walk = start_walk_toward_gait(self.model, params, self.step_options)
        return jnp.where(cycle.found, cycle.section_state, walk.steps.section_state[-1])


@eqx.filter_jit
def compute_cycle_and_derivatives(
    collocation_system: CollocationSystem, parameter_values: Array, cycle_guess: CollocationState
) -> tuple[LimitCycle, LimitCycle]:
    """Return the cycle near `cycle_guess`, and its derivatives with respect to all parameters.

    The derivatives have the parameters on a leading axis.
    """

    find_cycle = lambda parameter_values: solve_limit_cycle(
        collocation_system.make_wheel(parameter_values),
        collocation_system,
        cycle_guess,
    )
    cycle, parameter_jacobian = evaluate_with_jacobian(find_cycle, parameter_values)
    return cycle, move_derivative_axis_first(parameter_jacobian)


@eqx.filter_jit
def compute_step_and_derivatives(
    collocation_system: CollocationSystem,
    model: ViscoelasticWheel,
    parameter_values: Array,
    section_state: Array,
    section_state_derivatives: Array,
    options: StepOptions,
) -> tuple[StepResult, StepResult]:
    """Return one gait step, and its derivatives with respect to all parameters on the branch of
    gaits.

    `section_state_derivatives` contains the derivatives of the section state with respect to the
    parameters.
    """

    def take_step(parameter_values: Array) -> StepResult:
        start = attach_derivatives(
            lambda *_: section_state_derivatives, section_state, parameter_values, ()
        )
        params = collocation_system.make_wheel(parameter_values)
        return model.take_step_of_gait(params, start, options)

    step, parameter_jacobian = evaluate_with_jacobian(take_step, parameter_values)
    return step, move_derivative_axis_first(parameter_jacobian)
