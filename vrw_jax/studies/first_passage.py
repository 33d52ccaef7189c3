"""Mean number of gait steps until a wheel fails on uneven ground (first-passage time)."""

import functools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, Float, Int

from vrw_jax.base.checks import (
    check_int,
    check_positive,
    has_traced_leaf,
    require_untraced_arguments,
)
from vrw_jax.base.elementwise import Scalar
from vrw_jax.base.options import StepOptions
from vrw_jax.base.progress import announce_wait
from vrw_jax.base.results import (
    AbstractPrintable,
    LabelAndText,
    NoGaitError,
    Outcome,
    StatusCode,
    describe_step_ending,
    format_outcome_counts,
)
from vrw_jax.base.walker import AbstractWalker, check_one_walker, is_own_walker
from vrw_jax.gaits.gait_search import limit_cycle, resolve_model
from vrw_jax.lanes.autodiff import make_zero_tangent
from vrw_jax.models.stepping import (
    ModelLike,
    convert_model_argument,
    convert_step_options,
    require_single_wheel,
)
from vrw_jax.studies.rigid_passage import (
    RigidPassage,
    solve_passage_by_interpolation,
    solve_passage_on_slopes,
)
from vrw_jax.studies.sampled_passage import sample_passage
from vrw_jax.studies.walker_groups import ExtinctGroupError, GaussianMixture, WalkerGroups
from vrw_jax.wheel.params import (
    PARAMETER_DOMAINS,
    PARAMETER_NAMES,
    WheelParams,
    compute_wheel_units,
)

# Relative change of a parameter in a difference quotient of failure radii. The value is chosen
# because the resulting changes of failure radii are below `BRACKET_HALF_WIDTH`.
RELATIVE_PARAMETER_STEP = 3e-4
# Half the width of the interval that brackets the failure radius for a changed parameter. The unit
# is the standard deviation of a slope.
BRACKET_HALF_WIDTH = 0.2
# Number of bisections for each failure radius at the original parameters.
N_RADIUS_BISECTIONS = 22
# Number of bisections for each failure radius at a changed parameter. The value is chosen because
# the error of the radius is then a hundredth of a typical change.
N_CHANGED_WHEEL_BISECTIONS = 14


