"""Effects of an event: impacts at the velocity level, then the contact modes of the following
motion.

All functions work elementwise, for one wheel or a batch.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Int

from vrw_jax.contact.contact_modes import (
    ALL_MODES_MASK,
    MAX_VIOLATION,
    PAPER_RULE_SENTINEL,
    AllowedModes,
    ChosenCombination,
    ContactMode,
    Friction,
    SignTolerances,
    choose_combination,
    is_release_consistent,
)
from vrw_jax.contact.contact_state import ContactState, GuardLayout, stack_friction
from vrw_jax.contact.dynamics_jvp import (
    ContactConfiguration,
    ForceSolution,
    solve_configuration,
    solve_contact_forces,
    solve_impact,
)
from vrw_jax.contact.mechanics import (
    ContactInverseInertia,
    ContactSlots,
    FreeMotion,
    LegArray,
    SlotPair,
    WheelMotion,
    find_slots,
    foot_heights,
    foot_speeds,
    foot_velocity,
    free_acceleration,
    free_velocity,
    kinetic_energy,
    leg_directions,
    make_inverse_inertia,
    slot_friction,
    stop_gradients,
)
from vrw_jax.numerics import Elementwise, run_if_any, select_tree_leaves
from vrw_jax.wheel import Symbols


class Event(NamedTuple):
    """Kind of an event. One flag is set, for one leg or slot."""

    lands: Bool[Array, "n_legs ..."]  # whether the foot meets the ground
    meets_stopper: Bool[Array, "n_legs ..."]  # whether the leg meets its stopper
    leaves_stopper: Bool[Array, "n_legs ..."]  # whether the stopper force in the air vanishes
    lifts_off: Bool[Array, "2 ..."]  # whether the normal force of the slot vanishes
    slides_up: Bool[Array, "2 ..."]  # whether the slot's foot begins to slide uphill
    slides_down: Bool[Array, "2 ..."]
    stops_sliding: Bool[Array, "2 ..."]  # whether the slot's foot stops sliding
    releases_stopper: Bool[Array, "2 ..."]  # whether the stopper force of the slot's leg vanishes

    @property
    def is_impact(self) -> Bool[Array, "..."]:
        """Return whether velocities jump at the event."""
        return jnp.any(self.lands, axis=0) | jnp.any(self.meets_stopper, axis=0)


def _leg_indices(n: int, reference: Array) -> np.ndarray:
    """Return 0 ... n - 1 on the first axis, with as many further axes as `reference`."""
    return np.arange(n, dtype=np.int32).reshape(-1, *(1,) * jnp.ndim(reference))


def classify_event(guard_layout: GuardLayout, guard: Int[Array, "..."]) -> Event:
    """Return the event of a guard, from the guard's index in `layout`."""
    n = guard_layout.n_legs
    select_flags = lambda first_index, n_guards: (
        guard == first_index + _leg_indices(n_guards, guard)
    )
    leaves_stopper = (
        select_flags(guard_layout.airborne_release, n)
        if guard_layout.n_guards > guard_layout.airborne_release
        else select_flags(guard_layout.landing, n) & False
    )
    return Event(
        lands=select_flags(guard_layout.landing, n),
        meets_stopper=select_flags(guard_layout.stopper, n),
        leaves_stopper=leaves_stopper,
        lifts_off=select_flags(guard_layout.liftoff, 2),
        slides_up=select_flags(guard_layout.slip_up, 2),
        slides_down=select_flags(guard_layout.slip_down, 2),
        stops_sliding=select_flags(guard_layout.slip_end, 2),
        releases_stopper=select_flags(guard_layout.stopper_release, 2),
    )


class ContactLaw(NamedTuple):
    """Wheel, ground and contact options of all events of a walk."""

    s: Symbols
    friction: Friction  # of all feet; or of the last landed foot and of the others
    is_one_sided: bool  # whether stoppers of legs in the air only push
    counts_solutions: bool  # whether all admissible solutions are counted
    rest_speed: Elementwise  # speed below which a contact is at rest after an impact, m/s
    restitution: Elementwise | None = None  # Newton's coefficient of the feet
    tilt: Elementwise | None = None  # angle by which the next line is steeper, rad


@dataclass(frozen=True)
class StopperPivotOptions:
    """Options of the search for the stoppers that hold their legs.

    Few pivots suffice unless friction couples legs.
    """

    max_block_pivots: int = 8
    """Number of pivots that switch all legs of the wrong sign."""
    max_single_pivots: int = 16
    """Number of later pivots that switch one leg each."""
    max_enumerated_legs: int = 8
    """Largest number of legs whose combinations are enumerated if pivoting fails."""


