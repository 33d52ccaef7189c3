"""Figures of branches with their special points, and of basins of attraction."""

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from vrw_jax.branches import Branch, SpecialPoint
from vrw_jax.figures.style import (
    DARK_GRAY,
    GREEN,
    LEG_1_COLOR,
    LEG_2_COLOR,
    PAGE_WIDTH_INCHES,
    PINK,
    YELLOW,
    draw_outcome_cells,
    figure_style,
    format_axis_label,
    format_value_label,
    label_panel,
    make_outcome_patches,
    require_variables_of_all,
    typeset_symbols,
)
from vrw_jax.measures import MEASURES, describe_violation
from vrw_jax.simulation import PRE_TOUCHDOWN_NAMES
from vrw_jax.validation import check_type
from vrw_jax.wheel import Outcome

BRANCH_END_COLOR = PINK
"""Color of the end of a branch, chosen because no curve has it."""

SPECIAL_POINT_LINE_STYLE = (0, (1, 1.2))
"""Dotted line of a special point, chosen because no curve has it."""

SPECIAL_POINT_COLORS = {"lost": BRANCH_END_COLOR, "border_collision": GREEN}
"""Colors of special points by kind; those of other kinds, which change the stability, are black."""

COMMON_PANELS = (
    ("DLS fraction", {"dls_fraction": LEG_1_COLOR}),
    ("moduli of multipliers", {"spectral_radius": "black"}),
)
"""Label, and the color of each measure, of the panels of every branch."""
PAPER_PANELS = (
    *COMMON_PANELS,
    (
        f"${MEASURES['lambda_2_plus'].mathtext}$, ${MEASURES['lambda_4_plus'].mathtext}$ [N]",
        {"lambda_2_plus": LEG_1_COLOR, "lambda_4_plus": LEG_2_COLOR},
    ),
    ("clearance in SLS-I [mm]", {"clearance_sls1": LEG_2_COLOR}),
)
"""Panels of a branch of the paper's model."""
OTHER_MODEL_PANELS = (
    *COMMON_PANELS,
    ("walking speed [m/s]", {"speed": "black"}),
    ("step period [s]", {"period": "black"}),
)
"""Panels of a branch of a model without the paper's indicators."""


def _split_by_stability(branch: Branch) -> list[tuple[np.ndarray, bool]]:
    """Return indices and stability of pieces of a branch; a piece ends where the next starts."""
    cuts = np.flatnonzero(np.diff(branch.stable.astype(int))) + 1
    parts = np.split(np.arange(branch.values.size), cuts)
    return [
        (np.append(part, part[-1] + 1) if part[-1] + 1 < branch.values.size else part,
         bool(branch.stable[part[0]]))
        for part in parts
    ]  # fmt: skip


