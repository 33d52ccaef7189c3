"""Draw charts and tables of work against precision from the stored measurements."""

import json
import math
import textwrap
from collections.abc import Callable
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter

from experiments.shared.tables import DOCS, FIGURES, Row, format_markdown, replace_block
from vrw_jax.plot import PAGE_FIGURE_WIDTH_INCHES, figure_style, save

QUANTITIES = {  # group and title of each panel
    "post_impact": ("step", "state after the next landing"),
    "event_times": ("step", "times of the three events"),
    "cycle": ("cycle", "limit cycle and period"),
    "dls_fraction": ("cycle", "DLS fraction of the cycle"),
    "multipliers": ("cycle", "multipliers"),
    "gradient": ("gradient", "gradient of DLS fraction, period"),
}
COLOURS = {  # of Okabe and Ito
    "lane engine": "#0072B2",
    "diffrax engine": "#D55E00",
    "collocation": "#009E73",
    "diffrax by hand": "#CC79A7",
    "numba": "#000000",
    "heyoka": "#E69F00",
    "SciPy": "#56B4E9",
    "torchdiffeq": "#555555",
}
OURS = ("lane engine", "diffrax engine", "collocation")
PAGE_TEXT = Path(__file__).parent / "page.html"
MARKS = "os^Dv<>ph"
NOTE: dict = {
    "fontsize": 6,
    "zorder": 6,
    "bbox": {"boxstyle": "square,pad=0.1", "fc": "white", "ec": "none", "alpha": 0.8},
}
TARGETS = (1e-3, 1e-6, 1e-9, 1e-12)
DEFAULTS = {  # what a user gets who chooses nothing, by group
    ("step", "diffrax engine", "Dopri8", "1e-10"),
    ("step", "lane engine", "Dopri8", "1e-10"),
    ("cycle", "collocation", "from nothing", "(10, 8, 3)"),
    ("gradient", "collocation", "forward", "(10, 8, 3)"),
}
TABLE_METHODS = {  # of the table: group, one wheel or many
    "one step": ("step", True),
    "a batch of steps": ("step", False),
    "one limit cycle": ("cycle", True),
    "a batch of limit cycles": ("cycle", False),
    "one gradient": ("gradient", True),
    "a batch of gradients": ("gradient", False),
}
SCALAR = (
    "numba",
    "heyoka",
    "SciPy",
    "torchdiffeq",
)  # one wheel costs them what it costs in a batch


def time_of(row: Row, unit: float) -> float:
    """CPU time per gait, us, as if the reference always took `unit`."""
    return float(row["us_per_gait"]) / float(row["reference_us"]) * unit


def unit_of(rows: list[Row]) -> float:
    """Return the usual time of the reference computation, µs."""
    return float(np.median([float(row["reference_us"]) for row in rows]))


def label_of(row: Row) -> str:
    """Name of a curve."""
    exact = "" if row["precision"] == "float64" else f", {row['precision']}"
    return f"{row['family']}: {row['name']}{exact}"


def is_default(row: Row) -> bool:
    """Return whether a user without own choices gets this setting."""
    named = (row["group"], row["family"], row["name"], row["setting"])
    return named in DEFAULTS and row["precision"] == "float64"


def curves(rows: list[Row], quantity: str) -> dict[str, list[Row]]:
    """Return rows of batches that contain a quantity, by label, with the largest tolerance
    first.
    """
    result: dict[str, list[Row]] = {}
    for row in rows:
        if row.get(f"{quantity}_p99") and int(row["lanes"]) > 1:
            result.setdefault(label_of(row), []).append(row)
    return result


def style_of(rows: list[Row]) -> dict[str, dict]:
    """Colour by family, marker by name, float32 hollow and dotted."""
    styles: dict[str, dict] = {}
    used: dict[str, list[str]] = {}
    for row in rows:
        names = used.setdefault(row["family"], [])
        if row["name"] not in names:
            names.append(row["name"])
        single = row["precision"] == "float32"
        colour = COLOURS[row["family"]]
        styles[label_of(row)] = {
            "color": colour,
            "marker": MARKS[names.index(row["name"])],
            "ls": ":" if single else "-",
            "mfc": "white" if single else colour,
            "ms": 3.5,
            "lw": 0.9,
        }
    return styles


