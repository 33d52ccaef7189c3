"""Figures of scans: DLS fraction, speed and outcome over parameters, with borders of gaits."""

from collections.abc import Mapping, Sequence
from typing import Any, Literal

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.collections import PathCollection
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.lines import Line2D
from matplotlib.patheffects import Normal, Stroke

from vrw_jax.branches import BorderCurve
from vrw_jax.figures.style import (
    AMBER,
    BLUE,
    COLUMN,
    LIGHT,
    OUTCOMES,
    PAGE,
    UNSTABLE,
    axis_label,
    border_style,
    drawable,
    figure_style,
    outcome_cells,
    outcome_patches,
    outcome_style,
    typeset,
    value_label,
)
from vrw_jax.results import MARGINS, MEASURES, what_breaks
from vrw_jax.scans import OF_CYCLE, SALTELLI, SWEPT, manifest_of, sobol_indices
from vrw_jax.wheel import Outcome

PREFERRED = ("damping", "slope", "stiffness", "natural_length", *SWEPT)
"""Parameters in the order in which figures use them: horizontal, vertical, then columns."""

BORDERS = (
    "fore_foot_force", "takeoff_acceleration", "clearance_sls1", "clearance_sls2",
    "locked_stopper_force", "rear_stopper_force", "contraction", "friction_fore",
    "landing_friction_fore", "hit_planted_impulse",
)  # fmt: skip
"""Margins whose zero lines are drawn."""

MOST_COLUMNS, MOST_PAIRED, MOST_DRAWN = 4, 6, 20_000
"""Largest numbers of columns, of parameters in pairs, and of drawn samples."""


def scan_figures(scan: xr.Dataset) -> dict[str, Figure]:
    """Return the figures of a scan by name, one for each axis beyond the first two.

    Args:
        scan: dataset of `vrw.scan` over a grid or samples.

    Returns:
        dict[str, Figure]: the figures, whose names depend on the design.

    Examples:
        >>> gaits = vrw.scan(vrw.grid(damping=[150.0, 200.0]), ["speed", "dls_fraction"])
        >>> sorted(vrw.plot.draw_scan(gaits))
        ['scan']
    """
    drawable("scan", scan, ("outcome",), "give vrw.scan(design)")
    names = [name for name in dict.fromkeys(PREFERRED) if name in scan.coords]
    if "sample" in scan.dims:
        swept = [name for name in names if np.ptp(scan[name].values) > 0.0] or names
        if len(swept) < 3:
            return {"scan": sample_figure(scan, swept)}
        figures = {"scan_pairs": pairs_figure(scan, swept[:MOST_PAIRED])}
        if manifest_of(scan.attrs).get("design", {}).get("kind") == SALTELLI:
            measures = [n for n in OF_CYCLE if n in scan]
            figures["sobol_indices"] = indices_figure(sobol_indices(scan, measures))
        return figures
    long = [name for name in names if scan.sizes[name] > 1] or names
    if len(long) == 1:
        return {"scan": curve_figure(scan, long[0])}
    others = long[2:]
    if not others:
        return {"scan": slice_figure(scan, long[0], long[1])}
    return {f"scan_over_{name}": slice_figure(scan, long[0], long[1], name) for name in others}


