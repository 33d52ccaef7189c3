"""The monitored step of the viscoelastic wheel by the lane engine: values only, for batches.

A function of one wheel that `jax.vmap` maps onto lanes, within programs of JAX. What phases end
with comes from the lanes, all that follows from it by algebra from the model's own step.
"""

import functools

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array

from vrw_jax import simd
from vrw_jax.batches.paper import walk
from vrw_jax.models import (
    PAPER_START,
    SectionState,
    StepResult,
    Told,
    ViscoelasticWheel,
    replaced_where_bad,
    result_of,
    told_of,
    usable,
)
from vrw_jax.numerics import Options, explicit_tableau, one_wheel
from vrw_jax.runtime import lane_function
from vrw_jax.wheel import WheelParams, parameters_of, transitions, wheel_of


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
    s = params.symbols()
    return result_of(s, transitions.land(s, *x), told, model.friction)


def _over_lanes(rest: tuple, values: Array, x: Array, dynamic: Options) -> Told:
    n_legs, stop_at_lift_off, static, tableau = rest
    params, options = wheel_of(tuple(values), n_legs), eqx.combine(dynamic, static)
    return told_of(walk(params, tuple(x), options, tableau, stop_at_lift_off, monitored=True))


def _like(rest: tuple, values: Array, x: Array, dynamic: Options) -> Told:
    return Told((x, x, x), x, x, (x, x, x), x, x)
