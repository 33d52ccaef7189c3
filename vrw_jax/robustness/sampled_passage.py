"""First passage by sampled walks, with failures made frequent by importance sampling.

Groups of walkers walk over random slopes until the effect of the start has decayed. A walker that
fails is replaced by a copy of another walker of its group (Fleming and Viot). So all walkers have
the quasi-stationary distribution. Then walks of a few steps are drawn from a density under which
many walks fail in their last step. Likelihood ratios give the probability of that failure without
bias. Groups are independent, so that their spread gives the error.
"""

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import equinox as eqx
import numpy as np

from vrw_jax.batches import StepBatchResult, step_batch
from vrw_jax.numerics import StepOptions
from vrw_jax.robustness.failure_density import (
    DENSITY_OPTIONS,
    GaussianMixture,
    fit_failure_density,
)
from vrw_jax.wheel import Outcome, WheelParams


@dataclass(frozen=True)
class PassageSamplingOptions:
    """Options of sampled first passages."""

    n_groups: int = 32
    """Number of independent groups of walkers. The value is chosen because the quantile for 99 % is
    then within 7 % of that of the normal distribution."""
    negligible_line_effect: float = 0.01
    """Effect of a line on a later state, relative to that on the next state, below which the line's
    slope is drawn without bias. The result has no bias for any value. The value is chosen because
    weights are then similar."""
    max_biased_lines: int = 12
    """Largest number of lines whose slopes are drawn with a bias. The value is chosen because fits
    in more dimensions need more samples."""
    min_counted_failures: float = 0.2
    """Expected number of failures over the biased lines above which failures are counted without
    bias. The value is chosen because both methods then need as many steps."""
    min_forgetting_steps: int = 6
    """Smallest number of steps after which the effect of the start counts as decayed."""
    max_forgetting_steps: int = 100
    """Largest number of these steps. The value is chosen because gaits with slower decay are almost
    unstable."""
    max_first_rounds: int = 40
    """Largest number of rounds of walks from the gait. The value is chosen because more rounds are
    needed only if most walks fail within three steps."""
    n_regression_steps: int = 4
    """Number of steps whose states before and after are used to estimate kappa_2."""
    min_rounds: int = 4
    """Smallest number of rounds of all walkers. The value is chosen because the error of fewer
    rounds is uncertain."""
    remaining_start_fraction: float = 0.1
    """Fraction of the start's effect that remains, relative to the tolerance."""
    confidence: float = 0.99
    """Confidence of the error estimate."""


PASSAGE_SAMPLING_OPTIONS = PassageSamplingOptions()

N_FIXED_POINT_ITERATIONS = 60
"""Number of fixed-point iterations, chosen because each iteration reduces the error by a factor of
two or more."""

MIN_RELATIVE_SINGULAR_VALUE = 0.003
"""Smallest relative singular value of standardized states that enters the regression. The value is
chosen because noise dominates smaller ones: a landing with two feet held leaves two degrees of
freedom."""


class ExtinctGroupError(ValueError):
    """Error for a group of walkers of which no walker survived a step."""


class SampledPassage(NamedTuple):
    """First passage of a model, estimated from samples."""

    failure_probability: float  # of one step from the quasi-stationary distribution
    relative_error: float  # half confidence interval, plus the start's remaining effect
    mean_steps_from_gait: float
    kappa_2: float
    states: np.ndarray  # of the quasi-stationary distribution, the slope last, (n, entries)
    fraction_by_outcome: dict[str, float]
    n_steps: int


