"""Figures of the causes of a second force peak, and of peaks over leg mass, friction and contact.

The command `python -m experiments.gaits.force_peaks` draws them from the stored tables.
"""

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

import vrw_jax as vrw
from experiments.gaits.force_peak_comparisons import (
    CONTACT_TABLE,
    DAMPING_TABLE,
    FRICTION_STIFFNESS_NUMBER,
    LEG_MASS_TABLE,
    MAP_FRICTION,
    MAP_SLOPE,
)
from experiments.gaits.force_peak_stances import SPRING_MASS_TABLE, STANCE_TABLE
from experiments.gaits.force_peak_wheels import (
    compute_damping_ratio,
    compute_leg_share,
    compute_stiffness_number,
)
from experiments.shared.tables import FIGURES, Row, group_rows, read_column, read_table
from vrw_jax import plot as plots

PEAK_COLORS = {0: "#56B4E9", 1: "#0072B2", 2: "#E69F00", 3: "#D55E00"}
"""Colors of Okabe and Ito by number of peaks."""

PEAK_LABELS = {0: "no smooth peak", 1: "one peak", 2: "two peaks", 3: "three peaks"}
STIFFNESS_LABEL = "stiffness $k L_0 / (M g)$"
SLOPE_LABEL = "slope $\\phi$ [rad]"


def format_log_axes(axis: Axes, x_ticks: list[float], y_ticks: list[float]) -> None:
    """Give both logarithmic axes ticks with plain numbers."""
    axis.set_xscale("log")
    axis.set_yscale("log")
    axis.set_xticks(x_ticks, [f"{x:g}" for x in x_ticks])
    axis.set_yticks(y_ticks, [f"{y:g}" for y in y_ticks])
    axis.minorticks_off()


def count_separated_peaks(row: Row) -> int:
    """Return the number of force peaks of a gait, 1 if no smooth trough lies between two of them.

    With unilateral contact an event may separate two maxima, which then form one jagged peak.
    """
    n_peaks = int(float(row["n_force_peaks"]))
    return n_peaks if float(row["force_trough_depth"]) > 0.0 else min(n_peaks, 1)


def draw_peak_map(
    axis: Axes, rows: list[Row], x_name: str, y_name: str, largest_number: int
) -> None:
    """Draw the numbers of peaks of a map as colored cells; gray cells have no gait.

    Gaits with more peaks than `largest_number` have the color of this number.
    """
    rows = [row for row in rows if row[x_name]]
    x_values, y_values = (np.unique(read_column(rows, name)) for name in (x_name, y_name))
    n_peaks = np.full((len(y_values), len(x_values)), np.nan)
    for row in rows:
        if row["n_force_peaks"]:
            i, j = (
                int(np.searchsorted(values, float(row[name])))
                for values, name in ((y_values, y_name), (x_values, x_name))
            )
            n_peaks[i, j] = min(count_separated_peaks(row), largest_number)
    axis.set_facecolor(plots.LIGHT_GRAY_COLOR)
    axis.pcolormesh(x_values, y_values, n_peaks, shading="nearest",
                    cmap=ListedColormap(list(PEAK_COLORS.values())),
                    vmin=-0.5, vmax=len(PEAK_COLORS) - 0.5, rasterized=True)  # fmt: skip


def draw_causes(map_rows: list[Row]) -> None:
    """Draw forces over a stance, times of peaks in periods of the bounce, and a map of damping."""
    figure, panels = plt.subplot_mosaic(
        [["stances", "stances"], ["times", "dampings"]],
        figsize=(plots.PAGE_FIGURE_WIDTH_INCHES, 5.4),
        height_ratios=(1.0, 1.15),
    )
    draw_stances(panels["stances"])
    draw_peak_times(panels["times"], map_rows)
    draw_dampings(panels["dampings"])
    for letter, axis in zip("abc", panels.values(), strict=True):
        plots.style.draw_panel_letter(axis, letter)
    plots.save(figure, FIGURES, "force_peak_causes")


def draw_stances(axis: Axes) -> None:
    """Draw the force on one foot, from its landing to its lift-off, of three walkers."""
    labels = {"table_1": "Table 1", "two_peaks": "two-peak wheel"}
    colors = (plots.style.OKABE_ITO_BLUE, plots.style.OKABE_ITO_ORANGE, plots.DARK_GRAY_COLOR)
    for color, (walker, rows) in zip(
        colors, group_rows(read_table(STANCE_TABLE), "walker").items(), strict=True
    ):
        axis.plot(read_column(rows, "time_to_period"), read_column(rows, "force_to_weight"),
                  color=color, label=labels.get(walker, walker))  # fmt: skip
    axis.axvline(1.0, color=plots.DARK_GRAY_COLOR, linewidth=0.7, linestyle=":")
    axis.text(0.99, 0.93, "next touchdown", fontsize=8, ha="right",
              transform=axis.get_xaxis_transform())  # fmt: skip
    axis.set_xlabel("time since the landing of the foot [durations of a step]")
    axis.set_ylabel("force on the foot / weight")
    axis.set_ylim(0.0, 1.6)
    axis.legend(loc="upper right")


