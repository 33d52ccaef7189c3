"""λ_I4 stays positive along the damping; λ2⁺ vanishes at c = 4 and λ4⁺ at c = 220, at slope 0.30.

Writes `fig10_indicators.svg` and `.png` to `results/` or the folder given:
`python experiments/fig10_indicators.py [folder]`.
"""

import sys
from pathlib import Path

import jax

jax.config.update("jax_enable_x64", True)

from vrw_jax.figures import walk as plots  # noqa: E402  the number format is chosen first
from vrw_jax.paper import reproduction as reproduce  # noqa: E402

EVERY = 4  # one symbol for so many gaits


def main(folder: Path) -> None:
    gaits = reproduce.gaits_along_damping()
    plots.save(plots.indicators(gaits, EVERY), folder, "fig10_indicators")


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "results"))
