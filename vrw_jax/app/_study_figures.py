"""Figures of studies: basins, tuning, sensitivities and fits."""

import itertools
from collections.abc import Iterable, Mapping

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from scipy.special import gammaincinv

from vrw_jax.app.figure_style import (
    DARK_GRAY_COLOR,
    LIGHT_GRAY_COLOR,
    OKABE_ITO_AMBER,
    OKABE_ITO_BLUE,
    OKABE_ITO_ORANGE,
    OKABE_ITO_YELLOW,
    PAGE_FIGURE_WIDTH_INCHES,
    FigureWidth,
    StyledFigure,
    add_figure_legend,
    add_side_legend,
    add_wrapped_legend,
    count_panel_columns,
    declare_own_quantities,
    describe_quantity,
    draw_markers,
    draw_outcome_cells,
    figure_style,
    find_width_inches,
    format_axis_label,
    label_lowest_panels,
    make_bar_panels,
    make_outcome_patches,
    make_panel_grid,
    require_dataset_variables,
    require_variables_of_datasets,
    typeset_greek_symbols,
)
from vrw_jax.base.checks import (
    check_names,
    check_positive,
    check_real,
    check_type,
    require_known_name,
)
from vrw_jax.base.results import Outcome
from vrw_jax.base.walker import is_own_walker
from vrw_jax.models.measures import MEASURES
from vrw_jax.studies.fit_result import FitResult
from vrw_jax.studies.tune_maximization import ACTIVE_BOUND_TOLERANCE, TrialKind
from vrw_jax.studies.tune_problem import UPPER_BOUND_PREFIX, restore_sign_of_bound
from vrw_jax.studies.tuning import TuneResult
from vrw_jax.wheel.params import check_parameter_name


