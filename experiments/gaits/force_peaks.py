"""Map the number of force peaks over stiffness and slope, at two dampings and natural lengths.

    python -m experiments.gaits.force_peaks [--redraw]

The damping ratios and natural lengths are those of the parameter sets `two_peaks` and `table_1`.
Each of the four maps has 20 x 20 wheels. Their gaits are limit cycles of the paper's model on one
mesh. For each gait the table also contains the time on one foot in periods of the damped bounce,
and the quotient of this period and the step's duration. An overdamped leg has no bounce.

The command writes `force_peaks.csv` and the figure, and fills the block of
docs/studies/one_peak_or_two.md. It takes one minute on one core.
"""

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

import vrw_jax as vrw
from experiments.shared.command import make_parser, parse_and_start_jax
from experiments.shared.tables import (
    DOCS,
    FIGURES,
    Row,
    describe_run,
    format_markdown,
    read_column,
    read_table,
    replace_block,
    write_named_rows,
)
from vrw_jax import figures as plots

MARKED_SETS = {"two_peaks": ("*", "two-peak wheel"), "table_1": ("D", "Table 1")}
"""Marker and label of the parameter sets that the maps show."""

N_PER_AXIS = 20
STIFFNESS_NUMBERS = np.geomspace(1.5, 24.0, N_PER_AXIS)
"""Stiffnesses k L0 / (M g), chosen because they cover both parameter sets."""

SLOPES = np.geomspace(0.03, 0.4, N_PER_AXIS)
"""Slopes, rad, chosen because they cover both parameter sets."""

MAP_OPTIONS = vrw.CycleOptions(mesh_intervals=(40, 32, 16))
"""One mesh for all gaits, chosen because gaits with two peaks need its resolution."""

MEASURE_NAMES = ("n_force_peaks", "peak_force", "force_trough_depth", "dls_fraction",
                 "spectral_radius", "period")  # fmt: skip
PEAK_COLORS = {0: "#56B4E9", 1: "#0072B2", 2: "#E69F00", 3: "#D55E00"}
"""Colors of Okabe and Ito by number of peaks."""

MAP_TABLE = FIGURES / "force_peaks.csv"
PAGE = DOCS / "studies/one_peak_or_two.md"


def compute_total_mass(params: vrw.WheelParams) -> float:
    """Return the mass of the wheel, kg."""
    return float(params.hub_mass + params.n_legs * params.leg_mass)


def compute_stiffness_number(params: vrw.WheelParams) -> float:
    """Return the dimensionless stiffness k L0 / (M g)."""
    weight = compute_total_mass(params) * float(params.gravity)
    return float(params.stiffness * params.locked_length) / weight


def compute_damping_ratio(params: vrw.WheelParams) -> float:
    """Return the damping ratio c / (2 sqrt(k M)) of the wheel's mass on one leg."""
    critical_damping = 2.0 * np.sqrt(float(params.stiffness) * compute_total_mass(params))
    return float(params.damping) / critical_damping


def compute_bounce_periods(stiffness: np.ndarray, ratio: np.ndarray, mass: float) -> np.ndarray:
    """Return the periods of the wheel's damped bounce on one leg, s; NaN for overdamped legs."""
    is_underdamped = ratio < 1.0
    damped_rate = np.sqrt(stiffness / mass * np.where(is_underdamped, 1.0 - ratio**2, 1.0))
    return np.where(is_underdamped, 2.0 * np.pi / damped_rate, np.nan)


