"""Cache of machine code by content: traces that give the same LLVM text share one compilation.

A program is one record of the store. Its name is a digest of the text that LLVM compiles and of the
processor. A second record, the index, is named by everything on which the function's trace depends,
and contains the name of the program. An edit of the source that changes no trace therefore costs a
trace, but no compilation. The name by which programs of JAX call the code does not change.
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
from vrw_jax.simd.kernel import KERNEL_NAME, write_module
from vrw_jax.simd.machine import compilation_key, compile_native, require_object


@runtime_checkable
class CodeStore(Protocol):
    """Store of code between processes: an object or a module with these two functions."""

    def load_bytes(self, name: str) -> bytes | None:
        """Return the bytes saved under `name`, or None if there are none or they are damaged."""

    def save_bytes(self, name: str, content: bytes) -> None:
        """Save `content` under that name."""


class MachineCode(NamedTuple):
    """The machine code of a function over lanes, whose compilation may still run in the
    background.
    """

    name: str  # digest of the text that LLVM compiles; JAX programs call the code by it
    result_types: tuple[
        tuple[tuple[int, ...], np.dtype], ...
    ]  # for each result, the lengths of all axes before the lanes and the dtype
    object_code: Future[bytes]

    def wait_for_code(self) -> bytes:
        """Return the object code; the call blocks until LLVM has compiled it."""
        return self.object_code.result()


def get_machine_code(
    function: Callable,
    shapes: Any,
    key: object,
    group_width: int,
    store: CodeStore | None,
    limits: RegisterLimits,
) -> MachineCode:
    """Return the machine code of a function, from this process, from `store`, or newly compiled.

    `shapes` are those of the arguments, and the code computes `group_width` lanes at a time. `key`
    identifies everything else on which the trace depends.
    """
    key_parts = (key, shapes, group_width, limits, jax.__version__, compilation_key())
    index_name = f"lanes_index_{_digest(repr(key_parts).encode())}"
    if index_name not in _code_by_name:
        code_name = store.load_bytes(index_name) if store is not None else None
        code = load_machine_code(code_name.decode("ascii", "replace"), store) if code_name else None
        _code_by_name[index_name] = code or _trace_and_compile(
            function, shapes, group_width, index_name, store, limits
        )
    return _code_by_name[index_name]


def _trace_and_compile(
    function: Callable,
    shapes: Any,
    group_width: int,
    index_name: str,
    store: CodeStore | None,
    limits: RegisterLimits,
) -> MachineCode:
    """Trace a function and return its machine code, compiled in the background unless the cache
    contains the same text.
    """
    with _tracing_lock, _pause_garbage_collection():
        closed_jaxpr = trace_for_machine_code(function, *shapes)
        llvm_text = write_module(closed_jaxpr, group_width, limits)
    result_types = json.dumps(
        [(aval.shape[:-1], aval.dtype.name) for aval in closed_jaxpr.out_avals]
    )
    code_name = f"lanes_code_{_digest(f'{result_types}{compilation_key()}{llvm_text}'.encode())}"
    code = load_machine_code(code_name, store)
    if code is None:
        object_code = _compiler_pool.submit(
            _compile_and_save, llvm_text, result_types, code_name, index_name, store
        )
        code = _code_by_name[code_name] = MachineCode(
            code_name, _parse_result_types(result_types), object_code
        )
    elif store is not None:
        store.save_bytes(index_name, code_name.encode())
    return code


def _compile_and_save(
    llvm_text: str, result_types: str, code_name: str, index_name: str, store: CodeStore | None
) -> bytes:
    """Compile LLVM text, save the object code and its index record in `store`, and return the
    object code.
    """
    code = compile_native(llvm_text)
    if store is not None:
        store.save_bytes(code_name, result_types.encode() + b"\n" + code)
        store.save_bytes(index_name, code_name.encode())
    return code


def load_machine_code(code_name: str, store: CodeStore | None) -> MachineCode | None:
    """Return the machine code named `code_name` from this process or from `store`; None if neither
    has it.
    """
    if code_name not in _code_by_name:
        content = store.load_bytes(code_name) if store is not None else None
        if content is None:
            return None
        result_types, _, code = content.partition(b"\n")
        try:
            parsed_result_types = _parse_result_types(result_types)
            require_object(code, KERNEL_NAME)
        except (ValueError, TypeError) as error:  # LLVM would end the process on such a file.
            warnings.warn(
                f"{code_name} holds no machine code ({error}): compiled again.", stacklevel=2
            )
            return None
        object_code: Future[bytes] = Future()
        object_code.set_result(code)
        _code_by_name[code_name] = MachineCode(code_name, parsed_result_types, object_code)
    return _code_by_name[code_name]


def _digest(content: bytes) -> str:
    """Return the SHA-256 digest of some bytes in hexadecimal digits."""
    return hashlib.sha256(content).hexdigest()


_code_by_name: dict[str, MachineCode] = {}
"""Machine code of this process by the name of its index record and by its own name. Programs traced
for other batch sizes share it.
"""


@contextlib.contextmanager
def _pause_garbage_collection() -> Iterator[None]:
    """Return a context in which garbage collection is disabled.

    Collections would take a sixth of the tracing time, because a trace creates many objects that
    persist.
    """
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            gc.enable()


_tracing_lock = RLock()
"""Lock by which only one thread traces at a time. A thread soon proceeds to LLVM, which needs no
lock.
"""


_compiler_pool = ThreadPoolExecutor(1, "llvm")
"""Thread that compiles in the background while Python traces. There is only one, because LLVM has
its own lock.
"""


def _parse_result_types(encoded_types: str | bytes) -> tuple[tuple[tuple[int, ...], np.dtype], ...]:
    """Return the field `result_types` of `MachineCode` from its JSON text."""
    return tuple(
        (tuple(axis_lengths), np.dtype(dtype_name))
        for axis_lengths, dtype_name in json.loads(encoded_types)
    )


def trace_for_machine_code(function: Callable, *shapes: Any) -> ClosedJaxpr:
    """Return the jaxpr of a function of arguments with these shapes, traced for machine code."""
    context_token = _is_tracing.set(True)
    try:  # The loops are traced in this mesh, so that JAX's trace cache finds them again.
        with jax.sharding.use_abstract_mesh(jax.sharding.AbstractMesh((), ())):
            return jax.make_jaxpr(function)(*shapes)
    finally:
        _is_tracing.reset(context_token)


_is_tracing: ContextVar[bool] = ContextVar("_tracing", default=False)


def targets_machine_code() -> bool:
    """Return whether the function that is being traced will become machine code."""
    return _is_tracing.get()
