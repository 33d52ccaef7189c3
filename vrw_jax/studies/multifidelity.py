"""Means over many wheels with unilateral contact, with the paper's model as a control variate.

The measure is computed with the paper's model for all wheels. Only the difference from the measure
with unilateral contact is sampled (M. B. Giles, Acta Numerica 24, 2015; B. Peherstorfer, K. Willcox
and M. Gunzburger, SIAM Review 60, 2018). A pilot sample of wheels determines which control variate
reduces the total cost most, its weight, and the number of further wheels.

The measures of the pilot's wheels enter the sum directly, and further wheels are drawn from the
remaining wheels. The weight is therefore never applied to the measures from which it was computed,
and the mean is unbiased. If some wheels have no gait, the mean is a ratio of sums over all wheels.
Its bias is then inversely proportional to the number of sampled wheels.
"""

import math
from typing import Any, NamedTuple

import equinox as eqx
import numpy as np

from vrw_jax.base.checks import (
    check_choice,
    check_int,
    check_positive,
    check_type,
    require_known_name,
    require_untraced_arguments,
)
from vrw_jax.base.options import StepOptions
from vrw_jax.base.printing import AbstractPrintable, LabelAndText
from vrw_jax.base.progress import announce_wait
from vrw_jax.lanes.batching import select_tree_rows
from vrw_jax.models.measures import MEASURES
from vrw_jax.studies.fidelity import (
    MEASURE_FUNCTIONS,
    ContactWheelBatch,
    ModelIndex,
    evaluate_measures,
    find_paper_gaits,
    select_wheels,
)
from vrw_jax.studies.refinement import estimate_measures_from_lower_gaits
from vrw_jax.studies.tolerance_request import (
    MeasureResult,
    broadcast_params_and_friction,
    measure_to_tolerance,
)
from vrw_jax.wheel.params import WheelParams


class _ControlVariate(NamedTuple):
    """Name of a control variate, and its cost per wheel in steps with unilateral contact."""

    control_variate_name: str
    cost_in_steps: float


CONTROL_VARIATES = (
    _ControlVariate("no control", 0.0),
    _ControlVariate("the paper's gaits", 1.0),
    _ControlVariate("the paper's gaits with one contact step", 2.0),
)
"""Control variates. The sampling uses the control variate whose plan has the lowest cost.

In batches, the paper's gait costs as much as one walking step with unilateral contact.
"""


