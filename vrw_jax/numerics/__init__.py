"""Numerical methods for any system: hybrid flows, collocation, fixed points and continuation.

The entry points for any vector field, guards and resets are `simulate_hybrid`, `solve_fixed_point`,
`linearize_segments` with `product_multipliers`, `flow_jacobian_determinant`, `arclength` and
`enumerate_lcp_solutions`. The page docs/any_system.md shows examples.
"""

from vrw_jax.numerics import arclength, floquet
from vrw_jax.numerics.arclength import (
    AbstractContinuationProblem,
    ArclengthOptions,
    ConstraintPlane,
    ContinuationPoint,
    ContinuationStatus,
    FixedPointProblem,
    NewtonStep,
    SectionVector,
    Unknowns,
)
from vrw_jax.numerics.codes import StatusCode
from vrw_jax.numerics.collocation import (
    CollocationPhase,
    CollocationSolution,
    CycleLinearization,
    PhaseConstants,
    PhasePassage,
    PhasePoint,
    PhaseSequence,
    estimate_mesh_error,
    linearize_cycle,
    reconstruct_step,
)
from vrw_jax.numerics.complementarity import LCPStatus, enumerate_lcp_solutions
from vrw_jax.numerics.derivatives import (
    ExecutionWrapper,
    ForwardFunction,
    apply_jacobian,
    enable_all_ad_modes,
    implicit_jacobian,
    value_and_jacobian,
    with_implicit_derivative,
    zero_tangent,
)
from vrw_jax.numerics.events import (
    PhaseEnd,
    VectorField,
    integrate_phase,
    make_solver,
    sample_phase,
)
from vrw_jax.numerics.floquet import floquet_multipliers
from vrw_jax.numerics.gauss import (
    DOUBLE_END_WEIGHTS,
    DOUBLE_INTEGRATION_MATRIX,
    END_WEIGHTS,
    GAUSS_NODES,
    INTEGRATION_MATRIX,
    N_GAUSS_NODES,
    PhaseMesh,
    differentiation_matrix,
    integration_weights,
    lagrange_weights,
    mesh_transfer_matrix,
)
from vrw_jax.numerics.hybrid import Guard, Mode, Termination, simulate_hybrid, time_errors
from vrw_jax.numerics.lane_algebra import LaneArray, value_and_partials
from vrw_jax.numerics.lane_minima import MarginFunctions
from vrw_jax.numerics.lanes import (
    BatchFunction,
    concat_rows,
    is_inside_jit,
    make_blockwise,
    map_in_batches,
    map_in_numpy_batches,
    opaque_condition,
    run_if_any,
    take_rows,
    tree_where,
    unbatch,
    zeros_like_output,
)
from vrw_jax.numerics.levels import (
    AbstractTestFunction,
    TestFunctionCurve,
    TestFunctionNewtonStep,
    TestFunctionPoint,
    offset_bifurcation_margins,
)
from vrw_jax.numerics.march import (
    BatchPhase,
    integrate_batch_phase,
    sample_at_equal_times,
    sample_batch_phase,
)
from vrw_jax.numerics.minima import GUARD_ROUNDOFF_EPS, MonitoredFunctions, StateVector
from vrw_jax.numerics.newton import FixedPointResult, solve_fixed_point, solve_fixed_point_implicit
from vrw_jax.numerics.options import EngineName, StepOptions
from vrw_jax.numerics.roots import (
    BIFURCATION_NAMES,
    evaluate_bifurcation_functions,
    find_sign_changes,
    has_unit_circle_pair,
    locate_zeros,
)
from vrw_jax.numerics.saltation import flow_jacobian_determinant
from vrw_jax.numerics.segments import product_multipliers, segment_maps
from vrw_jax.numerics.side_by_side import continue_many_from, solve_many_on_planes, solve_on_plane
from vrw_jax.numerics.tableaus import (
    ButcherTableau,
    StageAcceleration,
    StageState,
    find_dip,
    fit_guard_parabola,
    load_explicit_tableau,
    real_stability_limit,
    step_size_factor,
)
from vrw_jax.numerics.tangents import ImplicitDynamics, with_batched_jvp
from vrw_jax.numerics.trig import sine_cosine
from vrw_jax.numerics.types import Elementwise, RealInput, Scalar, Vector
