"""Dynamics of the wheel between two events, and the guards that detect the next event.

A *contact state* consists of the contact modes of all feet, the stopper flags of all legs and, if
the force of a leg has kinks, the side of each kink. The contact state is constant between two
events.
"""

import itertools
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from vrw_jax.base.elementwise import Elementwise, Scalar
from vrw_jax.flow.event_location import has_guard_crossed
from vrw_jax.models.contact_jvp import (
    ContactConfiguration,
    WheelForceSolution,
    compute_slip_signs,
    find_slot_contacts,
    replace_infinite_friction,
    solve_contact_forces,
)
from vrw_jax.models.contact_mechanics import (
    ContactSlots,
    Friction,
    LegArray,
    PlaneVelocities,
    SlotArray,
    WheelMotion,
    compute_contact_foot_velocities,
    compute_foot_heights,
    compute_free_leg_acceleration,
    compute_leg_directions,
    make_opaque_one,
    prevent_fusion,
    stop_gradients,
    sum_over_legs,
)
from vrw_jax.wheel.laws import (
    OneSidedLegForce,
    compute_motor_work,
    count_kinks,
    evaluate_damping_power,
    evaluate_hub_torque,
    evaluate_leg_kinks,
    number_legs,
)
from vrw_jax.wheel.params import Symbols, compute_wheel_units
from vrw_jax.wheel.transitions import (
    ContactMode,
    GroundAhead,
    are_rates_negligible,
)

PackedState = Float[Array, "dim ..."]
"""Motion and loss accumulators as one vector of 10 + 2 n entries.

The entries are the hub coordinates (x, z, theta), their rates, the leg lengths, their rates, and
the `EnergyLossAccumulators`.
"""


class EnergyLossAccumulators(NamedTuple):
    """Time, energy losses and slip since the last event, integrated together with the motion."""

    time_since_event: Scalar  # time since the last event, s
    damping_loss: Scalar  # energy lost in the dampers, J
    friction_loss: Scalar  # energy lost by sliding, J
    slip_length: Scalar  # path length of all sliding feet, m


N_LOSSES = len(EnergyLossAccumulators._fields) - 1
"""Number of accumulators without the time."""


def pack_state(motion: WheelMotion, accumulators: EnergyLossAccumulators) -> PackedState:
    """Return the motion and the loss accumulators as one vector of 10 + 2 n entries."""
    return jnp.concatenate([jnp.stack(motion[:6]), motion.L, motion.dL, jnp.stack(accumulators)])


def unpack_state(packed_state: PackedState) -> tuple[WheelMotion, EnergyLossAccumulators]:
    """Return the motion and the loss accumulators in a packed state.

    The function is the inverse of `pack_state`.
    """
    n_legs = (packed_state.shape[0] - 10) // 2
    x, z, theta, vx, vz, dtheta = packed_state[:6]
    L, dL = packed_state[6 : 6 + n_legs], packed_state[6 + n_legs : 6 + 2 * n_legs]
    motion = WheelMotion(x, z, theta, vx, vz, dtheta, L, dL)
    return motion, EnergyLossAccumulators(*packed_state[6 + 2 * n_legs :])


class ContactState(NamedTuple):
    """Contact modes of the feet, stopper flags of the legs, and their changes at the last event."""

    contact_modes: Int[Array, " n_legs"]  # `ContactMode` of every foot
    is_leg_locked: Bool[Array, " n_legs"]  # whether a leg is on its stopper
    has_just_lifted: Bool[Array, " n_legs"]  # whether a foot has left the ground at the last event
    has_just_unlocked: Bool[Array, " n_legs"]  # whether a leg has left its stopper then
    has_just_slid: Bool[Array, " n_legs"]  # whether a foot at rest has begun to slide then
    # sign of each force rate (see `N_FORCE_RATES`); None if force peaks are not measured
    force_rate_signs: Array | None = None
    # whether the function of each kink is positive, for all legs
    is_kink_positive: tuple[Bool[Array, " n_legs"], ...] = ()

    @classmethod
    def without_recent_changes(
        cls, contact_modes: Array, is_leg_locked: Array, is_kink_positive: tuple[Array, ...]
    ) -> "ContactState":
        """Return the contact state without changes at the last event, and without signs."""
        no_leg_flags = is_leg_locked & False
        return cls(
            contact_modes,
            is_leg_locked,
            no_leg_flags,
            no_leg_flags,
            no_leg_flags,
            is_kink_positive=is_kink_positive,
        )


