"""Compute what wheels do at the dampings at which the paper's section 5.2 ends.

    python -m experiments.paper.corrections

The paper's model walks beyond c = 220. A wheel with unilateral contact walks at high damping, at
low damping, and where the rear foot scuffs. All walks start from gaits of the paper's model. The
command writes `paper_corrections.csv` and fills the block of docs/studies/beyond_the_border.md.
"""

import math

import numpy as np

import vrw_jax as vrw
from experiments.shared.command import make_parser, parse_and_start_jax
from experiments.shared.tables import (
    DOCS,
    FIGURES,
    describe_run,
    format_markdown,
    read_table,
    replace_block,
    write_named_rows,
)

PAGE = DOCS / "studies/beyond_the_border.md"
TABLE = FIGURES / "paper_corrections.csv"

PERIODIC_DAMPINGS = (219.9, 220.0, 220.5, 223.0)
"""Dampings with cycles of several steps, N s/m; the orbit diagram shows all others."""

CONTACT_WHEELS = (
    *((220.0, math.inf), (225.0, math.inf), (250.0, math.inf), (300.0, math.inf)),
    *((50.0, math.inf), (100.0, math.inf)),
    *((1.0, 15.0), (2.0, 15.0), (4.0, 15.0), (4.0, math.inf)),
)
"""Damping, N s/m, and friction coefficient of wheels with unilateral contact. An infinite
coefficient means the paper's rule."""

START_DAMPING_RANGE = (8.0, 219.0)
"""Dampings, N s/m, between which the paper's model has a gait of one step with all indicators
positive; a walk starts at the gait with the nearest damping."""

N_STEPS = 400
MAX_PERIOD = 12
PERIODICITY_TOLERANCE = 1e-6
"""Largest change of the section state over one period, chosen far above the error of a step."""

SHOWN_COLUMNS = ("contact", "c, N s/m", "friction", "period, steps", "double support, %",
                 "rear foot slides, %", "fore foot in the air, %")  # fmt: skip
"""Columns of the table on the page."""

AIR = 0  # index of the contact mode in which a foot is in the air


def find_start(damping: float) -> np.ndarray:
    """Return the section state of the paper's gait with the nearest damping."""
    params = vrw.WheelParams(damping=float(np.clip(damping, *START_DAMPING_RANGE)))
    return np.asarray(vrw.limit_cycle(params).section_state)


def find_period(states: np.ndarray) -> int:
    """Return the least number of steps after which the last state repeats; 0 if there is none."""
    for n_steps in range(1, MAX_PERIOD + 1):
        if np.max(np.abs(states[-1] - states[-1 - n_steps])) < PERIODICITY_TOLERANCE:
            return n_steps
    return 0


def describe_paper_walk(damping: float) -> dict[str, str]:
    """Return the table line of a walk of the paper's model."""
    model = vrw.ViscoelasticWheel(stop_at_lift_off=False)
    params = vrw.WheelParams(damping=damping)
    walk = vrw.walk(params, find_start(damping), N_STEPS, model=model)
    n_steps = find_period(np.asarray(walk.steps.section_state))
    durations = np.asarray(walk.steps.durations)[-max(n_steps, 1) :]
    return make_line(
        "the paper's", damping, None, vrw.Outcome(int(walk.outcome)), n_steps, durations
    )


def describe_contact_walk(damping: float, friction: float) -> dict[str, str]:
    """Return the table line of a walk with unilateral contact."""
    model = vrw.UnilateralWheel(friction=friction, infinite_friction_rule="paper")
    params, start = vrw.WheelParams(damping=damping), find_start(damping)
    states, x = [], start[None]
    for _ in range(N_STEPS // 4):
        steps = vrw.step_batch(vrw.WheelParams(damping=np.array([damping])), x, model=model)
        outcome = vrw.Outcome(int(steps.outcome[0]))
        if outcome != vrw.Outcome.STEPPED:
            return make_line("unilateral", damping, friction, outcome, 0, None)
        last_start, x = x, np.asarray(steps.section_state)
        states.append(x[0])
    n_steps = find_period(np.stack(states))
    step = vrw.step(params, last_start[0], model=model)
    shares = np.asarray(step.mode_durations) / float(step.period)
    line = make_line("unilateral", damping, friction, outcome, n_steps, np.asarray(steps.durations))
    slip = np.sum(shares[:, 2:])
    return line | {"rear foot slides, %": f"{100.0 * slip:.1f}",
                   "fore foot in the air, %": f"{100.0 * np.sum(shares[AIR]):.1f}"}  # fmt: skip


def make_line(
    model: str,
    damping: float,
    friction: float | None,
    outcome: vrw.Outcome,
    n_steps: int,
    durations: np.ndarray | None,
) -> dict[str, str]:
    """Return a table line; `durations` are those of the last period, shape (steps, 3)."""
    line = {"contact": model, "c, N s/m": f"{damping:g}",
            "friction": "–" if friction is None else f"{friction:g}", "last outcome": outcome.name,
            "period, steps": "–", "double support, %": "–", "landings without it": "–",
            "rear foot slides, %": "–", "fore foot in the air, %": "–"}  # fmt: skip
    if n_steps and durations is not None:
        line |= {"period, steps": str(n_steps),
                 "double support, %": f"{100.0 * durations[:, 0].sum() / durations.sum():.1f}",
                 "landings without it": str(int(np.sum(durations[:, 0] == 0.0)))}  # fmt: skip
    return line


def main() -> None:
    parse_and_start_jax(make_parser(__doc__))
    lines = [describe_paper_walk(damping) for damping in PERIODIC_DAMPINGS]
    lines += [describe_contact_walk(*wheel) for wheel in CONTACT_WHEELS]
    write_named_rows(TABLE, lines)
    rows = read_table(TABLE)
    text = format_markdown(SHOWN_COLUMNS, [[row[name] for name in SHOWN_COLUMNS] for row in rows])
    replace_block(PAGE, "corrections", text, describe_run("experiments.paper.corrections"))


if __name__ == "__main__":
    main()
