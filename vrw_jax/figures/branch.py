"""Figures of branches with their special points, and of basins of attraction."""

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from vrw_jax.branches import Border, Branch
from vrw_jax.figures.style import (
    GREEN,
    GREY,
    LEG_1,
    LEG_2,
    PAGE,
    PINK,
    YELLOW,
    all_drawable,
    axis_label,
    figure_style,
    outcome_cells,
    outcome_patches,
    panel_letter,
    typeset,
    value_label,
)
from vrw_jax.results import MEASURES, what_breaks
from vrw_jax.walks import BEFORE
from vrw_jax.wheel import Outcome
from vrw_jax.wording import instance

ENDS, BORDER = PINK, (0, (1, 1.2))
COLOURS = {"lost": ENDS, "border_collision": GREEN}
"""Colors of special points by kind; black for a change of stability, `BRANCH_END_COLOR` for the end
of a branch. Neither the colors nor the dots are those of a curve."""

EVERY = (
    ("DLS fraction", {"dls_fraction": LEG_1}),
    ("moduli of multipliers", {"spectral_radius": "black"}),
)
"""Label, and the color of each measure, of the panels of every branch."""
PANELS = (
    *EVERY,
    (
        f"${MEASURES['lambda_2_plus'].tex}$, ${MEASURES['lambda_4_plus'].tex}$ [N]",
        {"lambda_2_plus": LEG_1, "lambda_4_plus": LEG_2},
    ),
    ("clearance in SLS-I [mm]", {"clearance_sls1": LEG_2}),
)
"""Panels of a branch of the paper's model."""
OTHERS = (
    *EVERY,
    ("walking speed [m/s]", {"speed": "black"}),
    ("step period [s]", {"period": "black"}),
)
"""Panels of a branch of a model without the paper's indicators."""


def _pieces(branch: Branch) -> list[tuple[np.ndarray, bool]]:
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
        >>> figure = vrw.plot.draw_branch(branch)
    """
    instance("branch", branch, Branch, "give vrw.continue_branch(params, name, bounds)")
    values, data = branch.values, branch.dataset
    borders = sorted(branch.borders, key=lambda border: border.value)
    rows = -(-len(borders) // 2)
    figure = Figure(figsize=(PAGE, 4.0 + 0.16 * rows))
    panels = figure.subplots(2, 2, sharex=True)
    papers = "lambda_2_plus" in data
    told = PANELS if papers else OTHERS
    for axes, (label, series), letter in zip(panels.ravel(), told, "abcd", strict=True):
        panel_letter(axes, letter)
        for name, colour in series.items():
            scale = 1e3 if name == "clearance_sls1" else 1.0
            columns = [_broken(name, scale * data[name].values)]
            if name == "spectral_radius":
                columns = list(np.abs(branch.multipliers).T)
            for column in columns:
                for places, stable in _pieces(branch):
                    line = "-" if stable else "--"
                    axes.plot(values[places], column[places], line, color=colour)
        _draw_borders(axes, borders, numbered=letter in "ab")
        axes.set_ylabel(label)
    panels[0, 1].axhline(1.0, color=GREY, linewidth=0.5)
    panels[0, 1].set_ylim(0.0, None)
    if papers:
        _indicators(panels[1], 1e3 * data.clearance_sls1.values)
    for axes in panels[1]:
        axes.set_xlabel(axis_label(branch.parameter))
    _name_borders(figure, borders, branch.parameter)
    return figure


def _indicators(panels: np.ndarray, clearance: np.ndarray) -> None:
    """Draw zero lines, legend and scale of the panels of the paper's model; clearance in mm."""
    for axes in panels:
        axes.axhline(0.0, color=GREY, linewidth=0.5)
    for name, colour in PANELS[2][1].items():
        panels[0].plot([], [], color=colour, label=f"${MEASURES[name].tex}$")
    panels[0].legend(loc="center left")
    panels[1].set_yscale("symlog", linthresh=0.1)
    panels[1].set_ylim(2.0 * min(clearance.min(), -0.1), 2.0 * max(clearance.max(), 0.1))


def _broken(name: str, values: np.ndarray) -> np.ndarray:
    """Return the values, for a clearance with a gap where it jumps because a dip vanishes."""
    if name.startswith("clearance"):
        values = values.copy()
        values[1:][values[:-1] * values[1:] < 0.0] = np.nan
    return values


def _colour(border: Border) -> str:
    """Return the color of a special point."""
    return ENDS if border.ends_branch else COLOURS.get(border.kind, "black")


def _draw_borders(axes: Axes, borders: list[Border], numbered: bool) -> None:
    """Draw vertical lines at the special points, with numbers if wanted."""
    low, high = axes.get_xlim()
    last = -np.inf
    for i, border in enumerate(borders):
        axes.axvline(border.value, color=_colour(border), lw=0.7, linestyle=BORDER, zorder=0)
        if numbered:
            last = max(border.value, last + 0.03 * (high - low))
            axes.annotate(
                str(i + 1),
                (last, 1.0),
                xycoords=("data", "axes fraction"),
                ha="center",
                va="bottom",
                fontsize=7.0,
                color=_colour(border),
            )


def _name_borders(figure: Figure, borders: list[Border], parameter: str) -> None:
    """Add a legend of the special points and of the line styles."""
    handles = []
    for i, border in enumerate(borders):
        text = f"{value_label(parameter, border.value, 6)}: {typeset(what_breaks(border.name))}"
        text = f"{i + 1}  {text}" + (" (ends here)" if border.ends_branch else "")
        handles.append(
            Line2D([], [], color=_colour(border), linewidth=0.9, linestyle=BORDER, label=text)
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
        >>> figure = vrw.plot.draw_basins([basins], ["Table 1"])
    """
    all_drawable("results", results, ("outcome", "attractor"), "give vrw.basin(params, grid)")
    codes = sorted({int(c) for r in results for c in np.unique(r.outcome) if c != Outcome.STEPPED})
    figure = Figure(figsize=(PAGE, 3.3))
    panels = figure.subplots(1, len(results), sharey=True, squeeze=False)[0]
    most = max(float(r.steps.where(r.attractor >= 0).max()) for r in results)
    for axes, result, title in zip(panels, results, titles, strict=True):
        y, x = (str(d) for d in result.attractor.dims)
        steps = result.steps.where(result.attractor >= 0)
        image = axes.pcolormesh(
            result[x], result[y], steps, cmap="Greys_r", vmin=0.0, vmax=2.2 * most
        )
        image.set_rasterized(True)
        if codes:
            outcome_cells(axes, result[x].values, result[y].values, result.outcome.values, codes)
        _mark_orbits(axes, result, x, y)
        axes.set_title(title)
        axes.set_xlabel(axis_label(x, "{symbol}"))
    panels[0].set_ylabel(axis_label(str(results[0].attractor.dims[0]), "{symbol}"))
    bar = figure.colorbar(image, ax=list(panels), aspect=25, pad=0.01)
    bar.set_label("steps until the gait is reached")
    bar.ax.set_ylim(0.0, most)
    figure.legend(handles=outcome_patches(codes), loc="outside lower center", ncols=4, fontsize=7.5)
    return figure


def _mark_orbits(axes: Axes, result: xr.Dataset, x: str, y: str) -> None:
    """Draw crosses at the section states of the gaits if the plane is one of section states."""
    if not {x, y} <= set(BEFORE):
        return
    columns = [BEFORE.index(x), BEFORE.index(y)]
    states = result.orbit_state.values.reshape(-1, len(BEFORE))[:, columns]
    axes.plot(*states.T, "+", color=YELLOW, markersize=7.0, markeredgewidth=1.6)
