"""The point of a branch on a plane across it, by Newton's method from a place nearby."""

import functools
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from vrw_jax.numerics.arclength import (
    AbstractFollowed,
    ArclengthOptions,
    Corrected,
    Linear,
    PathPoint,
    Plane,
    Unknown,
    corrected,
    linear_at,
    parameter_at,
)
from vrw_jax.numerics.lanes import select

AT_ONCE = 1e-2
"""Of the tolerance: after a correction as small the Jacobian, of the trial before it, is exact."""


class Solving(NamedTuple):
    """Where Newton's method is on a plane."""

    now: Corrected
    tries: Int[Array, ""]
    settled: Int[Array, ""]


def to_solve(z: Unknown, plane: Plane) -> Solving:
    """Before its first iteration."""
    n, flat, none = plane.x.shape[0], jax.tree.map(jnp.zeros_like, z), jnp.zeros((), jnp.int32)
    nothing = jnp.zeros((n, n), plane.x.dtype)
    first = Corrected(z, plane.share, jnp.ones_like(plane.share), flat, nothing)
    return Solving(first, none, none)


def unsolved(options: ArclengthOptions, on: Solving) -> Array:
    """Whether another one is wanted."""
    return (on.settled < 2) & (on.tries < options.iterations) & jnp.isfinite(on.now.size)


def nearer(
    followed: AbstractFollowed,
    options: ArclengthOptions,
    bounds: Array,
    plane: Plane,
    on: Solving,
    linear: Linear,
) -> Solving:
    """After it."""
    now = on.now
    following = corrected(followed, linear, bounds, plane, now.z, now.share)
    # A trial that went astray stands still: no lane may hand its neighbours a NaN.
    sound = jnp.isfinite(following.size)
    following = select(sound, following, now)._replace(size=following.size)
    counts = jnp.where(following.size < AT_ONCE * options.tolerance, 2, 1)
    settled = jnp.where(following.size < options.tolerance, on.settled + counts, 0)
    return Solving(following, on.tries + 1, settled)


def solution(
    followed: AbstractFollowed, wheel: Any, bounds: Array, on: Solving
) -> tuple[PathPoint, Bool[Array, ""]]:
    """The point that it has come to, and whether that is one."""
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
    """The point of the branch on a plane, from the plane's place and z near it; whether found.

    Once converged, Newton's method goes on for one more iteration, unless its correction has
    become nothing: the Jacobian is then as exact as the point.
    """

    def iterate(on: Solving) -> Solving:
        linear = linear_at(followed, wheel, bounds, on.now.z, on.now.share)
        return nearer(followed, options, bounds, plane, on, linear)

    open_ = functools.partial(unsolved, options)
    return solution(followed, wheel, bounds, lax.while_loop(open_, iterate, to_solve(z, plane)))
