"""Printing of results: lines of text, tables in HTML and Markdown, symbols as mathtext."""

import abc
import enum
import re
import unicodedata
from collections.abc import Iterable, Sequence
from html import escape
from typing import Any

import equinox as eqx
import jax
import numpy as np

Row = tuple[str, str]


def is_concrete(tree: Any) -> bool:
    """Return whether all numbers of a module are set and concrete, which is False inside `jit`."""
    known = lambda leaf: eqx.is_array_like(leaf) and not isinstance(leaf, int | jax.core.Tracer)
    whole = not any(value is None for value in vars(tree).values())
    return whole and all(map(known, jax.tree.leaves(tree)))


class AbstractTold(eqx.Module):
    """Base class of results that print themselves as text, and as a table in a notebook."""

    @abc.abstractmethod
    def rows(self) -> list[Row]:
        """Return names and texts, one pair per line."""

    @property
    def title(self) -> str:
        """Heading of the printed result."""
        return type(self).__name__

    def __repr__(self) -> str:
        return as_text(self.title, self.rows()) if is_concrete(self) else eqx.tree_pformat(self)

    def _repr_html_(self) -> str:
        return as_html(self.title, self.rows()) if is_concrete(self) else f"<pre>{self!r}</pre>"


def told(value: object, unit: str) -> str:
    """Return a number with its unit, or the count and range of several numbers."""
    values, unit = np.asarray(value), "" if unit == "1" else unit
    if values.ndim == 0:
        return f"{float(values):.6g} {unit}".strip()
    ends = f" from {np.min(values):.6g} to {np.max(values):.6g} {unit}" if values.size else ""
    return f"{values.size} values{ends}".rstrip()


def counted(outcomes: Any, code: type[enum.IntEnum]) -> str:
    """Return the number of outcomes, their shape, and the count of each outcome."""
    n, shape = np.size(outcomes), np.shape(outcomes)
    codes, counts = np.unique(np.asarray(outcomes), return_counts=True)
    each = (f"{count:,} {code(int(c)).name}" for c, count in zip(codes, counts, strict=True))
    return f"{n:,} in shape {shape}: {', '.join(each)}"


def as_text(title: str, rows: Iterable[Row]) -> str:
    """Return a title and indented rows."""
    return "\n".join([title, *(f"  {name}: {text}" for name, text in rows)])


def as_html(title: str, rows: Iterable[Sequence[str]], header: Sequence[str] = ()) -> str:
    """Return the rows as a table for a notebook; the first cell of each row is its header."""
    cell = lambda kind, text: f"<{kind} style='text-align:left'>{escape(text)}</{kind}>"
    lines = ["".join(cell("th", text) for text in header)] if header else []
    lines += [cell("th", name) + "".join(cell("td", text) for text in rest) for name, *rest in rows]
    body = "".join(f"<tr>{line}</tr>" for line in lines)
    return f"<table><caption>{escape(title)}</caption>{body}</table>"


def as_markdown(header: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    """Return the lines of a Markdown table."""
    cell = lambda text: " " + text.replace("|", r"\|") + " " * bool(text)
    line = lambda cells: "|" + "|".join(map(cell, cells)) + "|"
    return [line(header), "|" + "---|" * len(header), *map(line, rows)]


_MATH = {
    "θ": r"\theta ", "λ": r"\lambda ", "μ": r"\mu ", "ρ": r"\rho ", "Δ": r"\Delta ",
    "σ": r"\sigma ", "∂": r"\partial ", "phi": r"\phi ", "min": r"\min ",
    "⁺": "^+", "⁻": "^-", "²": "^2", "*": "^*", "₀": "_0", "₁": "_1",
}  # fmt: skip
_TOKEN = re.compile(
    r"_(?P<below>\w[\w-]*(?:, ?\w+)?)|(?P<dotted>\w)\u0307|(?P<twice>\w)\u0308"
    r"|(?P<word>[A-Za-z]{2,}(?:-I+)?)"
    r"|(?P<index>(?<=[^\W\d_]|\u0307|\u0308)\d)|(?P<sign>[^\s\d()|/,A-Za-z-])"
)


def as_tex(symbol: str) -> str:
    r"""Return a symbol as mathtext: "θ̇⁺" as \dot{\theta}^+, "T_DLS" as T_\mathrm{DLS}, "L1" as
    L_1.
    """
    return _TOKEN.sub(_token_as_tex, unicodedata.normalize("NFD", symbol))


def _token_as_tex(found: re.Match[str]) -> str:
    kind = found.lastgroup or ""
    text = found[kind]
    roman = kind == "word" or re.search("[A-Za-z]{3}", text)
    told = _MATH.get(text, f"\\mathrm{{{text}}}" if roman else text)
    return {
        "below": f"_{{{told}}}",
        "dotted": f"\\dot{{{told}}}",
        "twice": f"\\ddot{{{told}}}",
        "index": f"_{told}",
    }.get(kind, told)


def listed(values: object) -> str:
    """Return numbers separated by commas."""
    return ", ".join(f"{v:.5g}" for v in np.ravel(np.asarray(values)))
