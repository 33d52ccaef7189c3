"""Gait sensitivity norm: the variation of a gait's measures on slightly uneven ground."""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from vrw_jax.base.checks import check_names, has_traced_leaf, require_known_name
from vrw_jax.base.options import StepOptions
from vrw_jax.base.outcomes import Outcome
from vrw_jax.base.printing import AbstractPrintable, LabelAndText, describe_step_ending
from vrw_jax.base.progress import announce_wait
from vrw_jax.base.types import Scalar
from vrw_jax.gaits.finder import AbstractGaitFinder
from vrw_jax.gaits.finder_selection import UserCycleGuess, resolve_finder
from vrw_jax.gaits.gait_search import limit_cycle, resolve_model
from vrw_jax.gaits.options import CycleOptions
from vrw_jax.gaits.slope_response import compute_sensitivity_norms
from vrw_jax.models.measures import (
    MARGIN_MEASURES,
    MEASURES,
    STEP_MEASURES,
    UNILATERAL_STEP_MEASURES,
)
from vrw_jax.models.stepping import ModelLike
from vrw_jax.wheel.params import WheelParams


class GaitSensitivity(AbstractPrintable):
    """Gait sensitivity norms of several measures, each in the measure's unit per rad of slope.

    The norm is the ratio of two standard deviations: that of a measure in a long walk over
    independent slopes, and that of the slopes. The ratio is taken in the limit of small deviations.
    The norm is infinite if the gait is not stable. A line of the ground joins two footholds. The
    squares of `ending_step`, `beginning_step` and `later_steps` sum to the square of the norm.

    - `norm`: norms in the order of `measures`;
    - `ending_step`: signed response of the step that ends on a line to the slope of that line;
    - `beginning_step`: signed response of the step that begins on a line to the slope of that line;
    - `later_steps`: square root of the sum of the squared responses of all later steps to the slope
      of the line;
    - `spectral_radius`: spectral radius of the gait's return map;
    - `outcome`: Outcome.STEPPED, or the reason why there is no gait; without a gait, all other
      numbers are zero;
    - `measures`: names of the measures.

    Examples:
        >>> print(vrw.gait_sensitivity(vrw.WheelParams(), ["period"]))
        GaitSensitivity
          step period T: 3.50861 s per rad (step that ends on the disturbed line: 0.566241, step that begins on it: -2.78338, later steps: 2.05973)
          spectral radius of the gait: 0.32862
    """  # noqa: E501

    norm: Float[Array, " n_measures"]
    ending_step: Float[Array, " n_measures"]
    beginning_step: Float[Array, " n_measures"]
    later_steps: Float[Array, " n_measures"]
    spectral_radius: Scalar
    outcome: Int[Array, ""]
    measures: tuple[str, ...] = eqx.field(static=True)

    @property
    def ending(self) -> str:
        """Return a sentence on whether the norms are finite, with the reason if they are not."""
        if self.outcome != Outcome.STEPPED:
            return describe_step_ending(self.outcome, Outcome)
        if self.spectral_radius < 1.0:
            return "The gait is stable, and the norms are finite."
        return "The gait is not stable: deviations grow from step to step, and no norm is finite."

    def summary_rows(self) -> list[LabelAndText]:
        """Return pairs of label and text for the norm of each measure and the responses that it
        sums.
        """
        if self.outcome != Outcome.STEPPED:
            return [("outcome", self.ending)]
        share_text_rows = []
        for measure_index, measure_name in enumerate(self.measures):
            measure_definition = MEASURES[measure_name]
            sensitivity_unit = f"{measure_definition.display_unit} per rad".strip()
            norm_parts_text = (
                "step that ends on the disturbed line: "
                f"{float(self.ending_step[measure_index]):.6g}, "
                f"step that begins on it: {float(self.beginning_step[measure_index]):.6g}, "
                f"later steps: {float(self.later_steps[measure_index]):.6g}"
            )
            share_text_rows.append(
                (
                    measure_definition.label_with_symbol,
                    f"{float(self.norm[measure_index]):.6g} {sensitivity_unit} ({norm_parts_text})",
                )
            )
        return [
            *share_text_rows,
            ("spectral radius of the gait", f"{float(self.spectral_radius):.5f}"),
        ]


