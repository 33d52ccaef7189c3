"""What a tolerance leaves of a step's time on real ground, by either kind of stoppers.

    python -m experiments.ground.cut_chart [--wheels 256] [--redraw]

Dips that an impact would leave shallower than a hundredth of the absolute tolerance are not
followed (1e-13 m at least). Wheels over friction and damping walk ten steps; from there one step by
each tolerance is held against the tightest. With stoppers that hold hardly a contact dips, and what
is left is the integration; with those that only push it is more, see
docs/explanation/contact_model.md.
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
    show_table,
    write_table,
)
from vrw_jax import figures as plots

N_FIRST, SEED, SOLVER = 10, 0, "Tsit5"
DAMPING, FRICTION = (150.0, 350.0), (0.5, 1.2)
START = (0.1, 1.6, -0.1)
TOLERANCES = (3e-13, *(10.0**-power for power in range(12, 4, -1)))  # the first is the truth
STOPPERS = {"bilateral": "that hold", "one-sided": "that only push"}
SHARE, MIN_DIP_DEPTH = 1e-2, 1e-13
TABLE = FIGURES / "ground_cut.csv"
HEADER = ("stoppers", "tolerance", "cut_m", "median_s", "p90_s", "largest_s", "tried_per_step")


def compute(wheels: int) -> None:
    random, rows = np.random.default_rng(SEED), []
    damping, friction = random.uniform(*DAMPING, wheels), random.uniform(*FRICTION, wheels)
    for stoppers in STOPPERS:

        def walked(
            states: np.ndarray, n_steps: int, tolerance: float, stoppers: str = stoppers
        ) -> vrw.StepBatchResult:
            return vrw.step_batch(
                vrw.WheelParams(damping=damping),
                states,
                n_steps,
                model=vrw.UnilateralWheel(friction=friction, stoppers=stoppers),
                options=vrw.StepOptions(solver=SOLVER, rtol=tolerance, atol=tolerance),
            )

        start_result = walked(np.tile(START, (wheels, 1)), N_FIRST, 1e-9)
        truth = None
        for tolerance in TOLERANCES:
            solution = walked(np.asarray(start_result.section_state), 1, tolerance)
            retained = (np.asarray(solution.outcome) == 0) & (np.asarray(start_result.outcome) == 0)
            period = np.where(retained, np.asarray(solution.durations).sum(-1), np.nan)
            truth = period if truth is None else truth
            errors = np.nanpercentile(np.abs(period - truth), (50, 90, 100))
            tried = float(np.mean(np.asarray(solution.solver_steps)[retained]))
            row = stoppers, tolerance, max(SHARE * tolerance, MIN_DIP_DEPTH), *errors, tried
            rows.append([row[0], *(f"{x:.3g}" for x in row[1:])])
            print(rows[-1], flush=True)
    write_table(TABLE, HEADER, rows)
    show_table("verification/contact.md", TABLE, "experiments.ground.cut_chart")


def draw() -> None:
    """Errors over the cut, median and largest."""
    figure, axis = plt.subplots(figsize=(0.6 * plots.PAGE_WIDTH_INCHES, 2.8))
    for colour, (stoppers, rows) in zip(
        ("#0072B2", "#D55E00"), group_rows(read_table(TABLE), "stoppers").items(), strict=True
    ):
        cut = read_column(rows, "tolerance")[1:]
        for name, line in (("median_s", "-"), ("p90_s", "--"), ("largest_s", ":")):
            label = f"{STOPPERS[stoppers]}: {name[:-2].replace('p90', '90 %')}"
            axis.loglog(
                cut, read_column(rows, name)[1:], line, color=colour, marker=".", label=label
            )
    axis.set(xlabel="tolerance; a hundredth of it in m is cut", ylabel="error of a step's time [s]")
    axis.legend(fontsize="small")
    plots.save(figure, FIGURES, "ground_cut")


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument("--wheels", type=int, default=256)
    parser.add_argument("--redraw", action="store_true", help="compute nothing")
    chosen = parse_and_start_jax(parser)
    if not chosen.redraw:
        compute(chosen.wheels)
    with plots.figure_style():
        draw()


if __name__ == "__main__":
    main()
