"""Figures of scans: measures and outcomes over parameters, and the curves on which margins are
0.
"""

import textwrap
import warnings
from base64 import b64encode
from collections.abc import Hashable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.collections import PathCollection
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patheffects import Normal, Stroke

from vrw_jax.app._study_figures import draw_sobol_indices
from vrw_jax.app.figure_style import (
    COLUMN_FIGURE_WIDTH_INCHES,
    LIGHT_GRAY_COLOR,
    OKABE_ITO_BLUE,
    OUTCOME_LABELS_AND_COLORS,
    PAGE_FIGURE_WIDTH_INCHES,
    UNSTABLE_CYCLE_CODE,
    FigureWidth,
    StyledFigure,
    add_color_bar,
    add_figure_legend,
    draw_outcome_cells,
    figure_style,
    find_cell_edges,
    find_width_inches,
    format_axis_label,
    format_value_label,
    make_outcome_patches,
    make_panel_grid,
    require_dataset_variables,
    scale_to_width,
    select_special_point_style,
    typeset_greek_symbols,
)
from vrw_jax.base.results import Outcome
from vrw_jax.branches.branch import SpecialPointCurve
from vrw_jax.models.measures import LAW_PREFIXES, MARGIN_MEASURES, describe_violation
from vrw_jax.studies.measure_catalog import DIFFERENTIABLE_MEASURES
from vrw_jax.studies.scan_design import (
    SALTELLI_DESIGN_KIND,
    SWEEPABLE_PARAMETERS,
    read_scan_manifest,
    sobol_indices,
)

PARAMETER_AXIS_ORDER = dict.fromkeys(
    ("damping", "slope", "stiffness", "natural_length", *SWEEPABLE_PARAMETERS)
)
"""Parameters in the order in which figures assign them to the horizontal axis, the vertical axis
and the panel columns.
"""


def _is_of_own_walker(scan: xr.Dataset) -> bool:
    return "walker" in read_scan_manifest(scan.attrs).get("model", {})


def _list_swept_parameters(
    scan: xr.Dataset,
    names: Iterable[Hashable],
    parameter_order: Iterable[str] = PARAMETER_AXIS_ORDER,
) -> list[str]:
    """Return the parameters among the names in an order, and then those of leg forces.

    The parameters of a walker of yours are all names, in the order of the names.
    """
    texts = list(map(str, names))
    if _is_of_own_walker(scan):
        return [name for name in texts if name != "sample"]
    law_names = [name for name in texts if name.startswith(LAW_PREFIXES)]
    wheel_names = [name for name in parameter_order if name in texts] + law_names
    return wheel_names or [name for name in texts if name != "sample"]


DRAWN_MARGIN_NAMES = (
    "fore_foot_force", "takeoff_acceleration", "clearance_sls1", "clearance_sls2",
    "locked_stopper_force", "rear_stopper_force", "contraction", "friction_fore",
    "landing_friction_fore", "hit_planted_impulse",
)  # fmt: skip
"""Names of the margins for which figures draw the curve of value 0."""

SHOWN_MEASURE_NAMES = ("mean_steps", "dls_fraction", "speed")
"""Names of the measures that figures show if the scan contains them."""

MAX_SHOWN_OWN_MEASURES = 6
"""Largest number of measures of a walker of the user in a figure, chosen because six rows of panels
fit a page.
"""

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


class FiguresByName(dict[str, Any]):
    """Figures by name, which notebooks show one below the other."""

    def _repr_html_(self) -> str:
        return "".join(
            f'<img alt="{name}" src="data:image/png;base64,'
            f'{b64encode(figure._repr_png_()).decode()}"><br>'
            for name, figure in self.items()
        )


