"""Style of all figures: journal widths, distinguishable colors, vector output, labels with units.

Figures are created inside `figure_style()`, and `save` writes them to files. No global setting of
matplotlib changes, and no window opens.
"""

import io
import math
import re
import textwrap
from collections.abc import Hashable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import xarray as xr
from cycler import cycler
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from vrw_jax.base.checks import check_path, check_real, check_type
from vrw_jax.base.results import Measure, Outcome, format_mathtext
from vrw_jax.models.measures import MEASURES

OKABE_ITO_BLUE = "#0072B2"
OKABE_ITO_ORANGE = "#D55E00"
OKABE_ITO_GREEN = "#009E73"
OKABE_ITO_PINK = "#CC79A7"
OKABE_ITO_SKY_BLUE = "#56B4E9"
OKABE_ITO_AMBER = "#E69F00"
OKABE_ITO_YELLOW = "#F0E442"
"""Last of the seven colors of Okabe and Ito. Color-blind readers can distinguish these colors."""

LEG_1_COLOR = OKABE_ITO_BLUE
LEG_2_COLOR = OKABE_ITO_ORANGE
DARK_GRAY_COLOR = "#555555"
LIGHT_GRAY_COLOR = "#E9E9E9"
"""Color of areas without a gait, and of areas that mark double support."""

MATPLOTLIB_SETTINGS: dict[Any, Any] = {
    "font.family": "serif",
    "font.serif": ["STIXGeneral"],
    "mathtext.fontset": "stix",
    "font.size": 9.0,
    "axes.titlesize": 9.0,
    "axes.labelsize": 9.0,
    "xtick.labelsize": 8.0,
    "ytick.labelsize": 8.0,
    "legend.fontsize": 8.0,
    "legend.frameon": False,
    "legend.handlelength": 2.2,
    "axes.linewidth": 0.6,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "lines.linewidth": 1.2,
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
    "xtick.direction": "out",
    "ytick.direction": "out",
    "axes.prop_cycle": cycler(
        color=[
            OKABE_ITO_BLUE,
            OKABE_ITO_ORANGE,
            OKABE_ITO_GREEN,
            OKABE_ITO_PINK,
            OKABE_ITO_SKY_BLUE,
        ]
    ),
    "figure.constrained_layout.use": True,
    "savefig.dpi": 200,
    # Journals refuse Type 3 fonts, which are matplotlib's default.
    "pdf.fonttype": 42,
    "ps.fonttype": 42,
    "svg.hashsalt": "vrw_jax",  # The same figure then gives the same file.
}
"""Matplotlib settings for all figures. The serif font is included in matplotlib, and the journal
uses it.
"""

COLUMN_FIGURE_WIDTH_INCHES = 3.4
"""Width of a figure in one column, inches, chosen because it is the column width of the journal."""

PAGE_FIGURE_WIDTH_INCHES = 6.9
"""Width of a figure across the page, inches, chosen because it is the text width of the journal."""

FIGURE_WIDTHS_INCHES = {"column": COLUMN_FIGURE_WIDTH_INCHES, "page": PAGE_FIGURE_WIDTH_INCHES}
"""Named widths of figures, inches."""

FIGURE_WIDTH_LIMITS_MM = (80.0, 500.0)
"""Widths that figures accept, mm. Narrower figures leave no space for legends, and the upper limit
refuses widths in pixels.
"""

FULL_ROW_WIDTH_INCHES = 6.0
"""Width of a figure from which on no row of panels is split, inches. It is chosen below the text
widths of journals, which are 150 mm to 190 mm.
"""

MIN_PANEL_WIDTH_INCHES = 2.2
"""Width that a panel of curves needs with its labels, inches."""

MIN_BAR_PANEL_WIDTH_INCHES = 1.5
"""Width that a panel of bars needs with its labels, inches."""

MAX_PANELS_PER_ROW = 3
"""Largest number of panels in a row of bars, chosen because four panels leave no space for
parameter symbols.
"""

UNSTABLE_CYCLE_CODE = 100
"""Outcome code that figures use for a cycle with a spectral radius of at least 1. It is chosen
above all codes of `Outcome`.
"""

NOT_COMPUTED_CODE = -1
"""Outcome code of a sample that has not been computed."""

