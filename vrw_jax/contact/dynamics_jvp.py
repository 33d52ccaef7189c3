"""Forces or impulses of a contact configuration, and their derivatives.

The equations are linear in accelerations and forces, or in impulses and the velocities after an
impact. So the tangents of these solve the same equations with the tangent of the residual on the
right-hand side. Only that residual is differentiated.
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
    FreeMotion,
    HubVector,
    LegArray,
    SlotPair,
    Slots,
    WheelMotion,
    apply_inverse,
    free_acceleration,
    free_velocity,
    make_inverse_inertia,
    opaque_one,
    prevent_fusion,
    sum_over_legs,
)
from vrw_jax.runtime import with_default_settings
from vrw_jax.wheel import Symbols


class ContactConfiguration(NamedTuple):
    """A wheel with known contact modes and stopper states."""

    s: Symbols
    motion: WheelMotion
    friction: Friction  # of the slots' feet
    slots: Slots
    contact: Array  # of the slots
    held: Array  # the slots' legs on their stoppers
    airborne: Array  # other legs on their stoppers

    @property
    def has_fixed_length(self) -> Array:
        """Whether the length of a leg is fixed."""
        return self.airborne | (self.slots.scatter(self.held) > 0)


class ForceSolution(NamedTuple):
    """Forces of ground and slots' stoppers and the hub's motion: see
    `contact_modes.ContactSolution`."""

    tangential: SlotPair
    normal: SlotPair
    stopper: SlotPair
    pull: SlotPair
    hub: HubVector
    painleve_determinant: Array
    lengths: LegArray  # accelerations of the legs' lengths, or rates after an impact


def slip_sign(contact: Array) -> SlotPair:
    """Return 1 for a slot's foot that slides downhill, -1 for uphill and 0 otherwise."""
    sign = lambda mode: jnp.where(
        mode == ContactMode.SLIP_DOWN, 1.0, jnp.where(mode == ContactMode.SLIP_UP, -1.0, 0.0)
    )
    return sign(contact[0]), sign(contact[1])


class _FrozenTerms(NamedTuple):
    """Quantities that are frozen for a tangent of the residual: accelerations, or velocity
    jumps.
    """

    radial: LegArray  # of leg masses, beyond the hub's: along the legs
    transverse: LegArray  # and transverse to them
    hub: SlotPair  # beyond gravity's


class _RowTangents(NamedTuple):
    """Tangents of the equations' rows with the frozen terms fixed."""

    radial: LegArray
    transverse: LegArray
    hub: SlotPair
    springs: LegArray | float  # N
    foot_e: SlotPair
    foot_u: SlotPair


_RowTangentFn = Callable[
    [ContactConfiguration, ContactConfiguration, ContactInverseInertia, ForceSolution],
    tuple[_FrozenTerms, _RowTangents],
]


@eqx.filter_jit  # traced once for all call sites
def solve_motion(configuration: ContactConfiguration) -> ForceSolution:
    """Return the forces, and the resulting accelerations."""
    return _differentiable_solution(free_acceleration, motion_row_tangents, configuration)


@eqx.filter_jit
def solve_impact(configuration: ContactConfiguration) -> ForceSolution:
    """Return the impulses, and the velocities after them."""
    return _differentiable_solution(free_velocity, _impact_row_tangents, configuration)


def solve_configuration(
    configuration: ContactConfiguration, inertia: ContactInverseInertia, free: FreeMotion
) -> ForceSolution:
    """Return the forces of a configuration for this free motion."""
    s, _, friction, slots, contact, held, _ = configuration
    solution = solve_combination(s, inertia, free, contact, held, friction)
    outward = free.legs + inertia.legs.sin * solution.hub[0] + inertia.legs.cos * solution.hub[1]
    lengths = jnp.where(
        configuration.has_fixed_length, 0.0, outward - slots.scatter(solution.pull) / s.m
    )
    forces = solution.tangential, solution.normal, solution.stopper, solution.pull
    return ForceSolution(*forces, solution.hub, solution.painleve_determinant, lengths)


