"""Programs that run: machine code on NumPy arrays or inside JAX programs, and JAX programs by key.

Machine code runs on NumPy arrays by all cores, or is called by its name in JAX programs.

JAX's persistent cache avoids compilation but not tracing. To trace a limit cycle with derivatives
takes longer than a scan of thousands of samples. If the persistent cache is on, its folder also
contains traces. The key of a trace contains everything on which the trace depends, including the
library's source code.

Within a process, functions with equal keys (see `keys`) share a compiled program, even if they are
different objects, such as fields and guards of users. Outside of `jax.jit`, JAX compiles a loop
again at each call if its body closes over functions.
"""

import contextlib
import ctypes
import functools
import hashlib
import warnings
from collections import OrderedDict
from collections.abc import Callable, Hashable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextvars import ContextVar
from dataclasses import dataclass, field
from threading import Lock
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import export
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir
from jax.sharding import SingleDeviceSharding

from vrw_jax.lanes import environment as store
from vrw_jax.lanes.array_emitter import LANE_AXIS_SENTINEL, MAX_UNROLLED_ENTRIES
from vrw_jax.lanes.batching import is_inside_jit
from vrw_jax.lanes.environment import count_available_cores, make_fusion_emitter_options
from vrw_jax.lanes.keys import UnresolvableFunctionError, make_key
from vrw_jax.lanes.llvm import (
    LoadedMachineCode,
    compile_llvm_for_webassembly,
    describe_processor,
    has_512_bit_vectors,
    is_llvmlite_installed,
)
from vrw_jax.lanes.machine_code import (
    FFI_HANDLER_NAME,
    LANE_KERNEL_NAME,
    LaneProgram,
    MachineCode,
    get_lane_program,
    load_machine_code,
    trace_for_machine_code,
    write_llvm_kernel,
)

LOADED_CODE_BY_FFI_TARGET: dict[str, LoadedMachineCode] = {}
"""Loaded machine code by the name under which JAX programs call it.

The code stays loaded, because XLA never releases a registered function.
"""
_loaded_code_lock = Lock()


def register_machine_code(machine_code: MachineCode) -> None:
    """Load machine code, and make it callable by its name in JAX programs."""
    object_code = machine_code.object_code_future.result()  # waits until LLVM has compiled it
    with _loaded_code_lock:
        if machine_code.ffi_target_name not in LOADED_CODE_BY_FFI_TARGET:
            loaded_code = LoadedMachineCode(object_code)
            jax.ffi.register_ffi_target(
                machine_code.ffi_target_name,
                jax.ffi.pycapsule(loaded_code.find_function_address(FFI_HANDLER_NAME)),
                platform="cpu",
            )
            LOADED_CODE_BY_FFI_TARGET[machine_code.ffi_target_name] = loaded_code


@dataclass(frozen=True)
class LaneCall:
    """Program that JAX calls, and what it calls if the program has no machine code."""

    lane_program: LaneProgram
    # function of the error, which it raises, or returns the function of the leaves for XLA
    replace_code: Callable[[Exception], Callable] = field(compare=False)

    def lower(self, lowering_context: Any, *call_arguments: Any) -> Any:
        """Register the machine code with XLA, and return the lowering of its call."""
        try:
            machine_code = self.lane_program.machine_code
        except Exception as compilation_error:
            evaluate_by_xla = self.replace_code(compilation_error)
            return mlir.lower_fun(evaluate_by_xla, multiple_results=True)(
                lowering_context, *call_arguments
            )
        register_machine_code(machine_code)
        return jax.ffi.ffi_lowering(machine_code.ffi_target_name)(lowering_context, *call_arguments)


MACHINE_CODE_PRIMITIVE = Primitive("machine_code")
"""JAX primitive that calls machine code from JAX programs.

Only the compilation of the JAX program needs the code, so LLVM can compile the code before it.
"""
MACHINE_CODE_PRIMITIVE.multiple_results = True


MACHINE_CODE_PRIMITIVE.def_abstract_eval(
    lambda *_, result_shapes, **__: [jax.core.ShapedArray(x.shape, x.dtype) for x in result_shapes]
)


