"""Text for results: labeled lines, tables, symbols as mathtext, and sentences for status codes."""

import abc
import dataclasses
import enum
import re
import unicodedata
from collections.abc import Callable, Iterable, Sequence
from html import escape
from typing import Any

import equinox as eqx
import jax
import numpy as np

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
