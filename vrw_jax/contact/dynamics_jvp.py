"""Compute forces or impulses for a contact configuration, and their derivatives.

The equations are linear in accelerations and forces, or in impulses and the velocities after an
impact. The tangents of these unknowns solve the same equations, with the tangent of the residual on
the right-hand side. Only that residual is differentiated.
"""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from vrw_jax.contact.contact_modes import Friction, replace_infinite_friction, solve_combination
from vrw_jax.contact.mechanics import (
    ContactInverseInertia,
    ContactSlots,
    FreeMotion,
    HubVector,
    LegArray,
    SlotPair,
    WheelMotion,
    compute_free_acceleration,
    compute_free_velocity,
    make_inverse_inertia,
    make_opaque_one,
    multiply_by_inverse_inertia,
    prevent_fusion,
    sum_over_legs,
)
from vrw_jax.numerics import with_default_jax_settings
from vrw_jax.wheel import ContactMode, Symbols


class ContactConfiguration(NamedTuple):
    """Motion, contact modes and stopper states of a wheel, which determine the contact forces."""

    s: Symbols
    motion: WheelMotion
    friction: Friction  # friction coefficient of the feet in the contact slots
    contact_slots: ContactSlots
    slot_modes: Array  # `ContactMode` of the foot in each contact slot
    is_stopper_holding: Array  # whether the leg in each contact slot is on its stopper
    is_airborne_leg_locked: Array  # whether a leg is in the air on its stopper

    @property
    def is_leg_length_fixed(self) -> Array:
        """Return whether the length of each leg is fixed by a stopper."""
        return self.is_airborne_leg_locked | (
            self.contact_slots.scatter_to_legs(self.is_stopper_holding) > 0
        )


class WheelForceSolution(NamedTuple):
    """Forces of ground and stoppers, and the resulting motion of the hub and of all legs.

    The fields are described in `contact_modes.SlotForceSolution`.
    """

    tangential_forces: SlotPair
    normal_forces: SlotPair
    stopper_forces: SlotPair
    leg_pull_forces: SlotPair
    hub_motion: HubVector
    painleve_determinant: Array
    length_motion: LegArray  # accelerations of the legs' lengths, or rates after an impact


def compute_slip_signs(slot_modes: Array) -> SlotPair:
    """Return the slip direction of each foot in contact: 1 downhill, -1 uphill, 0 for no slip."""
    select_slip_sign = lambda mode: jnp.where(
        mode == ContactMode.SLIP_DOWN, 1.0, jnp.where(mode == ContactMode.SLIP_UP, -1.0, 0.0)
    )
    return select_slip_sign(slot_modes[0]), select_slip_sign(slot_modes[1])


class _ConstantMotionTerms(NamedTuple):
    """Accelerations or velocity jumps that the tangent of the residual treats as constants."""

    radial_leg_motion: LegArray  # motion of the leg masses relative to the hub, along the legs
    # motion of the leg masses relative to the hub, transverse to the legs
    transverse_leg_motion: LegArray
    hub_motion: SlotPair  # motion of the hub without gravity


class _EquationTangents(NamedTuple):
    """Tangents of the equations of motion or impact.

    Accelerations or velocity jumps are treated as constants.
    """

    radial_leg_motion: LegArray
    transverse_leg_motion: LegArray
    hub_motion: SlotPair
    spring_force: LegArray | float  # N
    foot_transverse_motion: SlotPair
    foot_radial_motion: SlotPair


_EquationTangentFn = Callable[
    [ContactConfiguration, ContactConfiguration, ContactInverseInertia, WheelForceSolution],
    tuple[_ConstantMotionTerms, _EquationTangents],
]


@eqx.filter_jit  # This function is traced once for all call sites.
def solve_contact_forces(contact_configuration: ContactConfiguration) -> WheelForceSolution:
    """Return the contact forces (N) and the resulting accelerations, with a JVP rule."""
    return _solve_with_jvp_rule(
        compute_free_acceleration, _compute_motion_equation_tangents, contact_configuration
    )


@eqx.filter_jit
def solve_impact(contact_configuration: ContactConfiguration) -> WheelForceSolution:
    """Return the impulses in an impact (N s) and the velocities after it, with a JVP rule."""
    return _solve_with_jvp_rule(
        compute_free_velocity, _compute_impact_equation_tangents, contact_configuration
    )


