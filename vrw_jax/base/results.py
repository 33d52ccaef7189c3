"""Results: outcome codes, measures, printed text, and datasets.

The library xarray is imported on first use. All labeled results are its datasets. Text consists of
labeled lines, tables, symbols as mathtext, and sentences for status codes.
"""

import abc
import dataclasses
import enum
import re
import unicodedata
from collections.abc import Callable, Iterable, Sequence
from html import escape
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax
import numpy as np

from vrw_jax.base.checks import check_callable, check_choice, check_names, require_known_name

if TYPE_CHECKING:
    import xarray as xarray
else:

    class _LazyXarray:
        """Proxy for xarray, which is imported when an attribute is first read, because its import
        takes long.
        """

        def __getattr__(self, attribute_name: str) -> Any:
            import xarray

            return getattr(xarray, attribute_name)

    xarray = _LazyXarray()

LabelAndText = tuple[str, str]


def has_concrete_numbers(result_tree: Any) -> bool:
    """Return whether all fields of a result are set and all its numbers are concrete.

    Inside `jit`, numbers are not concrete. Fields that no caller gives, such as the leg force of a
    wheel, may be None.
    """
    is_leaf_concrete = lambda result_leaf: (
        eqx.is_array_like(result_leaf) and not isinstance(result_leaf, int | jax.core.Tracer)
    )
    has_all_fields = not any(
        field.init and getattr(result_tree, field.name) is None
        for field in dataclasses.fields(result_tree)
    )
    return has_all_fields and all(map(is_leaf_concrete, jax.tree.leaves(result_tree)))


class AbstractPrintable(eqx.Module):
    """Base class for results that are printed as text, and as a table in a notebook."""

    @abc.abstractmethod
    def summary_rows(self) -> list[LabelAndText]:
        """Return pairs of label and text. Each pair is printed on one line."""

    @property
    def printed_heading(self) -> str:
        """Return the heading under which the result is printed."""
        return type(self).__name__

    def __repr__(self) -> str:
        return (
            format_heading_and_rows(self.printed_heading, self.summary_rows())
            if has_concrete_numbers(self)
            else eqx.tree_pformat(self)
        )

    def _repr_html_(self) -> str:
        return (
            format_html_table(self.printed_heading, self.summary_rows())
            if has_concrete_numbers(self)
            else f"<pre>{self!r}</pre>"
        )


def format_quantity(quantity_value: object, quantity_unit: str) -> str:
    """Return a number with its unit as text. An array is described by its size and its range."""
    quantity_values = np.asarray(quantity_value)
    quantity_unit = "" if quantity_unit == "1" else quantity_unit
    if quantity_values.ndim == 0:
        return f"{float(quantity_values):.6g} {quantity_unit}".strip()
    value_range_text = (
        f" from {np.min(quantity_values):.6g} to {np.max(quantity_values):.6g} {quantity_unit}"
        if quantity_values.size
        else ""
    )
    return f"{quantity_values.size} values{value_range_text}".rstrip()


def format_outcome_counts(outcomes: Any, status_code_class: type[enum.IntEnum]) -> str:
    """Return a text with the shape of an array of outcomes, and the number of times that each
    outcome occurs in it.
    """
    outcome_count_texts = (
        f"{outcome_count:,} {status_code_class(int(status_code)).name}"
        for status_code, outcome_count in zip(
            *np.unique(np.asarray(outcomes), return_counts=True), strict=True
        )
    )
    return f"{np.size(outcomes):,} in shape {np.shape(outcomes)}: {', '.join(outcome_count_texts)}"


def format_each_batch_element(format_batch_element: Callable[..., str], *batch_values: Any) -> Any:
    """Return the text for one element, or an array of texts with one entry per batch element."""
    return np.vectorize(format_batch_element, otypes=[object])(*batch_values)[()]


def format_heading_and_rows(heading_text: str, text_rows: Iterable[LabelAndText]) -> str:
    """Return a text that consists of a heading and one indented line per row."""
    return "\n".join(
        [heading_text, *(f"  {row_label}: {row_text}" for row_label, row_text in text_rows)]
    )


