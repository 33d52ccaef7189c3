"""Machine code cached by its content: a trace that gives the same text is not compiled again.

Two files represent a function. An index, named by a digest of everything that the trace depends on,
contains the name of the code; the code is stored under a digest of the text that LLVM compiles. An
edit of the source that changes no trace therefore costs a trace but no compilation, and the name
that JAX programs call stays the same.
"""

import contextlib
import gc
import hashlib
import json
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextvars import ContextVar
from threading import RLock
from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax
import numpy as np
from jax.extend.core import ClosedJaxpr

from vrw_jax.simd.kernel import module_text
from vrw_jax.simd.machine import compiled, how_compiled


@runtime_checkable
class Store(Protocol):
    """Storage of code between processes; a module with these two functions is one."""

    def kept(self, name: str) -> bytes | None:
        """Return the content saved under that name; None if there is none, or it is damaged."""

    def keep(self, name: str, content: bytes) -> None:
        """Save `content` under that name."""


class Code(NamedTuple):
    """A function of lanes as machine code."""

    name: str  # a digest of the text that LLVM compiles, used by calls in JAX programs
    out: tuple[
        tuple[tuple[int, ...], np.dtype], ...
    ]  # of each result: axes before lanes, number type
    made: Future[bytes]

    def ready(self) -> bytes:
        """Return the code; this blocks until LLVM has compiled it."""
        return self.made.result()


def code_of(
    function: Callable, shapes: Any, key: object, width: int, store: Store | None, small: int
) -> Code:
    """Return the machine code of a function, from the cache or newly compiled."""
    asked = (key, shapes, width, small, jax.__version__, how_compiled())
    index = f"lanes_index_{_digest(repr(asked).encode())}"
    if index not in _made:
        name = store.kept(index) if store is not None else None
        code = kept_code(name.decode(), store) if name else None
        _made[index] = code or _written(function, shapes, width, index, store, small)
    return _made[index]


def _written(
    function: Callable, shapes: Any, width: int, index: str, store: Store | None, small: int
) -> Code:
    """Trace a function; compile it in the background unless code of the same text exists."""
    with _python, _uncollected():
        closed = traced(function, *shapes)
        text = module_text(closed, width, small)
    out = json.dumps([(aval.shape[:-1], aval.dtype.name) for aval in closed.out_avals])
    name = f"lanes_code_{_digest(f'{out}{how_compiled()}{text}'.encode())}"
    code = kept_code(name, store)
    if code is None:
        made = _llvm.submit(_made_of, text, out, name, index, store)
        code = _made[name] = Code(name, _results(out), made)
    elif store is not None:
        store.keep(index, name.encode())
    return code


def _made_of(text: str, out: str, name: str, index: str, store: Store | None) -> bytes:
    """Compile LLVM text, and save the code and its index entry."""
    code = compiled(text)
    if store is not None:
        store.keep(name, out.encode() + b"\n" + code)
        store.keep(index, name.encode())
    return code


def kept_code(name: str, store: Store | None) -> Code | None:
    """Return the code of that name, None if there is none."""
    if name not in _made:
        content = store.kept(name) if store is not None else None
        if content is None:
            return None
        out, _, code = content.partition(b"\n")
        made: Future[bytes] = Future()
        made.set_result(code)
        _made[name] = Code(name, _results(out), made)
    return _made[name]


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


_made: dict[str, Code] = {}
"""Code of this process by index and by name, shared by programs traced for other batches."""


@contextlib.contextmanager
def _uncollected() -> Iterator[None]:
    """Disable garbage collection, which takes a sixth of the time for many persistent objects."""
    before = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if before:
            gc.enable()


_python = RLock()
"""Lock under which threads trace one after the other: the first soon proceeds to LLVM, which needs
no lock."""


_llvm = ThreadPoolExecutor(1, "llvm")
"""Background thread that compiles while Python traces; LLVM's own lock allows no second one."""


def _results(told: str | bytes) -> tuple[tuple[tuple[int, ...], np.dtype], ...]:
    return tuple((tuple(n), np.dtype(kind)) for n, kind in json.loads(told))


def traced(function: Callable, *shapes: Any) -> ClosedJaxpr:
    """Return the trace of a function that becomes machine code."""
    outside = _tracing.set(True)
    try:  # the mesh in which JAX traces loops, so that its trace cache finds them again
        with jax.sharding.use_abstract_mesh(jax.sharding.AbstractMesh((), ())):
            return jax.make_jaxpr(function)(*shapes)
    finally:
        _tracing.reset(outside)


_tracing: ContextVar[bool] = ContextVar("_tracing", default=False)


def tracing() -> bool:
    """Return whether the present trace becomes machine code."""
    return _tracing.get()
