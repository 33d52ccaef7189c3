"""Figures of scans: measures and outcomes over parameters, and the curves on which margins are
0.
"""

import textwrap
from collections.abc import Mapping, Sequence
from typing import Any, Literal

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.collections import PathCollection
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.lines import Line2D
from matplotlib.patheffects import Normal, Stroke

from vrw_jax.branches import SpecialPointCurve
from vrw_jax.figures.style import (
    COLUMN_FIGURE_WIDTH_INCHES,
    LIGHT_GRAY_COLOR,
    OKABE_ITO_AMBER,
    OKABE_ITO_BLUE,
    OUTCOME_LABELS_AND_COLORS,
    PAGE_FIGURE_WIDTH_INCHES,
    UNSTABLE_CYCLE_CODE,
    draw_outcome_cells,
    figure_style,
    format_axis_label,
    format_value_label,
    make_outcome_patches,
    require_dataset_variables,
    select_outcome_style,
    select_special_point_style,
    typeset_greek_symbols,
)
from vrw_jax.measures import MARGIN_MEASURES, MEASURES, describe_violation
from vrw_jax.scans import (
    DIFFERENTIABLE_MEASURES,
    SALTELLI_DESIGN_KIND,
    SWEEPABLE_PARAMETERS,
    read_scan_manifest,
    sobol_indices,
)
from vrw_jax.wheel import Outcome

PARAMETER_AXIS_ORDER = ("damping", "slope", "stiffness", "natural_length", *SWEEPABLE_PARAMETERS)
"""Parameters in the order in which figures assign them to the horizontal axis, the vertical axis
and the panel columns.
"""

DRAWN_MARGIN_NAMES = (
    "fore_foot_force", "takeoff_acceleration", "clearance_sls1", "clearance_sls2",
    "locked_stopper_force", "rear_stopper_force", "contraction", "friction_fore",
    "landing_friction_fore", "hit_planted_impulse",
)  # fmt: skip
"""Names of the margins for which figures draw the curve of value 0."""

SHOWN_MEASURE_NAMES = ("mean_steps", "dls_fraction", "speed")
"""Names of the measures that figures show if the scan contains them."""

LOGARITHMIC_MEASURE_NAMES = ("mean_steps",)
"""Names of the measures that are shown on a logarithmic scale, chosen because these measures vary
by powers of ten.
"""

MAX_PANEL_COLUMNS = 4
"""Largest number of panels in a row, chosen because more panels leave no space for labels."""

MAX_PAIRED_PARAMETERS = 6
"""Largest number of parameters in a figure of parameter pairs, chosen because more parameters leave
no space for labels.
"""

MAX_DRAWN_SAMPLES = 20_000
"""Largest number of samples in a figure of parameter pairs, chosen because more samples would cover
each other.
"""