def solve_contact_configuration(
    contact_configuration: ContactConfiguration,
    inverse_inertia: ContactInverseInertia,
    free_motion: FreeMotion,
) -> WheelForceSolution:
    """Return the contact forces or impulses for a configuration with a known free motion.

    - `inverse_inertia`: inverse inertia for the posture of the configuration;
    - `free_motion`: accelerations without contact forces, or velocities without impulses.
    """
    s, _, friction, contact_slots, slot_modes, is_stopper_holding, _ = contact_configuration
    slot_solution = solve_combination(
        s, inverse_inertia, free_motion, slot_modes, is_stopper_holding, friction
    )
    outward_leg_motion = (
        free_motion.leg_motion
        + inverse_inertia.leg_directions.sin * slot_solution.hub_motion[0]
        + inverse_inertia.leg_directions.cos * slot_solution.hub_motion[1]
    )
    length_motion = jnp.where(
        contact_configuration.is_leg_length_fixed,
        0.0,
        outward_leg_motion - contact_slots.scatter_to_legs(slot_solution.leg_pull_forces) / s.m,
    )
    force_pairs = (
        slot_solution.tangential_forces,
        slot_solution.normal_forces,
        slot_solution.stopper_forces,
        slot_solution.leg_pull_forces,
    )
    return WheelForceSolution(
        *force_pairs, slot_solution.hub_motion, slot_solution.painleve_determinant, length_motion
    )


def _solve_with_free_motion(
    free_motion_fn: Callable[..., FreeMotion], contact_configuration: ContactConfiguration
) -> tuple[ContactInverseInertia, FreeMotion, WheelForceSolution]:
    """Return inverse inertia, free motion, and forces or impulses for a contact configuration."""
    s = contact_configuration.s
    motion = contact_configuration.motion
    opaque_one = make_opaque_one(contact_configuration.motion)
    inverse_inertia = prevent_fusion(
        make_inverse_inertia(
            s,
            motion,
            contact_configuration.contact_slots,
            contact_configuration.is_airborne_leg_locked,
        ),
        opaque_one,
    )
    free_motion = prevent_fusion(
        free_motion_fn(s, motion, contact_configuration.contact_slots, inverse_inertia),
        opaque_one,
    )
    return (
        inverse_inertia,
        free_motion,
        prevent_fusion(
            solve_contact_configuration(contact_configuration, inverse_inertia, free_motion),
            opaque_one,
        ),
    )


def _solve_with_jvp_rule(
    free_motion_fn: Callable[..., FreeMotion],
    equation_tangent_fn: _EquationTangentFn,
    contact_configuration: ContactConfiguration,
) -> WheelForceSolution:
    """Return the forces or impulses for a contact configuration, with a JVP rule.

    The JVP rule solves the contact equations with the tangent of the residual on the right-hand
    side.
    """
    float_leaves, nonarray_leaves = eqx.partition(contact_configuration, eqx.is_inexact_array)
    nonfloat_arrays, nonarray_leaves = eqx.partition(nonarray_leaves, eqx.is_array)
    assemble_configuration = lambda float_leaves, nonfloat_arrays: eqx.combine(
        float_leaves, nonfloat_arrays, nonarray_leaves
    )
    solve_from_arrays = jax.custom_jvp(
        lambda *arrays: _solve_with_free_motion(free_motion_fn, assemble_configuration(*arrays))[2]
    )

    @solve_from_arrays.defjvp
    @with_default_jax_settings
    def compute_solution_jvp(
        primals: tuple, tangents: tuple
    ) -> tuple[WheelForceSolution, WheelForceSolution]:
        contact_configuration = assemble_configuration(*primals)
        configuration_tangent = assemble_configuration(tangents[0], primals[1])
        inverse_inertia, free_motion, force_solution = _solve_with_free_motion(
            free_motion_fn, contact_configuration
        )
        residual_tangent = _compute_residual_tangent(
            contact_configuration,
            configuration_tangent,
            inverse_inertia,
            force_solution,
            *equation_tangent_fn(
                contact_configuration, configuration_tangent, inverse_inertia, force_solution
            ),
        )
        free_motion_tangents = _compute_free_motion_tangent(
            contact_configuration.contact_slots, inverse_inertia, residual_tangent
        )
        _, solution_tangent = jax.jvp(
            lambda free_motion: solve_contact_configuration(
                contact_configuration, inverse_inertia, free_motion
            ),
            (free_motion,),
            (free_motion_tangents,),
        )
        add_slot_pairs = lambda first_pair, second_pair: (
            first_pair[0] + second_pair[0],
            first_pair[1] + second_pair[1],
        )
        return force_solution, solution_tangent._replace(
            tangential_forces=add_slot_pairs(
                solution_tangent.tangential_forces, residual_tangent.friction_force
            ),
            leg_pull_forces=add_slot_pairs(
                solution_tangent.leg_pull_forces, residual_tangent.leg_pull_forces
            ),
        )

    return solve_from_arrays(float_leaves, nonfloat_arrays)


