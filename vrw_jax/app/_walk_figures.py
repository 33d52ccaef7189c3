"""Figures of walks: Figs 6 to 10 of the paper, and an animation of a walk."""

import itertools
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from numpy.typing import ArrayLike
from PIL import Image

from vrw_jax.app._contact_figures import (
    CONTACT_MODE_COLORS,
    GROUND_FORCE_NAMES,
    LEG_LINE_STYLES,
    OTHER_LEG_COLOR,
    HubAndFootMotion,
    compute_foot_motion,
    draw_feet,
    draw_sticks,
    find_constant_spans,
    insert_landing_gaps,
    make_contact_mode_handles,
    make_contact_panels,
    make_time_panels,
)
from vrw_jax.app.figure_style import (
    COLUMN_FIGURE_WIDTH_INCHES,
    DARK_GRAY_COLOR,
    LEG_1_COLOR,
    LEG_2_COLOR,
    LIGHT_GRAY_COLOR,
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
    make_panel_grid,
    require_dataset_variables,
    require_variables_of_datasets,
    typeset_greek_symbols,
)
from vrw_jax.base.checks import (
    check_int,
    check_path,
    check_positive,
    check_type,
    require_known_name,
)
from vrw_jax.models.measures import MEASURES, PHASE_NAMES

NO_WALK_REMEDY = "give vrw.simulate(params, model=...), of any model of the wheel"
"""Remedy in the error message for a dataset that is not a walk."""

NO_PAPER_WALK_REMEDY = (
    "give vrw.simulate(params) of the paper's wheel; vrw.plot.gait_panels, sticks and walk_frames "
    "draw walks of any model"
)
"""Remedy in the error message for a walk without the phases of the paper."""


def _require_nonempty_walk(argument_name: str, walk: xr.Dataset) -> None:
    required_names = ("hub_x", "hub_z", "step", "parameter_n_legs")
    require_dataset_variables(argument_name, walk, required_names, NO_WALK_REMEDY)
    if not walk.sizes["time"]:
        raise ValueError(
            f"{argument_name} has no samples, because the walk ended at once as "
            f"{walk.attrs['outcome']}: give one that takes a step."
        )


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
        return _make_coordinate_panels(gait, width)
    return _make_gait_panels(gait, width, forces_only=False)


MODE_TINTS = ("white", LIGHT_GRAY_COLOR, "#DCEBF5", "#FBE3D6", "#D9EFE7", "#F5E6EF", "#FCF9D5")
"""Backgrounds of the modes of a walker in turn, light tints of the colors of lines."""


def _make_coordinate_panels(walk: xr.Dataset, width: FigureWidth) -> Figure:
    """Return a figure of the state of a walker over time, with its modes and events."""
    times, spans = walk.time.values, find_constant_spans(walk, walk.phase.values)
    mode_names = walk.phase.attrs["flag_meanings"].split()
    # A line has a gap at each event, where a reset may change the state.
    gaps = np.flatnonzero(np.diff(times) == 0.0) + 1
    width_inches = find_width_inches(width, 0.8 * PAGE_FIGURE_WIDTH_INCHES)
    n_panels = len(walk.data_vars)
    figure, panel_axes = make_time_panels(
        width_inches, 0.6 + 1.25 * n_panels, [1.0] * n_panels, times
    )
    step_ends = times[np.flatnonzero(np.diff(walk.step.values)) + 1]
    for axes, (name, variable) in zip(panel_axes, walk.data_vars.items(), strict=True):
        for start_time, end_time, mode in spans:
            tint = MODE_TINTS[mode % len(MODE_TINTS)]
            axes.axvspan(start_time, end_time, color=tint, linewidth=0.0, zorder=0)
        for time in step_ends:
            axes.axvline(time, color=DARK_GRAY_COLOR, linewidth=0.5, linestyle=(0, (1, 2)))
        axes.plot(np.insert(times, gaps, np.nan), np.insert(variable.values, gaps, np.nan), "k")
        unit = variable.attrs.get("units", "1")
        axes.set_ylabel(typeset_greek_symbols(str(name)) + f" [{unit}]" * (unit != "1"))
    handles: list[Any] = [
        Patch(facecolor=MODE_TINTS[mode % len(MODE_TINTS)], edgecolor="#888888", linewidth=0.4,
              label=mode_names[mode].replace("_", " "))
        for mode in sorted({mode for *_, mode in spans})
    ]  # fmt: skip
    if len(step_ends):
        label = str(walk.attrs["section"]).replace("_", " ")
        handles.append(
            Line2D([], [], color=DARK_GRAY_COLOR, linewidth=0.5, linestyle=":", label=label)
        )
    add_figure_legend(figure, handles, len(handles))
    figure.align_ylabels(panel_axes)
    return figure


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
    _require_nonempty_walk("gait", gait)
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