class WalkerGroups:
    """Groups of walkers side by side on random slopes. All walkers start at the gait."""

    def __init__(
        self,
        params: WheelParams,
        section_state: np.ndarray,
        slope_sd: float,
        model: Any,
        step_options: StepOptions,
        n_walkers: int,
        generator: np.random.Generator,
        options: PassageSamplingOptions = PASSAGE_SAMPLING_OPTIONS,
    ) -> None:
        self.params, self.model, self.step_options = params, model, step_options
        self.mean_slope, self.slope_sd, self.random = float(params.slope), slope_sd, generator
        self.n_groups, self.n_continuous = options.n_groups, int(model.n_continuous(params))
        group_size = -(-n_walkers // self.n_groups)
        self.states = self.gait_states = np.tile(section_state, (self.n_groups * group_size, 1))
        self.slopes = np.full(len(self.states), self.mean_slope)
        self.n_steps = 0
        self.weight_by_outcome: dict[int, float] = {}

    def run_walks(self, deviations: np.ndarray) -> StepBatchResult:
        """Return walks from the states of the walkers, over lines of standardized slope deviations.

        Walk i starts at walker i modulo the number of walkers.

        - `deviations`: standardized deviations of the slopes, (walks, lines).
        """
        slopes = self.mean_slope + self.slope_sd * deviations
        walker_indices = np.arange(len(deviations)) % len(self.states)
        line_slopes = np.concatenate([self.slopes[walker_indices, None], slopes], 1)
        wheels = eqx.tree_at(lambda wheel: wheel.slope, self.params, line_slopes)
        walk_results = step_batch(
            wheels,
            self.states[walker_indices],
            deviations.shape[1],
            model=self.model,
            options=self.step_options,
        )
        self.n_steps += int(np.sum(walk_results.n_stepped)) + int(
            np.sum(walk_results.outcome != Outcome.STEPPED)
        )
        return walk_results

    def record_failures(self, outcome: np.ndarray, weights: np.ndarray) -> None:
        """Add the weights of failed walks to the totals of their outcomes."""
        for outcome_code in np.unique(outcome[weights > 0.0]):
            weight = float(np.sum(weights[outcome == outcome_code]))
            self.weight_by_outcome[int(outcome_code)] = (
                self.weight_by_outcome.get(int(outcome_code), 0.0) + weight
            )

    def restart_at_gait(self) -> None:
        """Set all walkers to the gait, on lines of the mean slope."""
        self.states, self.slopes = self.gait_states, np.full(len(self.gait_states), self.mean_slope)

    def get_markov_states(self) -> np.ndarray:
        """Return section states with the slope of the line last, (walkers, entries)."""
        return np.concatenate([self.states, self.slopes[:, None]], 1)

    def advance_walkers(self) -> tuple[np.ndarray, np.ndarray]:
        """Take one step of every walker, and replace the failed ones.

        Return whether each walker survived, and the standardized deviations of the slopes on which
        walkers landed. Raises `ExtinctGroupError` if no walker of a group survived.
        """
        n_walkers = len(self.states)
        deviations = self.random.standard_normal((n_walkers, 1))
        walk_results = self.run_walks(deviations)
        is_alive: np.ndarray = walk_results.outcome == Outcome.STEPPED
        self.record_failures(walk_results.outcome, (~is_alive).astype(float))
        source_walkers = np.arange(n_walkers).reshape(self.n_groups, -1)
        for group_walkers, is_group_alive in zip(
            source_walkers, is_alive.reshape(source_walkers.shape), strict=True
        ):
            if not np.any(is_group_alive):
                raise ExtinctGroupError
            group_walkers[~is_group_alive] = self.random.choice(
                group_walkers[is_group_alive], np.sum(~is_group_alive)
            )
        self.states = walk_results.section_state[source_walkers.ravel()]
        self.slopes = self.mean_slope + self.slope_sd * deviations[source_walkers.ravel(), 0]
        return is_alive, deviations[:, 0]


def sample_passage(
    walker_groups: WalkerGroups,
    spectral_radius: float,
    tol: float,
    max_steps: int,
    options: PassageSamplingOptions = PASSAGE_SAMPLING_OPTIONS,
) -> SampledPassage:
    """Return the first passage from walks of these groups, until the relative error is `tol`.

    Args:
        walker_groups: groups of walkers at the gait.
        spectral_radius: of the gait.
        tol: relative error.
        max_steps: number of steps after which no further walks begin.
        options: numerical choices.

    Raises:
        ExtinctGroupError: no walker of a group survived a step.
    """
    from scipy import stats  # This import is slow.

    student_quantile = float(
        stats.t.ppf(0.5 * (1.0 + options.confidence), walker_groups.n_groups - 1)
    )
    count_steps_to = lambda remaining_fraction: int(
        np.ceil(np.log(remaining_fraction) / np.log(np.clip(spectral_radius, 0.01, 0.99)))
    )
    step_limits = options.min_forgetting_steps, options.max_forgetting_steps
    n_forgetting_steps = int(
        np.clip(count_steps_to(options.remaining_start_fraction * tol), *step_limits)
    )
    surviving_fractions = _count_first_steps(
        walker_groups, n_forgetting_steps, tol / student_quantile, options
    )
    walker_groups.restart_at_gait()
    transitions = []
    for _ in range(n_forgetting_steps):
        states_before = walker_groups.get_markov_states()
        is_alive, deviations = walker_groups.advance_walkers()
        transitions.append((states_before, is_alive, deviations, walker_groups.get_markov_states()))
    kappa_2 = _estimate_kappa_2(
        transitions[-options.n_regression_steps :], walker_groups.n_continuous
    )
    walker_groups.weight_by_outcome.clear()
    n_lines = min(count_steps_to(options.negligible_line_effect), options.max_biased_lines)
    sample_round: Callable[[], np.ndarray] | None
    if n_lines * np.mean(~is_alive) > options.min_counted_failures:
        n_lines = 1
        sample_round = lambda: (~walker_groups.advance_walkers()[0]).astype(float)
    else:
        sample_round = _make_biased_round(walker_groups, n_lines)
    group_sums, n_rounds = np.zeros(walker_groups.n_groups), 0
    failure_probability, relative_error = 0.0, np.inf
    remaining_start_effect = max(kappa_2, spectral_radius) ** (n_forgetting_steps + n_lines - 1)
    while sample_round and (
        n_rounds < options.min_rounds
        or (relative_error > tol and walker_groups.n_steps < max_steps)
    ):
        group_sums += sample_round().reshape(walker_groups.n_groups, -1).mean(1)
        n_rounds += 1
        last_step_failure_probability = float(np.mean(group_sums)) / n_rounds
        if last_step_failure_probability > 0.0:
            failure_probability, amplification = _solve_step_probability(
                last_step_failure_probability, n_lines
            )
            standard_error = np.std(group_sums, ddof=1) / np.sqrt(walker_groups.n_groups) / n_rounds
            sampling_error = (
                student_quantile * amplification * standard_error / last_step_failure_probability
            )
            relative_error = float(sampling_error + remaining_start_effect)
    mean_from_gait = np.inf
    if failure_probability > 0.0:
        mean_from_gait = float(
            np.sum(surviving_fractions[1:-1]) + surviving_fractions[-1] / failure_probability
        )
    total_weight = sum(walker_groups.weight_by_outcome.values())
    return SampledPassage(
        failure_probability=failure_probability,
        relative_error=relative_error,
        mean_steps_from_gait=mean_from_gait,
        kappa_2=kappa_2,
        states=walker_groups.get_markov_states(),
        fraction_by_outcome={
            Outcome(outcome_code).name: weight / total_weight
            for outcome_code, weight in sorted(
                walker_groups.weight_by_outcome.items(),
                key=lambda outcome_weight: -outcome_weight[1],
            )
        },
        n_steps=walker_groups.n_steps,
    )


def _count_first_steps(
    walker_groups: WalkerGroups,
    n_steps: int,
    relative_error: float,
    options: PassageSamplingOptions,
) -> np.ndarray:
    """Return the fractions of walks from the gait that survive 0, 1, ... `n_steps` steps.

    Rounds of all walkers are repeated until the last fraction has this relative standard error.
    """
    n_survivors, n_walks = np.zeros(n_steps + 1), 0
    for _ in range(options.max_first_rounds):
        walker_groups.restart_at_gait()
        walk_results = walker_groups.run_walks(
            walker_groups.random.standard_normal((len(walker_groups.gait_states), n_steps))
        )
        n_walks += len(walker_groups.gait_states)
        n_walks_by_length = np.bincount(walk_results.n_stepped, minlength=n_steps + 1)
        n_survivors += np.cumsum(n_walks_by_length[::-1])[::-1]
        if n_walks - n_survivors[-1] < relative_error**2 * n_walks * n_survivors[-1]:
            break
    return n_survivors / n_walks


def _make_biased_round(
    walker_groups: WalkerGroups, n_lines: int
) -> Callable[[], np.ndarray] | None:
    """Return a function that runs one walk from every walker over `n_lines` lines; None without
    failures.

    The function returns the likelihood ratios of walks that fail in their last step, and 0 for
    other walks. The mean of these weights is the probability of such a failure.
    """

    def find_failures(deviations: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        walk_results = walker_groups.run_walks(deviations)
        has_failed = walk_results.outcome != Outcome.STEPPED
        return has_failed & (walk_results.n_stepped == n_lines - 1), has_failed

    density_options = dataclasses.replace(
        DENSITY_OPTIONS, n_samples=min(DENSITY_OPTIONS.n_samples, len(walker_groups.states))
    )
    failure_density = fit_failure_density(
        find_failures, n_lines, walker_groups.random, density_options
    )
    if failure_density is None:
        return None
    nominal_density = GaussianMixture.isotropic(n_lines, 1.0)

    def sample_round() -> np.ndarray:
        deviations = failure_density.draw_samples(len(walker_groups.states), walker_groups.random)
        walk_results = walker_groups.run_walks(deviations)
        has_failed_last = (walk_results.outcome != Outcome.STEPPED) & (
            walk_results.n_stepped == n_lines - 1
        )
        likelihood_ratios = np.exp(
            nominal_density.compute_log_density(deviations)
            - failure_density.compute_log_density(deviations)
        )
        weights = np.where(has_failed_last, likelihood_ratios, 0.0)
        walker_groups.record_failures(walk_results.outcome, weights)
        return weights

    return sample_round


def _solve_step_probability(
    last_step_failure_probability: float, n_lines: int
) -> tuple[float, float]:
    """Return p with p (1 - p)^(n_lines - 1) = `last_step_failure_probability`, and an error
    amplification.

    The equation holds if each step from the quasi-stationary distribution fails with probability p.
    The walk then fails in the last of `n_lines` steps with the given probability. The amplification
    is the ratio of the relative errors of p and of the given probability.
    """
    p = last_step_failure_probability
    if n_lines == 1:
        return p, 1.0
    for _ in range(N_FIXED_POINT_ITERATIONS):
        p = min(last_step_failure_probability / (1.0 - p) ** (n_lines - 1), 0.9 / n_lines)
    return p, 1.0 / (1.0 - (n_lines - 1) * p / (1.0 - p))


def _estimate_kappa_2(transitions: Sequence[tuple[np.ndarray, ...]], n_continuous: int) -> float:
    """Return the second eigenvalue of the survival operator, projected on quadratic functions.

    Transitions are states before a step, survival, deviations of the slopes on which the step ends,
    and states after the step. The projection is the extended dynamic mode decomposition (Williams,
    Kevrekidis and Rowley 2015). Polynomials of that deviation have a mean of zero in any state.
    They remove most of the noise from the regression. As the slopes become equal, the eigenvalue
    becomes the leading multiplier of the gait.
    """
    states_before, is_alive, landing_deviations, states_after = (
        np.concatenate(transition_parts) for transition_parts in zip(*transitions, strict=True)
    )
    state_center = states_before.mean(0)
    coordinate_indices = [
        i for i in (*range(n_continuous), states_before.shape[1] - 1) if np.ptp(states_before[:, i])
    ]
    state_scale = states_before[:, coordinate_indices].std(0)
    standardize = lambda states: (states - state_center)[:, coordinate_indices] / state_scale
    _, singular_values, directions = np.linalg.svd(standardize(states_before), full_matrices=False)
    is_resolved = singular_values > MIN_RELATIVE_SINGULAR_VALUE * singular_values[0]
    directions = (
        directions[is_resolved] * np.sqrt(len(states_before)) / singular_values[is_resolved, None]
    )
    first_indices, second_indices = np.triu_indices(len(directions))

    def evaluate_features(states: np.ndarray) -> np.ndarray:
        z = standardize(states) @ directions.T
        return np.concatenate(
            [np.ones((len(z), 1)), z, z[:, first_indices] * z[:, second_indices]], 1
        )

    image_values, basis_values = (
        np.where(is_alive[:, None], evaluate_features(states_after), 0.0),
        evaluate_features(states_before),
    )
    linear_features = basis_values[:, : 1 + len(directions)]
    hermite_polynomials = landing_deviations[:, None], landing_deviations[:, None] ** 2 - 1.0
    regressors = np.concatenate(
        [basis_values, *(linear_features * polynomial for polynomial in hermite_polynomials)], 1
    )
    coefficients = np.linalg.lstsq(regressors, image_values, rcond=None)[0]
    eigenvalue_moduli = np.sort(np.abs(np.linalg.eigvals(coefficients[: basis_values.shape[1]])))
    return float(eigenvalue_moduli[-2])
