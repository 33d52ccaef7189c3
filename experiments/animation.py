"""Table 1's gait repeats: one step of it loops.

Writes `walk.gif` to `results/` or the folder given:
`python experiments/animation.py [folder]`.
"""

import sys
from pathlib import Path

import jax

jax.config.update("jax_enable_x64", True)

from vrw_jax.figures import walk as plots  # noqa: E402  the number format is chosen first
from vrw_jax.paper import reproduction as reproduce  # noqa: E402

FRAMES = 36
SLOWER = 2.0  # times slower than life


def main(folder: Path) -> None:
    step = reproduce.gait_at_table_1(1)
    frames, milliseconds = plots.walk_frames(step, FRAMES, SLOWER)
    plots.save_animation(frames, milliseconds, folder / "walk.gif")


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "results"))
