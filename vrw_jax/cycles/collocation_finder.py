"""Finder of the gaits of the paper's model: one algebraic system for the cycle, and one step as
a check.
"""

import dataclasses
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from vrw_jax.cycles.collocation_search import CollocationState, CollocationSystem, surface_start
from vrw_jax.cycles.cycle import CYCLE_MEASURE_FUNCTIONS, AbstractCycle
from vrw_jax.cycles.finder import (
    AbstractGaitFinder,
    BranchPoint,
    Gait,
    GaitMeasures,
    Values,
    measure_from_cycle,
    measure_from_gait,
    move_derivative_axis_first,
)
from vrw_jax.cycles.limit_cycle_result import (
    LimitCycle,
    find_limit_cycle,
    guess_from_walk,
    sample_walk,
    transfer_to_mesh,
)
from vrw_jax.cycles.options import CycleOptions
from vrw_jax.cycles.slope_response import COLLOCATION_RESPONSE_MEASURES, SlopeResponse
from vrw_jax.measures import (
    DIFFERENTIABLE_STEP_NAMES,
    FORCE_PEAK_MEASURES,
    GAIT_SENSITIVITY_MEASURES,
    MARGIN_MEASURES,
    MEASURES,
)
from vrw_jax.models import AbstractStep, SectionState, StepResult, ViscoelasticWheel
from vrw_jax.numerics import StepOptions, value_and_jacobian
from vrw_jax.runtime import with_default_settings
from vrw_jax.simulation import validate_arguments
from vrw_jax.wheel import (
    PARAMETER_NAMES,
    WheelParams,
    stack_parameters,
    transitions,
    wheel_from_parameters,
)