def scan_figures(scan: xr.Dataset) -> dict[str, Figure]:
    """Return the figures of a scan, by name.

    A grid with one or two axes leads to one figure. Further axes add one figure each.

    Args:
        scan: dataset that `vrw.scan` returns for a grid or for samples.

    Returns:
        dict[str, Figure]: the figures, whose names depend on the design.

    Examples:
        >>> gaits = vrw.scan(vrw.grid(damping=[150.0, 200.0]), ["speed", "dls_fraction"])
        >>> sorted(vrw.plot.scan_figures(gaits))
        ['scan']
    """
    require_dataset_variables("scan", scan, ("outcome",), "give vrw.scan(design)")
    swept_axis_names = [
        parameter_name
        for parameter_name in dict.fromkeys(PARAMETER_AXIS_ORDER)
        if parameter_name in scan.coords
    ]
    if "sample" in scan.dims:
        varied_parameters = [
            parameter_name
            for parameter_name in swept_axis_names
            if np.ptp(scan[parameter_name].values) > 0.0
        ] or swept_axis_names
        if len(varied_parameters) < 3:
            return {"scan": draw_scan_samples(scan, varied_parameters)}
        figures_by_name = {
            "scan_pairs": draw_parameter_pairs(scan, varied_parameters[:MAX_PAIRED_PARAMETERS])
        }
        if read_scan_manifest(scan.attrs).get("design", {}).get("kind") == SALTELLI_DESIGN_KIND:
            measure_names = [
                measure_name for measure_name in DIFFERENTIABLE_MEASURES if measure_name in scan
            ]
            figures_by_name["sobol_indices"] = draw_sobol_indices(
                sobol_indices(scan, measure_names)
            )
        return figures_by_name
    multivalued_axis_names = [
        parameter_name for parameter_name in swept_axis_names if scan.sizes[parameter_name] > 1
    ] or swept_axis_names
    if len(multivalued_axis_names) == 1:
        return {"scan": draw_measure_curves(scan, multivalued_axis_names[0])}
    remaining_axis_names = multivalued_axis_names[2:]
    if not remaining_axis_names:
        return {
            "scan": draw_scan_slices(scan, multivalued_axis_names[0], multivalued_axis_names[1])
        }
    return {
        f"scan_over_{parameter_name}": draw_scan_slices(
            scan, multivalued_axis_names[0], multivalued_axis_names[1], parameter_name
        )
        for parameter_name in remaining_axis_names
    }


@figure_style()
def draw_scan_slices(
    scan: xr.Dataset, x: str, y: str, panel_column_parameter: str | None = None
) -> Figure:
    """Return a figure over two parameters, with one column of panels per value of
    `panel_column_parameter`.

    `x` and `y` are the names of the two parameters. The figure shows outcomes and the measures in
    `SHOWN_MEASURE_NAMES`. Every other parameter has the middle one of its values, which the title
    states. Cells without a gait are gray.
    """
    slice_indices = {
        parameter_name: scan.sizes[parameter_name] // 2
        for parameter_name in SWEEPABLE_PARAMETERS
        if parameter_name in scan.dims
    }
    slice_indices = {
        parameter_name: slice_index
        for parameter_name, slice_index in slice_indices.items()
        if parameter_name not in (x, y, panel_column_parameter)
    }
    scan_slice = scan.isel(slice_indices)
    panel_column_datasets = [scan_slice]
    if panel_column_parameter is not None:
        n_panel_column_values = scan.sizes[panel_column_parameter]
        panel_column_indices = np.unique(
            np.linspace(0, n_panel_column_values - 1, min(n_panel_column_values, MAX_PANEL_COLUMNS))
            .round()
            .astype(int)
        )
        panel_column_datasets = [
            scan_slice.isel({panel_column_parameter: int(panel_column_index)})
            for panel_column_index in panel_column_indices
        ]
    panel_measures = _list_shown_measures(scan)
    figure_width = (
        PAGE_FIGURE_WIDTH_INCHES if len(panel_column_datasets) > 1 else COLUMN_FIGURE_WIDTH_INCHES
    )
    figure = Figure(figsize=(figure_width, 1.65 * (len(panel_measures) + 1) + 1.0))
    panel_axes = figure.subplots(
        len(panel_measures) + 1, len(panel_column_datasets), sharex=True, sharey=True, squeeze=False
    )
    for axes_of_panel_row, measure_name in zip(panel_axes, panel_measures, strict=False):
        measure_values_by_panel = [
            panel_column_dataset[measure_name].transpose(y, x).values
            for panel_column_dataset in panel_column_datasets
        ]
        is_stable = [
            _compute_displayed_outcome_codes(panel_column_dataset).transpose(y, x).values
            == Outcome.STEPPED
            for panel_column_dataset in panel_column_datasets
        ]
        color_limits = _find_color_limits(measure_values_by_panel, is_stable)
        color_scale = _make_color_scale(measure_name, color_limits)
        for axes, panel_column_dataset, measure_values_by_cell in zip(
            axes_of_panel_row, panel_column_datasets, measure_values_by_panel, strict=True
        ):
            cell_mesh = _draw_measure_cells(
                axes,
                panel_column_dataset[x].values,
                panel_column_dataset[y].values,
                measure_values_by_cell,
                color_scale,
            )
        extended_color_bar_ends = _find_extended_color_bar_ends(
            measure_values_by_panel, color_limits
        )
        color_bar = figure.colorbar(
            cell_mesh,
            ax=axes_of_panel_row.tolist(),
            aspect=12,
            pad=0.01,
            extend=extended_color_bar_ends,
        )
        color_bar.set_label(textwrap.fill(format_axis_label(measure_name, "{name}"), 24))
    outcome_codes = np.unique(
        [
            _compute_displayed_outcome_codes(panel_column_dataset).values
            for panel_column_dataset in panel_column_datasets
        ]
    )
    for axes, panel_column_dataset in zip(panel_axes[-1], panel_column_datasets, strict=True):
        cell_outcome_codes = (
            _compute_displayed_outcome_codes(panel_column_dataset).transpose(y, x).values
        )
        draw_outcome_cells(
            axes,
            _find_cell_edges(panel_column_dataset[x].values),
            _find_cell_edges(panel_column_dataset[y].values),
            cell_outcome_codes,
            outcome_codes,
        )
    legend_lines: dict[str, Line2D] = {}
    for axes_of_panel_row in panel_axes:
        for axes, panel_column_dataset in zip(
            axes_of_panel_row, panel_column_datasets, strict=True
        ):
            legend_lines |= _draw_margin_zero_lines(axes, panel_column_dataset, x, y)
    for axes, panel_column_dataset in zip(panel_axes[0], panel_column_datasets, strict=True):
        if panel_column_parameter is not None:
            axes.set_title(
                format_value_label(
                    panel_column_parameter, panel_column_dataset[panel_column_parameter].item()
                )
            )
    for axes in panel_axes[-1]:
        axes.set_xlabel(
            format_axis_label(x)
            if len(panel_column_datasets) < 3
            else format_axis_label(x, "{symbol}")
        )
    for axes in panel_axes[:, 0]:
        axes.set_ylabel(format_axis_label(y, "{symbol}"))
    _add_scan_legend(figure, outcome_codes, legend_lines, len(panel_column_datasets))
    if slice_indices:
        fixed_values_text = ", ".join(
            format_value_label(parameter_name, scan[parameter_name].values[slice_index])
            for parameter_name, slice_index in slice_indices.items()
        )
        figure.suptitle(f"at {fixed_values_text}", fontsize=9.0)
    return figure


