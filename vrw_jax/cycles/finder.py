"""Interface of gait finders, each of which finds, checks and differentiates the gaits of one
model.
"""

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
from vrw_jax.cycles.slope_response import SlopeResponse, step_slope_response
from vrw_jax.models import AbstractStep, AbstractWheel
from vrw_jax.numerics import StepOptions, take_rows, value_and_jacobian
from vrw_jax.wheel import Outcome, WheelParams

STATE_AGREEMENT_TOLERANCE = 1e-8
"""Largest distance, rad, rad/s and m/s, between a cycle's section state and the state after the
event-driven step. The two computations are independent. At the default options their errors are a
tenth of this limit, for steps of up to some 1.5 s.
"""

Values = Float[Array, " n_values"]
"""Values of the parameters `AbstractWheel.parameter_names`, in that order."""


class BranchPoint(NamedTuple):
    """Gait as a point of a branch: the data that `is_same_branch` compares."""

    coordinates: Any  # section state and durations
    # derivatives of the coordinates, with a leading axis over the model's parameters
    d_coordinates: Any
    active_phases: Any  # which phases take place, constant along a branch
    return_jacobian: Any  # Jacobian of the return map


class Gait(eqx.Module):
    """Gait that repeats after one step, with that step and the derivatives of both.

    Derivatives are taken along the branch of gaits and have a leading axis over the parameters. In
    a batch of gaits, the batch axis comes first.
    """

    cycle: AbstractCycle
    step: AbstractStep  # event-driven step from the cycle's section state
    d_cycle: AbstractCycle
    d_step: AbstractStep
    branch_point: BranchPoint

    @property
    def outcome(self) -> np.ndarray:
        """Return the cycle's outcome, unless the step from its state fails or ends at another
        state.
        """
        cycle, step = self.cycle, self.step
        return confirm_outcome(cycle.outcome, cycle.section_state, step.outcome, step.section_state)


def is_same_branch(
    first_point: BranchPoint, second_point: BranchPoint, parameter_change: np.ndarray
) -> bool:
    """Return whether a branch connects two gaits whose parameters differ by `parameter_change`.

    The mean of the tangents at both ends must predict most of the distance between the gaits. The
    same phases must take place, and no multiplier may have crossed 1.
    """
    first_point, second_point = take_rows((first_point, second_point), ...)
    predicted_change = parameter_change @ (
        0.5 * (first_point.d_coordinates + second_point.d_coordinates)
    )
    deviation = np.linalg.norm(
        second_point.coordinates - first_point.coordinates - predicted_change
    )
    if deviation > 0.5 * np.linalg.norm(predicted_change) + 1e-6:
        return False
    fold_test_function = lambda point: np.linalg.det(
        np.eye(len(point.return_jacobian)) - point.return_jacobian
    )
    return bool(
        np.array_equal(first_point.active_phases, second_point.active_phases)
        and fold_test_function(first_point) * fold_test_function(second_point) > 0.0
    )


def confirm_outcome(outcome: Any, state: Any, step_outcome: Any, end_state: Any) -> np.ndarray:
    """Return the outcomes of cycles at section states `state`, confirmed by steps from them that
    end at `end_state`.
    """
    ends_at_same_state = (
        np.max(np.abs(np.asarray(end_state) - np.asarray(state)), axis=-1)
        <= STATE_AGREEMENT_TOLERANCE
    )
    confirmed_outcome = np.where(ends_at_same_state, Outcome.STEPPED, Outcome.MESH_TOO_COARSE)
    confirmed_outcome = np.where(
        np.asarray(step_outcome) == Outcome.STEPPED, confirmed_outcome, np.asarray(step_outcome)
    )
    return np.where(np.asarray(outcome) == Outcome.STEPPED, confirmed_outcome, np.asarray(outcome))