@figure_style()
def scan_figures(scan: xr.Dataset, *, width: FigureWidth = None) -> dict[str, Figure]:
    """Return the figures of a scan, by name.

    A grid with one or two axes leads to one figure. Further axes add one figure each. Narrow
    figures show fewer slices of a grid and fewer pairs of parameters. For a walker of your own, the
    figures show the first six measures that were asked for, and a warning names the others. A
    figure of pairs of parameters shows one measure. Of a measure with one value per leg, figures
    show the smallest. Infinite values of parameters are left out with a warning, and so are Sobol'
    indices if too few rows of a `saltelli` design have gaits.

    Args:
        scan: dataset that `vrw.scan` returns for a grid or for samples.
        width: "column", "page" or a number of mm; None for the usual width.

    Returns:
        dict[str, Figure]: the figures, whose names depend on the design.

    Examples:
        >>> gaits = vrw.scan(vrw.grid(damping=[150.0, 200.0]), ["speed", "dls_fraction"])
        >>> sorted(vrw.plot.scan_figures(gaits))
        ['scan']
    """
    require_dataset_variables("scan", scan, ("outcome",), "give vrw.scan(design)")
    _warn_of_omitted_measures(scan)
    swept_parameters = _list_swept_parameters(scan, scan.coords)
    scan = _take_least_over_legs(_leave_out_infinite_values(scan, swept_parameters))
    scan = scan.sortby([name for name in swept_parameters if name in scan.dims])
    varied_parameters = [
        parameter_name
        for parameter_name in swept_parameters
        if scan[parameter_name].values.max() > scan[parameter_name].values.min()
    ] or swept_parameters
    if "sample" in scan.dims:
        if len(varied_parameters) < 3:
            return FiguresByName(scan=draw_scan_samples(scan, varied_parameters, width))
        figures_by_name = FiguresByName(
            scan_pairs=draw_parameter_pairs(scan, varied_parameters, width)
        )
        if read_scan_manifest(scan.attrs).get("design", {}).get("kind") == SALTELLI_DESIGN_KIND:
            measure_names = (
                _list_shown_measures(scan)
                if _is_of_own_walker(scan)
                else [name for name in DIFFERENTIABLE_MEASURES if name in scan]
            )
            try:
                indices = sobol_indices(scan, measure_names)
            except ValueError as error:
                warnings.warn(f"scan_figures draws no Sobol' indices: {error}", stacklevel=3)
            else:
                figures_by_name["sobol_indices"] = draw_sobol_indices(indices, scan, width)
        return figures_by_name
    if len(varied_parameters) == 1:
        return FiguresByName(scan=draw_measure_curves(scan, varied_parameters[0], width))
    x, y, *further_parameters = varied_parameters
    if not further_parameters:
        return FiguresByName(scan=draw_scan_slices(scan, x, y, None, width))
    return FiguresByName(
        (f"scan_over_{parameter_name}", draw_scan_slices(scan, x, y, parameter_name, width))
        for parameter_name in further_parameters
    )


def _take_least_over_legs(scan: xr.Dataset) -> xr.Dataset:
    return scan.min("leg", keep_attrs=True) if "leg" in scan.dims else scan


def _leave_out_infinite_values(scan: xr.Dataset, parameter_names: Iterable[str]) -> xr.Dataset:
    """Return the scan without samples that no axis can show, and warn of them.

    A parameter without a finite value is not varied, so that it needs no axis.
    """
    for name in parameter_names:
        is_finite = np.isfinite(scan[name].values)
        if is_finite.any() and not is_finite.all():
            warnings.warn(
                f"scan_figures leaves out samples whose {name} is infinite or NaN, because no axis "
                "shows them: see them in the dataset.",
                stacklevel=4,
            )
            scan = scan.isel({scan[name].dims[0]: is_finite})
    return scan


def _warn_of_omitted_measures(scan: xr.Dataset) -> None:
    """Warn if a walker of the user has more measures than figures show."""
    asked_names = read_scan_manifest(scan.attrs).get("measures", ())
    shown_names = _list_shown_measures(scan)
    omitted_names = [name for name in asked_names if name in scan and name not in shown_names]
    if _is_of_own_walker(scan) and omitted_names:
        warnings.warn(
            f"scan_figures draws the first {len(shown_names)} measures, without "
            f"{', '.join(omitted_names)}: leave others out with scan.drop_vars([...]).",
            stacklevel=4,
        )


