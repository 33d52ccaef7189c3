"""Contact modes (stick, slip, lift-off) of the feet and stopper states, by enumeration.

Every combination of contact modes and stoppers of the two slots is solved. In an admissible one,
normal forces push, friction lies in Coulomb's cone and opposes the slip, and open constraints do
not close. Of several, the one with the most sticking feet is chosen. The same table serves impacts
(impulses and the velocities after them) and motion (forces and accelerations).

Infinite friction is the limit of large friction. In Coulomb's |t| = mu n, a finite t leaves n = 0.
So a sliding foot is carried by friction alone, against its slip, and a resting foot begins to slide
where its normal force vanishes. The paper's rule (A1)-(A4) is a different one, selected by a
friction of minus infinity (`PAPER_RULE_SENTINEL`). A foot sticks if that requires no pull, and
lifts otherwise. Only if neither is possible, it slides without friction.
"""

import functools
import itertools
from collections.abc import Callable
from enum import IntEnum
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
from vrw_jax.numerics import Elementwise, tree_where
from vrw_jax.wheel import Symbols

Friction = Elementwise | SlotPair
"""Friction of all feet, or of each slot's foot."""


class ContactMode(IntEnum):
    """Contact mode of a foot, as it is stored in section states and trajectories."""

    OFF = 0  # in the air
    STICK = 1  # at rest on the ground
    SLIP_DOWN = 2  # sliding downhill
    SLIP_UP = 3  # sliding uphill


PAPER_RULE_SENTINEL = -np.inf
"""Friction that selects the paper's rule instead of the limit of large friction."""


class ContactSolution(NamedTuple):
    """Forces (N) and resulting accelerations, or impulses (N s) and the velocities after them."""

    tangential: SlotPair  # on each slot's foot, downhill positive
    normal: SlotPair  # pushing positive
    stopper: SlotPair  # of each slot's leg, pushing positive
    pull: SlotPair  # sum of stopper and foot force along u, acting on the leg's mass
    hub: HubVector
    length: SlotPair  # of each slot's leg
    foot_x: SlotPair  # of each slot's foot
    foot_z: SlotPair
    painleve_determinant: Any  # 1; zero if no force holds a sliding foot: Painlevé's singularity


Matrix2 = tuple[tuple[Any, Any], tuple[Any, Any]]
"""Matrix of two rows and two columns."""


def _solve_2x2(A: Matrix2, b: SlotPair) -> SlotPair:
    """Return the solution of a 2 x 2 system; NaN if the matrix is singular."""
    determinant = A[0][0] * A[1][1] - A[0][1] * A[1][0]
    scale = 1.0 / jnp.where(determinant == 0.0, jnp.nan, determinant)
    return (
        (A[1][1] * b[0] - A[0][1] * b[1]) * scale,
        (A[0][0] * b[1] - A[1][0] * b[0]) * scale,
    )


def _make_matrix(entry: Any) -> Matrix2:
    """Return the 2 x 2 matrix of the entries `entry(i, j)`."""
    return ((entry(0, 0), entry(0, 1)), (entry(1, 0), entry(1, 1)))


def _make_pair(entry: Any) -> SlotPair:
    """Return the entries `entry(0)` and `entry(1)`."""
    return entry(0), entry(1)


def map_friction(function: Callable[[Any], Any], friction: Friction) -> Any:
    """Return the function of the friction of all feet, or of each slot's."""
    is_pair = isinstance(friction, tuple)
    return (function(friction[0]), function(friction[1])) if is_pair else function(friction)


def _friction_of_slot(i: int, friction: Any) -> Any:
    """Return the friction of slot i."""
    return friction[i] if isinstance(friction, tuple) else friction


def finite_friction(friction: Friction) -> Any:
    """Return Coulomb's coefficient; 0 for infinite friction, which exerts none on a sliding
    foot.
    """
    return map_friction(lambda value: jnp.where(jnp.isfinite(value), value, 0.0), friction)


class _FootEquations(NamedTuple):
    """Conditions of a combination at each slot's foot.

    The unknown c is the force along e for a sticking foot. For a sliding foot it is the normal
    force, or the friction force in the limit of infinite friction. An unloaded foot has c = 0.
    """

    is_sticking: SlotPair
    is_loaded: SlotPair
    force_e: SlotPair  # force along e for c = 1
    force_u: SlotPair  # along u, except for the own leg's part of a sticking foot
    row_e: SlotPair  # weight of the foot's motion along e in the zero condition
    row_u: SlotPair  # weight of the foot's force on the leg's mass in it


