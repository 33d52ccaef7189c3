"""Collisions between the phases: the landing of a foot, and the collision of Leg 2 with its
stopper.

The landing follows Section 3.4.1 of the paper, with the procedure of its Section 5.1. The collision
with the stopper follows Section 3.4.2 of the paper.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from vrw_jax.base.types import Elementwise
from vrw_jax.wheel.dynamics import (
    EquationTerms,
    FootForce,
    MassMatrix,
    Motion,
    compute_double_support_circle,
    compute_fore_foot_force,
    compute_kinetic_energy,
    compute_length_at_touchdown,
    compute_mass_matrix,
    compute_momentum,
    compute_rear_foot_force,
    compute_rear_force_from_residual,
    rotate_to_landing_leg,
    rotate_to_rear_leg,
    solve_double_support,
    solve_unconstrained_dynamics,
)
from vrw_jax.wheel.params import Symbols


class Landing(NamedTuple):
    """Motion just after the landing of a foot, with the impulses and the energy loss."""

    theta_after_landing: Elementwise  # rad, in the leg labels of the starting step
    motion_after: Motion  # just after the impact
    foot_distance: Elementwise  # D, between both feet, m
    is_rear_foot_planted: Bool[Array, "..."]  # whether lambda_I4 >= 0: (A4), else (A3)
    fore_impulse: FootForce  # (lambda_I1, lambda_I2), N s, of the actual impact
    rear_impulse: FootForce  # (lambda_I3, lambda_I4), N s, if both feet stay on the ground (A1)
    energy_loss: Elementwise  # J
    hub_velocity_jump: tuple[
        Elementwise, Elementwise
    ]  # jump of the hub's velocity along (x, z), m/s


def compute_motion_before_landing(
    s: Symbols, theta: Elementwise, dtheta: Elementwise, dL1: Elementwise
) -> Motion:
    """Return the motion just before a landing, computed from (theta-, dtheta-, dL1-).

    Leg 2 is on its stopper, and the next foot is on the ground.
    """
    L1 = compute_length_at_touchdown(s, theta)
    zero_rate = 0.0 * (theta + s.L0)
    return Motion.from_angle(theta, L1, s.L0 + zero_rate, dtheta, dL1, zero_rate)


class _BothFeetLanding(NamedTuple):
    """Landing after which both feet are on the ground (eq. A1 of the paper), with intermediate
    results.
    """

    motion_before: Motion
    motion_after: Motion
    foot_distance: Elementwise
    landing_foot_velocity: tuple[
        Elementwise, Elementwise
    ]  # velocity of the landing foot just before the impact, m/s
    mass_matrix: MassMatrix  # in the leg labels of the starting step
    generalized_momentum: tuple[Elementwise, ...]  # generalized momentum about the new foot
    momentum_per_hub_circle_rate: tuple[
        Elementwise, ...
    ]  # mass matrix times the tangent of the hub's circle


def _solve_both_feet_landing(
    s: Symbols, theta: Elementwise, dtheta: Elementwise, dL1: Elementwise
) -> _BothFeetLanding:
    """Compute a landing in which both feet stay on the ground (eq. A1 of the paper)."""
    motion_before = compute_motion_before_landing(s, theta, dtheta, dL1)
    L1_before = motion_before.L1
    # The velocity of the landing foot follows eqs (16), (17) with the rate of L1 before the impact.
    sin, cos = rotate_to_landing_leg(s, motion_before.sin_theta, motion_before.cos_theta)
    foot_velocity_x = (
        L1_before * motion_before.cos_theta - s.L0 * cos
    ) * dtheta + dL1 * motion_before.sin_theta
    foot_velocity_z = (
        -(L1_before * motion_before.sin_theta - s.L0 * sin) * dtheta + dL1 * motion_before.cos_theta
    )

    rear_leg = rotate_to_rear_leg(s, sin, cos)
    M = compute_mass_matrix(s, s.L0, L1_before)
    # The generalized momentum of (theta, L1, L2) about the new foot includes the velocity of this
    # foot.
    momentum_about_planted_foot = M.multiply_vector((dtheta, 0.0 * dtheta, dL1))
    A, B = s.Mh * s.L0 + s.m * s.L0, s.m * (s.L0 - L1_before)
    p1 = (
        momentum_about_planted_foot[0]
        + (A * cos + B * rear_leg.cos) * foot_velocity_x
        - (A * sin + B * rear_leg.sin) * foot_velocity_z
    )
    p2 = momentum_about_planted_foot[1] + s.Mh * (sin * foot_velocity_x + cos * foot_velocity_z)
    p3 = momentum_about_planted_foot[2] - s.m * (
        rear_leg.sin * foot_velocity_x + rear_leg.cos * foot_velocity_z
    )

    # (A1) If both feet stay on the ground, the hub can only move on its circle.
    foot_distance = s.L0 * s.sin_alpha / rear_leg.cos
    _, _, dL1_dtheta, dL2_dtheta = compute_double_support_circle(s, foot_distance, sin, cos)
    momentum_per_hub_circle_rate = M.multiply_vector(
        (jnp.ones_like(dL1_dtheta), dL1_dtheta, dL2_dtheta)
    )
    hub_circle_inertia = (
        momentum_per_hub_circle_rate[0]
        + dL1_dtheta * momentum_per_hub_circle_rate[1]
        + dL2_dtheta * momentum_per_hub_circle_rate[2]
    )
    dtheta_after = (p1 + dL1_dtheta * p2 + dL2_dtheta * p3) / hub_circle_inertia
    locked_length = s.L0 + 0.0 * L1_before
    motion_after = Motion(
        sin,
        cos,
        locked_length,
        L1_before,
        dtheta_after,
        dL1_dtheta * dtheta_after,
        dL2_dtheta * dtheta_after,
    )
    return _BothFeetLanding(
        motion_before,
        motion_after,
        foot_distance,
        (foot_velocity_x, foot_velocity_z),
        M,
        (p1, p2, p3),
        momentum_per_hub_circle_rate,
    )


def resolve_two_foot_landing(
    s: Symbols, theta: Elementwise, dtheta: Elementwise, dL1: Elementwise
) -> tuple[Elementwise, Elementwise]:
    """Return (theta+, dtheta+) just after a landing on both feet, rad and rad/s."""
    return theta - s.alpha, _solve_both_feet_landing(s, theta, dtheta, dL1).motion_after.dtheta


def resolve_landing(
    s: Symbols, theta: Elementwise, dtheta: Elementwise, dL1: Elementwise
) -> Landing:
    """Compute the inelastic landing and exchange the leg labels, eqs (15)-(21), (A1)-(A4) of the
    paper.

    The arguments theta, dtheta and dL1 are the section state just before touchdown, in the leg
    labels of the step that ends. The result uses the leg labels of the step that starts.
    """
    (
        motion_before,
        motion_on_both_feet,
        foot_distance,
        (foot_velocity_x, foot_velocity_z),
        M,
        (p1, p2, p3),
        momentum_per_hub_circle_rate,
    ) = _solve_both_feet_landing(s, theta, dtheta, dL1)
    dtheta_both_feet = motion_on_both_feet.dtheta
    rear_impulse = compute_rear_force_from_residual(
        s,
        motion_on_both_feet,
        momentum_per_hub_circle_rate[1] * dtheta_both_feet - p2,
        momentum_per_hub_circle_rate[2] * dtheta_both_feet - p3,
    )
    is_rear_foot_planted = rear_impulse.normal >= 0.0

    # (A3) If only the landing foot stays on the ground, M rates = p.
    rates_without_rear_foot = solve_unconstrained_dynamics(s, s.L0, EquationTerms(M, p1, p2, p3))
    motion_after = motion_on_both_feet._replace(
        dtheta=jnp.where(is_rear_foot_planted, dtheta_both_feet, rates_without_rear_foot.ddtheta),
        dL1=jnp.where(is_rear_foot_planted, motion_on_both_feet.dL1, rates_without_rear_foot.ddL1),
        dL2=jnp.where(is_rear_foot_planted, motion_on_both_feet.dL2, rates_without_rear_foot.ddL2),
    )
    # The impulse at the fore foot is the jump of total momentum minus the impulse at the rear foot.
    momentum_after_x, momentum_after_z = compute_momentum(s, motion_after)
    motion_of_new_legs = Motion(
        motion_on_both_feet.sin_theta,
        motion_on_both_feet.cos_theta,
        s.L0,
        motion_before.L1,
        dtheta,
        0.0 * dtheta,
        dL1,
    )
    momentum_before_x, momentum_before_z = compute_momentum(s, motion_of_new_legs)
    rear_impulse_x, rear_impulse_z = (jnp.where(is_rear_foot_planted, x, 0.0) for x in rear_impulse)
    fore_impulse = FootForce(
        momentum_after_x - momentum_before_x - s.Mt * foot_velocity_x - rear_impulse_x,
        momentum_after_z - momentum_before_z - s.Mt * foot_velocity_z - rear_impulse_z,
    )
    return Landing(
        theta_after_landing=theta - s.alpha,
        motion_after=motion_after,
        foot_distance=foot_distance,
        is_rear_foot_planted=is_rear_foot_planted,
        fore_impulse=fore_impulse,
        rear_impulse=rear_impulse,
        energy_loss=compute_kinetic_energy(s, motion_before)
        - compute_kinetic_energy(s, motion_after),
        hub_velocity_jump=compute_hub_velocity_jump(motion_before, motion_after),
    )


def lock_leg_2(s: Symbols, motion_before: Motion) -> Motion:
    """Return the motion just after Leg 2 hits its stopper. The collision is at L2 = L0."""
    M = compute_mass_matrix(s, motion_before.L1, motion_before.L2)
    return motion_before._replace(
        dtheta=motion_before.dtheta + M.M13 * motion_before.dL2 / M.M11,
        dL1=motion_before.dL1 + M.M23 * motion_before.dL2 / M.M22,
        dL2=0.0 * motion_before.dL2,
    )


class StopperCollision(NamedTuple):
    """Motion just after the collision of Leg 2 with its stopper, with the impulses and the energy
    loss.
    """

    motion_after: Motion  # just after the impact, L2 = L0 exactly
    stopper_impulse: Elementwise  # on the mass of Leg 2, towards the hub, N s
    foot_impulse: FootForce  # impulse on the foot of Leg 1, N s
    energy_loss: Elementwise  # J
    hub_velocity_jump: tuple[Elementwise, Elementwise]  # m/s


def resolve_stopper_collision(s: Symbols, motion: Motion) -> StopperCollision:
    """Compute the inelastic collision of Leg 2 with its stopper at L2 = L0.

    The equations are (22)-(25) of the paper. M12 vanishes at this length, so the impact needs only
    two divisions.
    """
    motion_before = motion._replace(L2=s.L0 + 0.0 * motion.L2)
    motion_after = lock_leg_2(s, motion_before)
    hub_velocity_jump = compute_hub_velocity_jump(motion_before, motion_after)
    rear_leg = rotate_to_rear_leg(s, motion_before.sin_theta, motion_before.cos_theta)
    momentum_before_x, momentum_before_z = compute_momentum(s, motion_before)
    momentum_after_x, momentum_after_z = compute_momentum(s, motion_after)
    return StopperCollision(
        motion_after=motion_after,
        stopper_impulse=s.m
        * (
            motion_before.dL2
            + hub_velocity_jump[0] * rear_leg.sin
            + hub_velocity_jump[1] * rear_leg.cos
        ),
        foot_impulse=FootForce(
            momentum_after_x - momentum_before_x, momentum_after_z - momentum_before_z
        ),
        energy_loss=compute_kinetic_energy(s, motion_before)
        - compute_kinetic_energy(s, motion_after),
        hub_velocity_jump=hub_velocity_jump,
    )


def compute_hub_velocity(motion: Motion) -> tuple[Elementwise, Elementwise]:
    """Return the velocity of the hub in the directions x and z, m/s, with the foot of Leg 1 at
    rest.
    """
    transverse_velocity = motion.L1 * motion.dtheta
    return (
        motion.dL1 * motion.sin_theta + transverse_velocity * motion.cos_theta,
        motion.dL1 * motion.cos_theta - transverse_velocity * motion.sin_theta,
    )


def compute_hub_velocity_jump(
    motion_before: Motion, motion_after: Motion
) -> tuple[Elementwise, Elementwise]:
    """Return the jump of the hub's velocity in the directions x and z, m/s."""
    velocity_before_x, velocity_before_z = compute_hub_velocity(motion_before)
    velocity_after_x, velocity_after_z = compute_hub_velocity(motion_after)
    return velocity_after_x - velocity_before_x, velocity_after_z - velocity_before_z


