"""Compare gait steps per second and core of the library's engines and other programs, over the
error.

    python -m experiments.speed.engine_benchmark [--lanes 4096] [--repeats 5] [--redraw]

4,096 wheels start 1 % off their limit cycles and take one gait step, with every engine and at
several tolerances, in turns. The error is the 99th percentile over lanes of the largest error of
section state and durations. Its reference is the diffrax engine at `StepOptions.tight()`. The time
is the CPU time of one core, median over turns. Other programs start after the landing and watch
only three events. C++ runs if g++ is installed. The command writes a table (csv, Markdown) and two
charts: speed over error, and cost over the share of lanes that fail.
"""

import os
import platform
import shutil
import time
from importlib.metadata import version
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import vrw_jax as vrw
from experiments.shared.command import make_parser
from experiments.shared.tables import (
    DOCS,
    describe_run,
    format_markdown,
    read_table,
    replace_block,
    write_named_rows,
)
from experiments.shared.timing import describe_processor, start_without_cache, use_one_core
from experiments.shared.wheels import draw_wheels_near_gaits, make_wheels
from experiments.speed import peers
from experiments.work_precision.charts import COLOURS
from vrw_jax import plot as plots
from vrw_jax.models.step_batch import order_wheels_by_work
from vrw_jax.wheel import PARAMETER_NAMES, transitions

LABELS = {
    "lanes": "lane engine, any start",
    "by hand": "C++ by hand, eight lanes side by side",
    "diffrax": "diffrax engine, in batches",
    "numba": "numba, scalar Dormand-Prince 5(4)",
    "heyoka": "heyoka, scalar Taylor",
    "scipy": "SciPy DOP853, compiled right-hand side",
}
KNOWN_AS = ("lane engine", "diffrax by hand", "diffrax engine", "numba", "heyoka", "SciPy")
"""Whose colour each has: those of work_precision/charts."""
COMPARED_ERROR = 1e-8
"""Error at which engines are compared."""


def by_library(engine, solver, tolerance):
    """Return a function that prepares runs of an engine of the library."""
    options = vrw.StepOptions(solver=solver, rtol=tolerance, atol=tolerance)

    def prepare(rows, states):
        params = make_wheels(rows)

        def run():
            batch_result = vrw.step_batch(params, states, options=options, engine=engine)
            return np.concatenate([batch_result.section_state, batch_result.durations], 1)

        return run

    return prepare


def by_peer(function, side_by_side=False):
    """Return a function that prepares runs of another program, which starts after the landing.

    With `side_by_side`, the wheels are sorted so that they wait least for each other; the time of
    the sort does not count.
    """

    def prepare(rows, states):
        params = make_wheels(rows)
        back = slice(None)
        if side_by_side:
            columns = [np.asarray(getattr(params, name)) for name in PARAMETER_NAMES]
            order = order_wheels_by_work(columns, states)
            params, states, back = make_wheels(rows[order]), states[order], np.argsort(order)
        landing = transitions.resolve_landing(params.symbols(), *np.asarray(states).T)
        starts = np.asarray(np.stack([landing.theta_after_landing, landing.motion_after.dtheta], 1))
        packed = peers.pack(params)
        return lambda: function(starts, packed)[back, :6]

    return prepare


def candidates():
    """Return engine, method, tolerance, number of lanes and preparation of each table entry."""
    for solver in ("Tsit5", "Dopri5", "Dopri8"):
        for tolerance in (1e-6, 1e-7, 6e-8, 1.5e-8, 1e-9, 1e-10):
            yield "lanes", solver, tolerance, 1.0, by_library("lanes", solver, tolerance)
    for solver in ("Tsit5", "Dopri8"):
        for tolerance in (6e-8, 1.5e-8, 1e-10):
            yield "diffrax", solver, tolerance, 0.25, by_library("diffrax", solver, tolerance)
    for solver in ("Tsit5", "Dopri8") if shutil.which("g++") else ():
        step = peers.ByHand(solver)
        for tolerance in (1e-6, 1e-7, 6e-8, 1.5e-8, 1e-9, 1e-10):
            yield (
                "by hand", solver, tolerance, 1.0,
                by_peer(lambda s, p, tol=tolerance, step=step: step(s, p, tol), True),
            )  # fmt: skip
    for tolerance in (1e-6, 1e-7, 8e-9, 1e-9, 1e-10):
        yield (
            "numba", "Dopri5", tolerance, 0.25,
            by_peer(lambda s, p, tol=tolerance: peers.numba_steps(s, p, tol)),
        )  # fmt: skip
    for tolerance in (1e-6, 3e-7, 1e-9, 1e-12):
        yield "heyoka", "Taylor", tolerance, 0.25, by_peer(peers.Heyoka(tolerance))
    for tolerance in (1e-6, 1e-8, 5e-10):
        yield (
            "scipy", "DOP853", tolerance, 1 / 128,
            by_peer(lambda s, p, tol=tolerance: peers.scipy_steps(s, p, tol)),
        )  # fmt: skip


