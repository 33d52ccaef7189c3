"""Determine the contact modes of the feet and the states of the stoppers by enumeration.

A contact mode is stick, slip or lift-off. Every combination of modes and stoppers for the legs in
the two contact slots is solved. In an admissible combination, normal forces push, friction lies in
Coulomb's cone and opposes the slip, and open constraints do not close. If several combinations are
admissible, the one with the most sticking feet is selected. The same table applies to impacts
(impulses and subsequent velocities) and to continuous motion (forces and accelerations).

Infinite friction is the limit of large friction. In Coulomb's law |t| = mu n, a finite tangential
force t requires a normal force n = 0. A sliding foot is therefore loaded by friction alone, which
acts against the slip. A resting foot begins to slide when its normal force vanishes. The rule
(A1)-(A4) of the paper differs and is selected by a friction of minus infinity
(`PAPER_RULE_SENTINEL`). By this rule, a foot sticks if that requires no pull, and lifts otherwise.
The foot slides without friction only if neither is possible.
"""

import functools
import itertools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Int

from vrw_jax import lanes
from vrw_jax.base.elementwise import Elementwise, select_trees_by_condition
from vrw_jax.models.contact_jvp import (
    WheelForceSolution,
    replace_infinite_friction,
    solve_combination,
)
from vrw_jax.models.contact_mechanics import (
    ContactInverseInertia,
    FreeMotion,
    LegArray,
    SlotArray,
    WheelMotion,
    align_with_batch,
    make_opaque_one,
    prevent_fusion,
    stop_gradients,
)
from vrw_jax.wheel.params import Symbols, compute_wheel_units
from vrw_jax.wheel.transitions import ContactMode

PAPER_RULE_SENTINEL = -np.inf
"""Friction coefficient that selects the rule (A1)-(A4) of the paper for infinite friction."""


_MODE_PRIORITY = {
    ContactMode.STICK: 0,
    ContactMode.SLIP_DOWN: 1,
    ContactMode.SLIP_UP: 1,
    ContactMode.OFF: 2,
}
# Two sticking feet of two legs on their stoppers are excluded. They constrain the hub twice, so
# their forces are not unique.
_COMBINATIONS = sorted(
    (
        (slot_modes, is_stopper_holding)
        for slot_modes in itertools.product(_MODE_PRIORITY, repeat=2)
        for is_stopper_holding in itertools.product((False, True), repeat=2)
        if not (slot_modes == (ContactMode.STICK, ContactMode.STICK) and all(is_stopper_holding))
    ),
    key=lambda combination: (
        sum(_MODE_PRIORITY[mode] for mode in combination[0]),
        sum(combination[1]),
    ),
)
CONTACT_MODE_TABLE, HELD_STOPPER_TABLE = map(np.array, zip(*_COMBINATIONS, strict=True))
"""Contact modes and closed stoppers for all combinations in order of preference, each (63, 2).

The combinations are sorted by decreasing number of sticking feet, then of sliding feet, then by
increasing number of closed stoppers.
"""
PAPER_RULE_ORDER = np.argsort(
    [
        sum(
            {ContactMode.STICK: 0, ContactMode.OFF: 2}.get(ContactMode(mode), 5)
            for mode in slot_modes
        )
        for slot_modes in CONTACT_MODE_TABLE
    ],
    kind="stable",
)
"""Order of the combinations by the rule of the paper, in which sliding comes last."""
N_COMBINATIONS_PER_ITERATION = 8
"""Number of combinations that XLA solves together, chosen because most events allow no more.

Machine code solves one combination after another.
"""
ALL_MODES_MASK = sum(1 << mode for mode in ContactMode)
"""Set of all contact modes, with one bit per mode."""

CombinationMask = Int[Array, "2 ..."]
"""Set of combinations, with one bit per combination in two 32-bit integers."""


