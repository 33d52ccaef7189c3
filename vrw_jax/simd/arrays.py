"""Arrays of LLVM values: entries in registers, and lazy arrays whose entries are computed on
access.

An array whose last axis are lanes is, without that axis, an array of LLVM vectors; any other is one
of scalars. Small arrays are divided into their entries, which live in registers: moving axes,
slicing and stacking cost nothing. Large arrays are lazy: each entry is computed or loaded on
access, in a loop over the index. They are stored in memory only where a loop carries them, where a
long sum ends and where the trace has an `optimization_barrier`. Code therefore stays short and
compiles fast. No operation may combine lanes, except to test whether any or all of them continue.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import llvmlite.ir as ir
import numpy as np

from vrw_jax.simd.arithmetic import elementwise
from vrw_jax.simd.fields import Entries, Field, Index, Memory, Unset, Updated
from vrw_jax.simd.numbers import LONG, NUMBERS, Numbers, Value

LANES = 1021
"""Length of the lane axis in the trace, by which the axis is recognized; machine code has any
number of lanes."""
SMALL = 8
"""Most entries of a lazy array that are computed individually, and most terms of a sum that are
unrolled."""
HELD = 32
"""Most entries of an array that a loop carries in registers, and of a constant that needs no
table."""
HELD_INSIDE = 64
"""The same limit of carried entries for loops without inner loops, which are unrolled."""


class Asked(NamedTuple):
    """An equation of a trace with one result."""

    name: str
    params: dict[str, Any]
    given: Sequence[Any]  # of the operands: shape and type
    out: Any  # of the result


class Arrays:
    """Emitter of operations on arrays, into the function of its value emitter."""

    def __init__(self, numbers: Numbers, written_out: bool = False, small: int = SMALL) -> None:
        self.numbers, self.builder, self.small = numbers, numbers.builder, small
        self.alive: list[Any] = []  # objects identified by `id`
        self.written_out = written_out  # within a loop without inner loops: constants need no table

    def kind_of(self, aval: Any) -> ir.Type:
        """Return the type of the entries of an array of the trace."""
        return self.numbers.vector(number_of(aval)) if has_lanes(aval) else number_of(aval)

    def constants_of(self, value: np.ndarray, aval: Any) -> Entries:
        """Return the numbers of a constant as an array."""
        if LANES in aval.shape:
            raise taken_for_lanes("A constant", aval)
        number = number_of(aval)
        entries = array_of(value.shape, [self.numbers.constant(number, x) for x in value.ravel()])
        return entries if value.size <= HELD or self.written_out else self.table(entries)

    def entries(self, array: Entries) -> np.ndarray:
        """Return all entries, one by one."""
        if isinstance(array, np.ndarray):
            return array
        return array_of(array.shape, [self.entry(array, i) for i in np.ndindex(array.shape)])

    def entry(self, array: Entries, index: Index) -> Value:
        """Return an entry, which is computed once for each index."""
        self.alive.append(array)
        if isinstance(array, Field):
            key = ("entry", id(array), *(i if isinstance(i, int) else ("at", id(i)) for i in index))
            return self.numbers.once(key, lambda: array.at(index))
        # An array with stride 0 along an axis is the same at all its indices.
        axes = zip(index, array.strides, array.shape, strict=True)
        index = tuple(0 if step == 0 or length == 1 else i for i, step, length in axes)
        moving = tuple(i for i in index if not isinstance(i, int))
        if not moving:
            return array[index]
        fixed = tuple(i if isinstance(i, int) else slice(None) for i in index)
        stored = self.numbers.once(
            ("table", id(array), str(fixed)), lambda: self.table(array[fixed])
        )
        return self.entry(stored, moving)

    def flat(self, arrays: Sequence[Entries], avals: Sequence[Any]) -> list[Value]:
        """Return all entries in a row, with vectors for those that have lanes."""
        flat: list[Value] = []
        for array, aval in zip(arrays, avals, strict=True):
            full = np.broadcast_to(self.entries(array), shape_of(aval)).ravel()
            flat += [self.numbers.spread(x) if has_lanes(aval) else x for x in full]
        return flat

    def linear(self, index: Index, shape: Sequence[int]) -> Value:
        """Return the offset of an entry among all, row after row."""
        stride, fixed = math.prod(shape), 0
        place: Value = None
        for i, length in zip(index, shape, strict=True):
            stride //= length
            if isinstance(i, int):
                fixed += i * stride
                continue
            term = i if stride == 1 else self.builder.mul(i, ir.Constant(LONG, stride))
            place = term if place is None else self.builder.add(place, term)
        if place is None:
            return ir.Constant(LONG, fixed)
        return self.builder.add(place, ir.Constant(LONG, fixed)) if fixed else place

    def each(
        self,
        shape: Sequence[int],
        body: Callable[[Index, list[Value]], Sequence[Value]],
        carried: Sequence[Value] = (),
    ) -> list[Value]:
        """Emit loops over all indices of `shape`: `carry = body(index, carry)`."""

        def nest(index: Index, carried: Sequence[Value]) -> Sequence[Value]:
            if len(index) == len(shape):
                return body(index, list(carried))
            if shape[len(index)] == 1:
                return nest((*index, 0), carried)
            turn = lambda i, carried: nest((*index, i), carried)
            return self.counted(shape[len(index)], turn, carried)

        return list(nest((), carried))

    def counted(
        self,
        length: int,
        turn: Callable[[Value, list[Value]], Sequence[Value]],
        carried: Sequence[Value],
    ) -> list[Value]:
        """Emit `for i in range(length): carry = body(i, carry)`."""
        return self.range(ir.Constant(LONG, 0), ir.Constant(LONG, length), turn, carried)

    def range(
        self,
        begin: Value,
        end: Value,
        turn: Callable[[Value, list[Value]], Sequence[Value]],
        carried: Sequence[Value] = (),
    ) -> list[Value]:
        """Emit `for i in range(begin, end): carry = emit_body(i, carry)`."""

        def body(state: list[Value]) -> list[Value]:
            following = turn(state[0], state[1:])
            return [self.builder.add(state[0], ir.Constant(LONG, 1)), *following]

        goes_on = lambda state: self.builder.icmp_signed("<", state[0], end)
        return self.numbers.loop([begin, *carried], goes_on, body)[1:]

    def room(self, shape: Sequence[int], kind: ir.Type) -> Memory:
        """Return memory that is allocated once, at the start of the function."""
        with self.builder.goto_entry_block():
            base = self.builder.alloca(kind, ir.Constant(LONG, max(1, math.prod(shape))))
        return Memory(self, shape, kind, base)

    def fill(self, memory: Memory, array: Entries) -> None:
        """Store all initialized entries."""
        if isinstance(array, Unset):
            return
        if isinstance(array, Updated):
            self.fill(memory, array.whole)
            array.store_into(memory)
            return
        if isinstance(array, np.ndarray) and any(array.strides):
            for index in np.ndindex(memory.shape):
                memory.store(index, array[index])
            return

        def store(index: Index, _: Any) -> list[Value]:
            memory.store(index, self.entry(array, index))
            return []

        self.each(memory.shape, store)

    def in_memory(self, array: Entries) -> Memory:
        """Return the array with all entries computed and stored, so that an LLVM index can access
        them.
        """
        if isinstance(array, Memory):
            return array
        memory = self.room(array.shape, _kind(array))
        self.fill(memory, array)
        return memory

    def table(self, array: np.ndarray) -> Memory:
        """Return entries in memory, so that an LLVM index can access them; constants are stored in
        the program.
        """
        if not all(isinstance(x, ir.Constant) for x in array.ravel()):
            return self.in_memory(array)
        number = array.ravel()[0].type
        kind = ir.ArrayType(number, array.size)
        module = self.builder.module
        table = ir.GlobalVariable(module, kind, module.get_unique_name("table"))
        table.initializer = ir.Constant(kind, list(array.ravel()))
        table.global_constant, table.linkage = True, "internal"
        return Memory(self, array.shape, number, table)

    def mapped(self, asked: Asked, values: Sequence[Entries]) -> Entries:
        """Emit an elementwise primitive."""
        name, params, given, out = asked
        shape, before = shape_of(out), given[0].dtype
        if not shape and all(isinstance(x, np.ndarray) and not x.shape for x in values):
            some = [x.item() for x in values]  # type: ignore[union-attr]
            return array_of((), [elementwise(self.numbers, name, params, before, out.dtype, some)])
        if any(x.shape != shape for x in values):
            # An operand without lanes may have an extra axis, or fewer axes.
            values = [self.fitted(x, x.shape[:-1], len(x.shape) > len(shape)) for x in values]
            values = [self.broadcast(x, shape, range(len(x.shape))) for x in values]
        make = lambda some: elementwise(self.numbers, name, params, before, out.dtype, some)
        if any(isinstance(x, Field) for x in values):
            at = lambda index: make([self.entry(x, index) for x in values])
            return Field(shape, self.kind_of(out), at)
        # Along an axis on which no operand varies, the entry is computed once and repeated.
        moves = (any(x.strides[axis] for x in values) for axis in range(len(shape)))  # type: ignore[union-attr]
        own = (*(slice(None if moving else 1) for moving in moves), ...)
        parts = [x[own] for x in values]  # type: ignore[index]
        entries = zip(*(x.ravel() for x in parts), strict=True)
        told = array_of(parts[0].shape, [make(some) for some in entries])
        return np.broadcast_to(told, shape)

    def fitted(self, array: Entries, shape: tuple[int, ...], needed: bool) -> Entries:
        """Return the array reshaped, if needed."""
        return self.reshaped(array, shape) if needed else array

    def broadcast(self, array: Entries, shape: tuple[int, ...], axes: Sequence[int]) -> Entries:
        """Return the array with its axes at these positions of `shape`."""
        lengths = array.shape
        if lengths == shape and tuple(axes) == tuple(range(len(shape))):
            return array
        if isinstance(array, np.ndarray):
            grown = [1] * len(shape)
            for axis, length in zip(axes, lengths, strict=True):
                grown[axis] = length
            return np.broadcast_to(array.reshape(grown), shape)

        def at(index: Index) -> Value:
            pairs = zip(axes, lengths, strict=True)
            return self.entry(array, tuple(0 if n == 1 else index[axis] for axis, n in pairs))

        return Field(shape, array.kind, at)

    def reshaped(self, array: Entries, shape: tuple[int, ...]) -> Entries:
        """Return an array with the same entries in the same order."""
        if array.shape == shape:
            return array
        if isinstance(array, np.ndarray):
            return array.reshape(shape)
        if isinstance(array, Memory):
            return Memory(self, shape, array.kind, array.base, array.free)
        before = array.shape

        def at(index: Index) -> Value:
            place = self.linear(index, shape)
            fixed = place.constant if isinstance(place, ir.Constant) else None
            if fixed is not None:
                return self.entry(array, tuple(map(int, np.unravel_index(fixed, before))))
            where: list[Any] = []
            for length in before[:0:-1]:
                size = ir.Constant(LONG, length)
                where.append(0 if length == 1 else self.builder.urem(place, size))
                place = place if length == 1 else self.builder.udiv(place, size)
            return self.entry(array, (0 if before[0] == 1 else place, *where[::-1]))

        own = [i for i, length in enumerate(before) if length > 1]
        new = [i for i, length in enumerate(shape) if length > 1]
        if [before[i] for i in own] == [shape[i] for i in new]:  # only axes of length 1 differ

            def at(index: Index) -> Value:
                moved = dict(zip(own, (index[i] for i in new), strict=True))
                return self.entry(array, tuple(moved.get(i, 0) for i in range(len(before))))

        return Field(shape, array.kind, at)

    def shifted(self, i: Any, start: int, step: int = 1) -> Any:
        """Return start + step * i."""
        if isinstance(i, int):
            return start + step * i
        i = i if step == 1 else self.builder.mul(i, ir.Constant(LONG, step))
        return i if start == 0 else self.builder.add(i, ir.Constant(LONG, start))

    def clamped(self, i: Value, last: int) -> Value:
        """Return the nearest index from 0 to `last`."""
        build, zero, end = self.builder, ir.Constant(LONG, 0), ir.Constant(LONG, last)
        i = build.select(build.icmp_signed("<", i, zero), zero, i)
        return build.select(build.icmp_signed(">", i, end), end, i)

    def further(self, index: Index, begin: Index) -> Index:
        """Return the sum of two indices."""

        def plus(i: Any, j: Any) -> Any:
            if isinstance(j, int):
                return self.shifted(i, j)
            return self.shifted(j, i) if isinstance(i, int) else self.builder.add(i, j)

        return tuple(plus(i, j) for i, j in zip(index, begin, strict=True))

    def zero(self, kind: ir.Type) -> Value:
        """Return a zero as the start of a sum, which is not simplified like a known
        constant zero.
        """
        number = kind.element if isinstance(kind, ir.VectorType) else kind
        value = ir.Constant(number, 0.0 if isinstance(number, _FLOATS) else 0)
        if not isinstance(kind, ir.VectorType):
            return value
        return ir.Constant(kind, [value] * kind.count)


_FLOATS = (ir.FloatType, ir.DoubleType)


def _kind(array: Entries) -> ir.Type:
    """Return the type of entries: a vector if any entry is one."""
    if isinstance(array, Field):
        return array.kind
    kinds = [x.type for x in array.ravel()]
    return next((kind for kind in kinds if isinstance(kind, ir.VectorType)), kinds[0])


def has_lanes(aval: Any) -> bool:
    """Return whether an array of the trace has the axis of lanes."""
    return bool(aval.shape) and aval.shape[-1] == LANES


def shape_of(aval: Any) -> tuple[int, ...]:
    """Return the shape without the axis of lanes."""
    return aval.shape[:-1] if has_lanes(aval) else aval.shape


def taken_for_lanes(what: str, aval: Any) -> NotImplementedError:
    """Return the error for an axis as long as the lanes' that is another, or is moved there."""
    return NotImplementedError(
        f"{what} has the shape {aval.str_short()}: an axis of {LANES} is the lanes', which come "
        "from arguments and stay the last; keep them there, and give other axes another length."
    )