def of_lanes(row: Row) -> int:
    """Return the number of measured lanes that have a reference."""
    return min(int(row["lanes"]), 256)


def draw_panel(axes: Axes, rows: list[Row], quantity: str, x_of) -> None:
    """p99 as a curve, p50 to worst as bars, failures as crosses with their share."""
    styles = style_of(rows)
    for label, selected_rows in curves(rows, quantity).items():
        shown_rows = [
            row for row in selected_rows if x_of(row) > 0.0 and int(row["failed"]) < of_lanes(row)
        ]
        shown_rows = [row for row in shown_rows if float(row[f"{quantity}_p99"]) > 0.0]
        if not shown_rows:
            continue
        x = np.array([x_of(row) for row in shown_rows])
        p50, p99, worst = (
            np.array([max(float(row[f"{quantity}_{part}"]), 1e-17) for row in shown_rows])
            for part in ("p50", "p99", "worst")
        )
        axes.vlines(x, p50, worst, color=styles[label]["color"], lw=0.5, alpha=0.6)
        axes.plot(x, p99, label=label, **styles[label])
        for a, b, row in zip(x, p99, shown_rows, strict=True):
            if int(row["failed"]):
                axes.plot(a, b, "x", color="black", ms=7, mew=1.2, zorder=5)
                note = f"{row['failed']}/{of_lanes(row)}"
                axes.annotate(note, (a, b), (4, 3), textcoords="offset points", **NOTE)
            if is_default(row):
                axes.plot(a, b, "o", ms=9, mfc="none", mec="#444444", mew=0.8)
    axes.set(xscale="log", yscale="log")
    low, high = axes.get_xlim()
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 3.0) if high < 200.0 * low else (1.0,)))
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.set_title(textwrap.fill(QUANTITIES[quantity][1], 28))
    axes.grid(color="0.9", lw=0.4)


def panels(rows: list[Row], quantities: list[str], x_of, x_label: str) -> Figure:
    """Draw one panel for each quantity, with one legend for all."""
    figure = Figure(figsize=(PAGE_FIGURE_WIDTH_INCHES, 4.2))
    grid = figure.subplots(1, len(quantities), sharey=True)
    for quantity, axes in zip(quantities, grid, strict=True):
        draw_panel(axes, rows, quantity, x_of)
        axes.set_xlabel(x_label)
    grid[0].set_ylabel("error, 99th percentile;\nbars from the median to the maximum")
    solution: dict[str, object] = {}
    for axes in grid:
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            solution.setdefault(label, handle)
    order = sorted(solution, key=lambda label: [*COLOURS].index(label.split(":")[0]))
    handles = [solution[label] for label in order]
    figure.legend(handles, order, loc="outside lower center", ncols=3, fontsize=7)
    return figure