def _mask_combinations(indices: np.ndarray | slice) -> tuple[np.ndarray, np.ndarray]:
    """Return bit masks that mark the combinations with a given contact mode or closed stopper.

    Bit i of a mask belongs to combination `indices[i]`. The masks for modes are indexed by slot and
    mode, (2, 4, 2), and those for stoppers by slot, (2, 2). The last axis is that of the two
    integers of a `CombinationMask`.
    """
    is_mode = CONTACT_MODE_TABLE[indices].T[:, None] == np.array(ContactMode)[:, None]

    def pack_bits(is_member: np.ndarray) -> np.ndarray:
        padded_flags = np.concatenate([is_member, np.zeros_like(is_member[..., :1])], -1)
        return np.packbits(padded_flags, axis=-1, bitorder="little").copy().view("<i4")

    return pack_bits(is_mode), pack_bits(HELD_STOPPER_TABLE[indices].T)


_COMBINATION_TABLES = _mask_combinations(PAPER_RULE_ORDER), _mask_combinations(slice(None))


class AllowedContactModes(NamedTuple):
    """Contact modes and stopper states that are allowed or need no test at an event.

    A set of modes is an integer with one bit per mode.
    """

    allowed_slot_modes: Int[Array, "2 ..."]  # set of modes allowed for each foot
    can_hold_stopper: Bool[Array, "2 ..."]  # whether the stopper may hold, not only be open
    is_foot_mode_fixed: Bool[Array, "2 ..."]  # whether the foot keeps its mode for any force
    untested_slot_modes: Int[Array, "2 ..."]  # set of modes that need no test
    is_open_stopper_untested: Bool[Array, "2 ..."]  # whether an open stopper needs no test

    def mask_allowed_combinations(
        self, masks_by_slot_mode: Array, masks_by_held_stopper: Array
    ) -> CombinationMask:
        """Return the bit mask of the combinations that are allowed; see `_mask_combinations`."""
        modes = align_with_batch(np.array(ContactMode), self.allowed_slot_modes[0])
        is_mode_allowed = is_mode_in_set(self.allowed_slot_modes[:, None], modes)
        mode_masks = jnp.where(is_mode_allowed[:, :, None], masks_by_slot_mode, 0)
        stopper_masks = jnp.where(self.can_hold_stopper[:, None], -1, ~masks_by_held_stopper)
        slot_masks = jnp.sum(mode_masks, axis=1, dtype=jnp.int32) & stopper_masks
        return slot_masks[0] & slot_masks[1]


def is_mode_in_set(allowed_mode_set: Array, mode: Array | np.ndarray) -> Bool[Array, "..."]:
    """Return whether a set of contact modes, with one bit per mode, contains `mode`."""
    return ((allowed_mode_set >> mode) & 1) > 0


class ChosenModeCombination(NamedTuple):
    """Combination of contact modes and stoppers that is selected at an event."""

    slot_modes: Int[Array, "2 ..."]
    is_stopper_holding: Bool[Array, "2 ..."]
    # largest sign violation in `ContactSignTolerances`; 0 if admissible
    sign_violation: Elementwise
    n_solutions: Int[Array, "..."]  # at least 1 if the violation is small


class ContactSignTolerances(NamedTuple):
    """Tolerances for the signs of forces and motions, by which sign violations are divided.

    Below its tolerance, the sign of a force or motion is determined by round-off.
    """

    force_tolerance: Elementwise  # N, or N s in an impact
    motion_tolerance: Elementwise  # m/s^2, or m/s


MAX_VIOLATION = 1e3
"""Largest accepted sign violation in units of `ContactSignTolerances`.

It applies if no combination has all signs correct.
"""


