"""The modules of llvmlite, or stand-ins if it is not installed. Without llvmlite, XLA computes
everything.
"""

from typing import Any

try:
    import llvmlite.binding as llvm
    import llvmlite.ir as ir

    has_llvm = True
except ImportError:
    has_llvm = False


class _MissingType:
    """Stand-in for a type of llvmlite that the emitters name and extend."""

    def __init__(self, *_: Any) -> None: ...


class _MissingTypes:
    """Stand-in for the module `llvmlite.ir`, in which any name is a type."""

    def __getattr__(self, name: str) -> Any:
        return type(name, (_MissingType,), {})


class _MissingCompiler:
    """Stand-in for the module `llvmlite.binding`, whose use raises an ImportError."""

    def __getattr__(self, name: str) -> Any:
        raise ImportError("machine code needs llvmlite, which is not installed: pip install it.")


if not has_llvm:
    llvm, ir = _MissingCompiler(), _MissingTypes()
