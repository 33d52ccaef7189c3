"""Stoppers that only push change a gait's period by less than a per cent, for ten times the events.

    python -m experiments.ground.one_sided_stoppers

Gaits over friction and damping with stoppers that hold legs in the air whatever it takes, then on
from there with stoppers that only push (outcome 8: lost on the way there). Last, what a step in
lanes costs with either (second call).
"""

import itertools

import numpy as np

import vrw_jax as vrw
from experiments.shared.command import command, started
from experiments.shared.tables import FIGURES, write
from experiments.shared.timing import seconds

DAMPING, FRICTION = (200.0, 300.0), (0.4, 0.5, 0.6, 0.7, 1.0, 1.3, 1.7, 2.0, 3.0)
START = (0.1, 1.6, -0.1)
N_FIRST, N_STEPS = 300, 60
LANES = {"solver": "Tsit5", "rtol": 1e-9, "atol": 1e-9}
TIMED, WHEELS = 5, 1024  # steps and wheels
NAMES = ("period_s", "dls_fraction", "events", "tried", "last_change_s", "outcome")


def main() -> None:
    started(command(__doc__))
    damping, friction = np.array(list(itertools.product(DAMPING, FRICTION))).T
    start = np.tile(START, (len(damping), 1))
    begun = walked(damping, friction, start, N_FIRST, "bilateral")
    told = {}
    for stoppers in ("bilateral", "one-sided"):
        found = walked(damping, friction, begun.section_state, N_STEPS, stoppers)
        wheels = damping, friction, found.section_state, found.durations, found.outcome
        told[stoppers] = [gait(*wheel, stoppers) for wheel in zip(*wheels, strict=True)]
        some = np.resize(np.arange(len(damping)), WHEELS)
        many = damping[some], friction[some], np.asarray(found.section_state)[some]
        speed = WHEELS * TIMED / seconds(lambda m=many, s=stoppers: walked(*m, TIMED, s), 1)
        print(f"{stoppers}: {speed:.0f} steps per second and core", flush=True)
    rows = []
    for c, mu, a, b in zip(damping, friction, *told.values(), strict=True):
        row = [c, mu, *a, *b, 100.0 * (b[0] / a[0] - 1.0)]
        print([f"{value:.4g}" for value in row], flush=True)
        rows.append([f"{value:.6g}" for value in row])
    each = [f"{name}_{stoppers}" for stoppers in told for name in NAMES]
    header = ("damping", "friction", *each, "period_change_percent")
    write(FIGURES / "one_sided_stoppers.csv", header, rows)


def walked(damping, friction, states, n_steps: int, stoppers: str) -> vrw.Steps:
    model = vrw.UnilateralWheel(friction=friction, stoppers=stoppers)
    params = vrw.WheelParams(damping=damping)
    return vrw.steps(params, states, n_steps, model=model, options=vrw.Options(**LANES))


def gait(damping, friction, x, durations, outcome, stoppers: str) -> list[float]:
    """NAMES of one more step; its period less the last one's tells whether the gait repeats."""
    model = vrw.UnilateralWheel(friction=friction, stoppers=stoppers)
    step = vrw.step(vrw.WheelParams(damping=damping), x, model=model)
    change = step.period - durations.sum()
    told = step.period, step.dls_fraction, step.events, step.solver_steps, change
    code = int(outcome) or int(step.outcome)
    return [*(np.nan if code else float(value) for value in told), float(code)]


if __name__ == "__main__":
    main()
