"""The monitored step of the viscoelastic wheel by the lane engine: values only, for batches.

A function of one wheel that `jax.vmap` maps onto lanes, within programs of JAX. What phases end
with comes from the lanes, all that follows from it by algebra from the model's own step.
"""

import functools
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array

from vrw_jax import simd
from vrw_jax.batches.paper import walk
from vrw_jax.models import (
    PAPER_START,
    SAFE_SINGLE_SUPPORT,
    PhaseBuilder,
    SectionState,
    StepResult,
    ViscoelasticWheel,
    Walked,
    phases_of,
    replaced_where_bad,
    result_of,
    usable,
)
from vrw_jax.numerics import Options, PhaseEnd, explicit_tableau, one_wheel
from vrw_jax.runtime import lane_function
from vrw_jax.wheel import WheelParams, parameters_of, transitions, wheel_of


class _Told(NamedTuple):
    """What the lanes tell, lanes last; by phase where it is a tuple."""

    states: tuple[Array, ...]  # coordinates, then rates, at the end
    durations: Array  # (3, lanes), s
    happened: Array  # (3, lanes)
    minima: tuple[Array, ...]  # of the monitors, (monitors, lanes)
    outcome: Array
    tried: Array  # (3, lanes)


def can_run(model: ViscoelasticWheel, options: Options) -> bool:
    """Whether there is such a step for this solver, and it is the quickest here."""
    return explicit_tableau(options.solver) is not None and simd.serves()


def step(
    model: ViscoelasticWheel, params: WheelParams, x: SectionState, options: Options
) -> StepResult:
    """`model.step` without derivatives, by machine code. Errors: those of `options`, as there."""
    tableau = explicit_tableau(options.solver)
    assert tableau is not None  # `can_run` looked
    dynamic, static = eqx.partition(options, eqx.is_array)
    rest = (params.n_legs, model.stop_at_lift_off, static, tableau)
    over_lanes, like = (functools.partial(function, rest) for function in (_over_lanes, _like))
    compiled = lane_function(over_lanes, like, ("monitored step", rest[:-1]))
    told = one_wheel(lambda *arrays: compiled(*arrays, dynamic))(parameters_of(params), x)
    good = usable(params, x)
    params, x = replaced_where_bad(good, params, x, jnp.asarray(PAPER_START))
    return result_of(_walked(model, params, x, told), model.friction)


def _over_lanes(rest: tuple, values: Array, x: Array, dynamic: Options) -> _Told:
    n_legs, stop_at_lift_off, static, tableau = rest
    params, options = wheel_of(tuple(values), n_legs), eqx.combine(dynamic, static)
    walked = walk(params, tuple(x), options, tableau, stop_at_lift_off, monitored=True)
    states = tuple(jnp.stack([*end.place.q, *end.place.v]) for end in walked.ends)
    return _Told(
        states=states,
        durations=jnp.stack([end.duration for end in walked.ends]),
        happened=jnp.stack(walked.happened),
        minima=tuple(end.minima for end in walked.ends if end.minima is not None),
        outcome=walked.outcome,
        tried=jnp.stack([end.tried for end in walked.ends]),
    )


def _like(rest: tuple, values: Array, x: Array, dynamic: Options) -> _Told:
    return _Told((x, x, x), x, x, (x, x, x), x, x)


def _walked(model: ViscoelasticWheel, params: WheelParams, x: SectionState, told: _Told) -> Walked:
    """As the model's own step would have left it."""
    s = params.symbols()
    landing = transitions.land(s, *x)
    build = PhaseBuilder(s, model.stop_at_lift_off, monitored=True)
    phases = phases_of(build, landing.distance)
    none = jnp.zeros((), jnp.int32)
    dls, sls1, sls2 = (
        PhaseEnd(state, duration, none, none > 0, none > 0, tried, minima)
        for state, duration, tried, minima in zip(
            told.states, told.durations, told.tried, told.minima, strict=True
        )
    )
    hits = told.happened[2]
    at_stopper = jnp.where(hits, told.states[1], jnp.asarray(SAFE_SINGLE_SUPPORT, x.dtype))
    hit = transitions.hit_stopper(s, phases[1].motion(at_stopper))
    happened = told.happened[0], told.happened[1], hits
    return Walked(s, landing, phases, (dls, sls1, sls2), happened, hit, told.outcome)
