"""Machine code that runs: on NumPy arrays by all cores, or called by saved JAX programs."""

import ctypes
import functools
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from vrw_jax.lanes import fallback
from vrw_jax.lanes.array_emitter import LANE_AXIS_SENTINEL, MAX_UNROLLED_ENTRIES
from vrw_jax.lanes.code_cache import (
    LaneProgram,
    MachineCode,
    get_lane_program,
    load_machine_code,
    trace_for_machine_code,
)
from vrw_jax.lanes.ffi_primitive import (
    LOADED_CODE_BY_FFI_TARGET,
    MACHINE_CODE_PRIMITIVE,
    LaneCall,
    register_machine_code,
)
from vrw_jax.lanes.kernel import LANE_KERNEL_NAME, write_llvm_kernel
from vrw_jax.lanes.llvm_library import is_llvmlite_installed
from vrw_jax.lanes.machine import (
    LoadedMachineCode,
    compile_llvm_for_webassembly,
    has_512_bit_vectors,
)

LANES_PER_256_BITS = {8: 4, 4: 8}
"""Number of lanes in 256 bits by the size of a number in bytes.

A vector has 256 bits, or 512 bits on processors with such registers.
"""
VECTORS_PER_GROUP = 2
"""Number of vectors of 256 bits in a group of lanes that `run_machine_code` computes at a time.

One vector computes during the latency of the other. The results are bitwise those of one vector,
which LLVM compiles in 40 % of the time. A batch that fits into one vector has code for one,
unless that for two is known already.
"""
LANE_GROUPS_PER_TASK = 64
"""Number of groups of lanes in one task of a thread.

The value is chosen because the start of a task then takes a negligible time.
"""


ArgumentTypes = tuple[tuple[tuple[int, ...] | None, np.dtype], ...]
"""Shapes without lanes and dtypes of arguments. The shape of a number without lanes is None."""
GetProgram = Callable[[ArgumentTypes, int], LaneProgram]
"""Function that returns machine code for types of arguments and a number of lanes per group."""


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
    get_program = lambda argument_types, lanes_per_group: get_lane_program(
        lambda x: x + 1.0,
        make_argument_shapes(argument_types),
        None,
        lanes_per_group,
        MAX_UNROLLED_ENTRIES,
    )
    increment = lambda x: call_machine_code(get_program, [x], _raise_error)
    with jax.ensure_compile_time_eval():
        try:
            test_program_results = jax.jit(increment)(jnp.arange(3.0))
        except Exception as call_error:  # XLA and LLVM may raise any exception.
            fallback.disable_machine_code(call_error)
            return False
        if test_program_results.tolist() != [1.0, 2.0, 3.0]:
            fallback.disable_machine_code("XLA calls it in another way")
            return False
    return True


def _raise_error(compilation_error: Exception) -> Any:
    raise compilation_error


def make_argument_shapes(argument_types: ArgumentTypes) -> list[jax.ShapeDtypeStruct]:
    """Return the shapes and dtypes for which a function of lanes is traced."""
    return [
        jax.ShapeDtypeStruct(() if shape is None else (*shape, LANE_AXIS_SENTINEL), dtype)
        for shape, dtype in argument_types
    ]


def count_lanes_per_256_bits(argument_leaves: Sequence[Any]) -> int:
    """Return how many lanes of the widest floating-point argument fit into 256 bits."""
    sizes = [x.dtype.itemsize for x in argument_leaves if x.dtype.kind == "f"]
    return LANES_PER_256_BITS[max(sizes) if sizes else jnp.zeros(()).dtype.itemsize]


def call_machine_code(
    get_program: GetProgram,
    argument_leaves: Sequence[Any],
    replace_code: Callable[[Exception], Callable],
) -> Any:
    """Return the results of a function, computed by machine code that a JAX program calls.

    The last axis of the arguments is the lane axis. The first array must have lanes; scalars are
    the same for all lanes. A single lane has separate code, which computes no
    other lanes and gives the same bits. The call has no derivatives, works on CPUs only, and uses
    one core.

    - `replace_code`: function of an error of the compilation, see `LaneCall`.
    """
    n_lanes = argument_leaves[0].shape[-1]
    for argument_shape in map(jnp.shape, argument_leaves):
        if argument_shape and argument_shape[-1] != n_lanes:
            raise ValueError(
                f"An argument has the shape {argument_shape}, but the first one has {n_lanes} "
                "lanes: give every array the same number on its last axis, or a number without "
                "axes."
            )
    lanes_per_group = count_lanes_per_256_bits(argument_leaves)
    if has_512_bit_vectors():
        lanes_per_group *= 2
    # A single lane has separate code, because a full group would compute lanes that are not
    # needed.
    if n_lanes == 1:
        lanes_per_group = 1
    n_padding_lanes = -n_lanes % lanes_per_group
    argument_types = tuple((x.shape[:-1] if x.ndim else None, x.dtype) for x in argument_leaves)
    lane_program = get_program(argument_types, lanes_per_group)
    if n_padding_lanes:
        pad_with_last_lane = lambda x: jnp.concatenate(
            [x, jnp.repeat(x[..., -1:], n_padding_lanes, -1)], -1
        )
        argument_leaves = [pad_with_last_lane(x) if jnp.ndim(x) else x for x in argument_leaves]
    padded_result_shapes = tuple(
        jax.ShapeDtypeStruct((*shape_without_lanes, n_lanes + n_padding_lanes), result_dtype)
        for shape_without_lanes, result_dtype in lane_program.result_shapes_and_dtypes
    )
    padded_results = MACHINE_CODE_PRIMITIVE.bind(
        *argument_leaves,
        lane_call=LaneCall(lane_program, replace_code),
        result_shapes=padded_result_shapes,
    )
    return jax.tree.unflatten(
        lane_program.result_structure, [x[..., :n_lanes] for x in padded_results]
    )


