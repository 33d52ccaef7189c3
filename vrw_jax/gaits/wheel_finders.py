"""Finders of gaits of one wheel, for its models.

Collocation finds gaits of the paper's model, and each is checked by one event-driven step. Newton's
method on the return map, from a start near the gait, finds gaits of any model. It only uses the
interface of models.
"""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from vrw_jax.base.checks import has_traced_leaf
from vrw_jax.base.elementwise import Scalar
from vrw_jax.base.options import StepOptions
from vrw_jax.base.results import Measure, Outcome
from vrw_jax.gaits.collocation_search import predict_start_from_gait_surface
from vrw_jax.gaits.cycle import CYCLE_MEASURE_FUNCTIONS, AbstractCycle, CycleOptions
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
from vrw_jax.gaits.fixed_points import (
    FixedPointResult,
    solve_fixed_point,
)
from vrw_jax.gaits.limit_cycle_result import (
    LimitCycle,
    guess_cycle_from_walk,
    land_foot,
    sample_walk_in_time,
    solve_limit_cycle,
)
from vrw_jax.gaits.phase_sequence import CollocationState, CollocationSystem
from vrw_jax.lanes.autodiff import evaluate_with_jacobian
from vrw_jax.lanes.environment import with_default_jax_settings
from vrw_jax.models.measures import (
    DIFFERENTIABLE_STEP_NAMES,
    FORCE_PEAK_MEASURES,
    GAIT_SENSITIVITY_MEASURES,
    MARGIN_MEASURES,
    MEASURES,
    SHARED_STEP_MEASURE_NAMES,
)
from vrw_jax.models.step_results import AbstractStep, SectionState, StepResult
from vrw_jax.models.stepping import convert_step_arguments, start_walk_toward_gait
from vrw_jax.models.viscoelastic import ViscoelasticWheel
from vrw_jax.wheel.params import WheelParams, compute_wheel_units

MIN_NEWTON_TOLERANCE = 1e-12
"""Smallest tolerance for Newton's last correction.

The tolerance is also at least that of the gait step.
"""


def compute_newton_tolerance(options: StepOptions) -> Scalar:
    """Return the tolerance for Newton's last correction that suits the options of the gait step."""
    return jnp.maximum(MIN_NEWTON_TOLERANCE, options.rtol)


class ReturnMapCycle(AbstractCycle):
    """Gait that repeats after `period_n` gait steps, as a fixed point of a model's return map.

    The cycle is differentiable with respect to the parameters by the implicit function theorem, to
    second order. If no gait is found, `outcome` is the reason, and all other fields are zero. Under
    `jax.vmap`, the batch axis of every field comes first.

    - `section_state`: fixed point of `period_n` return maps;
    - `post_impact`: (theta, dtheta) after the first landing, rad, rad/s;
    - `durations`: durations that the model's step returns, s; (n, 3) for period_n = n > 1;
    - `step_length`: distance between the feet at the landing, m;
    - `steps`: step results of the model, with an axis over the gait steps of one cycle;
    - `monodromy_value`: Jacobian of the return map;
    - `outcome`: Outcome.STEPPED, or the reason of the failure;
    - `residual`: largest absolute component of map(x) - x, in units of the wheel;
    - `n_iterations`: number of Newton iterations;
    - `params`, `model`: wheel and model of the gait.

    Examples:
        >>> wheel = vrw.RigidWheel(held_landing=True)
        >>> cycle = vrw.limit_cycle(vrw.WheelParams(slope=0.1), model=wheel, guess=[0.39, 1.5, 0.0])
        >>> print(f"{cycle.period:.3f} s")
        0.425 s
    """

    section_state: Float[Array, " n_section_entries"]
    post_impact: Float[Array, "2"]
    durations: Float[Array, "*n 3"]
    step_length: Float[Array, "*n"]
    steps: Any
    monodromy_value: Float[Array, "n_section_entries n_section_entries"]
    outcome: Int[Array, ""]
    residual: Scalar
    n_iterations: Int[Array, ""]
    params: WheelParams
    model: Any

    @property
    def searched_wheel(self) -> tuple[Any, WheelParams]:
        return self.model, self.params

    def _drop_single_step_axis(self, tree_over_steps: Any) -> Any:
        """Return the tree without its axis over the gait steps if the cycle has only one step."""
        if self.period_n > 1:
            return tree_over_steps
        return jax.tree.map(lambda x: jnp.squeeze(x, self.outcome.ndim), tree_over_steps)

    @property
    def indicators(self) -> Any:
        """Return the indicators of double support at each landing."""
        return self._drop_single_step_axis(self.steps.indicators)

    @property
    def margins(self) -> Any:
        """Return the margins of each gait step."""
        return self._drop_single_step_axis(self.steps.margins)

    @property
    def step_ends(self) -> Array:
        return jnp.asarray(self.steps.section_state)

    def _evaluate_own_measure(self, measure: Measure) -> Array:
        measure_cycle = functools.partial(measure_return_map_cycle, measure, StepOptions())
        return self.map_over_batch_axes(measure_cycle)(
            self.model, self.params, self.section_state, self.steps
        )

    def _locate_force_peaks(self) -> dict[str, Array]:
        measure_cycle = functools.partial(measure_return_map_force_peaks, options=StepOptions())
        return self.map_over_batch_axes(measure_cycle)(
            self.model, self.params, self.section_state, self.step_ends
        )