@figure_style()
def draw_scan_samples(scan: xr.Dataset, parameter_names: Sequence[str]) -> Figure:
    """Return a figure of individual samples over the first two parameters."""
    x, y = (
        (parameter_names[0], parameter_names[1])
        if len(parameter_names) > 1
        else (parameter_names[0], "sample")
    )
    measure_names = _list_shown_measures(scan)
    marker_size = float(np.clip(3000.0 / max(scan.sizes["sample"], 1), 1.0, 12.0))
    figure = Figure(figsize=(PAGE_FIGURE_WIDTH_INCHES, 2.9))
    panel_axes = figure.subplots(1, len(measure_names) + 1, sharey=True, squeeze=False)[0]
    for axes, measure_name in zip(panel_axes, measure_names, strict=False):
        point_collection = _draw_measure_samples(axes, scan, x, y, measure_name, marker_size)
        extended_color_bar_ends = _find_extended_color_bar_ends(
            [scan[measure_name].values], point_collection.get_clim()
        )
        color_bar = figure.colorbar(
            point_collection, ax=axes, location="top", aspect=25, extend=extended_color_bar_ends
        )
        color_bar.set_label(format_axis_label(measure_name))
    outcome_codes = _compute_displayed_outcome_codes(scan).values
    _draw_outcome_samples(
        panel_axes[-1], scan[x].values, scan[y].values, outcome_codes, marker_size
    )
    for axes in panel_axes:
        axes.set_xlabel(format_axis_label(x, "{symbol}"))
    panel_axes[0].set_ylabel("sample" if y == "sample" else format_axis_label(y, "{symbol}"))
    _add_scan_legend(figure, np.unique(outcome_codes), {}, 3)
    return figure