OUTCOME_LABELS_AND_COLORS: dict[int, tuple[str, str]] = {
    Outcome.STEPPED: ("stable limit cycle", OKABE_ITO_BLUE),
    Outcome.TOUCHDOWN_BEFORE_STOPPER: ("touchdown before stopper", OKABE_ITO_AMBER),
    Outcome.STOPPER_IN_DOUBLE_SUPPORT: ("stopper in DLS", OKABE_ITO_GREEN),
    Outcome.FELL_BACK: ("fell back", OKABE_ITO_SKY_BLUE),
    Outcome.COLLAPSED: ("collapsed", OKABE_ITO_ORANGE),
    Outcome.LEG_1_LIFTED_OFF: ("Leg 1 lifted off", OKABE_ITO_PINK),
    Outcome.NO_TOUCHDOWN_IN_TIME: ("no touchdown in time", "#999933"),
    Outcome.SOLVER_FAILED: ("solver gave up", "#7A1F7B"),
    Outcome.BAD_INPUT: ("bad input", "#000000"),
    Outcome.NO_CYCLE_FOUND: ("no cycle found", "#DDDDDD"),
    Outcome.TOO_MANY_EVENTS: ("too many events", "#332288"),
    Outcome.NO_ADMISSIBLE_CONTACT: ("no admissible contact", "#661100"),
    Outcome.THREE_FEET_LOADED: ("three feet loaded", "#3B8FBB"),
    Outcome.MESH_TOO_COARSE: ("mesh too coarse", "#646464"),
    Outcome.EVENT_ORDER_MISMATCH: ("other order of events", "#BABABA"),
    Outcome.BRANCH_ENDS_BEFORE_TARGET: ("branch ends on the way", "#454545"),
    Outcome.PAINLEVE_PARADOX: ("friction paradox", "#862DB8"),
    Outcome.CAME_TO_REST: ("came to rest", "#8C6D31"),
    Outcome.GUARD_VIOLATED: ("guard violated", "#AA66FF"),
    Outcome.ENDED_BY_GUARD: ("ended by a guard", "#DDFF99"),
    UNSTABLE_CYCLE_CODE: ("unstable limit cycle", OKABE_ITO_YELLOW),
    NOT_COMPUTED_CODE: ("not computed", "#FFFFFF"),
}
"""Label and color for each outcome code."""

SPECIAL_POINT_LINE_STYLES = ("-", "--", ":", "-.", (0, (5, 1, 1, 1, 1, 1)), (0, (8, 3)))
"""Line styles for curves of special points, in the order of names in
`SPECIAL_POINT_NAMES_BY_COLOR`.
"""

SPECIAL_POINT_NAMES_BY_COLOR = {
    "black": ("fold", "period_doubling", "neimark_sacker", "branch_point"),
    OKABE_ITO_BLUE: ("lambda_2_plus", "lambda_4_plus", "lambda_I4", "fore_foot_force"),
    OKABE_ITO_GREEN: ("clearance_sls1", "clearance_sls2", "", "", "", "takeoff_acceleration"),
    OKABE_ITO_SKY_BLUE: ("", "locked_stopper_force"),
    OKABE_ITO_ORANGE: ("friction_fore", "friction_rear", "landing_friction_fore",
    "landing_friction_rear"),
    OKABE_ITO_PINK: ("", "", "", "hit_planted_impulse", "hit_stopper_impulse"),
    OKABE_ITO_AMBER: (
        "duration_sls2", "duration_sls1", "duration_dls", "rear_stopper_force", "contraction",
        "landing_stopper_impulse",
    ),
}  # fmt: skip
"""Names of special points, by color. The index of a name determines the line style of the special
point, which is the same in every figure. Green and pink share no line style, because color-blind
readers may confuse them.
"""


@contextmanager
def figure_style() -> Iterator[None]:
    """Apply the style of all figures within a `with` block.

    Returns:
        A context manager that applies the matplotlib settings; it can also be used as a decorator.

    Examples:
        >>> gait = vrw.simulate(vrw.WheelParams(), vrw.paper_start(), n_steps=1)
        >>> with vrw.plot.figure_style():
        ...     figure = vrw.plot.sticks(gait)
    """
    with mpl.rc_context(MATPLOTLIB_SETTINGS):
        yield


class StyledFigure(Figure):
    """Figure that has the style of all figures wherever it is drawn, and that notebooks show."""

    # Matplotlib reads the fonts and their embedding when it draws and saves.
    draw = figure_style()(Figure.draw)
    savefig = figure_style()(Figure.savefig)

    def _repr_png_(self) -> bytes:
        png_buffer = io.BytesIO()
        self.savefig(png_buffer, format="png", dpi=self.dpi)
        return png_buffer.getvalue()