def measure_return_map_force_peaks(
    model: Any,
    params: WheelParams,
    section_state: Array,
    step_ends: Array,
    options: StepOptions,
) -> dict[str, Array]:
    """Return the `measures.FORCE_PEAK_MEASURES` of a cycle by name, the largest over its steps.

    - `section_state`: section state at the start of the cycle;
    - `step_ends`: section state at the end of each gait step, on a leading axis.
    """
    start_states = jnp.concatenate([section_state[None], step_ends[:-1]])
    measures_by_leg = []
    for k in range(model.leg_period):
        measure = functools.partial(model.measure_force_peaks, model.select_params(params, k))
        starts = start_states[k :: model.leg_period]
        measures_by_leg.append(jax.vmap(lambda x, measure=measure: measure(x, options))(starts))
    return jax.tree.map(lambda *values: jnp.nanmax(jnp.concatenate(values)), *measures_by_leg)


def measure_return_map_cycle(
    measure: Measure,
    options: StepOptions,
    model: Any,
    params: WheelParams,
    section_state: Array,
    steps: Any,
) -> Array:
    """Return a measure of the user, as the mean over the steps of a cycle.

    - `steps`: gait steps of the cycle, on a leading axis.
    """
    values = []
    for k in range(len(steps.section_state)):
        step = jax.tree.map(lambda x, k=k: x[k], steps)
        step_params = model.select_params(params, k)
        values.append(model.measure_step(step_params, section_state, step, options, (measure,)))
        section_state = step.section_state
    return jnp.mean(jnp.stack([value[measure.name] for value in values]), 0)


@eqx.filter_jit
def find_return_map_cycle(
    params: WheelParams,
    section_state: Array,
    model: Any,
    options: StepOptions,
    period_n: int,
    differentiates_jacobian: bool,
) -> ReturnMapCycle:
    """Find the cycle of a wheel by Newton's method on the model's return map.

    If `differentiates_jacobian` is false, the search uses the same step function as the result, so
    that only one program is compiled.
    """
    evaluate_step = model.advance if differentiates_jacobian else model.take_step
    section_units = jnp.stack(
        model.collect_section_units(compute_wheel_units(params.symbols()), params.n_legs)
    )

    def take_steps(evaluate_step: Callable, section_state: Array, n_steps: int) -> list[Any]:
        steps: list[Any] = []
        for k in range(n_steps):
            step_params = model.select_params(params, k)
            steps.append(evaluate_step(step_params, section_state, options))
            section_state = steps[-1].section_state
        return steps

    def return_map(section_state: Array) -> Array:
        steps = take_steps(evaluate_step, section_state * section_units, model.leg_period)
        return steps[-1].section_state / section_units

    fixed_point = solve_fixed_point(
        return_map,
        section_state / section_units,
        period_n=period_n // model.leg_period,
        tolerance=compute_newton_tolerance(options),
        units=1.0,
        differentiates_jacobian=differentiates_jacobian,
    )
    fixed_point = fixed_point._replace(
        x=fixed_point.x * section_units,
        jacobian=section_units[:, None] * fixed_point.jacobian / section_units,
    )
    steps = take_steps(model.take_step, fixed_point.x, period_n)
    return make_return_map_cycle(
        params, model, fixed_point, jax.tree.map(lambda *x: jnp.stack(x), *steps)
    )


