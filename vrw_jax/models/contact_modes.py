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
import operator
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Int

from vrw_jax import lanes
from vrw_jax.base.elementwise import select_trees_by_condition
from vrw_jax.base.types import Elementwise
from vrw_jax.models.contact_mechanics import (
    ContactInverseInertia,
    FreeMotion,
    HubVector,
    SlotArray,
    align_with_batch,
    make_opaque_one,
    prevent_fusion,
)
from vrw_jax.wheel.outcomes import ContactMode
from vrw_jax.wheel.params import Symbols, compute_wheel_units

PAPER_RULE_SENTINEL = -np.inf
"""Friction coefficient that selects the rule (A1)-(A4) of the paper for infinite friction."""


class SlotForceSolution(NamedTuple):
    """Forces (N) and resulting accelerations, or impulses (N s) and velocities after the impact.

    A `SlotArray` has one entry for the leg in each contact slot.
    """

    tangential_forces: SlotArray  # tangential forces on the feet, positive downhill
    normal_forces: SlotArray  # normal forces on the feet, positive if they push
    stopper_forces: SlotArray  # forces of the stoppers, positive if they push
    leg_pull_forces: SlotArray  # force of stopper and foot along u on the leg's mass
    hub_motion: HubVector
    length_motion: SlotArray  # accelerations of the leg lengths, or rates after an impact
    foot_motion_x: SlotArray  # accelerations of the feet, or velocities after an impact
    foot_motion_z: SlotArray
    painleve_determinant: Any  # of order 1; zero at Painlevé's singularity


def _compute_determinant(A: Array) -> Array:
    """Return the determinant of a 2 x 2 matrix."""
    return A[0, 0] * A[1, 1] - A[0, 1] * A[1, 0]


def _solve_2x2_system(A: Array, b: Array) -> Array:
    """Return the solution of A x = b for a 2 x 2 matrix A; NaN if A is singular.

    If b is a matrix, each of its columns is a right-hand side.
    """
    determinant = _compute_determinant(A)
    inverse_determinant = 1.0 / jnp.where(determinant == 0.0, jnp.nan, determinant)
    return jnp.stack(
        [
            (A[1, 1] * b[0] - A[0, 1] * b[1]) * inverse_determinant,
            (A[0, 0] * b[1] - A[1, 0] * b[0]) * inverse_determinant,
        ]
    )


def _make_diagonal_matrix(diagonal: SlotArray) -> Array:
    """Return the 2 x 2 matrix with the entries of `diagonal` on its diagonal, and zeros."""
    return jnp.where(align_with_batch(np.eye(2, dtype=bool), diagonal[0]), diagonal, 0.0)


def replace_infinite_friction(friction: Elementwise) -> Array:
    """Return the friction coefficients of Coulomb's law, with 0 in place of infinite coefficients.

    Coulomb's law then yields no friction on a foot that slides under infinite friction.
    """
    return jnp.where(jnp.isfinite(friction), friction, 0.0)


REFERENCE_MASS_RATIO = 18.0
"""Ratio of total mass to leg mass that scales the determinant of the contact equations.

At this ratio, resting and sliding feet have the same scale in the determinant. The value is that of
the wheel in Table 1 of the paper, chosen because `painleve_atol` was measured for this wheel.
"""


