"""Continuation of branches and location of their special points, independent of the wheel.

Several branches run side by side. First, each is continued both ways. Then the points where it
stops being admissible are located; they are its ends. Then every other change of sign on it is
located.
"""

import abc
import functools
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from vrw_jax.branches.branch import Border, FixedPoint
from vrw_jax.numerics import (
    BIFURCATIONS,
    AbstractFollowed,
    ArclengthOptions,
    Ending,
    PathPoint,
    Plane,
    arclength,
    bifurcation_functions,
    brackets,
    follow_many,
    in_batches,
    in_batches_of_numpy,
    joined,
    locate,
    solve,
    solve_many,
    taken,
    turns,
)

ACCURACY = 1e-10
"""Accuracy of a special point in the parameter: the width of the bracket at which the search
ends."""

AT_FOLD = 1e-6
"""Final width of the bracket as a fraction of the initial one, used near a fold, where the
parameter enters squared."""

SHARES_WHERE_LOST = (0.99, 0.9)
"""Fractions of the distance to an ill-conditioned zero at which a point beside it is tried
again."""

SHAPES = (1, 8)
"""Numbers of points that are located side by side; only one of them is compiled where compilation
is expensive."""

READ = 32
"""Number of points that one program evaluates; fewer points take the same time."""

IN_SEQUENCE = "sequence"
"""Name of the column that is 1 where a point is admissible, else -1."""

BRANCH_POINT = "branch_point"
"""Kind of a point where a multiplier crosses 1 but the branch does not turn back: another branch
crosses it. The equations are singular there, so the location is only as accurate as the
continuation steps are short."""

Table = dict[str, np.ndarray]
"""Named quantities over a batch of points, first axis."""


@dataclass(frozen=True)
class AbstractRun(abc.ABC):
    """Continuation of several wheels side by side, with the quantities to evaluate at its
    points."""

    followed: AbstractFollowed
    options: ArclengthOptions
    wheels: Any  # with a leading axis over wheels
    bounds: np.ndarray

    ending: ClassVar[tuple[str, ...]] = ()
    """Names of columns at whose zeros a branch ends because the order of events changes."""
    exact: ClassVar[Mapping[str, str]] = {}
    """Margins that vanish ill-conditioned, each with the column that vanishes at the same point."""

    @abc.abstractmethod
    def read(self, wheels: Any, points: PathPoint) -> Table:
        """Return the quantities that the Jacobian does not give, of the wheels with the same
        axis."""

    @abc.abstractmethod
    def kept(self, table: Table) -> np.ndarray:
        """Return which points are admissible, from their table."""

    def is_margin(self, name: str) -> bool:
        """Return whether a column's zero is a border collision."""
        return False

    def known(self, table: Table, owners: np.ndarray) -> Table:
        """Return the table with undefined quantities masked, which depend on the wheel of the
        point."""
        return table

    def name_of_loss(self, table: Table, place: int) -> str:
        """Return a name for the end of a branch from the first point beyond it."""
        return IN_SEQUENCE

    def is_rough(self, table: Table, ends: tuple[str, ...]) -> bool:
        """Return whether the mesh limits the extent or the accuracy of a branch; `ends` are names
        of ends."""
        return False

    def batched(self, function: Callable, size: int, *trees: Any) -> Any:
        """Map over many numpy rows, `size` at a time if the function is compiled."""
        if self.followed.traced:
            return in_batches_of_numpy(function, (size,), *trees)
        return jax.tree.map(np.asarray, in_batches(function, SHAPES, *trees))

    def table(self, points: PathPoint, owners: np.ndarray) -> Table:
        """Return every quantity at each point, with bifurcation functions and ADMISSIBLE_COLUMN."""
        wheels = taken(self.wheels, owners)
        found = self.read(wheels, points)
        margins = in_batches_of_numpy(bifurcation_functions, (READ,), points.jacobian)
        found |= {name: margins[:, i] for i, name in enumerate(BIFURCATIONS)}
        found = self.known(found, owners)
        for name, exact in self.exact.items():
            if exact in found and name in found:
                found[_both(name)] = both_hold(found[name], found[exact])
        good = np.asarray(points.valid) & self.kept(found)
        return found | {IN_SEQUENCE: np.where(good, 1.0, -1.0)}


