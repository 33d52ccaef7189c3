"""Figures of a tuning run, and tornado plots of the change of each measure per parameter."""

from collections.abc import Iterable, Mapping

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from vrw_jax.app.figure_style import (
    DARK_GRAY_COLOR,
    LIGHT_GRAY_COLOR,
    OKABE_ITO_AMBER,
    OKABE_ITO_BLUE,
    OKABE_ITO_ORANGE,
    PAGE_FIGURE_WIDTH_INCHES,
    FigureWidth,
    StyledFigure,
    add_figure_legend,
    add_side_legend,
    count_panel_columns,
    draw_markers,
    figure_style,
    find_width_inches,
    format_axis_label,
    make_bar_panels,
    require_dataset_variables,
    typeset_greek_symbols,
)
from vrw_jax.base.checks import check_names, check_positive, check_type, require_known_name
from vrw_jax.models.measures import MEASURES
from vrw_jax.studies.tune_maximization import ACTIVE_BOUND_TOLERANCE, TrialKind
from vrw_jax.studies.tune_result import TuneResult
from vrw_jax.wheel.params import check_parameter_name


@figure_style()
def tuning_figure(tuned: TuneResult, *, width: FigureWidth = None) -> Figure:
    """Return a figure of a tuning run: objective, parameters, and slacks of the constraints.

    Filled symbols are gaits that satisfy every constraint; open symbols are gaits that violate a
    constraint. Dotted lines mark trials without a usable gait, after which the optimizer step was
    shortened.

    Args:
        tuned: result of `vrw.tune`.
        width: "column", "page" or a number of mm; None for the usual width.

    Returns:
        Figure: objective and parameters over the evaluated gaits, and the slacks at start and end.

    Examples:
        >>> bounds = {"damping": (100.0, 215.0)}
        >>> tuned = vrw.tune(vrw.WheelParams(), "dls_fraction", ["damping"], bounds)
        >>> figure = vrw.plot.tuning_figure(tuned)
    """
    check_type("tuned", tuned, TuneResult, "give vrw.tune(params, objective, free, bounds)")
    path_dataset = tuned.path
    n_constraints = path_dataset.sizes["constraint"]
    # Each constraint has one line of text.
    slack_height_inches = 0.19 * n_constraints + 1.0
    width_inches = find_width_inches(width, PAGE_FIGURE_WIDTH_INCHES)
    if has_two_columns := count_panel_columns(width_inches, 3) == 3:  # Names need one column.
        figure = StyledFigure(figsize=(width_inches, max(3.2, slack_height_inches)))
        panel_axes = figure.subplot_mosaic(
            [["objective", "slack"], ["parameters", "slack"]], width_ratios=[1.0, 1.1]
        )
    else:
        panel_heights = [1.8, 1.8, slack_height_inches]
        figure = StyledFigure(figsize=(width_inches, sum(panel_heights)))
        panel_axes = figure.subplot_mosaic(
            [["objective"], ["parameters"], ["slack"]], height_ratios=panel_heights
        )
    panel_axes["objective"].sharex(panel_axes["parameters"])
    _draw_objective_path(panel_axes["objective"], path_dataset)
    parameter_axes = panel_axes["parameters"]
    # The parameters are scaled so that their bounds are 0 and 1.
    for parameter_name, lower_bound, upper_bound in zip(
        path_dataset.attrs["free"].split(),
        path_dataset.attrs["lower"],
        path_dataset.attrs["upper"],
        strict=True,
    ):
        parameter_axes.plot(
            path_dataset.evaluation,
            (path_dataset[parameter_name].values - lower_bound) / (upper_bound - lower_bound),
            marker=".",
            markersize=4.0,
            label=f"${MEASURES[parameter_name].mathtext}$",
        )
    parameter_axes.set_yticks([0.0, 1.0], ["lower\nbound", "upper\nbound"])
    parameter_axes.set(xlabel="gaits evaluated", ylim=(-0.05, 1.05))
    parameter_axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    add_side_legend(parameter_axes)
    _draw_constraint_slacks(panel_axes["slack"], tuned, " " if has_two_columns else "\n")
    return figure


