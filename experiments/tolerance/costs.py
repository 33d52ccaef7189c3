"""Compare the cost of measures to a tolerance with that of unilateral contact alone.

    python -m experiments.tolerance.costs [--wheels 1024] [--repeats 2]

Scans with unilateral contact are timed against scans to a tolerance of 1e-3 of the same wheels, at
friction 15 to 100. Figures are CPU times, the best of each. They are repeated for the wheels whose
gait is near that of the paper's model. Means are taken over wheels around a design and over a box.
Their CPU time is compared with that of a scan with unilateral contact of as many wheels as a mean
of them needs for the same error. All wheels at 1e-6 are the reference of their errors.
"""

import functools
import time
from collections.abc import Callable
from typing import Any

import numpy as np

import vrw_jax as vrw
from experiments.shared.command import make_parser, parse_and_start_jax
from experiments.shared.tables import (
    FIGURES,
    format_markdown,
    write_table,
)
from experiments.shared.wheels import PARAMETER_BOX
from vrw_jax.studies.refinement import MeasureStatus
from vrw_jax.studies.tolerances import N_STANDARD_ERRORS

TOL, FRICTION = 1e-3, (15.0, 100.0)
TABLE = FIGURES / "answers_means.csv"
N_MEAN, N_SCAN = 1000, 128
NARROW_BOX = {"damping": (140.0, 160.0), "stiffness": (480.0, 520.0), "slope": (0.29, 0.31)}
DESIGNS = {"around Table 1": (NARROW_BOX, (2e-3, 2e-4)), "box": (PARAMETER_BOX, (1e-2,))}
"""With tolerances of means."""


def draw_wheels(box: dict[str, tuple[float, float]], n: int) -> dict[str, np.ndarray]:
    random = np.random.default_rng(1)
    return {name: random.uniform(*ends, n) for name, ends in box.items()}


def compare_with_unilateral_model(n: int, repeats: int) -> None:
    """Return costs of all wheels, and of those whose gait is near that of the paper's model."""
    columns = draw_wheels(PARAMETER_BOX, n)
    columns["friction"] = np.exp(np.random.default_rng(2).uniform(*np.log(FRICTION), n))
    design = vrw.samples(columns)
    scan_result = vrw.scan(design, ["speed"], model=vrw.UnilateralWheel(), tol=TOL)
    friction = columns.pop("friction")
    measured = vrw.measure_to_tolerance("speed", vrw.WheelParams(**columns), TOL, friction=friction)
    near = np.isin(
        measured.statuses, (MeasureStatus.CHECKED_BY_ONE_STEP, MeasureStatus.CONTINUES_LOWER_GAIT)
    )
    print(
        f"{n} wheels: {int((scan_result.outcome.values == 0).sum())} with an answer, "
        f"{near.sum()} near"
    )
    selection = {name: x[near] for name, x in (*columns.items(), ("friction", friction))}
    for name, wheels in (("all", design), ("near the paper's gait", vrw.samples(selection))):
        scan = functools.partial(vrw.scan, wheels, ["speed"], model=vrw.UnilateralWheel())
        best = {tol: _cpu(functools.partial(scan, tol=tol), repeats)[0] for tol in (None, TOL)}
        share = best[TOL] / best[None]
        print(f"{name}: {best[TOL]:.3f} s, top rung {best[None]:.3f} s, {share:.3f}", flush=True)


def measure_means() -> None:
    """Return the cost of a mean, and of a scan with unilateral contact for the same error."""
    rows = []
    for name, (box, tolerances) in DESIGNS.items():
        columns = draw_wheels(box, N_MEAN)
        wheels = vrw.WheelParams(**columns)
        for friction in (5.0, 15.0, 50.0):
            every = vrw.measure_to_tolerance(
                ("speed", "dls_fraction"), wheels, 1e-6, friction=friction
            )
            selection = {key: x[:N_SCAN] for key, x in columns.items()}
            design = vrw.samples(selection | {"friction": np.full(N_SCAN, friction)})
            scan = functools.partial(vrw.scan, design, ["speed"], model=vrw.UnilateralWheel())
            one, solution = _cpu(scan, 2)[0] / N_SCAN, np.mean(every.found)
            for i, measure in enumerate(every.names):
                values = every.values[every.found, i]
                for tol in tolerances:
                    take = functools.partial(
                        vrw.multifidelity_mean, measure, wheels, tol, friction=friction
                    )
                    cpu, mean = _cpu(take, 3)
                    many = (N_STANDARD_ERRORS * np.std(values) / mean.error) ** 2 / solution
                    n_reference_wheels = many / (1.0 + many / N_MEAN)
                    rows.append([
                        name, friction, measure, tol, int(mean.n_high_fidelity), mean.control,
                        f"{mean.error:.2g}", f"{mean.value - np.mean(values):.2g}", f"{cpu:.3f}",
                        f"{n_reference_wheels:.0f}", f"{one * 1e3:.2f}",
                        f"{cpu / (n_reference_wheels * one):.3f}",
                    ])  # fmt: skip
                    print(*rows[-1], flush=True)
    header = (
        "design", "friction", "measure", "tol", "asked", "control", "stated", "wrong by",
        "CPU time, s", "wheels alone", "ms each", "ratio",
    )  # fmt: skip
    write_table(TABLE, header, rows)
    print(format_markdown(header, rows))


def _cpu(take: Callable[[], Any], repeats: int) -> tuple[float, Any]:
    """Return the least CPU time of all threads, s, without the first call, and the last result."""
    result, best = take(), np.inf
    for _ in range(repeats):
        began = time.process_time()
        result = take()
        best = min(best, time.process_time() - began)
    return best, result


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument("--wheels", type=int, default=1024)
    parser.add_argument("--repeats", type=int, default=2)
    arguments = parse_and_start_jax(parser)
    compare_with_unilateral_model(arguments.wheels, arguments.repeats)
    measure_means()


if __name__ == "__main__":
    main()
