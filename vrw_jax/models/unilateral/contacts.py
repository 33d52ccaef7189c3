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
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Int

from vrw_jax import simd
from vrw_jax.models.unilateral.mechanics import Free, Hub, Pair, Vector3, kept
from vrw_jax.numerics import Elementwise, select
from vrw_jax.wheel import Symbols

Roughness = Elementwise | Pair
"""Friction of all feet, or of each slot's foot."""
OFF, STICK, SLIP_DOWN, SLIP_UP = 0, 1, 2, 3
"""Contact modes of a foot: in the air, at rest, sliding downhill, sliding uphill."""


THE_PAPERS = -np.inf
"""Friction that selects the paper's rule instead of the limit of large friction."""


class Answer(NamedTuple):
    """Forces (N) and resulting accelerations, or impulses (N s) and the velocities after them."""

    tangential: Pair  # on each slot's foot, downhill positive
    normal: Pair  # pushing positive
    stopper: Pair  # of each slot's leg, pushing positive
    pull: Pair  # sum of stopper and foot force along u, acting on the leg's mass
    hub: Vector3
    length: Pair  # of each slot's leg
    foot_x: Pair  # of each slot's foot
    foot_z: Pair
    regular: Any  # zero if no force holds a sliding foot: Painlevé's singularity


Matrix = tuple[tuple[Any, Any], tuple[Any, Any]]
"""Matrix of two rows and two columns."""


def _solved(A: Matrix, b: Pair) -> Pair:
    """Return the solution of a 2 x 2 system; NaN if the matrix is singular."""
    determinant = A[0][0] * A[1][1] - A[0][1] * A[1][0]
    scale = 1.0 / jnp.where(determinant == 0.0, jnp.nan, determinant)
    return (
        (A[1][1] * b[0] - A[0][1] * b[1]) * scale,
        (A[0][0] * b[1] - A[1][0] * b[0]) * scale,
    )


def _matrix(entry: Any) -> Matrix:
    """Return the 2 x 2 matrix of the entries `entry(i, j)`."""
    return ((entry(0, 0), entry(0, 1)), (entry(1, 0), entry(1, 1)))


def _pair(entry: Any) -> Pair:
    """Return the entries `entry(0)` and `entry(1)`."""
    return entry(0), entry(1)


def each(function: Callable[[Any], Any], friction: Roughness) -> Any:
    """Return the function of the friction of all feet, or of each slot's."""
    pair = isinstance(friction, tuple)
    return (function(friction[0]), function(friction[1])) if pair else function(friction)


def _at(i: int, friction: Any) -> Any:
    """Return the friction of slot i."""
    return friction[i] if isinstance(friction, tuple) else friction


def rough_of(friction: Roughness) -> Any:
    """Return Coulomb's coefficient; 0 for infinite friction, which exerts none on a sliding
    foot.
    """
    return each(lambda value: jnp.where(jnp.isfinite(value), value, 0.0), friction)


class _Feet(NamedTuple):
    """Conditions of a combination at each slot's foot.

    The unknown c is the force along e for a sticking foot. For a sliding foot it is the normal
    force, or the friction force in the limit of infinite friction. An unloaded foot has c = 0.
    """

    stick: Pair
    loaded: Pair
    to_e: Pair  # force along e for c = 1
    to_u: Pair  # along u, except for the own leg's part of a sticking foot
    row_e: Pair  # weight of the foot's motion along e in the zero condition
    row_u: Pair  # weight of the foot's force on the leg's mass in it


