"""Printing of results: lines of text, tables in HTML and Markdown, symbols as mathtext."""

import abc
import enum
import re
import unicodedata
from collections.abc import Callable, Iterable, Sequence
from html import escape
from typing import Any

import equinox as eqx
import jax
import numpy as np

TextRow = tuple[str, str]


def is_concrete(tree: Any) -> bool:
    """Return whether all numbers of a module are set and concrete; False inside `jit`."""
    is_known = lambda leaf: eqx.is_array_like(leaf) and not isinstance(leaf, int | jax.core.Tracer)
    is_complete = not any(value is None for value in vars(tree).values())
    return is_complete and all(map(is_known, jax.tree.leaves(tree)))


class AbstractPrintable(eqx.Module):
    """Base class of results that print as text, and as a table in a notebook."""

    @abc.abstractmethod
    def summary_rows(self) -> list[TextRow]:
        """Return the pairs (name, text) to print, one per line."""

    @property
    def title(self) -> str:
        """Return the heading of the printed result."""
        return type(self).__name__

    def __repr__(self) -> str:
        return (
            format_text(self.title, self.summary_rows())
            if is_concrete(self)
            else eqx.tree_pformat(self)
        )

    def _repr_html_(self) -> str:
        return (
            format_html_table(self.title, self.summary_rows())
            if is_concrete(self)
            else f"<pre>{self!r}</pre>"
        )


def format_quantity(value: object, unit: str) -> str:
    """Return a number with its unit as text; of several numbers, their count and range."""
    values, unit = np.asarray(value), "" if unit == "1" else unit
    if values.ndim == 0:
        return f"{float(values):.6g} {unit}".strip()
    range_text = f" from {np.min(values):.6g} to {np.max(values):.6g} {unit}" if values.size else ""
    return f"{values.size} values{range_text}".rstrip()


def format_outcome_counts(outcomes: Any, status_class: type[enum.IntEnum]) -> str:
    """Return a text with the number of outcomes, their shape, and the count of each outcome."""
    n_outcomes, shape = np.size(outcomes), np.shape(outcomes)
    codes, counts = np.unique(np.asarray(outcomes), return_counts=True)
    count_texts = (
        f"{count:,} {status_class(int(status_code)).name}"
        for status_code, count in zip(codes, counts, strict=True)
    )
    return f"{n_outcomes:,} in shape {shape}: {', '.join(count_texts)}"


def describe_elements(describe: Callable[..., str], *values: Any) -> Any:
    """Return the text of numbers; for a batch, an array with the text of each element."""
    return np.vectorize(describe, otypes=[object])(*values)[()]


def describe_ending(codes: Any, status_class: type[enum.IntEnum]) -> Any:
    """Return the sentence of a status code; for a batch, an array of one sentence per element."""
    return describe_elements(lambda code: status_class(int(code)).meaning, codes)  # type: ignore[attr-defined]


def format_text(title: str, rows: Iterable[TextRow]) -> str:
    """Return a title and indented rows as one text."""
    return "\n".join([title, *(f"  {name}: {text}" for name, text in rows)])


def format_html_table(title: str, rows: Iterable[Sequence[str]], header: Sequence[str] = ()) -> str:
    """Return the rows as an HTML table; the first cell of each row is its header."""
    format_cell = lambda kind, text: f"<{kind} style='text-align:left'>{escape(text)}</{kind}>"
    lines = ["".join(format_cell("th", text) for text in header)] if header else []
    lines += [
        format_cell("th", name) + "".join(format_cell("td", text) for text in cells)
        for name, *cells in rows
    ]
    body = "".join(f"<tr>{line}</tr>" for line in lines)
    return f"<table><caption>{escape(title)}</caption>{body}</table>"


def format_markdown_table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    """Return the lines of a Markdown table."""
    format_cell = lambda text: " " + text.replace("|", r"\|") + " " * bool(text)
    format_line = lambda cells: "|" + "|".join(map(format_cell, cells)) + "|"
    return [format_line(header), "|" + "---|" * len(header), *map(format_line, rows)]


_MATHTEXT_SYMBOLS = {
    "θ": r"\theta ", "κ": r"\kappa ", "λ": r"\lambda ", "μ": r"\mu ", "ρ": r"\rho ",
    "Δ": r"\Delta ", "σ": r"\sigma ", "∂": r"\partial ", "phi": r"\phi ", "min": r"\min ",
    "⁺": "^+", "⁻": "^-", "²": "^2", "*": "^*", "₀": "_0", "₁": "_1",
}  # fmt: skip
_SYMBOL_PATTERN = re.compile(
    r"_(?P<below>\w[\w-]*(?:, ?\w+)?)|(?P<dotted>\w)\u0307|(?P<twice>\w)\u0308"
    r"|(?P<word>[A-Za-z]{2,}(?:-I+)?)"
    r"|(?P<index>(?<=[^\W\d_]|\u0307|\u0308)\d)|(?P<sign>[^\s\d()|/,A-Za-z-])"
)


def format_mathtext(symbol: str) -> str:
    r"""Return a symbol as mathtext: "θ̇⁺" as \dot{\theta}^+, "L1" as L_1."""
    return _SYMBOL_PATTERN.sub(_format_token, unicodedata.normalize("NFD", symbol))


def _format_token(match: re.Match[str]) -> str:
    """Return the mathtext of one match of `_SYMBOL_PATTERN`."""
    token_kind = match.lastgroup or ""
    text = match[token_kind]
    is_roman = token_kind == "word" or re.search("[A-Za-z]{3}", text)
    body = _MATHTEXT_SYMBOLS.get(text, f"\\mathrm{{{text}}}" if is_roman else text)
    return {
        "below": f"_{{{body}}}",
        "dotted": f"\\dot{{{body}}}",
        "twice": f"\\ddot{{{body}}}",
        "index": f"_{body}",
    }.get(token_kind, body)


def format_numbers(values: object) -> str:
    """Return numbers as text, separated by commas."""
    return ", ".join(f"{value:.5g}" for value in np.ravel(np.asarray(values)))
