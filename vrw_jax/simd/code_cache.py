"""Machine code cached by its content: a trace that gives the same text is not compiled again.

A program is one record, under a digest of what LLVM compiles and for which processor. An index, by
all that the function's trace depends on, holds the name of that record. So an edit of the source
that changes no trace costs a trace, not a compiler, and the name that programs of JAX call stays.
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
    """Storage of code between processes; a module with these two functions is one."""

    def load_bytes(self, name: str) -> bytes | None:
        """Return what was saved under that name; None if there is nothing or it is damaged."""

    def save_bytes(self, name: str, content: bytes) -> None:
        """Save `content` under that name."""


class MachineCode(NamedTuple):
    """A function of lanes as machine code."""

    name: str  # a digest of the text that LLVM compiles, used by calls in JAX programs
    result_types: tuple[
        tuple[tuple[int, ...], np.dtype], ...
    ]  # of each result: axes before lanes, number type
    object_code: Future[bytes]

    def wait_for_code(self) -> bytes:
        """Return the code; this blocks until LLVM has compiled it."""
        return self.object_code.result()


def get_machine_code(
    function: Callable,
    shapes: Any,
    key: object,
    width: int,
    store: CodeStore | None,
    limits: RegisterLimits,
) -> MachineCode:
    """Return the machine code of a function: from this process, from `store`, or newly compiled."""
    key_parts = (key, shapes, width, limits, jax.__version__, compilation_key())
    index = f"lanes_index_{_digest(repr(key_parts).encode())}"
    if index not in _code_by_name:
        name = store.load_bytes(index) if store is not None else None
        code = load_machine_code(name.decode("ascii", "replace"), store) if name else None
        _code_by_name[index] = code or _trace_and_compile(
            function, shapes, width, index, store, limits
        )
    return _code_by_name[index]


def _trace_and_compile(
    function: Callable,
    shapes: Any,
    width: int,
    index: str,
    store: CodeStore | None,
    limits: RegisterLimits,
) -> MachineCode:
    """Trace a function; compile it in the background unless code of the same text exists."""
    with _tracing_lock, _pause_garbage_collection():
        closed_jaxpr = trace_for_machine_code(function, *shapes)
        text = write_module(closed_jaxpr, width, limits)
    result_types = json.dumps(
        [(aval.shape[:-1], aval.dtype.name) for aval in closed_jaxpr.out_avals]
    )
    name = f"lanes_code_{_digest(f'{result_types}{compilation_key()}{text}'.encode())}"
    code = load_machine_code(name, store)
    if code is None:
        object_code = _compiler_pool.submit(
            _compile_and_save, text, result_types, name, index, store
        )
        code = _code_by_name[name] = MachineCode(
            name, _parse_result_types(result_types), object_code
        )
    elif store is not None:
        store.save_bytes(index, name.encode())
    return code


def _compile_and_save(
    text: str, result_types: str, name: str, index: str, store: CodeStore | None
) -> bytes:
    """Compile LLVM text, save the code and its index entry, and return the code."""
    code = compile_native(text)
    if store is not None:
        store.save_bytes(name, result_types.encode() + b"\n" + code)
        store.save_bytes(index, name.encode())
    return code


def load_machine_code(name: str, store: CodeStore | None) -> MachineCode | None:
    """Return the code of that name, None if there is none."""
    if name not in _code_by_name:
        content = store.load_bytes(name) if store is not None else None
        if content is None:
            return None
        result_types, _, code = content.partition(b"\n")
        try:
            results = _parse_result_types(result_types)
            require_object(code, KERNEL_NAME)
        except (ValueError, TypeError) as error:  # LLVM would end the process on such a file
            warnings.warn(f"{name} holds no machine code ({error}): compiled again.", stacklevel=2)
            return None
        object_code: Future[bytes] = Future()
        object_code.set_result(code)
        _code_by_name[name] = MachineCode(name, results, object_code)
    return _code_by_name[name]


def _digest(content: bytes) -> str:
    """Return the SHA-256 digest in hexadecimal digits."""
    return hashlib.sha256(content).hexdigest()


_code_by_name: dict[str, MachineCode] = {}
"""Code of this process by index and by name, shared by programs traced for other batches."""


@contextlib.contextmanager
def _pause_garbage_collection() -> Iterator[None]:
    """Disable garbage collection, which takes a sixth of the time for many persistent objects."""
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            gc.enable()


_tracing_lock = RLock()
"""Lock under which threads trace one after the other: the first soon proceeds to LLVM, which needs
no lock."""


_compiler_pool = ThreadPoolExecutor(1, "llvm")
"""Background thread that compiles while Python traces; LLVM's own lock allows no second one."""


def _parse_result_types(encoded: str | bytes) -> tuple[tuple[tuple[int, ...], np.dtype], ...]:
    """Return the result types of `MachineCode` from their JSON text."""
    return tuple((tuple(n), np.dtype(kind)) for n, kind in json.loads(encoded))


def trace_for_machine_code(function: Callable, *shapes: Any) -> ClosedJaxpr:
    """Return the trace of a function that becomes machine code."""
    token = _is_tracing.set(True)
    try:  # the mesh in which JAX traces loops, so that its trace cache finds them again
        with jax.sharding.use_abstract_mesh(jax.sharding.AbstractMesh((), ())):
            return jax.make_jaxpr(function)(*shapes)
    finally:
        _is_tracing.reset(token)


_is_tracing: ContextVar[bool] = ContextVar("_tracing", default=False)


def targets_machine_code() -> bool:
    """Return whether the present trace becomes machine code."""
    return _is_tracing.get()
