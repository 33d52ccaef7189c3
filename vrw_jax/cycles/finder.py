"""Interface of the gait finders: each finds, checks and differentiates the gaits of one model."""

import abc
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from vrw_jax.cycles.cycle import AbstractCycle
from vrw_jax.cycles.options import CycleOptions
from vrw_jax.models import AbstractStep, AbstractWheel
from vrw_jax.numerics import Options, taken, with_jacobian
from vrw_jax.wheel import Outcome, WheelParams

AGREEMENT = 1e-8
"""Largest distance, rad, rad/s and m/s, between a cycle's section state and the state after the
event-driven step. The two computations are independent. At the default options their errors are a
tenth of it while steps last some 1.5 s."""

Values = Float[Array, " n_values"]
"""Values of `AbstractWheel.parameter_names`."""


class OnBranch(NamedTuple):
    """Gait as a point of a branch: the data that `is_same_branch` compares."""

    posture: Any  # section state and durations
    d_posture: Any  # derivatives, with a leading axis over the model's parameters
    order: Any  # which phases take place: constant along a branch
    returns: Any  # Jacobian of the return map


class Gait(eqx.Module):
    """Gait that repeats after one step, with that step and the derivatives of both.

    Derivatives are taken along the branch of gaits and have a leading axis over the parameters'
    names. A batch of gaits has its axis before all others.
    """

    cycle: AbstractCycle
    step: AbstractStep  # event-driven step from the cycle's section state
    d_cycle: AbstractCycle
    d_step: AbstractStep
    on_branch: OnBranch

    @property
    def outcome(self) -> np.ndarray:
        """Return the cycle's outcome, unless the step from it fails or ends at another state."""
        cycle, step = self.cycle, self.step
        return confirmed(cycle.outcome, cycle.section_state, step.outcome, step.section_state)


def same_branch(here: OnBranch, there: OnBranch, change: np.ndarray) -> bool:
    """Return whether a branch connects two gaits whose parameters differ by `parameter_change`.

    The mean of the tangents at both ends must predict most of the distance between the gaits. The
    same phases must take place, and no multiplier may have crossed 1.
    """
    here, there = taken((here, there), ...)
    predicted = change @ (0.5 * (here.d_posture + there.d_posture))
    missed = np.linalg.norm(there.posture - here.posture - predicted)
    if missed > 0.5 * np.linalg.norm(predicted) + 1e-6:
        return False
    fold = lambda told: np.linalg.det(np.eye(len(told.returns)) - told.returns)
    return bool(np.array_equal(here.order, there.order) and fold(here) * fold(there) > 0.0)


def confirmed(outcome: Any, state: Any, walked: Any, reached: Any) -> np.ndarray:
    """Return outcomes of cycles with section states `state`, checked by a step that ends at
    `end_state`."""
    agrees = np.max(np.abs(np.asarray(reached) - np.asarray(state)), axis=-1) <= AGREEMENT
    step = np.where(agrees, Outcome.STEPPED, Outcome.MESH_TOO_COARSE)
    step = np.where(np.asarray(walked) == Outcome.STEPPED, step, np.asarray(walked))
    return np.where(np.asarray(outcome) == Outcome.STEPPED, step, np.asarray(outcome))


