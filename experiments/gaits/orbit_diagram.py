"""Draw the periodic orbits of the wheel beyond λ4⁺ = 0 (c = 219.85) over the damping.

    python -m experiments.gaits.orbit_diagram [folder] [--redraw]

Many starts at each damping walk until their steps repeat or the wheel falls. Beyond the special
point attracting orbits have 6, 5, 4 ... steps, and one step of each has no DLS. The command writes
`orbit_diagram.svg`, `.png` and `.csv` to `results/` or the given folder.
"""

from pathlib import Path

import numpy as np
import pandas as pd
import xarray as xr
from matplotlib.figure import Figure

import vrw_jax as vrw
from experiments.shared.command import make_parser, parse_and_start_jax
from vrw_jax import plot as plots
from vrw_jax.app._gait_figures import BRANCH_END_COLOR, SPECIAL_POINT_LINE_STYLE
from vrw_jax.gaits.gait_walks import (
    PeriodicWalkEnds,
    find_distinct_orbits,
    measure_orbit_steps,
    walk_until_periodic,
)

DAMPINGS = np.round(np.arange(215.0, 225.001, 0.1), 3)  # N s/m
N_STARTS = 12
TABLE = "orbit_diagram.csv"
MAX_STEPS, MAX_PERIOD = 300, 40
MARGIN_NAMES = ("clearance_sls1", "clearance_sls2", "locked_stopper_force", "fore_foot_force")


def draw_starts() -> np.ndarray:
    """Return random section states around the gait at c = 219."""
    draw = np.random.default_rng(1).uniform
    sizes = (N_STARTS,)
    return np.stack([draw(0.0, 0.2, sizes), draw(1.3, 1.8, sizes), draw(-0.3, 0.0, sizes)], 1)


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument("folder", type=Path, nargs="?", default="results")
    parser.add_argument(
        "--redraw", action="store_true", help="draw the stored table without walking"
    )
    arguments = parse_and_start_jax(parser)
    if not arguments.redraw:
        compute().to_csv(create_folder(arguments.folder) / TABLE, index=False, float_format="%.7g")
    table = pd.read_csv(arguments.folder / TABLE)
    special_point = vrw.continue_branch(
        vrw.WheelParams(), "damping", (190.0, 230.0)
    ).special_points[-1]
    figure = make_orbit_figure(table.to_xarray(), special_point.value)
    plots.save(figure, arguments.folder, "orbit_diagram")


@plots.figure_style()
def make_orbit_figure(orbits: xr.Dataset, special_point_damping: float) -> Figure:
    """Return the figure: rates after landing and periods of all attracting orbits over the damping.

    An open symbol is a step in which the foot scuffs, and a cross is a step without double support.
    `special_point_damping` is the damping at which λ4⁺ vanishes.
    """
    value = orbits.damping.values
    lifts, scuffs = orbits.duration_dls.values == 0.0, orbits.clearance.values < 0.0
    figure = Figure(figsize=(plots.PAGE_FIGURE_WIDTH_INCHES, 3.9))
    rates, periods = figure.subplots(2, 1, sharex=True, height_ratios=[2.2, 1.0])
    groups = (
        (~lifts & ~scuffs, "o", plots.LEG_1_COLOR, plots.LEG_1_COLOR, "with DLS"),
        (~lifts & scuffs, "o", plots.LEG_1_COLOR, "white", "with DLS, foot 2 scuffs"),
        (
            lifts,
            "x",
            plots.LEG_2_COLOR,
            plots.LEG_2_COLOR,
            "rear foot lifts at once ($\\lambda_4^+ < 0$)",
        ),
        (lifts & scuffs, "o", plots.LEG_2_COLOR, "none", "the same, foot 2 scuffs"),
    )
    for is_in_group, marker, colour, fill, text in groups:
        if is_in_group.any():
            size = 2.4 if marker == "o" else 3.4
            x, y = value[is_in_group], orbits.dtheta_post_impact.values[is_in_group]
            plots.style.draw_markers(rates, x, y, marker, colour, fill, markersize=size, label=text)
    periods.plot(value, orbits.period.values, "s", color="black", markersize=2.0)
    for axes in (rates, periods):
        axes.axvline(
            special_point_damping,
            color=BRANCH_END_COLOR,
            linewidth=0.7,
            linestyle=SPECIAL_POINT_LINE_STYLE,
            zorder=0,
        )
        for left, right in _find_empty_intervals(orbits):
            axes.axvspan(left, right, color=plots.LIGHT_GRAY_COLOR, linewidth=0.0, zorder=0)
    for left, right in _find_empty_intervals(orbits)[-1:]:
        rates.text(0.5 * (left + right), 0.5, "falls", rotation=90, ha="center", va="center",
                   transform=rates.get_xaxis_transform(), color=plots.DARK_GRAY_COLOR)  # fmt: skip
    rates.text(special_point_damping, 0.4, " $\\lambda_4^+ = 0$", color=BRANCH_END_COLOR,
               transform=rates.get_xaxis_transform())  # fmt: skip
    rates.set_ylabel("rate after landing, $\\dot\\theta^+$ [rad/s]")
    rates.legend(loc="lower left", fontsize=7.5)
    periods.set_ylabel("period [steps]")
    periods.set_ylim(0.0, 1.0 + float(orbits.period.max()))
    periods.yaxis.get_major_locator().set_params(integer=True)
    periods.set_xlabel(plots.style.format_axis_label("damping"))
    return figure


