"""Modules of llvmlite, or stand-ins if llvmlite is not installed. Without llvmlite, XLA computes
everything.
"""

from typing import Any

try:
    import llvmlite.binding as llvm
    import llvmlite.ir as ir

    is_llvmlite_installed = True
except ImportError:
    is_llvmlite_installed = False


class _MissingLlvmType:
    """Stand-in for a type of llvmlite that other modules use or subclass."""

    def __init__(self, *_: Any) -> None: ...


class _MissingLlvmTypes:
    """Stand-in for the module `llvmlite.ir`, in which every name is a type."""

    def __getattr__(self, type_name: str) -> Any:
        return type(type_name, (_MissingLlvmType,), {})


class _MissingLlvmCompiler:
    """Stand-in for the module `llvmlite.binding`. Any use of it raises an ImportError."""

    def __getattr__(self, attribute_name: str) -> Any:
        raise ImportError("machine code needs llvmlite, which is not installed: pip install it.")


if not is_llvmlite_installed:
    llvm, ir = _MissingLlvmCompiler(), _MissingLlvmTypes()
