"""Measure time and memory of scans over the number of samples, with two kills of the largest.

    python -m experiments.speed.scan_benchmark [largest]

One process each scans grids of 1,000 samples and of ten times as many, up to the largest
(1,000,000). Signal 9 kills the largest after a third and after two thirds. If the command itself is
interrupted, it continues when it is run again. It writes `scan_benchmark.csv`, `.png` and `.svg`,
and pictures of the largest scan, into `docs/figures`.
"""

import json
import os
import resource
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

import vrw_jax as vrw
from experiments.shared.command import make_parser, parse_and_start_jax
from experiments.shared.tables import (
    FIGURES,
    read_table,
    show_table,
    write_named_rows,
)
from vrw_jax.studies import ScanPlan, ScanProgress, plan_scan, run_scan

ROOT = Path(__file__).parents[2]
STORES = ROOT / "results" / "scan_benchmark"
COUNTS = {  # damping, stiffness, natural length, slope
    1_000: (5, 4, 5, 10),
    10_000: (10, 10, 5, 20),
    100_000: (25, 20, 5, 40),
    1_000_000: (50, 40, 5, 100),
}
MEASURES = ("dls_fraction", "speed", "period", "step_length", "lambda_I4", "lambda_4_plus")
KILLED_AT = (1 / 3, 2 / 3)
ITSELF = (sys.executable, "-m", "experiments.speed.scan_benchmark")
N_CHECKED_CHUNKS = 3
"""Chunks of the largest scan that are computed again and compared bit by bit."""


def make_plan(size: int) -> ScanPlan:
    damping, stiffness, natural_length, slope = COUNTS[size]
    design = vrw.grid(
        damping=np.linspace(100.0, 200.0, damping),
        stiffness=np.linspace(420.0, 500.0, stiffness),
        natural_length=np.linspace(1.015, 1.035, natural_length),
        slope=np.linspace(0.27, 0.305, slope),
    )
    return plan_scan(design, MEASURES)


def log(size: int) -> Path:
    return STORES / f"{size}.jsonl"


def scan(size: int, since: float) -> None:
    """Scan in this process, and log the progress of every chunk."""

    def report(progress: ScanProgress) -> None:
        result_by_name = {
            "session": os.getpid(),
            "kept": progress.n_reused,
            "done": progress.n_done,
            "failed": progress.n_failed,
            "wall": time.time() - since,
            "cpu": time.process_time(),
            "peak": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,  # MiB
        }
        with log(size).open("a") as file:
            file.write(json.dumps(result_by_name) + "\n")

    run_scan(make_plan(size), STORES / f"{size}.zarr", on_progress=report)


def sessions(size: int) -> list[list[dict]]:
    """Return the reports of each process that worked on a scan, in order."""
    if not log(size).exists():
        return []
    result: dict[int, list[dict]] = {}
    for line in log(size).read_text().splitlines():
        entry = json.loads(line)
        result.setdefault(entry["session"], []).append(entry)
    return list(result.values())


def done(size: int) -> int:
    """Return the number of samples in the store, according to the last report."""
    result = sessions(size)
    return result[-1][-1]["kept"] + result[-1][-1]["done"] if result else 0


def supervise(size: int, killed_at: tuple[float, ...]) -> None:
    """Run a scan to its end, with those kills that have not happened yet."""
    due = [share * size for share in killed_at if done(size) < share * size]
    returned = None
    while returned != 0:
        itself = [*ITSELF, str(size), "--since", str(time.time())]
        process = subprocess.Popen(itself, cwd=ROOT)
        while process.poll() is None:
            time.sleep(1.0)
            if due and done(size) >= due[0]:
                due.pop(0)
                os.kill(process.pid, signal.SIGKILL)
                print(f"killed after {done(size):,} of {size:,}", flush=True)
                process.wait()
        returned = process.returncode
        if returned not in (0, -signal.SIGKILL):
            raise SystemExit(returned)


def figures_of(size: int) -> dict[str, object]:
    result = sessions(size)
    last = [reports[-1] for reports in result]
    scanning = sum(reports[-1]["wall"] - reports[0]["wall"] for reports in result)
    return {
        "samples": size,
        "processes": len(result),
        "wall_s": round(sum(entry["wall"] for entry in last), 1),
        "cpu_s": round(sum(entry["cpu"] for entry in last), 1),
        "to_first_chunk_s": round(result[0][0]["wall"], 1),
        "samples_per_s": round(sum(entry["done"] for entry in last) / max(scanning, 1e-9), 0),
        "failed_share": round(sum(entry["failed"] for entry in last) / size, 4),
        "peak_MiB": round(max(entry["peak"] for entry in last)),
    }