class _ResidualTangent(NamedTuple):
    """Tangent of the residual of the contact equations, with one entry per leg or contact slot."""

    leg_length_residual: LegArray  # effect on each leg's length
    hub_residual_by_leg: tuple[
        LegArray, LegArray, LegArray
    ]  # effect of each leg on the hub's equations
    hub_residual_without_legs: HubVector  # effect on the hub's equations without the legs
    foot_transverse_motion: SlotPair
    foot_radial_motion: SlotPair
    friction_force: SlotPair  # tangent of the friction force by its coefficient
    leg_pull_forces: SlotPair  # tangent due to friction and rotation of the legs in contact


def _compute_residual_tangent(
    contact_configuration: ContactConfiguration,
    configuration_tangent: ContactConfiguration,
    inverse_inertia: ContactInverseInertia,
    force_solution: WheelForceSolution,
    constant_motion_terms: _ConstantMotionTerms,
    equation_tangents: _EquationTangents,
) -> _ResidualTangent:
    """Return the tangent of the contact equations' residual for a tangent of the configuration.

    - `configuration_tangent`: tangent of the configuration;
    - `constant_motion_terms`: accelerations or velocity jumps that are treated as constants;
    - `equation_tangents`: tangents of the equations for these constant terms.
    """
    s, ds, contact_slots, (sin, cos), slot_indices = (
        contact_configuration.s,
        configuration_tangent.s,
        contact_configuration.contact_slots,
        inverse_inertia.leg_directions,
        range(2),
    )
    b = contact_configuration.motion.L - s.a
    db = configuration_tangent.motion.L - ds.a
    dtheta = configuration_tangent.motion.theta
    slip_signs = compute_slip_signs(contact_configuration.slot_modes)
    friction_coefficient_tangent = jax.jvp(
        replace_infinite_friction,
        (contact_configuration.friction,),
        (configuration_tangent.friction,),
    )[1]
    friction_coefficient_tangent = (
        friction_coefficient_tangent
        if isinstance(friction_coefficient_tangent, tuple)
        else (friction_coefficient_tangent, friction_coefficient_tangent)
    )
    t = force_solution.tangential_forces
    n = force_solution.normal_forces
    L = inverse_inertia.L
    dL = contact_slots.gather_slot_pair(configuration_tangent.motion.L)
    friction_force_tangents = [
        -slip_signs[i] * friction_coefficient_tangent[i] * n[i] for i in slot_indices
    ]
    transverse_forces = [
        t[i] * inverse_inertia.cos[i] - n[i] * inverse_inertia.sin[i] for i in slot_indices
    ]
    radial_forces = [
        t[i] * inverse_inertia.sin[i] + n[i] * inverse_inertia.cos[i] for i in slot_indices
    ]
    leg_pull_tangent = [
        friction_force_tangents[i] * inverse_inertia.sin[i] + transverse_forces[i] * dtheta
        for i in slot_indices
    ]
    foot_moments = [
        dL[i] * transverse_forces[i]
        + L[i] * (friction_force_tangents[i] * inverse_inertia.cos[i] - radial_forces[i] * dtheta)
        for i in slot_indices
    ]

    (hub_motion_x, hub_motion_z), (hub_motion_tangent_x, hub_motion_tangent_z) = (
        constant_motion_terms.hub_motion,
        equation_tangents.hub_motion,
    )
    radial_hub_motion = sin * hub_motion_x + cos * hub_motion_z
    transverse_residual = (
        constant_motion_terms.transverse_leg_motion - cos * hub_motion_x + sin * hub_motion_z
    )
    length_tangent = (
        (cos * hub_motion_x - sin * hub_motion_z) * dtheta
        - equation_tangents.radial_leg_motion
        + sin * hub_motion_tangent_x
        + cos * hub_motion_tangent_z
    )
    length_tangent = (
        length_tangent
        + (
            equation_tangents.spring_force
            - contact_slots.scatter_to_legs(leg_pull_tangent)
            + (radial_hub_motion - constant_motion_terms.radial_leg_motion) * ds.m
        )
        / s.m
    )
    length_tangent = jnp.where(inverse_inertia.is_leg_released, length_tangent, 0.0)
    radial_tangent = length_tangent + equation_tangents.radial_leg_motion
    x = (
        constant_motion_terms.radial_leg_motion * sin
        + constant_motion_terms.transverse_leg_motion * cos
    )
    z = (
        constant_motion_terms.radial_leg_motion * cos
        - constant_motion_terms.transverse_leg_motion * sin
    )
    leg_torque = db * transverse_residual + b * (
        equation_tangents.transverse_leg_motion
        + radial_hub_motion * dtheta
        - cos * hub_motion_tangent_x
        + sin * hub_motion_tangent_z
    )
    return _ResidualTangent(
        leg_length_residual=length_tangent,
        hub_residual_by_leg=(
            s.m
            * (radial_tangent * sin + equation_tangents.transverse_leg_motion * cos + z * dtheta)
            + ds.m * x,
            s.m
            * (radial_tangent * cos - equation_tangents.transverse_leg_motion * sin - x * dtheta)
            + ds.m * z,
            -s.m * leg_torque
            - ds.m * (b * transverse_residual)
            - contact_slots.scatter_to_legs(foot_moments),
        ),
        hub_residual_without_legs=(
            friction_force_tangents[0]
            + friction_force_tangents[1]
            - ds.Mt * hub_motion_x
            - s.Mt * hub_motion_tangent_x,
            -ds.Mt * hub_motion_z - s.Mt * hub_motion_tangent_z,
            0.0,
        ),
        foot_transverse_motion=equation_tangents.foot_transverse_motion,
        foot_radial_motion=equation_tangents.foot_radial_motion,
        friction_force=(friction_force_tangents[0], friction_force_tangents[1]),
        leg_pull_forces=(leg_pull_tangent[0], leg_pull_tangent[1]),
    )


