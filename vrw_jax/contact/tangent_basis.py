"""Propagate many tangents through the dynamics, using the responses to unit coordinates.

The tangent of the dynamics is linear in the direction: a unit change of the angle has the same
effect in every direction. The length of a leg and its rate affect only the same leg, the hub and
the legs in the contact slots. Legs that do not move in any direction are skipped, and so are
constant inputs.
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
    compute_accumulator_rates,
    compute_forces,
)
from vrw_jax.contact.dynamics_jvp import (
    ContactConfiguration,
    ResidualTangent,
    SummedResidualTangent,
    WheelForceSolution,
    compute_free_motion_tangent,
    compute_motion_equation_tangents,
    compute_residual_tangent,
    solve_forces_with_free_motion,
    sum_residual_tangent,
)
from vrw_jax.contact.mechanics import (
    ContactInverseInertia,
    ContactSlots,
    FreeMotion,
    HubVector,
    LegArray,
    LegDirections,
    SlotFootVelocity,
    SlotPair,
    WheelMotion,
    compute_slot_foot_velocity,
    make_wheel_posture,
    sum_over_legs,
)
from vrw_jax.numerics import run_if_any
from vrw_jax.wheel import PARAMETER_NAMES

N_MOVING_LEGS = 3
"""Number of leading legs that usually include all moving legs.

The other legs are usually on their stoppers.
"""
_LEG_GROUP_SLICES = slice(0, N_MOVING_LEGS), slice(N_MOVING_LEGS, None)
_MASS_PARAMETERS = "hub_mass", "leg_mass", "leg_com"
_SPRING_PARAMETERS = "natural_length", "stiffness", "damping"
_INPUT_NAMES = (
    *PARAMETER_NAMES,
    "friction",
    "friction_before",
)  # on uneven ground
PARAMETER_GROUPS = [
    tuple(map(_INPUT_NAMES.index, group_names))
    for group_names in (
        _MASS_PARAMETERS,
        _SPRING_PARAMETERS,
        ("slope", "gravity"),
        ("friction", "friction_before"),
    )
]
"""Indices of the parameters and friction in each group whose effects are computed together.

