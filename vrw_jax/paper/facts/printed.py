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
def _touchdown(params: WheelParams, theta: float) -> tuple[Symbols, Array]:
    """Return the symbols of the paper, and the length of Leg 1 at touchdown in m."""
    s = params.symbols()
    return s, length_at_touchdown(s, jnp.asarray(theta))


def double_support_jacobian(
    theta: np.ndarray, L1: np.ndarray, L2: np.ndarray, alpha: float, as_printed: bool
) -> np.ndarray:
    """Return J_DLS of eq. (11), shape (..., 4, 5); the misprint is the sign in J43."""
    zero, one = np.zeros_like(theta), np.ones_like(theta)
    sin, cos = np.sin(theta), np.cos(theta)
    rear_sin, rear_cos = np.sin(theta + alpha), np.cos(theta + alpha)
    sign = -1.0 if as_printed else 1.0
    rows = (
        (one, zero, zero, zero, zero),
        (zero, one, zero, zero, zero),
        (one, zero, L1 * cos - L2 * rear_cos, sin, -rear_sin),
        (zero, one, -L1 * sin + sign * L2 * rear_sin, cos, -rear_cos),
    )
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def constraint_violation(gait: xr.Dataset, as_printed: bool) -> float:
    """Return the largest foot speed J q' of eq. (2) in the double support of a walk, in m/s."""
    held = gait.isel(time=gait.phase.values == 0)
    alpha = 2.0 * np.pi / gait.attrs["parameter_n_legs"]
    J = double_support_jacobian(
        held.theta.values, held.L1.values, held.L2.values, alpha, as_printed
    )
    rates = np.stack([held[name].values for name in ("dx", "dz", "dtheta", "dL1", "dL2")], axis=-1)
    return float(np.abs(np.einsum("tij,tj->ti", J, rates)).max())


class LandingByThePaper(NamedTuple):
    """Collision I by eqs (15)-(21) and (33)-(35), corrected and as printed."""

    after: np.ndarray  # q'+ of eq. (20)
    impulse: np.ndarray  # lambda_I = -X^-1 J q'
    printed: np.ndarray  # eq. (35) as printed: five numbers
    residual: float  # largest |M (q'+ - q') - J^T lambda_I|, N s


def landing(params: WheelParams, section_state: np.ndarray) -> LandingByThePaper:
    """Return collision I from the section state (theta-, dtheta-, dL1-) in five coordinates."""
    theta, dtheta, dL1 = (float(v) for v in section_state)
    s, reach = jax.tree.map(float, _touchdown(params, theta))
    foot = landing_foot_velocity(params, section_state, bare_rate=dL1)
    before = np.array([*foot, dtheta, 0.0, dL1])
    new = np.asarray(theta - s.alpha)
    ends = (new, np.asarray(s.L0), np.asarray(reach))
    J = double_support_jacobian(*ends, float(s.alpha), as_printed=False)
    M = np.asarray(five_coordinate_mass_matrix(s, jnp.asarray(new), s.L0, jnp.asarray(reach)))
    inverse = np.linalg.inv(M)
    X = J @ inverse @ J.T
    projector = np.eye(5) - inverse @ J.T @ np.linalg.solve(X, J)
    after, impulse = projector @ before, -np.linalg.solve(X, J @ before)
    residual = float(np.abs(M @ (after - before) - J.T @ impulse).max())
    return LandingByThePaper(after, impulse, projector @ before, residual)


@jax.jit
def five_coordinate_mass_matrix(s: Symbols, theta: Scalar, L1: Scalar, L2: Scalar) -> Array:
    """Return M(q) of eq. (1), from the planted wheel's and the momentum of a moving foot."""
    planted = mass_matrix(s, L1, L2)
    units = jnp.eye(3)
    angular = jnp.stack([jnp.stack(planted.times(tuple(unit))) for unit in units])
    moved = jnp.stack(
        [jnp.stack(momentum(s, Motion.of(theta, L1, L2, *unit))) for unit in units], axis=-1
    )
    return jnp.block([[s.Mt * jnp.eye(2), moved], [moved.T, angular]])


def landing_foot_velocity(
    params: WheelParams, section_state: np.ndarray, bare_rate: float
) -> np.ndarray:
    """Return the velocity of the landing foot by eqs (16) and (17) with `bare_rate` as L1 rate."""
    theta, dtheta, _ = (float(v) for v in section_state)
    s, reach = jax.tree.map(float, _touchdown(params, theta))
    L0, alpha = float(s.L0), float(s.alpha)
    x = (reach * np.cos(theta) - L0 * np.cos(alpha - theta)) * dtheta + bare_rate * np.sin(theta)
    z = -(reach * np.sin(theta) + L0 * np.sin(alpha - theta)) * dtheta + bare_rate * np.cos(theta)
    return np.array([x, z])


def landing_foot_velocity_by_differences(
    params: WheelParams, section_state: np.ndarray
) -> np.ndarray:
    """Return the same by central differences of the foot's position, accurate to 1e-11 m/s."""
    h = 1e-6  # s; the error is proportional to its square
    theta, dtheta, dL1 = (float(v) for v in section_state)
    s, reach = jax.tree.map(float, _touchdown(params, theta))

    def position(t: float) -> np.ndarray:
        """Return the position of the landing foot at the time t, in m."""
        angle, length = theta + dtheta * t, reach + dL1 * t
        hub = length * np.array([np.sin(angle), np.cos(angle)])
        ahead = angle - float(s.alpha)
        return hub - float(s.L0) * np.array([np.sin(ahead), np.cos(ahead)])

    return (position(h) - position(-h)) / (2.0 * h)