def _compute_free_motion_tangent(
    contact_slots: ContactSlots,
    inverse_inertia: ContactInverseInertia,
    residual_tangent: _ResidualTangent,
) -> FreeMotion:
    """Return the tangent of the free motion that is equivalent to the tangent of the residual."""
    x, z, rotation = (
        sum_over_legs(residual_by_leg) + residual_without_legs
        for residual_by_leg, residual_without_legs in zip(
            residual_tangent.hub_residual_by_leg,
            residual_tangent.hub_residual_without_legs,
            strict=True,
        )
    )
    hub_motion_tangent = multiply_by_inverse_inertia(
        inverse_inertia.inverse_inertia, (x, z, rotation)
    )
    slot_length_tangents = contact_slots.gather_slot_pair(residual_tangent.leg_length_residual)
    u, v = residual_tangent.foot_radial_motion
    e = [
        inverse_inertia.cos[i] * hub_motion_tangent[0]
        - inverse_inertia.sin[i] * hub_motion_tangent[1]
        - inverse_inertia.L[i] * hub_motion_tangent[2]
        for i in range(2)
    ]
    e = [e[i] + residual_tangent.foot_transverse_motion[i] for i in range(2)]
    return FreeMotion(
        hub_motion_tangent,
        residual_tangent.leg_length_residual,
        slot_length_tangents,
        (e[0], e[1]),
        (u - slot_length_tangents[0], v - slot_length_tangents[1]),
    )


