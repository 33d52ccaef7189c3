"""Tangents of the dynamics along many directions, from the responses to unit coordinates.

At a point everything is linear: a unit of the angle has the same effect in every direction. A
length and its rate affect only their own leg, the hub and the slots. So legs are skipped if none of
them moves, and so are input columns.
"""

import operator
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from vrw_jax.contact.batch_integrator import DynamicsFn
from vrw_jax.contact.contact_modes import solve_combination
from vrw_jax.contact.contact_state import (
    ContactForces,
    ModeDynamics,
    accumulator_rates,
    compute_forces,
)
from vrw_jax.contact.dynamics_jvp import (
    ContactConfiguration,
    ForceSolution,
    ResidualTangent,
    TotalTangent,
    free_motion_tangent,
    motion_row_tangents,
    residual_jvp,
    solve_motion_with_free,
    sum_residual,
)
from vrw_jax.contact.mechanics import (
    ContactInverseInertia,
    FootVelocity,
    FreeMotion,
    HubVector,
    LegArray,
    LegDirections,
    SlotPair,
    Slots,
    WheelMotion,
    foot_velocity,
    make_posture,
    sum_over_legs,
)
from vrw_jax.numerics import run_if_any
from vrw_jax.wheel import PARAMETER_NAMES

N_MOVING_LEGS = 3
"""Number of leading legs that usually include all that move: the others are on their stoppers."""
_LEG_SLICES = slice(0, N_MOVING_LEGS), slice(N_MOVING_LEGS, None)
_MASS_PARAMETERS = "hub_mass", "leg_mass", "leg_com"
_SPRING_PARAMETERS = "natural_length", "stiffness", "damping"
_INPUT_NAMES = *PARAMETER_NAMES, "friction", "friction_before"  # the latter on uneven ground
PARAMETER_GROUPS = [
    tuple(map(_INPUT_NAMES.index, names))
    for names in (
        _MASS_PARAMETERS,
        _SPRING_PARAMETERS,
        ("slope", "gravity"),
        ("friction", "friction_before"),
    )
]
"""Groups of columns with one common effect. Lengths act through the position of stoppers alone, the
tilt of the next line through guards alone."""

CoordinateTangentFn = Callable[[slice], tuple[Array, Array]]
"""Function that returns some coordinates and rates of a tangent at a point."""


class UnitResponse(NamedTuple):
    """Response to a unit input, with forces and accelerations fixed."""

    legs: LegArray  # of their lengths
    totals: TotalTangent
    foot_speed: SlotPair  # of the slots' feet along the slope
    damping: Array  # W


class _UnitLengthResponse(NamedTuple):
    """Response to a unit length of each leg, or to a unit rate.

    - `slots`: responses of lengths, of feet along e and along u, and of foot speed.
    """

    legs: LegArray  # of its own length
    hub: tuple[LegArray, LegArray, LegArray]
    slots: tuple[SlotPair, SlotPair, SlotPair, SlotPair]


class _LengthResponse(NamedTuple):
    """Response to the lengths and rates of some legs along a tangent."""

    hub: HubVector
    L: SlotPair  # the slots'
    dL: SlotPair
    damping: Array