STOPPER_PIVOT_OPTIONS = StopperPivotOptions()


class _LevelSolution(NamedTuple):
    """Solution at velocity or acceleration level for an assumed set of held legs in the air."""

    chosen_combination: ChosenCombination
    solution: ForceSolution
    stopper_push: LegArray  # force or impulse of the stoppers, N or N s
    outward_motion: LegArray  # of the leg lengths, m/s^2 or m/s
    motion: WheelMotion  # motion after the impact


_LevelSolver = Callable[[ContactLaw, WheelMotion, Array, ChosenCombination | None], _LevelSolution]
"""Function of contact law, motion, held legs in the air and, if known, the chosen combination."""


def _solve_stopper_lcp(
    solve_level: _LevelSolver,
    contact_law: ContactLaw,
    motion: WheelMotion,
    is_at_stopper: Array,
    is_tested: Array,
    tolerances: SignTolerances,
    pivot_options: StopperPivotOptions = STOPPER_PIVOT_OPTIONS,
) -> tuple[_LevelSolution, Array]:
    """Return the solution for the legs in the air that are held, and whether each leg is held.

    Legs `is_at_stopper` that are `is_tested` are held if their stopper pushes; otherwise they move
    inwards. Pivots first switch all legs of the wrong sign together. Later pivots switch only the
    last of these legs, which prevents cycles. This is principal pivoting, which is finite if no
    friction couples the legs (Murty 1974, Kostreva 1978). If pivoting fails, all combinations are
    enumerated. The least violating solution is returned. That solution is admissible if its
    violation is at most `MAX_VIOLATION`.
    """
    constant_inputs = stop_gradients((contact_law, motion))
    tested_rank = jnp.cumsum(is_tested.astype(jnp.int32), axis=0) - 1
    n_combinations = 1 << jnp.minimum(
        jnp.sum(is_tested, axis=0, dtype=jnp.int32), pivot_options.max_enumerated_legs
    )
    leg_index = _leg_indices(len(is_at_stopper), n_combinations)

    def is_unfinished(state: tuple) -> Array:
        _, combination_code, n_attempts, best_solution = state
        return (n_attempts == 0) | ((best_solution[0] > 1.0) & (combination_code < n_combinations))

    def pivot(state: tuple) -> tuple:
        is_held, combination_code, n_attempts, best_solution = state
        level_solution = solve_level(constant_inputs[0], constant_inputs[1], is_held, None)
        violation = jnp.where(
            is_held,
            -level_solution.stopper_push / tolerances.force_tolerance,
            level_solution.outward_motion / tolerances.motion_tolerance,
        )
        violation = jnp.where(is_tested, lax.stop_gradient(violation), 0.0)
        is_violated = violation > 1.0
        max_violation = jnp.maximum(
            jnp.max(violation, axis=0), level_solution.chosen_combination.violation
        )
        best_solution = select_tree_leaves(
            max_violation < best_solution[0],
            (max_violation, is_held, level_solution.chosen_combination),
            best_solution,
        )
        is_last_violated = leg_index == jnp.max(jnp.where(is_violated, leg_index, -1), axis=0)
        switched_legs = is_held ^ jnp.where(
            n_attempts < pivot_options.max_block_pivots, is_violated, is_last_violated
        )
        is_pivoting = (
            (combination_code < 0)
            & jnp.any(is_violated, axis=0)
            & (n_attempts < pivot_options.max_block_pivots + pivot_options.max_single_pivots)
        )
        combination_code = jnp.where(is_pivoting, combination_code, combination_code + 1)
        enumerated_legs = jnp.where(
            is_tested, ((combination_code >> tested_rank) & 1) == 1, is_at_stopper
        )
        return select_tree_leaves(
            is_unfinished(state),
            (
                jnp.where(is_pivoting, switched_legs, enumerated_legs),
                combination_code,
                n_attempts + 1,
                best_solution,
            ),
            state,
        )

    int_zeros = jnp.zeros_like(n_combinations)
    slot_zeros = jnp.stack([n_combinations, n_combinations]) * 0
    infinite_violation = jnp.full_like(constant_inputs[1].theta, jnp.inf)
    initial_state = (
        is_at_stopper,
        int_zeros - 1,
        int_zeros,
        (
            infinite_violation,
            is_at_stopper,
            ChosenCombination(slot_zeros, slot_zeros > 0, infinite_violation, int_zeros),
        ),
    )
    final_state = lax.while_loop(lambda state: jnp.any(is_unfinished(state)), pivot, initial_state)
    max_violation, is_held, chosen_combination = final_state[3]
    chosen_combination = chosen_combination._replace(
        n_solutions=jnp.where(max_violation <= MAX_VIOLATION, chosen_combination.n_solutions, 0)
    )
    return solve_level(contact_law, motion, is_held, chosen_combination), is_held