def compare(rows, states, reference, repeats):
    """Return the table: engine, method, tolerance, p99 error, steps per second and first call."""
    table, runs = [], []
    for engine, method, tolerance, share, make in candidates():
        n = max(int(share * len(rows)), 16)
        run = make(rows[:n], states[:n])
        begin = time.perf_counter()
        end_states = run()
        first = time.perf_counter() - begin
        error = np.quantile(np.max(np.abs(end_states - reference[:n]), 1), 0.99)
        entry = {"engine": engine, "method": method, "tolerance": tolerance, "p99_error": error}
        table.append(entry | {"lanes": n, "first_call_s": first, "times": []})
        runs.append(run)
        print(f"{engine:8s} {method:7s} {tolerance:.1e}  error {error:.1e}  {first:.1f} s")
    for _ in range(repeats):
        for entry, run in zip(table, runs, strict=True):
            begin = time.process_time()
            run()
            entry["times"].append(time.process_time() - begin)
    for entry in table:
        entry["steps_per_s"] = entry["lanes"] / np.median(entry.pop("times"))
    return table


def at_claimed_error(table):
    """Return the fastest entry of each engine with an error of at most `COMPARED_ERROR`."""
    best = {}
    for entry in sorted(table, key=lambda e: e["steps_per_s"]):
        if entry["p99_error"] <= COMPARED_ERROR:
            best[entry["engine"]] = entry
    return {name: best[name] for name in LABELS if name in best}


