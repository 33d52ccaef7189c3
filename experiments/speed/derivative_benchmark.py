"""Measure the cost of a step's derivatives, in batches and for one wheel.

    python -m experiments.speed.derivative_benchmark [--lanes 2048] [--repeats 9]

Wheels start 1 % off their cycles, as in `engine_benchmark`. One run computes values and Jacobians
of states and durations. Errors are 99th percentiles over lanes of the largest entry. Their
reference is the diffrax engine at `StepOptions.tight()`. Times in batches are the least CPU times
of the repeats on one core. The other times are wall times. The seven columns of state, c, k, L* and
phi are compared with other programs as speed over error. The command writes three tables into
`docs/benchmarks/steps.md`, and a chart.
"""

import os
import time
from collections.abc import Callable, Iterator, Sequence

import jax
import matplotlib.pyplot as plt
import numpy as np

import vrw_jax as vrw
from experiments.shared.command import make_parser, parse_and_start_jax
from experiments.shared.tables import DOCS, FIGURES, describe_run, format_markdown, replace_block
from experiments.shared.timing import describe_processor, measure_cpu_seconds, use_one_core
from experiments.shared.wheels import draw_wheels_near_gaits, make_wheels
from experiments.speed.derivative_peers import HeyokaVariations, numba_differences
from experiments.work_precision.charts import COLOURS
from vrw_jax import plot as plots
from vrw_jax.wheel import PARAMETER_NAMES

COLUMNS = {
    "state": ("section_state",),
    "state, c, k, L\\*, φ": ("section_state", "damping", "stiffness", "natural_length", "slope"),
    "all twelve": ("section_state", *PARAMETER_NAMES),
}
LABELS = (
    "lane engine, machine code",
    "heyoka, variational equations",
    "numba, central differences",
    "diffrax engine, forward mode",
)
COMPARED_ERROR = 1e-8
"""Error at which methods are compared."""
SINGLE_WHEEL_CALLS = {
    "return_map": "jax.jit(vrw.return_map)",
    "Jacobian of return_map, state": "jax.jit(jax.jacfwd(vrw.return_map, 1))",
    "Jacobian of return_map, all twelve inputs": "jax.jit(jax.jacfwd(vrw.return_map, (0, 1)))",
    "step": "jax.jit(vrw.step)",
    "simulate of three steps": "(lambda params, x: vrw.simulate(params, x, 3).time.values)",
}


def flatten_derivatives(by_input: dict, names: Sequence[str]) -> np.ndarray:
    """Return derivatives of section state and durations, shape (lanes, 6, columns)."""
    derivative_arrays = [
        np.concatenate([by_input[name].section_state, by_input[name].durations], 1)
        for name in names
    ]
    return np.concatenate([x.reshape(*x.shape[:2], -1) for x in derivative_arrays], 2)


def in_batches(n: int, repeats: int) -> list[tuple]:
    """Return tolerance, columns, microseconds per lane, and the errors of values and columns."""
    rows, states, reference = draw_wheels_near_gaits(n)
    params, selection, every = make_wheels(rows), slice(min(n, 512)), COLUMNS["all twelve"]
    tight = vrw.StepOptions.tight()
    exact = vrw.step_batch(
        make_wheels(rows[selection]),
        states[selection],
        options=tight,
        engine="diffrax",
        derivatives=every,
    )
    table = []

    def timed(
        options: vrw.StepOptions, requested_2: Sequence[str]
    ) -> tuple[vrw.StepBatchResult, float]:
        run = lambda: vrw.step_batch(params, states, options=options, derivatives=requested_2)
        result = run()
        with use_one_core():
            return result, 1e6 * measure_cpu_seconds(run, repeats, reduction=min) / n

    for tolerance in (1e-6, 1e-8, 1e-10):
        options = vrw.StepOptions(rtol=tolerance, atol=tolerance)
        batch_result, seconds = timed(options, ())
        values = np.concatenate([batch_result.section_state, batch_result.durations], 1)
        error = np.quantile(np.max(np.abs(values - reference), 1), 0.99)
        table.append((f"{tolerance:.0e}", "none", f"{seconds:.2f}", f"{error:.1e}"))
        for name, requested in COLUMNS.items():
            batch_result, seconds = timed(options, requested)
            away = np.abs(
                flatten_derivatives(batch_result.derivatives, requested)[selection]
                - flatten_derivatives(exact.derivatives, requested)
            )
            off = np.quantile(np.max(away, (1, 2)), 0.99)
            table.append((f"{tolerance:.0e}", name, f"{seconds:.2f}", f"{off:.1e}"))
    return table