def _evaluate_sign_violation(
    s: Symbols,
    inverse_inertia: ContactInverseInertia,
    free_motion: FreeMotion,
    friction: SlotArray,
    allowed_modes: AllowedContactModes,
    tolerances: ContactSignTolerances,
    slot_modes: Array,
    is_stopper_holding: Array,
) -> Array:
    """Return the largest sign violation of a combination, divided by its tolerance."""
    uses_friction_limit = friction == jnp.inf
    solution = solve_combination(
        s, inverse_inertia, free_motion, slot_modes, is_stopper_holding, friction
    )
    tangential_forces, normal_forces = solution.tangential_forces, solution.normal_forces
    is_untested = is_mode_in_set(allowed_modes.untested_slot_modes, slot_modes)
    slides_down = slot_modes == ContactMode.SLIP_DOWN
    pull_violation = -normal_forces / tolerances.force_tolerance
    cone_violation = jnp.where(
        jnp.isfinite(friction),
        jnp.abs(tangential_forces) - replace_infinite_friction(friction) * normal_forces,
        0.0,
    )
    stick_violation = jnp.where(
        is_untested,
        0.0,
        jnp.maximum(pull_violation, cone_violation / tolerances.force_tolerance),
    )
    slip_violation = (
        jnp.where(slides_down, -solution.foot_motion_x, solution.foot_motion_x)
        / tolerances.motion_tolerance
    )
    friction_violation = (
        jnp.where(slides_down, tangential_forces, -tangential_forces) / tolerances.force_tolerance
    )
    slide_violation = jnp.maximum(
        jnp.where(uses_friction_limit, friction_violation, pull_violation),
        jnp.where(is_untested, 0.0, slip_violation),
    )
    liftoff_violation = jnp.where(
        is_untested, 0.0, -solution.foot_motion_z / tolerances.motion_tolerance
    )
    foot_violation = jnp.where(
        slot_modes == ContactMode.OFF,
        liftoff_violation,
        jnp.where(slot_modes == ContactMode.STICK, stick_violation, slide_violation),
    )
    stopper_violation = jnp.where(
        is_stopper_holding,
        -solution.stopper_forces / tolerances.force_tolerance,
        jnp.where(
            allowed_modes.is_open_stopper_untested,
            0.0,
            solution.length_motion / tolerances.motion_tolerance,
        ),
    )
    slot_violations = jnp.maximum(
        jnp.where(allowed_modes.is_foot_mode_fixed, 0.0, foot_violation), stopper_violation
    )
    are_forces_finite = jnp.isfinite(normal_forces) & jnp.isfinite(tangential_forces)
    max_violation = jnp.max(jnp.where(are_forces_finite, slot_violations, jnp.inf), axis=0)
    # If both legs are held and both feet resist motion along the slope, the hub is rigid. The
    # tangential forces of the feet are then not separately determined.
    holds_along_slope = (
        is_stopper_holding
        & (slot_modes != ContactMode.OFF)
        & ((slot_modes == ContactMode.STICK) | uses_friction_limit)
    )
    return jnp.where(jnp.all(holds_along_slope, axis=0), jnp.inf, jnp.maximum(max_violation, 0.0))


def _find_least_violating_combination(
    evaluate_combination: Callable[[CombinationMask], Array],
    combinations: list[CombinationMask],
    opaque_one: Array,
) -> tuple[CombinationMask, Array, Array]:
    """Return the first of the least violating combinations, its violation, and a count.

    The count is the number of admissible combinations.
    """
    if len(combinations) == 1:
        sign_violation = evaluate_combination(combinations[0])
        return combinations[0], sign_violation, sign_violation == 0.0
    stacked_combinations = jnp.stack(combinations)
    sign_violations = prevent_fusion(
        jax.vmap(evaluate_combination)(stacked_combinations), opaque_one
    )
    combination_indices = lax.broadcasted_iota(jnp.int32, sign_violations.shape, 0)
    is_least_violating = combination_indices == jnp.argmin(sign_violations, axis=0)
    combination = jnp.sum(
        jnp.where(is_least_violating[:, None], stacked_combinations, 0), axis=0, dtype=jnp.int32
    )
    n_admissible = jnp.sum(sign_violations == 0.0, axis=0, dtype=jnp.int32)
    return combination, jnp.min(sign_violations, axis=0), n_admissible


