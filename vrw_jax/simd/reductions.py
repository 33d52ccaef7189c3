"""Primitives that reduce along axes of entries; over lanes they compute only any and all."""

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
    """Return cumulative sums along an axis, from either end."""
    if call.params["axis"] == len(array.shape):
        raise lane_mixing_error(call.name)
    rows = np.moveaxis(emitter.get_entries(array), call.params["axis"], 0)
    dtype = call.out_aval.dtype
    order = range(len(rows))[:: -1 if call.params["reverse"] else 1]
    add_values = lambda x, y: emit_elementwise(emitter.emitter, "add", {}, dtype, dtype, (x, y))
    sums = np.empty_like(rows)
    for k, i in enumerate(order):
        pairs = zip(sums[order[k - 1], ...].ravel(), rows[i, ...].ravel(), strict=True)
        row_sums = [add_values(*pair) if k else pair[1] for pair in pairs]
        sums[i, ...] = make_array(rows.shape[1:], row_sums)
    return np.moveaxis(sums, 0, call.params["axis"])


def emit_dot_general(
    emitter: ArrayEmitter, call: PrimitiveCall, left: ArrayValue, right: ArrayValue
) -> ArrayValue:
    """Return a product of arrays, summed over one pair of axes."""
    (contracted_left, contracted_right), (batch_axes, _) = call.params["dimension_numbers"]
    if batch_axes or len(contracted_left) != 1:
        raise NotImplementedError(
            "dot_general sums over one pair of axes only, without a batch: multiply and sum."
        )
    (a,), (b,), dtype = contracted_left, contracted_right, call.out_aval.dtype
    length, n_left = left.shape[a], len(left.shape) - 1

    def product(index: EntryIndex, k: Any) -> Value:
        left_index, right_index = index[:n_left], index[n_left:]
        x = emitter.get_entry(left, (*left_index[:a], k, *left_index[a:]))
        y = emitter.get_entry(right, (*right_index[:b], k, *right_index[b:]))
        return emit_elementwise(emitter.emitter, "mul", {}, dtype, dtype, (x, y))

    add_values = lambda x, y: emit_elementwise(emitter.emitter, "add", {}, dtype, dtype, (x, y))
    shape, kind = shape_without_lanes(call.out_aval), emitter.entry_type_of(call.out_aval)
    if length <= emitter.limits.max_unrolled_terms or emitter.is_unrolled:
        entry_at = lambda index: functools.reduce(
            add_values, [product(index, k) for k in range(length)]
        )
        if isinstance(left, LazyArray) or isinstance(right, LazyArray):
            return LazyArray(shape, kind, entry_at)
        return make_array(shape, [entry_at(index) for index in np.ndindex(shape)])
    left, right = emitter.materialize(left), emitter.materialize(right)
    memory = emitter.allocate(shape, kind)

    def store_total(index: EntryIndex, _: Any) -> list[Value]:
        add_term = lambda k, sums: [add_values(sums[0], product(index, k))]
        memory.store(index, emitter.loop_n_times(length, add_term, [emitter.make_zero(kind)])[0])
        return []

    emitter.loop_over_indices(shape, store_total)
    return memory


def reduction_rule(name: str) -> Callable[..., ArrayValue]:
    """Return the rule of a reduction by the elementwise primitive `name`."""

    def reduce_(emitter: ArrayEmitter, call: PrimitiveCall, array: ArrayValue) -> ArrayValue:
        """Reduce along axes; `any` and `all` also over lanes."""
        reduces_lanes = has_lanes(call.in_avals[0]) and not has_lanes(call.out_aval)
        dtype = call.in_avals[0].dtype
        if reduces_lanes and (name not in ("and", "or") or dtype.kind != "b"):
            raise lane_mixing_error(call.name)
        axes = tuple(axis for axis in call.params["axes"] if axis < len(array.shape))
        combine = lambda x, y: emit_elementwise(emitter.emitter, name, {}, dtype, dtype, (x, y))
        kept_lengths = [n for axis, n in enumerate(array.shape) if axis not in axes]
        lengths = [array.shape[axis] for axis in axes]

        def index_of(outer: EntryIndex, inner: EntryIndex) -> EntryIndex:
            inner_indices, outer_indices = iter(inner), iter(outer)
            return tuple(
                next(inner_indices if i in axes else outer_indices) for i in range(len(array.shape))
            )

        def reduce_entry(outer: EntryIndex) -> Value:
            entry_at = lambda inner: emitter.get_entry(array, index_of(outer, inner))
            n_terms = math.prod(lengths)
            if isinstance(array, np.ndarray) or n_terms <= emitter.limits.max_unrolled_terms:
                return functools.reduce(combine, map(entry_at, np.ndindex(*lengths)))
            # A first entry that is counted twice does not change any reduction except a sum.
            initial_value = entry_at((0,) * len(lengths))
            if name == "add":
                initial_value = emitter.make_zero(array.entry_type)
            elif isinstance(array.entry_type, ir.VectorType):
                initial_value = emitter.emitter.splat(initial_value)
            return emitter.loop_over_indices(
                lengths, lambda i, partial: [combine(partial[0], entry_at(i))], [initial_value]
            )[0]

        values = [reduce_entry(outer) for outer in np.ndindex(*kept_lengths)]
        if reduces_lanes:
            values = [_reduce_over_lanes(emitter, name, value) for value in values]
        return make_array(tuple(kept_lengths), values)

    return reduce_


def _reduce_over_lanes(emitter: ArrayEmitter, name: str, value: Value) -> Value:
    """Return whether any ("or") or all ("and") lanes of a group are true."""
    build = emitter.builder
    if not isinstance(value.type, ir.VectorType):
        return value
    bits = build.bitcast(value, ir.IntType(emitter.emitter.width))
    if name == "or":
        return build.icmp_unsigned("!=", bits, ir.Constant(bits.type, 0))
    return build.icmp_unsigned("==", bits, ir.Constant(bits.type, -1))
