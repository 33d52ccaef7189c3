"""Draw figure 8 of the paper: the height of foot 2 in SLS-I at three dampings.

    python -m experiments.paper.fig08_scuffing [folder]

Foot 2 scuffs at c = 50 and slightly at c = 100. It does not scuff at c = 200. The command writes
`fig08_scuffing.svg` and `.png` to `results/` or the given folder.
"""

from experiments.shared.command import parse_folder_and_start_jax
from vrw_jax import plot as plots
from vrw_jax.app import paper_reproduction as reproduction

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
