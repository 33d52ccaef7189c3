"""Figures of gaits: phases and forces of one gait, comparisons of several, and branches."""

import itertools
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from vrw_jax.app._walk_figures import (
    GROUND_FORCE_NAMES,
    LEG_LINE_STYLES,
    find_constant_spans,
    insert_landing_gaps,
    make_contact_panels,
    make_coordinate_panels,
    make_time_panels,
    require_nonempty_walk,
)
from vrw_jax.app.figure_style import (
    COLUMN_FIGURE_WIDTH_INCHES,
    DARK_GRAY_COLOR,
    LEG_1_COLOR,
    LEG_2_COLOR,
    LIGHT_GRAY_COLOR,
    OKABE_ITO_AMBER,
    OKABE_ITO_GREEN,
    OKABE_ITO_PINK,
    OKABE_ITO_SKY_BLUE,
    PAGE_FIGURE_WIDTH_INCHES,
    FigureWidth,
    StyledFigure,
    add_figure_legend,
    add_side_legend,
    count_panel_columns,
    draw_markers,
    draw_panel_letter,
    figure_style,
    find_width_inches,
    format_axis_label,
    format_value_label,
    label_lowest_panels,
    make_panel_grid,
    require_dataset_variables,
    require_variables_of_datasets,
    typeset_greek_symbols,
)
from vrw_jax.base.checks import (
    check_type,
    require_known_name,
)
from vrw_jax.branches.branch import Branch, SpecialPoint
from vrw_jax.models.measures import MEASURES, PHASE_NAMES, describe_violation


@figure_style()
def gait_panels(gait: xr.Dataset, *, width: FigureWidth = None) -> Figure:
    """Return a figure of the motion and the ground forces of a gait (Fig. 6 of the paper).

    The panels show angle, leg lengths, load share, foot height and ground forces. Gray bands mark
    double support, and dotted lines mark collision II. For walks with unilateral contact, the
    panels show angle, leg lengths, contact modes, foot heights, and normal and tangential forces.
    For a `HybridSystem`, each panel shows a coordinate of the state, on a background that marks the
    modes, with dotted lines at the section.

    Args:
        gait: dataset that `vrw.simulate` returns for any model, or for a `HybridSystem`.
        width: "column", "page" or a number of mm; None for the usual width.

    Returns:
        Figure: panels over time (s), in SI units.

    Examples:
        >>> gait = vrw.simulate(vrw.WheelParams(), vrw.paper_start(), n_steps=1)
        >>> figure = vrw.plot.gait_panels(gait)
    """
    if isinstance(gait, xr.Dataset) and "section" in gait.attrs and gait.sizes.get("time"):
        return make_coordinate_panels(gait, width)
    return _make_gait_panels(gait, width, forces_only=False)


@figure_style()
def ground_forces(gait: xr.Dataset, *, width: FigureWidth = None) -> Figure:
    """Return a figure of the ground forces of a gait, which is the last part of `gait_panels`.

    Args:
        gait: dataset that `vrw.simulate` returns for any model.
        width: "column", "page" or a number of mm; None for the usual width.

    Returns:
        Figure: forces (N) over time (s). With unilateral contact, one panel shows the normal
        forces, and another panel shows the tangential forces.

    Examples:
        >>> gait = vrw.simulate(vrw.WheelParams(), vrw.paper_start(), n_steps=1)
        >>> figure = vrw.plot.ground_forces(gait, width="column")
    """
    return _make_gait_panels(gait, width, forces_only=True)


