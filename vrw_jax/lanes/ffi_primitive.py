"""JAX primitive by which JAX programs call machine code by its name."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from threading import Lock
from typing import Any

import jax
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

from vrw_jax.lanes.code_cache import LaneProgram, MachineCode
from vrw_jax.lanes.ffi_handler import FFI_HANDLER_NAME
from vrw_jax.lanes.machine import LoadedMachineCode

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


@MACHINE_CODE_PRIMITIVE.def_abstract_eval
def _make_abstract_results(
    *call_arguments: Any, result_shapes: Sequence[jax.ShapeDtypeStruct], **_: Any
) -> list[Any]:
    """Return the abstract values (shapes and dtypes) of the results that a machine code call
    returns.
    """
    return [jax.core.ShapedArray(x.shape, x.dtype) for x in result_shapes]


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