_calling_program = jax.jit(
    MACHINE_CODE_PRIMITIVE.bind, static_argnames=("lane_call", "result_shapes")
)
"""Compiled JAX program that only calls machine code."""


@MACHINE_CODE_PRIMITIVE.def_impl
def _call_machine_code(*call_arguments: Any, **static_arguments: Any) -> Any:
    """Return the results of a machine code call outside of `jax.jit`."""
    with jax.disable_jit(False):  # Only a compiled program can call machine code.
        return _calling_program(*call_arguments, **static_arguments)


def _raise_unsupported_transform(*_: Any, **__: Any) -> Any:
    """Raise a NotImplementedError for a JAX transform that machine code does not support."""
    raise NotImplementedError(
        "Machine code can neither be mapped by `jax.vmap` nor differentiated from outside: give "
        "all lanes at once, on the last axis, and for derivatives the function that returns them."
    )


mlir.register_lowering(
    MACHINE_CODE_PRIMITIVE,
    lambda context, *arguments, lane_call, **_: lane_call.lower(context, *arguments),
    platform="cpu",
)
batching.primitive_batchers[MACHINE_CODE_PRIMITIVE] = ad.primitive_jvps[MACHINE_CODE_PRIMITIVE] = (
    _raise_unsupported_transform
)


LATEST_TESTED_JAX_RELEASE = (0, 12)
"""Latest release of JAX (major, minor) with which all tests of machine code pass."""

_machine_code_failure_reasons: list[str] = []
"""Reasons why this process uses XLA instead of machine code. The list is empty as long as machine
code works.
"""


def is_tested_jax_release() -> bool:
    """Return whether machine code has been tested with the installed release of JAX."""
    return jax.__version_info__[:2] <= LATEST_TESTED_JAX_RELEASE


def disable_machine_code(failure_reason: object) -> None:
    """Disable machine code in this process, so that XLA computes instead. Issue a warning the first
    time.
    """
    _machine_code_failure_reasons.append(str(failure_reason))
    if len(_machine_code_failure_reasons) == 1:
        latest_tested_release = ".".join(map(str, LATEST_TESTED_JAX_RELEASE))
        warnings.warn(
            f"machine code does not work with JAX {jax.__version__} ({failure_reason}); XLA "
            "computes instead, which is slower. Machine code is tested up to JAX "
            f"{latest_tested_release}.",
            stacklevel=2,
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
GetProgram = Callable[[ArgumentTypes, Sequence[int]], LaneProgram]
"""Function of types of arguments and possible numbers of lanes per group, see
`get_lane_program`."""


def is_machine_code_available() -> bool:
    """Return whether functions can be compiled to machine code in this process.

    Machine code needs llvmlite and the CPU as JAX's backend. It also needs a release of JAX with
    which it works.
    """
    if (
        not is_llvmlite_installed
        or jax.default_backend() != "cpu"
        or bool(_machine_code_failure_reasons)
    ):
        return False
    return is_tested_jax_release() or _can_xla_call_machine_code()


@functools.cache
def _can_xla_call_machine_code() -> bool:
    """Return whether XLA can call machine code: whether a small test succeeds."""
    get_program = lambda argument_types, numbers_of_lanes: get_lane_program(
        lambda x: x + 1.0,
        make_argument_shapes(argument_types),
        None,
        numbers_of_lanes,
        MAX_UNROLLED_ENTRIES,
    )
    increment = lambda x: call_machine_code(get_program, [x], _raise_error)
    with jax.ensure_compile_time_eval():
        try:
            test_program_results = jax.jit(increment)(jnp.arange(3.0))
        except Exception as call_error:  # XLA and LLVM may raise any exception.
            disable_machine_code(call_error)
            return False
        if test_program_results.tolist() != [1.0, 2.0, 3.0]:
            disable_machine_code("XLA calls it in another way")
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
    lane_program = get_program(argument_types, (lanes_per_group,))
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
    numbers_of_lanes = [VECTORS_PER_GROUP * lanes_per_vector if n_lanes else 1]
    if 0 < n_lanes <= lanes_per_vector < numbers_of_lanes[0]:
        numbers_of_lanes.insert(0, lanes_per_vector)
    argument_types = tuple((x.shape[:-1] if x.ndim else None, x.dtype) for x in argument_leaves)
    lane_program = get_program(argument_types, numbers_of_lanes)
    lanes_per_group = lane_program.lanes_per_group
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
    input_pointer_table, output_pointer_table = (
        (ctypes.c_void_p * len(arrays))(*(x.ctypes.data for x in arrays))
        for arrays in (padded_arguments, padded_results)
    )
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


def compile_exported_function(
    traced_function: Callable,
    example_arguments: tuple,
    target_device: jax.Device,
) -> Callable:
    """Compile `traced_function` on `target_device` for the shapes of `example_arguments`.

    The program is always compiled from the exported trace, whether it was loaded from disk or not.
    All runs therefore compile the same program.
    """
    exported_trace = _load_or_export_trace(traced_function, example_arguments)
    assert exported_trace is not None
    device_sharding = SingleDeviceSharding(target_device)
    argument_shapes = [
        jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=device_sharding)
        for x in exported_trace.in_avals
    ]
    compiled_program = (
        jax.jit(exported_trace.call)
        .lower(*argument_shapes)
        .compile(make_fusion_emitter_options(False))
    )
    return lambda *arguments: compiled_program(*jax.tree.leaves(arguments))