@figure_style()
def draw_parameter_pairs(scan: xr.Dataset, parameter_names: Sequence[str]) -> Figure:
    """Return a figure with one panel of samples per pair of parameters.

    Panels below the diagonal show a measure, and panels above the diagonal show the outcome. The
    measure is the first of `SHOWN_MEASURE_NAMES` that the scan contains. Panels on the diagonal
    show the fraction of samples with a stable cycle. Only the first `MAX_DRAWN_SAMPLES` samples are
    drawn, because they are spread as evenly as all samples.
    """
    drawn_samples = scan.isel(sample=slice(MAX_DRAWN_SAMPLES))
    measure_name = next(iter(_list_shown_measures(scan)), None)
    outcome_codes = _compute_displayed_outcome_codes(drawn_samples).values
    n_parameters = len(parameter_names)
    marker_size = float(np.clip(8000.0 / len(outcome_codes), 0.6, 8.0))
    figure = Figure(figsize=(PAGE_FIGURE_WIDTH_INCHES, PAGE_FIGURE_WIDTH_INCHES * 0.9))
    panel_axes = figure.subplots(n_parameters, n_parameters, sharex="col", squeeze=False)
    point_collection = None
    for (i, j), axes in np.ndenumerate(panel_axes):
        x, y = drawn_samples[parameter_names[j]].values, drawn_samples[parameter_names[i]].values
        if i == j:
            _draw_stable_fraction(axes, x, outcome_codes == Outcome.STEPPED)
        elif i < j:
            _draw_outcome_samples(axes, x, y, outcome_codes, marker_size)
        elif measure_name is not None:
            point_collection = _draw_measure_samples(
                axes,
                drawn_samples,
                parameter_names[j],
                parameter_names[i],
                measure_name,
                marker_size,
            )
        if i == n_parameters - 1:
            axes.set_xlabel(format_axis_label(parameter_names[j], "{symbol}"))
        if j == 0 and i > 0:
            axes.set_ylabel(format_axis_label(parameter_names[i], "{symbol}"))
        elif i != j:
            axes.tick_params(labelleft=False)
    panel_axes[0, 0].set_ylabel("share that walks")
    if measure_name is not None and point_collection is not None:
        extended_color_bar_ends = _find_extended_color_bar_ends(
            [drawn_samples[measure_name].values], point_collection.get_clim()
        )
        axes_of_all_panels = panel_axes.ravel().tolist()
        color_bar = figure.colorbar(
            point_collection,
            ax=axes_of_all_panels,
            aspect=40,
            pad=0.01,
            extend=extended_color_bar_ends,
        )
        color_bar.set_label(format_axis_label(measure_name, "{name}"))
    _add_scan_legend(figure, np.unique(outcome_codes), {}, 3)
    return figure


def _draw_measure_samples(
    axes: Axes, scan: xr.Dataset, x: str, y: str, measure_name: str, marker_size: float
) -> PathCollection:
    """Draw samples in colors that show a measure, and return the collection of points.

    Samples without a gait are gray.
    """
    marker_style: dict[str, Any] = {"s": marker_size, "linewidths": 0.0, "rasterized": True}
    has_gait, measure_values = scan.outcome.values == Outcome.STEPPED, scan[measure_name].values
    color_limits = _find_color_limits(
        [measure_values], [_compute_displayed_outcome_codes(scan).values == Outcome.STEPPED]
    )
    x_values, y_values = scan[x].values, scan[y].values
    axes.scatter(x_values[~has_gait], y_values[~has_gait], color=LIGHT_GRAY_COLOR, **marker_style)
    return axes.scatter(
        x_values[has_gait],
        y_values[has_gait],
        c=measure_values[has_gait],
        norm=_make_color_scale(measure_name, color_limits),
        **marker_style,
    )


