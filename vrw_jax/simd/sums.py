"""Primitives that reduce along axes of entries; over lanes they compute only any and all."""

import functools
import math
from collections.abc import Callable
from typing import Any

import llvmlite.ir as ir
import numpy as np

from vrw_jax.simd.arithmetic import elementwise
from vrw_jax.simd.arrays import SMALL, Arrays, Asked, array_of, has_lanes, moved, shape_of
from vrw_jax.simd.fields import Entries, Field, Index
from vrw_jax.simd.numbers import Value


def cumsum(arrays: Arrays, asked: Asked, array: Entries) -> Entries:
    """Return cumulative sums along an axis, from either end."""
    if asked.params["axis"] == len(array.shape):
        raise moved(asked.name)
    rows, dtype = np.moveaxis(arrays.entries(array), asked.params["axis"], 0), asked.out.dtype
    order = range(len(rows))[:: -1 if asked.params["reverse"] else 1]
    plus = lambda x, y: elementwise(arrays.numbers, "add", {}, dtype, dtype, (x, y))
    sums = np.empty_like(rows)
    for k, i in enumerate(order):
        pairs = zip(sums[order[k - 1], ...].ravel(), rows[i, ...].ravel(), strict=True)
        told = [plus(*pair) if k else pair[1] for pair in pairs]
        sums[i, ...] = array_of(rows.shape[1:], told)
    return np.moveaxis(sums, 0, asked.params["axis"])


def dot_general(arrays: Arrays, asked: Asked, left: Entries, right: Entries) -> Entries:
    """Return a product of arrays, summed over one pair of axes."""
    (over_left, over_right), (both, _) = asked.params["dimension_numbers"]
    if both or len(over_left) != 1:
        raise NotImplementedError(
            "dot_general sums over one pair of axes only, without a batch: multiply and sum."
        )
    (a,), (b,), dtype = over_left, over_right, asked.out.dtype
    length, n_left = left.shape[a], len(left.shape) - 1

    def product(index: Index, k: Any) -> Value:
        own, other = index[:n_left], index[n_left:]
        x = arrays.entry(left, (*own[:a], k, *own[a:]))
        y = arrays.entry(right, (*other[:b], k, *other[b:]))
        return elementwise(arrays.numbers, "mul", {}, dtype, dtype, (x, y))

    plus = lambda x, y: elementwise(arrays.numbers, "add", {}, dtype, dtype, (x, y))
    shape, kind = shape_of(asked.out), arrays.kind_of(asked.out)
    if length <= SMALL or arrays.written_out:
        at = lambda index: functools.reduce(plus, [product(index, k) for k in range(length)])
        if isinstance(left, Field) or isinstance(right, Field):
            return Field(shape, kind, at)
        return array_of(shape, [at(index) for index in np.ndindex(shape)])
    left, right = arrays.in_memory(left), arrays.in_memory(right)
    memory = arrays.room(shape, kind)

    def total(index: Index, _: Any) -> list[Value]:
        turn = lambda k, sums: [plus(sums[0], product(index, k))]
        memory.store(index, arrays.counted(length, turn, [arrays.zero(kind)])[0])
        return []

    arrays.each(shape, total)
    return memory


def reduction(name: str) -> Callable[..., Entries]:
    """Return the rule of a reduction by the elementwise primitive `name`."""

    def reduce_(arrays: Arrays, asked: Asked, array: Entries) -> Entries:
        """Reduce along axes; `any` and `all` also over lanes."""
        over_lanes = has_lanes(asked.given[0]) and not has_lanes(asked.out)
        dtype = asked.given[0].dtype
        if over_lanes and (name not in ("and", "or") or dtype.kind != "b"):
            raise moved(asked.name)
        axes = tuple(axis for axis in asked.params["axes"] if axis < len(array.shape))
        combine = lambda x, y: elementwise(arrays.numbers, name, {}, dtype, dtype, (x, y))
        left_over = [n for axis, n in enumerate(array.shape) if axis not in axes]
        lengths = [array.shape[axis] for axis in axes]

        def index_of(outer: Index, inner: Index) -> Index:
            some, others = iter(inner), iter(outer)
            return tuple(next(some if i in axes else others) for i in range(len(array.shape)))

        def reduced(outer: Index) -> Value:
            at = lambda inner: arrays.entry(array, index_of(outer, inner))
            if isinstance(array, np.ndarray) or math.prod(lengths) <= SMALL:
                return functools.reduce(combine, map(at, np.ndindex(*lengths)))
            first = at((0,) * len(lengths))  # counted twice, which does not change these reductions
            if name == "add":
                first = arrays.zero(array.kind)
            elif isinstance(array.kind, ir.VectorType):
                first = arrays.numbers.spread(first)
            return arrays.each(lengths, lambda i, so_far: [combine(so_far[0], at(i))], [first])[0]

        values = [reduced(outer) for outer in np.ndindex(*left_over)]
        if over_lanes:
            values = [_over_lanes(arrays, name, value) for value in values]
        return array_of(tuple(left_over), values)

    return reduce_


def _over_lanes(arrays: Arrays, name: str, value: Value) -> Value:
    build = arrays.builder
    if not isinstance(value.type, ir.VectorType):
        return value
    bits = build.bitcast(value, ir.IntType(arrays.numbers.width))
    if name == "or":
        return build.icmp_unsigned("!=", bits, ir.Constant(bits.type, 0))
    return build.icmp_unsigned("==", bits, ir.Constant(bits.type, -1))
