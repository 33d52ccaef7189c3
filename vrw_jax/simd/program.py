"""Compilation of functions over lanes (elements of a batch) to machine code for CPUs.

XLA on a CPU generates a loop over all lanes for every few operations, and stores intermediate
results in memory. XLA's `while` loop runs until the slowest of hundreds of lanes ends. Here the
trace of the whole function becomes one loop over groups of a few lanes, compiled by LLVM. The
values of a group stay in registers, and the loops of a group end with its slowest lane. A later
process neither traces nor compiles code that a store contains.
"""

import ctypes
import functools
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from vrw_jax.simd import fallback
from vrw_jax.simd.array_emitter import DEFAULT_REGISTER_LIMITS, LANE_AXIS_SENTINEL, RegisterLimits
from vrw_jax.simd.code_cache import (
    CodeStore,
    MachineCode,
    get_machine_code,
    load_machine_code,
    trace_for_machine_code,
)
from vrw_jax.simd.ffi_primitive import (
    LOADED_CODE_BY_FFI_TARGET,
    MACHINE_CODE_PRIMITIVE,
    register_machine_code,
)
from vrw_jax.simd.kernel import LANE_KERNEL_NAME, write_llvm_kernel
from vrw_jax.simd.llvm_library import is_llvmlite_installed
from vrw_jax.simd.machine import (
    LoadedMachineCode,
    compile_llvm_for_webassembly,
    has_512_bit_vectors,
)

LANES_PER_256_BITS = {np.dtype(np.float64): 4, np.dtype(np.float32): 8}
"""Number of lanes in 256 bits for each float type.

A vector has 256 bits, or 512 bits on processors with such registers.
"""
LANE_GROUPS_PER_TASK = 64
"""Number of groups of lanes in one task of a thread.

The value is chosen because the start of a task then takes a negligible time.
"""


def is_machine_code_available() -> bool:
    """Return whether functions can be compiled to machine code in this process.

    Machine code needs llvmlite and the CPU as JAX's backend. It also needs a release of JAX with
    which it works.
    """
    if (
        not is_llvmlite_installed
        or jax.default_backend() != "cpu"
        or fallback.is_machine_code_disabled()
    ):
        return False
    return fallback.is_tested_jax_release() or _can_xla_call_machine_code()


@functools.cache
def _can_xla_call_machine_code() -> bool:
    """Return whether XLA can call machine code: whether a small test succeeds."""
    increment_program = compile_lane_function(
        lambda x: x + 1.0, lambda x: x, "interface check", None
    )
    with jax.ensure_compile_time_eval():
        try:
            test_program_results = jax.jit(increment_program)(jnp.arange(3.0))
        except Exception as call_error:  # XLA and LLVM may raise any exception.
            fallback.disable_machine_code(call_error)
            return False
        if test_program_results.tolist() != [1.0, 2.0, 3.0]:
            fallback.disable_machine_code("XLA calls it in another way")
            return False
    return True


def compile_lane_program(
    lane_function: Callable[..., tuple],
    scalar_dtypes: Sequence[np.dtype],
    n_lane_arrays: int,
    lane_dtype: np.dtype,
    trace_key: object,
    code_store: CodeStore | None,
    register_limits: RegisterLimits = DEFAULT_REGISTER_LIMITS,
) -> Callable[[Sequence[Any], Sequence[np.ndarray]], list[np.ndarray]]:
    """Return a compiled program that computes `lane_function(scalars, lanes)`.

    The function must be elementwise over lanes, except for loops that end when no lane continues.
    It returns a flat tuple of arrays whose last axis is the lane axis.

    The program takes `n_lane_arrays` NumPy arrays of any equal length, and returns a list of
    arrays. The results of a lane are bitwise the same whatever the other lanes are. The program
    uses all cores available to the process.

    - `scalar_dtypes`: dtypes of the scalars;
    - `lane_dtype`: float type of the arrays;
    - `trace_key`: object whose `repr` identifies everything on which the trace depends except
      shapes: the values in the function's closure, and its source;
    - `code_store`: store that saves the code; None saves nothing;
    - `register_limits`: limits that decide which arrays are in registers.
    """
    # The group has two vectors of 256 bits, so that one computes during the latency of the other.
    lanes_per_group = 2 * LANES_PER_256_BITS[lane_dtype]
    argument_shapes = (
        tuple(jax.ShapeDtypeStruct((), scalar_dtype) for scalar_dtype in scalar_dtypes),
        (jax.ShapeDtypeStruct((LANE_AXIS_SENTINEL,), lane_dtype),) * n_lane_arrays,
    )
    try:
        return _LoadedLaneProgram(
            get_machine_code(
                lane_function,
                argument_shapes,
                trace_key,
                lanes_per_group,
                code_store,
                register_limits,
            ),
            lanes_per_group,
        )
    except Exception as compilation_error:
        _reraise_on_tested_release(compilation_error)
    xla_program = jax.jit(lane_function)
    return lambda scalar_arguments, lane_arrays: [
        np.asarray(x) for x in xla_program(tuple(scalar_arguments), tuple(lane_arrays))
    ]


