"""Reproduction of the paper: its figures, and a table of published facts with computed values.

All gaits are limits of walks from one start, without Newton's method for a fixed point.
"""

import csv
import itertools
import math
import re
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import xarray as xr
from jaxtyping import Array

from vrw_jax import plot as plots
from vrw_jax.app.paper_evidence import (
    INDEPENDENT_CODE_LABEL,
    MAX_SETTLED_STATE_CHANGE,
    MISPRINT_CLAIMS,
    SIGN_TOLERANCE_REASON,
    STEP_ERROR_TOLERANCE,
    ClaimValues,
    PaperClaim,
    PaperClaimGroup,
    PaperEvidence,
    PaperFact,
    compute_printed_landing,
    make_agreement_test,
    make_formally_continued_model,
    measure_gaits_along_parameter,
    replace_wheel_parameter,
    split_trajectory_by_phase,
    walk_along_parameter,
    walk_into_gait,
)
from vrw_jax.base.checks import check_path
from vrw_jax.base.results import Outcome, format_markdown_table
from vrw_jax.models.measures import PHASE_NAMES
from vrw_jax.models.stepping import paper_start
from vrw_jax.models.trajectory import simulate
from vrw_jax.wheel.params import WheelParams


def _compute_typical_gait_values(paper_evidence: PaperEvidence) -> ClaimValues:
    first_step_trajectory = paper_evidence.first_step_trajectory
    phase_trajectories = double_support, single_support_1, single_support_2 = (
        split_trajectory_by_phase(first_step_trajectory)
    )
    section_state_changes = paper_evidence.settling_walk.change.values[1:]
    convergence_ratio = float((section_state_changes[12] / section_state_changes[4]) ** (1.0 / 8.0))
    rear_load_fraction = double_support.lambda_4.values / (
        double_support.lambda_2.values + double_support.lambda_4.values
    )
    gait_step_period = float(first_step_trajectory.time[-1] - first_step_trajectory.time[0])
    total_energies = first_step_trajectory.total_energy.values
    count_local_maxima = lambda x: int(np.sum((x[1:-1] > x[:-2]) & (x[1:-1] >= x[2:])))
    return {
        "shrink": convergence_ratio,
        "change": section_state_changes[-1],
        "settled": (paper_evidence.settling_walk.settled and convergence_ratio < 1.0),
        "theta": first_step_trajectory.theta[0],
        "dtheta": first_step_trajectory.dtheta[0],
        "period": gait_step_period,
        "speed": float(
            paper_evidence.table_1_trajectory.x[-1] - paper_evidence.table_1_trajectory.x[0]
        )
        / (2.0 * gait_step_period),
        "share": 100 * paper_evidence.table_1_gait.dls_fraction,
        "durations": [
            float(phase_trajectory.time[-1] - phase_trajectory.time[0])
            for phase_trajectory in phase_trajectories
        ],
        "least_rate": first_step_trajectory.dtheta.min(),
        "fore_rate": first_step_trajectory.dL1.max(),
        "rear_rate": min(float(double_support.dL2.min()), float(single_support_1.dL2.min())),
        "rear_length": single_support_1.L2[-1],
        "off_stopper": abs(
            float(single_support_1.L2[-1]) - float(paper_evidence.params.locked_length)
        ),
        "load_before": first_step_trajectory.lambda_2[-1],
        "first_rear": 100 * rear_load_fraction[0],
        "most_rear": 100 * rear_load_fraction.max(),
        "last_rear": rear_load_fraction[-1],
        "load_grows": (np.diff(double_support.lambda_2.values) > 0.0).all(),
        "jump": (float(double_support.lambda_2[-1]), float(single_support_1.lambda_2[0])),
        "tangential": (float(double_support.lambda_3[-1]), float(single_support_1.lambda_3[0])),
        "peaks": sum(
            count_local_maxima(phase_trajectory.lambda_2.values)
            for phase_trajectory in phase_trajectories
        ),
        "peak": first_step_trajectory.lambda_2.max(),
        "rise": 1e3 * float(np.diff(single_support_2.foot_2_z.values).min()),
        "energy_rise": np.diff(total_energies).max(),
        "energy_lost": total_energies[0] - total_energies[-1],
    }


