"""Compute measures and their means to within a tolerance.

Measures of each wheel are computed with the simplest model whose error can be bounded. For means
over many wheels with unilateral contact, the paper's model is a control variate.

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
import time
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import numpy as np

from vrw_jax.base.checks import (
    check_bool,
    check_choice,
    check_int,
    check_names,
    check_positive,
    check_type,
    require_known_name,
    require_untraced_arguments,
)
from vrw_jax.base.options import StepOptions
from vrw_jax.base.progress import announce_wait
from vrw_jax.base.results import (
    AbstractPrintable,
    LabelAndText,
    Outcome,
    describe_step_ending,
    format_each_batch_element,
    format_outcome_counts,
)
from vrw_jax.gaits.gait_walks import GaitChoice, parse_gait_choice
from vrw_jax.lanes.batching import select_rows_on_device, select_tree_rows
from vrw_jax.models.measures import MEASURES
from vrw_jax.studies.fidelity import (
    MEASURE_FUNCTIONS,
    MODEL_NAMES,
    TIGHT_TOLERANCE,
    VERY_TIGHT_TOLERANCE,
    ContactWheelBatch,
    ModelIndex,
    compute_static_leg_contraction,
    evaluate_measures,
    find_paper_gaits,
    find_rigid_gaits,
)
from vrw_jax.studies.refinement import (
    REQUEST_SAFETY_FACTOR,
    MeasureRequest,
    MeasureStatus,
    estimate_measures_from_lower_gaits,
)
from vrw_jax.wheel.params import FRICTION_NAME, WheelParams, convert_friction

MODEL_LABELS = ("no model", "the rigid wheel", "the paper's wheel", "unilateral contact")
"""Labels of the models in printed results, in the order of `ModelIndex`."""


class MeasureResult(AbstractPrintable):
    """Measures of a gait and bounds for their errors, computed by `vrw.measure_to_tolerance`.

    The properties `value`, `error`, `model_error` and `numerical_error` are dictionaries whose keys
    are names of measures. If a single name was requested, each property is the entry for that
    measure. For a batch, the entries and all other properties are arrays with the batch axis.
    Without a gait, the measure is NaN and the error infinite.

    - `values`, `errors`, `model_errors`, `numerical_errors`: measures, bounds for their errors,
      errors of the lower model, and bounds for the numerical errors. The last axis contains the
      measures;
    - `models`, `statuses`: `ModelIndex` and `MeasureStatus` of each batch element;
    - `states`: full section states near the gait, at which walks and searches with unilateral
      contact can start;
    - `n_steps`: number of walking steps with unilateral contact. A step with its Jacobian is
      equivalent to four steps;
    - `n_gaits`: number of gaits among which `which` selected; 0 if `which` is None;
    - `outcomes`: `Outcome` of each batch element: STEPPED, or the reason why no gait was found;
    - `names`, `is_single`: names of the measures, and whether the request was a single name;
    - `seconds`: wall-clock time of the whole call, s.

    Examples:
        >>> wheel = vrw.WheelParams(damping=150.0)
        >>> result = vrw.measure_to_tolerance("speed", wheel, 1e-6, friction=np.inf)
        >>> result.model, int(result.n_steps)
        ('viscoelastic', 1)
    """

    values: np.ndarray  # (*batch, measures)
    errors: np.ndarray
    model_errors: np.ndarray
    numerical_errors: np.ndarray
    states: np.ndarray  # (*batch, 4 + 3 n)
    models: np.ndarray  # (*batch,), indices in MODEL_NAMES
    statuses: np.ndarray
    n_steps: np.ndarray  # number of walking steps with unilateral contact
    outcomes: np.ndarray
    n_gaits: np.ndarray
    names: tuple[str, ...] = eqx.field(static=True)
    is_single: bool = eqx.field(static=True)
    seconds: float = eqx.field(static=True)  # wall-clock time of the whole call, s

    def _index_by_measure_name(self, measure_values: np.ndarray) -> Any:
        """Return the entries of the last axis as a dictionary by names of measures.

        If a single name was requested, return the array or number for that measure.
        """
        values_by_measure_name = {
            measure_name: measure_values[..., i] if self.models.ndim else float(measure_values[i])
            for i, measure_name in enumerate(self.names)
        }
        return values_by_measure_name[self.names[0]] if self.is_single else values_by_measure_name

    @property
    def value(self) -> Any:
        """Return the measure computed with the selected model, in the measure's unit."""
        return self._index_by_measure_name(self.values)

    @property
    def error(self) -> Any:
        """Return a bound for the total error of the measure, in the measure's unit."""
        return self._index_by_measure_name(self.errors)

    @property
    def model_error(self) -> Any:
        """Return the error of the measure computed with the lower model, in the measure's unit.

        It is the lower model's measure minus the measure with unilateral contact. `value` contains
        this error only if the lower model is selected. The error is NaN if the lower model has no
        gait.
        """
        return self._index_by_measure_name(self.model_errors)

    @property
    def numerical_error(self) -> Any:
        """Return a bound for the numerical error of the measure, in the measure's unit.

        Numerical errors are due to tolerances, meshes and iterations.
        """
        return self._index_by_measure_name(self.numerical_errors)

    @property
    def model(self) -> Any:
        """Return the name of the selected model; for a batch, an array of names."""
        selected_model_names = np.asarray(MODEL_NAMES)[self.models]
        return selected_model_names if self.models.ndim else str(selected_model_names)

    @property
    def found(self) -> Any:
        """Return whether a gait was found; for a batch, an array of flags."""
        return (self.outcomes == Outcome.STEPPED)[()]

    @property
    def ending(self) -> Any:
        """Return a sentence on how the gait search ended; for a batch, an array of sentences."""
        return describe_step_ending(self.outcomes, Outcome)

    @property
    def why(self) -> Any:
        """Return a sentence on why the model was selected; for a batch, an array of sentences."""

        def describe_selection(
            model_index: int, status: int, n_steps: int, search_outcome: int, n_gaits: int
        ) -> str:
            status_meaning = MeasureStatus(int(status)).meaning
            if status == MeasureStatus.NO_GAIT:
                outcome_meaning = Outcome(int(search_outcome)).meaning[:-1]
                gait_count_text = f"; gaits that attract: {n_gaits}" if n_gaits else ""
                return f"{status_meaning}: {outcome_meaning}{gait_count_text}"
            if status == MeasureStatus.SELECTED_BY_RANK:
                status_meaning = f"{status_meaning}, {n_gaits} in all"
            if status == MeasureStatus.CHECKED_BY_ONE_STEP:
                return f"{MODEL_LABELS[int(model_index)]}, {status_meaning}"
            return f"{MODEL_LABELS[int(model_index)]}, {n_steps} steps, {status_meaning}"

        return format_each_batch_element(
            describe_selection,
            self.models,
            self.statuses,
            self.n_steps,
            self.outcomes,
            self.n_gaits,
        )

    @property
    def printed_heading(self) -> str:
        if self.models.ndim:
            milliseconds = _format_rounded_number(1e3 * self.seconds)
            return f"MeasureResult, {self.models.size} wheels, {milliseconds} ms"
        measures_text = "; ".join(
            self._format_measure_value(measure_index) for measure_index in range(len(self.names))
        )
        return f"{measures_text}: {self.why}. {_format_rounded_number(1e3 * self.seconds)} ms"

    def summary_rows(self) -> list[LabelAndText]:
        if not self.models.ndim:
            return []
        model_counts_text = ", ".join(
            f"{np.sum(self.models == model_index)} {model_label}"
            for model_index, model_label in enumerate(MODEL_LABELS)
        )
        max_errors = np.max(self.errors[self.found], axis=0, initial=0.0)
        error_text_rows = [
            (f"largest error of {measure_name}", _format_rounded_number(max_error))
            for measure_name, max_error in zip(self.names, max_errors, strict=True)
        ]
        return [
            ("models", model_counts_text),
            ("outcomes", format_outcome_counts(self.outcomes, Outcome)),
            *error_text_rows,
        ]

    def _format_measure_value(self, measure_index: int) -> str:
        measure_definition = MEASURES[self.names[measure_index]]
        if not self.found:
            return f"no {measure_definition.name}"
        measure_value = float(self.values[measure_index])
        error_bound = float(self.errors[measure_index])
        n_decimals = max(0, math.ceil(-math.log10(max(error_bound, 1e-15))))
        value_text = f"{measure_value:.{n_decimals}f} {measure_definition.display_unit}".strip()
        error_parts_text = (
            f"numerical {_format_rounded_number(self.numerical_errors[measure_index])}"
        )
        if self.models != ModelIndex.UNILATERAL:
            model_error_text = _format_rounded_number(abs(self.model_errors[measure_index]))
            error_parts_text = f"model {model_error_text}, {error_parts_text}"
        return f"{value_text} ± {_format_rounded_number(error_bound)} ({error_parts_text})"