def compile_wasm_object(
    lane_function: Callable[..., Any],
    n_scalars: int,
    n_rows_by_array: Sequence[int],
    exported_function_name: str,
    register_limits: RegisterLimits = DEFAULT_REGISTER_LIMITS,
) -> bytes:
    """Return object code for WebAssembly that computes `lane_function(*scalars, *arrays)` for two
    lanes at a time.

    The arguments are `n_scalars` scalars and arrays of shapes (n, lanes), all of type float64; the
    lengths n are `n_rows_by_array`. The compiled function takes (inputs, outputs, lanes, begin,
    end). The first two are tables of pointers to arguments and results. The third is the number of
    lanes. The last two are the range of pairs of lanes to compute. The caller must provide `sin`
    and `cos` if the trace uses them.
    """
    lane_array_shapes = [
        jax.ShapeDtypeStruct((n, LANE_AXIS_SENTINEL), np.float64) for n in n_rows_by_array
    ]
    argument_shapes = [jax.ShapeDtypeStruct((), np.float64)] * n_scalars + lane_array_shapes
    return compile_llvm_for_webassembly(
        write_llvm_kernel(
            trace_for_machine_code(lane_function, *argument_shapes), 2, register_limits
        ),
        LANE_KERNEL_NAME,
        exported_function_name,
    )


def compile_lane_function(
    lane_function: Callable[..., Any],
    result_shape_function: Callable[..., Any],
    trace_key: object,
    code_store: CodeStore | None,
    register_limits: RegisterLimits = DEFAULT_REGISTER_LIMITS,
) -> Callable[..., Any]:
    """Return a function that calls `lane_function`, compiled to machine code, from JAX programs.

    The returned function takes trees of arrays whose last axis is the lane axis. The first array
    must have lanes; scalars are the same for all lanes. The result is a tree of the structure that
    `result_shape_function` returns, which should be fast to trace. `trace_key`, `code_store` and
    `register_limits` are as in `compile_lane_program`. A single lane has separate code, which
    computes no other lanes and gives the same bits. The call has no derivatives, works on CPUs
    only, and uses one core.
    """

    def call_compiled_function(*argument_trees: Any) -> Any:
        argument_leaves, argument_structure = jax.tree.flatten(argument_trees)
        n_lanes = argument_leaves[0].shape[-1]
        for argument_shape in map(jnp.shape, argument_leaves):
            if argument_shape and argument_shape[-1] != n_lanes:
                raise ValueError(
                    f"An argument has the shape {argument_shape}, but the first one has {n_lanes} "
                    "lanes: give every array the same number on its last axis, or a number without "
                    "axes."
                )
        lanes_per_group = LANES_PER_256_BITS[np.dtype(argument_leaves[0].dtype)]
        if has_512_bit_vectors():
            lanes_per_group *= 2
        # A single lane has separate code, because a full group would compute lanes that are not
        # needed.
        if n_lanes == 1:
            lanes_per_group = 1
        n_padding_lanes = -n_lanes % lanes_per_group
        lane_argument_shapes = [
            jax.ShapeDtypeStruct(
                (*x.shape[:-1], LANE_AXIS_SENTINEL) if jnp.ndim(x) else (), jnp.result_type(x)
            )
            for x in argument_leaves
        ]
        flat_lane_function = lambda *argument_leaves: jax.tree.leaves(
            lane_function(*jax.tree.unflatten(argument_structure, argument_leaves))
        )
        try:
            machine_code = get_machine_code(
                flat_lane_function,
                lane_argument_shapes,
                (trace_key, str(argument_structure)),
                lanes_per_group,
                code_store,
                register_limits,
            )
        except Exception as compilation_error:
            _reraise_on_tested_release(compilation_error)
            return lane_function(*argument_trees)
        if n_padding_lanes:
            pad_with_last_lane = lambda x: jnp.concatenate(
                [x, jnp.repeat(x[..., -1:], n_padding_lanes, -1)], -1
            )
            argument_leaves = [pad_with_last_lane(x) if jnp.ndim(x) else x for x in argument_leaves]
        padded_result_shapes = tuple(
            jax.ShapeDtypeStruct((*shape_without_lanes, n_lanes + n_padding_lanes), result_dtype)
            for shape_without_lanes, result_dtype in machine_code.result_shapes_and_dtypes
        )
        padded_results = MACHINE_CODE_PRIMITIVE.bind(
            *argument_leaves, machine_code=machine_code, result_shapes=padded_result_shapes
        )
        result_structure = jax.tree.structure(
            jax.eval_shape(result_shape_function, *argument_trees)
        )
        return jax.tree.unflatten(result_structure, [x[..., :n_lanes] for x in padded_results])

    return call_compiled_function