@figure_style()
def sticks(gait: xr.Dataset, interval: float = 0.05, *, width: FigureWidth = None) -> Figure:
    """Return a stick diagram in the X-Z plane (Fig. 7 of the paper).

    Leg 1 is solid and Leg 2 is dotted. Colors show the phases. For walks with unilateral contact,
    the colors of the feet show their contact modes instead, and all other legs on the ground are
    also drawn.

    Args:
        gait: dataset that `vrw.simulate` returns for any model.
        interval: time between two sticks, in s.
        width: "column", "page" or a number of mm. By default, short walks are narrower than a page.

    Returns:
        Figure: one panel, in m.

    Examples:
        >>> gait = vrw.simulate(vrw.WheelParams(), vrw.paper_start(), n_steps=1)
        >>> figure = vrw.plot.sticks(gait, interval=0.1)
    """
    _require_nonempty_walk("gait", gait)
    check_positive("interval", interval)
    width_inches = find_width_inches(width, PAGE_FIGURE_WIDTH_INCHES)
    figure = StyledFigure(figsize=(width_inches, 2.8))
    axes = figure.subplots()
    draw_sticks(axes, gait, interval)
    axes.plot(gait.hub_x, gait.hub_z, color=LEG_2_COLOR, linewidth=1.0)
    axes.axhline(0.0, color="black", linewidth=0.8, zorder=1)
    # The word "downhill" needs 0.2 inches below the ground, or 0.12 m of a short walk.
    lower_limit = -max(0.12, 0.2 * np.ptp(axes.get_xlim()) / (0.85 * width_inches))
    arrow_z, last_hub_x = 0.07 / 0.12 * lower_limit, float(gait.hub_x[-1])
    axes.annotate(
        "downhill",
        (last_hub_x, arrow_z),
        (last_hub_x - 0.3, arrow_z),
        va="center",
        ha="right",
        arrowprops={"arrowstyle": "->", "linewidth": 0.6},
    )
    axes.set(xlabel="$X$ [m]", ylabel="$Z$ [m]", ylim=(lower_limit, None), aspect="equal")
    length_to_height = np.ptp(axes.get_xlim()) / np.ptp(axes.get_ylim())
    # The panel of a long walk is lower than a legend beside it.
    add_side_legend(axes, beside=length_to_height < 4.0)
    layout_engine: Any = figure.get_layout_engine()
    for _ in range(2):  # The labels need other space after the first change of the size.
        figure.draw_without_rendering()
        outer_box: Any = axes.get_tightbbox()
        label_space = np.subtract(outer_box.size, axes.bbox.size) / figure.dpi
        label_space += 2.0 * layout_engine.get()["w_pad"]
        panel_width = width_inches - label_space[0]
        if width is None:
            panel_width = min(panel_width, (2.8 - label_space[1]) * length_to_height)
        figure.set_size_inches(label_space + panel_width * np.array([1.0, 1.0 / length_to_height]))
    return figure


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


