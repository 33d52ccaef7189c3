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