def _make_foot_equations(
    s: Symbols, inertia: ContactInverseInertia, contact: Array, friction: Friction
) -> _FootEquations:
    """Return the conditions of these contact modes."""
    sin, cos = inertia.sin, inertia.cos
    coefficient = map_friction(
        lambda value: jnp.where(value == jnp.inf, 1.0, jnp.where(jnp.isfinite(value), value, 0.0)),
        friction,
    )
    normal_share = map_friction(lambda value: jnp.where(value == jnp.inf, 0.0, 1.0), friction)
    is_sticking = _make_pair(lambda i: contact[i] == ContactMode.STICK)
    is_sliding = _make_pair(
        lambda i: (contact[i] == ContactMode.SLIP_DOWN) | (contact[i] == ContactMode.SLIP_UP)
    )
    drag = _make_pair(
        lambda i: jnp.where(
            contact[i] == ContactMode.SLIP_DOWN,
            -_friction_of_slot(i, coefficient),
            _friction_of_slot(i, coefficient),
        )
    )
    select_by_mode = lambda i, if_sticking, if_sliding: jnp.where(
        is_sticking[i], if_sticking, jnp.where(is_sliding[i], if_sliding, 0.0)
    )
    return _FootEquations(
        is_sticking=is_sticking,
        is_loaded=_make_pair(lambda i: is_sticking[i] | is_sliding[i]),
        force_e=_make_pair(
            lambda i: select_by_mode(
                i, 1.0, drag[i] * cos[i] - _friction_of_slot(i, normal_share) * sin[i]
            )
        ),
        force_u=_make_pair(
            lambda i: select_by_mode(
                i, 0.0, drag[i] * sin[i] + _friction_of_slot(i, normal_share) * cos[i]
            )
        ),
        row_e=_make_pair(lambda i: select_by_mode(i, 1.0, -sin[i])),
        row_u=_make_pair(lambda i: select_by_mode(i, 0.0, cos[i] * (1.0 / s.m))),
    )


def _identity_entry(i: int, j: int) -> float:
    """Return an entry of the identity matrix."""
    return 1.0 if i == j else 0.0


def _eliminate_stoppers(
    s: Symbols,
    inertia: ContactInverseInertia,
    free: FreeMotion,
    held: Array,
    foot_equations: _FootEquations,
    unit: Array,
) -> tuple[SlotPair, Matrix2]:
    """Return the stopper forces without the feet, and the effect of each foot's c, [foot][stopper].

    They solve N s = p + P c, where the row of an open stopper is s = 0: the system is always
    regular.
    """
    sin, cos, m_inv = inertia.sin, inertia.cos, 1.0 / s.m
    H = ((inertia.H[0], inertia.H[1]), (inertia.H[2], inertia.H[3]))
    K = ((inertia.K[0], inertia.K[1]), inertia.K[1:])
    compliance = _make_pair(lambda i: jnp.where(foot_equations.is_sticking[i], 0.0, m_inv))
    N = _make_matrix(
        lambda i, j: jnp.where(
            held[i], K[i][j] + _identity_entry(i, j) * compliance[i], _identity_entry(i, j)
        )
    )
    outward = _make_pair(lambda i: sin[i] * free.hub[0] + cos[i] * free.hub[1] + free.slot_legs[i])
    free_growth = _make_pair(
        lambda i: outward[i] + jnp.where(foot_equations.is_sticking[i], free.foot_u[i], 0.0)
    )
    p = _make_pair(lambda i: jnp.where(held[i], free_growth[i], 0.0))
    foot_effect = lambda i, j: (
        H[i][j] * foot_equations.force_e[j]
        - _identity_entry(i, j) * foot_equations.force_u[i] * m_inv
    )
    P = _make_matrix(lambda i, j: jnp.where(held[i], foot_effect(i, j), 0.0))
    p, P, N = prevent_fusion((p, P, N), unit)
    return prevent_fusion(
        (_solve_2x2(N, p), _make_pair(lambda j: _solve_2x2(N, (P[0][j], P[1][j])))), unit
    )


