"""Means over many wheels with unilateral contact, from few of its gaits and many of the lower
model's.

The lower model is a control variate. Its values are known for all wheels, and only the difference
from unilateral contact is sampled (M. B. Giles, Acta Numerica 24, 2015; B. Peherstorfer, K. Willcox
and M. Gunzburger, SIAM Review 60, 2018). A pilot sample of wheels determines the weight, the
control that is worth its cost, and the number of further wheels. The pilot's own wheels count as
known, and the others are drawn from the remaining ones. Nothing is therefore estimated from the
numbers that it is applied to, and the mean is unbiased. If some wheels have no gait, the mean is a
ratio of sums over all wheels. Its bias is then of the order of one over the number of sampled
wheels.
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
"""Number of standard errors in the stated error of a mean."""
SHARE = 0.1
"""Share of the mean's error that is allowed for each gait."""
FEWEST = 8
"""Smallest number of wheels with a gait for an estimate of the variance."""
FLAT = 1e-12
"""Share of the largest singular value below which the pilot does not determine a direction."""
CONTROLS = ("no control", "the paper's gaits", "the paper's gaits with one contact step")
LOWER_COST = (0.0, 1.0, 2.0)
"""Cost of a control in steps with unilateral contact: in batches, the paper's gait costs as much as
one step."""


class Average(AbstractTold):
    """Mean of a measure over wheels with unilateral contact.

    - `measure`: its name;
    - `value`: the mean, in the measure's unit;
    - `error`: two of its standard errors, plus the mean error of the gaits;
    - `n_gaits`: number of sampled wheels with a gait with unilateral contact;
    - `n_high_fidelity`: number of wheels computed with unilateral contact, the pilot included;
    - `control`: the control variate for the others, one of CONTROL_NAMES;
    - `weight`: the weight of the control;
    - `cost`: steps with unilateral contact, with the equivalent cost of the control included;
    - `cost_high_fidelity_only`: expected cost of a mean of the same error without a control.

    Examples:
        >>> wheels = vrw.WheelParams(damping=jnp.linspace(120.0, 200.0, 60))
        >>> mean = vrw.multifidelity_mean("speed", wheels, 1e-2, friction=15.0, pilot=12)
        >>> bool(mean.n_high_fidelity < 60)
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
            (
                "with unilateral contact",
                f"{self.n_top:.0f} wheels, {self.n:.0f} of them with a gait",
            ),
            ("control", f"{self.control}, weight {self.weight:.3g}"),
            ("contact steps", f"{self.steps:.3g}, alone {self.steps_alone:.3g}"),
        ]


class _Plan(NamedTuple):
    """Sampling plan for a mean with one of the controls."""

    steps: float  # expected
    n: int  # number of wheels to draw
    weights: np.ndarray  # of the control's value, and of the flag that it has one
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
    """Return the mean of a measure over these wheels with unilateral contact, to within `tol`.

    Fields of `params` and `friction` have one axis, of wheels: a design, or draws from
    manufacturing tolerances. Wheels without a gait with unilateral contact are left out.

    Args:
        measure: one of the measures of `measure_to_tolerance`.
        params: the wheels.
        tol: allowed error (two standard errors), in the measure's unit.
        friction: friction coefficient of the ground.
        pilot: number of wheels in the pilot sample.
        seed: of the random sample.
        stoppers: of the wheels, "bilateral" or "one-sided".

    Returns:
        A `MultifidelityMean`.

    Raises:
        TypeError, ValueError: an invalid argument, or too few wheels with a gait.

    Examples:
        >>> wheels = vrw.WheelParams(damping=jnp.linspace(120.0, 200.0, 60))
        >>> mean = vrw.multifidelity_mean("speed", wheels, 1e-2, friction=15.0, pilot=12)
        >>> bool(mean.error < 1.1e-2)
        True
    """
    untraced("vrw.average", "it on numbers, and give wheels as arrays", params, friction)
    instance("measure", measure, str, "give the name of one, 'speed', say")
    require_known(measure, tuple(MADE), "measure that every model has")
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
            f"{np.sum(found)} of the pilot's {pilot} wheels have a gait with contact, but a mean "
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
    """Measures of sampled wheels."""

    total: np.ndarray  # the measure, zero if there is no gait
    has: np.ndarray  # whether there is a gait
    price: float  # mean number of steps per wheel

    @classmethod
    def of(cls, told: Answer) -> "_Asked":
        has = told.found.astype(float)
        return cls(np.where(told.found, told.value, 0.0), has, float(np.mean(told.n_steps)))


class _Wheels(NamedTuple):
    """Wheels of a sample and the measure to evaluate."""

    measure: str
    params: WheelParams
    friction: np.ndarray
    stoppers: str

    def some(self, lanes: np.ndarray) -> WheelParams:
        return jax.device_put(taken(self.params, lanes))

    def asked(self, lanes: np.ndarray, tol: float) -> Answer:
        """Return the measure with unilateral contact."""
        given = self.measure, self.some(lanes), tol
        return answer(*given, friction=self.friction[lanes], stoppers=self.stoppers)

    def known(self, lanes: np.ndarray, control: int) -> np.ndarray:
        """Return the values of a control; NaN where it has none."""
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
    """Return for each wheel the control's value, and whether it has one."""
    has = np.isfinite(known)
    return np.column_stack([np.where(has, known, 0.0), has])


def _planned(control: int, pilot: _Asked, x: np.ndarray, tol: float, n_rest: int) -> _Plan:
    """Return weights and number of wheels from the pilot, for a mean to within `tol`.

    The mean M is over the wheels with a gait, a ratio. The controlled quantity is each wheel's
    measure minus M, zero for a wheel without a gait; its sum is zero.
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
    """Return the mean and its standard error. `control_columns` are of all wheels but the pilot;
    the first ones were drawn."""
    n, known = len(x), x @ plan.weights
    count = np.sum(pilot.has) + n * np.mean(drawn.has)
    less = drawn.total - known[: plan.n]
    mean = (np.sum(pilot.total) + n * (np.mean(known) + np.mean(less))) / count
    squares = plan.n * np.var(less - mean * drawn.has)
    squares += _unseen(pilot, pilot.total - mean * pilot.has)
    variance = squares / (plan.n - 1) / plan.n * (1.0 - plan.n / n)
    return float(mean), float(n / count * math.sqrt(variance))


def _unseen(pilot: _Asked, z: np.ndarray) -> float:
    """Return the variance of one extra wheel that the control predicts wrongly, if gaits are lost.

    A small sample may contain no wheel with a gait of the paper's model and without one of
    unilateral contact.
    """
    return 0.0 if np.all(pilot.has) else float(np.var(z))
