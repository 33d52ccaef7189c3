"""Primitives that move entries: indexing, slicing, concatenation and reshaping."""

import math
from collections.abc import Sequence
from typing import Any

import llvmlite.ir as ir
import numpy as np

from vrw_jax.simd.arithmetic import converted
from vrw_jax.simd.arrays import Arrays, Asked, has_lanes, moved, shape_of
from vrw_jax.simd.fields import Entries, Field, Index, Memory, Turned, Unset, Updated
from vrw_jax.simd.numbers import LONG, Value
from vrw_jax.simd.trace import Traces


def broadcast_in_dim(arrays: Arrays, asked: Asked, array: Entries, *_: Any) -> Entries:
    """Repeat an array along new axes, including the lanes'."""
    shape, axes = shape_of(asked.out), tuple(map(int, asked.params["broadcast_dimensions"]))
    array = arrays.fitted(array, array.shape[:-1], len(array.shape) > len(shape))
    if has_lanes(asked.out) and len(array.shape) == len(axes) and axes[-1:] == (len(shape),):
        array = arrays.reshaped(array, array.shape[:-1])  # one number has the axis of lanes
    alike = isinstance(array, Memory) and array.kind == arrays.kind_of(asked.out)
    if alike and math.prod(array.shape) == math.prod(shape):
        return arrays.reshaped(array, shape)
    result = arrays.broadcast(array, shape, axes[: len(array.shape)])
    if isinstance(result, Field):
        return Field(shape, arrays.kind_of(asked.out), result.at)
    return result


def reshape(arrays: Arrays, asked: Asked, array: Entries) -> Entries:
    """Return the entries in the same order, in another shape."""
    return arrays.reshaped(array, shape_of(asked.out))


def transpose(arrays: Arrays, asked: Asked, array: Entries) -> Entries:
    """Return the array with its axes in another order."""
    order = asked.params["permutation"]
    order = order[: len(array.shape)]
    if isinstance(array, np.ndarray):
        return array.transpose(order)
    back = np.argsort(order)
    at = lambda index: arrays.entry(array, tuple(index[i] for i in back))
    form = Turned if isinstance(array, Memory | Turned) else Field
    return form(shape_of(asked.out), array.kind, at)


def slice_(arrays: Arrays, asked: Asked, array: Entries) -> Entries:
    """Return the entries from one index to another, with strides."""
    strides = asked.params["strides"] or (1,) * len(asked.params["start_indices"])
    places = zip(asked.params["start_indices"], asked.params["limit_indices"], strides, strict=True)
    slices = [slice(*place) for place in places][: len(array.shape)]
    if isinstance(array, np.ndarray):
        return array[tuple(slices)]

    def at(index: Index) -> Value:
        pairs = zip(index, slices, strict=True)
        return arrays.entry(array, tuple(arrays.shifted(i, s.start, s.step) for i, s in pairs))

    return Field(shape_of(asked.out), array.kind, at)


def concatenate(arrays: Arrays, asked: Asked, *values: Entries) -> Entries:
    """Concatenate arrays along an axis."""
    return _joined(arrays, asked, asked.params["dimension"], values)


def stack(arrays: Arrays, asked: Asked, *values: Entries) -> Entries:
    """Stack arrays of one shape along a new axis."""
    axis = asked.params["axis"]
    longer = [arrays.reshaped(x, (*x.shape[:axis], 1, *x.shape[axis:])) for x in values]
    return _joined(arrays, asked, axis, longer)


def unstack(traces: Traces, equation: Any, values: list[Entries]) -> list[Entries]:
    """Split an array along an axis into arrays of one shape."""
    (array,), axis, arrays = values, equation.params["axis"], traces.arrays
    if axis == len(array.shape):
        raise moved("unstack")

    def part(place: int) -> Entries:
        shape = (*array.shape[:axis], *array.shape[axis + 1 :])
        if isinstance(array, np.ndarray):
            return array.take([place], axis).reshape(shape)
        at = lambda index: arrays.entry(array, (*index[:axis], place, *index[axis:]))
        return Field(shape, array.kind, at)

    return [part(place) for place in range(len(equation.outvars))]