def moved(name: str) -> NotImplementedError:
    """Return the error for a primitive that combines or moves lanes."""
    return NotImplementedError(
        f"{name} moves, joins or picks lanes: do the same to each by itself; only `any` and `all` "
        "may ask about all of them."
    )


def number_of(aval: Any) -> ir.Type:
    """Return the type of an entry for one lane."""
    if aval.dtype not in _NUMBERS:
        raise NotImplementedError(
            f"{aval.str_short()} has numbers that machine code does not know: convert them to one "
            f"of {', '.join(NUMBERS)}."
        )
    return _NUMBERS[aval.dtype]


_NUMBERS = {
    np.dtype(name): kind for name, kind in NUMBERS.items()
}  # dtype names are slow to compute


def array_of(shape: tuple[int, ...], entries: Sequence[Value]) -> np.ndarray:
    """Return an array of LLVM values."""
    array = np.empty(len(entries), object)
    array[:] = entries
    return array.reshape(shape)


def arrays_of(flat: Sequence[Value], avals: Sequence[Any]) -> list[Entries]:
    """Return the arrays whose entries `ArrayEmitter.flatten_entries` returned."""
    found: list[Entries] = []
    begin = 0
    for aval in avals:
        shape = shape_of(aval)
        end = begin + math.prod(shape)
        found.append(array_of(shape, flat[begin:end]))
        begin = end
    return found