The locked length acts only through the position of stoppers. The tilt of the next line of uneven
ground acts only through guards.
"""

CoordinateTangentFn = Callable[[slice], tuple[Array, Array]]
"""Function that returns the tangents of a slice of coordinates and of their rates at a point."""


class UnitInputResponse(NamedTuple):
    """Tangent of the contact equations for a unit input, at constant forces and accelerations."""

    leg_length_residual: LegArray  # acceleration of each leg's length
    summed_residual_tangent: SummedResidualTangent
    foot_speed_tangent: SlotPair  # tangential speeds of the feet in contact
    damping_loss_rate: Array  # W


class _UnitLegLengthResponse(NamedTuple):
    """Tangent of the contact equations for a unit length of each leg, or for a unit length rate.

    - `slot_responses`: responses for the legs in the contact slots: lengths, motions of the feet
      transverse to the legs, motions along the legs, and foot speeds.
    """

    leg_length_residual: LegArray  # acceleration of the leg's length
    hub_residual: tuple[LegArray, LegArray, LegArray]
    slot_responses: tuple[SlotPair, SlotPair, SlotPair, SlotPair]


class _LegLengthResponse(NamedTuple):
    """Tangent of the contact equations for lengths and length rates of a group of legs."""

    hub_residual: HubVector
    slot_length_residual: SlotPair  # lengths of the legs in the contact slots
    slot_length_rate_residual: SlotPair
    damping_loss_rate: Array


class _DynamicsLinearization(NamedTuple):
    """Linearization of the wheel's dynamics at one motion."""

    dynamics: ModeDynamics
    motion: WheelMotion
    configuration: ContactConfiguration
    inertia: ContactInverseInertia
    free_motion: FreeMotion
    force_solution: WheelForceSolution
    zero_tangent: ContactConfiguration  # zero tangent of the configuration's floats

    @classmethod
    def from_motion(
        cls, mode_dynamics: ModeDynamics, motion: WheelMotion
    ) -> "_DynamicsLinearization":
        """Return the linearization of the dynamics at a motion."""
        contact_configuration = mode_dynamics.configure_contacts(motion)
        force_solution = solve_forces_with_free_motion(contact_configuration)
        float_leaves = eqx.filter(contact_configuration, eqx.is_inexact_array)
        zero_tangent = jax.tree.map(jnp.zeros_like, float_leaves)
        return cls(mode_dynamics, motion, contact_configuration, *force_solution, zero_tangent)

    def make_leg_residual_function(
        self, leg_slice: slice
    ) -> Callable[[ContactConfiguration], tuple[ResidualTangent, ContactSlots]]:
        """Return a function that computes the residual tangent of the legs in `leg_slice`.

        Its argument is a tangent of the contact configuration. Its result also contains the contact
        slots of these legs.
        """
        static_leaves = eqx.filter(self.configuration, eqx.is_inexact_array, inverse=True)
        contact_configuration = _restrict_configuration_to_legs(self.configuration, leg_slice)
        leg_directions = LegDirections(
            *(leg_row[leg_slice] for leg_row in self.inertia.leg_directions)
        )
        hub_motion = self.inertia._replace(
            leg_directions=leg_directions, is_released=self.inertia.is_released[leg_slice]
        )
        slot_solution = self.force_solution._replace(
            length_motion=self.force_solution.length_motion[leg_slice]
        )

        @jax.jit  # The residual is traced once.
        def compute_residual(tangent: ContactConfiguration) -> ResidualTangent:
            residual_arguments = (
                contact_configuration,
                _restrict_configuration_to_legs(eqx.combine(tangent, static_leaves), leg_slice),
                hub_motion,
                slot_solution,
            )
            return compute_residual_tangent(
                *residual_arguments, *compute_motion_equation_tangents(*residual_arguments)
            )

        return lambda tangent: (compute_residual(tangent), contact_configuration.contact_slots)

    def compute_foot_speed_tangent(self, tangent: WheelMotion) -> SlotPair:
        """Return the tangents of the tangential speeds of the feet in contact, m/s."""
        s, contact_slots = self.dynamics.s, self.dynamics.contact_slots
        compute_speeds = lambda motion: (
            compute_slot_foot_velocity(
                motion, contact_slots, make_wheel_posture(s, motion, contact_slots)
            ).along_slope
        )
        return jax.jvp(compute_speeds, (self.motion,), (tangent,))[1]

    def compute_motion_residual(
        self,
        motion: WheelMotion,
        leg_residual: Callable[[ContactConfiguration], tuple[ResidualTangent, ContactSlots]],
    ) -> tuple:
        """Return residual tangent, contact slots and foot-speed tangents of a group of legs.

        - `motion`: tangent of the motion of a group of legs;
        - `leg_residual`: result of `make_leg_residual_function` for these legs.
        """
        return *leg_residual(
            self.zero_tangent._replace(motion=motion)
        ), self.compute_foot_speed_tangent(motion)

    def compute_unit_length_responses(
        self, leg_slice: slice
    ) -> tuple[_UnitLegLengthResponse, _UnitLegLengthResponse]:
        """Return the responses to unit lengths and unit length rates of the legs in `leg_slice`."""
        leg_residual = self.make_leg_residual_function(leg_slice)

        def respond_to_coordinate(coordinate_name: str) -> _UnitLegLengthResponse:
            leg_row = getattr(self.zero_tangent.motion, coordinate_name)
            unit_tangent = jnp.stack(
                [x + float(i in range(len(leg_row))[leg_slice]) for i, x in enumerate(leg_row)]
            )
            residual, contact_slots, foot_speed = self.compute_motion_residual(
                self.zero_tangent.motion._replace(**{coordinate_name: unit_tangent}), leg_residual
            )
            return _UnitLegLengthResponse(
                residual.leg_length_residual,
                residual.hub_residual_by_leg,
                (
                    contact_slots.gather_slot_pair(residual.leg_length_residual),
                    residual.foot_transverse_motion,
                    residual.foot_radial_motion,
                    foot_speed,
                ),
            )

        return respond_to_coordinate("L"), respond_to_coordinate("dL")

    def linearize_solution(self) -> Callable[[FreeMotion], tuple[HubVector, SlotPair, SlotPair]]:
        """Return the linear map from tangents of the free motion to tangents of the solution.

        The map returns the tangents of hub acceleration, leg pull forces and tangential forces.
        """
        s, friction = self.configuration.s, self.configuration.friction
        slot_modes, is_held = self.configuration.slot_modes, self.configuration.is_stopper_holding

        def solve_forces(free_motion: FreeMotion) -> tuple[HubVector, SlotPair, SlotPair]:
            slot_solution = solve_combination(
                s, self.inertia, free_motion, slot_modes, is_held, friction
            )
            return (
                slot_solution.hub_motion,
                slot_solution.leg_pull_forces,
                slot_solution.tangential_forces,
            )

        return jax.linearize(solve_forces, self.free_motion)[1]


