"""Rules of primitives that move or reduce entries: indexing, slicing, concatenation, sums.

Each rule returns an array of LLVM values. Only `reduce_and` and `reduce_or` reduce over lanes.
"""

import bisect
import functools
import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from vrw_jax.lanes.array_emitter import (
    ArrayEmitter,
    PrimitiveCall,
    has_lane_axis,
    make_entry_array,
    make_lane_mixing_error,
)
from vrw_jax.lanes.llvm import (
    EntryIndex,
    JoinedArray,
    LazyArray,
    LlvmArray,
    LlvmValue,
    MemoryArray,
    PendingArrayUpdate,
    TransposedMemoryView,
    UninitializedArray,
    ir,
)
from vrw_jax.lanes.value_emitter import I64, LLVM_NUMBER_TYPES, emit_llvm_elementwise_primitive


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
    jaxpr_lowering: Any, equation: Any, array: LlvmArray, part_lengths: Sequence[int]
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


def emit_stacked_array(
    array_emitter: ArrayEmitter, primitive_call: PrimitiveCall, *stacked_arrays: LlvmArray
) -> LlvmArray:
    """Return the arrays, all of one shape, stacked along a new axis."""
    new_axis = primitive_call.primitive_params["axis"]
    expanded_arrays = [
        array_emitter.reshape_array(x, (*x.shape[:new_axis], 1, *x.shape[new_axis:]))
        for x in stacked_arrays
    ]
    concatenation = primitive_call._replace(primitive_params={"dimension": new_axis})
    return emit_concatenated_array(array_emitter, concatenation, *expanded_arrays)


def emit_unstacked_arrays(
    jaxpr_lowering: Any, equation: Any, operands: list[LlvmArray]
) -> list[LlvmArray]:
    """Return the arrays of equal shape that result from splitting an array along one axis."""
    parts = _split_along_axis(jaxpr_lowering, equation, operands[0], [1] * len(equation.outvars))
    reshape_array, split_axis = jaxpr_lowering.array_emitter.reshape_array, equation.params["axis"]
    return [reshape_array(x, (*x.shape[:split_axis], *x.shape[split_axis + 1 :])) for x in parts]


def emit_split_arrays(
    jaxpr_lowering: Any, equation: Any, operands: list[LlvmArray]
) -> list[LlvmArray]:
    """Return the parts of an array that follow each other along one axis."""
    return _split_along_axis(jaxpr_lowering, equation, operands[0], equation.params["sizes"])


def emit_optimization_barrier(
    jaxpr_lowering: Any, equation: Any, operands: list[LlvmArray]
) -> list[LlvmArray]:
    """Return the operands. Large lazy arrays among them are computed and stored in memory at this
    point.
    """
    return [
        jaxpr_lowering.array_emitter.store_array_in_memory(x) if isinstance(x, LazyArray) else x
        for x in operands
    ]


def emit_concatenated_array(
    array_emitter: ArrayEmitter, primitive_call: PrimitiveCall, *joined_arrays: LlvmArray
) -> LlvmArray:
    """Return the arrays joined along an existing axis."""
    join_axis = primitive_call.primitive_params["dimension"]
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


def emit_cumulative_sum(
    array_emitter: ArrayEmitter, primitive_call: PrimitiveCall, array: LlvmArray
) -> LlvmArray:
    """Return the cumulative sums along an axis, from its start or, with `reverse`, from its end."""
    sum_axis, is_reversed = (primitive_call.primitive_params[name] for name in ("axis", "reverse"))
    if sum_axis == len(array.shape):
        raise make_lane_mixing_error(primitive_call.primitive_name)
    array_entries = array_emitter.get_array_entries(array)
    emit_sum = _make_combination(array_emitter, "add", primitive_call.result_aval.dtype)
    if is_reversed:
        array_entries = np.flip(array_entries, sum_axis)
    partial_sums = np.frompyfunc(emit_sum, 2, 1).accumulate(array_entries, sum_axis, object)
    return np.flip(partial_sums, sum_axis) if is_reversed else partial_sums


COMBINING_PRIMITIVE_BY_REDUCTION = {
    "reduce_and": "and",
    "reduce_max": "max",
    "reduce_min": "min",
    "reduce_or": "or",
    "reduce_sum": "add",
}
"""Elementwise primitive by which each reduction combines two entries."""


def _get_value_of_no_entries(combining_primitive: str, dtype: np.dtype) -> Any:
    if combining_primitive not in ("max", "min"):
        return 0 if combining_primitive != "and" else 1 if dtype.kind == "b" else -1
    sign = -1 if combining_primitive == "max" else 1
    if dtype.kind == "f":
        return sign * np.inf
    return np.iinfo(dtype).max if sign > 0 else np.iinfo(dtype).min


