"""Robustness of gaits: uneven ground, first-passage times, basins of attraction, and disturbances
of the state.
"""

from vrw_jax.robustness.basin_share import BasinShare, basin_share
from vrw_jax.robustness.branch_robustness import measure_basins, measure_gait_sensitivity
from vrw_jax.robustness.first_passage import FirstPassage, first_passage
from vrw_jax.robustness.gait_sensitivity import GaitSensitivity, gait_sensitivity
from vrw_jax.robustness.smallest_disturbance import SmallestDisturbance, smallest_disturbance
