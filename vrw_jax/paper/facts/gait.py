"""Section 4: the gait of Table 1, and foot 2 for three dampings."""

import math

import numpy as np
import xarray as xr

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
from vrw_jax.paper.gaits import SETTLED


def gait_facts(e: Evidence) -> list[Fact]:
    group = "Typical gait, Table 1, slope 0.30 rad"
    step, one = first_step(e.gait), e.table_1
    dls, sls1, sls2 = (in_phase(step, i) for i in range(3))
    change = e.settling.change.values[1:]
    shrink = float((change[12] / change[4]) ** (1.0 / 8.0))
    settled = bool(e.settling.settled and shrink < 1.0)
    share = float(one.dls_fraction)
    period = float(step.time[-1] - step.time[0])
    durations = [float(p.time[-1] - p.time[0]) for p in (dls, sls1, sls2)]
    speed = float(e.gait.x[-1] - e.gait.x[0]) / (2.0 * period)
    theta, dtheta = float(step.theta[0]), float(step.dtheta[0])
    before = float(e.gait.lambda_2.values[e.gait.step.values == 0][-1])
    rear_share = dls.lambda_4.values / (dls.lambda_2.values + dls.lambda_4.values)
    jump = (float(dls.lambda_2[-1]), float(sls1.lambda_2[0]))
    last_tangential = float(dls.lambda_3[-1])
    peaks = sum(_n_maxima(p.lambda_2.values) for p in (dls, sls1, sls2))
    rise = float(np.diff(sls2.foot_2_z.values).min())
    energy = step.total_energy.values
    return [
        Fact(
            group,
            "the gait is stable and of period 1",
            "§4, Fig. 6",
            "stable, period 1",
            f"changes shrink by {shrink:.3f} a step, to {change[-1]:.0e}",
            settled,
            f"settled: below {SETTLED:g}, ten times a step's error",
        ),
        Fact(
            group,
            "angle just after landing",
            "independent code",
            "θ⁺ = −0.68267 rad",
            f"{theta:.5f} rad",
            near(theta, -0.68267, 5e-6),
            DIGIT,
        ),
        Fact(
            group,
            "angular rate just after landing",
            "independent code",
            "1.04920 rad/s",
            f"{dtheta:.5f} rad/s",
            near(dtheta, 1.04920, 5e-6),
            DIGIT,
        ),
        Fact(
            group,
            "step period",
            "independent code",
            "0.8170 s",
            f"{period:.4f} s",
            near(period, 0.8170, 5e-5),
            DIGIT,
        ),
        Fact(
            group,
            "walking speed",
            "independent code",
            "0.8700 m/s",
            f"{speed:.4f} m/s",
            near(speed, 0.8700, 5.001e-5),
            DIGIT,
        ),
        Fact(
            group,
            "DLS takes about 53 % of the cycle",
            "§4 (c)",
            "about 53 %",
            f"{100 * share:.2f} %",
            near(100 * share, 53.0, 0.5),
            "half a per cent: published as a whole number",
        ),
        Fact(
            group,
            "DLS share to four digits",
            "independent code",
            "53.15 %",
            f"{100 * share:.2f} %",
            near(100 * share, 53.15, 5e-3),
            DIGIT,
        ),
        Fact(
            group,
            "durations of DLS, SLS-I, SLS-II",
            "independent code",
            "0.4343, 0.3330, 0.0497 s",
            ", ".join(f"{d:.4f}" for d in durations) + " s",
            all(near(d, p, 5e-5) for d, p in zip(durations, (0.4343, 0.3330, 0.0497), strict=True)),
            DIGIT,
        ),
        Fact(
            group,
            "θ grows throughout the stance phases",
            "§4 (a), Fig. 6(a)",
            "θ̇ > 0",
            f"least θ̇ = {float(step.dtheta.min()):.3f} rad/s",
            bool((step.dtheta > 0.0).all()),
            SIGN,
        ),
        Fact(
            group,
            "Leg 1 only contracts after landing",
            "§4 (b), Fig. 6(b)",
            "L̇1 < 0",
            f"largest L̇1 = {float(step.dL1.max()):.3f} m/s",
            bool((step.dL1 < 0.0).all()),
            SIGN,
        ),
        Fact(
            group,
            "Leg 2 only extends, then meets its stopper",
            "§4 (b), Fig. 6(b)",
            "L̇2 > 0, then L2 = L0",
            f"least L̇2 = {float(xr.concat([dls, sls1], 'time').dL2.min()):.3f} m/s, "
            f"then L2 = {float(sls1.L2[-1]):.6f} m",
            bool(
                (dls.dL2 > 0.0).all()
                and (sls1.dL2 > 0.0).all()
                and near(float(sls1.L2[-1]), float(e.params.locked_length), ROUND_OFF)
            ),
            "a sign; L2 to the error of a step, 1e-9 m",
        ),
        Fact(
            group,
            "the load shifts from Leg 2 to Leg 1 soon after the landing",
            "§4 (c), Fig. 6(e)",
            "rear to fore",
            f"share of Leg 2: 100 % ({before:.0f} N) before, {100 * rear_share[0]:.0f} % just "
            f"after, at most {100 * rear_share.max():.0f} %, 0 at the end of DLS",
            bool(
                rear_share.max() < 0.5
                and abs(rear_share[-1]) < 1e-6
                and (np.diff(dls.lambda_2.values) > 0.0).all()
            ),
            "Leg 1 carries more than half throughout, λ2 grows; 1e-6: the event's accuracy",
        ),
        Fact(
            group,
            "λ2 jumps from DLS to SLS-I",
            "Fig. 6(e); numbers: independent code",
            "145.1 → 137.7 N",
            f"{jump[0]:.1f} → {jump[1]:.1f} N",
            near(jump[0], 145.1, 0.05) and near(jump[1], 137.7, 0.05),
            DIGIT,
        ),
        Fact(
            group,
            "because λ3 jumps from nonzero to zero",
            "§4, Fig. 6(e)",
            "nonzero → 0",
            f"{last_tangential:.1f} → {float(sls1.lambda_3[0]):.1f} N",
            abs(last_tangential) > 1.0 and float(sls1.lambda_3[0]) == 0.0,
            "nonzero: above 1 N, far over the event's accuracy",
        ),
        Fact(
            group,
            "one force peak per cycle",
            "§4, Fig. 6(e)",
            "1 peak of λ2",
            f"{peaks}, of {float(step.lambda_2.max()):.1f} N",
            peaks == 1,
            "smooth maxima of λ2 inside phases; jumps are no peaks",
        ),
        Fact(
            group,
            "foot 2 only rises after collision II",
            "§4 (d), Fig. 8",
            "ż2 > 0",
            f"least rise between samples {1e3 * rise:.2f} mm",
            rise > 0.0,
            SIGN,
        ),
        Fact(
            group,
            "mechanical energy falls monotonically",
            "§3.5, eq. (29)",
            "Ė ≤ 0",
            f"largest change between samples {np.diff(energy).max():.0e} J, "
            f"{energy[0] - energy[-1]:.1f} J lost between landings",
            bool(np.diff(energy).max() < ROUND_OFF),
            "1e-9 J of rounding on some 100 J",
        ),
    ]


