"""Draw charts and tables of the atlas from its stored tables."""

import math
import re
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter

from experiments.shared.tables import (
    DOCS,
    FIGURES,
    Row,
    describe_run,
    format_markdown,
    group_rows,
    read_column,
    read_table,
    replace_block,
)
from vrw_jax import Outcome
from vrw_jax.plot import PAGE_FIGURE_WIDTH_INCHES, figure_style, save, style

STYLES = {  # of Okabe and Ito, a marker each
    "lanes Tsit5": ("#0072B2", "o"),
    "lanes Dopri8": ("#0072B2", "s"),
    "diffrax Kvaerno3": ("#D55E00", "v"),
    "diffrax Kvaerno5": ("#D55E00", "^"),
    "automatic": ("#CC79A7", "*"),
    "numba Dopri5": ("#000000", "o"),
    "heyoka": ("#E69F00", "D"),
    "SciPy DOP853": ("#56B4E9", "s"),
    "SciPy LSODA": ("#56B4E9", "<"),
    "SciPy Radau": ("#56B4E9", ">"),
}
AXES = {"c/m": r"$c/m$ [s$^{-1}$] at $k$ = 500 N/m", "k/m": r"$k/m$ [s$^{-2}$] at $c/m$ = 100/s"}
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#000000", "0.5")
SIGNS = re.compile("λ([24])⁺ → 0")
FAST_MODE_RATIO = 1.03  # rate of SLS-I's fast mode over c/m, docs/explanation/physics.md


def stiffness(rows: list[Row], limit: Callable[[str], float]) -> Figure:
    """Time, work and error over stiffness; crosses where a method gave up or stepped otherwise."""
    figure = Figure(figsize=(PAGE_FIGURE_WIDTH_INCHES, 7.4))
    grid = figure.subplots(3, 2, sharex="col", sharey="row")
    for column, axis in enumerate(AXES):
        for method, (colour, marker) in STYLES.items():
            rows_of_group = [row for row in rows if row["axis"] == axis and row["method"] == method]
            good = [
                row
                for row in rows_of_group
                if row["outcome"] == "STEPPED" and row["error"] != "nan"
            ]
            look = {"color": colour, "marker": marker, "ms": 3.5, "lw": 0.9}
            for axes, name in zip(grid[:, column], ("us_per_gait", "work", "error"), strict=True):
                axes.loglog(
                    read_column(good, "value"), read_column(good, name), label=method, **look
                )
                failed = [row for row in rows_of_group if row not in good]
                y = np.nan_to_num(read_column(failed, name), nan=1.0)
                axes.plot(read_column(failed, "value"), y, "x", color="black", ms=6, zorder=5)
        grid[2, column].set_xlabel(AXES[axis])
    stiff = [row for row in rows if row["axis"] == "c/m" and row["method"] == "numba Dopri5"]
    value, time = read_column(stiff, "value"), read_column(stiff, "duration_sls1")
    for solver, line in (("Tsit5", "--"), ("Dopri8", ":")):
        steps = time * FAST_MODE_RATIO * value / limit(solver)
        grid[1, 0].plot(value, steps, line, color="0.4", lw=1.0, label=f"stability, {solver}")
    for axes, name in zip(
        grid[:, 0], ("CPU time per gait [µs]", "tried steps or evaluations", "error"), strict=True
    ):
        axes.set_ylabel(name)
    for axes in grid.flat:
        axes.grid(color="0.9", lw=0.4)
    grid[2, 0].set_ylim(1e-11, 10.0)
    figure.legend(*grid[1, 0].get_legend_handles_labels(), loc="outside lower center", ncols=4)
    return figure


def borders(rows: list[Row]) -> Figure:
    """Error of derivatives and values over the distance to a border."""
    names = list(dict.fromkeys(row["border"] for row in rows))
    figure = Figure(figsize=(PAGE_FIGURE_WIDTH_INCHES, 2.8))
    grid = figure.subplots(1, len(names), sharey=True)
    for axes, name in zip(grid, names, strict=True):
        rows_of_group = [row for row in rows if row["border"] == name]
        x = read_column(rows_of_group, "distance")
        axes.loglog(
            x, read_column(rows_of_group, "derivative_error"), "o-", ms=4, label="derivative"
        )
        axes.loglog(x, read_column(rows_of_group, "value_error"), "s--", ms=4, label="value")
        axes.set_title(SIGNS.sub(r"$\\lambda_\1^+ \\to 0$", name), fontsize=8)
        axes.grid(color="0.9", lw=0.4)
    figure.supxlabel("relative distance to the border", fontsize="medium")
    grid[0].set_ylabel("error")
    grid[0].legend()
    return figure