def _compute_motion_equation_tangents(
    contact_configuration: ContactConfiguration,
    configuration_tangent: ContactConfiguration,
    inverse_inertia: ContactInverseInertia,
    force_solution: WheelForceSolution,
) -> tuple[_ConstantMotionTerms, _EquationTangents]:
    """Return the constant accelerations, and the tangents of the equations of motion."""
    s = contact_configuration.s
    motion = contact_configuration.motion
    contact_slots = contact_configuration.contact_slots
    ds = configuration_tangent.s
    motion_tangent = configuration_tangent.motion
    dtheta = configuration_tangent.motion.theta
    b, db, ddtheta = motion.L - s.a, motion_tangent.L - ds.a, force_solution.hub_motion[2]
    squared_angular_rate, doubled_angular_rate = motion.dtheta * motion.dtheta, 2.0 * motion.dtheta
    squared_angular_rate_tangent = doubled_angular_rate * motion_tangent.dtheta
    doubled_angular_rate_tangent = 2.0 * motion_tangent.dtheta
    spring_force_tangent = ds.k * (s.Ls - motion.L) - ds.c * motion.dL
    spring_force_tangent = (
        spring_force_tangent + s.k * (ds.Ls - motion_tangent.L) - s.c * motion_tangent.dL
    )
    constant_motion_terms = _ConstantMotionTerms(
        radial_leg_motion=force_solution.length_motion - b * squared_angular_rate,
        transverse_leg_motion=doubled_angular_rate * motion.dL + b * ddtheta,
        hub_motion=(
            force_solution.hub_motion[0] - s.g * s.sin_phi,
            force_solution.hub_motion[1] + s.g * s.cos_phi,
        ),
    )
    L, dL, slot_length_rates, slot_length_rate_tangents = (
        inverse_inertia.L,
        *map(contact_slots.gather_slot_pair, (motion_tangent.L, motion.dL, motion_tangent.dL)),
    )
    slot_accelerations = contact_slots.gather_slot_pair(force_solution.length_motion)
    foot_transverse = [
        (L[i] * squared_angular_rate - slot_accelerations[i]) * dtheta
        - doubled_angular_rate * slot_length_rate_tangents[i]
        - slot_length_rates[i] * doubled_angular_rate_tangent
        - ddtheta * dL[i]
        for i in range(2)
    ]
    foot_radial = [
        (doubled_angular_rate * slot_length_rates[i] + ddtheta * L[i]) * dtheta
        + squared_angular_rate * dL[i]
        + L[i] * squared_angular_rate_tangent
        for i in range(2)
    ]
    return constant_motion_terms, _EquationTangents(
        radial_leg_motion=-(db * squared_angular_rate + b * squared_angular_rate_tangent),
        transverse_leg_motion=doubled_angular_rate * motion_tangent.dL
        + motion.dL * doubled_angular_rate_tangent
        + ddtheta * db,
        hub_motion=(-ds.g * s.sin_phi - s.g * ds.sin_phi, ds.g * s.cos_phi + s.g * ds.cos_phi),
        spring_force=spring_force_tangent,
        foot_transverse_motion=(foot_transverse[0], foot_transverse[1]),
        foot_radial_motion=(foot_radial[0], foot_radial[1]),
    )


def _compute_impact_equation_tangents(
    contact_configuration: ContactConfiguration,
    configuration_tangent: ContactConfiguration,
    inverse_inertia: ContactInverseInertia,
    force_solution: WheelForceSolution,
) -> tuple[_ConstantMotionTerms, _EquationTangents]:
    """Return the constant velocity jumps, and the tangents of the impact equations."""
    s = contact_configuration.s
    motion = contact_configuration.motion
    motion_tangent = configuration_tangent.motion
    contact_slots = contact_configuration.contact_slots
    dtheta_after = force_solution.hub_motion[2]
    angular_rate_jump, b = dtheta_after - motion.dtheta, motion.L - s.a
    constant_motion_terms = _ConstantMotionTerms(
        radial_leg_motion=force_solution.length_motion - motion.dL,
        transverse_leg_motion=b * angular_rate_jump,
        hub_motion=(
            force_solution.hub_motion[0] - motion.vx,
            force_solution.hub_motion[1] - motion.vz,
        ),
    )
    slot_length_rates = contact_slots.gather_slot_pair(force_solution.length_motion)
    dL = contact_slots.gather_slot_pair(motion_tangent.L)
    foot_transverse = [
        -dtheta_after * dL[i] - slot_length_rates[i] * motion_tangent.theta for i in range(2)
    ]
    return constant_motion_terms, _EquationTangents(
        radial_leg_motion=-motion_tangent.dL,
        transverse_leg_motion=(motion_tangent.L - configuration_tangent.s.a) * angular_rate_jump
        - b * motion_tangent.dtheta,
        hub_motion=(-motion_tangent.vx, -motion_tangent.vz),
        spring_force=0.0,
        foot_transverse_motion=(foot_transverse[0], foot_transverse[1]),
        foot_radial_motion=(
            inverse_inertia.L[0] * dtheta_after * motion_tangent.theta,
            inverse_inertia.L[1] * dtheta_after * motion_tangent.theta,
        ),
    )