def _feet(s: Symbols, hub: Hub, contact: Array, friction: Roughness) -> _Feet:
    """Return the conditions of these contact modes."""
    sin, cos = hub.sin, hub.cos
    rough = each(
        lambda value: jnp.where(value == jnp.inf, 1.0, jnp.where(jnp.isfinite(value), value, 0.0)),
        friction,
    )
    press = each(lambda value: jnp.where(value == jnp.inf, 0.0, 1.0), friction)
    stick = _pair(lambda i: contact[i] == STICK)
    slip = _pair(lambda i: (contact[i] == SLIP_DOWN) | (contact[i] == SLIP_UP))
    drag = _pair(lambda i: jnp.where(contact[i] == SLIP_DOWN, -_at(i, rough), _at(i, rough)))
    chosen = lambda i, sticks, slides: jnp.where(stick[i], sticks, jnp.where(slip[i], slides, 0.0))
    return _Feet(
        stick=stick,
        loaded=_pair(lambda i: stick[i] | slip[i]),
        to_e=_pair(lambda i: chosen(i, 1.0, drag[i] * cos[i] - _at(i, press) * sin[i])),
        to_u=_pair(lambda i: chosen(i, 0.0, drag[i] * sin[i] + _at(i, press) * cos[i])),
        row_e=_pair(lambda i: chosen(i, 1.0, -sin[i])),
        row_u=_pair(lambda i: chosen(i, 0.0, cos[i] * (1.0 / s.m))),
    )


def _same(i: int, j: int) -> float:
    """Return an entry of the identity matrix."""
    return 1.0 if i == j else 0.0


def _stoppers(
    s: Symbols, hub: Hub, free: Free, held: Array, feet: _Feet, one: Array
) -> tuple[Pair, Matrix]:
    """Return the stopper forces without the feet, and the effect of each foot's c, [foot][stopper].

    They solve N s = p + P c, where the row of an open stopper is s = 0: the system is always
    regular.
    """
    sin, cos, m_inv = hub.sin, hub.cos, 1.0 / s.m
    H, K = ((hub.H[0], hub.H[1]), (hub.H[2], hub.H[3])), ((hub.K[0], hub.K[1]), hub.K[1:])
    loose = _pair(lambda i: jnp.where(feet.stick[i], 0.0, m_inv))
    N = _matrix(lambda i, j: jnp.where(held[i], K[i][j] + _same(i, j) * loose[i], _same(i, j)))
    across = _pair(lambda i: sin[i] * free.hub[0] + cos[i] * free.hub[1] + free.own[i])
    grows = _pair(lambda i: across[i] + jnp.where(feet.stick[i], free.u[i], 0.0))
    p = _pair(lambda i: jnp.where(held[i], grows[i], 0.0))
    added = lambda i, j: H[i][j] * feet.to_e[j] - _same(i, j) * feet.to_u[i] * m_inv
    P = _matrix(lambda i, j: jnp.where(held[i], added(i, j), 0.0))
    p, P, N = kept((p, P, N), one)
    return kept((_solved(N, p), _pair(lambda j: _solved(N, (P[0][j], P[1][j])))), one)


def _carried(
    s: Symbols, hub: Hub, free: Free, feet: _Feet, alone: Pair, columns: Matrix, one: Array
) -> tuple[Pair, Pair, Pair, Any]:
    """Return the forces of the stoppers, of the feet along e and along u, and the determinant.

    The feet's equations are solved with the stoppers of `_eliminate_stoppers` inserted.
    """
    row_e, row_u, to_e, to_u = feet.row_e, feet.row_u, feet.to_e, feet.to_u
    G, H = ((hub.G[0], hub.G[1]), hub.G[1:]), ((hub.H[0], hub.H[1]), (hub.H[2], hub.H[3]))
    R = _matrix(lambda i, k: _same(i, k) * row_u[i] - row_e[i] * H[k][i])
    C = _matrix(
        lambda i, j: (
            row_e[i] * G[i][j] * to_e[j]
            + _same(i, j) * row_u[i] * to_u[i]
            + R[i][0] * columns[j][0]
            + R[i][1] * columns[j][1]
            + _same(i, j) * jnp.where(feet.loaded[i], 0.0, 1.0)
        )
    )
    moves = _pair(lambda i: -row_e[i] * free.e[i] - row_u[i] * s.m * free.u[i])
    c = _solved(C, _pair(lambda i: moves[i] - R[i][0] * alone[0] - R[i][1] * alone[1]))
    stopper = _pair(lambda k: alone[k] + columns[0][k] * c[0] + columns[1][k] * c[1])
    along_e = _pair(lambda i: to_e[i] * c[i])
    sticks = _pair(lambda i: -s.m * free.u[i] - stopper[i])
    along_u = _pair(lambda i: jnp.where(feet.stick[i], sticks[i], to_u[i] * c[i]))
    regular = s.m * s.m * (C[0][0] * C[1][1] - C[0][1] * C[1][0])
    return kept((stopper, along_e, along_u, regular), one)


