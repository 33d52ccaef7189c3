"""At c = 100 nearly every start walks; at c = 200 a fast one meets touchdown before the stopper.

Starts differ in θ̇⁻ and L̇1⁻ just before touchdown; θ⁻ is that of the gait. Writes `basin.svg` and
`.png` to `results/` or the folder given: `python experiments/basin.py [folder]`.
"""

import sys
from pathlib import Path

import jax

jax.config.update("jax_enable_x64", True)

import numpy as np  # noqa: E402  the number format is chosen first

import vrw_jax as vrw  # noqa: E402
from vrw_jax.figures import branch as branch_plots  # noqa: E402
from vrw_jax.figures import walk as plots  # noqa: E402
from vrw_jax.walks.basins import share  # noqa: E402

DAMPINGS = (100.0, 200.0)  # N s/m
RATES = np.linspace(0.4, 3.2, 57)  # rad/s
LEG_RATES = np.linspace(-1.0, 0.6, 49)  # m/s


def main(folder: Path) -> None:
    results, titles = [], []
    for damping in DAMPINGS:
        params = vrw.WheelParams(damping=damping)
        gait = vrw.limit_cycle(params)
        theta = float(gait.section_state[0])
        grid = {
            "theta_touchdown": theta, "dtheta_touchdown": RATES, "dL1_touchdown": LEG_RATES,
        }  # fmt: skip
        result = vrw.basin(params, grid, options=vrw.Options(rtol=1e-9, atol=1e-9))
        results.append(result)
        titles.append(f"$c$ = {damping:g} N·s/m, $\\theta^-$ = {theta:.4f} rad")
        print(damping, share(result), "periods", result.orbit_period.values)
    plots.save(branch_plots.basin_figure(results, titles), folder, "basin")


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "results"))