FigureWidth = str | float | None
"""Width of a figure: "column", "page", a number in mm, or None for the usual width."""


def find_width_inches(width: FigureWidth, usual_width_inches: float) -> float:
    """Return the width of a figure, inches. Raise an error if `width` is not a width."""
    if width is None:
        return usual_width_inches
    remedy = 'give "column", "page", or a number of mm'
    if isinstance(width, str):
        if width not in FIGURE_WIDTHS_INCHES:
            raise ValueError(f"width is {width!r}, but it is no width of a figure: {remedy}.")
        return FIGURE_WIDTHS_INCHES[width]
    width_mm = check_real("width", width)
    if not FIGURE_WIDTH_LIMITS_MM[0] <= width_mm <= FIGURE_WIDTH_LIMITS_MM[1]:
        raise ValueError(
            f"width is {width_mm:g} mm, but a figure is {FIGURE_WIDTH_LIMITS_MM[0]:g} to "
            f"{FIGURE_WIDTH_LIMITS_MM[1]:g} mm wide: {remedy}."
        )
    return width_mm / 25.4


def count_panel_columns(
    width_inches: float, n_panels: int, min_panel_width: float = MIN_PANEL_WIDTH_INCHES
) -> int:
    """Return how many panels a figure has in a row that has `n_panels` across a page."""
    if width_inches >= FULL_ROW_WIDTH_INCHES:
        return n_panels
    return min(n_panels, max(1, int(width_inches / min_panel_width)))


def scale_to_width(n_across_page: int, width_inches: float) -> int:
    """Return how many columns a matrix of small panels has if a page has `n_across_page`."""
    return min(n_across_page, round(n_across_page * width_inches / PAGE_FIGURE_WIDTH_INCHES))


def save(figure: Figure, folder: str | Path, name: str) -> list[Path]:
    """Write `figure` as SVG and PNG files, or as one file of another format, and return the paths.

    Texts of PDF files remain texts, in embedded fonts (Type 42).

    Args:
        figure: a matplotlib figure.
        folder: folder for the files, created if it does not exist.
        name: name of the files. A name that ends in .pdf, or in another format of matplotlib, is
            the name of a single file.

    Returns:
        list[Path]: the paths of `name`.svg and `name`.png, or of the single file.

    Raises:
        TypeError: if `folder` is not a path.
        OSError: if a file cannot be written.

    Examples:
        >>> gait = vrw.simulate(vrw.WheelParams(), vrw.paper_start(), n_steps=1)
        >>> figure, folder = vrw.plot.sticks(gait), Path(tempfile.mkdtemp())
        >>> [path.suffix for path in vrw.plot.save(figure, folder, "sticks")]
        ['.svg', '.png']
        >>> [path.name for path in vrw.plot.save(figure, folder, "sticks.pdf")]
        ['sticks.pdf']
    """
    folder = check_path("folder", folder, 'give a folder, such as "figures"')
    folder.mkdir(parents=True, exist_ok=True)
    is_file_name = Path(name).suffix[1:].lower() in figure.canvas.get_supported_filetypes()
    figure_paths = (
        [folder / name] if is_file_name else [folder / f"{name}.svg", folder / f"{name}.png"]
    )
    # Without dates and versions, the same figure gives the same file.
    varying_keys = {".svg": "Date", ".png": "Software", ".pdf": "CreationDate"}
    with figure_style():
        for figure_path in figure_paths:
            varying_key = varying_keys.get(figure_path.suffix.lower())
            figure.savefig(figure_path, metadata={varying_key: None} if varying_key else None)
    return figure_paths


def require_dataset_variables(
    argument_name: str, labeled_dataset: Any, required_names: Sequence[str], remedy_text: str
) -> None:
    """Raise an error unless `labeled_dataset` is a dataset with the needed variables or
    attributes.
    """
    check_type(argument_name, labeled_dataset, xr.Dataset, remedy_text)
    missing_required_names = [
        variable_name
        for variable_name in required_names
        if variable_name not in (*labeled_dataset.variables, *labeled_dataset.attrs)
    ]
    if missing_required_names:
        raise ValueError(
            f"{argument_name} holds no {missing_required_names[0]!r}, which is to be drawn: "
            f"{remedy_text}."
        )


