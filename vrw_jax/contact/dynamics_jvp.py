"""Forces or impulses of a contact configuration, and their derivatives.

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

from vrw_jax.contact.contact_modes import ContactMode, Friction, finite_friction, solve_combination
from vrw_jax.contact.mechanics import (
    ContactInverseInertia,
    ContactSlots,
    FreeMotion,
    HubVector,
    LegArray,
    SlotPair,
    WheelMotion,
    apply_inverse,
    free_acceleration,
    free_velocity,
    make_inverse_inertia,
    opaque_one,
    prevent_fusion,
    sum_over_legs,
)
from vrw_jax.runtime import with_default_jax_settings
from vrw_jax.wheel import Symbols


class ContactConfiguration(NamedTuple):
    """Motion of a wheel together with known contact modes and stopper states."""

    s: Symbols
    motion: WheelMotion
    friction: Friction  # friction coefficient of the slots' feet
    contact_slots: ContactSlots
    slot_modes: Array  # `ContactMode` of each slot's foot
    is_held: Array  # whether the leg of each slot is on its stopper
    is_airborne_locked: Array  # whether a leg is in the air on its stopper

    @property
    def has_fixed_length(self) -> Array:
        """Return whether the length of each leg is fixed by a stopper."""
        return self.is_airborne_locked | (self.contact_slots.scatter(self.is_held) > 0)


class ForceSolution(NamedTuple):
    """Forces of ground and stoppers, and the resulting motion of hub and legs: see
    `contact_modes.ContactSolution`.
    """

    tangential: SlotPair
    normal: SlotPair
    stopper: SlotPair
    pull: SlotPair
    hub_vector: HubVector
    painleve_determinant: Array
    length_motion: LegArray  # accelerations of the legs' lengths, or rates after an impact


def slip_sign(slot_modes: Array) -> SlotPair:
    """Return 1 for each slot's foot that slides downhill, -1 for uphill and 0 otherwise."""
    sign_of_mode = lambda mode: jnp.where(
        mode == ContactMode.SLIP_DOWN, 1.0, jnp.where(mode == ContactMode.SLIP_UP, -1.0, 0.0)
    )
    return sign_of_mode(slot_modes[0]), sign_of_mode(slot_modes[1])


class _FrozenTerms(NamedTuple):
    """Accelerations, or velocity jumps, that are constant for a tangent of the residual."""

    radial: LegArray  # of leg masses relative to the hub, along the legs
    transverse: LegArray  # of leg masses relative to the hub, transverse to the legs
    hub_vector: SlotPair  # of the hub, without gravity


class _EquationTangents(NamedTuple):
    """Tangents of the equations of motion, or of impact, with the frozen terms constant."""

    radial: LegArray
    transverse: LegArray
    hub_vector: SlotPair
    spring_force: LegArray | float  # N
    foot_transverse_motion: SlotPair
    foot_radial_motion: SlotPair


_EquationTangentFn = Callable[
    [ContactConfiguration, ContactConfiguration, ContactInverseInertia, ForceSolution],
    tuple[_FrozenTerms, _EquationTangents],
]


@eqx.filter_jit  # This function is traced once for all call sites.
def solve_contact_forces(configuration: ContactConfiguration) -> ForceSolution:
    """Return the contact forces (N), and the resulting accelerations."""
    return _differentiable_solution(free_acceleration, motion_equation_tangents, configuration)


@eqx.filter_jit
def solve_impact(configuration: ContactConfiguration) -> ForceSolution:
    """Return the impulses of an impact (N s), and the velocities after them."""
    return _differentiable_solution(free_velocity, _impact_equation_tangents, configuration)


def solve_configuration(
    configuration: ContactConfiguration, inertia: ContactInverseInertia, free_motion: FreeMotion
) -> ForceSolution:
    """Return the forces of a configuration, given its motion without contact forces.

    - `inertia`: inverse inertia at this posture;
    - `free_motion`: accelerations without contact forces, or velocities without impulses.
    """
    s, _, friction, contact_slots, slot_modes, is_held, _ = configuration
    solution = solve_combination(s, inertia, free_motion, slot_modes, is_held, friction)
    outward_motion = (
        free_motion.leg_motion
        + inertia.leg_directions.sin * solution.hub_vector[0]
        + inertia.leg_directions.cos * solution.hub_vector[1]
    )
    length_motion = jnp.where(
        configuration.has_fixed_length,
        0.0,
        outward_motion - contact_slots.scatter(solution.pull) / s.m,
    )
    force_pairs = solution.tangential, solution.normal, solution.stopper, solution.pull
    return ForceSolution(
        *force_pairs, solution.hub_vector, solution.painleve_determinant, length_motion
    )


