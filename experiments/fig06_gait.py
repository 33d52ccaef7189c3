"""Over a step of Table 1's gait θ grows, Leg 1 contracts, Leg 2 extends and the load goes forward.

Writes `fig06_gait.svg` and `.png` to `results/` or the folder given:
`python experiments/fig06_gait.py [folder]`.
"""

import sys
from pathlib import Path

import jax

jax.config.update("jax_enable_x64", True)

from vrw_jax.figures import walk as plots  # noqa: E402  the number format is chosen first
from vrw_jax.paper import reproduction as reproduce  # noqa: E402

STEPS = 3


def main(folder: Path) -> None:
    gait = reproduce.gait_at_table_1(STEPS)
    plots.save(plots.gait_panels(gait), folder, "fig06_gait")


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "results"))
