"""Compute measures to within a tolerance, from the simplest model whose error can be bounded.

One walking step with unilateral contact starts at the gait of the lower model. The defect of this
step, propagated to the measure by the lower model's derivatives, approximates the model error to
second order. The estimate is a dual-weighted residual (R. Becker and R. Rannacher, Acta Numerica
10, 2001), in which the next model replaces the finer mesh. If the error is within the tolerance,
the lower model's measure is returned. Otherwise Newton's method, starting at the end of that step,
finds the gait with unilateral contact. If that gait is far from the lower model's gait, a walk to
another gait is computed.
"""

import functools
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import numpy as np

from vrw_jax.base.checks import (
    check_bool,
    check_choice,
    check_names,
    check_positive,
    check_type,
    require_known_name,
    require_untraced_arguments,
)
from vrw_jax.base.options import StepOptions
from vrw_jax.base.outcomes import Outcome
from vrw_jax.base.printing import (
    AbstractPrintable,
    LabelAndText,
    StatusCode,
    describe_step_ending,
    format_each_batch_element,
    format_outcome_counts,
)
from vrw_jax.base.progress import announce_wait
from vrw_jax.gaits.gait_search import GaitChoice, parse_gait_choice
from vrw_jax.gaits.gait_walks import compute_walk_starts
from vrw_jax.lanes.batching import (
    replace_rows,
    select_rows_on_device,
    select_tree_rows,
)
from vrw_jax.models.measures import MEASURES
from vrw_jax.studies.fidelity import (
    MEASURE_FUNCTIONS,
    MODEL_NAMES,
    TIGHT_TOLERANCE,
    VERY_TIGHT_TOLERANCE,
    ContactWheelBatch,
    LowerFidelityGaits,
    ModelIndex,
    compute_static_leg_contraction,
    evaluate_measures,
    find_paper_gaits,
    find_rigid_gaits,
    multiply_rows,
)
from vrw_jax.studies.refinement import (
    RefinedGaits,
    estimate_measures_from_lower_gaits,
    refine_gaits,
    walk_until_settled,
)
from vrw_jax.wheel.params import FRICTION_NAME, WheelParams, convert_friction


class MeasureStatus(StatusCode):
    """Method by which a measure was computed."""

    CHECKED_BY_ONE_STEP = 0, "checked by one step with unilateral contact"
    CONTINUES_LOWER_GAIT = 1, "the gait that continues the lower model's"
    REACHED_FROM_LOWER_GAIT = (
        2,
        "a gait to which a walk from the lower model's gait leads",
    )
    REACHED_FROM_START = (
        3,
        "a gait to which a walk from a start leads, as the paper's wheel has no gait",
    )
    NO_GAIT = 4, "no such gait with unilateral contact"
    SELECTED_BY_RANK = 5, "one of the attracting gaits"


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


@announce_wait("gait steps of each model", "30 s")
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
    measure_request = _MeasureRequest(measure_names, tol, relative, wheel_batch, params)
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
    return (
        jax.tree.map(broadcast_to_batch, params),
        broadcast_to_batch(friction),
        batch_shape,
    )


# Ratio of the error bound to the error estimated from one walking step. It is chosen because the
# bound holds if each Newton correction is at most 3/4 as long as the previous correction.
REQUEST_SAFETY_FACTOR = 4.0
# Number of starts of walks, slow starts first, for wheels for which the lower model has no gait. It
# is chosen because walks from the first two starts reach a gait for 100 of 232 wheels. Walks from
# further starts reach a gait for no other wheel.
N_COLD_STARTS = 2
# Largest accepted distance between the lower model's gait and the gait with unilateral contact, in
# lengths of the first correction. It is chosen because the sum of corrections that are halved each
# time is twice the first correction.
MAX_GAIT_DISTANCE_RATIO = 2.0