def _solve_with_free_motion(
    free_motion_fn: Callable[..., FreeMotion], configuration: ContactConfiguration
) -> tuple[ContactInverseInertia, FreeMotion, ForceSolution]:
    """Return inertia, motion without contact forces, and forces of a configuration."""
    s, motion, unit_divisor = (
        configuration.s,
        configuration.motion,
        opaque_one(configuration.motion),
    )
    inertia = prevent_fusion(
        make_inverse_inertia(
            s, motion, configuration.contact_slots, configuration.is_airborne_locked
        ),
        unit_divisor,
    )
    free_motion = prevent_fusion(
        free_motion_fn(s, motion, configuration.contact_slots, inertia), unit_divisor
    )
    return (
        inertia,
        free_motion,
        prevent_fusion(solve_configuration(configuration, inertia, free_motion), unit_divisor),
    )


def solve_forces_with_free_motion(
    configuration: ContactConfiguration,
) -> tuple[ContactInverseInertia, FreeMotion, ForceSolution]:
    """Return inertia, accelerations without contact forces, and contact forces (N)."""
    return _solve_with_free_motion(free_acceleration, configuration)


def _differentiable_solution(
    free_motion_fn: Callable[..., FreeMotion],
    equation_tangent_fn: _EquationTangentFn,
    configuration: ContactConfiguration,
) -> ForceSolution:
    """Return the forces of a configuration.

    Their JVP rule solves the equations of the forces for the tangent of the residual.
    """
    float_leaves, static_leaves = eqx.partition(configuration, eqx.is_inexact_array)
    other_arrays, static_leaves = eqx.partition(static_leaves, eqx.is_array)
    assemble = lambda float_leaves, other_arrays: eqx.combine(
        float_leaves, other_arrays, static_leaves
    )
    solve = jax.custom_jvp(
        lambda *arrays: _solve_with_free_motion(free_motion_fn, assemble(*arrays))[2]
    )

    @solve.defjvp
    @with_default_jax_settings
    def solution_jvp(primals: tuple, tangents: tuple) -> tuple[ForceSolution, ForceSolution]:
        configuration, tangent = assemble(*primals), assemble(tangents[0], primals[1])
        inertia, free_motion, solution = _solve_with_free_motion(free_motion_fn, configuration)
        residual = residual_jvp(
            configuration,
            tangent,
            inertia,
            solution,
            *equation_tangent_fn(configuration, tangent, inertia, solution),
        )
        free_tangent = free_motion_tangent(
            inertia, residual.leg_lengths, sum_residual(configuration.contact_slots, residual)
        )
        _, solution_tangent = jax.jvp(
            lambda free_motion: solve_configuration(configuration, inertia, free_motion),
            (free_motion,),
            (free_tangent,),
        )
        add_pairs = lambda first_pair, second_pair: (
            first_pair[0] + second_pair[0],
            first_pair[1] + second_pair[1],
        )
        return solution, solution_tangent._replace(
            tangential=add_pairs(solution_tangent.tangential, residual.friction_force),
            pull=add_pairs(solution_tangent.pull, residual.pull),
        )

    return solve(float_leaves, other_arrays)


class ResidualTangent(NamedTuple):
    """Tangent of the residual, expressed by its effect on the unknowns."""

    leg_lengths: LegArray  # effect on each leg's length
    hub_by_leg: tuple[LegArray, LegArray, LegArray]  # effect of each leg on the hub's equations
    hub_without_legs: HubVector  # effect on the hub's equations without the legs
    foot_transverse_motion: SlotPair
    foot_radial_motion: SlotPair
    friction_force: SlotPair  # tangent of the friction force by its coefficient
    pull: SlotPair  # tangent by friction and rotation of the slots' legs