def _restrict_configuration_to_legs(
    contact_configuration: ContactConfiguration, leg_slice: slice
) -> ContactConfiguration:
    """Return the contact configuration restricted to the legs in `leg_slice`."""
    motion, contact_slots = contact_configuration.motion, contact_configuration.contact_slots
    return contact_configuration._replace(
        motion=motion._replace(L=motion.L[leg_slice], dL=motion.dL[leg_slice]),
        contact_slots=ContactSlots(
            contact_slots.first_slot_mask[leg_slice], contact_slots.second_slot_mask[leg_slice]
        ),
        is_airborne_locked=contact_configuration.is_airborne_locked[leg_slice],
    )


class TangentBasis(NamedTuple):
    """Responses to unit coordinates at one motion, which are common to all tangents.

    - `compute_all_leg_residual`: function that computes the residual tangent of all legs for a
      tangent of the configuration;
    - `length_responses`: responses to lengths and length rates, for the first `N_MOVING_LEGS` legs
      and for the other legs;
    - `slot_responses`: sums of the slot responses of both groups of legs.
    """

    linearization: _DynamicsLinearization
    forces: ContactForces
    map_free_motion_tangent: Callable[[FreeMotion], tuple[HubVector, SlotPair, SlotPair]]
    compute_all_leg_residual: Callable[[ContactConfiguration], tuple[ResidualTangent, ContactSlots]]
    angle_responses: tuple[
        UnitInputResponse, UnitInputResponse
    ]  # response to the angle, and to its rate
    length_responses: tuple[
        tuple[_UnitLegLengthResponse, _UnitLegLengthResponse],
        tuple[_UnitLegLengthResponse, _UnitLegLengthResponse],
    ]
    slot_responses: tuple[tuple[SlotPair, SlotPair, SlotPair, SlotPair], ...]
    damping_response: LegArray  # damping power for a unit rate of each leg, W
    slip_tangent: Callable[[SlotPair, SlotPair], Array]  # tangents of sliding loss and slip

    @classmethod
    def from_motion(
        cls, mode_dynamics: ModeDynamics, motion: WheelMotion, has_later_moving_legs: Array
    ) -> "TangentBasis":
        """Return the tangent basis at a motion.

        - `has_later_moving_legs`: whether legs after the first `N_MOVING_LEGS` move.
        """
        linearization = _DynamicsLinearization.from_motion(mode_dynamics, motion)
        contact_forces = compute_forces(mode_dynamics, motion)
        compute_all_leg_residual = linearization.make_leg_residual_function(slice(None))
        first_responses = linearization.compute_unit_length_responses(_LEG_GROUP_SLICES[0])
        n = len(motion.L)
        make_zero_coordinates = lambda foot_velocity_x: jnp.zeros(
            (n - N_MOVING_LEGS, *foot_velocity_x.shape[1:])
            if foot_velocity_x.ndim > 1
            else foot_velocity_x.shape,
            foot_velocity_x.dtype,
        )
        other_responses = run_if_any(
            has_later_moving_legs,
            lambda _: linearization.compute_unit_length_responses(_LEG_GROUP_SLICES[1]),
            jax.tree.map(make_zero_coordinates, first_responses),
        )

        def compute_slip_rates(x: SlotPair, tangential: SlotPair) -> Array:
            slot_solution = contact_forces.force_solution._replace(tangential_forces=tangential)
            rates = compute_accumulator_rates(
                mode_dynamics,
                motion,
                contact_forces._replace(
                    force_solution=slot_solution, foot_velocity=SlotFootVelocity(x, x)
                ),
            )
            return jnp.stack([rates.friction_loss, rates.slip_length])

        compute_damping = lambda dL: (
            compute_accumulator_rates(
                mode_dynamics, motion._replace(dL=dL), contact_forces
            ).damping_loss
        )
        (damping_response,) = jax.vjp(compute_damping, motion.dL)[1](jnp.ones_like(motion.theta))
        _, slip_tangent = jax.linearize(
            compute_slip_rates,
            contact_forces.foot_velocity.along_slope,
            contact_forces.force_solution.tangential_forces,
        )
        unit_tangent = jnp.ones_like(motion.theta)

        def respond_to_angle(coordinate_name: str) -> UnitInputResponse:
            residual, contact_slots, foot_speed = linearization.compute_motion_residual(
                linearization.zero_tangent.motion._replace(**{coordinate_name: unit_tangent}),
                compute_all_leg_residual,
            )
            return UnitInputResponse(
                residual.leg_length_residual,
                sum_residual_tangent(contact_slots, residual),
                foot_speed,
                jnp.zeros_like(unit_tangent),
            )

        angle_responses = respond_to_angle("theta"), respond_to_angle("dtheta")
        slot_responses = [
            jax.tree.map(
                operator.add,
                *(
                    foot_velocity_x.slot_responses
                    for foot_velocity_x in angle_responses_by_coordinate
                ),
            )
            for angle_responses_by_coordinate in zip(first_responses, other_responses, strict=True)
        ]
        return cls(
            linearization,
            contact_forces,
            linearization.linearize_solution(),
            compute_all_leg_residual,
            angle_responses,
            (first_responses, other_responses),
            tuple(slot_responses),
            damping_response,
            slip_tangent,
        )

    def compute_column_response(
        self, dynamics_fn: DynamicsFn, input_columns: Array, input_tangent: Array
    ) -> UnitInputResponse:
        """Return the response of the contact equations to a tangent of the inputs.

        - `input_columns`, `input_tangent`: parameters, friction and ground, and their tangent,
          (inputs, batch).
        """
        linearization, zero_response = self.linearization, self.make_zero_response()

        def configure_columns(input_columns: Array) -> tuple[ContactConfiguration, Array]:
            mode_dynamics = dynamics_fn(input_columns)
            rates = compute_accumulator_rates(mode_dynamics, linearization.motion, self.forces)
            return eqx.filter(
                mode_dynamics.configure_contacts(linearization.motion), eqx.is_inexact_array
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
                total_response: UnitInputResponse, group_tangent: Array = group_tangent
            ) -> UnitInputResponse:
                contact_configuration, damping_tangent = column_pushforward(group_tangent)
                residual, contact_slots = self.compute_all_leg_residual(contact_configuration)
                unit_response = UnitInputResponse(
                    residual.leg_length_residual,
                    sum_residual_tangent(contact_slots, residual),
                    zero_response.foot_speed_tangent,
                    damping_tangent,
                )
                return jax.tree.map(operator.add, total_response, unit_response)

            has_tangent = jnp.any(jnp.stack([input_tangent[i] != 0.0 for i in input_indices]))
            total_response = run_if_any(has_tangent, add_response, total_response)
        return total_response

    def make_zero_response(self) -> UnitInputResponse:
        """Return the response to a zero tangent of parameters, friction and ground."""
        return jax.tree.map(jnp.zeros_like, self.angle_responses[0])

    def propagate_tangent(
        self,
        coordinate_tangent_fn: CoordinateTangentFn,
        column_response: UnitInputResponse,
        has_later_moving_legs: Array,
    ) -> Array:
        """Return the tangents of accelerations and accumulator rates for one direction.

        Accumulator rates are included if accumulators are requested.

        - `coordinate_tangent_fn`: function that returns the tangents of a slice of coordinates and
          of their rates;
        - `column_response`: response to the tangent of parameters, friction and ground.
        """
        q, v = coordinate_tangent_fn(slice(0, 3 + N_MOVING_LEGS))
        theta, dtheta, first_length_tangents = q[2], v[2], (q[3:], v[3:])
        later_length_tangents = lambda: coordinate_tangent_fn(slice(3 + N_MOVING_LEGS, None))
        add_tangent_trees = lambda first_tree, second_tree: jax.tree.map(
            operator.add, first_tree, second_tree
        )
        length_response = self._respond_to_leg_lengths(0, *first_length_tangents)
        length_response = run_if_any(
            has_later_moving_legs,
            lambda _: add_tangent_trees(
                length_response, self._respond_to_leg_lengths(1, *later_length_tangents())
            ),
            length_response,
        )
        combine_responses = lambda a, b, c: a * theta + b * dtheta + c
        combined_responses = [
            jax.tree.map(combine_responses, *slot_rows)
            for slot_rows in zip(*self.angle_responses, column_response, strict=True)
        ][1:]
        summed_residual, foot_speed, damping_tangent = combined_responses
        slot_rows = (
            summed_residual.slot_length_residual,
            summed_residual.foot_transverse_motion,
            summed_residual.foot_radial_motion,
            foot_speed,
        )
        slot_lengths, foot_transverse, foot_radial, foot_speed = (
            tuple(
                a[i]
                + b[i] * length_response.slot_length_residual[i]
                + c[i] * length_response.slot_length_rate_residual[i]
                for i in range(2)
            )
            for a, b, c in zip(slot_rows, *self.slot_responses, strict=True)
        )
        hub_motion_tangent = tuple(
            map(operator.add, summed_residual.hub_residual, length_response.hub_residual)
        )
        summed_residual = SummedResidualTangent(
            hub_motion_tangent,
            slot_lengths,
            foot_transverse,
            foot_radial,
            summed_residual.friction_force,
        )
        free_motion_tangents = compute_free_motion_tangent(
            self.linearization.inertia, jnp.zeros_like(self.linearization.motion.L), summed_residual
        )
        hub_motion_tangent, leg_pull_tangent, tangential_force_tangent = (
            self.map_free_motion_tangent(free_motion_tangents)
        )
        propagate_leg_group = lambda group_index, *length_tangents: (
            self._propagate_leg_accelerations(
                group_index,
                hub_motion_tangent,
                leg_pull_tangent,
                combine_responses,
                column_response.leg_length_residual,
                *length_tangents,
            )
        )
        zero_leg_accelerations = jnp.zeros(
            (len(self.damping_response) - N_MOVING_LEGS, *theta.shape), theta.dtype
        )
        row_tangents = [
            jnp.stack(hub_motion_tangent),
            propagate_leg_group(0, *first_length_tangents),
            run_if_any(
                has_later_moving_legs,
                lambda _: propagate_leg_group(1, *later_length_tangents()),
                zero_leg_accelerations,
            ),
        ]
        if self.linearization.dynamics.has_accumulators:
            foot_speed = foot_speed[0] + v[0], foot_speed[1] + v[0]
            tangential_force_tangent = tuple(
                map(operator.add, tangential_force_tangent, summed_residual.friction_force)
            )
            row_tangents += [
                (damping_tangent + length_response.damping_loss_rate)[None],
                self.slip_tangent(foot_speed, tangential_force_tangent),
            ]
        return jnp.concatenate(row_tangents)

    def _respond_to_leg_lengths(self, group_index: int, L: Any, dL: Any) -> _LegLengthResponse:
        """Return the response to tangents of lengths and length rates in a group of legs."""
        length_response, rate_response = self.length_responses[group_index]
        leg_slice = _LEG_GROUP_SLICES[group_index]
        sum_response = lambda a, b: sum_over_legs(a * L + b * dL)
        x, z, rotation = map(sum_response, length_response.hub_residual, rate_response.hub_residual)
        contact_slots = self.linearization.dynamics.contact_slots
        group_slots = ContactSlots(
            contact_slots.first_slot_mask[leg_slice], contact_slots.second_slot_mask[leg_slice]
        )
        return _LegLengthResponse(
            (x, z, rotation),
            group_slots.gather_slot_pair(L),
            group_slots.gather_slot_pair(dL),
            sum_over_legs(self.damping_response[leg_slice] * dL),
        )

    def _propagate_leg_accelerations(
        self,
        group_index: int,
        hub_motion_tangent: HubVector,
        leg_pull_tangent: SlotPair,
        combine_responses: Callable,
        column_leg_response: Any,
        L: Any,
        dL: Any,
    ) -> Array:
        """Return the tangents of the length accelerations in one group of legs, m/s^2."""
        (length_response, rate_response), leg_slice, linearization = (
            self.length_responses[group_index],
            _LEG_GROUP_SLICES[group_index],
            self.linearization,
        )
        angle_response = combine_responses(
            *(
                unit_response.leg_length_residual[leg_slice]
                for unit_response in self.angle_responses
            ),
            column_leg_response[leg_slice],
        )
        contact_configuration = _restrict_configuration_to_legs(
            linearization.configuration, leg_slice
        )
        sin, cos = (leg_row[leg_slice] for leg_row in linearization.inertia.leg_directions)
        outward_motion = (
            angle_response
            + length_response.leg_length_residual * L
            + rate_response.leg_length_residual * dL
            + sin * hub_motion_tangent[0]
            + cos * hub_motion_tangent[1]
        )
        outward_motion = (
            outward_motion
            - contact_configuration.contact_slots.scatter_to_legs(leg_pull_tangent)
            / contact_configuration.s.m
        )
        return jnp.where(
            linearization.configuration.has_fixed_length[leg_slice], 0.0, outward_motion
        )
