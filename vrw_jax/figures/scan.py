"""Pictures of scans: DLS fraction, speed and outcome over two parameters, and borders on them."""

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
"""Which axes a picture takes first: across, then up, then side by side."""

BORDERS = (
    "fore_foot_force", "takeoff_acceleration", "clearance_sls1", "clearance_sls2",
    "locked_stopper_force", "rear_stopper_force", "contraction", "friction_fore",
    "landing_friction_fore", "hit_planted_impulse",
)  # fmt: skip
"""Premises whose borders are drawn."""

MOST_COLUMNS, MOST_PAIRED, MOST_DRAWN = 4, 6, 20_000


def scan_figures(scan: xr.Dataset) -> dict[str, Figure]:
    """Pictures of a scan by name: one for each axis that can be set side by side.

    Args:
        scan: of `vrw.scan`, over a grid or samples, or of `vrw.sobol_indices`.

    Returns:
        dict[str, Figure]: the pictures; which there are follows from the design.

    Examples:
        >>> found = vrw.scan(vrw.grid(damping=[150.0, 200.0]), ["speed", "dls_fraction"])
        >>> sorted(vrw.plot.scan_figures(found))
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
    """DLS fraction, speed and outcome over (x, y), one column for each value of `across`.

    Axes that are not shown are cut at their middle value, which the title names. Grey: no gait.
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
    """DLS fraction, speed and outcome of single samples over the first two parameters."""
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
    """Samples over each pair of parameters: DLS fraction below the diagonal, outcome above.

    On the diagonal the share that walks on a stable cycle, along each parameter. Of large designs
    the first MOST_DRAWN samples are drawn, which are as well spread as all.
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
    """Samples in the colours of a measure, in grey where there is none to tell."""
    dot: dict[str, Any] = {"s": size, "linewidths": 0.0, "rasterized": True}
    walks, values = scan.outcome.values == Outcome.STEPPED, scan[name].values
    low, high = _limits([values], [_codes(scan).values == Outcome.STEPPED])
    across, up = scan[x].values, scan[y].values
    axes.scatter(across[~walks], up[~walks], color=LIGHT, **dot)
    return axes.scatter(across[walks], up[walks], c=values[walks], vmin=low, vmax=high, **dot)


def _draw_outcomes(
    axes: Axes, x: np.ndarray, y: np.ndarray, codes: np.ndarray, size: float
) -> None:
    colors = [outcome_style(int(code))[1] for code in codes]
    axes.scatter(x, y, s=size, color=colors, linewidths=0.0, rasterized=True)


def _share_along(axes: Axes, x: np.ndarray, walks: np.ndarray) -> None:
    """The share of samples with a stable gait, along a parameter."""
    edges = np.linspace(x.min(), x.max(), 13)
    every, good = (np.histogram(some, edges)[0] for some in (x, x[walks]))
    axes.stairs(good / np.maximum(every, 1), edges, fill=True, color=OUTCOMES[Outcome.STEPPED][1])
    axes.set_ylim(0.0, 1.0)


@figure_style()
def indices_figure(indices: xr.Dataset) -> Figure:
    """First-order and total Sobol' indices of each measure, with their intervals."""
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
    """DLS fraction and speed along one parameter; grey where there is no gait."""
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
    return [name for name in ("dls_fraction", "speed") if name in scan]


def _limits(values: Sequence[np.ndarray], stable: Sequence[np.ndarray]) -> tuple[float, float]:
    """Range of colours that all panels of a row share: that of stable gaits, if there are any.

    A few unstable ones, far from the others, would leave these one colour.
    """
    every = [value[np.isfinite(value)] for value in values]
    walked = [v[s & np.isfinite(v)] for v, s in zip(values, stable, strict=True)]
    known = np.concatenate(walked if any(map(len, walked)) else every)
    return (float(known.min()), float(known.max())) if len(known) else (0.0, 1.0)


def _extended(
    values: Sequence[np.ndarray], limits: tuple[float, float]
) -> Literal["neither", "min", "max", "both"]:
    """At which ends of a colour bar there are values beyond it."""
    known = np.concatenate([value[np.isfinite(value)] for value in values])
    below, above = np.any(known < limits[0]), np.any(known > limits[1])
    return ("both" if above else "min") if below else ("max" if above else "neither")


def _cells(
    axes: Axes, x: np.ndarray, y: np.ndarray, values: np.ndarray, limits: tuple[float, float]
) -> AxesImage:
    """One coloured cell per sample, so that nothing is seen that was not computed."""
    axes.set_facecolor(LIGHT)
    masked = np.ma.masked_invalid(values)
    mesh = axes.pcolormesh(
        _edges(x), _edges(y), masked, cmap="viridis", vmin=limits[0], vmax=limits[1]
    )
    mesh.set_rasterized(True)
    return mesh  # type: ignore[return-value]  # whatever a colour bar accepts


def _edges(places: np.ndarray) -> np.ndarray:
    """Borders of cells around sample places."""
    if len(places) == 1:
        return places[0] + np.array([-0.5, 0.5]) * max(abs(places[0]) * 0.01, 1e-6)
    middle = 0.5 * (places[1:] + places[:-1])
    first, last = 2.0 * places[0] - middle[0], 2.0 * places[-1] - middle[-1]
    return np.concatenate([[first], middle, [last]])


def _codes(scan: xr.Dataset) -> xr.DataArray:
    """Outcomes, with unstable cycles told apart where the scan knows."""
    codes = scan.outcome.astype(int)
    if "spectral_radius" not in scan:
        return codes
    return codes.where(~(scan.spectral_radius >= 1.0), UNSTABLE)


def _borders(axes: Axes, scan: xr.Dataset, x: str, y: str) -> dict[str, Line2D]:
    """Lines where a premise's margin is zero; returns what a legend needs."""
    drawn = {}
    for name in BORDERS:
        if name not in scan or scan.sizes[x] < 2 or scan.sizes[y] < 2:
            continue
        margin = scan[name]
        if MARGINS[name].axis:
            margin = margin.min("leg")
        if name == "clearance_sls1" and "takeoff_acceleration" in scan:
            margin = margin.where(scan.takeoff_acceleration >= 0.0)  # the border's stairs
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
    """The measure of the scan's gaits in colours, grey where there is none, and every border.

    Thin where the gaits on it are not stable.

    Args:
        scan: of `vrw.scan` over a grid of two parameters.
        measure: one of its columns.
        curves: of `vrw.border_curve` over the same two; may be empty.

    Returns:
        Figure: one panel, in SI units.

    Examples:
        >>> grid = vrw.grid(damping=[150.0, 200.0], slope=[0.28, 0.3])
        >>> figure = vrw.plot.map_figure(vrw.scan(grid, ["speed"]), "speed", [])
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
            # A point of what follows joins them; several pieces of a border are told once.
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