def _solve_with_free_motion(
    free_motion_fn: Callable[..., FreeMotion], configuration: ContactConfiguration
) -> tuple[ContactInverseInertia, FreeMotion, ForceSolution]:
    """Return inertia, free motion and forces of a configuration."""
    s, motion, unit = configuration.s, configuration.motion, opaque_one(configuration.motion)
    inertia = prevent_fusion(
        make_inverse_inertia(s, motion, configuration.slots, configuration.airborne), unit
    )
    free = prevent_fusion(free_motion_fn(s, motion, configuration.slots, inertia), unit)
    return inertia, free, prevent_fusion(solve_configuration(configuration, inertia, free), unit)


def solve_motion_with_free(
    configuration: ContactConfiguration,
) -> tuple[ContactInverseInertia, FreeMotion, ForceSolution]:
    """Return the inertia, the motion free of contact forces, and the forces."""
    return _solve_with_free_motion(free_acceleration, configuration)


def _differentiable_solution(
    free_motion_fn: Callable[..., FreeMotion],
    row_tangent_fn: _RowTangentFn,
    configuration: ContactConfiguration,
) -> ForceSolution:
    """Return the forces, with a derivative rule by the tangent of the residual."""
    floats, rest = eqx.partition(configuration, eqx.is_inexact_array)
    arrays, rest = eqx.partition(rest, eqx.is_array)
    assemble = lambda floats, arrays: eqx.combine(floats, arrays, rest)
    solve = jax.custom_jvp(
        lambda *arguments: _solve_with_free_motion(free_motion_fn, assemble(*arguments))[2]
    )

    @solve.defjvp
    @with_default_settings
    def rule(primals: tuple, tangents: tuple) -> tuple[ForceSolution, ForceSolution]:
        configuration, tangent = assemble(*primals), assemble(tangents[0], primals[1])
        inertia, free, solution = _solve_with_free_motion(free_motion_fn, configuration)
        residual = residual_jvp(
            configuration,
            tangent,
            inertia,
            solution,
            *row_tangent_fn(configuration, tangent, inertia, solution),
        )
        free_tangent = free_motion_tangent(
            inertia, residual.legs, sum_residual(configuration.slots, residual)
        )
        _, solution_tangent = jax.jvp(
            lambda free: solve_configuration(configuration, inertia, free), (free,), (free_tangent,)
        )
        add_pairs = lambda first, second: (first[0] + second[0], first[1] + second[1])
        return solution, solution_tangent._replace(
            tangential=add_pairs(solution_tangent.tangential, residual.friction_tangent),
            pull=add_pairs(solution_tangent.pull, residual.pull),
        )

    return solve(floats, arrays)


class ResidualTangent(NamedTuple):
    """Tangent of the residual, in the form of its effect on the unknowns."""

    legs: LegArray  # their lengths
    hub: tuple[LegArray, LegArray, LegArray]  # each leg's part of the forces there
    hub_extra: HubVector  # the forces there without the legs' part
    foot_e: SlotPair
    foot_u: SlotPair
    friction_tangent: SlotPair  # tangent of friction by its coefficient
    pull: SlotPair  # tangent of the slots' pulls by that, and by their legs' rotation


