"""Figures of branches and their special points, and figures of basins of attraction."""

import itertools

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from vrw_jax.app.figure_style import (
    DARK_GRAY_COLOR,
    LEG_1_COLOR,
    LEG_2_COLOR,
    OKABE_ITO_AMBER,
    OKABE_ITO_GREEN,
    OKABE_ITO_PINK,
    OKABE_ITO_SKY_BLUE,
    OKABE_ITO_YELLOW,
    PAGE_FIGURE_WIDTH_INCHES,
    FigureWidth,
    add_figure_legend,
    draw_outcome_cells,
    draw_panel_letter,
    figure_style,
    find_width_inches,
    format_axis_label,
    format_value_label,
    make_outcome_patches,
    make_panel_grid,
    require_variables_of_datasets,
    typeset_greek_symbols,
)
from vrw_jax.base.checks import check_type
from vrw_jax.base.outcomes import Outcome
from vrw_jax.branches.branch import Branch, SpecialPoint
from vrw_jax.models.measures import MEASURES, PRE_TOUCHDOWN_COMPONENT_NAMES, describe_violation

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
COMPONENT_COLORS = (
    LEG_1_COLOR, LEG_2_COLOR, OKABE_ITO_SKY_BLUE, OKABE_ITO_AMBER, DARK_GRAY_COLOR, "black",
)  # fmt: skip
"""Colors of the components of a fixed point of a map, in turn."""


