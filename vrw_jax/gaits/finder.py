"""Define the interface of gait finders.

A gait finder finds, checks and differentiates the gaits of one model.
"""

import abc
import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from vrw_jax.base.options import StepOptions
from vrw_jax.base.results import Measure, Outcome
from vrw_jax.gaits.cycle import AbstractCycle
from vrw_jax.gaits.derivatives import SlopeResponse, compute_step_slope_response
from vrw_jax.lanes.autodiff import evaluate_with_jacobian
from vrw_jax.lanes.batching import select_tree_rows
from vrw_jax.models.measures import (
    FORCE_PEAK_MEASURES,
    MARGIN_MEASURES,
    STEP_MEASURES,
    UNILATERAL_STEP_MEASURES,
    get_measure,
)
from vrw_jax.models.step_results import AbstractStep, combine_steps
from vrw_jax.wheel.params import WheelParams

GAIT_BATCH_SIZES = (1, 8, 64, 512, 4096)
"""Numbers of limit cycles of the paper's model that one Newton iteration computes together."""

STATE_AGREEMENT_TOLERANCE = 1e-8
"""Largest accepted difference between the section states at the start and the end of a gait step.

The start is the section state of a cycle, and the gait step is event-driven. The unit is rad, rad/s
and m/s. Collocation and event-driven step are independent computations. With the default options,
each of them has a tenth of this error for gait steps of up to about 1.5 s.
"""

ParameterValues = Float[Array, " n_parameter_values"]
"""Values of the parameters in `AbstractWheel.parameter_names`, in that order."""


class GaitBranchPoint(NamedTuple):
    """Point of a branch of gaits, with the data that `is_same_branch` compares."""

    gait_coordinates: Any  # section state and durations
    # derivatives of the coordinates, with a leading axis over the model's parameters
    coordinate_derivatives: Any
    is_phase_active: Any  # whether each phase occurs; the same on a whole branch
    return_map_jacobian: Any  # with respect to the section state


class Gait(eqx.Module):
    """Limit cycle of one step, the event-driven step from its section state, and derivatives.

    The derivatives are those of the cycle and of the step with respect to the parameters, along
    the branch of gaits. They have a leading axis over the parameters. In a batch of gaits, the
    batch axis comes first.
    """

    cycle: Any  # an `AbstractCycle`, or a `HybridGait`
    step: Any  # event-driven step from the cycle's section state
    cycle_derivatives: Any
    step_derivatives: Any
    branch_point: GaitBranchPoint

    @property
    def outcome(self) -> np.ndarray:
        """Return the outcome of the cycle, or the failure of the step from its section state.

        The step is also treated as a failure if it ends at another section state.
        """
        return confirm_outcome_by_step(
            self.cycle.outcome,
            self.cycle.section_state,
            self.step.outcome,
            self.step.section_state,
        )


def is_same_branch(
    first_gait_point: GaitBranchPoint,
    second_gait_point: GaitBranchPoint,
    parameter_change: np.ndarray,
) -> np.ndarray:
    """Return whether a branch connects two gaits whose parameters differ by `parameter_change`.

    The mean of the tangents at the two gaits must predict most of the distance between the gaits.
    The same phases must occur in the two gaits, and no multiplier may cross 1 between them. The
    arguments may have a leading axis over a batch of pairs.
    """
    first_gait_point, second_gait_point = select_tree_rows(
        (first_gait_point, second_gait_point), ...
    )
    mean_derivatives = 0.5 * (
        first_gait_point.coordinate_derivatives + second_gait_point.coordinate_derivatives
    )
    predicted_coordinate_change = (parameter_change[..., None, :] @ mean_derivatives)[..., 0, :]
    coordinate_change = second_gait_point.gait_coordinates - first_gait_point.gait_coordinates
    prediction_error = np.linalg.norm(coordinate_change - predicted_coordinate_change, axis=-1)
    max_prediction_error = 0.5 * np.linalg.norm(predicted_coordinate_change, axis=-1) + 1e-6
    is_phase_equal = first_gait_point.is_phase_active == second_gait_point.is_phase_active
    fold_test_function = lambda branch_point: np.linalg.det(
        np.eye(branch_point.return_map_jacobian.shape[-1]) - branch_point.return_map_jacobian
    )
    with np.errstate(invalid="ignore"):  # A missing gait has NaN in its Jacobian.
        has_no_fold = (
            fold_test_function(first_gait_point) * fold_test_function(second_gait_point) > 0.0
        )
    return np.asarray(
        (prediction_error <= max_prediction_error)
        & is_phase_equal.reshape(*parameter_change.shape[:-1], -1).all(-1)
        & has_no_fold
    )


