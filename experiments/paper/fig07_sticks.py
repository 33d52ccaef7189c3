"""The hub of Table 1's gait rolls over circle after circle; Leg 2 leaves the ground only to rise.

    python -m experiments.paper.fig07_sticks [folder]

Writes `fig07_sticks.svg` and `.png` to `results/` or the folder given.
"""

from experiments.shared.command import started_with_folder
from vrw_jax import figures as plots
from vrw_jax.paper import reproduction

STEPS = 2
INTERVAL = 0.05  # s, between sticks


def main() -> None:
    folder = started_with_folder(__doc__)
    plots.save(plots.sticks(reproduction.gait_at_table_1(STEPS), INTERVAL), folder, "fig07_sticks")


if __name__ == "__main__":
    main()
