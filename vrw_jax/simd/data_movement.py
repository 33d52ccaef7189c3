"""Primitives that move entries: indexing, slicing, concatenation and reshaping."""

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
    """Repeat an array along new axes, including the lanes'."""
    shape = shape_without_lanes(call.out_aval)
    axes = tuple(map(int, call.params["broadcast_dimensions"]))
    array = emitter.reshape_if_needed(array, array.shape[:-1], len(array.shape) > len(shape))
    if has_lanes(call.out_aval) and len(array.shape) == len(axes) and axes[-1:] == (len(shape),):
        array = emitter.reshape_array(array, array.shape[:-1])  # one number has the axis of lanes
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
    """Return the entries in the same order, in another shape."""
    return emitter.reshape_array(array, shape_without_lanes(call.out_aval))


def emit_transpose(emitter: ArrayEmitter, call: PrimitiveCall, array: ArrayValue) -> ArrayValue:
    """Return the array with its axes in another order."""
    order = call.params["permutation"]
    order = order[: len(array.shape)]
    if isinstance(array, np.ndarray):
        return array.transpose(order)
    inverse_order = np.argsort(order)
    entry_at = lambda index: emitter.get_entry(array, tuple(index[i] for i in inverse_order))
    array_class = TransposedView if isinstance(array, MemoryArray | TransposedView) else LazyArray
    return array_class(shape_without_lanes(call.out_aval), array.entry_type, entry_at)


def emit_slice(emitter: ArrayEmitter, call: PrimitiveCall, array: ArrayValue) -> ArrayValue:
    """Return the entries from one index to another, with strides."""
    strides = call.params["strides"] or (1,) * len(call.params["start_indices"])
    ranges = zip(call.params["start_indices"], call.params["limit_indices"], strides, strict=True)
    slices = [slice(*bounds) for bounds in ranges][: len(array.shape)]
    if isinstance(array, np.ndarray):
        return array[tuple(slices)]

    def entry_at(index: EntryIndex) -> Value:
        pairs = zip(index, slices, strict=True)
        return emitter.get_entry(
            array, tuple(emitter.shift_index(i, s.start, s.step) for i, s in pairs)
        )

    return LazyArray(shape_without_lanes(call.out_aval), array.entry_type, entry_at)


def emit_concatenate(emitter: ArrayEmitter, call: PrimitiveCall, *values: ArrayValue) -> ArrayValue:
    """Concatenate arrays along an axis."""
    return _concatenate_along(emitter, call, call.params["dimension"], values)


def emit_stack(emitter: ArrayEmitter, call: PrimitiveCall, *values: ArrayValue) -> ArrayValue:
    """Stack arrays of one shape along a new axis."""
    axis = call.params["axis"]
    longer = [emitter.reshape_array(x, (*x.shape[:axis], 1, *x.shape[axis:])) for x in values]
    return _concatenate_along(emitter, call, axis, longer)


def emit_unstack(
    traces: JaxprLowering, equation: Any, values: list[ArrayValue]
) -> list[ArrayValue]:
    """Split an array along an axis into arrays of one shape."""
    (array,), axis, emitter = values, equation.params["axis"], traces.emitter
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
    """Return arrays joined along an existing axis."""
    shape = shape_without_lanes(call.out_aval)
    if axis == len(shape):
        raise lane_mixing_error(call.name)
    if all(isinstance(x, np.ndarray) for x in values):
        return np.concatenate(values, axis)  # type: ignore[arg-type]
    parts = [x for x in values if x.shape[axis]]
    starts = np.cumsum([0, *(x.shape[axis] for x in parts)]).tolist()

    def entry_at(index: EntryIndex) -> Value:
        i, selected_value = index[axis], None
        for part, start in zip(parts, starts, strict=False):
            local_index, last_index = emitter.shift_index(i, -start), part.shape[axis] - 1
            if isinstance(i, int):
                if 0 <= local_index <= last_index:
                    return emitter.get_entry(part, (*index[:axis], local_index, *index[axis + 1 :]))
                continue
            # Beyond the part's end any entry is valid, because the select below discards it.
            local_index = 0 if last_index == 0 else emitter.clamp_index(local_index, last_index)
            value = emitter.get_entry(part, (*index[:axis], local_index, *index[axis + 1 :]))
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
    """Add entries around an array, none within."""
    padding = call.params["padding_config"]
    if any(low < 0 or high < 0 or interior for low, high, interior in padding):
        raise NotImplementedError("pad takes entries away or puts some between: slice and stack.")
    padded = np.broadcast_to(
        emitter.get_entries(value).reshape(()), shape_without_lanes(call.out_aval)
    ).copy()
    interior_slices = tuple(
        slice(low, low + n) for (low, _, _), n in zip(padding, array.shape, strict=False)
    )
    padded[interior_slices] = emitter.get_entries(array)
    return padded


def emit_empty(emitter: ArrayEmitter, call: PrimitiveCall) -> ArrayValue:
    """Return uninitialized entries, which read as zeros except in memory that loops carry."""
    kind = emitter.entry_type_of(call.out_aval)
    return Uninitialized(
        shape_without_lanes(call.out_aval), kind, lambda _: emitter.make_zero(kind)
    )


def emit_iota(emitter: ArrayEmitter, call: PrimitiveCall) -> ArrayValue:
    """Return the indices along an axis."""
    return emitter.emit_constants(
        np.indices(call.out_aval.shape)[call.params["dimension"]], call.out_aval
    )


def emit_dynamic_slice(
    emitter: ArrayEmitter, call: PrimitiveCall, array: ArrayValue, *starts: ArrayValue
) -> ArrayValue:
    """Return a part whose start is given by numbers, the same for all lanes."""
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
    """Replace a part whose start is given by numbers, the same for all lanes."""
    if has_lanes(call.out_aval) and not has_lanes(call.in_avals[1]):
        raise lane_mixing_error(call.name)
    start_index = _clamp_starts(emitter, call.in_avals[1:], array.shape, update.shape, starts)
    is_uniform = isinstance(array, np.ndarray) and not any(array.strides)
    needs_no_copy = is_uniform or isinstance(array, Uninitialized)
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
    """Return the start of a part, clamped so that the part is inside."""
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
