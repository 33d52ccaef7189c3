"""Effects of an event: impacts by momentum, then the contact modes that carry the motion.

Everything is elementwise: for one wheel or a batch.
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
    solve_impact,
    solve_motion,
)
from vrw_jax.contact.mechanics import (
    ContactInverseInertia,
    FreeMotion,
    LegArray,
    SlotPair,
    Slots,
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
from vrw_jax.numerics import Elementwise, run_if_any, tree_where
from vrw_jax.wheel import Symbols


class Event(NamedTuple):
    """Kind of an event: one flag is set."""

    lands: Bool[Array, "n_legs ..."]  # the foot meets the ground
    meets_stopper: Bool[Array, "n_legs ..."]  # the leg meets its stopper
    leaves_stopper: Bool[Array, "n_legs ..."]  # in the air, the stopper force vanishes
    lifts_off: Bool[Array, "2 ..."]  # the slot's normal force vanishes
    slides_up: Bool[Array, "2 ..."]  # friction no longer holds the slot's foot
    slides_down: Bool[Array, "2 ..."]
    stops_sliding: Bool[Array, "2 ..."]  # the slot's foot stops sliding
    releases_stopper: Bool[Array, "2 ..."]  # the stopper force of the slot's leg vanishes

    @property
    def is_impact(self) -> Bool[Array, "..."]:
        """Whether velocities jump."""
        return jnp.any(self.lands, axis=0) | jnp.any(self.meets_stopper, axis=0)


def _index_column(n: int, reference: Array) -> np.ndarray:
    """Return 0 ... n - 1 on the first axis, for arrays of this shape."""
    return np.arange(n, dtype=np.int32).reshape(-1, *(1,) * jnp.ndim(reference))


def classify_event(layout: GuardLayout, guard: Int[Array, "..."]) -> Event:
    """Return the event of a guard."""
    n = layout.n_legs
    select_flags = lambda start, count: guard == start + _index_column(count, guard)
    leaves_stopper = (
        select_flags(layout.airborne_release, n)
        if layout.total > layout.airborne_release
        else select_flags(layout.landing, n) & False
    )
    return Event(
        lands=select_flags(layout.landing, n),
        meets_stopper=select_flags(layout.stopper, n),
        leaves_stopper=leaves_stopper,
        lifts_off=select_flags(layout.liftoff, 2),
        slides_up=select_flags(layout.slip_up, 2),
        slides_down=select_flags(layout.slip_down, 2),
        stops_sliding=select_flags(layout.slip_stop, 2),
        releases_stopper=select_flags(layout.stopper_release, 2),
    )


class ContactLaw(NamedTuple):
    """The wheel on its ground, with the settings that all events share."""

    s: Symbols
    friction: Friction  # of all feet; or (of the last landed foot, of the others)
    is_one_sided: bool  # stoppers of legs in the air only push
    counts_solutions: bool  # whether all admissible solutions are counted
    rest_speed: Elementwise  # contacts slower than this after an impact are at rest, m/s
    restitution: Elementwise | None = None  # of the feet: speed ratio
    tilt: Elementwise | None = None  # by which the next line is steeper, rad


@dataclass(frozen=True)
class PivotOptions:
    """Search for the stoppers that hold their legs; few pivots suffice unless friction couples
    legs.
    """

    max_block_pivots: int = 8
    """Number of pivots that switch all legs of the wrong sign."""
    max_single_pivots: int = 16
    """Number of pivots after them that switch one leg."""
    max_enumerated_legs: int = 8
    """Largest number of legs whose combinations are enumerated if pivoting fails."""


PIVOT_OPTIONS = PivotOptions()


class _LevelSolution(NamedTuple):
    """Solution for an assumed set of held legs in the air."""

    chosen: ChosenCombination
    solution: ForceSolution
    stopper_push: LegArray  # of the stoppers, N or N s
    outward: LegArray  # of the legs, m/s^2 or m/s
    motion: WheelMotion  # of an impact: after it


_LevelSolver = Callable[[ContactLaw, WheelMotion, Array, ChosenCombination | None], _LevelSolution]
"""Function of the held legs in the air and, if known, of the chosen combination."""


def _solve_stopper_lcp(
    solve: _LevelSolver,
    law: ContactLaw,
    motion: WheelMotion,
    at_stopper: Array,
    is_tested: Array,
    tolerances: SignTolerances,
    options: PivotOptions = PIVOT_OPTIONS,
) -> tuple[_LevelSolution, Array]:
    """Return the solution for the legs in the air that are held, and which legs are held.

    Of the legs `at_stopper`, those in `is_tested` are held if their stopper pushes; otherwise they
    move inwards. All legs of the wrong sign switch together. Then, against cycling, only the last
    one switches. This is principal pivoting, which is finite if no friction couples the legs (Murty
    1974, Kostreva 1978). After that, all combinations are enumerated. The least violating solution
    is taken; it is admissible if its violation is at most `MAX_VIOLATION`.
    """
    frozen = stop_gradients((law, motion))
    rank = jnp.cumsum(is_tested.astype(jnp.int32), axis=0) - 1
    n_combinations = 1 << jnp.minimum(
        jnp.sum(is_tested, axis=0, dtype=jnp.int32), options.max_enumerated_legs
    )
    leg_index = _index_column(len(at_stopper), n_combinations)

    def is_unfinished(state: tuple) -> Array:
        _, code, n_tries, best = state
        return (n_tries == 0) | ((best[0] > 1.0) & (code < n_combinations))

    def pivot(state: tuple) -> tuple:
        held, code, n_tries, best = state
        level = solve(frozen[0], frozen[1], held, None)
        violation = jnp.where(
            held, -level.stopper_push / tolerances.force, level.outward / tolerances.motion
        )
        violation = jnp.where(is_tested, lax.stop_gradient(violation), 0.0)
        is_violated = violation > 1.0
        max_violation = jnp.maximum(jnp.max(violation, axis=0), level.chosen.violation)
        best = tree_where(max_violation < best[0], (max_violation, held, level.chosen), best)
        is_last = leg_index == jnp.max(jnp.where(is_violated, leg_index, -1), axis=0)
        switched = held ^ jnp.where(n_tries < options.max_block_pivots, is_violated, is_last)
        is_pivoting = (
            (code < 0)
            & jnp.any(is_violated, axis=0)
            & (n_tries < options.max_block_pivots + options.max_single_pivots)
        )
        code = jnp.where(is_pivoting, code, code + 1)
        enumerated = jnp.where(is_tested, ((code >> rank) & 1) == 1, at_stopper)
        return tree_where(
            is_unfinished(state),
            (jnp.where(is_pivoting, switched, enumerated), code, n_tries + 1, best),
            state,
        )

    zeros = jnp.zeros_like(n_combinations)
    slot_zeros = jnp.stack([n_combinations, n_combinations]) * 0
    infinite = jnp.full_like(frozen[1].theta, jnp.inf)
    initial = (
        at_stopper,
        zeros - 1,
        zeros,
        (infinite, at_stopper, ChosenCombination(slot_zeros, slot_zeros > 0, infinite, zeros)),
    )
    final = lax.while_loop(lambda state: jnp.any(is_unfinished(state)), pivot, initial)
    max_violation, held, chosen = final[3]
    chosen = chosen._replace(
        n_solutions=jnp.where(max_violation <= MAX_VIOLATION, chosen.n_solutions, 0)
    )
    return solve(law, motion, held, chosen), held


class EventResult(NamedTuple):
    """Result of an event."""

    motion: WheelMotion
    contact_state: ContactState
    energy_lost: Elementwise  # J
    normal_impulse: SlotPair  # on the slots' feet, N s
    tangential_impulse: SlotPair
    stopper_impulse: Elementwise  # minimum over airborne locked legs, N s; inf without an impact
    n_solutions: Int[Array, "..."]  # admissible combinations: the minimum of both levels
    is_paradox: Bool[Array, "..."]  # no forces can continue the motion
    most_solutions: Int[Array, "..."]
    has_third_foot: Bool[Array, "..."]  # a third foot would have to be loaded


def _motion_after_impact(motion: WheelMotion, solution: ForceSolution) -> WheelMotion:
    """Return the motion with the velocities of an impact's solution."""
    vx, vz, dtheta = solution.hub
    return motion._replace(vx=vx, vz=vz, dtheta=dtheta, dL=solution.lengths)


