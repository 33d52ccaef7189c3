"""Compilation of JAX functions for batches: machine code on CPUs, XLA elsewhere.

The code computes a group of a few lanes (elements of a batch) at a time, in vector registers.
"""

from vrw_jax.simd import code_cache, disk_cache, ffi_primitive, kernel, machine, program
from vrw_jax.simd.array_emitter import DEFAULT_REGISTER_LIMITS, RegisterLimits
from vrw_jax.simd.code_cache import targets_machine_code
from vrw_jax.simd.ffi_primitive import MACHINE_CODE_PRIMITIVE
from vrw_jax.simd.lane_function import (
    CompiledBatchFunction,
    LaneFunction,
    compile_batch_function,
    jit,
)
from vrw_jax.simd.lowering import mark_noinline
from vrw_jax.simd.machine import describe_processor
from vrw_jax.simd.program import (
    compile_wasm_object,
    count_available_cores,
    is_machine_code_available,
    load_saved_machine_code,
)
from vrw_jax.simd.rules import describe_supported_primitives
from vrw_jax.simd.saved_traces import compile_exported_function, evaluate_by_saved_trace
