"""Motion of the feet for any model, and figures of walks: contact modes, sticks, animation."""

import string
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

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

from vrw_jax.app.figure_style import (
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
    draw_panel_letter,
    figure_style,
    find_width_inches,
    format_axis_label,
    require_dataset_variables,
    typeset_greek_symbols,
)
from vrw_jax.base.checks import (
    check_int,
    check_path,
    check_positive,
    check_type,
)
from vrw_jax.models.measures import CONTACT_MODE_NAMES, PHASE_NAMES
from vrw_jax.wheel.transitions import ContactMode

CONTACT_MODE_COLORS = ("white", OKABE_ITO_GREEN, OKABE_ITO_AMBER, OKABE_ITO_PINK)
"""Colors of the contact modes, by contact code."""

CONTACT_MODE_MARKERS = ("o", "o", ">", "<")
"""Markers of the contact modes, by contact code. They differ because some readers see the green and
the pink as the same gray.
"""

GROUND_FORCE_NAMES = ("lambda_1", "lambda_2", "lambda_3", "lambda_4")
"""Names of the ground forces (N) on the feet of Leg 1 and Leg 2."""

OTHER_LEG_COLOR = "#999999"
"""Color of every leg other than Legs 1 and 2."""

LEG_LINE_STYLES = {1: (LEG_1_COLOR, "-"), 2: (LEG_2_COLOR, "--")}
"""Color and line style of Legs 1 and 2 in plots over time."""

STICK_LINE_STYLES: dict[int, Any] = {1: "-", 2: ":"}
"""Line styles of Legs 1 and 2 in stick diagrams; other legs are dashed."""

PHASE_STICK_COLORS = ("#A0A0A0", OKABE_ITO_SKY_BLUE, "#000000")
"""Colors of the phases in stick diagrams, in the order of phases."""

OTHER_LEG_LINE_STYLES = (
    (OKABE_ITO_SKY_BLUE, "-."), (OKABE_ITO_PINK, ":"), (OKABE_ITO_AMBER, (0, (8, 3))),
    (DARK_GRAY_COLOR, (0, (5, 1, 1, 1, 1, 1))),
)  # fmt: skip
"""Colors and line styles of the other legs that move or touch the ground, in the order of leg
labels.
"""


class HubAndFootMotion(NamedTuple):
    """Positions of hub and feet during a walk, with contact modes and forces, in the slope's frame.

    Leg labels change with each step: Leg 1 is the front leg at the landing, and Leg 2 is the leg
    behind Leg 1.
    """

    sample_times: np.ndarray  # (time,), s
    hub_positions: np.ndarray  # (time, 2), x downhill and z normal to the slope, m
    foot_positions: np.ndarray  # (time, leg, 2), in the same coordinates, m
    foot_forces: np.ndarray  # (time, leg, 2), tangential and normal force, N
    contact_modes: np.ndarray  # (time, leg), contact mode

    def interpolate_at_time(self, t: float) -> tuple[np.ndarray, np.ndarray, int]:
        """Return the positions of hub and feet at the time `t` (s), and the index of the next
        sample.

        Contact modes and forces at this time are those of the next sample.
        """
        index_after = min(
            int(np.searchsorted(self.sample_times, t, side="right")), self.sample_times.size - 1
        )
        index_before = max(index_after - 1, 0)
        time_before, time_after = self.sample_times[[index_before, index_after]]
        fraction = (
            (t - time_before) / (time_after - time_before) if time_after > time_before else 1.0
        )
        interpolate = lambda sampled_values: (
            (1.0 - fraction) * sampled_values[index_before] + fraction * sampled_values[index_after]
        )
        return interpolate(self.hub_positions), interpolate(self.foot_positions), index_after


