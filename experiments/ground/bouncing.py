"""Count the gaits of the wheel at dampings (c = 1 ... 4) at which the paper's wheel bounces.

    python -m experiments.ground.bouncing

Wheels from a grid of starts walk with finite friction and by the rule for infinite friction. The
table contains the number of wheels that still walk, and median and spread of their periods and of
their double support. With high friction most starts lead to one gait.
"""

import itertools
import math

import numpy as np

import vrw_jax as vrw
from experiments.shared.command import make_parser, parse_and_start_jax
from experiments.shared.tables import FIGURES, write_table

DAMPING, FRICTION = (1.0, 2.0, 4.0), (5.0, 8.0, 15.0, 100.0, 1e6, math.inf)
STARTS = np.array(
    list(itertools.product((0.0, 0.1, 0.2), np.linspace(0.6, 2.4, 6), (-0.4, -0.1, 0.2)))
)
N_STEPS = 80
OPTIONS = {"solver": "Tsit5", "rtol": 1e-9, "atol": 1e-9}
HEADER = ("damping", "friction", "starts", "left", "period_s", "period_spread_s")


def main() -> None:
    parse_and_start_jax(make_parser(__doc__))
    rows, options = [], vrw.StepOptions(**OPTIONS)
    for damping, friction in itertools.product(DAMPING, FRICTION):
        batch_result = vrw.step_batch(
            vrw.WheelParams(damping=np.full(len(STARTS), damping)),
            STARTS,
            N_STEPS,
            model=vrw.UnilateralWheel(friction=friction, infinite_friction_rule="paper"),
            options=options,
        )
        is_walking = np.asarray(batch_result.outcome) == vrw.Outcome.STEPPED
        durations = np.asarray(batch_result.durations)[is_walking]
        period = durations.sum(-1)
        statistics = [np.nan] * 4
        if is_walking.any():
            dls_fraction = durations[:, 0] / period
            statistics = [
                np.median(period),
                np.ptp(period),
                np.median(dls_fraction),
                np.ptp(dls_fraction),
            ]
        rows.append([damping, friction, len(STARTS), is_walking.sum(), *statistics])
        print([f"{value:.5g}" for value in rows[-1]], flush=True)
    header = (*HEADER, "dls_fraction", "dls_spread")
    write_table(
        FIGURES / "bouncing.csv", header, [[f"{value:.5g}" for value in row] for row in rows]
    )


if __name__ == "__main__":
    main()