@eqx.filter_jit  # traced once for all call sites
def answer(
    s: Symbols, hub: Hub, free: Free, contact: Array, held: Array, friction: Roughness
) -> Answer:
    """Return the solution of one combination of contact modes and stoppers of the two slots, shape
    (2,).

    A sticking foot is at rest, a sliding foot keeps its height with friction against the slip, and
    a held leg keeps its length. The stoppers are eliminated first.
    """
    sin, cos, m_inv = hub.sin, hub.cos, 1.0 / s.m
    one = 1.0 + 0.0 * lax.stop_gradient(free.hub[2])
    feet = _feet(s, hub, contact, friction)
    stoppers = _stoppers(s, hub, free, held, feet, one)
    stopper, along_e, along_u, regular = _carried(s, hub, free, feet, *stoppers, one)
    pull = _pair(lambda i: along_u[i] + stopper[i])
    z, y = hub.along_e, hub.along_u
    by_feet = [free.hub[k] + z[0][k] * along_e[0] + z[1][k] * along_e[1] for k in range(3)]
    vx, vz, turn = (by_feet[k] - y[0][k] * stopper[0] - y[1][k] * stopper[1] for k in range(3))
    dx, dz, dturn = vx - free.hub[0], vz - free.hub[1], turn - free.hub[2]
    foot_e = _pair(lambda i: cos[i] * dx - sin[i] * dz - hub.L[i] * dturn + free.e[i])
    foot_u = _pair(lambda i: free.u[i] + pull[i] * m_inv)
    grows = _pair(lambda i: sin[i] * vx + cos[i] * vz + free.own[i] - pull[i] * m_inv)
    return Answer(
        tangential=_pair(lambda i: along_e[i] * cos[i] + along_u[i] * sin[i]),
        normal=_pair(lambda i: along_u[i] * cos[i] - along_e[i] * sin[i]),
        stopper=stopper,
        pull=pull,
        hub=(vx, vz, turn),
        length=_pair(lambda i: jnp.where(held[i], 0.0, grows[i])),
        foot_x=_pair(lambda i: foot_e[i] * cos[i] + foot_u[i] * sin[i]),
        foot_z=_pair(lambda i: foot_u[i] * cos[i] - foot_e[i] * sin[i]),
        regular=regular,
    )


def _table() -> tuple[np.ndarray, np.ndarray]:
    """Return all combinations of modes and stoppers, most sticking feet first, then most sliding
    ones.

    Two sticking feet on two held legs are excluded: they constrain the hub twice, so that their
    forces are not determined.
    """
    rank = {STICK: 0, SLIP_DOWN: 1, SLIP_UP: 1, OFF: 2}
    rows = [
        (modes, held)
        for modes in itertools.product((STICK, SLIP_DOWN, SLIP_UP, OFF), repeat=2)
        for held in itertools.product((False, True), repeat=2)
        if not (modes == (STICK, STICK) and all(held))
    ]
    rows.sort(key=lambda row: (sum(rank[m] for m in row[0]), sum(row[1])))
    return np.array([r[0] for r in rows], np.int32), np.array([r[1] for r in rows])


