"""Figures of branches with special points, of basins, of tuning runs, and tornado plots."""

import itertools
from collections.abc import Iterable, Mapping

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from vrw_jax.app.figure_style import (
    DARK_GRAY_COLOR,
    LEG_1_COLOR,
    LEG_2_COLOR,
    LIGHT_GRAY_COLOR,
    OKABE_ITO_AMBER,
    OKABE_ITO_BLUE,
    OKABE_ITO_GREEN,
    OKABE_ITO_ORANGE,
    OKABE_ITO_PINK,
    OKABE_ITO_SKY_BLUE,
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
    draw_panel_letter,
    figure_style,
    find_width_inches,
    format_axis_label,
    format_value_label,
    label_lowest_panels,
    make_bar_panels,
    make_outcome_patches,
    make_panel_grid,
    require_dataset_variables,
    require_variables_of_datasets,
    typeset_greek_symbols,
)
from vrw_jax.base.checks import check_names, check_positive, check_type, require_known_name
from vrw_jax.base.outcomes import Outcome
from vrw_jax.branches.branch import Branch, SpecialPoint
from vrw_jax.models.measures import MEASURES, describe_violation
from vrw_jax.studies.tune_maximization import ACTIVE_BOUND_TOLERANCE, TrialKind
from vrw_jax.studies.tune_problem import UPPER_BOUND_PREFIX, restore_sign_of_bound
from vrw_jax.studies.tuning import TuneResult
from vrw_jax.wheel.params import check_parameter_name

BRANCH_END_COLOR = OKABE_ITO_PINK
"""Color that marks the end of a branch, chosen because no curve has this color."""

SPECIAL_POINT_LINE_STYLE = (0, (1, 1.2))
"""Dotted line style that marks a special point, chosen because no curve has this style."""

SPECIAL_POINT_COLORS = {
    "lost": BRANCH_END_COLOR,
    "border_collision": OKABE_ITO_GREEN,
    "number_of_force_peaks_changes": OKABE_ITO_GREEN,
}
"""Colors of special points by kind. Other kinds, which change the stability, are black."""

MULTIPLIER_PANEL = ("moduli of multipliers", {"spectral_radius": "black"})
"""Panel of every branch figure: the label, and the color of each measure in the panel."""
COMMON_BRANCH_PANELS = (("DLS fraction", {"dls_fraction": LEG_1_COLOR}), MULTIPLIER_PANEL)
"""Panels of the figures of all branches of gaits."""
PAPER_BRANCH_PANELS = (
    *COMMON_BRANCH_PANELS,
    (
        f"${MEASURES['lambda_2_plus'].mathtext}$, ${MEASURES['lambda_4_plus'].mathtext}$ [N]",
        {"lambda_2_plus": LEG_1_COLOR, "lambda_4_plus": LEG_2_COLOR},
    ),
    ("clearance in SLS-I [mm]", {"clearance_sls1": LEG_2_COLOR}),
)
"""Panels of the figure of a branch that was computed with the paper's model."""
OTHER_MODEL_BRANCH_PANELS = (
    *COMMON_BRANCH_PANELS,
    ("walking speed [m/s]", {"speed": "black"}),
    ("step period [s]", {"period": "black"}),
)
"""Panels of the figure of a branch that was computed with a model without the paper's
indicators.
"""
STABILITY_MEASURES = ("spectral_radius", "spectral_margin")
MAX_FURTHER_BRANCH_PANELS = 6
"""Largest number of panels of period, margins and measures of a walker of the user, chosen because
four rows of panels fill a page.
"""
MULTIPLIER_AXIS_ENDS = (1.2, 3.0)
"""Smallest and largest upper end of the axis of multipliers of a map. They are chosen because the
limit of stability, 1, then lies well inside the panel.
"""
COMPONENT_COLORS = (
    LEG_1_COLOR, LEG_2_COLOR, OKABE_ITO_SKY_BLUE, OKABE_ITO_AMBER, DARK_GRAY_COLOR, "black",
)  # fmt: skip
"""Colors of the components of a fixed point of a map, in turn."""


