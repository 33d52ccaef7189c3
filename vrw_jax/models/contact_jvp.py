"""Compute forces or impulses for a contact configuration, and their derivatives.

The equations are linear in accelerations and forces, or in impulses and the velocities after an
impact. The tangents of these unknowns solve the same equations, with the tangent of the residual on
the right-hand side. Only that residual is differentiated.
"""

import operator
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from vrw_jax.base.elementwise import Elementwise
from vrw_jax.lanes.environment import with_default_jax_settings
from vrw_jax.models.contact_mechanics import (
    ContactInverseInertia,
    ContactSlots,
    FreeMotion,
    Friction,
    HubVector,
    LegArray,
    SlotArray,
    WheelMotion,
    align_with_batch,
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
from vrw_jax.wheel.laws import evaluate_hub_torque, evaluate_leg_force, number_legs
from vrw_jax.wheel.params import Symbols
from vrw_jax.wheel.transitions import ContactMode


class ContactConfiguration(NamedTuple):
    """Motion, contact modes and stopper states of a wheel, which determine the contact forces."""

    s: Symbols
    friction: SlotArray  # friction coefficient of the feet in the contact slots
    contact_slots: ContactSlots
    slot_modes: Array  # `ContactMode` of the foot in each contact slot
    is_stopper_holding: Array  # whether the leg in each contact slot is on its stopper
    is_airborne_leg_locked: Array  # whether a leg is in the air on its stopper
    motion: WheelMotion
    known_solution: Any = None  # forces and motion, if only their derivatives are computed


def find_slot_contacts(
    friction: Friction | float, contact_modes: Array, is_leg_locked: Array
) -> tuple[SlotArray, ContactSlots, Array, Array, Array]:
    """Return friction and all further fields of `ContactConfiguration` that describe contacts.

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

    The fields are described in `SlotForceSolution`.
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


_MotionTerms = tuple[Any, Any, Any, Any, Any]
"""Terms of the equations of motion (in m/s^2, N and N m), or of those of an impact (in m/s).

They are radial and transverse motion of the leg masses relative to the hub, the same of the feet in
the contact slots, motion of the hub along x and z without gravity, forces of the legs, and torque
of the hub. The relative motion of a mass is minus its radial term along the leg, and minus its
transverse term across the leg.
"""


@eqx.filter_jit  # This function is traced once for all call sites.
def solve_contact_forces(contact_configuration: ContactConfiguration) -> WheelForceSolution:
    """Return the contact forces (N) and the resulting accelerations, with a JVP rule."""
    return _solve_with_jvp_rule(
        compute_free_acceleration, _list_acceleration_terms, contact_configuration
    )


@eqx.filter_jit
def solve_impact(contact_configuration: ContactConfiguration) -> WheelForceSolution:
    """Return the impulses in an impact (N s) and the velocities after it, with a JVP rule."""
    return _solve_with_jvp_rule(compute_free_velocity, _list_velocity_terms, contact_configuration)


def solve_contact_configuration(
    contact_configuration: ContactConfiguration,
    inverse_inertia: ContactInverseInertia,
    free_motion: FreeMotion,
) -> WheelForceSolution:
    """Return the contact forces or impulses for a configuration with a known free motion.

    - `inverse_inertia`: inverse inertia for the posture of the configuration;
    - `free_motion`: accelerations without contact forces, or velocities without impulses.
    """
    s, friction, contact_slots, slot_modes, is_stopper_holding, is_airborne_leg_locked, *_ = (
        contact_configuration
    )
    slot_solution = solve_combination(
        s, inverse_inertia, free_motion, slot_modes, is_stopper_holding, friction
    )
    outward_leg_motion = (
        free_motion.leg_motion
        + inverse_inertia.leg_directions.sin * slot_solution.hub_motion[0]
        + inverse_inertia.leg_directions.cos * slot_solution.hub_motion[1]
    )
    length_motion = jnp.where(
        is_airborne_leg_locked | (contact_slots.scatter_to_legs(is_stopper_holding) > 0),
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
    s, _, contact_slots, _, _, is_airborne_leg_locked, motion, known_solution = (
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
    list_motion_terms: Callable[..., _MotionTerms],
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
            list_motion_terms,
            contact_configuration,
            configuration_tangent,
            inverse_inertia,
            force_solution,
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
    list_motion_terms: Callable[..., _MotionTerms],
    contact_configuration: ContactConfiguration,
    configuration_tangent: ContactConfiguration,
    inverse_inertia: ContactInverseInertia,
    force_solution: WheelForceSolution,
) -> tuple[FreeMotion, SlotArray]:
    """Return the tangent of the free motion that is equivalent to the tangent of the residual.

    The residual is that of the contact equations, for constant forces and accelerations, or
    impulses and velocities after the impact. The result is (free motion, friction forces by their
    coefficient).

    - `list_motion_terms`: function of symbols, motion, contact slots and solution;
    - `configuration_tangent`: tangent of the configuration.
    """
    _, _, contact_slots, slot_modes, *_ = contact_configuration
    sin, cos = inverse_inertia.leg_directions
    slot_sin, slot_cos = inverse_inertia.sin, inverse_inertia.cos
    t, n = force_solution.tangential_forces, force_solution.normal_forces
    select_inputs = lambda x: (x.s, x.friction, x.motion)
    inputs, constants = eqx.partition(select_inputs(contact_configuration), eqx.is_inexact_array)
    s, friction, motion = select_inputs(contact_configuration)
    fixed_friction, fixed_theta = replace_infinite_friction(friction), motion.theta
    leg_terms_at_point, foot_terms_at_point, fixed_hub, *_ = list_motion_terms(
        s, motion, contact_slots, force_solution
    )
    decompose = lambda sin, cos, x, z: (sin * x + cos * z, cos * x - sin * z)

    def evaluate_residual(inputs: Any) -> tuple:
        s, friction, motion = eqx.combine(inputs, constants)
        legs, feet, (x, z), leg_force, hub_torque = list_motion_terms(
            s, motion, contact_slots, force_solution
        )
        # Directions turn with the legs. The fixed vectors make the derivatives short.
        turn = motion.theta - fixed_theta
        rotate_with = lambda u, e, fixed_u, fixed_e: (u - fixed_e * turn, e + fixed_u * turn)
        rotate_against = lambda u, e, fixed_u, fixed_e: (u + fixed_e * turn, e - fixed_u * turn)
        friction_change = replace_infinite_friction(friction) - fixed_friction
        changed_t = t - compute_slip_signs(slot_modes) * friction_change * n
        leg_pulls, transverse_forces = rotate_against(
            *decompose(slot_sin, slot_cos, changed_t, n), *decompose(slot_sin, slot_cos, t, n)
        )
        hub_outward, hub_transverse = rotate_against(
            *decompose(sin, cos, x, z), *decompose(sin, cos, *fixed_hub)
        )
        foot_radial, foot_transverse = rotate_with(*feet, *foot_terms_at_point)
        pulls = contact_slots.scatter_to_legs(leg_pulls + force_solution.stopper_forces)
        length_residual = (leg_force - pulls) / s.m + hub_outward - legs[0]
        leg_moments = s.m * ((motion.L - s.a) * (legs[1] - hub_transverse))
        foot_moments = contact_slots.gather_from_legs(motion.L) * transverse_forces
        hub_residual = (
            sum_over_legs(changed_t) - s.Mt * x,
            -s.Mt * z,
            hub_torque - sum_over_legs(leg_moments) - sum_over_legs(foot_moments),
        )
        leg_inertia_forces = [s.m * term for term in rotate_with(*legs, *leg_terms_at_point)]
        foot_residual = -foot_transverse, -foot_radial
        return length_residual, hub_residual, leg_inertia_forces, foot_residual, changed_t

    _, (length_tangent, hub_tangent, leg_forces, foot_tangent, friction_force_tangents) = jax.jvp(
        evaluate_residual,
        (inputs,),
        (eqx.filter(select_inputs(configuration_tangent), eqx.is_inexact_array),),
    )
    length_tangent = jnp.where(inverse_inertia.is_leg_released, length_tangent, 0.0)
    radial_force = leg_forces[0] + s.m * length_tangent
    hub_motion_tangent = multiply_by_inverse_inertia(
        inverse_inertia.inverse_inertia,
        (
            sum_over_legs(radial_force * sin + leg_forces[1] * cos) + hub_tangent[0],
            sum_over_legs(radial_force * cos - leg_forces[1] * sin) + hub_tangent[1],
            hub_tangent[2],
        ),
    )
    slot_length_tangents = contact_slots.gather_from_legs(length_tangent)
    free_motion_tangent = FreeMotion(
        hub_motion_tangent,
        length_tangent,
        slot_length_tangents,
        inverse_inertia.compute_transverse_foot_motion(hub_motion_tangent) + foot_tangent[0],
        foot_tangent[1] - slot_length_tangents,
    )
    return free_motion_tangent, friction_force_tangents


def _list_acceleration_terms(
    s: Symbols, motion: WheelMotion, contact_slots: ContactSlots, solution: WheelForceSolution
) -> _MotionTerms:
    """Return the terms of the equations of motion for constant accelerations."""
    hub_x, hub_z, ddtheta = solution.hub_motion
    squared_rate, doubled_rate = motion.dtheta * motion.dtheta, 2.0 * motion.dtheta
    L, dL, ddL = map(contact_slots.gather_from_legs, (motion.L, motion.dL, solution.length_motion))
    list_relative_terms = lambda distance, rate, acceleration: (
        acceleration - distance * squared_rate,
        doubled_rate * rate + distance * ddtheta,
    )
    return (
        list_relative_terms(motion.L - s.a, motion.dL, solution.length_motion),
        list_relative_terms(L, dL, ddL),
        (hub_x - s.g * s.sin_phi, hub_z + s.g * s.cos_phi),
        evaluate_leg_force(s, motion.L, motion.dL, number_legs(motion.L)),
        0.0 if s.hub_torque is None else evaluate_hub_torque(s, motion.dtheta),
    )


def _list_velocity_terms(
    s: Symbols, motion: WheelMotion, contact_slots: ContactSlots, solution: WheelForceSolution
) -> _MotionTerms:
    """Return the jumps of velocities in an impact, and the velocities of the feet after it."""
    vx, vz, dtheta = solution.hub_motion
    L, dL = map(contact_slots.gather_from_legs, (motion.L, solution.length_motion))
    jumps = solution.length_motion - motion.dL, (motion.L - s.a) * (dtheta - motion.dtheta)
    return jumps, (dL, L * dtheta), (vx - motion.vx, vz - motion.vz), 0.0, 0.0


class SlotForceSolution(NamedTuple):
    """Forces (N) and resulting accelerations, or impulses (N s) and velocities after the impact.

    A `SlotArray` has one entry for the leg in each contact slot.
    """

    tangential_forces: SlotArray  # tangential forces on the feet, positive downhill
    normal_forces: SlotArray  # normal forces on the feet, positive if they push
    stopper_forces: SlotArray  # forces of the stoppers, positive if they push
    leg_pull_forces: SlotArray  # force of stopper and foot along u on the leg's mass
    hub_motion: HubVector
    length_motion: SlotArray  # accelerations of the leg lengths, or rates after an impact
    foot_motion_x: SlotArray  # accelerations of the feet, or velocities after an impact
    foot_motion_z: SlotArray
    painleve_determinant: Any  # of order 1; zero at Painlevé's singularity


def _compute_determinant(A: Array) -> Array:
    """Return the determinant of a 2 x 2 matrix."""
    return A[0, 0] * A[1, 1] - A[0, 1] * A[1, 0]


def _solve_2x2_system(A: Array, b: Array) -> Array:
    """Return the solution of A x = b for a 2 x 2 matrix A; NaN if A is singular.

    If b is a matrix, each of its columns is a right-hand side.
    """
    determinant = _compute_determinant(A)
    inverse_determinant = 1.0 / jnp.where(determinant == 0.0, jnp.nan, determinant)
    return jnp.stack(
        [
            (A[1, 1] * b[0] - A[0, 1] * b[1]) * inverse_determinant,
            (A[0, 0] * b[1] - A[1, 0] * b[0]) * inverse_determinant,
        ]
    )


def _make_diagonal_matrix(diagonal: SlotArray) -> Array:
    """Return the 2 x 2 matrix with the entries of `diagonal` on its diagonal, and zeros."""
    return jnp.where(align_with_batch(np.eye(2, dtype=bool), diagonal[0]), diagonal, 0.0)


def replace_infinite_friction(friction: Elementwise) -> Array:
    """Return the friction coefficients of Coulomb's law, with 0 in place of infinite coefficients.

    Coulomb's law then yields no friction on a foot that slides under infinite friction.
    """
    return jnp.where(jnp.isfinite(friction), friction, 0.0)


REFERENCE_MASS_RATIO = 18.0
"""Ratio of total mass to leg mass that scales the determinant of the contact equations.

At this ratio, resting and sliding feet have the same scale in the determinant. The value is that of
the wheel in Table 1 of the paper, chosen because `painleve_atol` was measured for this wheel.
"""


def _solve_slot_forces(
    s: Symbols,
    inverse_inertia: ContactInverseInertia,
    free_motion: FreeMotion,
    slot_modes: Array,
    is_stopper_holding: Array,
    friction: SlotArray,
    opaque_one: Array,
) -> tuple[SlotArray, SlotArray, SlotArray, Array]:
    """Return stopper forces, foot forces transverse to and along the legs, and the determinant.

    The unknown c is the transverse force on a sticking foot. For a sliding foot, c is the normal
    force. In the limit of infinite friction, c is the friction force instead. For an unloaded foot,
    c = 0. The stopper forces f are eliminated first: they solve N f = p + P c. For an open stopper,
    the corresponding equation is f = 0, so the system is always regular. In matrices, the first
    index is that of the equation.
    """
    sin, cos, inverse_leg_mass = inverse_inertia.sin, inverse_inertia.cos, 1.0 / s.m
    sliding_coefficient = jnp.where(friction == jnp.inf, 1.0, replace_infinite_friction(friction))
    normal_force_factor = jnp.where(friction == jnp.inf, 0.0, 1.0)
    is_sticking = slot_modes == ContactMode.STICK
    slides_down = slot_modes == ContactMode.SLIP_DOWN
    is_sliding = slides_down | (slot_modes == ContactMode.SLIP_UP)
    is_loaded = is_sticking | is_sliding
    friction_factor = jnp.where(slides_down, -sliding_coefficient, sliding_coefficient)
    select_by_mode = lambda sticking_value, sliding_value: jnp.where(
        is_sticking, sticking_value, jnp.where(is_sliding, sliding_value, 0.0)
    )
    # These are the force on a foot for c = 1, and the weights of the foot's transverse motion and
    # of the force on the leg's mass in the foot's condition.
    transverse_per_c = select_by_mode(1.0, friction_factor * cos - normal_force_factor * sin)
    radial_per_c = select_by_mode(0.0, friction_factor * sin + normal_force_factor * cos)
    weight_transverse = select_by_mode(1.0, -sin)
    weight_radial = select_by_mode(0.0, cos * inverse_leg_mass)

    leg_compliance = jnp.where(is_sticking, 0.0, inverse_leg_mass)
    N = jnp.where(
        is_stopper_holding[:, None],
        inverse_inertia.K + _make_diagonal_matrix(leg_compliance),
        _make_diagonal_matrix(jnp.ones_like(leg_compliance)),
    )
    outward_leg_motion = (
        sin * free_motion.hub_motion[0]
        + cos * free_motion.hub_motion[1]
        + free_motion.slot_leg_motion
    )
    foot_motion_of_leg = jnp.where(is_sticking, free_motion.foot_radial_motion, 0.0)
    p = jnp.where(is_stopper_holding, outward_leg_motion + foot_motion_of_leg, 0.0)
    P = jnp.where(
        is_stopper_holding[:, None],
        inverse_inertia.H * transverse_per_c
        - _make_diagonal_matrix(radial_per_c * inverse_leg_mass),
        0.0,
    )
    p, P, N = prevent_fusion((p, P, N), opaque_one)
    stopper_without_feet, stopper_response = prevent_fusion(
        (_solve_2x2_system(N, p), _solve_2x2_system(N, P)), opaque_one
    )

    R = _make_diagonal_matrix(weight_radial) - weight_transverse[:, None] * jnp.swapaxes(
        inverse_inertia.H, 0, 1
    )
    C = (
        weight_transverse[:, None] * inverse_inertia.G * transverse_per_c
        + _make_diagonal_matrix(weight_radial * radial_per_c)
        + R[:, :1] * stopper_response[0]
        + R[:, 1:] * stopper_response[1]
        + _make_diagonal_matrix(jnp.where(is_loaded, 0.0, 1.0))
    )
    right_hand_side = (
        -weight_transverse * free_motion.foot_transverse_motion
        - weight_radial * s.m * free_motion.foot_radial_motion
    )
    c = _solve_2x2_system(
        C,
        right_hand_side - R[:, 0] * stopper_without_feet[0] - R[:, 1] * stopper_without_feet[1],
    )
    stopper_force = (
        stopper_without_feet + stopper_response[:, 0] * c[0] + stopper_response[:, 1] * c[1]
    )
    foot_force_radial = jnp.where(
        is_sticking, -s.m * free_motion.foot_radial_motion - stopper_force, radial_per_c * c
    )
    scale_masses = jnp.where(is_sticking, s.Mt / REFERENCE_MASS_RATIO, s.m)
    scale_masses = jnp.where(is_loaded, scale_masses, 1.0)
    painleve_determinant = scale_masses[0] * scale_masses[1] * _compute_determinant(C)
    forces = stopper_force, transverse_per_c * c, foot_force_radial
    return prevent_fusion((*forces, painleve_determinant), opaque_one)


@eqx.filter_jit  # This function is traced once for all call sites.
def solve_combination(
    s: Symbols,
    inverse_inertia: ContactInverseInertia,
    free_motion: FreeMotion,
    slot_modes: Array,
    is_stopper_holding: Array,
    friction: SlotArray,
) -> SlotForceSolution:
    """Return forces and motion for one combination of contact modes and stoppers.

    - `slot_modes`: contact mode of the foot in each contact slot, shape (2, ...);
    - `is_stopper_holding`: whether the stopper holds the leg in each contact slot, shape (2, ...);
    - `friction`: friction coefficient of the foot in each contact slot, shape (2, ...).

    A sticking foot stays at rest. A sliding foot stays on the ground, with friction against the
    slip. A leg on its stopper has a constant length.
    """
    sin, cos, inverse_leg_mass = inverse_inertia.sin, inverse_inertia.cos, 1.0 / s.m
    opaque_one = make_opaque_one(free_motion.hub_motion[2])
    stopper_force, foot_force_transverse, foot_force_radial, painleve_determinant = (
        _solve_slot_forces(
            s, inverse_inertia, free_motion, slot_modes, is_stopper_holding, friction, opaque_one
        )
    )
    leg_pull_forces = foot_force_radial + stopper_force
    hub_motion = vx, vz, _ = tuple(
        free
        + transverse[0] * foot_force_transverse[0]
        + transverse[1] * foot_force_transverse[1]
        - radial[0] * stopper_force[0]
        - radial[1] * stopper_force[1]
        for free, transverse, radial in zip(
            free_motion.hub_motion,
            inverse_inertia.hub_response_transverse,
            inverse_inertia.hub_response_radial,
            strict=True,
        )
    )
    hub_change = tuple(map(operator.sub, hub_motion, free_motion.hub_motion))
    foot_transverse = (
        inverse_inertia.compute_transverse_foot_motion(hub_change)
        + free_motion.foot_transverse_motion
    )
    foot_radial = free_motion.foot_radial_motion + leg_pull_forces * inverse_leg_mass
    free_length_motion = (
        sin * vx + cos * vz + free_motion.slot_leg_motion - leg_pull_forces * inverse_leg_mass
    )
    return SlotForceSolution(
        tangential_forces=foot_force_transverse * cos + foot_force_radial * sin,
        normal_forces=foot_force_radial * cos - foot_force_transverse * sin,
        stopper_forces=stopper_force,
        leg_pull_forces=leg_pull_forces,
        hub_motion=hub_motion,
        length_motion=jnp.where(is_stopper_holding, 0.0, free_length_motion),
        foot_motion_x=foot_transverse * cos + foot_radial * sin,
        foot_motion_z=foot_radial * cos - foot_transverse * sin,
        painleve_determinant=painleve_determinant,
    )
