"""Curves in two parameters on which a test function of fixed points is zero, for `arclength`.

The second parameter is added to the unknowns of Newton's method, and the test function to its
equations. A curve is then a branch along the first parameter, which turns back as branches do at
folds.
"""

import abc
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from vrw_jax.continuation.arclength import (
    AbstractContinuationProblem,
    NewtonStep,
    ProblemUnknowns,
    SectionVector,
)
from vrw_jax.continuation.floquet import bifurcation_margins
from vrw_jax.numerics import Elementwise, Scalar

ParameterPair = Float[Array, "2"]
"""Values of the two parameters."""


class TestFunctionNewtonStep(NamedTuple):
    """Newton step at a trial (z, p), and the test function whose zero is continued."""

    correction: ProblemUnknowns  # correction of z at fixed p
    # dz/dp along the curve of fixed points, for both parameters
    tangents: tuple[ProblemUnknowns, ProblemUnknowns]
    jacobian: Float[Array, "n n"]  # Jacobian of the return map
    value: Scalar  # value of the test function at the corrected z
    # derivatives of the value with respect to p along the fixed points
    parameter_gradient: ParameterPair


class AbstractTestFunction(eqx.Module):
    """Base class of test functions of fixed points in two parameters.

    `args` is a pytree with all other inputs.
    """

    @abc.abstractmethod
    def linearize(self, args: Any, z: ProblemUnknowns, p: ParameterPair) -> TestFunctionNewtonStep:
        """Return the Newton step; it is not finite if the map is undefined at (z, p)."""

    @abc.abstractmethod
    def section_state(self, z: ProblemUnknowns) -> SectionVector:
        """Return the section state, which is a part of z."""

    def correction_norm(self, z: ProblemUnknowns, correction: ProblemUnknowns) -> Scalar:
        """Return the norm of a correction, which is compared with the tolerance."""
        return jnp.max(jnp.abs(correction))

    def is_admissible(self, args: Any, z: ProblemUnknowns, p: ParameterPair) -> Bool[Array, ""]:
        """Return whether a converged z satisfies the conditions of its branch."""
        return jnp.all(jnp.isfinite(self.section_state(z)))


class TestFunctionPoint(NamedTuple):
    """Unknowns of a point of the curve: those of the fixed point, and the second parameter."""

    z: ProblemUnknowns
    fraction: Elementwise  # second parameter as a fraction of its range


class TestFunctionCurve(AbstractContinuationProblem):
    """Curve on which a test function is zero, continued along the first of its two parameters.

    Arc lengths include the second parameter as a fraction of its range. The curve ends if this
    fraction leaves [0, 1].
    """

    test_function: AbstractTestFunction
    bounds: tuple[float, float] = eqx.field(static=True)  # bounds of the second parameter

    has_multipliers: ClassVar[bool] = False

    def second_parameter(self, z: TestFunctionPoint) -> Elementwise:
        """Return the second parameter at a point of the curve."""
        lower_bound, upper_bound = self.bounds
        return lower_bound + (upper_bound - lower_bound) * z.fraction

    def linearize(self, args: Any, z: TestFunctionPoint, p: Scalar) -> NewtonStep:
        parameter_range = self.bounds[1] - self.bounds[0]
        newton_step = self.test_function.linearize(
            args, z.z, jnp.stack([p, self.second_parameter(z)])
        )
        derivative_by_first_parameter = newton_step.parameter_gradient[0]
        derivative_by_fraction = parameter_range * newton_step.parameter_gradient[1]
        fraction_change = -newton_step.value / derivative_by_fraction
        fraction_tangent = -derivative_by_first_parameter / derivative_by_fraction
        first_tangent, second_tangent = newton_step.tangents
        add_second_tangent = lambda parameter_change: (
            lambda first_leaf, second_leaf: (
                first_leaf + parameter_range * parameter_change * second_leaf
            )
        )
        correction = jax.tree.map(
            add_second_tangent(fraction_change), newton_step.correction, second_tangent
        )
        tangent = jax.tree.map(add_second_tangent(fraction_tangent), first_tangent, second_tangent)
        # A zero multiplier is added for the fraction; it has no effect.
        jacobian = jnp.pad(newton_step.jacobian, (0, 1))
        return NewtonStep(
            TestFunctionPoint(correction, fraction_change),
            TestFunctionPoint(tangent, fraction_tangent),
            jacobian,
        )

    def section_state(self, z: TestFunctionPoint) -> SectionVector:
        return jnp.append(self.test_function.section_state(z.z), z.fraction)

    def correction_norm(self, z: TestFunctionPoint, correction: TestFunctionPoint) -> Scalar:
        return jnp.maximum(
            self.test_function.correction_norm(z.z, correction.z), jnp.abs(correction.fraction)
        )

    def is_admissible(self, args: Any, z: TestFunctionPoint, p: Scalar) -> Bool[Array, ""]:
        is_inside_parameter_range = (z.fraction >= 0.0) & (z.fraction <= 1.0)
        return is_inside_parameter_range & self.test_function.is_admissible(
            args, z.z, jnp.stack([p, self.second_parameter(z)])
        )


JURY_MARGIN_OFFSET = 1e-6
"""Value of the fold's margin on the curve that represents the fold.

It is chosen above zero because the equations are singular at the fold itself. The parameters turn
at the fold, so their error is the square of this value.
"""


def offset_bifurcation_margins(jacobian: Float[Array, "n n"]) -> Array:
    """Return the bifurcation margins, each zero where one of `BIFURCATION_NAMES` occurs."""
    return bifurcation_margins(jacobian).at[0].add(-JURY_MARGIN_OFFSET)
