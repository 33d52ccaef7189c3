"""Gait steps per second and core on real ground, lanes side by side: speed over error.

    python experiments/ground_benchmark.py

Wheels over friction and damping walk on from their tenth step. Time: CPU time of one core of the
second call; the first compiles. Error: of the periods after the walk, against the tightest run,
90th percentile over wheels (those near a border of event sequences part from each other).
"""

import csv
import time
from pathlib import Path

import jax
import numpy as np

jax.config.update("jax_enable_x64", True)

import vrw_jax as vrw  # noqa: E402  the number format is chosen first

WHEELS, N_STEPS, N_FIRST, SEED = 2048, 10, 10, 0
DAMPING, FRICTION = (150.0, 350.0), (0.5, 1.2)
START = (0.1, 1.6, -0.1)
SOLVER, TOLERANCES = "Tsit5", (1e-9, 1e-8, 1e-6)  # the first one is the truth
TARGET = Path(__file__).parents[1] / "docs" / "figures" / "ground_benchmark.csv"


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
    with TARGET.open("w", newline="") as file:
        header = ["tolerance", "steps_per_s_and_core", "tried_per_step"]
        header += ["first_call_s", "error_s", "failed"]
        writer = csv.writer(file)
        writer.writerow(header)
        writer.writerows([[f"{x:.3g}" for x in row] for row in rows])


if __name__ == "__main__":
    main()
