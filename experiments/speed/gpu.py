"""Measure rates and compile times of the same functions on a GPU, and compare the numbers with the
CPU.

    python -m experiments.speed.gpu [--lanes 1000000] [--seconds 400] [--rehearse]

The batch functions are steps, seven columns of their Jacobians, limit cycles and a scan. The other
functions are called for one wheel or for a small batch. All computations are in float64 on JAX's
default device. Each function has a process of its own on the GPU, and another on the CPU. The
processes compile at the same time, and take turns for the timed calls. A rate is the number of
lanes over the wall time of the second call. Compile time is the additional time of the first call.
A function that takes more than `--seconds` has no result.

The command writes a table into `docs/benchmarks/steps.md`. Without a GPU it prints a sentence
and writes nothing. With `--rehearse` it runs on a CPU and prints the table.
"""

import argparse
import fcntl
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import vrw_jax as vrw
from experiments.shared.command import make_parser, parse_and_start_jax
from experiments.shared.tables import DOCS, describe_run, format_markdown, replace_block
from experiments.shared.wheels import PARAMETER_BOX, draw_parameter_rows, make_wheels

COLUMNS = ("section_state", "damping", "stiffness", "natural_length", "slope")
LARGEST_ERROR = 1e-8
"""Largest accepted difference of a lane's numbers between both devices. The value is chosen
because the tolerance of a step is 1e-10."""


def _compute_steps(rows: np.ndarray) -> np.ndarray:
    starts = np.broadcast_to(np.asarray(vrw.paper_start()), (len(rows), 3))
    batch_result = vrw.step_batch(make_wheels(rows), starts)
    return np.concatenate(
        [batch_result.section_state, batch_result.durations, batch_result.outcome[:, None]], 1
    )


def _compute_jacobians(rows: np.ndarray) -> np.ndarray:
    starts = np.broadcast_to(np.asarray(vrw.paper_start()), (len(rows), 3))
    batch_result = vrw.step_batch(make_wheels(rows), starts, derivatives=COLUMNS)
    parts = (batch_result.derivatives[name].section_state for name in COLUMNS)
    return np.concatenate([np.asarray(x).reshape(len(rows), -1) for x in parts], 1)


@jax.jit
@jax.vmap
def _find_cycle(row: jax.Array) -> vrw.LimitCycle:
    return vrw.limit_cycle(make_wheels(row))


def _compute_cycles(rows: np.ndarray) -> np.ndarray:
    result = _find_cycle(rows)
    is_found = np.asarray(result.outcome == 0)[:, None]
    numbers = np.concatenate([result.section_state, result.durations], 1)
    return np.concatenate([np.where(is_found, numbers, 0.0), result.outcome[:, None]], 1)


def _scan(rows: np.ndarray) -> np.ndarray:
    names = ("speed", "dls_fraction", "spectral_radius")
    design = vrw.samples(dict(zip(PARAMETER_BOX, rows.T, strict=True)))
    scan_result = vrw.scan(design, names)
    return np.stack([np.nan_to_num(scan_result[name].values) for name in names], 1)


def _compute_one_step(_: np.ndarray) -> np.ndarray:
    result = vrw.step(vrw.WheelParams(), vrw.paper_start())
    return np.concatenate([result.section_state, result.durations])[None]


def _compute_one_gait(_: np.ndarray) -> np.ndarray:
    gait = vrw.limit_cycle(vrw.WheelParams())
    return np.concatenate([gait.section_state, gait.durations])[None]


def _compute_speed(parameters: jax.Array) -> jax.Array:
    damping, stiffness = parameters
    return vrw.limit_cycle(vrw.WheelParams(damping=damping, stiffness=stiffness)).speed


def _compute_gradient(_: np.ndarray) -> np.ndarray:
    return np.asarray(jax.grad(_compute_speed)(jnp.array([200.0, 500.0])))[None]


def _compute_unilateral_steps(rows: np.ndarray) -> np.ndarray:
    model = vrw.UnilateralWheel(friction=2.0)
    params = make_wheels(rows)
    start = np.asarray(model.compute_default_start(vrw.WheelParams()))
    starts = np.tile(start, (len(rows), 1))
    result = vrw.step_batch(params, starts, model=model)
    return np.concatenate(
        [np.nan_to_num(result.section_state), np.asarray(result.outcome)[:, None]], 1
    )


def _compute_sensitivity(_: np.ndarray) -> np.ndarray:
    return np.asarray(vrw.gait_sensitivity(vrw.WheelParams(), ["speed", "dls_fraction"]).norm)[None]


