"""λ_I4 stays positive along the damping; λ2⁺ vanishes at c = 4 and λ4⁺ at c = 220, at slope 0.30.

    python -m experiments.paper.fig10_indicators [folder]

Writes `fig10_indicators.svg` and `.png` to `results/` or the folder given.
"""

from experiments.shared.command import parse_folder_and_start_jax
from vrw_jax import figures as plots
from vrw_jax.paper import reproduction

EVERY = 4  # one symbol for so many gaits


def main() -> None:
    folder = parse_folder_and_start_jax(__doc__)
    plots.save(
        plots.indicators(reproduction.measure_gaits_along_damping(), EVERY),
        folder,
        "fig10_indicators",
    )


if __name__ == "__main__":
    main()
