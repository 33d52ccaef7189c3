"""Determinant of the flow's Jacobian through modes and events: Liouville's formula
with saltation.
"""

from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
from jax import lax
from jax.typing import ArrayLike
from jaxtyping import Array

from vrw_jax.numerics.events import sample_phase
from vrw_jax.numerics.hybrid import Guard, Mode, Walk
from vrw_jax.numerics.options import Options
from vrw_jax.numerics.types import Scalar
from vrw_jax.wording import reals


def volume_change(
    modes: Sequence[Mode], start: ArrayLike | Sequence, told: Walk, options: Options | None = None
) -> Scalar:
    """Return the determinant of the final state's Jacobian with respect to `start`, past the last
    event.

    It is exp of the field's integrated divergence along each mode (Liouville), times the
    determinant of each event's saltation matrix (R. I. Leine and H. Nijmeijer, Dynamics and
    Bifurcations of Non-Smooth Mechanical Systems, 2004, section 7). For an orbit that is periodic
    after these events, it is the product of all its multipliers, including the 1 along the orbit. A
    return map's Jacobian loses that product's digits where a guard is grazed, because its entries
    grow as one over the guard's rate.

    The result is NaN if the solver steps are spent. Transforms apply.
    """
    options = Options() if options is None else options
    start = reals("start", start)
    pairs = [_factor(mode, guard, options) for mode in modes for guard in mode.guards]
    firsts = jnp.cumsum(jnp.asarray([0, *(len(mode.guards) for mode in modes)]))[:-1]
    begin = jnp.concatenate([start[None], told.after[:-1]])
    durations = jnp.diff(told.times, prepend=0.0)
    following = jnp.append(told.modes[1:], told.mode)
    count = jnp.arange(len(told.times))
    following = jnp.where(count == told.n_events - 1, told.mode, following)
    fields = [mode.field for mode in modes]

    def event(product: Array, own: tuple) -> tuple[Array, None]:
        k, state, before, after, duration, pair, next_mode = own
        flow = lax.switch(next_mode, fields, after)
        factor = lax.switch(pair, pairs, state, before, flow, duration)
        return product * jnp.where(k < told.n_events, factor, 1.0), None

    each = (
        count, begin, told.before, told.after, durations, firsts[told.modes] + told.guards,
        following,
    )  # fmt: skip
    return lax.scan(event, jnp.ones((), start.dtype), each)[0]


def _factor(mode: Mode, guard: Guard, options: Options) -> Callable:
    """Return the factor of one mode that this guard ends."""

    def along(z: Array) -> Array:
        y = z[:-2]
        own = jnp.trace(jax.jacfwd(mode.field)(y))
        return jnp.concatenate([mode.field(y), jnp.stack([own, jnp.ones_like(own)])])

    def factor(begin: Array, before: Array, flow: Array, duration: Array) -> Array:
        end = sample_phase(along, jnp.append(begin, jnp.zeros(2)), duration, 2, options)[-1]
        reached = (
            jnp.abs(end[-1] - duration) <= 1e-9 * duration
        )  # otherwise the solver steps were spent
        reset, across = jax.jacfwd(guard.reset)(before), jax.jacfwd(guard.value)(before)
        moves = mode.field(before)
        saltation = reset + jnp.outer(flow - reset @ moves, across) / (across @ moves)
        return jnp.where(reached, jnp.exp(end[-2]) * jnp.linalg.det(saltation), jnp.nan)

    return factor
