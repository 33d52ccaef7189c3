"""Means over many wheels on real ground, from few of its gaits and many of the lower rung's.

The lower rung is a control variate: what it tells of all wheels is known, and only its difference
from real ground is sampled (M. B. Giles, Acta Numerica 24, 2015; B. Peherstorfer, K. Willcox and
M. Gunzburger, SIAM Review 60, 2018). A pilot of wheels drawn first tells the weight, which control
is worth its price, and how many more are needed. Its own wheels count as known and the others are
drawn from those that are left, so that nothing is estimated from the numbers that it is applied to,
and the mean is unbiased; where some wheels have no gait it is a ratio, of sums over all, and right
to the order of one over the wheels asked.
"""

import math
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np

from vrw_jax.answers.asking import answer, known_lanes
from vrw_jax.answers.climbing import Chord
from vrw_jax.answers.lower import Lower, paper_gaits
from vrw_jax.answers.quantities import MADE, measured
from vrw_jax.answers.result import Answer
from vrw_jax.answers.top import Ground
from vrw_jax.numerics import Options, taken
from vrw_jax.results import MEASURES
from vrw_jax.wheel import WheelParams, friction_of
from vrw_jax.wording import (
    AbstractTold,
    Row,
    chosen,
    instance,
    positive,
    require_known,
    untraced,
    whole,
)

DEVIATIONS = 2.0
"""Standard errors that a stated error of a mean holds."""
SHARE = 0.1
"""Share of the mean's error that each gait may take."""
FEWEST = 8
"""Wheels with a gait from which a spread is told."""
FLAT = 1e-12
"""Share of the largest singular value below which the pilot tells nothing of a direction."""
CONTROLS = ("no control", "the paper's gaits", "the paper's gaits with one step on real ground")
LOWER_COST = (0.0, 1.0, 2.0)
"""Price of a control, in steps on real ground: in lanes the paper's gait costs what one does."""


class Average(AbstractTold):
    """A measure's mean over wheels on real ground.

    - `measure`: its name;
    - `value`: the mean, in the measure's unit;
    - `error`: two of its standard errors, and what each gait may be wrong by;
    - `n`: wheels with a gait on real ground, as far as they were asked;
    - `n_top`: wheels asked on real ground, the pilot's included;
    - `control`: what was known of all others, one of CONTROLS;
    - `weight`: with which it counts;
    - `steps`: on real ground, those that the control is worth included;
    - `steps_alone`: expected of a mean of the same error from real ground alone.

    Examples:
        >>> wheels = vrw.WheelParams(damping=jnp.linspace(120.0, 200.0, 60))
        >>> mean = vrw.average("speed", wheels, 1e-2, friction=15.0, pilot=12)
        >>> bool(mean.n_top < 60)
        True
    """

    value: float
    error: float
    n: float
    n_top: float
    weight: float
    steps: float
    steps_alone: float
    measure: str = eqx.field(static=True)
    control: str = eqx.field(static=True)

    def rows(self) -> list[Row]:
        unit = MEASURES[self.measure].plain_unit
        return [
            (f"mean {self.measure}", f"{self.value:.6g} ± {self.error:.1g} {unit}".strip()),
            ("asked on real ground", f"{self.n_top:.0f} wheels, {self.n:.0f} of them with a gait"),
            ("control", f"{self.control}, weight {self.weight:.3g}"),
            ("steps on real ground", f"{self.steps:.3g}, alone {self.steps_alone:.3g}"),
        ]


class _Plan(NamedTuple):
    """How a mean will be taken with one of the controls."""

    steps: float  # expected
    n: int  # wheels to be drawn
    weights: np.ndarray  # of what the control tells, and of its telling anything
    control: int


def average(
    measure: str,
    params: WheelParams,
    tol: float,
    *,
    friction: Any = 0.7,
    pilot: int = 32,
    seed: int = 0,
    stoppers: str = "bilateral",
) -> Average:
    """The mean of a measure over these wheels on real ground, to within `tol` (two deviations).

    Fields of `params` and `friction` have one axis, of wheels: a design, or draws from what
    manufacturing leaves. Wheels without a gait on real ground are left out.

    Args:
        measure: one of those that `answer` knows.
        params: the wheels.
        tol: two standard errors allowed, in the measure's unit.
        friction: of the ground.
        pilot: wheels asked first.
        seed: says which.
        stoppers: of the wheels that are meant, "bilateral" or "one-sided".

    Returns:
        An `Average`.

    Raises:
        TypeError, ValueError: an argument that can't be meant, or too few wheels with a gait.

    Examples:
        >>> wheels = vrw.WheelParams(damping=jnp.linspace(120.0, 200.0, 60))
        >>> mean = vrw.average("speed", wheels, 1e-2, friction=15.0, pilot=12)
        >>> bool(mean.error < 1.1e-2)
        True
    """
    untraced("vrw.average", "it on numbers, and give wheels as arrays", params, friction)
    instance("measure", measure, str, "give the name of one, 'speed', say")
    require_known(measure, tuple(MADE), "measure that every rung tells")
    chosen("stoppers", stoppers, ("bilateral", "one-sided"))
    tol, pilot = positive("tol", tol), whole("pilot", pilot, FEWEST, ", to tell a spread")
    seed = whole("seed", seed, 0)
    params, mu, shape = known_lanes(params, friction_of(friction))
    n = len(mu)
    if not shape or n <= pilot:
        raise ValueError(
            f"there are {n} wheels and a pilot of {pilot}, but a mean needs more wheels than its "
            "pilot: give lanes, params.damping of shape (1000,), say."
        )
    wheels = _Wheels(measure, params, mu, stoppers)
    order = np.random.default_rng(seed).permutation(n)
    first, rest = order[:pilot], order[pilot:]
    exact = wheels.asked(first, SHARE * tol)
    found = exact.found
    if np.sum(found) < FEWEST:
        raise ValueError(
            f"{np.sum(found)} of the pilot's {pilot} wheels have a gait on real ground, but a mean "
            f"needs {FEWEST}: give other wheels, or a larger pilot."
        )
    pilots = _Asked.of(exact)
    known = [_columns(wheels.known(first, control)) for control in range(len(CONTROLS))]
    plans = [_planned(i, pilots, x, tol, len(rest)) for i, x in enumerate(known)]
    plan = min(plans, key=lambda plan: plan.steps)
    drawn = wheels.asked(rest[: plan.n], SHARE * tol)
    value, deviation = _estimated(
        plan, pilots, _Asked.of(drawn), _columns(wheels.known(rest, plan.control))
    )
    gaits = np.concatenate([exact.error[found], drawn.error[drawn.found]])
    return Average(
        value=value,
        error=DEVIATIONS * deviation + float(np.mean(gaits)),
        n=float(len(gaits)),
        n_top=float(pilot + plan.n),
        weight=float(plan.weights[0]),
        steps=float(np.sum(exact.n_steps) + np.sum(drawn.n_steps)) + LOWER_COST[plan.control] * n,
        steps_alone=pilots.price * pilot + plans[0].steps,
        measure=measure,
        control=CONTROLS[plan.control],
    )