def residual_jvp(
    configuration: ContactConfiguration,
    tangent: ContactConfiguration,
    inertia: ContactInverseInertia,
    solution: ForceSolution,
    frozen: _FrozenTerms,
    equation_tangents: _EquationTangents,
) -> ResidualTangent:
    """Return the tangent of the residual along a tangent of the configuration.

    - `frozen`: terms that are constant;
    - `equation_tangents`: tangents of the equations with these terms constant.
    """
    s, ds, contact_slots, (sin, cos), slot_indices = (
        configuration.s,
        tangent.s,
        configuration.contact_slots,
        inertia.leg_directions,
        range(2),
    )
    b, db, dtheta = configuration.motion.L - s.a, tangent.motion.L - ds.a, tangent.motion.theta
    slip_signs = slip_sign(configuration.slot_modes)
    coefficient_tangent = jax.jvp(finite_friction, (configuration.friction,), (tangent.friction,))[
        1
    ]
    coefficient_tangent = (
        coefficient_tangent
        if isinstance(coefficient_tangent, tuple)
        else (coefficient_tangent, coefficient_tangent)
    )
    t, n, L, dL = (
        solution.tangential,
        solution.normal,
        inertia.L,
        contact_slots.gather(tangent.motion.L),
    )
    friction_tangent = [-slip_signs[i] * coefficient_tangent[i] * n[i] for i in slot_indices]
    transverse = [t[i] * inertia.cos[i] - n[i] * inertia.sin[i] for i in slot_indices]
    radial = [t[i] * inertia.sin[i] + n[i] * inertia.cos[i] for i in slot_indices]
    pull = [friction_tangent[i] * inertia.sin[i] + transverse[i] * dtheta for i in slot_indices]
    moment = [
        dL[i] * transverse[i] + L[i] * (friction_tangent[i] * inertia.cos[i] - radial[i] * dtheta)
        for i in slot_indices
    ]

    (ax, az), (dx, dz) = frozen.hub_vector, equation_tangents.hub_vector
    radial_hub_motion, transverse_residual = (
        sin * ax + cos * az,
        frozen.transverse - cos * ax + sin * az,
    )
    length_tangent = (cos * ax - sin * az) * dtheta - equation_tangents.radial + sin * dx + cos * dz
    length_tangent = (
        length_tangent
        + (
            equation_tangents.spring_force
            - contact_slots.scatter(pull)
            + (radial_hub_motion - frozen.radial) * ds.m
        )
        / s.m
    )
    length_tangent = jnp.where(inertia.is_released, length_tangent, 0.0)
    radial_tangent = length_tangent + equation_tangents.radial
    x = frozen.radial * sin + frozen.transverse * cos
    z = frozen.radial * cos - frozen.transverse * sin
    torque = db * transverse_residual + b * (
        equation_tangents.transverse + radial_hub_motion * dtheta - cos * dx + sin * dz
    )
    return ResidualTangent(
        leg_lengths=length_tangent,
        hub_by_leg=(
            s.m * (radial_tangent * sin + equation_tangents.transverse * cos + z * dtheta)
            + ds.m * x,
            s.m * (radial_tangent * cos - equation_tangents.transverse * sin - x * dtheta)
            + ds.m * z,
            -s.m * torque - ds.m * (b * transverse_residual) - contact_slots.scatter(moment),
        ),
        hub_without_legs=(
            friction_tangent[0] + friction_tangent[1] - ds.Mt * ax - s.Mt * dx,
            -ds.Mt * az - s.Mt * dz,
            0.0,
        ),
        foot_transverse_motion=equation_tangents.foot_transverse_motion,
        foot_radial_motion=equation_tangents.foot_radial_motion,
        friction_force=(friction_tangent[0], friction_tangent[1]),
        pull=(pull[0], pull[1]),
    )


class TotalTangent(NamedTuple):
    """Tangent of the residual, summed over all legs and gathered for the slots."""

    hub_vector: HubVector
    slot_lengths: SlotPair
    foot_transverse_motion: SlotPair
    foot_radial_motion: SlotPair
    friction_force: SlotPair


def sum_residual(contact_slots: ContactSlots, residual: ResidualTangent) -> TotalTangent:
    """Return the tangent of the residual, summed over all legs and gathered for the slots."""
    x, z, rotation = (
        sum_over_legs(leg_forces) + other_force
        for leg_forces, other_force in zip(
            residual.hub_by_leg, residual.hub_without_legs, strict=True
        )
    )
    return TotalTangent(
        (x, z, rotation),
        contact_slots.gather(residual.leg_lengths),
        residual.foot_transverse_motion,
        residual.foot_radial_motion,
        residual.friction_force,
    )


def free_motion_tangent(
    inertia: ContactInverseInertia, leg_motion: LegArray, total_tangent: TotalTangent
) -> FreeMotion:
    """Return the tangent of the motion without contact forces that has the same effect as the
    residual's.

    - `leg_motion`: tangent of the legs' motion;
    - `total_tangent`: tangent of the residual, summed over all legs.
    """
    hub_tangent, slot_lengths, (u, v) = (
        apply_inverse(inertia.inverse_inertia, total_tangent.hub_vector),
        total_tangent.slot_lengths,
        total_tangent.foot_radial_motion,
    )
    e = [
        inertia.cos[i] * hub_tangent[0]
        - inertia.sin[i] * hub_tangent[1]
        - inertia.L[i] * hub_tangent[2]
        for i in range(2)
    ]
    e = [e[i] + total_tangent.foot_transverse_motion[i] for i in range(2)]
    return FreeMotion(
        hub_tangent,
        leg_motion,
        slot_lengths,
        (e[0], e[1]),
        (u - slot_lengths[0], v - slot_lengths[1]),
    )