def _solve_slot_forces(
    s: Symbols,
    inverse_inertia: ContactInverseInertia,
    free_motion: FreeMotion,
    slot_modes: Array,
    is_stopper_holding: Array,
    friction: SlotArray,
    opaque_one: Array,
) -> tuple[SlotArray, SlotArray, SlotArray, Array]:
    """Return the forces in the contact slots, and the determinant of the foot equations.

    The result is (stopper forces, foot forces transverse to the legs, foot forces along the legs,
    determinant).

    The unknown c is the transverse force on a sticking foot. For a sliding foot, c is the normal
    force. In the limit of infinite friction, c is the friction force instead. For an unloaded foot,
    c = 0. The stopper forces f are eliminated first: they solve N f = p + P c. For an open stopper,
    the corresponding equation is f = 0, so the system is always regular. In matrices, the first
    index is that of the equation.
    """
    sin, cos, inverse_leg_mass = inverse_inertia.sin, inverse_inertia.cos, 1.0 / s.m
    sliding_coefficient = jnp.where(friction == jnp.inf, 1.0, replace_infinite_friction(friction))
    normal_force_factor = jnp.where(friction == jnp.inf, 0.0, 1.0)
    is_sticking = slot_modes == ContactMode.STICK
    slides_down = slot_modes == ContactMode.SLIP_DOWN
    is_sliding = slides_down | (slot_modes == ContactMode.SLIP_UP)
    is_loaded = is_sticking | is_sliding
    friction_factor = jnp.where(slides_down, -sliding_coefficient, sliding_coefficient)
    select_by_mode = lambda sticking_value, sliding_value: jnp.where(
        is_sticking, sticking_value, jnp.where(is_sliding, sliding_value, 0.0)
    )
    # These are the force on a foot for c = 1, and the weights of the foot's transverse motion and
    # of the force on the leg's mass in the foot's condition.
    transverse_per_c = select_by_mode(1.0, friction_factor * cos - normal_force_factor * sin)
    radial_per_c = select_by_mode(0.0, friction_factor * sin + normal_force_factor * cos)
    weight_transverse = select_by_mode(1.0, -sin)
    weight_radial = select_by_mode(0.0, cos * inverse_leg_mass)

    leg_compliance = jnp.where(is_sticking, 0.0, inverse_leg_mass)
    N = jnp.where(
        is_stopper_holding[:, None],
        inverse_inertia.K + _make_diagonal_matrix(leg_compliance),
        _make_diagonal_matrix(jnp.ones_like(leg_compliance)),
    )
    outward_leg_motion = (
        sin * free_motion.hub_motion[0]
        + cos * free_motion.hub_motion[1]
        + free_motion.slot_leg_motion
    )
    free_length_motion = outward_leg_motion + jnp.where(
        is_sticking, free_motion.foot_radial_motion, 0.0
    )
    p = jnp.where(is_stopper_holding, free_length_motion, 0.0)
    P = jnp.where(
        is_stopper_holding[:, None],
        inverse_inertia.H * transverse_per_c
        - _make_diagonal_matrix(radial_per_c * inverse_leg_mass),
        0.0,
    )
    p, P, N = prevent_fusion((p, P, N), opaque_one)
    stopper_without_feet, stopper_response = prevent_fusion(
        (_solve_2x2_system(N, p), _solve_2x2_system(N, P)), opaque_one
    )

    R = _make_diagonal_matrix(weight_radial) - weight_transverse[:, None] * jnp.swapaxes(
        inverse_inertia.H, 0, 1
    )
    C = (
        weight_transverse[:, None] * inverse_inertia.G * transverse_per_c
        + _make_diagonal_matrix(weight_radial * radial_per_c)
        + R[:, :1] * stopper_response[0]
        + R[:, 1:] * stopper_response[1]
        + _make_diagonal_matrix(jnp.where(is_loaded, 0.0, 1.0))
    )
    right_hand_side = (
        -weight_transverse * free_motion.foot_transverse_motion
        - weight_radial * s.m * free_motion.foot_radial_motion
    )
    c = _solve_2x2_system(
        C,
        right_hand_side - R[:, 0] * stopper_without_feet[0] - R[:, 1] * stopper_without_feet[1],
    )
    stopper_force = (
        stopper_without_feet + stopper_response[:, 0] * c[0] + stopper_response[:, 1] * c[1]
    )
    foot_force_radial = jnp.where(
        is_sticking, -s.m * free_motion.foot_radial_motion - stopper_force, radial_per_c * c
    )
    scale_masses = jnp.where(is_sticking, s.Mt / REFERENCE_MASS_RATIO, s.m)
    scale_masses = jnp.where(is_loaded, scale_masses, 1.0)
    painleve_determinant = scale_masses[0] * scale_masses[1] * _compute_determinant(C)
    return prevent_fusion(
        (stopper_force, transverse_per_c * c, foot_force_radial, painleve_determinant),
        opaque_one,
    )