def compute_foot_motion(walk: xr.Dataset) -> HubAndFootMotion:
    """Return the motion of hub and feet in a trajectory that was computed with any model.

    In the paper's phases no foot slides: foot 1 is at rest, and foot 2 is at rest in double
    support.
    """
    hub_positions = np.stack([walk.hub_x.values, walk.hub_z.values], -1)
    if "contact" in walk:
        foot_positions = np.stack([walk.foot_x.values, walk.foot_z.values], -1)
        foot_forces = np.stack([walk.tangential.values, walk.normal.values], -1)
        contact_modes = walk.contact.values
    else:
        n_legs = int(walk.attrs["parameter_n_legs"])
        leg_angles = walk.theta.values[:, None] + 2.0 * np.pi / n_legs * np.arange(n_legs)
        leg_lengths = np.full(leg_angles.shape, walk.attrs["parameter_locked_length"])
        leg_lengths[:, 0] = walk.L1.values
        leg_lengths[:, 1] = walk.L2.values
        foot_positions = hub_positions[:, None] - leg_lengths[..., None] * np.stack(
            [np.sin(leg_angles), np.cos(leg_angles)], -1
        )
        foot_forces = np.zeros_like(foot_positions)
        ground_forces = [walk[force_name].values for force_name in GROUND_FORCE_NAMES]
        foot_forces[:, :2] = np.stack(ground_forces, -1).reshape(-1, 2, 2)
        contact_modes = np.full(leg_angles.shape, ContactMode.OFF)
        contact_modes[:, 0] = ContactMode.STICK
        contact_modes[walk.phase.values == 0, 1] = ContactMode.STICK
    return HubAndFootMotion(
        walk.time.values, hub_positions, foot_positions, foot_forces, contact_modes
    )


def insert_landing_gaps(walk: xr.Dataset, sampled_values: ArrayLike) -> np.ndarray:
    """Return values of the samples of a trajectory, with NaN inserted at each landing.

    The gaps separate steps in plots, because landings relabel the legs.
    """
    landing_indices = np.flatnonzero(np.diff(walk.step.values)) + 1
    return np.insert(np.asarray(sampled_values, float), landing_indices, np.nan)


def find_constant_spans(
    walk: xr.Dataset, sampled_codes: np.ndarray
) -> list[tuple[float, float, int]]:
    """Return the start time (s), the end time (s) and the code of every span with one code.

    A span ends where the code changes, and at each landing.

    - `sampled_codes`: code for each sample of the trajectory.
    """
    is_span_end = np.any(np.diff([walk.step.values, sampled_codes]), axis=0)
    spans = np.split(np.arange(len(sampled_codes)), np.flatnonzero(is_span_end) + 1)
    times = walk.time.values
    return [(times[span[0]], times[span[-1]], int(sampled_codes[span[0]])) for span in spans]


def make_time_panels(
    width_inches: float, height: float, height_ratios: Sequence[float], times: np.ndarray
) -> tuple[Figure, np.ndarray]:
    """Return a figure with panels over time, one below the other, and their axes."""
    figure = StyledFigure(figsize=(width_inches, height))
    panels = figure.subplots(
        len(height_ratios), 1, sharex=True, squeeze=False, height_ratios=height_ratios
    )[:, 0]
    for axes, letter in zip(panels, string.ascii_lowercase, strict=False):
        if len(panels) > 1:
            draw_panel_letter(axes, letter)
    panels[-1].set(xlabel="time [s]", xlim=(times[0], times[-1]))
    return figure, panels


def draw_feet(
    axes: Axes, foot_positions: np.ndarray, contact_modes: np.ndarray, marker_size: float
) -> None:
    """Draw feet in the colors of their contact modes, at positions of shape (2, feet)."""
    for contact_mode in np.unique(contact_modes):
        axes.plot(
            *foot_positions[:, contact_modes == contact_mode],
            CONTACT_MODE_MARKERS[contact_mode],
            color=CONTACT_MODE_COLORS[contact_mode],
            zorder=8,
            markersize=marker_size,
            markeredgecolor=DARK_GRAY_COLOR,
            markeredgewidth=0.1 * marker_size,
        )