def differentiate_log_mean_steps(
    walker_groups: WalkerGroups, walk_density: GaussianMixture, parameter_names: tuple[str, ...]
) -> dict[str, float]:
    """Return the derivatives of the logarithm of the mean number of gait steps, by parameter name.

    The name `walker_groups.sd_name` means the standard deviation of the ground. A derivative is NaN
    if a wheel with a slightly changed parameter has no gait. The result neglects the influence of
    failures on the quasi-stationary distribution. The neglected terms have the relative size
    1/`mean_steps`.

    - `walk_density`: density from which the slope deviations of walks are drawn.
    """
    from scipy import stats  # This import is slow.

    params, ground_sd = walker_groups.params, walker_groups.ground_sd
    states, start_ground, directions, norms = _draw_failing_walks(walker_groups, walk_density)

    def test_failures(
        radii: np.ndarray, params: Any, states: np.ndarray, ground: np.ndarray
    ) -> np.ndarray:
        """Return whether each walk fails if its slope deviations have the norms `radii`."""
        deviations = radii[:, None] * directions
        walk_results = walker_groups.run_walks_with_changes(params, states, ground, deviations)
        return walk_results.outcome != Outcome.STEPPED

    def bisect_failure_radii(
        lower: np.ndarray, upper: np.ndarray, n_bisections: int, *start: Any
    ) -> np.ndarray:
        """Return the failure radius of each walk, shape (walks,), by bisection.

        - `lower`, `upper`: radii at which the walks do not fail, and fail;
        - `start`: wheel, states and ground at the starts.
        """
        for _ in range(n_bisections):
            middle = 0.5 * (lower + upper)
            has_failed = test_failures(middle, *start)
            lower, upper = np.where(has_failed, lower, middle), np.where(has_failed, middle, upper)
        return 0.5 * (lower + upper)

    zero_radii, start = np.zeros_like(norms), (params, states, start_ground)
    survives_on_mean_slopes = ~test_failures(zero_radii, *start)
    failure_radii = bisect_failure_radii(zero_radii, norms, N_RADIUS_BISECTIONS, *start)
    radius_distribution = stats.chi(directions.shape[1])
    hazard_rates = np.exp(
        radius_distribution.logpdf(failure_radii) - radius_distribution.logsf(failure_radii)
    )
    hazard_rates = np.where(survives_on_mean_slopes, hazard_rates, 0.0)

    def differentiate_failure_radii(parameter_name: str) -> np.ndarray:
        """Return the derivatives of all failure radii with respect to one parameter, shape
        (walks,).
        """
        if parameter_name == walker_groups.sd_name:
            return -failure_radii / ground_sd
        parameter_value = float(getattr(params, parameter_name))
        domain = PARAMETER_DOMAINS[parameter_name]
        unit = compute_wheel_units(params.symbols()).compute_unit_in_si(domain.unit)
        change_size = RELATIVE_PARAMETER_STEP * (abs(parameter_value) or float(unit))
        changes = np.array([change_size, -change_size])
        if not domain.contains_parameter_value(parameter_value - change_size):
            changes += 2.0 * change_size
        changed_failure_radii = []
        for parameter_change in changes:
            _, changed_params = walker_groups.model.with_parameter(
                params,
                parameter_name,
                jnp.asarray(float(parameter_value + parameter_change), params.damping.dtype),
            )
            changed_cycle: Any = limit_cycle(changed_params, model=walker_groups.model)
            if int(changed_cycle.outcome) != Outcome.STEPPED:
                return np.full_like(failure_radii, np.nan)
            changes_ground = parameter_name == "slope" and not walker_groups.has_heights
            changed_failure_radii.append(
                bisect_failure_radii(
                    np.maximum(failure_radii - BRACKET_HALF_WIDTH, 0.0),
                    failure_radii + BRACKET_HALF_WIDTH,
                    N_CHANGED_WHEEL_BISECTIONS,
                    changed_params,
                    states + np.asarray(changed_cycle.section_state) - walker_groups.gait_state,
                    start_ground + (parameter_change if changes_ground else 0.0),
                )
            )
        return (changed_failure_radii[0] - changed_failure_radii[1]) / (changes[0] - changes[1])

    n_walks = np.sum(survives_on_mean_slopes)
    return {
        name: float(np.sum(hazard_rates * differentiate_failure_radii(name)) / n_walks)
        for name in parameter_names
    }


# Number of failing walks whose failure radii are computed. The value is chosen because the error of
# a derivative is then a few percent.
N_FAILING_WALKS = 1024
# Largest number of rounds in which failing walks are drawn.
MAX_SAMPLING_ROUNDS = 20


