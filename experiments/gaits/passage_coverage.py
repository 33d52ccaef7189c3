"""Compare stated errors of mean first-passage times with differences from references.

    python -m experiments.gaits.passage_coverage

Damping is 100 to 215 N s/m, stiffness 450 to 540 N/m and slope 0.28 to 0.32 rad in 100 random
wheels. The standard deviation of the slopes is 0.007 to 0.015 rad. A wheel without a gait is
replaced by another one. Each mean number of steps is computed at the default tolerance. The
reference of a short walk is a count of failures. The reference of a long walk is a second sampling
with another seed, more walkers and more biased lines. A mean without a known error needs no
reference. The command writes `passage_coverage.csv` to `docs/figures/` after each wheel, and a
table to `docs/benchmarks/first_passage.md`. It continues an interrupted run. Half an hour on one
core.
"""

from typing import Any

import numpy as np
from scipy import special

import vrw_jax as vrw
from experiments.shared import tables
from experiments.shared.command import make_parser, parse_and_start_jax
from experiments.shared.failure_counts import NORMAL_QUANTILE, count_failures
from vrw_jax.studies.first_passage import PassageStatus
from vrw_jax.studies.sampled_passage import sample_passage
from vrw_jax.studies.walker_groups import WalkerGroups

PAGE = tables.DOCS / "benchmarks" / "first_passage.md"
DATA = tables.FIGURES / "passage_coverage.csv"
N_WHEELS = 100
WHEEL_SEED = 2
"""Seed of the random wheels, chosen because the wheels of seeds 0 and 1 served to develop the
method."""
PARAMETER_RANGES = {"damping": (100.0, 215.0), "stiffness": (450.0, 540.0), "slope": (0.28, 0.32)}
SLOPE_SD_RANGE = (0.007, 0.015)
"""Range of the standard deviation of the slopes, rad."""
REFERENCE_ERROR = 0.006
"""Relative error of the references, chosen because a third of the default tolerance of 0.02
increases the spread of the difference by about 5 %."""
MAX_COUNTED_MEAN = 30.0
"""Largest mean number of steps for which failures are counted. The value is chosen because a count
of `MAX_COUNTED_STEPS` steps then has at most the error `REFERENCE_ERROR`."""
MAX_COUNTED_STEPS = 6_000_000
"""Largest number of counted steps, chosen because a count then takes half a minute."""
MAX_REFERENCE_STEPS = 20_000_000
"""Largest number of steps of the second sampling."""
REFERENCE_GROUND_LINE_EFFECT = 1e-3
"""Negligible effect of a line's slope in the second sampling, chosen so that more lines are biased.
"""
REFERENCE_FORGETTING_STEPS = 12
"""Smallest number of forgotten steps in the second sampling, twice the usual number."""
REFERENCE_STEP_TOLERANCE = 1e-6
"""Relative and absolute tolerance of gait steps in references, chosen because it is a tenth of the
tolerance of `first_passage`."""


def count_reference(
    params: vrw.WheelParams, slope_sd: float, seed: int, radius: float, mean_steps: float
) -> tuple[float, float]:
    """Return a counted mean number of steps and its relative error."""
    n_failures = min((NORMAL_QUANTILE / REFERENCE_ERROR) ** 2, MAX_COUNTED_STEPS / mean_steps)
    n_forgetting_steps = int(np.clip(np.log(1e-3) / np.log(radius), 12, 100))
    count = count_failures(
        params,
        slope_sd,
        int(n_failures),
        seed=seed,
        n_forgetting_steps=n_forgetting_steps,
        step_tolerance=REFERENCE_STEP_TOLERANCE,
    )
    return count.mean_steps, count.relative_error


def sample_reference(
    params: vrw.WheelParams, slope_sd: float, seed: int, gait: vrw.LimitCycle
) -> tuple[float, float]:
    """Return a mean number of steps from a second sampling, and its relative error."""
    walkers = WalkerGroups(
        params,
        np.asarray(gait.section_state),
        slope_sd,
        vrw.ViscoelasticWheel(),
        vrw.StepOptions(rtol=REFERENCE_STEP_TOLERANCE, atol=REFERENCE_STEP_TOLERANCE),
        16384,
        np.random.default_rng(seed),
        negligible_ground_line_effect=REFERENCE_GROUND_LINE_EFFECT,
        min_forgetting_steps=REFERENCE_FORGETTING_STEPS,
    )
    sample = sample_passage(
        walkers,
        float(gait.spectral_radius),
        REFERENCE_ERROR,
        MAX_REFERENCE_STEPS,
    )
    return 1.0 / sample.failure_probability, sample.relative_error


