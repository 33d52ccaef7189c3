"""Interface of gait finders, each of which finds, checks and differentiates one model's gaits."""

import abc
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from vrw_jax.cycles.cycle import AbstractCycle
from vrw_jax.cycles.options import CycleOptions
from vrw_jax.cycles.slope_response import SlopeResponse, compute_step_slope_response
from vrw_jax.models import AbstractStep, AbstractWheel
from vrw_jax.numerics import StepOptions, evaluate_with_jacobian, select_tree_rows
from vrw_jax.wheel import Outcome, WheelParams

STATE_AGREEMENT_TOLERANCE = 1e-8
"""Largest distance, rad, rad/s and m/s, between a cycle's section state and the state after the
event-driven step. The two computations are independent. At the default options the errors of both
are a tenth of this limit, for steps of up to some 1.5 s."""

ParameterValues = Float[Array, " n_values"]
"""Values of the parameters `AbstractWheel.parameter_names`, in that order."""


class BranchPoint(NamedTuple):
    """Gait as a point of a branch, with the data that `is_same_branch` compares."""

    gait_coordinates: Any  # section state and durations
    # derivatives of the coordinates, with a leading axis over the model's parameters
    coordinate_derivatives: Any
    is_phase_active: Any  # which phases take place, constant along a branch
    return_map_jacobian: Any  # Jacobian of the return map


class Gait(eqx.Module):
    """Gait that repeats after one step, with its event-driven step and the derivatives of both.

    Derivatives are taken along the branch of gaits and have a leading axis over the parameters. In
    a batch of gaits, the batch axis comes first.
    """

    cycle: AbstractCycle
    step: AbstractStep  # event-driven step from the cycle's section state
    cycle_derivatives: AbstractCycle
    step_derivatives: AbstractStep
    branch_point: BranchPoint

    @property
    def outcome(self) -> np.ndarray:
        """Return the cycle's outcome, or the failure of the step from the cycle's state.

        A step that ends at another state is a failure.
        """
        cycle, step = self.cycle, self.step
        return confirm_outcome_by_step(
            cycle.outcome, cycle.section_state, step.outcome, step.section_state
        )


def is_same_branch(
    first_point: BranchPoint, second_point: BranchPoint, parameter_change: np.ndarray
) -> bool:
    """Return whether a branch connects two gaits whose parameters differ by `parameter_change`.

    The mean of the tangents at both gaits must predict most of the distance between the gaits. The
    same phases must take place, and no multiplier may have crossed 1.
    """
    first_point, second_point = select_tree_rows((first_point, second_point), ...)
    predicted_change = parameter_change @ (
        0.5 * (first_point.coordinate_derivatives + second_point.coordinate_derivatives)
    )
    prediction_error = np.linalg.norm(
        second_point.gait_coordinates - first_point.gait_coordinates - predicted_change
    )
    if prediction_error > 0.5 * np.linalg.norm(predicted_change) + 1e-6:
        return False
    fold_test_function = lambda branch_point: np.linalg.det(
        np.eye(len(branch_point.return_map_jacobian)) - branch_point.return_map_jacobian
    )
    return bool(
        np.array_equal(first_point.is_phase_active, second_point.is_phase_active)
        and fold_test_function(first_point) * fold_test_function(second_point) > 0.0
    )


def confirm_outcome_by_step(
    cycle_outcomes: Any, section_states: Any, step_outcomes: Any, end_states: Any
) -> np.ndarray:
    """Return the outcomes of cycles, each confirmed by an event-driven step.

    The step begins at `section_states` and ends at `end_states`, which must be the same.
    """
    ends_at_same_state = (
        np.max(np.abs(np.asarray(end_states) - np.asarray(section_states)), axis=-1)
        <= STATE_AGREEMENT_TOLERANCE
    )
    confirmed_outcome = np.where(ends_at_same_state, Outcome.STEPPED, Outcome.MESH_TOO_COARSE)
    confirmed_outcome = np.where(
        np.asarray(step_outcomes) == Outcome.STEPPED, confirmed_outcome, np.asarray(step_outcomes)
    )
    return np.where(
        np.asarray(cycle_outcomes) == Outcome.STEPPED, confirmed_outcome, np.asarray(cycle_outcomes)
    )


