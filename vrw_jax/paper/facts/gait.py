"""Section 4: the gait of Table 1, and foot 2 for three dampings."""

import math

import numpy as np

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
from vrw_jax.paper.gaits import SETTLED


def _of_table_1(e: Evidence) -> Numbers:
    step = first_step(e.gait)
    phases = dls, sls1, sls2 = by_phase(step)
    change = e.settling.change.values[1:]
    shrink = float((change[12] / change[4]) ** (1.0 / 8.0))
    rear_share = dls.lambda_4.values / (dls.lambda_2.values + dls.lambda_4.values)
    period = float(step.time[-1] - step.time[0])
    energy = step.total_energy.values
    return {
        "shrink": shrink,
        "change": change[-1],
        "settled": bool(e.settling.settled and shrink < 1.0),
        "theta": float(step.theta[0]),
        "dtheta": float(step.dtheta[0]),
        "period": period,
        "speed": float(e.gait.x[-1] - e.gait.x[0]) / (2.0 * period),
        "share": 100 * float(e.table_1.dls_fraction),
        "durations": [float(phase.time[-1] - phase.time[0]) for phase in phases],
        "least_rate": float(step.dtheta.min()),
        "fore_rate": float(step.dL1.max()),
        "rear_rate": min(float(dls.dL2.min()), float(sls1.dL2.min())),
        "rear_length": float(sls1.L2[-1]),
        "off_stopper": abs(float(sls1.L2[-1]) - float(e.params.locked_length)),
        "load_before": float(step.lambda_2[-1]),
        "first_rear": 100 * rear_share[0],
        "most_rear": 100 * rear_share.max(),
        "last_rear": rear_share[-1],
        "load_grows": bool((np.diff(dls.lambda_2.values) > 0.0).all()),
        "jump": (float(dls.lambda_2[-1]), float(sls1.lambda_2[0])),
        "tangential": (float(dls.lambda_3[-1]), float(sls1.lambda_3[0])),
        "peaks": sum(_n_maxima(phase.lambda_2.values) for phase in phases),
        "peak": float(step.lambda_2.max()),
        "rise": 1e3 * float(np.diff(sls2.foot_2_z.values).min()),
        "energy_rise": np.diff(energy).max(),
        "energy_lost": energy[0] - energy[-1],
    }


def _n_maxima(values: np.ndarray) -> int:
    """Samples larger than both neighbours."""
    return int(np.sum((values[1:-1] > values[:-2]) & (values[1:-1] >= values[2:])))


def _of_three_dampings(e: Evidence) -> Numbers:
    gaits = {g.attrs["parameter_damping"]: g for g in e.by_damping}
    lowest = {c: float(gaits[c].foot_2_z.min()) for c in sorted(gaits)}
    first = {c: float(gaits[c].lambda_4[0]) for c in sorted(gaits)}
    clearance = np.minimum(e.branch.clearance_sls1, e.branch.clearance_sls2)
    kept = e.branch.settled.values & (clearance.values < 0.0)
    return {
        "lowest": ", ".join(f"{round(1e3 * z, 2) + 0.0:.2f} mm" for z in lowest.values()),
        "below": {c: z < -ROUND_OFF for c, z in lowest.items()},
        "last": float(e.branch.damping.values[kept].max()) if kept.any() else math.nan,
        "all_below": bool(kept[e.branch.damping.values <= 100.0].all()),
        "first": " > ".join(f"{force:.1f}" for force in first.values()),
        "falls": first[50.0] > first[100.0] > first[200.0] > 0.0,
    }


