"""Gaits of the paper's model: one algebraic system for the cycle, and one step as a check."""

import dataclasses
from concurrent.futures import ThreadPoolExecutor
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from vrw_jax.cycles.collocated import (
    LimitCycle,
    guess_along,
    on_mesh,
    sampled_walk,
    solved,
)
from vrw_jax.cycles.cycle import MEASURED, AbstractCycle
from vrw_jax.cycles.finder import (
    AbstractGaitFinder,
    Gait,
    Measured,
    OnBranch,
    Values,
    leading,
    measured_by_cycle,
    measured_of,
)
from vrw_jax.cycles.options import CycleOptions
from vrw_jax.cycles.search import Located, Problem, surface_start
from vrw_jax.models import AbstractStep, SectionState, StepResult, ViscoelasticWheel
from vrw_jax.numerics import Options, with_jacobian
from vrw_jax.results import MARGINS, MEASURES
from vrw_jax.walks import checked
from vrw_jax.wheel import PARAMETER_NAMES, WheelParams, parameters_of, transitions, wheel_of


class CollocationFinder(AbstractGaitFinder):
    """Finder of limit cycles that needs no start. `period_n` applies to `find_cycle` alone."""

    model: ViscoelasticWheel
    n_legs: int = eqx.field(static=True)
    step_options: Options
    options: CycleOptions = eqx.field(static=True)
    period_n: int = eqx.field(static=True)

    options_type: ClassVar[type] = CycleOptions
    of_cycle: ClassVar[tuple[str, ...]] = tuple(MEASURED)
    readable: ClassVar[tuple[str, ...]] = (
        *of_cycle, "energy_lost_landing", "energy_lost_stopper", "energy_lost_damping",
        *(n for n in MARGINS if n not in MEASURED),
    )  # fmt: skip
    differentiable: ClassVar[tuple[str, ...]] = tuple(n for n in readable if not MEASURES[n].axis)
    from_nothing: ClassVar[bool] = True
    usual: ClassVar[tuple[str, ...]] = tuple(n for n in of_cycle if n != "spectral_margin")

    @classmethod
    def of(
        cls, model: Any, n_legs: int, step: Options, period_n: int, cycle: CycleOptions
    ) -> "CollocationFinder":
        return cls(model, n_legs, step, cycle, period_n)

    @property
    def options_used(self) -> CycleOptions:
        return self.options

    @property
    def problem(self) -> Problem:
        return Problem(self.n_legs, self.period_n, self.options, self.model.stop_at_lift_off)

    def finer(self) -> "CollocationFinder":
        return dataclasses.replace(self, options=self.options.finer())

    @classmethod
    def read(cls, name: str, cycle: AbstractCycle, step: AbstractStep) -> Array:
        """Return a measure of a gait by name.

        If the foot scuffs at take-off, the clearance in SLS-I is that in SLS-II, because it would
        jump otherwise. Callers must check `takeoff_acceleration` too.
        """
        value = cycle.measure(name) if name in cls.of_cycle else step.measures()[name]
        if name == "clearance_sls1":
            scuffs = cycle.measure("takeoff_acceleration") < 0.0
            return jnp.where(scuffs, step.measures()["clearance_sls2"], value)
        return value

    def cycle(self, params: WheelParams, guess: Any = None) -> LimitCycle:
        if isinstance(guess, LimitCycle) and guess.problem == self.problem:
            guess = guess.located
        elif guess is not None and not isinstance(guess, Located):
            x = guess.section_state if isinstance(guess, AbstractCycle) else guess
            params, state, _, _ = checked(params, x, None, None)
            guess = self.after(*lax.stop_gradient((params, state)))
        return dataclasses.replace(solved(params, self.problem, guess), model=self.model)

    def after(self, params: WheelParams, x: SectionState) -> Located:
        """Return a start of the search: the next `period_n` steps of a walk from section
        state `x`."""
        walked = sampled_walk(self.model, params, x, self.period_n)
        return guess_along(self.problem, params, walked)

    @eqx.filter_jit
    def counted_from(self, step: int, params: WheelParams, located: Located) -> Located:
        """Return the same cycle with another of its steps as the first one."""
        before = located.ends[step - 1]
        landing = transitions.land(params.symbols(), before[0], *before[2:])
        solution, happens, ends = jax.tree.map(
            lambda x: jnp.roll(x, -step, 0), (located.solution, located.happens, located.ends)
        )
        section = jnp.stack([landing.theta, landing.motion.dtheta])
        return located._replace(
            solution=solution._replace(section=section), happens=happens, ends=ends
        )

    def on_mesh(self, problem: Problem, located: Located) -> Located:
        """Return a start on the mesh of `system` from a solution on this finder's mesh."""
        solution = on_mesh(problem, self.problem, located.solution)
        return located._replace(solution=solution)

    @eqx.filter_jit
    def first_guess(self, values: Values) -> Located:
        lane = surface_start(self.problem, values[:, None], jnp.ones((1,), bool))
        return jax.tree.map(lambda x: x[..., 0], lane)

    def find(self, values: Values, guess: Located) -> Gait:
        cycle, d_cycle = cycle_and_columns(self.problem, values, guess)
        x, dx = cycle.section_state, d_cycle.section_state
        step, d_step = step_and_columns(self.model, self.n_legs, values, x, dx, self.step_options)
        posture = lambda cycle: jnp.concatenate([cycle.section_state, cycle.durations], -1)
        told = posture(cycle), posture(d_cycle), cycle.located.happens, cycle.matrix
        return Gait(cycle, step, d_cycle, d_step, OnBranch(*told))

    def measured(self, values: Values, guess: Any, names: tuple[str, ...]) -> Measured:
        if set(names) <= set(self.of_cycle):
            return measured_by_cycle(self, values, guess, names)
        cycle: Any = None if guess is None else self.cycle_of(values, guess)
        near = self.first_guess(values) if cycle is None else cycle.located
        return measured_of(self.find(values, near), type(self).read, names)

    def compile(self, params: WheelParams) -> None:
        values = parameters_of(params)
        x = jnp.asarray(self.model.start(params), values.dtype)
        dx = jnp.zeros((len(PARAMETER_NAMES), x.shape[0]), x.dtype)
        with ThreadPoolExecutor(2) as pool:
            cycle = pool.submit(cycle_and_columns, self.problem, values, self.first_guess(values))
            step = pool.submit(
                step_and_columns, self.model, self.n_legs, values, x, dx, self.step_options
            )
            cycle.result(), step.result()


@eqx.filter_jit
def cycle_and_columns(
    problem: Problem, values: Array, guess: Located
) -> tuple[LimitCycle, LimitCycle]:
    """Return the cycle near `guess`, and its derivatives with respect to all parameters as a
    leading axis."""

    find = lambda values: solved(wheel_of(values, problem.n_legs), problem, guess)
    cycle, columns = with_jacobian(find, values)
    return cycle, leading(columns)


@eqx.filter_jit
def step_and_columns(
    model: ViscoelasticWheel, n_legs: int, values: Array, x: Array, dx: Array, options: Options
) -> tuple[StepResult, StepResult]:
    """Return one step and its derivatives with respect to all parameters if its start moves by `dx`
    with them."""

    n = values.shape[0]
    take = lambda inputs: model.step(wheel_of(inputs[:n], n_legs), inputs[n:], options)
    step, jacobian = with_jacobian(take, jnp.concatenate([values, x]))
    moved = jnp.concatenate([jnp.eye(n, dtype=x.dtype), dx], axis=1)
    return step, leading(jax.tree.map(lambda by_inputs: by_inputs @ moved.T, jacobian))
