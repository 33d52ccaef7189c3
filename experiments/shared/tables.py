"""Tables of numbers as csv files and in pages."""

import csv
from collections.abc import Iterable, Mapping, Sequence
from operator import itemgetter
from pathlib import Path

import numpy as np

DOCS = Path(__file__).parents[2] / "docs"
FIGURES = DOCS / "figures"
Row = dict[str, str]


def read_table(path: Path) -> list[Row]:
    with path.open() as file:
        return list(csv.DictReader(file))


def write_table(path: Path, header: Iterable[str], rows: Iterable[Iterable[object]]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="") as file:
        csv.writer(file).writerows([header, *rows])


def write_named_rows(path: Path, rows: Sequence[Mapping[str, object]]) -> None:
    """Rows by names of columns; a row may lack some."""
    header = dict.fromkeys(name for row in rows for name in row)
    write_table(path, header, [[row.get(name, "") for name in header] for row in rows])


def read_column(rows: Iterable[Row], name: str) -> np.ndarray:
    """A column."""
    return np.array([float(row[name]) for row in rows])


def group_rows(rows: Sequence[Row], name: str) -> dict[str, list[Row]]:
    """Rows by one of their columns, in order."""
    keys = dict.fromkeys(map(itemgetter(name), rows))
    return {key: [row for row in rows if row[name] == key] for key in keys}


def format_markdown(header: Iterable[object], rows: Iterable[Iterable[object]]) -> str:
    """A table of a page."""
    names = list(header)
    lines = [" | ".join(map(str, cells)) for cells in (names, *rows)]
    lines.insert(1, "|".join("---" for _ in names))
    return "\n".join(f"|{line}|" if k == 1 else f"| {line} |" for k, line in enumerate(lines))


def replace_block(page: Path, name: str, text: str) -> None:
    """Put a table between its two marks in a page."""
    begin, end = f"<!-- {name} -->", f"<!-- end of {name} -->"
    head, rest = page.read_text().split(begin)
    tail = rest.split(end)[1]
    page.write_text(f"{head}{begin}\n\n{text}\n\n{end}{tail}")
