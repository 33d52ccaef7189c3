"""Rules of primitives that move entries: indexing, slicing, concatenation and reshaping. Each
returns an array of LLVM values.
"""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from vrw_jax.simd.arithmetic import convert_value
from vrw_jax.simd.array_emitter import (
    ArrayEmitter,
    PrimitiveCall,
    has_lanes,
    lane_mixing_error,
    shape_without_lanes,
)
from vrw_jax.simd.lazy_arrays import (
    ArrayValue,
    EntryIndex,
    LazyArray,
    MemoryArray,
    PendingUpdate,
    TransposedView,
    Uninitialized,
)
from vrw_jax.simd.llvm_library import ir
from vrw_jax.simd.lowering import JaxprLowering
from vrw_jax.simd.value_emitter import I64, Value


def emit_broadcast(
    emitter: ArrayEmitter, call: PrimitiveCall, array: ArrayValue, *_: Any
) -> ArrayValue:
    """Return the array repeated along new axes, of which the last may be the lane axis."""
    shape = shape_without_lanes(call.out_aval)
    axes = tuple(map(int, call.params["broadcast_dimensions"]))
    array = emitter.reshape_if_needed(array, array.shape[:-1], len(array.shape) > len(shape))
    if has_lanes(call.out_aval) and len(array.shape) == len(axes) and axes[-1:] == (len(shape),):
        # The array is one number for each lane.
        array = emitter.reshape_array(array, array.shape[:-1])
    has_same_type = isinstance(array, MemoryArray) and array.entry_type == emitter.entry_type_of(
        call.out_aval
    )
    if has_same_type and math.prod(array.shape) == math.prod(shape):
        return emitter.reshape_array(array, shape)
    result = emitter.broadcast_array(array, shape, axes[: len(array.shape)])
    if isinstance(result, LazyArray):
        return LazyArray(shape, emitter.entry_type_of(call.out_aval), result.entry_at)
    return result


def emit_reshape(emitter: ArrayEmitter, call: PrimitiveCall, array: ArrayValue) -> ArrayValue:
    """Return the array in another shape, with the same entries in the same order."""
    return emitter.reshape_array(array, shape_without_lanes(call.out_aval))


def emit_transpose(emitter: ArrayEmitter, call: PrimitiveCall, array: ArrayValue) -> ArrayValue:
    """Return the array with its axes in the order of the parameter `permutation`."""
    axis_order = call.params["permutation"]
    axis_order = axis_order[: len(array.shape)]
    if isinstance(array, np.ndarray):
        return array.transpose(axis_order)
    inverse_axis_order = np.argsort(axis_order)
    entry_at = lambda index: emitter.get_entry(array, tuple(index[i] for i in inverse_axis_order))
    array_class = TransposedView if isinstance(array, MemoryArray | TransposedView) else LazyArray
    return array_class(shape_without_lanes(call.out_aval), array.entry_type, entry_at)


def emit_slice(emitter: ArrayEmitter, call: PrimitiveCall, array: ArrayValue) -> ArrayValue:
    """Return the entries between two indices of each axis, with strides."""
    strides = call.params["strides"] or (1,) * len(call.params["start_indices"])
    ranges = zip(call.params["start_indices"], call.params["limit_indices"], strides, strict=True)
    slices = [slice(*bounds) for bounds in ranges][: len(array.shape)]
    if isinstance(array, np.ndarray):
        return array[tuple(slices)]

    def entry_at(index: EntryIndex) -> Value:
        index_strides = zip(index, slices, strict=True)
        return emitter.get_entry(
            array,
            tuple(emitter.shift_index(i, stride.start, stride.step) for i, stride in index_strides),
        )

    return LazyArray(shape_without_lanes(call.out_aval), array.entry_type, entry_at)


def emit_concatenate(emitter: ArrayEmitter, call: PrimitiveCall, *values: ArrayValue) -> ArrayValue:
    """Return arrays joined along an existing axis."""
    return _concatenate_along(emitter, call, call.params["dimension"], values)


def emit_stack(emitter: ArrayEmitter, call: PrimitiveCall, *values: ArrayValue) -> ArrayValue:
    """Return arrays of one shape stacked along a new axis."""
    axis = call.params["axis"]
    expanded_arrays = [
        emitter.reshape_array(x, (*x.shape[:axis], 1, *x.shape[axis:])) for x in values
    ]
    return _concatenate_along(emitter, call, axis, expanded_arrays)


def emit_unstack(
    lowering: JaxprLowering, equation: Any, values: list[ArrayValue]
) -> list[ArrayValue]:
    """Return the arrays, all of one shape, into which an array is split along an axis."""
    (array,), axis, emitter = values, equation.params["axis"], lowering.emitter
    if axis == len(array.shape):
        raise lane_mixing_error("unstack")

    def take_slice(position: int) -> ArrayValue:
        shape = (*array.shape[:axis], *array.shape[axis + 1 :])
        if isinstance(array, np.ndarray):
            return array.take([position], axis).reshape(shape)
        entry_at = lambda index: emitter.get_entry(array, (*index[:axis], position, *index[axis:]))
        return LazyArray(shape, array.entry_type, entry_at)

    return [take_slice(position) for position in range(len(equation.outvars))]


