"""The machine-code function that XLA calls through its foreign function interface (FFI)."""

import functools
import re
from pathlib import Path
from typing import Any

import jax

from vrw_jax.simd.llvm_library import ir
from vrw_jax.simd.value_emitter import I8, I32, I64

HANDLER_NAME = "handler"

METADATA_EXTENSION_TYPE = 1
"""Type of the extension by which XLA requests the metadata of a handler, from the same header."""


@functools.cache
def read_api_version() -> tuple[int, int]:
    """Return the version of the call interface in the installed header of XLA.

    It is (0, 0), which XLA refuses, if the header is missing or has another form.
    """
    header = Path(jax.ffi.include_dir()) / "xla" / "ffi" / "api" / "c_api.h"
    try:
        text = header.read_text(encoding="utf-8")
    except OSError:
        return 0, 0
    numbers = dict(re.findall(r"#define XLA_FFI_API_(MAJOR|MINOR) (\d+)", text))
    return int(numbers.get("MAJOR", 0)), int(numbers.get("MINOR", 0))


def add_handler(
    module: ir.Module,
    kernel: ir.Function,
    n_in: int,
    n_out: int,
    width: int,
    api_version: tuple[int, int],
) -> None:
    """Add `XLA_FFI_Error *handler(XLA_FFI_CallFrame *)`, which calls the kernel, to the module.

    Offsets are in bytes, from XLA's xla/ffi/api/c_api.h, whose structs only grow at their ends. If
    XLA requests the metadata, the handler reports `api_version`, for which it is compiled.
    """
    pointer = ir.PointerType()
    handler = ir.Function(module, ir.FunctionType(pointer, [pointer]), HANDLER_NAME)
    handler.attributes.add("nounwind")
    build = ir.IRBuilder(handler.append_basic_block("entry"))
    extension_block, metadata_block, execute_block = (
        handler.append_basic_block(name) for name in ("extension", "metadata", "execute")
    )
    frame, null = handler.args[0], ir.Constant(pointer, None)

    def field_address(base: Any, offset: int) -> Any:
        return build.gep(base, [ir.Constant(I64, offset)], source_etype=I8)

    def load_field(base: Any, offset: int, kind: ir.Type = pointer) -> Any:
        return build.load(field_address(base, offset), typ=kind)

    extension = load_field(frame, 8)
    has_extension = build.icmp_unsigned("!=", extension, null)
    build.cbranch(has_extension, extension_block, execute_block)
    build.position_at_end(extension_block)
    is_metadata = build.icmp_unsigned(
        "==", load_field(extension, 8, I32), ir.Constant(I32, METADATA_EXTENSION_TYPE)
    )
    build.cbranch(is_metadata, metadata_block, execute_block)
    build.position_at_end(metadata_block)
    metadata = load_field(extension, 24)
    for field, number in zip((24, 28), api_version, strict=True):
        build.store(ir.Constant(I32, number), field_address(metadata, field))
    build.ret(null)
    build.position_at_end(execute_block)

    def buffers(offset: int, count: int) -> tuple[Any, Any]:
        """Return pointers to the data of a list of buffers, and the last buffer."""
        buffer_list, buffer = load_field(frame, offset), None
        pointers = build.alloca(pointer, ir.Constant(I64, count))
        for i in range(count):
            buffer = load_field(buffer_list, 8 * i)
            build.store(
                load_field(buffer, 24),
                build.gep(pointers, [ir.Constant(I64, i)], source_etype=pointer),
            )
        return pointers, buffer

    input_table, _ = buffers(72, n_in)
    output_table, last_output = buffers(112, n_out)
    rank = load_field(last_output, 32, I64)
    last_axis = build.sub(rank, ir.Constant(I64, 1))
    n_lanes = build.load(
        build.gep(load_field(last_output, 40), [last_axis], source_etype=I64), typ=I64
    )
    groups = build.sdiv(n_lanes, ir.Constant(I64, width))
    build.call(kernel, [input_table, output_table, n_lanes, ir.Constant(I64, 0), groups])
    build.ret(null)
