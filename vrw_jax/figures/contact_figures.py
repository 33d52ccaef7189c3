"""Motion of the feet of any model, and figures of their contact modes."""

from typing import NamedTuple

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from vrw_jax.contact import ContactMode
from vrw_jax.figures.style import (
    AMBER,
    DARK_GRAY,
    GREEN,
    LEG_1_COLOR,
    LEG_2_COLOR,
    PAGE_WIDTH_INCHES,
    PINK,
    SKY,
    format_axis_label,
    label_panel,
)
from vrw_jax.measures import CONTACT_MODE_NAMES

CONTACT_COLORS = ("white", GREEN, AMBER, PINK)
"""Colors of the contact modes, by code."""

CONTACT_MARKERS = ("o", "o", ">", "<")
"""Markers of the contact modes, by code, because some readers see green and pink as one gray."""

OTHER_LEG_COLOR = "#999999"
"""Color of every leg other than Legs 1 and 2."""

LEG_LINES = {1: (LEG_1_COLOR, "-"), 2: (LEG_2_COLOR, "--")}
"""Color and line style of Legs 1 and 2 over time."""

OTHER_LEG_LINES = (
    (SKY, "-."), (PINK, ":"), (AMBER, (0, (8, 3))), (DARK_GRAY, (0, (5, 1, 1, 1, 1, 1))),
)  # fmt: skip
"""Color and line style of the other legs that move or touch, in the order of their numbers."""


class FootMotion(NamedTuple):
    """Motion of hub and feet over a walk, in the slope's frame.

    Legs have the labels of each step: Leg 1 is the front leg at the landing, and Leg 2 follows it.
    """

    time: np.ndarray  # (time,), s
    hub: np.ndarray  # (time, 2), x downhill and z normal to the slope, m
    feet: np.ndarray  # (time, leg, 2), in the same coordinates, m
    forces: np.ndarray  # (time, leg, 2), tangential and normal force, N
    contact: np.ndarray  # (time, leg), contact mode
    step: np.ndarray  # (time,), number of the step

    def interpolate(self, t: float) -> tuple[np.ndarray, np.ndarray, int]:
        """Return hub, feet, and the index of the sample of contact modes and forces, at the time
        `t`, s.
        """
        index_after = min(int(np.searchsorted(self.time, t, side="right")), self.time.size - 1)
        index_before = max(index_after - 1, 0)
        interval = self.time[index_after] - self.time[index_before]
        fraction = (t - self.time[index_before]) / interval if interval > 0.0 else 1.0
        interpolate_samples = lambda values: (
            (1.0 - fraction) * values[index_before] + fraction * values[index_after]
        )
        return interpolate_samples(self.hub), interpolate_samples(self.feet), index_after


def reports_contact_modes(walk: xr.Dataset) -> bool:
    """Return whether a trajectory contains the contact modes of each leg."""
    return "contact" in walk.variables


def compute_foot_motion(walk: xr.Dataset) -> FootMotion:
    """Return the motion of the feet of a trajectory of any model.

    In the paper's phases no foot slides: Leg 1 is at rest, and so is Leg 2 in double support.
    """
    hub = np.stack([walk.hub_x.values, walk.hub_z.values], -1)
    if reports_contact_modes(walk):
        feet = np.stack([walk.foot_x.values, walk.foot_z.values], -1)
        forces = np.stack([walk.tangential.values, walk.normal.values], -1)
        modes = walk.contact.values
        return FootMotion(walk.time.values, hub, feet, forces, modes, walk.step.values)
    n_legs = int(walk.attrs["parameter_n_legs"])
    angles = walk.theta.values[:, None] + 2.0 * np.pi / n_legs * np.arange(n_legs)
    leg_lengths = np.full(angles.shape, walk.attrs["parameter_locked_length"])
    leg_lengths[:, 0] = walk.L1.values
    leg_lengths[:, 1] = walk.L2.values
    feet = hub[:, None] - leg_lengths[..., None] * np.stack([np.sin(angles), np.cos(angles)], -1)
    forces = np.zeros_like(feet)
    for leg in (1, 2):
        names = f"lambda_{2 * leg - 1}", f"lambda_{2 * leg}"
        forces[:, leg - 1] = np.stack([walk[name].values for name in names], -1)
    modes = np.full(angles.shape, ContactMode.OFF)
    modes[:, 0] = ContactMode.STICK
    modes[walk.phase.values == 0, 1] = ContactMode.STICK
    return FootMotion(walk.time.values, hub, feet, forces, modes, walk.step.values)


