"""Means over many wheels with unilateral contact, with a lower model as a control variate.

The values of the lower model are known for all wheels, and only the difference from unilateral
contact is sampled (M. B. Giles, Acta Numerica 24, 2015; B. Peherstorfer, K. Willcox and M.
Gunzburger, SIAM Review 60, 2018). A pilot sample of wheels determines the weight of the control
variate, the control that is worth its cost, and the number of further wheels. The pilot's wheels
count as known, and the others are drawn from the remaining wheels. No estimate is therefore applied
to the numbers from which it was computed, and the mean is unbiased. If some wheels have no gait,
the mean is a ratio of sums over all wheels. Its bias is then of the order of one over the number of
sampled wheels.
"""

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np

from vrw_jax.measures import MEASURES
from vrw_jax.numerics import StepOptions, take_rows
from vrw_jax.printing import AbstractPrintable, LabelAndText
from vrw_jax.runtime import with_default_jax_settings
from vrw_jax.tolerance.contact_steps import GroundBatch
from vrw_jax.tolerance.lower_fidelity import LowerFidelityGait, ModelIndex, find_paper_gaits
from vrw_jax.tolerance.measure_result import MeasureResult
from vrw_jax.tolerance.refinement import estimate_measures
from vrw_jax.tolerance.step_quantities import MEASURE_FUNCTIONS, evaluate_measures
from vrw_jax.tolerance.tolerance_request import check_batch, measure_to_tolerance
from vrw_jax.validation import (
    check_choice,
    check_int,
    check_known_name,
    check_not_traced,
    check_positive,
    check_type,
)
from vrw_jax.wheel import WheelParams, convert_friction


@dataclass(frozen=True)
class SamplingOptions:
    """Options of the sampling of a mean.

    - `n_standard_errors`: number of standard errors in the stated error of a mean;
    - `gait_error_share`: fraction of the mean's error that is allowed for each gait;
    - `min_pilot_gaits`: smallest number of wheels with a gait for an estimate of the variance;
    - `singular_value_tolerance`: fraction of the largest singular value below which the pilot does
      not determine a direction.
    """

    n_standard_errors: float = 2.0
    gait_error_share: float = 0.1
    min_pilot_gaits: int = 8
    singular_value_tolerance: float = 1e-12


SAMPLING_OPTIONS = SamplingOptions()
"""Options of `vrw.multifidelity_mean`."""


class _Control(NamedTuple):
    """Control variate: its name, and its cost in steps with unilateral contact."""

    name: str
    cost: float


CONTROLS = (
    _Control("no control", 0.0),
    _Control("the paper's gaits", 1.0),
    _Control("the paper's gaits with one contact step", 2.0),
)
"""Control variates, of which the cheapest is used. In batches the paper's gait costs as much as
one step.
"""


class MultifidelityMean(AbstractPrintable):
    """Mean of a measure over wheels with unilateral contact.

    - `measure`: name of the measure;
    - `value`: mean, in the measure's unit;
    - `error`: two standard errors of the mean, plus the mean error of the gaits;
    - `n_gaits`: number of sampled wheels with a gait with unilateral contact;
    - `n_high_fidelity`: number of wheels computed with unilateral contact, the pilot included;
    - `control`: name of the control variate for the others;
    - `weight`: weight of the control;
    - `cost`: number of steps with unilateral contact, including the equivalent cost of the control;
    - `cost_high_fidelity_only`: expected cost of a mean of the same error without a control.

    Examples:
        >>> wheels = vrw.WheelParams(damping=jnp.linspace(120.0, 200.0, 60))
        >>> mean = vrw.multifidelity_mean("speed", wheels, 1e-2, friction=15.0, pilot=12)
        >>> bool(mean.n_high_fidelity < 60)
        True
    """

    value: float
    error: float
    n_gaits: float
    n_high_fidelity: float
    weight: float
    cost: float
    cost_high_fidelity_only: float
    measure: str = eqx.field(static=True)
    control: str = eqx.field(static=True)

    @property
    def ending(self) -> str:
        """Return how many wheels were computed with unilateral contact, as a sentence."""
        return (
            f"{self.n_high_fidelity:.0f} wheels were computed with unilateral contact; "
            f"{self.n_gaits:.0f} of them have a gait."
        )

    def summary_rows(self) -> list[LabelAndText]:
        unit = MEASURES[self.measure].display_unit
        return [
            (f"mean {self.measure}", f"{self.value:.6g} ± {self.error:.1g} {unit}".strip()),
            (
                "with unilateral contact",
                f"{self.n_high_fidelity:.0f} wheels, {self.n_gaits:.0f} of them with a gait",
            ),
            ("control", f"{self.control}, weight {self.weight:.3g}"),
            ("contact steps", f"{self.cost:.3g}, alone {self.cost_high_fidelity_only:.3g}"),
        ]