def _both(name: str) -> str:
    """Return the name of the column that is positive where a margin and its substitute are."""
    return f"{name} for certain"


def both_hold(margin: np.ndarray, exact: np.ndarray) -> np.ndarray:
    """Return a quantity with the sign of both, and of `substitute` alone where that is negative.

    It crosses zero without a jump at the zeros of either.
    """
    return np.where(exact < 0.0, exact, np.minimum(exact, margin))


def _follow_both_ways(run: AbstractRun, z: Any, p: Array, wanted: np.ndarray) -> arclength.Track:
    """Continue all wheels, axes (wheel, direction), the first direction towards smaller values."""
    twice = lambda tree: jax.device_put(taken(tree, np.repeat(np.arange(len(p)), 2)))
    bounds = jnp.asarray(run.bounds)
    ways = jnp.tile(jnp.asarray([-1.0, 1.0], bounds.dtype), p.shape[0])
    given = twice(run.wheels), twice(z), twice(p), bounds, ways, twice(wanted)
    follow = arclength.follow if run.followed.traced else follow_many
    tracks = follow(run.followed, run.options, *given)
    return jax.tree.map(lambda x: np.asarray(x).reshape(-1, 2, *x.shape[1:]), tracks)


@eqx.filter_jit
def _solve_on(
    followed: AbstractFollowed,
    options: ArclengthOptions,
    bounds: Array,
    wheels: Any,
    left: PathPoint,
    right: PathPoint,
    places: Array,
) -> tuple[PathPoint, Array]:
    """Return points of the branch between neighbors, at `fractions` in [0, 1] of the chord."""

    def one(wheel: Any, left: PathPoint, right: PathPoint, place: Array) -> tuple[PathPoint, Array]:
        z, plane = _begin_on(followed, bounds, left, right, place)
        return solve(followed, options, wheel, z, plane, bounds)

    return jax.vmap(one)(wheels, left, right, places)


def _begin_on(
    followed: AbstractFollowed, bounds: Array, left: PathPoint, right: PathPoint, place: Array
) -> tuple[Any, Plane]:
    """Return the start of a search between neighbors, and the plane that contains the solution."""
    z = followed.between(left.z, right.z, place)
    scale = bounds[1] - bounds[0]
    row_x = followed.section(right.z) - followed.section(left.z)
    row_share = (right.p - left.p) / scale
    share = (left.p + place * (right.p - left.p) - bounds[0]) / scale
    return z, Plane(followed.section(z), share, row_x, row_share)


_begin_many = eqx.filter_jit(eqx.filter_vmap(_begin_on, in_axes=(None, None, 0, 0, 0)))


def _solve_many(
    followed: AbstractFollowed,
    options: ArclengthOptions,
    bounds: Array,
    wheels: Any,
    left: PathPoint,
    right: PathPoint,
    places: Array,
) -> tuple[PathPoint, Array]:
    """Return `_solve_between` outside of compiled code."""
    z, planes = _begin_many(followed, bounds, left, right, places)
    return solve_many(followed, options, wheels, z, planes, bounds)


class _Pieces(NamedTuple):
    """Points of all wheels in one array; each wheel's points are in the order of its branch."""

    points: PathPoint
    owners: np.ndarray  # of each point
    table: Table


class _Zero(NamedTuple):
    bracket: tuple[int, int, str]  # left and right point, name of the quantity
    value: float
    place: float
    beside: PathPoint  # on the side of the left point, leading axis 1
    table: Table  # at `point_beside`


