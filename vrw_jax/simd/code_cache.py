"""Cache of machine code by content: traces that give the same LLVM text share one compilation.

Each program is one record of the store. The name of the record is a digest of the processor and of
the text that LLVM compiles. A second record, the index, contains the name of the program. The name
of the index is a digest of everything on which the function's trace depends. An edit of the source
that changes no trace therefore costs a trace, but no compilation. JAX programs then call the code
by the same name as before the edit.
"""

import contextlib
import gc
import hashlib
import json
import warnings
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextvars import ContextVar
from threading import RLock
from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax
import numpy as np
from jax.extend.core import ClosedJaxpr

from vrw_jax.simd.array_emitter import RegisterLimits
from vrw_jax.simd.kernel import LANE_KERNEL_NAME, write_llvm_kernel
from vrw_jax.simd.machine import (
    compile_llvm_for_processor,
    describe_compiler_settings,
    require_object_file,
)


@runtime_checkable
class CodeStore(Protocol):
    """Store of machine code that several processes share.

    The store is an object or a module with two functions.
    """

    def load_cache_record(self, cache_record_name: str) -> bytes | None:
        """Return the bytes that are saved under `cache_record_name`, or None if no undamaged record
        has that name.
        """

    def save_cache_record(self, cache_record_name: str, cache_record_content: bytes) -> None:
        """Save `cache_record_content` under the name `cache_record_name`."""


ResultShapesAndDtypes = tuple[tuple[tuple[int, ...], np.dtype], ...]
"""For each result of machine code, the lengths of all axes before the lanes, and the dtype."""


class MachineCode(NamedTuple):
    """Machine code of a function over lanes, which may still be compiled in the background."""

    ffi_target_name: str  # digest of the text that LLVM compiles; JAX programs call the code by it
    result_shapes_and_dtypes: ResultShapesAndDtypes
    object_code_future: Future[bytes]


def get_machine_code(
    lane_function: Callable,
    argument_shapes: Any,
    trace_key: object,
    lanes_per_group: int,
    code_store: CodeStore | None,
    register_limits: RegisterLimits,
) -> MachineCode:
    """Return machine code for a function over lanes.

    The code is taken from this process or from `code_store`. If neither contains it, the function
    is traced, and compiled in the background.

    - `argument_shapes`: shapes and dtypes of the arguments;
    - `trace_key`: object whose `repr` identifies all other inputs of the trace;
    - `lanes_per_group`: number of lanes that the code computes at a time.
    """
    code_index_key = (
        trace_key,
        argument_shapes,
        lanes_per_group,
        register_limits,
        jax.__version__,
        describe_compiler_settings(),
    )
    code_index_name = f"lanes_index_{hashlib.sha256(repr(code_index_key).encode()).hexdigest()}"
    if code_index_name in _machine_code_by_record_name:
        return _machine_code_by_record_name[code_index_name]
    machine_code = None
    encoded_ffi_target_name = (
        code_store.load_cache_record(code_index_name) if code_store is not None else None
    )
    if encoded_ffi_target_name:
        ffi_target_name = encoded_ffi_target_name.decode("ascii", "replace")
        machine_code = load_machine_code(ffi_target_name, code_store)
    if machine_code is None:
        with _jax_tracing_lock, _pause_garbage_collection():
            closed_jaxpr = trace_for_machine_code(lane_function, *argument_shapes)
            llvm_text = write_llvm_kernel(closed_jaxpr, lanes_per_group, register_limits)
        encoded_result_types = json.dumps(
            [(aval.shape[:-1], aval.dtype.name) for aval in closed_jaxpr.out_avals]
        )
        digested_text = f"{encoded_result_types}{describe_compiler_settings()}{llvm_text}"
        ffi_target_name = f"lanes_code_{hashlib.sha256(digested_text.encode()).hexdigest()}"

        def compile_and_save_code() -> bytes:
            object_code = compile_llvm_for_processor(llvm_text)
            if code_store is not None:
                encoded_machine_code = encoded_result_types.encode() + b"\n" + object_code
                code_store.save_cache_record(ffi_target_name, encoded_machine_code)
                code_store.save_cache_record(code_index_name, ffi_target_name.encode())
            return object_code

        # Another trace may have given the same LLVM text.
        machine_code = load_machine_code(ffi_target_name, code_store)
        if machine_code is None:
            machine_code = _machine_code_by_record_name[ffi_target_name] = MachineCode(
                ffi_target_name,
                _parse_result_shapes_and_dtypes(encoded_result_types),
                _llvm_compiler_pool.submit(compile_and_save_code),
            )
        elif code_store is not None:
            code_store.save_cache_record(code_index_name, ffi_target_name.encode())
    _machine_code_by_record_name[code_index_name] = machine_code
    return machine_code


