"""Gaits on the top rung by quasi-Newton steps that need its values alone, lane by lane.

One step of the top rung from a state x tells the defect r = P(x) - x. Carried by the inverse of
I - DP it is Newton's correction d, and the gait's quantities are near those of this step plus what
they move by along d. Here both matrices are at first the lower rung's, where it has a gait, and
learn from each further step by Broyden's update of rank one (C. G. Broyden, Math. Comp. 19, 1965).
Where that is slow, and wherever the legs' codes have changed, differences of a few more steps take
their place: by matrices of another motion a slow direction moves the correction little, and
nothing that follows from it can be believed. How much smaller d becomes
from one step to the next is measured, q, the worse of two, and bounds what is left: as for a
contraction (Kantorovich), with a factor of two, by 2q/(1 - q) of what the last but one moved.
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
"""Contraction from which on matrices are taken anew, that is trusted at most to bound what is left,
and at least counted on. A slow direction hides behind quick ones: where corrections came down by a
third each, one gait was four times as far off as their bound."""
CURVED = 5.0
"""Contraction over the length of a correction that is counted on at least: how curved maps are."""
FARTHEST = 1.0
"""Longest correction, rad, rad/s, m/s: farther off nothing is known."""
PATIENCE = 4
"""Corrections that do not contract, or changes of the legs' codes, before a lane gives up."""
PER_TOLERANCE = 30.0
"""Error of a step over the tolerance of its local steps: 99 of 100 keep a third of it."""
Goal = Callable[[np.ndarray], np.ndarray]
"""Errors wanted of measures with about these values, (lanes, names)."""
SINGULAR = 1e-3
"""Share of a direction that must be left of it after a step for the inverse to learn from it."""
DIFFERENCE = 1e-5
"""Of a number of the section state, for derivatives, rad, rad/s, m, m/s."""
STEEP = 10.0
"""Slope by differences from which on they may lie across a jump: of 1,042 of gaits one in a hundred
is steeper, and where they jump a correction tells nothing of what is left."""
CORRECTIONS, AGAIN = 24, 8
"""Most corrections of one iteration, and after how many matrices are taken anew."""
ROUNDING, NOISE = 1e2, 1e4
"""Corrections of so many tolerances are the integrator's; and where they come down no more."""
BRIEF = 3.0
"""Dips of a foot of the shortest kind that a step may miss or add."""
BRIEFLY = 0.1
"""Share of what is wanted that such dips may be presumed to cost: else it is measured."""
AT_REST = 6.0
"""How far corrections that come down no more may leave one off, in their own effect, and a step, in
the difference that another tolerance makes: four times was too little for 4 of 10,365 answers."""
STRAY, STAYS = 1e-3, 1e-3
"""How far from a walk's end its gait may lie without being walked to again, and how far a walk may
then lead away, rad, rad/s, m, m/s."""
RESOLVED = 1e-13
"""Changes as short as this tell nothing."""


class Seen(NamedTuple):
    """What one step of the top rung tells; lanes lead."""

    same: np.ndarray  # it ended with the legs' codes that it began with
    values: np.ndarray  # (lanes, names): the measures of the gait, as far as is known
    size: np.ndarray  # (lanes, names): what the correction moves them by, nothing cancelled
    direct: np.ndarray  # (lanes, names, 7): how they move with the step's quantities
    numerical: np.ndarray  # (lanes, names): bound of what the integrator's tolerance leaves
    brief: np.ndarray  # (lanes, names): and of dips too short to be followed


class Settled(NamedTuple):
    """What became of lanes."""

    done: np.ndarray
    values: np.ndarray
    left: np.ndarray  # (lanes, names): bound of what the iteration leaves
    numerical: np.ndarray
    n_steps: np.ndarray  # of the top rung
    x: np.ndarray  # (lanes, 4 + 3 n)
    speed: np.ndarray  # m/s, of the last step


