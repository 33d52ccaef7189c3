"""Compare processor times of first passages and of counts of failures at the same error.

    python -m experiments.gaits.passage_cost

For the wheel of Table 1 and three standard deviations of the slopes, the mean number of steps is
computed by `vrw.first_passage` at several tolerances, and by counts of several numbers of failures.
The command writes processor times and errors to `passage_cost.csv` in `docs/figures/`, and draws
them. It writes a table to `docs/benchmarks/first_passage.md`. It does not run counts of more than
`MAX_COUNTED_STEPS` steps. Dashed lines show the times of counts at the measured rate of steps. Two
minutes on one core.
"""

import time
from collections.abc import Callable
from typing import Any

import numpy as np
from matplotlib.figure import Figure

import vrw_jax as vrw
from experiments.shared import tables
from experiments.shared.command import make_parser, parse_and_start_jax
from experiments.shared.failure_counts import NORMAL_QUANTILE, count_failures
from vrw_jax import plot as plots

PAGE = tables.DOCS / "benchmarks" / "first_passage.md"
SLOPE_SDS = (0.015, 0.007, 0.004)
"""Standard deviations of the slopes, rad."""
TOLERANCES = (0.1, 0.05, 0.02, 0.01)
"""Relative tolerances of first passages."""
DEFAULT_TOLERANCE = 0.02
FAILURE_COUNTS = (100, 400, 1600, 6400, 25600)
"""Numbers of counted failures."""
MAX_COUNTED_STEPS = 3_000_000
"""Largest number of steps of a count, chosen because a count then takes some seconds."""
N_WALKERS = 4096
"""Number of walks side by side in a count."""


def measure_time(compute: Callable[[], Any]) -> tuple[Any, float]:
    """Return a result and its processor time, s."""
    start = time.process_time()
    result = compute()
    return result, time.process_time() - start


def measure_costs(params: vrw.WheelParams) -> list[dict[str, object]]:
    """Return a row for each computation, with its error and its processor time."""
    # These calls compile.
    vrw.first_passage(params, SLOPE_SDS[0])
    vrw.first_passage(params, SLOPE_SDS[1])
    count_failures(params, SLOPE_SDS[0], 1, seed=0, n_walkers=N_WALKERS)
    rows: list[dict[str, object]] = []
    for slope_sd in SLOPE_SDS:
        for tol in TOLERANCES:
            passage, seconds = measure_time(
                lambda slope_sd=slope_sd, tol=tol: vrw.first_passage(params, slope_sd, tol=tol)
            )
            mean_steps = float(passage.mean_steps)
            rows.append(
                {
                    "slope_sd": slope_sd,
                    "method": "first_passage",
                    "mean_steps": mean_steps,
                    "relative_error": float(passage.error) / mean_steps,
                    "n_steps": passage.n_steps,
                    "seconds": seconds,
                }
            )
        for n_failures in FAILURE_COUNTS:
            if n_failures * mean_steps > MAX_COUNTED_STEPS:
                break
            count, seconds = measure_time(
                lambda slope_sd=slope_sd, n_failures=n_failures: count_failures(
                    params, slope_sd, n_failures, seed=1, n_walkers=N_WALKERS
                )
            )
            rows.append(
                {
                    "slope_sd": slope_sd,
                    "method": "count",
                    "mean_steps": count.mean_steps,
                    "relative_error": count.relative_error,
                    "n_steps": count.n_steps,
                    "seconds": seconds,
                }
            )
    return rows


def compute_step_time(rows: list[tables.Row]) -> float:
    """Return the mean processor time of a counted step, s."""
    counts = [row for row in rows if row["method"] == "count"]
    times, numbers_of_steps = (tables.read_column(counts, name) for name in ("seconds", "n_steps"))
    return float(np.sum(times) / np.sum(numbers_of_steps))


def summarize(rows: list[tables.Row]) -> list[tuple[str, ...]]:
    """Return a line for each standard deviation: times of both methods at the default tolerance."""
    lines = []
    for slope_sd, group in tables.group_rows(rows, "slope_sd").items():
        sampled = tables.group_rows(group, "method")["first_passage"]
        passage = sampled[TOLERANCES.index(DEFAULT_TOLERANCE)]
        mean_steps, error = float(passage["mean_steps"]), float(passage["relative_error"])
        n_counted_steps = (NORMAL_QUANTILE / error) ** 2 * mean_steps
        lines.append(
            (
                slope_sd,
                f"{mean_steps:.4g}",
                f"{100.0 * error:.2f} %",
                f"{float(passage['seconds']):.2g}",
                f"{n_counted_steps * compute_step_time(rows):.2g}",
            )
        )
    return lines


@plots.figure_style()
def draw_costs(rows: list[tables.Row]) -> Figure:
    """Return the figure of relative errors over processor times."""
    figure = Figure(figsize=(plots.PAGE_FIGURE_WIDTH_INCHES, 3.2))
    axes = figure.subplots()
    errors = np.array([0.008, 0.3])
    colors = (plots.LEG_1_COLOR, plots.LEG_2_COLOR, "black")
    for (slope_sd, group), color in zip(
        tables.group_rows(rows, "slope_sd").items(), colors, strict=True
    ):
        methods = tables.group_rows(group, "method")
        sampled = methods["first_passage"]
        mean_steps = float(sampled[-1]["mean_steps"])
        axes.plot(
            tables.read_column(sampled, "seconds"),
            tables.read_column(sampled, "relative_error"),
            "o-",
            color=color,
            markersize=3.5,
            label=f"first_passage, σ = {slope_sd} rad: {mean_steps:.2g} steps",
        )
        seconds = (NORMAL_QUANTILE / errors) ** 2 * mean_steps * compute_step_time(rows)
        axes.plot(seconds, errors, "--", color=color, linewidth=0.8)
        if "count" in methods:
            axes.plot(
                tables.read_column(methods["count"], "seconds"),
                tables.read_column(methods["count"], "relative_error"),
                "s",
                color=color,
                markerfacecolor="white",
                markersize=4.0,
                label=f"count of failures, σ = {slope_sd} rad",
            )
    axes.plot(
        [], [], "--", color=plots.DARK_GRAY_COLOR, linewidth=0.8, label="count, from step rate"
    )
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_xlabel("processor time [s]")
    axes.set_ylabel("relative error of mean steps\n(half of a 99 % interval)")
    axes.legend(loc="upper left", bbox_to_anchor=(1.01, 1.0))
    return figure


def main() -> None:
    parse_and_start_jax(make_parser(__doc__))
    path = tables.FIGURES / "passage_cost.csv"
    tables.write_named_rows(path, measure_costs(vrw.WheelParams()))
    rows = tables.read_table(path)
    plots.save(draw_costs(rows), tables.FIGURES, "passage_cost")
    header = ["σ, rad", "mean steps", "error", "`first_passage`, s", "count, s"]
    tables.replace_block(
        PAGE,
        "passage_cost",
        tables.format_markdown(header, summarize(rows)),
        tables.describe_run("experiments.gaits.passage_cost"),
    )


if __name__ == "__main__":
    main()
