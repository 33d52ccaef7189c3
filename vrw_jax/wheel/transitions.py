"""Collisions between the phases: landing of a foot, and Leg 2 at its stopper.

The landing follows Section 3.4.1 of the paper with the procedure of Section 5.1. The collision with
the stopper follows Section 3.4.2.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from vrw_jax.numerics import Elementwise
from vrw_jax.wheel.dynamics import (
    EquationTerms,
    FootForce,
    MassMatrix,
    double_support_acceleration,
    foot_force_from_residual,
    fore_foot_force,
    free_acceleration,
    kinetic_energy,
    mass_matrix,
    momentum,
    rear_foot_force,
)
from vrw_jax.wheel.geometry import (
    Motion,
    double_support_circle,
    landing_direction,
    length_at_touchdown,
    rear_direction,
)
from vrw_jax.wheel.params import Symbols


class Landing(NamedTuple):
    """Motion just after the landing of a foot, with impulses and energy loss."""

    theta: Elementwise  # rad, in the leg labels of the starting step
    motion: Motion  # just after the impact
    distance: Elementwise  # D, between both feet, m
    keeps_rear_foot: Bool[Array, "..."]  # whether lambda_I4 >= 0: (A4), else (A3)
    fore_impulse: FootForce  # (lambda_I1, lambda_I2), N s, of the actual impact
    rear_impulse: FootForce  # (lambda_I3, lambda_I4), N s, with both feet held (A1)
    energy_lost: Elementwise  # J
    hub_jump: tuple[Elementwise, Elementwise]  # jump of the hub's velocity along (x, z), m/s


def motion_before_landing(
    s: Symbols, theta: Elementwise, dtheta: Elementwise, dL1: Elementwise
) -> Motion:
    """Return the motion just before a landing, from (theta-, dtheta-, dL1-).

    Leg 2 is locked, and the next foot is on the ground.
    """
    L1 = length_at_touchdown(s, theta)
    zero = 0.0 * (theta + s.L0)
    return Motion.from_angle(theta, L1, s.L0 + zero, dtheta, dL1, zero)


class _BothFeetLanding(NamedTuple):
    """Landing that leaves both feet on the ground (A1), with intermediate results."""

    motion_before: Motion
    motion_after: Motion
    distance: Elementwise
    foot_velocity: tuple[Elementwise, Elementwise]  # of the landing foot before the impact, m/s
    mass: MassMatrix  # in the leg labels of the starting step
    momentum: tuple[Elementwise, ...]  # generalized momentum about the new foot
    circle_momentum: tuple[Elementwise, ...]  # mass matrix times the tangent of the hub's circle


def _solve_both_feet_landing(
    s: Symbols, theta: Elementwise, dtheta: Elementwise, dL1: Elementwise
) -> _BothFeetLanding:
    """Return the landing with both feet held on the ground (A1)."""
    motion_before = motion_before_landing(s, theta, dtheta, dL1)
    L1_before = motion_before.L1
    # The velocity of the landing foot follows eqs (16), (17) with the rate of L1 before the impact.
    sin, cos = landing_direction(s, motion_before.sin, motion_before.cos)
    foot_velocity_x = (
        L1_before * motion_before.cos - s.L0 * cos
    ) * dtheta + dL1 * motion_before.sin
    foot_velocity_z = (
        -(L1_before * motion_before.sin - s.L0 * sin) * dtheta + dL1 * motion_before.cos
    )

    rear_leg = rear_direction(s, sin, cos)
    M = mass_matrix(s, s.L0, L1_before)
    # The generalized momentum of (theta, L1, L2) about the new foot includes the velocity of this
    # foot.
    relative_momentum = M.multiply((dtheta, 0.0 * dtheta, dL1))
    A, B = s.Mh * s.L0 + s.m * s.L0, s.m * (s.L0 - L1_before)
    p1 = (
        relative_momentum[0]
        + (A * cos + B * rear_leg.cos) * foot_velocity_x
        - (A * sin + B * rear_leg.sin) * foot_velocity_z
    )
    p2 = relative_momentum[1] + s.Mh * (sin * foot_velocity_x + cos * foot_velocity_z)
    p3 = relative_momentum[2] - s.m * (
        rear_leg.sin * foot_velocity_x + rear_leg.cos * foot_velocity_z
    )

    # (A1) With both feet held, the hub can only move on its circle.
    distance = s.L0 * s.sin_alpha / rear_leg.cos
    circle = double_support_circle(s, distance, sin, cos)
    circle_momentum = M.multiply((jnp.ones_like(circle.G1), circle.G1, circle.G2))
    circle_inertia = (
        circle_momentum[0] + circle.G1 * circle_momentum[1] + circle.G2 * circle_momentum[2]
    )
    dtheta_after = (p1 + circle.G1 * p2 + circle.G2 * p3) / circle_inertia
    locked_length = s.L0 + 0.0 * L1_before
    motion_after = Motion(
        sin,
        cos,
        locked_length,
        L1_before,
        dtheta_after,
        circle.G1 * dtheta_after,
        circle.G2 * dtheta_after,
    )
    return _BothFeetLanding(
        motion_before,
        motion_after,
        distance,
        (foot_velocity_x, foot_velocity_z),
        M,
        (p1, p2, p3),
        circle_momentum,
    )


def land_on_both_feet(
    s: Symbols, theta: Elementwise, dtheta: Elementwise, dL1: Elementwise
) -> tuple[Elementwise, Elementwise]:
    """Return (theta+, dtheta+) of a landing that leaves both feet on the ground, rad and rad/s."""
    return theta - s.alpha, _solve_both_feet_landing(s, theta, dtheta, dL1).motion_after.dtheta


def land(s: Symbols, theta: Elementwise, dtheta: Elementwise, dL1: Elementwise) -> Landing:
    """Return the result of the exchange of legs and inelastic landing, eqs (15)-(21), (A1)-(A4).

    The arguments theta, dtheta, dL1 are the section state just before touchdown, in the leg labels
    of the ending step. The result uses the leg labels of the starting step.
    """
    (
        motion_before,
        motion_on_both_feet,
        distance,
        (foot_velocity_x, foot_velocity_z),
        M,
        (p1, p2, p3),
        circle_momentum,
    ) = _solve_both_feet_landing(s, theta, dtheta, dL1)
    sin, cos, L1_before = motion_on_both_feet.sin, motion_on_both_feet.cos, motion_before.L1
    dtheta_both_feet = motion_on_both_feet.dtheta
    rear_impulse = foot_force_from_residual(
        s,
        motion_on_both_feet,
        circle_momentum[1] * dtheta_both_feet - p2,
        circle_momentum[2] * dtheta_both_feet - p3,
    )
    keeps_rear_foot = rear_impulse.normal >= 0.0

    # (A3) With only the landing foot held, M rates = p.
    free_rates = free_acceleration(s, s.L0, EquationTerms(M, p1, p2, p3))
    motion_after = motion_on_both_feet._replace(
        dtheta=jnp.where(keeps_rear_foot, dtheta_both_feet, free_rates.ddtheta),
        dL1=jnp.where(keeps_rear_foot, motion_on_both_feet.dL1, free_rates.ddL1),
        dL2=jnp.where(keeps_rear_foot, motion_on_both_feet.dL2, free_rates.ddL2),
    )
    # The impulse at the fore foot is the jump of total momentum minus the impulse at the rear foot.
    px, pz = momentum(s, motion_after)
    relabeled_motion = Motion(sin, cos, s.L0, L1_before, dtheta, 0.0 * dtheta, dL1)
    momentum_before_x, momentum_before_z = momentum(s, relabeled_motion)
    applied_rear_impulse = FootForce(
        jnp.where(keeps_rear_foot, rear_impulse.tangential, 0.0),
        jnp.where(keeps_rear_foot, rear_impulse.normal, 0.0),
    )
    fore_impulse = FootForce(
        px - momentum_before_x - s.Mt * foot_velocity_x - applied_rear_impulse.tangential,
        pz - momentum_before_z - s.Mt * foot_velocity_z - applied_rear_impulse.normal,
    )
    return Landing(
        theta=theta - s.alpha,
        motion=motion_after,
        distance=distance,
        keeps_rear_foot=keeps_rear_foot,
        fore_impulse=fore_impulse,
        rear_impulse=rear_impulse,
        energy_lost=kinetic_energy(s, motion_before) - kinetic_energy(s, motion_after),
        hub_jump=hub_velocity_jump(motion_before, motion_after),
    )


def stop_leg_2(s: Symbols, motion_before: Motion) -> Motion:
    """Return the motion after Leg 2, at L2 = L0, has met its stopper."""
    M = mass_matrix(s, motion_before.L1, motion_before.L2)
    return motion_before._replace(
        dtheta=motion_before.dtheta + M.M13 * motion_before.dL2 / M.M11,
        dL1=motion_before.dL1 + M.M23 * motion_before.dL2 / M.M22,
        dL2=0.0 * motion_before.dL2,
    )


class StopperHit(NamedTuple):
    """Motion just after the collision of Leg 2 with its stopper, with impulses and energy loss."""

    motion: Motion  # just after the impact, L2 = L0 exactly
    stopper_impulse: Elementwise  # on the mass of Leg 2, towards the hub, N s
    foot_impulse: FootForce  # of the ground on the foot of Leg 1, N s
    energy_lost: Elementwise  # J
    hub_jump: tuple[Elementwise, Elementwise]  # m/s


def hit_stopper(s: Symbols, motion: Motion) -> StopperHit:
    """Return the result of the inelastic collision of Leg 2 with its stopper at L2 = L0, eqs
    (22)-(25).

    M12 vanishes there, so the impact needs only two divisions.
    """
    motion_before = motion._replace(L2=s.L0 + 0.0 * motion.L2)
    motion_after = stop_leg_2(s, motion_before)
    hub_jump = hub_velocity_jump(motion_before, motion_after)
    rear_leg = rear_direction(s, motion_before.sin, motion_before.cos)
    momentum_before_x, momentum_before_z = momentum(s, motion_before)
    momentum_after_x, momentum_after_z = momentum(s, motion_after)
    return StopperHit(
        motion=motion_after,
        stopper_impulse=s.m
        * (motion_before.dL2 + hub_jump[0] * rear_leg.sin + hub_jump[1] * rear_leg.cos),
        foot_impulse=FootForce(
            momentum_after_x - momentum_before_x, momentum_after_z - momentum_before_z
        ),
        energy_lost=kinetic_energy(s, motion_before) - kinetic_energy(s, motion_after),
        hub_jump=hub_jump,
    )


def hub_velocity(motion: Motion) -> tuple[Elementwise, Elementwise]:
    """Return the velocity of the hub along (x, z) with the foot of Leg 1 at rest, m/s."""
    transverse_velocity = motion.L1 * motion.dtheta
    return (
        motion.dL1 * motion.sin + transverse_velocity * motion.cos,
        motion.dL1 * motion.cos - transverse_velocity * motion.sin,
    )


def hub_velocity_jump(
    motion_before: Motion, motion_after: Motion
) -> tuple[Elementwise, Elementwise]:
    """Return the jump of the hub's velocity along (x, z), m/s."""
    (x, z), (velocity_after_x, velocity_after_z) = (
        hub_velocity(motion_before),
        hub_velocity(motion_after),
    )
    return velocity_after_x - x, velocity_after_z - z


