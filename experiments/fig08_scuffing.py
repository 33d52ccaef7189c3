"""Foot 2 scuffs in SLS-I where the damping is small (c = 50, and barely at 100), not at 200.

Writes `fig08_scuffing.svg` and `.png` to `results/` or the folder given:
`python experiments/fig08_scuffing.py [folder]`.
"""

import sys
from pathlib import Path

import jax

jax.config.update("jax_enable_x64", True)

from vrw_jax.figures import walk as plots  # noqa: E402  the number format is chosen first
from vrw_jax.paper import reproduction as reproduce  # noqa: E402

DAMPINGS = (50.0, 100.0, 200.0)  # N s/m


def main(folder: Path) -> None:
    gaits = reproduce.gaits_at(DAMPINGS)
    plots.save(plots.foot_height(gaits), folder, "fig08_scuffing")


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "results"))
