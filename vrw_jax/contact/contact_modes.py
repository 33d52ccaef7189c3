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

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Int

from vrw_jax import simd
from vrw_jax.contact.mechanics import (
    ContactInverseInertia,
    FreeMotion,
    HubVector,
    SlotPair,
    prevent_fusion,
)
from vrw_jax.numerics import Elementwise, select_trees_by_condition
from vrw_jax.wheel import ContactMode, Symbols, compute_wheel_units

Friction = Elementwise | SlotPair
"""Friction coefficient for all feet, or a pair with one coefficient for each contact slot."""


PAPER_RULE_SENTINEL = -np.inf
"""Friction coefficient that selects the rule (A1)-(A4) of the paper for infinite friction."""


class SlotForceSolution(NamedTuple):
    """Forces (N) and resulting accelerations, or impulses (N s) and velocities after the impact.

    A `SlotPair` has one entry for the leg in each contact slot.
    """

    tangential_forces: SlotPair  # tangential forces on the feet, positive downhill
    normal_forces: SlotPair  # normal forces on the feet, positive if they push
    stopper_forces: SlotPair  # forces of the stoppers, positive if they push
    leg_pull_forces: SlotPair  # force of stopper and foot along u on the leg's mass
    hub_motion: HubVector
    length_motion: SlotPair  # accelerations of the leg lengths, or rates after an impact
    foot_motion_x: SlotPair  # accelerations of the feet, or velocities after an impact
    foot_motion_z: SlotPair
    painleve_determinant: Any  # of order 1; zero at Painlevé's singularity


Matrix2x2 = tuple[tuple[Any, Any], tuple[Any, Any]]
"""Matrix with two rows and two columns, as nested tuples."""


def _solve_2x2_system(A: Matrix2x2, b: SlotPair) -> SlotPair:
    """Return the solution of A x = b for a 2 x 2 matrix A; NaN if A is singular."""
    determinant = A[0][0] * A[1][1] - A[0][1] * A[1][0]
    inverse_determinant = 1.0 / jnp.where(determinant == 0.0, jnp.nan, determinant)
    return (
        (A[1][1] * b[0] - A[0][1] * b[1]) * inverse_determinant,
        (A[0][0] * b[1] - A[1][0] * b[0]) * inverse_determinant,
    )


def _make_slot_matrix(compute_entry: Any) -> Matrix2x2:
    """Return the 2 x 2 matrix with the entries `compute_entry(i, j)`."""
    return ((compute_entry(0, 0), compute_entry(0, 1)), (compute_entry(1, 0), compute_entry(1, 1)))


def _make_slot_pair(compute_entry: Any) -> SlotPair:
    """Return the pair (`compute_entry(0)`, `compute_entry(1)`), with one entry for each contact
    slot.
    """
    return compute_entry(0), compute_entry(1)


def map_friction(friction_function: Callable[[Any], Any], friction: Friction) -> Any:
    """Return `friction_function` of a friction coefficient, or of each coefficient in a pair."""
    is_friction_pair = isinstance(friction, tuple)
    return (
        (friction_function(friction[0]), friction_function(friction[1]))
        if is_friction_pair
        else friction_function(friction)
    )


def _get_slot_friction(i: int, friction: Any) -> Any:
    """Return the friction coefficient for contact slot `i`, from a pair or a common coefficient."""
    return friction[i] if isinstance(friction, tuple) else friction


def replace_infinite_friction(friction: Friction) -> Any:
    """Return the friction coefficients of Coulomb's law, with 0 in place of infinite coefficients.

    Coulomb's law then yields no friction on a foot that slides under infinite friction.
    """
    return map_friction(
        lambda friction_coefficient: jnp.where(
            jnp.isfinite(friction_coefficient), friction_coefficient, 0.0
        ),
        friction,
    )


class _FootEquations(NamedTuple):
    """Coefficients of the equations for the feet in contact, for one combination of modes.

    The unknown c is the transverse force on a sticking foot. For a sliding foot, c is the normal
    force. In the limit of infinite friction, c is the friction force instead. For an unloaded foot,
    c = 0.
    """

    is_foot_sticking: SlotPair
    is_foot_loaded: SlotPair
    unit_force_transverse: SlotPair  # transverse force for c = 1
    unit_force_radial: SlotPair  # force along the leg for c = 1; 0 for a sticking foot
    condition_weight_transverse: SlotPair  # weight of the foot's transverse motion in the condition
    condition_weight_radial: SlotPair  # weight of the force on the leg's mass in the condition


