"""The LLVM function that XLA calls through its foreign function interface (FFI)."""

import functools
import re
from pathlib import Path
from typing import Any

import jax

from vrw_jax.simd.llvm_library import ir
from vrw_jax.simd.value_emitter import I8, I32, I64

HANDLER_NAME = "handler"

METADATA_EXTENSION_TYPE = 1
"""Type of the extension by which XLA requests the metadata of a handler, from XLA's
xla/ffi/api/c_api.h.
"""


@functools.cache
def read_api_version() -> tuple[int, int]:
    """Return the version (major, minor) of the call interface in the installed header of XLA.

    It is (0, 0), which XLA rejects, if the header is missing or has another form.
    """
    header_path = Path(jax.ffi.include_dir()) / "xla" / "ffi" / "api" / "c_api.h"
    try:
        header_text = header_path.read_text(encoding="utf-8")
    except OSError:
        return 0, 0
    version_numbers = dict(re.findall(r"#define XLA_FFI_API_(MAJOR|MINOR) (\d+)", header_text))
    return int(version_numbers.get("MAJOR", 0)), int(version_numbers.get("MINOR", 0))


def add_handler(
    module: ir.Module,
    kernel: ir.Function,
    n_inputs: int,
    n_outputs: int,
    group_width: int,
    api_version: tuple[int, int],
) -> None:
    """Add the function `XLA_FFI_Error *handler(XLA_FFI_CallFrame *)`, which calls `kernel`, to the
    module.

    The function reads pointers to `n_inputs` arguments and `n_outputs` results from the call frame.
    Offsets are in bytes, from XLA's xla/ffi/api/c_api.h, whose structs only grow at their ends. If
    XLA requests the metadata, the handler reports `api_version`, for which it is compiled.
    """
    pointer_type = ir.PointerType()
    handler = ir.Function(module, ir.FunctionType(pointer_type, [pointer_type]), HANDLER_NAME)
    handler.attributes.add("nounwind")
    builder = ir.IRBuilder(handler.append_basic_block("entry"))
    extension_block, metadata_block, execute_block = (
        handler.append_basic_block(name) for name in ("extension", "metadata", "execute")
    )
    call_frame, null_pointer = handler.args[0], ir.Constant(pointer_type, None)

    def field_address(base_pointer: Any, offset: int) -> Any:
        return builder.gep(base_pointer, [ir.Constant(I64, offset)], source_etype=I8)

    def load_field(base_pointer: Any, offset: int, field_type: ir.Type = pointer_type) -> Any:
        return builder.load(field_address(base_pointer, offset), typ=field_type)

    extension_pointer = load_field(call_frame, 8)
    has_extension = builder.icmp_unsigned("!=", extension_pointer, null_pointer)
    builder.cbranch(has_extension, extension_block, execute_block)
    builder.position_at_end(extension_block)
    is_metadata = builder.icmp_unsigned(
        "==", load_field(extension_pointer, 8, I32), ir.Constant(I32, METADATA_EXTENSION_TYPE)
    )
    builder.cbranch(is_metadata, metadata_block, execute_block)
    builder.position_at_end(metadata_block)
    metadata_pointer = load_field(extension_pointer, 24)
    for field_offset, version_number in zip((24, 28), api_version, strict=True):
        builder.store(
            ir.Constant(I32, version_number), field_address(metadata_pointer, field_offset)
        )
    builder.ret(null_pointer)
    builder.position_at_end(execute_block)

    def load_buffer_pointers(offset: int, n_buffers: int) -> tuple[Any, Any]:
        """Return a table of pointers to the data of `n_buffers` buffers, and the last buffer.

        `offset` is that of the list of buffers in the call frame, in bytes.
        """
        buffer_list, buffer = load_field(call_frame, offset), None
        data_pointers = builder.alloca(pointer_type, ir.Constant(I64, n_buffers))
        for i in range(n_buffers):
            buffer = load_field(buffer_list, 8 * i)
            builder.store(
                load_field(buffer, 24),
                builder.gep(data_pointers, [ir.Constant(I64, i)], source_etype=pointer_type),
            )
        return data_pointers, buffer

    input_table, _ = load_buffer_pointers(72, n_inputs)
    output_table, last_output = load_buffer_pointers(112, n_outputs)
    rank = load_field(last_output, 32, I64)
    last_axis = builder.sub(rank, ir.Constant(I64, 1))
    n_lanes = builder.load(
        builder.gep(load_field(last_output, 40), [last_axis], source_etype=I64), typ=I64
    )
    n_groups = builder.sdiv(n_lanes, ir.Constant(I64, group_width))
    builder.call(kernel, [input_table, output_table, n_lanes, ir.Constant(I64, 0), n_groups])
    builder.ret(null_pointer)