class AbstractGaitFinder(eqx.Module):
    """Finder of the gaits of one model. Higher packages use only this interface; `make_finder`
    selects the class.
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
    """Whether several gaits of a wheel may attract; walks from several starts then distinguish
    them.
    """

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
        """Return the finder with the options of its step, and those of its search if it has any."""

    @property
    def search_options(self) -> Any:
        """Return the options of the search, of type `options_type`."""
        return self.step_options

    @abc.abstractmethod
    def find_cycle(self, params: WheelParams, guess: Any = None) -> AbstractCycle:
        """Return the cycle of one wheel near `guess`: a neighbor's `warm_start`, a section state
        or None.
        """

    def find_cycles(self, params: WheelParams, guess: Any = None) -> Any:
        """Return the cycles of a batch of wheels; every array has a leading axis over wheels."""
        return jax.vmap(self.find_cycle)(params, guess)

    @abc.abstractmethod
    def initial_guess(self, values: Values) -> Any:
        """Return the start of a search for a wheel without a known neighbor."""

    def initial_guesses(self, values: Float[Array, "lanes n_values"]) -> Any:
        return jax.vmap(self.initial_guess)(values)

    @abc.abstractmethod
    def find_gait(self, values: Values, guess: Any) -> Gait:
        """Return the gait near `guess` with its derivatives; the large programs are compiled
        once.
        """

    def find_gaits(self, values: Float[Array, "lanes n_values"], guess: Any) -> Gait:
        """Return `find_gait` of a batch of wheels; every array has a leading axis over wheels."""
        return eqx.filter_vmap(self.find_gait)(values, guess)

    @abc.abstractmethod
    def precompile(self, params: WheelParams) -> None:
        """Compile the programs that `find_gait` needs, in parallel if possible."""

    def take_step(self, params: WheelParams, section_state: Array) -> AbstractStep:
        """Return one step of the model from a section state, computed by a program that is
        already compiled.
        """
        step: AbstractStep = self.model.take_step(params, section_state, self.step_options)
        return step

    def find_cycle_from_values(self, values: Values, guess: Any = None) -> AbstractCycle:
        """Return `find_cycle` as a function of the model's own parameter values."""
        model, params = self.model.from_values(values, self.n_legs)
        return eqx.tree_at(lambda finder: finder.model, self, model).find_cycle(params, guess)

    def measure_gait(self, values: Values, guess: Any, names: tuple[str, ...]) -> "GaitMeasures":
        """Return the requested measures of the gait near `guess` with their derivatives.

        `names` are some of `differentiable_measures`. Derivatives of stability measures are second
        derivatives of the motion.
        """
        return measure_from_cycle(self, values, guess, names)

    def slope_response(
        self, params: WheelParams, cycle: Any, names: Sequence[str]
    ) -> SlopeResponse:
        """Return the linear response of the cycle's step, and of these measures, to the slopes
        of its two lines.
        """
        return _step_slope_response(
            self.model, params, cycle.section_state, tuple(names), self.step_options
        )

    @classmethod
    def read_measure(cls, name: str, cycle: AbstractCycle, step: AbstractStep) -> Array:
        """Return a measure of a gait by name; margins of the locked legs have one value for each
        leg.
        """
        return cycle.measure(name) if name in cls.cycle_measures else step.measures()[name]


_step_slope_response = eqx.filter_jit(step_slope_response)


class GaitMeasures(NamedTuple):
    """Measures of a gait with their derivatives with respect to the model's parameter values."""

    values: Float[Array, " n_names"]
    jacobian: Float[Array, "n_names n_values"]
    outcome: Array


@eqx.filter_jit
def measure_from_cycle(
    finder: AbstractGaitFinder, values: Values, guess: Any, names: tuple[str, ...]
) -> GaitMeasures:
    """Return measures that need only the cycle, with their derivatives."""

    def measures_and_outcome(values: Values) -> tuple[Array, Array]:
        cycle = finder.find_cycle_from_values(values, guess)
        return jnp.stack(list(cycle.measures(names).values())), cycle.outcome

    (measures, outcome), (jacobian, _) = value_and_jacobian(measures_and_outcome, values)
    return GaitMeasures(measures, jacobian, outcome)


def move_derivative_axis_first(derivatives: Any) -> Any:
    """Return a tree whose last axis, over the model's parameters, is moved to the front."""
    return jax.tree.map(lambda x: jnp.moveaxis(x, -1, 0), derivatives)


def value_and_tangents(function: Callable, primals: tuple, tangents: tuple) -> tuple[Any, Any]:
    """Return a function of a gait's cycle and step, and its derivatives along the branch."""
    primal_floats, other_leaves = eqx.partition(primals, eqx.is_inexact_array)
    tangent_floats = eqx.filter(tangents, eqx.is_inexact_array)
    value = lambda all_floats: function(*eqx.combine(all_floats, other_leaves))
    derivatives = jax.vmap(lambda tangent: jax.jvp(value, (primal_floats,), (tangent,))[1])(
        tangent_floats
    )
    return value(primal_floats), derivatives


@eqx.filter_jit
def evaluate_on_gait(function: Callable, gait: Gait) -> tuple[Any, Any]:
    """Return the value of `function(cycle, step)` on one gait and its derivatives along the
    branch, compiled.
    """
    return value_and_tangents(function, (gait.cycle, gait.step), (gait.d_cycle, gait.d_step))


@eqx.filter_jit
def evaluate_on_gaits(function: Callable, gait: Gait) -> tuple[Any, Any]:
    """Return `evaluate_on_gait` of a batch of gaits."""
    arguments = (gait.cycle, gait.step), (gait.d_cycle, gait.d_step)
    return eqx.filter_vmap(
        lambda arguments, tangents: value_and_tangents(function, arguments, tangents)
    )(*arguments)


@dataclass(frozen=True)
class MeasureReader:
    """Function of cycle and step that returns several measures by name."""

    read: Callable[[str, AbstractCycle, AbstractStep], Array]
    names: tuple[str, ...]

    def __call__(self, cycle: AbstractCycle, step: AbstractStep) -> dict[str, Array]:
        return {name: self.read(name, cycle, step) for name in self.names}


def measure_from_gait(gait: Gait, read_measure: Callable, names: tuple[str, ...]) -> GaitMeasures:
    """Return measures of a gait from its stored derivatives."""
    measure_values, jacobian = evaluate_on_gait(MeasureReader(read_measure, names), gait)
    stack_measures = lambda values: jnp.stack([values[name] for name in names], -1)
    return GaitMeasures(
        stack_measures(measure_values), stack_measures(jacobian).T, gait.cycle.outcome
    )
