"""Objective and constraints of a gait with exact gradients: three compiled functions in turn.

The limit cycle with its derivatives by all parameters, one event-driven step from it with its
derivatives by parameters and section state (joined by the chain rule, so that monitors are followed
along the branch), then what was asked for, read off both. The first two, which take long to
compile, are the same for every tuning problem.
"""

import abc
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from vrw_jax.cycles import (
    TAKE_OFF,
    LimitCycle,
    Located,
    Problem,
    _limit_cycle,
    surface_start,
    takeoff_acceleration,
)
from vrw_jax.models import AbstractWheel, StepResult
from vrw_jax.numerics import Options
from vrw_jax.results import MARGINS
from vrw_jax.wheel import PARAMETER_NAMES, Outcome, WheelParams, parameters_of, wheel_of

Reader = Callable[[LimitCycle, StepResult], Array]

OF_CYCLE: dict[str, Callable[[LimitCycle], Array]] = {
    "dls_fraction": lambda cycle: cycle.dls_fraction,
    "period": lambda cycle: cycle.period,
    "speed": lambda cycle: cycle.speed,
    "step_length": lambda cycle: cycle.step_length,
    "lambda_I4": lambda cycle: cycle.indicators.lambda_I4,
    "lambda_2_plus": lambda cycle: cycle.indicators.lambda_2,
    "lambda_4_plus": lambda cycle: cycle.indicators.lambda_4,
    "spectral_radius": lambda cycle: cycle.spectral_radius,
    "stability_margin": lambda cycle: cycle.stability_margin,
    TAKE_OFF.name: takeoff_acceleration,
}
"""Measures that the cycle tells by itself. The two on stability need second derivatives."""

OF_STEP = ("energy_lost_landing", "energy_lost_stopper", "energy_lost_damping", *MARGINS)
READABLE: tuple[str, ...] = (*OF_CYCLE, *OF_STEP)
"""Names that an objective or a constraint may use."""


def read(name: str, cycle: LimitCycle, step: StepResult) -> Array:
    """A measure by name; margins of the locked legs have one value for each leg.

    The clearance in SLS-I is told as if a foot that scuffs at take-off rose: it would jump there
    otherwise. Whoever reads it must look at `takeoff_acceleration` too.
    """
    if name in OF_CYCLE:
        return OF_CYCLE[name](cycle)
    measures = step.measures()
    if name == "clearance_sls1":
        scuffs = takeoff_acceleration(cycle) < 0.0
        return jnp.where(scuffs, measures["clearance_sls2"], measures[name])
    return measures[name]


@dataclass(frozen=True)
class Weighted:
    """A weighted sum of measures, as an objective."""

    weights: tuple[tuple[str, float], ...]

    def __call__(self, cycle: LimitCycle, step: StepResult) -> Array:
        terms = [weight * read(name, cycle, step) for name, weight in self.weights]
        return sum(terms[1:], start=terms[0])


@dataclass(frozen=True)
class OfCycle:
    """A user's function of the cycle alone, as an objective."""

    function: Callable[[LimitCycle], Array]

    def __call__(self, cycle: LimitCycle, step: StepResult) -> Array:
        return self.function(cycle)


class Gait(NamedTuple):
    """A cycle and the step from it, with what was asked for and its derivatives."""

    cycle: Any  # LimitCycle, or WalkedCycle on real ground
    step: Any  # StepResult, or UnilateralStep
    values: Array  # (1 + n_constraints,): the objective, then the constraints
    columns: Array  # (n_parameters, 1 + n_constraints), in the order of PARAMETER_NAMES
    posture: Array  # section state and durations, which tell branches apart
    posture_columns: Array  # (n_parameters, 6)


def cycle_and_columns(
    problem: Problem, parameters: Array, guess: Located
) -> tuple[LimitCycle, LimitCycle]:
    """The cycle near `guess`, and its derivatives by all parameters as a leading axis."""

    def floats_of(parameters: Array) -> tuple[LimitCycle, tuple[LimitCycle, LimitCycle]]:
        cycle = _limit_cycle(wheel_of(parameters, problem.n_legs), problem, guess)
        floats, rest = eqx.partition(cycle, eqx.is_inexact_array)
        return floats, (floats, rest)

    columns, (floats, rest) = jax.jacfwd(floats_of, has_aux=True)(parameters)
    leading = jax.tree.map(lambda x: jnp.moveaxis(x, -1, 0), columns)
    return eqx.combine(floats, rest), leading