def _follow_branch(_: np.ndarray) -> np.ndarray:
    branch = vrw.continue_branch(vrw.WheelParams(), "damping", (200.0, 215.0))
    return branch.dataset.speed.values[[0, -1]][None]


def _walk_over_uneven_ground(_: np.ndarray) -> np.ndarray:
    slopes = 0.3 + 0.01 * np.sin(np.arange(10.0))
    params = vrw.WheelParams(damping=200.0, slope=slopes)
    return np.asarray(vrw.walk(params, vrw.paper_start(), 10).steps.section_state[-1])[None]


def _compute_passage(_: np.ndarray) -> np.ndarray:
    passage = vrw.first_passage(vrw.WheelParams(), 0.015, n_nodes=100, n_walkers=1024, tol=0.3)
    return np.array([[passage.mean_steps]])


def _compute_basin_share(_: np.ndarray) -> np.ndarray:
    box = {"theta_touchdown": 0.1, "dtheta_touchdown": (0.8, 2.8), "dL1_touchdown": (-0.6, 0.2)}
    return np.array([[vrw.basin_share(vrw.WheelParams(), box, n_starts=256, max_steps=50).share]])


def _measure_to_tolerance(_: np.ndarray) -> np.ndarray:
    result = vrw.measure_to_tolerance("speed", vrw.WheelParams(), 1e-2, friction=50.0)
    return np.array([[float(np.asarray(result.values)[0])]])


def _tune(_: np.ndarray) -> np.ndarray:
    bounds = {"damping": (150.0, 210.0)}
    result = vrw.tune(vrw.WheelParams(damping=180.0), "dls_fraction", ("damping",), bounds)
    return np.array([[float(result.params.damping)]])


def _find_unilateral_gait(_: np.ndarray) -> np.ndarray:
    gait = vrw.limit_cycle(vrw.WheelParams(), model=vrw.UnilateralWheel(friction=2.0))
    return np.array([[float(gait.speed), float(gait.period)]])


def _compute_force_peaks(_: np.ndarray) -> np.ndarray:
    peaks = vrw.limit_cycle(vrw.WheelParams()).force_peaks
    return np.array([[float(peaks["n_force_peaks"]), float(peaks["peak_force"])]])


class GpuJob(NamedTuple):
    """Function that is computed on both devices.

    - `compute`: function from parameter rows, shape (n, 4), to numbers, shape (n or 1, m);
    - `share_of_lanes`: number of rows as a share of `--lanes`; 0 for one wheel.
    """

    compute: Callable[[np.ndarray], np.ndarray]
    share_of_lanes: float


JOBS = {
    "steps": GpuJob(_compute_steps, 1.0),
    "Jacobians of steps by state, c, k, L\\*, φ": GpuJob(_compute_jacobians, 0.1),
    "limit cycles": GpuJob(_compute_cycles, 0.1),
    "samples of a scan": GpuJob(_scan, 0.05),
    "steps with unilateral contact": GpuJob(_compute_unilateral_steps, 0.01),
    "one step": GpuJob(_compute_one_step, 0.0),
    "one limit cycle": GpuJob(_compute_one_gait, 0.0),
    "gradient of one gait's speed": GpuJob(_compute_gradient, 0.0),
    "gait sensitivity of one gait": GpuJob(_compute_sensitivity, 0.0),
    "one branch in damping": GpuJob(_follow_branch, 0.0),
    "one walk of ten steps over uneven ground": GpuJob(_walk_over_uneven_ground, 0.0),
    "one gait with unilateral contact": GpuJob(_find_unilateral_gait, 0.0),
    "force peaks of one gait": GpuJob(_compute_force_peaks, 0.0),
    "speed to a tolerance of 1 %": GpuJob(_measure_to_tolerance, 0.0),
    "tuning of one parameter": GpuJob(_tune, 0.0),
    "basin share from 256 starts": GpuJob(_compute_basin_share, 0.0),
    "mean first-passage time": GpuJob(_compute_passage, 0.0),
}
"""Functions by their names in the table."""


class JobMeasurement(NamedTuple):
    """Numbers and times of one job on one device.

    - `numbers`: results, shape (n, m);
    - `rate`: rows per second of the second call;
    - `compile_seconds`: additional time of the first call.
    """

    numbers: np.ndarray
    rate: float
    compile_seconds: float