REFERENCE_MASS_RATIO = 18.0
"""Ratio of total mass to leg mass at which feet at rest and sliding feet have the same scale in the
determinant. It is that of Table 1's wheel, chosen because `PAINLEVE_ATOL` is measured there."""


def _solve_feet(
    s: Symbols,
    inertia: ContactInverseInertia,
    free: FreeMotion,
    foot_equations: _FootEquations,
    stopper_alone: SlotPair,
    stopper_columns: Matrix2,
    unit: Array,
) -> tuple[SlotPair, SlotPair, SlotPair, Any]:
    """Return the forces of the stoppers, of the feet along e and along u, and the determinant.

    The feet's equations are solved with the stoppers of `_eliminate_stoppers` inserted.
    """
    row_e = foot_equations.row_e
    row_u = foot_equations.row_u
    to_e = foot_equations.force_e
    to_u = foot_equations.force_u
    G = ((inertia.G[0], inertia.G[1]), inertia.G[1:])
    H = ((inertia.H[0], inertia.H[1]), (inertia.H[2], inertia.H[3]))
    R = _make_matrix(lambda i, k: _identity_entry(i, k) * row_u[i] - row_e[i] * H[k][i])
    C = _make_matrix(
        lambda i, j: (
            row_e[i] * G[i][j] * to_e[j]
            + _identity_entry(i, j) * row_u[i] * to_u[i]
            + R[i][0] * stopper_columns[j][0]
            + R[i][1] * stopper_columns[j][1]
            + _identity_entry(i, j) * jnp.where(foot_equations.is_loaded[i], 0.0, 1.0)
        )
    )
    right_hand_side = _make_pair(
        lambda i: -row_e[i] * free.foot_e[i] - row_u[i] * s.m * free.foot_u[i]
    )
    c = _solve_2x2(
        C,
        _make_pair(
            lambda i: right_hand_side[i] - R[i][0] * stopper_alone[0] - R[i][1] * stopper_alone[1]
        ),
    )
    stopper = _make_pair(
        lambda k: stopper_alone[k] + stopper_columns[0][k] * c[0] + stopper_columns[1][k] * c[1]
    )
    along_e = _make_pair(lambda i: to_e[i] * c[i])
    if_sticking = _make_pair(lambda i: -s.m * free.foot_u[i] - stopper[i])
    along_u = _make_pair(
        lambda i: jnp.where(foot_equations.is_sticking[i], if_sticking[i], to_u[i] * c[i])
    )
    masses = _make_pair(
        lambda i: jnp.where(foot_equations.is_sticking[i], s.Mt / REFERENCE_MASS_RATIO, s.m)
    )
    masses = _make_pair(lambda i: jnp.where(foot_equations.is_loaded[i], masses[i], 1.0))
    painleve_determinant = masses[0] * masses[1] * (C[0][0] * C[1][1] - C[0][1] * C[1][0])
    return prevent_fusion((stopper, along_e, along_u, painleve_determinant), unit)