def find_kink_sides(s: Symbols, L: LegArray, dL: LegArray) -> tuple[Array, ...]:
    """Return `ContactState.is_kink_positive` for the lengths of the legs and their rates.

    A function that is zero has the sign that it gets if the leg moves inwards, because a leg can
    leave its stopper only in this direction.
    """
    if count_kinks(s.leg_force) == 0:
        return ()
    evaluate = lambda L, dL: evaluate_leg_kinks(s, L, dL, number_legs(L))
    inwards = -jnp.ones_like(L)
    values, changes = jax.jvp(evaluate, stop_gradients((L, dL)), (inwards, inwards))
    return tuple(~has_guard_crossed(*kink) for kink in zip(values, changes, strict=True))


def select_kink_sides(s: Symbols, is_kink_positive: tuple[Array, ...]) -> Symbols:
    """Return symbols whose legs have forces that are smooth, as on the given sides of all kinks."""
    if not is_kink_positive:
        return s
    sides = tuple(jnp.where(x, 1.0, -1.0) for x in is_kink_positive)
    return s._replace(leg_force=OneSidedLegForce(s.leg_force, sides))


class ContactModeDynamics(NamedTuple):
    """Parameters and contact state that determine the dynamics of the wheel between two events.

    The first fields are those of `ContactConfiguration` before the motion.
    """

    s: Symbols
    friction: SlotArray  # friction coefficient of the feet in the contact slots
    contact_slots: ContactSlots
    slot_modes: Int[Array, "2"]  # `ContactMode` of the foot in each contact slot
    is_stopper_holding: Bool[Array, "2"]  # whether the leg in each contact slot is on its stopper
    is_airborne_leg_locked: Bool[Array, " n_legs"]  # whether a leg is in the air on its stopper
    has_one_sided_stoppers: bool  # whether legs in the air may leave their stoppers
    contact_state: ContactState
    has_accumulators: bool  # whether a batch integrates the accumulators
    ground_ahead: GroundAhead | None = None  # None on flat ground
    known_solution: WheelForceSolution | None = None  # see `ContactConfiguration`

    @property
    def measures_force_peaks(self) -> bool:
        """Return whether guards detect the extrema of normal forces."""
        return self.contact_state.force_rate_signs is not None

    @property
    def guard_layout(self) -> "GuardLayout":
        """Return the positions of the guards in the result of `evaluate_guards`."""
        return make_guard_layout(
            self.s.n,
            self.has_one_sided_stoppers,
            self.measures_force_peaks,
            len(self.contact_state.is_kink_positive),
        )

    def configure_contacts(self, motion: WheelMotion) -> ContactConfiguration:
        """Return the contact configuration for this motion, from which the forces are computed."""
        return ContactConfiguration(*self[:6], motion, self.known_solution)


def make_contact_mode_dynamics(
    s: Symbols,
    friction: Friction,
    has_one_sided_stoppers: bool,
    contact_state: ContactState,
    has_accumulators: bool = False,
    ground_ahead: GroundAhead | None = None,
) -> ContactModeDynamics:
    """Return the dynamics of the wheel in the contact state `contact_state`.

    - `friction`: friction coefficient for all feet, or a pair for the foot that landed last and for
      all other feet;
    - `has_one_sided_stoppers`: whether legs in the air may leave their stoppers;
    - `has_accumulators`: whether losses and slip are integrated together with the motion;
    - `ground_ahead`: uneven ground on which the next foot lands.
    """
    return ContactModeDynamics(
        select_kink_sides(s, contact_state.is_kink_positive),
        *find_slot_contacts(friction, *contact_state[:2]),
        has_one_sided_stoppers,
        contact_state,
        has_accumulators,
        ground_ahead,
    )


