"""Points of branches on constraint planes, and concurrent branches outside of compiled code.

Where a map is machine code for many points together, nothing is traced: linearizations are called
from outside of compiled code, and `arclength` performs the rest of each iteration.
"""

import functools
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from vrw_jax.numerics.arclength import (
    AbstractFollowed,
    ArclengthOptions,
    Corrected,
    Linear,
    PathPoint,
    Plane,
    Track,
    Unknown,
    begun,
    corrected,
    going,
    linear_at,
    parameter_at,
    track_of,
    turned,
)
from vrw_jax.numerics.lanes import select, taken

AT_ONCE = 1e-2
"""Fraction of the tolerance below which the last Jacobian is reused.

It is chosen because after a correction this small, the Jacobian of the trial before it is exact.
"""


class Solving(NamedTuple):
    """State of Newton's method for a point on a plane."""

    now: Corrected
    tries: Int[Array, ""]
    settled: Int[Array, ""]


def to_solve(z: Unknown, plane: Plane) -> Solving:
    """Return the initial state of Newton's method on a plane."""
    n, flat, none = plane.x.shape[0], jax.tree.map(jnp.zeros_like, z), jnp.zeros((), jnp.int32)
    nothing = jnp.zeros((n, n), plane.x.dtype)
    first = Corrected(z, plane.share, jnp.ones_like(plane.share), flat, nothing)
    return Solving(first, none, none)


def unsolved(options: ArclengthOptions, on: Solving) -> Array:
    """Return whether Newton's method needs another iteration."""
    return (on.settled < 2) & (on.tries < options.iterations) & jnp.isfinite(on.now.size)


def nearer(
    followed: AbstractFollowed,
    options: ArclengthOptions,
    bounds: Array,
    plane: Plane,
    on: Solving,
    linear: Linear,
) -> Solving:
    """Return the state after one Newton iteration."""
    now = on.now
    following = corrected(followed, linear, bounds, plane, now.z, now.share)
    # A trial that is not finite keeps its state, so that no NaN reaches other batch elements.
    sound = jnp.isfinite(following.size)
    following = select(sound, following, now)._replace(size=following.size)
    counts = jnp.where(following.size < AT_ONCE * options.tolerance, 2, 1)
    settled = jnp.where(following.size < options.tolerance, on.settled + counts, 0)
    return Solving(following, on.tries + 1, settled)


def solution(
    followed: AbstractFollowed, wheel: Any, bounds: Array, on: Solving
) -> tuple[PathPoint, Bool[Array, ""]]:
    """Return the point of a finished solve, and whether it converged."""
    now, p = on.now, parameter_at(on.now.share, bounds)
    valid = followed.valid(wheel, now.z, p)
    return PathPoint(now.z, p, (), jnp.ones_like(p), now.jacobian, valid), on.settled >= 1


@eqx.filter_jit
def solve(
    followed: AbstractFollowed,
    options: ArclengthOptions,
    wheel: Any,
    z: Unknown,
    plane: Plane,
    bounds: Float[Array, "2"],
) -> tuple[PathPoint, Bool[Array, ""]]:
    """Solve for the point of the branch on a plane, from z near it; return it and whether it
    converged.

    Once converged, Newton's method takes one more iteration, unless its correction is negligible:
    the Jacobian is then as exact as the point.
    """

    def iterate(on: Solving) -> Solving:
        linear = linear_at(followed, wheel, bounds, on.now.z, on.now.share)
        return nearer(followed, options, bounds, plane, on, linear)

    open_ = functools.partial(unsolved, options)
    return solution(followed, wheel, bounds, lax.while_loop(open_, iterate, to_solve(z, plane)))


def follow_many(
    followed: AbstractFollowed,
    options: ArclengthOptions,
    wheels: Any,
    z: Unknown,
    p: Float[Array, " branches"],
    bounds: Float[Array, "2"],
    directions: Float[Array, " branches"],
    wanted: Bool[Array, " branches"],
) -> Track:
    """Continue branches as `arclength.continue_from` does, outside of compiled code."""
    on, rows = begun(followed, options, z, p, bounds, directions, wanted), jnp.arange(len(p))
    while np.any(open_ := np.asarray(_going(on))):
        trial = on[0].trial
        linears = _linear_of(followed, wheels, bounds, trial.z, trial.share, open_)
        on = _turned(followed, options, wheels, bounds, directions, rows, on, linears)
    return track_of(on)


def _linear_of(
    followed: AbstractFollowed, wheels: Any, bounds: Array, z: Unknown, share: Array, some: Any
) -> Linear:
    """Return the Newton steps of the selected branches; those of the others are NaN."""
    low, high = np.asarray(bounds)
    p = low + (high - low) * np.asarray(share)
    there = followed.linearise(*jax.device_put(taken((wheels, z, p), some)))
    blank = lambda x: np.full((len(some), *x.shape[1:]), np.nan)
    whole = jax.tree.map(blank, there)
    for to, x in zip(jax.tree.leaves(whole), jax.tree.leaves(there), strict=True):
        to[some] = x
    return jax.device_put(whole)


def solve_many(
    followed: AbstractFollowed,
    options: ArclengthOptions,
    wheels: Any,
    z: Unknown,
    planes: Plane,
    bounds: Float[Array, "2"],
) -> tuple[PathPoint, Bool[Array, " many"]]:
    """Solve for many points as `solve_on_plane` does; all arrays have a leading axis."""
    on = _to_solve_many(z, planes)
    while np.any(open_ := np.asarray(_unsolved(options, on))):
        linear = _linear_of(followed, wheels, bounds, on.now.z, on.now.share, open_)
        on = _nearer_many(followed, options, bounds, planes, on, linear)
    return _solutions(followed, wheels, bounds, on)


_going: Any = eqx.filter_jit(going)
_turned: Any = eqx.filter_jit(turned)
_to_solve_many: Any = eqx.filter_jit(jax.vmap(to_solve))
_unsolved: Any = eqx.filter_jit(unsolved)


@eqx.filter_jit
def _solutions(followed: AbstractFollowed, wheels: Any, bounds: Array, on: Solving) -> Any:
    return jax.vmap(lambda wheel, on: solution(followed, wheel, bounds, on))(wheels, on)


@eqx.filter_jit
def _nearer_many(
    followed: AbstractFollowed, options: Any, bounds: Array, planes: Plane, *of: Any
) -> Solving:
    def one(plane: Plane, on: Solving, linear: Linear) -> Solving:
        later = nearer(followed, options, bounds, plane, on, linear)
        return select(unsolved(options, on), later, on)

    return jax.vmap(one)(planes, *of)