def residual_jvp(
    configuration: ContactConfiguration,
    tangent: ContactConfiguration,
    inertia: ContactInverseInertia,
    solution: ForceSolution,
    frozen: _FrozenTerms,
    row_tangents: _RowTangents,
) -> ResidualTangent:
    """Return the tangent of the residual along a tangent of the configuration."""
    s, ds, slots, (sin, cos), slot_range = (
        configuration.s,
        tangent.s,
        configuration.slots,
        inertia.legs,
        range(2),
    )
    b, db, dtheta = configuration.motion.L - s.a, tangent.motion.L - ds.a, tangent.motion.theta
    slip_signs = slip_sign(configuration.contact)
    coefficient_tangent = jax.jvp(finite_friction, (configuration.friction,), (tangent.friction,))[
        1
    ]
    coefficient_tangent = (
        coefficient_tangent
        if isinstance(coefficient_tangent, tuple)
        else (coefficient_tangent, coefficient_tangent)
    )
    t, n, L, dL = solution.tangential, solution.normal, inertia.L, slots.gather(tangent.motion.L)
    friction_tangent = [-slip_signs[i] * coefficient_tangent[i] * n[i] for i in slot_range]
    transverse = [t[i] * inertia.cos[i] - n[i] * inertia.sin[i] for i in slot_range]
    radial = [t[i] * inertia.sin[i] + n[i] * inertia.cos[i] for i in slot_range]
    pull = [friction_tangent[i] * inertia.sin[i] + transverse[i] * dtheta for i in slot_range]
    moment = [
        dL[i] * transverse[i] + L[i] * (friction_tangent[i] * inertia.cos[i] - radial[i] * dtheta)
        for i in slot_range
    ]

    (ax, az), (dx, dz) = frozen.hub, row_tangents.hub
    outward, lever = sin * ax + cos * az, frozen.transverse - cos * ax + sin * az
    legs = (cos * ax - sin * az) * dtheta - row_tangents.radial + sin * dx + cos * dz
    legs = (
        legs + (row_tangents.springs - slots.scatter(pull) + (outward - frozen.radial) * ds.m) / s.m
    )
    legs = jnp.where(inertia.is_released, legs, 0.0)
    net_legs = legs + row_tangents.radial
    x = frozen.radial * sin + frozen.transverse * cos
    z = frozen.radial * cos - frozen.transverse * sin
    torque = db * lever + b * (row_tangents.transverse + outward * dtheta - cos * dx + sin * dz)
    return ResidualTangent(
        legs=legs,
        hub=(
            s.m * (net_legs * sin + row_tangents.transverse * cos + z * dtheta) + ds.m * x,
            s.m * (net_legs * cos - row_tangents.transverse * sin - x * dtheta) + ds.m * z,
            -s.m * torque - ds.m * (b * lever) - slots.scatter(moment),
        ),
        hub_extra=(
            friction_tangent[0] + friction_tangent[1] - ds.Mt * ax - s.Mt * dx,
            -ds.Mt * az - s.Mt * dz,
            0.0,
        ),
        foot_e=row_tangents.foot_e,
        foot_u=row_tangents.foot_u,
        friction_tangent=(friction_tangent[0], friction_tangent[1]),
        pull=(pull[0], pull[1]),
    )


class TotalTangent(NamedTuple):
    """Tangent of the residual, summed over all legs and gathered for the slots."""

    hub: HubVector
    slot_legs: SlotPair
    foot_e: SlotPair
    foot_u: SlotPair
    friction_tangent: SlotPair


def sum_residual(slots: Slots, residual: ResidualTangent) -> TotalTangent:
    """Return the residual tangent summed over the legs."""
    x, z, rotation = (
        sum_over_legs(legs) + extra
        for legs, extra in zip(residual.hub, residual.hub_extra, strict=True)
    )
    return TotalTangent(
        (x, z, rotation),
        slots.gather(residual.legs),
        residual.foot_e,
        residual.foot_u,
        residual.friction_tangent,
    )


def free_motion_tangent(
    inertia: ContactInverseInertia, legs: LegArray, total: TotalTangent
) -> FreeMotion:
    """Return the tangent of the free motion that the residual tangent is equivalent to."""
    hub_tangent, slot_legs, (u, v) = (
        apply_inverse(inertia.inverse_inertia, total.hub),
        total.slot_legs,
        total.foot_u,
    )
    e = [
        inertia.cos[i] * hub_tangent[0]
        - inertia.sin[i] * hub_tangent[1]
        - inertia.L[i] * hub_tangent[2]
        for i in range(2)
    ]
    e = [e[i] + total.foot_e[i] for i in range(2)]
    return FreeMotion(
        hub_tangent, legs, slot_legs, (e[0], e[1]), (u - slot_legs[0], v - slot_legs[1])
    )


