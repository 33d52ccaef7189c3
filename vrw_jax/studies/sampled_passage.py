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
from dataclasses import dataclass
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from vrw_jax.base.options import StepOptions, find_tree_parameter, replace_tree_parameter
from vrw_jax.base.outcomes import Outcome
from vrw_jax.base.progress import report_progress
from vrw_jax.lanes.batching import replace_rows
from vrw_jax.models.step_batch import step_batch
from vrw_jax.models.walk_batch import StepBatchResult
from vrw_jax.studies.failure_density import GaussianMixture, fit_failure_density

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


class ExtinctGroupError(ValueError):
    """Error that is raised if all walkers of a group fail in the same step."""


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


class StepTransition(NamedTuple):
    """States of all walkers before and after the steps in which all legs have their turn.

    The states are those of `stack_states_and_ground`.
    """

    states_before_step: np.ndarray
    is_walker_alive: np.ndarray
    ground_deviations: np.ndarray  # of the slopes or heights on which the steps end
    states_after_step: np.ndarray
    step_distances: np.ndarray  # mean distance of each step along the mean slope, m
    n_stepped: np.ndarray  # number of completed steps


@dataclass
class WalkerGroups:
    """Groups of walkers (simulated wheels) on random slopes or heights, simulated as one batch.

    By the Markov property, the section state and the ground of a walker determine the distribution
    of later states. The ground is the slope of its line, or the heights of the two last footholds.
    For a walker of the user, it is the height of the last one.
    At first, the state of every walker is the section state of the gait. The number of walkers per
    group is rounded up to a power of two, because a digital net has such a number of points.
    """

    params: Any
    gait_state: np.ndarray
    ground_sd: float  # of slopes, rad, or of heights, m
    model: Any
    step_options: StepOptions
    n_walkers: int
    random: np.random.Generator
    n_groups: int = 32
    """Number of independent groups of walkers.

    The value is chosen because the quantile for 99 % of Student's distribution is then within 7 %
    of that of the normal distribution.
    """
    negligible_ground_line_effect: float = 0.01
    """Relative effect of a line's slope below which the slope is drawn without bias.

    A line joins two footholds. The effect is that on a later state, divided by that on the next
    state. The result has no bias for any value. The value is chosen because likelihood ratios are
    then similar.
    """
    min_forgetting_steps: int = 6
    """Smallest number of gait steps after which the effect of the start is considered to have
    decayed.
    """
    min_effective_failures: float = 100.0
    """Smallest effective number of sampled failures for which an error is estimated.

    The value is chosen because a few likelihood ratios dominate smaller samples. The spread of
    these ratios is then no estimate of the error.
    """
    sd_name: str = "slope_sd"  # or "height_sd"

    @property
    def has_heights(self) -> bool:
        """Return whether heights of footholds are random, instead of slopes."""
        return self.sd_name == "height_sd"

    @property
    def leg_period(self) -> int:
        """Return the number of steps after which the legs are in the same roles again.

        So many steps are one step of the survival operator.
        """
        return self.model.leg_period

    @property
    def n_continuous_entries(self) -> int:
        """Return the number of components of a section state that are no codes."""
        if not self.model.is_wheel:
            return len(self.gait_state)
        return int(self.model.count_continuous_section_entries(self.params))

    def __post_init__(self) -> None:
        self.n_walkers_per_group = 1 << (-(-self.n_walkers // self.n_groups) - 1).bit_length()
        self.n_walkers = self.n_groups * self.n_walkers_per_group
        self.n_steps = 0
        # total weight of walks that failed, by outcome and number of legs that had their turn
        self.weight_by_outcome: Any = collections.Counter()
        self.restart_at_gait()

    def run_walks(
        self, ground_deviations: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, StepBatchResult]:
        """Return whether walks fail in their last step, whether they fail, and their results.

        The walks begin at the current states of the walkers. Walk i begins at walker i modulo the
        number of walkers.

        - `ground_deviations`: standardized deviations of the slopes or heights on which the wheels
          land, shape (walks, lines).
        """
        walker_indices = np.arange(len(ground_deviations)) % self.n_walkers
        walk_results = self.run_walks_with_changes(
            self.params, self.states[walker_indices], self.ground[walker_indices], ground_deviations
        )
        has_failed = walk_results.outcome != Outcome.STEPPED
        self.n_steps += int(np.sum(walk_results.n_stepped) + np.sum(has_failed))
        is_in_last_step = walk_results.n_stepped >= ground_deviations.shape[1] - self.leg_period
        return has_failed & is_in_last_step, has_failed, walk_results

    def run_walks_with_changes(
        self,
        params: Any,
        section_states: np.ndarray,
        start_ground: np.ndarray,
        ground_deviations: np.ndarray,
    ) -> StepBatchResult:
        """Return the results of walks of the wheel `params` from given states on given ground."""
        ground = np.concatenate([start_ground, self.compute_ground(params, ground_deviations)], 1)
        heights = ground if self.has_heights else None
        if heights is None and not self.model.is_wheel:
            params = replace_tree_parameter(params, self.model.ground["slope"], ground[:, 1:])
        elif heights is None:
            params = eqx.tree_at(lambda wheel_on_lines: wheel_on_lines.slope, params, ground)
        return step_batch(
            params,
            section_states,
            ground_deviations.shape[1],
            model=self.model,
            options=self.step_options,
            heights=heights,
        )

    def compute_ground(self, params: Any, ground_deviations: np.ndarray) -> np.ndarray:
        """Return slopes (rad) or heights (m) for their standardized deviations."""
        mean = 0.0
        if not self.has_heights:
            name = "slope" if self.model.is_wheel else self.model.ground["slope"]
            mean = float(jax.tree.leaves(params)[find_tree_parameter(params, name)])
        return mean + self.ground_sd * ground_deviations

    def run_biased_walks(
        self, walk_density: GaussianMixture, slope_deviations: np.ndarray
    ) -> np.ndarray:
        """Return the failure weights of one walk from every walker, shape (walkers,).

        The weight of a walk is the likelihood ratio if the walk fails in its last step, and 0
        otherwise. The mean weight is the probability of a failure in the last step.

        - `walk_density`: density from which the slope deviations are drawn;
        - `slope_deviations`: standardized deviations of the slopes, shape (walkers, lines).
        """
        has_failed_in_last_step, _, walk_results = self.run_walks(slope_deviations)
        nominal_density = GaussianMixture.make_isotropic_gaussian(slope_deviations.shape[1], 1.0)
        likelihood_ratios = np.exp(
            nominal_density.compute_log_density(slope_deviations)
            - walk_density.compute_log_density(slope_deviations)
        )
        failure_importance_weights = np.where(has_failed_in_last_step, likelihood_ratios, 0.0)
        self.add_failure_weights(walk_results, failure_importance_weights)
        return failure_importance_weights

    def add_failure_weights(self, walk_results: StepBatchResult, walk_weights: np.ndarray) -> None:
        """Add the weights of failed walks to `weight_by_outcome`."""
        turns = walk_results.n_stepped % self.leg_period
        for turn in range(self.leg_period):
            weights = np.where(turns == turn, walk_weights, 0.0)
            for outcome_code in np.unique(walk_results.outcome[weights > 0.0]):
                outcome_weight = float(np.sum(weights[walk_results.outcome == outcome_code]))
                self.weight_by_outcome[int(outcome_code), turn] += outcome_weight

    def compute_mean_last_turn(self) -> float:
        """Return the mean number of steps without failure since the legs began their turns."""
        total = self.weight_by_outcome.total()
        turns = (turn * weight for (_, turn), weight in self.weight_by_outcome.items())
        return sum(turns) / total if total else 0.0

    def restart_at_gait(self) -> None:
        """Reset all walkers to the section state of the gait, on a line of the mean slope, or from
        the mean line to a foothold of random height.
        """
        self.states = np.tile(self.gait_state, (self.n_walkers, 1))
        start_deviations = np.zeros(
            (self.n_walkers, 1 + (self.has_heights and self.model.is_wheel))
        )
        if self.has_heights:
            start_deviations[:, -1] = self.random.standard_normal(self.n_walkers)
        self.ground = self.compute_ground(self.params, start_deviations)

    def stack_states_and_ground(self) -> np.ndarray:
        """Return section states with the ground as last components, shape (walkers, components)."""
        return np.concatenate([self.states, self.ground], 1)

    def compute_step_distances(self, states_after_step: np.ndarray) -> np.ndarray:
        """Return the distance of each step along the mean slope, m; NaN for a walker of the user.

        - `states_after_step`: as in `StepTransition`, shape (steps, components).
        """
        if not self.model.is_wheel:
            return np.full(len(states_after_step), np.nan)
        foot_distances = np.asarray(
            self.model.compute_foot_distance(
                self.params, jnp.asarray(states_after_step[:, : self.states.shape[1]].T)
            )
        )
        if self.has_heights:
            rises = states_after_step[:, -1] - states_after_step[:, -2]
            return np.sqrt(foot_distances**2 - rises**2)
        return foot_distances * np.cos(states_after_step[:, -1] - float(self.params.slope))

    def step_and_replace_failures(self) -> StepTransition:
        """Simulate one gait step of every walker, and replace walkers that fail by copies of
        survivors.

        Raise `ExtinctGroupError` if no walker of a group survived.
        """
        states_before_step = self.stack_states_and_ground()
        ground_deviations = self.random.standard_normal((self.n_walkers, self.leg_period))
        _, has_failed, walk_results = self.run_walks(ground_deviations)
        self.add_failure_weights(walk_results, has_failed.astype(float))
        step_distances = self.measure_step_distances(
            ground_deviations, walk_results.section_state, ~has_failed
        )
        source_indices = np.arange(self.n_walkers).reshape(self.n_groups, -1)
        for indices_of_group, has_walk_failed in zip(
            source_indices, has_failed.reshape(source_indices.shape), strict=True
        ):
            if np.all(has_walk_failed):
                raise ExtinctGroupError
            indices_of_group[has_walk_failed] = self.random.choice(
                indices_of_group[~has_walk_failed], np.sum(has_walk_failed)
            )
        self.states = walk_results.section_state[source_indices.ravel()]
        ground = np.concatenate(
            [self.ground, self.compute_ground(self.params, ground_deviations)], 1
        )
        self.ground = ground[source_indices.ravel(), self.leg_period :]
        return StepTransition(
            states_before_step,
            ~has_failed,
            ground_deviations,
            self.stack_states_and_ground(),
            step_distances,
            walk_results.n_stepped,
        )

    def measure_step_distances(
        self, ground_deviations: np.ndarray, end_states: np.ndarray, is_alive: np.ndarray
    ) -> np.ndarray:
        """Return the mean distance of the steps of each walker, 0 for those that fail, m."""
        distances = np.zeros(len(is_alive))
        for k in range(1, self.leg_period + 1):
            # JAX compiles for each number of walkers, so that those that failed are included.
            states, deviations = end_states, ground_deviations[:, :k]
            if k < self.leg_period:
                walks = self.run_walks_with_changes(
                    self.params, *(x[is_alive] for x in (self.states, self.ground, deviations))
                )
                states = replace_rows(end_states, is_alive, walks.section_state)
            ground = np.concatenate([self.ground, self.compute_ground(self.params, deviations)], 1)
            with np.errstate(invalid="ignore"):
                walked = self.compute_step_distances(np.concatenate([states, ground], 1))
            distances += np.where(is_alive, walked, 0.0)
        return distances / self.leg_period

    def advance_without_counting(self, n_steps: int = 1) -> collections.Counter:
        """Advance all walkers by `n_steps` gait steps, and return their failures by outcome.

        The failures are not added to `weight_by_outcome`.
        """
        weight_by_outcome, self.weight_by_outcome = self.weight_by_outcome, collections.Counter()
        for _ in range(n_steps):
            self.step_and_replace_failures()
        n_failures, self.weight_by_outcome = self.weight_by_outcome, weight_by_outcome
        return n_failures


def sample_passage(
    walker_groups: WalkerGroups,
    spectral_radius: float,
    relative_tolerance: float,
    max_steps: int,
) -> SampledPassage:
    """Return first-passage times, estimated from walks of groups of walkers.

    Walks are sampled until the error is within the tolerance.

    Args:
        walker_groups: groups of walkers on the gait.
        spectral_radius: spectral radius of the gait.
        relative_tolerance: relative error at which the sampling ends.
        max_steps: number of gait steps after which no further walks begin.

    Raises:
        ExtinctGroupError: if no walker of a group survives a step.
    """
    count_decay_steps = lambda remaining_start_effect, decay_factor: int(
        np.ceil(np.log(remaining_start_effect) / np.log(np.clip(decay_factor, 0.01, 0.99)))
    )
    leg_period = walker_groups.leg_period
    n_biased_steps = min(
        count_decay_steps(walker_groups.negligible_ground_line_effect, spectral_radius),
        MAX_BIASED_GROUND_LINES // leg_period,
    )
    n_biased_ground_lines = leg_period * n_biased_steps
    max_start_effect = MAX_START_EFFECT_PER_TOL * relative_tolerance
    n_forgetting_steps = int(
        np.clip(
            count_decay_steps(max_start_effect, spectral_radius),
            walker_groups.min_forgetting_steps,
            MAX_FORGETTING_STEPS,
        )
    )
    surviving_fraction, n_completed_steps, step_transitions = _step_until_start_is_forgotten(
        walker_groups, n_forgetting_steps, relative_tolerance
    )
    while True:
        n_forgetting_steps = len(step_transitions)
        late_transitions = step_transitions[-max(N_KAPPA_2_STEPS, n_forgetting_steps // 2) :]
        kappa_1 = float(np.mean([transition.is_walker_alive for transition in late_transitions]))
        kappa_2 = _estimate_kappa_2(
            late_transitions,
            walker_groups.n_continuous_entries,
            walker_groups.ground.shape[1],
        )
        # The effect of the start, divided by the survival probability, decays by this factor.
        start_effect_factor = 1.0 if np.isnan(kappa_2) else max(kappa_2 / kappa_1, spectral_radius)
        n_decay_steps = count_decay_steps(max_start_effect, start_effect_factor) + 1
        # The number of steps is at most doubled, because more transitions improve kappa_2.
        n_required_steps = min(
            n_decay_steps - n_biased_steps,
            MAX_FORGETTING_STEPS,
            2 * n_forgetting_steps,
        )
        if n_required_steps <= n_forgetting_steps:
            break
        for _ in range(n_required_steps - n_forgetting_steps):
            step_transitions.append(walker_groups.step_and_replace_failures())
            n_completed_steps += surviving_fraction * np.mean(step_transitions[-1].n_stepped)
            surviving_fraction *= np.mean(step_transitions[-1].is_walker_alive)
    walker_groups.weight_by_outcome.clear()
    walk_density = GaussianMixture.make_isotropic_gaussian(n_biased_ground_lines, 1.0)
    estimate_probability = functools.partial(
        _estimate_failure_probability,
        walker_groups,
        start_effect_decay=(start_effect_factor, n_forgetting_steps - 1),
        relative_tolerance=relative_tolerance,
        max_steps=max_steps,
    )
    count_failures = lambda: (~walker_groups.step_and_replace_failures().is_walker_alive).astype(
        float
    )
    failure_probability, relative_error, start_effect = 0.0, np.inf, 0.0
    n_effective_lines = count_decay_steps(
        walker_groups.negligible_ground_line_effect, start_effect_factor
    )
    n_failures_over_lines = n_effective_lines * np.mean(~step_transitions[-1].is_walker_alive)
    are_failures_counted = n_failures_over_lines > MIN_FAILURES_FOR_COUNTING
    if not are_failures_counted:
        failure_density = fit_failure_density(
            lambda slope_deviations: walker_groups.run_walks(slope_deviations)[:2],
            n_biased_ground_lines,
            walker_groups.random,
            max_walks_per_stage=walker_groups.n_walkers,
        )
        if failure_density is not None:
            walk_density = failure_density
            failure_probability, relative_error, start_effect = estimate_probability(
                _make_weight_sampler(walker_groups, walk_density),
                n_biased_steps,
                advance_walkers=walker_groups.advance_without_counting,
            )
            if np.isfinite(relative_error) and _has_missed_failures(
                walker_groups, failure_probability * (1.0 + relative_error)
            ):
                relative_error = np.inf
        n_expected_failures = failure_probability * (max_steps - walker_groups.n_steps)
        are_failures_counted = (
            not np.isfinite(relative_error)
            and n_expected_failures > walker_groups.min_effective_failures
        )
    if are_failures_counted:
        walker_groups.weight_by_outcome.clear()
        failure_probability, relative_error, start_effect = estimate_probability(
            count_failures, 1, are_walkers_advanced=True
        )
    if np.isnan(kappa_2):
        relative_error = np.inf
    mean_step_distance, step_distance_error = _estimate_step_distance(
        walker_groups, late_transitions
    )
    # Steps after a failure, before all legs have had their turn, are not taken.
    n_missing_steps = leg_period - 1.0 - walker_groups.compute_mean_last_turn()
    failure_probability /= leg_period - failure_probability * n_missing_steps
    mean_steps_from_gait = np.inf
    if failure_probability > 0.0:
        mean_steps_from_gait = float(
            n_completed_steps + surviving_fraction * (1.0 / failure_probability - 1.0)
        )
    outcome_weights: Any = collections.Counter()
    for (outcome_code, _), weight in walker_groups.weight_by_outcome.items():
        outcome_weights[outcome_code] += weight
    return SampledPassage(
        failure_probability=failure_probability,
        relative_error=relative_error,
        start_effect=start_effect,
        mean_steps_from_gait=mean_steps_from_gait,
        mean_step_distance=mean_step_distance,
        step_distance_error=step_distance_error,
        kappa_2=kappa_2 ** (1.0 / leg_period),
        quasi_stationary_states=walker_groups.stack_states_and_ground(),
        fraction_by_outcome={
            Outcome(outcome_code).name: outcome_weight / outcome_weights.total()
            for outcome_code, outcome_weight in outcome_weights.most_common()
        },
        n_sampled_steps=walker_groups.n_steps,
        walk_density=walk_density,
    )


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
    from scipy import stats  # This import is slow.

    first_fractions = FIRST_ERROR_TEST_FRACTIONS

    def compute_student_t_quantile(error_test_number: int) -> float:
        n_later_tests = error_test_number - len(first_fractions)
        miss_fraction = (
            (1.0 - sum(first_fractions)) / 2.0**n_later_tests
            if n_later_tests > 0
            else first_fractions[error_test_number - 1]
        )
        miss_probability = (1.0 - CONFIDENCE_LEVEL) * miss_fraction
        return float(stats.t.isf(0.5 * miss_probability, walker_groups.n_groups - 1))

    weight_sum_by_group, n_sampling_rounds = np.zeros(walker_groups.n_groups), 0
    weight_moments = np.zeros(3)
    failure_probability, relative_error = 0.0, np.inf
    start_effect_factor, n_steps_before_walks = start_effect_decay
    start_effect = start_effect_factor ** (n_steps_before_walks + n_ground_lines)
    n_error_tests, n_rounds_at_error_test = 0, MIN_SAMPLING_ROUNDS
    while n_sampling_rounds == 0 or (
        relative_error > relative_tolerance and walker_groups.n_steps < max_steps
    ):
        while n_sampling_rounds < n_rounds_at_error_test and (
            n_sampling_rounds < MIN_SAMPLING_ROUNDS or walker_groups.n_steps < max_steps
        ):
            report_progress(f"{walker_groups.n_walkers:,} walks of {walker_groups.n_steps:,} steps")
            if n_error_tests >= len(first_fractions):
                advance_walkers()
            walk_weights = failure_weight_sampler()
            weight_sum_by_group += walk_weights.reshape(walker_groups.n_groups, -1).mean(1)
            weight_moments += (
                np.sum(walk_weights),
                np.sum(walk_weights**2),
                np.sum(walk_weights > 0.0),
            )
            n_sampling_rounds += 1
        failure_weight_sum, squared_weight_sum, n_failing_walks = weight_moments
        n_rounds_at_error_test = 2 * n_sampling_rounds
        if failure_weight_sum == 0.0:
            continue
        last_step_failure_probability = float(np.mean(weight_sum_by_group)) / n_sampling_rounds
        failure_probability, error_amplification = _solve_failure_probability(
            last_step_failure_probability, n_ground_lines
        )
        n_effective_failures = failure_weight_sum**2 / squared_weight_sum
        if n_effective_failures < (MIN_EFFECTIVE_FAILURE_FRACTION * n_failing_walks):
            return failure_probability, np.inf, start_effect
        if n_effective_failures < walker_groups.min_effective_failures:
            continue
        n_error_tests += 1
        relative_standard_error = (
            error_amplification
            * np.std(weight_sum_by_group, ddof=1)
            / np.sqrt(walker_groups.n_groups)
            / np.mean(weight_sum_by_group)
        )
        if are_walkers_advanced:
            start_effect = float(
                np.mean(
                    start_effect_factor
                    ** (n_steps_before_walks + n_ground_lines + np.arange(n_sampling_rounds))
                )
            )
        relative_error = float(
            compute_student_t_quantile(n_error_tests) * relative_standard_error + start_effect
        )
        tolerated_sampling_error = relative_tolerance - start_effect
        can_start_effect_decay = are_walkers_advanced and start_effect_factor < 1.0
        if tolerated_sampling_error <= 0.0 and not can_start_effect_decay:
            break
        if tolerated_sampling_error > 0.0:
            sampling_error_ratio = (
                compute_student_t_quantile(n_error_tests + 1)
                * relative_standard_error
                / tolerated_sampling_error
            )
            n_rounds_at_error_test = int(
                np.ceil(
                    n_sampling_rounds
                    * max(
                        N_ROUNDS_SAFETY_FACTOR * sampling_error_ratio**2,
                        MIN_ROUND_COUNT_RATIO,
                    )
                )
            )
    return failure_probability, relative_error, start_effect


def _step_until_start_is_forgotten(
    walker_groups: WalkerGroups,
    n_steps: int,
    relative_tolerance: float,
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