def _compute_damping_values(paper_evidence: PaperEvidence) -> ClaimValues:
    """Compute the values that the claims on foot height and rear force need, by name.

    The claims concern gaits with three values of damping.
    """
    damping_branch = paper_evidence.damping_branch
    gaits = sorted(paper_evidence.gaits_by_damping, key=lambda g: g.attrs["parameter_damping"])
    lowest_foot_heights = {g.attrs["parameter_damping"]: float(g.foot_2_z.min()) for g in gaits}
    initial_rear_forces = [float(g.lambda_4[0]) for g in gaits]
    is_scuffing = damping_branch.settled & (
        np.minimum(damping_branch.clearance_sls1, damping_branch.clearance_sls2) < 0.0
    )
    return {
        "lowest": ", ".join(
            f"{round(1e3 * z, 2) + 0.0:.2f} mm" for z in lowest_foot_heights.values()
        ),
        "below": {c: z < -STEP_ERROR_TOLERANCE for c, z in lowest_foot_heights.items()},
        "last": damping_branch.damping.where(is_scuffing).max(),
        "all_below": is_scuffing.sel(damping=slice(None, 100.0)).all(),
        "first": " > ".join(f"{rear_force:.1f}" for rear_force in initial_rear_forces),
        "falls": (np.diff([*initial_rear_forces, 0.0]) < 0.0).all(),
    }


# fmt: off
TYPICAL_GAIT_CLAIMS = PaperClaimGroup(
    "Typical gait, Table 1, slope 0.30 rad", _compute_typical_gait_values, (
    PaperClaim("the gait is stable and of period 1", "§4, Fig. 6", "stable, period 1",
          "changes shrink by {shrink:.3f} a step, to {change:.0e}",
          lambda n: n.settled,
          f"settled: below {MAX_SETTLED_STATE_CHANGE:g}, ten times a step's "
          "error"),
    PaperClaim("angle just after landing", INDEPENDENT_CODE_LABEL, "θ⁺ = −0.68267 rad",
          "{theta:.5f} rad", make_agreement_test(theta=(-0.68267, 5e-6))),
    PaperClaim("angular rate just after landing", INDEPENDENT_CODE_LABEL, "1.04920 rad/s",
          "{dtheta:.5f} rad/s", make_agreement_test(dtheta=(1.04920, 5e-6))),
    PaperClaim("step period", INDEPENDENT_CODE_LABEL, "0.8170 s", "{period:.4f} s",
          make_agreement_test(period=(0.8170, 5e-5))),
    PaperClaim("walking speed", INDEPENDENT_CODE_LABEL, "0.8700 m/s", "{speed:.4f} m/s",
          make_agreement_test(speed=(0.8700, 5.001e-5))),
    PaperClaim("DLS takes about 53 % of the cycle", "§4 (c)", "about 53 %",
          "{share:.2f} %", make_agreement_test(share=(53.0, 0.5)),
          "half a per cent: published as a whole number"),
    PaperClaim("DLS share to four digits", INDEPENDENT_CODE_LABEL, "53.15 %", "{share:.2f} %",
          make_agreement_test(share=(53.15, 5e-3))),
    PaperClaim("durations of DLS, SLS-I, SLS-II", INDEPENDENT_CODE_LABEL,
          "0.4343, 0.3330, 0.0497 s",
          "{durations[0]:.4f}, {durations[1]:.4f}, {durations[2]:.4f} s",
          make_agreement_test(durations=((0.4343, 0.3330, 0.0497), 5e-5))),
    PaperClaim("θ grows throughout the stance phases", "§4 (a), Fig. 6(a)", "θ̇ > 0",
          "least θ̇ = {least_rate:.3f} rad/s", lambda n: n.least_rate > 0.0, SIGN_TOLERANCE_REASON),
    PaperClaim("Leg 1 only contracts after landing", "§4 (b), Fig. 6(b)", "L̇1 < 0",
          "largest L̇1 = {fore_rate:.3f} m/s", lambda n: n.fore_rate < 0.0, SIGN_TOLERANCE_REASON),
    PaperClaim("Leg 2 only extends, then meets its stopper", "§4 (b), Fig. 6(b)",
          "L̇2 > 0, then L2 = L0",
          "least L̇2 = {rear_rate:.3f} m/s, then L2 = {rear_length:.6f} m",
          lambda n: n.rear_rate > 0.0 and n.off_stopper <= STEP_ERROR_TOLERANCE,
          "a sign; L2 to the error of a step, 1e-9 m"),
    PaperClaim("the load shifts from Leg 2 to Leg 1 soon after the landing", "§4 (c), Fig. 6(e)",
          "rear to fore",
          "share of Leg 2: 100 % ({load_before:.0f} N) before, {first_rear:.0f} % just "
          "after, at most {most_rear:.0f} %, 0 at the end of DLS",
          lambda n: n.most_rear < 50.0 and abs(n.last_rear) < 1e-6 and n.load_grows,
          "Leg 1 carries more than half throughout, λ2 grows; 1e-6: the event's accuracy"),
    PaperClaim("λ2 jumps from DLS to SLS-I", "Fig. 6(e); numbers: independent code",
          "145.1 → 137.7 N",
          "{jump[0]:.1f} → {jump[1]:.1f} N", make_agreement_test(jump=((145.1, 137.7), 0.05))),
    PaperClaim("λ3 jumps from nonzero to zero", "§4, Fig. 6(e)", "nonzero → 0",
          "{tangential[0]:.1f} → {tangential[1]:.1f} N",
          lambda n: abs(n.tangential[0]) > 1.0 and n.tangential[1] == 0.0,
          "nonzero: above 1 N, far over the event's accuracy"),
    PaperClaim("one force peak per cycle", "§4, Fig. 6(e)", "1 peak of λ2",
          "{peaks}, of {peak:.1f} N", lambda n: n.peaks == 1,
          "smooth maxima of λ2 inside phases; jumps are no peaks"),
    PaperClaim("foot 2 only rises after collision II", "§4 (d), Fig. 8", "ż2 > 0",
          "least rise between samples {rise:.2f} mm", lambda n: n.rise > 0.0,
          SIGN_TOLERANCE_REASON),
    PaperClaim("mechanical energy falls monotonically", "§3.5, eq. (29)", "Ė ≤ 0",
          "largest change between samples {energy_rise:.0e} J, "
          "{energy_lost:.1f} J lost between landings",
          lambda n: n.energy_rise < STEP_ERROR_TOLERANCE, "1e-9 J of rounding on some 100 J"),
))

