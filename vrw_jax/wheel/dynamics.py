"""Accelerations of the wheel in each phase, and the forces of ground and stoppers.

With the foot of Leg 1 at rest the wheel has the coordinates (theta, L1, L2). Written with the hub's
velocity in the frame of Leg 1, the mass matrix does not depend on theta. Every phase follows from
one set of `equation_terms`. Double support restricts these equations to the circle of the hub, with
one degree of freedom. Single support I solves all three equations. Single support II drops L2 and
has two degrees of freedom. The constraints of eq. (2) hold by construction. The page
docs/explanation/physics.md derives every line.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from vrw_jax.numerics import Elementwise, Vector
from vrw_jax.wheel.geometry import (
    DoubleSupportCircle,
    Motion,
    double_support_circle,
    rear_direction,
)
from vrw_jax.wheel.params import Symbols


class Acceleration(NamedTuple):
    """Second derivatives of (theta, L1, L2)."""

    ddtheta: Elementwise  # rad/s^2
    ddL1: Elementwise  # m/s^2
    ddL2: Elementwise  # m/s^2


class MassMatrix(NamedTuple):
    """Symmetric mass matrix over (theta, L1, L2); M22, M33 and M23 are constants."""

    M11: Elementwise  # kg m^2
    M12: Elementwise  # kg m
    M13: Elementwise  # kg m
    M22: Elementwise  # kg
    M23: Elementwise  # kg
    M33: Elementwise  # kg

    def multiply(self, x: tuple[Elementwise, Elementwise, Elementwise]) -> Vector:
        """Return the product of the mass matrix and the vector x."""
        return (
            self.M11 * x[0] + self.M12 * x[1] + self.M13 * x[2],
            self.M12 * x[0] + self.M22 * x[1] + self.M23 * x[2],
            self.M13 * x[0] + self.M23 * x[1] + self.M33 * x[2],
        )


class EquationTerms(NamedTuple):
    """Mass matrix and the applied forces f of M q'' = f + constraint forces (eq. 1)."""

    mass: MassMatrix
    f1: Elementwise  # N m, along theta
    f2: Elementwise  # N, along L1
    f3: Elementwise  # N, along L2


def mass_matrix(s: Symbols, L1: Elementwise, L2: Elementwise) -> MassMatrix:
    """Return the mass matrix M(q) of eq. (1), restricted to a planted Leg 1."""
    b, coupling_moment = L2 - s.a, _coupling_moment(s, L2)
    # This sum is grouped first, because it depends on parameters only.
    constant_inertia = s.m * (s.a * s.a + (s.n - 2) * s.c0 * s.c0)
    return MassMatrix(
        M11=L1 * (s.Mh * L1 + 2.0 * coupling_moment) + (constant_inertia + s.m * b * b),
        M12=s.m * s.sin_alpha * (L2 - s.L0),
        M13=-s.m * s.sin_alpha * L1,
        M22=s.Mh,
        M23=-s.m * s.cos_alpha,
        M33=s.m,
    )


def _coupling_moment(s: Symbols, L2: Elementwise) -> Elementwise:
    """Return the moment of mass that turns with the hub, kg m."""
    return s.m * (s.c0 + s.cos_alpha * s.L0) - s.m * s.cos_alpha * L2


def equation_terms(s: Symbols, motion: Motion) -> EquationTerms:
    """Return the mass matrix and the applied forces at a motion.

    The forces are gravity, springs and dampers (eq. 3) and the inertial forces.
    """
    sin, cos, L1, L2, dtheta, dL1, dL2 = motion
    mass = mass_matrix(s, L1, L2)
    sin_from_vertical = sin * s.cos_phi + cos * s.sin_phi  # angle theta + phi
    cos_from_vertical = cos * s.cos_phi - sin * s.sin_phi
    rear_sin_from_vertical = (
        sin_from_vertical * s.cos_alpha + cos_from_vertical * s.sin_alpha
    )  # angle theta + alpha + phi
    rear_cos_from_vertical = cos_from_vertical * s.cos_alpha - sin_from_vertical * s.sin_alpha
    P1 = s.Mh * L1 + _coupling_moment(s, L2)  # half dM11/dL1
    P2 = s.m * (L2 - s.a) - s.m * s.cos_alpha * L1  # half dM11/dL2
    coriolis_factor = 2.0 * s.m * s.sin_alpha * dtheta
    fore_gravity_moment, rear_gravity_moment = (
        s.g * s.m * s.L0 + s.g * s.Mh * L1,
        s.g * s.m * s.L0 - s.g * s.m * L2,
    )
    spring_preload = s.k * s.Ls
    return EquationTerms(
        mass=mass,
        f1=fore_gravity_moment * sin_from_vertical
        + rear_gravity_moment * rear_sin_from_vertical
        - 2.0 * (P1 * dL1 + P2 * dL2) * dtheta,
        f2=(spring_preload - s.k * L1)
        - s.c * dL1
        + P1 * dtheta * dtheta
        - coriolis_factor * dL2
        - s.g * s.Mh * cos_from_vertical,
        f3=(spring_preload - s.k * L2)
        - s.c * dL2
        + P2 * dtheta * dtheta
        + coriolis_factor * dL1
        + s.g * s.m * rear_cos_from_vertical,
    )


def single_support_1_acceleration(s: Symbols, motion: Motion) -> Acceleration:
    """Return the accelerations in SLS-I (Section 3.3.2), with three degrees of freedom.

    The foot of Leg 2 is in the air, and its length is free.
    """
    return free_acceleration(s, motion.L1, equation_terms(s, motion))


def free_acceleration(s: Symbols, L1: Elementwise, terms: EquationTerms) -> Acceleration:
    """Return the accelerations due to the applied forces alone, M q'' = f, with foot 1 at rest."""
    M, f1, f2, f3 = terms
    q = s.sin_alpha * L1  # L2 is eliminated: its row of M is m (-q, -cos alpha, 1).
    A11 = M.M11 + M.M13 * q
    A12 = M.M12 + M.M13 * s.cos_alpha
    A22 = M.M22 + M.M23 * s.cos_alpha
    F1 = f1 + q * f3
    F2 = f2 + s.cos_alpha * f3
    inverse_determinant = 1.0 / (A11 * A22 - A12 * A12)
    ddtheta = (A22 * F1 - A12 * F2) * inverse_determinant
    ddL1 = (A11 * F2 - A12 * F1) * inverse_determinant
    inverse_leg_mass = 1.0 / s.m  # XLA hoists this constant out of loops over steps.
    return Acceleration(ddtheta, ddL1, f3 * inverse_leg_mass + q * ddtheta + s.cos_alpha * ddL1)


def takeoff_acceleration(s: Symbols, motion: Motion) -> Elementwise:
    """Return the normal acceleration of foot 2 at the start `motion` of SLS-I, m/s^2.

    Foot 2 is at rest on the ground at that instant. The foot rises if the value is positive and
    scuffs if the value is negative. The jump from zero is the effect of the lost tangential force
    of the ground. The value is smooth at the boundary of scuffing. The clearance is the lowest
    later height, which is not smooth. On one side, the clearance vanishes with the cube of the
    distance to the boundary. On the other side, the clearance jumps.
    """
    L1, L2, dtheta = motion.L1, motion.L2, motion.dtheta
    ddtheta, ddL1, ddL2 = single_support_1_acceleration(s, motion)
    rear_leg = rear_direction(s, motion.sin, motion.cos)
    radial_difference = (ddL1 - L1 * dtheta**2) * motion.cos - (
        ddL2 - L2 * dtheta**2
    ) * rear_leg.cos
    tangential_acceleration_1 = 2.0 * motion.dL1 * dtheta + L1 * ddtheta
    tangential_acceleration_2 = 2.0 * motion.dL2 * dtheta + L2 * ddtheta
    return (
        radial_difference
        - tangential_acceleration_1 * motion.sin
        + tangential_acceleration_2 * rear_leg.sin
    )


def single_support_2_acceleration(s: Symbols, motion: Motion) -> Acceleration:
    """Return the accelerations in SLS-II (Section 3.3.3), with two degrees of freedom.

    Leg 2 is on its stopper, and M12 = 0.
    """
    M, f1, f2, _ = equation_terms(s, motion)
    inverse_mass = 1.0 / M.M22
    return Acceleration(f1 / M.M11, f2 * inverse_mass, 0.0 * f1)


class SingleDofEquation(NamedTuple):
    """Equation of motion of a single degree of freedom: inertia * ddtheta = force."""

    inertia: Elementwise  # kg m^2
    force: Elementwise  # N m


def double_support_equation(s: Symbols, distance: Elementwise, motion: Motion) -> SingleDofEquation:
    """Return the equation of motion in DLS, where the hub moves on a circle (Section 3.3.1).

    The equation is that of `equation_terms` restricted to the circle. The bisector of both legs has
    a sine and cosine proportional to the sums of those of the legs. As a function of the bisector,
    every term is a trigonometric polynomial whose coefficients depend on the wheel only. This
    halves the work of the restriction.
    """
    # `diameter` is the diameter of the circle.
    diameter, bisector_factor = distance / s.sin_alpha, 1.0 / (1.0 + s.cos_alpha)
    weight_factor, swing_inertia = s.g * (s.Mh - s.m) * diameter, s.m * s.c0 * diameter
    leg_weight_moment, spring_factor, damping_factor = (
        s.g * s.m * s.L0,
        s.k * diameter,
        s.c * diameter * diameter,
    )
    constant_inertia = diameter * diameter * (s.Mh - s.m) + s.m * (
        2.0 * s.a * s.a + (s.n - 2) * s.c0 * s.c0
    )
    sin_coefficient = leg_weight_moment * s.cos_phi - s.Ls * spring_factor
    sin_cos_coefficient = bisector_factor * (
        s.cos_alpha * diameter * spring_factor + weight_factor * s.cos_phi
    )
    sin_squared_coefficient = -bisector_factor * weight_factor * s.sin_phi

    rear_leg, dtheta = rear_direction(s, motion.sin, motion.cos), motion.dtheta
    sin, cos = motion.sin + rear_leg.sin, motion.cos + rear_leg.cos
    sin_torque = (
        sin_coefficient
        + sin_cos_coefficient * cos
        + sin_squared_coefficient * sin
        + swing_inertia * dtheta * dtheta
    )
    slope_torque = weight_factor * s.sin_phi + leg_weight_moment * s.sin_phi * cos
    damping_coefficient = (
        1.0 - s.cos_alpha
    ) * damping_factor + bisector_factor * s.cos_alpha * damping_factor * (sin * sin)
    return SingleDofEquation(
        constant_inertia + 2.0 * swing_inertia * cos,
        slope_torque + sin * sin_torque - damping_coefficient * dtheta,
    )


def double_support_acceleration(s: Symbols, distance: Elementwise, motion: Motion) -> Acceleration:
    """Return all accelerations in DLS, from `double_support_equation`."""
    inertia, force = double_support_equation(s, distance, motion)
    circle = double_support_circle(s, distance, motion.sin, motion.cos)
    return accelerations_on_circle(circle, motion.dtheta, force / inertia)


def accelerations_on_circle(
    circle: DoubleSupportCircle, dtheta: Elementwise, ddtheta: Elementwise
) -> Acceleration:
    """Return all accelerations in double support, where only theta is free."""
    squared_rate = dtheta * dtheta
    return Acceleration(
        ddtheta,
        circle.G1 * ddtheta - circle.L1 * squared_rate,
        circle.G2 * ddtheta - circle.L2 * squared_rate,
    )


class FootForce(NamedTuple):
    """Force (N) or impulse (N s) of the ground on a foot."""

    tangential: Elementwise  # downhill positive: lambda_1 (fore) or lambda_3 (rear)
    normal: Elementwise  # pushing positive: lambda_2 (fore) or lambda_4 (rear)


def required_friction(force: FootForce) -> Elementwise:
    """Return the ratio of tangential to normal force; 0 for a foot without positive normal
    force.
    """
    is_loaded = force.normal > 0.0
    friction_ratio = jnp.abs(force.tangential) / jnp.where(is_loaded, force.normal, 1.0)
    return jnp.where(is_loaded, friction_ratio, 0.0)


def foot_force_from_residual(
    s: Symbols, motion: Motion, residual_L1: Elementwise, residual_L2: Elementwise
) -> FootForce:
    """Return the force of the ground on the rear foot, from its generalized forces along L1 and L2
    (eq. 1).
    """
    rear_leg = rear_direction(s, motion.sin, motion.cos)
    return FootForce(
        -(rear_leg.cos * residual_L1 + motion.cos * residual_L2) / s.sin_alpha,
        (rear_leg.sin * residual_L1 + motion.sin * residual_L2) / s.sin_alpha,
    )


def rear_foot_force(s: Symbols, motion: Motion, acceleration: Acceleration) -> FootForce:
    """Return (lambda_3, lambda_4) in double support, N: the part of M q'' that applied forces do
    not supply.
    """
    M, _, f2, f3 = equation_terms(s, motion)
    total_force = M.multiply(acceleration)
    return foot_force_from_residual(s, motion, total_force[1] - f2, total_force[2] - f3)


def fore_foot_force(
    s: Symbols, motion: Motion, acceleration: Acceleration, rear_force: FootForce | None = None
) -> FootForce:
    """Return (lambda_1, lambda_2), N: the rate of total momentum minus weight and rear-foot
    force.
    """
    sin, cos, L1, L2, dtheta, dL1, dL2 = motion
    ddtheta, ddL1, ddL2 = acceleration
    A, dA, ddA = s.Mh * L1 + s.m * s.L0, s.Mh * dL1, s.Mh * ddL1
    B, dB, ddB = s.m * (s.L0 - L2), -s.m * dL2, -s.m * ddL2
    radial_force_1 = ddA - A * dtheta * dtheta
    tangential_force_1 = 2.0 * dA * dtheta + A * ddtheta
    radial_force_2 = ddB - B * dtheta * dtheta
    tangential_force_2 = 2.0 * dB * dtheta + B * ddtheta
    rear_leg = rear_direction(s, sin, cos)
    x = (
        radial_force_1 * sin
        + tangential_force_1 * cos
        + radial_force_2 * rear_leg.sin
        + tangential_force_2 * rear_leg.cos
    )
    z = (
        radial_force_1 * cos
        - tangential_force_1 * sin
        + radial_force_2 * rear_leg.cos
        - tangential_force_2 * rear_leg.sin
    )
    tangential = x - s.Mt * s.g * s.sin_phi
    normal = z + s.Mt * s.g * s.cos_phi
    if rear_force is None:
        return FootForce(tangential, normal)
    return FootForce(tangential - rear_force.tangential, normal - rear_force.normal)


def momentum(s: Symbols, motion: Motion) -> tuple[Elementwise, Elementwise]:
    """Return the total linear momentum along (x, z) with the foot of Leg 1 at rest, kg m/s."""
    sin, cos, L1, L2, dtheta, dL1, dL2 = motion
    rear_leg = rear_direction(s, sin, cos)
    radial_momentum_1, tangential_momentum_1 = s.Mh * dL1, (s.Mh * L1 + s.m * s.L0) * dtheta
    radial_momentum_2, tangential_momentum_2 = -s.m * dL2, s.m * (s.L0 - L2) * dtheta
    return (
        radial_momentum_1 * sin
        + tangential_momentum_1 * cos
        + radial_momentum_2 * rear_leg.sin
        + tangential_momentum_2 * rear_leg.cos,
        radial_momentum_1 * cos
        - tangential_momentum_1 * sin
        + radial_momentum_2 * rear_leg.cos
        - tangential_momentum_2 * rear_leg.sin,
    )


def stopper_force(
    s: Symbols, motion: Motion, acceleration: Acceleration, leg_numbers: range
) -> Float[Array, "n_legs_asked ..."]:
    """Return the force of the stopper that keeps each of `leg_numbers` at L0, N.

    The force is negative if the leg would leave its stopper. The spring presses with k (L* - L0).
    The weight and the acceleration of the leg's mass reduce the force.
    """
    leg_angles = s.alpha * (np.asarray(leg_numbers).reshape(-1, *(1,) * jnp.ndim(motion.L1)) - 1)
    radial_acceleration = acceleration.ddL1 - motion.L1 * motion.dtheta * motion.dtheta
    tangential_acceleration = 2.0 * motion.dL1 * motion.dtheta + motion.L1 * acceleration.ddtheta
    # Gravity is subtracted from the acceleration of the hub, in the frame of Leg 1.
    radial_acceleration = radial_acceleration + s.g * (
        motion.cos * s.cos_phi - motion.sin * s.sin_phi
    )
    tangential_acceleration = tangential_acceleration - s.g * (
        motion.sin * s.cos_phi + motion.cos * s.sin_phi
    )
    leg_acceleration = radial_acceleration * np.cos(leg_angles) + tangential_acceleration * np.sin(
        leg_angles
    )
    centrifugal_acceleration = s.c0 * motion.dtheta * motion.dtheta
    return s.k * (s.Ls - s.L0) + s.m * centrifugal_acceleration + s.m * leg_acceleration


class Energy(NamedTuple):
    """Mechanical energy, J. The gravitational part is zero at the present foot of Leg 1 (Section
    3.5).
    """

    kinetic: Elementwise
    gravitational: Elementwise
    elastic: Elementwise

    @property
    def total(self) -> Elementwise:
        """Return the total energy E of eq. (26), J."""
        return self.kinetic + self.gravitational + self.elastic


def kinetic_energy(s: Symbols, motion: Motion) -> Elementwise:
    """Return the kinetic energy, half of q' M q', J."""
    rates = (motion.dtheta, motion.dL1, motion.dL2)
    p = mass_matrix(s, motion.L1, motion.L2).multiply(rates)
    return 0.5 * (p[0] * rates[0] + p[1] * rates[1] + p[2] * rates[2])


def mechanical_energy(s: Symbols, motion: Motion) -> Energy:
    """Return the kinetic, gravitational and elastic energy (eqs 26, 27), J."""
    sin_from_vertical = motion.sin * s.cos_phi + motion.cos * s.sin_phi
    cos_from_vertical = motion.cos * s.cos_phi - motion.sin * s.sin_phi
    rear_cos_from_vertical = cos_from_vertical * s.cos_alpha - sin_from_vertical * s.sin_alpha
    mass_moment = (s.Mh * motion.L1 + s.m * s.L0) * cos_from_vertical + s.m * (
        s.L0 - motion.L2
    ) * rear_cos_from_vertical
    stretch_1, stretch_2, locked_stretch = motion.L1 - s.Ls, motion.L2 - s.Ls, s.L0 - s.Ls
    elastic_energy = 0.5 * s.k * (stretch_1**2 + stretch_2**2 + (s.n - 2) * locked_stretch**2)
    return Energy(kinetic_energy(s, motion), s.g * mass_moment, elastic_energy)


def damping_power(s: Symbols, motion: Motion) -> Elementwise:
    """Return the power lost in the dampers, c (dL1^2 + dL2^2), W (eq. 29)."""
    return s.c * (motion.dL1 * motion.dL1 + motion.dL2 * motion.dL2)
