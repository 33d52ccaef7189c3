"""Emission of array operations: small arrays have entries in registers, and lazy arrays compute
entries on access.

A lane is one element of the batch. An array of the trace whose last axis is the lane axis becomes
an array of LLVM vectors without that axis. Any other array becomes an array of LLVM scalars.

Small arrays are divided into entries in registers, so moving axes, slicing and stacking cost
nothing. Large arrays are lazy: each entry is computed or loaded on access, in a loop over the
index. A lazy array is stored in memory only if a loop carries it, if a long sum ends, or at an
`optimization_barrier` of the trace. The code therefore stays short and compiles fast. No operation
may combine lanes, except the test whether any or all lanes continue.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, NamedTuple

import numpy as np

from vrw_jax.lanes.llvm import (
    EntryIndex,
    JoinedArray,
    LazyArray,
    LlvmArray,
    LlvmValue,
    MemoryArray,
    PendingArrayUpdate,
    UninitializedArray,
    ir,
)
from vrw_jax.lanes.value_emitter import (
    I64,
    LLVM_NUMBER_TYPES,
    ValueEmitter,
    emit_llvm_elementwise_primitive,
)

LANE_AXIS_SENTINEL = 1021
"""Length of the lane axis in a trace, chosen because no other axis has this length, so that the
length identifies the axis. The machine code accepts any number of lanes."""


MAX_UNROLLED_ENTRIES = 8
"""Largest number of entries of a lazy array for which each entry has its own instructions.

