"""Measure the error of a step's time over the tolerance, with both kinds of stoppers.

    python -m experiments.ground.cut_chart [--wheels 256] [--redraw]

The engine does not follow bounces that are shallower than a hundredth of the absolute tolerance, or
1e-13 m. Wheels over friction and damping walk ten steps, and then one step with each tolerance. The
reference is the step with the tightest tolerance. With bilateral stoppers contacts hardly bounce,
and the error is that of the integration. With one-sided stoppers it is larger
(docs/explanation/contact_model.md).
"""

import matplotlib.pyplot as plt
import numpy as np

import vrw_jax as vrw
from experiments.shared.command import make_parser, parse_and_start_jax
from experiments.shared.tables import (
    FIGURES,
    group_rows,
    read_column,
    read_table,
    write_table,
)
from vrw_jax import plot as plots

N_FIRST, SEED, SOLVER = 10, 0, "Tsit5"
DAMPING, FRICTION = (150.0, 350.0), (0.5, 1.2)
START = (0.1, 1.6, -0.1)
TOLERANCES = (3e-13, *(10.0**-power for power in range(12, 4, -1)))  # The first is the reference.
STOPPERS = {"bilateral": "bilateral stoppers", "one-sided": "one-sided stoppers"}
DIP_DEPTH_PER_ATOL, MIN_DIP_DEPTH = 1e-2, 1e-13
TABLE = FIGURES / "ground_cut.csv"
HEADER = ("stoppers", "tolerance", "cut_m", "median_s", "p90_s", "largest_s", "tried_per_step")


def compute(wheels: int) -> None:
    """Measure the errors, and write the table."""
    random, rows = np.random.default_rng(SEED), []
    damping, friction = random.uniform(*DAMPING, wheels), random.uniform(*FRICTION, wheels)
    for stoppers in STOPPERS:

        def walk_batch(
            states: np.ndarray, n_steps: int, tolerance: float, stoppers: str = stoppers
        ) -> vrw.StepBatchResult:
            return vrw.step_batch(
                vrw.WheelParams(damping=damping),
                states,
                n_steps,
                model=vrw.UnilateralWheel(friction=friction, stoppers=stoppers),
                options=vrw.StepOptions(solver=SOLVER, rtol=tolerance, atol=tolerance),
            )

        start_result = walk_batch(np.tile(START, (wheels, 1)), N_FIRST, 1e-9)
        reference = None
        for tolerance in TOLERANCES:
            solution = walk_batch(np.asarray(start_result.section_state), 1, tolerance)
            has_stepped = (np.asarray(solution.outcome) == 0) & (
                np.asarray(start_result.outcome) == 0
            )
            period = np.where(has_stepped, np.asarray(solution.durations).sum(-1), np.nan)
            reference = period if reference is None else reference
            errors = np.nanpercentile(np.abs(period - reference), (50, 90, 100))
            solver_steps = float(np.mean(np.asarray(solution.solver_steps)[has_stepped]))
            row = (
                stoppers,
                tolerance,
                max(DIP_DEPTH_PER_ATOL * tolerance, MIN_DIP_DEPTH),
                *errors,
                solver_steps,
            )
            rows.append([row[0], *(f"{x:.3g}" for x in row[1:])])
            print(rows[-1], flush=True)
    write_table(TABLE, HEADER, rows)


def draw() -> None:
    """Draw median, 90th percentile and largest error over the tolerance."""
    figure, axis = plt.subplots(figsize=(0.6 * plots.PAGE_FIGURE_WIDTH_INCHES, 3.4))
    for color, (stoppers, rows) in zip(
        ("#0072B2", "#D55E00"), group_rows(read_table(TABLE), "stoppers").items(), strict=True
    ):
        tolerances = read_column(rows, "tolerance")[1:]
        for name, line in (("median_s", "-"), ("p90_s", "--"), ("largest_s", ":")):
            label = f"{STOPPERS[stoppers]}: {name[:-2].replace('p90', '90th percentile')}"
            axis.loglog(
                tolerances, read_column(rows, name)[1:], line, color=color, marker=".", label=label
            )
    axis.set(xlabel="tolerance", ylabel="error of the step's duration [s]")
    figure.legend(loc="outside lower center", ncols=2, fontsize="small")
    plots.save(figure, FIGURES, "ground_cut")


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument("--wheels", type=int, default=256)
    parser.add_argument(
        "--redraw", action="store_true", help="draw the stored table without computing"
    )
    arguments = parse_and_start_jax(parser)
    if not arguments.redraw:
        compute(arguments.wheels)
    with plots.figure_style():
        draw()


if __name__ == "__main__":
    main()