def _format_rounded_number(measure_value: float) -> str:
    """Return a number as text with three digits, or with one digit and a power of ten."""
    if measure_value == 0.0 or 0.1 <= abs(measure_value) < 1e4:
        return f"{measure_value:.3g}"
    mantissa_text, exponent_text = f"{measure_value:.0e}".split("e")
    return f"{mantissa_text}e{int(exponent_text)}"


# Smallest tolerance of a measure for which walking steps are computed at `TIGHT_TOLERANCE`. Below
# this value, they are computed at `VERY_TIGHT_TOLERANCE`.
MIN_TOL_FOR_TIGHT_STEPS = 1e-7


@announce_wait("gait steps of each model", "15 s")
def measure_to_tolerance(
    measures: str | Sequence[str],
    params: WheelParams,
    tol: float,
    *,
    friction: Any = 0.7,
    relative: bool = False,
    stoppers: str = "bilateral",
    which: GaitChoice | None = None,
) -> MeasureResult:
    """Return measures of the wheel's gait with unilateral contact, each to within `tol`.

    The reference model is `UnilateralWheel(friction, stoppers=stoppers)`. By default, the gait is
    the one that Newton's method reaches from the gait of the paper's model. If that gait is too far
    away, it is the gait that a walk from the paper's gait reaches. `MeasureResult.why` names the
    method. Fields of `params` and `friction` may have one batch axis; the elements of a batch are
    independent.

    This function cannot be used inside `jax.jit`, because the values of the arguments determine
    which models are computed.

    Args:
        measures: one name or several of speed, period, dls_fraction, step_length, duration_dls,
            duration_single, duration_flight, theta_touchdown, dtheta_touchdown, dL1_touchdown.
        params: the wheel, or a batch of wheels.
        tol: allowed error, in the measure's unit or relative to the value.
        friction: coefficient of Coulomb friction between feet and ground.
        relative: whether `tol` is relative to the value itself.
        stoppers: stoppers in the reference model, "bilateral" or "one-sided".
        which: "slowest", "fastest" or an index, slowest first, among the gaits with unilateral
            contact that walks from a stated set of starts reach. By default, the gait is the one
            described above.

    Returns:
        A `MeasureResult`: the value for each wheel, its error, and the models that were used.

    Raises:
        TypeError, ValueError: if an argument is invalid; the message names the remedy.

    Examples:
        >>> wheel = vrw.WheelParams(damping=150.0)
        >>> result = vrw.measure_to_tolerance("speed", wheel, 1e-3, friction=50.0)
        >>> print(f"{result.value:.2f} m/s", result.error <= 1e-3)
        1.02 m/s True
    """
    start_seconds = time.perf_counter()
    require_untraced_arguments(
        "vrw.measure_to_tolerance", "it on numbers, and give a batch as arrays", params, friction
    )
    measure_names = check_names("measures", measures)
    for measure_name in measure_names:
        require_known_name(measure_name, tuple(MEASURE_FUNCTIONS), "measure that every model has")
    if not measure_names:
        raise ValueError("measures is empty, but at least one is needed: give 'speed', say.")
    tol, relative = check_positive("tol", tol), check_bool("relative", relative)
    check_choice("stoppers", stoppers, ("bilateral", "one-sided"))
    params, friction_by_wheel, batch_shape = broadcast_params_and_friction(params, friction)
    gait_rank = None if which is None else parse_gait_choice(which)
    solver_tolerance = TIGHT_TOLERANCE if tol >= MIN_TOL_FOR_TIGHT_STEPS else VERY_TIGHT_TOLERANCE
    step_options = StepOptions(rtol=solver_tolerance, atol=solver_tolerance)
    step_options.check_tolerances(np.dtype(float))
    wheel_batch = ContactWheelBatch.from_params(params, friction_by_wheel, stoppers, step_options)
    measure_request = MeasureRequest(measure_names, tol, relative, wheel_batch, params)
    if gait_rank is None:
        with np.errstate(all="ignore"):
            contraction = compute_static_leg_contraction(params)
        measure_request.correct_lower_gaits(
            np.flatnonzero(REQUEST_SAFETY_FACTOR * contraction <= tol), find_rigid_gaits, False
        )
        measure_request.correct_lower_gaits(
            measure_request.find_unfinished_indices(),
            functools.partial(find_paper_gaits, step_options=step_options),
            True,
        )
        measure_request.walk_to_gaits()
    else:
        measure_request.select_gait_by_rank(gait_rank)
    result_arrays = jax.tree.map(
        lambda x: x.reshape(batch_shape + x.shape[1:]), measure_request.result_arrays
    )
    return MeasureResult(
        **result_arrays,
        names=measure_names,
        is_single=isinstance(measures, str),
        seconds=time.perf_counter() - start_seconds,
    )


