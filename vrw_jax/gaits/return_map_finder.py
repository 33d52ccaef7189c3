"""Find gaits of any model by Newton's method on its return map, from a start near the gait.

Only the interface of models is used. For the paper's model, `collocation_finder` is a faster
method.
"""

import functools
from collections.abc import Callable
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from vrw_jax.base.measures import Measure
from vrw_jax.base.options import StepOptions
from vrw_jax.base.outcomes import Outcome
from vrw_jax.base.types import Scalar
from vrw_jax.gaits.cycle import CYCLE_MEASURE_FUNCTIONS, AbstractCycle
from vrw_jax.gaits.finder import (
    AbstractGaitFinder,
    ParameterValues,
)
from vrw_jax.gaits.fixed_points import (
    FixedPointResult,
    solve_fixed_point,
)
from vrw_jax.models.measures import (
    DIFFERENTIABLE_STEP_NAMES,
    FORCE_PEAK_MEASURES,
    GAIT_SENSITIVITY_MEASURES,
    SHARED_STEP_MEASURE_NAMES,
)
from vrw_jax.models.stepping import convert_step_arguments, start_walk_toward_gait
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
