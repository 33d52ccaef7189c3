"""Equations of the paper as printed and in corrected form, if numbers can distinguish the two.

They use the five coordinates q = (x, z, theta, L1, L2) of the paper, and share only the mass matrix
and the momentum with the simulator.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr
from jaxtyping import Array

from vrw_jax.numerics import Scalar
from vrw_jax.wheel import Motion, Symbols, WheelParams, length_at_touchdown, mass_matrix, momentum


@jax.jit
def _compute_touchdown(params: WheelParams, theta: float) -> tuple[Symbols, Array]:
    """Return the symbols of the paper, and the length of Leg 1 at touchdown in m."""
    s = params.symbols()
    return s, length_at_touchdown(s, jnp.asarray(theta))


def compute_double_support_jacobian(
    theta: np.ndarray, L1: np.ndarray, L2: np.ndarray, alpha: float, is_as_printed: bool
) -> np.ndarray:
    """Return J_DLS of eq. (11), shape (..., 4, 5); the misprint is the sign in J43."""
    zeros, ones = np.zeros_like(theta), np.ones_like(theta)
    sin, cos = np.sin(theta), np.cos(theta)
    rear_sin, rear_cos = np.sin(theta + alpha), np.cos(theta + alpha)
    sign = -1.0 if is_as_printed else 1.0
    rows = (
        (ones, zeros, zeros, zeros, zeros),
        (zeros, ones, zeros, zeros, zeros),
        (ones, zeros, L1 * cos - L2 * rear_cos, sin, -rear_sin),
        (zeros, ones, -L1 * sin + sign * L2 * rear_sin, cos, -rear_cos),
    )
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def compute_constraint_violation(gait: xr.Dataset, is_as_printed: bool) -> float:
    """Return the largest foot speed J q' of eq. (2) in the double support of a walk, in m/s."""
    double_support = gait.isel(time=gait.phase.values == 0)
    alpha = 2.0 * np.pi / gait.attrs["parameter_n_legs"]
    J = compute_double_support_jacobian(
        double_support.theta.values,
        double_support.L1.values,
        double_support.L2.values,
        alpha,
        is_as_printed,
    )
    rates = np.stack(
        [double_support[name].values for name in ("dx", "dz", "dtheta", "dL1", "dL2")], axis=-1
    )
    return float(np.abs(np.einsum("tij,tj->ti", J, rates)).max())


class PaperLanding(NamedTuple):
    """Collision I by eqs (15)-(21) and (33)-(35), corrected and as printed."""

    velocity_after: np.ndarray  # q'+ of eq. (20)
    impulse: np.ndarray  # lambda_I = -X^-1 J q'
    printed_impulse: np.ndarray  # eq. (35) as printed: five numbers
    momentum_residual: float  # largest |M (q'+ - q') - J^T lambda_I|, N s


def compute_landing(params: WheelParams, section_state: np.ndarray) -> PaperLanding:
    """Return collision I from the section state (theta-, dtheta-, dL1-) in five coordinates."""
    theta, dtheta, dL1 = (float(v) for v in section_state)
    s, length = jax.tree.map(float, _compute_touchdown(params, theta))
    foot_velocity = compute_landing_foot_velocity(params, section_state, bare_rate=dL1)
    velocity_before = np.array([*foot_velocity, dtheta, 0.0, dL1])
    theta_after = np.asarray(theta - s.alpha)
    coordinates_after = (theta_after, np.asarray(s.L0), np.asarray(length))
    J = compute_double_support_jacobian(*coordinates_after, float(s.alpha), is_as_printed=False)
    M = np.asarray(
        compute_five_coordinate_mass_matrix(s, jnp.asarray(theta_after), s.L0, jnp.asarray(length))
    )
    inverse = np.linalg.inv(M)
    X = J @ inverse @ J.T
    projector = np.eye(5) - inverse @ J.T @ np.linalg.solve(X, J)
    velocity_after, impulse = projector @ velocity_before, -np.linalg.solve(X, J @ velocity_before)
    residual = float(np.abs(M @ (velocity_after - velocity_before) - J.T @ impulse).max())
    return PaperLanding(velocity_after, impulse, projector @ velocity_before, residual)


@jax.jit
def compute_five_coordinate_mass_matrix(s: Symbols, theta: Scalar, L1: Scalar, L2: Scalar) -> Array:
    """Return M(q) of eq. (1), from the planted wheel's and the momentum of a moving foot."""
    planted_mass_matrix = mass_matrix(s, L1, L2)
    units = jnp.eye(3)
    angular = jnp.stack([jnp.stack(planted_mass_matrix.multiply(tuple(unit))) for unit in units])
    foot_momentum = jnp.stack(
        [jnp.stack(momentum(s, Motion.from_angle(theta, L1, L2, *unit))) for unit in units], axis=-1
    )
    return jnp.block([[s.Mt * jnp.eye(2), foot_momentum], [foot_momentum.T, angular]])


def compute_landing_foot_velocity(
    params: WheelParams, section_state: np.ndarray, bare_rate: float
) -> np.ndarray:
    """Return the velocity of the landing foot by eqs (16) and (17) with `bare_rate` as L1 rate."""
    theta, dtheta, _ = (float(v) for v in section_state)
    s, length = jax.tree.map(float, _compute_touchdown(params, theta))
    L0, alpha = float(s.L0), float(s.alpha)
    x = (length * np.cos(theta) - L0 * np.cos(alpha - theta)) * dtheta + bare_rate * np.sin(theta)
    z = -(length * np.sin(theta) + L0 * np.sin(alpha - theta)) * dtheta + bare_rate * np.cos(theta)
    return np.array([x, z])


def differentiate_landing_foot_position(
    params: WheelParams, section_state: np.ndarray
) -> np.ndarray:
    """Return the velocity of the landing foot by central differences, accurate to 1e-11 m/s."""
    h = 1e-6  # In s; the error is proportional to its square.
    theta, dtheta, dL1 = (float(v) for v in section_state)
    s, touchdown_length = jax.tree.map(float, _compute_touchdown(params, theta))

    def compute_position(t: float) -> np.ndarray:
        """Return the position of the landing foot at the time t, in m."""
        angle, length = theta + dtheta * t, touchdown_length + dL1 * t
        hub = length * np.array([np.sin(angle), np.cos(angle)])
        landing_angle = angle - float(s.alpha)
        return hub - float(s.L0) * np.array([np.sin(landing_angle), np.cos(landing_angle)])

    return (compute_position(h) - compute_position(-h)) / (2.0 * h)
