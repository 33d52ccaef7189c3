"""Count the force peaks of gaits over stiffness, slope, damping, leg mass and friction.

    python -m experiments.gaits.force_peaks [--only PART ...] [--redraw]

The maps cover stiffness and slope, at the damping ratios and natural lengths of the parameter sets
`two_peaks` and `table_1`. Each of the four maps has 20 x 20 wheels, whose gaits are limit cycles of
the paper's model on one mesh. For each gait the table also contains the times of its peaks in
periods of the damped bounce on one leg. An overdamped leg has no bounce.

The parts are `maps` and those of `force_peak_borders`, `force_peak_comparisons` and
`force_peak_stances`. The command writes their tables and three figures, and fills the blocks of
docs/studies/one_peak_or_two.md. It takes four minutes on one core, or six with compilation.
"""

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

import vrw_jax as vrw
from experiments.gaits.force_peak_borders import (
    BISECTION_TABLE,
    MAP_TABLE,
    compute_borders,
)
from experiments.gaits.force_peak_comparisons import (
    CONTACT_TABLE,
    DAMPING_TABLE,
    LEG_MASS_TABLE,
    compute_comparisons,
)
from experiments.gaits.force_peak_figures import (
    PEAK_COLORS,
    PEAK_LABELS,
    SLOPE_LABEL,
    STIFFNESS_LABEL,
    count_separated_peaks,
    draw_causes,
    draw_comparisons,
    draw_peak_map,
    format_log_axes,
)
from experiments.gaits.force_peak_stances import compute_stances
from experiments.gaits.force_peak_wheels import (
    GAIT_OPTIONS,
    compute_bounce_periods,
    compute_damping_ratio,
    compute_peak_times,
    compute_stiffness_number,
    make_wheels,
    select_wheel,
)
from experiments.shared.command import make_parser, parse_and_start_jax
from experiments.shared.tables import (
    DOCS,
    FIGURES,
    Row,
    describe_run,
    format_markdown,
    group_rows,
    read_column,
    read_table,
    replace_block,
    write_named_rows,
)
from vrw_jax import plot as plots

MARKED_SETS = {"two_peaks": ("*", "two-peak wheel"), "table_1": ("D", "Table 1")}
"""Marker and label of the parameter sets that the maps show."""

N_PER_AXIS = 20
STIFFNESS_NUMBERS = np.geomspace(1.5, 24.0, N_PER_AXIS)
"""Stiffnesses k L0 / (M g), chosen because they cover both parameter sets."""

SLOPES = np.geomspace(0.03, 0.4, N_PER_AXIS)
"""Slopes, rad, chosen because they cover both parameter sets."""

LEAST_RELATIVE_TROUGH = 1e-3
"""Depth of a trough over the peak force, chosen because bisection leaves less if both vanish."""

MEASURE_NAMES = ("n_force_peaks", "smooth_peak_force", "force_trough_depth", "dls_fraction",
                 "spectral_radius", "period")  # fmt: skip
BOUNCE_COLUMNS = ("bounces", "step_bounces", "first_peak_to_touchdown", "peak_distance")
"""Durations in periods of the bounce: of single support, of the step, from the first peak to the
next touchdown, and from the first peak to the second."""

PAGE = DOCS / "studies/one_peak_or_two.md"