class _PointLinearization(NamedTuple):
    """Linearization at one point."""

    dynamics: ModeDynamics
    motion: WheelMotion
    configuration: ContactConfiguration
    hub: ContactInverseInertia
    free: FreeMotion
    solution: ForceSolution
    zero_tangent: ContactConfiguration  # floats of the zero tangent

    @classmethod
    def from_motion(cls, dynamics: ModeDynamics, motion: WheelMotion) -> "_PointLinearization":
        """Return the linearization at this motion."""
        configuration = dynamics.configure(motion)
        solved = solve_motion_with_free(configuration)
        floats = eqx.filter(configuration, eqx.is_inexact_array)
        zero_tangent = jax.tree.map(jnp.zeros_like, floats)
        return cls(dynamics, motion, configuration, *solved, zero_tangent)

    def make_leg_residual(
        self, leg_slice: slice
    ) -> Callable[[ContactConfiguration], tuple[ResidualTangent, Slots]]:
        """Return the residual tangent of some legs along a tangent, and the slots of these legs."""
        rest = eqx.filter(self.configuration, eqx.is_inexact_array, inverse=True)
        configuration = _restrict_legs(self.configuration, leg_slice)
        directions = LegDirections(*(row[leg_slice] for row in self.hub.legs))
        hub = self.hub._replace(legs=directions, is_released=self.hub.is_released[leg_slice])
        solution = self.solution._replace(lengths=self.solution.lengths[leg_slice])

        @jax.jit  # traced once
        def compute_residual(tangent: ContactConfiguration) -> ResidualTangent:
            arguments = (
                configuration,
                _restrict_legs(eqx.combine(tangent, rest), leg_slice),
                hub,
                solution,
            )
            return residual_jvp(*arguments, *motion_row_tangents(*arguments))

        return lambda tangent: (compute_residual(tangent), configuration.slots)

    def foot_speed_tangent(self, tangent: WheelMotion) -> SlotPair:
        """Return the tangent of the foot speeds."""
        s, slots = self.dynamics.s, self.dynamics.slots
        compute_speeds = lambda motion: (
            foot_velocity(motion, slots, make_posture(s, motion, slots)).x
        )
        return jax.jvp(compute_speeds, (self.motion,), (tangent,))[1]

    def respond(
        self,
        motion: WheelMotion,
        leg_residual: Callable[[ContactConfiguration], tuple[ResidualTangent, Slots]],
    ) -> tuple:
        """Return the residual tangent of legs along a motion tangent, their slots, and the feet's
        speed.
        """
        return *leg_residual(self.zero_tangent._replace(motion=motion)), self.foot_speed_tangent(
            motion
        )

    def unit_length_responses(
        self, leg_slice: slice
    ) -> tuple[_UnitLengthResponse, _UnitLengthResponse]:
        """Return the responses to some legs' lengths, and to their rates."""
        leg_residual = self.make_leg_residual(leg_slice)

        def respond_to(name: str) -> _UnitLengthResponse:
            row = getattr(self.zero_tangent.motion, name)
            unit_tangent = jnp.stack(
                [x + float(i in range(len(row))[leg_slice]) for i, x in enumerate(row)]
            )
            residual, slots, speed = self.respond(
                self.zero_tangent.motion._replace(**{name: unit_tangent}), leg_residual
            )
            return _UnitLengthResponse(
                residual.legs,
                residual.hub,
                (slots.gather(residual.legs), residual.foot_e, residual.foot_u, speed),
            )

        return respond_to("L"), respond_to("dL")

    def linearize_solution(self) -> Callable[[FreeMotion], tuple[HubVector, SlotPair, SlotPair]]:
        """Return the tangent map from free motion to hub acceleration, pulls and tangential
        forces.
        """
        s, friction = self.configuration.s, self.configuration.friction
        contact, held = self.configuration.contact, self.configuration.held

        def solve(free: FreeMotion) -> tuple[HubVector, SlotPair, SlotPair]:
            solution = solve_combination(s, self.hub, free, contact, held, friction)
            return solution.hub, solution.pull, solution.tangential

        return jax.linearize(solve, self.free)[1]


def _restrict_legs(configuration: ContactConfiguration, leg_slice: slice) -> ContactConfiguration:
    """Return the configuration restricted to some legs."""
    motion, slots = configuration.motion, configuration.slots
    return configuration._replace(
        motion=motion._replace(L=motion.L[leg_slice], dL=motion.dL[leg_slice]),
        slots=Slots(slots.first[leg_slice], slots.second[leg_slice]),
        airborne=configuration.airborne[leg_slice],
    )