def batch_chart(rows: list[Row], every: list[Row]) -> Figure:
    """Time per gait over the batch, and the first call beside a warm one."""
    figure = Figure(figsize=(PAGE_FIGURE_WIDTH_INCHES, 4.4))
    left_axes, right = figure.subplots(1, 2, width_ratios=(1.0, 1.15))
    unit = unit_of(every)
    result: dict[str, list[Row]] = {}
    cycles = [row for row in every if is_default(row) and row["group"] == "cycle"]
    for row in (*rows, *cycles):
        result.setdefault(f"{row['group']}, {row['family']}: {row['name']}", []).append(row)
    for label, sorted_rows in result.items():
        sorted_rows = sorted(sorted_rows, key=lambda row: int(row["lanes"]))
        marker = "s" if sorted_rows[0]["group"] == "cycle" else "o"
        ls = "--" if sorted_rows[0]["group"] == "cycle" else "-"
        left_axes.loglog(
            [int(row["lanes"]) for row in sorted_rows],
            [time_of(row, unit) for row in sorted_rows],
            ls=ls, marker=marker, ms=3.5, color=COLOURS[sorted_rows[0]["family"]], label=label,
        )  # fmt: skip
    left_axes.set(xlabel="wheels in a call", ylabel="CPU time per gait [µs]")
    left_axes.grid(color="0.9", lw=0.4)
    left_axes.legend(fontsize=6, loc="upper center", bbox_to_anchor=(0.45, -0.14), ncols=2)
    first: dict[str, tuple[float, float]] = {}
    for row in every:
        name = f"{row['group']}, {label_of(row)}" + (", one" if row["lanes"] == "1" else "")
        warm = float(row["us_per_gait"]) * int(row["lanes"]) * 1e-6
        if name not in first or float(row["first_call_s"]) > first[name][0]:
            first[name] = float(row["first_call_s"]), warm
    order = sorted(first, key=lambda name: first[name][0])
    place = np.arange(len(order))
    right.hlines(place, [first[n][1] for n in order], [first[n][0] for n in order], color="0.8")
    right.plot([first[n][1] for n in order], place, "o", ms=3, color="#0072B2", label="warm call")
    right.plot([first[n][0] for n in order], place, "s", ms=3, color="#D55E00", label="first call")
    right.set_yticks(place, order, fontsize=5.5)
    right.set(xscale="log", xlabel="CPU time of a call [s]")
    right.legend(fontsize=6, loc="lower right")
    return figure


def best(rows: list[Row], group: str, is_for_one_wheel: bool, target: float) -> Row | None:
    """Return the fastest row in which each p99 error is below the target and no lane failed.

    A single wheel is judged by the errors of the batch, because its error alone may be small by
    chance.
    """
    quantities = [name for name, (of_values, _) in QUANTITIES.items() if of_values == group]
    unit = unit_of(rows)
    selected_rows = []
    for row in rows:
        fits = row["group"] == group and int(row["failed"]) == 0
        fits = fits and (row["lanes"] == "1" or not is_for_one_wheel or row["family"] in SCALAR)
        fits = fits and (is_for_one_wheel or row["lanes"] != "1")
        is_same = [r for r in rows if r["lanes"] != "1" and curve_of(r) == curve_of(row)]
        judged = is_same[0] if is_same else row
        fits = fits and int(judged["failed"]) == 0
        if fits and all(float(judged[f"{name}_p99"] or "nan") <= target for name in quantities):
            selected_rows.append(row)
    return min(selected_rows, key=lambda row: time_of(row, unit), default=None)


def curve_of(row: Row) -> tuple[str, ...]:
    """Method and setting, whatever the number of lanes."""
    return tuple(row[name] for name in ("group", "family", "name", "precision", "setting"))


def format_time(us: float) -> str:
    """Return microseconds with a unit."""
    scale, unit = (1.0, "µs") if us < 1e3 else (1e-3, "ms") if us < 1e6 else (1e-6, "s")
    return f"{us * scale:.3g} {unit}"


def table(rows: list[Row]) -> str:
    """Return a table of recommended methods, of this library and of all.

    Errors with the same recommendation share a line.
    """
    unit = unit_of(rows)
    ours = [row for row in rows if row["family"] not in (*SCALAR, "diffrax by hand")]
    lines: list[list[str]] = []
    for method_name, (group, is_for_one_wheel) in TABLE_METHODS.items():
        for target in TARGETS:
            cells = [method_name, f"1e{round(math.log10(target))}"]
            for selected_rows in (ours, rows):
                row = best(selected_rows, group, is_for_one_wheel, target)
                if row is None:
                    cells += ["none", "–"]
                else:
                    cells += [f"{label_of(row)}, {row['setting']}", format_time(time_of(row, unit))]
            if cells[2:] == ["none", "–", "none", "–"]:
                continue
            if cells[2:4] == cells[4:]:
                cells[4:] = "the same", ""
            if lines and [*lines[-1][:1], *lines[-1][2:]] == [method_name, *cells[2:]]:
                lines[-1][1] = f"{lines[-1][1].split()[0]} to {cells[1]}"
            else:
                lines.append(cells)
    header = ("wanted", "p99 error", "ours", "per gait", "fastest of all", "per gait")
    return format_markdown(header, lines)