@figure_style()
def basin_figure(
    results: list[xr.Dataset], titles: list[str], *, width: FigureWidth = None
) -> Figure:
    """Return a figure of basins of attraction, one panel per result.

    Crosses mark the section states of the gaits. Shades of gray show after how many steps a walk
    reaches the gait, and colors show the outcomes of failed walks.

    Args:
        results: results of `vrw.basin`, each with two axes of starts.
        titles: title of each panel.
        width: "column", "page" or a number of mm; None for the usual width.

    Returns:
        Figure: the panels side by side.

    Examples:
        >>> starts = {"theta_touchdown": 0.09, "dtheta_touchdown": [1.4, 1.6]}
        >>> starts |= {"dL1_touchdown": [-0.1, 0.0]}
        >>> basins = vrw.basin(vrw.WheelParams(), starts)
        >>> figure = vrw.plot.basin_figure([basins], ["Table 1"])
    """
    require_variables_of_datasets(
        "results", results, ("outcome", "attractor"), "give vrw.basin(params, grid)"
    )
    for index, result in enumerate(results):
        if result.attractor.ndim != 2:
            raise ValueError(
                f"results[{index}] has {result.attractor.ndim} axes of starts, but a panel shows "
                "two: give vrw.basin a grid in which two quantities have several values."
            )
    titles = list(check_names("titles", titles, '"Table 1"'))
    if len(titles) != len(results):
        raise ValueError(
            f"titles has {len(titles)} entries, but results has {len(results)}: give one title for "
            "each result."
        )
    results = [result.sortby(list(result.attractor.dims)) for result in results]
    all_outcome_codes = np.concatenate(
        [basin_dataset.outcome.values.ravel() for basin_dataset in results]
    )
    failure_outcome_codes = np.setdiff1d(all_outcome_codes, Outcome.STEPPED).tolist()
    steps_to_gait_by_panel = [
        basin_dataset.steps.where(basin_dataset.attractor >= 0) for basin_dataset in results
    ]
    max_n_steps_to_gait = max(
        1.0, *(float(x.max()) for x in steps_to_gait_by_panel), key=np.nan_to_num
    )
    figure, panel_axes = make_panel_grid(
        find_width_inches(width, PAGE_FIGURE_WIDTH_INCHES),
        len(results),
        2.8,
        0.5,
        len(results),
        sharey=True,
    )
    for axes, basin_dataset, steps_to_gait, panel_title in zip(
        panel_axes, results, steps_to_gait_by_panel, titles, strict=True
    ):
        vertical_axis_name, horizontal_axis_name = map(str, basin_dataset.attractor.dims)
        x, y = basin_dataset[horizontal_axis_name].values, basin_dataset[vertical_axis_name].values
        step_count_image = axes.pcolormesh(
            x,
            y,
            steps_to_gait,
            cmap="Greys_r",
            vmin=0.0,
            vmax=2.2 * max_n_steps_to_gait,
            rasterized=True,
        )
        if failure_outcome_codes:
            draw_outcome_cells(axes, x, y, basin_dataset.outcome.values, failure_outcome_codes)
        axis_names = [horizontal_axis_name, vertical_axis_name]
        if "component" in basin_dataset and {*axis_names} <= {*basin_dataset.component.values}:
            axes.plot(
                *basin_dataset.orbit_state.sel(component=axis_names).values.reshape(-1, 2).T,
                "+",
                color=OKABE_ITO_YELLOW,
                markersize=7.0,
                markeredgewidth=1.6,
            )
        xlabel, ylabel = (format_axis_label(x, "{symbol}", basin_dataset) for x in axis_names)
        axes.set(title=panel_title, xlabel=xlabel)
        if axes.get_subplotspec().is_first_col():
            axes.set_ylabel(ylabel)
    color_bar = figure.colorbar(step_count_image, ax=list(panel_axes), aspect=25, pad=0.01)
    color_bar.set_label("steps until the gait is reached")
    color_bar.ax.set_ylim(0.0, max_n_steps_to_gait)
    add_figure_legend(figure, make_outcome_patches(failure_outcome_codes), 4, fontsize=7.5)
    return figure


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
    own_units = None
    if not tuned.model.is_wheel:
        names = [str(x).removeprefix(UPPER_BOUND_PREFIX) for x in path_dataset.constraint.values]
        objective_unit = path_dataset.objective.attrs.get("units", "1")
        own_units = declare_own_quantities(
            [*names, tuned.objective], [*path_dataset.constraint_unit.values, objective_unit]
        )
    legend_width_inches = (0.4 if has_two_columns else 0.65) * width_inches
    _draw_objective_path(panel_axes["objective"], path_dataset, own_units, legend_width_inches)
    parameter_axes = panel_axes["parameters"]
    # The parameters are scaled so that their bounds are 0 and 1.
    for parameter_name, lower_bound, upper_bound in zip(
        path_dataset.free_parameter.values,
        path_dataset.attrs["lower"],
        path_dataset.attrs["upper"],
        strict=True,
    ):
        parameter_axes.plot(
            path_dataset.evaluation,
            (path_dataset[parameter_name].values - lower_bound) / (upper_bound - lower_bound),
            marker=".",
            markersize=4.0,
            label=f"${describe_quantity(parameter_name, path_dataset).mathtext}$",
        )
    parameter_axes.set_yticks([0.0, 1.0], ["lower\nbound", "upper\nbound"])
    parameter_axes.set(xlabel="gaits evaluated", ylim=(-0.05, 1.05))
    parameter_axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    add_side_legend(parameter_axes)
    label_break = " " if has_two_columns else "\n"
    slack_axes = panel_axes["slack"]
    _draw_constraint_slacks(slack_axes, tuned, own_units, label_break, legend_width_inches)
    return figure


def _draw_objective_path(
    axes: Axes, path_dataset: xr.Dataset, own_units: xr.Dataset | None, legend_width_inches: float
) -> None:
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
    objective_name = path_dataset.objective.attrs["long_name"]
    axes.set_ylabel(format_axis_label(objective_name, "{name}", own_units))
    legend_settings = {"loc": "lower center", "bbox_to_anchor": (0.5, 1.0), "fontsize": 7.0}
    add_wrapped_legend(axes, 3, legend_width_inches, **legend_settings)