@figure_style()
def walk_frames(
    step: xr.Dataset, n_frames: int = 36, slow: float = 2.0
) -> tuple[list[Image.Image], int]:
    """Return the frames of a looping animation of a steady gait, and the duration of a frame in ms.

    The camera moves at the mean speed. Arrows show ground forces. An arrow of 1 m represents 300 N.
    The colors of the feet show their contact modes.

    Args:
        step: dataset that `vrw.simulate` returns for one or more steps of a gait, with any model.
        n_frames: number of frames.
        slow: factor of slow motion; 2 plays at half speed.

    Returns:
        tuple[list[Image], int]: Pillow images, and the milliseconds per frame.

    Examples:
        >>> gait = vrw.simulate(vrw.WheelParams(), vrw.paper_start(), n_steps=1)
        >>> frames, milliseconds = vrw.plot.walk_frames(gait, n_frames=2)
        >>> len(frames)
        2
    """
    _require_nonempty_walk("step", step)
    n_frames, slow = check_int("n_frames", n_frames), check_positive("slow", slow)
    slope, foot_motion = step.attrs["parameter_slope"], compute_foot_motion(step)

    def rotate_to_view(slope_points: ArrayLike) -> np.ndarray:
        """Return points (..., 2) of the slope's frame in a frame with a vertical z axis, shape
        (2, ...).
        """
        x, z = np.moveaxis(np.asarray(slope_points), -1, 0)
        return np.array(
            [x * np.cos(slope) + z * np.sin(slope), z * np.cos(slope) - x * np.sin(slope)]
        )

    walk_duration = foot_motion.sample_times[-1]
    hub_travel_distance = float(foot_motion.hub_positions[-1, 0] - foot_motion.hub_positions[0, 0])
    n_steps = int(step.step[-1] - step.step[0]) + 1
    # The ground has two marks per step, so that the animation loops without a jump.
    mark_spacing = 0.5 * hub_travel_distance / n_steps
    frame_images = []
    for t in np.linspace(0.0, walk_duration, n_frames, endpoint=False):
        figure = Figure(figsize=(3.6, 3.3), dpi=100)
        figure.set_layout_engine("none")
        canvas = FigureCanvasAgg(figure)
        axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
        axes.set_axis_off()
        camera_position = (
            float(foot_motion.hub_positions[0, 0]) + hub_travel_distance * t / walk_duration
        )
        ground_ends = [(camera_position - 3.0, 0.0), (camera_position + 3.0, 0.0)]
        axes.plot(*rotate_to_view(ground_ends), color="black", linewidth=1.2)
        first_mark_number = np.ceil((camera_position - 2.0) / mark_spacing)
        for mark_number in range(int(4.0 / mark_spacing)):
            x = (first_mark_number + mark_number) * mark_spacing
            axes.plot(*rotate_to_view([(x, 0.0), (x - 0.06, -0.06)]), color="black", linewidth=0.7)
        sample_index = _draw_wheel_at_time(axes, foot_motion, t, rotate_to_view)
        camera_x, camera_z = rotate_to_view((camera_position, 0.75))
        axes.set(xlim=(camera_x - 1.35, camera_x + 1.35), ylim=(camera_z - 1.25, camera_z + 1.225))
        if "contact" in step:
            legend_handles = make_contact_mode_handles(foot_motion.contact_modes)
            axes.legend(handles=legend_handles, loc="lower left", fontsize=8)
        else:
            phase_name = PHASE_NAMES[int(step.phase[sample_index])]
            axes.text(0.02, 0.03, phase_name, transform=axes.transAxes, fontsize=14)
        canvas.draw()
        frame_image = Image.frombuffer("RGBA", canvas.get_width_height(), canvas.buffer_rgba())
        frame_images.append(frame_image.convert("RGB"))
    return frame_images, round(1e3 * slow * walk_duration / n_frames)


