"""Tangents of the dynamics along many directions, from the responses to unit coordinates.

The tangent at a point is linear in the direction: a unit of the angle has the same effect in every
direction. A length and its rate affect only the same leg, the hub and the slots. So legs that do
not move along any direction are skipped, and so are constant input columns.
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
    motion_equation_tangents,
    residual_jvp,
    solve_forces_with_free_motion,
    sum_residual,
)
from vrw_jax.contact.mechanics import (
    ContactInverseInertia,
    ContactSlots,
    FootVelocity,
    FreeMotion,
    HubVector,
    LegArray,
    LegDirections,
    SlotPair,
    WheelMotion,
    foot_velocity,
    make_posture,
    sum_over_legs,
)
from vrw_jax.numerics import run_if_any
from vrw_jax.wheel import PARAMETER_NAMES

N_MOVING_LEGS = 3
"""Number of leading legs that usually include all moving legs. The other legs are on their
stoppers."""
_LEG_GROUP_SLICES = slice(0, N_MOVING_LEGS), slice(N_MOVING_LEGS, None)
_MASS_PARAMETERS = "hub_mass", "leg_mass", "leg_com"
_SPRING_PARAMETERS = "natural_length", "stiffness", "damping"
_INPUT_NAMES = (
    *PARAMETER_NAMES,
    "friction",
    "friction_before",
)  # on uneven ground
PARAMETER_GROUPS = [
    tuple(map(_INPUT_NAMES.index, names))
    for names in (
        _MASS_PARAMETERS,
        _SPRING_PARAMETERS,
        ("slope", "gravity"),
        ("friction", "friction_before"),
    )
]
"""Indices of the input columns in each group with a common effect. Lengths act through the position
of stoppers alone, and the tilt of the next line acts through guards alone."""

CoordinateTangentFn = Callable[[slice], tuple[Array, Array]]
"""Function that returns the tangents of some coordinates and of their rates at a point."""


class UnitResponse(NamedTuple):
    """Response to a unit input, with constant forces and accelerations."""

    leg_lengths: LegArray  # acceleration of each leg's length
    total_tangent: TotalTangent
    foot_speed: SlotPair  # speed of the slots' feet along the slope
    damping: Array  # W


class _UnitLengthResponse(NamedTuple):
    """Response to a unit length of each leg, or to a unit length rate.

    - `slot_responses`: of lengths, of feet transverse to and along their legs, and of foot speeds.
    """

    leg_lengths: LegArray  # acceleration of the leg's length
    hub_vector: tuple[LegArray, LegArray, LegArray]
    slot_responses: tuple[SlotPair, SlotPair, SlotPair, SlotPair]


class _LengthResponse(NamedTuple):
    """Response to lengths and length rates of some legs along a tangent."""

    hub_vector: HubVector
    slot_length: SlotPair  # length of the slots' legs
    slot_length_rate: SlotPair
    damping: Array


class _PointLinearization(NamedTuple):
    """Linearization of the dynamics at one point."""

    dynamics: ModeDynamics
    motion: WheelMotion
    configuration: ContactConfiguration
    inertia: ContactInverseInertia
    free_motion: FreeMotion
    solution: ForceSolution
    zero_tangent: ContactConfiguration  # zero tangent of the configuration's floats

    @classmethod
    def from_motion(cls, dynamics: ModeDynamics, motion: WheelMotion) -> "_PointLinearization":
        """Return the linearization at this motion."""
        configuration = dynamics.configure(motion)
        force_solution = solve_forces_with_free_motion(configuration)
        float_leaves = eqx.filter(configuration, eqx.is_inexact_array)
        zero_tangent = jax.tree.map(jnp.zeros_like, float_leaves)
        return cls(dynamics, motion, configuration, *force_solution, zero_tangent)

    def make_leg_residual(
        self, leg_slice: slice
    ) -> Callable[[ContactConfiguration], tuple[ResidualTangent, ContactSlots]]:
        """Return a function of a tangent to the residual's tangent for some legs, and to the slots
        of these legs.
        """
        static_leaves = eqx.filter(self.configuration, eqx.is_inexact_array, inverse=True)
        configuration = _restrict_legs(self.configuration, leg_slice)
        directions = LegDirections(*(leg_row[leg_slice] for leg_row in self.inertia.leg_directions))
        hub = self.inertia._replace(
            leg_directions=directions, is_released=self.inertia.is_released[leg_slice]
        )
        solution = self.solution._replace(length_motion=self.solution.length_motion[leg_slice])

        @jax.jit  # The residual is traced once.
        def compute_residual(tangent: ContactConfiguration) -> ResidualTangent:
            residual_arguments = (
                configuration,
                _restrict_legs(eqx.combine(tangent, static_leaves), leg_slice),
                hub,
                solution,
            )
            return residual_jvp(*residual_arguments, *motion_equation_tangents(*residual_arguments))

        return lambda tangent: (compute_residual(tangent), configuration.contact_slots)

    def foot_speed_tangent(self, tangent: WheelMotion) -> SlotPair:
        """Return the tangent of the slots' foot speeds along the slope."""
        s, contact_slots = self.dynamics.s, self.dynamics.contact_slots
        compute_speeds = lambda motion: (
            foot_velocity(motion, contact_slots, make_posture(s, motion, contact_slots)).x
        )
        return jax.jvp(compute_speeds, (self.motion,), (tangent,))[1]

    def linearize_along(
        self,
        motion: WheelMotion,
        leg_residual: Callable[[ContactConfiguration], tuple[ResidualTangent, ContactSlots]],
    ) -> tuple:
        """Return residual tangent, slots and foot speeds of some legs along a tangent of the
        motion.
        """
        return *leg_residual(self.zero_tangent._replace(motion=motion)), self.foot_speed_tangent(
            motion
        )

    def compute_unit_length_responses(
        self, leg_slice: slice
    ) -> tuple[_UnitLengthResponse, _UnitLengthResponse]:
        """Return the responses to unit lengths of some legs, and to unit length rates."""
        leg_residual = self.make_leg_residual(leg_slice)

        def respond_to_coordinate(coordinate_name: str) -> _UnitLengthResponse:
            leg_row = getattr(self.zero_tangent.motion, coordinate_name)
            unit_tangent = jnp.stack(
                [x + float(i in range(len(leg_row))[leg_slice]) for i, x in enumerate(leg_row)]
            )
            residual, contact_slots, foot_speed = self.linearize_along(
                self.zero_tangent.motion._replace(**{coordinate_name: unit_tangent}), leg_residual
            )
            return _UnitLengthResponse(
                residual.leg_lengths,
                residual.hub_by_leg,
                (
                    contact_slots.gather(residual.leg_lengths),
                    residual.foot_transverse_motion,
                    residual.foot_radial_motion,
                    foot_speed,
                ),
            )

        return respond_to_coordinate("L"), respond_to_coordinate("dL")

    def linearize_solution(self) -> Callable[[FreeMotion], tuple[HubVector, SlotPair, SlotPair]]:
        """Return the tangent map from free motion to hub acceleration, pulls and tangential
        forces.
        """
        s, friction = self.configuration.s, self.configuration.friction
        slot_modes, is_held = self.configuration.slot_modes, self.configuration.is_held

        def solve_forces(free_motion: FreeMotion) -> tuple[HubVector, SlotPair, SlotPair]:
            solution = solve_combination(
                s, self.inertia, free_motion, slot_modes, is_held, friction
            )
            return solution.hub_vector, solution.pull, solution.tangential

        return jax.linearize(solve_forces, self.free_motion)[1]