def draw_peak_times(axis: Axes, map_rows: list[Row]) -> None:
    """Draw the time from the first peak to the next touchdown over stiffness, one dot per gait."""
    gaits = [row for row in map_rows if row["first_peak_to_touchdown"]]
    for n_peaks, rows in sorted(group_rows(gaits, "n_force_peaks").items()):
        axis.plot(
            read_column(rows, "first_peak_to_touchdown"), read_column(rows, "stiffness_number"),
            "o", color=PEAK_COLORS[int(n_peaks)], markersize=3, label=PEAK_LABELS[int(n_peaks)],
        )  # fmt: skip
    axis.axvline(0.75, color=plots.DARK_GRAY_COLOR, linewidth=0.7, linestyle=":", zorder=0)
    axis.set_xticks([0.0, 0.75, 2.0, 3.0], ["0", "0.75", "2", "3"])
    axis.set_xlabel("first peak to next touchdown\n[periods of the bounce]")
    format_stiffness_axis(axis)
    axis.legend(loc="lower right")


def draw_dampings(axis: Axes) -> None:
    """Draw the numbers of peaks over damping and stiffness, and the marked walkers."""
    draw_peak_map(axis, read_table(DAMPING_TABLE), "damping_ratio", "stiffness_number", 3)
    for name, marker, label in (
        ("table_1", "D", "Table 1 (at 0.3 rad)"),
        ("two_peaks", "*", "two-peak wheel"),
    ):
        params = vrw.parameter_sets[name].params
        axis.plot(compute_damping_ratio(params), compute_stiffness_number(params), marker,
                  color="white", markeredgecolor="black", markersize=8, label=label,
                  linestyle="none", clip_on=False)  # fmt: skip
    spring_mass = read_table(SPRING_MASS_TABLE)[0]
    axis.plot(0.0, float(spring_mass["stiffness_number"]), "^", color="white",
              markeredgecolor="black", markersize=7, label="spring-mass walker",
              linestyle="none", clip_on=False)  # fmt: skip
    axis.set_xlabel("damping ratio $c / (2 \\sqrt{k M})$")
    axis.set_title(f"slope {MAP_SLOPE:g} rad")
    axis.set_xlim(left=0.0)
    format_stiffness_axis(axis)
    color_handles = [
        Patch(color=plots.LIGHT_GRAY_COLOR, label="no gait found"),
        *(Patch(color=PEAK_COLORS[n], label=PEAK_LABELS[n]) for n in range(3)),
    ]
    axis.legend(handles=[*color_handles, *axis.get_legend_handles_labels()[0]],
                loc="upper center", bbox_to_anchor=(0.5, -0.24), ncols=2, fontsize=7)  # fmt: skip


def format_stiffness_axis(axis: Axes) -> None:
    """Give the vertical axis the stiffness, with plain numbers on a logarithmic scale."""
    axis.set_ylabel(STIFFNESS_LABEL)
    axis.set_yscale("log")
    axis.set_yticks([2, 3, 5, 10, 20], ["2", "3", "5", "10", "20"])
    axis.minorticks_off()


def draw_comparisons() -> None:
    """Draw the numbers of peaks over leg mass, with unilateral contact, and over friction."""
    figure, axes = plt.subplots(1, 3, figsize=(plots.PAGE_FIGURE_WIDTH_INCHES, 3.0))
    draw_peak_map(axes[0], read_table(LEG_MASS_TABLE), "leg_share", "stiffness_number", 2)
    axes[0].set_yscale("log")
    axes[0].set_yticks([3, 5, 10, 20], ["3", "5", "10", "20"])
    axes[0].minorticks_off()
    table_1_share = compute_leg_share(vrw.WheelParams())
    axes[0].axvline(table_1_share, color="black", linewidth=0.7, linestyle=":")
    axes[0].set_xlabel("mass of all legs / $M$")
    axes[0].set_ylabel(STIFFNESS_LABEL)
    axes[0].set_title(f"paper's model, $\\phi$ = {MAP_SLOPE:g} rad")
    maps = group_rows(read_table(CONTACT_TABLE), "map")
    draw_peak_map(axes[1], maps["stiffness"], "slope", "stiffness_number", 2)
    format_log_axes(axes[1], [0.03, 0.05, 0.1, 0.2], [3, 5, 10, 20])
    axes[1].set_xlabel(SLOPE_LABEL)
    axes[1].set_ylabel(STIFFNESS_LABEL)
    axes[1].set_title(f"unilateral contact, $\\mu$ = {MAP_FRICTION:g}")
    draw_peak_map(axes[2], maps["friction"], "slope", "friction", 2)
    format_log_axes(axes[2], [0.03, 0.05, 0.1, 0.2], [0.2, 0.5, 1, 3])
    axes[2].set_xlabel(SLOPE_LABEL)
    axes[2].set_ylabel("friction coefficient $\\mu$")
    axes[2].set_title(f"the same, $k L_0/(M g)$ = {FRICTION_STIFFNESS_NUMBER:g}")
    shown: list[Patch | Line2D] = [Patch(color=plots.LIGHT_GRAY_COLOR, label="no gait found")]
    labels = {0: PEAK_LABELS[0], 1: PEAK_LABELS[1], 2: "two or more peaks with a trough"}
    shown += [Patch(color=PEAK_COLORS[n], label=label) for n, label in labels.items()]
    shown.append(Line2D([], [], color="black", linewidth=0.7, linestyle=":",
                        label="leg mass of Table 1"))  # fmt: skip
    figure.legend(handles=shown, loc="outside lower center", ncols=3)
    plots.save(figure, FIGURES, "force_peak_comparisons")