class _Asked(NamedTuple):
    """What wheels that were asked tell."""

    total: np.ndarray  # the measure, zero where there is no gait
    has: np.ndarray  # whether there is one
    price: float  # steps of each

    @classmethod
    def of(cls, told: Answer) -> "_Asked":
        has = told.found.astype(float)
        return cls(np.where(told.found, told.value, 0.0), has, float(np.mean(told.n_steps)))


class _Wheels(NamedTuple):
    """What is asked of which wheels."""

    measure: str
    params: WheelParams
    friction: np.ndarray
    stoppers: str

    def some(self, lanes: np.ndarray) -> WheelParams:
        return jax.device_put(taken(self.params, lanes))

    def asked(self, lanes: np.ndarray, tol: float) -> Answer:
        """On real ground."""
        given = self.measure, self.some(lanes), tol
        return answer(*given, friction=self.friction[lanes], stoppers=self.stoppers)

    def known(self, lanes: np.ndarray, control: int) -> np.ndarray:
        """What a control tells of them; NaN where nothing."""
        told = np.full(len(lanes), np.nan)
        if not control:
            return told
        options = Options()
        lower = paper_gaits(self.some(lanes), options)
        (has,) = np.nonzero(lower.rung)
        lower = Lower(*(part[has] for part in lower))
        values = measured([self.measure], lower.told)[:, 0]
        if control == len(CONTROLS) - 1:
            of = lanes[has]
            ground = Ground.of(self.some(of), self.friction[of], self.stoppers, options)
            every = np.arange(len(of))
            x = ground.embedded(every, lower.x)
            chord = Chord.of(ground, every, x, lower)
            seen = chord.see(every, ground.step(every, x), [self.measure])
            values = np.where(seen.same, seen.values[:, 0], values)
        told[has] = values
        return told


def _columns(known: np.ndarray) -> np.ndarray:
    """Of each wheel what a control tells, and whether it tells anything."""
    has = np.isfinite(known)
    return np.column_stack([np.where(has, known, 0.0), has])


def _planned(control: int, pilot: _Asked, x: np.ndarray, tol: float, n_rest: int) -> _Plan:
    """Weights and number of wheels by the pilot, for a mean to within `tol`.

    The mean M is of those with a gait, a ratio: what is controlled is each wheel's measure less M,
    zero where it has none, of which the sum is zero.
    """
    share = float(np.mean(pilot.has))
    z = pilot.total - np.mean(pilot.total) / share * pilot.has
    centred = x - np.mean(x, axis=0)
    weights, _, rank, _ = np.linalg.lstsq(centred, z, rcond=FLAT)
    squares = float(np.sum((z - centred @ weights) ** 2)) + _unseen(pilot, z)
    left = squares / (len(z) - 1 - int(rank))
    wanted = left * (DEVIATIONS / ((1.0 - SHARE) * tol * share)) ** 2
    n = min(n_rest, max(FEWEST, math.ceil(wanted / (1.0 + wanted / n_rest))))
    return _Plan(n * pilot.price + LOWER_COST[control] * n_rest, n, weights, control)


def _estimated(plan: _Plan, pilot: _Asked, drawn: _Asked, x: np.ndarray) -> tuple[float, float]:
    """The mean and its standard error: `x` of all but the pilot, the first of which were drawn."""
    n, known = len(x), x @ plan.weights
    count = np.sum(pilot.has) + n * np.mean(drawn.has)
    less = drawn.total - known[: plan.n]
    mean = (np.sum(pilot.total) + n * (np.mean(known) + np.mean(less))) / count
    squares = plan.n * np.var(less - mean * drawn.has)
    squares += _unseen(pilot, pilot.total - mean * pilot.has)
    variance = squares / (plan.n - 1) / plan.n * (1.0 - plan.n / n)
    return float(mean), float(n / count * math.sqrt(variance))


def _unseen(pilot: _Asked, z: np.ndarray) -> float:
    """Where gaits are lost, one more wheel counts that the control says nothing right of: few may
    have met none that has the paper's gait and no other."""
    return 0.0 if np.all(pilot.has) else float(np.var(z))
