"""Over a step of Table 1's gait θ grows, Leg 1 contracts, Leg 2 extends and the load goes forward.

    python -m experiments.paper.fig06_gait [folder]

Writes `fig06_gait.svg` and `.png` to `results/` or the folder given.
"""

from experiments.shared.command import parse_folder_and_start_jax
from vrw_jax import figures as plots
from vrw_jax.paper import reproduction

STEPS = 3


def main() -> None:
    folder = parse_folder_and_start_jax(__doc__)
    plots.save(plots.gait_panels(reproduction.simulate_table_1_gait(STEPS)), folder, "fig06_gait")


if __name__ == "__main__":
    main()