# fmt: off
TYPICAL_GAIT = Group("Typical gait, Table 1, slope 0.30 rad", _of_table_1, (
    Claim("the gait is stable and of period 1", "§4, Fig. 6", "stable, period 1",
          "changes shrink by {shrink:.3f} a step, to {change:.0e}",
          lambda n: n.settled, f"settled: below {SETTLED:g}, ten times a step's error"),
    Claim("angle just after landing", CODE, "θ⁺ = −0.68267 rad",
          "{theta:.5f} rad", near(theta=(-0.68267, 5e-6))),
    Claim("angular rate just after landing", CODE, "1.04920 rad/s",
          "{dtheta:.5f} rad/s", near(dtheta=(1.04920, 5e-6))),
    Claim("step period", CODE, "0.8170 s", "{period:.4f} s", near(period=(0.8170, 5e-5))),
    Claim("walking speed", CODE, "0.8700 m/s", "{speed:.4f} m/s", near(speed=(0.8700, 5.001e-5))),
    Claim("DLS takes about 53 % of the cycle", "§4 (c)", "about 53 %",
          "{share:.2f} %", near(share=(53.0, 0.5)),
          "half a per cent: published as a whole number"),
    Claim("DLS share to four digits", CODE, "53.15 %", "{share:.2f} %", near(share=(53.15, 5e-3))),
    Claim("durations of DLS, SLS-I, SLS-II", CODE, "0.4343, 0.3330, 0.0497 s",
          "{durations[0]:.4f}, {durations[1]:.4f}, {durations[2]:.4f} s",
          near(durations=((0.4343, 0.3330, 0.0497), 5e-5))),
    Claim("θ grows throughout the stance phases", "§4 (a), Fig. 6(a)", "θ̇ > 0",
          "least θ̇ = {least_rate:.3f} rad/s", lambda n: n.least_rate > 0.0, SIGN),
    Claim("Leg 1 only contracts after landing", "§4 (b), Fig. 6(b)", "L̇1 < 0",
          "largest L̇1 = {fore_rate:.3f} m/s", lambda n: n.fore_rate < 0.0, SIGN),
    Claim("Leg 2 only extends, then meets its stopper", "§4 (b), Fig. 6(b)",
          "L̇2 > 0, then L2 = L0",
          "least L̇2 = {rear_rate:.3f} m/s, then L2 = {rear_length:.6f} m",
          lambda n: n.rear_rate > 0.0 and n.off_stopper <= ROUND_OFF,
          "a sign; L2 to the error of a step, 1e-9 m"),
    Claim("the load shifts from Leg 2 to Leg 1 soon after the landing", "§4 (c), Fig. 6(e)",
          "rear to fore",
          "share of Leg 2: 100 % ({load_before:.0f} N) before, {first_rear:.0f} % just "
          "after, at most {most_rear:.0f} %, 0 at the end of DLS",
          lambda n: n.most_rear < 50.0 and abs(n.last_rear) < 1e-6 and n.load_grows,
          "Leg 1 carries more than half throughout, λ2 grows; 1e-6: the event's accuracy"),
    Claim("λ2 jumps from DLS to SLS-I", "Fig. 6(e); numbers: independent code", "145.1 → 137.7 N",
          "{jump[0]:.1f} → {jump[1]:.1f} N", near(jump=((145.1, 137.7), 0.05))),
    Claim("because λ3 jumps from nonzero to zero", "§4, Fig. 6(e)", "nonzero → 0",
          "{tangential[0]:.1f} → {tangential[1]:.1f} N",
          lambda n: abs(n.tangential[0]) > 1.0 and n.tangential[1] == 0.0,
          "nonzero: above 1 N, far over the event's accuracy"),
    Claim("one force peak per cycle", "§4, Fig. 6(e)", "1 peak of λ2",
          "{peaks}, of {peak:.1f} N", lambda n: n.peaks == 1,
          "smooth maxima of λ2 inside phases; jumps are no peaks"),
    Claim("foot 2 only rises after collision II", "§4 (d), Fig. 8", "ż2 > 0",
          "least rise between samples {rise:.2f} mm", lambda n: n.rise > 0.0, SIGN),
    Claim("mechanical energy falls monotonically", "§3.5, eq. (29)", "Ė ≤ 0",
          "largest change between samples {energy_rise:.0e} J, "
          "{energy_lost:.1f} J lost between landings",
          lambda n: n.energy_rise < ROUND_OFF, "1e-9 J of rounding on some 100 J"),
))

THREE_DAMPINGS = Group("Foot 2 and rear force for three dampings", _of_three_dampings, (
    Claim("foot 2 scuffs in SLS-I at c = 50 and 100, not at 200", "§4, Fig. 8",
          "scuffs, scuffs, clear", "{lowest}",
          lambda n: n.below == {50.0: True, 100.0: True, 200.0: False},
          "lowest point of foot 2; the foot on the ground is 0 to 1e-9 m"),
    Claim("scuffs up to c = 100, clear from 120 on", CODE, "100 < limit < 120",
          "scuffs up to c = {last:.0f}", lambda n: n.all_below and 100.0 <= n.last < 120.0,
          "whole numbers of c"),
    Claim("λ4 just after landing falls as c grows", "§4, Fig. 9", "nearer to zero with c",
          "{first} N", lambda n: n.falls, SIGN),
))
# fmt: on