def motion_equation_tangents(
    configuration: ContactConfiguration,
    tangent: ContactConfiguration,
    inertia: ContactInverseInertia,
    solution: ForceSolution,
) -> tuple[_FrozenTerms, _EquationTangents]:
    """Return the accelerations that are held constant, and the tangents of the equations of
    motion.
    """
    s, motion, contact_slots = configuration.s, configuration.motion, configuration.contact_slots
    ds, motion_tangent, dtheta = tangent.s, tangent.motion, tangent.motion.theta
    b, db, ddtheta = motion.L - s.a, motion_tangent.L - ds.a, solution.hub_vector[2]
    squared_rate, twice_rate = motion.dtheta * motion.dtheta, 2.0 * motion.dtheta
    squared_rate_tangent = twice_rate * motion_tangent.dtheta
    twice_rate_tangent = 2.0 * motion_tangent.dtheta
    spring_force_tangent = ds.k * (s.Ls - motion.L) - ds.c * motion.dL
    spring_force_tangent = (
        spring_force_tangent + s.k * (ds.Ls - motion_tangent.L) - s.c * motion_tangent.dL
    )
    frozen = _FrozenTerms(
        radial=solution.length_motion - b * squared_rate,
        transverse=twice_rate * motion.dL + b * ddtheta,
        hub_vector=(
            solution.hub_vector[0] - s.g * s.sin_phi,
            solution.hub_vector[1] + s.g * s.cos_phi,
        ),
    )
    L, dL, slot_rates, slot_rate_tangents = (
        inertia.L,
        *map(contact_slots.gather, (motion_tangent.L, motion.dL, motion_tangent.dL)),
    )
    slot_accelerations = contact_slots.gather(solution.length_motion)
    foot_transverse = [
        (L[i] * squared_rate - slot_accelerations[i]) * dtheta
        - twice_rate * slot_rate_tangents[i]
        - slot_rates[i] * twice_rate_tangent
        - ddtheta * dL[i]
        for i in range(2)
    ]
    foot_radial = [
        (twice_rate * slot_rates[i] + ddtheta * L[i]) * dtheta
        + squared_rate * dL[i]
        + L[i] * squared_rate_tangent
        for i in range(2)
    ]
    return frozen, _EquationTangents(
        radial=-(db * squared_rate + b * squared_rate_tangent),
        transverse=twice_rate * motion_tangent.dL + motion.dL * twice_rate_tangent + ddtheta * db,
        hub_vector=(-ds.g * s.sin_phi - s.g * ds.sin_phi, ds.g * s.cos_phi + s.g * ds.cos_phi),
        spring_force=spring_force_tangent,
        foot_transverse_motion=(foot_transverse[0], foot_transverse[1]),
        foot_radial_motion=(foot_radial[0], foot_radial[1]),
    )


def _impact_equation_tangents(
    configuration: ContactConfiguration,
    tangent: ContactConfiguration,
    inertia: ContactInverseInertia,
    solution: ForceSolution,
) -> tuple[_FrozenTerms, _EquationTangents]:
    """Return the velocity jumps that are held constant, and the tangents of the impact
    equations.
    """
    s = configuration.s
    motion = configuration.motion
    motion_tangent = tangent.motion
    contact_slots = configuration.contact_slots
    dtheta_after = solution.hub_vector[2]
    rate_jump, b = dtheta_after - motion.dtheta, motion.L - s.a
    frozen = _FrozenTerms(
        radial=solution.length_motion - motion.dL,
        transverse=b * rate_jump,
        hub_vector=(solution.hub_vector[0] - motion.vx, solution.hub_vector[1] - motion.vz),
    )
    slot_rates, dL = (
        contact_slots.gather(solution.length_motion),
        contact_slots.gather(motion_tangent.L),
    )
    foot_transverse = [
        -dtheta_after * dL[i] - slot_rates[i] * motion_tangent.theta for i in range(2)
    ]
    return frozen, _EquationTangents(
        radial=-motion_tangent.dL,
        transverse=(motion_tangent.L - tangent.s.a) * rate_jump - b * motion_tangent.dtheta,
        hub_vector=(-motion_tangent.vx, -motion_tangent.vz),
        spring_force=0.0,
        foot_transverse_motion=(foot_transverse[0], foot_transverse[1]),
        foot_radial_motion=(
            inertia.L[0] * dtheta_after * motion_tangent.theta,
            inertia.L[1] * dtheta_after * motion_tangent.theta,
        ),
    )
