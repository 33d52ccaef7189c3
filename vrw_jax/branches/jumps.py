"""Branches whose section state jumps, as on unilateral contact where two impacts change places.

The effects of two impacts do not commute, so that the gait beyond has another section state, and
no step along the branch, however short, leads there.
"""

from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from vrw_jax.continuation import ContinuationStatus, arclength
from vrw_jax.numerics import take_rows

MAX_JUMPS = 20
"""Places at most where a direction of a branch goes on beyond a jump of the section state."""

JUMP_SHARES = (1e-9, 1e-7, 1e-5, 3e-5, 1e-4, 2e-4, 3e-4, 5e-4, 1e-3)
"""Changes of the parameter, as shares of its range, after which a gait beyond a jump is sought;
chosen because two impacts change places within a share of 1e-4 on unilateral contact."""

JUMP_FACTOR = 5.0
"""Factor by which the chord between two points must be steeper than both tangents for a jump,
chosen because the slope of a chord is between those of the tangents to some tenths if a
continuation step turns by at most 0.2 rad, also at a kink."""


def follow_beyond_jumps(
    run: Any, follow: Callable[..., Any], wheels: Any, tracks: arclength.ContinuationResult
) -> arclength.ContinuationResult:
    """Return tracks that go on where they stalled because the section state jumps.

    The gait beyond is searched for from the last one, at the least change of the parameter that
    finds one alike. `run` is an `AbstractRun`, `follow` its continuation.
    """
    rows, bounds = np.arange(len(tracks.n_points)), np.asarray(run.bounds)
    owners, given_up = rows // 2, np.zeros(len(rows), bool)
    for _ in range(MAX_JUMPS):
        n_points, endings = np.asarray(tracks.n_points), np.asarray(tracks.status)
        open_ = (
            (endings == int(ContinuationStatus.STEP_SIZE_UNDERFLOW)) & (n_points > 1) & ~given_up
        )
        if not open_.any():
            break
        ends = take_rows(tracks.points, (rows, np.maximum(n_points - 1, 0)))
        ways, before = np.sign(ends.fraction_rate), run.make_table(ends, owners)
        for share in JUMP_SHARES:
            p = ends.p + ways * share * (bounds[1] - bounds[0])
            wanted = open_ & (p > bounds[0]) & (p < bounds[1])
            if not wanted.any():
                continue
            given = jax.device_put((wheels, ends.z, p, bounds, ways, wanted))
            more = jax.tree.map(np.asarray, follow(*given))
            first = take_rows(more.points, (rows, 0))
            found = wanted & (np.asarray(more.n_points) > 1)
            found = found & run.is_alike(before, run.make_table(first, owners))
            tracks = append_tracks(tracks, more, found)
            open_ = open_ & ~found
        given_up = given_up | open_
    return tracks


def append_tracks(
    tracks: arclength.ContinuationResult, more: arclength.ContinuationResult, which: np.ndarray
) -> arclength.ContinuationResult:
    """Return tracks, to those of which `which` is true the points of others are appended."""
    if not which.any():
        return tracks
    n_points = tracks.n_points + np.where(which, more.n_points, 0)
    length = max(int(np.max(n_points)), tracks.points.p.shape[1])

    def together(old: np.ndarray, new: np.ndarray) -> np.ndarray:
        whole = np.zeros((len(old), length, *old.shape[2:]), old.dtype)
        whole[:, : old.shape[1]] = old
        for i in np.flatnonzero(which):
            whole[i, tracks.n_points[i] : n_points[i]] = new[i, : more.n_points[i]]
        return whole

    points: Any = jax.tree.map(together, tracks.points, more.points)
    ending: Any = np.where(which, more.status, tracks.status)
    counts: Any = n_points
    return arclength.ContinuationResult(
        points, counts, ending, tracks.n_linearizations + more.n_linearizations
    )


def find_jumps(
    states: np.ndarray, shares: np.ndarray, share_slopes: np.ndarray, pairs: list[tuple[int, int]]
) -> list[tuple[int, int]]:
    """Return those pairs of points between which the section state jumps.

    `shares` are the parameter's as shares of its range, `share_slopes` theirs along the branch.
    """

    def has_jump(i: int, j: int) -> bool:
        change = shares[j] - shares[i]
        chord = np.hypot(np.linalg.norm(states[j] - states[i]), change)
        smallest_change = min(abs(share_slopes[i]), abs(share_slopes[j])) * chord
        # Across a fold the slopes differ in sign, and the two ends may have the same parameter.
        is_one_way = share_slopes[i] * share_slopes[j] > 0.0
        return bool(is_one_way and JUMP_FACTOR * abs(change) < smallest_change)

    return [pair for pair in pairs if has_jump(*pair)]
