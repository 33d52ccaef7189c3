"""Gaits of any rung, by Newton's method on its own return map, from a start nearby."""

from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from vrw_jax.cycles.cycle import MEASURED, AbstractCycle
from vrw_jax.cycles.finder import (
    AbstractGaitFinder,
    Gait,
    Values,
    along,
    leading,
)
from vrw_jax.cycles.options import CycleOptions
from vrw_jax.cycles.section_cycle import WalkedCycle, walked_cycle
from vrw_jax.models import AbstractWheel
from vrw_jax.numerics import Options, with_jacobian
from vrw_jax.walks import checked, walk_towards
from vrw_jax.wheel import WheelParams


class AbstractWalkingFinder(AbstractGaitFinder):
    """Gaits as fixed points of `period_n` steps of the rung."""

    model: AbstractWheel
    n_legs: int = eqx.field(static=True)
    step_options: Options
    period_n: int = eqx.field(static=True, default=1)

    options_type: ClassVar[type] = Options
    from_nothing: ClassVar[bool] = False

    @classmethod
    def of(
        cls, model: AbstractWheel, n_legs: int, step: Options, period_n: int, cycle: CycleOptions
    ) -> "AbstractWalkingFinder":
        return cls(model, n_legs, step, period_n)

    def cycle(self, params: WheelParams, guess: Any = None) -> WalkedCycle:
        return walked_cycle(*where_walks_begin(self, params, guess), self.period_n)

    def first_guess(self, values: Values) -> Array:
        """Where a walk from the rung's start ends."""
        model, params = self.model.at(values, self.n_legs)
        return walk_towards(model, params, self.step_options).steps.section_state[-1]

    def compile(self, params: WheelParams) -> None:
        self.find(self.model.values(params), self.model.start(params))


class SectionFinder(AbstractWalkingFinder):
    """Of any rung; derivatives are those of Newton's method."""

    of_cycle: ClassVar[tuple[str, ...]] = tuple(n for n in MEASURED if n != "takeoff_acceleration")
    differentiable: ClassVar[tuple[str, ...]] = of_cycle
    usual: ClassVar[tuple[str, ...]] = tuple(n for n in of_cycle if n != "spectral_margin")
    readable: ClassVar[tuple[str, ...]] = of_cycle

    def find(self, values: Values, guess: Array) -> Gait:
        return _differentiated(self, values, guess)


@eqx.filter_jit
def _differentiated(finder: SectionFinder, values: Values, guess: Array) -> Gait:
    """The gait and all of its derivatives, those of the map's Jacobian included."""

    cycle, jacobian = with_jacobian(lambda values: finder.cycle_of(values, guess), values)
    d_cycle = leading(jacobian)
    step = jax.tree.map(lambda x: x[0], cycle.steps)
    d_step = jax.tree.map(lambda x: x[:, 0], d_cycle.steps)
    return gait_of(finder.model, finder.n_legs, cycle, step, d_cycle, d_step)


def where_walks_begin(
    finder: AbstractWalkingFinder, params: WheelParams, guess: Any
) -> tuple[WheelParams, Array, AbstractWheel, Options]:
    """Wheel, section state, rung and options of a search near `guess`."""
    start = guess.section_state if isinstance(guess, AbstractCycle) else guess
    begin = finder.model.start(params) if start is None else start
    return checked(params, begin, finder.model, finder.step_options)


def gait_of(
    model: AbstractWheel, n_legs: int, cycle: Any, step: Any, d_cycle: Any, d_step: Any
) -> Gait:
    """With what tells branches apart; on real ground the order of events may change along one."""
    numbers = model.section_numbers(WheelParams(n_legs=n_legs))
    posture = lambda cycle, step: jnp.concatenate([cycle.section_state[:numbers], step.durations])
    told = along(posture, (cycle, step), (d_cycle, d_step))
    returns = cycle.matrix[:numbers, :numbers]
    return Gait(cycle, step, d_cycle, d_step, *told, jnp.ones(1), returns)
