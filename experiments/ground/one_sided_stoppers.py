"""Compare gaits with one-sided stoppers and with bilateral stoppers.

    python -m experiments.ground.one_sided_stoppers

Gaits over friction and damping are reached with bilateral stoppers, and then continued with
one-sided stoppers. The periods differ by less than one percent, and the one-sided stoppers have
about ten times the events. The command also measures the cost of a batch step in the second call.
"""

import itertools

import numpy as np

import vrw_jax as vrw
from experiments.shared.command import make_parser, parse_and_start_jax
from experiments.shared.tables import (
    FIGURES,
    write_table,
)
from experiments.shared.timing import measure_cpu_seconds

DAMPING, FRICTION = (200.0, 300.0), (0.4, 0.5, 0.6, 0.7, 1.0, 1.3, 1.7, 2.0, 3.0)
START = (0.1, 1.6, -0.1)
N_FIRST, N_STEPS = 300, 60
SOLVER_OPTIONS = {"solver": "Tsit5", "rtol": 1e-9, "atol": 1e-9}
N_TIMED_STEPS, N_TIMED_WHEELS = 5, 1024
COLUMN_NAMES = ("period_s", "dls_fraction", "events", "tried", "last_change_s", "outcome")


def main() -> None:
    parse_and_start_jax(make_parser(__doc__))
    damping, friction = np.array(list(itertools.product(DAMPING, FRICTION))).T
    start = np.tile(START, (len(damping), 1))
    start_result = walk_batch(damping, friction, start, N_FIRST, "bilateral")
    rows_by_stoppers = {}
    for stoppers in ("bilateral", "one-sided"):
        solution = walk_batch(damping, friction, start_result.section_state, N_STEPS, stoppers)
        wheels = damping, friction, solution.section_state, solution.durations, solution.outcome
        rows_by_stoppers[stoppers] = [
            measure_gait(*wheel, stoppers) for wheel in zip(*wheels, strict=True)
        ]
        selection = np.resize(np.arange(len(damping)), N_TIMED_WHEELS)
        timed_wheels = (
            damping[selection],
            friction[selection],
            np.asarray(solution.section_state)[selection],
        )
        speed = (
            N_TIMED_WHEELS
            * N_TIMED_STEPS
            / measure_cpu_seconds(
                lambda m=timed_wheels, s=stoppers: walk_batch(*m, N_TIMED_STEPS, s), 1
            )
        )
        print(f"{stoppers}: {speed:.0f} steps per second and core", flush=True)
    rows = []
    for c, mu, a, b in zip(damping, friction, *rows_by_stoppers.values(), strict=True):
        row = [c, mu, *a, *b, 100.0 * (b[0] / a[0] - 1.0)]
        print([f"{value:.4g}" for value in row], flush=True)
        rows.append([f"{value:.6g}" for value in row])
    each = [f"{name}_{stoppers}" for stoppers in rows_by_stoppers for name in COLUMN_NAMES]
    header = ("damping", "friction", *each, "period_change_percent")
    write_table(FIGURES / "one_sided_stoppers.csv", header, rows)


def walk_batch(damping, friction, states, n_steps: int, stoppers: str) -> vrw.StepBatchResult:
    """Return the result of a walk of all wheels."""
    model = vrw.UnilateralWheel(friction=friction, stoppers=stoppers)
    params = vrw.WheelParams(damping=damping)
    return vrw.step_batch(
        params, states, n_steps, model=model, options=vrw.StepOptions(**SOLVER_OPTIONS)
    )


def measure_gait(damping, friction, x, durations, outcome, stoppers: str) -> list[float]:
    """Return the `COLUMN_NAMES` of one more step; a small change of the period means that the gait
    repeats."""
    model = vrw.UnilateralWheel(friction=friction, stoppers=stoppers)
    step = vrw.step(vrw.WheelParams(damping=damping), x, model=model)
    change = step.period - durations.sum()
    measures = step.period, step.dls_fraction, step.events, step.solver_steps, change
    code = int(outcome) or int(step.outcome)
    return [*(np.nan if code else float(value) for value in measures), float(code)]


if __name__ == "__main__":
    main()
