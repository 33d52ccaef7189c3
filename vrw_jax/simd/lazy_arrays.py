"""Large arrays of LLVM values, whose entries are computed on access or stored in memory.

Those that compute hold the `ArrayEmitter` that they belong to.
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from vrw_jax.simd.llvm_library import ir
from vrw_jax.simd.value_emitter import Value

EntryIndex = tuple[Any, ...]
"""For each axis an integer, or an LLVM value of type I64."""


class LazyArray:
    """A large array whose entries, values of type `entry_type`, are computed or loaded by
    `entry_at`.

    If `entry_type` is a vector, an entry may also be a scalar, the same for all lanes.
    """

    def __init__(
        self, shape: Sequence[int], entry_type: ir.Type, entry_at: Callable[[EntryIndex], Value]
    ) -> None:
        self.shape, self.entry_type, self.entry_at = tuple(shape), entry_type, entry_at


class Uninitialized(LazyArray):
    """A large array whose entries are never read before they are overwritten."""


class PendingUpdate(LazyArray):
    """An array in memory, or of one number, with one part replaced."""

    def __init__(
        self, emitter: Any, base_array: "ArrayValue", update: "ArrayValue", begin: EntryIndex
    ) -> None:
        entry_type = update.entry_type if isinstance(update, LazyArray) else update.ravel()[0].type
        super().__init__(base_array.shape, entry_type, self.load)
        self.emitter, self.base_array, self.update, self.begin = emitter, base_array, update, begin

    def load(self, index: EntryIndex) -> Value:
        """Return the entry at an index."""
        return self.emitter.get_entry(self.emitter.materialize(self), index)

    def materialize_update(self) -> "PendingUpdate":
        """Return the update with its part computed, which may depend on the entries it replaces."""
        if isinstance(self.update, np.ndarray):
            return self
        return PendingUpdate(
            self.emitter, self.base_array, self.emitter.materialize(self.update), self.begin
        )

    def store_into(self, memory: "MemoryArray") -> None:
        """Overwrite the part in memory; the update must be materialized."""
        emitter = self.emitter

        def store_updated_entry(index: EntryIndex, _: Any = None) -> list[Value]:
            memory.store(
                emitter.add_indices(index, self.begin), emitter.get_entry(self.update, index)
            )
            return []

        if isinstance(self.update, np.ndarray) and any(self.update.strides):
            for index in np.ndindex(self.update.shape):
                store_updated_entry(index)
        else:
            emitter.loop_over_indices(self.update.shape, store_updated_entry)


class MemoryArray(LazyArray):
    """A large array stored in memory, entry after entry.

    It is `is_overwritable` if no other array uses its memory: the consumer may overwrite it.
    """

    def __init__(
        self,
        emitter: Any,
        shape: Sequence[int],
        entry_type: ir.Type,
        base: Value,
        is_overwritable: bool = False,
    ) -> None:
        super().__init__(shape, entry_type, self.load)
        self.emitter, self.base, self.is_overwritable = emitter, base, is_overwritable

    def address_of(self, index: EntryIndex) -> Value:
        """Return the address of an entry."""
        offset = self.emitter.linear_index(index, self.shape)
        return self.emitter.builder.gep(self.base, [offset], source_etype=self.entry_type)

    def load(self, index: EntryIndex) -> Value:
        """Return the entry at an index."""
        return self.emitter.builder.load(self.address_of(index), typ=self.entry_type)

    def store(self, index: EntryIndex, value: Value) -> None:
        """Overwrite an entry."""
        value = (
            self.emitter.emitter.splat(value)
            if isinstance(self.entry_type, ir.VectorType)
            else value
        )
        self.emitter.builder.store(value, self.address_of(index))

    def get_row(self, row_index: Value) -> "MemoryArray":
        """Return the part at an index of the first axis."""
        trailing_index = (0,) * (len(self.shape) - 1)
        return MemoryArray(
            self.emitter,
            self.shape[1:],
            self.entry_type,
            self.address_of((row_index, *trailing_index)),
        )


class TransposedView(LazyArray):
    """A view of an array in memory with its axes in another order."""

    def get_row(self, row_index: Value) -> LazyArray:
        """Return the part at an index of the first axis."""
        return LazyArray(
            self.shape[1:], self.entry_type, lambda index: self.entry_at((row_index, *index))
        )


ArrayValue = np.ndarray | LazyArray
"""LLVM values in an array, without the axis of lanes."""


def as_shared(array: ArrayValue) -> ArrayValue:
    """Return the array as one that other consumers read too, so that it is not overwritten."""
    if isinstance(array, PendingUpdate):
        return PendingUpdate(array.emitter, as_shared(array.base_array), array.update, array.begin)
    if isinstance(array, MemoryArray) and array.is_overwritable:
        return MemoryArray(array.emitter, array.shape, array.entry_type, array.base)
    return array
