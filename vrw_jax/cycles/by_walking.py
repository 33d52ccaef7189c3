"""Gaits of any model, found by Newton's method on its return map from a start nearby.

The paper's model has a faster method (see `collocation_finder`). This module uses only the
interface of the models.
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
"""Lower limit of the tolerance of Newton's last correction. The step's own tolerance is a limit
too."""


def finest(options: Options) -> Scalar:
    """Return the tolerance of Newton's last correction for these step options."""
    return jnp.maximum(FINEST, options.rtol)


class WalkedCycle(AbstractCycle):
    """Gait that repeats after `period_n` steps, a fixed point of the return map. Batched under
    vmap.

    It is differentiable in the parameters by the implicit function theorem, to second order. If no
    gait is found, `outcome` gives the reason and every other number is zero.

    - `section_state`: fixed under `period_n` return maps;
    - `post_impact`: (theta, dtheta) after the first landing, rad, rad/s;
    - `durations`: as the model's step returns them, s; (n, 3) for period_n = n > 1;
    - `step_length`: distance between the feet at the landing, m;
    - `steps`: the model's step results, with an axis over the steps of one cycle;
    - `monodromy_value`: Jacobian of the return map;
    - `outcome`: Outcome.STEPPED, or the reason of the failure;
    - `residual`: largest entry of map(x) - x, rad, rad/s or m/s;
    - `n_iterations`: of Newton's method.

    Examples:
        >>> wheel = vrw.RigidWheel(holds_rear_foot=True)
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
        """Remove the axis over steps if there is only one step."""
        axis, once = self.outcome.ndim, self.period_n == 1
        return jax.tree.map(lambda leaf: jnp.squeeze(leaf, axis) if once else leaf, tree)

    @property
    def indicators(self) -> Any:
        """Return the indicators of each landing."""
        return self._of_steps(self.steps.indicators)

    @property
    def monitors(self) -> Any:
        """Return the margins of each step."""
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
    """Find a cycle by Newton's method on the model's return map.

    `uses_jvp_rule` selects `solve_fixed_point_implicit`, because second derivatives of a step are
    expensive with unilateral contact. The search then uses the same step as the result, so that
    only one program is compiled.
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
    """Return the cycle of a fixed point whose steps have a leading axis."""
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
    """Return post-impact state, durations and step lengths of a cycle from its steps, which have a
    leading axis."""
    durations, lengths = steps.durations, steps.step_length
    if len(durations) == 1:
        durations, lengths = durations[0], lengths[0]
    return steps.post_impact[0], durations, lengths


class AbstractWalkingFinder(AbstractGaitFinder):
    """Finder of gaits as fixed points of `period_n` steps of the model."""

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
        """Return the last section state of a walk from the model's start."""
        model, params = self.model.at(values, self.n_legs)
        return walk_towards(model, params, self.step_options).steps.section_state[-1]

    def compile(self, params: WheelParams) -> None:
        self.find(self.model.values(params), self.model.start(params))


class SectionFinder(AbstractWalkingFinder):
    """Finder for any model, with the derivatives of Newton's method."""

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
    """Return wheel, section state, model and options of a search near `guess`."""
    start = guess.section_state if isinstance(guess, AbstractCycle) else guess
    begin = finder.model.start(params) if start is None else start
    return checked(params, begin, finder.model, finder.step_options)


def gait_of(
    model: AbstractWheel, n_legs: int, cycle: Any, step: Any, d_cycle: Any, d_step: Any
) -> Gait:
    """Return a gait with the data that identify its branch. With unilateral contact the order of
    events may change along a branch."""
    numbers = model.section_numbers(WheelParams(n_legs=n_legs))
    posture = lambda cycle, step: jnp.concatenate([cycle.section_state[:numbers], step.durations])
    told = along(posture, (cycle, step), (d_cycle, d_step))
    returns = cycle.matrix[:numbers, :numbers]
    return Gait(cycle, step, d_cycle, d_step, OnBranch(*told, jnp.ones(1), returns))