def _draw_constraint_slacks(
    axes: Axes,
    tune_result: TuneResult,
    own_units: xr.Dataset | None,
    label_break: str,
    legend_width_inches: float,
) -> None:
    """Draw bars for the slack of each constraint at the start and at the tuned gait.

    Active constraints, whose bars have no length, have a marker.

    - `label_break`: space or line break in the label of the horizontal axis.
    """
    path_dataset = tune_result.path
    constraint_names = list(map(str, path_dataset.constraint.values))
    slacks = path_dataset.constraint_value.values - path_dataset.margin.values
    relative_parameter_changes = [
        path_dataset[parameter_name].values
        / float(tune_result.model.get_parameter(tune_result.params, parameter_name))
        - 1.0
        for parameter_name in path_dataset.free_parameter.values
    ]
    tuned_evaluation_index = np.nanargmin(np.abs(relative_parameter_changes).sum(axis=0))
    with np.errstate(invalid="ignore"):
        slack_units = np.maximum(np.nanmax(np.abs(slacks), axis=0), 1e-12)
    bar_positions = np.arange(len(constraint_names))[::-1]
    # The result names the measure of an upper bound, without the prefix of the constraint.
    active_limits = {(limit.name, limit.limit) for limit in tune_result.active}
    is_active = np.array(
        [
            (name.removeprefix(UPPER_BOUND_PREFIX), restore_sign_of_bound(name, least_value))
            in active_limits
            for name, least_value in zip(constraint_names, path_dataset.margin.values, strict=True)
        ],
        bool,
    )
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
    draw_markers(
        axes,
        (slacks[tuned_evaluation_index] / slack_units)[is_active],
        bar_positions[is_active] - 0.19,
        "D",
        OKABE_ITO_BLUE,
        OKABE_ITO_ORANGE,
        markersize=4.5,
        label="active" if is_active.any() else None,
    )
    constraint_labels = []
    for constraint_name in constraint_names:
        measure_name, _, leg_suffix = constraint_name.partition("[")
        is_upper_bound = measure_name.startswith(UPPER_BOUND_PREFIX)
        measure = describe_quantity(measure_name.removeprefix(UPPER_BOUND_PREFIX), own_units)
        constraint_labels.append(
            typeset_greek_symbols(measure.long_name)
            + (f", {leg_suffix[:-1]}" if leg_suffix else "")
            + (" (upper bound)" if is_upper_bound else "")
        )
    axes.set_yticks(bar_positions, constraint_labels, fontsize=7.0)
    for tick_label, is_label_bold in zip(axes.get_yticklabels(), is_active, strict=True):
        if is_label_bold:
            tick_label.set_color(OKABE_ITO_ORANGE)
            tick_label.set_fontweight("bold")
    axes.set(
        xlabel=f"slack, share of the{label_break}largest on the path\n(active in bold)",
        xlim=(min(-0.05, axes.get_xlim()[0]), 1.05),
    )
    legend_settings = {"loc": "lower center", "bbox_to_anchor": (0.5, 1.0)}
    add_wrapped_legend(axes, 3, legend_width_inches, **legend_settings)


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
    changes, such as for 1 % of a slope of 0 or of a measure that is 0, are omitted.

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
    # changes in per cent for 1 %
    measure_changes = table.elasticity.where(table.parameter_value != 0.0)
    if spreads is not None:
        known_parameter_names = tuple(map(str, table.parameter.values))
        for parameter_name in spreads:
            check_parameter_name(parameter_name, known_parameter_names, "parameter of this table")
        if not spreads:
            raise ValueError('spreads is empty, but bars need one: give {"damping": 10.0}, say.')
        changes = [check_positive(f"spreads[{name!r}]", x) for name, x in spreads.items()]
        measure_changes = table.derivative.sel(parameter=list(spreads)) * np.array(changes)
    panel_height = PARAMETER_ROW_HEIGHT_INCHES * measure_changes.sizes["parameter"] + 0.8
    width_fraction = 0.6 if len(measure_names) == 1 else 1.0
    width_inches = find_width_inches(width, width_fraction * PAGE_FIGURE_WIDTH_INCHES)
    own_units = None
    if "rung" not in table.attrs:  # The library's symbols are those of wheels.
        own_units = declare_own_quantities(table.measure.values, table.measure_unit.values)
    figure, panel_axes = make_bar_panels(width_inches, measure_names, panel_height, 0.3, own_units)
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
        labels = list(map(str, bars.parameter.values))
        if own_units is None:
            labels = [f"${MEASURES[name].mathtext}$" for name in labels]
        axes.set_yticks(range(bars.size), labels)
        axes.set_ylim(max(bars.size, 1) - 0.5, -0.5)
        if not bars.size:
            axes.text(0.5, 0.5, "undefined", ha="center", va="center", transform=axes.transAxes)
        change_label = format_axis_label(measure_name, "change of {symbol}", own_units)
        axes.set_xlabel("change [%]" if spreads is None else change_label)
    add_figure_legend(figure, panel_axes[0].get_legend_handles_labels()[0], 2)
    return figure


