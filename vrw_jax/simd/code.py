"""Machine code by its content: what is traced again to the same text is not compiled again.

Two files stand for a function. An index, by all that its trace depends on, tells the name of the
code; the code lies under a digest of what LLVM compiles. So an edit of the source that changes no
trace costs a trace, not a compiler, and the name that programs of JAX call stays.
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
    """Where code is kept between processes; a module with these two functions is one."""

    def kept(self, name: str) -> bytes | None:
        """What was kept under that name; None if nothing, or damaged."""

    def keep(self, name: str, content: bytes) -> None:
        """From now on `content` is what is kept there."""


class Code(NamedTuple):
    """A function of lanes as machine code."""

    name: str  # a digest of what LLVM compiles, by which programs of JAX call it
    out: tuple[tuple[tuple[int, ...], np.dtype], ...]  # of each result: axes before lanes, numbers
    made: Future[bytes]

    def ready(self) -> bytes:
        """The code, which LLVM may still be at work on."""
        return self.made.result()


def code_of(
    function: Callable, shapes: Any, key: object, width: int, store: Store | None, small: int
) -> Code:
    """Compiled, or found where it is kept."""
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
    """Traced; compiled only if nothing of the same text was, while Python goes on."""
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
    code = compiled(text)
    if store is not None:
        store.keep(name, out.encode() + b"\n" + code)
        store.keep(index, name.encode())
    return code


def kept_code(name: str, store: Store | None) -> Code | None:
    """The code of that name, if there is one."""
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
"""This process's, by index and by name: a program traced for another batch finds it here."""


@contextlib.contextmanager
def _uncollected() -> Iterator[None]:
    """Garbage waits: a program is many small objects that live on, and looking for dead ones among
    them takes a sixth of the time."""
    before = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if before:
            gc.enable()


_python = RLock()
"""Threads write their programs in turn: the first is soon with LLVM, which needs no lock."""


_llvm = ThreadPoolExecutor(1, "llvm")
"""Compiles what is written while Python traces on; for two at a time it has one lock."""


def _results(told: str | bytes) -> tuple[tuple[tuple[int, ...], np.dtype], ...]:
    return tuple((tuple(n), np.dtype(kind)) for n, kind in json.loads(told))


def traced(function: Callable, *shapes: Any) -> ClosedJaxpr:
    """The trace of a function that is to be machine code."""
    outside = _tracing.set(True)
    try:  # in what loops are traced in, for JAX to know again what it has traced
        with jax.sharding.use_abstract_mesh(jax.sharding.AbstractMesh((), ())):
            return jax.make_jaxpr(function)(*shapes)
    finally:
        _tracing.reset(outside)


_tracing: ContextVar[bool] = ContextVar("_tracing", default=False)


def tracing() -> bool:
    """Whether what is traced now is to be machine code."""
    return _tracing.get()
