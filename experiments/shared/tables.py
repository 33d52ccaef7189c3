"""Read and write tables as csv files and as blocks of pages."""

import csv
import subprocess
import time
from collections.abc import Iterable, Mapping, Sequence
from operator import itemgetter
from pathlib import Path

import numpy as np

from experiments.shared.timing import describe_processor

DOCS = Path(__file__).parents[2] / "docs"
"""Folder of the pages."""
FIGURES = DOCS / "figures"
"""Folder of the figures and of their data."""
SOURCE_LINE_START = "Command:"
"""First word of the line below a measured block."""
Row = dict[str, str]
"""Cells of one line of a table, by the names of the columns."""


def read_table(path: Path) -> list[Row]:
    """Return the rows of a csv file."""
    with path.open() as file:
        return list(csv.DictReader(file))


def write_table(path: Path, header: Iterable[str], rows: Iterable[Iterable[object]]) -> None:
    """Write a csv file, and create its folder if necessary."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="", errors="backslashreplace") as file:
        csv.writer(file).writerows([header, *rows])


def write_named_rows(path: Path, rows: Sequence[Mapping[str, object]]) -> None:
    """Write rows given by column names to a csv file; a missing cell stays empty."""
    header = dict.fromkeys(name for row in rows for name in row)
    write_table(path, header, [[row.get(name, "") for name in header] for row in rows])


def read_column(rows: Iterable[Row], name: str) -> np.ndarray:
    """Return one column as an array of floats."""
    return np.array([float(row[name]) for row in rows])


def group_rows(rows: Sequence[Row], name: str) -> dict[str, list[Row]]:
    """Return the rows by their value in one column, in order of first appearance."""
    keys = dict.fromkeys(map(itemgetter(name), rows))
    return {key: [row for row in rows if row[name] == key] for key in keys}


def format_markdown(header: Iterable[object], rows: Iterable[Iterable[object]]) -> str:
    """Return a table in Markdown."""
    names = list(header)
    lines = [" | ".join(map(str, cells)) for cells in (names, *rows)]
    lines.insert(1, "|".join("---" for _ in names))
    return "\n".join(f"|{line}|" if k == 1 else f"| {line} |" for k, line in enumerate(lines))


def describe_run(module: str) -> str:
    """Return the line below a measured block: command, commit, machine and date of this run."""
    git = ("git", "-C", str(DOCS), "rev-parse", "--short", "HEAD")
    commit = subprocess.run(git, capture_output=True, text=True, check=False).stdout.strip()
    return (
        f"{SOURCE_LINE_START} `python -m {module}`; commit: `{commit or 'unknown'}`; machine: "
        f"`{describe_processor()}`; date: `{time.strftime('%Y-%m-%d', time.gmtime())}`."
    )


def replace_block(page: Path, name: str, text: str, source: str | None = None) -> None:
    """Replace the text between two marks of a page.

    The block ends with `source`, the line of `describe_run`. Without `source` the present last line
    stays: a table drawn again from stored numbers belongs to the run that measured them.
    """
    begin, end = f"<!-- {name} -->", f"<!-- end of {name} -->"
    head, rest = page.read_text().split(begin)
    block, tail = rest.split(end)
    if source is None:
        lines = block.strip().splitlines()
        source = lines[-1] if lines and lines[-1].startswith(SOURCE_LINE_START) else ""
    page.write_text(f"{head}{begin}\n\n{text}\n\n{source}".rstrip() + f"\n\n{end}{tail}")


def shorten_number(text: str) -> str:
    """Return a number with four significant digits; whole numbers and other text stay."""
    try:
        return text if float(text).is_integer() and "e" not in text else f"{float(text):.4g}"
    except (ValueError, OverflowError):
        return text


def show_table(page: str, table: Path, module: str, columns: Iterable[str] = ()) -> None:
    """Write a csv file's columns, all by default, into the block of a page with its name."""
    rows = read_table(table)
    names = list(columns) or list(rows[0])
    cells = [[shorten_number(row[name]) for name in names] for row in rows]
    replace_block(DOCS / page, table.stem, format_markdown(names, cells), describe_run(module))
