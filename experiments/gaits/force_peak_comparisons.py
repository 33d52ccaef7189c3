"""Count force peaks over damping and leg mass, and with unilateral contact.

    python -m experiments.gaits.force_peak_comparisons

All wheels have L* = L0. Except in the map over damping, they have the damping ratio of the
parameter set `two_peaks`. The command writes `force_peak_damping.csv`, `force_peak_leg_mass.csv`
and `force_peak_contact.csv`.
"""

import numpy as np

import vrw_jax as vrw
from experiments.gaits.force_peak_wheels import (
    GAIT_OPTIONS,
    LIGHT_DAMPING,
    make_wheels,
    select_wheel,
)
from experiments.shared.command import make_parser, parse_and_start_jax
from experiments.shared.tables import FIGURES, write_named_rows

LEG_MASS_TABLE = FIGURES / "force_peak_leg_mass.csv"
DAMPING_TABLE = FIGURES / "force_peak_damping.csv"
CONTACT_TABLE = FIGURES / "force_peak_contact.csv"

N_PER_AXIS = 12
STIFFNESS_NUMBERS = np.geomspace(3.0, 24.0, N_PER_AXIS)
SLOPES = np.geomspace(0.03, 0.2, N_PER_AXIS)
LEG_SHARES = np.linspace(0.05, 0.75, N_PER_AXIS)
"""Masses of all legs as fractions of the mass of the wheel; that of Table 1 is 0.44."""

DAMPING_RATIOS = np.linspace(0.05, 1.15, N_PER_AXIS)
"""Damping ratios, chosen because they cover the parameter sets `two_peaks` and `table_1`."""

MAP_SLOPE = 0.075  # rad, that of the parameter set `two_peaks`
FRICTIONS = np.geomspace(0.2, 3.0, N_PER_AXIS)
MAP_FRICTION = 0.8
FRICTION_STIFFNESS_NUMBER = 14.0


def compute_leg_masses() -> None:
    """Search gaits over stiffness and leg mass at one slope, and write their force peaks."""
    number, share = (x.ravel() for x in np.meshgrid(STIFFNESS_NUMBERS, LEG_SHARES, indexing="ij"))
    params = make_wheels(number, LIGHT_DAMPING, MAP_SLOPE, leg_share=share)
    write_named_rows(LEG_MASS_TABLE, make_lines(params, number, "leg_share", share))


def compute_dampings() -> None:
    """Search gaits over stiffness and damping ratio at one slope, and write their force peaks."""
    number, ratio = (
        x.ravel() for x in np.meshgrid(STIFFNESS_NUMBERS, DAMPING_RATIOS, indexing="ij")
    )
    params = make_wheels(number, ratio, MAP_SLOPE)
    write_named_rows(DAMPING_TABLE, make_lines(params, number, "damping_ratio", ratio))


def make_lines(
    params: vrw.WheelParams, stiffness_number: np.ndarray, varied: str, values: np.ndarray
) -> list[dict[str, str]]:
    """Return the table lines of wheels that differ in stiffness and in `varied`."""
    gaits = vrw.limit_cycles(params, options=GAIT_OPTIONS)
    names = ("n_force_peaks", "force_trough_depth", "dls_fraction")
    measures = {name: np.asarray(value) for name, value in gaits.measures(names).items()}
    lines = []
    for i, found in enumerate(np.asarray(gaits.found)):
        line = {"stiffness_number": f"{stiffness_number[i]:.5g}", varied: f"{values[i]:.5g}"}
        lines.append(line | {k: f"{x[i]:.4g}" if found else "" for k, x in measures.items()})
    return lines


CONTACT_MAPS = {
    "stiffness": (STIFFNESS_NUMBERS, np.array([MAP_FRICTION])),
    "friction": (np.array([FRICTION_STIFFNESS_NUMBER]), FRICTIONS),
}
"""Stiffnesses and friction coefficients of the maps with unilateral contact."""


def compute_contact() -> None:
    """Search gaits with unilateral contact over stiffness, friction and slope, and write a table.

    Only a trough between two smooth peaks distinguishes them from peaks that an event separates.
    """
    rows = []
    for map_name, (stiffness_numbers, frictions) in CONTACT_MAPS.items():
        number, slope = (x.ravel() for x in np.meshgrid(stiffness_numbers, SLOPES, indexing="ij"))
        for friction in frictions:
            rows += compute_contact_gaits(map_name, number, slope, friction)
    write_named_rows(CONTACT_TABLE, rows)


def compute_contact_gaits(
    map_name: str, number: np.ndarray, slope: np.ndarray, friction: float
) -> list[dict[str, str]]:
    """Return the table lines of wheels with one friction coefficient."""
    params = make_wheels(number, LIGHT_DAMPING, slope)
    model = vrw.UnilateralWheel(friction=friction)
    gaits = vrw.limit_cycles(params, model=model)
    rows = []
    for i, found in enumerate(np.asarray(gaits.found)):
        row = {"map": map_name, "stiffness_number": f"{number[i]:.5g}", "slope": f"{slope[i]:.5g}",
               "friction": f"{friction:.5g}", "n_force_peaks": "", "force_trough_depth": "",
               "dls_fraction": ""}  # fmt: skip
        if found:
            walk = vrw.simulate(
                select_wheel(params, i), gaits.section_state[i], n_steps=1, model=model
            )
            peaks = vrw.force_peaks(walk)
            row |= {"n_force_peaks": f"{peaks.n_force_peaks.item():d}",
                    "force_trough_depth": f"{peaks.force_trough_depth.item():.4g}",
                    "dls_fraction": f"{float(gaits.dls_fraction[i]):.4g}"}  # fmt: skip
        rows.append(row)
    return rows


def compute_comparisons() -> None:
    """Compute all tables."""
    compute_leg_masses()
    compute_dampings()
    compute_contact()


def main() -> None:
    parse_and_start_jax(make_parser(__doc__))
    compute_comparisons()


if __name__ == "__main__":
    main()