def measure_job(job: GpuJob, lanes: int, turn_file: Path) -> JobMeasurement:
    """Return the numbers and times of a job on the default device.

    The second call waits until no other process is in its second call.
    """
    n_rows = max(16, int(job.share_of_lanes * lanes)) if job.share_of_lanes else 1
    rows = draw_parameter_rows(PARAMETER_BOX, n_rows, np.random.default_rng(3))
    start_time = time.perf_counter()
    job.compute(rows)
    first_seconds = time.perf_counter() - start_time
    with turn_file.open("w") as turn:
        fcntl.flock(turn, fcntl.LOCK_EX)
        start_time = time.perf_counter()
        numbers = job.compute(rows)
        second_seconds = time.perf_counter() - start_time
    return JobMeasurement(numbers, n_rows / second_seconds, first_seconds - second_seconds)


def measure_jobs(lanes: int, seconds: float) -> dict[tuple[str, str], JobMeasurement]:
    """Return the measurements by job and device, "here" or "cpu", of the jobs that ended in
    time."""
    results = {}
    with tempfile.TemporaryDirectory() as folder:
        processes = {}
        for index, name in enumerate(JOBS):
            for device, variables in (("here", {}), ("cpu", {"JAX_PLATFORMS": "cpu"})):
                result_file = Path(folder) / f"{index}_{device}.npz"
                call = [sys.executable, "-m", "experiments.speed.gpu", f"--lanes={lanes}"]
                call += [f"--job={name}", f"--to={result_file}", f"--turn={folder}/{device}"]
                environment = os.environ | {"XLA_PYTHON_CLIENT_PREALLOCATE": "false"} | variables
                processes[name, device] = subprocess.Popen(call, env=environment), result_file
        end_time = time.perf_counter() + seconds
        for key, (process, result_file) in processes.items():
            try:
                process.wait(max(0.0, end_time - time.perf_counter()))
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
            if result_file.exists():
                with np.load(result_file) as stored:
                    results[key] = JobMeasurement(
                        stored["numbers"], float(stored["rate"]), float(stored["compile_seconds"])
                    )
    return results


def describe_job(
    name: str, measurements: dict[tuple[str, str], JobMeasurement], seconds: float
) -> tuple[str, ...]:
    """Return the cells of a job's line in the table."""
    here, reference = measurements.get((name, "here")), measurements.get((name, "cpu"))
    if here is None or reference is None:
        return name, f"no result within {seconds:g} s", "", "", ""
    difference = np.abs(here.numbers - reference.numbers)
    difference = np.max(difference / np.maximum(1.0, np.abs(reference.numbers)), 1)
    n_different = int(np.sum(~(difference <= LARGEST_ERROR)))
    return (
        name,
        f"{here.rate:,.0f}" if here.rate > 10.0 else f"{here.rate:.2g}",
        f"{here.compile_seconds:.0f}",
        f"{np.quantile(difference, 0.99):.1e}",
        f"{n_different:,} of {len(difference):,}",
    )


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument("--lanes", type=int, default=1_000_000)
    parser.add_argument("--seconds", type=float, default=400.0, help="most time of a function")
    parser.add_argument("--rehearse", action="store_true", help="on a CPU, and write nothing")
    for name in ("--job", "--to", "--turn"):
        parser.add_argument(name, help=argparse.SUPPRESS)
    arguments = parse_and_start_jax(parser)
    if arguments.job is not None:
        measurement = measure_job(JOBS[arguments.job], arguments.lanes, Path(arguments.turn))
        np.savez(arguments.to, **measurement._asdict())
        return
    check = "import jax; d = jax.devices()[0]; print(d.platform, d.device_kind, sep=':')"
    found = subprocess.run(
        [sys.executable, "-c", check], capture_output=True, text=True, check=True
    )
    platform, device_kind = found.stdout.strip().split(":", 1)
    if platform != "gpu" and not arguments.rehearse:
        print(f"JAX finds no GPU here, only {device_kind}: nothing is measured or written.")
        return
    measurements = measure_jobs(arguments.lanes, arguments.seconds)
    header = "function", "a second", "compiling, s", "p99 difference from the CPU", "beyond 1e-8"
    lines = [describe_job(name, measurements, arguments.seconds) for name in JOBS]
    result = f"{format_markdown(header, lines)}\n\n{device_kind}, float64, JAX {jax.__version__}."
    print(result)
    if not arguments.rehearse:
        replace_block(
            DOCS / "benchmarks" / "steps.md", "gpu", result, describe_run("experiments.speed.gpu")
        )


if __name__ == "__main__":
    main()