@eqx.filter_jit  # traced once for all call sites
def solve_combination(
    s: Symbols,
    inertia: ContactInverseInertia,
    free: FreeMotion,
    contact: Array,
    held: Array,
    friction: Friction,
) -> ContactSolution:
    """Return the solution of one combination of contact modes and stoppers of the two slots, shape
    (2,).

    A sticking foot is at rest, a sliding foot keeps its height with friction against the slip, and
    a held leg keeps its length. The stoppers are eliminated first.
    """
    sin, cos, m_inv = inertia.sin, inertia.cos, 1.0 / s.m
    unit = 1.0 + 0.0 * lax.stop_gradient(free.hub[2])
    foot_equations = _make_foot_equations(s, inertia, contact, friction)
    stopper_system = _eliminate_stoppers(s, inertia, free, held, foot_equations, unit)
    stopper, along_e, along_u, painleve_determinant = _solve_feet(
        s, inertia, free, foot_equations, *stopper_system, unit
    )
    pull = _make_pair(lambda i: along_u[i] + stopper[i])
    z, y = inertia.response_e, inertia.response_u
    hub_with_feet = [free.hub[k] + z[0][k] * along_e[0] + z[1][k] * along_e[1] for k in range(3)]
    vx, vz, omega = (
        hub_with_feet[k] - y[0][k] * stopper[0] - y[1][k] * stopper[1] for k in range(3)
    )
    dx, dz, domega = vx - free.hub[0], vz - free.hub[1], omega - free.hub[2]
    foot_e = _make_pair(
        lambda i: cos[i] * dx - sin[i] * dz - inertia.L[i] * domega + free.foot_e[i]
    )
    foot_u = _make_pair(lambda i: free.foot_u[i] + pull[i] * m_inv)
    free_growth = _make_pair(
        lambda i: sin[i] * vx + cos[i] * vz + free.slot_legs[i] - pull[i] * m_inv
    )
    return ContactSolution(
        tangential=_make_pair(lambda i: along_e[i] * cos[i] + along_u[i] * sin[i]),
        normal=_make_pair(lambda i: along_u[i] * cos[i] - along_e[i] * sin[i]),
        stopper=stopper,
        pull=pull,
        hub=(vx, vz, omega),
        length=_make_pair(lambda i: jnp.where(held[i], 0.0, free_growth[i])),
        foot_x=_make_pair(lambda i: foot_e[i] * cos[i] + foot_u[i] * sin[i]),
        foot_z=_make_pair(lambda i: foot_u[i] * cos[i] - foot_e[i] * sin[i]),
        painleve_determinant=painleve_determinant,
    )


def _enumerate_combinations() -> tuple[np.ndarray, np.ndarray]:
    """Return all combinations of modes and stoppers, most sticking feet first, then most sliding
    ones.

    Two sticking feet on two held legs are excluded: they constrain the hub twice, so that their
    forces are not determined.
    """
    rank = {
        ContactMode.STICK: 0,
        ContactMode.SLIP_DOWN: 1,
        ContactMode.SLIP_UP: 1,
        ContactMode.OFF: 2,
    }
    rows = [
        (modes, held)
        for modes in itertools.product(
            (ContactMode.STICK, ContactMode.SLIP_DOWN, ContactMode.SLIP_UP, ContactMode.OFF),
            repeat=2,
        )
        for held in itertools.product((False, True), repeat=2)
        if not (modes == (ContactMode.STICK, ContactMode.STICK) and all(held))
    ]
    rows.sort(key=lambda row: (sum(rank[mode] for mode in row[0]), sum(row[1])))
    return np.array([r[0] for r in rows], np.int32), np.array([r[1] for r in rows])


MODE_TABLE, HELD_TABLE = _enumerate_combinations()
"""Combinations in order of preference: contact modes and held stoppers, shape (63, 2) each."""
PAPER_RULE_ORDER = np.argsort(
    [
        sum({ContactMode.STICK: 0, ContactMode.OFF: 2}.get(ContactMode(m), 5) for m in row)
        for row in MODE_TABLE
    ],
    kind="stable",
)
"""Order of the combinations by the paper's rule: sliding comes last."""
N_CONCURRENT_COMBINATIONS = 8
"""Number of combinations that XLA solves together, chosen because most events allow no more.
Machine code solves them one after the other."""
ALL_MODES_MASK = sum(1 << mode for mode in ContactMode)
"""Set of all modes, one bit per mode."""

RowSet = tuple[Any, Any]
"""A set of rows of the table: the bits of two words."""


class _TableOrder(NamedTuple):
    """The table in one order, as sets of rows with a property in common."""

    contact: list[list[RowSet]]  # by slot and mode
    held: list[RowSet]  # by slot

    @classmethod
    def from_rows(cls, rows: np.ndarray) -> "_TableOrder":
        """Return the table with its rows in this order."""

        def pack_bits(flags: np.ndarray) -> RowSet:
            words = np.packbits(np.append(flags, False), bitorder="little").view("<i4")
            return words[0], words[1]

        modes, held = MODE_TABLE[rows].T, HELD_TABLE[rows].T
        contact = [
            [pack_bits(slot_column == mode) for mode in ContactMode] for slot_column in modes
        ]
        return cls(contact, [pack_bits(slot_column) for slot_column in held])


_TABLE_ORDERS = (
    _TableOrder.from_rows(PAPER_RULE_ORDER),
    _TableOrder.from_rows(np.arange(len(MODE_TABLE))),
)