def _apply_restitution(
    law: ContactLaw,
    motion: WheelMotion,
    slots: Slots,
    inertia: ContactInverseInertia,
    free: FreeMotion,
) -> FreeMotion:
    """Return the free velocities with the rebound of striking feet by Newton's law."""
    if law.restitution is None:
        return free
    rebound = [law.restitution * z for z in foot_velocity(motion, slots, inertia).z]
    # A rebound slower than the rest speed is at rest.
    rebound = [jnp.where(z < -law.rest_speed, z, 0.0) for z in rebound]
    return free._replace(
        foot_e=(
            free.foot_e[0] - inertia.sin[0] * rebound[0],
            free.foot_e[1] - inertia.sin[1] * rebound[1],
        ),
        foot_u=(
            free.foot_u[0] + inertia.cos[0] * rebound[0],
            free.foot_u[1] + inertia.cos[1] * rebound[1],
        ),
    )


def _limit_energy_gain(
    law: ContactLaw, motion: WheelMotion, restituted: _LevelSolution, inelastic: _LevelSolution
) -> _LevelSolution:
    """Return the part of Newton's rebound that energy allows.

    With Coulomb's friction the law can create energy (Kane 1984). Energy is a parabola between the
    inelastic impact, which cannot create any, and Newton's. The result is the largest part without
    a gain. Impulses stay in the cone, because it is convex.
    """
    kinetic = lambda state: kinetic_energy(law.s, state)
    energy_inelastic, energy_restituted = kinetic(inelastic.motion), kinetic(restituted.motion)
    energy_midpoint = kinetic(
        jax.tree.map(lambda a, b: 0.5 * (a + b), inelastic.motion, restituted.motion)
    )
    curvature = 2.0 * (energy_inelastic - 2.0 * energy_midpoint + energy_restituted)
    linear_term = 4.0 * energy_midpoint - 3.0 * energy_inelastic - energy_restituted
    allowed_gain = jnp.maximum(kinetic(motion) - energy_inelastic, 0.0)
    has_gain = energy_restituted > kinetic(motion)
    root = jnp.sqrt(
        jnp.where(has_gain, linear_term * linear_term + 4.0 * curvature * allowed_gain, 1.0)
    )
    fraction = jnp.where(
        has_gain, 2.0 * allowed_gain / jnp.where(has_gain, linear_term + root, 1.0), 1.0
    )
    interpolate = lambda a, b: jnp.where(has_gain, a + fraction * (b - a), b)
    return _LevelSolution(
        restituted.chosen, *jax.tree.map(interpolate, inelastic[1:], restituted[1:])
    )


