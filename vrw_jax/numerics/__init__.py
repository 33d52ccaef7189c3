"""Types, options, trigonometry, settings of JAX, compiled programs, and helper functions for
automatic differentiation and for batches.
"""

from vrw_jax.numerics import batch_sizes
from vrw_jax.numerics.batch_algebra import (
    FusionBarrierFn,
    LaneArray,
    apply_matrix,
    contract_inner_axis,
    evaluate_with_jvps,
    evaluate_with_partial_derivatives,
    invert_small_matrices,
    make_fusion_barrier,
    solve_node_equations,
    sum_with_weights,
)
from vrw_jax.numerics.cubic_minima import (
    evaluate_cubic,
    find_cubic_minimum,
    refine_minimum_location,
)
from vrw_jax.numerics.forward_only import forbid_reverse_mode
from vrw_jax.numerics.options import EngineName, SolverName, StepOptions, make_real_field
from vrw_jax.numerics.status_codes import StatusCode, describe_step_ending
from vrw_jax.numerics.trigonometry import compute_sine_cosine
from vrw_jax.numerics.types import Elementwise, RealInput, Scalar, Vector
from vrw_jax.simd.autodiff import (
    ExecutionWrapper,
    ForwardFunction,
    apply_jacobian,
    compute_square_root,
    enable_all_ad_modes,
    evaluate_with_jacobian,
    make_implicit_jacobian,
    make_zero_tangent,
    with_implicit_derivative,
)
from vrw_jax.simd.batching import (
    BatchFunction,
    apply_function_in_blocks,
    concatenate_tree_rows,
    is_inside_jit,
    make_opaque_loop_condition,
    make_zeros_like_output,
    map_in_batches,
    map_in_numpy_batches,
    run_if_any_element_active,
    select_tree_rows,
    select_trees_by_condition,
    unbatch,
)
from vrw_jax.simd.lane_function import compile_batch_function
from vrw_jax.simd.saved_traces import compile_exported_function, evaluate_by_saved_trace
from vrw_jax.simd.settings import with_default_jax_settings
