"""Interface of limit cycles, independent of the model and of the search method."""

import abc
import dataclasses
from collections.abc import Callable, Iterable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Complex, Float, Int

from vrw_jax.continuation import floquet
from vrw_jax.measures import FORCE_PEAK_MEASURES
from vrw_jax.printing import (
    AbstractPrintable,
    LabelAndText,
    describe_step_ending,
    format_numbers,
    format_outcome_counts,
)
from vrw_jax.runtime import with_default_jax_settings
from vrw_jax.validation import check_choice
from vrw_jax.wheel import Outcome, WheelParams

SAME_STATE_RELATIVE_TOLERANCE = 1e-7
"""Relative distance below which two section states of a cycle are equal. The value is chosen
because it is ten times the allowed difference of two computations of a gait
(`finder.STATE_AGREEMENT_TOLERANCE`)."""


class AbstractCycle(AbstractPrintable):
    """Gait that repeats after `period_n` steps; under vmap every field has the batch axis first.

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
        """Return the section state at the end of each step; the last axes are steps and
        coordinates.
        """

    @property
    def minimal_period(self) -> Int[Array, "..."]:
        """Return the fewest steps after which the gait repeats; 0 if there is no gait.

        The number divides `period_n`: a gait of one step also repeats after two steps.
        """
        step_ends, period_n = self.step_ends, self.period_n
        largest_coordinate = jnp.max(jnp.abs(step_ends), (-2, -1))
        relative_tolerance = jnp.maximum(
            SAME_STATE_RELATIVE_TOLERANCE, 100.0 * jnp.finfo(step_ends.dtype).eps
        )
        minimal_period = jnp.full(self.outcome.shape, period_n, jnp.int32)
        for candidate_period in (
            candidate_period
            for candidate_period in range(period_n - 1, 0, -1)
            if period_n % candidate_period == 0
        ):
            state_distance = jnp.max(
                jnp.abs(jnp.roll(step_ends, candidate_period, -2) - step_ends), (-2, -1)
            )
            minimal_period = jnp.where(
                state_distance <= relative_tolerance * largest_coordinate,
                candidate_period,
                minimal_period,
            )
        return jnp.where(self.found, minimal_period, 0)

    def replace_missing_gaits_by_nan(self, params: WheelParams) -> Any:
        """Return the cycle with NaN in place of zeros if no gait was found.

        Derivatives by `params` are then NaN too.
        """
        nan_without_gait = jnp.where(self.found, 0.0, jnp.nan)
        # The parameters are included, so that derivatives are NaN too.
        nan_weight = 1.0 + nan_without_gait * sum(jax.tree.leaves(params))

        def apply_nan_weight(x: Array) -> Array:
            return x * nan_weight.astype(x.dtype) if eqx.is_inexact_array(x) else x

        field_names = [name for name in FIELDS_ZERO_WITHOUT_GAIT if name in vars(self)]
        weighted_fields = {
            name: jax.tree.map(apply_nan_weight, getattr(self, name)) for name in field_names
        }
        return dataclasses.replace(self, **weighted_fields)

    def _zero_without_gait(self, gait_value: Array) -> Array:
        """Return `gait_value`, or zero if no gait was found.

        After `replace_missing_gaits_by_nan` the result is NaN, also in derivatives.
        """
        # The derivative of this zero is zero.
        return jnp.where(self.found, gait_value, 0.0 * self.monodromy_value[..., 0, 0])

    def reduce_over_steps(
        self, step_values: Array, reduce_values: Callable[[Array, int], Array]
    ) -> Array:
        """Return one value for the whole cycle from the values of its steps on the last axis."""
        return reduce_values(step_values, -1) if self.period_n > 1 else step_values

    @property
    def found(self) -> Bool[Array, "..."]:
        """Return whether a gait was found."""
        return self.outcome == Outcome.STEPPED

    @property
    def ending(self) -> Any:
        """Return a sentence about how the search ended; for a batch, an array of sentences."""
        return describe_step_ending(self.outcome, Outcome)

    @property
    def why(self) -> Any:
        """Return the reason why no gait was found, which is the sentence of `ending`."""
        return self.ending

    @property
    def period(self) -> Array:
        """Return the duration of the whole cycle, s."""
        return jnp.sum(self.durations, axis=(-2, -1) if self.period_n > 1 else -1)

    @property
    def dls_fraction(self) -> Array:
        """Return the fraction of the period in double support."""
        dls, period = self.reduce_over_steps(self.durations[..., 0], jnp.sum), self.period
        return dls / jnp.where(period > 0.0, period, 1.0)

    @property
    def speed(self) -> Array:
        """Return the mean speed, the distance of a cycle over its period, m/s."""
        distance, period = self.reduce_over_steps(self.step_length, jnp.sum), self.period
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
    def spectral_radius_value(self) -> Array:
        """Return the spectral radius without derivatives."""
        return floquet.compute_spectral_radius(lax.stop_gradient(self.monodromy_value))

    @property
    def spectral_margin(self) -> Array:
        """Return 1 minus the spectral radius, which is positive for stable gaits of every model."""
        return self._zero_without_gait(1.0 - self.spectral_radius)

    @property
    def stability_margin(self) -> Array:
        """Return the smooth minimum of the Jury margins, which is positive for stable gaits.

        See `floquet.stability_margin`. It is defined for sections of at most three coordinates,
        which excludes unilateral contact.
        """
        return self._zero_without_gait(floquet.stability_margin(self.monodromy))

    @property
    def condition_number(self) -> Array:
        """Return the condition number of I - monodromy, the factor by which the cycle amplifies a
        disturbance.
        """
        newton_matrix = jnp.eye(self.monodromy_value.shape[-1]) - self.monodromy_value
        return self._zero_without_gait(jnp.linalg.cond(newton_matrix))

    @with_default_jax_settings
    def measure(self, measure_name: str) -> Array:
        """Return a measure of the cycle by its name in `CYCLE_MEASURE_FUNCTIONS`; batch axes come
        first.

        Durations are sums over the cycle's steps, and indicators are minima over the steps.
        """
        return CYCLE_MEASURE_FUNCTIONS[
            check_choice("the measure", measure_name, tuple(CYCLE_MEASURE_FUNCTIONS))
        ](self)

    def measures(self, names: Iterable[str]) -> dict[str, Array]:
        """Return several measures by name. Measures that are not named are not traced."""
        return {name: self.measure(name) for name in names}

    def summary_rows(self) -> list[LabelAndText]:
        """Return labels and texts of the printed cycle; for a batch, the number of found cycles."""
        outcome_codes = np.asarray(self.outcome)
        if outcome_codes.ndim:
            return [("wheels", format_outcome_counts(outcome_codes, Outcome))]
        if outcome_codes != Outcome.STEPPED:
            return [("outcome", f"{Outcome(int(outcome_codes)).name}: {self.why}")]
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
            *self.model_summary_rows(),
            ("after landing: angle, rate", f"{format_numbers(self.post_impact)} rad, rad/s"),
            ("multipliers", f"{multipliers_text}; spectral radius {spectral_radius:.6f}"),
        ]

    @abc.abstractmethod
    def model_summary_rows(self) -> list[LabelAndText]:
        """Return the labels and texts that only this model's cycles print."""