class AllowedModes(NamedTuple):
    """Allowed combinations, and conditions that need no test. Sets of modes are bits."""

    contact: Int[Array, "2 ..."]  # modes of each slot's foot
    may_hold: Bool[Array, "2 ..."]  # the stopper may hold; it may always be open
    keeps_mode: Bool[Array, "2 ..."]  # the foot keeps its mode whatever the force
    untested_modes: Int[Array, "2 ..."]  # modes that need no test
    untested_open: Bool[Array, "2 ..."]  # an open stopper needs no test: the leg is away from it

    def allowed_rows(self, order: _TableOrder) -> RowSet:
        """Return the allowed rows of the table."""

        def select_word(word_index: int) -> Array:
            remaining = jnp.full_like(self.contact[0], -1, jnp.int32)
            for i in range(2):
                rows_by_mode = enumerate(order.contact[i])
                mode_rows = [
                    jnp.where(contains_mode(self.contact[i], mode), rows[word_index], 0)
                    for mode, rows in rows_by_mode
                ]
                held_rows = jnp.where(self.may_hold[i], -1, ~order.held[i][word_index])
                remaining = (
                    remaining
                    & (mode_rows[0] | mode_rows[1] | mode_rows[2] | mode_rows[3])
                    & held_rows
                )
            return remaining

        return select_word(0), select_word(1)


def contains_mode(modes: Array, mode: Array | int) -> Bool[Array, "..."]:
    """Return whether the set contains the mode."""
    return ((modes >> mode) & 1) > 0


class ChosenCombination(NamedTuple):
    """The chosen combination."""

    contact: Int[Array, "2 ..."]
    held: Bool[Array, "2 ..."]
    violation: Elementwise  # worst sign violation, see `SignTolerances`; 0 if admissible
    n_solutions: Int[Array, "..."]  # admissible ones; at least 1 if the violation is small


class SignTolerances(NamedTuple):
    """Units in which sign violations are measured where rounding decides."""

    force: Elementwise  # N, or N s in an impact
    motion: Elementwise  # m/s^2, or m/s


MAX_VIOLATION = 1e3
"""Largest accepted violation, in units of `SignTolerances`, if no combination has all signs
correct."""


class _EnumerationState(NamedTuple):
    """State of the enumeration of the table."""

    remaining: RowSet  # allowed rows not yet examined
    best_row: RowSet  # first admissible row, else the least violating one
    violation: Elementwise
    n_solutions: Int[Array, "..."]


def _violation(
    s: Symbols,
    inertia: ContactInverseInertia,
    free: FreeMotion,
    friction: Friction,
    allowed: AllowedModes,
    tolerances: SignTolerances,
    contact: Array,
    held: Array,
) -> Array:
    """Return the largest sign violation of a combination, in units of the tolerances."""
    is_infinite = map_friction(lambda value: ~jnp.isfinite(value), friction)
    is_limit = map_friction(lambda value: value == jnp.inf, friction)
    coefficient = finite_friction(friction)
    solution = solve_combination(s, inertia, free, contact, held, friction)
    max_violation, holds_along_slope = jnp.zeros_like(solution.hub[0]), []
    for i in range(2):
        mode = contact[i]
        holds_along_slope.append(
            held[i]
            & (mode != ContactMode.OFF)
            & ((mode == ContactMode.STICK) | _friction_of_slot(i, is_limit))
        )
        zero_if = lambda is_untested, value: jnp.where(is_untested, 0.0, value)
        is_untested = contains_mode(allowed.untested_modes[i], mode)
        t, n, x, z = (
            pair[i]
            for pair in (solution.tangential, solution.normal, solution.foot_x, solution.foot_z)
        )
        pull_violation = -n / tolerances.force
        cone_violation = zero_if(
            _friction_of_slot(i, is_infinite),
            jnp.abs(t) - _friction_of_slot(i, coefficient) * n,
        )
        stick_violation = zero_if(
            is_untested, jnp.maximum(pull_violation, cone_violation / tolerances.force)
        )
        slip_violation = jnp.where(mode == ContactMode.SLIP_DOWN, -x, x) / tolerances.motion
        friction_violation = jnp.where(mode == ContactMode.SLIP_DOWN, t, -t) / tolerances.force
        slide_violation = jnp.maximum(
            jnp.where(_friction_of_slot(i, is_limit), friction_violation, pull_violation),
            zero_if(is_untested, slip_violation),
        )
        loaded_violation = jnp.where(mode == ContactMode.STICK, stick_violation, slide_violation)
        foot_violation = jnp.where(
            mode == ContactMode.OFF, zero_if(is_untested, -z / tolerances.motion), loaded_violation
        )
        open_violation = zero_if(allowed.untested_open[i], solution.length[i] / tolerances.motion)
        stopper_violation = jnp.where(
            held[i], -solution.stopper[i] / tolerances.force, open_violation
        )
        max_violation = jnp.maximum(
            max_violation,
            jnp.maximum(zero_if(allowed.keeps_mode[i], foot_violation), stopper_violation),
        )
        max_violation = jnp.where(jnp.isfinite(n) & jnp.isfinite(t), max_violation, jnp.inf)
    # The tangential forces of both feet are not separately determined on a rigid wheel.
    return jnp.where(holds_along_slope[0] & holds_along_slope[1], jnp.inf, max_violation)


