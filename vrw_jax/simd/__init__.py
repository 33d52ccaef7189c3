"""Compilation of JAX traces to machine code for CPUs with LLVM. The code computes a group of a few
lanes (elements of a batch) at a time, in vector registers.
"""

from vrw_jax.simd import code_cache, ffi_primitive, kernel, machine, program
from vrw_jax.simd.array_emitter import DEFAULT_REGISTER_LIMITS, RegisterLimits
from vrw_jax.simd.code_cache import targets_machine_code
from vrw_jax.simd.ffi_primitive import MACHINE_CODE_PRIMITIVE
from vrw_jax.simd.lowering import mark_noinline
from vrw_jax.simd.machine import describe_processor
from vrw_jax.simd.program import (
    compile_lane_function,
    compile_lane_program,
    compile_wasm_object,
    count_available_cores,
    is_machine_code_available,
    load_saved_machine_code,
)
from vrw_jax.simd.rules import describe_supported_primitives