def make_return_map_cycle(
    params: WheelParams,
    model: Any,
    fixed_point: FixedPointResult,
    gait_steps_of_cycle: Any,
) -> ReturnMapCycle:
    """Build the cycle that belongs to a fixed point, from its gait steps on a leading axis."""
    # A failed step returns zeros, to which Newton's method may converge.
    is_gait_valid = fixed_point.converged & jnp.all(gait_steps_of_cycle.outcome == Outcome.STEPPED)
    failure_outcome = jnp.where(params.is_in_domain(), Outcome.NO_CYCLE_FOUND, Outcome.BAD_INPUT)
    zero_without_gait = lambda array_over_steps: jnp.where(
        is_gait_valid, array_over_steps, jnp.zeros_like(array_over_steps)
    )
    gait_steps_of_cycle = jax.tree.map(zero_without_gait, gait_steps_of_cycle)
    select_step_values = lambda values_by_step: (
        values_by_step[0] if len(values_by_step) == 1 else values_by_step
    )
    return ReturnMapCycle(
        section_state=zero_without_gait(fixed_point.x),
        post_impact=gait_steps_of_cycle.post_impact[0],
        durations=select_step_values(gait_steps_of_cycle.durations),
        step_length=select_step_values(gait_steps_of_cycle.step_length),
        steps=gait_steps_of_cycle,
        monodromy_value=zero_without_gait(fixed_point.jacobian),
        outcome=jnp.where(is_gait_valid, Outcome.STEPPED, failure_outcome).astype(jnp.int32),
        residual=fixed_point.residual,
        n_iterations=fixed_point.n_iterations,
        params=params,
        model=model,
    )


class ReturnMapFinder(AbstractGaitFinder):
    """Finder of the gaits of any model, as fixed points of its return map over `period_n` steps."""

    model: Any
    n_legs: int = eqx.field(static=True)
    step_options: StepOptions
    period_n: int = eqx.field(static=True, default=1)

    options_type: ClassVar[type] = StepOptions
    supports_cold_start: ClassVar[bool] = False
    differentiates_jacobian: ClassVar[bool] = True
    """Whether derivatives of the multipliers are available, which need those of second order."""
    cycle_measures: ClassVar[tuple[str, ...]] = tuple(
        measure_name
        for measure_name in CYCLE_MEASURE_FUNCTIONS
        if measure_name
        not in ("takeoff_acceleration", *GAIT_SENSITIVITY_MEASURES, *FORCE_PEAK_MEASURES)
    )
    differentiable_measures: ClassVar[tuple[str, ...]] = tuple(
        dict.fromkeys(
            (
                *cycle_measures,
                *(
                    measure_name
                    for measure_name in SHARED_STEP_MEASURE_NAMES
                    if measure_name in DIFFERENTIABLE_STEP_NAMES
                ),
            )
        )
    )
    default_measures: ClassVar[tuple[str, ...]] = tuple(
        measure_name for measure_name in cycle_measures if measure_name != "spectral_margin"
    )
    readable_measures: ClassVar[tuple[str, ...]] = differentiable_measures

    def find_cycle(self, params: WheelParams, cycle_guess: Any = None) -> ReturnMapCycle:
        return find_return_map_cycle(
            *self.prepare_search(params, cycle_guess), self.period_n, self.differentiates_jacobian
        )

    def prepare_search(
        self, params: WheelParams, cycle_guess: Any
    ) -> tuple[WheelParams, Array, Any, StepOptions]:
        """Return the wheel, the section state, the model and the options for a search near
        `cycle_guess`.
        """
        section_state = getattr(cycle_guess, "section_state", cycle_guess)
        if section_state is None:
            section_state = self.model.compute_default_start(params)
        return convert_step_arguments(params, section_state, self.model, self.step_options)

    def make_initial_guess(self, parameter_values: ParameterValues) -> Array:
        """Return the last section state of a walk that begins at the model's default start."""
        model, params = self.model.from_parameter_values(parameter_values, self.n_legs)
        return start_walk_toward_gait(model, params, self.step_options).steps.section_state[-1]


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
