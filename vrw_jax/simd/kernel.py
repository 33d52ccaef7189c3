"""The LLVM module of a trace: a loop over groups of lanes with its inputs and outputs."""

import math
from typing import Any

from jax.extend.core import ClosedJaxpr

from vrw_jax.simd.array_emitter import (
    DEFAULT_LIMITS,
    LANE_AXIS_SENTINEL,
    ArrayEmitter,
    RegisterLimits,
    has_lanes,
    lane_axis_error,
)
from vrw_jax.simd.ffi_handler import add_handler, read_api_version
from vrw_jax.simd.lazy_arrays import ArrayValue, EntryIndex, LazyArray
from vrw_jax.simd.llvm_library import ir
from vrw_jax.simd.lowering import JaxprLowering
from vrw_jax.simd.rules import PRIMITIVE_RULES
from vrw_jax.simd.value_emitter import I1, I8, I64, NUMBER_TYPES, Value, ValueEmitter

KERNEL_NAME = "lanes"


def write_module(
    closed_jaxpr: ClosedJaxpr, group_width: int, limits: RegisterLimits = DEFAULT_LIMITS
) -> str:
    """Return the LLVM text of a function that computes a range of groups of lanes.

    Its signature is `void lanes(const void **inputs, void **outputs, int64 lanes, int64 begin,
    int64 end)`. The function loops over the groups from `begin` to `end`, each of `group_width`
    lanes. A single lane is computed twice, as a vector, because LLVM's code for scalars differs in
    the last digits.
    """
    _check_lane_axes(closed_jaxpr)
    module = ir.Module(KERNEL_NAME)
    pointer_type = ir.PointerType()
    kernel = ir.Function(
        module,
        ir.FunctionType(ir.VoidType(), [pointer_type, pointer_type, I64, I64, I64]),
        KERNEL_NAME,
    )
    kernel.attributes.add("nounwind")
    builder = ir.IRBuilder(kernel.append_basic_block("entry"))
    emitter = ArrayEmitter(ValueEmitter(builder, max(group_width, 2)), limits)
    input_table, output_table, n_lanes, first_group, end_group = kernel.args
    input_avals, output_avals = closed_jaxpr.in_avals, closed_jaxpr.out_avals

    def load_pointer(table: Value, index: int) -> Value:
        entry_pointer = builder.gep(table, [ir.Constant(I64, index)], source_etype=pointer_type)
        return builder.load(entry_pointer, typ=pointer_type)

    input_pointers = [load_pointer(input_table, i) for i in range(len(input_avals))]
    output_pointers = [load_pointer(output_table, i) for i in range(len(output_avals))]

    def emit_group(group_index: Value, _: Any) -> list[Value]:
        row_access = _LaneRowAccess(
            emitter,
            group_width == 1,
            n_lanes,
            builder.mul(group_index, ir.Constant(I64, group_width)),
        )
        values = [
            row_access.read_argument(*pair)
            for pair in zip(input_pointers, input_avals, strict=True)
        ]
        results = JaxprLowering(emitter, PRIMITIVE_RULES).lower_jaxpr(closed_jaxpr, values)
        for output_pointer, aval, value in zip(output_pointers, output_avals, results, strict=True):
            row_access.write_result(output_pointer, aval, value)
        return []

    emitter.loop_over_range(first_group, end_group, emit_group)
    builder.ret_void()
    add_handler(
        module, kernel, len(input_avals), len(output_avals), group_width, read_api_version()
    )
    return str(module)


def _check_lane_axes(closed_jaxpr: ClosedJaxpr) -> None:
    """Raise an error unless the lane axis is the last axis of every argument and result, and no
    other axis.
    """
    for array_description, avals in (
        ("An argument", closed_jaxpr.in_avals),
        ("A result", closed_jaxpr.out_avals),
    ):
        for aval in avals:
            if LANE_AXIS_SENTINEL in aval.shape[:-1]:
                raise lane_axis_error(array_description, aval)
    for aval in closed_jaxpr.out_avals:
        if not has_lanes(aval):
            raise NotImplementedError(
                f"A result has the shape {aval.str_short()}, the same for all lanes: compute it "
                "outside, or add zeros of the lanes."
            )


class _LaneRowAccess:
    """Access of one group of lanes to the arrays of the caller, whose last axis are the lanes."""

    def __init__(
        self, emitter: ArrayEmitter, is_single_lane: bool, n_lanes: Value, first_lane: Value
    ) -> None:
        self.emitter, self.is_single_lane = emitter, is_single_lane
        self.n_lanes, self.first_lane = n_lanes, first_lane

    def read_argument(self, base_pointer: Value, aval: Any) -> ArrayValue:
        """Return an argument as an array of LLVM values; a number without axes is the same for all
        lanes.
        """
        builder = self.emitter.builder

        def load_entry(index: EntryIndex) -> Value:
            address, stored_type = self.row_address(base_pointer, aval, index)
            value = builder.load(address, typ=stored_type, align=aval.dtype.itemsize)
            if aval.dtype.kind == "b":
                value = builder.icmp_signed(
                    "!=", value, self.emitter.emitter.constant(stored_type, 0)
                )
            return (
                self.emitter.emitter.splat(value) if self.is_single_lane and aval.shape else value
            )

        argument_array = LazyArray(aval.shape[:-1], self.emitter.entry_type_of(aval), load_entry)
        fits_registers = math.prod(argument_array.shape) <= self.emitter.limits.max_registers
        return self.emitter.get_entries(argument_array) if fits_registers else argument_array

    def write_result(self, base_pointer: Value, aval: Any, value: ArrayValue) -> None:
        """Emit stores of a result of the group into the memory that begins at `base_pointer`."""
        builder = self.emitter.builder

        def store_row(index: EntryIndex, _: Any) -> list[Value]:
            address, stored_type = self.row_address(base_pointer, aval, index)
            stored_value = self.emitter.emitter.splat(self.emitter.get_entry(value, index))
            if self.is_single_lane:
                stored_value = builder.extract_element(stored_value, ir.Constant(I64, 0))
            if aval.dtype.kind == "b":
                stored_value = builder.zext(stored_value, stored_type)
            builder.store(stored_value, address, align=aval.dtype.itemsize)
            return []

        self.emitter.loop_over_indices(aval.shape[:-1], store_row)

    def row_address(
        self, base_pointer: Value, aval: Any, index: EntryIndex
    ) -> tuple[Value, ir.Type]:
        """Return the address of the group's lanes of one entry, and the LLVM type in which they are
        stored.
        """
        builder, element_type = self.emitter.builder, NUMBER_TYPES[aval.dtype.name]
        element_type = I8 if element_type == I1 else element_type
        if aval.shape == ():
            return base_pointer, element_type
        row_index = self.emitter.linear_index(index, aval.shape[:-1])
        offset = builder.add(builder.mul(row_index, self.n_lanes), self.first_lane)
        stored_type = (
            element_type if self.is_single_lane else self.emitter.emitter.vector_type(element_type)
        )
        return builder.gep(base_pointer, [offset], source_etype=element_type), stored_type
