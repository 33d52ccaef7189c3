"""Figures of scans: DLS fraction, speed and outcome over parameters, with zero lines of margins."""

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

from vrw_jax.branches import SpecialPointCurve
from vrw_jax.figures.style import (
    AMBER,
    BLUE,
    COLUMN_WIDTH_INCHES,
    LIGHT_GRAY,
    OUTCOME_STYLES,
    PAGE_WIDTH_INCHES,
    UNSTABLE_CODE,
    draw_outcome_cells,
    figure_style,
    format_axis_label,
    format_value_label,
    make_outcome_patches,
    require_variables,
    select_outcome_style,
    select_special_point_style,
    typeset_symbols,
)
from vrw_jax.measures import MARGIN_MEASURES, MEASURES, describe_violation
from vrw_jax.scans import (
    DIFFERENTIABLE_MEASURES,
    SALTELLI_KIND,
    SWEEPABLE_PARAMETERS,
    read_manifest,
    sobol_indices,
)
from vrw_jax.wheel import Outcome

AXIS_ORDER = ("damping", "slope", "stiffness", "natural_length", *SWEEPABLE_PARAMETERS)
"""Parameters in the order in which figures use them: horizontal, vertical, then columns."""

DRAWN_MARGINS = (
    "fore_foot_force", "takeoff_acceleration", "clearance_sls1", "clearance_sls2",
    "locked_stopper_force", "rear_stopper_force", "contraction", "friction_fore",
    "landing_friction_fore", "hit_planted_impulse",
)  # fmt: skip
"""Margins whose zero lines are drawn."""

MAX_COLUMNS = 4
"""Largest number of columns of panels, chosen because more leave no space for labels."""

MAX_PAIRED_PARAMETERS = 6
"""Largest number of parameters shown in pairs, chosen because more leave no space for labels."""

MAX_DRAWN_SAMPLES = 20_000
"""Largest number of samples drawn in pairs, chosen because more would cover each other."""


def scan_figures(scan: xr.Dataset) -> dict[str, Figure]:
    """Return the figures of a scan by name, one for each axis beyond the first two.

    Args:
        scan: dataset of `vrw.scan` over a grid or samples.

    Returns:
        dict[str, Figure]: the figures, whose names depend on the design.

    Examples:
        >>> gaits = vrw.scan(vrw.grid(damping=[150.0, 200.0]), ["speed", "dls_fraction"])
        >>> sorted(vrw.plot.scan_figures(gaits))
        ['scan']
    """
    require_variables("scan", scan, ("outcome",), "give vrw.scan(design)")
    names = [name for name in dict.fromkeys(AXIS_ORDER) if name in scan.coords]
    if "sample" in scan.dims:
        swept_names = [name for name in names if np.ptp(scan[name].values) > 0.0] or names
        if len(swept_names) < 3:
            return {"scan": draw_samples(scan, swept_names)}
        figures = {"scan_pairs": draw_pairs(scan, swept_names[:MAX_PAIRED_PARAMETERS])}
        if read_manifest(scan.attrs).get("design", {}).get("kind") == SALTELLI_KIND:
            measures = [n_axes for n_axes in DIFFERENTIABLE_MEASURES if n_axes in scan]
            figures["sobol_indices"] = draw_sobol_indices(sobol_indices(scan, measures))
        return figures
    long_axes = [name for name in names if scan.sizes[name] > 1] or names
    if len(long_axes) == 1:
        return {"scan": draw_curves(scan, long_axes[0])}
    other_axes = long_axes[2:]
    if not other_axes:
        return {"scan": draw_slices(scan, long_axes[0], long_axes[1])}
    return {
        f"scan_over_{name}": draw_slices(scan, long_axes[0], long_axes[1], name)
        for name in other_axes
    }