def choose_combination(
    s: Symbols,
    inverse_inertia: ContactInverseInertia,
    free_motion: FreeMotion,
    allowed_modes: AllowedContactModes,
    friction: SlotArray,
    tolerances: ContactSignTolerances,
    counts_all_solutions: bool,
) -> ChosenModeCombination:
    """Return the first admissible combination in the table, with the number of solutions.

    - `counts_all_solutions`: whether the number of all admissible combinations is determined.
      Otherwise the search ends at the first admissible combination.

    If no combination is admissible, the least violating combination is returned. It is accepted as
    a solution if its violation is at most `MAX_VIOLATION`, because round-off may close or open two
    contacts. Otherwise the number of solutions is 0.
    """
    evaluate_modes = functools.partial(
        _evaluate_sign_violation,
        *lax.stop_gradient((s, inverse_inertia, free_motion, friction)),
        allowed_modes,
        lax.stop_gradient(tolerances),
    )
    uses_paper_rule = jnp.all(friction == PAPER_RULE_SENTINEL, axis=0)
    masks_by_slot_mode, masks_by_held_stopper = mode_combination_table = jax.tree.map(
        lambda *masks: jnp.where(
            uses_paper_rule, *(align_with_batch(mask, uses_paper_rule) for mask in masks)
        ),
        *_COMBINATION_TABLES,
    )
    modes = align_with_batch(np.array(ContactMode), uses_paper_rule)

    def decode_mode_combination(combination: CombinationMask) -> tuple[Array, Array]:
        has_mode = jnp.any(masks_by_slot_mode & combination != 0, axis=2)
        slot_modes = jnp.sum(jnp.where(has_mode, modes, 0), axis=1, dtype=jnp.int32)
        return slot_modes, jnp.any(masks_by_held_stopper & combination != 0, axis=1)

    def evaluate_combination(combination: CombinationMask) -> Array:
        return jnp.where(
            jnp.any(combination != 0, axis=0),
            evaluate_modes(*decode_mode_combination(combination)),
            jnp.inf,
        )

    def is_unfinished(state: tuple) -> Array:
        untested_mask, _, _, n_solutions = state
        return jnp.any(untested_mask != 0, axis=0) & (counts_all_solutions | (n_solutions == 0))

    def evaluate_next_combinations(state: tuple) -> tuple:
        """Return the state of the enumeration after the next few allowed combinations."""
        untested_mask, best_combination, lowest_violation, n_solutions = state
        combinations = []
        for _ in range(1 if lanes.targets_machine_code() else N_COMBINATIONS_PER_ITERATION):
            lowest_bits = untested_mask & -untested_mask
            combination = jnp.stack(
                [lowest_bits[0], jnp.where(lowest_bits[0] == 0, lowest_bits[1], 0)]
            )
            untested_mask = untested_mask ^ combination
            combinations.append(combination)
        combination, violation, n_admissible = _find_least_violating_combination(
            evaluate_combination, combinations, make_opaque_one(free_motion.hub_motion[2])
        )
        best = select_trees_by_condition(
            violation < lowest_violation,
            (combination, violation),
            (best_combination, lowest_violation),
        )
        return select_trees_by_condition(
            is_unfinished(state), (untested_mask, *best, n_solutions + n_admissible), state
        )

    # The state consists of the untested combinations, the first admissible combination or else the
    # least violating one, its violation, and the number of solutions.
    untested_mask = allowed_modes.mask_allowed_combinations(*mode_combination_table)
    initial_state = (
        untested_mask,
        0 * untested_mask + align_with_batch(np.array([1, 0], np.int32), uses_paper_rule),
        jnp.full_like(lax.stop_gradient(free_motion.hub_motion[2]), jnp.inf),
        0 * untested_mask[0],
    )
    _, best_combination, lowest_violation, n_solutions = lax.while_loop(
        lambda state: jnp.any(is_unfinished(state)), evaluate_next_combinations, initial_state
    )
    has_solution = (lowest_violation <= MAX_VIOLATION).astype(jnp.int32)
    return ChosenModeCombination(
        *decode_mode_combination(best_combination),
        lowest_violation,
        jnp.maximum(n_solutions, has_solution),
    )