@figure_style()
def branch_figure(branch: Branch, *, width: FigureWidth = None) -> Figure:
    """Return a figure of a branch and its special points.

    The panels show the DLS fraction, the moduli of multipliers, indicators and clearance. For
    models other than the paper's, speed and period replace indicators and clearance. For maps, the
    panels show the fixed points and the moduli of multipliers. Curves are solid where gaits are
    stable, and dashed where gaits are unstable. Special points are numbered from left to right.

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
    parameter_values, branch_dataset = branch.values, branch.dataset
    special_points = sorted(branch.special_points, key=lambda special_point: special_point.value)
    has_dls_indicators = "lambda_2_plus" in branch_dataset
    drawn_panels: tuple[tuple[str, dict[str, str]], ...] = (
        PAPER_BRANCH_PANELS if has_dls_indicators else OTHER_MODEL_BRANCH_PANELS
    )
    if "x" in branch_dataset:  # fixed points of a map
        components = {
            f"$x_{{{number}}}$": values
            for number, values in enumerate(branch_dataset.x.transpose("component", "point"), 1)
        }
        branch_dataset = branch_dataset.assign(components)
        component_colors = dict(zip(components, itertools.cycle(COMPONENT_COLORS), strict=False))
        drawn_panels = (("fixed point", component_colors), MULTIPLIER_PANEL)
    legend_height = 0.32 + 0.16 * -(-len(special_points) // 2)
    figure, panel_axes = make_panel_grid(
        find_width_inches(width, PAGE_FIGURE_WIDTH_INCHES),
        len(drawn_panels),
        1.84,
        legend_height,
        2,
        sharex=True,
    )
    stability_changes = (np.flatnonzero(np.diff(branch.stable.astype(int))) + 1).tolist()
    # A piece of equal stability ends at the point where the next piece starts.
    pieces_of_equal_stability = [
        slice(piece_start, next_start + 1)
        for piece_start, next_start in zip(
            [0, *stability_changes], [*stability_changes, branch.values.size], strict=True
        )
    ]
    for axes, (panel_label, panel_measure_names), panel_letter in zip(
        panel_axes, drawn_panels, "abcd", strict=False
    ):
        draw_panel_letter(axes, panel_letter)
        for measure_name, line_color in panel_measure_names.items():
            plotted_values = branch_dataset[measure_name].values
            if measure_name == "clearance_sls1":
                # The clearance is in mm. The line has a gap where the clearance jumps because a
                # local minimum vanishes.
                plotted_values = 1e3 * plotted_values
                plotted_values[1:][plotted_values[:-1] * plotted_values[1:] < 0.0] = np.nan
            if measure_name == "spectral_radius":
                plotted_values = np.abs(branch.multipliers)
            for piece in pieces_of_equal_stability:
                axes.plot(
                    parameter_values[piece],
                    plotted_values[piece],
                    "-" if branch.stable[piece.start] else "--",
                    color=line_color,
                )
        _draw_special_points(axes, special_points, draws_numbers=panel_letter in "ab")
        axes.set_ylabel(panel_label)
    panel_axes[1].axhline(1.0, color=DARK_GRAY_COLOR, linewidth=0.5)
    panel_axes[1].set_ylim(0.0, None)
    if has_dls_indicators:
        force_axes, clearance_axes = panel_axes[2:]
        for axes in panel_axes[2:]:
            axes.axhline(0.0, color=DARK_GRAY_COLOR, linewidth=0.5)
        for measure_name, line_color in PAPER_BRANCH_PANELS[2][1].items():
            force_axes.plot([], [], color=line_color, label=f"${MEASURES[measure_name].mathtext}$")
        force_axes.legend(loc="center left")
        clearance_mm = 1e3 * branch_dataset.clearance_sls1.values
        clearance_axes.set_yscale("symlog", linthresh=0.1)
        clearance_axes.set_ylim(
            2.0 * min(clearance_mm.min(), -0.1), 2.0 * max(clearance_mm.max(), 0.1)
        )
    if "x" in branch_dataset and 1 < len(component_colors) <= len(COMPONENT_COLORS):
        for component_name, line_color in component_colors.items():
            panel_axes[0].plot([], [], color=line_color, label=component_name)
        panel_axes[0].legend()
    for axes in panel_axes:
        if axes.get_subplotspec().is_last_row():
            axes.set_xlabel(format_axis_label(branch.parameter))
    _add_branch_legend(figure, special_points, branch.parameter)
    return figure


def _select_special_point_color(special_point: SpecialPoint) -> str:
    return (
        BRANCH_END_COLOR
        if special_point.ends_branch
        else SPECIAL_POINT_COLORS.get(special_point.kind, "black")
    )


def _draw_special_points(
    axes: Axes, special_points: list[SpecialPoint], draws_numbers: bool
) -> None:
    """Draw a vertical line at each special point, with its number if `draws_numbers` is true."""
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


def _add_branch_legend(figure: Figure, special_points: list[SpecialPoint], parameter: str) -> None:
    legend_handles = []
    for special_point_number, special_point in enumerate(special_points, 1):
        value_text = format_value_label(parameter, special_point.value, 6)
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
    all_outcome_codes = np.concatenate(
        [basin_dataset.outcome.values.ravel() for basin_dataset in results]
    )
    failure_outcome_codes = np.setdiff1d(all_outcome_codes, Outcome.STEPPED).tolist()
    steps_to_gait_by_panel = [
        basin_dataset.steps.where(basin_dataset.attractor >= 0) for basin_dataset in results
    ]
    max_n_steps_to_gait = max(
        float(steps_to_gait.max()) for steps_to_gait in steps_to_gait_by_panel
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
        if {horizontal_axis_name, vertical_axis_name} <= set(PRE_TOUCHDOWN_COMPONENT_NAMES):
            component_indices = list(
                map(PRE_TOUCHDOWN_COMPONENT_NAMES.index, (horizontal_axis_name, vertical_axis_name))
            )
            axes.plot(
                *basin_dataset.orbit_state.values[..., component_indices].reshape(-1, 2).T,
                "+",
                color=OKABE_ITO_YELLOW,
                markersize=7.0,
                markeredgewidth=1.6,
            )
        axes.set(title=panel_title, xlabel=format_axis_label(horizontal_axis_name, "{symbol}"))
        if axes.get_subplotspec().is_first_col():
            axes.set_ylabel(format_axis_label(vertical_axis_name, "{symbol}"))
    color_bar = figure.colorbar(step_count_image, ax=list(panel_axes), aspect=25, pad=0.01)
    color_bar.set_label("steps until the gait is reached")
    color_bar.ax.set_ylim(0.0, max_n_steps_to_gait)
    add_figure_legend(figure, make_outcome_patches(failure_outcome_codes), 4, fontsize=7.5)
    return figure
