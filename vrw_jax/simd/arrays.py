"""Arrays of LLVM values: entries in registers, fields that are computed where an index asks.

An array whose last axis are lanes is, without that axis, an array of LLVM vectors, any other one of
plain numbers. Small ones are taken apart into their entries, which live in registers: moving axes,
slicing and stacking cost nothing. Large ones are fields: each entry is computed or loaded where an
index asks for it, in a loop over the index, and they lie in memory only where a loop carries them,
where a long sum ends and where the trace has an `optimization_barrier`. So code stays short and
compiles quickly. Nothing may look from lane to lane but to ask whether any or all of them go on.
"""

import functools
import math
from collections.abc import Callable, Sequence
from typing import Any

import llvmlite.ir as ir
import numpy as np

from vrw_jax.simd.fields import Entries, Field, Index, Memory, Updated
from vrw_jax.simd.numbers import LONG, NUMBERS, Numbers, Value

LANES = 1021
"""Lanes of the trace, by which their axis is known; machine code has as many as suit it."""
SMALL = 8
"""Entries of fields that are taken apart after all, and terms of sums that are written out."""
HELD = 32
"""Entries of arrays that loops carry in registers, and of constants that need no table."""
HELD_INSIDE = 64
"""The first of these for loops that contain none: they are written out."""

REDUCED = {
    "reduce_max": "max",
    "reduce_min": "min",
    "reduce_sum": "add",
    "reduce_or": "or",
    "reduce_and": "and",
}