def draw_scan_slices(
    scan: xr.Dataset, x: str, y: str, panel_column_parameter: str | None, width: FigureWidth
) -> Figure:
    """Return a figure over two parameters, with one column of panels per value of
    `panel_column_parameter`.

    `x` and `y` are the names of the two parameters. The figure shows outcomes and the measures in
    `SHOWN_MEASURE_NAMES`. Every other parameter has the middle one of its values, which the title
    states. Cells without a gait are gray.
    """
    slice_indices = {
        parameter_name: scan.sizes[parameter_name] // 2
        for parameter_name in _list_swept_parameters(scan, scan.dims)
        if parameter_name not in (x, y, panel_column_parameter)
    }
    panel_column_datasets = [scan.isel(slice_indices).transpose(y, x, ...)]
    width_inches = find_width_inches(width, COLUMN_FIGURE_WIDTH_INCHES)
    if panel_column_parameter is not None:
        last_index = scan.sizes[panel_column_parameter] - 1
        if last_index:
            width_inches = find_width_inches(width, PAGE_FIGURE_WIDTH_INCHES)
        max_n_columns = scale_to_width(MAX_PANEL_COLUMNS, width_inches)
        panel_column_indices = np.linspace(0, last_index, min(last_index + 1, max_n_columns))
        panel_column_datasets = [
            panel_column_datasets[0].isel({panel_column_parameter: panel_column_index})
            for panel_column_index in panel_column_indices.round().astype(int)
        ]
    n_panel_columns = len(panel_column_datasets)
    panel_measures = _list_shown_measures(scan)
    figure = StyledFigure(figsize=(width_inches, 1.65 * (len(panel_measures) + 1) + 1.0))
    panel_axes = figure.subplots(
        len(panel_measures) + 1, n_panel_columns, sharex=True, sharey=True, squeeze=False
    )
    outcome_codes_by_panel = np.stack(
        [_compute_displayed_outcome_codes(dataset) for dataset in panel_column_datasets]
    )
    outcome_codes = np.unique(outcome_codes_by_panel)
    cell_edges = find_cell_edges(scan[x].values), find_cell_edges(scan[y].values)
    for axes_of_row, measure_name in zip(panel_axes, panel_measures, strict=False):
        measure_values = np.stack([dataset[measure_name] for dataset in panel_column_datasets])
        color_scale = _make_color_scale(
            measure_name, measure_values, outcome_codes_by_panel == Outcome.STEPPED
        )
        for axes, values_of_panel in zip(axes_of_row, measure_values, strict=True):
            axes.set_facecolor(LIGHT_GRAY_COLOR)
            cell_mesh = axes.pcolormesh(
                *cell_edges, values_of_panel, cmap="viridis", norm=color_scale, rasterized=True
            )
        add_color_bar(
            figure,
            axes_of_row.tolist(),
            cell_mesh,
            measure_values,
            textwrap.fill(format_axis_label(measure_name, "{name}", scan), 24),
            aspect=12,
            pad=0.01,
        )
    legend_lines: dict[str, Line2D] = {}
    for axes_of_column, dataset, codes_of_panel in zip(
        panel_axes.T, panel_column_datasets, outcome_codes_by_panel, strict=True
    ):
        draw_outcome_cells(axes_of_column[-1], *cell_edges, codes_of_panel, outcome_codes)
        for axes in axes_of_column:
            legend_lines |= _draw_margin_zero_lines(axes, dataset, x, y)
        if panel_column_parameter is not None:
            panel_value = dataset[panel_column_parameter].item()
            axes_of_column[0].set_title(
                format_value_label(panel_column_parameter, panel_value, dataset=scan)
            )
        axes_of_column[-1].set_xlabel(
            format_axis_label(
                x, "{name} {symbol}" if width_inches > 2.5 * n_panel_columns else "{symbol}", scan
            )
        )
    for axes in panel_axes[:, 0]:
        axes.set_ylabel(format_axis_label(y, "{symbol}", scan))
    _add_scan_legend(figure, outcome_codes, legend_lines, n_panel_columns)
    if slice_indices:
        fixed_values_text = ", ".join(
            format_value_label(
                parameter_name, scan[parameter_name].values[slice_index], dataset=scan
            )
            for parameter_name, slice_index in slice_indices.items()
        )
        figure.suptitle(f"at {fixed_values_text}", fontsize=9.0)
    return figure