class EventResult(NamedTuple):
    """Motion and contact state after an event, with impulses and lost energy."""

    motion: WheelMotion
    contact_state: ContactState
    energy_lost: Elementwise  # J
    normal_impulse: SlotPair  # impulse on the slots' feet, N s
    tangential_impulse: SlotPair
    stopper_impulse: Elementwise  # minimum over airborne locked legs, N s; inf without impact
    n_solutions: Int[Array, "..."]  # number of admissible combinations: minimum of both levels
    is_paradox: Bool[Array, "..."]  # whether no forces can continue the motion
    most_solutions: Int[Array, "..."]
    has_third_foot: Bool[Array, "..."]  # whether a third foot would have to be loaded


def _motion_after_impact(motion: WheelMotion, solution: ForceSolution) -> WheelMotion:
    """Return the motion with the velocities of an impact's solution."""
    vx, vz, dtheta = solution.hub_vector
    return motion._replace(vx=vx, vz=vz, dtheta=dtheta, dL=solution.length_motion)


def _apply_restitution(
    contact_law: ContactLaw,
    motion: WheelMotion,
    contact_slots: ContactSlots,
    inertia: ContactInverseInertia,
    free_motion: FreeMotion,
) -> FreeMotion:
    """Return the velocities without impulses, changed by the rebound of striking feet by Newton's
    law.
    """
    if contact_law.restitution is None:
        return free_motion
    rebound_speeds = [
        contact_law.restitution * z for z in foot_velocity(motion, contact_slots, inertia).z
    ]
    # A foot whose rebound is slower than the rest speed is at rest.
    rebound_speeds = [jnp.where(z < -contact_law.rest_speed, z, 0.0) for z in rebound_speeds]
    return free_motion._replace(
        foot_transverse_motion=(
            free_motion.foot_transverse_motion[0] - inertia.sin[0] * rebound_speeds[0],
            free_motion.foot_transverse_motion[1] - inertia.sin[1] * rebound_speeds[1],
        ),
        foot_radial_motion=(
            free_motion.foot_radial_motion[0] + inertia.cos[0] * rebound_speeds[0],
            free_motion.foot_radial_motion[1] + inertia.cos[1] * rebound_speeds[1],
        ),
    )


def _limit_energy_gain(
    contact_law: ContactLaw,
    motion: WheelMotion,
    newton_solution: _LevelSolution,
    inelastic_solution: _LevelSolution,
) -> _LevelSolution:
    """Return the part of Newton's rebound that energy allows.

    With Coulomb's friction, Newton's law can create energy (Kane 1984). Along the line from the
    inelastic impact to Newton's, energy is a quadratic function. The inelastic impact never creates
    energy. The result is the largest part of the rebound without an energy gain. Impulses stay in
    the cone of friction, because the cone is convex.
    """
    compute_energy = lambda motion_state: kinetic_energy(contact_law.s, motion_state)
    energy_inelastic, energy_newton = (
        compute_energy(inelastic_solution.motion),
        compute_energy(newton_solution.motion),
    )
    energy_midpoint = compute_energy(
        jax.tree.map(lambda a, b: 0.5 * (a + b), inelastic_solution.motion, newton_solution.motion)
    )
    parabola_curvature = 2.0 * (energy_inelastic - 2.0 * energy_midpoint + energy_newton)
    parabola_linear_term = 4.0 * energy_midpoint - 3.0 * energy_inelastic - energy_newton
    allowed_gain = jnp.maximum(compute_energy(motion) - energy_inelastic, 0.0)
    has_gain = energy_newton > compute_energy(motion)
    sqrt_discriminant = jnp.sqrt(
        jnp.where(
            has_gain,
            parabola_linear_term * parabola_linear_term + 4.0 * parabola_curvature * allowed_gain,
            1.0,
        )
    )
    rebound_fraction = jnp.where(
        has_gain,
        2.0 * allowed_gain / jnp.where(has_gain, parabola_linear_term + sqrt_discriminant, 1.0),
        1.0,
    )
    interpolate = lambda a, b: jnp.where(has_gain, a + rebound_fraction * (b - a), b)
    return _LevelSolution(
        newton_solution.chosen_combination,
        *jax.tree.map(interpolate, inelastic_solution[1:], newton_solution[1:]),
    )