def _zeros(run: AbstractRun, pieces: _Pieces, asked: list[tuple[int, int, str]]) -> list[_Zero]:
    """Locate the zero of each request (left, right, quantity) whose sign differs between two
    points."""
    if not asked:
        return []
    lefts, rights = (np.array([a[i] for a in asked]) for i in (0, 1))
    names = [a[2] for a in asked]
    left, right = taken(pieces.points, lefts), taken(pieces.points, rights)
    owners = pieces.owners[lefts]
    wheels = taken(run.wheels, owners)
    on = _solve_on if run.followed.traced else _solve_many
    search = functools.partial(on, run.followed, run.options, jnp.asarray(run.bounds))

    parameter = {(i, 1.0 * end): side.p[i]
                 for end, side in enumerate((left, right)) for i in range(len(asked))}  # fmt: skip

    def evaluated(places: np.ndarray, which: np.ndarray) -> tuple[PathPoint, Table]:
        rows = taken((wheels, left, right), which)
        points, found = run.batched(search, SHAPES[-1], *rows, places)
        parameter.update(zip(zip(which, places, strict=True), points.p, strict=True))
        points = points._replace(valid=points.valid & found)
        table = run.table(points, owners[which])
        return points, {k: np.where(_along(found, v), v, np.nan) for k, v in table.items()}

    def asked_at(places: np.ndarray, which: np.ndarray) -> np.ndarray:
        table = evaluated(places, which)[1]
        return np.array([table[names[k]][i] for i, k in enumerate(which)])

    known = lambda rows: np.array([pieces.table[n][i] for n, i in zip(names, rows, strict=True)])
    reach = np.maximum(np.abs(right.p - left.p), ACCURACY)
    width = np.minimum(ACCURACY / reach, AT_FOLD)
    found = locate(asked_at, (known(lefts), known(rights)), width)
    every = np.arange(len(asked))
    # Slightly to the left even of an exact zero, where the point is still admissible.
    beside, table = evaluated(np.maximum(found.left - width, 0.0), every)
    for share in SHARES_WHERE_LOST:
        lost, rows = np.flatnonzero(~(table[IN_SEQUENCE] > 0.0)), np.arange(len(asked))
        if len(lost):
            there = evaluated(share * found.left[lost], lost)
            rows[lost] = len(rows) + np.arange(len(lost))
            beside, table = taken(joined((beside, table), there), rows)
    return [
        _Zero(
            asked[i],
            float(parameter[i, found.place[i]]),
            float(found.place[i]),
            taken(beside, slice(i, i + 1)),
            taken(table, slice(i, i + 1)),
        )
        for i in range(len(asked))
    ]


def _along(flags: np.ndarray, values: np.ndarray) -> np.ndarray:
    return flags.reshape(-1, *(1,) * (values.ndim - 1))


def _collected(run: AbstractRun, tracks: arclength.Track) -> _Pieces:
    """Collect all points of all results, each wheel's two directions joined at its start."""
    parts, owners = [], []
    for wheel in range(tracks.n_points.shape[0]):
        down, up = (int(n) for n in tracks.n_points[wheel])
        if down:
            points = taken(tracks.points, (wheel, 0))
            points = taken(points, np.arange(down)[::-1])
            parts.append(points._replace(share_slope=-points.share_slope))
        if up:
            points = taken(tracks.points, (wheel, 1))
            parts.append(taken(points, np.arange(1 if down else 0, up)))
        owners += [wheel] * (down + max(up - (1 if down else 0), 0))
    if not owners:
        return _Pieces(taken(tracks.points, (0, 0, slice(0, 0))), np.zeros(0, int), {})
    points = joined(*parts)
    return _Pieces(points, np.array(owners), run.table(points, np.array(owners)))


class _Reach(NamedTuple):
    """Admissible points of one wheel, and the first one beyond at either end (-1 if there is
    none)."""

    owner: int
    points: np.ndarray
    beyond: tuple[int, int]


def _reaches(pieces: _Pieces, starts: Mapping[int, int]) -> list[_Reach]:
    """Return the points of each wheel that are connected to its start through admissible points."""
    reaches = []
    for owner, start in starts.items():
        own = np.flatnonzero(pieces.owners == owner)
        good = pieces.table[IN_SEQUENCE][own] > 0.0
        # A start on a special point may be beyond it: then it is next to the branch's end.
        near = [i for i in (start, start + 1, start - 1) if 0 <= i < len(own) and good[i]]
        if not near:
            continue
        start = near[0]
        low = high = start
        while low > 0 and good[low - 1]:
            low -= 1
        while high < len(own) - 1 and good[high + 1]:
            high += 1
        below = int(own[low - 1]) if low > 0 else -1
        above = int(own[high + 1]) if high < len(own) - 1 else -1
        reaches.append(_Reach(owner, own[low : high + 1], (below, above)))
    return reaches