def _least_violating(
    violation_of: Callable[[RowSet], Array], rows: list[RowSet]
) -> tuple[RowSet, Array, Array]:
    """Return the first of the least violating rows, its violation, and the number of admissible
    rows.

    Several rows are compared by one reduction. Read row by row, XLA on a CPU would duplicate the
    code of `violation_of` for each use, eightfold.
    """
    if len(rows) == 1:
        violation = violation_of(rows[0])
        return rows[0], violation, violation == 0.0
    first_words, second_words = (jnp.stack(words) for words in zip(*rows, strict=True))
    violations = jax.vmap(violation_of)((first_words, second_words))
    indices = lax.broadcasted_iota(jnp.int32, violations.shape, 0)

    def pick_better(a: tuple, b: tuple) -> tuple:
        a_is_better = (a[0] < b[0]) | ((a[0] == b[0]) & (a[1] < b[1]))
        return jnp.where(a_is_better, a[0], b[0]), jnp.where(a_is_better, a[1], b[1]), a[2] + b[2]

    initial = np.array(np.inf, violations.dtype), np.int32(len(rows)), np.int32(0)
    operands = violations, indices, (violations == 0.0).astype(jnp.int32)
    violation, index, n_admissible = lax.reduce(operands, initial, pick_better, (0,))
    select_word = lambda words: jnp.sum(
        jnp.where(index == indices, words, 0), axis=0, dtype=jnp.int32
    )
    return (select_word(first_words), select_word(second_words)), violation, n_admissible