def select_last_rows(rows: list[Row], name: str) -> list[Row]:
    """Return the last row for each value of a column."""
    return [rows_of_group[-1] for rows_of_group in group_rows(rows, name).values()]


def curves(axes: Axes, rows: list[Row], by_input: str, x: str, y: str, label: str = "{}") -> None:
    """Draw one curve for each value of a column, with a color and a marker, and without zeros."""
    looks = zip(COLOURS, "os^Dv<>p", strict=True)
    for (key, rows_of_group), (colour, marker) in zip(
        group_rows(rows, by_input).items(), looks, strict=False
    ):
        xs, ys = read_column(rows_of_group, x), np.abs(read_column(rows_of_group, y))
        is_positive = ys > 0.0
        look = {"color": colour, "marker": marker, "ms": 3.5, "lw": 0.9}
        axes.loglog(xs[is_positive], ys[is_positive], label=label.format(key), **look)
    axes.grid(color="0.9", lw=0.4)


def draw_over_steps(
    rows: list[Row], key: str, label: str, label_by_column: dict[str, str], height: float
) -> tuple[Figure, Axes]:
    """Draw a panel over the number of steps for each column, and return the last panel."""
    figure = Figure(figsize=(PAGE_FIGURE_WIDTH_INCHES, height))
    for axes, (y, name) in zip(
        figure.subplots(1, len(label_by_column)), label_by_column.items(), strict=True
    ):
        curves(axes, rows, key, "steps", y, label)
        axes.set(xlabel="steps", ylabel=name)
    return figure, axes


def long_walk(rows: list[Row]) -> Figure:
    """Distance from the cycle, error of the clock and energy not accounted for, over steps."""
    shown_by_name = {
        "distance": "distance from the cycle",
        "clock_error_s": "error of the clock [s]",
        "not_accounted_J": "energy not accounted for [J]",
    }
    rows = sorted(rows, key=lambda row: -float(row["tolerance"]))
    figure, axes = draw_over_steps(rows, "tolerance", "tolerance {}", shown_by_name, 2.8)
    work = group_rows(rows, "tolerance")["1e-06"]
    work_roundoff = np.finfo(float).eps * read_column(work, "work_of_gravity_J")
    axes.loglog(
        read_column(work, "steps"),
        work_roundoff,
        "--",
        color="0.4",
        lw=1.0,
        label="one rounding of the sum",
    )
    figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=5)
    return figure


def between(rows: list[Row]) -> Figure:
    """Share of other outcomes, and the times' largest difference, next to borders of outcomes."""
    figure = Figure(figsize=(PAGE_FIGURE_WIDTH_INCHES, 3.4))
    left_axes, right_axes = figure.subplots(1, 2)
    result = summarize_by_border(rows)
    for row in result:
        row["border"] = ", ".join(map(describe_outcome, row["border"].split(" | ")))
    curves(left_axes, result, "border", "distance", "share")
    curves(right_axes, result, "border", "distance", "time_difference_s")
    left_axes.set(xlabel="relative distance to the border", ylabel="share with another outcome")
    right_axes.set(
        xlabel="relative distance to the border", ylabel="largest difference of durations [s]"
    )
    handles = left_axes.get_legend_handles_labels()
    figure.legend(*handles, loc="outside lower center", ncols=2, fontsize=6)
    return figure


def describe_outcome(outcome: str) -> str:
    """Return a short description of the outcome of a step."""
    return (
        "stepped" if outcome == "STEPPED" else style.OUTCOME_LABELS_AND_COLORS[Outcome[outcome]][0]
    )


