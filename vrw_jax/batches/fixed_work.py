"""Gait steps of many wheels in a fixed amount of work, near gaits whose durations are known.

Collocation in all three phases: no lane waits for another. Each lane says whether it can be
trusted; one that can't is stepped anew by the adaptive engine, so that nothing depends on luck.
"""

import functools
import operator
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool

from vrw_jax.batches import paper as lane_engine
from vrw_jax.batches.lane_collocation import Residual, Scheme, collocate
from vrw_jax.models import PAPER_START, PhaseBuilder, replaced_where_bad, usable
from vrw_jax.numerics import LanePhase, Mesh, Place, Vector, sine_cosine
from vrw_jax.wheel import Motion, Symbols, WheelParams, dynamics, transitions

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


def _residuals(s: Symbols, double_support: LanePhase) -> tuple[Residual, ...]:
    """What the equations of motion of each phase leave over, linear in the acceleration."""

    def dls(sin: Array, cos: Array, q: Vector, v: Vector, a: Vector) -> Vector:
        return (a[0] - double_support.evaluate(q, v).acceleration[0],)

    def sls1(sin: Array, cos: Array, q: Vector, v: Vector, a: Vector) -> Vector:
        M, *forces = dynamics.terms(s, Motion(sin, cos, q[1], q[2], *v))
        return tuple(x - f for x, f in zip(M.times((a[0], a[1], a[2])), forces, strict=True))

    def sls2(sin: Array, cos: Array, q: Vector, v: Vector, a: Vector) -> Vector:
        m = Motion(sin, cos, q[1], s.L0 + 0.0 * q[1], v[0], v[1], 0.0 * v[1])
        M, *forces = dynamics.terms(s, m)
        return M.M11 * a[0] - forces[0], M.M22 * a[1] - forces[1]

    return dls, sls1, sls2


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
    build = PhaseBuilder(s, stop_at_lift_off, monitored=False)

    landing = transitions.land(s, *x)
    phases = (
        lane_engine.double_support(build, landing.distance),
        lane_engine.single_support_1(build),
        lane_engine.single_support_2(build),
    )
    residuals = _residuals(s, phases[0])
    q, v = (landing.theta,), (landing.motion.dtheta,)
    first = phases[0].guards(Place(q, v, phases[0].evaluate(q, v)))
    dls = collocate(phases[0], residuals[0], q, v, expected[0], SCHEMES[0])

    m = lane_engine.double_support_at(build, landing.distance, dls.q[0], dls.v[0])
    q1, v1 = (dls.q[0], m.L1, m.L2), (m.dtheta, m.dL1, m.dL2)
    sls1 = collocate(phases[1], residuals[1], q1, v1, expected[1], SCHEMES[1])

    lengths_and_rates = (*sls1.q[1:], *sls1.v)
    hit = transitions.hit_stopper(s, Motion(*sine_cosine(sls1.q[0]), *lengths_and_rates)).motion
    q2, v2 = (sls1.q[0], hit.L1), (hit.dtheta, hit.dL1)
    sls2 = collocate(phases[2], residuals[2], q2, v2, expected[2], SCHEMES[2])

    trusted = good & landing.stays
    for value in first:
        trusted = trusted & (value > 0.0)
    for end, most in zip((dls, sls1, sls2), MOST_MISMATCH, strict=True):
        trusted = trusted & (end.correction <= MOST_CORRECTION) & (end.shift <= MOST_SHIFT)
        trusted = trusted & (end.mismatch <= most) & (end.least > 0.0)
    kept = lambda values: tuple(jnp.where(trusted, value, 0.0) for value in values)
    durations = (dls.duration, sls1.duration, sls2.duration)
    return FixedStep(kept((sls2.q[0], *sls2.v)), kept(durations), trusted)