DAMPING_CLAIMS = PaperClaimGroup("Foot 2 and rear force for three dampings",
          _compute_damping_values, (
    PaperClaim("foot 2 scuffs in SLS-I at c = 50 and 100, not at 200", "§4, Fig. 8",
          "scuffs, scuffs, clear", "{lowest}",
          lambda n: n.below == {50.0: True, 100.0: True, 200.0: False},
          "lowest point of foot 2; the foot on the ground is 0 to 1e-9 m"),
    PaperClaim("scuffs up to c = 100, clear from 120 on", INDEPENDENT_CODE_LABEL,
          "100 < limit < 120",
          "scuffs up to c = {last:.0f}", lambda n: n.all_below and 100.0 <= n.last < 120.0,
          "whole numbers of c"),
    PaperClaim("λ4 just after landing falls as c grows", "§4, Fig. 9", "nearer to zero with c",
          "{first} N", lambda n: n.falls, SIGN_TOLERANCE_REASON),
))
# fmt: on


def _compute_indicator_values(paper_evidence: PaperEvidence) -> ClaimValues:
    """Compute the values that the claims on double-support indicators need, by name.

    The indicators are functions of the damping.
    """
    damping_branch = paper_evidence.damping_branch
    gaits_to_damping_219 = damping_branch.sel(damping=slice(1.0, 219.0))
    gaits_from_damping_220 = damping_branch.sel(damping=slice(220.0, None))
    read_branch_value = lambda c, indicator_name: float(
        damping_branch[indicator_name].sel(damping=c)
    )
    branch_landing_impulses = gaits_to_damping_219.lambda_I4.values
    landing_impulses = np.array(
        [
            compute_printed_landing(paper_evidence.params, x).corrected_impulse
            for x in gaits_to_damping_219.section_state.values
        ]
    )
    rear_forces_by_damping = {c: read_branch_value(c, "lambda_4_plus") for c in (1.0, 218.0, 219.0)}
    do_walks_continue = bool((gaits_from_damping_220.outcome == Outcome.STEPPED).all())
    return {
        "n_settled": int(gaits_to_damping_219.settled.sum()),
        "n": gaits_to_damping_219.sizes["damping"],
        "rear": (
            rear_forces_by_damping[1.0],
            rear_forces_by_damping[219.0],
            2 * rear_forces_by_damping[219.0] - rear_forces_by_damping[218.0],
        ),
        "last_rear": rear_forces_by_damping[219.0],
        "rear_falls": (np.diff(gaits_to_damping_219.lambda_4_plus) < 0.0).all(),
        "fore": (
            read_branch_value(219.0, "lambda_2_plus"),
            read_branch_value(1.0, "lambda_2_plus"),
        ),
        "fore_5": read_branch_value(5.0, "lambda_2_plus"),
        "fore_4": read_branch_value(4.0, "lambda_2_plus"),
        "fore_grows": (np.diff(gaits_to_damping_219.lambda_2_plus) > 0.0).all(),
        "least": branch_landing_impulses.min(),
        "most": branch_landing_impulses.max(),
        "fore_impulse": (landing_impulses[:, 1].min(), landing_impulses[:, 1].max()),
        "smallest": [
            min(
                read_branch_value(c, indicator_name)
                for indicator_name in ("lambda_I4", "lambda_2_plus", "lambda_4_plus")
            )
            for c in (50.0, 100.0, 200.0)
        ],
        "walks_on": do_walks_continue,
        "yes_or_no": "yes" if do_walks_continue else "no",
        "never_settles": not bool(gaits_from_damping_220.settled.any()),
        "change": gaits_from_damping_220.change.min(),
        "end": gaits_from_damping_220.damping.max(),
        "share": 100 * read_branch_value(219.0, "dls_fraction"),
        "too_fast": paper_evidence.fast_start_walk.outcome,
        "too_fast_ends": str(paper_evidence.fast_start_walk.outcome).lower().replace("_", " "),
    }