def wrap_with_saved_trace(
    traced_function: Callable, find_key: Callable[..., str | None] | None = None
) -> Callable:
    """Return a function that calls `traced_function` through its saved trace.

    If no trace exists yet, it is exported and saved. `traced_function` is called directly without a
    cache folder, or if JAX cannot export its trace. The returned function is called while a program
    is traced, and it must not be mapped or differentiated. As with `compile_exported_function`,
    first and later runs use the exported trace. `find_key` returns the key of the function and of
    further values.
    """

    def evaluate_saved_trace(*arguments: Any) -> Any:
        if _is_exporting_trace.get() or not store.find_cache_folder():
            return traced_function(*arguments)
        trace = _load_or_export_trace(traced_function, arguments, find_key)
        if trace is None:
            return traced_function(*arguments)
        return trace.call(*jax.tree.leaves(arguments))

    return evaluate_saved_trace


def _load_or_export_trace(
    traced_function: Callable,
    example_arguments: tuple,
    find_key: Callable[..., str | None] | None = None,
) -> export.Exported | None:
    """Return the exported trace of a function, as a function of the flattened arguments.

    The trace is loaded from disk if a record exists. Otherwise the function is traced for the
    shapes of `example_arguments`. The result is None if JAX cannot export the trace.
    """
    argument_leaves, argument_structure = jax.tree.flatten(example_arguments)
    argument_shapes = [
        jax.ShapeDtypeStruct(jnp.shape(x), jnp.result_type(x)) for x in argument_leaves
    ]
    # A trace calls the machine code of one processor, but several may share the folder.
    platform_and_processor = (
        jax.default_backend(),
        describe_processor() if is_machine_code_available() else None,
    )
    try:
        find_key = find_key or functools.partial(make_key, traced_function)
        function_key = find_key(argument_structure)
    except UnresolvableFunctionError:
        function_key = None
    trace_key_parts = (
        function_key,
        [(x.shape, x.dtype.name) for x in argument_shapes],
        platform_and_processor,
        store.describe_trace_environment(),
    )
    cache_record_name = f"vrw_trace_{hashlib.sha256(repr(trace_key_parts).encode()).hexdigest()}"
    cache_record_content = store.load_cache_record(cache_record_name) if function_key else None
    if cache_record_content is not None:
        encoded_ffi_target_names, _, serialized_trace = cache_record_content.partition(b"\n")
        try:
            if load_saved_machine_code(encoded_ffi_target_names.decode().split()):
                return export.deserialize(bytearray(serialized_trace))
        except Exception:  # JAX documents no type of error for bytes that are no trace.
            store.warn_of_unusable_cache_record(f"{cache_record_name} is no trace")
    flattened_function = jax.jit(
        lambda *argument_leaves: traced_function(
            *jax.tree.unflatten(argument_structure, argument_leaves)
        )
    )
    # Cached traces that are called inside become part of this trace.
    export_flag_token = _is_exporting_trace.set(True)
    try:
        # The export below finds this trace in JAX's cache.
        ffi_target_names = sorted(
            _find_ffi_target_names(flattened_function.trace(*argument_shapes).jaxpr)
        )
        disabled_checks = list(map(export.DisabledSafetyCheck.custom_call, ffi_target_names))
        exporter = export.export(flattened_function, disabled_checks=disabled_checks)
        try:
            exported_trace = exporter(*argument_shapes)
        except NotImplementedError:  # The function calls back into Python.
            return None
    finally:
        _is_exporting_trace.reset(export_flag_token)
    if function_key:
        # A result of a user's own class cannot be saved.
        with contextlib.suppress(ValueError):
            serialized_trace = bytes(exported_trace.serialize())
            store.save_cache_record(
                cache_record_name,
                " ".join(ffi_target_names).encode() + b"\n" + serialized_trace,
            )
    return exported_trace