def load_machine_code(ffi_target_name: str, code_store: CodeStore | None) -> MachineCode | None:
    """Return the machine code named `ffi_target_name` from this process or from `code_store`.

    Return None if neither contains the code.
    """
    if ffi_target_name not in _machine_code_by_record_name:
        cache_record_content = (
            code_store.load_cache_record(ffi_target_name) if code_store is not None else None
        )
        if cache_record_content is None:
            return None
        encoded_result_types, _, object_code = cache_record_content.partition(b"\n")
        try:
            result_shapes_and_dtypes = _parse_result_shapes_and_dtypes(encoded_result_types)
            require_object_file(object_code, LANE_KERNEL_NAME)
        except (
            ValueError,
            TypeError,
        ) as damage_error:  # LLVM would end the process on such a file.
            warnings.warn(
                f"{ffi_target_name} holds no machine code ({damage_error}): compiled again.",
                stacklevel=2,
            )
            return None
        object_code_future: Future[bytes] = Future()
        object_code_future.set_result(object_code)
        _machine_code_by_record_name[ffi_target_name] = MachineCode(
            ffi_target_name, result_shapes_and_dtypes, object_code_future
        )
    return _machine_code_by_record_name[ffi_target_name]


_machine_code_by_record_name: dict[str, MachineCode] = {}
"""Machine code of this process, by the name of its index record and by its code name.

Programs that are traced for several batch sizes share the code.
"""


@contextlib.contextmanager
def _pause_garbage_collection() -> Iterator[None]:
    """Return a context in which Python collects no garbage.

    Collections take a sixth of the tracing time, because a trace creates many objects that persist.
    """
    was_collection_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_collection_enabled:
            gc.enable()


_jax_tracing_lock = RLock()
"""Lock that lets only one thread trace at a time. The later compilation by LLVM needs no lock."""


_llvm_compiler_pool = ThreadPoolExecutor(1, "llvm")
"""Thread that compiles in the background while Python traces.

One thread suffices, because LLVM's lock lets only one thread compile.
"""


def _parse_result_shapes_and_dtypes(encoded_result_types: str | bytes) -> ResultShapesAndDtypes:
    """Return `MachineCode.result_shapes_and_dtypes`, parsed from JSON."""
    return tuple(
        (tuple(axis_lengths), np.dtype(dtype_name))
        for axis_lengths, dtype_name in json.loads(encoded_result_types)
    )


def trace_for_machine_code(lane_function: Callable, *argument_shapes: Any) -> ClosedJaxpr:
    """Return the jaxpr of a function for arguments with the shapes and dtypes `argument_shapes`.

    During the trace, `targets_machine_code` returns True.
    """
    tracing_flag_token = _is_tracing_for_machine_code.set(True)
    try:  # The loops are traced in this mesh, so that JAX's trace cache finds them again.
        with jax.sharding.use_abstract_mesh(jax.sharding.AbstractMesh((), ())):
            return jax.make_jaxpr(lane_function)(*argument_shapes)
    finally:
        _is_tracing_for_machine_code.reset(tracing_flag_token)


_is_tracing_for_machine_code: ContextVar[bool] = ContextVar("_tracing", default=False)


def targets_machine_code() -> bool:
    """Return whether the function that is being traced will become machine code."""
    return _is_tracing_for_machine_code.get()
