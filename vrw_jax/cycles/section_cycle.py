"""Limit cycles of any rung, by Newton's method on its own return map.

The paper's rung has a faster way (see limit_cycle); this one knows the model's face alone.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Complex, Float, Int

from vrw_jax.models import AbstractWheel, LadderWheel
from vrw_jax.numerics import Options, Scalar, SectionCycle, floquet, newton_cycle
from vrw_jax.walks import ModelLike, checked
from vrw_jax.wheel import Outcome, WheelParams

FINEST = 1e-12
"""Newton's last correction need not be smaller, nor than the step's own tolerance."""


def finest(options: Options) -> Scalar:
    """Newton's last correction at these tolerances."""
    return jnp.maximum(FINEST, options.rtol)


class WalkedCycle(eqx.Module):
    """A gait that repeats after `period_n` steps, told by walking it. Batched under vmap.

    Differentiable in the parameters by the implicit function theorem, to second order. Where none
    was found, `outcome` says so and every other number is zero.
    """

    section_state: Float[Array, " n_section"]  # fixed under `period_n` return maps
    steps: Any  # the model's step results, with an axis over the steps of one cycle
    matrix: Float[Array, "n_section n_section"]  # derivative of the return to the section
    outcome: Int[Array, ""]  # Outcome.STEPPED, NO_CYCLE_FOUND or BAD_INPUT
    residual: Scalar  # largest entry of map(x) - x, rad, rad/s or m/s
    iterations: Int[Array, ""]  # of Newton's method

    def _first(self, leaf: Array) -> Array:
        """Without the axis over steps where there is only one."""
        axis = self.outcome.ndim
        return jnp.squeeze(leaf, axis) if leaf.shape[axis] == 1 else leaf

    @property
    def durations(self) -> Float[Array, "*n 3"]:
        """Of DLS, SLS-I, SLS-II, s; (n, 3) for period_n = n > 1."""
        return self._first(self.steps.durations)

    @property
    def step_length(self) -> Float[Array, "*n"]:
        """Distance between the feet at the landing, m."""
        return self._first(self.steps.step_length)

    @property
    def post_impact(self) -> Float[Array, "... 2"]:
        """(theta, dtheta) after the first landing, rad, rad/s."""
        return jnp.take(self.steps.post_impact, 0, axis=self.outcome.ndim)

    @property
    def indicators(self) -> Any:
        """Of each landing."""
        return jax.tree.map(self._first, self.steps.indicators)

    @property
    def monitors(self) -> Any:
        """The premises' margins of each step."""
        return jax.tree.map(self._first, self.steps.monitors)

    @property
    def period(self) -> Array:
        """Duration of the whole cycle, s."""
        return jnp.sum(self.steps.period, axis=-1)

    @property
    def dls_fraction(self) -> Array:
        """Share of the period spent in double support."""
        shares = self.steps.dls_fraction * self.steps.period
        return jnp.sum(shares, -1) / jnp.where(self.period > 0.0, self.period, 1.0)

    @property
    def speed(self) -> Array:
        """Distance over period, m/s."""
        distance = jnp.sum(self.steps.step_length, -1)
        return distance / jnp.where(self.period > 0.0, self.period, 1.0)

    @property
    def multipliers(self) -> Complex[Array, "... n_section"]:
        """Floquet multipliers; in closed form, hence differentiable, up to a section of three."""
        return floquet.multipliers(self.matrix)

    @property
    def spectral_radius(self) -> Array:
        """Largest modulus of a multiplier: below 1 the gait is stable."""
        return floquet.spectral_radius(self.matrix)

    @property
    def stability_margin(self) -> Array:
        """Positive where stable: smooth up to a section of three, 1 - spectral radius beyond."""
        if self.matrix.shape[-1] > floquet.LARGEST_CLOSED:
            margin = 1.0 - self.spectral_radius
        else:
            margin = floquet.stability_margin(self.matrix)
        return jnp.where(self.found, margin, 0.0)

    @property
    def condition(self) -> Array:
        """Condition number of I - matrix: how much the cycle magnifies a disturbance."""
        matrix = jnp.eye(self.matrix.shape[-1]) - self.matrix
        return jnp.where(self.found, jnp.linalg.cond(matrix), 0.0)

    @property
    def found(self) -> Bool[Array, "..."]:
        """Whether there is a cycle."""
        return self.outcome == Outcome.STEPPED


def walked_cycle(
    params: WheelParams,
    model: ModelLike,
    start: object,
    period_n: int,
    options: Options | None,
) -> WalkedCycle:
    """The cycle next to `start` (the model's own start if None), stable or not."""
    model = LadderWheel() if model == "auto" else model
    begin = model.start(params) if start is None else start
    params, x, model, options = checked(params, begin, model, options)
    return _walked_cycle(params, x, model, options, period_n)


@eqx.filter_jit
def _walked_cycle(
    params: WheelParams, x: Array, model: AbstractWheel, options: Options, period_n: int
) -> WalkedCycle:
    found = newton_cycle(
        lambda x: model.advance(params, x, options).section_state,
        x,
        period_n=period_n,
        tolerance=finest(options),
    )
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
    return WalkedCycle(
        section_state=masked(found.x),
        steps=jax.tree.map(masked, steps),
        matrix=masked(found.jacobian),
        outcome=jnp.where(good, Outcome.STEPPED, missing).astype(jnp.int32),
        residual=found.residual,
        iterations=found.iterations,
    )
