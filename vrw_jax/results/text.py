"""How results show themselves: a few lines of text, and a table in a notebook."""

from collections.abc import Sequence
from html import escape

import jax
import numpy as np

Row = tuple[str, str]


def is_concrete(tree: object) -> bool:
    """Whether all numbers are known, as they aren't inside `jit` or `vmap`."""
    return not any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(tree))


def as_text(title: str, rows: Sequence[Row]) -> str:
    """The rows under a title."""
    return "\n".join([title, *(f"  {name}: {text}" for name, text in rows)])


def as_html(title: str, rows: Sequence[Row]) -> str:
    """The rows as a table."""
    left = "style='text-align:left'"
    cells = "".join(
        f"<tr><th {left}>{escape(name)}</th><td {left}>{escape(text)}</td></tr>"
        for name, text in rows
    )
    return f"<table><caption>{escape(title)}</caption>{cells}</table>"


def listed(values: object) -> str:
    """Numbers in a row."""
    return ", ".join(f"{v:.5g}" for v in np.ravel(np.asarray(values)))