@announce_wait("the gait and its response to slopes", "15 s")
def gait_sensitivity(
    params: WheelParams,
    measures: str | Sequence[str],
    *,
    model: ModelLike | None = None,
    guess: UserCycleGuess | None = None,
    options: CycleOptions | StepOptions | None = None,
) -> GaitSensitivity:
    """Return the gait sensitivity norm of each measure of a gait step.

    The slopes of the lines that join the footholds are independent, with mean `params.slope`. A
    line influences two steps directly: the step that ends on the line and the step that begins on
    it. A discrete Lyapunov equation sums the response of all later steps. Hobbelen and Wisse (2007)
    sum over a few steps.

    Norms are differentiable with respect to `params` in forward and reverse mode. The norm of a
    margin depends on more than durations and the first landing. Its gradient needs second
    derivatives of a gait step, whose compilation takes minutes. With unilateral contact, norms have
    no derivatives.

    Args:
        params: parameters of the wheel; the slope is the mean slope.
        measures: names of measures of a gait step, such as "period", "speed" or a margin.
        model: model of the wheel; by default the paper's, `ViscoelasticWheel()`.
        guess: as in `limit_cycle`.
        options: as in `limit_cycle`.

    Returns:
        A `GaitSensitivity`: the norm of each measure, and its parts.

    Raises:
        TypeError, ValueError: if an argument is invalid or the wheel has no gait.

    Examples:
        >>> print(vrw.gait_sensitivity(vrw.WheelParams(), ["period", "speed"]).norm.round(3))
        [3.509 3.757]
        >>> norm = lambda p: vrw.gait_sensitivity(p, "period").norm[0]
        >>> print(f"{jax.grad(norm)(vrw.WheelParams()).damping:.5f} s/rad per N s/m")
        0.01431 s/rad per N s/m
    """
    model = resolve_model(params, model)
    cycle_finder = resolve_finder(params, model, options)
    measure_names = parse_sensitivity_measures(cycle_finder, measures)
    limit_cycle_result: Any = limit_cycle(params, guess=guess, model=model, options=options)
    if (
        not has_traced_leaf(limit_cycle_result)
        and int(limit_cycle_result.outcome) != Outcome.STEPPED
    ):
        raise ValueError(
            "this wheel has no gait whose sensitivity could be computed: "
            f"{limit_cycle_result.why} Take a wheel for which vrw.limit_cycle finds a gait."
        )
    return compute_gait_sensitivity(cycle_finder, params, limit_cycle_result, measure_names)


def parse_sensitivity_measures(
    cycle_finder: AbstractGaitFinder, measures: str | Sequence[str]
) -> tuple[str, ...]:
    """Return the names of measures of a gait step; raise an error for names of other kinds."""
    measure_names = check_names("measures", measures)
    step_measures = STEP_MEASURES | MARGIN_MEASURES | UNILATERAL_STEP_MEASURES
    known_measure_names = tuple(
        measure_name
        for measure_name in cycle_finder.differentiable_measures
        if measure_name in step_measures
    )
    for measure_name in measure_names or ("nothing",):
        require_known_name(
            measure_name,
            known_measure_names,
            f"measure of a step of {cycle_finder.model.model_name} wheels",
        )
    return measure_names


def compute_gait_sensitivity(
    cycle_finder: AbstractGaitFinder,
    params: WheelParams,
    limit_cycle_result: Any,
    measure_names: tuple[str, ...],
) -> GaitSensitivity:
    """Return the `GaitSensitivity` of a gait and for checked arguments, zero without a gait."""
    zero_without_gait = lambda sensitivity_or_zero: jnp.where(
        limit_cycle_result.outcome == Outcome.STEPPED, sensitivity_or_zero, 0.0
    )
    slope_response = cycle_finder.compute_slope_response(params, limit_cycle_result, measure_names)
    norm, ending_step, beginning_step, later_steps = map(
        zero_without_gait, compute_sensitivity_norms(slope_response)
    )
    return GaitSensitivity(
        norm=norm,
        ending_step=ending_step,
        beginning_step=beginning_step,
        later_steps=later_steps,
        spectral_radius=zero_without_gait(limit_cycle_result.spectral_radius_value),
        outcome=limit_cycle_result.outcome,
        measures=measure_names,
    )