def _solve_velocity_level(
    law: ContactLaw, motion: WheelMotion, contact_state: ContactState, event: Event
) -> tuple[_LevelSolution, Slots, Bool[Array, "n ..."]]:
    """Return the velocity-level solution: simultaneous and inelastic, with Coulomb's law for
    impulses.

    It also returns the held legs in the air: with one-sided stoppers, those that need not pull. The
    paper's rule keeps resting feet planted when a leg meets its stopper.
    """
    s, slots = law.s, find_slots((contact_state.contact != ContactMode.OFF) | event.lands)
    friction = slot_friction(law.friction, slots)
    at_stopper = contact_state.locked | event.meets_stopper
    is_loaded = jnp.stack([jnp.any(slots.first, axis=0), jnp.any(slots.second, axis=0)])
    slot_locked = slots.gather_flags(at_stopper)
    slot_modes = slots.gather_codes(contact_state.contact)
    is_landing = jnp.any(event.lands, axis=0)
    is_planted = (
        (slot_modes == ContactMode.STICK)
        & ~is_landing
        & (stack_friction(friction) == PAPER_RULE_SENTINEL)
    )
    modes = jnp.where(is_loaded, ALL_MODES_MASK, 1 << ContactMode.OFF).astype(jnp.int32)
    modes = jnp.where(is_planted, 1 << slot_modes, modes)
    allowed = AllowedModes(
        contact=jnp.where(event.is_impact, modes, 0),  # without an impact, no mode is examined
        may_hold=slot_locked,
        keeps_mode=is_planted,
        untested_modes=jnp.where(is_loaded, 0, 1 << ContactMode.OFF).astype(jnp.int32),
        untested_open=~slot_locked,
    )
    tolerances = SignTolerances(
        s.m * law.rest_speed / MAX_VIOLATION, law.rest_speed / MAX_VIOLATION
    )

    def solve(
        law: ContactLaw, motion: WheelMotion, airborne: Array, chosen: ChosenCombination | None
    ) -> _LevelSolution:
        s, friction = law.s, slot_friction(law.friction, slots)
        legs = leg_directions(s, motion.theta)
        inertia = make_inverse_inertia(s, motion, slots, airborne)
        free = free_velocity(s, motion, slots, inertia)
        restituted_free = _apply_restitution(law, motion, slots, inertia, free)
        if chosen is None:
            chosen = choose_combination(
                s, inertia, restituted_free, allowed, friction, tolerances, law.counts_solutions
            )
        configuration = ContactConfiguration(
            s, motion, friction, slots, chosen.contact, chosen.held, airborne
        )
        solution = (
            solve_impact(configuration)
            if law.restitution is None
            else solve_configuration(configuration, inertia, restituted_free)
        )
        motion_after = _motion_after_impact(motion, solution)
        jump_x, jump_z = motion_after.vx - motion.vx, motion_after.vz - motion.vz
        impulse = s.m * (legs.sin * jump_x + legs.cos * jump_z + motion.dL)
        return _LevelSolution(chosen, solution, impulse, motion_after.dL, motion_after)

    airborne = at_stopper & ~slots.is_filled
    if not law.is_one_sided:
        return solve(law, motion, airborne, None), slots, airborne
    is_tested = airborne & event.is_impact
    level, held = _solve_stopper_lcp(solve, law, motion, airborne, is_tested, tolerances)
    return level, slots, held


