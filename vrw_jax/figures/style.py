"""Style of all figures: journal widths, distinguishable colors, vector output, labels with units.

Figures are created inside `figure_style()` and written by `save`. No global setting of matplotlib
changes, and no window opens.
"""

import re
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import xarray as xr
from cycler import cycler
from matplotlib.axes import Axes
from matplotlib.colors import BoundaryNorm, ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from vrw_jax.measures import MEASURES
from vrw_jax.printing import format_mathtext
from vrw_jax.validation import check_type
from vrw_jax.wheel import Outcome

BLUE = "#0072B2"
ORANGE = "#D55E00"
GREEN = "#009E73"
PINK = "#CC79A7"
SKY = "#56B4E9"
AMBER = "#E69F00"
YELLOW = "#F0E442"
"""Last of the colors of Okabe and Ito, which color-blind readers can distinguish."""

LEG_1_COLOR = BLUE
LEG_2_COLOR = ORANGE
DARK_GRAY = "#555555"
LIGHT_GRAY = "#E9E9E9"
"""Color of areas without a gait, and of double support."""

MATPLOTLIB_STYLE: dict[Any, Any] = {
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
    "axes.prop_cycle": cycler(color=[BLUE, ORANGE, GREEN, PINK, SKY]),
    "figure.constrained_layout.use": True,
    "savefig.dpi": 200,
    "svg.hashsalt": "vrw_jax",  # The same figure then gives the same file.
}
"""Settings of matplotlib, with the serif font that matplotlib includes and the journal uses."""

COLUMN_WIDTH_INCHES = 3.4
"""Width of a figure in one column, chosen as the column width of the journal."""

PAGE_WIDTH_INCHES = 6.9
"""Width of a figure over the page, chosen as the text width of the journal."""

OUTCOME_STYLES: dict[Outcome, tuple[str, str]] = {
    Outcome.STEPPED: ("stable limit cycle", BLUE),
    Outcome.TOUCHDOWN_BEFORE_STOPPER: ("touchdown before stopper", AMBER),
    Outcome.STOPPER_IN_DOUBLE_SUPPORT: ("stopper in DLS", GREEN),
    Outcome.FELL_BACK: ("fell back", SKY),
    Outcome.COLLAPSED: ("collapsed", ORANGE),
    Outcome.LEG_1_LIFTED_OFF: ("Leg 1 lifted off", PINK),
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
}
"""Label and color of each outcome."""

SPECIAL_POINT_LINE_STYLES = ("-", "--", ":", "-.", (0, (5, 1, 1, 1, 1, 1)), (0, (8, 3)))
"""Line styles of curves of special points, in the order of the names in
`SPECIAL_POINT_NAMES_BY_COLOR`.
"""

SPECIAL_POINT_NAMES_BY_COLOR = {
    "black": ("fold", "period_doubling", "neimark_sacker", "branch_point"),
    BLUE: ("lambda_2_plus", "lambda_4_plus", "lambda_I4", "fore_foot_force"),
    GREEN: ("clearance_sls1", "clearance_sls2", "", "", "", "takeoff_acceleration"),
    SKY: ("", "locked_stopper_force"),
    ORANGE: ("friction_fore", "friction_rear", "landing_friction_fore", "landing_friction_rear"),
    PINK: ("", "", "", "hit_planted_impulse", "hit_stopper_impulse"),
    AMBER: (
        "duration_sls2", "duration_sls1", "duration_dls", "rear_stopper_force", "contraction",
        "landing_stopper_impulse",
    ),
}  # fmt: skip
"""Names of special points by color. The index of a name gives its line style, which is the same
in every figure. Green and pink, which color-blind readers may confuse, share no line style.
"""

NOT_COMPUTED_STYLE = ("not computed", "#FFFFFF")
"""Label and color of a sample that is not computed."""

UNSTABLE_CODE = 100
"""Code of a cycle whose spectral radius is 1 or more, chosen above all codes of `Outcome`."""


@contextmanager
def figure_style() -> Iterator[None]:
    """Apply the style of all figures within a `with` block.

    Returns:
        A context manager, which is also a decorator, with the settings of matplotlib.

    Examples:
        >>> gait = vrw.simulate(vrw.WheelParams(), vrw.paper_start(), n_steps=1)
        >>> with vrw.plot.figure_style():
        ...     figure = vrw.plot.sticks(gait)
    """
    with mpl.rc_context(MATPLOTLIB_STYLE):
        yield


def save(figure: Figure, folder: str | Path, name: str) -> list[Path]:
    """Write `figure` as SVG and PNG into `folder`, and return the paths.

    Args:
        figure: a figure of matplotlib.
        folder: folder of the files, created if it does not exist.
        name: name of the files without the suffix.

    Returns:
        list[Path]: the paths of `name`.svg and `name`.png.

    Raises:
        TypeError: if `folder` is no path.
        OSError: if a file cannot be written.

    Examples:
        >>> gait = vrw.simulate(vrw.WheelParams(), vrw.paper_start(), n_steps=1)
        >>> figure, folder = vrw.plot.sticks(gait), Path(tempfile.mkdtemp())
        >>> [path.suffix for path in vrw.plot.save(figure, folder, "sticks")]
        ['.svg', '.png']
    """
    check_type("folder", folder, (str, Path), 'give a folder, such as "figures"')
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    paths = [folder / f"{name}.svg", folder / f"{name}.png"]
    with figure_style():
        figure.savefig(paths[0], metadata={"Date": None})
        figure.savefig(paths[1], metadata={"Software": None})
    return paths