@figure_style()
def draw_slices(scan: xr.Dataset, x: str, y: str, column_parameter: str | None = None) -> Figure:
    """Return a figure over the parameters (x, y), with one column per value of `column_parameter`.

    The figure shows DLS fraction, speed and outcome. Other parameters have their middle value,
    which the title gives. Gray cells have no gait.
    """
    cut_indices = {
        n_columns: scan.sizes[n_columns] // 2
        for n_columns in SWEEPABLE_PARAMETERS
        if n_columns in scan.dims
    }
    cut_indices = {
        name: index for name, index in cut_indices.items() if name not in (x, y, column_parameter)
    }
    scan_slice = scan.isel(cut_indices)
    columns = [scan_slice]
    if column_parameter is not None:
        n_columns = scan.sizes[column_parameter]
        indices = np.unique(
            np.linspace(0, n_columns - 1, min(n_columns, MAX_COLUMNS)).round().astype(int)
        )
        columns = [scan_slice.isel({column_parameter: int(index)}) for index in indices]
    panel_rows = _shown_measures(scan)
    width = PAGE_WIDTH_INCHES if len(columns) > 1 else COLUMN_WIDTH_INCHES
    figure = Figure(figsize=(width, 1.65 * (len(panel_rows) + 1) + 1.0))
    panels = figure.subplots(
        len(panel_rows) + 1, len(columns), sharex=True, sharey=True, squeeze=False
    )
    for row, name in zip(panels, panel_rows, strict=False):
        values = [column[name].transpose(y, x).values for column in columns]
        is_stable = [
            _outcome_codes(column).transpose(y, x).values == Outcome.STEPPED for column in columns
        ]
        color_limits = _find_color_limits(values, is_stable)
        for axes, column, value in zip(row, columns, values, strict=True):
            image = _draw_cells(axes, column[x].values, column[y].values, value, color_limits)
        extended_ends = _find_extended_ends(values, color_limits)
        color_bar = figure.colorbar(
            image, ax=row.tolist(), aspect=12, pad=0.01, extend=extended_ends
        )
        color_bar.set_label(format_axis_label(name, "{name}"))
    codes = np.unique([_outcome_codes(column).values for column in columns])
    for axes, column in zip(panels[-1], columns, strict=True):
        codes_of_cells = _outcome_codes(column).transpose(y, x).values
        draw_outcome_cells(
            axes,
            _find_cell_edges(column[x].values),
            _find_cell_edges(column[y].values),
            codes_of_cells,
            codes,
        )
    legend_lines: dict[str, Line2D] = {}
    for panel_row in panels:
        for axes, column in zip(panel_row, columns, strict=True):
            legend_lines |= _draw_margin_zeros(axes, column, x, y)
    for axes, column in zip(panels[0], columns, strict=True):
        if column_parameter is not None:
            axes.set_title(format_value_label(column_parameter, column[column_parameter].item()))
    for axes in panels[-1]:
        axes.set_xlabel(
            format_axis_label(x) if len(columns) < 3 else format_axis_label(x, "{symbol}")
        )
    for axes in panels[:, 0]:
        axes.set_ylabel(format_axis_label(y, "{symbol}"))
    _add_legend(figure, codes, legend_lines, len(columns))
    if cut_indices:
        fixed_values_text = ", ".join(
            format_value_label(n_columns, scan[n_columns].values[i])
            for n_columns, i in cut_indices.items()
        )
        figure.suptitle(f"at {fixed_values_text}", fontsize=9.0)
    return figure


@figure_style()
def draw_samples(scan: xr.Dataset, names: Sequence[str]) -> Figure:
    """Return a figure of single samples over the first two parameters."""
    x, y = (names[0], names[1]) if len(names) > 1 else (names[0], "sample")
    measure_names = _shown_measures(scan)
    marker_size = float(np.clip(3000.0 / max(scan.sizes["sample"], 1), 1.0, 12.0))
    figure = Figure(figsize=(PAGE_WIDTH_INCHES, 2.9))
    panels = figure.subplots(1, len(measure_names) + 1, sharey=True, squeeze=False)[0]
    for axes, name in zip(panels, measure_names, strict=False):
        points = _draw_values(axes, scan, x, y, name, marker_size)
        extended_ends = _find_extended_ends([scan[name].values], points.get_clim())
        color_bar = figure.colorbar(
            points, ax=axes, location="top", aspect=25, extend=extended_ends
        )
        color_bar.set_label(format_axis_label(name))
    codes = _outcome_codes(scan).values
    _draw_outcomes(panels[-1], scan[x].values, scan[y].values, codes, marker_size)
    for axes in panels:
        axes.set_xlabel(format_axis_label(x, "{symbol}"))
    panels[0].set_ylabel("sample" if y == "sample" else format_axis_label(y, "{symbol}"))
    _add_legend(figure, np.unique(codes), {}, 3)
    return figure


