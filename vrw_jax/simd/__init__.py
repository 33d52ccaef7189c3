"""Compilation of JAX traces to machine code with LLVM, for a few lanes per vector."""

from vrw_jax.simd.arrays import SMALL
from vrw_jax.simd.code import tracing
from vrw_jax.simd.ffi import CALLED
from vrw_jax.simd.machine import processor
from vrw_jax.simd.program import at_hand, lane_function, lane_program, serves, web_object
from vrw_jax.simd.rules import primitives
from vrw_jax.simd.trace import apart
