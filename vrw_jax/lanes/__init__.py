"""Compilation of JAX functions for batches: machine code on CPUs, XLA elsewhere.

The code computes a group of a few lanes (elements of a batch) at a time, in vector registers.
"""

from vrw_jax.lanes import environment, llvm, machine_code, program
from vrw_jax.lanes.array_emitter import MAX_UNROLLED_ENTRIES
from vrw_jax.lanes.autodiff import (
    compute_jacobian_columns,
    differentiate,
    make_leaf_function,
    make_zero_tangent,
)
from vrw_jax.lanes.batching import apply_function_in_blocks, map_in_batches, select_tree_rows
from vrw_jax.lanes.environment import count_available_cores, with_default_jax_settings
from vrw_jax.lanes.lane_function import compile_batch_function, jit, jit_batch
from vrw_jax.lanes.llvm import describe_processor
from vrw_jax.lanes.lowering import describe_supported_primitives, mark_noinline
from vrw_jax.lanes.machine_code import targets_machine_code
from vrw_jax.lanes.program import (
    compile_exported_function,
    compile_wasm_object,
    is_machine_code_available,
    load_saved_machine_code,
)