def summarize_by_border(rows: list[Row]) -> list[Row]:
    """Both kinds of cases and both sides together; borders met fewer than five times left out."""
    table_rows = []
    for border, rows_of_group in group_rows(rows, "border").items():
        for distance, rows_at_distance in group_rows(rows_of_group, "distance").items():
            names = ("cases", "other_outcome", "other_by_diffrax", "stepped")
            cases, other, by_diffrax, step_result = (
                int(read_column(rows_at_distance, n).sum()) for n in names
            )
            if cases >= 10:  # five borders, two sides each
                table_rows.append(
                    {
                        "border": border,
                        "distance": distance,
                        "cases": str(cases),
                        "other_outcome": f"{other} ({by_diffrax})",
                        "share": str(other / cases),
                        "stepped": str(step_result),
                        "time_difference_s": f"{max(read_column(rows_at_distance, 'time_difference_s')):.1e}",  # noqa: E501
                    }
                )
    return table_rows


def first_order(rows: list[Row]) -> Figure:
    """Error and cost of a leg of first order over c/m."""
    figure = Figure(figsize=(PAGE_FIGURE_WIDTH_INCHES, 2.8))
    left_axes, right = figure.subplots(1, 2)
    curves(left_axes, rows, "leg", "c_over_m", "error", "leg: {}")
    curves(right, rows, "leg", "c_over_m", "us_per_gait")
    left_axes.set(xlabel=r"$c/m$ [s$^{-1}$]", ylabel="error of state and durations")
    right.set(xlabel=r"$c/m$ [s$^{-1}$]", ylabel="CPU time per gait [µs]")
    left_axes.legend()
    return figure


def slowing(rows: list[Row]) -> Figure:
    """Period, and error of the period by each method, over the distance to the stop."""
    figure = Figure(figsize=(PAGE_FIGURE_WIDTH_INCHES, 2.8))
    left_axes, right = figure.subplots(1, 2)
    x, period, rate = (read_column(rows, name) for name in ("distance", "period_s", "upright_rate"))
    left_axes.semilogx(x, period, "o", ms=3.5, color=COLOURS[0], label="gait, by isolated roots")
    line = period[-1] - np.log(x / x[-1]) / rate[-1]
    left_axes.semilogx(x, line, "--", color="0.4", lw=1.0, label="slope −1/rate of falling upright")
    for (name, result), colour, marker in zip(
        {
            "default": "limit cycle, defaults",
            "tight": "limit cycle, tight",
            "step": "one step",
        }.items(),
        COLOURS,
        "os^",
        strict=False,
    ):
        error = read_column(rows, f"{name}_period_error")
        look = {"color": colour, "marker": marker, "ms": 3.5, "lw": 0.9}
        right.loglog(x, error, label=result, **look)
    left_axes.set(xlabel="slope minus the least slope of a gait [rad]", ylabel="period [s]")
    right.set(
        xlabel="slope minus the least slope of a gait [rad]", ylabel="relative error of the period"
    )
    for axes in (left_axes, right):
        axes.grid(color="0.9", lw=0.4)
        axes.legend()
    return figure


def scuffing(rows: list[Row]) -> Figure:
    """Clearance and its derivative, and their errors, where scuffing begins."""
    figure = Figure(figsize=(PAGE_FIGURE_WIDTH_INCHES, 2.8))
    for axes, (value, error, name) in zip(
        figure.subplots(1, 2),
        (
            ("clearance_m", "value_error", "depth of the foot [m]"),
            ("derivative", "derivative_error", "its derivative by $c$ [m/(N·s/m)]"),
        ),
        strict=True,
    ):
        x = read_column(rows, "distance")
        look = {"ms": 3.5, "lw": 0.9}
        axes.loglog(
            x, np.abs(read_column(rows, value)), "o-", color=COLOURS[0], label="size", **look
        )
        axes.loglog(x, read_column(rows, error), "s--", color=COLOURS[1], label="error", **look)
        axes.set(xlabel="relative distance in $c$ below the border", ylabel=name)
        axes.grid(color="0.9", lw=0.4)
        axes.legend()
    return figure


def growth(rows: list[Row]) -> Figure:
    """Draw derivatives over many steps and their errors, over the number of steps, by damping."""
    shown_by_name = {
        "by_start": "norm of derivative by the start",
        "by_damping": "derivative by $c$",
        "error": "error of the derivative by $c$",
    }
    figure, axes = draw_over_steps(rows, "damping", "$c$ = {} N·s/m", shown_by_name, 3.0)
    axes.set_ylim(1e-13, 1e-7)
    figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=4)
    return figure


