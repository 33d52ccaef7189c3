"""Interface of limit cycles, independent of the model and of the search method."""

import abc
import dataclasses
from collections.abc import Callable, Iterable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float, Int

from vrw_jax.numerics import floquet
from vrw_jax.wheel import Outcome, WheelParams
from vrw_jax.wording import AbstractTold, Row, chosen, counted, listed


class AbstractCycle(AbstractTold):
    """Gait that repeats after `period_n` steps. Batched under vmap: every field gains the batch
    axis.

    If no gait is found, `outcome` gives the reason. All other numbers and their derivatives are
    then zero. The axis over steps is absent for `period_n` = 1.
    """

    section_state: eqx.AbstractVar[Array]  # before touchdown, fixed under `period_n` return maps
    post_impact: eqx.AbstractVar[Float[Array, "2"]]  # (theta, dtheta) after the first landing
    durations: eqx.AbstractVar[Float[Array, "*n 3"]]  # s, double support first
    step_length: eqx.AbstractVar[Float[Array, "*n"]]  # between the feet at the landing, m
    matrix: eqx.AbstractVar[Array]  # monodromy matrix, without derivative
    outcome: eqx.AbstractVar[Int[Array, ""]]  # Outcome.STEPPED or the failure

    @property
    @abc.abstractmethod
    def period_n(self) -> int:
        """Return the number of steps after which the gait repeats."""

    @property
    @abc.abstractmethod
    def monodromy(self) -> Array:
        """Return the Jacobian of the return map, itself differentiable."""

    @property
    @abc.abstractmethod
    def near(self) -> Any:
        """Return the start of a search for a neighbor's gait."""

    def or_nan(self, params: WheelParams) -> Any:
        """Return the cycle with NaN in place of zeros where there is none, also in derivatives with
        respect to params."""
        lost = jnp.where(self.found, 0.0, jnp.nan)
        weight = 1.0 + lost * sum(jax.tree.leaves(params))  # so that derivatives pass the masks

        def told(x: Array) -> Array:
            return x * weight.astype(x.dtype) if eqx.is_inexact_array(x) else x

        names = [name for name in MASKED if name in vars(self)]
        values = {name: jax.tree.map(told, getattr(self, name)) for name in names}
        return dataclasses.replace(self, **values)

    def _if_found(self, value: Array) -> Array:
        """Return `value`, or zero where there is no cycle. The result is NaN after
        `replace_missing_by_nan`, also in derivatives."""
        return jnp.where(
            self.found, value, 0.0 * self.matrix[..., 0, 0]
        )  # whose derivative is zero

    def over_steps(self, values: Array, combine: Callable[[Array, int], Array]) -> Array:
        """Combine one value per step, on the last axis, into one value for the whole cycle."""
        return combine(values, -1) if self.period_n > 1 else values

    @property
    def found(self) -> Bool[Array, "..."]:
        """Return whether there is a cycle."""
        return self.outcome == Outcome.STEPPED

    @property
    def why(self) -> str:
        """Return why there is no cycle, as a sentence. The cycle must be that of one wheel."""
        return Outcome(int(self.outcome)).meaning

    @property
    def period(self) -> Array:
        """Return the duration of the whole cycle, s."""
        return jnp.sum(self.durations, axis=(-2, -1) if self.period_n > 1 else -1)

    @property
    def dls_fraction(self) -> Array:
        """Return the share of the period in double support."""
        dls, period = self.over_steps(self.durations[..., 0], jnp.sum), self.period
        return dls / jnp.where(period > 0.0, period, 1.0)

    @property
    def speed(self) -> Array:
        """Return distance over period, m/s."""
        distance, period = self.over_steps(self.step_length, jnp.sum), self.period
        return distance / jnp.where(period > 0.0, period, 1.0)

    @property
    def multipliers(self) -> Complex[Array, "... n"]:
        """Return the Floquet multipliers, largest first. They are differentiable for sections of at
        most three coordinates."""
        return floquet.multipliers(self.monodromy)

    @property
    def spectral_radius(self) -> Array:
        """Return the largest modulus of a multiplier. The gait is stable below 1."""
        return floquet.spectral_radius(self.monodromy)

    @property
    def spectral_margin(self) -> Array:
        """Return 1 - spectral radius, positive for stable gaits, for every model."""
        return self._if_found(1.0 - self.spectral_radius)

    @property
    def stability_margin(self) -> Array:
        """Return the smooth minimum of the Jury margins, positive for stable gaits: see
        `floquet.stability_margin`.

        It is defined for sections of at most three coordinates, which excludes unilateral contact.
        """
        return self._if_found(floquet.stability_margin(self.monodromy))

    @property
    def condition(self) -> Array:
        """Return the condition number of I - monodromy: the amplification of a disturbance by the
        cycle."""
        matrix = jnp.eye(self.matrix.shape[-1]) - self.matrix
        return self._if_found(jnp.linalg.cond(matrix))

    def measure(self, name: str) -> Array:
        """Return one of `CYCLE_MEASURE_FUNCTIONS`, by its name in `results.ALL_MEASURES`. Batch
        axes come first.

        Durations are sums over the cycle's steps, and indicators are minima.
        """
        return MEASURED[chosen("the measure", name, tuple(MEASURED))](self)

    def measures(self, names: Iterable[str]) -> dict[str, Array]:
        """Return several measures by name. Measures that are not requested are not traced."""
        return {name: self.measure(name) for name in names}

    def rows(self) -> list[Row]:
        """Return the printed rows of the cycle. A batch shows how many cycles are found."""
        outcome = np.asarray(self.outcome)
        if outcome.ndim:
            return [("wheels", counted(outcome, Outcome))]
        if outcome != Outcome.STEPPED:
            return [("outcome", f"{Outcome(int(outcome)).name}: {self.why}")]
        radius, told = multipliers_told(np.asarray(self.matrix))
        often = f"{self.period_n} steps" if self.period_n > 1 else "one step"
        stable = "stable" if radius < 1.0 else "unstable"
        return [
            ("gait", f"{stable}, repeats after {often}"),
            ("double support", f"{100 * float(self.dls_fraction):.3f} %"),
            ("period", f"{float(self.period):.6f} s"),
            ("speed", f"{float(self.speed):.6f} m/s"),
            *self.own_rows(),
            ("after landing: angle, rate", f"{listed(self.post_impact)} rad, rad/s"),
            ("multipliers", f"{told}; spectral radius {radius:.6f}"),
        ]

    @abc.abstractmethod
    def own_rows(self) -> list[Row]:
        """Return the rows that are specific to the model."""