def confirm_outcome_by_step(
    cycle_outcomes: Any, section_states: Any, step_outcomes: Any, end_states: Any
) -> np.ndarray:
    """Return the outcomes of cycles, each confirmed by an event-driven step.

    A step confirms its cycle if its start in `section_states` equals its end in `end_states`.
    """
    state_changes = np.max(np.abs(np.asarray(end_states) - np.asarray(section_states)), axis=-1)
    return np.select(
        [
            np.asarray(cycle_outcomes) != Outcome.STEPPED,
            np.asarray(step_outcomes) != Outcome.STEPPED,
            state_changes <= STATE_AGREEMENT_TOLERANCE,
        ],
        [np.asarray(cycle_outcomes), np.asarray(step_outcomes), Outcome.STEPPED],
        Outcome.MESH_TOO_COARSE,
    )


class AbstractGaitFinder(eqx.Module):
    """Base class of gait finders, each for one model.

    Packages above `gaits` use only this interface. `make_finder` selects the class.
    """

    model: eqx.AbstractVar[Any]
    n_legs: eqx.AbstractVar[int]
    step_options: eqx.AbstractVar[StepOptions]
    options_type: eqx.AbstractClassVar[type]  # type of the options that `limit_cycle` accepts
    # names of measures that depend only on the cycle
    cycle_measures: eqx.AbstractClassVar[tuple[str, ...]]
    differentiable_measures: eqx.AbstractClassVar[tuple[str, ...]]
    """Names of scalar measures that have derivatives on the branch of gaits."""
    # names of measures that are returned by default
    default_measures: eqx.AbstractClassVar[tuple[str, ...]]
    # names of all measures, including measures with one value per leg
    readable_measures: eqx.AbstractClassVar[tuple[str, ...]]
    # whether the search requires no start near the gait
    supports_cold_start: eqx.AbstractClassVar[bool]
    has_own_measures: ClassVar[bool] = False
    """Whether studies accept measures of the user."""
    is_multistable: ClassVar[bool] = False
    """Whether several gaits of a wheel may be attracting. Walks from several starts
    distinguish them.
    """

    @property
    def search_options(self) -> Any:
        """Return the options of the search, which have the type `options_type`."""
        return self.step_options

    @abc.abstractmethod
    def find_cycle(self, params: WheelParams, cycle_guess: Any = None) -> AbstractCycle:
        """Find the cycle of one wheel near `cycle_guess`.

        The guess is the `warm_start` of a similar wheel's cycle, a section state or None.
        """

    def find_cycles(self, params: WheelParams, cycle_guess: Any = None) -> Any:
        """Find the cycles of a batch of wheels, which have a leading axis over the wheels."""
        return jax.vmap(self.find_cycle)(params, cycle_guess)

    @abc.abstractmethod
    def make_initial_guess(self, parameter_values: ParameterValues) -> Any:
        """Return a start of the search for a wheel if no similar wheel is known."""

    def make_initial_guesses(
        self, parameter_values: Float[Array, "lanes n_parameter_values"]
    ) -> Any:
        """Return starts of the search for a batch of wheels."""
        return jax.vmap(self.make_initial_guess)(parameter_values)

    def complete_section_states(
        self, parameter_values: np.ndarray, section_states: np.ndarray
    ) -> np.ndarray:
        """Return section states of the model for those of the paper, of each wheel."""
        return section_states

    @eqx.filter_jit
    def find_gait(self, parameter_values: ParameterValues, cycle_guess: Any) -> Gait:
        """Find the gait near `cycle_guess` and its derivatives, by compiled programs."""
        cycle, jacobian = evaluate_with_jacobian(
            lambda values: self.find_cycle_from_values(values, cycle_guess), parameter_values
        )
        return self.make_gait(cycle, move_derivative_axis_first(jacobian))

    def make_gait(self, cycle: Any, derivatives: Any) -> Gait:
        """Build a gait with the data that identify its branch.

        The active phases do not identify a branch. With unilateral contact the order of events may
        change on a branch.

        - `derivatives`: derivatives of the cycle with respect to the parameters on the branch, with
          a leading axis over the parameters.
        """
        step = self.read_step(cycle)
        if self.leg_period == 1:
            step_derivatives = jax.vmap(self.read_step)(derivatives)
        else:  # Minima of margins are no linear functions of the steps.
            read_numbers = lambda cycle: eqx.filter(self.read_step(cycle), eqx.is_inexact_array)
            _, step_derivatives = compute_value_and_tangents(read_numbers, (cycle,), (derivatives,))
        n = self.n_coordinates
        coordinates = compute_value_and_tangents(
            lambda x, durations: jnp.concatenate([x[:n], durations]),
            (cycle.section_state, step.durations),
            (derivatives.section_state, step_derivatives.durations),
        )
        point = GaitBranchPoint(*coordinates, jnp.ones(1), cycle.monodromy_value[:n, :n])
        return Gait(cycle, step, derivatives, step_derivatives, point)

    @property
    def leg_period(self) -> int:
        """Return the number of steps after which the legs are in the same roles again."""
        return getattr(self.model, "leg_period", 1)

    def read_step(self, cycle: Any) -> Any:
        """Return the step of a cycle from which measures are read, of all legs in turn as one."""
        steps = [jax.tree.map(lambda x, k=k: x[k], cycle.steps) for k in range(self.leg_period)]
        return functools.reduce(combine_steps, steps)

    @property
    def n_coordinates(self) -> int | None:
        """Return the number of entries of a section state that vary, or None for all."""
        return self.model.count_continuous_section_entries(WheelParams(n_legs=self.n_legs))

    def find_gaits(
        self, parameter_values: Float[Array, "lanes n_parameter_values"], cycle_guess: Any
    ) -> Gait:
        """Find the gaits of a batch of wheels and their derivatives.

        The gaits have a leading axis over the wheels.
        """
        return eqx.filter_vmap(self.find_gait)(parameter_values, cycle_guess)

    def precompile_programs(self, params: WheelParams) -> None:
        """Compile the programs of `find_gait`, in parallel if possible."""
        self.find_gait(
            self.model.collect_parameter_values(params), self.model.compute_default_start(params)
        )

    def take_gait_step(self, params: WheelParams, section_state: Array) -> AbstractStep:
        """Compute one event-driven step from a section state, by a program that is
        already compiled.
        """
        return self.model.take_step_of_gait(params, section_state, self.step_options)

    def find_cycle_from_values(
        self, parameter_values: ParameterValues, cycle_guess: Any = None, **search_options: bool
    ) -> Any:
        """Find the cycle near `cycle_guess` for the wheel that `parameter_values` describes.

        - `search_options`: further arguments of `find_cycle`.
        """
        model, params = self.model.from_parameter_values(parameter_values, self.n_legs)
        return eqx.tree_at(lambda gait_finder: gait_finder.model, self, model).find_cycle(
            params, cycle_guess, **search_options
        )

    def refine_cycle_guess(self, parameter_values: ParameterValues, cycle_guess: Any) -> Any:
        """Return a start of `find_gait`, computed from a user's guess of the cycle."""
        return cycle_guess

    def measure_gait(
        self, parameter_values: ParameterValues, cycle_guess: Any, measure_names: tuple[Any, ...]
    ) -> "GaitMeasures":
        """Return measures of the gait near `cycle_guess`, and their derivatives.

        `measure_names` is a selection of `differentiable_measures`. Derivatives of stability
        measures are second derivatives of the motion.
        """
        is_of_cycle = lambda x: isinstance(x, Measure) or x in self.cycle_measures
        if all(map(is_of_cycle, measure_names)) and not self.is_multistable:
            return compute_cycle_measures(self, parameter_values, cycle_guess, measure_names)
        start_state = (
            self.make_initial_guess(parameter_values)
            if cycle_guess is None
            else self.refine_cycle_guess(parameter_values, cycle_guess)
        )
        return compute_gait_measures(
            self.find_gait(parameter_values, start_state), self.measure_reader, measure_names
        )

    @property
    def step_measures(self) -> tuple[str, ...]:
        """Return the names of the measures of a step that have derivatives."""
        known = STEP_MEASURES | MARGIN_MEASURES | UNILATERAL_STEP_MEASURES
        return tuple(name for name in self.differentiable_measures if name in known)

    @property
    def disturbance_unit(self) -> str:
        """Return the unit of the ground's deviations in `compute_slope_response`."""
        return "rad"

    def compute_slope_response(
        self, params: WheelParams, cycle: Any, measure_names: Sequence[str]
    ) -> SlopeResponse:
        """Return the linear response of the cycle's step and measures to the slopes of uneven
        ground.

        A step depends on the slopes of two successive lines of the ground.
        """
        return compute_step_slope_response(
            self.model, params, cycle.section_state, tuple(measure_names), self.step_options
        )

    def get_measure(self, name: str) -> Measure:
        """Return unit and description of a measure of the gaits."""
        return get_measure(name)

    def measure_step(self, params: Any, start: Any, step: Any) -> dict[str, Array]:
        """Return the measures of a step from a section state, or from that of a cycle, by name."""
        return step.measures()

    @property
    def measure_reader(self) -> Callable:
        """Return a function of a measure's name, a cycle and a step that returns the measure."""
        return type(self).read_measure

    @classmethod
    def read_measure(cls, measure_name: Any, cycle: AbstractCycle, step: AbstractStep) -> Array:
        """Return the measure of a gait with the given name.

        Margins of locked legs have one value per leg.
        """
        return (
            cycle.measure(measure_name)
            if isinstance(measure_name, Measure) or measure_name in cls.cycle_measures
            else step.measures()[measure_name]
        )