class TangentBasis(NamedTuple):
    """Quantities at a point that all tangents share.

    - `whole_residual`: residual of all legs along any tangent;
    - `length_responses`: those of the first legs, and of the others;
    - `slot_responses`: the sum of these for the slots.
    """

    linearization: _PointLinearization
    forces: ContactForces
    solve_tangent: Callable[[FreeMotion], tuple[HubVector, SlotPair, SlotPair]]
    whole_residual: Callable[[ContactConfiguration], tuple[ResidualTangent, Slots]]
    angle_responses: tuple[UnitResponse, UnitResponse]  # to the angle, and to its rate
    length_responses: tuple[
        tuple[_UnitLengthResponse, _UnitLengthResponse],
        tuple[_UnitLengthResponse, _UnitLengthResponse],
    ]
    slot_responses: tuple[tuple[SlotPair, SlotPair, SlotPair, SlotPair], ...]
    damping: LegArray  # W, for a unit rate of each leg
    slip_tangent: Callable[[SlotPair, SlotPair], Array]  # tangent of sliding loss and slip

    @classmethod
    def from_motion(
        cls, dynamics: ModeDynamics, motion: WheelMotion, has_more_moving: Array
    ) -> "TangentBasis":
        """Return the basis at this motion; `has_more_moving`: more than the first legs move."""
        linearization = _PointLinearization.from_motion(dynamics, motion)
        current_forces = compute_forces(dynamics, motion)
        whole_residual = linearization.make_leg_residual(slice(None))
        first_responses, n = linearization.unit_length_responses(_LEG_SLICES[0]), len(motion.L)
        make_zeros = lambda x: jnp.zeros(
            (n - N_MOVING_LEGS, *x.shape[1:]) if x.ndim > 1 else x.shape, x.dtype
        )
        other_responses = run_if_any(
            has_more_moving,
            lambda _: linearization.unit_length_responses(_LEG_SLICES[1]),
            jax.tree.map(make_zeros, first_responses),
        )

        def compute_slip(x: SlotPair, tangential: SlotPair) -> Array:
            solution = current_forces.solution._replace(tangential=tangential)
            rates = accumulator_rates(
                dynamics,
                motion,
                current_forces._replace(solution=solution, foot_velocity=FootVelocity(x, x)),
            )
            return jnp.stack([rates.friction, rates.slip])

        compute_damping = lambda dL: (
            accumulator_rates(dynamics, motion._replace(dL=dL), current_forces).damping
        )
        (damping,) = jax.vjp(compute_damping, motion.dL)[1](jnp.ones_like(motion.theta))
        _, slip_tangent = jax.linearize(
            compute_slip, current_forces.foot_velocity.x, current_forces.solution.tangential
        )
        ones = jnp.ones_like(motion.theta)

        def respond_to_angle(name: str) -> UnitResponse:
            residual, slots, foot_speed = linearization.respond(
                linearization.zero_tangent.motion._replace(**{name: ones}), whole_residual
            )
            return UnitResponse(
                residual.legs, sum_residual(slots, residual), foot_speed, jnp.zeros_like(ones)
            )

        angle_responses = respond_to_angle("theta"), respond_to_angle("dtheta")
        slot_responses = [
            jax.tree.map(operator.add, *(x.slots for x in responses))
            for responses in zip(first_responses, other_responses, strict=True)
        ]
        return cls(
            linearization,
            current_forces,
            linearization.linearize_solution(),
            whole_residual,
            angle_responses,
            (first_responses, other_responses),
            tuple(slot_responses),
            damping,
            slip_tangent,
        )

    def respond_to_columns(
        self, flow_at: DynamicsFn, columns: Array, tangent: Array
    ) -> UnitResponse:
        """Return the response to a tangent of the input columns."""
        linearization, zero_response = self.linearization, self.make_zero()

        def configure_columns(columns: Array) -> tuple[ContactConfiguration, Array]:
            dynamics = flow_at(columns)
            rates = accumulator_rates(dynamics, linearization.motion, self.forces)
            return eqx.filter(
                dynamics.configure(linearization.motion), eqx.is_inexact_array
            ), rates.damping

        _, push_columns = jax.linearize(configure_columns, columns)
        total = zero_response
        for alike in PARAMETER_GROUPS:
            group = [i for i in alike if i < len(tangent)]
            group_tangent = jnp.stack(
                [row if i in group else 0.0 * row for i, row in enumerate(tangent)]
            )

            def add_response(
                total: UnitResponse, group_tangent: Array = group_tangent
            ) -> UnitResponse:
                configuration, damping = push_columns(group_tangent)
                residual, slots = self.whole_residual(configuration)
                response = UnitResponse(
                    residual.legs, sum_residual(slots, residual), zero_response.foot_speed, damping
                )
                return jax.tree.map(operator.add, total, response)

            has_tangent = jnp.any(jnp.stack([tangent[i] != 0.0 for i in group]))
            total = run_if_any(has_tangent, add_response, total)
        return total

    def make_zero(self) -> UnitResponse:
        """Return the zero response."""
        return jax.tree.map(jnp.zeros_like, self.angle_responses[0])

    def propagate_tangent(
        self,
        coordinates: CoordinateTangentFn,
        column_response: UnitResponse,
        has_more_moving: Array,
    ) -> Array:
        """Return the tangent of the accelerations and, if requested, of the accumulators."""
        q, v = coordinates(slice(0, 3 + N_MOVING_LEGS))
        theta, dtheta, first_tangents = q[2], v[2], (q[3:], v[3:])
        other_tangents = lambda: coordinates(slice(3 + N_MOVING_LEGS, None))
        add_trees = lambda first, second: jax.tree.map(operator.add, first, second)
        lengths = self._propagate_lengths(0, *first_tangents)
        lengths = run_if_any(
            has_more_moving,
            lambda _: add_trees(lengths, self._propagate_lengths(1, *other_tangents())),
            lengths,
        )
        combine = lambda a, b, c: a * theta + b * dtheta + c
        responses = [
            jax.tree.map(combine, *rows)
            for rows in zip(*self.angle_responses, column_response, strict=True)
        ][1:]
        totals, foot_speed, damping = responses
        rows = totals.slot_legs, totals.foot_e, totals.foot_u, foot_speed
        slot_legs, foot_e, foot_u, foot_speed = (
            tuple(a[i] + b[i] * lengths.L[i] + c[i] * lengths.dL[i] for i in range(2))
            for a, b, c in zip(rows, *self.slot_responses, strict=True)
        )
        hub = tuple(map(operator.add, totals.hub, lengths.hub))
        totals = TotalTangent(hub, slot_legs, foot_e, foot_u, totals.friction_tangent)
        free = free_motion_tangent(
            self.linearization.hub, jnp.zeros_like(self.linearization.motion.L), totals
        )
        hub, pull, tangential = self.solve_tangent(free)
        propagate_legs = lambda group_index, *length_tangents: self._propagate_legs(
            group_index, hub, pull, combine, column_response.legs, *length_tangents
        )
        zero_legs = jnp.zeros((len(self.damping) - N_MOVING_LEGS, *theta.shape), theta.dtype)
        row_tangents = [
            jnp.stack(hub),
            propagate_legs(0, *first_tangents),
            run_if_any(has_more_moving, lambda _: propagate_legs(1, *other_tangents()), zero_legs),
        ]
        if self.linearization.dynamics.accumulates:
            foot_speed = foot_speed[0] + v[0], foot_speed[1] + v[0]
            tangential = tuple(map(operator.add, tangential, totals.friction_tangent))
            row_tangents += [
                (damping + lengths.damping)[None],
                self.slip_tangent(foot_speed, tangential),
            ]
        return jnp.concatenate(row_tangents)

    def _propagate_lengths(self, group_index: int, L: Any, dL: Any) -> _LengthResponse:
        by_length, by_rate = self.length_responses[group_index]
        leg_slice = _LEG_SLICES[group_index]
        total_response = lambda a, b: sum_over_legs(a * L + b * dL)
        x, z, rotation = map(total_response, by_length.hub, by_rate.hub)
        slots = self.linearization.dynamics.slots
        group_slots = Slots(slots.first[leg_slice], slots.second[leg_slice])
        return _LengthResponse(
            (x, z, rotation),
            group_slots.gather(L),
            group_slots.gather(dL),
            sum_over_legs(self.damping[leg_slice] * dL),
        )

    def _propagate_legs(
        self,
        group_index: int,
        hub: HubVector,
        pull: SlotPair,
        combine: Callable,
        column_legs: Any,
        L: Any,
        dL: Any,
    ) -> Array:
        (by_length, by_rate), leg_slice, linearization = (
            self.length_responses[group_index],
            _LEG_SLICES[group_index],
            self.linearization,
        )
        by_angle = combine(
            *(response.legs[leg_slice] for response in self.angle_responses), column_legs[leg_slice]
        )
        configuration = _restrict_legs(linearization.configuration, leg_slice)
        sin, cos = (row[leg_slice] for row in linearization.hub.legs)
        outward = by_angle + by_length.legs * L + by_rate.legs * dL + sin * hub[0] + cos * hub[1]
        outward = outward - configuration.slots.scatter(pull) / configuration.s.m
        return jnp.where(linearization.configuration.has_fixed_length[leg_slice], 0.0, outward)
