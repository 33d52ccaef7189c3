"""Mean number of steps until a wheel fails on uneven ground (first passage, metastability)."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from vrw_jax.cycles import limit_cycle, resolve_model
from vrw_jax.models import PassageMethod
from vrw_jax.numerics import Scalar, StatusCode, StepOptions
from vrw_jax.printing import AbstractPrintable, TextRow, describe_ending
from vrw_jax.robustness.rigid_passage import solve_rigid_passage
from vrw_jax.robustness.sampled_passage import ExtinctGroupError, WalkerGroups, sample_passage
from vrw_jax.runtime import with_default_settings
from vrw_jax.simulation import ModelLike, check_model, check_options, check_single_wheel
from vrw_jax.validation import check_int, check_not_traced, check_positive, is_traced
from vrw_jax.wheel import Outcome, WheelParams

MAX_NODES = 3200
"""Largest number of nodes that are tried, chosen because a matrix of this size takes 80 MB."""

SAMPLED_STEP_TOLERANCE = 1e-6
"""Tolerance of sampled steps, chosen because the error of an event's time is then a ten-thousandth
of its standard deviation on slopes that matter."""


class PassageStatus(StatusCode):
    """Status of a computation of first passages."""

    CONVERGED = 0, "The error estimate is within the tolerance."
    TOLERANCE_NOT_MET = 1, "The error estimate exceeds the tolerance: allow more nodes or steps."
    NO_FAILURE = 2, "No walk failed, however uneven its slopes were made: the mean has no estimate."


class FirstPassage(AbstractPrintable):
    """Mean numbers of steps until failure, with the eigenvalues of the survival operator.

    Means count the random lines on which the wheel lands, the one on which it fails included.

    - `mean_steps`: 1/(1 - kappa_1), from the quasi-stationary distribution;
    - `mean_steps_from_gait`: from the gait, before a landing on a line of the mean slope. From
      samples its relative error is at most 1.5 times that of `mean_steps`;
    - `failure_probability`: 1 - kappa_1, of one step from the quasi-stationary distribution;
    - `kappa_2`: rate at which the start is forgotten; from samples to some hundredths;
    - `error`: estimate of the error of `mean_steps`, from samples with a confidence of 99 %;
    - `states`: states of the quasi-stationary distribution. With quadrature: squared rate with the
      stance leg vertical, 1/s^2, shape (n, 1). From samples: section states, the slope last;
    - `weights`: their weights, whose sum is 1;
    - `status`: a `PassageStatus`;
    - `end_names`, `end_shares`: outcomes that end walks, and their shares;
    - `n_steps`: number of sampled steps; 0 with quadrature.

    Examples:
        >>> wheel = vrw.RigidWheel(stop_at_lift_off=False)
        >>> params = vrw.WheelParams(slope=0.14, leg_mass=1e-9)
        >>> passage = vrw.first_passage(params, 0.0436, model=wheel)
        >>> print(f"{passage.mean_steps:.1f} steps, {passage.kappa_2:.3f}")
        432.6 steps, 0.490
    """

    mean_steps: Scalar
    mean_steps_from_gait: Scalar
    failure_probability: Scalar
    kappa_2: Scalar
    error: Scalar
    states: Float[Array, "n n_state"]
    weights: Float[Array, " n"]
    status: Int[Array, ""]
    end_shares: Float[Array, " n_ends"]
    end_names: tuple[str, ...] = eqx.field(static=True)
    n_steps: int = eqx.field(static=True, default=0)

    @property
    def kappa_1(self) -> Scalar:
        """Return the leading eigenvalue, the probability to survive a step."""
        return 1.0 - self.failure_probability

    @property
    def ending(self) -> str:
        """Return whether the error is within the tolerance, as a sentence."""
        return describe_ending(self.status, PassageStatus)

    def summary_rows(self) -> list[TextRow]:
        """Return the printed rows."""
        ends = zip(self.end_names, np.asarray(self.end_shares), strict=True)
        sampled = f"{self.n_steps:,}" if self.n_steps else "none: quadrature"
        return [
            ("mean steps", f"{float(self.mean_steps):,.6g} (error {float(self.error):.2g})"),
            ("from the gait", f"{float(self.mean_steps_from_gait):,.6g}"),
            ("failure probability of a step", f"{float(self.failure_probability):.6g}"),
            ("ends", ", ".join(f"{name} {100 * share:.3g} %" for name, share in ends) or "none"),
            ("sampled steps", sampled),
            ("status", self.ending),
        ]


@with_default_settings
def first_passage(
    params: WheelParams,
    slope_sd: float | Scalar,
    *,
    model: ModelLike | None = None,
    options: StepOptions | None = None,
    seed: int = 0,
    n_nodes: int = 400,
    n_walkers: int = 8192,
    tol: float | None = None,
    max_steps: int = 5_000_000,
) -> FirstPassage:
    """Return the mean number of steps until failure on random slopes (Byl and Tedrake 2009).

    The slopes of the lines that join the footholds are independent and normal, with mean
    `params.slope`. A walk ends at the first step whose outcome is not STEPPED; a slope outside its
    domain is such a step. On the paper's wheel a failure is a departure from its sequence of phases
    and mostly no fall; `UnilateralWheel` continues.

    For the rigid wheel the kernel of its one-dimensional map is known, and quadrature gives means
    of any length. It needs `RigidWheel(stop_at_lift_off=False)`. `mean_steps` then has first
    derivatives with respect to `params` and `slope_sd`. For other models, walks are sampled, with
    failures made frequent by importance sampling, so that long lives take as many steps as short
    ones. The error is then half the width of a 99 % confidence interval.

    Args:
        params: the wheel, whose slope is the mean slope.
        slope_sd: standard deviation of the slopes, rad.
        model: the model; the paper's, `ViscoelasticWheel()`, by default.
        options: numerical choices of sampled steps; by default rtol and atol are 1e-6.
        seed: of the random slopes.
        n_nodes: number of nodes of the quadrature; doubled until `tol` is met.
        n_walkers: number of walks side by side.
        tol: relative error of `mean_steps`: by default 1e-8 with quadrature, 0.02 with samples.
        max_steps: number of sampled steps after which no further walks begin.

    Returns:
        A `FirstPassage`.

    Raises:
        TypeError, ValueError: an invalid argument, a wheel without a gait, or slopes so uneven that
            no step succeeds, described in one sentence.

    Examples:
        >>> passage = vrw.first_passage(vrw.WheelParams(), 0.02, tol=0.1)
        >>> passage.end_names
        ('TOUCHDOWN_BEFORE_STOPPER',)
    """
    check_single_wheel(params, "take one after the other")
    if not is_traced(slope_sd):
        slope_sd = check_positive("slope_sd", slope_sd)
    seed, n_nodes = check_int("seed", seed, 0), check_int("n_nodes", n_nodes, 8)
    n_walkers, max_steps = check_int("n_walkers", n_walkers), check_int("max_steps", max_steps)
    tol = None if tol is None else check_positive("tol", tol)
    resolved_model: Any = check_model(resolve_model(params, model))
    if resolved_model.capabilities.passage_method == PassageMethod.QUADRATURE:
        return _integrate(params, jnp.asarray(slope_sd), resolved_model, n_nodes, tol or 1e-8)
    check_not_traced("vrw.first_passage", "take the rigid wheel", params, slope_sd)
    if options is None:
        options = StepOptions(rtol=SAMPLED_STEP_TOLERANCE, atol=SAMPLED_STEP_TOLERANCE)
    return _sample(
        params,
        float(slope_sd),
        resolved_model,
        check_options(options),
        seed=seed,
        n_walkers=n_walkers,
        tol=tol or 0.02,
        max_steps=max_steps,
    )


def _integrate(
    params: WheelParams, slope_sd: Array, model: Any, n_nodes: int, tol: float
) -> FirstPassage:
    """Return the first passage by quadrature; nodes are doubled if values are known."""
    if model.stop_at_lift_off:
        raise ValueError(
            "RigidWheel has stop_at_lift_off=True, but the kernel in closed form has no lift-off: "
            "give vrw.RigidWheel(stop_at_lift_off=False)."
        )
    if (
        not is_traced(params)
        and not float(model.vertical_map(params).fixed_point(params.slope)) > 0
    ):
        raise ValueError(
            f"slope is {float(params.slope):g} rad, on which this rigid wheel has no gait: give a "
            "steeper one."
        )
    coarse = solve_rigid_passage(params, slope_sd, model, n_nodes // 2)
    while True:
        fine = solve_rigid_passage(params, slope_sd, model, n_nodes)
        means = [1.0 / x.survival.failure_probability for x in (coarse, fine)]
        error = lax.stop_gradient(jnp.abs(means[1] - means[0]))
        is_good = error <= tol * means[1]
        if is_traced(params, slope_sd) or bool(is_good) or n_nodes >= MAX_NODES:
            break
        coarse, n_nodes = fine, 2 * n_nodes
    status = jnp.where(is_good, PassageStatus.CONVERGED, PassageStatus.TOLERANCE_NOT_MET)
    return FirstPassage(
        mean_steps=means[1],
        mean_steps_from_gait=fine.mean_steps_from_gait,
        failure_probability=fine.survival.failure_probability,
        kappa_2=fine.survival.kappa_2,
        error=error,
        states=fine.nodes[:, None],
        weights=fine.survival.distribution,
        status=status.astype(jnp.int32),
        end_shares=jnp.ones(1, means[1].dtype),
        end_names=(Outcome.FELL_BACK.name,),
    )


def _sample(
    params: WheelParams,
    slope_sd: float,
    model: Any,
    options: StepOptions,
    *,
    seed: int,
    n_walkers: int,
    tol: float,
    max_steps: int,
) -> FirstPassage:
    """Return the first passage by sampling walks."""
    cycle: Any = limit_cycle(params, model=model)
    if int(cycle.outcome) != Outcome.STEPPED:
        raise ValueError(
            f"this wheel has no gait from which a walk could begin: {cycle.why} Take a wheel for "
            "which vrw.limit_cycle finds a gait."
        )
    random = np.random.default_rng(seed)
    start = np.asarray(cycle.section_state)
    groups = WalkerGroups(params, start, slope_sd, model, options, n_walkers, random)
    try:
        sample = sample_passage(groups, float(cycle.spectral_radius), tol, max_steps)
    except ExtinctGroupError as error:
        raise ValueError(
            f"slope_sd is {slope_sd:g} rad, with which hardly any step of this wheel succeeds: "
            "give a smaller one."
        ) from error
    probability = sample.failure_probability
    mean = 1.0 / probability if probability else np.inf
    is_good = sample.relative_error <= tol
    status = PassageStatus.CONVERGED if is_good else PassageStatus.TOLERANCE_NOT_MET
    status = status if probability else PassageStatus.NO_FAILURE
    number = lambda x: jnp.asarray(x, params.damping.dtype)
    return FirstPassage(
        mean_steps=number(mean),
        mean_steps_from_gait=number(sample.mean_steps_from_gait),
        failure_probability=number(probability),
        kappa_2=number(sample.kappa_2),
        error=number(mean * sample.relative_error if probability else np.inf),
        states=number(sample.states),
        weights=number(np.full(len(sample.states), 1.0 / len(sample.states))),
        status=jnp.asarray(int(status), jnp.int32),
        end_shares=number(list(sample.share_by_outcome.values())),
        end_names=tuple(sample.share_by_outcome),
        n_steps=sample.n_steps,
    )