def require_variables_of_datasets(
    argument_name: str, datasets: Any, required_names: Sequence[str], remedy_text: str
) -> None:
    """Raise an error unless `datasets` is a nonempty list of datasets with the needed variables."""
    check_type(argument_name, datasets, (list, tuple), f"{remedy_text}, several in a list")
    if not datasets:
        raise ValueError(f"{argument_name} is empty, but something is to be drawn: {remedy_text}.")
    for dataset_index, labeled_dataset in enumerate(datasets):
        require_dataset_variables(
            f"{argument_name}[{dataset_index}]", labeled_dataset, required_names, remedy_text
        )


def typeset_greek_symbols(symbol_text: str) -> str:
    """Return a text in which symbols such as "λ2⁺" are written as mathtext formulas.

    The text font lacks some of these symbols.
    """
    return re.sub(
        r"[θλ]\S*", lambda symbol_match: f"${format_mathtext(symbol_match[0])}$", symbol_text
    )


def describe_quantity(quantity_name: str, dataset: xr.Dataset | None = None) -> Measure:
    """Return the measure with a name, which a variable of `dataset` may be.

    A walker of the user may give another meaning to a name of the library. Its variables then have
    units and symbols, but not the unit and symbol of the library.
    """
    measure = MEASURES[quantity_name]
    if dataset is None or quantity_name not in dataset.variables:
        return measure
    attributes = dataset[quantity_name].attrs
    unit_and_symbol = attributes.get("units"), attributes.get("symbol")
    if unit_and_symbol in ((None, None), (measure.unit, measure.symbol)):
        return measure
    unit, symbol = unit_and_symbol
    if not symbol or "∂" in symbol:  # The name of a derivative already shows it.
        symbol = quantity_name.rpartition(".")[2]
    return Measure(quantity_name, unit or "1", symbol, quantity_name, "")


def _has_symbol(measure: Measure) -> bool:
    """Return whether a measure is one of the library, or has a symbol that is not its name."""
    is_in_library = measure is MEASURES.get(measure.name)
    return is_in_library or measure.symbol not in (measure.name, measure.name.rpartition(".")[2])


def declare_own_quantities(
    quantity_names: Iterable[Hashable],
    units: Iterable[Hashable],
    symbols: Mapping[str, str] | None = None,
) -> xr.Dataset:
    """Return a dataset from which labels of quantities of a walker of the user get their units.

    - `symbols`: symbols of some of the quantities by name.
    """
    named_units = zip(map(str, quantity_names), map(str, units), strict=True)
    symbols = symbols or {}
    return xr.Dataset(
        {
            name: ((), np.nan, {"units": unit, "symbol": symbols.get(name, "")})
            for name, unit in named_units
        }
    )


def _format_figure_unit(unit: str) -> str:
    """Return a unit in the form that figures use, such as "N·s/m"."""
    return unit.replace(" ", "·").replace("^2", "²").replace("^3", "³")


def format_axis_label(
    quantity_name: str, label_format: str = "{name} {symbol}", dataset: xr.Dataset | None = None
) -> str:
    """Return an axis label for a quantity, with its unit, formatted with `label_format`.

    A quantity of the user has the unit and the symbol of its variable in `dataset`, or its name in
    place of a symbol.
    """
    measure = describe_quantity(quantity_name, dataset)
    name_text, symbol_text = typeset_greek_symbols(measure.long_name), f"${measure.mathtext}$"
    if not _has_symbol(measure):
        symbol_text = "" if "{name}" in label_format else name_text
    label_text = label_format.format(name=name_text, symbol=symbol_text).strip()
    unit_text = _format_figure_unit(measure.display_unit)
    return f"{label_text} [{unit_text}]" if unit_text else label_text


def format_value_label(
    quantity_name: str,
    quantity_value: float,
    n_significant_digits: int = 4,
    dataset: xr.Dataset | None = None,
) -> str:
    """Return the symbol of a quantity with its value and unit, as in "c = 50 N·s/m"."""
    measure = describe_quantity(quantity_name, dataset)
    symbol_text = f"${measure.mathtext}$" if _has_symbol(measure) else quantity_name
    unit_text = _format_figure_unit(measure.display_unit)
    return f"{symbol_text} = {quantity_value:.{n_significant_digits}g} {unit_text}".rstrip()


