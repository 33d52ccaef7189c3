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
    describe_elements,
    describe_ending,
    format_outcome_counts,
)
from vrw_jax.tolerance.lower_fidelity import MODEL_NAMES
from vrw_jax.wheel import Outcome


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
"""Labels of the models by index."""


class MeasureResult(AbstractPrintable):
    """Measures of a gait and bounds of their errors; for a batch, every property has the batch
    axis.

    For one measure a property is a value, for several a dictionary by name. If there is no gait,
    the value is NaN and the error infinite.

    - `values`, `errors`, `model_errors`, `numerical_errors`: measures on the last axis;
    - `models`, `statuses`: indices of the models, and codes of the methods;
    - `states`: section states with unilateral contact near the gait, as starts for walks and
      searches;
    - `n_steps`: number of steps with unilateral contact, where a step with its Jacobian counts as
      four steps;
    - `n_gaits`: number of gaits that the gait was selected from, 0 without a selection;
    - `outcomes`: STEPPED, or the reason why there is no gait;
    - `names`, `is_single`: the requested measures;
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

    def _by_name(self, values: np.ndarray) -> Any:
        """Return the values by name of the measure, or the values of the only measure."""
        values_by_name = {
            name: values[..., measure_index] for measure_index, name in enumerate(self.names)
        }
        if not self.models.ndim:
            values_by_name = {
                name: float(number)  # type: ignore[misc]
                for name, number in values_by_name.items()
            }
        return values_by_name[self.names[0]] if self.is_single else values_by_name

    @property
    def value(self) -> Any:
        """Return the value from the selected model, in the measure's unit."""
        return self._by_name(self.values)

    @property
    def error(self) -> Any:
        """Return a bound of the error of the value, from all sources, in the measure's unit."""
        return self._by_name(self.errors)

    @property
    def model_error(self) -> Any:
        """Return the lower model's error, with sign, relative to unilateral contact.

        The value contains this error if the lower model is selected, and not if unilateral contact
        is. The error is NaN if the lower model has no gait.
        """
        return self._by_name(self.model_errors)

    @property
    def numerical_error(self) -> Any:
        """Return a bound of the error due to tolerances, meshes and iterations, in the measure's
        unit.
        """
        return self._by_name(self.numerical_errors)

    @property
    def model(self) -> Any:
        """Return the name of the selected model."""
        names = np.asarray(MODEL_NAMES)[self.models]
        return names if self.models.ndim else str(names)

    @property
    def found(self) -> Any:
        """Return whether a gait was found."""
        return (self.outcomes == Outcome.STEPPED)[()]

    @property
    def ending(self) -> Any:
        """Return how the search for the gait ended, as a sentence; for a batch, an array of
        sentences.
        """
        return describe_ending(self.outcomes, Outcome)

    @property
    def why(self) -> Any:
        """Return why the model was selected, as a sentence; for a batch, an array of sentences."""
        return describe_elements(
            _describe_selection,
            self.models,
            self.statuses,
            self.n_steps,
            self.outcomes,
            self.n_gaits,
        )

    @property
    def title(self) -> str:
        if self.models.ndim:
            milliseconds = _format_rounded(1e3 * self.seconds)
            return f"MeasureResult, {self.models.size} wheels, {milliseconds} ms"
        measures_text = "; ".join(self._format_measure(i) for i in range(len(self.names)))
        return f"{measures_text}: {self.why}. {_format_rounded(1e3 * self.seconds)} ms"

    def summary_rows(self) -> list[LabelAndText]:
        if not self.models.ndim:
            return []
        model_names = [str(name) for name in self.model]
        counts_text = ", ".join(
            f"{model_names.count(name)} {MODEL_LABELS[i]}" for i, name in enumerate(MODEL_NAMES)
        )
        max_error = lambda i: np.max(self.errors[self.found][:, i], initial=0.0)
        error_rows = [
            (f"largest error of {n}", _format_rounded(max_error(i)))
            for i, n in enumerate(self.names)
        ]
        return [
            ("models", counts_text),
            ("outcomes", format_outcome_counts(self.outcomes, Outcome)),
            *error_rows,
        ]

    def _format_measure(self, measure_index: int) -> str:
        """Return a measure with its unit and errors as text."""
        measure = MEASURES[self.names[measure_index]]
        if not self.found:
            return f"no {measure.name}"
        value, error = float(self.values[measure_index]), float(self.errors[measure_index])
        digits = max(0, math.ceil(-math.log10(max(error, 1e-15))))
        value_text = f"{value:.{digits}f} {measure.display_unit}".strip()
        parts_text = f"numerical {_format_rounded(self.numerical_errors[measure_index])}"
        if MODEL_NAMES[int(self.models)] != MODEL_NAMES[-1]:
            parts_text = (
                f"model {_format_rounded(abs(self.model_errors[measure_index]))}, {parts_text}"
            )
        return f"{value_text} ± {_format_rounded(error)} ({parts_text})"


def _describe_selection(
    model_index: int, status: int, n_steps: int, outcome: int, n_gaits: int
) -> str:
    """Return a sentence on the selected model of one element."""
    meaning = MeasureStatus(int(status)).meaning
    if status == MeasureStatus.NO_GAIT:
        gaits_text = f"; gaits that attract: {n_gaits}" if n_gaits else ""
        return f"{meaning}: {Outcome(int(outcome)).meaning[:-1]}{gaits_text}"
    if status == MeasureStatus.SELECTED_BY_RANK:
        meaning = f"{meaning}, {n_gaits} in all"
    if status == MeasureStatus.CHECKED_BY_ONE_STEP:
        return f"{MODEL_LABELS[int(model_index)]}, {meaning}"
    return f"{MODEL_LABELS[int(model_index)]}, {n_steps} steps, {meaning}"


def _format_rounded(value: float) -> str:
    """Return a value as one digit and a power of ten, or as a number of up to three digits."""
    if value == 0.0 or 0.1 <= abs(value) < 1e4:
        return f"{value:.3g}"
    digit, exponent = f"{value:.0e}".split("e")
    return f"{digit}e{int(exponent)}"
