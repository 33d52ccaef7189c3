"""Where methods fail, on problems that nobody here made: one table, one picture for each case.

    python -m experiments.atlas.failures [--only CASE ...] [--redraw]

Each case is a module of experiments/atlas/cases with its truth. The rows of the table are what each
method gave in this run: its answer, its error, its own words, what it cost. docs/stability_atlas.md
opens with them.
"""

import importlib
import math
import pkgutil
import re
import unicodedata

from matplotlib.figure import Figure

from experiments.atlas import cases
from experiments.atlas.told import RIGHT, Case, Row
from experiments.shared.command import command
from experiments.shared.tables import DOCS, FIGURES, groups, markdown, read, replace, write_named
from experiments.shared.timing import on_one_core, start_cold
from vrw_jax.figures import PAGE as WIDE
from vrw_jax.figures import figure_style, save

TABLE = FIGURES / "atlas_failures.csv"
ORDER = (
    "bouncing_ball", "monodromy", "grazing", "resonant_grazing", "two_states", "pinned_pendulum",
    "stick_slip", "painleve", "chenciner", "few_segments", "singular_field",
    "tangent_guards", "simplest_walker", "compass_gait", "rimless_wheel",
)  # fmt: skip
NAMES = [name for name in ORDER if name in {m.name for m in pkgutil.iter_modules(cases.__path__)}]
TEXT = DOCS / "stability_atlas.md"


def case_of(name: str) -> Case:
    return importlib.import_module(f"experiments.atlas.cases.{name}").CASE


def as_text(name: str, row: Row) -> dict[str, str]:
    """A row of the table."""
    return {
        "case": name,
        "quantity": row.quantity,
        "method": row.method,
        "verdict": row.verdict,
        "found": f"{row.found:.15g}",
        "truth": f"{row.truth:.15g}",
        "error": "-" if math.isinf(row.error) else f"{row.error:.1e}",
        "within": f"{row.within:g}",
        "says": row.says,
        "work": str(row.work),
        "ms": f"{1e3 * row.seconds:.3g}",
        "options": row.options,
        "version": row.version,
    }


WORSE = ("right", "says so", "WRONG, silently")


def anchor(title: str) -> str:
    """Of a heading, as the page's markdown makes it."""
    plain = unicodedata.normalize("NFKD", title).encode("ascii", "ignore").decode()
    return re.sub(r"[-\s]+", "-", re.sub(r"[^\w\s-]", "", plain).strip().lower())


def by_method(rows: list[dict[str, str]]) -> list[list[str]]:
    """A line for each method of a case: its worst answer, and what it cost."""
    lines = []
    for method, own in groups(rows, "method").items():
        size = lambda row: math.inf if row["error"] == "-" else float(row["error"])
        worst = max(own, key=lambda row: (WORSE.index(row["verdict"]), size(row)))
        good = sum(row["verdict"] == "right" for row in own)
        says = next((row["says"] for row in [worst, *own] if row["says"]), "")
        lines.append(
            [
                method, worst["verdict"], f"{good} of {len(own)}", worst["quantity"],
                worst["error"], says, worst["work"], worst["ms"],
                f"{worst['options']}; {worst['version']}",
            ]
        )  # fmt: skip
    return lines


def tell(rows: list[dict[str, str]]) -> None:
    """Tables of the page: one line for each case, and under each case one for each method."""
    lines = []
    for name, some in groups(rows, "case").items():
        case, methods = case_of(name), by_method(some)
        errors = [
            float(row["error"])
            for row in some
            if row["method"].startswith("ours")
            and row["verdict"] == "right"
            and float(row["within"]) <= RIGHT
        ]
        told = ["; ".join(m for m, verdict, *_ in methods if verdict == word) for word in WORSE]
        lines.append(
            [
                f"[{case.title}](#{anchor(case.title)})", case.breaks, case.truth,
                f"{max(errors, default=math.nan):.0e}", *told, f"`--only {name}`",
            ]
        )  # fmt: skip
        header = ["method", "worst verdict", "right", "worst question", "error", "says", "work",
                  "ms", "options; version"]  # fmt: skip
        table = markdown(header, methods)
        replace(TEXT, f"failure {name}", f"{table}\n\nSource: {case.source}.")
    header = ["case", "what breaks", "truth", "our largest error", "right", "says so",
              "wrong silently", "command"]  # fmt: skip
    replace(TEXT, "failures", markdown(header, lines))


def draw(name: str, rows: list[dict[str, str]]) -> None:
    with figure_style():
        figure = Figure(figsize=(0.62 * WIDE, 0.42 * WIDE))
        case_of(name).draw(figure, [row for row in rows if row["case"] == name])
        save(figure, FIGURES, f"failure_{name}")


def main() -> None:
    parser = command(__doc__)
    parser.add_argument("--only", choices=NAMES, nargs="+", help="some cases", metavar="CASE")
    parser.add_argument("--redraw", action="store_true", help="tables of the page alone")
    chosen = parser.parse_args()
    names = chosen.only or NAMES
    kept = read(TABLE) if TABLE.exists() else []
    if not chosen.redraw:
        with on_one_core():
            start_cold()
            for name in names:
                some = [as_text(name, row) for row in case_of(name).rows()]
                kept = [row for row in kept if row["case"] != name] + some
                kept.sort(key=lambda row: ORDER.index(row["case"]))
                for row in some:
                    print(
                        *(row[key] for key in row if key not in ("options", "version")), flush=True
                    )
                write_named(TABLE, kept)
                draw(name, kept)
    tell(kept)


if __name__ == "__main__":
    main()
