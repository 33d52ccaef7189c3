"""Use this rung when: the lower rungs' errors against real ground, scene by scene, and their cost.

    python experiments/rung_table.py

A scene is a wheel on a ground; the reference is its gait on the unilateral rung, reached by a walk
from the gait of the paper's rung (or the paper's start, where that has none). Costs are CPU times
of one step of one wheel, compiled.
"""

import csv
import math
import statistics
import time
from pathlib import Path

import jax
import jax.numpy as jnp

jax.config.update("jax_enable_x64", True)

import vrw_jax as vrw  # noqa: E402  the number format is chosen first

SCENES = {  # label: friction and what differs from Table 1
    "Table 1, feet can't slide": (math.inf, {}),
    "Table 1, μ = 50": (50.0, {}),
    "Table 1, μ = 20": (20.0, {}),
    "Table 1, μ = 1.3": (1.3, {}),
    "Table 1, μ = 0.7": (0.7, {}),
    "c = 150, feet can't slide": (math.inf, {"damping": 150.0}),
    "c = 50 (scuffs), feet can't slide": (math.inf, {"damping": 50.0}),
    "c = 225 (rear foot lifts off), feet can't slide": (math.inf, {"damping": 225.0}),
    "c = 300, feet can't slide": (math.inf, {"damping": 300.0}),
    "c = 300, μ = 0.7": (0.7, {"damping": 300.0}),
    "c = 400, μ = 0.7": (0.7, {"damping": 400.0}),
}
N_STEPS, N_TIMED = 300, 30
MEASURES = ("period", "dls_fraction", "speed")
OPTIONS = vrw.Options(rtol=1e-9, atol=1e-9)
TARGET = Path(__file__).parents[1] / "docs" / "figures" / "rung_table.csv"


def values(step: object) -> list[float]:
    return [float(getattr(step, name)) for name in MEASURES]


def seconds(params: vrw.WheelParams, x: object, model: object) -> float:
    """Median CPU time of one compiled step."""
    taken = []
    for _ in range(N_TIMED + 1):
        began = time.process_time()
        jax.block_until_ready(vrw.return_map(params, x, model=model, options=OPTIONS))
        taken.append(time.process_time() - began)
    return statistics.median(taken[1:])


def main() -> None:
    rows = []
    for label, (friction, changes) in SCENES.items():
        params = vrw.WheelParams(**{k: jnp.asarray(v) for k, v in changes.items()})
        ground = vrw.UnilateralWheel(friction=friction)
        paper = vrw.limit_cycle(params)
        found = bool(paper.found)
        start = paper.section_state if found else vrw.paper_start()
        walk = vrw.walk(params, start, N_STEPS, model=ground, options=OPTIONS)
        end = walk.steps.section_state[-1]
        step = vrw.step(params, end, model=ground, options=OPTIONS)
        again = float(jnp.sum(walk.steps.durations[-2] - walk.steps.durations[-1]))
        rigid = vrw.limit_cycle(params, model=vrw.RigidWheel())
        outcome = vrw.Outcome(int(walk.outcome))
        truth = values(step) if outcome == vrw.Outcome.STEPPED else [math.nan] * 3
        row = [label, friction, outcome.name, f"{again:.1e}", *(f"{v:.6g}" for v in truth)]
        for cycle in (paper, rigid):
            told = values(cycle) if bool(cycle.found) else [math.nan] * 3
            row += [f"{t - v:.3g}" for t, v in zip(told, truth, strict=True)]
        costs = [
            seconds(params, start if found else vrw.paper_start(), vrw.ViscoelasticWheel()),
            seconds(params, end, ground),
            seconds(params, (math.pi / 8, 1.6, 0.0), vrw.RigidWheel()),
        ]
        rows.append([*row, *(f"{1e3 * c:.3g}" for c in costs)])
        print(rows[-1], flush=True)
    header = ["scene", "friction", "outcome", "period_change_s", *MEASURES]
    header += [f"{rung}_{name}_error" for rung in ("paper", "rigid") for name in MEASURES]
    header += [f"{rung}_ms_per_step" for rung in ("paper", "ground", "rigid")]
    with TARGET.open("w", newline="") as file:
        csv.writer(file).writerows([header, *rows])


if __name__ == "__main__":
    main()