def _draw_failing_walks(
    walker_groups: WalkerGroups, walk_density: GaussianMixture
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return failing walks with equal weights, resampled from many walks.

    The result is (section states at the starts, ground at the starts as in `WalkerGroups`, unit
    vectors of slope deviations, their norms). The starts have the quasi-stationary distribution,
    and the walks fail in their last step. The slopes of the many walks are drawn from
    `walk_density`. Raise ValueError if no walk fails in its last step.
    """
    n_effective_walks, n_walkers = 0.0, walker_groups.n_walkers
    deviations: list[np.ndarray] = []
    weights_by_round: list[np.ndarray] = []
    while n_effective_walks < N_FAILING_WALKS and len(weights_by_round) < MAX_SAMPLING_ROUNDS:
        deviations.append(walk_density.draw_samples(n_walkers, walker_groups.random))
        weights_by_round.append(walker_groups.run_biased_walks(walk_density, deviations[-1]))
        weights = np.concatenate(weights_by_round)
        if np.any(weights):
            n_effective_walks = np.sum(weights) ** 2 / np.sum(weights**2)
    if n_effective_walks == 0.0:
        sd_text = f"{walker_groups.sd_name} {walker_groups.ground_sd:g}"
        raise ValueError(
            f"no sampled walk failed with {sd_text} {'m' if walker_groups.has_heights else 'rad'}, "
            "so that the mean number of steps has no derivative: give a larger "
            f"{walker_groups.sd_name} or n_walkers."
        )
    walks = walker_groups.random.choice(len(weights), N_FAILING_WALKS, p=weights / np.sum(weights))
    failing = np.concatenate(deviations)[walks]
    norms, walkers = np.linalg.norm(failing, axis=1), walks % n_walkers
    states, ground = walker_groups.states[walkers], walker_groups.ground[walkers]
    return states, ground, failing / norms[:, None], norms


MAX_QUADRATURE_NODES = 1600
"""Largest number of quadrature nodes to which the number is doubled.

The value is chosen because quadrature then takes seconds.
"""

SD_UNITS = {"slope_sd": "rad", "height_sd": "m"}
"""Units of the standard deviations of the ground, by the name of the argument."""

SAMPLED_STEP_TOLERANCE = 1e-5
"""Relative and absolute tolerance of sampled gait steps without unilateral contact.

The value is chosen because the error of a section state is then only a ten-thousandth of its
standard deviation over random slopes. With unilateral contact and infinite friction, one step in a
thousand would end with a spurious Painlevé paradox even at tolerances of 1e-6.
"""

SAMPLED_TRACING_REMEDY = "take jax.grad of a function that is not compiled"
"""Remedy in the error message for a sampled computation inside `jit` or `vmap`."""


class PassageStatus(StatusCode):
    """Status of the computation of first-passage times: whether its error is small enough."""

    CONVERGED = 0, "The error estimate is within the tolerance."
    TOLERANCE_NOT_MET = (
        1,
        "The error estimate exceeds the tolerance: give a larger tol, max_steps (sampled walks) or "
        "n_nodes (quadrature).",
    )
    NO_FAILURE = (
        2,
        "No walk failed, however uneven its ground was made: the mean has no estimate. Give more "
        "uneven ground, or a larger n_walkers.",
    )
    UNKNOWN_ERROR = (
        3,
        "The error is unknown, because sampled walks miss failures, or a few of them dominate the "
        "mean: give a larger n_walkers.",
    )
    START_NOT_FORGOTTEN = (
        4,
        "The effect of the start exceeds the tolerance: give a larger n_walkers or tol.",
    )


class FirstPassage(AbstractPrintable):
    """Mean numbers of gait steps until failure, with the eigenvalues of the survival operator.

    A line joins two footholds.

    - `mean_steps`: mean for starts from the quasi-stationary distribution, 1/(1 - kappa_1). It
      counts the step that fails;
    - `mean_steps_from_gait`: mean of completed steps, as `n_stepped` of `step_batch`. Walks start
      on the gait, before a landing on a line of the mean slope, or on a foothold of random height
      after a foothold on the mean line. If walks are sampled, the relative error is at most 1.5
      times that of `mean_steps`;
    - `mean_distance`: distance of `mean_steps` steps along the mean slope, m. It is `mean_steps`
      times the mean distance of completed steps from the quasi-stationary distribution. It is NaN
      for a walker of yours, whose steps have no distance;
    - `distance_error`: error estimate of `mean_distance`, m;
    - `failure_probability`: probability 1 - kappa_1 that a step from the quasi-stationary
      distribution fails;
    - `kappa_2`: second eigenvalue, the factor per step by which the effect of the start decays. If
      walks are sampled, its error is some hundredths. It is NaN if more walkers are needed for an
      estimate;
    - `error`: error estimate of `mean_steps`. If walks are sampled, it is half the width of a 99 %
      confidence interval, plus the effect of the start. It is infinite if the sampled walks miss
      failures, if a few walks dominate the mean, or if `kappa_2` is NaN;
    - `states`: states of the quasi-stationary distribution. For quadrature, they are squared
      angular rates at the instant at which the stance leg is vertical, 1/s^2, shape (n, 1), and
      with random heights the height of the foothold, m. For sampled walks, they are section states
      with the slope, or the heights of the last two footholds, as last components. For a walker of
      yours, the last component is the height of the last foothold;
    - `weights`: weights of the states, with the sum 1;
    - `status`: a `PassageStatus`;
    - `end_names`, `end_fractions`: names of the outcomes that end walks, and the fraction of walks
      that each outcome ends;
    - `n_steps`: number of sampled gait steps; 0 for quadrature.

    Examples:
        >>> wheel = vrw.RigidWheel(stop_at_lift_off=False)
        >>> params = vrw.WheelParams(slope=0.14, leg_mass=1e-9)
        >>> passage = vrw.first_passage(params, 0.0436, model=wheel)
        >>> print(f"{passage.mean_steps:.1f} steps, {passage.kappa_2:.3f}")
        432.6 steps, 0.490
    """

    mean_steps: Scalar
    mean_steps_from_gait: Scalar
    mean_distance: Scalar
    distance_error: Scalar
    failure_probability: Scalar
    kappa_2: Scalar
    error: Scalar
    states: Float[Array, "n n_state"]
    weights: Float[Array, " n"]
    status: Int[Array, ""]
    end_fractions: Float[Array, " n_ends"]
    end_names: tuple[str, ...] = eqx.field(static=True)
    n_steps: int = eqx.field(static=True, default=0)

    @property
    def kappa_1(self) -> Scalar:
        """Return the leading eigenvalue of the survival operator: the probability that a step from
        the quasi-stationary distribution succeeds.
        """
        return 1.0 - self.failure_probability

    @property
    def ending(self) -> Any:
        """Return a sentence on whether the error is within the tolerance."""
        return describe_step_ending(self.status, PassageStatus)

    def summary_rows(self) -> list[LabelAndText]:
        """Return pairs of label and text for means, failure probability, outcomes and status."""
        if np.ndim(self.status):
            return [("wheels", format_outcome_counts(self.status, PassageStatus))]
        end_texts = [
            f"{outcome_name} {100 * outcome_fraction:.3g} %"
            for outcome_name, outcome_fraction in zip(
                self.end_names, np.asarray(self.end_fractions), strict=True
            )
        ]
        distance, error = float(self.mean_distance), float(self.distance_error)
        distance_rows = [("mean distance", f"{distance:,.6g} m (error {error:.2g} m)")]
        if np.isnan(distance):
            distance_rows = []
        return [
            ("mean steps", f"{float(self.mean_steps):,.6g} (error {float(self.error):.2g})"),
            ("from the gait", f"{float(self.mean_steps_from_gait):,.6g}"),
            *distance_rows,
            ("failure probability of a step", f"{float(self.failure_probability):.6g}"),
            ("ends", ", ".join(end_texts) or "none"),
            ("sampled steps", f"{self.n_steps:,}" if self.n_steps else "none: quadrature"),
            ("status", self.ending),
        ]


@announce_wait("gaits and random walks", "10 s")
def first_passage(
    params: Any,
    slope_sd: float | Scalar | None = None,
    *,
    height_sd: float | Scalar | None = None,
    model: ModelLike | None = None,
    options: StepOptions | None = None,
    seed: int = 0,
    n_nodes: int = 400,
    n_walkers: int = 8192,
    tol: float | None = None,
    max_steps: int = 5_000_000,
) -> FirstPassage:
    """Return the mean number of gait steps until failure on random ground (Byl and Tedrake 2009).

    Either the slopes of the lines that join the footholds are independent and normal, with mean
    `params.slope`. Or the heights of the footholds above a line of this slope are independent and
    normal, with mean 0, as in `walk`. A walk ends at the first step whose outcome is not STEPPED. A
    landing on a slope outside the domain of slopes also ends the walk. In the paper's model, a
    failure is a departure from the sequence of phases, and need not be a fall. Walks of a
    `UnilateralWheel` continue after such a departure.

    For the rigid wheel, the map of a step has a closed form. Quadrature then computes the mean,
    even if walks take billions of steps. The model must be `RigidWheel(stop_at_lift_off=False)`,
    and `mean_steps` and `mean_distance` have first derivatives with respect to `params`, `slope_sd`
    and `height_sd`.

    For other models, walks are sampled. Importance sampling makes failures frequent, so that the
    number of sampled steps does not grow with the mean. The error is then half the width of a 99 %
    confidence interval.

    `jax.grad` of a sampled mean returns first derivatives with an error of a few percent. A walk
    fails beyond a radius in the space of slopes, and this radius is a smooth function of the
    parameters. The derivatives neglect terms of the relative size 1/`mean_steps`. They are computed
    from concrete values, so `jit` and `vmap` do not accept sampled means. A `WheelObjective` passes
    them to `tune`.

    If legs alternate, walks begin with the leg that `leg.turn` selects, and the failure probability
    is the mean over steps. Their means have no derivatives.

    A walker of yours declares by `ground` which of its parameters is the slope of a step or the
    rise of a foothold, see `AbstractWalker`. Its walks are sampled, and its means have no
    derivatives.

    Args:
        params: parameters of the wheel, or of a walker of yours; the slope is the mean slope.
        slope_sd: standard deviation of the slopes, rad.
        height_sd: standard deviation of the heights, m, instead of `slope_sd`.
        model: model of the wheel; by default the paper's, `ViscoelasticWheel()`.
        options: numerical options of sampled gait steps; by default rtol and atol are 1e-5, or with
            unilateral contact those of `StepOptions()`.
        seed: seed of the random slopes or heights.
        n_nodes: initial number of quadrature nodes, doubled until the relative error is at most
            `tol`.
        n_walkers: number of walks that are simulated at the same time, rounded up to 32 times a
            power of two.
        tol: relative error of `mean_steps`; by default 1e-8 for quadrature on slopes, 1e-6 for
            quadrature on heights, and 0.02 for sampled walks.
        max_steps: number of sampled gait steps after which no further walks begin.

    Returns:
        A `FirstPassage`: the mean number of steps, its error, and the outcomes that end walks.

    Raises:
        TypeError, ValueError: if an argument is invalid, if the wheel has no gait, or if the ground
            is so uneven that no step succeeds.

    Examples:
        >>> passage = vrw.first_passage(vrw.WheelParams(), 0.02, tol=0.1)
        >>> passage.end_names
        ('TOUCHDOWN_BEFORE_STOPPER',)
    """
    if not is_own_walker(model):
        require_single_wheel(params, "take one after the other")
    if (slope_sd is None) == (height_sd is None):
        raise ValueError(
            f"slope_sd is {slope_sd} and height_sd is {height_sd}, but the ground has one standard "
            "deviation: give slope_sd in rad or height_sd in m."
        )
    sd_name = "slope_sd" if height_sd is None else "height_sd"
    ground_sd: Any = slope_sd if height_sd is None else height_sd
    if not has_traced_leaf(ground_sd):
        ground_sd = check_positive(sd_name, ground_sd)
    seed, n_nodes = check_int("seed", seed, 0), check_int("n_nodes", n_nodes, 8)
    n_walkers, max_steps = check_int("n_walkers", n_walkers), check_int("max_steps", max_steps)
    tol = None if tol is None else check_positive("tol", tol)
    if is_own_walker(model):
        params = check_one_walker(params)
        _check_walker_on_random_ground(model, params, ground_sd, sd_name)
        resolved_model: Any = model
    else:
        resolved_model = convert_model_argument(resolve_model(params, model))
    if resolved_model.is_wheel and resolved_model.make_vertical_rate_map(params) is not None:
        return _solve_passage_by_quadrature(
            params, jnp.asarray(ground_sd), resolved_model, n_nodes, tol, sd_name
        )
    require_untraced_arguments(
        "vrw.first_passage", "differentiate by the wheel only", resolved_model
    )
    if options is None:
        options = (
            StepOptions()
            if resolved_model.is_wheel and resolved_model.reports_contacts
            else StepOptions(rtol=SAMPLED_STEP_TOLERANCE, atol=SAMPLED_STEP_TOLERANCE)
        )
    estimate_passage = functools.partial(
        _estimate_passage_by_sampling,
        sd_name=sd_name,
        model=resolved_model,
        options=convert_step_options(options),
        seed=seed,
        n_walkers=n_walkers,
        relative_tolerance=tol or 0.02,
        max_steps=max_steps,
    )
    if has_traced_leaf(params, ground_sd) and resolved_model.leg_period > 1:
        raise ValueError(
            "the legs alternate, but derivatives of sampled means are those of legs with one law: "
            "take differences of means."
        )
    if not has_traced_leaf(params, ground_sd):
        return estimate_passage(params, float(ground_sd))[0]
    return _estimate_differentiable_passage(estimate_passage, params, ground_sd)


def _check_walker_on_random_ground(
    walker: AbstractWalker, params: Any, ground_sd: Any, sd_name: str
) -> None:
    """Raise an error if the walker can't be simulated on random ground."""
    if isinstance(params, WheelParams):
        raise TypeError(
            "params is a WheelParams, but model is a walker of yours: give the walker's parameters."
        )
    require_untraced_arguments(
        "vrw.first_passage",
        "take differences of its means, which have no derivatives",
        params,
        ground_sd,
    )
    property_name = sd_name.removesuffix("_sd")
    if property_name not in walker.ground:
        raise ValueError(
            f"{sd_name} is given, but the walker does not declare what it changes: give it "
            f'ground={{"{property_name}": name}}, with the name of its parameter.'
        )


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _estimate_differentiable_passage(
    estimate_passage: Callable[..., tuple[FirstPassage, dict[str, float]]],
    params: WheelParams,
    ground_sd: Any,
) -> FirstPassage:
    """Return the `FirstPassage` that sampled walks estimate, with means that JAX can differentiate.

    Raise TypeError if the parameters of the wheel are abstract, as inside `jit` and `vmap`.
    """
    require_untraced_arguments("vrw.first_passage", SAMPLED_TRACING_REMEDY, params, ground_sd)
    return estimate_passage(params, float(ground_sd))[0]


@functools.partial(_estimate_differentiable_passage.defjvp, symbolic_zeros=True)
def _differentiate_passage(
    estimate_passage: functools.partial,
    primals: tuple[WheelParams, Any],
    tangents: tuple[WheelParams, Any],
) -> tuple[FirstPassage, FirstPassage]:
    """Return the `FirstPassage` that sampled walks estimate, and its tangent."""
    params, ground_sd = primals
    model, sd_name = (estimate_passage.keywords[name] for name in ("model", "sd_name"))
    require_untraced_arguments("vrw.first_passage", SAMPLED_TRACING_REMEDY, params, ground_sd)
    params_tangent, ground_sd_tangent = tangents
    tangent_by_name = {name: getattr(params_tangent, name) for name in PARAMETER_NAMES}
    tangent_by_name = {
        name: tangent
        for name, tangent in (tangent_by_name | {sd_name: ground_sd_tangent}).items()
        if not isinstance(tangent, SymbolicZero)
    }
    sampled_passage, derivatives = estimate_passage(
        params, float(ground_sd), differentiated_parameter_names=tuple(tangent_by_name)
    )
    log_mean_steps_tangent = sum(derivatives[name] * x for name, x in tangent_by_name.items())
    # The mean distance of a step changes as that of a step of the gait.
    gait_distance, gait_distance_tangent = jax.jvp(
        lambda wheel: model.compute_foot_distance(
            wheel, limit_cycle(wheel, model=model).section_state
        ),
        (params,),
        (
            jax.tree.map(
                lambda x, tangent: (
                    jnp.zeros_like(x) if isinstance(tangent, SymbolicZero) else tangent
                ),
                params,
                params_tangent,
            ),
        ),
    )
    passage_tangent = eqx.tree_at(
        lambda p: (p.mean_steps, p.mean_steps_from_gait, p.failure_probability, p.mean_distance),
        make_zero_tangent(sampled_passage),
        (
            sampled_passage.mean_steps * log_mean_steps_tangent,
            sampled_passage.mean_steps_from_gait * log_mean_steps_tangent,
            -sampled_passage.failure_probability * log_mean_steps_tangent,
            sampled_passage.mean_distance
            * (log_mean_steps_tangent + gait_distance_tangent / gait_distance),
        ),
    )
    return sampled_passage, passage_tangent


def _solve_passage_by_quadrature(
    params: WheelParams,
    ground_sd: Array,
    model: Any,
    n_nodes: int,
    relative_tolerance: float | None,
    sd_name: str,
) -> FirstPassage:
    """Return the `FirstPassage` of the rigid wheel, computed by quadrature.

    The number of nodes is doubled until the error is within `relative_tolerance`, by default 1e-8
    on slopes and 1e-6 on heights. For traced arguments, the number is not doubled. Raise ValueError
    if the model stops at lift-off or the wheel has no gait.

    - `sd_name`: "slope_sd" or "height_sd", the name of `ground_sd`.
    """
    if model.stop_at_lift_off:
        raise ValueError(
            "RigidWheel has stop_at_lift_off=True, but the map in closed form has no lift-off: "
            "give vrw.RigidWheel(stop_at_lift_off=False)."
        )
    has_heights, is_traced = sd_name == "height_sd", has_traced_leaf(params, ground_sd)
    if (
        not is_traced
        and not float(model.make_vertical_rate_map(params).compute_fixed_point(params.slope)) > 0
    ):
        raise NoGaitError(
            f"slope is {float(params.slope):g} rad, on which this rigid wheel has no gait: give a "
            "steeper one."
        )
    relative_tolerance = relative_tolerance or (1e-6 if has_heights else 1e-8)
    solve_by_interpolation = functools.partial(
        solve_passage_by_interpolation, params, ground_sd, model, has_heights=has_heights
    )
    solve_passage: Callable[..., RigidPassage] = solve_by_interpolation
    if not has_heights:
        solve_passage = functools.partial(solve_passage_on_slopes, params, ground_sd, model)
    previous_error: Any = np.inf
    coarse_passage = solve_passage(n_nodes=n_nodes // 2)
    if not is_traced and (
        coarse_passage.omitted_probability
        > 0.5 * relative_tolerance * coarse_passage.failure_probability
    ):
        solve_passage = solve_by_interpolation
        coarse_passage = solve_passage(n_nodes=n_nodes // 2)
    while True:
        passage = solve_passage(n_nodes=n_nodes)
        mean_steps, mean_distance = passage.compute_means()
        coarse_mean_steps, coarse_mean_distance = coarse_passage.compute_means()
        omission_error = mean_steps * passage.omitted_probability
        error = mean_steps * omission_error + jnp.abs(mean_steps - coarse_mean_steps)
        distance_error = mean_distance * omission_error + jnp.abs(
            mean_distance - coarse_mean_distance
        )
        # Round-off may exceed the failure probability of an extremely long life.
        is_within_tolerance = (error <= relative_tolerance * mean_steps) & (mean_steps > 0.0)
        if is_traced or bool(is_within_tolerance) or 2 * n_nodes > MAX_QUADRATURE_NODES:
            break
        if not error < 0.5 * previous_error:  # More nodes cannot reduce round-off.
            break
        n_nodes, coarse_passage, previous_error = 2 * n_nodes, passage, error
    status = jnp.where(
        is_within_tolerance, PassageStatus.CONVERGED, PassageStatus.TOLERANCE_NOT_MET
    )
    return FirstPassage(
        mean_steps=mean_steps,
        mean_steps_from_gait=passage.mean_steps_from_gait,
        mean_distance=mean_distance,
        distance_error=lax.stop_gradient(distance_error),
        failure_probability=passage.failure_probability,
        kappa_2=passage.kappa_2,
        error=lax.stop_gradient(error),
        states=passage.states,
        weights=passage.quasi_stationary_weights,
        status=status.astype(jnp.int32),
        end_fractions=jnp.ones(1, mean_steps.dtype),
        end_names=(Outcome.FELL_BACK.name,),
    )


def _estimate_passage_by_sampling(
    params: Any,
    ground_sd: float,
    sd_name: str,
    model: Any,
    options: StepOptions,
    *,
    seed: int,
    n_walkers: int,
    relative_tolerance: float,
    max_steps: int,
    differentiated_parameter_names: tuple[str, ...] = (),
) -> tuple[FirstPassage, dict[str, float]]:
    """Return the `FirstPassage` that sampled walks estimate, and derivatives of the logarithm of
    `mean_steps`.

    The derivatives are those with respect to the parameters `differentiated_parameter_names`, by
    the names of the parameters. Raise ValueError if the wheel has no gait, or if all walks
    of a group fail in one step.
    """
    gait: Any = limit_cycle(params, model=model, period_n=model.leg_period)
    kind = "wheel" if model.is_wheel else "walker"
    if int(gait.outcome) != Outcome.STEPPED:
        raise NoGaitError(
            f"this {kind} has no gait from which a walk could begin: {gait.why} "
            f"Take a {kind} for which vrw.limit_cycle finds a gait."
        )
    groups = WalkerGroups(
        params,
        np.asarray(gait.section_state),
        ground_sd,
        model,
        options,
        n_walkers,
        np.random.default_rng(seed),
        sd_name=sd_name,
    )
    try:
        sample = sample_passage(groups, float(gait.spectral_radius), relative_tolerance, max_steps)
    except ExtinctGroupError as extinction:
        raise ValueError(
            f"{sd_name} is {ground_sd:g} {SD_UNITS[sd_name]}, with which all walks of a group of "
            f"{groups.n_walkers_per_group:,} failed in one step: give a smaller one, or a "
            "larger n_walkers."
        ) from extinction
    derivative_by_name = {}
    if differentiated_parameter_names:
        derivative_by_name = differentiate_log_mean_steps(
            groups, sample.walk_density, differentiated_parameter_names
        )
    probability, error = sample.failure_probability, sample.relative_error
    mean_steps = 1.0 / probability if probability else np.inf
    failures = {
        PassageStatus.NO_FAILURE: not probability,
        PassageStatus.START_NOT_FORGOTTEN: sample.start_effect > relative_tolerance,
        PassageStatus.UNKNOWN_ERROR: not np.isfinite(error),
        PassageStatus.TOLERANCE_NOT_MET: error > relative_tolerance,
    }
    status = next(filter(failures.get, failures), PassageStatus.CONVERGED)
    states = sample.quasi_stationary_states
    distance_error = error * sample.mean_step_distance + sample.step_distance_error
    numbers = {
        "mean_steps": mean_steps,
        "mean_steps_from_gait": sample.mean_steps_from_gait,
        "mean_distance": mean_steps * sample.mean_step_distance,
        "distance_error": mean_steps * distance_error,
        "failure_probability": probability,
        "kappa_2": sample.kappa_2,
        "error": mean_steps * error,
        "states": states,
        "weights": np.full(len(states), 1.0 / len(states)),
        "end_fractions": np.array(list(sample.fraction_by_outcome.values())),
    }
    passage = FirstPassage(
        **jax.tree.map(lambda x: jnp.asarray(x, groups.gait_state.dtype), numbers),
        status=jnp.asarray(int(status), jnp.int32),
        end_names=tuple(sample.fraction_by_outcome),
        n_steps=sample.n_sampled_steps,
    )
    return passage, derivative_by_name
