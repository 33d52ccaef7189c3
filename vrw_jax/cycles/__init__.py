"""Gaits that repeat: found, checked and differentiated, each rung by its own means."""

from vrw_jax.cycles.cycle import LimitCycle, _limit_cycle, limit_cycle
from vrw_jax.cycles.ground import MOVED, cycle_of, ground_gait, told, values_of
from vrw_jax.cycles.options import CycleOptions
from vrw_jax.cycles.premises import TAKE_OFF, default_margins, measure, takeoff_acceleration
from vrw_jax.cycles.search import Located, Problem, correction_size, nothing_known, surface_start
from vrw_jax.cycles.section_cycle import WalkedCycle
from vrw_jax.cycles.sensitivity import sensitivities
