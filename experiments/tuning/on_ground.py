"""Compare the wheels with the most double support of two models: unilateral contact and the
paper's.

    python -m experiments.tuning.on_ground

The friction is μ = 0.7. Damping, stiffness, natural length and slope vary in one box. With the
paper's model all margins that its gaits can satisfy are constraints. With unilateral contact there
are none. Each optimum is then evaluated with the other model.
"""

import vrw_jax as vrw
from experiments.shared.command import make_parser, parse_and_start_jax
from experiments.shared.tables import (
    FIGURES,
    write_table,
)
from experiments.shared.wheels import WIDE_BOX

FRICTION = 0.7
PAPER_MODEL_BOX = WIDE_BOX  # Above c = 215 the rear foot lifts off at the landing.
BOX = WIDE_BOX | {"damping": (20.0, 400.0)}
DAMPING = 300.0  # of the second start with unilateral contact; the other parameters are Table 1's
TOLERANCE, MAX_EVALUATIONS = 1e-4, 30  # gaits of one call of tune
OPTIONS = {"rtol": 1e-9, "atol": 1e-9}  # of steps
FIELDS = ("scene", *BOX, "ending", "held_by", "dls_fraction", "period", "speed", "slip", "radius")


def measure_with_contact(wheel: vrw.WheelParams, start: object) -> tuple:
    """Return the measures of a gait with unilateral contact near `start`, or the end of a walk."""
    model, options = vrw.UnilateralWheel(friction=FRICTION), vrw.StepOptions(**OPTIONS)
    walk = vrw.walk(wheel, start, 300, model=model, options=options)
    end = walk.steps.section_state[-1]
    cycle = vrw.limit_cycle(wheel, guess=end, model=model, options=options)
    if not bool(cycle.found):
        return (vrw.Outcome(int(cycle.outcome)).name, "", "", "", "", "")
    slip = float(cycle.steps.slip[0])
    radius = float(cycle.spectral_radius)
    return ("", float(cycle.dls_fraction), float(cycle.period), float(cycle.speed), slip, radius)


def measure_with_paper_model(wheel: vrw.WheelParams) -> tuple:
    """Return the measures of the gait of the paper's model."""
    cycle = vrw.limit_cycle(wheel)
    if not bool(cycle.found):
        return (vrw.Outcome(int(cycle.outcome)).name, "", "", "", "", "")
    result = (float(cycle.dls_fraction), float(cycle.period), float(cycle.speed), 0.0)
    return ("", *result, float(cycle.spectral_radius))


def numbers(wheel: vrw.WheelParams) -> list[str]:
    return [f"{float(getattr(wheel, name)):.6g}" for name in BOX]


def main() -> None:
    parse_and_start_jax(make_parser(__doc__))
    model = vrw.UnilateralWheel(friction=FRICTION)
    rows: list[list] = []

    def row(
        scene: str,
        wheel: vrw.WheelParams,
        results: tuple,
        ending: str = "",
        held_values_2: str = "",
    ):
        rows.append([scene, *numbers(wheel), ending or results[0], held_values_2, *results[1:]])
        print(rows[-1], flush=True)

    paper = vrw.tune(vrw.WheelParams(), "dls_fraction", list(BOX), PAPER_MODEL_BOX)
    active_text = "; ".join(f"{a.name} at {a.limit:.4g}" for a in paper.active)
    row(
        "paper's optimum, paper's model",
        paper.params,
        measure_with_paper_model(paper.params),
        paper.status.name,
        active_text,
    )
    row(
        "paper's optimum, unilateral contact",
        paper.params,
        measure_with_contact(paper.params, paper.cycle.section_state),
    )
    tuned_results = []
    starts = {
        "tuned from the paper's optimum": paper.params,
        f"tuned from c = {DAMPING:g}": vrw.WheelParams(damping=DAMPING),
    }
    for scene, start in starts.items():
        tuned = vrw.tune(
            start, "dls_fraction", list(BOX), BOX, model=model, options=vrw.StepOptions(**OPTIONS),
            tolerance=TOLERANCE, max_evaluations=MAX_EVALUATIONS,
        )  # fmt: skip
        active_text = "; ".join(f"{a.name} at {a.limit:.4g}" for a in tuned.active)
        result = measure_with_contact(tuned.params, tuned.cycle.section_state)
        print(tuned, flush=True)
        row(scene, tuned.params, result, tuned.status.name, active_text)
        tuned_results.append(tuned)
    best = max(tuned_results, key=lambda tuned: tuned.value)
    row(
        "optimum with unilateral contact, paper's model",
        best.params,
        measure_with_paper_model(best.params),
    )
    write_table(FIGURES / "tuning_on_ground.csv", FIELDS, rows)


if __name__ == "__main__":
    main()