def draw_scan_samples(
    scan: xr.Dataset, parameter_names: Sequence[str], width: FigureWidth
) -> Figure:
    """Return a figure of individual samples over the first two parameters."""
    x, y, *_ = (*parameter_names, "sample")
    measure_names = _list_shown_measures(scan)
    marker_size = float(np.clip(3000.0 / max(scan.sizes["sample"], 1), 1.0, 12.0))
    n_panels = len(measure_names) + 1
    width_inches = find_width_inches(width, PAGE_FIGURE_WIDTH_INCHES)
    figure, panel_axes = make_panel_grid(
        width_inches, n_panels, 2.4, 0.5, min(n_panels, MAX_PANEL_COLUMNS), sharey=True
    )
    for axes, measure_name in zip(panel_axes, measure_names, strict=False):
        point_collection = _draw_measure_samples(axes, scan, x, y, measure_name, marker_size)
        add_color_bar(
            figure,
            axes,
            point_collection,
            scan[measure_name].values,
            format_axis_label(measure_name, dataset=scan),
            location="top",
            aspect=25,
        )
    outcome_codes = _compute_displayed_outcome_codes(scan)
    _draw_outcome_samples(
        panel_axes[-1], scan[x].values, scan[y].values, outcome_codes, marker_size
    )
    for axes in panel_axes:
        axes.set_xlabel(format_axis_label(x, "{symbol}", scan))
        if axes.get_subplotspec().is_first_col():
            is_sample = y == "sample"
            axes.set_ylabel(y if is_sample else format_axis_label(y, "{symbol}", scan))
    _add_scan_legend(figure, np.unique(outcome_codes), {}, 3)
    return figure