def measure_wheel(
    params: vrw.WheelParams, slope_sd: float, seed: int, gait: vrw.LimitCycle
) -> dict[str, float]:
    """Return the mean number of steps and its reference, with the relative error of each.

    The reference is NaN if the error of the mean is unknown.
    """
    passage = vrw.first_passage(params, slope_sd, seed=seed)
    mean_steps, radius = float(passage.mean_steps), float(gait.spectral_radius)
    is_converged = int(passage.status) == PassageStatus.CONVERGED
    max_counted_mean = MAX_COUNTED_MEAN if is_converged else MAX_COUNTED_STEPS / 100
    is_counted = mean_steps < max_counted_mean
    reference, reference_error = np.nan, np.nan
    if is_counted and np.isfinite(passage.error):
        reference, reference_error = count_reference(
            params, slope_sd, 1000 + seed, radius, mean_steps
        )
    elif np.isfinite(passage.error):
        reference, reference_error = sample_reference(params, slope_sd, 1000 + seed, gait)
    return {
        "spectral_radius": radius,
        "mean_steps": mean_steps,
        "relative_error": float(passage.error) / mean_steps,
        "status": int(passage.status),
        "n_steps": passage.n_steps,
        "reference": reference,
        "reference_error": reference_error,
        "is_counted": int(is_counted),
    }


def summarize(rows: list[tables.Row]) -> list[tuple[str, object]]:
    """Return the lines of the table: how many stated errors cover the difference."""
    columns = {name: tables.read_column(rows, name) for name in rows[0]}
    has_stated_error = columns["status"] != PassageStatus.UNKNOWN_ERROR
    is_known = has_stated_error & np.isfinite(columns["reference_error"])
    known = {name: column[is_known] for name, column in columns.items()}
    difference = np.abs(known["mean_steps"] / known["reference"] - 1.0)
    stated = known["relative_error"]
    expected_fraction = special.erf(
        NORMAL_QUANTILE / np.sqrt(2.0) / np.sqrt(1.0 + (known["reference_error"] / stated) ** 2)
    )
    return [
        ("wheels", len(rows)),
        ("error stated as unknown", int(np.sum(~has_stated_error))),
        (
            "error stated, but that of the reference unknown",
            int(np.sum(has_stated_error & ~is_known)),
        ),
        ("reference is a count", int(np.sum(known["is_counted"]))),
        ("difference within the stated error", int(np.sum(difference <= stated))),
        ("the same, expected if all errors are exact", f"{np.sum(expected_fraction):.0f}"),
        ("largest ratio of difference and stated error", f"{np.max(difference / stated):.2f}"),
        ("median of the mean numbers of steps", f"{np.median(known['mean_steps']):.3g}"),
        ("largest mean number of steps", f"{np.max(known['mean_steps']):.3g}"),
        ("sampled steps per wheel", f"{np.mean(columns['n_steps']):,.0f}"),
    ]


def main() -> None:
    parse_and_start_jax(make_parser(__doc__))
    random = np.random.default_rng(WHEEL_SEED)
    stored_rows = tables.read_table(DATA) if DATA.exists() else []
    row_by_damping: dict[float, dict] = {float(row["damping"]): row for row in stored_rows}
    rows: list[dict] = []
    while len(rows) < N_WHEELS:
        parameters = {name: random.uniform(*ends) for name, ends in PARAMETER_RANGES.items()}
        slope_sd = random.uniform(*SLOPE_SD_RANGE)
        wheel = vrw.WheelParams(**parameters)
        row = row_by_damping.get(parameters["damping"])
        if row is None:
            gait: Any = vrw.limit_cycle(wheel)
            if not gait.found:
                continue
            measured = measure_wheel(wheel, slope_sd, len(rows) + 1, gait)
            row = parameters | {"slope_sd": slope_sd} | measured
            print(row, flush=True)
        rows.append(row)
        tables.write_named_rows(DATA, rows)
    table = tables.format_markdown(["", "value"], summarize(tables.read_table(DATA)))
    source = tables.describe_run("experiments.gaits.passage_coverage")
    tables.replace_block(PAGE, "coverage of errors", table, source)


if __name__ == "__main__":
    main()
