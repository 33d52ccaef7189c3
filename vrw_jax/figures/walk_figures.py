"""Figures of walks: the paper's figures 6 to 10, and an animation of the walk."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

from vrw_jax.figures.contact_figures import (
    FootMotion,
    compute_foot_motion,
    draw_contact_sticks,
    draw_feet,
    make_contact_panels,
    make_mode_handles,
    reports_contact_modes,
    select_leg_color,
)
from vrw_jax.figures.style import (
    COLUMN_WIDTH_INCHES,
    DARK_GRAY,
    LEG_1_COLOR,
    LEG_2_COLOR,
    LIGHT_GRAY,
    PAGE_WIDTH_INCHES,
    SKY,
    draw_marks,
    figure_style,
    format_axis_label,
    format_value_label,
    label_panel,
    require_variables,
    require_variables_of_all,
)
from vrw_jax.measures import MEASURES, PHASE_NAMES
from vrw_jax.validation import check_int, check_path, check_positive, check_type

Coordinate = float | np.ndarray
"""One coordinate of points, in m."""

FORCE_NAMES = ("lambda_1", "lambda_2", "lambda_3", "lambda_4")
"""Names of the ground forces on the feet of Leg 1 and Leg 2, N."""


WALK_REMEDY = "give vrw.simulate(params, model=...), of any model"
"""Remedy in the message about a dataset that is no walk."""

PAPER_WALK_REMEDY = (
    "give vrw.simulate(params) of the paper's wheel; vrw.plot.gait_panels, sticks and walk_frames "
    "draw walks of any model"
)
"""Remedy in the message about a walk without the phases of the paper."""


def _require_walk(name: str, walk: xr.Dataset) -> None:
    """Raise an error unless `walk` is a trajectory with at least one sample."""
    needed_names = ("hub_x", "hub_z", "step", "parameter_n_legs")
    require_variables(name, walk, needed_names, WALK_REMEDY)
    if not walk.sizes["time"]:
        raise ValueError(
            f"{name} has no samples, because the walk ended at once as {walk.attrs['outcome']}: "
            "give one that takes a step."
        )


def find_phase_spans(gait: xr.Dataset) -> list[tuple[float, float, int]]:
    """Return (start time, end time, phase) of every phase of a trajectory, times in s."""
    step_and_phase = 3 * gait.step.values + gait.phase.values
    change_indices = np.flatnonzero(np.diff(step_and_phase)) + 1
    times = np.split(gait.time.values, change_indices)
    phases = gait.phase.values[np.r_[0, change_indices]]
    return [
        (phase_times[0], phase_times[-1], int(phase_code))
        for phase_times, phase_code in zip(times, phases, strict=True)
    ]


def insert_landing_gaps(gait: xr.Dataset, *names: str) -> list[np.ndarray]:
    """Return time and variables with a gap at each landing, at which the legs are relabeled."""
    landing_indices = np.flatnonzero(np.diff(gait.step.values)) + 1
    return [
        np.insert(gait[name].values.astype(float), landing_indices, np.nan)
        for name in ("time", *names)
    ]


@figure_style()
def gait_panels(gait: xr.Dataset) -> Figure:
    """Return a figure of angle, leg lengths, load share, foot height and ground forces (Fig. 6).

    Gray bands are double support, and dotted lines are collision II. With unilateral contact the
    panels show angle, leg lengths, contact modes, foot heights, normal and tangential forces.

    Args:
        gait: dataset of `vrw.simulate` with any model.

    Returns:
        Figure: panels over time in s, in SI units.

    Examples:
        >>> gait = vrw.simulate(vrw.WheelParams(), vrw.paper_start(), n_steps=1)
        >>> figure = vrw.plot.gait_panels(gait)
    """
    _require_walk("gait", gait)
    if reports_contact_modes(gait):
        return make_contact_panels(gait)
    time, theta, L1, L2, z2, *forces = insert_landing_gaps(
        gait, "theta", "L1", "L2", "foot_2_z", *FORCE_NAMES
    )
    load_share = 100.0 * forces[3] / (forces[1] + forces[3])
    figure = Figure(figsize=(0.8 * PAGE_WIDTH_INCHES, 7.4))
    panels = figure.subplots(5, 1, sharex=True, height_ratios=[1, 1, 1, 1, 1.5])
    for axes, panel_letter in zip(panels, "abcde", strict=True):
        label_panel(axes, panel_letter)
        for start_time, end_time, phase in find_phase_spans(gait):
            if phase == 0:
                axes.axvspan(start_time, end_time, color=LIGHT_GRAY, linewidth=0.0, zorder=0)
            if phase == 2:
                axes.axvline(
                    start_time, color=DARK_GRAY, linewidth=0.5, linestyle=(0, (1, 2)), zorder=0
                )
    panels[0].plot(time, theta, color="black")
    panels[0].set_ylabel(format_axis_label("theta", "{symbol}"))
    for start_time, end_time, phase in find_phase_spans(gait)[:3]:
        panels[0].annotate(
            PHASE_NAMES[phase],
            (0.5 * (start_time + end_time), 1.0),
            xycoords=("data", "axes fraction"),
            ha="center",
            va="bottom",
            fontsize=7.5,
            rotation=90 if phase == 2 else 0,
        )
    panels[1].plot(time, L1, color=LEG_1_COLOR, label="Leg 1, $L_1$")
    panels[1].plot(time, L2, color=LEG_2_COLOR, linestyle="--", label="Leg 2, $L_2$")
    panels[1].set_ylabel("$L_1,\\ L_2$ [m]")
    panels[2].plot(time, 100.0 - load_share, color=LEG_1_COLOR, label="foot 1")
    panels[2].plot(time, load_share, color=LEG_2_COLOR, linestyle="--", label="foot 2")
    panels[2].set_ylabel("share of the\nnormal force [%]")
    panels[3].plot(time, z2, color=LEG_2_COLOR, linestyle="--")
    panels[3].set_ylabel("$z_2$ [m]")
    for i, force in enumerate(forces):
        color, line = (LEG_1_COLOR, "-") if i < 2 else (LEG_2_COLOR, "--")
        name, width = f"${MEASURES[FORCE_NAMES[i]].mathtext}$", (0.7, 1.4)[i % 2]
        panels[4].plot(time, force, color=color, linestyle=line, linewidth=width, label=name)
    panels[4].axhline(0.0, color=DARK_GRAY, linewidth=0.4)
    panels[4].set_ylabel("ground reaction\nforce [N]")
    panels[4].set_xlabel("time [s]")
    panels[4].set_xlim(time[0], time[-1])
    for axes in panels[[1, 2, 4]]:
        axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
    figure.align_ylabels(panels)
    return figure


@figure_style()
def sticks(gait: xr.Dataset, interval: float = 0.05) -> Figure:
    """Return a stick diagram in the X-Z plane (Fig. 7); Leg 1 is solid and Leg 2 dotted.

    With unilateral contact the feet have the colors of their contact modes, in place of the colors
    of the phases, and other legs on the ground are drawn too.

    Args:
        gait: dataset of `vrw.simulate` with any model.
        interval: time between two sticks, in s.

    Returns:
        Figure: one panel, in m.

    Examples:
        >>> gait = vrw.simulate(vrw.WheelParams(), vrw.paper_start(), n_steps=1)
        >>> figure = vrw.plot.sticks(gait, interval=0.1)
    """
    _require_walk("gait", gait)
    check_positive("interval", interval)
    figure = Figure(figsize=(PAGE_WIDTH_INCHES, 2.8))
    axes = figure.subplots()
    draw_sticks = draw_contact_sticks if reports_contact_modes(gait) else _draw_phase_sticks
    draw_sticks(axes, gait, interval)
    axes.plot(gait.hub_x, gait.hub_z, color=LEG_2_COLOR, linewidth=1.0)
    axes.axhline(0.0, color="black", linewidth=0.8, zorder=1)
    last_hub_x = float(gait.hub_x[-1])
    axes.annotate(
        "downhill",
        (last_hub_x, -0.07),
        (last_hub_x - 0.3, -0.07),
        va="center",
        ha="right",
        arrowprops={"arrowstyle": "->", "linewidth": 0.6},
    )
    axes.set_ylim(-0.12, None)
    axes.set_aspect("equal")
    axes.set_xlabel("$X$ [m]")
    axes.set_ylabel("$Z$ [m]")
    axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
    return figure


def _draw_phase_sticks(axes: Axes, gait: xr.Dataset, interval: float) -> None:
    """Draw Legs 1 and 2 of a walk, in the colors of its phases."""
    phase_colors = ("#A0A0A0", SKY, "#000000")
    time = gait.time.values
    for i in np.searchsorted(time, np.arange(0.0, time[-1], interval)):
        sample = gait.isel(time=int(i))
        for foot, line in ((1, "-"), (2, ":")):
            axes.plot(
                [float(sample[f"foot_{foot}_x"]), float(sample.hub_x)],
                [float(sample[f"foot_{foot}_z"]), float(sample.hub_z)],
                color=phase_colors[int(sample.phase)],
                linestyle=line,
                linewidth=0.8,
            )
    for line, name in (("-", "Leg 1"), (":", "Leg 2")):
        axes.plot([], [], color="black", linestyle=line, linewidth=0.8, label=name)
    axes.plot([], [], color=LEG_2_COLOR, label="hub")
    for phase, phase_color in zip(PHASE_NAMES, phase_colors, strict=True):
        axes.plot([], [], color=phase_color, linewidth=3.0, label=phase)


GAIT_LINE_STYLES = ("-", "--", (0, (4, 1, 1, 1)), ":")
"""Line styles of the gaits of one figure."""


def _format_gait_label(gait: xr.Dataset, varied_parameter: str) -> str:
    """Return the label of a gait by its varied parameter, as in "c = 50 N·s/m"."""
    return format_value_label(varied_parameter, gait.attrs[f"parameter_{varied_parameter}"])


@figure_style()
def foot_height(gaits: Sequence[xr.Dataset], vary: str = "damping") -> Figure:
    """Return a figure of the height of foot 2 over one step of each gait (Fig. 8).

    A second panel shows the height around take-off, in mm.

    Args:
        gaits: datasets of `vrw.simulate` over one step, one per line.
        vary: name of the parameter in which the gaits differ, used in the legend.

    Returns:
        Figure: two panels over the time since the landing, in s.

    Examples:
        >>> gait = vrw.simulate(vrw.WheelParams(), vrw.paper_start(), n_steps=1)
        >>> figure = vrw.plot.foot_height([gait])
    """
    require_variables_of_all("gaits", gaits, ("phase", "foot_2_z"), PAPER_WALK_REMEDY)
    figure = Figure(figsize=(PAGE_WIDTH_INCHES, 2.6))
    step_axes, takeoff_axes = figure.subplots(1, 2)
    for gait, line in zip(gaits, GAIT_LINE_STYLES, strict=False):
        name, min_clearance = _format_gait_label(gait, vary), 1e3 * float(gait.foot_2_z.min())
        clearance_text = f"lowest −{-min_clearance:.1f} mm" if min_clearance < -1e-6 else "clear"
        step_axes.plot(gait.time, gait.foot_2_z, linestyle=line, label=name)
        takeoff_axes.plot(gait.time, 1e3 * gait.foot_2_z, linestyle=line, label=clearance_text)
    for panel_letter, axes in zip("ab", (step_axes, takeoff_axes), strict=True):
        label_panel(axes, panel_letter)
        axes.axhspan(-1e3, 0.0, color=LIGHT_GRAY, linewidth=0.0, zorder=0)
        axes.axhline(0.0, color="black", linewidth=0.5, zorder=1)
        axes.set_xlabel("time since landing [s]")
        axes.legend(loc="upper left")
    min_clearance = min(float(gait.foot_2_z.min()) for gait in gaits)
    takeoff_time = [float(gait.time[gait.phase == 1][0]) for gait in gaits]
    max_height = max(float(gait.foot_2_z.max()) for gait in gaits)
    step_axes.set_ylim(2.0 * min_clearance - 0.004, 1.05 * max_height)
    step_axes.set_xlim(0.0, max(float(gait.time.max()) for gait in gaits))
    step_axes.set_ylabel("height of foot 2, $z_2$ [m]")
    takeoff_axes.set_ylim(1.3e3 * min_clearance - 0.5, -1.8e3 * min_clearance + 0.5)
    takeoff_axes.set_xlim(min(takeoff_time) - 0.03, max(takeoff_time) + 0.1)
    takeoff_axes.set_ylabel("$z_2$ [mm]")
    takeoff_axes.text(
        0.98,
        0.03,
        "below the ground",
        transform=takeoff_axes.transAxes,
        ha="right",
        color=DARK_GRAY,
    )
    return figure


@figure_style()
def rear_force(gaits: Sequence[xr.Dataset], vary: str = "damping") -> Figure:
    """Return a figure of the normal force on foot 2 over double support of each gait (Fig. 9).

    Args:
        gaits: datasets of `vrw.simulate` over one step, one per line.
        vary: name of the parameter in which the gaits differ, used in the legend.

    Returns:
        Figure: one panel over the time since the landing, in s.

    Examples:
        >>> gait = vrw.simulate(vrw.WheelParams(), vrw.paper_start(), n_steps=1)
        >>> figure = vrw.plot.rear_force([gait])
    """
    require_variables_of_all("gaits", gaits, ("phase", "lambda_4"), PAPER_WALK_REMEDY)
    figure = Figure(figsize=(COLUMN_WIDTH_INCHES, 2.5))
    axes = figure.subplots()
    for gait, line in zip(gaits, GAIT_LINE_STYLES, strict=False):
        double_support = gait.isel(time=gait.phase.values == 0)
        (force_line,) = axes.plot(
            double_support.time,
            double_support.lambda_4,
            linestyle=line,
            label=_format_gait_label(gait, vary),
        )
        axes.plot(
            0.0,
            double_support.lambda_4[0],
            "o",
            color=force_line.get_color(),
            markersize=3.5,
            clip_on=False,
        )
    axes.set_xlim(0.0, None)
    axes.set_ylim(0.0, None)
    axes.set_xlabel("time since landing [s]")
    axes.set_ylabel("normal force on foot 2, $\\lambda_4$ [N]")
    axes.legend(loc="upper right")
    return figure


@figure_style()
def indicators(gaits: xr.Dataset, every: int = 4) -> Figure:
    """Return a figure of the DLS indicators of period-1 gaits with λ2⁺ >= 0 (Fig. 10).

    Symbols are filled if foot 2 stays clear of the ground, and open if it scuffs.

    Args:
        gaits: dataset over one parameter, with `settled`, `lambda_I4` (N s), `lambda_2_plus` and
            `lambda_4_plus` (N), `clearance_sls1` and `clearance_sls2` (m). Its attribute
            `parameter_slope` is the slope in rad.
        every: parameter values that are multiples of it have symbols, as have the first and the
            last.

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
    require_variables(
        "gaits",
        gaits,
        ("settled", "lambda_I4"),
        "give gaits over one parameter, as in the example of vrw.plot.indicators",
    )
    vary = str(gaits.settled.dims[0])
    valid_gaits = gaits.where(gaits.settled & (gaits.lambda_2_plus >= 0.0), drop=True)
    is_scuffing = np.minimum(valid_gaits.clearance_sls1, valid_gaits.clearance_sls2).values < 0.0
    values = valid_gaits[vary].values
    has_marker = (values % every == 0) | (values == values.min()) | (values == values.max())
    rows = (
        ((("lambda_I4", LEG_1_COLOR, "o"),), "impulse [N·s]"),
        ((("lambda_2_plus", LEG_1_COLOR, "s"), ("lambda_4_plus", LEG_2_COLOR, "o")), "force [N]"),
    )
    figure = Figure(figsize=(PAGE_WIDTH_INCHES, 2.7))
    panels = figure.subplots(1, 2)
    for axes, panel_letter, (series, axis_text) in zip(panels, "ab", rows, strict=True):
        label_panel(axes, panel_letter)
        for name, color, marker in series:
            data, symbol = valid_gaits[name].values, f"${MEASURES[name].mathtext}$"
            axes.plot(values, data, color=color, linewidth=0.7)
            for is_scuffing_drawn, fill_color in ((False, color), (True, "white")):
                is_selected = has_marker & (is_scuffing == is_scuffing_drawn)
                text = symbol + (", scuffing" if is_scuffing_drawn else "")
                x, y = values[is_selected], data[is_selected]
                draw_marks(axes, x, y, marker, color, fill_color, label=text, clip_on=False)
        axes.set_xlim(0.0, values.max() + 1.0)
        axes.set_ylim(0.0, 1.18 * max(float(valid_gaits[name].max()) for name, *_ in series))
        axes.set_xlabel(format_axis_label(vary, "{symbol}"))
        axes.set_ylabel(axis_text)
        axes.legend(loc="lower right" if panel_letter == "a" else "upper right", ncols=len(series))
    slope = gaits.attrs["parameter_slope"]  # The slope in the paper's caption is a misprint.
    panels[0].text(0.02, 0.05, format_value_label("slope", slope), transform=panels[0].transAxes)
    return figure


