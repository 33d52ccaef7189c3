"""How results show themselves: a few lines of text, tables of two kinds, symbols as mathtext."""

import re
import unicodedata
from collections.abc import Iterable, Sequence
from html import escape

import jax
import numpy as np

Row = tuple[str, str]


def is_concrete(tree: object) -> bool:
    """Whether all numbers are known, as they aren't inside `jit` or `vmap`."""
    return not any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(tree))


def as_text(title: str, rows: Iterable[Row]) -> str:
    """The rows under a title."""
    return "\n".join([title, *(f"  {name}: {text}" for name, text in rows)])


def as_html(title: str, rows: Iterable[Sequence[str]], header: Sequence[str] = ()) -> str:
    """The rows as a table for a notebook; the first cell of each names it."""
    cell = lambda kind, text: f"<{kind} style='text-align:left'>{escape(text)}</{kind}>"
    lines = ["".join(cell("th", text) for text in header)] if header else []
    lines += [cell("th", name) + "".join(cell("td", text) for text in rest) for name, *rest in rows]
    body = "".join(f"<tr>{line}</tr>" for line in lines)
    return f"<table><caption>{escape(title)}</caption>{body}</table>"


def as_markdown(header: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    """Lines of a table for a page."""
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
    r"""A symbol as mathtext: "θ̇⁺" as \dot{\theta}^+, "T_DLS" as T_\mathrm{DLS}, "L1" as L_1."""
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
    """Numbers in a row."""
    return ", ".join(f"{v:.5g}" for v in np.ravel(np.asarray(values)))