def _solve_velocity_level(
    contact_law: ContactLaw, motion: WheelMotion, contact_state: ContactState, event: Event
) -> tuple[_LevelSolution, ContactSlots, Bool[Array, "n ..."]]:
    """Return the solution of a simultaneous inelastic impact, with Coulomb's law for impulses.

    The result is (solution, slots, held legs in the air). With one-sided stoppers, held legs are
    those whose stoppers need not pull. The paper's rule keeps resting feet planted when a leg meets
    its stopper.
    """
    s, contact_slots = (
        contact_law.s,
        find_slots((contact_state.contact_modes != ContactMode.OFF) | event.lands),
    )
    friction = slot_friction(contact_law.friction, contact_slots)
    is_at_stopper = contact_state.locked | event.meets_stopper
    is_loaded = jnp.stack(
        [jnp.any(contact_slots.first_mask, axis=0), jnp.any(contact_slots.second_mask, axis=0)]
    )
    slot_locked = contact_slots.gather_flags(is_at_stopper)
    slot_modes = contact_slots.gather_codes(contact_state.contact_modes)
    is_landing = jnp.any(event.lands, axis=0)
    is_planted = (
        (slot_modes == ContactMode.STICK)
        & ~is_landing
        & (stack_friction(friction) == PAPER_RULE_SENTINEL)
    )
    allowed_slot_modes = jnp.where(is_loaded, ALL_MODES_MASK, 1 << ContactMode.OFF).astype(
        jnp.int32
    )
    allowed_slot_modes = jnp.where(is_planted, 1 << slot_modes, allowed_slot_modes)
    allowed = AllowedModes(
        allowed_modes=jnp.where(
            event.is_impact, allowed_slot_modes, 0
        ),  # Without an impact, no mode is examined.
        can_hold_stopper=slot_locked,
        has_fixed_mode=is_planted,
        untested_modes=jnp.where(is_loaded, 0, 1 << ContactMode.OFF).astype(jnp.int32),
        is_open_untested=~slot_locked,
    )
    tolerances = SignTolerances(
        s.m * contact_law.rest_speed / MAX_VIOLATION, contact_law.rest_speed / MAX_VIOLATION
    )

    def solve_level(
        contact_law: ContactLaw,
        motion: WheelMotion,
        is_airborne_locked: Array,
        chosen_combination: ChosenCombination | None,
    ) -> _LevelSolution:
        s, friction = contact_law.s, slot_friction(contact_law.friction, contact_slots)
        directions = leg_directions(s, motion.theta)
        inertia = make_inverse_inertia(s, motion, contact_slots, is_airborne_locked)
        free_motion = free_velocity(s, motion, contact_slots, inertia)
        rebound_motion = _apply_restitution(
            contact_law, motion, contact_slots, inertia, free_motion
        )
        if chosen_combination is None:
            chosen_combination = choose_combination(
                s,
                inertia,
                rebound_motion,
                allowed,
                friction,
                tolerances,
                contact_law.counts_solutions,
            )
        configuration = ContactConfiguration(
            s,
            motion,
            friction,
            contact_slots,
            chosen_combination.slot_modes,
            chosen_combination.is_held,
            is_airborne_locked,
        )
        solution = (
            solve_impact(configuration)
            if contact_law.restitution is None
            else solve_configuration(configuration, inertia, rebound_motion)
        )
        motion_after = _motion_after_impact(motion, solution)
        jump_x, jump_z = motion_after.vx - motion.vx, motion_after.vz - motion.vz
        impulse = s.m * (directions.sin * jump_x + directions.cos * jump_z + motion.dL)
        return _LevelSolution(chosen_combination, solution, impulse, motion_after.dL, motion_after)

    is_airborne_locked = is_at_stopper & ~contact_slots.is_filled
    if not contact_law.is_one_sided:
        return (
            solve_level(contact_law, motion, is_airborne_locked, None),
            contact_slots,
            is_airborne_locked,
        )
    is_tested = is_airborne_locked & event.is_impact
    level_solution, is_held_airborne = _solve_stopper_lcp(
        solve_level, contact_law, motion, is_airborne_locked, is_tested, tolerances
    )
    return level_solution, contact_slots, is_held_airborne