def _concatenate_along(
    emitter: ArrayEmitter, call: PrimitiveCall, axis: int, values: Sequence[ArrayValue]
) -> ArrayValue:
    """Return arrays joined along the existing axis `axis`."""
    shape = shape_without_lanes(call.out_aval)
    if axis == len(shape):
        raise lane_mixing_error(call.name)
    if all(isinstance(x, np.ndarray) for x in values):
        return np.concatenate(values, axis)  # type: ignore[arg-type]
    part_offsets = [x for x in values if x.shape[axis]]
    starts = np.cumsum([0, *(x.shape[axis] for x in part_offsets)]).tolist()

    def entry_at(index: EntryIndex) -> Value:
        i, selected_value = index[axis], None
        for part_array, start in zip(part_offsets, starts, strict=False):
            local_index, last_index = emitter.shift_index(i, -start), part_array.shape[axis] - 1
            if isinstance(i, int):
                if 0 <= local_index <= last_index:
                    return emitter.get_entry(
                        part_array, (*index[:axis], local_index, *index[axis + 1 :])
                    )
                continue
            # Beyond the end of a part any entry is valid, because the select below discards it.
            local_index = 0 if last_index == 0 else emitter.clamp_index(local_index, last_index)
            value = emitter.get_entry(part_array, (*index[:axis], local_index, *index[axis + 1 :]))
            is_inside = emitter.builder.icmp_signed(">=", i, ir.Constant(I64, start))
            if selected_value is None:
                selected_value = value
            else:
                value, selected_value = emitter.emitter.to_same_shape(value, selected_value)
                selected_value = emitter.builder.select(is_inside, value, selected_value)
        return selected_value

    return LazyArray(shape, emitter.entry_type_of(call.out_aval), entry_at)


def emit_pad(
    emitter: ArrayEmitter, call: PrimitiveCall, array: ArrayValue, value: ArrayValue
) -> ArrayValue:
    """Return the array with entries `value` added before and after it along each axis."""
    padding = call.params["padding_config"]
    if any(n_before < 0 or n_after < 0 or n_between for n_before, n_after, n_between in padding):
        raise NotImplementedError("pad takes entries away or puts some between: slice and stack.")
    result_array = np.broadcast_to(
        emitter.get_entries(value).reshape(()), shape_without_lanes(call.out_aval)
    ).copy()
    interior_slices = tuple(
        slice(n_before, n_before + n)
        for (n_before, _, _), n in zip(padding, array.shape, strict=False)
    )
    result_array[interior_slices] = emitter.get_entries(array)
    return result_array


def emit_empty(emitter: ArrayEmitter, call: PrimitiveCall) -> ArrayValue:
    """Return an uninitialized array, whose entries read as zeros except in memory that loops
    carry.
    """
    entry_type = emitter.entry_type_of(call.out_aval)
    return Uninitialized(
        shape_without_lanes(call.out_aval), entry_type, lambda _: emitter.make_zero(entry_type)
    )


def emit_iota(emitter: ArrayEmitter, call: PrimitiveCall) -> ArrayValue:
    """Return an array of indices along one axis, as `jax.lax.broadcasted_iota`."""
    return emitter.emit_constant_array(
        np.indices(call.out_aval.shape)[call.params["dimension"]], call.out_aval
    )


def emit_dynamic_slice(
    emitter: ArrayEmitter, call: PrimitiveCall, array: ArrayValue, *starts: ArrayValue
) -> ArrayValue:
    """Return the part of an array that begins at computed indices, which are the same for all
    lanes.
    """
    start_index = _clamp_starts(
        emitter, call.in_avals, array.shape, shape_without_lanes(call.out_aval), starts
    )
    entry_at = lambda index: emitter.get_entry(array, emitter.add_indices(index, start_index))
    return LazyArray(
        shape_without_lanes(call.out_aval), emitter.entry_type_of(call.out_aval), entry_at
    )


def emit_dynamic_update(
    emitter: ArrayEmitter,
    call: PrimitiveCall,
    array: ArrayValue,
    update: ArrayValue,
    *starts: ArrayValue,
) -> ArrayValue:
    """Return the array with one part replaced; the part begins at computed indices, the same for
    all lanes.
    """
    if has_lanes(call.out_aval) and not has_lanes(call.in_avals[1]):
        raise lane_mixing_error(call.name)
    start_index = _clamp_starts(emitter, call.in_avals[1:], array.shape, update.shape, starts)
    has_same_type = isinstance(array, np.ndarray) and not any(array.strides)
    needs_no_copy = has_same_type or isinstance(array, Uninitialized)
    return PendingUpdate(
        emitter, array if needs_no_copy else emitter.materialize(array), update, start_index
    )


def _clamp_starts(
    emitter: ArrayEmitter,
    in_avals: Any,
    array_shape: EntryIndex,
    part_shape: EntryIndex,
    starts: Sequence[ArrayValue],
) -> tuple[Any, ...]:
    """Return the start index of a part, clamped so that the part lies inside the array."""
    start_index: list[Any] = []
    for aval, n, m, start in zip(in_avals[1:], array_shape, part_shape, starts, strict=False):
        start_value = emitter.get_entries(start).item()
        if n == m:
            start_index.append(0)
        elif isinstance(start_value, ir.Constant):
            start_index.append(min(max(int(start_value.constant), 0), n - m))
        else:
            start_value = convert_value(
                emitter.emitter, start_value, aval.dtype, np.dtype(np.int64)
            )
            start_index.append(emitter.clamp_index(start_value, n - m))
    return tuple(start_index)