def draw_sobol_indices(indices: xr.Dataset, scan: xr.Dataset, width: FigureWidth) -> Figure:
    """Return a figure of the Sobol' indices of a scan, with their confidence intervals."""
    measure_names = list(map(str, indices.measure.values))
    bar_positions = np.arange(indices.sizes["parameter"])
    figure, panel_axes = make_bar_panels(
        find_width_inches(width, PAGE_FIGURE_WIDTH_INCHES),
        measure_names,
        0.26 * len(bar_positions) + 0.5,
        0.6,
        scan,
        sharex=True,
        sharey=True,
    )
    for axes, measure_name in zip(panel_axes, measure_names, strict=True):
        sobol_indices_of_measure = indices.sel(measure=measure_name)
        for sobol_index_name, legend_text, bar_offset, bar_color in (
            ("first_order", "by itself (first order)", -0.19, OKABE_ITO_BLUE),
            ("total", "with all it meets (total)", 0.19, OKABE_ITO_AMBER),
        ):
            sobol_index_values, lower_bounds, upper_bounds = (
                sobol_indices_of_measure[sobol_index_name + name_suffix].values
                for name_suffix in ("", "_lower", "_upper")
            )
            axes.barh(
                bar_positions + bar_offset,
                sobol_index_values,
                0.36,
                color=bar_color,
                label=legend_text,
                xerr=np.maximum(
                    [sobol_index_values - lower_bounds, upper_bounds - sobol_index_values], 0.0
                ),
                error_kw={"elinewidth": 0.7},
            )
        if sobol_indices_of_measure.is_constant_measure:
            axes.text(0.5, 0.5, "constant", ha="center", va="center", transform=axes.transAxes)
        parameter_names = indices.parameter.values
        axes.set_yticks(
            bar_positions,
            [f"${describe_quantity(name, scan).mathtext}$" for name in parameter_names],
        )
        axes.set_xlim(0.0, 1.05)
    panel_axes[0].invert_yaxis()
    label_lowest_panels(panel_axes, "share of the variance")
    add_figure_legend(figure, panel_axes[0].get_legend_handles_labels()[0], 2)
    omitted_samples_percent = 100.0 * indices.attrs["left_out"]
    omitted_rows_note = (
        f"{indices.attrs['rows']:,} rows; {omitted_samples_percent:.1f} % left out, without a gait"
    )
    figure.suptitle(omitted_rows_note, fontsize=8.0)
    return figure


PANEL_HEIGHT_INCHES = 1.7
N_CURVE_POINTS = 100
MAX_DRAWN_PAIRS = 3
"""Largest number of ellipses, those of the pairs with the largest correlations."""


