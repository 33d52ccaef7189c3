"""Landings on even and uneven ground, the collision of Leg 2 with its stopper, and rest.

The landing follows Section 3.4.1 of the paper, with the procedure of its Section 5.1. The collision
with the stopper follows Section 3.4.2 of the paper.

On uneven ground, straight lines join the footholds, and both feet of a double support stand on one
of them. The slopes of the lines are given, or the heights of the footholds above a mean line. A
slope between two heights depends on the distance of the feet, and therefore on the motion.

For a wheel at rest, round-off decides which guard ends the step, or whether any guard does. The
outcome therefore depends only on the state at the end of the step. It is the same with every
engine.
"""

import functools
import operator
from collections.abc import Iterable, Sequence
from enum import IntEnum
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from vrw_jax.base.elementwise import Elementwise, compute_arcsine, compute_sine_cosine
from vrw_jax.base.results import Outcome
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

    # (A3) If only the landing foot stays on the ground, M rates = p. Momenta take the place of
    # forces, so that the results are rates instead of accelerations.
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
    s: Symbols, motion: Motion, hub_velocity_jump: tuple[Elementwise, Elementwise]
) -> Float[Array, "n_locked ..."]:
    """Return the impulse that the stopper exerts on the mass of each of legs 3 to n, N s.

    The impulse follows from the jump of the hub's velocity. It is negative if the collision throws
    the leg off its stopper, because the preload of a spring resists no impulse.
    """
    leg_angles = s.alpha * np.arange(2, s.n).reshape(-1, *(1,) * jnp.ndim(motion.sin_theta))
    (x, z), sin, cos = hub_velocity_jump, motion.sin_theta, motion.cos_theta
    radial_jump, transverse_jump = x * sin + z * cos, x * cos - z * sin
    return s.m * (radial_jump * np.cos(leg_angles) + transverse_jump * np.sin(leg_angles))


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


def compute_line_slope(
    mean_slope: Elementwise, rise: Elementwise, foot_distance: Elementwise
) -> Elementwise:
    """Return the slope of the line from one foothold to the next one, rad.

    - `mean_slope`: slope of the line from which heights are measured, rad;
    - `rise`: height of the next foothold minus that of the foothold, m;
    - `foot_distance`: distance between both footholds, m.
    """
    return mean_slope - compute_arcsine(rise / foot_distance)


class GroundAhead(NamedTuple):
    """Ground ahead of a step, seen from the line under both feet of its double support.

    The reference line begins under the foot of Leg 1. It is the next line of the ground if slopes
    are given, and parallel to the mean line if heights are given.
    """

    tilt: Elementwise  # angle by which the reference line is steeper, rad
    rise: Elementwise | None = None  # height of the next foothold above it, m; None for slopes

    def compute_next_line_tilt(self, foot_distance: Elementwise) -> Elementwise:
        """Return the angle by which the next line of the ground is steeper, rad.

        - `foot_distance`: distance between the next foothold and the foot of Leg 1, m.
        """
        if self.rise is None:
            return self.tilt
        return compute_line_slope(self.tilt, self.rise, foot_distance)


def compute_foot_distance(s: Symbols, theta: Elementwise) -> Elementwise:
    """Return the distance between both feet at the touchdown with the angle theta, m."""
    return s.L0 * s.sin_alpha / compute_sine_cosine(theta)[1]


def compute_foot_distance_for_length(s: Symbols, L1: Elementwise) -> Elementwise:
    """Return the distance between the foot of Leg 1 and the foot that lands next, m."""
    return jnp.sqrt(L1 * L1 + s.L0 * s.L0 - 2.0 * s.L0 * s.cos_alpha * L1)


POSSIBLE_OUTCOMES_AT_REST = (Outcome.FELL_BACK, Outcome.NO_TOUCHDOWN_IN_TIME, Outcome.SOLVER_FAILED)
"""Outcomes with which a step can end before the wheel is recognized to be at rest."""

MAX_REST_SPEED = 1e-8
"""Largest speed of a wheel at rest, in the wheel's own units. The value is chosen because it is a
thousand times the error of a solver step at the default tolerances.
"""
REST_SPEED_PER_ATOL = 10.0
"""Upper bound on the speed of a wheel at rest, divided by the absolute tolerance. The larger of
this bound and `MAX_REST_SPEED` is used. The value is chosen because the errors of solver steps stay
below one tolerance.
"""
MAX_REST_ACCELERATION = 1e-4
"""Largest acceleration of a wheel at rest, in the wheel's own units. The value is chosen because it
lies between two scales: errors of the accelerations of stiff legs are below 1e-5, and accelerations
of wheels that fall back are near 1.
"""


def are_rates_negligible(
    coordinate_rates: Iterable[Elementwise], rate_units: Iterable[Elementwise], atol: Elementwise
) -> Bool[Array, "..."]:
    """Return whether all rates are 0 within the accuracy of the solver steps.

    - `rate_units`: the wheel's own unit of each rate;
    - `atol`: absolute tolerance in the wheel's own units.
    """
    max_speed = jnp.maximum(MAX_REST_SPEED, REST_SPEED_PER_ATOL * atol)
    return _are_quantities_small(coordinate_rates, rate_units, max_speed)


def are_coordinates_at_rest(
    coordinate_rates: Iterable[Elementwise],
    coordinate_accelerations: Iterable[Elementwise],
    rate_units: Sequence[Elementwise] | Array,
    time_unit: Elementwise,
    atol: Elementwise,
) -> Bool[Array, "..."]:
    """Return whether rates and accelerations of all coordinates are negligible.

    - `rate_units`, `time_unit`: the wheel's own units of the rates and of time;
    - `atol`: absolute tolerance in the wheel's own units.
    """
    return are_rates_negligible(coordinate_rates, rate_units, atol) & _are_quantities_small(
        coordinate_accelerations, rate_units, MAX_REST_ACCELERATION / time_unit
    )


def _are_quantities_small(
    quantities: Iterable[Elementwise],
    quantity_units: Iterable[Elementwise],
    max_value_in_units: Elementwise,
) -> Bool[Array, "..."]:
    is_quantity_small = [
        jnp.abs(x) <= max_value_in_units * quantity_unit
        for x, quantity_unit in zip(quantities, quantity_units, strict=True)
    ]
    return functools.reduce(operator.and_, is_quantity_small)


def replace_rest_outcome(
    step_outcome: Int[Array, "..."], is_at_rest: Bool[Array, "..."]
) -> Int[Array, "..."]:
    """Return the outcomes of steps. The outcome is CAME_TO_REST if the wheel is at rest at the
    end.
    """
    has_rest_outcome = functools.reduce(
        operator.or_,
        [step_outcome == possible_outcome for possible_outcome in POSSIBLE_OUTCOMES_AT_REST],
    )
    return jnp.where(has_rest_outcome & is_at_rest, jnp.int32(Outcome.CAME_TO_REST), step_outcome)


class ContactMode(IntEnum):
    """Contact mode of a foot. Section states and trajectories contain these integers."""

    OFF = 0  # in the air
    STICK = 1  # at rest on the ground
    SLIP_DOWN = 2  # sliding downhill
    SLIP_UP = 3  # sliding uphill