def cost_of_failures(rows, states, repeats):
    """Return CPU microseconds per lane over the share of lanes that need the second engine, by
    engine."""
    failing_rows, failing = rows.copy(), states.copy()
    failing_rows[:, 3], failing[:, 1] = (
        0.1,
        0.9,
    )  # These wheels are on a flat slope and slow, and fall back.
    shares, random = np.linspace(0.0, 1.0, 6), np.random.default_rng(2)
    runs = {
        "lanes": (by_library("lanes", "Dopri8", 6e-8), len(rows)),
        "diffrax": (by_library("diffrax", "Dopri8", 6e-8), len(rows) // 4),
    }
    cost = {name: np.zeros((repeats, len(shares))) for name in runs}
    for repeat in range(repeats):
        for k, share in enumerate(shares):
            fails = random.permutation(len(rows)) < share * len(rows)
            selection = np.where(fails[:, None], failing_rows, rows)
            start = np.where(fails[:, None], failing, states)
            for name, (prepare, n) in runs.items():
                run = prepare(selection[:n], start[:n])
                begin = time.process_time()
                run()
                cost[name][repeat, k] = (time.process_time() - begin) / n * 1e6
    return shares, {name: np.median(x, 0) for name, x in cost.items()}


def write(table, shares, cost, out):
    """Write the table, the page and the charts."""
    figures = out / "figures"
    shown_by_name = {"p99_error": ".2e", "steps_per_s": ".0f", "first_call_s": ".1f"}
    rounded = [
        entry | {k: format(entry[k], form) for k, form in shown_by_name.items()} for entry in table
    ]
    write_named_rows(figures / "engine.csv", rounded)
    lines = [
        {"share": f"{share:g}"} | {name: f"{values[k]:.4g}" for name, values in cost.items()}
        for k, share in enumerate(shares)
    ]
    write_named_rows(figures / "engine_failures.csv", lines)
    best = at_claimed_error(table)
    fastest = best["lanes"]["steps_per_s"]
    header = ("engine", "method, tolerance", "p99 error", "gait steps per second and core")
    header = (*header, "relative speed")
    cells = [
        (
            LABELS[name],
            f"{entry['method']}, {entry['tolerance']:.1e}",
            f"{entry['p99_error']:.1e}",
            f"{entry['steps_per_s']:,.0f}",
            f"{entry['steps_per_s'] / fastest:.3g}",
        )
        for name, entry in best.items()
    ]
    packages = ("jax", "jaxlib", "diffrax", "numba", "scipy", "heyoka", "numpy")
    quiet = os.getloadavg()[0] if hasattr(os, "getloadavg") else float("nan")
    versions = ", ".join(f"{name} {version(name)}" for name in packages)
    text = (
        f"{format_markdown(header, cells)}\n\n"
        f"{describe_processor()}; Python {platform.python_version()}, {versions}; load average "
        f"{quiet:.1f} "
        f"on {os.cpu_count()} cores."
    )
    print(text)
    source = describe_run("experiments.speed.engine_benchmark")
    replace_block(out / "benchmarks" / "steps.md", "speeds", text, source)
    draw(table, shares, cost, figures)


def draw(table, shares, cost, figures):
    with plots.figure_style():
        plots.save(draw_charts(table, shares, cost), figures, "engine")


def redraw(figures):
    """Draw the charts from the stored numbers."""
    numbers = ("p99_error", "steps_per_s")
    table = [
        entry | {name: float(entry[name]) for name in numbers}
        for entry in read_table(figures / "engine.csv")
    ]
    lines = read_table(figures / "engine_failures.csv")
    retained_by_name = {name: [float(line[name]) for line in lines] for name in lines[0]}
    shares = np.array(retained_by_name.pop("share"))
    draw(table, shares, retained_by_name, figures)


def draw_charts(table, shares, cost):
    """Draw speed over error of every engine, and cost over the share of lanes that fall back."""
    figure, (left_axes, right) = plt.subplots(1, 2, figsize=(plots.PAGE_FIGURE_WIDTH_INCHES, 3.9))
    markers = dict(zip(("Tsit5", "Dopri5", "Dopri8"), "os^", strict=True))
    colours = {
        name: COLOURS[method_label] for name, method_label in zip(LABELS, KNOWN_AS, strict=True)
    }
    for name, label in LABELS.items():
        for method in dict.fromkeys(e["method"] for e in table if e["engine"] == name):
            selection = [e for e in table if (e["engine"], e["method"]) == (name, method)]
            selection.sort(key=lambda e: e["p99_error"])
            several = name in ("lanes", "by hand", "diffrax")
            left_axes.loglog(
                [e["p99_error"] for e in selection],
                [e["steps_per_s"] for e in selection],
                ms=4,
                marker=markers.get(method, "o") if several else "D",
                linestyle="-" if name == "lanes" else "--",
                color=colours[name],
                label=f"{label}, {method}" if several else label,
            )
    left_axes.axvline(COMPARED_ERROR, color="0.7", lw=1)
    left_axes.set(xlabel="error, 99 % of lanes below it", ylabel="gait steps per second and core")
    figure.legend(*left_axes.get_legend_handles_labels(), loc="outside lower center", ncols=2)
    for name, values in cost.items():
        right.semilogy(100.0 * shares, values, "o-", ms=4, color=colours[name], label=LABELS[name])
    right.set(xlabel="lanes that fall back [%]", ylabel="CPU time per lane [µs]")
    right.set_ylim(bottom=1.0)
    right.legend()
    return figure


def main():
    parser = make_parser(__doc__)
    parser.add_argument("--lanes", type=int, default=4096)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--out", type=Path, default=DOCS)
    parser.add_argument("--redraw", action="store_true", help="the charts alone, measure nothing")
    chosen = parser.parse_args()
    if chosen.redraw:
        redraw(chosen.out / "figures")
        return
    with use_one_core():
        start_without_cache()
        rows, states, reference = draw_wheels_near_gaits(chosen.lanes)
        table = compare(rows, states, reference, chosen.repeats)
        shares, cost = cost_of_failures(rows, states, chosen.repeats)
    write(table, shares, cost, chosen.out)


if __name__ == "__main__":
    main()
