"""Measure rates and compile times of the same functions on a GPU, and compare the numbers with the
CPU.

    python -m experiments.speed.gpu [--lanes 1000000] [--rehearse]

The functions are steps, seven columns of their Jacobians, limit cycles and a scan, in float64 on
JAX's default device. Without a GPU the command prints a sentence and writes nothing. A second
process computes the same lanes on the CPU. A rate is the number of lanes over the wall time of the
second call. Compile time is the additional time of the first call. The command writes a table into
`docs/benchmarks/steps.md`. With `--rehearse` it runs on a CPU and prints the table.
"""

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import jax
import numpy as np

import vrw_jax as vrw
from experiments.shared.command import make_parser, parse_and_start_jax
from experiments.shared.tables import DOCS, describe_run, format_markdown, replace_block
from experiments.shared.wheels import PARAMETER_BOX, draw_parameter_rows, make_wheels

COLUMNS = ("section_state", "damping", "stiffness", "natural_length", "slope")
LARGEST_ERROR = 1e-8
"""Of a lane's numbers between both devices, where the tolerance of a step is 1e-10."""


def _steps(rows: np.ndarray) -> np.ndarray:
    starts = np.broadcast_to(np.asarray(vrw.paper_start()), (len(rows), 3))
    batch_result = vrw.step_batch(make_wheels(rows), starts)
    return np.concatenate(
        [batch_result.section_state, batch_result.durations, batch_result.outcome[:, None]], 1
    )


def _jacobians(rows: np.ndarray) -> np.ndarray:
    starts = np.broadcast_to(np.asarray(vrw.paper_start()), (len(rows), 3))
    batch_result = vrw.step_batch(make_wheels(rows), starts, derivatives=COLUMNS)
    parts = (batch_result.derivatives[name].section_state for name in COLUMNS)
    return np.concatenate([np.asarray(x).reshape(len(rows), -1) for x in parts], 1)


@jax.jit
@jax.vmap
def _cycle(row: jax.Array) -> vrw.LimitCycle:
    return vrw.limit_cycle(make_wheels(row))


def _cycles(rows: np.ndarray) -> np.ndarray:
    result = _cycle(rows)
    solution = np.asarray(result.outcome == 0)[:, None]
    numbers = np.concatenate([result.section_state, result.durations], 1)
    return np.concatenate([np.where(solution, numbers, 0.0), result.outcome[:, None]], 1)


def _scan(rows: np.ndarray) -> np.ndarray:
    names = ("speed", "dls_fraction", "spectral_radius")
    design = vrw.samples(dict(zip(PARAMETER_BOX, rows.T, strict=True)))
    scan_result = vrw.scan(design, names)
    return np.stack([np.nan_to_num(scan_result[name].values) for name in names], 1)


JOBS: dict[str, tuple[Callable[[np.ndarray], np.ndarray], float]] = {
    "steps": (_steps, 1.0),
    "Jacobians by state, c, k, L\\*, φ": (_jacobians, 0.1),
    "limit cycles": (_cycles, 0.1),
    "samples of a scan": (_scan, 0.05),
}
"""What is computed, and for which share of the lanes."""


def measure_job(lanes: int) -> list[tuple[str, np.ndarray, float, float]]:
    """Return job, numbers, lanes per second and seconds of compilation on the default device."""
    result_list = []
    for name, (job, share) in JOBS.items():
        rows = draw_parameter_rows(
            PARAMETER_BOX, max(16, int(share * lanes)), np.random.default_rng(3)
        )
        times = []
        for _ in range(2):
            began = time.perf_counter()
            numbers = job(rows)
            times.append(time.perf_counter() - began)
        result_list.append((name, numbers, len(rows) / times[1], times[0] - times[1]))
    return result_list


def by_cpu(lanes: int) -> list[np.ndarray]:
    """Return the same numbers from a process that uses only the CPU."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "cpu.npz"
        call = [sys.executable, "-m", "experiments.speed.gpu", f"--lanes={lanes}", f"--to={file}"]
        subprocess.run(call, env=os.environ | {"JAX_PLATFORMS": "cpu"}, check=True)
        with np.load(file) as retained:
            return [retained[f"arr_{k}"] for k in range(len(JOBS))]


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument("--lanes", type=int, default=1_000_000)
    parser.add_argument("--rehearse", action="store_true", help="on a CPU, and write nothing")
    parser.add_argument("--to", type=Path, help="only compute, and keep the numbers in this file")
    chosen = parse_and_start_jax(parser)
    if chosen.to is not None:
        np.savez(chosen.to, *[numbers for _, numbers, _, _ in measure_job(chosen.lanes)])
        return
    device = jax.devices()[0]
    if device.platform != "gpu" and not chosen.rehearse:
        print(f"JAX finds no GPU here, only {device.device_kind}: nothing is measured or written.")
        return
    values_here, values_there = measure_job(chosen.lanes), by_cpu(chosen.lanes)
    rows = []
    for (name, numbers, rate, compiling), others in zip(values_here, values_there, strict=True):
        away = np.max(np.abs(numbers - others) / np.maximum(1.0, np.abs(others)), 1)
        separated_values = int(np.sum(away > LARGEST_ERROR))
        agree = f"{np.quantile(away, 0.99):.1e}", f"{separated_values:,} of {len(away):,}"
        rows.append((name, f"{rate:,.0f}", f"{compiling:.0f}", *agree))
    header = "job", "a second", "compiling, s", "p99 difference from the CPU", "lanes beyond 1e-8"
    table = format_markdown(header, rows)
    result = f"{table}\n\n{device.device_kind}, float64, JAX {jax.__version__}."
    if chosen.rehearse:
        print(result)
    else:
        replace_block(
            DOCS / "benchmarks" / "steps.md", "gpu", result, describe_run("experiments.speed.gpu")
        )


if __name__ == "__main__":
    main()