def _joined(arrays: Arrays, asked: Asked, axis: int, values: Sequence[Entries]) -> Entries:
    shape = shape_of(asked.out)
    if axis == len(shape):
        raise moved(asked.name)
    if all(isinstance(x, np.ndarray) for x in values):
        return np.concatenate(values, axis)  # type: ignore[arg-type]
    parts = [x for x in values if x.shape[axis]]
    starts = np.cumsum([0, *(x.shape[axis] for x in parts)]).tolist()

    def at(index: Index) -> Value:
        i, chosen = index[axis], None
        for part, start in zip(parts, starts, strict=False):
            here, last = arrays.shifted(i, -start), part.shape[axis] - 1
            if isinstance(i, int):
                if 0 <= here <= last:
                    return arrays.entry(part, (*index[:axis], here, *index[axis + 1 :]))
                continue
            # Beyond the part's end any entry is valid, because the select below discards it.
            here = 0 if last == 0 else arrays.clamped(here, last)
            value = arrays.entry(part, (*index[:axis], here, *index[axis + 1 :]))
            inside = arrays.builder.icmp_signed(">=", i, ir.Constant(LONG, start))
            if chosen is None:
                chosen = value
            else:
                value, chosen = arrays.numbers.alike(value, chosen)
                chosen = arrays.builder.select(inside, value, chosen)
        return chosen

    return Field(shape, arrays.kind_of(asked.out), at)


def pad(arrays: Arrays, asked: Asked, array: Entries, value: Entries) -> Entries:
    """Add entries around an array, none within."""
    around = asked.params["padding_config"]
    if any(low < 0 or high < 0 or within for low, high, within in around):
        raise NotImplementedError("pad takes entries away or puts some between: slice and stack.")
    filled = np.broadcast_to(arrays.entries(value).reshape(()), shape_of(asked.out)).copy()
    inside = tuple(slice(low, low + n) for (low, _, _), n in zip(around, array.shape, strict=False))
    filled[inside] = arrays.entries(array)
    return filled


def empty(arrays: Arrays, asked: Asked) -> Entries:
    """Return uninitialized entries, which read as zeros except in memory that loops carry."""
    kind = arrays.kind_of(asked.out)
    return Unset(shape_of(asked.out), kind, lambda _: arrays.zero(kind))


def iota(arrays: Arrays, asked: Asked) -> Entries:
    """Return the indices along an axis."""
    return arrays.constants_of(np.indices(asked.out.shape)[asked.params["dimension"]], asked.out)


def dynamic_slice(arrays: Arrays, asked: Asked, array: Entries, *starts: Entries) -> Entries:
    """Return a part whose start is given by numbers, the same for all lanes."""
    begin = _starts(arrays, asked.given, array.shape, shape_of(asked.out), starts)
    at = lambda index: arrays.entry(array, arrays.further(index, begin))
    return Field(shape_of(asked.out), arrays.kind_of(asked.out), at)


def dynamic_update_slice(
    arrays: Arrays, asked: Asked, array: Entries, update: Entries, *starts: Entries
) -> Entries:
    """Replace a part whose start is given by numbers, the same for all lanes."""
    if has_lanes(asked.out) and not has_lanes(asked.given[1]):
        raise moved(asked.name)
    begin = _starts(arrays, asked.given[1:], array.shape, update.shape, starts)
    same = isinstance(array, np.ndarray) and not any(array.strides)
    plain = same or isinstance(array, Unset)
    return Updated(arrays, array if plain else arrays.in_memory(array), update, begin)


def _starts(
    arrays: Arrays, given: Any, whole: Index, part: Index, starts: Sequence[Entries]
) -> tuple[Any, ...]:
    """Return the start of a part, clamped so that the part is inside."""
    begin: list[Any] = []
    for aval, n, m, start in zip(given[1:], whole, part, starts, strict=False):
        place = arrays.entries(start).item()
        if n == m:
            begin.append(0)
        elif isinstance(place, ir.Constant):
            begin.append(min(max(int(place.constant), 0), n - m))
        else:
            place = converted(arrays.numbers, place, aval.dtype, np.dtype(np.int64))
            begin.append(arrays.clamped(place, n - m))
    return tuple(begin)