class ContactForces(NamedTuple):
    """Contact forces and accelerations, with the foot velocities."""

    force_solution: WheelForceSolution
    slot_foot_velocities: PlaneVelocities
    # stopper force on each leg, N; 0 for a leg with a loaded foot or not on its stopper
    airborne_stopper_forces: LegArray


def compute_forces(
    contact_mode_dynamics: ContactModeDynamics, motion: WheelMotion
) -> ContactForces:
    """Return the forces of ground and stoppers (N), and the resulting accelerations."""
    s, opaque_one = contact_mode_dynamics.s, make_opaque_one(motion.theta)
    sin, cos = leg_directions = compute_leg_directions(s, motion.theta)
    leg_acceleration = prevent_fusion(
        compute_free_leg_acceleration(s, motion, leg_directions), opaque_one
    )
    slot_foot_velocities = prevent_fusion(
        compute_contact_foot_velocities(
            motion, leg_directions, contact_mode_dynamics.contact_slots
        ),
        opaque_one,
    )
    force_solution = solve_contact_forces(contact_mode_dynamics.configure_contacts(motion))
    hub_acceleration_x, hub_acceleration_z, _ = force_solution.hub_motion
    # This is the acceleration of each leg's length without forces of slots and stoppers, m/s^2.
    free_leg_acceleration = leg_acceleration + sin * hub_acceleration_x + cos * hub_acceleration_z
    airborne_stopper_forces = jnp.where(
        contact_mode_dynamics.is_airborne_leg_locked, s.m * free_leg_acceleration, 0.0
    )
    return ContactForces(force_solution, slot_foot_velocities, airborne_stopper_forces)


def compute_accumulator_rates(
    contact_mode_dynamics: ContactModeDynamics, motion: WheelMotion, contact_forces: ContactForces
) -> EnergyLossAccumulators:
    """Return the time derivatives of the loss accumulators.

    They are 1 for the time, the powers dissipated in dampers and by sliding in W, and the sum of
    the slip speeds in m/s.
    """
    slip_signs = compute_slip_signs(contact_mode_dynamics.slot_modes)
    slip_speeds = slip_signs * contact_forces.slot_foot_velocities.along_slope
    friction_forces = -contact_forces.force_solution.tangential_forces * slip_signs
    s, L, dL = contact_mode_dynamics.s, motion.L, motion.dL
    if s.leg_force is None:
        damping_power = s.c * sum_over_legs(dL * dL)
    else:
        damping_power = sum_over_legs(evaluate_damping_power(s, L, dL, number_legs(L)))
    if s.hub_torque is not None:
        motor_power = evaluate_hub_torque(s, motion.dtheta) * motion.dtheta
        damping_power = damping_power + compute_motor_work(s, motion.dtheta) - motor_power
    return EnergyLossAccumulators(
        time_since_event=jnp.ones_like(motion.x),
        damping_loss=damping_power,
        friction_loss=jnp.sum(friction_forces * slip_speeds, axis=0),
        slip_length=jnp.sum(slip_speeds, axis=0),
    )


def evaluate_vector_field(
    contact_mode_dynamics: ContactModeDynamics, packed_state: PackedState
) -> PackedState:
    """Return the time derivative of a packed state in the contact state of
    `contact_mode_dynamics`.
    """
    motion, _ = unpack_state(packed_state)
    contact_forces = compute_forces(contact_mode_dynamics, motion)
    coordinate_rates = WheelMotion(
        motion.vx,
        motion.vz,
        motion.dtheta,
        *contact_forces.force_solution.hub_motion,
        jnp.where(contact_mode_dynamics.contact_state.is_leg_locked, 0.0, motion.dL),
        contact_forces.force_solution.length_motion,
    )
    return prevent_fusion(
        pack_state(
            coordinate_rates,
            compute_accumulator_rates(contact_mode_dynamics, motion, contact_forces),
        ),
        make_opaque_one(motion.theta),
    )


