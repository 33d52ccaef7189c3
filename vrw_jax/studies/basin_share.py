"""Share of the start states in a box from which a wheel reaches its gait."""

from collections.abc import Mapping
from typing import Any, Literal, get_args

import equinox as eqx
import numpy as np
from jaxtyping import Float

from vrw_jax.base.checks import check_choice, check_int, check_range, check_real, check_type
from vrw_jax.base.options import StepOptions
from vrw_jax.base.outcomes import Outcome
from vrw_jax.base.printing import AbstractPrintable, LabelAndText
from vrw_jax.base.progress import announce_wait
from vrw_jax.gaits.cycle import AbstractCycle
from vrw_jax.models.stepping import ModelLike
from vrw_jax.studies.basins import compute_section_states_of_starts, select_start_components
from vrw_jax.studies.gait_arrival import StableGait, walk_until_on_gait
from vrw_jax.wheel.params import WheelParams

StartSamplingName = Literal["sobol", "random"]
StartBox = Mapping[str, float | tuple[float, float]]
"""Bounds (lower, upper) of each component of a start state, by the name of the component.

A single number fixes the component.
"""


class BasinShare(AbstractPrintable):
    """Share of the start states in a box from which a wheel arrives at its gait.

    - `share`: share of the starts whose walk arrives at the gait;
    - `share_error`: standard error of `share` for independent starts;
    - `walking_share`: share of the starts whose walk has not failed after 1, 2, ... gait steps,
      shape (max_steps,);
    - `walking_share_error`: standard errors of `walking_share`, shape (max_steps,);
    - `elsewhere_share`: share of the starts whose walk neither fails nor arrives at the gait within
      `max_steps` gait steps;
    - `failure_shares`: shares of the starts whose walk fails, by the name of the `Outcome`;
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

    def summary_rows(self) -> list[LabelAndText]:
        """Return pairs of label and text for the shares, with their standard errors."""
        format_share = lambda share, error: f"{share:.4f} (standard error {error:.4f})"
        return [
            ("ends up on the gait", format_share(self.share, self.share_error)),
            (
                f"walks after {len(self.walking_share)} steps",
                format_share(self.walking_share[-1], self.walking_share_error[-1]),
            ),
            *(
                (outcome_name, f"{share:.4f}")
                for outcome_name, share in self.failure_shares.items()
            ),
            ("starts", f"{self.n_starts:,}"),
        ]


@announce_wait("gaits and walks", "20 s")
def basin_share(
    params: WheelParams,
    box: StartBox,
    *,
    model: ModelLike | None = None,
    cycle: AbstractCycle | None = None,
    options: StepOptions | None = None,
    n_starts: int = 4096,
    max_steps: int = 200,
    sampling: StartSamplingName = "sobol",
    seed: int = 0,
) -> BasinShare:
    """Return the share of the start states in a box from which a wheel arrives at its gait.

    The starts are spread evenly over `box`. A walk arrives at the gait when its section state
    differs from that of the gait by less than 1e-6. The unit is that of the wheel
    (`compute_wheel_units`). The gait must be stable, so that the walk stays on it.

    The errors are standard errors of a binomial share. For the error, one start that arrives and
    one that does not are added. The error is therefore positive for a share of 0 or 1. The errors
    hold for `sampling="random"`. In most boxes, points of a scrambled Sobol' sequence have smaller
    errors.

    Args:
        params: parameters of the wheel.
        box: bounds (lower, upper) or a number for each of "theta_touchdown", "dtheta_touchdown" and
            "dL1_touchdown", in rad, rad/s, m/s; or for each of "theta_post_impact" and
            "dtheta_post_impact", in rad, rad/s. Starts to which no landing leads count as
            BAD_INPUT.
        model: model of the wheel; by default that of the paper, `ViscoelasticWheel()`. "auto" means
            unilateral contact, which is valid for all starts.
        cycle: the gait; by default the result of `limit_cycle`.
        options: numerical options of the gait steps.
        n_starts: number of starts, best a power of 2.
        max_steps: largest number of gait steps of a walk.
        sampling: "sobol", or "random" for independent starts.
        seed: seed of the starts.

    Returns:
        A `BasinShare`: the share of starts whose walks reach the gait, and its error.

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
    check_choice("sampling", sampling, get_args(StartSamplingName))
    seed, box_bounds = check_int("seed", seed, 0), parse_start_box(box)
    stable_gait = StableGait.from_cycle("vrw.basin_share", params, model, cycle, options)
    return compute_basin_share(stable_gait, box_bounds, n_starts, max_steps, sampling, seed)


