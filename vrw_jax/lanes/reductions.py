"""Rules of primitives that reduce arrays along axes. Only `reduce_and` and `reduce_or` reduce over
lanes.
"""

import functools
import math
from collections.abc import Callable
from typing import Any

import numpy as np

from vrw_jax.lanes.arithmetic import emit_llvm_elementwise_primitive
from vrw_jax.lanes.array_emitter import (
    ArrayEmitter,
    PrimitiveCall,
    has_lane_axis,
    make_entry_array,
    make_lane_mixing_error,
)
from vrw_jax.lanes.lazy_arrays import EntryIndex, LazyArray, LlvmArray
from vrw_jax.lanes.llvm_library import ir
from vrw_jax.lanes.value_emitter import LLVM_NUMBER_TYPES, LlvmValue


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


def emit_array_product(
    array_emitter: ArrayEmitter,
    primitive_call: PrimitiveCall,
    left_array: LlvmArray,
    right_array: LlvmArray,
) -> LlvmArray:
    """Return the product of two arrays, summed over one axis of each array."""
    (contracted_left_axes, contracted_right_axes), (batch_axes, _) = (
        primitive_call.primitive_params["dimension_numbers"]
    )
    if batch_axes or len(contracted_left_axes) != 1:
        raise NotImplementedError(
            "dot_general sums over one pair of axes only, without a batch: multiply and sum."
        )
    (left_axis,), (right_axis,) = contracted_left_axes, contracted_right_axes
    result_dtype = primitive_call.result_aval.dtype
    emit_product = _make_combination(array_emitter, "mul", result_dtype)
    emit_sum = _make_combination(array_emitter, "add", result_dtype)
    n_terms, n_left_axes = left_array.shape[left_axis], len(left_array.shape) - 1

    def emit_product_term(product_index: EntryIndex, k: Any) -> LlvmValue:
        left_index, right_index = product_index[:n_left_axes], product_index[n_left_axes:]
        x = array_emitter.get_array_entry(
            left_array, (*left_index[:left_axis], k, *left_index[left_axis:])
        )
        y = array_emitter.get_array_entry(
            right_array, (*right_index[:right_axis], k, *right_index[right_axis:])
        )
        return emit_product(x, y)

    product_shape = primitive_call.result_shape
    entry_type = array_emitter.get_entry_type(primitive_call.result_aval)
    if n_terms <= array_emitter.MAX_UNROLLED_REDUCTION_TERMS or array_emitter.is_in_innermost_loop:
        emit_product_entry = lambda entry_index: functools.reduce(
            emit_sum, [emit_product_term(entry_index, k) for k in range(n_terms)]
        )
        if isinstance(left_array, LazyArray) or isinstance(right_array, LazyArray):
            return LazyArray(product_shape, entry_type, emit_product_entry)
        return make_entry_array(
            product_shape, list(map(emit_product_entry, np.ndindex(product_shape)))
        )
    left_array, right_array = map(array_emitter.store_array_in_memory, (left_array, right_array))
    product_memory = array_emitter.allocate_memory_array(product_shape, entry_type)

    def store_product_entry(product_index: EntryIndex, _: Any) -> list[LlvmValue]:
        add_term = lambda k, partial_sums: [
            emit_sum(partial_sums[0], emit_product_term(product_index, k))
        ]
        product_memory.emit_entry_store(
            product_index,
            array_emitter.emit_range_loop(
                0,
                n_terms,
                add_term,
                [array_emitter.value_emitter.make_llvm_constant(entry_type, 0)],
            )[0],
        )
        return []

    array_emitter.emit_index_loops(product_shape, store_product_entry)
    return product_memory


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

    reduced_entries = list(map(emit_reduced_entry, np.ndindex(*result_axis_lengths)))
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
    return make_entry_array(tuple(result_axis_lengths), reduced_entries)


def _make_combination(
    array_emitter: ArrayEmitter, primitive_name: str, number_dtype: Any
) -> Callable[[LlvmValue, LlvmValue], LlvmValue]:
    """Return a function that emits an elementwise primitive of two entries of one type."""
    return lambda x, y: emit_llvm_elementwise_primitive(
        array_emitter.value_emitter, primitive_name, {}, number_dtype, number_dtype, (x, y)
    )
