"""The machine-code function that XLA calls through its foreign function interface (FFI)."""

from typing import Any

import llvmlite.ir as ir

from vrw_jax.simd.numbers import BYTE, INT, LONG

HANDLER = "handler"


def add_handler(module: ir.Module, kernel: ir.Function, n_in: int, n_out: int, width: int) -> None:
    """Add `XLA_FFI_Error *handler(XLA_FFI_CallFrame *)`, which calls the kernel, to the module.

    Offsets are in bytes, from XLA's xla/ffi/api/c_api.h, whose structs only grow at their ends.
    """
    pointer = ir.PointerType()
    handler = ir.Function(module, ir.FunctionType(pointer, [pointer]), HANDLER)
    handler.attributes.add("nounwind")
    build = ir.IRBuilder(handler.append_basic_block("entry"))
    asked, called = (handler.append_basic_block(name) for name in ("asked", "called"))
    frame, none = handler.args[0], ir.Constant(pointer, None)

    def at(base: Any, offset: int) -> Any:
        return build.gep(base, [ir.Constant(LONG, offset)], source_etype=BYTE)

    def read(base: Any, offset: int, kind: ir.Type = pointer) -> Any:
        return build.load(at(base, offset), typ=kind)

    extension = read(frame, 8)
    build.cbranch(build.icmp_unsigned("==", extension, none), called, asked)
    build.position_at_end(
        asked
    )  # XLA requests the version of the interface: return the caller's version
    metadata, version = read(extension, 24), at(read(frame, 16), 16)
    for field in (16, 20):
        build.store(read(version, field, INT), at(metadata, 8 + field))
    build.ret(none)
    build.position_at_end(called)

    def buffers(offset: int, count: int) -> tuple[Any, Any]:
        """Return pointers to the data of a list of buffers, and the last buffer."""
        listed, buffer = read(frame, offset), None
        pointers = build.alloca(pointer, ir.Constant(LONG, count))
        for i in range(count):
            buffer = read(listed, 8 * i)
            build.store(
                read(buffer, 24), build.gep(pointers, [ir.Constant(LONG, i)], source_etype=pointer)
            )
        return pointers, buffer

    given, _ = buffers(72, n_in)
    told, first = buffers(112, n_out)
    rank = read(first, 32, LONG)
    last = build.sub(rank, ir.Constant(LONG, 1))
    n_lanes = build.load(build.gep(read(first, 40), [last], source_etype=LONG), typ=LONG)
    groups = build.sdiv(n_lanes, ir.Constant(LONG, width))
    build.call(kernel, [given, told, n_lanes, ir.Constant(LONG, 0), groups])
    build.ret(none)