@figure_style()
def fit_figure(result: FitResult, *, level: float = 0.95, width: FigureWidth = None) -> Figure:
    """Return a figure of a fit: measured against fitted numbers, residuals, and ellipses.

    Time series are drawn over time, and sequences over steps. Residuals are in standard errors, and
    a gray band marks two of them. An ellipse contains two estimates with the given probability. A
    batch of data sets shows the estimates of all data sets instead.

    Args:
        result: result of `vrw.fit`.
        level: probability of the ellipses.
        width: "column", "page" or a number of mm; None for the usual width.

    Returns:
        Figure: one panel for each measured column, one for residuals, and the ellipses.

    Raises:
        TypeError, ValueError: if an argument is invalid.

    Examples:
        >>> data = {"period": [0.70, 0.68], "period_error": [0.002], "slope": [0.3, 0.32]}
        >>> data |= {"speed": [0.86, 0.94], "speed_error": [0.01]}
        >>> figure = vrw.plot.fit_figure(vrw.fit(data, vrw.WheelParams(damping=150.0)))
    """
    check_type("result", result, FitResult, "give vrw.fit(data, params)")
    level = check_real("level", level)
    is_batch = result.values.ndim > 1
    if is_batch and len(result.names) == 1:
        raise ValueError(
            "the fits of several data sets have one unknown, but their figure shows pairs of "
            "unknowns: draw result.values."
        )
    table = result.residuals
    correlation = np.abs(np.nan_to_num(result.correlation.values)).reshape(
        -1, len(result.names), len(result.names)
    )[0]
    pairs = sorted(
        itertools.combinations(range(len(result.names)), 2), key=lambda pair: -correlation[pair]
    )[:MAX_DRAWN_PAIRS]
    columns = [] if is_batch else list(result.data.names)
    own_units = _find_own_units(result)
    n_panels = len(columns) + (not is_batch) + len(pairs)
    n_columns = min(3, max(n_panels, 1))
    n_rows = -(-n_panels // n_columns)
    figure = StyledFigure(
        figsize=(find_width_inches(width, PAGE_FIGURE_WIDTH_INCHES), PANEL_HEIGHT_INCHES * n_rows)
    )
    panels = iter(figure.subplots(n_rows, n_columns, squeeze=False).flat)
    position_name = next((x for x in ("time", "step") if x in table.coords), None)
    positions = table[position_name].values if position_name else np.arange(table.sizes["row"])
    position_label = {"time": "time [s]", "step": "step"}.get(str(position_name), "row")
    for name in columns:
        axes = next(panels)
        axes.errorbar(
            positions,
            table[name],
            table[f"{name}_error"],
            fmt=".",
            color=DARK_GRAY_COLOR,
            markersize=3.0,
            elinewidth=0.5,
            label="measured",
        )
        axes.plot(
            positions,
            table[f"{name}_predicted"],
            "-" if position_name == "time" else "_",
            color=OKABE_ITO_BLUE,
            label="fitted",
        )
        ylabel = format_axis_label(name, "{symbol}", own_units)
        axes.set(xlabel=position_label, ylabel=ylabel)
        axes.xaxis.set_major_locator(MaxNLocator(4, integer=position_name != "time"))
    if columns:
        # Above the panels, legends cover no points.
        legend_settings = {"loc": "lower center", "bbox_to_anchor": (0.5, 1.0), "fontsize": 7.0}
        legend_width = 0.8 * figure.get_figwidth() / n_columns
        add_wrapped_legend(axes, 2, legend_width, **legend_settings)
        axes = next(panels)
        axes.axhspan(-2.0, 2.0, color=LIGHT_GRAY_COLOR, zorder=0)
        for name in columns:
            axes.plot(positions, table[f"{name}_residual"], ".", label=name)
        axes.set(xlabel=position_label, ylabel="residual [standard errors]")
        add_wrapped_legend(axes, len(columns), legend_width, **legend_settings)
    for i, j in pairs:
        _draw_ellipse(next(panels), result, i, j, level, own_units)
    for axes in panels:
        axes.remove()
    return figure


def _find_own_units(result: FitResult) -> xr.Dataset:
    """Return the units of all quantities of a walker of the user, or of the unknowns of a wheel
    that the library does not have.
    """
    units = dict(zip(result.names, result.units, strict=True))
    finder = result.problem.finder
    symbols = {name: domain.symbol for name, domain in finder.model.parameter_domains.items()}
    if not is_own_walker(result.model):
        own_names = [name for name in result.names if name not in MEASURES]
        return declare_own_quantities(own_names, [units[name] for name in own_names], symbols)
    measures = {measure.name: measure.unit for measure in finder.described_measures}
    symbols |= {measure.name: measure.symbol for measure in finder.described_measures}
    units = getattr(result.model, "state_units", {}) | measures | units
    units = dict.fromkeys(result.data.names, "1") | units
    return declare_own_quantities(units, units.values(), symbols)


def _draw_ellipse(
    axes: Axes, result: FitResult, i: int, j: int, level: float, own_units: xr.Dataset
) -> None:
    """Draw two estimates with their ellipse, or those of all data sets."""
    values = result.values.reshape(-1, len(result.names))
    if len(values) > 1:
        axes.plot(values[:, i], values[:, j], ".", color=OKABE_ITO_BLUE, markersize=2.0)
    else:
        covariance = result.covariance[np.ix_([i, j], [i, j])]
        angles = np.linspace(0.0, 2.0 * np.pi, N_CURVE_POINTS)
        # chi2 of two degrees of freedom
        radius = np.sqrt(2.0 * gammaincinv(1.0, level))
        eigenvalues, directions = np.linalg.eigh(covariance)
        half_axes = directions * np.sqrt(np.maximum(eigenvalues, 0.0))
        ellipse = values[0, [i, j], None] + radius * half_axes @ [np.cos(angles), np.sin(angles)]
        axes.plot(*ellipse, color=OKABE_ITO_BLUE)
        axes.plot(values[0, i], values[0, j], "+", color=OKABE_ITO_ORANGE)
    axes.set(
        xlabel=format_axis_label(result.names[i], "{symbol}", own_units),
        ylabel=format_axis_label(result.names[j], "{symbol}", own_units),
    )
