"""Plain counts of failures on random slopes, with which first passages are compared."""

from typing import NamedTuple

import equinox as eqx
import numpy as np

import vrw_jax as vrw
from vrw_jax.studies.first_passage import SAMPLED_STEP_TOLERANCE

NORMAL_QUANTILE = 2.576
"""Half width of a 99 % confidence interval, in standard deviations of a normal distribution."""


class FailureCount(NamedTuple):
    """Number of failures among the counted steps."""

    n_failures: int
    n_counted: int  # steps after the effect of the start has decayed
    n_steps: int  # all steps

    @property
    def mean_steps(self) -> float:
        """Return the mean number of steps until a failure."""
        return self.n_counted / self.n_failures

    @property
    def relative_error(self) -> float:
        """Return half the relative width of a 99 % confidence interval of `mean_steps`."""
        return float(NORMAL_QUANTILE / np.sqrt(self.n_failures))


def count_failures(
    params: vrw.WheelParams,
    slope_sd: float,
    n_failures: int,
    *,
    seed: int,
    n_forgetting_steps: int = 12,
    n_walkers: int = 16384,
    step_tolerance: float = SAMPLED_STEP_TOLERANCE,
) -> FailureCount:
    """Return a count for walks of the paper's model, with at least `n_failures` failures.

    The walks run side by side, and all begin at the gait. A failed walk continues as a copy of
    another one, so that the walks have the quasi-stationary distribution after `n_forgetting_steps`
    steps. The count begins then. The relative and absolute tolerance of gait steps is
    `step_tolerance`.
    """
    random, mean_slope = np.random.default_rng(seed), float(params.slope)
    gait_state = np.asarray(vrw.limit_cycle(params).section_state)
    states = np.tile(gait_state, (n_walkers, 1))
    slopes = np.full(n_walkers, mean_slope)
    options = vrw.StepOptions(rtol=step_tolerance, atol=step_tolerance)
    n_failed, n_rounds = 0, 0
    while n_failed < n_failures:
        next_slopes = mean_slope + slope_sd * random.standard_normal(n_walkers)
        wheels = eqx.tree_at(lambda p: p.slope, params, np.stack([slopes, next_slopes], 1))
        result = vrw.step_batch(wheels, states, options=options)
        is_alive = result.outcome == vrw.Outcome.STEPPED
        n_failed += int(np.sum(~is_alive)) if n_rounds >= n_forgetting_steps else 0
        n_rounds += 1
        sources = np.arange(n_walkers)
        sources[~is_alive] = random.choice(sources[is_alive], np.sum(~is_alive))
        states, slopes = result.section_state[sources], next_slopes[sources]
    n_counted = (n_rounds - n_forgetting_steps) * n_walkers
    return FailureCount(n_failed, n_counted, n_rounds * n_walkers)
