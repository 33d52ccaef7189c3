"""Result of a measure to within a tolerance, and how it prints itself."""

import math
from typing import Any

import equinox as eqx
import numpy as np

from vrw_jax.answers.lower import RUNGS
from vrw_jax.numerics import Code
from vrw_jax.results import MEASURES
from vrw_jax.wheel import Outcome
from vrw_jax.wording import AbstractTold, Row, counted


class How(Code):
    """Method by which a measure was computed."""

    CHECKED = 0, "checked by one step with unilateral contact"
    CORRECTED = 1, "the gait that continues the lower model's"
    WALKED = 2, "another gait than the lower model's: a walk from there leads to it"
    FROM_START = (
        3,
        "no gait of the paper's wheel was found: a walk from its start leads to this one",
    )
    NO_GAIT = 4, "no such gait with unilateral contact"
    CHOSEN = 5, "one of those that attract"


CALLED = ("no model", "the rigid wheel", "the paper's wheel", "unilateral contact")
"""Labels of the models by index."""


class Answer(AbstractTold):
    """Measures of a gait and bounds of their errors. For a batch, every property has its axis.

    For one measure a property is a value, for several a dictionary by name. If there is no gait,
    the value is NaN and the error infinite.

    - `values`, `errors`, `model_errors`, `numerical_errors`: measures on the last axis;
    - `models`, `statuses`: indices of the models, and codes of the methods;
    - `states`: section states with unilateral contact near the gait, as starts for walks and
      searches;
    - `n_steps`: number of steps with unilateral contact;
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
    rungs: np.ndarray  # (*batch,), indices in MODEL_NAMES
    hows: np.ndarray
    n_steps: np.ndarray  # with unilateral contact
    outcomes: np.ndarray
    n_gaits: np.ndarray
    names: tuple[str, ...] = eqx.field(static=True)
    single: bool = eqx.field(static=True)
    cost: float = eqx.field(static=True)  # of the whole call, s

    def _told(self, table: np.ndarray) -> Any:
        columns = {name: table[..., i] for i, name in enumerate(self.names)}
        if not self.rungs.ndim:
            columns = {name: float(x) for name, x in columns.items()}  # type: ignore[misc]
        return columns[self.names[0]] if self.single else columns

    @property
    def value(self) -> Any:
        """Return the value from the selected model, in the measure's unit."""
        return self._told(self.values)

    @property
    def error(self) -> Any:
        """Return a bound of the error of the value, from all sources."""
        return self._told(self.errors)

    @property
    def model_error(self) -> Any:
        """Return the lower model's error, with sign, relative to unilateral contact.

        It is contained in the value if the lower model is selected. It has been removed if
        unilateral contact is. It is NaN if the lower model has no gait.
        """
        return self._told(self.model_errors)

    @property
    def numerical_error(self) -> Any:
        """Return a bound of the error from tolerances, meshes and iterations."""
        return self._told(self.numerical_errors)

    @property
    def rung(self) -> Any:
        """Return the name of the selected model."""
        names = np.asarray(RUNGS)[self.rungs]
        return names if self.rungs.ndim else str(names)

    @property
    def found(self) -> Any:
        """Return whether there is a gait."""
        return (self.outcomes == Outcome.STEPPED)[()]

    @property
    def why(self) -> Any:
        """Return why that model is selected, as a sentence. A batch has an array of them."""
        told = np.vectorize(_sentence, otypes=[object])
        return told(self.rungs, self.hows, self.n_steps, self.outcomes, self.n_gaits)[()]

    @property
    def title(self) -> str:
        if self.rungs.ndim:
            return f"Answer, {self.rungs.size} lanes, {_short(1e3 * self.cost)} ms"
        shown = "; ".join(self._text(i) for i in range(len(self.names)))
        return f"{shown}: {self.why}. {_short(1e3 * self.cost)} ms"

    def rows(self) -> list[Row]:
        if not self.rungs.ndim:
            return []
        names = [str(name) for name in self.rung]
        by = ", ".join(f"{names.count(name)} {CALLED[i]}" for i, name in enumerate(RUNGS))
        worst = lambda i: np.max(self.errors[self.found][:, i], initial=0.0)
        errors = [(f"largest error of {n}", _short(worst(i))) for i, n in enumerate(self.names)]
        return [("answered by", by), ("outcomes", counted(self.outcomes, Outcome)), *errors]

    def _text(self, i: int) -> str:
        measure = MEASURES[self.names[i]]
        if not self.found:
            return f"no {measure.name}"
        value, error = float(self.values[i]), float(self.errors[i])
        digits = max(0, math.ceil(-math.log10(max(error, 1e-15))))
        shown = f"{value:.{digits}f} {measure.plain_unit}".strip()
        parts = f"numerical {_short(self.numerical_errors[i])}"
        if RUNGS[int(self.rungs)] != RUNGS[-1]:
            parts = f"model {_short(abs(self.model_errors[i]))}, {parts}"
        return f"{shown} ± {_short(error)} ({parts})"


def _sentence(rung: int, how: int, n_steps: int, outcome: int, n_gaits: int) -> str:
    meaning = How(int(how)).meaning
    if how == How.NO_GAIT:
        among = f"; gaits that attract: {n_gaits}" if n_gaits else ""
        return f"{meaning}: {Outcome(int(outcome)).meaning[:-1]}{among}"
    if how == How.CHOSEN:
        meaning = f"{meaning}, {n_gaits} in all"
    if how == How.CHECKED:
        return f"{CALLED[int(rung)]}, {meaning}"
    return f"{CALLED[int(rung)]}, {n_steps} steps, {meaning}"


def _short(x: float) -> str:
    """Format a value as one digit and a power of ten, or as a plain number of up to three
    digits."""
    if x == 0.0 or 0.1 <= abs(x) < 1e4:
        return f"{x:.3g}"
    digit, power = f"{x:.0e}".split("e")
    return f"{digit}e{int(power)}"