def locked_leg_impulses(
    s: Symbols,
    motion: Motion,
    hub_jump: tuple[Elementwise, Elementwise],
    leg_numbers: range,
) -> Float[Array, "n_legs_asked ..."]:
    """Return the stopper impulse on the mass of each of `leg_numbers` for a jump of the hub's
    velocity, N s.

    The impulse is negative if the collision throws the leg off its stopper: a preload resists no
    impulse.
    """
    leg_angles = s.alpha * (np.asarray(leg_numbers).reshape(-1, *(1,) * jnp.ndim(motion.sin)) - 1)
    radial_jump = hub_jump[0] * motion.sin + hub_jump[1] * motion.cos
    transverse_jump = hub_jump[0] * motion.cos - hub_jump[1] * motion.sin
    return s.m * (radial_jump * np.cos(leg_angles) + transverse_jump * np.sin(leg_angles))


def landing_forces(s: Symbols, landing: Landing) -> tuple[FootForce, FootForce]:
    """Return the fore and rear foot force just after a landing with both feet planted, N.

    The forces follow (B1) and eq. (38).
    """
    circle = double_support_circle(s, landing.distance, landing.motion.sin, landing.motion.cos)
    dtheta = landing.motion.dtheta
    motion = landing.motion._replace(dL1=circle.G1 * dtheta, dL2=circle.G2 * dtheta)
    acceleration = double_support_acceleration(s, landing.distance, motion)
    rear_force = rear_foot_force(s, motion, acceleration)
    return fore_foot_force(s, motion, acceleration, rear_force), rear_force