def compute_maps() -> None:
    """Search the gaits of all wheels, and write the table."""
    marked_params = [vrw.parameter_sets[name].params for name in MARKED_SETS]
    ratios = [compute_damping_ratio(params) for params in marked_params]
    lengths = [float(params.natural_length) for params in marked_params]
    ratio, length, number, slope = (
        x.ravel() for x in np.meshgrid(ratios, lengths, STIFFNESS_NUMBERS, SLOPES, indexing="ij")
    )
    params = make_wheels(number, ratio, slope, length)
    gaits = vrw.limit_cycles(params, options=GAIT_OPTIONS)
    measures = {name: np.asarray(x) for name, x in gaits.measures(MEASURE_NAMES).items()}
    bounce_periods = compute_bounce_periods(params)
    single_support = np.asarray(gaits.durations)[:, 1:].sum(1)
    rows = []
    for i, outcome in enumerate(np.asarray(gaits.outcome)):
        row = {"damping_ratio": f"{ratio[i]:.4f}", "natural_length": f"{length[i]:g}",
               "stiffness_number": f"{number[i]:.5g}", "slope": f"{slope[i]:.5g}",
               "outcome": vrw.Outcome(int(outcome)).name}  # fmt: skip
        if outcome == vrw.Outcome.STEPPED:
            row |= {name: f"{x[i]:.4g}" for name, x in measures.items()}
            if np.isfinite(bounce_periods[i]):
                durations = {"bounces": single_support[i], "step_bounces": measures["period"][i]}
                row |= {name: f"{x / bounce_periods[i]:.4g}" for name, x in durations.items()}
                wheel, state = select_wheel(params, i), np.asarray(gaits.section_state[i])
                times = compute_peak_times(wheel, state)._asdict()
                row |= {name: f"{x:.4g}" for name, x in times.items() if np.isfinite(x)}
        rows.append(row)
    header = (*list(rows[0])[:5], *MEASURE_NAMES, *BOUNCE_COLUMNS)
    write_named_rows(MAP_TABLE, [{name: row.get(name, "") for name in header} for row in rows])


def get_panel(row: Row) -> tuple[str, str]:
    """Return the damping ratio and natural length of the map to which a wheel belongs."""
    return row["damping_ratio"], row["natural_length"]


def summarize_maps(rows: list[Row]) -> str:
    """Return a table in Markdown: one line per damping ratio and number of peaks."""
    lines = []
    for damping_ratio, wheels in group_rows(rows, "damping_ratio").items():
        for n_peaks in sorted({row["n_force_peaks"] for row in wheels if row["n_force_peaks"]}):
            group = [row for row in wheels if row["n_force_peaks"] == n_peaks]
            depth = (
                max(
                    read_column(group, "force_trough_depth")
                    / read_column(group, "smooth_peak_force")
                )
                if int(n_peaks) > 1
                else None
            )
            lines.append([
                f"{float(damping_ratio):.2f}", n_peaks, len(group),
                *(describe_range(group, name) for name in ("first_peak_to_touchdown",
                  "dls_fraction")),
                "–" if depth is None else f"{depth:.1%}",
            ])  # fmt: skip
    header = ("damping ratio", "peaks", "gaits", "first peak to touchdown", "DLS fraction",
              "deepest trough / peak")  # fmt: skip
    return format_markdown(header, lines)


def summarize_comparisons() -> str:
    """Return a table in Markdown: numbers of gaits by number of peaks, one line per map."""
    contact_maps = group_rows(read_table(CONTACT_TABLE), "map")
    groups = (
        ("over damping and stiffness, the paper's model", read_table(DAMPING_TABLE)),
        ("over leg mass and stiffness, the paper's model",
         read_table(LEG_MASS_TABLE)),
        ("over slope and stiffness, unilateral contact", contact_maps["stiffness"]),
        ("over slope and friction, unilateral contact", contact_maps["friction"]),
    )  # fmt: skip
    lines = []
    for label, rows in groups:
        gaits = [row for row in rows if row["n_force_peaks"]]
        n_peaks = np.array([count_separated_peaks(row) for row in gaits])
        lines.append([
            label, len(gaits), *(int(np.sum(n_peaks == n)) for n in range(2)),
            int(np.sum(n_peaks > 1)),
        ])  # fmt: skip
    header = ("map", "gaits", "no peak", "one peak", "two or more with a trough")
    return format_markdown(header, lines)


def select_borders(natural_length: str) -> list[Row]:
    """Return the bisected wheels with this natural length, m."""
    return [row for row in read_table(BISECTION_TABLE) if row["natural_length"] == natural_length]


def is_cut_off(row: Row) -> bool:
    """Return whether the second peak of a border is lost at a touchdown, with a deep trough."""
    return float(row["trough_to_peak"]) > LEAST_RELATIVE_TROUGH


