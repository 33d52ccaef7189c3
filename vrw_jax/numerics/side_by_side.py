"""Branches side by side, whose linearisations are called from outside of compiled code.

Where a map is machine code that takes many points at once, nothing is to be traced; the rest of
each iteration is `arclength`'s.
"""

from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Bool, Float

from vrw_jax.numerics.arclength import (
    AbstractFollowed,
    ArclengthOptions,
    Followed,
    Linear,
    PathPoint,
    Plane,
    Track,
    Unknown,
    begun,
    going,
    track_of,
    turned,
)
from vrw_jax.numerics.lanes import select, taken
from vrw_jax.numerics.on_plane import Solving, nearer, solution, to_solve, unsolved


def follow_many(
    followed: AbstractFollowed,
    options: ArclengthOptions,
    wheels: Any,
    z: Unknown,
    p: Float[Array, " branches"],
    bounds: Float[Array, "2"],
    directions: Float[Array, " branches"],
) -> Track:
    """`arclength.follow`."""
    on = begun(followed, options, z, p, bounds, directions)
    while np.any(open_ := np.asarray(_going(on))):
        trial = on[0].trial
        linears = _linear_of(followed, wheels, bounds, trial.z, trial.share, open_)
        on = _turned(followed, options, wheels, bounds, directions, on, linears)
    return track_of(on)


@eqx.filter_jit
def _turned(followed: Any, options: Any, wheels: Any, bounds: Array, *of: Any) -> Followed:
    return turned(followed, options, wheels, bounds, *of)


def _linear_of(
    followed: AbstractFollowed, wheels: Any, bounds: Array, z: Unknown, share: Array, some: Any
) -> Linear:
    """Of `some` of many, the others without numbers."""
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
    """`solve` side by side, all arrays with a leading axis."""
    on = _to_solve_many(z, planes)
    while np.any(open_ := np.asarray(_unsolved(options, on))):
        linear = _linear_of(followed, wheels, bounds, on.now.z, on.now.share, open_)
        on = _nearer_many(followed, options, bounds, planes, on, linear)
    return _solutions(followed, wheels, bounds, on)


_going: Any = eqx.filter_jit(going)
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
