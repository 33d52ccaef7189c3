"""Curves in two parameters on which a quantity of fixed points is zero, for `arclength` to follow.

The second parameter joins what Newton's method moves, and the quantity its equations: a curve is
then a branch along the first, through turning points as through folds.
"""

import abc
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from vrw_jax.numerics.arclength import AbstractFollowed, Linear, Section, Unknown
from vrw_jax.numerics.floquet import bifurcation_margins
from vrw_jax.numerics.types import Elementwise, Scalar

Pair = Float[Array, "2"]
"""Numbers of the two parameters."""


class LevelLinear(NamedTuple):
    """Newton's method at a trial (z, p), and the quantity whose zero is followed."""

    correction: Unknown  # of z at fixed p
    columns: tuple[Unknown, Unknown]  # dz/dp along the fixed points
    jacobian: Float[Array, "n n"]  # of the return map
    value: Scalar  # of the quantity, z corrected
    slopes: Pair  # of it by p, z following


class AbstractLevel(eqx.Module):
    """A quantity of fixed points in two parameters; `wheel` is whatever else they need."""

    @abc.abstractmethod
    def linearise(self, wheel: Any, z: Unknown, p: Pair) -> LevelLinear:
        """All that one iteration needs; not finite where the map can't be evaluated."""

    @abc.abstractmethod
    def section(self, z: Unknown) -> Section:
        """The section's numbers, a part of z."""

    def size(self, z: Unknown, correction: Unknown) -> Scalar:
        """Size of a correction, to be compared with the tolerance: its largest entry."""
        return jnp.max(jnp.abs(correction))

    def valid(self, wheel: Any, z: Unknown, p: Pair) -> Bool[Array, ""]:
        """Whether a converged z is what it stands for."""
        return jnp.all(jnp.isfinite(self.section(z)))


class LevelPoint(NamedTuple):
    z: Unknown
    share: Elementwise  # of the second parameter in its range


class LevelFollowed(AbstractFollowed):
    """The curve on which a level's quantity is zero, along the first of its parameters.

    Lengths along it count the second as a share of its range too; it stays within that.
    """

    level: AbstractLevel
    bounds: tuple[float, float] = eqx.field(static=True)  # of the second parameter

    def second(self, z: LevelPoint) -> Elementwise:
        low, high = self.bounds
        return low + (high - low) * z.share

    def linearise(self, wheel: Any, z: LevelPoint, p: Scalar) -> Linear:
        scale = self.bounds[1] - self.bounds[0]
        told = self.level.linearise(wheel, z.z, jnp.stack([p, self.second(z)]))
        by_first, by_share = told.slopes[0], scale * told.slopes[1]
        share, along = -told.value / by_share, -by_first / by_share
        first, second = told.columns
        beside = lambda change: lambda a, b: a + scale * change * b
        correction = jax.tree.map(beside(share), told.correction, second)
        column = jax.tree.map(beside(along), first, second)
        jacobian = jnp.pad(told.jacobian, (0, 1))  # a multiplier of zero for the share: no bearing
        return Linear(LevelPoint(correction, share), LevelPoint(column, along), jacobian)

    def section(self, z: LevelPoint) -> Section:
        return jnp.append(self.level.section(z.z), z.share)

    def size(self, z: LevelPoint, correction: LevelPoint) -> Scalar:
        return jnp.maximum(self.level.size(z.z, correction.z), jnp.abs(correction.share))

    def valid(self, wheel: Any, z: LevelPoint, p: Scalar) -> Bool[Array, ""]:
        inside = (z.share >= 0.0) & (z.share <= 1.0)
        return inside & self.level.valid(wheel, z.z, jnp.stack([p, self.second(z)]))


BESIDE_FOLD = 1e-6
"""How far from a fold its curve is followed, in the margin that vanishes there: at the fold itself
the equations are singular. The parameters, turning back there, are off by the square of this."""


def margins_beside_fold(jacobian: Float[Array, "n n"]) -> Array:
    """Zero where one of `BIFURCATIONS` is."""
    return bifurcation_margins(jacobian).at[0].add(-BESIDE_FOLD)