def format_multipliers(monodromy_matrix: np.ndarray) -> tuple[float, str]:
    """Return the spectral radius, and a text of the multipliers, largest first.

    Multipliers that are zero to five digits are only counted.
    """
    multipliers = sorted(np.linalg.eigvals(monodromy_matrix), key=abs, reverse=True)
    shown_multipliers = [multiplier for multiplier in multipliers if abs(multiplier) >= 5e-6]
    remainder_text = (
        f"{len(multipliers) - len(shown_multipliers)} below 5e-6"
        if len(shown_multipliers) < len(multipliers)
        else ""
    )
    multiplier_texts = [
        f"{multiplier:.5f}" if multiplier.imag else f"{multiplier.real:.5f}"
        for multiplier in shown_multipliers
    ]
    return float(np.abs(multipliers[0])), ", ".join(
        [*multiplier_texts, *([remainder_text] if remainder_text else [])]
    )


FIELDS_ZERO_WITHOUT_GAIT = (
    "section_state",
    "post_impact",
    "durations",
    "step_length",
    "indicators",
    "steps",
    "monodromy_value",
)
"""Names of the fields of a cycle that are zero if no gait was found."""


def _make_property_reader(name: str) -> Callable[[AbstractCycle], Array]:
    """Return the function that reads the property `name` of a cycle."""
    return lambda cycle: getattr(cycle, name)


def _make_duration_reader(phase_index: int) -> Callable[[AbstractCycle], Array]:
    """Return the function that reads the duration of a phase, s, from a cycle."""
    return lambda cycle: cycle.reduce_over_steps(cycle.durations[..., phase_index], jnp.sum)


def _make_indicator_reader(name: str) -> Callable[[Any], Array]:
    """Return the function that reads an indicator of double support from a cycle."""
    return lambda cycle: cycle.reduce_over_steps(getattr(cycle.indicators, name), jnp.min)


def _make_sensitivity_reader(name: str) -> Callable[[Any], Array]:
    """Return the function that reads the gait sensitivity norm of the measure `name` from a
    cycle.
    """
    return lambda cycle: cycle.gait_sensitivity(name)


def _make_force_peak_reader(name: str) -> Callable[[Any], Array]:
    """Return the function that reads the force-peak measure `name` from a cycle."""
    return lambda cycle: cycle.force_peaks[name]


CYCLE_MEASURE_FUNCTIONS: dict[str, Callable[[AbstractCycle], Array]] = {
    "dls_fraction": _make_property_reader("dls_fraction"),
    "period": _make_property_reader("period"),
    "speed": _make_property_reader("speed"),
    "step_length": lambda cycle: cycle.reduce_over_steps(cycle.step_length, jnp.sum),
    "duration_dls": _make_duration_reader(0),
    "duration_sls1": _make_duration_reader(1),
    "duration_sls2": _make_duration_reader(2),
    "theta_post_impact": lambda cycle: cycle.post_impact[..., 0],
    "dtheta_post_impact": lambda cycle: cycle.post_impact[..., 1],
    "theta_touchdown": lambda cycle: cycle.section_state[..., 0],
    "dtheta_touchdown": lambda cycle: cycle.section_state[..., 1],
    "dL1_touchdown": lambda cycle: cycle.section_state[..., 2],
    "lambda_I4": _make_indicator_reader("lambda_I4"),
    "lambda_2_plus": _make_indicator_reader("lambda_2"),
    "lambda_4_plus": _make_indicator_reader("lambda_4"),
    "spectral_radius": _make_property_reader("spectral_radius"),
    "spectral_margin": _make_property_reader("spectral_margin"),
    "stability_margin": _make_property_reader("stability_margin"),
    "takeoff_acceleration": _make_property_reader("takeoff_acceleration"),
    "gait_sensitivity_dls_fraction": _make_sensitivity_reader("dls_fraction"),
    "gait_sensitivity_period": _make_sensitivity_reader("period"),
    "gait_sensitivity_speed": _make_sensitivity_reader("speed"),
    **{name: _make_force_peak_reader(name) for name in FORCE_PEAK_MEASURES},
}
"""Functions of a cycle by the name of the measure. Derivatives of the stability measures are second
derivatives of the motion. They need one more compiled program than other derivatives, and take
twice the time to run."""