def _following_modes(
    event: Event, mode: Array, is_consistent: Array, follows_paper_rule: Array
) -> tuple[Int[Array, "2 ..."], Int[Array, "2 ..."]]:
    """Return the modes that may follow an event in each slot, and those that need no test, as bits.

    - `is_consistent`: the next mode of a slot's foot has the direction of release (see
      `is_release_consistent`).
    """
    own_bit, off_bit = 1 << mode, 1 << ContactMode.OFF
    modes = jnp.where(mode == ContactMode.STICK, ALL_MODES_MASK, own_bit | off_bit)
    reversed_bit = jnp.where(
        mode == ContactMode.SLIP_DOWN, 1 << ContactMode.SLIP_UP, 1 << ContactMode.SLIP_DOWN
    )
    modes = jnp.where(event.stops_sliding, 1 << ContactMode.STICK | off_bit | reversed_bit, modes)
    untested = jnp.where((mode == ContactMode.STICK) | event.stops_sliding, 0, own_bit)
    for flags, following, ended_bit in (
        (event.lifts_off, off_bit, own_bit),
        (event.slides_up, 1 << ContactMode.SLIP_UP, 1 << ContactMode.STICK),
        (event.slides_down, 1 << ContactMode.SLIP_DOWN, 1 << ContactMode.STICK),
    ):
        tested_bits = (
            ALL_MODES_MASK
            & ~ended_bit
            & jnp.where(is_consistent | follows_paper_rule, ALL_MODES_MASK, ~following)
        )
        modes = jnp.where(flags, jnp.where(is_consistent, following, tested_bits), modes)
        untested = jnp.where(flags, jnp.where(is_consistent, following, 0), untested)
    return modes, untested


FORCE_ROUNDOFF_FRACTION = 1e-9
"""Fraction of the wheel's weight, and of gravity, that counts as zero, chosen because forces are
accurate to rounding."""


