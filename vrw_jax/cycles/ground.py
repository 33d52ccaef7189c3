"""A gait on real ground with its first derivatives by every parameter, friction included.

The gait is found by Newton's method on its return map; how it moves with the parameters follows
from one Jacobian of the step, by the implicit function theorem. Nothing is differentiated twice.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from vrw_jax.cycles.cycle import limit_cycle
from vrw_jax.cycles.section_cycle import WalkedCycle, cycle_from, finest
from vrw_jax.models import UnilateralStep, UnilateralWheel
from vrw_jax.numerics import Options, SectionCycle, corrected
from vrw_jax.wheel import FRICTION, PARAMETER_NAMES, WheelParams, parameters_of, wheel_of

MOVED = (*PARAMETER_NAMES, FRICTION)
"""What a gait is differentiated by, in the order of its columns."""

Values = Float[Array, " n_moved"]
"""Numbers of MOVED."""


class GroundGait(NamedTuple):
    """A gait that repeats after one step, and how it moves. Where none was found, all is zero."""

    cycle: WalkedCycle
    step: UnilateralStep  # from the gait's section state
    columns: UnilateralStep  # derivatives of `step` along the branch of gaits, leading axis: MOVED
    section_columns: Float[Array, "n_moved n_section"]  # of the section state


def values_of(params: WheelParams, model: UnilateralWheel) -> Values:
    """The numbers that a gait is differentiated by."""
    return jnp.stack([*parameters_of(params), jnp.asarray(model.friction, params.damping.dtype)])


def wheel_and_ground(
    values: Values, n_legs: int, model: UnilateralWheel
) -> tuple[WheelParams, UnilateralWheel]:
    """The inverse of `values_of`; `model` gives what has no derivative."""
    ground = eqx.tree_at(lambda ground: ground.friction, model, values[-1])
    return wheel_of(values[:-1], n_legs), ground


def cycle_of(
    values: Values, start: Array, n_legs: int, model: UnilateralWheel, options: Options
) -> WalkedCycle:
    """The gait next to `start`."""
    wheel, ground = wheel_and_ground(values, n_legs, model)
    cycle = limit_cycle(wheel, guess=start, model=ground, options=options)
    assert isinstance(cycle, WalkedCycle)
    return cycle


@eqx.filter_jit
def ground_gait(
    values: Values, start: Array, n_legs: int, model: UnilateralWheel, options: Options
) -> GroundGait:
    """The gait next to `start`, with its derivatives.

    Each correction has all derivatives of the step: the step's Jacobian, by far the largest part of
    the program, is compiled once for search and derivatives.
    """
    n = values.shape[0]

    def floats_of(inputs: Array) -> tuple:
        wheel, ground = wheel_and_ground(inputs[:n], n_legs, model)
        floats, rest = eqx.partition(ground.step(wheel, inputs[n:], options), eqx.is_inexact_array)
        return floats, (floats, rest)

    differentiated = jax.jacfwd(floats_of, has_aux=True)
    one = jnp.eye(start.shape[0], dtype=start.dtype)

    def correct(x: Array) -> tuple:
        jacobian, (floats, rest) = differentiated(jnp.concatenate([values, x]))
        miss = floats.section_state - x
        change = jnp.linalg.solve(one - jacobian.section_state[:, n:], miss)
        return change, (jacobian, floats, rest, jnp.max(jnp.abs(miss)))

    shapes = jax.eval_shape(correct, start)[1]
    blank = jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), shapes)
    found = corrected(correct, start, blank, finest(options), 1)
    jacobian, floats, rest, residual = found.told
    by_values, by_section = jnp.split(jacobian.section_state, [n], axis=-1)
    moved = jnp.linalg.solve(one - by_section, by_values)
    along = jnp.concatenate([jnp.eye(n, dtype=start.dtype), moved])
    columns = jax.tree.map(lambda leaf: jnp.moveaxis(leaf @ along, -1, 0), jacobian)
    step = eqx.combine(floats, rest)
    gait = SectionCycle(found.at, by_section, residual, found.converged, found.iterations)
    wheel, _ = wheel_and_ground(values, n_legs, model)
    cycle = cycle_from(wheel, gait, jax.tree.map(lambda leaf: leaf[None], step))
    return GroundGait(cycle, step, columns, moved.T)


@eqx.filter_jit
def told(gait: GroundGait, names: tuple[str, ...]) -> dict[str, tuple[Array, Array]]:
    """Measures of the gait by name, each with its derivatives by MOVED."""
    floats, rest = eqx.partition(gait.step, eqx.is_inexact_array)
    columns = eqx.filter(gait.columns, eqx.is_inexact_array)

    def read(floats: UnilateralStep) -> dict[str, Array]:
        measures = eqx.combine(floats, rest).measures()
        return {name: measures[name] for name in names}

    along = jax.vmap(lambda column: jax.jvp(read, (floats,), (column,))[1])(columns)
    values = read(floats)
    return {name: (values[name], along[name]) for name in names}