def _following_modes(
    event: Event, slot_modes: Array, is_consistent: Array, follows_paper_rule: Array
) -> tuple[Int[Array, "2 ..."], Int[Array, "2 ..."]]:
    """Return the modes that may follow an event in each slot, and those that need no test, as bits.

    - `is_consistent`: whether the next mode of a slot's foot has the direction of release (see
      `is_release_consistent`).
    """
    current_bit, off_bit = 1 << slot_modes, 1 << ContactMode.OFF
    possible_modes = jnp.where(
        slot_modes == ContactMode.STICK, ALL_MODES_MASK, current_bit | off_bit
    )
    reversed_bit = jnp.where(
        slot_modes == ContactMode.SLIP_DOWN, 1 << ContactMode.SLIP_UP, 1 << ContactMode.SLIP_DOWN
    )
    possible_modes = jnp.where(
        event.stops_sliding, 1 << ContactMode.STICK | off_bit | reversed_bit, possible_modes
    )
    untested_modes = jnp.where(
        (slot_modes == ContactMode.STICK) | event.stops_sliding, 0, current_bit
    )
    for event_flags, following_mode, ended_mode in (
        (event.lifts_off, off_bit, current_bit),
        (event.slides_up, 1 << ContactMode.SLIP_UP, 1 << ContactMode.STICK),
        (event.slides_down, 1 << ContactMode.SLIP_DOWN, 1 << ContactMode.STICK),
    ):
        tested_bits = (
            ALL_MODES_MASK
            & ~ended_mode
            & jnp.where(is_consistent | follows_paper_rule, ALL_MODES_MASK, ~following_mode)
        )
        possible_modes = jnp.where(
            event_flags, jnp.where(is_consistent, following_mode, tested_bits), possible_modes
        )
        untested_modes = jnp.where(
            event_flags, jnp.where(is_consistent, following_mode, 0), untested_modes
        )
    return possible_modes, untested_modes


FORCE_ROUNDOFF_FRACTION = 1e-9
"""Fraction of the wheel's weight, and of gravity, that counts as zero, chosen because forces are
accurate to round-off."""


def _solve_acceleration_level(
    contact_law: ContactLaw,
    motion: WheelMotion,
    contact_modes: Int[Array, "n ..."],
    is_at_stopper: Array,
    event: Event,
) -> tuple[ChosenCombination, ContactSlots, Array, Bool[Array, "n ..."]]:
    """Return the contact modes and stoppers of the following motion, at the acceleration level.

    The result is (combination, slots, feet that were at rest, held legs in the air). The contact
    that an event has just ended is not tested again: its force is zero up to round-off. The contact
    is followed by the mode of its release, if that is consistent (see `is_release_consistent`). The
    result has no derivatives.
    """
    contact_law, motion = stop_gradients((contact_law, motion))
    s, contact_slots = contact_law.s, find_slots(contact_modes != ContactMode.OFF)
    friction = slot_friction(contact_law.friction, contact_slots)
    slot_modes, slot_locked = (
        contact_slots.gather_codes(contact_modes),
        contact_slots.gather_flags(is_at_stopper),
    )
    was_resting = (slot_modes == ContactMode.STICK) | event.stops_sliding
    # When such a foot is released, its tangential force jumps to zero.
    follows_paper_rule = (slot_modes == ContactMode.STICK) & (
        stack_friction(friction) == PAPER_RULE_SENTINEL
    )
    slides_up, slides_down = event.slides_up, event.slides_down
    is_second = (event.lifts_off | slides_up | slides_down)[1]
    any_slot = lambda event_flags: jnp.any(event_flags, axis=0).astype(jnp.int32)
    release_direction = any_slot(slides_down) - any_slot(slides_up)
    may_leave_stopper = ~slot_locked | event.releases_stopper
    tolerances = SignTolerances(FORCE_ROUNDOFF_FRACTION * s.Mt * s.g, FORCE_ROUNDOFF_FRACTION * s.g)

    def solve_level(
        contact_law: ContactLaw,
        motion: WheelMotion,
        is_airborne_locked: Array,
        chosen_combination: ChosenCombination | None,
    ) -> _LevelSolution:
        inertia = make_inverse_inertia(s, motion, contact_slots, is_airborne_locked)
        free_motion = free_acceleration(s, motion, contact_slots, inertia)
        if chosen_combination is None:
            is_consistent = is_release_consistent(
                s,
                inertia,
                free_motion,
                (slot_modes, slot_locked),
                friction,
                is_second,
                release_direction,
            )
            possible_modes, untested = _following_modes(
                event, slot_modes, is_consistent & ~follows_paper_rule, follows_paper_rule
            )
            allowed = AllowedModes(
                possible_modes, ~may_leave_stopper, was_resting & False, untested, may_leave_stopper
            )
            chosen_combination = choose_combination(
                s, inertia, free_motion, allowed, friction, tolerances, contact_law.counts_solutions
            )
        configuration = ContactConfiguration(
            s,
            motion,
            friction,
            contact_slots,
            chosen_combination.slot_modes,
            chosen_combination.is_held,
            is_airborne_locked,
        )
        solution = solve_configuration(configuration, inertia, free_motion)
        ax, az, _ = solution.hub_vector
        outward = (
            free_motion.leg_motion
            + inertia.leg_directions.sin * ax
            + inertia.leg_directions.cos * az
        )
        return _LevelSolution(chosen_combination, solution, s.m * outward, outward, motion)

    is_airborne_locked = is_at_stopper & ~contact_slots.is_filled
    if not contact_law.is_one_sided:
        return (
            solve_level(contact_law, motion, is_airborne_locked, None).chosen_combination,
            contact_slots,
            was_resting,
            is_airborne_locked,
        )
    level_solution, is_held_airborne = _solve_stopper_lcp(
        solve_level, contact_law, motion, is_airborne_locked, is_airborne_locked, tolerances
    )
    return level_solution.chosen_combination, contact_slots, was_resting, is_held_airborne


