"""Provide fixed points of maps, Floquet multipliers, pseudo-arclength continuation,
test functions.
"""

from vrw_jax.continuation import arclength, floquet
from vrw_jax.continuation.arclength import (
    AbstractContinuationProblem,
    ArclengthOptions,
    ContinuationPoint,
    ContinuationResult,
    ContinuationSetup,
    ContinuationStatus,
    CorrectorPlane,
    FixedPointProblem,
    NewtonStep,
    ProblemUnknowns,
    SectionStateVector,
)
from vrw_jax.continuation.batched_continuation import (
    continue_branches_uncompiled,
    solve_on_planes,
)
from vrw_jax.continuation.fixed_points import (
    UNIT_MULTIPLIER_ADVICE,
    FixedPointResult,
    check_state_units,
    check_vector_map,
    estimate_state_units,
    has_unit_multiplier,
    solve_fixed_point,
    solve_fixed_point_implicit,
)
from vrw_jax.continuation.floquet import (
    MULTIPLIER_TOLERANCES,
    floquet_multipliers,
)
from vrw_jax.continuation.sign_changes import (
    BIFURCATION_NAMES,
    evaluate_bifurcation_functions,
    find_sign_changes,
    has_unit_circle_pair,
    locate_function_roots,
)
from vrw_jax.continuation.test_functions import (
    AbstractTestFunction,
    TestFunctionCurve,
    TestFunctionNewtonStep,
    TestFunctionPoint,
    compute_offset_bifurcation_margins,
)

__all__ = (
    "ArclengthOptions",
    "FixedPointProblem",
    "FixedPointResult",
    "floquet_multipliers",
    "solve_fixed_point",
)  # The list of `help(vrw_jax.continuation)`.