def draw_parameter_pairs(
    scan: xr.Dataset, parameter_names: Sequence[str], width: FigureWidth
) -> Figure:
    """Return a figure with one panel of samples per pair of parameters.

    Panels below the diagonal show a measure, and panels above the diagonal show the outcome. The
    measure is the first of `SHOWN_MEASURE_NAMES` that the scan contains. Panels on the diagonal
    show the fraction of samples with a stable cycle. Only the first `MAX_DRAWN_SAMPLES` samples are
    drawn, because they are spread as evenly as all samples.
    """
    drawn_samples = scan.isel(sample=slice(MAX_DRAWN_SAMPLES))
    measure_name = next(iter(_list_shown_measures(scan)), None)
    outcome_codes = _compute_displayed_outcome_codes(drawn_samples)
    width_inches = find_width_inches(width, PAGE_FIGURE_WIDTH_INCHES)
    parameter_names = parameter_names[: scale_to_width(MAX_PAIRED_PARAMETERS, width_inches)]
    n_parameters = len(parameter_names)
    marker_size = float(np.clip(8000.0 / len(outcome_codes), 0.6, 8.0))
    figure = StyledFigure(figsize=(width_inches, width_inches * 0.9))
    panel_axes = figure.subplots(n_parameters, n_parameters, sharex="col", squeeze=False)
    point_collection = None
    for (i, j), axes in np.ndenumerate(panel_axes):
        x, y = parameter_names[j], parameter_names[i]
        x_values, y_values = drawn_samples[x].values, drawn_samples[y].values
        if i == j:
            histogram_edges = np.linspace(x_values.min(), x_values.max(), 13)
            n_samples, n_stable_samples = (
                np.histogram(parameter_values, histogram_edges)[0]
                for parameter_values in (x_values, x_values[outcome_codes == Outcome.STEPPED])
            )
            stable_fraction = n_stable_samples / np.maximum(n_samples, 1)
            stable_color = OUTCOME_LABELS_AND_COLORS[Outcome.STEPPED][1]
            axes.stairs(stable_fraction, histogram_edges, fill=True, color=stable_color)
            axes.set_ylim(0.0, 1.0)
        elif i < j:
            _draw_outcome_samples(axes, x_values, y_values, outcome_codes, marker_size)
        elif measure_name is not None:
            point_collection = _draw_measure_samples(
                axes, drawn_samples, x, y, measure_name, marker_size
            )
        if i == n_parameters - 1:
            axes.set_xlabel(format_axis_label(x, "{symbol}", scan))
        if j == 0 and i > 0:
            axes.set_ylabel(format_axis_label(y, "{symbol}", scan))
        elif i != j:
            axes.tick_params(labelleft=False)
    panel_axes[0, 0].set_ylabel("share that walks")
    if width_inches < 1.3 * n_parameters:  # The labels need more space than the panels have.
        panel_axes[0, 0].set_ylabel("share that\nwalks")
        for axes in panel_axes.flat:
            axes.locator_params(nbins=2)
            axes.tick_params("x", rotation=90)
    if measure_name is not None and point_collection is not None:
        add_color_bar(
            figure,
            panel_axes.ravel().tolist(),
            point_collection,
            drawn_samples[measure_name].values,
            format_axis_label(measure_name, "{name}", scan),
            aspect=40,
            pad=0.01,
        )
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
    is_stable = _compute_displayed_outcome_codes(scan) == Outcome.STEPPED
    x_values, y_values = scan[x].values, scan[y].values
    axes.scatter(x_values[~has_gait], y_values[~has_gait], color=LIGHT_GRAY_COLOR, **marker_style)
    return axes.scatter(
        x_values[has_gait],
        y_values[has_gait],
        c=measure_values[has_gait],
        norm=_make_color_scale(measure_name, measure_values, is_stable),
        **marker_style,
    )


def _draw_outcome_samples(
    axes: Axes, x: np.ndarray, y: np.ndarray, outcome_codes: np.ndarray, marker_size: float
) -> None:
    outcome_colors = [OUTCOME_LABELS_AND_COLORS[outcome_code][1] for outcome_code in outcome_codes]
    axes.scatter(x, y, s=marker_size, color=outcome_colors, linewidths=0.0, rasterized=True)


def draw_measure_curves(scan: xr.Dataset, x: str, width: FigureWidth) -> Figure:
    """Return a figure of the measures in `SHOWN_MEASURE_NAMES` as functions of one parameter.

    Parameter values without a gait are gray.
    """
    scan = scan.isel(
        {
            parameter_name: 0
            for parameter_name in _list_swept_parameters(scan, scan.dims)
            if parameter_name != x
        }
    )
    measure_names = _list_shown_measures(scan) or ["fore_foot_force"]
    width_inches = find_width_inches(width, COLUMN_FIGURE_WIDTH_INCHES)
    figure = StyledFigure(figsize=(width_inches, 1.6 * len(measure_names) + 0.6))
    panel_axes = figure.subplots(len(measure_names), 1, sharex=True, squeeze=False)[:, 0]
    cell_edges = find_cell_edges(scan[x].values)
    missing_gait_indices = np.flatnonzero(scan.outcome.values != Outcome.STEPPED)
    for axes, measure_name in zip(panel_axes, measure_names, strict=True):
        axes.plot(scan[x].values, scan[measure_name].values, marker=".", color=OKABE_ITO_BLUE)
        axes.set_yscale("log" if measure_name in LOGARITHMIC_MEASURE_NAMES else "linear")
        axes.set_ylabel(textwrap.fill(format_axis_label(measure_name, "{name}", scan), 24))
        for sample_index in missing_gait_indices:
            cell_ends = cell_edges[sample_index : sample_index + 2]
            axes.axvspan(*cell_ends, color=LIGHT_GRAY_COLOR, linewidth=0.0, zorder=0)
    panel_axes[-1].set_xlabel(format_axis_label(x, dataset=scan))
    return figure