def _make_foot_equations(
    s: Symbols, inverse_inertia: ContactInverseInertia, slot_modes: Array, friction: Friction
) -> _FootEquations:
    """Return the coefficients of the contact equations for the feet in both contact slots."""
    sin, cos = inverse_inertia.sin, inverse_inertia.cos
    sliding_coefficient = map_friction(
        lambda friction_coefficient: jnp.where(
            friction_coefficient == jnp.inf,
            1.0,
            jnp.where(jnp.isfinite(friction_coefficient), friction_coefficient, 0.0),
        ),
        friction,
    )
    normal_force_factor = map_friction(
        lambda friction_coefficient: jnp.where(friction_coefficient == jnp.inf, 0.0, 1.0), friction
    )
    is_sticking = _make_slot_pair(lambda i: slot_modes[i] == ContactMode.STICK)
    is_sliding = _make_slot_pair(
        lambda i: (slot_modes[i] == ContactMode.SLIP_DOWN) | (slot_modes[i] == ContactMode.SLIP_UP)
    )
    friction_factor = _make_slot_pair(
        lambda i: jnp.where(
            slot_modes[i] == ContactMode.SLIP_DOWN,
            -_get_slot_friction(i, sliding_coefficient),
            _get_slot_friction(i, sliding_coefficient),
        )
    )
    select_by_mode = lambda i, sticking_value, sliding_value: jnp.where(
        is_sticking[i], sticking_value, jnp.where(is_sliding[i], sliding_value, 0.0)
    )
    return _FootEquations(
        is_foot_sticking=is_sticking,
        is_foot_loaded=_make_slot_pair(lambda i: is_sticking[i] | is_sliding[i]),
        unit_force_transverse=_make_slot_pair(
            lambda i: select_by_mode(
                i,
                1.0,
                friction_factor[i] * cos[i] - _get_slot_friction(i, normal_force_factor) * sin[i],
            )
        ),
        unit_force_radial=_make_slot_pair(
            lambda i: select_by_mode(
                i,
                0.0,
                friction_factor[i] * sin[i] + _get_slot_friction(i, normal_force_factor) * cos[i],
            )
        ),
        condition_weight_transverse=_make_slot_pair(lambda i: select_by_mode(i, 1.0, -sin[i])),
        condition_weight_radial=_make_slot_pair(
            lambda i: select_by_mode(i, 0.0, cos[i] * (1.0 / s.m))
        ),
    )


def _get_identity_matrix_entry(i: int, j: int) -> float:
    """Return the entry (i, j) of the identity matrix."""
    return 1.0 if i == j else 0.0


def _eliminate_stoppers(
    s: Symbols,
    inverse_inertia: ContactInverseInertia,
    free_motion: FreeMotion,
    is_stopper_holding: Array,
    foot_equations: _FootEquations,
    opaque_one: Array,
) -> tuple[SlotPair, Matrix2x2]:
    """Return the stopper forces without foot forces, and their change due to c = 1 at each foot.

    The unknown c is defined in `_FootEquations`. The second result has the indices [foot][stopper].
    The stopper forces s solve N s = p + P c. For an open stopper, the corresponding equation is s =
    0, so the system is always regular.
    """
    sin, cos, inverse_leg_mass = inverse_inertia.sin, inverse_inertia.cos, 1.0 / s.m
    H = ((inverse_inertia.H[0], inverse_inertia.H[1]), (inverse_inertia.H[2], inverse_inertia.H[3]))
    K = ((inverse_inertia.K[0], inverse_inertia.K[1]), inverse_inertia.K[1:])
    leg_compliance = _make_slot_pair(
        lambda i: jnp.where(foot_equations.is_foot_sticking[i], 0.0, inverse_leg_mass)
    )
    N = _make_slot_matrix(
        lambda i, j: jnp.where(
            is_stopper_holding[i],
            K[i][j] + _get_identity_matrix_entry(i, j) * leg_compliance[i],
            _get_identity_matrix_entry(i, j),
        )
    )
    outward_leg_motion = _make_slot_pair(
        lambda i: (
            sin[i] * free_motion.hub_motion[0]
            + cos[i] * free_motion.hub_motion[1]
            + free_motion.slot_leg_motion[i]
        )
    )
    free_length_motion = _make_slot_pair(
        lambda i: (
            outward_leg_motion[i]
            + jnp.where(foot_equations.is_foot_sticking[i], free_motion.foot_radial_motion[i], 0.0)
        )
    )
    p = _make_slot_pair(lambda i: jnp.where(is_stopper_holding[i], free_length_motion[i], 0.0))
    foot_effect_on_stopper = lambda i, j: (
        H[i][j] * foot_equations.unit_force_transverse[j]
        - _get_identity_matrix_entry(i, j) * foot_equations.unit_force_radial[i] * inverse_leg_mass
    )
    P = _make_slot_matrix(
        lambda i, j: jnp.where(is_stopper_holding[i], foot_effect_on_stopper(i, j), 0.0)
    )
    p, P, N = prevent_fusion((p, P, N), opaque_one)
    return prevent_fusion(
        (
            _solve_2x2_system(N, p),
            _make_slot_pair(lambda j: _solve_2x2_system(N, (P[0][j], P[1][j]))),
        ),
        opaque_one,
    )