def _draw_wheel_at_time(
    axes: Axes,
    foot_motion: HubAndFootMotion,
    time: float,
    rotate_to_view: Callable[[ArrayLike], np.ndarray],
) -> int:
    """Draw hub, legs, feet and forces at the time `time`, s.

    Return the index of the sample whose contact modes are drawn.
    """
    hub_position, foot_positions, sample_index = foot_motion.interpolate_at_time(time)
    for leg_number, foot_position in enumerate(foot_positions, 1):
        axes.plot(
            *rotate_to_view([hub_position, foot_position]),
            color={1: LEG_1_COLOR, 2: LEG_2_COLOR}.get(leg_number, OTHER_LEG_COLOR),
            linewidth=3.0 if leg_number < 3 else 1.5,
            solid_capstyle="round",
            zorder=5 if leg_number < 3 else 3,
        )
    axes.plot(*rotate_to_view(hub_position), "o", color="black", markersize=9, zorder=6)
    draw_feet(axes, rotate_to_view(foot_positions), foot_motion.contact_modes[sample_index], 6.0)
    for foot_position, foot_force in zip(
        foot_positions, foot_motion.foot_forces[sample_index], strict=True
    ):
        if foot_force[1] != 0.0:
            axes.annotate(
                "",
                tuple(rotate_to_view(foot_position + foot_force / 300.0)),
                tuple(rotate_to_view(foot_position)),
                zorder=7,
                arrowprops={"arrowstyle": "-|>", "linewidth": 1.2, "color": "black"},
            )
    return sample_index


GIF_PALETTE_SIZE = 32
"""Number of colors of an animation, chosen because twice as many enlarge the file by a seventh."""


def save_animation(frames: Sequence[Image.Image], milliseconds: int, path: str | Path) -> Path:
    """Write frames as a looping GIF file with one shared palette of 32 colors.

    Args:
        frames: images as `walk_frames` returns them.
        milliseconds: duration of a frame, in ms.
        path: path of the GIF file.

    Returns:
        Path: the path of the GIF file.

    Raises:
        TypeError, ValueError: if `frames` is not a list, or `path` is not that of a GIF file.
        OSError: if the file cannot be written.

    Examples:
        >>> gait = vrw.simulate(vrw.WheelParams(), vrw.paper_start(), n_steps=1)
        >>> frames, milliseconds = vrw.plot.walk_frames(gait, n_frames=2)
        >>> path = Path(tempfile.mkdtemp(), "walk.gif")
        >>> vrw.plot.save_animation(frames, milliseconds, path).name
        'walk.gif'
    """
    check_type("frames", frames, (list, tuple), "give those of vrw.plot.walk_frames")
    path = check_path("path", path, 'give a file, such as "walk.gif"')
    if path.suffix.lower() != ".gif":
        raise ValueError(
            f'path is {path}, but an animation is a GIF file: end its name with ".gif".'
        )
    path.parent.mkdir(parents=True, exist_ok=True)
    largest_areas: dict[Any, int] = {}  # number of pixels of each color in a frame
    for frame_image in frames:
        for area, color in frame_image.getcolors(frame_image.width * frame_image.height) or []:
            largest_areas[color] = max(area, largest_areas.get(color, 0))
    # Feet are small but keep the colors of the other figures.
    palette = [tuple(round(255.0 * x) for x in to_rgb(color)) for color in CONTACT_MODE_COLORS]
    other_colors = set(largest_areas).difference(palette)
    palette += sorted(other_colors, key=lambda color: largest_areas[color], reverse=True)
    palette_array = np.array(palette[:GIF_PALETTE_SIZE])
    paletted_frames = []
    for frame_image in frames:
        frame_colors, color_indices = np.unique(
            np.asarray(frame_image).reshape(-1, 3), axis=0, return_inverse=True
        )
        distances = np.sum(np.square(frame_colors[:, None] - palette_array), axis=-1)
        nearest = np.argmin(distances, axis=-1)[color_indices.ravel()]
        paletted_frame = Image.new("P", frame_image.size)
        paletted_frame.putdata(nearest.tolist())
        paletted_frame.putpalette(palette_array.ravel().tolist())
        paletted_frames.append(paletted_frame)
    paletted_frames[0].save(
        path,
        save_all=True,
        append_images=paletted_frames[1:],
        duration=milliseconds,
        loop=0,
        optimize=True,
    )
    return path
