"""Gait steps per second and core on real ground, lanes side by side: speed over error.

    python -m experiments.ground.benchmark [--jacobians]

Wheels over friction and damping walk on from their tenth step. Time: CPU time of one core of the
second call; the first compiles. Error: of the periods after the walk, against the tightest run,
90th percentile over wheels (those near a border of event sequences part from each other).

With `--jacobians` one step of fewer wheels, with 11 directions: state, c, k, L*, phi and friction.
Errors: 99th percentile over wheels of the largest entry of state and durations, and of how these
move, against Dopri8 at 1e-12. Time: the least of several calls.
"""

import functools
import itertools
import time

import numpy as np

import vrw_jax as vrw
from experiments.shared.command import make_parser
from experiments.shared.tables import (
    FIGURES,
    show_table,
    write_table,
)
from experiments.shared.timing import measure_cpu_seconds, start_without_cache, use_one_core

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

N_DERIVATIVE_WHEELS, REPEATS = 256, 7
DIFFERENTIATED_INPUTS = (
    "section_state",
    "damping",
    "stiffness",
    "natural_length",
    "slope",
    "friction",
)
FACTORS = (1.0, 3.0, 5.0, 10.0, 20.0)
OF_JACOBIANS = (
    "solver",
    "tolerance",
    "tightened_by",
    "steps_per_s_and_core",
    "error_of_values",
    "error_of_derivatives",
)


def draw_wheels(wheels: int) -> tuple[np.ndarray, np.ndarray]:
    """Damping and friction."""
    random = np.random.default_rng(SEED)
    return random.uniform(*DAMPING, wheels), random.uniform(*FRICTION, wheels)


def jacobians() -> None:
    damping, friction = draw_wheels(N_DERIVATIVE_WHEELS)
    params, ground = vrw.WheelParams(damping=damping), vrw.UnilateralWheel(friction=friction)
    tight = vrw.StepOptions(solver=SOLVER, rtol=TOLERANCES[0], atol=TOLERANCES[0])
    batch_result = vrw.step_batch(
        params, np.tile(START, (N_DERIVATIVE_WHEELS, 1)), N_FIRST, model=ground, options=tight
    )
    assert not np.any(batch_result.outcome)

    def step(
        solver: str, tolerance: float, factor: float, requested: tuple[str, ...]
    ) -> vrw.StepBatchResult:
        options = vrw.StepOptions(
            solver=solver, rtol=tolerance, atol=tolerance, derivative_tightening=factor
        )
        given = params, batch_result.section_state
        return vrw.step_batch(*given, model=ground, options=options, derivatives=requested)

    evaluate = lambda by: np.concatenate([by.section_state, by.durations], 1).reshape(
        N_DERIVATIVE_WHEELS, -1
    )
    shift = lambda found: np.concatenate(
        [evaluate(found.derivatives[x]) for x in DIFFERENTIATED_INPUTS], 1
    )
    error = lambda a, b: float(np.percentile(np.abs(a - b).max(1), 99))
    truth = step("Dopri8", 1e-12, 1.0, DIFFERENTIATED_INPUTS)
    rows = []
    for solver, tolerance in itertools.product((SOLVER, "Dopri8"), (1e-6, 1e-8, 1e-10)):
        of_values = error(evaluate(step(solver, tolerance, 1.0, ())), evaluate(truth))
        for factor in FACTORS:
            run = functools.partial(step, solver, tolerance, factor, DIFFERENTIATED_INPUTS)
            away = error(shift(run()), shift(truth))
            speed = N_DERIVATIVE_WHEELS / measure_cpu_seconds(run, REPEATS, reduction=min)
            rows.append(
                [solver, *(f"{x:.3g}" for x in (tolerance, factor, speed, of_values, away))]
            )
            print(rows[-1], flush=True)
    write_table(FIGURES / "ground_jacobians.csv", OF_JACOBIANS, rows)
    command = "experiments.ground.benchmark --jacobians"
    show_table("benchmarks/contact.md", FIGURES / "ground_jacobians.csv", command)


def main() -> None:
    damping, friction = draw_wheels(WHEELS)
    lanes = lambda tolerance, states, n_steps: vrw.step_batch(
        vrw.WheelParams(damping=damping),
        states,
        n_steps,
        model=vrw.UnilateralWheel(friction=friction),
        options=vrw.StepOptions(solver=SOLVER, rtol=tolerance, atol=tolerance),
    )
    began = time.process_time()
    start_result = lanes(TOLERANCES[0], np.tile(START, (WHEELS, 1)), N_FIRST)
    first_call = time.process_time() - began
    retained = np.asarray(start_result.outcome) == 0
    print(f"{np.sum(~retained)} of {WHEELS} wheels lost on the way", flush=True)
    damping, friction = damping[retained], friction[retained]
    states = np.asarray(start_result.section_state)[retained]
    rows, truth = [], None
    for tolerance in TOLERANCES:
        began = time.process_time()
        solution = lanes(tolerance, states, N_STEPS)
        used_values = time.process_time() - began
        periods = np.asarray(solution.durations).sum(-1)
        truth = periods if truth is None else truth
        error = float(np.percentile(np.abs(periods - truth), 90))
        failed, per_step = (
            int(np.sum(np.asarray(solution.outcome) != 0)),
            int(solution.n_stepped.sum()),
        )
        tried = float(solution.solver_steps.sum()) / per_step
        row = [tolerance, per_step / used_values, tried, first_call, error, failed]
        rows.append(row)
        print(row, flush=True)
    write_table(
        FIGURES / "ground_benchmark.csv", HEADER, [[f"{x:.3g}" for x in row] for row in rows]
    )
    show_table(
        "benchmarks/contact.md", FIGURES / "ground_benchmark.csv", "experiments.ground.benchmark"
    )


if __name__ == "__main__":
    parser = make_parser(__doc__)
    parser.add_argument("--jacobians", action="store_true")
    chosen = parser.parse_args()
    with use_one_core():
        start_without_cache()
        (jacobians if chosen.jacobians else main)()