@eqx.filter_jit  # This function is traced once for all call sites.
def solve_combination(
    s: Symbols,
    inverse_inertia: ContactInverseInertia,
    free_motion: FreeMotion,
    slot_modes: Array,
    is_stopper_holding: Array,
    friction: SlotArray,
) -> SlotForceSolution:
    """Return forces and motion for one combination of contact modes and stoppers.

    - `slot_modes`: contact mode of the foot in each contact slot, shape (2, ...);
    - `is_stopper_holding`: whether the stopper holds the leg in each contact slot, shape (2, ...);
    - `friction`: friction coefficient of the foot in each contact slot, shape (2, ...).

    A sticking foot stays at rest. A sliding foot stays on the ground, with friction against the
    slip. A leg on its stopper has a constant length.
    """
    sin, cos, inverse_leg_mass = inverse_inertia.sin, inverse_inertia.cos, 1.0 / s.m
    opaque_one = make_opaque_one(free_motion.hub_motion[2])
    stopper_force, foot_force_transverse, foot_force_radial, painleve_determinant = (
        _solve_slot_forces(
            s, inverse_inertia, free_motion, slot_modes, is_stopper_holding, friction, opaque_one
        )
    )
    leg_pull_forces = foot_force_radial + stopper_force
    hub_motion = vx, vz, _ = tuple(
        free
        + transverse[0] * foot_force_transverse[0]
        + transverse[1] * foot_force_transverse[1]
        - radial[0] * stopper_force[0]
        - radial[1] * stopper_force[1]
        for free, transverse, radial in zip(
            free_motion.hub_motion,
            inverse_inertia.hub_response_transverse,
            inverse_inertia.hub_response_radial,
            strict=True,
        )
    )
    hub_change = tuple(map(operator.sub, hub_motion, free_motion.hub_motion))
    foot_transverse = (
        inverse_inertia.compute_transverse_foot_motion(hub_change)
        + free_motion.foot_transverse_motion
    )
    foot_radial = free_motion.foot_radial_motion + leg_pull_forces * inverse_leg_mass
    free_length_motion = (
        sin * vx + cos * vz + free_motion.slot_leg_motion - leg_pull_forces * inverse_leg_mass
    )
    return SlotForceSolution(
        tangential_forces=foot_force_transverse * cos + foot_force_radial * sin,
        normal_forces=foot_force_radial * cos - foot_force_transverse * sin,
        stopper_forces=stopper_force,
        leg_pull_forces=leg_pull_forces,
        hub_motion=hub_motion,
        length_motion=jnp.where(is_stopper_holding, 0.0, free_length_motion),
        foot_motion_x=foot_transverse * cos + foot_radial * sin,
        foot_motion_z=foot_radial * cos - foot_transverse * sin,
        painleve_determinant=painleve_determinant,
    )


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


class _ModeEnumerationState(NamedTuple):
    """State of the loop over the combinations of a table."""

    untested_combination_mask: CombinationMask  # allowed combinations that are not yet examined
    best_combination: CombinationMask  # first admissible combination, else the least violating one
    lowest_sign_violation: Elementwise
    n_solutions: Int[Array, "..."]


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

    def is_unfinished(mode_enumeration_state: _ModeEnumerationState) -> Array:
        return jnp.any(mode_enumeration_state.untested_combination_mask != 0, axis=0) & (
            counts_all_solutions | (mode_enumeration_state.n_solutions == 0)
        )

    def evaluate_next_combinations(
        mode_enumeration_state: _ModeEnumerationState,
    ) -> _ModeEnumerationState:
        """Return the state of the enumeration after the next few allowed combinations."""
        untested_mask, best_combination, lowest_sign_violation, n_solutions = mode_enumeration_state
        combinations = []
        for _ in range(1 if lanes.targets_machine_code() else N_COMBINATIONS_PER_ITERATION):
            lowest_bits = untested_mask & -untested_mask
            combination = jnp.stack(
                [lowest_bits[0], jnp.where(lowest_bits[0] == 0, lowest_bits[1], 0)]
            )
            untested_mask = untested_mask ^ combination
            combinations.append(combination)
        combination, combination_sign_violation, n_admissible = _find_least_violating_combination(
            evaluate_combination, combinations, make_opaque_one(free_motion.hub_motion[2])
        )
        best_combination, lowest_sign_violation = select_trees_by_condition(
            combination_sign_violation < lowest_sign_violation,
            (combination, combination_sign_violation),
            (best_combination, lowest_sign_violation),
        )
        n_solutions = n_solutions + n_admissible
        return select_trees_by_condition(
            is_unfinished(mode_enumeration_state),
            _ModeEnumerationState(
                untested_mask, best_combination, lowest_sign_violation, n_solutions
            ),
            mode_enumeration_state,
        )

    untested_mask = allowed_modes.mask_allowed_combinations(*mode_combination_table)
    infinite_sign_violation = jnp.full_like(lax.stop_gradient(free_motion.hub_motion[2]), jnp.inf)
    initial_state = _ModeEnumerationState(
        untested_mask,
        0 * untested_mask + align_with_batch(np.array([1, 0], np.int32), uses_paper_rule),
        infinite_sign_violation,
        0 * untested_mask[0],
    )
    mode_enumeration_state = lax.while_loop(
        lambda mode_enumeration_state: jnp.any(is_unfinished(mode_enumeration_state)),
        evaluate_next_combinations,
        initial_state,
    )
    n_solutions = jnp.maximum(
        mode_enumeration_state.n_solutions,
        (mode_enumeration_state.lowest_sign_violation <= MAX_VIOLATION).astype(jnp.int32),
    )
    return ChosenModeCombination(
        *decode_mode_combination(mode_enumeration_state.best_combination),
        mode_enumeration_state.lowest_sign_violation,
        n_solutions,
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
