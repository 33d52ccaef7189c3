"""Result of a measure to within a tolerance."""

import math
from typing import Any

import equinox as eqx
import numpy as np

from vrw_jax.measures import MEASURES
from vrw_jax.numerics import StatusCode
from vrw_jax.printing import (
    AbstractPrintable,
    LabelAndText,
    describe_step_ending,
    format_outcome_counts,
    map_text_of_elements,
)
from vrw_jax.tolerance.lower_fidelity import MODEL_NAMES
from vrw_jax.wheel import Outcome


class MeasureStatus(StatusCode):
    """Code of the method by which a measure was computed."""

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
    """Measures of a gait and bounds of their errors; for a batch, every property has the batch
    axis.

    If one measure was requested by its name, a property is a number or an array. Otherwise a
    property is a dictionary by names of measures. Without a gait, the measure is NaN and the error
    infinite.

    - `values`, `errors`, `model_errors`, `numerical_errors`: measures, bounds of their errors,
      errors of the lower model, and bounds of numerical errors, with the measures on the last axis;
    - `models`, `statuses`: a `ModelIndex` and a `MeasureStatus` of each element;
    - `states`: section states with unilateral contact near the gait, as starts for walks and
      searches;
    - `n_steps`: number of steps with unilateral contact, where a step with its Jacobian counts as
      four steps;
    - `n_gaits`: number of gaits from which the gait was selected, 0 without a selection;
    - `outcomes`: STEPPED, or the reason why there is no gait;
    - `names`, `is_single`: names of the measures, and whether the request was a single name;
    - `seconds`: time of the whole call, s.

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
    n_steps: np.ndarray  # number of steps with unilateral contact
    outcomes: np.ndarray
    n_gaits: np.ndarray
    names: tuple[str, ...] = eqx.field(static=True)
    is_single: bool = eqx.field(static=True)
    seconds: float = eqx.field(static=True)  # time of the whole call, s

    def _index_by_measure_name(self, measure_values: np.ndarray) -> Any:
        """Return a dictionary of arrays by measure name, or one array if the request was a single
        name.
        """
        values_by_measure_name = {
            measure_name: measure_values[..., measure_index]
            for measure_index, measure_name in enumerate(self.names)
        }
        if not self.models.ndim:
            values_by_measure_name = {
                measure_name: float(measure_value)  # type: ignore[misc]
                for measure_name, measure_value in values_by_measure_name.items()
            }
        return values_by_measure_name[self.names[0]] if self.is_single else values_by_measure_name

    @property
    def value(self) -> Any:
        """Return the measure by the selected model, in the measure's unit."""
        return self._index_by_measure_name(self.values)

    @property
    def error(self) -> Any:
        """Return a bound of the error of the measure, from all sources, in the measure's unit."""
        return self._index_by_measure_name(self.errors)

    @property
    def model_error(self) -> Any:
        """Return the lower model's measure minus the measure with unilateral contact, in the
        measure's unit.

        The result `value` contains this error only if the lower model is selected. The error is NaN
        if the lower model has no gait.
        """
        return self._index_by_measure_name(self.model_errors)

    @property
    def numerical_error(self) -> Any:
        """Return a bound of the measure's error due to tolerances, meshes and iterations, in the
        measure's unit.
        """
        return self._index_by_measure_name(self.numerical_errors)

    @property
    def model(self) -> Any:
        """Return the name of the selected model."""
        selected_model_names = np.asarray(MODEL_NAMES)[self.models]
        return selected_model_names if self.models.ndim else str(selected_model_names)

    @property
    def found(self) -> Any:
        """Return whether a gait was found."""
        return (self.outcomes == Outcome.STEPPED)[()]

    @property
    def ending(self) -> Any:
        """Return how the search for the gait ended, as a sentence; for a batch, an array of
        sentences.
        """
        return describe_step_ending(self.outcomes, Outcome)

    @property
    def why(self) -> Any:
        """Return why the model was selected, as a sentence; for a batch, an array of sentences."""
        return map_text_of_elements(
            _describe_selection,
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
        model_names = [str(measure_name) for measure_name in self.model]
        model_counts_text = ", ".join(
            f"{model_names.count(measure_name)} {MODEL_LABELS[measure_index]}"
            for measure_index, measure_name in enumerate(MODEL_NAMES)
        )
        compute_max_error = lambda measure_index: np.max(
            self.errors[self.found][:, measure_index], initial=0.0
        )
        error_rows = [
            (
                f"largest error of {measure_name}",
                _format_rounded_number(compute_max_error(measure_index)),
            )
            for measure_index, measure_name in enumerate(self.names)
        ]
        return [
            ("models", model_counts_text),
            ("outcomes", format_outcome_counts(self.outcomes, Outcome)),
            *error_rows,
        ]

    def _format_measure_value(self, measure_index: int) -> str:
        """Return the text of a measure with its unit and errors."""
        measure = MEASURES[self.names[measure_index]]
        if not self.found:
            return f"no {measure.name}"
        measure_value = float(self.values[measure_index])
        error_bound = float(self.errors[measure_index])
        n_decimals = max(0, math.ceil(-math.log10(max(error_bound, 1e-15))))
        value_text = f"{measure_value:.{n_decimals}f} {measure.display_unit}".strip()
        error_parts_text = (
            f"numerical {_format_rounded_number(self.numerical_errors[measure_index])}"
        )
        if MODEL_NAMES[int(self.models)] != MODEL_NAMES[-1]:
            model_error_text = _format_rounded_number(abs(self.model_errors[measure_index]))
            error_parts_text = f"model {model_error_text}, {error_parts_text}"
        return f"{value_text} ± {_format_rounded_number(error_bound)} ({error_parts_text})"


def _describe_selection(
    model_index: int, status: int, n_steps: int, search_outcome: int, n_gaits: int
) -> str:
    """Return a sentence on the selected model and method of one element."""
    status_meaning = MeasureStatus(int(status)).meaning
    if status == MeasureStatus.NO_GAIT:
        gait_count_text = f"; gaits that attract: {n_gaits}" if n_gaits else ""
        return f"{status_meaning}: {Outcome(int(search_outcome)).meaning[:-1]}{gait_count_text}"
    if status == MeasureStatus.SELECTED_BY_RANK:
        status_meaning = f"{status_meaning}, {n_gaits} in all"
    if status == MeasureStatus.CHECKED_BY_ONE_STEP:
        return f"{MODEL_LABELS[int(model_index)]}, {status_meaning}"
    return f"{MODEL_LABELS[int(model_index)]}, {n_steps} steps, {status_meaning}"


def _format_rounded_number(measure_value: float) -> str:
    """Return the text of a number with one digit and a power of ten, or with three digits."""
    if measure_value == 0.0 or 0.1 <= abs(measure_value) < 1e4:
        return f"{measure_value:.3g}"
    mantissa_text, exponent_text = f"{measure_value:.0e}".split("e")
    return f"{mantissa_text}e{int(exponent_text)}"
