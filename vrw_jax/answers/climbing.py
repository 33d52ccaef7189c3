"""Refinement of gaits of the highest model by quasi-Newton steps that need only its values.

One step of the highest model from a state x gives the defect r = P(x) - x. Multiplied by the
inverse of I - DP it is Newton's correction d. The gait's quantities are near those of this step
plus their change along d. At first both matrices are the lower model's, if it has a gait. Each
further step updates them by Broyden's update of rank one (C. G. Broyden, Math. Comp. 19, 1965). If
the convergence is slow, and if the legs' codes have changed, finite differences of a few more steps
replace the matrices. The matrices of another motion predict a small correction in a slow direction,
and an error bound that follows from them is invalid. The contraction q of d from one step to the
next is measured, and the larger of the last two bounds the remaining error. As for a contraction
(Kantorovich), with a factor of two, the bound is 2q/(1 - q) times the last change but one.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import numpy as np

from vrw_jax.answers.lower import Lower
from vrw_jax.answers.quantities import N_DURATIONS, N_QUANTITIES, measured, slopes
from vrw_jax.answers.top import Ground, Stepped
from vrw_jax.wheel import Outcome

SLOWEST, TRUSTED, QUICKEST = 0.5, 0.25, 0.1
"""Contraction rates. Above the first, matrices are recomputed. Above the second, the rate is not
trusted to bound the remaining error. The third is the smallest rate that is assumed. A slow
direction is hidden behind quick ones: when corrections decreased by a third each, one gait was four
times as far away as its bound."""
CURVED = 5.0
"""Smallest assumed contraction rate over the length of a correction, a measure of the curvature of
the maps."""
FARTHEST = 1.0
"""Longest accepted correction, rad, rad/s, m/s; beyond it the linearization is unknown."""
PATIENCE = 4
"""Number of corrections that do not contract, or of changes of the legs' codes, before an element
fails."""
PER_TOLERANCE = 30.0
"""Error of a step over the tolerance of its solver steps; 99 of 100 are within a third of it."""
Goal = Callable[[np.ndarray], np.ndarray]
"""Allowed errors of measures with about these values, (elements, measures)."""
SINGULAR = 1e-3
"""Smallest share of a direction that must remain after a step for an update of the inverse."""
DIFFERENCE = 1e-5
"""Step of finite differences in a coordinate of the section state, rad, rad/s, m, m/s."""
STEEP = 10.0
"""Derivative by differences above which they may cross a jump. Of 1,042 derivatives at gaits one in
a hundred is steeper. Across a jump a correction gives no information about the remaining error."""
CORRECTIONS, AGAIN = 24, 8
"""Largest number of corrections of one iteration, and the number after which matrices are
recomputed."""
ROUNDING, NOISE = 1e2, 1e4
"""Lengths of corrections in tolerances: the level of the integrator's errors, and the level below
which corrections may stall."""
BRIEF = 3.0
"""Number of shortest dips of a foot that a step may miss or add."""
BRIEFLY = 0.1
"""Largest share of the allowed error that is assumed for such dips; otherwise it is measured."""
AT_REST = 6.0
"""Safety factor of stalled corrections, relative to their own effect, and of the difference between
steps at two tolerances. A factor of four was too small for 4 of 10,365 results."""
STRAY, STAYS = 1e-3, 1e-3
"""Largest distance of a gait from a walk's end without a second walk, and largest drift of that
second walk, rad, rad/s, m, m/s."""
RESOLVED = 1e-13
"""Length below which a change is not resolved."""


class Seen(NamedTuple):
    """Estimate of a gait's measures from one step of the highest model; the batch axis comes
    first."""

    same: np.ndarray  # whether the legs' codes are unchanged by the step
    values: np.ndarray  # (elements, measures): estimated measures of the gait
    size: np.ndarray  # (elements, measures): sum of the absolute effects of the correction
    direct: np.ndarray  # (elements, measures, 7): derivatives with respect to the step's quantities
    numerical: np.ndarray  # (elements, measures): bound of the integrator's error
    brief: np.ndarray  # (elements, measures): bound of the error from unresolved short dips


class Settled(NamedTuple):
    """Result of the refinement."""

    done: np.ndarray
    values: np.ndarray
    left: np.ndarray  # (elements, measures): bound of the iteration's error
    numerical: np.ndarray
    n_steps: np.ndarray  # of the highest model
    x: np.ndarray  # (elements, 4 + 3 n)
    speed: np.ndarray  # of the last step, m/s


@dataclasses.dataclass
class Chord:
    """Quasi-Newton iteration of a batch to a fixed point of the highest model, with Broyden
    updates."""

    ground: Ground
    lanes: np.ndarray
    x: np.ndarray
    inverse: np.ndarray  # (elements, m, m): inverse of I - DP
    moved: np.ndarray  # (elements, 7, m): derivatives of the quantities with respect to x
    known: np.ndarray  # whether the matrices are those of this motion
    free: np.ndarray
    has: np.ndarray  # whether the previous step had the same codes
    before: tuple[np.ndarray, ...]  # its start, defect and quantities
    correction: np.ndarray

    @classmethod
    def of(cls, ground: Ground, lanes: np.ndarray, x: np.ndarray, lower: Lower | None) -> "Chord":
        """Start from `section_states`, with the matrices of the lower model's gaits if there are
        any."""
        n, m = len(lanes), x.shape[1] - ground.n
        inverse, moved = np.tile(np.eye(m), (n, 1, 1)), np.zeros((n, N_QUANTITIES, m))
        if lower is not None:
            plane = ground.plane()
            inverse[:, plane[:, None], plane] = lower.carry
            moved[:, :, plane] = lower.moved
        before = np.zeros((n, m)), np.zeros((n, m)), np.zeros((n, N_QUANTITIES))
        known, has = np.full(n, lower is not None), np.zeros(n, bool)
        free = ground.free(x)
        return cls(
            ground, lanes, x.copy(), inverse, moved, known, free, has, before, np.zeros((n, m))
        )

    def some(self, part: np.ndarray) -> "Chord":
        """Return the iteration of the selected elements."""
        ground, *arrays = (getattr(self, field.name) for field in dataclasses.fields(self))
        return Chord(ground, *jax.tree.map(lambda x: x[part], arrays))

    def see(self, some: np.ndarray, step: Stepped, names: Sequence[str]) -> Seen:
        """Update the matrices from a step of some elements, and return the estimate of their
        gaits."""
        m = self.free.shape[1]
        x, y = self.x[some], step.x
        same = self.alike(some, step)
        defect = np.where(self.free[some] & same[:, None], y[:, :m] - x[:, :m], 0.0)
        self._learn(some, x[:, :m], defect, step.told, same)
        inverse, moved = self.inverse[some], self.moved[some]
        d = np.where(self.free[some], np.einsum("ijk,ik->ij", inverse, defect), 0.0)
        self.correction[some] = d
        for kept, now in zip(self.before, (x[:, :m], defect, step.told), strict=True):
            kept[some] = now
        with np.errstate(all="ignore"):
            estimate = step.told + np.einsum("ijk,ik->ij", moved, d)
            direct = slopes(names, estimate)
            along = np.abs(direct @ moved)
            size = np.einsum("ijk,ik->ij", along, np.abs(d))
            tolerance = PER_TOLERANCE * float(self.ground.options.rtol)
            felt = np.abs(direct).sum(-1) + np.sum(along @ np.abs(inverse), axis=-1)
            # A dip moves time from one duration to another.
            spread = np.ptp(direct[:, :, :N_DURATIONS], axis=-1)
            brief = BRIEF * self.ground.shortest(self.lanes[some])[:, None] * spread
            values = measured(names, estimate)
            return Seen(same, values, size, direct, tolerance * felt, brief)

    def _learn(
        self,
        some: np.ndarray,
        x: np.ndarray,
        defect: np.ndarray,
        told: np.ndarray,
        same: np.ndarray,
    ) -> None:
        """Apply Broyden's updates to both matrices if the previous step is comparable."""
        x_before, defect_before, told_before = (kept[some] for kept in self.before)
        s = np.where(self.free[some], x - x_before, 0.0)
        z = defect_before - defect
        inverse, moved = self.inverse[some], self.moved[some]
        squared = np.einsum("ij,ij->i", s, s)
        reached = np.einsum("ijk,ik->ij", inverse, z)
        share = np.einsum("ij,ij->i", s, reached)
        can = self.has[some] & same & (squared > RESOLVED**2)
        sound = can & (np.abs(share) > SINGULAR * squared)
        row = np.einsum("ij,ijk->ik", s, inverse) / np.where(sound, share, 1.0)[:, None]
        learnt = inverse + (s - reached)[:, :, None] * row[:, None, :]
        self.inverse[some] = np.where(sound[:, None, None], learnt, inverse)
        missed = told - told_before - np.einsum("ijk,ik->ij", moved, s)
        row = s / np.where(can, squared, 1.0)[:, None]
        learnt = moved + missed[:, :, None] * row[:, None, :]
        self.moved[some] = np.where(can[:, None, None], learnt, moved)
        self.has[some] = same

    def step(self, some: np.ndarray) -> Stepped:
        """Take one step from the current states of some elements."""
        return self.ground.step(self.lanes[some], self.x[some])

    def alike(self, some: np.ndarray, step: Stepped) -> np.ndarray:
        """Return whether the step of these elements ended with the codes at its start."""
        m = self.free.shape[1]
        same = np.all(self.x[some, m:] == step.x[:, m:], axis=1)
        return same & (step.outcome == Outcome.STEPPED)

    def other_opinions(self, some: np.ndarray, names: Sequence[str], told: "Settled") -> np.ndarray:
        """Return numerical errors from steps at other tolerances, which replace the assumed error
        of dips.

        At another tolerance the shortest resolved dips are shorter or longer. The error is infinite
        if one of these steps has another motion.
        """
        worst = np.zeros_like(told.numerical[some])
        for ground in self.ground.otherwise():
            chord = dataclasses.replace(
                self.some(some), ground=ground, has=np.zeros(len(some), bool)
            )
            seen = chord.see(np.arange(len(some)), chord.step(np.arange(len(some))), names)
            apart = AT_REST * np.abs(seen.values - told.values[some])
            error = apart + np.minimum(seen.numerical, told.numerical[some])
            worst = np.maximum(worst, np.where(seen.same[:, None], error, np.inf))
        return worst

    def attract(self) -> np.ndarray:
        """Return whether nearby walks converge to the current states: no multiplier is outside the
        unit circle.

        Equivalently, no eigenvalue of (I - DP)^-1 has a real part below a half.
        """
        return np.linalg.eigvals(self.inverse).real.min(-1) > 0.5

    def away(self, x: np.ndarray) -> np.ndarray:
        """Return the largest distance of the current states from `section_states`."""
        return np.abs(self.x - x)[:, : self.free.shape[1]].max(-1)

    def stay(self, n_steps: int) -> np.ndarray:
        """Return whether a walk stays at the current states, because finite differences across a
        dip give wrong multipliers."""
        end = self.ground.step(self.lanes, self.x, n_steps)
        return (end.outcome == Outcome.STEPPED) & (self.away(end.x) <= STAYS)

    def go_on(self, some: np.ndarray, y: np.ndarray, same: np.ndarray) -> None:
        """Move to the corrected states, or to the end of the step if codes have changed."""
        m = self.free.shape[1]
        there = np.where(self.free[some], self.x[some, :m] + self.correction[some], y[:, :m])
        self.x[some] = y
        self.x[some[same], :m] = there[same]
        self.x[some[same]] = self.ground.consistent(self.x[some[same]])
        changed = some[~same]
        self.inverse[changed] = np.eye(m)
        self.moved[changed] = 0.0
        self.known[changed] = False
        self.free[changed] = self.ground.free(self.x[changed])

    def differentiate(self, some: np.ndarray, step: Stepped) -> np.ndarray:
        """Recompute both matrices by finite differences, one more step for each free coordinate.

        `step` is the one from the current states. Return the number of steps taken for each
        element. A difference above MAX_FD_DERIVATIVE is also taken on the other side, and the
        smaller one is used.
        """
        m = self.free.shape[1]
        lane, number = np.nonzero(self.free[some])
        if not len(lane):
            return np.zeros(0, int)
        slopes = self._slopes(some, step, lane, number, DIFFERENCE)
        steep = np.flatnonzero(np.abs(slopes).max(-1) > STEEP)
        if len(steep):
            other = self._slopes(some, step, lane[steep], number[steep], -DIFFERENCE)
            less = np.abs(other).max(-1) < np.abs(slopes[steep]).max(-1)
            slopes[steep[less]] = other[less]
        jacobian, moved = np.zeros((len(some), m, m)), np.zeros((len(some), N_QUANTITIES, m))
        jacobian[lane, :, number] = np.where(self.free[some][lane], slopes[:, :m], 0.0)
        moved[lane, :, number] = slopes[:, m:]
        regular = np.eye(m) - jacobian
        flat = np.abs(np.linalg.det(regular)) < RESOLVED
        regular[flat] = np.eye(m)
        self.inverse[some], self.moved[some] = np.linalg.inv(regular), moved
        self.has[some], self.known[some] = False, True
        return np.bincount(np.concatenate([lane, lane[steep]]), minlength=len(some))

    def _slopes(
        self, some: np.ndarray, step: Stepped, lane: np.ndarray, number: np.ndarray, change: float
    ) -> np.ndarray:
        """Return derivatives of section state and quantities, (pairs, m + 7), for changes of single
        coordinates.

        A pair is an element position and a coordinate. The derivatives are zero if the step ends
        with other codes.
        """
        m = self.free.shape[1]
        x = self.x[some][lane]
        x[np.arange(len(lane)), number] += change
        there = self.ground.step(self.lanes[some][lane], self.ground.consistent(x))
        same = np.all(there.x[:, m:] == step.x[lane, m:], axis=1)
        moved = np.concatenate([there.x[:, :m] - step.x[lane, :m], there.told - step.told[lane]], 1)
        return np.where(same[:, None], moved, 0.0) / change


