"""Equations of the paper in printed and in corrected form, if computed values can distinguish them.

The equations use the paper's five coordinates q = (x, z, theta, L1, L2). The simulator provides
only the mass matrix and the momentum.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr
from jaxtyping import Array

from vrw_jax.app.paper_evidence import (
    STEP_ERROR_TOLERANCE,
    ClaimValues,
    PaperClaim,
    PaperClaimGroup,
    PaperEvidence,
    make_agreement_test,
)
from vrw_jax.base.outcomes import Outcome
from vrw_jax.wheel.dynamics import (
    Motion,
    compute_length_at_touchdown,
    compute_mass_matrix,
    compute_momentum,
)
from vrw_jax.wheel.params import Symbols, WheelParams

_compute_length_at_touchdown = jax.jit(compute_length_at_touchdown)


def _compute_symbols_and_touchdown_length(params: WheelParams, theta: float) -> tuple[Any, float]:
    """Return the parameters by their symbols in the paper, and the length of Leg 1 at touchdown, m,
    as Python floats.
    """
    s = params.symbols()
    return jax.tree.map(float, s), float(_compute_length_at_touchdown(s, jnp.asarray(theta)))


def compute_double_support_jacobian(
    theta: np.ndarray, L1: np.ndarray, L2: np.ndarray, alpha: float, is_as_printed: bool
) -> np.ndarray:
    """Return the Jacobian J_DLS of eq. (11) of the paper, shape (..., 4, 5).

    The sign of its entry J43 is misprinted.

    - `is_as_printed`: whether the entry J43 has the printed sign.
    """
    fore_sine, fore_cosine = np.sin(theta), np.cos(theta)
    rear_sine, rear_cosine = np.sin(theta + alpha), np.cos(theta + alpha)
    printed_entry_sign = -1.0 if is_as_printed else 1.0
    J43 = -L1 * fore_sine + printed_entry_sign * L2 * rear_sine
    jacobian = np.zeros((*np.shape(theta), 4, 5))
    jacobian[..., :2, :2] = jacobian[..., 2:, :2] = np.eye(2)
    jacobian[..., 2, 2:] = np.stack(
        [L1 * fore_cosine - L2 * rear_cosine, fore_sine, -rear_sine], axis=-1
    )
    jacobian[..., 3, 2:] = np.stack([J43, fore_cosine, -rear_cosine], axis=-1)
    return jacobian


def compute_constraint_violation(walk_trajectory: xr.Dataset, is_as_printed: bool) -> float:
    """Return the largest speed of a foot in double support, m/s.

    The speed is J q' of eq. (2) of the paper, evaluated for all samples of a walk.
    """
    double_support = walk_trajectory.isel(time=walk_trajectory.phase.values == 0)
    theta, L1, L2 = (double_support[name].values for name in ("theta", "L1", "L2"))
    alpha = 2.0 * np.pi / walk_trajectory.attrs["parameter_n_legs"]
    J = compute_double_support_jacobian(theta, L1, L2, alpha, is_as_printed)
    rate_names = ("dx", "dz", "dtheta", "dL1", "dL2")
    coordinate_rates = np.stack([double_support[name].values for name in rate_names], axis=-1)
    return float(np.abs(np.einsum("tij,tj->ti", J, coordinate_rates)).max())


class PrintedLandingResult(NamedTuple):
    """Result of collision I by eqs (15)-(21) and (33)-(35) of the paper, corrected and as
    printed.
    """

    coordinate_rates_after: np.ndarray  # q'+ of eq. (20)
    corrected_impulse: np.ndarray  # lambda_I = -X^-1 J q'
    impulse_as_printed: np.ndarray  # eq. (35) as printed: five numbers
    momentum_residual: float  # largest |M (q'+ - q') - J^T lambda_I|, N s


def compute_printed_landing(params: WheelParams, section_state: np.ndarray) -> PrintedLandingResult:
    """Compute collision I in five coordinates from the section state (theta-, dtheta-, dL1-)."""
    touchdown_angle, touchdown_rate, dL1 = section_state
    s, touchdown_length = _compute_symbols_and_touchdown_length(params, touchdown_angle)
    foot_velocity = compute_landing_foot_velocity(params, section_state, leg_1_rate=dL1)
    coordinate_rates_before = np.array([*foot_velocity, touchdown_rate, 0.0, dL1])
    theta, L1, L2 = map(np.asarray, (touchdown_angle - s.alpha, s.L0, touchdown_length))
    J = compute_double_support_jacobian(theta, L1, L2, s.alpha, is_as_printed=False)
    M = np.asarray(compute_five_coordinate_mass_matrix(s, *map(jnp.asarray, (theta, L1, L2))))
    inverse_mass_matrix = np.linalg.inv(M)
    X = J @ inverse_mass_matrix @ J.T
    velocity_projector = np.eye(5) - inverse_mass_matrix @ J.T @ np.linalg.solve(X, J)
    coordinate_rates_after = velocity_projector @ coordinate_rates_before
    landing_impulse = -np.linalg.solve(X, J @ coordinate_rates_before)
    momentum_error = M @ (coordinate_rates_after - coordinate_rates_before) - J.T @ landing_impulse
    return PrintedLandingResult(
        coordinate_rates_after,
        landing_impulse,
        velocity_projector @ coordinate_rates_before,
        float(np.abs(momentum_error).max()),
    )


@jax.jit
def compute_five_coordinate_mass_matrix(s: Symbols, theta: Array, L1: Array, L2: Array) -> Array:
    """Return the mass matrix M(q) of eq. (1) of the paper, shape (5, 5).

    It consists of the mass matrix for a planted foot, and of the momentum due to a moving foot.
    """
    planted_mass_matrix = compute_mass_matrix(s, L1, L2)
    unit_vectors = jnp.eye(3)
    internal_mass_block = jnp.array(
        [planted_mass_matrix.multiply_vector(tuple(unit_vector)) for unit_vector in unit_vectors]
    )
    foot_momentum = jnp.array(
        [
            compute_momentum(s, Motion.from_angle(theta, L1, L2, *unit_vector))
            for unit_vector in unit_vectors
        ]
    )
    return jnp.block([[s.Mt * jnp.eye(2), foot_momentum.T], [foot_momentum, internal_mass_block]])


def compute_landing_foot_velocity(
    params: WheelParams, section_state: np.ndarray, leg_1_rate: float
) -> np.ndarray:
    """Return the velocity (x, z) of the landing foot by eqs (16) and (17) of the paper, m/s.

    - `leg_1_rate`: time derivative of L1 in these equations, m/s.
    """
    touchdown_angle, touchdown_rate, _ = section_state
    s, touchdown_length = _compute_symbols_and_touchdown_length(params, touchdown_angle)
    L0, alpha = s.L0, s.alpha
    x = (
        touchdown_length * np.cos(touchdown_angle) - L0 * np.cos(alpha - touchdown_angle)
    ) * touchdown_rate + leg_1_rate * np.sin(touchdown_angle)
    z = -(
        touchdown_length * np.sin(touchdown_angle) + L0 * np.sin(alpha - touchdown_angle)
    ) * touchdown_rate + leg_1_rate * np.cos(touchdown_angle)
    return np.array([x, z])


def differentiate_landing_foot_position(
    params: WheelParams, section_state: np.ndarray
) -> np.ndarray:
    """Return the velocity (x, z) of the landing foot, m/s, computed by central differences.

    The result is accurate to 1e-11 m/s.
    """
    h = 1e-6  # The step is in s; the error is proportional to its square.
    touchdown_angle, touchdown_rate, dL1 = section_state
    s, touchdown_length = _compute_symbols_and_touchdown_length(params, touchdown_angle)

    def compute_foot_position(t: float) -> np.ndarray:
        """Return the position (x, z) of the landing foot, m, at the time t, s."""
        wheel_angle, leg_length = touchdown_angle + touchdown_rate * t, touchdown_length + dL1 * t
        hub_position = leg_length * np.array([np.sin(wheel_angle), np.cos(wheel_angle)])
        landing_angle = wheel_angle - s.alpha
        return hub_position - s.L0 * np.array([np.sin(landing_angle), np.cos(landing_angle)])

    return (compute_foot_position(h) - compute_foot_position(-h)) / (2.0 * h)


def _compute_misprint_values(paper_evidence: PaperEvidence) -> ClaimValues:
    """Compute the values that the claims on misprints need, by name.

    The values follow from equations as printed in the paper and from corrected equations.
    """
    section_state = paper_evidence.table_1_gait.section_state.values
    library_landing_impulse = float(paper_evidence.table_1_gait.lambda_I4)
    printed_landing = compute_printed_landing(paper_evidence.params, section_state)
    reference_foot_velocity = differentiate_landing_foot_position(
        paper_evidence.params, section_state
    )
    foot_velocity_error_function = lambda rate: np.abs(
        compute_landing_foot_velocity(paper_evidence.params, section_state, rate)
        - reference_foot_velocity
    ).max()
    gentle_slope_gait = paper_evidence.slope_branch.sel(slope=0.10, method="nearest")
    gentle_slope_branch = paper_evidence.gentle_slope_branch
    low_damping_gait = paper_evidence.gentle_slope_low_damping_branch.sel(damping=4.0)
    return {
        "wrong": compute_constraint_violation(
            paper_evidence.table_1_trajectory, is_as_printed=True
        ),
        "right": compute_constraint_violation(
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