def make_contact_mode_handles(contact_modes: np.ndarray) -> list[Line2D]:
    """Return a legend entry for each contact mode that occurs in `contact_modes`."""
    return [
        Line2D([], [], linestyle="", marker=CONTACT_MODE_MARKERS[contact_mode],
        color=CONTACT_MODE_COLORS[contact_mode],
               markeredgecolor=DARK_GRAY_COLOR, markeredgewidth=0.5,
               label=CONTACT_MODE_NAMES[contact_mode])
        for contact_mode in np.unique(contact_modes)
    ]  # fmt: skip


def _select_marked_legs(is_leg_marked: np.ndarray) -> list[int]:
    """Return the labels of Legs 1 and 2, and of all legs that are marked at any time.

    - `is_leg_marked`: whether a panel marks the contact of a leg, shape (time, leg).
    """
    return [
        leg_number
        for leg_number, is_leg_ever_marked in enumerate(np.any(is_leg_marked, axis=0).tolist(), 1)
        if is_leg_ever_marked or leg_number < 3
    ]


def make_contact_panels(walk: xr.Dataset, width_inches: float, forces_only: bool) -> Figure:
    """Return a figure of angle, leg lengths, contact modes, foot heights and forces over time, or
    of the forces only.

    The walk is a trajectory with contact modes.
    """
    foot_motion = compute_foot_motion(walk)
    is_foot_touching = foot_motion.contact_modes != ContactMode.OFF
    touching_legs = _select_marked_legs(is_foot_touching)
    moving_legs = _select_marked_legs(is_foot_touching | ~walk.on_stopper.values.astype(bool))
    times_with_gaps = insert_landing_gaps(walk, foot_motion.sample_times)
    other_leg_line_styles = iter(OTHER_LEG_LINE_STYLES * len(moving_legs))
    line_style_by_leg = {
        leg_number: LEG_LINE_STYLES.get(leg_number) or next(other_leg_line_styles)
        for leg_number in moving_legs
    }
    panel_height_ratios = [1.0, 1.0, 0.35 + 0.11 * len(touching_legs), 1.0, 1.2, 1.2]
    figure, panel_axes = make_time_panels(
        width_inches,
        3.4 if forces_only else 8.0,
        panel_height_ratios[4 if forces_only else 0 :],
        foot_motion.sample_times,
    )
    leg_panels = [
        (panel_axes[-2], touching_legs, walk.normal, "normal\nforce [N]"),
        (panel_axes[-1], touching_legs, walk.tangential, "tangential\nforce [N]"),
    ]
    if not forces_only:
        angle_axes, length_axes, mode_axes, height_axes, *_ = panel_axes
        angle_axes.plot(times_with_gaps, insert_landing_gaps(walk, walk.theta), color="black")
        angle_axes.set_ylabel(format_axis_label("theta", "{symbol}"))
        modes = foot_motion.contact_modes
        for row, leg_number in enumerate(touching_legs):
            for start, end, mode in find_constant_spans(walk, modes[:, leg_number - 1]):
                if mode != ContactMode.OFF:
                    bar = (start, end - start)
                    color = CONTACT_MODE_COLORS[mode]
                    mode_axes.broken_barh([bar], (row - 0.35, 0.7), color=color)
        mode_axes.set_yticks(range(len(touching_legs)), list(map(str, touching_legs)))
        mode_axes.set(ylabel="foot on\nthe ground", ylim=(len(touching_legs) - 0.5, -0.5))
        mode_handles = [
            Patch(color=CONTACT_MODE_COLORS[mode], label=CONTACT_MODE_NAMES[mode])
            for mode in np.unique(modes[is_foot_touching])
        ]
        add_side_legend(mode_axes, mode_handles)
        leg_panels += [
            (length_axes, moving_legs, walk.length, "$L$ [m]"),
            (height_axes, touching_legs, walk.foot_z, "height of\nfoot [m]"),
        ]
    for axes, drawn_legs, quantity_by_leg, panel_label in leg_panels:
        for leg_number in drawn_legs:
            line_color, line_style = line_style_by_leg[leg_number]
            axes.plot(
                times_with_gaps,
                insert_landing_gaps(walk, quantity_by_leg.values[:, leg_number - 1]),
                color=line_color,
                linestyle=line_style,
                label=f"Leg {leg_number}",
            )
        axes.set_ylabel(panel_label)
    for axes in panel_axes[-3:]:
        axes.axhline(0.0, color=DARK_GRAY_COLOR, linewidth=0.4, zorder=0)
    add_side_legend(panel_axes[0] if forces_only else length_axes)
    figure.align_ylabels(panel_axes)
    return figure


