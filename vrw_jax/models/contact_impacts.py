"""Compute the effects of an event: the impact, and the contact modes of the subsequent motion.

All functions work elementwise, for one wheel or a batch.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int

from vrw_jax.base.elementwise import (
    Elementwise,
    run_if_any_element_active,
    select_trees_by_condition,
)
from vrw_jax.models.contact_jvp import (
    ContactConfiguration,
    WheelForceSolution,
    compute_slip_signs,
    find_slot_contacts,
    solve_contact_configuration,
    solve_contact_forces,
    solve_impact,
)
from vrw_jax.models.contact_mechanics import (
    ContactInverseInertia,
    ContactSlots,
    FreeMotion,
    Friction,
    SlotArray,
    WheelMotion,
    align_with_batch,
    compute_contact_foot_velocities,
    compute_foot_heights,
    compute_foot_velocities,
    compute_free_acceleration,
    compute_free_velocity,
    compute_kinetic_energy,
    compute_leg_directions,
    find_contact_slots,
    find_rebound_fraction,
    make_inverse_inertia,
    select_slot_friction,
    stop_gradients,
)
from vrw_jax.models.contact_modes import (
    ALL_MODES_MASK,
    MAX_VIOLATION,
    PAPER_RULE_SENTINEL,
    AllowedContactModes,
    ChosenModeCombination,
    ContactSignTolerances,
    LevelSolution,
    choose_combination,
    is_release_consistent,
    list_modes_after_event,
    solve_stopper_lcp,
)
from vrw_jax.models.contact_state import (
    ContactState,
    GuardLayout,
    find_kink_sides,
    select_kink_sides,
)
from vrw_jax.wheel.params import Symbols
from vrw_jax.wheel.transitions import ContactMode, GroundAhead


class ContactEvent(NamedTuple):
    """Kind of an event, as flags for legs and contact slots, in the order of `GuardLayout`.

    One flag of one leg or contact slot is True. `_merge_touching_contacts` may set further flags.
    """

    is_foot_landing: Bool[Array, "n_legs ..."]  # whether the foot meets the ground
    is_leg_meeting_stopper: Bool[Array, "n_legs ..."]  # whether the leg meets its stopper
    is_foot_lifting_off: Bool[Array, "2 ..."]  # whether the normal force on the foot vanishes
    # whether the foot in the slot begins to slide uphill
    is_starting_to_slide_up: Bool[Array, "2 ..."]
    is_starting_to_slide_down: Bool[Array, "2 ..."]
    is_stopping_to_slide: Bool[Array, "2 ..."]  # whether the foot in the slot stops sliding
    # whether the stopper force of the slot's leg vanishes
    is_releasing_stopper: Bool[Array, "2 ..."]
    # whether the stopper force of a leg in the air vanishes
    is_leg_leaving_stopper: Bool[Array, "n_legs ..."]
    # whether the function of each kink changes sign, for all legs
    is_kink_crossed: tuple[Bool[Array, "n_legs ..."], ...]

    @property
    def is_impact(self) -> Bool[Array, "..."]:
        """Return whether velocities jump at the event."""
        return jnp.any(self.is_foot_landing, axis=0) | jnp.any(self.is_leg_meeting_stopper, axis=0)


def classify_event(guard_layout: GuardLayout, guard_index: Int[Array, "..."]) -> ContactEvent:
    """Return the kind of the event at which the guard with the index `guard_index` is zero."""
    select_flags = lambda guards: guard_index == align_with_batch(np.array(guards), guard_index)
    n_legs, first_release = len(guard_layout.landing), guard_layout.airborne_release.start
    flags: list[Any] = [
        *map(select_flags, guard_layout[:7]),
        select_flags(range(first_release, first_release + n_legs)),
        tuple(select_flags(range(first, first + n_legs)) for first in guard_layout.kinks[::n_legs]),
    ]
    return ContactEvent(*flags)


class ContactLaw(NamedTuple):
    """Parameters of wheel and ground, and options of the contact law, for all events in a walk."""

    s: Symbols
    # coefficient of all feet, or a pair for the foot that landed last and the others
    friction: Friction
    has_one_sided_stoppers: bool  # whether stoppers of legs in the air only push
    counts_all_solutions: bool  # whether all admissible solutions are counted
    rest_speed: Elementwise  # speed below which a contact is at rest after an impact, m/s
    restitution: Elementwise | None = None  # Newton's coefficient of the feet
    ground_ahead: GroundAhead | None = None  # None on flat ground
    # number of events beyond `contact_kernel.N_EVENTS_BEFORE_REST_SPEED_RAMP`
    n_late_events: Int[Array, "..."] | int = 0

    @property
    def stopper_rest_speed(self) -> Elementwise:
        """Return the speed below which a leg stays on its stopper after an impact, m/s."""
        return self.rest_speed * (1 + self.n_late_events)


class ContactEventResult(NamedTuple):
    """Motion and contact state after an event, with impulses and lost energy."""

    motion: WheelMotion
    contact_state: ContactState
    impact_energy_loss: Elementwise  # J
    normal_impulse: SlotArray  # impulses on the feet in the contact slots, N s
    tangential_impulse: SlotArray
    stopper_impulse: Elementwise  # minimum over airborne locked legs, N s; inf without impact
    n_solutions: Int[Array, "..."]  # number of admissible combinations: minimum of both levels
    is_painleve_paradox: Bool[Array, "..."]  # whether no forces can continue the motion
    max_n_solutions: Int[Array, "..."]
    has_third_foot: Bool[Array, "..."]  # whether a third foot would have to be loaded


def _apply_impact_velocities(
    motion: WheelMotion, force_solution: WheelForceSolution
) -> WheelMotion:
    """Return the motion with the velocities after an impact."""
    vx, vz, dtheta = force_solution.hub_motion
    return motion._replace(vx=vx, vz=vz, dtheta=dtheta, dL=force_solution.length_motion)


def _apply_restitution(
    contact_law: ContactLaw,
    motion: WheelMotion,
    contact_slots: ContactSlots,
    inverse_inertia: ContactInverseInertia,
    free_motion: FreeMotion,
) -> FreeMotion:
    """Return the velocities without impulses, corrected for the rebound of striking feet.

    The rebound speeds follow from Newton's law of restitution.
    """
    if contact_law.restitution is None:
        return free_motion
    rebound_speeds = (
        contact_law.restitution
        * compute_contact_foot_velocities(
            motion, inverse_inertia.leg_directions, contact_slots
        ).normal_to_slope
    )
    # A foot whose rebound is slower than the rest speed is at rest. After many events, restitution
    # ends sooner than small motions of legs: an inelastic landing pushes, but the impulse that
    # keeps a leg on its stopper may pull on the feet.
    min_rebound_speed = contact_law.rest_speed * (1 + contact_law.n_late_events**2)
    rebound_speeds = jnp.where(rebound_speeds < -min_rebound_speed, rebound_speeds, 0.0)
    return free_motion._replace(
        foot_transverse_motion=free_motion.foot_transverse_motion
        - inverse_inertia.sin * rebound_speeds,
        foot_radial_motion=free_motion.foot_radial_motion + inverse_inertia.cos * rebound_speeds,
    )


def _solve_level(
    contact_law: ContactLaw,
    motion: WheelMotion,
    contact_slots: ContactSlots,
    stoppers: tuple[Array, Array],
    tolerances: ContactSignTolerances,
    compute_free_motion: Callable[..., FreeMotion],
    list_allowed_modes: Callable[..., AllowedContactModes],
    is_impact: bool,
) -> tuple[LevelSolution, Bool[Array, "n ..."]]:
    """Return the solution of a level, and whether each leg in the air is held on its stopper.

    - `stoppers`: whether each leg in the air is on its stopper, and whether its stopper is tested;
    - `compute_free_motion`: function of the contact law, the motion and the inverse inertia;
    - `list_allowed_modes`: function of the inverse inertia and the free motion;
    - `is_impact`: whether velocities are solved for.
    """

    def solve(
        contact_law: ContactLaw,
        motion: WheelMotion,
        is_airborne_leg_locked: Array,
        chosen_combination: ChosenModeCombination | None,
    ) -> LevelSolution:
        s, friction = contact_law.s, select_slot_friction(contact_law.friction, contact_slots)
        inverse_inertia = make_inverse_inertia(s, motion, contact_slots, is_airborne_leg_locked)
        free_motion = compute_free_motion(contact_law, motion, inverse_inertia)
        if chosen_combination is None:
            chosen_combination = choose_combination(
                s,
                inverse_inertia,
                free_motion,
                list_allowed_modes(inverse_inertia, free_motion),
                friction,
                tolerances,
                contact_law.counts_all_solutions,
            )
        contact_configuration = ContactConfiguration(
            s,
            friction,
            contact_slots,
            *chosen_combination[:2],
            is_airborne_leg_locked,
            motion,
        )
        force_solution = (
            solve_impact(contact_configuration)
            if is_impact and contact_law.restitution is None
            else solve_contact_configuration(contact_configuration, inverse_inertia, free_motion)
        )
        sin, cos = inverse_inertia.leg_directions
        x, z, _ = force_solution.hub_motion
        if is_impact:
            contact_impulse = s.m * (sin * (x - motion.vx) + cos * (z - motion.vz) + motion.dL)
            stopper_motion = contact_impulse, force_solution.length_motion
        else:
            outward_leg_motion = free_motion.leg_motion + sin * x + cos * z
            stopper_motion = s.m * outward_leg_motion, outward_leg_motion
        return LevelSolution(chosen_combination, force_solution, *stopper_motion)

    return solve_stopper_lcp(solve, contact_law, motion, *stoppers, tolerances)


def _solve_velocity_level(
    contact_law: ContactLaw,
    motion: WheelMotion,
    contact_state: ContactState,
    contact_event: ContactEvent,
) -> tuple[LevelSolution, ContactSlots, Bool[Array, "n ..."]]:
    """Return the solution of an impact in which all contacts strike at once.

    Coulomb's law applies to impulses. The result is (solution, contact slots, whether each leg in
    the air is held by its stopper). A one-sided stopper holds a leg only if it does not have to
    pull. By the rule of the paper, resting feet stay at rest when a leg reaches its stopper.
    """
    s = contact_law.s
    contact_slots = find_contact_slots(
        (contact_state.contact_modes != ContactMode.OFF) | contact_event.is_foot_landing
    )
    friction = select_slot_friction(contact_law.friction, contact_slots)
    is_at_stopper = contact_state.is_leg_locked | contact_event.is_leg_meeting_stopper
    is_loaded = jnp.any(contact_slots.slot_masks, axis=1)
    is_slot_locked = contact_slots.gather_flags_from_legs(is_at_stopper)
    slot_modes = contact_slots.gather_from_legs(contact_state.contact_modes)
    is_landing = jnp.any(contact_event.is_foot_landing, axis=0)
    is_kept_at_rest = (
        (slot_modes == ContactMode.STICK) & ~is_landing & (friction == PAPER_RULE_SENTINEL)
    )
    allowed_slot_modes = jnp.where(is_loaded, ALL_MODES_MASK, 1 << ContactMode.OFF).astype(
        jnp.int32
    )
    allowed_slot_modes = jnp.where(is_kept_at_rest, 1 << slot_modes, allowed_slot_modes)
    allowed_contact_modes = AllowedContactModes(
        allowed_slot_modes=jnp.where(
            contact_event.is_impact, allowed_slot_modes, 0
        ),  # Without an impact, no mode is examined.
        can_hold_stopper=is_slot_locked,
        is_foot_mode_fixed=is_kept_at_rest,
        untested_slot_modes=jnp.where(is_loaded, 0, 1 << ContactMode.OFF).astype(jnp.int32),
        is_open_stopper_untested=~is_slot_locked,
    )
    tolerances = ContactSignTolerances(
        s.m * contact_law.rest_speed / MAX_VIOLATION,
        contact_law.stopper_rest_speed / MAX_VIOLATION,
    )

    is_airborne_leg_locked = is_at_stopper & ~contact_slots.is_in_slot
    level_solution, is_held_airborne = _solve_level(
        contact_law,
        motion,
        contact_slots,
        (is_airborne_leg_locked, is_airborne_leg_locked & contact_event.is_impact),
        tolerances,
        lambda contact_law, motion, inverse_inertia: _apply_restitution(
            contact_law,
            motion,
            contact_slots,
            inverse_inertia,
            compute_free_velocity(contact_law.s, motion, contact_slots, inverse_inertia),
        ),
        lambda *_: allowed_contact_modes,
        is_impact=True,
    )
    if contact_law.restitution is not None:
        inelastic_solution, *_ = _solve_velocity_level(
            contact_law._replace(restitution=None), motion, contact_state, contact_event
        )
        has_energy_gain, fraction = find_rebound_fraction(
            s,
            motion,
            _apply_impact_velocities(motion, inelastic_solution.force_solution),
            _apply_impact_velocities(motion, level_solution.force_solution),
        )
        # Between both impacts, impulses stay in the friction cone, because the cone is convex.
        interpolate = lambda a, b: jnp.where(has_energy_gain, a + fraction * (b - a), b)
        level_solution = LevelSolution(
            level_solution.chosen_combination,
            *jax.tree.map(interpolate, inelastic_solution[1:], level_solution[1:]),
        )
    return level_solution, contact_slots, is_held_airborne


FORCE_ROUNDOFF_FRACTION = 1e-9
"""Fraction of the wheel's weight below which a force is treated as zero.