def format_html_table(
    table_title: str, text_rows: Iterable[Sequence[str]], header_cells: Sequence[str] = ()
) -> str:
    """Return an HTML table of rows of cells. The first cell of each row is a header."""
    format_table_cell = lambda cell_tag, cell_text: (
        f"<{cell_tag} style='text-align:left'>{escape(cell_text)}</{cell_tag}>"
    )
    cells_by_row = [[format_table_cell("th", cell_text) for cell_text in header_cells]]
    cells_by_row += [
        [
            format_table_cell("td" if column_index else "th", cell_text)
            for column_index, cell_text in enumerate(row_cells)
        ]
        for row_cells in text_rows
    ]
    html_rows = "".join(f"<tr>{''.join(row_cells)}</tr>" for row_cells in cells_by_row if row_cells)
    return f"<table><caption>{escape(table_title)}</caption>{html_rows}</table>"


def format_markdown_table(
    header_cells: Sequence[str], text_rows: Iterable[Sequence[str]]
) -> list[str]:
    """Return a Markdown table as a list of lines."""
    format_table_cell = lambda cell_text: (
        " " + cell_text.replace("|", r"\|") + " " * bool(cell_text)
    )
    format_table_line = lambda row_cells: "|" + "|".join(map(format_table_cell, row_cells)) + "|"
    return [
        format_table_line(header_cells),
        "|" + "---|" * len(header_cells),
        *map(format_table_line, text_rows),
    ]


def format_numbers(printed_numbers: object) -> str:
    """Return numbers as text with five significant digits, separated by commas."""
    return ", ".join(
        f"{printed_number:.5g}" for printed_number in np.ravel(np.asarray(printed_numbers))
    )


_MATHTEXT_BY_SYMBOL = {
    "θ": r"\theta ", "κ": r"\kappa ", "λ": r"\lambda ", "μ": r"\mu ", "ρ": r"\rho ",
    "Δ": r"\Delta ", "σ": r"\sigma ", "∂": r"\partial ", "phi": r"\phi ", "min": r"\min ",
    "⁺": "^+", "⁻": "^-", "²": "^2", "*": "^*", "₀": "_0", "₁": "_1",
}  # fmt: skip
_SYMBOL_TOKEN_PATTERN = re.compile(
    r"_(?P<below>\w[\w-]*(?:, ?\w+)?)|(?P<dotted>\w)\u0307|(?P<twice>\w)\u0308"
    r"|(?P<word>[A-Za-z]{2,}(?:-I+)?)"
    r"|(?P<index>(?<=[^\W\d_]|\u0307|\u0308)\d)|(?P<sign>[^\s\d()|/,A-Za-z-])"
)


def format_mathtext(symbol_text: str) -> str:
    r"""Convert a symbol to mathtext: "θ̇⁺" to \dot{\theta}^+, "L1" to L_1."""

    def format_symbol_token(token_match: re.Match[str]) -> str:
        token_kind = token_match.lastgroup or ""
        token_text = token_match[token_kind]
        is_upright_text = token_kind == "word" or re.search("[A-Za-z]{3}", token_text)
        token_mathtext = _MATHTEXT_BY_SYMBOL.get(
            token_text, f"\\mathrm{{{token_text}}}" if is_upright_text else token_text
        )
        return {
            "below": f"_{{{token_mathtext}}}",
            "dotted": f"\\dot{{{token_mathtext}}}",
            "twice": f"\\ddot{{{token_mathtext}}}",
            "index": f"_{token_mathtext}",
        }.get(token_kind, token_mathtext)

    return _SYMBOL_TOKEN_PATTERN.sub(format_symbol_token, unicodedata.normalize("NFD", symbol_text))


