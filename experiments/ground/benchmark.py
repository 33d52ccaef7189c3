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
from experiments.shared.command import command
from experiments.shared.tables import FIGURES, write
from experiments.shared.timing import on_one_core, seconds, start_cold

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

FEW, REPEATS = 256, 7
ASKED = ("section_state", "damping", "stiffness", "natural_length", "slope", "friction")
FACTORS = (1.0, 3.0, 5.0, 10.0, 20.0)
OF_JACOBIANS = (
    "solver",
    "tolerance",
    "tightened_by",
    "steps_per_s_and_core",
    "error_of_values",
    "error_of_derivatives",
)


def drawn(wheels: int) -> tuple[np.ndarray, np.ndarray]:
    """Damping and friction."""
    random = np.random.default_rng(SEED)
    return random.uniform(*DAMPING, wheels), random.uniform(*FRICTION, wheels)


def jacobians() -> None:
    damping, friction = drawn(FEW)
    params, ground = vrw.WheelParams(damping=damping), vrw.UnilateralWheel(friction=friction)
    tight = vrw.Options(solver=SOLVER, rtol=TOLERANCES[0], atol=TOLERANCES[0])
    begun = vrw.steps(params, np.tile(START, (FEW, 1)), N_FIRST, model=ground, options=tight)
    assert not np.any(begun.outcome)

    def step(solver: str, tolerance: float, factor: float, asked: tuple[str, ...]) -> vrw.Steps:
        options = vrw.Options(
            solver=solver, rtol=tolerance, atol=tolerance, derivative_tightening=factor
        )
        given = params, begun.section_state
        return vrw.steps(*given, model=ground, options=options, derivatives=asked)

    told = lambda by: np.concatenate([by.section_state, by.durations], 1).reshape(FEW, -1)
    moved = lambda found: np.concatenate([told(found.derivatives[x]) for x in ASKED], 1)
    error = lambda a, b: float(np.percentile(np.abs(a - b).max(1), 99))
    truth = step("Dopri8", 1e-12, 1.0, ASKED)
    rows = []
    for solver, tolerance in itertools.product((SOLVER, "Dopri8"), (1e-6, 1e-8, 1e-10)):
        of_values = error(told(step(solver, tolerance, 1.0, ())), told(truth))
        for factor in FACTORS:
            run = functools.partial(step, solver, tolerance, factor, ASKED)
            away = error(moved(run()), moved(truth))
            speed = FEW / seconds(run, REPEATS, told=min)
            rows.append(
                [solver, *(f"{x:.3g}" for x in (tolerance, factor, speed, of_values, away))]
            )
            print(rows[-1], flush=True)
    write(FIGURES / "ground_jacobians.csv", OF_JACOBIANS, rows)


def main() -> None:
    damping, friction = drawn(WHEELS)
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
    parser = command(__doc__)
    parser.add_argument("--jacobians", action="store_true")
    chosen = parser.parse_args()
    with on_one_core():
        start_cold()
        (jacobians if chosen.jacobians else main)()