class AbstractGaitFinder(eqx.Module):
    """Finder of the gaits of one model.

    Higher packages use only this interface. `make_finder` selects the class.
    """

    model: eqx.AbstractVar[AbstractWheel]
    n_legs: eqx.AbstractVar[int]
    step_options: eqx.AbstractVar[StepOptions]
    options_type: eqx.AbstractClassVar[type]  # type of the options that `limit_cycle` accepts
    # names of the measures that need only the cycle
    cycle_measures: eqx.AbstractClassVar[tuple[str, ...]]
    differentiable_measures: eqx.AbstractClassVar[tuple[str, ...]]
    """Names of the scalar measures that have derivatives along the branch."""
    # names of the measures returned by default
    default_measures: eqx.AbstractClassVar[tuple[str, ...]]
    # names of all measures, including those with one value per leg
    readable_measures: eqx.AbstractClassVar[tuple[str, ...]]
    # whether a search works without a start near the gait
    supports_cold_start: eqx.AbstractClassVar[bool]
    is_multistable: ClassVar[bool] = False
    """Whether several gaits of a wheel may attract. If so, walks from several starts distinguish
    these gaits."""

    @classmethod
    @abc.abstractmethod
    def from_options(
        cls,
        model: Any,
        n_legs: int,
        step_options: StepOptions,
        period_n: int,
        cycle_options: CycleOptions,
    ) -> "AbstractGaitFinder":
        """Return the finder with the options of its step, and of its search if it has any."""

    @property
    def search_options(self) -> Any:
        """Return the options of the search, of type `options_type`."""
        return self.step_options

    @abc.abstractmethod
    def find_cycle(self, params: WheelParams, guess: Any = None) -> AbstractCycle:
        """Return the cycle of one wheel near `guess`.

        The guess is a neighbor's `warm_start`, a section state or None.
        """

    def find_cycles(self, params: WheelParams, guess: Any = None) -> Any:
        """Return the cycles of a batch of wheels; every array has a leading axis over wheels."""
        return jax.vmap(self.find_cycle)(params, guess)

    @abc.abstractmethod
    def make_initial_guess(self, parameter_values: ParameterValues) -> Any:
        """Return the start of a search for a wheel without a known neighbor."""

    def make_initial_guesses(self, parameter_values: Float[Array, "lanes n_values"]) -> Any:
        """Return `make_initial_guess` of a batch of wheels."""
        return jax.vmap(self.make_initial_guess)(parameter_values)

    @abc.abstractmethod
    def find_gait(self, parameter_values: ParameterValues, guess: Any) -> Gait:
        """Return the gait near `guess` with its derivatives.

        The large programs are compiled once.
        """

    def find_gaits(self, parameter_values: Float[Array, "lanes n_values"], guess: Any) -> Gait:
        """Return `find_gait` of a batch of wheels; every array has a leading axis over wheels."""
        return eqx.filter_vmap(self.find_gait)(parameter_values, guess)

    @abc.abstractmethod
    def precompile(self, params: WheelParams) -> None:
        """Compile the programs that `find_gait` needs, in parallel if possible."""

    def take_step(self, params: WheelParams, section_state: Array) -> AbstractStep:
        """Return one step of the model from a section state.

        The step runs in a program that is already compiled.
        """
        step: AbstractStep = self.model.take_step(params, section_state, self.step_options)
        return step

    def find_cycle_from_values(
        self, parameter_values: ParameterValues, guess: Any = None
    ) -> AbstractCycle:
        """Return `find_cycle` as a function of the model's parameter values."""
        model, params = self.model.from_values(parameter_values, self.n_legs)
        return eqx.tree_at(lambda finder: finder.model, self, model).find_cycle(params, guess)

    def measure_gait(
        self, parameter_values: ParameterValues, guess: Any, measure_names: tuple[str, ...]
    ) -> "GaitMeasures":
        """Return the requested measures of the gait near `guess` with their derivatives.

        `measure_names` are some of `differentiable_measures`. Derivatives of stability measures are
        second derivatives of the motion.
        """
        return measure_on_cycle(self, parameter_values, guess, measure_names)

    def compute_slope_response(
        self, params: WheelParams, cycle: Any, measure_names: Sequence[str]
    ) -> SlopeResponse:
        """Return the linear response of the cycle's step and of measures to the slopes of its two
        lines.
        """
        return _compute_step_slope_response(
            self.model, params, cycle.section_state, tuple(measure_names), self.step_options
        )

    @classmethod
    def read_measure(cls, name: str, cycle: AbstractCycle, step: AbstractStep) -> Array:
        """Return a measure of a gait by name.

        Margins of the locked legs have one value for each leg.
        """
        return cycle.measure(name) if name in cls.cycle_measures else step.measures()[name]