def require_variables(name: str, data: Any, needed_names: Sequence[str], advice: str) -> None:
    """Raise an error unless `data` is a dataset that contains the needed variables or
    attributes.
    """
    check_type(name, data, xr.Dataset, advice)
    missing_names = [
        variable
        for variable in needed_names
        if variable not in data.variables and variable not in data.attrs
    ]
    if missing_names:
        raise ValueError(f"{name} holds no {missing_names[0]!r}, which is to be drawn: {advice}.")


def require_variables_of_all(
    name: str, datasets: Any, needed_names: Sequence[str], advice: str
) -> None:
    """Raise an error unless `datasets` is a nonempty list of datasets that contain the needed
    variables.
    """
    check_type(name, datasets, (list, tuple), f"{advice}, several in a list")
    if not datasets:
        raise ValueError(f"{name} is empty, but something is to be drawn: {advice}.")
    for dataset_index, data in enumerate(datasets):
        require_variables(f"{name}[{dataset_index}]", data, needed_names, advice)


def typeset_symbols(text: str) -> str:
    """Return text with symbols such as "λ2⁺" as formulas, because the font lacks some of them."""
    return re.sub(r"[θλ]\S*", lambda match: f"${format_mathtext(match[0])}$", text)


def _format_unit(name: str) -> str:
    """Return the unit of a quantity as figures write it, such as "N·s/m"."""
    return MEASURES[name].display_unit.replace(" ", "·").replace("^2", "²")


def format_axis_label(name: str, label_format: str = "{name} {symbol}") -> str:
    """Return the label of a quantity with its unit, formatted by `label_format`.

    An unknown name is returned unchanged.
    """
    if name not in MEASURES:
        return name
    measure = MEASURES[name]
    text = label_format.format(
        name=typeset_symbols(measure.long_name), symbol=f"${measure.mathtext}$"
    )
    return f"{text} [{_format_unit(name)}]" if _format_unit(name) else text


def format_value_label(name: str, value: float, digits: int = 4) -> str:
    """Return the text of a quantity with its value, as in "c = 50 N·s/m"."""
    if name not in MEASURES:
        return f"{name} = {value:.{digits}g}"
    return f"${MEASURES[name].mathtext}$ = {value:.{digits}g} {_format_unit(name)}".rstrip()


def label_panel(axes: Axes, letter: str) -> None:
    """Write the letter of a panel to the left of its top."""
    axes.text(-0.12, 1.02, f"({letter})", transform=axes.transAxes, ha="right", va="bottom")


def draw_marks(
    axes: Axes,
    x: np.ndarray,
    y: np.ndarray,
    marker: str,
    color: str,
    fill_color: str,
    **style_overrides: Any,
) -> None:
    """Draw markers without a line, filled with `fill_color`; "white" makes them open."""
    marker_style: dict[str, Any] = {
        "markersize": 3.2,
        "markeredgewidth": 0.7,
        "linestyle": "none",
    } | style_overrides
    axes.plot(x, y, marker, color=color, markerfacecolor=fill_color, **marker_style)


def select_special_point_style(name: str) -> tuple[str, Any]:
    """Return color and line style of a special point; those of locked legs differ by leg."""
    for color, names in SPECIAL_POINT_NAMES_BY_COLOR.items():
        if name in names:
            return color, SPECIAL_POINT_LINE_STYLES[names.index(name)]
    leg = name.partition("[")[2]
    style_index = int(leg[:-1]) - 3 if leg else len(name)
    return SKY, SPECIAL_POINT_LINE_STYLES[style_index % len(SPECIAL_POINT_LINE_STYLES)]


def select_outcome_style(code: int) -> tuple[str, str]:
    """Return label and color of an outcome, of an unstable cycle, or of a sample that is not
    computed.
    """
    if code == UNSTABLE_CODE:
        return "unstable limit cycle", YELLOW
    return OUTCOME_STYLES[Outcome(code)] if code >= 0 else NOT_COMPUTED_STYLE


def draw_outcome_cells(
    axes: Axes,
    x: np.ndarray,
    y: np.ndarray,
    codes: np.ndarray,
    known_codes: Sequence[int] | np.ndarray,
) -> None:
    """Draw cells over (x, y) in the colors of their outcomes; codes not in `known_codes` are
    left out.
    """
    colors = ListedColormap([select_outcome_style(int(code))[1] for code in known_codes])
    code_indices = np.ma.masked_where(
        ~np.isin(codes, known_codes), np.searchsorted(known_codes, codes)
    )
    color_norm = (
        BoundaryNorm(np.arange(len(known_codes) + 1) - 0.5, len(known_codes))
        if len(known_codes) > 1
        else None
    )
    axes.pcolormesh(x, y, code_indices, cmap=colors, norm=color_norm).set_rasterized(True)


def make_outcome_patches(codes: Iterable[int]) -> list[Patch]:
    """Return the legend entries of outcomes."""
    return [
        Patch(facecolor=color, edgecolor="#888888", linewidth=0.4, label=label)
        for label, color in (select_outcome_style(int(code)) for code in codes)
    ]