class _SamplingPlan(NamedTuple):
    """Sampling plan for a mean with one of the control variates."""

    expected_cost: float  # expected cost in steps with unilateral contact
    n_wheels: int  # number of wheels to draw
    weights: np.ndarray  # weights of the control's value, and of the flag that it has one
    control_index: int


@with_default_jax_settings
def multifidelity_mean(
    measure: str,
    params: WheelParams,
    tol: float,
    *,
    friction: Any = 0.7,
    pilot: int = 32,
    seed: int = 0,
    stoppers: str = "bilateral",
) -> MultifidelityMean:
    """Return the mean of a measure over these wheels with unilateral contact, to within `tol`.

    Fields of `params` and `friction` have one axis of wheels, such as a design or samples of
    manufacturing tolerances. Wheels without a gait with unilateral contact do not count.

    Args:
        measure: one of the measures of `measure_to_tolerance`.
        params: the wheels.
        tol: allowed error (two standard errors), in the measure's unit.
        friction: friction coefficient of the ground.
        pilot: number of wheels in the pilot sample.
        seed: seed of the random sample.
        stoppers: stoppers of the wheels, "bilateral" or "one-sided".

    Returns:
        A `MultifidelityMean`.

    Raises:
        TypeError, ValueError: if an argument is invalid, or if too few wheels have a gait.

    Examples:
        >>> wheels = vrw.WheelParams(damping=jnp.linspace(120.0, 200.0, 60))
        >>> mean = vrw.multifidelity_mean("speed", wheels, 1e-2, friction=15.0, pilot=12)
        >>> bool(mean.error < 1.1e-2)
        True
    """
    check_not_traced(
        "vrw.multifidelity_mean", "it on numbers, and give wheels as arrays", params, friction
    )
    check_type("measure", measure, str, "give the name of one, 'speed', say")
    check_known_name(measure, tuple(MEASURE_FUNCTIONS), "measure that every model has")
    check_choice("stoppers", stoppers, ("bilateral", "one-sided"))
    options, min_pilot_gaits = SAMPLING_OPTIONS, SAMPLING_OPTIONS.min_pilot_gaits
    tol = check_positive("tol", tol)
    pilot = check_int("pilot", pilot, min_pilot_gaits, ", to estimate a variance")
    seed = check_int("seed", seed, 0)
    params, friction_by_wheel, shape = check_batch(params, convert_friction(friction))
    n_wheels = len(friction_by_wheel)
    if not shape or n_wheels <= pilot:
        raise ValueError(
            f"there are {n_wheels} wheels and a pilot of {pilot}, but a mean needs more wheels "
            "than its pilot: give a batch, params.damping of shape (1000,), say."
        )
    wheels = _WheelSample(measure, params, friction_by_wheel, stoppers)
    permutation = np.random.default_rng(seed).permutation(n_wheels)
    pilot_indices, other_indices = permutation[:pilot], permutation[pilot:]
    gait_tol = options.gait_error_share * tol
    pilot_results = wheels.measure_wheels(pilot_indices, gait_tol)
    is_found = pilot_results.found
    if np.sum(is_found) < min_pilot_gaits:
        raise ValueError(
            f"{np.sum(is_found)} of the pilot's {pilot} wheels have a gait with contact, but a "
            f"mean needs {min_pilot_gaits}: give other wheels, or a larger pilot."
        )
    pilot_sample = _SampledMeasures.from_results(pilot_results)
    control_columns = [
        _stack_control_columns(wheels.evaluate_control(pilot_indices, control))
        for control in range(len(CONTROLS))
    ]
    sampling_plans = [
        _plan_sampling(control_index, pilot_sample, x, tol, len(other_indices), options)
        for control_index, x in enumerate(control_columns)
    ]
    plan = min(sampling_plans, key=lambda plan: plan.expected_cost)
    drawn_results = wheels.measure_wheels(other_indices[: plan.n_wheels], gait_tol)
    value, standard_error = _estimate_mean(
        plan,
        pilot_sample,
        _SampledMeasures.from_results(drawn_results),
        _stack_control_columns(wheels.evaluate_control(other_indices, plan.control_index)),
    )
    gait_errors = np.concatenate(
        [pilot_results.error[is_found], drawn_results.error[drawn_results.found]]
    )
    return MultifidelityMean(
        value=value,
        error=options.n_standard_errors * standard_error + float(np.mean(gait_errors)),
        n_gaits=float(len(gait_errors)),
        n_high_fidelity=float(pilot + plan.n_wheels),
        weight=float(plan.weights[0]),
        cost=float(np.sum(pilot_results.n_steps) + np.sum(drawn_results.n_steps))
        + CONTROLS[plan.control_index].cost * n_wheels,
        cost_high_fidelity_only=pilot_sample.mean_cost * pilot + sampling_plans[0].expected_cost,
        measure=measure,
        control=CONTROLS[plan.control_index].name,
    )


