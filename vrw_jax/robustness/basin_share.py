"""Share of a box of starts from which a wheel reaches its gait."""

from collections.abc import Mapping
from typing import Any, Literal, NamedTuple, get_args

import equinox as eqx
import numpy as np
from jaxtyping import Float

from vrw_jax.cycles import AbstractCycle
from vrw_jax.numerics import StepOptions
from vrw_jax.printing import AbstractPrintable, TextRow
from vrw_jax.robustness.gait_arrival import StableGait, walk_to_gait
from vrw_jax.runtime import with_default_settings
from vrw_jax.simulation import (
    POST_LANDING_NAMES,
    PRE_TOUCHDOWN_NAMES,
    ModelLike,
    invert_landing,
)
from vrw_jax.validation import check_choice, check_int, check_range, check_real, check_type
from vrw_jax.wheel import Outcome, WheelParams

Sampling = Literal["sobol", "random"]
StartBox = Mapping[str, float | tuple[float, float]]
"""Bounds of each component of a start, by name; a single number is fixed."""


class BasinShare(AbstractPrintable):
    """Share of a box of starts from which a wheel ends up on its gait.

    - `share`: share of the starts whose walk arrives at the gait;
    - `share_error`: standard error of the share for independent starts;
    - `walking_share`: share of the starts that still walk after 1, 2, ... steps, on the gait or
      not, shape (max_steps,);
    - `walking_share_error`: standard errors of these shares, shape (max_steps,);
    - `elsewhere_share`: share of the starts that walk `max_steps` steps and are not on the gait;
    - `failure_shares`: share of the starts by the name of the outcome that ends their walk;
    - `n_starts`: number of starts.

    Examples:
        >>> box = {"theta_touchdown": 0.1, "dtheta_touchdown": (0.8, 2.8)}
        >>> box |= {"dL1_touchdown": (-0.6, 0.2)}
        >>> print(vrw.basin_share(vrw.WheelParams(damping=150.0), box, n_starts=256))
        BasinShare
          ends up on the gait: 0.7461 (standard error 0.0273)
          walks after 200 steps: 0.7461 (standard error 0.0273)
          TOUCHDOWN_BEFORE_STOPPER: 0.2539
          starts: 256
    """

    share: float
    share_error: float
    walking_share: Float[np.ndarray, " n_steps"]
    walking_share_error: Float[np.ndarray, " n_steps"]
    elsewhere_share: float
    failure_shares: dict[str, float] = eqx.field(static=True)
    n_starts: int = eqx.field(static=True)

    def summary_rows(self) -> list[TextRow]:
        """Return label and text of each share, with its error."""
        n = len(self.walking_share)
        walking_fraction, walking_fraction_error = (
            self.walking_share[-1],
            self.walking_share_error[-1],
        )
        text_rows = [
            ("ends up on the gait", f"{self.share:.4f} (standard error {self.share_error:.4f})"),
            (
                f"walks after {n} steps",
                f"{walking_fraction:.4f} (standard error {walking_fraction_error:.4f})",
            ),
        ]
        text_rows += [(name, f"{share:.4f}") for name, share in self.failure_shares.items()]
        return [*text_rows, ("starts", f"{self.n_starts:,}")]


@with_default_settings
def basin_share(
    params: WheelParams,
    box: StartBox,
    *,
    model: ModelLike | None = None,
    cycle: AbstractCycle | None = None,
    options: StepOptions | None = None,
    n_starts: int = 4096,
    max_steps: int = 200,
    sampling: Sampling = "sobol",
    seed: int = 0,
) -> BasinShare:
    """Return the share of a box of starts from which the wheel ends up on its gait.

    The starts are spread evenly over `box`. A walk has arrived when its section state differs from
    that of the gait by less than 1e-6 in the wheel's own units. The gait must be stable, so that it
    is kept from there on.

    The errors are standard errors of a binomial share, with one start added on either side, so that
    they are positive for shares of 0 and 1. They hold for `sampling="random"`. Points of a
    scrambled Sobol' sequence have smaller errors in most boxes.

    Args:
        params: the wheel.
        box: bounds (lower, upper) or a number for all of "theta_touchdown", "dtheta_touchdown" and
            "dL1_touchdown", in rad, rad/s, m/s; or for both "theta_post_impact" and
            "dtheta_post_impact". Starts to which no landing leads count as BAD_INPUT.
        model: the model; by default that of the paper, `ViscoelasticWheel()`. "auto" means
            unilateral contact, which is valid for all starts.
        cycle: the gait; by default that of `limit_cycle`.
        options: numerical options of the steps.
        n_starts: number of starts, best a power of 2.
        max_steps: largest number of steps of a walk.
        sampling: "sobol", or "random" for independent starts.
        seed: seed of the starts.

    Returns:
        A `BasinShare`.

    Raises:
        TypeError, ValueError: if an argument is invalid, or if the wheel has no stable gait.

    Examples:
        >>> box = {"theta_touchdown": 0.1, "dtheta_touchdown": (0.8, 2.8)}
        >>> box |= {"dL1_touchdown": (-0.6, 0.2)}
        >>> result = vrw.basin_share(vrw.WheelParams(damping=150.0), box, n_starts=256)
        >>> print(f"{result.share:.2f}")
        0.75
    """
    n_starts, max_steps = check_int("n_starts", n_starts), check_int("max_steps", max_steps)
    check_choice("sampling", sampling, get_args(Sampling))
    seed, bounds = check_int("seed", seed, 0), parse_box(box)
    gait = StableGait.find("vrw.basin_share", params, model, cycle, options)
    return compute_basin_share(gait, bounds, n_starts, max_steps, sampling, seed)