def broadcast_params_and_friction(
    params: WheelParams, friction: Any
) -> tuple[WheelParams, np.ndarray, tuple[int, ...]]:
    """Return parameters and friction with one batch axis, and the batch shape of the arguments.

    The batch shape is () for a single wheel. Raise a ValueError if the arguments have several batch
    axes or different lengths.
    """
    check_type("params", params, WheelParams, "write vrw.WheelParams(damping=..., slope=...)")
    friction = convert_friction(friction)
    batch_argument_shapes = {
        np.shape(wheel_argument_array)
        for wheel_argument_array in (*jax.tree.leaves(params), friction)
    }
    batch_shape = max(batch_argument_shapes, key=len)
    if len(batch_shape) > 1 or batch_argument_shapes - {(), batch_shape}:
        shapes_text = ", ".join(map(str, sorted(batch_argument_shapes - {()})))
        raise ValueError(
            f"parameters and {FRICTION_NAME} have shapes {shapes_text}, but a batch has one "
            "axis, the same for all: give one value for all, or one for each element."
        )
    n_wheels = batch_shape[0] if batch_shape else 1
    broadcast_to_batch = lambda wheel_argument_array: np.broadcast_to(
        np.asarray(wheel_argument_array, float), (n_wheels,)
    )
    return (jax.tree.map(broadcast_to_batch, params), broadcast_to_batch(friction), batch_shape)


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