def step_and_columns(
    model: AbstractWheel, n_legs: int, parameters: Array, x: Array, dx: Array, options: Options
) -> tuple[StepResult, StepResult]:
    """One step and its derivatives by all parameters when the start moves by `dx` with them."""

    n = parameters.shape[0]

    def floats_of(inputs: Array) -> tuple:
        result = model.step(wheel_of(inputs[:n], n_legs), inputs[n:], options)
        floats, rest = eqx.partition(result, eqx.is_inexact_array)
        return floats, (floats, rest)

    inputs = jnp.concatenate([parameters, x])
    jacobian, (floats, rest) = jax.jacfwd(floats_of, has_aux=True)(inputs)
    moved = jnp.concatenate([jnp.eye(n, dtype=x.dtype), dx], axis=1)
    along = lambda by_inputs: jnp.moveaxis(by_inputs @ moved.T, -1, 0)
    return eqx.combine(floats, rest), jax.tree.map(along, jacobian)


def values_and_columns(
    objective: Reader,
    constraints: tuple[str, ...],
    cycle: LimitCycle,
    d_cycle: LimitCycle,
    step: StepResult,
    d_step: StepResult,
) -> tuple[Array, Array]:
    """Objective and constraints, and their derivatives along the columns of cycle and step."""
    (cycle, cycle_rest), (step, step_rest) = (
        eqx.partition(tree, eqx.is_inexact_array) for tree in (cycle, step)
    )

    def values(cycle: LimitCycle, step: StepResult) -> Array:
        whole = eqx.combine(cycle, cycle_rest), eqx.combine(step, step_rest)
        told = [jnp.ravel(objective(*whole)), *(jnp.ravel(read(n, *whole)) for n in constraints)]
        return jnp.concatenate(told)

    along = lambda *tangents: jax.jvp(values, (cycle, step), tangents)[1]
    return values(cycle, step), jax.vmap(along)(d_cycle, d_step)


_cycle_and_columns = eqx.filter_jit(cycle_and_columns)
_step_and_columns = eqx.filter_jit(step_and_columns)
_values_and_columns = eqx.filter_jit(values_and_columns)


@eqx.filter_jit
def _cycles_and_columns(
    problem: Problem, parameters: Array, guess: Located
) -> tuple[LimitCycle, LimitCycle]:
    return eqx.filter_vmap(lambda p, g: cycle_and_columns(problem, p, g))(parameters, guess)


@eqx.filter_jit
def _steps_and_columns(
    model: AbstractWheel, n_legs: int, parameters: Array, x: Array, dx: Array, options: Options
) -> tuple[StepResult, StepResult]:
    one = lambda p, x, dx: step_and_columns(model, n_legs, p, x, dx, options)
    return eqx.filter_vmap(one)(parameters, x, dx)


@eqx.filter_jit
def _many_values_and_columns(
    objective: Reader, constraints: tuple[str, ...], *told: LimitCycle | StepResult
) -> tuple[Array, Array]:
    one = lambda *told: values_and_columns(objective, constraints, *told)
    return eqx.filter_vmap(one)(*told)


AGREEMENT = 1e-7
"""Largest distance, rad, rad/s and m/s, between a cycle's section state and where the event-driven
step takes it: the two are independent computations."""


class AbstractEngine(abc.ABC):
    """Evaluates gaits of one tuning problem; a guess is whatever tells where to look for one."""

    model: AbstractWheel
    options: Options

    @abc.abstractmethod
    def first_guess(self, parameters: Array) -> Any:
        """Where a search for a wheel's gait begins that knows no neighbour."""

    @abc.abstractmethod
    def guess_of(self, gait: Gait) -> Any:
        """Where a neighbour's search begins."""

    @abc.abstractmethod
    def __call__(self, parameters: Array, guess: Any) -> Gait:
        """The gait of one wheel near `guess`."""

    @abc.abstractmethod
    def same_branch(self, here: Gait, there: Gait, change: np.ndarray) -> bool:
        """Whether a branch leads from one gait to the other when the parameters change so."""

    @abc.abstractmethod
    def step(self, params: WheelParams, x: np.ndarray) -> Any:
        """One step of the rung."""

    @abc.abstractmethod
    def monitored(self, step: Any) -> dict[str, np.ndarray]:
        """What a single step tells of constraints."""

    @abc.abstractmethod
    def unkept(self, step: Any) -> tuple[str, ...]:
        """Premises of the rung that the step breaks."""

    @abc.abstractmethod
    def compile(self, params: WheelParams) -> None:
        """Compile what is large."""


