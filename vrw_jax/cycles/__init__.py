"""Limit cycles: finders, checks and derivatives for each model."""

from vrw_jax.cycles.attracting import (
    NEAR,
    further_starts_of,
    gaits_attracting,
    slow_gaits,
    slowest,
    starts_of,
)
from vrw_jax.cycles.by_collocation import CollocationFinder
from vrw_jax.cycles.by_walking import WalkedCycle
from vrw_jax.cycles.collocated import LimitCycle, on_mesh
from vrw_jax.cycles.cycle import MEASURED, AbstractCycle, multipliers_told
from vrw_jax.cycles.derivatives import over_lanes
from vrw_jax.cycles.finder import (
    AGREEMENT,
    AbstractGaitFinder,
    Gait,
    Readings,
    confirmed,
    read_along,
    read_along_lanes,
    same_branch,
)
from vrw_jax.cycles.finding import (
    Guess,
    finder_for,
    finder_of,
    near,
    serving,
    serving_and_why,
)
from vrw_jax.cycles.on_ground import Periods, solved
from vrw_jax.cycles.options import CycleOptions
from vrw_jax.cycles.premises import default_margins, takeoff_acceleration
from vrw_jax.cycles.search import Located, Problem, correction_size, nothing_known
from vrw_jax.cycles.sensitivity import sensitivities