@announce_wait("gaits of each model", "20 s")
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
    tol, seed = check_positive("tol", tol), check_int("seed", seed, 0)
    pilot = check_int("pilot", pilot, MIN_PILOT_GAITS, ", to estimate a variance")
    params, friction, batch_shape = broadcast_params_and_friction(params, friction)
    n_wheels = len(friction)
    if not batch_shape or n_wheels <= pilot:
        raise ValueError(
            f"there are {n_wheels} wheels and a pilot of {pilot}, but a mean needs more wheels "
            "than its pilot: give a batch, params.damping of shape (1000,), say."
        )
    measure_wheels = lambda indices: measure_to_tolerance(
        measure, select_rows_on_device(params, indices), GAIT_ERROR_FRACTION * tol,
        friction=friction[indices], stoppers=stoppers,
    )  # fmt: skip
    evaluate_control = functools.partial(_evaluate_control, measure, params, friction, stoppers)
    wheels = np.random.default_rng(seed).permutation(n_wheels)
    pilot_wheels, other_wheels = wheels[:pilot], wheels[pilot:]
    pilot_results = measure_wheels(pilot_wheels)
    if (n_pilot_gaits := np.sum(pilot_results.found)) < MIN_PILOT_GAITS:
        raise ValueError(
            f"{n_pilot_gaits} of the pilot's {pilot} wheels have a gait with contact, but "
            f"a mean needs {MIN_PILOT_GAITS}: give other wheels, or a larger pilot."
        )
    pilot_values, n_mean_steps = _zero_missing(pilot_results), np.mean(pilot_results.n_steps)
    plans = []
    for name, cost in CONTROL_VARIATES.items():
        regressors = evaluate_control(pilot_wheels, name)
        n_drawn, weights = _plan_sampling(*pilot_values, regressors, tol, len(other_wheels))
        total_cost = n_drawn * float(n_mean_steps) + cost * len(other_wheels)
        plans.append((total_cost, n_drawn, weights, name))
    _, n_drawn, weights, control = min(plans, key=operator.itemgetter(0))
    drawn_results = measure_wheels(other_wheels[:n_drawn])
    regressors, results = evaluate_control(other_wheels, control), (pilot_results, drawn_results)
    have_gaits = _have_all_gaits(np.concatenate([x.found for x in results]), regressors)
    mean, standard_error = _estimate_mean(
        *pilot_values, *_zero_missing(drawn_results), regressors @ weights, have_gaits
    )
    gait_error_bounds = np.concatenate([x.error[x.found] for x in results])
    n_steps = float(sum(np.sum(x.n_steps) for x in results))
    return MultifidelityMean(
        value=mean,
        error=N_STANDARD_ERRORS * standard_error + float(np.mean(gait_error_bounds)),
        n_gaits=float(len(gait_error_bounds)),
        n_high_fidelity=float(pilot + n_drawn),
        weight=float(weights[0]),
        cost=n_steps + CONTROL_VARIATES[control] * n_wheels,
        cost_high_fidelity_only=float(n_mean_steps) * pilot + plans[0][0],
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
    pilot_mean = np.mean(pilot_values) / gait_fraction
    centered_values = pilot_values - pilot_mean * has_gait
    # With the mean subtracted, a wheel with a gait in neither model needs no weight of the second
    # column, which a pilot sample without such wheels cannot determine.
    subtract_mean = np.array([[1.0, 0.0], [-pilot_mean, 1.0]])
    regressors = regressors @ subtract_mean
    centered_regressors = regressors - np.mean(regressors, axis=0)
    weights, _, rank, _ = np.linalg.lstsq(
        centered_regressors, centered_values, rcond=SINGULAR_VALUE_TOLERANCE
    )
    squared_residuals = float(np.sum((centered_values - centered_regressors @ weights) ** 2))
    if not _have_all_gaits(has_gait, regressors):
        squared_residuals += float(np.var(centered_values))
    variance = squared_residuals / (len(centered_values) - 1 - int(rank))
    sampling_tolerance = (1.0 - GAIT_ERROR_FRACTION) * tolerance
    n_required = variance * (N_STANDARD_ERRORS / (sampling_tolerance * gait_fraction)) ** 2
    n_drawn = math.ceil(n_required / (1.0 + n_required / n_remaining))
    return min(n_remaining, max(MIN_PILOT_GAITS, n_drawn)), subtract_mean @ weights


def _estimate_mean(
    pilot_values: np.ndarray,
    pilot_has_gait: np.ndarray,
    drawn_values: np.ndarray,
    drawn_has_gait: np.ndarray,
    control_values: np.ndarray,
    have_gaits: bool,
) -> tuple[float, float]:
    """Return the mean of a measure and its standard error.

    - `control_values`: weighted control variates of all wheels outside the pilot sample. The drawn
      wheels come first;
    - `have_gaits`: see `_have_all_gaits`.
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
    if not have_gaits:
        squared_residuals += np.var(pilot_values - mean * pilot_has_gait)
    variance = squared_residuals / (n_drawn - 1) / n_drawn * (1.0 - n_drawn / n_remaining)
    return float(mean), float(n_remaining / n_gaits * math.sqrt(variance))


def _have_all_gaits(has_gait: np.ndarray, regressors: np.ndarray) -> bool:
    """Return whether no wheel is known to lack a gait in one of the models.

    Otherwise some wheels may have a gait in one model only, so that their control variate is wrong.
    A small sample may contain no such wheel. Callers therefore add the variance of one such wheel.
    """
    return bool(np.all(has_gait) and np.all(regressors[:, 1] == regressors[0, 1]))