class _SampledMeasures(NamedTuple):
    """Measures of the wheels of a sample."""

    values: np.ndarray  # values of the measure, zero if there is no gait
    has_gait: np.ndarray  # whether the wheel has a gait
    mean_cost: float  # mean number of steps per wheel

    @classmethod
    def from_results(cls, results: MeasureResult) -> "_SampledMeasures":
        """Return the sampled measures of these results."""
        has_gait = results.found.astype(float)
        return cls(
            np.where(results.found, results.value, 0.0), has_gait, float(np.mean(results.n_steps))
        )


class _WheelSample(NamedTuple):
    """Wheels of a sample, and the measure that is evaluated."""

    measure_name: str
    params: WheelParams
    friction: np.ndarray
    stoppers: str

    def take_wheels(self, indices: np.ndarray) -> WheelParams:
        """Return the wheels at these indices."""
        return jax.device_put(take_rows(self.params, indices))

    def measure_wheels(self, indices: np.ndarray, tol: float) -> MeasureResult:
        """Return the measure with unilateral contact of these wheels, to within `tol`."""
        arguments = self.measure_name, self.take_wheels(indices), tol
        return measure_to_tolerance(
            *arguments, friction=self.friction[indices], stoppers=self.stoppers
        )

    def evaluate_control(self, indices: np.ndarray, control_index: int) -> np.ndarray:
        """Return the values of a control variate, NaN for wheels without one."""
        control_values = np.full(len(indices), np.nan)
        if not control_index:
            return control_values
        options = StepOptions()
        lower_gaits = find_paper_gaits(self.take_wheels(indices), options)
        (has_gait,) = np.nonzero(lower_gaits.model_index != ModelIndex.NONE)
        lower_gaits = LowerFidelityGait(*(gait_array[has_gait] for gait_array in lower_gaits))
        values = evaluate_measures([self.measure_name], lower_gaits.quantities)[:, 0]
        if control_index == len(CONTROLS) - 1:
            gait_indices = indices[has_gait]
            ground = GroundBatch.from_params(
                self.take_wheels(gait_indices), self.friction[gait_indices], self.stoppers, options
            )
            all_positions = np.arange(len(gait_indices))
            section_states = ground.embed_states(all_positions, lower_gaits.section_state)
            estimate = estimate_measures(
                ground,
                all_positions,
                section_states,
                ground.take_steps(all_positions, section_states),
                lower_gaits.newton_matrix,
                lower_gaits.quantity_jacobian,
                [self.measure_name],
                ground.plane_indices(),
            )
            values = np.where(estimate.same_codes, estimate.values[:, 0], values)
        control_values[has_gait] = values
        return control_values