# fmt: off
INDICATOR_CLAIMS = PaperClaimGroup("DLS indicators over c, slope 0.30 rad",
          _compute_indicator_values, (
    PaperClaim("a period-1 gait exists at every whole c up to 219", "§5.2, Fig. 10",
          "1 … 219 (from 5 on with λ2⁺ ≥ 0)", "{n_settled} of {n} settled",
          lambda n: n.n_settled == n.n,
          f"change per step below {MAX_SETTLED_STATE_CHANGE:g}"),
    PaperClaim("λ4⁺ falls monotonically with c", "§5.2, Fig. 10(b)", "monotone",
          "{rear[0]:.1f} … {rear[1]:.2f} N", lambda n: n.rear_falls, SIGN_TOLERANCE_REASON),
    PaperClaim("λ4⁺ is not positive at c = 220", "§5.2, Fig. 10(b)", "0 at 220",
          "{rear[1]:+.2f} N at 219, on the line through the last two {rear[2]:+.2f} N at 220",
          lambda n: n.rear[1] > 0.0 > n.rear[2], "a sign on the integer grid of c"),
    PaperClaim("λ4⁺ at c = 219", INDEPENDENT_CODE_LABEL, "+0.40 N", "{last_rear:+.3f} N",
          make_agreement_test(last_rear=(0.40, 5e-3))),
    PaperClaim("λ2⁺ falls monotonically as c falls", "§5.2, Fig. 10(b)", "monotone",
          "{fore[0]:.1f} … {fore[1]:.2f} N", lambda n: n.fore_grows, SIGN_TOLERANCE_REASON),
    PaperClaim("λ2⁺ is not positive at c = 4", "§5.2, Fig. 10(b)", "0 at 4",
          "{fore_5:+.2f} N at 5, {fore_4:+.2f} N at 4",
          lambda n: n.fore_5 > 0.0 >= n.fore_4, "a sign on the integer grid of c"),
    PaperClaim("λ2⁺ at c = 5 and 4", INDEPENDENT_CODE_LABEL, "+0.19, −0.36 N",
          "{fore_5:+.3f}, {fore_4:+.3f} N",
          make_agreement_test(fore_5=(0.19, 5e-3), fore_4=(-0.36, 5e-3))),
    PaperClaim("λ_I4 is always positive", "§5.2, Fig. 10(a)", "> 0",
          "{least:.2f} … {most:.2f} N·s", lambda n: n.least > 0.0, SIGN_TOLERANCE_REASON),
    PaperClaim("range of λ_I4", INDEPENDENT_CODE_LABEL, "1.82 … 2.14 N·s",
          "{least:.2f} … {most:.2f} N·s",
          make_agreement_test(least=(1.82, 0.02), most=(2.14, 5e-3)),
          "0.02 at the lower end, which depends on the least c (1.81 at 1, 1.84 at 5)"),
    PaperClaim("λ_I2 > 0 always", "§5.1 (A2)", "> 0",
          "{fore_impulse[0]:.1f} … {fore_impulse[1]:.1f} N·s",
          lambda n: n.fore_impulse[0] > 0.0, SIGN_TOLERANCE_REASON),
    PaperClaim("all indicators are positive at c = 50, 100, 200", "§5.2", "> 0",
          "least of λ_I4, λ2⁺, λ4⁺: {smallest[0]:.2f}, {smallest[1]:.2f}, {smallest[2]:.2f}",
          lambda n: min(n.smallest) > 0.0, SIGN_TOLERANCE_REASON),
    PaperClaim("from c = 220 on the wheel walks, but not with period 1", "§5.2",
          "stable, not 1-period",
          "walks on: {yes_or_no}; change per step {change:.1g} or more, at c = 220 … {end:.0f}",
          lambda n: n.walks_on and n.never_settles and n.change > 1e-4,
          "1e-4: ten thousand times the change that counts as settled"),
    PaperClaim("the loss is abrupt: DLS does not decrease to zero as λ4⁺ → 0",
          INDEPENDENT_CODE_LABEL,
          "53 %", "{share:.1f} % at c = 219", make_agreement_test(share=(53.0, 0.5)),
          "half a per cent: published as a whole number"),
    PaperClaim("at c = 200 the basin is small: a start with 2 rad/s leaves the sequence of phases",
          INDEPENDENT_CODE_LABEL, "touchdown before Leg 2 is back", "{too_fast_ends}",
          lambda n: n.too_fast == Outcome.TOUCHDOWN_BEFORE_STOPPER.name, "an outcome"),
))
# fmt: on


