"""Large arrays of LLVM values, whose entries are computed on access or stored in memory.

Those that compute hold the `ArrayEmitter` that they belong to.
"""

from collections.abc import Callable, Sequence
from typing import Any

import llvmlite.ir as ir
import numpy as np

from vrw_jax.simd.numbers import Value

Index = tuple[Any, ...]
"""For each axis an integer, or an LLVM value of type I64."""


class Field:
    """A large array whose entries, values of type `entry_type`, are computed or loaded by
    `entry_at`.

    If `entry_type` is a vector, an entry may also be a scalar, the same for all lanes.
    """

    def __init__(self, shape: Sequence[int], kind: ir.Type, at: Callable[[Index], Value]) -> None:
        self.shape, self.kind, self.at = tuple(shape), kind, at


class Unset(Field):
    """A large array whose entries are never read before they are overwritten."""


class Updated(Field):
    """An array in memory, or of one number, with one part replaced."""

    def __init__(self, arrays: Any, whole: "Entries", part: "Entries", begin: Index) -> None:
        kind = part.kind if isinstance(part, Field) else part.ravel()[0].type
        super().__init__(whole.shape, kind, self.load)
        self.arrays, self.whole, self.part, self.begin = arrays, whole, part, begin

    def load(self, index: Index) -> Value:
        """Return the entry at an index."""
        return self.arrays.entry(self.arrays.in_memory(self), index)

    def ready(self) -> "Updated":
        """Return the update with its part computed, which may depend on the entries it replaces."""
        if isinstance(self.part, np.ndarray):
            return self
        return Updated(self.arrays, self.whole, self.arrays.in_memory(self.part), self.begin)

    def store_into(self, memory: "Memory") -> None:
        """Overwrite the part in memory; the update must be materialized."""
        arrays = self.arrays

        def store(index: Index, _: Any = None) -> list[Value]:
            memory.store(arrays.further(index, self.begin), arrays.entry(self.part, index))
            return []

        if isinstance(self.part, np.ndarray) and any(self.part.strides):
            for index in np.ndindex(self.part.shape):
                store(index)
        else:
            arrays.each(self.part.shape, store)


class Memory(Field):
    """A large array stored in memory, entry after entry.

    It is `is_overwritable` if no other array uses its memory: the consumer may overwrite it.
    """

    def __init__(
        self, arrays: Any, shape: Sequence[int], kind: ir.Type, base: Value, free: bool = False
    ) -> None:
        super().__init__(shape, kind, self.load)
        self.arrays, self.base, self.free = arrays, base, free

    def place(self, index: Index) -> Value:
        """Return the address of an entry."""
        where = self.arrays.linear(index, self.shape)
        return self.arrays.builder.gep(self.base, [where], source_etype=self.kind)

    def load(self, index: Index) -> Value:
        """Return the entry at an index."""
        return self.arrays.builder.load(self.place(index), typ=self.kind)

    def store(self, index: Index, value: Value) -> None:
        """Overwrite an entry."""
        value = self.arrays.numbers.spread(value) if isinstance(self.kind, ir.VectorType) else value
        self.arrays.builder.store(value, self.place(index))

    def part(self, first: Value) -> "Memory":
        """Return the part at an index of the first axis."""
        rest = (0,) * (len(self.shape) - 1)
        return Memory(self.arrays, self.shape[1:], self.kind, self.place((first, *rest)))


class Turned(Field):
    """A view of an array in memory with its axes in another order."""

    def part(self, first: Value) -> Field:
        """Return the part at an index of the first axis."""
        return Field(self.shape[1:], self.kind, lambda index: self.at((first, *index)))


Entries = np.ndarray | Field
"""LLVM values in an array, without the axis of lanes."""


def shared(array: Entries) -> Entries:
    """Return the array as one that other consumers read too, so that it is not overwritten."""
    if isinstance(array, Updated):
        return Updated(array.arrays, shared(array.whole), array.part, array.begin)
    if isinstance(array, Memory) and array.free:
        return Memory(array.arrays, array.shape, array.kind, array.base)
    return array
