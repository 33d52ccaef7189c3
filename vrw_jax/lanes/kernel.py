"""LLVM module for a jaxpr: a loop over groups of lanes, and the function by which XLA calls it.

XLA calls the latter through its foreign function interface (FFI).
"""

import functools
import math
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
from jax.extend.core import ClosedJaxpr

from vrw_jax.lanes.array_emitter import (
    LANE_AXIS_SENTINEL,
    MAX_UNROLLED_ENTRIES,
    ArrayEmitter,
    LaneAxisError,
    has_lane_axis,
    make_lane_axis_error,
)
from vrw_jax.lanes.lazy_arrays import EntryIndex, LazyArray, LlvmArray, MemoryArray
from vrw_jax.lanes.lowering import JaxprLowering
from vrw_jax.lanes.machine import ir
from vrw_jax.lanes.value_emitter import (
    I8,
    I32,
    I64,
    LLVM_NUMBER_TYPES,
    LlvmValue,
    TextBuilder,
    ValueEmitter,
)

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


LANE_KERNEL_NAME = "lanes"


def write_llvm_kernel(
    closed_jaxpr: ClosedJaxpr,
    lanes_per_group: int,
    max_unrolled_entries: int = MAX_UNROLLED_ENTRIES,
) -> str:
    """Return the LLVM text of a function that computes the jaxpr for a range of groups of lanes.

    The signature is
    `void lanes(const void **inputs, void **outputs, int64 lanes, int64 begin, int64 end)`. The
    function loops over the groups from `begin` to `end`, each of `lanes_per_group` lanes. If
    `lanes_per_group` is 1, the lane is computed twice, in a vector, because LLVM's code for scalars
    differs in the last digits.
    """
    llvm_module = ir.Module(LANE_KERNEL_NAME)
    llvm_pointer_type = ir.PointerType()
    llvm_kernel = ir.Function(
        llvm_module,
        ir.FunctionType(ir.VoidType(), [llvm_pointer_type, llvm_pointer_type, I64, I64, I64]),
        LANE_KERNEL_NAME,
    )
    llvm_kernel.attributes.add("nounwind")
    llvm_builder = TextBuilder(llvm_kernel.append_basic_block("entry"))
    value_emitter = ValueEmitter(llvm_builder, max(lanes_per_group, 2))
    array_emitter = ArrayEmitter(value_emitter, max_unrolled_entries)
    inputs, outputs, n_lanes, first_lane_group, end_lane_group = llvm_kernel.args
    argument_avals, result_avals = closed_jaxpr.in_avals, closed_jaxpr.out_avals

    def load_pointers(pointer_table: LlvmValue, n_pointers: int) -> list[LlvmValue]:
        table = MemoryArray(array_emitter, (n_pointers,), llvm_pointer_type, pointer_table)
        return [table.emit_entry_load((i,)) for i in range(n_pointers)]

    input_pointers = load_pointers(inputs, len(argument_avals))
    output_pointers = load_pointers(outputs, len(result_avals))

    def emit_lane_group(lane_group_index: LlvmValue, _: Any) -> list[LlvmValue]:
        first_lane = llvm_builder.mul(lane_group_index, ir.Constant(I64, lanes_per_group))
        read_argument, write_result = _make_lane_access(
            array_emitter, lanes_per_group, n_lanes, first_lane
        )
        arguments = list(map(read_argument, input_pointers, argument_avals))
        lowering = JaxprLowering(array_emitter)
        results = lowering.lower_jaxpr(closed_jaxpr, arguments)
        for pointer, aval, result in zip(output_pointers, result_avals, results, strict=True):
            write_result(pointer, aval, result)
        return []

    array_emitter.emit_range_loop(first_lane_group, end_lane_group, emit_lane_group)
    llvm_builder.ret_void()
    n_arguments, n_results = len(argument_avals), len(result_avals)
    add_ffi_handler(llvm_module, llvm_kernel, n_arguments, n_results, lanes_per_group)
    return str(llvm_module)