def _reraise_on_tested_release(compilation_error: Exception) -> None:
    """Raise the error on a tested release of JAX. On any other release, disable machine code
    instead.
    """
    if fallback.is_tested_jax_release():
        raise compilation_error
    fallback.disable_machine_code(compilation_error)


def load_saved_machine_code(ffi_target_names: Sequence[str], code_store: CodeStore | None) -> bool:
    """Load the saved machine code of all `ffi_target_names`, so that JAX programs can call it.

    Return whether the code of every name is available.
    """
    for ffi_target_name in set(ffi_target_names) - LOADED_CODE_BY_FFI_TARGET.keys():
        machine_code = load_machine_code(ffi_target_name, code_store)
        if machine_code is not None:
            register_machine_code(machine_code)
    return LOADED_CODE_BY_FFI_TARGET.keys() >= set(ffi_target_names)


class _LoadedLaneProgram:
    """Callable that runs loaded machine code on NumPy arrays."""

    def __init__(self, machine_code: MachineCode, lanes_per_group: int) -> None:
        self.result_shapes_and_dtypes = machine_code.result_shapes_and_dtypes
        self.lanes_per_group = lanes_per_group
        self._loaded_code = LoadedMachineCode(machine_code.object_code_future.result())
        c_function_type = ctypes.CFUNCTYPE(None, *[ctypes.c_void_p] * 2, *[ctypes.c_int64] * 3)
        self._run_lane_kernel = c_function_type(
            self._loaded_code.find_function_address(LANE_KERNEL_NAME)
        )

    def __call__(
        self, scalar_arguments: Sequence[Any], lane_arrays: Sequence[np.ndarray]
    ) -> list[np.ndarray]:
        n_lanes = len(lane_arrays[0])
        n_lane_groups = -(-n_lanes // self.lanes_per_group)
        n_padded_lanes = n_lane_groups * self.lanes_per_group
        # The last lane is repeated until the last group is full.
        padded_lane_arrays = [
            np.concatenate([x, np.full(n_padded_lanes - n_lanes, x[-1])])
            if n_padded_lanes > n_lanes
            else np.ascontiguousarray(x)
            for x in lane_arrays
        ]
        scalar_arrays = [np.asarray(x) for x in scalar_arguments]
        padded_results = [
            np.empty((*shape_without_lanes, n_padded_lanes), result_dtype)
            for shape_without_lanes, result_dtype in self.result_shapes_and_dtypes
        ]
        input_pointer_table = _make_pointer_table([*scalar_arrays, *padded_lane_arrays])
        output_pointer_table = _make_pointer_table(padded_results)
        compute_lane_groups_of_task = lambda first_lane_group: self._run_lane_kernel(
            input_pointer_table,
            output_pointer_table,
            n_padded_lanes,
            first_lane_group,
            min(first_lane_group + LANE_GROUPS_PER_TASK, n_lane_groups),
        )
        first_lane_groups_of_tasks = range(0, n_lane_groups, LANE_GROUPS_PER_TASK)
        if len(first_lane_groups_of_tasks) > 1 and count_available_cores() > 1:
            with ThreadPoolExecutor(count_available_cores()) as thread_pool:
                list(thread_pool.map(compute_lane_groups_of_task, first_lane_groups_of_tasks))
        else:
            for first_lane_group in first_lane_groups_of_tasks:
                compute_lane_groups_of_task(first_lane_group)
        return [x[..., :n_lanes] for x in padded_results]


def _make_pointer_table(numpy_arrays: Sequence[np.ndarray]) -> Any:
    """Return a C array of pointers to the data of the NumPy arrays."""
    return (ctypes.c_void_p * len(numpy_arrays))(*(x.ctypes.data for x in numpy_arrays))


def count_available_cores() -> int:
    """Return the number of processor cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