@dataclasses.dataclass
class Chord:
    """Lanes on their way to a fixed point of the top rung, whose matrices learn."""

    ground: Ground
    lanes: np.ndarray
    x: np.ndarray
    inverse: np.ndarray  # (lanes, m, m): of I - DP
    moved: np.ndarray  # (lanes, 7, m): how the quantities move with x
    known: np.ndarray  # whether the matrices are of this motion
    free: np.ndarray
    has: np.ndarray  # whether the step before had the same codes
    before: tuple[np.ndarray, ...]  # where that began, its defect and quantities
    correction: np.ndarray

    @classmethod
    def of(cls, ground: Ground, lanes: np.ndarray, x: np.ndarray, lower: Lower | None) -> "Chord":
        """From `x`, with the matrices of the gaits there, if a lower rung has any."""
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
        """Of these lanes alone."""
        ground, *arrays = (getattr(self, field.name) for field in dataclasses.fields(self))
        return Chord(ground, *jax.tree.map(lambda x: x[part], arrays))

    def see(self, some: np.ndarray, step: Stepped, names: Sequence[str]) -> Seen:
        """Learn from a step of `some` lanes, and tell what it says of the gait."""
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
            # What a dip takes from one duration it adds to another.
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
        """Broyden's updates of both matrices, where the step before can be compared with."""
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
        """From where `some` lanes are."""
        return self.ground.step(self.lanes[some], self.x[some])

    def alike(self, some: np.ndarray, step: Stepped) -> np.ndarray:
        """Whether these lanes' step ended with the codes that it began with."""
        m = self.free.shape[1]
        same = np.all(self.x[some, m:] == step.x[:, m:], axis=1)
        return same & (step.outcome == Outcome.STEPPED)

    def other_opinions(self, some: np.ndarray, names: Sequence[str], told: "Settled") -> np.ndarray:
        """Numerical errors by steps at other tolerances, in place of what dips may cost: the
        shortest that are followed are shorter, or longer, there. Infinite where one of these steps
        has another motion."""
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
        """Whether walks near by come to where the lanes are: no multiplier is beyond one, which is
        that no eigenvalue of (I - DP)^-1 has a real part below a half."""
        return np.linalg.eigvals(self.inverse).real.min(-1) > 0.5

    def away(self, x: np.ndarray) -> np.ndarray:
        """How far the lanes are from there."""
        return np.abs(self.x - x)[:, : self.free.shape[1]].max(-1)

    def stay(self, n_steps: int) -> np.ndarray:
        """Whether a walk stays where the lanes are: multipliers by differences across a dip lie."""
        end = self.ground.step(self.lanes, self.x, n_steps)
        return (end.outcome == Outcome.STEPPED) & (self.away(end.x) <= STAYS)

    def go_on(self, some: np.ndarray, y: np.ndarray, same: np.ndarray) -> None:
        """To where the correction leads; along the step itself where codes have changed."""
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
        """Both matrices anew, by differences of one step more for each free number.

        `step` is the one from where the lanes are; tells how many steps were taken for each lane.
        A difference that is STEEP is taken to the other side as well, and the lesser one counts.
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
        """How section state and quantities move, (pairs, m + 7), where the `lane`-th of `some` has
        the `number` changed; not at all where the step ends with other codes."""
        m = self.free.shape[1]
        x = self.x[some][lane]
        x[np.arange(len(lane)), number] += change
        there = self.ground.step(self.lanes[some][lane], self.ground.consistent(x))
        same = np.all(there.x[:, m:] == step.x[lane, m:], axis=1)
        moved = np.concatenate([there.x[:, :m] - step.x[lane, :m], there.told - step.told[lane]], 1)
        return np.where(same[:, None], moved, 0.0) / change


class _Trust:
    """How far each lane's corrections can be trusted, by how they have come down so far."""

    def __init__(self, n: int, m: int, tolerance: float) -> None:
        self.tolerance = tolerance
        self.length, self.ratio = np.full(n, np.inf), np.zeros(n)
        self.size, self.values = np.full((n, m), np.inf), np.full((n, m), np.nan)

    def anew(self, some: np.ndarray, ratio: float) -> None:
        """Matrices of these lanes are others."""
        self.length[some], self.ratio[some] = np.inf, ratio

    def left(self, some: np.ndarray, seen: Seen, length: np.ndarray) -> tuple[np.ndarray, ...]:
        """Bound of what the corrections leave, (lanes, names), how they contracted, and whether
        they come down no more, as the integrator allows."""
        before = self.length[some]
        with np.errstate(all="ignore"):
            q = np.where(seen.same, length / before, np.inf)
            # By differences across a dip ever shorter corrections move measures as far as before.
            felt = np.max(seen.size / np.maximum(self.size[some], RESOLVED), axis=1)
            stalls = seen.same & (np.maximum(q, felt) > SLOWEST) & np.isfinite(before)
            stalls &= np.maximum(length, before) <= NOISE * self.tolerance
            q = np.where(seen.same & (length <= ROUNDING * self.tolerance), 0.0, q)
            # Nothing is trusted where there is no correction yet to compare with.
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
    """Corrections until what is left is below the `goal`, CORRECTIONS at most.

    Differences take the matrices' place after so many steps, `patient`, and at once where they are
    of another motion. `first` is the step from where the lanes are, and what the chord has seen of
    it, if it has been taken.
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
        # A walk may have come to where feet dip more often than is presumed.
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