def _bring_to_rest(
    contact_law: ContactLaw,
    motion: WheelMotion,
    contact_slots: ContactSlots,
    contact_modes: Array,
    is_at_stopper: Array,
    was_locked: Array,
) -> tuple[WheelMotion, Array, Array]:
    """Return the motion after an impact, the modes of the touching feet, and whether legs are on
    stoppers.

    A contact slower than `ContactLaw.rest_speed` after the impact is brought to rest. Otherwise the
    contact would return after a bounce too small to resolve, and separate again at a lower speed,
    without end. The forces decide the contacts of the following motion.

    - `was_locked`: legs that were at their stoppers.
    """
    directions = leg_directions(contact_law.s, motion.theta)
    tangential_speed, normal_speed = foot_speeds(motion, directions)
    stays_loaded = contact_slots.is_filled & (normal_speed < contact_law.rest_speed)
    slip_mode = jnp.where(tangential_speed > 0.0, ContactMode.SLIP_DOWN, ContactMode.SLIP_UP)
    rest_modes = jnp.where(
        jnp.abs(tangential_speed) < contact_law.rest_speed, ContactMode.STICK, slip_mode
    )
    rest_modes = jnp.where(
        stays_loaded,
        jnp.where(contact_modes == ContactMode.STICK, ContactMode.STICK, rest_modes),
        ContactMode.OFF,
    )
    is_locked = is_at_stopper | (was_locked & (jnp.abs(motion.dL) < contact_law.rest_speed))
    has_changed = jnp.any((rest_modes != contact_modes) | (is_locked != is_at_stopper), axis=0)
    s, frozen_motion, friction = stop_gradients((contact_law.s, motion, contact_law.friction))

    def find_reversed_slip(_: Array) -> Array:
        """Return the feet whose slip would be reversed by the projection. These feet also come to
        rest.
        """
        speed_after, _ = foot_speeds(
            project_motion(s, frozen_motion, rest_modes, is_locked, friction), directions
        )
        return ((rest_modes == ContactMode.SLIP_DOWN) & (speed_after < 0.0)) | (
            (rest_modes == ContactMode.SLIP_UP) & (speed_after > 0.0)
        )

    is_slip_reversed = has_changed & run_if_any(
        jnp.any(has_changed), find_reversed_slip, is_locked & False
    )
    rest_modes = jnp.where(is_slip_reversed, ContactMode.STICK, rest_modes)
    return (
        select_tree_leaves(
            has_changed,
            project_motion(contact_law.s, motion, rest_modes, is_locked, contact_law.friction),
            motion,
        ),
        rest_modes,
        is_locked,
    )