def _restrict_legs(configuration: ContactConfiguration, leg_slice: slice) -> ContactConfiguration:
    """Return the configuration restricted to some legs."""
    motion, contact_slots = configuration.motion, configuration.contact_slots
    return configuration._replace(
        motion=motion._replace(L=motion.L[leg_slice], dL=motion.dL[leg_slice]),
        contact_slots=ContactSlots(
            contact_slots.first_mask[leg_slice], contact_slots.second_mask[leg_slice]
        ),
        is_airborne_locked=configuration.is_airborne_locked[leg_slice],
    )


class TangentBasis(NamedTuple):
    """Quantities at a point that are common to all tangents.

    - `all_leg_residual`: function to the residual of all legs along any tangent;
    - `length_responses`: those of the first legs, and those of the others;
    - `slot_responses`: sum of both for the slots.
    """

    linearization: _PointLinearization
    forces: ContactForces
    solve_tangent: Callable[[FreeMotion], tuple[HubVector, SlotPair, SlotPair]]
    all_leg_residual: Callable[[ContactConfiguration], tuple[ResidualTangent, ContactSlots]]
    angle_responses: tuple[UnitResponse, UnitResponse]  # response to the angle, and to its rate
    length_responses: tuple[
        tuple[_UnitLengthResponse, _UnitLengthResponse],
        tuple[_UnitLengthResponse, _UnitLengthResponse],
    ]
    slot_responses: tuple[tuple[SlotPair, SlotPair, SlotPair, SlotPair], ...]
    damping_response: LegArray  # damping power for a unit rate of each leg, W
    slip_tangent: Callable[[SlotPair, SlotPair], Array]  # tangents of sliding loss and slip

    @classmethod
    def from_motion(
        cls, dynamics: ModeDynamics, motion: WheelMotion, has_later_moving_legs: Array
    ) -> "TangentBasis":
        """Return the basis at this motion.

        - `has_later_moving_legs`: whether legs after the first `N_MOVING_LEGS` move.
        """
        linearization = _PointLinearization.from_motion(dynamics, motion)
        forces = compute_forces(dynamics, motion)
        all_leg_residual = linearization.make_leg_residual(slice(None))
        first_responses, n = (
            linearization.compute_unit_length_responses(_LEG_GROUP_SLICES[0]),
            len(motion.L),
        )
        make_zeros = lambda foot_velocity_x: jnp.zeros(
            (n - N_MOVING_LEGS, *foot_velocity_x.shape[1:])
            if foot_velocity_x.ndim > 1
            else foot_velocity_x.shape,
            foot_velocity_x.dtype,
        )
        other_responses = run_if_any(
            has_later_moving_legs,
            lambda _: linearization.compute_unit_length_responses(_LEG_GROUP_SLICES[1]),
            jax.tree.map(make_zeros, first_responses),
        )

        def compute_slip_rates(x: SlotPair, tangential: SlotPair) -> Array:
            solution = forces.solution._replace(tangential=tangential)
            rates = accumulator_rates(
                dynamics,
                motion,
                forces._replace(solution=solution, foot_velocity=FootVelocity(x, x)),
            )
            return jnp.stack([rates.friction_loss, rates.slip_length])

        compute_damping = lambda dL: (
            accumulator_rates(dynamics, motion._replace(dL=dL), forces).damping_loss
        )
        (damping_response,) = jax.vjp(compute_damping, motion.dL)[1](jnp.ones_like(motion.theta))
        _, slip_tangent = jax.linearize(
            compute_slip_rates, forces.foot_velocity.x, forces.solution.tangential
        )
        unit_tangent = jnp.ones_like(motion.theta)

        def respond_to_angle(coordinate_name: str) -> UnitResponse:
            residual, contact_slots, foot_speed = linearization.linearize_along(
                linearization.zero_tangent.motion._replace(**{coordinate_name: unit_tangent}),
                all_leg_residual,
            )
            return UnitResponse(
                residual.leg_lengths,
                sum_residual(contact_slots, residual),
                foot_speed,
                jnp.zeros_like(unit_tangent),
            )

        angle_responses = respond_to_angle("theta"), respond_to_angle("dtheta")
        slot_responses = [
            jax.tree.map(
                operator.add, *(foot_velocity_x.slot_responses for foot_velocity_x in responses)
            )
            for responses in zip(first_responses, other_responses, strict=True)
        ]
        return cls(
            linearization,
            forces,
            linearization.linearize_solution(),
            all_leg_residual,
            angle_responses,
            (first_responses, other_responses),
            tuple(slot_responses),
            damping_response,
            slip_tangent,
        )

    def compute_column_response(
        self, dynamics_fn: DynamicsFn, input_columns: Array, input_tangent: Array
    ) -> UnitResponse:
        """Return the response to a tangent of the input columns."""
        linearization, zero_response = self.linearization, self.make_zero_response()

        def configure_columns(input_columns: Array) -> tuple[ContactConfiguration, Array]:
            dynamics = dynamics_fn(input_columns)
            rates = accumulator_rates(dynamics, linearization.motion, self.forces)
            return eqx.filter(
                dynamics.configure(linearization.motion), eqx.is_inexact_array
            ), rates.damping_loss

        _, column_pushforward = jax.linearize(configure_columns, input_columns)
        total_response = zero_response
        for parameter_group in PARAMETER_GROUPS:
            input_indices = [i for i in parameter_group if i < len(input_tangent)]
            group_tangent = jnp.stack(
                [
                    input_row if i in input_indices else 0.0 * input_row
                    for i, input_row in enumerate(input_tangent)
                ]
            )

            def add_response(
                total_response: UnitResponse, group_tangent: Array = group_tangent
            ) -> UnitResponse:
                configuration, damping_tangent = column_pushforward(group_tangent)
                residual, contact_slots = self.all_leg_residual(configuration)
                response = UnitResponse(
                    residual.leg_lengths,
                    sum_residual(contact_slots, residual),
                    zero_response.foot_speed,
                    damping_tangent,
                )
                return jax.tree.map(operator.add, total_response, response)

            has_tangent = jnp.any(jnp.stack([input_tangent[i] != 0.0 for i in input_indices]))
            total_response = run_if_any(has_tangent, add_response, total_response)
        return total_response

    def make_zero_response(self) -> UnitResponse:
        """Return the zero response."""
        return jax.tree.map(jnp.zeros_like, self.angle_responses[0])

    def propagate_tangent(
        self,
        coordinate_tangent_fn: CoordinateTangentFn,
        column_response: UnitResponse,
        has_later_moving_legs: Array,
    ) -> Array:
        """Return the tangent of accelerations and, if requested, accumulators, along one direction.

        - `coordinate_tangent_fn`: function to the tangents of some coordinates and rates;
        - `column_response`: response to the direction's input columns.
        """
        q, v = coordinate_tangent_fn(slice(0, 3 + N_MOVING_LEGS))
        theta, dtheta, first_length_tangents = q[2], v[2], (q[3:], v[3:])
        later_length_tangents = lambda: coordinate_tangent_fn(slice(3 + N_MOVING_LEGS, None))
        add_trees = lambda first_tree, second_tree: jax.tree.map(
            operator.add, first_tree, second_tree
        )
        length_response = self._propagate_lengths(0, *first_length_tangents)
        length_response = run_if_any(
            has_later_moving_legs,
            lambda _: add_trees(
                length_response, self._propagate_lengths(1, *later_length_tangents())
            ),
            length_response,
        )
        combine_responses = lambda a, b, c: a * theta + b * dtheta + c
        combined_responses = [
            jax.tree.map(combine_responses, *slot_rows)
            for slot_rows in zip(*self.angle_responses, column_response, strict=True)
        ][1:]
        total_tangent, foot_speed, damping_tangent = combined_responses
        slot_rows = (
            total_tangent.slot_lengths,
            total_tangent.foot_transverse_motion,
            total_tangent.foot_radial_motion,
            foot_speed,
        )
        slot_lengths, foot_transverse, foot_radial, foot_speed = (
            tuple(
                a[i]
                + b[i] * length_response.slot_length[i]
                + c[i] * length_response.slot_length_rate[i]
                for i in range(2)
            )
            for a, b, c in zip(slot_rows, *self.slot_responses, strict=True)
        )
        hub_tangent = tuple(map(operator.add, total_tangent.hub_vector, length_response.hub_vector))
        total_tangent = TotalTangent(
            hub_tangent, slot_lengths, foot_transverse, foot_radial, total_tangent.friction_force
        )
        free_tangent = free_motion_tangent(
            self.linearization.inertia, jnp.zeros_like(self.linearization.motion.L), total_tangent
        )
        hub_tangent, pull_tangent, tangential_tangent = self.solve_tangent(free_tangent)
        propagate_legs = lambda group_index, *length_tangents: self._propagate_legs(
            group_index,
            hub_tangent,
            pull_tangent,
            combine_responses,
            column_response.leg_lengths,
            *length_tangents,
        )
        zero_legs = jnp.zeros(
            (len(self.damping_response) - N_MOVING_LEGS, *theta.shape), theta.dtype
        )
        row_tangents = [
            jnp.stack(hub_tangent),
            propagate_legs(0, *first_length_tangents),
            run_if_any(
                has_later_moving_legs,
                lambda _: propagate_legs(1, *later_length_tangents()),
                zero_legs,
            ),
        ]
        if self.linearization.dynamics.has_accumulators:
            foot_speed = foot_speed[0] + v[0], foot_speed[1] + v[0]
            tangential_tangent = tuple(
                map(operator.add, tangential_tangent, total_tangent.friction_force)
            )
            row_tangents += [
                (damping_tangent + length_response.damping)[None],
                self.slip_tangent(foot_speed, tangential_tangent),
            ]
        return jnp.concatenate(row_tangents)

    def _propagate_lengths(self, group_index: int, L: Any, dL: Any) -> _LengthResponse:
        """Return the response to lengths and length rates of one group of legs."""
        length_response, rate_response = self.length_responses[group_index]
        leg_slice = _LEG_GROUP_SLICES[group_index]
        sum_response = lambda a, b: sum_over_legs(a * L + b * dL)
        x, z, rotation = map(sum_response, length_response.hub_vector, rate_response.hub_vector)
        contact_slots = self.linearization.dynamics.contact_slots
        group_slots = ContactSlots(
            contact_slots.first_mask[leg_slice], contact_slots.second_mask[leg_slice]
        )
        return _LengthResponse(
            (x, z, rotation),
            group_slots.gather(L),
            group_slots.gather(dL),
            sum_over_legs(self.damping_response[leg_slice] * dL),
        )

    def _propagate_legs(
        self,
        group_index: int,
        hub_tangent: HubVector,
        pull_tangent: SlotPair,
        combine_responses: Callable,
        column_leg_response: Any,
        L: Any,
        dL: Any,
    ) -> Array:
        """Return the tangents of the length accelerations of one group of legs, m/s^2."""
        (length_response, rate_response), leg_slice, linearization = (
            self.length_responses[group_index],
            _LEG_GROUP_SLICES[group_index],
            self.linearization,
        )
        angle_response = combine_responses(
            *(response.leg_lengths[leg_slice] for response in self.angle_responses),
            column_leg_response[leg_slice],
        )
        configuration = _restrict_legs(linearization.configuration, leg_slice)
        sin, cos = (leg_row[leg_slice] for leg_row in linearization.inertia.leg_directions)
        outward_motion = (
            angle_response
            + length_response.leg_lengths * L
            + rate_response.leg_lengths * dL
            + sin * hub_tangent[0]
            + cos * hub_tangent[1]
        )
        outward_motion = (
            outward_motion - configuration.contact_slots.scatter(pull_tangent) / configuration.s.m
        )
        return jnp.where(
            linearization.configuration.has_fixed_length[leg_slice], 0.0, outward_motion
        )
