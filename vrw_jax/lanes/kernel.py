"""LLVM module for a jaxpr: a loop over groups of lanes that reads arguments and writes results."""

import math
from dataclasses import dataclass
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
from vrw_jax.lanes.value_emitter import I8, I64, LLVM_NUMBER_TYPES, LlvmValue, ValueEmitter

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
    llvm_builder = ir.IRBuilder(llvm_kernel.append_basic_block("entry"))
    array_emitter = ArrayEmitter(
        ValueEmitter(llvm_builder, max(lanes_per_group, 2)), max_unrolled_entries
    )
    input_pointer_table, output_pointer_table, n_lanes, first_lane_group, end_lane_group = (
        llvm_kernel.args
    )
    argument_avals, result_avals = closed_jaxpr.in_avals, closed_jaxpr.out_avals

    def emit_pointer_loads(pointer_table: LlvmValue, n_pointers: int) -> list[LlvmValue]:
        table = MemoryArray(array_emitter, (n_pointers,), llvm_pointer_type, pointer_table)
        return [table.emit_entry_load((i,)) for i in range(n_pointers)]

    input_pointers = emit_pointer_loads(input_pointer_table, len(argument_avals))
    output_pointers = emit_pointer_loads(output_pointer_table, len(result_avals))

    def emit_lane_group(lane_group_index: LlvmValue, _: Any) -> list[LlvmValue]:
        lane_group_access = _LaneGroupAccess(
            array_emitter,
            lanes_per_group == 1,
            n_lanes,
            llvm_builder.mul(lane_group_index, ir.Constant(I64, lanes_per_group)),
        )
        argument_arrays = list(
            map(lane_group_access.read_argument_array, input_pointers, argument_avals)
        )
        result_arrays = JaxprLowering(array_emitter, PRIMITIVE_RULES).lower_jaxpr(
            closed_jaxpr, argument_arrays
        )
        for output_pointer, aval, result_array in zip(
            output_pointers, result_avals, result_arrays, strict=True
        ):
            lane_group_access.write_result_array(output_pointer, aval, result_array)
        return []

    array_emitter.emit_range_loop(first_lane_group, end_lane_group, emit_lane_group)
    llvm_builder.ret_void()
    add_ffi_handler(
        llvm_module,
        llvm_kernel,
        len(argument_avals),
        len(result_avals),
        lanes_per_group,
    )
    return str(llvm_module)


@dataclass
class _LaneGroupAccess:
    """Emitter of loads and stores for one group of lanes in the caller's arrays.

    The last axis of these arrays is the lane axis.
    """

    array_emitter: ArrayEmitter
    has_single_lane: bool
    n_lanes: LlvmValue
    first_lane_index: LlvmValue

    def read_argument_array(self, base_pointer: LlvmValue, aval: Any) -> LlvmArray:
        """Return the argument at `base_pointer` as an array of LLVM values.

        An argument without axes is one number for all lanes. Raise a NotImplementedError if an axis
        before the last one has the length of the lane axis.
        """
        if LANE_AXIS_SENTINEL in aval.shape[:-1]:
            raise make_lane_axis_error("An argument", aval)
        llvm_builder = self.array_emitter.llvm_builder

        def emit_entry_load(entry_index: EntryIndex) -> LlvmValue:
            entry_address, llvm_stored_type = self.emit_lane_group_address(
                base_pointer, aval, entry_index
            )
            entry_value = llvm_builder.load(
                entry_address, typ=llvm_stored_type, align=aval.dtype.itemsize
            )
            if aval.dtype.kind == "b":
                entry_value = llvm_builder.icmp_signed(
                    "!=",
                    entry_value,
                    self.array_emitter.value_emitter.make_llvm_constant(llvm_stored_type, 0),
                )
            if not (self.has_single_lane and aval.shape):
                return entry_value
            vector = self.array_emitter.value_emitter.to_lane_vector(entry_value)
            if aval.dtype.kind != "f":
                return vector
            # The vector is read from memory. LLVM would else compute only one of two equal entries,
            # and then might not fuse the same products and sums.
            memory = self.array_emitter.allocate_memory_array((2,), entry_value.type)
            for i in range(2):
                memory.emit_entry_store((i,), entry_value)
            return llvm_builder.load(memory.base_pointer, typ=vector.type, align=8)

        argument_array = LazyArray(
            aval.shape[:-1], self.array_emitter.get_entry_type(aval), emit_entry_load
        )
        fits_registers = math.prod(argument_array.shape) <= self.array_emitter.MAX_REGISTER_ENTRIES
        return (
            self.array_emitter.get_array_entries(argument_array)
            if fits_registers
            else argument_array
        )

    def write_result_array(
        self, base_pointer: LlvmValue, aval: Any, result_array: LlvmArray
    ) -> None:
        """Emit stores of `result_array`, for the lanes of the group, into the memory at
        `base_pointer`.

        Raise a NotImplementedError unless the last axis is the lane axis.
        """
        if not has_lane_axis(aval):
            raise LaneAxisError(
                f"A result has the shape {aval.str_short()}, the same for all lanes: compute it "
                "outside, or add zeros of the lanes."
            )
        llvm_builder = self.array_emitter.llvm_builder

        def emit_entry_store(entry_index: EntryIndex, _: Any) -> list[LlvmValue]:
            entry_address, llvm_stored_type = self.emit_lane_group_address(
                base_pointer, aval, entry_index
            )
            entry_value = self.array_emitter.value_emitter.to_lane_vector(
                self.array_emitter.get_array_entry(result_array, entry_index)
            )
            if aval.dtype.kind == "b":
                stored_vector_type = self.array_emitter.value_emitter.make_vector_type(I8)
                entry_value = llvm_builder.zext(entry_value, stored_vector_type)
            if self.has_single_lane:
                # The lane is read from memory, because LLVM would reduce an extracted entry, and
                # all operations before it, to scalars.
                memory = self.array_emitter.allocate_memory_array((), entry_value.type)
                llvm_builder.store(entry_value, memory.base_pointer)
                entry_value = llvm_builder.load(memory.base_pointer, typ=llvm_stored_type)
            llvm_builder.store(entry_value, entry_address, align=aval.dtype.itemsize)
            return []

        self.array_emitter.emit_index_loops(aval.shape[:-1], emit_entry_store)

    def emit_lane_group_address(
        self, base_pointer: LlvmValue, aval: Any, entry_index: EntryIndex
    ) -> tuple[LlvmValue, ir.Type]:
        """Return the address of an array entry for the first lane of the group, and the LLVM type
        to load or store there.
        """
        llvm_builder = self.array_emitter.llvm_builder
        llvm_element_type = I8 if aval.dtype.kind == "b" else LLVM_NUMBER_TYPES[aval.dtype.name]
        if aval.shape == ():
            return base_pointer, llvm_element_type
        entry_offset = self.array_emitter.emit_memory_offset(entry_index, aval.shape[:-1])
        lane_offset = llvm_builder.add(
            llvm_builder.mul(entry_offset, self.n_lanes), self.first_lane_index
        )
        llvm_stored_type = (
            llvm_element_type
            if self.has_single_lane
            else self.array_emitter.value_emitter.make_vector_type(llvm_element_type)
        )
        return llvm_builder.gep(
            base_pointer, [lane_offset], source_etype=llvm_element_type
        ), llvm_stored_type
