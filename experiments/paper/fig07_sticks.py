"""Draw figure 7 of the paper: stick figures of Table 1's gait.

    python -m experiments.paper.fig07_sticks [folder]

The hub moves along one circle after another. Leg 2 leaves the ground and then only rises. The
command writes `fig07_sticks.svg` and `.png` to `results/` or the given folder.
"""

from experiments.shared.command import parse_folder_and_start_jax
from vrw_jax import plot as plots
from vrw_jax.app import paper_reproduction as reproduction

N_STEPS = 2
INTERVAL_SECONDS = 0.05
"""Time between two stick figures."""


def main() -> None:
    folder = parse_folder_and_start_jax(__doc__)
    plots.save(
        plots.sticks(reproduction.simulate_table_1_gait(N_STEPS), INTERVAL_SECONDS),
        folder,
        "fig07_sticks",
    )


if __name__ == "__main__":
    main()