REFERENCE_MASS_RATIO = 18.0
"""Ratio of total mass to leg mass that scales the determinant of the contact equations.

At this ratio, resting and sliding feet have the same scale in the determinant. The value is that of
the wheel in Table 1 of the paper, chosen because `painleve_atol` was measured for this wheel.
"""


def _solve_foot_forces(
    s: Symbols,
    inverse_inertia: ContactInverseInertia,
    free_motion: FreeMotion,
    foot_equations: _FootEquations,
    stopper_without_feet: SlotPair,
    stopper_response: Matrix2x2,
    opaque_one: Array,
) -> tuple[SlotPair, SlotPair, SlotPair, Any]:
    """Return the stopper forces, the foot forces and the determinant of the foot equations.

    The result is (stopper forces, foot forces transverse to the legs, foot forces along the legs,
    determinant). The arguments `stopper_without_feet` and `stopper_response` are the results of
    `_eliminate_stoppers`.
    """
    condition_weight_transverse = foot_equations.condition_weight_transverse
    condition_weight_radial = foot_equations.condition_weight_radial
    unit_force_transverse = foot_equations.unit_force_transverse
    unit_force_radial = foot_equations.unit_force_radial
    G = ((inverse_inertia.G[0], inverse_inertia.G[1]), inverse_inertia.G[1:])
    H = ((inverse_inertia.H[0], inverse_inertia.H[1]), (inverse_inertia.H[2], inverse_inertia.H[3]))
    R = _make_slot_matrix(
        lambda i, k: (
            _get_identity_matrix_entry(i, k) * condition_weight_radial[i]
            - condition_weight_transverse[i] * H[k][i]
        )
    )
    C = _make_slot_matrix(
        lambda i, j: (
            condition_weight_transverse[i] * G[i][j] * unit_force_transverse[j]
            + _get_identity_matrix_entry(i, j) * condition_weight_radial[i] * unit_force_radial[i]
            + R[i][0] * stopper_response[j][0]
            + R[i][1] * stopper_response[j][1]
            + _get_identity_matrix_entry(i, j)
            * jnp.where(foot_equations.is_foot_loaded[i], 0.0, 1.0)
        )
    )
    right_hand_side = _make_slot_pair(
        lambda i: (
            -condition_weight_transverse[i] * free_motion.foot_transverse_motion[i]
            - condition_weight_radial[i] * s.m * free_motion.foot_radial_motion[i]
        )
    )
    c = _solve_2x2_system(
        C,
        _make_slot_pair(
            lambda i: (
                right_hand_side[i]
                - R[i][0] * stopper_without_feet[0]
                - R[i][1] * stopper_without_feet[1]
            )
        ),
    )
    stopper_force = _make_slot_pair(
        lambda k: (
            stopper_without_feet[k] + stopper_response[0][k] * c[0] + stopper_response[1][k] * c[1]
        )
    )
    foot_force_transverse = _make_slot_pair(lambda i: unit_force_transverse[i] * c[i])
    sticking_force_radial = _make_slot_pair(
        lambda i: -s.m * free_motion.foot_radial_motion[i] - stopper_force[i]
    )
    foot_force_radial = _make_slot_pair(
        lambda i: jnp.where(
            foot_equations.is_foot_sticking[i],
            sticking_force_radial[i],
            unit_force_radial[i] * c[i],
        )
    )
    scale_masses = _make_slot_pair(
        lambda i: jnp.where(foot_equations.is_foot_sticking[i], s.Mt / REFERENCE_MASS_RATIO, s.m)
    )
    scale_masses = _make_slot_pair(
        lambda i: jnp.where(foot_equations.is_foot_loaded[i], scale_masses[i], 1.0)
    )
    painleve_determinant = (
        scale_masses[0] * scale_masses[1] * (C[0][0] * C[1][1] - C[0][1] * C[1][0])
    )
    return prevent_fusion(
        (stopper_force, foot_force_transverse, foot_force_radial, painleve_determinant),
        opaque_one,
    )