def compute() -> None:
    """Search the gaits of all wheels, and write the table."""
    table_1 = vrw.WheelParams()
    marked_params = [vrw.parameter_sets[name].params for name in MARKED_SETS]
    ratios = [compute_damping_ratio(params) for params in marked_params]
    lengths = [float(params.natural_length) for params in marked_params]
    ratio, length, number, slope = (
        x.ravel() for x in np.meshgrid(ratios, lengths, STIFFNESS_NUMBERS, SLOPES, indexing="ij")
    )
    mass = compute_total_mass(table_1)
    stiffness = number / compute_stiffness_number(table_1) * float(table_1.stiffness)
    params = vrw.WheelParams(
        stiffness=stiffness,
        damping=2.0 * ratio * np.sqrt(stiffness * mass),
        natural_length=length,
        slope=slope,
    )
    gaits = vrw.limit_cycles(params, options=MAP_OPTIONS)
    measures = {name: np.asarray(x) for name, x in gaits.measures(MEASURE_NAMES).items()}
    bounce_periods = compute_bounce_periods(stiffness, ratio, mass)
    numbers = measures | {
        "bounces": np.asarray(gaits.durations)[:, 1:].sum(1) / bounce_periods,
        "bounce_to_step": bounce_periods / np.where(gaits.found, measures["period"], np.nan),
    }
    rows = []
    for i, outcome in enumerate(np.asarray(gaits.outcome)):
        row = {"damping_ratio": f"{ratio[i]:.4f}", "natural_length": f"{length[i]:g}",
               "stiffness_number": f"{number[i]:.5g}", "slope": f"{slope[i]:.5g}",
               "outcome": vrw.Outcome(int(outcome)).name}  # fmt: skip
        if outcome == vrw.Outcome.STEPPED:
            row |= {name: f"{x[i]:.4g}" for name, x in numbers.items() if np.isfinite(x[i])}
        rows.append(row)
    header = (*list(rows[0])[:5], *numbers)
    write_named_rows(MAP_TABLE, [{name: row.get(name, "") for name in header} for row in rows])


def select_gaits(rows: list[Row], panel: tuple[str, str]) -> list[Row]:
    """Return the gaits of one map, given by the text of its damping ratio and natural length."""
    return [row for row in rows if row["n_force_peaks"] and get_panel(row) == panel]


def has_whole_bounce(row: Row) -> bool:
    """Return whether single support lasts at least one period of the bounce."""
    return bool(row["bounces"]) and float(row["bounces"]) >= 1.0


def get_panel(row: Row) -> tuple[str, str]:
    """Return the damping ratio and natural length of the map to which a wheel belongs."""
    return row["damping_ratio"], row["natural_length"]


def summarize(rows: list[Row]) -> str:
    """Return a table in Markdown: one line per map and number of peaks."""
    lines = []
    for panel in dict.fromkeys(map(get_panel, rows)):
        gaits = select_gaits(rows, panel)
        for n_peaks in sorted({row["n_force_peaks"] for row in gaits}):
            group = [row for row in gaits if row["n_force_peaks"] == n_peaks]
            depth = (
                max(read_column(group, "force_trough_depth") / read_column(group, "peak_force"))
                if int(n_peaks) > 1
                else None
            )
            lines.append([
                f"{float(panel[0]):.2f}", f"{float(panel[1]):.2f}", n_peaks, len(group),
                int(np.sum(read_column(group, "spectral_radius") >= 1.0)),
                describe_range(group, "bounces"), sum(map(has_whole_bounce, group)),
                describe_range(group, "bounce_to_step"), describe_range(group, "dls_fraction"),
                "–" if depth is None else f"{depth:.1%}",
            ])  # fmt: skip
    header = ("damping ratio", "L*, m", "peaks", "gaits", "unstable", "bounces in single support",
              "gaits with a whole bounce", "bounce period / step", "DLS fraction",
              "deepest trough / peak")  # fmt: skip
    return format_markdown(header, lines)


def describe_range(rows: list[Row], name: str) -> str:
    """Return least and largest value of a column as text; a dash if its cells are empty."""
    if not rows[0][name]:
        return "–"
    values = read_column(rows, name)
    return f"{values.min():.2f} to {values.max():.2f}"