def _is_rough(run: AbstractRun, pieces: _Pieces, reach: _Reach) -> bool:
    """Return `AbstractContinuation.is_mesh_limited` before special points are located."""
    lost = [i for i in reach.beyond if i >= 0 and not _crossing(run, pieces, reach, i)]
    names = tuple(run.name_of_loss(pieces.table, i) for i in lost)
    return run.is_rough(taken(pieces.table, reach.points), names)


def _crossing(run: AbstractRun, pieces: _Pieces, reach: _Reach, beyond: int) -> list[str]:
    """Return the quantities that change sign from the last point to the first one beyond."""
    last = reach.points[0 if beyond < reach.points[0] else -1]
    known = [name for name in run.ending if name in pieces.table]
    return [n for n in known if pieces.table[n][last] * pieces.table[n][beyond] < 0.0]


def _located_ends(
    run: AbstractRun, pieces: _Pieces, reaches: list[_Reach]
) -> dict[tuple[int, int], _Zero]:
    """Locate where each branch stops being admissible, by (wheel, end: 0 or 1), at the nearest
    zero."""
    asked, keys = [], []
    for reach in reaches:
        for end, beyond in enumerate(reach.beyond):
            if beyond < 0:
                continue
            last = int(reach.points[0 if end == 0 else -1])
            for name in _crossing(run, pieces, reach, beyond) or [IN_SEQUENCE]:
                asked.append((last, beyond, name))
                keys.append((reach.owner, end))
    nearest: dict[tuple[int, int], _Zero] = {}
    for key, zero in zip(keys, _zeros(run, pieces, asked), strict=True):
        if key not in nearest or zero.place < nearest[key].place:
            nearest[key] = zero
    return nearest


def _with_ends(
    pieces: _Pieces, reaches: list[_Reach], ends: Mapping[tuple[int, int], _Zero]
) -> _Pieces:
    """Return the admissible points alone, joined with the points next to the located ends."""
    points, owners, tables = [], [], []

    def add(some: PathPoint, owner: int, table: Table) -> None:
        points.append(some)
        owners.append(np.full(len(some.p), owner))
        tables.append(table)

    for reach in reaches:
        low, high = (ends.get((reach.owner, end)) for end in (0, 1))
        if low is not None and low.table[IN_SEQUENCE][0] > 0.0:
            add(low.beside, reach.owner, low.table)
        add(taken(pieces.points, reach.points), reach.owner, taken(pieces.table, reach.points))
        if high is not None and high.table[IN_SEQUENCE][0] > 0.0:
            add(high.beside, reach.owner, high.table)
    return _Pieces(joined(*points), np.concatenate(owners), joined(*tables))


def _inner_zeros(run: AbstractRun, pieces: _Pieces) -> list[tuple[str, _Zero]]:
    """Locate every change of sign between neighbors on the same branch; return names and zeros."""
    skipped = (IN_SEQUENCE, *run.exact.values())
    names = [
        name for name, values in pieces.table.items() if values.ndim == 1 and name not in skipped
    ]
    names = [name for name in names if name in BIFURCATIONS or run.is_margin(name)]
    columns = [_both(name) if _both(name) in pieces.table else name for name in names]
    asked, told = [], []
    for left, right, place in brackets(np.stack([pieces.table[name] for name in columns], 1)):
        if pieces.owners[left] == pieces.owners[right]:
            asked.append((left, right, columns[place]))
            told.append(names[place])
    for i, (left, right, _) in enumerate(asked):
        slopes = pieces.points.share_slope
        if told[i] == "fold" and slopes[left] * slopes[right] > 0.0:
            told[i] = BRANCH_POINT
    zeros = list(zip(told, _zeros(run, pieces, asked), strict=True))
    return [
        (n, z) for n, z in zeros if n != "neimark_sacker" or turns(np.asarray(z.beside.jacobian[0]))
    ]