def describe_range(rows: list[Row], name: str) -> str:
    """Return least and largest value of a column as text; a dash if it is empty."""
    rows = [row for row in rows if row[name]]
    if not rows:
        return "–"
    values = read_column(rows, name)
    return f"{values.min():.3g} to {values.max():.3g}"


def draw_maps() -> None:
    """Draw a map of the numbers of peaks per damping ratio and natural length, with the border."""
    rows = read_table(MAP_TABLE)
    panels = list(dict.fromkeys(map(get_panel, rows)))
    figure, axes = plt.subplots(
        2, 2, figsize=(plots.PAGE_FIGURE_WIDTH_INCHES, 5.6), sharex=True, sharey=True
    )
    for axis, panel in zip(axes.T.ravel(), panels, strict=True):
        draw_peak_map(axis, [row for row in rows if get_panel(row) == panel],
                      "slope", "stiffness_number", max(PEAK_COLORS))  # fmt: skip
        format_log_axes(axis, [0.03, 0.05, 0.1, 0.2, 0.3], [2, 3, 5, 10, 20])
        axis.set_title(f"damping ratio {float(panel[0]):.2f}, $L^*$ = {float(panel[1]):.2f} m")
        if float(panel[0]) < 1.0:
            borders = select_borders(panel[1])
            for fill, group in (
                ("black", [row for row in borders if not is_cut_off(row)]),
                ("white", [row for row in borders if is_cut_off(row)]),
            ):
                axis.plot(read_column(group, "slope"), read_column(group, "stiffness_number"),
                          "o-", color="black", markerfacecolor=fill, markersize=4)  # fmt: skip
        for name, (marker, _) in MARKED_SETS.items():
            params = vrw.parameter_sets[name].params
            if panel == (f"{compute_damping_ratio(params):.4f}", f"{params.natural_length:g}"):
                axis.plot(float(params.slope), compute_stiffness_number(params), marker,
                          color="white", markeredgecolor="black", markersize=9)  # fmt: skip
    for axis in axes[:, 0]:
        axis.set_ylabel(STIFFNESS_LABEL)
    for axis in axes[-1]:
        axis.set_xlabel(SLOPE_LABEL)
    shown_peaks = sorted({int(row["n_force_peaks"]) for row in rows if row["n_force_peaks"]})
    figure.legend(
        handles=[
            Patch(color=plots.LIGHT_GRAY_COLOR, label="no gait found"),
            *(Patch(color=PEAK_COLORS[n], label=PEAK_LABELS[n]) for n in shown_peaks),
            Line2D([], [], color="black", marker="o", markersize=4,
                   label="border: second peak meets trough"),
            Line2D([], [], color="black", marker="o", markersize=4, markerfacecolor="white",
                   label="border: touchdown at second peak"),
            *(Line2D([], [], linestyle="none", marker=marker, color="white",
                     markeredgecolor="black", markersize=8, label=label)
              for marker, label in MARKED_SETS.values()),
        ],
        loc="outside lower center",
        ncols=4,
    )  # fmt: skip
    plots.save(figure, FIGURES, "force_peaks")


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument("--only", nargs="+", choices=PARTS, default=list(PARTS), metavar="PART",
                        help="compute these parts alone: " + ", ".join(PARTS))  # fmt: skip
    parser.add_argument("--redraw", action="store_true", help="draw stored tables alone")
    arguments = parse_and_start_jax(parser)
    computed_parts = [] if arguments.redraw else arguments.only
    for part in computed_parts:
        PARTS[part]()
    run = describe_run("experiments.gaits.force_peaks")
    blocks = {
        "force_peaks": ("maps", summarize_maps(read_table(MAP_TABLE))),
        "force_peak_comparisons": ("comparisons", summarize_comparisons()),
    }
    for block, (part, text) in blocks.items():
        replace_block(PAGE, block, text, run if part in computed_parts else None)
    with plots.figure_style():
        draw_maps()
        draw_causes(read_table(MAP_TABLE))
        draw_comparisons()


PARTS = {
    "maps": compute_maps,
    "borders": compute_borders,
    "comparisons": compute_comparisons,
    "stances": compute_stances,
}
"""Functions that compute the tables, by the name of a part."""


if __name__ == "__main__":
    main()
