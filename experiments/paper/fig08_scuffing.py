"""Foot 2 scuffs in SLS-I where the damping is small (c = 50, and barely at 100), not at 200.

    python -m experiments.paper.fig08_scuffing [folder]

Writes `fig08_scuffing.svg` and `.png` to `results/` or the folder given.
"""

from experiments.shared.command import parse_folder_and_start_jax
from vrw_jax import figures as plots
from vrw_jax.paper import reproduction

DAMPINGS = (50.0, 100.0, 200.0)  # N s/m


def main() -> None:
    folder = parse_folder_and_start_jax(__doc__)
    plots.save(
        plots.foot_height(reproduction.simulate_gaits_at_dampings(DAMPINGS)),
        folder,
        "fig08_scuffing",
    )


if __name__ == "__main__":
    main()