The same fraction of gravity applies to accelerations. The value is chosen because forces are
accurate to round-off.
"""


def _solve_acceleration_level(
    contact_law: ContactLaw,
    motion: WheelMotion,
    contact_modes: Int[Array, "n ..."],
    is_at_stopper: Array,
    contact_event: ContactEvent,
) -> tuple[ChosenModeCombination, ContactSlots, Array, Bool[Array, "n ..."]]:
    """Return the contact modes and stoppers for the motion after an event.

    The accelerations determine modes and stoppers. The result is (combination, contact slots,
    whether each foot was at rest, whether each leg in the air is held by its stopper), without
    derivatives.

    The contact that the event has ended is not tested again, because its force is zero within
    round-off. Its new mode is the mode of its release if that mode is consistent (see
    `is_release_consistent`).
    """
    contact_law, motion = stop_gradients((contact_law, motion))
    s = contact_law.s
    friction, contact_slots, slot_modes, is_slot_locked, is_airborne_leg_locked = (
        find_slot_contacts(contact_law.friction, contact_modes, is_at_stopper)
    )
    was_resting = (slot_modes == ContactMode.STICK) | contact_event.is_stopping_to_slide
    # When such a foot is released, its tangential force jumps to zero.
    follows_paper_rule = (slot_modes == ContactMode.STICK) & (friction == PAPER_RULE_SENTINEL)
    is_starting_to_slide_up = contact_event.is_starting_to_slide_up
    is_starting_to_slide_down = contact_event.is_starting_to_slide_down
    is_released = (
        contact_event.is_foot_lifting_off | is_starting_to_slide_up | is_starting_to_slide_down
    )
    is_in_any_slot = lambda event_flags: jnp.any(event_flags, axis=0).astype(jnp.int32)
    release_direction = is_in_any_slot(is_starting_to_slide_down) - is_in_any_slot(
        is_starting_to_slide_up
    )
    may_leave_stopper = ~is_slot_locked | contact_event.is_releasing_stopper
    tolerances = ContactSignTolerances(
        FORCE_ROUNDOFF_FRACTION * s.Mt * s.g, FORCE_ROUNDOFF_FRACTION * s.g
    )

    def list_allowed_modes(
        inverse_inertia: ContactInverseInertia, free_motion: FreeMotion
    ) -> AllowedContactModes:
        is_consistent = is_release_consistent(
            s,
            inverse_inertia,
            free_motion,
            (slot_modes, is_slot_locked),
            friction,
            is_released,
            release_direction,
        )
        possible_modes, untested_slot_modes = list_modes_after_event(
            contact_event, slot_modes, is_consistent & ~follows_paper_rule, follows_paper_rule
        )
        return AllowedContactModes(
            possible_modes,
            ~may_leave_stopper,
            was_resting & False,
            untested_slot_modes,
            may_leave_stopper,
        )

    level_solution, is_held_airborne = _solve_level(
        contact_law,
        motion,
        contact_slots,
        (is_airborne_leg_locked, is_airborne_leg_locked),
        tolerances,
        lambda contact_law, motion, inverse_inertia: compute_free_acceleration(
            contact_law.s, motion, contact_slots, inverse_inertia
        ),
        list_allowed_modes,
        is_impact=False,
    )
    return level_solution.chosen_combination, contact_slots, was_resting, is_held_airborne


def _bring_slow_contacts_to_rest(
    contact_law: ContactLaw,
    motion: WheelMotion,
    contact_slots: ContactSlots,
    contact_modes: Array,
    is_at_stopper: Array,
    was_at_stopper: Array,
) -> tuple[WheelMotion, Array, Array]:
    """Return the motion after an impact with slow contacts at rest, and the new modes and stoppers.

    The modes are those of the touching feet. A contact slower than `ContactLaw.rest_speed` after
    the impact is brought to rest. Otherwise its bounces would be too small to resolve, and their
    number would be unlimited. The forces then determine the contacts in the subsequent motion.

    The impulses that bring contacts to rest have no friction. They may pull, by about the mass that
    stops times its speed, and the later support force makes up for the pull.

    - `contact_modes`: contact mode of each foot after the impact;
    - `is_at_stopper`, `was_at_stopper`: whether each leg is on its stopper after and before the
      impact.
    """
    leg_directions = compute_leg_directions(contact_law.s, motion.theta)
    tangential_speed, normal_speed = compute_foot_velocities(motion, leg_directions)
    stays_in_contact = contact_slots.is_in_slot & (normal_speed < contact_law.rest_speed)
    slip_mode = jnp.where(tangential_speed > 0.0, ContactMode.SLIP_DOWN, ContactMode.SLIP_UP)
    comes_to_rest = jnp.abs(tangential_speed) < contact_law.rest_speed
    modes_after_rest = jnp.where(
        stays_in_contact,
        jnp.where(
            (contact_modes == ContactMode.STICK) | comes_to_rest, ContactMode.STICK, slip_mode
        ),
        ContactMode.OFF,
    )
    is_leg_locked = is_at_stopper | (
        was_at_stopper & (jnp.abs(motion.dL) < contact_law.stopper_rest_speed)
    )
    has_contact_changed = jnp.any(
        (modes_after_rest != contact_modes) | (is_leg_locked != is_at_stopper), axis=0
    )
    s, frozen_motion = stop_gradients((contact_law.s, motion))

    def find_reversed_slip(_: Array) -> Array:
        """Return whether the projection reverses the slip of a foot, which then comes to rest."""
        slip_speed_after, _ = compute_foot_velocities(
            project_motion(s, frozen_motion, modes_after_rest, is_leg_locked),
            leg_directions,
        )
        return ((modes_after_rest == ContactMode.SLIP_DOWN) & (slip_speed_after < 0.0)) | (
            (modes_after_rest == ContactMode.SLIP_UP) & (slip_speed_after > 0.0)
        )

    is_slip_reversed = has_contact_changed & run_if_any_element_active(
        jnp.any(has_contact_changed), find_reversed_slip, is_leg_locked & False
    )
    modes_after_rest = jnp.where(is_slip_reversed, ContactMode.STICK, modes_after_rest)
    return (
        select_trees_by_condition(
            has_contact_changed,
            project_motion(contact_law.s, motion, modes_after_rest, is_leg_locked),
            motion,
        ),
        modes_after_rest,
        is_leg_locked,
    )


def _merge_touching_contacts(
    contact_law: ContactLaw,
    motion: WheelMotion,
    contact_state: ContactState,
    contact_event: ContactEvent,
) -> ContactEvent:
    """Return the event extended by all other contacts that touch.

    A contact touches if its distance is below the smallest resolved bounce and it does not
    separate. If such contacts were resolved one after another, each impact would cause the next one
    without end.
    """
    s, leg_directions = contact_law.s, compute_leg_directions(contact_law.s, motion.theta)
    bounce_height = contact_law.rest_speed**2 / (2.0 * s.g)
    foot_heights = compute_foot_heights(motion, leg_directions, contact_law.ground_ahead)
    is_touching = (foot_heights <= bounce_height) & (
        compute_foot_velocities(motion, leg_directions).normal_to_slope <= contact_law.rest_speed
    )
    is_foot_landing = contact_event.is_foot_landing | (
        is_touching & (contact_state.contact_modes == ContactMode.OFF) & contact_event.is_impact
    )
    is_loaded = is_foot_landing | (contact_state.contact_modes != ContactMode.OFF)
    fits_two_slots = jnp.sum(is_loaded, axis=0, dtype=jnp.int32) <= 2
    has_more_contacts = (bounce_height >= s.L0 - motion.L) & (
        motion.dL >= -contact_law.stopper_rest_speed
    )
    is_leg_meeting_stopper = contact_event.is_leg_meeting_stopper | (
        has_more_contacts & ~contact_state.is_leg_locked & contact_event.is_impact
    )
    return contact_event._replace(
        is_foot_landing=jnp.where(fits_two_slots, is_foot_landing, contact_event.is_foot_landing),
        is_leg_meeting_stopper=is_leg_meeting_stopper,
    )


def _replace_liftoff_by_slip(
    contact_law: ContactLaw,
    motion: WheelMotion,
    contact_state: ContactState,
    contact_event: ContactEvent,
) -> ContactEvent:
    """Return the event with lift-off replaced by sliding, in the limit of large friction.

    A resting foot whose normal force vanishes begins to slide against the direction of its
    tangential force.
    """
    contact_law, motion = stop_gradients((contact_law, motion))
    contact_configuration = ContactConfiguration(
        contact_law.s, *find_slot_contacts(contact_law.friction, *contact_state[:2]), motion
    )
    is_starting_to_slide = (
        contact_event.is_foot_lifting_off
        & (contact_configuration.slot_modes == ContactMode.STICK)
        & (contact_configuration.friction == jnp.inf)
    )
    tangential_forces = run_if_any_element_active(
        jnp.any(is_starting_to_slide),
        lambda _: solve_contact_forces(contact_configuration).tangential_forces,
        jnp.zeros_like(contact_configuration.friction),
    )
    slides_up = is_starting_to_slide & (tangential_forces > 0.0)
    slides_down = is_starting_to_slide & ~(tangential_forces > 0.0)
    return contact_event._replace(
        is_foot_lifting_off=contact_event.is_foot_lifting_off & ~is_starting_to_slide,
        is_starting_to_slide_up=contact_event.is_starting_to_slide_up | slides_up,
        is_starting_to_slide_down=contact_event.is_starting_to_slide_down | slides_down,
    )


def _update_kink_sides(
    s: Symbols,
    motion: WheelMotion,
    is_at_stopper: Array,
    contact_state: ContactState,
    contact_event: ContactEvent,
) -> tuple[Array, ...]:
    """Return the sides of the kinks after an event.

    An impact changes rates, on which the functions of kinks may depend.

    - `motion`, `is_at_stopper`: motion and stoppers after the impact, if there is one.
    """
    if not contact_state.is_kink_positive:
        return ()
    L, dL = jnp.where(is_at_stopper, s.L0, motion.L), jnp.where(is_at_stopper, 0.0, motion.dL)
    sides_after_impact = find_kink_sides(s, L, dL)
    return tuple(
        jnp.where(contact_event.is_impact, after_impact, before ^ is_crossed)
        for after_impact, before, is_crossed in zip(
            sides_after_impact,
            contact_state.is_kink_positive,
            contact_event.is_kink_crossed,
            strict=True,
        )
    )


def _scatter_combination(
    contact_slots: ContactSlots,
    chosen_combination: ChosenModeCombination,
    is_airborne_leg_held: Array,
) -> tuple[Int[Array, "n ..."], Bool[Array, "n ..."]]:
    """Return the contact mode of each foot, and whether each leg is on its stopper."""
    contact_modes = contact_slots.scatter_to_legs(chosen_combination.slot_modes).astype(jnp.int32)
    is_slot_leg_held = contact_slots.scatter_to_legs(chosen_combination.is_stopper_holding) > 0
    return contact_modes, jnp.where(
        contact_slots.is_in_slot, is_slot_leg_held, is_airborne_leg_held
    )


def resolve_event(
    contact_law: ContactLaw,
    motion: WheelMotion,
    contact_state: ContactState,
    contact_event: ContactEvent,
) -> ContactEventResult:
    """Return motion and contact state after an event, with the impulses and the lost energy."""
    contact_event = _replace_liftoff_by_slip(contact_law, motion, contact_state, contact_event)
    contact_event = _merge_touching_contacts(contact_law, motion, contact_state, contact_event)
    s, is_impact = contact_law.s, contact_event.is_impact
    was_touching = (contact_state.contact_modes != ContactMode.OFF) | contact_event.is_foot_landing
    was_held = contact_state.is_leg_locked | contact_event.is_leg_meeting_stopper
    was_at_stopper = was_held & ~contact_event.is_leg_leaving_stopper
    velocity_solution, contact_slots, is_stopper_holding = _solve_velocity_level(
        contact_law, motion, contact_state, contact_event
    )
    force_solution = velocity_solution.force_solution
    impact_modes, stays_at_stopper = _scatter_combination(
        contact_slots, velocity_solution.chosen_combination, was_at_stopper & is_stopper_holding
    )
    if contact_law.restitution is not None:  # Only a part of the impulse may act.
        stays_at_stopper = stays_at_stopper & (
            jnp.abs(force_solution.length_motion) < contact_law.stopper_rest_speed
        )
    slow_contact_result = _bring_slow_contacts_to_rest(
        contact_law,
        _apply_impact_velocities(motion, force_solution),
        contact_slots,
        impact_modes,
        stays_at_stopper,
        was_at_stopper,
    )
    motion_after, contact_modes, is_at_stopper = select_trees_by_condition(
        is_impact, slow_contact_result, (motion, contact_state.contact_modes, was_at_stopper)
    )
    _, normal_speeds = compute_foot_velocities(
        motion_after, compute_leg_directions(s, motion.theta)
    )
    is_without_slot = was_touching & ~contact_slots.is_in_slot
    stopper_impulse = jnp.where(is_stopper_holding, velocity_solution.stopper_forces, jnp.inf)
    is_kink_positive = _update_kink_sides(
        s, motion_after, is_at_stopper, contact_state, contact_event
    )
    contact_law = contact_law._replace(s=select_kink_sides(s, is_kink_positive))
    next_combination, contact_slots, was_resting, is_stopper_holding = _solve_acceleration_level(
        contact_law, motion_after, contact_modes, is_at_stopper, contact_event
    )
    contact_modes, is_leg_locked = _scatter_combination(
        contact_slots, next_combination, is_at_stopper & is_stopper_holding
    )
    is_sliding = compute_slip_signs(next_combination.slot_modes) != 0.0
    contact_state = ContactState(
        contact_modes=contact_modes,
        is_leg_locked=is_leg_locked,
        has_just_lifted=was_touching & (contact_modes == ContactMode.OFF),
        has_just_unlocked=was_held & ~is_leg_locked,
        has_just_slid=contact_slots.scatter_to_legs(is_sliding & was_resting) > 0,
        is_kink_positive=is_kink_positive,
    )
    n_impact_solutions = velocity_solution.chosen_combination.n_solutions
    n_force_solutions = next_combination.n_solutions
    count_both = lambda select: jnp.where(
        is_impact, select(n_impact_solutions, n_force_solutions), n_force_solutions
    )
    zero_without_impact = lambda impact_value: jnp.where(is_impact, impact_value, 0.0)
    return ContactEventResult(
        motion=motion_after._replace(
            L=jnp.where(is_leg_locked, s.L0, motion_after.L),
            dL=jnp.where(is_leg_locked, 0.0, motion_after.dL),
        ),
        contact_state=contact_state,
        impact_energy_loss=zero_without_impact(
            compute_kinetic_energy(s, motion) - compute_kinetic_energy(s, motion_after)
        ),
        normal_impulse=zero_without_impact(force_solution.normal_forces),
        tangential_impulse=zero_without_impact(force_solution.tangential_forces),
        stopper_impulse=jnp.where(is_impact, jnp.min(stopper_impulse, axis=0), jnp.inf),
        n_solutions=count_both(jnp.minimum),
        is_painleve_paradox=(n_force_solutions == 0) & ((n_impact_solutions > 0) | ~is_impact),
        max_n_solutions=count_both(jnp.maximum),
        has_third_foot=jnp.any(is_without_slot & (normal_speeds < 0.0), axis=0) & is_impact,
    )


def project_motion(
    s: Symbols,
    motion: WheelMotion,
    contact_modes: Int[Array, "n ..."],
    is_leg_locked: Bool[Array, "n ..."],
) -> WheelMotion:
    """Return the motion projected onto the constraints of its contacts.

    After the projection, loaded feet are on the slope and sticking feet are at rest. Bilateral
    impulses without friction project the velocities, which never increases the energy: friction on
    a foot whose impulse pulls would. A motion that satisfies the constraints is returned unchanged
    within round-off.
    """
    leg_directions = compute_leg_directions(s, motion.theta)
    L = jnp.where(
        (contact_modes != ContactMode.OFF) & ~is_leg_locked, motion.z / leg_directions.cos, motion.L
    )
    motion = motion._replace(L=jnp.where(is_leg_locked, s.L0, L))
    contact_configuration = ContactConfiguration(
        s, *find_slot_contacts(0.0, contact_modes, is_leg_locked), motion
    )
    is_sticking = contact_configuration.slot_modes == ContactMode.STICK
    is_first_held, is_second_held = contact_configuration.is_stopper_holding
    # Two resting feet on two held legs would constrain the hub twice.
    is_overdetermined = jnp.all(is_sticking & contact_configuration.is_stopper_holding, axis=0)
    contact_configuration = contact_configuration._replace(
        is_stopper_holding=jnp.stack([is_first_held, is_second_held & ~is_overdetermined])
    )
    projected_motion = _apply_impact_velocities(motion, solve_impact(contact_configuration))
    return projected_motion._replace(dL=jnp.where(is_leg_locked, 0.0, projected_motion.dL))
