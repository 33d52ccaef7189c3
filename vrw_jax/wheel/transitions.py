"""Collisions between the phases: each guard with its reset.

Guards are positive inside their phase and trigger when they fall through zero. Resets are the two
collisions of the paper: landing (Section 3.4.1 with the procedure of Section 5.1) and stopper
(Section 3.4.2).
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from vrw_jax.numerics import Elementwise
from vrw_jax.wheel.dynamics import (
    FootForce,
    MassMatrix,
    Terms,
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
    """Result of the collision of the landing foot, with its impulses and energy loss."""

    theta: Elementwise  # rad, in the leg labels of the starting step
    motion: Motion  # just after the impact
    distance: Elementwise  # D, between both feet, m
    stays: Bool[Array, "..."]  # lambda_I4 >= 0: the rear foot stays (A4), else (A3)
    fore: FootForce  # (lambda_I1, lambda_I2), N s, of the actual impact
    rear: FootForce  # (lambda_I3, lambda_I4), N s, with both feet held (A1)
    energy_lost: Elementwise  # J
    hub_jump: tuple[Elementwise, Elementwise]  # jump of the hub's velocity along (x, z), m/s


def motion_before_landing(
    s: Symbols, theta: Elementwise, dtheta: Elementwise, dL1: Elementwise
) -> Motion:
    """Return the motion of the section state (theta-, dtheta-, dL1-): Leg 2 locked, next foot at z
    = 0.
    """
    L1 = length_at_touchdown(s, theta)
    zero = 0.0 * (theta + s.L0)
    return Motion.of(theta, L1, s.L0 + zero, dtheta, dL1, zero)


class _HeldLanding(NamedTuple):
    """Landing that leaves both feet on the ground (A1), with its intermediate results."""

    before: Motion
    after: Motion
    distance: Elementwise
    foot: tuple[Elementwise, Elementwise]  # of the landing foot before the impact, m/s
    mass: MassMatrix  # in the leg labels of the starting step
    momentum: tuple[Elementwise, ...]  # along its coordinates, about the new foot
    row: tuple[Elementwise, ...]  # mass matrix times the tangent of the hub's circle


def _held_landing(
    s: Symbols, theta: Elementwise, dtheta: Elementwise, dL1: Elementwise
) -> _HeldLanding:
    """Return the landing with both feet held on the ground (A1)."""
    before = motion_before_landing(s, theta, dtheta, dL1)
    reach = before.L1
    # Velocity of the landing foot: eqs (16), (17) with the rate of L1 before the impact.
    sin, cos = landing_direction(s, before.sin, before.cos)
    foot_x = (reach * before.cos - s.L0 * cos) * dtheta + dL1 * before.sin
    foot_z = -(reach * before.sin - s.L0 * sin) * dtheta + dL1 * before.cos

    rear = rear_direction(s, sin, cos)
    M = mass_matrix(s, s.L0, reach)
    # Generalized momentum of (theta, L1, L2) about the new foot, including its velocity.
    p = M.times((dtheta, 0.0 * dtheta, dL1))
    A, B = s.Mh * s.L0 + s.m * s.L0, s.m * (s.L0 - reach)
    p1 = p[0] + (A * cos + B * rear.cos) * foot_x - (A * sin + B * rear.sin) * foot_z
    p2 = p[1] + s.Mh * (sin * foot_x + cos * foot_z)
    p3 = p[2] - s.m * (rear.sin * foot_x + rear.cos * foot_z)

    # (A1) both feet held: the hub can only move on its circle.
    distance = s.L0 * s.sin_alpha / rear.cos
    circle = double_support_circle(s, distance, sin, cos)
    row = M.times((jnp.ones_like(circle.G1), circle.G1, circle.G2))
    inertia = row[0] + circle.G1 * row[1] + circle.G2 * row[2]
    held = (p1 + circle.G1 * p2 + circle.G2 * p3) / inertia
    full = s.L0 + 0.0 * reach
    after = Motion(sin, cos, full, reach, held, circle.G1 * held, circle.G2 * held)
    return _HeldLanding(before, after, distance, (foot_x, foot_z), M, (p1, p2, p3), row)


def land_on_both(
    s: Symbols, theta: Elementwise, dtheta: Elementwise, dL1: Elementwise
) -> tuple[Elementwise, Elementwise]:
    """Return (theta+, dtheta+) of a landing that leaves both feet on the ground."""
    return theta - s.alpha, _held_landing(s, theta, dtheta, dL1).after.dtheta


def land(s: Symbols, theta: Elementwise, dtheta: Elementwise, dL1: Elementwise) -> Landing:
    """Return the exchange of legs and inelastic landing, eqs (15)-(21), (A1)-(A4).

    The arguments theta, dtheta, dL1 are the section state just before touchdown, in the leg labels
    of the ending step. The result uses the leg labels of the starting step.
    """
    before, on_both, distance, (foot_x, foot_z), M, (p1, p2, p3), row = _held_landing(
        s, theta, dtheta, dL1
    )
    sin, cos, reach = on_both.sin, on_both.cos, before.L1
    held = on_both.dtheta
    rear_impulse = foot_force_from_residual(s, on_both, row[1] * held - p2, row[2] * held - p3)
    stays = rear_impulse.normal >= 0.0

    # (A3) only the landing foot held: M rates = p.
    free = free_acceleration(s, s.L0, Terms(M, p1, p2, p3))
    after = on_both._replace(
        dtheta=jnp.where(stays, held, free.ddtheta),
        dL1=jnp.where(stays, on_both.dL1, free.ddL1),
        dL2=jnp.where(stays, on_both.dL2, free.ddL2),
    )
    # Impulses of the ground: the jump of total momentum minus the impulse at the rear foot.
    px, pz = momentum(s, after)
    moving = Motion(sin, cos, s.L0, reach, dtheta, 0.0 * dtheta, dL1)
    before_x, before_z = momentum(s, moving)
    taken = FootForce(
        jnp.where(stays, rear_impulse.tangential, 0.0), jnp.where(stays, rear_impulse.normal, 0.0)
    )
    fore = FootForce(
        px - before_x - s.Mt * foot_x - taken.tangential,
        pz - before_z - s.Mt * foot_z - taken.normal,
    )
    return Landing(
        theta=theta - s.alpha,
        motion=after,
        distance=distance,
        stays=stays,
        fore=fore,
        rear=rear_impulse,
        energy_lost=kinetic_energy(s, before) - kinetic_energy(s, after),
        hub_jump=jump_of_hub(before, after),
    )


def stopped(s: Symbols, before: Motion) -> Motion:
    """Return the motion after Leg 2, at L2 = L0, has met its stopper."""
    M = mass_matrix(s, before.L1, before.L2)
    return before._replace(
        dtheta=before.dtheta + M.M13 * before.dL2 / M.M11,
        dL1=before.dL1 + M.M23 * before.dL2 / M.M22,
        dL2=0.0 * before.dL2,
    )


class StopperHit(NamedTuple):
    """Result of the collision of Leg 2 with its stopper, with its impulses and energy loss."""

    motion: Motion  # just after the impact, L2 = L0 exactly
    stopper_impulse: Elementwise  # on the mass of Leg 2, towards the hub, N s
    planted: FootForce  # of the ground on the foot of Leg 1, N s
    energy_lost: Elementwise  # J
    hub_jump: tuple[Elementwise, Elementwise]  # m/s


def hit_stopper(s: Symbols, motion: Motion) -> StopperHit:
    """Return the inelastic collision of Leg 2 with its stopper at L2 = L0, eqs (22)-(25).

    M12 vanishes there, so the impact needs only two divisions.
    """
    before = motion._replace(L2=s.L0 + 0.0 * motion.L2)
    after = stopped(s, before)
    jump = jump_of_hub(before, after)
    rear = rear_direction(s, before.sin, before.cos)
    before_x, before_z = momentum(s, before)
    after_x, after_z = momentum(s, after)
    return StopperHit(
        motion=after,
        stopper_impulse=s.m * (before.dL2 + jump[0] * rear.sin + jump[1] * rear.cos),
        planted=FootForce(after_x - before_x, after_z - before_z),
        energy_lost=kinetic_energy(s, before) - kinetic_energy(s, after),
        hub_jump=jump,
    )


def hub_velocity(motion: Motion) -> tuple[Elementwise, Elementwise]:
    """Return the velocity of the hub along (x, z) with the foot of Leg 1 at rest, m/s."""
    across = motion.L1 * motion.dtheta
    return (
        motion.dL1 * motion.sin + across * motion.cos,
        motion.dL1 * motion.cos - across * motion.sin,
    )


def jump_of_hub(before: Motion, after: Motion) -> tuple[Elementwise, Elementwise]:
    """Return the jump of the hub's velocity along (x, z), m/s."""
    (x, z), (after_x, after_z) = hub_velocity(before), hub_velocity(after)
    return after_x - x, after_z - z


