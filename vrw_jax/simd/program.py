"""Compilation of functions over lanes to machine code for CPUs.

XLA on CPU generates a loop over all lanes for every few operations, with results in memory between
them. Its `while` loop runs until the slowest of hundreds of lanes ends. Here the trace of the whole
function becomes one loop over groups of a few lanes, compiled by LLVM. A group's numbers stay in
registers, and a group ends with its own slowest lane. A later process neither traces nor compiles
code that a store contains.
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
from vrw_jax.simd.array_emitter import DEFAULT_LIMITS, LANE_AXIS_SENTINEL, RegisterLimits
from vrw_jax.simd.code_cache import (
    CodeStore,
    MachineCode,
    get_machine_code,
    load_machine_code,
    trace_for_machine_code,
)
from vrw_jax.simd.ffi_primitive import LOADED_BY_NAME, MACHINE_CODE_PRIMITIVE, register_code
from vrw_jax.simd.kernel import KERNEL_NAME, write_module
from vrw_jax.simd.llvm_library import has_llvm
from vrw_jax.simd.machine import LoadedCode, compile_wasm, has_512_bit_vectors

LANES_PER_256_BITS = {np.dtype(np.float64): 4, np.dtype(np.float32): 8}
"""Number of lanes in 256 bits for each float type. A vector has 256 bits, or 512 on processors with
such registers.
"""
GROUPS_PER_TASK = 64
"""Number of groups in one task of a thread, chosen because starting a task then costs little."""


def is_available() -> bool:
    """Return whether functions can be compiled to machine code in this process.

    Machine code needs llvmlite, the CPU as JAX's backend, and a release of JAX with which it works.
    """
    if not has_llvm or jax.default_backend() != "cpu" or fallback.is_disabled():
        return False
    return fallback.is_tested_release() or _can_call_machine_code()


@functools.cache
def _can_call_machine_code() -> bool:
    """Return whether XLA can call a small test program of machine code and gets the correct
    result.
    """
    increment_program = compile_lane_function(
        lambda x: x + 1.0, lambda x: x, "interface check", None
    )
    with jax.ensure_compile_time_eval():
        try:
            results = jax.jit(increment_program)(jnp.arange(3.0))
        except Exception as error:  # XLA and LLVM may raise any exception.
            fallback.disable(error)
            return False
        if results.tolist() != [1.0, 2.0, 3.0]:
            fallback.disable("XLA calls it in another way")
            return False
    return True


def compile_lane_program(
    function: Callable[..., tuple],
    scalar_dtypes: Sequence[np.dtype],
    n_lanes_in: int,
    dtype: np.dtype,
    key: object,
    store: CodeStore | None,
    limits: RegisterLimits = DEFAULT_LIMITS,
) -> Callable[[Sequence[Any], Sequence[np.ndarray]], list[np.ndarray]]:
    """Return a compiled program of `function(scalars, lanes)`.

    Scalars have the types `scalar_dtypes`, and arrays the float type `dtype`. The function must be
    elementwise over lanes, except for loops that end when no lane continues. It returns a flat
    tuple of arrays whose last axis is that of the lanes. The `repr` of `key` identifies everything
    on which its trace depends except shapes: the values in its closure, and its source. Code is
    saved in `store`, if given, and `limits` decides what is kept in registers.

    The program takes NumPy arrays of any equal length, and returns a list of arrays. The results of
    a lane are bitwise the same whatever the other lanes are. The program uses all cores available
    to the process.
    """
    # The group has two vectors of 256 bits, so that one computes during the latency of the other.
    group_width = 2 * LANES_PER_256_BITS[dtype]
    shapes = (
        tuple(jax.ShapeDtypeStruct((), scalar_dtype) for scalar_dtype in scalar_dtypes),
        (jax.ShapeDtypeStruct((LANE_AXIS_SENTINEL,), dtype),) * n_lanes_in,
    )
    try:
        return _LaneProgram(
            get_machine_code(function, shapes, key, group_width, store, limits), group_width
        )
    except Exception as error:
        _require_untested_release(error)
    return _compile_with_xla(function)


def compile_wasm_object(
    function: Callable[..., Any],
    n_scalars: int,
    n_rows_by_array: Sequence[int],
    name: str,
    limits: RegisterLimits = DEFAULT_LIMITS,
) -> bytes:
    """Return `function(*scalars, *arrays)` as object code for WebAssembly, two lanes at a time.

    The arguments are float64: `n_scalars` numbers, and arrays of shapes (rows, lanes) with the
    given numbers of rows. The compiled function `name` takes (inputs, outputs, lanes, begin, end).
    These are tables of pointers to arguments and results, the number of lanes, and the range of
    pairs of lanes to compute. The caller provides `sin` and `cos` if the trace uses them.
    """
    lanes = [jax.ShapeDtypeStruct((n, LANE_AXIS_SENTINEL), np.float64) for n in n_rows_by_array]
    shapes = [jax.ShapeDtypeStruct((), np.float64)] * n_scalars + lanes
    return compile_wasm(
        write_module(trace_for_machine_code(function, *shapes), 2, limits), KERNEL_NAME, name
    )


def compile_lane_function(
    function: Callable[..., Any],
    shape_function: Callable[..., Any],
    key: object,
    store: CodeStore | None,
    limits: RegisterLimits = DEFAULT_LIMITS,
) -> Callable[..., Any]:
    """Return `function`, compiled to machine code, as one call within JAX programs.

    The arguments are trees of arrays whose last axis is that of the lanes. The first array has
    lanes, and numbers without axes are the same for all lanes. The results form a tree, that of
    `shape_function`, which is fast to trace. Other arguments are as in `compile_lane_program`. A
    single lane has separate code, which computes no other lanes and gives the same bits. The call
    has no derivatives, works on CPUs only, and uses the one core that runs the program.
    """

    def call_machine_code(*arrays: Any) -> Any:
        leaves, structure = jax.tree.flatten(arrays)
        n_lanes = leaves[0].shape[-1]
        for shape in (jnp.shape(x) for x in leaves):
            if shape and shape[-1] != n_lanes:
                raise ValueError(
                    f"An argument has the shape {shape}, but the first one has {n_lanes} lanes: "
                    "give every array the same number on its last axis, or a number without axes."
                )
        group_width = LANES_PER_256_BITS[np.dtype(leaves[0].dtype)] * (
            2 if has_512_bit_vectors() else 1
        )
        # A single lane has separate code, because a full group would compute lanes that are not
        # needed.
        lanes_per_group = 1 if n_lanes == 1 else group_width
        n_padding_lanes = -n_lanes % lanes_per_group
        shapes = [
            jax.ShapeDtypeStruct(
                (*x.shape[:-1], LANE_AXIS_SENTINEL) if jnp.ndim(x) else (), jnp.result_type(x)
            )
            for x in leaves
        ]
        flat_function = lambda *leaves: jax.tree.leaves(
            function(*jax.tree.unflatten(structure, leaves))
        )
        try:
            code = get_machine_code(
                flat_function, shapes, (key, str(structure)), lanes_per_group, store, limits
            )
        except Exception as error:
            _require_untested_release(error)
            return function(*arrays)
        if n_padding_lanes:
            pad_with_last = lambda x: jnp.concatenate(
                [x, jnp.repeat(x[..., -1:], n_padding_lanes, -1)], -1
            )
            leaves = [pad_with_last(x) if jnp.ndim(x) else x for x in leaves]
        padded_result_shapes = [
            jax.ShapeDtypeStruct((*leading_shape, n_lanes + n_padding_lanes), result_dtype)
            for leading_shape, result_dtype in code.result_types
        ]
        results = MACHINE_CODE_PRIMITIVE.bind(
            *leaves, code=code, result_shapes=tuple(padded_result_shapes)
        )
        result_structure = jax.tree.structure(jax.eval_shape(shape_function, *arrays))
        return jax.tree.unflatten(result_structure, [x[..., :n_lanes] for x in results])

    return call_machine_code


def _require_untested_release(error: Exception) -> None:
    """Raise the error on a tested release of JAX; on any other release, use XLA from now on."""
    if fallback.is_tested_release():
        raise error
    fallback.disable(error)


def _compile_with_xla(function: Callable[..., tuple]) -> Callable[..., list[np.ndarray]]:
    """Return `function(scalars, lanes)` of NumPy arrays, compiled by XLA."""
    compiled = jax.jit(function)
    return lambda scalars, lanes: [np.asarray(x) for x in compiled(tuple(scalars), tuple(lanes))]


def ensure_loaded(names: Sequence[str], store: CodeStore | None) -> bool:
    """Register the saved machine code of these names, and return whether all of it is available."""
    for name in names:
        code = None if name in LOADED_BY_NAME else load_machine_code(name, store)
        if code is not None:
            register_code(code)
    return all(name in LOADED_BY_NAME for name in names)


class _LaneProgram:
    """Loaded machine code as a function of NumPy arrays."""

    def __init__(self, code: MachineCode, group_width: int) -> None:
        self.result_types, self.group_width = code.result_types, group_width
        self._loaded_code = LoadedCode(code.wait_for_code())
        pointer_type, count_type = ctypes.c_void_p, ctypes.c_int64
        function_type = ctypes.CFUNCTYPE(
            None, pointer_type, pointer_type, count_type, count_type, count_type
        )
        self._run = function_type(self._loaded_code.find_address(KERNEL_NAME))

    def __call__(self, scalars: Sequence[Any], lanes: Sequence[np.ndarray]) -> list[np.ndarray]:
        n_lanes = len(lanes[0])
        n_groups = -(-n_lanes // self.group_width)
        padded_lanes = [_pad_lanes(x, n_groups * self.group_width) for x in lanes]
        scalar_arrays = [np.asarray(x) for x in scalars]
        results = [
            np.empty((*shape, n_groups * self.group_width), result_dtype)
            for shape, result_dtype in self.result_types
        ]
        input_table = _pointer_table([*scalar_arrays, *padded_lanes])
        output_table = _pointer_table(results)
        n_padded_lanes = n_groups * self.group_width
        run_groups = lambda first_group: self._run(
            input_table,
            output_table,
            n_padded_lanes,
            first_group,
            min(first_group + GROUPS_PER_TASK, n_groups),
        )
        group_starts = range(0, n_groups, GROUPS_PER_TASK)
        if len(group_starts) > 1 and _count_cores() > 1:
            with ThreadPoolExecutor(_count_cores()) as pool:
                list(pool.map(run_groups, group_starts))
        else:
            for first_group in group_starts:
                run_groups(first_group)
        return [x[..., :n_lanes] for x in results]


def _pad_lanes(x: np.ndarray, n_padded: int) -> np.ndarray:
    """Return `x` as a contiguous array of `n_padded` numbers, padded with its last number."""
    if len(x) == n_padded:
        return np.ascontiguousarray(x)
    padded_array = np.full(n_padded, x[-1])
    padded_array[: len(x)] = x
    return padded_array


def _pointer_table(arrays: Sequence[np.ndarray]) -> Any:
    """Return a C array of pointers to the arrays' data."""
    return (ctypes.c_void_p * len(arrays))(*(x.ctypes.data for x in arrays))


def _count_cores() -> int:
    """Return the number of cores available to the process."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
