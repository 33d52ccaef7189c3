"""Steps, walks, trajectories, and the attractors that walks reach."""

from vrw_jax.walks.basins import BEFORE, basin
from vrw_jax.walks.stepping import (
    ModelLike,
    Walk,
    checked,
    choose_model,
    one_wheel,
    options_of,
    paper_start,
    return_map,
    rung_of,
    state_of,
    step,
    walk,
    walk_towards,
)
from vrw_jax.walks.trajectory import simulate
