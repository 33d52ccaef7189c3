"""Curves in two parameters on which a test function of fixed points is zero, for `arclength`.

The second parameter joins the unknowns of Newton's method, and the test function joins its
equations. A curve is then a branch along the first parameter, through turning points as through
folds.
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
"""Values of the two parameters."""


class LevelLinear(NamedTuple):
    """Newton step at a trial (z, p), and the test function whose zero is continued."""

    correction: Unknown  # of z at fixed p
    columns: tuple[Unknown, Unknown]  # dz/dp along the curve of fixed points
    jacobian: Float[Array, "n n"]  # of the return map
    value: Scalar  # of the test function at the corrected z
    slopes: Pair  # derivatives of the value by p along the fixed points


class AbstractLevel(eqx.Module):
    """Base class of test functions of fixed points in two parameters.

    `args` is a pytree with all other inputs.
    """

    @abc.abstractmethod
    def linearise(self, wheel: Any, z: Unknown, p: Pair) -> LevelLinear:
        """Return all that one iteration needs; it is not finite where the map is undefined."""

    @abc.abstractmethod
    def section(self, z: Unknown) -> Section:
        """Return the section state, a part of z."""

    def size(self, z: Unknown, correction: Unknown) -> Scalar:
        """Return the norm of a correction, its largest entry, which is compared with
        the tolerance.
        """
        return jnp.max(jnp.abs(correction))

    def valid(self, wheel: Any, z: Unknown, p: Pair) -> Bool[Array, ""]:
        """Return whether a converged z satisfies the conditions of its branch."""
        return jnp.all(jnp.isfinite(self.section(z)))


class LevelPoint(NamedTuple):
    """Unknowns of a point of the curve: those of the fixed point, and the second parameter."""

    z: Unknown
    share: Elementwise  # of the second parameter's range


class LevelFollowed(AbstractFollowed):
    """The curve on which a test function is zero, along the first of its parameters.

    Lengths along it include the second parameter as a fraction of its range, which it must not
    leave.
    """

    level: AbstractLevel
    bounds: tuple[float, float] = eqx.field(static=True)  # of the second parameter

    def second(self, z: LevelPoint) -> Elementwise:
        """Return the second parameter at a point of the curve."""
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
        jacobian = jnp.pad(
            told.jacobian, (0, 1)
        )  # a zero multiplier for the fraction has no effect
        return Linear(LevelPoint(correction, share), LevelPoint(column, along), jacobian)

    def section(self, z: LevelPoint) -> Section:
        return jnp.append(self.level.section(z.z), z.share)

    def size(self, z: LevelPoint, correction: LevelPoint) -> Scalar:
        return jnp.maximum(self.level.size(z.z, correction.z), jnp.abs(correction.share))

    def valid(self, wheel: Any, z: LevelPoint, p: Scalar) -> Bool[Array, ""]:
        inside = (z.share >= 0.0) & (z.share <= 1.0)
        return inside & self.level.valid(wheel, z.z, jnp.stack([p, self.second(z)]))


BESIDE_FOLD = 1e-6
"""Value of the fold's margin on the curve that represents the fold.

It is chosen because the equations are singular at the fold itself. The parameters turn at the fold
and are wrong by the square of this value.
"""


def margins_beside_fold(jacobian: Float[Array, "n n"]) -> Array:
    """Return the bifurcation margins, each zero where one of `BIFURCATION_NAMES` occurs."""
    return bifurcation_margins(jacobian).at[0].add(-BESIDE_FOLD)