def _find_ffi_target_names(jaxpr: Any) -> set[str]:
    """Return the names of all machine-code functions that a traced program calls."""
    ffi_target_names: set[str] = set()
    for jaxpr_equation in getattr(jaxpr, "jaxpr", jaxpr).eqns:
        if jaxpr_equation.primitive is MACHINE_CODE_PRIMITIVE:
            with contextlib.suppress(Exception):  # The lowering replaces the code, or raises.
                lane_program = jaxpr_equation.params["lane_call"].lane_program
                ffi_target_names.add(lane_program.machine_code.ffi_target_name)
        for equation_parameter in jax.tree.leaves(list(jaxpr_equation.params.values())):
            if hasattr(getattr(equation_parameter, "jaxpr", equation_parameter), "eqns"):
                ffi_target_names |= _find_ffi_target_names(equation_parameter)
    return ffi_target_names


_is_exporting_trace: ContextVar[bool] = ContextVar("_exporting", default=False)


MAX_CACHED_PROGRAMS = 32
"""Largest number of programs in the cache, chosen because a program occupies about 14 MB."""

_program_by_key: OrderedDict[Hashable, Callable] = OrderedDict()


def call_compiled_program(function: Callable, static_arguments: Any, *arguments: Any) -> Any:
    """Return `function(static_arguments, *arguments)`, computed by a compiled program.

    `static_arguments` is a tree of functions and values. Calls with equal `static_arguments` share
    one program. A function without a key is compiled for this call alone. Inside `jax.jit` the
    function becomes part of the caller's program.
    """
    if is_inside_jit():
        return function(static_arguments, *arguments)
    compiled_program = get_compiled_program(function, static_arguments, *arguments)
    return (compiled_program or jax.jit(functools.partial(function, static_arguments)))(*arguments)


def get_compiled_program(
    function: Callable, static_arguments: Any, *arguments: Any
) -> Callable | None:
    """Return the compiled program for equal `static_arguments`, or None if they have no key.

    There is no key inside `jax.jit` either. The key contains the types of the arguments. Each
    program is therefore traced once, when `static_arguments` has the values of the key.
    """
    if is_inside_jit():
        return None
    argument_leaves, tree_structure = jax.tree.flatten(arguments)
    try:
        function_key = make_key(function, static_arguments)
    except UnresolvableFunctionError:
        return None
    program_key = (function_key, tree_structure, *map(jax.typeof, argument_leaves))
    if program_key not in _program_by_key:
        _program_by_key[program_key] = jax.jit(functools.partial(function, static_arguments))
    _program_by_key.move_to_end(program_key)
    if len(_program_by_key) > MAX_CACHED_PROGRAMS:
        _program_by_key.popitem(last=False)
    return _program_by_key[program_key]