def emit_reduced_array(
    array_emitter: ArrayEmitter, primitive_call: PrimitiveCall, array: LlvmArray
) -> LlvmArray:
    """Return the array reduced along axes. Only `reduce_and` and `reduce_or` also reduce over
    lanes.
    """
    combining_primitive = COMBINING_PRIMITIVE_BY_REDUCTION[primitive_call.primitive_name]
    reduces_over_lanes = has_lane_axis(primitive_call.operand_avals[0]) and not has_lane_axis(
        primitive_call.result_aval
    )
    result_dtype = primitive_call.operand_avals[0].dtype
    if reduces_over_lanes and (
        combining_primitive not in ("and", "or") or result_dtype.kind != "b"
    ):
        raise make_lane_mixing_error(primitive_call.primitive_name)
    reduced_axes = [
        axis for axis in primitive_call.primitive_params["axes"] if axis < len(array.shape)
    ]
    emit_combination = _make_combination(array_emitter, combining_primitive, result_dtype)
    result_axis_lengths = [n for axis, n in enumerate(array.shape) if axis not in reduced_axes]
    reduced_axis_lengths = [array.shape[axis] for axis in reduced_axes]

    def emit_reduced_entry(result_index: EntryIndex) -> LlvmValue:
        def get_entry_to_reduce(reduced_index: EntryIndex) -> LlvmValue:
            reduced_index_iterator, result_index_iterator = iter(reduced_index), iter(result_index)
            entry_index = tuple(
                next(reduced_index_iterator if i in reduced_axes else result_index_iterator)
                for i in range(len(array.shape))
            )
            return array_emitter.get_array_entry(array, entry_index)

        n_terms = math.prod(reduced_axis_lengths)
        if n_terms == 0:
            return array_emitter.value_emitter.make_llvm_constant(
                LLVM_NUMBER_TYPES[result_dtype.name],
                _get_value_of_no_entries(combining_primitive, result_dtype),
            )
        if isinstance(array, np.ndarray) or n_terms <= array_emitter.MAX_UNROLLED_REDUCTION_TERMS:
            return functools.reduce(
                emit_combination, map(get_entry_to_reduce, np.ndindex(*reduced_axis_lengths))
            )
        # The first entry is counted twice, which changes no reduction except a sum.
        initial_reduction_value = get_entry_to_reduce((0,) * len(reduced_axis_lengths))
        if combining_primitive == "add":
            initial_reduction_value = array_emitter.value_emitter.make_llvm_constant(
                array.entry_type, 0
            )
        elif isinstance(array.entry_type, ir.VectorType):
            initial_reduction_value = array_emitter.value_emitter.to_lane_vector(
                initial_reduction_value
            )
        return array_emitter.emit_index_loops(
            reduced_axis_lengths,
            lambda i, loop_carried_values: [
                emit_combination(loop_carried_values[0], get_entry_to_reduce(i))
            ],
            [initial_reduction_value],
        )[0]

    def store_reduced_entry(result_index: EntryIndex, _: Any) -> list[LlvmValue]:
        result_memory.emit_entry_store(result_index, emit_reduced_entry(result_index))
        return []

    result_shape = tuple(result_axis_lengths)
    is_large = math.prod(result_shape) > array_emitter.MAX_REGISTER_ENTRIES
    if isinstance(array, LazyArray) and is_large and not reduces_over_lanes:
        result_memory = array_emitter.allocate_memory_array(result_shape, array.entry_type)
        array_emitter.emit_index_loops(result_shape, store_reduced_entry)
        return result_memory
    reduced_entries = list(map(emit_reduced_entry, np.ndindex(result_shape)))
    for i, lane_flags in enumerate(reduced_entries):
        # This truth value of the group is a scalar: whether any ("or") or all ("and") lanes are
        # true.
        if reduces_over_lanes and isinstance(lane_flags.type, ir.VectorType):
            lane_bits = array_emitter.llvm_builder.bitcast(
                lane_flags, ir.IntType(array_emitter.value_emitter.n_vector_lanes)
            )
            comparison_operator, number = ("!=", 0) if combining_primitive == "or" else ("==", -1)
            reduced_entries[i] = array_emitter.llvm_builder.icmp_unsigned(
                comparison_operator, lane_bits, ir.Constant(lane_bits.type, number)
            )
    return make_entry_array(result_shape, reduced_entries)


def _make_combination(
    array_emitter: ArrayEmitter, primitive_name: str, number_dtype: Any
) -> Callable[[LlvmValue, LlvmValue], LlvmValue]:
    """Return a function that emits an elementwise primitive of two entries of one type."""
    return lambda x, y: emit_llvm_elementwise_primitive(
        array_emitter.value_emitter, primitive_name, {}, number_dtype, number_dtype, (x, y)
    )