def _draw_objective_path(axes: Axes, path_dataset: xr.Dataset) -> None:
    evaluation_numbers = path_dataset.evaluation.values
    objective_values = path_dataset.objective.values
    is_gait_lost = np.isin(path_dataset.kind.values, (TrialKind.LOST, TrialKind.NOT_FINITE))
    are_constraints_satisfied = path_dataset.breach.values <= ACTIVE_BOUND_TOLERANCE
    axes.plot(
        evaluation_numbers[~is_gait_lost],
        objective_values[~is_gait_lost],
        color=DARK_GRAY_COLOR,
        linewidth=0.7,
        zorder=1,
    )
    for draws_feasible_gaits, fill_color, marker_text in (
        (True, OKABE_ITO_BLUE, "keeps the constraints"),
        (False, "white", "breaks one"),
    ):
        is_marker_drawn = ~is_gait_lost & (are_constraints_satisfied == draws_feasible_gaits)
        draw_markers(
            axes,
            evaluation_numbers[is_marker_drawn],
            objective_values[is_marker_drawn],
            "o",
            OKABE_ITO_BLUE,
            fill_color,
            markersize=4.0,
            label=marker_text,
        )
    legend_text: str | None = "gait or finite value lost, step shortened"
    for evaluation_number in evaluation_numbers[is_gait_lost]:
        axes.axvline(
            evaluation_number,
            color=OKABE_ITO_ORANGE,
            linewidth=0.8,
            linestyle=":",
            label=legend_text,
        )
        legend_text = None  # One line is in the legend.
    axes.set_ylabel(format_axis_label(path_dataset.objective.attrs["long_name"], "{name}"))
    axes.legend(loc="best", fontsize=7.0)


def _draw_constraint_slacks(axes: Axes, tune_result: TuneResult, label_break: str) -> None:
    """Draw bars for the slack of each constraint at the start and at the tuned gait.

    - `label_break`: space or line break in the label of the horizontal axis.
    """
    path_dataset = tune_result.path
    constraint_names = list(map(str, path_dataset.constraint.values))
    slacks = path_dataset.constraint_value.values - path_dataset.margin.values
    relative_parameter_changes = [
        path_dataset[parameter_name].values / float(getattr(tune_result.params, parameter_name))
        - 1.0
        for parameter_name in path_dataset.attrs["free"].split()
    ]
    tuned_evaluation_index = np.nanargmin(np.abs(relative_parameter_changes).sum(axis=0))
    with np.errstate(invalid="ignore"):
        slack_units = np.maximum(np.nanmax(np.abs(slacks), axis=0), 1e-12)
    bar_positions = np.arange(len(constraint_names))[::-1]
    active_constraint_names = {active_constraint.name for active_constraint in tune_result.active}
    for evaluation_index, vertical_offset, bar_color, legend_text in (
        (0, 0.19, LIGHT_GRAY_COLOR, "at the start"),
        (tuned_evaluation_index, -0.19, OKABE_ITO_BLUE, "tuned"),
    ):
        axes.barh(
            bar_positions + vertical_offset,
            slacks[evaluation_index] / slack_units,
            0.36,
            color=bar_color,
            label=legend_text,
            edgecolor=DARK_GRAY_COLOR,
            linewidth=0.3,
        )
    axes.axvline(0.0, color="black", linewidth=0.6)
    constraint_labels = []
    for constraint_name in constraint_names:
        measure_name, _, leg_suffix = constraint_name.partition("[")
        constraint_labels.append(
            typeset_greek_symbols(MEASURES[measure_name].long_name)
            + (f", {leg_suffix[:-1]}" if leg_suffix else "")
        )
    axes.set_yticks(bar_positions, constraint_labels, fontsize=7.0)
    for tick_label, constraint_name in zip(axes.get_yticklabels(), constraint_names, strict=True):
        if constraint_name in active_constraint_names:
            tick_label.set_color(OKABE_ITO_ORANGE)
            tick_label.set_fontweight("bold")
    axes.set(
        xlabel=f"slack, share of the{label_break}largest on the path\n(active in bold)",
        xlim=(min(-0.05, axes.get_xlim()[0]), 1.05),
    )
    axes.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=2)


MAX_DEFAULT_DRAWN_MEASURES = 6
"""Largest number of measures that are drawn by default, chosen because two rows of panels fit a
page.
"""