def choose_combination(
    s: Symbols,
    inertia: ContactInverseInertia,
    free: FreeMotion,
    allowed: AllowedModes,
    friction: Friction,
    tolerances: SignTolerances,
    counts_all: bool,
) -> ChosenCombination:
    """Return the first admissible combination of the table; `n_solutions` is 0 if there is none.

    With `counts_all` all admissible combinations are counted; otherwise the search ends at the
    first. If there is none, the least violating combination is taken, provided that its violation
    is small: two contacts close by rounding, or open by it.
    """
    violation_of_modes = functools.partial(
        _violation, *lax.stop_gradient((s, inertia, free, friction)), allowed, tolerances
    )
    uses_paper_rule = map_friction(lambda value: value == PAPER_RULE_SENTINEL, friction)
    if isinstance(uses_paper_rule, tuple):
        uses_paper_rule = uses_paper_rule[0] & uses_paper_rule[1]
    order = jax.tree.map(
        lambda paper_words, limit_words: jnp.where(uses_paper_rule, paper_words, limit_words),
        *_TABLE_ORDERS,
    )

    def decode_row(row: RowSet) -> tuple[Array, Array]:
        is_member = lambda rows: ((row[0] & rows[0]) | (row[1] & rows[1])) != 0
        modes = [
            sum(jnp.where(is_member(slot_rows[mode]), mode, 0) for mode in range(1, 4))
            for slot_rows in order.contact
        ]
        return jnp.stack(modes).astype(jnp.int32), jnp.stack(
            [is_member(slot_rows) for slot_rows in order.held]
        )

    def violation_of(row: RowSet) -> Array:
        return jnp.where((row[0] | row[1]) != 0, violation_of_modes(*decode_row(row)), jnp.inf)

    def is_unfinished(state: _EnumerationState) -> Array:
        return ((state.remaining[0] | state.remaining[1]) != 0) & (
            counts_all | (state.n_solutions == 0)
        )

    def examine_next(state: _EnumerationState) -> _EnumerationState:
        """Return the state after the next few allowed combinations."""
        (remaining, best_row, lowest, n_solutions), rows = state, []
        for _ in range(1 if simd.targets_machine_code() else N_CONCURRENT_COMBINATIONS):
            row = (
                remaining[0] & -remaining[0],
                jnp.where(remaining[0] == 0, remaining[1] & -remaining[1], 0),
            )
            remaining = remaining[0] ^ row[0], remaining[1] ^ row[1]
            rows.append(row)
        row, row_violation, n_admissible = _least_violating(violation_of, rows)
        best_row, lowest = tree_where(
            row_violation < lowest, (row, row_violation), (best_row, lowest)
        )
        n_solutions = n_solutions + n_admissible
        return tree_where(
            is_unfinished(state), _EnumerationState(remaining, best_row, lowest, n_solutions), state
        )

    remaining = allowed.allowed_rows(order)
    infinite = jnp.full_like(lax.stop_gradient(free.hub[2]), jnp.inf)
    initial = _EnumerationState(
        remaining, (0 * remaining[0] + 1, 0 * remaining[1]), infinite, 0 * remaining[0]
    )
    state = lax.while_loop(lambda state: jnp.any(is_unfinished(state)), examine_next, initial)
    solutions = jnp.maximum(state.n_solutions, (state.violation <= MAX_VIOLATION).astype(jnp.int32))
    return ChosenCombination(*decode_row(state.best_row), state.violation, solutions)


def is_release_consistent(
    s: Symbols,
    inertia: ContactInverseInertia,
    free: FreeMotion,
    slot_state: tuple[Array, Array],
    friction: Friction,
    is_second: Bool[Array, "..."],
    direction: Int[Array, "..."],
) -> Bool[Array, "..."]:
    """Return whether a slot's foot, just released by its mode, would move in the direction of
    release.

    - `is_second`: which slot is meant;
    - `direction`: 0 off the ground, 1 downhill, -1 uphill.

    The margin of the mode must grow with the acceleration in that direction. If it shrinks, the
    following mode would end before it begins, and the forces jump instead (Painlevé).
    """
    contact, held = slot_state
    slot_weights = jnp.stack([~is_second, is_second]).astype(inertia.sin[0].dtype)
    sin, cos = (
        slot_weights[0] * pair[0] + slot_weights[1] * pair[1] for pair in (inertia.sin, inertia.cos)
    )
    is_liftoff = direction == 0
    e, u = jnp.where(is_liftoff, -sin, direction * cos), jnp.where(is_liftoff, cos, direction * sin)
    shift_pair = lambda pair, delta: (
        pair[0] - delta * slot_weights[0],
        pair[1] - delta * slot_weights[1],
    )
    displaced = free._replace(foot_e=shift_pair(free.foot_e, e), foot_u=shift_pair(free.foot_u, u))
    slot_friction = (
        jnp.where(is_second, friction[1], friction[0]) if isinstance(friction, tuple) else friction
    )
    coefficient = finite_friction(slot_friction)
    is_limit, mode = slot_friction == jnp.inf, jnp.where(is_second, contact[1], contact[0])
    slides_down = mode == ContactMode.SLIP_DOWN
    is_sliding = slides_down | (mode == ContactMode.SLIP_UP)

    def mode_margin(free_motion: FreeMotion) -> Array:
        solution = solve_combination(s, inertia, free_motion, contact, held, friction)
        normal = jnp.where(is_second, solution.normal[1], solution.normal[0])
        tangential = jnp.where(is_second, solution.tangential[1], solution.tangential[0])
        pressure = jnp.where(
            is_limit & is_sliding, jnp.where(slides_down, -tangential, tangential), normal
        )
        return jnp.where(
            is_liftoff | is_limit, pressure, coefficient * normal + direction * tangential
        )

    return mode_margin(displaced) > mode_margin(free)