def is_release_consistent(
    s: Symbols,
    inverse_inertia: ContactInverseInertia,
    free_motion: FreeMotion,
    slot_modes_and_stoppers: tuple[Array, Array],
    friction: SlotArray,
    is_released: Bool[Array, "2 ..."],
    release_direction: Int[Array, "..."],
) -> Bool[Array, "..."]:
    """Return whether a foot that is released from its contact mode moves in the release direction.

    - `slot_modes_and_stoppers`: contact modes of both feet, and flags of both stoppers, in the
      contact slots;
    - `is_released`: whether the foot in each contact slot is the released foot;
    - `release_direction`: 0 off the ground, 1 downhill, -1 uphill.

    The margin of the new contact mode must grow with the acceleration in that direction. If the
    margin shrinks, the new mode ends immediately, and the forces jump (Painlevé).
    """
    slot_modes, is_stopper_holding = slot_modes_and_stoppers
    select_released = lambda slot_array: jnp.sum(jnp.where(is_released, slot_array, 0), axis=0)
    sin, cos = select_released(inverse_inertia.sin), select_released(inverse_inertia.cos)
    is_liftoff = release_direction == 0
    e = jnp.where(is_liftoff, -sin, release_direction * cos)
    u = jnp.where(is_liftoff, cos, release_direction * sin)
    acceleration_unit = compute_wheel_units(s).acceleration_unit
    shift_released = lambda slot_array, shift: (
        slot_array - jnp.where(is_released, acceleration_unit * shift, 0.0)
    )
    shifted_free_motion = free_motion._replace(
        foot_transverse_motion=shift_released(free_motion.foot_transverse_motion, e),
        foot_radial_motion=shift_released(free_motion.foot_radial_motion, u),
    )
    released_friction = select_released(friction)
    uses_friction_limit = released_friction == jnp.inf
    mode = select_released(slot_modes)
    slides_down = mode == ContactMode.SLIP_DOWN
    is_sliding = slides_down | (mode == ContactMode.SLIP_UP)

    def compute_mode_margin(assumed_motion: FreeMotion) -> Array:
        solution = solve_combination(
            s, inverse_inertia, assumed_motion, slot_modes, is_stopper_holding, friction
        )
        normal = select_released(solution.normal_forces)
        tangential = select_released(solution.tangential_forces)
        supporting_force = jnp.where(
            uses_friction_limit & is_sliding,
            jnp.where(slides_down, -tangential, tangential),
            normal,
        )
        return jnp.where(
            is_liftoff | uses_friction_limit,
            supporting_force,
            replace_infinite_friction(released_friction) * normal + release_direction * tangential,
        )

    return compute_mode_margin(shifted_free_motion) > compute_mode_margin(free_motion)


MAX_BLOCK_PIVOTS = 8
"""Number of pivots that switch all legs with a wrong sign."""


MAX_SINGLE_PIVOTS = 16
"""Number of later pivots that switch one leg each."""


MAX_ENUMERATED_LEGS = 8
"""Largest number of legs whose combinations are enumerated if pivoting fails."""


class LevelSolution(NamedTuple):
    """Solution in terms of velocities or accelerations, for an assumed set of closed stoppers.

    The stoppers are those of legs in the air.
    """

    chosen_combination: ChosenModeCombination
    force_solution: WheelForceSolution
    stopper_forces: LegArray  # force or impulse of the stoppers, N or N s
    outward_leg_motion: LegArray  # acceleration or rate of the leg lengths, m/s^2 or m/s