@figure_style()
def slice_figure(scan: xr.Dataset, x: str, y: str, across: str | None = None) -> Figure:
    """Return a figure over (x, y), with one column for each value of the parameter `across`.

    It shows DLS fraction, speed and outcome. Other axes are cut at their middle value, which is in
    the title. Gray cells have no gait.
    """
    cut = {n: scan.sizes[n] // 2 for n in SWEPT if n in scan.dims}
    cut = {name: place for name, place in cut.items() if name not in (x, y, across)}
    shown = scan.isel(cut)
    columns = [shown]
    if across is not None:
        n = scan.sizes[across]
        places = np.unique(np.linspace(0, n - 1, min(n, MOST_COLUMNS)).round().astype(int))
        columns = [shown.isel({across: int(place)}) for place in places]
    rows = _shown(scan)
    width = PAGE if len(columns) > 1 else COLUMN
    figure = Figure(figsize=(width, 1.65 * (len(rows) + 1) + 1.0))
    panels = figure.subplots(len(rows) + 1, len(columns), sharex=True, sharey=True, squeeze=False)
    for row, name in zip(panels, rows, strict=False):
        values = [column[name].transpose(y, x).values for column in columns]
        stable = [_codes(column).transpose(y, x).values == Outcome.STEPPED for column in columns]
        limits = _limits(values, stable)
        for axes, column, value in zip(row, columns, values, strict=True):
            image = _cells(axes, column[x].values, column[y].values, value, limits)
        beyond = _extended(values, limits)
        bar = figure.colorbar(image, ax=row.tolist(), aspect=12, pad=0.01, extend=beyond)
        bar.set_label(axis_label(name, "{name}"))
    codes = np.unique([_codes(column).values for column in columns])
    for axes, column in zip(panels[-1], columns, strict=True):
        kinds = _codes(column).transpose(y, x).values
        outcome_cells(axes, _edges(column[x].values), _edges(column[y].values), kinds, codes)
    drawn: dict[str, Line2D] = {}
    for panel_row in panels:
        for axes, column in zip(panel_row, columns, strict=True):
            drawn |= _borders(axes, column, x, y)
    for axes, column in zip(panels[0], columns, strict=True):
        if across is not None:
            axes.set_title(value_label(across, column[across].item()))
    for axes in panels[-1]:
        axes.set_xlabel(axis_label(x) if len(columns) < 3 else axis_label(x, "{symbol}"))
    for axes in panels[:, 0]:
        axes.set_ylabel(axis_label(y, "{symbol}"))
    _legend(figure, codes, drawn, len(columns))
    if cut:
        where = ", ".join(value_label(n, scan[n].values[i]) for n, i in cut.items())
        figure.suptitle(f"at {where}", fontsize=9.0)
    return figure


@figure_style()
def sample_figure(scan: xr.Dataset, names: Sequence[str]) -> Figure:
    """Return a figure of single samples over the first two parameters."""
    x, y = (names[0], names[1]) if len(names) > 1 else (names[0], "sample")
    rows = _shown(scan)
    size = float(np.clip(3000.0 / max(scan.sizes["sample"], 1), 1.0, 12.0))
    figure = Figure(figsize=(PAGE, 2.9))
    panels = figure.subplots(1, len(rows) + 1, sharey=True, squeeze=False)[0]
    for axes, name in zip(panels, rows, strict=False):
        points = _draw_values(axes, scan, x, y, name, size)
        beyond = _extended([scan[name].values], points.get_clim())
        bar = figure.colorbar(points, ax=axes, location="top", aspect=25, extend=beyond)
        bar.set_label(axis_label(name))
    codes = _codes(scan).values
    _draw_outcomes(panels[-1], scan[x].values, scan[y].values, codes, size)
    for axes in panels:
        axes.set_xlabel(axis_label(x, "{symbol}"))
    panels[0].set_ylabel("sample" if y == "sample" else axis_label(y, "{symbol}"))
    _legend(figure, np.unique(codes), {}, 3)
    return figure


@figure_style()
def pairs_figure(scan: xr.Dataset, names: Sequence[str]) -> Figure:
    """Return a figure of samples over each pair of parameters.

    It shows the DLS fraction below the diagonal and the outcome above it. The diagonal shows the
    share of samples with a stable cycle. Of a large design only the first `MAX_DRAWN_SAMPLES`
    samples are drawn, which are as evenly spread as all.
    """
    shown = scan.isel(sample=slice(MOST_DRAWN))
    value = next(iter(_shown(scan)), None)
    codes = _codes(shown).values
    d = len(names)
    size = float(np.clip(8000.0 / len(codes), 0.6, 8.0))
    figure = Figure(figsize=(PAGE, PAGE * 0.9))
    panels = figure.subplots(d, d, sharex="col", squeeze=False)
    points = None
    for (i, j), axes in np.ndenumerate(panels):
        x, y = shown[names[j]].values, shown[names[i]].values
        if i == j:
            _share_along(axes, x, codes == Outcome.STEPPED)
        elif i < j:
            _draw_outcomes(axes, x, y, codes, size)
        elif value is not None:
            points = _draw_values(axes, shown, names[j], names[i], value, size)
        if i == d - 1:
            axes.set_xlabel(axis_label(names[j], "{symbol}"))
        if j == 0 and i > 0:
            axes.set_ylabel(axis_label(names[i], "{symbol}"))
        elif i != j:
            axes.tick_params(labelleft=False)
    panels[0, 0].set_ylabel("share that walks")
    if value is not None and points is not None:
        beyond = _extended([shown[value].values], points.get_clim())
        around = panels.ravel().tolist()
        bar = figure.colorbar(points, ax=around, aspect=40, pad=0.01, extend=beyond)
        bar.set_label(axis_label(value, "{name}"))
    _legend(figure, np.unique(codes), {}, 3)
    return figure


def _draw_values(
    axes: Axes, scan: xr.Dataset, x: str, y: str, name: str, size: float
) -> PathCollection:
    """Draw samples in the colors of a measure, and in gray if they have no gait."""
    dot: dict[str, Any] = {"s": size, "linewidths": 0.0, "rasterized": True}
    walks, values = scan.outcome.values == Outcome.STEPPED, scan[name].values
    low, high = _limits([values], [_codes(scan).values == Outcome.STEPPED])
    across, up = scan[x].values, scan[y].values
    axes.scatter(across[~walks], up[~walks], color=LIGHT, **dot)
    return axes.scatter(across[walks], up[walks], c=values[walks], vmin=low, vmax=high, **dot)


def _draw_outcomes(
    axes: Axes, x: np.ndarray, y: np.ndarray, codes: np.ndarray, size: float
) -> None:
    """Draw samples in the colors of their outcomes."""
    colors = [outcome_style(int(code))[1] for code in codes]
    axes.scatter(x, y, s=size, color=colors, linewidths=0.0, rasterized=True)


def _share_along(axes: Axes, x: np.ndarray, walks: np.ndarray) -> None:
    """Draw the share of samples with a stable gait along a parameter."""
    edges = np.linspace(x.min(), x.max(), 13)
    every, good = (np.histogram(some, edges)[0] for some in (x, x[walks]))
    axes.stairs(good / np.maximum(every, 1), edges, fill=True, color=OUTCOMES[Outcome.STEPPED][1])
    axes.set_ylim(0.0, 1.0)


@figure_style()
def indices_figure(indices: xr.Dataset) -> Figure:
    """Return a figure of the Sobol' indices of each measure with their intervals."""
    measures, parameters = indices.measure.values, [str(p) for p in indices.parameter.values]
    n_columns = min(len(measures), 3)
    n_rows = -(-len(measures) // n_columns)
    places = np.arange(len(parameters))
    height = (0.26 * len(parameters) + 0.5) * n_rows + 0.6
    figure = Figure(figsize=(PAGE, height))
    panels = figure.subplots(n_rows, n_columns, sharex=True, sharey=True, squeeze=False)
    for axes in panels.ravel()[len(measures) :]:
        axes.set_axis_off()
    for axes, name in zip(panels.ravel(), measures, strict=False):
        told = indices.sel(measure=name)
        for kind, label, shift, color in (
            ("first_order", "by itself (first order)", -0.19, BLUE),
            ("total", "with all it meets (total)", 0.19, AMBER),
        ):
            value = told[kind].values
            low, high = told[f"{kind}_lower"].values, told[f"{kind}_upper"].values
            away = np.maximum([value - low, high - value], 0.0)
            bars = {"height": 0.36, "color": color, "label": label}
            axes.barh(places + shift, value, xerr=away, error_kw={"elinewidth": 0.7}, **bars)
        axes.set_title(typeset(MEASURES[str(name)].long_name))
        axes.set_yticks(places, [f"${MEASURES[p].tex}$" for p in parameters])
        axes.set_xlim(0.0, 1.05)
    panels[0, 0].invert_yaxis()
    for axes in panels.ravel()[max(len(measures) - n_columns, 0) : len(measures)]:
        axes.set_xlabel("share of the variance")
        axes.tick_params(labelbottom=True)
    handles, labels = panels[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=2)
    left_out = 100.0 * indices.attrs["left_out"]
    note = f"{indices.attrs['rows']:,} rows; {left_out:.1f} % left out, without a gait"
    figure.suptitle(note, fontsize=8.0)
    return figure


@figure_style()
def curve_figure(scan: xr.Dataset, x: str) -> Figure:
    """Return a figure of DLS fraction and speed along one parameter; gray without a gait."""
    scan = scan.isel({n: 0 for n in SWEPT if n in scan.dims and n != x}).sortby(x)
    rows = _shown(scan) or ["fore_foot_force"]
    figure = Figure(figsize=(COLUMN, 1.6 * len(rows) + 0.6))
    panels = figure.subplots(len(rows), 1, sharex=True, squeeze=False)[:, 0]
    edges = _edges(scan[x].values)
    failed = scan.outcome.values != Outcome.STEPPED
    for axes, name in zip(panels, rows, strict=True):
        axes.plot(scan[x].values, scan[name].values, marker=".", color=BLUE)
        axes.set_ylabel(axis_label(name, "{name}"))
        for cell in np.flatnonzero(failed):
            axes.axvspan(edges[cell], edges[cell + 1], color=LIGHT, linewidth=0.0, zorder=0)
    panels[-1].set_xlabel(axis_label(x))
    return figure


def _shown(scan: xr.Dataset) -> list[str]:
    """Return the names of the measures that figures show."""
    return [name for name in ("dls_fraction", "speed") if name in scan]


def _limits(values: Sequence[np.ndarray], stable: Sequence[np.ndarray]) -> tuple[float, float]:
    """Return the color range of a row of panels: the range of stable gaits, if there are any.

    A few distant unstable gaits would otherwise leave all others in one color.
    """
    every = [value[np.isfinite(value)] for value in values]
    walked = [v[s & np.isfinite(v)] for v, s in zip(values, stable, strict=True)]
    known = np.concatenate(walked if any(map(len, walked)) else every)
    return (float(known.min()), float(known.max())) if len(known) else (0.0, 1.0)


def _extended(
    values: Sequence[np.ndarray], limits: tuple[float, float]
) -> Literal["neither", "min", "max", "both"]:
    """Return the ends of a color bar beyond which there are values."""
    known = np.concatenate([value[np.isfinite(value)] for value in values])
    below, above = np.any(known < limits[0]), np.any(known > limits[1])
    return ("both" if above else "min") if below else ("max" if above else "neither")


def _cells(
    axes: Axes, x: np.ndarray, y: np.ndarray, values: np.ndarray, limits: tuple[float, float]
) -> AxesImage:
    """Draw one colored cell per sample, without interpolation."""
    axes.set_facecolor(LIGHT)
    masked = np.ma.masked_invalid(values)
    mesh = axes.pcolormesh(
        _edges(x), _edges(y), masked, cmap="viridis", vmin=limits[0], vmax=limits[1]
    )
    mesh.set_rasterized(True)
    return mesh  # type: ignore[return-value]  # a color bar accepts it


def _edges(places: np.ndarray) -> np.ndarray:
    """Return the edges of the cells around sample positions."""
    if len(places) == 1:
        return places[0] + np.array([-0.5, 0.5]) * max(abs(places[0]) * 0.01, 1e-6)
    middle = 0.5 * (places[1:] + places[:-1])
    first, last = 2.0 * places[0] - middle[0], 2.0 * places[-1] - middle[-1]
    return np.concatenate([[first], middle, [last]])


def _codes(scan: xr.Dataset) -> xr.DataArray:
    """Return the outcomes, with a code of their own for unstable cycles if these are known."""
    codes = scan.outcome.astype(int)
    if "spectral_radius" not in scan:
        return codes
    return codes.where(~(scan.spectral_radius >= 1.0), UNSTABLE)


def _borders(axes: Axes, scan: xr.Dataset, x: str, y: str) -> dict[str, Line2D]:
    """Draw lines of zero margin, and return their legend entries by name."""
    drawn = {}
    for name in BORDERS:
        if name not in scan or scan.sizes[x] < 2 or scan.sizes[y] < 2:
            continue
        margin = scan[name]
        if MARGINS[name].axis:
            margin = margin.min("leg")
        if name == "clearance_sls1" and "takeoff_acceleration" in scan:
            margin = margin.where(scan.takeoff_acceleration >= 0.0)  # avoids steps in the line
        values = margin.transpose(y, x).values
        known = values[np.isfinite(values)]
        if not len(known) or known.min() >= 0.0 or known.max() <= 0.0:
            continue
        color, line = border_style(name)
        axes.contour(
            scan[x].values, scan[y].values, np.ma.masked_invalid(values), levels=[0.0],
            colors=[color], linestyles=[line], linewidths=1.4,
        ).set_path_effects([Stroke(linewidth=2.6, foreground="white"), Normal()])  # fmt: skip
        drawn[name] = Line2D([], [], color=color, linestyle=line, label=MARGINS[name].breaks)
    return drawn


def _legend(figure: Figure, codes: np.ndarray, drawn: Mapping[str, Line2D], n_columns: int) -> None:
    """Add the legend of outcomes and lines below a figure."""
    lines = [drawn[name] for name in BORDERS if name in drawn]
    figure.legend(
        handles=[*outcome_patches(codes), *lines],
        loc="outside lower center",
        ncols=4 if n_columns > 1 else 2,
        fontsize=7.5,
        columnspacing=1.4,
    )


@figure_style()
def map_figure(scan: xr.Dataset, measure: str, curves: Sequence[BorderCurve]) -> Figure:
    """Return a map of a measure over two parameters, with curves of special points.

    Gray cells have no gait. A curve is thin where its gaits are unstable.

    Args:
        scan: dataset of `vrw.scan` over a grid of two parameters.
        measure: name of a variable of the scan.
        curves: results of `vrw.continue_special_point` over the same parameters; may be empty.

    Returns:
        Figure: one panel, in SI units.

    Examples:
        >>> grid = vrw.grid(damping=[150.0, 200.0], slope=[0.28, 0.3])
        >>> figure = vrw.plot.draw_map(vrw.scan(grid, ["speed"]), "speed", [])
    """
    drawable("scan", scan, ("outcome", measure), "give vrw.scan of two parameters and the measure")
    x, y = curves[0].parameters if curves else [n for n in SWEPT if n in scan.dims]
    figure = Figure(figsize=(PAGE, 0.62 * PAGE))
    axes = figure.subplots()
    axes.set_facecolor(LIGHT)
    values = scan[measure].where(scan.outcome == 0).transpose(y, x).values
    image = axes.pcolormesh(
        scan[x].values, scan[y].values, values, shading="nearest", cmap="cividis", rasterized=True
    )
    figure.colorbar(image, ax=axes, aspect=30, pad=0.01).set_label(axis_label(measure))
    names = sorted({curve.name for curve in curves})
    labels = {name: typeset(what_breaks(name)) for name in names}
    for curve in curves:
        color, dash = border_style(curve.name)
        stable = curve.dataset.spectral_radius.values < 1.0
        for there, width in ((stable, 1.2), (~stable, 0.5)):
            # The next piece contributes one point; a curve of several pieces has one legend entry.
            joined = there | np.append(False, there[:-1])
            drawn = np.where(joined[:, None], curve.values, np.nan)
            told = labels.pop(curve.name, None) if there.any() else None
            halo = [Stroke(linewidth=width + 1.0, foreground="white"), Normal()]
            axes.plot(
                *drawn.T, color=color, linestyle=dash, linewidth=width, label=told,
                path_effects=halo,
            )  # fmt: skip
    met = np.array([meeting.values for curve in curves for meeting in curve.meetings])
    axes.plot(
        *met.reshape(-1, 2).T, "o", color="black", markersize=2.5, markerfacecolor="white",
        markeredgewidth=0.6, label="two borders at once",
    )  # fmt: skip
    axes.set_xlim(*scan[x].values[[0, -1]])
    axes.set_ylim(*scan[y].values[[0, -1]])
    axes.set_xlabel(axis_label(x))
    axes.set_ylabel(axis_label(y))
    if curves:
        figure.legend(loc="outside lower center", ncols=2)
    return figure
