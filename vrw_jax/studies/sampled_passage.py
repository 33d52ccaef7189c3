"""First-passage times from sampled walks, with failures made frequent by importance sampling.

Groups of simulated wheels, the walkers, walk over random slopes or heights until the effect of the
start has decayed. A walker that fails is replaced by a copy of another walker of its group (Fleming
and Viot). All walkers then have the quasi-stationary distribution. From there, walks of a few steps
are sampled with ground from a density for which many walks fail in their last step. Likelihood
ratios give the probability of that failure without bias. Groups are independent, so that the spread
between groups gives the error.
"""

import collections
import functools
import itertools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from vrw_jax.base.progress import report_progress
from vrw_jax.base.results import Outcome
from vrw_jax.studies.walker_groups import (
    GaussianMixture,
    StepTransition,
    WalkerGroups,
    fit_failure_density,
)

MAX_BIASED_GROUND_LINES = 12
"""Largest number of lines of the ground whose slopes are drawn with a bias.

The value is chosen because fits in more dimensions need more samples.
"""
MIN_FAILURES_FOR_COUNTING = 0.35
"""Expected number of failures over the lines that affect a state, above which failures are counted
without bias.

The value is chosen because counting and importance sampling then need equally many steps.
"""
MAX_FORGETTING_STEPS = 100
"""Largest number of gait steps after which walks from the gait begin to be sampled.

The value is chosen because gaits with slower decay are almost unstable.
"""
MAX_ROUNDS_FROM_GAIT = 40
"""Largest number of rounds in which all walkers start on the gait.

The value is chosen because more rounds are needed only if most walks fail within three steps.
"""
N_KAPPA_2_STEPS = 4
"""Smallest number of gait steps whose states before and after the step are used to estimate
kappa_2.

If the effect of the start decays slowly, the second half of all steps is used.
"""
MIN_TRANSITIONS_PER_REGRESSOR = 25.0
"""Smallest number of transitions per regressor in a regression on quadratic functions.

The value is chosen because the eigenvalues of a wheel with unilateral contact, which has 250
quadratic regressors, then vary by a few hundredths. With 8 transitions per regressor, many
eigenvalues exceed 1.
"""
MIN_SAMPLING_ROUNDS = 2
"""Smallest number of rounds, each with one walk per walker.

The value is chosen because most wheels then pass the first error test.
"""
N_ROUNDS_SAFETY_FACTOR = 1.2
"""Ratio of the number of rounds before the next error test to the number that is expected to
suffice.

The value is chosen because three of four wheels then pass the next error test.
"""
MIN_ROUND_COUNT_RATIO = 1.25
"""Smallest ratio of the numbers of rounds at two successive error tests.

The value is chosen because later error tests need wider confidence intervals.
"""
MAX_START_EFFECT_PER_TOL = 0.1
"""Largest remaining fraction of the effect of the start, divided by the tolerance."""
MIN_EFFECTIVE_FAILURE_FRACTION = 0.02
"""Smallest accepted ratio of the effective number of failures to the number of failing walks.

The value is chosen because it is a tenth of the usual ratio. A lower ratio means that the fit
misses a part of the failures. Failures are then counted if they are frequent enough.
"""
N_FAILURE_CHECK_STEPS = 12
"""Number of gait steps per walker whose failures are counted to check importance sampling.

The value is chosen because these steps take a sixth of the computing time for a usual wheel.
"""
MIN_FAILURE_CHECK_PROBABILITY = 1e-4
"""Smallest probability at which the number of counted failures is attributed to chance.

The value is chosen because a wrong alarm is then rare among some thousands of wheels.
"""
CONFIDENCE_LEVEL = 0.99
"""Confidence level of the error estimate.

An error test compares the error with the tolerance. The probability that the interval of an error
test misses the mean is a fraction of 1 - `CONFIDENCE_LEVEL`. The fractions of all error tests sum
to 1, so that the level holds although the error decides when sampling ends.
"""
FIRST_ERROR_TEST_FRACTIONS = (0.45, 0.45)
"""Fractions of the miss probability 1 - `CONFIDENCE_LEVEL` for the first two error tests.

Each later error test has half of the remaining fraction. The values are chosen because nearly all
wheels pass one of the first two tests.
"""


