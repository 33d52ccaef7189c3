"""Compute forces or impulses for a contact configuration, and their derivatives.

The equations are linear in accelerations and forces, or in impulses and the velocities after an
impact. The tangents of these unknowns solve the same equations, with the tangent of the residual on
the right-hand side. Only that residual is differentiated.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from vrw_jax.base.types import Elementwise
from vrw_jax.lanes.settings import with_default_jax_settings
from vrw_jax.models.contact_mechanics import (
    ContactInverseInertia,
    ContactSlots,
    FreeMotion,
    Friction,
    HubVector,
    LegArray,
    SlotArray,
    WheelMotion,
    compute_free_acceleration,
    compute_free_velocity,
    find_contact_slots,
    make_inverse_inertia,
    make_opaque_one,
    multiply_by_inverse_inertia,
    prevent_fusion,
    select_slot_friction,
    sum_over_legs,
)
from vrw_jax.models.contact_modes import replace_infinite_friction, solve_combination
from vrw_jax.wheel.laws import evaluate_hub_torque, evaluate_leg_force, number_legs
from vrw_jax.wheel.outcomes import ContactMode
from vrw_jax.wheel.params import Symbols


class ContactConfiguration(NamedTuple):
    """Motion, contact modes and stopper states of a wheel, which determine the contact forces."""

    s: Symbols
    motion: WheelMotion
    friction: SlotArray  # friction coefficient of the feet in the contact slots
    contact_slots: ContactSlots
    slot_modes: Array  # `ContactMode` of the foot in each contact slot
    is_stopper_holding: Array  # whether the leg in each contact slot is on its stopper
    is_airborne_leg_locked: Array  # whether a leg is in the air on its stopper
    known_solution: Any = None  # forces and motion, if only their derivatives are computed

    @property
    def is_leg_length_fixed(self) -> Array:
        """Return whether the length of each leg is fixed by a stopper."""
        return self.is_airborne_leg_locked | (
            self.contact_slots.scatter_to_legs(self.is_stopper_holding) > 0
        )


def find_slot_contacts(
    friction: Friction | float, contact_modes: Array, is_leg_locked: Array
) -> tuple[SlotArray, ContactSlots, Array, Array, Array]:
    """Return the fields of `ContactConfiguration` after the motion for the contacts of all legs.

    - `friction`: friction coefficient for all feet, or a pair for the foot that landed last and for
      all other feet;
    - `contact_modes`, `is_leg_locked`: `ContactMode` of every foot, and whether each leg is on its
      stopper.
    """
    contact_slots = find_contact_slots(contact_modes != ContactMode.OFF)
    return (
        select_slot_friction(friction, contact_slots),
        contact_slots,
        contact_slots.gather_from_legs(contact_modes),
        contact_slots.gather_flags_from_legs(is_leg_locked),
        is_leg_locked & ~contact_slots.is_in_slot,
    )


class WheelForceSolution(NamedTuple):
    """Forces of ground and stoppers, and the resulting motion of the hub and of all legs.

    The fields are described in `contact_modes.SlotForceSolution`.
    """

    tangential_forces: SlotArray
    normal_forces: SlotArray
    stopper_forces: SlotArray
    hub_motion: HubVector
    painleve_determinant: Array
    length_motion: LegArray  # accelerations of the legs' lengths, or rates after an impact


def compute_slip_signs(slot_modes: Array) -> SlotArray:
    """Return the slip direction of each foot in contact: 1 downhill, -1 uphill, 0 for no slip."""
    return jnp.where(
        slot_modes == ContactMode.SLIP_DOWN,
        1.0,
        jnp.where(slot_modes == ContactMode.SLIP_UP, -1.0, 0.0),
    )


class _ConstantMotionTerms(NamedTuple):
    """Accelerations or velocity jumps that the tangent of the residual treats as constants."""

    radial_leg_motion: LegArray  # motion of the leg masses relative to the hub, along the legs
    # motion of the leg masses relative to the hub, transverse to the legs
    transverse_leg_motion: LegArray
    hub_motion: tuple[Array, Array]  # motion of the hub along x and z without gravity


class _EquationTangents(NamedTuple):
    """Tangents of the equations of motion or impact.

    Accelerations or velocity jumps are treated as constants.
    """

    radial_leg_motion: LegArray
    transverse_leg_motion: LegArray
    hub_motion: tuple[Array, Array]
    spring_force: LegArray | float  # N
    hub_torque: Array | float  # N m; 0.0 without a motor, and in impacts
    foot_transverse_motion: SlotArray
    foot_radial_motion: SlotArray


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
    s, _, friction, contact_slots, slot_modes, is_stopper_holding, *_ = contact_configuration
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
    return WheelForceSolution(
        *slot_solution[:3],
        slot_solution.hub_motion,
        slot_solution.painleve_determinant,
        length_motion,
    )


def _solve_with_free_motion(
    free_motion_fn: Callable[..., FreeMotion], contact_configuration: ContactConfiguration
) -> tuple[ContactInverseInertia, FreeMotion, WheelForceSolution]:
    """Return inverse inertia, free motion, and forces or impulses for a contact configuration."""
    s, motion, _, contact_slots, _, _, is_airborne_leg_locked, known_solution = (
        contact_configuration
    )
    opaque_one = make_opaque_one(motion.theta)
    inverse_inertia = prevent_fusion(
        make_inverse_inertia(s, motion, contact_slots, is_airborne_leg_locked), opaque_one
    )
    free_motion = prevent_fusion(
        free_motion_fn(s, motion, contact_slots, inverse_inertia), opaque_one
    )
    force_solution = known_solution or solve_contact_configuration(
        contact_configuration, inverse_inertia, free_motion
    )
    return inverse_inertia, free_motion, prevent_fusion(force_solution, opaque_one)


def _solve_with_jvp_rule(
    free_motion_fn: Callable[..., FreeMotion],
    equation_tangent_fn: Callable[..., tuple[_ConstantMotionTerms, _EquationTangents]],
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
        free_motion_tangent, friction_force_tangents = _compute_free_motion_tangent(
            contact_configuration,
            configuration_tangent,
            inverse_inertia,
            force_solution,
            *equation_tangent_fn(
                contact_configuration, configuration_tangent, inverse_inertia, force_solution
            ),
        )
        _, solution_tangent = jax.jvp(
            lambda free_motion: solve_contact_configuration(
                contact_configuration, inverse_inertia, free_motion
            ),
            (free_motion,),
            (free_motion_tangent,),
        )
        return force_solution, solution_tangent._replace(
            tangential_forces=solution_tangent.tangential_forces + friction_force_tangents
        )

    return solve_from_arrays(float_leaves, nonfloat_arrays)


def _compute_free_motion_tangent(
    contact_configuration: ContactConfiguration,
    configuration_tangent: ContactConfiguration,
    inverse_inertia: ContactInverseInertia,
    force_solution: WheelForceSolution,
    constant_motion_terms: _ConstantMotionTerms,
    equation_tangents: _EquationTangents,
) -> tuple[FreeMotion, SlotArray]:
    """Return the tangent of the free motion that is equivalent to the tangent of the residual.

    The residual is that of the contact equations. The result is (free motion, friction forces by
    their coefficient).

    - `configuration_tangent`: tangent of the configuration;
    - `constant_motion_terms`: accelerations or velocity jumps that are treated as constants;
    - `equation_tangents`: tangents of the equations for these constant terms.
    """
    s, motion, friction, contact_slots, slot_modes, *_ = contact_configuration
    ds, motion_tangent, friction_tangent, *_ = configuration_tangent
    sin, cos = inverse_inertia.leg_directions
    b, db, dtheta = motion.L - s.a, motion_tangent.L - ds.a, motion_tangent.theta
    _, friction_coefficient_tangent = jax.jvp(
        replace_infinite_friction, (friction,), (friction_tangent,)
    )
    t, n = force_solution.tangential_forces, force_solution.normal_forces
    slot_sin, slot_cos = inverse_inertia.sin, inverse_inertia.cos
    friction_force_tangents = -compute_slip_signs(slot_modes) * friction_coefficient_tangent * n
    transverse_forces = t * slot_cos - n * slot_sin
    radial_forces = t * slot_sin + n * slot_cos
    leg_pull_tangents = friction_force_tangents * slot_sin + transverse_forces * dtheta
    foot_moments = contact_slots.gather_from_legs(
        motion_tangent.L
    ) * transverse_forces + inverse_inertia.L * (
        friction_force_tangents * slot_cos - radial_forces * dtheta
    )

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
            - contact_slots.scatter_to_legs(leg_pull_tangents)
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
    force_x_by_leg = (
        s.m * (radial_tangent * sin + equation_tangents.transverse_leg_motion * cos + z * dtheta)
        + ds.m * x
    )
    force_z_by_leg = (
        s.m * (radial_tangent * cos - equation_tangents.transverse_leg_motion * sin - x * dtheta)
        + ds.m * z
    )
    torque_by_leg = (
        -s.m * leg_torque
        - ds.m * (b * transverse_residual)
        - contact_slots.scatter_to_legs(foot_moments)
    )
    hub_residual = (
        sum_over_legs(force_x_by_leg)
        + (
            friction_force_tangents[0]
            + friction_force_tangents[1]
            - ds.Mt * hub_motion_x
            - s.Mt * hub_motion_tangent_x
        ),
        sum_over_legs(force_z_by_leg) + (-ds.Mt * hub_motion_z - s.Mt * hub_motion_tangent_z),
        sum_over_legs(torque_by_leg),
    )
    if s.hub_torque is not None:
        force_x, force_z, torque = hub_residual
        hub_residual = force_x, force_z, torque + equation_tangents.hub_torque
    hub_motion_tangent = multiply_by_inverse_inertia(inverse_inertia.inverse_inertia, hub_residual)
    slot_length_tangents = contact_slots.gather_from_legs(length_tangent)
    free_motion_tangent = FreeMotion(
        hub_motion_tangent,
        length_tangent,
        slot_length_tangents,
        inverse_inertia.compute_transverse_foot_motion(hub_motion_tangent)
        + equation_tangents.foot_transverse_motion,
        equation_tangents.foot_radial_motion - slot_length_tangents,
    )
    return free_motion_tangent, friction_force_tangents


def _compute_motion_equation_tangents(
    contact_configuration: ContactConfiguration,
    configuration_tangent: ContactConfiguration,
    inverse_inertia: ContactInverseInertia,
    force_solution: WheelForceSolution,
) -> tuple[_ConstantMotionTerms, _EquationTangents]:
    """Return the constant accelerations, and the tangents of the equations of motion."""
    s, motion, _, contact_slots, *_ = contact_configuration
    ds, motion_tangent, *_ = configuration_tangent
    dtheta = motion_tangent.theta
    b, db, ddtheta = motion.L - s.a, motion_tangent.L - ds.a, force_solution.hub_motion[2]
    squared_angular_rate, doubled_angular_rate = motion.dtheta * motion.dtheta, 2.0 * motion.dtheta
    squared_angular_rate_tangent = doubled_angular_rate * motion_tangent.dtheta
    doubled_angular_rate_tangent = 2.0 * motion_tangent.dtheta
    hub_torque_tangent: Array | float = 0.0
    if s.leg_force is None:
        spring_force_tangent = ds.k * (s.Ls - motion.L) - ds.c * motion.dL
        spring_force_tangent = (
            spring_force_tangent + s.k * (ds.Ls - motion_tangent.L) - s.c * motion_tangent.dL
        )
    else:
        spring_force_tangent = _push_through_law(
            lambda s, L, dL: evaluate_leg_force(s, L, dL, number_legs(L)),
            (s, motion.L, motion.dL),
            (ds, motion_tangent.L, motion_tangent.dL),
        )
    if s.hub_torque is not None:
        hub_torque_tangent = _push_through_law(
            evaluate_hub_torque, (s, motion.dtheta), (ds, motion_tangent.dtheta)
        )
    constant_motion_terms = _ConstantMotionTerms(
        radial_leg_motion=force_solution.length_motion - b * squared_angular_rate,
        transverse_leg_motion=doubled_angular_rate * motion.dL + b * ddtheta,
        hub_motion=(
            force_solution.hub_motion[0] - s.g * s.sin_phi,
            force_solution.hub_motion[1] + s.g * s.cos_phi,
        ),
    )
    length_tangents, length_rates, length_rate_tangents, length_accelerations = map(
        contact_slots.gather_from_legs,
        (motion_tangent.L, motion.dL, motion_tangent.dL, force_solution.length_motion),
    )
    foot_transverse = (
        (inverse_inertia.L * squared_angular_rate - length_accelerations) * dtheta
        - doubled_angular_rate * length_rate_tangents
        - length_rates * doubled_angular_rate_tangent
        - ddtheta * length_tangents
    )
    foot_radial = (
        (doubled_angular_rate * length_rates + ddtheta * inverse_inertia.L) * dtheta
        + squared_angular_rate * length_tangents
        + inverse_inertia.L * squared_angular_rate_tangent
    )
    return constant_motion_terms, _EquationTangents(
        radial_leg_motion=-(db * squared_angular_rate + b * squared_angular_rate_tangent),
        transverse_leg_motion=doubled_angular_rate * motion_tangent.dL
        + motion.dL * doubled_angular_rate_tangent
        + ddtheta * db,
        hub_motion=(-ds.g * s.sin_phi - s.g * ds.sin_phi, ds.g * s.cos_phi + s.g * ds.cos_phi),
        spring_force=spring_force_tangent,
        hub_torque=hub_torque_tangent,
        foot_transverse_motion=foot_transverse,
        foot_radial_motion=foot_radial,
    )


def _push_through_law(law: Callable, primals: tuple, tangents: tuple) -> Elementwise:
    """Return the tangent of a function of symbols and a motion, with respect to all floats."""
    floats, constants = eqx.partition(primals, eqx.is_inexact_array)
    evaluate = lambda floats: law(*eqx.combine(floats, constants))
    return jax.jvp(evaluate, (floats,), (eqx.filter(tangents, eqx.is_inexact_array),))[1]


def _compute_impact_equation_tangents(
    contact_configuration: ContactConfiguration,
    configuration_tangent: ContactConfiguration,
    inverse_inertia: ContactInverseInertia,
    force_solution: WheelForceSolution,
) -> tuple[_ConstantMotionTerms, _EquationTangents]:
    """Return the constant velocity jumps, and the tangents of the impact equations."""
    s, motion, _, contact_slots, *_ = contact_configuration
    ds, motion_tangent, *_ = configuration_tangent
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
    slot_length_rates, slot_length_tangents = map(
        contact_slots.gather_from_legs, (force_solution.length_motion, motion_tangent.L)
    )
    return constant_motion_terms, _EquationTangents(
        radial_leg_motion=-motion_tangent.dL,
        transverse_leg_motion=(motion_tangent.L - ds.a) * angular_rate_jump
        - b * motion_tangent.dtheta,
        hub_motion=(-motion_tangent.vx, -motion_tangent.vz),
        spring_force=0.0,
        hub_torque=0.0,
        foot_transverse_motion=-dtheta_after * slot_length_tangents
        - slot_length_rates * motion_tangent.theta,
        foot_radial_motion=inverse_inertia.L * dtheta_after * motion_tangent.theta,
    )
