"""Tornado plots: bars that show the change of each measure per parameter, sorted by length."""

from collections.abc import Iterable, Mapping

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from vrw_jax.app.figure_style import (
    OKABE_ITO_AMBER,
    OKABE_ITO_BLUE,
    PAGE_FIGURE_WIDTH_INCHES,
    FigureWidth,
    add_figure_legend,
    figure_style,
    find_width_inches,
    format_axis_label,
    make_bar_panels,
    require_dataset_variables,
)
from vrw_jax.base.checks import check_names, check_positive, require_known_name
from vrw_jax.models.measures import MEASURES
from vrw_jax.wheel.params import check_parameter_name

MAX_DEFAULT_DRAWN_MEASURES = 6
"""Largest number of measures that are drawn by default, chosen because two rows of panels fit a
page.
"""

PARAMETER_ROW_HEIGHT_INCHES = 0.2
"""Height of the bar of one parameter, inches, chosen because the parameter's symbol has that
height.
"""


@figure_style()
def tornado_figure(
    table: xr.Dataset,
    measures: str | Iterable[str] | None = None,
    *,
    spreads: Mapping[str, float] | None = None,
    width: FigureWidth = None,
) -> Figure:
    """Return a figure of the change of each measure with each parameter, with largest changes on
    top.

    Changes are first-order estimates, computed from the derivatives of the gait. By default they
    are in per cent of the measure, for a change of each parameter by 1 %. If `spreads` is given,
    they are in the unit of the measure, for the changes of the parameters in `spreads`. Undefined
    changes, such as for 1 % of a slope of 0, are omitted.

    Args:
        table: dataset that `vrw.sensitivities` returns.
        measures: names of the measures; by default the first six of the table.
        spreads: change of each parameter, by name, in the parameter's unit; other parameters are
            omitted.
        width: "column", "page" or a number of mm; None for the usual width.

    Returns:
        Figure: one panel per measure, with one bar per parameter.

    Raises:
        TypeError, ValueError: if an argument is invalid.

    Examples:
        >>> table = vrw.sensitivities(vrw.WheelParams(), measures=["speed", "dls_fraction"])
        >>> figure = vrw.plot.tornado_figure(table)
        >>> figure = vrw.plot.tornado_figure(table, "speed", spreads={"damping": 10.0})
    """
    require_dataset_variables(
        "table", table, ("derivative", "elasticity"), "give vrw.sensitivities(params)"
    )
    known_measure_names = tuple(map(str, table.measure.values))
    measure_names = known_measure_names[:MAX_DEFAULT_DRAWN_MEASURES]
    if measures is not None:
        measure_names = check_names("measures", measures)
    for measure_name in measure_names:
        require_known_name(measure_name, known_measure_names, "measure of this table")
    if not measure_names:
        raise ValueError('measures is empty, but something is to be drawn: give "speed", say.')
    measure_changes = table.elasticity  # changes in per cent for 1 %
    if spreads is not None:
        known_parameter_names = tuple(map(str, table.parameter.values))
        for parameter_name in spreads:
            check_parameter_name(parameter_name, known_parameter_names, "parameter of this table")
        if not spreads:
            raise ValueError('spreads is empty, but bars need one: give {"damping": 10.0}, say.')
        parameter_changes = [
            check_positive(f"spreads[{parameter_name!r}]", parameter_change)
            for parameter_name, parameter_change in spreads.items()
        ]
        measure_changes = table.derivative.sel(parameter=list(spreads)) * np.array(
            parameter_changes
        )
    panel_height = PARAMETER_ROW_HEIGHT_INCHES * measure_changes.sizes["parameter"] + 0.8
    width_fraction = 0.6 if len(measure_names) == 1 else 1.0
    width_inches = find_width_inches(width, width_fraction * PAGE_FIGURE_WIDTH_INCHES)
    figure, panel_axes = make_bar_panels(width_inches, measure_names, panel_height, 0.3)
    parameter_change_text = "1 %" if spreads is None else "by its spread"
    for axes, measure_name in zip(panel_axes, measure_names, strict=True):
        bars = measure_changes.sel(measure=measure_name)
        bars = bars[np.isfinite(bars.values)]
        bars = bars[np.argsort(-np.abs(bars.values), kind="stable")]
        for change_sign, direction, bar_color in (
            (1.0, "up", OKABE_ITO_BLUE),
            (-1.0, "down", OKABE_ITO_AMBER),
        ):
            axes.barh(
                range(bars.size),
                change_sign * bars.values,
                0.7,
                color=bar_color,
                label=f"parameter {direction} {parameter_change_text}",
            )
        axes.axvline(0.0, color="black", linewidth=0.6)
        parameter_symbols = [f"${MEASURES[str(name)].mathtext}$" for name in bars.parameter.values]
        axes.set_yticks(range(bars.size), parameter_symbols)
        axes.set_ylim(bars.size - 0.5, -0.5)
        change_label = format_axis_label(measure_name, "change of {symbol}")
        axes.set_xlabel("change [%]" if spreads is None else change_label)
    add_figure_legend(figure, panel_axes[0].get_legend_handles_labels()[0], 2)
    return figure