def make_panel_grid(
    width_inches: float,
    n_panels: int,
    panel_height: float,
    legend_height: float,
    max_n_columns: int,
    min_panel_width: float = MIN_PANEL_WIDTH_INCHES,
    **subplot_settings: Any,
) -> tuple[Figure, np.ndarray]:
    """Return a figure with rows of up to `max_n_columns` panels, and the axes of its panels.

    Narrow figures have fewer panels in a row. The heights are in inches, and `legend_height` is
    that of the figure without its panels.
    """
    n_columns = count_panel_columns(width_inches, min(n_panels, max_n_columns), min_panel_width)
    n_rows = math.ceil(n_panels / n_columns)
    figure = StyledFigure(figsize=(width_inches, n_rows * panel_height + legend_height))
    panel_axes = figure.subplots(n_rows, n_columns, squeeze=False, **subplot_settings).ravel()
    for axes in panel_axes[n_panels:]:
        axes.set_axis_off()
    return figure, panel_axes[:n_panels]


def make_bar_panels(
    width_inches: float,
    measure_names: Sequence[str],
    panel_height: float,
    legend_height: float,
    dataset: xr.Dataset | None = None,
    **subplot_settings: Any,
) -> tuple[Figure, np.ndarray]:
    """Return a figure with one panel of bars per measure, and the axes of its panels.

    - `dataset`: variables that describe measures of the user.
    """
    figure, panel_axes = make_panel_grid(
        width_inches,
        len(measure_names),
        panel_height,
        legend_height,
        MAX_PANELS_PER_ROW,
        MIN_BAR_PANEL_WIDTH_INCHES,
        **subplot_settings,
    )
    n_columns = panel_axes[0].get_gridspec().ncols
    for axes, measure_name in zip(panel_axes, measure_names, strict=True):
        # An inch contains 18 letters.
        title = textwrap.fill(
            describe_quantity(measure_name, dataset).long_name, int(18.0 * width_inches / n_columns)
        )
        axes.set_title(typeset_greek_symbols(title))
    return figure, panel_axes


def label_lowest_panels(panel_axes: np.ndarray, label: str) -> None:
    """Label the horizontal axes of the last rows of a grid of panels that share these axes."""
    for axes in panel_axes[-panel_axes[0].get_gridspec().ncols :]:
        axes.tick_params(labelbottom=True)
        axes.set_xlabel(label)


def add_wrapped_legend(
    owner: Figure | Axes, max_n_columns: int, max_width_inches: float, **legend_settings: Any
) -> float:
    """Add a legend to a figure or a panel, with as many columns as `max_width_inches` allows.

    Return by how much the legend is higher than a legend with `max_n_columns`, inches.
    """
    figure: Any = owner.get_figure(root=True)
    lowest_height = math.inf
    for n_columns in range(max_n_columns, 0, -1):
        legend = owner.legend(ncols=n_columns, **legend_settings)
        extent = legend.get_window_extent()
        lowest_height = min(lowest_height, extent.height)
        if n_columns == 1 or extent.width <= max_width_inches * figure.dpi:
            break
        legend.remove()
    return float(extent.height - lowest_height) / figure.dpi


def add_figure_legend(
    figure: Figure, handles: Sequence[Artist], max_n_columns: int, **legend_settings: Any
) -> None:
    """Add a legend below a figure, with as many columns as the width of the figure allows.

    Further rows make the figure higher.
    """
    legend_settings |= {"handles": handles, "loc": "outside lower center"}
    width_inches, height_inches = figure.get_size_inches()
    added_height = add_wrapped_legend(figure, max_n_columns, width_inches, **legend_settings)
    figure.set_figheight(height_inches + added_height)


def add_side_legend(
    axes: Axes, handles: Sequence[Artist] | None = None, beside: bool = True
) -> None:
    """Add a legend on the right of a panel, or above the panel in a narrow figure.

    - `beside`: if False, the legend is above the panel in every figure.
    """
    handles = axes.get_legend_handles_labels()[0] if handles is None else handles
    figure: Any = axes.get_figure(root=True)
    if beside and count_panel_columns(figure.get_figwidth(), 2) > 1:
        axes.legend(handles=handles, loc="center left", bbox_to_anchor=(1.0, 0.5))
        return
    legend_settings = {"handles": handles, "loc": "lower center", "bbox_to_anchor": (0.5, 1.0)}
    # The labels of the vertical axis take a fifth of a narrow figure.
    add_wrapped_legend(axes, len(handles), 0.8 * figure.get_figwidth(), **legend_settings)


def draw_panel_letter(axes: Axes, panel_letter: str) -> None:
    """Write the letter of a panel to the left of the panel's top edge."""
    axes.text(-0.12, 1.02, f"({panel_letter})", transform=axes.transAxes, ha="right", va="bottom")


