"""Rules of primitives that move entries: indexing, slicing, concatenation and reshaping.

Each rule returns an array of LLVM values.
"""

import bisect
import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from vrw_jax.lanes.arithmetic import emit_llvm_elementwise_primitive
from vrw_jax.lanes.array_emitter import (
    ArrayEmitter,
    PrimitiveCall,
    has_lane_axis,
    make_lane_mixing_error,
)
from vrw_jax.lanes.lazy_arrays import (
    EntryIndex,
    JoinedArray,
    LazyArray,
    LlvmArray,
    MemoryArray,
    PendingArrayUpdate,
    TransposedMemoryView,
    UninitializedArray,
)
from vrw_jax.lanes.llvm_library import ir
from vrw_jax.lanes.lowering import JaxprLowering
from vrw_jax.lanes.value_emitter import I64, LlvmValue


def emit_broadcast_array(
    array_emitter: ArrayEmitter, primitive_call: PrimitiveCall, array: LlvmArray, *_: Any
) -> LlvmArray:
    """Return the array repeated along new axes, of which the last may be the lane axis."""
    result_shape = primitive_call.result_shape
    entry_type = array_emitter.get_entry_type(primitive_call.result_aval)
    axis_positions = tuple(map(int, primitive_call.primitive_params["broadcast_dimensions"]))
    array = array_emitter.drop_extra_axis(array, len(result_shape))
    if (
        has_lane_axis(primitive_call.result_aval)
        and len(array.shape) == len(axis_positions)
        and axis_positions[-1:] == (len(result_shape),)
    ):
        # The array is one number for each lane.
        array = array_emitter.reshape_array(array, array.shape[:-1])
    if (
        isinstance(array, MemoryArray)
        and array.entry_type == entry_type
        and math.prod(array.shape) == math.prod(result_shape)
    ):
        return array_emitter.reshape_array(array, result_shape)
    broadcast_array = array_emitter.broadcast_array(
        array, result_shape, axis_positions[: len(array.shape)]
    )
    if isinstance(broadcast_array, LazyArray):
        return LazyArray(result_shape, entry_type, broadcast_array.get_entry_at_index)
    return broadcast_array


def emit_reshaped_array(
    array_emitter: ArrayEmitter, primitive_call: PrimitiveCall, array: LlvmArray
) -> LlvmArray:
    """Return the array in another shape, with the same entries in the same order."""
    return array_emitter.reshape_array(array, primitive_call.result_shape)


def emit_transposed_array(
    array_emitter: ArrayEmitter, primitive_call: PrimitiveCall, array: LlvmArray
) -> LlvmArray:
    """Return the array with its axes in the order of the parameter `permutation`."""
    axis_order = primitive_call.primitive_params["permutation"][: len(array.shape)]
    if isinstance(array, np.ndarray):
        return array.transpose(axis_order)
    inverse_axis_order = np.argsort(axis_order)
    get_transposed_entry = lambda entry_index: array_emitter.get_array_entry(
        array, tuple(entry_index[i] for i in inverse_axis_order)
    )
    transposed_array_class = (
        TransposedMemoryView if isinstance(array, MemoryArray | TransposedMemoryView) else LazyArray
    )
    return transposed_array_class(
        primitive_call.result_shape, array.entry_type, get_transposed_entry
    )


def emit_static_slice(
    array_emitter: ArrayEmitter, primitive_call: PrimitiveCall, array: LlvmArray
) -> LlvmArray:
    """Return the entries from a start index to a limit along each axis, with a stride."""
    slice_params = primitive_call.primitive_params
    slice_starts = slice_params["start_indices"]
    slice_strides = slice_params["strides"] or (1,) * len(slice_starts)
    axis_slices = list(map(slice, slice_starts, slice_params["limit_indices"], slice_strides))
    return _take_slice(array_emitter, array, axis_slices[: len(array.shape)])


def _take_slice(
    array_emitter: ArrayEmitter, array: LlvmArray, axis_slices: Sequence[slice]
) -> LlvmArray:
    """Return the entries of an array that the slices of its axes contain."""
    if isinstance(array, np.ndarray):
        return array[tuple(axis_slices)]

    def get_sliced_entry(slice_index: EntryIndex) -> LlvmValue:
        indices_and_slices = zip(slice_index, axis_slices, strict=True)
        return array_emitter.get_array_entry(
            array,
            tuple(
                array_emitter.emit_affine_index(i, axis_slice.start, axis_slice.step)
                for i, axis_slice in indices_and_slices
            ),
        )

    slice_shape = tuple(len(range(x.start, x.stop, x.step)) for x in axis_slices)
    return LazyArray(slice_shape, array.entry_type, get_sliced_entry)