def _compute_assumption_values(paper_evidence: PaperEvidence) -> ClaimValues:
    """Compute the values that the claims on the model's assumptions need, by name.

    The claims concern the gait of Table 1 of the paper.
    """
    table_1_gait = paper_evidence.table_1_gait
    first_step_trajectory = paper_evidence.first_step_trajectory
    double_support, *_ = split_trajectory_by_phase(first_step_trajectory)
    natural_length = float(paper_evidence.params.natural_length)
    locked_length = float(paper_evidence.params.locked_length)
    stopper_impulses_per_mass = table_1_gait.landing_stopper_impulse.values / float(
        paper_evidence.params.leg_mass
    )
    separation_speeds = np.sort(stopper_impulses_per_mass[stopper_impulses_per_mass < 0.0])
    landing_impulse = compute_printed_landing(
        paper_evidence.params, table_1_gait.section_state.values
    ).corrected_impulse
    required_friction = np.abs(
        double_support.lambda_3.values[:-1] / double_support.lambda_4.values[:-1]
    )
    phase_codes = first_step_trajectory.phase.values
    phase_order = [
        PHASE_NAMES[int(p)] for p in phase_codes[np.r_[0, np.flatnonzero(np.diff(phase_codes)) + 1]]
    ]
    margin_names = (
        "fore_foot_force",
        "rear_stopper_force",
        "energy_lost_landing",
        "hit_planted_impulse",
    )
    return {margin_name: float(table_1_gait[margin_name]) for margin_name in margin_names} | {
        "rear_force": double_support.lambda_4[:-1].min(),
        "last_rear_force": abs(float(double_support.lambda_4[-1])),
        "clearance": min(float(table_1_gait.clearance_sls1), float(table_1_gait.clearance_sls2)),
        "locked_force": table_1_gait.locked_stopper_force.min(),
        "preload": float(paper_evidence.params.stiffness) * (natural_length - locked_length),
        "contraction": locked_length - float(first_step_trajectory.L1[1:].max()),
        "order": " → ".join(phase_order),
        "back_in_time": phase_order == list(PHASE_NAMES)
        and float(double_support.L2.max()) < locked_length,
        "friction_fore": np.abs(
            first_step_trajectory.lambda_1 / first_step_trajectory.lambda_2
        ).max(),
        "friction_rear": required_friction[0],
        "friction_last": required_friction[-1],
        "last_tangential": double_support.lambda_3[-1],
        "in_landing_rear": abs(landing_impulse[2]) / landing_impulse[3],
        "in_landing_fore": abs(landing_impulse[0]) / landing_impulse[1],
        "thrown": (separation_speeds[-1], separation_speeds[0])
        if separation_speeds.size
        else (np.nan, np.nan),
        "n_thrown": separation_speeds.size,
        "thrown_off": f"{separation_speeds.size} of {stopper_impulses_per_mass.size}, "
        f"{separation_speeds[-1]:.2f} … "
        f"{separation_speeds[0]:.2f} m/s"
        if separation_speeds.size
        else "none",
    }