def _solve_acceleration_level(
    law: ContactLaw,
    motion: WheelMotion,
    contact: Int[Array, "n ..."],
    at_stopper: Array,
    event: Event,
) -> tuple[ChosenCombination, Slots, Array, Bool[Array, "n ..."]]:
    """Return the acceleration-level solution: the contacts that carry the following motion.

    It also returns the feet that were at rest, and the held legs in the air. The contact that an
    event has just ended is not tested again: its force is zero up to rounding. It is followed by
    the mode of its release, if that is consistent (see `is_release_consistent`). The result has no
    derivatives.
    """
    law, motion = stop_gradients((law, motion))
    s, slots = law.s, find_slots(contact != ContactMode.OFF)
    friction = slot_friction(law.friction, slots)
    mode, slot_locked = slots.gather_codes(contact), slots.gather_flags(at_stopper)
    was_resting = (mode == ContactMode.STICK) | event.stops_sliding
    # At the release of such a foot, its tangential force jumps to zero.
    follows_paper_rule = (mode == ContactMode.STICK) & (
        stack_friction(friction) == PAPER_RULE_SENTINEL
    )
    slides_up, slides_down = event.slides_up, event.slides_down
    is_second = (event.lifts_off | slides_up | slides_down)[1]
    any_slot = lambda flags: jnp.any(flags, axis=0).astype(jnp.int32)
    direction = any_slot(slides_down) - any_slot(slides_up)
    may_open = ~slot_locked | event.releases_stopper
    tolerances = SignTolerances(FORCE_ROUNDOFF_FRACTION * s.Mt * s.g, FORCE_ROUNDOFF_FRACTION * s.g)

    def solve(
        law: ContactLaw, motion: WheelMotion, airborne: Array, chosen: ChosenCombination | None
    ) -> _LevelSolution:
        inertia = make_inverse_inertia(s, motion, slots, airborne)
        free = free_acceleration(s, motion, slots, inertia)
        if chosen is None:
            is_consistent = is_release_consistent(
                s, inertia, free, (mode, slot_locked), friction, is_second, direction
            )
            modes, untested = _following_modes(
                event, mode, is_consistent & ~follows_paper_rule, follows_paper_rule
            )
            allowed = AllowedModes(modes, ~may_open, was_resting & False, untested, may_open)
            chosen = choose_combination(
                s, inertia, free, allowed, friction, tolerances, law.counts_solutions
            )
        configuration = ContactConfiguration(
            s, motion, friction, slots, chosen.contact, chosen.held, airborne
        )
        solution = solve_configuration(configuration, inertia, free)
        ax, az, _ = solution.hub
        outward = free.legs + inertia.legs.sin * ax + inertia.legs.cos * az
        return _LevelSolution(chosen, solution, s.m * outward, outward, motion)

    airborne = at_stopper & ~slots.is_filled
    if not law.is_one_sided:
        return solve(law, motion, airborne, None).chosen, slots, was_resting, airborne
    level, held = _solve_stopper_lcp(solve, law, motion, airborne, airborne, tolerances)
    return level.chosen, slots, was_resting, held


def _bring_to_rest(
    law: ContactLaw,
    motion: WheelMotion,
    slots: Slots,
    contact: Array,
    at_stopper: Array,
    was_locked: Array,
) -> tuple[WheelMotion, Array, Array]:
    """Return the motion after an impact, the modes of the touching feet, and the legs on their
    stoppers.

    A contact slower than `ContactLaw.rest_speed` after the impact is at rest. Otherwise it would
    return after a dip too small to follow, and separate again at a lower speed, without end. The
    forces decide the contacts of the following motion.

    - `was_locked`: legs that were at their stoppers.
    """
    legs = leg_directions(law.s, motion.theta)
    tangential_speed, normal_speed = foot_speeds(motion, legs)
    stays_loaded = slots.is_filled & (normal_speed < law.rest_speed)
    slip_mode = jnp.where(tangential_speed > 0.0, ContactMode.SLIP_DOWN, ContactMode.SLIP_UP)
    mode = jnp.where(jnp.abs(tangential_speed) < law.rest_speed, ContactMode.STICK, slip_mode)
    mode = jnp.where(
        stays_loaded,
        jnp.where(contact == ContactMode.STICK, ContactMode.STICK, mode),
        ContactMode.OFF,
    )
    is_locked = at_stopper | (was_locked & (jnp.abs(motion.dL) < law.rest_speed))
    has_changed = jnp.any((mode != contact) | (is_locked != at_stopper), axis=0)
    s, frozen_motion, friction = stop_gradients((law.s, motion, law.friction))

    def find_reversed_slip(_: Array) -> Array:
        """Return the feet whose slip would be reversed by this: they come to rest as well."""
        speed_after, _ = foot_speeds(
            project_motion(s, frozen_motion, mode, is_locked, friction), legs
        )
        return ((mode == ContactMode.SLIP_DOWN) & (speed_after < 0.0)) | (
            (mode == ContactMode.SLIP_UP) & (speed_after > 0.0)
        )

    is_reversed = has_changed & run_if_any(
        jnp.any(has_changed), find_reversed_slip, is_locked & False
    )
    mode = jnp.where(is_reversed, ContactMode.STICK, mode)
    return (
        tree_where(
            has_changed, project_motion(law.s, motion, mode, is_locked, law.friction), motion
        ),
        mode,
        is_locked,
    )


