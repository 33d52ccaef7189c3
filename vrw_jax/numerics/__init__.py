"""Types, options, trigonometry, and helpers for automatic differentiation and for batches."""

from vrw_jax.numerics import batch_sizes
from vrw_jax.numerics.autodiff import (
    ExecutionWrapper,
    ForwardFunction,
    apply_jacobian,
    enable_all_ad_modes,
    implicit_jacobian,
    value_and_jacobian,
    with_implicit_derivative,
    zero_tangent,
)
from vrw_jax.numerics.batch_algebra import (
    FusionBarrierFn,
    LaneArray,
    apply_matrix,
    contract_axes,
    fusion_barrier,
    invert_small,
    solve_node_equations,
    value_and_jvps,
    value_and_partials,
    weighted_sum,
)
from vrw_jax.numerics.batching import (
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
from vrw_jax.numerics.cubic_minima import (
    MINIMUM_LOCATION_TOLERANCE,
    evaluate_cubic,
    find_cubic_minimum,
)
from vrw_jax.numerics.forward_only import forbid_reverse_mode
from vrw_jax.numerics.options import EngineName, SolverName, StepOptions
from vrw_jax.numerics.status_codes import StatusCode
from vrw_jax.numerics.trigonometry import sine_cosine
from vrw_jax.numerics.types import Elementwise, RealInput, Scalar, Vector
from vrw_jax.validation import raise_for_missing_numerics_name as __getattr__
