"""The machine-code function that XLA calls through its foreign function interface (FFI)."""

from typing import Any

import llvmlite.ir as ir

from vrw_jax.simd.value_emitter import I8, I32, I64

HANDLER_NAME = "handler"


def add_handler(module: ir.Module, kernel: ir.Function, n_in: int, n_out: int, width: int) -> None:
    """Add `XLA_FFI_Error *handler(XLA_FFI_CallFrame *)`, which calls the kernel, to the module.

    Offsets are in bytes, from XLA's xla/ffi/api/c_api.h, whose structs only grow at their ends.
    """
    pointer = ir.PointerType()
    handler = ir.Function(module, ir.FunctionType(pointer, [pointer]), HANDLER_NAME)
    handler.attributes.add("nounwind")
    build = ir.IRBuilder(handler.append_basic_block("entry"))
    metadata_block, execute_block = (
        handler.append_basic_block(name) for name in ("metadata", "execute")
    )
    frame, null = handler.args[0], ir.Constant(pointer, None)

    def field_address(base: Any, offset: int) -> Any:
        return build.gep(base, [ir.Constant(I64, offset)], source_etype=I8)

    def load_field(base: Any, offset: int, kind: ir.Type = pointer) -> Any:
        return build.load(field_address(base, offset), typ=kind)

    extension = load_field(frame, 8)
    build.cbranch(build.icmp_unsigned("==", extension, null), execute_block, metadata_block)
    # XLA requests the version of the interface: return the caller's version.
    build.position_at_end(metadata_block)
    metadata, version = load_field(extension, 24), field_address(load_field(frame, 16), 16)
    for field in (16, 20):
        build.store(load_field(version, field, I32), field_address(metadata, 8 + field))
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
