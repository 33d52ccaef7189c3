"""How a rung's gait is found, checked and differentiated: one face, one finder for each rung."""

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
"""Largest distance, rad, rad/s and m/s, between a cycle's section state and where the event-driven
step takes it: two independent computations, whose errors at the default options are a tenth of it
while steps last some 1.5 s."""

Values = Float[Array, " n_values"]
"""Numbers of `AbstractWheel.parameter_names`."""


class OnBranch(NamedTuple):
    """A gait as a point of a branch: what `same_branch` looks at."""

    posture: Any  # section state and durations
    d_posture: Any  # leading axis: the rung's numbers
    order: Any  # what may not change along a branch: which phases happen
    returns: Any  # derivative of the return to the section


class Gait(eqx.Module):
    """A gait that repeats after one step, that step, and how both move with the parameters.

    Derivatives are along the branch of gaits and have a leading axis over the parameters' names.
    A batch of gaits has its axis before all others.
    """

    cycle: AbstractCycle
    step: AbstractStep  # event by event, from the cycle's section state
    d_cycle: AbstractCycle
    d_step: AbstractStep
    on_branch: OnBranch

    @property
    def outcome(self) -> np.ndarray:
        """The cycle's outcome, unless the step from it fails or ends elsewhere."""
        cycle, step = self.cycle, self.step
        return confirmed(cycle.outcome, cycle.section_state, step.outcome, step.section_state)


def same_branch(here: OnBranch, there: OnBranch, change: np.ndarray) -> bool:
    """Whether a branch leads from one gait to the other when the rung's numbers change so.

    The mean of both ends' slopes must account for most of the way between the gaits, the same
    phases must happen, and no multiplier may have passed through 1.
    """
    here, there = taken((here, there), ...)
    predicted = change @ (0.5 * (here.d_posture + there.d_posture))
    missed = np.linalg.norm(there.posture - here.posture - predicted)
    if missed > 0.5 * np.linalg.norm(predicted) + 1e-6:
        return False
    fold = lambda told: np.linalg.det(np.eye(len(told.returns)) - told.returns)
    return bool(np.array_equal(here.order, there.order) and fold(here) * fold(there) > 0.0)


def confirmed(outcome: Any, state: Any, walked: Any, reached: Any) -> np.ndarray:
    """Outcomes of cycles with these section states, from which a step was walked to `reached`."""
    agrees = np.max(np.abs(np.asarray(reached) - np.asarray(state)), axis=-1) <= AGREEMENT
    step = np.where(agrees, Outcome.STEPPED, Outcome.MESH_TOO_COARSE)
    step = np.where(np.asarray(walked) == Outcome.STEPPED, step, np.asarray(walked))
    return np.where(np.asarray(outcome) == Outcome.STEPPED, step, np.asarray(outcome))


