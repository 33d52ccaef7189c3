"""Figure of a tuning run: its path, and the slack of each constraint at its start and end."""

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from vrw_jax.figures.style import (
    BLUE,
    DARK_GRAY,
    LIGHT_GRAY,
    ORANGE,
    PAGE_WIDTH_INCHES,
    draw_marks,
    figure_style,
    format_axis_label,
    typeset_symbols,
)
from vrw_jax.measures import MEASURES
from vrw_jax.tuning import MAXIMIZATION_OPTIONS, TrialKind, TuneResult
from vrw_jax.validation import check_type


@figure_style()
def tuning_figure(tuned: TuneResult) -> Figure:
    """Return a figure of a tuning run: objective, parameters, and slack of the constraints.

    Filled symbols satisfy every constraint, and open ones violate one. Dotted lines are trials that
    lost the gait, after which the step was shortened.

    Args:
        tuned: result of `vrw.tune`.

    Returns:
        Figure: the path over the evaluated gaits, and the slack at start and end.

    Examples:
        >>> bounds = {"damping": (100.0, 215.0)}
        >>> tuned = vrw.tune(vrw.WheelParams(), "dls_fraction", ["damping"], bounds)
        >>> figure = vrw.plot.tuning_figure(tuned)
    """
    check_type("tuned", tuned, TuneResult, "give vrw.tune(params, objective, free, bounds)")
    path = tuned.path
    n_constraints = path.sizes["constraint"]
    height_inches = max(3.2, 0.19 * n_constraints + 1.0)  # Each constraint has one row of text.
    figure = Figure(figsize=(PAGE_WIDTH_INCHES, height_inches))
    panels = figure.subplot_mosaic(
        [["objective", "slack"], ["parameters", "slack"]], width_ratios=[1.0, 1.1]
    )
    panels["objective"].sharex(panels["parameters"])
    _draw_objective(panels["objective"], path)
    _draw_parameters(panels["parameters"], path)
    _draw_slack(panels["slack"], tuned)
    return figure


def _draw_objective(axes: Axes, path: xr.Dataset) -> None:
    """Draw the objective over the evaluated gaits."""
    evaluation_numbers, value = path.evaluation.values, path.objective.values
    is_gait_lost = np.isin(path.kind.values, (TrialKind.LOST, TrialKind.NOT_FINITE))
    keeps_constraints = path.breach.values <= MAXIMIZATION_OPTIONS.active_bound_tolerance
    axes.plot(
        evaluation_numbers[~is_gait_lost],
        value[~is_gait_lost],
        color=DARK_GRAY,
        linewidth=0.7,
        zorder=1,
    )
    for is_feasible, fill_color, text in (
        (True, BLUE, "keeps the constraints"),
        (False, "white", "breaks one"),
    ):
        is_drawn = ~is_gait_lost & (keeps_constraints == is_feasible)
        draw_marks(
            axes,
            evaluation_numbers[is_drawn],
            value[is_drawn],
            "o",
            BLUE,
            fill_color,
            markersize=4.0,
            label=text,
        )
    if is_gait_lost.any():
        for evaluation_index, evaluation in enumerate(evaluation_numbers[is_gait_lost]):
            legend_text = (
                "gait or finite value lost, step shortened" if evaluation_index == 0 else None
            )
            axes.axvline(evaluation, color=ORANGE, linewidth=0.8, linestyle=":", label=legend_text)
    axes.set_ylabel(format_axis_label(path.objective.attrs["long_name"], "{name}"))
    axes.legend(loc="best", fontsize=7.0)


def _draw_parameters(axes: Axes, path: xr.Dataset) -> None:
    """Draw the parameters over the evaluated gaits, scaled to their bounds."""
    lower, upper = np.asarray(path.attrs["lower"]), np.asarray(path.attrs["upper"])
    for i, name in enumerate(path.attrs["free"].split()):
        scaled_values = (path[name].values - lower[i]) / (upper[i] - lower[i])
        axes.plot(
            path.evaluation,
            scaled_values,
            marker=".",
            markersize=4.0,
            label=f"${MEASURES[name].mathtext}$",
        )
    axes.set_ylim(-0.05, 1.05)
    axes.set_yticks([0.0, 1.0], ["lower\nbound", "upper\nbound"])
    axes.set_xlabel("gaits evaluated")
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))


def _draw_slack(axes: Axes, result: TuneResult) -> None:
    """Draw the slack of each constraint at the start and at the tuned gait."""
    path = result.path
    names = [str(name) for name in path.constraint.values]
    values = path.constraint_value.values
    margin = path.margin.values
    tuned_index = np.nanargmin(
        np.sum(
            [
                np.abs(path[name].values / float(getattr(result.params, name)) - 1.0)
                for name in path.attrs["free"].split()
            ],
            axis=0,
        )
    )
    with np.errstate(invalid="ignore"):
        slack_scale = np.maximum(np.nanmax(np.abs(values - margin), axis=0), 1e-12)
    positions = np.arange(len(names))[::-1]
    active_names = {active_constraint.name for active_constraint in result.active}
    for slack_fraction, vertical_offset, color, text in (
        ((values[0] - margin) / slack_scale, 0.19, LIGHT_GRAY, "at the start"),
        ((values[tuned_index] - margin) / slack_scale, -0.19, BLUE, "tuned"),
    ):
        axes.barh(
            positions + vertical_offset,
            slack_fraction,
            0.36,
            color=color,
            label=text,
            edgecolor=DARK_GRAY,
            linewidth=0.3,
        )
    axes.axvline(0.0, color="black", linewidth=0.6)
    texts = []
    for name in names:
        measure_name, _, leg_suffix = name.partition("[")
        texts.append(
            typeset_symbols(MEASURES[measure_name].long_name)
            + (f", {leg_suffix[:-1]}" if leg_suffix else "")
        )
    axes.set_yticks(positions, texts, fontsize=7.0)
    for tick, name in zip(axes.get_yticklabels(), names, strict=True):
        if name in active_names:
            tick.set_color(ORANGE)
            tick.set_fontweight("bold")
    axes.set_xlim(min(-0.05, axes.get_xlim()[0]), 1.05)
    axes.set_xlabel("slack, share of the largest on the path\n(active in bold)")
    axes.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=2)
