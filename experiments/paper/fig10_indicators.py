"""Draw figure 10 of the paper: the indicators of gaits along the damping, at slope 0.30.

    python -m experiments.paper.fig10_indicators [folder]

λ_I4 stays positive. λ2⁺ vanishes at c = 4, and λ4⁺ vanishes at c = 220. The command writes
`fig10_indicators.svg` and `.png` to `results/` or the given folder.
"""

from experiments.shared.command import parse_folder_and_start_jax
from vrw_jax import plot as plots
from vrw_jax.app import paper_reproduction as reproduction

SYMBOL_INTERVAL = 4
"""Number of gaits per plotted symbol."""


def main() -> None:
    folder = parse_folder_and_start_jax(__doc__)
    plots.save(
        plots.indicators(reproduction.measure_gaits_along_damping(), SYMBOL_INTERVAL),
        folder,
        "fig10_indicators",
    )


if __name__ == "__main__":
    main()
