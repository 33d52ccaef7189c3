"""First passage by sampling walks, with failures made frequent by importance sampling.

Groups of walkers walk over random slopes until they have forgotten the gait. A walker that fails is
replaced by a copy of another of its group (Fleming and Viot), so that all have the quasi-stationary
distribution. From there walks of a few steps are drawn from a density under which many fail in
their last step. Likelihood ratios give the probability of that failure without bias. Groups are
independent, so that their spread gives the error.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import equinox as eqx
import numpy as np

from vrw_jax.batches import StepBatchResult, step_batch
from vrw_jax.numerics import StepOptions
from vrw_jax.robustness.failure_density import GaussianMixture, fit_failure_density
from vrw_jax.wheel import Outcome, WheelParams


@dataclass(frozen=True)
class SamplingOptions:
    """Numerical choices of sampled first passages."""

    n_groups: int = 32
    """Number of independent groups of walkers, chosen because the quantile for 99 % is then within
    7 % of that of the normal distribution."""
    forgotten_effect: float = 0.01
    """Effect of a line on a later state, relative to that on the next, below which its slope is
    drawn without bias. The result has no bias for any number; this one makes weights similar."""
    max_biased_lines: int = 12
    """Largest number of lines whose slopes are drawn with a bias, chosen because fits in more
    dimensions need more samples."""
    counted_failures: float = 0.2
    """Expected failures over the lines drawn with a bias above which failures are counted without
    bias, chosen because both ways need as many steps there."""
    min_forgetting_steps: int = 6
    """Least number of steps before a walker counts as having forgotten the gait."""
    max_forgetting_steps: int = 100
    """Largest number of these steps, chosen because gaits that forget more slowly are almost
    unstable."""
    max_first_rounds: int = 40
    """Largest number of rounds of walks from the gait, chosen because more are needed only if most
    walks fail within three steps."""
    n_regression_steps: int = 4
    """Number of steps whose states before and after give kappa_2."""
    min_rounds: int = 4
    """Least number of rounds of all walkers, chosen because the error of fewer is uncertain."""
    forgotten_share: float = 0.1
    """Deviation from the gait's start that remains, relative to the tolerance."""
    confidence: float = 0.99
    """Confidence of the error estimate."""


SAMPLING_OPTIONS = SamplingOptions()

N_GEOMETRIC_ITERATIONS = 60
"""Number of fixed-point iterations, chosen because each gains a factor of two or more."""

REGRESSION_CUTOFF = 0.003
"""Least relative singular value of standardized states that enters the regression, chosen because
noise dominates smaller ones: a landing with two feet held leaves two degrees of freedom."""


class ExtinctGroupError(ValueError):
    """A group of walkers of which none survived a step."""


class SampledPassage(NamedTuple):
    """First passage of a model from samples."""

    failure_probability: float  # of one step from the quasi-stationary distribution
    relative_error: float  # half the width of the confidence interval, and the start's remainder
    mean_steps_from_gait: float
    kappa_2: float
    states: (
        np.ndarray
    )  # walkers of the quasi-stationary distribution, with the slope last, (n, ...)
    share_by_outcome: dict[str, float]
    n_steps: int