def _split_along_axis(
    jaxpr_lowering: JaxprLowering, equation: Any, array: LlvmArray, part_lengths: Sequence[int]
) -> list[LlvmArray]:
    """Return the parts of an array that follow each other along the axis of an equation."""
    split_axis = equation.params["axis"]
    if split_axis == len(array.shape):
        raise make_lane_mixing_error(equation.primitive.name)
    whole_axes = [slice(0, axis_length, 1) for axis_length in array.shape]
    part_ends = np.cumsum(part_lengths).tolist()
    return [
        _take_slice(
            jaxpr_lowering.array_emitter,
            array,
            [
                *whole_axes[:split_axis],
                slice(part_end - part_length, part_end, 1),
                *whole_axes[split_axis + 1 :],
            ],
        )
        for part_end, part_length in zip(part_ends, part_lengths, strict=True)
    ]


def emit_concatenated_array(
    array_emitter: ArrayEmitter, primitive_call: PrimitiveCall, *joined_arrays: LlvmArray
) -> LlvmArray:
    """Return the arrays joined along an existing axis."""
    return _concatenate_along_axis(
        array_emitter, primitive_call, primitive_call.primitive_params["dimension"], joined_arrays
    )


def emit_stacked_array(
    array_emitter: ArrayEmitter, primitive_call: PrimitiveCall, *stacked_arrays: LlvmArray
) -> LlvmArray:
    """Return the arrays, all of one shape, stacked along a new axis."""
    new_axis = primitive_call.primitive_params["axis"]
    expanded_arrays = [
        array_emitter.reshape_array(x, (*x.shape[:new_axis], 1, *x.shape[new_axis:]))
        for x in stacked_arrays
    ]
    return _concatenate_along_axis(array_emitter, primitive_call, new_axis, expanded_arrays)


def emit_unstacked_arrays(
    jaxpr_lowering: JaxprLowering, equation: Any, operands: list[LlvmArray]
) -> list[LlvmArray]:
    """Return the arrays of equal shape that result from splitting an array along one axis."""
    parts = _split_along_axis(jaxpr_lowering, equation, operands[0], [1] * len(equation.outvars))
    reshape_array, split_axis = jaxpr_lowering.array_emitter.reshape_array, equation.params["axis"]
    return [reshape_array(x, (*x.shape[:split_axis], *x.shape[split_axis + 1 :])) for x in parts]


def emit_split_arrays(
    jaxpr_lowering: JaxprLowering, equation: Any, operands: list[LlvmArray]
) -> list[LlvmArray]:
    """Return the parts of an array that follow each other along one axis."""
    return _split_along_axis(jaxpr_lowering, equation, operands[0], equation.params["sizes"])


def emit_optimization_barrier(
    jaxpr_lowering: JaxprLowering, equation: Any, operands: list[LlvmArray]
) -> list[LlvmArray]:
    """Return the operands. Large lazy arrays among them are computed and stored in memory at this
    point.
    """
    return [
        jaxpr_lowering.array_emitter.store_array_in_memory(x) if isinstance(x, LazyArray) else x
        for x in operands
    ]


def _concatenate_along_axis(
    array_emitter: ArrayEmitter,
    primitive_call: PrimitiveCall,
    join_axis: int,
    joined_arrays: Sequence[LlvmArray],
) -> LlvmArray:
    """Return the arrays joined along the existing axis `join_axis`."""
    result_shape = primitive_call.result_shape
    if join_axis == len(result_shape):
        raise make_lane_mixing_error(primitive_call.primitive_name)
    if all(isinstance(x, np.ndarray) for x in joined_arrays):
        return np.concatenate(joined_arrays, join_axis)  # type: ignore[arg-type]
    nonempty_arrays = [x for x in joined_arrays if x.shape[join_axis]]
    part_starts = np.cumsum([0, *(x.shape[join_axis] for x in nonempty_arrays)]).tolist()

    def select_joined_array_entry(result_index: EntryIndex) -> LlvmValue:
        def get_part_entry(part: LlvmArray, index_in_part: Any) -> LlvmValue:
            return array_emitter.get_array_entry(
                part, (*result_index[:join_axis], index_in_part, *result_index[join_axis + 1 :])
            )

        i, selected_entry = result_index[join_axis], None
        if isinstance(i, int):
            part_position = bisect.bisect_right(part_starts, i) - 1
            return get_part_entry(nonempty_arrays[part_position], i - part_starts[part_position])
        for part, part_start in zip(nonempty_arrays, part_starts, strict=False):
            # Beyond the end of a part any entry is valid, because the select below discards it.
            part_entry = get_part_entry(
                part,
                array_emitter.emit_clamped_index(
                    array_emitter.emit_affine_index(i, -part_start), part.shape[join_axis] - 1
                ),
            )
            if selected_entry is None:
                selected_entry = part_entry
                continue
            is_past_start = array_emitter.llvm_builder.icmp_signed(
                ">=", i, ir.Constant(I64, part_start)
            )
            selected_entry = array_emitter.llvm_builder.select(
                is_past_start,
                *array_emitter.value_emitter.to_scalars_or_vectors(part_entry, selected_entry),
            )
        return selected_entry

    return JoinedArray(
        result_shape,
        array_emitter.get_entry_type(primitive_call.result_aval),
        select_joined_array_entry,
        nonempty_arrays,
        [
            tuple(start if axis == join_axis else 0 for axis in range(len(result_shape)))
            for start in part_starts[:-1]
        ],
    )