class BoxBounds(NamedTuple):
    """Names and bounds of the components of starts."""

    names: tuple[str, ...]
    lower: np.ndarray
    upper: np.ndarray


def compute_basin_share(
    gait: StableGait,
    bounds: BoxBounds,
    n_starts: int,
    max_steps: int,
    sampling: str = "sobol",
    seed: int = 0,
) -> BasinShare:
    """Return the result of `basin_share` for a gait and checked arguments."""
    unit_points = _draw_unit_points(len(bounds.names), n_starts, sampling, seed)
    starts = bounds.lower + (bounds.upper - bounds.lower) * unit_points
    if bounds.names == POST_LANDING_NAMES:
        starts = invert_landing(gait.params, starts)
    is_reachable = np.isfinite(starts).all(-1)
    is_on_gait, n_stepped = np.zeros(n_starts, bool), np.zeros(n_starts, int)
    outcome = np.full(n_starts, int(Outcome.BAD_INPUT))
    if is_reachable.any():
        walks = walk_to_gait(gait, starts[is_reachable], max_steps)
        is_on_gait[is_reachable], outcome[is_reachable] = walks.is_on_gait, walks.outcome
        n_stepped[is_reachable] = walks.n_stepped
    n_stepped[is_on_gait] = max_steps
    walking_share = np.mean(n_stepped[:, None] >= np.arange(1, max_steps + 1), 0)
    share_by_failure = {code.name: float(np.mean(outcome == code)) for code in Outcome if code}
    share = float(is_on_gait.mean())
    return BasinShare(
        share=share,
        share_error=compute_share_error(share, n_starts),
        walking_share=walking_share,
        walking_share_error=compute_share_error(walking_share, n_starts),
        elsewhere_share=float(np.mean((outcome == Outcome.STEPPED) & ~is_on_gait)),
        failure_shares={name: value for name, value in share_by_failure.items() if value > 0.0},
        n_starts=n_starts,
    )


def compute_share_error(share: Any, n: int) -> Any:
    """Return the standard error of a share of n independent draws, or of an array of shares.

    One draw on either side is added (Laplace's rule of succession), so that the error is never
    zero.
    """
    smoothed_share = (share * n + 1.0) / (n + 2.0)
    return (smoothed_share * (1.0 - smoothed_share) / n) ** 0.5


def _draw_unit_points(n_dims: int, n_points: int, sampling: str, seed: int) -> np.ndarray:
    """Return points of the unit cube, (n_points, n_dims)."""
    if sampling == "random":
        return np.random.default_rng(seed).random((n_points, n_dims))
    from scipy.stats import qmc  # This import is slow.

    sobol_exponent = (n_points - 1).bit_length()
    generator = np.random.default_rng(seed)
    return qmc.Sobol(n_dims, rng=generator).random_base2(sobol_exponent)[:n_points]


def parse_box(box: StartBox) -> BoxBounds:
    """Return names and bounds of the components of the starts.

    Raises `TypeError` or `ValueError` unless the box bounds all components of one kind.
    """
    check_type("box", box, Mapping, "write {'theta_touchdown': 0.1, 'dtheta_touchdown': (1, 2)...}")
    for names in (PRE_TOUCHDOWN_NAMES, POST_LANDING_NAMES):
        if set(box) == set(names):
            break
    else:
        raise ValueError(
            f"the box contains {', '.join(map(str, box)) or 'nothing'}, but it must contain all of "
            f"{', '.join(PRE_TOUCHDOWN_NAMES)}, or all of {', '.join(POST_LANDING_NAMES)}: give "
            "each a number or two bounds."
        )
    is_number = lambda value: np.ndim(value) == 0
    bounds = [
        (check_real(name, box[name]),) * 2 if is_number(box[name]) else check_range(name, box[name])
        for name in names
    ]
    lower, upper = np.array(bounds).T
    return BoxBounds(names, lower, upper)