@eqx.filter_jit  # This function is traced once for all call sites.
def solve_combination(
    s: Symbols,
    inverse_inertia: ContactInverseInertia,
    free_motion: FreeMotion,
    slot_modes: Array,
    is_stopper_holding: Array,
    friction: Friction,
) -> SlotForceSolution:
    """Return forces and motion for one combination of contact modes and stoppers.

    - `slot_modes`: contact mode of the foot in each contact slot, shape (2, ...);
    - `is_stopper_holding`: whether the stopper holds the leg in each contact slot, shape (2, ...).

    A sticking foot stays at rest. A sliding foot stays on the ground, with friction against the
    slip. A leg on its stopper has a constant length. The stopper forces are eliminated first.
    """
    sin, cos, inverse_leg_mass = inverse_inertia.sin, inverse_inertia.cos, 1.0 / s.m
    opaque_one = 1.0 + 0.0 * lax.stop_gradient(free_motion.hub_motion[2])
    foot_equations = _make_foot_equations(s, inverse_inertia, slot_modes, friction)
    stopper_system = _eliminate_stoppers(
        s, inverse_inertia, free_motion, is_stopper_holding, foot_equations, opaque_one
    )
    stopper_force, foot_force_transverse, foot_force_radial, painleve_determinant = (
        _solve_foot_forces(
            s, inverse_inertia, free_motion, foot_equations, *stopper_system, opaque_one
        )
    )
    leg_pull_forces = _make_slot_pair(lambda i: foot_force_radial[i] + stopper_force[i])
    hub_response_transverse = inverse_inertia.hub_response_transverse
    hub_response_radial = inverse_inertia.hub_response_radial
    hub_motion_with_feet = [
        free_motion.hub_motion[k]
        + hub_response_transverse[0][k] * foot_force_transverse[0]
        + hub_response_transverse[1][k] * foot_force_transverse[1]
        for k in range(3)
    ]
    vx, vz, hub_motion_theta = (
        hub_motion_with_feet[k]
        - hub_response_radial[0][k] * stopper_force[0]
        - hub_response_radial[1][k] * stopper_force[1]
        for k in range(3)
    )
    hub_change_x = vx - free_motion.hub_motion[0]
    hub_change_z = vz - free_motion.hub_motion[1]
    hub_change_theta = hub_motion_theta - free_motion.hub_motion[2]
    foot_transverse = _make_slot_pair(
        lambda i: (
            cos[i] * hub_change_x
            - sin[i] * hub_change_z
            - inverse_inertia.L[i] * hub_change_theta
            + free_motion.foot_transverse_motion[i]
        )
    )
    foot_radial = _make_slot_pair(
        lambda i: free_motion.foot_radial_motion[i] + leg_pull_forces[i] * inverse_leg_mass
    )
    free_length_motion = _make_slot_pair(
        lambda i: (
            sin[i] * vx
            + cos[i] * vz
            + free_motion.slot_leg_motion[i]
            - leg_pull_forces[i] * inverse_leg_mass
        )
    )
    return SlotForceSolution(
        tangential_forces=_make_slot_pair(
            lambda i: foot_force_transverse[i] * cos[i] + foot_force_radial[i] * sin[i]
        ),
        normal_forces=_make_slot_pair(
            lambda i: foot_force_radial[i] * cos[i] - foot_force_transverse[i] * sin[i]
        ),
        stopper_forces=stopper_force,
        leg_pull_forces=leg_pull_forces,
        hub_motion=(vx, vz, hub_motion_theta),
        length_motion=_make_slot_pair(
            lambda i: jnp.where(is_stopper_holding[i], 0.0, free_length_motion[i])
        ),
        foot_motion_x=_make_slot_pair(
            lambda i: foot_transverse[i] * cos[i] + foot_radial[i] * sin[i]
        ),
        foot_motion_z=_make_slot_pair(
            lambda i: foot_radial[i] * cos[i] - foot_transverse[i] * sin[i]
        ),
        painleve_determinant=painleve_determinant,
    )