def _list_shown_measures(scan: xr.Dataset) -> list[str]:
    """Return the names of the measures to be shown: of a walker of yours, the first ones."""
    first_names = [str(name) for name in scan.data_vars if scan[name].dtype.kind == "f"]
    if _is_of_own_walker(scan):
        asked_names = read_scan_manifest(scan.attrs).get("measures", ())
        own_names = [x for x in first_names if x != "spectral_radius" or x in asked_names]
        return own_names[:MAX_SHOWN_OWN_MEASURES]
    shown_names = [name for name in SHOWN_MEASURE_NAMES if name in scan]
    return shown_names or first_names[: len(SHOWN_MEASURE_NAMES)]


def _make_color_scale(
    measure_name: str, measure_values: np.ndarray, is_stable: np.ndarray
) -> Normalize:
    """Return the linear or logarithmic color scale for a measure.

    Its range is that of the stable gaits, or of all gaits if none is stable. A few distant unstable
    gaits would otherwise make the colors of all other gaits equal.
    """
    is_finite = np.isfinite(measure_values)
    is_in_range = is_finite & is_stable if (is_finite & is_stable).any() else is_finite
    if not is_in_range.any():
        return Normalize(0.0, 1.0)
    min_value, max_value = measure_values[is_in_range].min(), measure_values[is_in_range].max()
    is_logarithmic = measure_name in LOGARITHMIC_MEASURE_NAMES and min_value > 0.0
    return (LogNorm if is_logarithmic else Normalize)(min_value, max_value)


def _compute_displayed_outcome_codes(scan: xr.Dataset) -> np.ndarray:
    """Return the outcome codes of a scan, with unstable cycles replaced by `UNSTABLE_CYCLE_CODE`.

    They are replaced only if the scan contains the spectral radius.
    """
    outcome_codes = scan.outcome.values.astype(int)
    if "spectral_radius" in scan:
        outcome_codes[scan.spectral_radius.values >= 1.0] = UNSTABLE_CYCLE_CODE
    return outcome_codes