def draw_sticks(axes: Axes, walk: xr.Dataset, stick_interval: float) -> None:
    """Draw Legs 1 and 2 and every leg on the ground at equal time intervals.

    The sticks have the colors of the phases. For walks with unilateral contact, the feet have the
    colors of their contact modes instead. `stick_interval` is in s.
    """
    foot_motion = compute_foot_motion(walk)
    stick_times = np.arange(0.0, foot_motion.sample_times[-1], stick_interval)
    sample_indices = np.searchsorted(foot_motion.sample_times, stick_times)
    is_leg_drawn = foot_motion.contact_modes != ContactMode.OFF
    is_leg_drawn[:, :2] = True
    has_contact_modes = "contact" in walk
    line_width = 0.7 if has_contact_modes else 0.8
    for sample_index in sample_indices:
        drawn_legs = np.flatnonzero(is_leg_drawn[sample_index])
        foot_positions = foot_motion.foot_positions[sample_index, drawn_legs]
        for leg_number, foot_position in zip(
            (drawn_legs + 1).tolist(), foot_positions, strict=True
        ):
            if has_contact_modes:
                stick_color = "black" if leg_number < 3 else DARK_GRAY_COLOR
            else:
                stick_color = PHASE_STICK_COLORS[int(walk.phase[sample_index])]
            axes.plot(
                *np.stack([foot_position, foot_motion.hub_positions[sample_index]], -1),
                color=stick_color,
                linestyle=STICK_LINE_STYLES.get(leg_number, "--"),
                linewidth=line_width,
            )
        if has_contact_modes:
            contact_modes = foot_motion.contact_modes[sample_index, drawn_legs]
            draw_feet(axes, foot_positions.T, contact_modes, 4.0)
    legend_leg_labels = [(1, "Leg 1"), (2, "Leg 2")]
    if is_leg_drawn[sample_indices, 2:].any():
        legend_leg_labels.append((3, "another leg"))
    for leg_number, legend_text in legend_leg_labels:
        line_style = STICK_LINE_STYLES.get(leg_number, "--")
        axes.plot(
            [], [], color="black", linestyle=line_style, linewidth=line_width, label=legend_text
        )
    axes.plot([], [], color=LEG_2_COLOR, label="hub")
    if not has_contact_modes:
        for phase_name, phase_color in zip(PHASE_NAMES, PHASE_STICK_COLORS, strict=True):
            axes.plot([], [], color=phase_color, linewidth=3.0, label=phase_name)
        return
    for legend_handle in make_contact_mode_handles(
        foot_motion.contact_modes[sample_indices][is_leg_drawn[sample_indices]]
    ):
        axes.add_line(legend_handle)


NO_WALK_REMEDY = "give vrw.simulate(params, model=...), of any model of the wheel"
"""Remedy in the error message for a dataset that is not a walk."""


def require_nonempty_walk(argument_name: str, walk: xr.Dataset) -> None:
    required_names = ("hub_x", "hub_z", "step", "parameter_n_legs")
    require_dataset_variables(argument_name, walk, required_names, NO_WALK_REMEDY)
    if not walk.sizes["time"]:
        raise ValueError(
            f"{argument_name} has no samples, because the walk ended at once as "
            f"{walk.attrs['outcome']}: give one that takes a step."
        )


MODE_TINTS = ("white", LIGHT_GRAY_COLOR, "#DCEBF5", "#FBE3D6", "#D9EFE7", "#F5E6EF", "#FCF9D5")
"""Backgrounds of the modes of a walker in turn, light tints of the colors of lines."""


def make_coordinate_panels(walk: xr.Dataset, width: FigureWidth) -> Figure:
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
    require_nonempty_walk("gait", gait)
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
    require_nonempty_walk("step", step)
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