@figure_style()
def draw_pairs(scan: xr.Dataset, names: Sequence[str]) -> Figure:
    """Return a figure of samples over each pair of parameters.

    The figure shows the DLS fraction below the diagonal and the outcome above it. The diagonal
    shows the fraction of samples with a stable cycle. Only the first `MAX_DRAWN_SAMPLES` samples
    are drawn, which are as evenly spread as all.
    """
    drawn_samples = scan.isel(sample=slice(MAX_DRAWN_SAMPLES))
    value = next(iter(_shown_measures(scan)), None)
    codes = _outcome_codes(drawn_samples).values
    n_parameters = len(names)
    marker_size = float(np.clip(8000.0 / len(codes), 0.6, 8.0))
    figure = Figure(figsize=(PAGE_WIDTH_INCHES, PAGE_WIDTH_INCHES * 0.9))
    panels = figure.subplots(n_parameters, n_parameters, sharex="col", squeeze=False)
    points = None
    for (i, j), axes in np.ndenumerate(panels):
        x, y = drawn_samples[names[j]].values, drawn_samples[names[i]].values
        if i == j:
            _draw_stable_share(axes, x, codes == Outcome.STEPPED)
        elif i < j:
            _draw_outcomes(axes, x, y, codes, marker_size)
        elif value is not None:
            points = _draw_values(axes, drawn_samples, names[j], names[i], value, marker_size)
        if i == n_parameters - 1:
            axes.set_xlabel(format_axis_label(names[j], "{symbol}"))
        if j == 0 and i > 0:
            axes.set_ylabel(format_axis_label(names[i], "{symbol}"))
        elif i != j:
            axes.tick_params(labelleft=False)
    panels[0, 0].set_ylabel("share that walks")
    if value is not None and points is not None:
        extended_ends = _find_extended_ends([drawn_samples[value].values], points.get_clim())
        all_panels = panels.ravel().tolist()
        color_bar = figure.colorbar(
            points, ax=all_panels, aspect=40, pad=0.01, extend=extended_ends
        )
        color_bar.set_label(format_axis_label(value, "{name}"))
    _add_legend(figure, np.unique(codes), {}, 3)
    return figure


def _draw_values(
    axes: Axes, scan: xr.Dataset, x: str, y: str, name: str, marker_size: float
) -> PathCollection:
    """Draw samples in the colors of a measure, or in gray if they have no gait, and return the
    points.
    """
    dot_style: dict[str, Any] = {"s": marker_size, "linewidths": 0.0, "rasterized": True}
    has_gait, values = scan.outcome.values == Outcome.STEPPED, scan[name].values
    min_value, max_value = _find_color_limits(
        [values], [_outcome_codes(scan).values == Outcome.STEPPED]
    )
    x_values, y_values = scan[x].values, scan[y].values
    axes.scatter(x_values[~has_gait], y_values[~has_gait], color=LIGHT_GRAY, **dot_style)
    return axes.scatter(
        x_values[has_gait],
        y_values[has_gait],
        c=values[has_gait],
        vmin=min_value,
        vmax=max_value,
        **dot_style,
    )


def _draw_outcomes(
    axes: Axes, x: np.ndarray, y: np.ndarray, codes: np.ndarray, marker_size: float
) -> None:
    """Draw samples in the colors of their outcomes."""
    colors = [select_outcome_style(int(code))[1] for code in codes]
    axes.scatter(x, y, s=marker_size, color=colors, linewidths=0.0, rasterized=True)


