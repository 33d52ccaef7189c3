"""Beyond λ4⁺ = 0 (c = 219.85) gaits of 6, 5, 4 ... steps attract, one landing in each without DLS.

    python -m experiments.gaits.orbit_diagram [folder] [--redraw]

Many starts at each damping are walked until they repeat or fall. Writes `orbit_diagram.svg`, `.png`
and `.csv` to `results/` or the folder given.
"""

from pathlib import Path

import numpy as np
import pandas as pd

import vrw_jax as vrw
from experiments.shared.command import command, started
from vrw_jax import figures as plots
from vrw_jax.walks.attractors import Settled, distinct, orbit_measures, settle

DAMPINGS = np.round(np.arange(215.0, 225.001, 0.1), 3)  # N s/m
N_STARTS = 12
TABLE = "orbit_diagram.csv"
MOST_STEPS, LONGEST_PERIOD = 300, 40
PREMISES = ("clearance_sls1", "clearance_sls2", "locked_stopper_force", "fore_foot_force")


def starts() -> np.ndarray:
    """Section states scattered around the gait at c = 219."""
    draw = np.random.default_rng(1).uniform
    sizes = (N_STARTS,)
    return np.stack([draw(0.0, 0.2, sizes), draw(1.3, 1.8, sizes), draw(-0.3, 0.0, sizes)], 1)


def main() -> None:
    parser = command(__doc__)
    parser.add_argument("folder", type=Path, nargs="?", default="results")
    parser.add_argument("--redraw", action="store_true", help="walk nothing: draw the table there")
    chosen = started(parser)
    if not chosen.redraw:
        compute().to_csv(made(chosen.folder) / TABLE, index=False, float_format="%.7g")
    table = pd.read_csv(chosen.folder / TABLE)
    points = table.to_xarray().assign_attrs(parameter="damping", tried=DAMPINGS.tolist())
    border = vrw.continue_branch(vrw.WheelParams(), "damping", (190.0, 230.0)).borders[-1]
    plots.save(plots.orbit_figure(points, border.value), chosen.folder, "orbit_diagram")


def made(folder: Path) -> Path:
    """The folder, there at the latest now."""
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def compute() -> pd.DataFrame:
    """Every step of every orbit that attracts, at each damping."""
    model = vrw.ViscoelasticWheel(stop_at_lift_off=False)  # λ2 < 0 is told, not a fall
    options = vrw.Options(rtol=1e-9, atol=1e-9)
    dampings = np.repeat(DAMPINGS, N_STARTS)
    walked = settle(
        vrw.WheelParams(damping=dampings),
        np.tile(starts(), (len(DAMPINGS), 1)),
        model,
        options,
        MOST_STEPS,
        LONGEST_PERIOD,
    )
    rows = []
    for damping in DAMPINGS:
        here = Settled(*(part[dampings == damping] for part in walked))
        fell = [vrw.Outcome(int(c)).name for c in here.outcome if c != vrw.Outcome.STEPPED]
        orbits = distinct(here)
        for index, orbit in enumerate(orbits.orbits):
            told = orbit_measures(vrw.WheelParams(damping=damping), orbit, model, options)
            for k in range(len(orbit)):
                broken = [name for name in PREMISES if told[name][k].min() < 0.0]
                rows.append(
                    {
                        "damping": damping,
                        "orbit": index,
                        "period": len(orbit),
                        "step": k,
                        "theta_post_impact": told["theta_post_impact"][k],
                        "dtheta_post_impact": told["dtheta_post_impact"][k],
                        "duration_dls": told["duration_dls"][k],
                        "lambda_4_plus": told["lambda_4_plus"][k],
                        "clearance": min(told[name][k] for name in PREMISES[:2]),
                        "broken": " ".join(broken),
                        "share_of_starts": np.mean(orbits.of_start == index),
                    }
                )
        print(damping, sorted({len(o) for o in orbits.orbits}), {n: fell.count(n) for n in fell})
    return pd.DataFrame(rows)


if __name__ == "__main__":
    main()