def _rotate_to_vertical(
    x: Coordinate, z: Coordinate, slope: float
) -> tuple[Coordinate, Coordinate]:
    """Return coordinates in a frame with vertical gravity from those in the slope's frame, m."""
    return (
        x * np.cos(slope) + z * np.sin(slope),
        z * np.cos(slope) - x * np.sin(slope),
    )


@figure_style()
def walk_frames(
    step: xr.Dataset, n_frames: int = 36, slow: float = 2.0
) -> tuple[list[Image.Image], int]:
    """Return looping frames of one step of a steady gait, and the duration of a frame in ms.

    The camera moves at the mean speed. Arrows are ground forces, 1 m for 300 N. Feet have the
    colors of their contact modes.

    Args:
        step: dataset of `vrw.simulate` over one step of a gait, or over several, with any model.
        n_frames: number of frames.
        slow: factor of slow motion; 2 plays at half speed.

    Returns:
        tuple[list[Image], int]: images of Pillow, and the milliseconds per frame.

    Examples:
        >>> gait = vrw.simulate(vrw.WheelParams(), vrw.paper_start(), n_steps=1)
        >>> frames, milliseconds = vrw.plot.walk_frames(gait, n_frames=2)
        >>> len(frames)
        2
    """
    _require_walk("step", step)
    n_frames, slow = check_int("n_frames", n_frames), check_positive("slow", slow)
    slope, motion = step.attrs["parameter_slope"], compute_foot_motion(step)
    duration = motion.time[-1]
    distance = float(motion.hub[-1, 0] - motion.hub[0, 0])
    stride = distance / max(int(motion.step[-1] - motion.step[0]) + 1, 1)
    frames = []
    for t in np.linspace(0.0, duration, n_frames, endpoint=False):
        figure = Figure(figsize=(3.6, 3.3), dpi=100)
        figure.set_layout_engine("none")
        canvas = FigureCanvasAgg(figure)
        axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
        axes.set_axis_off()
        center = float(motion.hub[0, 0]) + distance * t / duration
        _draw_ground(axes, slope, center, stride)
        sample = _draw_wheel(axes, motion, t, slope)
        view_center = [float(v) for v in _rotate_to_vertical(center, 0.75, slope)]
        axes.set_xlim(view_center[0] - 1.35, view_center[0] + 1.35)
        axes.set_ylim(view_center[1] - 1.25, view_center[1] + 1.225)
        if reports_contact_modes(step):
            handles = make_mode_handles(motion.contact)
            axes.legend(handles=handles, loc="lower left", fontsize=8)
        else:
            phase_name = PHASE_NAMES[int(step.phase[sample])]
            axes.text(0.02, 0.03, phase_name, transform=axes.transAxes, fontsize=14)
        canvas.draw()
        picture = Image.frombuffer("RGBA", canvas.get_width_height(), canvas.buffer_rgba())
        frames.append(picture.convert("RGB"))
    return frames, round(1e3 * slow * duration / n_frames)