def floors(rows: list[Row]) -> str:
    """Return the least p99 error of each quantity by number format, and its method."""
    lines = []
    for quantity, (_, title) in QUANTITIES.items():
        cells = [title]
        for precision in ("float32", "float64"):
            selected_rows = [
                row
                for row in rows
                if row["precision"] == precision
                and row["family"] not in (*SCALAR, "diffrax by hand")
                and row.get(f"{quantity}_p99")
                and int(row["lanes"]) > 1
                and "durations" not in row["name"]  # of a step, with wheels handed on
            ]
            minimum = min(
                selected_rows, key=lambda row: float(row[f"{quantity}_p99"]), default=None
            )
            if minimum is None:
                cells += ["not measured", "–"]
            else:
                error = float(minimum[f"{quantity}_p99"])
                failed = int(minimum["failed"])
                failure_note = f", {failed} of {of_lanes(minimum)} failed" if failed else ""
                cells += [
                    f"{error:.0e}",
                    f"{minimum['family']}, {minimum['setting']}{failure_note}",
                ]
        lines.append(cells)
    return format_markdown(("quantity", "float32", "by", "float64", "by"), lines)


STEPS, CYCLES = list(QUANTITIES)[:2], list(QUANTITIES)[2:]
CHARTS = {  # quantities, and which rows are shown
    "steps": (STEPS, lambda row: row["family"] in OURS),
    "peers": (STEPS, lambda row: row["family"] not in OURS or is_default_method(row)),
    "cycles": (CYCLES, lambda row: row["group"] != "step"),
}


def is_default_method(row: Row) -> bool:
    """Return whether a user without own choices gets this method, at any setting."""
    named = (row["group"], row["family"], row["name"])
    return named in {one[:3] for one in DEFAULTS} and row["precision"] == "float64"


def works(unit: float) -> dict[str, tuple[str, Callable[[Row], float]]]:
    """Return the label of the axis of work, and a function that reads the work of a row."""
    return {
        "time": ("CPU time per gait [µs]", lambda row: time_of(row, unit)),
        "evaluations": ("evaluations per gait", lambda row: float(row["evaluations"])),
    }


def write_page(
    rows: list[Row], path: Path, counted: dict[str, tuple[str, Callable[[Row], float]]]
) -> None:
    """Write all methods and quantities into one page with a switch for each."""
    curves_of = []
    for quantity, (_, title) in QUANTITIES.items():
        for label, selected_rows in curves(rows, quantity).items():
            parts = [f"{quantity}_{part}" for part in ("p50", "p99", "worst")]
            points = [
                [
                    row["setting"],
                    *(x_of(row) for _, x_of in counted.values()),
                    *(max(float(row[part]), 1e-17) for part in parts),
                    int(row["failed"]),
                    of_lanes(row),
                ]
                for row in selected_rows
                if int(row["failed"]) < of_lanes(row)
            ]
            look = {"quantity": title, "label": label, "colour": COLOURS[label.split(":")[0]]}
            curves_of.append(look | {"points": points})
    labels = json.dumps([label for label, _ in counted.values()])
    text = PAGE_TEXT.read_text(encoding="utf-8")
    text = text.replace("CURVES", json.dumps(curves_of)).replace("LABELS", labels)
    path.write_text(text, encoding="utf-8")


def draw(rows: list[Row], batches: list[Row], source: str | None = None) -> None:
    """Draw all charts and tables; `source` is the line of `describe_run` of a new measurement."""
    unit = unit_of(rows)
    with figure_style():
        for name, (quantities, is_row_shown) in CHARTS.items():
            selected_rows = [row for row in rows if is_row_shown(row)]
            for work, (label, x_of) in works(unit).items():
                chart = panels(selected_rows, quantities, x_of, label)
                save(chart, FIGURES, f"work_precision_{name}_{work}")
        save(batch_chart(batches, rows), FIGURES, "work_precision_batch")
    write_page(rows, FIGURES / "work_precision.html", works(unit))
    page = DOCS / "benchmarks" / "work_precision.md"
    replace_block(page, "what to use", table(rows), source)
    replace_block(page, "floors", floors(rows), source)
