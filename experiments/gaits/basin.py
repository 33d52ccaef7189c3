"""Draw the basin of attraction of the gait at two dampings.

    python -m experiments.gaits.basin [folder]

Starts differ in θ̇⁻ and L̇1⁻ just before touchdown, and have the θ⁻ of the gait. At c = 100 nearly
every start leads to walking. At c = 200 a fast start touches down before Leg 2 meets its stopper.
The command writes `basin.svg` and `.png` to `results/` or the given folder.
"""

import numpy as np
import xarray as xr

import vrw_jax as vrw
from experiments.shared.command import parse_folder_and_start_jax
from vrw_jax import plot as plots

DAMPINGS = (100.0, 200.0)  # N s/m
ANGULAR_RATES = np.linspace(0.4, 3.2, 57)  # rad/s
LEG_RATES = np.linspace(-1.0, 0.6, 49)  # m/s


def main() -> None:
    folder = parse_folder_and_start_jax(__doc__)
    results, titles = [], []
    for damping in DAMPINGS:
        params = vrw.WheelParams(damping=damping)
        gait = vrw.limit_cycle(params)
        theta = float(gait.section_state[0])
        grid = {
            "theta_touchdown": theta, "dtheta_touchdown": ANGULAR_RATES, "dL1_touchdown": LEG_RATES,
        }  # fmt: skip
        basin_result = vrw.basin(params, grid, options=vrw.StepOptions(rtol=1e-9, atol=1e-9))
        results.append(basin_result)
        title_parts = (
            plots.style.format_value_label("damping", damping),
            plots.style.format_value_label("theta_touchdown", theta),
        )
        titles.append(", ".join(title_parts))
        print(
            damping,
            compute_walk_end_fractions(basin_result),
            "periods",
            basin_result.orbit_period.values,
        )
    plots.save(plots.basin_figure(results, titles), folder, "basin")


def compute_walk_end_fractions(basin_dataset: xr.Dataset) -> dict[str, float]:
    """Return the fraction of starts for each end of a walk, by the name of the end.

    The names are "attractor 0", "attractor 1" and so on, "unsettled", and the names of outcomes.
    """
    attractor_indices = basin_dataset.attractor.values.ravel()
    outcome_codes = basin_dataset.outcome.values.ravel()
    walk_end_names = [
        f"attractor {attractor_code}"
        if attractor_code >= 0
        else (
            "unsettled"
            if outcome_code == vrw.Outcome.STEPPED
            else vrw.Outcome(int(outcome_code)).name
        )
        for attractor_code, outcome_code in zip(attractor_indices, outcome_codes, strict=True)
    ]
    return {
        walk_end_name: walk_end_names.count(walk_end_name) / len(walk_end_names)
        for walk_end_name in sorted(set(walk_end_names))
    }


if __name__ == "__main__":
    main()
