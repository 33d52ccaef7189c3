"""Rules of primitives that reduce arrays along axes. Over lanes only `any` and `all` are
possible.
"""

import functools
import math
from collections.abc import Callable
from typing import Any

import numpy as np

from vrw_jax.simd.arithmetic import emit_elementwise
from vrw_jax.simd.array_emitter import (
    ArrayEmitter,
    PrimitiveCall,
    has_lanes,
    lane_mixing_error,
    make_array,
    shape_without_lanes,
)
from vrw_jax.simd.lazy_arrays import ArrayValue, EntryIndex, LazyArray
from vrw_jax.simd.llvm_library import ir
from vrw_jax.simd.value_emitter import Value


def emit_cumsum(emitter: ArrayEmitter, call: PrimitiveCall, array: ArrayValue) -> ArrayValue:
    """Return cumulative sums along an axis, from its start or, with `reverse`, from its end."""
    if call.params["axis"] == len(array.shape):
        raise lane_mixing_error(call.name)
    terms = np.moveaxis(emitter.get_entries(array), call.params["axis"], 0)
    dtype = call.out_aval.dtype
    summation_order = range(len(terms))[:: -1 if call.params["reverse"] else 1]
    add_values = lambda x, y: emit_elementwise(emitter.emitter, "add", {}, dtype, dtype, (x, y))
    partial_sums = np.empty_like(terms)
    for position, i in enumerate(summation_order):
        pairs = zip(
            partial_sums[summation_order[position - 1], ...].ravel(),
            terms[i, ...].ravel(),
            strict=True,
        )
        sums_at_index = [add_values(*pair) if position else pair[1] for pair in pairs]
        partial_sums[i, ...] = make_array(terms.shape[1:], sums_at_index)
    return np.moveaxis(partial_sums, 0, call.params["axis"])


def emit_dot_general(
    emitter: ArrayEmitter, call: PrimitiveCall, left: ArrayValue, right: ArrayValue
) -> ArrayValue:
    """Return the product of two arrays, summed over one axis of each."""
    (contracted_left, contracted_right), (batch_axes, _) = call.params["dimension_numbers"]
    if batch_axes or len(contracted_left) != 1:
        raise NotImplementedError(
            "dot_general sums over one pair of axes only, without a batch: multiply and sum."
        )
    (left_axis,), (right_axis,), dtype = contracted_left, contracted_right, call.out_aval.dtype
    n_terms, n_left = left.shape[left_axis], len(left.shape) - 1

    def emit_term(index: EntryIndex, k: Any) -> Value:
        left_index, right_index = index[:n_left], index[n_left:]
        x = emitter.get_entry(left, (*left_index[:left_axis], k, *left_index[left_axis:]))
        y = emitter.get_entry(right, (*right_index[:right_axis], k, *right_index[right_axis:]))
        return emit_elementwise(emitter.emitter, "mul", {}, dtype, dtype, (x, y))

    add_values = lambda x, y: emit_elementwise(emitter.emitter, "add", {}, dtype, dtype, (x, y))
    shape, entry_type = shape_without_lanes(call.out_aval), emitter.entry_type_of(call.out_aval)
    if n_terms <= emitter.limits.max_unrolled_terms or emitter.is_in_innermost_loop:
        entry_at = lambda index: functools.reduce(
            add_values, [emit_term(index, k) for k in range(n_terms)]
        )
        if isinstance(left, LazyArray) or isinstance(right, LazyArray):
            return LazyArray(shape, entry_type, entry_at)
        return make_array(shape, [entry_at(index) for index in np.ndindex(shape)])
    left, right = emitter.materialize(left), emitter.materialize(right)
    memory = emitter.allocate(shape, entry_type)

    def store_total(index: EntryIndex, _: Any) -> list[Value]:
        add_term = lambda k, sums: [add_values(sums[0], emit_term(index, k))]
        memory.store(
            index, emitter.loop_n_times(n_terms, add_term, [emitter.make_zero(entry_type)])[0]
        )
        return []

    emitter.loop_over_indices(shape, store_total)
    return memory


def reduction_rule(name: str) -> Callable[..., ArrayValue]:
    """Return the rule of a reduction by the elementwise primitive `name`, such as "add"."""

    def emit_reduction(emitter: ArrayEmitter, call: PrimitiveCall, array: ArrayValue) -> ArrayValue:
        """Reduce an array along axes, and return the result; only `any` and `all` also reduce over
        lanes.
        """
        reduces_lanes = has_lanes(call.in_avals[0]) and not has_lanes(call.out_aval)
        dtype = call.in_avals[0].dtype
        if reduces_lanes and (name not in ("and", "or") or dtype.kind != "b"):
            raise lane_mixing_error(call.name)
        axes = tuple(axis for axis in call.params["axes"] if axis < len(array.shape))
        combine = lambda x, y: emit_elementwise(emitter.emitter, name, {}, dtype, dtype, (x, y))
        kept_lengths = [n for axis, n in enumerate(array.shape) if axis not in axes]
        reduced_lengths = [array.shape[axis] for axis in axes]

        def combine_indices(kept_index: EntryIndex, reduced_index: EntryIndex) -> EntryIndex:
            inner_indices, outer_indices = iter(reduced_index), iter(kept_index)
            return tuple(
                next(inner_indices if i in axes else outer_indices) for i in range(len(array.shape))
            )

        def reduce_entry(kept_index: EntryIndex) -> Value:
            entry_at = lambda reduced_index: emitter.get_entry(
                array, combine_indices(kept_index, reduced_index)
            )
            n_terms = math.prod(reduced_lengths)
            if isinstance(array, np.ndarray) or n_terms <= emitter.limits.max_unrolled_terms:
                return functools.reduce(combine, map(entry_at, np.ndindex(*reduced_lengths)))
            # The first entry is counted twice, which changes no reduction except a sum.
            initial_value = entry_at((0,) * len(reduced_lengths))
            if name == "add":
                initial_value = emitter.make_zero(array.entry_type)
            elif isinstance(array.entry_type, ir.VectorType):
                initial_value = emitter.emitter.splat(initial_value)
            return emitter.loop_over_indices(
                reduced_lengths,
                lambda i, partial: [combine(partial[0], entry_at(i))],
                [initial_value],
            )[0]

        values = [reduce_entry(kept_index) for kept_index in np.ndindex(*kept_lengths)]
        if reduces_lanes:
            values = [_reduce_over_lanes(emitter, name, value) for value in values]
        return make_array(tuple(kept_lengths), values)

    return emit_reduction


def _reduce_over_lanes(emitter: ArrayEmitter, name: str, value: Value) -> Value:
    """Emit the test whether any ("or") or all ("and") lanes of a group are true, and return its
    truth value.
    """
    builder = emitter.builder
    if not isinstance(value.type, ir.VectorType):
        return value
    lane_bits = builder.bitcast(value, ir.IntType(emitter.emitter.width))
    if name == "or":
        return builder.icmp_unsigned("!=", lane_bits, ir.Constant(lane_bits.type, 0))
    return builder.icmp_unsigned("==", lane_bits, ir.Constant(lane_bits.type, -1))
