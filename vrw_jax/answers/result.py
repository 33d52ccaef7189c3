"""What an answer tells, and how it prints itself."""

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
    """How an answer came about."""

    CHECKED = 0, "checked by one step on real ground"
    CORRECTED = 1, "the gait that continues the lower rung's"
    WALKED = 2, "another gait than the lower rung's: a walk from there leads to it"
    FROM_START = (
        3,
        "no gait of the paper's wheel was found: a walk from its start leads to this one",
    )
    NO_GAIT = 4, "no such gait on real ground"
    CHOSEN = 5, "one of those that attract"


CALLED = ("no rung", "the rigid wheel", "the paper's wheel", "real ground")
"""Of the rungs, by number."""


class Answer(AbstractTold):
    """Measures of a gait and what they may be wrong by; of lanes, every property has their axis.

    Of one measure a property is that, of several a dictionary by name. Where there is no gait the
    value is NaN and the error infinite.

    - `values`, `errors`, `model_errors`, `numerical_errors`: measures on the last axis;
    - `rungs`, `hows`: numbers of the rungs and of how the answers came about;
    - `states`: section states of real ground next to the gait, from which walks and searches for
      it may start;
    - `n_steps`: taken on real ground;
    - `n_gaits`: among which the gait was chosen, 0 where none was to be;
    - `outcomes`: STEPPED, or why there is no gait;
    - `names`, `single`: what was asked;
    - `cost`: of the whole call, s.

    Examples:
        >>> told = vrw.answer("speed", vrw.WheelParams(damping=150.0), 1e-6, friction=np.inf)
        >>> told.rung, int(told.n_steps)
        ('viscoelastic', 1)
    """

    values: np.ndarray  # (*lanes, measures)
    errors: np.ndarray
    model_errors: np.ndarray
    numerical_errors: np.ndarray
    states: np.ndarray  # (*lanes, 4 + 3 n)
    rungs: np.ndarray  # (*lanes,), numbers of RUNGS
    hows: np.ndarray
    n_steps: np.ndarray  # taken on real ground
    outcomes: np.ndarray
    n_gaits: np.ndarray
    names: tuple[str, ...] = eqx.field(static=True)
    single: bool = eqx.field(static=True)
    cost: float = eqx.field(static=True)  # s, of the whole call

    def _told(self, table: np.ndarray) -> Any:
        columns = {name: table[..., i] for i, name in enumerate(self.names)}
        if not self.rungs.ndim:
            columns = {name: float(x) for name, x in columns.items()}  # type: ignore[misc]
        return columns[self.names[0]] if self.single else columns

    @property
    def value(self) -> Any:
        """Of the rung that answers, in the measure's unit."""
        return self._told(self.values)

    @property
    def error(self) -> Any:
        """Bound of what the value may be wrong by, all counted."""
        return self._told(self.errors)

    @property
    def model_error(self) -> Any:
        """What the lower rung's value is wrong by, with sign, as real ground tells it.

        It is part of the value where the lower rung answers, and has been taken off where real
        ground does; NaN where the lower rung has no gait.
        """
        return self._told(self.model_errors)

    @property
    def numerical_error(self) -> Any:
        """Bound of what tolerances, meshes and iterations leave."""
        return self._told(self.numerical_errors)

    @property
    def rung(self) -> Any:
        """Name of the rung that the value is of."""
        names = np.asarray(RUNGS)[self.rungs]
        return names if self.rungs.ndim else str(names)

    @property
    def found(self) -> Any:
        """Whether there is a gait."""
        return (self.outcomes == Outcome.STEPPED)[()]

    @property
    def why(self) -> Any:
        """Why the answer is of that rung, a sentence; of lanes an array of them."""
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
    """One digit and a power of ten, or a plain number of up to three digits."""
    if x == 0.0 or 0.1 <= abs(x) < 1e4:
        return f"{x:.3g}"
    digit, power = f"{x:.0e}".split("e")
    return f"{digit}e{int(power)}"
