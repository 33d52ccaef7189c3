"""Where the paper is misprinted, each with the numbers that show it."""

import math

import numpy as np

from vrw_jax.paper.facts import printed
from vrw_jax.paper.facts.base import DIGIT, ROUND_OFF, Evidence, Fact, near
from vrw_jax.wheel import Outcome


def misprint_facts(e: Evidence) -> list[Fact]:
    group = "Misprints of the paper, with the evidence"
    wrong, right = (printed.constraint_violation(e.gait, as_printed=p) for p in (True, False))
    state = e.table_1.section_state.values
    landing = printed.landing(e.params, state)
    here = float(e.table_1.lambda_I4)
    reference = printed.landing_foot_velocity_by_differences(e.params, state)
    of_new, of_old = (
        float(np.abs(printed.landing_foot_velocity(e.params, state, rate) - reference).max())
        for rate in (0.0, float(state[2]))
    )
    slow = e.gentler.sel(slope=0.10, method="nearest")
    period, share = float(slow.period), 100.0 * float(slow.dls_fraction)
    walking = e.gentle.settled.values
    last = float(e.gentle.damping.values[walking].max()) if walking.any() else math.nan
    least_rear = float(e.gentle.lambda_4_plus.values[walking].min()) if walking.any() else math.nan
    next_outcome = Outcome(int(e.gentle.outcome.values[-1])).name.lower().replace("_", " ")
    low = float(e.gentle_low.lambda_2_plus.sel(damping=4.0))
    return [
        Fact(
            group,
            "eq. (11): J43 must be −L1 sin θ + L2 sin(θ+α)",
            "eq. (11)",
            "−L1 sin θ − L2 sin(θ+α)",
            f"J q̇ reaches {wrong:.2f} m/s as printed, {right:.0e} mended (must be 0)",
            wrong > 0.1 and right < 1e-12,
            "1e-12 m/s: rounding; as printed far from it",
        ),
        Fact(
            group,
            "eq. (35): the impulse is −X⁻¹ J q̇†",
            "eq. (35)",
            "the projector of eq. (20)",
            f"as printed five numbers, eq. (20)'s velocities; mended M Δq̇ = Jᵀ λ_I to "
            f"{landing.residual:.0e} N·s, λ_I4 = {landing.impulse[3]:.4f}, here {here:.4f} N·s",
            landing.printed.size == 5
            and bool(np.array_equal(landing.printed, landing.after))
            and landing.residual < 1e-10
            and near(landing.impulse[3], here, ROUND_OFF),
            "1e-10 N·s: rounding; λ_I4 to the error of a step",
        ),
        Fact(
            group,
            "eqs (16), (17): the bare L̇1 is L̇1⁻",
            "eqs (16), (17)",
            "L̇1",
            f"landing foot's velocity off by {of_old:.0e} m/s with L̇1⁻, "
            f"by {of_new:.2f} with the new L̇1 = 0",
            of_old < 1e-8 and of_new > 1e-2,
            "1e-8 m/s: error of the difference quotient",
        ),
        Fact(
            group,
            "§5.2 prints φ = 0.10 for Fig. 10: there gaits are nearly at rest",
            "§5.2",
            "c = 100: 96 % DLS, T ≈ 4.5 s (independent code)",
            f"{share:.1f} % DLS, T = {period:.2f} s",
            bool(slow.settled) and near(share, 96.0, 0.5) and near(period, 4.5, 0.05),
            DIGIT,
        ),
        Fact(
            group,
            "and λ4⁺ does not vanish at c = 220 at φ = 0.10",
            "§5.2",
            "0 at 220 (at φ = 0.30 it is)",
            f"λ4⁺ ≥ {least_rear:.0f} N up to c = {last:.0f}; at c = "
            f"{float(e.gentle.damping.max()):.0f}: {next_outcome}",
            least_rear > 10.0 and not walking[-1],
            "10 N: far from zero; no gait left at 220 for λ4⁺ to vanish on",
        ),
        Fact(
            group,
            "and λ2⁺ does not vanish at c = 4 at φ = 0.10",
            "§5.2",
            "0 at 4 (at φ = 0.30 it is)",
            f"λ2⁺ = {low:.1f} N at c = 4",
            low > 1.0 and bool(e.gentle_low.settled.sel(damping=4.0)),
            "1 N: far from zero",
        ),
    ]
