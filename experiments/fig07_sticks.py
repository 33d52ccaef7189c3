"""The hub of Table 1's gait rolls over circle after circle; Leg 2 leaves the ground only to rise.

Writes `fig07_sticks.svg` and `.png` to `results/` or the folder given:
`python experiments/fig07_sticks.py [folder]`.
"""

import sys
from pathlib import Path

import jax

jax.config.update("jax_enable_x64", True)

from vrw_jax.figures import walk as plots  # noqa: E402  the number format is chosen first
from vrw_jax.paper import reproduction as reproduce  # noqa: E402

STEPS = 2
INTERVAL = 0.05  # s, between sticks


def main(folder: Path) -> None:
    gait = reproduce.gait_at_table_1(STEPS)
    plots.save(plots.sticks(gait, INTERVAL), folder, "fig07_sticks")


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "results"))