class GuardLayout(NamedTuple):
    """Indices of the guards of each kind in the result of `evaluate_guards`."""

    landing: range  # height of a foot in the air, one per leg: zero at a landing
    stopper: range  # distance to the stopper, one per leg
    liftoff: range  # normal force, one per contact slot
    slip_up: range  # friction margin before the foot slides uphill, one per contact slot
    slip_down: range  # friction margin before the foot slides downhill, one per contact slot
    slip_end: range  # speed of a sliding foot, one per contact slot
    stopper_release: range  # stopper force of a loaded leg, one per contact slot
    rolling_rate: range  # rate of rolling, dtheta
    collapse: range  # length of the shortest leg minus a
    airborne_release: range  # stopper force in the air, one per leg, if one-sided
    kinks: range  # function of each kink on its present side, one per leg
    force_rates: range  # absolute value of each force rate, if requested


def make_guard_layout(
    n_legs: int,
    has_one_sided_stoppers: bool,
    measures_force_peaks: bool = False,
    n_kinks: int = 0,
) -> GuardLayout:
    """Return the guard layout for a wheel with `n_legs` legs.

    - `has_one_sided_stoppers`: whether legs in the air may leave their stoppers;
    - `measures_force_peaks`: whether guards detect the extrema of normal forces;
    - `n_kinks`: number of kinks that the law of a leg declares.
    """
    n_guards = (
        *[n_legs] * 2,
        *[2] * 5,
        *[1] * 2,
        n_legs * has_one_sided_stoppers,
        n_kinks * n_legs,
        N_FORCE_RATES * measures_force_peaks,
    )
    ends = itertools.accumulate(n_guards)
    return GuardLayout(*(range(end - n, end) for n, end in zip(n_guards, ends, strict=True)))


N_FORCE_RATES = 3
"""Number of rates of normal forces whose zeros are extrema.

They are those of the force on the foot of Leg 1, N/s, and of the sum of the forces on all feet,
N/s, and the second rate of the first force, N/s^2, which is zero at an extremum of its rate.
"""


NormalForces = tuple[Elementwise, Elementwise]
"""Normal forces of the ground on the foot of Leg 1 and on all feet together, or their rates."""


def compute_normal_forces(
    contact_mode_dynamics: ContactModeDynamics, motion: WheelMotion
) -> NormalForces:
    """Return the normal forces of the ground on the feet, N."""
    return split_normal_forces(
        contact_mode_dynamics,
        solve_contact_forces(contact_mode_dynamics.configure_contacts(motion)).normal_forces,
    )


def split_normal_forces(
    contact_mode_dynamics: ContactModeDynamics, slot_normal_forces: SlotArray
) -> NormalForces:
    """Return the normal forces on the feet, computed from those in the contact slots, N."""
    first_force, second_force = slot_normal_forces
    # A loaded fore foot is in the first contact slot.
    is_fore_loaded = contact_mode_dynamics.contact_state.contact_modes[0] != ContactMode.OFF
    return jnp.where(is_fore_loaded, first_force, 0.0), first_force + second_force


def compute_normal_force_rates(
    contact_mode_dynamics: ContactModeDynamics, motion: WheelMotion
) -> tuple[NormalForces, NormalForces]:
    """Return the normal forces on the feet, N, and their rates between two events, N/s."""
    return _differentiate_in_time(compute_normal_forces, contact_mode_dynamics, motion)


def compute_force_rates(contact_mode_dynamics: ContactModeDynamics, motion: WheelMotion) -> Array:
    """Return the rates that `N_FORCE_RATES` counts, in the motion between two events, (3, ...)."""
    (_, force_rates), (_, (second_fore_rate, _)) = _differentiate_in_time(
        compute_normal_force_rates, contact_mode_dynamics, motion
    )
    return jnp.stack([*force_rates, second_fore_rate])