class AbstractGaitFinder(eqx.Module):
    """Finds gaits of one rung. Rooms above ask this face alone, and `finder_of` which one it is."""

    model: eqx.AbstractVar[AbstractWheel]
    n_legs: eqx.AbstractVar[int]
    step_options: eqx.AbstractVar[Options]
    options_type: eqx.AbstractClassVar[type]  # what `limit_cycle` takes as its options
    of_cycle: eqx.AbstractClassVar[tuple[str, ...]]  # measures that the cycle tells by itself
    differentiable: eqx.AbstractClassVar[tuple[str, ...]]
    """Measures with derivatives along the branch, one number each."""
    usual: eqx.AbstractClassVar[tuple[str, ...]]  # of them, where nothing is asked for
    readable: eqx.AbstractClassVar[tuple[str, ...]]  # `differentiable`, and those of several legs
    from_nothing: eqx.AbstractClassVar[bool]  # whether a search needs no start nearby
    coexisting: ClassVar[bool] = False
    """Whether several gaits of a wheel may attract, which walks from several starts tell apart."""

    @classmethod
    @abc.abstractmethod
    def of(
        cls, model: Any, n_legs: int, step: Options, period_n: int, cycle: CycleOptions
    ) -> "AbstractGaitFinder":
        """The finder with the options of its step, and of its search if that has its own."""

    @property
    def options_used(self) -> Any:
        """Those of `options_type`."""
        return self.step_options

    @abc.abstractmethod
    def cycle(self, params: WheelParams, guess: Any = None) -> AbstractCycle:
        """The cycle of a wheel near `guess`: a neighbour's `near`, a section state or nothing."""

    def cycles(self, params: WheelParams, guess: Any = None) -> Any:
        """Those of a batch of wheels; every array gains a leading axis."""
        return jax.vmap(self.cycle)(params, guess)

    @abc.abstractmethod
    def first_guess(self, values: Values) -> Any:
        """Where a search begins that knows no neighbour."""

    def first_guesses(self, values: Float[Array, "lanes n_values"]) -> Any:
        return jax.vmap(self.first_guess)(values)

    @abc.abstractmethod
    def find(self, values: Values, guess: Any) -> Gait:
        """The gait near `guess`, with its derivatives; the large programs are compiled once."""

    def find_many(self, values: Float[Array, "lanes n_values"], guess: Any) -> Gait:
        """`find` of many wheels side by side; every array gains a leading axis."""
        return eqx.filter_vmap(self.find)(values, guess)

    @abc.abstractmethod
    def compile(self, params: WheelParams) -> None:
        """Compile what `find` needs, as much as can be side by side."""

    def step(self, params: WheelParams, x: Array) -> AbstractStep:
        """One step of the rung, by what is compiled already."""
        told: AbstractStep = self.model.step(params, x, self.step_options)
        return told

    def cycle_of(self, values: Values, guess: Any = None) -> AbstractCycle:
        """`cycle`, of the rung's own numbers."""
        model, params = self.model.at(values, self.n_legs)
        return eqx.tree_at(lambda finder: finder.model, self, model).cycle(params, guess)

    def measured(self, values: Values, guess: Any, names: tuple[str, ...]) -> "Measured":
        """Measures of the gait near `guess` with their derivatives, and no more than is asked for.

        Some of `differentiable`; of those on stability they are second derivatives of the motion.
        """
        return measured_by_cycle(self, values, guess, names)

    @classmethod
    def read(cls, name: str, cycle: AbstractCycle, step: AbstractStep) -> Array:
        """A measure of a gait by name; margins of the locked legs have one value for each leg."""
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
    """Derivatives by the rung's numbers, these as the first axis."""
    return jax.tree.map(lambda x: jnp.moveaxis(x, -1, 0), columns)


def along(function: Callable, told: tuple, d_told: tuple) -> tuple[Any, Any]:
    """What a function of cycle and step tells of a gait, and its derivatives along the branch."""
    whole, rest = eqx.partition(told, eqx.is_inexact_array)
    columns = eqx.filter(d_told, eqx.is_inexact_array)
    value = lambda floats: function(*eqx.combine(floats, rest))
    slopes = jax.vmap(lambda column: jax.jvp(value, (whole,), (column,))[1])(columns)
    return value(whole), slopes


@eqx.filter_jit
def read_along(function: Callable, gait: Gait) -> tuple[Any, Any]:
    """`along` of one gait, compiled; `function(cycle, step)`."""
    return along(function, (gait.cycle, gait.step), (gait.d_cycle, gait.d_step))


@eqx.filter_jit
def read_along_lanes(function: Callable, gait: Gait) -> tuple[Any, Any]:
    told = (gait.cycle, gait.step), (gait.d_cycle, gait.d_step)
    return eqx.filter_vmap(lambda told, d_told: along(function, told, d_told))(*told)


@dataclass(frozen=True)
class Readings:
    """Several measures of a gait at once, by name, as a function of cycle and step."""

    read: Callable[[str, AbstractCycle, AbstractStep], Array]
    names: tuple[str, ...]

    def __call__(self, cycle: AbstractCycle, step: AbstractStep) -> dict[str, Array]:
        return {name: self.read(name, cycle, step) for name in self.names}


def measured_of(gait: Gait, read: Callable, names: tuple[str, ...]) -> Measured:
    """Measures of a gait that was found with all of its derivatives."""
    told, slopes = read_along(Readings(read, names), gait)
    stack = lambda values: jnp.stack([values[name] for name in names], -1)
    return Measured(stack(told), stack(slopes).T, gait.cycle.outcome)
