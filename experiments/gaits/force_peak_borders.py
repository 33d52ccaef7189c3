"""Compute the borders between wheels with one force peak and wheels with two.

    python -m experiments.gaits.force_peak_borders

The gait loses its second peak in two ways. Its maximum and the minimum before it meet, or the next
touchdown comes before the maximum. `vrw.continue_special_point` continues wheels of the first kind.
Stiffness, mass and length of a wheel are constant on this curve, and gravity varies, so that the
damping ratio is constant. Bisection of the slope finds both kinds, between neighboring gaits of the
maps of `experiments.gaits.force_peaks`. The command writes `force_peak_curve.csv` and
`force_peak_bisections.csv`. It takes two minutes on one core.
"""

import itertools

import numpy as np

import vrw_jax as vrw
from experiments.gaits.force_peak_wheels import (
    GAIT_OPTIONS,
    LIGHT_DAMPING,
    compute_peak_times,
    compute_stiffness_number,
    make_wheels,
    select_wheel,
)
from experiments.shared.command import make_parser, parse_and_start_jax
from experiments.shared.tables import FIGURES, Row, read_column, read_table, write_named_rows

MAP_TABLE = FIGURES / "force_peaks.csv"
CURVE_TABLE = FIGURES / "force_peak_curve.csv"
BISECTION_TABLE = FIGURES / "force_peak_bisections.csv"
STIFFNESS_NUMBER_RANGE = (7.0, 13.0)
SLOPE_RANGE = (0.07, 0.1)
"""Ranges of the curve, rad, chosen because its special points there are of the first kind."""

N_BISECTIONS = 24
"""Number of halvings, chosen because slopes are then accurate to 1e-9 rad."""

CURVE_START = {"stiffness_number": 10.0, "damping_ratio": LIGHT_DAMPING, "slope": 0.08}
"""Arguments of `make_wheels` for a wheel with two peaks near which the curve starts."""


def compute_curve() -> None:
    """Continue the border over slope and stiffness, and write its points."""
    params = make_wheels(**CURVE_START)
    gait = vrw.limit_cycle(params, options=GAIT_OPTIONS)
    gravity_at_one = float(params.gravity) * compute_stiffness_number(params)
    least_gravity, largest_gravity = sorted(gravity_at_one / x for x in STIFFNESS_NUMBER_RANGE)
    curve = vrw.continue_special_point(
        "second_peak_rate",
        ("slope", "gravity"),
        gait,
        bounds={"slope": SLOPE_RANGE, "gravity": (least_gravity, largest_gravity)},
    )
    print(*curve.ends, *curve.codim2_points, sep="\n", flush=True)
    lines = [
        {
            "slope": f"{slope:.9g}",
            "stiffness_number": f"{gravity_at_one / gravity:.9g}",
            "spectral_radius": f"{radius:.4g}",
        }
        for (slope, gravity), radius in zip(
            np.asarray(curve.values), np.asarray(curve.dataset.spectral_radius), strict=True
        )
    ]
    write_named_rows(CURVE_TABLE, lines)


def find_brackets() -> list[tuple[Row, Row]]:
    """Return neighboring gaits of the maps along the slope, with two peaks and with one.

    Overdamped legs are omitted.
    """
    rows = [row for row in read_table(MAP_TABLE) if float(row["damping_ratio"]) < 1.0]
    brackets = []
    for pair in itertools.pairwise(rows):
        by_number = {row["n_force_peaks"]: row for row in pair}
        is_same_wheel = pair[0]["stiffness_number"] == pair[1]["stiffness_number"]
        if is_same_wheel and set(by_number) == {"1", "2"}:
            brackets.append((by_number["2"], by_number["1"]))
    return brackets


def bisect_borders() -> None:
    """Bisect the slope between gaits with two peaks and with one, and write the borders."""
    two_peak_rows, one_peak_rows = zip(*find_brackets(), strict=True)
    number, natural_length = (
        read_column(two_peak_rows, name) for name in ("stiffness_number", "natural_length")
    )
    two_peak_slope, one_peak_slope = (
        read_column(rows, "slope") for rows in (two_peak_rows, one_peak_rows)
    )
    is_found = np.ones(len(number), bool)
    for _ in range(N_BISECTIONS):
        slope = 0.5 * (two_peak_slope + one_peak_slope)
        params = make_wheels(number, LIGHT_DAMPING, slope, natural_length)
        gaits = vrw.limit_cycles(params, options=GAIT_OPTIONS)
        is_found &= np.asarray(gaits.found)
        has_two_peaks = np.asarray(gaits.measures(["n_force_peaks"])["n_force_peaks"]) >= 2
        two_peak_slope = np.where(has_two_peaks, slope, two_peak_slope)
        one_peak_slope = np.where(has_two_peaks, one_peak_slope, slope)
    params = make_wheels(number, LIGHT_DAMPING, two_peak_slope, natural_length)
    gaits = vrw.limit_cycles(params, options=GAIT_OPTIONS)
    measures = gaits.measures(["force_trough_depth", "smooth_peak_force", "dls_fraction"])
    depth, peak_force, dls_fraction = (np.asarray(x) for x in measures.values())
    lines = []
    for i in np.flatnonzero(is_found & np.asarray(gaits.found)):
        times = compute_peak_times(select_wheel(params, i), np.asarray(gaits.section_state[i]))
        lines.append({
            "natural_length": f"{natural_length[i]:g}",
            "stiffness_number": f"{number[i]:.5g}",
            "slope": f"{two_peak_slope[i]:.9g}",
            "first_peak_to_touchdown": f"{times.first_peak_to_touchdown:.4g}",
            "trough_to_peak": f"{depth[i] / peak_force[i]:.4g}",
            "dls_fraction": f"{dls_fraction[i]:.4g}",
        })  # fmt: skip
    write_named_rows(BISECTION_TABLE, lines)


def compute_borders() -> None:
    """Compute both tables."""
    compute_curve()
    bisect_borders()


def main() -> None:
    parse_and_start_jax(make_parser(__doc__))
    compute_borders()


if __name__ == "__main__":
    main()
