"""Charts of stability_atlas.py, drawn from its tables alone."""

import csv
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter
from work_precision_charts import replace

from vrw_jax.plots import PAGE, save, style

Row = dict[str, str]
STYLES = {  # of Okabe and Ito, a marker each
    "lanes Tsit5": ("#0072B2", "o"),
    "lanes Dopri8": ("#0072B2", "s"),
    "diffrax Kvaerno3": ("#D55E00", "v"),
    "numba Dopri5": ("#000000", "o"),
    "heyoka": ("#E69F00", "D"),
    "SciPy DOP853": ("#56B4E9", "s"),
    "SciPy LSODA": ("#56B4E9", "<"),
    "SciPy Radau": ("#56B4E9", ">"),
}
AXES = {"c/m": r"$c/m$ [s$^{-1}$] at $k$ = 500 N/m", "k/m": r"$k/m$ [s$^{-2}$] at $c/m$ = 100/s"}
SIGNS = re.compile("λ([24])⁺ → 0")
FAST = 1.03  # rate of SLS-I's fast mode over c/m, docs/physics.md


def read(path: Path) -> list[Row]:
    with path.open() as file:
        return list(csv.DictReader(file))


def numbers(rows: list[Row], name: str) -> np.ndarray:
    return np.array([float(row[name]) for row in rows])


def stiffness(rows: list[Row], limit: Callable[[str], float]) -> Figure:
    """Time, work and error over stiffness; crosses where a method gave up or stepped otherwise."""
    figure = Figure(figsize=(PAGE, 7.4))
    grid = figure.subplots(3, 2, sharex="col", sharey="row")
    for column, axis in enumerate(AXES):
        for method, (colour, marker) in STYLES.items():
            some = [row for row in rows if row["axis"] == axis and row["method"] == method]
            good = [row for row in some if row["outcome"] == "STEPPED" and row["error"] != "nan"]
            look = {"color": colour, "marker": marker, "ms": 3.5, "lw": 0.9}
            for axes, name in zip(grid[:, column], ("us_per_gait", "work", "error"), strict=True):
                axes.loglog(numbers(good, "value"), numbers(good, name), label=method, **look)
                failed = [row for row in some if row not in good]
                y = np.nan_to_num(numbers(failed, name), nan=1.0)
                axes.plot(numbers(failed, "value"), y, "x", color="#D00000", ms=6, zorder=5)
        grid[2, column].set_xlabel(AXES[axis])
    stiff = [row for row in rows if row["axis"] == "c/m" and row["method"] == "numba Dopri5"]
    value, time = numbers(stiff, "value"), numbers(stiff, "duration_sls1")
    for solver, line in (("Tsit5", "--"), ("Dopri8", ":")):
        steps = time * FAST * value / limit(solver)
        grid[1, 0].plot(value, steps, line, color="0.4", lw=1.0, label=f"stability, {solver}")
    for axes, name in zip(
        grid[:, 0], ("CPU time per gait [µs]", "tried steps or evaluations", "error"), strict=True
    ):
        axes.set_ylabel(name)
    for axes in grid.flat:
        axes.grid(color="0.9", lw=0.4)
    grid[2, 0].set_ylim(1e-9, 10.0)
    figure.legend(*grid[1, 0].get_legend_handles_labels(), loc="outside lower center", ncols=4)
    return figure


def borders(rows: list[Row]) -> Figure:
    """Error of derivatives and values over the distance to a border."""
    names = list(dict.fromkeys(row["border"] for row in rows))
    figure = Figure(figsize=(PAGE, 2.8))
    grid = figure.subplots(1, len(names), sharey=True)
    for axes, name in zip(grid, names, strict=True):
        some = [row for row in rows if row["border"] == name]
        x = numbers(some, "distance")
        axes.loglog(x, numbers(some, "derivative_error"), "o-", ms=4, label="derivative")
        axes.loglog(x, numbers(some, "value_error"), "s--", ms=4, label="value")
        axes.set_title(SIGNS.sub(r"$\\lambda_\1^+ \\to 0$", name), fontsize=8)
        axes.set_xlabel("relative distance to the border")
        axes.grid(color="0.9", lw=0.4)
    grid[0].set_ylabel("error")
    grid[0].legend()
    return figure


def long_walk(rows: list[Row]) -> Figure:
    """Distance from the cycle and error of the clock over steps."""
    figure = Figure(figsize=(PAGE / 2.0, 2.6))
    axes = figure.subplots()
    x = numbers(rows, "steps")
    axes.loglog(x, numbers(rows, "distance"), "o-", ms=4, label="distance from the cycle")
    axes.loglog(x, numbers(rows, "clock_error_s"), "s--", ms=4, label="error of the clock [s]")
    axes.set(xlabel="gait steps", ylabel="error")
    axes.grid(color="0.9", lw=0.4)
    axes.legend()
    return figure