# fmt: off
ASSUMPTION_CLAIMS = PaperClaimGroup(
    "Assumptions of the model at Table 1",
    _compute_assumption_values, (
    PaperClaim("Leg 1 pushes on the ground: least λ2", INDEPENDENT_CODE_LABEL, "103.9 N",
          "{fore_foot_force:.1f} N", make_agreement_test(fore_foot_force=(103.9, 0.05))),
    PaperClaim("Leg 2 pushes in DLS: least λ4", INDEPENDENT_CODE_LABEL, "≥ 0, 0 at its end",
          "{rear_force:.2f} N before the end, {last_rear_force:.0e} N there",
          lambda n: n.rear_force > 0.0 and n.last_rear_force < 1e-6,
          "1e-6 N: the event's accuracy"),
    PaperClaim("the swinging foot does not touch the ground", INDEPENDENT_CODE_LABEL, "≥ 0",
          "{clearance:.3f} m at its first minimum", lambda n: n.clearance >= 0.0,
          SIGN_TOLERANCE_REASON),
    PaperClaim("stopper force of the six locked legs, of 10 N preload", INDEPENDENT_CODE_LABEL,
          "0.95 N: near the edge", "{locked_force:.3f} N of {preload:.0f} N",
          make_agreement_test(locked_force=(0.95, 0.02), preload=(10.0, STEP_ERROR_TOLERANCE)),
          "0.02 N: a least value read off samples lies above the one located here"),
    PaperClaim("stopper force of Leg 2 in SLS-II", INDEPENDENT_CODE_LABEL, "17 N",
          "{rear_stopper_force:.2f} N", make_agreement_test(rear_stopper_force=(17.0, 0.5))),
    PaperClaim("Leg 1 stays below L0 after landing", INDEPENDENT_CODE_LABEL, "L0 − L1 ≥ 0",
          "{contraction:.4f} m after the first sample", lambda n: n.contraction > 0.0,
          SIGN_TOLERANCE_REASON),
    PaperClaim("Leg 2 reaches L0 after DLS and before touchdown", INDEPENDENT_CODE_LABEL,
          "holds", "{order}", lambda n: n.back_in_time, "the order of events"),
    PaperClaim("friction that Leg 1 needs", INDEPENDENT_CODE_LABEL, "0.61",
          "{friction_fore:.3f}", make_agreement_test(friction_fore=(0.61, 5e-3))),
    PaperClaim("friction that Leg 2 needs just after landing", INDEPENDENT_CODE_LABEL, "14.2",
          "{friction_rear:.2f}", make_agreement_test(friction_rear=(14.2, 0.05))),
    PaperClaim("this friction grows without bound as λ4 → 0", INDEPENDENT_CODE_LABEL,
          "λ3 does not vanish with λ4",
          "λ3 = {last_tangential:.1f} N at the end of DLS; {friction_last:.0f} one sample before",
          lambda n: abs(n.last_tangential) > 1.0 and n.friction_last > 14.2,
          "λ3 above 1 N where λ4 is 0"),
    PaperClaim("friction needed in the landing impulse, rear and fore foot", INDEPENDENT_CODE_LABEL,
          "9.7 and 1.10", "{in_landing_rear:.2f} and {in_landing_fore:.3f}",
          make_agreement_test(in_landing_rear=(9.7, 0.05), in_landing_fore=(1.10, 5e-3))),
    PaperClaim("energy lost in the landing", INDEPENDENT_CODE_LABEL, "7.58 J",
          "{energy_lost_landing:.3f} J", make_agreement_test(energy_lost_landing=(7.58, 5e-3))),
    PaperClaim("at the landing four of the six locked legs leave their stoppers",
          INDEPENDENT_CODE_LABEL,
          "−0.24 … −0.86 m/s", "{thrown_off}",
          make_agreement_test(n_thrown=(4, 0), thrown=((-0.24, -0.86), 5e-3))),
    PaperClaim("collision II requires a slightly negative impulse at the planted foot",
          INDEPENDENT_CODE_LABEL, "−4e-4 N·s", "{hit_planted_impulse:.1e} N·s",
          make_agreement_test(hit_planted_impulse=(-4e-4, 5e-5))),
))
# fmt: on


FACTS_PAGE_INTRODUCTION = (
    "The paper is *Modeling and analysis of passive viscoelastic-legged rimless wheel that "
    "generates measurable period of double-limb support*. “Independent code” is a solver in the "
    "paper's five constrained coordinates. This solver is the reference if the paper prints no "
    "number, or only a curve. A tolerance is half a unit of the last published digit unless the "
    "table gives another reason."
)

PAPER_CLAIM_GROUPS = (
    TYPICAL_GAIT_CLAIMS,
    DAMPING_CLAIMS,
    INDICATOR_CLAIMS,
    ASSUMPTION_CLAIMS,
    MISPRINT_CLAIMS,
)


def compute_paper_facts(paper_evidence: PaperEvidence) -> list[PaperFact]:
    """Return the facts for all groups of claims."""
    return [
        paper_fact
        for claim_group in PAPER_CLAIM_GROUPS
        for paper_fact in claim_group.make_facts(paper_evidence)
    ]


def summarize_paper_facts(paper_facts: Sequence[PaperFact]) -> str:
    """Return a sentence that states how many facts hold, and the sources of their published
    values.
    """
    n_facts = len(paper_facts)
    n_facts_from_reference_code = sum(
        paper_fact.is_from_reference_code for paper_fact in paper_facts
    )
    n_facts_that_hold = sum(paper_fact.holds for paper_fact in paper_facts)
    return (
        f"{n_facts_that_hold} of {n_facts} facts hold: {n_facts - n_facts_from_reference_code} "
        f"with published numbers, {n_facts_from_reference_code} with independent code"
    )


CORRECTED_STATEMENTS = (
    "The paper describes gaits only at dampings at which its model is valid. The section "
    "“Corrections of the paper” of the page `docs/studies/beyond_the_border.md` contains computed "
    "walks at other dampings. From c = 220 N s/m on, the paper's model has cycles of seven to four "
    "steps. With unilateral contact, gaits of one step there have 44 to 50 % double support. At "
    "dampings of 4 N s/m and below, the fore foot does not bounce with unilateral contact and μ = "
    "15. At c = 50 and 100 N s/m, the wheel has a gait of one step although its rear foot scuffs."
)
"""Paragraph about statements of the paper that computed walks correct. A table of the page
`docs/studies/beyond_the_border.md` contains the walks.
"""