def _draw_margin_zero_lines(axes: Axes, scan: xr.Dataset, x: str, y: str) -> dict[str, Line2D]:
    """Draw the curves on which a margin is 0, and return their legend entries, by margin name.

    The first dimension of the margins is `y`.
    """
    legend_lines: dict[str, Line2D] = {}
    if min(scan.sizes[x], scan.sizes[y]) < 2:
        return legend_lines
    for margin_name in DRAWN_MARGIN_NAMES:
        if margin_name not in scan:
            continue
        margin_array = scan[margin_name]
        if margin_name == "clearance_sls1" and "takeoff_acceleration" in scan:
            # Without missing values the line has no steps.
            margin_array = margin_array.where(scan.takeoff_acceleration >= 0.0)
        margin_values = margin_array.values
        if not ((margin_values < 0.0).any() and (margin_values > 0.0).any()):
            continue
        line_color, line_style = select_special_point_style(margin_name)
        axes.contour(
            scan[x].values, scan[y].values, margin_values, levels=[0.0],
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
    margin_names = sorted(legend_lines, key=DRAWN_MARGIN_NAMES.index)
    margin_lines = [legend_lines[margin_name] for margin_name in margin_names]
    add_figure_legend(
        figure,
        [*make_outcome_patches(outcome_codes), *margin_lines],
        4 if n_panel_columns > 1 else 2,
        fontsize=7.5,
        columnspacing=1.4,
    )


@figure_style()
def map_figure(
    scan: xr.Dataset,
    measure: str,
    curves: Sequence[SpecialPointCurve],
    *,
    width: FigureWidth = None,
) -> Figure:
    """Return a map of a measure over two parameters, with curves of special points.

    Cells without a gait are gray. A curve is thin where its gaits are unstable.

    Args:
        scan: dataset that `vrw.scan` returns for a grid of two parameters.
        measure: name of a measure in the scan.
        curves: results of `vrw.continue_special_point` for the same parameters; may be empty.
        width: "column", "page" or a number of mm; None for the usual width.

    Returns:
        Figure: one panel, in SI units.

    Examples:
        >>> grid = vrw.grid(damping=[150.0, 200.0], slope=[0.28, 0.3])
        >>> figure = vrw.plot.map_figure(vrw.scan(grid, ["speed"]), "speed", [])
    """
    require_dataset_variables(
        "scan", scan, ("outcome", measure), "give vrw.scan of two parameters and the measure"
    )
    scan = _take_least_over_legs(scan)
    names = _list_swept_parameters(scan, scan.dims, SWEEPABLE_PARAMETERS)
    if len(names) != 2:
        raise ValueError(
            f"the scan is over {', '.join(names) or 'samples'}, but a map is over two parameters: "
            "give vrw.scan of a grid of two, or a part of a larger one by scan.sel."
        )
    for curve in curves:
        if set(curve.parameters) != set(names):
            raise ValueError(
                f"a curve is over {' and '.join(curve.parameters)}, but the scan is over "
                f"{' and '.join(names)}: give curves in the parameters of the scan."
            )
    x, y = curves[0].parameters if curves else names
    scan = scan.sortby([x, y])
    width_inches = find_width_inches(width, PAGE_FIGURE_WIDTH_INCHES)
    figure = StyledFigure(figsize=(width_inches, 0.62 * width_inches))
    axes = figure.subplots()
    axes.set_facecolor(LIGHT_GRAY_COLOR)
    values = scan[measure].where(scan.outcome == 0).transpose(y, x).values
    image_settings: dict[str, Any] = {"cmap": "cividis", "rasterized": True}
    image = axes.pcolormesh(
        scan[x].values, scan[y].values, values, shading="nearest", **image_settings
    )
    figure.colorbar(image, ax=axes, aspect=30, pad=0.01).set_label(
        format_axis_label(measure, dataset=scan)
    )
    _draw_special_point_curves(axes, curves, x, y)
    axes.set(
        xlabel=format_axis_label(x, dataset=scan),
        ylabel=format_axis_label(y, dataset=scan),
        xlim=scan[x].values[[0, -1]],
        ylim=scan[y].values[[0, -1]],
    )
    if curves:
        add_figure_legend(figure, axes.get_legend_handles_labels()[0], 2)
    return figure


def _draw_special_point_curves(
    axes: Axes, curves: Sequence[SpecialPointCurve], x: str, y: str
) -> None:
    """Draw curves of special points, and mark the points at which two special points coincide."""
    labeled = set()
    for curve in curves:
        color, line_style = select_special_point_style(curve.name)
        is_stable = curve.dataset.spectral_radius.values < 1.0
        for is_drawn, line_width in ((is_stable, 1.2), (~is_stable, 0.5)):
            # Each piece includes the first point of the next piece. The curve has one legend entry.
            is_drawn_or_next = is_drawn | np.append(False, is_drawn[:-1])
            points = [np.where(is_drawn_or_next, curve.dataset[name], np.nan) for name in (x, y)]
            label = None
            if is_drawn.any() and curve.name not in labeled:
                labeled.add(curve.name)
                label = typeset_greek_symbols(describe_violation(curve.name))
            axes.plot(
                *points,
                color=color,
                linestyle=line_style,
                linewidth=line_width,
                label=label,
                path_effects=[Stroke(linewidth=line_width + 1.0, foreground="white"), Normal()],
            )
    double_points = [
        dict(zip(curve.parameters, point.values, strict=True))
        for curve in curves
        for point in curve.codim2_points
    ]
    if double_points:
        axes.plot(
            *([point[name] for point in double_points] for name in (x, y)),
            "o",
            color="black",
            markersize=2.5,
            markerfacecolor="white",
            markeredgewidth=0.6,
            label="two special points at once",
        )