def motion_row_tangents(
    configuration: ContactConfiguration,
    tangent: ContactConfiguration,
    inertia: ContactInverseInertia,
    solution: ForceSolution,
) -> tuple[_FrozenTerms, _RowTangents]:
    """Return the frozen terms and the tangents of the rows of the equations of motion."""
    s, motion, slots = configuration.s, configuration.motion, configuration.slots
    ds, motion_tangent, dtheta = tangent.s, tangent.motion, tangent.motion.theta
    b, db, ddtheta = motion.L - s.a, motion_tangent.L - ds.a, solution.hub[2]
    spin, double_rate = motion.dtheta * motion.dtheta, 2.0 * motion.dtheta
    spin_tangent = double_rate * motion_tangent.dtheta
    double_rate_tangent = 2.0 * motion_tangent.dtheta
    springs = ds.k * (s.Ls - motion.L) - ds.c * motion.dL
    springs = springs + s.k * (ds.Ls - motion_tangent.L) - s.c * motion_tangent.dL
    frozen = _FrozenTerms(
        radial=solution.lengths - b * spin,
        transverse=double_rate * motion.dL + b * ddtheta,
        hub=(solution.hub[0] - s.g * s.sin_phi, solution.hub[1] + s.g * s.cos_phi),
    )
    L, dL, slot_rates, slot_rate_tangents = (
        inertia.L,
        *map(slots.gather, (motion_tangent.L, motion.dL, motion_tangent.dL)),
    )
    slot_accelerations = slots.gather(solution.lengths)
    foot_e = [
        (L[i] * spin - slot_accelerations[i]) * dtheta
        - double_rate * slot_rate_tangents[i]
        - slot_rates[i] * double_rate_tangent
        - ddtheta * dL[i]
        for i in range(2)
    ]
    foot_u = [
        (double_rate * slot_rates[i] + ddtheta * L[i]) * dtheta + spin * dL[i] + L[i] * spin_tangent
        for i in range(2)
    ]
    return frozen, _RowTangents(
        radial=-(db * spin + b * spin_tangent),
        transverse=double_rate * motion_tangent.dL + motion.dL * double_rate_tangent + ddtheta * db,
        hub=(-ds.g * s.sin_phi - s.g * ds.sin_phi, ds.g * s.cos_phi + s.g * ds.cos_phi),
        springs=springs,
        foot_e=(foot_e[0], foot_e[1]),
        foot_u=(foot_u[0], foot_u[1]),
    )


def _impact_row_tangents(
    configuration: ContactConfiguration,
    tangent: ContactConfiguration,
    inertia: ContactInverseInertia,
    solution: ForceSolution,
) -> tuple[_FrozenTerms, _RowTangents]:
    """Return the frozen terms and the tangents of the rows of the impact equations."""
    s = configuration.s
    motion = configuration.motion
    motion_tangent = tangent.motion
    slots = configuration.slots
    dtheta_after = solution.hub[2]
    rate_jump, b = dtheta_after - motion.dtheta, motion.L - s.a
    frozen = _FrozenTerms(
        radial=solution.lengths - motion.dL,
        transverse=b * rate_jump,
        hub=(solution.hub[0] - motion.vx, solution.hub[1] - motion.vz),
    )
    slot_rates, dL = slots.gather(solution.lengths), slots.gather(motion_tangent.L)
    foot_e = [-dtheta_after * dL[i] - slot_rates[i] * motion_tangent.theta for i in range(2)]
    return frozen, _RowTangents(
        radial=-motion_tangent.dL,
        transverse=(motion_tangent.L - tangent.s.a) * rate_jump - b * motion_tangent.dtheta,
        hub=(-motion_tangent.vx, -motion_tangent.vz),
        springs=0.0,
        foot_e=(foot_e[0], foot_e[1]),
        foot_u=(
            inertia.L[0] * dtheta_after * motion_tangent.theta,
            inertia.L[1] * dtheta_after * motion_tangent.theta,
        ),
    )