class Arrays(Numbers):
    """Writes operations on arrays into a function of `builder`'s module."""

    def __init__(self, builder: ir.IRBuilder, width: int) -> None:
        super().__init__(builder, width)
        self.alive: list[Any] = []  # what is known by `id`
        self.written_out = False  # within a loop's body that has no loops: constants need no table

    def kind_of(self, aval: Any) -> ir.Type:
        """What entries of one of the trace's arrays are."""
        return self.vector(_number(aval)) if has_lanes(aval) else _number(aval)

    def constants_of(self, value: np.ndarray, aval: Any) -> Entries:
        """Numbers of the program."""
        if has_lanes(aval):
            raise NotImplementedError(f"{aval.str_short()} is constant, but differs by lane.")
        number = _number(aval)
        entries = array_of(value.shape, [self.constant(number, x) for x in value.ravel()])
        return entries if value.size <= HELD or self.written_out else self._table(entries)

    def primitive(self, equation: Any, values: Sequence[Entries]) -> Entries:
        """The result of an equation that is neither a loop nor a call."""
        name, params = equation.primitive.name, equation.params
        given = [atom.aval for atom in equation.invars]
        out = equation.outvars[0].aval
        if any(map(has_lanes, given)) and not has_lanes(out) and name not in REDUCED:
            raise NotImplementedError(f"{name} moves, joins or picks lanes: {equation}")
        if name in REDUCED:
            result: Entries = self._reduced(REDUCED[name], params["axes"], given[0], out, values[0])
        elif hasattr(self, f"_do_{name}"):
            result = getattr(self, f"_do_{name}")(params, given, out, *values)
        else:
            result = self._mapped(name, params, given[0].dtype, out, values)
        if isinstance(result, Field) and math.prod(result.shape) <= SMALL:
            result = self.entries(result)
        return result

    def entries(self, array: Entries) -> np.ndarray:
        """All entries, one by one."""
        if isinstance(array, np.ndarray):
            return array
        return array_of(array.shape, [self.entry(array, i) for i in np.ndindex(array.shape)])

    def entry(self, array: Entries, index: Index) -> Value:
        """An entry, computed once for each index."""
        self.alive.append(array)
        if isinstance(array, Field):
            key = ("entry", id(array), *(i if isinstance(i, int) else ("at", id(i)) for i in index))
            return self.once(key, lambda: array.at(index))
        # What repeats itself along an axis is the same at all its indices.
        axes = zip(index, array.strides, array.shape, strict=True)
        index = tuple(0 if step == 0 or length == 1 else i for i, step, length in axes)
        moving = tuple(i for i in index if not isinstance(i, int))
        if not moving:
            return array[index]
        fixed = tuple(i if isinstance(i, int) else slice(None) for i in index)
        stored = self.once(("table", id(array), str(fixed)), lambda: self._table(array[fixed]))
        return self.entry(stored, moving)

    def linear(self, index: Index, shape: Sequence[int]) -> Value:
        """The place of an entry among all, row after row."""
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
        """Loops over all indices of `shape`: `carried = body(index, carried)`."""

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
        """`for i in range(length): carried = turn(i, carried)`."""
        return self.range(ir.Constant(LONG, 0), ir.Constant(LONG, length), turn, carried)

    def range(
        self,
        begin: Value,
        end: Value,
        turn: Callable[[Value, list[Value]], Sequence[Value]],
        carried: Sequence[Value] = (),
    ) -> list[Value]:
        """`for i in range(begin, end): carried = turn(i, carried)`."""

        def body(state: list[Value]) -> list[Value]:
            following = turn(state[0], state[1:])
            return [self.builder.add(state[0], ir.Constant(LONG, 1)), *following]

        goes_on = lambda state: self.builder.icmp_signed("<", state[0], end)
        return self.loop([begin, *carried], goes_on, body)[1:]

    def room(self, shape: Sequence[int], kind: ir.Type) -> Memory:
        """Memory, taken once where the function begins."""
        with self.builder.goto_entry_block():
            base = self.builder.alloca(kind, ir.Constant(LONG, max(1, math.prod(shape))))
        return Memory(self, shape, kind, base)

    def fill(self, memory: Memory, array: Entries) -> None:
        """Stores all entries."""
        if isinstance(array, Updated):
            self.fill(memory, array.whole)
            array.store_into(memory)
            return
        if isinstance(array, np.ndarray):
            for index in np.ndindex(memory.shape):
                memory.store(index, array[index])
            return

        def store(index: Index, _: Any) -> list[Value]:
            memory.store(index, self.entry(array, index))
            return []

        self.each(memory.shape, store)

    def in_memory(self, array: Entries) -> Memory:
        """All entries computed, where an index can reach them."""
        if isinstance(array, Memory):
            return array
        memory = self.room(array.shape, _kind(array))
        self.fill(memory, array)
        return memory

    def _table(self, array: np.ndarray) -> Memory:
        """Entries where an index can reach them: constants are stored with the program."""
        if not all(isinstance(x, ir.Constant) for x in array.ravel()):
            return self.in_memory(array)
        number = array.ravel()[0].type
        kind = ir.ArrayType(number, array.size)
        module = self.builder.module
        table = ir.GlobalVariable(module, kind, module.get_unique_name("table"))
        table.initializer = ir.Constant(kind, list(array.ravel()))
        table.global_constant, table.linkage = True, "internal"
        return Memory(self, array.shape, number, table)

    def _mapped(
        self, name: str, params: Any, before: Any, out: Any, values: Sequence[Entries]
    ) -> Entries:
        """An elementwise primitive."""
        shape = shape_of(out)
        if any(x.shape != shape for x in values):
            # One number for all lanes may have an axis for them, or be the same anywhere.
            values = [self._fitted(x, x.shape[:-1], len(x.shape) > len(shape)) for x in values]
            values = [self._broadcast(x, shape, range(len(x.shape))) for x in values]
        make = lambda some: self.elementwise(name, params, before, out.dtype, some)
        if any(isinstance(x, Field) for x in values):
            at = lambda index: make([self.entry(x, index) for x in values])
            return Field(shape, self.kind_of(out), at)
        entries = zip(*(x.ravel() for x in values), strict=True)  # type: ignore[union-attr]
        return array_of(shape, [make(some) for some in entries])

    def _fitted(self, array: Entries, shape: tuple[int, ...], needed: bool) -> Entries:
        return self._reshaped(array, shape) if needed else array

    def _broadcast(self, array: Entries, shape: tuple[int, ...], axes: Sequence[int]) -> Entries:
        """Its axes at these places of `shape`."""
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

    def _do_broadcast_in_dim(
        self, params: Any, given: Any, out: Any, array: Entries, *_: Any
    ) -> Entries:
        shape, axes = shape_of(out), tuple(map(int, params["broadcast_dimensions"]))
        array = self._fitted(array, array.shape[:-1], len(array.shape) > len(shape))
        if has_lanes(out) and len(array.shape) == len(axes) and axes[-1:] == (len(shape),):
            array = self._reshaped(array, array.shape[:-1])  # one number has the axis of lanes
        result = self._broadcast(array, shape, axes[: len(array.shape)])
        if isinstance(result, Field):
            return Field(shape, self.kind_of(out), result.at)
        return result

    def _reshaped(self, array: Entries, shape: tuple[int, ...]) -> Entries:
        if array.shape == shape:
            return array
        if isinstance(array, np.ndarray):
            return array.reshape(shape)
        if isinstance(array, Memory):
            return Memory(self, shape, array.kind, array.base)
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

    def _do_reshape(self, params: Any, given: Any, out: Any, array: Entries) -> Entries:
        return self._reshaped(array, shape_of(out))

    _do_squeeze = _do_expand_dims = _do_reshape

    def _do_transpose(self, params: Any, given: Any, out: Any, array: Entries) -> Entries:
        order = params["permutation"]
        order = order[: len(array.shape)]
        if isinstance(array, np.ndarray):
            return array.transpose(order)
        back = np.argsort(order)
        at = lambda index: self.entry(array, tuple(index[i] for i in back))
        return Field(shape_of(out), array.kind, at)

    def _do_slice(self, params: Any, given: Any, out: Any, array: Entries) -> Entries:
        strides = params["strides"] or (1,) * len(params["start_indices"])
        places = zip(params["start_indices"], params["limit_indices"], strides, strict=True)
        slices = [slice(*place) for place in places][: len(array.shape)]
        if isinstance(array, np.ndarray):
            return array[tuple(slices)]

        def at(index: Index) -> Value:
            pairs = zip(index, slices, strict=True)
            return self.entry(array, tuple(self._shifted(i, s.start, s.step) for i, s in pairs))

        return Field(shape_of(out), array.kind, at)

    def _shifted(self, i: Any, start: int, step: int = 1) -> Any:
        """start + step * i."""
        if isinstance(i, int):
            return start + step * i
        i = i if step == 1 else self.builder.mul(i, ir.Constant(LONG, step))
        return i if start == 0 else self.builder.add(i, ir.Constant(LONG, start))

    def _do_concatenate(self, params: Any, given: Any, out: Any, *arrays: Entries) -> Entries:
        axis = params["dimension"]
        if all(isinstance(x, np.ndarray) for x in arrays):
            return np.concatenate(arrays, axis)  # type: ignore[arg-type]
        parts = [x for x in arrays if x.shape[axis]]
        starts = np.cumsum([0, *(x.shape[axis] for x in parts)]).tolist()

        def at(index: Index) -> Value:
            i, chosen = index[axis], None
            for part, start in zip(parts, starts, strict=False):
                here, last = self._shifted(i, -start), part.shape[axis] - 1
                if isinstance(i, int):
                    if 0 <= here <= last:
                        return self.entry(part, (*index[:axis], here, *index[axis + 1 :]))
                    continue
                # Beyond its end, any entry will do: another part's is chosen there.
                here = 0 if last == 0 else self._clamped(here, last)
                value = self.entry(part, (*index[:axis], here, *index[axis + 1 :]))
                inside = self.builder.icmp_signed(">=", i, ir.Constant(LONG, start))
                if chosen is None:
                    chosen = value
                else:
                    value, chosen = self._alike(value, chosen)
                    chosen = self.builder.select(inside, value, chosen)
            return chosen

        return Field(shape_of(out), self.kind_of(out), at)

    def _clamped(self, i: Value, last: int) -> Value:
        build, zero, end = self.builder, ir.Constant(LONG, 0), ir.Constant(LONG, last)
        i = build.select(build.icmp_signed("<", i, zero), zero, i)
        return build.select(build.icmp_signed(">", i, end), end, i)

    def _do_stack(self, params: Any, given: Any, out: Any, *arrays: Entries) -> Entries:
        axis = params["axis"]
        longer = [self._reshaped(x, (*x.shape[:axis], 1, *x.shape[axis:])) for x in arrays]
        return self._do_concatenate({"dimension": axis}, given, out, *longer)

    def _do_pad(self, params: Any, given: Any, out: Any, array: Entries, value: Entries) -> Entries:
        """With more entries around, none within."""
        around = params["padding_config"][: len(array.shape)]
        if any(low < 0 or high < 0 or within for low, high, within in around):
            raise NotImplementedError("pad takes entries away or puts some between.")
        filled = np.broadcast_to(self.entries(value).reshape(()), shape_of(out)).copy()
        inside = tuple(
            slice(low, low + n) for (low, _, _), n in zip(around, array.shape, strict=True)
        )
        filled[inside] = self.entries(array)
        return filled

    def _do_iota(self, params: Any, given: Any, out: Any) -> Entries:
        return self.constants_of(np.indices(out.shape)[params["dimension"]], out)

    def _do_dynamic_slice(
        self, params: Any, given: Any, out: Any, array: Entries, *starts: Entries
    ) -> Entries:
        begin = self._starts(given, array.shape, shape_of(out), starts)
        at = lambda index: self.entry(array, self.further(index, begin))
        return Field(shape_of(out), self.kind_of(out), at)

    def _do_dynamic_update_slice(
        self, params: Any, given: Any, out: Any, array: Entries, update: Entries, *starts: Entries
    ) -> Entries:
        begin = self._starts(given[1:], array.shape, update.shape, starts)
        return Updated(self, self.in_memory(array), update, begin)

    def _starts(
        self, given: Any, whole: Index, part: Index, starts: Sequence[Entries]
    ) -> tuple[Any, ...]:
        """Where a part begins, moved so that it lies inside."""
        begin: list[Any] = []
        for aval, n, m, start in zip(given[1:], whole, part, starts, strict=False):
            place = self.entries(start).item()
            if n == m:
                begin.append(0)
            elif isinstance(place, ir.Constant):
                begin.append(min(max(int(place.constant), 0), n - m))
            else:
                place = self._converted(place, aval.dtype, np.dtype(np.int64))
                begin.append(self._clamped(place, n - m))
        return tuple(begin)

    def further(self, index: Index, begin: Index) -> Index:
        """The sum of two indices."""

        def plus(i: Any, j: Any) -> Any:
            if isinstance(j, int):
                return self._shifted(i, j)
            return self._shifted(j, i) if isinstance(i, int) else self.builder.add(i, j)

        return tuple(plus(i, j) for i, j in zip(index, begin, strict=True))

    def _do_cumsum(self, params: Any, given: Any, out: Any, array: Entries) -> Entries:
        if params["axis"] == len(array.shape):
            raise NotImplementedError("cumsum moves, joins or picks lanes.")
        rows = np.moveaxis(self.entries(array), params["axis"], 0)
        order = range(len(rows))[:: -1 if params["reverse"] else 1]
        plus = lambda x, y: self.elementwise("add", {}, out.dtype, out.dtype, (x, y))
        sums = np.empty_like(rows)
        for k, i in enumerate(order):
            pairs = zip(sums[order[k - 1], ...].ravel(), rows[i, ...].ravel(), strict=True)
            told = [plus(*pair) if k else pair[1] for pair in pairs]
            sums[i, ...] = array_of(rows.shape[1:], told)
        return np.moveaxis(sums, 0, params["axis"])

    def _do_dot_general(
        self, params: Any, given: Any, out: Any, left: Entries, right: Entries
    ) -> Entries:
        (over_left, over_right), (both, _) = params["dimension_numbers"]
        if both or len(over_left) != 1:
            raise NotImplementedError("dot_general sums over one pair of axes only.")
        (a,), (b,), dtype = over_left, over_right, out.dtype
        length, n_left = left.shape[a], len(left.shape) - 1

        def product(index: Index, k: Any) -> Value:
            own, other = index[:n_left], index[n_left:]
            x = self.entry(left, (*own[:a], k, *own[a:]))
            y = self.entry(right, (*other[:b], k, *other[b:]))
            return self.elementwise("mul", {}, dtype, dtype, (x, y))

        plus = lambda x, y: self.elementwise("add", {}, dtype, dtype, (x, y))
        shape, kind = shape_of(out), self.kind_of(out)
        if length <= SMALL or self.written_out:
            at = lambda index: functools.reduce(plus, [product(index, k) for k in range(length)])
            if isinstance(left, Field) or isinstance(right, Field):
                return Field(shape, kind, at)
            return array_of(shape, [at(index) for index in np.ndindex(shape)])
        left, right = self.in_memory(left), self.in_memory(right)
        memory = self.room(shape, kind)

        def total(index: Index, _: Any) -> list[Value]:
            turn = lambda k, sums: [plus(sums[0], product(index, k))]
            memory.store(index, self.counted(length, turn, [self._zero(kind)])[0])
            return []

        self.each(shape, total)
        return memory

    def _zero(self, kind: ir.Type) -> Value:
        # Not `constant`: sums drop terms that are known to be zero, but this one is to grow.
        number = kind.element if isinstance(kind, ir.VectorType) else kind
        value = ir.Constant(number, 0.0 if isinstance(number, _FLOATS) else 0)
        if not isinstance(kind, ir.VectorType):
            return value
        return ir.Constant(kind, [value] * kind.count)

    def _reduced(self, name: str, axes: Sequence[int], before: Any, out: Any, array: Entries
                 ) -> Entries:  # fmt: skip
        """Over axes of entries, and for `or` and `and` over lanes."""
        over_lanes = has_lanes(before) and not has_lanes(out)
        if over_lanes and name not in ("or", "and"):
            raise NotImplementedError(f"a sum or largest of lanes is asked for: {before}.")
        axes = tuple(axis for axis in axes if axis < len(array.shape))
        combine = lambda x, y: self.elementwise(name, {}, before.dtype, before.dtype, (x, y))
        left_over = [n for axis, n in enumerate(array.shape) if axis not in axes]
        lengths = [array.shape[axis] for axis in axes]

        def index_of(outer: Index, inner: Index) -> Index:
            some, others = iter(inner), iter(outer)
            return tuple(next(some if i in axes else others) for i in range(len(array.shape)))

        def reduced(outer: Index) -> Value:
            at = lambda inner: self.entry(array, index_of(outer, inner))
            if isinstance(array, np.ndarray) or math.prod(lengths) <= SMALL:
                return functools.reduce(combine, map(at, np.ndindex(*lengths)))
            first = at((0,) * len(lengths))  # counted twice: for these sums, no matter
            if name == "add":
                first = self._zero(array.kind)
            elif isinstance(array.kind, ir.VectorType):
                first = self.spread(first)
            return self.each(lengths, lambda i, so_far: [combine(so_far[0], at(i))], [first])[0]

        values = [reduced(outer) for outer in np.ndindex(*left_over)]
        if over_lanes:
            values = [self._over_lanes(name, value) for value in values]
        return array_of(tuple(left_over), values)

    def _over_lanes(self, name: str, value: Value) -> Value:
        build = self.builder
        if not isinstance(value.type, ir.VectorType):
            return value
        bits = build.bitcast(value, ir.IntType(self.width))
        if name == "or":
            return build.icmp_unsigned("!=", bits, ir.Constant(bits.type, 0))
        return build.icmp_unsigned("==", bits, ir.Constant(bits.type, -1))


_FLOATS = (ir.FloatType, ir.DoubleType)


def _kind(array: Entries) -> ir.Type:
    """What entries are: vectors, if any of them is one."""
    if isinstance(array, Field):
        return array.kind
    kinds = [x.type for x in array.ravel()]
    return next((kind for kind in kinds if isinstance(kind, ir.VectorType)), kinds[0])


def has_lanes(aval: Any) -> bool:
    return bool(aval.shape) and aval.shape[-1] == LANES


def shape_of(aval: Any) -> tuple[int, ...]:
    """Without the axis of lanes."""
    return aval.shape[:-1] if has_lanes(aval) else aval.shape


def _number(aval: Any) -> ir.Type:
    if aval.dtype not in _NUMBERS:
        raise NotImplementedError(f"numbers of {aval.str_short()} are of no kind known here.")
    return _NUMBERS[aval.dtype]


_NUMBERS = {np.dtype(name): kind for name, kind in NUMBERS.items()}  # names are slow to ask for


def array_of(shape: tuple[int, ...], entries: Sequence[Value]) -> np.ndarray:
    """An array of LLVM values."""
    array = np.empty(len(entries), object)
    array[:] = entries
    return array.reshape(shape)