def _enumerate_mode_combinations() -> tuple[np.ndarray, np.ndarray]:
    """Return contact modes and closed stoppers for all combinations, each of shape (63, 2).

    The combinations are sorted by decreasing number of sticking feet, then of sliding feet. Two
    sticking feet of two legs on their stoppers are excluded. They constrain the hub twice, so their
    forces are not unique.
    """
    mode_priority = {
        ContactMode.STICK: 0,
        ContactMode.SLIP_DOWN: 1,
        ContactMode.SLIP_UP: 1,
        ContactMode.OFF: 2,
    }
    combinations = [
        (slot_modes, is_stopper_holding)
        for slot_modes in itertools.product(
            (ContactMode.STICK, ContactMode.SLIP_DOWN, ContactMode.SLIP_UP, ContactMode.OFF),
            repeat=2,
        )
        for is_stopper_holding in itertools.product((False, True), repeat=2)
        if not (slot_modes == (ContactMode.STICK, ContactMode.STICK) and all(is_stopper_holding))
    ]
    combinations.sort(
        key=lambda combination: (
            sum(mode_priority[mode] for mode in combination[0]),
            sum(combination[1]),
        )
    )
    return np.array([r[0] for r in combinations], np.int32), np.array([r[1] for r in combinations])


CONTACT_MODE_TABLE, HELD_STOPPER_TABLE = _enumerate_mode_combinations()
"""Contact modes and closed stoppers for all combinations in order of preference, each (63, 2)."""
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

CombinationMask = tuple[Any, Any]
"""Set of combinations, with one bit per combination in two 32-bit integers."""


class _ModeCombinationTable(NamedTuple):
    """Bit masks that mark the combinations with a given contact mode or closed stopper.

    The bits follow one order of the combinations.
    """

    masks_by_slot_mode: list[list[CombinationMask]]  # indexed by slot and mode
    masks_by_held_stopper: list[CombinationMask]  # indexed by slot

    @classmethod
    def from_indices(cls, indices: np.ndarray) -> "_ModeCombinationTable":
        """Return the bit masks for the combinations in the order `indices`."""

        def pack_bits(is_member: np.ndarray) -> CombinationMask:
            combination_masks = np.packbits(np.append(is_member, False), bitorder="little").view(
                "<i4"
            )
            return combination_masks[0], combination_masks[1]

        slot_modes = CONTACT_MODE_TABLE[indices].T
        is_stopper_holding = HELD_STOPPER_TABLE[indices].T
        mode_masks = [
            [pack_bits(slot_values == mode) for mode in ContactMode] for slot_values in slot_modes
        ]
        return cls(
            mode_masks, [pack_bits(is_slot_holding) for is_slot_holding in is_stopper_holding]
        )


_COMBINATION_TABLES = (
    _ModeCombinationTable.from_indices(PAPER_RULE_ORDER),
    _ModeCombinationTable.from_indices(np.arange(len(CONTACT_MODE_TABLE))),
)


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
        self, mode_combination_table: _ModeCombinationTable
    ) -> CombinationMask:
        """Return the bit mask of the combinations in `mode_combination_table` that are allowed."""

        def combine_combination_masks(mask_index: int) -> Array:
            allowed_mask = jnp.full_like(self.allowed_slot_modes[0], -1, jnp.int32)
            for i in range(2):
                masks_by_mode = enumerate(mode_combination_table.masks_by_slot_mode[i])
                slot_mode_masks = [
                    jnp.where(
                        is_mode_in_set(self.allowed_slot_modes[i], mode),
                        combination_mask[mask_index],
                        0,
                    )
                    for mode, combination_mask in masks_by_mode
                ]
                stopper_mask = jnp.where(
                    self.can_hold_stopper[i],
                    -1,
                    ~mode_combination_table.masks_by_held_stopper[i][mask_index],
                )
                allowed_mask = (
                    allowed_mask
                    & (
                        slot_mode_masks[0]
                        | slot_mode_masks[1]
                        | slot_mode_masks[2]
                        | slot_mode_masks[3]
                    )
                    & stopper_mask
                )
            return allowed_mask

        return combine_combination_masks(0), combine_combination_masks(1)


