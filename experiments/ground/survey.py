"""No wheel on real ground loses its way: how walks end, over a wide box and all tolerances.

    python -m experiments.ground.survey [--wheels 192] [--steps 60]

Wheels drawn over damping, friction and slope, from slow and fast starts, walk with both kinds of
stoppers at each tolerance. Falling back, collapsing, sliding without landing, a third loaded foot
and Painlevé's paradox are physics; a code of the method is a loss.
"""

import math
from collections import Counter

import numpy as np

import vrw_jax as vrw
from experiments.shared.command import make_parser, parse_and_start_jax
from experiments.shared.tables import (
    FIGURES,
    show_table,
    write_named_rows,
)

SEED, SOLVER = 0, "Tsit5"
DAMPING, SLOPE = (20.0, 400.0), (0.1, 0.34)
FRICTIONS = {"0.3-1": (0.3, 1.0), "1-3": (1.0, 3.0), "inf": (math.inf, math.inf)}
START = ((0.05, 0.15), (0.8, 2.2), (-0.3, 0.0))
TOLERANCES = (1e-6, 1e-8, 1e-10, 1e-12)
STOPPERS = ("bilateral", "one-sided")
FAILURE_OUTCOMES = (
    vrw.Outcome.NO_ADMISSIBLE_CONTACT,
    vrw.Outcome.SOLVER_FAILED,
    vrw.Outcome.TOO_MANY_EVENTS,
)


def draw_wheels(
    wheels: int, friction: tuple[float, float]
) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Parameters and friction by name, and starts: the paper's section numbers."""
    draw = np.random.default_rng(SEED).uniform
    box = {"damping": draw(*DAMPING, wheels), "slope": draw(*SLOPE, wheels)}
    states = np.stack([draw(*limits, wheels) for limits in START], 1)
    share = np.linspace(0.0, 1.0, wheels)
    infinite = math.isinf(friction[0])
    box["friction"] = np.full(wheels, math.inf) if infinite else np.interp(share, (0, 1), friction)
    return box, states


def walk_batch(
    box: dict[str, np.ndarray], states: np.ndarray, n_steps: int, stoppers: str, tolerance: float
) -> vrw.StepBatchResult:
    """The last steps of all wheels."""
    wheel = vrw.UnilateralWheel(friction=box["friction"], stoppers=stoppers)
    params = vrw.WheelParams(damping=box["damping"], slope=box["slope"])
    options = vrw.StepOptions(solver=SOLVER, rtol=tolerance, atol=tolerance)
    return vrw.step_batch(params, states, n_steps, model=wheel, options=options)


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument("--wheels", type=int, default=192, help="of each kind of friction")
    parser.add_argument("--steps", type=int, default=60)
    parser.add_argument("--tolerances", type=float, nargs="*", default=TOLERANCES)
    parser.add_argument("--stoppers", nargs="*", default=STOPPERS)
    chosen = parse_and_start_jax(parser)
    rows = []
    for stoppers in chosen.stoppers:
        for tolerance in chosen.tolerances:
            for band, friction in FRICTIONS.items():
                solution = walk_batch(
                    *draw_wheels(chosen.wheels, friction), chosen.steps, stoppers, tolerance
                )
                ends = Counter(np.asarray(solution.outcome).tolist())
                result_by_name = {
                    vrw.Outcome(code).name: count for code, count in sorted(ends.items())
                }
                created = int(np.sum(solution.n_stepped))
                lost_values = sum(ends[code] for code in FAILURE_OUTCOMES)
                row = {
                    "stoppers": stoppers, "tolerance": tolerance, "friction": band,
                    "wheels": chosen.wheels, "steps": created, "lost": lost_values,
                    "lost_per_step": f"{lost_values / max(created, 1):.1e}", **result_by_name,
                }  # fmt: skip
                rows.append(row)
                print(row, flush=True)
    write_named_rows(FIGURES / "ground_survey.csv", rows)
    command = f"experiments.ground.survey --wheels {chosen.wheels}"
    show_table("verification/contact.md", FIGURES / "ground_survey.csv", command)


if __name__ == "__main__":
    main()
