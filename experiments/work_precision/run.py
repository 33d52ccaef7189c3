"""Work against precision for a hybrid system: every engine and its peers, every quantity, honestly.

    python -m experiments.work_precision.run [--at-most N] [--only TEXT] [--again] [--redraw]

Each of METHODS of `methods` computes 256 wheels near their limit cycles (see `reference_values`).
Error: largest over the parts of a quantity, against references of 20 digits; p50, p99 and worst
over lanes; failed lanes are counted. Time: CPU time of one core per gait, median of repeats, scaled
by a reference (numba's step) timed just before and after, because machines are shared. Results are
kept method by method in a table: a run that was stopped goes on. Then charts and tables are drawn
from it.
"""

import argparse
import functools
import time
from pathlib import Path
from typing import Any

import numpy as np
from rich.progress import track

from experiments.shared.command import make_parser, require_extra
from experiments.shared.tables import (
    FIGURES,
    Row,
    describe_run,
    read_table,
    write_named_rows,
)
from experiments.shared.timing import measure_cpu_seconds, start_without_cache, use_one_core
from experiments.shared.wheels import make_wheels
from experiments.work_precision import charts
from experiments.work_precision.methods import (
    BATCHES,
    METHODS,
    NUMBA,
    TORCH,
    Method,
    Run,
    by_peer,
    compute_landing,
)
from experiments.work_precision.reference_values import load

TABLE, BATCH_TABLE = FIGURES / "work_precision.csv", FIGURES / "work_precision_batch.csv"
KEY = ("group", "family", "name", "precision", "setting", "lanes")
SHARES = {"p50": 0.5, "p99": 0.99, "worst": 1.0}
REFERENCE_TOLERANCE = 1e-8
measure_repeated = functools.partial(measure_cpu_seconds, repeats=5, max_seconds=0.5)
MAX_REPEATED_SECONDS = (
    20.0  # s: a first call that compiles nothing and lasts as long is not repeated
)


def errors(
    group: str, result: np.ndarray, references: dict[str, np.ndarray]
) -> dict[str, np.ndarray]:
    """Error of each quantity by lane; NaN where the lane failed."""
    n = len(result)
    largest = lambda x: np.max(np.abs(x), 1)
    if group == "step":
        after = compute_landing(make_wheels(references["rows"][:n]), result[:, :3])
        times = np.cumsum(result[:, 3:6] - references["step"][:n, 3:], 1)
        return {
            "post_impact": largest(after - references["post_impact"][:n]),
            "event_times": largest(times),
        }
    exact = references["cycle"][:n]
    period = exact[:, 2:].sum(1)
    if group == "cycle":
        sorted_ = lambda matrices: -np.sort(-np.abs(np.linalg.eigvals(matrices)), 1)
        good = np.isfinite(result[:, 0])
        solution = np.full((n, 2), np.nan)
        solution[good] = sorted_(result[good, 5:9].reshape(-1, 2, 2))
        missed = result[:, 2:5].sum(1) - period
        fraction = result[:, 2] / result[:, 2:5].sum(1) - exact[:, 2] / period
        return {
            "cycle": largest(np.column_stack([result[:, :2] - exact[:, :2], missed])),
            "dls_fraction": np.abs(fraction),
            "multipliers": largest(solution - sorted_(references["matrix"][:n])),
        }
    d_exact = references["d_cycle"][:n, 2:]
    d_period = d_exact.sum(1)
    d_fraction = (d_exact[:, 0] - (exact[:, 2] / period)[:, None] * d_period) / period[:, None]
    # A change of a parameter counts by its relative size.
    scaled = lambda parts: parts * references["rows"][:n]
    miss, size = [], []
    for part, right in ((result[:, :4], d_fraction), (result[:, 4:8], d_period)):
        miss.append(np.linalg.norm(scaled(part - right), axis=1))
        size.append(np.linalg.norm(scaled(right), axis=1))
    return {"gradient": np.max(np.array(miss) / np.array(size), 0)}


