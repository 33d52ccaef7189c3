"""Draw figure 9 of the paper: the normal force on foot 2 after landing.

    python -m experiments.paper.fig09_rear_force [folder]

The force approaches zero as the damping grows. The command writes `fig09_rear_force.svg` and
`.png` to `results/` or the given folder.
"""

from experiments.shared.command import parse_folder_and_start_jax
from vrw_jax import plot as plots
from vrw_jax.app import paper_reproduction as reproduction

DAMPINGS = (50.0, 100.0, 200.0)  # N s/m


def main() -> None:
    folder = parse_folder_and_start_jax(__doc__)
    plots.save(
        plots.rear_force(reproduction.simulate_gaits_at_dampings(DAMPINGS)),
        folder,
        "fig09_rear_force",
    )


if __name__ == "__main__":
    main()