def compute_locked_leg_impulses(
    s: Symbols,
    motion: Motion,
    hub_velocity_jump: tuple[Elementwise, Elementwise],
    leg_numbers: range,
) -> Float[Array, "n_legs_asked ..."]:
    """Return the impulse that the stopper exerts on the mass of each leg of `leg_numbers`, N s.

    The impulse follows from the jump of the hub's velocity. It is negative if the collision throws
    the leg off its stopper, because the preload of a spring resists no impulse.
    """
    leg_angles = s.alpha * (
        np.asarray(leg_numbers).reshape(-1, *(1,) * jnp.ndim(motion.sin_theta)) - 1
    )
    radial_velocity_jump = (
        hub_velocity_jump[0] * motion.sin_theta + hub_velocity_jump[1] * motion.cos_theta
    )
    transverse_velocity_jump = (
        hub_velocity_jump[0] * motion.cos_theta - hub_velocity_jump[1] * motion.sin_theta
    )
    return s.m * (
        radial_velocity_jump * np.cos(leg_angles) + transverse_velocity_jump * np.sin(leg_angles)
    )


def compute_landing_forces(s: Symbols, landing: Landing) -> tuple[FootForce, FootForce]:
    """Return the forces on the fore and the rear foot just after a landing on both feet, N.

    The forces follow (B1) and eq. (38) of the paper.
    """
    hub_circle = compute_double_support_circle(
        s, landing.foot_distance, landing.motion_after.sin_theta, landing.motion_after.cos_theta
    )
    dtheta = landing.motion_after.dtheta
    motion = landing.motion_after._replace(
        dL1=hub_circle.dL1_dtheta * dtheta, dL2=hub_circle.dL2_dtheta * dtheta
    )
    acceleration = solve_double_support(s, landing.foot_distance, motion)
    rear_force = compute_rear_foot_force(s, motion, acceleration)
    return compute_fore_foot_force(s, motion, acceleration, rear_force), rear_force