def measure(
    method: Method,
    setting: Any,
    references: dict[str, np.ndarray],
    reference: Run,
    compiling: float,
) -> dict:
    """Return one row of the table; `compiling` is the compile time of numba, s."""
    n = method.lanes
    rows, starts = (
        np.resize(references[name], (n, references[name].shape[1])) for name in ("rows", "start")
    )
    before = measure_repeated(reference)
    begin = time.process_time()
    run = method.make(setting, rows, starts)
    results = run()
    first = time.process_time() - begin
    if method.family == NUMBA:
        first += compiling
    seconds = (
        first
        if method.family in charts.SCALAR and first > MAX_REPEATED_SECONDS
        else measure_repeated(run)
    )
    results = results[: len(references["rows"])]
    unit = 0.5 * (before + measure_repeated(reference)) / len(references["rows"]) * 1e6
    solution = errors(method.group, results, references)
    failed = ~np.isfinite(next(iter(solution.values())))
    with np.errstate(invalid="ignore"):
        evaluations = np.nanmean(results[:, -1]) if not failed.all() else 0.0
    row = key_columns(method, setting) | {
        "failed": int(failed.sum()),
        "evaluations": f"{evaluations:.1f}",
        "first_call_s": f"{first:.3g}",
        "us_per_gait": f"{seconds / n * 1e6:.4g}",
        "reference_us": f"{unit:.4g}",
    }
    for name, values in solution.items():
        selection = values[~failed] if not failed.all() else np.array([np.nan])
        for label, share in SHARES.items():
            row[f"{name}_{label}"] = f"{np.quantile(selection, share):.3g}"
    return row


def read_measured_rows(table: Path) -> list[Row]:
    """Return the rows that were measured in earlier runs."""
    return read_table(table) if table.exists() else []


def key_columns(method: Method, setting: Any) -> dict[str, Any]:
    """Return the columns of KEY."""
    return dict(zip(KEY, (*method[:4], str(setting), method.lanes), strict=True))


def key(row: dict[str, Any]) -> tuple[str, ...]:
    return tuple(str(row[name]) for name in KEY)


def measure_all(chosen: argparse.Namespace) -> None:
    """Fill both tables, method by method."""
    references = load()
    reference = by_peer("numba")(REFERENCE_TOLERANCE, references["rows"], references["start"])
    begin = time.process_time()
    reference()
    compiling = time.process_time() - begin
    tables = {TABLE: read_measured_rows(TABLE), BATCH_TABLE: read_measured_rows(BATCH_TABLE)}
    todo = []
    for table, methods in ((TABLE, METHODS), (BATCH_TABLE, BATCHES)):
        for method in methods:
            label = " ".join(map(str, (*method[:4], method.lanes)))
            if chosen.again and chosen.only in label:
                keys = {key(key_columns(method, s)) for s in method.settings}
                tables[table] = [row for row in tables[table] if key(row) not in keys]
            done = set(map(key, tables[table]))
            settings = [s for s in method.settings if key(key_columns(method, s)) not in done]
            if settings and chosen.only in label:
                todo.append((table, method, settings))
    if any(method.family == TORCH for _, method, _ in todo):
        require_extra("torchdiffeq", "pip install torch torchdiffeq, or leave it out by --only")
    last = None
    for table, method, settings in track(todo[: chosen.at_most], "methods"):
        if method[:4] != last:  # a first call compiles, whatever came before
            start_without_cache()
            last = method[:4]
        for setting in settings:
            row = measure(method, setting, references, reference, compiling)
            tables[table].append(row)
            write_named_rows(table, tables[table])
            print(*row.values(), flush=True)


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument("--at-most", type=int, default=None, help="methods measured in this run")
    parser.add_argument("--only", default="", help="methods whose label holds this text")
    parser.add_argument("--again", action="store_true", help="measure them anew")
    parser.add_argument("--redraw", action="store_true", help="measure nothing")
    chosen = parser.parse_args()
    if not chosen.redraw:
        with use_one_core():
            start_without_cache()
            measure_all(chosen)
    source = None if chosen.redraw else describe_run("experiments.work_precision.run")
    charts.draw(read_measured_rows(TABLE), read_measured_rows(BATCH_TABLE), source)


if __name__ == "__main__":
    main()