MODES, HELD = _table()
"""Combinations in order of preference: contact modes and held stoppers, shape (63, 2) each."""
ORDER_WITHOUT_SLIP = np.argsort(
    [sum({STICK: 0, OFF: 2}.get(int(m), 5) for m in row) for row in MODES], kind="stable"
)
"""Order of the combinations by the paper's rule: sliding comes last."""
AT_ONCE = 8
"""Number of combinations that XLA solves together, chosen because most events allow no more.
Machine code solves them one after the other."""
ANY_MODE = (1 << 4) - 1
"""Set of all modes, one bit per mode."""

Rows = tuple[Any, Any]
"""A set of rows of the table: the bits of two words."""


class _Order(NamedTuple):
    """The table in one order, as sets of rows with a property in common."""

    contact: list[list[Rows]]  # by slot and mode
    held: list[Rows]  # by slot

    @classmethod
    def of(cls, rows: np.ndarray) -> "_Order":
        """Return the table with its rows in this order."""

        def packed(flags: np.ndarray) -> Rows:
            words = np.packbits(np.append(flags, False), bitorder="little").view("<i4")
            return words[0], words[1]

        modes, held = MODES[rows].T, HELD[rows].T
        contact = [[packed(own == mode) for mode in range(4)] for own in modes]
        return cls(contact, [packed(own) for own in held])


_ORDERS = _Order.of(ORDER_WITHOUT_SLIP), _Order.of(np.arange(len(MODES)))


def _order(by_paper: Array) -> _Order:
    """Return the paper's order or the usual one, per batch element."""
    return jax.tree.map(lambda yes, no: jnp.where(by_paper, yes, no), *_ORDERS)


class Allowed(NamedTuple):
    """Allowed combinations, and conditions that need no test. Sets of modes are bits."""

    contact: Int[Array, "2 ..."]  # modes of each slot's foot
    held: Bool[Array, "2 ..."]  # the stopper may hold; it may always be open
    stays: Bool[Array, "2 ..."]  # the foot keeps its mode whatever the force
    known_contact: Int[Array, "2 ..."]  # modes that need no test
    known_open: Bool[Array, "2 ..."]  # an open stopper needs no test: the leg is away from it

    def rows(self, order: _Order) -> Rows:
        """Return the allowed rows of the table."""

        def word(w: int) -> Array:
            left = jnp.full_like(self.contact[0], -1, jnp.int32)
            for i in range(2):
                by_mode = enumerate(order.contact[i])
                mine = [jnp.where(has(self.contact[i], m), rows[w], 0) for m, rows in by_mode]
                may_hold = jnp.where(self.held[i], -1, ~order.held[i][w])
                left = left & (mine[0] | mine[1] | mine[2] | mine[3]) & may_hold
            return left

        return word(0), word(1)


def has(modes: Array, mode: Array | int) -> Bool[Array, "..."]:
    """Return whether the set contains the mode."""
    return ((modes >> mode) & 1) > 0


class Chosen(NamedTuple):
    """The chosen combination."""

    contact: Int[Array, "2 ..."]
    held: Bool[Array, "2 ..."]
    wrong: Elementwise  # worst sign violation, see `SignTolerances`; 0 if admissible
    solutions: Int[Array, "..."]  # admissible ones; at least 1 if the violation is small


class Negligible(NamedTuple):
    """Units in which sign violations are measured where rounding decides."""

    force: Elementwise  # N, or N s in an impact
    motion: Elementwise  # m/s^2, or m/s


ACCEPTED = 1e3
"""Largest accepted violation, in units of `SignTolerances`, if no combination has all signs
correct."""


class _Looked(NamedTuple):
    """State of the enumeration of the table."""

    left: Rows  # allowed rows not yet examined
    best: Rows  # first admissible row, else the least violating one
    wrong: Elementwise
    solutions: Int[Array, "..."]