def select_leg_color(leg: int) -> str:
    """Return the color of a leg by its number, from 1."""
    return {1: LEG_1_COLOR, 2: LEG_2_COLOR}.get(leg, OTHER_LEG_COLOR)


def draw_feet(axes: Axes, positions: np.ndarray, modes: np.ndarray, marker_size: float) -> None:
    """Draw feet at `positions`, shape (2, feet), as markers in the colors of their contact
    modes.
    """
    for mode in np.unique(modes):
        axes.plot(
            *positions[:, modes == mode],
            CONTACT_MARKERS[mode],
            color=CONTACT_COLORS[mode],
            zorder=8,
            markersize=marker_size,
            markeredgecolor=DARK_GRAY,
            markeredgewidth=0.1 * marker_size,
        )


def make_mode_handles(modes: np.ndarray) -> list[Line2D]:
    """Return a legend entry for each of the contact modes that occur in `modes`."""
    return [
        Line2D([], [], linestyle="", marker=CONTACT_MARKERS[mode], color=CONTACT_COLORS[mode],
               markeredgecolor=DARK_GRAY, markeredgewidth=0.5, label=CONTACT_MODE_NAMES[mode])
        for mode in np.unique(modes)
    ]  # fmt: skip


def _select_legs(is_drawn: np.ndarray) -> list[int]:
    """Return the numbers of Legs 1 and 2, and of the legs that are ever marked in `is_drawn`,
    (time, leg).
    """
    return [
        leg
        for leg, is_marked in enumerate(np.any(is_drawn, axis=0).tolist(), 1)
        if is_marked or leg < 3
    ]


def make_contact_panels(walk: xr.Dataset) -> Figure:
    """Return a figure of angle, leg lengths, contact modes, foot heights and forces over time."""
    motion = compute_foot_motion(walk)
    is_touching = motion.contact != ContactMode.OFF
    touching_legs = _select_legs(is_touching)
    moving_legs = _select_legs(is_touching | ~walk.on_stopper.values.astype(bool))
    landing_indices = (
        np.flatnonzero(np.diff(motion.step)) + 1
    )  # At landings the legs are relabeled.
    insert_gaps = lambda values: np.insert(np.asarray(values, float), landing_indices, np.nan)
    time = insert_gaps(motion.time)
    other_leg_lines = iter(OTHER_LEG_LINES * len(moving_legs))
    lines = {leg: LEG_LINES.get(leg) or next(other_leg_lines) for leg in moving_legs}
    figure = Figure(figsize=(0.8 * PAGE_WIDTH_INCHES, 8.0))
    heights = [1.0, 1.0, 0.35 + 0.11 * len(touching_legs), 1.0, 1.2, 1.2]
    panels = figure.subplots(6, 1, sharex=True, height_ratios=heights)
    for axes, panel_letter in zip(panels, "abcdef", strict=True):
        label_panel(axes, panel_letter)
    panels[0].plot(time, insert_gaps(walk.theta), color="black")
    panels[0].set_ylabel(format_axis_label("theta", "{symbol}"))
    rows = (
        (panels[1], moving_legs, walk.length.values, "$L$ [m]"),
        (panels[3], touching_legs, motion.feet[..., 1], "height of\nfoot [m]"),
        (panels[4], touching_legs, motion.forces[..., 1], "normal\nforce [N]"),
        (panels[5], touching_legs, motion.forces[..., 0], "tangential\nforce [N]"),
    )
    for axes, legs, values, label in rows:
        for leg in legs:
            color, line_style = lines[leg]
            leg_values = insert_gaps(values[:, leg - 1])
            axes.plot(time, leg_values, color=color, linestyle=line_style, label=f"Leg {leg}")
        axes.set_ylabel(label)
    for axes in panels[3:]:
        axes.axhline(0.0, color=DARK_GRAY, linewidth=0.4, zorder=0)
    _draw_mode_bars(panels[2], motion, touching_legs)
    panels[5].set_xlabel("time [s]")
    panels[5].set_xlim(motion.time[0], motion.time[-1])
    panels[1].legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
    figure.align_ylabels(panels)
    return figure


