"""Arrays of LLVM values: entries in registers, and lazy arrays whose entries are computed on
access.

A lane is one element of the batch. An array of the trace whose last axis is that of the lanes
becomes an array of LLVM vectors without that axis. Any other array becomes one of scalars.

Small arrays are divided into their entries, which live in registers: moving axes, slicing and
stacking cost nothing. Large arrays are lazy: each entry is computed or loaded on access, in a loop
over the index. They are stored in memory only if a loop carries them, if a long sum ends, or at an
`optimization_barrier` of the trace. The code therefore stays short and compiles fast. No operation
may combine lanes, except the test whether any or all of them continue.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from vrw_jax.simd.arithmetic import emit_elementwise
from vrw_jax.simd.lazy_arrays import (
    ArrayValue,
    EntryIndex,
    LazyArray,
    MemoryArray,
    PendingUpdate,
    Uninitialized,
)
from vrw_jax.simd.llvm_library import ir
from vrw_jax.simd.value_emitter import I64, NUMBER_TYPES, Value, ValueEmitter

LANE_AXIS_SENTINEL = 1021
"""Length of the lane axis in the trace, by which the axis is recognized. The machine code accepts
any number of lanes.
"""


@dataclass(frozen=True)
class RegisterLimits:
    """Largest sizes of arrays whose entries are kept in registers.

    Larger limits give longer code, which takes longer to compile.
    """

    max_unrolled: int = 8
    """Largest number of entries of a lazy array that are computed individually."""
    max_unrolled_terms: int = 8
    """Largest number of terms of a sum or a reduction that are emitted one after the other, without
    a loop.
    """
    max_registers: int = 32
    """Largest number of entries of an array that a loop carries in registers, and of a constant
    without a table in memory.
    """
    max_registers_inner: int = 64
    """Largest number of entries that an innermost loop carries in registers."""


DEFAULT_LIMITS = RegisterLimits()


class PrimitiveCall(NamedTuple):
    """An equation of a trace with one result: a primitive, its parameters, and shapes and types."""

    name: str
    params: dict[str, Any]
    in_avals: Sequence[Any]  # shapes and types of the operands
    out_aval: Any  # shape and type of the result


class ArrayEmitter:
    """Emitter of array operations, which adds LLVM instructions to the function of its value
    emitter.
    """

    def __init__(
        self, emitter: ValueEmitter, limits: RegisterLimits, is_in_innermost_loop: bool = False
    ) -> None:
        self.emitter, self.builder, self.limits = emitter, emitter.builder, limits
        self.objects_kept_alive: list[Any] = []  # objects that are identified by `id`
        # whether the code is in an innermost loop, where constants need no table
        self.is_in_innermost_loop = is_in_innermost_loop

    def entry_type_of(self, aval: Any) -> ir.Type:
        """Return the LLVM type of the entries of an array: a vector if the array has lanes, else a
        scalar.
        """
        return self.emitter.vector_type(number_type(aval)) if has_lanes(aval) else number_type(aval)

    def emit_constant_array(self, value: np.ndarray, aval: Any) -> ArrayValue:
        """Return an array of LLVM constants with the entries of `value`."""
        if LANE_AXIS_SENTINEL in aval.shape:
            raise lane_axis_error("A constant", aval)
        number_type_of_entries = number_type(aval)
        entries = make_array(
            value.shape, [self.emitter.constant(number_type_of_entries, x) for x in value.ravel()]
        )
        fits_registers = self.is_in_innermost_loop or value.size <= self.limits.max_registers
        return entries if fits_registers else self.make_table(entries)

    def get_entries(self, array: ArrayValue) -> np.ndarray:
        """Return all entries of an array as an array of LLVM values, in its shape."""
        if isinstance(array, np.ndarray):
            return array
        return make_array(array.shape, [self.get_entry(array, i) for i in np.ndindex(array.shape)])

    def get_entry(self, array: ArrayValue, index: EntryIndex) -> Value:
        """Return the entry at an index; its instructions are emitted once for each index."""
        self.objects_kept_alive.append(array)
        if isinstance(array, LazyArray):
            key = ("entry", id(array), *(i if isinstance(i, int) else ("at", id(i)) for i in index))
            return self.emitter.emit_once(key, lambda: array.entry_at(index))
        # An array with stride 0 along an axis has the same entry at all indices of the axis.
        index_strides_lengths = zip(index, array.strides, array.shape, strict=True)
        index = tuple(
            0 if stride == 0 or length == 1 else i for i, stride, length in index_strides_lengths
        )
        varying_index = tuple(i for i in index if not isinstance(i, int))
        if not varying_index:
            return array[index]
        fixed_index = tuple(i if isinstance(i, int) else slice(None) for i in index)
        table = self.emitter.emit_once(
            ("table", id(array), str(fixed_index)), lambda: self.make_table(array[fixed_index])
        )
        return self.get_entry(table, varying_index)

    def flatten_entries(self, arrays: Sequence[ArrayValue], avals: Sequence[Any]) -> list[Value]:
        """Return the entries of all arrays in one list, as vectors if the array has lanes."""
        flat_values: list[Value] = []
        for array, aval in zip(arrays, avals, strict=True):
            broadcast_entries = np.broadcast_to(
                self.get_entries(array), shape_without_lanes(aval)
            ).ravel()
            flat_values += [
                self.emitter.splat(x) if has_lanes(aval) else x for x in broadcast_entries
            ]
        return flat_values

    def linear_index(self, index: EntryIndex, shape: Sequence[int]) -> Value:
        """Return the offset of an entry in memory, in entries; the last axis varies fastest."""
        stride, constant_offset = math.prod(shape), 0
        offset: Value = None
        for i, length in zip(index, shape, strict=True):
            stride //= length
            if isinstance(i, int):
                constant_offset += i * stride
                continue
            term = i if stride == 1 else self.builder.mul(i, ir.Constant(I64, stride))
            offset = term if offset is None else self.builder.add(offset, term)
        if offset is None:
            return ir.Constant(I64, constant_offset)
        return (
            self.builder.add(offset, ir.Constant(I64, constant_offset))
            if constant_offset
            else offset
        )

    def loop_over_indices(
        self,
        shape: Sequence[int],
        emit_body: Callable[[EntryIndex, list[Value]], Sequence[Value]],
        carry: Sequence[Value] = (),
    ) -> list[Value]:
        """Emit nested loops over all indices of `shape`, and return the last `carry`.

        Each iteration is `carry = emit_body(index, carry)`.
        """

        def emit_nested_loops(index: EntryIndex, carry: Sequence[Value]) -> Sequence[Value]:
            if len(index) == len(shape):
                return emit_body(index, list(carry))
            if shape[len(index)] == 1:
                return emit_nested_loops((*index, 0), carry)
            emit_inner_loop = lambda i, carry: emit_nested_loops((*index, i), carry)
            return self.loop_n_times(shape[len(index)], emit_inner_loop, carry)

        return list(emit_nested_loops((), carry))

    def loop_n_times(
        self,
        length: int,
        emit_body: Callable[[Value, list[Value]], Sequence[Value]],
        carry: Sequence[Value],
    ) -> list[Value]:
        """Emit `for i in range(length): carry = emit_body(i, carry)`, and return the last
        `carry`.
        """
        return self.loop_over_range(ir.Constant(I64, 0), ir.Constant(I64, length), emit_body, carry)

    def loop_over_range(
        self,
        begin: Value,
        end: Value,
        emit_body: Callable[[Value, list[Value]], Sequence[Value]],
        carry: Sequence[Value] = (),
    ) -> list[Value]:
        """Emit `for i in range(begin, end): carry = emit_body(i, carry)`, and return the last
        `carry`.
        """

        def body(loop_values: list[Value]) -> list[Value]:
            next_carry = emit_body(loop_values[0], loop_values[1:])
            return [self.builder.add(loop_values[0], ir.Constant(I64, 1)), *next_carry]

        emit_condition = lambda loop_values: self.builder.icmp_signed("<", loop_values[0], end)
        return self.emitter.emit_loop([begin, *carry], emit_condition, body)[1:]

    def allocate(self, shape: Sequence[int], entry_type: ir.Type) -> MemoryArray:
        """Return an array of this shape in memory, which is allocated once, at the start of the
        function.
        """
        with self.builder.goto_entry_block():
            base_pointer = self.builder.alloca(
                entry_type, ir.Constant(I64, max(1, math.prod(shape)))
            )
        return MemoryArray(self, shape, entry_type, base_pointer)

    def fill_memory(self, memory: MemoryArray, array: ArrayValue) -> None:
        """Emit stores of all initialized entries of `array` into `memory`, which has the same
        shape.
        """
        if isinstance(array, Uninitialized):
            return
        if isinstance(array, PendingUpdate):
            self.fill_memory(memory, array.base_array)
            array.store_into(memory)
            return
        if isinstance(array, np.ndarray) and any(array.strides):
            for index in np.ndindex(memory.shape):
                memory.store(index, array[index])
            return

        def store_entry(index: EntryIndex, _: Any) -> list[Value]:
            memory.store(index, self.get_entry(array, index))
            return []

        self.loop_over_indices(memory.shape, store_entry)

    def materialize(self, array: ArrayValue) -> MemoryArray:
        """Return the array with all entries computed and stored in memory, where an LLVM value can
        index them.
        """
        if isinstance(array, MemoryArray):
            return array
        if isinstance(array, LazyArray):
            entry_type = array.entry_type
        else:  # The type is a vector if any entry is one.
            entry_types = [x.type for x in array.ravel()]
            entry_type = next(
                (
                    candidate_type
                    for candidate_type in entry_types
                    if isinstance(candidate_type, ir.VectorType)
                ),
                entry_types[0],
            )
        memory = self.allocate(array.shape, entry_type)
        self.fill_memory(memory, array)
        return memory

    def make_table(self, array: np.ndarray) -> MemoryArray:
        """Return the array in memory, where an LLVM value can index its entries; constants are
        stored in the program.
        """
        if not all(isinstance(x, ir.Constant) for x in array.ravel()):
            return self.materialize(array)
        element_type = array.ravel()[0].type
        table_type = ir.ArrayType(element_type, array.size)
        module = self.builder.module
        table = ir.GlobalVariable(module, table_type, module.get_unique_name("table"))
        table.initializer = ir.Constant(table_type, list(array.ravel()))
        table.global_constant, table.linkage = True, "internal"
        return MemoryArray(self, array.shape, element_type, table)

    def emit_elementwise(self, call: PrimitiveCall, values: Sequence[ArrayValue]) -> ArrayValue:
        """Emit an elementwise primitive for arrays of values, and return the array of its
        results.
        """
        name, params, in_avals, out_aval = call
        shape, in_dtype = shape_without_lanes(out_aval), in_avals[0].dtype
        if not shape and all(isinstance(x, np.ndarray) and not x.shape for x in values):
            operands = [x.item() for x in values]  # type: ignore[union-attr]
            return make_array(
                (),
                [emit_elementwise(self.emitter, name, params, in_dtype, out_aval.dtype, operands)],
            )
        if any(x.shape != shape for x in values):
            # An operand without lanes may have an extra axis, or fewer axes.
            values = [
                self.reshape_if_needed(x, x.shape[:-1], len(x.shape) > len(shape)) for x in values
            ]
            values = [self.broadcast_array(x, shape, range(len(x.shape))) for x in values]
        emit_entry = lambda operands: emit_elementwise(
            self.emitter, name, params, in_dtype, out_aval.dtype, operands
        )
        if any(isinstance(x, LazyArray) for x in values):
            entry_at = lambda index: emit_entry([self.get_entry(x, index) for x in values])
            return LazyArray(shape, self.entry_type_of(out_aval), entry_at)
        # Along an axis on which no operand varies, the entry is computed once and repeated.
        is_varying_axes = (any(x.strides[axis] for x in values) for axis in range(len(shape)))  # type: ignore[union-attr]
        varying_part = (*(slice(None if is_varying else 1) for is_varying in is_varying_axes), ...)
        varying_operands = [x[varying_part] for x in values]  # type: ignore[index]
        entries = zip(*(x.ravel() for x in varying_operands), strict=True)
        results = make_array(
            varying_operands[0].shape, [emit_entry(operands) for operands in entries]
        )
        return np.broadcast_to(results, shape)

    def reshape_if_needed(
        self, array: ArrayValue, shape: tuple[int, ...], is_needed: bool
    ) -> ArrayValue:
        """Return the array reshaped to `shape` if `is_needed`, else the array itself."""
        return self.reshape_array(array, shape) if is_needed else array

    def broadcast_array(
        self, array: ArrayValue, shape: tuple[int, ...], axes: Sequence[int]
    ) -> ArrayValue:
        """Return the array broadcast to `shape`; `axes` are the positions of its axes in that
        shape.
        """
        axis_lengths = array.shape
        if axis_lengths == shape and tuple(axes) == tuple(range(len(shape))):
            return array
        if isinstance(array, np.ndarray):
            new_shape = [1] * len(shape)
            for axis, length in zip(axes, axis_lengths, strict=True):
                new_shape[axis] = length
            return np.broadcast_to(array.reshape(new_shape), shape)

        def entry_at(index: EntryIndex) -> Value:
            pairs = zip(axes, axis_lengths, strict=True)
            return self.get_entry(array, tuple(0 if n == 1 else index[axis] for axis, n in pairs))

        return LazyArray(shape, array.entry_type, entry_at)

    def reshape_array(self, array: ArrayValue, shape: tuple[int, ...]) -> ArrayValue:
        """Return the array reshaped to `shape`, with the same entries in the same order."""
        if array.shape == shape:
            return array
        if isinstance(array, np.ndarray):
            return array.reshape(shape)
        if isinstance(array, MemoryArray):
            return MemoryArray(
                self, shape, array.entry_type, array.base_pointer, array.is_overwritable
            )
        old_shape = array.shape

        def entry_at(index: EntryIndex) -> Value:
            offset = self.linear_index(index, shape)
            constant_offset = offset.constant if isinstance(offset, ir.Constant) else None
            if constant_offset is not None:
                return self.get_entry(
                    array, tuple(map(int, np.unravel_index(constant_offset, old_shape)))
                )
            old_index: list[Any] = []
            for length in old_shape[:0:-1]:
                axis_length = ir.Constant(I64, length)
                old_index.append(0 if length == 1 else self.builder.urem(offset, axis_length))
                offset = offset if length == 1 else self.builder.udiv(offset, axis_length)
            return self.get_entry(array, (0 if old_shape[0] == 1 else offset, *old_index[::-1]))

        old_axes = [i for i, length in enumerate(old_shape) if length > 1]
        new_axes = [i for i, length in enumerate(shape) if length > 1]
        if [old_shape[i] for i in old_axes] == [
            shape[i] for i in new_axes
        ]:  # The shapes differ only by axes of length 1.

            def entry_at(index: EntryIndex) -> Value:
                index_by_axis = dict(zip(old_axes, (index[i] for i in new_axes), strict=True))
                return self.get_entry(
                    array, tuple(index_by_axis.get(i, 0) for i in range(len(old_shape)))
                )

        return LazyArray(shape, array.entry_type, entry_at)

    def shift_index(self, i: Any, start: int, step: int = 1) -> Any:
        """Return the index start + step * i."""
        if isinstance(i, int):
            return start + step * i
        i = i if step == 1 else self.builder.mul(i, ir.Constant(I64, step))
        return i if start == 0 else self.builder.add(i, ir.Constant(I64, start))

    def clamp_index(self, i: Value, last_index: int) -> Value:
        """Emit the index from 0 to `last_index` that is nearest to `i`, and return it."""
        builder, zero, end = self.builder, ir.Constant(I64, 0), ir.Constant(I64, last_index)
        i = builder.select(builder.icmp_signed("<", i, zero), zero, i)
        return builder.select(builder.icmp_signed(">", i, end), end, i)

    def add_indices(self, index: EntryIndex, offset_index: EntryIndex) -> EntryIndex:
        """Return the sum of two indices, axis by axis."""

        def add_index(i: Any, j: Any) -> Any:
            if isinstance(j, int):
                return self.shift_index(i, j)
            return self.shift_index(j, i) if isinstance(i, int) else self.builder.add(i, j)

        return tuple(add_index(i, j) for i, j in zip(index, offset_index, strict=True))

    def make_zero(self, entry_type: ir.Type) -> Value:
        """Return the zero from which a sum starts; unlike a known constant zero, it is not
        simplified away.
        """
        element_type = entry_type.element if isinstance(entry_type, ir.VectorType) else entry_type
        value = ir.Constant(element_type, 0.0 if isinstance(element_type, _FLOAT_TYPES) else 0)
        if not isinstance(entry_type, ir.VectorType):
            return value
        return ir.Constant(entry_type, [value] * entry_type.count)


_FLOAT_TYPES = (ir.FloatType, ir.DoubleType)


def has_lanes(aval: Any) -> bool:
    """Return whether the last axis of an array of the trace is that of the lanes."""
    return bool(aval.shape) and aval.shape[-1] == LANE_AXIS_SENTINEL


def shape_without_lanes(aval: Any) -> tuple[int, ...]:
    """Return the shape of an array of the trace without the lane axis."""
    return aval.shape[:-1] if has_lanes(aval) else aval.shape


def lane_axis_error(description: str, aval: Any) -> NotImplementedError:
    """Return the error for an axis that has the length of the lane axis but is not the last one."""
    return NotImplementedError(
        f"{description} has the shape {aval.str_short()}: an axis of {LANE_AXIS_SENTINEL} is "
        "the lanes', which come from arguments and stay the last; keep them there, and give other "
        "axes another length."
    )


def lane_mixing_error(name: str) -> NotImplementedError:
    """Return the error for the primitive `name`, which would combine lanes or move the lane
    axis.
    """
    return NotImplementedError(
        f"{name} moves, joins or selects lanes: do the same to each lane; only `any` and `all` "
        "may combine them."
    )


def number_type(aval: Any) -> ir.Type:
    """Return the LLVM type of one entry of an array of the trace, for one lane."""
    if aval.dtype not in _TYPE_BY_DTYPE:
        raise NotImplementedError(
            f"{aval.str_short()} has numbers that machine code does not support: convert them to "
            f"one of {', '.join(NUMBER_TYPES)}."
        )
    return _TYPE_BY_DTYPE[aval.dtype]


_TYPE_BY_DTYPE = {
    np.dtype(name): kind for name, kind in NUMBER_TYPES.items()
}  # The names of dtypes are slow to compute.


def make_array(shape: tuple[int, ...], entries: Sequence[Value]) -> np.ndarray:
    """Return a NumPy array of this shape whose entries are the given LLVM values."""
    array = np.empty(len(entries), object)
    array[:] = entries
    return array.reshape(shape)


def split_arrays(flat_values: Sequence[Value], avals: Sequence[Any]) -> list[ArrayValue]:
    """Return the arrays whose entries `ArrayEmitter.flatten_entries` put into one list."""
    arrays: list[ArrayValue] = []
    begin = 0
    for aval in avals:
        shape = shape_without_lanes(aval)
        end = begin + math.prod(shape)
        arrays.append(make_array(shape, flat_values[begin:end]))
        begin = end
    return arrays