def _kind(run: AbstractRun, name: str) -> str:
    if name in (*BIFURCATIONS, BRANCH_POINT):
        return name
    return "border_collision" if run.is_margin(name) else "lost"


class Strand(NamedTuple):
    """Finished branch of one wheel, before it is labeled."""

    points: PathPoint
    table: Table
    borders: tuple[Border, ...]
    ends: tuple[str, str]
    rough: bool  # `AbstractContinuation.is_mesh_limited`


MakeCycle = Callable[[int, PathPoint], Callable[[], Any] | None]
"""Function of a wheel's index and a point that returns a function for its limit cycle."""


def _left_rough(
    run: AbstractRun, pieces: _Pieces, reaches: list[_Reach], n_wheels: int
) -> list[Strand | None]:
    strands: list[Strand | None] = [None] * n_wheels
    for reach in reaches:
        if _is_rough(run, pieces, reach):
            points, table = taken((pieces.points, pieces.table), reach.points)
            strands[reach.owner] = Strand(points, table, (), ("", ""), True)
    return strands


def run_all(
    run: AbstractRun,
    z: Any,
    p: Array,
    found: np.ndarray,
    make_cycle: MakeCycle,
    finest: bool = True,
) -> list[Strand | None]:
    """Continue the branches, locate special points, and return the branches by wheel; None without
    a start.

    Without `is_finest`, special points of mesh-limited branches are not located, because these are
    continued again.
    """
    tracks = _follow_both_ways(run, z, p, found)
    # A closed curve has both directions in one result.
    closed = (tracks.ending == int(Ending.CLOSED)).all(1, keepdims=True) & np.array([True, False])
    counts: Any = np.where(closed, 0, tracks.n_points)
    tracks = tracks._replace(n_points=counts)
    pieces = _collected(run, tracks)
    n_wheels, before = len(found), np.maximum(tracks.n_points[:, 0] - 1, 0)
    starts = {w: int(before[w]) for w in range(n_wheels) if w in pieces.owners}
    reaches = _reaches(pieces, starts)
    strands: list[Strand | None] = [None] * n_wheels
    if not finest:
        strands = _left_rough(run, pieces, reaches, n_wheels)
        reaches = [reach for reach in reaches if strands[reach.owner] is None]
    if not reaches:
        return strands
    ends = _located_ends(run, pieces, reaches)
    whole = _with_ends(pieces, reaches, ends)
    inner = _inner_zeros(run, whole)

    def border(name: str, zero: _Zero, owner: int, ends_branch: bool) -> Border:
        beside = taken(zero.beside, 0)
        section = np.asarray(run.followed.section(jax.device_put(beside.z)))
        point = FixedPoint(section, float(beside.p), beside.jacobian)
        if name == IN_SEQUENCE:
            name = run.name_of_loss(pieces.table, zero.bracket[1])
        return Border(
            _kind(run, name), name, zero.value, point, ends_branch, make_cycle(owner, beside)
        )

    for reach in reaches:
        own = np.flatnonzero(whole.owners == reach.owner)
        placed = [
            (zero.bracket[0] + zero.place, border(name, zero, reach.owner, False))
            for name, zero in inner
            if zero.bracket[0] in own
        ]
        endings = []
        for end in (0, 1):
            zero = ends.get((reach.owner, end))
            if zero is None:
                endings.append(Ending(int(tracks.ending[reach.owner, end])).meaning)
                continue
            last = border(zero.bracket[2], zero, reach.owner, True)
            placed.append((own[0] - 1.0 if end == 0 else own[-1] + 1.0, last))
            endings.append(f"{last.name.replace('_', ' ')} at {last.value:.9g} ends it.")
        borders = tuple(b for _, b in sorted(placed, key=lambda pair: pair[0]))
        table = taken(whole.table, own)
        lost = tuple(b.name for b in borders if b.ends_branch)
        told = taken(whole.points, own), table, borders, (endings[0], endings[1])
        strands[reach.owner] = Strand(*told, run.is_rough(table, lost))
    return strands
