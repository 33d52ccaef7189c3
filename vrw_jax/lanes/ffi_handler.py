"""The LLVM function that XLA calls through its foreign function interface (FFI)."""

import functools
import re
from pathlib import Path
from typing import Any

import jax

from vrw_jax.lanes.llvm_library import ir
from vrw_jax.lanes.value_emitter import I8, I32, I64

FFI_HANDLER_NAME = "handler"

FFI_METADATA_EXTENSION_TYPE = 1
"""Number of the extension type by which XLA requests the metadata of a handler.

The number is from XLA's xla/ffi/api/c_api.h.
"""


@functools.cache
def read_ffi_api_version() -> tuple[int, int]:
    """Return the version (major, minor) of XLA's call interface, read from the installed header.

    Return (0, 0), which XLA rejects, if the header is missing or has another form.
    """
    header_path = Path(jax.ffi.include_dir()) / "xla" / "ffi" / "api" / "c_api.h"
    try:
        header_text = header_path.read_text(encoding="utf-8")
    except OSError:
        return 0, 0
    version_numbers = dict(re.findall(r"#define XLA_FFI_API_(MAJOR|MINOR) (\d+)", header_text))
    return int(version_numbers.get("MAJOR", 0)), int(version_numbers.get("MINOR", 0))


def add_ffi_handler(
    llvm_module: ir.Module,
    llvm_kernel: ir.Function,
    n_inputs: int,
    n_outputs: int,
    lanes_per_group: int,
) -> None:
    """Add the function `XLA_FFI_Error *handler(XLA_FFI_CallFrame *)` to the LLVM module.

    The function calls `llvm_kernel` with pointers to `n_inputs` arguments and `n_outputs` results,
    which it reads from the call frame. Offsets in the frame are in bytes, from XLA's
    xla/ffi/api/c_api.h, whose structs only grow at their ends. If XLA requests the metadata, the
    handler reports the version of the interface for which it is compiled.
    """
    llvm_pointer_type = ir.PointerType()
    llvm_handler = ir.Function(
        llvm_module, ir.FunctionType(llvm_pointer_type, [llvm_pointer_type]), FFI_HANDLER_NAME
    )
    llvm_handler.attributes.add("nounwind")
    llvm_builder = ir.IRBuilder(llvm_handler.append_basic_block("entry"))
    extension_basic_block, metadata_basic_block, execute_basic_block = (
        llvm_handler.append_basic_block(block_name)
        for block_name in ("extension", "metadata", "execute")
    )
    ffi_call_frame, llvm_null_pointer = llvm_handler.args[0], ir.Constant(llvm_pointer_type, None)

    def emit_struct_field_address(base_pointer: Any, byte_offset: int) -> Any:
        return llvm_builder.gep(base_pointer, [ir.Constant(I64, byte_offset)], source_etype=I8)

    def emit_struct_field_load(
        base_pointer: Any, byte_offset: int, llvm_field_type: ir.Type = llvm_pointer_type
    ) -> Any:
        return llvm_builder.load(
            emit_struct_field_address(base_pointer, byte_offset), typ=llvm_field_type
        )

    extension_pointer = emit_struct_field_load(ffi_call_frame, 8)
    has_extension = llvm_builder.icmp_unsigned("!=", extension_pointer, llvm_null_pointer)
    llvm_builder.cbranch(has_extension, extension_basic_block, execute_basic_block)
    llvm_builder.position_at_end(extension_basic_block)
    is_metadata_request = llvm_builder.icmp_unsigned(
        "==",
        emit_struct_field_load(extension_pointer, 8, I32),
        ir.Constant(I32, FFI_METADATA_EXTENSION_TYPE),
    )
    llvm_builder.cbranch(is_metadata_request, metadata_basic_block, execute_basic_block)
    llvm_builder.position_at_end(metadata_basic_block)
    metadata_pointer = emit_struct_field_load(extension_pointer, 24)
    for version_field_offset, version_number in zip((24, 28), read_ffi_api_version(), strict=True):
        llvm_builder.store(
            ir.Constant(I32, version_number),
            emit_struct_field_address(metadata_pointer, version_field_offset),
        )
    llvm_builder.ret(llvm_null_pointer)
    llvm_builder.position_at_end(execute_basic_block)

    def emit_buffer_pointer_table(buffer_list_offset: int, n_buffers: int) -> tuple[Any, Any]:
        """Return LLVM values: a table of pointers to the data of `n_buffers` buffers, and the last
        buffer.

        - `buffer_list_offset`: offset of the list of buffers in the call frame, bytes.
        """
        buffer_list, ffi_buffer = emit_struct_field_load(ffi_call_frame, buffer_list_offset), None
        data_pointer_table = llvm_builder.alloca(llvm_pointer_type, ir.Constant(I64, n_buffers))
        for i in range(n_buffers):
            ffi_buffer = emit_struct_field_load(buffer_list, 8 * i)
            llvm_builder.store(
                emit_struct_field_load(ffi_buffer, 24),
                llvm_builder.gep(
                    data_pointer_table, [ir.Constant(I64, i)], source_etype=llvm_pointer_type
                ),
            )
        return data_pointer_table, ffi_buffer

    input_pointer_table, _ = emit_buffer_pointer_table(72, n_inputs)
    output_pointer_table, last_output_buffer = emit_buffer_pointer_table(112, n_outputs)
    output_rank = emit_struct_field_load(last_output_buffer, 32, I64)
    last_axis_index = llvm_builder.sub(output_rank, ir.Constant(I64, 1))
    n_lanes = llvm_builder.load(
        llvm_builder.gep(
            emit_struct_field_load(last_output_buffer, 40), [last_axis_index], source_etype=I64
        ),
        typ=I64,
    )
    n_lane_groups = llvm_builder.sdiv(n_lanes, ir.Constant(I64, lanes_per_group))
    llvm_builder.call(
        llvm_kernel,
        [input_pointer_table, output_pointer_table, n_lanes, ir.Constant(I64, 0), n_lane_groups],
    )
    llvm_builder.ret(llvm_null_pointer)