def _make_gait_panels(gait: xr.Dataset, width: FigureWidth, forces_only: bool) -> Figure:
    require_nonempty_walk("gait", gait)
    width_inches = find_width_inches(width, 0.8 * PAGE_FIGURE_WIDTH_INCHES)
    if "contact" in gait:
        return make_contact_panels(gait, width_inches, forces_only)
    times, theta, L1, L2, rear_foot_height, *forces = (
        insert_landing_gaps(gait, gait[variable_name].values)
        for variable_name in ("time", "theta", "L1", "L2", "foot_2_z", *GROUND_FORCE_NAMES)
    )
    height, ratios = (2.3, [1.5]) if forces_only else (7.4, [1, 1, 1, 1, 1.5])
    figure, panel_axes = make_time_panels(width_inches, height, ratios, times)
    leg_1_style, leg_2_style = (
        {"color": line_color, "linestyle": line_style}
        for line_color, line_style in LEG_LINE_STYLES.values()
    )
    if not forces_only:
        angle_axes, length_axes, load_axes, height_axes, _ = panel_axes
        angle_axes.plot(times, theta, color="black")
        angle_axes.set_ylabel(format_axis_label("theta", "{symbol}"))
        length_axes.plot(times, L1, label="Leg 1, $L_1$", **leg_1_style)
        length_axes.plot(times, L2, label="Leg 2, $L_2$", **leg_2_style)
        length_axes.set_ylabel("$L_1,\\ L_2$ [m]")
        rear_load_percent = 100.0 * forces[3] / (forces[1] + forces[3])
        load_axes.plot(times, 100.0 - rear_load_percent, label="foot 1", **leg_1_style)
        load_axes.plot(times, rear_load_percent, label="foot 2", **leg_2_style)
        load_axes.set_ylabel("share of the\nnormal force [%]")
        height_axes.plot(times, rear_foot_height, **leg_2_style)
        height_axes.set_ylabel("$z_2$ [m]")
    force_axes = panel_axes[-1]
    for i, force_name in enumerate(GROUND_FORCE_NAMES):
        force_axes.plot(
            times,
            forces[i],
            linewidth=(0.7, 1.4)[i % 2],
            label=f"${MEASURES[force_name].mathtext}$",
            **(leg_1_style if i < 2 else leg_2_style),
        )
    force_axes.axhline(0.0, color=DARK_GRAY_COLOR, linewidth=0.4)
    force_axes.set_ylabel("ground reaction\nforce [N]")
    if forces_only and count_panel_columns(width_inches, 2) == 1:  # The names of phases are above.
        add_figure_legend(figure, force_axes.get_legend_handles_labels()[0], 4)
    else:
        for axes in (force_axes,) if forces_only else (length_axes, load_axes, force_axes):
            add_side_legend(axes)
    figure.align_ylabels(panel_axes)
    _mark_phases(panel_axes, find_constant_spans(gait, gait.phase.values))
    return figure


def _mark_phases(panel_axes: np.ndarray, phase_spans: list[tuple[float, float, int]]) -> None:
    """Mark double support and collision II, and name the phases of the first step on top.

    A name is upright where its phase is shorter than the name, and is omitted where it would cover
    another one.
    """
    for axes in panel_axes:
        for start_time, end_time, phase_code in phase_spans:
            if phase_code == 0:
                axes.axvspan(start_time, end_time, color=LIGHT_GRAY_COLOR, linewidth=0.0, zorder=0)
            if phase_code == 2:
                dotted = (0, (1, 2))
                axes.axvline(
                    start_time, color=DARK_GRAY_COLOR, linewidth=0.5, linestyle=dotted, zorder=0
                )
    axes = panel_axes[0]
    names = [
        axes.annotate(
            PHASE_NAMES[phase_code],
            (0.5 * (start_time + end_time), 1.0),
            xycoords=("data", "axes fraction"),
            ha="center",
            va="bottom",
            fontsize=7.5,
        )
        for start_time, end_time, phase_code in phase_spans[:3]
    ]
    axes.figure.draw_without_rendering()  # The layout defines the widths of the phases.
    pixels_per_second = axes.bbox.width / np.ptp(axes.get_xlim())
    last_right_edge = -np.inf
    for name, (start_time, end_time, _) in zip(names, phase_spans, strict=False):
        if name.get_window_extent().width > (end_time - start_time) * pixels_per_second:
            name.set_rotation(90)
        extent = name.get_window_extent()
        if extent.x0 < last_right_edge:
            name.remove()
        else:
            last_right_edge = extent.x1


NO_PAPER_WALK_REMEDY = (
    "give vrw.simulate(params) of the paper's wheel; vrw.plot.gait_panels, sticks and walk_frames "
    "draw walks of any model"
)
"""Remedy in the error message for a walk without the phases of the paper."""


GAIT_LINE_STYLES = ("-", "--", (0, (4, 1, 1, 1)), ":")
"""Line styles of the gaits in one figure, which more gaits repeat in other colors."""


def _format_gait_lines(
    gaits: Sequence[xr.Dataset], vary: str
) -> Iterator[tuple[xr.Dataset, dict[str, Any]]]:
    """Yield each gait with the style and the label of its line, for matplotlib."""
    for gait, line_style in zip(gaits, itertools.cycle(GAIT_LINE_STYLES), strict=False):
        names = [x.removeprefix("parameter_") for x in gait.attrs if x.startswith("parameter_")]
        require_known_name(vary, names, "parameter of these gaits")
        label = format_value_label(vary, gait.attrs[f"parameter_{vary}"])
        yield gait, {"linestyle": line_style, "label": label}


