"""Continue curves in two parameters on which a test function of fixed points is zero.

Newton's method has the second parameter as an additional unknown, and the test function as an
additional equation. A curve is then continued by `arclength` in the first parameter. The curve may
turn back like a branch at a fold.
"""

import abc
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from vrw_jax.base.types import Elementwise, Scalar
from vrw_jax.branches.arclength import (
    AbstractContinuationProblem,
    AbstractSectionStateProblem,
    NewtonStep,
    ProblemUnknowns,
    SectionStateVector,
)
from vrw_jax.gaits.floquet import compute_bifurcation_margins

ParameterPair = Float[Array, "2"]
"""Values of the first and the second parameter."""


class TestFunctionNewtonStep(NamedTuple):
    """Newton step at trial unknowns z and trial parameters p, and the value of the test
    function.
    """

    newton_correction: ProblemUnknowns  # of z at fixed p
    # derivatives dz/dp of the fixed point, with both parameters on a leading axis
    parameter_tangents: ProblemUnknowns
    return_map_jacobian: Float[Array, "n n"]  # Jacobian of the return map
    test_function_value: Scalar  # at the corrected z
    # total derivatives of the test function with respect to both parameters
    parameter_gradient: ParameterPair


class AbstractTestFunction(AbstractSectionStateProblem):
    """Base class of test functions that are evaluated at fixed points, in two parameters.

    The argument `z` contains the unknowns of the fixed point. The argument `p` contains the values
    of the two parameters.
    """

    @abc.abstractmethod
    def linearize(self, args: Any, z: ProblemUnknowns, p: ParameterPair) -> TestFunctionNewtonStep:
        """Return the Newton step at (z, p). It is not finite if the map is undefined there."""


class TestFunctionPoint(NamedTuple):
    """Unknowns at a point of the curve: those of the fixed point, and the second parameter."""

    z: ProblemUnknowns
    second_parameter_fraction: Elementwise  # second parameter as a fraction of its range


class TestFunctionCurve(AbstractContinuationProblem):
    """Continuation problem for the curve on which a test function of two parameters is zero.

    The curve is continued in the first parameter. Arc lengths include the second parameter as a
    fraction of its range. The curve ends when this fraction leaves [0, 1].
    """

    test_function: AbstractTestFunction
    second_parameter_bounds: tuple[float, float] = eqx.field(static=True)  # lower and upper bound

    has_multipliers: ClassVar[bool] = False

    def compute_second_parameter(self, z: TestFunctionPoint) -> Elementwise:
        """Return the second parameter at a point of the curve."""
        lower_bound, upper_bound = self.second_parameter_bounds
        return lower_bound + (upper_bound - lower_bound) * z.second_parameter_fraction

    def linearize(self, args: Any, z: TestFunctionPoint, p: Scalar) -> NewtonStep:
        parameter_range = self.second_parameter_bounds[1] - self.second_parameter_bounds[0]
        newton_step = self.test_function.linearize(
            args, z.z, jnp.stack([p, self.compute_second_parameter(z)])
        )
        derivative_by_second_fraction = parameter_range * newton_step.parameter_gradient[1]
        second_fraction_change = -newton_step.test_function_value / derivative_by_second_fraction
        second_fraction_tangent = -newton_step.parameter_gradient[0] / derivative_by_second_fraction
        add_second_tangent = lambda tree, fraction_change: jax.tree.map(
            lambda leaf, tangents: leaf + parameter_range * fraction_change * tangents[1],
            tree,
            newton_step.parameter_tangents,
        )
        fixed_point_correction = add_second_tangent(
            newton_step.newton_correction, second_fraction_change
        )
        fixed_point_tangent = add_second_tangent(
            jax.tree.map(lambda tangents: tangents[0], newton_step.parameter_tangents),
            second_fraction_tangent,
        )
        # The fraction adds a multiplier of zero, which has no effect.
        padded_return_map_jacobian = jnp.pad(newton_step.return_map_jacobian, (0, 1))
        return NewtonStep(
            TestFunctionPoint(fixed_point_correction, second_fraction_change),
            TestFunctionPoint(fixed_point_tangent, second_fraction_tangent),
            padded_return_map_jacobian,
        )

    def section_state(self, z: TestFunctionPoint) -> SectionStateVector:
        return jnp.append(self.test_function.section_state(z.z), z.second_parameter_fraction)

    def correction_norm(self, z: TestFunctionPoint, correction: TestFunctionPoint) -> Scalar:
        return jnp.maximum(
            self.test_function.correction_norm(z.z, correction.z),
            jnp.abs(correction.second_parameter_fraction),
        )

    def is_admissible(self, args: Any, z: TestFunctionPoint, p: Scalar) -> Bool[Array, ""]:
        is_inside_parameter_range = (z.second_parameter_fraction >= 0.0) & (
            z.second_parameter_fraction <= 1.0
        )
        return is_inside_parameter_range & self.test_function.is_admissible(
            args, z.z, jnp.stack([p, self.compute_second_parameter(z)])
        )


JURY_MARGIN_OFFSET = 1e-6
"""Value that the margin to the fold has on the curve by which the fold is represented.

The value is above zero, because the equations are singular at the fold. It is small, because the
error of the parameters is the square of the value.
"""


def compute_offset_bifurcation_margins(return_map_jacobian: Float[Array, "n n"]) -> Array:
    """Return the bifurcation margins, with the margin to the fold reduced by
    `JURY_MARGIN_OFFSET`.
    """
    return compute_bifurcation_margins(return_map_jacobian).at[0].add(-JURY_MARGIN_OFFSET)