def _differentiate_in_time(
    function: Callable[[ContactModeDynamics, WheelMotion], Any],
    contact_mode_dynamics: ContactModeDynamics,
    motion: WheelMotion,
) -> tuple[Any, Any]:
    """Return a function of the motion, and its time derivative in the motion between two events."""
    force_solution = solve_contact_forces(contact_mode_dynamics.configure_contacts(motion))
    coordinate_rates = motion.vx, motion.vz, motion.dtheta
    motion_rate = WheelMotion(
        *coordinate_rates, *force_solution.hub_motion, motion.dL, force_solution.length_motion
    )
    return jax.jvp(partial(function, contact_mode_dynamics), (motion,), (motion_rate,))


class ContactQuantities(NamedTuple):
    """Accelerations, loss rates and contact forces; the first axis of each array contains rows."""

    accelerations: Array  # of hub x, hub z, theta and the leg lengths
    loss_rates: Array | None  # without the rate of the time; None unless a batch integrates them
    painleve_determinant: Array  # one row
    normal_forces: SlotArray
    tangential_forces: SlotArray
    stopper_forces: SlotArray
    slip_speeds: SlotArray  # tangential speeds of the feet in the contact slots, m/s
    # stopper force of legs in the air, if stoppers are one-sided
    airborne_stopper_forces: LegArray | None
    force_rates: Array | None  # see `N_FORCE_RATES`, if peaks are measured

    def pack_rows(self) -> Array:
        """Return all quantities as one array (rows, ...)."""
        return jnp.concatenate(jax.tree.leaves(self))

    @classmethod
    def unpack_rows(
        cls, contact_mode_dynamics: ContactModeDynamics, rows: Array
    ) -> "ContactQuantities":
        """Return the quantities in an array of `pack_rows`."""
        n_legs = contact_mode_dynamics.s.n
        row_counts = (
            3 + n_legs,
            N_LOSSES * contact_mode_dynamics.has_accumulators,
            1,
            *[2] * 4,
            n_legs * contact_mode_dynamics.has_one_sided_stoppers,
            N_FORCE_RATES * contact_mode_dynamics.measures_force_peaks,
        )
        ends = itertools.accumulate(row_counts)
        blocks: Any = (
            rows[end - count : end] if count else None
            for count, end in zip(row_counts, ends, strict=True)
        )
        return cls(*blocks)

    @property
    def force_solution(self) -> WheelForceSolution:
        """Return the forces, and the motion that results from them."""
        return WheelForceSolution(
            self.tangential_forces,
            self.normal_forces,
            self.stopper_forces,
            tuple(self.accelerations[:3]),  # type: ignore[arg-type]
            self.painleve_determinant[0],
            self.accelerations[3:],
        )


def compute_contact_quantities(
    contact_mode_dynamics: ContactModeDynamics, motion: WheelMotion
) -> ContactQuantities:
    """Return the accelerations, and the quantities that losses and guards depend on."""
    contact_forces = compute_forces(contact_mode_dynamics, motion)
    force_solution = contact_forces.force_solution
    loss_rates = airborne_stopper_forces = force_rates = None
    if contact_mode_dynamics.has_accumulators:
        _, *rates = compute_accumulator_rates(contact_mode_dynamics, motion, contact_forces)
        loss_rates = jnp.stack(prevent_fusion(rates, make_opaque_one(motion.theta)))
    if contact_mode_dynamics.has_one_sided_stoppers:
        airborne_stopper_forces = contact_forces.airborne_stopper_forces
    if contact_mode_dynamics.measures_force_peaks:
        force_rates = compute_force_rates(contact_mode_dynamics, motion)
    return ContactQuantities(
        jnp.concatenate([jnp.stack(force_solution.hub_motion), force_solution.length_motion]),
        loss_rates,
        force_solution.painleve_determinant[None],
        force_solution.normal_forces,
        force_solution.tangential_forces,
        force_solution.stopper_forces,
        contact_forces.slot_foot_velocities.along_slope,
        airborne_stopper_forces,
        force_rates,
    )