class StatusCode(enum.IntEnum):
    """Base class for enumerations of status codes. Members are defined as `NAME = number,
    "sentence"`.

    The number is the member's value, and the sentence is the member's attribute `meaning`.
    """

    meaning: str

    def __new__(cls, value: int, meaning: str = "") -> "StatusCode":
        status_code = int.__new__(cls, value)
        status_code._value_, status_code.meaning = value, meaning
        return status_code


def describe_step_ending(status_codes: Any, status_code_class: type[StatusCode]) -> Any:
    """Return the sentence that explains a status code, or an array of sentences for a batch."""
    describe_status_code = lambda status_code: status_code_class(int(status_code)).meaning
    return format_each_batch_element(describe_status_code, status_codes)


class NoGaitError(ValueError):
    """Error of a computation that needs a gait, for a wheel or walker that has none."""


class Outcome(StatusCode):
    """Outcome of a step. Only a step with the outcome STEPPED ends in a section state. Every other
    outcome ends the walk.

    Examples:
        >>> vrw.Outcome.FELL_BACK.meaning
        'The wheel stopped rolling forward and would fall back.'
        >>> vrw.Outcome(0).name
        'STEPPED'
    """

    STEPPED = 0, "The wheel stepped from touchdown to touchdown."
    TOUCHDOWN_BEFORE_STOPPER = (
        1, "The next foot met the ground before Leg 2 was back at its stopper."
    )  # fmt: skip
    STOPPER_IN_DOUBLE_SUPPORT = (
        2, "Leg 2 reached its stopper while its foot was still on the ground."
    )  # fmt: skip
    FELL_BACK = 3, "The wheel stopped rolling forward and would fall back."
    COLLAPSED = 4, "A loaded leg collapsed to where its mass meets the hub: the wheel fell."
    LEG_1_LIFTED_OFF = 5, "The ground would have to pull on Leg 1's foot: it lifts off."
    NO_TOUCHDOWN_IN_TIME = 6, "No touchdown came within the allowed time of one phase."
    SOLVER_FAILED = 7, "The integrator ran out of steps or could not locate an event."
    BAD_INPUT = 8, "A parameter or the start is not finite, or outside its domain."
    NO_CYCLE_FOUND = (
        9, "The search for a limit cycle did not converge: there may be one that it missed."
    )  # fmt: skip
    TOO_MANY_EVENTS = 10, "Contacts and stoppers changed more often than one step may."
    NO_ADMISSIBLE_CONTACT = (
        11, "No combination of contact modes was found that satisfies Coulomb's law in an impact."
    )  # fmt: skip
    THREE_FEET_LOADED = 12, "Three feet would have to carry load at once."
    MESH_TOO_COARSE = (
        13, "A cycle solves the equations, but the mesh is too coarse: give more intervals."
    )  # fmt: skip
    EVENT_ORDER_MISMATCH = (
        14, "A cycle solves the equations, but its events do not come in the paper's order."
    )  # fmt: skip
    BRANCH_ENDS_BEFORE_TARGET = (
        16, "No cycle was found; followed from Table 1 to this wheel, the gait ends on the way."
    )  # fmt: skip
    PAINLEVE_PARADOX = (
        15, "Friction is so high that no forces can carry the motion on (Painlevé's paradox)."
    )  # fmt: skip
    CAME_TO_REST = 17, "The wheel came to rest: it neither rolls on nor falls back."
    GUARD_VIOLATED = (
        18, "One of the guards was negative when its mode began, for example after a fall."
    )  # fmt: skip
    ENDED_BY_GUARD = 19, "A guard that ends walks has fallen to zero, for example at a fall."


def describe_outcomes(outcomes: Any, section: str = "") -> Any:
    """Return the sentence on an outcome, or an array of sentences for a batch.

    - `section`: name of the section of a walker of the user, which takes the place of a touchdown.
    """
    sentences = describe_step_ending(outcomes, Outcome)
    if not section:
        return sentences
    name_section = lambda x: x.replace("touchdown", section).replace("The wheel", "The walker")
    return format_each_batch_element(name_section, sentences)


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