def format_facts_page(paper_facts: Sequence[PaperFact]) -> str:
    """Return the table of facts as a Markdown page."""
    failed_facts = [paper_fact for paper_fact in paper_facts if not paper_fact.holds]
    page_lines = [
        "# The paper's facts",
        "",
        "This page compares every number that the paper publishes with the computed number. "
        "`vrw reproduce --out results` writes this page and the figures.",
        "",
        f"{summarize_paper_facts(paper_facts)}."
        + (
            ""
            if not failed_facts
            else " Not: " + "; ".join(paper_fact.claim for paper_fact in failed_facts) + "."
        ),
        "",
        FACTS_PAGE_INTRODUCTION,
        "",
        "Figure 10 uses the slope 0.30 rad. Section 5.2 prints 0.10, but at this slope the gaits "
        "do not agree with the numbers of the figure (last group). With Coulomb friction the rear "
        "foot would slip in the landing. The paper assumes that the foot does not slip, "
        "and so does this model.",
    ]
    for group_title, facts_of_group in itertools.groupby(
        paper_facts, lambda paper_fact: paper_fact.group
    ):
        facts_table_rows = []
        for paper_fact in facts_of_group:
            verdict_text = paper_fact.verdict if paper_fact.holds else f"**{paper_fact.verdict}**"
            table_cell_texts = (
                paper_fact.claim,
                paper_fact.source,
                paper_fact.published_value,
                paper_fact.computed,
                verdict_text,
                paper_fact.tolerance_reason,
            )
            # Minus signs replace the hyphens before numbers.
            facts_table_rows.append(
                [
                    re.sub(r"(?<![\w.])-(?=\d)", "−", table_cell_text)
                    for table_cell_text in table_cell_texts
                ]
            )
        column_headings = ("fact", "where", "published", "found", "", "tolerance")
        page_lines += [
            "",
            f"## {group_title}",
            "",
            *format_markdown_table(column_headings, facts_table_rows),
        ]
    page_lines += ["", "## Corrected statements of the paper", "", CORRECTED_STATEMENTS]
    return "\n".join(page_lines) + "\n"


def write_facts_files(paper_facts: Sequence[PaperFact], folder: Path) -> None:
    """Write the table of facts to facts.md and facts.csv."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "facts.md").write_text(format_facts_page(paper_facts), encoding="utf-8")
    with (folder / "facts.csv").open("w", newline="", encoding="utf-8") as csv_file:
        fact_rows = [
            asdict(paper_fact) | {"holds": paper_fact.verdict} for paper_fact in paper_facts
        ]
        csv_writer = csv.DictWriter(csv_file, fact_rows[0].keys())
        csv_writer.writeheader()
        csv_writer.writerows(fact_rows)


ReproductionProgressCallback = Callable[[float, str], None]
"""Function that is called with the completed fraction, 0 to 1, and the name of the current task."""

FIGURE_8_AND_9_DAMPINGS = (50.0, 100.0, 200.0)
"""Damping in Figs 8 and 9 of the paper, N s/m."""


def ignore_progress(completed_fraction: float, task_name: str) -> None:
    """Ignore a report of progress."""


def walk_into_table_1_gait() -> xr.Dataset:
    """Simulate the walk from the paper's start into the gait of Table 1 of the paper."""
    return walk_into_gait(WheelParams(), paper_start())


def find_table_1_section_state() -> Array:
    """Return the section state of the gait of Table 1 of the paper."""
    return jnp.asarray(walk_into_table_1_gait().section_state.values[-1])


def simulate_table_1_gait(n_steps: int = 3) -> xr.Dataset:
    """Return the trajectory of the gait of Table 1 of the paper, for Figs 6 and 7.

    The slope is 0.30 rad.
    """
    return simulate(
        WheelParams(), find_table_1_section_state(), n_steps, model=make_formally_continued_model()
    )


def simulate_gaits_at_dampings(dampings: Sequence[float]) -> list[xr.Dataset]:
    """Return the trajectory of one step of the gait for each value of `dampings`, for Figs 8 and 9.

    The values may be 1 to 219 N s/m. From walk to walk, the damping changes by at most 10 N s/m,
    beginning at that of Table 1 of the paper.
    """
    start_state = find_table_1_section_state()
    table_1_wheel, gait_trajectories = WheelParams(), []
    for damping in dampings:
        start_damping = float(table_1_wheel.damping)
        n_dampings = 1 + math.ceil(abs(damping - start_damping) / 10.0)
        dampings_on_path = np.linspace(start_damping, damping, n_dampings).tolist()
        *_, gait_walk = walk_along_parameter(
            table_1_wheel, "damping", dampings_on_path, start_state
        )
        if not gait_walk.settled:
            raise ValueError(f"No period-1 gait was met at damping {damping:g}: choose 1 to 219.")
        section_state = jnp.asarray(gait_walk.section_state.values[-1])
        gait_trajectories.append(
            simulate(
                replace_wheel_parameter(table_1_wheel, "damping", damping),
                section_state,
                1,
                model=make_formally_continued_model(),
            )
        )
    return gait_trajectories