N_FIXED_POINT_ITERATIONS = 60
"""Number of fixed-point iterations for the failure probability, chosen because each iteration
reduces the error by a factor of two or more.
"""

MIN_RELATIVE_SINGULAR_VALUE = 0.003
"""Smallest singular value of standardized states that enters the regression, relative to the
largest.

The value is chosen because noise dominates smaller singular values. For example, a landing after
which both feet stick leaves two degrees of freedom.
"""


class SampledPassage(NamedTuple):
    """Results of `sample_passage`: first-passage times, estimated from sampled walks."""

    failure_probability: float  # mean of a step from the quasi-stationary distribution
    relative_error: float  # of the mean; half a confidence interval plus `start_effect`
    start_effect: float  # relative effect of the start of the walks on the mean
    mean_steps_from_gait: float
    mean_step_distance: float  # of a completed step, along the mean slope, m
    step_distance_error: float  # half a confidence interval, m
    kappa_2: float  # NaN if the walkers are too few for an estimate
    quasi_stationary_states: np.ndarray  # as in `stack_states_and_ground`, (n, components)
    fraction_by_outcome: dict[str, float]
    n_sampled_steps: int
    # of the deviations of the ground in walks that may fail in their last step
    walk_density: GaussianMixture


def sample_passage(
    walker_groups: WalkerGroups, spectral_radius: float, relative_tolerance: float, max_steps: int
) -> SampledPassage:
    """Return first-passage times, estimated from walks of groups of walkers on the gait.

    Walks are sampled until the error is within the tolerance. After `max_steps` steps, and a few
    first rounds, no further walks begin.
    Raise an `ExtinctGroupError` if no walker of a group survives a step.

    - `spectral_radius`: spectral radius of the gait.
    """
    count_decay_steps = lambda remaining_start_effect, decay_factor: int(
        np.ceil(np.log(remaining_start_effect) / np.log(np.clip(decay_factor, 0.01, 0.99)))
    )
    leg_period = walker_groups.leg_period
    line_effect = walker_groups.negligible_ground_line_effect
    n_biased_steps = count_decay_steps(line_effect, spectral_radius)
    n_biased_steps = min(n_biased_steps, MAX_BIASED_GROUND_LINES // leg_period)
    max_start_effect = MAX_START_EFFECT_PER_TOL * relative_tolerance
    n_steps = count_decay_steps(max_start_effect, spectral_radius)
    least = walker_groups.min_forgetting_steps
    n_forgetting_steps = int(np.clip(n_steps, least, MAX_FORGETTING_STEPS))
    surviving_fraction, n_completed_steps, step_transitions = _step_until_start_is_forgotten(
        walker_groups, n_forgetting_steps, relative_tolerance
    )
    while True:
        n_forgetting_steps = len(step_transitions)
        late_transitions = step_transitions[-max(N_KAPPA_2_STEPS, n_forgetting_steps // 2) :]
        kappa_1 = float(np.mean([transition.is_walker_alive for transition in late_transitions]))
        kappa_2 = _estimate_kappa_2(
            late_transitions, walker_groups.n_continuous_entries, walker_groups.ground.shape[1]
        )
        # The effect of the start, divided by the survival probability, decays by this factor.
        start_effect_factor = 1.0 if np.isnan(kappa_2) else max(kappa_2 / kappa_1, spectral_radius)
        n_decay_steps = count_decay_steps(max_start_effect, start_effect_factor) + 1
        # The number of steps is at most doubled, because more transitions improve kappa_2.
        n_required_steps = min(
            n_decay_steps - n_biased_steps, MAX_FORGETTING_STEPS, 2 * n_forgetting_steps
        )
        if n_required_steps <= n_forgetting_steps:
            break
        for _ in range(n_required_steps - n_forgetting_steps):
            step_transitions.append(walker_groups.step_and_replace_failures())
            n_completed_steps += surviving_fraction * np.mean(step_transitions[-1].n_stepped)
            surviving_fraction *= np.mean(step_transitions[-1].is_walker_alive)
    walker_groups.weight_by_outcome.clear()
    estimate_probability = functools.partial(
        _estimate_failure_probability,
        walker_groups,
        start_effect_decay=(start_effect_factor, n_forgetting_steps - 1),
        relative_tolerance=relative_tolerance,
        max_steps=max_steps,
    )
    n_effective_lines = count_decay_steps(line_effect, start_effect_factor)
    n_failures_over_lines = n_effective_lines * np.mean(~step_transitions[-1].is_walker_alive)
    is_failure_frequent = n_failures_over_lines > MIN_FAILURES_FOR_COUNTING
    n_lines = leg_period * n_biased_steps
    failure_probability, relative_error, start_effect, walk_density = _weigh_or_count_failures(
        walker_groups, estimate_probability, n_lines, is_failure_frequent, max_steps
    )
    if np.isnan(kappa_2):
        relative_error = np.inf
    mean_distance, distance_error = _estimate_step_distance(walker_groups, late_transitions)
    # Steps after a failure, before all legs have had their turn, are not taken.
    n_missing_steps = leg_period - 1.0 - walker_groups.compute_mean_last_turn()
    failure_probability /= leg_period - failure_probability * n_missing_steps
    mean_steps_from_gait = np.inf
    if failure_probability > 0.0:
        n_later_steps = surviving_fraction * (1.0 / failure_probability - 1.0)
        mean_steps_from_gait = float(n_completed_steps + n_later_steps)
    outcome_weights: Any = collections.Counter()
    for (outcome_code, _), weight in walker_groups.weight_by_outcome.items():
        outcome_weights[outcome_code] += weight
    return SampledPassage(
        failure_probability=failure_probability,
        relative_error=relative_error,
        start_effect=start_effect,
        mean_steps_from_gait=mean_steps_from_gait,
        mean_step_distance=mean_distance,
        step_distance_error=distance_error,
        kappa_2=kappa_2 ** (1.0 / leg_period),
        quasi_stationary_states=walker_groups.stack_states_and_ground(),
        fraction_by_outcome={
            Outcome(outcome_code).name: outcome_weight / outcome_weights.total()
            for outcome_code, outcome_weight in outcome_weights.most_common()
        },
        n_sampled_steps=walker_groups.n_steps,
        walk_density=walk_density,
    )


def _weigh_or_count_failures(
    walker_groups: WalkerGroups,
    estimate_probability: Callable,
    n_ground_lines: int,
    is_failure_frequent: Any,
    max_steps: int,
) -> tuple[float, float, float, GaussianMixture]:
    """Return the result of `_estimate_failure_probability`, and the density of sampled walks.

    Frequent failures are counted, and rare ones are made frequent by importance sampling. If the
    error of importance sampling is unknown, failures are counted too, if enough of them are
    expected.
    """
    density = GaussianMixture.make_isotropic_gaussian(n_ground_lines, 1.0)
    probability, error, start_effect = 0.0, np.inf, 0.0
    if not is_failure_frequent:
        failure_density = fit_failure_density(
            lambda deviations: walker_groups.run_walks(deviations)[:2],
            n_ground_lines,
            walker_groups.random,
            max_walks_per_stage=walker_groups.n_walkers,
        )
        if failure_density is not None:
            density = failure_density
            probability, error, start_effect = estimate_probability(
                _make_weight_sampler(walker_groups, density),
                n_ground_lines // walker_groups.leg_period,
                advance_walkers=walker_groups.advance_without_counting,
            )
            if np.isfinite(error) and _has_missed_failures(
                walker_groups, probability * (1.0 + error)
            ):
                error = np.inf
        n_expected_failures = probability * (max_steps - walker_groups.n_steps)
        is_failure_frequent = (
            not np.isfinite(error) and n_expected_failures > walker_groups.min_effective_failures
        )
    if is_failure_frequent:
        walker_groups.weight_by_outcome.clear()
        probability, error, start_effect = estimate_probability(
            lambda: 1.0 - walker_groups.step_and_replace_failures().is_walker_alive,
            1,
            are_walkers_advanced=True,
        )
    return probability, error, start_effect, density


def _estimate_failure_probability(
    walker_groups: WalkerGroups,
    failure_weight_sampler: Callable[[], np.ndarray],
    n_ground_lines: int,
    *,
    start_effect_decay: tuple[float, int],
    relative_tolerance: float,
    max_steps: int,
    are_walkers_advanced: bool = False,
    advance_walkers: Callable[[], object] = lambda: None,
) -> tuple[float, float, float]:
    """Return the failure probability of a gait step, the relative error of that probability, and
    the part of this error that is the effect of the start.

    A round samples one walk per walker. After the first rounds, and after each further number of
    rounds that is expected to suffice, the error is compared with the tolerance. The error is
    infinite if a few walks dominate the probability. Sampling also ends if the estimate depends on
    the section state at the start by more than the tolerance, and further rounds cannot reduce this
    dependence.

    - `failure_weight_sampler`: function that returns the weight of each walk of a round, which is 0
      unless the walk fails in its last step;
    - `n_ground_lines`: number of lines of the ground in each walk;
    - `start_effect_decay`: factor per step by which the effect of the start decays, and number of
      steps before the walks;
    - `are_walkers_advanced`: whether each round advances the walkers by one step, so that later
      rounds are affected less by the start;
    - `advance_walkers`: function that advances the walkers. It is called before each round that
      follows the first error tests, because rounds from the same starts cannot reduce the part of
      the error that is due to the choice of these starts.
    """
    n_groups = walker_groups.n_groups
    weight_sum_by_group, n_rounds, weight_moments = np.zeros(n_groups), 0, np.zeros(3)
    failure_probability, relative_error = 0.0, np.inf
    start_effect_factor, n_decay_steps = start_effect_decay
    n_decay_steps += n_ground_lines
    start_effect = start_effect_factor**n_decay_steps
    n_error_tests, n_rounds_at_error_test = 0, MIN_SAMPLING_ROUNDS
    while n_rounds == 0 or (
        relative_error > relative_tolerance and walker_groups.n_steps < max_steps
    ):
        while n_rounds < n_rounds_at_error_test and (
            n_rounds < MIN_SAMPLING_ROUNDS or walker_groups.n_steps < max_steps
        ):
            report_progress(f"{walker_groups.n_walkers:,} walks of {walker_groups.n_steps:,} steps")
            if n_error_tests >= len(FIRST_ERROR_TEST_FRACTIONS):
                advance_walkers()
            weights = failure_weight_sampler()
            weight_sum_by_group += weights.reshape(n_groups, -1).mean(1)
            weight_moments += np.sum(weights), np.sum(weights**2), np.sum(weights > 0.0)
            n_rounds += 1
        weight_sum, squared_weight_sum, n_failing_walks = weight_moments
        n_rounds_at_error_test = 2 * n_rounds
        if weight_sum == 0.0:
            continue
        mean_sum = np.mean(weight_sum_by_group)
        failure_probability, error_amplification = _solve_failure_probability(
            float(mean_sum) / n_rounds, n_ground_lines
        )
        n_effective_failures = weight_sum**2 / squared_weight_sum
        if n_effective_failures < (MIN_EFFECTIVE_FAILURE_FRACTION * n_failing_walks):
            return failure_probability, np.inf, start_effect
        if n_effective_failures < walker_groups.min_effective_failures:
            continue
        n_error_tests += 1
        standard_error = (
            error_amplification * np.std(weight_sum_by_group, ddof=1) / np.sqrt(n_groups) / mean_sum
        )
        if are_walkers_advanced:
            start_effects = start_effect_factor ** (n_decay_steps + np.arange(n_rounds))
            start_effect = float(np.mean(start_effects))
        quantile, next_quantile = (
            _compute_student_t_quantile(n, n_groups) for n in (n_error_tests, n_error_tests + 1)
        )
        relative_error = float(quantile * standard_error + start_effect)
        tolerated_sampling_error = relative_tolerance - start_effect
        if tolerated_sampling_error > 0.0:
            error_ratio = next_quantile * standard_error / tolerated_sampling_error
            growth = max(N_ROUNDS_SAFETY_FACTOR * error_ratio**2, MIN_ROUND_COUNT_RATIO)
            n_rounds_at_error_test = int(np.ceil(n_rounds * growth))
        elif not (are_walkers_advanced and start_effect_factor < 1.0):
            break
    return failure_probability, relative_error, start_effect


def _compute_student_t_quantile(error_test_number: int, n_groups: int) -> float:
    """Return the half width of the interval of an error test, in standard errors."""
    from scipy import stats  # This import is slow.

    fractions = FIRST_ERROR_TEST_FRACTIONS
    n_later_tests = error_test_number - len(fractions)
    miss_fraction = (
        (1.0 - sum(fractions)) / 2.0**n_later_tests
        if n_later_tests > 0
        else fractions[error_test_number - 1]
    )
    return float(stats.t.isf(0.5 * (1.0 - CONFIDENCE_LEVEL) * miss_fraction, n_groups - 1))


def _step_until_start_is_forgotten(
    walker_groups: WalkerGroups, n_steps: int, relative_tolerance: float
) -> tuple[float, float, list[StepTransition]]:
    """Return the fraction of walks from the gait that survive, the mean number of steps that they
    complete, and the transitions of the walkers.

    All walkers start on the gait and take `n_steps` steps, or so many turns of all legs. These
    rounds are repeated until the last fraction is accurate. The product of the surviving fractions
    of successive steps has no bias, although survivors replace failed walkers (Del Moral 2004).
    """
    from scipy import stats  # This import is slow.

    max_relative_variance = (
        relative_tolerance / stats.norm.isf(0.5 * (1.0 - CONFIDENCE_LEVEL))
    ) ** 2
    fractions_by_round: list[float] = []
    n_completed_by_round: list[float] = []
    relative_variance_sum = 0.0
    while not fractions_by_round or (
        len(fractions_by_round) < MAX_ROUNDS_FROM_GAIT
        and relative_variance_sum > max_relative_variance * len(fractions_by_round) ** 2
    ):
        walker_groups.restart_at_gait()
        step_transitions = [walker_groups.step_and_replace_failures() for _ in range(n_steps)]
        alive_fractions = np.array(
            [np.mean(transition.is_walker_alive) for transition in step_transitions]
        )
        fractions = np.cumprod([1.0, *alive_fractions])
        mean_completed = [np.mean(transition.n_stepped) for transition in step_transitions]
        fractions_by_round.append(float(fractions[-1]))
        n_completed_by_round.append(float(fractions[:-1] @ mean_completed))
        relative_variance_sum += float(
            np.sum((1.0 - alive_fractions) / alive_fractions) / walker_groups.n_walkers
        )
    return (
        float(np.mean(fractions_by_round)),
        float(np.mean(n_completed_by_round)),
        step_transitions,
    )


def _estimate_step_distance(
    walker_groups: WalkerGroups, step_transitions: Sequence[StepTransition]
) -> tuple[float, float]:
    """Return the mean distance of completed steps along the mean slope, and its error, m."""
    from scipy import stats  # This import is slow.

    n_groups = walker_groups.n_groups
    distance_sums, n_completed = np.zeros((2, n_groups))
    for transition in step_transitions:
        is_alive = transition.is_walker_alive
        distance_sums += transition.step_distances.reshape(n_groups, -1).sum(1)
        n_completed += is_alive.reshape(n_groups, -1).sum(1)
    quantile = stats.t.isf(0.5 * (1.0 - CONFIDENCE_LEVEL), n_groups - 1)
    group_means = distance_sums / n_completed
    return (
        float(np.sum(distance_sums) / np.sum(n_completed)),
        float(quantile * np.std(group_means, ddof=1) / np.sqrt(n_groups)),
    )


def _has_missed_failures(walker_groups: WalkerGroups, max_failure_probability: float) -> bool:
    """Return whether some outcome occurs in more simulated steps than importance sampling predicts.

    Importance sampling may miss an outcome that no large slope causes. For example, a landing may
    release the rear foot, and the wheel then falls back a step later.

    - `max_failure_probability`: upper end of the confidence interval of the failure probability.
    """
    from scipy import stats  # This import is slow.

    importance_weight_by_outcome = walker_groups.weight_by_outcome
    n_failures_by_outcome = walker_groups.advance_without_counting(N_FAILURE_CHECK_STEPS)
    max_failure_count = max_failure_probability * N_FAILURE_CHECK_STEPS * walker_groups.n_walkers
    total_failure_weight = importance_weight_by_outcome.total()
    return any(
        stats.poisson.sf(
            n_failures - 1.0,
            max_failure_count * importance_weight_by_outcome[outcome_code] / total_failure_weight,
        )
        < MIN_FAILURE_CHECK_PROBABILITY
        for outcome_code, n_failures in n_failures_by_outcome.items()
    )


def _make_weight_sampler(
    walker_groups: WalkerGroups, walk_density: GaussianMixture
) -> Callable[[], np.ndarray]:
    """Return a function that runs one walk from every walker and returns the failure weights.

    The slope deviations of each group come from a randomized digital net (Owen 1997), which fills
    the space of slopes more evenly than independent numbers. Each point of the net is uniformly
    distributed, so that estimates have no bias. The nets of different groups are independent.
    """
    from scipy.stats import qmc  # This import is slow.

    random_generator, n_ground_lines = walker_groups.random, walk_density.gaussian_means.shape[1]
    group_nets = [
        qmc.Sobol(1 + n_ground_lines, rng=random_generator) for _ in range(walker_groups.n_groups)
    ]

    def sample_failure_weights() -> np.ndarray:
        # The permutation lets each walker meet all parts of the space of slopes.
        net_points = np.concatenate(
            [
                random_generator.permutation(net.random(walker_groups.n_walkers_per_group))
                for net in group_nets
            ]
        )
        return walker_groups.run_biased_walks(
            walk_density, walk_density.map_uniform_numbers(net_points)
        )

    return sample_failure_weights


def _solve_failure_probability(
    last_step_failure_probability: float, n_biased_ground_lines: int
) -> tuple[float, float]:
    """Return the failure probability p of a gait step, and the amplification of its relative error.

    Each step from the quasi-stationary distribution fails with probability p. A walk of n steps,
    where n is `n_biased_ground_lines`, therefore fails in its last step with probability
    p (1 - p)^(n - 1). This probability is `last_step_failure_probability`. The amplification is the
    relative error of p, divided by the relative error of `last_step_failure_probability`.
    """
    p = last_step_failure_probability
    if n_biased_ground_lines == 1:
        return p, 1.0
    for _ in range(N_FIXED_POINT_ITERATIONS):
        p = min(
            last_step_failure_probability / (1.0 - p) ** (n_biased_ground_lines - 1),
            0.9 / n_biased_ground_lines,
        )
    return p, 1.0 / (1.0 - (n_biased_ground_lines - 1) * p / (1.0 - p))


def _estimate_kappa_2(
    step_transitions: Sequence[tuple[np.ndarray, ...]],
    n_continuous_entries: int,
    n_ground_entries: int = 1,
) -> float:
    """Return kappa_2, the second eigenvalue of the survival operator's projection on quadratic
    functions.

    The projection is the extended dynamic mode decomposition (Williams, Kevrekidis and Rowley
    2015). Hermite polynomials of the slope deviations have a mean of zero in any state. As
    regressors, they remove most of the noise. In the limit of equal slopes, the eigenvalue becomes
    the leading multiplier of the gait. With unilateral contact, sampled states have many components
    and outliers. If transitions are too few for a quadratic projection, or if its second eigenvalue
    exceeds kappa_1, a linear projection replaces it. The result is NaN if the second eigenvalue of
    the linear projection exceeds kappa_1 too, because no second eigenvalue exceeds the leading one.

    - `step_transitions`: `StepTransition` of each gait step;
    - `n_continuous_entries`: number of continuous components of a section state;
    - `n_ground_entries`: number of components of the ground, which are the last ones.
    """
    states_before_step, is_walker_alive, landing_deviations, states_after_step = (
        np.concatenate(arrays_by_step)
        for arrays_by_step in itertools.islice(zip(*step_transitions, strict=True), 4)
    )
    varying_components = [
        i
        for i in (*range(n_continuous_entries), *range(-n_ground_entries, 0))
        if np.ptp(states_before_step[:, i])
    ]
    mean_state = states_before_step.mean(0)
    standard_deviations = states_before_step[:, varying_components].std(0)
    standardize_states = lambda states: (
        (states - mean_state)[:, varying_components] / standard_deviations
    )
    _, singular_values, principal_directions = np.linalg.svd(
        standardize_states(states_before_step), full_matrices=False
    )
    is_direction_resolved = singular_values > MIN_RELATIVE_SINGULAR_VALUE * singular_values[0]
    principal_directions = (
        principal_directions[is_direction_resolved]
        * np.sqrt(len(states_before_step))
        / singular_values[is_direction_resolved, None]
    )
    first_coordinate_indices, second_coordinate_indices = np.triu_indices(len(principal_directions))
    columns = landing_deviations.reshape(len(landing_deviations), -1, 1).swapaxes(0, 1)
    landing_hermite_polynomials = (*columns, *(columns**2 - 1.0))

    def project_second_eigenvalue(has_quadratic_features: bool) -> float:
        """Return the modulus of the second eigenvalue, projected on polynomials of the state.

        The result is NaN if there are too few transitions, or if it exceeds kappa_1.
        """

        def evaluate_state_features(states: np.ndarray) -> np.ndarray:
            z = standardize_states(states) @ principal_directions.T
            features = [np.ones((len(z), 1)), z]
            if has_quadratic_features:
                features.append(z[:, first_coordinate_indices] * z[:, second_coordinate_indices])
            return np.concatenate(features, 1)

        state_features_before_step = evaluate_state_features(states_before_step)
        linear_state_features = state_features_before_step[:, : 1 + len(principal_directions)]
        regressor_matrix = np.concatenate(
            [
                state_features_before_step,
                *(linear_state_features * h for h in landing_hermite_polynomials),
            ],
            1,
        )
        if has_quadratic_features and len(regressor_matrix) < (
            MIN_TRANSITIONS_PER_REGRESSOR * regressor_matrix.shape[1]
        ):
            return np.nan
        state_features_after_step = np.where(
            is_walker_alive[:, None], evaluate_state_features(states_after_step), 0.0
        )
        regression_coefficients = np.linalg.lstsq(
            regressor_matrix.T @ regressor_matrix,
            regressor_matrix.T @ state_features_after_step,
            rcond=None,
        )[0]
        projected_eigenvalues = np.linalg.eigvals(
            regression_coefficients[: state_features_before_step.shape[1]]
        )
        second_modulus = float(np.sort(np.abs(projected_eigenvalues))[-2])
        return second_modulus if second_modulus < np.mean(is_walker_alive) else np.nan

    kappa_2 = project_second_eigenvalue(has_quadratic_features=True)
    return project_second_eigenvalue(has_quadratic_features=False) if np.isnan(kappa_2) else kappa_2
