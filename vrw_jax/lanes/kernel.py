"""LLVM module for a jaxpr: a loop over groups of lanes that reads arguments and writes results."""

import math
from typing import Any

from jax.extend.core import ClosedJaxpr

from vrw_jax.lanes.array_emitter import (
    LANE_AXIS_SENTINEL,
    MAX_UNROLLED_ENTRIES,
    ArrayEmitter,
    LaneAxisError,
    has_lane_axis,
    make_lane_axis_error,
)
from vrw_jax.lanes.ffi_handler import add_ffi_handler
from vrw_jax.lanes.lazy_arrays import EntryIndex, LazyArray, LlvmArray, MemoryArray
from vrw_jax.lanes.llvm_library import ir
from vrw_jax.lanes.lowering import JaxprLowering
from vrw_jax.lanes.rules import PRIMITIVE_RULES
from vrw_jax.lanes.value_emitter import (
    I8,
    I64,
    LLVM_NUMBER_TYPES,
    LlvmValue,
    TextBuilder,
    ValueEmitter,
)

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
    has_single_lane = lanes_per_group == 1

    def load_pointers(pointer_table: LlvmValue, n_pointers: int) -> list[LlvmValue]:
        table = MemoryArray(array_emitter, (n_pointers,), llvm_pointer_type, pointer_table)
        return [table.emit_entry_load((i,)) for i in range(n_pointers)]

    input_pointers = load_pointers(inputs, len(argument_avals))
    output_pointers = load_pointers(outputs, len(result_avals))

    def emit_lane_group(lane_group_index: LlvmValue, _: Any) -> list[LlvmValue]:
        first_lane = llvm_builder.mul(lane_group_index, ir.Constant(I64, lanes_per_group))

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
                value = value_emitter.to_lane_vector(
                    array_emitter.get_array_entry(result, entry_index)
                )
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

        arguments = list(map(read_argument, input_pointers, argument_avals))
        lowering = JaxprLowering(array_emitter, PRIMITIVE_RULES)
        results = lowering.lower_jaxpr(closed_jaxpr, arguments)
        for pointer, aval, result in zip(output_pointers, result_avals, results, strict=True):
            write_result(pointer, aval, result)
        return []

    array_emitter.emit_range_loop(first_lane_group, end_lane_group, emit_lane_group)
    llvm_builder.ret_void()
    n_arguments, n_results = len(argument_avals), len(result_avals)
    add_ffi_handler(llvm_module, llvm_kernel, n_arguments, n_results, lanes_per_group)
    return str(llvm_module)