class GaitMeasures(NamedTuple):
    """Measures of a gait, and their derivatives with respect to the model's parameter values."""

    measure_values: Float[Array, " n_names"]
    parameter_jacobian: Float[Array, "n_names n_parameter_values"]
    outcome: Array


@eqx.filter_jit
def compute_cycle_measures(
    gait_finder: AbstractGaitFinder,
    parameter_values: ParameterValues,
    cycle_guess: Any,
    measure_names: tuple[Any, ...],
) -> GaitMeasures:
    """Return measures that depend only on the cycle, and their derivatives."""

    def compute_measures_and_outcome(parameter_values: ParameterValues) -> tuple[Array, Array]:
        cycle = gait_finder.find_cycle_from_values(parameter_values, cycle_guess)
        return jnp.stack(list(cycle.measures(measure_names).values())), cycle.outcome

    (measure_values, cycle_outcome), (parameter_jacobian, _) = evaluate_with_jacobian(
        compute_measures_and_outcome, parameter_values
    )
    return GaitMeasures(measure_values, parameter_jacobian, cycle_outcome)


def move_derivative_axis_first(derivative_tree: Any) -> Any:
    """Return the tree with the last axis of each array moved to the front.

    The last axis is that of the model's parameters.
    """
    return jax.tree.map(lambda x: jnp.moveaxis(x, -1, 0), derivative_tree)


