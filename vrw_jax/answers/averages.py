"""Means over many wheels on real ground, from few of its gaits and many of the lower rung's.

The lower rung is a control variate: what it tells of all wheels is known, and only its difference
from real ground is sampled (M. B. Giles, Acta Numerica 24, 2015; B. Peherstorfer, K. Willcox and
M. Gunzburger, SIAM Review 60, 2018). A pilot of wheels drawn first tells the weight, which control
is worth its price, and how many more are needed. Its own wheels count as known and the others are
drawn from those that are left, so that nothing is estimated from the numbers that it is applied to,
and the mean is unbiased.
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
from vrw_jax.numerics import Options
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
    weight: float
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
    y, price = exact.value[found], float(np.mean(exact.n_steps))
    known = [wheels.known(first, control)[found] for control in range(len(CONTROLS))]
    plans = [_planned(i, y, x, tol, len(rest), price) for i, x in enumerate(known)]
    plan = min(plans, key=lambda plan: plan.steps)
    mean_of_rest, variance, more = _estimated(wheels, plan, rest, tol, float(np.mean(y)))
    kept, share = more.found, len(rest) / n
    gaits = np.concatenate([exact.error[found], more.error[kept]])
    return Average(
        value=(1.0 - share) * float(np.mean(y)) + share * mean_of_rest,
        error=DEVIATIONS * share * math.sqrt(variance) + float(np.mean(gaits)),
        n=float(np.sum(found) + np.sum(kept)),
        n_top=float(pilot + plan.n),
        weight=plan.weight,
        steps=float(np.sum(exact.n_steps) + np.sum(more.n_steps)) + LOWER_COST[plan.control] * n,
        steps_alone=price * pilot + plans[0].steps,
        measure=measure,
        control=CONTROLS[plan.control],
    )


class _Wheels(NamedTuple):
    """What is asked of which wheels."""

    measure: str
    params: WheelParams
    friction: np.ndarray
    stoppers: str

    def some(self, lanes: np.ndarray) -> WheelParams:
        return jax.tree.map(lambda x: x[lanes], self.params)

    def asked(self, lanes: np.ndarray, tol: float) -> Answer:
        """On real ground."""
        given = self.measure, self.some(lanes), tol
        return answer(*given, friction=self.friction[lanes], stoppers=self.stoppers)

    def known(self, lanes: np.ndarray, control: int) -> np.ndarray:
        """What a control tells of them; NaN where nothing."""
        told = np.full(len(lanes), np.nan)
        if not control:
            return 0.0 * lanes
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


def _estimated(
    wheels: _Wheels, plan: _Plan, rest: np.ndarray, tol: float, usual: float
) -> tuple[float, float, Answer]:
    """Mean over the `rest`, its variance, and what was asked for it."""
    drawn = rest[: plan.n]
    more = wheels.asked(drawn, SHARE * tol)
    known = wheels.known(rest, plan.control)
    # Where the lower rung tells nothing, any number that was known before serves.
    known = plan.weight * np.where(np.isfinite(known), known, usual)
    left = (more.value - known[: plan.n])[more.found]
    if len(left) < 2:
        raise ValueError(
            f"{len(left)} of {plan.n} wheels drawn have a gait on real ground, but a mean needs 2: "
            "give a larger pilot, or other wheels."
        )
    variance = float(np.var(left, ddof=1)) / len(left) * (1.0 - plan.n / len(rest))
    return float(np.mean(known) + np.mean(left)), variance, more


def _planned(
    control: int, y: np.ndarray, x: np.ndarray, tol: float, n_rest: int, price: float
) -> _Plan:
    """Weight and number of wheels by the pilot, for a mean to within `tol`."""
    x = np.where(np.isfinite(x), x, np.mean(y))
    spread = float(np.var(x))
    weight = float(np.cov(x, y, ddof=0)[0, 1]) / spread if control and spread > 0.0 else 0.0
    left = float(np.var(y - weight * x, ddof=1 + (control > 0)))
    wanted = left * (DEVIATIONS / ((1.0 - SHARE) * tol)) ** 2
    n = min(n_rest, max(FEWEST, math.ceil(wanted / (1.0 + wanted / n_rest))))
    return _Plan(n * price + LOWER_COST[control] * n_rest, n, weight, control)
