"""Gaits of any rung, by Newton's method on its own return map, from a start nearby.

The paper's rung has a faster way (see `by_collocation`); this one knows the model's face alone.
"""

from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from vrw_jax.cycles.cycle import MEASURED, AbstractCycle
from vrw_jax.cycles.finder import (
    AbstractGaitFinder,
    Gait,
    OnBranch,
    Values,
    along,
    leading,
)
from vrw_jax.cycles.options import CycleOptions
from vrw_jax.models import AbstractWheel
from vrw_jax.numerics import (
    Options,
    Scalar,
    SectionCycle,
    moved_cycle,
    newton_cycle,
    with_jacobian,
)
from vrw_jax.walks import checked, walk_towards
from vrw_jax.wheel import Outcome, WheelParams
from vrw_jax.wording import Row, listed

FINEST = 1e-12
"""Newton's last correction need not be smaller, nor than the step's own tolerance."""


def finest(options: Options) -> Scalar:
    """Newton's last correction at these tolerances."""
    return jnp.maximum(FINEST, options.rtol)


class WalkedCycle(AbstractCycle):
    """A gait that repeats after `period_n` steps, told by walking it. Batched under vmap.

    Differentiable in the parameters by the implicit function theorem, to second order. Where none
    was found, `outcome` says so and every other number is zero.

    - `section_state`: fixed under `period_n` return maps;
    - `post_impact`: (theta, dtheta) after the first landing, rad, rad/s;
    - `durations`: as the rung's step tells them, s; (n, 3) for period_n = n > 1;
    - `step_length`: distance between the feet at the landing, m;
    - `steps`: the model's step results, with an axis over the steps of one cycle;
    - `matrix`: derivative of the return to the section;
    - `outcome`: Outcome.STEPPED, or why there is none;
    - `residual`: largest entry of map(x) - x, rad, rad/s or m/s;
    - `iterations`: of Newton's method.

    Examples:
        >>> wheel = vrw.RigidWheel(held_landing=True)
        >>> cycle = vrw.limit_cycle(vrw.WheelParams(slope=0.1), model=wheel, guess=[0.39, 1.5, 0.0])
        >>> print(f"{cycle.period:.3f} s")
        0.425 s
    """

    section_state: Float[Array, " n_section"]
    post_impact: Float[Array, "2"]
    durations: Float[Array, "*n 3"]
    step_length: Float[Array, "*n"]
    steps: Any
    matrix: Float[Array, "n_section n_section"]
    outcome: Int[Array, ""]
    residual: Scalar
    iterations: Int[Array, ""]

    @property
    def period_n(self) -> int:
        return self.steps.durations.shape[self.outcome.ndim]

    def _of_steps(self, tree: Any) -> Any:
        """Without the axis over steps where there is only one."""
        axis, once = self.outcome.ndim, self.period_n == 1
        return jax.tree.map(lambda leaf: jnp.squeeze(leaf, axis) if once else leaf, tree)

    @property
    def indicators(self) -> Any:
        """Of each landing."""
        return self._of_steps(self.steps.indicators)

    @property
    def monitors(self) -> Any:
        """The premises' margins of each step."""
        return self._of_steps(self.steps.monitors)

    @property
    def near(self) -> Array:
        return self.section_state

    @property
    def monodromy(self) -> Array:
        return self.matrix

    def own_rows(self) -> list[Row]:
        return [("durations of each kind of support", f"{listed(self.durations)} s")]


@eqx.filter_jit
def walked_cycle(
    params: WheelParams, x: Array, model: AbstractWheel, options: Options, period_n: int, dear: bool
) -> WalkedCycle:
    """`dear`: second derivatives of a step are, as on real ground: see `moved_cycle`.

    Searched for by the step that tells the gait then, so that one program is compiled, not two.
    """
    take, search = (model.step, moved_cycle) if dear else (model.advance, newton_cycle)
    image = lambda x: take(params, x, options).section_state
    found = search(image, x, period_n=period_n, tolerance=finest(options))
    x, results = found.x, []
    for _ in range(period_n):
        results.append(model.step(params, x, options))
        x = results[-1].section_state
    return cycle_from(params, found, jax.tree.map(lambda *leaves: jnp.stack(leaves), *results))


def cycle_from(params: WheelParams, found: SectionCycle, steps: Any) -> WalkedCycle:
    """The gait through a fixed point, whose steps have a leading axis."""
    # A step that fails returns zeros, which Newton's method may take for a fixed point.
    good = found.converged & jnp.all(steps.outcome == Outcome.STEPPED)
    missing = jnp.where(params.in_domain(), Outcome.NO_CYCLE_FOUND, Outcome.BAD_INPUT)
    masked = lambda leaf: jnp.where(good, leaf, jnp.zeros_like(leaf))
    steps = jax.tree.map(masked, steps)
    return WalkedCycle(
        masked(found.x),
        *of_steps(steps),
        steps=steps,
        matrix=masked(found.jacobian),
        outcome=jnp.where(good, Outcome.STEPPED, missing).astype(jnp.int32),
        residual=found.residual,
        iterations=found.iterations,
    )


def of_steps(steps: Any) -> tuple[Array, Array, Array]:
    """What a cycle tells of its steps, which have a leading axis: after landing, times, lengths."""
    durations, lengths = steps.durations, steps.step_length
    if len(durations) == 1:
        durations, lengths = durations[0], lengths[0]
    return steps.post_impact[0], durations, lengths


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
        given = where_walks_begin(self, params, guess)
        return walked_cycle(*given, self.period_n, dear=False)

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

    @eqx.filter_jit
    def find(self, values: Values, guess: Array) -> Gait:
        cycle, jacobian = with_jacobian(lambda values: self.cycle_of(values, guess), values)
        d_cycle: Any = leading(jacobian)
        step = jax.tree.map(lambda x: x[0], cycle.steps)
        d_step = jax.tree.map(lambda x: x[:, 0], d_cycle.steps)
        return gait_of(self.model, self.n_legs, cycle, step, d_cycle, d_step)


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
    return Gait(cycle, step, d_cycle, d_step, OnBranch(*told, jnp.ones(1), returns))