class _Trust:
    """Bounds of the remaining error from the measured contraction of each element's corrections."""

    def __init__(self, n: int, m: int, tolerance: float) -> None:
        self.tolerance = tolerance
        self.length, self.ratio = np.full(n, np.inf), np.zeros(n)
        self.size, self.values = np.full((n, m), np.inf), np.full((n, m), np.nan)

    def anew(self, some: np.ndarray, ratio: float) -> None:
        """Reset these elements after their matrices have been replaced."""
        self.length[some], self.ratio[some] = np.inf, ratio

    def left(self, some: np.ndarray, seen: Seen, length: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return the bound of the remaining error, (elements, measures), the contraction rates, and
        which stall.

        Corrections stall if they stop decreasing and are as small as the integrator's errors allow.
        """
        before = self.length[some]
        with np.errstate(all="ignore"):
            q = np.where(seen.same, length / before, np.inf)
            # With differences across a dip, shorter corrections change measures as much as before.
            felt = np.max(seen.size / np.maximum(self.size[some], RESOLVED), axis=1)
            stalls = seen.same & (np.maximum(q, felt) > SLOWEST) & np.isfinite(before)
            stalls &= np.maximum(length, before) <= NOISE * self.tolerance
            q = np.where(seen.same & (length <= ROUNDING * self.tolerance), 0.0, q)
            # No rate is trusted before there is a previous correction.
            least = np.clip(CURVED * before, QUICKEST, TRUSTED)
            least = np.where(np.isfinite(before), least, np.inf)
            worst = np.maximum(np.maximum(q, self.ratio[some]), least)
            worst = np.maximum(worst, np.where(q > 0.0, felt, 0.0))
            change = np.abs(seen.values - self.values[some])
            effect = np.fmax(np.fmax(seen.size, self.size[some]), change)
            share = np.where(worst <= TRUSTED, 2.0 * worst / (1.0 - worst), np.inf)
            share = np.where(stalls, np.minimum(share, AT_REST), share)
            left = np.nan_to_num(share[:, None] * effect, nan=np.inf, posinf=np.inf)
        compared = np.isfinite(before)
        self.ratio[some] = np.where(compared, np.where(seen.same, q, 0.0), self.ratio[some])
        self.length[some] = np.where(seen.same, length, np.inf)
        self.size[some], self.values[some] = seen.size, seen.values
        return left, q, stalls


def settled(
    chord: Chord,
    names: Sequence[str],
    goal: Goal,
    patient: int,
    first: tuple[Stepped, Seen] | None = None,
) -> Settled:
    """Apply corrections until the remaining error is below the goal, at most MAX_ITERATIONS.

    Finite differences replace the matrices after `n_steps_before_differences` steps, and
    immediately if the matrices are those of another motion. `first_step_and_estimate` is the step
    from the current states with its estimate, if it has been taken.
    """
    n, m = len(chord.lanes), len(names)
    told = Settled(
        np.zeros(n, bool), np.full((n, m), np.nan), np.full((n, m), np.inf), np.zeros((n, m)),
        np.zeros(n, int), chord.x, np.full(n, np.nan),
    )  # fmt: skip
    trust = _Trust(n, m, float(chord.ground.options.rtol))
    strikes, age, open_ = np.zeros(n, int), np.full(n, AGAIN - patient), np.arange(n)
    doubted = np.zeros(n, bool)
    for k in range(CORRECTIONS):
        if not len(open_):
            break
        if first is not None and k == 0:
            step, seen = first
        else:
            step = chord.step(open_)
            told.n_steps[open_] += 1
            old = chord.alike(open_, step) & ((age[open_] >= AGAIN) | ~chord.known[open_])
            some = open_[old]
            told.n_steps[some] += chord.differentiate(some, Stepped(*(x[old] for x in step)))
            trust.anew(some, 0.0 if patient else np.inf)
            age[some] = 0
            seen = chord.see(open_, step, names)
        length = np.linalg.norm(chord.correction[open_], axis=1)
        left, q, stalls = trust.left(open_, seen, length)
        wanted = goal(seen.values)
        done = stalls | np.all(left <= np.maximum(wanted - seen.numerical, seen.numerical), axis=1)
        told.values[open_], told.left[open_], told.done[open_] = seen.values, left, done
        told.numerical[open_] = seen.numerical + seen.brief
        told.speed[open_] = measured(("speed",), step.told)[:, 0]
        # A walk may end at a gait whose feet dip more often than assumed.
        doubted[open_] = done & (np.any(seen.brief > BRIEFLY * wanted, axis=1) | (patient == 0))
        slow = np.isfinite(q) & (q > SLOWEST)
        strikes[open_] += ~seen.same | slow
        age[open_] = np.where(slow, AGAIN, age[open_] + 1)
        goes_on = ~done & (step.outcome == Outcome.STEPPED) & (length <= FARTHEST)
        goes_on &= strikes[open_] < PATIENCE
        chord.go_on(open_[goes_on], step.x[goes_on], seen.same[goes_on])
        open_ = open_[goes_on]
    some = np.flatnonzero(doubted)
    if len(some):
        told.numerical[some] = chord.other_opinions(some, names, told)
        told.n_steps[some] += len(chord.ground.otherwise())
    told.done[some] &= np.isfinite(told.numerical[some]).all(1)
    return told
