"""Geometry of the wheel, its accelerations in each phase, and the forces of ground and stoppers.

The frame is tilted with the slope: x points downhill along the slope, and z is normal to the slope.
Angles are measured from the normal, and theta increases as the wheel rolls downhill. Leg j has the
angle theta + (j - 1) alpha. Leg 1 is the fore leg on the ground, Leg 2 is the rear leg, and leg n,
at theta - alpha, lands next. The origin is the foot of Leg 1. A posture depends on theta only
through sin(theta) and cos(theta).

With the foot of Leg 1 at rest, the coordinates of the wheel are (theta, L1, L2). The mass matrix is
written with the hub's velocity in the frame of Leg 1, so it does not depend on theta. The equations
of motion of every phase follow from `compute_equation_terms`. In double support, the hub moves on a
circle, so one degree of freedom remains. Single support I uses all three equations. Single support
II omits L2 and has two degrees of freedom. The constraints of eq. (2) of the paper hold by
construction. The page docs/explanation/physics.md contains the derivations.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from vrw_jax.base.elementwise import Elementwise, Vector, compute_sine_cosine
from vrw_jax.wheel.laws import (
    compute_leg_potential,
    evaluate_damping_power,
    evaluate_hub_torque,
    evaluate_leg_force,
)
from vrw_jax.wheel.params import Symbols


class Motion(NamedTuple):
    """Posture and rates of change of (theta, L1, L2), with the foot of Leg 1 at rest."""

    sin_theta: Elementwise  # sine of theta
    cos_theta: Elementwise  # cosine of theta
    L1: Elementwise  # m
    L2: Elementwise  # m
    dtheta: Elementwise  # rad/s
    dL1: Elementwise  # m/s
    dL2: Elementwise  # m/s

    @classmethod
    def from_angle(
        cls,
        theta: Elementwise,
        L1: Elementwise,
        L2: Elementwise,
        dtheta: Elementwise,
        dL1: Elementwise,
        dL2: Elementwise,
    ) -> "Motion":
        """Return the motion for the angle theta (rad), the leg lengths (m), and their rates."""
        return cls(*compute_sine_cosine(theta), L1, L2, dtheta, dL1, dL2)

    @property
    def lengths_and_rates(self) -> Vector:
        """Return the leg lengths, and the rates of (theta, L1, L2)."""
        return self[2:]


class SineCosine(NamedTuple):
    """Sine and cosine of one angle."""

    sin: Elementwise
    cos: Elementwise


def rotate_to_rear_leg(s: Symbols, sin_theta: Elementwise, cos_theta: Elementwise) -> SineCosine:
    """Return the sine and cosine of theta + alpha, the angle of Leg 2."""
    return SineCosine(
        sin_theta * s.cos_alpha + cos_theta * s.sin_alpha,
        cos_theta * s.cos_alpha - sin_theta * s.sin_alpha,
    )


def rotate_to_landing_leg(s: Symbols, sin_theta: Elementwise, cos_theta: Elementwise) -> SineCosine:
    """Return the sine and cosine of theta - alpha, the angle of the leg that lands next."""
    return SineCosine(
        sin_theta * s.cos_alpha - cos_theta * s.sin_alpha,
        cos_theta * s.cos_alpha + sin_theta * s.sin_alpha,
    )


def rotate_to_vertical(s: Symbols, sin_angle: Elementwise, cos_angle: Elementwise) -> SineCosine:
    """Return the sine and cosine of an angle plus phi, which is the angle from the vertical."""
    return SineCosine(
        sin_angle * s.cos_phi + cos_angle * s.sin_phi,
        cos_angle * s.cos_phi - sin_angle * s.sin_phi,
    )


def compute_rear_foot_height(s: Symbols, motion: Motion) -> Elementwise:
    """Return the height of foot 2 above the slope, m.

    The height is negative if the foot scuffs (Section 3.3.1 of the paper).
    """
    return (
        motion.L1 * motion.cos_theta
        - motion.L2 * rotate_to_rear_leg(s, motion.sin_theta, motion.cos_theta).cos
    )


def compute_landing_foot_height(s: Symbols, motion: Motion) -> Elementwise:
    """Return the height above the slope of the foot that lands next, m. It is 0 at touchdown."""
    return (
        motion.L1 * motion.cos_theta
        - s.L0 * rotate_to_landing_leg(s, motion.sin_theta, motion.cos_theta).cos
    )


def compute_length_at_touchdown(s: Symbols, theta: Elementwise) -> Elementwise:
    """Return the length of Leg 1 at which the next foot meets the ground at the angle theta, m."""
    sin_theta, cos_theta = compute_sine_cosine(theta)
    return s.L0 * rotate_to_landing_leg(s, sin_theta, cos_theta).cos / cos_theta


class DoubleSupportCircle(NamedTuple):
    """Leg lengths and their derivatives with respect to theta, for a hub on its circle."""

    L1: Elementwise  # m
    L2: Elementwise  # m
    dL1_dtheta: Elementwise  # dL1/dtheta, m/rad; the second derivative is -L1
    dL2_dtheta: Elementwise  # dL2/dtheta, m/rad; the second derivative is -L2


def compute_double_support_circle(
    s: Symbols, foot_distance: Elementwise, sin_theta: Elementwise, cos_theta: Elementwise
) -> DoubleSupportCircle:
    """Return the leg lengths and their derivatives in double support.

    The distance between the feet is `foot_distance`, m. The hub moves on a circle with the
    inscribed angle alpha (Section 2 of the paper).
    """
    hub_circle_diameter = foot_distance / s.sin_alpha
    rear_leg = rotate_to_rear_leg(s, sin_theta, cos_theta)
    return DoubleSupportCircle(
        hub_circle_diameter * rear_leg.cos,
        hub_circle_diameter * cos_theta,
        -hub_circle_diameter * rear_leg.sin,
        -hub_circle_diameter * sin_theta,
    )


class Acceleration(NamedTuple):
    """Second time derivatives of (theta, L1, L2)."""

    ddtheta: Elementwise  # rad/s^2
    ddL1: Elementwise  # m/s^2
    ddL2: Elementwise  # m/s^2


class MassMatrix(NamedTuple):
    """Symmetric mass matrix for (theta, L1, L2). M22, M33 and M23 are constants."""

    M11: Elementwise  # kg m^2
    M12: Elementwise  # kg m
    M13: Elementwise  # kg m
    M22: Elementwise  # kg
    M23: Elementwise  # kg
    M33: Elementwise  # kg

    def multiply_vector(self, x: tuple[Elementwise, Elementwise, Elementwise]) -> Vector:
        """Return the product of the mass matrix and a vector with components for theta, L1 and
        L2.
        """
        return (
            self.M11 * x[0] + self.M12 * x[1] + self.M13 * x[2],
            self.M12 * x[0] + self.M22 * x[1] + self.M23 * x[2],
            self.M13 * x[0] + self.M23 * x[1] + self.M33 * x[2],
        )


class EquationTerms(NamedTuple):
    """Mass matrix M and applied forces f of M q'' = f + constraint forces (eq. 1 of the paper)."""

    mass_matrix: MassMatrix
    applied_moment_theta: Elementwise  # N m, along theta
    applied_force_L1: Elementwise  # N, along L1
    applied_force_L2: Elementwise  # N, along L2


def compute_mass_matrix(s: Symbols, L1: Elementwise, L2: Elementwise) -> MassMatrix:
    """Return the mass matrix M(q) of eq. (1) of the paper for a planted foot of Leg 1."""
    b, hub_fixed_mass_moment = L2 - s.a, _compute_hub_fixed_mass_moment(s, L2)
    # This sum is grouped first, because it depends on parameters only.
    constant_inertia = s.m * (s.a * s.a + (s.n - 2) * s.c0 * s.c0)
    return MassMatrix(
        M11=L1 * (s.Mh * L1 + 2.0 * hub_fixed_mass_moment) + (constant_inertia + s.m * b * b),
        M12=s.m * s.sin_alpha * (L2 - s.L0),
        M13=-s.m * s.sin_alpha * L1,
        M22=s.Mh,
        M23=-s.m * s.cos_alpha,
        M33=s.m,
    )


def _compute_hub_fixed_mass_moment(s: Symbols, L2: Elementwise) -> Elementwise:
    """Return the first moment of the mass that turns rigidly with the hub, kg m."""
    return s.m * (s.c0 + s.cos_alpha * s.L0) - s.m * s.cos_alpha * L2


def compute_leg_forces(s: Symbols, motion: Motion) -> tuple[Elementwise, Elementwise]:
    """Return the forces along Leg 1 and Leg 2, which push the hub off the feet if positive, N.

    They are the forces of springs and dampers (eq. 3 of the paper), or those of a user's law.
    """
    if s.leg_force is not None:
        return (
            evaluate_leg_force(s, motion.L1, motion.dL1),
            evaluate_leg_force(s, motion.L2, motion.dL2, 2),
        )
    spring_preload = s.k * s.Ls
    return (
        (spring_preload - s.k * motion.L1) - s.c * motion.dL1,
        (spring_preload - s.k * motion.L2) - s.c * motion.dL2,
    )


def compute_equation_terms(s: Symbols, motion: Motion) -> EquationTerms:
    """Return the mass matrix and the applied forces for a motion.

    The applied forces are gravity, the forces along the legs, the torque on the hub, and the
    inertial forces.
    """
    sin, cos, L1, L2, dtheta, dL1, dL2 = motion
    mass_matrix = compute_mass_matrix(s, L1, L2)
    fore_leg = rotate_to_vertical(s, sin, cos)  # angle theta + phi
    rear_leg = rotate_to_rear_leg(s, *fore_leg)  # angle theta + alpha + phi
    half_dM11_dL1 = s.Mh * L1 + _compute_hub_fixed_mass_moment(s, L2)  # half dM11/dL1
    half_dM11_dL2 = s.m * (L2 - s.a) - s.m * s.cos_alpha * L1  # half dM11/dL2
    coriolis_factor = 2.0 * s.m * s.sin_alpha * dtheta
    fore_gravity_moment = s.g * s.m * s.L0 + s.g * s.Mh * L1
    rear_gravity_moment = s.g * s.m * s.L0 - s.g * s.m * L2
    leg_force_1, leg_force_2 = compute_leg_forces(s, motion)
    applied_moment_theta = (
        fore_gravity_moment * fore_leg.sin
        + rear_gravity_moment * rear_leg.sin
        - 2.0 * (half_dM11_dL1 * dL1 + half_dM11_dL2 * dL2) * dtheta
    )
    if s.hub_torque is not None:
        # Hub and legs turn together, so that the work of the torque is torque times dtheta.
        applied_moment_theta = applied_moment_theta + evaluate_hub_torque(s, dtheta, sin, cos)
    return EquationTerms(
        mass_matrix=mass_matrix,
        applied_moment_theta=applied_moment_theta,
        applied_force_L1=leg_force_1
        + half_dM11_dL1 * dtheta * dtheta
        - coriolis_factor * dL2
        - s.g * s.Mh * fore_leg.cos,
        applied_force_L2=leg_force_2
        + half_dM11_dL2 * dtheta * dtheta
        + coriolis_factor * dL1
        + s.g * s.m * rear_leg.cos,
    )


def solve_single_support_1(s: Symbols, motion: Motion) -> Acceleration:
    """Return the accelerations in SLS-I, which has three degrees of freedom.

    The foot of Leg 2 is in the air, and the length of Leg 2 can vary (Section 3.3.2 of the paper).
    """
    return solve_unconstrained_dynamics(s, motion.L1, compute_equation_terms(s, motion))


def solve_unconstrained_dynamics(
    s: Symbols, L1: Elementwise, equation_terms: EquationTerms
) -> Acceleration:
    """Solve M q'' = f for the accelerations q''. The only constraint is that foot 1 stays at
    rest.
    """
    M, f1, f2, f3 = equation_terms
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


def compute_takeoff_acceleration(s: Symbols, motion: Motion) -> Elementwise:
    """Return the acceleration of foot 2 normal to the slope at the start of SLS-I, m/s^2.

    At that instant, whose motion is `motion`, foot 2 is at rest on the ground. The foot rises if
    the acceleration is positive and scuffs if the acceleration is negative. The acceleration jumps
    from 0 because the tangential force of the ground vanishes. At the boundary of scuffing, the
    acceleration is smooth. The clearance, which is the smallest later height of the foot, is not
    smooth there. On one side of the boundary, the clearance vanishes with the cube of the distance
    to the boundary. On the other side, the clearance jumps.
    """
    L1, L2, dtheta = motion.L1, motion.L2, motion.dtheta
    ddtheta, ddL1, ddL2 = solve_single_support_1(s, motion)
    rear_leg = rotate_to_rear_leg(s, motion.sin_theta, motion.cos_theta)
    radial_acceleration_difference = (ddL1 - L1 * dtheta**2) * motion.cos_theta - (
        ddL2 - L2 * dtheta**2
    ) * rear_leg.cos
    tangential_acceleration_1 = 2.0 * motion.dL1 * dtheta + L1 * ddtheta
    tangential_acceleration_2 = 2.0 * motion.dL2 * dtheta + L2 * ddtheta
    return (
        radial_acceleration_difference
        - tangential_acceleration_1 * motion.sin_theta
        + tangential_acceleration_2 * rear_leg.sin
    )


def solve_single_support_2(s: Symbols, motion: Motion) -> Acceleration:
    """Return the accelerations in SLS-II, which has two degrees of freedom.

    Leg 2 is on its stopper, and M12 = 0 (Section 3.3.3 of the paper).
    """
    M, f1, f2, _ = compute_equation_terms(s, motion)
    inverse_mass = 1.0 / M.M22
    return Acceleration(f1 / M.M11, f2 * inverse_mass, 0.0 * f1)


class SingleDofEquation(NamedTuple):
    """Equation of motion: `generalized_inertia` * ddtheta = `generalized_force`."""

    generalized_inertia: Elementwise  # kg m^2
    generalized_force: Elementwise  # N m


def compute_double_support_equation(
    s: Symbols, foot_distance: Elementwise, motion: Motion
) -> SingleDofEquation:
    """Return the equation of motion in DLS, where the hub moves on a circle.

    The equation is that of `compute_equation_terms`, restricted to the circle (Section 3.3.1 of the
    paper). The sine and cosine of the bisector of the two legs are proportional to the sums of the
    legs' sines and cosines. Every term is a trigonometric polynomial in the angle of the bisector,
    with coefficients that depend only on the wheel. This form halves the cost of the restriction.
    The forces of a user's law are not among these terms, but are projected on the circle.
    """
    has_own_law = s.leg_force is not None
    k, c = (0.0, 0.0) if has_own_law else (s.k, s.c)
    hub_circle_diameter = foot_distance / s.sin_alpha
    squared_bisector_factor = 1.0 / (1.0 + s.cos_alpha)
    weight_factor = s.g * (s.Mh - s.m) * hub_circle_diameter
    sin_squared_rate_coefficient = s.m * s.c0 * hub_circle_diameter
    leg_weight_moment = s.g * s.m * s.L0
    spring_factor = k * hub_circle_diameter
    damping_factor = c * hub_circle_diameter * hub_circle_diameter
    constant_inertia = hub_circle_diameter * hub_circle_diameter * (s.Mh - s.m) + s.m * (
        2.0 * s.a * s.a + (s.n - 2) * s.c0 * s.c0
    )
    sin_coefficient = leg_weight_moment * s.cos_phi - s.Ls * spring_factor
    sin_cos_coefficient = squared_bisector_factor * (
        s.cos_alpha * hub_circle_diameter * spring_factor + weight_factor * s.cos_phi
    )
    sin_squared_coefficient = -squared_bisector_factor * weight_factor * s.sin_phi

    rear_leg, dtheta = rotate_to_rear_leg(s, motion.sin_theta, motion.cos_theta), motion.dtheta
    sin_sum, cos_sum = motion.sin_theta + rear_leg.sin, motion.cos_theta + rear_leg.cos
    sin_torque_factor = (
        sin_coefficient
        + sin_cos_coefficient * cos_sum
        + sin_squared_coefficient * sin_sum
        + sin_squared_rate_coefficient * dtheta * dtheta
    )
    slope_torque = weight_factor * s.sin_phi + leg_weight_moment * s.sin_phi * cos_sum
    damping_coefficient = (
        1.0 - s.cos_alpha
    ) * damping_factor + squared_bisector_factor * s.cos_alpha * damping_factor * (
        sin_sum * sin_sum
    )
    generalized_force = slope_torque + sin_sum * sin_torque_factor - damping_coefficient * dtheta
    if has_own_law:
        leg_force_1, leg_force_2 = compute_leg_forces(s, motion)
        generalized_force = generalized_force - hub_circle_diameter * (
            leg_force_1 * rear_leg.sin + leg_force_2 * motion.sin_theta
        )
    if s.hub_torque is not None:
        generalized_force = generalized_force + evaluate_hub_torque(
            s, dtheta, motion.sin_theta, motion.cos_theta
        )
    return SingleDofEquation(
        constant_inertia + 2.0 * sin_squared_rate_coefficient * cos_sum, generalized_force
    )


def solve_double_support(s: Symbols, foot_distance: Elementwise, motion: Motion) -> Acceleration:
    """Return the accelerations of (theta, L1, L2) in DLS.

    They solve the equation of `compute_double_support_equation`.
    """
    generalized_inertia, generalized_force = compute_double_support_equation(
        s, foot_distance, motion
    )
    hub_circle = compute_double_support_circle(s, foot_distance, motion.sin_theta, motion.cos_theta)
    return complete_accelerations_on_hub_circle(
        hub_circle, motion.dtheta, generalized_force / generalized_inertia
    )


def complete_accelerations_on_hub_circle(
    hub_circle: DoubleSupportCircle, dtheta: Elementwise, ddtheta: Elementwise
) -> Acceleration:
    """Return the accelerations of (theta, L1, L2) in double support, computed from that of
    theta.
    """
    squared_rate = dtheta * dtheta
    return Acceleration(
        ddtheta,
        hub_circle.dL1_dtheta * ddtheta - hub_circle.L1 * squared_rate,
        hub_circle.dL2_dtheta * ddtheta - hub_circle.L2 * squared_rate,
    )


class FootForce(NamedTuple):
    """Force (N) or impulse (N s) that the ground exerts on a foot."""

    tangential: Elementwise  # downhill positive: lambda_1 (fore) or lambda_3 (rear)
    normal: Elementwise  # pushing positive: lambda_2 (fore) or lambda_4 (rear)


def compute_required_friction(foot_force: FootForce) -> Elementwise:
    """Return the ratio of the tangential to the normal force, which is the required friction
    coefficient.

    The result is 0 if the normal force is not positive.
    """
    is_foot_loaded = foot_force.normal > 0.0
    friction_ratio = jnp.abs(foot_force.tangential) / jnp.where(
        is_foot_loaded, foot_force.normal, 1.0
    )
    return jnp.where(is_foot_loaded, friction_ratio, 0.0)


def compute_rear_force_from_residual(
    s: Symbols, motion: Motion, residual_L1: Elementwise, residual_L2: Elementwise
) -> FootForce:
    """Return the force of the ground on the rear foot, computed from its generalized forces.

    `residual_L1` and `residual_L2` are the generalized forces for L1 and L2 (eq. 1 of the paper).
    """
    rear_leg = rotate_to_rear_leg(s, motion.sin_theta, motion.cos_theta)
    return FootForce(
        -(rear_leg.cos * residual_L1 + motion.cos_theta * residual_L2) / s.sin_alpha,
        (rear_leg.sin * residual_L1 + motion.sin_theta * residual_L2) / s.sin_alpha,
    )


def compute_rear_foot_force(s: Symbols, motion: Motion, acceleration: Acceleration) -> FootForce:
    """Return the force of the ground on the rear foot in double support, (lambda_3, lambda_4), N.

    The force is the part of M q'' that the applied forces do not supply.
    """
    M, _, f2, f3 = compute_equation_terms(s, motion)
    inertial_force = M.multiply_vector(acceleration)
    return compute_rear_force_from_residual(
        s, motion, inertial_force[1] - f2, inertial_force[2] - f3
    )


def compute_fore_foot_force(
    s: Symbols, motion: Motion, acceleration: Acceleration, rear_force: FootForce | None = None
) -> FootForce:
    """Return the force of the ground on the fore foot, (lambda_1, lambda_2), N.

    The force is the time derivative of the total momentum minus the weight and the force on the
    rear foot.
    """
    sin, cos, L1, L2, dtheta, dL1, dL2 = motion
    ddtheta, ddL1, ddL2 = acceleration
    A, dA, ddA = s.Mh * L1 + s.m * s.L0, s.Mh * dL1, s.Mh * ddL1
    B, dB, ddB = s.m * (s.L0 - L2), -s.m * dL2, -s.m * ddL2
    radial_force_1 = ddA - A * dtheta * dtheta
    tangential_force_1 = 2.0 * dA * dtheta + A * ddtheta
    radial_force_2 = ddB - B * dtheta * dtheta
    tangential_force_2 = 2.0 * dB * dtheta + B * ddtheta
    rear_leg = rotate_to_rear_leg(s, sin, cos)
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


def compute_momentum(s: Symbols, motion: Motion) -> tuple[Elementwise, Elementwise]:
    """Return the total linear momentum in the directions x and z, kg m/s, with the foot of Leg 1 at
    rest.
    """
    sin, cos, L1, L2, dtheta, dL1, dL2 = motion
    rear_leg = rotate_to_rear_leg(s, sin, cos)
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


def compute_stopper_force(
    s: Symbols, motion: Motion, acceleration: Acceleration, leg_numbers: range
) -> Float[Array, "n_legs_asked ..."]:
    """Return the force that the stopper exerts on each leg of `leg_numbers`, N.

    Each of these legs has the length L0. The force is negative if the leg would leave its stopper.
    The spring presses the leg against the stopper with the force k (L* - L0), or that of a user's
    law at rest. The weight and the acceleration of the leg's mass reduce the force.
    """
    legs = np.asarray(leg_numbers).reshape(-1, *(1,) * jnp.ndim(motion.L1))
    if s.leg_force is None:
        spring_force = s.k * (s.Ls - s.L0)
    else:
        spring_force = evaluate_leg_force(s, s.L0, 0.0 * s.L0, legs)
    leg_angles = s.alpha * (legs - 1)
    fore_leg = rotate_to_vertical(s, motion.sin_theta, motion.cos_theta)
    # Gravity is subtracted from the acceleration of the hub, in the frame of Leg 1.
    radial_hub_acceleration = (
        acceleration.ddL1 - motion.L1 * motion.dtheta * motion.dtheta + s.g * fore_leg.cos
    )
    tangential_hub_acceleration = (
        2.0 * motion.dL1 * motion.dtheta + motion.L1 * acceleration.ddtheta - s.g * fore_leg.sin
    )
    leg_acceleration = radial_hub_acceleration * np.cos(
        leg_angles
    ) + tangential_hub_acceleration * np.sin(leg_angles)
    centrifugal_acceleration = s.c0 * motion.dtheta * motion.dtheta
    return spring_force + s.m * centrifugal_acceleration + s.m * leg_acceleration


class Energy(NamedTuple):
    """Mechanical energy, J.

    The gravitational energy is 0 at the present foot of Leg 1 (Section 3.5 of the paper).
    """

    kinetic_energy: Elementwise
    gravitational_energy: Elementwise
    elastic_energy: Elementwise

    @property
    def total_energy(self) -> Elementwise:
        """Return the total energy E of eq. (26) of the paper, J."""
        return self.kinetic_energy + self.gravitational_energy + self.elastic_energy


def compute_kinetic_energy(s: Symbols, motion: Motion) -> Elementwise:
    """Return the kinetic energy, q' M q' / 2, J."""
    coordinate_rates = (motion.dtheta, motion.dL1, motion.dL2)
    p = compute_mass_matrix(s, motion.L1, motion.L2).multiply_vector(coordinate_rates)
    return 0.5 * (
        p[0] * coordinate_rates[0] + p[1] * coordinate_rates[1] + p[2] * coordinate_rates[2]
    )


def compute_mechanical_energy(s: Symbols, motion: Motion) -> Energy:
    """Return the kinetic, gravitational and elastic energy (eqs 26, 27 of the paper), J."""
    fore_leg = rotate_to_vertical(s, motion.sin_theta, motion.cos_theta)
    mass_height_moment = (s.Mh * motion.L1 + s.m * s.L0) * fore_leg.cos + s.m * (
        s.L0 - motion.L2
    ) * rotate_to_rear_leg(s, *fore_leg).cos
    if s.leg_force is None:
        stretch_1, stretch_2, locked_stretch = motion.L1 - s.Ls, motion.L2 - s.Ls, s.L0 - s.Ls
        elastic_energy = 0.5 * s.k * (stretch_1**2 + stretch_2**2 + (s.n - 2) * locked_stretch**2)
    else:
        elastic_energy = (
            compute_leg_potential(s, motion.L1)
            + compute_leg_potential(s, motion.L2, 2)
            + (0.5 * s.n - 1.0)
            * (compute_leg_potential(s, s.L0) + compute_leg_potential(s, s.L0, 2))
        )
    return Energy(compute_kinetic_energy(s, motion), s.g * mass_height_moment, elastic_energy)


def compute_damping_power(s: Symbols, motion: Motion) -> Elementwise:
    """Return the power c (dL1^2 + dL2^2) that the dampers dissipate, W (eq. 29 of the paper).

    For a user's law, it is the power of the force at rest minus that of the force.
    """
    if s.leg_force is None:
        return s.c * (motion.dL1 * motion.dL1 + motion.dL2 * motion.dL2)
    power_1 = evaluate_damping_power(s, motion.L1, motion.dL1)
    return power_1 + evaluate_damping_power(s, motion.L2, motion.dL2, 2)
