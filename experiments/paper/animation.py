"""Animate one step of Table 1's gait as a loop.

    python -m experiments.paper.animation [folder]

The command writes `walk.gif` to `results/` or the given folder.
"""

from experiments.shared.command import parse_folder_and_start_jax
from vrw_jax import plot as plots
from vrw_jax.app import paper_reproduction as reproduction

N_FRAMES = 36
"""Number of pictures of the loop."""
SLOW_MOTION_FACTOR = 2.0
"""Duration of the animation divided by that of the step."""


def main() -> None:
    folder = parse_folder_and_start_jax(__doc__)
    step = reproduction.simulate_table_1_gait(1)
    frames, milliseconds = plots.walk_frames(step, N_FRAMES, SLOW_MOTION_FACTOR)
    plots.save_animation(frames, milliseconds, folder / "walk.gif")


if __name__ == "__main__":
    main()