def compute_value_and_tangents(
    differentiated_function: Callable, input_values: tuple, input_tangents: tuple
) -> tuple[Any, Any]:
    """Return the value of a function at `input_values`, and one JVP for each of the
    `input_tangents`.

    The tangents have a leading axis.
    """
    float_primals, non_float_inputs = eqx.partition(input_values, eqx.is_inexact_array)
    evaluate_at_floats = lambda all_float_inputs: differentiated_function(
        *eqx.combine(all_float_inputs, non_float_inputs)
    )
    return jax.vmap(
        lambda tangent: jax.jvp(evaluate_at_floats, (float_primals,), (tangent,)),
        out_axes=(None, 0),
    )(eqx.filter(input_tangents, eqx.is_inexact_array))


@eqx.filter_jit
def evaluate_on_gait(function_of_cycle_and_step: Callable, gait: Gait) -> tuple[Any, Any]:
    """Evaluate `function_of_cycle_and_step(cycle, step)` for one gait.

    Return the value and its derivatives on the branch of gaits.
    """
    return compute_value_and_tangents(
        function_of_cycle_and_step,
        (gait.cycle, gait.step),
        (gait.cycle_derivatives, gait.step_derivatives),
    )


@eqx.filter_jit
def evaluate_on_gaits(function_of_cycle_and_step: Callable, gait: Gait) -> tuple[Any, Any]:
    """Evaluate `function_of_cycle_and_step(cycle, step)` for each gait of a batch.

    Return the values and their derivatives on the branches of gaits.
    """
    return eqx.filter_vmap(functools.partial(evaluate_on_gait, function_of_cycle_and_step))(gait)


GaitFunction = Callable[[AbstractCycle, AbstractStep], Array]
"""Function of a gait's cycle and of the step from its section state."""

GaitMeasureReader = Callable[[str, AbstractCycle, AbstractStep], Array]
"""Function that returns the measure with a given name of a gait's cycle and step."""


@dataclass(frozen=True)
class MeasureReader:
    """Function that maps a cycle and a step to the measures with the names `measure_names`."""

    read_measure: GaitMeasureReader
    measure_names: tuple[Any, ...]

    def __call__(self, cycle: Any, step: Any) -> dict[str, Array]:
        # One search locates all force peaks.
        peak_names = [name for name in self.measure_names if name in FORCE_PEAK_MEASURES]
        force_peaks = cycle.measures(peak_names) if peak_names else {}
        return {
            getattr(measure_name, "name", measure_name): force_peaks[measure_name]
            if measure_name in force_peaks
            else self.read_measure(measure_name, cycle, step)
            for measure_name in self.measure_names
        }


def compute_gait_measures(
    gait: Gait, read_measure: Callable, measure_names: tuple[Any, ...]
) -> GaitMeasures:
    """Return measures of a gait and their derivatives, computed from the gait's stored
    derivatives.
    """
    measure_values, measure_tangents = evaluate_on_gait(
        MeasureReader(read_measure, measure_names), gait
    )
    stack_measures = lambda parameter_values: jnp.stack(
        [parameter_values[getattr(name, "name", name)] for name in measure_names], -1
    )
    return GaitMeasures(
        stack_measures(measure_values), stack_measures(measure_tangents).T, gait.cycle.outcome
    )
