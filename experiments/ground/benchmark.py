"""Measure gait steps per second and core with unilateral contact, and their error.

    python -m experiments.ground.benchmark [--jacobians]

Wheels over friction and damping walk on from their tenth step. The time is the CPU time of one core
in the second call, because the first call compiles. The error is that of the periods after the
walk, 90th percentile over the wheels. The reference is the run with the tightest tolerance. Wheels
near a change of the event sequence separate from each other.

With `--jacobians` fewer wheels take one step with 11 directions: state, c, k, L*, phi and friction.
The errors are 99th percentiles over the wheels of the largest entry of state and durations, and of
their derivatives. The reference is Dopri8 at 1e-12. The time is the least of several calls.
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

N_WHEELS, N_STEPS, N_FIRST, SEED = 2048, 10, 10, 0
DAMPING, FRICTION = (150.0, 350.0), (0.5, 1.2)
START = (0.1, 1.6, -0.1)
SOLVER, TOLERANCES = "Tsit5", (1e-9, 1e-8, 1e-6)  # The first is the reference.
HEADER = (
    "tolerance",
    "steps_per_s_and_core",
    "tried_per_step",
    "first_call_s",
    "error_s",
    "failed",
)

N_DERIVATIVE_WHEELS, N_REPEATS = 256, 7
DIFFERENTIATED_INPUTS = (
    "section_state",
    "damping",
    "stiffness",
    "natural_length",
    "slope",
    "friction",
)
TIGHTENING_FACTORS = (1.0, 3.0, 5.0, 10.0, 20.0)
JACOBIAN_HEADER = (
    "solver",
    "tolerance",
    "tightened_by",
    "steps_per_s_and_core",
    "error_of_values",
    "error_of_derivatives",
)


def draw_wheels(wheels: int) -> tuple[np.ndarray, np.ndarray]:
    """Return random damping, N s/m, and random friction coefficients."""
    random = np.random.default_rng(SEED)
    return random.uniform(*DAMPING, wheels), random.uniform(*FRICTION, wheels)


def measure_jacobians() -> None:
    """Measure speed and errors of steps with derivatives, and write the table."""
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
        inputs = params, batch_result.section_state
        return vrw.step_batch(*inputs, model=ground, options=options, derivatives=requested)

    stack_values = lambda by: np.concatenate([by.section_state, by.durations], 1).reshape(
        N_DERIVATIVE_WHEELS, -1
    )
    stack_derivatives = lambda found: np.concatenate(
        [stack_values(found.derivatives[x]) for x in DIFFERENTIATED_INPUTS], 1
    )
    error = lambda a, b: float(np.percentile(np.abs(a - b).max(1), 99))
    reference = step("Dopri8", 1e-12, 1.0, DIFFERENTIATED_INPUTS)
    rows = []
    for solver, tolerance in itertools.product((SOLVER, "Dopri8"), (1e-6, 1e-8, 1e-10)):
        error_of_values = error(
            stack_values(step(solver, tolerance, 1.0, ())), stack_values(reference)
        )
        for factor in TIGHTENING_FACTORS:
            run = functools.partial(step, solver, tolerance, factor, DIFFERENTIATED_INPUTS)
            error_of_derivatives = error(stack_derivatives(run()), stack_derivatives(reference))
            speed = N_DERIVATIVE_WHEELS / measure_cpu_seconds(run, N_REPEATS, reduction=min)
            rows.append(
                [
                    solver,
                    *(
                        f"{x:.3g}"
                        for x in (tolerance, factor, speed, error_of_values, error_of_derivatives)
                    ),
                ]
            )
            print(rows[-1], flush=True)
    write_table(FIGURES / "ground_jacobians.csv", JACOBIAN_HEADER, rows)


def main() -> None:
    """Measure speed and errors of walks, and write the table."""
    damping, friction = draw_wheels(N_WHEELS)
    walk_batch = lambda tolerance, states, n_steps: vrw.step_batch(
        vrw.WheelParams(damping=damping),
        states,
        n_steps,
        model=vrw.UnilateralWheel(friction=friction),
        options=vrw.StepOptions(solver=SOLVER, rtol=tolerance, atol=tolerance),
    )
    start_time = time.process_time()
    start_result = walk_batch(TOLERANCES[0], np.tile(START, (N_WHEELS, 1)), N_FIRST)
    first_call = time.process_time() - start_time
    has_stepped = np.asarray(start_result.outcome) == 0
    print(f"{np.sum(~has_stepped)} of {N_WHEELS} wheels failed in the first steps", flush=True)
    damping, friction = damping[has_stepped], friction[has_stepped]
    states = np.asarray(start_result.section_state)[has_stepped]
    rows, reference = [], None
    for tolerance in TOLERANCES:
        start_time = time.process_time()
        solution = walk_batch(tolerance, states, N_STEPS)
        seconds = time.process_time() - start_time
        periods = np.asarray(solution.durations).sum(-1)
        reference = periods if reference is None else reference
        error = float(np.percentile(np.abs(periods - reference), 90))
        failed, per_step = (
            int(np.sum(np.asarray(solution.outcome) != 0)),
            int(solution.n_stepped.sum()),
        )
        solver_steps = float(solution.solver_steps.sum()) / per_step
        row = [tolerance, per_step / seconds, solver_steps, first_call, error, failed]
        rows.append(row)
        print(row, flush=True)
    write_table(
        FIGURES / "ground_benchmark.csv", HEADER, [[f"{x:.3g}" for x in row] for row in rows]
    )
    show_table(
        "benchmarks/contact.md", FIGURES / "ground_benchmark.csv", "experiments.ground.benchmark",
        ("tolerance", "steps_per_s_and_core", "tried_per_step", "error_s"),
    )  # fmt: skip


if __name__ == "__main__":
    parser = make_parser(__doc__)
    parser.add_argument("--jacobians", action="store_true")
    chosen = parser.parse_args()
    with use_one_core():
        start_without_cache()
        (measure_jacobians if chosen.jacobians else main)()
