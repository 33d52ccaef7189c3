"""Measure the errors of the simpler models against unilateral contact, by scene, and their cost.

    python -m experiments.ground.model_table

A scene is a wheel on a ground. The reference is its gait with unilateral contact, reached by a walk
from the gait of the paper's model, or from the paper's start if there is none. Costs are CPU times
of one compiled step, of one wheel by itself and of one among many (`vrw.step_batch`).
"""

import math
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

import vrw_jax as vrw
from experiments.ground.friction_map import FIELDS, SETTLING_OPTIONS, compute_fields
from experiments.shared.command import make_parser, parse_and_start_jax
from experiments.shared.tables import (
    FIGURES,
    show_table,
    write_table,
)
from experiments.shared.timing import measure_cpu_seconds

SCENES = {
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
"""Friction and the parameters that differ from Table 1, by label."""
N_STEPS, N_TIMED, BATCH_SIZE = 300, 30, 2048
MEASURES = ("period", "dls_fraction", "speed")


def read_measures(cycle: object) -> list[float]:
    """Return the `MEASURES` of a gait."""
    return [float(getattr(cycle, name)) for name in MEASURES]


def make_wheel(changes: dict[str, float]) -> vrw.WheelParams:
    """Return the wheel of Table 1 with some parameters replaced."""
    return vrw.WheelParams(**{name: jnp.asarray(value) for name, value in changes.items()})


def measure_errors() -> None:
    """Write the errors of the simpler models in every scene."""
    paper_gaits = [vrw.limit_cycle(make_wheel(changes)) for _, changes in SCENES.values()]
    friction = np.array([mu for mu, _ in SCENES.values()])
    damping = np.array([changes.get("damping", 200.0) for _, changes in SCENES.values()])
    x = [p.section_state if bool(p.found) else vrw.paper_start() for p in paper_gaits]
    params = vrw.WheelParams(damping=damping)
    model = vrw.UnilateralWheel(friction=friction, infinite_friction_rule="paper")
    batch_result = vrw.step_batch(
        params, np.array(x), N_STEPS - 1, model=model, options=vrw.StepOptions(**SETTLING_OPTIONS)
    )
    last = vrw.step_batch(
        params, batch_result.section_state, model=model, options=vrw.StepOptions(**SETTLING_OPTIONS)
    )
    fields = dict(
        zip(FIELDS, compute_fields(friction, damping, batch_result.section_state).T, strict=True)
    )
    rows = []
    for i, (label, (mu, changes)) in enumerate(SCENES.items()):
        period_change = float(jnp.sum(last.durations[i] - batch_result.durations[i]))
        outcome = vrw.Outcome(int(last.outcome[i]))
        has_stepped = outcome == vrw.Outcome.STEPPED
        reference = [float(fields[name][i]) if has_stepped else math.nan for name in MEASURES]
        row = [label, mu, outcome.name, f"{period_change:.1e}", *(f"{v:.6g}" for v in reference)]
        for cycle in (paper_gaits[i], vrw.limit_cycle(make_wheel(changes), model=vrw.RigidWheel())):
            gait_measures = read_measures(cycle) if bool(cycle.found) else [math.nan] * 3
            row += [f"{t - v:.3g}" for t, v in zip(gait_measures, reference, strict=True)]
        rows.append(row)
        print(row, flush=True)
    header = ["scene", "friction", "outcome", "period_change_s", *MEASURES]
    header += [f"{rung}_{name}_error" for rung in ("paper", "rigid") for name in MEASURES]
    write_table(FIGURES / "rung_table.csv", header, rows)
    shown = "scene", "period", "paper_period_error", "dls_fraction", "paper_dls_fraction_error"
    show_table(
        "explanation/ladder.md", FIGURES / "rung_table.csv", "experiments.ground.model_table", shown
    )


def measure_costs() -> None:
    """Write the cost of one step of each model at Table 1 and μ = 0.7, alone and in a batch."""
    params, start = vrw.WheelParams(), vrw.paper_start()
    models = {
        "rigid": (vrw.RigidWheel(), jnp.asarray([math.pi / 8, 1.6, 0.0])),
        "paper": (vrw.ViscoelasticWheel(), start),
        "ground": (vrw.UnilateralWheel(friction=0.7), start),
    }
    rows = []
    for name, (model, x) in models.items():
        take_single_step = partial(
            vrw.return_map, params, x, model=model, options=vrw.StepOptions(**SETTLING_OPTIONS)
        )
        if name == "rigid":
            batched_map = jax.jit(jax.vmap(partial(vrw.return_map, params, model=model)))
            take_batch_step = partial(batched_map, jnp.tile(x, (BATCH_SIZE, 1)))
        else:
            states = np.tile(x, (BATCH_SIZE, 1))
            take_batch_step = partial(
                vrw.step_batch,
                params,
                states,
                model=model,
                options=vrw.StepOptions(**SETTLING_OPTIONS),
            )
        jax.block_until_ready((take_single_step(), take_batch_step()))  # The first call compiles.
        row = [
            name,
            f"{1e3 * measure_cpu_seconds(take_single_step, N_TIMED):.3g}",
            f"{1e6 * measure_cpu_seconds(take_batch_step, 3) / BATCH_SIZE:.3g}",
        ]
        rows.append(row)
        print(row, flush=True)
    write_table(FIGURES / "rung_costs.csv", ("model", "ms_alone", "us_in_a_batch"), rows)
    show_table(
        "benchmarks/contact.md", FIGURES / "rung_costs.csv", "experiments.ground.model_table"
    )


if __name__ == "__main__":
    parse_and_start_jax(make_parser(__doc__))
    measure_errors()
    measure_costs()