@figure_style()
def foot_height(
    gaits: Sequence[xr.Dataset], vary: str = "damping", *, width: FigureWidth = None
) -> Figure:
    """Return a figure of the height of foot 2 during one step of each gait (Fig. 8 of the paper).

    A second panel shows the height around take-off, in mm.

    Args:
        gaits: datasets that `vrw.simulate` returns for one step, one per curve.
        vary: name of the parameter in which the gaits differ, used in the legend.
        width: "column", "page" or a number of mm; None for the usual width.

    Returns:
        Figure: two panels over the time since the landing, in s.

    Examples:
        >>> gait = vrw.simulate(vrw.WheelParams(), vrw.paper_start(), n_steps=1)
        >>> figure = vrw.plot.foot_height([gait])
    """
    require_variables_of_datasets("gaits", gaits, ("phase", "foot_2_z"), NO_PAPER_WALK_REMEDY)
    figure, (step_axes, takeoff_axes) = make_panel_grid(
        find_width_inches(width, PAGE_FIGURE_WIDTH_INCHES), 2, 2.6, 0.0, 2
    )
    for gait, line_format in _format_gait_lines(gaits, vary):
        foot_height_mm = 1e3 * gait.foot_2_z
        lowest_mm = float(foot_height_mm.min())
        clearance_text = f"lowest −{-lowest_mm:.1f} mm" if lowest_mm < -1e-6 else "clear"
        step_axes.plot(gait.time, gait.foot_2_z, **line_format)
        takeoff_axes.plot(gait.time, foot_height_mm, **line_format | {"label": clearance_text})
    for panel_letter, axes in zip("ab", (step_axes, takeoff_axes), strict=True):
        draw_panel_letter(axes, panel_letter)
        axes.axhspan(-1e3, 0.0, color=LIGHT_GRAY_COLOR, linewidth=0.0, zorder=0)
        axes.axhline(0.0, color="black", linewidth=0.5, zorder=1)
        axes.set_xlabel("time since landing [s]")
    step_axes.legend(loc="upper left")
    heights = np.concatenate([gait.foot_2_z for gait in gaits])
    min_height, max_height = heights.min(), heights.max()
    takeoff_times = [float(gait.time[gait.phase == 1][0]) for gait in gaits]
    step_axes.set(
        xlim=(0.0, max(float(gait.time.max()) for gait in gaits)),
        ylim=(2.0 * min_height - 0.004, 1.05 * max_height),
        ylabel="height of foot 2, $z_2$ [m]",
    )
    takeoff_axes.set(
        xlim=(min(takeoff_times) - 0.03, max(takeoff_times) + 0.12),
        ylim=(1.3e3 * min_height - 0.5, -1.8e3 * min_height + 0.5),
        ylabel="$z_2$ [mm]",
    )
    takeoff_axes.legend(loc="best")
    takeoff_axes.text(
        0.98,
        0.03,
        "below the ground",
        transform=takeoff_axes.transAxes,
        ha="right",
        color=DARK_GRAY_COLOR,
    )
    return figure


@figure_style()
def rear_force(
    gaits: Sequence[xr.Dataset], vary: str = "damping", *, width: FigureWidth = None
) -> Figure:
    """Return a figure of the normal force on foot 2 in double support of each gait (Fig. 9 of the
    paper).

    Args:
        gaits: datasets that `vrw.simulate` returns for one step, one per curve.
        vary: name of the parameter in which the gaits differ, used in the legend.
        width: "column", "page" or a number of mm; None for the usual width.

    Returns:
        Figure: one panel over the time since the landing, in s.

    Examples:
        >>> gait = vrw.simulate(vrw.WheelParams(), vrw.paper_start(), n_steps=1)
        >>> figure = vrw.plot.rear_force([gait])
    """
    require_variables_of_datasets("gaits", gaits, ("phase", "lambda_4"), NO_PAPER_WALK_REMEDY)
    figure = StyledFigure(figsize=(find_width_inches(width, COLUMN_FIGURE_WIDTH_INCHES), 2.5))
    axes = figure.subplots()
    for gait, line_format in _format_gait_lines(gaits, vary):
        double_support = gait.isel(time=gait.phase.values == 0)
        (force_line,) = axes.plot(double_support.time, double_support.lambda_4, **line_format)
        axes.plot(
            0.0,
            double_support.lambda_4[0],
            "o",
            color=force_line.get_color(),
            markersize=3.5,
            clip_on=False,
        )
    axes.set(
        xlim=(0.0, None),
        ylim=(0.0, None),
        xlabel="time since landing [s]",
        ylabel="normal force on foot 2, $\\lambda_4$ [N]",
    )
    axes.legend(loc="upper right")
    return figure