def _draw_wheel(axes: Axes, motion: FootMotion, time: float, slope: float) -> int:
    """Draw hub, legs, feet and forces at a time in s, and return the index of the sample of
    contact modes.
    """
    hub, feet, sample = motion.interpolate(time)
    rotate_to_view = lambda points: np.array(
        _rotate_to_vertical(points[..., 0], points[..., 1], slope)
    )
    for leg, foot in enumerate(feet, 1):
        axes.plot(
            *rotate_to_view(np.stack([hub, foot])),
            color=select_leg_color(leg),
            linewidth=3.0 if leg < 3 else 1.5,
            solid_capstyle="round",
            zorder=5 if leg < 3 else 3,
        )
    axes.plot(*rotate_to_view(hub), "o", color="black", markersize=9, zorder=6)
    draw_feet(axes, rotate_to_view(feet), motion.contact[sample], 6.0)
    for foot, force in zip(feet, motion.forces[sample], strict=True):
        if force[1] != 0.0:
            axes.annotate(
                "",
                tuple(rotate_to_view(foot + force / 300.0)),
                tuple(rotate_to_view(foot)),
                zorder=7,
                arrowprops={"arrowstyle": "-|>", "linewidth": 1.2, "color": "black"},
            )
    return sample


def _draw_ground(axes: Axes, slope: float, center: float, stride: float) -> None:
    """Draw the slope with marks that repeat every half stride, so that the animation loops."""
    ground_ends = np.array([center - 3.0, center + 3.0])
    axes.plot(
        *_rotate_to_vertical(ground_ends, 0.0 * ground_ends, slope), color="black", linewidth=1.2
    )
    spacing = 0.5 * stride
    first_mark = np.ceil((center - 2.0) / spacing)
    for mark_number in range(int(4.0 / spacing)):
        x = np.array([0.0, -0.06]) + (first_mark + mark_number) * spacing
        axes.plot(
            *_rotate_to_vertical(x, np.array([0.0, -0.06]), slope), color="black", linewidth=0.7
        )