class AbstractGaitFinder(eqx.Module):
    """Finder of the gaits of one model. Higher packages use this interface only; `make_finder`
    selects the class."""

    model: eqx.AbstractVar[AbstractWheel]
    n_legs: eqx.AbstractVar[int]
    step_options: eqx.AbstractVar[Options]
    options_type: eqx.AbstractClassVar[type]  # type of the options that `limit_cycle` accepts
    of_cycle: eqx.AbstractClassVar[tuple[str, ...]]  # measures that need the cycle alone
    differentiable: eqx.AbstractClassVar[tuple[str, ...]]
    """Scalar measures that have derivatives along the branch."""
    usual: eqx.AbstractClassVar[tuple[str, ...]]  # the measures returned by default
    readable: eqx.AbstractClassVar[tuple[str, ...]]  # and those of several legs
    from_nothing: eqx.AbstractClassVar[bool]  # whether a search works without a start nearby
    coexisting: ClassVar[bool] = False
    """Whether several gaits of a wheel may attract, which walks from several starts distinguish."""

    @classmethod
    @abc.abstractmethod
    def of(
        cls, model: Any, n_legs: int, step: Options, period_n: int, cycle: CycleOptions
    ) -> "AbstractGaitFinder":
        """Return the finder with the options of its step, and of its search if that has separate
        options."""

    @property
    def options_used(self) -> Any:
        """Return the options of the search, of type `options_type`."""
        return self.step_options

    @abc.abstractmethod
    def cycle(self, params: WheelParams, guess: Any = None) -> AbstractCycle:
        """Return the cycle of a wheel near `guess`: a neighbor's `warm_start`, a section state or
        None."""

    def cycles(self, params: WheelParams, guess: Any = None) -> Any:
        """Return the cycles of a batch of wheels; every array gains a leading axis."""
        return jax.vmap(self.cycle)(params, guess)

    @abc.abstractmethod
    def first_guess(self, values: Values) -> Any:
        """Return the start of a search for a wheel without a known neighbor."""

    def first_guesses(self, values: Float[Array, "lanes n_values"]) -> Any:
        return jax.vmap(self.first_guess)(values)

    @abc.abstractmethod
    def find(self, values: Values, guess: Any) -> Gait:
        """Return the gait near `guess` with its derivatives. The large programs are compiled
        once."""

    def find_many(self, values: Float[Array, "lanes n_values"], guess: Any) -> Gait:
        """Return `find_gait` of a batch of wheels; every array gains a leading axis."""
        return eqx.filter_vmap(self.find)(values, guess)

    @abc.abstractmethod
    def compile(self, params: WheelParams) -> None:
        """Compile the programs that `find_gait` needs, in parallel where possible."""

    def step(self, params: WheelParams, x: Array) -> AbstractStep:
        """Return one step of the model, computed by an already compiled program."""
        told: AbstractStep = self.model.step(params, x, self.step_options)
        return told

    def cycle_of(self, values: Values, guess: Any = None) -> AbstractCycle:
        """Return `find_cycle` as a function of the model's own parameter values."""
        model, params = self.model.at(values, self.n_legs)
        return eqx.tree_at(lambda finder: finder.model, self, model).cycle(params, guess)

    def measured(self, values: Values, guess: Any, names: tuple[str, ...]) -> "Measured":
        """Return the requested measures of the gait near `guess` with their derivatives.

        `names` are some of `differentiable_measures`. Derivatives of stability measures are second
        derivatives of the motion.
        """
        return measured_by_cycle(self, values, guess, names)

    @classmethod
    def read(cls, name: str, cycle: AbstractCycle, step: AbstractStep) -> Array:
        """Return a measure of a gait by name. Margins of the locked legs have one value for each
        leg."""
        return cycle.measure(name) if name in cls.of_cycle else step.measures()[name]


class Measured(NamedTuple):
    values: Float[Array, " n_names"]
    slopes: Float[Array, "n_names n_values"]
    outcome: Array


@eqx.filter_jit
def measured_by_cycle(
    finder: AbstractGaitFinder, values: Values, guess: Any, names: tuple[str, ...]
) -> Measured:
    def told(values: Values) -> tuple[Array, Array]:
        cycle = finder.cycle_of(values, guess)
        return jnp.stack(list(cycle.measures(names).values())), cycle.outcome

    (measures, outcome), (slopes, _) = with_jacobian(told, values)
    return Measured(measures, slopes, outcome)


def leading(columns: Any) -> Any:
    """Move the axis of the derivatives, which is over the model's parameters, to the front."""
    return jax.tree.map(lambda x: jnp.moveaxis(x, -1, 0), columns)


def along(function: Callable, told: tuple, d_told: tuple) -> tuple[Any, Any]:
    """Return a function of a gait's cycle and step, and its derivatives along the branch."""
    whole, rest = eqx.partition(told, eqx.is_inexact_array)
    columns = eqx.filter(d_told, eqx.is_inexact_array)
    value = lambda floats: function(*eqx.combine(floats, rest))
    slopes = jax.vmap(lambda column: jax.jvp(value, (whole,), (column,))[1])(columns)
    return value(whole), slopes


@eqx.filter_jit
def read_along(function: Callable, gait: Gait) -> tuple[Any, Any]:
    """Return `value_and_tangents` of `function(cycle, step)` on one gait, compiled."""
    return along(function, (gait.cycle, gait.step), (gait.d_cycle, gait.d_step))


@eqx.filter_jit
def read_along_lanes(function: Callable, gait: Gait) -> tuple[Any, Any]:
    told = (gait.cycle, gait.step), (gait.d_cycle, gait.d_step)
    return eqx.filter_vmap(lambda told, d_told: along(function, told, d_told))(*told)


@dataclass(frozen=True)
class Readings:
    """Several named measures of a gait, as a function of cycle and step."""

    read: Callable[[str, AbstractCycle, AbstractStep], Array]
    names: tuple[str, ...]

    def __call__(self, cycle: AbstractCycle, step: AbstractStep) -> dict[str, Array]:
        return {name: self.read(name, cycle, step) for name in self.names}


def measured_of(gait: Gait, read: Callable, names: tuple[str, ...]) -> Measured:
    """Return measures of a gait that was found with all of its derivatives."""
    told, slopes = read_along(Readings(read, names), gait)
    stack = lambda values: jnp.stack([values[name] for name in names], -1)
    return Measured(stack(told), stack(slopes).T, gait.cycle.outcome)