def _make_lane_access(
    array_emitter: ArrayEmitter, lanes_per_group: int, n_lanes: LlvmValue, first_lane: LlvmValue
) -> tuple[Callable[..., LlvmArray], Callable[..., None]]:
    """Return functions that read an argument and write a result of the lanes from `first_lane`."""
    value_emitter, llvm_builder = array_emitter.value_emitter, array_emitter.llvm_builder
    has_single_lane = lanes_per_group == 1

    def emit_address(base: LlvmValue, aval: Any, entry_index: EntryIndex) -> tuple:
        """Return the address of an entry for the first lane of the group, and its type there.

        The last axis of the caller's arrays is the lane axis.
        """
        number_type = I8 if aval.dtype.kind == "b" else LLVM_NUMBER_TYPES[aval.dtype.name]
        if aval.shape == ():
            return base, number_type
        entry_offset = array_emitter.emit_memory_offset(entry_index, aval.shape[:-1])
        lane_offset = llvm_builder.add(llvm_builder.mul(entry_offset, n_lanes), first_lane)
        address = llvm_builder.gep(base, [lane_offset], source_etype=number_type)
        if has_single_lane:
            return address, number_type
        return address, value_emitter.make_vector_type(number_type)

    def read_argument(base: LlvmValue, aval: Any) -> LlvmArray:
        """Return an argument; one without axes is one number for all lanes."""
        if LANE_AXIS_SENTINEL in aval.shape[:-1]:
            raise make_lane_axis_error("An argument", aval)

        def load_entry(entry_index: EntryIndex) -> LlvmValue:
            address, stored_type = emit_address(base, aval, entry_index)
            value = llvm_builder.load(address, typ=stored_type, align=aval.dtype.itemsize)
            if aval.dtype.kind == "b":
                zero = value_emitter.make_llvm_constant(stored_type, 0)
                value = llvm_builder.icmp_signed("!=", value, zero)
            if not (has_single_lane and aval.shape):
                return value
            vector = value_emitter.to_lane_vector(value)
            if aval.dtype.kind != "f":
                return vector
            # The vector is read from memory. LLVM would else compute only one of two equal
            # entries, and then might not fuse the same products and sums.
            memory = array_emitter.allocate_memory_array((2,), value.type)
            for i in range(2):
                memory.emit_entry_store((i,), value)
            return llvm_builder.load(memory.base_pointer, typ=vector.type, align=8)

        array = LazyArray(aval.shape[:-1], array_emitter.get_entry_type(aval), load_entry)
        fits_registers = math.prod(array.shape) <= array_emitter.MAX_REGISTER_ENTRIES
        return array_emitter.get_array_entries(array) if fits_registers else array

    def write_result(base: LlvmValue, aval: Any, result: LlvmArray) -> None:
        if not has_lane_axis(aval):
            raise LaneAxisError(
                f"A result has the shape {aval.str_short()}, the same for all lanes: compute "
                "it outside, or add zeros of the lanes."
            )

        if 0 in aval.shape:
            return

        def store_entry(entry_index: EntryIndex, _: Any) -> list[LlvmValue]:
            address, stored_type = emit_address(base, aval, entry_index)
            value = value_emitter.to_lane_vector(array_emitter.get_array_entry(result, entry_index))
            if aval.dtype.kind == "b":
                value = llvm_builder.zext(value, value_emitter.make_vector_type(I8))
            if has_single_lane:
                # The lane is read from memory, because LLVM would reduce an extracted entry,
                # and all operations before it, to scalars.
                memory = array_emitter.allocate_memory_array((), value.type)
                llvm_builder.store(value, memory.base_pointer)
                value = llvm_builder.load(memory.base_pointer, typ=stored_type)
            llvm_builder.store(value, address, align=aval.dtype.itemsize)
            return []

        array_emitter.emit_index_loops(aval.shape[:-1], store_entry)

    return read_argument, write_result