def evaluate_guards(
    contact_mode_dynamics: ContactModeDynamics,
    motion: WheelMotion,
    contact_quantities: ContactQuantities,
) -> Array:
    """Return the values of all guards in the order of `GuardLayout`, (guards, ...).

    A guard is positive inside the contact state and zero at its end. A guard that is not evaluated
    has the value 1.
    """
    s, contact_state = contact_mode_dynamics.s, contact_mode_dynamics.contact_state
    friction = contact_mode_dynamics.friction
    friction_coefficients = replace_infinite_friction(friction)
    normal_forces = contact_quantities.normal_forces
    tangential_forces = contact_quantities.tangential_forces
    # In the limit of large friction, a resting foot begins to slide when its normal force vanishes
    # (see `contact_impacts.resolve_event`). A sliding foot lifts off when its friction vanishes.
    uses_friction_limit = friction == jnp.inf
    slip_signs = compute_slip_signs(contact_mode_dynamics.slot_modes)
    supporting_force = jnp.where(
        uses_friction_limit & (slip_signs != 0.0), -slip_signs * tangential_forces, normal_forces
    )
    has_friction_cone = (contact_mode_dynamics.slot_modes == ContactMode.STICK) & jnp.isfinite(
        friction
    )
    replace_if_not_evaluated = lambda is_evaluated, guard_value: jnp.where(
        is_evaluated, guard_value, 1.0
    )
    guards = [
        replace_if_not_evaluated(
            contact_state.contact_modes == ContactMode.OFF,
            compute_foot_heights(
                motion, compute_leg_directions(s, motion.theta), contact_mode_dynamics.ground_ahead
            ),
        ),
        replace_if_not_evaluated(~contact_state.is_leg_locked, s.L0 - motion.L),
        replace_if_not_evaluated(
            contact_mode_dynamics.slot_modes != ContactMode.OFF, supporting_force
        ),
        replace_if_not_evaluated(
            has_friction_cone, friction_coefficients * normal_forces - tangential_forces
        ),
        replace_if_not_evaluated(
            has_friction_cone, friction_coefficients * normal_forces + tangential_forces
        ),
        replace_if_not_evaluated(slip_signs != 0.0, slip_signs * contact_quantities.slip_speeds),
        replace_if_not_evaluated(
            contact_mode_dynamics.is_stopper_holding, contact_quantities.stopper_forces
        ),
        motion.dtheta[None],
        (jnp.min(motion.L, axis=0) - s.a)[None],
    ]
    if contact_quantities.airborne_stopper_forces is not None:
        guards.append(
            replace_if_not_evaluated(
                contact_mode_dynamics.is_airborne_leg_locked,
                contact_quantities.airborne_stopper_forces,
            )
        )
    if contact_state.is_kink_positive:
        kinks = evaluate_leg_kinks(s, motion.L, motion.dL, number_legs(motion.L))
        guards += [
            replace_if_not_evaluated(~contact_state.is_leg_locked, side * value)
            for side, value in zip(s.leg_force.sides, kinks, strict=True)
        ]
    if contact_quantities.force_rates is not None and contact_state.force_rate_signs is not None:
        # If only the fore foot is loaded, the extrema of its force are those of the total force.
        is_fore_loaded = contact_state.contact_modes[0] != ContactMode.OFF
        is_first_loaded, is_second_loaded = contact_mode_dynamics.slot_modes != ContactMode.OFF
        is_total_different = is_second_loaded | (is_first_loaded & ~is_fore_loaded)
        guards.append(
            replace_if_not_evaluated(
                jnp.stack([is_fore_loaded, is_total_different, is_fore_loaded]),
                contact_state.force_rate_signs * contact_quantities.force_rates,
            )
        )
    return jnp.concatenate(guards)