def multipliers_told(matrix: np.ndarray) -> tuple[float, str]:
    """Return the spectral radius, and the multipliers that five digits show, largest first."""
    multipliers = sorted(np.linalg.eigvals(matrix), key=abs, reverse=True)
    shown = [z for z in multipliers if abs(z) >= 5e-6]
    rest = f"{len(multipliers) - len(shown)} below 5e-6" if len(shown) < len(multipliers) else ""
    told = [f"{z:.5f}" if z.imag else f"{z.real:.5f}" for z in shown]
    return float(np.abs(multipliers[0])), ", ".join([*told, *([rest] if rest else [])])


MASKED = (
    "section_state",
    "post_impact",
    "durations",
    "step_length",
    "indicators",
    "steps",
    "matrix",
)
"""Fields that are zero where there is no gait."""


def _own(name: str) -> Callable[[AbstractCycle], Array]:
    return lambda cycle: getattr(cycle, name)


def _duration(place: int) -> Callable[[AbstractCycle], Array]:
    return lambda cycle: cycle.over_steps(cycle.durations[..., place], jnp.sum)


def _indicator(name: str) -> Callable[[Any], Array]:
    return lambda cycle: cycle.over_steps(getattr(cycle.indicators, name), jnp.min)


MEASURED: dict[str, Callable[[AbstractCycle], Array]] = {
    "dls_fraction": _own("dls_fraction"),
    "period": _own("period"),
    "speed": _own("speed"),
    "step_length": lambda cycle: cycle.over_steps(cycle.step_length, jnp.sum),
    "duration_dls": _duration(0),
    "duration_sls1": _duration(1),
    "duration_sls2": _duration(2),
    "theta_post_impact": lambda cycle: cycle.post_impact[..., 0],
    "dtheta_post_impact": lambda cycle: cycle.post_impact[..., 1],
    "theta_touchdown": lambda cycle: cycle.section_state[..., 0],
    "dtheta_touchdown": lambda cycle: cycle.section_state[..., 1],
    "dL1_touchdown": lambda cycle: cycle.section_state[..., 2],
    "lambda_I4": _indicator("lambda_I4"),
    "lambda_2_plus": _indicator("lambda_2"),
    "lambda_4_plus": _indicator("lambda_4"),
    "spectral_radius": _own("spectral_radius"),
    "spectral_margin": _own("spectral_margin"),
    "stability_margin": _own("stability_margin"),
    "takeoff_acceleration": _own("takeoff_acceleration"),
}
"""Functions of a cycle by name of the measure; the only such table. Derivatives of the stability
measures are second derivatives of the motion. They need one more compiled program and take twice
the time to run."""
