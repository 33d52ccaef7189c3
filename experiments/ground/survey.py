"""Count how walks with unilateral contact end, over wide ranges and all tolerances.

    python -m experiments.ground.survey [--wheels 192] [--steps 60]

Wheels with random damping, friction and slope walk from slow and fast starts, with both kinds of
stoppers and at each tolerance. Falling back, collapsing, sliding without landing, a third loaded
foot and Painlevé's paradox are physical ends. An outcome of `FAILURE_OUTCOMES` is a failure of the
method.
"""

import math
from collections import Counter

import numpy as np

import vrw_jax as vrw
from experiments.shared.command import make_parser, parse_and_start_jax
from experiments.shared.tables import (
    FIGURES,
    write_named_rows,
)

SEED, SOLVER = 0, "Tsit5"
DAMPING, SLOPE = (20.0, 400.0), (0.1, 0.34)
FRICTIONS = {"0.3-1": (0.3, 1.0), "1-3": (1.0, 3.0), "inf": (math.inf, math.inf)}
START_RANGES = ((0.05, 0.15), (0.8, 2.2), (-0.3, 0.0))
TOLERANCES = (1e-6, 1e-8, 1e-10, 1e-12)
STOPPERS = ("bilateral", "one-sided")
FAILURE_OUTCOMES = (
    vrw.Outcome.NO_ADMISSIBLE_CONTACT,
    vrw.Outcome.SOLVER_FAILED,
    vrw.Outcome.TOO_MANY_EVENTS,
)
"""Outcomes that are failures of the method."""


def draw_wheels(
    wheels: int, friction: tuple[float, float]
) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Return parameters and friction by name, and section states in the paper's coordinates."""
    draw = np.random.default_rng(SEED).uniform
    box = {"damping": draw(*DAMPING, wheels), "slope": draw(*SLOPE, wheels)}
    states = np.stack([draw(*limits, wheels) for limits in START_RANGES], 1)
    share = np.linspace(0.0, 1.0, wheels)
    infinite = math.isinf(friction[0])
    box["friction"] = np.full(wheels, math.inf) if infinite else np.interp(share, (0, 1), friction)
    return box, states


def walk_batch(
    box: dict[str, np.ndarray], states: np.ndarray, n_steps: int, stoppers: str, tolerance: float
) -> vrw.StepBatchResult:
    """Return the last steps of all wheels."""
    wheel = vrw.UnilateralWheel(friction=box["friction"], stoppers=stoppers)
    params = vrw.WheelParams(damping=box["damping"], slope=box["slope"])
    options = vrw.StepOptions(solver=SOLVER, rtol=tolerance, atol=tolerance)
    return vrw.step_batch(params, states, n_steps, model=wheel, options=options)


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument(
        "--wheels", type=int, default=192, help="number of wheels per range of friction"
    )
    parser.add_argument("--steps", type=int, default=60)
    parser.add_argument("--tolerances", type=float, nargs="*", default=TOLERANCES)
    parser.add_argument("--stoppers", nargs="*", default=STOPPERS)
    arguments = parse_and_start_jax(parser)
    rows = []
    for stoppers in arguments.stoppers:
        for tolerance in arguments.tolerances:
            for band, friction in FRICTIONS.items():
                walk_result = walk_batch(
                    *draw_wheels(arguments.wheels, friction), arguments.steps, stoppers, tolerance
                )
                ends = Counter(np.asarray(walk_result.outcome).tolist())
                count_by_outcome = {
                    vrw.Outcome(code).name: count for code, count in sorted(ends.items())
                }
                n_stepped = int(np.sum(walk_result.n_stepped))
                n_failed = sum(ends[code] for code in FAILURE_OUTCOMES)
                row = {
                    "stoppers": stoppers, "tolerance": tolerance, "friction": band,
                    "wheels": arguments.wheels, "steps": n_stepped, "lost": n_failed,
                    "lost_per_step": f"{n_failed / max(n_stepped, 1):.1e}", **count_by_outcome,
                }  # fmt: skip
                rows.append(row)
                print(row, flush=True)
    write_named_rows(FIGURES / "ground_survey.csv", rows)


if __name__ == "__main__":
    main()