def is_mode_in_set(allowed_mode_set: Array, mode: Array | int) -> Bool[Array, "..."]:
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
    friction: Friction,
    allowed_modes: AllowedContactModes,
    tolerances: ContactSignTolerances,
    slot_modes: Array,
    is_stopper_holding: Array,
) -> Array:
    """Return the largest sign violation of a combination, divided by its tolerance."""
    is_friction_infinite = map_friction(
        lambda friction_coefficient: ~jnp.isfinite(friction_coefficient), friction
    )
    uses_friction_limit = map_friction(
        lambda friction_coefficient: friction_coefficient == jnp.inf, friction
    )
    slot_friction_coefficient = replace_infinite_friction(friction)
    solution = solve_combination(
        s, inverse_inertia, free_motion, slot_modes, is_stopper_holding, friction
    )
    max_violation, holds_along_slope = jnp.zeros_like(solution.hub_motion[0]), []
    for i in range(2):
        mode = slot_modes[i]
        holds_along_slope.append(
            is_stopper_holding[i]
            & (mode != ContactMode.OFF)
            & ((mode == ContactMode.STICK) | _get_slot_friction(i, uses_friction_limit))
        )
        zero_if_untested = lambda is_untested, friction_coefficient: jnp.where(
            is_untested, 0.0, friction_coefficient
        )
        is_untested = is_mode_in_set(allowed_modes.untested_slot_modes[i], mode)
        tangential_force, normal_force, foot_motion_x, foot_motion_z = (
            slot_pair[i]
            for slot_pair in (
                solution.tangential_forces,
                solution.normal_forces,
                solution.foot_motion_x,
                solution.foot_motion_z,
            )
        )
        pull_violation = -normal_force / tolerances.force_tolerance
        cone_violation = zero_if_untested(
            _get_slot_friction(i, is_friction_infinite),
            jnp.abs(tangential_force)
            - _get_slot_friction(i, slot_friction_coefficient) * normal_force,
        )
        stick_violation = zero_if_untested(
            is_untested, jnp.maximum(pull_violation, cone_violation / tolerances.force_tolerance)
        )
        slip_violation = (
            jnp.where(mode == ContactMode.SLIP_DOWN, -foot_motion_x, foot_motion_x)
            / tolerances.motion_tolerance
        )
        friction_violation = (
            jnp.where(mode == ContactMode.SLIP_DOWN, tangential_force, -tangential_force)
            / tolerances.force_tolerance
        )
        slide_violation = jnp.maximum(
            jnp.where(
                _get_slot_friction(i, uses_friction_limit), friction_violation, pull_violation
            ),
            zero_if_untested(is_untested, slip_violation),
        )
        loaded_violation = jnp.where(mode == ContactMode.STICK, stick_violation, slide_violation)
        foot_violation = jnp.where(
            mode == ContactMode.OFF,
            zero_if_untested(is_untested, -foot_motion_z / tolerances.motion_tolerance),
            loaded_violation,
        )
        open_violation = zero_if_untested(
            allowed_modes.is_open_stopper_untested[i],
            solution.length_motion[i] / tolerances.motion_tolerance,
        )
        stopper_violation = jnp.where(
            is_stopper_holding[i],
            -solution.stopper_forces[i] / tolerances.force_tolerance,
            open_violation,
        )
        max_violation = jnp.maximum(
            max_violation,
            jnp.maximum(
                zero_if_untested(allowed_modes.is_foot_mode_fixed[i], foot_violation),
                stopper_violation,
            ),
        )
        max_violation = jnp.where(
            jnp.isfinite(normal_force) & jnp.isfinite(tangential_force), max_violation, jnp.inf
        )
    # If both legs are held and both feet resist motion along the slope, the hub is rigid. The
    # tangential forces of the feet are then not separately determined.
    return jnp.where(holds_along_slope[0] & holds_along_slope[1], jnp.inf, max_violation)