def _draw_stable_share(axes: Axes, x: np.ndarray, has_stable_gait: np.ndarray) -> None:
    """Draw the fraction of samples with a stable gait along a parameter."""
    edges = np.linspace(x.min(), x.max(), 13)
    n_samples, n_stable = (
        np.histogram(positions, edges)[0] for positions in (x, x[has_stable_gait])
    )
    axes.stairs(
        n_stable / np.maximum(n_samples, 1),
        edges,
        fill=True,
        color=OUTCOME_STYLES[Outcome.STEPPED][1],
    )
    axes.set_ylim(0.0, 1.0)


@figure_style()
def draw_sobol_indices(indices: xr.Dataset) -> Figure:
    """Return a figure of the Sobol' indices of each measure with their intervals."""
    measures, parameters = (
        indices.measure.values,
        [str(parameter_positions) for parameter_positions in indices.parameter.values],
    )
    n_columns = min(len(measures), 3)
    n_rows = -(-len(measures) // n_columns)
    positions = np.arange(len(parameters))
    height = (0.26 * len(parameters) + 0.5) * n_rows + 0.6
    figure = Figure(figsize=(PAGE_WIDTH_INCHES, height))
    panels = figure.subplots(n_rows, n_columns, sharex=True, sharey=True, squeeze=False)
    for axes in panels.ravel()[len(measures) :]:
        axes.set_axis_off()
    for axes, name in zip(panels.ravel(), measures, strict=False):
        measure_indices = indices.sel(measure=name)
        for kind, label, shift, color in (
            ("first_order", "by itself (first order)", -0.19, BLUE),
            ("total", "with all it meets (total)", 0.19, AMBER),
        ):
            value = measure_indices[kind].values
            lower_ends, upper_ends = (
                measure_indices[f"{kind}_lower"].values,
                measure_indices[f"{kind}_upper"].values,
            )
            interval_lengths = np.maximum([value - lower_ends, upper_ends - value], 0.0)
            bars = {"height": 0.36, "color": color, "label": label}
            axes.barh(
                positions + shift,
                value,
                xerr=interval_lengths,
                error_kw={"elinewidth": 0.7},
                **bars,
            )
        if measure_indices.is_constant:
            axes.text(0.5, 0.5, "constant", ha="center", va="center", transform=axes.transAxes)
        axes.set_title(typeset_symbols(MEASURES[str(name)].long_name))
        axes.set_yticks(
            positions,
            [f"${MEASURES[parameter_positions].mathtext}$" for parameter_positions in parameters],
        )
        axes.set_xlim(0.0, 1.05)
    panels[0, 0].invert_yaxis()
    for axes in panels.ravel()[max(len(measures) - n_columns, 0) : len(measures)]:
        axes.set_xlabel("share of the variance")
        axes.tick_params(labelbottom=True)
    handles, labels = panels[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=2)
    left_out_fraction = 100.0 * indices.attrs["left_out"]
    note_text = (
        f"{indices.attrs['rows']:,} rows; {left_out_fraction:.1f} % left out, without a gait"
    )
    figure.suptitle(note_text, fontsize=8.0)
    return figure


@figure_style()
def draw_curves(scan: xr.Dataset, x: str) -> Figure:
    """Return a figure of DLS fraction and speed along one parameter; gray cells have no gait."""
    scan = scan.isel(
        {
            n_measures: 0
            for n_measures in SWEEPABLE_PARAMETERS
            if n_measures in scan.dims and n_measures != x
        }
    ).sortby(x)
    measure_names = _shown_measures(scan) or ["fore_foot_force"]
    figure = Figure(figsize=(COLUMN_WIDTH_INCHES, 1.6 * len(measure_names) + 0.6))
    panels = figure.subplots(len(measure_names), 1, sharex=True, squeeze=False)[:, 0]
    edges = _find_cell_edges(scan[x].values)
    has_failed = scan.outcome.values != Outcome.STEPPED
    for axes, name in zip(panels, measure_names, strict=True):
        axes.plot(scan[x].values, scan[name].values, marker=".", color=BLUE)
        axes.set_ylabel(format_axis_label(name, "{name}"))
        for cell in np.flatnonzero(has_failed):
            axes.axvspan(edges[cell], edges[cell + 1], color=LIGHT_GRAY, linewidth=0.0, zorder=0)
    panels[-1].set_xlabel(format_axis_label(x))
    return figure


def _shown_measures(scan: xr.Dataset) -> list[str]:
    """Return the names of the measures that figures show."""
    return [name for name in ("dls_fraction", "speed") if name in scan]


def _find_color_limits(
    values: Sequence[np.ndarray], is_stable: Sequence[np.ndarray]
) -> tuple[float, float]:
    """Return the color range of a row of panels: the range of stable gaits if there are any.

    A few distant unstable gaits would otherwise give all other gaits the same color.
    """
    finite_values = [value[np.isfinite(value)] for value in values]
    stable_values = [v[s & np.isfinite(v)] for v, s in zip(values, is_stable, strict=True)]
    values_in_range = np.concatenate(
        stable_values if any(map(len, stable_values)) else finite_values
    )
    return (
        (float(values_in_range.min()), float(values_in_range.max()))
        if len(values_in_range)
        else (0.0, 1.0)
    )


def _find_extended_ends(
    values: Sequence[np.ndarray], color_limits: tuple[float, float]
) -> Literal["neither", "min", "max", "both"]:
    """Return the ends of a color bar beyond which there are values."""
    finite_values = np.concatenate([value[np.isfinite(value)] for value in values])
    is_any_below, is_any_above = (
        np.any(finite_values < color_limits[0]),
        np.any(finite_values > color_limits[1]),
    )
    return (
        ("both" if is_any_above else "min")
        if is_any_below
        else ("max" if is_any_above else "neither")
    )


def _draw_cells(
    axes: Axes, x: np.ndarray, y: np.ndarray, values: np.ndarray, color_limits: tuple[float, float]
) -> AxesImage:
    """Draw one colored cell per sample, without interpolation, and return the image."""
    axes.set_facecolor(LIGHT_GRAY)
    masked_values = np.ma.masked_invalid(values)
    cell_image = axes.pcolormesh(
        _find_cell_edges(x),
        _find_cell_edges(y),
        masked_values,
        cmap="viridis",
        vmin=color_limits[0],
        vmax=color_limits[1],
    )
    cell_image.set_rasterized(True)
    return cell_image  # type: ignore[return-value]  # A color bar accepts it.


def _find_cell_edges(positions: np.ndarray) -> np.ndarray:
    """Return the edges of the cells around sample positions."""
    if len(positions) == 1:
        return positions[0] + np.array([-0.5, 0.5]) * max(abs(positions[0]) * 0.01, 1e-6)
    inner_edges = 0.5 * (positions[1:] + positions[:-1])
    first_edge, last_edge = (
        2.0 * positions[0] - inner_edges[0],
        2.0 * positions[-1] - inner_edges[-1],
    )
    return np.concatenate([[first_edge], inner_edges, [last_edge]])


def _outcome_codes(scan: xr.Dataset) -> xr.DataArray:
    """Return the outcomes, with `UNSTABLE_CODE` for unstable cycles if the spectral radius is
    known.
    """
    codes = scan.outcome.astype(int)
    if "spectral_radius" not in scan:
        return codes
    return codes.where(~(scan.spectral_radius >= 1.0), UNSTABLE_CODE)


def _draw_margin_zeros(axes: Axes, scan: xr.Dataset, x: str, y: str) -> dict[str, Line2D]:
    """Draw lines of zero margin, and return their legend entries by name."""
    legend_lines = {}
    for name in DRAWN_MARGINS:
        if name not in scan or scan.sizes[x] < 2 or scan.sizes[y] < 2:
            continue
        margin = scan[name]
        if MARGIN_MEASURES[name].dimension:
            margin = margin.min("leg")
        if name == "clearance_sls1" and "takeoff_acceleration" in scan:
            # Without missing values the line has no steps.
            margin = margin.where(scan.takeoff_acceleration >= 0.0)
        values = margin.transpose(y, x).values
        finite_values = values[np.isfinite(values)]
        if not len(finite_values) or finite_values.min() >= 0.0 or finite_values.max() <= 0.0:
            continue
        color, line = select_special_point_style(name)
        axes.contour(
            scan[x].values, scan[y].values, np.ma.masked_invalid(values), levels=[0.0],
            colors=[color], linestyles=[line], linewidths=1.4,
        ).set_path_effects([Stroke(linewidth=2.6, foreground="white"), Normal()])  # fmt: skip
        legend_lines[name] = Line2D(
            [], [], color=color, linestyle=line, label=MARGIN_MEASURES[name].violation
        )
    return legend_lines


def _add_legend(
    figure: Figure, codes: np.ndarray, legend_lines: Mapping[str, Line2D], n_columns: int
) -> None:
    """Add the legend of outcomes and lines below a figure."""
    lines = [legend_lines[name] for name in DRAWN_MARGINS if name in legend_lines]
    figure.legend(
        handles=[*make_outcome_patches(codes), *lines],
        loc="outside lower center",
        ncols=4 if n_columns > 1 else 2,
        fontsize=7.5,
        columnspacing=1.4,
    )


@figure_style()
def map_figure(scan: xr.Dataset, measure: str, curves: Sequence[SpecialPointCurve]) -> Figure:
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
        >>> figure = vrw.plot.map_figure(vrw.scan(grid, ["speed"]), "speed", [])
    """
    require_variables(
        "scan", scan, ("outcome", measure), "give vrw.scan of two parameters and the measure"
    )
    x, y = (
        curves[0].parameters
        if curves
        else [n_samples for n_samples in SWEEPABLE_PARAMETERS if n_samples in scan.dims]
    )
    figure = Figure(figsize=(PAGE_WIDTH_INCHES, 0.62 * PAGE_WIDTH_INCHES))
    axes = figure.subplots()
    axes.set_facecolor(LIGHT_GRAY)
    values = scan[measure].where(scan.outcome == 0).transpose(y, x).values
    image = axes.pcolormesh(
        scan[x].values, scan[y].values, values, shading="nearest", cmap="cividis", rasterized=True
    )
    figure.colorbar(image, ax=axes, aspect=30, pad=0.01).set_label(format_axis_label(measure))
    names = sorted({curve.name for curve in curves})
    labels = {name: typeset_symbols(describe_violation(name)) for name in names}
    for curve in curves:
        color, line_style = select_special_point_style(curve.name)
        is_stable = curve.dataset.spectral_radius.values < 1.0
        for is_drawn, width in ((is_stable, 1.2), (~is_stable, 0.5)):
            # Each piece includes the first point of the next one; the curve has one legend entry.
            is_drawn_or_next = is_drawn | np.append(False, is_drawn[:-1])
            points = np.where(is_drawn_or_next[:, None], curve.values, np.nan)
            label = labels.pop(curve.name, None) if is_drawn.any() else None
            text_outline = [Stroke(linewidth=width + 1.0, foreground="white"), Normal()]
            axes.plot(
                *points.T, color=color, linestyle=line_style, linewidth=width, label=label,
                path_effects=text_outline,
            )  # fmt: skip
    codim2_points = np.array(
        [codim2_point.values for curve in curves for codim2_point in curve.codim2_points]
    )
    axes.plot(
        *codim2_points.reshape(-1, 2).T,
        "o",
        color="black",
        markersize=2.5,
        markerfacecolor="white",
        markeredgewidth=0.6,
        label="two special points at once",
    )
    axes.set_xlim(*scan[x].values[[0, -1]])
    axes.set_ylim(*scan[y].values[[0, -1]])
    axes.set_xlabel(format_axis_label(x))
    axes.set_ylabel(format_axis_label(y))
    if curves:
        figure.legend(loc="outside lower center", ncols=2)
    return figure