def _stack_control_columns(control_values: np.ndarray) -> np.ndarray:
    """Return the control's value of each wheel, zero if it has none, and whether it has one,
    (wheels, 2).
    """
    has_value = np.isfinite(control_values)
    return np.column_stack([np.where(has_value, control_values, 0.0), has_value])


def _plan_sampling(
    control_index: int,
    pilot_sample: _SampledMeasures,
    control_columns: np.ndarray,
    tol: float,
    n_other: int,
    options: SamplingOptions,
) -> _SamplingPlan:
    """Return weights and number of wheels from the pilot, for a mean to within `tol`.

    The mean M is over the wheels with a gait, which is a ratio. The controlled quantity is each
    wheel's measure minus M, and zero for a wheel without a gait. Its sum over all wheels is zero.
    """
    gait_share = float(np.mean(pilot_sample.has_gait))
    centered_values = (
        pilot_sample.values - np.mean(pilot_sample.values) / gait_share * pilot_sample.has_gait
    )
    centered_columns = control_columns - np.mean(control_columns, axis=0)
    weights, _, rank, _ = np.linalg.lstsq(
        centered_columns, centered_values, rcond=options.singular_value_tolerance
    )
    sum_of_squares = float(
        np.sum((centered_values - centered_columns @ weights) ** 2)
    ) + _variance_of_unseen_wheel(pilot_sample, centered_values)
    residual_variance = sum_of_squares / (len(centered_values) - 1 - int(rank))
    sampling_tol = (1.0 - options.gait_error_share) * tol
    n_required = residual_variance * (options.n_standard_errors / (sampling_tol * gait_share)) ** 2
    n_wheels = min(
        n_other, max(options.min_pilot_gaits, math.ceil(n_required / (1.0 + n_required / n_other)))
    )
    return _SamplingPlan(
        n_wheels * pilot_sample.mean_cost + CONTROLS[control_index].cost * n_other,
        n_wheels,
        weights,
        control_index,
    )


def _estimate_mean(
    plan: _SamplingPlan,
    pilot_sample: _SampledMeasures,
    drawn_sample: _SampledMeasures,
    control_columns: np.ndarray,
) -> tuple[float, float]:
    """Return the mean and its standard error.

    `control_columns` are those of all wheels except the pilot's, of which the first belong to the
    drawn wheels.
    """
    n_wheels, control_values = len(control_columns), control_columns @ plan.weights
    gait_count = np.sum(pilot_sample.has_gait) + n_wheels * np.mean(drawn_sample.has_gait)
    differences = drawn_sample.values - control_values[: plan.n_wheels]
    mean = (
        np.sum(pilot_sample.values) + n_wheels * (np.mean(control_values) + np.mean(differences))
    ) / gait_count
    sum_of_squares = plan.n_wheels * np.var(differences - mean * drawn_sample.has_gait)
    sum_of_squares += _variance_of_unseen_wheel(
        pilot_sample, pilot_sample.values - mean * pilot_sample.has_gait
    )
    variance = (
        sum_of_squares / (plan.n_wheels - 1) / plan.n_wheels * (1.0 - plan.n_wheels / n_wheels)
    )
    return float(mean), float(n_wheels / gait_count * math.sqrt(variance))


def _variance_of_unseen_wheel(pilot_sample: _SampledMeasures, centered_values: np.ndarray) -> float:
    """Return the variance due to one additional wheel that the control predicts wrongly, if gaits
    are lost.

    A small sample may contain no wheel that has a gait of the paper's model and none with
    unilateral contact.
    """
    return 0.0 if np.all(pilot_sample.has_gait) else float(np.var(centered_values))