def draw() -> None:
    """Draw a map of the numbers of peaks per damping ratio and natural length."""
    rows = read_table(MAP_TABLE)
    panels = list(dict.fromkeys(map(get_panel, rows)))
    figure, axes = plt.subplots(
        2, 2, figsize=(plots.PAGE_FIGURE_WIDTH_INCHES, 5.6), sharex=True, sharey=True
    )
    for axis, panel in zip(axes.T.ravel(), panels, strict=True):
        draw_map(axis, select_gaits(rows, panel))
        axis.set_title(f"damping ratio {float(panel[0]):.2f}, $L^*$ = {float(panel[1]):.2f} m")
        for name, (marker, _) in MARKED_SETS.items():
            params = vrw.parameter_sets[name].params
            if panel == (f"{compute_damping_ratio(params):.4f}", f"{params.natural_length:g}"):
                axis.plot(float(params.slope), compute_stiffness_number(params), marker,
                          color="white", markeredgecolor="black", markersize=9)  # fmt: skip
    for axis in axes[:, 0]:
        axis.set_ylabel("stiffness $k L_0 / (M g)$")
    for axis in axes[-1]:
        axis.set_xlabel("slope $\\phi$ [rad]")
    shown_peaks = sorted({int(row["n_force_peaks"]) for row in rows if row["n_force_peaks"]})
    labels = {0: "no smooth peak", 1: "one peak", 2: "two peaks", 3: "three peaks"}
    figure.legend(
        handles=[
            Patch(color=plots.LIGHT_GRAY_COLOR, label="no gait found"),
            *(Patch(color=PEAK_COLORS[n], label=labels[n]) for n in shown_peaks),
            Line2D([], [], linestyle="none", marker=".", color="black",
                   label="at least one bounce in single support"),
            *(Line2D([], [], linestyle="none", marker=marker, color="white",
                     markeredgecolor="black", markersize=8, label=label)
              for marker, label in MARKED_SETS.values()),
        ],
        loc="outside lower center",
        ncols=4,
    )  # fmt: skip
    plots.save(figure, FIGURES, "force_peaks")


def draw_map(axis: Axes, gaits: list[Row]) -> None:
    """Draw the numbers of peaks of one map, with a dot for at least one bounce."""
    n_peaks, has_bounce = (
        np.full((N_PER_AXIS, N_PER_AXIS), np.nan),
        np.zeros((N_PER_AXIS,) * 2, bool),
    )
    for row in gaits:
        i = int(np.argmin(np.abs(STIFFNESS_NUMBERS - float(row["stiffness_number"]))))
        j = int(np.argmin(np.abs(SLOPES - float(row["slope"]))))
        n_peaks[i, j] = int(row["n_force_peaks"])
        has_bounce[i, j] = has_whole_bounce(row)
    i, j = np.nonzero(has_bounce)
    axis.plot(SLOPES[j], STIFFNESS_NUMBERS[i], ".", color="black", markersize=3)
    axis.set_facecolor(plots.LIGHT_GRAY_COLOR)
    axis.pcolormesh(SLOPES, STIFFNESS_NUMBERS, n_peaks, shading="nearest",
                    cmap=ListedColormap(list(PEAK_COLORS.values())),
                    vmin=-0.5, vmax=len(PEAK_COLORS) - 0.5, rasterized=True)  # fmt: skip
    axis.set_xscale("log")
    axis.set_yscale("log")
    axis.set_xticks([0.03, 0.05, 0.1, 0.2, 0.3], ["0.03", "0.05", "0.1", "0.2", "0.3"])
    axis.set_yticks([2, 3, 5, 10, 20], ["2", "3", "5", "10", "20"])
    axis.minorticks_off()


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument(
        "--redraw", action="store_true", help="draw the stored table without computing"
    )
    is_redrawn = parse_and_start_jax(parser).redraw
    if not is_redrawn:
        compute()
    source = None if is_redrawn else describe_run("experiments.gaits.force_peaks")
    replace_block(PAGE, "force_peaks", summarize(read_table(MAP_TABLE)), source)
    with plots.figure_style():
        draw()


if __name__ == "__main__":
    main()
