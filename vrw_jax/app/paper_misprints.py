"""Misprints of the paper, each with computed values that show the misprint."""

import numpy as np

from vrw_jax.app import paper_printed as printed
from vrw_jax.app.paper_fact import (
    STEP_ERROR_TOLERANCE,
    ClaimValues,
    PaperClaim,
    PaperClaimGroup,
    PaperEvidence,
    make_agreement_test,
)
from vrw_jax.wheel.outcomes import Outcome


def _compute_misprint_values(paper_evidence: PaperEvidence) -> ClaimValues:
    """Compute the values that the claims on misprints need, by name.

    The values follow from equations as printed in the paper and from corrected equations.
    """
    section_state = paper_evidence.table_1_gait.section_state.values
    library_landing_impulse = float(paper_evidence.table_1_gait.lambda_I4)
    printed_landing = printed.compute_printed_landing(paper_evidence.params, section_state)
    reference_foot_velocity = printed.differentiate_landing_foot_position(
        paper_evidence.params, section_state
    )
    foot_velocity_error_function = lambda rate: np.abs(
        printed.compute_landing_foot_velocity(paper_evidence.params, section_state, rate)
        - reference_foot_velocity
    ).max()
    gentle_slope_gait = paper_evidence.slope_branch.sel(slope=0.10, method="nearest")
    gentle_slope_branch = paper_evidence.gentle_slope_branch
    low_damping_gait = paper_evidence.gentle_slope_low_damping_branch.sel(damping=4.0)
    return {
        "wrong": printed.compute_constraint_violation(
            paper_evidence.table_1_trajectory, is_as_printed=True
        ),
        "right": printed.compute_constraint_violation(
            paper_evidence.table_1_trajectory, is_as_printed=False
        ),
        "residual": printed_landing.momentum_residual,
        "velocities": np.array_equal(
            printed_landing.impulse_as_printed, printed_landing.coordinate_rates_after
        ),
        "impulse": printed_landing.corrected_impulse[3],
        "here": library_landing_impulse,
        "off": abs(printed_landing.corrected_impulse[3] - library_landing_impulse),
        "off_new": foot_velocity_error_function(0.0),
        "off_old": foot_velocity_error_function(section_state[2]),
        "slow_settled": gentle_slope_gait.settled,
        "share": 100.0 * gentle_slope_gait.dls_fraction,
        "period": gentle_slope_gait.period,
        "rear": gentle_slope_branch.lambda_4_plus.where(gentle_slope_branch.settled).min(),
        "last": gentle_slope_branch.damping.where(gentle_slope_branch.settled).max(),
        "end": gentle_slope_branch.damping.max(),
        "end_walks": gentle_slope_branch.settled[-1],
        "end_outcome": Outcome(int(gentle_slope_branch.outcome[-1])).name.lower().replace("_", " "),
        "low": low_damping_gait.lambda_2_plus,
        "low_settled": low_damping_gait.settled,
    }


# fmt: off
MISPRINT_CLAIMS = PaperClaimGroup(
    "Misprints of the paper, with the evidence", _compute_misprint_values, (
    PaperClaim("eq. (11): J43 must be −L1 sin θ + L2 sin(θ+α)", "eq. (11)",
          "−L1 sin θ − L2 sin(θ+α)",
          "J q̇ reaches {wrong:.2f} m/s as printed, {right:.0e} corrected (must be 0)",
          lambda n: n.wrong > 0.1 and n.right < 1e-12,
          "1e-12 m/s: rounding; as printed far from it"),
    PaperClaim("eq. (35): the impulse is −X⁻¹ J q̇†", "eq. (35)", "the projector of eq. (20)",
          "as printed five numbers, eq. (20)'s velocities; corrected M Δq̇ = Jᵀ λ_I to "
          "{residual:.0e} N·s, λ_I4 = {impulse:.4f}, here {here:.4f} N·s",
          lambda n: n.velocities and n.residual < 1e-10 and n.off <= STEP_ERROR_TOLERANCE,
          "1e-10 N·s: rounding; λ_I4 to the error of a step"),
    PaperClaim("eqs (16), (17): L̇1 without a superscript is L̇1⁻", "eqs (16), (17)", "L̇1",
          "landing foot's velocity off by {off_old:.0e} m/s with L̇1⁻, "
          "by {off_new:.2f} with the new L̇1 = 0",
          lambda n: n.off_old < 1e-8 and n.off_new > 1e-2,
          "1e-8 m/s: error of the difference quotient"),
    PaperClaim("§5.2 prints φ = 0.10 for Fig. 10, where gaits are nearly at rest", "§5.2",
          "c = 100: 96 % DLS, T ≈ 4.5 s (independent code)",
          "{share:.1f} % DLS, T = {period:.2f} s",
          lambda n: n.slow_settled and make_agreement_test(share=(96.0, 0.5), period=(4.5,
          0.05))(n)),
    PaperClaim("λ4⁺ does not vanish at c = 220 at φ = 0.10", "§5.2",
          "0 at 220 (at φ = 0.30 it is)",
          "λ4⁺ ≥ {rear:.0f} N up to c = {last:.0f}; at c = {end:.0f}: {end_outcome}",
          lambda n: n.rear > 10.0 and not n.end_walks,
          "10 N: far from zero; no gait left at 220 for λ4⁺ to vanish on"),
    PaperClaim("λ2⁺ does not vanish at c = 4 at φ = 0.10", "§5.2", "0 at 4 (at φ = 0.30 it is)",
          "λ2⁺ = {low:.1f} N at c = 4", lambda n: n.low > 1.0 and n.low_settled,
          "1 N: far from zero"),
))
# fmt: on