def solve_stopper_lcp(
    solve_level: Callable[..., LevelSolution],
    contact_law: Any,
    motion: WheelMotion,
    is_at_stopper: Array,
    is_stopper_tested: Array,
    tolerances: ContactSignTolerances,
) -> tuple[LevelSolution, Array]:
    """Return the solution with complementary stopper forces, and whether each stopper is closed.

    The stopper of a tested leg is closed if it pushes. It is open if the leg moves inwards. If
    stoppers are bilateral, all stoppers in `is_at_stopper` are closed and may pull.

    - `solve_level`: function that solves for velocities or accelerations, for an assumed set of
      closed stoppers. Its arguments are the contact law, the motion, the flags of the closed
      stoppers and, if it is known, the combination of contact modes, else None.
    """
    if not contact_law.has_one_sided_stoppers:
        return solve_level(contact_law, motion, is_at_stopper, None), is_at_stopper
    is_stopper_holding, chosen_combination = _pivot_stoppers(
        functools.partial(solve_level, *stop_gradients((contact_law, motion))),
        jnp.full_like(motion.theta, jnp.inf),
        is_at_stopper,
        is_stopper_tested,
        tolerances,
    )
    return solve_level(
        contact_law, motion, is_stopper_holding, chosen_combination
    ), is_stopper_holding


def _pivot_stoppers(
    solve_level: Callable[..., LevelSolution],
    infinite_sign_violation: Array,
    is_at_stopper: Array,
    is_stopper_tested: Array,
    tolerances: ContactSignTolerances,
) -> tuple[Array, ChosenModeCombination]:
    """Return which stoppers are closed, and the combination of modes, by principal pivoting.

    The first pivots switch all legs with a wrong sign together. Later pivots switch only the last
    of these legs, which prevents cycles. Principal pivoting is finite if no friction couples the
    legs (Murty 1974, Kostreva 1978). If it fails, all combinations are enumerated, and the solution
    with the smallest violation is returned. This solution is admissible if its violation is at most
    `MAX_VIOLATION`.
    """
    tested_leg_rank = jnp.cumsum(is_stopper_tested.astype(jnp.int32), axis=0) - 1
    n_combinations = 1 << jnp.minimum(
        jnp.sum(is_stopper_tested, axis=0, dtype=jnp.int32), MAX_ENUMERATED_LEGS
    )
    leg_index = align_with_batch(np.arange(len(is_at_stopper), dtype=np.int32), n_combinations)

    def is_unfinished(pivot_state: tuple) -> Array:
        _, combination_code, n_attempts, best_solution = pivot_state
        return (n_attempts == 0) | ((best_solution[0] > 1.0) & (combination_code < n_combinations))

    def pivot_legs(pivot_state: tuple) -> tuple:
        is_stopper_holding, combination_code, n_attempts, best_solution = pivot_state
        level_solution = solve_level(is_stopper_holding, None)
        sign_violation = jnp.where(
            is_stopper_holding,
            -level_solution.stopper_forces / tolerances.force_tolerance,
            level_solution.outward_leg_motion / tolerances.motion_tolerance,
        )
        sign_violation = jnp.where(is_stopper_tested, lax.stop_gradient(sign_violation), 0.0)
        has_wrong_sign = sign_violation > 1.0
        max_violation = jnp.maximum(
            jnp.max(sign_violation, axis=0), level_solution.chosen_combination.sign_violation
        )
        best_solution = select_trees_by_condition(
            max_violation < best_solution[0],
            (max_violation, is_stopper_holding, level_solution.chosen_combination),
            best_solution,
        )
        is_last_wrong_leg = leg_index == jnp.max(jnp.where(has_wrong_sign, leg_index, -1), axis=0)
        switched_legs = is_stopper_holding ^ jnp.where(
            n_attempts < MAX_BLOCK_PIVOTS, has_wrong_sign, is_last_wrong_leg
        )
        is_pivoting = (
            (combination_code < 0)
            & jnp.any(has_wrong_sign, axis=0)
            & (n_attempts < MAX_BLOCK_PIVOTS + MAX_SINGLE_PIVOTS)
        )
        combination_code = jnp.where(is_pivoting, combination_code, combination_code + 1)
        enumerated_legs = jnp.where(
            is_stopper_tested, ((combination_code >> tested_leg_rank) & 1) == 1, is_at_stopper
        )
        next_holding = jnp.where(is_pivoting, switched_legs, enumerated_legs)
        return select_trees_by_condition(
            is_unfinished(pivot_state),
            (next_holding, combination_code, n_attempts + 1, best_solution),
            pivot_state,
        )

    zero = jnp.zeros_like(n_combinations)
    slot_zeros = jnp.stack([n_combinations, n_combinations]) * 0
    no_combination = ChosenModeCombination(
        slot_zeros, slot_zeros > 0, infinite_sign_violation, zero
    )
    best_solution = infinite_sign_violation, is_at_stopper, no_combination
    *_, (max_violation, is_stopper_holding, chosen_combination) = lax.while_loop(
        lambda pivot_state: jnp.any(is_unfinished(pivot_state)),
        pivot_legs,
        (is_at_stopper, zero - 1, zero, best_solution),
    )
    return is_stopper_holding, chosen_combination._replace(
        n_solutions=jnp.where(max_violation <= MAX_VIOLATION, chosen_combination.n_solutions, 0)
    )