def _find_empty_intervals(orbits: xr.Dataset) -> list[tuple[float, float]]:
    """Return the intervals of damping in which no start reaches an orbit."""
    empty = ~np.isin(DAMPINGS, orbits.damping.values)
    half = 0.5 * (DAMPINGS[1] - DAMPINGS[0])
    cuts = np.flatnonzero(np.diff(empty.astype(int))) + 1
    parts = [part for part in np.split(np.arange(len(DAMPINGS)), cuts) if empty[part[0]]]
    return [(DAMPINGS[part[0]] - half, DAMPINGS[part[-1]] + half) for part in parts]


def create_folder(folder: Path) -> Path:
    """Create the folder if necessary, and return it."""
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def compute() -> pd.DataFrame:
    """Return every step of every attracting orbit at each damping."""
    # A negative λ2 is reported, and does not end the step.
    model = vrw.ViscoelasticWheel(stop_at_lift_off=False)
    options = vrw.StepOptions(rtol=1e-9, atol=1e-9)
    dampings = np.repeat(DAMPINGS, N_STARTS)
    walk_result = walk_until_periodic(
        vrw.WheelParams(damping=dampings),
        np.tile(draw_starts(), (len(DAMPINGS), 1)),
        model,
        options,
        MAX_STEPS,
        MAX_PERIOD,
    )
    rows = []
    for damping in DAMPINGS:
        walk_ends = PeriodicWalkEnds(*(part[dampings == damping] for part in walk_result))
        failures = [vrw.Outcome(int(c)).name for c in walk_ends.outcome if c != vrw.Outcome.STEPPED]
        orbit_indices, orbits = find_distinct_orbits(walk_ends)
        for index, orbit in enumerate(orbits):
            measured_orbit = measure_orbit_steps(
                vrw.WheelParams(damping=damping), orbit, model, options
            )
            for k in range(len(orbit)):
                negative_margins = [
                    name for name in MARGIN_NAMES if measured_orbit[name][k].min() < 0.0
                ]
                rows.append(
                    {
                        "damping": damping,
                        "orbit": index,
                        "period": len(orbit),
                        "step": k,
                        "theta_post_impact": measured_orbit["theta_post_impact"][k],
                        "dtheta_post_impact": measured_orbit["dtheta_post_impact"][k],
                        "duration_dls": measured_orbit["duration_dls"][k],
                        "lambda_4_plus": measured_orbit["lambda_4_plus"][k],
                        "clearance": min(measured_orbit[name][k] for name in MARGIN_NAMES[:2]),
                        "broken": " ".join(negative_margins),
                        "share_of_starts": np.mean(orbit_indices == index),
                    }
                )
        print(
            damping,
            sorted({len(o) for o in orbits}),
            {n: failures.count(n) for n in failures},
        )
    return pd.DataFrame(rows)


if __name__ == "__main__":
    main()
