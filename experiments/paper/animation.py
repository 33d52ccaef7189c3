"""Table 1's gait repeats: one step of it loops.

    python -m experiments.paper.animation [folder]

Writes `walk.gif` to `results/` or the folder given.
"""

from experiments.shared.command import started_with_folder
from vrw_jax import figures as plots
from vrw_jax.paper import reproduction

FRAMES = 36
SLOWER = 2.0  # times slower than life


def main() -> None:
    folder = started_with_folder(__doc__)
    step = reproduction.gait_at_table_1(1)
    frames, milliseconds = plots.walk_frames(step, FRAMES, SLOWER)
    plots.save_animation(frames, milliseconds, folder / "walk.gif")


if __name__ == "__main__":
    main()
