"""Functions over lanes as machine code for CPUs, a few lanes at a time from start to end.

XLA on CPU generates a loop over all lanes for every few operations, with results in memory between
them. A `while` runs until the slowest of hundreds ends. Here the trace of the whole function
becomes one loop over groups of a few lanes, compiled by LLVM: a group's numbers stay in registers,
and a group ends with its own slowest lane. A later process neither traces nor compiles code that a
store contains.
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
"""Number of lanes in 256 bits, which is a vector, or half of one on processors with 512 bits."""
GROUPS_PER_TASK = 64
"""Number of groups in one task of a thread, chosen because starting a task then costs little."""


def is_available() -> bool:
    """Return whether machine code is available.

    It needs llvmlite, the CPU as JAX's backend, and a release of JAX with which it works.
    """
    if not has_llvm or jax.default_backend() != "cpu" or fallback.is_disabled():
        return False
    return fallback.is_tested_release() or _can_call_machine_code()


@functools.cache
def _can_call_machine_code() -> bool:
    """Return whether XLA calls a small program of machine code and gets its results."""
    increment = compile_lane_function(lambda x: x + 1.0, lambda x: x, "interface check", None)
    with jax.ensure_compile_time_eval():
        try:
            results = jax.jit(increment)(jnp.arange(3.0))
        except Exception as error:  # whatever XLA or LLVM raises
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
    """Compile `function(scalars, lanes)`: scalars of `scalar_dtypes`, and arrays of the float
    `dtype`.

    The function must be elementwise over lanes, except for loops that end when no lane continues.
    It returns a flat tuple of arrays whose last axis are lanes. The `repr` of `key` identifies
    everything that its trace depends on except shapes: the values in its closure, and its source.
    Code is saved in `store`, if given; `limits` decides what is kept in registers. The program
    takes numpy arrays of any equal length. It returns bitwise the same results for a lane whatever
    the other lanes are, and uses all cores available to the process.
    """
    # Of two vectors of 256 bits, one computes during the latency of the other.
    width = 2 * LANES_PER_256_BITS[dtype]
    shapes = (
        tuple(jax.ShapeDtypeStruct((), kind) for kind in scalar_dtypes),
        (jax.ShapeDtypeStruct((LANE_AXIS_SENTINEL,), dtype),) * n_lanes_in,
    )
    try:
        return _LaneProgram(get_machine_code(function, shapes, key, width, store, limits), width)
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

    The arguments are float64: the given number of scalars, and arrays with the given numbers of
    rows, lanes last. The code's function `name` takes (inputs, outputs, lanes, begin, end): tables
    of pointers to arguments and results, the number of lanes, and the range of pairs of lanes to
    compute. The caller provides `sin` and `cos` if the trace uses them.
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
    """Return `function` of trees of arrays, lanes on their last axis, as one call within JAX
    programs.

    The first array has lanes; numbers without an axis are the same for all lanes. It works like
    `compile_lane_program`, with two differences. The results form a tree, that of `shape_function`,
    which is fast to trace. A single lane has separate code, which computes no other lanes and gives
    the same bits. The call has no derivatives, works on CPUs only, and uses the one core that runs
    the program.
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
        # A single lane has its own code: a full group would compute lanes that are not needed.
        width = 1 if n_lanes == 1 else group_width
        n_missing = -n_lanes % width
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
                flat_function, shapes, (key, str(structure)), width, store, limits
            )
        except Exception as error:
            _require_untested_release(error)
            return function(*arrays)
        if n_missing:
            pad_with_last = lambda x: jnp.concatenate(
                [x, jnp.repeat(x[..., -1:], n_missing, -1)], -1
            )
            leaves = [pad_with_last(x) if jnp.ndim(x) else x for x in leaves]
        out = [
            jax.ShapeDtypeStruct((*n, n_lanes + n_missing), kind) for n, kind in code.result_types
        ]
        results = MACHINE_CODE_PRIMITIVE.bind(*leaves, code=code, result_shapes=tuple(out))
        result_structure = jax.tree.structure(jax.eval_shape(shape_function, *arrays))
        return jax.tree.unflatten(result_structure, [x[..., :n_lanes] for x in results])

    return call_machine_code


def _require_untested_release(error: Exception) -> None:
    """Raise the error on a tested release of JAX; otherwise, use XLA from now on."""
    if fallback.is_tested_release():
        raise error
    fallback.disable(error)


def _compile_with_xla(function: Callable[..., tuple]) -> Callable[..., list[np.ndarray]]:
    """Return `function(scalars, lanes)` of numpy arrays, compiled by XLA."""
    compiled = jax.jit(function)
    return lambda scalars, lanes: [np.asarray(x) for x in compiled(tuple(scalars), tuple(lanes))]


def ensure_loaded(names: Sequence[str], store: CodeStore | None) -> bool:
    """Register saved machine code of these names, and return whether all of it is available."""
    for name in names:
        code = None if name in LOADED_BY_NAME else load_machine_code(name, store)
        if code is not None:
            register_code(code)
    return all(name in LOADED_BY_NAME for name in names)


class _LaneProgram:
    """Machine code for numpy arrays."""

    def __init__(self, code: MachineCode, width: int) -> None:
        self.result_types, self.width = code.result_types, width
        self._loaded_code = LoadedCode(code.wait_for_code())
        pointer, count = ctypes.c_void_p, ctypes.c_int64
        signature = ctypes.CFUNCTYPE(None, pointer, pointer, count, count, count)
        self._run = signature(self._loaded_code.address(KERNEL_NAME))

    def __call__(self, scalars: Sequence[Any], lanes: Sequence[np.ndarray]) -> list[np.ndarray]:
        n = len(lanes[0])
        groups = -(-n // self.width)
        padded_lanes = [_pad_lanes(x, groups * self.width) for x in lanes]
        numbers = [np.asarray(x) for x in scalars]
        results = [
            np.empty((*shape, groups * self.width), kind) for shape, kind in self.result_types
        ]
        input_table = _pointer_table([*numbers, *padded_lanes])
        output_table = _pointer_table(results)
        length = groups * self.width
        run_groups = lambda begin: self._run(
            input_table, output_table, length, begin, min(begin + GROUPS_PER_TASK, groups)
        )
        group_starts = range(0, groups, GROUPS_PER_TASK)
        if len(group_starts) > 1 and _count_cores() > 1:
            with ThreadPoolExecutor(_count_cores()) as pool:
                list(pool.map(run_groups, group_starts))
        else:
            for begin in group_starts:
                run_groups(begin)
        return [x[..., :n] for x in results]


def _pad_lanes(x: np.ndarray, length: int) -> np.ndarray:
    """Return a contiguous array, padded with its last number."""
    if len(x) == length:
        return np.ascontiguousarray(x)
    padded = np.full(length, x[-1])
    padded[: len(x)] = x
    return padded


def _pointer_table(arrays: Sequence[np.ndarray]) -> Any:
    """Return a table of pointers to the arrays' data."""
    return (ctypes.c_void_p * len(arrays))(*(x.ctypes.data for x in arrays))


def _count_cores() -> int:
    """Return the number of cores available to the process."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
