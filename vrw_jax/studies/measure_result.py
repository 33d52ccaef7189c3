"""Result of `vrw.measure_to_tolerance`."""

import math
from typing import Any

import equinox as eqx
import numpy as np

from vrw_jax.base.outcomes import Outcome
from vrw_jax.base.printing import (
    AbstractPrintable,
    LabelAndText,
    StatusCode,
    describe_step_ending,
    format_each_batch_element,
    format_outcome_counts,
)
from vrw_jax.models.measures import MEASURES
from vrw_jax.studies.lower_fidelity import MODEL_NAMES, ModelIndex


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
