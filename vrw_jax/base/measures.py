"""Measures: measured quantities with their names, units and meanings, and measures of your own."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from vrw_jax.base.checks import check_callable, check_choice, check_names, require_known_name
from vrw_jax.base.printing import format_mathtext


@dataclasses.dataclass(frozen=True, repr=False)
class Measure:
    """Measured quantity with its name, unit, symbol and description.

    - `unit`: SI unit, "1" for a pure number;
    - `equation`: equation or section of the paper, "" if there is none;
    - `leg_dimension`: "leg" if the measure has one value per leg, otherwise "". Margins have values
      for the locked legs 3 to n, `CONTACT_MEASURES` for every leg;
    - `violation_text`: clause that states what a negative margin means, otherwise "";
    - `is_shared`: whether the steps of every model have the measure;
    - `is_integer_code`: whether the measure is an integer code or count without derivatives;
    - `is_averaged_over_steps`, `is_largest_over_steps`: whether the measure of several steps is
      their mean or their maximum instead of their sum;
    - `function`, `phases`, `reduction`: function of a measure of your own, see `vrw.measure`.
    """

    name: str
    unit: str
    symbol: str
    long_name: str
    description: str
    equation: str = ""
    leg_dimension: str = ""
    violation_text: str = ""
    is_shared: bool = False
    is_integer_code: bool = False
    is_averaged_over_steps: bool = False
    is_largest_over_steps: bool = False
    function: Callable[..., Any] | None = None
    phases: tuple[str, ...] = ()
    reduction: str = ""

    def __call__(self, *arguments: Any) -> Any:
        """Return the value of the function that `vrw.measure` decorates."""
        assert self.function is not None
        return self.function(*arguments)

    def __repr__(self) -> str:
        place = f", {self.reduction} over {', '.join(self.phases)}" * bool(self.phases)
        return f"Measure({self.name} [{self.unit}]{place})"

    @property
    def mathtext(self) -> str:
        """Return the symbol as Matplotlib mathtext, without dollar signs."""
        return format_mathtext(self.symbol)

    @property
    def label_with_symbol(self) -> str:
        """Return the long name followed by the symbol, or the long name alone if it contains the
        symbol.
        """
        has_symbol = self.symbol in self.long_name
        return self.long_name if has_symbol else f"{self.long_name} {self.symbol}"

    @property
    def display_unit(self) -> str:
        """Return the unit to be printed, which is "" for a pure number."""
        return "" if self.unit == "1" else self.unit

    @property
    def variable_attributes(self) -> dict[str, str]:
        """Return the attributes for a dataset variable that contains this measure."""
        measure_attributes = {
            "units": self.unit,
            "long_name": self.long_name,
            "symbol": self.symbol,
            "description": self.description,
        }
        return measure_attributes | ({"equation": self.equation} if self.equation else {})

    def format_with_unit(self, measured_value: object) -> str:
        """Return a value as text with the unit of this measure and six significant digits."""
        return f"{float(np.asarray(measured_value)):.6g} {self.display_unit}".strip()


USED_NAMES = ("outcome", "period", "section_state", "x")
"""Names of variables beside the measures in results for any walker."""


def find_own_measures(measures: Any, taken_names: Sequence[str] = ()) -> dict[str, Measure]:
    """Return the measures of the user among names and measures, by name.

    Raise a `ValueError` if the library has a measure with one of the names, the `taken_names`.
    """
    given = (measures,) if isinstance(measures, Measure) else measures
    given = given if isinstance(given, list | tuple) else ()
    own = {measure.name: measure for measure in given if isinstance(measure, Measure)}
    for name in own:
        _require_unused_name(name, taken_names)
    return own


def _require_unused_name(name: str, used_names: Sequence[str]) -> None:
    if name in used_names:
        raise ValueError(
            f"a measure of your own has the name {name}, which the library uses: give another name."
        )


def select_measures(measures: Any, known: Sequence[Measure]) -> tuple[Measure, ...]:
    """Return measures of the user, of which those in `known` may be given by their names."""
    own = {measure.name: measure for measure in known} | find_own_measures(measures)
    names = check_names("measures", name_measures(measures), "cost")
    for name in names:
        require_known_name(name, tuple(own) or ("measures declared by vrw.measure",), "measure")
    return tuple(own[name] for name in names)


def name_measures(measures: Any) -> Any:
    """Return names and measures with the name of each measure of the user in its place."""
    if isinstance(measures, Measure):
        return (measures.name,)
    if isinstance(measures, list | tuple):
        return [getattr(measure, "name", measure) for measure in measures]
    return measures


def measure(
    name: str,
    *,
    unit: str = "1",
    meaning: str = "",
    symbol: str = "",
    phase: str | Sequence[str] = (),
    reduction: str = "",
) -> Callable[[Callable[..., Any]], Measure]:
    """Declare a function as a measure of gaits, of the paper's wheel or of your own walker.

    A measure without a phase is a function of a step and of the parameters. A measure of a phase is
    a function of the motion at one instant and of the parameters, whose integral, mean, minimum or
    maximum over the phase is as accurate as the motion and has derivatives. For the wheel, the
    instant has `motion`, `acceleration`, `fore_force` and `rear_force`, and the phases are "DLS",
    "SLS-I" and "SLS-II". For a `HybridSystem`, the instant is the state, and the phases are the
    modes. A phase that does not occur has the value zero.

    Give the measure to `vrw.scan`, `vrw.tune`, `vrw.sensitivities`, `vrw.continue_branch` or
    `cycle.measure`, or to your own walker as `measures=(cost,)`, whose gaits have it in `values`.
    Its value for several steps is the mean over the steps.

    Args:
        name: name of the measure.
        unit: SI unit, "1" for a pure number.
        meaning: what is measured, for printed results and datasets.
        symbol: symbol in figures; by default the name.
        phase: name of the phase or mode in which the function is measured, or several names.
        reduction: "integral", "mean", "min" or "max" over the phases.

    Returns:
        A decorator, which returns a `Measure` that is called like the function.

    Raises:
        TypeError, ValueError: if only one of phase and reduction is given, or the reduction is
            unknown.

    Examples:
        >>> @vrw.measure("frequency", unit="1/s", meaning="steps per second")
        ... def frequency(step, params):
        ...     return 1.0 / step.duration
        >>> frequency.unit
        '1/s'
    """
    _require_unused_name(name, USED_NAMES)
    phases = (phase,) * bool(phase) if isinstance(phase, str) else tuple(phase)
    if phases:
        check_choice("reduction", reduction, ("integral", "mean", "min", "max"))
    elif reduction:
        raise ValueError(
            f"reduction is {reduction!r}, but there is no phase: name the phase over which the "
            "measure is taken."
        )

    def declare(function: Callable[..., Any]) -> Measure:
        check_callable("a measure", function, "of a step, or of a state, and parameters")
        return Measure(
            name,
            unit,
            symbol or name,
            name.replace("_", " "),
            meaning,
            is_averaged_over_steps=True,
            function=function,
            phases=phases,
            reduction=reduction,
        )

    return declare