class CollocationFinder(AbstractGaitFinder):
    """Finder of limit cycles that needs no start. `period_n` applies to `find_cycle` alone."""

    model: ViscoelasticWheel
    n_legs: int = eqx.field(static=True)
    step_options: StepOptions
    cycle_options: CycleOptions = eqx.field(static=True)
    period_n: int = eqx.field(static=True)

    options_type: ClassVar[type] = CycleOptions
    cycle_measures: ClassVar[tuple[str, ...]] = tuple(CYCLE_MEASURE_FUNCTIONS)
    readable_measures: ClassVar[tuple[str, ...]] = tuple(
        dict.fromkeys((*cycle_measures, *DIFFERENTIABLE_STEP_NAMES, *MARGIN_MEASURES))
    )
    differentiable_measures: ClassVar[tuple[str, ...]] = tuple(
        n for n in readable_measures if not MEASURES[n].dimension
    )
    supports_cold_start: ClassVar[bool] = True
    default_measures: ClassVar[tuple[str, ...]] = tuple(
        n
        for n in cycle_measures
        if n not in ("spectral_margin", *GAIT_SENSITIVITY_MEASURES, *FORCE_PEAK_MEASURES)
    )

    @classmethod
    def from_options(
        cls,
        model: Any,
        n_legs: int,
        step_options: StepOptions,
        period_n: int,
        cycle_options: CycleOptions,
    ) -> "CollocationFinder":
        return cls(model, n_legs, step_options, cycle_options, period_n)

    @property
    def search_options(self) -> CycleOptions:
        return self.cycle_options

    @property
    def system(self) -> CollocationSystem:
        """Return the collocation system of the search."""
        return CollocationSystem(
            self.n_legs, self.period_n, self.cycle_options, self.model.stop_at_lift_off
        )

    def with_finer_mesh(self) -> "CollocationFinder":
        """Return this finder with a finer mesh."""
        return dataclasses.replace(self, cycle_options=self.cycle_options.refine_mesh())

    @classmethod
    def read_measure(cls, name: str, cycle: AbstractCycle, step: AbstractStep) -> Array:
        """Return a measure of a gait by name.

        If the foot scuffs at take-off, the clearance in SLS-I is that in SLS-II, because it would
        otherwise jump. Callers must check `takeoff_acceleration` too.
        """
        value = cycle.measure(name) if name in cls.cycle_measures else step.measures()[name]
        if name == "clearance_sls1":
            is_scuffing = cycle.measure("takeoff_acceleration") < 0.0
            return jnp.where(is_scuffing, step.measures()["clearance_sls2"], value)
        return value

    def find_cycle(self, params: WheelParams, guess: Any = None) -> LimitCycle:
        if isinstance(guess, LimitCycle) and guess.system == self.system:
            guess = guess.collocation_state
        elif guess is not None and not isinstance(guess, CollocationState):
            section_state = guess.section_state if isinstance(guess, AbstractCycle) else guess
            params, state, _, _ = validate_arguments(params, section_state, None, None)
            guess = self.guess_from_state(*lax.stop_gradient((params, state)))
        return dataclasses.replace(find_limit_cycle(params, self.system, guess), model=self.model)

    def guess_from_state(
        self, params: WheelParams, section_state: SectionState
    ) -> CollocationState:
        """Return a start of the search from a walk: the next `period_n` steps from a section
        state.
        """
        walk = sample_walk(self.model, params, section_state, self.period_n)
        return guess_from_walk(self.system, params, walk)

    @eqx.filter_jit
    def shift_first_step(
        self, step_index: int, params: WheelParams, collocation_state: CollocationState
    ) -> CollocationState:
        """Return the same cycle with the step of this index as the first one."""
        previous_end = collocation_state.ends[step_index - 1]
        landing = transitions.land(params.symbols(), previous_end[0], *previous_end[2:])
        solution, is_active, ends = jax.tree.map(
            lambda x: jnp.roll(x, -step_index, 0),
            (collocation_state.solution, collocation_state.phase_active, collocation_state.ends),
        )
        section_state = jnp.stack([landing.theta, landing.motion.dtheta])
        return collocation_state._replace(
            solution=solution._replace(section_state=section_state),
            phase_active=is_active,
            ends=ends,
        )

    def transfer_to_mesh(
        self, system: CollocationSystem, collocation_state: CollocationState
    ) -> CollocationState:
        """Return a start on this finder's mesh from a solution on the mesh of `system`."""
        solution = transfer_to_mesh(system, self.system, collocation_state.solution)
        return collocation_state._replace(solution=solution)

    @eqx.filter_jit
    def initial_guess(self, values: Values) -> CollocationState:
        start = surface_start(self.system, values[:, None], jnp.ones((1,), bool))
        return jax.tree.map(lambda x: x[..., 0], start)

    def find_gait(self, values: Values, guess: CollocationState) -> Gait:
        cycle, d_cycle = cycle_with_jacobian(self.system, values, guess)
        section_state, section_state_derivatives = cycle.section_state, d_cycle.section_state
        step, d_step = step_with_jacobian(
            self.model,
            self.n_legs,
            values,
            section_state,
            section_state_derivatives,
            self.step_options,
        )
        gait_coordinates = lambda cycle: jnp.concatenate([cycle.section_state, cycle.durations], -1)
        branch_point = (
            gait_coordinates(cycle),
            gait_coordinates(d_cycle),
            cycle.collocation_state.phase_active,
            cycle.monodromy_value,
        )
        return Gait(cycle, step, d_cycle, d_step, BranchPoint(*branch_point))

    def measure_gait(self, values: Values, guess: Any, names: tuple[str, ...]) -> GaitMeasures:
        if set(names) <= set(self.cycle_measures):
            return measure_from_cycle(self, values, guess, names)
        cycle: Any = None if guess is None else self.find_cycle_from_values(values, guess)
        start = self.initial_guess(values) if cycle is None else cycle.collocation_state
        return measure_from_gait(self.find_gait(values, start), type(self).read_measure, names)

    def slope_response(
        self, params: WheelParams, cycle: Any, names: Sequence[str]
    ) -> SlopeResponse:
        """Return the response from the collocation if it determines the measures, else from the
        event-driven step.
        """
        if not set(names) <= set(COLLOCATION_RESPONSE_MEASURES):
            return super().slope_response(params, cycle, names)
        response: SlopeResponse = cycle.slope_response
        return response.select([COLLOCATION_RESPONSE_MEASURES.index(name) for name in names])

    def precompile(self, params: WheelParams) -> None:
        values = stack_parameters(params)
        section_state = jnp.asarray(self.model.default_start(params), values.dtype)
        section_state_derivatives = jnp.zeros(
            (len(PARAMETER_NAMES), section_state.shape[0]), section_state.dtype
        )
        with ThreadPoolExecutor(2) as compile_threads:
            cycle = compile_threads.submit(
                with_default_settings(cycle_with_jacobian),
                self.system,
                values,
                self.initial_guess(values),
            )
            step = compile_threads.submit(
                with_default_settings(step_with_jacobian),
                self.model,
                self.n_legs,
                values,
                section_state,
                section_state_derivatives,
                self.step_options,
            )
            cycle.result(), step.result()


@eqx.filter_jit
def cycle_with_jacobian(
    system: CollocationSystem, values: Array, guess: CollocationState
) -> tuple[LimitCycle, LimitCycle]:
    """Return the cycle near `guess`, and its derivatives with respect to all parameters, which
    lead its axes.
    """

    find_cycle = lambda values: find_limit_cycle(
        wheel_from_parameters(values, system.n_legs), system, guess
    )
    cycle, jacobian = value_and_jacobian(find_cycle, values)
    return cycle, move_derivative_axis_first(jacobian)


@eqx.filter_jit
def step_with_jacobian(
    model: ViscoelasticWheel,
    n_legs: int,
    values: Array,
    section_state: Array,
    section_state_derivatives: Array,
    options: StepOptions,
) -> tuple[StepResult, StepResult]:
    """Return one step, and its derivatives with respect to all parameters if its start moves with
    them.

    `section_state_derivatives` are those of the section state from which the step starts.
    """

    n_values = values.shape[0]
    take_step = lambda inputs: model.take_step(
        wheel_from_parameters(inputs[:n_values], n_legs), inputs[n_values:], options
    )
    step, jacobian = value_and_jacobian(take_step, jnp.concatenate([values, section_state]))
    input_tangents = jnp.concatenate(
        [jnp.eye(n_values, dtype=section_state.dtype), section_state_derivatives], axis=1
    )
    return step, move_derivative_axis_first(
        jax.tree.map(lambda derivative: derivative @ input_tangents.T, jacobian)
    )
