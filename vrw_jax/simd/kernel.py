"""An LLVM module for a trace: a loop over groups of lanes with its inputs and outputs."""

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
    closed_jaxpr: ClosedJaxpr, width: int, limits: RegisterLimits = DEFAULT_LIMITS
) -> str:
    """Return the LLVM text of the kernel, which computes a range of groups of lanes.

    Its signature is `void lanes(const void **inputs, void **outputs, int64 lanes, int64 begin,
    int64 end)`. The function loops over groups of `width` lanes. A single lane is computed twice,
    as a vector, because LLVM's code for scalars differs in the last digits.
    """
    _check_lane_axes(closed_jaxpr)
    module = ir.Module(KERNEL_NAME)
    pointer = ir.PointerType()
    kernel = ir.Function(
        module, ir.FunctionType(ir.VoidType(), [pointer, pointer, I64, I64, I64]), KERNEL_NAME
    )
    kernel.attributes.add("nounwind")
    build = ir.IRBuilder(kernel.append_basic_block("entry"))
    arrays = ArrayEmitter(ValueEmitter(build, max(width, 2)), limits)
    input_table, output_table, n_lanes, begin, end = kernel.args
    inputs, outputs = closed_jaxpr.in_avals, closed_jaxpr.out_avals

    def load_pointer(base: Value, index: int) -> Value:
        slot = build.gep(base, [ir.Constant(I64, index)], source_etype=pointer)
        return build.load(slot, typ=pointer)

    sources = [load_pointer(input_table, i) for i in range(len(inputs))]
    targets = [load_pointer(output_table, i) for i in range(len(outputs))]

    def emit_group(group_index: Value, _: Any) -> list[Value]:
        row_access = _RowAccess(
            arrays, width == 1, n_lanes, build.mul(group_index, ir.Constant(I64, width))
        )
        values = [row_access.read_argument(*pair) for pair in zip(sources, inputs, strict=True)]
        results = JaxprLowering(arrays, PRIMITIVE_RULES).lower_jaxpr(closed_jaxpr, values)
        for target, aval, value in zip(targets, outputs, results, strict=True):
            row_access.write_result(target, aval, value)
        return []

    arrays.loop_over_range(begin, end, emit_group)
    build.ret_void()
    add_handler(module, kernel, len(inputs), len(outputs), width, read_api_version())
    return str(module)


def _check_lane_axes(closed_jaxpr: ClosedJaxpr) -> None:
    """Raise an error unless the lanes are the last axis of every argument and result, and
    no other.
    """
    for description, avals in (
        ("An argument", closed_jaxpr.in_avals),
        ("A result", closed_jaxpr.out_avals),
    ):
        for aval in avals:
            if LANE_AXIS_SENTINEL in aval.shape[:-1]:
                raise lane_axis_error(description, aval)
    for aval in closed_jaxpr.out_avals:
        if not has_lanes(aval):
            raise NotImplementedError(
                f"A result has the shape {aval.str_short()}, the same for all lanes: compute it "
                "outside, or add zeros of the lanes."
            )


class _RowAccess:
    """Access to arrays outside for a group of lanes: they are stored row after row, lanes last."""

    def __init__(
        self, emitter: ArrayEmitter, is_single_lane: bool, n_lanes: Value, lane: Value
    ) -> None:
        self.emitter, self.is_single_lane = emitter, is_single_lane
        self.n_lanes, self.lane = n_lanes, lane

    def read_argument(self, base: Value, aval: Any) -> ArrayValue:
        """Return an argument; a number without axes is the same for all lanes."""
        build = self.emitter.builder

        def load_entry(index: EntryIndex) -> Value:
            address, kind = self.row_address(base, aval, index)
            value = build.load(address, typ=kind, align=aval.dtype.itemsize)
            if aval.dtype.kind == "b":
                value = build.icmp_signed("!=", value, self.emitter.emitter.constant(kind, 0))
            return (
                self.emitter.emitter.splat(value) if self.is_single_lane and aval.shape else value
            )

        field = LazyArray(aval.shape[:-1], self.emitter.entry_type_of(aval), load_entry)
        fits_registers = math.prod(field.shape) <= self.emitter.limits.max_registers
        return self.emitter.get_entries(field) if fits_registers else field

    def write_result(self, base: Value, aval: Any, value: ArrayValue) -> None:
        """Store a result of the group in the memory that begins at `base`."""
        build = self.emitter.builder

        def store_row(index: EntryIndex, _: Any) -> list[Value]:
            address, kind = self.row_address(base, aval, index)
            stored_value = self.emitter.emitter.splat(self.emitter.get_entry(value, index))
            if self.is_single_lane:
                stored_value = build.extract_element(stored_value, ir.Constant(I64, 0))
            if aval.dtype.kind == "b":
                stored_value = build.zext(stored_value, kind)
            build.store(stored_value, address, align=aval.dtype.itemsize)
            return []

        self.emitter.loop_over_indices(aval.shape[:-1], store_row)

    def row_address(self, base: Value, aval: Any, index: EntryIndex) -> tuple[Value, ir.Type]:
        """Return the address of a row's lanes, and the type in which they are stored."""
        build, number = self.emitter.builder, NUMBER_TYPES[aval.dtype.name]
        number = I8 if number == I1 else number
        if aval.shape == ():
            return base, number
        row = self.emitter.linear_index(index, aval.shape[:-1])
        offset = build.add(build.mul(row, self.n_lanes), self.lane)
        kind = number if self.is_single_lane else self.emitter.emitter.vector_type(number)
        return build.gep(base, [offset], source_etype=number), kind
