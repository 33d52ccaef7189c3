"""Gait steps per second and core on real ground: lanes side by side against the mapped single step.

    python experiments/ground_benchmark.py

Wheels over friction and damping walk on from their tenth step. Time: CPU time of one core of the
second call; the first compiles. Error: of the periods after the walk, against the tightest run,
90th percentile over wheels (those near a border of event sequences part from each other).
"""

import csv
import os
import time
from pathlib import Path

os.environ.setdefault("XLA_FLAGS", "--xla_cpu_multi_thread_eigen=false")
os.environ.setdefault("JAX_PLATFORMS", "cpu")
if hasattr(os, "sched_setaffinity"):
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})

import jax
import jax.numpy as jnp
import numpy as np

jax.config.update("jax_enable_x64", True)

import vrw_jax as vrw  # noqa: E402  the number format is chosen first

WHEELS, MAPPED, N_STEPS, N_FIRST, SEED = 2048, 64, 10, 10, 0  # MAPPED: of them by vmap
DAMPING, FRICTION = (150.0, 350.0), (0.5, 1.2)
START = (0.1, 1.6, -0.1)
SOLVER, TOLERANCES = "Tsit5", (1e-9, 1e-8, 1e-6)  # the first one is the truth
TARGET = Path(__file__).parents[1] / "docs" / "figures" / "ground_benchmark.csv"


@jax.jit
@jax.vmap
def mapped(damping: jax.Array, friction: jax.Array, x: jax.Array) -> tuple:
    """The single wheel's walk under vmap, at the middle tolerance."""
    options = vrw.Options(solver=SOLVER, rtol=TOLERANCES[1], atol=TOLERANCES[1])
    model = vrw.UnilateralWheel(friction=friction)
    walked = vrw.walk(vrw.WheelParams(damping=damping), x, N_STEPS, model=model, options=options)
    return jnp.sum(walked.steps.durations[-1]), walked.n_stepped


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
        row = ["lanes", tolerance, per_step / taken, tried, first_call, error, failed]
        rows.append(row)
        print(row, flush=True)
    some = slice(MAPPED)
    args = jnp.asarray(damping[some]), jnp.asarray(friction[some]), jnp.asarray(states[some])
    taken = []
    for _ in range(2):
        began = time.process_time()
        periods, stepped = jax.block_until_ready(mapped(*args))
        taken.append(time.process_time() - began)
    error = float(np.percentile(np.abs(np.asarray(periods) - truth[some]), 90))
    failed = int(np.sum(np.asarray(stepped) < N_STEPS))
    rate = int(stepped.sum()) / taken[1]
    rows.append(["vmap of return_map", TOLERANCES[1], rate, 0.0, taken[0], error, failed])
    print(rows[-1], flush=True)
    with TARGET.open("w", newline="") as file:
        header = ["engine", "tolerance", "steps_per_s_and_core", "tried_per_step"]
        header += ["first_call_s", "error_s", "failed"]
        writer = csv.writer(file)
        writer.writerow(header)
        for name, *numbers in rows:
            writer.writerow([name, *(f"{x:.3g}" for x in numbers)])


if __name__ == "__main__":
    main()
