"""What repeats: steps, walks, trajectories, and what they settle on."""

from vrw_jax.walks.basins import BEFORE, basin
from vrw_jax.walks.choice import choose_model
from vrw_jax.walks.stepping import ModelLike, Walk, checked, paper_start, return_map, step, walk
from vrw_jax.walks.trajectory import simulate