def _n_maxima(values: np.ndarray) -> int:
    """Samples larger than both neighbours."""
    return int(np.sum((values[1:-1] > values[:-2]) & (values[1:-1] >= values[2:])))


def damping_facts(e: Evidence) -> list[Fact]:
    group = "Foot 2 and rear force for three dampings"
    lowest = {g.attrs["parameter_damping"]: float(g.foot_2_z.min()) for g in e.by_damping}
    first = {g.attrs["parameter_damping"]: float(g.lambda_4[0]) for g in e.by_damping}
    clearance = np.minimum(e.branch.clearance_sls1, e.branch.clearance_sls2)
    kept = e.branch.settled.values & (clearance.values < 0.0)
    last = float(e.branch.damping.values[kept].max()) if kept.any() else math.nan
    all_below = bool(kept[e.branch.damping.values <= 100.0].all())
    below = {c: lowest[c] < -ROUND_OFF for c in lowest}
    return [
        Fact(
            group,
            "foot 2 scuffs in SLS-I at c = 50 and 100, not at 200",
            "§4, Fig. 8",
            "scuffs, scuffs, clear",
            ", ".join(f"{round(1e3 * lowest[c], 2) + 0.0:.2f} mm" for c in sorted(lowest)),
            below == {50.0: True, 100.0: True, 200.0: False},
            "lowest point of foot 2; the foot on the ground is 0 to 1e-9 m",
        ),
        Fact(
            group,
            "scuffs up to c = 100, clear from 120 on",
            "independent code",
            "100 < limit < 120",
            f"scuffs up to c = {last:.0f}",
            all_below and 100.0 <= last < 120.0,
            "whole numbers of c",
        ),
        Fact(
            group,
            "λ4 just after landing falls as c grows",
            "§4, Fig. 9",
            "nearer to zero with c",
            " > ".join(f"{first[c]:.1f}" for c in sorted(first)) + " N",
            first[50.0] > first[100.0] > first[200.0] > 0.0,
            SIGN,
        ),
    ]