def _merge_touching(
    law: ContactLaw, motion: WheelMotion, contact_state: ContactState, event: Event
) -> Event:
    """Return the event extended to everything that touches, whether or not its own guard is zero.

    A contact touches if it is closer than the smallest followed dip and does not separate. Resolved
    one by one, such contacts would throw each other off forever.
    """
    s, legs = law.s, leg_directions(law.s, motion.theta)
    dip_depth = law.rest_speed**2 / (2.0 * s.g)
    heights = foot_heights(motion, legs, law.tilt)
    is_touching = (heights <= dip_depth) & (foot_speeds(motion, legs)[1] <= law.rest_speed)
    lands = event.lands | (
        is_touching & (contact_state.contact == ContactMode.OFF) & event.is_impact
    )
    fits_slots = (
        jnp.sum(lands | (contact_state.contact != ContactMode.OFF), axis=0, dtype=jnp.int32) <= 2
    )
    is_extended = (dip_depth >= s.L0 - motion.L) & (motion.dL >= -law.rest_speed)
    meets_stopper = event.meets_stopper | (is_extended & ~contact_state.locked & event.is_impact)
    return event._replace(
        lands=jnp.where(fits_slots, lands, event.lands), meets_stopper=meets_stopper
    )


def _liftoff_to_slip(
    law: ContactLaw, motion: WheelMotion, contact_state: ContactState, event: Event
) -> Event:
    """Return the event with lift-off replaced by slip, in the limit of large friction.

    A resting foot whose normal force vanishes begins to slide in the direction that its tangential
    force no longer resists.
    """
    law, motion = stop_gradients((law, motion))
    slots = find_slots(contact_state.contact != ContactMode.OFF)
    friction, mode = slot_friction(law.friction, slots), slots.gather_codes(contact_state.contact)
    begins_slip = (
        event.lifts_off & (mode == ContactMode.STICK) & (stack_friction(friction) == jnp.inf)
    )
    slot_state = (
        slots,
        mode,
        slots.gather_flags(contact_state.locked),
        contact_state.locked & ~slots.is_filled,
    )
    tangential_forces = lambda _: (
        solve_motion(ContactConfiguration(law.s, motion, friction, *slot_state)).tangential
    )
    zeros = jnp.zeros_like(motion.theta), jnp.zeros_like(motion.theta)
    is_uphill = jnp.stack(run_if_any(jnp.any(begins_slip), tangential_forces, zeros)) > 0.0
    return event._replace(
        lifts_off=event.lifts_off & ~begins_slip,
        slides_up=event.slides_up | (begins_slip & is_uphill),
        slides_down=event.slides_down | (begins_slip & ~is_uphill),
    )