@dataclass(frozen=True)
class Engine(AbstractEngine):
    """Evaluates gaits of one tuning problem: what is asked for, of which rung, how exactly."""

    objective: Reader
    constraints: tuple[str, ...]
    problem: Problem
    model: AbstractWheel
    options: Options

    def first_guess(self, parameters: Array) -> Located:
        lane = surface_start(self.problem, parameters[:, None], jnp.ones((1,), bool))
        return jax.tree.map(lambda x: x[..., 0], lane)

    def first_guesses(self, parameters: Array) -> Located:
        """The same for many wheels, one row of parameters for each."""
        lanes = surface_start(self.problem, parameters.T, jnp.ones(parameters.shape[:1], bool))
        return jax.tree.map(lambda x: jnp.moveaxis(x, -1, 0), lanes)

    def __call__(self, parameters: Array, guess: Located) -> Gait:
        n_legs = self.problem.n_legs
        cycle, d_cycle = _cycle_and_columns(self.problem, parameters, guess)
        x, dx = cycle.section_state, d_cycle.section_state
        step, d_step = _step_and_columns(self.model, n_legs, parameters, x, dx, self.options)
        told = _values_and_columns(self.objective, self.constraints, cycle, d_cycle, step, d_step)
        return _gait(cycle, d_cycle, step, told)

    def guess_of(self, gait: Gait) -> Located:
        return gait.cycle.located

    def same_branch(self, here: Gait, there: Gait, change: np.ndarray) -> bool:
        return same_branch(here, there, change)

    def monitored(self, step: StepResult) -> dict[str, np.ndarray]:
        return {name: np.array(getattr(step.monitors, name)) for name in MARGINS}

    def unkept(self, step: StepResult) -> tuple[str, ...]:
        return tuple(name for name, value in self.monitored(step).items() if np.min(value) < 0.0)

    def step(self, params: WheelParams, x: np.ndarray) -> StepResult:
        """One step by the function that is compiled already, with its derivatives thrown away."""
        parameters, start = parameters_of(params), jnp.asarray(x)
        still = jnp.zeros((parameters.shape[0], start.shape[0]), start.dtype)
        return _step_and_columns(self.model, params.n_legs, parameters, start, still, self.options)[
            0
        ]

    def batch(self, parameters: Array, guess: Located) -> Gait:
        """The gaits of many wheels side by side; every array gains a leading axis."""
        n_legs = self.problem.n_legs
        cycle, d_cycle = _cycles_and_columns(self.problem, parameters, guess)
        x, dx = cycle.section_state, d_cycle.section_state
        step, d_step = _steps_and_columns(self.model, n_legs, parameters, x, dx, self.options)
        told = _many_values_and_columns(
            self.objective, self.constraints, cycle, d_cycle, step, d_step
        )
        return _gait(cycle, d_cycle, step, told)

    def compile(self, params: WheelParams) -> None:
        """Compile the two large functions side by side."""
        parameters = parameters_of(params)
        x = jnp.asarray(self.model.start(params), parameters.dtype)
        dx = jnp.zeros((len(PARAMETER_NAMES), x.shape[0]), x.dtype)
        guess = self.first_guess(parameters)
        with ThreadPoolExecutor(2) as pool:
            cycle = pool.submit(_cycle_and_columns, self.problem, parameters, guess)
            step = pool.submit(
                _step_and_columns, self.model, params.n_legs, parameters, x, dx, self.options
            )
            cycle.result(), step.result()


def _gait(
    cycle: LimitCycle, d_cycle: LimitCycle, step: StepResult, told: tuple[Array, Array]
) -> Gait:
    posture = lambda c: jnp.concatenate([c.section_state, c.durations], -1)
    return Gait(cycle, step, *told, posture(cycle), posture(d_cycle))


def outcome_of(gait: Gait) -> Outcome:
    """The cycle's outcome, unless the event-driven step from it fails or ends elsewhere."""
    if int(gait.cycle.outcome) != Outcome.STEPPED:
        return Outcome(int(gait.cycle.outcome))
    if int(gait.step.outcome) != Outcome.STEPPED:
        return Outcome(int(gait.step.outcome))
    away = np.max(np.abs(gait.step.section_state - gait.cycle.section_state))
    return Outcome.STEPPED if away <= AGREEMENT else Outcome.NO_CYCLE_FOUND


Told = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]
"""Posture, its columns, which phases happen, and the monodromy matrix of one gait."""


def same_branch(here: Gait, there: Gait, change: np.ndarray) -> bool:
    """Whether a branch leads from one gait to the other when the parameters change so."""
    told = [
        (gait.posture, gait.posture_columns, gait.cycle.located.happens, gait.cycle.matrix)
        for gait in (here, there)
    ]
    first, second = (tuple(np.asarray(x) for x in some) for some in told)
    return is_same_branch(first, second, change)  # type: ignore[arg-type]


def is_same_branch(here: Told, there: Told, change: np.ndarray) -> bool:
    """See `same_branch`.

    The mean of both ends' slopes must account for most of the way between the gaits, the same
    phases must happen, and no multiplier may have passed through 1.
    """
    predicted = change @ (0.5 * (here[1] + there[1]))
    missed = np.linalg.norm(there[0] - here[0] - predicted)
    if missed > 0.5 * np.linalg.norm(predicted) + 1e-6:
        return False
    fold = lambda told: np.linalg.det(np.eye(len(told[3])) - told[3])
    return bool(np.array_equal(here[2], there[2]) and fold(here) * fold(there) > 0.0)