def _draw_outcome_samples(
    axes: Axes, x: np.ndarray, y: np.ndarray, outcome_codes: np.ndarray, marker_size: float
) -> None:
    """Draw samples in the colors of their outcomes."""
    outcome_colors = [select_outcome_style(int(outcome_code))[1] for outcome_code in outcome_codes]
    axes.scatter(x, y, s=marker_size, color=outcome_colors, linewidths=0.0, rasterized=True)


def _draw_stable_fraction(axes: Axes, x: np.ndarray, has_stable_gait: np.ndarray) -> None:
    """Draw the fraction of samples with a stable gait as a function of a parameter."""
    histogram_edges = np.linspace(x.min(), x.max(), 13)
    n_samples, n_stable_samples = (
        np.histogram(parameter_values, histogram_edges)[0]
        for parameter_values in (x, x[has_stable_gait])
    )
    axes.stairs(
        n_stable_samples / np.maximum(n_samples, 1),
        histogram_edges,
        fill=True,
        color=OUTCOME_LABELS_AND_COLORS[Outcome.STEPPED][1],
    )
    axes.set_ylim(0.0, 1.0)


@figure_style()
def draw_sobol_indices(indices: xr.Dataset) -> Figure:
    """Return a figure of the Sobol' indices of each measure, with their confidence intervals."""
    measure_names, parameter_names = (
        indices.measure.values,
        [str(parameter_name) for parameter_name in indices.parameter.values],
    )
    n_panel_columns = min(len(measure_names), 3)
    n_panel_rows = -(-len(measure_names) // n_panel_columns)
    bar_positions = np.arange(len(parameter_names))
    figure_height = (0.26 * len(parameter_names) + 0.5) * n_panel_rows + 0.6
    figure = Figure(figsize=(PAGE_FIGURE_WIDTH_INCHES, figure_height))
    panel_axes = figure.subplots(
        n_panel_rows, n_panel_columns, sharex=True, sharey=True, squeeze=False
    )
    for axes in panel_axes.ravel()[len(measure_names) :]:
        axes.set_axis_off()
    for axes, measure_name in zip(panel_axes.ravel(), measure_names, strict=False):
        sobol_indices_of_measure = indices.sel(measure=measure_name)
        for sobol_index_name, legend_text, bar_offset, bar_color in (
            ("first_order", "by itself (first order)", -0.19, OKABE_ITO_BLUE),
            ("total", "with all it meets (total)", 0.19, OKABE_ITO_AMBER),
        ):
            sobol_index_values = sobol_indices_of_measure[sobol_index_name].values
            lower_confidence_bounds, upper_confidence_bounds = (
                sobol_indices_of_measure[f"{sobol_index_name}_lower"].values,
                sobol_indices_of_measure[f"{sobol_index_name}_upper"].values,
            )
            confidence_interval_lengths = np.maximum(
                [
                    sobol_index_values - lower_confidence_bounds,
                    upper_confidence_bounds - sobol_index_values,
                ],
                0.0,
            )
            sobol_bar_style = {"height": 0.36, "color": bar_color, "label": legend_text}
            axes.barh(
                bar_positions + bar_offset,
                sobol_index_values,
                xerr=confidence_interval_lengths,
                error_kw={"elinewidth": 0.7},
                **sobol_bar_style,
            )
        if sobol_indices_of_measure.is_constant_measure:
            axes.text(0.5, 0.5, "constant", ha="center", va="center", transform=axes.transAxes)
        axes.set_title(typeset_greek_symbols(MEASURES[str(measure_name)].long_name))
        axes.set_yticks(
            bar_positions,
            [f"${MEASURES[parameter_name].mathtext}$" for parameter_name in parameter_names],
        )
        axes.set_xlim(0.0, 1.05)
    panel_axes[0, 0].invert_yaxis()
    for axes in panel_axes.ravel()[
        max(len(measure_names) - n_panel_columns, 0) : len(measure_names)
    ]:
        axes.set_xlabel("share of the variance")
        axes.tick_params(labelbottom=True)
    legend_handles, legend_texts = panel_axes[0, 0].get_legend_handles_labels()
    figure.legend(legend_handles, legend_texts, loc="outside lower center", ncols=2)
    omitted_samples_percent = 100.0 * indices.attrs["left_out"]
    omitted_rows_note = (
        f"{indices.attrs['rows']:,} rows; {omitted_samples_percent:.1f} % left out, without a gait"
    )
    figure.suptitle(omitted_rows_note, fontsize=8.0)
    return figure


@figure_style()
def draw_measure_curves(scan: xr.Dataset, x: str) -> Figure:
    """Return a figure of the measures in `SHOWN_MEASURE_NAMES` as functions of one parameter.

    Parameter values without a gait are gray.
    """
    scan = scan.isel(
        {
            parameter_name: 0
            for parameter_name in SWEEPABLE_PARAMETERS
            if parameter_name in scan.dims and parameter_name != x
        }
    ).sortby(x)
    measure_names = _list_shown_measures(scan) or ["fore_foot_force"]
    figure = Figure(figsize=(COLUMN_FIGURE_WIDTH_INCHES, 1.6 * len(measure_names) + 0.6))
    panel_axes = figure.subplots(len(measure_names), 1, sharex=True, squeeze=False)[:, 0]
    cell_edges = _find_cell_edges(scan[x].values)
    is_gait_missing = scan.outcome.values != Outcome.STEPPED
    for axes, measure_name in zip(panel_axes, measure_names, strict=True):
        axes.plot(scan[x].values, scan[measure_name].values, marker=".", color=OKABE_ITO_BLUE)
        axes.set_yscale("log" if measure_name in LOGARITHMIC_MEASURE_NAMES else "linear")
        axes.set_ylabel(textwrap.fill(format_axis_label(measure_name, "{name}"), 24))
        for sample_index in np.flatnonzero(is_gait_missing):
            axes.axvspan(
                cell_edges[sample_index],
                cell_edges[sample_index + 1],
                color=LIGHT_GRAY_COLOR,
                linewidth=0.0,
                zorder=0,
            )
    panel_axes[-1].set_xlabel(format_axis_label(x))
    return figure


def _list_shown_measures(scan: xr.Dataset) -> list[str]:
    """Return the names of the measures that figures show for this scan."""
    return [measure_name for measure_name in SHOWN_MEASURE_NAMES if measure_name in scan]


def _find_color_limits(
    measure_values_by_panel: Sequence[np.ndarray], is_stable_by_panel: Sequence[np.ndarray]
) -> tuple[float, float]:
    """Return the color range for the panels of one measure.

    The range is that of the stable gaits, or of all gaits if none is stable. A few distant unstable
    gaits would otherwise make the colors of all other gaits equal.
    """
    finite_values_by_panel = [
        values_of_panel[np.isfinite(values_of_panel)] for values_of_panel in measure_values_by_panel
    ]
    stable_values_by_panel = [
        v[s & np.isfinite(v)]
        for v, s in zip(measure_values_by_panel, is_stable_by_panel, strict=True)
    ]
    values_in_range = np.concatenate(
        stable_values_by_panel if any(map(len, stable_values_by_panel)) else finite_values_by_panel
    )
    return (
        (float(values_in_range.min()), float(values_in_range.max()))
        if len(values_in_range)
        else (0.0, 1.0)
    )


def _make_color_scale(measure_name: str, color_limits: tuple[float, float]) -> Normalize:
    """Return the linear or logarithmic color scale for a measure."""
    if measure_name in LOGARITHMIC_MEASURE_NAMES and color_limits[0] > 0.0:
        return LogNorm(*color_limits)
    return Normalize(*color_limits)


def _find_extended_color_bar_ends(
    measure_values_by_panel: Sequence[np.ndarray], color_limits: tuple[float, float]
) -> Literal["neither", "min", "max", "both"]:
    """Return the ends of a color bar beyond which values lie: "neither", "min", "max" or "both"."""
    finite_values_by_panel = np.concatenate(
        [
            values_of_panel[np.isfinite(values_of_panel)]
            for values_of_panel in measure_values_by_panel
        ]
    )
    has_values_below, has_values_above = (
        np.any(finite_values_by_panel < color_limits[0]),
        np.any(finite_values_by_panel > color_limits[1]),
    )
    return (
        ("both" if has_values_above else "min")
        if has_values_below
        else ("max" if has_values_above else "neither")
    )


def _draw_measure_cells(
    axes: Axes,
    x: np.ndarray,
    y: np.ndarray,
    measure_values_by_cell: np.ndarray,
    color_scale: Normalize,
) -> AxesImage:
    """Draw one colored cell per grid point, without interpolation, and return the mesh of cells."""
    axes.set_facecolor(LIGHT_GRAY_COLOR)
    masked_measure_values = np.ma.masked_invalid(measure_values_by_cell)
    cell_mesh = axes.pcolormesh(
        _find_cell_edges(x),
        _find_cell_edges(y),
        masked_measure_values,
        cmap="viridis",
        norm=color_scale,
    )
    cell_mesh.set_rasterized(True)
    return cell_mesh  # type: ignore[return-value]  # A color bar accepts it.


def _find_cell_edges(cell_center_positions: np.ndarray) -> np.ndarray:
    """Return the edges of cells around the given positions."""
    if len(cell_center_positions) == 1:
        return cell_center_positions[0] + np.array([-0.5, 0.5]) * max(
            abs(cell_center_positions[0]) * 0.01, 1e-6
        )
    inner_cell_edges = 0.5 * (cell_center_positions[1:] + cell_center_positions[:-1])
    first_cell_edge, last_cell_edge = (
        2.0 * cell_center_positions[0] - inner_cell_edges[0],
        2.0 * cell_center_positions[-1] - inner_cell_edges[-1],
    )
    return np.concatenate([[first_cell_edge], inner_cell_edges, [last_cell_edge]])


def _compute_displayed_outcome_codes(scan: xr.Dataset) -> xr.DataArray:
    """Return the outcome codes of a scan, with unstable cycles replaced by `UNSTABLE_CYCLE_CODE`.

    They are replaced only if the scan contains the spectral radius.
    """
    outcome_codes_with_instability = scan.outcome.astype(int)
    if "spectral_radius" not in scan:
        return outcome_codes_with_instability
    return outcome_codes_with_instability.where(~(scan.spectral_radius >= 1.0), UNSTABLE_CYCLE_CODE)


def _draw_margin_zero_lines(axes: Axes, scan: xr.Dataset, x: str, y: str) -> dict[str, Line2D]:
    """Draw the curves on which a margin is 0, and return their legend entries, by margin name."""
    legend_lines = {}
    for margin_name in DRAWN_MARGIN_NAMES:
        if margin_name not in scan or scan.sizes[x] < 2 or scan.sizes[y] < 2:
            continue
        margin_array = scan[margin_name]
        if MARGIN_MEASURES[margin_name].leg_dimension:
            margin_array = margin_array.min("leg")
        if margin_name == "clearance_sls1" and "takeoff_acceleration" in scan:
            # Without missing values the line has no steps.
            margin_array = margin_array.where(scan.takeoff_acceleration >= 0.0)
        margin_values = margin_array.transpose(y, x).values
        finite_values_by_panel = margin_values[np.isfinite(margin_values)]
        if (
            not len(finite_values_by_panel)
            or finite_values_by_panel.min() >= 0.0
            or finite_values_by_panel.max() <= 0.0
        ):
            continue
        line_color, line_style = select_special_point_style(margin_name)
        axes.contour(
            scan[x].values, scan[y].values, np.ma.masked_invalid(margin_values), levels=[0.0],
            colors=[line_color], linestyles=[line_style], linewidths=1.4,
        ).set_path_effects([Stroke(linewidth=2.6, foreground="white"), Normal()])  # fmt: skip
        legend_lines[margin_name] = Line2D(
            [],
            [],
            color=line_color,
            linestyle=line_style,
            label=MARGIN_MEASURES[margin_name].violation_text,
        )
    return legend_lines


def _add_scan_legend(
    figure: Figure,
    outcome_codes: np.ndarray,
    legend_lines: Mapping[str, Line2D],
    n_panel_columns: int,
) -> None:
    """Add a legend of outcomes and of margin curves below a figure."""
    margin_lines = [
        legend_lines[margin_name]
        for margin_name in DRAWN_MARGIN_NAMES
        if margin_name in legend_lines
    ]
    figure.legend(
        handles=[*make_outcome_patches(outcome_codes), *margin_lines],
        loc="outside lower center",
        ncols=4 if n_panel_columns > 1 else 2,
        fontsize=7.5,
        columnspacing=1.4,
    )


@figure_style()
def map_figure(scan: xr.Dataset, measure: str, curves: Sequence[SpecialPointCurve]) -> Figure:
    """Return a map of a measure over two parameters, with curves of special points.

    Cells without a gait are gray. A curve is thin where its gaits are unstable.

    Args:
        scan: dataset that `vrw.scan` returns for a grid of two parameters.
        measure: name of a measure in the scan.
        curves: results of `vrw.continue_special_point` for the same parameters; may be empty.

    Returns:
        Figure: one panel, in SI units.

    Examples:
        >>> grid = vrw.grid(damping=[150.0, 200.0], slope=[0.28, 0.3])
        >>> figure = vrw.plot.map_figure(vrw.scan(grid, ["speed"]), "speed", [])
    """
    require_dataset_variables(
        "scan", scan, ("outcome", measure), "give vrw.scan of two parameters and the measure"
    )
    x, y = (
        curves[0].parameters
        if curves
        else [
            parameter_name for parameter_name in SWEEPABLE_PARAMETERS if parameter_name in scan.dims
        ]
    )
    figure = Figure(figsize=(PAGE_FIGURE_WIDTH_INCHES, 0.62 * PAGE_FIGURE_WIDTH_INCHES))
    axes = figure.subplots()
    axes.set_facecolor(LIGHT_GRAY_COLOR)
    measure_values = scan[measure].where(scan.outcome == 0).transpose(y, x).values
    measure_image = axes.pcolormesh(
        scan[x].values,
        scan[y].values,
        measure_values,
        shading="nearest",
        cmap="cividis",
        rasterized=True,
    )
    figure.colorbar(measure_image, ax=axes, aspect=30, pad=0.01).set_label(
        format_axis_label(measure)
    )
    special_point_names = sorted({special_point_curve.name for special_point_curve in curves})
    legend_texts = {
        special_point_name: typeset_greek_symbols(describe_violation(special_point_name))
        for special_point_name in special_point_names
    }
    for special_point_curve in curves:
        curve_color, line_style = select_special_point_style(special_point_curve.name)
        is_stable = special_point_curve.dataset.spectral_radius.values < 1.0
        for is_point_drawn, line_width in ((is_stable, 1.2), (~is_stable, 0.5)):
            # Each piece includes the first point of the next piece. The curve has one legend entry.
            is_point_or_next_drawn = is_point_drawn | np.append(False, is_point_drawn[:-1])
            curve_points = np.where(
                is_point_or_next_drawn[:, None], special_point_curve.values, np.nan
            )
            legend_text = (
                legend_texts.pop(special_point_curve.name, None) if is_point_drawn.any() else None
            )
            line_outline = [Stroke(linewidth=line_width + 1.0, foreground="white"), Normal()]
            axes.plot(
                *curve_points.T, color=curve_color, linestyle=line_style, linewidth=line_width,
                label=legend_text,
                path_effects=line_outline,
            )  # fmt: skip
    codim2_points = np.array(
        [
            codim2_point.values
            for special_point_curve in curves
            for codim2_point in special_point_curve.codim2_points
        ]
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
