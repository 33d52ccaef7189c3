"""Gait steps of many wheels in a fixed amount of work, near gaits whose durations are known.

Collocation in all three phases: no lane waits for another. Each lane says whether it can be
trusted; one that can't is stepped anew by the adaptive engine, so that nothing depends on luck.
"""

import functools
import operator
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool

from vrw_jax.batches.lane_collocation import Scheme, collocate
from vrw_jax.models import PAPER_START, replaced_where_bad, usable
from vrw_jax.numerics import Mesh, Vector
from vrw_jax.wheel import Instant, WheelParams, phases_of, transitions

SCHEMES = (
    Scheme(Mesh(4, 1.0), sweeps=4, rounds=4),
    Scheme(Mesh(5, 3.0), sweeps=4, rounds=4),
    Scheme(Mesh(1, 1.0), sweeps=0, rounds=3),
)
"""Of DLS, SLS-I and SLS-II: the cheapest of those tried whose 99th percentile of errors over lanes
near their gaits is about 1e-8 (experiments/speed/engine_benchmark.py)."""

MOST_CORRECTION = 5e-8
MOST_SHIFT = 1e-6
MOST_MISMATCH = (2e-3, 1.2e-1, 8e-5)
"""What a trusted lane may show at most, see `Collocated`; errors are the square of a mismatch and
less. Some three in a hundred lanes show more near their gaits."""


class FixedStep(NamedTuple):
    """One gait step of a block of lanes, and which of them to trust."""

    section_state: Vector  # three arrays
    durations: Vector  # of DLS, SLS-I, SLS-II, s
    trusted: Bool[Array, " lanes"]


def fixed_gait_step(
    params: WheelParams,
    x: Vector,
    expected: Vector,
    stop_at_lift_off: bool,
) -> FixedStep:
    """One gait step of every lane, near the expected durations of DLS, SLS-I, SLS-II."""
    known = [(duration > 0.0) & (duration < 10.0) for duration in expected]
    good = functools.reduce(operator.and_, known, usable(params, x))
    params, x = replaced_where_bad(good, params, x, PAPER_START)
    expected = tuple(jnp.where(good, duration, 0.1) for duration in expected)
    s = params.symbols()
    landing = transitions.land(s, *x)
    trusted = good & landing.stays
    theta, motion = landing.theta, landing.motion
    phases = phases_of(s, landing.distance, stop_at_lift_off)
    for value in phases[0].guards(Instant(phases[0], motion, None)):
        trusted = trusted & (value > 0.0)
    durations = []
    for phase, duration, scheme, most in zip(phases, expected, SCHEMES, MOST_MISMATCH, strict=True):
        end = collocate(phase, *phase.own(theta, motion), duration, scheme)
        trusted = trusted & (end.correction <= MOST_CORRECTION) & (end.shift <= MOST_SHIFT)
        trusted = trusted & (end.mismatch <= most) & (end.least > 0.0)
        theta, motion = end.q[0], phase.after(phase.at(end.q, end.v))
        durations.append(end.duration)
    kept = lambda values: tuple(jnp.where(trusted, value, 0.0) for value in values)
    return FixedStep(kept((theta, motion.dtheta, motion.dL1)), kept(durations), trusted)