StartBoxBounds = tuple[tuple[str, ...], np.ndarray, np.ndarray]
"""Names, lower bounds and upper bounds of the components of start states, rad, rad/s and m/s."""


def compute_basin_share(
    stable_gait: StableGait,
    box_bounds: StartBoxBounds,
    n_starts: int,
    max_steps: int,
    sampling_name: str = "sobol",
    seed: int = 0,
) -> BasinShare:
    """Return the `BasinShare` for a stable gait and for valid arguments of `basin_share`."""
    start_component_names, lower_bounds, upper_bounds = box_bounds
    n_start_components = len(start_component_names)
    random_generator = np.random.default_rng(seed)
    if sampling_name == "random":
        unit_cube_points = random_generator.random((n_starts, n_start_components))
    else:
        from scipy.stats import qmc  # This import is slow.

        sobol_sampler = qmc.Sobol(n_start_components, rng=random_generator)
        unit_cube_points = sobol_sampler.random_base2((n_starts - 1).bit_length())[:n_starts]
    starts = lower_bounds + (upper_bounds - lower_bounds) * unit_cube_points
    start_states = compute_section_states_of_starts(
        stable_gait.params, start_component_names, starts
    )
    is_on_gait, walk_outcomes, n_steps_walked = walk_until_on_gait(
        stable_gait, start_states, max_steps
    )
    n_steps_walked[is_on_gait] = max_steps
    walking_share = np.mean(n_steps_walked[:, None] >= np.arange(1, max_steps + 1), 0)
    failure_codes, n_failures = np.unique(
        walk_outcomes[walk_outcomes != Outcome.STEPPED], return_counts=True
    )
    arrival_share = float(is_on_gait.mean())
    return BasinShare(
        share=arrival_share,
        share_error=compute_share_error(arrival_share, n_starts),
        walking_share=walking_share,
        walking_share_error=compute_share_error(walking_share, n_starts),
        elsewhere_share=float(np.mean((walk_outcomes == Outcome.STEPPED) & ~is_on_gait)),
        failure_shares={
            Outcome(failure_code).name: float(n / n_starts)
            for failure_code, n in zip(failure_codes, n_failures, strict=True)
        },
        n_starts=n_starts,
    )


def compute_share_error(sampled_share: Any, n_draws: int) -> Any:
    """Return the standard error of a share that is estimated from `n_draws` independent draws.

    `sampled_share` is a share or an array of shares. One draw with each result is added (Laplace's
    rule of succession), so that the error is positive.
    """
    smoothed_share = (sampled_share * n_draws + 1.0) / (n_draws + 2.0)
    return (smoothed_share * (1.0 - smoothed_share) / n_draws) ** 0.5


def parse_start_box(box: StartBox) -> StartBoxBounds:
    """Return the names and bounds of the components of start states in `box`.

    Raise TypeError if the box is not a mapping. Raise ValueError unless the box bounds all
    components of one kind of start.
    """
    check_type("box", box, Mapping, "write {'theta_touchdown': 0.1, 'dtheta_touchdown': (1, 2)...}")
    start_component_names = select_start_components("box", box, "a number or two bounds")
    bounds_of_start_component = [
        (check_real(component_name, box[component_name]),) * 2
        if np.ndim(box[component_name]) == 0
        else check_range(component_name, box[component_name])
        for component_name in start_component_names
    ]
    lower_bounds, upper_bounds = np.array(bounds_of_start_component).T
    return start_component_names, lower_bounds, upper_bounds