class WalkerGroups:
    """Groups of walkers side by side on random slopes. All walkers begin at the gait."""

    def __init__(
        self,
        params: WheelParams,
        section_state: np.ndarray,
        slope_sd: float,
        model: Any,
        step_options: StepOptions,
        n_walkers: int,
        random: np.random.Generator,
        options: SamplingOptions = SAMPLING_OPTIONS,
    ) -> None:
        self.params, self.model, self.step_options = params, model, step_options
        self.mean_slope, self.slope_sd, self.random = float(params.slope), slope_sd, random
        self.n_groups, self.n_continuous = options.n_groups, int(model.n_continuous(params))
        group_size = -(-n_walkers // self.n_groups)
        self.states = self.start = np.tile(section_state, (self.n_groups * group_size, 1))
        self.slopes = np.full(len(self.states), self.mean_slope)
        self.n_steps = 0
        self.weight_by_outcome: dict[int, float] = {}

    def run_walks(self, deviations: np.ndarray) -> StepBatchResult:
        """Return walks that begin at the walkers in turn, over lines of standardized deviations."""
        slopes = self.mean_slope + self.slope_sd * deviations
        walkers = np.arange(len(deviations)) % len(self.states)
        lines = np.concatenate([self.slopes[walkers, None], slopes], 1)
        wheels = eqx.tree_at(lambda wheel: wheel.slope, self.params, lines)
        result = step_batch(
            wheels,
            self.states[walkers],
            deviations.shape[1],
            model=self.model,
            options=self.step_options,
        )
        self.n_steps += int(np.sum(result.n_stepped)) + int(
            np.sum(result.outcome != Outcome.STEPPED)
        )
        return result

    def record_failures(self, outcome: np.ndarray, weights: np.ndarray) -> None:
        """Add the weights of failures to those of their outcomes."""
        for code in np.unique(outcome[weights > 0.0]):
            weight = float(np.sum(weights[outcome == code]))
            self.weight_by_outcome[int(code)] = self.weight_by_outcome.get(int(code), 0.0) + weight

    def restart_at_gait(self) -> None:
        """Put all walkers at the gait, on lines of the mean slope."""
        self.states, self.slopes = self.start, np.full(len(self.start), self.mean_slope)

    def markov_states(self) -> np.ndarray:
        """Return section states with the slope of the line last, (walkers, numbers)."""
        return np.concatenate([self.states, self.slopes[:, None]], 1)

    def advance(self) -> tuple[np.ndarray, np.ndarray]:
        """Take one step of every walker, replace failed ones, and return which survived, and the
        standardized deviations of the slopes on which they landed.

        Raises:
            ExtinctGroupError: no walker of a group survived.
        """
        n_walkers = len(self.states)
        deviations = self.random.standard_normal((n_walkers, 1))
        result = self.run_walks(deviations)
        is_alive: np.ndarray = result.outcome == Outcome.STEPPED
        self.record_failures(result.outcome, (~is_alive).astype(float))
        source = np.arange(n_walkers).reshape(self.n_groups, -1)
        for walkers, alive in zip(source, is_alive.reshape(source.shape), strict=True):
            if not np.any(alive):
                raise ExtinctGroupError
            walkers[~alive] = self.random.choice(walkers[alive], np.sum(~alive))
        self.states = result.section_state[source.ravel()]
        self.slopes = self.mean_slope + self.slope_sd * deviations[source.ravel(), 0]
        return is_alive, deviations[:, 0]


def sample_passage(
    groups: WalkerGroups,
    spectral_radius: float,
    tol: float,
    max_steps: int,
    options: SamplingOptions = SAMPLING_OPTIONS,
) -> SampledPassage:
    """Return the first passage from walks of these groups, until the relative error is `tol`.

    Args:
        groups: walkers at the gait.
        spectral_radius: of the gait.
        tol: relative error.
        max_steps: number of steps after which no further walks begin.
        options: numerical choices.

    Raises:
        ExtinctGroupError: no walker of a group survived a step.
    """
    from scipy import stats  # This import is slow.

    quantile = float(stats.t.ppf(0.5 * (1.0 + options.confidence), groups.n_groups - 1))
    steps_to = lambda share: int(
        np.ceil(np.log(share) / np.log(np.clip(spectral_radius, 0.01, 0.99)))
    )
    limits = options.min_forgetting_steps, options.max_forgetting_steps
    n_forgetting = int(np.clip(steps_to(options.forgotten_share * tol), *limits))
    alive_shares = _count_first_steps(groups, n_forgetting, tol / quantile, options)
    groups.restart_at_gait()
    pairs = []
    for _ in range(n_forgetting):
        before = groups.markov_states()
        is_alive, deviations = groups.advance()
        pairs.append((before, is_alive, deviations, groups.markov_states()))
    kappa_2 = _estimate_kappa_2(pairs[-options.n_regression_steps :], groups.n_continuous)
    groups.weight_by_outcome.clear()
    n_lines = min(steps_to(options.forgotten_effect), options.max_biased_lines)
    sample_round: Callable[[], np.ndarray] | None
    if n_lines * np.mean(~is_alive) > options.counted_failures:
        n_lines = 1
        sample_round = lambda: (~groups.advance()[0]).astype(float)
    else:
        sample_round = _make_biased_round(groups, n_lines)
    group_sums, n_rounds = np.zeros(groups.n_groups), 0
    probability, relative_error = 0.0, np.inf
    remaining_start = max(kappa_2, spectral_radius) ** (n_forgetting + n_lines - 1)
    while sample_round and (
        n_rounds < options.min_rounds or (relative_error > tol and groups.n_steps < max_steps)
    ):
        group_sums += sample_round().reshape(groups.n_groups, -1).mean(1)
        n_rounds += 1
        last_failure = float(np.mean(group_sums)) / n_rounds
        if last_failure > 0.0:
            probability, amplification = _solve_geometric(last_failure, n_lines)
            standard_error = np.std(group_sums, ddof=1) / np.sqrt(groups.n_groups) / n_rounds
            sampling_error = quantile * amplification * standard_error / last_failure
            relative_error = float(sampling_error + remaining_start)
    mean_from_gait = np.inf
    if probability > 0.0:
        mean_from_gait = float(np.sum(alive_shares[1:-1]) + alive_shares[-1] / probability)
    total_weight = sum(groups.weight_by_outcome.values())
    return SampledPassage(
        failure_probability=probability,
        relative_error=relative_error,
        mean_steps_from_gait=mean_from_gait,
        kappa_2=kappa_2,
        states=groups.markov_states(),
        share_by_outcome={
            Outcome(code).name: weight / total_weight
            for code, weight in sorted(groups.weight_by_outcome.items(), key=lambda item: -item[1])
        },
        n_steps=groups.n_steps,
    )


def _count_first_steps(
    groups: WalkerGroups, n_steps: int, relative_error: float, options: SamplingOptions
) -> np.ndarray:
    """Return the shares of walks from the gait that survive 0, 1, ... `n_steps` steps.

    Rounds of all walkers are repeated until the last share has this relative standard error.
    """
    n_survivors, n_walks = np.zeros(n_steps + 1), 0
    for _ in range(options.max_first_rounds):
        groups.restart_at_gait()
        n_stepped = groups.run_walks(groups.random.standard_normal((len(groups.start), n_steps)))
        n_walks += len(groups.start)
        counts = np.bincount(n_stepped.n_stepped, minlength=n_steps + 1)
        n_survivors += np.cumsum(counts[::-1])[::-1]
        if n_walks - n_survivors[-1] < relative_error**2 * n_walks * n_survivors[-1]:
            break
    return n_survivors / n_walks


def _make_biased_round(groups: WalkerGroups, n_lines: int) -> Callable[[], np.ndarray] | None:
    """Return a function that walks once from every walker over `n_lines` lines.

    It returns the weights of the walks that fail in their last step, and 0 for others. The mean of
    the weights is the probability of that failure. Return None if no failure was found.
    """

    def find_failures(deviations: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        result = groups.run_walks(deviations)
        fails = result.outcome != Outcome.STEPPED
        return fails & (result.n_stepped == n_lines - 1), fails

    density = fit_failure_density(find_failures, n_lines, groups.random)
    if density is None:
        return None
    nominal = GaussianMixture.isotropic(n_lines, 1.0)

    def sample_round() -> np.ndarray:
        deviations = density.sample(len(groups.states), groups.random)
        result = groups.run_walks(deviations)
        fails_last = (result.outcome != Outcome.STEPPED) & (result.n_stepped == n_lines - 1)
        ratios = np.exp(nominal.log_density(deviations) - density.log_density(deviations))
        weights = np.where(fails_last, ratios, 0.0)
        groups.record_failures(result.outcome, weights)
        return weights

    return sample_round


def _solve_geometric(last_failure: float, n_lines: int) -> tuple[float, float]:
    """Return p with p (1 - p)^(n_lines - 1) = `last_failure`, and the amplification of relative
    errors by the solution.

    It is the probability to fail in the last of `n_lines` steps from the quasi-stationary
    distribution, where each step fails with probability p.
    """
    p = last_failure
    for _ in range(N_GEOMETRIC_ITERATIONS):
        p = min(last_failure / (1.0 - p) ** (n_lines - 1), 0.9 / n_lines) if n_lines > 1 else p
    return p, 1.0 / (1.0 - (n_lines - 1) * p / (1.0 - p))


def _estimate_kappa_2(pairs: Sequence[tuple[np.ndarray, ...]], n_continuous: int) -> float:
    """Return the second eigenvalue of the survival operator, projected on quadratic functions.

    Pairs are states before a step, survival, deviations of the slope on which it ends, and states
    after it. The projection is the extended dynamic mode decomposition (Williams, Kevrekidis and
    Rowley 2015). Polynomials of that deviation, whose mean is zero in any state, take most of the
    noise out of the regression. As the slopes become equal, the eigenvalue becomes the leading
    multiplier of the gait.
    """
    before, is_alive, noise, after = (np.concatenate(parts) for parts in zip(*pairs, strict=True))
    center = before.mean(0)
    coordinates = [i for i in (*range(n_continuous), before.shape[1] - 1) if np.ptp(before[:, i])]
    scale = before[:, coordinates].std(0)
    standardize = lambda states: (states - center)[:, coordinates] / scale
    _, singular_values, directions = np.linalg.svd(standardize(before), full_matrices=False)
    is_resolved = singular_values > REGRESSION_CUTOFF * singular_values[0]
    directions = directions[is_resolved] * np.sqrt(len(before)) / singular_values[is_resolved, None]
    rows, columns = np.triu_indices(len(directions))

    def features(states: np.ndarray) -> np.ndarray:
        z = standardize(states) @ directions.T
        return np.concatenate([np.ones((len(z), 1)), z, z[:, rows] * z[:, columns]], 1)

    images, basis = np.where(is_alive[:, None], features(after), 0.0), features(before)
    linear = basis[:, : 1 + len(directions)]
    hermite = noise[:, None], noise[:, None] ** 2 - 1.0
    regressors = np.concatenate([basis, *(linear * polynomial for polynomial in hermite)], 1)
    coefficients = np.linalg.lstsq(regressors, images, rcond=None)[0]
    moduli = np.sort(np.abs(np.linalg.eigvals(coefficients[: basis.shape[1]])))
    return float(moduli[-2])