def draw_markers(
    axes: Axes,
    x: np.ndarray,
    y: np.ndarray,
    marker_symbol: str,
    edge_color: str,
    fill_color: str,
    **marker_style_overrides: Any,
) -> None:
    """Draw markers without a connecting line, filled with `fill_color`.

    The fill color "white" gives open markers.
    """
    marker_style: dict[str, Any] = {
        "markersize": 3.2,
        "markeredgewidth": 0.7,
        "linestyle": "none",
    } | marker_style_overrides
    axes.plot(x, y, marker_symbol, color=edge_color, markerfacecolor=fill_color, **marker_style)


def select_special_point_style(special_point_name: str) -> tuple[str, Any]:
    """Return the color and the line style for a special point.

    Special points that belong to different locked legs have different styles.
    """
    for line_color, special_point_names in SPECIAL_POINT_NAMES_BY_COLOR.items():
        if special_point_name in special_point_names:
            return line_color, SPECIAL_POINT_LINE_STYLES[
                special_point_names.index(special_point_name)
            ]
    leg_suffix = special_point_name.partition("[")[2]
    line_style_index = int(leg_suffix[:-1]) - 3 if leg_suffix else len(special_point_name)
    return OKABE_ITO_SKY_BLUE, SPECIAL_POINT_LINE_STYLES[
        line_style_index % len(SPECIAL_POINT_LINE_STYLES)
    ]


def add_color_bar(
    figure: Figure,
    axes: Axes | list[Axes],
    colored_values: ScalarMappable,
    measure_values: np.ndarray,
    label_text: str,
    **color_bar_settings: Any,
) -> None:
    """Add a color bar, whose ends are pointed if finite `measure_values` lie beyond them."""
    min_shown_value, max_shown_value = colored_values.get_clim()
    finite_values = measure_values[np.isfinite(measure_values)]
    has_lower_values = bool((finite_values < min_shown_value).any())
    has_higher_values = bool((finite_values > max_shown_value).any())
    pointed_ends = ("neither", "min", "max", "both")[has_lower_values + 2 * has_higher_values]
    figure.colorbar(colored_values, ax=axes, extend=pointed_ends, **color_bar_settings).set_label(
        label_text
    )


def find_cell_edges(cell_center_positions: np.ndarray) -> np.ndarray:
    """Return the edges of cells with the given centers, halfway between these."""
    if len(cell_center_positions) == 1:
        return cell_center_positions[0] + np.array([-0.5, 0.5]) * max(
            abs(cell_center_positions[0]) * 0.01, 1e-6
        )
    inner_cell_edges = 0.5 * (cell_center_positions[1:] + cell_center_positions[:-1])
    first_cell_edge, last_cell_edge = (
        2.0 * cell_center_positions[[0, -1]] - inner_cell_edges[[0, -1]]
    )
    return np.array([first_cell_edge, *inner_cell_edges, last_cell_edge])


def draw_outcome_cells(
    axes: Axes,
    x: np.ndarray,
    y: np.ndarray,
    outcome_codes: np.ndarray,
    drawn_outcome_codes: Sequence[int] | np.ndarray,
) -> None:
    """Draw cells over (x, y) in the colors of their outcomes.

    Cells with codes that are not in `drawn_outcome_codes` are omitted.
    """
    outcome_color_map = ListedColormap(
        [OUTCOME_LABELS_AND_COLORS[outcome_code][1] for outcome_code in drawn_outcome_codes]
    )
    outcome_code_indices = np.ma.masked_where(
        ~np.isin(outcome_codes, drawn_outcome_codes),
        np.searchsorted(drawn_outcome_codes, outcome_codes),
    )
    axes.pcolormesh(
        x,
        y,
        outcome_code_indices,
        cmap=outcome_color_map,
        vmin=-0.5,
        vmax=len(drawn_outcome_codes) - 0.5,
        rasterized=True,
    )


def make_outcome_patches(outcome_codes: Iterable[int]) -> list[Patch]:
    """Return a legend entry for each outcome code."""
    outcome_styles = [OUTCOME_LABELS_AND_COLORS[outcome_code] for outcome_code in outcome_codes]
    return [
        Patch(facecolor=outcome_color, edgecolor="#888888", linewidth=0.4, label=outcome_label)
        for outcome_label, outcome_color in outcome_styles
    ]