def emit_padded_array(
    array_emitter: ArrayEmitter,
    primitive_call: PrimitiveCall,
    array: LlvmArray,
    padding_value: LlvmArray,
) -> LlvmArray:
    """Return the array with entries `padding_value` added before and after it along each axis."""
    padding_widths = primitive_call.primitive_params["padding_config"]
    if any(min(widths) < 0 or widths[2] for widths in padding_widths):
        raise NotImplementedError("pad takes entries away or puts some between: slice and stack.")
    padded_array = np.broadcast_to(
        array_emitter.get_array_entries(padding_value).reshape(()),
        primitive_call.result_shape,
    ).copy()
    unpadded_slices = tuple(
        slice(n_before, n_before + n)
        for (n_before, _, _), n in zip(padding_widths, array.shape, strict=False)
    )
    padded_array[unpadded_slices] = array_emitter.get_array_entries(array)
    return padded_array


def emit_uninitialized_array(
    array_emitter: ArrayEmitter, primitive_call: PrimitiveCall
) -> LlvmArray:
    """Return an array without assigned entries.

    Entries read as 0. If a loop stores the array in memory, they read as the content of the memory.
    """
    entry_type = array_emitter.get_entry_type(primitive_call.result_aval)
    return UninitializedArray(
        primitive_call.result_shape,
        entry_type,
        lambda _: array_emitter.value_emitter.make_llvm_constant(entry_type, 0),
    )


def emit_index_array(array_emitter: ArrayEmitter, primitive_call: PrimitiveCall) -> LlvmArray:
    """Return an array whose entries are their indices along one axis, as
    `jax.lax.broadcasted_iota`.
    """
    return array_emitter.emit_constant_array(
        np.indices(primitive_call.result_aval.shape)[primitive_call.primitive_params["dimension"]],
        primitive_call.result_aval,
    )


def emit_dynamic_slice(
    array_emitter: ArrayEmitter,
    primitive_call: PrimitiveCall,
    array: LlvmArray,
    *start_index_arrays: LlvmArray,
) -> LlvmArray:
    """Return a part of the array that begins at a computed index, which all lanes share."""
    start_index = _clamp_start_index(
        array_emitter,
        primitive_call.operand_avals,
        array.shape,
        primitive_call.result_shape,
        start_index_arrays,
    )
    get_sliced_entry = lambda entry_index: array_emitter.get_array_entry(
        array, array_emitter.emit_sum_of_indices(entry_index, start_index)
    )
    return LazyArray(
        primitive_call.result_shape,
        array_emitter.get_entry_type(primitive_call.result_aval),
        get_sliced_entry,
    )


def emit_dynamic_slice_update(
    array_emitter: ArrayEmitter,
    primitive_call: PrimitiveCall,
    array: LlvmArray,
    update_array: LlvmArray,
    *start_index_arrays: LlvmArray,
) -> LlvmArray:
    """Return the array with one part replaced. The part begins at a computed index, the same for
    all lanes.
    """
    if has_lane_axis(primitive_call.result_aval) and not has_lane_axis(
        primitive_call.operand_avals[1]
    ):
        raise make_lane_mixing_error(primitive_call.primitive_name)
    start_index = _clamp_start_index(
        array_emitter,
        primitive_call.operand_avals[1:],
        array.shape,
        update_array.shape,
        start_index_arrays,
    )
    has_repeated_entry = isinstance(array, np.ndarray) and not any(array.strides)
    needs_no_copy = has_repeated_entry or isinstance(array, UninitializedArray)
    return PendingArrayUpdate(
        array_emitter,
        array if needs_no_copy else array_emitter.store_array_in_memory(array),
        update_array,
        start_index,
    )


def _clamp_start_index(
    array_emitter: ArrayEmitter,
    operand_avals: Any,
    array_shape: EntryIndex,
    slice_shape: EntryIndex,
    start_index_arrays: Sequence[LlvmArray],
) -> tuple[Any, ...]:
    """Return the index `start_index_arrays`, clamped so that a part of shape `slice_shape` lies
    inside the array.
    """
    clamped_start_index: list[Any] = []
    for start_index_aval, n, m, start_index_array in zip(
        operand_avals[1:], array_shape, slice_shape, start_index_arrays, strict=False
    ):
        start_index_value = array_emitter.get_array_entries(start_index_array).item()
        if n == m:
            clamped_start_index.append(0)
        elif isinstance(start_index_value, ir.Constant):
            clamped_start_index.append(min(max(int(start_index_value.constant), 0), n - m))
        else:
            start_index_value = emit_llvm_elementwise_primitive(
                array_emitter.value_emitter,
                "convert_element_type",
                {},
                start_index_aval.dtype,
                np.dtype(np.int64),
                (start_index_value,),
            )
            clamped_start_index.append(array_emitter.emit_clamped_index(start_index_value, n - m))
    return tuple(clamped_start_index)
