"""Gait sensitivity norms, and sizes of basins, of one gait and along a branch of gaits.

The gait sensitivity norm is the variation of a gait's measures on slightly uneven ground.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from vrw_jax.base.checks import (
    check_int,
    check_names,
    check_type,
    has_traced_leaf,
    require_known_name,
)
from vrw_jax.base.elementwise import Scalar
from vrw_jax.base.options import StepOptions
from vrw_jax.base.progress import announce_wait
from vrw_jax.base.results import (
    AbstractPrintable,
    LabelAndText,
    Measure,
    NoGaitError,
    Outcome,
    describe_step_ending,
    format_each_batch_element,
    format_outcome_counts,
)
from vrw_jax.base.results import xarray as xr
from vrw_jax.base.walker import is_own_walker
from vrw_jax.branches.branch import Branch
from vrw_jax.gaits.cycle import CycleOptions
from vrw_jax.gaits.derivatives import compute_sensitivity_norms
from vrw_jax.gaits.finder import AbstractGaitFinder
from vrw_jax.gaits.gait_search import UserCycleGuess, limit_cycle, resolve_finder, resolve_model
from vrw_jax.models.stepping import ModelLike, convert_model_argument, convert_step_options
from vrw_jax.studies.basins import (
    MAX_ARRIVAL_DISTANCE,
    StableGait,
    StartBox,
    compute_basin_share,
    parse_start_box,
)
from vrw_jax.studies.stride_pushes import (
    check_disturbed_coordinate,
    compute_smallest_disturbance,
    find_coordinate_unit,
)


class GaitSensitivity(AbstractPrintable):
    """Gait sensitivity norms of several measures, each in the measure's unit per rad of slope.

    The norm is the ratio of two standard deviations: that of a measure in a long walk over
    independent slopes, and that of the slopes. The ratio is taken in the limit of small deviations.
    The norm is infinite if the gait is not stable. A line of the ground joins two footholds. The
    squares of `ending_step`, `beginning_step` and `later_steps` sum to the square of the norm.

    For a walker of yours, the deviations are those of the slopes of steps, in rad, or of the heights
    of footholds, in m.

    - `norm`: norms in the order of `measures`;
    - `ending_step`: signed response of the step that ends on a line to the slope of that line;
    - `beginning_step`: signed response of the step that begins on a line to the slope of that line;
    - `later_steps`: square root of the sum of the squared responses of all later steps to the slope
      of the line;
    - `spectral_radius`: spectral radius of the gait's return map;
    - `outcome`: Outcome.STEPPED, or the reason why there is no gait; without a gait, all other
      numbers are zero;
    - `measures`: names of the measures;
    - `described_measures`, `disturbance_unit`: unit and meaning of each measure, and the unit of
      the disturbance.

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
    described_measures: tuple[Measure, ...] = eqx.field(static=True)
    disturbance_unit: str = eqx.field(static=True)

    @property
    def measures(self) -> tuple[str, ...]:
        """Return the names of the measures."""
        return tuple(measure.name for measure in self.described_measures)

    @property
    def ending(self) -> Any:
        """Return a sentence on whether the norms are finite, with the reason if they are not."""
        return format_each_batch_element(_describe_norms, self.outcome, self.spectral_radius)

    def summary_rows(self) -> list[LabelAndText]:
        """Return pairs of label and text for the norm of each measure and the responses that it
        sums.
        """
        if np.ndim(self.outcome):
            return [("gaits", format_outcome_counts(self.outcome, Outcome))]
        if self.outcome != Outcome.STEPPED:
            return [("outcome", self.ending)]
        share_text_rows = []
        for measure_index, measure_definition in enumerate(self.described_measures):
            unit = measure_definition.display_unit
            sensitivity_unit = f"{unit} per {self.disturbance_unit}".strip()
            place = "foothold" if self.disturbance_unit == "m" else "line"
            norm_parts_text = (
                f"step that ends on the disturbed {place}: "
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


def _describe_norms(outcome: int, spectral_radius: float) -> str:
    """Return a sentence on whether the norms of one gait are finite."""
    if outcome != Outcome.STEPPED:
        return describe_step_ending(outcome, Outcome)
    if spectral_radius < 1.0:
        return "The gait is stable, and the norms are finite."
    return "The gait is not stable: deviations grow from step to step, and no norm is finite."


@announce_wait("the gait and its response to slopes", "10 s")
def gait_sensitivity(
    params: Any,
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

    A walker of yours declares by `ground` which of its parameters is the slope of a step or the
    rise of a foothold, see `AbstractWalker`. If it declares no slope, heights of the footholds are
    independent.

    Args:
        params: parameters of the wheel, or of a walker of yours; the slope is the mean slope.
        measures: names of measures of a gait step, such as "period", "speed" or a margin. For a
            walker of yours, "period" and its own measures.
        model: model of the wheel; by default the paper's, `ViscoelasticWheel()`.
        guess: as in `limit_cycle`.
        options: as in `limit_cycle`.

    Returns:
        A `GaitSensitivity`: the norm of each measure, and its parts.

    Raises:
        TypeError, ValueError: if an argument is invalid or there is no gait.

    Examples:
        >>> print(vrw.gait_sensitivity(vrw.WheelParams(), ["period", "speed"]).norm.round(3))
        [3.509 3.757]
        >>> norm = lambda p: vrw.gait_sensitivity(p, "period").norm[0]
        >>> print(f"{jax.grad(norm)(vrw.WheelParams()).damping:.5f} s/rad per N s/m")
        0.01431 s/rad per N s/m
    """
    if getattr(model, "leg_period", 1) > 1:
        raise ValueError(
            "the legs alternate, but gait sensitivity norms are those of gaits of one step: give "
            "one law for all legs, or take vrw.first_passage."
        )
    if not is_own_walker(model):
        model = resolve_model(params, model)
    cycle_finder = resolve_finder(params, model, options, guess=guess)
    measure_names = parse_sensitivity_measures(cycle_finder, measures)
    limit_cycle_result: Any = limit_cycle(params, guess=guess, model=model, options=options)
    if (
        not has_traced_leaf(limit_cycle_result)
        and int(limit_cycle_result.outcome) != Outcome.STEPPED
    ):
        raise NoGaitError(
            f"there is no gait whose sensitivity could be computed: {limit_cycle_result.why} Take "
            "parameters for which vrw.limit_cycle finds a gait."
        )
    return compute_gait_sensitivity(cycle_finder, params, limit_cycle_result, measure_names)


def parse_sensitivity_measures(
    cycle_finder: AbstractGaitFinder, measures: str | Sequence[str]
) -> tuple[str, ...]:
    """Return the names of measures of a gait step, each once; raise an error for other names."""
    measure_names = tuple(dict.fromkeys(check_names("measures", measures)))
    known_names = cycle_finder.step_measures
    for measure_name in measure_names or ("nothing",):
        kind = f"measure of a step of {cycle_finder.model.model_name} wheels"
        if not cycle_finder.model.is_wheel:
            kind = "measure of a step of this walker"
        require_known_name(measure_name, known_names, kind)
    return measure_names


def compute_gait_sensitivity(
    cycle_finder: AbstractGaitFinder,
    params: Any,
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
        described_measures=tuple(map(cycle_finder.get_measure, measure_names)),
        disturbance_unit=cycle_finder.disturbance_unit,
    )


@announce_wait("gaits and walks", "10 s")
def measure_basins(
    branch: Branch,
    box: StartBox | None = None,
    *,
    model: ModelLike | None = None,
    options: StepOptions | None = None,
    n_points: int = 16,
    n_starts: int = 1024,
    max_steps: int = 200,
    coordinate: str | None = None,
) -> xr.Dataset:
    """Return the sizes of the basins of attraction of the stable gaits on a branch.

    The result has at most `n_points` points, evenly spaced over the points of the branch, both ends
    included. Its coordinate is the parameter of the branch. Variables are NaN at points of unstable
    gaits, and of gaits so slow that walks do not arrive within `max_steps`. With a `box`, the
    variables include `basin_share` and `basin_share_error` (see `basin_share`). For models of the
    wheel that can start within a step, and for a `HybridSystem` with a `coordinate`, the variables
    include `smallest_disturbance` and `smallest_disturbance_error` (see `smallest_disturbance`).

    Args:
        branch: a branch of gaits, from `continue_branch`.
        box: bounds of the starts, as in `basin_share`; without a box, no shares are computed.
        model: the model of the branch, if it is not the paper's. A walker of yours may be given.
        options: numerical options of the gait steps.
        n_points: largest number of points.
        n_starts: number of start states at each point.
        max_steps: largest number of gait steps of a walk.
        coordinate: for a `HybridSystem`, name of the coordinate that disturbances change.

    Returns:
        A dataset with the dimension `point`.

    Raises:
        TypeError, ValueError: if an argument is invalid, or if the branch has another model.

    Examples:
        >>> branch = vrw.continue_branch(vrw.WheelParams(), "damping", (190.0, 200.0))
        >>> vrw.measure_basins(branch, n_points=2).smallest_disturbance.values.round(3).tolist()
        [0.126, 0.109]
    """
    checked_model = _check_branch_model(branch, model)
    checked_step_options = convert_step_options(options)
    n_starts, max_steps = check_int("n_starts", n_starts), check_int("max_steps", max_steps)
    box_bounds = None if box is None else parse_start_box(box, checked_model)
    variables = {}
    if box_bounds:
        variables["basin_share"] = ("1", "share of the box of starts that ends up on the gait")
        variables["basin_share_error"] = ("1", "standard error of that share")
    if coordinate is not None or (
        checked_model.is_wheel and checked_model.can_start_within_gait_step
    ):
        coordinate = check_disturbed_coordinate(checked_model, coordinate)
        unit = find_coordinate_unit(checked_model, coordinate)
        meaning = f"smallest change of {coordinate} that leaves the basin"
        variables["smallest_disturbance"] = (unit, meaning)
        variables["smallest_disturbance_error"] = (unit, "error of that change")
    if not variables:
        raise ValueError(
            "box and coordinate are None, so that there is nothing to measure: give a box of "
            "starts, or for a HybridSystem the coordinate that disturbances change."
        )

    def measure_gait(gait: StableGait) -> list[float]:
        values: list[float] = []
        if box_bounds:
            share = compute_basin_share(gait, box_bounds, n_starts, max_steps)
            values += [share.share, share.share_error]
        if coordinate is not None:
            disturbance = compute_smallest_disturbance(gait, None, max_steps, coordinate)
            values += [disturbance.size, disturbance.size_error]
        return values

    points = _select_branch_points(branch, n_points)
    remaining_distances = branch.dataset.spectral_radius.values ** (max_steps / branch.period_n)
    rows = [
        measure_gait(_make_branch_gait(branch, i, checked_model, checked_step_options))
        if remaining_distances[i] <= MAX_ARRIVAL_DISTANCE
        else [np.nan] * len(variables)
        for i in points
    ]
    return _make_branch_dataset(branch, points, rows, variables, "Basins of the gaits")


@announce_wait("gaits and their response to slopes", "10 s")
def measure_gait_sensitivity(
    branch: Branch,
    measures: str | Sequence[str],
    *,
    model: ModelLike | None = None,
    options: CycleOptions | StepOptions | None = None,
    n_points: int | None = None,
) -> xr.Dataset:
    """Return the gait sensitivity norms of measures along a branch.

    The result has at most `n_points` points, evenly spaced over the points of the branch, both ends
    included. Its coordinate is the parameter of the branch. The variable
    `gait_sensitivity_<measure>` contains the norm of one measure, in the measure's unit per rad, or
    per m (see `gait_sensitivity`). The norm is infinite at points of unstable gaits. Next to a fold
    two gaits may be too close for `limit_cycle` to separate. The norm is then NaN.

    Args:
        branch: a branch of gaits of one step, from `continue_branch`.
        measures: names of measures of a gait step, such as "period", "speed" or a margin.
        model: the model of the branch, if it is not the paper's. A walker of yours may be given,
            whose `ground` is declared.
        options: as in `limit_cycle`.
        n_points: largest number of points; by default all points of the branch.

    Returns:
        A dataset with the dimension `point`.

    Raises:
        TypeError, ValueError: if an argument is invalid, or if the branch has another model.

    Examples:
        >>> branch = vrw.continue_branch(vrw.WheelParams(), "damping", (190.0, 200.0))
        >>> norms = vrw.measure_gait_sensitivity(branch, "period", n_points=2)
        >>> norms.gait_sensitivity_period.values.round(3).tolist()
        [3.365, 3.509]
    """
    checked_model = _check_branch_model(branch, model)
    if branch.period_n > 1:
        raise ValueError(
            f"the gaits of the branch repeat after {branch.period_n} steps, but the norm is that "
            "of gaits of one step: continue a branch with period_n=1, and one law for all legs."
        )
    measure_names, rows = check_names("measures", measures), []
    points = _select_branch_points(branch, n_points)
    for i in points:
        gait = _make_branch_gait(branch, i, checked_model, StepOptions())
        guess = gait.section_states[0]
        cycle_finder = resolve_finder(gait.params, gait.model, options, guess=guess)
        measure_names = parse_sensitivity_measures(cycle_finder, measure_names)
        cycle: Any = limit_cycle(gait.params, guess=guess, model=gait.model, options=options)
        is_same_gait = (
            int(cycle.outcome) == Outcome.STEPPED
            and gait.is_on_gait(np.asarray(cycle.section_state)[None])[0]
        )
        row: Any = [np.nan] * len(measure_names)
        if is_same_gait:
            row = compute_gait_sensitivity(cycle_finder, gait.params, cycle, measure_names).norm
        rows.append(row)
    variables = {
        f"gait_sensitivity_{measure.name}": (
            f"{measure.unit} per {cycle_finder.disturbance_unit}",
            f"gait sensitivity norm of {measure.long_name}",
        )
        for measure in map(cycle_finder.get_measure, measure_names)
    }
    return _make_branch_dataset(branch, points, rows, variables, "Gait sensitivity norms")


def _check_branch_model(branch: Branch, model: ModelLike | None) -> Any:
    """Return the model, or raise an error if the branch has another one."""
    check_type("branch", branch, Branch, "give the result of vrw.continue_branch")
    is_own, branch_model = is_own_walker(model), branch.dataset.attrs.get("model")
    checked_model: Any = model if is_own else convert_model_argument(model)
    if is_own and branch_model is None and branch.params is not None:
        return model
    if branch_model is None and branch.params is None:
        raise ValueError(
            "the branch is one of a map or without gaits, but basins and norms are those of gaits: "
            "give the result of vrw.continue_branch for a walker with a gait."
        )
    if is_own or branch_model != repr(checked_model):
        raise ValueError(
            f"the branch is one of {branch_model or 'a walker of yours'}, but model is "
            f"{checked_model!r}: give the model of the branch."
        )
    return checked_model


def _select_branch_points(branch: Branch, n_points: int | None) -> list[int]:
    """Return the indices of evenly spaced points of a branch, of all if `n_points` is None."""
    n_branch_points = len(branch.values)
    if not n_branch_points:
        raise ValueError(
            f"the branch has no gait: {branch.ending} Take a walker for which vrw.limit_cycle "
            "finds a gait."
        )
    if n_points is not None:
        n_points = min(check_int("n_points", n_points), n_branch_points)
    spaced_points = np.linspace(0, n_branch_points - 1, n_points or n_branch_points)
    return np.unique(spaced_points.round().astype(int)).tolist()


def _make_branch_gait(branch: Branch, point: int, model: Any, options: StepOptions) -> StableGait:
    """Return the gait at a point of a branch, stable or not."""
    value = jnp.asarray(branch.values[point], jnp.result_type(*jax.tree.leaves(branch.params)))
    model, params = model.with_parameter(branch.params, branch.parameter, value)
    section_state = branch.section_states[point]
    return StableGait.from_section_state(params, model, options, section_state, branch.period_n)


def _make_branch_dataset(
    branch: Branch,
    points: list[int],
    rows: list[Any],
    variables: Mapping[str, tuple[str, str]],
    title: str,
) -> xr.Dataset:
    """Return a dataset over points of a branch.

    - `rows`: values of all variables at each point;
    - `variables`: unit and meaning of each variable.
    """
    parameter = branch.dataset[branch.parameter]
    columns = np.array(rows, float).T
    return xr.Dataset(
        {
            name: ("point", values, {"units": unit, "long_name": meaning})
            for (name, (unit, meaning)), values in zip(variables.items(), columns, strict=True)
        },
        {branch.parameter: ("point", branch.values[points], parameter.attrs)},
        branch.dataset.attrs | {"title": f"{title} along {branch.parameter}"},
    )
