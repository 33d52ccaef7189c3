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

from vrw_jax.continuation import floquet
from vrw_jax.measures import FORCE_PEAK_MEASURES
from vrw_jax.printing import (
    AbstractPrintable,
    TextRow,
    describe_ending,
    format_numbers,
    format_outcome_counts,
)
from vrw_jax.runtime import with_default_settings
from vrw_jax.validation import check_choice
from vrw_jax.wheel import Outcome, WheelParams

SAME_STATE_TOLERANCE = 1e-7
"""Relative distance below which two section states of a cycle are equal. It is chosen because it
is ten times the allowed difference of two computations of a gait
(`finder.STATE_AGREEMENT_TOLERANCE`).
"""


class AbstractCycle(AbstractPrintable):
    """Gait that repeats after `period_n` steps; under vmap every field gains the batch axis.

    If no gait is found, `outcome` gives the reason. All other numbers and their derivatives are
    then zero. The axis over steps is absent if `period_n` is 1.
    """

    # state before touchdown, a fixed point of `period_n` return maps
    section_state: eqx.AbstractVar[Array]
    post_impact: eqx.AbstractVar[Float[Array, "2"]]  # (theta, dtheta) after the first landing
    # durations of the phases, s, double support first
    durations: eqx.AbstractVar[Float[Array, "*n 3"]]
    step_length: eqx.AbstractVar[Float[Array, "*n"]]  # distance between the feet at the landing, m
    monodromy_value: eqx.AbstractVar[Array]  # monodromy matrix, without derivatives
    outcome: eqx.AbstractVar[Int[Array, ""]]  # Outcome.STEPPED or the failure

    @property
    @abc.abstractmethod
    def period_n(self) -> int:
        """Return the number of steps after which the gait repeats."""

    @property
    @abc.abstractmethod
    def monodromy(self) -> Array:
        """Return the Jacobian of the return map, which is itself differentiable."""

    @property
    @abc.abstractmethod
    def warm_start(self) -> Any:
        """Return the start of a search for the gait of a neighboring wheel."""

    @property
    @abc.abstractmethod
    def step_ends(self) -> Array:
        """Section state at the end of each step; the last axes are steps and coordinates."""

    @property
    def minimal_period(self) -> Int[Array, "..."]:
        """Return the fewest steps after which the gait repeats; 0 if there is no gait.

        The number divides `period_n`: a gait of one step also repeats after two.
        """
        step_ends, n_steps = self.step_ends, self.period_n
        largest_coordinate = jnp.max(jnp.abs(step_ends), (-2, -1))
        tolerance = jnp.maximum(SAME_STATE_TOLERANCE, 100.0 * jnp.finfo(step_ends.dtype).eps)
        minimal_steps = jnp.full(self.outcome.shape, n_steps, jnp.int32)
        for candidate_period in (
            candidate_period
            for candidate_period in range(n_steps - 1, 0, -1)
            if n_steps % candidate_period == 0
        ):
            distance = jnp.max(
                jnp.abs(jnp.roll(step_ends, candidate_period, -2) - step_ends), (-2, -1)
            )
            minimal_steps = jnp.where(
                distance <= tolerance * largest_coordinate, candidate_period, minimal_steps
            )
        return jnp.where(self.found, minimal_steps, 0)

    def replace_missing_by_nan(self, params: WheelParams) -> Any:
        """Return the cycle with NaN in place of zeros if no gait was found, also in derivatives
        by `params`.
        """
        nan_if_missing = jnp.where(self.found, 0.0, jnp.nan)
        nan_weight = 1.0 + nan_if_missing * sum(
            jax.tree.leaves(params)
        )  # The parameters are included so that derivatives pass the masks.

        def apply_nan_weight(x: Array) -> Array:
            return x * nan_weight.astype(x.dtype) if eqx.is_inexact_array(x) else x

        field_names = [name for name in MASKED_FIELDS if name in vars(self)]
        values = {name: jax.tree.map(apply_nan_weight, getattr(self, name)) for name in field_names}
        return dataclasses.replace(self, **values)

    def _mask_missing(self, value: Array) -> Array:
        """Return `value`, or zero if no gait was found.

        After `replace_missing_by_nan` the result is NaN, also in derivatives.
        """
        return jnp.where(
            self.found, value, 0.0 * self.monodromy_value[..., 0, 0]
        )  # The derivative of this zero is zero.

    def combine_steps(self, values: Array, combine: Callable[[Array, int], Array]) -> Array:
        """Return one value for the whole cycle, by `combine` of the values of its steps on the
        last axis.
        """
        return combine(values, -1) if self.period_n > 1 else values

    @property
    def found(self) -> Bool[Array, "..."]:
        """Return whether a gait was found."""
        return self.outcome == Outcome.STEPPED

    @property
    def ending(self) -> Any:
        """Return how the search ended, as a sentence; for a batch, an array of sentences."""
        return describe_ending(self.outcome, Outcome)

    @property
    def why(self) -> Any:
        """Return the reason why no gait was found: the same as `ending`."""
        return self.ending

    @property
    def period(self) -> Array:
        """Return the duration of the whole cycle, s."""
        return jnp.sum(self.durations, axis=(-2, -1) if self.period_n > 1 else -1)

    @property
    def dls_fraction(self) -> Array:
        """Return the fraction of the period in double support."""
        dls, period = self.combine_steps(self.durations[..., 0], jnp.sum), self.period
        return dls / jnp.where(period > 0.0, period, 1.0)

    @property
    def speed(self) -> Array:
        """Return the mean speed, the distance of a cycle over its period, m/s."""
        distance, period = self.combine_steps(self.step_length, jnp.sum), self.period
        return distance / jnp.where(period > 0.0, period, 1.0)

    @property
    def multipliers(self) -> Complex[Array, "... n"]:
        """Return the Floquet multipliers, largest modulus first.

        They are differentiable for sections of at most three coordinates.
        """
        return floquet.floquet_multipliers(self.monodromy)

    @property
    def spectral_radius(self) -> Array:
        """Return the largest modulus of a Floquet multiplier; the gait is stable below 1."""
        return floquet.compute_spectral_radius(self.monodromy)

    @property
    def spectral_margin(self) -> Array:
        """Return 1 minus the spectral radius, which is positive for stable gaits, for every
        model.
        """
        return self._mask_missing(1.0 - self.spectral_radius)

    @property
    def stability_margin(self) -> Array:
        """Return the smooth minimum of the Jury margins, positive for stable gaits; see
        `floquet.stability_margin`.

        It is defined for sections of at most three coordinates, which excludes unilateral contact.
        """
        return self._mask_missing(floquet.stability_margin(self.monodromy))

    @property
    def condition_number(self) -> Array:
        """Return the condition number of I - monodromy, by which the cycle amplifies a
        disturbance.
        """
        matrix = jnp.eye(self.monodromy_value.shape[-1]) - self.monodromy_value
        return self._mask_missing(jnp.linalg.cond(matrix))

    @with_default_settings
    def measure(self, name: str) -> Array:
        """Return one of `CYCLE_MEASURE_FUNCTIONS`, by its name in `measures.MEASURES`; batch axes
        come first.

        Durations are sums over the cycle's steps, and indicators are minima.
        """
        return CYCLE_MEASURE_FUNCTIONS[
            check_choice("the measure", name, tuple(CYCLE_MEASURE_FUNCTIONS))
        ](self)

    def measures(self, names: Iterable[str]) -> dict[str, Array]:
        """Return several measures by name; other measures are not traced."""
        return {name: self.measure(name) for name in names}

    def summary_rows(self) -> list[TextRow]:
        """Return the printed rows of the cycle; for a batch, the number of cycles that were
        found.
        """
        outcome = np.asarray(self.outcome)
        if outcome.ndim:
            return [("wheels", format_outcome_counts(outcome, Outcome))]
        if outcome != Outcome.STEPPED:
            return [("outcome", f"{Outcome(int(outcome)).name}: {self.why}")]
        spectral_radius, multipliers_text = format_multipliers(np.asarray(self.monodromy_value))
        period_text = f"{self.period_n} steps" if self.period_n > 1 else "one step"
        if (minimal_period := int(self.minimal_period)) < self.period_n:
            period_text += f"; its minimal period is {minimal_period}"
        stability_text = "stable" if spectral_radius < 1.0 else "unstable"
        return [
            ("gait", f"{stability_text}, repeats after {period_text}"),
            ("double support", f"{100 * float(self.dls_fraction):.3f} %"),
            ("period", f"{float(self.period):.6f} s"),
            ("speed", f"{float(self.speed):.6f} m/s"),
            *self.model_rows(),
            ("after landing: angle, rate", f"{format_numbers(self.post_impact)} rad, rad/s"),
            ("multipliers", f"{multipliers_text}; spectral radius {spectral_radius:.6f}"),
        ]

    @abc.abstractmethod
    def model_rows(self) -> list[TextRow]:
        """Return the printed rows that are specific to the model."""