@figure_style()
def branch_figure(branch: Branch) -> Figure:
    """Return a figure of a branch with its special points.

    The panels show DLS fraction, multipliers, indicators and clearance. For models other than the
    paper's, speed and period replace the last two. Stable gaits are solid, unstable gaits dashed.
    Special points are numbered from left to right.

    Args:
        branch: result of `vrw.continue_branch` over a parameter of the wheel.

    Returns:
        Figure: four panels over the parameter, in SI units.

    Examples:
        >>> branch = vrw.continue_branch(vrw.WheelParams(), "damping", (190.0, 230.0))
        >>> figure = vrw.plot.branch_figure(branch)
    """
    check_type("branch", branch, Branch, "give vrw.continue_branch(params, name, bounds)")
    values, data = branch.values, branch.dataset
    special_points = sorted(branch.special_points, key=lambda special_point: special_point.value)
    rows = -(-len(special_points) // 2)
    figure = Figure(figsize=(PAGE_WIDTH_INCHES, 4.0 + 0.16 * rows))
    panels = figure.subplots(2, 2, sharex=True)
    has_indicators = "lambda_2_plus" in data
    shown_panels = PAPER_PANELS if has_indicators else OTHER_MODEL_PANELS
    for axes, (label, series), letter in zip(panels.ravel(), shown_panels, "abcd", strict=True):
        label_panel(axes, letter)
        for name, color in series.items():
            columns = [data[name].values]
            if name == "clearance_sls1":
                # In mm, with a gap at a jump, where a dip vanishes.
                clearance = 1e3 * data[name].values
                clearance[1:][clearance[:-1] * clearance[1:] < 0.0] = np.nan
                columns = [clearance]
            if name == "spectral_radius":
                columns = list(np.abs(branch.multipliers).T)
            for column in columns:
                for indices, stable in _split_by_stability(branch):
                    line = "-" if stable else "--"
                    axes.plot(values[indices], column[indices], line, color=color)
        _draw_special_points(axes, special_points, has_numbers=letter in "ab")
        axes.set_ylabel(label)
    panels[0, 1].axhline(1.0, color=DARK_GRAY, linewidth=0.5)
    panels[0, 1].set_ylim(0.0, None)
    force_axes, clearance_axes = panels[1]
    if has_indicators:
        for axes in (force_axes, clearance_axes):
            axes.axhline(0.0, color=DARK_GRAY, linewidth=0.5)
        for name, color in PAPER_PANELS[2][1].items():
            force_axes.plot([], [], color=color, label=f"${MEASURES[name].mathtext}$")
        force_axes.legend(loc="center left")
        clearance = 1e3 * data.clearance_sls1.values
        clearance_axes.set_yscale("symlog", linthresh=0.1)
        clearance_axes.set_ylim(2.0 * min(clearance.min(), -0.1), 2.0 * max(clearance.max(), 0.1))
    for axes in panels[1]:
        axes.set_xlabel(format_axis_label(branch.parameter))
    _add_legend(figure, special_points, branch.parameter)
    return figure


def _select_color(special_point: SpecialPoint) -> str:
    """Return the color of a special point."""
    return (
        BRANCH_END_COLOR
        if special_point.ends_branch
        else SPECIAL_POINT_COLORS.get(special_point.kind, "black")
    )


def _draw_special_points(axes: Axes, special_points: list[SpecialPoint], has_numbers: bool) -> None:
    """Draw vertical lines at the special points, with numbers if wanted."""
    low, high = axes.get_xlim()
    label_position = -np.inf
    for i, special_point in enumerate(special_points):
        axes.axvline(
            special_point.value,
            color=_select_color(special_point),
            lw=0.7,
            linestyle=SPECIAL_POINT_LINE_STYLE,
            zorder=0,
        )
        if has_numbers:
            label_position = max(special_point.value, label_position + 0.03 * (high - low))
            axes.annotate(
                str(i + 1),
                (label_position, 1.0),
                xycoords=("data", "axes fraction"),
                ha="center",
                va="bottom",
                fontsize=7.0,
                color=_select_color(special_point),
            )


def _add_legend(figure: Figure, special_points: list[SpecialPoint], parameter: str) -> None:
    """Add a legend of the special points and of the line styles."""
    handles = []
    for i, special_point in enumerate(special_points):
        violation = typeset_symbols(describe_violation(special_point.name))
        text = f"{format_value_label(parameter, special_point.value, 6)}: {violation}"
        text = f"{i + 1}  {text}" + (" (ends here)" if special_point.ends_branch else "")
        handles.append(
            Line2D(
                [],
                [],
                color=_select_color(special_point),
                linewidth=0.9,
                linestyle=SPECIAL_POINT_LINE_STYLE,
                label=text,
            )
        )
    handles.append(Line2D([], [], color="black", linestyle="-", label="stable"))
    handles.append(Line2D([], [], color="black", linestyle="--", label="unstable"))
    figure.legend(handles=handles, loc="outside lower center", ncols=2, fontsize=7.5)


@figure_style()
def basin_figure(results: list[xr.Dataset], titles: list[str]) -> Figure:
    """Return a figure of basins of attraction, one panel per result.

    Crosses mark the section states of the gaits. Shades of gray give the number of steps until the
    gait is reached, and colors the falls.

    Args:
        results: results of `vrw.basin`, each over a plane of starts.
        titles: title of each panel.

    Returns:
        Figure: the panels side by side.

    Examples:
        >>> starts = {"theta_touchdown": 0.09, "dtheta_touchdown": [1.4, 1.6]}
        >>> starts |= {"dL1_touchdown": [-0.1, 0.0]}
        >>> basins = vrw.basin(vrw.WheelParams(), starts)
        >>> figure = vrw.plot.basin_figure([basins], ["Table 1"])
    """
    require_variables_of_all(
        "results", results, ("outcome", "attractor"), "give vrw.basin(params, grid)"
    )
    codes = sorted({int(c) for r in results for c in np.unique(r.outcome) if c != Outcome.STEPPED})
    figure = Figure(figsize=(PAGE_WIDTH_INCHES, 3.3))
    panels = figure.subplots(1, len(results), sharey=True, squeeze=False)[0]
    max_steps = max(float(r.steps.where(r.attractor >= 0).max()) for r in results)
    for axes, result, title in zip(panels, results, titles, strict=True):
        y, x = (str(d) for d in result.attractor.dims)
        steps = result.steps.where(result.attractor >= 0)
        image = axes.pcolormesh(
            result[x], result[y], steps, cmap="Greys_r", vmin=0.0, vmax=2.2 * max_steps
        )
        image.set_rasterized(True)
        if codes:
            draw_outcome_cells(
                axes, result[x].values, result[y].values, result.outcome.values, codes
            )
        if {x, y} <= set(PRE_TOUCHDOWN_NAMES):
            states = result.orbit_state.values.reshape(-1, len(PRE_TOUCHDOWN_NAMES))
            shown_columns = [PRE_TOUCHDOWN_NAMES.index(x), PRE_TOUCHDOWN_NAMES.index(y)]
            axes.plot(
                *states[:, shown_columns].T, "+", color=YELLOW, markersize=7.0, markeredgewidth=1.6
            )
        axes.set_title(title)
        axes.set_xlabel(format_axis_label(x, "{symbol}"))
    panels[0].set_ylabel(format_axis_label(str(results[0].attractor.dims[0]), "{symbol}"))
    bar = figure.colorbar(image, ax=list(panels), aspect=25, pad=0.01)
    bar.set_label("steps until the gait is reached")
    bar.ax.set_ylim(0.0, max_steps)
    figure.legend(
        handles=make_outcome_patches(codes), loc="outside lower center", ncols=4, fontsize=7.5
    )
    return figure