def _draw_mode_bars(axes: Axes, motion: FootMotion, legs: list[int]) -> None:
    """Draw the contact modes of each leg over time as bars in their colors."""
    for bar_row, leg in enumerate(legs):
        modes = motion.contact[:, leg - 1]
        change_indices = np.flatnonzero(np.diff(modes) | np.diff(motion.step)) + 1
        for start_index, end_index in zip(
            np.r_[0, change_indices], np.r_[change_indices, len(modes)], strict=True
        ):
            if modes[start_index] != ContactMode.OFF:
                time_span = (
                    motion.time[start_index],
                    motion.time[end_index - 1] - motion.time[start_index],
                )
                axes.broken_barh(
                    [time_span], (bar_row - 0.35, 0.7), color=CONTACT_COLORS[modes[start_index]]
                )
    axes.set_yticks(range(len(legs)), [str(leg) for leg in legs])
    axes.set_ylim(len(legs) - 0.5, -0.5)
    axes.set_ylabel("foot on\nthe ground")
    present_modes = np.unique(motion.contact[:, np.array(legs) - 1])
    patches = [
        Patch(color=CONTACT_COLORS[mode], label=CONTACT_MODE_NAMES[mode])
        for mode in present_modes
        if mode != ContactMode.OFF
    ]
    axes.legend(handles=patches, loc="center left", bbox_to_anchor=(1.0, 0.5))


def draw_contact_sticks(axes: Axes, walk: xr.Dataset, interval: float) -> None:
    """Draw Legs 1 and 2 and every leg that touches, with feet in the colors of their contact
    modes.
    """
    motion = compute_foot_motion(walk)
    samples = np.searchsorted(motion.time, np.arange(0.0, motion.time[-1], interval))
    is_drawn = motion.contact != ContactMode.OFF
    is_drawn[:, :2] = True
    for sample_index in samples:
        for leg in (np.flatnonzero(is_drawn[sample_index]) + 1).tolist():
            stick_coordinates = np.stack(
                [motion.feet[sample_index, leg - 1], motion.hub[sample_index]], -1
            )
            color = "black" if leg < 3 else DARK_GRAY
            axes.plot(
                *stick_coordinates, color=color, linestyle=_stick_line_style(leg), linewidth=0.7
            )
        draw_feet(
            axes,
            motion.feet[sample_index, is_drawn[sample_index]].T,
            motion.contact[sample_index, is_drawn[sample_index]],
            4.0,
        )
    named_legs = [(1, "Leg 1"), (2, "Leg 2")]
    if is_drawn[samples, 2:].any():
        named_legs.append((3, "another leg"))
    for leg, name in named_legs:
        line_style = _stick_line_style(leg)
        axes.plot([], [], color="black", linestyle=line_style, linewidth=0.7, label=name)
    axes.plot([], [], color=LEG_2_COLOR, label="hub")
    for handle in make_mode_handles(motion.contact[samples][is_drawn[samples]]):
        axes.add_line(handle)


def _stick_line_style(leg: int) -> str:
    """Return the line style of a leg in a stick diagram."""
    return {1: "-", 2: ":"}.get(leg, "--")