def candidates(rows: np.ndarray, states: np.ndarray) -> Iterator[tuple[str, str, int, Callable]]:
    """Return method, tolerance, number of lanes, and a function that computes seven columns per
    lane."""
    requested = COLUMNS["state, c, k, L\\*, φ"]

    def by_library(engine: str, tolerance: float, n: int) -> Callable:
        options = vrw.StepOptions(rtol=tolerance, atol=tolerance)
        params, selection = make_wheels(rows[:n]), states[:n]
        evaluate = lambda: vrw.step_batch(
            params, selection, options=options, engine=engine, derivatives=requested
        )
        return lambda: flatten_derivatives(evaluate().derivatives, requested)

    n_wheels = len(rows) // 16
    for tolerance in (1e-5, 1e-6, 1e-7, 1e-8, 1e-9, 1e-10):
        yield LABELS[0], f"{tolerance:.0e}", len(rows), by_library("lanes", tolerance, len(rows))
    for tolerance in (1e-4, 1e-6, 1e-7, 1e-9, 1e-11):
        run = HeyokaVariations(tolerance).make_run(rows[:n_wheels], states[:n_wheels])
        yield LABELS[1], f"{tolerance:.0e}", n_wheels, run
    for tolerance, share in ((1e-8, 1e-4), (1e-10, 1e-5), (1e-12, 1e-6), (1e-13, 1e-6)):
        run = numba_differences(rows[:n_wheels], states[:n_wheels], tolerance, share)
        yield LABELS[2], f"{tolerance:.0e}, moved by {share:.0e}", n_wheels, run
    for tolerance in (1e-6, 1e-8, 3e-9, 1e-10):
        yield LABELS[3], f"{tolerance:.0e}", n_wheels, by_library("diffrax", tolerance, n_wheels)


def compare_with_others(n: int, repeats: int) -> list[dict]:
    """Return the error of each candidate, and its steps with seven columns per second and core."""
    rows, states, _ = draw_wheels_near_gaits(n)
    requested, selection = COLUMNS["state, c, k, L\\*, φ"], slice(n // 16)
    exact = flatten_derivatives(
        vrw.step_batch(
            make_wheels(rows[selection]), states[selection], options=vrw.StepOptions.tight(),
            engine="diffrax",
            derivatives=requested,
        ).derivatives,
        requested,
    )  # fmt: skip
    table, runs = list[dict](), []
    for method, setting, lanes, run in candidates(rows, states):
        error = np.quantile(np.max(np.abs(run()[selection] - exact), (1, 2)), 0.99)
        table.append({"method": method, "at": setting, "error": error, "lanes": lanes, "taken": []})
        runs.append(run)
    with use_one_core():
        for _ in range(
            repeats
        ):  # Candidates take turns, because the clock of a shared machine changes.
            for entry, run in zip(table, runs, strict=True):
                entry["taken"].append(measure_cpu_seconds(run, 1))
    return [x | {"speed": x["lanes"] / np.median(x["taken"])} for x in table]


def draw_chart(table: list[dict]) -> None:
    """Draw speed over error."""
    with plots.figure_style():
        figure, axes = plt.subplots(figsize=(plots.PAGE_FIGURE_WIDTH_INCHES, 3.6))
        method_labels = ("lane engine", "heyoka", "numba", "diffrax engine")
        for label, method_label, marker in zip(LABELS, method_labels, "osD^", strict=True):
            sorted_entries = sorted(
                (x for x in table if x["method"] == label), key=lambda x: x["error"]
            )
            result = [x["error"] for x in sorted_entries], [x["speed"] for x in sorted_entries]
            axes.loglog(*result, marker=marker, ms=4, color=COLOURS[method_label], label=label)
        axes.set(
            xlabel="error of derivatives, 99 % of lanes below it",
            ylabel="gait steps with seven columns\nper second and core",
        )
        figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=2)
        plots.save(figure, FIGURES, "derivatives")


def find_fastest(table: list[dict]) -> list[tuple]:
    """Return the fastest row of each method with an error of at most `COMPARED_ERROR`."""
    best = {}
    for entry in sorted(table, key=lambda x: x["speed"]):
        if entry["error"] <= COMPARED_ERROR:
            best[entry["method"]] = entry
    seconds_without_derivatives = best[LABELS[0]]["speed"]
    return [
        (
            x["method"],
            x["at"],
            f"{x['error']:.1e}",
            f"{x['speed']:,.0f}",
            f"{x['speed'] / seconds_without_derivatives:.2g}",
        )
        for x in (best[label] for label in LABELS if label in best)
    ]


def measure_single_calls() -> list[tuple]:
    """Return each call and its microseconds."""
    params, x, table = vrw.WheelParams(), vrw.paper_start(), []
    for name, call in SINGLE_WHEEL_CALLS.items():
        function = eval(call, {"jax": jax, "vrw": vrw})  # The source of this file.
        jax.block_until_ready(function(params, x))
        times = []
        for _ in range(300):
            began = time.perf_counter()
            jax.block_until_ready(function(params, x))
            times.append(time.perf_counter() - began)
        table.append((name, f"{1e6 * np.median(times):.0f}"))
    return table


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument("--lanes", type=int, default=2048)
    parser.add_argument("--repeats", type=int, default=9)
    chosen = parse_and_start_jax(parser)
    header = ("tolerance", "columns", "µs per element", "p99 error")
    batches = format_markdown(header, in_batches(chosen.lanes, chosen.repeats))
    one = format_markdown(("one wheel", "µs"), measure_single_calls())
    others = compare_with_others(chosen.lanes, chosen.repeats)
    draw_chart(others)
    header = ("method", "tolerance", "p99 error", "steps with 7 columns per second and core",
              "relative speed")  # fmt: skip
    compared = format_markdown(header, find_fastest(others))
    result = (
        f"{describe_processor()}; load average {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores."
    )
    replace_block(
        DOCS / "benchmarks" / "steps.md",
        "derivatives",
        f"{batches}\n\n{one}\n\n{compared}\n\n{result}",
        describe_run("experiments.speed.derivative_benchmark"),
    )


if __name__ == "__main__":
    main()
