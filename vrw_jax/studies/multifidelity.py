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

import functools
import math
import operator
from typing import Any

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
from vrw_jax.lanes.batching import (
    select_rows_on_device,
    select_tree_rows,
)
from vrw_jax.models.measures import MEASURES
from vrw_jax.studies.fidelity import (
    MEASURE_FUNCTIONS,
    ContactWheelBatch,
    ModelIndex,
    evaluate_measures,
    find_paper_gaits,
)
from vrw_jax.studies.refinement import estimate_measures_from_lower_gaits
from vrw_jax.studies.tolerance_request import (
    MeasureResult,
    broadcast_params_and_friction,
    measure_to_tolerance,
)
from vrw_jax.wheel.params import WheelParams

CONTROL_VARIATES = {
    "no control": 0.0,
    "the paper's gaits": 1.0,
    "the paper's gaits with one contact step": 2.0,
}
"""Costs per wheel of the control variates, in steps with unilateral contact, by name. The sampling
uses the control variate whose plan has the lowest cost.

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

    def measure_wheels(indices: np.ndarray) -> MeasureResult:
        return measure_to_tolerance(
            measure,
            select_rows_on_device(params, indices),
            GAIT_ERROR_FRACTION * tol,
            friction=friction_by_wheel[indices],
            stoppers=stoppers,
        )

    evaluate_control = functools.partial(
        _evaluate_control, measure, params, friction_by_wheel, stoppers
    )
    pilot_wheels, other_wheels = np.split(
        np.random.default_rng(seed).permutation(n_wheels), [pilot]
    )
    pilot_results = measure_wheels(pilot_wheels)
    has_pilot_gait = pilot_results.found
    if np.sum(has_pilot_gait) < MIN_PILOT_GAITS:
        raise ValueError(
            f"{np.sum(has_pilot_gait)} of the pilot's {pilot} wheels have a gait with contact, but "
            f"a mean needs {MIN_PILOT_GAITS}: give other wheels, or a larger pilot."
        )
    pilot_values, mean_steps = _zero_missing(pilot_results), float(np.mean(pilot_results.n_steps))
    plans = []
    for name, cost in CONTROL_VARIATES.items():
        n_drawn, weights = _plan_sampling(
            *pilot_values, evaluate_control(pilot_wheels, name), tol, len(other_wheels)
        )
        plans.append((n_drawn * mean_steps + cost * len(other_wheels), n_drawn, weights, name))
    _, n_drawn, weights, control = min(plans, key=operator.itemgetter(0))
    drawn_results = measure_wheels(other_wheels[:n_drawn])
    mean, standard_error = _estimate_mean(
        *pilot_values,
        *_zero_missing(drawn_results),
        evaluate_control(other_wheels, control) @ weights,
    )
    gait_error_bounds = np.concatenate([x.error[x.found] for x in (pilot_results, drawn_results)])
    n_steps = float(np.sum(pilot_results.n_steps) + np.sum(drawn_results.n_steps))
    return MultifidelityMean(
        value=mean,
        error=N_STANDARD_ERRORS * standard_error + float(np.mean(gait_error_bounds)),
        n_gaits=float(len(gait_error_bounds)),
        n_high_fidelity=float(pilot + n_drawn),
        weight=float(weights[0]),
        cost=n_steps + CONTROL_VARIATES[control] * n_wheels,
        cost_high_fidelity_only=mean_steps * pilot + plans[0][0],
        measure=measure,
        control=control,
    )


def _zero_missing(results: MeasureResult) -> tuple[np.ndarray, np.ndarray]:
    """Return the measure of each wheel, zero if it has no gait, and whether it has one, 1 or 0."""
    return np.where(results.found, results.value, 0.0), results.found.astype(float)


def _evaluate_control(
    measure: str,
    params: WheelParams,
    friction: np.ndarray,
    stoppers: str,
    indices: np.ndarray,
    control: str,
) -> np.ndarray:
    """Return the two regressors for the regression on a control variate, shape (wheels, 2).

    - `indices`: indices of the evaluated wheels.

    The first column is the control variate, or zero for a wheel for which the paper's model has no
    gait. The second column is 1 for a wheel with a finite control variate and 0 otherwise.
    """
    params, friction = select_rows_on_device(params, indices), friction[indices]
    control_values = np.full(len(friction), np.nan)
    no_control, _, one_step = CONTROL_VARIATES
    if control != no_control:
        options = StepOptions()
        gaits = find_paper_gaits(params, options)
        (found,) = np.nonzero(gaits.model_index != ModelIndex.NONE)
        gaits = select_tree_rows(gaits, found)
        values = evaluate_measures([measure], gaits.step_quantities)
        if control == one_step:
            wheel_batch = ContactWheelBatch.from_params(
                select_rows_on_device(params, found), friction[found], stoppers, options
            )
            *_, estimates = estimate_measures_from_lower_gaits(
                wheel_batch, np.arange(len(found)), gaits, [measure]
            )
            has_same_codes = estimates.has_same_leg_codes[:, None]
            values = np.where(has_same_codes, estimates.measure_values, values)
        control_values[found] = values[:, 0]
    is_finite = np.isfinite(control_values)
    return np.column_stack([np.where(is_finite, control_values, 0.0), is_finite])


# Fraction of the largest singular value below which a singular value of the control columns is
# treated as zero.
SINGULAR_VALUE_TOLERANCE = 1e-12


def _plan_sampling(
    pilot_values: np.ndarray,
    has_gait: np.ndarray,
    regressors: np.ndarray,
    tolerance: float,
    n_remaining: int,
) -> tuple[int, np.ndarray]:
    """Return the number of further wheels for a mean to within `tolerance`, and the weights of the
    two control columns.

    The pilot sample determines both. The mean M over the wheels with a gait is a ratio of two sums.
    The controlled quantity is the wheel's measure minus M, or zero for a wheel without a gait. The
    sum of this quantity over all wheels is zero.
    """
    gait_fraction = float(np.mean(has_gait))
    centered_values = pilot_values - np.mean(pilot_values) / gait_fraction * has_gait
    centered_regressors = regressors - np.mean(regressors, axis=0)
    weights, _, rank, _ = np.linalg.lstsq(
        centered_regressors, centered_values, rcond=SINGULAR_VALUE_TOLERANCE
    )
    squared_residuals = float(np.sum((centered_values - centered_regressors @ weights) ** 2))
    squared_residuals += _compute_unseen_wheel_variance(has_gait, centered_values)
    variance = squared_residuals / (len(centered_values) - 1 - int(rank))
    sampling_tolerance = (1.0 - GAIT_ERROR_FRACTION) * tolerance
    n_required = variance * (N_STANDARD_ERRORS / (sampling_tolerance * gait_fraction)) ** 2
    n_drawn = math.ceil(n_required / (1.0 + n_required / n_remaining))
    return min(n_remaining, max(MIN_PILOT_GAITS, n_drawn)), weights


def _estimate_mean(
    pilot_values: np.ndarray,
    pilot_has_gait: np.ndarray,
    drawn_values: np.ndarray,
    drawn_has_gait: np.ndarray,
    control_values: np.ndarray,
) -> tuple[float, float]:
    """Return the mean of a measure and its standard error.

    - `control_values`: weighted control variates of all wheels outside the pilot sample. The drawn
      wheels come first.
    """
    n_remaining, n_drawn = len(control_values), len(drawn_values)
    n_gaits = np.sum(pilot_has_gait) + n_remaining * np.mean(drawn_has_gait)
    differences = drawn_values - control_values[:n_drawn]
    mean = (
        np.sum(pilot_values) + n_remaining * (np.mean(control_values) + np.mean(differences))
    ) / n_gaits
    if n_drawn == n_remaining:  # The gaits of all wheels are computed, perhaps of one only.
        return float(mean), 0.0
    squared_residuals = n_drawn * np.var(differences - mean * drawn_has_gait)
    squared_residuals += _compute_unseen_wheel_variance(
        pilot_has_gait, pilot_values - mean * pilot_has_gait
    )
    variance = squared_residuals / (n_drawn - 1) / n_drawn * (1.0 - n_drawn / n_remaining)
    return float(mean), float(n_remaining / n_gaits * math.sqrt(variance))


def _compute_unseen_wheel_variance(has_gait: np.ndarray, centered_values: np.ndarray) -> float:
    """Return the variance due to one more wheel whose control variate is wrong.

    A wheel may have a gait in the paper's model and no gait with unilateral contact. A small sample
    may contain no such wheel. The result is zero if all wheels in the pilot sample have a gait.
    """
    return 0.0 if np.all(has_gait) else float(np.var(centered_values))