def compute_guard_scales(contact_mode_dynamics: ContactModeDynamics) -> Array:
    """Return the scale of each guard in the order of `GuardLayout`, in the guard's unit."""
    s = contact_mode_dynamics.s
    force_scale, speed_scale = s.Mt * s.g, jnp.sqrt(s.g * s.L0)
    guard_scales = (
        [s.L0] * 2 * s.n
        + [force_scale] * 6
        + [speed_scale] * 2
        + [force_scale] * 2
        + [speed_scale / s.L0, s.L0]
    )
    guard_scales += [force_scale] * s.n * contact_mode_dynamics.has_one_sided_stoppers
    if contact_mode_dynamics.contact_state.is_kink_positive:
        guard_scales += _compute_kink_scales(s, speed_scale)
    if contact_mode_dynamics.measures_force_peaks:
        force_rate_scale = force_scale * speed_scale / s.L0
        guard_scales += [force_rate_scale] * 2 + [force_rate_scale * speed_scale / s.L0]
    return jnp.stack(guard_scales)


def _compute_kink_scales(s: Symbols, speed_scale: Array) -> list[Array]:
    """Return the scale of the function of each kink for each leg, from its derivatives."""
    L = jnp.stack([s.L0] * s.n)
    zero, speed = 0.0 * L, jnp.stack([speed_scale] * s.n)
    evaluate = lambda L, dL: evaluate_leg_kinks(s, L, dL, number_legs(L))
    changes = (
        jax.jvp(evaluate, (L, zero), direction)[1] for direction in ((L, zero), (zero, speed))
    )
    scales = (jnp.abs(x) + jnp.abs(y) for x, y in zip(*changes, strict=True))
    return [jnp.where(x > 0.0, x, 1.0) for scale in scales for x in scale]


def compute_state_units(s: Symbols) -> tuple[Array, Array]:
    """Return the wheel's units for (hub x, hub z, theta, leg lengths) and for their rates."""
    wheel_units = compute_wheel_units(s)
    stack_units = lambda linear_unit, angular_unit: jnp.stack(
        [linear_unit, linear_unit, angular_unit, *[linear_unit] * s.n]
    )
    return (
        stack_units(wheel_units.length_unit, jnp.ones_like(s.L0)),
        stack_units(wheel_units.velocity_unit, wheel_units.rate_unit),
    )


def choose_stopping_guard(
    contact_mode_dynamics: ContactModeDynamics,
    coordinate_rates: Array,
    guard_index: Int[Array, "..."],
    atol: Elementwise,
) -> Int[Array, "..."]:
    """Return the index of the guard that ends the interval when the wheel stops rolling.

    If all rates are zero to within `atol` and a foot slides, the result is the guard for the end of
    the slide. Otherwise it is `guard_index`. The reason is that round-off determines which of the
    two guards is zero first. After the slide has ended, the friction on the stopped foot determines
    whether the wheel rests or falls back.
    """
    guard_layout = contact_mode_dynamics.guard_layout
    slip_signs = compute_slip_signs(contact_mode_dynamics.slot_modes)
    has_just_slid = contact_mode_dynamics.contact_slots.gather_flags_from_legs(
        contact_mode_dynamics.contact_state.has_just_slid
    )
    has_slid_to_rest = guard_index == guard_layout.rolling_rate.start
    has_slid_to_rest &= are_rates_negligible(
        coordinate_rates, compute_state_units(contact_mode_dynamics.s)[1], atol
    )
    for stopped_slot in reversed(range(2)):
        has_slide_ended = (
            has_slid_to_rest & (slip_signs[stopped_slot] != 0.0) & ~has_just_slid[stopped_slot]
        )
        guard_index = jnp.where(has_slide_ended, guard_layout.slip_end[stopped_slot], guard_index)
    return guard_index


def compute_packed_units(s: Symbols) -> PackedState:
    """Return the wheel's unit for each entry of `pack_state`."""
    wheel_units, (position_units, rate_units) = compute_wheel_units(s), compute_state_units(s)
    accumulator_units = EnergyLossAccumulators(
        wheel_units.time_unit,
        wheel_units.energy_unit,
        wheel_units.energy_unit,
        wheel_units.length_unit,
    )
    motion_units = position_units[:3], rate_units[:3], position_units[3:], rate_units[3:]
    return lax.stop_gradient(jnp.concatenate([*motion_units, jnp.stack(accumulator_units)]))
