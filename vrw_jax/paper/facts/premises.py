"""What the model assumes without saying, measured at Table 1."""

import numpy as np

from vrw_jax.paper.facts import printed
from vrw_jax.paper.facts.base import (
    CODE,
    ROUND_OFF,
    SIGN,
    Claim,
    Evidence,
    Group,
    Numbers,
    by_phase,
    first_step,
    near,
)
from vrw_jax.results import PHASES


def _of_table_1(e: Evidence) -> Numbers:
    one, step = e.table_1, first_step(e.gait)
    dls, *_ = by_phase(step)
    natural, locked = float(e.params.natural_length), float(e.params.locked_length)
    impulses = one.landing_stopper_impulse.values / float(e.params.leg_mass)
    thrown = np.sort(impulses[impulses < 0.0])
    impulse = printed.landing(e.params, one.section_state.values).impulse
    needed = np.abs(dls.lambda_3.values[:-1] / dls.lambda_4.values[:-1])
    phases = step.phase.values
    order = [PHASES[int(p)] for p in phases[np.r_[0, np.flatnonzero(np.diff(phases)) + 1]]]
    names = ("fore_foot_force", "rear_stopper_force", "energy_lost_landing", "hit_planted_impulse")
    return {name: float(one[name]) for name in names} | {
        "rear_force": float(dls.lambda_4[:-1].min()),
        "last_rear_force": abs(float(dls.lambda_4[-1])),
        "clearance": min(float(one.clearance_sls1), float(one.clearance_sls2)),
        "locked_force": float(one.locked_stopper_force.min()),
        "preload": float(e.params.stiffness) * (natural - locked),
        "contraction": locked - float(step.L1[1:].max()),
        "order": " → ".join(order),
        "back_in_time": order == list(PHASES) and float(dls.L2.max()) < locked,
        "friction_fore": float(np.abs(step.lambda_1 / step.lambda_2).max()),
        "friction_rear": needed[0],
        "friction_last": needed[-1],
        "last_tangential": float(dls.lambda_3[-1]),
        "in_landing_rear": abs(impulse[2]) / impulse[3],
        "in_landing_fore": abs(impulse[0]) / impulse[1],
        "thrown": (thrown[-1], thrown[0]) if thrown.size else (np.nan, np.nan),
        "n_thrown": thrown.size,
        "thrown_off": f"{thrown.size} of {impulses.size}, {thrown[-1]:.2f} … {thrown[0]:.2f} m/s"
        if thrown.size
        else "none",
    }


# fmt: off
PREMISES = Group(
    "Premises of the model at Table 1 (what it assumes without saying)", _of_table_1, (
    Claim("Leg 1 pushes on the ground: least λ2", CODE, "103.9 N",
          "{fore_foot_force:.1f} N", near(fore_foot_force=(103.9, 0.05))),
    Claim("Leg 2 pushes in DLS: least λ4", CODE, "≥ 0, 0 at its end",
          "{rear_force:.2f} N before the end, {last_rear_force:.0e} N there",
          lambda n: n.rear_force > 0.0 and n.last_rear_force < 1e-6,
          "1e-6 N: the event's accuracy"),
    Claim("the swinging foot stays clear", CODE, "≥ 0",
          "{clearance:.3f} m at its first minimum", lambda n: n.clearance >= 0.0, SIGN),
    Claim("stopper force of the six locked legs, of 10 N preload", CODE,
          "0.95 N: near the edge", "{locked_force:.3f} N of {preload:.0f} N",
          near(locked_force=(0.95, 0.02), preload=(10.0, ROUND_OFF)),
          "0.02 N: a least value read off samples lies above the one located here"),
    Claim("stopper force of Leg 2 in SLS-II", CODE, "17 N",
          "{rear_stopper_force:.2f} N", near(rear_stopper_force=(17.0, 0.5))),
    Claim("Leg 1 stays below L0 after landing", CODE, "L0 − L1 ≥ 0",
          "{contraction:.4f} m after the first sample", lambda n: n.contraction > 0.0, SIGN),
    Claim("Leg 2 is back at L0 before touchdown, and not yet there in DLS", CODE, "holds",
          "{order}", lambda n: n.back_in_time, "the order of events"),
    Claim("friction that Leg 1 needs", CODE, "0.61",
          "{friction_fore:.3f}", near(friction_fore=(0.61, 5e-3))),
    Claim("friction that Leg 2 needs just after landing", CODE, "14.2",
          "{friction_rear:.2f}", near(friction_rear=(14.2, 0.05))),
    Claim("and without bound as λ4 → 0", CODE, "λ3 does not vanish with λ4",
          "λ3 = {last_tangential:.1f} N at the end of DLS; {friction_last:.0f} one sample before",
          lambda n: abs(n.last_tangential) > 1.0 and n.friction_last > 14.2,
          "λ3 above 1 N where λ4 is 0"),
    Claim("friction needed in the landing impulse, rear and fore foot", CODE, "9.7 and 1.10",
          "{in_landing_rear:.2f} and {in_landing_fore:.3f}",
          near(in_landing_rear=(9.7, 0.05), in_landing_fore=(1.10, 5e-3))),
    Claim("energy lost in the landing", CODE, "7.58 J",
          "{energy_lost_landing:.3f} J", near(energy_lost_landing=(7.58, 5e-3))),
    Claim("the landing throws four of the six locked legs off their stoppers", CODE,
          "−0.24 … −0.86 m/s", "{thrown_off}",
          near(n_thrown=(4, 0), thrown=((-0.24, -0.86), 5e-3))),
    Claim("collision II asks the planted foot for a slightly negative impulse", CODE,
          "−4e-4 N·s", "{hit_planted_impulse:.1e} N·s", near(hit_planted_impulse=(-4e-4, 5e-5))),
))
# fmt: on