def locked_leg_impulses(
    s: Symbols,
    motion: Motion,
    jump: tuple[Elementwise, Elementwise],
    legs: range,
) -> Float[Array, "n_legs_asked ..."]:
    """Return the stopper impulse on the mass of each of `legs` for a jump of the hub's velocity, N
    s.

    It is negative where the collision throws the leg off its stopper: a preload resists no impulse.
    """
    turn = s.alpha * (np.asarray(legs).reshape(-1, *(1,) * jnp.ndim(motion.sin)) - 1)
    radial = jump[0] * motion.sin + jump[1] * motion.cos
    across = jump[0] * motion.cos - jump[1] * motion.sin
    return s.m * (radial * np.cos(turn) + across * np.sin(turn))


def landing_forces(s: Symbols, landing: Landing) -> tuple[FootForce, FootForce]:
    """Return the fore and rear foot force just after a landing with both feet planted, N (B1, eq.
    38).
    """
    circle = double_support_circle(s, landing.distance, landing.motion.sin, landing.motion.cos)
    dtheta = landing.motion.dtheta
    motion = landing.motion._replace(dL1=circle.G1 * dtheta, dL2=circle.G2 * dtheta)
    acceleration = double_support_acceleration(s, landing.distance, motion)
    rear = rear_foot_force(s, motion, acceleration)
    return fore_foot_force(s, motion, acceleration, rear), rear
