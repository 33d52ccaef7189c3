"""Gait steps of many wheels in a fixed amount of work, near gaits whose durations are known.

Collocation in all three phases: no lane waits for another. Each lane says whether it can be
trusted; one that can't is stepped anew by the adaptive engine, so that nothing depends on luck.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from vrw_jax import dynamics, lane_engine, transitions
from vrw_jax.geometry import Motion, double_support_circle
from vrw_jax.lane_collocation import Residual, Scheme, collocate
from vrw_jax.lane_phase import LanePhase
from vrw_jax.mesh import Mesh
from vrw_jax.models.base import replaced_where_bad, usable
from vrw_jax.models.viscoelastic import PAPER_START, PhaseBuilder
from vrw_jax.params import Symbols, WheelParams
from vrw_jax.runge_kutta import Cut, Place, Vector, cut_where
from vrw_jax.sequences import sine_cosine

SCHEMES = (
    Scheme(Mesh(4, 1.0), sweeps=4, rounds=4),
    Scheme(Mesh(5, 3.0), sweeps=4, rounds=4),
    Scheme(Mesh(1, 1.0), sweeps=0, rounds=3),
)
"""Of DLS, SLS-I and SLS-II: the cheapest of those tried whose 99th percentile of errors over lanes
near their gaits is about 1e-8 (experiments/engine_benchmark.py)."""

MOST_CORRECTION = 5e-8
MOST_SHIFT = 1e-6
MOST_MISMATCH = (2e-3, 1.2e-1, 8e-5)
"""What a trusted lane may show at most, see `Collocated`; errors are the square of a mismatch and
less. Some three in a hundred lanes show more near their gaits."""


class FixedStep(NamedTuple):
    """One gait step of a block of lanes, and which of them to trust."""

    section_state: Float[Array, "3 lanes"]
    durations: Float[Array, "3 lanes"]  # s
    trusted: Bool[Array, " lanes"]


def _residuals(s: Symbols, double_support: LanePhase, cut: Cut) -> tuple[Residual, ...]:
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

    return dls, partial(cut, sls1), partial(cut, sls2)


def fixed_gait_step(
    params: WheelParams,
    x: Float[Array, "lanes 3"],
    wanted: Array,
    expected: Float[Array, "lanes 3"],
    stop_at_lift_off: bool,
) -> FixedStep:
    """One gait step of every wanted lane, near the expected durations of DLS, SLS-I, SLS-II."""
    known = jnp.all((expected > 0.0) & (expected < 10.0), axis=1)
    good = jax.vmap(usable)(params, x) & wanted & known
    params, x = jax.vmap(replaced_where_bad, (0, 0, 0, None))(
        good, params, x, jnp.asarray(PAPER_START)
    )
    expected = jnp.where(good[:, None], expected, 0.1)
    cut = cut_where(~jnp.isnan(jnp.max(x)))
    s = params.symbols()
    build = PhaseBuilder(s, stop_at_lift_off, monitored=False)

    def land(*x: Array) -> tuple:
        landing = transitions.land(s, *x)
        return landing.theta, landing.motion.dtheta, landing.distance, landing.stays

    theta, dtheta, distance, stays = cut(land, *x.T)
    phases = (
        lane_engine.double_support(build, distance, cut),
        lane_engine.single_support_1(build, cut),
        lane_engine.single_support_2(build, cut),
    )
    residuals = _residuals(s, phases[0], cut)
    q, v = (theta,), (dtheta,)
    first = phases[0].guards(Place(q, v, phases[0].evaluate(q, v)))
    dls = collocate(phases[0], residuals[0], q, v, expected[:, 0], SCHEMES[0], cut)

    def free(theta: Array, dtheta: Array) -> Vector:
        circle = double_support_circle(s, distance, *sine_cosine(theta))
        return circle.L1, circle.L2, circle.G1 * dtheta, circle.G2 * dtheta

    L1, L2, dL1, dL2 = cut(free, dls.q[0], dls.v[0])
    q1, v1 = (dls.q[0], L1, L2), (dls.v[0], dL1, dL2)
    sls1 = collocate(phases[1], residuals[1], q1, v1, expected[:, 1], SCHEMES[1], cut)

    def hit(theta: Array, L1: Array, L2: Array, *rates: Array) -> Vector:
        motion = transitions.hit_stopper(s, Motion(*sine_cosine(theta), L1, L2, *rates)).motion
        return motion.L1, motion.dtheta, motion.dL1

    L1, dtheta, dL1 = cut(hit, *sls1.q, *sls1.v)
    q2, v2 = (sls1.q[0], L1), (dtheta, dL1)
    sls2 = collocate(phases[2], residuals[2], q2, v2, expected[:, 2], SCHEMES[2], cut)

    trusted = good & stays
    for value in first:
        trusted = trusted & (value > 0.0)
    for end, most in zip((dls, sls1, sls2), MOST_MISMATCH, strict=True):
        trusted = trusted & (end.correction <= MOST_CORRECTION) & (end.shift <= MOST_SHIFT)
        trusted = trusted & (end.mismatch <= most) & (end.least > 0.0)
    section = jnp.stack([sls2.q[0], *sls2.v])
    durations = jnp.stack([dls.duration, sls1.duration, sls2.duration])
    return FixedStep(jnp.where(trusted, section, 0.0), jnp.where(trusted, durations, 0.0), trusted)