def _wrong(
    s: Symbols,
    hub: Hub,
    free: Free,
    friction: Roughness,
    allowed: Allowed,
    small: Negligible,
    contact: Array,
    on: Array,
) -> Array:
    """Return the largest sign violation of a combination, in units of the tolerances."""
    infinite = each(lambda value: ~jnp.isfinite(value), friction)
    limit = each(lambda value: value == jnp.inf, friction)
    rough = rough_of(friction)
    found = answer(s, hub, free, contact, on, friction)
    worst, along_slope = jnp.zeros_like(found.hub[0]), []
    for i in range(2):
        mode = contact[i]
        along_slope.append(on[i] & (mode != OFF) & ((mode == STICK) | _at(i, limit)))
        unless = lambda known, value: jnp.where(known, 0.0, value)
        known = has(allowed.known_contact[i], mode)
        t, n, x, z = (v[i] for v in (found.tangential, found.normal, found.foot_x, found.foot_z))
        pulls, outside = -n / small.force, unless(_at(i, infinite), jnp.abs(t) - _at(i, rough) * n)
        rests = unless(known, jnp.maximum(pulls, outside / small.force))
        against = jnp.where(mode == SLIP_DOWN, -x, x) / small.motion
        along = jnp.where(mode == SLIP_DOWN, t, -t) / small.force
        slides = jnp.maximum(jnp.where(_at(i, limit), along, pulls), unless(known, against))
        loaded = jnp.where(mode == STICK, rests, slides)
        foot = jnp.where(mode == OFF, unless(known, -z / small.motion), loaded)
        opens = unless(allowed.known_open[i], found.length[i] / small.motion)
        stopper = jnp.where(on[i], -found.stopper[i] / small.force, opens)
        worst = jnp.maximum(worst, jnp.maximum(unless(allowed.stays[i], foot), stopper))
        worst = jnp.where(jnp.isfinite(n) & jnp.isfinite(t), worst, jnp.inf)
    # The tangential forces of both feet are not separately determined on a rigid wheel.
    return jnp.where(along_slope[0] & along_slope[1], jnp.inf, worst)


def _foremost(off_of: Callable[[Rows], Array], rows: list[Rows]) -> tuple[Rows, Array, Array]:
    """Return the first of the least violating rows, its violation, and the number of admissible
    rows.

    Several rows are compared by one reduction. Read row by row, XLA on a CPU would duplicate the
    code of `violation_of` for each use, eightfold.
    """
    if len(rows) == 1:
        off = off_of(rows[0])
        return rows[0], off, off == 0.0
    first, second = (jnp.stack(words) for words in zip(*rows, strict=True))
    offs = jax.vmap(off_of)((first, second))
    places = lax.broadcasted_iota(jnp.int32, offs.shape, 0)

    def better(a: tuple, b: tuple) -> tuple:
        before = (a[0] < b[0]) | ((a[0] == b[0]) & (a[1] < b[1]))
        return jnp.where(before, a[0], b[0]), jnp.where(before, a[1], b[1]), a[2] + b[2]

    none = np.array(np.inf, offs.dtype), np.int32(len(rows)), np.int32(0)
    told = offs, places, (offs == 0.0).astype(jnp.int32)
    off, place, right = lax.reduce(told, none, better, (0,))
    word = lambda words: jnp.sum(jnp.where(place == places, words, 0), axis=0, dtype=jnp.int32)
    return (word(first), word(second)), off, right


