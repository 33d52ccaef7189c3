"""The hub of Table 1's gait rolls over circle after circle; Leg 2 leaves the ground only to rise.

    python -m experiments.paper.fig07_sticks [folder]

Writes `fig07_sticks.svg` and `.png` to `results/` or the folder given.
"""

from experiments.shared.command import parse_folder_and_start_jax
from vrw_jax import figures as plots
from vrw_jax.paper import reproduction

STEPS = 2
INTERVAL = 0.05  # s, between sticks


def main() -> None:
    folder = parse_folder_and_start_jax(__doc__)
    plots.save(
        plots.sticks(reproduction.simulate_table_1_gait(STEPS), INTERVAL), folder, "fig07_sticks"
    )


if __name__ == "__main__":
    main()
