"""What the model assumes without saying, measured at Table 1."""

import numpy as np
import xarray as xr

from vrw_jax.paper.facts import printed
from vrw_jax.paper.facts.base import (
    DIGIT,
    ROUND_OFF,
    SIGN,
    Evidence,
    Fact,
    first_step,
    in_phase,
    near,
)
from vrw_jax.results import PHASES


def premise_facts(e: Evidence) -> list[Fact]:
    group = "Premises of the model at Table 1 (what it assumes without saying)"
    where = "independent code"
    one, step = e.table_1, first_step(e.gait)
    dls = in_phase(step, 0)
    value = lambda name: float(one[name])
    locked = float(one.locked_stopper_force.min())
    preload = float(e.params.stiffness * (e.params.natural_length - e.params.locked_length))
    impulses = one.landing_stopper_impulse.values / float(e.params.leg_mass)
    thrown = np.sort(impulses[impulses < 0.0])
    friction = float(np.abs(step.lambda_1 / step.lambda_2).max())
    rear = float(np.abs(dls.lambda_3[0] / dls.lambda_4[0]))
    impulse = printed.landing(e.params, one.section_state.values).impulse
    shock = (abs(impulse[2]) / impulse[3], abs(impulse[0]) / impulse[1])
    growth = np.abs(dls.lambda_3.values[:-1] / dls.lambda_4.values[:-1])
    return [
        Fact(
            group,
            "Leg 1 pushes on the ground: least λ2",
            where,
            "103.9 N",
            f"{value('fore_foot_force'):.1f} N",
            near(value("fore_foot_force"), 103.9, 0.05),
            DIGIT,
        ),
        Fact(
            group,
            "Leg 2 pushes in DLS: least λ4",
            where,
            "≥ 0, 0 at its end",
            f"{float(dls.lambda_4[:-1].min()):.2f} N before the end, "
            f"{abs(float(dls.lambda_4[-1])):.0e} N there",
            bool((dls.lambda_4[:-1] > 0.0).all()) and abs(float(dls.lambda_4[-1])) < 1e-6,
            "1e-6 N: the event's accuracy",
        ),
        Fact(
            group,
            "the swinging foot stays clear",
            where,
            "≥ 0",
            f"{min(value('clearance_sls1'), value('clearance_sls2')):.3f} m at its first minimum",
            min(value("clearance_sls1"), value("clearance_sls2")) >= 0.0,
            SIGN,
        ),
        Fact(
            group,
            "stopper force of the six locked legs, of 10 N preload",
            where,
            "0.95 N: near the edge",
            f"{locked:.3f} N of {preload:.0f} N",
            near(locked, 0.95, 0.02) and near(preload, 10.0, ROUND_OFF),
            "0.02 N: a least value read off samples lies above the one located here",
        ),
        Fact(
            group,
            "stopper force of Leg 2 in SLS-II",
            where,
            "17 N",
            f"{value('rear_stopper_force'):.2f} N",
            near(value("rear_stopper_force"), 17.0, 0.5),
            DIGIT,
        ),
        Fact(
            group,
            "Leg 1 stays below L0 after landing",
            where,
            "L0 − L1 ≥ 0",
            f"{float(e.params.locked_length) - float(step.L1[1:].max()):.4f} m after the first "
            "sample",
            bool((step.L1[1:] < float(e.params.locked_length)).all()),
            SIGN,
        ),
        Fact(
            group,
            "Leg 2 is back at L0 before touchdown, and not yet there in DLS",
            where,
            "holds",
            " → ".join(_phases_in_order(step)),
            _phases_in_order(step) == ["DLS", "SLS-I", "SLS-II"]
            and float(dls.L2.max()) < float(e.params.locked_length),
            "the order of events",
        ),
        Fact(
            group,
            "friction that Leg 1 needs",
            where,
            "0.61",
            f"{friction:.3f}",
            near(friction, 0.61, 5e-3),
            DIGIT,
        ),
        Fact(
            group,
            "friction that Leg 2 needs just after landing",
            where,
            "14.2",
            f"{rear:.2f}",
            near(rear, 14.2, 0.05),
            DIGIT,
        ),
        Fact(
            group,
            "and without bound as λ4 → 0",
            where,
            "λ3 does not vanish with λ4",
            f"λ3 = {float(dls.lambda_3[-1]):.1f} N at the end of DLS; {growth[-1]:.0f} one sample "
            "before",
            abs(float(dls.lambda_3[-1])) > 1.0 and growth[-1] > 14.2,
            "λ3 above 1 N where λ4 is 0",
        ),
        Fact(
            group,
            "friction needed in the landing impulse, rear and fore foot",
            where,
            "9.7 and 1.10",
            f"{shock[0]:.2f} and {shock[1]:.3f}",
            near(shock[0], 9.7, 0.05) and near(shock[1], 1.10, 5e-3),
            DIGIT,
        ),
        Fact(
            group,
            "energy lost in the landing",
            where,
            "7.58 J",
            f"{value('energy_lost_landing'):.3f} J",
            near(value("energy_lost_landing"), 7.58, 5e-3),
            DIGIT,
        ),
        Fact(
            group,
            "the landing throws four of the six locked legs off their stoppers",
            where,
            "−0.24 … −0.86 m/s",
            f"{thrown.size} of {impulses.size}, {thrown[-1]:.2f} … {thrown[0]:.2f} m/s"
            if thrown.size
            else "none",
            thrown.size == 4 and near(thrown[-1], -0.24, 5e-3) and near(thrown[0], -0.86, 5e-3),
            DIGIT,
        ),
        Fact(
            group,
            "collision II asks the planted foot for a slightly negative impulse",
            where,
            "−4e-4 N·s",
            f"{value('hit_planted_impulse'):.1e} N·s",
            near(value("hit_planted_impulse"), -4e-4, 5e-5),
            DIGIT,
        ),
    ]


def _phases_in_order(step: xr.Dataset) -> list[str]:
    phases = step.phase.values
    return [PHASES[int(p)] for p in phases[np.r_[0, np.flatnonzero(np.diff(phases)) + 1]]]