def _merge_touching(
    contact_law: ContactLaw, motion: WheelMotion, contact_state: ContactState, event: Event
) -> Event:
    """Return the event extended to all contacts that touch, whether or not their guards are zero.

    A contact touches if its distance is below the smallest resolved bounce and it does not
    separate. If such contacts were resolved one by one, they would push each other off forever.
    """
    s, directions = contact_law.s, leg_directions(contact_law.s, motion.theta)
    bounce_height = contact_law.rest_speed**2 / (2.0 * s.g)
    heights = foot_heights(motion, directions, contact_law.tilt)
    is_touching = (heights <= bounce_height) & (
        foot_speeds(motion, directions)[1] <= contact_law.rest_speed
    )
    lands = event.lands | (
        is_touching & (contact_state.contact_modes == ContactMode.OFF) & event.is_impact
    )
    fits_slots = (
        jnp.sum(lands | (contact_state.contact_modes != ContactMode.OFF), axis=0, dtype=jnp.int32)
        <= 2
    )
    is_extended = (bounce_height >= s.L0 - motion.L) & (motion.dL >= -contact_law.rest_speed)
    meets_stopper = event.meets_stopper | (is_extended & ~contact_state.locked & event.is_impact)
    return event._replace(
        lands=jnp.where(fits_slots, lands, event.lands), meets_stopper=meets_stopper
    )


def _liftoff_to_slip(
    contact_law: ContactLaw, motion: WheelMotion, contact_state: ContactState, event: Event
) -> Event:
    """Return the event with lift-off replaced by slip, in the limit of large friction.

    A resting foot whose normal force vanishes begins to slide against the direction of its
    tangential force.
    """
    contact_law, motion = stop_gradients((contact_law, motion))
    contact_slots = find_slots(contact_state.contact_modes != ContactMode.OFF)
    friction, slot_modes = (
        slot_friction(contact_law.friction, contact_slots),
        contact_slots.gather_codes(contact_state.contact_modes),
    )
    begins_slip = (
        event.lifts_off & (slot_modes == ContactMode.STICK) & (stack_friction(friction) == jnp.inf)
    )
    slot_state = (
        contact_slots,
        slot_modes,
        contact_slots.gather_flags(contact_state.locked),
        contact_state.locked & ~contact_slots.is_filled,
    )
    tangential_forces = lambda _: (
        solve_contact_forces(
            ContactConfiguration(contact_law.s, motion, friction, *slot_state)
        ).tangential
    )
    zeros = jnp.zeros_like(motion.theta), jnp.zeros_like(motion.theta)
    is_uphill = jnp.stack(run_if_any(jnp.any(begins_slip), tangential_forces, zeros)) > 0.0
    return event._replace(
        lifts_off=event.lifts_off & ~begins_slip,
        slides_up=event.slides_up | (begins_slip & is_uphill),
        slides_down=event.slides_down | (begins_slip & ~is_uphill),
    )