PARAMETER_ROW_HEIGHT_INCHES = 0.2
"""Height of the bar of one parameter, inches, chosen because the parameter's symbol has that
height.
"""


@figure_style()
def tornado_figure(
    table: xr.Dataset,
    measures: str | Iterable[str] | None = None,
    *,
    spreads: Mapping[str, float] | None = None,
    width: FigureWidth = None,
) -> Figure:
    """Return a figure of the change of each measure with each parameter, with largest changes on
    top.

    Changes are first-order estimates, computed from the derivatives of the gait. By default they
    are in per cent of the measure, for a change of each parameter by 1 %. If `spreads` is given,
    they are in the unit of the measure, for the changes of the parameters in `spreads`. Undefined
    changes, such as for 1 % of a slope of 0, are omitted.

    Args:
        table: dataset that `vrw.sensitivities` returns.
        measures: names of the measures; by default the first six of the table.
        spreads: change of each parameter, by name, in the parameter's unit; other parameters are
            omitted.
        width: "column", "page" or a number of mm; None for the usual width.

    Returns:
        Figure: one panel per measure, with one bar per parameter.

    Raises:
        TypeError, ValueError: if an argument is invalid.

    Examples:
        >>> table = vrw.sensitivities(vrw.WheelParams(), measures=["speed", "dls_fraction"])
        >>> figure = vrw.plot.tornado_figure(table)
        >>> figure = vrw.plot.tornado_figure(table, "speed", spreads={"damping": 10.0})
    """
    require_dataset_variables(
        "table", table, ("derivative", "elasticity"), "give vrw.sensitivities(params)"
    )
    known_measure_names = tuple(map(str, table.measure.values))
    measure_names = known_measure_names[:MAX_DEFAULT_DRAWN_MEASURES]
    if measures is not None:
        measure_names = check_names("measures", measures)
    for measure_name in measure_names:
        require_known_name(measure_name, known_measure_names, "measure of this table")
    if not measure_names:
        raise ValueError('measures is empty, but something is to be drawn: give "speed", say.')
    measure_changes = table.elasticity  # changes in per cent for 1 %
    if spreads is not None:
        known_parameter_names = tuple(map(str, table.parameter.values))
        for parameter_name in spreads:
            check_parameter_name(parameter_name, known_parameter_names, "parameter of this table")
        if not spreads:
            raise ValueError('spreads is empty, but bars need one: give {"damping": 10.0}, say.')
        parameter_changes = [
            check_positive(f"spreads[{parameter_name!r}]", parameter_change)
            for parameter_name, parameter_change in spreads.items()
        ]
        measure_changes = table.derivative.sel(parameter=list(spreads)) * np.array(
            parameter_changes
        )
    panel_height = PARAMETER_ROW_HEIGHT_INCHES * measure_changes.sizes["parameter"] + 0.8
    width_fraction = 0.6 if len(measure_names) == 1 else 1.0
    width_inches = find_width_inches(width, width_fraction * PAGE_FIGURE_WIDTH_INCHES)
    figure, panel_axes = make_bar_panels(width_inches, measure_names, panel_height, 0.3)
    parameter_change_text = "1 %" if spreads is None else "by its spread"
    for axes, measure_name in zip(panel_axes, measure_names, strict=True):
        bars = measure_changes.sel(measure=measure_name)
        bars = bars[np.isfinite(bars.values)]
        bars = bars[np.argsort(-np.abs(bars.values), kind="stable")]
        for change_sign, direction, bar_color in (
            (1.0, "up", OKABE_ITO_BLUE),
            (-1.0, "down", OKABE_ITO_AMBER),
        ):
            axes.barh(
                range(bars.size),
                change_sign * bars.values,
                0.7,
                color=bar_color,
                label=f"parameter {direction} {parameter_change_text}",
            )
        axes.axvline(0.0, color="black", linewidth=0.6)
        parameter_symbols = [f"${MEASURES[str(name)].mathtext}$" for name in bars.parameter.values]
        axes.set_yticks(range(bars.size), parameter_symbols)
        axes.set_ylim(bars.size - 0.5, -0.5)
        change_label = format_axis_label(measure_name, "change of {symbol}")
        axes.set_xlabel("change [%]" if spreads is None else change_label)
    add_figure_legend(figure, panel_axes[0].get_legend_handles_labels()[0], 2)
    return figure
