"""Work against precision for a hybrid system: every engine and its peers, every quantity, honestly.

    python -m experiments.work_precision.run [--at-most N] [--only TEXT] [--again] [--redraw]

256 wheels near their own limit cycles (see `truth`) by each of METHODS of `methods`. Error: largest
over the parts of a quantity, against a truth of 20 digits; p50, p99 and worst over lanes; failed
lanes are counted. Time: CPU time of one core per gait, median of repeats, scaled by a reference
(numba's step) timed just before and after, because machines are shared. Results are kept method by
method in a table: a run that was stopped goes on. Then charts and tables are drawn from it.
"""

import argparse
import functools
import time
from pathlib import Path
from typing import Any

import numpy as np
from rich.progress import track

from experiments.shared.command import command, extra
from experiments.shared.tables import FIGURES, Row, read, write_named
from experiments.shared.timing import on_one_core, seconds, start_cold
from experiments.shared.wheels import wheels
from experiments.work_precision import charts
from experiments.work_precision.methods import (
    BATCHES,
    METHODS,
    NUMBA,
    TORCH,
    Method,
    Run,
    by_peer,
    landed,
)
from experiments.work_precision.truth import load

TABLE, BATCH_TABLE = FIGURES / "work_precision.csv", FIGURES / "work_precision_batch.csv"
KEY = ("group", "family", "name", "precision", "setting", "lanes")
SHARES = {"p50": 0.5, "p99": 0.99, "worst": 1.0}
REFERENCE_TOLERANCE = 1e-8
timed = functools.partial(seconds, repeats=5, enough=0.5)
LONG = 20.0  # s: a first call that compiles nothing and lasts as long is not repeated


def errors(group: str, told: np.ndarray, truth: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Error of each quantity by lane; NaN where the lane failed."""
    n = len(told)
    largest = lambda x: np.max(np.abs(x), 1)
    if group == "step":
        after = landed(wheels(truth["rows"][:n]), told[:, :3])
        times = np.cumsum(told[:, 3:6] - truth["step"][:n, 3:], 1)
        return {
            "post_impact": largest(after - truth["post_impact"][:n]),
            "event_times": largest(times),
        }
    exact = truth["cycle"][:n]
    period = exact[:, 2:].sum(1)
    if group == "cycle":
        sorted_ = lambda matrices: -np.sort(-np.abs(np.linalg.eigvals(matrices)), 1)
        good = np.isfinite(told[:, 0])
        found = np.full((n, 2), np.nan)
        found[good] = sorted_(told[good, 5:9].reshape(-1, 2, 2))
        missed = told[:, 2:5].sum(1) - period
        fraction = told[:, 2] / told[:, 2:5].sum(1) - exact[:, 2] / period
        return {
            "cycle": largest(np.column_stack([told[:, :2] - exact[:, :2], missed])),
            "dls_fraction": np.abs(fraction),
            "multipliers": largest(found - sorted_(truth["matrix"][:n])),
        }
    d_exact = truth["d_cycle"][:n, 2:]
    d_period = d_exact.sum(1)
    d_fraction = (d_exact[:, 0] - (exact[:, 2] / period)[:, None] * d_period) / period[:, None]
    # A change of a parameter counts by its relative size.
    scaled = lambda parts: parts * truth["rows"][:n]
    miss, size = [], []
    for part, right in ((told[:, :4], d_fraction), (told[:, 4:8], d_period)):
        miss.append(np.linalg.norm(scaled(part - right), axis=1))
        size.append(np.linalg.norm(scaled(right), axis=1))
    return {"gradient": np.max(np.array(miss) / np.array(size), 0)}


def measure(
    method: Method,
    setting: Any,
    truth: dict[str, np.ndarray],
    reference: Run,
    compiling: float,
) -> dict:
    """One row of the table; `compiling` is what numba took before, s."""
    n = method.lanes
    rows, starts = (np.resize(truth[name], (n, truth[name].shape[1])) for name in ("rows", "start"))
    before = timed(reference)
    begin = time.process_time()
    run = method.make(setting, rows, starts)
    told = run()
    first = time.process_time() - begin
    if method.family == NUMBA:
        first += compiling
    taken = first if method.family in charts.SCALAR and first > LONG else timed(run)
    told = told[: len(truth["rows"])]
    unit = 0.5 * (before + timed(reference)) / len(truth["rows"]) * 1e6
    found = errors(method.group, told, truth)
    failed = ~np.isfinite(next(iter(found.values())))
    with np.errstate(invalid="ignore"):
        evaluations = np.nanmean(told[:, -1]) if not failed.all() else 0.0
    row = named(method, setting) | {
        "failed": int(failed.sum()),
        "evaluations": f"{evaluations:.1f}",
        "first_call_s": f"{first:.3g}",
        "us_per_gait": f"{taken / n * 1e6:.4g}",
        "reference_us": f"{unit:.4g}",
    }
    for name, values in found.items():
        some = values[~failed] if not failed.all() else np.array([np.nan])
        for label, share in SHARES.items():
            row[f"{name}_{label}"] = f"{np.quantile(some, share):.3g}"
    return row


def kept(table: Path) -> list[Row]:
    """Rows measured so far."""
    return read(table) if table.exists() else []


def named(method: Method, setting: Any) -> dict[str, Any]:
    """The columns of KEY."""
    return dict(zip(KEY, (*method[:4], str(setting), method.lanes), strict=True))


def key(row: dict[str, Any]) -> tuple[str, ...]:
    return tuple(str(row[name]) for name in KEY)


def measure_all(chosen: argparse.Namespace) -> None:
    """Fill both tables, method by method."""
    truth = load()
    reference = by_peer("numba")(REFERENCE_TOLERANCE, truth["rows"], truth["start"])
    begin = time.process_time()
    reference()
    compiling = time.process_time() - begin
    tables = {TABLE: kept(TABLE), BATCH_TABLE: kept(BATCH_TABLE)}
    todo = []
    for table, methods in ((TABLE, METHODS), (BATCH_TABLE, BATCHES)):
        for method in methods:
            label = " ".join(map(str, (*method[:4], method.lanes)))
            if chosen.again and chosen.only in label:
                keys = {key(named(method, s)) for s in method.settings}
                tables[table] = [row for row in tables[table] if key(row) not in keys]
            done = set(map(key, tables[table]))
            settings = [s for s in method.settings if key(named(method, s)) not in done]
            if settings and chosen.only in label:
                todo.append((table, method, settings))
    if any(method.family == TORCH for _, method, _ in todo):
        extra("torchdiffeq", "pip install torch torchdiffeq, or leave it out by --only")
    last = None
    for table, method, settings in track(todo[: chosen.at_most], "methods"):
        if method[:4] != last:  # a first call compiles, whatever came before
            start_cold()
            last = method[:4]
        for setting in settings:
            row = measure(method, setting, truth, reference, compiling)
            tables[table].append(row)
            write_named(table, tables[table])
            print(*row.values(), flush=True)


def main() -> None:
    parser = command(__doc__)
    parser.add_argument("--at-most", type=int, default=None, help="methods measured in this run")
    parser.add_argument("--only", default="", help="methods whose label holds this text")
    parser.add_argument("--again", action="store_true", help="measure them anew")
    parser.add_argument("--redraw", action="store_true", help="measure nothing")
    chosen = parser.parse_args()
    if not chosen.redraw:
        with on_one_core():
            start_cold()
            measure_all(chosen)
    charts.draw(kept(TABLE), kept(BATCH_TABLE))


if __name__ == "__main__":
    main()
