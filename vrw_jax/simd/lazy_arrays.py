"""Large arrays of LLVM values, whose entries are computed on access or stored in memory.

Arrays that emit instructions contain the `ArrayEmitter` to which they belong.
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from vrw_jax.simd.llvm_library import ir
from vrw_jax.simd.value_emitter import Value

EntryIndex = tuple[Any, ...]
"""Index of an array entry: for each axis an integer, or an LLVM value of type I64."""


class LazyArray:
    """A large array of type `entry_type` whose entries the function `entry_at(index)` computes or
    loads.

    If `entry_type` is a vector, an entry may also be a scalar, which is the same for all lanes.
    """

    def __init__(
        self, shape: Sequence[int], entry_type: ir.Type, entry_at: Callable[[EntryIndex], Value]
    ) -> None:
        self.shape, self.entry_type, self.entry_at = tuple(shape), entry_type, entry_at


class Uninitialized(LazyArray):
    """A large array whose entries are never read before they are overwritten."""


class PendingUpdate(LazyArray):
    """An array in memory, or an array of one repeated number, with one part replaced."""

    def __init__(
        self, emitter: Any, base_array: "ArrayValue", update: "ArrayValue", start_index: EntryIndex
    ) -> None:
        entry_type = update.entry_type if isinstance(update, LazyArray) else update.ravel()[0].type
        super().__init__(base_array.shape, entry_type, self.load)
        self.emitter, self.base_array, self.update, self.start_index = (
            emitter,
            base_array,
            update,
            start_index,
        )

    def load(self, index: EntryIndex) -> Value:
        """Return the entry at an index: of the update inside the replaced part, else of the base
        array.
        """
        return self.emitter.get_entry(self.emitter.materialize(self), index)

    def materialize_update(self) -> "PendingUpdate":
        """Return the same update with its part computed, because the part may depend on the entries
        that it replaces.
        """
        if isinstance(self.update, np.ndarray):
            return self
        return PendingUpdate(
            self.emitter, self.base_array, self.emitter.materialize(self.update), self.start_index
        )

    def store_into(self, memory: "MemoryArray") -> None:
        """Emit stores that overwrite the part in `memory`; the update must be materialized."""
        emitter = self.emitter

        def store_updated_entry(index: EntryIndex, _: Any = None) -> list[Value]:
            memory.store(
                emitter.add_indices(index, self.start_index), emitter.get_entry(self.update, index)
            )
            return []

        if isinstance(self.update, np.ndarray) and any(self.update.strides):
            for index in np.ndindex(self.update.shape):
                store_updated_entry(index)
        else:
            emitter.loop_over_indices(self.update.shape, store_updated_entry)


class MemoryArray(LazyArray):
    """A large array stored in memory, entry after entry, at `base_pointer`.

    The flag `is_overwritable` is True if no other array uses the memory, so that the consumer may
    overwrite it.
    """

    def __init__(
        self,
        emitter: Any,
        shape: Sequence[int],
        entry_type: ir.Type,
        base_pointer: Value,
        is_overwritable: bool = False,
    ) -> None:
        super().__init__(shape, entry_type, self.load)
        self.emitter, self.base_pointer, self.is_overwritable = (
            emitter,
            base_pointer,
            is_overwritable,
        )

    def address_of(self, index: EntryIndex) -> Value:
        """Return the address of the entry at an index."""
        offset = self.emitter.linear_index(index, self.shape)
        return self.emitter.builder.gep(self.base_pointer, [offset], source_etype=self.entry_type)

    def load(self, index: EntryIndex) -> Value:
        """Emit a load of the entry at an index, and return its value."""
        return self.emitter.builder.load(self.address_of(index), typ=self.entry_type)

    def store(self, index: EntryIndex, value: Value) -> None:
        """Emit a store of `value` at an index."""
        value = (
            self.emitter.emitter.splat(value)
            if isinstance(self.entry_type, ir.VectorType)
            else value
        )
        self.emitter.builder.store(value, self.address_of(index))

    def get_row(self, row_index: Value) -> "MemoryArray":
        """Return the part of the array at one index of its first axis, in the same memory."""
        later_indices = (0,) * (len(self.shape) - 1)
        return MemoryArray(
            self.emitter,
            self.shape[1:],
            self.entry_type,
            self.address_of((row_index, *later_indices)),
        )


class TransposedView(LazyArray):
    """A view of an array in memory with its axes in another order."""

    def get_row(self, row_index: Value) -> LazyArray:
        """Return the part of the array at one index of its first axis."""
        return LazyArray(
            self.shape[1:], self.entry_type, lambda index: self.entry_at((row_index, *index))
        )


ArrayValue = np.ndarray | LazyArray
"""Array of LLVM values without the lane axis, in registers (NumPy) or lazy."""


def as_shared(array: ArrayValue) -> ArrayValue:
    """Return the array marked as read by other consumers too, so that its memory is not
    overwritten.
    """
    if isinstance(array, PendingUpdate):
        return PendingUpdate(
            array.emitter, as_shared(array.base_array), array.update, array.start_index
        )
    if isinstance(array, MemoryArray) and array.is_overwritable:
        return MemoryArray(array.emitter, array.shape, array.entry_type, array.base_pointer)
    return array