_compute_step_slope_response = eqx.filter_jit(compute_step_slope_response)


class GaitMeasures(NamedTuple):
    """Measures of a gait with their derivatives with respect to the model's parameter values."""

    measure_values: Float[Array, " n_names"]
    parameter_jacobian: Float[Array, "n_names n_values"]
    outcome: Array


@eqx.filter_jit
def measure_on_cycle(
    finder: AbstractGaitFinder,
    parameter_values: ParameterValues,
    guess: Any,
    measure_names: tuple[str, ...],
) -> GaitMeasures:
    """Return measures that need only the cycle, with their derivatives."""

    def measures_and_outcome(parameter_values: ParameterValues) -> tuple[Array, Array]:
        cycle = finder.find_cycle_from_values(parameter_values, guess)
        return jnp.stack(list(cycle.measures(measure_names).values())), cycle.outcome

    (measure_values, outcome), (parameter_jacobian, _) = evaluate_with_jacobian(
        measures_and_outcome, parameter_values
    )
    return GaitMeasures(measure_values, parameter_jacobian, outcome)


def move_derivative_axis_first(derivatives: Any) -> Any:
    """Return a tree whose last axis, over the model's parameters, is moved to the front."""
    return jax.tree.map(lambda x: jnp.moveaxis(x, -1, 0), derivatives)


def compute_value_and_tangents(
    function: Callable, primals: tuple, tangents: tuple
) -> tuple[Any, Any]:
    """Return the value of a function at `primals`, and its JVP along each of the `tangents`.

    Tangents have a leading axis.
    """
    float_primals, other_leaves = eqx.partition(primals, eqx.is_inexact_array)
    float_tangents = eqx.filter(tangents, eqx.is_inexact_array)
    evaluate = lambda all_floats: function(*eqx.combine(all_floats, other_leaves))
    tangents_of_value = jax.vmap(
        lambda tangent: jax.jvp(evaluate, (float_primals,), (tangent,))[1]
    )(float_tangents)
    return evaluate(float_primals), tangents_of_value


@eqx.filter_jit
def evaluate_on_gait(function: Callable, gait: Gait) -> tuple[Any, Any]:
    """Return `function(cycle, step)` of one gait and its derivatives along the branch, compiled."""
    return compute_value_and_tangents(
        function, (gait.cycle, gait.step), (gait.cycle_derivatives, gait.step_derivatives)
    )


@eqx.filter_jit
def evaluate_on_gaits(function: Callable, gait: Gait) -> tuple[Any, Any]:
    """Return `evaluate_on_gait` of a batch of gaits."""
    arguments = (gait.cycle, gait.step), (gait.cycle_derivatives, gait.step_derivatives)
    return eqx.filter_vmap(
        lambda arguments, tangents: compute_value_and_tangents(function, arguments, tangents)
    )(*arguments)


@dataclass(frozen=True)
class MeasureReader:
    """Function of cycle and step that returns several measures by name."""

    read_measure: Callable[[str, AbstractCycle, AbstractStep], Array]
    measure_names: tuple[str, ...]

    def __call__(self, cycle: AbstractCycle, step: AbstractStep) -> dict[str, Array]:
        return {name: self.read_measure(name, cycle, step) for name in self.measure_names}


def measure_on_gait(
    gait: Gait, read_measure: Callable, measure_names: tuple[str, ...]
) -> GaitMeasures:
    """Return measures of a gait from its stored derivatives."""
    measure_values, measure_tangents = evaluate_on_gait(
        MeasureReader(read_measure, measure_names), gait
    )
    stack_measures = lambda parameter_values: jnp.stack(
        [parameter_values[name] for name in measure_names], -1
    )
    return GaitMeasures(
        stack_measures(measure_values), stack_measures(measure_tangents).T, gait.cycle.outcome
    )