def collect_paper_evidence(
    on_progress: ReproductionProgressCallback = ignore_progress,
) -> PaperEvidence:
    """Simulate all walks that the facts and figures use."""
    table_1_wheel = WheelParams()
    on_progress(0.0, "walk from the start for Table 1")
    settling_walk = walk_into_table_1_gait()
    fast_start_walk = walk_into_gait(table_1_wheel, jnp.asarray((0.1, 2.0, -0.1)))

    task_name = "gaits along c from 1 to 224"
    on_progress(0.1, task_name)
    report = lambda fraction: on_progress(0.1 + 0.5 * fraction, task_name)
    start = table_1_wheel, "damping"
    table_1_state = find_table_1_section_state()
    damping_branch = xr.concat(
        [
            measure_gaits_along_parameter(*start, range(200, 0, -1), table_1_state, report),
            measure_gaits_along_parameter(*start, range(201, 225), table_1_state),
        ],
        "damping",
        data_vars="minimal",
        combine_attrs="override",
    )

    on_progress(0.65, "gaits at slope 0.10")
    start_state = jnp.asarray(damping_branch.section_state.sel(damping=100.0).values)
    slope_values = [0.01 * i for i in range(30, 9, -1)]
    medium_damping_wheel = replace_wheel_parameter(table_1_wheel, "damping", 100.0)
    gentle_slope_wheel = replace_wheel_parameter(table_1_wheel, "slope", 0.10)
    slope_branch = measure_gaits_along_parameter(
        medium_damping_wheel, "slope", slope_values, start_state
    )
    start_state = jnp.asarray(slope_branch.section_state.sel(slope=0.10, method="nearest").values)
    gentle_slope_branch = measure_gaits_along_parameter(
        gentle_slope_wheel, "damping", range(100, 221, 10), start_state
    )
    low_dampings = [*range(100, 0, -10), 5, 4]
    gentle_slope_low_damping_branch = measure_gaits_along_parameter(
        gentle_slope_wheel, "damping", low_dampings, start_state
    )

    on_progress(0.7, "trajectories")
    return PaperEvidence(
        params=table_1_wheel,
        settling_walk=settling_walk,
        table_1_trajectory=simulate_table_1_gait(),
        gaits_by_damping=simulate_gaits_at_dampings(FIGURE_8_AND_9_DAMPINGS),
        damping_branch=damping_branch,
        slope_branch=slope_branch,
        gentle_slope_branch=gentle_slope_branch,
        gentle_slope_low_damping_branch=gentle_slope_low_damping_branch,
        fast_start_walk=fast_start_walk,
    )


def write_paper_figures(paper_evidence: PaperEvidence, folder: Path) -> None:
    """Write Figs 6 to 10 as SVG and PNG files, and the walk as a GIF file."""
    two_step_trajectory = paper_evidence.table_1_trajectory.isel(
        time=paper_evidence.table_1_trajectory.step.values < 2
    )
    figure_by_name = {
        "fig06_gait": plots.gait_panels(paper_evidence.table_1_trajectory),
        "fig07_sticks": plots.sticks(two_step_trajectory),
        "fig08_scuffing": plots.foot_height(paper_evidence.gaits_by_damping),
        "fig09_rear_force": plots.rear_force(paper_evidence.gaits_by_damping),
        "fig10_indicators": plots.indicators(paper_evidence.damping_branch),
    }
    for figure_name, figure in figure_by_name.items():
        plots.save(figure, folder, figure_name)
    frame_images, frame_duration_ms = plots.walk_frames(paper_evidence.gaits_by_damping[-1])
    plots.save_animation(frame_images, frame_duration_ms, folder / "walk.gif")


def reproduce_paper(
    folder: str | Path, on_progress: ReproductionProgressCallback = ignore_progress
) -> list[PaperFact]:
    """Write all figures and the table of facts into `folder`, and return the facts.

    The table is in `facts.md` and `facts.csv`. The values that Fig. 10 shows are in
    `indicators.csv`.

    - `on_progress`: function that is called with the completed fraction and the name of the current
      task.
    """
    folder = check_path("folder", folder, 'give a folder, such as "results/reproduction"')
    paper_evidence = collect_paper_evidence(on_progress)
    on_progress(0.8, "figures")
    write_paper_figures(paper_evidence, folder)
    on_progress(0.98, "table of facts")
    paper_facts = compute_paper_facts(paper_evidence)
    write_facts_files(paper_facts, folder)
    indicator_table = paper_evidence.damping_branch.drop_dims(["leg", "component"]).to_dataframe()
    indicator_table.to_csv(folder / "indicators.csv", float_format="%.10g")
    on_progress(1.0, "done")
    return paper_facts
