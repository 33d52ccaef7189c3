"""Gait steps per second and core on real ground, lanes side by side: speed over error.

    python -m experiments.ground.benchmark

Wheels over friction and damping walk on from their tenth step. Time: CPU time of one core of the
second call; the first compiles. Error: of the periods after the walk, against the tightest run,
90th percentile over wheels (those near a border of event sequences part from each other).
"""

import time

import numpy as np

import vrw_jax as vrw
from experiments.shared.command import command
from experiments.shared.tables import FIGURES, write
from experiments.shared.timing import on_one_core, start_cold

WHEELS, N_STEPS, N_FIRST, SEED = 2048, 10, 10, 0
DAMPING, FRICTION = (150.0, 350.0), (0.5, 1.2)
START = (0.1, 1.6, -0.1)
SOLVER, TOLERANCES = "Tsit5", (1e-9, 1e-8, 1e-6)  # the first one is the truth
HEADER = (
    "tolerance",
    "steps_per_s_and_core",
    "tried_per_step",
    "first_call_s",
    "error_s",
    "failed",
)


def main() -> None:
    random = np.random.default_rng(SEED)
    damping, friction = random.uniform(*DAMPING, WHEELS), random.uniform(*FRICTION, WHEELS)
    lanes = lambda tolerance, states, n_steps: vrw.steps(
        vrw.WheelParams(damping=damping),
        states,
        n_steps,
        model=vrw.UnilateralWheel(friction=friction),
        options=vrw.Options(solver=SOLVER, rtol=tolerance, atol=tolerance),
    )
    began = time.process_time()
    begun = lanes(TOLERANCES[0], np.tile(START, (WHEELS, 1)), N_FIRST)
    first_call = time.process_time() - began
    kept = np.asarray(begun.outcome) == 0
    print(f"{np.sum(~kept)} of {WHEELS} wheels lost on the way", flush=True)
    damping, friction = damping[kept], friction[kept]
    states = np.asarray(begun.section_state)[kept]
    rows, truth = [], None
    for tolerance in TOLERANCES:
        began = time.process_time()
        found = lanes(tolerance, states, N_STEPS)
        taken = time.process_time() - began
        periods = np.asarray(found.durations).sum(-1)
        truth = periods if truth is None else truth
        error = float(np.percentile(np.abs(periods - truth), 90))
        failed, per_step = int(np.sum(np.asarray(found.outcome) != 0)), int(found.n_stepped.sum())
        tried = float(found.solver_steps.sum()) / per_step
        row = [tolerance, per_step / taken, tried, first_call, error, failed]
        rows.append(row)
        print(row, flush=True)
    write(FIGURES / "ground_benchmark.csv", HEADER, [[f"{x:.3g}" for x in row] for row in rows])


if __name__ == "__main__":
    command(__doc__).parse_args()
    with on_one_core():
        start_cold()
        main()