def _find_least_violating_combination(
    evaluate_combination: Callable[[CombinationMask], Array], combinations: list[CombinationMask]
) -> tuple[CombinationMask, Array, Array]:
    """Return the first of the least violating combinations, its violation, and a count.

    The count is the number of admissible combinations. Several combinations are compared by one
    reduction. If they were read one by one, XLA on a CPU would duplicate the code of
    `evaluate_combination` for each use.
    """
    if len(combinations) == 1:
        sign_violation = evaluate_combination(combinations[0])
        return combinations[0], sign_violation, sign_violation == 0.0
    first_masks, second_masks = (
        jnp.stack(combination_masks) for combination_masks in zip(*combinations, strict=True)
    )
    sign_violations = jax.vmap(evaluate_combination)((first_masks, second_masks))
    combination_indices = lax.broadcasted_iota(jnp.int32, sign_violations.shape, 0)

    def pick_less_violating_combination(a: tuple, b: tuple) -> tuple:
        is_first_better = (a[0] < b[0]) | ((a[0] == b[0]) & (a[1] < b[1]))
        return (
            jnp.where(is_first_better, a[0], b[0]),
            jnp.where(is_first_better, a[1], b[1]),
            a[2] + b[2],
        )

    initial_lowest_sign_violation = (
        np.array(np.inf, sign_violations.dtype),
        np.int32(len(combinations)),
        np.int32(0),
    )
    reduction_operands = (
        sign_violations,
        combination_indices,
        (sign_violations == 0.0).astype(jnp.int32),
    )
    sign_violation, least_violating_index, n_admissible = lax.reduce(
        reduction_operands, initial_lowest_sign_violation, pick_less_violating_combination, (0,)
    )
    select_combinations = lambda combination_masks: jnp.sum(
        jnp.where(least_violating_index == combination_indices, combination_masks, 0),
        axis=0,
        dtype=jnp.int32,
    )
    return (
        (select_combinations(first_masks), select_combinations(second_masks)),
        sign_violation,
        n_admissible,
    )


