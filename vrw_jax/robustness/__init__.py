"""Robustness of gaits on uneven ground: sensitivity norms, mean first-passage times."""

from vrw_jax.robustness.first_passage import FirstPassage, first_passage
from vrw_jax.robustness.gait_sensitivity import GaitSensitivity, gait_sensitivity