def formulations(drift: list[Row], penalty: list[Row]) -> Figure:
    """Constraint drift over steps, and a penalty ground's error over its work."""
    figure = Figure(figsize=(PAGE, 2.9))
    left, right = figure.subplots(1, 2)
    for marker, name in zip("os^", dict.fromkeys(row["stabilised"] for row in drift), strict=True):
        some = [row for row in drift if row["stabilised"] == name]
        gap = numbers(some, "gap_m")
        left.loglog(numbers(some, "steps"), gap, f"{marker}-", ms=4, label=f"stabilised: {name}")
    left.set(xlabel="integrator steps", ylabel="largest gap of a held foot [m]")
    left.legend()
    for marker, name in zip("os", dict.fromkeys(row["ground"] for row in penalty), strict=True):
        some = [row for row in penalty if row["ground"] == name and row["outcome"] == "STEPPED"]
        look = {"ms": 4, "label": f"penalty, {name}"}
        right.loglog(
            numbers(some, "evaluations"), numbers(some, "dtheta_error"), f"{marker}-", **look
        )
    right.set(xlabel="evaluations per gait", ylabel="error of θ̇ before touchdown [rad/s]")
    right.legend()
    for axes in (left, right):
        axes.xaxis.set_minor_formatter(NullFormatter())
        axes.grid(color="0.9", lw=0.4)
    return figure


def automatic(rows: list[Row]) -> str:
    """The fastest method with an error below 1e-4 by axis and value, and the switch's cost."""
    lines = [
        "| axis | value | fastest of ours | µs | fastest of all | µs |",
        "|---|---|---|---|---|---|",
    ]
    for axis in AXES:
        for value in dict.fromkeys(row["value"] for row in rows if row["axis"] == axis):
            some = [r for r in rows if (r["axis"], r["value"]) == (axis, value)]
            some = [r for r in some if r["outcome"] == "STEPPED" and float(r["error"]) < 1e-4]
            cells = [axis, value]
            for ours in (True, False):
                fit = [
                    r for r in some if not ours or r["method"].split()[0] in ("lanes", "diffrax")
                ]
                best = min(fit, key=lambda r: float(r["us_per_gait"]), default=None)
                cells += (
                    ["not measured", "–"] if best is None else [best["method"], best["us_per_gait"]]
                )
            lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def events(rows: list[Row]) -> list[Row]:
    """Counts by kind of case, over all chunks."""
    told = []
    for kind in dict.fromkeys(row["kind"] for row in rows):
        some = [row for row in rows if row["kind"] == kind]
        pairs: dict[str, int] = {}
        for part in filter(None, "; ".join(row["ours/isolated"] for row in some).split("; ")):
            pair, count = part.split(": ")
            pairs[pair] = pairs.get(pair, 0) + int(count)
        counts = ("cases", "stepped", "other_outcome", "late")
        told.append(
            {"kind": kind}
            | {name: str(sum(int(row[name]) for row in some)) for name in counts}
            | {"largest_time_difference": f"{max(numbers(some, 'largest_time_difference')):.2e}"}
            | {"ours/isolated": "; ".join(f"{pair}: {n}" for pair, n in sorted(pairs.items()))}
        )
    return told


def as_table(rows: list[Row]) -> str:
    """All columns."""
    lines = [" | ".join(name.replace("_", " ") for name in rows[0])]
    lines += ["|".join("---" for _ in rows[0]), *(" | ".join(row.values()) for row in rows)]
    return "\n".join(f"| {line} |" for line in lines)


def draw(target: Path, tables: dict[str, Path], limit: Callable[[str], float]) -> None:
    """Every chart whose tables exist."""
    page = target.parent / "stability_atlas.md"
    for name, path in tables.items():
        if path.exists() and name in ("borders", "long_walk"):
            replace(page, name, as_table(read(path)))
    known = {name: read(path) for name, path in tables.items() if path.exists()}
    if "events" in known:
        replace(page, "events", as_table(events(known["events"])))
    with style():
        if "stiffness" in known:
            save(stiffness(known["stiffness"], limit), target, "atlas_stiffness")
            replace(page, "switch", automatic(known["stiffness"]))
        if "borders" in known:
            save(borders(known["borders"]), target, "atlas_borders")
        if "long_walk" in known:
            save(long_walk(known["long_walk"]), target, "atlas_long_walk")
        if {"drift", "formulations"} <= set(known):
            figure = formulations(known["drift"], known["formulations"])
            save(figure, target, "atlas_formulations")