def meeting(rows: list[Row]) -> Figure:
    """Draw errors of derivatives of stability measures over the distance between multipliers."""
    figure = Figure(figsize=(PAGE_FIGURE_WIDTH_INCHES, 2.8))
    grid = figure.subplots(1, 2, sharey=True)
    for axes, (kind, rows_of_group) in zip(
        grid, group_rows(rows, "multipliers").items(), strict=True
    ):
        x = np.abs(read_column(rows_of_group, "distance"))
        for y, label, line, colour in (
            ("d_radius", "derivative of the spectral radius", "o-", COLOURS[0]),
            ("d_radius_error", "its error", "s--", COLOURS[1]),
            ("d_jury_error", "error of the Jury margins' derivatives", "^--", COLOURS[2]),
        ):
            axes.loglog(
                x,
                np.maximum(np.abs(read_column(rows_of_group, y)), 1e-17),
                line,
                color=colour,
                ms=3.5,
                lw=0.9,
                label=label,
            )
        axes.set(xlabel="distance $s$", title=f"{kind} eigenvalues")
        axes.grid(color="0.9", lw=0.4)
    figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=3)
    return figure


def modes(rows: list[Row]) -> Figure:
    """Error and cost of a gait's derivative, implicit and through n steps."""
    figure = Figure(figsize=(PAGE_FIGURE_WIDTH_INCHES, 2.8))
    left_axes, right = figure.subplots(1, 2)
    walk_rows = [row for row in rows if row["steps"] != "0"]
    curves(left_axes, walk_rows, "way", "steps", "median_error")
    curves(right, walk_rows, "way", "steps", "ms")
    for row, line in zip([row for row in rows if row["steps"] == "0"], ("--", ":"), strict=True):
        for axes, name in ((left_axes, "median_error"), (right, "ms")):
            axes.axhline(float(row[name]), color=COLOURS[2], ls=line, lw=1.2, label=row["way"])
    left_axes.set(
        xlabel="steps of the walk", ylabel="relative error of the period's derivative, median"
    )
    right.set(xlabel="steps of the walk", ylabel="CPU time per gait [ms]")
    right.legend(fontsize=6)
    return figure


def formulations(drift: list[Row], penalty: list[Row]) -> Figure:
    """Constraint drift over steps, and a penalty ground's error over its work."""
    figure = Figure(figsize=(PAGE_FIGURE_WIDTH_INCHES, 2.9))
    left_axes, right = figure.subplots(1, 2)
    for marker, name in zip("os^", dict.fromkeys(row["stabilised"] for row in drift), strict=True):
        rows_of_group = [row for row in drift if row["stabilised"] == name]
        gap = read_column(rows_of_group, "gap_m")
        left_axes.loglog(
            read_column(rows_of_group, "steps"),
            gap,
            f"{marker}-",
            ms=4,
            label=f"stabilised: {name}",
        )
    left_axes.set(xlabel="integrator steps", ylabel="largest gap of a held foot [m]")
    left_axes.legend()
    for marker, name in zip("os", dict.fromkeys(row["ground"] for row in penalty), strict=True):
        rows_of_group = [
            row for row in penalty if row["ground"] == name and row["outcome"] == "STEPPED"
        ]
        look = {"ms": 4, "label": f"penalty, {name}"}
        # Each of the two errors changes sign somewhere.
        error = np.maximum(
            read_column(rows_of_group, "dtheta_error"), read_column(rows_of_group, "period_error")
        )
        right.loglog(read_column(rows_of_group, "evaluations"), error, f"{marker}-", **look)
    error_of = r"error of $\dot\theta$ [rad/s] and period [s], the larger"
    right.set(xlabel="evaluations per gait", ylabel=error_of)
    right.legend()
    for axes in (left_axes, right):
        axes.xaxis.set_minor_formatter(NullFormatter())
        axes.grid(color="0.9", lw=0.4)
    return figure