def format_multipliers(matrix: np.ndarray) -> tuple[float, str]:
    """Return the spectral radius, and a text of the multipliers that five digits show, largest
    first.
    """
    multipliers = sorted(np.linalg.eigvals(matrix), key=abs, reverse=True)
    shown_multipliers = [multiplier for multiplier in multipliers if abs(multiplier) >= 5e-6]
    remainder = (
        f"{len(multipliers) - len(shown_multipliers)} below 5e-6"
        if len(shown_multipliers) < len(multipliers)
        else ""
    )
    texts = [
        f"{multiplier:.5f}" if multiplier.imag else f"{multiplier.real:.5f}"
        for multiplier in shown_multipliers
    ]
    return float(np.abs(multipliers[0])), ", ".join([*texts, *([remainder] if remainder else [])])


MASKED_FIELDS = (
    "section_state",
    "post_impact",
    "durations",
    "step_length",
    "indicators",
    "steps",
    "monodromy_value",
)
"""Fields of a cycle that are zero if no gait was found."""


def _read_property(name: str) -> Callable[[AbstractCycle], Array]:
    """Return the function that reads the property `name` of a cycle."""
    return lambda cycle: getattr(cycle, name)


def _read_duration(phase_index: int) -> Callable[[AbstractCycle], Array]:
    """Return the function that reads the duration of a phase, s, from a cycle."""
    return lambda cycle: cycle.combine_steps(cycle.durations[..., phase_index], jnp.sum)