class MultifidelityMean(AbstractPrintable):
    """Mean of a measure over wheels with unilateral contact.

    - `measure`: name of the measure;
    - `value`: mean, in the measure's unit;
    - `error`: two standard errors of the mean, plus the mean of the error bounds for the gaits;
    - `n_gaits`: number of sampled wheels that have a gait with unilateral contact;
    - `n_high_fidelity`: number of wheels computed with unilateral contact, including the pilot
      sample;
    - `control`: name of the control variate;
    - `weight`: weight of the control variate;
    - `cost`: total cost in walking steps with unilateral contact, including the equivalent cost of
      the control variate;
    - `cost_high_fidelity_only`: expected cost of a mean with the same error, computed without a
      control variate, in walking steps.

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
        """Return a sentence with the number of wheels computed with unilateral contact."""
        return (
            f"{self.n_high_fidelity:.0f} wheels were computed with unilateral contact; "
            f"{self.n_gaits:.0f} of them have a gait."
        )

    def summary_rows(self) -> list[LabelAndText]:
        measure_unit = MEASURES[self.measure].display_unit
        return [
            (f"mean {self.measure}", f"{self.value:.6g} ± {self.error:.1g} {measure_unit}".strip()),
            (
                "with unilateral contact",
                f"{self.n_high_fidelity:.0f} wheels, {self.n_gaits:.0f} of them with a gait",
            ),
            ("control", f"{self.control}, weight {self.weight:.3g}"),
            ("contact steps", f"{self.cost:.3g}, alone {self.cost_high_fidelity_only:.3g}"),
        ]


class _SamplingPlan(NamedTuple):
    """Plan of the sampling for a mean with one of the control variates."""

    expected_cost_in_steps: float  # expected cost, walking steps
    n_drawn_wheels: int  # number of further wheels to compute with unilateral contact
    control_weights: np.ndarray  # (2,): weights of the two control columns
    control_index: int  # index in `CONTROL_VARIATES`


# Number of standard errors in the reported error of a mean.
N_STANDARD_ERRORS = 2.0
# Allowed error of each gait's measure, as a fraction of the mean's allowed error.
GAIT_ERROR_FRACTION = 0.1
# Smallest number of wheels with a gait in the pilot sample, from which the variance is estimated.
MIN_PILOT_GAITS = 8


@announce_wait("gaits of each model", "30 s")
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
    """Return the mean of a measure over wheels with unilateral contact, to within `tol`.

    Fields of `params` and `friction` have one axis over the wheels. The wheels are, for example,
    samples of manufacturing tolerances. The mean is over the wheels that have a gait with
    unilateral contact. Most wheels are computed with a cheaper model of lower fidelity.

    Args:
        measure: name of one of the measures of `measure_to_tolerance`.
        params: the wheels.
        tol: allowed error (two standard errors), in the measure's unit.
        friction: friction coefficient of the ground.
        pilot: number of wheels in the pilot sample.
        seed: seed of the random sample.
        stoppers: stoppers of the wheels, "bilateral" or "one-sided".

    Returns:
        A `MultifidelityMean`: the mean, its error, and its cost.

    Raises:
        TypeError, ValueError: if an argument is invalid, or if too few wheels have a gait.

    Examples:
        >>> wheels = vrw.WheelParams(damping=jnp.linspace(120.0, 200.0, 60))
        >>> mean = vrw.multifidelity_mean("speed", wheels, 1e-2, friction=15.0, pilot=12)
        >>> bool(mean.error < 1.1e-2)
        True
    """
    require_untraced_arguments(
        "vrw.multifidelity_mean", "it on numbers, and give wheels as arrays", params, friction
    )
    check_type("measure", measure, str, "give the name of one, 'speed', say")
    require_known_name(measure, tuple(MEASURE_FUNCTIONS), "measure that every model has")
    check_choice("stoppers", stoppers, ("bilateral", "one-sided"))
    tol = check_positive("tol", tol)
    pilot = check_int("pilot", pilot, MIN_PILOT_GAITS, ", to estimate a variance")
    seed = check_int("seed", seed, 0)
    params, friction_by_wheel, batch_shape = broadcast_params_and_friction(params, friction)
    n_wheels = len(friction_by_wheel)
    if not batch_shape or n_wheels <= pilot:
        raise ValueError(
            f"there are {n_wheels} wheels and a pilot of {pilot}, but a mean needs more wheels "
            "than its pilot: give a batch, params.damping of shape (1000,), say."
        )
    measured_wheels = _MeasuredWheels(measure, params, friction_by_wheel, stoppers)
    wheel_permutation = np.random.default_rng(seed).permutation(n_wheels)
    pilot_wheel_indices, remaining_wheel_indices = np.split(wheel_permutation, [pilot])
    gait_measure_tolerance = GAIT_ERROR_FRACTION * tol
    pilot_measure_results = measured_wheels.measure_selected_wheels(
        pilot_wheel_indices, gait_measure_tolerance
    )
    has_pilot_gait = pilot_measure_results.found
    if np.sum(has_pilot_gait) < MIN_PILOT_GAITS:
        raise ValueError(
            f"{np.sum(has_pilot_gait)} of the pilot's {pilot} wheels have a gait with contact, but "
            f"a mean needs {MIN_PILOT_GAITS}: give other wheels, or a larger pilot."
        )
    pilot_sample = _SampledMeasures.from_results(pilot_measure_results)
    sampling_plans = [
        _plan_sampling(
            control_index,
            pilot_sample,
            measured_wheels.evaluate_control_regressors(pilot_wheel_indices, control_index),
            tol,
            len(remaining_wheel_indices),
        )
        for control_index in range(len(CONTROL_VARIATES))
    ]
    sampling_plan = min(
        sampling_plans, key=lambda sampling_plan: sampling_plan.expected_cost_in_steps
    )
    drawn_measure_results = measured_wheels.measure_selected_wheels(
        remaining_wheel_indices[: sampling_plan.n_drawn_wheels], gait_measure_tolerance
    )
    estimated_mean, standard_error = _estimate_mean(
        sampling_plan,
        pilot_sample,
        _SampledMeasures.from_results(drawn_measure_results),
        measured_wheels.evaluate_control_regressors(
            remaining_wheel_indices, sampling_plan.control_index
        ),
    )
    gait_error_bounds = np.concatenate(
        [
            pilot_measure_results.error[has_pilot_gait],
            drawn_measure_results.error[drawn_measure_results.found],
        ]
    )
    return MultifidelityMean(
        value=estimated_mean,
        error=N_STANDARD_ERRORS * standard_error + float(np.mean(gait_error_bounds)),
        n_gaits=float(len(gait_error_bounds)),
        n_high_fidelity=float(pilot + sampling_plan.n_drawn_wheels),
        weight=float(sampling_plan.control_weights[0]),
        cost=float(np.sum(pilot_measure_results.n_steps) + np.sum(drawn_measure_results.n_steps))
        + CONTROL_VARIATES[sampling_plan.control_index].cost_in_steps * n_wheels,
        cost_high_fidelity_only=pilot_sample.mean_steps_per_wheel * pilot
        + sampling_plans[0].expected_cost_in_steps,
        measure=measure,
        control=CONTROL_VARIATES[sampling_plan.control_index].control_variate_name,
    )


class _SampledMeasures(NamedTuple):
    """Measures with unilateral contact for the wheels in a sample."""

    measure_values: np.ndarray  # measure of each wheel, zero if the wheel has no gait
    has_gait: np.ndarray  # whether the wheel has a gait
    mean_steps_per_wheel: float  # mean number of walking steps per wheel

    @classmethod
    def from_results(cls, measure_results: MeasureResult) -> "_SampledMeasures":
        """Return the sampled measures from the result of `measure_to_tolerance`."""
        return cls(
            np.where(measure_results.found, measure_results.value, 0.0),
            measure_results.found.astype(float),
            float(np.mean(measure_results.n_steps)),
        )


class _MeasuredWheels(NamedTuple):
    """All wheels of a mean, and the name of the averaged measure."""

    measure_name: str
    params: WheelParams
    friction_coefficients: np.ndarray
    stoppers: str

    def measure_selected_wheels(
        self, wheel_indices: np.ndarray, measure_tolerance: float
    ) -> MeasureResult:
        """Return the measure with unilateral contact for the selected wheels."""
        return measure_to_tolerance(
            self.measure_name,
            select_wheels(self.params, wheel_indices),
            measure_tolerance,
            friction=self.friction_coefficients[wheel_indices],
            stoppers=self.stoppers,
        )

    def evaluate_control_regressors(
        self, wheel_indices: np.ndarray, control_index: int
    ) -> np.ndarray:
        """Return the two regressors for the regression on a control variate, shape (wheels, 2).

        The first column is the control variate, or zero for a wheel for which the paper's model has
        no gait. The second column is 1 for a wheel with a finite control variate and 0 otherwise.
        `control_index` is an index in `CONTROL_VARIATES`.
        """
        control_values = np.full(len(wheel_indices), np.nan)
        if control_index:
            step_options = StepOptions()
            paper_gaits = find_paper_gaits(select_wheels(self.params, wheel_indices), step_options)
            (found_wheel_indices,) = np.nonzero(paper_gaits.model_index != ModelIndex.NONE)
            paper_gaits = select_tree_rows(paper_gaits, found_wheel_indices)
            measure_values = evaluate_measures([self.measure_name], paper_gaits.step_quantities)
            if control_index == len(CONTROL_VARIATES) - 1:
                wheel_indices_of_gaits = wheel_indices[found_wheel_indices]
                wheel_batch = ContactWheelBatch.from_params(
                    select_wheels(self.params, wheel_indices_of_gaits),
                    self.friction_coefficients[wheel_indices_of_gaits],
                    self.stoppers,
                    step_options,
                )
                gait_indices = np.arange(len(wheel_indices_of_gaits))
                *_, measure_estimates = estimate_measures_from_lower_gaits(
                    wheel_batch, gait_indices, paper_gaits, [self.measure_name]
                )
                measure_values = np.where(
                    measure_estimates.has_same_leg_codes[:, None],
                    measure_estimates.measure_values,
                    measure_values,
                )
            control_values[found_wheel_indices] = measure_values[:, 0]
        is_control_finite = np.isfinite(control_values)
        return np.column_stack(
            [np.where(is_control_finite, control_values, 0.0), is_control_finite]
        )


# Fraction of the largest singular value below which a singular value of the control columns is
# treated as zero.
SINGULAR_VALUE_TOLERANCE = 1e-12


def _plan_sampling(
    control_index: int,
    pilot_sample: _SampledMeasures,
    control_regressors: np.ndarray,
    mean_tolerance: float,
    n_remaining_wheels: int,
) -> _SamplingPlan:
    """Return the sampling plan for a mean to within `mean_tolerance`, with one control variate.

    The pilot sample determines the weights of the control columns and the number of further wheels.
    The mean M over the wheels with a gait is a ratio of two sums. The controlled quantity is the
    wheel's measure minus M, or zero for a wheel without a gait. The sum of this quantity over all
    wheels is zero.
    """
    fraction_of_wheels_with_gait = float(np.mean(pilot_sample.has_gait))
    centered_measure_values = (
        pilot_sample.measure_values
        - np.mean(pilot_sample.measure_values)
        / fraction_of_wheels_with_gait
        * pilot_sample.has_gait
    )
    centered_control_regressors = control_regressors - np.mean(control_regressors, axis=0)
    control_weights, _, matrix_rank, _ = np.linalg.lstsq(
        centered_control_regressors,
        centered_measure_values,
        rcond=SINGULAR_VALUE_TOLERANCE,
    )
    residual_sum_of_squares = float(
        np.sum((centered_measure_values - centered_control_regressors @ control_weights) ** 2)
    ) + _compute_unseen_wheel_variance(pilot_sample, centered_measure_values)
    residual_variance = residual_sum_of_squares / (
        len(centered_measure_values) - 1 - int(matrix_rank)
    )
    sampling_tolerance = (1.0 - GAIT_ERROR_FRACTION) * mean_tolerance
    n_required_wheels = (
        residual_variance
        * (N_STANDARD_ERRORS / (sampling_tolerance * fraction_of_wheels_with_gait)) ** 2
    )
    n_drawn_wheels = min(
        n_remaining_wheels,
        max(
            MIN_PILOT_GAITS,
            math.ceil(n_required_wheels / (1.0 + n_required_wheels / n_remaining_wheels)),
        ),
    )
    return _SamplingPlan(
        n_drawn_wheels * pilot_sample.mean_steps_per_wheel
        + CONTROL_VARIATES[control_index].cost_in_steps * n_remaining_wheels,
        n_drawn_wheels,
        control_weights,
        control_index,
    )


def _estimate_mean(
    sampling_plan: _SamplingPlan,
    pilot_sample: _SampledMeasures,
    drawn_sample: _SampledMeasures,
    control_regressors: np.ndarray,
) -> tuple[float, float]:
    """Return the mean of a measure and its standard error.

    - `control_regressors`: control columns of all wheels outside the pilot sample. The drawn wheels
      come first.
    """
    n_remaining_wheels = len(control_regressors)
    control_values = control_regressors @ sampling_plan.control_weights
    estimated_gait_count = np.sum(pilot_sample.has_gait) + n_remaining_wheels * np.mean(
        drawn_sample.has_gait
    )
    control_value_differences = (
        drawn_sample.measure_values - control_values[: sampling_plan.n_drawn_wheels]
    )
    measure_mean = (
        np.sum(pilot_sample.measure_values)
        + n_remaining_wheels * (np.mean(control_values) + np.mean(control_value_differences))
    ) / estimated_gait_count
    residual_sum_of_squares = sampling_plan.n_drawn_wheels * np.var(
        control_value_differences - measure_mean * drawn_sample.has_gait
    )
    residual_sum_of_squares += _compute_unseen_wheel_variance(
        pilot_sample, pilot_sample.measure_values - measure_mean * pilot_sample.has_gait
    )
    mean_variance = (
        residual_sum_of_squares
        / (sampling_plan.n_drawn_wheels - 1)
        / sampling_plan.n_drawn_wheels
        * (1.0 - sampling_plan.n_drawn_wheels / n_remaining_wheels)
    )
    return float(measure_mean), float(
        n_remaining_wheels / estimated_gait_count * math.sqrt(mean_variance)
    )


def _compute_unseen_wheel_variance(
    pilot_sample: _SampledMeasures, centered_measure_values: np.ndarray
) -> float:
    """Return the variance due to one more wheel whose control variate is wrong.

    A wheel may have a gait in the paper's model and no gait with unilateral contact. A small sample
    may contain no such wheel. The result is zero if all wheels in the pilot sample have a gait.
    """
    return 0.0 if np.all(pilot_sample.has_gait) else float(np.var(centered_measure_values))