def save_animation(frames: Sequence[Image.Image], milliseconds: int, path: str | Path) -> Path:
    """Write frames as a looping GIF with one shared palette of 32 colors.

    Args:
        frames: images as `walk_frames` returns them.
        milliseconds: duration of a frame, in ms.
        path: path of the GIF.

    Returns:
        Path: the path of the GIF.

    Raises:
        TypeError: if `frames` is no list, or `path` is no path.
        OSError: if the file cannot be written.

    Examples:
        >>> gait = vrw.simulate(vrw.WheelParams(), vrw.paper_start(), n_steps=1)
        >>> frames, milliseconds = vrw.plot.walk_frames(gait, n_frames=2)
        >>> path = Path(tempfile.mkdtemp(), "walk.gif")
        >>> vrw.plot.save_animation(frames, milliseconds, path).name
        'walk.gif'
    """
    check_type("frames", frames, (list, tuple), "give those of vrw.plot.walk_frames")
    check_path("path", path, 'give a file, such as "walk.gif"')
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    shared_palette = frames[0].quantize(32)
    paletted_frames = [
        frame.quantize(palette=shared_palette, dither=Image.Dither.NONE) for frame in frames
    ]
    paletted_frames[0].save(
        path,
        save_all=True,
        append_images=paletted_frames[1:],
        duration=milliseconds,
        loop=0,
        optimize=True,
    )
    return path