def automatic(rows: list[Row]) -> str:
    """Return the fastest method with an error below 1e-4 and the automatic choice, by decade."""
    lines = []
    fast = lambda rows_of_group: min(rows_of_group, key=lambda row: float(row["us_per_gait"]))
    for axis in AXES:
        for value, rows_of_group in group_rows(
            [r for r in rows if r["axis"] == axis], "value"
        ).items():
            if not math.log10(float(value)).is_integer():
                continue
            chosen = next(row for row in rows_of_group if row["method"] == "automatic")
            good = [
                r for r in rows_of_group if r["outcome"] == "STEPPED" and float(r["error"]) < 1e-4
            ]
            assert chosen in good
            good.remove(chosen)
            every = fast(good)
            ratio = float(chosen["us_per_gait"]) / float(every["us_per_gait"])
            cells = [axis, value, every["method"], every["us_per_gait"]]
            cells += [chosen["solver"], chosen["us_per_gait"]]
            lines.append([*cells, f"{ratio:.2f}"])
    header = ("axis", "value", "fastest", "µs", "automatic", "µs")
    return format_markdown((*header, "ratio"), lines)


def events(rows: list[Row]) -> list[Row]:
    """Count the cases by kind over all chunks, and those in which our solver gave up."""
    counts = ("cases", "stepped", "late", "other_outcome")
    gave_up = re.compile(r"SOLVER_FAILED/\w+: (\d+)")
    return [
        {"kind": kind}
        | {name: str(sum(int(row[name]) for row in rows_of_group)) for name in counts}
        | {
            "of_them_gave_up": str(
                sum(int(n) for row in rows_of_group for n in gave_up.findall(row["ours/isolated"]))
            ),
            "largest_time_difference": f"{max(read_column(rows_of_group, 'largest_time_difference')):.2e}",  # noqa: E501
        }
        for kind, rows_of_group in group_rows(rows, "kind").items()
    ]


def dips(rows: list[Row]) -> list[Row]:
    """Count the local minima by kind of case over all chunks."""
    counts = ("cases", "stepped", "gave_up", "other_outcome", "other_by_tight")
    return [
        {"kind": kind}
        | {name: str(sum(int(row[name]) for row in rows_of_group)) for name in counts}
        for kind, rows_of_group in group_rows(rows, "kind").items()
    ]


LONG_WALK_COLUMNS = ("tolerance", "steps", "distance", "clock_error_s", "share")
"""Columns of the table of long walks on the page."""


def as_table(rows: list[Row]) -> str:
    """Format all columns as a table."""
    return format_markdown(
        [name.replace("_", " ") for name in rows[0]], [row.values() for row in rows]
    )


def draw(
    tables: dict[str, Path], limit: Callable[[str], float], measured_names: Sequence[str]
) -> None:
    """Draw every chart and table of the pages whose data exist.

    Tables of maps that were measured now get a new line of command, commit, machine and date.
    """
    accuracy = DOCS / "verification" / "accuracy.md"
    stiff_legs = DOCS / "benchmarks" / "stiff_legs.md"
    known_by_name = {name: read_table(path) for name, path in tables.items() if path.exists()}
    result_by_name = {
        "switch": ("stiffness", automatic),
        "events": ("events", lambda rows: as_table(events(rows))),
        "dips": ("dips", lambda rows: as_table(dips(rows))),
        "long_walk": (
            "long_walk",
            lambda rows: as_table(
                [
                    {name: row[name] for name in LONG_WALK_COLUMNS}
                    for row in select_last_rows(rows, "tolerance")
                ]
            ),
        ),
    }
    for mark, (name, text) in result_by_name.items():
        if name in known_by_name:
            page = stiff_legs if mark == "switch" else accuracy
            command = f"experiments.atlas.run --only {name}"
            source = describe_run(command) if name in measured_names else None
            replace_block(page, mark, text(known_by_name[name]), source)
    charts: dict[str, Callable[[list[Row]], Figure]] = {
        "stiffness": lambda rows: stiffness(rows, limit),
        "between": between,
        "first_order": first_order,
        "slowing": slowing,
        "borders": borders,
        "scuffing": scuffing,
        "growth": growth,
        "meeting": meeting,
        "modes": modes,
        "long_walk": long_walk,
    }
    with figure_style():
        for name, chart in charts.items():
            if name in known_by_name:
                save(chart(known_by_name[name]), FIGURES, f"atlas_{name}")
        if {"drift", "formulations"} <= set(known_by_name):
            figure = formulations(known_by_name["drift"], known_by_name["formulations"])
            save(figure, FIGURES, "atlas_formulations")
