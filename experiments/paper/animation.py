"""Table 1's gait repeats: one step of it loops.

    python -m experiments.paper.animation [folder]

Writes `walk.gif` to `results/` or the folder given.
"""

from experiments.shared.command import parse_folder_and_start_jax
from vrw_jax import figures as plots
from vrw_jax.paper import reproduction

FRAMES = 36
SLOWER = 2.0  # times slower than life


def main() -> None:
    folder = parse_folder_and_start_jax(__doc__)
    step = reproduction.simulate_table_1_gait(1)
    frames, milliseconds = plots.walk_frames(step, FRAMES, SLOWER)
    plots.save_animation(frames, milliseconds, folder / "walk.gif")


if __name__ == "__main__":
    main()