def choose_combination(
    s: Symbols,
    inverse_inertia: ContactInverseInertia,
    free_motion: FreeMotion,
    allowed_modes: AllowedContactModes,
    friction: Friction,
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
    uses_paper_rule = map_friction(
        lambda friction_coefficient: friction_coefficient == PAPER_RULE_SENTINEL, friction
    )
    if isinstance(uses_paper_rule, tuple):
        uses_paper_rule = uses_paper_rule[0] & uses_paper_rule[1]
    mode_combination_table = jax.tree.map(
        lambda paper_mask, limit_mask: jnp.where(uses_paper_rule, paper_mask, limit_mask),
        *_COMBINATION_TABLES,
    )

    def decode_mode_combination(combination: CombinationMask) -> tuple[Array, Array]:
        is_combination_in_mask = lambda combination_mask: (
            ((combination[0] & combination_mask[0]) | (combination[1] & combination_mask[1])) != 0
        )
        slot_modes = [
            sum(
                jnp.where(is_combination_in_mask(masks_by_mode[mode]), mode, 0)
                for mode in range(1, 4)
            )
            for masks_by_mode in mode_combination_table.masks_by_slot_mode
        ]
        return jnp.stack(slot_modes).astype(jnp.int32), jnp.stack(
            [
                is_combination_in_mask(held_stopper_mask)
                for held_stopper_mask in mode_combination_table.masks_by_held_stopper
            ]
        )

    def evaluate_combination(combination: CombinationMask) -> Array:
        return jnp.where(
            (combination[0] | combination[1]) != 0,
            evaluate_modes(*decode_mode_combination(combination)),
            jnp.inf,
        )

    def is_unfinished(mode_enumeration_state: _ModeEnumerationState) -> Array:
        return (
            (
                mode_enumeration_state.untested_combination_mask[0]
                | mode_enumeration_state.untested_combination_mask[1]
            )
            != 0
        ) & (counts_all_solutions | (mode_enumeration_state.n_solutions == 0))

    def evaluate_next_combinations(
        mode_enumeration_state: _ModeEnumerationState,
    ) -> _ModeEnumerationState:
        """Return the state of the enumeration after the next few allowed combinations."""
        (untested_mask, best_combination, lowest_sign_violation, n_solutions), combinations = (
            mode_enumeration_state,
            [],
        )
        for _ in range(1 if simd.targets_machine_code() else N_COMBINATIONS_PER_ITERATION):
            combination = (
                untested_mask[0] & -untested_mask[0],
                jnp.where(untested_mask[0] == 0, untested_mask[1] & -untested_mask[1], 0),
            )
            untested_mask = untested_mask[0] ^ combination[0], untested_mask[1] ^ combination[1]
            combinations.append(combination)
        combination, combination_sign_violation, n_admissible = _find_least_violating_combination(
            evaluate_combination, combinations
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

    untested_mask = allowed_modes.mask_allowed_combinations(mode_combination_table)
    infinite_sign_violation = jnp.full_like(lax.stop_gradient(free_motion.hub_motion[2]), jnp.inf)
    initial_state = _ModeEnumerationState(
        untested_mask,
        (0 * untested_mask[0] + 1, 0 * untested_mask[1]),
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
    friction: Friction,
    is_second_slot: Bool[Array, "..."],
    release_direction: Int[Array, "..."],
) -> Bool[Array, "..."]:
    """Return whether a foot that is released from its contact mode moves in the release direction.

    - `slot_modes_and_stoppers`: contact modes of both feet, and flags of both stoppers, in the
      contact slots;
    - `is_second_slot`: whether the foot is the one in the second contact slot;
    - `release_direction`: 0 off the ground, 1 downhill, -1 uphill.

    The margin of the new contact mode must grow with the acceleration in that direction. If the
    margin shrinks, the new mode ends immediately, and the forces jump (Painlevé).
    """
    slot_modes, is_stopper_holding = slot_modes_and_stoppers
    slot_weights = jnp.stack([~is_second_slot, is_second_slot]).astype(inverse_inertia.sin[0].dtype)
    sin, cos = (
        slot_weights[0] * slot_pair[0] + slot_weights[1] * slot_pair[1]
        for slot_pair in (inverse_inertia.sin, inverse_inertia.cos)
    )
    is_liftoff = release_direction == 0
    e = jnp.where(is_liftoff, -sin, release_direction * cos)
    u = jnp.where(is_liftoff, cos, release_direction * sin)
    acceleration_unit = compute_wheel_units(s).acceleration_unit
    shift_slot_pair = lambda slot_pair, slot_shift: (
        slot_pair[0] - acceleration_unit * slot_shift * slot_weights[0],
        slot_pair[1] - acceleration_unit * slot_shift * slot_weights[1],
    )
    shifted_free_motion = free_motion._replace(
        foot_transverse_motion=shift_slot_pair(free_motion.foot_transverse_motion, e),
        foot_radial_motion=shift_slot_pair(free_motion.foot_radial_motion, u),
    )
    slot_friction = (
        jnp.where(is_second_slot, friction[1], friction[0])
        if isinstance(friction, tuple)
        else friction
    )
    slot_friction_coefficient = replace_infinite_friction(slot_friction)
    uses_friction_limit = slot_friction == jnp.inf
    mode = jnp.where(is_second_slot, slot_modes[1], slot_modes[0])
    slides_down = mode == ContactMode.SLIP_DOWN
    is_sliding = slides_down | (mode == ContactMode.SLIP_UP)

    def compute_mode_margin(assumed_motion: FreeMotion) -> Array:
        solution = solve_combination(
            s, inverse_inertia, assumed_motion, slot_modes, is_stopper_holding, friction
        )
        normal = jnp.where(is_second_slot, solution.normal_forces[1], solution.normal_forces[0])
        tangential = jnp.where(
            is_second_slot, solution.tangential_forces[1], solution.tangential_forces[0]
        )
        supporting_force = jnp.where(
            uses_friction_limit & is_sliding,
            jnp.where(slides_down, -tangential, tangential),
            normal,
        )
        return jnp.where(
            is_liftoff | uses_friction_limit,
            supporting_force,
            slot_friction_coefficient * normal + release_direction * tangential,
        )

    return compute_mode_margin(shifted_free_motion) > compute_mode_margin(free_motion)