@figure_style()
def indicators(gaits: xr.Dataset, every: int = 4, *, width: FigureWidth = None) -> Figure:
    """Return a figure of the DLS indicators of period-1 gaits with λ2⁺ >= 0 (Fig. 10 of the paper).

    Symbols are filled if foot 2 stays above the ground, and open if foot 2 scuffs.

    Args:
        gaits: dataset over one parameter, with `settled`, `lambda_I4` (N s), `lambda_2_plus` and
            `lambda_4_plus` (N), `clearance_sls1` and `clearance_sls2` (m). Its attribute
            `parameter_slope` is the slope in rad.
        every: spacing of the symbols: they are drawn at parameter values that are multiples of this
            number, and at the first and the last value.
        width: "column", "page" or a number of mm; None for the usual width.

    Returns:
        Figure: the impulse and the two forces over the parameter.

    Examples:
        >>> columns = {"lambda_I4": [5.0, 4.0], "lambda_2_plus": [90.0, 80.0]}
        >>> columns |= {"lambda_4_plus": [50.0, 60.0], "settled": [True, True]}
        >>> columns |= {"clearance_sls1": [0.01, 0.02], "clearance_sls2": [0.01, 0.02]}
        >>> over = {name: ("damping", values) for name, values in columns.items()}
        >>> gaits = xr.Dataset(over, {"damping": [80.0, 120.0]}, {"parameter_slope": 0.3})
        >>> figure = vrw.plot.indicators(gaits)
    """
    require_dataset_variables(
        "gaits",
        gaits,
        ("settled", "lambda_I4"),
        "give gaits over one parameter, as in the example of vrw.plot.indicators",
    )
    varied_parameter = str(gaits.settled.dims[0])
    valid_gaits = gaits.where(gaits.settled & (gaits.lambda_2_plus >= 0.0), drop=True)
    is_scuffing = np.minimum(valid_gaits.clearance_sls1, valid_gaits.clearance_sls2).values < 0.0
    parameter_values = valid_gaits[varied_parameter].values
    value_range = (parameter_values.min(), parameter_values.max())
    is_marker_drawn_at_value = (parameter_values % every == 0) | np.isin(
        parameter_values, value_range
    )
    panel_rows = (
        ((("lambda_I4", LEG_1_COLOR, "o"),), "impulse [N·s]"),
        ((("lambda_2_plus", LEG_1_COLOR, "s"), ("lambda_4_plus", LEG_2_COLOR, "o")), "force [N]"),
    )
    figure, panel_axes = make_panel_grid(
        find_width_inches(width, PAGE_FIGURE_WIDTH_INCHES), 2, 2.7, 0.0, 2
    )
    for axes, panel_letter, (panel_indicators, axis_label) in zip(
        panel_axes, "ab", panel_rows, strict=True
    ):
        draw_panel_letter(axes, panel_letter)
        for indicator_name, line_color, marker_symbol in panel_indicators:
            indicator_values = valid_gaits[indicator_name].values
            axes.plot(parameter_values, indicator_values, color=line_color, linewidth=0.7)
            for is_drawn, fill_color, legend_suffix in (
                (is_marker_drawn_at_value & ~is_scuffing, line_color, ""),
                (is_marker_drawn_at_value & is_scuffing, "white", ", scuffing"),
            ):
                draw_markers(
                    axes,
                    parameter_values[is_drawn],
                    indicator_values[is_drawn],
                    marker_symbol,
                    line_color,
                    fill_color,
                    label=f"${MEASURES[indicator_name].mathtext}${legend_suffix}",
                    clip_on=False,
                )
        max_indicator = max(valid_gaits[name].max() for name, *_ in panel_indicators)
        axes.set(
            xlim=(0.0, value_range[1] + 1.0),
            ylim=(0.0, 1.18 * max_indicator),
            xlabel=format_axis_label(varied_parameter, "{symbol}"),
            ylabel=axis_label,
        )
        axes.legend(
            loc="lower right" if panel_letter == "a" else "upper right", ncols=len(panel_indicators)
        )
    ground_slope = gaits.attrs["parameter_slope"]  # The slope in the paper's caption is a misprint.
    panel_axes[0].text(
        0.02, 0.05, format_value_label("slope", ground_slope), transform=panel_axes[0].transAxes
    )
    return figure


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