def draw(rows: list[Any]) -> None:
    """Draw the figures in a process of its own, because the memory of scanning processes is
    measured."""
    from matplotlib.figure import Figure

    from vrw_jax import plot as plots

    cold, warm = (
        rows[:1],
        rows[1:],
    )  # The first process compiles, and its time is not part of the trend.
    with plots.figure_style():
        figure = Figure(figsize=(plots.PAGE_FIGURE_WIDTH_INCHES, 2.6))
        left_axes, right = figure.subplots(1, 2)
        left_axes.set(xscale="log", yscale="log", xlabel="samples", ylabel="time [s]")
        right.set(xscale="log", xlabel="samples", ylabel="peak memory [MiB]", ylim=(0, 2300))
        series = (
            (left_axes, "wall_s", plots.LEG_1_COLOR, "o", "-", "wall"),
            (left_axes, "cpu_s", plots.LEG_2_COLOR, "s", "--", "CPU, both cores"),
            (right, "peak_MiB", plots.LEG_1_COLOR, "o", "-", "peak"),
        )
        for axes, key, colour, mark, line, label in series:
            selection = [(float(r["samples"]), float(r[key])) for r in warm]
            axes.plot(*zip(*selection, strict=True), mark + line, color=colour, ms=4, label=label)
            first = [(float(r["samples"]), float(r[key])) for r in cold]
            text = f"{label}, with compiling"
            axes.plot(*zip(*first, strict=True), mark, color=colour, mfc="white", ms=4, label=text)
        right.axhline(2048, color=plots.DARK_GRAY_COLOR, linestyle=":", label="2 GiB")
        for axes in (left_axes, right):
            axes.legend(fontsize=7)
    plots.save(figure, FIGURES, "scan_benchmark")


def compare(size: int) -> None:
    """Compute some chunks again, and require the stored bits."""
    of_values = make_plan(size)
    stored, engine = vrw.open_scan(STORES / f"{size}.zarr"), of_values.build_scan_engine()
    assert np.all(stored.outcome.values >= 0), "samples are missing"
    for index in np.linspace(0, of_values.result_layout.n_chunks - 1, N_CHECKED_CHUNKS).astype(int):
        region = of_values.result_layout.compute_chunk_region(int(index))
        for name, values in engine(of_values.design.select_samples(region)).items():
            stored_values = stored[name][region].values
            np.testing.assert_array_equal(values.reshape(stored_values.shape), stored_values, name)
    print(f"{N_CHECKED_CHUNKS} chunks of {size:,} samples computed again: bitwise the stored ones")


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument("largest", type=int, choices=COUNTS, nargs="?", default=max(COUNTS))
    parser.add_argument("--since", type=float, help="that scan alone, in a process begun then")
    parser.add_argument("--redraw", action="store_true", help="scan nothing: draw the table")
    chosen = parse_and_start_jax(parser)
    if chosen.redraw:
        draw(read_table(FIGURES / "scan_benchmark.csv"))
        return
    STORES.mkdir(parents=True, exist_ok=True)
    if chosen.since:
        scan(chosen.largest, chosen.since)
        return
    sizes = [size for size in COUNTS if size <= chosen.largest]
    for size in sizes:
        supervise(size, KILLED_AT if size == max(COUNTS) else ())
        print(figures_of(size), flush=True)
    rows = [figures_of(size) for size in sizes]
    write_named_rows(FIGURES / "scan_benchmark.csv", rows)
    show_table(
        "benchmarks/scans.md", FIGURES / "scan_benchmark.csv", "experiments.speed.scan_benchmark",
        ("samples", "processes", "wall_s", "cpu_s", "samples_per_s", "peak_MiB"),
    )  # fmt: skip
    draw(rows)
    compare(sizes[-1])

    from vrw_jax import plot as plots

    for name, figure in plots.scan_figures(vrw.open_scan(STORES / f"{sizes[-1]}.zarr")).items():
        plots.save(figure, FIGURES, f"{name}_of_{sizes[-1]}")


if __name__ == "__main__":
    main()