def list_modes_after_event(
    contact_event: Any, slot_modes: Array, is_consistent: Array, follows_paper_rule: Array
) -> tuple[Int[Array, "2 ..."], Int[Array, "2 ..."]]:
    """Return the contact modes that may follow an event, and the modes that need no test.

    The result contains two sets of modes for each contact slot, with one bit per mode.

    - `slot_modes`: contact mode of the foot in each contact slot before the event;
    - `is_consistent`: whether the released foot moves in the release direction (see
      `is_release_consistent`);
    - `follows_paper_rule`: whether the rule of the paper applies to infinite friction.
    """
    current_mode_bit, off_mode_bit = 1 << slot_modes, 1 << ContactMode.OFF
    possible_modes = jnp.where(
        slot_modes == ContactMode.STICK, ALL_MODES_MASK, current_mode_bit | off_mode_bit
    )
    reversed_mode_bit = jnp.where(
        slot_modes == ContactMode.SLIP_DOWN, 1 << ContactMode.SLIP_UP, 1 << ContactMode.SLIP_DOWN
    )
    possible_modes = jnp.where(
        contact_event.is_stopping_to_slide,
        1 << ContactMode.STICK | off_mode_bit | reversed_mode_bit,
        possible_modes,
    )
    untested_modes = jnp.where(
        (slot_modes == ContactMode.STICK) | contact_event.is_stopping_to_slide, 0, current_mode_bit
    )
    for event_flags, following_mode, ended_mode in (
        (contact_event.is_foot_lifting_off, off_mode_bit, current_mode_bit),
        (contact_event.is_starting_to_slide_up, 1 << ContactMode.SLIP_UP, 1 << ContactMode.STICK),
        (
            contact_event.is_starting_to_slide_down,
            1 << ContactMode.SLIP_DOWN,
            1 << ContactMode.STICK,
        ),
    ):
        tested_mode_bits = (
            ALL_MODES_MASK
            & ~ended_mode
            & jnp.where(is_consistent | follows_paper_rule, ALL_MODES_MASK, ~following_mode)
        )
        possible_modes = jnp.where(
            event_flags, jnp.where(is_consistent, following_mode, tested_mode_bits), possible_modes
        )
        untested_modes = jnp.where(
            event_flags, jnp.where(is_consistent, following_mode, 0), untested_modes
        )
    return possible_modes, untested_modes