def run_machine_code(
    get_program: GetProgram,
    choose_lanes_per_group: Callable[[ArgumentTypes, Sequence[int]], int],
    argument_leaves: Sequence[np.ndarray],
) -> Any:
    """Return the results of a function of NumPy arrays, computed on all cores of the process.

    The last axis of the arrays is the lane axis; arrays without axes are the same for all lanes.
    The results of a lane are bitwise the same whatever the other lanes are. A few lanes have code
    for one vector, unless that for several vectors is known already.
    """
    n_lanes = next(x.shape[-1] for x in argument_leaves if x.ndim)
    # An empty batch needs no code: that of groups of one lane is compiled when it is needed.
    lanes_per_vector = count_lanes_per_256_bits(argument_leaves)
    lanes_per_group = VECTORS_PER_GROUP * lanes_per_vector if n_lanes else 1
    argument_types = tuple((x.shape[:-1] if x.ndim else None, x.dtype) for x in argument_leaves)
    if 0 < n_lanes <= lanes_per_vector < lanes_per_group:
        lanes_per_group = choose_lanes_per_group(
            argument_types, (lanes_per_vector, lanes_per_group)
        )
    lane_program = get_program(argument_types, lanes_per_group)
    if n_lanes == 0:
        result_types = lane_program.result_shapes_and_dtypes
        empty_results = [np.empty((*shape, 0), dtype) for shape, dtype in result_types]
        return jax.tree.unflatten(lane_program.result_structure, empty_results)
    machine_code = lane_program.machine_code
    n_lane_groups = -(-n_lanes // lanes_per_group)
    n_padded_lanes = n_lane_groups * lanes_per_group
    pad_lanes = lambda x: [(0, 0)] * (x.ndim - 1) + [(0, n_padded_lanes - n_lanes)]
    # The last lane is repeated until the last group is full.
    padded_arguments = [
        np.ascontiguousarray(  # The order of a transposed array outlives its padding.
            np.pad(x, pad_lanes(x), "edge") if x.ndim and n_padded_lanes > n_lanes else x
        )
        for x in argument_leaves
    ]
    padded_results = [
        np.empty((*shape_without_lanes, n_padded_lanes), result_dtype)
        for shape_without_lanes, result_dtype in lane_program.result_shapes_and_dtypes
    ]
    run_lane_kernel = _load_lane_kernel(machine_code.ffi_target_name, machine_code)
    input_pointer_table = _make_pointer_table(padded_arguments)
    output_pointer_table = _make_pointer_table(padded_results)
    compute_lane_groups_of_task = lambda first_lane_group: run_lane_kernel(
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
    return jax.tree.unflatten(
        lane_program.result_structure, [x[..., :n_lanes] for x in padded_results]
    )


_lane_kernels: dict[str, tuple[Callable, LoadedMachineCode]] = {}
"""Kernels that are loaded for calls with NumPy arrays, by the name of their code."""


def _load_lane_kernel(code_name: str, machine_code: MachineCode) -> Callable:
    if code_name not in _lane_kernels:
        loaded_code = LoadedMachineCode(machine_code.object_code_future.result())
        c_function_type = ctypes.CFUNCTYPE(None, *[ctypes.c_void_p] * 2, *[ctypes.c_int64] * 3)
        run_lane_kernel = c_function_type(loaded_code.find_function_address(LANE_KERNEL_NAME))
        _lane_kernels[code_name] = run_lane_kernel, loaded_code
    return _lane_kernels[code_name][0]


def _make_pointer_table(numpy_arrays: Sequence[np.ndarray]) -> Any:
    """Return a C array of pointers to the data of the NumPy arrays."""
    return (ctypes.c_void_p * len(numpy_arrays))(*(x.ctypes.data for x in numpy_arrays))


def compile_wasm_object(
    lane_function: Callable[..., Any],
    n_scalars: int,
    n_rows_by_array: Sequence[int],
    exported_function_name: str,
    max_unrolled_entries: int = MAX_UNROLLED_ENTRIES,
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
    closed_jaxpr, _ = trace_for_machine_code(lane_function, *argument_shapes)
    return compile_llvm_for_webassembly(
        write_llvm_kernel(closed_jaxpr, 2, max_unrolled_entries),
        LANE_KERNEL_NAME,
        exported_function_name,
    )


def load_saved_machine_code(code_names: Sequence[str]) -> bool:
    """Load the saved machine code of all `code_names`, so that JAX programs can call it.

    Return whether the code of every name is available.
    """
    for code_name in set(code_names) - LOADED_CODE_BY_FFI_TARGET.keys():
        machine_code = load_machine_code(code_name)
        if machine_code is not None:
            register_machine_code(machine_code)
    return LOADED_CODE_BY_FFI_TARGET.keys() >= set(code_names)


def count_available_cores() -> int:
    """Return the number of processor cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
