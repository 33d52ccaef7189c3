"""Large arrays of LLVM values, whose entries are computed on access or stored in memory.

Arrays that emit instructions have a reference to their `ArrayEmitter`.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from vrw_jax.lanes.machine import ir
from vrw_jax.lanes.value_emitter import LlvmValue

EntryIndex = tuple[Any, ...]
"""Index of an array entry. For each axis it contains an integer, or an LLVM value of type I64."""


@dataclass(eq=False)
class LazyArray:
    """Large array of type `entry_type`, whose entries are computed or loaded by
    `get_entry_at_index(index)`.

    If `entry_type` is a vector, an entry may also be a scalar, which is the same for all lanes.
    """

    shape: tuple[int, ...]
    entry_type: ir.Type
    get_entry_at_index: Callable[[EntryIndex], LlvmValue]


class UninitializedArray(LazyArray):
    """Large array whose entries are overwritten before they are read."""


@dataclass(eq=False)
class JoinedArray(LazyArray):
    """Arrays that are joined along one axis, and can be stored one after another."""

    parts: Sequence["LlvmArray"]
    start_indices: Sequence[EntryIndex]  # index at which each part begins


class PendingArrayUpdate(LazyArray):
    """Array in memory, or array of one repeated number, of which one part is replaced."""

    def __init__(
        self,
        array_emitter: Any,
        base_array: "LlvmArray",
        update_array: "LlvmArray",
        start_index: EntryIndex,
    ) -> None:
        entry_type = (
            update_array.entry_type
            if isinstance(update_array, LazyArray)
            else update_array.ravel()[0].type
        )
        super().__init__(base_array.shape, entry_type, self.emit_entry_load)
        self.array_emitter, self.base_array = array_emitter, base_array
        self.update_array, self.start_index = update_array, start_index

    def emit_entry_load(self, entry_index: EntryIndex) -> LlvmValue:
        """Return the LLVM value of the entry at `entry_index`.

        The entry is that of the update inside the replaced part, and that of the base array
        elsewhere.
        """
        return self.array_emitter.get_array_entry(
            self.array_emitter.store_array_in_memory(self), entry_index
        )

    def store_update_in_memory(self) -> "PendingArrayUpdate":
        """Return the same update with its new entries computed and stored in memory.

        New entries may depend on the entries that they replace, so they are computed first.
        """
        if isinstance(self.update_array, np.ndarray):
            return self
        return PendingArrayUpdate(
            self.array_emitter,
            self.base_array,
            self.array_emitter.store_array_in_memory(self.update_array),
            self.start_index,
        )


class MemoryArray(LazyArray):
    """Large array whose entries are stored one after another in memory, from `base_pointer` on.

    `is_overwritable` is True if no other array uses the memory, so that a consumer may overwrite
    it.
    """

    def __init__(
        self,
        array_emitter: Any,
        array_shape: tuple[int, ...],
        entry_type: ir.Type,
        base_pointer: LlvmValue,
        is_overwritable: bool = False,
    ) -> None:
        super().__init__(array_shape, entry_type, self.emit_entry_load)
        self.array_emitter, self.base_pointer = array_emitter, base_pointer
        self.is_overwritable = is_overwritable

    def contains_array(self, array: "LlvmArray") -> bool:
        """Return whether `array` is stored in the memory of this array."""
        return isinstance(array, MemoryArray) and array.base_pointer is self.base_pointer

    def emit_entry_address(self, entry_index: EntryIndex) -> LlvmValue:
        """Return the LLVM value of the address of the entry at `entry_index`."""
        memory_offset = self.array_emitter.emit_memory_offset(entry_index, self.shape)
        return self.array_emitter.llvm_builder.gep(
            self.base_pointer, [memory_offset], source_etype=self.entry_type
        )

    def emit_entry_load(self, entry_index: EntryIndex) -> LlvmValue:
        """Emit a load of the entry at `entry_index`, and return its LLVM value."""
        return self.array_emitter.llvm_builder.load(
            self.emit_entry_address(entry_index), typ=self.entry_type
        )

    def emit_entry_store(self, entry_index: EntryIndex, stored_value: LlvmValue) -> None:
        """Emit a store of `stored_value` into the entry at `entry_index`."""
        if isinstance(self.entry_type, ir.VectorType):
            stored_value = self.array_emitter.value_emitter.to_lane_vector(stored_value)
        self.array_emitter.llvm_builder.store(stored_value, self.emit_entry_address(entry_index))

    def get_subarray(self, first_axis_index: LlvmValue) -> "MemoryArray":
        """Return the subarray at one index of the first axis, in the memory of this array."""
        zero_indices = (0,) * (len(self.shape) - 1)
        return MemoryArray(
            self.array_emitter,
            self.shape[1:],
            self.entry_type,
            self.emit_entry_address((first_axis_index, *zero_indices)),
        )


class TransposedMemoryView(LazyArray):
    """View of an array in memory, with the axes in another order."""

    def get_subarray(self, first_axis_index: LlvmValue) -> LazyArray:
        """Return the subarray at one index of the first axis."""
        return LazyArray(
            self.shape[1:],
            self.entry_type,
            lambda entry_index: self.get_entry_at_index((first_axis_index, *entry_index)),
        )


LlvmArray = np.ndarray | LazyArray
"""Array of LLVM values without the lane axis: a NumPy array of values in registers, or a lazy
array.
"""


def mark_memory_as_shared(array: LlvmArray) -> LlvmArray:
    """Return the array with a mark that other consumers still read it, so that no consumer
    overwrites its memory.
    """
    if isinstance(array, PendingArrayUpdate):
        return PendingArrayUpdate(
            array.array_emitter,
            mark_memory_as_shared(array.base_array),
            array.update_array,
            array.start_index,
        )
    if isinstance(array, MemoryArray) and array.is_overwritable:
        return MemoryArray(array.array_emitter, array.shape, array.entry_type, array.base_pointer)
    return array