@dataclass
class _MeasureRequest:
    """State of the computation of measures for a batch of wheels, with the results so far."""

    measure_names: tuple[str, ...]
    tol: float
    relative: bool
    wheel_batch: ContactWheelBatch
    params: WheelParams

    def __post_init__(self) -> None:
        n_wheels = self.wheel_batch.parameter_matrix.shape[1]
        self.lower_gaits = LowerFidelityGaits.without_gait(n_wheels)
        fill = lambda value: np.full((n_wheels, len(self.measure_names)), value)
        all_wheels = np.arange(n_wheels)
        self.result_arrays = {
            "values": fill(np.nan),
            "errors": fill(np.inf),
            "model_errors": fill(np.nan),
            "numerical_errors": fill(np.inf),
            "models": np.full(n_wheels, ModelIndex.NONE),
            "statuses": np.full(n_wheels, int(MeasureStatus.NO_GAIT)),
            "n_steps": np.zeros(n_wheels, int),
            "outcomes": np.full(n_wheels, int(Outcome.NO_CYCLE_FOUND)),
            "n_gaits": np.zeros(n_wheels, int),
            "states": self.wheel_batch.embed_paper_states(all_wheels, np.zeros((n_wheels, 3))),
        }

    def compute_error_goal(self, values: np.ndarray) -> np.ndarray:
        """Return the allowed absolute errors for measures with the given values."""
        return self.tol * (np.abs(values) if self.relative else np.ones_like(values))

    def find_unfinished_indices(self) -> np.ndarray:
        return np.flatnonzero(self.result_arrays["models"] == ModelIndex.NONE)

    def walk_to_gaits(self) -> None:
        """Compute walks of wheels without a result, and store the measures of the gaits reached."""
        unfinished = self.find_unfinished_indices()
        has_lower_gait = self.lower_gaits.model_index[unfinished] != ModelIndex.NONE
        wheels, unfinished = unfinished[has_lower_gait], unfinished[~has_lower_gait]
        self._walk_and_record_gaits(
            wheels, self.lower_gaits.section_states[wheels], MeasureStatus.REACHED_FROM_LOWER_GAIT
        )
        walk_starts = compute_walk_starts(select_rows_on_device(self.params, unfinished))
        for start in walk_starts[:N_COLD_STARTS]:
            is_missing = self.result_arrays["models"][unfinished] == ModelIndex.NONE
            self._walk_and_record_gaits(
                unfinished[is_missing], start[is_missing], MeasureStatus.REACHED_FROM_START
            )

    def select_gait_by_rank(self, gait_rank: int) -> None:
        """Store the measures of the gait with the index `gait_rank`, slowest first.

        The gaits are those that walks from all starts reach.
        """
        wheels = self.find_unfinished_indices()
        starts = compute_walk_starts(self.params)
        gait_wheels, gaits = self._walk_and_refine_gaits(
            np.tile(wheels, len(starts)), np.concatenate(starts)
        )
        selected = []
        for wheel in wheels:
            distinct = gaits.find_distinct_gaits(np.flatnonzero(gait_wheels == wheel))
            self.result_arrays["n_gaits"][wheel] = len(distinct)
            selected += distinct[gait_rank:][:1] if -len(distinct) <= gait_rank else []
        self._record_gaits(
            gait_wheels, gaits, np.array(selected, int), MeasureStatus.SELECTED_BY_RANK
        )

    def correct_lower_gaits(
        self,
        wheel_indices: np.ndarray,
        find_gaits: Callable[[WheelParams], LowerFidelityGaits],
        are_rejected_gaits_refined: bool,
    ) -> None:
        """Compute one step with unilateral contact from each lower gait, and store measures.

        The measures of a lower gait are stored if the estimated errors are within `tol`. If
        `are_rejected_gaits_refined` is True, the other lower gaits are the initial guesses for
        gaits with unilateral contact, whose measures are stored as well.
        """
        if not len(wheel_indices):
            return
        gaits = find_gaits(select_rows_on_device(self.params, wheel_indices))
        self.lower_gaits = replace_rows(self.lower_gaits, wheel_indices, gaits)
        has_gait = np.isfinite(gaits.step_quantities).all(1)
        wheel_indices, gaits = select_tree_rows((wheel_indices, gaits), has_gait)
        states, step, estimates = estimate_measures_from_lower_gaits(
            self.wheel_batch, wheel_indices, gaits, self.measure_names
        )
        values = evaluate_measures(self.measure_names, gaits.step_quantities)
        with np.errstate(all="ignore"):
            step_change = evaluate_measures(self.measure_names, step.step_quantities) - values
            total_change = np.abs(step_change) + estimates.correction_effect_on_measures
            model_error = values - estimates.measure_values
            sensitivity = np.abs(estimates.measure_jacobian @ gaits.step_quantity_jacobian)
            numerical_error = (
                multiply_rows(sensitivity, np.abs(gaits.section_state_error))
                + estimates.numerical_error_bound
                + estimates.missed_contact_error_bound
            )
            error = (
                np.abs(model_error) + (REQUEST_SAFETY_FACTOR - 1.0) * total_change + numerical_error
            )
            is_accepted = estimates.has_same_leg_codes & np.all(
                error <= self.compute_error_goal(values), axis=1
            )
        self.result_arrays["n_steps"][wheel_indices] += 1
        lower_results = {
            "models": gaits.model_index,
            "values": values,
            "errors": error,
            "model_errors": model_error,
            "numerical_errors": numerical_error,
            "states": states,
        }
        self._record_results(
            wheel_indices[is_accepted],
            select_tree_rows(lower_results, is_accepted),
            MeasureStatus.CHECKED_BY_ONE_STEP,
        )
        is_refined = are_rejected_gaits_refined & ~is_accepted & estimates.has_same_leg_codes
        wheel_indices = wheel_indices[is_refined]
        refined = self._refine_gaits(wheel_indices, step.section_states[is_refined], False)
        distances, correction_lengths = (
            np.linalg.norm(x, axis=1)
            for x in (
                (refined.section_states - states[is_refined])[
                    :, self.wheel_batch.list_paper_state_indices()
                ],
                estimates.newton_correction[is_refined],
            )
        )
        is_near = distances <= MAX_GAIT_DISTANCE_RATIO * correction_lengths
        self._record_gaits(
            wheel_indices, refined, refined.is_found & is_near, MeasureStatus.CONTINUES_LOWER_GAIT
        )

    def _refine_gaits(
        self, wheel_indices: np.ndarray, states: np.ndarray, is_every_gait_compared: bool
    ) -> RefinedGaits:
        """Return the gaits near full section states, and add their steps to the results."""
        gaits = refine_gaits(
            self.wheel_batch,
            wheel_indices,
            states,
            self.measure_names,
            self.compute_error_goal,
            is_every_gait_compared,
        )
        np.add.at(self.result_arrays["n_steps"], wheel_indices, gaits.n_steps)
        return gaits

    def _walk_and_record_gaits(
        self, wheel_indices: np.ndarray, section_states: np.ndarray, status: MeasureStatus
    ) -> None:
        """Compute walks from the paper's section states, and store measures of the gaits reached.

        The section states have the shape (wheels, 3).
        """
        gait_wheels, gaits = self._walk_and_refine_gaits(wheel_indices, section_states)
        self._record_gaits(gait_wheels, gaits, gaits.is_found & gaits.is_attracting, status)

    def _walk_and_refine_gaits(
        self, wheel_indices: np.ndarray, section_states: np.ndarray
    ) -> tuple[np.ndarray, RefinedGaits]:
        """Return the gaits at the ends of walks from the paper's section states, after refinement.

        The result is (wheel index of each gait, gaits).
        """
        walk_ends = walk_until_settled(
            self.wheel_batch,
            wheel_indices,
            self.wheel_batch.embed_paper_states(wheel_indices, section_states),
        )
        np.add.at(self.result_arrays["n_steps"], wheel_indices, walk_ends.n_steps)
        # A step cannot begin if a wheel has turned more than once in flight.
        is_reason_unknown = np.isin(walk_ends.walk_outcomes, (Outcome.STEPPED, Outcome.BAD_INPUT))
        self.result_arrays["outcomes"][wheel_indices] = np.where(
            is_reason_unknown, Outcome.NO_CYCLE_FOUND, walk_ends.walk_outcomes
        )
        wheel_indices = wheel_indices[walk_ends.has_settled]
        states = walk_ends.section_states[walk_ends.has_settled]
        return wheel_indices, self._refine_gaits(wheel_indices, states, True)

    def _record_gaits(
        self,
        gait_wheels: np.ndarray,
        gaits: RefinedGaits,
        selected_gaits: np.ndarray,
        status: MeasureStatus,
    ) -> None:
        """Store the measures of the selected gaits with unilateral contact.

        - `gait_wheels`: index of the wheel of each gait;
        - `selected_gaits`: indices or mask of the selected gaits.
        """
        wheels, values, errors, states = select_tree_rows(
            (gait_wheels, gaits.values, gaits.error_bounds, gaits.section_states), selected_gaits
        )
        lower_values = evaluate_measures(
            self.measure_names, self.lower_gaits.step_quantities[wheels]
        )
        gait_results = {
            "models": ModelIndex.UNILATERAL,
            "values": values,
            "errors": errors,
            "model_errors": lower_values - values,
            "numerical_errors": errors,
            "states": states,
        }
        self._record_results(wheels, gait_results, status)

    def _record_results(
        self, wheel_indices: np.ndarray, results: dict[str, Any], status: MeasureStatus
    ) -> None:
        """Store the results of the wheels with the indices `wheel_indices`.

        The keys of `results` are those of `result_arrays`. `status` is the method of the results.
        """
        results = results | {"statuses": status, "outcomes": Outcome.STEPPED}
        for result_name, new_result_values in results.items():
            self.result_arrays[result_name][wheel_indices] = new_result_values
