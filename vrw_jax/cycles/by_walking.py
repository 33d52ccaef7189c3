"""Gaits of any rung, by Newton's method on its own return map, from a start nearby.

On real ground the step's Jacobian is by far the largest program: there it is compiled once, for
search and derivatives, and nothing is differentiated twice.
"""

from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from vrw_jax.cycles.cycle import MEASURED, AbstractCycle
from vrw_jax.cycles.finder import (
    AbstractGaitFinder,
    Gait,
    Measured,
    Values,
    along,
    leading,
    measured_of,
)
from vrw_jax.cycles.options import CycleOptions
from vrw_jax.cycles.section_cycle import WalkedCycle, cycle_from, finest, of_steps, walked_cycle
from vrw_jax.models import AbstractWheel
from vrw_jax.numerics import Options, SectionCycle, corrected, with_jacobian
from vrw_jax.results import ON_GROUND
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
        start = guess.section_state if isinstance(guess, AbstractCycle) else guess
        begin = self.model.start(params) if start is None else start
        params, x, model, options = checked(params, begin, self.model, self.step_options)
        return walked_cycle(params, x, model, options, self.period_n)

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
    return _gait(finder.model, finder.n_legs, cycle, step, d_cycle, d_step)


class GroundFinder(AbstractWalkingFinder):
    """On real ground, with first derivatives, friction's included."""

    of_cycle: ClassVar[tuple[str, ...]] = ("spectral_radius", "spectral_margin")
    differentiable: ClassVar[tuple[str, ...]] = ON_GROUND
    usual: ClassVar[tuple[str, ...]] = ON_GROUND
    readable: ClassVar[tuple[str, ...]] = ON_GROUND

    def find(self, values: Values, guess: Array) -> Gait:
        return _ground_gait(self.model, self.n_legs, self.step_options, values, guess)

    def measured(self, values: Values, guess: Any, names: tuple[str, ...]) -> Measured:
        """As everywhere; of one Jacobian of the step."""
        model, params = self.model.at(values, self.n_legs)
        start = guess.section_state if isinstance(guess, AbstractCycle) else guess
        start = model.start(params) if start is None else start
        _, x, _, _ = checked(params, start, model, self.step_options)
        return measured_of(self.find(values, x), type(self).read, names)


def _gait(
    model: AbstractWheel, n_legs: int, cycle: Any, step: Any, d_cycle: Any, d_step: Any
) -> Gait:
    """With what tells branches apart; on real ground the order of events may change along one."""
    numbers = model.section_numbers(WheelParams(n_legs=n_legs))
    posture = lambda cycle, step: jnp.concatenate([cycle.section_state[:numbers], step.durations])
    told = along(posture, (cycle, step), (d_cycle, d_step))
    returns = cycle.matrix[:numbers, :numbers]
    return Gait(cycle, step, d_cycle, d_step, *told, jnp.ones(1), returns)


@eqx.filter_jit
def _ground_gait(
    model: AbstractWheel, n_legs: int, options: Options, values: Values, start: Array
) -> Gait:
    """The gait next to `start`, with its derivatives.

    Each correction has all derivatives of the step: the step's Jacobian, by far the largest part of
    the program, is compiled once for search and derivatives.
    """
    n = values.shape[0]

    def step_at(inputs: Array) -> Any:
        ground, wheel = model.at(inputs[:n], n_legs)
        return ground.step(wheel, inputs[n:], options)

    one = jnp.eye(start.shape[0], dtype=start.dtype)

    def correct(x: Array) -> tuple:
        step, jacobian = with_jacobian(step_at, jnp.concatenate([values, x]))
        miss = step.section_state - x
        change = jnp.linalg.solve(one - jacobian.section_state[:, n:], miss)
        return change, (jacobian, step, jnp.max(jnp.abs(miss)))

    shapes = jax.eval_shape(correct, start)[1]
    blank = jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), shapes)
    found = corrected(correct, start, blank, finest(options), 1)
    jacobian, step, residual = found.told
    by_values, by_section = jnp.split(jacobian.section_state, [n], axis=-1)
    moved = jnp.linalg.solve(one - by_section, by_values)
    follow = jnp.concatenate([jnp.eye(n, dtype=start.dtype), moved])
    d_step = leading(jax.tree.map(lambda leaf: leaf @ follow, jacobian))
    wheel = model.at(values, n_legs)[1]
    fixed = SectionCycle(found.at, by_section, residual, found.converged, found.iterations)
    cycle = cycle_from(wheel, fixed, jax.tree.map(lambda leaf: leaf[None], step))
    # Nothing here tells how the Jacobian itself moves: what depends on it is not `differentiable`.
    floating = eqx.filter(cycle, eqx.is_inexact_array)
    still = jax.tree.map(lambda x: jnp.zeros((n, *x.shape), x.dtype), floating)
    d_steps = jax.tree.map(lambda leaf: leaf[:, None], d_step)
    d_cycle = eqx.tree_at(
        lambda c: (c.section_state, c.steps, c.post_impact, c.durations, c.step_length),
        still,
        (moved.T, d_steps, *jax.vmap(of_steps)(d_steps)),
    )
    return _gait(model, n_legs, cycle, step, d_cycle, d_step)