def _read_indicator(name: str) -> Callable[[Any], Array]:
    """Return the function that reads an indicator of double support from a cycle."""
    return lambda cycle: cycle.combine_steps(getattr(cycle.indicators, name), jnp.min)


def _read_gait_sensitivity(name: str) -> Callable[[Any], Array]:
    return lambda cycle: cycle.gait_sensitivity(name)


def _read_force_peak(name: str) -> Callable[[Any], Array]:
    return lambda cycle: cycle.force_peaks[name]


CYCLE_MEASURE_FUNCTIONS: dict[str, Callable[[AbstractCycle], Array]] = {
    "dls_fraction": _read_property("dls_fraction"),
    "period": _read_property("period"),
    "speed": _read_property("speed"),
    "step_length": lambda cycle: cycle.combine_steps(cycle.step_length, jnp.sum),
    "duration_dls": _read_duration(0),
    "duration_sls1": _read_duration(1),
    "duration_sls2": _read_duration(2),
    "theta_post_impact": lambda cycle: cycle.post_impact[..., 0],
    "dtheta_post_impact": lambda cycle: cycle.post_impact[..., 1],
    "theta_touchdown": lambda cycle: cycle.section_state[..., 0],
    "dtheta_touchdown": lambda cycle: cycle.section_state[..., 1],
    "dL1_touchdown": lambda cycle: cycle.section_state[..., 2],
    "lambda_I4": _read_indicator("lambda_I4"),
    "lambda_2_plus": _read_indicator("lambda_2"),
    "lambda_4_plus": _read_indicator("lambda_4"),
    "spectral_radius": _read_property("spectral_radius"),
    "spectral_margin": _read_property("spectral_margin"),
    "stability_margin": _read_property("stability_margin"),
    "takeoff_acceleration": _read_property("takeoff_acceleration"),
    "gait_sensitivity_dls_fraction": _read_gait_sensitivity("dls_fraction"),
    "gait_sensitivity_period": _read_gait_sensitivity("period"),
    "gait_sensitivity_speed": _read_gait_sensitivity("speed"),
    **{name: _read_force_peak(name) for name in FORCE_PEAK_MEASURES},
}
"""Functions of a cycle by the name of the measure. Derivatives of the stability measures are
second derivatives of the motion. They need one more compiled program and take twice the time to
run.
"""