def resolve_event(
    contact_law: ContactLaw, motion: WheelMotion, contact_state: ContactState, event: Event
) -> EventResult:
    """Return motion, contact state, impulses and lost energy after an event."""
    event = _merge_touching(
        contact_law,
        motion,
        contact_state,
        _liftoff_to_slip(contact_law, motion, contact_state, event),
    )
    s, is_impact = contact_law.s, event.is_impact
    was_touching = (contact_state.contact_modes != ContactMode.OFF) | event.lands
    was_locked = (contact_state.locked | event.meets_stopper) & ~event.leaves_stopper
    velocity_solution, contact_slots, is_held = _solve_velocity_level(
        contact_law, motion, contact_state, event
    )
    if contact_law.restitution is not None:
        inelastic_solution = _solve_velocity_level(
            contact_law._replace(restitution=None), motion, contact_state, event
        )[0]
        velocity_solution = _limit_energy_gain(
            contact_law, motion, velocity_solution, inelastic_solution
        )
    impact_modes = contact_slots.scatter(velocity_solution.chosen_combination.slot_modes).astype(
        jnp.int32
    )
    stays_locked = jnp.where(
        contact_slots.is_filled,
        contact_slots.scatter(velocity_solution.chosen_combination.is_held) > 0,
        was_locked & is_held,
    )
    if contact_law.restitution is not None:  # Only a part of the impulse may act.
        stays_locked = stays_locked & (
            jnp.abs(velocity_solution.motion.dL) < contact_law.rest_speed
        )
    rest_result = _bring_to_rest(
        contact_law, velocity_solution.motion, contact_slots, impact_modes, stays_locked, was_locked
    )
    motion_after, contact_modes, is_at_stopper = select_tree_leaves(
        is_impact, rest_result, (motion, contact_state.contact_modes, was_locked)
    )
    directions = leg_directions(s, motion.theta)
    has_no_slot = was_touching & ~contact_slots.is_filled
    energy_lost = kinetic_energy(s, motion) - kinetic_energy(s, motion_after)
    stopper_impulse = jnp.where(is_held, velocity_solution.stopper_push, jnp.inf)

    acceleration_solution, contact_slots, was_resting, is_held = _solve_acceleration_level(
        contact_law, motion_after, contact_modes, is_at_stopper, event
    )
    contact_modes = contact_slots.scatter(acceleration_solution.slot_modes).astype(jnp.int32)
    is_locked = jnp.where(
        contact_slots.is_filled,
        contact_slots.scatter(acceleration_solution.is_held) > 0,
        is_at_stopper & is_held,
    )
    is_sliding = (acceleration_solution.slot_modes == ContactMode.SLIP_DOWN) | (
        acceleration_solution.slot_modes == ContactMode.SLIP_UP
    )
    contact_state = ContactState(
        contact_modes=contact_modes,
        locked=is_locked,
        has_just_lifted=was_touching & (contact_modes == ContactMode.OFF),
        has_just_unlocked=(contact_state.locked | event.meets_stopper) & ~is_locked,
        has_just_slid=contact_slots.scatter(is_sliding & was_resting) > 0,
    )
    n_impact_solutions = velocity_solution.chosen_combination.n_solutions
    n_force_solutions = acceleration_solution.n_solutions
    zero_without_impact = lambda slot_pair: (
        jnp.where(is_impact, slot_pair[0], 0.0),
        jnp.where(is_impact, slot_pair[1], 0.0),
    )
    return EventResult(
        motion=motion_after._replace(
            L=jnp.where(is_locked, s.L0, motion_after.L),
            dL=jnp.where(is_locked, 0.0, motion_after.dL),
        ),
        contact_state=contact_state,
        energy_lost=jnp.where(is_impact, energy_lost, 0.0),
        normal_impulse=zero_without_impact(velocity_solution.solution.normal),
        tangential_impulse=zero_without_impact(velocity_solution.solution.tangential),
        stopper_impulse=jnp.where(is_impact, jnp.min(stopper_impulse, axis=0), jnp.inf),
        n_solutions=jnp.where(
            is_impact, jnp.minimum(n_impact_solutions, n_force_solutions), n_force_solutions
        ),
        is_paradox=(n_force_solutions == 0) & ((n_impact_solutions > 0) | ~is_impact),
        most_solutions=jnp.where(
            is_impact, jnp.maximum(n_impact_solutions, n_force_solutions), n_force_solutions
        ),
        has_third_foot=jnp.any(
            has_no_slot & (foot_speeds(motion_after, directions)[1] < 0.0), axis=0
        )
        & is_impact,
    )


def project_motion(
    s: Symbols,
    motion: WheelMotion,
    contact_modes: Int[Array, "n ..."],
    is_locked: Bool[Array, "n ..."],
    friction: Any = None,
) -> WheelMotion:
    """Return the motion projected onto its contacts: loaded feet on the slope, sticking feet at
    rest.

    Bilateral, frictionless impulses project the velocities. A motion that already satisfies its
    contacts is unchanged up to round-off.

    - `friction`: coefficient of sliding feet during the projection; None means 0.
    """
    directions = leg_directions(s, motion.theta)
    L = jnp.where(
        (contact_modes != ContactMode.OFF) & ~is_locked, motion.z / directions.cos, motion.L
    )
    motion = motion._replace(L=jnp.where(is_locked, s.L0, L))
    contact_slots = find_slots(contact_modes != ContactMode.OFF)
    is_airborne_locked = is_locked & ~contact_slots.is_filled
    slot_modes, is_held = (
        contact_slots.gather_codes(contact_modes),
        contact_slots.gather_flags(is_locked),
    )
    # Two resting feet on two held legs would constrain the hub twice.
    is_overdetermined = jnp.all((slot_modes == ContactMode.STICK) & is_held, axis=0)
    is_held = jnp.stack([is_held[0], is_held[1] & ~is_overdetermined])
    slot_coefficients = (
        jnp.zeros_like(motion.theta) if friction is None else slot_friction(friction, contact_slots)
    )
    configuration = ContactConfiguration(
        s, motion, slot_coefficients, contact_slots, slot_modes, is_held, is_airborne_locked
    )
    projected_motion = _motion_after_impact(motion, solve_impact(configuration))
    return projected_motion._replace(dL=jnp.where(is_locked, 0.0, projected_motion.dL))
