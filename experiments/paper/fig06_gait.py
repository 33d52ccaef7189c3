"""Draw figure 6 of the paper: coordinates and forces over steps of Table 1's gait.

    python -m experiments.paper.fig06_gait [folder]

Within a step θ grows, Leg 1 contracts, Leg 2 extends, and the load moves to the front foot. The
command writes `fig06_gait.svg` and `.png` to `results/` or the given folder.
"""

from experiments.shared.command import parse_folder_and_start_jax
from vrw_jax import plot as plots
from vrw_jax.app import paper_reproduction as reproduction

N_STEPS = 3


def main() -> None:
    folder = parse_folder_and_start_jax(__doc__)
    plots.save(plots.gait_panels(reproduction.simulate_table_1_gait(N_STEPS)), folder, "fig06_gait")


if __name__ == "__main__":
    main()