def choose(
    s: Symbols,
    hub: Hub,
    free: Free,
    allowed: Allowed,
    friction: Roughness,
    small: Negligible,
    counted: bool,
) -> Chosen:
    """Return the first admissible combination of the table; `n_solutions` is 0 if there is none.

    With `counts_all` all admissible combinations are counted; otherwise the search ends at the
    first. If there is none, the least violating combination is taken, provided that its violation
    is small: two contacts close by rounding, or open by it.
    """
    wrong = functools.partial(_wrong, *lax.stop_gradient((s, hub, free, friction)), allowed, small)
    by_paper = each(lambda value: value == THE_PAPERS, friction)
    order = _order(by_paper[0] & by_paper[1] if isinstance(by_paper, tuple) else by_paper)

    def told(row: Rows) -> tuple[Array, Array]:
        within = lambda rows: ((row[0] & rows[0]) | (row[1] & rows[1])) != 0
        modes = [sum(jnp.where(within(own[m]), m, 0) for m in range(1, 4)) for own in order.contact]
        return jnp.stack(modes).astype(jnp.int32), jnp.stack([within(own) for own in order.held])

    def off_of(row: Rows) -> Array:
        return jnp.where((row[0] | row[1]) != 0, wrong(*told(row)), jnp.inf)

    def goes_on(looked: _Looked) -> Array:
        return ((looked.left[0] | looked.left[1]) != 0) & (counted | (looked.solutions == 0))

    def look(looked: _Looked) -> _Looked:
        """Return the state after the next few allowed combinations."""
        (left, best, least, solutions), rows = looked, []
        for _ in range(1 if simd.tracing() else AT_ONCE):
            row = left[0] & -left[0], jnp.where(left[0] == 0, left[1] & -left[1], 0)
            left = left[0] ^ row[0], left[1] ^ row[1]
            rows.append(row)
        row, off, right = _foremost(off_of, rows)
        best, least = select(off < least, (row, off), (best, least))
        solutions = solutions + right
        return select(goes_on(looked), _Looked(left, best, least, solutions), looked)

    left = allowed.rows(order)
    far = jnp.full_like(lax.stop_gradient(free.hub[2]), jnp.inf)
    begin = _Looked(left, (0 * left[0] + 1, 0 * left[1]), far, 0 * left[0])
    looked = lax.while_loop(lambda looked: jnp.any(goes_on(looked)), look, begin)
    solutions = jnp.maximum(looked.solutions, (looked.wrong <= ACCEPTED).astype(jnp.int32))
    return Chosen(*told(looked.best), looked.wrong, solutions)


def leaves(
    s: Symbols,
    hub: Hub,
    free: Free,
    stance: tuple[Array, Array],
    friction: Roughness,
    second: Bool[Array, "..."],
    direction: Int[Array, "..."],
) -> Bool[Array, "..."]:
    """Return whether a slot's foot, just released by its mode, would move in the direction of
    release.

    - `is_second`: which slot is meant;
    - `direction`: 0 off the ground, 1 downhill, -1 uphill.

    The margin of the mode must grow with the acceleration in that direction. If it shrinks, the
    following mode would end before it begins, and the forces jump instead (Painlevé).
    """
    contact, held = stance
    here = jnp.stack([~second, second]).astype(hub.sin[0].dtype)
    sin, cos = (here[0] * pair[0] + here[1] * pair[1] for pair in (hub.sin, hub.cos))
    off = direction == 0
    e, u = jnp.where(off, -sin, direction * cos), jnp.where(off, cos, direction * sin)
    shift = lambda pair, by: (pair[0] - by * here[0], pair[1] - by * here[1])
    asked = free._replace(e=shift(free.e, e), u=shift(free.u, u))
    mine = jnp.where(second, friction[1], friction[0]) if isinstance(friction, tuple) else friction
    rough = rough_of(mine)
    limit, mode = mine == jnp.inf, jnp.where(second, contact[1], contact[0])
    down = mode == SLIP_DOWN
    slides = down | (mode == SLIP_UP)

    def margin(given: Free) -> Array:
        found = answer(s, hub, given, contact, held, friction)
        normal = jnp.where(second, found.normal[1], found.normal[0])
        tangential = jnp.where(second, found.tangential[1], found.tangential[0])
        pressed = jnp.where(limit & slides, jnp.where(down, -tangential, tangential), normal)
        return jnp.where(off | limit, pressed, rough * normal + direction * tangential)

    return margin(asked) > margin(free)
