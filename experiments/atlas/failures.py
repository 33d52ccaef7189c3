"""Compare methods on published problems: one table, and one figure for each case.

    python -m experiments.atlas.failures [--only CASE ...] [--redraw]

Each case is a module of experiments/atlas/cases with its reference. A row of the table contains a
method's result, its error, its message and its cost. The pages docs/verification/failures.md and
hybrid_problems.md contain summaries. With `--only` the given cases run again.
"""

import importlib
import math
import pkgutil
import re
import time
import unicodedata
from collections.abc import Collection

from matplotlib.figure import Figure

from experiments.atlas import cases
from experiments.atlas.results import Case, Row
from experiments.shared.command import make_parser
from experiments.shared.tables import (
    DOCS,
    FIGURES,
    describe_run,
    format_markdown,
    group_rows,
    read_table,
    replace_block,
    write_named_rows,
    write_table,
)
from experiments.shared.timing import start_without_cache, use_one_core
from vrw_jax.plot import PAGE_FIGURE_WIDTH_INCHES as WIDE
from vrw_jax.plot import figure_style, save

TABLE = FIGURES / "atlas_failures.csv"
ORDER = (
    "bouncing_ball", "monodromy", "grazing", "resonant_grazing", "two_states", "pinned_pendulum",
    "clutches", "stick_slip", "woodpecker", "slider_crank", "painleve", "chenciner", "few_segments",
    "singular_field", "tangent_guards", "simplest_walker", "compass_gait", "rimless_wheel",
)  # fmt: skip
NAMES = [name for name in ORDER if name in {m.name for m in pkgutil.iter_modules(cases.__path__)}]
OVERVIEW = DOCS / "verification" / "failures.md"
PROBLEMS = DOCS / "verification" / "hybrid_problems.md"


def import_case(name: str) -> Case:
    return importlib.import_module(f"experiments.atlas.cases.{name}").CASE


def as_text(name: str, row: Row) -> dict[str, str]:
    """Format one row of the table."""
    return {
        "case": name,
        "quantity": row.quantity,
        "method": row.method,
        "verdict": row.verdict,
        "found": f"{row.found:.15g}",
        "reference": f"{row.reference:.15g}",
        "error": "-" if math.isinf(row.error) else f"{row.error:.1e}",
        "within": f"{row.is_within_request:.3g}",
        "condition": f"{row.condition:.3g}",
        "digits": "" if row.digits is None else str(row.digits),
        "says": row.says,
        "work": str(row.work),
        "ms": f"{1e3 * row.seconds:.3g}",
        "options": row.options,
        "version": row.version,
    }


VERDICT_LABELS = {
    "right": "correct",
    "says so": "failure reported",
    "WRONG, silently": "WRONG, not reported",
}
"""What the page calls the stored verdicts, best first."""


def anchor(title: str) -> str:
    """Return the anchor of a heading, as the site forms it."""
    plain = unicodedata.normalize("NFKD", title).encode("ascii", "ignore").decode()
    return re.sub(r"[-\s]+", "-", re.sub(r"[^\w\s-]", "", plain).strip().lower())


def summarize_by_method(rows: list[dict[str, str]]) -> list[tuple[str, str]]:
    """Return each method of a case with its worst verdict."""
    severities = list(VERDICT_LABELS)
    return [
        (
            method.replace("ours", "vrw_jax"),
            VERDICT_LABELS[max((row["verdict"] for row in rows_of_method), key=severities.index)],
        )
        for method, rows_of_method in group_rows(rows, "method").items()
    ]


def select_exact_rows(rows: list[dict[str, str]]) -> list[dict[str, str]]:
    """Return the results of this library for which the reference has all digits."""
    return [
        row
        for row in rows
        if row["method"].startswith("ours")
        and row["verdict"] == "right"
        and not row["digits"]
        and "1e-10" not in row["options"]
    ]


def format_page(rows: list[dict[str, str]], measured_names: Collection[str] = ()) -> None:
    """Write the table of results and the file of origins, with a line for each case.

    If several cases were measured now, the table gets a new line of command, commit, machine and
    date.
    """
    results, origins = [], []
    for name, selection in group_rows(rows, "case").items():
        case, methods = import_case(name), summarize_by_method(selection)
        errors = [
            float(row["error"]) / float(row["condition"]) for row in select_exact_rows(selection)
        ]
        method_cells = [
            "; ".join(m for m, verdict in methods if verdict == label)
            for label in VERDICT_LABELS.values()
        ]
        link = f"[{case.title}]({PROBLEMS.name}#{anchor(case.title)})"
        results.append([link, *method_cells, f"{max(errors):.0e}" if errors else "-"])
        origins.append([case.title, case.reference, case.source])
    header = ["problem", *VERDICT_LABELS.values(), "error of vrw_jax over condition"]
    source = describe_run("experiments.atlas.failures") if len(measured_names) > 1 else None
    replace_block(OVERVIEW, "failures", format_markdown(header, results), source)
    write_table(FIGURES / "atlas_failure_origins.csv", ["problem", "reference", "origin"], origins)


def draw(name: str, rows: list[dict[str, str]]) -> None:
    with figure_style():
        figure = Figure(figsize=(0.62 * WIDE, 0.42 * WIDE))
        import_case(name).draw(figure, [row for row in rows if row["case"] == name])
        save(figure, FIGURES, f"failure_{name}")


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument("--only", choices=NAMES, nargs="+", help="some cases", metavar="CASE")
    parser.add_argument("--redraw", action="store_true", help="tables of the page alone")
    chosen = parser.parse_args()
    names = chosen.only or NAMES
    if chosen.redraw:
        format_page(read_table(TABLE))
        return
    rows = read_table(TABLE) if chosen.only and TABLE.exists() else []
    began = time.strftime("%Y-%m-%dT%H:%MZ", time.gmtime())
    with use_one_core():
        start_without_cache()
        for name in names:
            selection = [as_text(name, row) | {"run": began} for row in import_case(name).rows()]
            for row in selection:
                print(*(x for key, x in row.items() if key not in ("options", "run")), flush=True)
            draw(name, selection)
            rows = [row for row in rows if row["case"] != name] + selection
    rows.sort(key=lambda row: ORDER.index(row["case"]))
    write_named_rows(TABLE, rows)
    format_page(rows, names)


if __name__ == "__main__":
    main()
