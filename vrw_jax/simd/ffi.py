"""Machine code as a JAX primitive, which JAX programs call by the name of the code."""

import functools
from collections.abc import Sequence
from threading import Lock
from typing import Any

import jax
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

from vrw_jax.simd.code import Code
from vrw_jax.simd.handler import HANDLER
from vrw_jax.simd.machine import Loaded

registered: dict[str, Loaded] = {}
"""Machine code by the name under which JAX programs can call it; XLA never releases it."""
_registering = Lock()


def register(code: Code) -> None:
    """Make this code callable by its name in JAX programs."""
    made = code.ready()
    with _registering:
        if code.name not in registered:
            loaded = Loaded(made)
            jax.ffi.register_ffi_target(code.name, loaded.capsule(HANDLER), platform="cpu")
            registered[code.name] = loaded


CALLED = Primitive("machine_code")
"""A call of machine code by programs of JAX, which need it only when they are compiled themselves:
until then LLVM may be at work on it."""
CALLED.multiple_results = True


@CALLED.def_abstract_eval
def _results(*given: Any, code: Code, out: Sequence[jax.ShapeDtypeStruct]) -> list[Any]:
    return [jax.core.ShapedArray(x.shape, x.dtype) for x in out]


@CALLED.def_impl
def _call(*given: Any, **params: Any) -> Any:
    return jax.jit(functools.partial(CALLED.bind, **params))(*given)


def _lowered(context: Any, *given: Any, code: Code, out: Sequence[jax.ShapeDtypeStruct]) -> Any:
    register(code)
    return jax.ffi.ffi_lowering(code.name)(context, *given)


def _refused(*_: Any, **__: Any) -> Any:
    raise NotImplementedError(
        "Machine code can neither be mapped by `jax.vmap` nor differentiated from outside: give "
        "all lanes at once, on the last axis, and for derivatives the function that returns them."
    )


mlir.register_lowering(CALLED, _lowered, platform="cpu")
batching.primitive_batchers[CALLED] = ad.primitive_jvps[CALLED] = _refused
"""A call of machine code by JAX programs, which require the code only when they are compiled: LLVM
can compile it in the meantime."""