def resolve_event(
    law: ContactLaw, motion: WheelMotion, contact_state: ContactState, event: Event
) -> EventResult:
    """Return the result of an event."""
    event = _merge_touching(
        law, motion, contact_state, _liftoff_to_slip(law, motion, contact_state, event)
    )
    s, is_impact = law.s, event.is_impact
    was_touching = (contact_state.contact != ContactMode.OFF) | event.lands
    was_locked = (contact_state.locked | event.meets_stopper) & ~event.leaves_stopper
    velocity_level, slots, held = _solve_velocity_level(law, motion, contact_state, event)
    if law.restitution is not None:
        inelastic = _solve_velocity_level(
            law._replace(restitution=None), motion, contact_state, event
        )[0]
        velocity_level = _limit_energy_gain(law, motion, velocity_level, inelastic)
    impact_modes = slots.scatter(velocity_level.chosen.contact).astype(jnp.int32)
    stays_locked = jnp.where(
        slots.is_filled, slots.scatter(velocity_level.chosen.held) > 0, was_locked & held
    )
    if law.restitution is not None:  # only a part of the impulse may act
        stays_locked = stays_locked & (jnp.abs(velocity_level.motion.dL) < law.rest_speed)
    rested = _bring_to_rest(
        law, velocity_level.motion, slots, impact_modes, stays_locked, was_locked
    )
    motion_after, contact, at_stopper = tree_where(
        is_impact, rested, (motion, contact_state.contact, was_locked)
    )
    legs = leg_directions(s, motion.theta)
    has_no_slot = was_touching & ~slots.is_filled
    energy_lost = kinetic_energy(s, motion) - kinetic_energy(s, motion_after)
    stopper_impulse = jnp.where(held, velocity_level.stopper_push, jnp.inf)

    acceleration_level, slots, was_resting, held = _solve_acceleration_level(
        law, motion_after, contact, at_stopper, event
    )
    contact = slots.scatter(acceleration_level.contact).astype(jnp.int32)
    is_locked = jnp.where(
        slots.is_filled, slots.scatter(acceleration_level.held) > 0, at_stopper & held
    )
    is_sliding = (acceleration_level.contact == ContactMode.SLIP_DOWN) | (
        acceleration_level.contact == ContactMode.SLIP_UP
    )
    contact_state = ContactState(
        contact=contact,
        locked=is_locked,
        has_just_lifted=was_touching & (contact == ContactMode.OFF),
        has_just_unlocked=(contact_state.locked | event.meets_stopper) & ~is_locked,
        has_just_slid=slots.scatter(is_sliding & was_resting) > 0,
    )
    n_impact_solutions = velocity_level.chosen.n_solutions
    n_force_solutions = acceleration_level.n_solutions
    if_impact = lambda pair: (
        jnp.where(is_impact, pair[0], 0.0),
        jnp.where(is_impact, pair[1], 0.0),
    )
    return EventResult(
        motion=motion_after._replace(
            L=jnp.where(is_locked, s.L0, motion_after.L),
            dL=jnp.where(is_locked, 0.0, motion_after.dL),
        ),
        contact_state=contact_state,
        energy_lost=jnp.where(is_impact, energy_lost, 0.0),
        normal_impulse=if_impact(velocity_level.solution.normal),
        tangential_impulse=if_impact(velocity_level.solution.tangential),
        stopper_impulse=jnp.where(is_impact, jnp.min(stopper_impulse, axis=0), jnp.inf),
        n_solutions=jnp.where(
            is_impact, jnp.minimum(n_impact_solutions, n_force_solutions), n_force_solutions
        ),
        is_paradox=(n_force_solutions == 0) & ((n_impact_solutions > 0) | ~is_impact),
        most_solutions=jnp.where(
            is_impact, jnp.maximum(n_impact_solutions, n_force_solutions), n_force_solutions
        ),
        has_third_foot=jnp.any(has_no_slot & (foot_speeds(motion_after, legs)[1] < 0.0), axis=0)
        & is_impact,
    )


def project_motion(
    s: Symbols,
    motion: WheelMotion,
    contact: Int[Array, "n ..."],
    locked: Bool[Array, "n ..."],
    friction: Any = None,
) -> WheelMotion:
    """Return the motion projected onto its contacts: loaded feet on the slope, sticking ones at
    rest.

    Velocities are projected by bilateral, frictionless impulses. A motion that already satisfies
    its contacts is unchanged up to round-off.
    """
    legs = leg_directions(s, motion.theta)
    L = jnp.where((contact != ContactMode.OFF) & ~locked, motion.z / legs.cos, motion.L)
    motion = motion._replace(L=jnp.where(locked, s.L0, L))
    slots = find_slots(contact != ContactMode.OFF)
    airborne = locked & ~slots.is_filled
    modes, held = slots.gather_codes(contact), slots.gather_flags(locked)
    # Two resting feet on two held legs would constrain the hub twice.
    is_overdetermined = jnp.all((modes == ContactMode.STICK) & held, axis=0)
    held = jnp.stack([held[0], held[1] & ~is_overdetermined])
    slot_coefficients = (
        jnp.zeros_like(motion.theta) if friction is None else slot_friction(friction, slots)
    )
    configuration = ContactConfiguration(s, motion, slot_coefficients, slots, modes, held, airborne)
    projected = _motion_after_impact(motion, solve_impact(configuration))
    return projected._replace(dL=jnp.where(locked, 0.0, projected.dL))