With a larger number, the code is longer and takes longer to compile.
"""


class PrimitiveCall(NamedTuple):
    """Equation with one result in a jaxpr.

    The fields are the primitive, its parameters, and the shapes and types of operands and result.
    """

    primitive_name: str
    primitive_params: dict[str, Any]
    operand_avals: Sequence[Any]  # shapes and types of the operands
    result_aval: Any  # shape and type of the result

    @property
    def result_shape(self) -> tuple[int, ...]:
        """Return the shape of the result without the lane axis."""
        return get_shape_without_lanes(self.result_aval)


@dataclass(eq=False)
class ArrayEmitter:
    """Emitter of array operations.

    It adds LLVM instructions to the function of its value emitter.
    """

    value_emitter: ValueEmitter
    max_unrolled_entries: int = MAX_UNROLLED_ENTRIES
    is_in_innermost_loop: bool = False
    """Whether the code is in an innermost loop, where constants need no table."""
    objects_kept_alive: list[Any] = field(default_factory=list)
    """Objects that are identified by `id`."""
    n_stack_bytes: int = 0
    MAX_STACK_BYTES: ClassVar[int] = 6 * 2**20
    """Largest memory of one LLVM function. Threads usually have 8 MB of stack, and a function that
    needs more ends the process.
    """
    MAX_REGISTER_ENTRIES: ClassVar[int] = 32
    """Largest number of entries of an array that a loop carries in registers.

    The limit also applies to constants; a larger constant is a table in memory.
    """
    MAX_INNERMOST_REGISTER_ENTRIES: ClassVar[int] = 64
    """Largest number of entries of an array that an innermost loop carries in registers."""
    MAX_UNROLLED_REDUCTION_TERMS: ClassVar[int] = 8
    """Largest number of terms of a sum or another reduction for which no loop is emitted."""

    def __post_init__(self) -> None:
        self.llvm_builder = self.value_emitter.llvm_builder

    def get_entry_type(self, aval: Any) -> ir.Type:
        """Return the LLVM type of an entry of an array with the abstract value `aval`.

        The type is a vector if the array has a lane axis, else a scalar.
        """
        return (
            self.value_emitter.make_vector_type(get_llvm_number_type(aval))
            if has_lane_axis(aval)
            else get_llvm_number_type(aval)
        )

    def emit_constant_array(self, constant_array: np.ndarray, aval: Any) -> LlvmArray:
        """Return an array of LLVM constants that equal the entries of `constant_array`.

        A large array is stored in memory, unless the code is in an innermost loop.
        """
        if LANE_AXIS_SENTINEL in aval.shape:
            raise make_lane_axis_error("A constant", aval)
        llvm_entry_type = get_llvm_number_type(aval)
        constant_entries = make_entry_array(
            constant_array.shape,
            [
                self.value_emitter.make_llvm_constant(llvm_entry_type, x)
                for x in constant_array.ravel()
            ],
        )
        fits_registers = (
            self.is_in_innermost_loop or constant_array.size <= self.MAX_REGISTER_ENTRIES
        )
        return constant_entries if fits_registers else self.make_memory_table(constant_entries)

    def get_array_entries(self, array: LlvmArray) -> np.ndarray:
        """Return a NumPy array of the LLVM values of all entries, in the shape of `array`."""
        if isinstance(array, np.ndarray):
            return array
        return make_entry_array(
            array.shape, [self.get_array_entry(array, i) for i in np.ndindex(array.shape)]
        )

    def get_array_entry(self, array: LlvmArray, entry_index: EntryIndex) -> LlvmValue:
        """Return the LLVM value of the entry at `entry_index`.

        Its instructions are emitted only on the first call for the index.
        """
        self.objects_kept_alive.append(array)
        if isinstance(array, LazyArray):
            entry_key = (
                "entry",
                id(array),
                *(i if isinstance(i, int | np.integer) else ("at", id(i)) for i in entry_index),
            )
            return self.value_emitter.emit_value_once(
                entry_key, lambda: array.get_entry_at_index(entry_index)
            )
        # An array with stride 0 along an axis has the same entry at all indices of the axis.
        indices_strides_lengths = zip(entry_index, array.strides, array.shape, strict=True)
        entry_index = tuple(
            0 if axis_stride == 0 or axis_length == 1 else i
            for i, axis_stride, axis_length in indices_strides_lengths
        )
        llvm_index = tuple(i for i in entry_index if not isinstance(i, int | np.integer))
        if not llvm_index:
            return array[entry_index]
        integer_index = tuple(
            i if isinstance(i, int | np.integer) else slice(None) for i in entry_index
        )
        memory_table = self.value_emitter.emit_value_once(
            ("table", id(array), str(integer_index)),
            lambda: self.make_memory_table(array[integer_index]),
        )
        return self.get_array_entry(memory_table, llvm_index)

    def flatten_array_entries(
        self, arrays: Sequence[LlvmArray], avals: Sequence[Any]
    ) -> list[LlvmValue]:
        """Return a list of the LLVM values of all entries of all arrays.

        Entries of an array with a lane axis are vectors.
        """
        flat_entries: list[LlvmValue] = []
        for array, aval in zip(arrays, avals, strict=True):
            broadcast_entries = np.broadcast_to(
                self.get_array_entries(array), get_shape_without_lanes(aval)
            ).ravel()
            flat_entries += [
                self.value_emitter.to_lane_vector(x) if has_lane_axis(aval) else x
                for x in broadcast_entries
            ]
        return flat_entries

    def emit_memory_offset(self, entry_index: EntryIndex, array_shape: Sequence[int]) -> LlvmValue:
        """Emit the offset of an entry from the start of an array in memory, and return the LLVM
        value of the offset.

        The unit is one entry. The last axis varies fastest.
        """
        axis_stride, constant_offset = math.prod(array_shape), 0
        memory_offset: LlvmValue = None
        for i, axis_length in zip(entry_index, array_shape, strict=True):
            axis_stride //= axis_length
            if isinstance(i, int | np.integer):
                constant_offset += int(i) * axis_stride
                continue
            axis_offset = self.emit_affine_index(i, 0, axis_stride)
            memory_offset = (
                axis_offset
                if memory_offset is None
                else self.llvm_builder.add(memory_offset, axis_offset)
            )
        if memory_offset is None:
            return ir.Constant(I64, constant_offset)
        return self.emit_affine_index(memory_offset, constant_offset)

    def emit_index_loops(
        self,
        index_shape: Sequence[int],
        emit_loop_body: Callable[[EntryIndex, list[LlvmValue]], Sequence[LlvmValue]],
        loop_carry: Sequence[LlvmValue] = (),
    ) -> list[LlvmValue]:
        """Emit nested loops over all indices of an array of shape `index_shape`.

        Each iteration computes `loop_carry = emit_loop_body(index, loop_carry)`. Return the loop
        carry after the last iteration.
        """

        def emit_nested_index_loops(
            outer_index: EntryIndex, loop_carry: Sequence[LlvmValue]
        ) -> Sequence[LlvmValue]:
            if len(outer_index) == len(index_shape):
                return emit_loop_body(outer_index, list(loop_carry))
            if index_shape[len(outer_index)] == 1:
                return emit_nested_index_loops((*outer_index, 0), loop_carry)
            emit_inner_loop = lambda i, loop_carry: emit_nested_index_loops(
                (*outer_index, i), loop_carry
            )
            return self.emit_range_loop(
                0, index_shape[len(outer_index)], emit_inner_loop, loop_carry
            )

        return list(emit_nested_index_loops((), loop_carry))

    def emit_range_loop(
        self,
        first_iteration: Any,
        end_iteration: Any,
        emit_loop_body: Callable[[LlvmValue, list[LlvmValue]], Sequence[LlvmValue]],
        initial_loop_carry: Sequence[LlvmValue] = (),
    ) -> list[LlvmValue]:
        """Emit a loop over `range(first_iteration, end_iteration)`, and return the loop carry after
        its end.

        Iteration i computes `carry = emit_loop_body(i, carry)`. The bounds are integers or LLVM
        values.
        """
        first_iteration, end_iteration = (
            ir.Constant(I64, i) if isinstance(i, int | np.integer) else i
            for i in (first_iteration, end_iteration)
        )

        def emit_range_body(loop_carried_values: list[LlvmValue]) -> list[LlvmValue]:
            next_loop_carry = emit_loop_body(loop_carried_values[0], loop_carried_values[1:])
            return [
                self.llvm_builder.add(loop_carried_values[0], ir.Constant(I64, 1)),
                *next_loop_carry,
            ]

        emit_range_condition = lambda loop_carried_values: self.llvm_builder.icmp_signed(
            "<", loop_carried_values[0], end_iteration
        )
        return self.value_emitter.emit_llvm_loop(
            [first_iteration, *initial_loop_carry], emit_range_condition, emit_range_body
        )[1:]

    def allocate_memory_array(
        self, array_shape: tuple[int, ...], entry_type: ir.Type
    ) -> MemoryArray:
        """Return a new uninitialized array of shape `array_shape` in memory.

        The memory is allocated once, at the start of the LLVM function, on the stack.
        """
        largest_number_bytes = 8
        self.n_stack_bytes += (
            largest_number_bytes * math.prod(array_shape) * getattr(entry_type, "count", 1)
        )
        if self.n_stack_bytes > self.MAX_STACK_BYTES:
            raise NotImplementedError(
                f"its arrays need {self.n_stack_bytes / 2**20:.0f} MB, which do not fit on the "
                "stack: return fewer numbers, or repeat a shorter loop."
            )
        with self.llvm_builder.goto_entry_block():
            base_pointer = self.llvm_builder.alloca(
                entry_type, ir.Constant(I64, max(1, math.prod(array_shape)))
            )
        return MemoryArray(self, array_shape, entry_type, base_pointer)

    def emit_array_stores(
        self, memory_array: MemoryArray, array: LlvmArray, start_index: EntryIndex = ()
    ) -> None:
        """Emit stores of all initialized entries of `array` into the part of `memory_array` that
        begins at `start_index`.

        Without a start index, both arrays have the same shape.
        """
        if isinstance(array, UninitializedArray) or memory_array.contains_array(array):
            return
        start_index = start_index or (0,) * len(array.shape)
        if isinstance(array, JoinedArray):
            for part, part_start_index in zip(array.parts, array.start_indices, strict=True):
                self.emit_array_stores(
                    memory_array, part, self.emit_sum_of_indices(part_start_index, start_index)
                )
            return
        if isinstance(array, PendingArrayUpdate):
            # New entries may depend on the entries that they replace, so they are computed first.
            if memory_array.contains_array(array.base_array):
                array = array.store_update_in_memory()
            update_start_index = self.emit_sum_of_indices(array.start_index, start_index)
            self.emit_array_stores(memory_array, array.base_array, start_index)
            self.emit_array_stores(memory_array, array.update_array, update_start_index)
            return

        def emit_entry_copy(entry_index: EntryIndex, _: Any = None) -> list[LlvmValue]:
            memory_array.emit_entry_store(
                self.emit_sum_of_indices(entry_index, start_index),
                self.get_array_entry(array, entry_index),
            )
            return []

        if isinstance(array, np.ndarray) and any(array.strides):
            for entry_index in np.ndindex(array.shape):
                emit_entry_copy(entry_index)
        else:
            self.emit_index_loops(array.shape, emit_entry_copy)

    def store_array_in_memory(self, array: LlvmArray) -> MemoryArray:
        """Return the array with all entries computed and stored in memory.

        In memory, an LLVM value can serve as an index.
        """
        if isinstance(array, MemoryArray):
            return array
        if isinstance(array, LazyArray):
            entry_type = array.entry_type
        else:  # The type is a vector if any entry is one.
            entry_types = [x.type for x in array.ravel()]
            vector_types = (t for t in entry_types if isinstance(t, ir.VectorType))
            entry_type = next(vector_types, entry_types[0])
        memory_array = self.allocate_memory_array(array.shape, entry_type)
        self.emit_array_stores(memory_array, array)
        return memory_array

    def make_memory_table(self, array: np.ndarray) -> MemoryArray:
        """Return the array stored in memory, where an LLVM value can serve as an index.

        An array of constants becomes part of the program.
        """
        if not all(isinstance(x, ir.Constant) for x in array.ravel()):
            return self.store_array_in_memory(array)
        llvm_element_type = array.ravel()[0].type
        llvm_table_type = ir.ArrayType(llvm_element_type, array.size)
        llvm_module = self.llvm_builder.module
        llvm_table = ir.GlobalVariable(
            llvm_module, llvm_table_type, llvm_module.get_unique_name("table")
        )
        llvm_table.initializer = ir.Constant(llvm_table_type, list(array.ravel()))
        llvm_table.global_constant, llvm_table.linkage = True, "internal"
        return MemoryArray(self, array.shape, llvm_element_type, llvm_table)

    def emit_elementwise_array(
        self, primitive_call: PrimitiveCall, *operand_arrays: LlvmArray
    ) -> LlvmArray:
        """Apply the primitive to each entry, and return the array of the results."""
        primitive_name, primitive_params, operand_avals, result_aval = primitive_call
        result_shape = primitive_call.result_shape
        emit_result_entry = lambda entry_operands: emit_llvm_elementwise_primitive(
            self.value_emitter,
            primitive_name,
            primitive_params,
            operand_avals[0].dtype,
            result_aval.dtype,
            entry_operands,
        )
        if not result_shape and all(
            isinstance(x, np.ndarray) and not x.shape for x in operand_arrays
        ):
            entry_operands = [x.item() for x in operand_arrays]  # type: ignore[union-attr]
            return make_entry_array((), [emit_result_entry(entry_operands)])
        if any(x.shape != result_shape for x in operand_arrays):
            # An operand without lanes may have an extra axis, or fewer axes.
            shortened_arrays = [self.drop_extra_axis(x, len(result_shape)) for x in operand_arrays]
            operand_arrays = tuple(
                self.broadcast_array(x, result_shape, range(len(x.shape))) for x in shortened_arrays
            )
        if any(isinstance(x, LazyArray) for x in operand_arrays):
            emit_entry_at_index = lambda entry_index: emit_result_entry(
                [self.get_array_entry(x, entry_index) for x in operand_arrays]
            )
            return LazyArray(result_shape, self.get_entry_type(result_aval), emit_entry_at_index)
        # Along an axis on which no operand varies, the entry is computed once and repeated.
        varying_axis_flags = (
            any(x.strides[axis] for x in operand_arrays)  # type: ignore[union-attr]
            for axis in range(len(result_shape))
        )  # type: ignore[union-attr]
        varying_axes_index = (
            *(slice(None if is_varying_axis else 1) for is_varying_axis in varying_axis_flags),
            ...,
        )
        varying_operands = [x[varying_axes_index] for x in operand_arrays]  # type: ignore[index]
        operand_entries = zip(*(x.ravel() for x in varying_operands), strict=True)
        result_entries = make_entry_array(
            varying_operands[0].shape,
            [emit_result_entry(entry_operands) for entry_operands in operand_entries],
        )
        if result_entries.shape == result_shape:
            return result_entries
        return np.broadcast_to(result_entries, result_shape)

    def drop_extra_axis(self, array: LlvmArray, n_axes: int) -> LlvmArray:
        """Return the array without its last axis if it has more than `n_axes` axes."""
        has_extra_axis = len(array.shape) > n_axes
        return self.reshape_array(array, array.shape[:-1]) if has_extra_axis else array

    def broadcast_array(
        self, array: LlvmArray, broadcast_shape: tuple[int, ...], axis_positions: Sequence[int]
    ) -> LlvmArray:
        """Return the array broadcast to `broadcast_shape`.

        - `axis_positions`: for each axis of the array, its position in `broadcast_shape`.
        """
        axis_lengths = array.shape
        if axis_lengths == broadcast_shape and tuple(axis_positions) == tuple(
            range(len(broadcast_shape))
        ):
            return array
        if isinstance(array, np.ndarray):
            expanded_shape = [1] * len(broadcast_shape)
            for axis_position, axis_length in zip(axis_positions, axis_lengths, strict=True):
                expanded_shape[axis_position] = axis_length
            return np.broadcast_to(array.reshape(expanded_shape), broadcast_shape)

        def get_broadcast_entry(broadcast_index: EntryIndex) -> LlvmValue:
            positions_and_lengths = zip(axis_positions, axis_lengths, strict=True)
            return self.get_array_entry(
                array,
                tuple(0 if n == 1 else broadcast_index[axis] for axis, n in positions_and_lengths),
            )

        return LazyArray(broadcast_shape, array.entry_type, get_broadcast_entry)

    def reshape_array(self, array: LlvmArray, new_shape: tuple[int, ...]) -> LlvmArray:
        """Return the array reshaped to `new_shape`, with the same entries in the same order."""
        if array.shape == new_shape:
            return array
        if isinstance(array, np.ndarray):
            return array.reshape(new_shape)
        if isinstance(array, MemoryArray):
            return MemoryArray(
                self, new_shape, array.entry_type, array.base_pointer, array.is_overwritable
            )
        shape_before_reshape = array.shape

        def get_reshaped_entry(reshaped_index: EntryIndex) -> LlvmValue:
            memory_offset = self.emit_memory_offset(reshaped_index, new_shape)
            if isinstance(memory_offset, ir.Constant):
                constant_index = np.unravel_index(memory_offset.constant, shape_before_reshape)
                return self.get_array_entry(array, tuple(map(int, constant_index)))
            index_before_reshape: list[Any] = []
            for axis_length in shape_before_reshape[:0:-1]:
                if axis_length == 1:
                    index_before_reshape.append(0)
                    continue
                llvm_axis_length = ir.Constant(I64, axis_length)
                index_before_reshape.append(self.llvm_builder.urem(memory_offset, llvm_axis_length))
                memory_offset = self.llvm_builder.udiv(memory_offset, llvm_axis_length)
            return self.get_array_entry(
                array,
                (0 if shape_before_reshape[0] == 1 else memory_offset, *index_before_reshape[::-1]),
            )

        nonunit_old_axes = [
            i for i, axis_length in enumerate(shape_before_reshape) if axis_length > 1
        ]
        nonunit_new_axes = [i for i, axis_length in enumerate(new_shape) if axis_length > 1]
        if [shape_before_reshape[i] for i in nonunit_old_axes] == [
            new_shape[i] for i in nonunit_new_axes
        ]:  # The shapes differ only by axes of length 1.

            def get_reshaped_entry(reshaped_index: EntryIndex) -> LlvmValue:
                index_by_axis = dict(
                    zip(
                        nonunit_old_axes, (reshaped_index[i] for i in nonunit_new_axes), strict=True
                    )
                )
                return self.get_array_entry(
                    array, tuple(index_by_axis.get(i, 0) for i in range(len(shape_before_reshape)))
                )

        return LazyArray(new_shape, array.entry_type, get_reshaped_entry)

    def emit_affine_index(self, i: Any, index_start: int, index_step: int = 1) -> Any:
        """Emit the index `index_start + index_step * i`, and return its LLVM value.

        If `i` is an integer, the function only computes the index and returns an integer.
        """
        if isinstance(i, int | np.integer):
            return index_start + index_step * int(i)
        i = i if index_step == 1 else self.llvm_builder.mul(i, ir.Constant(I64, index_step))
        return i if index_start == 0 else self.llvm_builder.add(i, ir.Constant(I64, index_start))

    def emit_clamped_index(self, i: LlvmValue, last_index: int) -> LlvmValue:
        """Emit the index from 0 to `last_index` that is nearest to `i`, and return its value."""
        if last_index == 0:
            return 0
        llvm_builder = self.llvm_builder
        llvm_zero, llvm_last_index = ir.Constant(I64, 0), ir.Constant(I64, last_index)
        i = llvm_builder.select(llvm_builder.icmp_signed("<", i, llvm_zero), llvm_zero, i)
        return llvm_builder.select(
            llvm_builder.icmp_signed(">", i, llvm_last_index), llvm_last_index, i
        )

    def emit_sum_of_indices(self, entry_index: EntryIndex, offset_index: EntryIndex) -> EntryIndex:
        """Emit the sum of two indices of array entries, axis by axis, and return the resulting
        index.
        """

        def emit_axis_index_sum(i: Any, j: Any) -> Any:
            if isinstance(j, int | np.integer):
                return self.emit_affine_index(i, int(j))
            if isinstance(i, int | np.integer):
                return self.emit_affine_index(j, int(i))
            return self.llvm_builder.add(i, j)

        return tuple(
            emit_axis_index_sum(i, j) for i, j in zip(entry_index, offset_index, strict=True)
        )


def has_lane_axis(aval: Any) -> bool:
    """Return whether the last axis of an array of the trace is the lane axis."""
    return bool(aval.shape) and aval.shape[-1] == LANE_AXIS_SENTINEL


def get_shape_without_lanes(aval: Any) -> tuple[int, ...]:
    """Return the shape, without the lane axis, of an array of the trace."""
    return aval.shape[:-1] if has_lane_axis(aval) else aval.shape


class LaneAxisError(NotImplementedError):
    """Error of a function that is not elementwise over lanes, which XLA cannot compute either."""


def make_lane_axis_error(error_subject: str, aval: Any) -> LaneAxisError:
    """Return the error for an axis that has the length of the lane axis without being the last
    axis.

    - `error_subject`: subject of the message, such as "An argument".
    """
    return LaneAxisError(
        f"{error_subject} has the shape {aval.str_short()}: an axis of {LANE_AXIS_SENTINEL} is "
        "the lanes', which come from arguments and stay the last; keep them there, and give other "
        "axes another length."
    )


def make_lane_mixing_error(primitive_name: str) -> LaneAxisError:
    """Return the error for a primitive that would combine lanes or move the lane axis."""
    return LaneAxisError(
        f"{primitive_name} moves, joins or selects lanes: do the same to each lane; only `any` and "
        "`all` may combine them."
    )


def get_llvm_number_type(aval: Any) -> ir.Type:
    """Return the LLVM type of one entry, for one lane, of an array of the trace."""
    if aval.dtype not in _LLVM_TYPE_BY_DTYPE:
        raise NotImplementedError(
            f"{aval.str_short()} has numbers that machine code does not support: convert them to "
            f"one of {', '.join(LLVM_NUMBER_TYPES)}."
        )
    return _LLVM_TYPE_BY_DTYPE[aval.dtype]


_LLVM_TYPE_BY_DTYPE = {
    np.dtype(dtype_name): llvm_number_type
    for dtype_name, llvm_number_type in LLVM_NUMBER_TYPES.items()
}  # The names of dtypes are slow to compute.


def make_entry_array(array_shape: tuple[int, ...], llvm_entries: Sequence[LlvmValue]) -> np.ndarray:
    """Return a NumPy array of shape `array_shape` whose entries are `llvm_entries`."""
    entry_array = np.empty(len(llvm_entries), object)
    entry_array[:] = llvm_entries
    return entry_array.reshape(array_shape)


def split_into_entry_arrays(
    flat_entries: Sequence[LlvmValue], avals: Sequence[Any]
) -> list[LlvmArray]:
    """Return arrays with the abstract values `avals`, whose entries are those of the list
    `flat_entries`.

    This function is the inverse of `ArrayEmitter.flatten_array_entries`.
    """
    array_shapes = list(map(get_shape_without_lanes, avals))
    array_ends = np.cumsum([math.prod(array_shape) for array_shape in array_shapes])
    flat_arrays = np.split(make_entry_array((len(flat_entries),), flat_entries), array_ends)
    return [x.reshape(shape) for x, shape in zip(flat_arrays, array_shapes, strict=False)]