@figure_style()
def branch_figure(branch: Branch, *, width: FigureWidth = None) -> Figure:
    """Return a figure of a branch and its special points.

    The panels show the DLS fraction, the moduli of multipliers, indicators and clearance. For
    models of the wheel other than the paper's, speed and period replace indicators and clearance.
    Measures of your own on a branch of wheels are not drawn. For maps and walkers of your own, the
    panels show the fixed points and the moduli of multipliers, and then the period, margins and
    measures, of these the first six. A label states the largest multiplier if it lies beyond the
    axis. Curves are solid where gaits are stable, and dashed where gaits are unstable. Special
    points are numbered from left to right.

    Args:
        branch: result of `vrw.continue_branch` or `vrw.continue_map`.
        width: "column", "page" or a number of mm; None for the usual width.

    Returns:
        Figure: panels with the parameter on the horizontal axis, in SI units.

    Raises:
        TypeError, ValueError: if the branch has no point, or an argument is no branch or width.

    Examples:
        >>> branch = vrw.continue_branch(vrw.WheelParams(), "damping", (190.0, 230.0))
        >>> figure = vrw.plot.branch_figure(branch)
    """
    check_type("branch", branch, Branch, "give vrw.continue_branch(params, name, bounds)")
    if not branch.values.size:
        raise ValueError(
            f"the branch has no point to draw: {branch.ending} Start it at a gait or fixed point."
        )
    dataset, is_map = branch.dataset, "x" in branch.dataset
    special_points = sorted(branch.special_points, key=lambda special_point: special_point.value)
    has_dls_indicators = "lambda_2_plus" in dataset
    panels: tuple[BranchPanel, ...] = OTHER_MODEL_BRANCH_PANELS
    if has_dls_indicators:
        panels = PAPER_BRANCH_PANELS
    elif is_map:
        dataset, panels = _describe_map_panels(branch)
    legend_height = 0.32 + 0.16 * -(-len(special_points) // 2)
    width_inches = find_width_inches(width, PAGE_FIGURE_WIDTH_INCHES)
    figure, panel_axes = make_panel_grid(
        width_inches, len(panels), 1.84, legend_height, 2, sharex=True
    )
    for axes, panel, letter in zip(panel_axes, panels, "abcdefgh", strict=False):
        draw_panel_letter(axes, letter)
        _draw_branch_panel(axes, panel, branch, dataset)
        _draw_special_points(axes, special_points, draws_numbers=letter in "ab")
    draw_line = lambda axes, y: axes.axhline(y, color=DARK_GRAY_COLOR, linewidth=0.5)
    first_axes, multiplier_axes, *other_axes = panel_axes
    draw_line(multiplier_axes, 1.0)
    multiplier_axes.set_ylim(0.0, None)
    if is_map:
        _limit_multiplier_axis(multiplier_axes, float(np.nanmax(np.abs(branch.multipliers))))
        for axes, (_, colors) in zip(other_axes, panels[2:], strict=False):
            if np.ptp(np.sign(dataset[next(iter(colors))].values)) > 1.0:  # margins, for example
                draw_line(axes, 0.0)
        component_colors = panels[0][1]
        if 1 < len(component_colors) <= len(COMPONENT_COLORS):
            for name, color in component_colors.items():
                first_axes.plot([], [], color=color, label=name)
            first_axes.legend()
    if has_dls_indicators:
        force_axes, clearance_axes = other_axes
        for axes in other_axes:
            draw_line(axes, 0.0)
        for name, color in PAPER_BRANCH_PANELS[2][1].items():
            force_axes.plot([], [], color=color, label=f"${MEASURES[name].mathtext}$")
        force_axes.legend(loc="center left")
        clearance_mm = 1e3 * dataset.clearance_sls1.values
        clearance_axes.set_yscale("symlog", linthresh=0.1)
        clearance_axes.set_ylim(
            2.0 * min(clearance_mm.min(), -0.1), 2.0 * max(clearance_mm.max(), 0.1)
        )
    label_lowest_panels(panel_axes, format_axis_label(branch.parameter, dataset=dataset))
    _add_branch_legend(figure, special_points, branch)
    return figure


BranchPanel = tuple[str, dict[str, str]]
"""Label of a panel of a branch figure, and the color of each measure in the panel."""


def _describe_map_panels(branch: Branch) -> tuple[xr.Dataset, tuple[BranchPanel, ...]]:
    """Return the panels of a branch of fixed points, and its dataset with the labels of their
    components as names.
    """
    dataset = branch.dataset
    further_names = [
        str(name)
        for name in dataset.data_vars
        if dataset[name].dims == ("point",) and name not in STABILITY_MEASURES
    ]
    components = {
        _label_component(values, number): ("point", values.values)
        for number, values in enumerate(dataset.x.transpose("component", "point"), 1)
    }
    label = "section coordinates" if "component" in dataset.coords else "fixed point"
    if len(components) == 1:
        (label,) = components
    dataset = dataset.drop_vars("component_unit", errors="ignore").assign(components)
    return dataset, (
        (label, dict(zip(components, itertools.cycle(COMPONENT_COLORS), strict=False))),
        MULTIPLIER_PANEL,
        *(
            (format_axis_label(name, "{symbol}", dataset), {name: "black"})
            for name in further_names[:MAX_FURTHER_BRANCH_PANELS]
        ),
    )


def _draw_branch_panel(axes: Axes, panel: BranchPanel, branch: Branch, dataset: xr.Dataset) -> None:
    """Draw curves that are solid where gaits are stable, and dashed where they are unstable."""
    label, color_by_name = panel
    changes = (np.flatnonzero(np.diff(branch.stable.astype(int))) + 1).tolist()
    for name, color in color_by_name.items():
        values = dataset[name].values
        if name == "clearance_sls1":
            # The clearance is in mm. The line has a gap where the clearance jumps because a local
            # minimum vanishes.
            values = 1e3 * values
            values[1:][values[:-1] * values[1:] < 0.0] = np.nan
        if name == "spectral_radius":
            values = np.abs(branch.multipliers)
        # A piece of equal stability ends at the point where the next piece starts.
        for start, next_start in itertools.pairwise([0, *changes, branch.values.size]):
            piece = slice(start, next_start + 1)
            style = "-" if branch.stable[start] else "--"
            axes.plot(branch.values[piece], values[piece], style, color=color)
    axes.set_ylabel(label)


def _limit_multiplier_axis(axes: Axes, largest_modulus: float) -> None:
    """Limit the axis of multipliers so that the limit of stability, 1, is well visible."""
    highest_modulus = float(np.clip(1.05 * largest_modulus, *MULTIPLIER_AXIS_ENDS))
    axes.set_ylim(0.0, highest_modulus)
    if largest_modulus > highest_modulus:
        axes.set_ylabel(f"{MULTIPLIER_PANEL[0]}\n(up to {largest_modulus:.3g})")


def _label_component(values: xr.DataArray, number: int) -> str:
    """Return the name of a component with its unit, or its number."""
    if "component" not in values.coords:
        return f"$x_{{{number}}}$"
    name, unit = str(values.component.values), str(values.component_unit.values)
    return typeset_greek_symbols(name) + (f" [{unit}]" if unit != "1" else "")


def _select_special_point_color(special_point: SpecialPoint) -> str:
    return (
        BRANCH_END_COLOR
        if special_point.ends_branch
        else SPECIAL_POINT_COLORS.get(special_point.kind, "black")
    )


def _draw_special_points(
    axes: Axes, special_points: list[SpecialPoint], draws_numbers: bool
) -> None:
    lower_limit, upper_limit = axes.get_xlim()
    last_number_position = -np.inf
    for special_point_number, special_point in enumerate(special_points, 1):
        axes.axvline(
            special_point.value,
            color=_select_special_point_color(special_point),
            lw=0.7,
            linestyle=SPECIAL_POINT_LINE_STYLE,
            zorder=0,
        )
        if draws_numbers:
            last_number_position = max(
                special_point.value, last_number_position + 0.03 * (upper_limit - lower_limit)
            )
            axes.annotate(
                str(special_point_number),
                (last_number_position, 1.0),
                xycoords=("data", "axes fraction"),
                ha="center",
                va="bottom",
                fontsize=7.0,
                color=_select_special_point_color(special_point),
            )


def _add_branch_legend(figure: Figure, special_points: list[SpecialPoint], branch: Branch) -> None:
    legend_handles = []
    for special_point_number, special_point in enumerate(special_points, 1):
        value_text = format_value_label(branch.parameter, special_point.value, 6, branch.dataset)
        violation_text = typeset_greek_symbols(describe_violation(special_point.name))
        ending_text = " (ends here)" if special_point.ends_branch else ""
        legend_handles.append(
            Line2D(
                [],
                [],
                color=_select_special_point_color(special_point),
                linewidth=0.9,
                linestyle=SPECIAL_POINT_LINE_STYLE,
                label=f"{special_point_number}  {value_text}: {violation_text}{ending_text}",
            )
        )
    legend_handles += [
        Line2D([], [], color="black", linestyle="-", label="stable"),
        Line2D([], [], color="black", linestyle="--", label="unstable"),
    ]
    add_figure_legend(figure, legend_handles, 2, fontsize=7.5)


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
